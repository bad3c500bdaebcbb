"""A study over a grid of parameters: arrays of its store, and points of a block by the model.

The effects of a block's points are planned tile by tile: boxes of neighbouring points, of a flight
consecutive shots. They follow from the study alone: what is simulated at a point does not depend on
how a study is cut.
"""

from __future__ import annotations

import hashlib
import math
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model.accuracy import Accuracy
from sweep.model.effects.catalogue import (
    DEFAULTS,
    FLAGS_APART,
    SHARED,
    flag_attributes,
    flags_of,
    names_of,
)
from sweep.model.effects.catalogue import EFFECTS as ALL
from sweep.model.effects.points import Points
from sweep.model.looks import NUMBER, VOTES
from sweep.model.outputs import (
    ACCURACY_OUTPUTS,
    DRAW_OUTPUTS,
    ERROR_OUTPUTS,
    OUTPUTS,
    RUNNING,
    RUNNING_COLUMNS,
    RUNNING_OUTPUTS,
    SIMULATED,
    SPECTRA_OUTPUTS,
    STRONGEST_OUTPUTS,
    Output,
)
from sweep.model.resolution import BEAMLETS, by_tolerance, effects_tolerance
from sweep.model.unsupported import UnsupportedShot
from sweep.model.waveform import PEAKS
from sweep.tasks.study import (
    DAMAGED,
    NONE_FOUND,
    TOLERANCE,
    ArrayLayout,
    BlockGrid,
    Found,
    Grid,
    GrowingStudy,
    Known,
    Results,
    Stop,
    Unfinished,
    Value,
    described,
    together,
)

if TYPE_CHECKING:
    from sweep.model.effects.planning import Plan
    from sweep.model.sampling import Before
    from sweep.spec import Axis, Spec


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

#: Points of a tile at the most: few enough that they are much alike, enough that planning is cheap.
TILE_POINTS = 1024

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

    def of_block(self, block: int, points: np.ndarray | None = None) -> Selected:
        """Effects simulated at the points of a block, in C order over it, or at some of these.

        Only the tiles of the points asked for are planned.
        """
        tiles, place = self.tiles.of_block(block)
        parameters = self.tiles.grid.parameters(block)
        if points is not None:
            met, place = np.unique(place[points], return_inverse=True)
            tiles = tiles[met]
            parameters = select(parameters, points)
        lacking = np.array([t for t in tiles.tolist() if t not in self._known], np.int64)
        for chosen, plan in self.plans(lacking):
            flags = flags_of(plan.kept)
            for tile, flag, error in zip(lacking[chosen], flags, plan.error, strict=True):
                self._known[int(tile)] = int(flag), float(error)
        found = [self._known[t] for t in tiles.tolist()]
        flags, errors = np.array([f for f, _ in found], np.uint32), np.array([e for _, e in found])
        absent = self.absent(parameters, len(place))
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


#: Dimension of the batches of draws.
BATCH = "batch"


def outputs_of(spec: Spec) -> dict[str, Output]:
    """Arrays that blocks of a study write, sorted by name, with dimensions besides the axes."""
    error = replace(
        SIMULATED[ERROR],
        comment="sum over the effects left out of what each may change: of pd in all three "
        "segments, of log10 of the probability of a false alarm, or of a relative magnitude, "
        "whichever is most",
    )
    found = {EFFECTS: replace(SIMULATED[EFFECTS], dims=()), ERROR: replace(error, dims=())}
    drawn = ACCURACY_OUTPUTS | DRAW_OUTPUTS
    if not spec.draws.any:
        found |= OUTPUTS | (STRONGEST_OUTPUTS if spec.reports_strongest else {})
    elif spec.draws.whole_spectra:
        found |= SPECTRA_OUTPUTS | drawn
    else:
        sums = RUNNING_OUTPUTS if spec.has_random_effects else {}
        found |= OUTPUTS | ERROR_OUTPUTS | drawn | sums
    further = {RUNNING: ("sum",)}
    if not spec.draws.adaptive:
        further |= dict.fromkeys(DRAW_OUTPUTS, (BATCH,))
    return {name: replace(found[name], dims=further.get(name, ())) for name in sorted(found)}


class GridStudy(GrowingStudy):
    """A study over a grid of parameters."""

    def __init__(self, spec: Spec) -> None:
        super().__init__(spec)
        self.grid = Grid(spec)
        self.selection = EffectSelection(spec, self.grid)

    @property
    def grids(self) -> tuple[Grid]:
        """Its points."""
        return (self.grid,)

    def follows_tolerance(self, block: int) -> np.ndarray | bool:
        """Mark the points of a block that a tighter tolerance computes more closely, (points,)."""
        return by_tolerance(self.grid.parameters(block))

    def attributes(self) -> dict[str, Any]:
        """Title, question, spec and the blocks' shape."""
        coordinates = [member.name for axis in self.spec.axes for member in axis.members]
        coordinates += ["batch_draws"] if batch_sizes(self.spec) else []
        return {
            "kind": "grid",
            "title": self.spec.title,
            "question": self.spec.question,
            "spec": self.spec.to_json(),
            "block_shape": list(self.grid.block_shape),
            # xarray's way to tell coordinates that share a dimension from variables
            "coordinates": " ".join(coordinates),
        }

    def known_arrays(self) -> list[ArrayLayout]:
        """Coordinates, and the sizes of batches."""
        arrays = coordinates(self.spec.axes)
        if sizes := batch_sizes(self.spec):
            about = described("1", "draws in the batch")
            arrays.append(
                ArrayLayout.known("batch_draws", (BATCH,), np.array(sizes, np.int64), about)
            )
        return arrays

    def outputs(self) -> list[ArrayLayout]:
        """Return an array for each output of the model, and for the effects simulated."""
        sizes = {BATCH: len(batch_sizes(self.spec)), "sum": RUNNING_COLUMNS}
        off_axes = self.spec.parameters_off_axes()
        promise = {  # that half-widths are held against
            name: float(off_axes[f"accuracy.{name}"])
            for name in ("tolerance", "confidence")
            if f"accuracy.{name}" in off_axes
        }
        found = []
        for name, output in outputs_of(self.spec).items():
            layout = self.grid.array(name, output, self.grid.dims + output.dims, sizes)
            about = dict(layout.attributes)
            if name == EFFECTS:
                about |= flag_attributes()
            elif name in ACCURACY_OUTPUTS and output.dtype != "int64":
                about |= promise
            found.append(replace(layout, attributes=about))
        return found

    def evaluate(
        self,
        block: int,
        begun: Known = Known(),  # noqa: B008
        stop: Stop | None = None,
    ) -> Results:
        """Return the outputs of a block; fill values where a point is beyond the model."""
        selected = self.selection.of_block(block)
        known = self._known(block, selected)
        extent, size = self.grid.extent(block), self.grid.block_size(block)
        results = {
            name: np.full((size, *layout.shape[len(extent) :]), layout.fill, layout.dtype)
            for name, layout in self.layouts.items()
        }
        results |= {EFFECTS: selected.flags, ERROR: selected.error}
        computed = evaluated(self.spec, self.grid, block, selected, known, begun, stop or Stop())
        for points, found in (known.done, begun.done, *computed):
            for name in results.keys() & found.keys():  # some are of use to later draws alone
                results[name][points] = found[name]
        return {name: values.reshape(extent + values.shape[1:]) for name, values in results.items()}

    def _known(self, block: int, selected: Selected) -> Known:
        """Points of a block that a smaller study has: whole, or their first draws."""
        if (reuse := self.earlier) is None:
            return Known()
        found = []
        for share in reuse.shares(block):
            if (older := reuse.read(share.block)) is None:
                continue
            rank, size = len(reuse.older.grids[0].shape), reuse.older.block_size(share.block)
            same = older[EFFECTS].ravel()[share.place] == selected.flags[share.points]
            results = {
                name: values.reshape(size, *values.shape[rank:])[share.place[same]]
                for name, values in older.items()
                if name not in (EFFECTS, ERROR)
            }
            found.append(Found(share.points[same], results))
        points, results = together(found)
        there = Found(points, no_sums(self.spec, points.size) | results)
        reuse.taken[block] = points.size if reuse.is_whole else 0
        return Known(done=there) if reuse.is_whole else Known(begun=there)

    def there(self, block: int) -> int:
        """Points of a block that the smaller study has, with the same effects."""
        if (reuse := self.earlier) is None:
            return 0
        selected, number = self.selection.of_block(block), 0
        for share in reuse.shares(block):
            with suppress(*DAMAGED):
                flags = reuse.chunk(EFFECTS, share.block).ravel()
                number += int(np.sum(flags[share.place] == selected.flags[share.points]))
        return number

    def compile(self) -> None:
        """Compile what the model compiles: a point with all effects that may be, and with none."""
        modes, once = self.spec.modes(), with_few_draws(self.spec, 1)
        may_be = [e.name for e in ALL if modes[e.name] != "off" and not e.is_random]
        own = names_of(int(self.selection.of_block(0, np.zeros(1, np.int64)).flags[0]))
        for effects in ({*may_be, *own}, ()):
            with suppress(UnsupportedShot):
                evaluate_points(once, self.grid.parameters_at(np.zeros(1, np.int64)), 1, effects)


def coordinates(axes: tuple[Axis, ...]) -> list[ArrayLayout]:
    """Arrays of the values along axes, in the units that they were written in."""
    return [
        ArrayLayout.known(
            member.name,
            (axis.name,),
            np.asarray(member.display),
            described(member.units, member.name.replace("_", " "), name=member.name)
            | {"path": member.path},
        )
        for axis in axes
        for member in axis.members
    ]


#: Points evaluated at once: enough that a call costs nothing beside them, few enough that a
#: worker's memory does not grow with the block. Their draws are cut further by the model.
SUB_BATCH = 1 << 16

#: Counts of draws held at once; many batches make a point larger.
SUB_BATCH_COUNTS = 1 << 19

#: Parameters that change how draws are looked at, and not what is drawn.
NOT_PHYSICAL = (
    "accuracy.", "instrument.processing.detector.", "instrument.processing.estimator.", PEAKS
)  # fmt: skip

#: Domain of the keys of draws, so that no other use of the same seed meets their streams.
DOMAIN = "sweep.draws"


def evaluated(
    spec: Spec, grid: Grid, block: int, selected: Selected, known: Known, begun: Known, stop: Stop
) -> Iterator[Found]:
    """Compute a block's points that are not done, grouped by their effects.

    Those that need not be computed are ``known``, of another study, or ``begun`` by a call that
    was stopped. Unfinished where it is stopped; the next call goes on, to the same bits.
    """
    parameters, order = grid.parameters(block), grid.geometry_order(block)
    order = order[~np.isin(order, [*known.done.points, *begun.done.points])]
    done, step = [begun.done], _step(spec)
    left = deque(
        (effects, points)
        for members, effects in selected.some(order).groups()
        for points in np.split(order[members], range(step, len(members), step))
    )
    while left:
        effects, points = left.popleft()
        if len(done) > 1 and stop():
            raise _unfinished(spec, done, NONE_FOUND)
        ours = np.isin(points, begun.begun.points).any()
        before = drawn_before(spec, (begun if ours else known).begun, points)
        some = select(parameters, points)
        try:
            results = evaluate_points(spec, some, len(points), effects, before, stop)
        except UnsupportedShot:  # costs the point that is beyond the model, and no other
            if len(points) > 1:
                left.extendleft((effects, half) for half in np.array_split(points, 2)[::-1])
            continue
        if stop.told:
            raise _unfinished(spec, done, Found(points, results))
        done.append(Found(points, results))
        yield done[-1]


def _unfinished(spec: Spec, done: list[Found], begun: Found) -> Unfinished:
    known = Known(together([each for each in done if each.points.size]), begun)
    draws = begun.results["n_draws"].sum() if begun.points.size else 0
    part = float(draws) / max(spec.draws.number, spec.draws.limit, 1)
    return Unfinished(known, known.done.points.size + part)


def evaluate_points(
    spec: Spec,
    parameters: Mapping[str, Value],
    count: int,
    effects: Collection[str],
    before: Before | None = None,
    stop: Callable[[], bool] | None = None,
) -> Results:
    """Results of points, (count,) each; counts of a fixed number of draws (count, batches).

    Parameters are scalars, strings or arrays (count,). Draws go on from those ``before``, until
    there are all or ``stop`` says so.
    """
    if spec.draws.any:
        return _drawn(spec, parameters, count, effects, before, stop)
    from sweep.model.realisations import random_effects
    from sweep.model.shot import evaluate

    if random := [effect.name for effect in random_effects(effects)]:
        raise ValueError(f"{', '.join(random)}: simulated by draws, and the study has none")
    outputs = evaluate(parameters, effects)
    return {name: np.broadcast_to(values, (count,)) for name, values in outputs.items()}


def select(parameters: Mapping[str, Value], points: np.ndarray) -> dict[str, Value]:
    """Parameters of some of the points: arrays are taken from, scalars stay."""
    return {
        path: value[points] if isinstance(value, np.ndarray) else value
        for path, value in parameters.items()
    }


def _step(spec: Spec) -> int:
    return max(1, min(SUB_BATCH, SUB_BATCH_COUNTS // max(1, len(batch_sizes(spec)))))


def batch_sizes(spec: Spec) -> list[int]:
    """Draws in each batch of a fixed number; the last one holds what is left."""
    number, batch = spec.draws.number, spec.draws.batch
    return [min(batch, number - first) for first in range(0, number, batch)]


def draw_keys(spec: Spec, parameters: Mapping[str, Value], count: int) -> np.ndarray:
    """Random keys (count, 2) uint64 of points, however closely these are looked at."""
    from sweep.model.philox import point_keys

    physical = {path: v for path, v in parameters.items() if not path.startswith(NOT_PHYSICAL)}
    return point_keys(canonical_rows(physical, count), domain=DOMAIN, seed=spec.seed)


def drawn_before(spec: Spec, begun: Found, points: np.ndarray) -> Before | None:
    """Draws that there are of some points of a block; None where there are none."""
    from sweep.model.sampling import Before

    _, theirs, ours = np.intersect1d(begun.points, points, return_indices=True)
    if not ours.size:
        return None

    def laid_out(name: str) -> np.ndarray:
        values = begun.results[name][theirs]
        room = np.zeros((len(points), *values.shape[1:]), values.dtype)
        room[ours] = values
        return room

    counts = np.stack([laid_out(name).reshape(len(points), -1) for name in DRAW_OUTPUTS])
    further = max(1, len(batch_sizes(spec))) - counts.shape[-1]
    counts = np.pad(counts, ((0, 0), (0, 0), (0, further)))
    means = {name: laid_out(name) for name in (*OUTPUTS, RUNNING) if name in begun.results}
    return Before(laid_out("n_draws"), counts, means)


def _drawn(
    spec: Spec,
    parameters: Mapping[str, Value],
    count: int,
    effects: Collection[str],
    before: Before | None,
    stop: Callable[[], bool] | None,
) -> Results:
    from sweep.model.sampling import never, simulate
    from sweep.tasks.user_code import methods

    draws = spec.draws
    given: dict[str, Any] = {
        "keys": draw_keys(spec, parameters, count), "before": before, "stop": stop or never,
        "method": draws.method, "accuracy": Accuracy.of(parameters, interval=draws.interval),
    }  # fmt: skip
    if draws.adaptive:
        given |= {"batch": draws.batch, "limit": draws.limit}
    else:
        given |= {"batch_sizes": batch_sizes(spec)}
    if draws.whole_spectra:
        return simulate(parameters, effects, methods=methods(parameters), **given)
    return no_sums(spec, count) | simulate(parameters, effects, **given)


def no_sums(spec: Spec, count: int) -> Results:
    """Return empty running sums, if any point of the study may have some."""
    some = spec.has_random_effects and not spec.draws.whole_spectra
    return {RUNNING: np.zeros((count, RUNNING_COLUMNS))} if some else {}


def with_few_draws(spec: Spec, most: int) -> Spec:
    """Limit the draws of a study, if it has any."""
    fewer = {"number": min(spec.draws.number, most), "limit": min(spec.draws.limit, most)}
    return spec.model_copy(update={"draws": spec.draws.model_copy(update=fewer)})
