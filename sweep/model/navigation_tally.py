"""Errors of navigation summed up over draws: results that add.

A tally holds counts, means and sums of squared deviations, so that tallies of parts give that of
the whole. Sums of floats depend on their order: keep one tally for each unit of work and merge
them on reading, in the order of the units, and no number of workers can change the result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Tally:
    """Errors of a vector of m components, by cell (of altitude, scan pattern, ...).

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

        The update of Chan, Golub and LeVeque (1983), which never subtracts large sums. Adding is
        commutative and associative only up to rounding: see :func:`merge`.
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


def tally(
    error: np.ndarray,
    covariance: np.ndarray,
    *,
    available: np.ndarray,
    cells: Sequence[np.ndarray] = (),
    shape: Sequence[int] = (),
) -> Tally:
    """Tally of n solutions by cell.

    Parameters
    ----------
    error : (n, m) array_like
        Solution less truth; not looked at where not available.
    covariance : (n, m, m) array_like
        What each solution states of its error.
    available : (n,) array_like of bool
        Whether there is a solution.
    cells : sequence of (n,) array_like of int
        Index of each solution along each dimension of `shape`. One that is outside of it (as
        ``np.digitize(altitude, edges) - 1`` gives for altitudes outside the edges) leaves the
        solution out.
    shape : sequence of int
        Number of altitude bins, of scan patterns, ...; without any, all is one cell.

    Raises
    ------
    ValueError
        `cells` and `shape` differ in length, or the arrays in n.
    """
    error, covariance = np.asarray(error, float), np.asarray(covariance, float)
    available, shape = np.asarray(available, bool), tuple(shape)
    n, m = error.shape
    if covariance.shape != (n, m, m) or available.shape != (n,) or len(cells) != len(shape):
        raise ValueError("a tally needs (n, m), (n, m, m), (n,) and one index for each dimension")
    inside = np.ones(n, bool)
    flat = np.zeros(n, np.int64)
    for index, size in zip(cells, shape, strict=True):
        index = np.asarray(index, np.int64)
        inside &= (index >= 0) & (index < size)
        flat = flat * size + index
    size = math.prod(shape)
    attempts = np.bincount(flat[inside], minlength=size)
    held = inside & available
    sums = _sums(error[held], covariance[held], flat[held], size)
    parts = (attempts.astype(np.int64), *sums)
    return Tally(*(part.reshape(shape + part.shape[1:]) for part in parts))


def _sums(
    error: np.ndarray, covariance: np.ndarray, cell: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Count, mean, deviation and mean covariance by cell, in two passes for the digits' sake."""
    count = np.bincount(cell, minlength=size).astype(np.int64)
    some = np.maximum(count, 1)
    mean = _add_up(error, cell, size) / some[:, None]
    apart = error - mean[cell]
    rest = _add_up(apart, cell, size) / some[:, None]  # what rounding left in the mean
    deviation = _add_up(apart[:, :, None] * apart[:, None, :], cell, size)
    predicted = _add_up(covariance, cell, size) / some[:, None, None]
    return count, mean + rest, deviation, predicted


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
