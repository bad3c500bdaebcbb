"""Probabilities that the strongest peak of a segment is the echo's, or another's.

A peak elsewhere that is larger than the echo's takes its place: what is reported is detected, with
a wrong range. Let Z be the largest |X| of the bins searched that the echo does not occupy, and b
the threshold. Let P_z be the probability that the echo crosses a level z, by the same law as at b.
Then

    P(right) = P_b - L,    P(wrong) = P(Z >= b) (1 - P_b) + L,
    L = int_b^inf (P_b - P_z) dP(Z < z),    P(none) = P(Z < b) (1 - P_b)

and these three add to 1. All terms are positive, so that small ones keep their digits. P(Z < z) is
that no bin of noise crosses z, n independent ones at each level (:mod:`sweep.model.alarms`), and
that no bin of leaked signal does either. With y = z^2 / (2 sigma^2), -ln P(Z < z) is very nearly
proportional to e^-y. The integral over y is Gauss's in intervals, and its mass is made exact.

Noise is independent from segment to segment, and so are right peaks of a steady echo. If speckle is
shared, the probability of both is that of two correlated Rayleigh magnitudes which cross their own
levels, max(b, Z), averaged over both Z. An echo of many bins counts at each level as the one bin
that crosses it as often. It is within 0.01 of drawn records at any threshold.

A shot is wrong where both chirps report a peak, and not both of the echo.
"""

import math
from typing import Any

import numpy as np

from sweep.kernel_cache import njit
from sweep.model import alarms, waveform
from sweep.model.detection import BinLevels, found_pair, levels_of, speckle_of
from sweep.model.marcum import marcum_q1_pair
from sweep.model.search import leakage_of
from sweep.model.segments import runs_of

ORDER = 4
"""Gauss points of each stretch of y."""
EDGES = np.array([0, 1, 2, 3, 4, 5, 6, 7.5, 9.5, 12, 15, 19, 24, 30, 37.0])
"""Ends of the stretches, from the threshold or from 4 below ln n on, where noise surely alarms."""

_NODE, _WEIGHT = np.polynomial.legendre.leggauss(ORDER)
_SLOPE = np.array(
    [np.polynomial.Polynomial.fit(_NODE, row, ORDER - 1).deriv()(_NODE) for row in np.eye(ORDER)]
).T
"""Derivative at the points of the polynomial through values at them."""


def outcomes(
    shots: Any, pd: np.ndarray, miss: np.ndarray, magnitude: np.ndarray
) -> dict[str, np.ndarray]:
    """Probabilities of segments and shot, (n,) by name: ``pd_``, ``miss_``, ``p_wrong_range_``.

    By those of all peaks and |X| [V] of the strongest bin, by segment, (3, n) each.
    """
    lost, alarm, shared = np.zeros((3, shots.size)), np.zeros((3, shots.size)), np.zeros(shots.size)
    for runs in runs_of(shots, every_bin=True):
        lost[:, runs.part], alarm[:, runs.part], shared[runs.part] = _of_runs(shots, runs, pd)
    right, missed = np.maximum(pd - lost, 0.0), np.minimum(miss + lost, 1.0)
    wrong = np.minimum(alarm * miss + lost, 1.0)
    found = {
        f"{name}_{segment}": values[s]
        for name, values in {"pd": right, "miss": missed, "p_wrong_range": wrong}.items()
        for s, segment in enumerate(waveform.SEGMENTS)
    }
    quiet = (1 - alarm[0]) * (1 - alarm[2])
    both = right[0] * right[2] + shared
    if shots.fading is not None:
        cross = shots.both(pd[0], pd[2], (magnitude[0], magnitude[2])) - pd[0] * pd[2]
        both = np.minimum(both + quiet * cross, np.minimum(right[0], right[2]))
    report = wrong[0] * (right[2] + wrong[2]) + right[0] * wrong[2]
    return found | {
        "pd_shot": both,
        "miss_shot": np.minimum(missed[0] + np.maximum(right[0] - both, 0.0), 1.0),
        "p_wrong_range_shot": np.maximum(report - shared, 0.0),
    }


def _of_runs(shots: Any, runs: Any, pd: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """L and P(Z >= b) by segment, (3, m); by how much shared speckle adds to both, (m,)."""
    part = runs.part
    deviation, sigma, threshold, floor = (
        np.broadcast_to(v, shots.size)[part]
        for v in (shots.line_deviation, shots.bin_deviation, shots.threshold, shots.floor)
    )
    y = _places(shots, runs, threshold / sigma)
    level, silence = np.sqrt(2 * y) * sigma[:, None], _silence(shots, runs, y)
    lost = np.zeros(level.shape)
    numbers = np.array([runs.low, runs.bins, runs.peak, runs.start])
    _at_levels(
        numbers, runs.inside, (runs.magnitudes, runs.exempt), level,
        np.concatenate([shots.bin_levels[:, part], floor[None]]),
        (shots.echo_rule, shots.leakage), (part, shots.speckle_table), lost, silence,
    )  # fmt: skip
    alarm = -np.expm1(-silence[..., 0])
    weight = _weights(silence[..., 1:], alarm)
    there, shared = shots.segments[:, None], np.zeros(part.size)
    if shots.fading is not None:
        alike = np.broadcast_to(np.abs(shots.fading.over) ** 2, shots.size)[part]
        with np.errstate(divide="ignore"):
            rare = np.minimum(-np.log(np.maximum(pd[:, part, None] - lost, 0.0)), 700.0)
        share = np.maximum(1 - rare / (0.5 * np.square(level / deviation[:, None])), 0.0)
        each = np.concatenate([1 - alarm[..., None], weight], axis=-1)
        _share((each[0], each[2]), (rare[0], rare[2]), (share[0], share[2]), alike, shared)
    loss = (weight * lost[..., 1:]).sum(axis=-1)
    return np.where(there, loss, np.nan), np.where(there, alarm, np.nan), shared


def _places(shots: Any, runs: Any, level: np.ndarray) -> np.ndarray:
    """Places y, (3, m, 1 + points), that of the threshold first."""
    least = 0.5 * np.square(level)
    bins = shots.searched_bins(runs.exempted, runs.part)
    start = np.maximum(least, np.log(np.maximum(bins, 1.0)) - 4)
    inner = (EDGES[:-1, None] + np.diff(EDGES)[:, None] * 0.5 * (_NODE + 1)).ravel()
    first = np.broadcast_to(least, start.shape)[..., None]
    return np.concatenate([first, start[..., None] + inner], axis=-1)


def _silence(shots: Any, runs: Any, y: np.ndarray) -> np.ndarray:
    """-ln P(no bin of noise is at or above y), of the shape of y."""
    bins = shots.searched_bins(runs.exempted, runs.part)[..., None]
    if shots.noise_bins == "correlated":
        bins = alarms.independent_bins(bins, level=np.sqrt(2 * y), correlation=shots.correlation)
    with np.errstate(divide="ignore", under="ignore"):
        one = np.where(y > 0.7, -np.log1p(-np.exp(-y)), -np.log(-np.expm1(-y)))
    return np.array(bins * one)


def _weights(silence: np.ndarray, alarm: np.ndarray) -> np.ndarray:
    """Weights of the points, their sum P(Z >= b), of the shape of ``silence`` (3, m, points)."""
    stretches = silence.reshape(*silence.shape[:2], -1, ORDER)
    with np.errstate(divide="ignore", invalid="ignore"):
        falls = -(np.log(stretches) @ _SLOPE.T)
    each = _WEIGHT * np.exp(-stretches) * stretches * falls
    each = np.nan_to_num(each, nan=0.0).reshape(silence.shape)
    each = np.maximum(each, 0.0)
    return each * (alarm / np.maximum(each.sum(axis=-1), 1e-300))[..., None]


@njit(cache=True, error_model="numpy")
def _excess_pair(a, b, alike):
    """P(both) - e^-a e^-b of two Rayleigh magnitudes (:func:`.detection.fading_together`)."""
    if alike <= 0.0 or a + b > 700.0:
        return 0.0
    rest = 2.0 / (1.0 - alike)
    both = math.exp(-a) * marcum_q1_pair(math.sqrt(b * rest), math.sqrt(alike * a * rest))[1]
    both += math.exp(-b) * marcum_q1_pair(math.sqrt(alike * b * rest), math.sqrt(a * rest))[0]
    return max(both - math.exp(-a - b), 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _at_levels(numbers, inside, bins, levels, noise, how, speckle, lost, silence):
    """Evaluate runs at all levels: what the echo loses there, and what leaked signal adds.

    ``numbers`` (4, segments, m) are low, count, peak and start of runs; ``bins`` |X| [V] of all
    runs, and whether they are of the echo; ``levels`` (segments, m, k) [V], the threshold first;
    ``noise`` (8, m) levels of the bins (:class:`sweep.model.detection.BinLevels`), and the floor of
    leakage over the noise; ``how`` the rule of detection, and whether leakage is looked at;
    ``speckle`` points (m,) and the speckle of all. Results, of the levels' shape:
    ``lost`` P_b - P_z; ``silence`` -ln P(Z < z), to which that of leaked signal is added.
    """
    low, count, peak, start = numbers
    sigma, floor = noise[2], noise[7]
    for s in range(low.shape[0]):
        for j in range(low.shape[1]):
            if count[s, j] == 0:
                continue
            run = bins[0][start[s, j] : start[s, j] + count[s, j]]
            echo = bins[1][start[s, j] : start[s, j] + count[s, j]]
            found_first, missed_first, of_bins = 0.0, 1.0, levels_of(noise, j)
            for k in range(levels.shape[2]):
                level = levels[s, j, k]
                if inside[s, j]:
                    found, missed = found_pair(
                        run, echo, peak[s, j], low[s, j], how[0],
                        BinLevels(
                            of_bins.line, level, of_bins.quiet, of_bins.beside, of_bins.pedestal
                        ),
                        speckle_of(speckle[1], s, speckle[0][j]),
                    )  # fmt: skip
                    if k == 0:
                        found_first, missed_first = found, missed
                    more = missed - missed_first if missed < 0.5 else found_first - found
                    lost[s, j, k] = max(more, 0.0)
                if how[1]:
                    leaks = leakage_of(
                        run, echo, (level, sigma[j], floor[j]), levels[s, j, 0],
                        how[0].sidelobe_correlation,
                    )  # fmt: skip
                    leaks = min(leaks, 1.0 - 1e-16)
                    silence[s, j, k] -= math.log1p(-leaks)


@njit(cache=True, nogil=True, error_model="numpy")
def _share(weights, rare, share, alike, shared):
    """Excess probability that both peaks are right if noise crosses in either, (m,) in place.

    ``weights``, ``rare`` and ``share`` are of up and down segment, (m, 1 + k) each, the threshold
    first: probabilities of levels that the echo has to cross; -ln P_z; share of signal in the power
    of the bin detected as often. ``alike`` is the square of the correlation of the signals'
    amplitudes.
    """
    for j in range(shared.size):
        up, down, total = weights[0][j], weights[1][j], 0.0
        one, other = 1.0 - up[0], 1.0 - down[0]
        for k in range(up.size):
            for i in range(1 if k == 0 else 0, down.size):
                chance = up[k] * down[i]
                if chance > 1e-9 * (one if k > 0 else 1.0) * (other if i > 0 else 1.0):
                    square = min(alike[j] * share[0][j, k] * share[1][j, i], 1.0 - 1e-12)
                    total += chance * _excess_pair(rare[0][j, k], rare[1][j, i], square)
        shared[j] = total
