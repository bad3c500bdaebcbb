"""Directions and times of shots by number, rays of their beamlets, and pointing errors.

Directions are in the body frame (x forward, y left, z up).

A measurement cycle is the set of shots from which one velocity vector is made. Everything is a
function of the shot's number, so that any part of a flight can be had without the rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from sweep.model.geometry.quaternion import from_rotation_vector, multiply, rotate

JITTER_DOMAIN = "sweep.jitter"
"""Domain of the random key, so that no other use of the same seed meets its numbers."""


def cone(number: int, *, half_angle: float, azimuth: float = 0.0) -> np.ndarray:
    """Directions evenly round nadir, at an angle from it [rad], (number, 3).

    `azimuth` is that of the first beam, from forward towards the left [rad].
    """
    turn = azimuth + 2 * math.pi * np.arange(number) / number
    across = math.sin(half_angle)
    down = np.full(number, -math.cos(half_angle))
    return np.column_stack([across * np.cos(turn), across * np.sin(turn), down])


def steered(angle_x: np.ndarray, angle_y: np.ndarray) -> np.ndarray:
    """Directions of a two-axis steerer, (..., 3).

    The angle of an axis is that of the beam's projection on the plane of that axis and nadir, so
    that a grid of angles draws straight lines on level ground: ``tan = x / -z``. Both axes at
    22.5 deg make 30.4 deg from nadir. `angle_x` is towards forward and `angle_y` towards the left
    [rad], under 90 deg.
    """
    x, y = np.broadcast_arrays(np.tan(angle_x), np.tan(angle_y))
    vector = np.stack([x, y, np.full(x.shape, -1.0)], axis=-1)
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def corners(angle: float) -> np.ndarray:
    """Four directions at both axes' angles of +-`angle` [rad], counter-clockwise, (4, 3)."""
    return steered(angle * np.array([1, -1, -1, 1]), angle * np.array([1, 1, -1, -1]))


def stacked_angles(elements: Sequence[float]) -> np.ndarray:
    """Angles of an axis of stacked steering elements [rad], rising, (2^n,).

    Each element throws the beam to one side or the other by its angle, and the angles add: 15 and
    7.5 deg make -22.5, -7.5, 7.5 and 22.5 deg.
    """
    sides = np.array([0.0])
    for element in elements:
        sides = np.concatenate([sides - element, sides + element])
    return np.sort(sides)


def squares(elements: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """All angles of a steerer with like axes of `stacked_angles`, sorted into squares.

    A square is what a quarter turn about nadir makes of one pair of angles. The widest comes
    first and the narrowest last, each counter-clockwise: for the two elements of [T Fig. 5.2] the
    corners at 22.5 deg, the two squares that are askew, and the corners at 7.5 deg. Returns unit
    vectors (4^n, 3), square by square, and the beams of each square, (4^n / 4, 4) int64.
    """
    angles = stacked_angles(elements)
    if angles.min() >= 0 or len(np.unique(np.round(angles, 12))) < len(angles) or 0 in angles:
        raise ValueError("the elements must reach as many different angles, and not nadir")
    positive = angles[angles > 0]
    pairs = [(x, y) for x in positive for y in positive]
    pairs.sort(key=lambda pair: (-round(math.hypot(*np.tan(pair)), 12), -pair[0]))
    turned = [((x, y), (-y, x), (-x, -y), (y, -x)) for x, y in pairs]
    grid = np.array(turned).reshape(-1, 2)
    return steered(grid[:, 0], grid[:, 1]), np.arange(len(grid)).reshape(-1, 4)


class Shots(NamedTuple):
    """Shots of a scanner."""

    time: np.ndarray
    """(n,): start of each measurement, from the first one of the scan [s]."""
    beam: np.ndarray
    """(n,) int64: number of the beam."""
    cycle: np.ndarray
    """(n,) int64: number of the measurement cycle."""
    direction: np.ndarray
    """(n, 3): unit vectors in the body frame."""
    turning: np.ndarray
    """(n, 3): their rates of change there [1/s]."""


@dataclass(frozen=True, eq=False)
class BeamCycle:
    """Beams at fixed angles, fired in a cycle of patterns."""

    beams_at: Sequence[Sequence[float]] | np.ndarray
    """(b, 3): directions of the beams in the body frame; scaled to length 1."""
    patterns: Sequence[Sequence[int]] | np.ndarray
    """Beams of each measurement cycle as they fire; cycles take the patterns, all as long, in
    turn."""
    rate: float
    """Measurement cycles a second [Hz], > 0."""
    interval: float | None = None
    """Time from one beam of a cycle to the next [s]: 0 fires them at once (several telescopes),
    None spreads them evenly over the cycle (one steered beam)."""
    _steps: tuple[np.ndarray, np.ndarray, float] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        vectors, patterns = np.asarray(self.beams_at, float), np.asarray(self.patterns)
        if vectors.ndim != 2 or vectors.shape[1] != 3 or patterns.ndim != 2 or not patterns.size:
            raise ValueError("a cycle needs (b, 3) directions and patterns of one length")
        length = np.linalg.norm(vectors, axis=1, keepdims=True)
        if not (np.isfinite(length) & (length > 0)).all():
            raise ValueError("the beams' directions must be finite and other than zero")
        if patterns.min() < 0 or patterns.max() >= len(vectors):
            raise ValueError(f"patterns name beams 0 to {len(vectors) - 1}")
        if not (self.rate > 0 and math.isfinite(self.rate)):
            raise ValueError(f"the measurement rate must be positive, not {self.rate}")
        each = patterns.shape[1]
        interval = 1 / (each * self.rate) if self.interval is None else self.interval
        if not 0 <= interval * each * self.rate <= 1 + 1e-9:
            raise ValueError(f"{each} beams {interval:g} s apart do not fit in 1/{self.rate:g} s")
        object.__setattr__(self, "_steps", (vectors / length, patterns.astype(np.int64), interval))

    @property
    def beams(self) -> int:
        """Number of distinct beams."""
        return len(self._steps[0])

    @property
    def beams_per_cycle(self) -> int:
        """Shots of a measurement cycle."""
        return int(self._steps[1].shape[1])

    def number(self, duration: float) -> int:
        """Shots that begin within a duration [s], its end included."""
        return _begun(duration, self.rate, self.beams_per_cycle, self._steps[2])

    def shots(self, index: np.ndarray) -> Shots:
        """Shots by number (n,), from 0."""
        vectors, patterns, interval = self._steps
        cycle, place = np.divmod(np.asarray(index, np.int64), self.beams_per_cycle)
        beam = patterns[cycle % len(patterns), place]
        still = np.zeros((beam.size, 3))
        return Shots(cycle / self.rate + place * interval, beam, cycle, vectors[beam], still)


def _begun(duration: float, rate: float, each: int, interval: float) -> int:
    """Shots, `each` a cycle, that have begun within a duration [s]; none before time 0."""
    if duration < 0:
        return 0
    # A hair below a whole number is that number: times come from products that were rounded.
    whole = math.floor(duration * rate * (1 + 1e-12) + 1e-9)
    within = max(duration * rate - whole, 0.0) / rate
    last = min(each, math.floor(within / interval + 1e-6) + 1) if interval > 0 else each
    return whole * each + last


def fixed(
    beams_at: Sequence[Sequence[float]] | np.ndarray, *, rate: float, interval: float | None = 0.0
) -> BeamCycle:
    """Beams that all fire in every measurement cycle, at once by default."""
    return BeamCycle(beams_at, [list(range(len(beams_at)))], rate, interval)


def raster(
    *,
    columns: int,
    rows: int,
    half_angles: tuple[float, float],
    rate: float,
    both_ways: bool = True,
) -> BeamCycle:
    """Grid of directions, visited row by row, from right to left and from aft forward.

    `columns` lie across (y), `rows` along (x), at least 1 each; `half_angles` [rad] are the reach
    of both to each side of nadir. `rate` counts frames a second [Hz]. Every other row runs
    backwards; without `both_ways` each starts at the right.
    """
    across = half_angles[0] * np.linspace(-1, 1, columns) if columns > 1 else np.zeros(1)
    along = half_angles[1] * np.linspace(-1, 1, rows) if rows > 1 else np.zeros(1)
    order = np.arange(rows * columns).reshape(rows, columns)
    if both_ways:
        order[1::2] = order[1::2, ::-1]
    vectors = steered(along[:, None], across[None, :]).reshape(-1, 3)
    return BeamCycle(vectors, order.reshape(1, -1), rate)


@dataclass(frozen=True)
class LineScan:
    """Beams side by side along the track, swept together from side to side."""

    half_angle: float
    """Reach of the sweep to each side of nadir [rad], 0 <= . < pi/2."""
    line_rate: float
    """Lines a second [Hz]; a sweep one way is a line."""
    rate: float
    """Measurements a second of each beam [Hz]."""
    along: tuple[float, ...] = (0.0,)
    """Each beam's fixed angle from nadir towards forward [rad]."""
    wave: str = "triangle"
    """``triangle`` at a constant rate, or ``sine`` for a resonant mirror."""
    interval: float = 0.0
    """Time from one beam of a measurement to the next [s]; 0 fires them at once."""

    def __post_init__(self) -> None:
        if not (0 <= self.half_angle < math.pi / 2 and self.along):
            raise ValueError("a line scan needs a beam and a reach of 0 to 90 deg")
        if not (self.line_rate > 0 and self.rate > 0 and math.isfinite(self.rate)):
            raise ValueError("line rate and measurement rate must be positive")
        if self.wave not in ("triangle", "sine"):
            raise ValueError(f"a line scan's wave is 'triangle' or 'sine', not {self.wave!r}")
        if not 0 <= self.interval * len(self.along) * self.rate <= 1 + 1e-9:
            raise ValueError(f"the beams do not fit in a measurement of 1/{self.rate:g} s")

    @property
    def beams(self) -> int:
        """Number of distinct beams."""
        return len(self.along)

    def number(self, duration: float) -> int:
        """Shots that begin within a duration [s], its end included."""
        return _begun(duration, self.rate, self.beams, self.interval)

    def shots(self, index: np.ndarray) -> Shots:
        """Shots by number (n,), from 0; a cycle is one measurement of all beams."""
        cycle, beam = np.divmod(np.asarray(index, np.int64), self.beams)
        time = cycle / self.rate + beam * self.interval
        along, across = np.asarray(self.along)[beam], self.across(time)
        # The mirror turns the fan of beams about x: each keeps its angle towards forward.
        level, sine, cosine = np.cos(along), np.sin(across), np.cos(across)
        swept = level * self.across_rate(time)
        return Shots(
            time, beam, cycle, np.column_stack([np.sin(along), level * sine, -level * cosine]),
            np.column_stack([0.0 * swept, swept * cosine, swept * sine]),
        )  # fmt: skip

    def across(self, t: np.ndarray) -> np.ndarray:
        """Angle of the sweep from nadir towards the left [rad]; it starts at the right."""
        lines = np.asarray(t, float) * self.line_rate
        if self.wave == "sine":
            return np.asarray(-self.half_angle * np.cos(math.pi * lines))
        return np.asarray(self.half_angle * (1 - 2 * np.abs(1 - lines % 2)))

    def across_rate(self, t: np.ndarray) -> np.ndarray:
        """Rate of that angle [rad/s]; where it turns back, that of what follows."""
        lines = np.asarray(t, float) * self.line_rate
        if self.wave == "sine":
            return np.asarray(self.half_angle * math.pi * self.line_rate * np.sin(math.pi * lines))
        back = np.where(lines % 2 < 1, 1.0, -1.0)
        return np.asarray(2 * self.half_angle * self.line_rate * back)


Scanner = BeamCycle | LineScan
"""A scan pattern."""


def beamlet_rays(
    attitude: np.ndarray,
    axis: np.ndarray,
    across: np.ndarray,
    along: np.ndarray,
    sigma: float | np.ndarray,
) -> np.ndarray:
    """Return unit vectors of every beamlet in the world frame, (n, b, 3).

    `attitude` (n, 4) turns body to world, `axis` (n, 3) are the beams there. `across` and `along`
    (b,) are tangents of angles off the axis towards the two vectors of :func:`transverse_of`, in
    units of the beam's standard deviation `sigma` on each axis [rad], (n, 1) or scalar.
    """
    vectors = rotate(attitude[:, None], np.stack([*transverse_of(axis), axis], axis=1))
    first, second, centre = np.moveaxis(vectors, 0, 2)[..., None]
    rays = np.empty((len(axis), len(across), 3))
    for k in range(3):
        np.multiply(first[k], across * sigma, out=rays[..., k])
        rays[..., k] += second[k] * (along * sigma)
        rays[..., k] += centre[k]
    length = rays[..., 0] * rays[..., 0]
    for k in (1, 2):
        length += rays[..., k] * rays[..., k]
    np.sqrt(length, out=length)
    for k in range(3):
        rays[..., k] /= length
    return rays


def transverse_of(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across directions (n, 3): (first, second, direction) is right-handed.

    For a beam near -z the first lies near x. A smooth function of the direction but along -x
    and x, where no beam of a downward-looking instrument points.
    """
    second = np.cross(u, [1.0, 0.0, 0.0])
    length = _length(second)
    second = np.where(length < 1e-6, [0.0, 1.0, 0.0], second / np.maximum(length, 1e-6))
    first = np.cross(second, u)
    first /= _length(first)
    return first, np.cross(u, first)


def _length(v: np.ndarray) -> np.ndarray:
    x, y, z = v[..., :1], v[..., 1:2], v[..., 2:]
    return np.asarray(np.sqrt(x * x + y * y + z * z))


class PointingJitter(NamedTuple):
    """Random turns of the beams, shot by shot: three independent normal angles about body axes.

    A beam in any direction is thrown off by two angles across it, each of that standard
    deviation; the third angle turns its footprint about it.
    """

    sigma: float
    """Standard deviation of each angle [rad]."""
    seed: int
    """Seed of the study, >= 0."""

    def turned(self, attitude: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Attitudes (n, 4) of shots by number (n,), turned; any part is the same bit for bit."""
        from sweep.model.philox import STREAM_POINTING_JITTER, normals, point_keys, uniforms

        key = point_keys(np.empty((1, 0)), domain=JITTER_DOMAIN, seed=self.seed)
        keys = np.broadcast_to(key, (len(index), 2))  # a shot's number stands for that of a draw
        draws = normals(uniforms(keys, np.asarray(index), STREAM_POINTING_JITTER, 4))[:, :3]
        return multiply(attitude, from_rotation_vector(draws * self.sigma))
