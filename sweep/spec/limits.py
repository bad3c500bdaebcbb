"""Rules that join several fields: a chirp longer than its echo's delay, samples to transform.

They are held against the whole grid of a study, by its extremes.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.spec.axes import Axis
from sweep.spec.mistakes import ABSENT, Finding

RANGE = "target.range"
DURATION = "instrument.chirp.duration"
DELAY = "instrument.processing.acquisition_delay"
SAMPLE_RATE = "instrument.processing.sample_rate"


def grid_findings(values: Mapping[str, float], axes: tuple[Axis, ...]) -> list[Finding]:
    """What is wrong with the combinations of values in a study's grid.

    Parameters
    ----------
    values : mapping
        SI values of the parameters off the axes, as far as they could be read.
    axes : tuple of Axis
        The axes.
    """
    known = set(values) | {member.path for axis in axes for member in axis.members}
    if not {DURATION, DELAY} <= known:
        return []
    location = tuple(DURATION.split("."))
    if RANGE in known:
        spare = _smallest_sum(
            {DURATION: 1.0, DELAY: -1.0, RANGE: -2.0 / SPEED_OF_LIGHT}, values, axes
        )
        if spare <= 0:
            rule = (
                "must exceed the acquisition delay and the echo's delay 2R/c over the whole grid, "
                f"and falls short by {-spare:.6g} s at its worst"
            )
            return [Finding(location, rule, "shorten the range or lengthen the chirp", ABSENT)]
    if SAMPLE_RATE in known:
        samples = _fewest_samples(values, axes)
        if np.floor(samples + 1e-6) < 2:
            rule = f"must leave 2 samples after the acquisition delay, and leaves {samples:.3g}"
            return [Finding(location, rule, "raise the sample rate or lengthen the chirp", ABSENT)]
    return []


def _sum_along(axis: Axis, weights: Mapping[str, float]) -> np.ndarray | float:
    """Weighted sum of an axis's own parameters, along it."""
    total: np.ndarray | float = 0.0
    for member in axis.members:
        if member.path in weights:
            total = total + weights[member.path] * np.asarray(member.values)
    return total


def _smallest_sum(
    weights: Mapping[str, float], values: Mapping[str, float], axes: tuple[Axis, ...]
) -> float:
    """Smallest weighted sum over the grid: each axis adds its own smallest part."""
    on_axes = {member.path for axis in axes for member in axis.members}
    off_axes = sum(weight * values[path] for path, weight in weights.items() if path not in on_axes)
    return float(off_axes + sum(np.min(_sum_along(axis, weights)) for axis in axes))


def _fewest_samples(values: Mapping[str, float], axes: tuple[Axis, ...]) -> float:
    """Fewest samples of one segment over the grid."""
    weights = {DURATION: 1.0, DELAY: -1.0}
    for axis in axes:
        rates = [np.asarray(m.values) for m in axis.members if m.path == SAMPLE_RATE]
        if rates:
            others = tuple(other for other in axes if other is not axis)
            own = {member.path for member in axis.members}
            rest = {path: weight for path, weight in weights.items() if path not in own}
            spare = _smallest_sum(rest, values, others) + _sum_along(axis, weights)
            return float(np.min(spare * rates[0]))
    return _smallest_sum(weights, values, axes) * values[SAMPLE_RATE]
