"""Point clouds as files for other programs: CloudCompare, PyVista, GIS, spreadsheets."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from sweep.analysis import labels
from sweep.analysis.consistency import consistency
from sweep.analysis.figures import SceneStudy
from sweep.analysis.scenes.recording import (
    INTERPOLATED,
    QUANTISED,
    QUANTITIES,
    Place,
    Recording,
    place,
)
from sweep.model.outputs import CLOSING
from sweep.model.pairing import FLAGS, TRUE
from sweep.spec import Mistake, SpecError
from sweep.spec.rules import near_miss
from sweep.storage.locations import Location, draft

ROW = np.dtype(
    [
        *((name, "<f8") for name in (
            "x", "y", "z", "time", "range", "radial_velocity", "range_standard_error",
            "radial_velocity_standard_error", "snr", "pd", "true_range", "true_radial_velocity",
        )),
        ("surface", "<i2"), ("flags", "|u1"), ("beam", "<i4"), ("shot", "<u4"),
        ("return_number", "|u1"), ("number_of_returns", "|u1"), ("scan_angle", "<f8"),
    ]
)  # fmt: skip
"""Every column, in the order of files; returns of a shot and draw are numbered from 1 as stored,
confirmed and strong ones first. The scan angle is that of the beam from nadir [deg], below 0 on the
left of the way that the platform goes over the ground (of the x axis where it goes nowhere)."""

COLUMNS: tuple[str, ...] = ROW.names or ()
UNITS = {n: QUANTITIES[n].units for n in COLUMNS if n in QUANTITIES and QUANTITIES[n].units != "1"}
"""Units of the columns that have any."""
UNITS["scan_angle"] = "deg"

REMARKS = dict.fromkeys(("radial_velocity", "true_radial_velocity"), CLOSING)
"""What a value of a column means beyond its units."""

MEANINGS = {name: "; ".join(filter(None, [UNITS.get(name), REMARKS.get(name)])) for name in COLUMNS}
"""Units and remark of each column; empty for a pure number."""


@dataclass(frozen=True)
class PointTable:
    """Points of one draw of a recording, in the coordinates and times of the scene's files."""

    recording: Recording
    draw: int
    ranges: str
    origin: np.ndarray
    """(3,): added to the coordinates in the store [m]."""
    time_origin: float = 0.0
    """Added to the times in the store [s]."""
    projection: str = ""
    """WKT of the coordinates' map projection; empty where none is known."""

    def parts(self) -> Iterator[np.ndarray]:
        """Rows (m,) of ROW, part by part."""
        names = [name for name in COLUMNS if name not in ("number_of_returns", "scan_angle")]
        for part in self.recording.stretches():
            table = self.recording.points([*names, "returns"], part, self.draw, self.ranges)
            rows = np.zeros(table["x"].size, ROW)
            for name in names:
                rows[name] = table[name]
            rows["return_number"] += 1
            rows["number_of_returns"] = table["returns"]
            rows["scan_angle"] = self._scan_angles(part)[rows["shot"] - part.start]
            rows["time"] += self.time_origin
            for axis, shift in zip("xyz", self.origin, strict=True):
                rows[axis] += shift
            yield rows

    def _scan_angles(self, part: slice) -> np.ndarray:
        """Angle of each shot's beam from nadir [deg], (k,), below 0 on the left."""
        beams, moving = (
            self.recording.read(name, part) for name in ("beam_direction", "platform_velocity")
        )
        still = np.hypot(moving[:, 0], moving[:, 1]) < 1e-9 * np.linalg.norm(moving, axis=1)
        ahead = np.where(still[:, None], [1.0, 0.0, 0.0], moving)
        rightwards = beams[:, 0] * ahead[:, 1] - beams[:, 1] * ahead[:, 0]
        angle = np.degrees(np.arctan2(np.hypot(beams[:, 0], beams[:, 1]), -beams[:, 2]))
        return np.where(rightwards < 0, -angle, angle)

    def number(self) -> int:
        """Return the number of points."""
        return sum(
            int((self.recording.read("flags", part, self.draw) > 0).sum())
            for part in self.recording.stretches()
        )

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest coordinates, (3,) each [m]; infinite without a point."""
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for part in self.recording.stretches():
            table = self.recording.points("xyz", part, self.draw, self.ranges)
            places = np.array([*table.values()]) + self.origin[:, None]
            low = np.minimum(low, places.min(axis=1, initial=np.inf))
            high = np.maximum(high, places.max(axis=1, initial=-np.inf))
        return low, high


Remarks = Sequence[str]

_PLY_TYPES = {
    "<f8": "double", "<i2": "short", "|u1": "uchar", "<i4": "int", "<u4": "uint",
}  # fmt: skip


def write_ply(table: PointTable, path: Path, remarks: Remarks) -> int:
    """Write a binary PLY file with the columns as properties; return the number of points."""
    number = table.number()
    comments = [*remarks, *(f"{name}: {remark}" for name, remark in REMARKS.items())]
    for unit in dict.fromkeys(UNITS.values()):
        comments.append(f"{' '.join(n for n, own in UNITS.items() if own == unit)} in {unit}")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {' '.join(text.split())}" for text in comments),
        f"element vertex {number}",
        *(f"property {_PLY_TYPES[ROW[name].str]} {name}" for name in COLUMNS),
        "end_header",
    ]
    with path.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii", "replace"))
        for rows in table.parts():
            file.write(rows.tobytes())
    return number


def write_csv(table: PointTable, path: Path, remarks: Remarks) -> int:
    """Write a CSV file with names and units in its first line, and all digits."""
    number = 0
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(labels.with_brackets(n, MEANINGS[n]) for n in COLUMNS)
        for rows in table.parts():
            writer.writerows(rows.tolist())
            number += rows.size
    return number


FINEST = 1e-4
"""Step of coordinates in a LAS file [m]; coarser where the points lie too far apart for it."""

INTEGERS = 2.0**31 - 1
LARGEST_RETURN = 15
"""Largest coordinates, in steps from the offset, and numbers of returns in a LAS file."""

_STANDARD = {"x", "y", "z", "time", "return_number", "number_of_returns", "scan_angle"}

_SCAN_STEP = 0.006
"""Step of scan angles in a LAS file [deg]."""

_STORED_RETURN = "stored_return"
"""Extra byte that holds the number of a return in the store, from 1."""

_LARGEST_BEAM = 255
"""Largest number of a beam that a LAS file's user data can hold."""

UNCLASSIFIED, NOISE = 1, 7
"""Classes of LAS: points as they are, and points known to be false."""


def write_las(table: PointTable, path: Path, remarks: Remarks, *, compressed: bool = False) -> int:
    """Write a LAS 1.4 file, point format 6, with the other columns as extra bytes.

    True returns of a shot are numbered by rising range, as the format asks. False points have the
    class of noise and are numbered apart. The number of the beam stands as user data too (255 from
    there on), times as GPS times; intensity is the signal-to-noise ratio in hundredths of a
    decibel. The coordinates' projection is stated where it is known.
    """
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6)
    extra = [name for name in COLUMNS if name not in _STANDARD]
    header.add_extra_dims(
        [
            *(laspy.ExtraBytesParams(n, ROW[n], description=MEANINGS[n]) for n in extra),
            laspy.ExtraBytesParams(_STORED_RETURN, "|u1", description="return_number in the store"),
        ]
    )
    low, high = table.limits()
    found = bool(np.isfinite(low).all())
    header.global_encoding.wkt = bool(table.projection)
    if table.projection:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(table.projection))
    header.offsets = np.round((low + high) / 2) + 0.0 if found else np.zeros(3)
    header.scales = np.full(3, _step(float((high - low).max()) if found else 0.0))
    header.generating_software = "sweep"
    header.system_identifier = "simulated FMCW Doppler lidar"[:32]
    number = 0
    with laspy.open(path, mode="w", header=header, do_compress=compressed) as writer:
        for rows in table.parts():
            writer.write_points(_las_points(rows, header, extra))
            number += rows.size
    return number


def _step(extent: float) -> float:
    """Step of coordinates that reach so far [m]: a power of ten."""
    return FINEST * 10.0 ** max(0, math.ceil(math.log10((extent / 2 + 1) / (FINEST * INTEGERS))))


def _las_points(rows: np.ndarray, header, extra: Sequence[str]):  # type: ignore[no-untyped-def]
    import laspy

    points = laspy.ScaleAwarePointRecord.zeros(rows.size, header=header)
    for axis in "xyz":
        points[axis] = rows[axis]
    points["gps_time"] = rows["time"]
    for name, numbers in zip(("return_number", "number_of_returns"), _by_range(rows), strict=True):
        points[name] = np.minimum(numbers, LARGEST_RETURN)
    points[_STORED_RETURN] = rows["return_number"]
    points["user_data"] = np.minimum(rows["beam"], _LARGEST_BEAM)
    points["scan_angle"] = np.round(rows["scan_angle"] / _SCAN_STEP)
    points["classification"] = np.where(rows["flags"] & TRUE, UNCLASSIFIED, NOISE)
    decibels = 10 * np.log10(np.maximum(rows["snr"], 1e-30))
    points["intensity"] = np.clip(np.round(100 * np.nan_to_num(decibels)), 0, 65535)
    for name in extra:
        points[name] = rows[name]
    return points


def _by_range(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers by rising range, from 1, and how many there are, of true points and of false.

    Rows of a shot all come together.
    """
    false = (rows["flags"] & TRUE) == 0
    order = np.lexsort((rows["range"], false, rows["shot"]))
    new = np.ones(rows.size, bool)
    new[1:] = np.diff(rows["shot"][order].astype(np.int64)) != 0
    new[1:] |= np.diff(false[order].astype(np.int8)) != 0
    first = np.flatnonzero(new)
    counts = np.diff(first, append=rows.size)
    numbers, totals = np.empty((2, rows.size), np.int64)
    numbers[order] = np.arange(rows.size) - np.repeat(first, counts) + 1
    totals[order] = np.repeat(counts, counts)
    return numbers, totals


WRITERS: dict[str, Callable[[PointTable, Path, Remarks], int]] = {
    ".ply": write_ply,
    ".las": write_las,
    ".laz": partial(write_las, compressed=True),
    ".csv": write_csv,
}
"""Writers of the kinds of files, by suffix."""


def export(
    store: str | Location,
    file: str | Path,
    *,
    scanner: str | None = None,
    draw: int = 0,
    ranges: str = INTERPOLATED,
    where: Mapping[str, object] | None = None,
) -> int:
    """Write the points of one scanner and draw to a file.

    Coordinates are those of the scene's files in metres: the scene's origin is added to what is
    stored. Of a raster in feet they are its own times the length of a foot. Times are those of the
    platform's table of waypoints, or begin with the flight. Radial velocities are positive when
    closing. Points are written in the order of shots and returns, part by part; those not computed
    yet are left out. Nothing is at the file's place before it is whole.

    Parameters
    ----------
    store
        Store of a scene's point clouds, complete or not.
    file
        Where to; its suffix says what it is: ``.ply``, ``.las``, ``.laz`` or ``.csv``.
    scanner
        Name of the scanner; may be left out where there is only one.
    draw
        Number of the draw, from 0.
    ranges
        ``interpolated`` or ``quantised``: which ranges, velocities, positions and standard
        errors to write.
    where
        Value, as written in a spec, of every coordinate that has several.

    Returns
    -------
    int
        Number of points.

    Raises
    ------
    NotAStoreError
        Where there is no store of a scene.
    SpecError
        With every mistake in what is asked for.
    OSError
        Where the file can't be written.
    """
    study, file, mistakes = SceneStudy.of(store), Path(file), []
    if file.suffix.lower() not in WRITERS:
        remedy = f"take one of {', '.join(WRITERS)}"
        rule = "must have a suffix that says its format"
        mistakes.append(Mistake("file", rule, str(file), remedy))
    recording, at = chosen(study, scanner, draw, ranges, where or {}, mistakes)
    origin = np.asarray(study.tree.attrs.get("origin", np.zeros(3)), float)
    attributes = study.tree.attrs
    table = PointTable(
        recording, draw, ranges, origin,
        float(attributes.get("time_origin", 0.0)), str(attributes.get("projection", "")),
    )  # fmt: skip
    with draft(file, replace=True) as made:
        return WRITERS[file.suffix.lower()](table, made, _remarks(study, table, at))


def chosen(
    study: SceneStudy,
    scanner: str | None,
    draw: int,
    ranges: str,
    where: Mapping[str, object],
    mistakes: Sequence[Mistake] = (),
) -> tuple[Recording, Place]:
    """Return the recording that is asked for, and its place along the axes.

    Raises
    ------
    SpecError
        With every mistake in what is asked for, and those known before.
    """
    at = place(study.spec, where)
    if found := [*mistakes, *_mistakes(study, scanner, draw, ranges, at)]:
        raise SpecError(found)
    return at.recording(study.tree, scanner or study.scanners[0]), at


def _mistakes(
    study: SceneStudy, scanner: str | None, draw: int, ranges: str, at: Place
) -> list[Mistake]:
    """Mistakes in what is asked for of a study."""
    found = []
    names = ", ".join(study.scanners)
    if scanner is None and len(study.scanners) > 1:
        found.append(Mistake("scanner", "must be named where there are several", "", f"{names}"))
    elif scanner is not None and scanner not in study.scanners:
        remedy = near_miss(scanner, study.scanners, otherwise=f"there is {names}")
        found.append(Mistake("scanner", "is no scanner of this study", scanner, remedy))
    draws = int(study.spec.draws.number)
    if not 0 <= draw < draws:
        rule, remedy = "is no draw of this study", f"they are numbered 0 to {draws - 1}"
        found.append(Mistake("draw", rule, str(draw), remedy))
    if ranges not in (INTERPOLATED, QUANTISED):
        rule = f"must be {INTERPOLATED} or {QUANTISED}"
        remedy = near_miss(ranges, (INTERPOLATED, QUANTISED))
        found.append(Mistake("ranges", rule, ranges, remedy))
    for axis in study.spec.axes:
        if axis.name in at.left_open:  # several values, and none is chosen
            member = axis.members[0]
            shown = ", ".join(labels.quantity(v, member.units) for v in member.display[:5])
            rule = f"has {axis.size} values, and a file holds the points of one"
            remedy = f"choose {member.name} from {shown}{', ...' if axis.size > 5 else ''}"
            found.append(Mistake(f"where.{member.name}", rule, "", remedy))
    return found


def _remarks(study: SceneStudy, table: PointTable, at: Place) -> list[str]:
    """Remarks in a file on its contents."""
    number = [f"surface {i}: {name}" for i, name in enumerate(study.surfaces)]
    bits = [f"flag {bit}: {labels.coordinate(name)}" for name, bit in FLAGS.items()]
    shown = f"scanner {table.recording.scanner}, draw {table.draw}, {table.ranges} ranges"
    told = [
        result.words
        for result in consistency(study.tree)
        if not result.is_consistent and result.scanner == table.recording.scanner
    ]
    return [study.note, *told, ", ".join(filter(None, [shown, at.words])), *number, *bits]
