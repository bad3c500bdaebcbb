"""Errors of navigation by altitude: how often there is a solution, its bias and its scatter."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import xarray as xr

from sweep.analysis.scenes.opening import chunk, stretches
from sweep.analysis.scenes.recording import Recording
from sweep.model.navigation import EXCLUDED, SOLVED

VELOCITY, ALTITUDE = "velocity", "altitude"

STRETCH = 65_536
"""Solutions that are read at a time, about."""


@dataclass(frozen=True, eq=False)
class Tally:
    """Errors of a vector of m components, by bin of altitude: counts, means, squared deviations.

    Tallies of parts add up to that of the whole. Sums of floats depend on their order: see
    :func:`merge`.

    Parameters
    ----------
    attempts, count : (...,) int64 ndarray
        Solutions asked for, and those that there were.
    mean : (..., m) ndarray
        Mean error; 0 where there was none.
    deviation : (..., m, m) ndarray
        Sum of the products of deviations from the mean.
    predicted : (..., m, m) ndarray
        Mean of the covariances that the solutions came with; 0 where there was none.
    """

    attempts: np.ndarray
    count: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray
    predicted: np.ndarray

    def __add__(self, other: Tally) -> Tally:
        """Tally of both, of two sets of draws that share none.

        The update of Chan, Golub and LeVeque (1983), which never subtracts large sums.
        """
        count = self.count + other.count
        share = (other.count / np.maximum(count, 1))[..., None]
        apart = other.mean - self.mean
        between = (self.count[..., None] * share * apart)[..., None] * apart[..., None, :]
        return Tally(
            self.attempts + other.attempts,
            count,
            self.mean + share * apart,
            self.deviation + other.deviation + between,
            self.predicted + share[..., None] * (other.predicted - self.predicted),
        )

    @property
    def availability(self) -> np.ndarray:
        """Share of attempts with a solution (...,), 0..1; nan without attempts."""
        return _over(self.count, self.attempts)

    @property
    def bias(self) -> np.ndarray:
        """Mean error (..., m); nan without solutions."""
        return np.where(self.count[..., None] > 0, self.mean, np.nan)

    @property
    def rmse(self) -> np.ndarray:
        """Root mean square error of each component (..., m), bias included; nan without any."""
        square = np.diagonal(self.deviation, axis1=-2, axis2=-1)
        return np.sqrt(_over(square, self.count[..., None]) + self.mean**2)

    @property
    def covariance(self) -> np.ndarray:
        """Unbiased covariance of the errors (..., m, m); nan with fewer than two solutions."""
        return _over(self.deviation, self.count[..., None, None] - 1)

    @property
    def predicted_covariance(self) -> np.ndarray:
        """Mean covariance that the solutions stated (..., m, m); nan without any."""
        return np.where(self.count[..., None, None] > 0, self.predicted, np.nan)


@dataclass(frozen=True)
class Curve:
    """Errors of one scanner's solutions, by bins of true altitude.

    Attributes
    ----------
    scanner, words : str
        Its name, and what else tells the curve from others.
    edges : (bins + 1,) ndarray
        Altitudes between the bins [m], rising.
    tally : Tally
        Errors by bin, of three components or one.
    """

    scanner: str
    edges: np.ndarray
    tally: Tally

    @property
    def middle(self) -> np.ndarray:
        """Altitudes in the middle of the bins [m]."""
        return (self.edges[1:] + self.edges[:-1]) / 2

    @property
    def bias(self) -> np.ndarray:
        """Mean error of each component, (bins, m)."""
        return self.tally.bias

    @property
    def bias_error(self) -> np.ndarray:
        """Standard error of the bias (bins, m); nan with fewer than two solutions."""
        variance = np.diagonal(self.tally.covariance, axis1=-2, axis2=-1)
        return np.sqrt(variance / np.maximum(self.tally.count, 1)[:, None])

    @property
    def rmse(self) -> np.ndarray:
        """Root mean square error of each component and of the vector's length, (bins, m [+ 1])."""
        return _with_length(self.tally.rmse)

    @property
    def predicted(self) -> np.ndarray:
        """Standard deviation that solutions state of themselves, as `rmse`: root of the mean."""
        variance = np.diagonal(self.tally.predicted_covariance, axis1=-2, axis2=-1)
        return _with_length(np.sqrt(variance))


def _with_length(parts: np.ndarray) -> np.ndarray:
    """Components (..., m), and of vectors the root of the sum of their squares after them."""
    if parts.shape[-1] == 1:
        return parts
    return np.concatenate([parts, np.linalg.norm(parts, axis=-1, keepdims=True)], axis=-1)


def navigates(recording: Recording) -> bool:
    """Whether a scanner has solutions: its cycles have three shots or more."""
    return "velocity_status" in recording.dataset


def curves(recordings: Sequence[Recording], *, quantity: str, bins: int) -> list[Curve]:
    """Errors of scanners that navigate, all over the same bins of altitude.

    Solutions are read chunk by chunk; each stretch has a tally of its own, and the tallies are
    merged in the order of the stretches, so that the result is the same to the last bit.

    Parameters
    ----------
    recordings
        What the scanners recorded.
    quantity
        ``velocity`` or ``altitude``.
    bins
        Number of bins, of one width, from the lowest altitude to the highest.
    """
    able = [recording for recording in recordings if navigates(recording)]
    edges = _edges(able, bins)
    if edges is None:
        return []
    return [
        Curve(recording.scanner, edges, merge(list(_tallies(recording.dataset, quantity, edges))))
        for recording in able
    ]


def _edges(recordings: Sequence[Recording], bins: int) -> np.ndarray | None:
    """Edges of the bins; none where no cycle's altitude is known."""
    lows, highs = [], []
    for recording in recordings:
        altitude = recording.dataset["true_altitude"]
        for part in stretches(altitude, "cycle", STRETCH):
            known = np.asarray(altitude.isel(cycle=part).values)
            known = known[np.isfinite(known)]
            if known.size:
                lows.append(float(known.min()))
                highs.append(float(known.max()))
    if not lows:
        return None
    low, high = min(lows), max(highs)
    if high - low < 1e-6 * max(abs(high), 1.0):
        low, high, bins = low - 0.5, high + 0.5, 1
    edges = np.linspace(low, high, bins + 1)
    edges[-1] = np.nextafter(high, np.inf)  # the highest cycle is in the last bin
    return edges


def _tallies(dataset: xr.Dataset, quantity: str, edges: np.ndarray) -> Iterator[Tally]:
    status = dataset[f"{quantity}_status"]
    draws_a_chunk = chunk(status, "draw")
    draws = stretches(status, "draw", draws_a_chunk)
    cycles = stretches(status, "cycle", max(1, STRETCH // draws_a_chunk))
    for cycle, draw in product(cycles, draws):
        part = dataset.isel(cycle=cycle, draw=draw)
        solved, error, covariance = _errors(part, quantity)
        altitude = np.broadcast_to(np.asarray(part["true_altitude"].values)[:, None], solved.shape)
        computed = np.asarray(part[f"{quantity}_status"].values).ravel() >= SOLVED
        cell = np.digitize(np.nan_to_num(altitude.ravel(), nan=-np.inf), edges) - 1
        cell = np.where(computed, cell, -1)
        yield tally(error, covariance, solved.ravel(), cell, edges.size - 1)


def _errors(part: xr.Dataset, quantity: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether there is a solution (cycles, draws); its error (n, m) and covariance (n, m, m)."""
    status = np.asarray(part[f"{quantity}_status"].values)
    solved = (status >= SOLVED) & (status <= EXCLUDED)
    found, true = (np.asarray(part[n].values) for n in (quantity, f"true_{quantity}"))
    error = found - true[:, None]
    stated = "velocity_covariance" if quantity == VELOCITY else "altitude_variance"
    size = 3 if quantity == VELOCITY else 1
    return solved, error.reshape(-1, size), np.asarray(part[stated].values).reshape(-1, size, size)


def tally(
    error: np.ndarray, covariance: np.ndarray, available: np.ndarray, cell: np.ndarray, cells: int
) -> Tally:
    """Tally of n solutions by cell, in two passes for the digits' sake.

    Parameters
    ----------
    error : (n, m) ndarray
        Solution less truth; ignored where not available.
    covariance : (n, m, m) ndarray
        Covariance that each solution states.
    available : (n,) bool ndarray
        Mask of the solutions that exist.
    cell : (n,) int ndarray
        Cell of each, 0..cells - 1; a solution elsewhere is left out.
    cells : int
        Number of cells.
    """
    inside = (cell >= 0) & (cell < cells)
    attempts = np.bincount(cell[inside], minlength=cells)
    held = inside & available
    error, covariance, cell = error[held], covariance[held], cell[held]
    count = np.bincount(cell, minlength=cells)
    some = np.maximum(count, 1)
    mean = _add_up(error, cell, cells) / some[:, None]
    apart = error - mean[cell]
    rest = _add_up(apart, cell, cells) / some[:, None]  # what rounding left in the mean
    deviation = _add_up(apart[:, :, None] * apart[:, None, :], cell, cells)
    predicted = _add_up(covariance, cell, cells) / some[:, None, None]
    return Tally(attempts, count, mean + rest, deviation, predicted)


def merge(tallies: Sequence[Tally]) -> Tally:
    """Tally of all, added pair by pair: first and second, third and fourth, ..., then again.

    The tree depends on the number of tallies alone, so the same tallies in the same order give
    the same bits, and rounding grows with the logarithm of their number.

    Raises
    ------
    ValueError
        There is none.
    """
    if not tallies:
        raise ValueError("there is no tally to merge")
    level = list(tallies)
    while len(level) > 1:
        pairs = [a + b for a, b in zip(level[::2], level[1::2], strict=False)]
        level = pairs + level[2 * len(pairs) :]
    return level[0]


def _add_up(values: np.ndarray, cell: np.ndarray, size: int) -> np.ndarray:
    """Sums of values (n, ...) by cell (size, ...), each in the order of the rows."""
    columns = values.reshape(len(values), math.prod(values.shape[1:])).T
    sums = [np.bincount(cell, weights=column, minlength=size) for column in columns]
    return np.stack(sums, axis=-1).reshape(size, *values.shape[1:])


def _over(total: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Quotient, nan where the number is not positive."""
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)
