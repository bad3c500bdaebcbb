"""The axes of a study: which parameters vary, over which values, together or apart.

The ``axes`` section of a spec is read here as a whole.
"""

from __future__ import annotations

import copy
import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np

from sweep.model.outputs import GRID_VARIABLES
from sweep.spec.rules import (
    Finding,
    Findings,
    Location,
    Numeric,
    Rule,
    SweepError,
    near_miss,
    rejected,
)
from sweep.spec.sections import (
    AXES_TAKE,
    NOT_ON_AXES,
    SECTIONS,
    parameter_rules,
    parameter_suggestion,
    short_name,
)
from sweep.units import QuantityError, Unit

RESERVED = ("batch", "draw", "point", "spec", "study_id")
"""Names of dimensions that a store may have besides its axes."""

_MARKER = re.compile("study_[0-9a-f]{16}")
"""Names of the coordinate that marks a study's points, in the dataset that its store opens as."""

_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,60}")
_LISTED = 64
"""Values of an axis that its identity lists at most."""
_REMEDY = "take a word such as 'cut'"


@dataclass(frozen=True, eq=False)
class Member:
    """One parameter along an axis."""

    path: str
    name: str
    """Name of its coordinate."""
    values: np.ndarray | tuple[str, ...]
    """SI values (n,), float64 or int64; words of a parameter that takes words."""
    display: np.ndarray
    """The same in `units`."""
    units: str
    """The unit that the user wrote; empty where there is none."""


@dataclass(frozen=True)
class Axis:
    """One dimension of a study's grid."""

    name: str
    members: tuple[Member, ...]
    """The parameters along it: one, or several that vary together."""

    @property
    def size(self) -> int:
        """Number of values."""
        return len(self.members[0].values)

    @property
    def zipped(self) -> bool:
        """True if the dimension has a name of its own."""
        return len(self.members) > 1 or self.members[0].name != self.name


def axis_identity(axis: Axis) -> dict[str, Any]:
    """Content of an axis: its values where they are few, else their number, ends and digest."""
    return {"name": axis.name, "members": {m.path: _member_identity(m) for m in axis.members}}


def _member_identity(member: Member) -> dict[str, Any]:
    """Content of one parameter along an axis."""
    number, words = len(member.values), isinstance(member.values, tuple)
    if number <= _LISTED:
        return {"values": list(member.values) if words else np.asarray(member.values).tolist()}
    if words:
        content = "\0".join(map(str, member.values)).encode()
    else:
        content = (np.asarray(member.values, dtype="<f8") + 0.0).tobytes()  # no -0.0
    first, last = np.asarray(member.values)[[0, -1]].tolist()
    digest = hashlib.blake2b(content, digest_size=16).hexdigest()
    return {"number": number, "first": first, "last": last, "digest": digest}


def place_on_grid(path: str, axes: tuple[Axis, ...]) -> Location:
    """Location of the values of a parameter in a spec: on its axis, if it has one."""
    for axis in axes:
        if any(member.path == path for member in axis.members):
            return ("axes", axis.name if axis.zipped else path)
    return tuple(path.split("."))


def read_axes(written: object) -> tuple[tuple[Axis, ...], list[Finding]]:
    """Axes of a spec's ``axes`` section that can be read, and everything that is wrong with it."""
    if not isinstance(written, dict):
        remedy = "write e.g. 'target.range: [1 km, 2 km]' below it, or leave it out"
        return (), [Finding(("axes",), "must be a mapping of paths to values", remedy, written)]
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


def without_fields_on_axes(written: Mapping[str, Any]) -> dict[str, Any]:
    """Copy of a written study in whose sections no field is that an axis of it sets.

    A field and its axis may not contradict each other: this gives a study of plain data an axis
    in the place of a field.

    >>> study = {"target": {"range": "2 km", "reflectance": 0.1}}
    >>> without_fields_on_axes({**study, "axes": {"target.range": ["1 km", "3 km"]}})
    {'target': {'reflectance': 0.1}, 'axes': {'target.range': ['1 km', '3 km']}}
    """
    copied = copy.deepcopy(dict(written))
    for path in paths_on_axes(copied.get("axes")):
        *parents, name = path.split(".")
        section: Any = copied
        for parent in parents:
            section = section.get(parent) if isinstance(section, dict) else None
        if isinstance(section, dict):
            section.pop(name, None)
    return copied


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
    if key in SECTIONS and isinstance(written, dict):
        path, values = _first_path(key, written)
        rule = "is a section, and an axis is named by the whole path of a field"
        raise rejected(location, rule, f"write '{path}: {values}'")
    member = _member(key, read_pieces(written, _rule_at(key, location), location), location)
    _without_duplicates(member, location)
    return Axis(member.name, (member,))


def _first_path(path: str, written: object) -> tuple[str, str]:
    """Dotted path of the first field within sections as written, and its values in short."""
    while isinstance(written, dict) and written and not set(written) & set(_FORMS):
        name = next(iter(written))
        path, written = f"{path}.{name}", written[name]
    return path, "[...]" if isinstance(written, list) else "{linear: [...], number: ...}"


def _rule_at(path: str, location: Location) -> Rule:
    """Rule of the parameter at a path."""
    rule = parameter_rules().get(path)
    if rule is None:
        raise rejected(location, *_why_no_axis(path))
    if isinstance(rule, SweepError):
        raise rejected(location, "is one table for a whole study", "put it into the instrument")
    return rule


_WHOLE_STUDY = "is the same for a whole study"


def _why_no_axis(path: str) -> tuple[str, str]:
    """Rule and remedy for the path of what no axis may set."""
    section, _, name = path.partition(".")
    if path == "seed":
        rule = f"{_WHOLE_STUDY}: each point and draw has random numbers of its own already"
        return rule, "leave it out, or run a study for each seed"
    if section == "effects" and name:
        return _WHOLE_STUDY, "run a study for each mode, and compare them with sweep compare"
    if path in ("instrument", "instrument.like", "instrument.file"):
        return _WHOLE_STUDY, "run a study for each, and compare them with sweep compare"
    if section in NOT_ON_AXES:
        return _WHOLE_STUDY, f"run a study for each value; {AXES_TAKE}"
    return "is no parameter", parameter_suggestion(path)


def _member(path: str, pieces: list[Values], location: Location) -> Member:
    """Parameter along an axis, from pieces laid end to end."""
    name = short_name(path)
    size = _length(pieces)
    if size > MOST_VALUES:
        raise rejected(location, f"has {size} values, and an axis takes at most {MOST_VALUES}")
    # Not in decibels where some piece is not: those have no zero.
    unit = next((piece.unit for piece in pieces if not piece.unit.decibel), pieces[0].unit)
    values = np.concatenate([piece.si for piece in pieces])
    if values.dtype.kind == "U":
        return Member(path, name, tuple(values.tolist()), values, "")
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
    if _NAME.fullmatch(key) is None or key in RESERVED or _MARKER.fullmatch(key):
        findings.append(Finding(location, "is no name for an axis", _REMEDY))
    pieces: dict[Location, object] = {(*location, "zip"): written["zip"]}
    if written["zip"] in ([], {}, None):
        findings.append(Finding((*location, "zip"), "holds no piece", "list at least one"))
        pieces = {}
    elif isinstance(written["zip"], list):
        pieces = {(*location, "zip", i): piece for i, piece in enumerate(written["zip"])}
    read: list[dict[str, list[Values]]] = []
    for at, piece in pieces.items():
        with findings.of():
            read.append(_read_piece(piece, at))
            if unlike := ", ".join(sorted(set(read[0]) ^ set(read[-1]))):
                rule = "must set the same parameters as the first piece"
                raise rejected(at, rule, f"mind {unlike}")
    findings.refuse_any()
    laid = {path: [values for piece in read for values in piece[path]] for path in read[0]}
    return Axis(key, tuple(_member(path, values, location) for path, values in laid.items()))


def _read_piece(piece: object, location: Location) -> dict[str, list[Values]]:
    """Values of one piece by path, all of one length."""
    if not isinstance(piece, dict) or not piece:
        raise rejected(location, "must be a mapping of paths to values", "", piece)
    findings = Findings()
    read: dict[str, list[Values]] = {}
    for path, written in piece.items():
        inside = (*location, str(path))
        with findings.of():
            rule = _rule_at(str(path), inside)
            if isinstance(written, dict | list):
                read[path] = read_pieces(written, rule, inside)
            else:
                read[path] = [read_single(written, rule, inside)]
    lengths = {path: _length(read[path]) for path in read if isinstance(piece[path], dict | list)}
    if len(set(lengths.values())) > 1:
        text = ", ".join(f"{path} has {n}" for path, n in lengths.items())
        findings.append(Finding(location, f"must give as many values of each: {text}"))
    findings.refuse_any()
    length = max(lengths.values(), default=1)
    return {
        path: values if path in lengths else [values[0].repeated(length)]
        for path, values in read.items()
    }


def _length(pieces: list[Values]) -> int:
    """Count the values in pieces."""
    return sum(len(piece.si) for piece in pieces)


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
    """Return the shortest dotted tail of a path that names it alone, joined by underscores.

    No other path ends with it, and no variable of a store is called so.
    """
    own, *others = (p.removesuffix(".kind").split(".") for p in (path, *set(paths) - {path}))
    for length in range(1, len(own) + 1):
        name = "_".join(own[-length:])
        is_shared = any(other[-length:] == own[-length:] for other in others)
        if not is_shared and name not in GRID_VARIABLES:
            break
    return name


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
    """List zipped axes that bear the name of another axis's coordinate, or of a variable."""
    findings = []
    for axis in axes:
        others = {m.name for other in axes if other is not axis for m in other.members}
        own = {m.name for m in axis.members} if len(axis.members) > 1 else set()
        if axis.zipped and axis.name in others | own:
            findings.append(Finding(("axes", axis.name), "bears the name of a coordinate", _REMEDY))
        elif axis.zipped and axis.name in GRID_VARIABLES:
            rule = "bears the name of a variable of the store"
            findings.append(Finding(("axes", axis.name), rule, _REMEDY))
    return findings


# Written values as arrays: single ones, and linear, log or step generators. Regular values stay
# exact until the one rounding of each: a generator makes the float that the same value, written
# out, gives.

MOST_VALUES = 20_000_000
_FORMS = {
    "linear": "{linear: [first, last], number: 10}",
    "log": "{log: [first, last], number: 10}",
    "step": "{step: [first, last, step]}",
}
_ALIASES = {"linspace": "linear", "geomspace": "log", "logspace": "log", "arange": "step"}
"""Names that generators have in NumPy."""
_NUMBER = Numeric(about="", example="10", at_least="2", at_most=str(MOST_VALUES), whole=True)


# Regular values, exactly


@dataclass(frozen=True)
class Progression:
    """The regular values ``start + increment * i`` for ``i = 0 .. number - 1``, exactly."""

    start: Fraction
    increment: Fraction = Fraction(0)
    number: int = 1

    def mapped(self, factor: Fraction, offset: Fraction) -> Progression:
        """Return the progression of ``factor * value + offset``."""
        return Progression(self.start * factor + offset, self.increment * factor, self.number)

    def values(self) -> np.ndarray:
        """Floats (number,), each the nearest to its exact value: quotients of whole numbers."""
        common = math.lcm(self.start.denominator, self.increment.denominator)
        first, step = int(self.start * common), int(self.increment * common)
        return np.array([(first + step * i) / common for i in range(self.number)])


def _rounded(values: np.ndarray) -> np.ndarray:
    """Values (n,) to 15 significant digits.

    Powers and logarithms may differ in the last bit from one machine to the next; 15 digits are
    the same everywhere.
    """
    magnitude = np.abs(values)
    np.floor(np.log10(magnitude, where=magnitude > 0, out=np.zeros(values.shape)), out=magnitude)
    exponent = 14 - magnitude.astype(np.int64)
    inside = np.abs(exponent) <= 22  # powers of ten that are exact floats
    scale = 10.0 ** np.where(inside, np.abs(exponent), 0)
    up, down = np.rint(values * scale) / scale, np.rint(values / scale) * scale
    return np.where(inside, np.where(exponent >= 0, up, down), values)


def values_in(unit: Unit, si: np.ndarray) -> np.ndarray:
    """SI values (n,) in the given unit, to 15 significant digits."""
    if unit.decibel:
        return _rounded(10.0 * np.log10(si / float(unit.factor)))
    if (unit.factor, unit.offset) == (1, 0):
        return _rounded(si.astype(float))
    (p, q), (a, b) = unit.offset.as_integer_ratio(), unit.factor.as_integer_ratio()
    ratios = (value.as_integer_ratio() for value in si.tolist())
    return _rounded(np.array([(n * q - p * d) * b / (d * q * a) for n, d in ratios]))


def in_units(rule: Numeric, written: object, units: str) -> float:
    """Written value in the unit of choice."""
    number, unit = rule.exact(written)
    single = Values(np.array([unit.to_si(number)]), unit, Progression(number))
    return float(single.displayed(rule.exact(f"1 {units}" if units else 1)[1])[0])


# Written values


@dataclass(frozen=True)
class Values:
    """Numbers or words of one written piece of an axis."""

    si: np.ndarray
    """SI values (n,), or words."""
    unit: Unit
    """The unit they were written in; of words none."""
    progression: Progression | None = None
    """The same numbers exactly, in `unit`, where they are regular."""

    def displayed(self, unit: Unit) -> np.ndarray:
        """Values (n,) in the unit of choice."""
        if self.progression is not None and unit == self.unit:
            return self.progression.values()
        if self.progression is None or unit.decibel or self.unit.decibel:
            return values_in(unit, self.si)
        offset = (self.unit.offset - unit.offset) / unit.factor
        return self.progression.mapped(self.unit.factor / unit.factor, offset).values()

    def repeated(self, number: int) -> Values:
        """Return a single value as often as asked."""
        progression = self.progression and replace(self.progression, number=number)
        return replace(self, si=np.repeat(self.si, number), progression=progression)


def read_pieces(written: object, rule: Rule, location: Location) -> list[Values]:
    """Values of an axis over one field: a list of values and generators, or one generator."""
    if isinstance(written, dict):
        return [_read_generator(written, rule, location)]
    if not isinstance(written, list):
        example = getattr(rule, "example", "") if written is None else written
        remedy = f"write e.g. [{example}] or {_FORMS['linear']}"
        raise rejected(location, "must be a list or a generator", remedy, written)
    if not written:
        raise rejected(location, "holds no value", "list at least one")
    pieces: list[Values] = []
    findings = Findings()
    for i, piece in enumerate(written):
        read = _read_generator if isinstance(piece, dict) else read_single
        with findings.of():
            pieces.append(read(piece, rule, (*location, i)))
    findings.refuse_any()
    return pieces


def read_single(written: object, rule: Rule, location: Location) -> Values:
    """One value: of numeric fields with its unit, of others the word."""
    try:
        value = rule.read(written)
        if not isinstance(rule, Numeric):
            return Values(np.array([str(value)]), Unit(""))
        number, unit = rule.exact(written)
    except QuantityError as error:
        raise rejected(location, error.rule, error.suggestion, written) from None
    kind = np.int64 if rule.whole else np.float64
    return Values(np.array([value], dtype=kind), unit, Progression(number))


def _read_generator(written: dict[Any, Any], rule: Rule, location: Location) -> Values:
    """Values of ``{linear: ...}``, ``{log: ...}`` or ``{step: ...}``, within the field's bounds."""
    kinds = [key for key in written if key in _FORMS]
    if len(kinds) != 1:
        name, value = next(iter(written.items()), ("", None))
        remedy = near_miss(_ALIASES.get(str(name), str(name)), _FORMS)
        if isinstance(value, list) and name not in _ALIASES and len(written) == 1:
            remedy = remedy or f"write the list alone, without '{name}:'"
        remedy = remedy or f"write e.g. {_FORMS['linear']}"
        raise rejected(location, "must have exactly one of linear, log and step", remedy)
    if not isinstance(rule, Numeric):
        raise rejected(location, "takes words, which have no steps", "list them")
    kind, findings = kinds[0], Findings()
    allowed = {kind} if kind == "step" else {kind, "number"}
    remedy = f"write {_FORMS[kind]}"
    for key, value in written.items():
        if key not in allowed:
            where = (*location, str(key))
            findings.append(Finding(where, f"is no part of '{kind}'", remedy, value))
    number = 0
    if kind != "step" and "number" not in written:
        findings.append(Finding(location, "lacks the number of values", remedy))
    elif kind != "step":
        with findings.of((*location, "number"), written["number"]):
            number = int(_NUMBER.read(written["number"]))
    values: Values | None = None
    with findings.of():
        # Bounds are looked at even if the number of values cannot be read.
        values = _spaced(kind, written[kind], number or 2, rule, (*location, kind))
        if number or kind == "step":
            _hold_to_rule(values, rule, location)
    findings.refuse_any()
    assert values is not None
    return values


def _spaced(kind: str, written: object, number: int, rule: Numeric, location: Location) -> Values:
    """Values between written bounds."""
    bounds, unit = _read_bounds(kind, written, rule, location)
    if kind == "step":
        return _regular(_stepped(bounds, location), unit, rule, location)
    if bounds[0] == bounds[1]:
        raise rejected(location, "begins and ends with the same value", "write it as a list of one")
    if kind == "log":
        return _geometric(bounds, unit, number, rule, location)
    progression = Progression(bounds[0], (bounds[1] - bounds[0]) / (number - 1), number)
    return _regular(progression, unit, rule, location)


def _read_bounds(
    kind: str, written: object, rule: Numeric, location: Location
) -> tuple[list[Fraction], Unit]:
    """First, last and (for a step) increment as exact numbers in the first one's unit."""
    count = 3 if kind == "step" else 2
    if not isinstance(written, list) or len(written) != count:
        raise rejected(
            location, f"must be a list of {count} values", f"write {_FORMS[kind]}", written
        )
    exact: list[tuple[Fraction, Unit]] = []
    findings = Findings()
    for i, text in enumerate(written):
        with findings.of((*location, i), text):
            exact.append(rule.exact(text))
            if i < 2:
                rule.read(text)
    findings.refuse_any()
    first = exact[0][1]
    if any(unit.decibel != first.decibel for _, unit in exact):
        raise rejected(location, "mixes decibels with a plain unit", "take one of them")
    if first.decibel and any(unit.factor != first.factor for _, unit in exact):
        raise rejected(location, "mixes units of decibels", f"take {first.text} for all")
    # An increment feels no offset.
    offsets = [exact[0][1].offset - first.offset, exact[1][1].offset - first.offset, Fraction(0)]
    return [
        (number * unit.factor + offset) / first.factor
        for (number, unit), offset in zip(exact, offsets, strict=False)
    ], first


def _stepped(bounds: list[Fraction], location: Location) -> Progression:
    """Values from first to last, last included where a step lands on it."""
    first, last, step = bounds
    if step == 0:
        raise rejected(location, "has a step of zero", "list the values")
    if (last - first) / step < 0:
        remedy = "turn its sign, or swap first and last"
        raise rejected(location, "has a step that leads away from its end", remedy)
    number = math.floor((last - first) / step) + 1
    if number > MOST_VALUES:
        rule = f"gives {number} values, and an axis has at most {MOST_VALUES}"
        raise rejected(location, rule, "take a larger step")
    return Progression(first, step, number)


def _regular(progression: Progression, unit: Unit, rule: Numeric, location: Location) -> Values:
    """Values of a regular progression, whole ones where the field asks for them."""
    if unit.decibel:
        si = np.array([unit.to_si(Fraction(x)) for x in progression.values().tolist()])
        return Values(si, unit, progression)
    exact = progression.mapped(unit.factor, unit.offset)
    if not rule.whole:
        return Values(exact.values(), unit, progression)
    if exact.start.denominator != 1 or exact.increment.denominator != 1:
        raise rejected(location, "gives values that are not whole", "list them")
    steps = np.arange(progression.number, dtype=np.int64)
    return Values(int(exact.start) + int(exact.increment) * steps, unit, progression)


def _geometric(
    bounds: list[Fraction], unit: Unit, number: int, rule: Numeric, location: Location
) -> Values:
    """Values with a constant ratio, spaced in SI so that the unit of the ends doesn't matter."""
    if unit.decibel:
        remedy = f"write {_FORMS['linear']}"
        raise rejected(location, "steps in decibels, which are logarithms already", remedy)
    first, last = (unit.to_si(bound) for bound in bounds)
    if first <= 0 or last <= 0:
        raise rejected(location, "must begin and end above zero")
    si = _rounded(np.geomspace(first, last, number))
    si[0], si[-1] = first, last
    if not rule.whole:
        return Values(si, unit)
    whole = np.rint(si)
    if np.any(np.abs(si - whole) > 1e-9 * whole):
        raise rejected(location, "gives values that are not whole", "list them")
    return Values(whole.astype(np.int64), unit)


def _hold_to_rule(values: Values, rule: Numeric, location: Location) -> None:
    """Values within the bounds of their field, or a finding that names the first outside."""
    broken = rule.first_outside(values.si)
    if broken is not None:
        index, words = broken
        value = f"{values.displayed(values.unit)[index]:.12g} {values.unit.text}".rstrip()
        raise rejected(location, f"{words}, and value {index + 1} of the generator is {value}")
