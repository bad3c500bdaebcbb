"""Flight paths and what flies along them: position, velocity and acceleration against time.

Velocity and acceleration are the exact derivatives of the position, and a `Flight` adds an
attitude whose angular rate is the derivative of its quaternion. A moving target is a `Flight` too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from scipy.interpolate import CubicSpline, PPoly

from sweep.model.geometry.attitude import Attitude
from sweep.model.geometry.quaternion import rotate

_SLACK = 1e-9
"""Share of the duration by which a time may lie outside the path, for rounding's sake."""


class Motion(NamedTuple):
    """Movement of a point: position [m], velocity [m/s], acceleration [m/s^2], each (n, 3)."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


class State(NamedTuple):
    """Pose of a body in the world frame.

    Parameters
    ----------
    position : (n, 3) ndarray
        Of the instrument [m].
    velocity : (n, 3) ndarray
        Of the instrument [m/s].
    attitude : (n, 4) ndarray
        Unit quaternion (w, x, y, z), body to world.
    rate : (n, 3) ndarray
        Angular velocity [rad/s] in the world frame.
    """

    position: np.ndarray
    velocity: np.ndarray
    attitude: np.ndarray
    rate: np.ndarray


class Path(Protocol):
    """Movement of a point from `start` to `stop` [s]."""

    @property
    def start(self) -> float:
        """First time [s]."""
        ...

    @property
    def stop(self) -> float:
        """Last time [s]."""
        ...

    def motion(self, t: np.ndarray) -> Motion:
        """Movement at times (n,) [s] from start to stop."""
        ...


def _within(t: np.ndarray, start: float, stop: float) -> np.ndarray:
    """Times as floats, held to the path.

    Raises
    ------
    ValueError
        Where one is not on the path.
    """
    t = np.atleast_1d(np.asarray(t, float))
    slack = _SLACK * max(stop - start, 1.0)
    if not ((t >= start - slack) & (t <= stop + slack)).all():
        raise ValueError(f"times must be numbers on the path, {start:g} to {stop:g} s")
    return np.clip(t, start, stop)


@dataclass(frozen=True, eq=False)
class ConstantAcceleration:
    """Path of a point under a constant acceleration; a straight line where that is 0.

    Parameters
    ----------
    position, velocity, acceleration : (3,) array_like
        At time 0 [m, m/s, m/s^2].
    duration : float
        Length in time [s], > 0.
    """

    position: Sequence[float] | np.ndarray
    velocity: Sequence[float] | np.ndarray
    acceleration: Sequence[float] | np.ndarray
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
        x0, v0, a = (
            np.asarray(v, float) for v in (self.position, self.velocity, self.acceleration)
        )
        return Motion(x0 + (v0 + 0.5 * a * t) * t, v0 + a * t, a + 0 * t)


def straight(
    *,
    begin: Sequence[float] | np.ndarray,
    end: Sequence[float] | np.ndarray,
    initial_speed: float,
    final_speed: float | None = None,
) -> ConstantAcceleration:
    """Straight line between two points, the speed changing at a constant rate.

    Parameters
    ----------
    begin, end : (3,) array_like
        First and last position [m].
    initial_speed, final_speed : float
        Speeds there [m/s], >= 0 and not both 0; the final one is the initial one by default.

    Raises
    ------
    ValueError
        For equal points, or speeds that never cover the distance.
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
    """Path through given positions at given times.

    Parameters
    ----------
    time : (n,) array_like
        Rising times [s], at least two.
    position : (n, 3) array_like
        Positions there [m].
    smooth : bool
        A cubic spline, whose velocity and acceleration are steady (through two or three points,
        the line or parabola); False joins the points by straight lines at constant velocities.
    """

    time: Sequence[float] | np.ndarray
    position: Sequence[Sequence[float]] | np.ndarray
    smooth: bool = True
    _curve: PPoly = field(init=False, repr=False)
    _origin: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        t, x = rising_times(self.time), np.asarray(self.position, float)
        if x.shape != (len(t), 3) or not np.isfinite(x).all():
            raise ValueError(f"waypoints need three finite coordinates a time, not {x.shape}")
        # Far-off positions would cost the spline its last digits: it runs from the first one.
        origin, x = x[0], x - x[0]
        if self.smooth:
            curve: PPoly = CubicSpline(t, x)
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


def rising_times(time: Sequence[float] | np.ndarray) -> np.ndarray:
    """Times as an array.

    Raises
    ------
    ValueError
        Where they are fewer than two, not finite or not strictly rising.
    """
    t = np.asarray(time, float)
    if t.ndim != 1 or len(t) < 2 or not np.isfinite(t).all() or not (np.diff(t) > 0).all():
        raise ValueError("times must be two or more finite numbers that rise")
    return t


@dataclass(frozen=True, eq=False)
class Flight:
    """A body on a path, with an attitude, carrying the instrument.

    Parameters
    ----------
    path : Path
        Movement of the body's reference point.
    attitude : Attitude
        How the body is turned.
    lever_arm : (3,) array_like
        Position of the instrument in the body frame [m].
    """

    path: Path
    attitude: Attitude
    lever_arm: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)

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

        Raises
        ------
        ValueError
            For a time outside the path, or an attitude that the movement leaves undefined.
        """
        motion = self.path.motion(t)
        times = _within(t, self.start, self.stop)
        attitude, rate = self.attitude.turn(times, motion.velocity, motion.acceleration)
        arm = rotate(attitude, np.asarray(self.lever_arm, float))
        return State(motion.position + arm, motion.velocity + np.cross(rate, arm), attitude, rate)
