"""Means over a Gaussian beam by few nodes: how many a spectrum's spread over bins calls for.

Where beamlets add as powers, the mean power of a bin is that of |W(k - f)|^2 over the beam, f being
nearly proportional to one coordinate along the slope. |W|^2 is band-limited: with r the window's
autocorrelation over lags of -1..1 records, normalised to sum 1, and s the standard deviation of f
in bins of fs/L, a rule of nodes x_j and weights w_j is off by

    integral |r(tau)| |sum_j w_j cos(2 pi s tau x_j) - exp(-(2 pi s tau)^2 / 2)| dtau

at most, in units of the power that one line on a bin has there: by what the rule makes of cosines
up to 2 pi s. Gauss and Hermite's rule is best for narrow spreads; for wide ones even steps are, as
they are all but exact up to where they alias.
"""

import math
from functools import lru_cache

import numpy as np

from sweep.model.effects.lobes import Lobe, lobe
from sweep.model.window import samples

HERMITE = 15
"""Nodes up to which the rule is Gauss and Hermite's."""

REACH = 7.0
"""Standard deviations on either side over which more nodes step evenly; 3e-12 is beyond."""

COUNTS = np.array(
    [
        2,
        3,
        4,
        5,
        6,
        7,
        9,
        11,
        15,
        22,
        33,
        49,
        73,
        109,
        163,
        244,
        366,
        549,
        823,
        1234,
        1851,
        2776,
        4096,
    ]
)
"""Numbers of nodes to choose from; wide steps, as points of different numbers go apart."""

_FLOOR = 1e-10
"""Error of even steps, for what lies beyond their reach."""
_SAMPLES, _LAGS = 1024, 4096
_CHEBYSHEV = np.array([1.4, 1.8, 2.5, 4.0, 8.0])[:, None]


@lru_cache(maxsize=64)
def gaussian_rule(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights for the mean over the standard normal distribution, (number,) each.

    The weights sum to 1; the mean is 0 and, from two nodes on, the variance 1.
    """
    if number <= HERMITE:
        nodes, weights = np.polynomial.hermite_e.hermegauss(number)
    else:
        nodes = np.linspace(-REACH, REACH, number)
        weights = np.exp(-0.5 * nodes**2)
    weights /= weights.sum()
    if number > HERMITE:
        nodes /= math.sqrt((weights * nodes**2).sum())
    return nodes, weights


def nodes_needed(
    window_name: str, deviation: np.ndarray, tolerance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Nodes with which the largest bin's power is within a tolerance, or as near as any are.

    Parameters
    ----------
    window_name : str
        Canonical name of the record's window.
    deviation : (n,) ndarray
        Standard deviation of the lines' places [bins of fs/L], >= 0.
    tolerance : (n,) ndarray
        On the largest bin's power, over that power itself, wherever the lines lie.

    Returns
    -------
    number : (n,) int64 ndarray
        Nodes, 2 at least.
    error : (n,) ndarray
        What they may be off by; 1 for spreads beyond all that is provided for, 400 bins.
    """
    spreads, errors = _errors(window_name)
    off = errors[:, np.searchsorted(spreads, deviation)]  # of the next wider spread
    serves = off <= tolerance
    best = np.where(off.min(axis=0) < 1, off.argmin(axis=0), COUNTS.size - 1)
    rung = np.where(serves.any(axis=0), serves.argmax(axis=0), best)
    return COUNTS[rung], np.take_along_axis(off, rung[None], axis=0)[0]


@lru_cache(maxsize=32)
def _errors(window_name: str) -> tuple[np.ndarray, np.ndarray]:
    """Deviations (m,), and the error of each count up to each and beyond all, (counts, m + 1)."""
    spreads = np.geomspace(1e-3, 400.0, 96)
    least = _largest_bin(lobe(window_name, _SAMPLES, _SAMPLES), spreads)
    lag = (np.arange(_LAGS) + 0.5) / _LAGS
    weight = _autocorrelation(window_name, lag)
    errors = np.ones((COUNTS.size, spreads.size + 1))
    for row, number in zip(errors, COUNTS.tolist(), strict=True):
        for i, spread in enumerate(spreads.tolist()):
            row[i] = (weight * _departure(number, 2 * np.pi * spread * lag)).sum() / least[i]
            if row[i] > 1:
                row[i:] = 1.0  # wider spreads are no better
                break
    return spreads, np.maximum.accumulate(errors, axis=1)


def _largest_bin(shape: Lobe, deviation: np.ndarray) -> np.ndarray:
    """Least power of the largest bin, over that of all lines on a bin: as of `power_range`."""
    narrow = shape.worst**2 - 0.5 * shape.curvature * deviation**2
    wide = (1 - 1 / _CHEBYSHEV**2) * shape.energy
    return np.maximum(
        narrow, (wide / (2 * _CHEBYSHEV * deviation + 2 * shape.margin + 1)).max(axis=0)
    )


def _autocorrelation(window_name: str, lag: np.ndarray) -> np.ndarray:
    """|r| at lags [records] of both signs, in shares of their sum with sign."""
    w = samples(window_name, _SAMPLES)
    r = np.fft.irfft(np.abs(np.fft.rfft(w, 2 * _SAMPLES)) ** 2)[: _SAMPLES + 1]
    at_lags = np.interp(lag * _SAMPLES, np.arange(_SAMPLES + 1), r)
    return np.asarray(np.abs(at_lags) / at_lags.sum())


def _departure(number: int, turn: np.ndarray) -> np.ndarray:
    """How far a rule's mean of cos(turn x) may be from exp(-turn^2 / 2)."""
    if number <= HERMITE:
        x, w = gaussian_rule(number)
        mean = (w * np.cos(turn[:, None] * x)).sum(axis=1)
        return np.asarray(np.abs(mean - np.exp(-0.5 * turn**2)))
    step = 2 * REACH / (number - 1)
    past = turn - 2 * np.pi / step  # even steps repeat themselves there
    return np.asarray(np.where(past < 0, np.exp(-0.5 * past**2), 1.0) + _FLOOR)
