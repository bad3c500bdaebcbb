"""A study over a grid of parameters: arrays of its store, and points of a block by the model."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model.accuracy import Accuracy
from sweep.model.effects.catalogue import EFFECTS as ALL
from sweep.model.effects.catalogue import flag_attributes, names_of
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
from sweep.model.resolution import by_tolerance
from sweep.model.unsupported import UnsupportedShot
from sweep.model.waveform import PEAKS
from sweep.tasks.grid import EFFECTS, ERROR, EffectSelection, Grid, Selected, Value, canonical_rows
from sweep.tasks.study import (
    DAMAGED,
    NONE_FOUND,
    ArrayLayout,
    Found,
    GrowingStudy,
    Known,
    Results,
    Stop,
    Unfinished,
    described,
    together,
)

if TYPE_CHECKING:
    from sweep.model.sampling import Before
    from sweep.spec import Axis, Spec

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
        found = []
        for name, output in outputs_of(self.spec).items():
            layout = self.grid.array(name, output, self.grid.dims + output.dims, sizes)
            about = dict(layout.attributes)
            if name == EFFECTS:
                about |= flag_attributes()
            elif name in ACCURACY_OUTPUTS and output.dtype != "int64":
                about |= self._promise()
            found.append(replace(layout, attributes=about))
        return found

    def _promise(self) -> dict[str, float]:
        """Tolerance and confidence that half-widths are held against, but for those on axes."""
        promised = {f"accuracy.{name}": name for name in ("tolerance", "confidence")}
        off_axes = self.spec.parameters_off_axes()
        return {n: float(off_axes[path]) for path, n in promised.items() if path in off_axes}

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
        own = names_of(int(self.selection.of_block(0).flags[0]))
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
