"""Doppler spread: over the beam's divergence one velocity has different radial velocities.

Called for when 2/lambda |v_perp| div is not small against a bin (100 m/s across and 50 urad:
1.4 bins of 4.6 kHz), or v (1 - cos theta) of a velocity along a wide beam is not. It acts on the
lines' positions in all three segments.
"""

from dataclasses import replace

import numpy as np

from sweep.model.effects.effect import Effect, Parameter, Scene, Size
from sweep.model.effects.footprint import by_power
from sweep.model.effects.points import Points
from sweep.model.preparation import Shots

NAME = "doppler_spread"


def size(points: Points) -> Size | None:
    """What differences of velocity change in the largest bin.

    Of amplitudes that add, lines in phase change by their own moves.
    """
    velocities = points.velocity_spread
    if not np.any(velocities.extreme):
        return None
    added = points.in_phase(velocities.extreme) if points.adds_amplitudes else 0.0
    if points.architecture == "direct":
        return Size(added=added)
    power = points.moved(velocities, points.range_spread)
    return Size(magnitude=by_power(power), added=added)


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
    size=size,
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
