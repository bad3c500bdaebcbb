"""A block's points through the model, in the order that shares their geometry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from sweep.tasks.grid import Grid, Value, canonical_rows
from sweep.tasks.study import Results

if TYPE_CHECKING:
    from sweep.spec import Spec

#: Points evaluated at once: enough that a call costs nothing beside them, few enough that a
#: worker's memory does not grow with the block.
SUB_BATCH = 1 << 16

#: Counts of draws held at once; many batches make a point larger.
SUB_BATCH_COUNTS = 1 << 19

#: Domain of the keys of draws, so that no other use of the same seed meets their streams.
DOMAIN = "sweep.draws"


def evaluate_block(spec: Spec, grid: Grid, block: int) -> Results:
    """Results of one block.

    Parameters
    ----------
    spec, grid
        The study and its grid.
    block
        Number of the block.

    Returns
    -------
    dict of ndarray
        Each output of the model with the block's extent as its shape; counts of draws with a last
        dimension over batches, where the study draws.
    """
    extent, parameters = grid.extent(block), grid.parameters(block)
    order = grid.geometry_order(block)
    results: Results = {}
    for points in np.split(order, range(_step(spec), len(order), _step(spec))):
        found = evaluate_points(spec, select(parameters, points), len(points))
        for name, values in found.items():
            if name not in results:
                results[name] = np.empty((len(order), *values.shape[1:]), values.dtype)
            results[name][points] = values
    return {name: values.reshape(extent + values.shape[1:]) for name, values in results.items()}


def evaluate_points(spec: Spec, parameters: Mapping[str, Value], count: int) -> Results:
    """Results of points, (count,) each; counts of draws (count, batches)."""
    from sweep.model.shot import evaluate

    outputs = evaluate(parameters)
    outputs = {name: np.broadcast_to(values, (count,)) for name, values in outputs.items()}
    return {**outputs, **_draws(spec, parameters, outputs, count)}


def select(parameters: Mapping[str, Value], points: np.ndarray) -> dict[str, Value]:
    """Parameters of some of the points: arrays are taken from, scalars stay."""
    return {
        path: value[points] if isinstance(value, np.ndarray) else value
        for path, value in parameters.items()
    }


def _step(spec: Spec) -> int:
    return max(1, min(SUB_BATCH, SUB_BATCH_COUNTS // max(1, len(batch_sizes(spec)))))


def batch_sizes(spec: Spec) -> list[int]:
    """Draws in each batch; the last one holds what is left, none where none is drawn."""
    number, batch = spec.draws.number, spec.draws.batch
    return [min(batch, number - first) for first in range(0, number, batch)]


def _draws(spec: Spec, parameters: Mapping[str, Value], outputs: Results, count: int) -> Results:
    if spec.draws.number == 0:
        return {}
    from sweep.model.draws import draw
    from sweep.model.philox import point_keys

    return draw(
        parameters,
        outputs,
        keys=point_keys(canonical_rows(parameters, count), domain=DOMAIN, seed=spec.seed),
        first_draw=0,
        batch_sizes=batch_sizes(spec),
        method=spec.draws.method,
    )


def compile_kernels(grid: Grid) -> None:
    """Compile what the model compiles, once, before workers get blocks and find it on disk."""
    evaluate_points(grid.spec, grid.parameters_at(np.zeros(1, dtype=np.int64)), 1)
