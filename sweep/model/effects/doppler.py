"""Doppler: the shift 2 v_r / lambda of every line.

Without it nothing is known of velocity at all, whatever the detection probability says: it is
left out only where lines would not move by any share of a bin that matters. Otherwise the
bound says what the shift does to detection: the receiver's transfer at the new frequency, and
where between two bins the line comes to lie.
"""

from dataclasses import replace

import numpy as np

from sweep.model.effects.effect import Effect, Scene, Size
from sweep.model.effects.footprint import by_power
from sweep.model.effects.points import Points
from sweep.model.effects.spread import NO_SPREAD
from sweep.model.preparation import Shots, doppler_ratio

NOT_AWAY = 0.1
"""Bins by which the Doppler effect may move lines and yet be left out; further, it counts whole."""


def size(points: Points) -> Size | None:
    """What the shift changes in the largest bin.

    Its size in bins counts besides, as velocity is measured by it. A line that goes elsewhere is
    not left out.
    """
    if not points.has("target.radial_velocity"):
        return None
    moved = points.doppler_shift
    away = (moved > NOT_AWAY).any(axis=0)
    shift = np.where(away, 1.0, moved.max(axis=0))
    if away.all():
        return Size(shift=shift)
    magnitude: np.ndarray | float = 0.0
    added: np.ndarray | float = 0.0
    if points.architecture != "direct":
        change = by_power(points.moved(NO_SPREAD, points.spread, moved))
        magnitude = np.where(away, 0.0, change)
    if points.adds_amplitudes:
        bins = moved * (1 + points.spread.extreme)  # the beat of a range stretches too
        added = np.where(away, 0.0, points.in_phase(bins))
    return Size(magnitude=magnitude, added=added, shift=shift)


def act(shots: Shots, scene: Scene) -> Shots:
    """Lines shifted by the radial velocity on the axis."""
    return replace(shots, beta=doppler_ratio(shots.radial_velocity))


EFFECT = Effect(
    name="doppler",
    about="shift of all lines by the radial velocity",
    stage="lines",
    size=size,
    act=act,
)
