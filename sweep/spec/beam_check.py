"""Beams that a telescope makes, or cannot make: rules that join laser, telescope and receiver."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from sweep.model import beam
from sweep.spec.axes import Axis
from sweep.spec.limits import Condition, has_point, place_on_grid
from sweep.spec.mistakes import ABSENT, Finding

_DIVERGENT = {beam.QUALITY: 1.0, beam.WAVELENGTH: 1.0, beam.DIVERGENCE: -1.0, beam.DIAMETER: -1.0}
"""Powers whose product is the waist over the aperture's radius, but for 4 / pi."""


def _is(word: str) -> Condition:
    return lambda values: values == word


def _is_not(word: str) -> Condition:
    return lambda values: values != word


def _given(values: np.ndarray) -> np.ndarray:
    return values > 0


def _missing(values: np.ndarray) -> np.ndarray:
    return values == 0


_ONE_MODE = {beam.COUPLING: _is(beam.SINGLE_MODE), beam.ARCHITECTURE: _is_not("direct")}


def beam_findings(values: Mapping[str, Any], axes: tuple[Axis, ...]) -> Iterator[Finding]:
    """Mistakes in the beams of a study's grid.

    Parameters
    ----------
    values : mapping
        SI values of the parameters off the axes, as far as they could be read.
    axes : tuple of Axis
        The axes.
    """
    known = set(values) | {member.path for axis in axes for member in axis.members}
    if not {beam.WAVELENGTH, beam.DIAMETER, beam.DIVERGENCE, beam.WAIST} <= known:
        return
    if has_point({beam.DIVERGENCE: _missing, beam.WAIST: _missing}, values, axes):
        rule = "must be given, or beam_waist in its place"
        yield Finding(place_on_grid(beam.DIVERGENCE, axes), rule, "write e.g. '50 urad'", ABSENT)
    elif has_point({beam.DIVERGENCE: _given, beam.WAIST: _given}, values, axes):
        rule = "stands beside beam_divergence, and each follows from the other"
        yield Finding(place_on_grid(beam.WAIST, axes), rule, "leave one of them out", ABSENT)
    else:
        yield from _width_findings(values, axes)


def _width_findings(values: Mapping[str, Any], axes: tuple[Axis, ...]) -> Iterator[Finding]:
    """Beams that are too wide for their aperture, or too narrow for the paraxial approximation."""
    remedy = "or set instrument.telescope.coupling: aperture, where all light mixes"
    if told := _too_narrow(values, axes, _ONE_MODE):
        at, limit = told
        rule = f"must be at least {1e6 * limit:.3g} urad, 4 M^2 lambda / (pi D): no narrower beam "
        rule += f"leaves an aperture of {1e3 * at[beam.DIAMETER]:.3g} mm"
        wider = f"widen the beam or the aperture, {remedy}"
        yield Finding(place_on_grid(beam.DIVERGENCE, axes), rule, wider, ABSENT)
    for path in (beam.WAIST, beam.RECEIVED_WAIST):
        at = _worst({path: 1.0, beam.DIAMETER: -1.0}, values, axes, _ONE_MODE | {path: _given})
        if at and at[path] > at[beam.DIAMETER] / 2:
            rule = f"must be at most {500 * at[beam.DIAMETER]:.3g} mm, the radius of the aperture"
            smaller = f"take a smaller one, or a larger aperture, {remedy}"
            yield Finding(place_on_grid(path, axes), rule, smaller, ABSENT)
        powers = {beam.QUALITY: 1.0, beam.WAVELENGTH: 1.0, path: -1.0}
        at = _worst(powers, values, axes, {path: _given})
        if at and at[path] < (least := _fitting(at, beam.WIDEST)):
            rule = (
                f"must be at least {1e6 * least:.3g} um, for the beam to spread by 90 deg at most"
            )
            yield Finding(place_on_grid(path, axes), rule, "take a larger one", ABSENT)


def too_narrow(values: Mapping[str, Any], axes: tuple[Axis, ...]) -> str:
    """Beam of a study that its aperture cannot make, in words; empty where there is none.

    Only where all light in the aperture mixes: elsewhere such a beam is refused. Parameters are
    those of :func:`beam_findings`.
    """
    for law in ({beam.COUPLING: _is(beam.APERTURE)}, {beam.ARCHITECTURE: _is("direct")}):
        if told := _too_narrow(values, axes, law):
            at, limit = told
            made = f"an aperture of {1e3 * at[beam.DIAMETER]:.3g} mm makes"
            given = f"a beam of {1e6 * at[beam.DIVERGENCE]:.3g} urad is narrower than"
            return f"{given} {made}, 4 M^2 lambda / (pi D) = {1e6 * limit:.3g} urad"
    return ""


def _too_narrow(
    values: Mapping[str, Any], axes: tuple[Axis, ...], law: Mapping[str, Condition]
) -> tuple[dict[str, float], float] | None:
    """Parameters of the narrowest beam that no aperture under a law makes, and its limit [rad]."""
    at = _worst(_DIVERGENT, values, axes, {**law, beam.DIVERGENCE: _given})
    if at and at[beam.DIVERGENCE] < (limit := _fitting(at, at[beam.DIAMETER] / 2)):
        return at, limit
    return None


def _fitting(at: Mapping[str, float], width: float) -> float:
    """Divergence [rad] of a beam with a waist [m], or waist of one with a divergence."""
    return float(beam.divergence_of(width, at[beam.WAVELENGTH], at[beam.QUALITY]))


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
    at = {path: float(values[path]) for path in (*powers, beam.QUALITY) if path in values}
    for axis in axes:
        own = {member.path: np.asarray(member.values) for member in axis.members}
        size = np.zeros(axis.size)
        for path, power in powers.items():
            size += power * np.log(own[path]) if path in own else 0.0
        for path, holds in conditions.items():
            size = np.where(holds(own[path]), size, -np.inf) if path in own else size
        at |= {path: float(own[path][size.argmax()]) for path in powers if path in own}
    return at if set(powers) <= set(at) else {}
