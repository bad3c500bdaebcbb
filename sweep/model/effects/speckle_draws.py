"""Detection of speckled shots: draw by draw over the noise, with the noise, and in closed form.

:func:`conditional_detection` draws the speckle and leaves the noise to the closed forms of
PHYSICS section 6: each draw has its own probabilities, and their mean over draws converges far
faster than a count of detections. :func:`sampled_detection` draws the noise too, as
:mod:`sweep.model.draws` does, on the same speckle. :func:`mean_detection` needs no draws where the
footprint's lines fall into one bin.

What is looked at are the bins within ``sidelobe`` of a line's peak. In a draw in which the lines
all but cancel there, the largest bin may lie outside; ``neglected`` says in each draw how much
its probability of detection could rise by that, at most. Leakage is that of the bins looked at.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from sweep.model import chances, philox
from sweep.model.effects import speckle
from sweep.model.effects.speckle_bins import SIDELOBE, Response, margin, response
from sweep.model.marcum import excess_crossing, marcum_q1_pair
from sweep.model.preparation import Shots

STRETCH = 4096
"""Draws whose amplitudes are held at once."""

_NOISE = (philox.STREAM_NOISE_UP, philox.STREAM_NOISE_DOPPLER, philox.STREAM_NOISE_DOWN)
_MAXIMUM = (
    philox.STREAM_NOISE_MAXIMUM_UP,
    philox.STREAM_NOISE_MAXIMUM_DOPPLER,
    philox.STREAM_NOISE_MAXIMUM_DOWN,
)
_NAMES = ("up", "doppler", "down")


class MeanDetection(NamedTuple):
    """Means over speckle and noise for the strongest bin of each segment, whichever the draw.

    They are exact where the bins rise and fall together (``spread`` 0, a footprint within a small
    part of a bin), and least values otherwise, as the largest of several bins is larger.
    """

    pd: np.ndarray
    """(3, n): up, Doppler, down."""
    pd_shot: np.ndarray
    """(n,): up and down both; nan with a coherent share, which has no closed form."""
    spread: np.ndarray
    """(3, n): share of the diffuse power, over all bins, that does not follow the strongest."""


def conditional_detection(
    shots: Shots,
    *,
    keys: np.ndarray,
    first_draw: int = 0,
    draws: int,
    coherent_share: ArrayLike = 0.0,
    interval: ArrayLike | None = None,
    sidelobe: float = SIDELOBE,
) -> dict[str, np.ndarray]:
    """Probabilities over the noise of each draw of speckle.

    Parameters
    ----------
    shots : Shots
        n prepared points, homodyne or heterodyne.
    keys : (n, 2) uint64
        Random key of each.
    first_draw, draws : int
        Number of the first draw, number of draws; any stretch of draws can be had alone.
    coherent_share : array_like
        kappa of :func:`sweep.model.effects.speckle.coherent_share`, (n,) or a scalar. Incoherent
        shots have it with a random phase for each beamlet.
    interval : array_like, optional
        From the start of a segment to that of the next [s], (n,) or a scalar; the chirp's duration
        unless given.
    sidelobe : float
        Bins are looked at in which a line can exceed this share of its peak.

    Returns
    -------
    dict of (n, draws) ndarray
        ``pd_up``, ``pd_doppler``, ``pd_down`` and ``pd_shot`` (up and down); ``pfa_up``,
        ``pfa_down`` of noise alone; ``p_leakage_up``, ``p_leakage_down``; ``neglected``.

    Raises
    ------
    ValueError
        Of direct detection, whose speckle is one of intensities.
    """
    out = _draw(shots, keys, (first_draw, draws, False), (coherent_share, interval, sidelobe))
    values = {f"pd_{name}": out[..., s, 0] for s, name in enumerate(_NAMES)}
    values["pd_shot"] = values["pd_up"] * values["pd_down"]
    for s, name in ((0, "up"), (2, "down")):
        values[f"pfa_{name}"], values[f"p_leakage_{name}"] = out[..., s, 1], out[..., s, 2]
    return values | {"neglected": out[..., 3].max(axis=-1)}


def sampled_detection(
    shots: Shots,
    *,
    keys: np.ndarray,
    first_draw: int = 0,
    draws: int,
    coherent_share: ArrayLike = 0.0,
    interval: ArrayLike | None = None,
    sidelobe: float = SIDELOBE,
) -> dict[str, np.ndarray]:
    """Detections and false alarms of each draw of speckle and noise.

    Parameters as of :func:`conditional_detection`.

    Returns
    -------
    dict of (n, draws) bool ndarray
        ``found_up``, ``found_doppler``, ``found_down``, ``found_shot``; ``alarm_up``,
        ``alarm_down``, of noise or leakage.
    """
    out = _draw(shots, keys, (first_draw, draws, True), (coherent_share, interval, sidelobe)) > 0
    values = {f"found_{name}": out[..., s, 0] for s, name in enumerate(_NAMES)}
    values["found_shot"] = values["found_up"] & values["found_down"]
    return values | {"alarm_up": out[..., 0, 1], "alarm_down": out[..., 2, 1]}


def mean_and_error(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean over the draws, the last axis, and its standard error."""
    return values.mean(axis=-1), values.std(axis=-1, ddof=1) / math.sqrt(values.shape[-1])


def mean_detection(
    shots: Shots,
    *,
    coherent_share: ArrayLike = 0.0,
    interval: ArrayLike | None = None,
    sidelobe: float = SIDELOBE,
) -> MeanDetection:
    """Mean detection in closed form, for lines within one bin and clear of DC and Nyquist.

    Parameters as of :func:`conditional_detection`. The coherent share of incoherent shots has no
    closed form: their pd are nan unless it is 0.
    """
    n = shots.range.size
    shares, intervals, reach = _settings(shots, coherent_share, interval, sidelobe)
    pd, spread, shot = np.empty((3, n)), np.empty((3, n)), np.full(n, np.nan)
    for i in range(n):
        kappa, noise = shares[i], (shots.bin_deviation[i], shots.threshold[i])
        found = [response(shots, i, s, margin_bins=reach) for s in range(3)]
        best = [_strongest(r, spread[s, i : i + 1]) for s, r in enumerate(found)]
        for s, r in enumerate(found):
            pd[s, i] = speckle.fixed_bin_detection(
                steady=math.sqrt(kappa) * abs(r.real[:, best[s]].sum()),
                diffuse_power=(1 - kappa) * _power(r, best[s]),
                bin_deviation=noise[0],
                threshold=noise[1],
            )
        if kappa == 0:
            shot[i] = _both(found[0], found[2], best[0], best[2], _turn(shots, i, intervals), noise)
        elif shots.incoherent and shots.offset.shape[1] > 1:
            pd[:, i] = np.nan
    return MeanDetection(pd, shot, spread)


def _settings(
    shots: Shots, coherent_share: ArrayLike, interval: ArrayLike | None, sidelobe: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Coherent share and interval of each point, (n,); reach of the bins looked at."""
    if shots.architecture == "direct":
        raise ValueError("direct detection has speckle of intensities, which is not this one")
    n = shots.range.size
    between = shots.duration if interval is None else interval
    share, between = (np.broadcast_to(np.asarray(v, float), n) for v in (coherent_share, between))
    return share, between, margin(shots.window, sidelobe)


def _turn(shots: Shots, i: int, intervals: np.ndarray) -> np.ndarray:
    """Factors (3, beamlets) by which beamlets have turned in each segment."""
    carrier = np.broadcast_to(shots.carriers[0], shots.range.size)[i]
    cycles = speckle.turns(
        carrier=carrier, doppler=shots.doppler[shots.row[i]], interval=intervals[i]
    )
    return np.asarray(np.exp(2j * np.pi * (cycles - np.rint(cycles))))


def _power(found: Response, k: int) -> float:
    """Mean |X|^2 of a bin whose beamlets are independent, of mean power 1."""
    return float((abs(found.real[:, k]) ** 2 + abs(found.imaginary[:, k]) ** 2).sum() / 2)


def _strongest(found: Response, spread: np.ndarray) -> int:
    """Bin of the largest mean power; what of the others' power does not follow it."""
    covariance = found.covariance()
    power = covariance.diagonal().real
    k = int(np.argmax(power))
    following = abs(covariance[:, k]) ** 2 / power[k]
    spread[0] = max(0.0, 1 - following.sum() / power.sum())
    return k


def _both(
    up: Response, down: Response, k: int, m: int, turn: np.ndarray, noise: tuple[float, float]
) -> float:
    """Chance that the strongest bins of up and down segment both cross."""
    real, imaginary = turn[2].real, turn[2].imag
    turned_real = real * down.real[:, m] + imaginary * down.imaginary[:, m]
    turned_imaginary = real * down.imaginary[:, m] - imaginary * down.real[:, m]
    first, second = up.real[:, k], up.imaginary[:, k]
    plain = (first * turned_real.conj() + second * turned_imaginary.conj()).sum() / 2
    # Where one of the two is folded, it follows the conjugate of the other.
    mirrored = (first * turned_real + second * turned_imaginary).sum() / 2
    return float(
        speckle.joint_detection(
            powers=(_power(up, k), _power(down, m)),
            covariance=max(abs(plain), abs(mirrored)),
            bin_deviation=noise[0],
            threshold=noise[1],
        )
    )


def _draw(
    shots: Shots, keys: np.ndarray, stretch: tuple[int, int, bool], settings: tuple
) -> np.ndarray:
    """(n, draws, 3, 4): pd, pfa, leakage and what is neglected, or what was found and alarmed."""
    first, draws, noisy = stretch
    n, beamlets = shots.range.size, shots.offset.shape[1]
    shares, intervals, reach = _settings(shots, *settings)
    base = float(shots.counted_bins(np.zeros(()))), shots.bins_counted != "all"
    floors = np.broadcast_to(np.asarray(shots.leakage_floor, float), n)
    out = np.empty((n, draws, 3, 4))
    keys = np.asarray(keys, np.uint64)
    for i in range(n):
        noise = float(shots.bin_deviation[i]), float(shots.threshold[i]), float(floors[i])
        found = [response(shots, i, s, margin_bins=reach) for s in range(3)]
        turn = _turn(shots, i, intervals)
        for start in range(0, draws, STRETCH):
            part = slice(start, min(start + STRETCH, draws))
            steady, diffuse = speckle.parts(
                keys[i], first + start, part.stop - start, beamlets, float(shares[i]),
                shots.incoherent,
            )  # fmt: skip
            for s, r in enumerate(found):
                factors = steady + diffuse * turn[s]
                _judge(
                    (keys[i, 0], keys[i, 1], first + start, _NOISE[s], _MAXIMUM[s]), factors, r,
                    noise, base, noisy, out[i, part, s],
                )  # fmt: skip
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _judge(source, factors, found, noise, counted, noisy, out):
    """One segment's draws: a row of four each, as of :func:`_draw`."""
    bins, real, imaginary, strength, outside = found
    sigma, level, floor = noise
    beta = level / sigma
    size = bins.size
    x, magnitude, exempt = np.empty(size, np.complex128), np.empty(size), np.empty(size, np.bool_)
    for d in range(factors.shape[0]):
        total = 0.0
        x[:] = 0.0
        for b in range(factors.shape[1]):
            re, im = factors[d, b].real, factors[d, b].imag
            total += strength[b] * math.hypot(re, im)
            for k in range(size):
                x[k] += real[b, k] * re + imaginary[b, k] * im
        for k in range(size):
            magnitude[k] = abs(x[k]) / sigma
        peak, exempted = _exempt(bins, magnitude, beta, exempt)
        others = counted[0] - (exempted if counted[1] else 0.0)
        if noisy:
            out[d, 0], out[d, 1] = _look(
                source, d, bins, magnitude, exempt, peak, floor, beta, others
            )
            out[d, 2], out[d, 3] = 0.0, 0.0
        else:
            out[d, 0], _ = marcum_q1_pair(magnitude[peak], beta)
            out[d, 1] = chances.at_least_one_scalar(math.exp(-0.5 * beta * beta), max(others, 0.0))
            out[d, 2] = _leakage(magnitude, exempt, floor, beta)
            most = outside * total / sigma
            out[d, 3] = 0.0
            if most > magnitude[peak]:
                out[d, 3] = marcum_q1_pair(most, beta)[0] - out[d, 0]


@njit(cache=True, error_model="numpy")
def _exempt(bins, magnitude, beta, exempt):
    """Largest bin; number of those that can't raise a false alarm: groups and their neighbours."""
    peak = 0
    for k in range(bins.size):
        exempt[k] = False
        if magnitude[k] > magnitude[peak]:
            peak = k
    exempted = 0
    for k in range(bins.size):
        if magnitude[k] >= beta or k == peak:
            for j in range(max(k - 1, 0), min(k + 2, bins.size)):
                if abs(bins[j] - bins[k]) <= 1 and not exempt[j]:
                    exempt[j] = True
                    exempted += 1
    return peak, exempted


@njit(cache=True, error_model="numpy")
def _leakage(magnitude, exempt, floor, beta):
    """Chance that the signal's own bins raise an extra group, over noise alone."""
    noise_only = -math.expm1(-0.5 * beta * beta)
    silence = 0.0
    for k in range(magnitude.size):
        if not exempt[k] and magnitude[k] >= floor:
            silence += math.log1p(-excess_crossing(magnitude[k], beta) / noise_only)
    return 0.0 - math.expm1(silence)


@njit(cache=True, error_model="numpy")
def _look(source, d, bins, magnitude, exempt, peak, floor, beta, others):
    """Whether one draw of noise lifts the peak over the threshold, and any other bin."""
    a, b, first, stream, maximum_stream = source
    found, alarm = False, False
    for k in range(bins.size):
        if k != peak and (exempt[k] or magnitude[k] < floor):
            continue
        re, im = philox.normal_pair(a, b, first + d, stream, bins[k])
        crosses = (magnitude[k] + re) ** 2 + im**2 >= beta * beta
        if k == peak:
            found = crosses
        else:
            alarm |= crosses
            others -= 1.0
    quiet = chances.at_least_one_scalar(math.exp(-0.5 * beta * beta), max(others, 0.0))
    alarm |= philox.uniform(a, b, first + d, maximum_stream, 0) < quiet
    return found, alarm
