"""Limits along an axis at which pd falls below a level: maximum range, least grazing angle.

Between two points of the grid the place is interpolated in the normal deviate z(pd), pd = Phi(z).
Q_1(a, b) is near Phi(a - b): z follows the signal's amplitude and is nearly a straight line where
pd itself bends from 1 to 0. Digits near 1 come from the probability of a miss.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from contourpy import contour_generator
from scipy.special import ndtri

from sweep.analysis.answers.physical import coordinate, probability_level, require_variables
from sweep.analysis.answers.probability import confidence, half_width, named

FOUND, NEVER, ALWAYS, NOT_COMPUTED = range(4)
REASONS = "found never_reached never_lost not_computed"

_COMPLEMENT_ERROR_MAX = 1e-6
"""Largest difference of pd + miss from 1 that rounding and means leave."""

_FARTHEST = 38.0
"""Normal deviate of the least positive float, in place of those of 0 and 1."""


def deviate(pd: xr.DataArray, miss: xr.DataArray | None = None) -> xr.DataArray:
    """Return the normal deviate z of pd = Phi(z), from the probability of a miss above one half.

    ValueError where the two probabilities do not add to 1 [when the result is computed].
    """
    lost = 1 - pd if miss is None else miss

    def of(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        if (np.abs(p + q - 1) > _COMPLEMENT_ERROR_MAX).any():
            raise ValueError(
                "the probabilities of detection and of a miss do not add to 1, as after a maximum "
                "or minimum of the dataset: ask for the answer first, of the whole dataset, and "
                "compare its values then. A value without a limit is nan, for the reason in "
                "unbroken_reason (such as never_lost: beyond the last value), and max() and min() "
                "pass over it"
            )
        z = np.where(p < 0.5, p, q)
        ndtri(z, out=z)
        np.negative(z, out=z, where=p >= 0.5)
        return np.clip(z, -_FARTHEST, _FARTHEST, out=z)

    return xr.apply_ufunc(of, pd, lost, dask="parallelized", output_dtypes=[float])


def limit(
    dataset: xr.Dataset,
    along: str,
    pd: float | str = 0.9,
    *,
    segment: str = "shot",
    from_highest: bool = False,
) -> xr.Dataset:
    """Farthest value of a coordinate up to which the probability of detection keeps to a level.

    pd need not fall steadily: scalloping and interference make dips. So there are two answers.

    Parameters
    ----------
    along
        Coordinate, each value of it once; those of a zipped axis after a selection.
    pd
        The level, 0 < pd < 1, as 0.9 or "90 %".
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
        - `unbroken_reason`, `farthest_reason`: flags for the reason of a nan. Either pd is below
          the level at the first value (or at all of them), or it is not below the level up to the
          last value, or a deciding value is not computed.

        `unbroken_low`, `unbroken_high` and so on are the answers with the lower and the upper ends
        of pd's intervals, if it is drawn.

    Raises
    ------
    ValueError
        No such coordinate or level, one value only, or one that comes more than once.
    """
    level = probability_level(pd)
    x = coordinate(dataset, along)
    name = named("pd", segment)
    require_variables(dataset, name)
    ordered, dim = _ordered(dataset, x, from_highest)
    lost = ordered.get(named("miss", segment))
    found = _answers(ordered[name], lost, ordered[x.name], dim, level)
    reach = half_width(ordered, segment)
    if reach is not None:
        for end, sign in (("low", -1), ("high", 1)):
            moved = (ordered[name] + sign * reach).clip(0, 1)
            ends = _answers(moved, None, ordered[x.name], dim, level)
            found |= {f"{key}_{end}": a for key, a in ends.items() if not key.endswith("reason")}
    result = xr.Dataset(found).assign_attrs(dataset.attrs)
    return _described(result, x, segment, level, confidence(dataset, reach))


def maximum_range(
    dataset: xr.Dataset, pd: float | str = 0.9, *, segment: str = "shot"
) -> xr.Dataset:
    """Range up to which pd keeps to a level, unbroken and at all: :func:`limit`."""
    return limit(dataset, "target.range", pd, segment=segment)


def minimum_grazing_angle(
    dataset: xr.Dataset, pd: float | str = 0.9, *, segment: str = "shot"
) -> xr.Dataset:
    """Least grazing angle down to which pd keeps to a level: :func:`limit`."""
    return limit(dataset, "target.grazing_angle", pd, segment=segment, from_highest=True)


def _ordered(dataset: xr.Dataset, x: xr.DataArray, from_highest: bool) -> tuple[xr.Dataset, str]:
    """Sort a dataset by a coordinate, in the direction of the search; its dimension."""
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
    """Both answers and their reasons.

    Places are counted in steps along the axis, so that they rise whichever way it is walked; those
    that there are none of are infinite.
    """
    z = deviate(pd, miss) - float(ndtri(level))
    steps = xr.DataArray(np.arange(float(x.size)), dims=[dim])
    after = z.shift({dim: -1})
    falls = (z >= 0) & (after < 0)
    places = steps + z / (z - after).where(falls, 1.0)
    break_at, unknown_from = (_first(places, falls, dim), _first(steps, z.isnull(), dim))
    left_at, unknown_to = (-_first(-places, falls, dim), -_first(-steps, z.isnull(), dim))
    starts, ends = (z.isel({dim: end}, drop=True) >= 0 for end in (0, -1))
    unbroken = xr.where(
        unknown_from < xr.where(starts, break_at, 0.5),
        NOT_COMPUTED,
        xr.where(~starts, NEVER, xr.where(np.isinf(break_at), ALWAYS, FOUND)),
    )
    farthest = xr.where(
        unknown_to > xr.where(ends, float(x.size), left_at),
        NOT_COMPUTED,
        xr.where(ends, ALWAYS, xr.where(np.isinf(left_at), NEVER, FOUND)),
    )
    return {
        "unbroken": _value(break_at.where(unbroken == FOUND), x),
        "farthest": _value(left_at.where(farthest == FOUND), x),
        "unbroken_reason": unbroken.astype("int8"),
        "farthest_reason": farthest.astype("int8"),
    }


def _first(places: xr.DataArray, chosen: xr.DataArray, dim: str) -> xr.DataArray:
    """Least of the chosen places along a dimension; infinity where none is chosen."""
    return xr.where(chosen, places, np.inf).min(dim, skipna=False)


def _value(place: xr.DataArray, x: xr.DataArray) -> xr.DataArray:
    """Value of a coordinate at a place counted in steps along it; nan stays."""
    steps = np.arange(x.size, dtype=float)
    return xr.apply_ufunc(
        lambda p: np.interp(p, steps, x.values), place, dask="parallelized", output_dtypes=[float]
    )


def _described(
    result: xr.Dataset, x: xr.DataArray, segment: str, level: float, sure: dict[str, float]
) -> xr.Dataset:
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
            array.attrs |= sure if end else {}
    return result


def contour(
    dataset: xr.Dataset,
    pd: float | str = 0.9,
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
        The level, 0 < pd < 1, as 0.9 or "90 %".
    x, y
        Coordinates, each with a dimension of its own.
    segment
        ``shot``, ``up``, ``doppler`` or ``down``.

    Returns
    -------
    xarray.Dataset
        Over `vertex`: the two coordinates in their units, and `line`, the number of the line that
        the vertex is of, in order along it; none where pd is nowhere at the level. Between the
        grid's points, places are interpolated in the normal deviate.

    Raises
    ------
    ValueError
        A coordinate that is not there, or further dimensions.
    """
    level = probability_level(pd)
    across, up = coordinate(dataset, x), coordinate(dataset, y)
    name = named("pd", segment)
    require_variables(dataset, name)
    array = dataset[name]
    if set(array.dims) != {across.name, up.name}:
        others = ", ".join(str(d) for d in array.dims if d not in (across.name, up.name))
        raise ValueError(
            f"a contour goes over {across.name} and {up.name} as dimensions: "
            + (f"select one value along {others}" if others else "they share one, or lack it")
        )
    z = deviate(array, dataset.get(named("miss", segment))).transpose(up.name, across.name)
    found = contour_generator(
        across.values, up.values, np.ma.masked_invalid(z.values)
    ).lines(float(ndtri(level)))  # fmt: skip
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
