"""Means over a Gaussian beam by few nodes: how many a spectrum's spread over bins calls for.

Where beamlets add as powers, the mean power of a bin is that of |W(k - f)|^2 over the beam, f being
nearly proportional to one coordinate along the slope. |W|^2 is band-limited: with r the window's
autocorrelation over lags of -1..1 records, normalised to sum 1, and s the standard deviation of f
in bins of fs/L, a rule of nodes x_j and weights w_j is off by

    integral |r(tau)| |sum_j w_j cos(2 pi s tau x_j) - exp(-(2 pi s tau)^2 / 2)| dtau

at most, in units of the power that one line on a bin has there: by what the rule makes of cosines
up to 2 pi s. Gauss and Hermite's rule is best for narrow spreads; for wide ones even steps are, as
they are all but exact up to where they alias.

To second order the range rises with the square of the distance from the axis, across the slope as
along it: f = s y + c (x^2 + y^2), where E exp(i t c x^2) = 1 / sqrt(1 - 2 i t c). A line of nodes
at x = 1 has the mean of x^2, and misses (t c)^2 at the most. More lines lie at the positive nodes
of a rule of twice as many:

    x ^      .  .  .  .  .      3 lines of 5 nodes, weighted by the Gaussians of x and y;
      |      .  .  .  .  .      as f is even in x, there is no need of their mirror images
      |      .  .  .  .  .
      +-----------------------> y, along the slope
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.accuracy import Accuracy
from sweep.model.effects.lobes import Lobe, lobe
from sweep.model.window import samples

HERMITE = 15
"""Nodes up to which the rule is Gauss and Hermite's."""

REACH = 7.0
"""Standard deviations on either side over which more nodes step evenly; 3e-12 is beyond."""

COUNTS = np.array([
    2, 3, 4, 5, 6, 7, 9, 11, 15, 22, 33, 49, 73, 109, 163, 244, 366, 549, 823, 1234, 1851, 2776,
    4096,
])  # fmt: skip
"""Numbers of nodes to choose from; wide steps, as points of different numbers go apart."""

LINES = np.array([1, 2, 3, 5, 7, 11, 16, 24, 32])
"""Numbers of parallel lines of nodes to choose from."""

_FLOOR = 1e-10
"""Error of even steps, for what lies beyond their reach."""
_SAMPLES, _LAGS = 1024, 4096
_CURVES = np.geomspace(1e-6, 100.0, 97)
_CURVED_LAGS, _CURVED_TURNS, _RATIOS = (
    512,
    np.geomspace(1e-6, 1e3, 512),
    np.geomspace(1e-6, 1e3, 97),
)
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


class Spread(NamedTuple):
    """Places of a footprint's lines, s y + c (x^2 + y^2), in bins of fs/L."""

    deviation: np.ndarray
    """(n,): most of |s|, steeper where the plane is, over the segments."""
    slope: np.ndarray
    """(segments, n): |s| of each segment."""
    curve: np.ndarray
    """(segments, n): |c| of each segment."""

    @property
    def smoothing(self) -> np.ndarray:
        """Deviation that smooths what lines miss across the slope, (segments, n).

        |E exp(i t (s y + c y^2))| <= exp(-(t s)^2 / 2 / (1 + (2 t c)^2)), and t <= 2 pi.
        """
        return np.asarray(self.slope / np.sqrt(1 + (4 * np.pi * self.curve) ** 2))


def nodes_needed(
    window_name: str, spread: Spread, tolerance: np.ndarray, accuracy: Accuracy
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes with which the largest bin's power is within a tolerance, or as near as any are.

    Parameters
    ----------
    window_name : str
        Canonical name of the record's window.
    spread : Spread
        Of n points.
    tolerance : (n,) ndarray
        On the largest bin's power, over that power itself, wherever the lines lie.
    accuracy : Accuracy
        Says how many nodes all lines together may have, and when several lines are tried.

    Returns
    -------
    lines : (n,) int64 ndarray
        Parallel lines of nodes, 1 for most points.
    number : (n,) int64 ndarray
        Nodes of each line, 2 at least.
    error : (n,) ndarray
        What they may be off by; 1 where they say nothing.
    """
    spreads, errors, least = _errors(window_name)
    place = np.searchsorted(spreads, spread.deviation)  # of the next wider spread
    missed = _of_one_line(window_name, spread) / least[place]
    counts = COUNTS[: np.searchsorted(COUNTS, accuracy.most_beamlets, "right")]
    total = errors[: counts.size, place] + missed
    rung, error = _cheapest(total, counts[:, None], tolerance)
    lines = np.ones(rung.shape, np.int64)
    several = (error > tolerance) & (missed > accuracy.one_line_share * tolerance)
    if several.any():
        some = Spread(*(np.asarray(values)[..., several] for values in spread))
        rungs, further, left = _of_lines(
            window_name, some, tolerance[several], accuracy.most_beamlets
        )
        better = left < np.minimum(error[several], 1.0)
        some = np.flatnonzero(several)[better]
        rung[some], lines[some], error[some] = rungs[better], further[better], left[better]
    return lines, COUNTS[rung], np.minimum(error, 1.0)


def _cheapest(
    error: np.ndarray, cost: np.ndarray, tolerance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Row of the cheapest (rows, n) whose error is tolerated, or of the least error; its error."""
    price = np.where(error <= tolerance, cost, np.inf)
    row = np.where(np.isfinite(price).any(axis=0), price.argmin(axis=0), error.argmin(axis=0))
    return row, np.take_along_axis(error, row[None], axis=0)[0]


def _of_lines(
    window_name: str, spread: Spread, tolerance: np.ndarray, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row of :data:`COUNTS`, lines and error for spreads that one line of nodes misses."""
    spreads, errors, least = _errors(window_name)
    along, across = _curved_errors(window_name)
    curve, slope = spread.curve.max(axis=0), spread.slope.max(axis=0)
    # Where squares alone spread the lines, what the rules make of squares is all that counts.
    steep = spread.deviation * np.minimum(slope / curve, 1.0)
    largest = least[np.searchsorted(spreads, spread.deviation)]
    place = np.searchsorted(_CURVES, curve)
    off = errors[:, np.searchsorted(spreads, steep)] + along[:, place] / largest
    missed = np.zeros((LINES.size, curve.size))
    for s, c in zip(spread.smoothing, spread.curve, strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.searchsorted(_RATIOS, np.where(s > 0, c / s, np.inf))
            smooth = _smoothed_errors()[:, ratio] * (_peak(window_name) / (2 * np.pi * s))
        here = np.fmin(across[:, np.searchsorted(_CURVES, c)], smooth)
        missed = np.maximum(missed, here / largest)
    total = off[:, None] + missed
    cost = COUNTS[:, None] * LINES
    total = np.where((cost <= most)[..., None], total, np.inf).reshape(-1, curve.size)
    best, error = _cheapest(total, cost.reshape(-1, 1), tolerance)
    return best // LINES.size, LINES[best % LINES.size], error


def _of_one_line(window_name: str, spread: Spread) -> np.ndarray:
    """Error of one line of nodes by squares, over the power of a line on a bin, (n,).

    As much again is for what the fewest nodes along the slope miss of them.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        density = _peak(window_name) / (2 * np.pi * spread.smoothing)
        smooth = density * math.sqrt(np.pi / 2) * (spread.curve / spread.smoothing) ** 2
    form = lobe(window_name, _SAMPLES, _SAMPLES)
    return np.asarray(2 * np.fmin(form.curvature * spread.curve**2, smooth).max(axis=0))


@lru_cache(maxsize=32)
def _errors(window_name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of each count by deviation, over the largest bin's power; and that power.

    Deviations (m,), errors (counts, m + 1) up to each and beyond all, largest bins (m + 1,).
    """
    spreads = np.geomspace(1e-3, 400.0, 96)
    least = _largest_bin(lobe(window_name, _SAMPLES, _SAMPLES), spreads)
    lag = (np.arange(_LAGS) + 0.5) / _LAGS
    weight = _autocorrelation(window_name, lag)
    errors = np.empty((COUNTS.size, spreads.size + 1))
    for row, number in zip(errors, COUNTS.tolist(), strict=True):
        row[:] = np.append(_boundless(spreads, number), np.inf)
        for i, spread in enumerate(spreads.tolist()):
            off = (weight * _departure(number, 2 * np.pi * spread * lag)).sum() / least[i]
            if off > 1:
                break  # wider spreads are no better
            row[i] = off
        row[-1] = _boundless(1e3, number)
    return spreads, np.maximum.accumulate(errors, axis=1), np.append(least, least[-1])


def _boundless(spread: ArrayLike, number: int) -> np.ndarray:
    """Stand-in for errors without a bound, 1 or more: the nodes' distance [bins]."""
    return np.maximum(1.0, 2 * REACH * np.asarray(spread) / number)


@lru_cache(maxsize=32)
def _curved_errors(window_name: str) -> tuple[np.ndarray, np.ndarray]:
    """Errors by curve, over the power of a line on a bin: of counts along, of lines across."""
    lag = (np.arange(_CURVED_LAGS) + 0.5) / _CURVED_LAGS
    weight = _autocorrelation(window_name, lag)
    turn = 2 * np.pi * lag * _CURVES[:, None]

    def of(number: int) -> np.ndarray:
        off = (weight * np.interp(turn, _CURVED_TURNS, _curved_departure(number))).sum(axis=1)
        return np.append(np.where(off < 1, off, _boundless(_CURVES, number)), 1e3)

    along, across = COUNTS.tolist(), (2 * LINES).tolist()
    return np.array([of(number) for number in along]), np.array([of(number) for number in across])


@lru_cache(maxsize=1)
def _smoothed_errors() -> np.ndarray:
    """Mean of what lines miss of squares, over a Gaussian 1 / ratio wide, (lines, ratios + 1)."""
    turn = np.linspace(0.0, 8.0, 801)[1:]
    weight = np.exp(-0.5 * turn**2) * (turn[1] - turn[0])
    found = np.full((LINES.size, _RATIOS.size + 1), np.inf)
    for row, lines in zip(found, LINES.tolist(), strict=True):
        off = np.interp(turn * _RATIOS[:, None], _CURVED_TURNS, _curved_departure(2 * lines))
        row[:-1] = (weight * off).sum(axis=1)
    return found


@lru_cache(maxsize=64)
def _curved_departure(number: int) -> np.ndarray:
    """How far a rule's mean of exp(i turn x^2) may be from 1 / sqrt(1 - 2 i turn), up to turns."""
    x, w = gaussian_rule(number)
    mean = np.array([(w * np.exp(1j * turn * x**2)).sum() for turn in _CURVED_TURNS.tolist()])
    return np.maximum.accumulate(np.abs(mean - 1 / np.sqrt(1 - 2j * _CURVED_TURNS)))


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


@lru_cache(maxsize=32)
def _peak(window_name: str) -> float:
    """Largest density of the autocorrelation over lags [1/record]."""
    lag = (np.arange(_LAGS) + 0.5) / _LAGS
    return float(_autocorrelation(window_name, lag).max()) * _LAGS


def _departure(number: int, turn: np.ndarray) -> np.ndarray:
    """How far a rule's mean of cos(turn x) may be from exp(-turn^2 / 2)."""
    if number <= HERMITE:
        x, w = gaussian_rule(number)
        mean = (w * np.cos(turn[:, None] * x)).sum(axis=1)
        return np.asarray(np.abs(mean - np.exp(-0.5 * turn**2)))
    step = 2 * REACH / (number - 1)
    past = turn - 2 * np.pi / step  # even steps repeat themselves there
    return np.asarray(np.where(past < 0, np.exp(-0.5 * past**2), 1.0) + _FLOOR)
