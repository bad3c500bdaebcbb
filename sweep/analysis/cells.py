"""Arrays of any size reduced to as many cells as a picture or a page can hold, chunk by chunk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import dask.array
import numpy as np
import xarray as xr

from sweep.analysis import labels

MEAN, LOWEST, HIGHEST = "mean", "lowest", "highest"


@dataclass(frozen=True)
class Side:
    """A dimension as a figure runs along it.

    Attributes
    ----------
    dim
        The dimension.
    positions : (n,) int ndarray
        Places along it, in the order of rising values.
    values : (n,) ndarray
        The coordinate there.
    """

    dim: str
    positions: np.ndarray
    values: np.ndarray

    def together(self, most: int) -> int:
        """How many neighbours a cell stands for, so that there are `most` cells or fewer."""
        return 1 if labels.is_words(self.values) else together(self.values.size, most)

    def middles(self, most: int) -> np.ndarray:
        """Mean value of the coordinate in each cell."""
        return middles(self.values, self.together(most))


def reduced(
    array: xr.DataArray, sides: Sequence[tuple[Side, int]], at: Mapping[str, int], kind: str
) -> xr.DataArray:
    """An array in cells along some sides, at one place along its other dimensions; not computed.

    Parameters
    ----------
    array
        Of a store, in its chunks; or in memory.
    sides
        Each with the largest number of its cells.
    at
        Places along the other dimensions.
    kind
        ``mean``, ``lowest`` or ``highest`` of the values in a cell; nan only where all are.
    """
    chosen = {
        side.dim: side.positions
        for side, _ in sides
        if not np.array_equal(side.positions, np.arange(array.sizes[side.dim]))
    }
    array = known(array.isel(dict(at)).isel(chosen))
    array = array.transpose(*(side.dim for side, _ in sides))
    by = [side.together(most) for side, most in sides]
    if max(by) == 1:
        return array
    return xr.DataArray(_in_cells(array.chunk().data, kind, by), dims=array.dims)


def _in_cells(data: dask.array.Array, kind: str, by: Sequence[int]) -> dask.array.Array:
    """Cells of `by` values along each axis: first within the pieces, then across their borders."""
    cells = [_cells_of(own, number) for own, number in zip(data.chunks, by, strict=True)]
    tallies = data.map_blocks(
        _of_piece,  # type: ignore[arg-type]
        kind, by, dtype=float, new_axis=data.ndim,
        chunks=(*(tuple(part.size for part in own) for own in cells), (1 + (kind == MEAN),)),
    )  # fmt: skip
    numbers = [np.concatenate(own) for own in cells]
    return tallies.rechunk(-1).map_blocks(
        lambda whole: told(
            gathered(whole, kind, [np.unique(n, return_index=True)[1] for n in numbers]),
            kind,
        ),
        dtype=float, drop_axis=data.ndim, chunks=tuple((int(n[-1]) + 1,) for n in numbers),
    )  # fmt: skip


def _cells_of(lengths: Sequence[int], by: int) -> list[np.ndarray]:
    """Numbers of the cells that pieces of some lengths have a part of."""
    ends = np.cumsum(lengths)
    starts = ends - lengths
    return [
        np.arange(first // by, (last - 1) // by + 1)
        for first, last in zip(starts, ends, strict=True)
    ]


def _of_piece(values: np.ndarray, kind: str, by: Sequence[int], block_info: Any) -> np.ndarray:
    """Tallies of the cells that a piece has a part of."""
    places = [first for first, _ in block_info[0]["array-location"]]
    starts = [
        np.maximum(np.arange(-(place % number), size, number), 0)
        for place, number, size in zip(places, by, values.shape, strict=True)
    ]
    return gathered(tallied(values, kind), kind, starts)


def known(array: xr.DataArray) -> xr.DataArray:
    """An array as floats; nan where a count is not made yet."""
    return array if array.dtype.kind == "f" else array.astype(float).where(array >= 0)


def together(number: int, most: int) -> int:
    """How many neighbours a cell stands for, so that there are `most` cells or fewer."""
    return -(-number // most)


def middles(along: np.ndarray, by: int) -> np.ndarray:
    """Mean value of a coordinate in each cell of `by` neighbours; of words the first."""
    if by == 1:
        return along
    starts = np.arange(0, along.size, by)
    if labels.is_words(along):
        return along[starts]
    return np.add.reduceat(along, starts) / np.diff(starts, append=along.size)


def tallied(values: np.ndarray, kind: str) -> np.ndarray:
    """What is gathered of values (...), in a further last dimension."""
    if kind != "mean":
        return values[..., np.newaxis]
    missing = np.isnan(values)
    return np.stack([np.where(missing, 0.0, values), ~missing], axis=-1)


def gathered(tallies: np.ndarray, kind: str, starts: Sequence[np.ndarray]) -> np.ndarray:
    """Tallies of cells that begin at some places along each axis, from those of their values."""
    ufunc = {"mean": np.add, "lowest": np.fmin, "highest": np.fmax}[kind]
    for axis, places in enumerate(starts):
        if places.size < tallies.shape[axis]:
            tallies = ufunc.reduceat(tallies, places, axis=axis)
    return tallies


def told(tallies: np.ndarray, kind: str) -> np.ndarray:
    """Values of cells (...) from their tallies."""
    if kind != "mean":
        return tallies[..., 0]
    total, number = tallies[..., 0], tallies[..., 1]
    return np.where(number > 0, total / np.maximum(number, 1.0), np.nan)
