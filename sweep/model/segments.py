"""The compiled loop over points: three segments each, from lines to detections."""

import math

import numpy as np

from sweep.model.bundles import (
    DELTA,
    ROOM,
    STRENGTH_IM,
    STRENGTH_RE,
    WIDTH,
    as_lines,
    take_bundles,
)
from sweep.model.compiling import borrowing, inlined, owning
from sweep.model.crossings import MOST_TERMS, crossing_series, largest
from sweep.model.detection import assess, mark
from sweep.model.elementary import borrowed
from sweep.model.equivalent import MOST_NODES
from sweep.model.far_field import MOST_POINTS
from sweep.model.leakage import inspect
from sweep.model.lending import lend
from sweep.model.lines import folding, segment_lines
from sweep.model.marcum import marcum_q1_pair
from sweep.model.mode_bundles import take_modes
from sweep.model.modulation import is_whole, modulate, reduce_lines, take_few
from sweep.model.preparation import LINE_STEPS
from sweep.model.runs import detect, smooth
from sweep.model.single_bins import bins_above, extent_of, magnitudes_of, parts_at

SIGNS = (1.0, 0.0, -1.0)

LEAKING = (True, False, True)
"""Segments whose leakage is looked at: no output tells that of the Doppler segment, 0 here."""

SEGMENT_FIELDS = ("pd", "miss", "magnitude", "frequency", "exempted", "leakage")
"""Rows of the result: what is found in each segment's spectrum."""


@borrowing()
def segment_spectrum(segment, p, scene, at, level, choices, kernel, room):
    """|X| of the bins in which a segment's lines stand above a level, into room's first row.

    Parameters
    ----------
    segment : int
        0 up, 1 Doppler, 2 down.
    p : (16,) float64
        The point's column of :meth:`sweep.model.preparation.Shots.point_table`.
    scene, at : tuple, (int, int)
        Footprint, parts and shifts of :class:`sweep.model.modulation.Stretch`; the point's row in
        the first, and its place in the others.
    level : float
        Bins in which lines stay below it, and their images too, may be left out; 0 keeps all. If
        none is above it, bins that the largest is known to exceed are.
    choices : (bool, bool, bool, bool)
        :func:`sweep.model.modulation.choices`.
    kernel : tuple
        :meth:`sweep.model.preparation.Shots.kernel`.
    room : (ROOM, >= width of :func:`workspace`) float64
        Scratch; the result in row 0.

    Returns
    -------
    low, count : int
        First bin, number of bins.
    """
    power, image = choices[0], choices[1]
    origin, n, fold = _lines_of(segment, p, scene, at, power, True, kernel, room)
    few = reduce_lines(n, power, allowed(p), n - 1, kernel, room)
    split, further = parts_at(segment, at[1], fold, scene, power, kernel)
    reach = extent_of(at[1], few, split, further, scene[2], power, kernel, room)
    low, high = bins_above(level, reach, origin, kernel)
    while True:
        magnitudes_of(low, high, origin, few, at[1], fold, split, scene[2], choices, kernel, room)
        most = largest(room[0, : high - low + 1])
        if most >= level:
            break
        level = most
        first, last = bins_above(level * (0.5 if image else 1.0), reach, origin, kernel)
        if first >= low and last <= high:
            break
        low, high = min(low, first), max(high, last)
    return low, high - low + 1


@borrowing()
def allowed(p):
    """Error of a bin that one step of taking few lines for many may make, and the threshold."""
    return p[15] * p[10] / LINE_STEPS, p[11]


@borrowing()
def _lines_of(segment, p, scene, at, power, split, kernel, room):
    """Lines of a segment as :mod:`sweep.model.spectrum` takes them, into rows DELTA ..

    Those that add as amplitudes are replaced by their parts, if asked for. Returns their origin,
    their number, and -1 where they are seen as their images, else 1.
    """
    footprint, parts, shifts = scene[0], scene[1], scene[2]
    row, sizes = at[0], kernel[0]
    offset, doppler, amplitude = footprint[0][row], footprint[1][row], footprint[2][row]
    phase = footprint[3][segment, row]  # without phases a row of none
    which = SIGNS[segment], p[9] if segment == 2 else p[8]
    chirp, record = (p[2], p[0], p[1], p[3]), (p[6], sizes[0], sizes[1], p[7])
    origin = segment_lines(
        which, chirp, (p[4], p[5]), record, offset, doppler, amplitude, phase, room[DELTA],
        room[STRENGTH_RE], room[STRENGTH_IM], power,
    )  # fmt: skip
    n, fold = offset.size, 1.0
    if parts[0].size or shifts[0].size:
        fold = folding(which, chirp, record)
        if power or split:
            n = modulate(
                segment, at[1], n, fold, scene, power, allowed(p), kernel, room
            )  # fmt: skip
    return origin, n, fold


@borrowing()
def inspect_segment(segment, p, scene, at, choices, kernel, room, exempt, series):
    """What a segment's spectrum shows, without noise.

    Parameters
    ----------
    segment, p, scene, at, choices, kernel, room
        As of :func:`segment_spectrum`.
    exempt : (room's width,) bool
        Result: bins of the run that can't raise a false alarm.
    series : (MOST_TERMS,) float64
        :func:`sweep.model.crossings.crossing_series` of the threshold.

    Returns
    -------
    low, count : int
        Run of bins that holds every bin above the threshold and its neighbours; |X| in row 0.
    peak, exempted : int
        Index of the largest bin; number of exempt bins.
    leakage : float
        Of all bins; where the window has no closed form or the record is padded, where the
        spectrum is a mean of several, or for ``every_bin``, of those above the leakage floor.
        0 where leakage is left out.

    Notes
    -----
    Means of several spectra are those of amplitudes over shifts: their bins are looked at one by
    one. So are those of lines in parts that are too many or spread too wide for bundles.
    """
    power, _, leakage, every_bin = choices
    if smooth(kernel) and not every_bin and (power or not scene[2][0].size):
        origin, n, kind = _smooth_lines(segment, p, scene, at, power, kernel, room)
        count, chance = 0, 0.0
        if leakage and n:
            low, count, peak, exempted, chance = inspect(
                origin, n, kind, (p[10], p[11], p[14]), choices, kernel, room, exempt, series
            )
        elif n:
            low, count, peak, exempted = detect(
                origin, n, kind, p[11], choices, kernel, room, exempt
            )  # fmt: skip
        if count:
            return low, count, peak, exempted, chance
    return inspect_bins(segment, p, scene, at, choices, kernel, room, exempt)


@inlined()
def _smooth_lines(segment, p, scene, at, power, kernel, room):
    """As :func:`_lines_of`: origin, number, and of what kind they are (:func:`inspect`).

    Lines in parts that many points share are bundles. Those of a point by itself would not be
    worth its kernels: parts of amplitudes are lines of their own, and of powers there are none
    here, as where they are too many or spread too wide for bundles.
    """
    parts, own = scene[1], -1
    if parts[0].size and not is_whole(segment, at[1], scene, power):
        own = parts[4][at[1]]
    alone = own >= 0 and math.isnan(parts[5][segment, own])
    origin, n, fold = _lines_of(segment, p, scene, at, power, alone, kernel, room)
    if alone and power:
        if parts[3][segment, own] > 0:
            return origin, 0, as_lines()
        n, kind = take_modes(
            n, (segment, own, fold), parts[1], allowed(p), kernel, room
        )  # fmt: skip
        return origin, n, kind
    own = -1 if alone else own
    if own >= 0 or (n > 1 and p[15] > 0.0):
        n, kind = take_bundles(
            n, power, (segment, own, fold), parts, allowed(p), kernel, room
        )  # fmt: skip
        if own >= 0 or kind[0] >= 0:
            return origin, n, kind
    several = alone or (power and scene[2][0].size > 0)
    most = n - 1 if several else (n // 2 if p[15] > 0.0 else 0)
    if most > 0:
        n = take_few(n, power, allowed(p), most, kernel, room)
    return origin, n, as_lines()


@borrowing()
def inspect_bins(segment, p, scene, at, choices, kernel, room, exempt):
    """The same, bin by bin."""
    sigma, level, floor = p[10], p[11], p[12]
    if choices[2]:
        low, count = segment_spectrum(
            segment, p, scene, at, floor * sigma, choices, kernel, room
        )  # fmt: skip
        peak, exempted, leakage = assess(room[0], count, sigma, level, floor, exempt)
        return low, count, peak, exempted, leakage
    least = level * (0.5 if choices[1] else 1.0)
    low, count = segment_spectrum(segment, p, scene, at, least, choices, kernel, room)
    peak, exempted = mark(room[0], count, level, exempt)
    return low, count, peak, exempted, 0.0


def workspace(lines: int, fft_size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scratch of :func:`inspect_segment`: room (ROOM, width), exempt (width,), series.

    ``lines`` as of :class:`sweep.model.modulation.Stretch`.
    """
    width = max(lines, MOST_NODES, fft_size // 2 + 1, 2 * MOST_POINTS, WIDTH) + 16
    return np.empty((ROOM, width)), np.empty(width, np.bool_), np.empty(MOST_TERMS)


@borrowing()
def lent(scene, kernel, work):
    """Scene, kernel and workspace for the length of a call, their use uncounted."""
    (offset, doppler, amplitude, phase), parts, (shift, share) = scene
    apart, re, im, number, which, digest = parts
    sizes, shape, sidelobes, limits, tangent, known = kernel
    coefficients, numerator, poles, edge, table = shape
    window_sum, envelope, reach, beyond = sidelobes
    room, exempt, series = work
    return (
        (
            (borrowed(offset), borrowed(doppler), borrowed(amplitude), borrowed(phase)),
            (
                borrowed(apart),
                borrowed(re),
                borrowed(im),
                borrowed(number),
                borrowed(which),
                borrowed(digest),
            ),
            (borrowed(shift), borrowed(share)),
        ),
        (
            sizes,
            (coefficients, numerator, poles, edge, borrowed(table)),
            (window_sum, borrowed(envelope), borrowed(reach), borrowed(beyond)),
            borrowed(limits),
            borrowed(tangent),
            borrowed(known),
        ),
        (borrowed(room), borrowed(exempt), borrowed(series)),
    )


@owning(nogil=True)
def evaluate_segments(points, row, scene, segments, choices, kernel, work, out):
    """Every point's segments: detection probability, peak, exempt bins, leakage.

    Parameters
    ----------
    points, row, scene
        Of a :class:`sweep.model.modulation.Stretch` of m points.
    segments : (3,) bool
        Segments to evaluate.
    choices, kernel
        As in :func:`inspect_segment`.
    work : tuple
        :func:`workspace`.
    out : (3, 6, m) float64
        Result by segment and :data:`SEGMENT_FIELDS`; what is not evaluated is left as it is.
    """
    fft_size = kernel[0][0]
    seen, known, (room, exempt, series) = lent(scene, kernel, work)
    scene, kernel = lend(seen), lend(known)
    power, image, leakage_too, every_bin = choices
    p = np.empty(points.shape[0])
    before = -1.0
    for i in range(points.shape[1]):
        p[:] = points[:, i]
        sigma, level = p[10], p[11]
        if leakage_too and level / sigma != before:
            before = level / sigma
            crossing_series(before, series)
        for s in range(3):
            if not segments[s]:
                continue
            own = power, image, leakage_too and LEAKING[s], every_bin
            low, _, peak, exempted, leakage = inspect_segment(
                s, p, scene, (row[i], i), own, kernel, room, exempt, series
            )
            found, missed = marcum_q1_pair(room[0, peak] / p[13], level / p[13])
            out[s, 0, i] = found
            out[s, 1, i] = missed
            out[s, 2, i] = room[0, peak]
            out[s, 3, i] = (low + peak) * p[6] / fft_size
            out[s, 4, i] = exempted
            out[s, 5, i] = leakage
