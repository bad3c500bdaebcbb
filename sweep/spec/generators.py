"""Written axis values as arrays: single values and linear, log or step generators."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from sweep.spec.mistakes import ABSENT, Finding, Location, near_miss
from sweep.spec.progressions import Progression, rounded, si_values, values_in
from sweep.spec.rules import Numeric, Rule
from sweep.units import QuantityError, Unit

MOST_VALUES = 20_000_000
GENERATORS = ("linear", "log", "step")

_FORMS = {
    "linear": "{linear: [first, last], number: 10}",
    "log": "{log: [first, last], number: 10}",
    "step": "{step: [first, last, step]}",
}


class Rejected(Exception):
    """Written values that cannot be read.

    Parameters
    ----------
    findings : list of Finding
        Everything wrong with them.
    """

    def __init__(self, *findings: Finding) -> None:
        super().__init__(*findings)
        self.findings = list(findings)


@dataclass(frozen=True)
class Values:
    """Numbers of one written piece of an axis.

    Parameters
    ----------
    si : ndarray (n,)
        SI values.
    unit : Unit
        The unit they were written in.
    progression : Progression, optional
        The same numbers exactly, in `unit`, where they are regular.
    """

    si: np.ndarray
    unit: Unit
    progression: Progression | None = None

    def displayed(self, unit: Unit) -> np.ndarray:
        """Values (n,) in the unit of choice."""
        if self.progression is None or unit.decibel != self.unit.decibel:
            return values_in(unit, self.si)
        if unit == self.unit:
            return self.progression.values()
        factor = self.unit.factor / unit.factor
        return self.progression.mapped(
            factor, (self.unit.offset - unit.offset) / unit.factor
        ).values()


@contextmanager
def reported(location: Location, written: object) -> Iterator[None]:
    """Context in which a broken rule becomes a finding at the given location."""
    try:
        yield
    except QuantityError as error:
        finding = Finding(location, error.rule, error.suggestion, written)
        raise Rejected(finding) from None


def read_pieces(written: object, rule: Rule, location: Location) -> list[Values] | list[str]:
    """Values of an axis over one field: a list of values and generators, or one generator.

    Raises
    ------
    Rejected
        With every mistake in it.
    """
    if isinstance(written, dict):
        return [read_generator(written, rule, location)]
    if not isinstance(written, list):
        raise Rejected(
            Finding(
                location,
                "must be a list or a generator",
                f"write e.g. [{written}] or {_FORMS['linear']}",
                written,
            )
        )
    if not written:
        raise Rejected(Finding(location, "holds no value", "list at least one", ABSENT))
    pieces: list[Any] = []
    findings: list[Finding] = []
    for i, piece in enumerate(written):
        try:
            if isinstance(piece, dict):
                pieces.append(read_generator(piece, rule, (*location, i)))
            else:
                pieces.append(read_single(piece, rule, (*location, i)))
        except Rejected as rejected:
            findings += rejected.findings
    if findings:
        raise Rejected(*findings)
    return pieces


def read_single(written: object, rule: Rule, location: Location) -> Values | str:
    """One value: of numeric fields with its unit, of others the word."""
    with reported(location, written):
        value = rule.read(written)
        if not isinstance(rule, Numeric):
            return str(value)
        number, unit = rule.exact(written)
        kind = np.int64 if rule.whole else np.float64
        return Values(np.array([value], dtype=kind), unit, Progression(number))


def read_generator(written: dict[Any, Any], rule: Rule, location: Location) -> Values:
    """Values of ``{linear: ...}``, ``{log: ...}`` or ``{step: ...}``, within the field's bounds."""
    kinds = [key for key in written if key in GENERATORS]
    if len(kinds) != 1:
        suggestion = near_miss(str(next(iter(written), "")), GENERATORS)
        raise Rejected(
            Finding(
                location,
                "must have exactly one of linear, log and step",
                suggestion or f"write e.g. {_FORMS['linear']}",
                ABSENT,
            )
        )
    kind = kinds[0]
    if not isinstance(rule, Numeric):
        raise Rejected(Finding(location, "takes words, which have no steps", "list them", ABSENT))
    allowed = {kind} if kind == "step" else {kind, "number"}
    findings = [
        Finding((*location, str(key)), f"is no part of '{kind}'", f"write {_FORMS[kind]}", value)
        for key, value in written.items()
        if key not in allowed
    ]
    try:
        values = _generated(kind, written, rule, location)
        _hold_to_rule(values, rule, location)
    except Rejected as rejected:
        raise Rejected(*findings, *rejected.findings) from None
    if findings:
        raise Rejected(*findings)
    return values


def _generated(kind: str, written: dict[Any, Any], rule: Numeric, location: Location) -> Values:
    """Values of a generator whose kind is known."""
    findings: list[Finding] = []
    number = 2  # stands in for one that cannot be read, so that the bounds are looked at too
    if kind != "step":
        try:
            number = _read_number_of_values(written, location, kind)
        except Rejected as rejected:
            findings += rejected.findings
    try:
        values = _spaced(kind, written[kind], number, rule, (*location, kind))
    except Rejected as rejected:
        raise Rejected(*findings, *rejected.findings) from None
    if findings:
        raise Rejected(*findings)
    return values


def _spaced(kind: str, written: object, number: int, rule: Numeric, location: Location) -> Values:
    """Values between written bounds."""
    bounds, unit = _read_bounds(kind, written, rule, location)
    if kind == "step":
        return _stepped(bounds, unit, rule, location)
    if bounds[0] == bounds[1]:
        rule_broken = "begins and ends with the same value"
        raise Rejected(Finding(location, rule_broken, "write it as a list of one", ABSENT))
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
        raise Rejected(
            Finding(location, f"must be a list of {count} values", f"write {_FORMS[kind]}", written)
        )
    numbers: list[Fraction] = []
    units: list[Unit] = []
    findings: list[Finding] = []
    for i, text in enumerate(written):
        try:
            with reported((*location, i), text):
                number, unit = rule.exact(text)
                if i < 2:
                    rule.read(text)
                numbers.append(number)
                units.append(unit)
        except Rejected as rejected:
            findings += rejected.findings
    if findings:
        raise Rejected(*findings)
    first = units[0]
    if any(unit.decibel != first.decibel for unit in units):
        rule_broken = "mixes decibels with a plain unit"
        raise Rejected(Finding(location, rule_broken, "take one of them", ABSENT))
    pairs = zip(numbers, units, strict=True)
    return [_in_unit(n, u, first, i) for i, (n, u) in enumerate(pairs)], first


def _in_unit(number: Fraction, unit: Unit, wanted: Unit, position: int) -> Fraction:
    """Number in another unit; an increment (position 2) feels no offset."""
    offset = Fraction(0) if position == 2 else unit.offset - wanted.offset
    return (number * unit.factor + offset) / wanted.factor


def _read_number_of_values(written: dict[Any, Any], location: Location, kind: str) -> int:
    """Number of values of a linear or log generator."""
    rule = Numeric(about="", example="10", at_least="2", at_most=str(MOST_VALUES), whole=True)
    if "number" not in written:
        raise Rejected(
            Finding(location, "lacks the number of values", f"write {_FORMS[kind]}", ABSENT)
        )
    with reported((*location, "number"), written["number"]):
        return int(rule.read(written["number"]))


def _stepped(bounds: list[Fraction], unit: Unit, rule: Numeric, location: Location) -> Values:
    """Values from first to last, last included where a step lands on it."""
    first, last, step = bounds
    if step == 0:
        raise Rejected(Finding(location, "has a step of zero", "list the values", ABSENT))
    if (last - first) / step < 0:
        raise Rejected(
            Finding(
                location,
                "has a step that leads away from its end",
                "turn its sign, or swap first and last",
                ABSENT,
            )
        )
    number = math.floor((last - first) / step) + 1
    if number > MOST_VALUES:
        raise Rejected(
            Finding(
                location,
                f"gives {number} values, and an axis has at most {MOST_VALUES}",
                "take a larger step",
                ABSENT,
            )
        )
    return _regular(Progression(first, step, number), unit, rule, location)


def _regular(progression: Progression, unit: Unit, rule: Numeric, location: Location) -> Values:
    """Values of a regular progression, whole ones where the field asks for them."""
    if not rule.whole:
        return Values(si_values(progression, unit), unit, progression)
    exact = progression.mapped(unit.factor, unit.offset)
    if exact.start.denominator != 1 or exact.increment.denominator != 1:
        raise Rejected(Finding(location, "gives values that are not whole", "list them", ABSENT))
    steps = np.arange(progression.number, dtype=np.int64)
    return Values(int(exact.start) + int(exact.increment) * steps, unit, progression)


def _geometric(
    bounds: list[Fraction], unit: Unit, number: int, rule: Numeric, location: Location
) -> Values:
    """Values with a constant ratio, spaced in SI so that the unit of the ends doesn't matter."""
    if unit.decibel:
        raise Rejected(
            Finding(
                location,
                "steps in decibels, which are logarithms already",
                f"write {_FORMS['linear']}",
                ABSENT,
            )
        )
    first, last = (unit.to_si(bound) for bound in bounds)
    if first <= 0 or last <= 0:
        raise Rejected(Finding(location, "must begin and end above zero", "", ABSENT))
    si = rounded(np.geomspace(first, last, number))
    si[0], si[-1] = first, last
    if not rule.whole:
        return Values(si, unit)
    whole = np.rint(si)
    if np.any(np.abs(si - whole) > 1e-9 * whole):
        raise Rejected(Finding(location, "gives values that are not whole", "list them", ABSENT))
    return Values(whole.astype(np.int64), unit)


def _hold_to_rule(values: Values, rule: Numeric, location: Location) -> None:
    """Values within the bounds of their field, or a finding that names the first outside."""
    broken = rule.first_outside(values.si)
    if broken is not None:
        index, words = broken
        value = values.displayed(values.unit)[index]
        raise Rejected(
            Finding(
                location,
                f"{words}, and value {index + 1} of the generator is "
                f"{value:.12g} {values.unit.text}".rstrip(),
                "",
                ABSENT,
            )
        )
