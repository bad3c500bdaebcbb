"""|X| of a run of bins around a segment's lines, and the detection in it.

For unpadded spectra of cosine-sum windows, whose far field is smooth: bins near the lines take
every line as it is, bins beside them few sources (:mod:`sweep.model.far_field`). Where leakage is
left out nothing is looked at but what lines can lift to the threshold, and what it takes to be
sure of the largest bin.
"""

import math

import numpy as np

from sweep.model import far_field
from sweep.model.bundles import (
    DELTA,
    STRENGTH_IM,
    STRENGTH_RE,
    add_forms_afar,
    add_near,
    forms_afar,
)
from sweep.model.compiling import borrowing, inlined
from sweep.model.detection import mark
from sweep.model.far_field import CLEARANCE, LARGEST_ANGLE, add_far_field, add_near_field
from sweep.model.kernel_rows import REACHES, ROWS
from sweep.model.mode_bundles import add_modes_near, modes_afar
from sweep.model.spectrum import set_tangents

SOURCES, IMAGES = 13, 16
"""First of three rows each that hold the sources of lines and of images."""


@inlined()
def smooth(kernel):
    """Whether spectra are smooth between lines: closed form of the window, no padding."""
    return kernel[1][4].size == 0 and kernel[0][0] == kernel[0][1]


@borrowing()
def reach_of(level, weights, envelope, reach):
    """Bins [of fs/L] beyond which lines of the given summed weight stay below ``level``."""
    if not weights > 0.0:
        return 1.0
    low, high = 0, envelope.size - 1
    if envelope[high] * weights > level:
        return np.inf
    while low < high:
        middle = (low + high) // 2
        if envelope[middle] * weights > level:
            low = middle + 1
        else:
            high = middle
    return reach[low]


@borrowing()
def detect(origin, n, kind, level, choices, kernel, room, exempt):
    """Run of bins and detection of a segment's lines, whatever leaks beside them.

    Parameters and results as of :func:`sweep.model.leakage.inspect`, without leakage; ``level`` is
    the threshold. The run ends where lines and images stay below it, and below the largest bin.
    """
    half_size = kernel[0][0] // 2
    power, image = choices[0], choices[1]
    total, lowest, highest = bundle(n, kind, power, room)
    spread = lowest, highest
    poles = len(kernel[1][2])
    clearance = CLEARANCE + poles + served_beside(kind, kernel)
    total = math.sqrt(total) if power else total
    afar = total if power else sum_afar(n, total, spread, poles, room)
    centre = seen_from(origin, spread, kernel[0][0])
    needed = _lifted(level, total, afar, highest - lowest, centre, image, kernel)
    while True:
        beyond = needed
        near, mirrored, fits = near_bins(
            origin, lowest, highest, min(beyond, clearance), image, kernel
        )
        if not fits:
            return 0, 0, 0, 0
        sources = beyond > clearance or (image and not mirrored)
        field = prepare_field(origin, n, kind, spread, sources, choices, kernel, room)
        low = max(near[0] - max(beyond - clearance, 0), 0)
        high = min(near[1] + max(beyond - clearance, 0), half_size)
        count = high - low + 1
        magnitudes(low, count, origin, n, near, mirrored, field, power, kernel, room)
        peak, exempted = mark(room[0], count, level, exempt)
        if room[0, peak] >= level or count == half_size + 1:
            return low, count, peak, exempted
        most = room[0, peak]
        needed = _lifted(most, total, afar, highest - lowest, centre, image, kernel)
        if needed <= beyond:
            return low, count, peak, exempted


@inlined()
def bundle(n, kind, power, room):
    """Turns lines into strengths, unless they are sources of bundles.

    Returns the sum of their magnitudes, for powers squared, and the range of positions.
    """
    if kind[0] >= 0:
        return kind[6]
    return far_field.strengths(
        room[DELTA], room[STRENGTH_RE], room[STRENGTH_IM], n, power, room[9]
    )  # fmt: skip


@inlined()
def served_beside(kind, kernel):
    """Bins beyond the clearance in which known kernels take less time than sources, of many."""
    return 0 if kind[1] < 2 else min(REACHES[1] // 4, kernel[0][0] // 128)


@inlined()
def _lifted(level, total, afar, spread, centre, image, kernel):
    """Bins beside the lines that they and their images may lift to a level."""
    poles, half_size = len(kernel[1][2]), kernel[0][0] // 2
    near = stays_below(level, total * kernel[2][0], spread, centre, image, kernel)
    clearance = CLEARANCE + poles
    if near > clearance:
        far = stays_below(level, afar * kernel[2][0], spread, centre, image, kernel)
        near = max(min(near, far), float(clearance))
    return math.ceil(min(max(near, poles + 2.0), float(half_size)))


@inlined()
def stays_below(level, weight, spread, centre, image, kernel):
    """Bins beyond which lines and images of a summed weight stay below a level.

    The envelope is of sin(pi y) K(y): K itself falls to it within a bin.
    """
    _, envelope, reach, _ = kernel[2]
    crossing = reach_of(0.9 * level, weight, envelope, reach)
    far = min(centre, kernel[0][0] // 2 - centre) - 0.5 * spread - 1.0
    if image and far < 32.0 * crossing:  # else images add less than a tenth
        crossing = reach_of(0.5 * level, weight, envelope, reach)
    return crossing + 1.5


@borrowing()
def sum_afar(n, total, spread, poles, room):
    """Bound on the magnitude of n strengths' sum as it is seen from afar, in rows DELTA ..

    Over that of the kernel at the nearest end of their ``spread``, from the clearance on. With x
    the lines' places over half of it, and h that half over the distance of the kernel's nearest
    pole, Taylor's series about the middle has, for P = 2 poles,

        |sum s| + sum_j (P + j over j) h^j |sum s x^j|,  j = 1..3

    and, with h as the lines next to a bin have it, (P + 4 over 4) h^4 sum |s| x^4 for the rest: a
    kernel's j-th derivative is at most j! (P + j over j) of itself over the distance's j-th power.
    Never more than ``total``, the sum of the magnitudes.
    """
    half, middle = 0.5 * (spread[1] - spread[0]), 0.5 * (spread[0] + spread[1])
    inverse = 1.0 / half if half > 0.0 else 0.0
    delta, re, im = room[DELTA], room[STRENGTH_RE], room[STRENGTH_IM]
    re_0, re_1, re_2, re_3 = 0.0, 0.0, 0.0, 0.0
    im_0, im_1, im_2, im_3, rest = 0.0, 0.0, 0.0, 0.0, 0.0
    for b in range(n):
        x = (delta[b] - middle) * inverse
        square = x * x
        re_0 += re[b]
        im_0 += im[b]
        re_1 += x * re[b]
        im_1 += x * im[b]
        re_2 += square * re[b]
        im_2 += square * im[b]
        re_3 += square * x * re[b]
        im_3 += square * x * im[b]
        rest += square * square * math.sqrt(re[b] * re[b] + im[b] * im[b])
    share, nearest, order = half / (CLEARANCE + half), half / CLEARANCE, 2 * poles
    first = order + 1.0
    second = first * (order + 2) / 2
    third = second * (order + 3) / 3
    found = math.hypot(re_0, im_0) + third * (order + 4) / 4 * nearest**4 * rest
    found += share * first * math.hypot(re_1, im_1)
    found += share * share * second * math.hypot(re_2, im_2)
    found += share * share * share * third * math.hypot(re_3, im_3)
    return min(total, found)


@borrowing()
def seen_from(origin, spread, fft_size):
    """Bin in the middle of where a bundle of lines is seen, 0..N/2."""
    centre = abs(origin + math.floor(0.5 * (spread[0] + spread[1]) + 0.5))
    return fft_size - centre if centre > fft_size // 2 else centre


@inlined()
def near_bins(origin, lowest, highest, apart, image, kernel):
    """First and last bin ``apart`` from a line; whether images are near; whether angles small."""
    fft_size = kernel[0][0]
    half_size = fft_size // 2
    clearance = CLEARANCE + len(kernel[1][2])
    low = origin + math.floor(lowest) - apart
    high = origin + math.ceil(highest) + apart
    # Lines beyond DC or Nyquist are seen as their images, which fold back into the band.
    if low < 0:
        high = max(high, -low)
    if high > half_size:
        low = min(low, fft_size - high)
    low, high = max(low, 0), min(high, half_size)
    below, above = low + origin + lowest, fft_size - high - origin - highest
    mirrored = image and min(below, above) < clearance
    farthest = max(high - origin - lowest, origin + highest - low)
    if mirrored:
        sum_, other = high + origin + highest, fft_size - low - origin - lowest
        farthest = max(farthest, sum_ if below < above else other)
    fits = (farthest + clearance) * math.pi < LARGEST_ANGLE * fft_size
    return (low, high), mirrored, fits


@borrowing()
def prepare_field(origin, n, kind, spread, sources, choices, kernel, room):
    """What the far field needs.

    Bin that distances count from; number of sources of the lines and of their images; what the
    window's first sample adds to every bin, real and imaginary; of what kind they are. Without
    ``sources`` there are none: all that matters is near.
    """
    power, image = choices[0], choices[1]
    fft_size, poles, edge = kernel[0][0], len(kernel[1][2]), kernel[1][3]
    delta, re, im = room[DELTA], room[STRENGTH_RE], room[STRENGTH_IM]
    centre = seen_from(origin, spread, fft_size)
    lines, images = 0, 0
    if kind[5]:
        if kind[0] >= ROWS:
            constant = modes_afar(kind, sources, kernel, room)
        else:
            constant = forms_afar(kind, sources, kernel, room)
        if sources:
            lines, images = n, n if image else 0
            far_field.seen_at(
                delta, n, centre, centre - origin, fft_size, kernel[4], room[SOURCES], room[IMAGES]
            )  # fmt: skip
        return centre, lines, images, constant * (2.0 if image else 1.0), 0.0, kind
    if sources:
        lines, images = far_field.far_sources(
            delta, re, im, n, spread, centre, centre - origin, fft_size, poles, power, kernel[4],
            room[SOURCES:], room[5:11],
        )  # fmt: skip
    edge_re, edge_im = far_field.edge_field(re if power else im, n, edge, power), 0.0
    if not image:  # else the imaginary parts of line and image cancel
        images, edge_re = 0, 0.5 * edge_re
        edge_im = 0.0 if power else -0.5 * far_field.edge_field(re, n, edge, False)
    return centre, lines, images, edge_re, edge_im, kind


@borrowing()
def magnitudes(low, count, origin, n, near, mirrored, field, power, kernel, room):
    """|X| of a run of bins into row 0: all lines where they are near, few sources elsewhere."""
    fft_size, half_size = kernel[0][0], kernel[0][0] // 2
    centre, _, _, edge_re, edge_im, _ = field
    re, im, t = room[0, :count], room[1, :count], room[2, :count]
    re[:] = edge_re
    im[:] = edge_im
    first, last = near[0] - low, near[1] - low + 1
    if field[1]:
        set_tangents(low - centre, count, fft_size, kernel[4], t)
    for start, end in ((0, first), (last, count)):
        if start < end:
            at, part_re, part_im = t[start:end], re[start:end], im[start:end]
            add_afar(at, False, field, power, kernel, room, part_re, part_im)
            if mirrored:
                add_afar(at, True, field, power, kernel, room, part_re, part_im)
    if not mirrored and field[2]:
        add_afar(t, True, field, power, kernel, room, re, im)
    near_re, near_im = re[first:last], im[first:last]
    _add_beside(near[0] - origin, DELTA, n, False, field, power, kernel, room, near_re, near_im)
    if mirrored:
        for b in range(n):
            room[7, b] = -room[DELTA, b]
        first_bin = near[0] + origin - (fft_size if 2 * near[0] > half_size else 0)
        _add_beside(first_bin, 7, n, True, field, power, kernel, room, near_re, near_im)
    for i in range(count):
        square = re[i] if power else re[i] * re[i] + im[i] * im[i]
        re[i] = math.sqrt(square if square > 0.0 else 0.0)


@borrowing()
def add_afar(t, image, field, power, kernel, room, re, im):
    """Adds what lines, or their images, hold in bins far from them; t is tan(pi q / N) there."""
    _, numerator, poles, _, _ = kernel[1]
    _, lines, images, _, _, kind = field
    row, used = (IMAGES, images) if image else (SOURCES, lines)
    if kind[5]:
        side = -1.0 if image else 1.0
        add_forms_afar(t, room[row], used, kind, numerator, poles, side, room, re)
    else:
        add_far_field(t, room[row : row + 3], used, numerator, poles, power, re, im)


@borrowing()
def _add_beside(first, row, n, image, field, power, kernel, room, re, im):
    """The same in bins first, first + 1 .. next to n lines, or images, with their places in row."""
    if field[5][0] >= ROWS:
        add_modes_near(first, image, field[5], kernel, room, re)
        return
    if field[5][0] >= 0:
        add_near(first, image, field[5], power, kernel, room, re, im)
        return
    coefficients, fft_size = kernel[1][0], kernel[0][0]
    add_near_field(
        first, room[row], room[STRENGTH_RE], room[STRENGTH_IM], n, image, fft_size, coefficients,
        power, room[5:7], re, im,
    )  # fmt: skip
