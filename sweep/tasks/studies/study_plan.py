"""Plan of a study before it runs: numbers of points and blocks, size, time, memory and effects."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import psutil

from sweep.messages import is_run_as_command
from sweep.model.effects.catalogue import EFFECT_NAMES, EFFECTS
from sweep.scenes.eyepoint_arrays import eyepoints_from_arrays
from sweep.storage.locations import Location, eyepoint_store_location
from sweep.tasks.engine.session import RunOptions
from sweep.tasks.engine.worker_memory import available_process_memory
from sweep.tasks.studies.eyepoint_study import EyepointStudy, get_built_scene, terrain_map_layouts
from sweep.tasks.studies.flight_coverage import sample_coverage
from sweep.tasks.studies.flight_study import FlightStudy
from sweep.tasks.studies.grid_study import (
    EffectPlanner,
    GridStudy,
    evaluate_points,
    limit_draws,
    select_parameters_of_points,
)
from sweep.tasks.studies.memory_limits import (
    block_peak_memory_bytes,
    refuse_too_large_blocks,
    refuse_too_large_point,
    refuse_too_large_scene,
)
from sweep.tasks.studies.parameter_grid import SHOTS_PER_TILE, ParameterValue
from sweep.tasks.studies.study_loading import make_study
from sweep.tasks.studies.workload import SpecWorkload

if TYPE_CHECKING:
    from sweep.spec import GridSpec, SceneSpec

GRID_TIMING_SECONDS = 1.0
"""Approximate duration of timing the points of a grid study [s]."""
TIMED_BLOCKS_MAX = 16
"""Largest number of blocks of a grid whose points are timed."""

FLIGHT_TIMING_SECONDS = 1.0
"""Approximate duration of timing the shots of all scanners of a flight [s]."""

TIMED_RAYS_MAX = 1 << 17
"""Largest number of rays of the timed shots, for each scanner."""
TIMED_SHOT_DRAWS_MAX = 1 << 14
"""Largest number of timed shots times number of timed draws per shot, for each scanner."""

WARM_UP_SHOTS_MAX = 32
"""Largest number of shots that are simulated to load kernels and tables before shots are timed.

They are spread over the flight.
"""

TIMED_CYCLE_SHOTS_MAX = 128
"""Largest number of shots per measurement cycle for which complete cycles are timed.

Navigation is timed with complete cycles only.
"""

TIMED_AXIS_POINTS_MAX = 3
"""Largest number of points of a flight's axes at which shots are timed."""

TIMED_DRAWS_MAX = 1000
"""Largest number of draws of a point or shot that are timed, if no whole spectra are drawn."""

TIMED_SPECTRA_MAX = 10
"""Largest number of draws of a point or shot that are timed, if whole spectra are drawn."""

WORKER_START_SECONDS = 3.0
"""Estimated time of starting worker processes [s]."""
CHUNK_WRITE_SECONDS = 2e-3
"""Estimated time of writing a chunk [s]."""
COMMAND_START_CPU_SECONDS = 1.5
"""Estimated processor time of starting the command [s]."""
FLIGHT_STORE_CPU_SECONDS = 1.0
"""Estimated processor time of creating a flight's stores and summarising its results [s]."""
FLIGHT_COMPILE_CPU_SECONDS = 100.0
"""Estimated processor time of compiling the kernels of a flight [s]."""

MODEL_LOADING_CPU_SECONDS = 3.0
"""Assumed processor time of loading a flight's model if its kernels are not compiled yet [s]."""
UNMEASURED_RAY_CPU_SECONDS = 1e-6
"""Assumed processor time of a ray if kernels are not compiled yet [s]."""
UNMEASURED_SHOT_CPU_SECONDS, UNMEASURED_DRAW_CPU_SECONDS = 5e-4, 3e-5
"""Assumed times of a shot, and of each of its draws, if kernels are not compiled yet [s]."""

WALL_TO_CPU_TIME_RATIO_MAX = 10.0
"""Largest ratio of wall time to processor time that a plan assumes.

The ratio exceeds 1 if other programs keep the processors busy.
"""


@dataclass(frozen=True, kw_only=True)
class TimePart:
    """Part of the time that a run takes."""

    name: str
    """Name of the work, such as 'rays' or 'writing'."""
    cpu_seconds: float
    """Processor time of this part, in all threads or workers together [s]."""
    n_parallel: int = 1
    """Number of threads or workers that share the work."""


@dataclass(frozen=True, kw_only=True)
class ScannerPlan:
    """Plan of one scanner of a flight: numbers of shots and rays, and computing times."""

    name: str
    """Name of the scanner."""
    n_cycles: int
    """Number of measurement cycles."""
    n_shots: int
    """Number of shots."""
    n_rays: int
    """Number of rays of all shots."""
    has_eyepoints: bool
    """True if the geometry of the shots (eyepoints) is already stored."""
    seconds_per_ray: float
    """Measured time of a ray on one worker [s]."""
    seconds_per_draw: float
    """Measured time of one draw of a shot, with navigation [s]."""
    n_timed_shots: int
    """Number of different shots that were timed; 0 if times are assumed, not measured."""
    loading_seconds: float = 0.0
    """Time of loading kernels and tables before the first shot [s]."""

    @property
    def casting_seconds(self) -> float:
        """Processor time of casting all rays [s]; 0 if the eyepoints are already stored."""
        return 0.0 if self.has_eyepoints else self.n_rays * self.seconds_per_ray


@dataclass(frozen=True, kw_only=True)
class StudyPlan:
    """Plan of a study; `scanners` and `mesh_reports` are empty for a grid."""

    n_points: int
    n_blocks: int
    block_shape: dict[str, int]  # points along each axis; empty for a flight
    n_chunks: int
    nbytes: int  # size of all results before compression [bytes]
    n_workers: int  # number of worker processes, or of threads of the command
    has_workers: bool  # True if worker processes compute, False if threads do
    seconds_per_point: float  # measured time of a point on one core [s]
    time_parts: tuple[TimePart, ...]  # parts of the time of the run
    wall_to_cpu_time_ratio: (
        float  # wall time over processor time of this process as it planned, at least 1
    )
    process_memory_bytes: (
        int  # estimated memory of each worker, or of this process with its threads [bytes]
    )
    scanners: tuple[ScannerPlan, ...] = ()
    mesh_reports: tuple[str, ...] = ()  # repairs of meshes when the scene was loaded

    @property
    def cpu_seconds(self) -> float:
        """Estimated processor time of the run [s]: the sum over its parts."""
        return sum(part.cpu_seconds for part in self.time_parts)

    @property
    def wall_seconds(self) -> float:
        """Estimated wall time of the run [s], if the processors stay as busy as now."""
        start_seconds = WORKER_START_SECONDS if self.has_workers else 0.0
        return start_seconds + self.wall_to_cpu_time_ratio * sum(
            part.cpu_seconds / part.n_parallel for part in self.time_parts
        )

    @property
    def are_kernels_compiled(self) -> bool:
        """True if the kernels of the study are compiled, so that its points could be timed."""
        return all(scanner_plan.n_timed_shots for scanner_plan in self.scanners)


def plan_study(
    spec: GridSpec | SceneSpec, *, store_path: Location | None = None, n_workers: int | None = None
) -> StudyPlan:
    """Plan a study from its size, and from points that are computed for about a second.

    Parameters
    ----------
    spec
        Study to plan.
    store_path
        Path of the study's store. Eyepoints that are already stored beside it are not cast.
    n_workers
        Number of worker processes; by default the number in the spec's section `execution`. If both
        are missing, threads on all cores compute, provided the study allows it.

    Returns
    -------
    StudyPlan
        Numbers of points, blocks and chunks, size, time and memory.

    Raises
    ------
    SpecError
        If a point, a block or the scene needs more memory than this machine has.
    """
    start_wall, start_cpu = time.perf_counter(), time.process_time()
    start_part = TimePart(
        name="start", cpu_seconds=start_cpu if is_run_as_command() else COMMAND_START_CPU_SECONDS
    )
    refuse_too_large_point(spec, available_process_memory())
    study = make_study(spec, (store_path or Path("nowhere.zarr")).absolute())
    refuse_too_large_blocks(study, available_process_memory())
    options = RunOptions(workers=n_workers)
    has_workers = options.resolve_cluster(SpecWorkload(spec)) is not None
    n_workers = n_workers or spec.execution.workers or options.n_threads(SpecWorkload(spec))
    n_parallel = min(n_workers, study.n_blocks)
    scanners: tuple[ScannerPlan, ...] = ()
    mesh_reports: tuple[str, ...] = ()
    block_shape = {}
    if isinstance(study, FlightStudy):
        scanners, parts, mesh_reports = _plan_flight(study, n_workers)
        seconds_per_point = sum(
            part.cpu_seconds for part in parts if part.name in ("rays", "shots")
        ) / (study.n_points)
    else:
        seconds_per_point = measure_seconds_per_point(study)
        block_shape = dict(zip(study.grid.dims, study.grid.block_shape, strict=True))
        parts = (
            TimePart(
                name="points",
                cpu_seconds=study.n_points * seconds_per_point,
                n_parallel=n_parallel,
            ),
        )
    writing_part = TimePart(
        name="writing", cpu_seconds=study.n_chunks * CHUNK_WRITE_SECONDS, n_parallel=n_parallel
    )
    wall_seconds = time.perf_counter() - start_wall
    cpu_seconds = max(time.process_time() - start_cpu, 1e-9)
    return StudyPlan(
        n_points=study.n_points,
        n_blocks=study.n_blocks,
        block_shape=block_shape,
        n_chunks=study.n_chunks,
        nbytes=study.nbytes,
        n_workers=n_workers,
        has_workers=has_workers,
        seconds_per_point=seconds_per_point,
        time_parts=(start_part, *parts, writing_part),
        wall_to_cpu_time_ratio=min(
            max(wall_seconds / cpu_seconds, 1.0), WALL_TO_CPU_TIME_RATIO_MAX
        ),
        # with the model loaded, and for each block at work its results and their encoded copy
        process_memory_bytes=psutil.Process().memory_info().rss
        + (1 if has_workers else n_parallel) * block_peak_memory_bytes(study),
        scanners=scanners,
        mesh_reports=mesh_reports,
    )


def _plan_flight(
    study: FlightStudy, n_workers: int
) -> tuple[tuple[ScannerPlan, ...], tuple[TimePart, ...], tuple[str, ...]]:
    """Return the plans of a flight's scanners, the parts of its time, and the reports on meshes."""
    spec, eyepoint_studies = study.spec, study.eyepoint_studies()
    times = [time.process_time()]
    built_scene = get_built_scene(spec)
    times.append(time.process_time())
    sample_coverage(spec)
    terrain_map_layouts(spec)
    times.append(time.process_time())
    scene_seconds, checks_seconds = np.diff(times).tolist()
    refuse_too_large_scene(spec, available_process_memory())
    if are_flight_kernels_compiled(spec):
        plan_scanner, compile_seconds = _plan_scanner, 0.0
    else:
        plan_scanner, compile_seconds = _plan_scanner_unmeasured, FLIGHT_COMPILE_CPU_SECONDS
    scanners = tuple(plan_scanner(study, eyepoints) for eyepoints in eyepoint_studies)
    parts = [
        TimePart(name="scene", cpu_seconds=scene_seconds),
        # warnings sample the flight as the coverage does
        TimePart(name="checks", cpu_seconds=2 * checks_seconds + FLIGHT_STORE_CPU_SECONDS),
        TimePart(name="compiling", cpu_seconds=compile_seconds),
        TimePart(name="model", cpu_seconds=sum(plan.loading_seconds for plan in scanners)),
    ]
    for name, seconds_by_scanner, block_counts in (
        (
            "rays",
            [plan.casting_seconds for plan in scanners],
            [eyepoints.n_blocks for eyepoints in eyepoint_studies],
        ),
        (
            "shots",
            [
                grid.n_points * plan.seconds_per_draw
                for grid, plan in zip(study.grids, scanners, strict=True)
            ],
            [study.n_blocks] * len(scanners),
        ),
    ):
        seconds_by_n_parallel: dict[int, float] = defaultdict(float)
        for seconds, n_blocks in zip(seconds_by_scanner, block_counts, strict=True):
            seconds_by_n_parallel[min(n_workers, n_blocks)] += seconds
        parts += [
            TimePart(name=name, cpu_seconds=seconds, n_parallel=n_parallel)
            for n_parallel, seconds in seconds_by_n_parallel.items()
        ]
    return scanners, tuple(parts), built_scene.mesh_reports


def are_flight_kernels_compiled(spec: SceneSpec) -> bool:
    """Return True if the kernels that cast and simulate shots are in memory or in the cache."""
    from sweep.kernel_cache import is_compiled  # imports the compiler
    from sweep.model.geometry.bvh import find_nearest_triangles
    from sweep.model.pointcloud.returns import store_peak

    return is_compiled(find_nearest_triangles) and (
        spec.draws.draws_whole_spectra or is_compiled(store_peak)
    )


def measure_seconds_per_point(study: GridStudy) -> float:
    """Return the processor time per point of a grid study [s], measured at some points.

    The points are spread over the grid. Complete sets of points that share a geometry are computed,
    as in a run. If a point misses the accuracy after the timed draws, the time of the largest
    number of draws is assumed for the point.
    """
    study.compile_kernels()
    blocks = _choose_timed_blocks(study)

    def time_round(n_geometries: int) -> TimedRound:
        for block in blocks:  # planning of effects serves many points, and is not timed
            study.effect_planner.select_for_block(
                block, _sampled_indices_of_block(study, block, n_geometries)
            )
        start = time.process_time()
        samples = [_compute_timed_points(study, block, n_geometries) for block in blocks]
        measured_seconds = time.process_time() - start
        points, extrapolated_seconds = (sum(column) for column in zip(*samples, strict=True))
        return TimedRound(points, (measured_seconds + extrapolated_seconds,))

    timed_round = _time_growing_rounds(time_round, study.grid.n_points, GRID_TIMING_SECONDS)
    return timed_round.seconds_by_part[0] / timed_round.n_points


def _choose_timed_blocks(study: GridStudy) -> list[int]:
    """Return the numbers of blocks, spread over the grid, whose points are to be timed.

    Points of one geometry are computed in each block to load compiled kernels. There are fewer
    blocks if this takes long.
    """
    blocks: list[int] = []
    last_block, start = study.grid.n_blocks - 1, time.process_time()
    for k in sorted(
        range(TIMED_BLOCKS_MAX), key=lambda k: -math.gcd(k, TIMED_BLOCKS_MAX)
    ):  # first and middle block, quarters, and so on
        block = k * last_block // (TIMED_BLOCKS_MAX - 1)
        if block not in blocks:
            _compute_timed_points(study, block, 1)
            blocks.append(block)
        if time.process_time() - start > 2 * GRID_TIMING_SECONDS:
            break
    return blocks


class TimedRound(NamedTuple):
    """Number of points in one round of time measurement, and the time that they took."""

    n_points: int
    """Number of points computed in the round."""
    seconds_by_part: tuple[float, ...]
    """Time of each part of the round's work [s]."""


def _time_growing_rounds(
    time_round: Callable[[int], TimedRound], n_points_max: int, seconds_max: float
) -> TimedRound:
    """Call `time_round` with rising sample counts, until a round is long enough. Return that round.

    The number of samples quadruples each time, except after a round that compiled kernels.

    A round is long enough if all rounds took a third of `seconds_max` [s], or if the round has
    `n_points_max` points. Rounds that compile kernels do not count.
    """
    from numba.core.event import install_recorder

    n_samples, start = 1, time.perf_counter()
    while True:  # at least one round, even if this process was delayed
        with install_recorder("numba:compile") as compile_events:
            timed_round = time_round(n_samples)
        now = time.perf_counter()
        if compile_events.buffer:  # a round with compilation is not representative
            start = now
            continue
        if timed_round.n_points >= n_points_max or now - start > seconds_max / 3:
            return timed_round
        n_samples *= 4


def _sampled_indices_of_block(study: GridStudy, block: int, n_geometries: int) -> np.ndarray:
    """Return the indices of sampled points in a block.

    The points are `n_geometries` complete sets that each share a geometry, spread over the block.
    """
    grid, points_per_geometry = study.grid, 1
    for length, is_geometric in zip(
        grid.actual_block_shape(block), grid.is_geometric_axis, strict=True
    ):
        points_per_geometry *= 1 if is_geometric else length
    geometry_groups = grid.point_order_by_geometry(block).reshape(-1, points_per_geometry)
    sampled_groups = np.unique(
        np.linspace(0, len(geometry_groups) - 1, n_geometries).astype(np.int64)
    )
    return geometry_groups[sampled_groups].ravel()


def _compute_timed_points(study: GridStudy, block: int, n_geometries: int) -> tuple[int, float]:
    """Compute sampled points of a block, so that the caller can measure the time.

    Return the number of points, and the estimated time of draws that were left out [s].
    """
    spec, extrapolated_seconds = study.spec, 0.0
    indices_in_block = _sampled_indices_of_block(study, block, n_geometries)
    parameters = study.grid.parameters_of_block(block)
    for members, effects in study.effect_planner.select_for_block(
        block, indices_in_block
    ).iter_groups_by_effects():
        group_parameters = select_parameters_of_points(parameters, indices_in_block[members])
        draws_max = TIMED_SPECTRA_MAX if spec.draws.draws_whole_spectra else TIMED_DRAWS_MAX
        extrapolated_seconds += time_points(
            spec, group_parameters, len(members), effects, draws_max=draws_max
        ).extrapolated_seconds
    return len(indices_in_block), extrapolated_seconds


class PointTimes(NamedTuple):
    """Processor time that some points took, and an estimate for draws that were left out."""

    measured_seconds: float
    """Measured processor time of the computed draws [s]."""
    extrapolated_seconds: float
    """Estimated processor time of the draws that were left out [s].

    If the number of draws is adaptive, only points that miss their accuracy have draws left out.
    """


def time_points(
    spec: GridSpec,
    parameters: Mapping[str, ParameterValue],
    n_points: int,
    effects: Collection[str],
    *,
    draws_max: int,
) -> PointTimes:
    """Measure the time of `n_points` points with at most `draws_max` draws each.

    The other arguments are those of :func:`evaluate_points`.
    """
    limited_spec = limit_draws(spec, draws_max)
    if spec.draws.draws_whole_spectra:
        evaluate_points(limit_draws(spec, 1), parameters, n_points, effects)  # fills caches
    start = time.process_time()
    results = evaluate_points(limited_spec, parameters, n_points, effects)
    measured_seconds = time.process_time() - start
    n_draws, n_draws_timed = (
        max(draws_spec.draws.number, draws_spec.draws.limit) for draws_spec in (spec, limited_spec)
    )
    if n_draws == n_draws_timed:
        return PointTimes(measured_seconds, 0.0)
    if (
        spec.draws.draws_whole_spectra
    ):  # the noise-free spectrum of a point takes as long as many draws
        start = time.process_time()
        evaluate_points(limit_draws(spec, 1), parameters, n_points, effects)
        single_draw_seconds = time.process_time() - start
        seconds_per_draw = max(measured_seconds - single_draw_seconds, 0.0) / (n_draws_timed - 1)
        return PointTimes(measured_seconds, seconds_per_draw * (n_draws - n_draws_timed))
    unsettled_fraction = (
        float(np.mean(results["accuracy_missed"] > 0)) if spec.draws.is_adaptive else 1.0
    )
    return PointTimes(
        measured_seconds, measured_seconds * unsettled_fraction * (n_draws / n_draws_timed - 1)
    )


class TimedShots(NamedTuple):
    """Processor times of some shots."""

    n_shots: int
    """Number of shots that were timed."""
    casting_seconds: float
    """Time of casting the rays of all timed shots [s]."""
    simulation_seconds: float
    """Time of simulating the draws of all timed shots [s], averaged over points of the axes."""

    @property
    def total_seconds(self) -> float:
        """Time of casting and simulating all timed shots [s]."""
        return self.casting_seconds + self.simulation_seconds


class _ScannerTimer:
    """Timer of a scanner's shots, spread over the flight and over the points of the axes."""

    def __init__(self, study: FlightStudy, eyepoints: EyepointStudy) -> None:
        self._study, self._eyepoints = study, eyepoints
        self.grid = study.scanner_grids[eyepoints.scanner]
        axis_points = list(np.ndindex(self.grid.axes_shape))
        draws_max = TIMED_SPECTRA_MAX if study.spec.draws.draws_whole_spectra else TIMED_DRAWS_MAX
        flight_blocks = [
            self.grid.first_block_at_axes_point(axis_point)
            for axis_point in _select_evenly_spaced(axis_points, TIMED_AXIS_POINTS_MAX)
        ]
        self._flight_blocks = [
            flight_block._replace(draws=flight_block.draws[:draws_max])
            for flight_block in flight_blocks
        ]
        self.n_draws = len(self._flight_blocks[0].draws)
        self.shots_per_block = len(self._flight_blocks[0].cycles) * self.grid.shots_per_cycle
        self.n_shots_max = max(
            1,
            min(
                TIMED_RAYS_MAX // eyepoints.n_beamlets,
                TIMED_SHOT_DRAWS_MAX // self.n_draws,
                self.shots_per_block,
            ),
        )
        # Navigation needs complete cycles. It is left out of the time where cycles are too long for
        # a sample.
        self._takes_cycles = self.grid.shots_per_cycle <= min(
            TIMED_CYCLE_SHOTS_MAX, self.n_shots_max
        )

    def time_shots(self, n_shots: int) -> TimedShots:
        """Cast and simulate about `n_shots` shots.

        Return their number, and the times of both steps [s]. The time of simulating is that of the
        timer's ``n_draws`` draws, averaged over points of the axes.
        """
        start = time.process_time()
        if self._takes_cycles:
            shot_numbers = self._eyepoints.shot_numbers_of_evenly_spaced_cycles(
                max(n_shots // self.grid.shots_per_cycle, 1)
            )
        else:
            shot_numbers = self._eyepoints.evenly_spaced_shot_numbers(n_shots)
        shot_arrays = self._eyepoints.cast_shots(shot_numbers)
        cast_at = time.process_time()
        shot_eyepoints = eyepoints_from_arrays(shot_arrays, self._eyepoints.beamlet_weights)
        for flight_block in self._flight_blocks:
            self._study.simulate_shots(
                flight_block,
                shot_arrays,
                shot_eyepoints,
                self._study.select_effects(flight_block, shot_eyepoints, shot_numbers),
                shot_numbers,
                solves_navigation=self._takes_cycles,
            )
        simulation_seconds = (time.process_time() - cast_at) / len(self._flight_blocks)
        return TimedShots(len(shot_numbers), cast_at - start, simulation_seconds)


def _plan_scanner(study: FlightStudy, eyepoints: EyepointStudy) -> ScannerPlan:
    """Return the plan of a scanner, with times measured on shots spread over its flight.

    The time of a call is a constant plus a time per shot. Both follow from the times of two calls
    with different numbers of shots.
    """
    timer = _ScannerTimer(study, eyepoints)
    seconds_max = FLIGHT_TIMING_SECONDS / len(study.spec.scanners)
    # The first shots load kernels and tables, which other places in the flight may need too.
    first_sample = timer.time_shots(min(WARM_UP_SHOTS_MAX, timer.n_shots_max))
    start = time.process_time()
    n_timed, samples = 1, [timer.time_shots(1)]
    while n_timed < timer.n_shots_max and (
        samples[-1].total_seconds < seconds_max / 4 and time.process_time() - start < seconds_max
    ):
        n_timed = min(4 * samples[-1].n_shots, timer.n_shots_max)
        samples.append(timer.time_shots(n_timed))
        if samples[-1].n_shots == samples[-2].n_shots:  # the next cycle would be beyond the limit
            break
    # Shots elsewhere may need tables of their own, which the second time finds.
    final_sample, smallest_sample = timer.time_shots(n_timed), samples[0]
    n_shots, simulation_seconds = final_sample.n_shots, final_sample.simulation_seconds
    loading_seconds = first_sample.total_seconds - smallest_sample.total_seconds
    loading_seconds += samples[-1].total_seconds - final_sample.total_seconds
    seconds_per_shot = (
        max(simulation_seconds - smallest_sample.simulation_seconds, 0.0)
        / (n_shots - smallest_sample.n_shots)
        if n_shots > smallest_sample.n_shots
        else simulation_seconds / n_shots
    )
    call_seconds = max(simulation_seconds - n_shots * seconds_per_shot, 0.0)
    block_seconds = call_seconds + timer.shots_per_block * seconds_per_shot
    return ScannerPlan(
        name=eyepoints.scanner,
        n_cycles=eyepoints.n_cycles,
        n_shots=eyepoints.n_points,
        n_rays=eyepoints.n_rays,
        has_eyepoints=eyepoint_store_location(study.store_path, eyepoints.id).exists(),
        seconds_per_ray=final_sample.casting_seconds / (n_shots * eyepoints.n_beamlets),
        seconds_per_draw=block_seconds / (timer.shots_per_block * timer.n_draws),
        n_timed_shots=n_shots,
        loading_seconds=max(loading_seconds, 0.0),
    )


def _plan_scanner_unmeasured(study: FlightStudy, eyepoints: EyepointStudy) -> ScannerPlan:
    """Return the plan of a scanner with assumed times, because measuring would compile kernels."""
    shot_seconds = UNMEASURED_SHOT_CPU_SECONDS / study.scanner_grids[eyepoints.scanner].n_draws
    return ScannerPlan(
        name=eyepoints.scanner,
        n_cycles=eyepoints.n_cycles,
        n_shots=eyepoints.n_points,
        n_rays=eyepoints.n_rays,
        has_eyepoints=eyepoint_store_location(study.store_path, eyepoints.id).exists(),
        seconds_per_ray=UNMEASURED_RAY_CPU_SECONDS,
        seconds_per_draw=shot_seconds + UNMEASURED_DRAW_CPU_SECONDS,
        n_timed_shots=0,
        loading_seconds=MODEL_LOADING_CPU_SECONDS / len(study.spec.scanners),
    )


GRID_TILES_SAMPLED_MAX = 1024
"""Largest number of tiles of a grid that are planned for the table of effects.

Of a larger grid, tiles spread evenly over the grid are planned.
"""

SCANNER_TILES_SAMPLED, AXIS_POINTS_SAMPLED = 16, 12
"""Number of tiles of each scanner of a flight that are planned, and of points of the axes."""

(
    EFFECT_COST_TILES_MAX,
    EFFECT_COST_POINTS_MAX,
    EFFECT_COST_DRAWS_MAX,
) = 4, 24, 20
"""Largest sample for measuring the cost of an effect: tiles, points per tile, draws per point."""
EFFECT_COST_ROUNDS_MAX, EFFECT_COST_ROUNDS_MIN = 5, 3
"""Largest number of rounds of measuring the cost of an effect, and smallest if they take long."""

EFFECT_COST_SPREAD_MAX = 0.1
"""Largest relative spread of an effect's measured cost for which the cost is reported.

The spread is that between rounds of measurement, about twice the error of their median.
"""

EFFECT_COST_ROUND_SECONDS = 0.1
"""Duration that one round of measuring an effect's cost should reach [s].

Tiles are added to the round until it takes longer.
"""


@dataclass(frozen=True, kw_only=True)
class EffectRow:
    """Row of a table of effects: where one effect is simulated, what it changes, and its cost."""

    name: str
    """Name of the effect."""
    mode: str
    """Mode in the spec: 'auto', 'on' or 'off'."""
    simulated_fraction: float
    """Fraction of the points at which the effect is simulated."""
    simulated_region: str
    """Region of the study that contains all points at which the effect is simulated, as text."""
    change_bound: float
    """Upper bound of the change of pd, log10 pfa or relative |X| by the effect, over all points."""
    largest_change_region: str
    """Region of the study in which the upper bound of the change is largest, as text."""
    time_fraction: float
    """Fraction of computing time that the effect takes where it is simulated; nan if unknown."""


@dataclass(frozen=True, kw_only=True)
class EffectsTable:
    """Table of all effects of a study: where each is simulated, what it changes, and its cost."""

    rows: tuple[EffectRow, ...]
    """Rows of the table, one for each effect."""
    tolerance: float
    """Tolerance of the study, to be compared with the upper bounds of changes."""
    error_bound: float
    """Upper bound of the change by all omitted effects together, over all points."""
    planned_tile_fraction: float
    """Fraction of the study's tiles on which the table is based."""

    def warnings(self) -> Iterator[str]:
        """Yield a warning for each effect that is off in the spec and may change results too much.

        A change above the tolerance is too much.
        """
        for row in self.rows:
            if row.mode == "off" and row.change_bound > self.tolerance:
                yield (
                    f"effects.{row.name} is off and may change pd, log10 pfa or |X| by up to "
                    f"{row.change_bound:.2g} ({row.largest_change_region}); the tolerance is "
                    f"{self.tolerance:g}: "
                    "say auto to have it where it matters"
                )


def effects_table(study: GridStudy | FlightStudy, *, costs: bool = True) -> EffectsTable:
    """Return the table of a study's effects, from the plans of a sample of its tiles.

    Parameters
    ----------
    study
        Study over a grid, or flight.
    costs
        Whether to measure each effect's share of the computing time of a grid. It is not measured
        for a flight, as the times of shots vary by more than such a share.

    Returns
    -------
    EffectsTable
        Where each effect is simulated, the largest change that it causes, and its cost.
    """
    if isinstance(study, GridStudy):
        return _grid_effects_table(study, costs)
    return _flight_effects_table(study)


def _grid_effects_table(study: GridStudy, costs: bool) -> EffectsTable:
    """Return the table of effects of a grid study, based on a sample of its tiles.

    If `costs` is True, each effect's share of the computing time is measured.
    """
    spec, effect_planner = study.spec, study.effect_planner
    n_tiles = effect_planner.tiles.n_blocks
    tiles = np.unique(
        np.linspace(0, n_tiles - 1, min(n_tiles, GRID_TILES_SAMPLED_MAX)).astype(np.int64)
    )
    is_kept = np.empty((len(EFFECTS), len(tiles)), bool)
    change_bounds, error_bounds = np.empty(is_kept.shape), np.empty(len(tiles))
    for members, effect_plan in effect_planner.iter_tile_plans(tiles):
        is_kept[:, members], change_bounds[:, members], error_bounds[members] = (
            effect_plan.is_kept,
            effect_plan.omission_error,
            effect_plan.total_error,
        )
    points_by_tile = [_tile_grid_indices(effect_planner, tile) for tile in tiles.tolist()]
    n_points_by_tile = np.array([len(tile_points) for tile_points in points_by_tile])
    absent_effect_flags = effect_planner.absent_effect_flags(
        study.grid.parameters_at(np.concatenate(points_by_tile)), int(n_points_by_tile.sum())
    )
    first_points = np.cumsum(n_points_by_tile) - n_points_by_tile
    n_active_points = np.array(
        [
            np.add.reduceat((absent_effect_flags >> bit & 1) == 0, first_points)
            for bit in range(len(EFFECTS))
        ]
    )
    timed_spec = spec
    if spec.draws.draws_whole_spectra:  # detectors of spectra do not change the cost of effects
        draws = spec.draws.model_copy(update={"method": "probabilities"})
        timed_spec = spec.model_copy(update={"draws": draws})
    sample_tile = _make_tile_sampler(timed_spec, effect_planner)
    return _make_effects_table(
        spec,
        _TileEffects(is_kept * n_active_points, change_bounds, error_bounds),
        n_points=int(n_points_by_tile.sum()),
        region_text=lambda is_in_region: _region_text(spec, effect_planner, tiles[is_in_region]),
        effect_time_fraction=lambda name, is_simulated: (
            _grid_effect_time_fraction(timed_spec, sample_tile, tiles[is_simulated], name)
            if costs
            else math.nan
        ),
        planned_tile_fraction=len(tiles) / n_tiles,
    )


def _flight_effects_table(study: FlightStudy) -> EffectsTable:
    """Return the table of effects of a flight, based on a sample of its tiles and axis points."""
    tile_effects, tile_times, n_shots = [], [], 0
    axes = tuple(int(axis.size) for axis in study.spec.axes)
    axis_points = list(np.ndindex(axes))
    for eyepoints in study.eyepoint_studies():
        shot_numbers = eyepoints.shot_numbers_of_sampled_tiles(SCANNER_TILES_SAMPLED)
        sample_eyepoints = eyepoints_from_arrays(
            eyepoints.cast_shots(shot_numbers), eyepoints.beamlet_weights
        )
        for place in np.unique(
            np.linspace(0, len(axis_points) - 1, AXIS_POINTS_SAMPLED).astype(int)
        ).tolist():
            n_shots += len(shot_numbers)
            flight_block = study.scanner_grids[eyepoints.scanner].first_block_at_axes_point(
                axis_points[place]
            )
            shot_plan = study.plan_effects(
                flight_block, sample_eyepoints, shot_numbers // SHOTS_PER_TILE
            )
            if shot_plan is not None:
                effect_plan, n_hitting_by_tile = (
                    shot_plan.tile_plan,
                    np.bincount(shot_plan.tile_index),
                )
                tile_effects.append(
                    _TileEffects(
                        effect_plan.is_kept * n_hitting_by_tile,
                        effect_plan.omission_error,
                        effect_plan.total_error,
                    )
                )
                first_shots = np.searchsorted(
                    shot_plan.tile_index, np.arange(n_hitting_by_tile.size)
                )
                tile_times.append(sample_eyepoints.time[shot_plan.hitting_shots][first_shots])
    if not tile_effects:
        tolerance = float(study.spec.accuracy.tolerance)
        return EffectsTable(
            rows=(), tolerance=tolerance, error_bound=0.0, planned_tile_fraction=1.0
        )
    time_of_tile = np.concatenate(tile_times)
    return _make_effects_table(
        study.spec,
        _TileEffects(
            *(np.concatenate(column, axis=-1) for column in zip(*tile_effects, strict=True))
        ),
        n_points=n_shots,
        region_text=lambda is_in_region: _time_range_text(time_of_tile[is_in_region]),
        effect_time_fraction=lambda name, is_in_region: math.nan,
        planned_tile_fraction=n_shots * study.spec.draws.number / study.n_points,
    )


class _TileEffects(NamedTuple):
    """Simulated and omitted effects of m tiles (boxes of points, or runs of shots)."""

    n_simulated: np.ndarray
    """Number of points of each tile at which each effect is simulated, (effects, m)."""
    change_bounds: np.ndarray
    """Upper bound of the change by each effect in each tile, (effects, m)."""
    error_bounds: np.ndarray
    """Upper bound of the change by all omitted effects together in each tile, (m,)."""


def _make_effects_table(
    spec: GridSpec | SceneSpec,
    tile_effects: _TileEffects,
    *,
    n_points: int,
    region_text: Callable[[np.ndarray], str],
    effect_time_fraction: Callable[[str, np.ndarray], float],
    planned_tile_fraction: float,
) -> EffectsTable:
    """Return the table of effects, given the simulated and omitted effects of each tile.

    `region_text` and `effect_time_fraction` are functions of a mask of tiles: they return the
    tiles' region as text, and an effect's share of their computing time.
    """
    effect_modes = spec.effect_modes()
    rows = tuple(
        EffectRow(
            name=effect.name,
            mode=effect_modes[effect.name],
            simulated_fraction=float(n_simulated.sum() / n_points),
            simulated_region=region_text(n_simulated > 0) if n_simulated.any() else "",
            change_bound=float(bounds.max()),
            largest_change_region=region_text(np.arange(bounds.size) == bounds.argmax()),
            time_fraction=effect_time_fraction(effect.name, n_simulated > 0)
            if n_simulated.any()
            else math.nan,
        )
        for effect, n_simulated, bounds in zip(
            EFFECTS, tile_effects.n_simulated, tile_effects.change_bounds, strict=True
        )
    )
    tolerance, error_bound = float(spec.accuracy.tolerance), float(tile_effects.error_bounds.max())
    return EffectsTable(
        rows=rows,
        tolerance=tolerance,
        error_bound=error_bound,
        planned_tile_fraction=planned_tile_fraction,
    )


def _time_range_text(times: np.ndarray) -> str:
    """Return the earliest and the latest of some times in a flight as text."""
    first, last = times.min(), times.max()
    return f"time {first:.4g} s" if first == last else f"time {first:.4g}..{last:.4g} s"


def _region_text(spec: GridSpec, effect_planner: EffectPlanner, tiles: np.ndarray) -> str:
    """Return the smallest box of the grid that contains some tiles, as text in the spec's units.

    A tile is a box of neighbouring points whose effects are chosen together.
    """
    slices = [effect_planner.tiles.block_slices(tile) for tile in tiles.tolist()]
    words = []
    for k, axis in enumerate(spec.axes):
        first, stop = (
            min(tile_slices[k].start for tile_slices in slices),
            max(tile_slices[k].stop for tile_slices in slices),
        )
        for member in axis.parameters:
            values = list(dict.fromkeys(member.display_values[first:stop].tolist()))
            unit = f" {member.units}" if member.units else ""
            if isinstance(values[0], str):
                words.append(f"{member.coordinate_name} {', '.join(values)}")
            elif len(values) == 1:
                words.append(f"{member.coordinate_name} {values[0]:g}{unit}")
            else:
                words.append(f"{member.coordinate_name} {min(values):g}..{max(values):g}{unit}")
    return ", ".join(words) or "the point"


class _PointSample(NamedTuple):
    """Points of a tile (box of neighbouring points) to be timed, with all effects chosen for it."""

    parameters: Mapping[str, ParameterValue]
    n_points: int
    effect_names: tuple[str, ...]


def _make_tile_sampler(
    spec: GridSpec, effect_planner: EffectPlanner
) -> Callable[[int], _PointSample]:
    """Return a cached function from the number of a tile to a sample of the tile's points.

    The sample is a single point if points take long.
    """

    @cache
    def sample_tile(tile: int) -> _PointSample:
        ((_, effect_plan),) = effect_planner.iter_tile_plans(np.array([tile]))
        effect_names = tuple(compress(EFFECT_NAMES, effect_plan.is_kept[:, 0]))
        sampled_indices, single_index = (
            _tile_grid_indices(effect_planner, tile, n_points)
            for n_points in (EFFECT_COST_POINTS_MAX, 1)
        )
        parameters = effect_planner.tiles.grid.parameters_at(single_index)
        if _seconds_of_points(spec, parameters, 1, effect_names) < EFFECT_COST_ROUND_SECONDS / 2:
            return _PointSample(
                effect_planner.tiles.grid.parameters_at(sampled_indices),
                len(sampled_indices),
                effect_names,
            )
        return _PointSample(parameters, 1, effect_names)

    return sample_tile


def _seconds_of_points(
    spec: GridSpec,
    parameters: Mapping[str, ParameterValue],
    n_points: int,
    effect_names: Collection[str],
) -> float:
    """Return the time of computing some points with given effects [s]."""
    return sum(
        time_points(spec, parameters, n_points, effect_names, draws_max=EFFECT_COST_DRAWS_MAX)
    )


Stopwatch = Callable[[], float]
"""Function that does some work once, and returns the time that the work took [s]."""


def _grid_effect_time_fraction(
    spec: GridSpec, sample_tile: Callable[[int], _PointSample], tiles: np.ndarray, effect_name: str
) -> float:
    """Return an effect's share of the computing time of points, measured on tiles of a grid."""

    def stopwatches_of_tile(tile: int) -> tuple[Stopwatch, Stopwatch]:
        parameters, n_points, effect_names = sample_tile(tile)
        without = tuple(other for other in effect_names if other != effect_name)
        return (
            lambda: _seconds_of_points(spec, parameters, n_points, effect_names),
            lambda: _seconds_of_points(spec, parameters, n_points, without),
        )

    return reproducible_time_fraction(
        map(stopwatches_of_tile, _select_evenly_spaced(tiles.tolist(), EFFECT_COST_TILES_MAX))
    )


def reproducible_time_fraction(stopwatches: Iterable[tuple[Stopwatch, Stopwatch]]) -> float:
    """Measure an effect's share of the computing time; return nan if it is not reproducible.

    Parameters
    ----------
    stopwatches
        Pairs of functions that time the same work with and without the effect. They are used until
        the work with the effect takes :data:`EFFECT_COST_ROUND_SECONDS` in total.

    Returns
    -------
    float
        Median over rounds, in which work with and without the effect alternates. nan if the rounds
        differ by more than :data:`EFFECT_COST_SPREAD_MAX` of the median.
    """
    timed_pairs, total_seconds = [], 0.0
    for time_with, time_without in stopwatches:
        time_without()  # loads compiled kernels
        total_seconds += time_with()
        timed_pairs.append((time_with, time_without))
        if total_seconds > EFFECT_COST_ROUND_SECONDS:
            break
    fractions, start = [], time.process_time()
    for round_number in range(EFFECT_COST_ROUNDS_MAX):
        if (
            round_number >= EFFECT_COST_ROUNDS_MIN
            and time.process_time() - start > EFFECT_COST_ROUNDS_MAX * EFFECT_COST_ROUND_SECONDS
        ):
            break
        times = np.array([(time_with(), time_without()) for time_with, time_without in timed_pairs])
        seconds_with, seconds_without = times.sum(axis=0) if timed_pairs else (0.0, 0.0)
        fractions.append(
            (seconds_with - seconds_without) / seconds_with if seconds_with > 0 else math.nan
        )
    median = float(np.median(fractions))
    return median if np.ptp(fractions) <= EFFECT_COST_SPREAD_MAX * median else math.nan


def _select_evenly_spaced(sequence: Sequence[Any] | np.ndarray, n_max: int) -> list[Any]:
    """Return at most `n_max` items of a sequence, evenly spaced from the first to the last."""
    positions = np.linspace(0, len(sequence) - 1, min(n_max, len(sequence))).astype(int)
    return [sequence[k] for k in positions]


def _tile_grid_indices(
    effect_planner: EffectPlanner, tile: int, n_max: int | None = None
) -> np.ndarray:
    """Return the indices in the grid, in C order, of the points of a tile.

    If `n_max` is given, at most this number of points, evenly spaced, are included. A tile is a box
    of neighbouring points whose effects are chosen together.
    """
    tile_size = effect_planner.tiles.count_block_points(tile)
    local_indices = np.unique(np.linspace(0, tile_size - 1, n_max or tile_size).astype(np.int64))
    return effect_planner.tiles.point_indices_in_grid(tile, local_indices)
