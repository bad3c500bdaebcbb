"""Probabilities that bins cross the threshold: Marcum's Q of one bin, and at least one among many.

``Q1(a, b)`` is the probability that a Rice-distributed magnitude of amplitude ``a`` (in units of
the noise per quadrature) exceeds ``b``: the detection probability [T 3.3]; ``Q1(0, b)`` is the
false alarm probability [T 3.4]. The smaller tail is computed as a sum of positive terms, and the
other as its complement, so neither loses precision.

Below ``ab = 30`` the series of Bessel functions is summed by backward recurrence (Miller). Above,
the integral over the imaginary axis is summed by the midpoint rule, with a correction by the
residue of its pole. Arguments are (a, b) and not their squares, whose difference would lose
precision when both are large.

The probability of a false alarm in 1e5 bins [T 3.7] is needed for probabilities per bin of 1e-21 or
1e-2000. ``1 - (1-p)^n`` is 0 below p = 1e-16, and float64 ends at 1e-308. Hence log1p and expm1 are
used for probabilities, and another form takes and returns natural logarithms.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.kernel_cache import njit
from sweep.model.elementary_functions import exact_product

_SERIES_PRODUCT_MAX = 30.0
"""Largest product of signal a and threshold b, over the noise per quadrature, for which Marcum's
Q_1(a, b) is computed as a series of Bessel functions."""
_MIDPOINT_STEP = 0.7
"""Step h of the midpoint rule by which the tail integral of Marcum's Q is computed. The relative
error is exp(-(2 pi / h)^2 / 2) = 3e-18."""

_SQUARED_MIDPOINT_NODES = tuple((_MIDPOINT_STEP * (k + 0.5)) ** 2 for k in range(13))
_MIDPOINT_WEIGHTS = tuple(
    _MIDPOINT_STEP / math.pi * math.exp(-0.5 * v) for v in _SQUARED_MIDPOINT_NODES
)
_POLE_CORRECTION_DECAY_RATE = 2.0 * math.pi / _MIDPOINT_STEP
"""Decay rate c of the midpoint rule's correction for the pole of the integrand of Marcum's Q_1(a,
b). At the distance d = |a - b| the correction is 1 / (1 + exp(c d)). It is neglected for d >= c."""

_SQUARED_DISTANCE_MAX = 1500.0
"""Limit of (a - b)^2 above which the smaller tail of Marcum's Q_1(a, b) is 0 in float64. The tail
is about exp(-(a - b)^2 / 2)."""

_EXCESS_SERIES_TERMS_MAX = 24
"""Largest number of terms of the series in :func:`marcum_q1_excess`."""
# 1/(m+1) and 1/m^2 by m, so that no step of the series divides.
_INVERSE_NEXT_INTEGERS = tuple(1.0 / (m + 1) for m in range(_EXCESS_SERIES_TERMS_MAX + 1))
_INVERSE_SQUARES = (0.0, *(1.0 / m**2 for m in range(1, _EXCESS_SERIES_TERMS_MAX + 1)))

_LN2 = math.log(2.0)
_LOG_P_LINEAR_MAX = -600.0
"""Value of ln p, for the success probability p of a trial, below which 1-(1-p)^n and n p are the
same float64 number for any number of trials n up to 1e240."""


class Tails(NamedTuple):
    """Probabilities that a magnitude |X| is above and below a threshold; their sum is 1.

    Both are precise where they are small.
    """

    above: float
    """Probability that |X| is at or above the threshold, 0..1."""
    below: float
    """Probability that |X| is below the threshold, 0..1."""


class RiceTails(NamedTuple):
    """Both tails of the Rice distribution of a magnitude in noise, arrays of one shape."""

    q: np.ndarray
    """Marcum's Q1(a, b), the probability, 0..1, that a magnitude of amplitude a exceeds b."""
    p: np.ndarray
    """Probability 1 - Q1(a, b), 0..1, that the magnitude does not exceed b. It is precise where Q1
    is near 1."""


def marcum_q1(a: ArrayLike, b: ArrayLike) -> RiceTails:
    """Compute the first-order Marcum Q function and its complement [T 3.3].

    Parameters
    ----------
    a, b
        Signal and threshold over the noise per quadrature, >= 0.

    Returns
    -------
    RiceTails
        Of the broadcast shape; nan outside the domain and where both arguments are infinite. The
        relative error is at most 2e-15 for results above float64's smallest normal number.
    """
    a, b = np.broadcast_arrays(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
    tails = np.empty((2, a.size))
    _fill_tails(a.ravel(), b.ravel(), *tails)
    return RiceTails(*tails.reshape(2, *a.shape))


@njit(cache=True, error_model="numpy")
def _fill_tails(a, b, q, p):
    """Fill ``q`` and ``p`` (n,) with Q1(a, b) and 1 - Q1(a, b) for n pairs of arguments."""
    for i in range(a.size):
        tails = marcum_q1_tails(a[i], b[i])
        q[i], p[i] = tails.above, tails.below


@njit(cache=True, error_model="numpy")
def marcum_q1_tails(a, b):
    """Return Q1(a, b) and 1 - Q1(a, b) of one pair of arguments as :class:`Tails`.

    Parameters
    ----------
    a, b
        Signal and threshold over the noise per quadrature, >= 0. The result is nan outside the
        domain.

    Notes
    -----
    The tail that is computed is Q1 if b >= a, else 1 - Q1. Below b = 1.2, where Q1 is near 1 for
    any a, it is always 1 - Q1. Its factor exp(-(a - b)^2 / 2) is computed in double-double
    arithmetic.

    For ab < 30, Q1 = exp(-(a^2+b^2)/2) sum_{k>=0} (a/b)^k I_k(ab), and 1 - Q1 is the same sum from
    k = 1 with a and b exchanged. The recurrence N_k = 2k N_{k+1} + (ab)^2 N_{k+2}, started at k = K
    from (1, 0), gives I_k / I_0 = (ab)^k N_{k+1} / N_1. The scale follows from exp(ab) = I_0 + 2
    sum I_k.

    Elsewhere, with d = |a - b| and the step h, the tail is

        h/pi sum_k exp(-v/2) (b d +- v/2) / ((d^2 + v) sqrt(ab - v/4)),    v = (h (k + 1/2))^2,

    with + for Q1. It is written in ratios of a and b so that it cannot overflow.
    """
    if not (a >= 0.0 and b >= 0.0) or (math.isinf(a) and math.isinf(b)):
        return Tails(math.nan, math.nan)
    d, is_p = abs(a - b), b < a
    if b == 0.0 or d * d > _SQUARED_DISTANCE_MAX:
        return Tails(1.0, 0.0) if b == 0.0 or is_p else Tails(0.0, 1.0)
    high = 0.5 * d * d
    low = exact_product(0.5 * d, d)[1] + d * ((max(a, b) - d) - min(a, b))
    decay = math.exp(-high)
    decay -= decay * low
    if a * b < _SERIES_PRODUCT_MAX:
        is_p = is_p or b < 1.2
        x, ratio_square = a * b, (b * b if is_p else a * a)
        product_square = x * x
        n, previous_n, total, exponential = 1.0, 0.0, 0.0, 0.0
        for k in range(min(int(7.0 + 9.0 * math.sqrt(max(x, ratio_square))), 52), 0, -1):
            total = ratio_square * total + n
            exponential = x * exponential + n
            n, previous_n = (2.0 * k * n + product_square * previous_n), n
        norm = 1.0 / (2.0 * x * exponential + n)
        # One b multiplies last: a tiny one would underflow when squared.
        tail = (
            b * (b * (total * norm) * decay) if is_p else (ratio_square * total + n) * norm * decay
        )
    else:
        shift, half_step = d * math.sqrt(b / a), 0.5 / (math.sqrt(a) * math.sqrt(b))
        if is_p:
            half_step = -half_step
        quarter, d_square, total = 0.25 / (a * b), d * d, 0.0
        for k in range(12, -1, -1):
            v = _SQUARED_MIDPOINT_NODES[k]
            total += (_MIDPOINT_WEIGHTS[k] * (shift + half_step * v)) / (
                (d_square + v) * math.sqrt(1.0 - quarter * v)
            )
        pole = (
            1.0 / (1.0 + math.exp(_POLE_CORRECTION_DECAY_RATE * d))
            if d < _POLE_CORRECTION_DECAY_RATE
            else 0.0
        )
        tail = total * decay + pole
    return Tails(1.0 - tail, tail) if is_p else Tails(tail, 1.0 - tail)


@njit(cache=True, error_model="numpy")
def marcum_q1_excess(a, b):
    """Return the crossing probability that a bin's signal adds to noise, Q1(a, b) - Q1(0, b).

    Parameters
    ----------
    a, b
        Signal and threshold over the noise per quadrature, >= 0. The result is nan outside the
        domain. Its relative error is at most 2e-15.

    Notes
    -----
    For weak signals (a <= 2 and ab <= 8), with x = a^2/2, y = b^2/2 and Kummer's function M, the
    result is

        exp(-x-y) sum_{m>=1} (x y)^m / m!^2  M(1, m+1, x),

    from dQ1/da = b exp(-x-y) I1(ab). All terms are positive, so the result is precise down to
    ``exp(-y) x y`` for a -> 0. Elsewhere it is a difference of tails that loses at most two bits.
    """
    if not (a >= 0.0 and b >= 0.0):
        return math.nan
    x = 0.5 * a * a
    w = 0.25 * (a * b) * (a * b)
    high = 0.5 * b * b
    low = exact_product(0.5 * b, b)[1] if high < 1e3 else 0.0
    if x <= 2.0 and w <= 16.0:
        terms = _EXCESS_SERIES_TERMS_MAX
        if x <= 1e-2 and w <= 2.6e-2:
            terms = 6
        elif x <= 0.125 and w <= 0.7:
            terms = 10
        elif x <= 0.25 and w <= 3.3:
            terms = 14
        low += x - ((high + x) - high)
        decay = math.exp(-(high + x))
        kummer, total = 1.0, 0.0
        for m in range(terms, 0, -1):  # backwards, with M by its recurrence
            kummer = x * _INVERSE_NEXT_INTEGERS[m] * kummer + 1.0
            total = (w * _INVERSE_SQUARES[m]) * (kummer + total)
        return (decay - decay * low) * total
    tails = marcum_q1_tails(a, b)
    noise_alone = math.exp(-high)
    noise_alone -= noise_alone * low
    if tails.above >= 2.0 * noise_alone:
        return tails.above - noise_alone
    return -math.expm1(-high) - tails.below


def at_least_one_probability(p: ArrayLike, n: ArrayLike) -> np.ndarray:
    """Return the probability 1 - (1-p)^n of at least one success in n independent trials [T 3.7].

    Parameters
    ----------
    p : array_like
        Probability of success in one trial, 0..1.
    n : array_like
        Number of trials, >= 0. It need not be an integer (a mean number of independent bins).

    Returns
    -------
    ndarray
        Probability, of the broadcast shape; 0 for n = 0. The relative error is at most 1e-15.
    """
    p, n = np.asarray(p, float), np.asarray(n, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(n > 0.0, -np.expm1(n * np.log1p(-p)), 0.0)


def log_at_least_one_probability(log_p: ArrayLike, n: ArrayLike) -> np.ndarray:
    """Return the logarithm of the probability of at least one success in n trials, ln(1 - (1-p)^n).

    Parameters
    ----------
    log_p
        ln p <= 0.
    n
        Number of trials, 0..1e240; need not be an integer.

    Returns
    -------
    numpy.ndarray
        -inf where p or n is 0. The relative error is at most 1e-15 for n p < 1, at any ln p. Near
        certainty the result is about -(1-p)^n. Rounding of ln p alone changes that by up to
        n p / (1-p) parts in 1e16, and the error is within 2 + n p / (1-p) parts in 2e15.
    """
    log_p, n = np.asarray(log_p, float), np.asarray(n, float)
    with np.errstate(divide="ignore", invalid="ignore", under="ignore"):
        p_none_once, is_likely = -np.expm1(log_p), log_p > -_LN2
        exponent = n * np.where(is_likely, np.log(p_none_once), np.log1p(-np.exp(log_p)))
        # For large p, powers of 1-p are more precise than exp(n ln(1-p)).
        p_none_of_n = np.where(is_likely, p_none_once**n, np.exp(exponent))
        log_p_if_rare = np.log(-np.expm1(exponent))
        log_probability = np.where(exponent > -_LN2, log_p_if_rare, np.log1p(-p_none_of_n))
        log_probability = np.where(log_p < _LOG_P_LINEAR_MAX, log_p + np.log(n), log_probability)
        return np.where(n > 0.0, log_probability, -np.inf)


def log_either_probability(log_p_first: np.ndarray, log_p_second: np.ndarray) -> np.ndarray:
    """Return the natural logarithm of the probability of at least one of two independent events.

    Parameters
    ----------
    log_p_first, log_p_second : ndarray
        ln p and ln q of the two events' probabilities p and q, <= 0.

    Returns
    -------
    ndarray
        ln(p + q (1 - p)), of the broadcast shape; -inf where both probabilities are 0.
    """
    with np.errstate(divide="ignore"):
        return np.minimum(
            np.logaddexp(log_p_first, log_p_second + np.log(-np.expm1(log_p_first))), 0.0
        )
