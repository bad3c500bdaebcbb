"""Rules that join several fields: a chirp longer than its echo's delay, samples to transform,
no more electrons than photons.

They are held against the whole grid of a study, by its extremes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from sweep.model.constants import ELEMENTARY_CHARGE, PLANCK, SPEED_OF_LIGHT
from sweep.spec.axes import Axis
from sweep.spec.fields import default_of, parameter_rules
from sweep.spec.mistakes import ABSENT, Finding, Location
from sweep.units import QuantityError

RANGE = "target.range"
DURATION = "instrument.chirp.duration"
DELAY = "instrument.processing.acquisition_delay"
SAMPLE_RATE = "instrument.processing.sample_rate"
FFT_SIZE = "instrument.processing.fft_size"
WINDOW = "instrument.processing.window"
RESPONSIVITY = "instrument.receiver.responsivity"
WAVELENGTH = "instrument.laser.wavelength"

_TRIED = 16
"""Samples with which windows are tried as they are read: with more they can be had."""

Condition = Callable[[np.ndarray], np.ndarray]
"""What holds or does not for each of several values."""


def readable(written: Mapping[str, Any], axes: Iterable[Axis]) -> dict[str, Any]:
    """SI values of the parameters off the axes by dotted path, as far as they can be read."""
    on_axes = {member.path for axis in axes for member in axis.members}
    values: dict[str, Any] = {}
    for path, rule in parameter_rules().items():
        found: Any = written
        for name in path.split("."):
            found = found.get(name, ABSENT) if isinstance(found, Mapping) else ABSENT
        if path in on_axes:
            continue
        with suppress(QuantityError):
            value = default_of(path) if found is ABSENT else rule.read(found)
            if value is not None:
                values[path] = value
    return values


def place_on_grid(path: str, axes: tuple[Axis, ...]) -> Location:
    """Where the values of a parameter stand in a spec: on its axis, if it has one."""
    for axis in axes:
        if any(member.path == path for member in axis.members):
            return ("axes", axis.name if axis.zipped else path)
    return tuple(path.split("."))


def has_point(
    conditions: Mapping[str, Condition], values: Mapping[str, Any], axes: tuple[Axis, ...]
) -> bool:
    """Whether some point of a grid meets conditions on parameters, all of them.

    Axes vary apart, and the members of one together: each axis must have a place that meets all
    conditions on its members.

    Parameters
    ----------
    conditions : mapping
        By dotted path.
    values : mapping
        SI values of the parameters off the axes, as far as they could be read.
    axes : tuple of Axis
        The axes.
    """
    on_axes = {member.path for axis in axes for member in axis.members}
    for path in set(conditions) - on_axes:
        if path not in values or not conditions[path](np.asarray(values[path])):
            return False
    for axis in axes:
        met = [
            conditions[member.path](np.asarray(member.values))
            for member in axis.members
            if member.path in conditions
        ]
        if met and not np.logical_and.reduce(met).any():
            return False
    return True


def grid_findings(values: Mapping[str, Any], axes: tuple[Axis, ...]) -> list[Finding]:
    """What is wrong with the combinations of values in a study's grid.

    Parameters
    ----------
    values : mapping
        SI values of the parameters off the axes, as far as they could be read.
    axes : tuple of Axis
        The axes.
    """
    known = set(values) | {member.path for axis in axes for member in axis.members}
    findings = _time_findings(values, axes, known) or _window_findings(values, axes, known)
    if {RESPONSIVITY, WAVELENGTH} <= known:
        per_metre = ELEMENTARY_CHARGE / (PLANCK * SPEED_OF_LIGHT)
        spare = _smallest_sum({WAVELENGTH: per_metre, RESPONSIVITY: -1.0}, values, axes)
        if spare < 0:
            rule = (
                "must not exceed that of one electron a photon, q lambda / (h c), over the whole "
                f"grid, and does so by {-spare:.3g} A/W at its worst"
            )
            remedy = "lower it; the gain of an avalanche is 'apd_gain'"
            findings += [Finding(place_on_grid(RESPONSIVITY, axes), rule, remedy, ABSENT)]
    return findings


def _time_findings(
    values: Mapping[str, Any], axes: tuple[Axis, ...], known: set[str]
) -> list[Finding]:
    """What is wrong with the chirp's duration, of the parameters that are known."""
    if not {DURATION, DELAY} <= known:
        return []
    location = place_on_grid(DURATION, axes)
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


def _window_findings(
    values: Mapping[str, Any], axes: tuple[Axis, ...], known: set[str]
) -> list[Finding]:
    """What is wrong with a window for the shortest record: some have none of a few samples."""
    if not {WINDOW, FFT_SIZE, DURATION, DELAY, SAMPLE_RATE} <= known:
        return []
    from sweep.model.window import samples

    length = int(min(_of(FFT_SIZE, values, axes).min(), _fewest_samples(values, axes) + 1e-6))
    for name in dict.fromkeys(_of(WINDOW, values, axes).tolist()):
        try:
            samples(name, min(length, _TRIED))
        except ValueError:
            rule = f"must be one that has {length} samples, as many as the shortest record, and "
            rule += f"{name} has none of so few"
            remedy = "write another one, or raise instrument.processing.fft_size"
            return [Finding(place_on_grid(WINDOW, axes), rule, remedy, ABSENT)]
    return []


def _of(path: str, values: Mapping[str, Any], axes: tuple[Axis, ...]) -> np.ndarray:
    """Values of a parameter over the grid."""
    for axis in axes:
        for member in axis.members:
            if member.path == path:
                return np.asarray(member.values)
    return np.atleast_1d(values[path])


def _sum_along(axis: Axis, weights: Mapping[str, float]) -> np.ndarray | float:
    """Weighted sum of an axis's own parameters, along it."""
    total: np.ndarray | float = 0.0
    for member in axis.members:
        if member.path in weights:
            total = total + weights[member.path] * np.asarray(member.values)
    return total


def _smallest_sum(
    weights: Mapping[str, float], values: Mapping[str, Any], axes: tuple[Axis, ...]
) -> float:
    """Smallest weighted sum over the grid: each axis adds its own smallest part."""
    on_axes = {member.path for axis in axes for member in axis.members}
    off_axes = sum(weight * values[path] for path, weight in weights.items() if path not in on_axes)
    return float(off_axes + sum(np.min(_sum_along(axis, weights)) for axis in axes))


def _fewest_samples(values: Mapping[str, Any], axes: tuple[Axis, ...]) -> float:
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
    return _smallest_sum(weights, values, axes) * float(values[SAMPLE_RATE])
