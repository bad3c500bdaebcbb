"""Which places along a study's dimensions a figure shows, and what tells its parts apart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from sweep.analysis.selection import Column, Points, confined, split
from sweep.report.cells import Side
from sweep.spec import Axis, Spec

MOST_PARTS = 6
"""Values that a chart offers to choose from, at the most."""

_POSITION = "position"


@dataclass(frozen=True)
class Part:
    """A part of a study that a figure shows at a time.

    Attributes
    ----------
    words
        What tells it from the others.
    found : dict of Points
        Places along every axis, by the axis's name.
    """

    words: str
    found: Mapping[str, Points]

    def side(self, spec: Spec, name: str) -> Side:
        """The places along a coordinate, each of its values once."""
        axis = axis_of(spec, name)
        values, positions = self.found[axis.name].along(name, _POSITION)
        return Side(axis.name, positions.astype(int), values)

    def at(self, *sides: Side) -> dict[str, int]:
        """The first place along every axis but those of the sides."""
        shown = {side.dim for side in sides}
        return {
            name: int(found.variables[_POSITION][0])
            for name, found in self.found.items()
            if name not in shown
        }

    def lines(self, spec: Spec, by: str, most: int) -> tuple[list[Part], int]:
        """The part apart by the values of a coordinate, and how many of these are left out."""
        if not by:
            return [self], 0
        axis = axis_of(spec, by).name
        pieces, left_out = split(self.found[axis], [by], most)
        return [Part(words, {**self.found, axis: piece}) for words, piece in pieces], left_out


def axis_of(spec: Spec, name: str) -> Axis:
    """The axis that has a coordinate, or bears the name itself."""
    return next(
        axis for axis in spec.axes if name == axis.name or name in [m.name for m in axis.members]
    )


def parts(spec: Spec, shown: Sequence[str], where: Mapping[str, object]) -> tuple[list[Part], int]:
    """Parts of a study of which a figure shows one at a time, and how many are left out.

    Parameters
    ----------
    spec
        The study.
    shown
        Coordinates that a part has many values of: along the figure's sides and lines.
    where
        Values that coordinates are confined to, as written. There is no part where the study has
        none of them.
    """
    kept, missing = {}, False
    for axis in spec.axes:
        names = {axis.name, *(member.name for member in axis.members)}
        own = {name: value for name, value in where.items() if name in names}
        kept[axis.name] = confined(_places(axis), spec, own)
        missing |= not kept[axis.name].size
    if missing:
        return [], 0
    apart, number = [], 1
    for name, found in kept.items():
        pieces, left_out = split(found, found.further(_along(found, shown)), MOST_PARTS)
        apart.append([(words, name, piece) for words, piece in pieces])
        number *= len(pieces) + left_out
    made = [
        Part(", ".join(filter(None, (words for words, _, _ in one))), {n: p for _, n, p in one})
        for one in _spread(list(product(*apart)))
    ]
    return made, number - len(made)


def _spread(
    pieces: list[tuple[tuple[str, str, Points], ...]],
) -> Iterator[tuple[tuple[str, str, Points], ...]]:
    """No more than the page offers, spread over all."""
    for i in np.unique(np.linspace(0, len(pieces) - 1, min(MOST_PARTS, len(pieces))).round()):
        yield pieces[int(i)]


def _places(axis: Axis) -> Points:
    """Places along an axis with the parameters there."""
    columns = {m.name: Column(np.asarray(m.display), m.units) for m in axis.members}
    if axis.name not in columns:
        columns[axis.name] = Column(np.arange(axis.size), "", index=True)
    return Points({_POSITION: np.arange(axis.size)}, columns)


def _along(found: Points, shown: Sequence[str]) -> list[str]:
    return [name for name in shown if name in found.coordinates]
