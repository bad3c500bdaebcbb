"""Leakage: extra groups raised by the signal's own bins below the threshold.

It changes no detecting bin, and so no detection probability; it is what ``p_leakage`` holds. It
acts on the detection: without it no bin beside the groups need be looked at. By the union bound

    p_leakage <= sum_k (Q_1(a_k, b) - Q_1(0, b)) / (1 - Q_1(0, b)),   a_k <= min(A E(k), b),

with A the magnitude of all lines in phase, E the envelope of the window's sidelobes and b the
threshold, all over sigma.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from sweep.model.effects.change import Change
from sweep.model.effects.line_spread import Line
from sweep.model.marcum import excess_crossing
from sweep.model.segments import SEGMENT_FIELDS

_STEPS = 40


def bound() -> Change:
    """What leakage can change in the detecting bin: nothing."""
    return Change()


def probability_bound(
    line: Line,
    *,
    amplitude: ArrayLike,
    threshold: ArrayLike,
    extreme: ArrayLike,
    fft_size: int,
    powers: bool,
) -> np.ndarray:
    """Bound on the chance that leaked signal raises an extra group in a segment, 0..1.

    Parameters
    ----------
    line : Line
        Of the axis.
    amplitude, threshold : array_like
        Magnitude of all lines in phase, or as powers, and the threshold, over sigma.
    extreme : array_like
        Bins from the axis's line to the furthest.
    fft_size : int
        N; there are N/2 bins.
    powers : bool
        Whether lines, and images, add as powers: then the largest bin is nearest to lines that
        lie close, and it and its neighbours, less than a bin from them, cannot leak.
    """
    steps = np.unique(np.r_[0.0, np.geomspace(0.75, fft_size / 2 + 1, _STEPS)])
    columns = np.broadcast_arrays(
        *(np.asarray(v, float) for v in (amplitude, threshold, extreme)), line.edge
    )
    a, b, e, edge = (np.array(v) for v in columns)
    image = line.lobe.tail(edge - e)
    envelope, bins = line.lobe.tail(steps[:-1]), np.diff(steps)
    return np.asarray(_union(a, b, e, image, envelope, bins, fft_size / 2, powers))


@njit(cache=True, error_model="numpy")
def _union(amplitude, threshold, extreme, image, envelope, bins, half, powers):
    """Sum of the chances of all bins, step of distance by step, (n,)."""
    out = np.empty(amplitude.size)
    for i in range(amplitude.size):
        a, b, aside = amplitude[i], threshold[i], image[i]
        close = powers and extreme[i] < 0.125
        total = 0.0
        if not close:
            inside = min(2.0 * extreme[i] + 1.0, half)
            total = inside * excess_crossing(min(2.0 * a, b), b)
        for j in range(1 if close else 0, bins.size):
            beside = envelope[j]
            both = math.hypot(beside, aside) if powers else beside + aside
            # to either side; steps need not begin on a bin
            number = 2.0 * bins[j] + (2.0 if j < 2 else 0.0)
            total += number * excess_crossing(min(a * both, b), b)
        out[i] = min(total / -math.expm1(-0.5 * b * b), 1.0)
    return out


def without(found: np.ndarray) -> np.ndarray:
    """What is found in the spectra, (3, fields, n), with no leakage: what need not be summed."""
    quiet = found.copy()
    quiet[:, SEGMENT_FIELDS.index("leakage")] = 0.0
    return quiet
