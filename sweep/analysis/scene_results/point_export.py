"""Export of point clouds to files for other programs: CloudCompare, PyVista, GIS, spreadsheets."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sweep.analysis import labels
from sweep.analysis.scene_results.consistency import check_error_consistency
from sweep.analysis.scene_results.recordings import (
    INTERPOLATED_RANGES,
    QUANTISED_RANGES,
    QUANTITY_BY_NAME,
    AxisPosition,
    Recording,
    find_axis_position,
)
from sweep.analysis.study_figures import SceneResults
from sweep.model.outputs import CLOSING_SIGN_NOTE
from sweep.model.pointcloud.pairing import FLAG_BITS, TRUE_RETURN_FLAG
from sweep.spec import Mistake, SpecError
from sweep.spec.rules import suggest_similar_name
from sweep.storage.locations import Location, write_path_atomically

POINT_DTYPE = np.dtype(
    [
        *((name, "<f8") for name in (
            "x", "y", "z", "time", "range", "radial_velocity", "range_standard_error",
            "radial_velocity_standard_error", "snr", "pd", "true_range", "true_radial_velocity",
        )),
        ("surface", "<i2"), ("flags", "|u1"), ("beam", "<i4"), ("shot", "<u4"),
        ("return_number", "|u1"), ("number_of_returns", "|u1"), ("scan_angle", "<f8"),
    ]
)  # fmt: skip
"""NumPy structured type of a point in a file: its columns in order.

The returns of a shot and draw are numbered from 1 in stored order: confirmed before unconfirmed
ones, strong before weak ones. The scan angle is the angle between beam and nadir [deg]. It is
negative to the left of the ground track, or of the x axis if the platform has no horizontal
velocity.
"""

POINT_COLUMNS: tuple[str, ...] = POINT_DTYPE.names or ()
"""Names of the columns of points, in the order in which files have them."""

UNIT_BY_COLUMN = {
    n: QUANTITY_BY_NAME[n].units
    for n in POINT_COLUMNS
    if n in QUANTITY_BY_NAME and QUANTITY_BY_NAME[n].units != "1"
}
"""Unit of each column of points that has a unit."""
UNIT_BY_COLUMN["scan_angle"] = "deg"

REMARK_BY_COLUMN = dict.fromkeys(("radial_velocity", "true_radial_velocity"), CLOSING_SIGN_NOTE)
"""Remark on the sign of the values, for each column with a radial velocity."""

DESCRIPTION_BY_COLUMN = {
    name: "; ".join(filter(None, [UNIT_BY_COLUMN.get(name), REMARK_BY_COLUMN.get(name)]))
    for name in POINT_COLUMNS
}
"""Unit and remark of each column of points; an empty text for a pure number."""


@dataclass(frozen=True)
class PointTable:
    """Points of one draw of a recording, in the coordinates and times of the scene's files."""

    recording: Recording
    """Recording of a scanner."""
    draw_number: int
    """Number of the draw."""
    range_kind: str
    """Kind of the ranges that are written: ``interpolated`` or ``quantised``."""
    origin: np.ndarray
    """Offset (3,) from the stored coordinates to those of the scene's files [m]."""
    time_origin: float = 0.0
    """Offset from the stored times to those of the scene's files [s]."""
    projection_wkt: str = ""
    """WKT of the map projection of the coordinates; empty if unknown."""

    def iter_rows(self) -> Iterator[np.ndarray]:
        """Yield arrays of points (m,) of type `POINT_DTYPE`, one part of the flight at a time."""
        stored_columns = [
            name for name in POINT_COLUMNS if name not in ("number_of_returns", "scan_angle")
        ]
        for shot_slice in self.recording.iter_shot_slices():
            column_arrays = self.recording.point_columns(
                [*stored_columns, "returns"], shot_slice, self.draw_number, self.range_kind
            )
            rows = np.zeros(column_arrays["x"].size, POINT_DTYPE)
            for name in stored_columns:
                rows[name] = column_arrays[name]
            rows["return_number"] += 1
            rows["number_of_returns"] = column_arrays["returns"]
            rows["scan_angle"] = self._scan_angles(shot_slice)[rows["shot"] - shot_slice.start]
            rows["time"] += self.time_origin
            for axis, origin_offset in zip("xyz", self.origin, strict=True):
                rows[axis] += origin_offset
            yield rows

    def _scan_angles(self, shot_slice: slice) -> np.ndarray:
        """Return the scan angles (k,) of the k shots of a slice [deg] (see `POINT_DTYPE`)."""
        beam_directions, velocities = (
            self.recording.read_array(name, shot_slice)
            for name in ("beam_direction", "platform_velocity")
        )
        is_still = np.hypot(velocities[:, 0], velocities[:, 1]) < 1e-9 * np.linalg.norm(
            velocities, axis=1
        )
        headings = np.where(is_still[:, None], [1.0, 0.0, 0.0], velocities)
        right_component = (
            beam_directions[:, 0] * headings[:, 1] - beam_directions[:, 1] * headings[:, 0]
        )
        nadir_angle = np.degrees(
            np.arctan2(
                np.hypot(beam_directions[:, 0], beam_directions[:, 1]), -beam_directions[:, 2]
            )
        )
        return np.where(right_component < 0, -nadir_angle, nadir_angle)

    def count_points(self) -> int:
        """Return the number of points of the table."""
        return sum(
            int((self.recording.read_array("flags", shot_slice, self.draw_number) > 0).sum())
            for shot_slice in self.recording.iter_shot_slices()
        )

    def coordinate_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest x, y and z of all points, as two arrays (3,) [m].

        Without points all limits are infinite.
        """
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for shot_slice in self.recording.iter_shot_slices():
            column_arrays = self.recording.point_columns(
                "xyz", shot_slice, self.draw_number, self.range_kind
            )
            coordinates = np.array([*column_arrays.values()]) + self.origin[:, None]
            low = np.minimum(low, coordinates.min(axis=1, initial=np.inf))
            high = np.maximum(high, coordinates.max(axis=1, initial=-np.inf))
        return low, high


FileRemarks = Sequence[str]
"""Remarks on the contents of a file. Writers put them into the file if its format allows."""

_PLY_TYPE_BY_DTYPE = {
    "<f8": "double", "<i2": "short", "|u1": "uchar", "<i4": "int", "<u4": "uint",
}  # fmt: skip
"""Name of the PLY type of a column, by the column's NumPy type."""


def write_ply(table: PointTable, file_path: Path, remarks: FileRemarks) -> int:
    """Write a binary PLY file with the columns as properties; return the number of points."""
    n_points = table.count_points()
    comments = [*remarks, *(f"{name}: {remark}" for name, remark in REMARK_BY_COLUMN.items())]
    for unit in dict.fromkeys(UNIT_BY_COLUMN.values()):
        comments.append(
            f"{' '.join(n for n, column_unit in UNIT_BY_COLUMN.items() if column_unit == unit)} in "
            f"{unit}"
        )
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {' '.join(text.split())}" for text in comments),
        f"element vertex {n_points}",
        *(f"property {_PLY_TYPE_BY_DTYPE[POINT_DTYPE[name].str]} {name}" for name in POINT_COLUMNS),
        "end_header",
    ]
    with file_path.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii", "replace"))
        for rows in table.iter_rows():
            file.write(rows.tobytes())
    return n_points


def write_csv(table: PointTable, file_path: Path, remarks: FileRemarks) -> int:
    """Write a CSV file with names and units in the first line, in full precision.

    Return the number of points.
    """
    n_points = 0
    with file_path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(labels.column_label(n, DESCRIPTION_BY_COLUMN[n]) for n in POINT_COLUMNS)
        for rows in table.iter_rows():
            writer.writerows(rows.tolist())
            n_points += rows.size
    return n_points


LAS_COORDINATE_STEP_MIN = 1e-4
"""Least quantisation step of coordinates in a LAS file [m]. A large cloud needs a larger step."""

LAS_COORDINATE_STEPS_MAX = 2.0**31 - 1
"""Largest distance of a coordinate from the offset of a LAS file, in quantisation steps."""
LAS_RETURN_NUMBER_MAX = 15
"""Largest number that a return can have in a LAS file."""

_LAS_STANDARD_COLUMNS = {"x", "y", "z", "time", "return_number", "number_of_returns", "scan_angle"}
"""Names of the columns with a field in LAS point format 6. All others become extra bytes."""

_LAS_SCAN_ANGLE_STEP_DEG = 0.006
"""Quantisation step of scan angles in a LAS file [deg]."""

_STORED_RETURN_NUMBER_FIELD = "stored_return"
"""Name of the extra field of a LAS point that holds the return's number in the store, from 1."""

_LAS_BEAM_NUMBER_MAX = 255
"""Largest beam number that the user data of a LAS point can hold."""

LAS_UNCLASSIFIED_CLASS, LAS_NOISE_CLASS = 1, 7
"""LAS classes of true points and of false points."""


def write_las(
    table: PointTable, file_path: Path, remarks: FileRemarks, *, compressed: bool = False
) -> int:
    """Write a LAS 1.4 file of point format 6; return the number of points.

    Columns without a field in this format become extra bytes. True returns of a shot are numbered
    by rising range, as the format requires. False points have the class of noise, and are numbered
    separately. User data contains the beam number (255 for any larger one). Times are GPS times.
    The intensity is the signal-to-noise ratio in 0.01 dB. The map projection is stated if it is
    known.
    """
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6)
    extra_columns = [name for name in POINT_COLUMNS if name not in _LAS_STANDARD_COLUMNS]
    header.add_extra_dims(
        [
            *(
                laspy.ExtraBytesParams(n, POINT_DTYPE[n], description=DESCRIPTION_BY_COLUMN[n])
                for n in extra_columns
            ),
            laspy.ExtraBytesParams(
                _STORED_RETURN_NUMBER_FIELD, "|u1", description="return_number in the store"
            ),
        ]
    )
    low, high = table.coordinate_limits()
    has_points = bool(np.isfinite(low).all())
    header.global_encoding.wkt = bool(table.projection_wkt)
    if table.projection_wkt:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(table.projection_wkt))
    header.offsets = np.round((low + high) / 2) + 0.0 if has_points else np.zeros(3)
    header.scales = np.full(
        3, _las_coordinate_step(float((high - low).max()) if has_points else 0.0)
    )
    header.generating_software = "sweep"
    header.system_identifier = "simulated FMCW Doppler lidar"[:32]
    n_points = 0
    with laspy.open(file_path, mode="w", header=header, do_compress=compressed) as writer:
        for rows in table.iter_rows():
            writer.write_points(_to_las_points(rows, header, extra_columns))
            n_points += rows.size
    return n_points


def _las_coordinate_step(extent: float) -> float:
    """Return the quantisation step [m], a power of ten, for coordinates of a given extent [m]."""
    return LAS_COORDINATE_STEP_MIN * 10.0 ** max(
        0,
        math.ceil(
            math.log10((extent / 2 + 1) / (LAS_COORDINATE_STEP_MIN * LAS_COORDINATE_STEPS_MAX))
        ),
    )


def _to_las_points(rows: np.ndarray, header, extra_columns: Sequence[str]):  # type: ignore[no-untyped-def]
    """Return points of `POINT_DTYPE` as points of a LAS file with the given header.

    `extra_columns` are the names of the columns that become extra bytes.
    """
    import laspy

    points = laspy.ScaleAwarePointRecord.zeros(rows.size, header=header)
    for axis in "xyz":
        points[axis] = rows[axis]
    points["gps_time"] = rows["time"]
    for name, return_numbers in zip(
        ("return_number", "number_of_returns"), _assign_return_numbers(rows), strict=True
    ):
        points[name] = np.minimum(return_numbers, LAS_RETURN_NUMBER_MAX)
    points[_STORED_RETURN_NUMBER_FIELD] = rows["return_number"]
    points["user_data"] = np.minimum(rows["beam"], _LAS_BEAM_NUMBER_MAX)
    points["scan_angle"] = np.round(rows["scan_angle"] / _LAS_SCAN_ANGLE_STEP_DEG)
    points["classification"] = np.where(
        rows["flags"] & TRUE_RETURN_FLAG, LAS_UNCLASSIFIED_CLASS, LAS_NOISE_CLASS
    )
    snr_db = 10 * np.log10(np.maximum(rows["snr"], 1e-30))
    points["intensity"] = np.clip(np.round(100 * np.nan_to_num(snr_db)), 0, 65535)
    for name in extra_columns:
        points[name] = rows[name]
    return points


def _assign_return_numbers(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the points among the returns of their shots, from 1 by rising range.

    True and false points are numbered separately. ``rows`` are points of `POINT_DTYPE`, and contain
    all points of each shot.

    Returns
    -------
    tuple of numpy.ndarray
        Return number (n,) of each of n points, and the number (n,) of true returns, or of false
        ones, in the point's shot.
    """
    is_false = (rows["flags"] & TRUE_RETURN_FLAG) == 0
    order = np.lexsort((rows["range"], is_false, rows["shot"]))
    starts_group = np.ones(rows.size, bool)
    starts_group[1:] = np.diff(rows["shot"][order].astype(np.int64)) != 0
    starts_group[1:] |= np.diff(is_false[order].astype(np.int8)) != 0
    group_starts = np.flatnonzero(starts_group)
    group_sizes = np.diff(group_starts, append=rows.size)
    return_numbers, return_counts = np.empty((2, rows.size), np.int64)
    return_numbers[order] = np.arange(rows.size) - np.repeat(group_starts, group_sizes) + 1
    return_counts[order] = np.repeat(group_sizes, group_sizes)
    return return_numbers, return_counts


WRITER_BY_SUFFIX: dict[str, Callable[[PointTable, Path, FileRemarks], int]] = {
    ".ply": write_ply,
    ".las": write_las,
    ".laz": partial(write_las, compressed=True),
    ".csv": write_csv,
}
"""Function that writes points to a file and returns their number, by the file's suffix."""


def export(
    store: str | Location,
    file: str | Path,
    *,
    scanner: str | None = None,
    draw: int = 0,
    ranges: str = INTERPOLATED_RANGES,
    where: Mapping[str, object] | None = None,
) -> int:
    """Write the points of one scanner and draw to a file.

    Coordinates are those of the scene's files, in metres: the scene's origin is added to stored
    coordinates. A raster's coordinates in feet are converted to metres. Times are those of the
    platform's table of waypoints; without a table they begin with the flight. Radial
    velocities are positive when closing. Points are written in the order of shots and returns, part
    by part. Points that are not computed yet are left out. The file appears only once it is
    complete.

    Parameters
    ----------
    store
        Store of a scene's point clouds, complete or not.
    file
        File to write. Its suffix defines the format: ``.ply``, ``.las``, ``.laz`` or ``.csv``.
    scanner
        Name of the scanner; optional if there is only one.
    draw
        Number of the draw, from 0.
    ranges
        ``interpolated`` or ``quantised``: which ranges, velocities, positions and standard errors
        to write.
    where
        Value of every coordinate that has several, written as in a spec.

    Returns
    -------
    int
        Number of points.

    Raises
    ------
    NotAStoreError
        The path has no store of a scene.
    SpecError
        The request has mistakes, all of which are listed.
    OSError
        The file can't be written.

    Examples
    --------
    >>> import sweep
    >>> outcome = sweep.run(sweep.load("flight.yaml"), store="export.zarr", progress=False)
    >>> n_points = sweep.export("export.zarr", "points.csv")
    >>> n_points > 0
    True
    """
    results, file, mistakes = SceneResults.from_store(store), Path(file), []
    if file.suffix.lower() not in WRITER_BY_SUFFIX:
        remedy = f"take one of {', '.join(WRITER_BY_SUFFIX)}"
        problem = "must have a suffix that says its format"
        mistakes.append(Mistake("file", problem, str(file), remedy))
    recording, axis_position = resolve_recording(
        results, scanner, draw, ranges, where or {}, mistakes
    )
    origin = np.asarray(results.tree.attrs.get("origin", np.zeros(3)), float)
    attributes = results.tree.attrs
    table = PointTable(
        recording, draw, ranges, origin,
        float(attributes.get("time_origin", 0.0)), str(attributes.get("projection", "")),
    )  # fmt: skip
    with write_path_atomically(file, replace=True) as draft_path:
        return WRITER_BY_SUFFIX[file.suffix.lower()](
            table, draft_path, _file_remarks(results, table, axis_position)
        )


class RequestedRecording(NamedTuple):
    """Recording that a user requests."""

    recording: Recording
    """Shots and points of the requested scanner at the requested axis values."""
    axis_position: AxisPosition
    """Position of the recording along the study's axes."""


def resolve_recording(
    results: SceneResults,
    scanner: str | None,
    draw: int,
    ranges: str,
    where: Mapping[str, object],
    mistakes: Sequence[Mistake] = (),
) -> RequestedRecording:
    """Return the recording that a user requests, and its position along the study's axes.

    Parameters
    ----------
    results
        Opened store of a flight.
    scanner
        Name of the scanner; None for the only one.
    draw
        Number of the draw.
    ranges
        ``interpolated`` or ``quantised``.
    where
        Values of coordinates, written as in a spec.
    mistakes
        Mistakes of the request that are known already, which the error also lists.

    Raises
    ------
    SpecError
        The request has mistakes.
    """
    axis_position = find_axis_position(results.spec, where)
    if all_mistakes := [
        *mistakes,
        *_find_request_mistakes(results, scanner, draw, ranges, axis_position),
    ]:
        raise SpecError(all_mistakes)
    recording = axis_position.open_recording(results.tree, scanner or results.scanners[0])
    return RequestedRecording(recording, axis_position)


def _find_request_mistakes(
    results: SceneResults, scanner: str | None, draw: int, ranges: str, axis_position: AxisPosition
) -> list[Mistake]:
    """Return the mistakes in a user's request for points of a scanner and draw; [] if none."""
    mistakes = []
    scanner_list = ", ".join(results.scanners)
    if scanner is None and len(results.scanners) > 1:
        mistakes.append(
            Mistake("scanner", "must be named where there are several", "", f"{scanner_list}")
        )
    elif scanner is not None and scanner not in results.scanners:
        remedy = suggest_similar_name(
            scanner, results.scanners, fallback=f"there is {scanner_list}"
        )
        mistakes.append(Mistake("scanner", "is no scanner of this study", scanner, remedy))
    n_draws = int(results.spec.draws.number)
    if not 0 <= draw < n_draws:
        problem, remedy = "is no draw of this study", f"they are numbered 0 to {n_draws - 1}"
        mistakes.append(Mistake("draw", problem, str(draw), remedy))
    if ranges not in (INTERPOLATED_RANGES, QUANTISED_RANGES):
        problem = f"must be {INTERPOLATED_RANGES} or {QUANTISED_RANGES}"
        remedy = suggest_similar_name(ranges, (INTERPOLATED_RANGES, QUANTISED_RANGES))
        mistakes.append(Mistake("ranges", problem, ranges, remedy))
    for axis in results.spec.axes:
        if axis.name in axis_position.undetermined_axes:  # the request leaves several values
            axis_parameter = axis.parameters[0]
            value_list = ", ".join(
                labels.format_quantity(v, axis_parameter.units)
                for v in axis_parameter.display_values[:5]
            )
            problem = f"has {axis.size} values, and a file holds the points of one"
            remedy = (
                f"choose {axis_parameter.coordinate_name} from "
                f"{value_list}{', ...' if axis.size > 5 else ''}"
            )
            mistakes.append(Mistake(f"where.{axis_parameter.coordinate_name}", problem, "", remedy))
    return mistakes


def _file_remarks(
    results: SceneResults, table: PointTable, axis_position: AxisPosition
) -> list[str]:
    """Return the remarks to write into a file of points: source, selection, meaning of codes."""
    surface_remarks = [f"surface {i}: {name}" for i, name in enumerate(results.surface_labels)]
    flag_remarks = [
        f"flag {bit}: {labels.coordinate_label(name)}" for name, bit in FLAG_BITS.items()
    ]
    selection_remark = (
        f"scanner {table.recording.scanner}, draw {table.draw_number}, {table.range_kind} ranges"
    )
    consistency_messages = [
        result.message
        for result in check_error_consistency(results.tree)
        if not result.is_consistent and result.scanner == table.recording.scanner
    ]
    return [
        results.source_note,
        *consistency_messages,
        ", ".join(filter(None, [selection_remark, axis_position.label])),
        *surface_remarks,
        *flag_remarks,
    ]
