"""A block's points through the model, in the order that shares their geometry."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model.unsupported import UnsupportedShot
from sweep.tasks.effect_selection import Selected
from sweep.tasks.grid import Grid, Value, canonical_rows
from sweep.tasks.study import (
    NONE_FOUND,
    Found,
    Known,
    Results,
    Stop,
    Unfinished,
    together,
)

if TYPE_CHECKING:
    from sweep.model.sampling import Before
    from sweep.spec import Spec

#: Points evaluated at once: enough that a call costs nothing beside them, few enough that a
#: worker's memory does not grow with the block. Their draws are cut further by the model.
SUB_BATCH = 1 << 16

#: Counts of draws held at once; many batches make a point larger.
SUB_BATCH_COUNTS = 1 << 19

#: Parameters that change how draws are looked at, and not what is drawn.
NOT_PHYSICAL = (
    "accuracy.", "instrument.processing.detector.", "instrument.processing.estimator."
)  # fmt: skip

#: Domain of the keys of draws, so that no other use of the same seed meets their streams.
DOMAIN = "sweep.draws"


def evaluated(
    spec: Spec, grid: Grid, block: int, selected: Selected, known: Known, begun: Known, stop: Stop
) -> Iterator[Found]:
    """Outputs of a block's points that are not done, those together that call for the same.

    Parameters
    ----------
    selected
        Effects simulated at each of its points, in C order over it.
    known, begun
        Results that need not be computed, whole or of first draws: of another study, and of the
        block itself from a call that was stopped.
    stop
        When to stop, with at least some draws taken.

    Raises
    ------
    Unfinished
        Where it was stopped; the next call goes on, to the same bits.
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

    Parameters
    ----------
    spec, parameters
        The study; dotted path to scalars, strings or arrays (count,).
    effects
        Names of the effects that are simulated in all of them. Outputs are means over the
        study's draws where random ones are among them, and an error where it has no draws.
    before, stop
        Draws that there are already; when to return with those that there are then, by default
        with all.
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
    """Random keys (count, 2) uint64 of points, by what they are.

    The same however closely draws are looked at, and by whatever method.
    """
    from sweep.model.philox import point_keys

    physical = {path: v for path, v in parameters.items() if not path.startswith(NOT_PHYSICAL)}
    return point_keys(canonical_rows(physical, count), domain=DOMAIN, seed=spec.seed)


def drawn_before(spec: Spec, begun: Found, points: np.ndarray) -> Before | None:
    """Draws that there are of some points of a block; None where there are none."""
    from sweep.model.outputs import DRAW_OUTPUTS, OUTPUTS, RUNNING
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
    from sweep.model.accuracy import Accuracy
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
    """Running sums of points that have none, where any point of the study may have some."""
    from sweep.model.outputs import RUNNING
    from sweep.model.realisations import RUNNING_COLUMNS

    some = spec.has_random_effects and not spec.draws.whole_spectra
    return {RUNNING: np.zeros((count, RUNNING_COLUMNS))} if some else {}


def with_few_draws(spec: Spec, most: int) -> Spec:
    """The same study with so many draws at the most, where it has any."""
    fewer = {"number": min(spec.draws.number, most), "limit": min(spec.draws.limit, most)}
    return spec.model_copy(update={"draws": spec.draws.model_copy(update=fewer)})
