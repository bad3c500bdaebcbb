"""Detection in one segment's spectrum: threshold, groups, what may raise a false alarm."""

import math

import numpy as np
from numba import njit

from sweep.model.marcum import marcum_q1_pair

RAYLEIGH_DEVIATION = math.sqrt(2 - math.pi / 2)
"""Standard deviation of |X| in a noise-only bin, in units of sigma (per quadrature)."""


def threshold(*, tnr: np.ndarray, bin_deviation: np.ndarray) -> np.ndarray:
    """Detection threshold on |X|: TNR standard deviations of a noise-only bin's magnitude.

    The only reading of [T]'s threshold-to-noise ratio that gives its Table 4.2 (PHYSICS section
    6): a noise-only bin crosses with probability exp(-(4 - pi)/4 TNR^2).
    """
    return tnr * bin_deviation * RAYLEIGH_DEVIATION


def quiet_below(*, chance: np.ndarray, level: np.ndarray, bins: int) -> np.ndarray:
    """Signal [sigma] below which bins may count as noise alone, at the price of a chance, (n,).

    With x = a^2/2 and y = b^2/2 a bin of a sigma leaks with no more than

        x y e^-y / (1 - e^-y) e^(a^2 b^2 / 8)

    (:mod:`sweep.model.leakage`), here with a b <= 1.

    Parameters
    ----------
    chance : (n,) ndarray
        Leakage of all those bins together that may be left out, 0..1.
    level : (n,) ndarray
        Threshold b over sigma, > 0.
    bins : int
        Number of bins.
    """
    y = 0.5 * np.square(level)
    with np.errstate(divide="ignore", over="ignore", under="ignore", invalid="ignore"):
        each = np.where(y > 0, y / np.expm1(y), 1.0)
        return np.minimum(np.sqrt(2 * chance / (bins * math.exp(1 / 8) * each)), 1 / level)


@njit(cache=True, error_model="numpy")
def mark(magnitude, count, level, exempt):
    """Detection in a run of bins, and the bins that it keeps from raising a false alarm.

    Adjacent bins at or above the threshold form a group; its largest bin is the detection. The
    bins of a group and the two beside it can't raise a false alarm, nor can the strongest bin
    and its neighbours, group or not.

    Parameters
    ----------
    magnitude : (>= count,) float64
        |X| of the bins, without noise.
    level : float
        Threshold.
    exempt : (>= count,) bool
        Result: bins that can't raise a false alarm.

    Returns
    -------
    peak, exempted : int
        Index of the largest bin; number of exempt bins.
    """
    largest, above = _survey(magnitude[:count], level)
    peak = 0
    while peak < count - 1 and magnitude[peak] < largest:
        peak += 1
    exempt[:count] = False
    first, last = peak, peak
    while first > 0 and magnitude[first - 1] >= level:
        first -= 1
    while last < count - 1 and magnitude[last + 1] >= level:
        last += 1
    exempted = _exempt(first, last, count, exempt)
    if above > last - first + 1:
        exempted = 0
        for i in range(count):
            if magnitude[i] >= level:
                _exempt(i, i, count, exempt)
        for i in range(count):
            exempted += exempt[i]
    return peak, exempted


@njit(cache=True, error_model="numpy")
def _survey(magnitude, level):
    """Largest magnitude, and how many reach a level."""
    largest, above = magnitude[0], 0
    for i in range(magnitude.size):
        largest = magnitude[i] if magnitude[i] > largest else largest
        above += magnitude[i] >= level
    return largest, above


@njit(cache=True, error_model="numpy")
def _exempt(first, last, count, exempt):
    """Marks the bins of a group and the two beside it; how many they are."""
    first, last = max(first - 1, 0), min(last + 1, count - 1)
    exempt[first : last + 1] = True
    return last - first + 1


@njit(cache=True, error_model="numpy")
def detect_rows(magnitude, first, bins, deviation, level, out):
    """Detections in spectra without noise that are given bin by bin.

    Parameters
    ----------
    magnitude : (m, count) float64
        |X| of runs of bins.
    first : (m,) int64
        Number of each run's first bin.
    bins : (int, float)
        Last bin of the spectrum, N/2, and bin width [Hz]; bins outside 0..N/2 are passed over.
    deviation, level : (m,) float64
        Noise per quadrature of bins that hold lines; threshold.
    out : (6, m) float64
        Result, by the names of :data:`sweep.model.segments.SEGMENT_FIELDS`; no leakage.
    """
    half, width = bins
    exempt = np.empty(magnitude.shape[1], np.bool_)
    for i in range(magnitude.shape[0]):
        low = max(-first[i], 0)
        high = min(half + 1 - first[i], magnitude.shape[1])
        run = magnitude[i, low:high]
        peak, exempted = mark(run, run.size, level[i], exempt)
        found, missed = marcum_q1_pair(run[peak] / deviation[i], level[i] / deviation[i])
        out[0, i], out[1, i], out[2, i] = found, missed, run[peak]
        out[3, i] = (first[i] + low + peak) * width
        out[4, i], out[5, i] = exempted, 0.0
