"""Beams that a telescope makes, or cannot make: rules that join laser, telescope and receiver."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.model.beam import (
    APERTURE,
    ARCHITECTURE,
    COUPLING,
    DIAMETER,
    DIVERGENCE,
    QUALITY,
    RECEIVED_WAIST,
    SINGLE_MODE,
    WAIST,
    WAVELENGTH,
    WIDEST,
    divergence_of,
)
from sweep.spec.axes import Axis
from sweep.spec.limits import Condition, has_point, place_on_grid
from sweep.spec.mistakes import ABSENT, Finding

if TYPE_CHECKING:
    from sweep.spec.study import Study

_DIVERGENT = {QUALITY: 1.0, WAVELENGTH: 1.0, DIVERGENCE: -1.0, DIAMETER: -1.0}
"""Powers whose product is the waist over the aperture's radius, but for 4 / pi."""


def _is(word: str) -> Condition:
    return lambda values: values == word


def _is_not(word: str) -> Condition:
    return lambda values: values != word


def _given(values: np.ndarray) -> np.ndarray:
    return values > 0


def _missing(values: np.ndarray) -> np.ndarray:
    return values == 0


_ONE_MODE = {COUPLING: _is(SINGLE_MODE), ARCHITECTURE: _is_not("direct")}


def beam_findings(values: Mapping[str, Any], axes: tuple[Axis, ...]) -> Iterator[Finding]:
    """What is wrong with the beams of a study's grid.

    Parameters
    ----------
    values : mapping
        SI values of the parameters off the axes, as far as they could be read.
    axes : tuple of Axis
        The axes.
    """
    known = set(values) | {member.path for axis in axes for member in axis.members}
    if not {WAVELENGTH, DIAMETER, DIVERGENCE, WAIST} <= known:
        return
    if has_point({DIVERGENCE: _missing, WAIST: _missing}, values, axes):
        rule = "must be given, or beam_waist in its place"
        yield Finding(place_on_grid(DIVERGENCE, axes), rule, "write e.g. '50 urad'", ABSENT)
    elif has_point({DIVERGENCE: _given, WAIST: _given}, values, axes):
        rule = "stands beside beam_divergence, and each follows from the other"
        yield Finding(place_on_grid(WAIST, axes), rule, "leave one of them out", ABSENT)
    else:
        yield from _width_findings(values, axes)


def _width_findings(values: Mapping[str, Any], axes: tuple[Axis, ...]) -> Iterator[Finding]:
    """Beams that are too wide for their aperture, or too narrow for the paraxial approximation."""
    remedy = "or set instrument.telescope.coupling: aperture, where all light mixes"
    at = _worst(_DIVERGENT, values, axes, _ONE_MODE | {DIVERGENCE: _given})
    if at and at[DIVERGENCE] < (limit := _limit(at)):
        rule = (
            f"must be at least {1e6 * limit:.3g} urad, 4 M^2 lambda / (pi D): no narrower beam leaves an "
        )
        rule += f"aperture of {1e3 * at[DIAMETER]:.3g} mm"
        remedies = f"widen the beam or the aperture, {remedy}"
        yield Finding(place_on_grid(DIVERGENCE, axes), rule, remedies, ABSENT)
    for path in (WAIST, RECEIVED_WAIST):
        at = _worst({path: 1.0, DIAMETER: -1.0}, values, axes, _ONE_MODE | {path: _given})
        if at and at[path] > at[DIAMETER] / 2:
            rule = f"must be at most {500 * at[DIAMETER]:.3g} mm, the radius of the aperture"
            remedies = f"take a smaller one, or a larger aperture, {remedy}"
            yield Finding(place_on_grid(path, axes), rule, remedies, ABSENT)
        at = _worst({QUALITY: 1.0, WAVELENGTH: 1.0, path: -1.0}, values, axes, {path: _given})
        if at and at[path] < (least := divergence_of(WIDEST, at[WAVELENGTH], at[QUALITY])):
            rule = (
                f"must be at least {1e6 * float(least):.3g} um, for the beam to spread by 90 deg at most"
            )
            yield Finding(place_on_grid(path, axes), rule, "take a larger one", ABSENT)


def too_narrow(study: Study) -> str:
    """Beam of a study that its aperture cannot make, in words; empty where there is none.

    Only where all light in the aperture mixes: elsewhere such a beam is refused.
    """
    values = study.parameters_off_axes()
    for conditions in ({COUPLING: _is(APERTURE)}, {ARCHITECTURE: _is("direct")}):
        at = _worst(_DIVERGENT, values, study.axes, conditions | {DIVERGENCE: _given})
        if at and at[DIVERGENCE] < (limit := _limit(at)):
            return (
                f"a beam of {1e6 * at[DIVERGENCE]:.3g} urad is narrower than an aperture of "
                f"{1e3 * at[DIAMETER]:.3g} mm makes, 4 M^2 lambda / (pi D) = {1e6 * limit:.3g} urad"
            )
    return ""


def _limit(at: Mapping[str, float]) -> float:
    """Least divergence of a beam whose waist fits the aperture [rad]."""
    return float(divergence_of(at[DIAMETER] / 2, at[WAVELENGTH], at[QUALITY]))


def _worst(
    powers: Mapping[str, float],
    values: Mapping[str, Any],
    axes: tuple[Axis, ...],
    conditions: Mapping[str, Condition],
) -> dict[str, float]:
    """Parameters where the product of their powers is largest; empty where conditions never hold.

    Axes vary apart: each adds its own largest part, of the places that meet its conditions.
    """
    if not has_point(conditions, values, axes):
        return {}
    at = {path: float(values[path]) for path in (*powers, QUALITY) if path in values}
    for axis in axes:
        own = {member.path: np.asarray(member.values) for member in axis.members}
        size = np.zeros(axis.size)
        for path, power in powers.items():
            size += power * np.log(own[path]) if path in own else 0.0
        for path, holds in conditions.items():
            size = np.where(holds(own[path]), size, -np.inf) if path in own else size
        at |= {path: float(own[path][size.argmax()]) for path in powers if path in own}
    return at if set(powers) <= set(at) else {}
