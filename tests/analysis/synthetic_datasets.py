"""Datasets like those of stores, with values that are known in closed form."""

import numpy as np
import xarray as xr
from scipy.special import ndtr

import sweep.analysis.datasets  # noqa: F401

PATH_BY_NAME = {"range": "target.range", "grazing_angle": "target.grazing_angle"}
UNITS_BY_NAME = {"range": "m", "grazing_angle": "deg"}


def dataset_of_deviates(deviates, half_width=None, **coordinates):
    """A dataset whose pd has the normal deviates z (an array over the coordinates, in order)."""
    dims = list(coordinates)
    deviates = np.asarray(deviates, float)
    variables = {"pd_shot": (dims, ndtr(deviates)), "miss_shot": (dims, ndtr(-deviates))}
    if half_width is not None:
        half_widths, attributes = np.full(deviates.shape, half_width), {"confidence": 0.95}
        variables["pd_shot_half_width"] = (dims, half_widths, attributes)
    dataset = xr.Dataset(
        variables,
        {
            name: (
                [name],
                np.asarray(values, float),
                {"units": UNITS_BY_NAME[name], "path": PATH_BY_NAME[name]},
            )
            for name, values in coordinates.items()
        },
        {"title": "Made"},
    )
    dataset.pd_shot.attrs = {"units": "1", "long_name": "probability of detection, shot"}
    return dataset
