"""Platform of the instrument: position, velocity and attitude against time.

Velocity and acceleration are the exact derivatives of the position; every law of attitude gives
the quaternion (body to world) and the angular velocity that is its derivative. A moving target is
a `Flight` too. Body frame: x forward, y left, z up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from sweep.model.geometry import quaternion as quat
from sweep.model.geometry.quaternion import rotate

_VERTICAL, _STILL = 1e-9, 1e-100
"""Horizontal share of the speed, and horizontal speed [m/s], under which there is no heading."""


Vector = Sequence[float] | np.ndarray

Turn = tuple[np.ndarray, np.ndarray]
"""Quaternion (n, 4), body to world, and angular velocity (n, 3) [rad/s] in the world frame.

What a law of attitude makes of times (n,) [s], velocities and accelerations (n, 3) [m/s, m/s^2].
"""


@dataclass(frozen=True)
class Nadir:
    """Level, so that a beam along -z points straight down."""

    heading: float | None = 0.0
    """Angle of the forward axis from the world's x, counter-clockwise from above [rad]; None
    follows the track over the ground, which a vertical movement does not have."""

    def turn(self, t: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Turn:
        """Attitude and angular velocity."""
        if self.heading is not None:
            return np.tile(quat.about(2, self.heading), (len(t), 1)), np.zeros((len(t), 3))
        heading, yaw_rate = _track(velocity, acceleration)
        return quat.about(2, heading), yaw_rate[:, None] * [0.0, 0.0, 1.0]


@dataclass(frozen=True)
class AlongTrack:
    """Forward axis along the velocity, wings level but for a bank."""

    roll: float = 0.0
    """Left side up [rad], constant."""

    def turn(self, t: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Turn:
        """Attitude and angular velocity."""
        heading, yaw_rate = _track(velocity, acceleration)
        level = np.hypot(velocity[:, 0], velocity[:, 1])
        pitch = np.arctan2(velocity[:, 2], level)
        level_rate = (velocity[:, :2] * acceleration[:, :2]).sum(axis=1) / level
        pitch_rate = acceleration[:, 2] * level - velocity[:, 2] * level_rate
        pitch_rate /= (velocity**2).sum(axis=1)
        left = np.column_stack([-np.sin(heading), np.cos(heading), np.zeros(len(t))])
        rate = yaw_rate[:, None] * [0.0, 0.0, 1.0] - pitch_rate[:, None] * left
        return quat.from_heading(heading=heading, pitch=pitch, roll=self.roll), rate


def _track(velocity: np.ndarray, acceleration: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heading [rad] and its rate [rad/s], (n,) each."""
    vx, vy = velocity[:, 0], velocity[:, 1]
    level = np.hypot(vx, vy)
    speed = np.linalg.norm(velocity, axis=1)
    if not (level > np.maximum(_VERTICAL * speed, _STILL)).all():
        raise ValueError("a vertical movement (or none) has no heading to follow: state one")
    return np.arctan2(vy, vx), (vx * acceleration[:, 1] - vy * acceleration[:, 0]) / level**2


@dataclass(frozen=True, eq=False)
class Fixed:
    """One attitude throughout: (w, x, y, z), body to world, scaled to length 1."""

    quaternion: Vector

    def turn(self, t: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Turn:
        """Attitude and angular velocity."""
        q = quat.normalise(np.asarray(self.quaternion, float))
        return np.tile(q, (len(t), 1)), np.zeros((len(t), 3))


@dataclass(frozen=True, eq=False)
class Spin:
    """Turning at a constant rate about an axis that is fixed in the body and in the world."""

    rate: Vector
    """(3,): angular velocity in the world frame [rad/s]."""
    quaternion: Vector = (1.0, 0.0, 0.0, 0.0)
    """Attitude at `time` [s]."""
    time: float = 0.0

    def turn(self, t: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Turn:
        """Attitude and angular velocity."""
        rate = np.asarray(self.rate, float)
        turned = quat.from_rotation_vector((t - self.time)[:, None] * rate)
        first = quat.normalise(np.asarray(self.quaternion, float))
        return quat.multiply(turned, first), np.tile(rate, (len(t), 1))


@dataclass(frozen=True, eq=False)
class Track:
    """Attitudes (n, 4) at rising times (n,) [s], joined by the shorter turns at constant rates.

    Slerp; before the first and after the last the attitude stays. q and -q are one.
    """

    time: Vector
    quaternion: Sequence[Sequence[float]] | np.ndarray
    _steps: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        t, q = rising_times(self.time), np.asarray(self.quaternion, float)
        if q.shape != (len(t), 4):
            raise ValueError(f"a quaternion track needs four numbers a time, not {q.shape}")
        q = quat.normalise(q)
        steps = quat.to_rotation_vector(quat.multiply(quat.conjugate(q[:-1]), q[1:]))
        for name, value in (("time", t), ("quaternion", q), ("_steps", steps)):
            object.__setattr__(self, name, value)

    def turn(self, t: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Turn:
        """Attitude and angular velocity."""
        times, nodes = np.asarray(self.time), np.asarray(self.quaternion)
        leg = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
        lasts = np.diff(times)[leg]
        fraction = np.clip((t - times[leg]) / lasts, 0.0, 1.0)
        step = self._steps[leg]
        q = quat.multiply(nodes[leg], quat.from_rotation_vector(step * fraction[:, None]))
        turning = (t >= times[0]) & (t <= times[-1])
        rate = quat.rotate(q, step / lasts[:, None]) * turning[:, None]
        return q, rate


@dataclass(frozen=True, eq=False)
class Mounted:
    """An instrument turned, from its frame to the body's, with respect to its carrier."""

    carrier: Attitude
    quaternion: Vector

    def turn(self, t: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Turn:
        """Attitude and angular velocity."""
        q, rate = self.carrier.turn(t, velocity, acceleration)
        return quat.multiply(q, quat.normalise(np.asarray(self.quaternion, float))), rate


_SLACK = 1e-9
"""Share of the duration by which a time may lie outside the path, for rounding's sake."""


Attitude = Nadir | AlongTrack | Fixed | Spin | Track | Mounted


class Motion(NamedTuple):
    """Movement of a point: position [m], velocity [m/s], acceleration [m/s^2], each (n, 3)."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


class State(NamedTuple):
    """Pose of a body in the world frame, (n, 3) or (n, 4) each.

    Position [m] and velocity [m/s] of the instrument, unit quaternion (w, x, y, z) from body to
    world, angular velocity [rad/s]; acceleration of the instrument [m/s^2], as if that angular
    velocity stayed as it is.
    """

    position: np.ndarray
    velocity: np.ndarray
    attitude: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray


def _within(t: np.ndarray, start: float, stop: float) -> np.ndarray:
    """Return times, those just off the path's ends clipped to it; a ValueError for others."""
    t = np.atleast_1d(np.asarray(t, float))
    slack = _SLACK * max(stop - start, 1.0)
    if not ((t >= start - slack) & (t <= stop + slack)).all():
        raise ValueError(f"times must be numbers on the path, {start:g} to {stop:g} s")
    return np.clip(t, start, stop)


@dataclass(frozen=True, eq=False)
class ConstantAcceleration:
    """Path of a point under a constant acceleration; a straight line where that is 0.

    Position, velocity and acceleration (3,) at time 0 [m, m/s, m/s^2]; duration [s], > 0.
    """

    position: Vector
    velocity: Vector
    acceleration: Vector
    duration: float
    start: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        if not (self.duration > 0 and math.isfinite(self.duration)):
            raise ValueError(f"a path must last longer than 0 s, not {self.duration} s")

    @property
    def stop(self) -> float:
        """Last time [s]."""
        return self.duration

    def motion(self, t: np.ndarray) -> Motion:
        """Movement at times (n,) [s] from start to stop."""
        t = _within(t, 0.0, self.duration)[:, None]
        x0, v0, a = np.array([self.position, self.velocity, self.acceleration], float)
        return Motion(x0 + (v0 + 0.5 * a * t) * t, v0 + a * t, a + 0 * t)


def straight(
    *,
    begin: Vector,
    end: Vector,
    initial_speed: float,
    final_speed: float | None = None,
) -> ConstantAcceleration:
    """Straight line between two points (3,) [m], the speed changing at a constant rate.

    The speeds [m/s] are >= 0 and not both 0; the final one is the initial one by default. A
    ValueError for equal points, or speeds that never cover the distance.
    """
    final = initial_speed if final_speed is None else final_speed
    first = np.asarray(begin, float)
    way = np.asarray(end, float) - first
    length = float(np.linalg.norm(way))
    if not (length > 0 and min(initial_speed, final) >= 0 and initial_speed + final > 0):
        raise ValueError("a straight path needs two points apart and speeds >= 0, not both 0")
    along = way / length
    acceleration = (final - initial_speed) * (final + initial_speed) / (2 * length)
    duration = 2 * length / (initial_speed + final)
    return ConstantAcceleration(first, along * initial_speed, along * acceleration, duration)


@dataclass(frozen=True, eq=False)
class Waypoints:
    """Path through positions (n, 3) [m] at rising times (n,) [s], at least two."""

    time: Vector
    position: Sequence[Sequence[float]] | np.ndarray
    smooth: bool = True
    """A cubic spline, whose velocity and acceleration are steady (through two or three points,
    the line or parabola); False joins the points by straight lines at constant velocities."""
    _curve: Any = field(init=False, repr=False)
    _origin: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        from scipy.interpolate import CubicSpline, PPoly  # which takes longer than all else here

        t, x = rising_times(self.time), np.asarray(self.position, float)
        if x.shape != (len(t), 3) or not np.isfinite(x).all():
            raise ValueError(f"waypoints need three finite coordinates a time, not {x.shape}")
        # Far-off positions would cost the spline its last digits: it runs from the first one.
        origin, x = x[0], x - x[0]
        if self.smooth:
            curve = CubicSpline(t, x)
        else:
            curve = PPoly(np.stack([np.diff(x, axis=0) / np.diff(t)[:, None], x[:-1]]), t)
        object.__setattr__(self, "_curve", curve)
        object.__setattr__(self, "_origin", origin)

    @property
    def start(self) -> float:
        """First time [s]."""
        return float(self._curve.x[0])

    @property
    def stop(self) -> float:
        """Last time [s]."""
        return float(self._curve.x[-1])

    def motion(self, t: np.ndarray) -> Motion:
        """Movement at times (n,) [s] from start to stop."""
        t = _within(t, self.start, self.stop)
        return Motion(self._curve(t) + self._origin, self._curve(t, 1), self._curve(t, 2))


def rising_times(time: Vector) -> np.ndarray:
    """Return times as an array; a ValueError for fewer than two, or where they do not rise."""
    t = np.asarray(time, float)
    if t.ndim != 1 or len(t) < 2 or not np.isfinite(t).all() or not (np.diff(t) > 0).all():
        raise ValueError("times must be two or more finite numbers that rise")
    return t


Path = ConstantAcceleration | Waypoints
"""Movement of a point from `start` to `stop` [s]."""


@dataclass(frozen=True, eq=False)
class Flight:
    """A body whose reference point is on a path, with an attitude, carrying the instrument."""

    path: Path
    attitude: Attitude
    lever_arm: Vector = (0.0, 0.0, 0.0)
    """(3,): position of the instrument in the body frame [m]."""

    @property
    def start(self) -> float:
        """First time [s]."""
        return self.path.start

    @property
    def stop(self) -> float:
        """Last time [s]."""
        return self.path.stop

    def state(self, t: np.ndarray) -> State:
        """Pose at times (n,) [s] from start to stop.

        A ValueError for a time outside the path, or an attitude that the movement leaves undefined.
        """
        motion = self.path.motion(t)
        times = _within(t, self.start, self.stop)
        attitude, rate = self.attitude.turn(times, motion.velocity, motion.acceleration)
        arm = rotate(attitude, np.asarray(self.lever_arm, float))
        swung = np.cross(rate, arm)
        return State(
            motion.position + arm, motion.velocity + swung, attitude, rate,
            motion.acceleration + np.cross(rate, swung),
        )  # fmt: skip
