"""Effects in a study: where they are called for, how much they may change, their cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import compress
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.model.effects.catalogue import EFFECTS, NAMES
from sweep.tasks.effect_selection import TILE_SHOTS, EffectSelection
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.plan import timed

if TYPE_CHECKING:
    from sweep.spec import SceneSpec, Spec

#: Tiles that are looked at; of larger grids as many as these, spread over them.
MOST_TILES = 1024

#: Tiles of a flight that are looked at, of each scanner, and places along its axes.
FLIGHT_TILES, FLIGHT_PLACES = 16, 12

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
        """Effects that are forced off though they matter."""
        for row in self.rows:
            if row.mode == "off" and row.bound > self.tolerance:
                yield (
                    f"effects.{row.name} is off and may change pd, log10 pfa or |X| by up to "
                    f"{row.bound:.2g} ({row.at}); the tolerance is {self.tolerance:g}: "
                    "say auto to have it where it matters"
                )


def effects_table(study: GridStudy | FlightStudy, *, costs: bool = True) -> EffectsTable:
    """Effects of a study: where they are simulated, as its store will tell.

    By the plans of its tiles, as many as are looked at, and of a flight at some places along its
    axes. ``costs``: whether to measure what effects of a grid cost, in a second or so.
    """
    if isinstance(study, GridStudy):
        return _of_grid(study, costs)
    return _of_flight(study)


def _of_grid(study: GridStudy, costs: bool) -> EffectsTable:
    spec, selection = study.spec, study.selection
    number = selection.tiles.n_blocks
    tiles = np.unique(np.linspace(0, number - 1, min(number, MOST_TILES)).astype(np.int64))
    kept = np.empty((len(EFFECTS), len(tiles)), bool)
    change, error = np.empty(kept.shape), np.empty(len(tiles))
    for chosen, plan in selection.plans(tiles):
        kept[:, chosen], change[:, chosen], error[chosen] = plan.kept, plan.change, plan.error
    numbers = [_numbers(selection, tile) for tile in tiles.tolist()]
    sizes = np.array([len(each) for each in numbers])
    flags = selection.absent(study.grid.parameters_at(np.concatenate(numbers)), int(sizes.sum()))
    first = np.cumsum(sizes) - sizes
    there = np.array([np.add.reduceat((flags >> k & 1) == 0, first) for k in range(len(EFFECTS))])
    return _table(
        spec,
        _Planned(kept * there, change, error),
        points=int(sizes.sum()),
        where=lambda some: _region(spec, selection, tiles[some]),
        cost=lambda name, selected: (
            _cost(spec, selection, tiles[selected], name) if costs else math.nan
        ),
        looked_at=len(tiles) / number,
    )


def _of_flight(study: FlightStudy) -> EffectsTable:
    from sweep.scenes.eyepoint_arrays import from_arrays

    found, times, shots = [], [], 0
    axes = tuple(int(axis.size) for axis in study.spec.axes)
    places = list(np.ndindex(axes))
    for eyepoints in study.eyepoint_studies():
        index = eyepoints.tiles(FLIGHT_TILES)
        seen = from_arrays(eyepoints.cast(index), eyepoints.weight)
        for k in np.unique(np.linspace(0, len(places) - 1, FLIGHT_PLACES).astype(int)).tolist():
            shots += len(index)
            part = study.scanners[eyepoints.scanner].first_part(places[k])
            planned = study.planned(part, seen, index // TILE_SHOTS)
            if planned is not None:
                plan, seeing = planned.plan, np.bincount(planned.tile)
                found.append(_Planned(plan.kept * seeing, plan.change, plan.error))
                first = np.searchsorted(planned.tile, np.arange(seeing.size))
                times.append(seen.time[planned.shots][first])
    if not found:
        tolerance = float(study.spec.accuracy.tolerance)
        return EffectsTable(rows=(), tolerance=tolerance, error=0.0, looked_at=1.0)
    time = np.concatenate(times)
    return _table(
        study.spec,
        _Planned(*(np.concatenate(each, axis=-1) for each in zip(*found, strict=True))),
        points=shots,
        where=lambda some: _times(time[some]),
        cost=lambda name, some: math.nan,
        looked_at=shots * study.spec.draws.number / study.points,
    )


class _Planned(NamedTuple):
    """Plans of m tiles."""

    simulated: np.ndarray
    """(effects, m): points at which each effect is simulated."""
    change: np.ndarray
    """(effects, m)"""
    error: np.ndarray
    """(m,)"""


def _table(
    spec: Spec | SceneSpec,
    planned: _Planned,
    *,
    points: int,
    where: Callable[[np.ndarray], str],
    cost: Callable[[str, np.ndarray], float],
    looked_at: float,
) -> EffectsTable:
    """The table, from what is kept and changed in tiles."""
    modes = spec.modes()
    rows = tuple(
        EffectRow(
            name=effect.name,
            about=effect.about,
            mode=modes[effect.name],
            share=float(simulated.sum() / points),
            where=where(simulated > 0) if simulated.any() else "",
            bound=float(changes.max()),
            at=where(np.arange(changes.size) == changes.argmax()),
            cost=cost(effect.name, simulated > 0) if simulated.any() else math.nan,
        )
        for effect, simulated, changes in zip(
            EFFECTS, planned.simulated, planned.change, strict=True
        )
    )
    tolerance, error = float(spec.accuracy.tolerance), float(planned.error.max())
    return EffectsTable(rows=rows, tolerance=tolerance, error=error, looked_at=looked_at)


def _times(times: np.ndarray) -> str:
    low, high = times.min(), times.max()
    return f"time {low:.4g} s" if low == high else f"time {low:.4g}..{high:.4g} s"


def _region(spec: Spec, selection: EffectSelection, tiles: np.ndarray) -> str:
    """The least box of the grid that holds some tiles, in the user's units."""
    slices = [selection.tiles.block(tile) for tile in tiles.tolist()]
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


def _cost(spec: Spec, selection: EffectSelection, tiles: np.ndarray, name: str) -> float:
    """Share of the time of points that an effect takes, from points with it and without."""
    if spec.draws.whole_spectra:  # what an effect costs does not go by what looks at spectra
        draws = spec.draws.model_copy(update={"method": "probabilities"})
        spec = spec.model_copy(update={"draws": draws})
    spent = total = 0.0
    for tile in tiles[np.unique(np.linspace(0, len(tiles) - 1, COST_TILES).astype(np.int64))]:
        parameters = selection.tiles.grid.parameters_at(
            numbers := _numbers(selection, int(tile), COST_POINTS)
        )
        ((_, plan),) = selection.plans(np.array([tile]))
        names = tuple(compress(NAMES, plan.kept[:, 0]))
        with_it, without = (
            min(
                sum(timed(spec, parameters, len(numbers), effects, most_draws=COST_DRAWS))
                for _ in range(ROUNDS)
            )
            for effects in (names, tuple(n for n in names if n != name))
        )
        spent += max(with_it - without, 0.0)
        total += with_it
    return spent / total


def _numbers(selection: EffectSelection, tile: int, most: int | None = None) -> np.ndarray:
    """Numbers of the points of a tile, or of some, in C order over the grid."""
    size = selection.tiles.block_size(tile)
    few = np.unique(np.linspace(0, size - 1, most or size).astype(np.int64))
    return selection.tiles.numbers(tile, few)
