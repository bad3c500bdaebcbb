"""The tables of what was promised: where it is met, and by how much it is not.

Of a grid, what is drawn; of a flight, what rays leave where the tolerance says how many they are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model.accuracy import Accuracy
from sweep.storage.locations import Location, located
from sweep.storage.opening import open_group
from sweep.tasks import studies
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.summary import done_blocks, pieces, place_words

if TYPE_CHECKING:
    from sweep.spec import Spec


@dataclass
class Row:
    """Error of a probability of detection, or of all that depends on a scanner's rays."""

    name: str
    """Of the probability or the scanner; none for a grid's beamlets, which are counted as rays."""
    points: int = 0  # computed, with a known error; of a flight shots, times places along the axes
    met: int = 0  # of these, within the tolerance
    error: float = math.nan  # of the point that is furthest above its tolerance: its half-width
    tolerance: float = math.nan  # there
    where: str = ""
    number: int = 0  # of draws, or of rays, that it has had there
    total: int = 0  # the same of all points
    most: int = 0
    index: tuple[int, ...] = ()  # place of that point in the array
    _over: float = -math.inf

    @property
    def missed(self) -> float:
        """By how much the tolerance is missed at the worst point; 0 where it is met."""
        return max(0.0, self.error - self.tolerance)

    @property
    def mean(self) -> float:
        """Draws or rays of a point."""
        return self.total / max(self.points, 1)

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

    def add(
        self, error: np.ndarray, tolerance: np.ndarray, number: np.ndarray, start: tuple[int, ...]
    ) -> None:
        """Take in some points, the first of which is at ``start``."""
        known = np.isfinite(error)
        number = np.where(known, np.nan_to_num(number), 0)
        over = np.where(known, error - tolerance, -np.inf)
        self.points += int(known.sum())
        self.met += int((over <= 0).sum() - (~known).sum())
        self.total += int(number.sum())
        self.most = max(self.most, int(number.max(initial=0)))
        at = np.unravel_index(np.argmax(over), over.shape)
        if over[at] > self._over:
            self._over, self.error = float(over[at]), float(error[at])
            self.tolerance, self.number = float(tolerance[at]), int(number[at])
            self.index = tuple(first + int(i) for first, i in zip(start, at, strict=True))


def accuracy_table(store: str | Location) -> list[Row]:
    """A row for each probability that is promised; none where nothing is drawn or computed.

    Raises
    ------
    StoreError
        Where there is no store of sweep's.
    """
    from sweep.model.outputs import PROMISED

    path = located(store)
    _, study = studies.read(path)
    if not isinstance(study, GridStudy) or not study.spec.draws.any:
        return []
    errors = {name: f"{name}_half_width" for name in PROMISED}
    return [
        row for row in _rows(path, study, errors, "n_draws", _tolerance(study.spec)) if row.points
    ]


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
        tolerance = Accuracy(_tolerance(study.spec)).for_beamlets
        tolerance = np.maximum(tolerance, Accuracy.least_rays_tolerance)
        rows = _rows(path, study, {"": "beamlets_error"}, "beamlets", tolerance)
        return [row for row in rows if row.missed]
    if not isinstance(study, FlightStudy) or not study.spec.rays_by_tolerance:
        return []
    found, group = [], open_group(path)
    for name in study.scanners:
        errors = {name: f"{name}/beamlets_error"}
        tolerance = np.asarray(study.spec.accuracy.tolerance)
        for row in _rows(path, study, errors, f"{name}/beamlets", tolerance):
            if row.points:
                times: Any = group[f"{name}/time"]
                time = f"time {float(np.asarray(times[row.index[-1]])):.4g} s"
                row.where = f"{row.where}, {time}" if study.spec.axes else time
                found.append(row)
    return found


def _rows(
    path: Location,
    study: GridStudy | FlightStudy,
    errors: Mapping[str, str],
    number: str,
    tolerance: np.ndarray,
) -> list[Row]:
    """Rows by the names of arrays of errors, and of draws or rays."""
    found, axes = [Row(name) for name in errors], study.spec.axes
    tolerance = np.broadcast_to(tolerance, study.layouts[number].shape)
    names = [number, *errors.values()]
    for place, (numbers, *widths) in pieces(path, study, names, done_blocks(path, study)):
        for row, error in zip(found, widths, strict=True):
            row.add(error, tolerance[place], numbers, tuple(part.start for part in place))
    for row in found:
        if row.points:
            row.where = ", ".join(place_words(axes, row.index[: len(axes)])) or "the point"
    return found


def _tolerance(spec: Spec) -> np.ndarray:
    """Tolerances that broadcast over the grid."""
    for k, axis in enumerate(spec.axes):
        for member in axis.members:
            if member.path == "accuracy.tolerance":
                return np.asarray(member.values).reshape(-1, *(1,) * (len(spec.axes) - k - 1))
    return np.asarray(spec.accuracy.tolerance)
