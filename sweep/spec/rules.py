"""Rules of single fields of a spec, and the findings and mistakes that broken rules raise.

A rule is an entry of a field's metadata. Pydantic validates the field with it, an axis over the
field applies it to every value, and the JSON Schema describes it.
"""

from __future__ import annotations

import dataclasses
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from fractions import Fraction
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from sweep.messages import escape_unprintable
from sweep.model.effects.phase_errors import NO_TABLE
from sweep.model.effects.sweep_error_table import fit_sweep_frequency_error
from sweep.model.window import COSINE_SUM_COEFFICIENTS, WINDOW_NAME_ALIASES
from sweep.scenes.scene_files import file_digest
from sweep.units import DECIBEL, ExactQuantity, QuantityError, Unit, read_number, read_quantity

# Mistakes in specs

SpecLocation = tuple[str | int, ...]
"""Keys and list indices that lead to a value in a spec."""

MISSING = object()
"""Marker for a value that a spec does not contain."""
_SHOWN_VALUE_CHARACTERS_MAX = 60
"""Largest number of characters of a wrong value that an error message shows."""
_PARTIAL_NAME_CHARACTERS_MIN, _SUGGESTIONS_MAX = 4, 3
"""Limits for suggestions of longer names that contain a wrong name.

The first is the smallest number of characters of the wrong name. The second is the largest number
of names that are suggested.
"""
_OFF_WORDS = {"no", "n", "false", "none", "never", "null", "disable", "disabled", "0", "off"}
"""Words that users write where a spec takes ``off``."""
_ON_WORDS = {"yes", "y", "true", "always", "enable", "enabled", "1", "on"}
"""Words that users write where a spec takes ``on``."""


@dataclass(frozen=True, order=True)
class Mistake:
    """One mistake in a user's spec; text fields may be empty."""

    path: str
    """Dotted path of the value in the spec, such as ``instrument.laser.power`` or
    ``axes.target.range[2]``."""
    problem: str
    """Broken rule, as the end of a sentence that begins with the path: ``must be at least 1 m``."""
    value: str = ""
    """Wrong value as the user wrote it; empty if it is not to be shown."""
    suggestion: str = ""
    """Advice to the user, such as a similar name or a remedy; may be empty."""
    line: int | None = None
    """Line in the file, counted from 1; None if unknown."""
    file: str = ""
    """Path of the file; empty if the spec is not from a file."""

    def __str__(self) -> str:
        prefix = (
            f"{self.file}:{self.line}: " if self.line else f"{self.file}: " if self.file else ""
        )
        statement = f"{self.path}: {self.problem}" if self.path else self.problem
        quoted_value = f" (you wrote {self.value})" if self.value else ""
        return escape_unprintable(
            prefix + statement + quoted_value + (f"; {self.suggestion}" if self.suggestion else "")
        )


class SpecError(Exception):
    """Error that holds every mistake in a spec, in the order in which they are shown."""

    def __init__(self, mistakes: Iterable[Mistake]) -> None:
        self.mistakes = list(mistakes)
        super().__init__(self.mistakes)

    def __str__(self) -> str:
        if len(self.mistakes) == 1:
            return str(self.mistakes[0])
        lines = [f"{len(self.mistakes)} mistakes:", *(f"  {mistake}" for mistake in self.mistakes)]
        return "\n".join(lines)


@dataclass(frozen=True)
class Finding:
    """A mistake at a location of a spec, before its file and line are known."""

    location: SpecLocation
    """Keys and list indices that lead to the value."""
    problem: str
    """Broken rule, as the end of a sentence that begins with the location: ``must be at least
    1 m``."""
    suggestion: str = ""
    """Advice to the user, such as a similar name or a remedy; may be empty."""
    raw_value: object = MISSING
    """Wrong value as read from the file; `MISSING` if it is not to be shown."""


class FindingsError(Exception):
    """Error of a part of a spec that can't be read; holds all findings about that part."""

    def __init__(self, *findings: Finding) -> None:
        super().__init__(*findings)
        self.findings = list(findings)


def single_finding_error(
    location: SpecLocation, problem: str, suggestion: str = "", raw_value: object = MISSING
) -> FindingsError:
    """Return a `FindingsError` that holds one finding; the caller raises it."""
    return FindingsError(Finding(location, problem, suggestion, raw_value))


class Findings(list[Finding]):
    """List of findings; an error in one part of a spec is added, and the next part is read."""

    @contextmanager
    def collect_errors(
        self, location: SpecLocation = (), raw_value: object = MISSING
    ) -> Iterator[None]:
        """Context manager that appends the errors raised in its body to this list, as findings.

        A `QuantityError` becomes a finding at `location` that shows `raw_value`. The findings of a
        `FindingsError` are appended as they are. Other errors propagate.
        """
        try:
            yield
        except FindingsError as error:
            self.extend(error.findings)
        except QuantityError as error:
            self.append(Finding(location, error.rule, error.suggestion, raw_value))

    def raise_if_any(self) -> None:
        """Raise a `FindingsError` with all findings in this list, unless the list is empty."""
        if self:
            raise FindingsError(*self)


def dotted_path(location: SpecLocation) -> str:
    """Return the keys and indices of a location as text, such as ``axes.target.range[2]``."""
    path = ""
    for key in location:
        path += f"[{key}]" if isinstance(key, int) else f".{key}" if path else str(key)
    return path


def format_raw_value(raw_value: object) -> str:
    """Return a value of a spec as one line of at most 60 characters, for messages.

    The result is empty for `MISSING`, mappings and lists.
    """
    if raw_value is MISSING or isinstance(raw_value, dict | list | tuple):
        return ""
    if raw_value is None:
        return "nothing"
    text = repr(raw_value) if isinstance(raw_value, str) else str(raw_value)
    return (
        text
        if len(text) <= _SHOWN_VALUE_CHARACTERS_MAX
        else text[: _SHOWN_VALUE_CHARACTERS_MAX - 3] + "..."
    )


def suggest_similar_name(name: str, known_names: Iterable[str], *, fallback: str = "") -> str:
    """Suggest known names that resemble a wrong name.

    Parameters
    ----------
    name : str
        Wrong name.
    known_names : Iterable of str
        Valid names. One that is similar is suggested, else up to three that contain `name`.
    fallback : str
        Result if no name is similar.

    Returns
    -------
    str
        Suggestion, as a question, or `fallback`.
    """
    names = list(known_names)
    similar_names = [k for k in names if k.lower() == name.lower()] or get_close_matches(
        name, names, n=1
    )
    if not similar_names and len(name) >= _PARTIAL_NAME_CHARACTERS_MIN:
        similar_names = [k for k in names if name.lower() in k.lower()]
    if len(similar_names) > _SUGGESTIONS_MAX:
        return fallback
    return f"did you mean {' or '.join(map(repr, similar_names))}?" if similar_names else fallback


# Rules

RULE_ERROR_TYPE = "broken_rule"
"""Type name of a pydantic error that a broken rule raises; pydantic's own errors have other
names."""

JsonObject = dict[str, Any]
"""JSON object: a dict with text keys."""


def rule_error(problem: str, suggestion: str) -> PydanticCustomError:
    """Return the pydantic error for a broken rule of a field or section; the caller raises it."""
    return PydanticCustomError(
        RULE_ERROR_TYPE, "{rule}", {"rule": problem, "suggestion": suggestion}
    )


@dataclass(frozen=True, kw_only=True)
class Rule:
    """Base of rules. A rule defines which values a field may hold."""

    description: str
    """Description of the field, shown to users."""

    @property
    def example(self) -> str:
        """A valid value as a user would write it; empty if messages need no example."""
        return ""

    @property
    def value_unit(self) -> str:
        """SI unit of the value that `read` returns; empty if the value has no unit."""
        return ""

    def read(self, raw_value: object) -> Any:
        """Convert a quantity as written in a spec to SI units; check and return any other value.

        Raises
        ------
        QuantityError
            The error states the broken rule and a suggestion.
        """
        raise QuantityError("holds nothing that can be read")

    def format(self, value: Any) -> Any:
        """Convert a result of `read` back to a value as a spec would hold it."""
        return value

    def schema(self) -> JsonObject:
        """Return the JSON Schema of a value as written, with the field's description."""
        return {"description": self.description} | self._value_schema()

    def _value_schema(self) -> JsonObject:
        """Return the JSON Schema of a value as written, without the field's description."""
        return {}

    def __get_pydantic_core_schema__(self, _: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self._validate)

    def __get_pydantic_json_schema__(
        self, _: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonObject:
        return self.schema()

    def _validate(self, raw_value: object) -> Any:
        """Return the result of `read`; raise a pydantic error if the value breaks the rule."""
        try:
            return self.read(raw_value)
        except QuantityError as error:
            raise rule_error(error.rule, error.suggestion) from None


@dataclass(frozen=True, kw_only=True)
class CustomRule(Rule):
    """Rule of a single field, given by a function."""

    reader: Callable[[Any], Any]
    """Function that converts a value as written in a spec, or raises a `QuantityError`."""
    value_schema: JsonObject = dataclasses.field(default_factory=dict, compare=False)
    """JSON Schema of a value as written in a spec."""

    def read(self, raw_value: object) -> Any:
        """Convert a value as written in a spec by the function `reader`."""
        return self.reader(raw_value)

    def _value_schema(self) -> JsonObject:
        return self.value_schema


_BOUND_KINDS = {
    "above": ("greater than", np.less_equal, "exclusiveMinimum"),
    "at_least": ("at least", np.less, "minimum"),
    "below": ("less than", np.greater_equal, "exclusiveMaximum"),
    "at_most": ("at most", np.greater, "maximum"),
}
"""Kinds of bounds of a number, by the names of fields of `NumericRule`, such as ``at_least``.

An entry has the words for messages, a NumPy function that is True for values outside the bound, and
the keyword of JSON Schema.
"""


class BoundViolation(NamedTuple):
    """First of several values that is outside the bounds of a rule."""

    value_index: int
    """Index of the value in the array that was checked."""
    broken_bound_text: str
    """The broken bound in words, such as ``must be at least 1 m``."""


@dataclass(frozen=True, kw_only=True)
class NumericRule(Rule):
    """Rule of a number within bounds; bounds are written as users write values."""

    si_unit: str = ""
    """SI unit of the value that `read` returns; empty for a pure number.

    It is ``"dB"`` for a power ratio that is written in decibels and read as a pure number.
    """
    example: str = ""
    """A valid value as a user would write it."""
    above: str | None = None
    """Exclusive lower bound as text with its unit; None if there is none."""
    at_least: str | None = None
    """Inclusive lower bound as text with its unit; None if there is none."""
    below: str | None = None
    """Exclusive upper bound as text with its unit; None if there is none."""
    at_most: str | None = None
    """Inclusive upper bound as text with its unit; None if there is none."""
    is_integer: bool = False
    """True if the number must be an integer."""
    is_power_ratio: bool = False
    """True for a pure number, a ratio of powers, that may also be written in decibels."""
    keyword: str = ""
    """Word that a spec may hold in place of the number, except on an axis; empty if there is
    none."""
    keyword_value: float | str = 0
    """Value that `read` returns for the keyword; may be outside the bounds."""

    @property
    def value_unit(self) -> str:
        """SI unit of the value that `read` returns; empty for a power ratio or a pure number."""
        return "" if self.si_unit == DECIBEL else self.si_unit

    @property
    def bound_texts(self) -> dict[str, str]:
        """Texts of the bounds that are not None, such as ``{"at_least": "1 um"}``."""
        bound_texts = {name: getattr(self, name) for name in _BOUND_KINDS}
        return {
            name: bound_text for name, bound_text in bound_texts.items() if bound_text is not None
        }

    def read_exact_number(self, raw_value: object) -> ExactQuantity:
        """Return the exact number and the unit of a value as written; the bounds are not checked.

        Raises
        ------
        QuantityError
            If the value is no number with a unit of the right dimension, or is the keyword.
        """
        if self.si_unit:
            return read_quantity(raw_value, si_unit=self.si_unit, example=self.example)
        if self.keyword and raw_value == self.keyword:
            problem = "is one value for a whole study, no point of an axis"
            raise QuantityError(problem, "leave it out")
        try:
            description = _first_clause(self.description)
            return read_number(
                raw_value,
                description,
                is_power_ratio=self.is_power_ratio,
                is_valid=self._is_valid,
            )
        except QuantityError as error:
            if not self.keyword:
                raise
            raise QuantityError(f"must be a number or {self.keyword}", error.suggestion) from None

    def read(self, raw_value: object) -> Any:
        """Return the SI value of a number as written, or `keyword_value` for the keyword.

        Raises
        ------
        QuantityError
            The error states the broken rule and a suggestion.
        """
        if self.keyword and raw_value == self.keyword:
            return self.keyword_value
        try:
            return self._read_number(raw_value)
        except QuantityError as error:
            remedy = error.suggestion or f"write e.g. '{self.example}'"
            if self.keyword and not error.suggestion:
                raw_text = raw_value if isinstance(raw_value, str) else ""
                remedy = suggest_similar_name(
                    raw_text, [self.keyword], fallback=f"{remedy} or '{self.keyword}'"
                )
            raise QuantityError(error.rule, remedy) from None

    def _is_valid(self, number: Fraction) -> bool:
        """Return True if a pure number is within the bounds, and an integer if required."""
        if self.is_integer and number.denominator != 1:
            return False
        try:
            return self.first_bound_violation(np.array([Unit("").to_si(number)])) is None
        except QuantityError:  # beyond the range of floats
            return False

    def _read_number(self, raw_value: object) -> float | int:
        """Return the SI value of a number as written; raise `QuantityError` if it breaks the rule.

        The value is an int if the rule requires integers, else a float.
        """
        quantity = self.read_exact_number(raw_value)
        if self.is_integer and quantity.number.denominator != 1:
            raise QuantityError("must be a whole number")
        value = quantity.to_si()
        violation = self.first_bound_violation(np.array([value]))
        if violation is not None:
            raise QuantityError(violation.broken_bound_text)
        return int(quantity.number) if self.is_integer else value

    def first_bound_violation(self, values: np.ndarray) -> BoundViolation | None:
        """Return the first violated bound and the index of the first value that violates it.

        Parameters
        ----------
        values : ndarray, shape (n,)
            SI values.

        Returns
        -------
        BoundViolation or None
            None if all values are within the bounds.
        """
        for name, bound_text in self.bound_texts.items():
            comparison, violates, _ = _BOUND_KINDS[name]
            is_outside = violates(values, _bound_in_si(self, bound_text))
            if is_outside.any():
                return BoundViolation(
                    int(np.argmax(is_outside)), f"must be {comparison} {bound_text}"
                )
        return None

    def format(self, value: Any) -> str | int | float:
        """Convert an SI value back to a number or text, ``0.001 W``, as a spec would hold it.

        `read` converts the result to exactly the same value; for decibels, to 15 equal digits.
        """
        if self.keyword and value == self.keyword_value:
            return self.keyword
        if self.si_unit:
            number = 10.0 * math.log10(value) if self.si_unit == DECIBEL else float(value)
            return f"{repr(number).removesuffix('.0')} {self.si_unit}"
        return int(value) if self.is_integer else float(value)

    def _value_schema(self) -> JsonObject:
        bounds = [
            f"{_BOUND_KINDS[name][0]} {bound_text}" for name, bound_text in self.bound_texts.items()
        ]
        description = "; ".join([self.description, *([", ".join(bounds)] if bounds else [])])
        base_schema: JsonObject = {"description": description, "examples": [self.example]}
        if self.si_unit:
            pattern = r"^\s*[-+−.0-9].*[^\s0-9.]\S*\s*$"
            pattern += rf"|^{self.keyword}$" if self.keyword else ""
            return base_schema | {"type": "string", "pattern": pattern}
        bound_keywords = {
            _BOUND_KINDS[name][2]: _bound_in_si(self, limit_text)
            for name, limit_text in self.bound_texts.items()
        }
        unit_pattern = "(%|dB)?" if self.is_power_ratio else "%?"
        schemas: list[JsonObject] = [
            {"type": "integer" if self.is_integer else "number"} | bound_keywords,
            {"type": "string", "pattern": rf"^\s*[-+.0-9][-+.0-9eE^*_ ]*{unit_pattern}\s*$"},
        ]
        schemas += [{"type": "string", "enum": [self.keyword]}] if self.keyword else []
        return base_schema | {"anyOf": schemas}


def _first_clause(description: str) -> str:
    """Return the first clause of a text, with a small first letter, for the end of a sentence."""
    clause = re.split(r"[;:,.(] ?", description)[0].strip()
    return clause[:1].lower() + clause[1:] if clause[1:2].islower() else clause


@lru_cache(maxsize=1024)
def _bound_in_si(rule: NumericRule, bound_text: str) -> float:
    """Convert a bound of a rule from text, such as ``1 um``, to an SI value."""
    return rule.read_exact_number(bound_text).to_si()


_FUNCTION_PATTERN = r"[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*:[A-Za-z_][A-Za-z0-9_]*"
"""Regular expression for the name of a function as ``module:function``."""


@dataclass(frozen=True, kw_only=True)
class ChoiceRule(Rule):
    """Rule of one of several words.

    If ``on`` is one of them, YAML's truth values are accepted too.
    """

    options: tuple[str, ...]
    """Valid words."""
    problem: str = ""
    """Words of the error message for a word that is no option; if empty, the message lists the
    options."""
    remedy: str = ""
    """Advice to the user for a wrong word that resembles none of the options."""

    def read(self, raw_value: object) -> str:
        """Return the word that was written; for a truth value, ``on`` or ``off``.

        Raise `QuantityError` if the word is none of the options.
        """
        if isinstance(raw_value, bool) and "on" in self.options:
            return "on" if raw_value else "off"
        if raw_value in self.options and isinstance(raw_value, str):
            return raw_value
        problem = self.problem or f"must be one of {', '.join(self.options)}"
        normalised = str(raw_value).strip().lower()
        candidates = (
            ("off", "none")
            if normalised in _OFF_WORDS
            else ("on",)
            if normalised in _ON_WORDS
            else ()
        )
        if option := next((option for option in candidates if option in self.options), ""):
            raise QuantityError(problem, f"write '{option}'")
        raise QuantityError(
            problem, suggest_similar_name(str(raw_value), self.options, fallback=self.remedy)
        )

    def _value_schema(self) -> JsonObject:
        if "on" in self.options:
            return {"enum": [*self.options, True, False]}
        return {"type": "string", "enum": list(self.options)}


class ChoiceOrFunctionRule(ChoiceRule):
    """Rule of one of several words, or of a function's name ``module:function``.

    The function is not imported.
    """

    def read(self, raw_value: object) -> str:
        """Return the word, or the function's name ``module:function``, as written.

        Raise `QuantityError` for any other value.
        """
        if isinstance(raw_value, str) and re.fullmatch(_FUNCTION_PATTERN, raw_value):
            return raw_value
        try:
            return super().read(raw_value)
        except QuantityError as error:
            problem = f"{error.rule}, or a function as module:function"
            raise QuantityError(problem, error.suggestion) from None

    def _value_schema(self) -> JsonObject:
        return {
            "anyOf": [
                super()._value_schema(),
                {"type": "string", "pattern": f"^{_FUNCTION_PATTERN}$"},
            ]
        }


class FlagRule(Rule):
    """Rule of a truth value."""

    def read(self, raw_value: object) -> bool:
        """Return the truth value as written; raise `QuantityError` for any other value."""
        if not isinstance(raw_value, bool):
            raise QuantityError("must be true or false", "write 'true' or 'false'")
        return raw_value

    def _value_schema(self) -> JsonObject:
        return {"type": "boolean"}


@dataclass(frozen=True, kw_only=True)
class TextRule(Rule):
    """Rule of a text that matches a pattern."""

    example: str = ""
    """A valid text."""
    pattern: str = r"[^\x00-\x08\x0b-\x1f\x7f-\x9f]{0,5000}"
    """Regular expression that the full text must match."""
    remedy: str = "write at most 5000 characters that can be printed"
    """Advice to the user for a text that does not match the pattern."""

    def read(self, raw_value: object) -> str:
        """Return the text; raise `QuantityError` if it does not match the pattern.

        A number is converted to text.
        """
        if isinstance(raw_value, bool) or not isinstance(raw_value, str | int | float):
            remedy = (
                self.remedy
                if self.pattern != TextRule.pattern
                else "write it as one text, in quotes if need be"
            )
            raise QuantityError("must be text", remedy)
        if re.fullmatch(self.pattern, str(raw_value)) is None:
            raise QuantityError("is no valid text for this field", self.remedy)
        return str(raw_value)

    def _value_schema(self) -> JsonObject:
        return {"type": "string", "pattern": f"^{self.pattern}$"}


@dataclass(frozen=True, kw_only=True)
class FilePathRule(Rule):
    """Rule of a file's path, relative to the file that names it."""

    compute_digest: Callable[[Path], str] = file_digest
    """Function that returns a digest of the content of the file and of the files that belong to
    it."""

    def read(self, raw_value: object) -> str:
        """Return the path as written; raise `QuantityError` if it can't be the path of a file.

        Whether the file exists is not checked.
        """
        if not isinstance(raw_value, str) or not 0 < len(raw_value.strip()) <= 4096:
            raise QuantityError("must be the path of a file", "write it relative to this file")
        if "\0" in raw_value:
            raise QuantityError("holds a character that no path has")
        return raw_value

    def _value_schema(self) -> JsonObject:
        return {"type": "string", "minLength": 1}


@dataclass(frozen=True, kw_only=True)
class ListRule(Rule):
    """Rule of a list of values that have a common rule."""

    element_rule: Rule
    """Rule that each value of the list obeys."""
    length_min: int = 3
    """Minimum number of values."""
    length_max: int = 3
    """Maximum number of values."""
    element_noun: str = "values"
    """Noun for the values of the list in error messages."""
    is_increasing: bool = False
    """True if each value must be larger than the preceding one."""
    is_distinct: bool = False
    """True if no value may occur twice."""

    @property
    def value_unit(self) -> str:
        """SI unit of the values that `read` returns; empty if the values have no unit."""
        return self.element_rule.value_unit

    @property
    def example(self) -> str:
        """A valid list as a user would write it, made of the element rule's example."""
        return f"[{', '.join([self.element_rule.example] * max(self.length_min, 1))}]"

    def read(self, raw_value: object) -> tuple[Any, ...]:
        """Return the values of a list as written, as a tuple of SI values.

        Raise `QuantityError` if the list or one of its values breaks the rule.
        """
        remedy = f"write e.g. {self.example}"
        if (
            not isinstance(raw_value, list | tuple)
            or not self.length_min <= len(raw_value) <= self.length_max
        ):
            length_text = f"{self.length_min} " if self.length_min == self.length_max else ""
            length_text = length_text or (
                f"at least {self.length_min} " if self.element_noun == "values" else ""
            )
            raise QuantityError(f"must be a list of {length_text}{self.element_noun}", remedy)
        values = tuple(
            read_list_element(self.element_rule, i, value) for i, value in enumerate(raw_value)
        )
        if self.is_increasing and any(b <= a for a, b in pairwise(values)):
            raise QuantityError("must begin below its end", "put the lower value first")
        if self.is_distinct and len(set(values)) < len(values):
            raise QuantityError("holds a name more than once", "list it once")
        return values

    def format(self, value: Any) -> Any:
        """Convert a result of `read` back to a list as a spec would hold it."""
        return [self.element_rule.format(element) for element in value]

    def _value_schema(self) -> JsonObject:
        length_keywords = {"minItems": self.length_min, "maxItems": self.length_max}
        distinct_keyword = {"uniqueItems": True} if self.is_distinct else {}
        return (
            {"type": "array", "items": self.element_rule.schema()}
            | length_keywords
            | distinct_keyword
        )


def read_list_element(rule: Rule, index: int, raw_value: object) -> Any:
    """Return the value that a rule reads from one element of a list.

    The `QuantityError` of an invalid element names `index`, the element's index in the list.
    """
    try:
        return rule.read(raw_value)
    except QuantityError as error:
        shown_value = (
            raw_value if isinstance(raw_value, str | int | float) else type(raw_value).__name__
        )
        problem = f"holds {shown_value!r:.60} as value {index}, which {error.rule}"
        raise QuantityError(problem, error.suggestion or f"write e.g. {rule.example}") from None


_CHIRP_TIME_RULE = NumericRule(
    description="Time in the up-chirp",
    si_unit="s",
    example="10 us",
    at_least="-1e6 s",
    at_most="1e6 s",
)
"""Rule of a time in the up-chirp [s]: one column of a table of the sweep's frequency error."""
_FREQUENCY_ERROR_RULE = NumericRule(
    description="Frequency error",
    si_unit="Hz",
    example="2 kHz",
    at_least="-1e15 Hz",
    at_most="1e15 Hz",
)
"""Rule of a frequency error [Hz]: one column of a table of the sweep's frequency error."""
FREQUENCY_ERROR_TABLE_ROWS_MAX = 4096
"""Largest number of rows in a table of the sweep's frequency error over time."""


class FrequencyErrorTableRule(Rule):
    """Rule of a table of the sweep's frequency error over time, which is held as text."""

    def read(self, raw_value: object) -> str:
        """Return the table as text: rows ``time error`` [s, Hz] separated by commas, or `NO_TABLE`.

        Raise `QuantityError` if the table is invalid or not smooth.
        """
        if raw_value == NO_TABLE:
            return NO_TABLE
        remedy = "write e.g. [[0 us, 0 Hz], [10 us, 2 kHz], [20 us, 1 kHz]], or a CSV file's path"
        if (
            not isinstance(raw_value, list | tuple)
            or not 3 <= len(raw_value) <= FREQUENCY_ERROR_TABLE_ROWS_MAX
        ):
            raise QuantityError(
                f"must be a list of 3 to {FREQUENCY_ERROR_TABLE_ROWS_MAX} rows, "
                "a time and an error",
                remedy,
            )
        rows = []
        for i, row in enumerate(raw_value):
            if not isinstance(row, list | tuple) or len(row) != 2:
                raise QuantityError(f"has a row {i} that is no time with its error", remedy)
            rules = zip((_CHIRP_TIME_RULE, _FREQUENCY_ERROR_RULE), row, strict=True)
            rows.append([read_list_element(rule, i, value) for rule, value in rules])
        if any(b[0] <= a[0] for a, b in pairwise(rows)):
            raise QuantityError("has times that do not rise", "sort the rows by time")
        table_text = ", ".join(f"{time!r} {error!r}" for time, error in rows)
        try:
            fit_sweep_frequency_error(table_text)
        except ValueError as error:
            raise QuantityError(str(error), "smooth it, or give more rows") from None
        return table_text

    def format(self, value: Any) -> Any:
        """Convert a table, text from `read`, back to a list of rows [time, error] with units.

        `NO_TABLE` is returned unchanged.
        """
        if value == NO_TABLE:
            return value
        rules = (_CHIRP_TIME_RULE, _FREQUENCY_ERROR_RULE)
        return [
            [rule.format(float(number)) for rule, number in zip(rules, row.split(), strict=True)]
            for row in value.split(",")
        ]

    def _value_schema(self) -> JsonObject:
        row_schema = {"minItems": 2, "maxItems": 2, "items": {"type": "string"}}
        rows_schema = {"type": "array", "minItems": 3, "items": {"type": "array"} | row_schema}
        return {"anyOf": [rows_schema, {"type": "string"}]}


COSINE_SUM_WINDOWS = tuple(COSINE_SUM_COEFFICIENTS)
"""Names of the windows that are sums of cosines; these are computed without scipy."""
SCIPY_WINDOWS = (
    "barthann", "bartlett", "bohman", "chebwin", "cosine", "dpss", "exponential", "gaussian",
    "general_gaussian", "general_hamming", "kaiser", "lanczos", "parzen", "taylor", "triang",
    "tukey",
)  # fmt: skip
"""Names of scipy's window functions that error messages suggest."""
_WINDOW_NAME_PATTERN = re.compile(
    r"(?P<name>[a-z_]{1,40})\s*(?:\((?P<parameters>[-+.,eE\d\s]*)\))?"
)
"""Regular expression for a window as written: a name, with or without parameters in parentheses."""
_KAISER_REMEDY = "write e.g. 'kaiser(8.6)'"


class WindowFunctionRule(Rule):
    """Rule of a window function with its parameters, such as ``hamming`` or ``kaiser(8.6)``."""

    def read(self, raw_value: object) -> str:
        """Return the window's canonical name, with any parameters in parentheses: ``kaiser(8.6)``.

        Raise `QuantityError` if the window or its parameters are invalid.
        """
        match = (
            _WINDOW_NAME_PATTERN.fullmatch(raw_value.strip().lower())
            if isinstance(raw_value, str)
            else None
        )
        if match is None:
            remedy = "write e.g. 'hamming' or 'kaiser(8.6)'"
            raise QuantityError("must be the name of a window", remedy)
        name = WINDOW_NAME_ALIASES.get(match["name"], match["name"])
        parameters_text = match["parameters"]
        if name in COSINE_SUM_WINDOWS and parameters_text is None:
            return name
        try:
            parameters = (
                [float(text) for text in parameters_text.split(",")] if parameters_text else []
            )
        except ValueError:
            raise QuantityError("has parameters that are no numbers", _KAISER_REMEDY) from None
        _check_scipy_window(name, tuple(parameters))
        return f"{name}({','.join(map(repr, parameters))})" if parameters else name

    def _value_schema(self) -> JsonObject:
        return {
            "type": "string",
            "pattern": r"^\s*[A-Za-z_]+\s*(\([-+.,eE0-9\s]*\))?\s*$",
            "examples": ["hamming", "hann", "rectangular", "kaiser(8.6)"],
        }


@lru_cache(maxsize=256)
def _check_scipy_window(name: str, parameters: tuple[float, ...]) -> None:
    """Compute a window with scipy; raise `QuantityError` if its name or parameters are invalid."""
    from scipy.signal import get_window  # slow to import and rarely needed

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            samples = get_window((name, *parameters) if parameters else name, 16)
    except UserWarning:
        problem = "has parameters that make it unsuitable for spectral analysis"
        raise QuantityError(problem, "take others, for chebwin 45 or more") from None
    except RuntimeWarning:  # samples beyond the range of floats
        raise QuantityError("has parameters that make no usable window") from None
    except (ValueError, TypeError, ArithmeticError, MemoryError):
        if name in COSINE_SUM_WINDOWS + SCIPY_WINDOWS:
            problem = "has parameters that this window does not take"
            raise QuantityError(problem, _KAISER_REMEDY) from None
        remedy = suggest_similar_name(
            name, COSINE_SUM_WINDOWS + SCIPY_WINDOWS, fallback="write e.g. 'hamming'"
        )
        raise QuantityError("is no periodic window that scipy.signal makes", remedy) from None
    if not np.all(np.isfinite(samples)) or not np.sum(samples) > 0:
        raise QuantityError("has parameters that make no usable window")
