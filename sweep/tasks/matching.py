"""Which points of one grid are points of another: those whose parameters have the same values.

Axes may be longer, in another order, new, or zipped otherwise. Points are looked up axis by axis,
so that two grids of any size cost the lengths of their axes and no more.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from typing import NamedTuple

import numpy as np

from sweep.tasks.grid import Lattice, Value, canonical_rows


class Places(NamedTuple):
    """Where the values of some parameters in one grid stand along an axis of another."""

    paths: tuple[str, ...]
    axis: int | None
    """Axis of the grid that is looked in; None for parameters that are fixed there."""
    where: np.ndarray
    """int64, of the shape of the grid that is looked from, but 1 along axes without any of these
    parameters: index along that axis, -1 where it lacks the values."""


class Matching:
    """Points along the axes of one study by the points of another.

    Parameters
    ----------
    other, grid
        Those that are looked in, and those that are looked from.
    ignored
        Dotted paths of parameters that may differ.
    """

    def __init__(self, other: Lattice, grid: Lattice, ignored: Collection[str] = ()) -> None:
        self._other = other
        self.places = [
            _places(grid, axis, {path: v for path, v in values.items() if path not in ignored})
            for axis, values in _parts(other, grid)
        ]

    def of(self, slices: tuple[slice, ...]) -> np.ndarray:
        """Numbers, in C order over the other grid, of some points; -1 of those it lacks.

        Parameters
        ----------
        slices
            Of the grid that is looked from, one an axis.

        Returns
        -------
        ndarray of int64 (points,)
        """
        numbers = np.zeros((1,) * len(slices), np.int64)
        lacking = np.zeros((1,) * len(slices), bool)
        for places in self.places:
            varies = [size > 1 for size in places.where.shape]
            part = (s if v else slice(None) for s, v in zip(slices, varies, strict=True))
            index = places.where[tuple(part)]
            lacking = lacking | (index < 0)
            if places.axis is not None:
                numbers = numbers + index * math.prod(self._other.shape[places.axis + 1 :])
        numbers = np.where(lacking, -1, numbers)
        return np.broadcast_to(numbers, [s.stop - s.start for s in slices]).ravel()


def _parts(other: Lattice, grid: Lattice) -> Iterator[tuple[int | None, dict[str, np.ndarray]]]:
    """Parameters that are looked up together: those of each axis, and all that are fixed."""
    yield from enumerate(other.values)
    on_axes = {path for values in other.values for path in values}
    fixed = {path: np.array([v]) for path, v in other.fixed.items() if path not in on_axes}
    for values in grid.values:
        yield None, {path: fixed.pop(path) for path in values if path in fixed}
    yield None, fixed


def _places(grid: Lattice, axis: int | None, values: dict[str, np.ndarray]) -> Places:
    """Where values of a grid stand among others of the same parameters, which go together."""
    along = [k for k, own in enumerate(grid.values) if not own.keys().isdisjoint(values)]
    shape = tuple(size if k in along else 1 for k, size in enumerate(grid.shape))
    index = [i.ravel() for i in np.indices([grid.shape[k] for k in along])]
    wanted: dict[str, Value] = {path: grid.fixed[path] for path in values}
    for k, i in zip(along, index, strict=True):
        wanted |= {path: a[i] for path, a in grid.values[k].items() if path in wanted}
    number = len(next(iter(values.values()))) if values else 1
    rows = canonical_rows(values, number)
    found = _looked_up(rows, canonical_rows(wanted, math.prod(shape)))
    return Places(tuple(values), axis, found.reshape(shape))


def _looked_up(rows: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Index of each wanted row, (m,), among rows (n, columns); -1 of those that are not there."""
    if not rows.shape[1]:
        return np.zeros(len(wanted), np.int64)
    both = np.concatenate([rows, wanted]).view(np.uint64)
    codes = np.unique(both, axis=0, return_inverse=True)[1].ravel()
    place = np.full(len(both), -1)
    place[codes[: len(rows)]] = np.arange(len(rows))
    return place[codes[len(rows) :]]
