"""What is wrong with the effects that a study asks for: their modes, and what they lack."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from sweep.model import beam
from sweep.model.effects.catalogue import EFFECTS
from sweep.model.effects.effect import Effect, Parameter
from sweep.model.effects.noise_sources import SUN_RADIUS
from sweep.spec.axes import Axis
from sweep.spec.effect_fields import OFF, ON
from sweep.spec.fields import rules_of
from sweep.spec.limits import Condition, has_point, place_on_grid
from sweep.spec.mistakes import ABSENT, Finding
from sweep.spec.sections import Effects
from sweep.units import QuantityError

SECTION = "effects"


class Need(NamedTuple):
    """A parameter that means nothing beside some values of another."""

    path: str
    asks: Condition
    """Whether values of it need the other."""
    other: str
    """Parameter that must then have another value."""
    lacks: Condition
    """Whether values of that one will not do."""
    rule: str
    remedy: str
    if_on: bool = False
    """Whether the parameter's effect has the same need wherever it is forced on."""


def _above_zero(path: str, asks: Condition, other: str) -> Need:
    return Need(path, asks, other, lambda v: v == 0, f"needs {other}, which is 0", f"set {other}")


NEEDS = (
    *(
        Need(
            path,
            lambda value: value != 0,
            other,
            lacks,
            "counts by the mode that a coherent receiver sees, and here all light in the aperture "
            "does",
            "take a coherent receiver of coupling: single_mode",
        )
        for path in (beam.SCAN_RATE, beam.SEPARATION, beam.MISALIGNMENT)
        for other, lacks in (
            (beam.COUPLING, lambda coupling: coupling == beam.APERTURE),
            (beam.ARCHITECTURE, lambda architecture: architecture == "direct"),
        )
    ),
    _above_zero(
        "instrument.processing.bits", lambda bits: bits > 0, "instrument.processing.full_scale"
    ),
    _above_zero(
        "atmosphere.profile",
        lambda profile: np.isin(profile, ("exponential", "layer")),
        "atmosphere.extinction",
    ),
    Need(
        "target.roughness",
        lambda roughness: roughness > 0,
        "instrument.receiver.architecture",
        lambda architecture: architecture == "direct",
        "makes speckle, of which direct detection averages over an unknown number",
        "take a coherent receiver",
        if_on=True,
    ),
    Need(
        "target.roughness",
        lambda roughness: roughness > 0,
        "footprint.speckle",
        lambda law: law == "developed",
        "says how rough the target is, which developed speckle takes to be without limit",
        "set footprint.speckle: none",
    ),
    Need(
        "target.sun_distance",
        lambda distance: (distance > 0) & (distance < SUN_RADIUS),
        "instrument.laser.wavelength",
        lambda wavelength: wavelength > 0,
        f"must be 0, for no sun, or at least the sun's radius, {SUN_RADIUS:g} m",
        "set it to 1 au or so",
    ),
)


def written_modes(written: Mapping[str, Any]) -> dict[str, str]:
    """Mode of every effect by its name, of a spec as written; those unreadable are left out."""
    section = written.get(SECTION)
    modes = {}
    for name, rule in rules_of(Effects, "").items():
        default = Effects.model_fields[name].default
        with suppress(QuantityError):
            given = section.get(name, ABSENT) if isinstance(section, Mapping) else ABSENT
            modes[name] = default if given is ABSENT else rule.read(given)
    return modes


def effect_findings(
    values: Mapping[str, Any], axes: tuple[Axis, ...], modes: Mapping[str, str]
) -> list[Finding]:
    """Effects without those that they act within, and parameters without those that they need.

    Parameters
    ----------
    values : mapping
        SI values of the parameters off the axes, as far as they could be read.
    axes : tuple of Axis
        The axes.
    modes : mapping
        Mode of each effect by its name, as far as it could be read.
    """
    return [*_nesting_findings(modes), *_need_findings(values, axes, modes)]


def _nesting_findings(modes: Mapping[str, str]) -> Iterator[Finding]:
    """Effects that are on within others that are off."""
    by_name = {effect.name: effect for effect in EFFECTS}
    for effect in EFFECTS:
        outer = effect.within
        while outer and modes.get(effect.name) == ON:
            if modes.get(outer) == OFF:
                rule = f"acts within {outer}, which is off"
                remedy = f"turn {outer} on, or leave {effect.name} out"
                yield Finding((SECTION, effect.name), rule, remedy, ON)
            outer = by_name[outer].within


def _need_findings(
    values: Mapping[str, Any], axes: tuple[Axis, ...], modes: Mapping[str, str]
) -> Iterator[Finding]:
    """Parameters of effects without others that they need."""
    for need in NEEDS:
        owner = next(e for e in EFFECTS if any(p.path == need.path for p in e.parameters))
        mode = modes.get(owner.name, OFF)
        remedy = f"{need.remedy}, or effects.{owner.name}: off"
        if mode != OFF and has_point({need.path: need.asks, need.other: need.lacks}, values, axes):
            yield Finding(place_on_grid(need.path, axes), need.rule, remedy, ABSENT)
        elif need.if_on and mode == ON and has_point({need.other: need.lacks}, values, axes):
            yield Finding((SECTION, owner.name), need.rule, remedy, ON)


def without_draws(
    values: Mapping[str, Any], axes: tuple[Axis, ...], modes: Mapping[str, str]
) -> Iterator[Finding]:
    """Random effects that a grid has and, without draws, can't simulate.

    Parameters are those of :func:`effect_findings`.
    """
    rule = "is simulated by draws, and the study has none"
    for effect in EFFECTS:
        if effect.is_random and modes.get(effect.name) == ON:
            remedy = "set draws.limit or draws.number, or leave it out"
            yield Finding((SECTION, effect.name), rule, remedy, ON)
    for effect, parameter in _random_and_there(values, axes, modes):
        remedy = (
            "set draws.limit to draw until accuracy.tolerance is met, draws.number to draw so many "
            f"times, or effects.{effect.name}: off"
        )
        yield Finding(place_on_grid(parameter.path, axes), rule, remedy, ABSENT)


def not_in_flights(
    values: Mapping[str, Any], axes: tuple[Axis, ...], modes: Mapping[str, str]
) -> Iterator[Finding]:
    """Random effects that are asked for in a flight, and that only grids draw.

    Parameters are those of :func:`effect_findings`.
    """
    rule = "is not drawn in flights"
    for effect in EFFECTS:
        of_target = any(parameter.path.startswith("target.") for parameter in effect.parameters)
        if (effect.turn or of_target) and effect.is_random and modes.get(effect.name) == ON:
            instead = ": beams wander by platform.jitter" if effect.turn is not None else ""
            yield Finding((SECTION, effect.name), rule, f"leave it out{instead}", ON)
    for effect, parameter in _random_and_there(values, axes, modes):
        if effect.turn is None:
            continue  # drawn, or of a target, which a flight has not and which is told elsewhere
        remedy = f"leave it out, or set effects.{effect.name}: off"
        yield Finding(place_on_grid(parameter.path, axes), rule, remedy, ABSENT)


def _random_and_there(
    values: Mapping[str, Any], axes: tuple[Axis, ...], modes: Mapping[str, str]
) -> Iterator[tuple[Effect, Parameter]]:
    """Random effects that are not off, each with a parameter by which the scene has it."""
    for effect in EFFECTS:
        if not effect.is_random or modes.get(effect.name, OFF) == OFF:
            continue
        for parameter in effect.parameters:
            if has_point({parameter.path: _is_there(parameter)}, values, axes):
                yield effect, parameter


def _is_there(parameter: Parameter) -> Condition:
    """Whether values of a parameter bring its effect: all but its zero or `none`.

    One that is something by default only says how an effect acts that another brings.
    """
    return lambda value: (value != parameter.default) & parameter.brings
