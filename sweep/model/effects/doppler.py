"""Doppler: the shift 2 v_r / lambda of every line, its spread over the beam, rotating bodies.

v_r is the radial velocity and lambda the wavelength. Without the shift, nothing is measured of
velocity, whatever the detection probability. The shift is skipped only if lines would not move by a
significant fraction of a bin. Let v_perp be the velocity across the beam and div the beam's
divergence. The spread matters if 2/lambda |v_perp| div is not small against a bin (100 m/s across
and 50 urad: 1.4 bins of 4.6 kHz). In a wide beam, a velocity v along the beam spreads lines as
well, by v (1 - cos theta) at the angle theta from the axis.

The surface of a rotating body moves with V + omega x (P - X) at the point P, with the velocity V of
the body's centre X and the angular velocity omega. A beamlet from O along d_b meets it at the range
R_b, at P_b = O + R_b d_b. The rotation contributes the closing speed -omega x (P_b - X) . d_b =
-omega x (O - X) . d_b, in which R_b cancels. Rotation is thus equivalent to a velocity
-omega x (O - X) of the instrument, whatever the body's shape. Its component along the beam shifts
the lines, and its component across the beam spreads them.

References
----------
The shift is [T 3.1]. Spread and rotation are derived here; docs/physics.md, *Beats*, has the beat
with all its terms.
"""

from dataclasses import replace

import numpy as np

from sweep.model.beamlets import ZERO_OFFSET_MOMENTS
from sweep.model.effects.effect import Effect, EffectContext, Parameter
from sweep.model.effects.error_bounds import ErrorBound, magnitude_change_from_power
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.preparation import Shots

OMITTED_SHIFT_MAX_BINS = 0.1
"""Largest Doppler shift of lines [FFT bins] for which the effect may be skipped. A larger shift
counts as an error of 1, so that the effect is always simulated."""


def doppler_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a bound on the change of the largest bin if the lines' Doppler shift is omitted.

    Notes
    -----
    The shift is 2 v_r / lambda, with the radial velocity v_r and the wavelength lambda. The shift
    changes the receiver's gain and the line's position between two bins. The shift in bins is an
    error too, because the shift is the measure of velocity. The effect is never skipped if the
    shift is above :data:`OMITTED_SHIFT_MAX_BINS`.
    """
    if not points.any_nonzero("target.radial_velocity"):
        return None
    return line_shift_error_bound(
        points, np.abs(points.target.radial_velocity) * points.bins_per_velocity
    )


def line_shift_error_bound(points: PlannerInputs, shift_bins: np.ndarray) -> ErrorBound:
    """Return a bound on the change of the largest bin due to a common shift of all lines.

    Parameters
    ----------
    points : PlannerInputs
        Points that are planned together.
    shift_bins : ndarray (segments, n)
        Shift of the lines of each segment [bins].

    Returns
    -------
    ErrorBound
        A shift above :data:`OMITTED_SHIFT_MAX_BINS` in any segment counts as 1 bin, so that the
        effect is kept.
    """
    is_far = (shift_bins > OMITTED_SHIFT_MAX_BINS).any(axis=0)
    omitted_shift_bins = np.where(is_far, 1.0, shift_bins.max(axis=0))
    if is_far.all():
        return ErrorBound(shift_bins=omitted_shift_bins)
    magnitude_change: np.ndarray | float = 0.0
    coherent_change: np.ndarray | float = 0.0
    if points.waveform.architecture != "direct":
        near_change = magnitude_change_from_power(
            points.peak_power_change_bound(ZERO_OFFSET_MOMENTS, points.line_spread, shift_bins)
        )
        magnitude_change = np.where(is_far, 0.0, near_change)
    if points.adds_amplitudes:
        stretched_shift_bins = shift_bins * (
            1 + points.line_spread.largest_magnitude
        )  # the Doppler ratio scales range beats as well
        coherent_change = np.where(
            is_far, 0.0, points.coherent_sum_change_bound(stretched_shift_bins)
        )
    return ErrorBound(
        magnitude_change=magnitude_change,
        coherent_sum_change=coherent_change,
        shift_bins=omitted_shift_bins,
    )


def apply_doppler(shots: Shots, context: EffectContext) -> Shots:
    """Shift all lines by the radial velocity on the beam's axis.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Not used (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the Doppler ratio of the target in their record ``motion``.

    Notes
    -----
    The Doppler ratio of the line on the axis becomes 2 v_r / c, to first order in v_r / c, with the
    radial velocity v_r. It is positive when the range shrinks. The line shifts by 2 v_r / lambda at
    the wavelength lambda [T 3.1].
    """
    return replace(shots, motion=shots.motion._replace(doppler_ratio=shots.target.doppler_ratio))


DOPPLER = Effect(
    name="doppler",
    description="shift of all lines by the radial velocity",
    stage="lines",
    error_bound=doppler_error_bound,
    apply=apply_doppler,
)
"""Effect that shifts all lines of an echo by the radial velocity on the beam's axis."""


def doppler_spread_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a bound on the change of the largest bin if all beamlets have one velocity.

    Notes
    -----
    Let v_b be the radial velocity of beamlet b, and v_0 that on the axis. The bound follows from
    mean and rms of the lines' shifts 2 (v_b - v_0) / lambda. If beamlets add as amplitudes, the
    bound is relative to their sum in phase and follows from the largest shift.
    """
    line_spread_by_velocity = points.line_spread_by_velocity
    if not np.any(line_spread_by_velocity.largest_magnitude):
        return None
    coherent_change = (
        points.coherent_sum_change_bound(line_spread_by_velocity.largest_magnitude)
        if points.adds_amplitudes
        else 0.0
    )
    if points.waveform.architecture == "direct":
        return ErrorBound(coherent_sum_change=coherent_change)
    power_change = points.peak_power_change_bound(
        line_spread_by_velocity, points.line_spread_by_range
    )
    return ErrorBound(
        magnitude_change=magnitude_change_from_power(power_change),
        coherent_sum_change=coherent_change,
    )


def apply_doppler_spread(shots: Shots, context: EffectContext) -> Shots:
    """Give beamlets their own radial velocities, if the footprint has beamlets.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Ground with the beamlets' Doppler ratios, and mask of the effect
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with Doppler ratios (rows, beamlets) relative to the axis, or unchanged if the
        footprint is one line on the axis.

    Notes
    -----
    The Doppler ratio of beamlet b minus that on the axis becomes 2 V.(d_b - d_0) / c. V is the
    velocity of the instrument relative to the ground, d_b the direction of the beamlet, and d_0
    that of the axis.
    """
    doppler_ratios = context.ground.beamlet_table.doppler_ratio_offset
    if shots.footprint.doppler_ratio_offset.shape != doppler_ratios.shape:
        return shots
    doppler_ratios = context.select_beamlet_values(
        "doppler_spread",
        shots.footprint.row_of_point,
        doppler_ratios,
        shots.footprint.doppler_ratio_offset,
    )
    return replace(shots, footprint=shots.footprint._replace(doppler_ratio_offset=doppler_ratios))


DOPPLER_SPREAD = Effect(
    name="doppler_spread",
    description="radial velocities that differ over the footprint",
    stage="lines",
    error_bound=doppler_spread_error_bound,
    apply=apply_doppler_spread,
    uses_beamlet_velocities=True,
    needs_separate_batches=False,
    parameters=(
        Parameter(
            path="target.transverse_velocity",
            description="Speed across the line of sight, positive towards the near side of the "
            "footprint",
            example="100 m/s",
            limits=("-1000 km/s", "1000 km/s"),
            si_unit="m/s",
            can_cause_effect=False,
        ),
    ),
    parent="footprint",
)
"""Effect that gives each beamlet of a footprint the Doppler shift of its own radial velocity."""


def rotation_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a probability change of 1 if any body of the scene rotates, else None.

    A change of 1 keeps the effect. The velocities of rotating surfaces are part of the scene.
    """
    return ErrorBound(probability_change=1.0) if points.has_rotating_body else None


ROTATION = Effect(
    name="rotation",
    description="surfaces of turning bodies",
    stage="lines",
    error_bound=rotation_error_bound,
)
"""Effect of rotating bodies; their surface velocities are part of the scene."""
