"""A user's mistakes in a spec: what is wrong, where it stands, and what to write instead."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches

from sweep.units import QuantityError

Location = tuple[str | int, ...]

ABSENT = object()
"""Stands for a value where none is written."""
_LONGEST_VALUE = 60


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
        return place + said + wrote + (f"; {self.suggestion}" if self.suggestion else "")


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
    """Suggestion of the known name that `name` resembles, else a remedy."""
    names = list(known)
    close = [k for k in names if k.lower() == name.lower()] or get_close_matches(name, names, n=1)
    return f"did you mean '{close[0]}'?" if close else otherwise
