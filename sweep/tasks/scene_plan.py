"""What a study of a scene will take, before anything runs."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import psutil

from sweep.storage.locations import Location
from sweep.tasks import cluster
from sweep.tasks.eyepoint_study import EyepointStudy, eyepoints_path
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.plan import START, WRITE_CHUNK

if TYPE_CHECKING:
    from sweep.spec import SceneSpec

#: Time that measuring a scanner may take [s], about, and the shots to begin with.
MEASURING = 0.5
FIRST_SHOTS = 64


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
    from sweep.scenes.eyepoint_arrays import from_arrays

    part = study.scanners[eyepoints.scanner].part(0)
    first_draw, end = study.scanners[eyepoints.scanner].draw_range(part)
    weight = eyepoints.weight

    def timed(cycles: int) -> tuple[float, float]:
        begun = time.perf_counter()
        numbers = eyepoints.spread(cycles)
        seen = eyepoints.see(numbers)
        cast = time.perf_counter()
        shots = from_arrays(seen, weight)
        study.look(part, seen, shots, study.call(part, shots), numbers)
        return cast - begun, time.perf_counter() - cast

    timed(1)  # compiles what there is to compile
    cycles = max(1, FIRST_SHOTS // eyepoints.shots_a_cycle)
    casting, looking = timed(min(cycles, eyepoints.cycles))
    while casting + looking < MEASURING / 4 and cycles < eyepoints.cycles:
        cycles *= 4
        casting, looking = timed(min(cycles, eyepoints.cycles))
    shots = min(cycles, eyepoints.cycles) * eyepoints.shots_a_cycle
    return ScannerPlan(
        name=eyepoints.scanner,
        cycles=eyepoints.cycles,
        shots=eyepoints.points,
        rays=eyepoints.rays,
        is_cast=eyepoints_path(study.path, eyepoints.id).exists(),
        seconds_a_ray=casting / eyepoints.rays_in(shots),
        seconds_a_draw=looking / (shots * (end - first_draw)),
    )
