"""Points of a study along its axes, block by block, and the effects that they need.

Effects are planned tile by tile: boxes of neighbouring points of a grid, or consecutive shots. They
follow from the study alone: what is simulated at a point does not depend on how a study is cut.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model.effects.catalogue import DEFAULTS, FLAGS_APART, SHARED, flags_of, names_of
from sweep.model.effects.catalogue import EFFECTS as ALL
from sweep.model.effects.points import Points
from sweep.model.ground import of_rays
from sweep.model.looks import NUMBER, VOTES
from sweep.model.resolution import BEAMLETS, effects_tolerance
from sweep.tasks.study import BlockGrid

if TYPE_CHECKING:
    from sweep.model.effects.planning import Plan
    from sweep.model.eyepoints import Eyepoints
    from sweep.model.geometry.mesh import Surface
    from sweep.spec import Axis, SceneSpec, Spec


Value = float | int | str | np.ndarray

#: Parameters that move the beamlets over the target; every other one only scales or reads lines
#: that are already placed, and is cheap once they are.
GEOMETRIC = (
    "target.range",
    "target.grazing_angle",
    "target.radial_velocity",
    "target.transverse_velocity",
    "target.pointing_jitter",
)
GEOMETRIC_PREFIXES = (
    "instrument.laser.beam_", "instrument.laser.focus", "instrument.telescope.coupling",
    "instrument.receiver.local_oscillator_waist", "footprint.",
)  # fmt: skip

#: Seconds that a block takes at the most, as :func:`seconds_a_point` has it: what is lost where a
#: worker dies. It also bounds the counts of draws, one a point and batch, to some 100 MB.
BLOCK_SECONDS = 60.0

#: Points of a block at the most, and blocks beyond which it grows: a block is some 25 files, and
#: what lists, copies or removes a store handles them one by one.
BLOCK_POINTS = 1 << 16
MOST_BLOCKS = 1 << 14


def is_geometric(axis: Axis) -> bool:
    """Tell whether any member of an axis changes where the beamlets fall."""
    return any(
        member.path in GEOMETRIC or member.path.startswith(GEOMETRIC_PREFIXES)
        for member in axis.members
    )


def seconds_a_point(spec: Spec) -> float:
    """Time of the dearest point of a study on one core, by the study alone [s].

    Measured on one machine and rounded up: the content of a block must not depend on the
    machine. Draws until a tolerance is met are reckoned with their limit.
    """
    dearest = {path: v for path, v in spec.parameters().items() if not isinstance(v, str)}
    for axis in spec.axes:
        for member in axis.members:
            if isinstance(member.values, np.ndarray):
                dearest[member.path] = member.values.max()
    draws = spec.draws
    once = 4e-5 + 2e-7 * float(dearest.get("footprint.beamlets", 0.0))
    if draws.whole_spectra:
        once += 2e-7 * float(dearest["instrument.processing.fft_size"])
    return once * max(draws.number, draws.limit, 1)


def block_shape(
    sizes: tuple[int, ...], geometric: tuple[bool, ...], block_points: int
) -> tuple[int, ...]:
    """Points of a block along each axis, given whether each axis changes the geometry.

    Radiometric axes are kept whole before geometric ones, and the last axis before the first,
    as far as the block has room: it then holds every radiometric variation of its geometry.
    """
    order = sorted(range(len(sizes)), key=lambda k: (geometric[k], -k))
    shape, room = [1] * len(sizes), block_points
    for k in order:
        shape[k] = min(sizes[k], room)
        room //= shape[k]
    return tuple(shape)


def points_a_block(points: int) -> int:
    """Points that a block holds at most in a study of so many, where it does not say."""
    return max(BLOCK_POINTS, -(-points // MOST_BLOCKS))


def most_points(spec: Spec, points: int) -> int:
    """Points that a block may hold: as the spec says, or fits it; less where each takes long."""
    asked = spec.storage.block_points or points_a_block(points)
    return max(1, min(asked, int(BLOCK_SECONDS / seconds_a_point(spec))))


class Lattice:
    """Parameters along the axes of a study: those that are fixed, and those of each axis."""

    def __init__(self, spec: Spec | SceneSpec) -> None:
        self.fixed: dict[str, float | int | str] = dict(spec.parameters())
        self._axes = tuple(spec.axes)
        self.shape = tuple(int(axis.size) for axis in self._axes)
        self.values = [{m.path: np.asarray(m.values) for m in axis.members} for axis in self._axes]
        """Values along each dimension by the parameters that they set."""


class LatticeGrid(Lattice, BlockGrid):
    """Points along axes, and perhaps further dimensions, cut into blocks."""


class Grid(LatticeGrid):
    """Points of a study over a grid, their parameters, and the blocks they are computed in."""

    def __init__(self, spec: Spec) -> None:
        Lattice.__init__(self, spec)
        self.spec = spec
        self.geometric = tuple(is_geometric(axis) for axis in self._axes)
        most = most_points(spec, math.prod(self.shape))
        dims = tuple(axis.name for axis in self._axes)
        BlockGrid.__init__(self, dims, self.shape, block_shape(self.shape, self.geometric, most))

    def parameters(self, block: int) -> dict[str, Value]:
        """Parameters of a block's points by path: scalars, or arrays (n,) in C order over it."""
        slices = self.block(block)
        index = [along.ravel() for along in np.indices(self.extent(block))]
        return self._select([s.start + along for s, along in zip(slices, index, strict=True)])

    def parameters_at(self, points: np.ndarray) -> dict[str, Value]:
        """Parameters of points given by their numbers in C order over the whole grid, (n,)."""
        return self._select(list(np.unravel_index(points, self.shape)) if self.shape else [])

    def _select(self, indices: list[np.ndarray]) -> dict[str, Value]:
        selected: dict[str, Value] = dict(self.fixed)
        for values, along in zip(self.values, indices, strict=True):
            for path, array in values.items():
                selected[path] = array[along]
        return selected

    def geometry_order(self, block: int) -> np.ndarray:
        """Order of a block's points, (n,) in C order over it, that brings equal geometry together.

        Radiometric axes run fastest, and velocities slowest: a line's change within a
        record follows them.
        """
        numbers = np.arange(self.block_size(block)).reshape(self.extent(block))
        moving = ["target.radial_velocity" in {m.path for m in axis.members} for axis in self._axes]
        axes = sorted(
            range(len(self.shape)), key=lambda k: (not self.geometric[k], not moving[k], k)
        )
        return numbers.transpose(axes).ravel()


def canonical_rows(parameters: Mapping[str, Value], count: int) -> np.ndarray:
    """Rows of float64, (count, parameters), that say what a point is by its values alone.

    A row holds every parameter, in the order of the sorted paths; strings stand as 62 bits of
    their hash.
    """
    rows = np.empty((count, len(parameters)), dtype=np.uint64)
    for column, path in enumerate(sorted(parameters)):
        rows[:, column] = _bits(parameters[path])
    return rows.view(np.float64)


def _bits(value: Value) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind == "U":
        names, inverse = np.unique(array, return_inverse=True)
        hashes = np.array([_hashed(str(name)) for name in names], dtype=np.uint64)
        return hashes[inverse].reshape(array.shape)
    return (array.astype(np.float64) + 0.0).view(np.uint64)  # -0.0 and 0.0 are the same value


@lru_cache(maxsize=256)
def _hashed(text: str) -> int:
    # 62 bits: with the upper two clear it is no nan, which no row may hold
    digest = hashlib.blake2b(text.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 2


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

    flags: np.ndarray  # uint32: bit k for the k-th effect of the catalogue
    error: np.ndarray  # largest change of a probability that all that is left out may make

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

    code: int  # the same for all tiles of the grid that share them
    tiles: np.ndarray  # (m,): their numbers among those asked for
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

        ``every``: of every so manieth point along each axis, and of the largest of each
        parameter.
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

        A few points are looked at first: if these need all effects, the others can't need
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

    shots: np.ndarray  # places of the shots that see something
    tile: np.ndarray  # index of the tile of each of these
    plan: Plan  # Of the tiles

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

    ``tiles``: the number of the tile of each shot, rising.
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
