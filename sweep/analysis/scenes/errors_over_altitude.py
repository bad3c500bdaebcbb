"""Errors of navigation by altitude: how often there is a solution, its bias and its scatter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import xarray as xr

from sweep.analysis.scenes.opening import chunk, stretches
from sweep.analysis.scenes.recording import Recording
from sweep.model.navigation import EXCLUDED, SOLVED
from sweep.model.navigation_tally import Tally, merge, tally

VELOCITY, ALTITUDE = "velocity", "altitude"

STRETCH = 65_536
"""Solutions that are read at a time, about."""


@dataclass(frozen=True)
class Curve:
    """Errors of one scanner's solutions, by bins of true altitude.

    Attributes
    ----------
    scanner, words : str
        Its name, and what else tells the curve from others.
    edges : (bins + 1,) ndarray
        Altitudes between the bins [m], rising.
    tally : Tally
        Errors by bin, of three components or one.
    """

    scanner: str
    edges: np.ndarray
    tally: Tally

    @property
    def middle(self) -> np.ndarray:
        """Altitudes in the middle of the bins [m]."""
        return (self.edges[1:] + self.edges[:-1]) / 2

    @property
    def bias(self) -> np.ndarray:
        """Mean error of each component, (bins, m)."""
        return self.tally.bias

    @property
    def bias_error(self) -> np.ndarray:
        """Standard error of the bias (bins, m); nan with fewer than two solutions."""
        variance = np.diagonal(self.tally.covariance, axis1=-2, axis2=-1)
        return np.sqrt(variance / np.maximum(self.tally.count, 1)[:, None])

    @property
    def rmse(self) -> np.ndarray:
        """Root mean square error of each component and of the vector's length, (bins, m [+ 1])."""
        return _with_length(self.tally.rmse)

    @property
    def predicted(self) -> np.ndarray:
        """Standard deviation that solutions state of themselves, as `rmse`: root of the mean."""
        variance = np.diagonal(self.tally.predicted_covariance, axis1=-2, axis2=-1)
        return _with_length(np.sqrt(variance))


def _with_length(parts: np.ndarray) -> np.ndarray:
    """Components (..., m), and of vectors the root of the sum of their squares after them."""
    if parts.shape[-1] == 1:
        return parts
    return np.concatenate([parts, np.linalg.norm(parts, axis=-1, keepdims=True)], axis=-1)


def navigates(recording: Recording) -> bool:
    """Whether a scanner has solutions: its cycles have three shots or more."""
    return "velocity_status" in recording.dataset


def curves(recordings: Sequence[Recording], *, quantity: str, bins: int) -> list[Curve]:
    """Errors of scanners that navigate, all over the same bins of altitude.

    Solutions are read chunk by chunk; each stretch has a tally of its own, and the tallies are
    merged in the order of the stretches, so that the result is the same to the last bit.

    Parameters
    ----------
    recordings
        What the scanners recorded.
    quantity
        ``velocity`` or ``altitude``.
    bins
        Number of bins, of one width, from the lowest altitude to the highest.
    """
    able = [recording for recording in recordings if navigates(recording)]
    edges = _edges(able, bins)
    if edges is None:
        return []
    return [
        Curve(recording.scanner, edges, merge(list(_tallies(recording.dataset, quantity, edges))))
        for recording in able
    ]


def _edges(recordings: Sequence[Recording], bins: int) -> np.ndarray | None:
    """Edges of the bins; none where no cycle's altitude is known."""
    lows, highs = [], []
    for recording in recordings:
        altitude = recording.dataset["true_altitude"]
        for part in stretches(altitude, "cycle", STRETCH):
            known = np.asarray(altitude.isel(cycle=part).values)
            known = known[np.isfinite(known)]
            if known.size:
                lows.append(float(known.min()))
                highs.append(float(known.max()))
    if not lows:
        return None
    low, high = min(lows), max(highs)
    if high - low < 1e-6 * max(abs(high), 1.0):
        low, high, bins = low - 0.5, high + 0.5, 1
    edges = np.linspace(low, high, bins + 1)
    edges[-1] = np.nextafter(high, np.inf)  # the highest cycle is in the last bin
    return edges


def _tallies(dataset: xr.Dataset, quantity: str, edges: np.ndarray) -> Iterator[Tally]:
    status = dataset[f"{quantity}_status"]
    draws_a_chunk = chunk(status, "draw")
    draws = stretches(status, "draw", draws_a_chunk)
    cycles = stretches(status, "cycle", max(1, STRETCH // draws_a_chunk))
    for cycle, draw in product(cycles, draws):
        part = dataset.isel(cycle=cycle, draw=draw)
        solved, error, covariance = _errors(part, quantity)
        altitude = np.broadcast_to(np.asarray(part["true_altitude"].values)[:, None], solved.shape)
        computed = np.asarray(part[f"{quantity}_status"].values).ravel() >= SOLVED
        cell = np.digitize(np.nan_to_num(altitude.ravel(), nan=-np.inf), edges) - 1
        yield tally(
            error, covariance, available=solved.ravel(), cells=[np.where(computed, cell, -1)],
            shape=[edges.size - 1],
        )  # fmt: skip


def _errors(part: xr.Dataset, quantity: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether there is a solution (cycles, draws); its error (n, m) and covariance (n, m, m)."""
    status = np.asarray(part[f"{quantity}_status"].values)
    solved = (status >= SOLVED) & (status <= EXCLUDED)
    found, true = (np.asarray(part[n].values) for n in (quantity, f"true_{quantity}"))
    error = found - true[:, None]
    stated = "velocity_covariance" if quantity == VELOCITY else "altitude_variance"
    size = 3 if quantity == VELOCITY else 1
    return solved, error.reshape(-1, size), np.asarray(part[stated].values).reshape(-1, size, size)
