"""Effects that points need: planned tile by tile, told point by point.

Tiles are boxes of neighbouring points of a grid, or shots of a flight that follow each other. They
are fixed by the study alone, not by its blocks: what is simulated at a point does not depend on how
a study is cut up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model.effects.catalogue import DEFAULTS, FLAGS_APART, SHARED, flags_of, names_of
from sweep.model.effects.catalogue import EFFECTS as ALL
from sweep.model.effects.points import Points
from sweep.model.ground import of_rays
from sweep.model.looks import NUMBER, VOTES
from sweep.model.resolution import BEAMLETS, effects_tolerance
from sweep.tasks.grid import Grid, Value
from sweep.tasks.study import BlockGrid

if TYPE_CHECKING:
    from sweep.model.effects.planning import Plan
    from sweep.model.eyepoints import Eyepoints
    from sweep.model.geometry.mesh import Surface
    from sweep.spec import Spec

#: Arrays of a store that say what was simulated.
EFFECTS, ERROR = "effects", "effects_error"

TOLERANCE = "accuracy.tolerance"

#: Points of a tile at the most: few enough that they are much alike, enough that planning is cheap.
TILE_POINTS = 1024

#: Shots of a flight that are planned together.
TILE_SHOTS = 256

#: Points of a grid that are looked at together; of a tile, that are looked at first.
POINTS_AT_ONCE, FEW_POINTS = 1 << 14, 64

#: Numbers that set the length of records, or how closely all is computed.
UNDIVIDED = (
    "instrument.processing.fft_size",
    "instrument.processing.sample_rate",
    "instrument.processing.acquisition_delay",
    "instrument.chirp.duration",
    "footprint.beamlets",
    NUMBER,
    VOTES,
    TOLERANCE,
)


class Selected(NamedTuple):
    """Effects that are simulated at some points, (n,) each."""

    flags: np.ndarray
    """uint32: bit k for the k-th effect of the catalogue."""
    error: np.ndarray
    """Largest change of a probability that all that is left out may make."""

    def some(self, index: slice | np.ndarray) -> Selected:
        """Select some of the points."""
        return Selected(self.flags[index], self.error[index])

    def groups(self) -> Iterator[tuple[np.ndarray, tuple[str, ...]]]:
        """Points with the same effects, and these."""
        for flags in np.unique(self.flags):
            yield np.flatnonzero(self.flags == flags), names_of(int(flags))

    def together(self) -> Iterator[tuple[np.ndarray, tuple[str, ...], np.ndarray]]:
        """Points that are computed together, the effects of all of them, and their flags."""
        apart = self.flags & FLAGS_APART
        for each in np.unique(apart):
            index = np.flatnonzero(apart == each)
            own = self.flags[index]
            yield index, names_of(int(np.bitwise_or.reduce(own))), own


class Alike(NamedTuple):
    """Tiles that share every word and size."""

    code: int
    """The same for all tiles of the grid that share them."""
    tiles: np.ndarray
    """(m,): their numbers among those asked for."""
    parameters: dict[str, Value]
    """By dotted path: words, numbers, and arrays that broadcast over (m, *tile): tiles that the
    grid's edge cuts have their last points several times."""


class Tiles(BlockGrid):
    """Tiles of a grid; points of one tile share every word and every size."""

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self._undivided = tuple(self._is_undivided(k) for k in range(len(grid.dims)))
        super().__init__(grid.dims, grid.shape, tile_shape(grid.shape, self._undivided))

    def of_block(self, block: int) -> tuple[np.ndarray, np.ndarray]:
        """Tiles that a block meets, (m,), and the index into them of each of its points."""
        along = [
            np.arange(s.start, s.stop) // side
            for s, side in zip(self.grid.block(block), self.block_shape, strict=True)
        ]
        mesh = np.ix_(*along) if along else ()
        numbers = np.ravel_multi_index(mesh, self.along) if along else np.zeros((), np.int64)
        tiles, place = np.unique(numbers, return_inverse=True)
        return tiles, place.ravel()

    def alike(self, tiles: np.ndarray, every: int = 1) -> Iterator[Alike]:
        """Parameters of the points of some tiles, those together that share words and sizes.

        ``every``: of every so manieth point along each axis, and of those with the largest value
        of each parameter.
        """
        positions = np.unravel_index(tiles, self.along) if self.along else ()
        codes = np.zeros(len(tiles), np.int64)
        for k, position in enumerate(positions):
            if self._undivided[k]:
                codes = codes * self.along[k] + position
        for code in np.unique(codes) if any(self._undivided) else codes[:1]:
            chosen = np.flatnonzero(codes == code)
            parameters: dict[str, Value] = {**self.grid.fixed}
            for k, position in enumerate(positions):
                parameters |= self._along(k, position[chosen], every)
            yield Alike(int(code), chosen, parameters)

    def _is_undivided(self, axis: int) -> bool:
        return any(
            values.dtype.kind in "UO" or path in UNDIVIDED or path in SHARED
            for path, values in self.grid.values[axis].items()
        )

    def _along(self, axis: int, position: np.ndarray, every: int) -> dict[str, Value]:
        members = self.grid.values[axis]
        if self._undivided[axis]:
            first = int(position[0])
            return {path: values[first].item() for path, values in members.items()}
        side, size = self.block_shape[axis], self.shape[axis]
        within = np.minimum(position[:, None] * side + np.arange(side), size - 1)
        index = within[:, ::every]
        if every > 1:  # with the largest of each, so that none is missed that is there at all
            furthest = [np.abs(v[within].astype(float)).argmax(axis=1) for v in members.values()]
            rows = np.arange(len(position))[:, None]
            index = np.hstack([index, within[rows, np.transpose(furthest)]])
        shape = [len(position), *(1,) * len(self.shape)]
        shape[axis + 1] = index.shape[1]
        index = index.reshape(shape)
        return {path: values[index].astype(float) for path, values in members.items()}


def tile_shape(sizes: tuple[int, ...], undivided: tuple[bool, ...]) -> tuple[int, ...]:
    """Points of a tile along each axis: alike on all, but 1 where values are not to be joined."""
    shape, room = [1] * len(sizes), TILE_POINTS
    free = sorted((k for k in range(len(sizes)) if not undivided[k]), key=lambda k: sizes[k])
    for done, k in enumerate(free):
        shape[k] = min(sizes[k], max(1, int(room ** (1 / (len(free) - done)) + 1e-9)))
        room //= shape[k]
    return tuple(shape)


class EffectSelection:
    """Plans of a grid's tiles, each made once."""

    def __init__(self, spec: Spec, grid: Grid) -> None:
        self._modes, self.tiles = spec.modes(), Tiles(grid)
        self._known: dict[int, tuple[int, float]] = {}

    def of_block(self, block: int) -> Selected:
        """Effects simulated at the points of a block, in C order over it."""
        tiles, place = self.tiles.of_block(block)
        lacking = np.array([t for t in tiles.tolist() if t not in self._known], np.int64)
        for chosen, plan in self.plans(lacking):
            flags = flags_of(plan.kept)
            for tile, flag, error in zip(lacking[chosen], flags, plan.error, strict=True):
                self._known[int(tile)] = int(flag), float(error)
        found = [self._known[t] for t in tiles.tolist()]
        flags, errors = np.array([f for f, _ in found], np.uint32), np.array([e for _, e in found])
        absent = self.absent(self.tiles.grid.parameters(block), len(place))
        return Selected(flags[place] & ~absent, errors[place])

    def absent(self, parameters: Mapping[str, Value], count: int) -> np.ndarray:
        """Return the flags of effects absent from points, whatever their tiles have."""
        flags = np.zeros(count, np.uint32)
        for k, effect in enumerate(ALL):
            absent = effect.absent(DEFAULTS | dict(parameters))
            flags |= np.where(absent, np.uint32(1 << k), np.uint32(0))
        return flags

    def plans(self, tiles: np.ndarray) -> Iterator[tuple[np.ndarray, Plan]]:
        """Plans of some tiles: places among them, and the plan of these.

        A few of the points are looked at first: if these need all effects, the others cannot need
        more.
        """
        sides = [side for side in self.tiles.block_shape if side > 1]
        few = max(int((math.prod(sides) / FEW_POINTS) ** (1 / max(len(sides), 1))), 1)
        rest = np.arange(len(tiles))
        for every in (few, 1) if few > 1 else (1,):
            points = math.prod(-(-side // every) for side in sides)
            together = max(POINTS_AT_ONCE // points, 1)
            left = []
            for first in range(0, len(rest), together):
                some = rest[first : first + together]
                for alike in self.tiles.alike(tiles[some], every):
                    plan = self._plan(alike)
                    settled = np.full(len(alike.tiles), every == 1) | plan.all_kept
                    if settled.any():
                        yield some[alike.tiles[settled]], plan.some(settled)
                    left.append(some[alike.tiles[~settled]])
            rest = np.concatenate(left) if left else rest[:0]

    def _plan(self, alike: Alike) -> Plan:
        """Return the plan of tiles that share words and sizes."""
        from sweep.model.effects.planning import plan

        parameters, number = alike.parameters, len(alike.tiles)
        along = tuple(range(1, len(self.tiles.shape) + 1))

        def tiles(values: np.ndarray) -> np.ndarray:
            most = np.max(values, axis=along) if values.ndim else values
            return np.broadcast_to(most, (number,))

        tolerance = effects_tolerance(parameters, int(parameters[BEAMLETS]))  # type: ignore[arg-type]
        return plan(Points(DEFAULTS | parameters), tiles, self._modes, tolerance)


class ShotsPlan(NamedTuple):
    """Plans of shots of a flight."""

    shots: np.ndarray
    """Places of the shots that see something."""
    tile: np.ndarray
    """Index of the tile of each of these."""
    plan: Plan
    """Of the tiles."""

    def selected(self, number: int) -> Selected:
        """Effects simulated at that many shots; none where nothing is seen."""
        selected = Selected(np.zeros(number, np.uint32), np.zeros(number))
        selected.flags[self.shots] = flags_of(self.plan.kept)[self.tile]
        selected.error[self.shots] = self.plan.error[self.tile]
        return selected


def plan_shots(
    eyepoints: Eyepoints,
    tiles: np.ndarray,
    parameters: Mapping[str, Any],
    surfaces: Sequence[Surface],
    *,
    modes: Mapping[str, str],
    rotating: bool,
    rays_by_tolerance: bool = False,
) -> ShotsPlan | None:
    """Plans of a flight's shots at one place along its axes; None where none sees anything.

    ``tiles``: the number of the tile of each shot, rising. ``rays_by_tolerance``: whether the
    tolerance is for the number of rays too.
    """
    from sweep.model.effects.planning import plan
    from sweep.model.eyepoints import seen_ground

    seen = eyepoints.seen.nonzero()[0]
    if not seen.size:
        return None
    some = eyepoints if seen.size == len(tiles) else eyepoints.some(seen)
    edges, tile = _stretches(tiles[seen])
    shots, ground = seen_ground(some, DEFAULTS | dict(parameters), surfaces)
    points = Points(shots, of_rays(ground), rotating=rotating)

    def of_tiles(values: np.ndarray) -> np.ndarray:
        return np.maximum.reduceat(np.broadcast_to(values, some.time.shape), edges[:-1])

    rays = 0 if rays_by_tolerance else some.offset.shape[1]
    planned = plan(points, of_tiles, modes, effects_tolerance(parameters, rays))
    return ShotsPlan(seen, tile, planned)


def _stretches(tiles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges of stretches of the same tile among some, one at least; index of each one's stretch."""
    new = np.diff(tiles) != 0
    edges = np.concatenate([[0], np.flatnonzero(new) + 1, [tiles.size]])
    return edges, np.concatenate([[0], np.cumsum(new)])
