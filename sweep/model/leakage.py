"""A segment's detection and leakage, every bin accounted for without looking at each.

Bins within a run around the lines are evaluated one by one: all that may cross the threshold, and
as many as it takes for what leaks to become smooth. Beyond it, down to DC and up to Nyquist, the
chances that leaked signal adds are summed as an integral (:mod:`sweep.model.far_field`), to better
than 1e-6 of the leakage; or left out, where the window's envelope says that they come to no more
than the accuracy asked for. What this leaves of that may do for the bins within the run as well.
"""

import math

import numpy as np

from sweep.model import far_field
from sweep.model.compiling import borrowing
from sweep.model.crossings import (
    added_crossings,
    any_crossing,
    largest,
    silence,
    weighted_silence,
)
from sweep.model.detection import mark
from sweep.model.far_field import CLEARANCE
from sweep.model.lanes import dot
from sweep.model.runs import (
    add_afar,
    bundle,
    magnitudes,
    near_bins,
    prepare_field,
    seen_from,
    served_beside,
    stays_below,
    sum_afar,
)

APRON = 3
"""Bins on either side of an integral's near end that its corrections look at."""

SMOOTHNESS = 1e-7
"""Largest last correction at the near end of an integral, relative to all that leaks."""


@borrowing()
def inspect(origin, n, kind, noise, choices, kernel, room, exempt, series):
    """Run of bins, detection and leakage of a segment's lines.

    Parameters
    ----------
    origin, n : int
        Bin from which the lines count; their number. Rows DELTA .. hold positions and C_b, for
        ``power`` |C_b|^2 and nothing; they become strengths.
    kind : tuple
        Whether they are sources of bundles, and of which: :func:`sweep.model.bundles.take_bundles`.
    noise : (float, float, float)
        sigma per quadrature; threshold; chance of leakage that may be left out.
    choices, kernel
        As of :func:`sweep.model.segments.segment_spectrum`.
    room : (ROOM, width) float64
        Scratch; |X| of the run in row 0.
    exempt : (width,) bool
        Result: bins of the run that can't raise a false alarm.
    series : (MOST_TERMS,) float64
        :func:`sweep.model.crossings.crossing_series` of the threshold.

    Returns
    -------
    low, count, peak, exempted : int
        First bin of the run, number of bins, index of the largest, number of exempt ones; count
        is 0 where the lines lie too far apart for what this rests on.
    leakage : float
    """
    half_size = kernel[0][0] // 2
    power, image = choices[0], choices[1]
    total, lowest, highest = bundle(n, kind, power, room)
    near, mirrored, fits = near_bins(
        origin, lowest, highest, CLEARANCE + len(kernel[1][2]), image, kernel
    )
    if not fits:
        return 0, 0, 0, 0, 0.0
    spread = lowest, highest
    poles = len(kernel[1][2])
    total = math.sqrt(total) if power else sum_afar(n, total, spread, poles, room)
    centre = seen_from(origin, spread, kernel[0][0])
    crossing = stays_below(noise[1], total * kernel[2][0], highest - lowest, centre, image, kernel)
    clearance = CLEARANCE + poles
    reach = int(min(max(math.ceil(crossing) - clearance, 0), half_size))
    mirror = min(centre, half_size - centre) - 0.5 * (highest - lowest) - 1.0
    mirror = mirror if image else math.inf
    left = noise[2] - _all_beyond(total, float(clearance + reach), mirror, noise, kernel)
    alone = left >= 0.0
    if alone and reach > 0:
        served = min(reach, served_beside(kind, kernel))
        wider = near_bins(origin, lowest, highest, clearance + served, image, kernel)
        if wider[2]:
            near, mirrored, _ = wider
            reach -= served
    sources = not alone or reach > 0 or (image and not mirrored)
    field = prepare_field(origin, n, kind, spread, sources, choices, kernel, room)
    if alone:
        low, high = max(near[0] - reach, 0), min(near[1] + reach, half_size)
        count = high - low + 1
        magnitudes(low, count, origin, n, near, mirrored, field, power, kernel, room)
        peak, exempted = mark(room[0], count, noise[1], exempt)
        chance = _of_run(count, left, noise, kernel, room, exempt, series)
        return low, count, peak, exempted, chance
    reach = _least_reach(total, highest - lowest, noise, crossing, kernel)
    while True:
        low, high = near[0] - reach, near[1] + reach
        low = 0 if low <= reach + APRON else low
        high = half_size if half_size - high <= reach + APRON else high
        count = high - low + 1
        magnitudes(low, count, origin, n, near, mirrored, field, power, kernel, room)
        peak, exempted = mark(room[0], count, noise[1], exempt)
        leakage, settled = _leakage(
            low, count, peak, field, noise, choices, kernel, room, exempt, series
        )
        if settled:
            return low, count, peak, exempted, leakage
        reach *= 2


@borrowing()
def _all_beyond(total, first, mirror, noise, kernel):
    """Bound on the chance that any bin ``first`` or more bins from the lines adds to leakage.

    With x = a^2/2, y = b^2/2 and z = a b a bin's own is at most

        x dQ_1/dx = x y e^{-y} g,    g = I_1(z) / (z/2) <= e^{z^2/8}, 2 e^z / sqrt(2 pi z^3)

    so that all of them together have at most y e^{-y} g(nearest) times the sum of x. Images are no
    nearer to a bin than the lines, nor than ``mirror``; infinite where there are none.
    """
    sigma, level, _ = noise
    weight = total * kernel[2][0] / sigma
    b = level / sigma
    y = 0.5 * b * b
    nearest, squares = _envelope_beyond(first, kernel)
    if mirror < math.inf:
        image, image_squares = _envelope_beyond(max(first, mirror), kernel)
        image_squares += max(mirror - first, 0.0) * image * image
        nearest += image
        squares = (math.sqrt(squares) + math.sqrt(image_squares)) ** 2
    z = weight * nearest * b
    if z > 2.0 * y:
        return np.inf
    growth = z * z / 8.0
    if z > 1.0:
        growth = min(growth, z + math.log(2.0 / math.sqrt(2.0 * math.pi * z * z * z)))
    return weight * weight * squares * y * math.exp(growth - y) / -math.expm1(-y)


@borrowing()
def _envelope_beyond(first, kernel):
    """Window's envelope ``first`` bins away; sum of its squares in all bins from there on."""
    _, envelope, reach, beyond = kernel[2]
    place = max(np.searchsorted(reach, max(first - 1.5, 0.0), "right") - 1, 0)
    return envelope[place], envelope[place] * envelope[place] + beyond[place]


@borrowing()
def _at_most(count, noise, exempt, room):
    """Bound on the chance that any bin of a run adds to leakage; infinite where it is large.

    With x and y as of :func:`_all_beyond`, Q_1 is convex in x up to y - 2, as I_2(z) / I_1(z) is at
    least z / (2 + sqrt(z^2 + 4)); there each bin adds no more than in proportion to the largest of
    them, and that at most e^{-(b - a)^2 / 2}, of the e^-2 and more below 1 that noise alone leaves.
    """
    sigma, level, _ = noise
    magnitude, loud = room[0], room[3]
    for i in range(count):
        loud[i] = magnitude[i]
    for i in range(count):
        loud[i] = 0.0 if exempt[i] else loud[i]
    most = largest(loud[:count])
    if not most > 0.0:
        return 0.0
    a, b = most / sigma, level / sigma
    if a * a > b * b - 4.0:
        return np.inf
    share = dot(loud, loud, count) / (most * most)
    return 1.2 * share * math.exp(-0.5 * (b - a) * (b - a))


@borrowing()
def _of_run(count, left, noise, kernel, room, exempt, series):
    """Leakage of a run of bins; 0 where it is sure to be no more than is ``left`` to leave out."""
    if left > 0.0 and _at_most(count, noise, exempt, room) <= left:
        return 0.0
    _chances(count, noise, kernel, room, exempt, series)
    return any_crossing(room[4], 0, count)


@borrowing()
def _chances(count, noise, kernel, room, exempt, series):
    """Added chances of a run of bins, into row 4."""
    sigma, level, _ = noise
    _half_squares(room[0, :count], exempt, 0.5 / (sigma * sigma), room[3])
    added_crossings(room[3], count, level / sigma, series, room[4])


@borrowing()
def _least_reach(total, spread, noise, crossing, kernel):
    """Bins beyond the near ones that the run has to take in: see the module."""
    sigma, level, _ = noise
    window_sum, envelope, reach, _ = kernel[2]
    half_size = kernel[0][0] // 2
    clearance = CLEARANCE + len(kernel[1][2])
    weight = total * window_sum
    at = np.searchsorted(reach, float(clearance))
    beside = envelope[min(at, envelope.size - 1)] * weight / sigma
    gentle = 4.0 + 1.5 * math.sqrt(beside * clearance * level / sigma)
    least = max(crossing, max(gentle, 0.75 * spread)) - clearance
    return int(min((max(math.ceil(least), 0.0) + 2 * APRON + 7) // 8 * 8, half_size))


@borrowing()
def _leakage(low, count, peak, field, noise, choices, kernel, room, exempt, series):
    """Leakage of the run and of all beyond it; False where the run is too short to tell."""
    sigma, level, _ = noise
    fft_size, half_size = kernel[0][0], kernel[0][0] // 2
    beta, scale = level / sigma, 0.5 / (sigma * sigma)
    magnitude, chance = room[0], room[4]
    _chances(count, noise, kernel, room, exempt, series)
    below, above = low > 0, low + count - 1 < half_size
    some = any_crossing(chance, APRON if below else 0, count - APRON if above else count)
    if not below and not above:
        return some, True
    tail, rest, points = 0.0, 0.0, 0
    for side in (-1, 1):
        if not (below if side < 0 else above):
            continue
        correction, last, steepness, found = _near_end(side, count, chance, exempt)
        if not found:
            return 0.0, False
        tail += correction
        rest += last
        points = _points_beyond(
            side, low, count, field[0], steepness, choices[1], kernel, room, points
        )
    while points % 8:  # whole vectors: what is left over costs as much as all of them
        room[9, points], room[10, points] = room[9, points - 1], 0.0
        points += 1
    far_field.points_to_bins(room[9, :points], room[10, :points], fft_size)
    largest_beyond = _far_chances(points, field, scale, beta, choices[0], kernel, room, series)
    tail += weighted_silence(chance[:points], room[10, :points])
    most = min(0.45 * beta * beta, magnitude[peak] * magnitude[peak] * scale)
    if not (largest_beyond <= most and rest <= SMOOTHNESS * (some + tail)):
        return 0.0, False
    return some - (1.0 - some) * math.expm1(-tail), True


@borrowing()
def _half_squares(magnitude, exempt, scale, x):
    """a^2/2 of bins; 0 of those that can't raise a false alarm."""
    for i in range(magnitude.size):
        x[i] = magnitude[i] * magnitude[i] * scale
    for i in range(magnitude.size):
        if exempt[i]:
            x[i] = 0.0


@borrowing()
def _near_end(side, count, chance, exempt):
    """Correction of an integral at its near end, its last term's size, -d ln f / dq; if there."""
    step = 1 if side > 0 else -1
    i = count - APRON - 1 if side > 0 else APRON  # the last bin before the integral
    for k in range(-2, 4):
        if exempt[i + k * step]:
            return 0.0, 0.0, 0.0, False
    before, after = silence(chance[i]), silence(chance[i + step])
    first = after - before
    middle = silence(chance[i + 2 * step]) - silence(chance[i - step])
    third = middle - 3.0 * first
    fifth = silence(chance[i + 3 * step]) - silence(chance[i - 2 * step])
    fifth += 10.0 * first - 5.0 * middle
    terms = first / 24.0, -17.0 / 5760.0 * third, 367.0 / 967680.0 * fifth
    last = max(abs(terms[2]), abs(terms[1]) / 30.0)  # the fifth may cross zero
    steepness = abs(first) / max(after, 1e-300)
    return terms[0] + terms[1] + terms[2], last, steepness, True


@borrowing()
def _points_beyond(side, low, count, centre, steepness, image, kernel, room, points):
    """Adds the points and weights of one side's integral to rows 9 and 10.

    With images the spectrum is even about DC and Nyquist; without, it goes on, and the integral
    out to half a bin beyond is corrected by the first difference there.
    """
    fft_size, half_size, tangent = kernel[0][0], kernel[0][0] // 2, kernel[4]
    odd = 2 * half_size != fft_size
    if side < 0:
        last, far_bin, half = centre - low - APRON, 0, False
    else:
        last, far_bin, half = low + count - 1 - APRON - centre, half_size, odd
    v, weight = room[9], room[10]
    last_bin = abs(far_bin - centre)
    goes_on = not image and last_bin < half_size
    half = half or goes_on
    far = max(far_field.half_bin_cotangent(abs(far_bin - centre), half, fft_size, tangent), 1e-9)
    points = far_field.far_points(
        float(side), far_field.half_bin_cotangent(last, True, fft_size, tangent), far,
        steepness * (last + 0.5), v, weight, points,
    )  # fmt: skip
    bin_ = math.pi / fft_size
    if goes_on:
        for k in range(2):
            at = far_field.half_bin_cotangent(last_bin + k, False, fft_size, tangent)
            v[points] = side * at
            weight[points] = (1.0 - 2.0 * k) / 24.0 * bin_ * (1.0 + at * at)
            points += 1
    elif not half:  # the far end is a bin: half of it lies beyond the integral
        v[points] = side * far
        weight[points] = 0.5 * bin_ * (1.0 + far * far)
        points += 1
    return points


@borrowing()
def _far_chances(points, field, scale, beta, power, kernel, room, series):
    """Added chances at the points of the integrals, into row 4; the largest a^2/2 there."""
    _, _, _, edge_re, edge_im, _ = field
    t, re, im, x = room[9, :points], room[11, :points], room[12, :points], room[3]
    re[:] = edge_re
    im[:] = edge_im
    add_afar(t, False, field, power, kernel, room, re, im)
    add_afar(t, True, field, power, kernel, room, re, im)
    for i in range(points):
        square = re[i] if power else re[i] * re[i] + im[i] * im[i]
        x[i] = scale * (square if square > 0.0 else 0.0)
    largest_beyond = largest(x[:points])
    added_crossings(x, points, beta, series, room[4])
    return largest_beyond
