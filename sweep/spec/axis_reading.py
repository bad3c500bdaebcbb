"""The ``axes`` section of a spec, read as a whole."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from sweep.spec.axes import Axis, Member, member_of, rule_at
from sweep.spec.fields import parameter_rules, short_name
from sweep.spec.generators import Rejected, read_pieces
from sweep.spec.mistakes import ABSENT, Finding, Location
from sweep.spec.zips import is_zip, read_zip, zip_items


def read_axes(written: object) -> tuple[tuple[Axis, ...], list[Finding]]:
    """Axes of a spec's ``axes`` section, and everything that is wrong with it.

    Parameters
    ----------
    written : object
        The section as read from the file.

    Returns
    -------
    axes : tuple of Axis
        Those that could be read, in the order of the file.
    findings : list of Finding
        The mistakes.
    """
    if not isinstance(written, dict):
        return (), [Finding(("axes",), "must be a mapping of paths to values", "", written)]
    axes: list[Axis] = []
    findings: list[Finding] = []
    for key, value in written.items():
        location: Location = ("axes", key if isinstance(key, str) else str(key))
        try:
            axes.append(_read_axis(str(key), value, location))
        except Rejected as rejected:
            findings += rejected.findings
    findings += _paths_set_twice(written)
    return (tuple(_named(axes)), findings + _name_clashes(axes))


def paths_on_axes(written: object) -> dict[str, object]:
    """Parameters that a spec's ``axes`` section sets, each with its first value as written."""
    first: dict[str, object] = {}
    for key, value in written.items() if isinstance(written, dict) else ():
        for path, values in zip_items(value) if is_zip(value) else [(str(key), value)]:
            first.setdefault(path, _first_written(values))
    return {path: value for path, value in first.items() if path in parameter_rules()}


def _first_written(values: object) -> object:
    """First value of a written list or generator; None where it has none."""
    while isinstance(values, dict | list) and values:
        values = next(iter(values.values())) if isinstance(values, dict) else values[0]
    return None if isinstance(values, dict | list) else values


def _read_axis(key: str, written: object, location: Location) -> Axis:
    """One axis, plain or zipped."""
    if isinstance(written, dict) and is_zip(written):
        return read_zip(key, written, location)
    member = member_of(key, read_pieces(written, rule_at(key, location), location), location)
    _without_duplicates(member, location)
    return Axis(member.name, (member,))


def _without_duplicates(member: Member, location: Location) -> None:
    """No value twice along an axis, or a finding that names one."""
    values = np.asarray(member.values)
    if values.dtype.kind != "U" and (
        np.all(values[1:] > values[:-1]) or np.all(values[1:] < values[:-1])
    ):
        return
    unique, counts = np.unique(values, return_counts=True)
    if counts.max(initial=1) > 1:
        repeated = member.display[np.argmax(values == unique[np.argmax(counts > 1)])]
        text = f"{repeated} {member.units}".strip()
        raise Rejected(Finding(location, f"holds {text} more than once", "list it once", ABSENT))


def _named(axes: list[Axis]) -> list[Axis]:
    """Axes whose coordinates have the shortest names that tell them apart."""
    paths = [member.path for axis in axes for member in axis.members]
    taken = Counter(map(short_name, paths))
    named = []
    for axis in axes:
        members = tuple(
            replace(member, name=_coordinate_name(member.path, paths))
            if taken[member.name] > 1
            else member
            for member in axis.members
        )
        plain = len(axis.members) == 1 and axis.name == axis.members[0].name
        named.append(Axis(members[0].name if plain else axis.name, members))
    return named


def _coordinate_name(path: str, paths: list[str]) -> str:
    """Shortest dotted tail of a path that no other path ends with, joined by underscores."""
    parts = path.split(".")
    for length in range(1, len(parts) + 1):
        tail = parts[-length:]
        if sum(other.split(".")[-length:] == tail for other in set(paths)) == 1:
            break
    return "_".join(tail)


def _paths_set_twice(written: dict[Any, Any]) -> list[Finding]:
    """Parameters that two axes set."""
    owners: dict[str, list[str]] = {}
    for key, value in written.items():
        paths = {path for path, _ in zip_items(value)} if is_zip(value) else {str(key)}
        for path in sorted(paths):
            owners.setdefault(path, []).append(str(key))
    return [
        Finding(("axes", keys[1]), f"sets {path}, which the axis '{keys[0]}' sets too", "", ABSENT)
        for path, keys in owners.items()
        if len(keys) > 1
    ]


def _name_clashes(axes: list[Axis]) -> list[Finding]:
    """Zipped axes that bear the name of another axis's coordinate."""
    findings = []
    for axis in axes:
        others = {m.name for other in axes if other is not axis for m in other.members}
        own = {m.name for m in axis.members} if len(axis.members) > 1 else set()
        if axis.zipped and axis.name in others | own:
            findings.append(
                Finding(
                    ("axes", axis.name),
                    "bears the name of a coordinate",
                    "take a word such as 'cut'",
                    ABSENT,
                )
            )
    return findings
