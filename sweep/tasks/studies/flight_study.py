"""Study of a flight's point clouds, computed from the known geometry of its shots.

Radiometry, random draws and navigation are computed; rays have been cast before.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model.beamlet_counts import effects_tolerance, has_numerics_set_by_tolerance
from sweep.model.effects.catalogue import (
    PARAMETER_DEFAULTS,
    effect_flag_attributes,
    pack_effect_flags,
)
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.error_budget import ErrorBudget
from sweep.model.ground import ray_traced_footprint_extent
from sweep.model.outputs import (
    BEAMLET_GEOMETRY_VARIABLES,
    CYCLE_VARIABLES,
    EFFECT_VARIABLES,
    NAVIGATION_VARIABLES,
    POINT_CLOUD_VARIABLES,
    SHOT_GEOMETRY_VARIABLES,
    SHOT_STATISTIC_VARIABLES,
)
from sweep.spec.figure_sections import NAVIGATION_SHOTS_PER_CYCLE_MIN
from sweep.spec.rules import Mistake, SpecError
from sweep.spec.scene_sections import scene_projection_wkt
from sweep.storage.locations import Location, eyepoint_store_location
from sweep.storage.store_format import TERRAIN_MAP_GROUP
from sweep.storage.verified_store import open_verified_group
from sweep.tasks.engine.blocks import BLOCKS_PER_STUDY_MAX, ArrayLayout, BlockGrid, Results
from sweep.tasks.studies.extendable_study import ExtendableStudy
from sweep.tasks.studies.eyepoint_study import (
    VECTOR_DIM_SIZES,
    EyepointStudy,
    get_built_scene,
    refine_rays,
    terrain_map_layouts,
)
from sweep.tasks.studies.grid_study import (
    EFFECTS_ARRAY,
    EFFECTS_ERROR_ARRAY,
    SelectedEffects,
    axis_coordinate_layouts,
)
from sweep.tasks.studies.output_layouts import make_output_layout
from sweep.tasks.studies.parameter_grid import (
    SHOTS_PER_TILE,
    ParameterGrid,
    flight_block_size_max,
)

if TYPE_CHECKING:
    from sweep.model.effects.planning import EffectPlan
    from sweep.model.geometry.mesh import SurfaceMaterial
    from sweep.model.pointcloud.ego_motion import MotionPriors
    from sweep.model.pointcloud.error_floor import ErrorFloor
    from sweep.model.pointcloud.eyepoints import Eyepoints
    from sweep.spec import SceneSpec
    from sweep.spec.scene_sections import BuiltScene

    CloudSimulator = Callable[[tuple[str, ...], Eyepoints, np.ndarray, np.ndarray], Results]
    """Function that simulates the points of some shots.

    Its arguments are effect names, eyepoints (geometry of the shots), shot numbers and effect
    flags.
    """

FLIGHT_RANDOM_KEY_DOMAIN = "sweep.flight"
"""Text that, with the seed and a shot's number, determines the random numbers of the shot's draws.

These random numbers are the same at every point of the axes and for every instrument.
"""

GEOMETRY_OUTPUTS = SHOT_GEOMETRY_VARIABLES | CYCLE_VARIABLES
"""Output variables, by name, of the geometry of shots and of cycles.

The geometry does not depend on the axes of a flight study.
"""


@cache
def flag_array_attributes() -> dict[str, dict[str, Any]]:
    """Return the CF attributes of arrays of flags or categories, by array name.

    CF are the Climate and Forecast conventions for metadata.
    """
    from sweep.model.pointcloud.navigation import (
        STATUS_EXCLUDED,
        STATUS_SOLVED,
        STATUS_UNDETERMINED,
        STATUS_WITHHELD,
    )
    from sweep.model.pointcloud.pairing import FLAG_BITS

    status_attributes = {
        "flag_values": [STATUS_SOLVED, STATUS_EXCLUDED, STATUS_WITHHELD, STATUS_UNDETERMINED],
        "flag_meanings": "solved one_beam_excluded withheld undetermined",
    }
    point_attributes = {
        "flag_masks": list(FLAG_BITS.values()),
        "flag_meanings": " ".join(FLAG_BITS),
    }
    return {
        EFFECTS_ARRAY: effect_flag_attributes(), "flags": point_attributes,
        "velocity_status": status_attributes, "altitude_status": status_attributes,
    }  # fmt: skip


class FlightBlock(NamedTuple):
    """Block of a flight: measurement cycles and draws of one scanner at one point of the axes."""

    scanner: str
    """Name of the scanner."""
    axis_indices: tuple[int, ...]
    """Indices of the block's point along the study's axes, one index per axis."""
    draws: range
    """Numbers of the draws in the block."""
    cycles: range
    """Numbers of the measurement cycles in the block."""


class ScannerBlockGrid(ParameterGrid, BlockGrid):
    """Grid of the blocks of one scanner.

    Its dimensions are axes, draws and cycles, the last fastest.
    """

    def __init__(self, spec: SceneSpec, scanner: str) -> None:
        ParameterGrid.__init__(self, spec)
        self.scanner, self.axes_shape = scanner, self.shape
        self.n_cycles, self.shots_per_cycle = (
            spec.number_of_cycles(scanner),
            spec.shots_per_cycle(scanner),
        )
        self.n_draws = int(spec.draws.number)
        _refuse_too_many_shots(spec, self.n_cycles * self.shots_per_cycle)
        block_size_max = flight_block_size_max(
            spec,
            math.prod(self.axes_shape),
            self.n_cycles * self.shots_per_cycle,
            self.n_draws,
        )
        cycles_per_block = max(1, block_size_max.n_shots // self.shots_per_cycle)
        BlockGrid.__init__(
            self,
            (*(axis.name for axis in spec.axes), "draw", "cycle"),
            (*self.axes_shape, self.n_draws, self.n_cycles),
            (
                *(1 for _ in self.axes_shape),
                min(self.n_draws, block_size_max.n_draws),
                min(self.n_cycles, cycles_per_block),
            ),
            group=scanner,
            fine_dim="shot",
            fine_steps=self.shots_per_cycle,
        )
        if self.n_blocks > BLOCKS_PER_STUDY_MAX:
            rule = (
                f"cuts {self.n_draws:,} draws of {self.n_cycles:,} cycles of {scanner} into "
                f"{self.n_blocks:.3g} blocks, and a study has at most {BLOCKS_PER_STUDY_MAX:.0e}"
            )
            size = f"{block_size_max.n_draws}"
            remedy = "raise it or storage.block_shots, or take fewer draws"
            raise SpecError([Mistake("storage.block_draws", rule, size, remedy)])

    def values_by_dim(self) -> list[dict[str, np.ndarray]]:
        """Return a list with a dict for each dimension of the grid: the values along it, by name.

        The names are dotted parameter paths for an axis, `draw` for the draws, and `cycle` for the
        cycles.
        """
        draw_values = {"draw": np.arange(self.n_draws)}
        return [*self.values_by_axis, draw_values, {"cycle": np.arange(self.n_cycles)}]

    @property
    def can_solve_navigation(self) -> bool:
        """True if a measurement cycle has enough shots to compute a velocity vector."""
        return self.shots_per_cycle >= NAVIGATION_SHOTS_PER_CYCLE_MIN

    def flight_block(self, block_in_grid: int) -> FlightBlock:
        """Return the axis point, draws and cycles of a block, given its number in this grid."""
        *axis_ranges, draws, cycles = (
            range(block_slice.start, block_slice.stop)
            for block_slice in self.block_slices(block_in_grid)
        )
        return FlightBlock(
            self.scanner, tuple(axis_range.start for axis_range in axis_ranges), draws, cycles
        )

    def first_block_at_axes_point(self, axis_indices: tuple[int, ...]) -> FlightBlock:
        """Return the block with the first draws and first cycles at a point of the axes.

        `axis_indices` are the indices of the point along the axes.
        """
        return self.flight_block(self.block_at((*axis_indices, 0, 0)))


DRAWN_SHOTS_MAX = 10**10
"""Largest permitted number of a scanner's shots, in all draws and at all points of the axes."""


def _refuse_too_many_shots(spec: SceneSpec, n_shots: int) -> None:
    """Raise a SpecError if a scanner makes more than `DRAWN_SHOTS_MAX` shots in all draws.

    `n_shots` is the scanner's number of shots at one point of the axes and in one draw. Arrays of
    all shots are only made after this check.
    """
    n_draws = int(spec.draws.number)
    all_shots = n_shots * n_draws * math.prod(int(axis.size) for axis in spec.axes)
    if all_shots > DRAWN_SHOTS_MAX:
        rule = (
            f"makes {all_shots:.3g} shots in all draws and places along axes, and a study has at "
            f"most {DRAWN_SHOTS_MAX:.0e}"
        )
        raise SpecError([Mistake("draws.number", rule, f"{n_draws}", "take fewer draws")])


class LocatedFlightBlock(NamedTuple):
    """Block of a flight, with the grid of its scanner."""

    grid: ScannerBlockGrid
    """Grid of all blocks of the block's scanner."""
    flight_block: FlightBlock
    """Scanner, point of the axes, draws and cycles of the block."""


class SimulatedShotGroup(NamedTuple):
    """Results of shots that were simulated together."""

    shot_rows: np.ndarray
    """Indices (m,) of the group's shots among the shots passed to the simulation."""
    results: Results
    """Results of the m shots: arrays (m, ...) by the name of the output variable."""


class ReusedCloud(NamedTuple):
    """Results of a flight's block that are taken from the store of a smaller study."""

    is_reused: np.ndarray
    """True (shots, draws) where results are taken from the smaller study's store."""
    results: Results
    """Arrays by output variable: (shots or cycles, draws, ...), or (shots, ...) if without draws.

    Results that are not reused have fill values, or values that are replaced later.
    """


class FlightStudy(ExtendableStudy):
    """Study of the point clouds of a flight, with a group of arrays for each scanner."""

    points_noun = "shots"

    def __init__(
        self, spec: SceneSpec, store_path: Location, built_scene: BuiltScene | None = None
    ) -> None:
        super().__init__(spec)
        self.store_path = store_path
        self.get_eyepoint_study = cache(partial(EyepointStudy, spec, built_scene=built_scene))
        self.scanner_grids = {scanner: ScannerBlockGrid(spec, scanner) for scanner in spec.scanners}
        self._get_eyepoint_arrays = cache(self._open_eyepoints)

    @property
    def grids(self) -> list[ScannerBlockGrid]:
        """Grids that divide the flight into blocks, one grid for each scanner."""
        return list(self.scanner_grids.values())

    def has_numerics_set_by_tolerance(self, block: int) -> np.ndarray | bool:
        """Return True if the tolerance sets the number of rays or other numerics of shots.

        The answer is the same for all blocks.
        """
        return bool(
            self.spec.is_ray_number_set_by_tolerance
            or has_numerics_set_by_tolerance(self.spec.parameters())
        )

    def locate_flight_block(self, block: int) -> LocatedFlightBlock:
        """Return a block, given its number in the study, and the grid of its scanner.

        IndexError is raised if the study has no block with this number.
        """
        grid, block_in_grid = self.locate_block(block)
        scanner_grid = self.scanner_grids[grid.group]
        return LocatedFlightBlock(scanner_grid, scanner_grid.flight_block(block_in_grid))

    def block_of_first_draws(self, block: int) -> int:
        """Return the number of the block that holds the first draws of the shots in block `block`.

        The block with the first draws also holds the results that do not depend on draws.
        """
        grid, block_in_grid = self.locate_block(block)
        *axis_positions, _, cycle_position = grid.block_position(block_in_grid)
        return block - block_in_grid + grid.block_at((*axis_positions, 0, cycle_position))

    def store_attributes(self) -> dict[str, Any]:
        """Return the attributes of the store by name: title, spec, scanners, surfaces, origins.

        ``projection`` is the WKT of the coordinates in the scene's files, or empty. ``origin`` [m]
        is the position, in these coordinates, of the store's coordinates 0. ``time_origin`` [s], a
        decimal with all its digits, is the time in these files that is time 0 in the store.
        """
        return {
            "kind": "scene",
            "title": self.spec.title,
            "question": self.spec.question,
            "spec": self.spec.to_json(),
            "surfaces": [surface.name for surface in self.surface_materials],
            "scanners": list(self.spec.scanners),
            "origin": np.asarray(get_built_scene(self.spec).origin, float).tolist(),
            "projection": scene_projection_wkt(self.spec.scene, self.spec.files),
            "time_origin": f"{self.spec.files.time_origin.normalize():f}",
        }

    def group_attributes(self) -> dict[str, dict[str, Any]]:
        """Return the attributes, by name, of each group of the store.

        The store has a group for each scanner, and a group without attributes for the map of
        heights.
        """
        coordinate_names = " ".join(
            member.coordinate_name for axis in self.spec.axes for member in axis.parameters
        )
        return {
            scanner: {
                "shots_a_cycle": scanner_grid.shots_per_cycle,
                "geometry_id": self.spec.geometry_id(scanner),
                "coordinates": coordinate_names,
            }
            for scanner, scanner_grid in self.scanner_grids.items()
        } | {TERRAIN_MAP_GROUP: {}}

    def constant_array_layouts(self) -> list[ArrayLayout]:
        """Return the layouts of the arrays known in advance: map of heights, and axis coordinates.

        The axis coordinates are repeated in the group of each scanner.
        """
        return terrain_map_layouts(self.spec) + [
            replace(layout, name=f"{scanner}/{layout.name}")
            for scanner in self.scanner_grids
            for layout in axis_coordinate_layouts(self.spec.axes)
        ]

    def output_layouts(self) -> list[ArrayLayout]:
        """Return the layouts of the arrays that blocks write.

        Each scanner has arrays of geometry, statistics, points, and perhaps navigation.
        """
        axis_names = tuple(axis.name for axis in self.spec.axes)
        sizes = VECTOR_DIM_SIZES | {"return_number": int(self.spec.draws.returns)}
        layouts = []
        for scanner_grid in self.grids:
            outputs = (
                GEOMETRY_OUTPUTS
                | SHOT_STATISTIC_VARIABLES
                | EFFECT_VARIABLES
                | POINT_CLOUD_VARIABLES
            )
            outputs = (
                outputs | NAVIGATION_VARIABLES if scanner_grid.can_solve_navigation else outputs
            )
            for name, output in outputs.items():
                dims = output.dims if name in GEOMETRY_OUTPUTS else axis_names + output.dims
                layouts.append(
                    make_output_layout(
                        scanner_grid, name, output, dims, sizes, flag_array_attributes().get(name)
                    )
                )
        return layouts

    def evaluate(self, block: int) -> Results:
        """Compute point cloud, statistics and navigation of a block. Return arrays by name.

        Effects are selected for complete tiles (runs of consecutive shots), which may extend beyond
        the block.
        """
        scanner_grid, flight_block = self.locate_flight_block(block)
        first_shot, shots_end = (
            cycle * scanner_grid.shots_per_cycle
            for cycle in (flight_block.cycles.start, flight_block.cycles.stop)
        )
        first_tile_shot, tiles_end = (
            first_shot // SHOTS_PER_TILE * SHOTS_PER_TILE,
            -(-shots_end // SHOTS_PER_TILE) * SHOTS_PER_TILE,
        )
        tiles_end = min(tiles_end, scanner_grid.n_cycles * scanner_grid.shots_per_cycle)
        shot_arrays, eyepoints = self._read_shots_and_eyepoints(
            flight_block.scanner, range(first_tile_shot, tiles_end)
        )
        block_rows, shot_numbers = (
            slice(first_shot - first_tile_shot, shots_end - first_tile_shot),
            np.arange(first_shot, shots_end),
        )
        selected_effects = self.select_effects(
            flight_block, eyepoints, np.arange(first_tile_shot, tiles_end)
        ).subset(block_rows)
        shot_arrays = {name: values[block_rows] for name, values in shot_arrays.items()}
        eyepoints = eyepoints.select(block_rows)
        results = shot_arrays | self._read_eyepoint_arrays(
            flight_block.scanner, CYCLE_VARIABLES, flight_block.cycles
        )
        results |= {
            EFFECTS_ARRAY: selected_effects.effect_flags,
            EFFECTS_ERROR_ARRAY: selected_effects.error_bound,
        }
        reused_cloud = (
            self._read_reused_cloud(block, selected_effects) if self.reuse_source else None
        )
        results |= self.simulate_shots(
            flight_block, shot_arrays, eyepoints, selected_effects, shot_numbers, reused_cloud
        )
        chunks = {}
        for name in self.chunk_positions_of_block(block):
            values, n_dims = (
                results[name.rpartition("/")[2]],
                len(self.output_layout_by_name[name].shape),
            )
            chunks[name] = values.reshape((1,) * (n_dims - values.ndim) + values.shape)
        return chunks

    def compile_kernels(self) -> None:
        """Compile all kernels, by simulating the first measurement cycle of each scanner."""
        for scanner_grid in self.grids:
            flight_block = scanner_grid.flight_block(0)._replace(draws=range(1))
            shot_range = range(scanner_grid.shots_per_cycle)
            shot_arrays, eyepoints = self._read_shots_and_eyepoints(
                flight_block.scanner, shot_range
            )
            shot_numbers = np.array(shot_range)
            selected_effects = self.select_effects(flight_block, eyepoints, shot_numbers)
            self.simulate_shots(
                flight_block, shot_arrays, eyepoints, selected_effects, shot_numbers
            )

    def select_effects(
        self, flight_block: FlightBlock, eyepoints: Eyepoints, shot_numbers: np.ndarray
    ) -> SelectedEffects:
        """Return the effects that are simulated at each of n shots.

        `shot_numbers` (n,) are the rising numbers of the shots, `eyepoints` is their geometry.
        """
        n_shots = len(shot_numbers)
        effect_plan = self.plan_effects(flight_block, eyepoints, shot_numbers // SHOTS_PER_TILE)
        no_effects = SelectedEffects(np.zeros(n_shots, np.uint32), np.zeros(n_shots))
        return no_effects if effect_plan is None else effect_plan.selected_effects(n_shots)

    def plan_effects(
        self, flight_block: FlightBlock, eyepoints: Eyepoints, tile_numbers: np.ndarray
    ) -> ShotEffectPlan | None:
        """Choose the effects of n shots, given their geometry and their rising tile numbers (n,).

        A tile is a run of consecutive shots whose effects are chosen together. The result is None
        if no shot hits anything.
        """
        return plan_shot_effects(
            eyepoints,
            tile_numbers,
            self.parameters_at(flight_block),
            self.surface_materials,
            modes=self.spec.effect_modes(),
            has_rotating_bodies=self.spec.has_rotating_bodies,
            rays_by_tolerance=self.spec.is_ray_number_set_by_tolerance,
        )

    def simulate_shots(
        self,
        flight_block: FlightBlock,
        shot_arrays: Results,
        eyepoints: Eyepoints,
        selected_effects: SelectedEffects,
        shot_numbers: np.ndarray,
        reused_cloud: ReusedCloud | None = None,
        *,
        solves_navigation: bool = True,
    ) -> Results:
        """Simulate radiometry, draws and navigation of complete measurement cycles.

        Return arrays by name. Results that ``reused_cloud`` holds are not simulated again. If
        ``solves_navigation`` is False, the shots need not make complete cycles, and navigation gets
        fill values.
        """
        scanner_grid = self.scanner_grids[flight_block.scanner]
        n_draws, shots_per_cycle = len(flight_block.draws), scanner_grid.shots_per_cycle
        is_reused, results = reused_cloud or self._empty_cloud(
            scanner_grid, selected_effects.effect_flags.size, n_draws
        )
        for rows, draw_slice in _iter_shots_missing_draws(~is_reused):
            simulate_cloud = partial(self._simulate_cloud, flight_block, draw_slice)
            for shot_rows, part_results in self.iter_simulated_shot_groups(
                flight_block.scanner,
                eyepoints,
                selected_effects,
                shot_numbers,
                rows,
                simulate_cloud,
            ):
                _insert_results(results, shot_rows, draw_slice, part_results)
        if scanner_grid.can_solve_navigation and solves_navigation:
            is_missing = (~is_reused).reshape(-1, shots_per_cycle, n_draws).any(axis=1)
            for cycles, draw_slice in _iter_shots_missing_draws(np.asarray(is_missing)):
                rows = (cycles[:, None] * shots_per_cycle + np.arange(shots_per_cycle)).ravel()
                part_results = self._solve_navigation(
                    shots_per_cycle, shot_arrays, results, rows, draw_slice
                )
                _insert_results(results, cycles, draw_slice, part_results)
        return results

    def _empty_cloud(
        self, scanner_grid: ScannerBlockGrid, n_shots: int, n_draws: int
    ) -> ReusedCloud:
        """Return a `ReusedCloud` in which nothing is reused, and all results are fill values."""
        outputs = (
            SHOT_STATISTIC_VARIABLES
            | POINT_CLOUD_VARIABLES
            | (NAVIGATION_VARIABLES if scanner_grid.can_solve_navigation else {})
        )
        sizes = VECTOR_DIM_SIZES | {
            "shot": n_shots, "cycle": n_shots // scanner_grid.shots_per_cycle, "draw": n_draws,
            "return_number": int(self.spec.draws.returns),
        }  # fmt: skip
        results = {name: output.empty_array(sizes) for name, output in outputs.items()}
        return ReusedCloud(np.zeros((n_shots, n_draws), bool), results)

    def iter_simulated_shot_groups(
        self,
        scanner: str,
        eyepoints: Eyepoints,
        selected_effects: SelectedEffects,
        shot_numbers: np.ndarray,
        rows: np.ndarray,
        simulate_cloud: CloudSimulator,
    ) -> Iterator[SimulatedShotGroup]:
        """Yield the results of the shots at indices `rows`, in groups that are simulated together.

        A shot whose error by the number of rays exceeds the tolerance is simulated again with more
        rays.
        """
        for members, effect_names, effect_flags in selected_effects.subset(
            rows
        ).iter_groups_computed_together():
            group_rows, simulate_group = rows[members], partial(simulate_cloud, effect_names)
            results = simulate_group(
                eyepoints.select(group_rows), shot_numbers[group_rows], effect_flags
            )
            if self.ray_error_budget is not None:
                n_rays = eyepoints.weight.size
                self._refine_rays(
                    scanner, n_rays, shot_numbers[group_rows], effect_flags, results, simulate_group
                )
            yield SimulatedShotGroup(group_rows, results)

    def _simulate_cloud(
        self,
        flight_block: FlightBlock,
        draw_slice: slice,
        effect_names: tuple[str, ...],
        eyepoints: Eyepoints,
        shot_numbers: np.ndarray,
        effect_flags: np.ndarray,
    ) -> Results:
        """Return the points and statistics of shots as arrays by name, for some draws of a block.

        `draw_slice` are the draws in the block. The effects to simulate are `effect_names`, or for
        each shot the bits of `effect_flags`.
        """
        from sweep.model.pointcloud.error_floor import apply_error_floor
        from sweep.model.pointcloud.point_cloud import simulate_cloud
        from sweep.model.sampling.philox import point_keys
        from sweep.tasks.studies.user_functions import spectrum_methods

        draws_spectra = self.spec.draws.draws_whole_spectra
        method_keywords = (
            {"methods": spectrum_methods(self.parameters_at(flight_block))} if draws_spectra else {}
        )
        seed, first_draw = int(self.spec.seed), flight_block.draws.start + draw_slice.start
        keys = point_keys(
            shot_numbers[:, None].astype(float), domain=FLIGHT_RANDOM_KEY_DOMAIN, seed=seed
        )
        results = simulate_cloud(
            eyepoints,
            parameters=self.parameters_at(flight_block),
            surfaces=self.surface_materials,
            keys=keys,
            first_draw=first_draw,
            draws=draw_slice.stop - draw_slice.start,
            method=self.spec.draws.method,
            **method_keywords,
            returns_max=int(self.spec.draws.returns),
            effects=effect_names,
            effect_flags=effect_flags,
            estimates_ray_error=self.ray_error_budget is not None,
            motion_priors=self.motion_priors,
        )
        if not any(self.error_floor):
            return results
        return apply_error_floor(
            results, eyepoints, self.error_floor, keys=keys, seed=seed, first_draw=first_draw
        )

    def _refine_rays(
        self,
        scanner: str,
        n_rays: int,
        shot_numbers: np.ndarray,
        effect_flags: np.ndarray,
        results: Results,
        simulate_group: Callable[[Eyepoints, np.ndarray, np.ndarray], Results],
    ) -> None:
        """Simulate shots that need more rays again, and replace their `results` in place."""
        assert self.ray_error_budget is not None

        def cast_more_rays(rows: np.ndarray, n_rays_now: int) -> np.ndarray:
            row_shots = shot_numbers[rows]
            finer_results = simulate_group(
                self.get_eyepoint_study(scanner, n_rays_now).cast_eyepoints(row_shots),
                row_shots,
                effect_flags[rows],
            )
            for name, values in finer_results.items():
                results[name][rows] = values
            return finer_results["beamlets_error"]

        refine_rays(n_rays, results["beamlets_error"], self.ray_error_budget, cast_more_rays)

    def _solve_navigation(
        self,
        shots_per_cycle: int,
        shot_arrays: Results,
        results: Results,
        rows: np.ndarray,
        draw_slice: slice,
    ) -> Results:
        """Return velocity and altitude of measurement cycles as arrays by name, for some draws.

        `rows` are the indices of the cycles' shots in `shot_arrays` and `results`; the cycles are
        complete. `draw_slice` are the draws.
        """
        from sweep.model.pointcloud.navigation import solve_navigation

        row_index = slice(None) if rows.size == len(results["flags"]) else rows
        return solve_navigation(
            {
                name: values[row_index]
                for name, values in shot_arrays.items()
                if name in SHOT_GEOMETRY_VARIABLES
            },
            {name: results[name][row_index, draw_slice] for name in POINT_CLOUD_VARIABLES},
            shots_per_cycle=shots_per_cycle,
            test_level=self.spec.navigation.test_level,
            ground_slope=self.spec.navigation.ground_slope,
            relief=self.spec.navigation.relief,
            pointing_jitter=self.spec.platform.jitter,
            error_floor=self.error_floor,
            motion_priors=self.motion_priors,
        )

    def _read_reused_cloud(self, block: int, selected_effects: SelectedEffects) -> ReusedCloud:
        """Return the results of a block that the smaller study has computed with equal effects.

        A shot with other effects, or without readable results, is marked as not reused.
        """
        assert self.reuse_source is not None
        reuse_source, (scanner_grid, flight_block) = (
            self.reuse_source,
            self.locate_flight_block(block),
        )
        shots_per_cycle = scanner_grid.shots_per_cycle
        is_reused, results = reused_cloud = self._empty_cloud(
            scanner_grid, selected_effects.effect_flags.size, len(flight_block.draws)
        )
        for shared_points in reuse_source.iter_shared_points(block):
            first_draw_results, block_results = (
                reuse_source.read_block(source_block)
                for source_block in (
                    reuse_source.source_study.block_of_first_draws(shared_points.source_block),
                    shared_points.source_block,
                )
            )
            if first_draw_results is None or block_results is None:
                continue
            source_arrays = {
                name.rpartition("/")[2]: values
                for name, values in (first_draw_results | block_results).items()
            }
            source_results = {
                name: values.reshape(values.shape[len(reuse_source.source_study.spec.axes) :])
                for name, values in source_arrays.items()
                if name not in GEOMETRY_OUTPUTS
            }
            (draw_index, cycle_index), (source_draw, source_cycle) = (
                np.divmod(shared_points.indices_in_block, len(flight_block.cycles)),
                np.divmod(
                    shared_points.source_local_indices,
                    len(source_results["flags"]) // shots_per_cycle,
                ),
            )
            shot_rows, source_rows = (
                cycle_numbers[:, None] * shots_per_cycle + np.arange(shots_per_cycle)
                for cycle_numbers in (cycle_index, source_cycle)
            )
            draw_column, source_draw_column = draw_index[:, None], source_draw[:, None]
            is_reused[shot_rows, draw_column] = (
                source_results[EFFECTS_ARRAY][source_rows]
                == selected_effects.effect_flags[shot_rows]
            )
            part_results = {
                name: source_results[name][source_rows] for name in SHOT_STATISTIC_VARIABLES
            }
            part_results |= {
                name: source_results[name][source_rows, source_draw_column]
                for name in POINT_CLOUD_VARIABLES
            }
            _insert_results(results, shot_rows, draw_column, part_results)
            if scanner_grid.can_solve_navigation:
                part_results = {
                    name: source_results[name][source_cycle, source_draw]
                    for name in NAVIGATION_VARIABLES
                }
                _insert_results(results, cycle_index, draw_index, part_results)
        reuse_source.reused_points_by_block[block] = int(is_reused.sum())
        return reused_cloud

    def parameters_at(self, flight_block: FlightBlock) -> Mapping[str, Any]:
        """Return the SI values of all parameters, by dotted path, at the axis point of a block."""
        scanner_grid = self.scanner_grids[flight_block.scanner]
        return scanner_grid.fixed_parameters | {
            path: axis_values[index].item()
            for values, index in zip(
                scanner_grid.values_by_axis, flight_block.axis_indices, strict=True
            )
            for path, axis_values in values.items()
        }

    @cached_property
    def error_floor(self) -> ErrorFloor:
        """Standard deviations of instrument errors that do not fall as the echo gets stronger."""
        from sweep.model.pointcloud.error_floor import ErrorFloor

        floor_section = self.spec.error_floor
        return ErrorFloor(
            floor_section.pointing_error,
            floor_section.clock_error,
            floor_section.wavelength_error,
            floor_section.vibration,
            floor_section.range_noise,
        )

    @cached_property
    def motion_priors(self) -> MotionPriors:
        """Standard deviations, from the spec, of motions that the instrument does not measure."""
        from sweep.model.pointcloud.ego_motion import MotionPriors

        navigation_section = self.spec.navigation
        return MotionPriors(
            navigation_section.terrain_slope,
            navigation_section.target_speed,
            navigation_section.target_acceleration,
        )

    @cached_property
    def surface_materials(self) -> tuple[SurfaceMaterial, ...]:
        """Materials of the scene's surfaces; the surface number is the index."""
        return tuple(self.spec.surface_materials())

    @cached_property
    def ray_error_budget(self) -> ErrorBudget | None:
        """Error budget that sets each shot's number of rays; None if the spec states the number."""
        return (
            ErrorBudget.from_parameters(self.spec.parameters())
            if self.spec.is_ray_number_set_by_tolerance
            else None
        )

    def _open_eyepoints(self, scanner: str) -> Mapping[str, Any]:
        """Open the store of a scanner's shot geometry (eyepoints). Return its arrays by name.

        Only the power fractions of the beamlets, ``weight``, are read at once.
        """
        group = open_verified_group(
            eyepoint_store_location(self.store_path, self.spec.geometry_id(scanner))
        )
        arrays: dict[str, Any] = {
            name: group[name]
            for name in SHOT_GEOMETRY_VARIABLES | BEAMLET_GEOMETRY_VARIABLES | CYCLE_VARIABLES
        }
        return arrays | {"weight": np.asarray(group["weight"][...])}  # type: ignore[index]

    def _read_eyepoint_arrays(
        self, scanner: str, names: Mapping[str, Any], index_range: range
    ) -> Results:
        """Read named arrays of a scanner's shot geometry, for a range of shots or cycles."""
        arrays = self._get_eyepoint_arrays(scanner)
        return {
            name: np.asarray(arrays[name][index_range.start : index_range.stop]) for name in names
        }

    def _read_shots_and_eyepoints(
        self, scanner: str, shot_range: range
    ) -> tuple[Results, Eyepoints]:
        """Read the geometry of a range of shots.

        Return the same shots as arrays by name and as `Eyepoints`.
        """
        from sweep.scenes.eyepoint_arrays import eyepoints_from_arrays

        shot_arrays = self._read_eyepoint_arrays(scanner, SHOT_GEOMETRY_VARIABLES, shot_range)
        beamlet_arrays = self._read_eyepoint_arrays(scanner, BEAMLET_GEOMETRY_VARIABLES, shot_range)
        return shot_arrays, eyepoints_from_arrays(
            shot_arrays | beamlet_arrays, self._get_eyepoint_arrays(scanner)["weight"]
        )

    def eyepoint_studies(self) -> list[EyepointStudy]:
        """Return the studies that compute the shot geometry of this flight, one per scanner."""
        return [self.get_eyepoint_study(scanner) for scanner in self.scanner_grids]


def _iter_shots_missing_draws(is_missing: np.ndarray) -> Iterator[tuple[np.ndarray, slice]]:
    """Yield indices of shots that lack the same consecutive draws, and the slice of these draws.

    `is_missing` (shots, draws) is True for each draw that a shot lacks.
    """
    patterns, pattern_of_row = np.unique(is_missing, axis=0, return_inverse=True)
    for pattern_number, pattern in enumerate(patterns):
        rows = np.flatnonzero(pattern_of_row.ravel() == pattern_number)
        edges = np.flatnonzero(np.diff(pattern, prepend=False, append=False))
        for start, stop in edges.reshape(-1, 2).tolist():
            yield rows, slice(start, stop)


def _insert_results(
    results: Results, rows: np.ndarray, draw_index: slice | np.ndarray, part_results: Results
) -> None:
    """Copy the results of some shots and draws into `results`, the arrays of all shots, in place.

    `rows` are the indices of the shots or cycles, `draw_index` those of the draws.
    """
    for name, values in part_results.items():
        results[name][rows if name in SHOT_STATISTIC_VARIABLES else (rows, draw_index)] = values


class ShotEffectPlan(NamedTuple):
    """Effects chosen for each shot of a flight."""

    hitting_shots: np.ndarray
    """Indices (m,) of the shots that hit something."""
    tile_index: np.ndarray
    """Index (m,) in `tile_plan` of the tile of each shot in `hitting_shots`."""
    tile_plan: EffectPlan
    """Plan of effects for each tile, a run of shots with common effects."""

    def selected_effects(self, n_shots: int) -> SelectedEffects:
        """Return the effects that are simulated at each of `n_shots` shots.

        A shot that hits nothing has no effects.
        """
        selected = SelectedEffects(np.zeros(n_shots, np.uint32), np.zeros(n_shots))
        selected.effect_flags[self.hitting_shots] = pack_effect_flags(self.tile_plan.is_kept)[
            self.tile_index
        ]
        selected.error_bound[self.hitting_shots] = self.tile_plan.total_error[self.tile_index]
        return selected


def plan_shot_effects(
    eyepoints: Eyepoints,
    tile_of_shot: np.ndarray,
    parameters: Mapping[str, Any],
    surfaces: Sequence[SurfaceMaterial],
    *,
    modes: Mapping[str, str],
    has_rotating_bodies: bool,
    rays_by_tolerance: bool = False,
) -> ShotEffectPlan | None:
    """Choose the effects of a flight's shots at one point of the axes.

    ``tile_of_shot`` (n,) is the rising number of each shot's tile, a run of shots with common
    effects. The result is None if no shot hits anything.
    """
    from sweep.model.effects.planning import plan_effects
    from sweep.model.pointcloud.eyepoints import parameters_and_ground_of_eyepoints

    hitting_shots = eyepoints.has_target.nonzero()[0]
    if not hitting_shots.size:
        return None
    hitting_eyepoints = (
        eyepoints if hitting_shots.size == len(tile_of_shot) else eyepoints.select(hitting_shots)
    )
    run_edges, tile_index = _find_tile_runs(tile_of_shot[hitting_shots])
    shots, ground = parameters_and_ground_of_eyepoints(
        hitting_eyepoints, PARAMETER_DEFAULTS | dict(parameters), surfaces
    )
    points = PlannerInputs(
        shots, ray_traced_footprint_extent(ground), has_rotating_body=has_rotating_bodies
    )

    def max_per_tile(values: np.ndarray) -> np.ndarray:
        return np.maximum.reduceat(
            np.broadcast_to(values, hitting_eyepoints.time.shape), run_edges[:-1]
        )

    n_rays = 0 if rays_by_tolerance else hitting_eyepoints.offset.shape[1]
    effect_plan = plan_effects(points, max_per_tile, modes, effects_tolerance(parameters, n_rays))
    return ShotEffectPlan(hitting_shots, tile_index, effect_plan)


def _find_tile_runs(tile_numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges of runs of equal tile numbers, and the run of each element.

    The tile numbers are (n,). The edges (runs + 1,) are the indices of the first element of each
    run, and n. The run of each element is an index (n,).
    """
    starts_new_run = np.diff(tile_numbers) != 0
    run_edges = np.concatenate([[0], np.flatnonzero(starts_new_run) + 1, [tile_numbers.size]])
    return run_edges, np.concatenate([[0], np.cumsum(starts_new_run)])
