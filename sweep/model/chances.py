"""Many small chances: the probability of at least one success in n tries.

A false alarm somewhere among 1e5 bins, each with a chance of 1e-21 or 1e-2000 [T 3.7]: neither
the naive ``1 - (1-p)^n``, which is 0 below p = 1e-16, nor float64's range will do. Hence
log1p/expm1 for chances, and a form that takes and returns natural logarithms.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

_LN2 = math.log(2.0)
_LOG_FAR_BELOW = -600.0
"""Below this ln p, 1-(1-p)^n and n p are the same double for any n up to 1e240."""


def at_least_one(p: ArrayLike, n: ArrayLike) -> np.ndarray:
    """Probability 1 - (1-p)^n of at least one success in n independent tries [T 3.7].

    Parameters
    ----------
    p : array_like
        Probability of one try, 0..1. Broadcast against `n`.
    n : array_like
        Number of tries, >= 0; need not be whole (a mean number of independent bins).

    Returns
    -------
    ndarray
        Probability, 0..1, of the broadcast shape; relative error at most 1e-15.

    Raises
    ------
    ValueError
        `p` is outside 0..1 or nan, or `n` is negative, infinite or nan.
    """
    p, n = _broadcast(p, n)
    if not np.all((p >= 0.0) & (p <= 1.0)):
        raise ValueError("a probability lies within 0..1")
    return _at_least_one_flat(p.ravel(), n.ravel()).reshape(p.shape)


def log_at_least_one(log_p: ArrayLike, n: ArrayLike) -> np.ndarray:
    """Natural logarithm of 1 - (1-p)^n, from ln p.

    Parameters
    ----------
    log_p : array_like
        ln p <= 0; -inf is p = 0. Broadcast against `n`. Divide by ln 10 for decades.
    n : array_like
        Number of tries, 0..1e240; need not be whole.

    Returns
    -------
    ndarray
        ln(1 - (1-p)^n) <= 0, of the broadcast shape; -inf where p or n is 0. Relative error at
        most 1e-15 while n p < 1, at any ln p. Near certainty the result is minus the chance
        (1-p)^n of none; the rounding of ln p alone moves that by up to n p / (1-p) parts in
        1e16, and the error stays within 2 + n p / (1-p) parts in 2e15.

    Raises
    ------
    ValueError
        `log_p` is positive or nan, or `n` is negative, infinite or nan.
    """
    log_p, n = _broadcast(log_p, n)
    if not np.all(log_p <= 0.0):
        raise ValueError("the logarithm of a probability is at most 0")
    return _log_at_least_one_flat(log_p.ravel(), n.ravel()).reshape(n.shape)


def _broadcast(chance: ArrayLike, n: ArrayLike) -> tuple[np.ndarray, ...]:
    """Both as float64 of one shape; refuses an impossible number of tries."""
    arrays: tuple[np.ndarray, ...] = (np.asarray(chance, np.float64), np.asarray(n, np.float64))
    if arrays[0].shape != arrays[1].shape:
        arrays = np.broadcast_arrays(*arrays)
    if not np.all((arrays[1] >= 0.0) & np.isfinite(arrays[1])):
        raise ValueError("the number of tries is finite and not negative")
    return arrays


@njit(cache=True, error_model="numpy")
def at_least_one_scalar(p, n):
    """1 - (1-p)^n for 0 <= p <= 1 and finite n >= 0; the compiled form of `at_least_one`."""
    if n == 0.0:
        return 0.0
    return -math.expm1(n * math.log1p(-p))


@njit(cache=True, error_model="numpy")
def log_at_least_one_scalar(log_p, n):
    """ln(1 - (1-p)^n) for log_p <= 0 and finite n >= 0; compiled form of `log_at_least_one`."""
    if n == 0.0:
        return -math.inf
    if log_p < _LOG_FAR_BELOW:
        return log_p + math.log(n)
    none = -math.expm1(log_p)
    exponent = n * (math.log(none) if log_p > -_LN2 else math.log1p(-math.exp(log_p)))
    if exponent > -_LN2:
        return math.log(-math.expm1(exponent))
    if log_p > -_LN2:
        # Here 1-p carries the digits, and its power keeps them where exp(n ln(1-p)) loses some.
        return math.log1p(-(none**n))
    return math.log1p(-math.exp(exponent))


@njit(cache=True, error_model="numpy")
def _at_least_one_flat(p, n):
    """`at_least_one_scalar` of each element, (n,)."""
    chance = np.empty(p.size)
    for i in range(p.size):
        chance[i] = at_least_one_scalar(p[i], n[i])
    return chance


@njit(cache=True, error_model="numpy")
def _log_at_least_one_flat(log_p, n):
    """`log_at_least_one_scalar` of each element, (n,)."""
    log_chance = np.empty(log_p.size)
    for i in range(log_p.size):
        log_chance[i] = log_at_least_one_scalar(log_p[i], n[i])
    return log_chance
