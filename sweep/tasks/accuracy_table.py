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
from sweep.tasks.journal import receipted
from sweep.tasks.summary import done_blocks, pieces

if TYPE_CHECKING:
    from sweep.spec import Axis, Spec


@dataclass(frozen=True)
class AccuracyRow:
    """How well one of the probabilities of detection is known over the grid."""

    name: str
    points: int  # that are computed and have it
    met: int  # of these, within the tolerance
    half_width: float  # at the worst point, that of the largest excess over its tolerance
    tolerance: float  # there
    where: str
    draws: int  # that it has had
    needed: float  # that would do, about; nan where these did, inf where none would

    @property
    def missed(self) -> float:
        """By how much the tolerance is missed at the worst point; 0 where it is met."""
        return max(0.0, self.half_width - self.tolerance)


def accuracy_table(store: str | Location) -> list[AccuracyRow]:
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


def _rows(store: Location, study: GridStudy) -> Iterator[AccuracyRow]:
    from sweep.model.outputs import PROMISED

    spec, found = study.spec, {name: _Worst() for name in PROMISED}
    names = ["n_draws", *(f"{name}_half_width" for name in PROMISED)]
    tolerance = np.broadcast_to(_tolerance(spec), study.grid.shape)
    for place, (draws, *widths) in pieces(store, study, names, done_blocks(store, study)):
        for worst, width in zip(found.values(), widths, strict=True):
            worst.add(width, tolerance[place], draws, tuple(part.start for part in place))
    for name, worst in found.items():
        if worst.points:
            yield AccuracyRow(
                name=name,
                points=worst.points,
                met=worst.met,
                half_width=worst.half_width,
                tolerance=worst.tolerance,
                where=_place(spec.axes, worst.index),
                draws=worst.draws,
                needed=_needed(worst.draws, worst.half_width, worst.tolerance),
            )


@dataclass(frozen=True)
class RaysRow:
    """How well a scanner's probabilities and magnitudes are known, for what its rays leave."""

    scanner: str  # none for a grid, whose points and beamlets are counted as shots and rays
    shots: int  # that are computed and see something, times places along the axes
    met: int  # of these, within the tolerance
    error: float  # of the worst
    tolerance: float
    where: str
    rays: float  # of a shot, in the mean
    most: int  # of any shot

    @property
    def missed(self) -> float:
        """By how much the tolerance is missed by the worst shot; 0 where it is met."""
        return max(0.0, self.error - self.tolerance) if self.shots > self.met else 0.0


def rays_table(store: str | Location) -> list[RaysRow]:
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
        return [row] if (row := _of_beamlets(path, study)).missed else []
    if not isinstance(study, FlightStudy) or not study.spec.rays_by_tolerance:
        return []
    return [row for scanner in study.scanners if (row := _of_rays(path, study, scanner)).shots]


def _of_beamlets(path: Location, study: GridStudy) -> RaysRow:
    worst, total, most = _Worst(), 0, 0
    tolerance = np.broadcast_to(_tolerance(study.spec), study.grid.shape)
    tolerance = np.maximum(Accuracy(tolerance).for_beamlets, Accuracy.least_rays_tolerance)
    names = "beamlets_error", "beamlets"
    for place, (error, number) in pieces(path, study, names, done_blocks(path, study)):
        start, number = tuple(part.start for part in place), np.nan_to_num(number)
        worst.add(error, tolerance[place], number.astype(np.int64), start)
        total, most = total + int(number.sum()), max(most, int(number.max()))
    where, mean = _place(study.spec.axes, worst.index), total / max(worst.points, 1)
    return RaysRow(
        "", worst.points, worst.met, worst.half_width, worst.tolerance, where, mean, most
    )  # fmt: skip


def _of_rays(path: Location, study: FlightStudy, scanner: str) -> RaysRow:
    names = "beamlets_error", "beamlets", "time"
    arrays: Any = open_group(path)[scanner]
    errors, numbers, times = (arrays[name] for name in names)
    stretches, worst = study.scanners[scanner], _Worst()
    tolerance, rays, most = float(study.spec.accuracy.tolerance), 0, 0
    for block in np.flatnonzero(receipted(path, study)).tolist():
        own, part = study.part(block)
        if own is stretches and part.draws == 0:
            first, stop = stretches.shot_range(part)
            there = *(slice(i, i + 1) for i in part.axes), slice(first, stop)
            error = np.asarray(errors[there])
            number = np.where(np.isfinite(error), np.asarray(numbers[there]), 0)
            rays, most = rays + int(number.sum()), max(most, int(number.max(initial=0)))
            start, undrawn = (*part.axes, first), np.zeros(error.shape, np.int64)
            worst.add(error, np.full(error.shape, tolerance), undrawn, start)
    where = ""
    if worst.points:
        *axes, shot = worst.index
        where = f"{_place(study.spec.axes, tuple(axes))}, " if axes else ""
        where += f"time {float(np.asarray(times[shot])):.4g} s"
    mean = rays / max(worst.points, 1)
    return RaysRow(
        scanner, worst.points, worst.met, worst.half_width, tolerance, where, mean, most
    )  # fmt: skip


@dataclass
class _Worst:
    """Points whose half-width is known, and that which is furthest above its tolerance."""

    points: int = 0
    met: int = 0
    over: float = -math.inf
    half_width: float = math.nan
    tolerance: float = math.nan
    draws: int = 0
    index: tuple[int, ...] = ()

    def add(
        self, width: np.ndarray, tolerance: np.ndarray, draws: np.ndarray, start: tuple[int, ...]
    ) -> None:
        """Take in some points of the grid, the first of which is at ``start``."""
        known = np.isfinite(width)
        over = np.where(known, width - tolerance, -np.inf)
        self.points += int(known.sum())
        self.met += int((over <= 0).sum() - (~known).sum())
        at = np.unravel_index(np.argmax(over), over.shape)
        if over[at] > self.over:
            self.over, self.half_width = float(over[at]), float(width[at])
            self.tolerance, self.draws = float(tolerance[at]), int(draws[at])
            self.index = tuple(first + int(i) for first, i in zip(start, at, strict=True))


def _tolerance(spec: Spec) -> np.ndarray:
    """Tolerances that broadcast over the grid."""
    for k, axis in enumerate(spec.axes):
        for member in axis.members:
            if member.path == "accuracy.tolerance":
                return np.asarray(member.values).reshape(-1, *(1,) * (len(spec.axes) - k - 1))
    return np.asarray(spec.accuracy.tolerance)


def _needed(draws: int, half_width: float, tolerance: float) -> float:
    """Draws that would bring a half-width down to a tolerance, as its square falls with them."""
    if half_width <= tolerance:
        return math.nan
    return math.ceil(draws * (half_width / tolerance) ** 2) if tolerance > 0 else math.inf


def _place(axes: tuple[Axis, ...], index: tuple[int, ...]) -> str:
    """A point of the grid in the user's units."""
    words = []
    for axis, i in zip(axes, index, strict=True):
        for member in axis.members:
            value = member.display[i]
            shown = value if isinstance(value, str) else f"{value:.4g}"
            words.append(f"{member.name} {shown} {member.units}".strip())
    return ", ".join(words) or "the point"
