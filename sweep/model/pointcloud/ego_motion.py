"""Motion of the instrument within a shot, as far as it is known, and the remaining errors.

The beats of a shot give range and radial velocity some milliseconds after its start. They are wrong
if the closing speed grows meanwhile. Let the segments start at t_i, with optical frequencies f_i
and chirp rates r_i. The middle of each record is t_c after its segment's start. The beam meets
scatterers that close at v and accelerate at a, and ground whose range along the beam falls at u. To
first order the beats are

    f_i (2/c) (v + a (t_i + t_c)) - r_i (2/c) (R - u t_i - (v + u) t_c - a (t_i^2 + ...) / 2)

and the fit assumes a = 0 and u = v. The remainder of each beat,

    (2/c) f_i a (t_i + t_c)
    - (2/c) r_i [ (v - u) (t_i + t_c) - a (t_i^2 / 2 + 2 t_i t_c + 3/2 t_c^2) ],

shifts range and velocity by the same fit, which is linear. For Table 4.1 an acceleration of 11
m/s^2 shifts the range by 0.55 m. A beam that turns by 20 deg/s has the same effect, through a =
V.d'.

**Known motion.** Inertial sensors and the scanner give the instrument its velocity V, its
acceleration V' and the rate d' at which the beam d turns. So it knows a = V'.d + V.d' for ground at
rest. It assumes that the ground is level (:func:`assumed_motion_along_beams`). A beam that points
down then meets the ground at a range that falls by u = (V + R d').z / d.z. A beam that does not
point down is assumed to meet a surface that faces it, along which nothing slides. Range and
velocity are corrected for both u and a.

**Unknown motion.** The instrument does not know the slope of the surface that a beam meets, nor the
motion of this surface. It has prior standard deviations of both (:class:`MotionPriors`), which the
spec of a flight states; they are never taken from the scene. With W = V + R d' and a gradient g of
level ground, du/dg = (W_z d_h - W_h d_z) / d_z^2. With a gradient of a surface that faces the beam,
du/dg = -W_perp. A target's velocity w changes v - u by (z / d.z - d).w over level ground, and not
at all on a surface that faces the beam. It changes a by -w.d'. The standard errors of range and
velocity include, in quadrature, these deviations times the derivatives of range and velocity with
respect to slip and acceleration. If the truth is outside the priors, the stated errors do not cover
it. A run, a report and an export compare errors with standard errors and warn in this case
(:mod:`sweep.analysis.scene_results.consistency`).

The slip v - u shifts a range only because the range refers to the shot's start. Ground points of
navigation are where the beam meets the ground at the range of the beats, whatever its slope
(:mod:`sweep.model.pointcloud.navigation`).

The angular acceleration is neglected in the truth and by the instrument
(:mod:`sweep.model.geometry.body_motion`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from sweep.model.pointcloud.eyepoints import Eyepoints

DEPRESSION_SINE_MIN = 0.05
"""Smallest sine of a beam's angle below the horizontal at which the instrument assumes that the
beam meets level ground. Other beams are assumed to meet a surface that faces them."""


class MotionPriors(NamedTuple):
    """Prior standard deviations of the slope and motion of surfaces, which no instrument knows."""

    terrain_slope: float = 0.2
    """Standard deviation of the slope (rise over run) of the surface that a beam meets. The slope
    is relative to level ground. For a beam that does not point down it is relative to a plane
    across the beam."""
    target_speed: float = 0.0
    """Standard deviation of each component of the velocity [m/s] of the surface that a beam meets.
    """
    target_acceleration: float = 0.0
    """Standard deviation of the acceleration, along the beam, of the surface that a beam meets
    [m/s^2]."""


class EgoMotion(NamedTuple):
    """Motion of an instrument along n beams, as the instrument knows it.

    Arrays are (n,) unless noted. The slip is the closing speed minus the speed at which the range
    to the ground falls. It is not 0 if ground slides under the beam.
    """

    closing_speed: np.ndarray
    """(n,): component of the instrument's velocity along the beam [m/s]. It is the speed at which
    ground at rest approaches."""
    closing_acceleration: np.ndarray
    """(n,): time derivative of ``closing_speed`` [m/s^2]."""
    slip_at_range_0: np.ndarray
    """(n,): slip [m/s] at range 0. The slip is the closing speed minus the speed at which the range
    to level ground falls."""
    slip_per_range: np.ndarray
    """(n,): derivative of the slip with respect to the range [(m/s)/m]. The slip is the closing
    speed minus the speed at which the range falls."""
    slip_per_slope: np.ndarray
    """(n, 3): derivative of the slip [m/s] with respect to the gradient (rise over run) of the
    surface, at range 0. The slip is the closing speed minus the speed at which the range falls."""
    slip_per_slope_per_range: np.ndarray
    """(n, 3): derivative of ``slip_per_slope`` with respect to the range [(m/s)/m].
    ``slip_per_slope`` is the value at range 0."""
    slip_per_target_speed: np.ndarray
    """(n,): standard deviation of the slip due to motion of the surface, divided by the standard
    deviation of one component of the surface's velocity. The slip is the closing speed minus the
    speed at which the range falls."""
    turn_rate: np.ndarray
    """(n,): angular speed at which the beam's direction turns [rad/s]."""
    priors: MotionPriors
    """Standard deviations of what the instrument does not know: slope and motion of surfaces."""

    def select(self, beams: np.ndarray) -> EgoMotion:
        """Return the record for the beams with the given indices."""
        return self._replace(
            **{name: getattr(self, name)[beams] for name in self._fields if name != "priors"}
        )

    def slip_at(self, distance: np.ndarray) -> np.ndarray:
        """Return the slip [m/s] of n beams at given ranges, for level ground at rest.

        ``distance`` (n, ...) holds ranges [m], and the result has its shape. The slip is the
        closing speed minus the speed at which the range falls.
        """
        slip, per_range = (
            _align_with_ranges(v, distance) for v in (self.slip_at_range_0, self.slip_per_range)
        )
        return np.asarray(slip + per_range * distance)

    def approach_speed_at(self, distance: np.ndarray) -> np.ndarray:
        """Return the speed [m/s] at which the range to level ground at rest falls, for n beams.

        ``distance`` (n, ...) holds the ranges [m] at which the speed is computed. The result has
        its shape.
        """
        return np.asarray(_align_with_ranges(self.closing_speed, distance) - self.slip_at(distance))

    def slip_standard_error(self, distance: np.ndarray) -> np.ndarray:
        """Return the standard deviation [m/s] of the slip at given ranges.

        ``distance`` (n, ...) holds ranges [m] of n beams, and the result has its shape. The slip is
        the closing speed minus the speed at which the range falls. It is uncertain because slope
        and motion of the surface are unknown.

        Notes
        -----
        The variance is slope^2 |d slip / d gradient|^2 + speed^2 (slip_per_target_speed^2 +
        slope^2), with the priors ``terrain_slope`` as slope and ``target_speed`` as speed.
        """
        slope_deviation, speed_deviation, _ = self.priors
        at_range_0, per_range = self.slip_per_slope, self.slip_per_slope_per_range
        constant, linear, quadratic = (
            _align_with_ranges(v, distance)
            for v in (
                _scalar_products(at_range_0, at_range_0),
                2 * _scalar_products(at_range_0, per_range),
                _scalar_products(per_range, per_range),
            )
        )
        slope_variance = slope_deviation**2 * (
            constant + (linear + quadratic * distance) * distance
        )
        target_variance = speed_deviation**2 * (
            _align_with_ranges(self.slip_per_target_speed, distance) ** 2 + slope_deviation**2
        )
        return np.sqrt(np.maximum(slope_variance, 0.0) + target_variance)

    @property
    def acceleration_standard_error(self) -> np.ndarray:
        """Return the standard deviation (n,) of the acceleration along each beam [m/s^2].

        The acceleration is uncertain because the motion of the surface is unknown.
        """
        return np.hypot(self.priors.target_acceleration, self.priors.target_speed * self.turn_rate)


def ego_motion_of_eyepoints(
    eyepoints: Eyepoints,
    priors: MotionPriors = MotionPriors(),  # noqa: B008  # a tuple
) -> EgoMotion:
    """Return the motion along the commanded beams of n shots, as an instrument knows it.

    The instrument assumes that the ground is level and at rest. Beams that do not point down are
    assumed to meet a surface that faces them.

    Parameters
    ----------
    eyepoints : Eyepoints
        Geometry of the shots (:class:`sweep.model.pointcloud.eyepoints.Eyepoints`). Directions,
        their rates, and the instrument's velocity and acceleration are used; what the beams hit is
        not.
    priors : MotionPriors
        Prior standard deviations of the slope and motion of surfaces.

    Returns
    -------
    EgoMotion
        Arrays (n,), by the equations of :func:`assumed_motion_along_beams`.
    """
    return assumed_motion_along_beams(
        eyepoints.direction, eyepoints.velocity, eyepoints.direction_rate,
        eyepoints.platform_acceleration, priors,
    )  # fmt: skip


def assumed_motion_along_beams(
    direction: np.ndarray,
    velocity: np.ndarray,
    direction_rate: np.ndarray,
    acceleration: np.ndarray,
    priors: MotionPriors,
) -> EgoMotion:
    """Return the motion along n beams that an instrument assumes over level ground at rest.

    Parameters
    ----------
    direction
        (n, 3): unit vectors d of the beams.
    velocity, acceleration
        (n, 3): velocity V [m/s] and acceleration V' [m/s^2] of the instrument.
    direction_rate
        (n, 3): rate of change d' of the directions [1/s].
    priors
        Prior standard deviations of unknown motion.

    Notes
    -----
    Let z be the vertical, R the range, and u the speed at which the range falls. Then u = V.z / d.z
    + R d'.z / d.z, and the slip is V.d - u.
    """
    closing_rate = _scalar_products(acceleration, direction) + _scalar_products(
        velocity, direction_rate
    )
    closing_speed = _scalar_products(velocity, direction)
    meets_ground = direction[:, 2] < -DEPRESSION_SINE_MIN
    direction_z = np.where(meets_ground, direction[:, 2], -1.0)

    def slip_gradient(vector: np.ndarray) -> np.ndarray:
        """Return the derivative (n, 3) of the slip [m/s] with respect to the surface's gradient.

        ``vector`` (n, 3) [m/s] is the velocity of the beam's foot, or a part of it; the derivative
        is linear in it.
        """
        over_ground = vector * direction_z[:, None] - vector[:, 2:] * direction
        over_ground /= direction_z[:, None] ** 2
        for_facing_surface = vector - _scalar_products(vector, direction)[:, None] * direction
        return np.where(meets_ground[:, None], over_ground, for_facing_surface)

    return EgoMotion(
        closing_speed=closing_speed,
        closing_acceleration=closing_rate,
        slip_at_range_0=np.where(meets_ground, closing_speed - velocity[:, 2] / direction_z, 0.0),
        slip_per_range=np.where(meets_ground, -direction_rate[:, 2] / direction_z, 0.0),
        slip_per_slope=slip_gradient(velocity),
        slip_per_slope_per_range=slip_gradient(direction_rate),
        slip_per_target_speed=np.where(
            meets_ground, np.sqrt(np.maximum(direction_z**-2 - 1.0, 0.0)), 0.0
        ),
        turn_rate=np.sqrt(_scalar_products(direction_rate, direction_rate)),
        priors=priors,
    )


def _align_with_ranges(values: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Reshape values (n,) to (n, 1, ...), with as many axes as the ranges (n, ...)."""
    return values.reshape(-1, *[1] * (np.ndim(distance) - 1))


def _scalar_products(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the scalar products (n,) of the rows of two arrays (n, 3)."""
    return np.asarray(
        first[:, 0] * second[:, 0] + first[:, 1] * second[:, 1] + first[:, 2] * second[:, 2]
    )
