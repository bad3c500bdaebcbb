"""Points of a study, as all combinations of some places along each of its axes.

A figure asks for values over some coordinates, whether these are dimensions of their own or vary
together along a zipped axis. Chosen are places along axes, which are few however many points there
are: nothing of the arrays is read before their values are asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.cells import Side, reduced

if TYPE_CHECKING:
    from sweep.spec import Spec


@dataclass(frozen=True)
class Column:
    """A coordinate at every place along an axis (n,), in its units."""

    values: np.ndarray
    units: str
    index: bool = False
    """Whether it is the place along a zipped axis, which the axis's parameters say better."""


@dataclass(frozen=True)
class Places:
    """Places along an axis (n,), in rising order, and its coordinates there."""

    positions: np.ndarray
    coordinates: Mapping[str, Column]

    def at(self, chosen: np.ndarray | slice) -> Places:
        """Those of the given indices, or where the given mask is true."""
        columns = {n: replace(c, values=c.values[chosen]) for n, c in self.coordinates.items()}
        return Places(self.positions[chosen], columns)

    def varying(self) -> list[str]:
        """Coordinates with more than one value."""
        return [
            name
            for name, c in self.coordinates.items()
            if not c.index and (c.values != c.values[:1]).any()
        ]

    def further(self, names: Sequence[str]) -> list[str]:
        """As :meth:`Points.further` of one axis."""
        names = [name for name in names if name in self.coordinates]
        code = np.zeros(self.positions.size, np.int64)
        number, needed = 0, []
        for name in [*names, *(n for n in self.varying() if n not in names)]:
            values, group = np.unique(self.coordinates[name].values, return_inverse=True)
            found, code_with = np.unique(code * values.size + group.ravel(), return_inverse=True)
            if name in names or found.size > number:
                number, code = found.size, code_with.ravel()
                needed += [] if name in names else [name]
        return needed

    def apart(self, name: str) -> list[tuple[object, Places]]:
        """Places of each value of a coordinate, in the order in which the values first appear."""
        column = self.coordinates[name].values
        values, first, group = np.unique(column, return_index=True, return_inverse=True)
        order = np.argsort(group.ravel(), kind="stable")
        members = np.split(order, np.cumsum(np.bincount(group.ravel(), minlength=values.size))[:-1])
        return [(values[i], self.at(members[i])) for i in np.argsort(first)]

    def once(self) -> Places:
        """The first of those that have all coordinates alike."""
        columns = [c.values for c in self.coordinates.values() if not c.index]
        if not columns:
            return self
        codes = np.stack([np.unique(c, return_inverse=True)[1].ravel() for c in columns])
        return self.at(np.sort(np.unique(codes, axis=1, return_index=True)[1]))


@dataclass(frozen=True)
class Points:
    """Points of a dataset: all combinations of some places along its dimensions."""

    dataset: xr.Dataset
    axes: Mapping[str, Places]

    @classmethod
    def of(cls, dataset: xr.Dataset) -> Points:
        """All points of a dataset."""
        largest = max(dataset.data_vars.values(), key=lambda array: array.ndim)
        return cls(dataset, {str(dim): _places(dataset, str(dim)) for dim in largest.dims})

    @property
    def size(self) -> int:
        """Number of points."""
        sizes = [places.positions.size for places in self.axes.values()]
        return int(np.prod(sizes, dtype=np.int64))

    def axis_of(self, name: str) -> str:
        """The axis that has a coordinate."""
        return next(dim for dim, places in self.axes.items() if name in places.coordinates)

    def column(self, name: str) -> Column:
        """A coordinate along its axis."""
        return self.axes[self.axis_of(name)].coordinates[name]

    def along_axis(self, name: str, chosen: np.ndarray | Callable[[Places], Places]) -> Points:
        """With some of the places along the axis of a coordinate."""
        dim = self.axis_of(name)
        places = self.axes[dim]
        new = chosen(places) if callable(chosen) else places.at(chosen)
        return replace(self, axes={**self.axes, dim: new})

    def where(self, name: str, values: list[object]) -> Points:
        """Points at which a coordinate has one of the values."""
        return self.along_axis(name, is_any(self.column(name).values, values))

    def once(self) -> Points:
        """Points without repetition of all their coordinates."""
        return replace(self, axes={dim: places.once() for dim, places in self.axes.items()})

    def distinct(self, name: str) -> list[object]:
        """Values of a coordinate, in the order in which they first appear."""
        values, first = np.unique(self.column(name).values, return_index=True)
        return list(values[np.argsort(first)])

    def varying(self) -> list[str]:
        """Coordinates with more than one value."""
        return [name for places in self.axes.values() for name in places.varying()]

    def further(self, names: Sequence[str]) -> list[str]:
        """Coordinates that tell points apart which those named leave together, as few as will do.

        Parameters that vary along a zipped axis with one that is named are none of them.
        """
        return [name for places in self.axes.values() for name in places.further(names)]

    def apart(self, name: str) -> list[tuple[object, Points]]:
        """Points of each value of a coordinate, in the order in which the values first appear."""
        dim = self.axis_of(name)
        return [
            (value, replace(self, axes={**self.axes, dim: places}))
            for value, places in self.axes[dim].apart(name)
        ]

    def within(self, block: Mapping[str, tuple[int, int]]) -> Points:
        """Those of places from a first to before a last one along each axis."""
        axes = {}
        for dim, places in self.axes.items():
            first, last = np.searchsorted(places.positions, block[dim])
            axes[dim] = places.at(slice(int(first), int(last)))
        return replace(self, axes=axes)

    def spread(self, name: str) -> np.ndarray:
        """A coordinate at every point, (n,)."""
        dim = self.axis_of(name)
        shape = [places.positions.size for places in self.axes.values()]
        along = [size if own == dim else 1 for own, size in zip(self.axes, shape, strict=True)]
        return np.broadcast_to(self.column(name).values.reshape(along), shape).ravel()

    def side(self, name: str) -> Side:
        """Places along a coordinate, in rising order, each value of the coordinate once."""
        dim = self.axis_of(name)
        values, first = np.unique(self.column(name).values, return_index=True)
        return Side(dim, self.axes[dim].positions[first], values)

    def first(self, *sides: Side) -> dict[str, int]:
        """The first place along every axis but those of some sides."""
        shown = {side.dim for side in sides}
        return {
            dim: int(places.positions[0]) for dim, places in self.axes.items() if dim not in shown
        }

    def cells(self, variable: str, sides: Sequence[tuple[Side, int]], kind: str) -> xr.DataArray:
        """A variable in cells along some sides, as :func:`.cells.reduced` makes them."""
        at = self.first(*(side for side, _ in sides))
        return reduced(self.dataset[variable], sides, at, kind)


def _places(dataset: xr.Dataset, dim: str) -> Places:
    """All places along a dimension."""
    columns = {
        str(name): Column(np.asarray(c.values), str(c.attrs.get("units", "")))
        for name, c in dataset.coords.items()
        if c.dims == (dim,)
    }
    if dim not in columns:
        columns[dim] = Column(np.arange(dataset.sizes[dim]), "", index=True)
    return Places(np.arange(dataset.sizes[dim]), columns)


def is_any(values: np.ndarray, wanted: list[object]) -> np.ndarray:
    """Whether each value is one of those wanted, to the last digits of a float."""
    if values.dtype.kind not in "fiu":
        return np.isin([str(v) for v in values], [str(w) for w in wanted])
    matches = [np.isclose(values, float(w), rtol=1e-9, atol=0.0) for w in wanted]  # type: ignore[arg-type]
    return np.logical_or.reduce(matches)


def confined(found: Points, spec: Spec, where: Mapping[str, object]) -> Points:
    """Points at which coordinates have the values that a figure is confined to.

    Parameters
    ----------
    found, spec
        Points of a study, and the study.
    where
        Values as written in the study: one, or several, of each coordinate.
    """
    for name, written in where.items():
        several = list(written) if isinstance(written, tuple | list) else [written]
        if found.column(name).index:
            found = found.where(name, several)
        else:
            found = found.where(name, [spec.coordinate_value(name, value) for value in several])
    return found


def split(found: Points, names: Sequence[str], most: int) -> tuple[list[tuple[str, Points]], int]:
    """Points apart by the values of some coordinates.

    Returns
    -------
    parts : list of (str, Points)
        What each part is, and its points: at most `most`, spread over all.
    left_out : int
        Number of parts left out.
    """
    parts = [("", found)]
    for name in names:
        units = found.column(name).units
        parts = [
            (", ".join(filter(None, [text, _named(name, value, units)])), piece)
            for text, part in parts
            for value, piece in part.apart(name)
        ]
    return spread(parts, most)


def spread(parts: list[tuple[str, Points]], most: int) -> tuple[list[tuple[str, Points]], int]:
    """At most so many parts, spread over all, and the number of those left out."""
    if len(parts) <= most:
        return parts, 0
    return [parts[round(i * (len(parts) - 1) / (most - 1))] for i in range(most)], len(parts) - most


def _named(name: str, value: object, units: str) -> str:
    return f"{labels.coordinate(name)} {labels.quantity(value, units)}"
