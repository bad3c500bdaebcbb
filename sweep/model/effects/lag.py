"""Lag: the axes of transmitted and received beam are apart at the target.

A scanner has turned by omega 2R/c when the light returns, so the receiver looks to the side of the
transmitted beam. The parallax of a bistatic pair and a misalignment have the same effect. Of the
light that one mode collects, the fraction exp(-2 d^2 / (w_T^2 + w_L^2)) remains. Here d is the
distance of the axes at the target, and w_T and w_L are the radii of the transmitted and the
received beam at the target (:mod:`sweep.model.beam`). If all light in the aperture mixes, nothing
is lost.

References
----------
The fraction is the overlap of two Gaussian modes at a diffuse target, from the antenna theorem
[Siegman, Appl. Opt. 5, 1966, 1588]; docs/physics.md, *Lag*.
"""

from dataclasses import replace

import numpy as np

from sweep.model import beam
from sweep.model.effects.effect import Effect, EffectContext, Parameter
from sweep.model.effects.error_bounds import ErrorBound, magnitude_change_from_power
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.effects.requirements import ParameterRequirement, condition_equal_to
from sweep.model.preparation import Shots


def error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return the changes of the echo and of its shot noise if the beams' offset is omitted.

    The offset is the distance between the axes of transmitted and received beam at the target. The
    changes are exact, not bounds. The result is None if the axes coincide, or if all light in the
    aperture mixes.
    """
    paths = beam.SCAN_RATE_PATH, beam.SEPARATION_PATH, beam.MISALIGNMENT_PATH
    if not (beam.is_single_mode(points.parameters) and points.any_nonzero(*paths)):
        return None
    lost_fraction = 1 - beam.beam_axis_offset_transmission(points.parameters, points.range)
    echo_shot_noise_ratio = points.echo_shot_noise_ratio
    return ErrorBound(
        magnitude_change=magnitude_change_from_power(lost_fraction),
        noise_variance_change=-lost_fraction * echo_shot_noise_ratio / (1 + echo_shot_noise_ratio),
        threshold_follows_noise=False,
    )


def apply(shots: Shots, context: EffectContext) -> Shots:
    """Reduce echoes by the offset between the axes of transmitted and received beam.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Parameters of both beams; the ground is not used
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with reduced echoes, or unchanged if all light in the aperture mixes.

    Notes
    -----
    The echo's power is multiplied by exp(-2 d^2 / (w_T^2 + w_L^2)), with the distance d of the axes
    and the beam radii w_T and w_L at the target (antenna theorem, Siegman 1966). The beat's
    amplitude is multiplied by the square root of that factor.
    """
    if not beam.is_single_mode(context.parameters):
        return shots
    kept_fraction = beam.beam_axis_offset_transmission(context.parameters, shots.range)
    echo_scales = shots.echo_scales.with_scaled_echo(
        power_factor=kept_fraction, amplitude_factor=np.sqrt(kept_fraction)
    )
    return replace(shots, echo_scales=echo_scales)


_SINGLE_MODE_REQUIREMENTS = tuple(
    ParameterRequirement(
        other_path,
        condition_equal_to(word),
        "counts by the mode that a coherent receiver sees, and here all light in the aperture does",
        "take a coherent receiver of coupling: single_mode",
    )
    for other_path, word in (
        (beam.COUPLING_PATH, beam.APERTURE_COUPLING_LAW),
        (beam.ARCHITECTURE_PATH, "direct"),
    )
)


LAG = Effect(
    name="lag",
    description="a receiver that looks beside the sent beam: lag of a scan, parallax, misalignment",
    stage="light",
    error_bound=error_bound,
    apply=apply,
    parameters=(
        Parameter(
            path=beam.SCAN_RATE_PATH,
            description="Rate at which a scan turns the beams, in flights besides scanner and "
            "platform; "
            "single_mode only, as the two that follow, which add to its lag where signs agree",
            example="100 deg/s",
            limits=("-1e6 rad/s", "1e6 rad/s"),
            requirements=_SINGLE_MODE_REQUIREMENTS,
        ),
        Parameter(
            path=beam.SEPARATION_PATH,
            description="Distance of the received beam's axis from the sent one's at the "
            "instrument",
            example="40 mm",
            limits=("-1 km", "1 km"),
            si_unit="m",
            requirements=_SINGLE_MODE_REQUIREMENTS,
        ),
        Parameter(
            path=beam.MISALIGNMENT_PATH,
            description="Angle of the received beam's axis off the sent one's",
            example="5 urad",
            limits=("-10 deg", "10 deg"),
            si_unit="rad",
            requirements=_SINGLE_MODE_REQUIREMENTS,
        ),
    ),
)
"""Effect that reduces the echo by the offset between transmitted and received beam."""
