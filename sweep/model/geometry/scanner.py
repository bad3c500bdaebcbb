"""Scanners: directions and times of shots by number, rays of their beamlets, and pointing errors.

Directions are in the body frame (x forward, y left, z up). A measurement cycle is the set of shots
from which one velocity vector is computed. Everything is a function of the shot's number, so that
any part of a flight can be computed without the rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from sweep.model.geometry.quaternion import from_rotation_vector, multiply, rotate

JITTER_DOMAIN = "sweep.jitter"
"""Domain of the random key, so that no other use of the same seed shares its numbers."""


def cone_directions(n_beams: int, *, half_angle: float, azimuth: float = 0.0) -> np.ndarray:
    """Return directions evenly spaced on a cone around nadir, (n_beams, 3).

    Parameters
    ----------
    n_beams : int
        Number of beams.
    half_angle : float
        Angle from nadir [rad].
    azimuth : float
        Azimuth of the first beam, from forward towards the left [rad].
    """
    azimuths = azimuth + 2 * math.pi * np.arange(n_beams) / n_beams
    horizontal = math.sin(half_angle)
    vertical = np.full(n_beams, -math.cos(half_angle))
    return np.column_stack([horizontal * np.cos(azimuths), horizontal * np.sin(azimuths), vertical])


def steered_directions(angle_x: np.ndarray, angle_y: np.ndarray) -> np.ndarray:
    """Return the directions of a two-axis beam steerer, (..., 3).

    Parameters
    ----------
    angle_x, angle_y : ndarray
        Angles towards forward and towards the left [rad], below 90 deg.

    Notes
    -----
    The angle of an axis is that of the beam's projection on the plane of that axis and nadir: ``tan
    = x / -z``. A grid of angles thus draws straight lines on level ground. Both axes at 22.5 deg
    make 30.4 deg from nadir.
    """
    x, y = np.broadcast_arrays(np.tan(angle_x), np.tan(angle_y))
    vector = np.stack([x, y, np.full(x.shape, -1.0)], axis=-1)
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def corner_directions(angle: float) -> np.ndarray:
    """Return the four directions with both axes at +-`angle` [rad], counter-clockwise, (4, 3)."""
    return steered_directions(angle * np.array([1, -1, -1, 1]), angle * np.array([1, 1, -1, -1]))


def stacked_angles(element_angles: Sequence[float]) -> np.ndarray:
    """Return the angles of an axis of n stacked steering elements [rad], ascending, (2^n,).

    Each element deflects the beam to either side by its angle, and the angles add: 15 and 7.5 deg
    make -22.5, -7.5, 7.5 and 22.5 deg.
    """
    angles = np.array([0.0])
    for element_angle in element_angles:
        angles = np.concatenate([angles - element_angle, angles + element_angle])
    return np.sort(angles)


def square_patterns(element_angles: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return all directions of a steerer with two axes of `stacked_angles`, sorted into squares.

    A square consists of one pair of angles and its quarter turns about nadir. The widest square
    comes first and the narrowest last, each counter-clockwise. For the two elements of [T Fig. 5.2]
    these are the corners at 22.5 deg, the two oblique squares, and the corners at 7.5 deg.

    Returns
    -------
    directions : ndarray (4^n, 3)
        Unit vectors, square by square.
    patterns : ndarray (4^n / 4, 4) int64
        Beams of each square.

    Raises
    ------
    ValueError
        If the elements do not reach distinct angles, or reach nadir.
    """
    angles = stacked_angles(element_angles)
    if angles.min() >= 0 or len(np.unique(np.round(angles, 12))) < len(angles) or 0 in angles:
        raise ValueError("the elements must reach as many different angles, and not nadir")
    positive_angles = angles[angles > 0]
    pairs = [(x, y) for x in positive_angles for y in positive_angles]
    pairs.sort(key=lambda pair: (-round(math.hypot(*np.tan(pair)), 12), -pair[0]))
    quarter_turns = [((x, y), (-y, x), (-x, -y), (y, -x)) for x, y in pairs]
    grid = np.array(quarter_turns).reshape(-1, 2)
    return steered_directions(grid[:, 0], grid[:, 1]), np.arange(len(grid)).reshape(-1, 4)


class ScanShots(NamedTuple):
    """Shots of a scanner."""

    time: np.ndarray
    """(n,): start of each measurement, from the first one of the scan [s]."""
    beam_number: np.ndarray
    """(n,) int64: number of the beam."""
    cycle_number: np.ndarray
    """(n,) int64: number of the measurement cycle."""
    direction: np.ndarray
    """(n, 3): unit vectors in the body frame."""
    direction_rate: np.ndarray
    """(n, 3): rate of change of the direction in the body frame [1/s]."""


@dataclass(frozen=True, eq=False)
class BeamCycle:
    """Beams at fixed angles, fired in a cycle of patterns."""

    directions: Sequence[Sequence[float]] | np.ndarray
    """(b, 3): directions of the beams in the body frame; they are normalised."""
    patterns: Sequence[Sequence[int]] | np.ndarray
    """(p, k): beams of each measurement cycle in the order of firing; cycles use the patterns in
    turn."""
    rate: float
    """Measurement cycles per second [Hz], > 0."""
    interval: float | None = None
    """Time from one beam of a cycle to the next [s]. 0 fires all at once (several telescopes); None
    spaces them evenly over the cycle (one steered beam)."""
    _checked: tuple[np.ndarray, np.ndarray, float] = field(init=False, repr=False)
    """Normalised directions, patterns as an array, and interval [s]."""

    def __post_init__(self) -> None:
        directions, patterns = np.asarray(self.directions, float), np.asarray(self.patterns)
        if (
            directions.ndim != 2
            or directions.shape[1] != 3
            or patterns.ndim != 2
            or not patterns.size
        ):
            raise ValueError("a cycle needs (b, 3) directions and patterns of one length")
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        if not (np.isfinite(length) & (length > 0)).all():
            raise ValueError("the beams' directions must be finite and other than zero")
        if patterns.min() < 0 or patterns.max() >= len(directions):
            raise ValueError(f"patterns name beams 0 to {len(directions) - 1}")
        if not (self.rate > 0 and math.isfinite(self.rate)):
            raise ValueError(f"the measurement rate must be positive, not {self.rate}")
        shots_per_cycle = patterns.shape[1]
        interval = 1 / (shots_per_cycle * self.rate) if self.interval is None else self.interval
        if not 0 <= interval * shots_per_cycle * self.rate <= 1 + 1e-9:
            raise ValueError(
                f"{shots_per_cycle} beams {interval:g} s apart do not fit in 1/{self.rate:g} s"
            )
        object.__setattr__(
            self, "_checked", (directions / length, patterns.astype(np.int64), interval)
        )

    @property
    def n_beams(self) -> int:
        """Number of distinct beams."""
        return len(self._checked[0])

    @property
    def beams_per_cycle(self) -> int:
        """Number of shots of a measurement cycle."""
        return int(self._checked[1].shape[1])

    def count_shots(self, duration: float) -> int:
        """Return the number of shots that begin within a duration [s], including its end."""
        return _count_begun_shots(duration, self.rate, self.beams_per_cycle, self._checked[2])

    def shots(self, shot_numbers: np.ndarray) -> ScanShots:
        """Return the shots of given numbers (n,), counted from 0."""
        directions, patterns, interval = self._checked
        cycle_number, shot_in_cycle = np.divmod(
            np.asarray(shot_numbers, np.int64), self.beams_per_cycle
        )
        beam_number = patterns[cycle_number % len(patterns), shot_in_cycle]
        zero_rate = np.zeros((beam_number.size, 3))
        return ScanShots(
            cycle_number / self.rate + shot_in_cycle * interval,
            beam_number,
            cycle_number,
            directions[beam_number],
            zero_rate,
        )


def _count_begun_shots(
    duration: float, cycle_rate: float, shots_per_cycle: int, interval: float
) -> int:
    """Count the shots, `shots_per_cycle` a cycle, that begin within a duration [s] from time 0."""
    if duration < 0:
        return 0
    # A number just below an integer counts as that integer, because times are rounded products.
    whole_cycles = math.floor(duration * cycle_rate * (1 + 1e-12) + 1e-9)
    time_in_cycle = max(duration * cycle_rate - whole_cycles, 0.0) / cycle_rate
    shots_in_last_cycle = (
        min(shots_per_cycle, math.floor(time_in_cycle / interval + 1e-6) + 1)
        if interval > 0
        else shots_per_cycle
    )
    return whole_cycles * shots_per_cycle + shots_in_last_cycle


def fixed_beams(
    directions: Sequence[Sequence[float]] | np.ndarray, *, rate: float, interval: float | None = 0.0
) -> BeamCycle:
    """Return a cycle of beams that all fire in every measurement cycle.

    Parameters
    ----------
    directions : array_like (b, 3)
        Directions of the beams in the body frame.
    rate : float
        Measurement cycles per second [Hz].
    interval : float, optional
        Time from one beam to the next [s]; 0 fires all at once, None spaces them evenly over the
        cycle.
    """
    return BeamCycle(directions, [list(range(len(directions)))], rate, interval)


def raster_scan(
    *,
    columns: int,
    rows: int,
    half_angles: tuple[float, float],
    rate: float,
    both_ways: bool = True,
) -> BeamCycle:
    """Return a grid of directions, scanned row by row, from right to left and from aft forward.

    Parameters
    ----------
    columns, rows : int
        Number of directions across (y) and along (x), at least 1 each.
    half_angles : tuple of float
        Largest angles from nadir across and along [rad].
    rate : float
        Frames per second [Hz].
    both_ways : bool
        True if every other row is scanned backwards; False if each row starts at the right.
    """
    angles_across = half_angles[0] * np.linspace(-1, 1, columns) if columns > 1 else np.zeros(1)
    angles_along = half_angles[1] * np.linspace(-1, 1, rows) if rows > 1 else np.zeros(1)
    order = np.arange(rows * columns).reshape(rows, columns)
    if both_ways:
        order[1::2] = order[1::2, ::-1]
    directions = steered_directions(angles_along[:, None], angles_across[None, :]).reshape(-1, 3)
    return BeamCycle(directions, order.reshape(1, -1), rate)


@dataclass(frozen=True)
class LineScan:
    """Parallel beams along the track, swept together from side to side."""

    half_angle: float
    """Largest angle of the sweep from nadir to each side [rad], 0 <= . < pi/2."""
    line_rate: float
    """Lines per second [Hz]; a sweep in one direction is a line."""
    rate: float
    """Measurements per second of each beam [Hz]."""
    along: tuple[float, ...] = (0.0,)
    """Fixed angle of each beam from nadir towards forward [rad]."""
    wave: str = "triangle"
    """``triangle`` at a constant rate, or ``sine`` for a resonant mirror."""
    interval: float = 0.0
    """Time from one beam of a measurement to the next [s]; 0 fires all at once."""

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
    def n_beams(self) -> int:
        """Number of distinct beams."""
        return len(self.along)

    def count_shots(self, duration: float) -> int:
        """Return the number of shots that begin within a duration [s], including its end."""
        return _count_begun_shots(duration, self.rate, self.n_beams, self.interval)

    def shots(self, shot_numbers: np.ndarray) -> ScanShots:
        """Return the shots of given numbers (n,), counted from 0.

        A cycle is one measurement of all beams.
        """
        cycle_number, beam_number = np.divmod(np.asarray(shot_numbers, np.int64), self.n_beams)
        time = cycle_number / self.rate + beam_number * self.interval
        angle_along, angle_across = np.asarray(self.along)[beam_number], self.sweep_angle(time)
        # The mirror rotates the fan of beams about x: each beam keeps its angle towards forward.
        cosine_along, sine_across, cosine_across = (
            np.cos(angle_along),
            np.sin(angle_across),
            np.cos(angle_across),
        )
        horizontal_rate = cosine_along * self.sweep_rate(time)
        return ScanShots(
            time,
            beam_number,
            cycle_number,
            np.column_stack(
                [np.sin(angle_along), cosine_along * sine_across, -cosine_along * cosine_across]
            ),
            np.column_stack(
                [
                    0.0 * horizontal_rate,
                    horizontal_rate * cosine_across,
                    horizontal_rate * sine_across,
                ]
            ),
        )

    def sweep_angle(self, times: np.ndarray) -> np.ndarray:
        """Return the sweep angle from nadir towards the left [rad]; it starts at the right."""
        lines_scanned = np.asarray(times, float) * self.line_rate
        if self.wave == "sine":
            return np.asarray(-self.half_angle * np.cos(math.pi * lines_scanned))
        return np.asarray(self.half_angle * (1 - 2 * np.abs(1 - lines_scanned % 2)))

    def sweep_rate(self, times: np.ndarray) -> np.ndarray:
        """Return the rate of the sweep angle [rad/s]; at a turning point, the rate after it."""
        lines_scanned = np.asarray(times, float) * self.line_rate
        if self.wave == "sine":
            return np.asarray(
                self.half_angle * math.pi * self.line_rate * np.sin(math.pi * lines_scanned)
            )
        direction_sign = np.where(lines_scanned % 2 < 1, 1.0, -1.0)
        return np.asarray(2 * self.half_angle * self.line_rate * direction_sign)


ScanPattern = BeamCycle | LineScan
"""A scan pattern."""


def beamlet_rays(
    attitude: np.ndarray,
    axis: np.ndarray,
    tangent_across: np.ndarray,
    tangent_along: np.ndarray,
    sigma: float | np.ndarray,
) -> np.ndarray:
    """Return unit vectors of all beamlets in the world frame, (n, b, 3).

    Parameters
    ----------
    attitude : ndarray (n, 4)
        Quaternions from body to world.
    axis : ndarray (n, 3)
        Directions of the beams in the body frame.
    tangent_across, tangent_along : ndarray (b,)
        Tangents of angles off the axis towards the two vectors of :func:`transverse_axes`, in units
        of `sigma`.
    sigma : float or ndarray (n, 1)
        Standard deviation of the beam on each axis [rad].
    """
    axes = rotate(attitude[:, None], np.stack([*transverse_axes(axis), axis], axis=1))
    first, second, axis_vector = np.moveaxis(axes, 0, 2)[..., None]
    rays = np.empty((len(axis), len(tangent_across), 3))
    for component in range(3):
        np.multiply(first[component], tangent_across * sigma, out=rays[..., component])
        rays[..., component] += second[component] * (tangent_along * sigma)
        rays[..., component] += axis_vector[component]
    length = rays[..., 0] * rays[..., 0]
    for component in (1, 2):
        length += rays[..., component] * rays[..., component]
    np.sqrt(length, out=length)
    for component in range(3):
        rays[..., component] /= length
    return rays


def transverse_axes(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors across directions (n, 3): (first, second, direction) is right-handed.

    For a beam near -z the first vector lies near x. They are smooth functions of the direction
    except near x and -x, where no beam of a downward-looking instrument points.
    """
    second = np.cross(direction, [1.0, 0.0, 0.0])
    length = _vector_length(second)
    second = np.where(length < 1e-6, [0.0, 1.0, 0.0], second / np.maximum(length, 1e-6))
    first = np.cross(second, direction)
    first /= _vector_length(first)
    return first, np.cross(direction, first)


def _vector_length(vectors: np.ndarray) -> np.ndarray:
    """Return the length of vectors, (..., 1)."""
    x, y, z = vectors[..., :1], vectors[..., 1:2], vectors[..., 2:]
    return np.asarray(np.sqrt(x * x + y * y + z * z))


class PointingJitter(NamedTuple):
    """Random rotations of the beams, shot by shot: three independent normal angles about body axes.

    A beam in any direction is deflected by two angles across it, each of that standard deviation.
    The third angle rotates its footprint.
    """

    sigma: float
    """Standard deviation of each angle [rad]."""
    seed: int
    """Seed of the study, >= 0."""

    def perturb_attitude(self, attitude: np.ndarray, shot_numbers: np.ndarray) -> np.ndarray:
        """Rotate the attitudes of shots at random.

        Parameters
        ----------
        attitude : ndarray (n, 4)
            Quaternions from body to world.
        shot_numbers : ndarray (n,)
            Numbers of the shots. The rotation depends only on seed and number, so that any part of
            a flight has the same bits.

        Returns
        -------
        ndarray (n, 4)
        """
        from sweep.model.sampling.philox import (
            STREAM_POINTING_JITTER,
            point_keys,
            to_normals_by_row,
            uniforms,
        )

        study_key = point_keys(np.empty((1, 0)), domain=JITTER_DOMAIN, seed=self.seed)
        keys = np.broadcast_to(
            study_key, (len(shot_numbers), 2)
        )  # the shot's number replaces that of a draw
        normal_draws = to_normals_by_row(
            uniforms(keys, np.asarray(shot_numbers), STREAM_POINTING_JITTER, 4)
        )[:, :3]
        return multiply(attitude, from_rotation_vector(normal_draws * self.sigma))
