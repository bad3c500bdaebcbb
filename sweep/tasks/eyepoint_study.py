"""Eyepoints as a study of its own: what every shot of a flight sees through one scanner.

Rays are cast here and nowhere else. The store is named by its content, so that every study of the
same geometry finds it. Shots that need more rays are cast again as they are looked at
(:func:`refine`).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model.accuracy import Accuracy
from sweep.model.outputs import BEAMLETS, CYCLES, SHOTS, WEIGHT
from sweep.model.resolution import more_rays
from sweep.storage.opening import MAP
from sweep.tasks.study import FILLS, TILE_SHOTS, ArrayLayout, BlockGrid, Results, Study, described

if TYPE_CHECKING:
    from sweep.model.eyepoints import Eyepoints
    from sweep.spec import SceneSpec
    from sweep.spec.scene import World

#: Shots and beamlets of a block, as far as whole cycles allow.
BLOCK_SHOTS = 4096
BLOCK_BEAMLETS = 1 << 20

#: Beamlets cast at once, which bounds a worker's memory where cycles are long.
CAST_BEAMLETS = 1 << 18

#: Nodes of a scene's map along the longer side, and along the shorter at least.
NODES = 256
LEAST_NODES = 16

#: Shots of each scanner that say where the flight looks, or times that say where it is; and the
#: room left around what they see.
SAMPLE = 512
MARGIN = 0.08

#: Distance above the scene from which it is seen for its map [m].
ABOVE = 1.0

#: Distance of the ground up to which a platform stands on it [m].
ON_GROUND = 1e-6

#: Size of an axis named by the model.
SIZES = {"xyz": 3, "xyz_again": 3}


class EyepointStudy(Study):
    """Eyepoints of a flight's shots through one scanner; rays and scene by default its own."""

    unit = "shots"

    def __init__(
        self,
        spec: SceneSpec,
        scanner: str,
        beamlets: int | None = None,
        world: World | None = None,
    ) -> None:
        self.spec, self.scanner, self._world = spec, scanner, world
        self.cycles = spec.cycles(scanner)
        self.shots_a_cycle = spec.shots_a_cycle(scanner)
        self.beamlets = beamlets or int(spec.parameters()["footprint.beamlets"])
        most = max(1, min(BLOCK_SHOTS, BLOCK_BEAMLETS // self.beamlets))
        block_cycles = min(self.cycles, max(1, most // self.shots_a_cycle))
        self._grid = BlockGrid(
            ("cycle",), (self.cycles,), (block_cycles,), finer="shot", each=self.shots_a_cycle
        )

    @property
    def grids(self) -> tuple[BlockGrid]:
        """Its cycles."""
        return (self._grid,)

    @cached_property
    def id(self) -> str:
        """Hash of the geometry."""
        return self.spec.geometry_id(self.scanner)

    @property
    def rays(self) -> int:
        """Rays that all blocks cast: one a beamlet, and one straight down a cycle."""
        return self.rays_in(self.points)

    def rays_in(self, shots: int) -> int:
        """Rays that are cast for a number of shots in whole cycles."""
        return shots * self.beamlets + shots // self.shots_a_cycle

    def attributes(self) -> dict[str, Any]:
        """Return the geometry, as it was hashed."""
        return {
            "kind": "eyepoints",
            "geometry": json.dumps(self.spec.geometry(self.scanner), sort_keys=True),
            "shots_a_cycle": self.shots_a_cycle,
        }

    def known_arrays(self) -> list[ArrayLayout]:
        """Weights of the beamlets."""
        about = described(WEIGHT.units, WEIGHT.long_name)
        return [ArrayLayout.known("weight", WEIGHT.dims, self.weight, about, fill=FILLS["f"])]

    @cached_property
    def weight(self) -> np.ndarray:
        """Power fractions of the beamlets, (beamlets,)."""
        from sweep.model.footprint import beamlets

        return beamlets(self.beamlets, self.spec.pattern)[1]

    def outputs(self) -> list[ArrayLayout]:
        """Shots, beamlets and cycles."""
        sizes = SIZES | {"beamlet": self.beamlets}
        return [
            self._grid.array(name, output, output.dims, sizes)
            for name, output in (SHOTS | BEAMLETS | CYCLES).items()
        ]

    def evaluate(self, block: int) -> Results:
        """Eyepoints of a block."""
        (cycles,) = self._grid.block(block)
        return self.see(
            np.arange(cycles.start * self.shots_a_cycle, cycles.stop * self.shots_a_cycle)
        )

    def compile(self) -> None:
        """Compile the ray caster, on the first cycle."""
        self.see(np.arange(self.shots_a_cycle))

    def see(self, index: np.ndarray) -> Results:
        """Arrays of shots, by number (n,), in whole cycles, and of these."""
        shots = self.cast(index)
        return shots | self._cycles(shots)

    def cast(self, index: np.ndarray) -> Results:
        """Arrays of any shots, by number (n,)."""
        from sweep.scenes.eyepoint_arrays import to_arrays

        step = max(1, CAST_BEAMLETS // self.beamlets)
        parts = [
            to_arrays(self.observe(index[start : start + step]))
            for start in range(0, len(index), step)
        ]
        if len(parts) == 1:
            return parts[0]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def tiles(self, number: int) -> np.ndarray:
        """Numbers of the shots of some tiles, as the study plans them, spread over the flight."""
        last = (self.points - 1) // TILE_SHOTS
        first = np.unique(np.linspace(0, last, number).astype(np.int64)) * TILE_SHOTS
        shots = (first[:, None] + np.arange(TILE_SHOTS)).ravel()
        return np.asarray(shots[shots < self.points])

    def spread(self, tiles: int) -> np.ndarray:
        """Numbers of the shots of whole cycles that hold some tiles, spread over the flight."""
        first = np.unique(self.tiles(tiles) // self.shots_a_cycle)
        return np.asarray(
            (first[:, None] * self.shots_a_cycle + np.arange(self.shots_a_cycle)).ravel()
        )

    def observe(self, index: np.ndarray) -> Eyepoints:
        """Eyepoints of any shots, by number (n,): all their rays are cast at once."""
        from sweep.model.eyepoints import observe

        world = self.world
        return observe(index, caster=world.caster, bodies=world.bodies, **self._optics)

    def _cycles(self, shots: Results) -> Results:
        first = slice(None, None, self.shots_a_cycle)
        time, position = shots["time"][first], shots["platform_position"][first]
        velocity = shots["platform_velocity"].reshape(-1, self.shots_a_cycle, 3)
        return {
            "cycle_time": time,
            "true_velocity": velocity.mean(axis=1),
            "true_altitude": altitude(self.world, position, time),
        }

    @property
    def world(self) -> World:
        """The scene, built when it is first looked at."""
        return self._world or world_of(self.spec)

    @cached_property
    def _optics(self) -> dict[str, Any]:
        """Arguments of :func:`sweep.model.eyepoints.observe` that say what looks at the scene."""
        return {
            "flight": self.spec.flight(),
            "scanner": self.spec.scan(self.scanner),
            "beam_divergence": float(self.spec.instrument.laser.beam_divergence),
            "number": self.beamlets,
            "pattern": self.spec.pattern,
            "jitter": self.spec.pointing_jitter(),
            "angles": self.spec.footprint_angles(),
            "rotation": self.spec.modes()["rotation"] != "off",
        }


@lru_cache(maxsize=1)
def world_of(spec: SceneSpec) -> World:
    """Build the scene of a study; the last one is cached, as building can take seconds."""
    return spec.world()


def altitude(world: World, position: np.ndarray, time: float | np.ndarray) -> np.ndarray:
    """Height above what lies straight below positions (n, 3) at times (n,) [m]; inf for nothing."""
    down = np.broadcast_to([0.0, 0.0, -1.0], (len(position), 1, 3))
    return np.asarray(world.caster.bundle(position, down, poses=_poses(world, time)).range)


def beneath(spec: SceneSpec) -> str:
    """Warning of a flight that lies beneath its scene for a while; empty for one that does not."""
    world, flight = world_of(spec), spec.flight()
    time = np.linspace(flight.start, flight.stop, SAMPLE)
    position = flight.state(time).position
    up = np.broadcast_to([0.0, 0.0, 1.0], (len(position), 1, 3))
    above = world.caster.bundle(position, up, poses=_poses(world, time))
    # Whoever stands on the ground may be told, by rounding, that it lies above.
    is_covered = np.isfinite(above.range) & (above.range > ON_GROUND)
    is_low = is_covered & np.isinf(altitude(world, position, time))
    if not is_low.any():
        return ""
    when, deep = time[is_low], np.where(is_low, above.range, 0.0)
    surface = world.surfaces[above.surface[deep.argmax(), 0]].name
    return (
        f"the platform is beneath {surface} from time {when[0]:.4g} to {when[-1]:.4g} s, by "
        f"{deep.max():.4g} m at the most, with nothing below it: raise its path, or let the "
        "scene's origin be the ground"
    )


def _poses(world: World, time: float | np.ndarray) -> list[Any]:
    """Place and attitude of each body at a time, or at one for each ray; None of those at rest."""
    from sweep.model.geometry.rays import Pose

    states = [None if body is None else body.state(np.atleast_1d(time)) for body in world.bodies]
    return [None if s is None else Pose(s.position, s.attitude) for s in states]


def refine(
    rays: int,
    error: np.ndarray,
    accuracy: Accuracy,
    again: Callable[[np.ndarray, int], np.ndarray],
) -> None:
    """Look at shots again, with more rays, until what these leave is within the tolerance.

    The ``rays`` of each shot leave an ``error`` so far, (n,); ``again`` looks at shots, by
    place, with more, and says what these leave.
    """
    needed = more_rays(rays, error, accuracy)
    for number in accuracy.rays:  # rising, and so are the needs of each shot
        places = np.flatnonzero(needed == number)
        step = max(1, CAST_BEAMLETS // number)
        for start in range(0, len(places), step):
            some = places[start : start + step]
            needed[some] = more_rays(number, again(some, number), accuracy)


def scene_map(spec: SceneSpec) -> list[ArrayLayout]:
    """Heights of what a flight passes and looks at, as seen from above at its start."""
    world = world_of(spec)
    seen = np.concatenate([_passed(spec, world, name) for name in spec.scanners])
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    room = MARGIN * max(*(high - low), 1.0)
    x, y = _nodes(low - room, high + room)
    tops = [
        float(mesh.vertices[:, 2].max() + mesh.origin[2])
        for mesh, body in zip(world.caster.meshes, world.bodies, strict=True)
        if body is None
    ]
    top = max(max(tops, default=0.0), seen[:, 2].max()) + ABOVE
    grid = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), top)], axis=-1).reshape(-1, 3)
    depth = altitude(world, grid, spec.flight().start)
    height = np.where(np.isfinite(depth), top - depth, np.nan).reshape(len(y), len(x))
    return [
        ArrayLayout.known(f"{MAP}/{name}", dims, values, described("m", text), fill=FILLS["f"])
        for name, dims, values, text in (
            ("x", ("x",), x, "x of the map's nodes"),
            ("y", ("y",), y, "y of the map's nodes"),
            ("height", ("y", "x"), height, "height seen from above"),
        )
    ]


def _passed(spec: SceneSpec, world: World, scanner: str) -> np.ndarray:
    """Positions of the platform and of what its beams hit, (n, 3)."""
    from sweep.model.geometry.quaternion import rotate

    shots = spec.cycles(scanner) * spec.shots_a_cycle(scanner)
    scan = spec.scan(scanner).shots(np.unique(np.linspace(0, shots - 1, SAMPLE).astype(int)))
    flight = spec.flight()
    state = flight.state(flight.start + scan.time)
    direction = rotate(state.attitude, scan.direction)
    # Bodies that move are looked at where they are as the flight begins: it is only a map.
    poses = _poses(world, flight.start)
    hits = world.caster.bundle(state.position, direction[:, None], poses=poses)
    hit = np.isfinite(hits.range)
    ground = state.position[hit] + direction[hit] * hits.range[hit, None]
    return np.concatenate([state.position, ground])


def _nodes(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of square cells over a rectangle."""
    step = float((high - low).max()) / (NODES - 1)
    count = np.maximum(np.ceil((high - low) / step).astype(int) + 1, LEAST_NODES)
    middle = (low + high) / 2
    x, y = (m + step * (np.arange(n) - (n - 1) / 2) for m, n in zip(middle, count, strict=True))
    return x, y
