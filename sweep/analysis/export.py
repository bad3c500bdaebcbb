"""Point clouds as files for other programs: CloudCompare, PyVista, GIS, spreadsheets."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sweep.analysis import labels
from sweep.analysis.scenes.figures import SceneStudy
from sweep.analysis.scenes.places import Place, place
from sweep.analysis.scenes.point_files import WRITERS
from sweep.analysis.scenes.point_table import PointTable
from sweep.analysis.scenes.quantities import INTERPOLATED, QUANTISED
from sweep.model.pairing import FLAGS
from sweep.spec import Mistake, SpecError
from sweep.spec.mistakes import near_miss
from sweep.storage.locations import Location


def export(
    store: str | Location,
    file: str | Path,
    *,
    scanner: str | None = None,
    draw: int = 0,
    ranges: str = INTERPOLATED,
    where: Mapping[str, object] | None = None,
) -> int:
    """The points of one scanner and draw as a file.

    Coordinates are those of the scene's files: the scene's origin is added to what is stored.
    Points are written stretch by stretch, in the order of shots and returns; what is not computed
    yet is left out. Nothing is at the file's place before it is whole.

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
    study, file = SceneStudy.of(store), Path(file)
    mistakes = _mistakes(study, file, scanner, draw, ranges)
    at = place(study.spec, where or {})
    mistakes += _open_axes(study, at)
    if mistakes:
        raise SpecError(mistakes)
    recording = at.recording(study.tree, scanner or study.scanners[0])
    origin = np.asarray(study.tree.attrs.get("origin", np.zeros(3)), float)
    table = PointTable(recording, draw, ranges, origin)
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_name(f".{file.name}.{os.getpid()}.partial")
    try:
        number = WRITERS[file.suffix.lower()](table, partial, _remarks(study, table, at))
        os.replace(partial, file)
    finally:
        partial.unlink(missing_ok=True)
    return number


def _mistakes(
    study: SceneStudy, file: Path, scanner: str | None, draw: int, ranges: str
) -> list[Mistake]:
    """What is wrong with what is asked for."""
    found = []
    if file.suffix.lower() not in WRITERS:
        remedy = f"take one of {', '.join(WRITERS)}"
        found.append(Mistake("file", "must have a suffix that says its format", str(file), remedy))
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
    return found


def _open_axes(study: SceneStudy, at: Place) -> list[Mistake]:
    """Axes along which there are several values, and none is chosen."""
    mistakes = []
    for axis in study.spec.axes:
        if axis.name in at.left_open:
            member = axis.members[0]
            shown = ", ".join(labels.quantity(v, member.units) for v in member.display[:5])
            more = ", ..." if axis.size > 5 else ""
            rule = f"has {axis.size} values, and a file holds the points of one"
            remedy = f"choose {member.name} from {shown}{more}"
            mistakes.append(Mistake(f"where.{member.name}", rule, "", remedy))
    return mistakes


def _remarks(study: SceneStudy, table: PointTable, at: Place) -> list[str]:
    """What a file says of itself, where it can."""
    number = [f"surface {i}: {name}" for i, name in enumerate(study.surfaces)]
    bits = [f"flag {bit}: {labels.coordinate(name)}" for name, bit in FLAGS.items()]
    shown = f"scanner {table.recording.scanner}, draw {table.draw}, {table.ranges} ranges"
    return [study.note, ", ".join(filter(None, [shown, at.words])), *number, *bits]
