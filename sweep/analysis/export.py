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
from sweep.analysis.figures import SceneStudy
from sweep.analysis.scenes.recording import (
    INTERPOLATED,
    QUANTISED,
    QUANTITIES,
    Place,
    Recording,
    place,
)
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
        ("return_number", "|u1"), ("number_of_returns", "|u1"),
    ]
)  # fmt: skip
"""Every column, in the order of files; returns of a shot and draw are numbered from 1."""

COLUMNS: tuple[str, ...] = ROW.names or ()
UNITS = {n: QUANTITIES[n].units for n in COLUMNS if n in QUANTITIES and QUANTITIES[n].units != "1"}
"""Units of the columns that have any."""


@dataclass(frozen=True)
class PointTable:
    """Points of one draw of a recording; the origin (3,) is added to their coordinates [m]."""

    recording: Recording
    draw: int
    ranges: str
    origin: np.ndarray

    def parts(self) -> Iterator[np.ndarray]:
        """Rows (m,) of ROW, part by part."""
        names = [name for name in COLUMNS if name != "number_of_returns"]
        for part in self.recording.stretches():
            table = self.recording.points([*names, "returns"], part, self.draw, self.ranges)
            rows = np.zeros(table["x"].size, ROW)
            for name in names:
                rows[name] = table[name]
            rows["return_number"] += 1
            rows["number_of_returns"] = table["returns"]
            for axis, shift in zip("xyz", self.origin, strict=True):
                rows[axis] += shift
            yield rows

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
    comments = list(remarks)
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
        writer.writerow(labels.with_brackets(n, UNITS.get(n, "")) for n in COLUMNS)
        for rows in table.parts():
            writer.writerows(rows.tolist())
            number += rows.size
    return number


FINEST = 1e-4
"""Step of coordinates in a LAS file [m]; coarser where the points lie too far apart for it."""

INTEGERS = 2.0**31 - 1
LARGEST_RETURN = 15
"""Largest coordinates, in steps from the offset, and numbers of returns in a LAS file."""

_STANDARD = {"x", "y", "z", "time", "return_number", "number_of_returns"}

UNCLASSIFIED, NOISE = 1, 7
"""Classes of LAS: points as they are, and points known to be false."""


def write_las(table: PointTable, path: Path, remarks: Remarks, *, compressed: bool = False) -> int:
    """Write a LAS 1.4 file, point format 6, with the other columns as extra bytes.

    Times since the flight's start stand as GPS times; false points have the class of noise;
    intensity is the signal-to-noise ratio in hundredths of a decibel.
    """
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6)
    extra = [name for name in COLUMNS if name not in _STANDARD]
    header.add_extra_dims(
        [laspy.ExtraBytesParams(n, ROW[n], description=UNITS.get(n, "")) for n in extra]
    )
    low, high = table.limits()
    found = bool(np.isfinite(low).all())
    header.global_encoding.wkt = True  # as the format asks of these points
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
    for name in ("return_number", "number_of_returns"):
        points[name] = np.minimum(rows[name], LARGEST_RETURN)
    points["classification"] = np.where(rows["flags"] & TRUE, UNCLASSIFIED, NOISE)
    decibels = 10 * np.log10(np.maximum(rows["snr"], 1e-30))
    points["intensity"] = np.clip(np.round(100 * np.nan_to_num(decibels)), 0, 65535)
    for name in extra:
        points[name] = rows[name]
    return points


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

    Coordinates are those of the scene's files: the scene's origin is added to what is stored.
    Points are written in the order of shots and returns, part by part; those not computed yet are
    left out. Nothing is at the file's place before it is whole.

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
    table = PointTable(recording, draw, ranges, origin)
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
    return [study.note, ", ".join(filter(None, [shown, at.words])), *number, *bits]
