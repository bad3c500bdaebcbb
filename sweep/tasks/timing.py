"""How long points take, measured on few of their draws where they have many."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.tasks.evaluate import evaluate_points, with_few_draws
from sweep.tasks.grid import Value

if TYPE_CHECKING:
    from sweep.spec import Spec


class Seconds(NamedTuple):
    """Time of some points on one core."""

    taken: float
    """Measured."""
    left_out: float
    """Of draws that were left out: of all up to their limit, of points that are not settled."""


def timed(
    spec: Spec,
    parameters: Mapping[str, Value],
    count: int,
    effects: Collection[str],
    *,
    most_draws: int,
) -> Seconds:
    """Time of some points, each drawn so many times at the most.

    The other parameters are those of :func:`evaluate_points`.
    """
    fewer = with_few_draws(spec, most_draws)
    if spec.draws.whole_spectra:
        evaluate_points(with_few_draws(spec, 1), parameters, count, effects)  # makes tables once
    begun = time.perf_counter()
    found = evaluate_points(fewer, parameters, count, effects)
    taken = time.perf_counter() - begun
    most, drawn = (max(s.draws.number, s.draws.limit) for s in (spec, fewer))
    if most == drawn:
        return Seconds(taken, 0.0)
    if spec.draws.whole_spectra:  # a point's spectrum without noise costs as much as many draws
        begun = time.perf_counter()
        evaluate_points(with_few_draws(spec, 1), parameters, count, effects)
        alone = time.perf_counter() - begun
        each = max(taken - alone, 0.0) / (drawn - 1)
        return Seconds(taken, each * (most - drawn))
    unsettled = float(np.mean(found["accuracy_missed"] > 0)) if spec.draws.adaptive else 1.0
    return Seconds(taken, taken * unsettled * (most / drawn - 1))
