"""Sample of a study's points, on which accuracy settings are tried.

Points of a grid are spread over all axes. Shots of a flight come in complete tiles of consecutive
shots, because effects are planned tile by tile. Points are computed as in a run, or by the thesis's
method (:mod:`sweep.model.spectrum.oversampled_grid`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import cache, cached_property, partial
from itertools import zip_longest
from pathlib import Path
from time import thread_time
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import qmc

from sweep.model import evaluation, time_domain_truth
from sweep.model.effects.catalogue import (
    EFFECT_NAMES,
    EFFECTS,
    effect_names_in_flags,
    pack_effect_flags,
)
from sweep.model.error_budget import ErrorBudget
from sweep.model.pointcloud.eyepoints import Eyepoints, parameters_and_ground_of_eyepoints
from sweep.model.pointcloud.ray_error import estimate_ray_error
from sweep.model.preparation import Shots
from sweep.model.spectrum.oversampled_grid import find_peaks_on_grid
from sweep.model.spectrum.segment_spectra import SegmentResults
from sweep.model.waveform import SEGMENT_NAMES
from sweep.scenes.eyepoint_arrays import eyepoints_from_arrays
from sweep.spec import Axis, GridSpec, SceneSpec
from sweep.storage.accuracy_setting_kinds import AS_WRITTEN_KIND
from sweep.tasks.accuracy.settings import AccuracySetting, AnySpec
from sweep.tasks.engine.blocks import Results
from sweep.tasks.studies.eyepoint_study import get_built_scene
from sweep.tasks.studies.flight_study import FlightBlock, FlightStudy
from sweep.tasks.studies.grid_study import GridStudy, SelectedEffects, evaluate_points
from sweep.tasks.studies.parameter_grid import (
    SHOTS_PER_TILE,
    ParameterBlockGrid,
)

PeakFinder = Callable[[Shots], SegmentResults]
"""Function that finds the largest bins in the spectrum of each segment (chirp) of some shots."""

PointCoordinates = dict[str, tuple[np.ndarray, dict[str, Any]]]
"""Coordinates that identify sampled points: a mapping from the name of a coordinate to its values
at the points and its attributes.
"""


def _effect_mask_of_names(effect_names: Collection[str]) -> np.uint32:
    """Return an integer in which the bit of each named effect is set."""
    return np.uint32(sum(1 << EFFECT_NAMES.index(effect_name) for effect_name in effect_names))


THESIS_EFFECT_MASK = _effect_mask_of_names(
    [effect.name for effect in EFFECTS if effect.stage not in ("record", "detection", "draws")]
)
"""Effects that the thesis's method can simulate, one bit each.

Effects of this kind move or scale a spectral line as a whole.
"""

TIME_DOMAIN_EFFECT_MASK = ~_effect_mask_of_names(
    [effect.name for effect in EFFECTS if effect.is_random or not effect.is_in_time_domain_truth]
)
"""Effects that simulated time-domain records contain, one bit each."""

TIMED_SEQUENCES_PER_PART, TIMED_POINTS_MAX = 12, 8192
"""Limits of timing in a grid: timed sequences per part of the sample, and points per sequence."""

AXIS_POINTS_PER_SCANNER = 2
"""Number of points of a flight's axes at which shots of each scanner are sampled."""

RESERVED_COORDINATE_NAMES = ("number", "kind", "tolerance")
"""Names that the store uses for its own coordinates.

If a parameter has one of these names, its coordinate is named by the parameter's dotted path.
"""

AS_WRITTEN_SETTING = AccuracySetting(name="as written", kind=AS_WRITTEN_KIND)


class SampleResults(NamedTuple):
    """Results that one accuracy setting gives at n points; nan where it gives no result."""

    pd: np.ndarray
    """(n, 4): probability of detection in up, Doppler, down segment, and shot."""
    log10_pfa: np.ndarray
    """(n, 2): log10 of the probability of false alarm of segment and shot."""
    leakage: np.ndarray
    """(n, 2): probability of a false peak by leakage, in up and down segment."""
    magnitude: np.ndarray
    """(n, k): |X| of the peak bin of each segment, in a unit that all settings share."""
    standard_error: np.ndarray
    """(n,): largest standard error of the four pd, if they are means over draws; else nan."""
    noise_sigma: np.ndarray
    """(n,): noise of a bin per quadrature, in the unit of ``magnitude``."""
    n_beamlets: np.ndarray
    """(n,): number of beamlets that sample the beam; in a flight, number of rays per shot."""


def extract_results(outputs: Results, n_draws: int = 0) -> SampleResults:
    """Return the results of some points from the model's outputs.

    If ``n_draws`` is above 0, the outputs are the numbers of draws, out of ``n_draws``, that have a
    detection. Otherwise they are probabilities.
    """
    segments_and_shot = (*SEGMENT_NAMES, "shot")

    def stack_outputs(form: str, names: Iterable[str] = SEGMENT_NAMES) -> np.ndarray:
        return np.stack([outputs[form.format(name)] for name in names], axis=1)

    if n_draws:
        n_detected = [outputs[f"n_detected_{name}"].sum(axis=1) for name in segments_and_shot]
        pd = np.stack(n_detected, axis=1) / n_draws
        standard_error = np.sqrt(np.maximum(pd * (1 - pd), 0.0) / n_draws)
        return nan_results(len(pd))._replace(pd=pd, standard_error=standard_error.max(axis=1))
    pd, variance = stack_outputs("pd_{}", segments_and_shot), outputs["noise_variance"]
    standard_errors = [
        outputs[f"pd_{name}_error"] for name in segments_and_shot if f"pd_{name}_error" in outputs
    ]
    return SampleResults(
        pd,
        stack_outputs("log10_pfa_{}", ("segment", "shot")),
        stack_outputs("p_leakage_{}", ("up", "down")),
        np.sqrt(stack_outputs("snr_{}") * np.reshape(variance, (-1, 1))),
        np.fmax.reduce(standard_errors) if standard_errors else np.full(len(pd), np.nan),
        np.sqrt(variance / 2),
        outputs["beamlets"],
    )


def nan_results(n_points: int) -> SampleResults:
    """Return the results of n_points points, all of them nan."""
    shapes = (
        (n_points, 4),
        (n_points, 2),
        (n_points, 2),
        (n_points, 3),
        n_points,
        n_points,
        n_points,
    )
    return SampleResults(*(np.full(shape, np.nan) for shape in shapes))


class Trial(NamedTuple):
    """Results and computing time of one accuracy setting on some points."""

    results: SampleResults
    """Results of the setting at the points."""
    seconds_per_point: float
    """Processor time of this process per point [s], including the time to plan the point's
    effects."""
    planning_seconds_per_point: float
    """Part of ``seconds_per_point`` that planning the effects takes [s]."""


def merge_trials(trials: Sequence[Trial]) -> Trial:
    """Return one trial that joins the trials of one setting on several parts of a sample."""
    weights = np.array([trial.results.noise_sigma.size for trial in trials], float)
    weights /= weights.sum()
    return Trial(
        SampleResults(*map(np.concatenate, zip(*(trial.results for trial in trials), strict=True))),
        float(weights @ [trial.seconds_per_point for trial in trials]),
        float(weights @ [trial.planning_seconds_per_point for trial in trials]),
    )


class TimeDomainComparison(NamedTuple):
    """Results of one point from time-domain records, and by the model."""

    time_domain_results: SampleResults
    """Results from simulated time-domain records."""
    model_results: SampleResults
    """Results of the model, with the same effects."""


class PlannedEffectFlags(NamedTuple):
    """Effects chosen for n points, and the time that the choice took."""

    effect_flags: np.ndarray
    """Effects of each point, (n,) of uint32: bit k for the k-th effect of the catalogue."""
    seconds_per_point: float
    """Processor time of the choice per point [s]."""


class StudySample(ABC):
    """Base of the samples of a study's points. Accuracy settings are tried on these points."""

    points_noun = "points"
    """Plural noun for the points of the sample in messages, such as ``points``."""
    spec: AnySpec
    """Spec of the study."""
    study_with_setting: Callable[[AccuracySetting], Any]
    """Function from an accuracy setting to the study with this setting."""
    point_indices: np.ndarray
    """(size,): indices of the sampled points in the study. In a flight they count the sampled
    shots."""
    n_study_points: int
    """Number of points of the study, without the draws of a flight."""
    timed_points_max: int
    """Largest number of points that are timed together."""

    @property
    def size(self) -> int:
        """Number of points in the sample."""
        return self.point_indices.size

    @abstractmethod
    def split_into_parts(self, points_per_part: int) -> list[np.ndarray]:
        """Divide the sample into parts of about `points_per_part` points.

        Return the indices of each part's points in the sample.
        """

    @abstractmethod
    def try_setting(self, setting: AccuracySetting, part: np.ndarray, n_timed_points: int) -> Trial:
        """Compute a part of the sample with one setting, and time it.

        `n_timed_points` is the number of points that are timed. This number may exceed the size of
        the part.
        """

    @abstractmethod
    def point_coordinates(self) -> PointCoordinates:
        """Return the coordinates that identify the points of the sample in the store."""

    def simulated_effects(self, setting: AccuracySetting) -> frozenset[str]:
        """Return the names of the effects that a setting simulates at any point of the sample."""
        parts = (self.point_indices[part] for part in self.split_into_parts(self.size))
        effect_flags = [
            np.bitwise_or.reduce(self._plan_effect_flags(setting, indices).effect_flags)
            for indices in parts
        ]
        return frozenset(effect_names_in_flags(int(np.bitwise_or.reduce(effect_flags))))

    def compare_with_time_domain(
        self, setting: AccuracySetting, sample_row: int
    ) -> TimeDomainComparison:
        """Compute one point from time-domain records and by the model. Return both results.

        Only effects that the setting plans and that records contain are simulated.
        """
        point_index = self.point_indices[[sample_row]]
        planned_flags = self._plan_effect_flags(setting, point_index).effect_flags
        effect_flags = planned_flags & TIME_DOMAIN_EFFECT_MASK
        # Records contain range walk, whatever effects are named.
        time_domain_results, simulated = (
            self._collect_results(
                setting,
                1,
                self._iter_results_by_effects(setting, point_index, effect_flags, find_peaks),
            )
            for find_peaks in (
                time_domain_truth.evaluate_segments_in_time_domain,
                evaluation.evaluate_segments,
            )
        )
        return TimeDomainComparison(time_domain_results, simulated)

    def clear_caches(self) -> None:  # noqa: B027
        """Drop cached results that several trials of one part share.

        Each of these trials is then timed with the computation of these results included.
        """

    @abstractmethod
    def _plan_effect_flags(
        self, setting: AccuracySetting, point_indices: np.ndarray
    ) -> PlannedEffectFlags:
        """Choose the effects at each of n points."""

    @abstractmethod
    def _iter_results_by_effects(
        self,
        setting: AccuracySetting,
        point_indices: np.ndarray,
        effect_flags: np.ndarray,
        find_peaks: PeakFinder | None,
    ) -> Iterator[tuple[np.ndarray, Results]]:
        """Yield rows of ``point_indices`` and the model's outputs at these points, group by group.

        ``find_peaks`` replaces the model's search for peaks.
        """

    @cached_property
    def _thesis_effect_flags(self) -> np.uint32:
        """Effects of the study that the thesis's method can simulate, one bit each."""
        return (
            _effect_mask_of_names(self.simulated_effects(AS_WRITTEN_SETTING)) & THESIS_EFFECT_MASK
        )

    def _run_setting(self, setting: AccuracySetting, point_indices: np.ndarray) -> Trial:
        """Plan and compute some points with one setting. Return results and times."""
        effect_flags, planning_seconds = self._plan_effect_flags(setting, point_indices)
        find_peaks = (
            partial(find_peaks_on_grid, **setting.thesis_grid_options)
            if setting.thesis_grid_options
            else None
        )
        start = thread_time()
        outputs = list(
            self._iter_results_by_effects(setting, point_indices, effect_flags, find_peaks)
        )
        seconds = thread_time() - start
        results = self._collect_results(setting, point_indices.size, outputs)
        return Trial(results, seconds / point_indices.size + planning_seconds, planning_seconds)

    def _collect_results(
        self,
        setting: AccuracySetting,
        n_points: int,
        outputs_by_rows: Iterable[tuple[np.ndarray, Results]],
    ) -> SampleResults:
        """Return the results at all points, joined from outputs for groups of points."""
        n_counted_draws = (
            int(self.study_with_setting(setting).spec.draws.number)
            if setting.counts_detections
            else 0
        )
        results = nan_results(n_points)
        for rows, outputs in outputs_by_rows:
            for values, values_of_rows in zip(
                results, extract_results(outputs, n_counted_draws), strict=True
            ):
                values[rows] = values_of_rows
        return results


def halton_sample(shape: tuple[int, ...], n_points: int) -> np.ndarray:
    """Return indices of grid points that Halton's sequence spreads evenly over the grid.

    The indices count in C order. The first points of the sample are spread evenly by themselves, so
    a first part represents all.
    """
    n_grid_points = math.prod(shape)
    if not shape or n_grid_points <= 1:
        return np.zeros(min(n_grid_points, n_points), np.int64)
    # The first point of the sequence, a corner of the grid, is skipped.
    halton_points = qmc.Halton(len(shape), scramble=False).random(128 * n_points + 1)[1:]
    axis_indices = np.floor(halton_points * shape).astype(np.int64)
    grid_indices = dict.fromkeys(np.ravel_multi_index(tuple(axis_indices.T), shape).tolist())
    grid_indices |= dict.fromkeys(
        range(min(n_grid_points, 2 * n_points))
    )  # the sequence may never reach some points of small grids
    return np.fromiter(grid_indices, np.int64)[:n_points]


def axis_coordinates(
    axes: tuple[Axis, ...], axis_indices: tuple[np.ndarray, ...]
) -> PointCoordinates:
    """Return the coordinates of points, given their indices along each axis."""
    coordinates: PointCoordinates = {}
    for axis, indices in zip(axes, axis_indices, strict=True):
        for member in axis.parameters:
            name = (
                member.path.replace(".", "_")
                if member.coordinate_name in RESERVED_COORDINATE_NAMES
                else member.coordinate_name
            )
            attributes = {"units": member.units, "path": member.path}
            coordinates[name] = np.asarray(member.display_values)[indices], attributes
    return coordinates


class GridSample(StudySample):
    """Sample of the points of a grid: spread evenly, or given by their indices.

    Each point is timed together with the points that a run computes next in the same block, because
    they share intermediate results.
    """

    def __init__(
        self, spec: GridSpec, n_points: int, point_indices: np.ndarray | None = None
    ) -> None:
        self.spec = spec
        self.study_with_setting = cache(lambda setting: GridStudy(setting.apply_to(spec)))
        self._grid: ParameterBlockGrid = self.study_with_setting(AS_WRITTEN_SETTING).grid
        self.point_indices = (
            halton_sample(self._grid.shape, n_points) if point_indices is None else point_indices
        )
        self.n_study_points = self._grid.n_points
        self._block_points = math.prod(self._grid.block_shape)
        self.timed_points_max = min(TIMED_POINTS_MAX, self._block_points)

    def split_into_parts(self, points_per_part: int) -> list[np.ndarray]:
        """Return the sample's rows divided into parts, each spread evenly over the grid."""
        return np.array_split(np.arange(self.size), max(1, round(self.size / points_per_part)))

    def try_setting(self, setting: AccuracySetting, part: np.ndarray, n_timed_points: int) -> Trial:
        """Compute a part with one setting. Measure the time on more points of the same blocks."""
        point_indices = self.point_indices[part]
        trial = self._run_setting(setting, point_indices)
        if n_timed_points == 1:
            return trial
        timed_points = point_indices[:: -(-part.size // TIMED_SEQUENCES_PER_PART)].tolist()
        timed_sequences = np.concatenate(
            [
                self._points_computed_next(setting, timed_point, n_timed_points)
                for timed_point in timed_points
            ]
        )
        # As many points per call as a block has, which share the overhead of a call.
        blocks = np.array_split(timed_sequences, -(-timed_sequences.size // self._block_points))
        return merge_trials([self._run_setting(setting, block) for block in blocks])._replace(
            results=trial.results
        )

    def point_coordinates(self) -> PointCoordinates:
        """Return the index of each sampled point in C order, and its values along each axis."""
        axis_indices = (
            np.unravel_index(self.point_indices, self._grid.shape) if self._grid.shape else ()
        )
        index_coordinate = self.point_indices, {"long_name": "number of the point of the study"}
        return {"number": index_coordinate} | axis_coordinates(self.spec.axes, axis_indices)

    def _plan_effect_flags(
        self, setting: AccuracySetting, point_indices: np.ndarray
    ) -> PlannedEffectFlags:
        if setting.has_line_effects_only:
            return PlannedEffectFlags(np.full(point_indices.size, self._thesis_effect_flags), 0.0)
        effect_planner = self.study_with_setting(setting).effect_planner
        tiles, tile_of_point = np.unique(
            effect_planner.tiles.locate_points(point_indices).blocks, return_inverse=True
        )
        effect_flags = np.empty(tiles.size, np.uint32)
        start = thread_time()
        for members, effect_plan in effect_planner.iter_tile_plans(tiles):
            effect_flags[members] = pack_effect_flags(effect_plan.is_kept)
        seconds = thread_time() - start if setting.plans_effects else 0.0
        n_tile_points = sum(map(effect_planner.tiles.count_block_points, tiles.tolist()))
        return PlannedEffectFlags(effect_flags[tile_of_point], seconds / n_tile_points)

    def _iter_results_by_effects(
        self,
        setting: AccuracySetting,
        point_indices: np.ndarray,
        effect_flags: np.ndarray,
        find_peaks: PeakFinder | None,
    ) -> Iterator[tuple[np.ndarray, Results]]:
        study = self.study_with_setting(setting)
        for rows, effect_names in SelectedEffects(
            effect_flags, np.zeros(effect_flags.size)
        ).iter_groups_by_effects():
            parameters = study.grid.parameters_at(point_indices[rows])
            if find_peaks is None:
                yield rows, evaluate_points(study.spec, parameters, rows.size, effect_names)
            else:
                yield (
                    rows,
                    evaluation.evaluate(parameters, effect_names, segment_evaluator=find_peaks),
                )

    def _points_computed_next(
        self, setting: AccuracySetting, point_index: int, n_points: int
    ) -> np.ndarray:
        """Return a point and the ``n_points`` - 1 points of its block that are computed next.

        The block's first point follows its last.
        """
        grid = self.study_with_setting(setting).grid
        (block,), (local_index,) = (
            array.tolist() for array in grid.locate_points(np.array([point_index]))
        )
        point_order_by_geometry = grid.point_order_by_geometry(block)
        order_positions = np.flatnonzero(point_order_by_geometry == local_index) + np.arange(
            n_points
        )
        return grid.point_indices_in_grid(
            block, point_order_by_geometry.take(order_positions, mode="wrap")
        )


class ShotsOfBlock(NamedTuple):
    """Some shots of one scanner at one point of a flight's axes."""

    flight_block: FlightBlock
    """Scanner and point of the axes."""
    shot_numbers: np.ndarray
    """Numbers (n,) of the shots in the flight."""


class TimedEyepoints(NamedTuple):
    """Geometry of shots, found by rays, and the time of casting these rays."""

    eyepoints: Eyepoints
    """Geometry of each shot."""
    seconds: float
    """Processor time of casting the rays [s]."""


class FlightSample(StudySample):
    """Sample of the shots of a flight, in complete tiles (runs of consecutive shots).

    Tiles are complete because effects are planned tile by tile. The measured time
    includes rays, plans, spectra and probabilities. Draws, points and navigation are left out,
    because they take the same time whatever the accuracy. `point_indices` are indices of shots
    within the sample.
    """

    points_noun = "shots"

    def __init__(self, spec: SceneSpec, n_points: int) -> None:
        self.spec = spec
        self.study_with_setting = cache(self._make_study)
        self._cast_eyepoints: dict[tuple[str, bytes], TimedEyepoints] = {}
        # The shots of a block share work that does not depend on their number, such as planning.
        self.timed_points_max = max(int(spec.storage.block_shots), SHOTS_PER_TILE)
        self._flight_blocks, shots_by_part = zip(*self._sample_shots(n_points), strict=True)
        self._shot_numbers = np.concatenate(shots_by_part)
        self._part_of_row = np.repeat(
            np.arange(len(shots_by_part)), [part_shots.size for part_shots in shots_by_part]
        )
        self.point_indices = np.arange(self._shot_numbers.size)
        self.n_study_points = sum(
            part_shots.n_points // part_shots.n_draws
            for part_shots in self.study_with_setting(AS_WRITTEN_SETTING).grids
        )

    def split_into_parts(self, points_per_part: int) -> list[np.ndarray]:
        """Return the sample's rows divided into parts of complete tiles.

        Each part has shots of one scanner at one point of the axes. Scanners and points take turns.
        """
        tiles_per_part, parts_by_block = max(1, round(points_per_part / SHOTS_PER_TILE)), []
        for rows in (
            np.flatnonzero(self._part_of_row == block_number)
            for block_number in range(len(self._flight_blocks))
        ):
            tile_of_row = self._shot_numbers[rows] // SHOTS_PER_TILE
            tiles = np.unique(tile_of_row)
            tile_groups = np.array_split(tiles, -(-tiles.size // tiles_per_part))
            parts_by_block.append(
                [rows[np.isin(tile_of_row, tile_group)] for tile_group in tile_groups]
            )
        return [
            part
            for parts_in_turn in zip_longest(*parts_by_block)
            for part in parts_in_turn
            if part is not None
        ]

    def try_setting(self, setting: AccuracySetting, part: np.ndarray, n_timed_points: int) -> Trial:
        """Compute a part with one setting.

        If the part has fewer than `n_timed_points` shots, neighbouring tiles are timed with it.
        """
        point_indices = self.extend_to_complete_tiles(part, n_timed_points)
        trial = self._run_setting(setting, point_indices)
        rows_of_part = np.searchsorted(point_indices, part)
        cast_shots = self._cast_shots(setting, *self.flight_block_and_shots(point_indices))
        results = SampleResults(*(values[rows_of_part] for values in trial.results))
        return Trial(
            results,
            trial.seconds_per_point + cast_shots.seconds / point_indices.size,
            trial.planning_seconds_per_point,
        )

    def point_coordinates(self) -> PointCoordinates:
        """Return, for each sampled shot, its scanner, its number and the values along each axis."""
        axis_indices = np.reshape(
            [flight_block.axis_indices for flight_block in self._flight_blocks],
            (len(self._flight_blocks), -1),
        )
        scanners = np.array([flight_block.scanner for flight_block in self._flight_blocks], object)
        return {
            "scanner": (scanners[self._part_of_row], {"long_name": "scanner"}),
            "shot": (self._shot_numbers, {"long_name": "number of the shot"}),
        } | axis_coordinates(self.spec.axes, tuple(axis_indices[self._part_of_row].T))

    def clear_caches(self) -> None:
        """Drop the cached geometry of cast rays that settings with the same geometry share."""
        self._cast_eyepoints.clear()

    def extend_to_complete_tiles(self, point_indices: np.ndarray, n_shots: int) -> np.ndarray:
        """Return the sample indices of all shots in the tiles of some shots, and in the next tiles.

        Following tiles are added until the tiles from the first one on have at least `n_shots`
        shots together.
        """
        rows_of_block = np.flatnonzero(self._part_of_row == self._part_of_row[point_indices[0]])
        return rows_of_block[
            rows_of_complete_tiles(
                self._shot_numbers[rows_of_block] // SHOTS_PER_TILE,
                point_indices - rows_of_block[0],
                n_shots,
            )
        ]

    def flight_block_and_shots(self, point_indices: np.ndarray) -> ShotsOfBlock:
        """Return the scanner and axis point of a part of the sample, and its shot numbers."""
        flight_block = self._flight_blocks[self._part_of_row[point_indices[0]]]
        return ShotsOfBlock(flight_block, self._shot_numbers[point_indices])

    def _plan_effect_flags(
        self, setting: AccuracySetting, point_indices: np.ndarray
    ) -> PlannedEffectFlags:
        tile_rows = self.extend_to_complete_tiles(point_indices, 1)
        flight_block, shot_numbers = self.flight_block_and_shots(tile_rows)
        eyepoints = self._cast_shots(setting, flight_block, shot_numbers).eyepoints
        start = thread_time()
        if setting.has_line_effects_only:
            effect_flags = np.where(eyepoints.has_target, self._thesis_effect_flags, 0)
        else:
            effect_flags = (
                self.study_with_setting(setting)
                .select_effects(flight_block, eyepoints, shot_numbers)
                .effect_flags
            )
        seconds = thread_time() - start if setting.plans_effects else 0.0
        return PlannedEffectFlags(
            effect_flags[np.searchsorted(tile_rows, point_indices)], seconds / tile_rows.size
        )

    def _iter_results_by_effects(
        self,
        setting: AccuracySetting,
        point_indices: np.ndarray,
        effect_flags: np.ndarray,
        find_peaks: PeakFinder | None,
    ) -> Iterator[tuple[np.ndarray, Results]]:
        study, (flight_block, shot_numbers) = (
            self.study_with_setting(setting),
            self.flight_block_and_shots(point_indices),
        )
        eyepoints = self._cast_shots(setting, flight_block, shot_numbers).eyepoints
        selected_effects, hitting_rows = (
            SelectedEffects(effect_flags, np.zeros(effect_flags.size)),
            np.flatnonzero(eyepoints.has_target),
        )
        simulate_group = partial(
            _simulate_shot_statistics,
            study,
            flight_block,
            find_peaks or evaluation.evaluate_segments,
        )
        yield from study.iter_simulated_shot_groups(
            flight_block.scanner,
            eyepoints,
            selected_effects,
            shot_numbers,
            hitting_rows,
            simulate_group,
        )

    def _sample_shots(self, n_points: int) -> Iterator[ShotsOfBlock]:
        """Yield scanners at points of the axes, with shot numbers spread evenly over the flight."""
        study = self.study_with_setting(AS_WRITTEN_SETTING)
        for scanner, scanner_grid in study.scanner_grids.items():
            axis_points = halton_sample(scanner_grid.axes_shape, AXIS_POINTS_PER_SCANNER)
            tiles_wanted = math.ceil(
                n_points / SHOTS_PER_TILE / len(study.scanner_grids) / len(axis_points)
            )
            shot_numbers = study.get_eyepoint_study(scanner).shot_numbers_of_sampled_cycles(
                max(self.timed_points_max // SHOTS_PER_TILE, tiles_wanted)
            )
            for axis_point in axis_points:
                axis_indices = (
                    np.unravel_index(axis_point, scanner_grid.axes_shape)
                    if scanner_grid.axes_shape
                    else ()
                )
                flight_block = scanner_grid.first_block_at_axes_point(tuple(map(int, axis_indices)))
                yield ShotsOfBlock(flight_block, shot_numbers)

    def _make_study(self, setting: AccuracySetting) -> FlightStudy:
        """Return the flight study that an accuracy setting gives."""
        spec: Any = setting.apply_to(self.spec)
        # all studies share a scene, as building it can take seconds
        study = FlightStudy(spec, Path("nowhere.zarr"), get_built_scene(self.spec))
        if setting.rays_error_max:
            study.ray_error_budget = ErrorBudget(setting.rays_error_max, rays_tolerance_min=0.0)
        return study

    def _cast_shots(
        self, setting: AccuracySetting, flight_block: FlightBlock, shot_numbers: np.ndarray
    ) -> TimedEyepoints:
        """Return the geometry of shots found by rays, and the time of casting these rays [s].

        The geometry is cached for settings that share it.
        """
        eyepoint_study = self.study_with_setting(setting).get_eyepoint_study(flight_block.scanner)
        cache_key = eyepoint_study.id, shot_numbers.tobytes()
        if cache_key not in self._cast_eyepoints:
            start = thread_time()
            eyepoints = eyepoints_from_arrays(
                eyepoint_study.cast_shots(shot_numbers), eyepoint_study.beamlet_weights
            )
            self._cast_eyepoints[cache_key] = TimedEyepoints(eyepoints, thread_time() - start)
        return self._cast_eyepoints[cache_key]


def rows_of_complete_tiles(tile_of_row: np.ndarray, rows: np.ndarray, n_shots: int) -> np.ndarray:
    """Return the rows of all shots in the tiles of the given rows, and in enough following tiles.

    After the last tile comes the first. ``tile_of_row`` (n,) is the number of each row's tile, in
    rising order. Following tiles are added until the tiles from the first one on have at least
    `n_shots` shots together.
    """
    tiles, counts = np.unique(tile_of_row, return_counts=True)
    own_tiles = np.unique(tile_of_row[rows])
    tile_order = np.roll(np.arange(tiles.size), -int(np.searchsorted(tiles, own_tiles[0])))
    n_tiles = int(np.searchsorted(np.cumsum(counts[tile_order]), n_shots)) + 1
    return np.flatnonzero(np.isin(tile_of_row, [*own_tiles, *tiles[tile_order[:n_tiles]]]))


def _simulate_shot_statistics(
    study: FlightStudy,
    flight_block: FlightBlock,
    find_peaks: PeakFinder,
    effect_names: tuple[str, ...],
    eyepoints: Eyepoints,
    shot_numbers: np.ndarray,
    effect_flags: np.ndarray,
) -> Results:
    """Return statistics of shots computed from the peaks that ``find_peaks`` finds.

    The statistics are nan for shots without a hit.
    """
    hitting_shots, n_rays = eyepoints.has_target.nonzero()[0], eyepoints.weight.size
    shot_parameters, ground = parameters_and_ground_of_eyepoints(
        eyepoints.select(hitting_shots), study.parameters_at(flight_block), study.surface_materials
    )
    shots = evaluation.prepare_ray_traced_shots(
        shot_parameters, ground, effect_names, effect_flags[hitting_shots]
    )
    peaks = find_peaks(shots)
    outputs = evaluation.shot_statistics(shots, peaks) | {"beamlets": np.full(shots.size, n_rays)}
    if study.ray_error_budget is not None:
        peak_bins = peaks.frequency.T * (shots.fft_size / shots.sample_rate[:, None])
        outputs["beamlets_error"] = estimate_ray_error(
            shots, ground.beamlet_table, peak_bins, peaks.magnitude.T
        )
    all_outputs = {name: np.full(shot_numbers.size, np.nan) for name in outputs}
    for name, values in outputs.items():
        all_outputs[name][hitting_shots] = values
    return all_outputs
