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
def mark(magnitude, count, level, exempt, beside):
    """Detection in a run of bins, and the bins that it keeps from raising a false alarm.

    Adjacent bins at or above the threshold form a group; its largest bin is the detection. The
    bins of a group and the two beside it can't raise a false alarm, nor can the strongest bin
    and its neighbours, group or not. Where any bin of the echo detects, all those can't that are
    within a main lobe of one that has half of the largest magnitude.

    Parameters
    ----------
    magnitude : (>= count,) float64
        |X| of the bins, without noise.
    level : float
        Threshold.
    exempt : (>= count,) bool
        Result: bins that can't raise a false alarm.
    beside : int
        Half of a main lobe [bins] where any bin of the echo detects, else 0.

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
    if beside > 0:
        for i in range(count):
            if i == peak or (magnitude[i] >= 0.5 * largest and largest > 0.0):
                exempt[max(i - beside, 0) : min(i + beside + 1, count)] = True
    first, last = peak, peak
    while first > 0 and magnitude[first - 1] >= level:
        first -= 1
    while last < count - 1 and magnitude[last + 1] >= level:
        last += 1
    exempted = _exempt(first, last, count, exempt)
    if above > last - first + 1 or beside > 0:
        exempted = 0
        for i in range(count):
            if magnitude[i] >= level:
                _exempt(i, i, count, exempt)
        for i in range(count):
            exempted += exempt[i]
    return peak, exempted


@njit(cache=True, error_model="numpy")
def is_end(bin_, ends):
    """Whether a bin is DC or Nyquist, where noise is real; ``ends`` is N, or 0 where none is."""
    return ends > 0 and (bin_ == 0 or 2 * bin_ == ends)


@njit(cache=True, error_model="numpy")
def crossing_pair(a, b, real):
    """Chances that a bin of signal a [sigma] reaches a threshold b, and that it does not.

    Q_1(a, b) and its complement. Where the noise is real it has the power of both quadratures in
    one, a variance of 2 sigma^2: |a + n| >= b.
    """
    if not real:
        return marcum_q1_pair(a, b)
    above = 0.5 * (math.erfc(0.5 * (b - a)) + math.erfc(0.5 * (b + a)))
    if a < b:
        return above, 0.5 * (math.erf(0.5 * (b - a)) + math.erf(0.5 * (b + a)))
    return above, 0.5 * (math.erfc(0.5 * (a - b)) - math.erfc(0.5 * (a + b)))


@njit(cache=True, error_model="numpy")
def found_pair(magnitude, echo, peak, low, rule, levels):
    """Chances that an echo is detected, and that it is missed.

    By any of its bins (:func:`any_pair`), or by the peak of a run alone where half of a main lobe
    is 0. ``rule`` is :attr:`sweep.model.preparation.Shots.echo_rule`; ``levels`` are the noise per
    quadrature and the threshold.
    """
    (ends, beside, pairs), (deviation, level) = rule, levels
    if beside > 0:
        return any_pair(magnitude, echo, low, ends, deviation, level, pairs)
    real = is_end(low + peak, ends)
    return crossing_pair(magnitude[peak] / deviation, level / deviation, real)


@njit(cache=True, error_model="numpy")
def any_pair(magnitude, echo, low, ends, deviation, level, pairs):
    """Chances that any bin of an echo reaches the threshold, and that none does.

    Each bin by itself crosses with :func:`crossing_pair`. Neighbours' noise is correlated, and in
    phase with a signal that is in step from bin to bin, as in a line's main lobe: of each pair
    the joint chance is that of normal numbers with the bins' own chances, which add

        1 / (2 pi) int_0^{asin rho} exp(-(s^2 + t^2 - 2 s t sin u) / (2 cos^2 u)) du

    to the product [Owen, Ann. Math. Statist. 27, 1956]; bins are a Markov chain of first order.

    Parameters
    ----------
    magnitude, echo : (m,) float64, (m,) bool
        |X| of a run of bins; those that are of the echo.
    low, ends : int
        First bin; N where noise at DC and Nyquist is real, else 0.
    deviation, level : float
        Noise per quadrature; threshold.
    pairs : (3, k) float64
        :func:`sweep.model.alarms.pair_nodes`; k is 0 where bins are taken as independent.
    """
    found, missed, before, t_before = 0.0, 1.0, -1.0, 0.0
    for i in range(magnitude.size):
        if not echo[i]:
            before = -1.0
            continue
        real = is_end(low + i, ends)
        crosses, stays = crossing_pair(magnitude[i] / deviation, level / deviation, real)
        if not stays > 0.0:
            return 1.0, 0.0
        t = _deviate(crosses) if crosses < stays else -_deviate(stays)
        chance, rest = crosses, stays
        if before > 0.0:
            joint = 0.0
            for k in range(pairs.shape[1]):
                square = t * t + t_before * t_before - 2.0 * t * t_before * pairs[0, k]
                joint += pairs[1, k] * math.exp(-square * pairs[2, k])
            joint = min(joint / before, crosses)
            chance, rest = crosses - joint, stays + joint
        found += missed * chance
        missed *= rest
        before, t_before = stays, t
    return (found if found < 0.5 else 1.0 - missed), missed


@njit(cache=True, error_model="numpy")
def _deviate(chance):
    """Normal deviate that is exceeded with a chance of at most 1/2; to some 1e-4."""
    if chance < 1e-300:
        return 37.0
    s = math.sqrt(-2.0 * math.log(chance))
    t = s - (2.30753 + 0.27061 * s) / (1.0 + s * (0.99229 + 0.04481 * s))
    tail = 0.5 * math.erfc(t * math.sqrt(0.5))
    slope = math.exp(-0.5 * t * t) / math.sqrt(2.0 * math.pi)
    return t + math.log(tail / chance) * tail / slope


@njit(cache=True, error_model="numpy")
def echo_of(magnitude, first, last, level, beside):
    """First and last bin of the echo about a group of bins first .. last of a run.

    Those of half the group's largest magnitude that join on to it, and a main lobe on either side;
    the group itself where ``beside`` is 0.
    """
    if beside == 0:
        return first, last
    floor = 0.5 * magnitude[first : last + 1].max()
    while first > 0 and floor <= magnitude[first - 1] < level:
        first -= 1
    while last < magnitude.size - 1 and floor <= magnitude[last + 1] < level:
        last += 1
    return max(first - beside, 0), min(last + beside, magnitude.size - 1)


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
def detect_rows(magnitude, first, bins, rule, deviation, level, out):
    """Detections in spectra without noise that are given bin by bin.

    Parameters
    ----------
    magnitude : (m, count) float64
        |X| of runs of bins.
    first : (m,) int64
        Number of each run's first bin.
    bins : (int, float)
        Last bin of the spectrum, N/2, and bin width [Hz]; bins outside 0..N/2 are passed over.
    rule : (int, int, (3, k) float64)
        :attr:`sweep.model.preparation.Shots.echo_rule`.
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
        peak, exempted = mark(run, run.size, level[i], exempt, rule[1])
        found, missed = found_pair(
            run, exempt[: run.size], peak, first[i] + low, rule, (deviation[i], level[i])
        )
        out[0, i], out[1, i], out[2, i] = found, missed, run[peak]
        out[3, i] = (first[i] + low + peak) * width
        out[4, i], out[5, i] = exempted, 0.0
