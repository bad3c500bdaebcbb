"""What a study will take, before anything runs: points, blocks, bytes, time, memory."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import psutil

from sweep.storage.locations import Location
from sweep.tasks import cluster
from sweep.tasks.calling import Calling
from sweep.tasks.evaluate import compile_kernels, evaluate_points, select, with_few_draws
from sweep.tasks.eyepoint_study import EyepointStudy, eyepoints_path
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid import Grid, Value
from sweep.tasks.grid_study import further_dims, output_names

if TYPE_CHECKING:
    from sweep.spec import SceneSpec, Spec

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
class Plan:
    """What a study will take."""

    points: int
    blocks: int
    block_shape: dict[str, int]  # points along each axis
    chunks: int
    bytes: int  # before compression, of all results
    workers: int
    seconds_a_point: float  # on one worker, measured
    seconds: float  # of the whole study, estimated
    worker_memory: int  # bytes, estimated


def plan(spec: Spec, *, workers: int | None = None) -> Plan:
    """What a study will take, from its size and a second of measuring its own points.

    Parameters
    ----------
    spec
        The study.
    workers
        Workers it would run on; default those of the spec, else all cores.
    """
    grid, names = Grid(spec), output_names(spec)
    workers = workers or spec.execution.workers or cluster.cores()
    each = measured(spec, grid)
    writing = grid.n_blocks * len(names) * WRITE_CHUNK
    busy = min(workers, grid.n_blocks)
    return Plan(
        points=grid.points,
        blocks=grid.n_blocks,
        block_shape=dict(zip(grid.dims, grid.block_shape, strict=True)),
        chunks=grid.n_blocks * len(names),
        bytes=grid.points * point_bytes(spec, names),
        workers=workers,
        seconds_a_point=each,
        seconds=START + (grid.points * each + writing) / busy,
        worker_memory=worker_memory(spec, grid, names),
    )


def point_bytes(spec: Spec, names: list[str]) -> int:
    """Bytes of one point's results: 8 an output, or as often as that has a further dimension."""
    further = further_dims(spec)
    return 8 * sum(further[name][1] if name in further else 1 for name in names)


def worker_memory(spec: Spec, grid: Grid, names: list[str]) -> int:
    """Bytes a worker takes: as this process does with the model loaded, and two copies of a block's
    results, its own and the one being encoded.
    """
    block = grid.block_size(0) * point_bytes(spec, names)
    return psutil.Process().memory_info().rss + 2 * block


def measured(spec: Spec, grid: Grid) -> float:
    """Time a point takes on one core [s], measured on points spread over the grid.

    Whole sets of points that share a geometry are taken, so that sharing shows as it will. Where
    points are drawn until their accuracy is met, those that are not after few draws are taken to
    reach their limit.
    """
    from numba.core.event import install_recorder

    compile_kernels(spec, grid)
    calling = Calling(spec, grid)
    rows, begun = 1, time.perf_counter()
    while True:  # once at the least, however long this process has been held up
        points, left_out = 0, 0.0
        round_begun = time.perf_counter()
        with install_recorder("numba:compile") as compiled:
            for block in np.unique(np.linspace(0, grid.n_blocks - 1, PLACES).astype(np.int64)):
                more, seconds = _evaluate_some(spec, calling, int(block), rows)
                points, left_out = points + more, left_out + seconds
        now = time.perf_counter()
        if compiled.buffer:  # a round that compiles tells nothing of those that do not
            begun = now
            continue
        taken = now - round_begun
        if points >= grid.points or taken > MEASURING / 4 or now - begun > MEASURING / 2:
            return (taken + left_out) / points
        rows *= 4


def _evaluate_some(spec: Spec, calling: Calling, block: int, rows: int) -> tuple[int, float]:
    """Number of points evaluated, and the time [s] that draws left out of them would take."""
    left_out = 0.0
    grid, sharing = calling.tiles.grid, 1
    for size, geometric in zip(grid.extent(block), grid.geometric, strict=True):
        sharing *= 1 if geometric else size
    sets = grid.geometry_order(block).reshape(-1, sharing)
    few = np.unique(np.linspace(0, len(sets) - 1, rows).astype(np.int64))
    chosen = sets[few].ravel()
    parameters = grid.parameters(block)
    for members, effects in calling.of_block(block).some(chosen).groups():
        part = select(parameters, chosen[members])
        most = MOST_SPECTRA if spec.draws.whole_spectra else MOST_DRAWS
        left_out += timed(spec, part, len(members), effects, most_draws=most).left_out
    return len(chosen), left_out


class Seconds(NamedTuple):
    """Time of some points on one core."""

    taken: float
    """Measured."""
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
    """Time of some points, each drawn so many times at the most.

    The other parameters are those of :func:`evaluate_points`.
    """
    fewer = with_few_draws(spec, most_draws)
    if spec.draws.whole_spectra:
        evaluate_points(with_few_draws(spec, 1), parameters, count, effects)  # makes tables once
    begun = time.perf_counter()
    found = evaluate_points(fewer, parameters, count, effects)
    taken = time.perf_counter() - begun
    most, drawn = (max(s.draws.number, s.draws.limit) for s in (spec, fewer))
    if most == drawn:
        return Seconds(taken, 0.0)
    if spec.draws.whole_spectra:  # a point's spectrum without noise costs as much as many draws
        begun = time.perf_counter()
        evaluate_points(with_few_draws(spec, 1), parameters, count, effects)
        alone = time.perf_counter() - begun
        each = max(taken - alone, 0.0) / (drawn - 1)
        return Seconds(taken, each * (most - drawn))
    unsettled = float(np.mean(found["accuracy_missed"] > 0)) if spec.draws.adaptive else 1.0
    return Seconds(taken, taken * unsettled * (most / drawn - 1))


@dataclass(frozen=True, kw_only=True)
class ScannerPlan:
    """What one scanner will take."""

    name: str
    cycles: int
    shots: int
    rays: int
    is_cast: bool  # eyepoints are there already
    seconds_a_ray: float  # on one worker, measured
    seconds_a_draw: float  # of one shot, with radiometry and navigation


@dataclass(frozen=True, kw_only=True)
class ScenePlan:
    """What a study of a scene will take."""

    scanners: tuple[ScannerPlan, ...]
    draws: int
    places: int  # along the axes
    blocks: int
    chunks: int
    bytes: int  # before compression, of the point clouds
    workers: int
    seconds: float  # of the whole study, estimated
    worker_memory: int  # bytes, estimated
    reports: tuple[str, ...]  # what was mended as the scene was loaded


def scene_plan(spec: SceneSpec, *, store: Location, workers: int | None = None) -> ScenePlan:
    """What a study of a scene will take, from its size and from measuring some of its own shots.

    Parameters
    ----------
    spec
        The study.
    store
        Where it would be stored: eyepoints are looked for beside it.
    workers
        Workers it would run on; default those of the spec, else all cores.
    """
    study = FlightStudy(spec, store.absolute())
    eyepoints = list(study.eyepoint_studies())
    scanners = tuple(_scanner(study, each) for each in eyepoints)
    arrays = [a for a in study.arrays() if a.values is None]
    chunks = sum(
        math.prod(-(-n // c) for n, c in zip(a.shape, a.chunks, strict=True)) for a in arrays
    )
    workers = workers or spec.execution.workers or cluster.cores()
    places = math.prod(int(axis.size) for axis in spec.axes)
    draws = int(spec.draws.number)
    work = sum(
        (0 if s.is_cast else s.rays * s.seconds_a_ray) + s.shots * draws * places * s.seconds_a_draw
        for s in scanners
    )
    block = sum(math.prod(a.chunks) * np.dtype(a.dtype).itemsize for a in arrays)
    return ScenePlan(
        scanners=scanners,
        draws=draws,
        places=places,
        blocks=study.n_blocks,
        chunks=chunks,
        bytes=sum(math.prod(a.shape) * np.dtype(a.dtype).itemsize for a in arrays),
        workers=workers,
        seconds=START + (work + chunks * WRITE_CHUNK) / min(workers, study.n_blocks),
        worker_memory=psutil.Process().memory_info().rss + 2 * block // len(scanners),
        reports=eyepoints[0].world.reports,
    )


def _scanner(study: FlightStudy, eyepoints: EyepointStudy) -> ScannerPlan:
    from numba.core.event import install_recorder

    from sweep.scenes.eyepoint_arrays import from_arrays

    part = study.scanners[eyepoints.scanner].part(0)
    first_draw, end = study.scanners[eyepoints.scanner].draw_range(part)
    weight = eyepoints.weight

    def measured(tiles: int) -> tuple[int, float, float]:
        """Number of shots, and what casting and looking take [s], compiling apart."""
        with install_recorder("numba:compile") as compiled:
            begun = time.perf_counter()
            numbers = eyepoints.spread(tiles)
            seen = eyepoints.see(numbers)
            cast = time.perf_counter()
            shots = from_arrays(seen, weight)
            called = study.call(part, shots, numbers)
            study.look(part, seen, shots, called, numbers)
            looked = time.perf_counter()
        return measured(tiles) if compiled.buffer else (len(numbers), cast - begun, looked - cast)

    tiles = 1
    shots, casting, looking = measured(tiles)
    while casting + looking < MEASURING_SCANNER / 4 and shots < eyepoints.points:
        tiles *= 4
        shots, casting, looking = measured(tiles)
    return ScannerPlan(
        name=eyepoints.scanner,
        cycles=eyepoints.cycles,
        shots=eyepoints.points,
        rays=eyepoints.rays,
        is_cast=eyepoints_path(study.path, eyepoints.id).exists(),
        seconds_a_ray=casting / eyepoints.rays_in(shots),
        seconds_a_draw=looking / (shots * (end - first_draw)),
    )
