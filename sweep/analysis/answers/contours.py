"""Lines of constant probability of detection over two coordinates."""

from __future__ import annotations

import numpy as np
import xarray as xr
from contourpy import contour_generator
from scipy.special import ndtri

from sweep.analysis.answers.limits import deviate
from sweep.analysis.answers.physical import coordinate
from sweep.analysis.answers.probability import named


def contour(
    dataset: xr.Dataset,
    pd: float = 0.9,
    *,
    x: str = "range",
    y: str = "grazing_angle",
    segment: str = "shot",
) -> xr.Dataset:
    """Lines along which the probability of detection is at a level.

    Parameters
    ----------
    dataset
        As `sweep.open` gives it; of any dimension other than the two one value selected.
    pd
        The level, 0 < pd < 1.
    x, y
        Coordinates, each with a dimension of its own.
    segment
        ``shot``, ``up``, ``doppler`` or ``down``.

    Returns
    -------
    xarray.Dataset
        Over `vertex`: the two coordinates in their units, and `line`, the number of the line that
        the vertex is of, in order along it; none where pd is nowhere at the level. Between the
        grid's points, places are interpolated as :mod:`sweep.analysis.answers.limits` does.

    Raises
    ------
    ValueError
        A coordinate that is not there, or further dimensions.
    """
    if not 0 < pd < 1:
        raise ValueError(f"a level of pd lies between 0 and 1, and {pd!r} does not")
    across, up = coordinate(dataset, x), coordinate(dataset, y)
    array = dataset[named("pd", segment)]
    if set(array.dims) != {across.name, up.name}:
        others = ", ".join(str(d) for d in array.dims if d not in (across.name, up.name))
        raise ValueError(
            f"a contour goes over {across.name} and {up.name} as dimensions: "
            + (f"select one value along {others}" if others else "they share one, or lack it")
        )
    z = deviate(array, dataset.get(named("miss", segment))).transpose(up.name, across.name)
    found = contour_generator(
        across.values, up.values, np.ma.masked_invalid(z.values)
    ).lines(float(ndtri(pd)))  # fmt: skip
    lines = [np.asarray(line) for line in found]
    vertices = np.concatenate(lines) if lines else np.empty((0, 2))
    numbers = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    return xr.Dataset(
        {
            str(across.name): ("vertex", vertices[:, 0], across.attrs),
            str(up.name): ("vertex", vertices[:, 1], up.attrs),
            "line": ("vertex", numbers, {"units": "1", "long_name": "number of the line"}),
        },
        attrs=dataset.attrs,
    )
