"""What a study will take, before anything runs: points, blocks, bytes, time, memory."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
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
from sweep.tasks.studies import study_of

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
class Plan:
    """What a study will take; scanners and reports are those of a flight."""

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
    """What a study will take, from its size and a second of measuring its own points.

    Parameters
    ----------
    spec
        The study.
    store
        Where it would be stored: eyepoints are looked for beside it.
    workers
        Workers it would run on; default those of the spec, else all cores.
    """
    study = study_of(spec, (store or Path("nowhere.zarr")).absolute())
    scanners: tuple[ScannerPlan, ...] = ()
    reports: tuple[str, ...] = ()
    shape = {}
    if isinstance(study, FlightStudy):
        eyepoints = list(study.eyepoint_studies())
        scanners = tuple(_scanner(study, each) for each in eyepoints)
        rays = sum(0 if s.is_cast else s.rays * s.seconds_a_ray for s in scanners)
        looking = sum(
            grid.points * s.seconds_a_draw for grid, s in zip(study.grids, scanners, strict=True)
        )
        each, reports = (rays + looking) / study.points, eyepoints[0].world.reports
    else:
        each = measured(study.spec, study.grid)
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
        worker_memory=psutil.Process().memory_info().rss + 2 * study.block_bytes,
        scanners=scanners,
        reports=reports,
    )


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
