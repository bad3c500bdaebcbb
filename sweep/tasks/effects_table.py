"""Which effects a study calls for, where, how much they may change, and what they cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sweep.tasks.calling import TILE_SHOTS, Calling
from sweep.tasks.grid import Grid
from sweep.tasks.plan import timed

if TYPE_CHECKING:
    from sweep.spec import Spec
    from sweep.tasks.flight_study import FlightStudy

#: Tiles that are looked at; of larger grids as many as these, spread over them.
MOST_TILES = 1024

#: Tiles of a flight that are looked at, of each scanner.
FLIGHT_TILES = 16

#: Tiles on which an effect's cost is measured, points of each, draws of a point, and rounds, of
#: which the best counts.
COST_TILES, COST_POINTS, COST_DRAWS, ROUNDS = 4, 24, 20, 3


@dataclass(frozen=True, kw_only=True)
class EffectRow:
    """An effect in a study."""

    name: str
    about: str
    mode: str
    share: float  # of the points at which it is simulated
    where: str  # the part of the study that holds these
    bound: float  # largest change that it may make anywhere: of pd, log10 pfa or a magnitude
    at: str  # where that is
    cost: float  # share of a point's time that it takes where it is simulated; nan where it is not


@dataclass(frozen=True, kw_only=True)
class EffectsTable:
    """All effects in a study."""

    rows: tuple[EffectRow, ...]
    tolerance: float
    error: float  # largest sum of what is left out
    looked_at: float  # share of the tiles

    def warnings(self) -> Iterator[str]:
        """What is forced off though it matters."""
        for row in self.rows:
            if row.mode == "off" and row.bound > self.tolerance:
                yield (
                    f"effects.{row.name} is off and may change pd, log10 pfa or |X| by up to "
                    f"{row.bound:.2g} ({row.at}); the tolerance is {self.tolerance:g}: "
                    "say auto to have it where it matters"
                )


def effects_table(spec: Spec, *, costs: bool = True) -> EffectsTable:
    """Effects of a study of a grid, from the plans of its tiles.

    Parameters
    ----------
    spec
        The study.
    costs
        Whether to measure what effects cost, in a second or so.
    """
    from sweep.model.effects.catalogue import EFFECTS

    calling = Calling(spec, Grid(spec))
    number = calling.tiles.number
    tiles = np.unique(np.linspace(0, number - 1, min(number, MOST_TILES)).astype(np.int64))
    kept = np.empty((len(EFFECTS), len(tiles)), bool)
    change, error = np.empty(kept.shape), np.empty(len(tiles))
    for chosen, plan in calling.plans(tiles):
        kept[:, chosen], change[:, chosen], error[chosen] = plan.kept, plan.change, plan.error

    def cost(name: str, called: np.ndarray) -> float:
        return _cost(spec, calling, tiles[called], name) if costs else math.nan

    return EffectsTable(
        rows=_rows(
            spec.modes(), kept, change,
            weight=np.array([_points(calling, tile) for tile in tiles.tolist()]),
            where=lambda some: _region(spec, calling, tiles[some]),
            cost=cost,
        ),
        tolerance=float(spec.accuracy.tolerance),
        error=float(error.max()),
        looked_at=len(tiles) / number,
    )  # fmt: skip


def flight_effects_table(study: FlightStudy) -> EffectsTable:
    """Effects of a study of a scene, at the first place along its axes.

    Parameters
    ----------
    study
        The study.
    """
    from sweep.scenes.eyepoint_arrays import from_arrays

    plans, times, weights, total = [], [], [], 0
    for eyepoints in study.eyepoint_studies():
        index = eyepoints.tiles(FLIGHT_TILES)
        seen = from_arrays(eyepoints.cast(index), eyepoints.weight)
        part = study.scanners[eyepoints.scanner].part(0)
        planned = study.planned(part, seen, index // TILE_SHOTS)
        total += eyepoints.points
        if planned is not None:
            plans.append(planned.plan)
            first = np.searchsorted(planned.tile, np.arange(planned.tile[-1] + 1))
            times.append(seen.time[planned.shots][first])
            weights.append(np.bincount(planned.tile))
    tolerance = float(study.spec.accuracy.tolerance)
    if not plans:
        return EffectsTable(rows=(), tolerance=tolerance, error=0.0, looked_at=1.0)
    time_, weight = np.concatenate(times), np.concatenate(weights)
    return EffectsTable(
        rows=_rows(
            study.spec.modes(),
            np.concatenate([plan.kept for plan in plans], axis=1),
            np.concatenate([plan.change for plan in plans], axis=1),
            weight=weight,
            where=lambda some: _times(time_[some]),
            cost=lambda name, called: math.nan,
        ),
        tolerance=tolerance,
        error=max(float(plan.error.max()) for plan in plans),
        looked_at=float(weight.sum() / total),
    )


def _rows(
    modes: Mapping[str, str],
    kept: np.ndarray,
    change: np.ndarray,
    *,
    weight: np.ndarray,
    where: Callable[[np.ndarray], str],
    cost: Callable[[str, np.ndarray], float],
) -> tuple[EffectRow, ...]:
    """A row for each effect, from what is kept and changed in tiles of so many points each."""
    from sweep.model.effects.catalogue import EFFECTS

    return tuple(
        EffectRow(
            name=effect.name,
            about=effect.about,
            mode=modes[effect.name],
            share=float(weight[called].sum() / weight.sum()),
            where=where(called) if called.any() else "",
            bound=float(changes.max()),
            at=where(np.arange(changes.size) == changes.argmax()),
            cost=cost(effect.name, called) if called.any() else math.nan,
        )
        for effect, called, changes in zip(EFFECTS, kept, change, strict=True)
    )


def _times(times: np.ndarray) -> str:
    low, high = times.min(), times.max()
    return f"time {low:.4g} s" if low == high else f"time {low:.4g}..{high:.4g} s"


def _points(calling: Calling, tile: int) -> int:
    return int(np.prod([s.stop - s.start for s in calling.tiles.points(tile)]))


def _region(spec: Spec, calling: Calling, tiles: np.ndarray) -> str:
    """The least box of the grid that holds some tiles, in the user's units."""
    slices = [calling.tiles.points(tile) for tile in tiles.tolist()]
    words = []
    for k, axis in enumerate(spec.axes):
        first, stop = min(s[k].start for s in slices), max(s[k].stop for s in slices)
        for member in axis.members:
            seen = list(dict.fromkeys(member.display[first:stop].tolist()))
            unit = f" {member.units}" if member.units else ""
            if isinstance(seen[0], str):
                words.append(f"{member.name} {', '.join(seen)}")
            elif len(seen) == 1:
                words.append(f"{member.name} {seen[0]:g}{unit}")
            else:
                words.append(f"{member.name} {min(seen):g}..{max(seen):g}{unit}")
    return ", ".join(words) or "the point"


def _cost(spec: Spec, calling: Calling, tiles: np.ndarray, name: str) -> float:
    """Share of the time of points that an effect takes, from points with it and without."""
    chosen = tiles[np.unique(np.linspace(0, len(tiles) - 1, COST_TILES).astype(np.int64))]
    spent = total = 0.0
    for tile in chosen.tolist():
        numbers, names = _some_points(calling, tile)
        best = {}
        for effects in (names, tuple(n for n in names if n != name)):
            best[effects] = min(_timed(spec, calling, numbers, effects) for _ in range(ROUNDS))
        spent += best[names] - min(best.values())
        total += best[names]
    return spent / total


def _some_points(calling: Calling, tile: int) -> tuple[np.ndarray, tuple[str, ...]]:
    """Numbers of some points of a tile, and the effects that it calls for."""
    from sweep.model.effects.catalogue import NAMES

    slices = calling.tiles.points(tile)
    shape = tuple(s.stop - s.start for s in slices)
    few = np.unique(np.linspace(0, int(np.prod(shape)) - 1, COST_POINTS).astype(np.int64))
    along = np.unravel_index(few, shape) if shape else ()
    at = [i + s.start for i, s in zip(along, slices, strict=True)]
    numbers = np.ravel_multi_index(at, calling.tiles.grid.shape) if at else few
    ((_, plan),) = calling.plans(np.array([tile]))
    return numbers, tuple(n for n, kept in zip(NAMES, plan.kept[:, 0], strict=True) if kept)


def _timed(spec: Spec, calling: Calling, numbers: np.ndarray, effects: tuple[str, ...]) -> float:
    parameters = calling.tiles.grid.parameters_at(numbers)
    if spec.draws.whole_spectra:  # what an effect costs does not go by what looks at spectra
        draws = spec.draws.model_copy(update={"method": "probabilities"})
        spec = spec.model_copy(update={"draws": draws})
    return sum(timed(spec, parameters, len(numbers), effects, most_draws=COST_DRAWS))
