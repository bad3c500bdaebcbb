"""Which effects the points of a grid call for: planned tile by tile, told point by point."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model.effects.catalogue import FLAGS_APART, flag_attributes, flags_of, names_of
from sweep.tasks.study import ArrayLayout
from sweep.tasks.tiles import Alike, Tiles

if TYPE_CHECKING:
    from sweep.model.effects.planning import Plan
    from sweep.model.eyepoints import Eyepoints
    from sweep.model.geometry.mesh import Surface
    from sweep.spec import Spec
    from sweep.tasks.grid import Grid

#: Arrays of a store that say what was simulated.
EFFECTS, ERROR = "effects", "effects_error"

TOLERANCE = "accuracy.tolerance"

#: Shots of a flight that are planned together.
TILE_SHOTS = 256

#: Points of a grid that are looked at together; of a tile, that are looked at first.
POINTS_AT_ONCE, FEW_POINTS = 1 << 14, 64


class Called(NamedTuple):
    """What is simulated at some points, (n,) each."""

    flags: np.ndarray
    """uint32: bit k for the k-th effect of the catalogue."""
    error: np.ndarray
    """Largest change of a probability that all that is left out may make."""

    def some(self, index: slice | np.ndarray) -> Called:
        """What is simulated at some of the points."""
        return Called(self.flags[index], self.error[index])

    def groups(self) -> Iterator[tuple[np.ndarray, tuple[str, ...]]]:
        """Points that call for the same effects, and these."""
        for flags in np.unique(self.flags):
            yield np.flatnonzero(self.flags == flags), names_of(int(flags))

    def together(self) -> Iterator[tuple[np.ndarray, tuple[str, ...], np.ndarray]]:
        """Points that are computed together, the effects of all of them, and their flags."""
        apart = self.flags & FLAGS_APART
        for each in np.unique(apart):
            index = np.flatnonzero(apart == each)
            own = self.flags[index]
            yield index, names_of(int(np.bitwise_or.reduce(own))), own


class Calling:
    """Plans of a grid's tiles.

    Parameters
    ----------
    spec, grid
        The study and its grid.
    """

    def __init__(self, spec: Spec, grid: Grid) -> None:
        self._modes, self.tiles = spec.modes(), Tiles(grid)
        self._known: dict[int, tuple[int, float]] = {}

    def of_block(self, block: int) -> Called:
        """What is simulated at the points of a block, in C order over it."""
        tiles, place = self.tiles.of_block(block)
        lacking = np.array([t for t in tiles.tolist() if t not in self._known], np.int64)
        for chosen, plan in self.plans(lacking):
            flags = flags_of(plan.kept)
            for tile, flag, error in zip(lacking[chosen], flags, plan.error, strict=True):
                self._known[int(tile)] = int(flag), float(error)
        found = [self._known[t] for t in tiles.tolist()]
        flags, errors = np.array([f for f, _ in found], np.uint32), np.array([e for _, e in found])
        return Called(flags[place] & ~self._absent(block), errors[place])

    def _absent(self, block: int) -> np.ndarray:
        """Flags of effects that points have nothing of, whatever their tiles have and modes say."""
        from sweep.model.effects.catalogue import DEFAULTS
        from sweep.model.effects.catalogue import EFFECTS as ALL

        grid = self.tiles.grid
        parameters = DEFAULTS | grid.parameters(block)
        flags = np.zeros(grid.block_size(block), np.uint32)
        for k, effect in enumerate(ALL):
            flags |= np.where(effect.absent(parameters), np.uint32(1 << k), np.uint32(0))
        return flags

    def of_point(self, point: int) -> tuple[str, ...]:
        """Names of the effects that are simulated at a point of the first block."""
        return names_of(int(self.of_block(0).flags[point]))

    def plans(self, tiles: np.ndarray) -> Iterator[tuple[np.ndarray, Plan]]:
        """Plans of some tiles: places among them, and the plan of these.

        A few of the points are looked at first: where these call for all that there is, the others
        cannot call for more.
        """
        sides = [side for side in self.tiles.shape if side > 1]
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
        """The plan of tiles that share words and sizes."""
        from sweep.model.effects.catalogue import DEFAULTS
        from sweep.model.effects.planning import plan
        from sweep.model.effects.points import Points

        points = Points(DEFAULTS | alike.parameters)
        tolerance = self._tolerance(alike.parameters)
        number, along = len(alike.tiles), tuple(range(1, len(self.tiles.shape) + 1))

        def tiles(values: np.ndarray) -> np.ndarray:
            most = np.max(values, axis=along) if values.ndim else values
            return np.broadcast_to(most, (number,))

        return plan(points, tiles, self._modes, tolerance)

    def _tolerance(self, parameters: Mapping[str, Any]) -> float:
        """Share of the tolerance that is for effects."""
        from sweep.model.resolution import BEAMLETS, effects_tolerance

        return effects_tolerance(parameters, int(parameters[BEAMLETS]))


class ShotsPlan(NamedTuple):
    """Plans of shots of a flight."""

    shots: np.ndarray
    """Places of the shots that see something."""
    tile: np.ndarray
    """Index of the tile of each of these."""
    plan: Plan
    """Of the tiles."""

    def called(self, number: int) -> Called:
        """What is simulated of that many shots; nothing where nothing is seen."""
        called = Called(np.zeros(number, np.uint32), np.zeros(number))
        called.flags[self.shots] = flags_of(self.plan.kept)[self.tile]
        called.error[self.shots] = self.plan.error[self.tile]
        return called


class ShotsCalling:
    """Plans of a flight's shots, at one place along its axes.

    Parameters
    ----------
    parameters, surfaces
        As of :func:`sweep.model.eyepoints.seen_ground`.
    modes
        Mode of each effect.
    rotating
        Whether any body turns.
    rays_by_tolerance
        Whether the tolerance is for the number of rays too.
    """

    def __init__(
        self,
        parameters: Mapping[str, Any],
        surfaces: Sequence[Surface],
        *,
        modes: Mapping[str, str],
        rotating: bool,
        rays_by_tolerance: bool = False,
    ) -> None:
        self._parameters, self._surfaces, self._modes = parameters, surfaces, modes
        self._rotating, self._rays_by_tolerance = rotating, rays_by_tolerance

    def plans(self, eyepoints: Eyepoints, tiles: np.ndarray) -> ShotsPlan | None:
        """Plans of shots whose tiles have these numbers, rising; None where none sees anything."""
        seen = eyepoints.seen.nonzero()[0]
        if not seen.size:
            return None
        some = eyepoints if seen.size == len(tiles) else eyepoints.some(seen)
        edges, tile = _stretches(tiles[seen])
        return ShotsPlan(seen, tile, self._plan(some, edges))

    def _plan(self, eyepoints: Eyepoints, edges: np.ndarray) -> Plan:
        """The plan of tiles of shots that all see something."""
        from sweep.model.effects.catalogue import DEFAULTS
        from sweep.model.effects.planning import plan
        from sweep.model.effects.points import Points
        from sweep.model.eyepoints import seen_ground
        from sweep.model.ground import of_rays

        shots, ground = seen_ground(eyepoints, DEFAULTS | dict(self._parameters), self._surfaces)
        points = Points(shots, of_rays(ground), rotating=self._rotating)

        def tiles(values: np.ndarray) -> np.ndarray:
            each = np.broadcast_to(values, eyepoints.time.shape)
            return np.maximum.reduceat(each, edges[:-1])

        return plan(points, tiles, self._modes, self._tolerance(eyepoints))

    def _tolerance(self, eyepoints: Eyepoints) -> float:
        """What of the tolerance is for effects."""
        from sweep.model.resolution import effects_tolerance

        number = 0 if self._rays_by_tolerance else eyepoints.offset.shape[1]
        return effects_tolerance(self._parameters, number)


def _stretches(tiles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges of stretches of the same tile among some, one at least; index of each one's stretch."""
    new = np.diff(tiles) != 0
    edges = np.concatenate([[0], np.flatnonzero(new) + 1, [tiles.size]])
    return edges, np.concatenate([[0], np.cumsum(new)])


def layouts(
    shape: tuple[int, ...], chunks: tuple[int, ...], dims: tuple[str, ...]
) -> list[ArrayLayout]:
    """Arrays that say what was simulated at each point."""
    comment = (
        "sum over the effects left out of what each may change: of pd in all three segments, of "
        "log10 of the probability of a false alarm, or of a relative magnitude, whichever is most"
    )
    return [
        ArrayLayout(
            name=EFFECTS, shape=shape, chunks=chunks, dims=dims, dtype="uint32", fill=0,
            attributes=flag_attributes(),
        ),
        ArrayLayout(
            name=ERROR, shape=shape, chunks=chunks, dims=dims, dtype="float64", fill=float("nan"),
            attributes={
                "units": "1",
                "long_name": "largest change by effects that were left out",
                "comment": comment,
            },
        ),
    ]  # fmt: skip
