"""Points of a study, as all combinations of some places along each of its axes; cuts through it.

Chosen are places along axes: nothing of the arrays is read before their values are asked for.
Arrays of any size are reduced to as many cells as a picture or a page can hold, chunk by chunk.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any

import dask.array
import numpy as np
import pandas
import xarray as xr

from sweep.analysis import labels

if TYPE_CHECKING:
    from sweep.spec import Axis, Member, SceneSpec, Spec


MEAN, LOWEST, HIGHEST = "mean", "lowest", "highest"

PIECE = 2**20
"""Values that are added up at a time."""


@dataclass(frozen=True)
class Side:
    """A dimension as a figure runs along it: places in rising order of a coordinate's values."""

    dim: str
    positions: np.ndarray
    values: np.ndarray

    def together(self, most: int) -> int:
        """Return the number of neighbours in a cell, so that there are `most` cells or fewer."""
        return 1 if labels.is_words(self.values) else -(-self.values.size // most)

    def middles(self, most: int) -> np.ndarray:
        """Mean value of the coordinate in each cell."""
        by = self.together(most)
        if by == 1:
            return self.values
        starts = np.arange(0, self.values.size, by)
        sums = np.add.reduceat(self.values, starts)
        return sums / np.diff(starts, append=self.values.size)


def known(array: xr.DataArray) -> xr.DataArray:
    """Return an array as floats; nan where a count is not made yet."""
    return array if array.dtype.kind == "f" else array.astype(float).where(array >= 0)


@dataclass(frozen=True)
class Points:
    """Points of a dataset: all combinations of some places along its dimensions.

    Places are rows of their dimension's table: their number, and the coordinates there.
    """

    dataset: xr.Dataset
    places: Mapping[str, pandas.DataFrame]

    @classmethod
    def of(cls, dataset: xr.Dataset) -> Points:
        """All points of a dataset."""
        largest = max(dataset.data_vars.values(), key=lambda array: array.ndim)
        every: dict[str, dict[str, np.ndarray]] = {str(dim): {} for dim in largest.dims}
        for name, coordinate in dataset.coords.items():
            if coordinate.dims and coordinate.dims[0] in every:
                every[str(coordinate.dims[0])][str(name)] = coordinate.values
        places = {
            dim: pandas.DataFrame(own, index=pandas.RangeIndex(dataset.sizes[dim]))
            for dim, own in every.items()
        }
        return cls(dataset, places)

    @property
    def size(self) -> int:
        """Number of points."""
        return math.prod(map(len, self.places.values()))

    def dim_of(self, name: str) -> str:
        """Return the dimension of a coordinate; a zipped axis, which is none, is its own."""
        return next((dim for dim, own in self.places.items() if name in own), name)

    def values(self, name: str) -> np.ndarray:
        """Return a coordinate, or the number of the place, at each place along its dimension."""
        own = self.places[self.dim_of(name)]
        return np.asarray(own.get(name, own.index))

    def units(self, name: str) -> str:
        """Units of a coordinate."""
        coordinate = self.dataset.coords.get(name)
        return "" if coordinate is None else str(coordinate.attrs.get("units", ""))

    def at(self, dim: str, chosen: np.ndarray) -> Points:
        """Points at some of the places along a dimension, by their indices or a mask."""
        return replace(self, places={**self.places, dim: self.places[dim].iloc[chosen]})

    def where(self, name: str, wanted: list[object]) -> Points:
        """Points at which a coordinate has one of the values."""
        return self.at(self.dim_of(name), is_any(self.values(name), wanted))

    def once(self) -> Points:
        """Points without repetition of all their coordinates."""
        places = {dim: own.drop_duplicates() if len(own.columns) else own
                  for dim, own in self.places.items()}  # fmt: skip
        return replace(self, places=places)

    def distinct(self, name: str) -> list[object]:
        """Values of a coordinate, in the order in which they first appear."""
        return list(pandas.unique(self.values(name)))

    def varying(self) -> list[str]:
        """Coordinates with more than one value."""
        return [n for own in self.places.values() for n in own if own[n].nunique(dropna=False) > 1]

    def further(self, names: Sequence[str]) -> list[str]:
        """Coordinates that tell points apart which those named leave together, the fewest."""
        return [name for dim in self.places for name in self.further_along(dim, names)]

    def further_along(self, dim: str, names: Sequence[str]) -> list[str]:
        """Those of :meth:`further` that lie along a dimension."""
        own = self.places[dim]
        told = [name for name in names if name in own]
        needed: list[str] = []
        number = len(own[told].drop_duplicates()) if told else 1
        for name in [n for n in own if n not in told]:
            apart = len(own[[*told, *needed, name]].drop_duplicates())
            if apart > number:
                number = apart
                needed.append(name)
        return needed

    def apart(self, name: str) -> list[tuple[object, Points]]:
        """Points of each value of a coordinate, in the order in which the values first appear."""
        dim = self.dim_of(name)
        groups = self.places[dim].groupby(self.values(name), sort=False, dropna=False)
        return [(value, replace(self, places={**self.places, dim: own})) for value, own in groups]

    def side(self, name: str) -> Side:
        """Places along a coordinate, once a value: numbers rising, words as they appear."""
        values, first = np.unique(self.values(name), return_index=True)
        if labels.is_words(values):
            order = np.argsort(first)
            values, first = values[order], first[order]
        dim = self.dim_of(name)
        return Side(dim, np.asarray(self.places[dim].index)[first], values)

    def first(self, *sides: Side) -> dict[str, int]:
        """Return the first place along every dimension but those of some sides."""
        shown = {side.dim for side in sides}
        return {dim: int(own.index[0]) for dim, own in self.places.items() if dim not in shown}

    def cells(self, variable: str, sides: Sequence[tuple[Side, int]], kind: str) -> xr.DataArray:
        """Return a variable in cells along some sides, at the first place along the others; lazy.

        Sides come with the largest number of their cells; kinds are ``mean``, ``lowest``,
        ``highest``.
        """
        array = self.dataset[variable].isel(self.first(*(side for side, _ in sides)))
        for side, _ in sides:
            if not np.array_equal(side.positions, np.arange(array.sizes[side.dim])):
                array = array.isel({side.dim: side.positions})
        array = xr.DataArray(known(array).variable)
        together = {side.dim: side.together(most) for side, most in sides}
        if max(together.values()) > 1:
            cells = array.coarsen(together, boundary="pad")
            array = {MEAN: cells.mean, LOWEST: cells.min, HIGHEST: cells.max}[kind]()
        return array.transpose(*together)


def is_any(values: np.ndarray, wanted: list[object]) -> np.ndarray:
    """Mask of the values that are among those wanted, to the last digits of a float."""
    if values.dtype.kind not in "fiu":
        return np.isin([str(v) for v in values], [str(w) for w in wanted])
    matches = [np.isclose(values, float(w), rtol=1e-9, atol=0.0) for w in wanted]  # type: ignore[arg-type]
    return np.logical_or.reduce(matches)


def confined(found: Points, spec: Spec, where: Mapping[str, object]) -> Points:
    """Points at which coordinates have one of some values, as written in the study."""
    for name, written in where.items():
        several = list(written) if isinstance(written, tuple | list) else [written]
        if name in found.dataset.coords:
            several = [spec.coordinate_value(name, value) for value in several]
        found = found.where(name, several)
    return found


def split(found: Points, names: Sequence[str], most: int) -> tuple[list[tuple[str, Points]], int]:
    """Points apart by the values of coordinates, in words; and the number of parts left out."""
    parts = [("", found)]
    for name in names:
        units = found.units(name)
        parts = [
            (", ".join(filter(None, [text, labels.valued(name, value, units)])), piece)
            for text, part in parts
            for value, piece in part.apart(name)
        ]
    return spread(parts, most)


def spread(parts: list[tuple[str, Points]], most: int) -> tuple[list[tuple[str, Points]], int]:
    """At most so many parts, spread over all, and the number of those left out."""
    if len(parts) <= most:
        return parts, 0
    return [parts[round(i * (len(parts) - 1) / (most - 1))] for i in range(most)], len(parts) - most


def coordinate_of(spec: Spec, path: str) -> Member | None:
    """Return the parameter of a path where it is on an axis."""
    return next((m for axis in spec.axes for m in axis.members if m.path == path), None)


def parameters_at(spec: Spec | SceneSpec, position: Mapping[str, int]) -> dict[str, Any]:
    """SI values of all parameters at a position along the axes, by dotted path."""
    return dict(spec.parameters()) | {
        member.path: np.asarray(member.values)[position[axis.name]].item()
        for axis in spec.axes
        for member in axis.members
    }


RANGE, GRAZING_ANGLE = "target.range", "target.grazing_angle"
PUBLISHED = ((GRAZING_ANGLE, "15 deg"), (GRAZING_ANGLE, "85 deg"), (RANGE, "3500 m"))
NEAREST = "5 m"
"""Nearer ranges are left out of means: there the echo's own shot noise counts [T 4.2]."""


@dataclass(frozen=True)
class Cut:
    """One coordinate at a value, the other along the cut; both empty for a whole study."""

    name: str
    held: str
    value: object
    along: str

    def of(self, found: Points) -> Points:
        """Points of the cut, each once."""
        return found.where(self.held, [self.value]).once() if self.held else found


def cuts(spec: Spec) -> list[Cut]:
    """Cuts of a study's zipped axis through range and angle; else the published three; else all."""
    ranges, angles = coordinate_of(spec, RANGE), coordinate_of(spec, GRAZING_ANGLE)
    whole = [Cut("all", "", None, ranges.name if ranges else angles.name if angles else "")]
    if ranges is None or angles is None:
        return whole
    members = {RANGE: ranges, GRAZING_ANGLE: angles}
    zipped = next((axis for axis in spec.axes if {ranges, angles} <= set(axis.members)), None)
    if zipped is not None:
        held = _pieces(zipped)
    else:
        published = [(members[p], spec.coordinate_value(p, text)) for p, text in PUBLISHED]
        held = [(m, v) for m, v in published if np.isclose(m.display, float(v)).any()]
    found = [
        Cut(
            labels.quantity(value, member.units).replace("°", " deg"),
            member.name,
            value,
            angles.name if member is ranges else ranges.name,
        )
        for member, value in held
    ]
    return found or whole


def _pieces(axis: Axis) -> list[tuple[Member, object]]:
    """Stretches of a zipped axis in which one parameter stays and another varies, in order."""
    members = [m for m in axis.members if m.path in (RANGE, GRAZING_ANGLE)]
    pieces: list[tuple[Member, object]] = []
    start = 0
    while start < axis.size:
        alike = [member.display[start:] == member.display[start] for member in members]
        lengths = [int(np.argmin([*own, False])) for own in alike]
        longest = int(np.argmax(lengths))
        piece = (members[longest], members[longest].display[start].item())
        if piece not in pieces:
            pieces.append(piece)
        start += lengths[longest]
    return pieces


def beyond(found: Points, spec: Spec, distance: str, *, included: bool = False) -> Points:
    """Points farther than a distance (or at it), where range is on an axis."""
    member = coordinate_of(spec, RANGE)
    if member is None:
        return found
    least = float(spec.coordinate_value(RANGE, distance))
    ranges = found.values(member.name)
    return found.at(found.dim_of(member.name), ranges >= least if included else ranges > least)


@dataclass(frozen=True)
class Statistics:
    """Number of the finite values of some points; their mean, median and extremes, nan of none."""

    number: int
    mean: float
    median: float
    least: float
    largest: float

    @classmethod
    def of(cls, values: np.ndarray) -> Statistics:
        """Return those of values without infinity, which are sorted in place."""
        total = sum(np.nansum(part) for part in np.array_split(values, values.size // PIECE + 1))
        values.sort()  # nan comes last
        number = int(np.searchsorted(values, np.nan))
        if not number:
            return cls(0, *[math.nan] * 4)
        middle = values[(number - 1) // 2 : number // 2 + 1].mean()
        return cls(number, float(total / number), float(middle), *values[[0, number - 1]].tolist())


def statistics(groups: Sequence[Points], variable: str) -> list[Statistics]:
    """Statistics of a variable over the points of each group, read once for all of them."""
    places = [{dim: np.asarray(own.index) for dim, own in g.places.items()} for g in groups]
    arrays = [known(g.dataset[variable].isel(at)) for g, at in zip(groups, places, strict=True)]
    with TemporaryFile() as file:  # which holds the values, as memory may not
        sizes = [array.size for array in arrays]
        room = np.memmap(file, float, "w+", shape=(sum(sizes) + 1,)).view(np.ndarray)
        parts = np.split(room, np.cumsum(sizes))[:-1]
        dask.array.store(
            [array.where(np.isfinite(array)).chunk().data for array in arrays],
            [part.reshape(array.shape) for part, array in zip(parts, arrays, strict=True)],
        )
        return [Statistics.of(part) for part in parts]
