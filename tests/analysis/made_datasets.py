"""Datasets like those of stores, with values that are known in closed form."""

import numpy as np
import xarray as xr
from scipy.special import ndtr

import sweep.analysis.opening  # noqa: F401

PATHS = {"range": "target.range", "grazing_angle": "target.grazing_angle"}
UNITS = {"range": "m", "grazing_angle": "deg"}


def made(z, half_width=None, **coordinates):
    """A dataset whose pd has the normal deviates z (an array over the coordinates, in order)."""
    dims = list(coordinates)
    z = np.asarray(z, float)
    variables = {"pd_shot": (dims, ndtr(z)), "miss_shot": (dims, ndtr(-z))}
    if half_width is not None:
        width, about = np.full(z.shape, half_width), {"confidence": 0.95}
        variables["pd_shot_half_width"] = (dims, width, about)
    dataset = xr.Dataset(
        variables,
        {
            name: ([name], np.asarray(values, float), {"units": UNITS[name], "path": PATHS[name]})
            for name, values in coordinates.items()
        },
        {"title": "Made"},
    )
    dataset.pd_shot.attrs = {"units": "1", "long_name": "probability of detection, shot"}
    return dataset
