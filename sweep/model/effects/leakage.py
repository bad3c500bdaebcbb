"""Leakage: extra groups raised by the signal's own bins below the threshold.

It changes no detecting bin, and so no detection probability; it is what ``p_leakage`` holds. It
acts on the detection: without it no bin beside the groups need be looked at. By the union bound

    p_leakage <= sum_k (Q_1(a_k, b) - Q_1(0, b)) / (1 - Q_1(0, b)),   a_k <= min(A E(k), b),

with A the magnitude of all lines in phase, E the envelope of the window's sidelobes and b the
threshold, all over sigma.
"""

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from sweep.model.effects.effect import Effect, Scene
from sweep.model.effects.line_spread import Line
from sweep.model.marcum import excess_crossing
from sweep.model.preparation import Shots

if TYPE_CHECKING:
    from sweep.model.effects.block import Block


_STEPS = 40
_NEGLIGIBLE = 1e-14
"""Chance that needs no closer look."""
_HIGHER = 1.25
"""How much more leaks, at the most, with a higher threshold than one of 2 sigma or more: only bins
that reach the threshold, whose chance to cross then rises from 0.468 to 0.556."""


def bound(block: "Block") -> np.ndarray:
    """Bound on the chance that leaked signal raises an extra group, (3, tiles)."""
    lines, spread = block.lines, block.spread
    uphill = np.exp(np.minimum(lines.tilt * np.asarray(spread.extreme), 50.0))
    peak = (block.beat / block.deviation).high * np.minimum(lines.transfer * uphill, 1.0)
    ratio = np.maximum(block.echo_ratio.high, 1.0)
    whole = ratio if block.architecture == "direct" else np.sqrt(ratio)
    powers = not block.adds_amplitudes
    lower, upper = block.threshold.low, block.threshold.high
    found = probability_bound(
        lines,
        amplitude=peak * whole * (1.0 if powers else block.gain.high),
        threshold=lower,
        extreme=spread.extreme,
        fft_size=block.fft_size,
        powers=powers,
    )
    if not block.segment_exists[1]:
        found[1] = 0.0
    one = np.equal(lower, upper)
    return np.asarray(np.where(one, found, np.where(np.greater(lower, 2), _HIGHER * found, 1.0)))


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
    steps = _steps(fft_size)
    columns = np.broadcast_arrays(
        *(np.asarray(v, float) for v in (amplitude, threshold, extreme)), line.edge
    )
    a, b, e, edge = (np.array(v) for v in columns)
    image = line.lobe.tail(edge - e)
    envelope, bins = line.lobe.tail(steps[:-1]), np.diff(steps)
    flat = np.stack([v.ravel() for v in (a, b, e, image)])
    total = _union(flat, envelope, bins, fft_size / 2, powers)
    return np.asarray(total.reshape(a.shape))


@lru_cache(maxsize=32)
def _steps(fft_size: int) -> np.ndarray:
    """Distances [bins] between which the sidelobes are taken to be even."""
    return np.unique(np.r_[0.0, np.geomspace(0.75, fft_size / 2 + 1, _STEPS)])


@njit(cache=True, error_model="numpy")
def _union(columns, envelope, bins, half, powers):
    """Sum of the chances of all bins, step of distance by step, (n,)."""
    out = np.empty(columns.shape[1])
    for i in range(out.size):
        a, b, extreme, aside = columns[:, i]
        close = powers and extreme < 0.125
        total = 0.0
        if not close:
            inside = min(2.0 * extreme + 1.0, half)
            total = inside * excess_crossing(min(2.0 * a, b), b)
        for j in range(1 if close else 0, bins.size):
            beside = envelope[j]
            both = math.hypot(beside, aside) if powers else beside + aside
            # to either side; steps need not begin on a bin
            number = 2.0 * bins[j] + (2.0 if j < 2 else 0.0)
            chance = excess_crossing(min(a * both, b), b)
            if chance * half < _NEGLIGIBLE or total > 1.0:
                total += 2.0 * half * chance  # sidelobes fall, so does the chance
                break
            total += number * chance
        out[i] = min(total / -math.expm1(-0.5 * b * b), 1.0)
    return out


def act(shots: Shots, scene: Scene) -> Shots:
    """Bins beside the detection looked at too."""
    return replace(shots, leakage=True)


EFFECT = Effect(
    name="leakage",
    about="further groups raised by sidelobes below the threshold",
    stage="detection",
    bound=bound,
    act=act,
)
