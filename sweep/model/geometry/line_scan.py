"""Beams swept side to side by a mirror."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sweep.model.geometry.scanner import Shots, shots_begun


@dataclass(frozen=True)
class LineScan:
    """Beams side by side along the track, swept together from side to side.

    Parameters
    ----------
    half_angle : float
        Reach of the sweep to each side of nadir [rad], 0 <= . < pi/2.
    line_rate : float
        Lines a second [Hz]; a sweep one way is a line.
    rate : float
        Measurements a second of each beam [Hz].
    along : tuple of float
        Each beam's fixed angle from nadir towards forward [rad].
    wave : str
        ``triangle`` at a constant rate, or ``sine`` for a resonant mirror.
    interval : float
        Time from one beam of a measurement to the next [s]; 0 fires them at once.
    """

    half_angle: float
    line_rate: float
    rate: float
    along: tuple[float, ...] = (0.0,)
    wave: str = "triangle"
    interval: float = 0.0

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
        return int(self._begun(np.array([duration]))[0])

    def _begun(self, t: np.ndarray) -> np.ndarray:
        return shots_begun(t, rate=self.rate, each=self.beams, interval=self.interval)

    def shots(self, index: np.ndarray) -> Shots:
        """Shots by number (n,), from 0; a cycle is one measurement of all beams."""
        cycle, beam = np.divmod(np.asarray(index, np.int64), self.beams)
        time = cycle / self.rate + beam * self.interval
        return Shots(time, beam, cycle, self._pointing(time, beam))

    def across(self, t: np.ndarray) -> np.ndarray:
        """Angle of the sweep from nadir towards the left [rad]; it starts at the right."""
        lines = np.asarray(t, float) * self.line_rate
        if self.wave == "sine":
            return np.asarray(-self.half_angle * np.cos(math.pi * lines))
        return np.asarray(self.half_angle * (1 - 2 * np.abs(1 - lines % 2)))

    def _pointing(self, t: np.ndarray, beam: np.ndarray) -> np.ndarray:
        along, across = np.asarray(self.along)[beam], self.across(t)
        # The mirror turns the fan of beams about x: each keeps its angle towards forward.
        level = np.cos(along)
        return np.column_stack([np.sin(along), level * np.sin(across), -level * np.cos(across)])
