"""The scene as seen from straight above, for drawing under a point cloud."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.model.geometry.rays import Pose
from sweep.tasks.eyepoint_study import world_of
from sweep.tasks.study import FILLS, ArrayLayout, described

if TYPE_CHECKING:
    from sweep.spec import SceneSpec
    from sweep.spec.world import World

#: Nodes along the longer side, and along the shorter at least.
NODES = 256
LEAST_NODES = 16

#: Shots of each scanner that say where the flight looks, and the room left around what they see.
SAMPLE = 512
MARGIN = 0.08

#: Distance above the scene from which it is seen [m].
ABOVE = 1.0


class SceneMap(NamedTuple):
    """Heights of what a flight flies over, at its start."""

    x: np.ndarray
    """(columns,) [m]"""
    y: np.ndarray
    """(rows,) [m]"""
    height: np.ndarray
    """(rows, columns) [m]; nan where there is nothing."""
    origin: np.ndarray
    """(3,): where the scene's zero lies in the coordinates of its files [m]."""

    @classmethod
    def of(cls, spec: SceneSpec) -> SceneMap:
        """Map of the ground that the flight of a study passes and looks at."""
        world = world_of(spec)
        seen = np.concatenate([_looked_at(spec, world, name) for name in spec.scanners])
        low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
        room = MARGIN * max(*(high - low), 1.0)
        x, y = _nodes(low - room, high + room)
        top = max(mesh_top(world), seen[:, 2].max()) + ABOVE
        grid = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), top)], axis=-1)
        down = np.broadcast_to([0.0, 0.0, -1.0], (grid.size // 3, 1, 3))
        depth = world.caster.bundle(grid.reshape(-1, 3), down, poses=_poses(spec, world)).range
        height = np.where(np.isfinite(depth), top - depth, np.nan)
        return cls(x, y, height.reshape(len(y), len(x)), np.asarray(world.origin, float))

    def arrays(self) -> list[ArrayLayout]:
        """Arrays of a store that hold the map."""
        return [
            ArrayLayout.known(name, dims, values, described("m", long_name), fill=FILLS["f"])
            for name, dims, values, long_name in (
                ("map_x", ("map_x",), self.x, "x of the map's nodes"),
                ("map_y", ("map_y",), self.y, "y of the map's nodes"),
                ("map_height", ("map_y", "map_x"), self.height, "height seen from above"),
            )
        ]


def _looked_at(spec: SceneSpec, world: World, scanner: str) -> np.ndarray:
    """Positions of the platform and of what its beams hit, (n, 3)."""
    from sweep.model.geometry.quaternion import rotate

    shots = spec.cycles(scanner) * spec.shots_a_cycle(scanner)
    scan = spec.scan(scanner).shots(np.unique(np.linspace(0, shots - 1, SAMPLE).astype(int)))
    flight = spec.flight()
    state = flight.state(flight.start + scan.time)
    direction = rotate(state.attitude, scan.direction)
    # Bodies that move are looked at where they are as the flight begins: it is only a map.
    hits = world.caster.bundle(state.position, direction[:, None], poses=_poses(spec, world))
    hit = np.isfinite(hits.range)
    ground = state.position[hit] + direction[hit] * hits.range[hit, None]
    return np.concatenate([state.position, ground])


def _poses(spec: SceneSpec, world: World) -> list[Pose | None] | None:
    start = np.array([spec.flight().start])
    poses: list[Pose | None] = []
    for body in world.bodies:
        state = None if body is None else body.state(start)
        poses.append(None if state is None else Pose(state.position[0], state.attitude[0]))
    return poses or None


def mesh_top(world: World) -> float:
    """Height of the highest vertex of the bodies at rest [m]."""
    tops = [
        float(mesh.vertices[:, 2].max() + mesh.origin[2])
        for mesh, body in zip(world.caster.meshes, world.bodies, strict=True)
        if body is None
    ]
    return max(tops, default=0.0)


def _nodes(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of square cells over a rectangle."""
    step = float((high - low).max()) / (NODES - 1)
    count = np.maximum(np.ceil((high - low) / step).astype(int) + 1, LEAST_NODES)
    middle = (low + high) / 2
    x, y = (m + step * (np.arange(n) - (n - 1) / 2) for m, n in zip(middle, count, strict=True))
    return x, y
