"""Tables of points as files: PLY, CSV, LAS and LAZ, written stretch by stretch."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sweep.analysis.scenes.point_table import FIELDS, PointTable
from sweep.model.pairing import TRUE

Remarks = Sequence[str]

_PLY_TYPES = {
    "<f8": "double", "<i2": "short", "|u1": "uchar", "<i4": "int", "<u4": "uint",
}  # fmt: skip


def write_ply(table: PointTable, path: Path, remarks: Remarks) -> int:
    """A binary PLY file of vertices whose properties are the columns; how many there are."""
    number = table.number()
    units: dict[str, list[str]] = {}
    for field in FIELDS:
        units.setdefault(field.units, []).append(field.name)
    units.pop("1")
    comments = [*remarks, *(f"{' '.join(names)} in {unit}" for unit, names in units.items())]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {' '.join(text.split())}" for text in comments),
        f"element vertex {number}",
        *(f"property {_PLY_TYPES[field.dtype]} {field.name}" for field in FIELDS),
        "end_header",
    ]
    with path.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii", "replace"))
        for rows in table.parts():
            file.write(rows.tobytes())
    return number


def write_csv(table: PointTable, path: Path, remarks: Remarks) -> int:
    """A CSV file with names and units in its first line, and digits that give the same numbers."""
    number = 0
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            field.name if field.units == "1" else f"{field.name} [{field.units}]"
            for field in FIELDS
        )
        for rows in table.parts():
            writer.writerows(rows.tolist())
            number += rows.size
    return number


FINEST = 1e-4
"""Step of coordinates in a LAS file [m]; coarser where the points lie too far apart for it."""

INTEGERS = 2.0**31 - 1
LARGEST_RETURN = 15
"""What LAS's coordinates, in steps from its offset, and numbers of returns go up to."""

_STANDARD = {"x", "y", "z", "time", "return_number", "number_of_returns"}

UNCLASSIFIED, NOISE = 1, 7
"""Classes of LAS: points as they are, and points known to be false."""


def write_las(table: PointTable, path: Path, remarks: Remarks, *, compressed: bool = False) -> int:
    """A LAS 1.4 file, point format 6, with the other columns as extra bytes.

    Times since the flight's start stand as GPS times; false points have the class of noise;
    intensity is the signal-to-noise ratio in hundredths of a decibel.
    """
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6)
    extra = [field for field in FIELDS if field.name not in _STANDARD]
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(
                name=field.name, type=np.dtype(field.dtype),
                description=field.units if field.units != "1" else "",
            )
            for field in extra
        ]
    )  # fmt: skip
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
            writer.write_points(_las_points(rows, header, [field.name for field in extra]))
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


def _write_laz(table: PointTable, path: Path, remarks: Remarks) -> int:
    return write_las(table, path, remarks, compressed=True)


WRITERS: dict[str, Callable[[PointTable, Path, Remarks], int]] = {
    ".ply": write_ply,
    ".las": write_las,
    ".laz": _write_laz,
    ".csv": write_csv,
}
"""How to write each kind of file, by its suffix."""
