"""Points of a recording as rows of a table, for files that other programs read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sweep.analysis.scenes.quantities import QUANTITIES
from sweep.analysis.scenes.recording import Recording


@dataclass(frozen=True)
class Field:
    """A column: its name, type, units ("1" where it has none) and what it is."""

    name: str
    dtype: str
    units: str
    words: str


def _of(name: str, dtype: str) -> Field:
    about = QUANTITIES[name]
    return Field(name, dtype, about.units, about.words)


FIELDS = (
    *(_of(name, "<f8") for name in (
        "x", "y", "z", "time", "range", "radial_velocity", "range_standard_error",
        "radial_velocity_standard_error", "snr", "pd", "true_range", "true_radial_velocity",
    )),
    _of("surface", "<i2"),
    _of("flags", "|u1"),
    _of("beam", "<i4"),
    _of("shot", "<u4"),
    Field("return_number", "|u1", "1", "number of the return, from 1"),
    Field("number_of_returns", "|u1", "1", "points of the same shot and draw"),
)  # fmt: skip
"""Every column, in the order of files."""

ROW = np.dtype([(field.name, field.dtype) for field in FIELDS])


@dataclass(frozen=True)
class PointTable:
    """Points of one draw of a recording.

    Attributes
    ----------
    recording, draw, ranges
        Whose points; which draw; `quantised` or `interpolated`.
    origin : (3,) ndarray
        What is added to the scene's coordinates [m].
    """

    recording: Recording
    draw: int
    ranges: str
    origin: np.ndarray

    def parts(self) -> Iterator[np.ndarray]:
        """Rows (m,) of ROW, stretch by stretch."""
        names = [field.name for field in FIELDS if field.name != "number_of_returns"]
        for part in self.recording.stretches():
            table = self.recording.points(
                [*names, "returns"], part, draw=self.draw, ranges=self.ranges
            )
            rows = np.zeros(table["x"].size, ROW)
            for name in names:
                rows[name] = table[name]
            rows["return_number"] += 1
            rows["number_of_returns"] = table["returns"]
            for axis, shift in zip("xyz", self.origin, strict=True):
                rows[axis] += shift
            yield rows

    def number(self) -> int:
        """How many points there are."""
        return sum(
            int((self.recording.read("flags", part, self.draw) > 0).sum())
            for part in self.recording.stretches()
        )

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest coordinates, (3,) each [m]; infinite without a point."""
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for part in self.recording.stretches():
            table = self.recording.points("xyz", part, draw=self.draw, ranges=self.ranges)
            places = np.array([table[axis] for axis in "xyz"]) + self.origin[:, None]
            low = np.minimum(low, places.min(axis=1, initial=np.inf))
            high = np.maximum(high, places.max(axis=1, initial=-np.inf))
        return low, high
