"""Proof that a dataset belongs to one study, and answers per design from a join of studies.

A dataset of `sweep.open` has the scalar coordinate `study_id`, which selections keep. When the
datasets of two studies are combined, xarray drops it, spreads it along a dimension, or keeps that
of the first (`compat="override"`). A second coordinate, the marker, therefore has the id in its
name: `study_1f2e3d4c5b6a7980`. xarray keeps a coordinate that only one dataset has, so a dataset
with two markers combines two studies. Attributes prove nothing, as xarray keeps those of the first
dataset.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.answers.dataset_lookup import (
    JOIN_REMEDY,
    JOINED_SPECS_ATTRIBUTE,
    STUDY_ID_NAME,
    coordinate_in_si,
    parameter_coordinate,
    spec_of_dataset,
    study_marker_name,
    study_marker_names,
)
from sweep.spec import GridSpec, SceneSpec
from sweep.spec.axes import AxisParameter, convert_from_si
from sweep.spec.rules import NumericRule
from sweep.spec.sections import parameter_rules

RELATIVE_VALUE_TOLERANCE = 1e-9
"""Largest relative difference up to which a coordinate's value equals one of the study's axis."""


def compute_answer_per_study(
    dataset: xr.Dataset, answer: Callable[[xr.Dataset], Any], *, require_axes: bool
) -> Any:
    """Return an answer from a dataset of one study, or the answers for all studies of a join.

    Parameters
    ----------
    dataset
        Dataset of `sweep.open`, or a selection of it.
    answer
        Function of the dataset of a single study.
    require_axes
        If true, the answer uses the study's parameters, so that each axis must have its coordinate.

    Returns
    -------
    Any
        Result of `answer`. For a join, the results of the designs are concatenated along its
        dimension, if they are datasets or arrays; contours are concatenated along `vertex`.

    Raises
    ------
    ValueError
        The dataset does not prove that it comes from one study.
    """
    names_from_sweep = {
        STUDY_ID_NAME,
        JOINED_SPECS_ATTRIBUTE,
        "spec",
        "model_version",
        *study_marker_names(dataset),
    }
    if not require_axes and not names_from_sweep & {*dataset.coords, *dataset.attrs}:
        return answer(dataset)  # not from a store: the answer needs nothing but the arrays
    dim = _joined_dimension(dataset)
    if not dim:
        return answer(check_single_study(dataset, require_axes=require_axes))
    answers = [
        answer(check_single_study(dataset.isel({dim: design_index}), require_axes=require_axes))
        for design_index in range(dataset.sizes[dim])
    ]
    design_names = dataset[dim]
    answers = [
        design_answer.drop_vars([dim, STUDY_ID_NAME], errors="ignore") for design_answer in answers
    ]
    if any("vertex" in design_answer.dims for design_answer in answers):
        contours = [
            design_answer.assign({dim: ("vertex", np.repeat(name, design_answer.sizes["vertex"]))})
            for name, design_answer in zip(design_names.values, answers, strict=True)
        ]
        return xr.concat(contours, "vertex", combine_attrs="drop_conflicts")
    result = concatenate_designs(answers, dim, design_names.values.tolist())
    result = result.assign_coords({STUDY_ID_NAME: dataset[STUDY_ID_NAME]})
    return result.assign_attrs(dataset.attrs) if isinstance(result, xr.Dataset) else result


def check_single_study(dataset: xr.Dataset, *, require_axes: bool) -> xr.Dataset:
    """Check that a dataset comes from one study; return it with restored coordinate attributes.

    Raises
    ------
    ValueError
        The dataset comes from no study or from several, its coordinates were changed, a dimension
        is not an axis, or (with ``require_axes``) the coordinate of an axis is missing.
    """
    _joined_dimension(dataset, refuse_join=True)
    spec = spec_of_dataset(dataset)
    dataset = _restore_coordinate_attributes(dataset, spec)
    if JOINED_SPECS_ATTRIBUTE in dataset.attrs:
        dataset = _restrict_to_design(dataset, spec)
    _check_coordinate_values(dataset, spec)
    _check_dimensions(dataset, spec)
    if require_axes:
        check_axis_coordinates(dataset, spec)
        if "effects" in dataset and dataset["effects"].dtype.kind not in "iu":
            raise ValueError(
                "'effects' has no flags any more: an operation such as mean, shift or rolling has "
                "made numbers of them. Use the arrays that sweep.open gave"
            )
    return dataset


def check_axis_coordinates(dataset: xr.Dataset, spec: GridSpec | SceneSpec) -> None:
    """Raise ValueError if a dataset lacks the coordinate of any axis of its study."""
    for axis_parameter in _axis_parameters(spec):
        if parameter_coordinate(dataset, axis_parameter.path) is None:
            raise ValueError(
                f"the dataset lacks the coordinate {axis_parameter.coordinate_name} "
                f"({axis_parameter.path}), an axis of its "
                "study: it was dropped, or averaged or summed over. Select one value and keep it: "
                f"ds.sweep.sel({axis_parameter.coordinate_name}=...), or isel without drop=True"
            )


def _joined_dimension(dataset: xr.Dataset, *, refuse_join: bool = False) -> str:
    """Return the dimension along which a dataset joins several studies, or '' for a single study.

    Raise ValueError if the dataset proves neither of both. With ``refuse_join`` a join is an error
    too.
    """
    if STUDY_ID_NAME not in dataset.coords:
        raise ValueError(
            f"the dataset lacks the coordinate '{STUDY_ID_NAME}', which proves that it is one "
            "study's: it is no dataset of sweep.open, or is made of several studies. Take one that "
            f"sweep.open gave, or {JOIN_REMEDY}"
        )
    study_id_coord = dataset[STUDY_ID_NAME]
    if not study_id_coord.dims:
        return ""
    dim = str(study_id_coord.dims[0])
    if (
        not refuse_join
        and study_id_coord.ndim == 1
        and JOINED_SPECS_ATTRIBUTE in dataset.attrs
        and dim in dataset.coords
    ):
        return dim
    short_ids = ", ".join(
        str(value)[:8] for value in dict.fromkeys(study_id_coord.values.ravel().tolist())
    )
    remedy = f"it has the spec of the first alone; {JOIN_REMEDY}"
    if JOINED_SPECS_ATTRIBUTE in dataset.attrs:
        remedy = f"select one of them, ds.isel({dim}=0)"
    raise ValueError(
        f"the dataset is put together along '{dim}' of the studies {short_ids}: {remedy}"
    )


def _axis_parameters(spec: GridSpec | SceneSpec) -> list[AxisParameter]:
    """Return the parameters on the axes of a study, axis by axis."""
    return [axis_parameter for axis in spec.axes for axis_parameter in axis.parameters]


def _restore_coordinate_attributes(dataset: xr.Dataset, spec: GridSpec | SceneSpec) -> xr.Dataset:
    """Return a dataset in which the attributes `path` and `units` of axis coordinates are restored.

    Only coordinates that lack both attributes are changed.
    """
    restored_coords = {}
    for axis_parameter in _axis_parameters(spec):
        coord = dataset.coords.get(axis_parameter.coordinate_name)
        if coord is not None and not {"path", "units"} & set(coord.attrs):
            restored_coords[axis_parameter.coordinate_name] = coord.assign_attrs(
                path=axis_parameter.path, units=axis_parameter.units
            )
    return dataset.assign_coords(restored_coords) if restored_coords else dataset


def _study_value_mask(coord: xr.DataArray, spec: GridSpec | SceneSpec) -> np.ndarray:
    """Return a mask of the values of a coordinate that the study's spec contains."""
    path = coord.attrs["path"]
    axis_values = [
        np.asarray(axis_parameter.values)
        for axis_parameter in _axis_parameters(spec)
        if axis_parameter.path == path
    ]
    study_values = axis_values[0] if axis_values else np.atleast_1d(spec.parameters()[path])
    values = np.atleast_1d(coordinate_in_si(coord).values)
    if study_values.dtype.kind not in "fiu" or values.dtype.kind not in "fiu":
        return np.isin(values.astype(str), study_values.astype(str))
    study_values = np.sort(study_values.astype(float))
    insertion_index = np.searchsorted(study_values, values).clip(1, max(study_values.size - 1, 1))
    neighbours = np.stack(
        [
            study_values[insertion_index - 1],
            study_values[insertion_index.clip(max=study_values.size - 1)],
        ]
    )
    return np.asarray(
        (
            np.abs(neighbours - values)
            <= RELATIVE_VALUE_TOLERANCE * np.maximum(np.abs(values), np.abs(neighbours))
        ).any(axis=0)
    )


def _parameter_coordinates(dataset: xr.Dataset, spec: GridSpec | SceneSpec) -> list[xr.DataArray]:
    """Return the coordinates of a dataset that are parameters of a study."""
    fixed_parameters = spec.parameters()
    axis_paths = {axis_parameter.path for axis_parameter in _axis_parameters(spec)}
    return [coord for coord in dataset.coords.values()
            if coord.attrs.get("path") in axis_paths | fixed_parameters.keys()]  # fmt: skip


def _check_coordinate_values(dataset: xr.Dataset, spec: GridSpec | SceneSpec) -> None:
    """Raise ValueError if a coordinate of a dataset has a value that the study does not have."""
    for coord in _parameter_coordinates(dataset, spec):
        is_value_known = _study_value_mask(coord, spec)
        if JOINED_SPECS_ATTRIBUTE in dataset.attrs and not coord.dims:
            continue  # a value of another design, at which this design has no points
        if not is_value_known.all():
            value = np.atleast_1d(coord.values)[np.argmin(is_value_known)]
            value_text = labels.format_quantity(value, str(coord.attrs.get("units", "")))
            raise ValueError(
                f"{coord.name} has the value {value_text}, which its study does not have: the "
                "coordinate was changed, averaged or interpolated. Use the values that sweep.open "
                "gave"
            )


def _check_dimensions(dataset: xr.Dataset, spec: GridSpec | SceneSpec) -> None:
    """Raise ValueError if a dimension is neither an axis of the study nor has a parameter."""
    known_dims = {axis.name for axis in spec.axes} | {"shot", "draw", "return_number", "statistic"}
    known_dims |= {
        str(dim) for array in _parameter_coordinates(dataset, spec) for dim in array.dims
    }
    unknown_dims = [
        dim for array in dataset.data_vars.values() for dim in array.dims if dim not in known_dims
    ]
    if unknown_dims and isinstance(spec, GridSpec):
        raise ValueError(
            f"'{unknown_dims[0]}' is no axis of the study: the dataset is stacked from several, or "
            f"expanded. Select one value along it, or {JOIN_REMEDY}"
        )


# Joins of several studies.


def _restrict_to_design(dataset: xr.Dataset, spec: GridSpec | SceneSpec) -> xr.Dataset:
    """Return the data of one of several joined studies.

    Points and variables that only other studies of the join have are dropped.
    """
    design_record = json.loads(dataset.attrs[JOINED_SPECS_ATTRIBUTE])[
        str(dataset[STUDY_ID_NAME].item())
    ]
    dataset = dataset.drop_vars(set(dataset.data_vars) - set(design_record["variables"]))
    for coord in _parameter_coordinates(dataset, spec):
        if coord.name in dataset.dims:
            dataset = dataset.isel({coord.name: np.flatnonzero(_study_value_mask(coord, spec))})
    return dataset


def join_designs(datasets: Mapping[str, xr.Dataset], dim: str) -> xr.Dataset:
    """Join the datasets of several studies, the designs, along a new dimension.

    Parameters
    ----------
    datasets
        Datasets of `sweep.open` by the name of the design.
    dim
        Name of the new dimension.

    Returns
    -------
    xarray.Dataset
        Dataset over `dim` and the axes of all studies, in the units of the first. Points that a
        design lacks are nan, -1 for counts, and 0 for flags. A parameter that varies only in some
        studies has its fixed value in the others. The attribute `specs` has the spec of each study.

    Raises
    ------
    ValueError
        The name of the dimension is taken, a study occurs twice, or zipped axes differ.
    """
    specs = {name: spec_of_dataset(dataset) for name, dataset in datasets.items()}
    _check_join_names(datasets, dim)
    reference_coords = _reference_coordinate_by_path(datasets)
    aligned = [
        _align_coordinates(datasets[name], specs[name], reference_coords) for name in datasets
    ]
    dim_order = list(dict.fromkeys(str(d) for part in aligned for d in part.dims))
    aligned = [part.transpose(*[d for d in dim_order if d in part.dims]) for part in aligned]
    study_ids = [part[STUDY_ID_NAME].item() for part in aligned]
    aligned = [part.drop_vars([STUDY_ID_NAME, *study_marker_names(part)]) for part in aligned]
    result = concatenate_designs(aligned, dim, list(datasets))
    result = result.assign_coords(
        {STUDY_ID_NAME: (dim, study_ids), study_marker_name(study_ids): True}
    )
    result.attrs = _joined_attributes(datasets)
    return result


_SUMMED_ATTRIBUTES = ("points", "points_committed", "blocks", "blocks_committed")
"""Names of the attributes of datasets that are summed when studies are joined."""


def _joined_attributes(datasets: Mapping[str, xr.Dataset]) -> dict[str, Any]:
    """Return the attributes of a join: equal ones of all datasets, sums of counts, all specs."""
    first_attributes, *other_attributes = (dataset.attrs for dataset in datasets.values())
    common_attributes = {
        key: value
        for key, value in first_attributes.items()
        if key != "spec"
        and all(str(attributes.get(key)) == str(value) for attributes in other_attributes)
    }
    specs = {
        dataset[STUDY_ID_NAME].item(): {
            "spec": dataset.attrs["spec"], "variables": [str(name) for name in dataset.data_vars],
        }
        for dataset in datasets.values()
    }  # fmt: skip
    return common_attributes | {
        "title": f"Designs: {', '.join(datasets)}",
        JOINED_SPECS_ATTRIBUTE: json.dumps(specs, ensure_ascii=False),
        **{key: sum(int(d.attrs[key]) for d in datasets.values()) for key in _SUMMED_ATTRIBUTES},
    }


def _check_join_names(datasets: Mapping[str, xr.Dataset], dim: str) -> None:
    """Raise ValueError if the name of a join's dimension is taken, or a study occurs twice."""
    used_names = {
        str(name) for d in datasets.values() for name in [*d.dims, *d.coords, *d.data_vars]
    }
    if not dim.isidentifier() or dim in used_names:
        raise ValueError(f"'{dim}' can't name the dimension of designs: it is taken, or no word")
    name_by_study_id: dict[str, str] = {}
    for name, dataset in datasets.items():
        first_name = name_by_study_id.setdefault(dataset[STUDY_ID_NAME].item(), name)
        if first_name != name:
            raise ValueError(f"the designs '{first_name}' and '{name}' are the same study")


def _reference_coordinate_by_path(datasets: Mapping[str, xr.Dataset]) -> dict[str, xr.DataArray]:
    """Return a coordinate by parameter path, from the first dataset with that parameter."""
    coord_by_path: dict[str, xr.DataArray] = {}
    for dataset in datasets.values():
        for coord in dataset.coords.values():
            if "path" in coord.attrs:
                coord_by_path.setdefault(str(coord.attrs["path"]), coord)
    return coord_by_path


def _align_coordinates(
    dataset: xr.Dataset, spec: GridSpec | SceneSpec, reference_coords: Mapping[str, xr.DataArray]
) -> xr.Dataset:
    """Return a dataset whose coordinates have the names and units of ``reference_coords``.

    A parameter that the study does not vary becomes a dimension with one value.
    """
    for path, reference_coord in reference_coords.items():
        coord = parameter_coordinate(dataset, path)
        if reference_coord.name not in reference_coord.dims:
            if (
                coord is None
                or coord.dims != reference_coord.dims
                or not np.array_equal(coord.values, reference_coord.values)
            ):
                raise ValueError(
                    f"the studies differ along the zipped axis '{reference_coord.dims[0]}', whose "
                    "values "
                    "can't be matched one by one: join studies with the same one"
                )
            continue
        units = str(reference_coord.attrs.get("units", ""))
        if coord is None:
            axis_values = _convert_to_display_units(
                np.atleast_1d(spec.parameters()[path]), path, units
            )
            dataset = dataset.expand_dims({str(reference_coord.name): axis_values})
        elif coord.name not in coord.dims:
            raise ValueError(
                f"{coord.name} is on the zipped axis '{coord.dims[0]}' of one study and an axis by "
                "itself in another: join studies with the same axes"
            )
        else:
            if coord.attrs.get("units", "") != units:
                axis_values = _convert_to_display_units(
                    np.asarray(coordinate_in_si(coord).values), path, units
                )
                dataset = dataset.assign_coords({coord.name: axis_values})
            if coord.name != reference_coord.name:
                dataset = dataset.rename({coord.name: reference_coord.name})
        dataset[reference_coord.name].attrs = dict(reference_coord.attrs)
    return dataset


def _convert_to_display_units(si_values: np.ndarray, path: str, units: str) -> np.ndarray:
    """Convert SI values of the parameter at a path to given units; return words unchanged."""
    rule = parameter_rules()[path]
    if not isinstance(rule, NumericRule) or not units:
        return si_values
    return convert_from_si(rule.read_exact_number(f"1 {units}").unit, si_values)


def concatenate_designs(designs: Sequence[Any], dim: str, design_names: Sequence[str]) -> Any:
    """Concatenate the datasets or arrays of designs along a new dimension; return the result.

    Points that a design lacks get the fill values of `_FILL_VALUE_BY_DTYPE_KIND`, or nan.
    """
    fill_values: Any = np.nan
    if isinstance(designs[0], xr.Dataset):
        variables = {name: array for part in designs for name, array in part.data_vars.items()}
        fill_values = {
            name: _FILL_VALUE_BY_DTYPE_KIND.get(array.dtype.kind, np.nan)
            for name, array in variables.items()
        }
        designs = [
            part.assign(
                {
                    name: xr.full_like(
                        array.isel(dict.fromkeys(array.dims, 0), drop=True), fill_values[name]
                    )
                    for name, array in variables.items()
                    if name not in part
                }
            )
            for part in designs
        ]
    return xr.concat(
        designs, xr.DataArray(np.asarray(design_names, str), dims=[dim], name=dim), data_vars="all",
        coords="minimal", compat="override", join="outer", fill_value=fill_values,
        combine_attrs="drop_conflicts",
    )  # fmt: skip


_FILL_VALUE_BY_DTYPE_KIND = {"i": -1, "u": 0, "b": False}
"""Values at points that one of the joined studies lacks, by NumPy's kind of data type.

For kinds that are not listed the value is nan.
"""
