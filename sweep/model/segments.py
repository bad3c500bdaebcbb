"""The compiled loop over points: three segments each, from lines to detections."""

import math

import numpy as np
from numba import njit

from sweep.model.crossings import MOST_TERMS, crossing_series
from sweep.model.detection import assess
from sweep.model.elementary import borrowed
from sweep.model.equivalent import MOST_NODES, equivalent_lines
from sweep.model.far_field import MOST_POINTS
from sweep.model.leakage import DELTA, STRENGTH_IM, STRENGTH_RE, inspect, reach_of, smooth
from sweep.model.lines import segment_lines
from sweep.model.marcum import marcum_q1_pair
from sweep.model.spectrum import bin_magnitudes

SIGNS = (1.0, 0.0, -1.0)

ROOM = 22
"""Rows of scratch that :func:`segment_spectrum` and :func:`inspect_segment` need."""

SEGMENT_FIELDS = ("pd", "miss", "magnitude", "frequency", "exempted", "leakage")
"""Rows of the result: what is found in each segment's spectrum."""


@njit(cache=True, error_model="numpy")
def segment_spectrum(segment, p, footprint, row, level, power, kernel, room):
    """|X| of the bins in which a segment's lines stand above a level, into room's first row.

    Parameters
    ----------
    segment : int
        0 up, 1 Doppler, 2 down.
    p : (13,) float64
        The point's column of :meth:`sweep.model.shot.Shots.point_table`.
    footprint, row : tuple of (rows, beamlets) float64, int
        (R_b - R_0)/R_0, beta_b - beta_0 and relative beat amplitude of each beamlet; the point's
        row in them.
    level : float
        Bins in which lines stay below it, and their images too, may be left out; 0 keeps all.
    power : bool
        Whether beamlets add as powers.
    kernel : tuple
        :meth:`sweep.model.shot.Shots.kernel`.
    room : (ROOM, >= max(beamlets, MOST_NODES, N // 2 + 1)) float64
        Scratch; the result in row 0.

    Returns
    -------
    low, count : int
        First bin, number of bins.
    """
    sizes, shape, sidelobes, limits, tangent = kernel
    fft_size, length = sizes
    origin = _lines_of(segment, p, footprint, row, power, sizes, room[DELTA:])
    n = footprint[0].shape[1]
    delta, re, im = room[DELTA], room[STRENGTH_RE], room[STRENGTH_IM]
    few_delta, few_re, few_im = room[4], room[5], room[6]
    band = math.pi * length / fft_size * (2.0 if power else 1.0)
    few = equivalent_lines(
        delta, re, im, n, band, limits, few_delta, few_re, few_im, room[7:12]
    )  # fmt: skip
    low, high = _bins_above(
        level, few_delta, few_re, few_im, few, origin, power, sizes, sidelobes
    )  # fmt: skip
    bin_magnitudes(
        low, high, origin, few_delta, few_re, few_im, few, sizes, shape, power, tangent,
        room[0], room[1], room[7:10],
    )  # fmt: skip
    return low, high - low + 1


@njit(cache=True, error_model="numpy")
def _lines_of(segment, p, footprint, row, power, sizes, lines):
    """Lines of a segment as :mod:`sweep.model.spectrum` takes them, into (3, n); their origin."""
    offset, doppler, amplitude = footprint[0][row], footprint[1][row], footprint[2][row]
    origin = segment_lines(
        (SIGNS[segment], p[9] if segment == 2 else p[8]), (p[2], p[0], p[1], p[3]), (p[4], p[5]),
        (p[6], sizes[0], sizes[1], p[7]), offset, doppler, amplitude, lines[0], lines[1],
        lines[2], power,
    )  # fmt: skip
    return origin


@njit(cache=True, error_model="numpy")
def inspect_segment(
    segment, p, footprint, row, power, every_bin, kernel, room, exempt, series
):  # fmt: skip
    """What a segment's spectrum shows, without noise.

    Parameters
    ----------
    segment, p, footprint, row, power, kernel, room
        As of :func:`segment_spectrum`.
    every_bin : bool
        Look at each bin by itself where leakage could be summed as an integral.
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
        Of all bins; where the window has no closed form or the record is padded, or for
        ``every_bin``, of those above the leakage floor.
    """
    sigma, level, floor = p[10], p[11], p[12]
    if smooth(kernel) and not every_bin:
        origin = _lines_of(segment, p, footprint, row, power, kernel[0], room[DELTA:])
        low, count, peak, exempted, leakage = inspect(
            origin, footprint[0].shape[1], (sigma, level), power, kernel, room, exempt, series
        )
        if count:
            return low, count, peak, exempted, leakage
    low, count = segment_spectrum(segment, p, footprint, row, floor * sigma, power, kernel, room)
    peak, exempted, leakage = assess(room[0], count, sigma, level, floor, exempt)
    return low, count, peak, exempted, leakage


def workspace(beamlets: int, fft_size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scratch of :func:`inspect_segment`: room (ROOM, width), exempt (width,), series."""
    width = max(beamlets, MOST_NODES, fft_size // 2 + 1, 2 * MOST_POINTS) + 16
    return np.empty((ROOM, width)), np.empty(width, np.bool_), np.empty(MOST_TERMS)


@njit(cache=True, error_model="numpy")
def lent(footprint, kernel, work):
    """Footprint, kernel and workspace for the length of a call, their use uncounted."""
    offset, doppler, amplitude = footprint
    sizes, shape, sidelobes, limits, tangent = kernel
    coefficients, numerator, poles, edge, table = shape
    window_sum, envelope, reach = sidelobes
    room, exempt, series = work
    return (
        (borrowed(offset), borrowed(doppler), borrowed(amplitude)),
        (
            sizes,
            (coefficients, numerator, poles, edge, borrowed(table)),
            (window_sum, borrowed(envelope), borrowed(reach)),
            borrowed(limits),
            borrowed(tangent),
        ),
        (borrowed(room), borrowed(exempt), borrowed(series)),
    )


@njit(cache=True, error_model="numpy")
def _bins_above(level, delta, re, im, n, origin, power, sizes, sidelobes):
    """First and last bin, within 0..N/2, that n lines can lift above a level."""
    fft_size, length = sizes
    window_sum, envelope, reach = sidelobes
    total = 0.0
    lowest, highest = delta[0], delta[0]
    for j in range(n):
        total += abs(re[j]) if power else math.hypot(re[j], im[j])
        lowest, highest = min(lowest, delta[j]), max(highest, delta[j])
    total = math.sqrt(total) if power else total
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


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate_segments(points, row, footprint, segments, power, every_bin, kernel, work, out):
    """Every point's segments: detection probability, peak, exempt bins, leakage.

    Parameters
    ----------
    points : (13, n) float64
        :meth:`sweep.model.shot.Shots.point_table`.
    row : (n,) int64
        The point's row in the geometry.
    footprint : tuple of (rows, beamlets) float64
        As in :func:`segment_spectrum`.
    segments : (3,) bool
        Segments to evaluate.
    power, every_bin, kernel
        As in :func:`inspect_segment`.
    work : tuple
        :func:`workspace`.
    out : (3, 6, n) float64
        Result by segment and :data:`SEGMENT_FIELDS`; what is not evaluated is left as it is.
    """
    fft_size = kernel[0][0]
    footprint, kernel, (room, exempt, series) = lent(footprint, kernel, work)
    p = np.empty(points.shape[0])
    for i in range(points.shape[1]):
        p[:] = points[:, i]
        sigma, level = p[10], p[11]
        crossing_series(level / sigma, series)
        for s in range(3):
            if not segments[s]:
                continue
            low, _, peak, exempted, leakage = inspect_segment(
                s, p, footprint, row[i], power, every_bin, kernel, room, exempt, series
            )
            found, missed = marcum_q1_pair(room[0, peak] / sigma, level / sigma)
            out[s, 0, i] = found
            out[s, 1, i] = missed
            out[s, 2, i] = room[0, peak]
            out[s, 3, i] = (low + peak) * p[6] / fft_size
            out[s, 4, i] = exempted
            out[s, 5, i] = leakage
