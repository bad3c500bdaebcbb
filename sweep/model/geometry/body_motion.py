"""Motion of bodies: position, velocity, acceleration and attitude over time.

A body is the platform of the instrument, or a moving target. Velocity and acceleration are exact
derivatives of the position. Every attitude law returns the quaternion (body to world) and its exact
derivative, the angular velocity. In the body's frame x is forward, y left and z up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from sweep.model.geometry import quaternion as quat
from sweep.model.geometry.quaternion import rotate

_HORIZONTAL_SPEED_FRACTION_MIN = 1e-9
"""Ratio of horizontal to total speed below which motion counts as vertical, without a heading.
"""
_HORIZONTAL_SPEED_MIN = 1e-100
"""Horizontal speed [m/s] below which motion has no heading."""

FloatSequence = Sequence[float] | np.ndarray
"""Sequence or array of real numbers (type of an argument)."""

AttitudeAndRate = tuple[np.ndarray, np.ndarray]
"""Pair of arrays that ``attitude_and_rate`` of an attitude law returns for n times: quaternions (n,
4), body to world, and angular velocities (n, 3) [rad/s] in the world's frame.
"""


@dataclass(frozen=True)
class NadirAttitude:
    """Attitude of a level body, so that a beam along the body's -z points straight down."""

    heading: float | None = 0.0
    """Angle of the forward axis from the world's x, counter-clockwise seen from above [rad]. With
    None the forward axis follows the horizontal velocity, which must not be 0."""

    def attitude_and_rate(
        self, times: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
    ) -> AttitudeAndRate:
        """Return the attitudes and angular velocities of a level body.

        Parameters
        ----------
        times : ndarray (n,)
            Times [s]; only their number n is used.
        velocity, acceleration : ndarray (n, 3)
            Velocities [m/s] and accelerations [m/s^2] of the body in the world's frame. They are
            used only if the heading follows the velocity.

        Returns
        -------
        attitude : ndarray (n, 4)
            Unit quaternions (w, x, y, z) from body to world.
        angular_velocity : ndarray (n, 3)
            Angular velocities in the world's frame [rad/s].

        Raises
        ------
        ValueError
            If the heading follows the velocity, and a velocity is vertical or 0.

        Notes
        -----
        The attitude is a rotation about z by the heading h. The angular velocity is (0, 0, dh/dt).
        With a constant heading, dh/dt is 0. Else h = atan2(v_y, v_x) and dh/dt = (v_x a_y - v_y
        a_x) / (v_x^2 + v_y^2), with the velocity v and the acceleration a.
        """
        if self.heading is not None:
            return np.tile(quat.from_axis_angle(2, self.heading), (len(times), 1)), np.zeros(
                (len(times), 3)
            )
        heading, yaw_rate = _heading_and_rate(velocity, acceleration)
        return quat.from_axis_angle(2, heading), yaw_rate[:, None] * [0.0, 0.0, 1.0]


@dataclass(frozen=True)
class AlongTrackAttitude:
    """Attitude of a body whose forward axis points along the velocity.

    The body is rolled about this axis by a constant angle.
    """

    roll: float = 0.0
    """Roll angle, positive with the left side up [rad]; at 0 the left axis is horizontal."""

    def attitude_and_rate(
        self, times: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
    ) -> AttitudeAndRate:
        """Return the attitudes and angular velocities of a body that points along its velocity.

        Parameters
        ----------
        times : ndarray (n,)
            Times [s]; only their number n is used.
        velocity, acceleration : ndarray (n, 3)
            Velocities [m/s] and accelerations [m/s^2] of the body in the world's frame.

        Returns
        -------
        attitude : ndarray (n, 4)
            Unit quaternions (w, x, y, z) from body to world.
        angular_velocity : ndarray (n, 3)
            Angular velocities in the world's frame [rad/s].

        Raises
        ------
        ValueError
            If a velocity is vertical or 0.

        Notes
        -----
        With the velocity v, the acceleration a and the horizontal speed s = hypot(v_x, v_y),
        heading and pitch are h = atan2(v_y, v_x) and p = atan2(v_z, s). Let l = (-sin h, cos h, 0)
        be the horizontal axis to the left. The angular velocity is (dh/dt) z - (dp/dt) l, because
        the roll is constant:

            dh/dt = (v_x a_y - v_y a_x) / s^2
            dp/dt = (a_z s - v_z (v_x a_x + v_y a_y) / s) / |v|^2
        """
        heading, yaw_rate = _heading_and_rate(velocity, acceleration)
        horizontal_speed = np.hypot(velocity[:, 0], velocity[:, 1])
        pitch = np.arctan2(velocity[:, 2], horizontal_speed)
        horizontal_acceleration = (velocity[:, :2] * acceleration[:, :2]).sum(
            axis=1
        ) / horizontal_speed
        pitch_rate = (
            acceleration[:, 2] * horizontal_speed - velocity[:, 2] * horizontal_acceleration
        )
        pitch_rate /= (velocity**2).sum(axis=1)
        left_axis = np.column_stack([-np.sin(heading), np.cos(heading), np.zeros(len(times))])
        angular_velocity = yaw_rate[:, None] * [0.0, 0.0, 1.0] - pitch_rate[:, None] * left_axis
        return quat.from_heading(heading=heading, pitch=pitch, roll=self.roll), angular_velocity


def _heading_and_rate(
    velocity: np.ndarray, acceleration: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return heading [rad] and turn rate [rad/s] of moving bodies, (n,) each.

    The heading is the angle of the horizontal velocity from x, counter-clockwise from above.
    ``velocity`` [m/s] and ``acceleration`` [m/s^2] are (n, 3).

    Raises
    ------
    ValueError
        If a velocity is vertical or 0.
    """
    vx, vy = velocity[:, 0], velocity[:, 1]
    horizontal_speed = np.hypot(vx, vy)
    speed = np.linalg.norm(velocity, axis=1)
    if not (
        horizontal_speed > np.maximum(_HORIZONTAL_SPEED_FRACTION_MIN * speed, _HORIZONTAL_SPEED_MIN)
    ).all():
        raise ValueError("a vertical movement (or none) has no heading to follow: state one")
    return np.arctan2(vy, vx), (
        vx * acceleration[:, 1] - vy * acceleration[:, 0]
    ) / horizontal_speed**2


@dataclass(frozen=True, eq=False)
class FixedAttitude:
    """Attitude that does not depend on time."""

    quaternion: FloatSequence
    """(4,): quaternion (w, x, y, z), body to world; it is normalised to length 1."""

    def attitude_and_rate(
        self, times: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
    ) -> AttitudeAndRate:
        """Return the constant attitude and the angular velocity 0, for each time.

        Parameters
        ----------
        times : ndarray (n,)
            Times [s]; only their number n is used.
        velocity, acceleration : ndarray (n, 3)
            Not used: the attitude does not depend on the body's motion.

        Returns
        -------
        attitude : ndarray (n, 4)
            Unit quaternions (w, x, y, z) from body to world.
        angular_velocity : ndarray (n, 3)
            Angular velocities in the world's frame [rad/s].

        Notes
        -----
        The quaternion is normalised to length 1.
        """
        q = quat.normalise(np.asarray(self.quaternion, float))
        return np.tile(q, (len(times), 1)), np.zeros((len(times), 3))


@dataclass(frozen=True, eq=False)
class SpinningAttitude:
    """Attitude of a body that rotates at a constant rate about an axis fixed in the world."""

    angular_velocity: FloatSequence
    """(3,): angular velocity in the world frame [rad/s]."""
    initial_quaternion: FloatSequence = (1.0, 0.0, 0.0, 0.0)
    """(4,): quaternion (w, x, y, z), body to world, at the time ``initial_time``."""
    initial_time: float = 0.0
    """Time at which the attitude is ``initial_quaternion`` [s]."""

    def attitude_and_rate(
        self, times: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
    ) -> AttitudeAndRate:
        """Return the attitudes of a body that rotates at a constant rate, and its angular velocity.

        Parameters
        ----------
        times : ndarray (n,)
            Times [s].
        velocity, acceleration : ndarray (n, 3)
            Not used: the attitude does not depend on the body's motion.

        Returns
        -------
        attitude : ndarray (n, 4)
            Unit quaternions (w, x, y, z) from body to world.
        angular_velocity : ndarray (n, 3)
            Angular velocities in the world's frame [rad/s].

        Notes
        -----
        The attitude at the time t is exp(omega (t - t_0)) q_0, with the angular velocity omega and
        the attitude q_0 at the time t_0. Here exp(r) is the quaternion of the rotation vector r.
        """
        angular_velocity = np.asarray(self.angular_velocity, float)
        rotation = quat.from_rotation_vector(
            (times - self.initial_time)[:, None] * angular_velocity
        )
        initial_attitude = quat.normalise(np.asarray(self.initial_quaternion, float))
        return quat.multiply(rotation, initial_attitude), np.tile(angular_velocity, (len(times), 1))


@dataclass(frozen=True, eq=False)
class AttitudeTrack:
    """Attitudes at given times, and between these times rotations at a constant rate (slerp).

    Of the two rotations from one attitude to the next, the shorter is taken. Before the first and
    after the last time the attitude is constant.
    """

    times: FloatSequence
    """(n,): ascending times at which attitudes are given [s]."""
    quaternions: Sequence[Sequence[float]] | np.ndarray
    """(n, 4): attitudes at ``times``, as quaternions (w, x, y, z) from body to world."""
    _rotation_steps: np.ndarray = field(init=False, repr=False)
    """(n - 1, 3): rotation vectors from each attitude of ``quaternions`` to the next [rad]. A
    rotation vector points along the axis of the rotation; its length is the angle."""

    def __post_init__(self) -> None:
        times, quaternions = require_rising_times(self.times), np.asarray(self.quaternions, float)
        if quaternions.shape != (len(times), 4):
            raise ValueError(
                f"a quaternion track needs four numbers a time, not {quaternions.shape}"
            )
        quaternions = quat.normalise(quaternions)
        rotation_steps = quat.to_rotation_vector(
            quat.multiply(quat.conjugate(quaternions[:-1]), quaternions[1:])
        )
        for name, value in (
            ("times", times),
            ("quaternions", quaternions),
            ("_rotation_steps", rotation_steps),
        ):
            object.__setattr__(self, name, value)

    def attitude_and_rate(
        self, query_times: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
    ) -> AttitudeAndRate:
        """Return attitudes interpolated between those of the track, and angular velocities.

        Parameters
        ----------
        query_times : ndarray (n,)
            Times for which attitudes are returned [s].
        velocity, acceleration : ndarray (n, 3)
            Not used: the attitude does not depend on the body's motion.

        Returns
        -------
        attitude : ndarray (n, 4)
            Unit quaternions (w, x, y, z) from body to world.
        angular_velocity : ndarray (n, 3)
            Angular velocities in the world's frame [rad/s].

        Notes
        -----
        Between the times t_k and t_(k+1), the attitude is q_k exp(s_k (t - t_k) / (t_(k+1) - t_k)).
        The rotation vector s_k turns the attitude q_k to the next one, and exp(r) is the quaternion
        of the rotation vector r. The angular velocity is s_k / (t_(k+1) - t_k), rotated to the
        world's frame. Before the first and after the last time of the track, the angular velocity
        is 0.
        """
        times, quaternions = np.asarray(self.times), np.asarray(self.quaternions)
        interval = np.clip(np.searchsorted(times, query_times, side="right") - 1, 0, len(times) - 2)
        interval_duration = np.diff(times)[interval]
        fraction = np.clip((query_times - times[interval]) / interval_duration, 0.0, 1.0)
        rotation_step = self._rotation_steps[interval]
        q = quat.multiply(
            quaternions[interval], quat.from_rotation_vector(rotation_step * fraction[:, None])
        )
        is_turning = (query_times >= times[0]) & (query_times <= times[-1])
        angular_velocity = (
            quat.rotate(q, rotation_step / interval_duration[:, None]) * is_turning[:, None]
        )
        return q, angular_velocity


@dataclass(frozen=True, eq=False)
class MountedAttitude:
    """Attitude of an instrument that is fixed to a vehicle at a constant rotation."""

    vehicle_attitude: AttitudeLaw
    """Attitude law (attitude over time) of the vehicle."""
    mounting: FloatSequence
    """(4,): quaternion (w, x, y, z) from the instrument's frame to the vehicle's."""

    def attitude_and_rate(
        self, times: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
    ) -> AttitudeAndRate:
        """Return the attitudes of the mounted instrument, and the vehicle's angular velocities.

        Parameters
        ----------
        times : ndarray (n,)
            Times [s].
        velocity, acceleration : ndarray (n, 3)
            Velocities [m/s] and accelerations [m/s^2] of the vehicle in the world's frame, which
            its attitude law may use.

        Returns
        -------
        attitude : ndarray (n, 4)
            Unit quaternions (w, x, y, z) from the instrument's frame to the world's.
        angular_velocity : ndarray (n, 3)
            Angular velocities in the world's frame [rad/s].

        Notes
        -----
        The attitude is q m, with the attitude q of the vehicle and the rotation m from the
        instrument's frame to the vehicle's.
        """
        q, angular_velocity = self.vehicle_attitude.attitude_and_rate(times, velocity, acceleration)
        return quat.multiply(q, quat.normalise(np.asarray(self.mounting, float))), angular_velocity


_TIME_TOLERANCE_FRACTION = 1e-9
"""Largest excess of a time over the start or stop of a trajectory that counts as rounding. The unit
is the larger of the trajectory's duration and 1 s."""


AttitudeLaw = (
    NadirAttitude
    | AlongTrackAttitude
    | FixedAttitude
    | SpinningAttitude
    | AttitudeTrack
    | MountedAttitude
)
"""Attitude of a body over time (type of an argument): an instance of any attitude class of this
module, with a method ``attitude_and_rate``."""


class Motion(NamedTuple):
    """Position, velocity and acceleration of a point at n times, in the world's frame.

    Each array is (n, 3).
    """

    position: np.ndarray
    """(n, 3): position of the point in the world's frame [m]."""
    velocity: np.ndarray
    """(n, 3): velocity of the point in the world's frame [m/s]."""
    acceleration: np.ndarray
    """(n, 3): acceleration of the point in the world's frame [m/s^2]."""


class BodyState(NamedTuple):
    """Position, attitude and motion at n times of an instrument on a body, in the world's frame."""

    position: np.ndarray
    """(n, 3): position of the instrument [m]."""
    velocity: np.ndarray
    """(n, 3): velocity of the instrument [m/s]."""
    attitude: np.ndarray
    """(n, 4): unit quaternion (w, x, y, z) from body to world."""
    angular_velocity: np.ndarray
    """(n, 3): angular velocity of the body [rad/s]."""
    acceleration: np.ndarray
    """(n, 3): acceleration of the instrument [m/s^2]. The angular velocity is taken as constant."""


def _clip_times_to_interval(times: np.ndarray, start: float, stop: float) -> np.ndarray:
    """Return times (n,) [s], clipped to ``start`` .. ``stop`` where rounding put them outside.

    Raises
    ------
    ValueError
        If a time lies outside ``start`` .. ``stop`` by more than rounding.
    """
    times = np.atleast_1d(np.asarray(times, float))
    tolerance = _TIME_TOLERANCE_FRACTION * max(stop - start, 1.0)
    if not ((times >= start - tolerance) & (times <= stop + tolerance)).all():
        raise ValueError(f"times must be numbers on the path, {start:g} to {stop:g} s")
    return np.clip(times, start, stop)


@dataclass(frozen=True, eq=False)
class ConstantAcceleration:
    """Trajectory of a point under constant acceleration, which may be 0."""

    initial_position: FloatSequence
    """(3,): position of the point at time 0 [m], in the world's frame."""
    initial_velocity: FloatSequence
    """(3,): velocity of the point at time 0 [m/s], in the world's frame."""
    acceleration: FloatSequence
    """(3,): constant acceleration of the point [m/s^2], in the world's frame."""
    duration: float
    """Duration of the trajectory [s], above 0."""
    start_time: float = field(default=0.0, init=False)
    """Time at which the trajectory begins [s]."""

    def __post_init__(self) -> None:
        if not (self.duration > 0 and math.isfinite(self.duration)):
            raise ValueError(f"a path must last longer than 0 s, not {self.duration} s")

    @property
    def stop_time(self) -> float:
        """Time at which the trajectory ends [s]."""
        return self.duration

    def motion(self, times: np.ndarray) -> Motion:
        """Return the :class:`Motion` of the point at times (n,) [s] from start to stop."""
        times = _clip_times_to_interval(times, 0.0, self.duration)[:, None]
        x0, v0, a = np.array(
            [self.initial_position, self.initial_velocity, self.acceleration], float
        )
        return Motion(x0 + (v0 + 0.5 * a * times) * times, v0 + a * times, a + 0 * times)


def straight_trajectory(
    *,
    start_point: FloatSequence,
    end_point: FloatSequence,
    initial_speed: float,
    final_speed: float | None = None,
) -> ConstantAcceleration:
    """Return a straight trajectory between two points, under constant acceleration.

    Parameters
    ----------
    start_point, end_point : array_like (3,)
        Points [m].
    initial_speed, final_speed : float
        Speeds [m/s], >= 0 and not both 0; by default the final speed is the initial one.

    Returns
    -------
    ConstantAcceleration
        Trajectory of the length L between the points, from speed v_0 to v_1. Its duration is 2 L /
        (v_0 + v_1) [s], and its acceleration (v_1^2 - v_0^2) / (2 L) [m/s^2] towards the end point.

    Raises
    ------
    ValueError
        For equal points, or speeds that never cover the distance.
    """
    end_speed = initial_speed if final_speed is None else final_speed
    first_point = np.asarray(start_point, float)
    displacement = np.asarray(end_point, float) - first_point
    length = float(np.linalg.norm(displacement))
    if not (length > 0 and min(initial_speed, end_speed) >= 0 and initial_speed + end_speed > 0):
        raise ValueError("a straight path needs two points apart and speeds >= 0, not both 0")
    direction = displacement / length
    acceleration = (end_speed - initial_speed) * (end_speed + initial_speed) / (2 * length)
    duration = 2 * length / (initial_speed + end_speed)
    return ConstantAcceleration(
        first_point, direction * initial_speed, direction * acceleration, duration
    )


@dataclass(frozen=True, eq=False)
class Waypoints:
    """Trajectory that passes through given positions at given times."""

    times: FloatSequence
    """(n,): ascending times at which positions are given [s], at least two."""
    positions: Sequence[Sequence[float]] | np.ndarray
    """(n, 3): given positions of the moving point at ``times`` [m]."""
    is_smooth: bool = True
    """True to connect the positions by a cubic spline, whose velocity and acceleration are
    continuous (a line or a parabola through two or three points). False to connect them by straight
    lines at constant velocities."""
    _interpolant: Any = field(init=False, repr=False)
    """Function of the time [s] and of the order of a time derivative. It returns this derivative of
    the position relative to the first position [m]."""
    _origin: np.ndarray = field(init=False, repr=False)
    """(3,): first of the given positions [m]."""

    def __post_init__(self) -> None:
        from scipy.interpolate import CubicSpline, PPoly  # slow to import

        times, positions = require_rising_times(self.times), np.asarray(self.positions, float)
        if positions.shape != (len(times), 3) or not np.isfinite(positions).all():
            raise ValueError(
                f"waypoints need three finite coordinates a time, not {positions.shape}"
            )
        # Positions are relative to the first, because large coordinates would cost the spline its
        # last digits.
        origin, positions = positions[0], positions - positions[0]
        if self.is_smooth:
            interpolant = CubicSpline(times, positions)
        else:
            interpolant = PPoly(
                np.stack([np.diff(positions, axis=0) / np.diff(times)[:, None], positions[:-1]]),
                times,
            )
        object.__setattr__(self, "_interpolant", interpolant)
        object.__setattr__(self, "_origin", origin)

    @property
    def start_time(self) -> float:
        """Time of the first position [s]."""
        return float(self._interpolant.x[0])

    @property
    def stop_time(self) -> float:
        """Time of the last position [s]."""
        return float(self._interpolant.x[-1])

    def motion(self, times: np.ndarray) -> Motion:
        """Return the :class:`Motion` of the point at times (n,) [s] from start to stop."""
        times = _clip_times_to_interval(times, self.start_time, self.stop_time)
        return Motion(
            self._interpolant(times) + self._origin,
            self._interpolant(times, 1),
            self._interpolant(times, 2),
        )


def require_rising_times(time: FloatSequence) -> np.ndarray:
    """Convert times (n,) [s] to an array, and require that they ascend.

    Raises
    ------
    ValueError
        If there are fewer than two times, or times that do not ascend.
    """
    times = np.asarray(time, float)
    if (
        times.ndim != 1
        or len(times) < 2
        or not np.isfinite(times).all()
        or not (np.diff(times) > 0).all()
    ):
        raise ValueError("times must be two or more finite numbers that rise")
    return times


Trajectory = ConstantAcceleration | Waypoints
"""Motion of a point over time, from ``start_time`` to ``stop_time`` [s] (type of an argument): an
instance of any trajectory class of this module."""


@dataclass(frozen=True, eq=False)
class MovingBody:
    """Body that follows a trajectory and an attitude law, and may carry an instrument."""

    trajectory: Trajectory
    """Trajectory of the body's reference point, the origin of its frame."""
    attitude_law: AttitudeLaw
    """Law that gives the attitude of the body over time."""
    lever_arm: FloatSequence = (0.0, 0.0, 0.0)
    """(3,): position of the instrument in the body frame [m]."""

    @property
    def start_time(self) -> float:
        """Time at which the trajectory begins [s]."""
        return self.trajectory.start_time

    @property
    def stop_time(self) -> float:
        """Time at which the trajectory ends [s]."""
        return self.trajectory.stop_time

    def state(self, times: np.ndarray) -> BodyState:
        """Return the :class:`BodyState` of the instrument at times (n,) [s].

        Times are from ``start_time`` to ``stop_time``.

        Raises
        ------
        ValueError
            For a time outside the trajectory, or a heading that the velocity leaves undefined.
        """
        motion = self.trajectory.motion(times)
        clipped_times = _clip_times_to_interval(times, self.start_time, self.stop_time)
        attitude, angular_velocity = self.attitude_law.attitude_and_rate(
            clipped_times, motion.velocity, motion.acceleration
        )
        lever_arm = rotate(attitude, np.asarray(self.lever_arm, float))
        lever_velocity = np.cross(angular_velocity, lever_arm)
        return BodyState(
            motion.position + lever_arm,
            motion.velocity + lever_velocity,
            attitude,
            angular_velocity,
            motion.acceleration + np.cross(angular_velocity, lever_velocity),
        )
