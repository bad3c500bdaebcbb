"""Doppler spread: over the beam's divergence one velocity has different radial velocities.

Called for when 2/lambda |v_perp| div is not small against a bin (100 m/s across and 50 urad:
1.4 bins of 4.6 kHz), or v (1 - cos theta) of a velocity along a wide beam is not. It acts on the
lines' positions in all three segments.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sweep.model.effects import footprint_phase
from sweep.model.effects.change import Change
from sweep.model.effects.effect import Effect, Parameter, Scene
from sweep.model.effects.line_spread import spread_change
from sweep.model.effects.span import any_holds
from sweep.model.preparation import Shots

if TYPE_CHECKING:
    from sweep.model.effects.block import Block

NAME = "doppler_spread"


def bound(block: "Block") -> Change | None:
    """What differences of velocity can change in the largest bin.

    That the ranges are there already makes no difference to whether this is a bound, as powers;
    of amplitudes that add, lines in phase change by their own moves.
    """
    velocities = block.spreads.velocities
    if not any_holds(np.greater(velocities.extreme, 0)):
        return None
    change = Change()
    if block.architecture != "direct":
        change = spread_change(block.lines, velocities, block.spreads.ranges, block.number)
    if not block.adds_amplitudes:
        return change
    return change._replace(added=footprint_phase.sum_added(block, block.lines, velocities.extreme))


def act(shots: Shots, scene: Scene) -> Shots:
    """Beamlets at their own radial velocities, where there are beamlets."""
    doppler = scene.ground.beamlets.doppler
    if shots.doppler.shape != doppler.shape:
        return shots
    return replace(shots, doppler=scene.beamlets(NAME, shots.row, doppler, shots.doppler))


EFFECT = Effect(
    name=NAME,
    about="radial velocities that differ over the footprint",
    stage="lines",
    bound=bound,
    act=act,
    apart=False,
    parameters=(
        Parameter(
            path="target.transverse_velocity",
            about="Speed across the line of sight, positive towards the near side of the footprint",
            si_unit="m/s",
            default=0.0,
            alone=False,
            example="100 m/s",
            at_least="-1000 km/s",
            at_most="1000 km/s",
        ),
    ),
    within="footprint",
)
