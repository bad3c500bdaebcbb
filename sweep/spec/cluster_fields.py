"""Rules for the fields of a cluster's file: memory, numbers of workers, lines, variables."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from sweep.spec.quantities import count, duration
from sweep.spec.rules import Numeric, Rule, Text
from sweep.units import QuantityError

_COUNT = count("Workers", "8", at_most="100000")


class Bounds(NamedTuple):
    """Workers at least and at most; the same where their number is fixed."""

    least: int
    most: int


def memory(about: str, example: str = "4 GB") -> Numeric:
    """Rule of an amount of memory [byte]."""
    return Numeric(
        about=about, si_unit="byte", example=example, at_least="64 MB", at_most="100 TB"
    )  # fmt: skip


def walltime(about: str) -> Numeric:
    """Rule of the time that a batch job may take [s]."""
    return duration(about, "2 h", at_least="1 min", at_most="365 d")


def word(about: str, example: str) -> Text:
    """Rule of one word on a command line: no blanks, no quotes, nothing that a shell reads."""
    return Text(
        about=about,
        pattern=r"[A-Za-z0-9_.:/@%+=,\[\]~-]{1,500}",
        remedy=f"write one word, such as '{example}'",
    )


@dataclass(frozen=True, kw_only=True)
class WorkerNumber(Rule):
    """A number of workers, or bounds that it is kept within."""

    def read(self, written: object) -> Bounds:
        """The bounds."""
        if not isinstance(written, Mapping):
            try:
                fixed = int(_COUNT.read(written))
            except QuantityError as error:
                raise QuantityError(error.rule, "write e.g. 8 or {least: 2, most: 40}") from None
            return Bounds(fixed, fixed)
        if written.keys() != {"least", "most"}:
            raise QuantityError("must have a least and a most", "write e.g. {least: 2, most: 40}")
        bounds = Bounds(*(int(_end(name, written[name])) for name in ("least", "most")))
        if bounds.least > bounds.most:
            raise QuantityError("has a least above its most", "write the smaller number as least")
        return bounds

    def written(self, value: Any) -> Any:
        """What reads back as the bounds."""
        return value.most if value.least == value.most else value._asdict()

    def schema(self) -> dict[str, Any]:
        """JSON Schema: a number, or both bounds."""
        ends = {name: _COUNT.schema() for name in ("least", "most")}
        bounds = {
            "type": "object",
            "properties": ends,
            "required": list(ends),
            "additionalProperties": False,
        }
        return {"description": self.about, "anyOf": [_COUNT.schema(), bounds]}


def _end(name: str, written: object) -> Any:
    try:
        return _COUNT.read(written)
    except QuantityError as error:
        raise QuantityError(
            f"has a {name} that {error.rule}", "write e.g. {least: 2, most: 40}"
        ) from None


@dataclass(frozen=True, kw_only=True)
class Texts(Rule):
    """A list of texts of one line each.

    Parameters
    ----------
    example : str
        A good one.
    of : Rule
        What each may be.
    least : int
        Number of them.
    """

    example: str
    of: Rule = Text(about="One line", pattern=r"[^\n\r\0]{1,2000}", remedy="write one line")  # noqa: RUF009
    least: int = 0

    def read(self, written: object) -> tuple[str, ...]:
        """The texts."""
        if not isinstance(written, list | tuple) or len(written) < self.least:
            raise QuantityError("must be a list of texts", f"write e.g. [{self.example}]")
        try:
            return tuple(self.of.read(text) for text in written)
        except QuantityError as error:
            raise QuantityError(
                "holds what is no such text", error.suggestion or f"write e.g. [{self.example}]"
            ) from None

    def written(self, value: Any) -> Any:
        """List of the texts."""
        return list(value)

    def schema(self) -> dict[str, Any]:
        """JSON Schema: a list of texts."""
        return {
            "description": self.about,
            "type": "array",
            "items": self.of.schema(),
            "minItems": self.least,
        }


@dataclass(frozen=True, kw_only=True)
class Variables(Rule):
    """Environment variables by name."""

    def read(self, written: object) -> dict[str, str]:
        """Values by name."""
        example = "write e.g. {TMPDIR: /scratch}"
        if not isinstance(written, Mapping):
            raise QuantityError("must be a mapping of names to values", example)
        for name, value in written.items():
            if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", str(name)):
                raise QuantityError(f"holds '{name}', which is no name of a variable", example)
            if isinstance(value, bool) or not isinstance(value, str | int | float):
                raise QuantityError(f"holds no text for {name}", example)
            if re.search(r"[\n\r\0']", str(value)):
                raise QuantityError(f"holds a quote or more than a line for {name}", example)
        return {str(name): str(value) for name, value in written.items()}

    def written(self, value: Any) -> Any:
        """Mapping of the values."""
        return dict(value)

    def schema(self) -> dict[str, Any]:
        """JSON Schema: a mapping."""
        return {
            "description": self.about,
            "type": "object",
            "additionalProperties": {"type": ["string", "number"]},
        }
