"""Eyepoints as a study of its own: what every shot of a flight sees through one scanner.

Rays are cast here and nowhere else. The store is named by its content, so that every radiometric
study of the same geometry finds it.
"""

from __future__ import annotations

import json
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model.outputs import BEAMLETS, CYCLES, SHOTS, WEIGHT, Output
from sweep.storage.atomic_replace import real
from sweep.storage.locations import Location
from sweep.tasks.calling import TILE_SHOTS
from sweep.tasks.grid_study import described
from sweep.tasks.study import ArrayLayout, Results

if TYPE_CHECKING:
    from sweep.model.eyepoints import Eyepoints
    from sweep.spec import SceneSpec
    from sweep.spec.world import World

#: Directory of eyepoint stores, beside the stores of the studies that use them.
EYEPOINTS = "eyepoints"

#: Shots and beamlets of a block, as far as whole cycles allow.
BLOCK_SHOTS = 4096
BLOCK_BEAMLETS = 1 << 20

#: Beamlets cast at once, which bounds a worker's memory where cycles are long.
CAST_BEAMLETS = 1 << 18

#: Size of an axis named by the model.
SIZES = {"xyz": 3, "xyz_again": 3}


def eyepoints_path(study_path: Location, geometry_id: str) -> Location:
    """Eyepoint store of a geometry, for the study stored at a path."""
    return real(study_path).parent / EYEPOINTS / f"{geometry_id}.zarr"


class EyepointStudy:
    """What the shots of a flight see through one scanner.

    Parameters
    ----------
    spec
        A study of the scene.
    scanner
        Name of the scanner.
    beamlets
        Rays of each shot; those of the spec by default.
    """

    unit = "shots"

    def __init__(self, spec: SceneSpec, scanner: str, beamlets: int | None = None) -> None:
        self.spec, self.scanner = spec, scanner
        self.cycles = spec.cycles(scanner)
        self.shots_a_cycle = spec.shots_a_cycle(scanner)
        self.beamlets = beamlets or int(spec.parameters()["footprint.beamlets"])
        most = max(1, min(BLOCK_SHOTS, BLOCK_BEAMLETS // self.beamlets))
        self.block_cycles = min(self.cycles, max(1, most // self.shots_a_cycle))

    @cached_property
    def id(self) -> str:
        """Hash of the geometry."""
        return self.spec.geometry_id(self.scanner)

    @property
    def points(self) -> int:
        """Number of shots."""
        return self.cycles * self.shots_a_cycle

    @property
    def rays(self) -> int:
        """Rays that all blocks cast: one a beamlet, and one straight down a cycle."""
        return self.rays_in(self.points)

    def rays_in(self, shots: int) -> int:
        """Rays that are cast for a number of shots in whole cycles."""
        return shots * self.beamlets + shots // self.shots_a_cycle

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return -(-self.cycles // self.block_cycles)

    def block_size(self, block: int) -> int:
        """Shots of a block."""
        first = block * self.block_cycles
        return (min(first + self.block_cycles, self.cycles) - first) * self.shots_a_cycle

    def points_in(self, blocks: np.ndarray) -> int:
        """Shots in the blocks that are marked in an ndarray of bool (blocks,)."""
        full = int(np.count_nonzero(blocks)) * self.block_cycles * self.shots_a_cycle
        short = self.block_cycles * self.shots_a_cycle - self.block_size(self.n_blocks - 1)
        return full - short * bool(blocks[-1])

    def attributes(self) -> dict[str, Any]:
        """The geometry, as it was hashed."""
        return {
            "kind": "eyepoints",
            "geometry": json.dumps(self.spec.geometry(self.scanner), sort_keys=True),
            "shots_a_cycle": self.shots_a_cycle,
        }

    def groups(self) -> dict[str, dict[str, Any]]:
        """None."""
        return {}

    def arrays(self) -> list[ArrayLayout]:
        """Shots, cycles, beamlets, and the beamlets' weights."""
        shape = self.weight.shape
        weights = scene_array("weight", WEIGHT, shape, shape, values=self.weight)
        return [weights, *(self._array(name) for name in self._outputs)]

    @cached_property
    def weight(self) -> np.ndarray:
        """Power fractions of the beamlets, (beamlets,)."""
        from sweep.model.footprint import beamlets

        return beamlets(self.beamlets, self.spec.pattern)[1]

    @property
    def _outputs(self) -> dict[str, Output]:
        return SHOTS | BEAMLETS | CYCLES

    def _array(self, name: str) -> ArrayLayout:
        output = self._outputs[name]
        sizes = SIZES | {"beamlet": self.beamlets, "shot": self.points, "cycle": self.cycles}
        cut = {"cycle": self.block_cycles, "shot": self.block_cycles * self.shots_a_cycle}
        return scene_array(
            name,
            output,
            tuple(sizes[dim] for dim in output.dims),
            tuple((sizes | cut)[dim] for dim in output.dims),
        )

    def chunks(self, block: int) -> dict[str, tuple[int, ...]]:
        """The block's chunk of every array."""
        return {
            name: (block, *(0 for _ in output.dims[1:])) for name, output in self._outputs.items()
        }

    def owners(self) -> dict[str, np.ndarray]:
        """The blocks along the first dimension of every array."""
        blocks = np.arange(self.n_blocks)
        return {
            name: blocks.reshape(-1, *(1 for _ in output.dims[1:]))
            for name, output in self._outputs.items()
        }

    def evaluate(self, block: int) -> Results:
        """What the shots of a block see."""
        first, size = block * self.block_cycles * self.shots_a_cycle, self.block_size(block)
        return self.see(np.arange(first, first + size))

    def compile(self) -> None:
        """Compile the ray caster, on the first cycle."""
        self.see(np.arange(self.shots_a_cycle))

    def see(self, index: np.ndarray) -> Results:
        """What shots see, by number (n,), in whole cycles, and these."""
        shots = self.cast(index)
        return shots | self._cycles(shots)

    def cast(self, index: np.ndarray) -> Results:
        """What any shots see, by number (n,)."""
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
        return world_of(self.spec)

    @cached_property
    def _optics(self) -> dict[str, Any]:
        """What looks at the scene, as :func:`sweep.model.eyepoints.observe` takes it."""
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
    """The scene of a study; the last one is kept, for building one can take seconds."""
    return spec.world()


def altitude(world: World, position: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Height above what lies straight below positions (n, 3) at times (n,) [m]; inf for nothing."""
    from sweep.model.geometry.rays import Pose

    states = [None if body is None else body.state(time) for body in world.bodies]
    poses = [None if state is None else Pose(state.position, state.attitude) for state in states]
    down = np.broadcast_to([0.0, 0.0, -1.0], (len(position), 1, 3))
    return np.asarray(world.caster.bundle(position, down, poses=poses).range)


def scene_array(
    name: str,
    output: Output,
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    *,
    axes: tuple[str, ...] = (),
    values: np.ndarray | None = None,
) -> ArrayLayout:
    """Layout of one of the model's arrays, with a study's axes before its own dimensions."""
    fills = {"f": float("nan"), "i": -1, "u": 0}
    return ArrayLayout(
        name=name,
        shape=shape,
        chunks=chunks,
        dims=axes + output.dims,
        dtype=output.dtype,
        fill=fills[output.dtype[0]],
        attributes=described(output.units, output.long_name, output.comment),
        values=values,
    )
