"""Cuts through a study, as the thesis makes them: along range at an angle, or along angle."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from sweep.analysis import labels
from sweep.analysis.selection import Points, coordinate_of

if TYPE_CHECKING:
    from sweep.spec import Axis, Member, Spec

RANGE, GRAZING_ANGLE = "target.range", "target.grazing_angle"
PUBLISHED = ((GRAZING_ANGLE, "15 deg"), (GRAZING_ANGLE, "85 deg"), (RANGE, "3500 m"))
NEAREST = "5 m"
"""Nearer ranges are left out of means: there the echo's own shot noise counts [T 4.2]."""


@dataclass(frozen=True)
class Cut:
    """One coordinate at a value, the other along the cut; both empty for a whole study."""

    name: str
    held: str
    value: object
    along: str

    def of(self, found: Points) -> Points:
        """Points of the cut, each once."""
        return found.where(self.held, [self.value]).once() if self.held else found


def cuts(spec: Spec) -> list[Cut]:
    """Cuts that a study makes through range and grazing angle.

    Those of its zipped axis; else the published three that its grid holds; else the whole.
    """
    ranges, angles = coordinate_of(spec, RANGE), coordinate_of(spec, GRAZING_ANGLE)
    whole = [Cut("all", "", None, ranges.name if ranges else angles.name if angles else "")]
    if ranges is None or angles is None:
        return whole
    members = {RANGE: ranges, GRAZING_ANGLE: angles}
    zipped = next((axis for axis in spec.axes if {ranges, angles} <= set(axis.members)), None)
    if zipped is not None:
        held = _pieces(zipped)
    else:
        published = [(members[p], spec.coordinate_value(p, text)) for p, text in PUBLISHED]
        held = [(m, v) for m, v in published if np.isclose(m.display, float(v)).any()]
    found = [
        Cut(
            labels.quantity(value, member.units).replace("°", " deg"),
            member.name,
            value,
            angles.name if member is ranges else ranges.name,
        )
        for member, value in held
    ]
    return found or whole


def _pieces(axis: Axis) -> list[tuple[Member, object]]:
    """Stretches of a zipped axis in which one parameter stays and another varies, in order."""
    members = [m for m in axis.members if m.path in (RANGE, GRAZING_ANGLE)]
    pieces: list[tuple[Member, object]] = []
    start = 0
    while start < axis.size:
        lengths = [_constant(member.display[start:]) for member in members]
        longest = int(np.argmax(lengths))
        piece = (members[longest], members[longest].display[start].item())
        if piece not in pieces:
            pieces.append(piece)
        start += lengths[longest]
    return pieces


def _constant(values: np.ndarray) -> int:
    """Number of leading values that are equal."""
    different = values != values[0]
    return int(np.argmax(different)) if different.any() else values.size


def beyond(found: Points, spec: Spec, distance: str, *, included: bool = False) -> Points:
    """Points farther than a distance (or at it), where range is on an axis."""
    member = coordinate_of(spec, RANGE)
    if member is None:
        return found
    least = float(spec.coordinate_value(RANGE, distance))
    ranges = found.values(member.name)
    return found.at(found.dim_of(member.name), ranges >= least if included else ranges > least)


def bands(spec: Spec, along: str, values: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Decades of range, or bands of angle, that hold any of the values: name and mask of each."""
    member = spec.member(along)
    angle = member.path == GRAZING_ANGLE
    si = np.asarray(member.values, float)[_position(member, values)]
    si = np.rad2deg(si) if angle else si
    unit = "deg" if angle else "m"
    limits = [0.0, 15.0, 30.0, 60.0, 90.0] if angle else [10.0**k for k in range(-1, 8)]
    masks = [
        (f"{a:g}-{b:g} {unit}", (si > a * (1 + 1e-12)) & (si <= b * (1 + 1e-12)))
        for a, b in pairwise(limits)
    ]
    return [(name, mask) for name, mask in masks if mask.any()]


def _position(member: Member, values: np.ndarray) -> np.ndarray:
    """Index along an axis of each value of its coordinate."""
    order = np.argsort(member.display, kind="stable")
    return order[np.searchsorted(member.display[order], values)]


def si_value(member: Member, value: object) -> float | int | str:
    """SI value of a coordinate's value."""
    if isinstance(member.values, tuple):
        return str(value)
    return member.values[_position(member, np.array([value]))[0]].item()
