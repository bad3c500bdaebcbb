"""Study of a flight's geometry: what every shot through one scanner hits (its eyepoint).

Only this module casts rays. The path of the store is a hash of its content, so that every study of
the same geometry finds it. Shots that need more rays are cast again during the simulation
(:func:`refine_rays`).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model import MODEL_VERSION
from sweep.model.beamlet_counts import next_ray_counts
from sweep.model.error_budget import ErrorBudget
from sweep.model.outputs import (
    BEAMLET_GEOMETRY_VARIABLES,
    BEAMLET_WEIGHT_VARIABLE,
    CYCLE_VARIABLES,
    SHOT_GEOMETRY_VARIABLES,
)
from sweep.storage.store_format import TERRAIN_MAP_GROUP
from sweep.tasks.engine.block_study import BlockStudy
from sweep.tasks.engine.blocks import FILL_VALUE_BY_DTYPE_KIND, ArrayLayout, BlockGrid, Results
from sweep.tasks.studies.output_layouts import cf_attributes, make_output_layout
from sweep.tasks.studies.parameter_grid import DEFAULT_BLOCKS_MIN, SHOTS_PER_TILE
from sweep.tasks.studies.scene_cache import load_or_build_scene

if TYPE_CHECKING:
    from sweep.model.pointcloud.eyepoints import Eyepoints
    from sweep.spec import SceneSpec
    from sweep.spec.scene_sections import BuiltScene

SHOTS_PER_BLOCK_MAX = 4096
"""Largest number of shots in a block, unless a single measurement cycle has more."""
BEAMLETS_PER_BLOCK_MAX = 1 << 20
"""Largest number of beamlets (rays) in a block, unless a single measurement cycle has more."""

DEFAULT_BLOCK_BEAMLETS_MIN = 1 << 17
"""Number of beamlets (rays) above which a study is divided into several blocks.

Several blocks give work to all cores. Casting this number of rays takes about half a second.
"""

RAYS_PER_CAST_MAX = 1 << 18
"""Largest number of beamlets (rays) that are cast at once.

The limit bounds the memory of blocks with long measurement cycles.
"""

SAMPLED_RAYS_MAX = 1 << 19
"""Largest number of rays that are cast to sample a flight's shots before the flight is computed."""

TERRAIN_MAP_LONG_SIDE_NODES = 256
"""Number of grid nodes along the longer side of the map of a scene's heights."""
TERRAIN_MAP_SHORT_SIDE_NODES_MIN = 16
"""Smallest number of grid nodes along the shorter side of the map of a scene's heights."""

N_SAMPLED_FLIGHT_TIMES = 512
"""Number of instants at which the positions of a flight are sampled.

It is also the number of shots by which each scanner's hits are sampled.
"""
TERRAIN_MAP_MARGIN_FRACTION = 0.08
"""Margin of a scene's map around the sampled positions, as a fraction of their larger extent."""

TERRAIN_MAP_VIEWPOINT_CLEARANCE = 1.0
"""Height above the highest point of scene and path, from which rays map the ground below [m]."""

GROUND_CONTACT_DISTANCE_MAX = 1e-6
"""Largest height of the ground above a platform that still counts as standing on the ground [m].

Rounding may place the ground slightly above such a platform.
"""

VECTOR_DIM_SIZES = {"xyz": 3, "xyz_again": 3}
"""Sizes of the dimensions of vectors and matrices in stores, by the dimension's name."""


class EyepointStudy(BlockStudy):
    """Study of the eyepoints (geometry found by rays) of a flight's shots through one scanner.

    `n_beamlets` and `built_scene` are by default those of the spec.
    """

    points_noun = "shots"
    model_version = MODEL_VERSION

    def __init__(
        self,
        spec: SceneSpec,
        scanner: str,
        n_beamlets: int | None = None,
        built_scene: BuiltScene | None = None,
    ) -> None:
        self.spec, self.scanner, self._built_scene = spec, scanner, built_scene
        self.n_cycles = spec.number_of_cycles(scanner)
        self.shots_per_cycle = spec.shots_per_cycle(scanner)
        self.n_beamlets = n_beamlets or int(spec.parameters()["footprint.beamlets"])
        n_beamlets_in_all = self.n_cycles * self.shots_per_cycle * self.n_beamlets
        beamlets_max = max(n_beamlets_in_all // DEFAULT_BLOCKS_MIN, DEFAULT_BLOCK_BEAMLETS_MIN)
        beamlets_max = min(beamlets_max, BEAMLETS_PER_BLOCK_MAX)
        shots_max = max(1, min(SHOTS_PER_BLOCK_MAX, beamlets_max // self.n_beamlets))
        cycles_per_block = min(self.n_cycles, max(1, shots_max // self.shots_per_cycle))
        self._grid = BlockGrid(
            ("cycle",),
            (self.n_cycles,),
            (cycles_per_block,),
            fine_dim="shot",
            fine_steps=self.shots_per_cycle,
        )

    @property
    def grids(self) -> tuple[BlockGrid]:
        """Grid that divides the measurement cycles into blocks, as the only element of a tuple."""
        return (self._grid,)

    @cached_property
    def id(self) -> str:
        """Hash of everything that the geometry depends on."""
        return self.spec.geometry_id(self.scanner)

    @property
    def n_rays(self) -> int:
        """Number of rays: one per beamlet of each shot, plus one straight down per cycle."""
        return self.count_rays(self.n_points)

    def count_rays(self, n_shots: int) -> int:
        """Return the number of rays of `n_shots` shots that make complete measurement cycles.

        A shot has a ray for each beamlet. A cycle has one more ray, straight down.
        """
        return n_shots * self.n_beamlets + n_shots // self.shots_per_cycle

    def store_attributes(self) -> dict[str, Any]:
        """Return the attributes of the store by name.

        The attribute ``geometry`` describes the geometry; the study's id is a hash of this
        description.
        """
        return {
            "kind": "eyepoints",
            "geometry": json.dumps(self.spec.geometry_identity(self.scanner), sort_keys=True),
            "shots_a_cycle": self.shots_per_cycle,
        }

    def constant_array_layouts(self) -> list[ArrayLayout]:
        """Return a list with the layout of the only array known before rays are cast.

        The array holds the power fractions of the beamlets.
        """
        weight_attributes = cf_attributes(
            BEAMLET_WEIGHT_VARIABLE.units, BEAMLET_WEIGHT_VARIABLE.long_name
        )
        return [
            ArrayLayout.from_values(
                "weight",
                BEAMLET_WEIGHT_VARIABLE.dims,
                self.beamlet_weights,
                weight_attributes,
                fill_value=FILL_VALUE_BY_DTYPE_KIND["f"],
            )
        ]

    @cached_property
    def beamlet_weights(self) -> np.ndarray:
        """Power fraction of each beamlet, of shape (beamlets,)."""
        from sweep.model.beamlets import place_beamlets

        return place_beamlets(self.n_beamlets, self.spec.beamlet_pattern)[1]

    def output_layouts(self) -> list[ArrayLayout]:
        """Return the layouts of the arrays that have values per shot, per beamlet, or per cycle."""
        sizes = VECTOR_DIM_SIZES | {"beamlet": self.n_beamlets}
        return [
            make_output_layout(self._grid, name, output, output.dims, sizes)
            for name, output in (
                SHOT_GEOMETRY_VARIABLES | BEAMLET_GEOMETRY_VARIABLES | CYCLE_VARIABLES
            ).items()
        ]

    def evaluate(self, block: int) -> Results:
        """Cast the rays of a block. Return the geometry of shots and cycles as arrays by name."""
        (cycles,) = self._grid.block_slices(block)
        return self.cast_cycles(
            np.arange(cycles.start * self.shots_per_cycle, cycles.stop * self.shots_per_cycle)
        )

    def compile_kernels(self) -> None:
        """Compile the ray caster, by casting the rays of the first measurement cycle."""
        self.cast_cycles(np.arange(self.shots_per_cycle))

    def cast_cycles(self, shot_numbers: np.ndarray) -> Results:
        """Cast the rays of complete measurement cycles. Return arrays by shot and by cycle.

        `shot_numbers` (n,) are the numbers of all shots in these cycles. The result maps names to
        arrays.
        """
        shot_arrays = self.cast_shots(shot_numbers)
        return shot_arrays | self._cycle_arrays_from_shots(shot_arrays)

    def cast_shots(self, shot_numbers: np.ndarray) -> Results:
        """Cast the rays of shots with given numbers (n,). Return the geometry as arrays by name."""
        from sweep.scenes.eyepoint_arrays import eyepoints_to_arrays

        shots_per_cast = max(1, RAYS_PER_CAST_MAX // self.n_beamlets)
        parts = [
            eyepoints_to_arrays(self.cast_eyepoints(shot_numbers[start : start + shots_per_cast]))
            for start in range(0, len(shot_numbers), shots_per_cast)
        ]
        if len(parts) == 1:
            return parts[0]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def shot_numbers_of_sampled_tiles(self, n_tiles: int) -> np.ndarray:
        """Return the numbers of shots in up to `n_tiles` tiles spread over the flight.

        A tile is a run of consecutive shots whose effects are planned together. The result contains
        every k-th shot of these tiles, with the smallest k for which the shots have at most
        `SAMPLED_RAYS_MAX` rays.
        """
        last_tile = (self.n_points - 1) // SHOTS_PER_TILE
        first_shots = (
            np.unique(np.linspace(0, last_tile, n_tiles).astype(np.int64)) * SHOTS_PER_TILE
        )
        shot_numbers = (first_shots[:, None] + np.arange(SHOTS_PER_TILE)).ravel()
        shot_numbers = shot_numbers[shot_numbers < self.n_points]
        return shot_numbers[:: -(-shot_numbers.size * self.n_beamlets // SAMPLED_RAYS_MAX)]

    def shot_numbers_of_sampled_cycles(self, n_tiles: int) -> np.ndarray:
        """Return the numbers of all shots in the cycles that overlap sampled tiles.

        A tile is a run of consecutive shots whose effects are planned together. Up to `n_tiles`
        tiles, spread over the flight, are sampled.
        """
        return self._shot_numbers_of_cycles(
            np.unique(self.shot_numbers_of_sampled_tiles(n_tiles) // self.shots_per_cycle)
        )

    def shot_numbers_of_evenly_spaced_cycles(self, n_cycles: int) -> np.ndarray:
        """Return the numbers of all shots in `n_cycles` cycles spread evenly over the flight.

        A single cycle is the one in the middle of the flight.
        """
        return self._shot_numbers_of_cycles(_middles_of_equal_parts(self.n_cycles, n_cycles))

    def evenly_spaced_shot_numbers(self, n_shots: int) -> np.ndarray:
        """Return the numbers of `n_shots` shots spread evenly over the flight.

        If the flight has fewer shots, the result contains all of them.
        """
        return _middles_of_equal_parts(self.n_points, n_shots)

    def _shot_numbers_of_cycles(self, cycle_numbers: np.ndarray) -> np.ndarray:
        """Return the numbers of all shots in the measurement cycles with given numbers (n,)."""
        return np.asarray(
            (
                cycle_numbers[:, None] * self.shots_per_cycle + np.arange(self.shots_per_cycle)
            ).ravel()
        )

    def cast_eyepoints(self, shot_numbers: np.ndarray) -> Eyepoints:
        """Cast the rays of shots with given numbers (n,). Return the eyepoints of the shots.

        Eyepoints are the geometry of shots as found by rays. All rays are cast in one call.
        """
        from sweep.model.pointcloud.eyepoints import compute_eyepoints

        built_scene = self.built_scene
        return compute_eyepoints(
            shot_numbers,
            caster=built_scene.caster,
            body_motions=built_scene.body_motions,
            **self._keywords_of_compute_eyepoints,
        )

    def _cycle_arrays_from_shots(self, shot_arrays: Results) -> Results:
        """Return time, true velocity and true altitude of each measurement cycle as arrays by name.

        `shot_arrays` are the arrays of all shots of complete cycles, by name.
        """
        cycle_starts = slice(None, None, self.shots_per_cycle)
        time, position = (
            shot_arrays["time"][cycle_starts],
            shot_arrays["platform_position"][cycle_starts],
        )
        velocity = shot_arrays["platform_velocity"].reshape(-1, self.shots_per_cycle, 3)
        return {
            "cycle_time": time,
            "true_velocity": velocity.mean(axis=1),
            "true_altitude": height_above_surface(self.built_scene, position, time),
        }

    @property
    def built_scene(self) -> BuiltScene:
        """Meshes, bodies and surfaces of the study's scene, built when first needed."""
        return self._built_scene or get_built_scene(self.spec)

    @cached_property
    def _keywords_of_compute_eyepoints(self) -> dict[str, Any]:
        """Keyword arguments of `compute_eyepoints` that follow from the spec and the scanner."""
        return {
            "flight": self.spec.build_flight(),
            "scanner": self.spec.scan_pattern(self.scanner),
            "beam_divergence": float(self.spec.instrument.laser.beam_divergence),
            "n_beamlets": self.n_beamlets,
            "pattern": self.spec.beamlet_pattern,
            "jitter": self.spec.pointing_jitter(),
            "footprint_full_angles": self.spec.footprint_angles_function(),
            "bodies_rotate": self.spec.effect_modes()["rotation"] != "off",
        }


def _middles_of_equal_parts(n_items: int, n_parts: int) -> np.ndarray:
    """Return the index of the middle item of each part, if items are cut into equal parts.

    There are `n_items` items and `n_parts` parts, or as many parts as items if `n_parts` is larger.
    """
    n_parts = min(n_parts, n_items)
    return np.asarray((2 * np.arange(n_parts) + 1) * n_items // (2 * n_parts))


@lru_cache(maxsize=1)
def get_built_scene(spec: SceneSpec) -> BuiltScene:
    """Return the scene of a spec, from the cache on disk or newly built.

    The scene of the last call is kept in memory.
    """
    return load_or_build_scene(spec, spec.build_scene)


def height_above_surface(
    built_scene: BuiltScene, position: np.ndarray, time: float | np.ndarray
) -> np.ndarray:
    """Return the heights (n,) of positions above the surface straight below them [m].

    `position` (n, 3) is in world coordinates [m]. `time` [s] is one time for all positions, or
    (n,). The height is inf if nothing is below a position.
    """
    down = np.broadcast_to([0.0, 0.0, -1.0], (len(position), 1, 3))
    return np.asarray(
        built_scene.caster.cast_bundles(position, down, poses=_body_poses(built_scene, time)).range
    )


def below_surface_warning(spec: SceneSpec) -> str:
    """Return a warning if the platform is beneath a surface of the scene at times; '' otherwise."""
    built_scene, flight = get_built_scene(spec), spec.build_flight()
    time = np.linspace(flight.start_time, flight.stop_time, N_SAMPLED_FLIGHT_TIMES)
    position = flight.state(time).position
    up = np.broadcast_to([0.0, 0.0, 1.0], (len(position), 1, 3))
    hits_above = built_scene.caster.cast_bundles(position, up, poses=_body_poses(built_scene, time))
    # For a platform on the ground, rounding may place the ground just above it.
    is_covered = np.isfinite(hits_above.range) & (hits_above.range > GROUND_CONTACT_DISTANCE_MAX)
    is_low = is_covered & np.isinf(height_above_surface(built_scene, position, time))
    if not is_low.any():
        return ""
    times_below, depth = time[is_low], np.where(is_low, hits_above.range, 0.0)
    surface = built_scene.surface_materials[hits_above.surface_index[depth.argmax(), 0]].name
    return (
        f"the platform is beneath {surface} from time {times_below[0]:.4g} to "
        f"{times_below[-1]:.4g} s, by "
        f"{depth.max():.4g} m at the most, with nothing below it: raise its path, or let the "
        "scene's origin be the ground"
    )


def _body_poses(built_scene: BuiltScene, time: float | np.ndarray) -> list[Any]:
    """Return the pose (position and attitude) of each body of a scene; None for a body at rest.

    `time` [s] is one time, or one time per ray.
    """
    from sweep.model.geometry.ray_casting import Pose

    states = [
        None if body is None else body.state(np.atleast_1d(time))
        for body in built_scene.body_motions
    ]
    return [None if state is None else Pose(state.position, state.attitude) for state in states]


def refine_rays(
    n_rays: int,
    ray_errors: np.ndarray,
    accuracy: ErrorBudget,
    cast_more_rays: Callable[[np.ndarray, int], np.ndarray],
) -> None:
    """Cast shots again with more rays, until the error of each shot is within the tolerance.

    Parameters
    ----------
    n_rays
        Number of rays of each shot so far.
    ray_errors
        Errors (n,) that remain with these rays.
    accuracy
        Error budget from which the number of rays follows.
    cast_more_rays
        Function of the indices (m,) of shots and of a number of rays. It casts each of the shots
        with this number of rays, and returns the errors (m,) that remain.
    """
    rays_needed = next_ray_counts(n_rays, ray_errors, accuracy)
    for n_rays_now in accuracy.ray_counts:  # the numbers rise, as do those that a shot needs
        shot_rows = np.flatnonzero(rays_needed == n_rays_now)
        shots_per_cast = max(1, RAYS_PER_CAST_MAX // n_rays_now)
        for start in range(0, len(shot_rows), shots_per_cast):
            batch_rows = shot_rows[start : start + shots_per_cast]
            rays_needed[batch_rows] = next_ray_counts(
                n_rays_now, cast_more_rays(batch_rows, n_rays_now), accuracy
            )


def terrain_map_layouts(spec: SceneSpec) -> list[ArrayLayout]:
    """Return the layouts of a map of the scene's heights: its x, its y and its heights.

    The heights are those at the start of the flight. The map covers the flight path and sampled
    points that the beams hit.
    """
    built_scene = get_built_scene(spec)
    positions = np.concatenate(
        [_sampled_platform_and_hit_positions(spec, built_scene, name) for name in spec.scanners]
    )
    low, high = positions[:, :2].min(axis=0), positions[:, :2].max(axis=0)
    margin = TERRAIN_MAP_MARGIN_FRACTION * max(*(high - low), 1.0)
    x, y = _terrain_map_nodes(low - margin, high + margin)
    mesh_tops = [
        float(mesh.vertices[:, 2].max() + mesh.origin[2])
        for mesh, body in zip(built_scene.caster.meshes, built_scene.body_motions, strict=True)
        if body is None
    ]
    view_height = (
        max(max(mesh_tops, default=0.0), positions[:, 2].max()) + TERRAIN_MAP_VIEWPOINT_CLEARANCE
    )
    view_points = np.stack(
        [*np.meshgrid(x, y), np.full((len(y), len(x)), view_height)], axis=-1
    ).reshape(-1, 3)
    depth = height_above_surface(built_scene, view_points, spec.build_flight().start_time)
    height = np.where(np.isfinite(depth), view_height - depth, np.nan).reshape(len(y), len(x))
    return [
        ArrayLayout.from_values(
            f"{TERRAIN_MAP_GROUP}/{name}",
            dims,
            values,
            cf_attributes("m", long_name),
            fill_value=FILL_VALUE_BY_DTYPE_KIND["f"],
        )
        for name, dims, values, long_name in (
            ("x", ("x",), x, "x of the map's nodes"),
            ("y", ("y",), y, "y of the map's nodes"),
            ("height", ("y", "x"), height, "height seen from above"),
        )
    ]


def _sampled_platform_and_hit_positions(
    spec: SceneSpec, built_scene: BuiltScene, scanner: str
) -> np.ndarray:
    """Return positions (n, 3) [m] of the platform at sampled shots, and of the points hit."""
    from sweep.model.geometry.quaternion import rotate

    n_shots = spec.number_of_cycles(scanner) * spec.shots_per_cycle(scanner)
    scan = spec.scan_pattern(scanner).shots(
        np.unique(np.linspace(0, n_shots - 1, N_SAMPLED_FLIGHT_TIMES).astype(int))
    )
    flight = spec.build_flight()
    state = flight.state(flight.start_time + scan.time)
    direction = rotate(state.attitude, scan.direction)
    # Moving bodies are placed at their position at the start of the flight, as in the map.
    poses = _body_poses(built_scene, flight.start_time)
    hits = built_scene.caster.cast_bundles(state.position, direction[:, None], poses=poses)
    hit = np.isfinite(hits.range)
    ground = state.position[hit] + direction[hit] * hits.range[hit, None]
    return np.concatenate([state.position, ground])


def _terrain_map_nodes(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the x and the y coordinates of grid nodes whose square cells cover a rectangle [m].

    `low` and `high` are opposite corners (x, y) of the rectangle [m].
    """
    step = float((high - low).max()) / (TERRAIN_MAP_LONG_SIDE_NODES - 1)
    count = np.maximum(
        np.ceil((high - low) / step).astype(int) + 1, TERRAIN_MAP_SHORT_SIDE_NODES_MIN
    )
    centre = (low + high) / 2
    x, y = (
        axis_centre + step * (np.arange(n_nodes) - (n_nodes - 1) / 2)
        for axis_centre, n_nodes in zip(centre, count, strict=True)
    )
    return x, y
