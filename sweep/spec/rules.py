"""Rules of single fields of a spec, and mistakes: what is wrong, where, and what to write instead.

A rule sits in a field's metadata. Pydantic reads the field with it, an axis over the field holds
every one of its values to it, and the JSON Schema describes it.
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
from typing import Any

import numpy as np
from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from sweep.messages import printable
from sweep.model.effects.phase_errors import NO_TABLE
from sweep.model.effects.sweep_table import sweep_table
from sweep.model.window import ALIASES, COSINE_SUMS
from sweep.scenes.files import file_digest
from sweep.units import DECIBEL, QuantityError, Unit, read_number, read_quantity

# Mistakes of users

Location = tuple[str | int, ...]

ABSENT = object()
"""Stands for a value where none is written."""
_LONGEST_VALUE = 60
_SHORTEST_PART, _MOST_SUGGESTED = 4, 3
"""Characters of a part of a name that suggests the whole, and whole names that are suggested."""
_NO = {"no", "n", "false", "none", "never", "null", "disable", "disabled", "0", "off"}
_YES = {"yes", "y", "true", "always", "enable", "enabled", "1", "on"}
"""Words for off and on."""


@dataclass(frozen=True, order=True)
class Mistake:
    """One mistake in a spec; texts are empty where there is nothing to tell."""

    path: str
    """Dotted path in the file, such as ``instrument.laser.power`` or ``axes.target.range[2]``."""
    rule: str
    """The rule broken, as the end of a sentence about the path."""
    value: str = ""
    """The value as the user wrote it."""
    suggestion: str = ""
    """A near miss or a remedy."""
    line: int | None = None
    """Line in the file, from 1."""
    file: str = ""

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}: " if self.line else f"{self.file}: " if self.file else ""
        said = f"{self.path}: {self.rule}" if self.path else self.rule
        wrote = f" (you wrote {self.value})" if self.value else ""
        return printable(place + said + wrote + (f"; {self.suggestion}" if self.suggestion else ""))


class SpecError(Exception):
    """Everything that is wrong with a spec, at once, in the order in which to show it."""

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
    """A mistake whose place in the file is still to be looked up."""

    location: Location
    """Keys and list indices that lead to it."""
    rule: str
    suggestion: str = ""
    written: object = ABSENT
    """The value as read from the file, if it is to be shown."""


class Rejected(Exception):
    """A part of a spec that cannot be read, with everything that is wrong with it."""

    def __init__(self, *findings: Finding) -> None:
        super().__init__(*findings)
        self.findings = list(findings)


def rejected(
    location: Location, rule: str, suggestion: str = "", written: object = ABSENT
) -> Rejected:
    """Refusal for a single reason, to be raised."""
    return Rejected(Finding(location, rule, suggestion, written))


class Findings(list[Finding]):
    """Findings of several parts, which are read one after the other whatever is wrong with one."""

    @contextmanager
    def of(self, location: Location = (), written: object = ABSENT) -> Iterator[None]:
        """Context that keeps what is wrong with a part, or with the value at a location."""
        try:
            yield
        except Rejected as error:
            self.extend(error.findings)
        except QuantityError as error:
            self.append(Finding(location, error.rule, error.suggestion, written))

    def refuse_any(self) -> None:
        """Raise all findings, if there are any."""
        if self:
            raise Rejected(*self)


def dotted(location: Location) -> str:
    """Path of keys and indices as text: ``axes.target.range[2]``."""
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def shown(written: object) -> str:
    """Format a written value on one short line; empty for ``ABSENT`` and for whole sections."""
    if written is ABSENT or isinstance(written, dict | list | tuple):
        return ""
    if written is None:
        return "nothing"
    text = repr(written) if isinstance(written, str) else str(written)
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "..."


def near_miss(name: str, known: Iterable[str], *, otherwise: str = "") -> str:
    """Suggestion of the known name that `name` resembles, or those that hold it, else a remedy."""
    names = list(known)
    close = [k for k in names if k.lower() == name.lower()] or get_close_matches(name, names, n=1)
    if not close and len(name) >= _SHORTEST_PART:
        close = [k for k in names if name.lower() in k.lower()]
    if len(close) > _MOST_SUGGESTED:
        return otherwise
    return f"did you mean {' or '.join(map(repr, close))}?" if close else otherwise


# Rules

BROKEN_RULE = "broken_rule"

Json = dict[str, Any]


def broken(rule: str, suggestion: str) -> PydanticCustomError:
    """Mistake in a value, or in a section as a whole, told in pydantic's way."""
    return PydanticCustomError(BROKEN_RULE, "{rule}", {"rule": rule, "suggestion": suggestion})


@dataclass(frozen=True, kw_only=True)
class Rule:
    """Rule of what a field may hold."""

    about: str
    """Description of the field, for people."""

    @property
    def example(self) -> str:
        """A good value; empty where none need be shown."""
        return ""

    @property
    def units(self) -> str:
        """SI unit of the value read; empty where there is none."""
        return ""

    def read(self, written: object) -> Any:
        """Value of what the user wrote.

        Raises
        ------
        QuantityError
            With the rule broken and a suggestion.
        """
        raise QuantityError("holds nothing that can be read")

    def written(self, value: Any) -> Any:
        """Text or number that reads back as exactly `value`."""
        return value

    def schema(self) -> Json:
        """JSON Schema of what a user may write."""
        return {"description": self.about} | self._json()

    def _json(self) -> Json:
        return {}

    def __get_pydantic_core_schema__(self, _: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self._validated)

    def __get_pydantic_json_schema__(self, _: CoreSchema, handler: GetJsonSchemaHandler) -> Json:
        return self.schema()

    def _validated(self, written: object) -> Any:
        """Value read, with a mistake told in pydantic's way."""
        try:
            return self.read(written)
        except QuantityError as error:
            raise broken(error.rule, error.suggestion) from None


@dataclass(frozen=True, kw_only=True)
class Special(Rule):
    """Rule of one kind of field alone."""

    reader: Callable[[Any], Any]
    """Reads what the user wrote, or raises a `QuantityError`."""
    json: Json = dataclasses.field(default_factory=dict, compare=False)
    """JSON Schema of it."""

    def read(self, written: object) -> Any:
        """Value of what the user wrote."""
        return self.reader(written)

    def _json(self) -> Json:
        return self.json


_BOUNDS = {
    "above": ("greater than", np.less_equal, "exclusiveMinimum"),
    "at_least": ("at least", np.less, "minimum"),
    "below": ("less than", np.greater_equal, "exclusiveMaximum"),
    "at_most": ("at most", np.greater, "maximum"),
}
"""Bounds of numbers: in words, what breaks them, and in JSON Schema's words."""


@dataclass(frozen=True, kw_only=True)
class Numeric(Rule):
    """A number within bounds, which are as a user would write them."""

    si_unit: str = ""
    """Unit of the value inside; ``"dB"`` for a power ratio that is written in decibels; empty for
    a pure number."""
    example: str = ""
    above: str | None = None
    at_least: str | None = None
    below: str | None = None
    at_most: str | None = None
    whole: bool = False
    is_power_ratio: bool = False
    """True for a pure number that may be written in decibels, as a ratio of powers."""
    word: str = ""
    """A word that may stand in place of a number, not along axes; empty for none."""
    means: float | str = 0
    """Value that the word stands for, whatever the bounds."""

    @property
    def units(self) -> str:
        """SI unit of the value read; a power ratio has none."""
        return "" if self.si_unit == DECIBEL else self.si_unit

    @property
    def bounds(self) -> dict[str, str]:
        """Bounds that there are, as written."""
        written = {name: getattr(self, name) for name in _BOUNDS}
        return {name: bound for name, bound in written.items() if bound is not None}

    def exact(self, written: object) -> tuple[Fraction, Unit]:
        """Exact number and unit of what the user wrote, bounds apart."""
        if self.si_unit:
            return read_quantity(written, si_unit=self.si_unit, example=self.example)
        if self.word and written == self.word:
            rule = "is one value for a whole study, no point of an axis"
            raise QuantityError(rule, "leave it out")
        try:
            about = _first_clause(self.about)
            return read_number(
                written, about, is_power_ratio=self.is_power_ratio, is_valid=self._is_valid
            )
        except QuantityError as error:
            if not self.word:
                raise
            raise QuantityError(f"must be a number or {self.word}", error.suggestion) from None

    def read(self, written: object) -> Any:
        """SI value of what the user wrote, within the bounds; or what its word means."""
        if self.word and written == self.word:
            return self.means
        try:
            return self._number(written)
        except QuantityError as error:
            remedy = error.suggestion or f"write e.g. '{self.example}'"
            if self.word and not error.suggestion:
                text = written if isinstance(written, str) else ""
                remedy = near_miss(text, [self.word], otherwise=f"{remedy} or '{self.word}'")
            raise QuantityError(error.rule, remedy) from None

    def _is_valid(self, number: Fraction) -> bool:
        """Tell whether a pure number fits the field."""
        if self.whole and number.denominator != 1:
            return False
        try:
            return self.first_outside(np.array([Unit("").to_si(number)])) is None
        except QuantityError:  # more than a float holds
            return False

    def _number(self, written: object) -> float | int:
        number, unit = self.exact(written)
        if self.whole and number.denominator != 1:
            raise QuantityError("must be a whole number")
        value = unit.to_si(number)
        broken = self.first_outside(np.array([value]))
        if broken is not None:
            raise QuantityError(broken[1])
        return int(number) if self.whole else value

    def first_outside(self, values: np.ndarray) -> tuple[int, str] | None:
        """Index of the first of the SI values (n,) that breaks a bound, and that bound in words."""
        for name, written in self.bounds.items():
            words, is_outside, _ = _BOUNDS[name]
            outside = is_outside(values, _bound(self, written))
            if outside.any():
                return int(np.argmax(outside)), f"must be {words} {written}"
        return None

    def written(self, value: Any) -> str | int | float:
        """Text that reads back as exactly `value`: ``0.001 W``; of decibels, to 15 digits."""
        if self.word and value == self.means:
            return self.word
        if self.si_unit:
            number = 10.0 * math.log10(value) if self.si_unit == DECIBEL else float(value)
            return f"{repr(number).removesuffix('.0')} {self.si_unit}"
        return int(value) if self.whole else float(value)

    def _json(self) -> Json:
        bounds = [f"{_BOUNDS[name][0]} {written}" for name, written in self.bounds.items()]
        about = "; ".join([self.about, *([", ".join(bounds)] if bounds else [])])
        common: Json = {"description": about, "examples": [self.example]}
        if self.si_unit:
            pattern = r"^\s*[-+−.0-9].*[^\s0-9.]\S*\s*$"
            pattern += rf"|^{self.word}$" if self.word else ""
            return common | {"type": "string", "pattern": pattern}
        numbers = {_BOUNDS[name][2]: _bound(self, text) for name, text in self.bounds.items()}
        units = "(%|dB)?" if self.is_power_ratio else "%?"
        kinds: list[Json] = [
            {"type": "integer" if self.whole else "number"} | numbers,
            {"type": "string", "pattern": rf"^\s*[-+.0-9][-+.0-9eE^*_ ]*{units}\s*$"},
        ]
        kinds += [{"type": "string", "enum": [self.word]}] if self.word else []
        return common | {"anyOf": kinds}


def _first_clause(about: str) -> str:
    """First clause of a description, as the end of a sentence."""
    clause = re.split(r"[;:,.(] ?", about)[0].strip()
    return clause[:1].lower() + clause[1:] if clause[1:2].islower() else clause


@lru_cache(maxsize=1024)
def _bound(rule: Numeric, written: str) -> float:
    """SI value of a rule's bound."""
    number, unit = rule.exact(written)
    return unit.to_si(number)


_FUNCTION = r"[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*:[A-Za-z_][A-Za-z0-9_]*"


@dataclass(frozen=True, kw_only=True)
class Choice(Rule):
    """One of several words; of on and off, which YAML makes truth values of, these too."""

    options: tuple[str, ...]
    rule: str = ""
    """Message for other words; by default that they are none of the options."""
    remedy: str = ""

    def read(self, written: object) -> str:
        """Return the word written."""
        if isinstance(written, bool) and "on" in self.options:
            return "on" if written else "off"
        if written in self.options and isinstance(written, str):
            return written
        rule = self.rule or f"must be one of {', '.join(self.options)}"
        said = str(written).strip().lower()
        meant = ("off", "none") if said in _NO else ("on",) if said in _YES else ()
        if option := next((option for option in meant if option in self.options), ""):
            raise QuantityError(rule, f"write '{option}'")
        raise QuantityError(rule, near_miss(str(written), self.options, otherwise=self.remedy))

    def _json(self) -> Json:
        if "on" in self.options:
            return {"enum": [*self.options, True, False]}
        return {"type": "string", "enum": list(self.options)}


class Method(Choice):
    """One of several words, or ``module:function``, which reading does not import."""

    def read(self, written: object) -> str:
        """Return the word or the function's name."""
        if isinstance(written, str) and re.fullmatch(_FUNCTION, written):
            return written
        try:
            return super().read(written)
        except QuantityError as error:
            rule = f"{error.rule}, or a function as module:function"
            raise QuantityError(rule, error.suggestion) from None

    def _json(self) -> Json:
        return {"anyOf": [super()._json(), {"type": "string", "pattern": f"^{_FUNCTION}$"}]}


class Flag(Rule):
    """True or false."""

    def read(self, written: object) -> bool:
        """Return true or false."""
        if not isinstance(written, bool):
            raise QuantityError("must be true or false", "write 'true' or 'false'")
        return written

    def _json(self) -> Json:
        return {"type": "boolean"}


@dataclass(frozen=True, kw_only=True)
class Text(Rule):
    """Words for people, or the name of something."""

    example: str = ""
    pattern: str = r"[^\x00-\x08\x0b-\x1f\x7f-\x9f]{0,5000}"
    """Regular expression that the whole text matches."""
    remedy: str = "write at most 5000 characters that can be printed"

    def read(self, written: object) -> str:
        """Return the text."""
        if isinstance(written, bool) or not isinstance(written, str | int | float):
            remedy = (
                self.remedy
                if self.pattern != Text.pattern
                else "write it as one text, in quotes if need be"
            )
            raise QuantityError("must be text", remedy)
        if re.fullmatch(self.pattern, str(written)) is None:
            raise QuantityError("is no text that can stand here", self.remedy)
        return str(written)

    def _json(self) -> Json:
        return {"type": "string", "pattern": f"^{self.pattern}$"}


@dataclass(frozen=True, kw_only=True)
class File(Rule):
    """Path of a file, relative to the one that names it."""

    digest: Callable[[Path], str] = file_digest
    """Digest of what is read from the file."""

    def read(self, written: object) -> str:
        """Return the path, as written."""
        if not isinstance(written, str) or not 0 < len(written.strip()) <= 4096:
            raise QuantityError("must be the path of a file", "write it relative to this file")
        if "\0" in written:
            raise QuantityError("holds a character that no path has")
        return written

    def _json(self) -> Json:
        return {"type": "string", "minLength": 1}


@dataclass(frozen=True, kw_only=True)
class Several(Rule):
    """A list of values, each held to the same rule."""

    of: Rule
    least: int = 3
    most: int = 3
    noun: str = "values"
    """Name of all values together."""
    rising: bool = False
    """Each must exceed the one before."""
    distinct: bool = False
    """None may be there twice."""

    @property
    def units(self) -> str:
        """SI unit of the values read; empty where there is none."""
        return self.of.units

    @property
    def example(self) -> str:
        """A good list."""
        return f"[{', '.join([self.of.example] * max(self.least, 1))}]"

    def read(self, written: object) -> tuple[Any, ...]:
        """SI values of what the user wrote."""
        remedy = f"write e.g. {self.example}"
        if not isinstance(written, list | tuple) or not self.least <= len(written) <= self.most:
            number = f"{self.least} " if self.least == self.most else ""
            number = number or (f"at least {self.least} " if self.noun == "values" else "")
            raise QuantityError(f"must be a list of {number}{self.noun}", remedy)
        values = tuple(read_element(self.of, i, value) for i, value in enumerate(written))
        if self.rising and any(b <= a for a, b in pairwise(values)):
            raise QuantityError("must begin below its end", "put the lower value first")
        if self.distinct and len(set(values)) < len(values):
            raise QuantityError("holds a name more than once", "list it once")
        return values

    def written(self, value: Any) -> Any:
        """List that reads back as exactly `value`."""
        return [self.of.written(element) for element in value]

    def _json(self) -> Json:
        number = {"minItems": self.least, "maxItems": self.most}
        distinct = {"uniqueItems": True} if self.distinct else {}
        return {"type": "array", "items": self.of.schema()} | number | distinct


def read_element(rule: Rule, index: int, written: object) -> Any:
    """One value of a list, or what is wrong with it."""
    try:
        return rule.read(written)
    except QuantityError as error:
        value = written if isinstance(written, str | int | float) else type(written).__name__
        told = f"holds {value!r:.60} as value {index}, which {error.rule}"
        raise QuantityError(told, error.suggestion or f"write e.g. {rule.example}") from None


_TIME = Numeric(
    about="Time in the up-chirp", si_unit="s", example="10 us", at_least="-1e6 s", at_most="1e6 s"
)
_FREQUENCY_ERROR = Numeric(
    about="Frequency error", si_unit="Hz", example="2 kHz", at_least="-1e15 Hz", at_most="1e15 Hz"
)
MOST_ROWS = 4096


class SweepError(Rule):
    """A table of the sweep's frequency error over time; text inside, a row after the other."""

    def read(self, written: object) -> str:
        """Rows ``time error`` in SI, separated by commas; or none."""
        if written == NO_TABLE:
            return NO_TABLE
        remedy = "write e.g. [[0 us, 0 Hz], [10 us, 2 kHz], [20 us, 1 kHz]], or a CSV file's path"
        if not isinstance(written, list | tuple) or not 3 <= len(written) <= MOST_ROWS:
            raise QuantityError(
                f"must be a list of 3 to {MOST_ROWS} rows, a time and an error", remedy
            )
        rows = []
        for i, row in enumerate(written):
            if not isinstance(row, list | tuple) or len(row) != 2:
                raise QuantityError(f"has a row {i} that is no time with its error", remedy)
            rules = zip((_TIME, _FREQUENCY_ERROR), row, strict=True)
            rows.append([read_element(rule, i, value) for rule, value in rules])
        if any(b[0] <= a[0] for a, b in pairwise(rows)):
            raise QuantityError("has times that do not rise", "sort the rows by time")
        text = ", ".join(f"{time!r} {error!r}" for time, error in rows)
        try:
            sweep_table(text)
        except ValueError as error:
            raise QuantityError(str(error), "smooth it, or give more rows") from None
        return text

    def written(self, value: Any) -> Any:
        """Rows that read back as exactly `value`."""
        if value == NO_TABLE:
            return value
        rules = (_TIME, _FREQUENCY_ERROR)
        return [
            [rule.written(float(number)) for rule, number in zip(rules, row.split(), strict=True)]
            for row in value.split(",")
        ]

    def _json(self) -> Json:
        pair = {"minItems": 2, "maxItems": 2, "items": {"type": "string"}}
        rows = {"type": "array", "minItems": 3, "items": {"type": "array"} | pair}
        return {"anyOf": [rows, {"type": "string"}]}


WINDOWS = tuple(COSINE_SUMS)
"""Windows that need no look at scipy, which is slow to import; all others are put to it."""
SCIPY_WINDOWS = (
    "barthann", "bartlett", "bohman", "chebwin", "cosine", "dpss", "exponential", "gaussian",
    "general_gaussian", "general_hamming", "kaiser", "lanczos", "parzen", "taylor", "triang",
    "tukey",
)  # fmt: skip
_WINDOW = re.compile(r"(?P<name>[a-z_]{1,40})\s*(?:\((?P<parameters>[-+.,eE\d\s]*)\))?")
_KAISER = "write e.g. 'kaiser(8.6)'"


class Window(Rule):
    """Name of a window function, with its parameters: ``hamming``, ``kaiser(8.6)``."""

    def read(self, written: object) -> str:
        """Window in one spelling."""
        match = _WINDOW.fullmatch(written.strip().lower()) if isinstance(written, str) else None
        if match is None:
            remedy = "write e.g. 'hamming' or 'kaiser(8.6)'"
            raise QuantityError("must be the name of a window", remedy)
        name = ALIASES.get(match["name"], match["name"])
        inside = match["parameters"]
        if name in WINDOWS and inside is None:
            return name
        try:
            parameters = [float(text) for text in inside.split(",")] if inside else []
        except ValueError:
            raise QuantityError("has parameters that are no numbers", _KAISER) from None
        _try_window(name, tuple(parameters))
        return f"{name}({','.join(map(repr, parameters))})" if parameters else name

    def _json(self) -> Json:
        return {
            "type": "string",
            "pattern": r"^\s*[A-Za-z_]+\s*(\([-+.,eE0-9\s]*\))?\s*$",
            "examples": ["hamming", "hann", "rectangular", "kaiser(8.6)"],
        }


@lru_cache(maxsize=256)
def _try_window(name: str, parameters: tuple[float, ...]) -> None:
    """Make the window with scipy; a QuantityError where it knows none or refuses parameters."""
    from scipy.signal import get_window  # slow to import, and seldom needed

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            values = get_window((name, *parameters) if parameters else name, 16)
    except UserWarning:
        rule = "has parameters that make it unsuitable for spectral analysis"
        raise QuantityError(rule, "take others, for chebwin 45 or more") from None
    except RuntimeWarning:  # samples beyond what a number can be
        raise QuantityError("has parameters that make no usable window") from None
    except (ValueError, TypeError, ArithmeticError, MemoryError):
        if name in WINDOWS + SCIPY_WINDOWS:
            rule = "has parameters that this window does not take"
            raise QuantityError(rule, _KAISER) from None
        remedy = near_miss(name, WINDOWS + SCIPY_WINDOWS, otherwise="write e.g. 'hamming'")
        raise QuantityError("is no periodic window that scipy.signal makes", remedy) from None
    if not np.all(np.isfinite(values)) or not np.sum(values) > 0:
        raise QuantityError("has parameters that make no usable window")
