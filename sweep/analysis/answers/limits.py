"""Where a probability of detection falls below a level along an axis: maximum range, least angle.

Between two points of the grid the place is interpolated in the normal deviate z(pd), pd = Phi(z):
Q_1(a, b) is near Phi(a - b), so that z follows the signal's amplitude and is nearly a straight line
where pd itself bends from 1 to 0. Digits near 1 come from the probability of a miss.

Everything is a reduction of pairs of neighbours, so that it is lazy, and a store larger than memory
goes through piece by piece.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from scipy.special import ndtri

from sweep.analysis.answers.physical import coordinate
from sweep.analysis.answers.probability import half_width, named

FOUND, NEVER, ALWAYS, NOT_COMPUTED = range(4)
REASONS = "found never_reached never_lost not_computed"

_FARTHEST = 38.0
"""Normal deviate of the least positive float, in place of those of 0 and 1."""


def deviate(pd: xr.DataArray, miss: xr.DataArray | None = None) -> xr.DataArray:
    """Normal deviate z of pd = Phi(z), from the probability of a miss above one half."""
    lost = 1 - pd if miss is None else miss

    def of(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return np.clip(np.where(p < 0.5, ndtri(p), -ndtri(q)), -_FARTHEST, _FARTHEST)

    return xr.apply_ufunc(of, pd, lost, dask="parallelized", output_dtypes=[float])


def limit(
    dataset: xr.Dataset,
    along: str,
    *,
    pd: float = 0.9,
    segment: str = "shot",
    from_highest: bool = False,
) -> xr.Dataset:
    """How far along a coordinate the probability of detection keeps to a level.

    pd need not fall steadily: scalloping and interference make dips. So there are two answers.

    Parameters
    ----------
    dataset
        As `sweep.open` gives it, or a part of it.
    along
        Coordinate, each value of it once; those of a zipped axis after a selection.
    pd
        The level, 0 < pd < 1.
    segment
        ``shot``, ``up``, ``doppler`` or ``down``.
    from_highest
        Whether to go from the largest value to the smallest, as for grazing angles.

    Returns
    -------
    xarray.Dataset
        In the coordinate's units, over what other dimensions there are; lazy:

        - `unbroken`: the farthest value up to which pd is at the level or above all the way;
        - `farthest`: the farthest value at which pd is at the level at all;
        - `unbroken_reason`, `farthest_reason`: flags that say why there is none (nan): pd is
          below the level at the very first value (or at all of them), or is not below it up to
          the last, or what decides is not computed.

        Where pd is drawn, `unbroken_low`, `unbroken_high` and so on are the answers with the
        lower and the upper ends of its intervals.

    Raises
    ------
    ValueError
        No such coordinate or level, one value only, or one that comes more than once.
    """
    if not 0 < pd < 1:
        raise ValueError(f"a level of pd lies between 0 and 1, and {pd!r} does not")
    x = coordinate(dataset, along)
    name = named("pd", segment)
    ordered, dim = _ordered(dataset, x, from_highest)
    lost = ordered.get(named("miss", segment))
    found = _answers(ordered[name], lost, ordered[x.name], dim, pd)
    reach = half_width(ordered, segment)
    if reach is not None:
        for end, sign in (("low", -1), ("high", 1)):
            moved = (ordered[name] + sign * reach).clip(0, 1)
            ends = _answers(moved, None, ordered[x.name], dim, pd)
            found |= {f"{key}_{end}": a for key, a in ends.items() if not key.endswith("reason")}
    result = xr.Dataset(found).assign_attrs(dataset.attrs)
    return _described(result, x, segment, pd)


def _ordered(dataset: xr.Dataset, x: xr.DataArray, from_highest: bool) -> tuple[xr.Dataset, str]:
    """The dataset in the order in which the coordinate is walked, and its dimension."""
    if x.ndim != 1 or x.size < 2:
        raise ValueError(f"{x.name} has a single value: there is nothing to go along")
    order = np.argsort(x.values, kind="stable")
    values = x.values[order]
    if (values[1:] == values[:-1]).any():
        raise ValueError(
            f"{x.name} has a value more than once: select by the other coordinates along "
            f"'{x.dims[0]}' first"
        )
    order = order[::-1] if from_highest else order
    if (order == np.arange(order.size)).all():
        return dataset, str(x.dims[0])
    return dataset.isel({x.dims[0]: order}), str(x.dims[0])


def _answers(
    pd: xr.DataArray, miss: xr.DataArray | None, x: xr.DataArray, dim: str, level: float
) -> dict[str, xr.DataArray]:
    """Both answers and their reasons."""
    z = deviate(pd, miss) - float(ndtri(level))
    steps = xr.DataArray(np.arange(x.size, dtype=float), dims=[dim])
    first, last = {dim: slice(None, -1)}, {dim: slice(1, None)}
    here, there = _bare(z.isel(first), dim), _bare(z.isel(last), dim)
    falls = (here >= 0) & (there < 0)
    # Places are counted in steps along the axis, so that they rise whichever way it is walked.
    place = steps.isel(first) + here / xr.where(falls, here - there, 1.0)
    break_at = place.where(falls, np.inf).min(dim)
    left_at = place.where(falls, -np.inf).max(dim)
    z = _bare(z, dim)
    unknown = z.isnull()
    first_unknown = steps.where(unknown, np.inf).min(dim)
    last_unknown = steps.where(unknown, -np.inf).max(dim)
    starts, ends = z.isel({dim: 0}) >= 0, z.isel({dim: -1}) >= 0
    unbroken = xr.where(
        first_unknown < xr.where(starts, break_at, 0.5),
        NOT_COMPUTED,
        xr.where(~starts, NEVER, xr.where(np.isinf(break_at), ALWAYS, FOUND)),
    )
    farthest = xr.where(
        last_unknown > xr.where(ends, float(x.size), left_at),
        NOT_COMPUTED,
        xr.where(ends, ALWAYS, xr.where(np.isinf(left_at), NEVER, FOUND)),
    )
    return {
        "unbroken": _value(break_at.where(unbroken == FOUND), x),
        "farthest": _value(left_at.where(farthest == FOUND), x),
        "unbroken_reason": unbroken.astype("int8"),
        "farthest_reason": farthest.astype("int8"),
    }


def _bare(array: xr.DataArray, dim: str) -> xr.DataArray:
    """An array without coordinates along a dimension, so that neighbours meet."""
    names = [name for name, c in array.coords.items() if dim in c.dims]
    return array.drop_vars(names)


def _value(place: xr.DataArray, x: xr.DataArray) -> xr.DataArray:
    """Value of a coordinate at a place counted in steps along it; nan stays."""
    steps = np.arange(x.size, dtype=float)
    return xr.apply_ufunc(
        lambda p: np.interp(p, steps, x.values), place, dask="parallelized", output_dtypes=[float]
    )


def _described(result: xr.Dataset, x: xr.DataArray, segment: str, level: float) -> xr.Dataset:
    """Units and words of the answers."""
    words = {
        "unbroken": f"farthest {x.name} up to which pd of the {segment} stays {level:g} or more",
        "farthest": f"farthest {x.name} at which pd of the {segment} is {level:g} or more",
    }
    for name, array in result.data_vars.items():
        kind = str(name).split("_")[0]
        if str(name).endswith("reason"):
            array.attrs = {
                "long_name": f"why there is no {kind} value", "units": "1",
                "flag_values": [FOUND, NEVER, ALWAYS, NOT_COMPUTED], "flag_meanings": REASONS,
            }  # fmt: skip
        else:
            end = {"low": ", lower end", "high": ", upper end"}.get(str(name).split("_")[-1], "")
            array.attrs = {"units": x.attrs.get("units", ""), "long_name": words[kind] + end}
    return result
