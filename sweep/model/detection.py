"""Detection in one segment's spectrum: threshold, groups, what may raise a false alarm."""

import math

import numpy as np
from numba import njit

from sweep.model.marcum import excess_crossing

RAYLEIGH_DEVIATION = math.sqrt(2 - math.pi / 2)
"""Standard deviation of |X| in a noise-only bin, in units of sigma (per quadrature)."""


def threshold(*, tnr: np.ndarray, bin_deviation: np.ndarray) -> np.ndarray:
    """Detection threshold on |X|: TNR standard deviations of a noise-only bin's magnitude.

    The only reading of [T]'s threshold-to-noise ratio that gives its Table 4.2 (PHYSICS section
    6): a noise-only bin crosses with probability exp(-(4 - pi)/4 TNR^2).
    """
    return tnr * bin_deviation * RAYLEIGH_DEVIATION


@njit(cache=True, error_model="numpy")
def assess(magnitude, count, sigma, level, floor, exempt):
    """Detection and leakage in a run of bins around a segment's lines.

    Adjacent bins at or above the threshold form a group; its largest bin is the detection. The
    bins of a group and the two beside it can't raise a false alarm, nor can the strongest bin
    and its neighbours, group or not. Every other bin crosses with Q_1 of its own magnitude
    [T 3.3.2]; what that adds to the crossings of noise alone is the leakage.

    Parameters
    ----------
    magnitude : (>= count,) float64
        |X| of the bins, without noise.
    sigma, level : float
        Noise per quadrature; threshold.
    floor : float
        Bins of less than this many sigma count as noise alone.
    exempt : (>= count,) bool
        Result: bins that can't raise a false alarm.

    Returns
    -------
    peak, exempted : int
        Index of the largest bin; number of exempt bins.
    leakage : float
        Probability that leaked signal raises at least one extra group, over noise alone.
    """
    peak = 0
    for i in range(count):
        exempt[i] = False
        if magnitude[i] > magnitude[peak]:
            peak = i
    for i in range(count):
        if magnitude[i] >= level or i == peak:
            for j in range(max(i - 1, 0), min(i + 2, count)):
                exempt[j] = True
    beta = level / sigma
    noise_only = -math.expm1(-0.5 * beta * beta)
    exempted = 0
    silence = 0.0
    for i in range(count):
        if exempt[i]:
            exempted += 1
        elif magnitude[i] >= floor * sigma:
            silence += math.log1p(-excess_crossing(magnitude[i] / sigma, beta) / noise_only)
    return peak, exempted, 0.0 - math.expm1(silence)
