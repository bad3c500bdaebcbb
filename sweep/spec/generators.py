"""Written values along an axis as arrays: single values and linear, log or step generators.

Regular values stay exact until the one rounding of each, so that a value that a generator makes is
the float that the same value written out gives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from sweep.spec.mistakes import Findings, Location, near_miss, rejected
from sweep.spec.rules import Numeric, Rule
from sweep.units import QuantityError, Unit

MOST_VALUES = 20_000_000
_FORMS = {
    "linear": "{linear: [first, last], number: 10}",
    "log": "{log: [first, last], number: 10}",
    "step": "{step: [first, last, step]}",
}
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
        return _rounded(10.0 * np.log10(si))
    if (unit.factor, unit.offset) == (1, 0):
        return _rounded(si.astype(float))
    (p, q), (a, b) = unit.offset.as_integer_ratio(), unit.factor.as_integer_ratio()
    ratios = (value.as_integer_ratio() for value in si.tolist())
    return _rounded(np.array([(n * q - p * d) * b / (d * q * a) for n, d in ratios]))


def in_units(rule: Numeric, written: object, units: str) -> float:
    """Written value in the unit of choice."""
    number, unit = rule.exact(written)
    display = rule.exact(f"1 {units}" if units else 1)[1]
    if unit.decibel != display.decibel:
        return float(values_in(display, np.array([unit.to_si(number)]))[0])
    if unit.decibel:
        return float(number)
    return float((unit.factor * number + unit.offset - display.offset) / display.factor)


# Written values


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
        offset = (self.unit.offset - unit.offset) / unit.factor
        return self.progression.mapped(self.unit.factor / unit.factor, offset).values()


def read_pieces(written: object, rule: Rule, location: Location) -> list[Values] | list[str]:
    """Values of an axis over one field: a list of values and generators, or one generator.

    Raises
    ------
    Rejected
        With every mistake in it.
    """
    if isinstance(written, dict):
        return [_read_generator(written, rule, location)]
    if not isinstance(written, list):
        remedy = f"write e.g. [{written}] or {_FORMS['linear']}"
        raise rejected(location, "must be a list or a generator", remedy, written)
    if not written:
        raise rejected(location, "holds no value", "list at least one")
    pieces: list[Any] = []
    findings = Findings()
    for i, piece in enumerate(written):
        read = _read_generator if isinstance(piece, dict) else read_single
        with findings.of():
            pieces.append(read(piece, rule, (*location, i)))
    findings.refuse_any()
    return pieces


def read_single(written: object, rule: Rule, location: Location) -> Values | str:
    """One value: of numeric fields with its unit, of others the word."""
    try:
        value = rule.read(written)
        if not isinstance(rule, Numeric):
            return str(value)
        number, unit = rule.exact(written)
    except QuantityError as error:
        raise rejected(location, error.rule, error.suggestion, written) from None
    kind = np.int64 if rule.whole else np.float64
    return Values(np.array([value], dtype=kind), unit, Progression(number))


def _read_generator(written: dict[Any, Any], rule: Rule, location: Location) -> Values:
    """Values of ``{linear: ...}``, ``{log: ...}`` or ``{step: ...}``, within the field's bounds."""
    kinds = [key for key in written if key in _FORMS]
    if len(kinds) != 1:
        remedy = near_miss(str(next(iter(written), "")), _FORMS)
        remedy = remedy or f"write e.g. {_FORMS['linear']}"
        raise rejected(location, "must have exactly one of linear, log and step", remedy)
    if not isinstance(rule, Numeric):
        raise rejected(location, "takes words, which have no steps", "list them")
    kind, findings = kinds[0], Findings()
    allowed = {kind} if kind == "step" else {kind, "number"}
    for key, value in written.items():
        if key not in allowed:
            with findings.of():
                where = (*location, str(key))
                raise rejected(where, f"is no part of '{kind}'", f"write {_FORMS[kind]}", value)
    number = 0
    if kind != "step":
        with findings.of((*location, "number"), written.get("number")):
            if "number" not in written:
                raise rejected(location, "lacks the number of values", f"write {_FORMS[kind]}")
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
