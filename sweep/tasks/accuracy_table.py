"""The table of what was promised of what is drawn: where it is met, and by how much it is not."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sweep.storage.locations import Location, located, read_array
from sweep.tasks import studies
from sweep.tasks.grid_study import GridStudy

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
    _, study = studies.read(located(store))
    if not isinstance(study, GridStudy) or not study.spec.draws.any:
        return []
    return list(_rows(located(store), study.spec))


def _rows(store: Location, spec: Spec) -> Iterator[AccuracyRow]:
    from sweep.model.outputs import PROMISED

    def read(name: str) -> np.ndarray:
        return np.asarray(read_array(store / name)[...])

    draws = read("n_draws")
    tolerance = _tolerance(spec)
    for name in PROMISED:
        width = read(f"{name}_half_width")
        if not (known := np.isfinite(width)).any():
            continue
        over = np.where(known, width - tolerance, -np.inf)
        worst = np.unravel_index(np.argmax(over), over.shape)
        allowed = float(np.broadcast_to(tolerance, over.shape)[worst])
        yield AccuracyRow(
            name=name,
            points=int(known.sum()),
            met=int((over <= 0).sum() - (~known).sum()),
            half_width=float(width[worst]),
            tolerance=allowed,
            where=_place(spec.axes, worst),
            draws=int(draws[worst]),
            needed=_needed(int(draws[worst]), float(width[worst]), allowed),
        )


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


def _place(axes: tuple[Axis, ...], index: tuple[np.intp, ...]) -> str:
    """A point of the grid in the user's units."""
    words = []
    for axis, i in zip(axes, index, strict=True):
        for member in axis.members:
            value = member.display[int(i)]
            shown = value if isinstance(value, str) else f"{value:.4g}"
            words.append(f"{member.name} {shown} {member.units}".strip())
    return ", ".join(words) or "the point"
