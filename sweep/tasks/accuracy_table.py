"""The tables of what was promised: where it is met, and by how much it is not.

Of a grid, what is drawn; of a flight, what rays leave where the tolerance says how many they are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model.accuracy import Accuracy
from sweep.storage.locations import Location, located
from sweep.storage.opening import open_group
from sweep.tasks import studies
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.summary import done_blocks, pieces

if TYPE_CHECKING:
    from sweep.spec import Axis, Spec


@dataclass(frozen=True, kw_only=True)
class Row:
    """Error of a probability of detection, or of all that depends on a scanner's rays."""

    name: str
    """Of the probability or the scanner; none for a grid's beamlets, which are counted as rays."""
    points: int  # that are computed and have it; of a flight shots, times places along the axes
    met: int  # of these, within the tolerance
    error: float  # a half-width, where it is drawn: that of the largest excess over its tolerance
    tolerance: float  # there
    where: str
    number: int  # of draws, or of rays, that it has had there
    mean: float  # the same of all points
    most: int

    @property
    def missed(self) -> float:
        """By how much the tolerance is missed at the worst point; 0 where it is met."""
        return max(0.0, self.error - self.tolerance)

    @property
    def needed(self) -> float:
        """Draws that would do there, about, as the half-width's square falls with them.

        nan where these did; inf where none would.
        """
        if not self.missed:
            return math.nan
        if not self.tolerance:
            return math.inf
        return math.ceil(self.number * (self.error / self.tolerance) ** 2)


def accuracy_table(store: str | Location) -> list[Row]:
    """A row for each probability that is promised; none where nothing is drawn or computed.

    Raises
    ------
    StoreError
        Where there is no store of sweep's.
    """
    path = located(store)
    _, study = studies.read(path)
    if not isinstance(study, GridStudy) or not study.spec.draws.any:
        return []
    return list(_rows(path, study))


def _rows(store: Location, study: GridStudy) -> Iterator[Row]:
    from sweep.model.outputs import PROMISED

    spec, found = study.spec, {name: _Worst() for name in PROMISED}
    names = ["n_draws", *(f"{name}_half_width" for name in PROMISED)]
    tolerance = np.broadcast_to(_tolerance(spec), study.grid.shape)
    for place, (draws, *widths) in pieces(store, study, names, done_blocks(store, study)):
        for worst, width in zip(found.values(), widths, strict=True):
            worst.add(width, tolerance[place], draws, tuple(part.start for part in place))
    for name, worst in found.items():
        if worst.points:
            yield worst.row(name, _place(spec.axes, worst.index))


def rays_table(store: str | Location) -> list[Row]:
    """A row for each scanner; none where the tolerance does not say how many rays there are.

    Of a grid one row, with no scanner, where even the most beamlets are too few for some points.

    Raises
    ------
    StoreError
        Where there is no store of sweep's.
    """
    path = located(store)
    _, study = studies.read(path)
    if isinstance(study, GridStudy):
        return [row] if (row := _of_rays(path, study)).missed else []
    if not isinstance(study, FlightStudy) or not study.spec.rays_by_tolerance:
        return []
    return [row for scanner in study.scanners if (row := _of_rays(path, study, scanner)).points]


def _of_rays(path: Location, study: GridStudy | FlightStudy, scanner: str = "") -> Row:
    """The row of a scanner, or of a grid's beamlets."""
    names = [f"{scanner}/{n}" if scanner else n for n in ("beamlets_error", "beamlets")]
    tolerance = np.asarray(study.spec.accuracy.tolerance)
    if not scanner:
        least = Accuracy.least_rays_tolerance
        tolerance = np.maximum(Accuracy(_tolerance(study.spec)).for_beamlets, least)
    tolerance = np.broadcast_to(tolerance, study.layouts[names[0]].shape)
    worst = _Worst()
    for place, (error, number) in pieces(path, study, names, done_blocks(path, study)):
        number = np.where(np.isfinite(error), np.nan_to_num(number), 0)
        worst.add(error, tolerance[place], number, tuple(part.start for part in place))
    where, axes = "", len(study.spec.axes)
    if worst.points and (axes or not scanner):
        where = _place(study.spec.axes, worst.index[:axes])
    if scanner and worst.points:
        time: Any = open_group(path)[f"{scanner}/time"]
        where += f"{', ' if where else ''}time {float(np.asarray(time[worst.index[-1]])):.4g} s"
    return worst.row(scanner, where)


@dataclass
class _Worst:
    """Points whose error is known, and that which is furthest above its tolerance."""

    points: int = 0
    met: int = 0
    over: float = -math.inf
    error: float = math.nan
    tolerance: float = math.nan
    number: int = 0
    index: tuple[int, ...] = ()
    total: int = 0
    most: int = 0

    def row(self, name: str, where: str) -> Row:
        """A row of the table."""
        shared = ("points", "met", "error", "tolerance", "number", "most")
        own = {each: getattr(self, each) for each in shared}
        return Row(name=name, where=where, mean=self.total / max(self.points, 1), **own)

    def add(
        self, error: np.ndarray, tolerance: np.ndarray, number: np.ndarray, start: tuple[int, ...]
    ) -> None:
        """Take in some points of the grid, the first of which is at ``start``."""
        known = np.isfinite(error)
        over = np.where(known, error - tolerance, -np.inf)
        self.points += int(known.sum())
        self.met += int((over <= 0).sum() - (~known).sum())
        self.total += int(number.sum())
        self.most = max(self.most, int(number.max(initial=0)))
        at = np.unravel_index(np.argmax(over), over.shape)
        if over[at] > self.over:
            self.over, self.error = float(over[at]), float(error[at])
            self.tolerance, self.number = float(tolerance[at]), int(number[at])
            self.index = tuple(first + int(i) for first, i in zip(start, at, strict=True))


def _tolerance(spec: Spec) -> np.ndarray:
    """Tolerances that broadcast over the grid."""
    for k, axis in enumerate(spec.axes):
        for member in axis.members:
            if member.path == "accuracy.tolerance":
                return np.asarray(member.values).reshape(-1, *(1,) * (len(spec.axes) - k - 1))
    return np.asarray(spec.accuracy.tolerance)


def _place(axes: tuple[Axis, ...], index: tuple[int, ...]) -> str:
    """A point of the grid in the user's units."""
    words = []
    for axis, i in zip(axes, index, strict=True):
        for member in axis.members:
            value = member.display[i]
            shown = value if isinstance(value, str) else f"{value:.4g}"
            words.append(f"{member.name} {shown} {member.units}".strip())
    return ", ".join(words) or "the point"
