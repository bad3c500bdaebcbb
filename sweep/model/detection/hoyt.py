"""Tail probabilities of a noncircular complex Gaussian's magnitude (Hoyt distribution).

Let X be a zero-mean complex Gaussian number of mean power P = E|X|^2 and real pseudo-variance
E[X^2] = q P, -1 <= q <= 1. Its real and imaginary parts are independent, with the variances
v_1^2, v_2^2 = (1 +- q) P / 2, and |X| has a Hoyt (Nakagami-q) distribution [Hoyt, Bell Syst. Tech.
J. 26, 318, 1947]. Equivalently, |X|^2 is exponential with the mean P (1 + q cos t), averaged over a
phase t uniform in 0 .. pi. It exceeds r^2 with the probability [Paris, Electron. Lett. 45, 210,
2009]

    P(|X| > r) = 1 - Q_1(a r, b r) + Q_1(b r, a r),    a, b = (v_1 +- v_2) / (2 v_1 v_2)

with Marcum's Q_1. For q = +-1 one part of X is 0, and the probability is erfc(r / sqrt(2 P)).
"""

import math

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection.marcum import Tails, marcum_q1_tails

N_PHASE_NODES = 8
"""Number of nodes of the midpoint rule for averages over a speckle phase t in 0 .. pi. The nodes
are t_j = pi (j + 1/2) / N_PHASE_NODES."""

PHASE_COSINES = np.cos(np.pi * (np.arange(N_PHASE_NODES) + 0.5) / N_PHASE_NODES)
"""Cosines of the phases pi (j + 1/2) / N_PHASE_NODES, the nodes of averages over a speckle
phase."""


@njit(cache=True, error_model="numpy", borrows=True)
def pseudo_variance_ratio_at(bin_, nyquist_bin, ratios):
    """Return the pseudo-variance ratio q = E[X^2] / E[|X|^2] of a bin with the amplitude X.

    The ratio is 0 for a circular X, as in bins far from DC and Nyquist.

    Parameters
    ----------
    bin_
        Number of the bin, 0 .. ``nyquist_bin``.
    nyquist_bin
        Number of the bin at the Nyquist frequency, half the FFT size.
    ratios
        (k,): q at distances of 0 .. k - 1 bins from the nearer of DC and Nyquist.
    """
    distance_from_end = min(bin_, nyquist_bin - bin_)
    return ratios[distance_from_end] if 0 <= distance_from_end < ratios.size else 0.0


@njit(cache=True, error_model="numpy", borrows=True)
def hoyt_tails(power, ratio, threshold):
    """Return the tails of the magnitude |X| of a noncircular complex Gaussian number X.

    Parameters
    ----------
    power
        E[|X|^2].
    ratio
        Pseudo-variance ratio q = E[X^2] / E[|X|^2], -1 .. 1.
    threshold
        Threshold on |X|, in the unit of |X|.

    Returns
    -------
    Tails
        Probabilities that |X| is above and below the threshold.
    """
    q = abs(ratio)
    if q == 0.0:
        y = threshold * threshold / power
        return Tails(math.exp(-y), -math.expm1(-y))
    if q > 1.0 - 1e-9:
        x = threshold / math.sqrt(2.0 * power)
        return Tails(math.erfc(x), math.erf(x))
    deviation_1, deviation_2 = (
        math.sqrt(0.5 * power * (1.0 + q)),
        math.sqrt(0.5 * power * (1.0 - q)),
    )
    scale = 0.5 * threshold / (deviation_1 * deviation_2)
    a, b = scale * (deviation_1 + deviation_2), scale * (deviation_1 - deviation_2)
    tails_ab, tails_ba = marcum_q1_tails(a, b), marcum_q1_tails(b, a)
    p_above = tails_ab.below + tails_ba.above
    p_below = tails_ba.below - tails_ab.below
    if tails_ab.above < 0.5:
        p_below = tails_ab.above - tails_ba.above
    return Tails(p_above, max(p_below, 0.0))
