"""Developed speckle in bins near DC and Nyquist of a real record, whose quadratures differ.

A real record holds each line A e^(i phase) with its image, the conjugate at the opposite frequency.
Bin k of the transform about the record's middle, of lines at the places nu with the window's
transform G, real and even, is

    X = sum_b (A_b G(k - nu_b) + conj(A_b) G(k + nu_b)) + noise.

With circular complex Gaussian amplitudes A_b of mean power P_b it is a Gaussian number. It has the
mean power S + 2 sigma^2, and the pseudo-variance

    E[X^2] = 2 sum_b P_b G(k - nu_b) G(k + nu_b) + 2 sigma^2 W2(2k) / W2(0),

W2 the transform of the squared window. It is real, so that the quadratures are independent, of
variances (1 +- q) / 2 of the mean power with q = E[X^2] / E[|X|^2]. At DC and Nyquist q is 1: the
number is real. Some bins away q is 0, and the number is circular.

The law of |X|^2 is in :mod:`sweep.model.hoyt`.

Phase errors within the record widen a line. They are left out of G here, as are the samples that
the echo does not have. Neither changes q at DC, where it is 1.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from sweep.model.detectors import main_lobe
from sweep.model.hoyt import ANGLES, COSINES, hoyt_pair
from sweep.model.look_speckle import independent_speckles, power_sum_tails, votes_given_speckle
from sweep.model.looks import POWER, Looks
from sweep.model.search import beamlet_lines, centre_lines
from sweep.model.speckle_correlation import window_transform
from sweep.model.window import Window, samples

SHARE_MIN = 0.05
"""Pseudo-variance ratio |q| below which bins are treated as circular; pd changes by less than
2e-4."""


class SignalQuadratures(NamedTuple):
    """Pseudo-variance ratio q of echoes near DC and Nyquist, which overlap their images there."""

    row: np.ndarray
    """(segments, n) int64: row of ``share`` and ``factors`` of each point; row 0, in which q is 0,
    for echoes far from DC and Nyquist."""
    share: np.ndarray
    """(rows, bins): q by bin, counted from the nearer of DC and Nyquist."""
    factors: np.ndarray
    """(rows, ANGLES): echo power at each phase node, 1 + q cos t_j times its mean in the strongest
    bin. With ``any_bin`` detection, of the bin that is strongest at that phase."""


def signal_quadratures(shots: Any) -> SignalQuadratures:
    """Compute the pseudo-variance ratios of echoes near DC and Nyquist of real records."""
    size, ratio = shots.fft_size, shots.fft_size / shots.window.length
    bins = number_of_bins(shots.window, size)
    row = np.zeros((len(shots.waveform), shots.size), np.int64)
    rows, factors = [np.zeros((1, bins))], [np.ones((1, ANGLES))]
    near = lines_near_end(shots)
    for s in np.flatnonzero(shots.segments):
        points = np.flatnonzero(near[s])
        if not points.size:
            continue
        places = beamlet_lines(shots, points)[:, s]
        # About Nyquist lines and images mirror as about DC.
        upper = places.mean(axis=1) > size / 4
        places = np.where(upper[:, None], size / 2 - places, places) / ratio
        power = shots.amplitude[shots.row[points]] ** 2
        k = np.arange(bins) / ratio
        line = window_transform(shots.window, k - places[..., None])
        image = window_transform(shots.window, k + places[..., None])
        both = (power[..., None] * (line * line + image * image)).sum(axis=1)
        pseudo = (power[..., None] * 2 * line * image).sum(axis=1)
        row[s, points] = sum(map(len, rows)) + np.arange(points.size)
        rows.append(np.where(both > 1e-12 * both.max(axis=1)[:, None], pseudo, 0.0))
        rows[-1] /= np.maximum(both, 1e-300)
        rows[-1][:, 0] = 1.0
        of_bins = both[..., None] * (1 + rows[-1][..., None] * COSINES)
        peak = np.take_along_axis(of_bins, both.argmax(axis=1)[:, None, None], axis=1)[:, 0]
        factor = peak if shots.detection == "peak_bin" else of_bins.max(axis=1)
        largest = both.max(axis=1)[:, None]
        factors.append(np.where(largest > 0, factor / np.maximum(largest, 1e-300), 1.0))
    return SignalQuadratures(row, np.concatenate(rows), np.concatenate(factors))


def mean_over_angles(
    factors: np.ndarray,
    chances: tuple[np.ndarray, ...],
    law: Callable[..., tuple[np.ndarray, ...]],
) -> tuple[np.ndarray, ...]:
    """Average a joint law of detection over the phases of the segments' noncircular echoes.

    Parameters
    ----------
    factors
        (segments, n, ANGLES): relative echo power at the phase nodes, as of
        :class:`SignalQuadratures`.
    chances
        For each segment (..., n): probability that it is detected.
    law
        Function of the segments' probabilities for circular numbers; returns arrays (..., n).

    Returns
    -------
    tuple of numpy.ndarray
        Mean over the phases of each result of ``law``, (..., n).

    Notes
    -----
    At the phase t a bin is detected like a circular number of f = 1 + q cos t times the power, with
    exp(-A / f); A is solved for, so that the mean over t is the given probability. Phases of
    different segments are independent.
    """
    turned = [_at_angles(*of_segment) for of_segment in zip(chances, factors, strict=True)]
    total: list[np.ndarray] = []
    for j in range(ANGLES):
        # No two segments have the same order of phases.
        results = law(*(each[(1 + 2 * s) * j % ANGLES] for s, each in enumerate(turned)))
        total = [a + b for a, b in zip(total, results, strict=True)] if total else list(results)
    return tuple(value / ANGLES for value in total)


def _at_angles(chance: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Return detection probabilities exp(-A / f) at all phase nodes, (ANGLES, ..., n).

    A is found by bisection so that their mean over the nodes is ``chance`` (..., n).
    """
    factors = factors.T.reshape(ANGLES, *[1] * (chance.ndim - 1), -1)
    there = np.isfinite(chance)
    wanted = np.where(there, chance, 0.5)
    low, high = np.zeros(chance.shape), np.full(chance.shape, 700.0)
    for _ in range(50):
        a = 0.5 * (low + high)
        above = np.exp(-a / factors).mean(axis=0) > wanted
        low, high = np.where(above, a, low), np.where(above, high, a)
    return np.where(there, np.exp(-0.5 * (low + high) / factors), np.nan)


def lines_near_end(shots: Any) -> np.ndarray:
    """Mark points whose lines overlap their own images at DC or Nyquist, bool (segments, n)."""
    reach = _reach(shots.window) * shots.fft_size / shots.window.length
    place = centre_lines(shots)
    edge = np.minimum(place, shots.fft_size / 2 - place)
    return np.asarray(edge - 3 * shots.line_spread < reach)


@lru_cache(maxsize=64)
def number_of_bins(window: Window, fft_size: int) -> int:
    """Return the number of bins, counted from DC, whose pseudo-variance is tabulated."""
    beyond = (_reach(window) + main_lobe(window) + 1) * fft_size / window.length
    return min(math.ceil(beyond) + 1, fft_size // 4 + 1)


@lru_cache(maxsize=64)
def noise_quadratures(window: Window, fft_size: int) -> np.ndarray:
    """Return the pseudo-variance ratio W2(2k) / W2(0) of white noise by bin k, (bins,)."""
    squares = samples(window.name, window.length) ** 2
    time = (np.arange(window.length) - window.length / 2) / fft_size
    bins = np.arange(number_of_bins(window, fft_size))
    found = [(squares * np.cos(4 * np.pi * k * time)).sum() / squares.sum() for k in bins]
    return np.where(np.abs(found) > 1e-12, found, 0.0)


def _reach(window: Window) -> float:
    """Return the distance of a line from DC [bins of fs/L] beyond which its image is negligible."""
    far = window.reach[np.argmax(window.envelope < SHARE_MIN / 2)]
    return 0.5 * min(float(far), 12.0)


_LEAST_STRENGTH = 1e-7
"""Part of the looks' power below which an independent amplitude is left out."""


def faded_looks(
    looks: Looks, signal: np.ndarray, level: np.ndarray, shares: np.ndarray, noise: np.ndarray,
    covariance: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return pd and 1 - pd of a bin near DC or Nyquist for several looks in developed speckle.

    Parameters
    ----------
    signal, level
        (m,): root mean square |X| and threshold over the noise per quadrature of one look.
    shares, noise
        (m,): pseudo-variance ratio q of the signal, and of the noise.
    covariance
        (m, k, k) complex: that of the looks' echoes, of mean power 1, with the turn of the line's
        phase from look to look. k = N looks, or fewer that represent them.

    Notes
    -----
    Let g_k be the echo's amplitude in look k. Bin X_k = u_k + i v_k has the quadratures
    ``u = sqrt(1 + q) Re g``, ``v = sqrt(1 - q) Im g`` times the root of the signal's power, for the
    line and its image have the phases of g and of its conjugate. Their 2N numbers are Gaussian. So
    the sum of all |X_k|^2 is one of independent squared Gaussian variables, whose variances are the
    eigenvalues of the quadratures' covariance matrix.

    Of votes the probability given the amplitudes is averaged over a fixed lattice of them, as of
    looks far from DC. Of noise whose quadratures differ in part the probabilities of circular and
    of real noise are averaged.
    """
    power = np.square(signal)
    if looks.combine == POWER:
        sides = np.stack([np.sqrt(1 + shares), np.sqrt(np.maximum(1 - shares, 0.0))], axis=1)
        few = covariance.shape[-1]
        real, turned = covariance.real, covariance.imag
        quarters = np.block([[real, -turned], [turned, real]])
        scale = np.repeat(sides, few, axis=1)
        scale *= np.sqrt(0.5 * power * looks.number / few)[:, None]
        noise_power = np.stack([1 + noise, 1 - noise], axis=1)
        matrix = scale[:, :, None] * scale[:, None, :] * quarters
        matrix += np.repeat(noise_power, few, axis=1)[:, :, None] * np.eye(2 * few)
        variance = np.concatenate([np.linalg.eigvalsh(matrix), noise_power], axis=1)
        shape = np.full(variance.shape, 0.5)
        shape[:, 2 * few :] = 0.5 * (looks.number - few)  # looks that others represent: noise
        mean = 2 * np.maximum(variance, 0.0)
        return power_sum_tails(shape, mean, looks.number * np.square(level))
    found = np.empty(signal.shape)
    for i, matrix in enumerate(covariance):
        number = matrix.shape[-1]

        def mean_votes(amplitudes: np.ndarray, i: int = i) -> float:
            magnitude = np.hypot(
                math.sqrt(1 + shares[i]) * amplitudes.real,
                math.sqrt(max(1 - shares[i], 0.0)) * amplitudes.imag,
            )
            part = abs(float(noise[i]))
            mean = 0.0
            for is_real, weight in ((True, part), (False, 1 - part)):
                if weight > 0:
                    given = votes_given_speckle(
                        signal[i], level[i], looks.votes, magnitude, is_real
                    )
                    mean += weight * float(given.mean())
            return mean

        q = (power[i] * shares[i] + 2 * noise[i]) / (power[i] + 2)
        lone = np.array(hoyt_pair(power[i] + 2, abs(q), level[i]))
        found[i] = looks.votes_of(*lone)[0]
        independence = (number**2 / np.square(np.abs(matrix)).sum() - 1) / max(number - 1, 1)
        if independence < 1 - 1e-9:
            value, vector = np.linalg.eigh(matrix)
            used = value > _LEAST_STRENGTH * number
            root = vector[:, used] * np.sqrt(value[used])
            # Less the lattice's error for independent looks, in proportion.
            apart = found[i] - mean_votes(independent_speckles(number))
            together = mean_votes(independent_speckles(int(used.sum())) @ root.T)
            found[i] = together + independence * apart
    found = np.clip(found, 0.0, 1.0)
    return found, 1 - found
