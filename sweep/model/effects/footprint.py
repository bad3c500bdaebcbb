"""Footprint: the ranges of a beam's beamlets, which spread its line over bins.

Called for when S 2/c R div cot(grazing) N/fs is not small. It acts on the lines' positions; a
beam without it has one line, on its axis, of all its echo's power. Phases between beamlets are
an effect of their own (:mod:`sweep.model.effects.footprint_phase`), the velocities too
(:mod:`sweep.model.effects.doppler_spread`).
"""

from dataclasses import replace

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, Parameter, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.effects.spread import NO_SPREAD
from sweep.model.footprint import PATTERNS
from sweep.model.preparation import Shots, relative_amplitude


def size(points: Points) -> Size | None:
    """What the ranges of the footprint change in the largest bin, and how much more it echoes.

    Of powers, without velocities, other surfaces or phases: these are within it. In direct
    detection the echoes' beats always add as amplitudes, with the phases that the ranges give to
    the radio frequency.
    """
    if points.number == 1:
        return None
    power = points.moved(points.own_spread, NO_SPREAD)
    echo = 2 * np.abs(points.footprint.echo_ratio - 1)
    if points.architecture != "direct":
        return Size(magnitude=by_power(power + echo))
    away = points.range * points.footprint.own_ranges.extreme
    highest = points.carriers + 2 * points["instrument.chirp.bandwidth"]
    phase = np.minimum(4 * np.pi / SPEED_OF_LIGHT * highest * away, 2.0)
    beside = np.where(points.near_image, 2 * phase, 0.5 * phase**2)
    return Size(magnitude=by_power(power + echo) + beside + echo)


def by_power(change: np.ndarray) -> np.ndarray:
    """Relative change of a magnitude by that of its power, downwards, which is the larger one."""
    return np.asarray(1 - np.sqrt(1 - np.minimum(change, 1.0)))


def act(shots: Shots, scene: Scene) -> Shots:
    """Beamlets at their own ranges, those on other surfaces at the axis's, all of its velocity."""
    row, offset, _, echo = scene.ground.beamlets
    if scene.ground.beside is not None:
        offset = np.where(scene.ground.beside, 0.0, offset)
    return replace(
        shots,
        row=row,
        offset=offset,
        doppler=np.zeros_like(offset),
        amplitude=relative_amplitude(shots.architecture, echo),
    )


EFFECT = Effect(
    name="footprint",
    about="beamlets at ranges of their own",
    stage="lines",
    size=size,
    act=act,
    parameters=(
        Parameter(
            path="footprint.pattern",
            about="Arrangement of the beamlets; auto: as many as the tolerance needs lie in a line "
            "along the slope, a given number in a hexagonal lattice where their powers add, else "
            "in a sunflower",
            default="auto",
            options=("auto", *PATTERNS),
        ),
    ),
)
