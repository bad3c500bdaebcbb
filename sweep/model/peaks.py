"""Peaks of one segment in one draw: which groups are detected, where, and what false peak joins.

Two ways, as :mod:`sweep.model.returns` describes; both take their numbers from the addresses that
:mod:`sweep.model.draws` uses for the strongest group and for the false alarm.
"""

import math

import numpy as np
from numba import njit

from sweep.model import chances, philox
from sweep.model.groups import FIRST, LAST
from sweep.model.interpolation import noise_triple, sub_bin, sub_bin_error

WHOLE, FINE, ERROR, RATIO = range(4)
"""Fields of a peak: bin; position between bins and its standard error [bins]; |X| / sigma."""

FALSE, ABSENT = -1, -2
"""In place of a peak's group: a false peak; the Doppler peak of an architecture without one."""

STREAMS = np.array(
    [
        [
            philox.STREAM_DETECTION_UP,
            philox.STREAM_FALSE_ALARM_UP,
            philox.STREAM_NOISE_UP,
            philox.STREAM_NOISE_MAXIMUM_UP,
        ],
        [
            philox.STREAM_DETECTION_DOPPLER,
            philox.STREAM_FALSE_ALARM_DOPPLER,
            philox.STREAM_NOISE_DOPPLER,
            philox.STREAM_NOISE_MAXIMUM_DOPPLER,
        ],
        [
            philox.STREAM_DETECTION_DOWN,
            philox.STREAM_FALSE_ALARM_DOWN,
            philox.STREAM_NOISE_DOWN,
            philox.STREAM_NOISE_MAXIMUM_DOWN,
        ],
    ]
)
"""By segment (up, Doppler, down): detection, false alarm, noise, largest noise."""


@njit(cache=True, error_model="numpy")
def draw_by_chance(address, streams, listed, noise, others, alarm, tables, half, peaks, which):
    """Detections against pd and one false peak against its probability.

    Parameters
    ----------
    address : (uint64, uint64, int)
        Key of the point, number of the draw.
    streams : (4,) int
        A row of :data:`STREAMS`.
    listed : tuple
        (bins (3, most), pd (most,), magnitudes (most, 3)) of the segment's groups.
    noise : (float, float, float)
        sigma per quadrature; over it, the threshold and the noise of bins that hold lines.
    others, alarm : float
        Bins of noise alone; probability of a false alarm, by noise or leaked signal.
    tables : tuple
        :class:`sweep.model.interpolation.Interpolator`.
    half : int
        N/2.
    peaks, which : (most + 1, 4) float64, (most + 1,) int64
        Result: peaks by their fields, and their groups.

    Returns
    -------
    int
        Number of peaks.
    """
    a, b, draw = address
    bins, pd, magnitudes = listed
    sigma, beta, under_lines = noise
    count = 0
    for g in range(pd.size):
        if bins[0, g] < 0:
            break
        if philox.uniform(a, b, draw, streams[0], g) < pd[g]:
            m = magnitudes[g]
            delta, ratio = sub_bin(m[0], m[1], m[2], tables), m[1] / sigma
            error = sub_bin_error(delta, ratio / under_lines, tables)
            normal, _ = philox.normal_pair(a, b, draw, streams[2], g)
            fine = bins[0, g] + delta + error * normal
            _put(peaks[count], bins[0, g], fine, error, ratio, half)
            which[count] = g
            count += 1
    chance = philox.uniform(a, b, draw, streams[1], 0)
    if chance < alarm:
        place = _free_bin(philox.uniform(a, b, draw, streams[1], 1), bins, half)
        ratio = max(_largest(chance, others), beta)
        count = _put_false(peaks, which, count, place, ratio, tables, half)
    return count


@njit(cache=True, error_model="numpy")
def alarm_chance(beta, others, leakage):
    """Probability of a false alarm: one of ``others`` bins of noise, or leaked signal."""
    quiet = chances.at_least_one_scalar(math.exp(-0.5 * beta * beta), max(others, 0.0))
    return 1.0 - (1.0 - quiet) * (1.0 - leakage)


@njit(cache=True, error_model="numpy")
def draw_in_noise(
    address, streams, listed, noise, others, run, tables, half, peaks, which
):  # fmt: skip
    """Noise added to the bins that hold signal; the largest of all others by its order statistic.

    Parameters as of :func:`draw_by_chance`, but ``run``: (first bin, |X| / sigma of the bins from
    there on, which of them are exempt, level under which a bin counts as noise alone).
    """
    a, b, draw = address
    bins, pd, magnitudes = listed
    beta = noise[1]
    low = run[0]
    count = 0
    for g in range(pd.size):
        if bins[0, g] < 0:
            break
        if _look(address, streams[2], bins[0, g], low, magnitudes[g], noise, tables, half,
                 peaks[count]):  # fmt: skip
            which[count] = g
            count += 1
    place, ratio, others = _look_aside(address, streams[2], run, beta, others)
    chance = philox.uniform(a, b, draw, streams[3], 0)
    if chance < chances.at_least_one_scalar(math.exp(-0.5 * beta * beta), others):
        largest = max(_largest(chance, others), beta)
        if largest > ratio:
            place = _free_bin(philox.uniform(a, b, draw, streams[3], 1), bins, half)
            ratio = largest
    if place >= 0:
        count = _put_false(peaks, which, count, place, ratio, tables, half)
    return count


@njit(cache=True, error_model="numpy")
def _look(address, stream, centre, low, magnitudes, noise, tables, half, peak):
    """Whether the strongest bin crosses with its noise; the peak of three bins as it is found."""
    a, b, draw = address
    sigma, beta, under_lines = noise
    k = centre - low
    re, im = philox.normal_pair(a, b, draw, stream, k)
    re, im = re * under_lines, im * under_lines
    m0 = magnitudes[1] / sigma
    if (m0 + re) ** 2 + im**2 < beta * beta:
        return False
    # neighbours are exempt from false alarms, so their bins' own numbers are free
    re_below, im_below = philox.normal_pair(a, b, draw, stream, k - 1 if k > 0 else k + 2)
    re_above, im_above = philox.normal_pair(a, b, draw, stream, k + 1)
    real = noise_triple(re, re_below * under_lines, re_above * under_lines, tables)
    imaginary = noise_triple(im, im_below * under_lines, im_above * under_lines, tables)
    below = math.hypot(magnitudes[0] / sigma + real[0], imaginary[0])
    middle = math.hypot(m0 + re, im)
    above = math.hypot(magnitudes[2] / sigma + real[2], imaginary[2])
    delta = sub_bin(below, middle, above, tables)
    shift = 0
    if max(below, above) > middle:
        shift = 1 if above > below else -1
    error = sub_bin_error(delta, middle / under_lines, tables)
    _put(peak, centre + shift, centre + delta, error, max(below, middle, above), half)
    return True


@njit(cache=True, error_model="numpy")
def _look_aside(address, stream, run, beta, others):
    """Largest crossing among the bins of leaked signal: (bin or -1, |X| / sigma, bins left)."""
    a, b, draw = address
    low, signals, exempt, floor = run
    place, largest = -1, beta
    for i in range(signals.size):
        if exempt[i] or signals[i] < floor:
            continue
        re, im = philox.normal_pair(a, b, draw, stream, i)
        ratio = math.hypot(signals[i] + re, im)
        if ratio >= largest:
            place, largest = low + i, ratio
        others -= 1.0
    return place, largest if place >= 0 else 0.0, max(others, 0.0)


@njit(cache=True, error_model="numpy")
def _put(peak, whole, fine, error, ratio, half):
    """A peak's fields, mirrored into 0..N/2 where it lies past DC or Nyquist."""
    whole, fine = abs(whole), abs(fine)
    peak[WHOLE] = 2 * half - whole if whole > half else whole
    peak[FINE] = 2 * half - fine if fine > half else fine
    peak[ERROR] = error
    peak[RATIO] = ratio


@njit(cache=True, error_model="numpy")
def _put_false(peaks, which, count, place, ratio, tables, half):
    """Adds a false peak, in the middle of its bin."""
    _put(peaks[count], place, place, sub_bin_error(0.0, ratio, tables), ratio, half)
    which[count] = FALSE
    return count + 1


@njit(cache=True, error_model="numpy")
def _largest(chance, number):
    """|X| / sigma that the largest of so many bins of noise exceeds with the given chance."""
    if not number > 0.0:
        return 0.0
    one = -math.expm1(math.log1p(-chance) / number)
    return math.sqrt(-2.0 * math.log(one))


@njit(cache=True, error_model="numpy")
def _free_bin(chance, bins, half):
    """Bin of 1..N/2 outside the groups and the bins beside them, uniformly by a chance."""
    free = half
    ends = _spans(bins, half)
    for g in range(ends.shape[0]):
        free -= ends[g, 1] - ends[g, 0]
    place = 1 + int(chance * free)
    for g in range(ends.shape[0]):
        if place >= ends[g, 0]:
            place += ends[g, 1] - ends[g, 0]
    return min(place, half)


@njit(cache=True, error_model="numpy")
def _spans(bins, half):
    """Sorted, disjoint stretches [first, end) of 1..N/2 that groups and their neighbours take."""
    spans = np.zeros((bins.shape[1], 2), np.int64)
    spans[:, :] = half + 1
    for g in range(bins.shape[1]):
        if bins[0, g] < 0:
            break
        spans[g, 0] = max(bins[FIRST, g] - 1, 1)
        spans[g, 1] = max(min(bins[LAST, g] + 2, half + 1), spans[g, 0])
    order = np.argsort(spans[:, 0])
    spans = spans[order]
    for g in range(1, spans.shape[0]):
        spans[g, 0] = max(spans[g, 0], spans[g - 1, 1])
        spans[g, 1] = max(spans[g, 1], spans[g, 0])
    return spans
