"""Points of a grid to try rungs on."""

from __future__ import annotations

import math
from collections.abc import Iterator
from time import thread_time
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model.effects.catalogue import flags_of, names_of
from sweep.tasks.accuracy.bench import NOT_IN_TRUTH, Seen, Trial, look_of, of_lines, seen_in
from sweep.tasks.accuracy.rungs import MEAN, WRITTEN, Rung
from sweep.tasks.accuracy.sample import by_chance, neighbours, spread
from sweep.tasks.calling import Calling
from sweep.tasks.evaluate import evaluate_points
from sweep.tasks.grid import Grid

if TYPE_CHECKING:
    from sweep.spec import Spec

#: Places of a part at which stretches of a block are timed, and points of a stretch at the most.
PLACES = 12
MOST_TIMES = 8192


class GridBench:
    """A sample of the points of a grid.

    Parameters
    ----------
    spec
        The study.
    points
        Points of the sample, fewer where the grid has fewer.
    seed
        Draws the points by chance; None spreads them evenly.
    """

    unit = "points"
    least_parts = 2

    def __init__(self, spec: Spec, points: int, seed: int | None = None) -> None:
        self.spec = spec
        self._grid = Grid(spec)
        shape = self._grid.shape
        self._numbers = spread(shape, points) if seed is None else by_chance(shape, points, seed)
        self._calling: dict[str, Calling] = {}
        self._names: dict[str, frozenset[str]] = {}

    @property
    def size(self) -> int:
        """Points of the sample."""
        return len(self._numbers)

    @property
    def whole(self) -> int:
        """Points of the study."""
        return self._grid.points

    def parts(self, points: int) -> list[np.ndarray]:
        """The sample in parts of about so many points."""
        return np.array_split(np.arange(self.size), max(1, round(self.size / points)))

    def effects(self, rung: Rung) -> frozenset[str]:
        """Effects that a rung calls for anywhere in the sample."""
        if rung.name not in self._names:
            flags, _ = self._planned(rung, self._numbers)
            names = (name for flag in np.unique(flags) for name in names_of(int(flag)))
            self._names[rung.name] = frozenset(names)
        return self._names[rung.name]

    @property
    def most_times(self) -> int:
        """Points of a block, as far as more of them cost no less each."""
        return min(MOST_TIMES, self._block_points)

    @property
    def _block_points(self) -> int:
        return math.prod(self._grid.block_shape)

    def try_on(self, rung: Rung, part: np.ndarray, times: int) -> Trial:
        """A rung on a part of the sample; timed on stretches of so many points, or on the part.

        What a point costs depends on those beside it, as they share what is worked out for them:
        a stretch is what the point's block computes next to it.
        """
        numbers = self._numbers[part]
        outputs, spent, planning = self._run(rung, numbers)
        timed = len(part)
        if times > 1:
            stretches = self._stretches(rung, numbers[:: -(-len(part) // PLACES)], times)
            # As many points together as a block has: what a call costs is shared by these alone.
            together = np.array_split(stretches, -(-stretches.size // self._block_points))
            runs = [self._run(rung, each)[1:] for each in together]
            spent, planning = (sum(each) for each in zip(*runs, strict=True))
            timed, planning = stretches.size, planning / len(runs)
        planning = planning if rung.plans else 0.0
        draws = int(self._calling_of(rung).tiles.grid.spec.draws.number)
        seen = seen_in(outputs, rung.estimate, draws)
        return Trial(seen, spent / timed + planning, planning)

    def forget(self) -> None:
        """Nothing is shared."""

    def truth(self, rung: Rung, place: int) -> tuple[Seen, Seen]:
        """A point in the time domain, and as the rung has it without what the truth lacks."""
        from sweep.model import shot, truth
        from sweep.model.effects.catalogue import EFFECTS

        random = {effect.name for effect in EFFECTS if effect.is_random}
        number = self._numbers[[place]]
        flags, _ = self._planned(rung, number)
        effects = [n for n in names_of(int(flags[0])) if n not in NOT_IN_TRUTH | random]
        parameters = self._calling_of(rung).tiles.grid.parameters_at(number)
        # Records walk by themselves, whatever effects are named.
        in_time = shot.evaluate(parameters, effects, look=truth.find)
        return seen_in(in_time, MEAN, 0), seen_in(shot.evaluate(parameters, effects), MEAN, 0)

    def coordinates(self) -> dict[str, tuple[np.ndarray, dict[str, Any]]]:
        """Number of each point in C order, and its place along each axis."""
        found = {"number": (self._numbers, {"long_name": "number of the point of the study"})}
        index = np.unravel_index(self._numbers, self._grid.shape) if self._grid.shape else ()
        for axis, along in zip(self.spec.axes, index, strict=True):
            for member in axis.members:
                attributes = {"units": member.units, "path": member.path}
                found[member.name] = (np.asarray(member.display)[along], attributes)
        return found

    def _calling_of(self, rung: Rung) -> Calling:
        if rung.name not in self._calling:
            spec = rung.of(self.spec)
            self._calling[rung.name] = Calling(spec, Grid(spec))  # type: ignore[arg-type]
        return self._calling[rung.name]

    def _run(self, rung: Rung, numbers: np.ndarray) -> tuple[dict[str, np.ndarray], float, float]:
        """Outputs of points, the time they take together, and that of planning one of them."""
        grid = self._calling_of(rung).tiles.grid
        flags, planning = self._planned(rung, numbers)
        outputs: dict[str, np.ndarray] = {}
        spent = 0.0
        for members, effects in self._groups(rung, flags):
            parameters = grid.parameters_at(numbers[members])
            begun = thread_time()
            found = self._evaluated(rung, grid.spec, parameters, len(members), effects)
            spent += thread_time() - begun
            for name, values in found.items():
                room = (len(numbers), *values.shape[1:])
                outputs.setdefault(name, np.empty(room, values.dtype))[members] = values
        return outputs, spent, planning

    def _stretches(self, rung: Rung, numbers: np.ndarray, times: int) -> np.ndarray:
        """Points and those that their blocks compute beside them: at other ranges, then others."""
        grid = self._calling_of(rung).tiles.grid
        paths = [{member.path for member in axis.members} for axis in grid.spec.axes]
        order = sorted(
            range(len(paths)),
            key=lambda k: (not grid.geometric[k], paths[k] == {"target.range"}),
        )
        found = []
        for number in numbers:
            point = np.unravel_index(number, grid.shape) if grid.shape else ()
            along = [int(p) // side for p, side in zip(point, grid.block_shape, strict=True)]
            block = np.ravel_multi_index(along, grid.blocks_along) if along else 0
            place = tuple(map(int, point))
            found.append(neighbours(place, grid.block(int(block)), grid.shape, times, order))
        return np.concatenate(found)

    def _planned(self, rung: Rung, numbers: np.ndarray) -> tuple[np.ndarray, float]:
        """Flags of points (n,), and the time that planning takes one.

        A plan serves a whole tile, so that a point takes its share.
        """
        tiles = self._calling_of(rung).tiles
        index = np.unravel_index(numbers, tiles.grid.shape) if tiles.grid.shape else ()
        along = [i // side for i, side in zip(index, tiles.shape, strict=True)]
        own = np.ravel_multi_index(along, tiles.along) if along else np.zeros(len(numbers), int)
        met, where = np.unique(own, return_inverse=True)
        flags = np.empty(len(met), np.uint32)
        begun = thread_time()
        for chosen, plan in self._calling_of(rung).plans(met):
            flags[chosen] = flags_of(plan.kept)
        spent = thread_time() - begun
        served = sum(math.prod(s.stop - s.start for s in tiles.points(int(tile))) for tile in met)
        return flags[where], spent / served

    def _groups(
        self, rung: Rung, flags: np.ndarray
    ) -> Iterator[tuple[np.ndarray, tuple[str, ...]]]:
        if rung.of_lines:
            written = Rung(name="as written", kind=WRITTEN)
            yield np.arange(len(flags)), of_lines(self.effects(written))
            return
        for flag in np.unique(flags):
            yield np.flatnonzero(flags == flag), names_of(int(flag))

    @staticmethod
    def _evaluated(
        rung: Rung, spec: Spec, parameters: Any, count: int, effects: tuple[str, ...]
    ) -> dict[str, np.ndarray]:
        from sweep.model.shot import evaluate

        if not rung.cells:
            return evaluate_points(spec, parameters, count, effects)
        found = evaluate(parameters, effects, look=look_of(rung))
        return {name: np.broadcast_to(values, (count,)) for name, values in found.items()}
