"""Look up a dataset's coordinates, study and parameters, with units converted."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import xarray as xr

from sweep.spec import SceneSpec, Spec, from_stored
from sweep.spec.axes import in_units
from sweep.spec.rules import Numeric
from sweep.spec.sections import parameter_rules
from sweep.units import QuantityError, read_number, read_quantity

CLOSE = 1e-9
"""Relative tolerance for matching a value to one of the grid."""

STUDY_ID = "study_id"
"""Name of the coordinate, and of the attribute, with the identity of the study."""

HOW_TO_JOIN = (
    "join stores with sweep.open([STORE, STORE], dim='design'), whose answers are per design"
)

_MARKER = re.compile("study_[0-9a-f]{16}")

SPECS = "specs"
"""Attribute of a join of studies: JSON of spec and variable names by study identity."""


def marker_of(identities: Iterable[str]) -> str:
    """Return the name of the marker coordinate of a study, or of a join of several.

    xarray drops a conflicting coordinate or keeps the first dataset's, but keeps a coordinate that
    only one dataset has. The identity is therefore in the name: a merge of two studies has two
    markers.
    """
    identities = list(identities)
    if len(identities) == 1:
        return f"study_{identities[0][:16]}"
    return f"study_{hashlib.sha256(' '.join(sorted(identities)).encode()).hexdigest()[:16]}"


def markers(dataset: xr.Dataset | xr.DataTree) -> list[str]:
    """Return the markers that a dataset has, by :func:`marker_of`."""
    return [name for name in map(str, dataset.coords) if _MARKER.fullmatch(name)]


def study_of(dataset: xr.Dataset | xr.DataTree) -> Spec | SceneSpec:
    """Return the spec of the study that a dataset, or a flight's tree, comes from."""
    text = dataset.attrs.get("spec")
    _check_marker(dataset)
    if STUDY_ID in dataset.coords:
        identity = dataset.coords[STUDY_ID]
        if identity.dims:
            raise ValueError(
                f"the dataset has several studies along '{identity.dims[0]}': select one of them, "
                f"ds.isel({identity.dims[0]}=0)"
            )
        if SPECS in dataset.attrs:
            text = json.loads(dataset.attrs[SPECS]).get(str(identity.item()), {}).get("spec")
        elif dataset.attrs.get(STUDY_ID) != str(identity.item()):
            text = None
    if not text:
        raise ValueError(
            "the dataset lacks the spec of its study, an attribute that an operation has dropped "
            "or taken from another: use a dataset of sweep.open, or "
            "xarray.set_options(keep_attrs=True)"
        )
    return _from_stored(text)


def _check_marker(dataset: xr.Dataset | xr.DataTree) -> None:
    """Raise a ValueError if a dataset combines several studies, or lacks its study's marker."""
    present = markers(dataset)
    if len(present) > 1:
        studies = ", ".join(name.removeprefix("study_")[:8] for name in present)
        raise ValueError(
            f"the dataset is put together of the studies {studies} and has the spec of the first "
            f"alone: {HOW_TO_JOIN}"
        )
    if STUDY_ID in dataset.coords and not dataset.coords[STUDY_ID].dims:
        identity = str(dataset.coords[STUDY_ID].item())
        joined = json.loads(dataset.attrs[SPECS]) if SPECS in dataset.attrs else [identity]
        if present != [marker_of(joined)]:
            raise ValueError(
                f"the dataset lacks the coordinate '{marker_of(joined)}', which proves that no "
                f"other study's variables are in it: take one that sweep.open gave, or "
                f"{HOW_TO_JOIN}"
            )


@lru_cache(maxsize=8)
def _from_stored(text: str) -> Spec | SceneSpec:
    """Parse a stored spec; cached, because answers parse that of one dataset repeatedly."""
    return from_stored(text)


def spec_of(dataset: xr.Dataset) -> Spec:
    """Return the spec of the grid study that a dataset comes from; ValueError for a flight's."""
    study = study_of(dataset)
    if not isinstance(study, Spec):
        raise ValueError("the dataset is a flight's: this answer is one of a grid of points")
    return study


def require_variables(dataset: xr.Dataset, *names: str) -> None:
    """Refuse a dataset that lacks variables which an answer needs."""
    if missing := [name for name in names if name not in dataset]:
        raise ValueError(
            f"the dataset lacks {', '.join(missing)}, which this answer needs: take all variables "
            "that sweep.open gives, or add these to the selection"
        )


def quantity(written: object, *, si_unit: str, name: str) -> float:
    """Parse a quantity such as ``"20 Hz"`` to SI; a bare number is in SI already."""
    if isinstance(written, int | float) and not isinstance(written, bool):
        return float(written)
    try:
        value, unit = read_quantity(written, si_unit=si_unit, example=f"1 {si_unit}")
    except QuantityError as error:
        raise ValueError(f"{name} {error}") from None
    return unit.to_si(value)


def probability_level(written: object) -> float:
    """Level of pd as a number, ``0.9`` or ``"90 %"``; ValueError unless it is between 0 and 1."""
    is_number = isinstance(written, np.number) and np.ndim(written) == 0
    try:
        value, unit = read_number(written.item() if is_number else written)  # type: ignore[attr-defined]
        level = unit.to_si(value)
    except QuantityError as error:
        raise ValueError(f"a level of pd, {written!r:.60}, {error}") from None
    if not 0 < level < 1:
        raise ValueError(f"a level of pd lies between 0 and 1, and {written!r} does not")
    return level


def coordinate(dataset: xr.Dataset, name: str) -> xr.DataArray:
    """Return a coordinate by its name or by the dotted path of its parameter."""
    for known, array in dataset.coords.items():
        if name in (known, array.attrs.get("path")):
            return array
    names = ", ".join(map(str, dataset.coords)) or "none"
    raise ValueError(f"'{name}' is no coordinate of this dataset: there is {names}")


def shown(array: xr.DataArray, written: object) -> float | str:
    """Convert a value such as ``"2 km"`` to a coordinate's units; a bare number is in them."""
    rule = parameter_rules().get(array.attrs.get("path", ""))
    if isinstance(written, int | float | np.number) and not isinstance(written, bool):
        return float(written)
    if not isinstance(rule, Numeric):
        return str(written)
    try:
        return in_units(rule, written, array.attrs.get("units", ""))
    except QuantityError as error:
        raise ValueError(f"{array.name} {error}") from None


def si(array: xr.DataArray) -> xr.DataArray:
    """Return a coordinate's values in SI, or as strings if they are words."""
    rule = parameter_rules().get(array.attrs.get("path", ""))
    units = array.attrs.get("units", "")
    if array.dtype.kind not in "fiu":
        return array.copy(
            data=np.array([str(v) for v in array.values.ravel()]).reshape(array.shape)
        )
    if not isinstance(rule, Numeric) or not units:
        return array
    unit = rule.exact(f"1 {units}")[1]
    if unit.decibel:
        return float(unit.factor) * 10 ** (array / 10)
    return array * float(unit.factor) + float(unit.offset)


def parameter(dataset: xr.Dataset, path: str, spec: Spec | SceneSpec | None = None) -> xr.DataArray:
    """Return a parameter in SI: over its axis, or as a scalar if it is the same for all points."""
    array = parameter_coordinate(dataset, path)
    if array is not None:
        return si(array).drop_vars(list(array.coords), errors="ignore").assign_coords(
            {n: c for n, c in array.coords.items() if n in array.dims}
        )  # fmt: skip
    spec = spec or spec_of(dataset)
    if any(member.path == path for axis in spec.axes for member in axis.members):
        raise ValueError(
            f"the dataset lacks the coordinate of {path}, an axis of its study: select one value "
            "and keep it, ds.sweep.sel(...), or isel without drop=True"
        )
    return xr.DataArray(spec.parameters()[path])


def parameter_coordinate(dataset: xr.Dataset, path: str) -> xr.DataArray | None:
    """Return the coordinate of a parameter, by its dotted path."""
    found = (array for array in dataset.coords.values() if array.attrs.get("path") == path)
    return next(found, None)


def select(
    dataset: xr.Dataset, wanted: Mapping[str, Any], *, method: str | None = None
) -> xr.Dataset:
    """Select the points at which coordinates have given values.

    Parameters
    ----------
    wanted
        By a coordinate's name or path: a value (``"2 km"``, or a number in the coordinate's own
        units), a list of values, or a slice with both ends included. A single value of a dimension
        coordinate removes its dimension. A coordinate along a zipped axis keeps the matching points
        of that axis.
    method
        ``nearest`` takes the nearest value, for one within the coordinate's range; by default the
        value must match to 1e-9.

    Raises
    ------
    ValueError
        No such coordinate, a value that cannot be read, or one that is not on the grid.
    """
    if method not in (None, "nearest"):
        raise ValueError(f"method '{method}' is unknown: take 'nearest', or none")
    for name, written in wanted.items():
        array = coordinate(dataset, name)
        chosen = _places(array, written, method)
        if not array.dims:
            continue
        single = not isinstance(written, list | tuple | slice | np.ndarray)
        if single and array.name in array.dims:
            dataset = dataset.isel({array.dims[0]: int(chosen[0])})
        else:
            dataset = dataset.isel({array.dims[0]: chosen})
    return dataset


def _places(array: xr.DataArray, written: Any, method: str | None) -> np.ndarray:
    """Return the indices of the wanted values; for slices in the coordinate's order."""
    values = np.atleast_1d(array.values)
    if isinstance(written, slice):
        low = -np.inf if written.start is None else float(shown(array, written.start))
        high = np.inf if written.stop is None else float(shown(array, written.stop))
        room = CLOSE * np.abs(values)
        return np.flatnonzero((values >= low - room) & (values <= high + room))
    several = written if isinstance(written, list | tuple | np.ndarray) else [written]
    found = [_matching(array, values, shown(array, value), method) for value in several]
    return np.concatenate(found)


def _matching(
    array: xr.DataArray, values: np.ndarray, value: float | str, method: str | None
) -> np.ndarray:
    """Return the indices at which a coordinate has one value."""
    units = array.attrs.get("units", "")
    if values.dtype.kind not in "fiu":
        words = [str(word) for word in values]
        same = np.flatnonzero([word == str(value) for word in words])
        if not same.size:
            there = ", ".join(dict.fromkeys(words))
            raise ValueError(f"{array.name} '{value}' is not on the grid: there is {there}")
        return same
    distance = np.abs(values - float(value))
    low, high = float(values.min()), float(values.max())
    if not low - CLOSE * abs(low) <= float(value) <= high + CLOSE * abs(high):
        raise ValueError(
            f"{array.name} {value:g} {units} lies outside the grid, which reaches from {low:g} to "
            f"{high:g} {units}"
        )
    nearest = values[np.argmin(distance)]
    if method == "nearest":
        return np.flatnonzero(values == nearest)
    same = np.flatnonzero(distance <= CLOSE * np.maximum(np.abs(values), abs(float(value))))
    if not same.size:
        raise ValueError(
            f"{array.name} {value:g} {units} is not on the grid: {nearest:g} {units} is nearest, "
            "which method='nearest' takes"
        )
    return same
