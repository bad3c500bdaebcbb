"""Pointing jitter over a plane: a random rotation of the beam in each draw.

The beam is deflected by two independent normal angles of standard deviation sigma: a in the plane
of incidence (towards grazing) and b across it. From the same height over the same plane it then
meets

    sin(grazing') = sin(grazing) cos(t) - a cos(grazing) sin(t)/t,     t^2 = a^2 + b^2
    range' = range sin(grazing) / sin(grazing'),

to first order range (1 + a cot(grazing)); along the normal, range (1 + t^2/2). The instrument does
not know the deflection: its reports are those of the deflected beam.

The effect changes the geometry of a draw before anything else, and echo, lines and noise follow
from that geometry. The footprint turns with its axis. If phases follow the geometry, the footprint
of every draw fades independently.

The target's radial velocity is the component along the beam; the component across it may be stated
too. The deflected beam sees v_r cos(t) + (v_a a + v_b b) sin(t)/t.

References
----------
The equations are those of a rotation by t about an axis across the beam, derived here. PHYSICS
section 7 lists the effect; docs/physics.md, *Pointing jitter*, has that of moving instruments.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.beamlets import ZERO_OFFSET_MOMENTS, pattern_radius
from sweep.model.effects.effect import DrawAddresses, Effect, Parameter
from sweep.model.effects.error_bounds import (
    ErrorBound,
    PhaseErrorBound,
    magnitude_change_from_power,
)
from sweep.model.effects.planner_inputs import PlannerInputs

RARE_DRAW_PROBABILITY = 1e-6
"""Probability that the random deflection of a beam is larger than the error bound assumes."""

_JITTER_PATH = "target.pointing_jitter"


class PerturbedGeometry(NamedTuple):
    """Geometry of a deflected beam, in the broadcast shape; nan where the beam misses the plane."""

    range: np.ndarray
    """Range [m] along the deflected beam."""
    grazing_angle: np.ndarray
    """Angle [rad] between the deflected beam and the plane."""
    radial_velocity: np.ndarray
    """Radial velocity [m/s] along the deflected beam, positive when the range shrinks."""


def draw_jitter_angles(draw_addresses: DrawAddresses, sigma: np.ndarray) -> np.ndarray:
    """Draw the random deflection angles of beams.

    Parameters
    ----------
    draw_addresses : DrawAddresses
        Random key (n, 2) and draw number (n,) of each point
        (:class:`sweep.model.effects.effect.DrawAddresses`).
    sigma : ndarray
        Standard deviation of each angle [rad], (n,) or scalar.

    Returns
    -------
    ndarray (n, 2)
        Independent normal angles [rad]: a in the plane of incidence, and b across it.
    """
    from sweep.model.sampling.philox import STREAM_POINTING_JITTER, to_normals_by_row

    uniform_draws = draw_addresses.uniforms(STREAM_POINTING_JITTER, 2, are_polar=True)
    return to_normals_by_row(uniform_draws) * np.asarray(sigma, float)[..., None]


def perturb_geometry(
    *,
    range: ArrayLike,
    grazing_angle: ArrayLike,
    radial_velocity: ArrayLike,
    jitter_angles: np.ndarray,
    transverse_velocity: ArrayLike = (0.0, 0.0),
) -> PerturbedGeometry:
    """Compute the geometry of deflected beams.

    Parameters
    ----------
    range, grazing_angle, radial_velocity : array_like
        Values of the axis as aimed [m, rad, m/s]; they broadcast against the leading axes of the
        angles.
    jitter_angles : ndarray (..., 2)
        Deflections [rad]: a, positive towards grazing (upwards), and b across.
    transverse_velocity : array_like (..., 2)
        Velocity of the instrument along the directions of a and b [m/s].

    Returns
    -------
    PerturbedGeometry
        Range, grazing angle and radial velocity, by the equations of the module's description.
    """
    aimed_grazing, offsets = np.asarray(grazing_angle, float), np.asarray(jitter_angles, float)
    total_angle = np.hypot(offsets[..., 0], offsets[..., 1])
    sinc, cosine = np.sinc(total_angle / math.pi), np.cos(total_angle)
    grazing_sine = np.sin(aimed_grazing) * cosine - offsets[..., 0] * np.cos(aimed_grazing) * sinc
    grazing_cosine = np.cos(aimed_grazing) * cosine + offsets[..., 0] * np.sin(aimed_grazing) * sinc
    grazing = np.arctan2(grazing_sine, np.hypot(grazing_cosine, offsets[..., 1] * sinc))
    transverse_speed = (np.asarray(transverse_velocity, float) * offsets).sum(axis=-1) * sinc
    hits_plane = grazing_sine > 0
    hit_range = (
        np.asarray(range, float) * np.sin(aimed_grazing) / np.where(hits_plane, grazing_sine, 1.0)
    )
    return PerturbedGeometry(
        np.where(hits_plane, hit_range, np.nan),
        np.where(hits_plane, grazing, np.nan),
        np.asarray(radial_velocity, float) * cosine + transverse_speed,
    )


def _largest_range_change_and_line_shift(points: PlannerInputs) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest relative change of range, and shift of lines [bins], by beam deflections.

    Both hold for all beamlets, in all draws except a fraction :data:`RARE_DRAW_PROBABILITY`. The
    change of range is infinite if a beamlet may pass over the horizon.
    """
    turn_max = points[_JITTER_PATH] * math.sqrt(2 * math.log(1 / RARE_DRAW_PROBABILITY))
    rim_angle: np.ndarray | float = 0.0
    if points.n_beamlets > 1:
        rim_angle = (
            pattern_radius(points.n_beamlets, points.beamlet_pattern)
            * points.footprint_full_angles.position_spread_angle
            / 4
        )
    lowest_grazing = points["target.grazing_angle"] - rim_angle
    stays_on_plane = lowest_grazing > turn_max
    lowest_grazing = np.where(stays_on_plane, lowest_grazing, 1.0)
    range_ratio = np.where(
        stays_on_plane,
        np.sin(lowest_grazing) / np.sin(lowest_grazing - np.where(stays_on_plane, turn_max, 0.0))
        - 1,
        np.inf,
    )
    transverse_speed = np.abs(points["target.transverse_velocity"])
    velocity_change = (
        np.abs(points.target.radial_velocity) * turn_max**2 / 2 + transverse_speed * turn_max
    )
    range_ratio = np.where(turn_max > 0, np.maximum(range_ratio, turn_max**2 / 2), 0.0)
    shift_bins = (
        points.bins_per_relative_range * np.minimum(range_ratio, 1e6)
        + points.bins_per_velocity * velocity_change
    )
    return range_ratio, shift_bins


def phase_error_bound(points: PlannerInputs) -> PhaseErrorBound | None:
    """Return a bound whose shift is that of lines by random deflections of the beam.

    The result is None without random deflections.
    """
    if not points.any_nonzero(_JITTER_PATH):
        return None
    return PhaseErrorBound(
        extra_shift_window_bins=_largest_range_change_and_line_shift(points)[1]
        / points.padding_factor
    )


def error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return a bound on the change of results if jitter is omitted, in all but rare draws.

    Notes
    -----
    Echo powers change by the cube of the ratio of ranges (1/R^2 and at most Lambert's cosine). A
    footprint whose phases follow its geometry may start or stop fading, and so may lines with their
    images. No bound is known for these changes.
    """
    if not points.any_nonzero(_JITTER_PATH):
        return None
    range_ratio, shift_bins = _largest_range_change_and_line_shift(points)
    echo_change = 3 * range_ratio * (1 + range_ratio) ** 2
    power_change = (
        points.peak_power_change_bound(ZERO_OFFSET_MOMENTS, points.line_spread, shift_bins)
        + echo_change
    )
    is_unknown = points.amplitudes_may_cancel & (points[_JITTER_PATH] > 0)
    coherent_change: np.ndarray | float = 0.0
    if points.amplitudes_may_add:  # the phase between line and image changes with range
        turned_cycles = points.carriers * points.target.delay * np.minimum(range_ratio, 1e6)
        coherent_change = points.image_magnitude_bound * np.minimum(
            4 * math.pi * turned_cycles, 2.0
        )
    return ErrorBound(
        magnitude_change=np.where(is_unknown, 1.0, magnitude_change_from_power(power_change)),
        coherent_sum_change=coherent_change,
        noise_variance_change=np.minimum(echo_change, 1e6) * points.echo_shot_noise_ratio,
        threshold_follows_noise=False,
    )


def perturb_parameters(
    parameters: dict[str, np.ndarray], draw_addresses: DrawAddresses
) -> dict[str, np.ndarray]:
    """Draw range, grazing angle and velocity of deflected beams; no echo if they miss the plane.

    Parameters
    ----------
    parameters : dict of str to ndarray
        Parameters of n points by dotted path.
    draw_addresses : DrawAddresses
        Random key (n, 2) and draw number (n,) of each point
        (:class:`sweep.model.effects.effect.DrawAddresses`).

    Returns
    -------
    dict of str to ndarray
        Parameters with changed range [m], grazing angle [rad] and radial velocity [m/s]. Beams that
        miss the plane get a reflectance of 0, the range 1 m and the grazing angle pi/2.

    Notes
    -----
    sin(grazing') = sin(grazing) cos(t) - a cos(grazing) sin(t)/t for normal deflections a and b,
    t^2 = a^2 + b^2; range' = range sin(grazing) / sin(grazing'). The radial velocity becomes
    v_r cos(t) - v_p a sin(t)/t, with the transverse velocity v_p towards the near side of the
    footprint.
    """
    jitter_angles = draw_jitter_angles(draw_addresses, parameters[_JITTER_PATH])
    transverse_velocity = np.zeros_like(jitter_angles)
    transverse_velocity[:, 0] = -parameters[
        "target.transverse_velocity"
    ]  # towards the near side is away from grazing
    aimed_geometry = {name: parameters[f"target.{name}"] for name in PerturbedGeometry._fields}
    perturbed = perturb_geometry(
        jitter_angles=jitter_angles, transverse_velocity=transverse_velocity, **aimed_geometry
    )
    hits_plane = np.isfinite(perturbed.range)
    return parameters | {
        "target.range": np.where(hits_plane, perturbed.range, 1.0),
        "target.grazing_angle": np.where(hits_plane, perturbed.grazing_angle, math.pi / 2),
        "target.radial_velocity": perturbed.radial_velocity,
        "target.reflectance": np.where(hits_plane, parameters["target.reflectance"], 0.0),
    }


POINTING_JITTER = Effect(
    name="pointing_jitter",
    description="a beam that wanders from shot to shot",
    stage="draws",
    error_bound=error_bound,
    phase_error_bound=phase_error_bound,
    perturb_parameters=perturb_parameters,
    parameters=(
        Parameter(
            path=_JITTER_PATH,
            description="Standard deviation of the beam's direction, on each axis, from shot to "
            "shot",
            example="20 urad",
            limits=("0 rad", "10 deg"),
        ),
    ),
)
"""Effect that deflects the beam at random from shot to shot."""
