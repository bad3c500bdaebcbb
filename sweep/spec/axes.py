"""The axes of a study: which parameters vary, over which values, together or apart.

The ``axes`` section of a spec is read here as a whole.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sweep.spec.fields import parameter_rules, parameter_suggestion, short_name
from sweep.spec.generators import MOST_VALUES, Progression, Values, read_pieces, read_single
from sweep.spec.mistakes import Finding, Findings, Location, rejected
from sweep.spec.rules import Rule, SweepError

RESERVED = ("batch", "draw", "point", "spec")
"""Names of dimensions that a store may have besides its axes."""

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,60}")
_REMEDY = "take a word such as 'cut'"


@dataclass(frozen=True, eq=False)
class Member:
    """One parameter along an axis.

    Parameters
    ----------
    path : str
        Dotted path of the parameter.
    name : str
        Name of its coordinate.
    values : ndarray (n,) or tuple of str
        SI values, float64 or int64; words of a parameter that takes words.
    display : ndarray (n,)
        The same in `units`.
    units : str
        The unit that the user wrote; empty where there is none.
    """

    path: str
    name: str
    values: np.ndarray | tuple[str, ...]
    display: np.ndarray
    units: str


@dataclass(frozen=True)
class Axis:
    """One dimension of a study's grid.

    Parameters
    ----------
    name : str
        Name of the dimension.
    members : tuple of Member
        The parameters along it: one, or several that vary together.
    """

    name: str
    members: tuple[Member, ...]

    @property
    def size(self) -> int:
        """Number of values."""
        return len(self.members[0].values)

    @property
    def zipped(self) -> bool:
        """True if the dimension has a name of its own."""
        return len(self.members) > 1 or self.members[0].name != self.name


def place_on_grid(path: str, axes: tuple[Axis, ...]) -> Location:
    """Location of the values of a parameter in a spec: on its axis, if it has one."""
    for axis in axes:
        if any(member.path == path for member in axis.members):
            return ("axes", axis.name if axis.zipped else path)
    return tuple(path.split("."))


def read_axes(written: object) -> tuple[tuple[Axis, ...], list[Finding]]:
    """Axes of a spec's ``axes`` section that can be read, and everything that is wrong with it."""
    if not isinstance(written, dict):
        return (), [Finding(("axes",), "must be a mapping of paths to values", "", written)]
    axes: list[Axis] = []
    findings = Findings()
    for key, value in written.items():
        with findings.of():
            axes.append(_read_axis(str(key), value, ("axes", str(key))))
    findings += _paths_set_twice(written)
    return (tuple(_named(axes)), findings + _name_clashes(axes))


def paths_on_axes(written: object) -> dict[str, object]:
    """Parameters that a spec's ``axes`` section sets, each with its first value as written."""
    first: dict[str, object] = {}
    for key, value in written.items() if isinstance(written, dict) else ():
        for path, values in _items(str(key), value):
            first.setdefault(path, _first_written(values))
    return {path: value for path, value in first.items() if path in parameter_rules()}


def _items(key: str, written: object) -> list[tuple[str, object]]:
    """Paths and values of a written axis; of a zipped one, piece after piece."""
    if not isinstance(written, dict) or "zip" not in written:
        return [(key, written)]
    pieces = written["zip"] if isinstance(written["zip"], list) else [written["zip"]]
    mappings = [piece for piece in pieces if isinstance(piece, dict)]
    return [(str(path), value) for piece in mappings for path, value in piece.items()]


def _first_written(values: object) -> object:
    """First value of a written list or generator; None where it has none."""
    while isinstance(values, dict | list) and values:
        values = next(iter(values.values())) if isinstance(values, dict) else values[0]
    return None if isinstance(values, dict | list) else values


def _read_axis(key: str, written: object, location: Location) -> Axis:
    """One axis, plain or zipped."""
    if isinstance(written, dict) and "zip" in written:
        return _read_zip(key, written, location)
    member = _member(key, read_pieces(written, _rule_at(key, location), location), location)
    _without_duplicates(member, location)
    return Axis(member.name, (member,))


def _rule_at(path: str, location: Location) -> Rule:
    """Rule of the parameter at a path."""
    rule = parameter_rules().get(path)
    if rule is None:
        raise rejected(location, "is no parameter", parameter_suggestion(path))
    if isinstance(rule, SweepError):
        raise rejected(location, "is one table for a whole study", "put it into the instrument")
    return rule


def _member(path: str, pieces: list[Any], location: Location) -> Member:
    """Parameter along an axis, from pieces (values or words) laid end to end."""
    name = short_name(path)
    if isinstance(pieces[0], str):
        return Member(path, name, tuple(pieces), np.array(pieces), "")
    size = sum(len(piece.si) for piece in pieces)
    if size > MOST_VALUES:
        raise rejected(location, f"has {size} values, and an axis takes at most {MOST_VALUES}")
    # Not in decibels where some piece is not: those have no zero.
    unit = next((piece.unit for piece in pieces if not piece.unit.decibel), pieces[0].unit)
    values = np.concatenate([piece.si for piece in pieces])
    display = np.concatenate([piece.displayed(unit) for piece in pieces])
    if values.dtype == np.int64 and unit.text == "":
        display = values.copy()
    values.flags.writeable = display.flags.writeable = False
    return Member(path, name, values, display, unit.text)


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
        raise rejected(location, f"holds {text} more than once", "list it once")


# Zipped axes: several parameters that vary together, in pieces laid end to end


def _read_zip(key: str, written: dict[str, Any], location: Location) -> Axis:
    """Zipped axis, each of whose pieces gives all of its parameters."""
    findings = Findings(
        Finding((*location, str(other)), "is no part of a zipped axis", "write {zip: [...]}")
        for other in written
        if other != "zip"
    )
    if _NAME.fullmatch(key) is None or key in RESERVED:
        findings.append(Finding(location, "is no name for an axis", _REMEDY))
    pieces: dict[Location, object] = {(*location, "zip"): written["zip"]}
    if written["zip"] in ([], {}, None):
        findings.append(Finding((*location, "zip"), "holds no piece", "list at least one"))
        pieces = {}
    elif isinstance(written["zip"], list):
        pieces = {(*location, "zip", i): piece for i, piece in enumerate(written["zip"])}
    read: list[dict[str, list[Any]]] = []
    for at, piece in pieces.items():
        with findings.of():
            read.append(_read_piece(piece, at))
            if unlike := ", ".join(sorted(set(read[0]) ^ set(read[-1]))):
                rule = "must set the same parameters as the first piece"
                raise rejected(at, rule, f"mind {unlike}")
    findings.refuse_any()
    laid = {path: [values for piece in read for values in piece[path]] for path in read[0]}
    return Axis(key, tuple(_member(path, values, location) for path, values in laid.items()))


def _read_piece(piece: object, location: Location) -> dict[str, list[Any]]:
    """Values of one piece by path, all of one length."""
    if not isinstance(piece, dict) or not piece:
        raise rejected(location, "must be a mapping of paths to values", "", piece)
    findings = Findings()
    read: dict[str, list[Any]] = {}
    for path, written in piece.items():
        inside = (*location, str(path))
        with findings.of():
            rule = _rule_at(str(path), inside)
            several = isinstance(written, dict | list)
            read[path] = (
                list(read_pieces(written, rule, inside))
                if several
                else [read_single(written, rule, inside)]
            )
    lengths = {path: _length(read[path]) for path in read if isinstance(piece[path], dict | list)}
    if len(set(lengths.values())) > 1:
        text = ", ".join(f"{path} has {n}" for path, n in lengths.items())
        findings.append(Finding(location, f"must give as many values of each: {text}"))
    findings.refuse_any()
    length = max(lengths.values(), default=1)
    return {
        path: values if path in lengths else _repeated(values[0], length)
        for path, values in read.items()
    }


def _length(pieces: list[Any]) -> int:
    """Count the values in pieces."""
    return sum(1 if isinstance(piece, str) else len(piece.si) for piece in pieces)


def _repeated(single: Values | str, number: int) -> list[Any]:
    """Repeat a single value as often as the rest of its piece is long."""
    if isinstance(single, str):
        return [single] * number
    assert single.progression is not None
    progression = Progression(single.progression.start, number=number)
    return [replace(single, si=np.repeat(single.si, number), progression=progression)]


# Names


def _named(axes: list[Axis]) -> list[Axis]:
    """Axes whose coordinates have the shortest names that tell them apart."""
    paths = [member.path for axis in axes for member in axis.members]
    named = []
    for axis in axes:
        members = tuple(replace(m, name=_coordinate_name(m.path, paths)) for m in axis.members)
        plain = len(axis.members) == 1 and axis.name == axis.members[0].name
        named.append(Axis(members[0].name if plain else axis.name, members))
    return named


def _coordinate_name(path: str, paths: list[str]) -> str:
    """Shortest dotted tail of a path that no other path ends with, joined by underscores."""
    own, *others = (p.removesuffix(".kind").split(".") for p in (path, *set(paths) - {path}))
    for length in range(1, len(own) + 1):
        if not any(other[-length:] == own[-length:] for other in others):
            break
    return "_".join(own[-length:])


def _paths_set_twice(written: dict[Any, Any]) -> list[Finding]:
    """Parameters that two axes set."""
    owners: dict[str, list[str]] = {}
    for key, value in written.items():
        for path in sorted({path for path, _ in _items(str(key), value)}):
            owners.setdefault(path, []).append(str(key))
    return [
        Finding(("axes", keys[1]), f"sets {path}, which the axis '{keys[0]}' sets too")
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
            findings.append(Finding(("axes", axis.name), "bears the name of a coordinate", _REMEDY))
    return findings
