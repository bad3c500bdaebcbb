"""How a body is turned along its path. Body frame: x forward, y left, z up.

Every law gives the quaternion (body to world) and the angular velocity that is its derivative.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from sweep.model.geometry import quaternion as quat

_VERTICAL = 1e-9
"""Horizontal share of the speed under which a movement has no heading."""

_MOST_SCALED = 1000
"""Powers of two by which velocities are scaled: no larger number has an inverse."""

Turn = tuple[np.ndarray, np.ndarray]
"""Quaternion (n, 4), body to world, and angular velocity (n, 3) [rad/s] in the world frame."""


class Attitude(Protocol):
    """A law of attitude."""

    def turn(self, t: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Turn:
        """Attitude and angular velocity.

        Parameters
        ----------
        t : (n,) ndarray
            Times [s].
        velocity, acceleration : (n, 3) ndarray
            Movement of the body at those times [m/s, m/s^2].
        """
        ...


@dataclass(frozen=True)
class Nadir:
    """Level, so that a beam along -z points straight down.

    Parameters
    ----------
    heading : float or None
        Angle of the forward axis from the world's x, counter-clockwise from above [rad]; None
        follows the track over the ground, which a vertical movement does not have.
    """

    heading: float | None = 0.0

    def turn(self, t: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Turn:
        """Attitude and angular velocity."""
        if self.heading is not None:
            return np.tile(quat.about(2, self.heading), (len(t), 1)), np.zeros((len(t), 3))
        unit, scale = _scaled(velocity)
        heading, yaw_rate, _ = _track(unit, acceleration)
        yaw_rate = _rate(yaw_rate, scale)
        return quat.about(2, heading), yaw_rate[:, None] * [0.0, 0.0, 1.0]


@dataclass(frozen=True)
class AlongTrack:
    """Forward axis along the velocity, wings level but for a bank.

    Parameters
    ----------
    roll : float
        Left side up [rad], constant.
    """

    roll: float = 0.0

    def turn(self, t: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Turn:
        """Attitude and angular velocity."""
        unit, scale = _scaled(velocity)
        heading, yaw_rate, level = _track(unit, acceleration)
        speed2 = (unit**2).sum(axis=1)
        pitch = np.arctan2(unit[:, 2], level)
        level_rate = (unit[:, :2] * acceleration[:, :2]).sum(axis=1) / level
        pitch_rate = (acceleration[:, 2] * level - unit[:, 2] * level_rate) / speed2
        yaw_rate, pitch_rate = _rate(yaw_rate, scale), _rate(pitch_rate, scale)
        left = np.column_stack([-np.sin(heading), np.cos(heading), np.zeros(len(t))])
        rate = yaw_rate[:, None] * [0.0, 0.0, 1.0] - pitch_rate[:, None] * left
        return quat.from_heading(heading=heading, pitch=pitch, roll=self.roll), rate


def _scaled(velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocities times powers of two, so that their squares are numbers however slow; and these."""
    _, exponent = np.frexp(np.abs(velocity).max(axis=1))
    scale = np.ldexp(1.0, np.clip(-exponent, -_MOST_SCALED, _MOST_SCALED))
    return velocity * scale[:, None], scale


def _rate(rate: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Rate of an angle between velocities [rad/s], (n,), from that of scaled ones."""
    with np.errstate(over="ignore"):
        found = rate * scale
    if not np.isfinite(found).all():
        raise ValueError("so slow a movement that turns has no heading to follow: state one")
    return found


def _track(
    velocity: np.ndarray, acceleration: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heading [rad], its rate and the horizontal speed, each (n,), in the velocities' unit."""
    vx, vy = velocity[:, 0], velocity[:, 1]
    level = np.hypot(vx, vy)
    if not (level > _VERTICAL * np.linalg.norm(velocity, axis=1)).all():
        raise ValueError("a vertical movement (or none) has no heading to follow: state one")
    rate = (vx * acceleration[:, 1] - vy * acceleration[:, 0]) / level**2
    return np.arctan2(vy, vx), rate, level


@dataclass(frozen=True, eq=False)
class Fixed:
    """One attitude throughout.

    Parameters
    ----------
    quaternion : (4,) array_like
        (w, x, y, z), body to world; scaled to length 1.
    """

    quaternion: Sequence[float] | np.ndarray

    def turn(self, t: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Turn:
        """Attitude and angular velocity."""
        q = quat.normalise(np.asarray(self.quaternion, float))
        return np.tile(q, (len(t), 1)), np.zeros((len(t), 3))


@dataclass(frozen=True, eq=False)
class Spin:
    """Turning at a constant rate about an axis that is fixed in the body and in the world.

    Parameters
    ----------
    rate : (3,) array_like
        Angular velocity in the world frame [rad/s].
    quaternion : (4,) array_like
        Attitude at `time`.
    time : float
        When the body has that attitude [s].
    """

    rate: Sequence[float] | np.ndarray
    quaternion: Sequence[float] | np.ndarray = (1.0, 0.0, 0.0, 0.0)
    time: float = 0.0

    def turn(self, t: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Turn:
        """Attitude and angular velocity."""
        rate = np.asarray(self.rate, float)
        turned = quat.from_rotation_vector((t - self.time)[:, None] * rate)
        first = quat.normalise(np.asarray(self.quaternion, float))
        return quat.multiply(turned, first), np.tile(rate, (len(t), 1))


@dataclass(frozen=True, eq=False)
class Track:
    """Attitudes at given times, joined by turns at a constant rate the shorter way (slerp).

    Before the first and after the last the attitude stays.

    Parameters
    ----------
    time : (n,) array_like
        Rising times [s].
    quaternion : (n, 4) array_like
        Attitudes there; q and -q are one.
    """

    time: Sequence[float] | np.ndarray
    quaternion: Sequence[Sequence[float]] | np.ndarray
    _steps: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        t, q = np.asarray(self.time, float), np.asarray(self.quaternion, float)
        if t.ndim != 1 or len(t) < 2 or q.shape != (len(t), 4) or not (np.diff(t) > 0).all():
            raise ValueError("a quaternion track needs rising times with four numbers each")
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
    """An instrument turned with respect to the body that carries it.

    Parameters
    ----------
    carrier : Attitude
        Law of the body.
    quaternion : (4,) array_like
        Instrument to body frame.
    """

    carrier: Attitude
    quaternion: Sequence[float] | np.ndarray

    def turn(self, t: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> Turn:
        """Attitude and angular velocity."""
        q, rate = self.carrier.turn(t, velocity, acceleration)
        return quat.multiply(q, quat.normalise(np.asarray(self.quaternion, float))), rate
