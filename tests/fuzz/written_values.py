"""Anything that a field may hold, as a user may write it: strategies made of the field's own rule.

A new field needs no strategy here, and a rule of a new kind raises a `TypeError` that names it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
from hypothesis import strategies as st

from sweep.spec import flight, rules
from sweep.spec.rules import Choice, Method, Numeric, Rule, Text
from sweep.units import _PREFIXED, QuantityError, Unit

MOST_SIGNIFICANT = 17
"""Digits that tell any two floats apart."""


@dataclass(frozen=True)
class Number:
    """A number in a unit, as text that has not yet been put together."""

    digits: str
    unit: str

    @property
    def text(self) -> str | int | float:
        """What a user writes."""
        return f"{self.digits} {self.unit}" if self.unit else self.digits


@cache
def usual_units(rule: Numeric) -> list[str]:
    """Units in which users write a field, its SI unit among them; [""] for a pure number."""
    if not rule.si_unit:
        return ["", "%"] if not rule.whole else [""]
    usual = _PREFIXED.get(rule.si_unit, "")
    if " " in rule.example:
        usual += " " + rule.example.split(" ", 1)[1]
    return sorted({*usual.split(), rule.si_unit})


def unit_of(rule: Numeric, text: str) -> Unit:
    """A unit by its text, as the rule reads it."""
    return rule.exact(f"1 {text}".strip())[1]


def inside(rule: Numeric, values: list[float]) -> bool:
    """Whether SI values keep a rule's bounds."""
    return rule.first_outside(np.array(values, float)) is None


def si_bound(rule: Numeric, written: str | None, otherwise: float) -> float:
    """SI value of a bound as the rule writes it."""
    if written is None:
        return otherwise
    number, unit = rule.exact(written)
    return unit.to_si(number)


class Style:
    """A whole number taken apart into choices: one draw of hypothesis's in place of many."""

    def __init__(self, number: int) -> None:
        self._left = number

    def below(self, count: int) -> int:
        """A choice among so many."""
        self._left, chosen = divmod(self._left, count)
        return chosen

    def of(self, options: Sequence[Any]) -> Any:
        """One of the options."""
        return options[self.below(len(options))]


STYLES = st.integers(0, 2**24 - 1)
STEPS = 100
"""Steps from an example to the end of its decades."""


@cache
def ends(rule: Numeric) -> tuple[float, float, float]:
    """Least and largest SI value of a rule, and its example."""
    low = si_bound(rule, rule.above or rule.at_least, -math.inf)
    high = si_bound(rule, rule.at_most, math.inf)
    return low, high, abs(float(rule.read(rule.example))) or 1.0


def si_value(rule: Numeric, decades: float, step: int, style: Style) -> float:
    """A value so many steps from the example; now and then 0, a bound, or below 0."""
    low, high, centre = ends(rule)
    way = style.below(12)
    exponent = decades * step / STEPS
    value = math.inf if exponent + math.log10(centre) > 308 else centre * 10.0**exponent
    if low < 0 and way < 4:
        value = -value if way else 0.0
    elif way == 4 and decades >= 1:
        value = low
    elif way == 5 and decades >= 1:
        value = high
    value = min(max(value, low), high)
    return value if math.isfinite(value) else centre


def whole_number(rule: Numeric, step: int, style: Style) -> int:
    """A whole number within a rule's bounds: small, any, a bound, or the example."""
    low, high, centre = ends(rule)
    low, high = math.ceil(max(low, -(2.0**63))), math.floor(min(high, 2.0**63))
    way, share = style.below(4), abs(step) / STEPS
    if way == 0:
        return int(centre)
    if way == 1:
        return min(low + abs(step), high)
    return low + int(Fraction(share) * (high - low))


def number_of(
    rule: Numeric, decades: float, step: int, style: Style, unit: str | None = None
) -> Number:
    """A number within a rule's bounds; in a unit of choice, or in any."""
    if rule.whole:
        return Number(str(whole_number(rule, step, style)), "")
    chosen = style.of(usual_units(rule)) if unit is None else unit
    value, digits = si_value(rule, decades, step, style), style.of([3, 2, 6, MOST_SIGNIFICANT])
    measure = unit_of(rule, chosen)
    if measure.decibel:
        number = Fraction(10 * math.log10(value)) if value > 0 else None
    else:
        number = (Fraction(value) - measure.offset) / measure.factor
    for precision in (digits, MOST_SIGNIFICANT):
        text = "nan" if number is None else f"{float(number):.{precision}g}"
        if number is not None and _holds(rule, text, chosen):
            return Number(text, chosen)
    example = str(rule.example).split(" ", 1)
    return Number(example[0], example[1] if len(example) > 1 else "")


@cache
def numbers(rule: Numeric, decades: float, unit: str | None = None) -> st.SearchStrategy[Number]:
    """Numbers within a rule's bounds; in a unit of choice, or in any."""
    return st.builds(
        lambda step, style: number_of(rule, decades, step, Style(style), unit),
        st.integers(-STEPS, STEPS),
        STYLES,
    )


def _holds(rule: Numeric, text: str, unit: str) -> bool:
    """Whether a number in a unit keeps a rule's bounds and is not rounded to nothing."""
    value = unit_of(rule, unit).to_si(Fraction(text))
    return math.isfinite(value) and inside(rule, [value])


_UNIT_SPELLINGS = (
    ("u", "µ"), ("u", "μ"), ("ohm", "Ω"), ("deg", "°"), ("^2", "²"), ("^", "**"), ("/", " / "),
    ("rtHz", "√Hz"), ("rtHz", "sqrt(Hz)"), ("rtHz", "Hz^0.5"), ("rtHz", "Hz^(1/2)"), ("*", "·"),
)  # fmt: skip


def spelled(number: Number, style: Style) -> str | int | float:
    """One of the many ways in which a number with a unit may be written."""
    digits, unit, way = number.digits, number.unit, style.below(10)
    if way == 1:
        digits = f"{Decimal(digits):E}"
    elif way == 2 and not digits.startswith("-"):
        digits = f"+{digits}"
    elif way == 3 and digits.startswith("-"):
        digits = digits.replace("-", "−", 1)
    elif way == 4 and digits.startswith("0."):
        digits = digits[1:]
    elif way == 5 and "." not in digits and "e" not in digits:
        digits += "." if unit else ".0"
    if not unit:
        return digits if 1 <= way <= 6 else _plain(digits)
    old, new = style.of(_UNIT_SPELLINGS)
    if (old != "u" or unit.startswith("u")) and "(" not in unit and style.below(2):
        unit = unit.replace(old, new, 1)
    # Without a space "5" and "1/m" would be 51.
    return digits + style.of([" ", " ", "  " if unit[0] == "1" else "", "  "]) + unit


def _plain(digits: str) -> int | float:
    """A bare YAML number."""
    return int(digits) if digits.lstrip("+-").isdigit() else float(digits)


ASTRAY, FAR = 40, (30.0, 300.0)
"""Of so many numbers one lies so many decades from its example."""


@cache
def quantities(rule: Numeric, decades: float) -> st.SearchStrategy[Any]:
    """Numbers within a rule's bounds, however spelled."""

    def made(step: int, first: int, second: int) -> str | int | float:
        style, spelling = Style(first), Style(second)
        far = style.below(2 * ASTRAY)
        reach = FAR[far % 2] if far >= 2 * ASTRAY - 2 else decades
        number = number_of(rule, reach, step, style)
        value = int(number.digits) if rule.whole else 0
        if value > 1 and value & (value - 1) == 0 and spelling.below(2):
            return f"2^{value.bit_length() - 1}"
        return spelled(number, spelling)

    return st.builds(made, st.integers(-STEPS, STEPS), STYLES, STYLES)


@cache
def windows(rule: rules.Window) -> st.SearchStrategy[str]:
    """Any window of scipy's that the rule takes, with parameters where it wants some."""
    names = (*rules.WINDOWS, *rules.ALIASES, *rules.SCIPY_WINDOWS)
    inside = ("", "(0.5)", "(2.5)", "(8.6)", "(60)", "(1.5, 7)")
    every = [name + parameters for name in names for parameters in inside]
    return st.sampled_from([window for window in every if _reads(rule, window)])


_LETTERS = "abc XYZ 019 äöü λ°µ 日本 -_:#'\"[]{}%&*!|>?@`,\t"


@st.composite
def texts(draw: st.DrawFn, rule: Text) -> str:
    """Text that a rule takes."""
    if rule.pattern == Text(about="").pattern:
        return draw(st.text(_LETTERS, max_size=30))
    return draw(st.from_regex(rule.pattern, fullmatch=True).map(lambda text: text[:20]))


def several(rule: rules.Several, decades: float) -> st.SearchStrategy[list[Any]]:
    """A list as a rule takes it, of few values."""
    most = min(rule.most, rule.least + 2)
    listed = st.lists(values(rule.of, decades), min_size=rule.least, max_size=most)
    return listed.filter(lambda written: _reads(rule, written))


def _beams(rule: flight.Beams, decades: float) -> st.SearchStrategy[list[Any]]:
    """A few beams, by angles or by vectors."""
    steered = several(flight.STEERED, min(decades, 0.3))
    pointed = st.lists(st.sampled_from(["-1", 0.25, "−0.5", 0]), min_size=2, max_size=2)
    return st.lists(st.one_of(steered, pointed.map(lambda two: [*two, -1])), min_size=1, max_size=4)


def _reads(rule: Rule, written: object) -> bool:
    try:
        rule.read(written)
    except QuantityError:
        return False
    return True


@cache
def values(rule: Rule, decades: float) -> st.SearchStrategy[Any]:
    """All that a rule takes, as written; numbers about its example, so many decades away."""
    if isinstance(rule, Numeric):
        number = quantities(rule, decades)
        return st.one_of(st.just(rule.word), number) if isinstance(rule.means, str) else number
    if isinstance(rule, rules.Window):
        return windows(rule)
    if isinstance(rule, Method):  # a function of the user's would have to be there
        return st.sampled_from(rule.options)
    if isinstance(rule, Choice):
        return st.sampled_from(rule.schema()["enum"])
    if isinstance(rule, Text):
        return texts(rule)
    if isinstance(rule, rules.Flag):
        return st.booleans()
    if isinstance(rule, flight.Beams):
        return _beams(rule, decades)
    if isinstance(rule, rules.Several):
        return several(rule, decades)
    if isinstance(rule, rules.SweepError):  # a table that covers any chirp
        rows = [["0 us", "0 Hz"], ["0.5 s", "20 kHz"], ["1 s", "40 kHz"]]
        return st.sampled_from(["none", rows])
    raise TypeError(f"no strategy for what {type(rule).__name__} takes: add one in written_values")


def cheaper(rule: Rule, bounds: dict[str, str]) -> Rule:
    """A rule with tighter bounds, so that what keeps it is soon computed."""
    return replace(rule, **bounds)  # type: ignore[arg-type]
