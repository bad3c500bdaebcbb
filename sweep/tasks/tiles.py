"""Tiles: boxes of neighbouring points of a grid, for each of which effects are planned at once.

They are fixed by the grid alone, not by its blocks: what is simulated at a point does not depend on
how a study is cut up. Points of one tile share every word and every size that sets the length of
arrays.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sweep.tasks.grid import Grid, Value

#: Points of a tile at the most: few enough that they are much alike, enough that planning is cheap.
TILE_POINTS = 1024

#: Numbers that set the length of records, or how closely all is computed.
UNDIVIDED = (
    "instrument.processing.fft_size",
    "instrument.processing.sample_rate",
    "instrument.processing.acquisition_delay",
    "instrument.chirp.duration",
    "footprint.beamlets",
    "accuracy.tolerance",
)


class Alike(NamedTuple):
    """Tiles that share every word and size."""

    code: int
    """The same for all tiles of the grid that share them."""
    tiles: np.ndarray
    """(m,): their numbers among those asked for."""
    parameters: dict[str, Value]
    """By dotted path: words, numbers, and arrays that broadcast over (m, *tile): tiles that the
    grid's edge cuts have their last points several times."""


class Tiles:
    """Tiles of a grid.

    Parameters
    ----------
    grid
        The grid.
    """

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self._undivided = tuple(self._is_undivided(k) for k in range(len(grid.dims)))
        self.shape = tile_shape(grid.shape, self._undivided)
        self.along = tuple(-(-n // s) for n, s in zip(grid.shape, self.shape, strict=True))

    @property
    def number(self) -> int:
        """Tiles of the whole grid."""
        return math.prod(self.along)

    def of_block(self, block: int) -> tuple[np.ndarray, np.ndarray]:
        """Tiles that a block meets, and where each of its points lies among them.

        Returns
        -------
        tiles : (m,) ndarray of int
            Numbers of tiles, in C order over the grid of tiles.
        place : (points,) ndarray of int
            Index into them of each point of the block, in C order over the block.
        """
        along = [
            np.arange(s.start, s.stop) // side
            for s, side in zip(self.grid.block(block), self.shape, strict=True)
        ]
        mesh = np.ix_(*along) if along else ()
        numbers = np.ravel_multi_index(mesh, self.along) if along else np.zeros((), np.int64)
        tiles, place = np.unique(numbers, return_inverse=True)
        return tiles, place.ravel()

    def alike(self, tiles: np.ndarray, every: int = 1) -> Iterator[Alike]:
        """Parameters of the points of some tiles, those together that share words and sizes.

        ``every``: of every so manieth point along each axis, and of those with the largest value
        of each parameter.
        """
        positions = np.unravel_index(tiles, self.along) if self.along else ()
        codes = np.zeros(len(tiles), np.int64)
        for k, position in enumerate(positions):
            if self._undivided[k]:
                codes = codes * self.along[k] + position
        for code in np.unique(codes) if any(self._undivided) else codes[:1]:
            chosen = np.flatnonzero(codes == code)
            parameters: dict[str, Value] = {**self.grid.fixed}
            for k, position in enumerate(positions):
                parameters |= self._along(k, position[chosen], every)
            yield Alike(int(code), chosen, parameters)

    def points(self, tile: int) -> tuple[slice, ...]:
        """Slices of a tile along each axis, cut at the edge of the grid."""
        position = np.unravel_index(tile, self.along) if self.along else ()
        return tuple(
            slice(int(p) * side, min((int(p) + 1) * side, size))
            for p, side, size in zip(position, self.shape, self.grid.shape, strict=True)
        )

    def _is_undivided(self, axis: int) -> bool:
        from sweep.model.shot import SHARED

        return any(
            values.dtype.kind in "UO" or path in UNDIVIDED or path in SHARED
            for path, values in self.grid.values[axis].items()
        )

    def _along(self, axis: int, position: np.ndarray, every: int) -> dict[str, Value]:
        members = self.grid.values[axis]
        if self._undivided[axis]:
            first = int(position[0])
            return {path: values[first].item() for path, values in members.items()}
        side, size = self.shape[axis], self.grid.shape[axis]
        within = np.minimum(position[:, None] * side + np.arange(side), size - 1)
        index = within[:, ::every]
        if every > 1:  # with the largest of each, so that none is missed that is there at all
            furthest = [np.abs(v[within].astype(float)).argmax(axis=1) for v in members.values()]
            rows = np.arange(len(position))[:, None]
            index = np.hstack([index, within[rows, np.transpose(furthest)]])
        shape = [len(position), *(1,) * len(self.shape)]
        shape[axis + 1] = index.shape[1]
        index = index.reshape(shape)
        return {path: values[index].astype(float) for path, values in members.items()}


def tile_shape(sizes: tuple[int, ...], undivided: tuple[bool, ...]) -> tuple[int, ...]:
    """Points of a tile along each axis: alike on all, but 1 where values are not to be joined."""
    shape, room = [1] * len(sizes), TILE_POINTS
    free = sorted((k for k in range(len(sizes)) if not undivided[k]), key=lambda k: sizes[k])
    for done, k in enumerate(free):
        shape[k] = min(sizes[k], max(1, int(room ** (1 / (len(free) - done)) + 1e-9)))
        room //= shape[k]
    return tuple(shape)
