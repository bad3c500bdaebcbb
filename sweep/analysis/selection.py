"""Selections of a study's points by index along each axis, their statistics, and published cuts.

A selection stores indices along axes. Arrays are read only when values are requested. Large arrays
are reduced, chunk by chunk, to the number of cells that a figure or a page can show.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any

import dask.array
import numpy as np
import pandas
import xarray as xr

from sweep.analysis import labels

if TYPE_CHECKING:
    from sweep.spec import Axis, AxisParameter, GridSpec, SceneSpec


MEAN, LOWEST, HIGHEST = "mean", "lowest", "highest"
"""Statistics of the points in a cell."""

VALUES_PER_SUM = 2**20
"""Number of values that are summed at once."""


@dataclass(frozen=True)
class SortedCoordinate:
    """Dimension of a figure: indices and values of a coordinate, in the order of its values."""

    dim: str
    indices: np.ndarray
    values: np.ndarray

    def points_per_cell(self, cells_max: int) -> int:
        """Return the number of adjacent points per cell that gives at most ``cells_max`` cells."""
        return 1 if labels.is_categorical(self.values) else -(-self.values.size // cells_max)

    def cell_means(self, cells_max: int) -> np.ndarray:
        """Return the mean value of the coordinate in each cell."""
        cell_size = self.points_per_cell(cells_max)
        if cell_size == 1:
            return self.values
        starts = np.arange(0, self.values.size, cell_size)
        sums = np.add.reduceat(self.values, starts)
        return sums / np.diff(starts, append=self.values.size)


def to_float_with_nan(array: xr.DataArray) -> xr.DataArray:
    """Return an array as floats; missing counts, which are negative, become nan."""
    return array if array.dtype.kind == "f" else array.astype(float).where(array >= 0)


@dataclass(frozen=True)
class PointSelection:
    """Selection of points of a dataset: all combinations of selected indices along its dimensions.

    ``dim_tables`` has a table for each dimension. Its rows are the selected indices, its columns
    the coordinates along the dimension.
    """

    dataset: xr.Dataset
    dim_tables: Mapping[str, pandas.DataFrame]

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset) -> PointSelection:
        """Return the selection of all points of a dataset."""
        largest_array = max(dataset.data_vars.values(), key=lambda array: array.ndim)
        columns_by_dim: dict[str, dict[str, np.ndarray]] = {
            str(dim): {} for dim in largest_array.dims
        }
        for name, coordinate in dataset.coords.items():
            if coordinate.dims and coordinate.dims[0] in columns_by_dim:
                columns_by_dim[str(coordinate.dims[0])][str(name)] = coordinate.values
        tables = {
            dim: pandas.DataFrame(columns, index=pandas.RangeIndex(dataset.sizes[dim]))
            for dim, columns in columns_by_dim.items()
        }
        return cls(dataset, tables)

    @property
    def size(self) -> int:
        """Number of selected points."""
        return math.prod(map(len, self.dim_tables.values()))

    def dim_of(self, name: str) -> str:
        """Return the dimension of a coordinate, or the name itself if it is a zipped axis."""
        return next((dim for dim, table in self.dim_tables.items() if name in table), name)

    def coordinate_values(self, name: str) -> np.ndarray:
        """Return the values of a coordinate along its dimension, or the indices if it has none."""
        table = self.dim_tables[self.dim_of(name)]
        return np.asarray(table.get(name, table.index))

    def coordinate_units(self, name: str) -> str:
        """Return the units of a coordinate."""
        coordinate = self.dataset.coords.get(name)
        return "" if coordinate is None else str(coordinate.attrs.get("units", ""))

    def isel(self, dim: str, indices: np.ndarray) -> PointSelection:
        """Return the selection restricted to positions, or a mask, along a dimension."""
        return replace(
            self, dim_tables={**self.dim_tables, dim: self.dim_tables[dim].iloc[indices]}
        )

    def sel(self, name: str, values: list[object]) -> PointSelection:
        """Return the points at which a coordinate has one of the values."""
        return self.isel(self.dim_of(name), matches_any(self.coordinate_values(name), values))

    def drop_duplicates(self) -> PointSelection:
        """Return the selection without rows that repeat all coordinates of their dimension."""
        tables = {dim: table.drop_duplicates() if len(table.columns) else table
                  for dim, table in self.dim_tables.items()}  # fmt: skip
        return replace(self, dim_tables=tables)

    def unique_values(self, name: str) -> list[object]:
        """Return the values of a coordinate, in the order in which they first appear."""
        return list(pandas.unique(self.coordinate_values(name)))

    def varying_coordinates(self) -> list[str]:
        """Return the names of coordinates with more than one value."""
        return [
            n
            for table in self.dim_tables.values()
            for n in table
            if table[n].nunique(dropna=False) > 1
        ]

    def distinguishing_coordinates(self, names: Sequence[str]) -> list[str]:
        """Return the fewest other coordinates needed to distinguish points of equal ``names``."""
        return [name for dim in self.dim_tables for name in self.distinguishing_along(dim, names)]

    def distinguishing_along(self, dim: str, names: Sequence[str]) -> list[str]:
        """Return :meth:`distinguishing_coordinates` restricted to one dimension."""
        table = self.dim_tables[dim]
        given_names = [name for name in names if name in table]
        distinguishing: list[str] = []
        n_distinct = len(table[given_names].drop_duplicates()) if given_names else 1
        for name in [n for n in table if n not in given_names]:
            n_with_name = len(table[[*given_names, *distinguishing, name]].drop_duplicates())
            if n_with_name > n_distinct:
                n_distinct = n_with_name
                distinguishing.append(name)
        return distinguishing

    def group_by(self, name: str) -> list[tuple[object, PointSelection]]:
        """Return the points of each value of a coordinate, in the order of first appearance."""
        dim = self.dim_of(name)
        groups = self.dim_tables[dim].groupby(
            self.coordinate_values(name), sort=False, dropna=False
        )
        return [
            (value, replace(self, dim_tables={**self.dim_tables, dim: table}))
            for value, table in groups
        ]

    def sorted_coordinate(self, name: str) -> SortedCoordinate:
        """Return a coordinate's unique values, with an index of each.

        Numbers are sorted in rising order, words in the order of first appearance.
        """
        values, first_rows = np.unique(self.coordinate_values(name), return_index=True)
        if labels.is_categorical(values):
            order = np.argsort(first_rows)
            values, first_rows = values[order], first_rows[order]
        dim = self.dim_of(name)
        return SortedCoordinate(dim, np.asarray(self.dim_tables[dim].index)[first_rows], values)

    def first_indices(self, *coordinates: SortedCoordinate) -> dict[str, int]:
        """Return the first selected index along every dimension except those of the coordinates."""
        shown_dims = {coordinate.dim for coordinate in coordinates}
        return {
            dim: int(table.index[0])
            for dim, table in self.dim_tables.items()
            if dim not in shown_dims
        }

    def coarsen(
        self, variable: str, coordinates: Sequence[tuple[SortedCoordinate, int]], statistic: str
    ) -> xr.DataArray:
        """Return a variable reduced to cells along some coordinates, lazily.

        Parameters
        ----------
        variable
            Name of the variable.
        coordinates
            Coordinates of the result, each with its largest number of cells. Along other dimensions
            the first selected index is taken.
        statistic
            Statistic of a cell: ``mean``, ``lowest`` or ``highest``.

        Returns
        -------
        xarray.DataArray
            Floats over the dimensions of the coordinates, in their order; nan where not computed.
        """
        array = self.dataset[variable].isel(
            self.first_indices(*(coordinate for coordinate, _ in coordinates))
        )
        for coordinate, _ in coordinates:
            if not np.array_equal(coordinate.indices, np.arange(array.sizes[coordinate.dim])):
                array = array.isel({coordinate.dim: coordinate.indices})
        array = xr.DataArray(to_float_with_nan(array).variable)
        points_per_cell = {
            coordinate.dim: coordinate.points_per_cell(cells_max)
            for coordinate, cells_max in coordinates
        }
        if max(points_per_cell.values()) > 1:
            coarsened = array.coarsen(points_per_cell, boundary="pad")
            array = {MEAN: coarsened.mean, LOWEST: coarsened.min, HIGHEST: coarsened.max}[
                statistic
            ]()
        return array.transpose(*points_per_cell)


def matches_any(values: np.ndarray, wanted_values: list[object]) -> np.ndarray:
    """Return a mask of the values that match a wanted value; floats to a relative 1e-9."""
    if values.dtype.kind not in "fiu":
        return np.isin([str(v) for v in values], [str(w) for w in wanted_values])
    matches = [np.isclose(values, float(w), rtol=1e-9, atol=0.0) for w in wanted_values]  # type: ignore[arg-type]
    return np.logical_or.reduce(matches)


def select_where(
    points: PointSelection, spec: GridSpec, where: Mapping[str, object]
) -> PointSelection:
    """Return the points at which coordinates have given values, written as in the spec."""
    for name, raw_value in where.items():
        wanted_values = list(raw_value) if isinstance(raw_value, tuple | list) else [raw_value]
        if name in points.dataset.coords:
            wanted_values = [spec.read_coordinate_value(name, value) for value in wanted_values]
        points = points.sel(name, wanted_values)
    return points


def split_by_coordinates(
    points: PointSelection, names: Sequence[str], parts_max: int
) -> tuple[list[tuple[str, PointSelection]], int]:
    """Split points by the values of coordinates, and name each part.

    Return at most ``parts_max`` parts, evenly spread, and the number of omitted parts.
    """
    parts = [("", points)]
    for name in names:
        units = points.coordinate_units(name)
        parts = [
            (
                ", ".join(
                    filter(None, [label, labels.format_coordinate_value(name, value, units)])
                ),
                subpart,
            )
            for label, part in parts
            for value, subpart in part.group_by(name)
        ]
    return thin_evenly(parts, parts_max)


def thin_evenly(
    parts: list[tuple[str, PointSelection]], parts_max: int
) -> tuple[list[tuple[str, PointSelection]], int]:
    """Return at most ``parts_max`` of the parts, evenly spread, and the number of omitted parts."""
    if len(parts) <= parts_max:
        return parts, 0
    return [parts[round(i * (len(parts) - 1) / (parts_max - 1))] for i in range(parts_max)], len(
        parts
    ) - parts_max


def find_axis_parameter(spec: GridSpec, path: str) -> AxisParameter | None:
    """Return the axis parameter of a path, or None if it is not on an axis."""
    return next((m for axis in spec.axes for m in axis.parameters if m.path == path), None)


def parameters_at(spec: GridSpec | SceneSpec, axis_indices: Mapping[str, int]) -> dict[str, Any]:
    """Return the SI values of all parameters at a position along the axes, by dotted path."""
    return dict(spec.parameters()) | {
        axis_parameter.path: np.asarray(axis_parameter.values)[axis_indices[axis.name]].item()
        for axis in spec.axes
        for axis_parameter in axis.parameters
    }


RANGE_PATH, GRAZING_ANGLE_PATH = "target.range", "target.grazing_angle"
PUBLISHED_CUTS = (
    (GRAZING_ANGLE_PATH, "15 deg"),
    (GRAZING_ANGLE_PATH, "85 deg"),
    (RANGE_PATH, "3500 m"),
)
"""Fixed parameter and value of each published cut."""

MEAN_RANGE_MIN = "5 m"
"""Range below which points are excluded from means.

At shorter ranges the echo's own shot noise matters [T 4.2].
"""


@dataclass(frozen=True)
class Cut:
    """Cut through a study: one coordinate fixed at a value, the other varying.

    All names are empty for the cut that is the complete study.
    """

    name: str
    fixed_name: str
    fixed_value: object
    varying_name: str

    def select_from(self, points: PointSelection) -> PointSelection:
        """Return the points of the cut without duplicates."""
        return (
            points.sel(self.fixed_name, [self.fixed_value]).drop_duplicates()
            if self.fixed_name
            else points
        )


def study_cuts(spec: GridSpec) -> list[Cut]:
    """Return the cuts through range and grazing angle of a study.

    A zipped axis of both defines its cuts. Otherwise they are the three published cuts, or one cut
    that is the complete study.
    """
    range_parameter, angle_parameter = (
        find_axis_parameter(spec, RANGE_PATH),
        find_axis_parameter(spec, GRAZING_ANGLE_PATH),
    )
    uncut = [
        Cut(
            "all",
            "",
            None,
            range_parameter.coordinate
            if range_parameter
            else angle_parameter.coordinate
            if angle_parameter
            else "",
        )
    ]
    if range_parameter is None or angle_parameter is None:
        return uncut
    parameter_by_path = {RANGE_PATH: range_parameter, GRAZING_ANGLE_PATH: angle_parameter}
    zipped_axis = next(
        (axis for axis in spec.axes if {range_parameter, angle_parameter} <= set(axis.parameters)),
        None,
    )
    if zipped_axis is not None:
        fixed_values = _constant_runs(zipped_axis)
    else:
        published_values = [
            (parameter_by_path[p], spec.read_coordinate_value(p, text))
            for p, text in PUBLISHED_CUTS
        ]
        fixed_values = [
            (m, v) for m, v in published_values if np.isclose(m.display_values, float(v)).any()
        ]
    cut_list = [
        Cut(
            labels.format_quantity(value, axis_parameter.units).replace("°", " deg"),
            axis_parameter.coordinate,
            value,
            angle_parameter.coordinate
            if axis_parameter is range_parameter
            else range_parameter.coordinate,
        )
        for axis_parameter, value in fixed_values
    ]
    return cut_list or uncut


def _constant_runs(axis: Axis) -> list[tuple[AxisParameter, object]]:
    """Return the constant parameter and its value for each run of a zipped axis, in order.

    In a run one of range and grazing angle is constant, while the other varies.
    """
    axis_parameters = [m for m in axis.parameters if m.path in (RANGE_PATH, GRAZING_ANGLE_PATH)]
    runs: list[tuple[AxisParameter, object]] = []
    run_start = 0
    while run_start < axis.size:
        is_same = [
            axis_parameter.display_values[run_start:] == axis_parameter.display_values[run_start]
            for axis_parameter in axis_parameters
        ]
        run_lengths = [int(np.argmin([*same_mask, False])) for same_mask in is_same]
        longest_parameter = int(np.argmax(run_lengths))
        run = (
            axis_parameters[longest_parameter],
            axis_parameters[longest_parameter].display_values[run_start].item(),
        )
        if run not in runs:
            runs.append(run)
        run_start += run_lengths[longest_parameter]
    return runs


def select_beyond(
    points: PointSelection, spec: GridSpec, distance: str, *, inclusive: bool = False
) -> PointSelection:
    """Return the points beyond a range, or at it with ``inclusive``, if range is on an axis."""
    range_parameter = find_axis_parameter(spec, RANGE_PATH)
    if range_parameter is None:
        return points
    range_min = float(spec.read_coordinate_value(RANGE_PATH, distance))
    ranges = points.coordinate_values(range_parameter.coordinate)
    return points.isel(
        points.dim_of(range_parameter.coordinate),
        ranges >= range_min if inclusive else ranges > range_min,
    )


@dataclass(frozen=True)
class Statistics:
    """Statistics of the finite values of points; nan if there are none."""

    n_finite: int
    mean: float
    median: float
    minimum: float
    maximum: float

    @classmethod
    def from_values(cls, values: np.ndarray) -> Statistics:
        """Return the statistics of values, nan or finite; the values are sorted in place."""
        total = sum(
            np.nansum(part) for part in np.array_split(values, values.size // VALUES_PER_SUM + 1)
        )
        values.sort()  # nan is sorted to the end
        n_finite = int(np.searchsorted(values, np.nan))
        if not n_finite:
            return cls(0, *[math.nan] * 4)
        median = values[(n_finite - 1) // 2 : n_finite // 2 + 1].mean()
        return cls(
            n_finite, float(total / n_finite), float(median), *values[[0, n_finite - 1]].tolist()
        )


def compute_statistics(groups: Sequence[PointSelection], variable: str) -> list[Statistics]:
    """Return the statistics of a variable over the points of each group, in one reading pass."""
    indices_by_group = [
        {dim: np.asarray(table.index) for dim, table in g.dim_tables.items()} for g in groups
    ]
    arrays = [
        to_float_with_nan(g.dataset[variable].isel(group_indices))
        for g, group_indices in zip(groups, indices_by_group, strict=True)
    ]
    with TemporaryFile() as file:  # the values may exceed the memory
        sizes = [array.size for array in arrays]
        buffer = np.memmap(file, float, "w+", shape=(sum(sizes) + 1,)).view(np.ndarray)
        group_buffers = np.split(buffer, np.cumsum(sizes))[:-1]
        dask.array.store(
            [array.where(np.isfinite(array)).chunk().data for array in arrays],
            [
                group_buffer.reshape(array.shape)
                for group_buffer, array in zip(group_buffers, arrays, strict=True)
            ],
        )
        return [Statistics.from_values(group_buffer) for group_buffer in group_buffers]
