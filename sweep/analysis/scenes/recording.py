"""What one scanner recorded on its flight: shots and points, read stretch by stretch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.analysis.scenes.opening import chunk, stretches
from sweep.analysis.scenes.quantities import QUANTISED, QUANTITIES, stored_name
from sweep.storage.locations import Location

Table = dict[str, np.ndarray]


@dataclass(frozen=True)
class Interval:
    """Limits of a quantity, either of them none."""

    low: float = -np.inf
    high: float = np.inf

    def holds(self, values: np.ndarray) -> np.ndarray:
        """Whether each value lies within; nan does not."""
        return (values >= self.low) & (values <= self.high)


@dataclass(frozen=True)
class Recording:
    """Shots and points of one scanner, at one place along the study's axes.

    Attributes
    ----------
    scanner : str
        Its name.
    dataset : xarray.Dataset
        Arrays of the scanner's group, without the study's axes.
    chunks : Location or None
        Folder of the chunks of its flags; none where all is computed whose time is known.
    """

    scanner: str
    dataset: xr.Dataset
    chunks: Location | None = None

    @property
    def shots(self) -> int:
        """Number of shots."""
        return int(self.dataset.sizes["shot"])

    @property
    def shots_a_cycle(self) -> int:
        """Shots of a measurement cycle."""
        return int(self.dataset.attrs["shots_a_cycle"])

    def stretches(self, time: Interval | None = None) -> Iterator[slice]:
        """Stretches of shots, without those that are not computed or lie outside of an interval."""
        for part in stretches(self.dataset["flags"], "shot"):
            at = self.read("time", part)
            if np.isfinite(at).any() and (time is None or time.holds(at).any()):
                yield part

    def computed(self, part: slice, draw: int = 0) -> np.ndarray:
        """Which shots of a stretch are computed, as far as points of a draw go, (k,) bool.

        Geometry is stored with a study's first place and draw: that a shot's time is known says
        nothing of the others, and no point looks like none found. Only its chunk tells.
        """
        known = np.isfinite(self.read("time", part))
        if self.chunks is None:
            return known
        shots, draws = (chunk(self.dataset["flags"], dim) for dim in ("shot", "draw"))
        stored = [
            (self.chunks / f"{number}" / f"{draw // draws}" / "0").exists()
            for number in range(part.start // shots, (part.stop - 1) // shots + 1)
        ]
        at = np.arange(part.start, part.stop) // shots - part.start // shots
        return known & np.array(stored)[at]

    def read(self, name: str, part: slice, draw: int | None = None) -> np.ndarray:
        """An array's values over a stretch of shots, of one draw where it has any."""
        array = self.dataset[name].isel(shot=part)
        return np.asarray((array if draw is None else array.isel(draw=draw)).values)

    def points(
        self, names: Sequence[str], part: slice, *, draw: int = 0, ranges: str = QUANTISED
    ) -> Table:
        """Quantities of every point of a stretch, (m,) each, in the order of shots and returns.

        Parameters
        ----------
        names
            Names of :data:`QUANTITIES`, and ``return_number``, ``returns`` (points of the same
            shot).
        part, draw
            Stretch of shots; number of the draw.
        ranges
            ``quantised`` or ``interpolated``: which ranges and velocities to take, and which
            positions follow from them.
        """
        present = self.read("flags", part, draw) > 0
        shot, place = np.nonzero(present)
        table: Table = {}
        for name in names:
            if name in ("x", "y", "z"):
                if name not in table:
                    where = self._positions(part, present, shot, draw, ranges)
                    table |= dict(zip("xyz", where.T, strict=True))
            elif name == "return_number":
                table[name] = place
            elif name == "returns":
                table[name] = present.sum(axis=1)[shot]
            elif QUANTITIES[name].of_points:
                table[name] = self.read(stored_name(name, ranges), part, draw)[present]
            else:
                table[name] = self.of_shots(name, part)[shot]
        return {name: table[name] for name in names}

    def _positions(
        self, part: slice, present: np.ndarray, shot: np.ndarray, draw: int, ranges: str
    ) -> np.ndarray:
        """World positions of points, (m, 3)."""
        position = self.read("position", part, draw)[present]
        if ranges == QUANTISED:
            change = self.read("range", part, draw) - self.read("range_interpolated", part, draw)
            position = position + change[present][:, None] * self.read("beam_direction", part)[shot]
        return position

    def of_shots(self, name: str, part: slice) -> np.ndarray:
        """A quantity of every shot of a stretch, (k,)."""
        if name == "shot":
            return np.arange(part.start, part.stop)
        if name == "altitude":
            cycle = np.arange(part.start, part.stop) // self.shots_a_cycle
            heights = self.dataset["true_altitude"].isel(cycle=slice(cycle[0], cycle[-1] + 1))
            return np.asarray(heights.values)[cycle - cycle[0]]
        return self.read(name, part)

    def aims(self, part: slice) -> np.ndarray:
        """World positions that beams truly point at, (k, 3); nan where a beam meets nothing."""
        reach = self.read("beam_range", part)
        reach = np.where(np.isfinite(reach), reach, np.nan)[:, None]
        return self.read("platform_position", part) + reach * self.read("beam_direction", part)


def confined(tables: Table, crops: Mapping[str, Interval]) -> Table:
    """Rows of a table in which every quantity lies within its interval."""
    if not crops:
        return tables
    inside = np.logical_and.reduce([crop.holds(tables[name]) for name, crop in crops.items()])
    return {name: values[inside] for name, values in tables.items()}


class Thinned:
    """Rows of tables in order, evenly thinned to a number of them in bounded memory.

    Every row is kept until there are too many, then every second, every fourth, ...

    Parameters
    ----------
    most
        Rows to keep at most.
    """

    def __init__(self, most: int) -> None:
        self.most, self.every, self.total = most, 1, 0
        self._parts: list[Table] = []
        self._kept = 0

    def add(self, table: Table) -> None:
        """Rows that follow."""
        size = len(next(iter(table.values())))
        number = np.arange(self.total, self.total + size)
        self.total += size
        self._append(table, number % self.every == 0)
        while self._kept > self.most:
            self.every *= 2
            whole = self.rows()
            self._parts, self._kept = [], 0
            self._append(whole, np.arange(len(next(iter(whole.values())))) % 2 == 0)

    def _append(self, table: Table, chosen: np.ndarray) -> None:
        self._parts.append({name: values[chosen] for name, values in table.items()})
        self._kept += int(chosen.sum())

    def rows(self) -> Table:
        """The rows kept; empty where none were added."""
        if not self._parts:
            return {}
        return {n: np.concatenate([part[n] for part in self._parts]) for n in self._parts[0]}
