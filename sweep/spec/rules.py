"""What a single field of a spec may hold: reads what the user wrote and says what is wrong.

A rule sits in a field's annotation. Pydantic reads the field with it, an axis over the field
holds every one of its values to it, and the JSON Schema describes it.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Any

import numpy as np
from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from sweep.spec.mistakes import near_miss
from sweep.units import DECIBEL, QuantityError, Unit, read_number, read_quantity

BROKEN_RULE = "broken_rule"


@dataclass(frozen=True, kw_only=True)
class Rule:
    """What a field may hold.

    Parameters
    ----------
    about : str
        What the field is, for people.
    """

    about: str

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
        """What a user writes to have exactly `value`."""
        return str(value)

    def schema(self) -> dict[str, Any]:
        """JSON Schema of what a user may write."""
        return {"description": self.about}

    def __get_pydantic_core_schema__(self, _: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self._validated)

    def __get_pydantic_json_schema__(
        self, _: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return self.schema()

    def _validated(self, written: object) -> Any:
        """Value read, with a mistake told in pydantic's way."""
        try:
            return self.read(written)
        except QuantityError as error:
            context = {"rule": error.rule, "suggestion": error.suggestion}
            raise PydanticCustomError(BROKEN_RULE, "{rule}", context) from None


@dataclass(frozen=True, kw_only=True)
class Numeric(Rule):
    """A number within bounds, with a unit where `si_unit` names one.

    Parameters
    ----------
    si_unit : str
        Unit of the value inside; ``"dB"`` for a power ratio that is written in decibels; empty
        for a pure number.
    example : str
        A good value.
    above, at_least, below, at_most : str, optional
        Bounds, as a user would write them.
    whole : bool
        Whether only whole numbers will do.
    words : tuple of (str, int)
        Words that stand for numbers, whatever the bounds; not along axes.
    """

    si_unit: str = ""
    example: str
    above: str | None = None
    at_least: str | None = None
    below: str | None = None
    at_most: str | None = None
    whole: bool = False
    words: tuple[tuple[str, int], ...] = ()

    @property
    def units(self) -> str:
        """SI unit of the value read; a power ratio has none."""
        return "" if self.si_unit == DECIBEL else self.si_unit

    def exact(self, written: object) -> tuple[Fraction, Unit]:
        """Exact number and unit of what the user wrote, bounds apart."""
        if self.si_unit:
            return read_quantity(written, si_unit=self.si_unit, example=self.example)
        if isinstance(written, str) and written in dict(self.words):
            raise QuantityError(
                "is one value for a whole study, no point of an axis", "leave it out"
            )
        try:
            return read_number(written)
        except QuantityError as error:
            if not self.words:
                raise
            words = " or ".join(word for word, _ in self.words)
            raise QuantityError(f"must be a number or {words}", error.suggestion) from None

    def read(self, written: object) -> float | int:
        """SI value of what the user wrote, within the bounds."""
        known = dict(self.words)
        if isinstance(written, str) and written in known:
            return known[written]
        try:
            return self._read(written)
        except QuantityError as error:
            words = "".join(f" or '{word}'" for word in known)
            remedy = error.suggestion or f"write e.g. '{self.example}'{words}"
            raise QuantityError(error.rule, remedy) from None

    def _read(self, written: object) -> float | int:
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
        for written, words, is_outside in (
            (self.above, "must be greater than", np.less_equal),
            (self.at_least, "must be at least", np.less),
            (self.below, "must be less than", np.greater_equal),
            (self.at_most, "must be at most", np.greater),
        ):
            if written is None:
                continue
            outside = is_outside(values, _bound(self, written))
            if outside.any():
                return int(np.argmax(outside)), f"{words} {written}"
        return None

    def written(self, value: Any) -> str | int | float:
        """Text that reads back as exactly `value`: ``0.001 W``; of decibels, to 15 digits."""
        for word, stands_for in self.words:
            if value == stands_for:
                return word
        if self.si_unit:
            number = 10.0 * math.log10(value) if self.si_unit == DECIBEL else float(value)
            return f"{repr(number).removesuffix('.0')} {self.si_unit}"
        return int(value) if self.whole else float(value)

    def schema(self) -> dict[str, Any]:
        """JSON Schema: text with a unit, or a number."""
        bounds = [f"greater than {self.above}"] if self.above is not None else []
        bounds += [f"at least {self.at_least}"] if self.at_least is not None else []
        bounds += [f"less than {self.below}"] if self.below is not None else []
        bounds += [f"at most {self.at_most}"] if self.at_most is not None else []
        description = f"{self.about}; {', '.join(bounds)}" if bounds else self.about
        common: dict[str, Any] = {"description": description, "examples": [self.example]}
        if self.si_unit:
            words = (rf"^{word}$" for word, _ in self.words)
            pattern = "|".join([r"^\s*[-+−.0-9].*[^\s0-9.]\S*\s*$", *words])
            return common | {"type": "string", "pattern": pattern}
        kinds: list[dict[str, Any]] = [
            {"type": "integer" if self.whole else "number"} | self._numeric_bounds(),
            {"type": "string", "pattern": r"^\s*[-+.0-9][-+.0-9eE^*_ ]*%?\s*$"},
        ]
        kinds += (
            [{"type": "string", "enum": [word for word, _ in self.words]}] if self.words else []
        )
        return common | {"anyOf": kinds}

    def _numeric_bounds(self) -> dict[str, float]:
        """Bounds of a pure number in JSON Schema's words."""
        words = {
            "exclusiveMinimum": self.above,
            "minimum": self.at_least,
            "exclusiveMaximum": self.below,
            "maximum": self.at_most,
        }
        return {word: _bound(self, text) for word, text in words.items() if text is not None}


@lru_cache(maxsize=1024)
def _bound(rule: Numeric, written: str) -> float:
    """SI value of a rule's bound."""
    number, unit = rule.exact(written)
    return unit.to_si(number)


@dataclass(frozen=True, kw_only=True)
class Choice(Rule):
    """One of several words.

    Parameters
    ----------
    options : tuple of str
        The words.
    """

    options: tuple[str, ...]

    def read(self, written: object) -> str:
        """The word written."""
        if written in self.options and isinstance(written, str):
            return written
        options = ", ".join(self.options)
        raise QuantityError(f"must be one of {options}", near_miss(str(written), self.options))

    def schema(self) -> dict[str, Any]:
        """JSON Schema: the words."""
        return {"description": self.about, "type": "string", "enum": list(self.options)}


@dataclass(frozen=True, kw_only=True)
class Text(Rule):
    """Words for people, or the name of something.

    Parameters
    ----------
    pattern : str
        Regular expression that the whole text matches.
    remedy : str
        What to write where it doesn't.
    """

    pattern: str = r"[^\x00-\x08\x0b-\x1f\x7f-\x9f]{0,5000}"
    remedy: str = "write at most 5000 characters that can be printed"

    def read(self, written: object) -> str:
        """The text."""
        if isinstance(written, bool) or not isinstance(written, str | int | float):
            raise QuantityError("must be text")
        if re.fullmatch(self.pattern, str(written)) is None:
            raise QuantityError("is no text that can stand here", self.remedy)
        return str(written)

    def schema(self) -> dict[str, Any]:
        """JSON Schema: text."""
        return {"description": self.about, "type": "string", "pattern": f"^{self.pattern}$"}
