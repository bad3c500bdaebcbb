"""Doppler: the shift 2 v_r / lambda of every line.

Without it nothing is known of velocity at all, whatever the detection probability says: it is
left out only where lines would not move by any share of a bin that matters. Otherwise the
bound says what the shift does to detection: the receiver's transfer at the new frequency, and
where between two bins the line comes to lie.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sweep.model.effects import footprint_phase
from sweep.model.effects.change import Change
from sweep.model.effects.effect import Effect, Scene
from sweep.model.effects.line_spread import NO_SPREAD, NOT_AWAY, moved_change
from sweep.model.preparation import Shots, doppler_ratio

if TYPE_CHECKING:
    from sweep.model.effects.block import Block


def bound(block: "Block") -> Change | None:
    """What the shift can change in the largest bin, from the block's amplitude, which has it.

    Its size in bins counts besides, as velocity is measured by it. A line that goes elsewhere is
    not left out, nor is it any other effect's business where it was.
    """
    if not block.has("target.radial_velocity"):
        return None
    moved = block.doppler_shift
    away = (moved > NOT_AWAY).any(axis=0)
    change = Change(shift=np.where(away, 1.0, moved))
    if away.all():
        return change
    if block.architecture != "direct":
        factors = moved_change(
            block.lines, block.resting_lines, moved, NO_SPREAD, block.spread, block.number
        )
        low, high = factors.signal
        with np.errstate(divide="ignore"):
            least, most = (np.where(away, 1.0, 1 / np.asarray(end)) for end in (high, low))
        change = change._replace(signal=(least, most))
    if block.adds_amplitudes:
        bins = moved * (1 + block.spread.extreme)  # the beat of a range stretches too
        added = footprint_phase.sum_added(block, block.lines, bins)
        change = change._replace(added=np.where(away, 0.0, added))
    return change


def act(shots: Shots, scene: Scene) -> Shots:
    """Lines shifted by the radial velocity on the axis."""
    return replace(shots, beta=doppler_ratio(shots.radial_velocity))


EFFECT = Effect(
    name="doppler",
    about="shift of all lines by the radial velocity",
    stage="lines",
    bound=bound,
    act=act,
)
