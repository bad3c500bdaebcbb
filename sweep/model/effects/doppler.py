"""Doppler: the shift 2 v_r / lambda of every line, its spread over the beam, turning bodies.

Without the shift nothing is known of velocity at all, whatever the detection probability says: it
is left out only where lines would not move by any share of a bin that matters. The spread matters
where 2/lambda |v_perp| div is not small against a bin (100 m/s across and 50 urad: 1.4 bins of 4.6
kHz). So does v (1 - cos theta) of a velocity along a wide beam.

The surface of a turning body moves with V + omega x (P - X). A beamlet along d_b that meets it at
P_b = O + R_b d_b, seen from O, has from the rotation the closing speed -omega x (P_b - X) . d_b =
-omega x (O - X) . d_b: R_b falls out. Rotation is thus what a velocity -omega x (O - X) of the
instrument would be, whatever the body's form: a shift by its component along the beam, a spread by
that across it.
"""

from dataclasses import replace

import numpy as np

from sweep.model.effects.effect import Effect, Parameter, Scene, Size
from sweep.model.effects.points import Points, by_power
from sweep.model.footprint import NO_SPREAD
from sweep.model.preparation import Shots, doppler_ratio

NOT_AWAY = 0.1
"""Bins by which the Doppler effect may move lines and yet be left out; further, it counts whole."""


def size(points: Points) -> Size | None:
    """Change of the largest bin by the shift: another transfer, another place between two bins.

    The shift in bins counts besides, as velocity is measured by it. A line that goes elsewhere is
    not left out.
    """
    if not points.has("target.radial_velocity"):
        return None
    return moved_size(points, np.abs(points.radial_velocity) * points.per_velocity)


def moved_size(points: Points, moved: np.ndarray) -> Size:
    """Change of the largest bin by lines that all move by so many bins, by segment."""
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


def shift(shots: Shots, scene: Scene) -> Shots:
    """Lines shifted by the radial velocity on the axis."""
    return replace(shots, beta=doppler_ratio(shots.radial_velocity))


DOPPLER = Effect(
    name="doppler",
    about="shift of all lines by the radial velocity",
    stage="lines",
    size=size,
    act=shift,
)


def spread_size(points: Points) -> Size | None:
    """Change of the largest bin by differences of velocity.

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


def spread(shots: Shots, scene: Scene) -> Shots:
    """Beamlets at their own radial velocities, where there are beamlets."""
    doppler = scene.ground.beamlets.doppler
    if shots.doppler.shape != doppler.shape:
        return shots
    doppler = scene.beamlets("doppler_spread", shots.row, doppler, shots.doppler)
    return replace(shots, doppler=doppler)


DOPPLER_SPREAD = Effect(
    name="doppler_spread",
    about="radial velocities that differ over the footprint",
    stage="lines",
    size=spread_size,
    act=spread,
    apart=False,
    parameters=(
        Parameter(
            path="target.transverse_velocity",
            about="Speed across the line of sight, positive towards the near side of the footprint",
            example="100 m/s",
            limits=("-1000 km/s", "1000 km/s"),
            si_unit="m/s",
            alone=False,
        ),
    ),
    within="footprint",
)


def rotation_size(points: Points) -> Size | None:
    """All or nothing: velocities of turning surfaces are in the scene, and not left out."""
    return Size(chance=1.0) if points.rotating else None


ROTATION = Effect(
    name="rotation", about="surfaces of turning bodies", stage="lines", size=rotation_size
)
