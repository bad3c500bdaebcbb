"""Proof that a dataset belongs to one study, and answers per design from a join of studies.

A dataset of `sweep.open` has the scalar coordinate `study_id`, which selections keep. When two
studies' datasets are combined, xarray drops it, spreads it along a dimension, or keeps the first
one's (`compat="override"`). A second coordinate, the marker, therefore has the identity in its
name: `study_1f2e3d4c5b6a7980`. xarray keeps a coordinate that only one dataset has, so that a
dataset with two markers combines two studies. Attributes prove nothing: xarray keeps the first
dataset's.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.answers.physical import (
    HOW_TO_JOIN,
    SPECS,
    STUDY_ID,
    marker_of,
    markers,
    parameter_coordinate,
    si,
    study_of,
)
from sweep.spec import SceneSpec, Spec
from sweep.spec.axes import Member, values_in
from sweep.spec.rules import Numeric
from sweep.spec.sections import parameter_rules

CLOSE = 1e-9
"""Relative tolerance for matching a value to one of an axis."""


def answer_per_study(
    dataset: xr.Dataset, answer: Callable[[xr.Dataset], Any], *, every_axis: bool
) -> Any:
    """Compute an answer from a dataset of one study, or for each design of a join.

    Parameters
    ----------
    dataset
        A dataset of `sweep.open`, or a selection of it.
    answer
        Function of the dataset of a single study.
    every_axis
        Whether the answer uses the study's parameters, so that each axis must have its coordinate.

    Returns
    -------
    Any
        Result of `answer`; for a join, the designs' results along its dimension, if they are
        datasets or arrays. Contours are concatenated along `vertex`.

    Raises
    ------
    ValueError
        The dataset does not prove that it is one study's.
    """
    of_sweep = {STUDY_ID, SPECS, "spec", "model_version", *markers(dataset)}
    if not every_axis and not of_sweep & {*dataset.coords, *dataset.attrs}:
        return answer(dataset)  # arrays of no study, of which nothing but the arrays is used
    dim = _join_dimension(dataset)
    if not dim:
        return answer(proven(dataset, every_axis=every_axis))
    answers = [
        answer(proven(dataset.isel({dim: place}), every_axis=every_axis))
        for place in range(dataset.sizes[dim])
    ]
    names = dataset[dim]
    answers = [found.drop_vars([dim, STUDY_ID], errors="ignore") for found in answers]
    if any("vertex" in found.dims for found in answers):
        parts = [
            found.assign({dim: ("vertex", np.repeat(name, found.sizes["vertex"]))})
            for name, found in zip(names.values, answers, strict=True)
        ]
        return xr.concat(parts, "vertex", combine_attrs="drop_conflicts")
    result = join_along(answers, dim, names.values.tolist())
    result = result.assign_coords({STUDY_ID: dataset[STUDY_ID]})
    return result.assign_attrs(dataset.attrs) if isinstance(result, xr.Dataset) else result


def proven(dataset: xr.Dataset, *, every_axis: bool) -> xr.Dataset:
    """Check that a dataset is one study's; return it with coordinate attributes restored.

    Raises
    ------
    ValueError
        It is of no or several studies, its coordinates were changed, a dimension is no axis, or
        (with ``every_axis``) the coordinate of an axis is missing.
    """
    _join_dimension(dataset, refuse=True)
    spec = study_of(dataset)
    dataset = _with_attributes(dataset, spec)
    if SPECS in dataset.attrs:
        dataset = _of_design(dataset, spec)
    _check_coordinates(dataset, spec)
    _check_dimensions(dataset, spec)
    if every_axis:
        check_axes(dataset, spec)
        if "effects" in dataset and dataset["effects"].dtype.kind not in "iu":
            raise ValueError(
                "'effects' has no flags any more: an operation such as mean, shift or rolling has "
                "made numbers of them. Use the arrays that sweep.open gave"
            )
    return dataset


def check_axes(dataset: xr.Dataset, spec: Spec | SceneSpec) -> None:
    """Raise a ValueError if the coordinate of an axis is missing, so that its value is unknown."""
    for member in _members(spec):
        if parameter_coordinate(dataset, member.path) is None:
            raise ValueError(
                f"the dataset lacks the coordinate {member.name} ({member.path}), an axis of its "
                "study: it was dropped, or averaged or summed over. Select one value and keep it: "
                f"ds.sweep.sel({member.name}=...), or isel without drop=True"
            )


def _join_dimension(dataset: xr.Dataset, *, refuse: bool = False) -> str:
    """Return the dimension along which a dataset joins studies, or '' for a single study.

    Raises a ValueError if the dataset proves neither; with ``refuse`` also for a join.
    """
    if STUDY_ID not in dataset.coords:
        raise ValueError(
            f"the dataset lacks the coordinate '{STUDY_ID}', which proves that it is one study's: "
            "it is no dataset of sweep.open, or is made of several studies. Take one that "
            f"sweep.open gave, or {HOW_TO_JOIN}"
        )
    identity = dataset[STUDY_ID]
    if not identity.dims:
        return ""
    dim = str(identity.dims[0])
    if not refuse and identity.ndim == 1 and SPECS in dataset.attrs and dim in dataset.coords:
        return dim
    studies = ", ".join(str(value)[:8] for value in dict.fromkeys(identity.values.ravel().tolist()))
    remedy = f"it has the spec of the first alone; {HOW_TO_JOIN}"
    if SPECS in dataset.attrs:
        remedy = f"select one of them, ds.isel({dim}=0)"
    raise ValueError(
        f"the dataset is put together along '{dim}' of the studies {studies}: {remedy}"
    )


def _members(spec: Spec | SceneSpec) -> list[Member]:
    """Return the parameters on the axes of a study."""
    return [member for axis in spec.axes for member in axis.members]


def _with_attributes(dataset: xr.Dataset, spec: Spec | SceneSpec) -> xr.Dataset:
    """Restore path and units of coordinates where an operation dropped both."""
    restored = {}
    for member in _members(spec):
        array = dataset.coords.get(member.name)
        if array is not None and not {"path", "units"} & set(array.attrs):
            restored[member.name] = array.assign_attrs(path=member.path, units=member.units)
    return dataset.assign_coords(restored) if restored else dataset


def _is_of_study(array: xr.DataArray, spec: Spec | SceneSpec) -> np.ndarray:
    """Return whether the study has each value of a parameter's coordinate, bool array."""
    path = array.attrs["path"]
    on_axis = [np.asarray(member.values) for member in _members(spec) if member.path == path]
    allowed = on_axis[0] if on_axis else np.atleast_1d(spec.parameters()[path])
    values = np.atleast_1d(si(array).values)
    if allowed.dtype.kind not in "fiu" or values.dtype.kind not in "fiu":
        return np.isin(values.astype(str), allowed.astype(str))
    allowed = np.sort(allowed.astype(float))
    place = np.searchsorted(allowed, values).clip(1, max(allowed.size - 1, 1))
    nearest = np.stack([allowed[place - 1], allowed[place.clip(max=allowed.size - 1)]])
    return np.asarray(
        (np.abs(nearest - values) <= CLOSE * np.maximum(np.abs(values), np.abs(nearest))).any(
            axis=0
        )
    )


def _parameter_coordinates(dataset: xr.Dataset, spec: Spec | SceneSpec) -> list[xr.DataArray]:
    """Return the coordinates that are parameters of a study."""
    known = spec.parameters()
    axes = {member.path for member in _members(spec)}
    return [array for array in dataset.coords.values()
            if array.attrs.get("path") in axes | known.keys()]  # fmt: skip


def _check_coordinates(dataset: xr.Dataset, spec: Spec | SceneSpec) -> None:
    """Refuse coordinates with values that the study does not have."""
    for array in _parameter_coordinates(dataset, spec):
        is_of_study = _is_of_study(array, spec)
        if SPECS in dataset.attrs and not array.dims:
            continue  # a value of another design: there this one has no point
        if not is_of_study.all():
            value = np.atleast_1d(array.values)[np.argmin(is_of_study)]
            shown = labels.quantity(value, str(array.attrs.get("units", "")))
            raise ValueError(
                f"{array.name} has the value {shown}, which its study does not have: the "
                "coordinate was changed, averaged or interpolated. Use the values that sweep.open "
                "gave"
            )


def _check_dimensions(dataset: xr.Dataset, spec: Spec | SceneSpec) -> None:
    """Raise a ValueError if a dimension is neither an axis nor that of a parameter's coordinate."""
    known = {axis.name for axis in spec.axes} | {"shot", "draw", "return_number", "statistic"}
    known |= {str(dim) for array in _parameter_coordinates(dataset, spec) for dim in array.dims}
    foreign = [
        dim for array in dataset.data_vars.values() for dim in array.dims if dim not in known
    ]
    if foreign and isinstance(spec, Spec):
        raise ValueError(
            f"'{foreign[0]}' is no axis of the study: the dataset is stacked from several, or "
            f"expanded. Select one value along it, or {HOW_TO_JOIN}"
        )


# Joins of several studies


def _of_design(dataset: xr.Dataset, spec: Spec | SceneSpec) -> xr.Dataset:
    """Reduce one design of a join to the points and variables of its study."""
    stored = json.loads(dataset.attrs[SPECS])[str(dataset[STUDY_ID].item())]
    dataset = dataset.drop_vars(set(dataset.data_vars) - set(stored["variables"]))
    for array in _parameter_coordinates(dataset, spec):
        if array.name in dataset.dims:
            dataset = dataset.isel({array.name: np.flatnonzero(_is_of_study(array, spec))})
    return dataset


def joined(datasets: Mapping[str, xr.Dataset], dim: str) -> xr.Dataset:
    """Join the datasets of several studies along a new dimension, each a design.

    Parameters
    ----------
    datasets
        By the name of the design, as `sweep.open` gives them.
    dim
        Name of the new dimension.

    Returns
    -------
    xarray.Dataset
        Over `dim` and the axes of all studies, in the units of the first. Points that a design
        lacks are nan, -1 for counts, 0 for flags. A parameter that varies in some studies has its
        fixed value in the others. Its attribute `specs` has the spec of each study.

    Raises
    ------
    ValueError
        The name of the dimension is taken, one study comes twice, or zipped axes differ.
    """
    specs = {name: study_of(dataset) for name, dataset in datasets.items()}
    _check_names(datasets, dim)
    reference = _reference_coordinates(datasets)
    parts = [_aligned(datasets[name], specs[name], reference) for name in datasets]
    order = list(dict.fromkeys(str(d) for part in parts for d in part.dims))
    parts = [part.transpose(*[d for d in order if d in part.dims]) for part in parts]
    identities = [part[STUDY_ID].item() for part in parts]
    parts = [part.drop_vars([STUDY_ID, *markers(part)]) for part in parts]
    result = join_along(parts, dim, list(datasets))
    result = result.assign_coords({STUDY_ID: (dim, identities), marker_of(identities): True})
    result.attrs = _attributes_of_join(datasets)
    return result


_SUMMED = ("points", "points_committed", "blocks", "blocks_committed")


def _attributes_of_join(datasets: Mapping[str, xr.Dataset]) -> dict[str, Any]:
    """Return the attributes of a join: common ones, summed counts, and all specs."""
    first, *others = (dataset.attrs for dataset in datasets.values())
    common = {
        key: value for key, value in first.items()
        if key != "spec" and all(str(own.get(key)) == str(value) for own in others)
    }  # fmt: skip
    specs = {
        dataset[STUDY_ID].item(): {
            "spec": dataset.attrs["spec"], "variables": [str(name) for name in dataset.data_vars],
        }
        for dataset in datasets.values()
    }  # fmt: skip
    return common | {
        "title": f"Designs: {', '.join(datasets)}",
        SPECS: json.dumps(specs, ensure_ascii=False),
        **{key: sum(int(d.attrs[key]) for d in datasets.values()) for key in _SUMMED},
    }


def _check_names(datasets: Mapping[str, xr.Dataset], dim: str) -> None:
    """Raise a ValueError if the dimension's name is taken, or a study occurs twice."""
    taken = {str(name) for d in datasets.values() for name in [*d.dims, *d.coords, *d.data_vars]}
    if not dim.isidentifier() or dim in taken:
        raise ValueError(f"'{dim}' can't name the dimension of designs: it is taken, or no word")
    identities: dict[str, str] = {}
    for name, dataset in datasets.items():
        twin = identities.setdefault(dataset[STUDY_ID].item(), name)
        if twin != name:
            raise ValueError(f"the designs '{twin}' and '{name}' are the same study")


def _reference_coordinates(datasets: Mapping[str, xr.Dataset]) -> dict[str, xr.DataArray]:
    """Return for each parameter path the coordinate of the first dataset that has one."""
    found: dict[str, xr.DataArray] = {}
    for dataset in datasets.values():
        for array in dataset.coords.values():
            if "path" in array.attrs:
                found.setdefault(str(array.attrs["path"]), array)
    return found


def _aligned(
    dataset: xr.Dataset, spec: Spec | SceneSpec, reference: Mapping[str, xr.DataArray]
) -> xr.Dataset:
    """Give a dataset the coordinates of ``reference``, in their names and units."""
    for path, like in reference.items():
        array = parameter_coordinate(dataset, path)
        if like.name not in like.dims:
            if (
                array is None
                or array.dims != like.dims
                or not np.array_equal(array.values, like.values)
            ):
                raise ValueError(
                    f"the studies differ along the zipped axis '{like.dims[0]}', whose values "
                    "can't be matched one by one: join studies with the same one"
                )
            continue
        units = str(like.attrs.get("units", ""))
        if array is None:
            value = _displayed(np.atleast_1d(spec.parameters()[path]), path, units)
            dataset = dataset.expand_dims({str(like.name): value})
        elif array.name not in array.dims:
            raise ValueError(
                f"{array.name} is on the zipped axis '{array.dims[0]}' of one study and an axis by "
                "itself in another: join studies with the same axes"
            )
        else:
            if array.attrs.get("units", "") != units:
                value = _displayed(np.asarray(si(array).values), path, units)
                dataset = dataset.assign_coords({array.name: value})
            if array.name != like.name:
                dataset = dataset.rename({array.name: like.name})
        dataset[like.name].attrs = dict(like.attrs)
    return dataset


def _displayed(values: np.ndarray, path: str, units: str) -> np.ndarray:
    """Convert SI values to display units; return words unchanged."""
    rule = parameter_rules()[path]
    if not isinstance(rule, Numeric) or not units:
        return values
    return values_in(rule.exact(f"1 {units}")[1], values)


def join_along(parts: Sequence[Any], dim: str, names: Sequence[str]) -> Any:
    """Concatenate datasets or arrays along a new dimension; missing points get a fill value."""
    fills: Any = np.nan
    if isinstance(parts[0], xr.Dataset):
        variables = {name: array for part in parts for name, array in part.data_vars.items()}
        fills = {name: _FILLS.get(array.dtype.kind, np.nan) for name, array in variables.items()}
        parts = [
            part.assign({
                name: xr.full_like(array.isel(dict.fromkeys(array.dims, 0), drop=True), fills[name])
                for name, array in variables.items() if name not in part
            })
            for part in parts
        ]  # fmt: skip
    return xr.concat(
        parts, xr.DataArray(np.asarray(names, str), dims=[dim], name=dim), data_vars="all",
        coords="minimal", compat="override", join="outer", fill_value=fills,
        combine_attrs="drop_conflicts",
    )  # fmt: skip


_FILLS = {"i": -1, "u": 0, "b": False}
"""Fill values of points that a design lacks, by NumPy kind; nan for other kinds."""
