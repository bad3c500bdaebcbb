"""The axes of a study: which parameters vary, over which values, together or apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.spec.fields import parameter_rules, parameter_suggestion, short_name
from sweep.spec.generators import MOST_VALUES, Rejected
from sweep.spec.mistakes import ABSENT, Finding, Location
from sweep.spec.rules import Rule


@dataclass(frozen=True, eq=False)
class Member:
    """One parameter along an axis.

    Parameters
    ----------
    path : str
        Dotted path of the parameter.
    name : str
        Name of its coordinate.
    values : ndarray (n,) or tuple of str
        SI values, float64 or int64; words of a parameter that takes words.
    display : ndarray (n,)
        The same in `units`.
    units : str
        The unit that the user wrote; empty where there is none.
    """

    path: str
    name: str
    values: np.ndarray | tuple[str, ...]
    display: np.ndarray
    units: str

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Member):
            return NotImplemented
        same = (self.path, self.name, self.units) == (other.path, other.name, other.units)
        return (
            same
            and np.array_equal(np.asarray(self.values), np.asarray(other.values))
            and np.array_equal(self.display, other.display)
        )

    def __hash__(self) -> int:
        return hash((self.path, self.name, self.units, len(self.values)))


@dataclass(frozen=True)
class Axis:
    """One dimension of a study's grid.

    Parameters
    ----------
    name : str
        Name of the dimension.
    members : tuple of Member
        The parameters along it: one, or several that vary together.
    """

    name: str
    members: tuple[Member, ...]

    @property
    def size(self) -> int:
        """Number of values."""
        return len(self.members[0].values)

    @property
    def zipped(self) -> bool:
        """Whether the dimension has a name of its own."""
        return len(self.members) > 1 or self.members[0].name != self.name


def rule_at(path: str, location: Location) -> Rule:
    """Rule of the parameter at a path, or a `Rejected` that suggests another path."""
    rule = parameter_rules().get(path)
    if rule is None:
        raise Rejected(Finding(location, "is no parameter", parameter_suggestion(path), ABSENT))
    return rule


def member_of(path: str, pieces: list[Any], location: Location) -> Member:
    """Parameter along an axis, from pieces laid end to end.

    Parameters
    ----------
    path : str
        Dotted path of the parameter.
    pieces : list of Values or of str
        What the user listed.
    location : tuple
        Where, for what is wrong with it.

    Raises
    ------
    Rejected
        Where there are too many values.
    """
    name = short_name(path)
    if isinstance(pieces[0], str):
        return Member(path, name, tuple(pieces), np.array(pieces), "")
    size = sum(len(piece.si) for piece in pieces)
    if size > MOST_VALUES:
        raise Rejected(
            Finding(
                location, f"has {size} values, and an axis takes at most {MOST_VALUES}", "", ABSENT
            )
        )
    # Not in decibels where some piece is not: those have no zero.
    unit = next((piece.unit for piece in pieces if not piece.unit.decibel), pieces[0].unit)
    values = np.concatenate([piece.si for piece in pieces])
    display = np.concatenate([piece.displayed(unit) for piece in pieces])
    if values.dtype == np.int64 and unit.text == "":
        display = values.copy()
    values.flags.writeable = display.flags.writeable = False
    return Member(path, name, values, display, unit.text)
