"""Plans of studies, before anything runs: points, blocks, bytes, time, memory, effects."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import psutil

from sweep.model.effects.catalogue import EFFECTS, NAMES
from sweep.model.outputs import SHOTS
from sweep.scenes.eyepoint_arrays import from_arrays
from sweep.storage.locations import Location, eyepoints_path
from sweep.tasks import cluster
from sweep.tasks.eyepoint_study import EyepointStudy
from sweep.tasks.flight_study import FlightStudy, Part
from sweep.tasks.grid_study import (
    EffectSelection,
    GridStudy,
    Selected,
    evaluate_points,
    select,
    with_few_draws,
)
from sweep.tasks.memory import (
    point_bytes,
    refuse_too_large,
    refuse_too_large_blocks,
    refuse_too_large_scene,
    this_machine,
)
from sweep.tasks.studies import study_of
from sweep.tasks.study import TILE_SHOTS, Value

if TYPE_CHECKING:
    from sweep.model.eyepoints import Eyepoints
    from sweep.spec import SceneSpec, Spec
    from sweep.tasks.study import Results

#: Time that measuring may take [s], and places of the grid that it looks at.
MEASURING = 1.0
PLACES = 16

#: Time that measuring a scanner may take [s], about.
MEASURING_SCANNER = 0.5

#: Draws of a point while measuring.
MOST_DRAWS = 1000

#: The same, of whole spectra.
MOST_SPECTRA = 10

#: What a worker takes to start [s], and to write a chunk [s].
START = 3.0
WRITE_CHUNK = 2e-3


@dataclass(frozen=True, kw_only=True)
class ScannerPlan:
    """Plan of one scanner."""

    name: str
    cycles: int
    shots: int
    rays: int
    is_cast: bool  # eyepoints are there already
    seconds_a_ray: float  # on one worker, measured
    seconds_a_draw: float  # of one shot, with radiometry and navigation


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Plan of a study; scanners and reports are those of a flight."""

    points: int
    blocks: int
    block_shape: dict[str, int]  # points along each axis; none of a flight
    chunks: int
    bytes: int  # before compression, of all results
    workers: int
    seconds_a_point: float  # on one worker, measured
    seconds: float  # of the whole study, estimated
    worker_memory: int  # bytes, estimated
    scanners: tuple[ScannerPlan, ...] = ()
    reports: tuple[str, ...] = ()  # what was mended as the scene was loaded

    @property
    def work(self) -> float:
        """Time on one core [s]."""
        return self.points * self.seconds_a_point


def plan(
    spec: Spec | SceneSpec, *, store: Location | None = None, workers: int | None = None
) -> Plan:
    """Plan a study to be stored at a place, by its size and a second of measuring points."""
    refuse_too_large(spec, this_machine())
    study = study_of(spec, (store or Path("nowhere.zarr")).absolute())
    refuse_too_large_blocks(study, this_machine())
    scanners: tuple[ScannerPlan, ...] = ()
    reports: tuple[str, ...] = ()
    shape = {}
    if isinstance(study, FlightStudy):
        eyepoints = study.eyepoint_studies()
        scanners = tuple(_scanner(study, each) for each in eyepoints)
        rays = sum(0 if s.is_cast else s.rays * s.seconds_a_ray for s in scanners)
        looking = sum(
            grid.points * s.seconds_a_draw for grid, s in zip(study.grids, scanners, strict=True)
        )
        refuse_too_large_scene(study.spec, this_machine())
        each, reports = (rays + looking) / study.points, eyepoints[0].world.reports
    else:
        each = measured(study)
        shape = dict(zip(study.grid.dims, study.grid.block_shape, strict=True))
    workers = workers or spec.execution.workers or cluster.cores()
    work = study.points * each + study.n_chunks * WRITE_CHUNK
    return Plan(
        points=study.points,
        blocks=study.n_blocks,
        block_shape=shape,
        chunks=study.n_chunks,
        bytes=study.bytes,
        workers=workers,
        seconds_a_point=each,
        seconds=START + work / min(workers, study.n_blocks),
        # with the model loaded, and a block's results twice: its own, and those being encoded
        worker_memory=psutil.Process().memory_info().rss
        + 2 * study.block_bytes
        + point_bytes(spec),
        scanners=scanners,
        reports=reports,
    )


def measured(study: GridStudy) -> float:
    """Processor time of a point [s], measured on points spread over the grid.

    Whole sets of points that share a geometry are taken, so that sharing shows as it will.
    Points that miss an accuracy after few draws are taken to reach their limit.
    """
    study.compile()
    blocks = _places(study)

    def look(rows: int) -> Round:
        for block in blocks:  # effects are planned once for many points, and are not timed
            study.selection.of_block(block, _some_points(study, block, rows))
        begun = time.process_time()
        found = [_evaluate_some(study, block, rows) for block in blocks]
        taken = time.process_time() - begun
        points, left_out = (sum(each) for each in zip(*found, strict=True))
        return Round(points, (taken + left_out,))

    enough = _enough(look, study.grid.points, MEASURING)
    return enough.parts[0] / enough.points


def _places(study: GridStudy) -> list[int]:
    """Blocks spread over the grid, fewer where points take long: looked at once.

    That loads what is compiled, which takes longer than many points.
    """
    blocks: list[int] = []
    last, begun = study.grid.n_blocks - 1, time.process_time()
    for k in sorted(range(PLACES), key=lambda k: -math.gcd(k, PLACES)):  # 0, the middle, quarters
        block = k * last // (PLACES - 1)
        if block not in blocks:
            _evaluate_some(study, block, 1)
            blocks.append(block)
        if time.process_time() - begun > 2 * MEASURING:
            break
    return blocks


class Round(NamedTuple):
    """A look at some points."""

    points: int
    parts: tuple[float, ...]  # time of each kind of work [s]


def _enough(look: Callable[[int], Round], points: int, seconds: float) -> Round:
    """Compute so much of a study that the time can be measured, or all of it."""
    from numba.core.event import install_recorder

    amount, begun = 1, time.perf_counter()
    while True:  # once at the least, however long this process has been held up
        with install_recorder("numba:compile") as compiled:
            found = look(amount)
        now = time.perf_counter()
        if compiled.buffer:  # a round that compiles tells nothing of those that do not
            begun = now
            continue
        if found.points >= points or now - begun > seconds / 3:
            return found
        amount *= 4


def _some_points(study: GridStudy, block: int, rows: int) -> np.ndarray:
    """Points of a block, by number within it: so many whole sets that share a geometry."""
    grid, sharing = study.grid, 1
    for size, geometric in zip(grid.extent(block), grid.geometric, strict=True):
        sharing *= 1 if geometric else size
    sets = grid.geometry_order(block).reshape(-1, sharing)
    few = np.unique(np.linspace(0, len(sets) - 1, rows).astype(np.int64))
    return sets[few].ravel()


def _evaluate_some(study: GridStudy, block: int, rows: int) -> tuple[int, float]:
    """Return the number of points evaluated, and the time [s] of their skipped draws."""
    spec, left_out = study.spec, 0.0
    chosen = _some_points(study, block, rows)
    parameters = study.grid.parameters(block)
    for members, effects in study.selection.of_block(block, chosen).groups():
        part = select(parameters, chosen[members])
        most = MOST_SPECTRA if spec.draws.whole_spectra else MOST_DRAWS
        left_out += timed(spec, part, len(members), effects, most_draws=most).left_out
    return len(chosen), left_out


class Seconds(NamedTuple):
    """Time of some points on one core."""

    taken: float  # measured
    left_out: float
    """Of draws that were left out: of all up to their limit, of points that are not settled."""


def timed(
    spec: Spec,
    parameters: Mapping[str, Value],
    count: int,
    effects: Collection[str],
    *,
    most_draws: int,
) -> Seconds:
    """Time of some points, each drawn so many times at the most; as of :func:`evaluate_points`."""
    fewer = with_few_draws(spec, most_draws)
    if spec.draws.whole_spectra:
        evaluate_points(with_few_draws(spec, 1), parameters, count, effects)  # makes tables once
    begun = time.process_time()
    found = evaluate_points(fewer, parameters, count, effects)
    taken = time.process_time() - begun
    most, drawn = (max(s.draws.number, s.draws.limit) for s in (spec, fewer))
    if most == drawn:
        return Seconds(taken, 0.0)
    if spec.draws.whole_spectra:  # a point's spectrum without noise costs as much as many draws
        begun = time.process_time()
        evaluate_points(with_few_draws(spec, 1), parameters, count, effects)
        alone = time.process_time() - begun
        each = max(taken - alone, 0.0) / (drawn - 1)
        return Seconds(taken, each * (most - drawn))
    unsettled = float(np.mean(found["accuracy_missed"] > 0)) if spec.draws.adaptive else 1.0
    return Seconds(taken, taken * unsettled * (most / drawn - 1))


def _scanner(study: FlightStudy, eyepoints: EyepointStudy) -> ScannerPlan:
    blocks = study.scanners[eyepoints.scanner]
    part = blocks.part(0)
    part = part._replace(draws=part.draws[:MOST_DRAWS])

    def look(tiles: int) -> Round:
        begun = time.process_time()
        numbers = eyepoints.spread(tiles)
        seen = eyepoints.see(numbers)
        cast = time.process_time()
        shots = from_arrays(seen, eyepoints.weight)
        study.look(part, seen, shots, study.select(part, shots, numbers), numbers)
        looked = time.process_time()
        return Round(len(numbers), (cast - begun, looked - cast))

    look(1)  # loads what is compiled, which takes longer than many points
    found = _enough(look, eyepoints.points, MEASURING_SCANNER)
    casting, looking = found.parts
    return ScannerPlan(
        name=eyepoints.scanner,
        cycles=eyepoints.cycles,
        shots=eyepoints.points,
        rays=eyepoints.rays,
        is_cast=eyepoints_path(study.path, eyepoints.id).exists(),
        seconds_a_ray=casting / eyepoints.rays_in(found.points),
        seconds_a_draw=looking / (found.points * len(part.draws)),
    )


#: Tiles that are looked at; of larger grids as many as these, spread over them.
MOST_TILES = 1024

#: Tiles of a flight that are looked at, of each scanner, and places along its axes.
FLIGHT_TILES, FLIGHT_PLACES = 16, 12

#: Tiles on which an effect's cost is measured, points of each, and draws of a point; in flights
#: scanners and places along the axes, and shots of each. Rounds: of short work, and of long.
COST_TILES, COST_POINTS, COST_DRAWS, COST_LOOKS = 4, 24, 20, 3
ROUNDS, LEAST_ROUNDS = 5, 3

#: Spread of an effect's cost over the rounds, relative to it, up to which the cost is known. It is
#: about twice the error of the median.
REPRODUCIBLE = 0.1

#: Time [s] of a round of measuring an effect's cost that is long enough.
COST_SECONDS = 0.1


@dataclass(frozen=True, kw_only=True)
class EffectRow:
    """An effect in a study."""

    name: str
    mode: str
    share: float  # of the points at which it is simulated
    where: str  # the part of the study that holds these
    bound: float  # largest change that it may make anywhere: of pd, log10 pfa or a magnitude
    at: str  # where that is
    cost: float  # share of a point's time that it takes where it is simulated; nan: not known


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
    """Effects of a study, by the plans of its tiles, and what they cost, if asked."""
    if isinstance(study, GridStudy):
        return _of_grid(study, costs)
    return _of_flight(study, costs)


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
    drawn = spec
    if spec.draws.whole_spectra:  # what an effect costs does not go by what looks at spectra
        draws = spec.draws.model_copy(update={"method": "probabilities"})
        drawn = spec.model_copy(update={"draws": draws})
    sample = _sampling(drawn, selection)
    return _table(
        spec,
        _Planned(kept * there, change, error),
        points=int(sizes.sum()),
        where=lambda some: _region(spec, selection, tiles[some]),
        cost=lambda name, selected: (
            _cost(drawn, sample, tiles[selected], name) if costs else math.nan
        ),
        looked_at=len(tiles) / number,
    )


def _of_flight(study: FlightStudy, costs: bool) -> EffectsTable:
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
    time, looks = np.concatenate(times), _looks(study) if costs else []
    return _table(
        study.spec,
        _Planned(*(np.concatenate(each, axis=-1) for each in zip(*found, strict=True))),
        points=shots,
        where=lambda some: _times(time[some]),
        cost=lambda name, some: _flight_cost(study, looks, name),
        looked_at=shots * study.spec.draws.number / study.points,
    )


class _Planned(NamedTuple):
    """Plans of m tiles."""

    simulated: np.ndarray  # (effects, m): points at which each effect is simulated
    change: np.ndarray  # (effects, m)
    error: np.ndarray  # (m,)


def _table(
    spec: Spec | SceneSpec,
    planned: _Planned,
    *,
    points: int,
    where: Callable[[np.ndarray], str],
    cost: Callable[[str, np.ndarray], float],
    looked_at: float,
) -> EffectsTable:
    """Return the table, from what is kept and changed in tiles."""
    modes = spec.modes()
    rows = tuple(
        EffectRow(
            name=effect.name,
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
    """Return the smallest box of the grid that holds some tiles, in the user's units."""
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


class _Sample(NamedTuple):
    """Points of a tile, with all effects of its plan."""

    parameters: Mapping[str, Value]
    number: int
    effects: tuple[str, ...]


def _sampling(spec: Spec, selection: EffectSelection) -> Callable[[int], _Sample]:
    """Choice of points of a tile, made once: of few, or of one where that takes long."""

    @cache
    def sample(tile: int) -> _Sample:
        ((_, plan),) = selection.plans(np.array([tile]))
        effects = tuple(compress(NAMES, plan.kept[:, 0]))
        few, one = (_numbers(selection, tile, most) for most in (COST_POINTS, 1))
        parameters = selection.tiles.grid.parameters_at(one)
        if _seconds_of(spec, parameters, 1, effects) < COST_SECONDS / 2:
            return _Sample(selection.tiles.grid.parameters_at(few), len(few), effects)
        return _Sample(parameters, 1, effects)

    return sample


def _seconds_of(
    spec: Spec, parameters: Mapping[str, Value], number: int, effects: Collection[str]
) -> float:
    """Time of some points [s] with some effects."""
    return sum(timed(spec, parameters, number, effects, most_draws=COST_DRAWS))


Clock = Callable[[], float]
"""Measure some work once: its time [s]."""


def _cost(spec: Spec, sample: Callable[[int], _Sample], tiles: np.ndarray, name: str) -> float:
    """Share of the time of points that an effect takes, from points with it and without."""

    def clocks(tile: int) -> tuple[Clock, Clock]:
        parameters, number, effects = sample(tile)
        without = tuple(n for n in effects if n != name)
        return (
            lambda: _seconds_of(spec, parameters, number, effects),
            lambda: _seconds_of(spec, parameters, number, without),
        )

    return reproducible_share(map(clocks, _spread(tiles.tolist(), COST_TILES)))


def reproducible_share(clocks: Iterable[tuple[Clock, Clock]]) -> float:
    """Share of the time that an effect takes; nan where rounds of measuring disagree on it.

    Parameters
    ----------
    clocks
        Clocks of the same work with the effect and without. As many are read as take
        :data:`COST_SECONDS` together.

    Returns
    -------
    float
        Median over rounds, each of which takes one reading with the effect and one without by
        turns. nan if the rounds differ by more than :data:`REPRODUCIBLE` of it.
    """
    measured, total = [], 0.0
    for with_it, without in clocks:
        without()  # loads what is compiled
        total += with_it()
        measured.append((with_it, without))
        if total > COST_SECONDS:
            break
    shares, begun = [], time.process_time()
    for number in range(ROUNDS):
        if number >= LEAST_ROUNDS and time.process_time() - begun > ROUNDS * COST_SECONDS:
            break
        times = np.array([(with_it(), without()) for with_it, without in measured])
        whole, rest = times.sum(axis=0) if measured else (0.0, 0.0)
        shares.append((whole - rest) / whole if whole > 0 else math.nan)
    middle = float(np.median(shares))
    return middle if np.ptp(shares) <= REPRODUCIBLE * middle else math.nan


class _Look(NamedTuple):
    """Arguments of :meth:`FlightStudy.look`, of whole cycles of a scanner."""

    part: Part
    shots: Results
    eyepoints: Eyepoints
    selected: Selected
    numbers: np.ndarray

    def some(self, rows: np.ndarray, *, less: np.uint32) -> _Look:
        """Select shots, without the effects of some flags."""
        shots = {name: self.shots[name][rows] for name in SHOTS}
        flags = self.selected.flags[rows] & ~less
        selected = Selected(flags, self.selected.error[rows])
        return _Look(self.part, shots, self.eyepoints.some(rows), selected, self.numbers[rows])


def _looks(study: FlightStudy) -> list[_Look]:
    """Cycles spread over each scanner's flight, at the ends of its axes, with few draws."""
    ends = {tuple(k * (int(axis.size) - 1) for axis in study.spec.axes) for k in (0, 1)}
    found = []
    for eyepoints in study.eyepoint_studies():
        numbers = eyepoints.spread(FLIGHT_TILES)
        seen = eyepoints.see(numbers)
        shots = from_arrays(seen, eyepoints.weight)
        for place in sorted(ends):
            part = study.scanners[eyepoints.scanner].first_part(place)
            part = part._replace(draws=range(min(len(part.draws), COST_DRAWS)))
            selected = study.select(part, shots, numbers)
            found.append(_Look(part, seen, shots, selected, numbers))
    return found


def _flight_cost(study: FlightStudy, looks: Sequence[_Look], name: str) -> float:
    """Share of the time of shots that an effect takes, from cycles with it and without."""
    nothing, flag = np.uint32(0), np.uint32(1 << NAMES.index(name))

    def clocks(look: _Look) -> tuple[Clock, Clock]:
        each = study.scanners[look.part.scanner].shots_a_cycle
        having = np.flatnonzero((look.selected.flags & flag).reshape(-1, each).any(axis=1))
        for number in (1, -(-COST_POINTS // each)):
            cycles = np.array(_spread(having, number))
            if _seconds(study, look, cycles, less=nothing) > COST_SECONDS / 2:  # so few tell enough
                break
        return (
            lambda: _seconds(study, look, cycles, less=nothing),
            lambda: _seconds(study, look, cycles, less=flag),
        )

    there = [look for look in looks if (look.selected.flags & flag).any()]
    return reproducible_share(map(clocks, _spread(there, COST_LOOKS)))


def _spread(items: Sequence[Any] | np.ndarray, most: int) -> list[Any]:
    """Select some items, from the first to the last."""
    few = np.linspace(0, len(items) - 1, min(most, len(items))).astype(int)
    return [items[k] for k in few]


def _seconds(study: FlightStudy, look: _Look, cycles: np.ndarray, *, less: np.uint32) -> float:
    """Time of some cycles [s] without the effects of some flags."""
    each = study.scanners[look.part.scanner].shots_a_cycle
    some = look.some((cycles[:, None] * each + np.arange(each)).ravel(), less=less)

    begun = time.process_time()
    study.look(*some)
    return time.process_time() - begun


def _numbers(selection: EffectSelection, tile: int, most: int | None = None) -> np.ndarray:
    """Numbers of the points of a tile, or of some, in C order over the grid."""
    size = selection.tiles.block_size(tile)
    few = np.unique(np.linspace(0, size - 1, most or size).astype(np.int64))
    return selection.tiles.numbers(tile, few)
