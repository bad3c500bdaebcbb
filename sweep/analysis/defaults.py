"""Figures of a study that asks for none."""

from __future__ import annotations

import numpy as np

from sweep.analysis import slices
from sweep.analysis.cuts import GRAZING_ANGLE, RANGE, cuts
from sweep.spec import Axis, Figure, Slices, Spec, Surface, Table

LONG = 8
"""Values from which on an axis is worth a side of a surface."""

VARIABLES = ("pd_shot", "pd_doppler")


def default_figures(spec: Spec) -> list[Figure]:
    """Surfaces where two axes are long, slices where one is, else a table; none without axes."""
    if not spec.axes:
        return []
    zipped = next((axis for axis in spec.axes if axis.zipped), None)
    if zipped is not None:
        return _along_zipped(spec, zipped)
    numeric = sorted((a for a in spec.axes if _is_numeric(a)), key=lambda axis: -axis.size)
    long = [axis for axis in numeric if axis.size >= LONG]
    if len(long) >= 2:
        x, y = _range_before_angle(long)
        return [Surface(kind="surface", variable=v, x=x, y=y) for v in VARIABLES]
    if numeric:
        by = _lines(spec, numeric[0])
        return [Slices(kind="slices", variable=v, x=numeric[0].name, **by) for v in VARIABLES]
    rows = spec.axes[0].name
    return [Table(kind="table", variable=v, rows=rows) for v in VARIABLES]


def _is_numeric(axis: Axis) -> bool:
    return np.asarray(axis.members[0].display).dtype.kind in "fiu"


def _range_before_angle(long: list[Axis]) -> tuple[str, str]:
    """Range along x and angle along y where they are long, else the longest two."""
    rank = {RANGE: 0, GRAZING_ANGLE: 1}
    first = sorted(long, key=lambda axis: rank.get(axis.members[0].path, 2))[:2]
    if first[0].members[0].path == GRAZING_ANGLE:
        first.reverse()
    return first[0].name, first[1].name


def _lines(spec: Spec, along: Axis) -> dict[str, str]:
    """Coordinate that has a line for each value, the first with few, as `by`; none where none."""
    others = [a for a in spec.axes if a is not along and not a.zipped]
    return next(({"by": a.name} for a in others if a.size <= slices.MOST_LINES), {})


def _along_zipped(spec: Spec, zipped: Axis) -> list[Figure]:
    """Slices along each cut of range and angle, or along a zipped axis's first number."""
    by = _lines(spec, zipped)
    members = {member.name: member for member in zipped.members}
    figures: list[Figure] = []
    for i, cut in enumerate(cuts(spec)):
        if cut.held in members and cut.along in members:
            written = f"{cut.value!r} {members[cut.held].units}".strip()
            figures.append(
                Slices(
                    kind="slices", name=f"pd_shot_{cut.along}_{i + 1}", variable="pd_shot",
                    x=cut.along, **by, where={cut.held: written},
                    title=f"Probability of detection at {cut.name}",
                )
            )  # fmt: skip
    if figures:
        return figures
    numeric = [m.name for m in zipped.members if np.asarray(m.display).dtype.kind in "fiu"]
    if not numeric:
        return [Table(kind="table", variable=v, rows=zipped.members[0].name) for v in VARIABLES]
    return [Slices(kind="slices", variable=v, x=numeric[0], **by) for v in VARIABLES]
