"""Selections of a study's points, statistics of them, and cuts through range and grazing angle.

A selection stores indices along axes. Arrays are read only when values are requested. Large arrays
are reduced, chunk by chunk, to the number of cells that a figure or a page can show.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any, NamedTuple

import dask.array
import numpy as np
import pandas
import xarray as xr

from sweep.analysis import labels

if TYPE_CHECKING:
    from sweep.spec import Axis, AxisParameter, GridSpec, SceneSpec


CELL_MEAN, CELL_LOWEST, CELL_HIGHEST = "mean", "lowest", "highest"
"""Names of the statistics of the points in a cell of a figure."""

PARTIAL_SUM_VALUES_MAX = 2**20
"""Largest number of values in one partial sum. The sum of an array adds its partial sums."""


@dataclass(frozen=True)
class SortedCoordinate:
    """Coordinate along an axis of a figure, in the order of its values."""

    dim: str
    """Dimension of the dataset along which the coordinate lies."""
    indices: np.ndarray
    """Index of each of the `values` along the dimension of the dataset."""
    values: np.ndarray
    """Distinct values of the coordinate, in order."""

    def points_per_cell(self, cells_max: int) -> int:
        """Return the number of adjacent values that share a cell of a figure.

        It is the smallest number for which at most ``cells_max`` cells are needed. For words it is
        1.
        """
        return 1 if labels.is_categorical(self.values) else -(-self.values.size // cells_max)

    def cell_means(self, cells_max: int) -> np.ndarray:
        """Return the mean of the coordinate's values in each cell of a figure.

        Cells hold adjacent values. There are at most ``cells_max`` cells; each word has its own
        cell.
        """
        cell_size = self.points_per_cell(cells_max)
        if cell_size == 1:
            return self.values
        starts = np.arange(0, self.values.size, cell_size)
        sums = np.add.reduceat(self.values, starts)
        return sums / np.diff(starts, append=self.values.size)


def to_float_with_nan(array: xr.DataArray) -> xr.DataArray:
    """Return an array as floats; negative integers, which mark missing counts, become nan."""
    return array if array.dtype.kind == "f" else array.astype(float).where(array >= 0)


@dataclass(frozen=True)
class PointSelection:
    """Selection of points: all combinations of selected indices along a dataset's dimensions."""

    dataset: xr.Dataset
    """Dataset whose points are selected."""
    table_by_dim: Mapping[str, pandas.DataFrame]
    """Table of each dimension. Its rows are the selected indices, its columns the coordinates."""

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
    def n_points(self) -> int:
        """Number of selected points."""
        return math.prod(map(len, self.table_by_dim.values()))

    def dim_of_coordinate(self, name: str) -> str:
        """Return the dimension of the named coordinate, or the name itself if it is a dimension."""
        return next((dim for dim, table in self.table_by_dim.items() if name in table), name)

    def coordinate_values(self, name: str) -> np.ndarray:
        """Return a coordinate's values at the selected indices; the indices if it has no values."""
        table = self.table_by_dim[self.dim_of_coordinate(name)]
        return np.asarray(table.get(name, table.index))

    def coordinate_units(self, name: str) -> str:
        """Return the units of the named coordinate; '' if it has none."""
        coordinate = self.dataset.coords.get(name)
        return "" if coordinate is None else str(coordinate.attrs.get("units", ""))

    def isel(self, dim: str, indices: np.ndarray) -> PointSelection:
        """Return the selection restricted along a dimension to row numbers, or to a row mask."""
        return replace(
            self, table_by_dim={**self.table_by_dim, dim: self.table_by_dim[dim].iloc[indices]}
        )

    def sel(self, name: str, values: list[object]) -> PointSelection:
        """Return the selection of the points at which a coordinate has one of the values."""
        return self.isel(
            self.dim_of_coordinate(name), matches_any_value(self.coordinate_values(name), values)
        )

    def drop_duplicates(self) -> PointSelection:
        """Return the selection without points that repeat an earlier point along a dimension.

        A point repeats another one if all coordinates along the dimension are equal.
        """
        tables = {dim: table.drop_duplicates() if len(table.columns) else table
                  for dim, table in self.table_by_dim.items()}  # fmt: skip
        return replace(self, table_by_dim=tables)

    def unique_values(self, name: str) -> list[object]:
        """Return the values of a coordinate, in the order in which they first appear."""
        return list(pandas.unique(self.coordinate_values(name)))

    def varying_coordinates(self) -> list[str]:
        """Return the names of coordinates with more than one value among the selected points."""
        return [
            n
            for table in self.table_by_dim.values()
            for n in table
            if table[n].nunique(dropna=False) > 1
        ]

    def distinguishing_coordinates(self, names: Sequence[str]) -> list[str]:
        """Return the names of coordinates that distinguish points with equal values of `names`.

        As few coordinates as possible are returned.
        """
        return [
            name
            for dim in self.table_by_dim
            for name in self.distinguishing_coordinates_along(dim, names)
        ]

    def distinguishing_coordinates_along(self, dim: str, names: Sequence[str]) -> list[str]:
        """Return those of the `distinguishing_coordinates` that lie along one dimension."""
        table = self.table_by_dim[dim]
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
        """Return pairs of a coordinate's value and the selection of the points with this value.

        Values are in the order of their first appearance.
        """
        dim = self.dim_of_coordinate(name)
        groups = self.table_by_dim[dim].groupby(
            self.coordinate_values(name), sort=False, dropna=False
        )
        return [
            (value, replace(self, table_by_dim={**self.table_by_dim, dim: table}))
            for value, table in groups
        ]

    def sorted_coordinate(self, name: str) -> SortedCoordinate:
        """Return a coordinate's distinct values, each with one index along the dimension.

        Numbers are in rising order, words in the order of their first appearance.
        """
        values, first_rows = np.unique(self.coordinate_values(name), return_index=True)
        if labels.is_categorical(values):
            order = np.argsort(first_rows)
            values, first_rows = values[order], first_rows[order]
        dim = self.dim_of_coordinate(name)
        return SortedCoordinate(dim, np.asarray(self.table_by_dim[dim].index)[first_rows], values)

    def first_indices(self, *coordinates: SortedCoordinate) -> dict[str, int]:
        """Return the first selected index by dimension.

        The dimensions of `coordinates` are left out.
        """
        shown_dims = {coordinate.dim for coordinate in coordinates}
        return {
            dim: int(table.index[0])
            for dim, table in self.table_by_dim.items()
            if dim not in shown_dims
        }

    def coarsen(
        self, variable: str, coordinates: Sequence[tuple[SortedCoordinate, int]], statistic: str
    ) -> xr.DataArray:
        """Return a variable over some coordinates as a lazy array of cells of adjacent points.

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
            array = {
                CELL_MEAN: coarsened.mean,
                CELL_LOWEST: coarsened.min,
                CELL_HIGHEST: coarsened.max,
            }[statistic]()
        return array.transpose(*points_per_cell)


def matches_any_value(values: np.ndarray, wanted_values: list[object]) -> np.ndarray:
    """Return a mask of the values that equal any wanted value; numbers match to a relative 1e-9."""
    if values.dtype.kind not in "fiu":
        return np.isin([str(v) for v in values], [str(w) for w in wanted_values])
    matches = [np.isclose(values, float(w), rtol=1e-9, atol=0.0) for w in wanted_values]  # type: ignore[arg-type]
    return np.logical_or.reduce(matches)


def select_where(
    points: PointSelection, spec: GridSpec, where: Mapping[str, object]
) -> PointSelection:
    """Return the selection of the points at which coordinates have given values.

    `where` has one or several values for each coordinate, written as in a spec.
    """
    for name, raw_value in where.items():
        wanted_values = list(raw_value) if isinstance(raw_value, tuple | list) else [raw_value]
        if name in points.dataset.coords:
            wanted_values = [spec.read_coordinate_value(name, value) for value in wanted_values]
        points = points.sel(name, wanted_values)
    return points


class NamedPart(NamedTuple):
    """Part of a selection of points, named by the coordinates that are equal at its points."""

    name: str
    """Name of the part, such as ``grazing angle 15°``; '' for the whole selection."""
    points: PointSelection
    """Points of the part."""


class ShownParts(NamedTuple):
    """Parts of a selection that a figure or table has room for."""

    parts: list[NamedPart]
    """Shown parts, evenly spread over all parts."""
    n_omitted: int
    """Number of omitted parts."""


def split_by_coordinates(
    points: PointSelection, names: Sequence[str], parts_max: int
) -> ShownParts:
    """Split a selection by the values of named coordinates, into at most ``parts_max`` parts.

    Without names the selection is the only part.
    """
    parts = [NamedPart("", points)]
    for name in names:
        units = points.coordinate_units(name)
        parts = [
            NamedPart(
                ", ".join(
                    filter(None, [label, labels.format_coordinate_value(name, value, units)])
                ),
                subpart,
            )
            for label, part in parts
            for value, subpart in part.group_by(name)
        ]
    return thin_parts_evenly(parts, parts_max)


def thin_parts_evenly(parts: list[NamedPart], parts_max: int) -> ShownParts:
    """Return at most ``parts_max`` evenly spread parts, with the number of omitted parts."""
    if len(parts) <= parts_max:
        return ShownParts(parts, 0)
    shown_parts = [parts[round(i * (len(parts) - 1) / (parts_max - 1))] for i in range(parts_max)]
    return ShownParts(shown_parts, len(parts) - parts_max)


def find_axis_parameter(spec: GridSpec, path: str) -> AxisParameter | None:
    """Return the parameter with a dotted path if it is on an axis of the study, otherwise None."""
    return next((m for axis in spec.axes for m in axis.parameters if m.path == path), None)


def parameters_at(spec: GridSpec | SceneSpec, axis_indices: Mapping[str, int]) -> dict[str, Any]:
    """Return the SI values of all parameters by dotted path, at an index along each axis."""
    return dict(spec.parameters()) | {
        axis_parameter.path: np.asarray(axis_parameter.values)[axis_indices[axis.name]].item()
        for axis in spec.axes
        for axis_parameter in axis.parameters
    }


RANGE_PATH, GRAZING_ANGLE_PATH = "target.range", "target.grazing_angle"
"""Dotted paths of the parameters range and grazing angle."""
PUBLISHED_CUTS = (
    (GRAZING_ANGLE_PATH, "15 deg"),
    (GRAZING_ANGLE_PATH, "85 deg"),
    (RANGE_PATH, "3500 m"),
)
"""Cuts of the published figures through range and grazing angle.

Each cut has the dotted path and the value of the parameter that is fixed.
"""

FALSE_ALARM_AVERAGING_RANGE_MIN = "5 m"
"""Smallest range of the points over which false alarms are averaged, as text with a unit.

At shorter ranges the shot noise of the echo matters ([T] 4.2).
"""


@dataclass(frozen=True)
class StudyCut:
    """Part of a study in which range is fixed and grazing angle varies, or the reverse."""

    name: str
    """Name of the cut: the value of the fixed coordinate, or 'all' for the complete study."""
    fixed_coordinate: str
    """Name of the fixed coordinate; empty for the complete study."""
    fixed_value: object
    """Value of the fixed coordinate; None for the complete study."""
    varying_coordinate: str
    """Name of the varying coordinate."""

    def select_from(self, points: PointSelection) -> PointSelection:
        """Return those points of a selection that are on the cut, without duplicates."""
        return (
            points.sel(self.fixed_coordinate, [self.fixed_value]).drop_duplicates()
            if self.fixed_coordinate
            else points
        )


def study_cuts(spec: GridSpec) -> list[StudyCut]:
    """Return the cuts of a study along which either range or grazing angle is fixed.

    If both lie on one zipped axis, that axis defines the cuts. Otherwise the cuts are the published
    ones whose fixed value the study has. If it has none, the complete study is the only cut.
    """
    range_parameter, angle_parameter = (
        find_axis_parameter(spec, RANGE_PATH),
        find_axis_parameter(spec, GRAZING_ANGLE_PATH),
    )
    uncut = [
        StudyCut(
            "all",
            "",
            None,
            range_parameter.coordinate_name
            if range_parameter
            else angle_parameter.coordinate_name
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
        fixed_values = _split_axis_into_constant_runs(zipped_axis)
    else:
        published_values = [
            (parameter_by_path[p], spec.read_coordinate_value(p, text))
            for p, text in PUBLISHED_CUTS
        ]
        fixed_values = [
            (m, v) for m, v in published_values if np.isclose(m.display_values, float(v)).any()
        ]
    cut_list = [
        StudyCut(
            labels.format_quantity(value, axis_parameter.units).replace("°", " deg"),
            axis_parameter.coordinate_name,
            value,
            angle_parameter.coordinate_name
            if axis_parameter is range_parameter
            else range_parameter.coordinate_name,
        )
        for axis_parameter, value in fixed_values
    ]
    return cut_list or uncut


def _split_axis_into_constant_runs(axis: Axis) -> list[tuple[AxisParameter, object]]:
    """Divide a zipped axis, along which range and grazing angle vary, into runs.

    In each run one of the two parameters is constant. The result has this parameter and its
    constant value for each run, in order.
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


def select_beyond_range(
    points: PointSelection, spec: GridSpec, distance: str, *, inclusive: bool = False
) -> PointSelection:
    """Return the selection of the points beyond a range, such as "5 m".

    With ``inclusive`` the points at that range belong to the selection too. If range is on no axis,
    all points are returned.
    """
    range_parameter = find_axis_parameter(spec, RANGE_PATH)
    if range_parameter is None:
        return points
    range_min = float(spec.read_coordinate_value(RANGE_PATH, distance))
    ranges = points.coordinate_values(range_parameter.coordinate_name)
    return points.isel(
        points.dim_of_coordinate(range_parameter.coordinate_name),
        ranges >= range_min if inclusive else ranges > range_min,
    )


@dataclass(frozen=True)
class Statistics:
    """Statistics of the finite values of a variable; nan if there are no finite values."""

    n_finite: int
    """Number of finite values."""
    mean: float
    """Mean of the finite values."""
    median: float
    """Median of the finite values."""
    minimum: float
    """Smallest finite value."""
    maximum: float
    """Largest finite value."""

    @classmethod
    def from_values(cls, values: np.ndarray) -> Statistics:
        """Return the statistics of the finite values of an array; nan does not count.

        The array is sorted in place.
        """
        total = sum(
            np.nansum(part)
            for part in np.array_split(values, values.size // PARTIAL_SUM_VALUES_MAX + 1)
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
    """Return the statistics of a variable for each group of points, in order, in one pass."""
    indices_by_group = [
        {dim: np.asarray(table.index) for dim, table in g.table_by_dim.items()} for g in groups
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
