"""What is wrong with the detectors and estimators that a study asks for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sweep.model.noisy_spectra import DEFAULTS, DETECTOR, ESTIMATOR
from sweep.spec.axes import Axis
from sweep.spec.limits import place_on_grid
from sweep.spec.mistakes import ABSENT, Finding
from sweep.spec.sections import SPECTRA, Draws

FFT_SIZE = "instrument.processing.fft_size"
TRAINING, GUARD, RANK = (DETECTOR + name for name in ("training", "guard", "rank"))
FEWEST_BINS = 8
"""Of a spectrum that is looked at whole."""


def is_method(path: str) -> bool:
    """Whether a parameter says how whole spectra are looked at."""
    return path.startswith((DETECTOR, ESTIMATOR))


def spectra_findings(
    draws: Draws, values: Mapping[str, Any], axes: tuple[Axis, ...]
) -> list[Finding]:
    """Methods without spectra to look at, spectra without draws, CFAR windows that do not fit.

    Parameters
    ----------
    draws : Draws
        The study's draws.
    values : mapping
        SI values of the parameters off the axes, as far as they could be read.
    axes : tuple of Axis
        The axes.
    """
    if not draws.whole_spectra:
        remedy = f"set draws: {{method: {SPECTRA}, number: 1000}}, or leave it out"
        rule = f"looks at whole spectra, which draws.method {draws.method!r} does not draw"
        return [_at(path, axes, rule, remedy) for path in _asked(values, axes)]
    if not draws.any:
        rule, remedy = "draws whole spectra, and draws none", "set draws.number or draws.limit"
        return [Finding(("draws", "method"), rule, remedy, draws.method)]
    return _misfits(values, axes)


def not_on_flights(values: Mapping[str, Any], axes: tuple[Axis, ...]) -> list[Finding]:
    """Methods in the instrument of a scene's study, which draws no whole spectra."""
    rule = "looks at whole spectra, which flights over scenes do not draw"
    return [
        Finding(tuple(path.split(".")), rule, "leave it out, or study a flat target", ABSENT)
        for path in _asked(values, axes)
        if path in values
    ]


def _asked(values: Mapping[str, Any], axes: tuple[Axis, ...]) -> list[str]:
    """Methods' parameters that are not at their defaults."""
    on_axes = [member.path for axis in axes for member in axis.members if is_method(member.path)]
    changed = [path for path in DEFAULTS if values.get(path, DEFAULTS[path]) != DEFAULTS[path]]
    return [*on_axes, *(path for path in changed if path not in on_axes)]


def _misfits(values: Mapping[str, Any], axes: tuple[Axis, ...]) -> list[Finding]:
    """CFAR windows that are odd or too wide, and ranks beyond them, by the grid's extremes."""
    training, guard, rank, size = (
        _span(path, values, axes) for path in (TRAINING, GUARD, RANK, FFT_SIZE)
    )
    findings = []
    if (training % 2 == 1).any():
        findings.append(_at(TRAINING, axes, "must be even", "half of them stand on either side"))
    if training.size and rank.size and rank.max() > training.min():
        rule = f"must be at most detector.training, {training.min():g}, over the whole grid"
        findings.append(_at(RANK, axes, rule, "lower it, or write 'auto'"))
    if not (training.size and guard.size and size.size):
        return findings
    bins, needed = int(size.min()) // 2 - 1, int(training.max() + 2 * guard.max()) + 1
    if bins < max(needed, FEWEST_BINS):
        rule = f"leaves {bins} bins between DC and Nyquist, and detectors need "
        rule += f"{max(needed, FEWEST_BINS)} over the whole grid"
        findings.append(_at(FFT_SIZE, axes, rule, "lengthen it, or take fewer training cells"))
    return findings


def _span(path: str, values: Mapping[str, Any], axes: tuple[Axis, ...]) -> np.ndarray:
    """Values that a number takes in the grid; none where it could not be read."""
    for axis in axes:
        for member in axis.members:
            if member.path == path:
                return np.asarray(member.values)
    return np.asarray([values[path]] if path in values else [], dtype=float)


def _at(path: str, axes: tuple[Axis, ...], rule: str, remedy: str) -> Finding:
    return Finding(place_on_grid(path, axes), rule, remedy, ABSENT)
