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

from sweep.spec import flight_sections, rules
from sweep.spec.rules import ChoiceOrFunctionRule, ChoiceRule, NumericRule, Rule, TextRule
from sweep.units import _USUAL_UNITS_BY_SI_UNIT, QuantityError, Unit

SIGNIFICANT_DIGITS_MAX = 17
"""Digits that tell any two floats apart."""


@dataclass(frozen=True)
class NumberWithUnit:
    """A number in a unit, as text that has not yet been put together."""

    digits: str
    unit: str

    @property
    def text(self) -> str | int | float:
        """What a user writes."""
        return f"{self.digits} {self.unit}" if self.unit else self.digits


@cache
def usual_units(rule: NumericRule) -> list[str]:
    """Units in which users write a field, its SI unit among them; [""] for a pure number."""
    if not rule.si_unit:
        return ["", "%"] if not rule.is_integer else [""]
    usual = _USUAL_UNITS_BY_SI_UNIT.get(rule.si_unit, "")
    if " " in rule.example:
        usual += " " + rule.example.split(" ", 1)[1]
    return sorted({*usual.split(), rule.si_unit})


def parse_unit(rule: NumericRule, unit_text: str) -> Unit:
    """A unit by its text, as the rule reads it."""
    return rule.read_exact_number(f"1 {unit_text}".strip())[1]


def is_within_bounds(rule: NumericRule, values: list[float]) -> bool:
    """Tell whether SI values keep a rule's bounds."""
    return rule.first_bound_violation(np.array(values, float)) is None


def si_bound(rule: NumericRule, raw_bound: str | None, default: float) -> float:
    """SI value of a bound as the rule writes it."""
    if raw_bound is None:
        return default
    number, unit = rule.read_exact_number(raw_bound)
    return unit.to_si(number)


class ChoiceSource:
    """A whole number taken apart into choices: one draw of hypothesis's in place of many."""

    def __init__(self, number: int) -> None:
        self._remaining = number

    def choose_below(self, n_choices: int) -> int:
        """A choice among so many."""
        self._remaining, chosen = divmod(self._remaining, n_choices)
        return chosen

    def choose(self, options: Sequence[Any]) -> Any:
        """One of the options."""
        return options[self.choose_below(len(options))]


CHOICE_NUMBERS = st.integers(0, 2**24 - 1)
STEPS_TO_DECADES_END = 100
"""Steps from an example to the end of its decades."""


@cache
def rule_limits(rule: NumericRule) -> tuple[float, float, float]:
    """Least and largest SI value of a rule, and its example."""
    lower = si_bound(rule, rule.above or rule.at_least, -math.inf)
    upper = si_bound(rule, rule.at_most, math.inf)
    return lower, upper, abs(float(rule.read(rule.example))) or 1.0


def si_value_near_example(
    rule: NumericRule, decades: float, step: int, choices: ChoiceSource
) -> float:
    """A value so many steps from the example; now and then 0, a bound, or below 0."""
    lower, upper, example = rule_limits(rule)
    case = choices.choose_below(12)
    exponent = decades * step / STEPS_TO_DECADES_END
    value = math.inf if exponent + math.log10(example) > 308 else example * 10.0**exponent
    if lower < 0 and case < 4:
        value = -value if case else 0.0
    elif case == 4 and decades >= 1:
        value = lower
    elif case == 5 and decades >= 1:
        value = upper
    value = min(max(value, lower), upper)
    return value if math.isfinite(value) else example


def integer_within_bounds(rule: NumericRule, step: int, choices: ChoiceSource) -> int:
    """A whole number within a rule's bounds: small, any, a bound, or the example."""
    lower, upper, example = rule_limits(rule)
    lower, upper = math.ceil(max(lower, -(2.0**63))), math.floor(min(upper, 2.0**63))
    case, fraction = choices.choose_below(4), abs(step) / STEPS_TO_DECADES_END
    if case == 0:
        return int(example)
    if case == 1:
        return min(lower + abs(step), upper)
    return lower + int(Fraction(fraction) * (upper - lower))


def number_with_unit(
    rule: NumericRule, decades: float, step: int, choices: ChoiceSource, unit: str | None = None
) -> NumberWithUnit:
    """A number within a rule's bounds; in a unit of choice, or in any."""
    if rule.is_integer:
        return NumberWithUnit(str(integer_within_bounds(rule, step, choices)), "")
    chosen = choices.choose(usual_units(rule)) if unit is None else unit
    value, digits = (
        si_value_near_example(rule, decades, step, choices),
        choices.choose([3, 2, 6, SIGNIFICANT_DIGITS_MAX]),
    )
    parsed_unit = parse_unit(rule, chosen)
    if parsed_unit.is_logarithmic:
        number = Fraction(10 * math.log10(value)) if value > 0 else None
    else:
        number = (Fraction(value) - parsed_unit.offset) / parsed_unit.factor
    for precision in (digits, SIGNIFICANT_DIGITS_MAX):
        text = "nan" if number is None else f"{float(number):.{precision}g}"
        if number is not None and _is_valid_number(rule, text, chosen):
            return NumberWithUnit(text, chosen)
    example = str(rule.example).split(" ", 1)
    return NumberWithUnit(example[0], example[1] if len(example) > 1 else "")


@cache
def number_strategy(
    rule: NumericRule, decades: float, unit: str | None = None
) -> st.SearchStrategy[NumberWithUnit]:
    """Numbers within a rule's bounds; in a unit of choice, or in any."""
    return st.builds(
        lambda step, choice_number: number_with_unit(
            rule, decades, step, ChoiceSource(choice_number), unit
        ),
        st.integers(-STEPS_TO_DECADES_END, STEPS_TO_DECADES_END),
        CHOICE_NUMBERS,
    )


def _is_valid_number(rule: NumericRule, text: str, unit: str) -> bool:
    """Tell whether a number in a unit keeps a rule's bounds and is not rounded to nothing."""
    value = parse_unit(rule, unit).to_si(Fraction(text))
    return math.isfinite(value) and is_within_bounds(rule, [value])


_UNIT_SPELLINGS = (
    ("u", "µ"), ("u", "μ"), ("ohm", "Ω"), ("deg", "°"), ("^2", "²"), ("^", "**"), ("/", " / "),
    ("rtHz", "√Hz"), ("rtHz", "sqrt(Hz)"), ("rtHz", "Hz^0.5"), ("rtHz", "Hz^(1/2)"), ("*", "·"),
)  # fmt: skip


def spell_number(number: NumberWithUnit, choices: ChoiceSource) -> str | int | float:
    """One of the many ways in which a number with a unit may be written."""
    digits, unit, variant = number.digits, number.unit, choices.choose_below(10)
    if variant == 1:
        digits = f"{Decimal(digits):E}"
    elif variant == 2 and not digits.startswith("-"):
        digits = f"+{digits}"
    elif variant == 3 and digits.startswith("-"):
        digits = digits.replace("-", "−", 1)
    elif variant == 4 and digits.startswith("0."):
        digits = digits[1:]
    elif variant == 5 and "." not in digits and "e" not in digits:
        digits += "." if unit else ".0"
    if not unit:
        return digits if 1 <= variant <= 6 else _to_yaml_number(digits)
    ascii_spelling, other_spelling = choices.choose(_UNIT_SPELLINGS)
    if (
        (ascii_spelling != "u" or unit.startswith("u"))
        and "(" not in unit
        and choices.choose_below(2)
    ):
        unit = unit.replace(ascii_spelling, other_spelling, 1)
    # Without a space "5" and "1/m" would be 51.
    return digits + choices.choose([" ", " ", "  " if unit[0] == "1" else "", "  "]) + unit


def _to_yaml_number(digits: str) -> int | float:
    """A bare YAML number."""
    return int(digits) if digits.lstrip("+-").isdigit() else float(digits)


FAR_VALUE_ONE_IN, FAR_DECADES = 40, (30.0, 300.0)
"""Of so many numbers one lies so many decades from its example."""


@cache
def quantity_strategy(rule: NumericRule, decades: float) -> st.SearchStrategy[Any]:
    """Numbers within a rule's bounds, however spelled."""

    def spell_random_number(
        step: int, number_choice_number: int, spelling_choice_number: int
    ) -> str | int | float:
        choices, spelling_choices = (
            ChoiceSource(number_choice_number),
            ChoiceSource(spelling_choice_number),
        )
        far_choice = choices.choose_below(2 * FAR_VALUE_ONE_IN)
        number_decades = (
            FAR_DECADES[far_choice % 2] if far_choice >= 2 * FAR_VALUE_ONE_IN - 2 else decades
        )
        number = number_with_unit(rule, number_decades, step, choices)
        value = int(number.digits) if rule.is_integer else 0
        if value > 1 and value & (value - 1) == 0 and spelling_choices.choose_below(2):
            return f"2^{value.bit_length() - 1}"
        return spell_number(number, spelling_choices)

    return st.builds(
        spell_random_number,
        st.integers(-STEPS_TO_DECADES_END, STEPS_TO_DECADES_END),
        CHOICE_NUMBERS,
        CHOICE_NUMBERS,
    )


@cache
def window_strategy(rule: rules.WindowFunctionRule) -> st.SearchStrategy[str]:
    """Any window of scipy's that the rule takes, with parameters where it wants some."""
    names = (*rules.COSINE_SUM_WINDOWS, *rules.WINDOW_NAME_ALIASES, *rules.SCIPY_WINDOWS)
    parameter_texts = ("", "(0.5)", "(2.5)", "(8.6)", "(60)", "(1.5, 7)")
    window_names = [name + parameters for name in names for parameters in parameter_texts]
    return st.sampled_from([window for window in window_names if _is_readable(rule, window)])


_TEXT_ALPHABET = "abc XYZ 019 äöü λ°µ 日本 -_:#'\"[]{}%&*!|>?@`,\t"


@st.composite
def text_strategy(draw: st.DrawFn, rule: TextRule) -> str:
    """Text that a rule takes."""
    if rule.pattern == TextRule(description="").pattern:
        return draw(st.text(_TEXT_ALPHABET, max_size=30))
    return draw(st.from_regex(rule.pattern, fullmatch=True).map(lambda text: text[:20]))


def list_strategy(rule: rules.ListRule, decades: float) -> st.SearchStrategy[list[Any]]:
    """A list as a rule takes it, of few values."""
    length_max = min(rule.length_max, rule.length_min + 2)
    listed = st.lists(
        value_strategy(rule.element_rule, decades), min_size=rule.length_min, max_size=length_max
    )
    return listed.filter(lambda raw_value: _is_readable(rule, raw_value))


def _beams_strategy(
    rule: flight_sections.BeamDirectionsRule, decades: float
) -> st.SearchStrategy[list[Any]]:
    """A few beams, by angles or by vectors."""
    steered_beams = list_strategy(flight_sections.STEERING_ANGLES_RULE, min(decades, 0.3))
    vector_components = st.lists(st.sampled_from(["-1", 0.25, "−0.5", 0]), min_size=2, max_size=2)
    return st.lists(
        st.one_of(steered_beams, vector_components.map(lambda xy: [*xy, -1])),
        min_size=1,
        max_size=4,
    )


def _is_readable(rule: Rule, raw_value: object) -> bool:
    try:
        rule.read(raw_value)
    except QuantityError:
        return False
    return True


@cache
def value_strategy(rule: Rule, decades: float) -> st.SearchStrategy[Any]:
    """All that a rule takes, as written; numbers about its example, so many decades away."""
    if isinstance(rule, NumericRule):
        number = quantity_strategy(rule, decades)
        return (
            st.one_of(st.just(rule.keyword), number)
            if isinstance(rule.keyword_value, str)
            else number
        )
    if isinstance(rule, rules.WindowFunctionRule):
        return window_strategy(rule)
    if isinstance(rule, ChoiceOrFunctionRule):  # a function of the user's would have to be there
        return st.sampled_from(rule.options)
    if isinstance(rule, ChoiceRule):
        return st.sampled_from(rule.schema()["enum"])
    if isinstance(rule, TextRule):
        return text_strategy(rule)
    if isinstance(rule, rules.FlagRule):
        return st.booleans()
    if isinstance(rule, flight_sections.BeamDirectionsRule):
        return _beams_strategy(rule, decades)
    if isinstance(rule, rules.ListRule):
        return list_strategy(rule, decades)
    if isinstance(rule, rules.FrequencyErrorTableRule):  # a table that covers any chirp
        rows = [["0 us", "0 Hz"], ["0.5 s", "20 kHz"], ["1 s", "40 kHz"]]
        return st.sampled_from(["none", rows])
    raise TypeError(f"no strategy for what {type(rule).__name__} takes: add one in written_values")


def with_tighter_bounds(rule: Rule, bounds: dict[str, str]) -> Rule:
    """A rule with tighter bounds, so that what keeps it is soon computed."""
    return replace(rule, **bounds)  # type: ignore[arg-type]
