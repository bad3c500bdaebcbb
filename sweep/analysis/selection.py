"""Points of a dataset in long form: one row a point, coordinates as columns.

A figure asks for values over some coordinates, whether these are dimensions of their own or vary
together along a zipped axis. In long form there is no difference.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from sweep.analysis import labels

if TYPE_CHECKING:
    from sweep.spec import Spec


@dataclass(frozen=True)
class Column:
    """A coordinate of every point (n,), in its units."""

    values: np.ndarray
    units: str
    index: bool = False
    """Whether it is the place along a zipped axis, which the axis's parameters say better."""


@dataclass(frozen=True)
class Points:
    """Variables and coordinates of n points, (n,) each."""

    variables: dict[str, np.ndarray]
    coordinates: dict[str, Column]

    def at(self, chosen: np.ndarray) -> Points:
        """Points of the given indices, or where the given mask is true."""
        return Points(
            {name: values[chosen] for name, values in self.variables.items()},
            {name: replace(c, values=c.values[chosen]) for name, c in self.coordinates.items()},
        )

    def where(self, name: str, values: list[object]) -> Points:
        """Points at which a coordinate has one of the values."""
        return self.at(is_any(self.coordinates[name].values, values))

    def distinct(self, name: str) -> list[object]:
        """Values of a coordinate, in the order in which they first appear."""
        values, first = np.unique(self.coordinates[name].values, return_index=True)
        return list(values[np.argsort(first)])

    def varying(self) -> list[str]:
        """Coordinates with more than one value."""
        return [
            name
            for name, c in self.coordinates.items()
            if not c.index and (c.values != c.values[:1]).any()
        ]

    def further(self, names: list[str]) -> list[str]:
        """Coordinates that tell points apart which those named leave together, as few as will do.

        Parameters that vary along a zipped axis with one that is named are none of them.
        """
        code = np.zeros(self.size, np.int64)
        number, needed = 0, []
        for name in [*names, *(n for n in self.varying() if n not in names)]:
            values, group = np.unique(self.coordinates[name].values, return_inverse=True)
            found, code_with = np.unique(code * values.size + group.ravel(), return_inverse=True)
            if name in names or found.size > number:
                number, code = found.size, code_with.ravel()
                needed += [] if name in names else [name]
        return needed

    def apart(self, name: str) -> list[tuple[object, Points]]:
        """Points of each value of a coordinate, in the order in which the values first appear."""
        column = self.coordinates[name].values
        values, first, group = np.unique(column, return_index=True, return_inverse=True)
        order = np.argsort(group.ravel(), kind="stable")
        members = np.split(order, np.cumsum(np.bincount(group.ravel(), minlength=values.size))[:-1])
        return [(values[i], self.at(members[i])) for i in np.argsort(first)]

    def along(self, x: str, variable: str) -> tuple[np.ndarray, np.ndarray]:
        """A variable over a coordinate, in rising order, each value of the coordinate once."""
        values, first = np.unique(self.coordinates[x].values, return_index=True)
        return values, self.variables[variable][first]

    @property
    def size(self) -> int:
        """Number of points."""
        return next(iter(self.variables.values())).size


def is_any(values: np.ndarray, wanted: list[object]) -> np.ndarray:
    """Whether each value is one of those wanted, to the last digits of a float."""
    if values.dtype.kind not in "fiu":
        return np.isin([str(v) for v in values], [str(w) for w in wanted])
    matches = [np.isclose(values, float(w), rtol=1e-9, atol=0.0) for w in wanted]  # type: ignore[arg-type]
    return np.logical_or.reduce(matches)


def points(dataset: xr.Dataset, names: list[str]) -> Points:
    """All points of a dataset, with some of its variables.

    Parameters
    ----------
    dataset
        A store opened.
    names
        Variables to read.
    """
    chosen = dataset[names]
    dims = tuple(str(dim) for dim in next(iter(dataset[names].data_vars.values())).dims)
    shape = tuple(dataset.sizes[dim] for dim in dims)
    coordinates = {
        str(name): Column(
            np.broadcast_to(_spread(c, dims), shape).ravel(), str(c.attrs.get("units", ""))
        )
        for name, c in chosen.coords.items()
    }
    for dim, size in zip(dims, shape, strict=True):
        if dim not in coordinates:
            place = _spread(xr.DataArray(np.arange(size), dims=[dim]), dims)
            coordinates[dim] = Column(np.broadcast_to(place, shape).ravel(), "", index=True)
    return Points({n: _known(chosen[n].values) for n in names}, coordinates)


def _known(values: np.ndarray) -> np.ndarray:
    """Values in one row; counts as floats, nan where none was made."""
    values = np.asarray(values).ravel()
    return values if values.dtype.kind == "f" else np.where(values < 0, np.nan, values)


def _spread(coordinate: xr.DataArray, dims: tuple[str, ...]) -> np.ndarray:
    """A coordinate's values, shaped to broadcast against the dimensions."""
    values = np.asarray(coordinate.values)
    return values.reshape([values.size if dim in coordinate.dims else 1 for dim in dims])


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
        if found.coordinates[name].index:
            found = found.where(name, several)
        else:
            found = found.where(name, [spec.coordinate_value(name, value) for value in several])
    return found


def split(found: Points, names: list[str], most: int) -> tuple[list[tuple[str, Points]], int]:
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
        units = found.coordinates[name].units
        parts = [
            (", ".join(filter(None, [text, _named(name, value, units)])), piece)
            for text, part in parts
            for value, piece in part.apart(name)
        ]
    if len(parts) <= most:
        return parts, 0
    return [parts[round(i * (len(parts) - 1) / (most - 1))] for i in range(most)], len(parts) - most


def _named(name: str, value: object, units: str) -> str:
    return f"{labels.coordinate(name)} {labels.quantity(value, units)}"
