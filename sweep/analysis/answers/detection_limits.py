"""Limits along an axis at which pd falls below a level: maximum range, minimum grazing angle.

Between two grid points the limit is interpolated in the normal deviate z of pd. It is defined by
pd = Phi(z), with the normal distribution function Phi. A steady signal gives pd = Q_1(a, b), the
Marcum function of signal a and threshold b over the noise, which is close to Phi(a - b). Therefore
z follows the signal's amplitude and is almost linear, while pd bends from 1 to 0. Near pd = 1 the
probability of a miss, 1 - pd, supplies the digits.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from contourpy import contour_generator
from scipy.special import ndtri

from sweep.analysis.answers.dataset_lookup import (
    coordinate_by_name_or_path,
    parse_pd_level,
    require_variables,
)
from sweep.analysis.answers.probability import (
    confidence_level_attributes,
    pd_half_width,
    segment_variable_name,
)

LIMIT_FOUND, LEVEL_NEVER_REACHED, LEVEL_NEVER_LOST, LIMIT_NOT_COMPUTED = range(4)
"""Flags for the outcome of a search for the limit, the coordinate where pd falls below a level."""
LIMIT_REASON_MEANINGS = "found never_reached never_lost not_computed"
"""Names of the outcomes of a limit search in the order of their flags, separated by spaces.

They are the value of the CF attribute `flag_meanings`.
"""

_PD_PLUS_MISS_ERROR_MAX = 1e-6
"""Largest accepted deviation of pd plus the probability of a miss from 1, by rounding."""

_NORMAL_DEVIATE_MAX = 38.0
"""Largest magnitude of a normal deviate z; it stands for a pd of 0 or 1.

The normal deviate z of pd is defined by pd = Phi(z), with the normal distribution function Phi.
Phi(-38) is near the smallest positive float.
"""


def normal_deviate(pd: xr.DataArray, miss: xr.DataArray | None = None) -> xr.DataArray:
    """Return the normal deviate z of a probability of detection pd.

    The deviate is defined by pd = Phi(z), with the normal distribution function Phi.

    Parameters
    ----------
    pd
        Probability of detection, 0..1.
    miss
        Probability of a miss, 1 - pd. It supplies the digits of pd above 1/2. By default it is
        computed from pd.

    Returns
    -------
    xarray.DataArray
        Deviate z, clipped to +-38, lazy if `pd` is.

    Raises
    ------
    ValueError
        pd and miss do not add to 1. The error is raised when the result is computed.
    """
    miss_or_complement = 1 - pd if miss is None else miss

    def clipped_deviate(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        if (np.abs(p + q - 1) > _PD_PLUS_MISS_ERROR_MAX).any():
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
        return np.clip(z, -_NORMAL_DEVIATE_MAX, _NORMAL_DEVIATE_MAX, out=z)

    return xr.apply_ufunc(
        clipped_deviate, pd, miss_or_complement, dask="parallelized", output_dtypes=[float]
    )


def limit(
    dataset: xr.Dataset,
    along: str,
    pd: float | str = 0.9,
    *,
    segment: str = "shot",
    from_highest: bool = False,
) -> xr.Dataset:
    """Return the farthest value of a coordinate at which pd still reaches a level.

    pd need not fall monotonically: scalloping and interference make dips. The result therefore has
    two answers, one up to the first dip below the level, and one beyond the last dip.

    Parameters
    ----------
    along
        Coordinate without repeated values. For a coordinate of a zipped axis, select points first.
    pd
        Level, 0 < pd < 1, such as 0.9 or "90 %".
    segment
        ``shot``, ``up``, ``doppler`` or ``down``.
    from_highest
        If true, search from the largest value to the smallest, as for grazing angles.

    Returns
    -------
    xarray.Dataset
        Lazy dataset in the coordinate's units, over the other dimensions:

        - `unbroken`: the farthest value up to which pd is always at or above the level;
        - `farthest`: the farthest value at which pd is at or above the level;
        - `unbroken_reason`, `farthest_reason`: flags with the reason of a nan. `never_reached`: pd
          is below the level at the first value (or at all of them). `never_lost`: pd is not below
          the level up to the last value. `not_computed`: a deciding value is not computed.

        If pd is drawn, `unbroken_low`, `unbroken_high` and so on are the answers for the lower and
        upper ends of pd's intervals.

    Raises
    ------
    ValueError
        The coordinate or level does not exist, or the coordinate has one value only or a repeated
        one.

    Notes
    -----
    Between the last value at the level and the next value below it, the normal deviate z of pd is
    interpolated linearly. It is defined by pd = Phi(z), with the normal distribution function Phi.
    """
    level = parse_pd_level(pd)
    coord = coordinate_by_name_or_path(dataset, along)
    pd_name = segment_variable_name("pd", segment)
    require_variables(dataset, pd_name)
    sorted_dataset, dim = _sort_by_coordinate(dataset, coord, from_highest)
    miss = sorted_dataset.get(segment_variable_name("miss", segment))
    limits = _limits_along_dimension(
        sorted_dataset[pd_name], miss, sorted_dataset[coord.name], dim, level
    )
    interval_half_width = pd_half_width(sorted_dataset, segment)
    if interval_half_width is not None:
        for end, sign in (("low", -1), ("high", 1)):
            shifted_pd = (sorted_dataset[pd_name] + sign * interval_half_width).clip(0, 1)
            shifted_limits = _limits_along_dimension(
                shifted_pd, None, sorted_dataset[coord.name], dim, level
            )
            limits |= {
                f"{key}_{end}": a for key, a in shifted_limits.items() if not key.endswith("reason")
            }
    result = xr.Dataset(limits).assign_attrs(dataset.attrs)
    return _set_limit_attributes(
        result, coord, segment, level, confidence_level_attributes(dataset, interval_half_width)
    )


def maximum_range(
    dataset: xr.Dataset, pd: float | str = 0.9, *, segment: str = "shot"
) -> xr.Dataset:
    """Return the largest range at which the probability of detection is at least ``pd``.

    The result is that of :func:`limit` along the range.
    """
    return limit(dataset, "target.range", pd, segment=segment)


def minimum_grazing_angle(
    dataset: xr.Dataset, pd: float | str = 0.9, *, segment: str = "shot"
) -> xr.Dataset:
    """Return the smallest grazing angle at which the probability of detection is at least ``pd``.

    The result is that of :func:`limit` along the grazing angle, from the largest angle
    downwards.
    """
    return limit(dataset, "target.grazing_angle", pd, segment=segment, from_highest=True)


def _sort_by_coordinate(
    dataset: xr.Dataset, coord: xr.DataArray, from_highest: bool
) -> tuple[xr.Dataset, str]:
    """Return a dataset sorted by a coordinate, and the name of the coordinate's dimension.

    The values rise, or fall with ``from_highest``. Raise ValueError for a single or repeated value.
    """
    if coord.ndim != 1 or coord.size < 2:
        raise ValueError(f"{coord.name} has a single value: there is nothing to go along")
    order = np.argsort(coord.values, kind="stable")
    values = coord.values[order]
    if (values[1:] == values[:-1]).any():
        raise ValueError(
            f"{coord.name} has a value more than once: select by the other coordinates along "
            f"'{coord.dims[0]}' first"
        )
    order = order[::-1] if from_highest else order
    if (order == np.arange(order.size)).all():
        return dataset, str(coord.dims[0])
    return dataset.isel({coord.dims[0]: order}), str(coord.dims[0])


def _limits_along_dimension(
    pd: xr.DataArray, miss: xr.DataArray | None, coord: xr.DataArray, dim: str, level: float
) -> dict[str, xr.DataArray]:
    """Return the two limits of :func:`limit` along a dimension, and their reasons, by name.

    Parameters
    ----------
    pd
        Probability of detection, sorted in the direction of the search.
    miss
        Probability of a miss; None if it is 1 - pd.
    coord
        Coordinate along the dimension.
    dim
        Name of the dimension.
    level
        Level of pd, 0..1.
    """
    z = normal_deviate(pd, miss) - float(ndtri(level))
    steps = xr.DataArray(np.arange(float(coord.size)), dims=[dim])
    next_z = z.shift({dim: -1})
    is_falling = (z >= 0) & (next_z < 0)
    crossings = steps + z / (z - next_z).where(is_falling, 1.0)
    first_break, first_unknown = (
        _smallest_step_where(crossings, is_falling, dim),
        _smallest_step_where(steps, z.isnull(), dim),
    )
    last_break, last_unknown = (
        -_smallest_step_where(-crossings, is_falling, dim),
        -_smallest_step_where(-steps, z.isnull(), dim),
    )
    starts_above, ends_above = (z.isel({dim: end}, drop=True) >= 0 for end in (0, -1))
    unbroken_reason = xr.where(
        first_unknown < xr.where(starts_above, first_break, 0.5),
        LIMIT_NOT_COMPUTED,
        xr.where(
            ~starts_above,
            LEVEL_NEVER_REACHED,
            xr.where(np.isinf(first_break), LEVEL_NEVER_LOST, LIMIT_FOUND),
        ),
    )
    farthest_reason = xr.where(
        last_unknown > xr.where(ends_above, float(coord.size), last_break),
        LIMIT_NOT_COMPUTED,
        xr.where(
            ends_above,
            LEVEL_NEVER_LOST,
            xr.where(np.isinf(last_break), LEVEL_NEVER_REACHED, LIMIT_FOUND),
        ),
    )
    return {
        "unbroken": _coordinate_at_step(first_break.where(unbroken_reason == LIMIT_FOUND), coord),
        "farthest": _coordinate_at_step(last_break.where(farthest_reason == LIMIT_FOUND), coord),
        "unbroken_reason": unbroken_reason.astype("int8"),
        "farthest_reason": farthest_reason.astype("int8"),
    }


def _smallest_step_where(steps: xr.DataArray, is_chosen: xr.DataArray, dim: str) -> xr.DataArray:
    """Return the smallest of the steps at which a mask is true; infinity if it is true nowhere.

    Steps are indices along the dimension `dim`, and may lie between two integers.
    """
    return xr.where(is_chosen, steps, np.inf).min(dim, skipna=False)


def _coordinate_at_step(step: xr.DataArray, coord: xr.DataArray) -> xr.DataArray:
    """Interpolate the values of a coordinate at fractional indices; a nan index gives nan."""
    all_steps = np.arange(coord.size, dtype=float)
    return xr.apply_ufunc(
        lambda p: np.interp(p, all_steps, coord.values),
        step,
        dask="parallelized",
        output_dtypes=[float],
    )


def _set_limit_attributes(
    result: xr.Dataset,
    coord: xr.DataArray,
    segment: str,
    level: float,
    confidence_attributes: dict[str, float],
) -> xr.Dataset:
    """Set units and long names of the variables of :func:`limit`, in place; return the dataset."""
    long_names = {
        "unbroken": (
            f"farthest {coord.name} up to which pd of the {segment} stays {level:g} or more"
        ),
        "farthest": f"farthest {coord.name} at which pd of the {segment} is {level:g} or more",
    }
    for name, array in result.data_vars.items():
        answer_name = str(name).split("_")[0]
        if str(name).endswith("reason"):
            array.attrs = {
                "long_name": f"why there is no {answer_name} value",
                "units": "1",
                "flag_values": [
                    LIMIT_FOUND,
                    LEVEL_NEVER_REACHED,
                    LEVEL_NEVER_LOST,
                    LIMIT_NOT_COMPUTED,
                ],
                "flag_meanings": LIMIT_REASON_MEANINGS,
            }
        else:
            end_text = {"low": ", lower end", "high": ", upper end"}.get(
                str(name).split("_")[-1], ""
            )
            array.attrs = {
                "units": coord.attrs.get("units", ""),
                "long_name": long_names[answer_name] + end_text,
            }
            array.attrs |= confidence_attributes if end_text else {}
    return result


def contour(
    dataset: xr.Dataset,
    pd: float | str = 0.9,
    *,
    x: str = "range",
    y: str = "grazing_angle",
    segment: str = "shot",
) -> xr.Dataset:
    """Return the lines along which the probability of detection equals a level.

    Parameters
    ----------
    dataset
        Dataset of `sweep.open`, with one value selected along every dimension except two.
    pd
        Level, 0 < pd < 1, such as 0.9 or "90 %".
    x, y
        Coordinates of the two dimensions.
    segment
        ``shot``, ``up``, ``doppler`` or ``down``.

    Returns
    -------
    xarray.Dataset
        Dataset over `vertex`, in order along each line: both coordinates in their units, and
        `line`, the number of the line. The dataset is empty if pd never equals the level. Between
        grid points the normal deviate of pd is interpolated linearly.

    Raises
    ------
    ValueError
        A coordinate does not exist, or the dataset has more than two dimensions.
    """
    level = parse_pd_level(pd)
    x_coord, y_coord = (
        coordinate_by_name_or_path(dataset, x),
        coordinate_by_name_or_path(dataset, y),
    )
    pd_name = segment_variable_name("pd", segment)
    require_variables(dataset, pd_name)
    array = dataset[pd_name]
    if set(array.dims) != {x_coord.name, y_coord.name}:
        other_dims = ", ".join(str(d) for d in array.dims if d not in (x_coord.name, y_coord.name))
        raise ValueError(
            f"a contour goes over {x_coord.name} and {y_coord.name} as dimensions: "
            + (
                f"select one value along {other_dims}"
                if other_dims
                else "they share one, or lack it"
            )
        )
    z = normal_deviate(array, dataset.get(segment_variable_name("miss", segment))).transpose(
        y_coord.name, x_coord.name
    )
    contour_lines = contour_generator(
        x_coord.values, y_coord.values, np.ma.masked_invalid(z.values)
    ).lines(float(ndtri(level)))  # fmt: skip
    lines = [np.asarray(line) for line in contour_lines]
    vertices = np.concatenate(lines) if lines else np.empty((0, 2))
    line_numbers = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    return xr.Dataset(
        {
            str(x_coord.name): ("vertex", vertices[:, 0], x_coord.attrs),
            str(y_coord.name): ("vertex", vertices[:, 1], y_coord.attrs),
            "line": ("vertex", line_numbers, {"units": "1", "long_name": "number of the line"}),
        },
        attrs=dataset.attrs,
    )
