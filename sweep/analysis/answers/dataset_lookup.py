"""Look up a dataset's coordinates, study and parameters, with units converted."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import xarray as xr

from sweep.spec import GridSpec, SceneSpec, from_stored
from sweep.spec.axes import STUDY_MARKER_NAME_PATTERN, read_in_unit
from sweep.spec.rules import NumericRule
from sweep.spec.sections import parameter_rules
from sweep.units import QuantityError, read_number, read_quantity

RELATIVE_VALUE_TOLERANCE = 1e-9
"""Largest relative difference between a wanted value and a coordinate's value that match."""

STUDY_ID_NAME = "study_id"
"""Name of both the coordinate and the attribute that hold the id of the study."""

JOIN_REMEDY = (
    "join stores with sweep.open([STORE, STORE], dim='design'), whose answers are per design"
)
"""Advice in error messages: how to join the stores of several studies into one dataset."""

JOINED_SPECS_ATTRIBUTE = "specs"
"""Name of the attribute in which a join of studies keeps their specs and variable names.

Its value is the JSON text of a mapping by study id.
"""


def study_marker_name(study_ids: Iterable[str]) -> str:
    """Return the name of the coordinate that marks the data of a study, or of joined studies.

    The ids of the studies are part of the name. When xarray merges datasets, it always keeps a
    coordinate that only one dataset has. A merge of two studies therefore has two markers. By
    contrast, xarray drops a coordinate that differs between datasets, or keeps that of the first
    dataset.
    """
    study_ids = list(study_ids)
    if len(study_ids) == 1:
        return f"study_{study_ids[0][:16]}"
    return f"study_{hashlib.sha256(' '.join(sorted(study_ids)).encode()).hexdigest()[:16]}"


def study_marker_names(dataset: xr.Dataset | xr.DataTree) -> list[str]:
    """Return the names of a dataset's coordinates that mark studies (:func:`study_marker_name`)."""
    return [name for name in map(str, dataset.coords) if STUDY_MARKER_NAME_PATTERN.fullmatch(name)]


def spec_of_dataset(dataset: xr.Dataset | xr.DataTree) -> GridSpec | SceneSpec:
    """Return the spec of the study from which a dataset or tree comes.

    Raise ValueError if the data combine several studies, or lack the spec or the study's marker.
    """
    spec_text = dataset.attrs.get("spec")
    _check_study_marker(dataset)
    if STUDY_ID_NAME in dataset.coords:
        study_id_coord = dataset.coords[STUDY_ID_NAME]
        if study_id_coord.dims:
            raise ValueError(
                f"the dataset has several studies along '{study_id_coord.dims[0]}': select one of "
                "them, "
                f"ds.isel({study_id_coord.dims[0]}=0)"
            )
        if JOINED_SPECS_ATTRIBUTE in dataset.attrs:
            spec_text = (
                json.loads(dataset.attrs[JOINED_SPECS_ATTRIBUTE])
                .get(str(study_id_coord.item()), {})
                .get("spec")
            )
        elif dataset.attrs.get(STUDY_ID_NAME) != str(study_id_coord.item()):
            spec_text = None
    if not spec_text:
        raise ValueError(
            "the dataset lacks the spec of its study, an attribute that an operation has dropped "
            "or taken from another: use a dataset of sweep.open, or "
            "xarray.set_options(keep_attrs=True)"
        )
    return _parse_stored_spec(spec_text)


def _check_study_marker(dataset: xr.Dataset | xr.DataTree) -> None:
    """Raise ValueError if a dataset combines several studies, or lacks the marker of its study."""
    dataset_markers = study_marker_names(dataset)
    if len(dataset_markers) > 1:
        short_ids = ", ".join(name.removeprefix("study_")[:8] for name in dataset_markers)
        raise ValueError(
            f"the dataset is put together of the studies {short_ids} and has the spec of the first "
            f"alone: {JOIN_REMEDY}"
        )
    if STUDY_ID_NAME in dataset.coords and not dataset.coords[STUDY_ID_NAME].dims:
        study_id = str(dataset.coords[STUDY_ID_NAME].item())
        joined_ids = (
            json.loads(dataset.attrs[JOINED_SPECS_ATTRIBUTE])
            if JOINED_SPECS_ATTRIBUTE in dataset.attrs
            else [study_id]
        )
        if dataset_markers != [study_marker_name(joined_ids)]:
            raise ValueError(
                f"the dataset lacks the coordinate '{study_marker_name(joined_ids)}', which proves "
                f"that no other study's variables are in it: take one that sweep.open gave, or "
                f"{JOIN_REMEDY}"
            )


@lru_cache(maxsize=8)
def _parse_stored_spec(spec_text: str) -> GridSpec | SceneSpec:
    """Parse the JSON text of a stored spec; the last eight results are cached."""
    return from_stored(spec_text)


def grid_spec_of_dataset(dataset: xr.Dataset) -> GridSpec:
    """Return the spec of the grid study from which a dataset comes.

    Raise ValueError for the dataset of a flight.
    """
    spec = spec_of_dataset(dataset)
    if not isinstance(spec, GridSpec):
        raise ValueError("the dataset is a flight's: this answer is one of a grid of points")
    return spec


def require_variables(dataset: xr.Dataset, *names: str) -> None:
    """Raise ValueError if a dataset lacks one of the named variables."""
    if missing := [name for name in names if name not in dataset]:
        raise ValueError(
            f"the dataset lacks {', '.join(missing)}, which this answer needs: take all variables "
            "that sweep.open gives, or add these to the selection"
        )


def parse_to_si(raw_value: object, *, si_unit: str, name: str) -> float:
    """Return the SI value of a quantity such as ``"20 Hz"``; a plain number is returned unchanged.

    `si_unit` is the unit of the result. `name` names the quantity in error messages.
    """
    if isinstance(raw_value, int | float) and not isinstance(raw_value, bool):
        return float(raw_value)
    try:
        quantity = read_quantity(raw_value, si_unit=si_unit, example=f"1 {si_unit}")
    except QuantityError as error:
        raise ValueError(f"{name} {error}") from None
    return quantity.to_si()


def parse_pd_level(pd: object) -> float:
    """Return a level of pd, such as 0.9 or ``"90 %"``, as a number between 0 and 1.

    Raise ValueError for other values.
    """
    is_number = isinstance(pd, np.number) and np.ndim(pd) == 0
    try:
        level = read_number(pd.item() if is_number else pd).to_si()  # type: ignore[attr-defined]
    except QuantityError as error:
        raise ValueError(f"a level of pd, {pd!r:.60}, {error}") from None
    if not 0 < level < 1:
        raise ValueError(f"a level of pd lies between 0 and 1, and {pd!r} does not")
    return level


def coordinate_by_name_or_path(dataset: xr.Dataset, name: str) -> xr.DataArray:
    """Return a dataset's coordinate, given its name or the dotted path of its parameter.

    Raise ValueError if there is none.
    """
    for coord_name, coord in dataset.coords.items():
        if name in (coord_name, coord.attrs.get("path")):
            return coord
    names = ", ".join(map(str, dataset.coords)) or "none"
    raise ValueError(f"'{name}' is no coordinate of this dataset: there is {names}")


def convert_to_coordinate_units(coord: xr.DataArray, raw_value: object) -> float | str:
    """Return a value such as ``"2 km"`` in a coordinate's units; a plain number stays as it is."""
    rule = parameter_rules().get(coord.attrs.get("path", ""))
    if isinstance(raw_value, int | float | np.number) and not isinstance(raw_value, bool):
        return float(raw_value)
    if not isinstance(rule, NumericRule):
        return str(raw_value)
    try:
        return read_in_unit(rule, raw_value, coord.attrs.get("units", ""))
    except QuantityError as error:
        raise ValueError(f"{coord.name} {error}") from None


def coordinate_in_si(coord: xr.DataArray) -> xr.DataArray:
    """Return a coordinate with its values in SI units, or as strings for a text parameter."""
    rule = parameter_rules().get(coord.attrs.get("path", ""))
    units = coord.attrs.get("units", "")
    if coord.dtype.kind not in "fiu":
        return coord.copy(
            data=np.array([str(v) for v in coord.values.ravel()]).reshape(coord.shape)
        )
    if not isinstance(rule, NumericRule) or not units:
        return coord
    unit = rule.read_exact_number(f"1 {units}").unit
    if unit.is_logarithmic:
        return float(unit.factor) * 10 ** (coord / 10)
    return coord * float(unit.factor) + float(unit.offset)


def parameter_in_si(
    dataset: xr.Dataset, path: str, spec: GridSpec | SceneSpec | None = None
) -> xr.DataArray:
    """Return the SI values of a parameter as an array along its axis.

    A parameter on no axis gives an array without dimensions. ``path`` is the parameter's dotted
    path.
    """
    coord = parameter_coordinate(dataset, path)
    if coord is not None:
        return coordinate_in_si(coord).drop_vars(list(coord.coords), errors="ignore").assign_coords(
            {n: c for n, c in coord.coords.items() if n in coord.dims}
        )  # fmt: skip
    spec = spec or grid_spec_of_dataset(dataset)
    if any(axis_parameter.path == path for axis in spec.axes for axis_parameter in axis.parameters):
        raise ValueError(
            f"the dataset lacks the coordinate of {path}, an axis of its study: select one value "
            "and keep it, ds.sweep.sel(...), or isel without drop=True"
        )
    return xr.DataArray(spec.parameters()[path])


def parameter_coordinate(dataset: xr.Dataset, path: str) -> xr.DataArray | None:
    """Return the coordinate of the parameter with a given dotted path; None if there is none."""
    matches = (coord for coord in dataset.coords.values() if coord.attrs.get("path") == path)
    return next(matches, None)


def select_points(
    dataset: xr.Dataset, selection: Mapping[str, Any], *, method: str | None = None
) -> xr.Dataset:
    """Return the points of a dataset at which coordinates have given values.

    Parameters
    ----------
    selection
        Selected values by name or path of a coordinate: a value (``"2 km"``, or a number in the
        coordinate's units), a list of values, or a slice that includes both ends. A single value of
        a dimension coordinate removes its dimension. A coordinate along a zipped axis keeps the
        matching points of that axis.
    method
        ``nearest`` selects the nearest value, if the wanted value lies within the coordinate's
        range. By default the value must match to a relative 1e-9.

    Raises
    ------
    ValueError
        A coordinate does not exist, or a value can't be read or is not on the grid.
    """
    if method not in (None, "nearest"):
        raise ValueError(f"method '{method}' is unknown: take 'nearest', or none")
    for name, selected in selection.items():
        coord = coordinate_by_name_or_path(dataset, name)
        indices = _indices_of_selection(coord, selected, method)
        if not coord.dims:
            continue
        is_single_value = not isinstance(selected, list | tuple | slice | np.ndarray)
        if is_single_value and coord.name in coord.dims:
            dataset = dataset.isel({coord.dims[0]: int(indices[0])})
        else:
            dataset = dataset.isel({coord.dims[0]: indices})
    return dataset


def _indices_of_selection(coord: xr.DataArray, selected: Any, method: str | None) -> np.ndarray:
    """Return the indices at which a coordinate has the selected values.

    `selected` is a value, a list of values, or a slice that includes both ends.
    """
    coord_values = np.atleast_1d(coord.values)
    if isinstance(selected, slice):
        low = (
            -np.inf
            if selected.start is None
            else float(convert_to_coordinate_units(coord, selected.start))
        )
        high = (
            np.inf
            if selected.stop is None
            else float(convert_to_coordinate_units(coord, selected.stop))
        )
        tolerance = RELATIVE_VALUE_TOLERANCE * np.abs(coord_values)
        return np.flatnonzero(
            (coord_values >= low - tolerance) & (coord_values <= high + tolerance)
        )
    selected_values = selected if isinstance(selected, list | tuple | np.ndarray) else [selected]
    indices = [
        _indices_of_value(coord, coord_values, convert_to_coordinate_units(coord, value), method)
        for value in selected_values
    ]
    return np.concatenate(indices)


def _indices_of_value(
    coord: xr.DataArray, coord_values: np.ndarray, value: float | str, method: str | None
) -> np.ndarray:
    """Return the indices at which a coordinate has a given value.

    With the method ``nearest`` they are those of the nearest value. Raise ValueError if the value
    is not on the grid, or outside the coordinate's range.
    """
    units = coord.attrs.get("units", "")
    if coord_values.dtype.kind not in "fiu":
        coord_words = [str(word) for word in coord_values]
        matches = np.flatnonzero([word == str(value) for word in coord_words])
        if not matches.size:
            available = ", ".join(dict.fromkeys(coord_words))
            raise ValueError(f"{coord.name} '{value}' is not on the grid: there is {available}")
        return matches
    distance = np.abs(coord_values - float(value))
    low, high = float(coord_values.min()), float(coord_values.max())
    if (
        not low - RELATIVE_VALUE_TOLERANCE * abs(low)
        <= float(value)
        <= high + RELATIVE_VALUE_TOLERANCE * abs(high)
    ):
        raise ValueError(
            f"{coord.name} {value:g} {units} lies outside the grid, which reaches from {low:g} to "
            f"{high:g} {units}"
        )
    nearest_value = coord_values[np.argmin(distance)]
    if method == "nearest":
        return np.flatnonzero(coord_values == nearest_value)
    matches = np.flatnonzero(
        distance <= RELATIVE_VALUE_TOLERANCE * np.maximum(np.abs(coord_values), abs(float(value)))
    )
    if not matches.size:
        raise ValueError(
            f"{coord.name} {value:g} {units} is not on the grid: {nearest_value:g} {units} is "
            "nearest, "
            "which method='nearest' takes"
        )
    return matches
