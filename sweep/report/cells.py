"""Arrays of any size reduced to as many cells as a page can hold, chunk by chunk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.analysis import surface

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
        return 1 if surface.is_words(self.values) else -(-self.values.size // most)

    def middles(self, most: int) -> np.ndarray:
        """Mean value of the coordinate in each cell."""
        if self.together(most) == 1:
            return self.values
        row = surface.Grid(self.values, np.zeros(1), np.zeros((1, self.values.size)))
        return surface.reduced(row, MEAN, most, 1).x


def reduced(
    array: xr.DataArray, sides: Sequence[tuple[Side, int]], at: Mapping[str, int], kind: str
) -> xr.DataArray:
    """An array in cells along some sides, at one place along its other dimensions; not computed.

    Parameters
    ----------
    array
        Of a store, in its chunks.
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
    by = {side.dim: side.together(most) for side, most in sides}
    if all(number == 1 for number in by.values()):
        return array
    cells = array.drop_vars(list(array.coords)).coarsen(by, boundary="pad")  # type: ignore[arg-type]
    return {MEAN: cells.mean, LOWEST: cells.min, HIGHEST: cells.max}[kind]()


def known(array: xr.DataArray) -> xr.DataArray:
    """An array as floats; nan where a count is not made yet."""
    return array if array.dtype.kind == "f" else array.astype(float).where(array >= 0)
