"""Rules for fields that hold more than one value, and for the less usual single ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sweep.scenes.files import file_digest
from sweep.spec.mistakes import near_miss
from sweep.spec.rules import Numeric, Rule
from sweep.units import QuantityError

Numbers = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class Several(Rule):
    """A list of values, each held to the same rule.

    Parameters
    ----------
    of : Numeric
        What each value may be.
    least, most : int
        Number of values.
    """

    of: Numeric
    least: int = 3
    most: int = 3

    @property
    def units(self) -> str:
        """SI unit of the values read; empty where there is none."""
        return self.of.units

    @property
    def example(self) -> str:
        """A good list."""
        return f"[{', '.join([self.of.example] * self.least)}]"

    def read(self, written: object) -> Numbers:
        """SI values of what the user wrote."""
        if not isinstance(written, list | tuple) or not self.least <= len(written) <= self.most:
            number = str(self.least) if self.least == self.most else f"at least {self.least}"
            raise QuantityError(f"must be a list of {number} values", f"write e.g. {self.example}")
        return tuple(_read_element(self.of, i, value) for i, value in enumerate(written))

    def written(self, value: Any) -> Any:
        """List that reads back as exactly `value`."""
        return [self.of.written(element) for element in value]

    def schema(self) -> dict[str, Any]:
        """JSON Schema: a list."""
        return {
            "description": self.about,
            "type": "array",
            "items": self.of.schema(),
            "minItems": self.least,
            "maxItems": self.most,
        }


@dataclass(frozen=True, kw_only=True)
class Interval(Several):
    """Lower and upper end of a stretch."""

    least: int = 2
    most: int = 2

    def read(self, written: object) -> Numbers:
        """SI values of both ends."""
        low, high = super().read(written)
        if not low < high:
            raise QuantityError("must begin below its end", "put the lower value first")
        return low, high


@dataclass(frozen=True, kw_only=True)
class Names(Rule):
    """A list of different names.

    Parameters
    ----------
    of : Rule
        What each name may be.
    """

    of: Rule

    def read(self, written: object) -> tuple[str, ...]:
        """The names."""
        if not isinstance(written, list | tuple) or not written:
            raise QuantityError("must be a list of names", "write e.g. [three]")
        names = tuple(_read_element(self.of, i, name) for i, name in enumerate(written))
        if len(set(names)) < len(names):
            raise QuantityError("holds a name more than once", "list it once")
        return names

    def written(self, value: Any) -> Any:
        """List of the names."""
        return list(value)

    def schema(self) -> dict[str, Any]:
        """JSON Schema: a list of text."""
        return {
            "description": self.about,
            "type": "array",
            "items": self.of.schema(),
            "minItems": 1,
            "uniqueItems": True,
        }


def _read_element(rule: Rule, index: int, written: object) -> Any:
    """One value of a list, or what is wrong with it."""
    try:
        return rule.read(written)
    except QuantityError as error:
        value = written if isinstance(written, str | int | float) else type(written).__name__
        told = f"holds {value!r:.60} as value {index}, which {error.rule}"
        remedy = error.suggestion or f"write e.g. {getattr(rule, 'example', 'ground')}"
        raise QuantityError(told, remedy) from None


_STEERED = Several(
    about="Angles of a beam towards forward and towards the left",
    of=Numeric(
        about="Angle from nadir", si_unit="rad", example="22.5 deg", at_least="-89 deg",
        at_most="89 deg",
    ),
    least=2,
    most=2,
)  # fmt: skip
_POINTED = Several(
    about="Direction of a beam in the body frame",
    of=Numeric(about="Component", example="-1", at_least="-1e9", at_most="1e9"),
)
MOST_BEAMS = 10_000


@dataclass(frozen=True, kw_only=True)
class Beams(Rule):
    """Directions of beams: angles towards forward and left, or vectors in the body frame."""

    def read(self, written: object) -> tuple[Numbers, ...]:
        """Angles [rad] (two of them) or components (three) of each beam."""
        example = "write e.g. [[22.5 deg, 0 deg], [0 deg, 0 deg]]"
        if not isinstance(written, list | tuple) or not 0 < len(written) <= MOST_BEAMS:
            raise QuantityError(f"must be a list of 1 to {MOST_BEAMS} beams", example)
        return tuple(_read_element(_rule_of_beam(b), i, b) for i, b in enumerate(written))

    def written(self, value: Any) -> Any:
        """Lists that read back as exactly `value`."""
        return [_rule_of_beam(beam).written(beam) for beam in value]

    def schema(self) -> dict[str, Any]:
        """JSON Schema: a list of lists."""
        beam = {"anyOf": [_STEERED.schema(), _POINTED.schema()]}
        return {
            "description": self.about,
            "type": "array",
            "items": beam,
            "minItems": 1,
            "maxItems": MOST_BEAMS,
        }


def _rule_of_beam(beam: object) -> Several:
    """Rule of a beam, by how many numbers it has."""
    return _POINTED if isinstance(beam, list | tuple) and len(beam) == 3 else _STEERED


@dataclass(frozen=True, kw_only=True)
class Either(Rule):
    """One of several words, or a number.

    Parameters
    ----------
    words : tuple of str
        The words.
    of : Rule
        What it may be else.
    """

    words: tuple[str, ...]
    of: Rule

    @property
    def units(self) -> str:
        """SI unit of the value read; empty where there is none."""
        return self.of.units

    def read(self, written: object) -> Any:
        """The word, or the SI value."""
        if isinstance(written, str) and written in self.words:
            return written
        try:
            return self.of.read(written)
        except QuantityError as error:
            words = " or ".join(f"'{word}'" for word in self.words)
            text = written if isinstance(written, str) else ""
            suggestion = near_miss(text, self.words) or error.suggestion or f"write {words}"
            raise QuantityError(f"{error.rule} (or be {words})", suggestion) from None

    def written(self, value: Any) -> Any:
        """Text that reads back as exactly `value`."""
        return value if isinstance(value, str) else self.of.written(value)

    def schema(self) -> dict[str, Any]:
        """JSON Schema: the words, or the rest."""
        return {
            "description": self.about,
            "anyOf": [{"type": "string", "enum": list(self.words)}, self.of.schema()],
        }


@dataclass(frozen=True, kw_only=True)
class Flag(Rule):
    """Whether or not."""

    def read(self, written: object) -> bool:
        """True or False."""
        if not isinstance(written, bool):
            raise QuantityError("must be true or false", "write 'true' or 'false'")
        return written

    def written(self, value: Any) -> Any:
        """True or False."""
        return bool(value)

    def schema(self) -> dict[str, Any]:
        """JSON Schema: true or false."""
        return {"description": self.about, "type": "boolean"}


@dataclass(frozen=True, kw_only=True)
class File(Rule):
    """Path of a file, relative to the one that names it.

    Parameters
    ----------
    digest
        Digest of what is read from the file.
    """

    digest: Callable[[Path], str] = file_digest

    def read(self, written: object) -> str:
        """The path, as written."""
        if not isinstance(written, str) or not 0 < len(written.strip()) <= 4096:
            raise QuantityError("must be the path of a file", "write it relative to this file")
        if "\0" in written:
            raise QuantityError("holds a character that no path has")
        return written

    def schema(self) -> dict[str, Any]:
        """JSON Schema: text."""
        return {"description": self.about, "type": "string", "minLength": 1}
