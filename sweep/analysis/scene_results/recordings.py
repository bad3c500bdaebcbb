"""Recordings of scanners: shots and points read in parts, and point clouds gathered from them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.datasets import (
    chunk_aligned_slices,
    read_attributes_of_kind,
    stored_chunk_length,
)
from sweep.analysis.selection import matches_any_value
from sweep.model.outputs import (
    BEAMLET_GEOMETRY_VARIABLES,
    CYCLE_VARIABLES,
    POINT_CLOUD_VARIABLES,
    SHOT_GEOMETRY_VARIABLES,
    SHOT_STATISTIC_VARIABLES,
    XYZ_DIM,
)
from sweep.model.pointcloud.eyepoints import Eyepoints
from sweep.model.pointcloud.pairing import FLAG_BITS, TRUE_RETURN_FLAG
from sweep.scenes.eyepoint_arrays import eyepoints_from_arrays
from sweep.spec import Mistake, SpecError
from sweep.spec.rules import suggest_similar_name
from sweep.storage.locations import (
    PACKED_ATTRIBUTE,
    Location,
    eyepoint_store_location,
    parse_location,
)
from sweep.storage.store_format import OPEN_ZARR_KWARGS, NotAStoreError
from sweep.storage.verified_store import open_verified_store
from sweep.units import QuantityError

if TYPE_CHECKING:
    from sweep.spec import SceneSpec


WORLD_AXES = ("x", "y", "z")
"""Names of the axes of world coordinates."""

QUANTISED_RANGES, INTERPOLATED_RANGES = "quantised", "interpolated"
"""Names of the two kinds of ranges and velocities: from whole bins, or interpolated."""

_INTERPOLATED_ARRAY_BY_QUANTITY = {
    f"{name}{error}": f"{name}_interpolated{error}"
    for name in ("range", "radial_velocity")
    for error in ("", "_standard_error")
}
"""Name of the stored array with interpolated values, for each quantity with such an array."""


def quantity_array_name(name: str, ranges: str) -> str:
    """Return the name of the stored array of a quantity; `ranges` is quantised or interpolated.

    With interpolated ranges it is the array of interpolated values, if the quantity has one.
    """
    return (
        _INTERPOLATED_ARRAY_BY_QUANTITY.get(name, name) if ranges == INTERPOLATED_RANGES else name
    )


CATEGORICAL_QUANTITIES = ("beam", "surface", "flags")
"""Names of quantities whose values are categories, not amounts."""

SIGNED_QUANTITIES = ("radial_velocity", "beam_radial_velocity", "true_radial_velocity")
"""Names of quantities with a colour scale that distinguishes both signs: velocities."""

DECIBEL_QUANTITIES = ("snr", "snr_up")
"""Names of quantities that figures show in decibels: power ratios."""

LOG_SCALE_QUANTITIES = ("pfa_up", "pfa_down")
"""Names of quantities that figures show on a logarithmic scale: false-alarm probabilities."""

POINT_KIND_BITS = {name: bit for name, bit in FLAG_BITS.items() if name != "unconfirmed"}
"""Bit for each kind of point, by the name of the kind.

The flags of each point have exactly one of these bits.
"""


@dataclass(frozen=True)
class Quantity:
    """Description of a quantity that each shot, or each point, has."""

    long_name: str
    """Name of the quantity in labels of figures."""
    units: str
    """Units of the stored values."""
    is_per_point: bool
    """True if each point has a value, False if each shot has a value."""


def _list_quantities() -> dict[str, Quantity]:
    """Return the descriptions of all quantities of shots and points, by the quantity's name."""
    quantities = {}
    for table, is_per_point in (
        (SHOT_GEOMETRY_VARIABLES, False),
        (SHOT_STATISTIC_VARIABLES, False),
        (POINT_CLOUD_VARIABLES, True),
    ):
        for name, output in table.items():
            if XYZ_DIM not in output.dims:
                quantities[name] = Quantity(output.long_name, output.units, is_per_point)
    short_names = {
        "range": "range", "radial_velocity": "radial velocity", "snr": "signal-to-noise ratio",
        "pd": "probability of detection", "time": "time", "beam": "beam", "surface": "surface",
    }  # fmt: skip
    for name, long_name in short_names.items():
        quantities[name] = replace(quantities[name], long_name=long_name)
    altitude = CYCLE_VARIABLES["true_altitude"]
    quantities["altitude"] = Quantity("altitude above ground", altitude.units, False)
    quantities |= {axis: Quantity(axis, "m", True) for axis in WORLD_AXES}
    return quantities | {"shot": Quantity("number of the shot", "1", False)}


QUANTITY_BY_NAME = _list_quantities()
"""Descriptions of all quantities of shots and points, by the quantity's name."""


def quantity_label(name: str) -> str:
    """Return the label of the named quantity, with the units in which figures show it."""
    quantity = QUANTITY_BY_NAME[name]
    return labels.axis_label(
        quantity.long_name, "dB" if name in DECIBEL_QUANTITIES else quantity.units
    )


def to_displayed_values(name: str, values: np.ndarray) -> np.ndarray:
    """Return the values of the named quantity as figures show them, as floats.

    Power ratios become decibels, and flags become indices in `POINT_KIND_BITS`.
    """
    values = np.asarray(values)
    if name == "flags":
        return np.asarray(point_kind_indices(values.astype(int)), float)
    if name in DECIBEL_QUANTITIES:
        is_positive = values > 0
        return np.where(is_positive, 10 * np.log10(np.where(is_positive, values, 1.0)), np.nan)
    return values.astype(float)


def point_kind_indices(flags: np.ndarray) -> np.ndarray:
    """Return the index in `POINT_KIND_BITS` of the kind in each point's flags; -1 for no point."""
    kind_indices = np.full(np.shape(flags), -1)
    for i, bit in enumerate(POINT_KIND_BITS.values()):
        kind_indices[(flags & bit) > 0] = i
    return kind_indices


ColumnArrays = dict[str, np.ndarray]
"""Columns (n,) of a table with n rows, by the column's name."""


ValueLimits = tuple[float, ...]
"""Lowest and highest value of a quantity that are within limits."""

INFINITE_VALUE_LIMITS: ValueLimits = (-np.inf, np.inf)
"""Lowest and highest value that exclude no finite value."""


def within_limits_mask(
    column_arrays: ColumnArrays, limits: Mapping[str, ValueLimits]
) -> np.ndarray:
    """Return a mask of the rows of a table whose values are within limits in every limited column.

    A nan is not within limits.
    """
    masks = [
        (column_arrays[n] >= low) & (column_arrays[n] <= high) for n, (low, high) in limits.items()
    ]
    return np.asarray(np.logical_and.reduce(masks))


@dataclass(frozen=True)
class Recording:
    """Shots and points of one scanner, at one position along the study's axes."""

    scanner: str
    """Name of the scanner."""
    dataset: xr.Dataset
    """Arrays of the scanner at one position along the study's axes."""
    flags_chunk_folder: Location | None = None
    """Folder with the stored chunks of the array `flags` for this scanner and position.

    Chunks in the folder show which shots are computed. The folder is None for a packed store.
    """

    @property
    def n_shots(self) -> int:
        """Number of shots."""
        return int(self.dataset.sizes["shot"])

    def iter_shot_slices(self, time_limits: ValueLimits = INFINITE_VALUE_LIMITS) -> Iterator[slice]:
        """Yield consecutive slices of shots, each of which is read at once.

        Slices without a computed shot within `time_limits`, the earliest and the latest time [s],
        are skipped.
        """
        for shot_slice in chunk_aligned_slices(self.dataset["flags"], "shot"):
            if within_limits_mask(
                {"time": self.read_array("time", shot_slice)}, {"time": time_limits}
            ).any():
                yield shot_slice

    def computed_shot_mask(self, shot_slice: slice, draw: int = 0) -> np.ndarray:
        """Return a mask (k,) of the k shots of a slice whose points are computed for a draw.

        A shot that is not computed has no points, like a shot that detects nothing. Only the
        existence of its stored chunk tells the two apart. The shot's geometry does not, because it
        is stored with the first draw that is computed at any axis position.
        """
        has_geometry = np.isfinite(self.read_array("time", shot_slice))
        if self.flags_chunk_folder is None:
            return has_geometry
        shots_per_chunk, draws_per_chunk = (
            stored_chunk_length(self.dataset["flags"], dim) for dim in ("shot", "draw")
        )
        is_chunk_stored = [
            (
                self.flags_chunk_folder / f"{chunk_number}" / f"{draw // draws_per_chunk}" / "0"
            ).exists()
            for chunk_number in range(
                shot_slice.start // shots_per_chunk, (shot_slice.stop - 1) // shots_per_chunk + 1
            )
        ]
        chunk_of_shot = (
            np.arange(shot_slice.start, shot_slice.stop) // shots_per_chunk
            - shot_slice.start // shots_per_chunk
        )
        return has_geometry & np.array(is_chunk_stored)[chunk_of_shot]

    def read_array(self, name: str, shot_slice: slice, draw: int | None = None) -> np.ndarray:
        """Return the values of a stored array over a slice of shots.

        `draw` is the number of the draw; None for an array without draws.
        """
        array = self.dataset[name].isel(shot=shot_slice)
        return np.asarray((array if draw is None else array.isel(draw=draw)).values)

    def point_columns(
        self, names: Sequence[str], shot_slice: slice, draw: int = 0, ranges: str = QUANTISED_RANGES
    ) -> ColumnArrays:
        """Return the named quantities of all m points of a slice of shots and a draw, (m,) each.

        Names are those of :data:`QUANTITY_BY_NAME`, ``return_number``, and ``returns`` (number of
        points of the same shot). ``ranges`` is ``quantised`` or ``interpolated``.
        """
        has_point = self.read_array("flags", shot_slice, draw) > 0
        shot_index, return_number = np.nonzero(has_point)
        column_arrays: ColumnArrays = {}
        for name in names:
            if name in ("x", "y", "z"):
                if name not in column_arrays:
                    positions = self._point_positions(
                        shot_slice, has_point, shot_index, draw, ranges
                    )
                    column_arrays |= dict(zip("xyz", positions.T, strict=True))
            elif name == "return_number":
                column_arrays[name] = return_number
            elif name == "returns":
                column_arrays[name] = has_point.sum(axis=1)[shot_index]
            elif QUANTITY_BY_NAME[name].is_per_point:
                column_arrays[name] = self.read_array(
                    quantity_array_name(name, ranges), shot_slice, draw
                )[has_point]
            else:
                column_arrays[name] = self.shot_values(name, shot_slice)[shot_index]
        return {name: column_arrays[name] for name in names}

    def read_thinned_rows(
        self,
        names: Sequence[str],
        rows_max: int,
        *,
        draw: int = 0,
        ranges: str = QUANTISED_RANGES,
        time_limits: ValueLimits | None = None,
    ) -> ThinnedRows:
        """Return at most ``rows_max`` evenly spaced rows of the named quantities of all points.

        If all quantities belong to shots, the rows are the computed shots. ``time_limits`` are the
        earliest and the latest time [s].
        """
        is_per_point = any(QUANTITY_BY_NAME[name].is_per_point for name in names)
        limits = {"time": time_limits} if time_limits else {}
        thinned = ThinnedRows(rows_max)
        for shot_slice in self.iter_shot_slices(time_limits or INFINITE_VALUE_LIMITS):
            if is_per_point:
                names_read = list(dict.fromkeys([*names, "flags", "time"]))
                column_arrays = self.point_columns(names_read, shot_slice, draw, ranges)
            else:
                is_computed = self.computed_shot_mask(shot_slice, draw)
                names_read = list(dict.fromkeys([*names, "time"]))
                column_arrays = {
                    name: self.shot_values(name, shot_slice)[is_computed] for name in names_read
                }
            thinned.append(select_rows_within(column_arrays, limits))
        return thinned

    def _point_positions(
        self,
        shot_slice: slice,
        has_point: np.ndarray,
        shot_index: np.ndarray,
        draw: int,
        ranges: str,
    ) -> np.ndarray:
        """Return the world positions of points (m, 3) [m], for quantised or interpolated ranges.

        `has_point` is the mask of the stored points of the slice. `shot_index` (m,) is the index
        within the slice of each point's shot.
        """
        position = self.read_array("position", shot_slice, draw)[has_point]
        if ranges == QUANTISED_RANGES:
            range_change = self.read_array("range", shot_slice, draw) - self.read_array(
                "range_interpolated", shot_slice, draw
            )
            position = (
                position
                + range_change[has_point][:, None]
                * self.read_array("beam_direction", shot_slice)[shot_index]
            )
        return position

    def shot_values(self, name: str, shot_slice: slice) -> np.ndarray:
        """Return the named quantity of the k shots of a slice, (k,)."""
        if name == "shot":
            return np.arange(shot_slice.start, shot_slice.stop)
        if name == "altitude":
            cycle = np.arange(shot_slice.start, shot_slice.stop) // int(
                self.dataset.attrs["shots_a_cycle"]
            )
            altitudes = self.dataset["true_altitude"].isel(cycle=slice(cycle[0], cycle[-1] + 1))
            return np.asarray(altitudes.values)[cycle - cycle[0]]
        return self.read_array(name, shot_slice)

    def beam_axis_hit_points(self, shot_slice: slice) -> np.ndarray:
        """Return the points (k, 3) [m] where the beam axes of k shots meet the scene, or nan.

        `shot_slice` is the slice of the k shots.
        """
        beam_range = self.read_array("beam_range", shot_slice)
        beam_range = np.where(np.isfinite(beam_range), beam_range, np.nan)[:, None]
        return self.read_array("platform_position", shot_slice) + beam_range * self.read_array(
            "beam_direction", shot_slice
        )


def find_multi_surface_shot(recording: Recording, draw: int = 0) -> int | None:
    """Return the number of the first shot that has true points on two surfaces in a draw.

    Without one, return the number of the first shot whose spectrum without noise has two groups of
    adjacent bins above the threshold. Without either kind of shot, return None.
    """
    fallback_shot = None
    for shot_slice in recording.iter_shot_slices():
        surface_numbers = np.where(
            (recording.read_array("flags", shot_slice, draw) & TRUE_RETURN_FLAG) > 0,
            recording.read_array("surface", shot_slice, draw).astype(float), np.nan,
        )  # fmt: skip
        low = np.where(np.isnan(surface_numbers), np.inf, surface_numbers).min(axis=1)
        high = np.where(np.isnan(surface_numbers), -np.inf, surface_numbers).max(axis=1)
        multi_surface_shots = np.flatnonzero(high > low)
        if multi_surface_shots.size:
            return shot_slice.start + int(multi_surface_shots[0])
        if fallback_shot is None:
            multi_group_shots = np.flatnonzero(
                recording.read_array("surfaces_seen", shot_slice) >= 2
            )
            fallback_shot = (
                shot_slice.start + int(multi_group_shots[0]) if multi_group_shots.size else None
            )
    return fallback_shot


def select_rows_within(
    column_arrays: ColumnArrays, limits: Mapping[str, ValueLimits]
) -> ColumnArrays:
    """Return the rows of a table that are within limits in every limited column, as columns."""
    if not limits:
        return column_arrays
    is_inside = within_limits_mask(column_arrays, limits)
    return {name: values[is_inside] for name, values in column_arrays.items()}


class ThinnedRows:
    """Rows collected part by part. If they are too many, only every n-th row is kept.

    The step n is a power of two.
    """

    def __init__(self, rows_max: int) -> None:
        self.rows_max, self.step, self.n_total = rows_max, 1, 0
        self._tables: list[ColumnArrays] = []

    def append(self, column_arrays: ColumnArrays) -> None:
        """Append the rows of a table in place, and thin all rows if they are too many."""
        start = -self.n_total % self.step
        self.n_total += len(next(iter(column_arrays.values())))
        self._tables.append(
            {n: values[start :: self.step].copy() for n, values in column_arrays.items()}
        )
        while self.n_total > self.rows_max * self.step:
            self.step *= 2
            self._tables = [{n: values[::2].copy() for n, values in self.to_columns().items()}]

    def describe_count(self, noun: str, qualifier: str = "") -> str:
        """Return a text with the number of all appended rows, and with the share that is kept.

        `noun` names a row, and `qualifier` is put behind it.
        """
        kept_note = f", one in {self.step} of them shown" if self.step > 1 else ""
        return labels.number_with_noun(self.n_total, noun) + qualifier + kept_note

    def to_columns(self) -> ColumnArrays:
        """Return the kept rows as columns by name; an empty dict if no table was appended."""
        if not self._tables:
            return {}
        return {n: np.concatenate([part[n] for part in self._tables]) for n in self._tables[0]}


@dataclass(frozen=True)
class AxisPosition:
    """Position along the axes of a study."""

    axis_indices: dict[str, int]
    """Index along each axis, by the axis's name."""
    label: str
    """Text with the coordinates of the position."""
    undetermined_axes: tuple[str, ...]
    """Names of the axes along which the request matches several values."""

    def open_recording(self, tree: xr.DataTree, scanner: str) -> Recording:
        """Return the recording of a scanner at this position."""
        group = tree.children[scanner].to_dataset(inherit=False)
        if PACKED_ATTRIBUTE in tree.attrs:
            return Recording(scanner, group.isel(self.axis_indices))
        flags_folder = parse_location(str(tree.encoding["source"])) / scanner / "flags" / "c"
        return Recording(
            scanner,
            group.isel(self.axis_indices),
            flags_folder.joinpath(*map(str, self.axis_indices.values())),
        )


def find_axis_position(spec: SceneSpec, where: Mapping[str, object]) -> AxisPosition:
    """Return the first position along a study's axes at which coordinates have requested values.

    Parameters
    ----------
    spec
        Spec of the study.
    where
        One or several values for each coordinate, written as in a spec. For the name of an axis,
        the values are indices along it.

    Raises
    ------
    SpecError
        A coordinate or a value does not exist; all of them are listed.
    """
    allowed_by_axis = {axis.name: np.ones(axis.size, bool) for axis in spec.axes}
    mistakes = []
    for name, raw_value in where.items():
        wanted_values = list(raw_value) if isinstance(raw_value, tuple | list) else [raw_value]
        try:
            axis, is_wanted, available = _axis_and_mask_of_values(spec, name, wanted_values)
            allowed_by_axis[axis] &= is_wanted
            if not allowed_by_axis[axis].any():
                raise QuantityError("is no value of this study", available)
        except QuantityError as error:
            mistakes.append(Mistake(f"where.{name}", error.rule, f"{raw_value}", error.suggestion))
    if mistakes:
        raise SpecError(mistakes)
    axis_indices = {name: int(np.argmax(is_wanted)) for name, is_wanted in allowed_by_axis.items()}
    undetermined_axes = tuple(
        name for name, is_wanted in allowed_by_axis.items() if is_wanted.sum() > 1
    )
    return AxisPosition(axis_indices, _axis_position_label(spec, axis_indices), undetermined_axes)


def axis_position_at(spec: SceneSpec, value_numbers: Sequence[int]) -> AxisPosition:
    """Return the axis position with the indices `value_numbers`, in the order of `spec.axes`."""
    axis_indices = {
        axis.name: number for axis, number in zip(spec.axes, value_numbers, strict=True)
    }
    return AxisPosition(axis_indices, _axis_position_label(spec, axis_indices), ())


def _axis_and_mask_of_values(
    spec: SceneSpec, name: str, wanted_values: list[object]
) -> tuple[str, np.ndarray, str]:
    """Return the axis of a coordinate and a mask of the requested values along the axis.

    Raise QuantityError if no axis has the coordinate.

    Returns
    -------
    axis_name : str
        Name of the axis of the coordinate.
    is_wanted : numpy.ndarray
        Mask of the requested values along the axis.
    available : str
        Text with the values that exist.
    """
    for axis in spec.axes:
        for axis_parameter in axis.parameters:
            if name == axis_parameter.coordinate_name:
                coordinate_values: list[object] = [
                    spec.read_coordinate_value(name, value) for value in wanted_values
                ]
                value_texts = [
                    labels.format_quantity(value, axis_parameter.units)
                    for value in axis_parameter.display_values[:8]
                ]
                available = f"it has {', '.join(value_texts)}" + (", ..." if axis.size > 8 else "")
                return (
                    axis.name,
                    matches_any_value(np.asarray(axis_parameter.display_values), coordinate_values),
                    available,
                )
        if name == axis.name:
            is_wanted = np.isin(np.arange(axis.size), [int(str(v)) for v in wanted_values])
            return axis.name, is_wanted, f"they are numbered 0 to {axis.size - 1}"
    coordinate_names = [
        axis_parameter.coordinate_name for axis in spec.axes for axis_parameter in axis.parameters
    ]
    otherwise = (
        f"the coordinates are {', '.join(coordinate_names)}"
        if coordinate_names
        else "it has no axes"
    )
    raise QuantityError(
        "is no coordinate of this study",
        suggest_similar_name(name, coordinate_names, fallback=otherwise),
    )


def _axis_position_label(spec: SceneSpec, axis_indices: Mapping[str, int]) -> str:
    """Return a text with the coordinates of a position; axes with a single value are left out."""
    return ", ".join(
        labels.format_coordinate_value(
            axis_parameter.coordinate_name,
            axis_parameter.display_values[axis_indices[axis.name]],
            axis_parameter.units,
        )
        for axis in spec.axes
        if axis.size > 1
        for axis_parameter in axis.parameters
    )


CLOUD_POINTS_MAX, CLOUD_DROPOUTS_MAX, CLOUD_PATH_POINTS_MAX = 120_000, 20_000, 2000
"""Largest numbers of points, of shots without a point, and of path positions in a picture."""

BOX_MARGIN_FRACTION = 0.04
"""Margin around the points of a picture, as a fraction of the longest side of their box."""

CoordinateBox = dict[str, tuple[float, float]]
"""Box that bounds a picture: lowest and highest value [m] by axis, x, y and z."""


@dataclass(frozen=True)
class PointCloud:
    """Points of a picture, with the flight path and dropouts (shots that gave no point)."""

    points: ColumnArrays
    """Columns of the points: x, y, z, flags, and the requested quantities."""
    flight_path: ColumnArrays
    """Columns x, y and z of the flight path [m]; empty if it was not requested."""
    thinned_points: ThinnedRows
    """Points inside and outside the box, with the number of points before thinning."""
    thinned_dropouts: ThinnedRows
    """Positions of the dropouts, with their number before thinning."""
    n_false_points_outside: int
    """Number of false points that are left out because they lie outside the box."""
    box: CoordinateBox
    """Bounds of the picture along x, y and z."""

    @property
    def dropouts(self) -> ColumnArrays:
        """Columns x, y and z [m] of the points where the beam axes of dropouts meet the scene.

        The columns are empty if dropouts were not requested.
        """
        return self.thinned_dropouts.to_columns()

    @property
    def true_point_mask(self) -> np.ndarray:
        """Mask of the true points among the rows of `points`."""
        return np.asarray((self.points["flags"] & TRUE_RETURN_FLAG) > 0)

    @property
    def remarks(self) -> list[str]:
        """Sentences on the numbers of points, dropouts and omitted false points."""
        count_texts = [self.thinned_points.describe_count("point")]
        if self.dropouts:
            count_texts.append(self.thinned_dropouts.describe_count("shot", " without a point"))
        if self.n_false_points_outside:
            count_texts.append(
                f"{labels.number_with_noun(self.n_false_points_outside, 'false point')}"
                " outside of the picture"
            )
        return count_texts


def gather_point_cloud(
    recording: Recording,
    names: Sequence[str],
    *,
    ranges: str,
    draw: int = 0,
    crops: Mapping[str, ValueLimits] | None = None,
    with_dropouts: bool = False,
    with_path: bool = False,
    points_max: int = CLOUD_POINTS_MAX,
) -> PointCloud | None:
    """Return the points of a recording within limits, with flight path and dropouts, for a picture.

    Parameters
    ----------
    recording
        Recording of a scanner.
    names
        Quantities of the points, in addition to position and flags.
    ranges
        ``quantised`` or ``interpolated``.
    draw
        Number of the draw.
    crops
        Lowest and highest value of quantities, by name. Points outside are left out.
    with_dropouts, with_path
        If true, the shots without a point, or the flight path, are read too.
    points_max
        Largest number of points. Of more points only some are read, evenly spaced.

    Returns
    -------
    PointCloud or None
        None if no point is within the limits.
    """
    crops = dict(crops or {})
    coordinate_crops = {name: crop for name, crop in crops.items() if name in WORLD_AXES}
    kept_names = list(dict.fromkeys([*WORLD_AXES, "flags", *names]))
    thinned_points, thinned_dropouts, thinned_path = (
        ThinnedRows(points_max),
        ThinnedRows(CLOUD_DROPOUTS_MAX),
        ThinnedRows(CLOUD_PATH_POINTS_MAX),
    )
    time_limits = crops.get("time", INFINITE_VALUE_LIMITS)
    for shot_slice in recording.iter_shot_slices(time_limits):
        point_columns = recording.point_columns(
            list(dict.fromkeys([*kept_names, *crops])), shot_slice, draw, ranges
        )
        cropped_columns = select_rows_within(point_columns, crops)
        thinned_points.append({name: cropped_columns[name] for name in kept_names})
        time = recording.read_array("time", shot_slice)
        is_in_time = within_limits_mask({"time": time}, {"time": time_limits})
        if with_dropouts:
            has_no_point = ~(recording.read_array("flags", shot_slice, draw) > 0).any(axis=-1)
            has_no_point &= recording.computed_shot_mask(shot_slice, draw) & (
                is_in_time | ("time" not in crops)
            )
            beam_axis_hit_points = recording.beam_axis_hit_points(shot_slice)[has_no_point]
            beam_axis_hit_points = beam_axis_hit_points[np.isfinite(beam_axis_hit_points[:, 0])]
            thinned_dropouts.append(
                select_rows_within(
                    dict(zip(WORLD_AXES, beam_axis_hit_points.T, strict=True)), coordinate_crops
                )
            )
        if with_path:
            positions = recording.read_array("platform_position", shot_slice)[is_in_time]
            thinned_path.append(dict(zip(WORLD_AXES, positions.T, strict=True)))
    if not thinned_points.n_total:
        return None
    column_arrays = thinned_points.to_columns()
    box = _bounding_box(
        column_arrays, thinned_dropouts.to_columns(), thinned_path.to_columns(), coordinate_crops
    )
    is_in_box = within_limits_mask(column_arrays, box)
    return PointCloud(
        points={name: values[is_in_box] for name, values in column_arrays.items()},
        flight_path=thinned_path.to_columns(),
        thinned_points=thinned_points,
        thinned_dropouts=thinned_dropouts,
        n_false_points_outside=int((~is_in_box).sum()) * thinned_points.step,
        box=box,
    )


def _bounding_box(
    point_columns: ColumnArrays,
    dropout_columns: ColumnArrays,
    path_columns: ColumnArrays,
    coordinate_crops: Mapping[str, ValueLimits],
) -> CoordinateBox:
    """Return the box of a picture around true points, dropouts and flight path, with a margin.

    `coordinate_crops` are limits of x, y and z [m]; only the margin exceeds them. Without true
    points all points count.
    """
    is_true = (point_columns["flags"] & TRUE_RETURN_FLAG) > 0
    box: CoordinateBox = {}
    for axis in WORLD_AXES:
        values = point_columns[axis][is_true] if is_true.any() else point_columns[axis]
        value_arrays = [values, *(t[axis] for t in (dropout_columns, path_columns) if t)]
        crop_low, crop_high = coordinate_crops.get(axis, INFINITE_VALUE_LIMITS)
        low = min(float(v.min()) for v in value_arrays if v.size)
        high = max(float(v.max()) for v in value_arrays if v.size)
        box[axis] = (max(low, crop_low), min(high, crop_high))
    margin = BOX_MARGIN_FRACTION * max(max(high - low for low, high in box.values()), 1.0)
    return {axis: (low - margin, high + margin) for axis, (low, high) in box.items()}


def read_eyepoints(
    store_path: Location, scanner_dataset: xr.Dataset, shot_indices: np.ndarray
) -> Eyepoints:
    """Read the eyepoints (geometry) of shots of a scanner, given by index, from their own store.

    Raise NotAStoreError if the store of eyepoints is missing.
    """
    eyepoints_store = eyepoint_store_location(store_path, str(scanner_dataset.attrs["geometry_id"]))
    if not eyepoints_store.exists():
        raise NotAStoreError(
            f"the eyepoints of the study are not at {eyepoints_store}: they are kept beside its "
            "store; "
            "running the study again casts them anew"
        )
    study_id = read_attributes_of_kind(eyepoints_store, "eyepoints")["study_id"]
    dataset = xr.open_zarr(
        open_verified_store(eyepoints_store, study_id), chunks=None, **OPEN_ZARR_KWARGS
    )
    selected = dataset.isel(shot=np.asarray(shot_indices))
    arrays = {
        name: np.asarray(selected[name].values)
        for name in (*SHOT_GEOMETRY_VARIABLES, *BEAMLET_GEOMETRY_VARIABLES)
    }
    return eyepoints_from_arrays(arrays, np.asarray(dataset["weight"].values))
