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

JITTER_KEY_DOMAIN = "sweep.jitter"
"""Text that is hashed into the random key of pointing jitter, so that the key differs from other
keys made from the same seed."""


def cone_directions(n_beams: int, *, half_angle: float, azimuth: float = 0.0) -> np.ndarray:
    """Return unit vectors of beams evenly spaced on a cone around nadir.

    The vectors are in the body frame.

    Parameters
    ----------
    n_beams : int
        Number of beams.
    half_angle : float
        Angle of each beam from nadir [rad].
    azimuth : float
        Angle of the first beam about the vertical, from forward towards the left [rad].

    Returns
    -------
    ndarray (n_beams, 3)
        Unit vectors.
    """
    azimuths = azimuth + 2 * math.pi * np.arange(n_beams) / n_beams
    horizontal = math.sin(half_angle)
    vertical = np.full(n_beams, -math.cos(half_angle))
    return np.column_stack([horizontal * np.cos(azimuths), horizontal * np.sin(azimuths), vertical])


def steered_directions(angle_x: np.ndarray, angle_y: np.ndarray) -> np.ndarray:
    """Return unit vectors of beams steered about two axes, in the body frame.

    Parameters
    ----------
    angle_x, angle_y : ndarray
        Angles of the beam from nadir towards forward and towards the left [rad], below 90 deg.

    Returns
    -------
    ndarray (..., 3)
        Unit vectors, in the shape to which the angles broadcast.

    Notes
    -----
    The direction is proportional to (tan angle_x, tan angle_y, -1). A grid of angles thus draws
    straight lines on level ground. With both angles at 22.5 deg the beam is 30.4 deg from nadir.
    """
    x, y = np.broadcast_arrays(np.tan(angle_x), np.tan(angle_y))
    vector = np.stack([x, y, np.full(x.shape, -1.0)], axis=-1)
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def corner_directions(angle: float) -> np.ndarray:
    """Return the directions of four beams, each steered by +-`angle` [rad] towards x and y.

    The angles are those of :func:`steered_directions`.

    Returns
    -------
    ndarray (4, 3)
        Unit vectors, counter-clockwise seen from above.
    """
    return steered_directions(angle * np.array([1, -1, -1, 1]), angle * np.array([1, 1, -1, -1]))


def stacked_deflections(element_angles: Sequence[float]) -> np.ndarray:
    """Return all deflections [rad] that a stack of n steering elements can give, ascending, (2^n,).

    Each element deflects the beam to one side or the other by its angle [rad], and deflections add.
    Elements of 15 and 7.5 deg reach -22.5, -7.5, 7.5 and 22.5 deg.
    """
    angles = np.array([0.0])
    for element_angle in element_angles:
        angles = np.concatenate([angles - element_angle, angles + element_angle])
    return np.sort(angles)


def square_patterns(element_angles: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return all directions of a two-axis steerer of stacked elements, sorted into squares.

    Parameters
    ----------
    element_angles : sequence of float
        Angles of the n elements of each axis [rad], as in :func:`stacked_deflections`.

    Returns
    -------
    directions : ndarray (4^n, 3)
        Unit vectors, square by square.
    patterns : ndarray (4^n / 4, 4) int64
        Indices of the four directions of each square.

    Raises
    ------
    ValueError
        If the elements do not reach distinct angles, or reach nadir.

    Notes
    -----
    A square consists of one pair of angles and its quarter turns about nadir. The widest square
    comes first and the narrowest last, each counter-clockwise. For the two elements of [T Fig. 5.2]
    these are the corners at 22.5 deg, the two oblique squares, and the corners at 7.5 deg.
    """
    angles = stacked_deflections(element_angles)
    if angles.min() >= 0 or len(np.unique(np.round(angles, 12))) < len(angles) or 0 in angles:
        raise ValueError("the elements must reach as many different angles, and not nadir")
    positive_angles = angles[angles > 0]
    pairs = [(x, y) for x in positive_angles for y in positive_angles]
    pairs.sort(key=lambda pair: (-round(math.hypot(*np.tan(pair)), 12), -pair[0]))
    quarter_turns = [((x, y), (-y, x), (-x, -y), (y, -x)) for x, y in pairs]
    grid = np.array(quarter_turns).reshape(-1, 2)
    return steered_directions(grid[:, 0], grid[:, 1]), np.arange(len(grid)).reshape(-1, 4)


class ScanShots(NamedTuple):
    """Times, beams and directions of n shots of a scanner."""

    time: np.ndarray
    """(n,): time from the scan's first measurement to the start of each measurement [s]."""
    beam_number: np.ndarray
    """(n,) int64: number of the beam that fires each shot."""
    cycle_number: np.ndarray
    """(n,) int64: number of the measurement cycle to which each shot belongs."""
    direction: np.ndarray
    """(n, 3): unit vectors along the beams in the body frame."""
    direction_rate: np.ndarray
    """(n, 3): time derivative of ``direction`` in the body frame [1/s]."""


@dataclass(frozen=True, eq=False)
class BeamCycle:
    """Scan pattern of beams at fixed angles, fired in a repeated sequence of groups (patterns)."""

    directions: Sequence[Sequence[float]] | np.ndarray
    """(b, 3): directions of the beams in the body frame; vectors of any length above 0."""
    patterns: Sequence[Sequence[int]] | np.ndarray
    """(p, k): indices of the k beams in each of p patterns. Each measurement cycle fires the beams
    of one pattern in their order. The next cycle fires the next pattern."""
    cycle_rate: float
    """Number of measurement cycles per second [Hz], > 0."""
    shot_interval: float | None = None
    """Time from one shot to the next within a measurement cycle [s]. With 0 all beams fire at once
    (several telescopes). With None the shots are spaced evenly over the cycle (one steered beam).
    """
    _unit_directions: np.ndarray = field(init=False, repr=False)
    """(b, 3): unit vectors along `directions`."""
    _pattern_table: np.ndarray = field(init=False, repr=False)
    """(p, k) int64: indices of the k beams in each of p patterns, as an array."""
    _resolved_shot_interval: float = field(init=False, repr=False)
    """Time from one shot to the next within a measurement cycle [s]: ``shot_interval``, or the even
    spacing over the cycle if ``shot_interval`` is None."""

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
        if not (self.cycle_rate > 0 and math.isfinite(self.cycle_rate)):
            raise ValueError(f"the measurement rate must be positive, not {self.cycle_rate}")
        shots_per_cycle = patterns.shape[1]
        interval = (
            1 / (shots_per_cycle * self.cycle_rate)
            if self.shot_interval is None
            else self.shot_interval
        )
        if not 0 <= interval * shots_per_cycle * self.cycle_rate <= 1 + 1e-9:
            raise ValueError(
                f"{shots_per_cycle} beams {interval:g} s apart do not fit in "
                f"1/{self.cycle_rate:g} s"
            )
        object.__setattr__(self, "_unit_directions", directions / length)
        object.__setattr__(self, "_pattern_table", patterns.astype(np.int64))
        object.__setattr__(self, "_resolved_shot_interval", interval)

    @property
    def n_beams(self) -> int:
        """Number of beams with distinct directions."""
        return len(self._unit_directions)

    @property
    def shots_per_cycle(self) -> int:
        """Number of shots in a measurement cycle, one per beam of a pattern."""
        return int(self._pattern_table.shape[1])

    def count_shots(self, duration: float) -> int:
        """Return the number of shots that begin at times 0 .. ``duration`` [s], ends included."""
        return _count_begun_shots(
            duration, self.cycle_rate, self.shots_per_cycle, self._resolved_shot_interval
        )

    def shots(self, shot_numbers: np.ndarray) -> ScanShots:
        """Return the :class:`ScanShots` with the given shot numbers (n,), counted from 0."""
        patterns = self._pattern_table
        cycle_number, shot_in_cycle = np.divmod(
            np.asarray(shot_numbers, np.int64), self.shots_per_cycle
        )
        beam_number = patterns[cycle_number % len(patterns), shot_in_cycle]
        zero_rate = np.zeros((beam_number.size, 3))
        return ScanShots(
            cycle_number / self.cycle_rate + shot_in_cycle * self._resolved_shot_interval,
            beam_number,
            cycle_number,
            self._unit_directions[beam_number],
            zero_rate,
        )


def _count_begun_shots(
    duration: float, cycle_rate: float, shots_per_cycle: int, interval: float
) -> int:
    """Count the shots that begin within a duration [s] from time 0.

    Measurement cycles are repeated at ``cycle_rate`` [Hz]. Each has ``shots_per_cycle`` shots,
    ``interval`` [s] apart.
    """
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
    """Return a scan pattern of beams at fixed angles that all fire in every measurement cycle.

    Parameters
    ----------
    directions : array_like (b, 3)
        Directions of the beams in the body frame.
    rate : float
        Measurement cycles per second [Hz].
    interval : float, optional
        Time from one beam to the next [s]. 0 fires all beams at once, None spaces them evenly over
        the cycle.

    Returns
    -------
    BeamCycle
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
    """Return a scan pattern over a grid of directions, scanned once in each measurement cycle.

    One scan of the grid is a frame. Rows are scanned from aft forward, and each row from right to
    left.

    Parameters
    ----------
    columns, rows : int
        Number of directions across the track (y) and along it (x), at least 1 each.
    half_angles : tuple of float
        Largest angles from nadir across and along the track [rad].
    rate : float
        Frames per second [Hz].
    both_ways : bool
        True if every other row is scanned backwards; False if each row starts at the right.

    Returns
    -------
    BeamCycle
        Cycle of columns * rows shots, spaced evenly over 1 / rate [s].
    """
    half_angle_across, half_angle_along = half_angles
    angles_across = half_angle_across * np.linspace(-1, 1, columns) if columns > 1 else np.zeros(1)
    angles_along = half_angle_along * np.linspace(-1, 1, rows) if rows > 1 else np.zeros(1)
    order = np.arange(rows * columns).reshape(rows, columns)
    if both_ways:
        order[1::2] = order[1::2, ::-1]
    directions = steered_directions(angles_along[:, None], angles_across[None, :]).reshape(-1, 3)
    return BeamCycle(directions, order.reshape(1, -1), rate)


@dataclass(frozen=True)
class LineScan:
    """Fan of beams, spread along the track, that a mirror sweeps together from side to side."""

    half_angle: float
    """Largest angle from nadir that the sweep reaches on each side [rad], at least 0 and below
    pi/2."""
    line_rate: float
    """Number of lines per second [Hz]. A line is a sweep in one direction."""
    rate: float
    """Number of measurements per second of each beam [Hz]."""
    along: tuple[float, ...] = (0.0,)
    """Fixed angle of each beam from nadir, towards forward [rad]."""
    wave: str = "triangle"
    """Shape of the sweep angle over time: ``triangle`` for a constant rate, ``sine`` for a resonant
    mirror."""
    interval: float = 0.0
    """Time from one beam's shot to the next beam's in a measurement cycle [s]. With 0 all beams
    fire at once."""

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
        """Number of beams with distinct directions."""
        return len(self.along)

    def count_shots(self, duration: float) -> int:
        """Return the number of shots that begin at times 0 .. ``duration`` [s], ends included."""
        return _count_begun_shots(duration, self.rate, self.n_beams, self.interval)

    def shots(self, shot_numbers: np.ndarray) -> ScanShots:
        """Return the :class:`ScanShots` with the given shot numbers (n,), counted from 0.

        A measurement cycle is one shot of each beam.
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
        """Return the sweep angle at times [s], from nadir towards the left [rad].

        The first sweep starts at the right.
        """
        lines_scanned = np.asarray(times, float) * self.line_rate
        if self.wave == "sine":
            return np.asarray(-self.half_angle * np.cos(math.pi * lines_scanned))
        return np.asarray(self.half_angle * (1 - 2 * np.abs(1 - lines_scanned % 2)))

    def sweep_rate(self, times: np.ndarray) -> np.ndarray:
        """Return the time derivative of the sweep angle at times [s], in rad/s.

        At a turning point of the mirror, the rate after the turn is returned.
        """
        lines_scanned = np.asarray(times, float) * self.line_rate
        if self.wave == "sine":
            return np.asarray(
                self.half_angle * math.pi * self.line_rate * np.sin(math.pi * lines_scanned)
            )
        direction_sign = np.where(lines_scanned % 2 < 1, 1.0, -1.0)
        return np.asarray(2 * self.half_angle * self.line_rate * direction_sign)


ScanPattern = BeamCycle | LineScan
"""Pattern of a scanner: times and directions of its shots, as a function of their numbers."""


def beamlet_directions(
    attitude: np.ndarray,
    axis: np.ndarray,
    tangent_across: np.ndarray,
    tangent_along: np.ndarray,
    sigma: float | np.ndarray,
) -> np.ndarray:
    """Return unit vectors of all beamlets (rays that sample a beam) in the world frame.

    Parameters
    ----------
    attitude : ndarray (n, 4)
        Quaternions from body to world.
    axis : ndarray (n, 3)
        Directions of the beams in the body frame.
    tangent_across, tangent_along : ndarray (b,)
        Tangents of the beamlets' angles off the axis, over `sigma`, towards the first and second
        vector of :func:`transverse_axes`.
    sigma : float or ndarray (n, 1)
        Standard deviation of the beam on each axis [rad].

    Returns
    -------
    ndarray (n, b, 3)
        Unit vectors along a + sigma (x e_1 + y e_2). a is the direction of the beam, x and y are
        the tangents across and along, and e_1 and e_2 the vectors of :func:`transverse_axes`. All
        vectors are in the world frame.
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
    """Return two unit vectors perpendicular to each direction and to each other, (n, 3) each.

    First, second and `direction` (n, 3) form a right-handed system. For a beam near -z the first
    vector lies near x. Both vectors are smooth functions of the direction except near x and -x,
    where no beam of a downward-looking instrument points.
    """
    second = np.cross(direction, [1.0, 0.0, 0.0])
    length = _vector_length(second)
    second = np.where(length < 1e-6, [0.0, 1.0, 0.0], second / np.maximum(length, 1e-6))
    first = np.cross(second, direction)
    first /= _vector_length(first)
    return first, np.cross(direction, first)


def _vector_length(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths (..., 1) of vectors (..., 3)."""
    x, y, z = vectors[..., :1], vectors[..., 1:2], vectors[..., 2:]
    return np.asarray(np.sqrt(x * x + y * y + z * z))


class PointingJitter(NamedTuple):
    """Random pointing errors: each shot's beams rotate about the three body axes.

    The three angles are independent normal random numbers. Two of their combinations deflect a beam
    across its direction, each with the standard deviation `sigma`. The third rotates the footprint
    about the beam.
    """

    sigma: float
    """Standard deviation of the rotation angle about each body axis [rad]."""
    seed: int
    """Seed of the study's random numbers, >= 0."""

    def perturb_attitude(self, attitude: np.ndarray, shot_numbers: np.ndarray) -> np.ndarray:
        """Rotate attitudes by the pointing errors of their shots.

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
            Rotated quaternions.
        """
        from sweep.model.sampling.philox import (
            STREAM_POINTING_JITTER,
            point_keys,
            to_normals_by_row,
            uniforms,
        )

        study_key = point_keys(np.empty((1, 0)), domain=JITTER_KEY_DOMAIN, seed=self.seed)
        keys = np.broadcast_to(
            study_key, (len(shot_numbers), 2)
        )  # the shot's number replaces that of a draw
        normal_draws = to_normals_by_row(
            uniforms(keys, np.asarray(shot_numbers), STREAM_POINTING_JITTER, 4)
        )[:, :3]
        return multiply(attitude, from_rotation_vector(normal_draws * self.sigma))
