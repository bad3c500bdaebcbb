"""Magnitude of a complex Gaussian number whose quadratures differ.

Of a mean power P and a real pseudo-variance E[X^2] = q P the quadratures are independent, of the
variances (1 +- q) P / 2. |X|^2 is a Hoyt variable [Hoyt, Bell Syst. Tech. J. 26, 318, 1947]: with a
phase t uniform in 0 .. pi it is exponential, of the mean P (1 + q cos t). It exceeds r^2 with
[Paris, Electron. Lett. 45, 210, 2009]

    1 - Q_1(a r, b r) + Q_1(b r, a r),    a, b = (v_1 +- v_2) / (2 v_1 v_2),

v_1 and v_2 the deviations of the quadratures; a real number with erfc(r / sqrt(2 P)).
"""

import math

import numpy as np

from sweep.kernels import njit
from sweep.model.marcum import marcum_q1_pair

ANGLES = 8
"""Phases of an amplitude that stand for all where quadratures differ."""

COSINES = np.cos(np.pi * (np.arange(ANGLES) + 0.5) / ANGLES)


@njit(cache=True, error_model="numpy")
def bin_share(bin_, half, shares):
    """Pseudo-variance over power of a bin 0 .. N/2; ``shares`` (k,) are counted from DC."""
    k = min(bin_, half - bin_)
    return shares[k] if 0 <= k < shares.size else 0.0


@njit(cache=True, error_model="numpy")
def hoyt_pair(power, share, level):
    """Probabilities that a Gaussian number's magnitude reaches a level, and that it does not.

    ``power`` is its mean square, ``share`` its pseudo-variance over that, -1 .. 1.
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
