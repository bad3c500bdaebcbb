"""Footprint: beamlets at their own ranges, on one surface or several, with or without phases.

A beamlet is one of the rays that sample the beam. Without the effect, a beam has one line on its
axis, with all of its echo's power. The effect matters if lines spread over bins, that is if
S 2/c R div cot(grazing) N/fs is not small. S is the chirp rate, R the range, div the divergence, N
the FFT size and fs the sample rate.
"""

from dataclasses import replace

import numpy as np

from sweep.model.beamlets import BEAMLET_PATTERNS, ZERO_OFFSET_MOMENTS, OffsetMoments
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects import image_and_leakage
from sweep.model.effects.effect import Effect, EffectContext, Parameter
from sweep.model.effects.error_bounds import ErrorBound, magnitude_change_from_power
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.link_budget import relative_amplitude
from sweep.model.preparation import Shots
from sweep.model.shot_settings import CHIRP_PREFIX


def axis_surface_line_spread(points: PlannerInputs) -> OffsetMoments:
    """Return moments of the lines' offsets [FFT bins] from the line on the beam's axis.

    The offsets are due to the ranges of beamlets on the surface that the axis meets.
    """
    return points.footprint_extent.axis_surface_range_offset_moments.scaled_by(
        points.bins_per_relative_range
    )


def footprint_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a bound on the change of the largest bin if the echo is one line on the axis.

    Notes
    -----
    The beamlets' ranges spread the lines, and the beamlets' echoes add up to another
    total power than that of one line on the axis. The bound is for beamlets that add as powers.
    Velocities, other surfaces and optical phases are separate effects. In direct detection the
    beats always add as amplitudes: beamlet b of range R_b has the phase 4 pi f (R_b - R_0) / c at
    the radio frequency f, with the range R_0 of the axis.
    """
    if points.n_beamlets == 1:
        return None
    power_change = points.peak_power_change_bound(
        axis_surface_line_spread(points), ZERO_OFFSET_MOMENTS
    )
    echo_change = 2 * np.abs(points.footprint_extent.total_to_axis_echo_ratio - 1)
    if points.waveform.architecture != "direct":
        return ErrorBound(magnitude_change=magnitude_change_from_power(power_change + echo_change))
    range_deviation = (
        points.range * points.footprint_extent.axis_surface_range_offset_moments.largest_magnitude
    )
    highest_frequency = points.carriers + 2 * points[CHIRP_PREFIX + "bandwidth"]
    phase_change = np.minimum(4 * np.pi / SPEED_OF_LIGHT * highest_frequency * range_deviation, 2.0)
    coherent_change = np.where(points.is_near_image, 2 * phase_change, 0.5 * phase_change**2)
    return ErrorBound(
        magnitude_change=magnitude_change_from_power(power_change + echo_change)
        + coherent_change
        + echo_change
    )


def apply_footprint(shots: Shots, context: EffectContext) -> Shots:
    """Give beamlets their own ranges and echoes.

    Two things are left to separate effects. Beamlets on surfaces that the axis does not meet keep
    the axis's range, and all beamlets keep the axis's velocity.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Ground with the beamlets' ranges and echoes
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with relative ranges and amplitudes of beamlets, (rows, beamlets) each.

    Notes
    -----
    Beamlet b has the range R_0 (1 + r_b). R_0 is the range of the axis, and r_b the relative offset
    of the ground (:mod:`sweep.model.ground`). Its amplitude is the square root of its relative echo
    [1/sr], or with direct detection that echo itself.
    """
    row, range_offset, _, echo = context.ground.beamlet_table
    if context.ground.is_on_other_surface is not None:
        range_offset = np.where(context.ground.is_on_other_surface, 0.0, range_offset)
    return replace(
        shots,
        footprint=shots.footprint._replace(
            row_of_point=row,
            relative_range_offset=range_offset,
            doppler_ratio_offset=np.zeros_like(range_offset),
            relative_amplitude=relative_amplitude(shots.waveform.architecture, echo),
        ),
    )


FOOTPRINT = Effect(
    name="footprint",
    description="beamlets at ranges of their own",
    stage="lines",
    error_bound=footprint_error_bound,
    apply=apply_footprint,
    parameters=(
        Parameter(
            path="footprint.pattern",
            description="Arrangement of the beamlets; auto: as many as the tolerance needs lie in "
            "a line "
            "along the slope, a given number in a hexagonal lattice where their powers add, else "
            "in a sunflower",
            default="auto",
            options=("auto", *BEAMLET_PATTERNS),
        ),
    ),
)
"""Effect that gives each beamlet (ray of the beam) its own range and echo."""


def coherent_footprint_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a bound on the change of the largest bin due to optical phases of beamlets.

    Lines with these phases may cancel or amplify each other.

    Notes
    -----
    The round trip to beamlet b differs by 4 pi/lambda (R_b - R_0) in phase from that on the axis.
    Without the effect, the sum of N beamlets of amplitudes a_b has the magnitude
    A = sqrt(sum a_b^2). With large phase differences the magnitude is between 0 and sqrt(N) A
    (Cauchy and Schwarz). With small ones it is sum a_b, which may be as large. The effect is
    therefore kept wherever there are several beamlets. The line of a single beamlet adds to its own
    image.
    """
    if not points.adds_field_amplitudes:
        return None
    if points.n_beamlets == 1:
        return image_and_leakage.image_error_bound(points)
    return ErrorBound(magnitude_change=points.footprint_extent.amplitude_gain_max)


def apply_footprint_phase(shots: Shots, context: EffectContext) -> Shots:
    """Add the lines of beamlets as complex amplitudes instead of powers.

    This applies if the spec states that the optical phases follow the surface. Otherwise the shots
    are returned unchanged.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Parameter ``footprint.phases``; the ground is not used
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots whose beamlets add as amplitudes, or unchanged.

    Notes
    -----
    Bin k of the spectrum is X_k = sum_b a_b W(k - nu_b) exp(-2 pi i f tau_b), in place of
    |X_k|^2 = sum_b |a_b W(k - nu_b)|^2. Beamlet b has the amplitude a_b, its line at nu_b [bins],
    and the round-trip time tau_b. W is the transform of the window, and f the optical frequency.
    """
    if str(context.parameters["footprint.phases"]) != "coherent":
        return shots
    return replace(shots, footprint=shots.footprint._replace(adds_powers=False))


FOOTPRINT_PHASE = Effect(
    name="footprint_phase",
    description="optical phases of a smooth surface",
    stage="lines",
    error_bound=coherent_footprint_error_bound,
    apply=apply_footprint_phase,
    parent="footprint",
)
"""Effect that adds beamlets as complex amplitudes, with the optical phases of a smooth surface."""


def several_returns_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a bound on the change of the largest bin if all surfaces are at one range.

    The common range is the one on the beam's axis. The result is None if all power is on the
    surface that the axis meets.

    Notes
    -----
    Let a fraction f of the power be off the axis's surface, and let the lines of the axis's surface
    have the power a in their largest bin. With the effect the largest bin holds at least a, and no
    bin holds more than a + f. Without the effect the power f lies at the range of the axis, so the
    largest bin holds at most a plus the peak power of a line of power f. If amplitudes add, the
    only bound is their sum in phase.
    """
    other_surface_echo_fraction = np.minimum(
        points.footprint_extent.other_surface_echo_fraction, 1.0
    )
    if not (other_surface_echo_fraction > 0).any():
        return None
    if points.adds_amplitudes:
        return ErrorBound(
            magnitude_change=np.where(
                other_surface_echo_fraction > 0,
                points.footprint_extent.amplitude_gain_max + 1.0,
                0.0,
            )
        )
    line_distance_bins = (
        points.footprint_extent.other_surface_range_offset_max * points.bins_per_relative_range
    )
    power_min = points.peak_power_bounds_for_spread(axis_surface_line_spread(points)).power_min
    gain_ratio_max = np.minimum(
        np.exp(np.minimum(points.gain_slope_max * line_distance_bins, 50.0)),
        1 / points.transfer_gain**2,
    )
    added_power = (
        other_surface_echo_fraction
        * np.maximum(gain_ratio_max, 1.0)
        * np.where(points.is_near_image, 2.0, 1.01)
    )
    kept_power = np.maximum((1 - other_surface_echo_fraction) * power_min, 1e-9)
    return ErrorBound(
        magnitude_change=np.where(
            line_distance_bins > 0, np.minimum(added_power / kept_power, 1e3), 0.0
        )
    )


def apply_several_returns(shots: Shots, context: EffectContext) -> Shots:
    """Give beamlets on surfaces that the axis does not meet their own ranges.

    Without the effect these beamlets return their power from the axis's range.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Ground with the beamlets' ranges and surfaces, and mask of the effect
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with relative ranges (rows, beamlets) of all beamlets, or unchanged if all beamlets
        are on the surface that the axis meets.
    """
    range_offset = context.ground.beamlet_table.relative_range_offset
    if (
        context.ground.is_on_other_surface is None
        or shots.footprint.relative_range_offset.shape != range_offset.shape
    ):
        return shots
    range_offset = context.select_beamlet_values(
        "several_returns",
        shots.footprint.row_of_point,
        range_offset,
        shots.footprint.relative_range_offset,
    )
    return replace(shots, footprint=shots.footprint._replace(relative_range_offset=range_offset))


SEVERAL_RETURNS = Effect(
    name="several_returns",
    description="more than one surface in a footprint",
    stage="lines",
    error_bound=several_returns_error_bound,
    apply=apply_several_returns,
    parent="footprint",
    needs_separate_batches=False,
)
"""Effect that gives beamlets on surfaces that the axis does not meet their own ranges."""
