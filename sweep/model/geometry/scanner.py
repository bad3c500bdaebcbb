"""Where the beams point, and when: shots by number, in the body frame (x forward, y left, z up).

A measurement cycle is the set of shots from which one velocity vector is made. Everything is a
function of the shot's number, so that any stretch of a flight can be had without the rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from sweep.model.geometry.beams import steered


class Shots(NamedTuple):
    """Shots of a scanner.

    Parameters
    ----------
    time : (n,) ndarray
        Start of each measurement, from the first one of the scan [s].
    beam : (n,) int64 ndarray
        Number of the beam.
    cycle : (n,) int64 ndarray
        Number of the measurement cycle.
    direction : (n, 3) ndarray
        Unit vectors in the body frame.
    """

    time: np.ndarray
    beam: np.ndarray
    cycle: np.ndarray
    direction: np.ndarray


class Scanner(Protocol):
    """A scan pattern."""

    @property
    def beams(self) -> int:
        """Number of distinct beams."""
        ...

    def number(self, duration: float) -> int:
        """Shots that begin within a duration [s], its end included."""
        ...

    def shots(self, index: np.ndarray) -> Shots:
        """Shots by number (n,), from 0."""
        ...


@dataclass(frozen=True, eq=False)
class BeamCycle:
    """Beams at fixed angles, fired in a cycle of patterns.

    Parameters
    ----------
    beams_at : (b, 3) array_like
        Directions of the beams in the body frame; scaled to length 1.
    patterns : sequence of sequences of int
        Beams of each measurement cycle, in the order in which they fire; the cycles take the
        patterns in turn. All of one length.
    rate : float
        Measurement cycles a second [Hz], > 0.
    interval : float or None
        Time from one beam of a cycle to the next [s]: 0 fires them at once (several telescopes),
        None spreads them evenly over the cycle (one steered beam).
    """

    beams_at: Sequence[Sequence[float]] | np.ndarray
    patterns: Sequence[Sequence[int]] | np.ndarray
    rate: float
    interval: float | None = None
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
        return int(self._begun(np.array([duration]))[0])

    def _begun(self, t: np.ndarray) -> np.ndarray:
        return shots_begun(t, rate=self.rate, each=self.beams_per_cycle, interval=self._steps[2])

    def shots(self, index: np.ndarray) -> Shots:
        """Shots by number (n,), from 0."""
        vectors, patterns, interval = self._steps
        cycle, place = np.divmod(np.asarray(index, np.int64), self.beams_per_cycle)
        beam = patterns[cycle % len(patterns), place]
        return Shots(cycle / self.rate + place * interval, beam, cycle, vectors[beam])


def shots_begun(t: np.ndarray, *, rate: float, each: int, interval: float) -> np.ndarray:
    """Number of shots that have begun at times [s], (n,) int64; none before time 0.

    Parameters
    ----------
    t : (n,) array_like
        Times since the first shot [s].
    rate : float
        Cycles a second [Hz].
    each : int
        Shots a cycle.
    interval : float
        Time from one to the next within a cycle [s], >= 0.
    """
    t = np.asarray(t, float)
    # A hair below a whole number is that number: times come from products that were rounded.
    cycles = t * rate
    whole = np.floor(cycles * (1 + 1e-12) + 1e-9)
    within = np.maximum(cycles - whole, 0.0) / rate
    last = np.full(t.shape, float(each))
    if interval > 0:
        last = np.minimum(last, np.floor(within / interval + 1e-6) + 1)
    return np.where(t < 0, 0, whole * each + last).astype(np.int64)


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

    Parameters
    ----------
    columns, rows : int
        Directions across (y) and along (x), at least 1 each.
    half_angles : (across, along) of float
        Reach of the grid to each side of nadir [rad].
    rate : float
        Frames a second [Hz].
    both_ways : bool
        Every other row runs backwards; False starts each at the right.
    """
    across = half_angles[0] * np.linspace(-1, 1, columns) if columns > 1 else np.zeros(1)
    along = half_angles[1] * np.linspace(-1, 1, rows) if rows > 1 else np.zeros(1)
    order = np.arange(rows * columns).reshape(rows, columns)
    if both_ways:
        order[1::2] = order[1::2, ::-1]
    vectors = steered(along[:, None], across[None, :]).reshape(-1, 3)
    return BeamCycle(vectors, order.reshape(1, -1), rate)
