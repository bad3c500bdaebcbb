"""A whole store in a few numbers of every output."""

from __future__ import annotations

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
        Every variable of floats over `statistic`, lazy. The store goes through memory piece by
        piece, once for all variables if they are computed together.
    """
    result = xr.Dataset(coords={"statistic": list(STATISTICS)}, attrs=dataset.attrs)
    for name, array in dataset.data_vars.items():
        if array.dtype.kind == "f":
            parts = [array.mean(), array.min(), array.max(), np.isfinite(array).sum().astype(float)]
            joined = xr.concat(
                [p.drop_vars(list(p.coords)) for p in parts], dim="statistic", coords="minimal"
            )
            result[name] = joined.assign_attrs(array.attrs)
    return result
