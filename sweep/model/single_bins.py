"""|X| of a segment's bins one by one, from the lines themselves: the way that serves whatever is.

Any window, padded records, means over shifts, lines in parts however far apart. Where spectra are
smooth bundles are faster (:mod:`sweep.model.runs`).
"""

import math

from sweep.model.compiling import borrowing, owning
from sweep.model.effects.line_modes import CENTRE, lines_of
from sweep.model.mode_kernels import bound_of, modes_in
from sweep.model.runs import reach_of
from sweep.model.spectrum import bin_magnitudes, split_magnitudes


@owning()
def parts_at(segment, i, fold, scene, power, kernel):
    """Parts of the lines of a point that add as powers, and how much farther and stronger they are.

    Amplitudes have none: they are lines of their own by then.

    Returns
    -------
    split : tuple of (k,) float64
        Places [bins] from a line, real and imaginary weights that are not conjugated yet.
    further : (float, float, float)
        Bound on what parts show beside the line, relative to it; their lowest and highest place.
    """
    parts = scene[1]
    each, below, above = 1.0, 0.0, 0.0
    if not power or not parts[0].size:
        return (parts[0][0, 0], parts[0][0, 0], parts[0][0, 0]), (each, below, above)
    bins, own = fold * kernel[0][0] / kernel[0][1], parts[4][i]
    number = parts[3][segment, own]
    if number == 0:
        numbers, (offset, strength) = parts[1][segment, own], modes_in(kernel)
        place, re, im = lines_of(numbers, offset, strength)
        each, below = bound_of(numbers, kernel), bins * numbers[CENTRE]
        above = below
    else:
        place = parts[0][segment, own, :number].copy()
        re, im = parts[1][segment, own, :number], parts[2][segment, own, :number]
        each = 0.0
        for k in range(number):
            each += math.hypot(re[k], im[k])
            below, above = min(below, bins * place[k]), max(above, bins * place[k])
    for k in range(place.size):
        place[k] *= bins
    return (place, re, im), (each, below, above)


@borrowing()
def magnitudes_of(low, high, origin, n, i, fold, split, shifts, choices, kernel, room):
    """|X| of bins low .. high of n lines in rows 4 to 6, into row 0.

    ``split``: the lines' parts (:func:`parts_at`) where powers add; else they are lines already.
    """
    sizes, shape, tangent = kernel[0], kernel[1], kernel[4]
    power, image = choices[0], choices[1]
    delta, re, im = room[4], room[5], room[6]
    if power and split[0].size:
        split_magnitudes(
            low, high, origin, delta, re, n, split, fold, sizes, shape, tangent, room[0],
            room[11:19], image,
        )  # fmt: skip
    elif not power and shifts[0].size:
        _average(low, high, origin, n, i, fold, shifts, image, kernel, room)
    else:
        bin_magnitudes(
            low, high, origin, delta, re, im, n, sizes, shape, power, tangent, room[0], room[1],
            room[7:10], image,
        )  # fmt: skip


@borrowing()
def _average(low, high, origin, n, i, fold, shifts, image, kernel, room):
    """Root of the mean |X|^2 over shifts of n lines that add as amplitudes, into row 0."""
    sizes, shape, tangent = kernel[0], kernel[1], kernel[4]
    total, moved = room[0, : high - low + 1], room[10]
    total[:] = 0.0
    for m in range(shifts[0].shape[1]):
        share = shifts[1][i, m]
        if share > 0.0:
            apart = fold * shifts[0][i, m] * sizes[0] / sizes[1]
            for j in range(n):
                moved[j] = room[4, j] + apart
            bin_magnitudes(
                low, high, origin, moved, room[5], room[6], n, sizes, shape, False, tangent,
                room[1], room[2], room[7:10], image,
            )  # fmt: skip
            for k in range(total.size):
                total[k] += share * (room[1, k] * room[1, k])
    for k in range(total.size):
        total[k] = math.sqrt(total[k])


@borrowing()
def extent_of(i, n, split, further, shifts, power, kernel, room):
    """Summed weight of n lines in rows 4 to 6 as |X| may have it, and their lowest and highest.

    Parts, as of :func:`parts_at`, and shifts that are not lines of their own yet are reckoned with.
    """
    delta, re, im = room[4], room[5], room[6]
    total = 0.0
    lowest, highest = delta[0], delta[0]
    for j in range(n):
        total += abs(re[j]) if power else math.hypot(re[j], im[j])
        lowest, highest = min(lowest, delta[j]), max(highest, delta[j])
    if power:
        each, below, above = further
        return math.sqrt(total) * each, lowest + below, highest + above
    below, above = 0.0, 0.0
    for k in range(shifts[0].shape[1]):
        if shifts[1][i, k] > 0.0:
            below, above = min(below, shifts[0][i, k]), max(above, shifts[0][i, k])
    bins = kernel[0][0] / kernel[0][1]
    return total, lowest + below * bins, highest + above * bins


@borrowing()
def bins_above(level, extent, origin, kernel):
    """First and last bin, within 0..N/2, that lines of an extent can lift above a level."""
    fft_size, length = kernel[0]
    window_sum, envelope, reach, _ = kernel[2]
    total, lowest, highest = extent
    beyond = reach_of(level, total * window_sum, envelope, reach) * fft_size / length + 2.0
    half = fft_size // 2
    low, high = origin + lowest - beyond, origin + highest + beyond
    # Lines beyond DC or Nyquist are seen as their images, which fold back into the band.
    if low < 0:
        high = max(high, -low)
    if high > half:
        low = min(low, fft_size - high)
    first = 0 if low < 0 else min(math.floor(low), half)
    last = half if high > half else max(math.ceil(high), 0)
    return first, max(first, last)
