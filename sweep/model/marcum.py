"""First-order Marcum Q function: the chance that a bin with signal crosses the threshold.

``Q1(a, b)`` is the probability that a Rice-distributed magnitude of amplitude ``a`` (in units of
the noise per quadrature) exceeds ``b``: the detection probability [T 3.3]; ``Q1(0, b)`` is the
false alarm probability [T 3.4]. Both tails are computed as sums of positive terms, each from the
side on which it is small, and the other as its complement, so neither loses digits.

Below ``ab = 30`` the series of Bessel functions is summed by backward recurrence (Miller), from
there on the integral over the imaginary axis is summed by the midpoint rule with the residue of
its pole put back. Arguments are (a, b), not their squares, which could not tell a from b when
both are large.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.compiling import borrowing, owning
from sweep.model.elementary import fma

_LARGEST_SERIES_PRODUCT = 30.0
_STEP = 0.7
"""Step h of the midpoint rule: its error is exp(-(2 pi / h)^2 / 2) = 3e-18 of the result."""

_NODES = tuple((_STEP * (k + 0.5)) ** 2 for k in range(13))
_WEIGHTS = tuple(_STEP / math.pi * math.exp(-0.5 * v) for v in _NODES)
_POLE_REACH = 2.0 * math.pi / _STEP

_NOTHING_LEFT = 1500.0
"""(a - b)^2 from which on the smaller tail, exp of minus half of it, is 0 to float64."""

# Excess crossings, K terms: 1/(m+1) and 1/m^2 for m = K .. 1, so that no step divides.
_LONGEST_EXCESS = 24
_HARMONIC = tuple(1.0 / (m + 1) for m in range(_LONGEST_EXCESS + 1))
_INVERSE_SQUARE = (0.0, *(1.0 / m**2 for m in range(1, _LONGEST_EXCESS + 1)))


class MarcumQ(NamedTuple):
    """Both tails of the Rice distribution and their natural logarithms, of one common shape."""

    q: np.ndarray
    """Q1(a, b), the probability to exceed b; 0..1."""
    p: np.ndarray
    """1 - Q1(a, b); 0..1, with its own digits where Q1 is near 1."""
    log_q: np.ndarray
    """ln Q1(a, b) <= 0, finite far below float64's range."""
    log_p: np.ndarray
    """ln(1 - Q1(a, b)) <= 0, likewise."""


def marcum_q1(a: ArrayLike, b: ArrayLike) -> MarcumQ:
    """First-order Marcum Q function, its complement and the logarithms of both [T 3.3].

    Parameters
    ----------
    a : array_like
        Signal magnitude over the noise per quadrature [1], >= 0. Broadcast against `b`.
    b : array_like
        Threshold over the noise per quadrature [1], >= 0.

    Returns
    -------
    MarcumQ
        Arrays of the broadcast shape. Relative error at most 2e-15 in each of the four (for
        ``q`` and ``p`` while they stay above float64's smallest normal number).

    Raises
    ------
    ValueError
        An argument is negative or nan, or both are infinite, where no limit exists.
    """
    a, b = np.broadcast_arrays(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
    if not (np.all(a >= 0.0) and np.all(b >= 0.0)):
        raise ValueError("the Marcum Q function needs a >= 0 and b >= 0, and no nan")
    if np.any(np.isinf(a) & np.isinf(b)):
        raise ValueError("the Marcum Q function has no limit where both a and b are infinite")
    values = _marcum_q1_flat(a.ravel(), b.ravel())
    return MarcumQ(*(value.reshape(a.shape) for value in values))


@owning()
def _marcum_q1_flat(a, b):
    """Rows q, p, log q and log p of shape (4, n)."""
    values = np.empty((4, a.size))
    for i in range(a.size):
        values[0, i], values[1, i], values[2, i], values[3, i] = marcum_q1_scalar(a[i], b[i])
    return values


@borrowing()
def marcum_q1_scalar(a, b):
    """Marcum Q of one pair: (q, p, log_q, log_p); all nan outside the domain.

    The compiled form of `marcum_q1`, for other kernels.
    """
    if not (a >= 0.0 and b >= 0.0) or (math.isinf(a) and math.isinf(b)):
        return math.nan, math.nan, math.nan, math.nan
    if b == 0.0 or math.isinf(a):
        return 1.0, 0.0, 0.0, -math.inf
    if math.isinf(b):
        return 0.0, 1.0, -math.inf, 0.0
    high, low, lead, scale, pole, is_p = _smaller_tail(a, b)
    tail = lead * (lead * scale * _exp_minus(high, low)) + pole
    if tail > 1e-290:
        log_tail = math.log(tail)
    else:
        log_tail = -high + (2.0 * math.log(lead) + math.log(scale) - low)
    if is_p:
        return 1.0 - tail, tail, math.log1p(-tail), log_tail
    return tail, 1.0 - tail, log_tail, math.log1p(-tail)


@borrowing()
def marcum_q1_pair(a, b):
    """Marcum Q of one pair without the logarithms: (q, p); nan outside the domain."""
    if not (a >= 0.0 and b >= 0.0) or (math.isinf(a) and math.isinf(b)):
        return math.nan, math.nan
    if b == 0.0 or math.isinf(a):
        return 1.0, 0.0
    if math.isinf(b):
        return 0.0, 1.0
    if (a - b) * (a - b) > _NOTHING_LEFT:
        return (1.0, 0.0) if b < a else (0.0, 1.0)
    high, low, lead, scale, pole, is_p = _smaller_tail(a, b)
    tail = lead * (lead * scale * _exp_minus(high, low)) + pole
    if is_p:
        return 1.0 - tail, tail
    return tail, 1.0 - tail


@borrowing()
def excess_crossing(a, b):
    """Q1(a, b) - Q1(0, b): what a bin's own signal adds to its chance to cross; nan outside.

    Where the sum is short (a <= 2 and ab <= 8; a leaking bin), with x = a^2/2 and y = b^2/2,

        exp(-x-y) sum_{m>=1} (x y)^m / m!^2  M(1, m+1, x),

    all of it positive (M is Kummer's function; from dQ1/da = b exp(-x-y) I1(ab)), so the result
    keeps its digits down to ``exp(-y) x y`` for a -> 0. Elsewhere it is a difference of tails in
    which at most a bit or two cancels. Relative error at most 2e-15.
    """
    if not (a >= 0.0 and b >= 0.0):
        return math.nan
    x = 0.5 * a * a
    w = 0.25 * (a * b) * (a * b)
    if x <= 2.0 and w <= 16.0:
        high, low = _half_square(b)
        decay = _exp_minus(high + x, low + (x - ((high + x) - high)))
        if x <= 1e-2 and w <= 2.6e-2:
            return decay * _excess_sum(x, w, 6)
        if x <= 0.125 and w <= 0.7:
            return decay * _excess_sum(x, w, 10)
        if x <= 0.25 and w <= 3.3:
            return decay * _excess_sum(x, w, 14)
        return decay * _excess_sum(x, w, _LONGEST_EXCESS)
    q, p = marcum_q1_pair(a, b)
    high, low = _half_square(b)
    noise_alone = _exp_minus(high, low)
    if q >= 2.0 * noise_alone:
        return q - noise_alone
    return -math.expm1(-high) - p


@borrowing()
def _excess_sum(x, w, terms):
    """sum_{m=1}^{terms} w^m / m!^2 M(1, m+1, x), from the last term on, M by its recurrence."""
    kummer = 1.0
    total = 0.0
    for m in range(terms, 0, -1):
        kummer = fma(x * _HARMONIC[m], kummer, 1.0)
        total = (w * _INVERSE_SQUARE[m]) * (kummer + total)
    return total


@borrowing()
def _half_square(x):
    """x^2 / 2 in two doubles; the low part is 0 where exp(-x^2/2) is, and may overflow else."""
    high = 0.5 * x * x
    return high, (fma(0.5 * x, x, -high) if high < 1e3 else 0.0)


@borrowing()
def _exp_minus(high, low):
    """exp(-(high + low)) for a low part far below 1."""
    value = math.exp(-high)
    return value - value * low


@borrowing()
def _smaller_tail(a, b):
    """The tail to compute, as lead^2 scale exp(-(high + low)) + pole, and whether it is 1 - Q1.

    Q1 for b >= a, else 1 - Q1; but below b = 1.2, where Q1 is near 1 for any a, always 1 - Q1.
    For finite a >= 0 and b > 0. `lead` is squared last so that a tiny b does not underflow.
    """
    larger, smaller = max(a, b), min(a, b)
    d = larger - smaller
    high, low = _half_square(d)
    if high < 1e3:
        low += d * ((larger - d) - smaller)
    is_p = b < a
    if math.isinf(high):
        return high, 0.0, 1.0, 1.0, 0.0, is_p
    if a * b < _LARGEST_SERIES_PRODUCT:
        is_p = is_p or b < 1.2
        lead, scale = _bessel_series(a, b, is_p)
        return high, low, lead, scale, 0.0, is_p
    pole = 1.0 / (1.0 + math.exp(_POLE_REACH * d)) if d < _POLE_REACH else 0.0
    return high, low, 1.0, _midpoint_rule(a, b, d, is_p), pole, is_p


@borrowing()
def _bessel_series(a, b, is_p):
    """(lead, scale) with lead^2 scale = exp(d^2/2) times Q1, or 1 - Q1 if `is_p`; ab < 30.

    Q1 = exp(-(a^2+b^2)/2) sum_{k>=0} (a/b)^k I_k(ab), and 1 - Q1 the same from k = 1 with a and
    b exchanged. The recurrence N_k = 2k N_{k+1} + (ab)^2 N_{k+2}, started at k = K from (1, 0),
    gives I_k / I_0 = (ab)^k N_{k+1} / N_1; exp(ab) = I_0 + 2 sum I_k sets the scale.
    """
    x = a * b
    square = b * b if is_p else a * a
    xx = x * x
    terms = int(7.0 + 9.0 * math.sqrt(max(x, square)))
    n, older = 1.0, 0.0
    tail, exponential = 0.0, 0.0
    for k in range(min(terms, 52), 0, -1):
        tail = fma(square, tail, n)
        exponential = fma(x, exponential, n)
        n, older = fma(2.0 * k, n, xx * older), n
    norm = 1.0 / fma(2.0 * x, exponential, n)
    if is_p:
        return b, tail * norm
    return 1.0, fma(square, tail, n) * norm


@borrowing()
def _midpoint_rule(a, b, d, is_p):
    """exp(d^2/2) times the tail less its pole; ab >= 30, d = |a - b|.

    h/pi sum_k exp(-v/2) (b d +- v/2) / ((d^2 + v) sqrt(ab - v/4)), v = (h (k + 1/2))^2, with +
    for Q1; written in ratios of a and b so that it cannot overflow.
    """
    shift = d * math.sqrt(b / a)
    half = 0.5 / (math.sqrt(a) * math.sqrt(b))
    if is_p:
        half = -half
    quarter = 0.25 / (a * b)
    dd = d * d
    total = 0.0
    for k in range(12, -1, -1):
        v = _NODES[k]
        total += (_WEIGHTS[k] * (shift + half * v)) / ((dd + v) * math.sqrt(1.0 - quarter * v))
    return total
