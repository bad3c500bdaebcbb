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

from sweep.model.beamlets import NO_SPREAD
from sweep.model.effects.effect import Effect, EffectContext, ErrorBound, Parameter
from sweep.model.effects.planner_inputs import PlannerInputs, magnitude_change_from_power
from sweep.model.preparation import Shots, doppler_ratio

OMITTED_SHIFT_MAX_BINS = 0.1
"""Bins by which the Doppler effect may move lines and yet be left out; further, it counts whole."""


def doppler_bound(points: PlannerInputs) -> ErrorBound | None:
    """Change of the largest bin by the shift: another transfer, another place between two bins.

    The shift in bins counts besides, as velocity is measured by it. A line that goes elsewhere is
    not left out.
    """
    if not points.any_nonzero("target.radial_velocity"):
        return None
    return line_shift_bound(points, np.abs(points.radial_velocity) * points.bins_per_velocity)


def line_shift_bound(points: PlannerInputs, shift_bins: np.ndarray) -> ErrorBound:
    """Change of the largest bin by lines that all move by so many bins, by segment."""
    is_far = (shift_bins > OMITTED_SHIFT_MAX_BINS).any(axis=0)
    omitted_shift_bins = np.where(is_far, 1.0, shift_bins.max(axis=0))
    if is_far.all():
        return ErrorBound(shift_bins=omitted_shift_bins)
    magnitude_change: np.ndarray | float = 0.0
    coherent_change: np.ndarray | float = 0.0
    if points.architecture != "direct":
        near_change = magnitude_change_from_power(
            points.power_change_bound(NO_SPREAD, points.line_spread, shift_bins)
        )
        magnitude_change = np.where(is_far, 0.0, near_change)
    if points.adds_amplitudes:
        stretched_shift_bins = shift_bins * (
            1 + points.line_spread.extreme
        )  # the beat of a range stretches too
        coherent_change = np.where(is_far, 0.0, points.coherent_sum_bound(stretched_shift_bins))
    return ErrorBound(
        magnitude_change=magnitude_change,
        coherent_sum_change=coherent_change,
        shift_bins=omitted_shift_bins,
    )


def apply_doppler(shots: Shots, context: EffectContext) -> Shots:
    """Lines shifted by the radial velocity on the axis."""
    return replace(shots, doppler_ratio=doppler_ratio(shots.radial_velocity))


DOPPLER = Effect(
    name="doppler",
    description="shift of all lines by the radial velocity",
    stage="lines",
    error_bound=doppler_bound,
    apply=apply_doppler,
)


def doppler_spread_bound(points: PlannerInputs) -> ErrorBound | None:
    """Change of the largest bin by differences of velocity.

    Of amplitudes that add, lines in phase change by their own moves.
    """
    velocity_spread = points.velocity_spread
    if not np.any(velocity_spread.extreme):
        return None
    coherent_change = (
        points.coherent_sum_bound(velocity_spread.extreme) if points.adds_amplitudes else 0.0
    )
    if points.architecture == "direct":
        return ErrorBound(coherent_sum_change=coherent_change)
    power_change = points.power_change_bound(velocity_spread, points.range_spread)
    return ErrorBound(
        magnitude_change=magnitude_change_from_power(power_change),
        coherent_sum_change=coherent_change,
    )


def apply_doppler_spread(shots: Shots, context: EffectContext) -> Shots:
    """Beamlets at their own radial velocities, where there are beamlets."""
    doppler_ratios = context.ground.beamlets.doppler_ratio_offset
    if shots.doppler_ratio_offset.shape != doppler_ratios.shape:
        return shots
    doppler_ratios = context.select_beamlets(
        "doppler_spread", shots.footprint_row, doppler_ratios, shots.doppler_ratio_offset
    )
    return replace(shots, doppler_ratio_offset=doppler_ratios)


DOPPLER_SPREAD = Effect(
    name="doppler_spread",
    description="radial velocities that differ over the footprint",
    stage="lines",
    error_bound=doppler_spread_bound,
    apply=apply_doppler_spread,
    needs_own_batch=False,
    parameters=(
        Parameter(
            path="target.transverse_velocity",
            description="Speed across the line of sight, positive towards the near side of the "
            "footprint",
            example="100 m/s",
            limits=("-1000 km/s", "1000 km/s"),
            si_unit="m/s",
            is_sole_cause=False,
        ),
    ),
    parent="footprint",
)


def rotation_bound(points: PlannerInputs) -> ErrorBound | None:
    """All or nothing: velocities of turning surfaces are in the scene, and not left out."""
    return ErrorBound(probability_change=1.0) if points.has_rotating_body else None


ROTATION = Effect(
    name="rotation",
    description="surfaces of turning bodies",
    stage="lines",
    error_bound=rotation_bound,
)
