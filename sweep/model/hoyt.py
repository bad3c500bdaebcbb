"""Tail probabilities of a noncircular complex Gaussian's magnitude (Hoyt distribution).

Let X be a zero-mean complex Gaussian number of mean power P = E|X|^2 and real pseudo-variance
E[X^2] = q P, -1 <= q <= 1. Its real and imaginary parts are independent, with the variances
v_1^2, v_2^2 = (1 +- q) P / 2, and |X| has a Hoyt (Nakagami-q) distribution [Hoyt, Bell Syst. Tech.
J. 26, 318, 1947]. Equivalently, |X|^2 is exponential with the mean P (1 + q cos t), averaged over a
phase t uniform in 0 .. pi. It exceeds r^2 with the probability [Paris, Electron. Lett. 45, 210,
2009]

    P(|X| > r) = 1 - Q_1(a r, b r) + Q_1(b r, a r),    a, b = (v_1 +- v_2) / (2 v_1 v_2).

For q = +-1 only one part of X is left, and the probability is erfc(r / sqrt(2 P)).
"""

import math

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.marcum import marcum_q1_pair

ANGLES = 8
"""Number of nodes t_j = pi (j + 1/2) / ANGLES of the midpoint rule over the phase t."""

COSINES = np.cos(np.pi * (np.arange(ANGLES) + 0.5) / ANGLES)


@njit(cache=True, error_model="numpy", borrows=True)
def bin_share(bin_, half, shares):
    """Return the pseudo-variance ratio q = E[X^2] / E[|X|^2] of a bin; 0 far from DC and Nyquist.

    ``bin_`` is 0 .. N/2 and ``half`` is N/2. ``shares`` (k,): q of the bins 0 .. k - 1, counted
    from the nearer of DC and Nyquist.
    """
    k = min(bin_, half - bin_)
    return shares[k] if 0 <= k < shares.size else 0.0


@njit(cache=True, error_model="numpy", borrows=True)
def hoyt_pair(power, share, level):
    """Return P(|X| >= level) and P(|X| < level) of a noncircular complex Gaussian number X.

    ``power`` is E[|X|^2], ``share`` the pseudo-variance ratio q = E[X^2] / E[|X|^2], -1 .. 1.
    """
    q = abs(share)
    if q == 0.0:
        y = level * level / power
        return math.exp(-y), -math.expm1(-y)
    if q > 1.0 - 1e-9:
        x = level / math.sqrt(2.0 * power)
        return math.erfc(x), math.erf(x)
    one, other = math.sqrt(0.5 * power * (1.0 + q)), math.sqrt(0.5 * power * (1.0 - q))
    scale = 0.5 * level / (one * other)
    a, b = scale * (one + other), scale * (one - other)
    crosses, stays = marcum_q1_pair(a, b)
    crosses_turned, stays_turned = marcum_q1_pair(b, a)
    above = stays + crosses_turned
    below = crosses - crosses_turned if crosses < 0.5 else stays_turned - stays
    return above, max(below, 0.0)
