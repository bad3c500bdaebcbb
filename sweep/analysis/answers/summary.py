"""A whole store in a few numbers of every output."""

from __future__ import annotations

import dask.array
import numpy as np
import xarray as xr

STATISTICS = ("mean", "least", "largest", "number")


def summary(dataset: xr.Dataset) -> xr.Dataset:
    """Mean, extremes and number of the computed points of every output.

    Parameters
    ----------
    dataset
        As `sweep.open` gives it, or a part of it.

    Returns
    -------
    xarray.Dataset
        Every variable of floats over `statistic`, lazy; nan where no point is finite. The store
        goes through memory chunk by chunk, each chunk once.
    """
    result = xr.Dataset(coords={"statistic": list(STATISTICS)}, attrs=dataset.attrs)
    for name, array in dataset.data_vars.items():
        if array.dtype.kind == "f":
            result[name] = xr.DataArray(_reduced(array), dims=["statistic"], attrs=array.attrs)
    return result


def _reduced(array: xr.DataArray) -> dask.array.Array:
    """The statistics of an array, (4,)."""
    data = array.chunk().data if array.chunks is None else array.data
    axis = data.ndim
    parts = data.map_blocks(
        _of_block, dtype=float, new_axis=axis, chunks=(*((1,) * n for n in data.numblocks), (4,))
    )
    return parts.reshape(-1, 4).rechunk(-1).map_blocks(
        _of_all, dtype=float, drop_axis=0, chunks=((4,),)
    )  # fmt: skip


def _of_block(block: np.ndarray) -> np.ndarray:
    """Sum, extremes and number of the finite values of a block, (1, .., 1, 4)."""
    known = block[np.isfinite(block)]
    least, largest = (known.min(), known.max()) if known.size else (np.inf, -np.inf)
    return np.array([known.sum(), least, largest, known.size]).reshape((1,) * block.ndim + (4,))


def _of_all(parts: np.ndarray) -> np.ndarray:
    """The statistics of all blocks together, from (blocks, 4)."""
    number = parts[:, 3].sum()
    if not number:
        return np.array([np.nan, np.nan, np.nan, 0.0])
    return np.array([parts[:, 0].sum() / number, parts[:, 1].min(), parts[:, 2].max(), number])
