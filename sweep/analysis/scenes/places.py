"""Which place along a study's axes is looked at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.scenes.recording import Recording
from sweep.analysis.selection import is_any
from sweep.spec import Mistake, SpecError
from sweep.spec.mistakes import near_miss
from sweep.storage.locations import PACKED, located
from sweep.units import QuantityError

if TYPE_CHECKING:
    from sweep.spec import SceneSpec


@dataclass(frozen=True)
class Place:
    """A place along the axes of a study.

    Attributes
    ----------
    index : dict
        Number of the value along each axis, by the axis's name.
    words : str
        Values of the axes that have several, for a reader; empty where none has.
    left_open : tuple of str
        Axes along which other values would do as well.
    """

    index: dict[str, int]
    words: str
    left_open: tuple[str, ...]

    def recording(self, tree: xr.DataTree, scanner: str) -> Recording:
        """What a scanner recorded there."""
        group = tree.children[scanner].to_dataset(inherit=False)
        if PACKED in tree.attrs:
            return Recording(scanner, group.isel(self.index))
        points = located(str(tree.encoding["source"])) / scanner / "flags" / "c"
        return Recording(
            scanner, group.isel(self.index), points.joinpath(*map(str, self.index.values()))
        )

    def parameters(self, spec: SceneSpec) -> dict[str, float | int | str]:
        """SI values of all parameters there, by dotted path."""
        parameters = dict(spec.parameters())
        for axis in spec.axes:
            for member in axis.members:
                value = member.values[self.index[axis.name]]
                parameters[member.path] = value.item() if isinstance(value, np.generic) else value
        return parameters


def place(spec: SceneSpec, where: Mapping[str, object]) -> Place:
    """The first place at which coordinates have the values asked for.

    Parameters
    ----------
    spec
        The study.
    where
        Value, or values, of coordinates, as written in a spec; of an axis with a name of its
        own, the number along it.

    Raises
    ------
    SpecError
        For a coordinate that the study lacks, or a value that cannot be read or that it lacks.
    """
    fits = {axis.name: np.ones(axis.size, bool) for axis in spec.axes}
    mistakes = []
    for name, written in where.items():
        several = list(written) if isinstance(written, tuple | list) else [written]
        try:
            axis, found = _fitting(spec, name, several)
        except QuantityError as error:
            mistakes.append(Mistake(f"where.{name}", error.rule, f"{written}", error.suggestion))
            continue
        except KeyError:
            known = [member.name for axis in spec.axes for member in axis.members]
            otherwise = f"the coordinates are {', '.join(known)}" if known else "it has no axes"
            remedy = near_miss(name, known, otherwise=otherwise)
            mistakes.append(
                Mistake(f"where.{name}", "is no coordinate of this study", f"{written}", remedy)
            )
            continue
        fits[axis] &= found
        if not fits[axis].any():
            rule, remedy = "is no value of this study", _values(spec, name)
            mistakes.append(Mistake(f"where.{name}", rule, f"{written}", remedy))
    if mistakes:
        raise SpecError(mistakes)
    index = {name: int(np.argmax(found)) for name, found in fits.items()}
    left_open = tuple(name for name, found in fits.items() if found.sum() > 1)
    return Place(index, _words(spec, index), left_open)


def _fitting(spec: SceneSpec, name: str, several: list[object]) -> tuple[str, np.ndarray]:
    """The axis of a coordinate, and which of its values are among those asked for."""
    for axis in spec.axes:
        if name in [member.name for member in axis.members]:
            wanted: list[object] = [spec.coordinate_value(name, value) for value in several]
            return axis.name, is_any(np.asarray(spec.member(name).display), wanted)
        if name == axis.name:
            return axis.name, np.isin(np.arange(axis.size), [int(str(v)) for v in several])
    raise KeyError(name)


def _values(spec: SceneSpec, name: str) -> str:
    """The values that there are, in words."""
    for axis in spec.axes:
        for member in axis.members:
            if name == member.name:
                shown = [labels.quantity(value, member.units) for value in member.display[:8]]
                return f"it has {', '.join(shown)}" + (", ..." if axis.size > 8 else "")
    return f"they are numbered 0 to {next(a.size for a in spec.axes if a.name == name) - 1}"


def _words(spec: SceneSpec, index: Mapping[str, int]) -> str:
    return ", ".join(
        f"{labels.coordinate(member.name)} "
        f"{labels.quantity(member.display[index[axis.name]], member.units)}"
        for axis in spec.axes
        if axis.size > 1
        for member in axis.members
    )
