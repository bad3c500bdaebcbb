"""Random draws of shots: detections and false alarms counted, batch by batch.

Two ways that agree in the mean. ``probabilities`` is [T 3.3.2]'s: uniform numbers against pd and
the probability of a false alarm (noise and leakage together). ``noise`` adds complex Gaussian
noise to the bins that hold signal and looks; over the other bins, which hold noise alone, the
largest magnitude is drawn exactly from its order statistic. Both take the bins' noise as
independent, as the closed forms do. Where effects are random, each draw has a spectrum and
probabilities of its own, and its noise with them: see :mod:`sweep.model.sampling`, which also says
when to stop.

Every number is addressed by point, draw, cause and index (:mod:`sweep.model.philox`).
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numba import njit

from sweep.model import philox
from sweep.model.marcum import at_least_one
from sweep.model.philox import (
    STREAM_DETECTION,
    STREAM_FALSE_ALARM,
    STREAM_NOISE,
    STREAM_NOISE_MAXIMUM,
)
from sweep.model.preparation import Shots
from sweep.model.segments import runs_of

METHODS = ("probabilities", "noise")

_AT_ONCE = 256
"""Draws of a row whose random numbers are made together."""


class Rows(NamedTuple):
    """Spectra, (m,) each, that a stretch of draws is taken of."""

    point: np.ndarray
    """int64: the point whose counts they add to."""
    keys: np.ndarray
    """(m, 2) uint64: random key of that point."""
    first: np.ndarray
    """int64: number of the first draw."""
    last: np.ndarray
    """int64: number after the last."""


def is_noisy(method: str) -> bool:
    """Whether a way to draw adds noise.

    Raises
    ------
    ValueError
        There is no way to draw of that name.
    """
    if method not in METHODS:
        raise ValueError(f"no way to draw called {method!r}: choose from {', '.join(METHODS)}")
    return method == "noise"


def count_by_chance(
    rows: Rows, ends: np.ndarray, outputs: Mapping[str, np.ndarray], counts: np.ndarray
) -> None:
    """Add the draws of some rows, held against their outputs, to the counts.

    ``ends`` (batches + 1,) are the numbers of draws between batches; the counts, int64, are (names,
    points, batches) in the order of :data:`sweep.model.outputs.DRAW_OUTPUTS`.
    """
    size, chances = rows.point.size, np.array(_chances(outputs))
    _count(rows, ends, np.zeros((2, size)), chances, False, Seen.nothing(size), counts)


def count_in_noise(rows: Rows, ends: np.ndarray, shots: Shots, counts: np.ndarray) -> None:
    """Add the draws of some rows, in the noise of their shots, as :func:`count_by_chance` does."""
    levels = noise_levels(shots)
    one = np.exp(-0.5 * levels[0] ** 2)
    for part, seen in seen_spectra(shots):
        others = at_least_one(one[part], seen.others.T)
        chances = np.array([np.zeros_like(others), others])  # in C order
        some = Rows(*(column[part] for column in rows))
        _count(some, ends, levels[:, part].copy(), chances, True, seen, counts)


def _chances(outputs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities of detection and of a false alarm by segment (up, Doppler, down), (3, n)."""
    found = np.stack([outputs["pd_up"], outputs["pd_doppler"], outputs["pd_down"]])
    noise_up = outputs["pfa_segment"]
    both, one = outputs["log10_pfa_shot"], outputs["log10_pfa_segment"]
    some = np.isfinite(one)  # else the detection occupies every bin
    noise_down = np.where(some, 10 ** (both - np.where(some, one, 0.0)), 0.0)
    up = 1 - (1 - noise_up) * (1 - outputs["p_leakage_up"])
    down = 1 - (1 - noise_down) * (1 - outputs["p_leakage_down"])
    return np.nan_to_num(found), np.stack([up, np.zeros_like(up), down])


def noise_levels(shots: Shots) -> np.ndarray:
    """Threshold and noise under the lines, over the noise of any other bin, (2, n)."""
    levels = np.stack([shots.threshold, shots.line_deviation]) / shots.bin_deviation
    return np.ascontiguousarray(np.broadcast_to(levels, (2, shots.size)))


class Seen(NamedTuple):
    """What spectra without noise hold, by point and segment (m, 3), for noise to be added to."""

    low: np.ndarray
    """int64: first of the bins that hold signal, from which they are numbered."""
    peak: np.ndarray
    """int64: number of the largest."""
    ratio: np.ndarray
    """Its |X| / sigma; nan for a segment that does not exist."""
    others: np.ndarray
    """Bins that count for false alarms and hold noise alone."""
    stretch: np.ndarray
    """(m, 3, 2) int64: first of the bins below, and after the last; none without leakage."""
    aside: np.ndarray
    """int64: numbers of bins of leaked signal, that may raise a false alarm by themselves."""
    leaked: np.ndarray
    """|X| / sigma of them."""

    @classmethod
    def nothing(cls, points: int) -> "Seen":
        """No spectra, for what is drawn against probabilities."""
        low, stretch = np.zeros((points, 3), np.int64), np.zeros((points, 3, 2), np.int64)
        none, others = np.full((points, 3), np.nan), np.zeros((points, 3))
        return cls(low, low, none, others, stretch, np.empty(0, np.int64), np.empty(0))


def seen_spectra(shots: Shots) -> Iterator[tuple[np.ndarray, Seen]]:
    """Points of some shots, and their spectra; as many at once as memory holds."""
    sigma = shots.bin_deviation
    # Without leakage none but the peak is looked at.
    floor = shots.floor + np.zeros(shots.size) if shots.leakage else np.full(shots.size, np.inf)
    for runs in runs_of(shots, least=np.minimum(shots.threshold, floor * sigma), leakage=False):
        count, start, peak = (c.T.ravel() for c in (runs.bins, runs.start, runs.peak))
        run = np.repeat(np.arange(count.size), count)  # of each bin, point by point
        number = np.arange(run.size) - (np.cumsum(count) - count)[run]
        at, point = start[run] + number, runs.part[run // 3]
        ratio = runs.magnitudes[at] / sigma[point]
        leaks = (ratio >= floor[point]) & (number != peak[run]) & ~runs.exempt[at]
        leaking = np.bincount(run[leaks], minlength=count.size).reshape(-1, 3)
        after = np.cumsum(leaking).reshape(-1, 3)
        there = runs.bins.T > 0
        others = shots.counted_bins(np.where(there, runs.exempted.T, 0.0)) - leaking
        seen = Seen(
            low=np.where(there, runs.low.T, 0),
            peak=np.where(there, runs.peak.T, 0),
            ratio=np.where(there, runs.magnitude.T / sigma[runs.part, None], np.nan),
            others=np.maximum(others, 0.0),
            stretch=np.stack([after - leaking, after], axis=2),
            aside=number[leaks],
            leaked=ratio[leaks],
        )
        # In C order as those of `nothing`: numba compiles anew for each order.
        yield runs.part, Seen(*map(np.ascontiguousarray, seen))


@njit(cache=True, nogil=True, error_model="numpy")
def _count(rows, ends, levels, chances, noisy, seen, counts):
    """Add the draws of each row to the counts.

    ``levels`` (2, m) are threshold and noise under the lines, over the noise of any other bin;
    ``chances`` (2, 3, m) those of a detection, of no meaning in noise, and of a false alarm in
    bins that are not looked at one by one.
    """
    words = np.empty((4, _AT_ONCE), np.uint64)
    hits, alarms = np.empty((2, 3, _AT_ONCE), np.bool_)
    for j in range(rows.point.size):
        threshold, under_lines = levels[0, j] * levels[0, j], levels[1, j]
        i, batch = rows.point[j], 0
        for first in range(rows.first[j], rows.last[j], _AT_ONCE):
            number = min(_AT_ONCE, rows.last[j] - first)
            address = rows.keys[j, 0], rows.keys[j, 1], first, number
            hits[:], alarms[:] = False, False
            for s in range(3):
                stream, ratio, peak = STREAM_NOISE[s], seen.ratio[j, s], seen.peak[j, s]
                if noisy:
                    _cross(address, stream, peak, ratio, under_lines, threshold, words, hits[s])
                else:
                    _happen(address, STREAM_DETECTION[s], chances[0, s, j], words, hits[s])
                if chances[1, s, j] > 0.0:
                    largest = STREAM_NOISE_MAXIMUM[s] if noisy else STREAM_FALSE_ALARM[s]
                    _happen(address, largest, chances[1, s, j], words, alarms[s])
                for k in range(seen.stretch[j, s, 0], seen.stretch[j, s, 1]):
                    leaked = seen.leaked[k]
                    _cross(address, stream, seen.aside[k], leaked, 1.0, threshold, words, alarms[s])
            for d in range(number):
                while first + d >= ends[batch + 1]:
                    batch += 1
                counts[0, i, batch] += hits[0, d]
                counts[1, i, batch] += hits[2, d]
                counts[2, i, batch] += hits[1, d]
                counts[3, i, batch] += hits[0, d] & hits[2, d]
                counts[4, i, batch] += alarms[0, d]
                counts[5, i, batch] += alarms[2, d]
                counts[6, i, batch] += alarms[0, d] & alarms[2, d]


@njit(cache=True, error_model="numpy")
def _happen(address, stream, chance, words, found):
    """Mark the draws (key, first, number) in which something of that chance happens."""
    philox.fill_words(address[:3], stream, philox.FIRST_BLOCK, philox.BY_DRAW, address[3], words)
    for d in range(address[3]):
        found[d] |= philox.to_uniform(words[0, d]) < chance


@njit(cache=True, error_model="numpy")
def _cross(address, stream, index, ratio, deviation, threshold, words, found):
    """Mark the draws in which a bin of that |X| / sigma, with its noise, reaches the threshold.

    The threshold is a power; the noise, of that deviation, is pair `index` of the stream.
    """
    philox.fill_words(address[:3], stream, index >> 1, philox.BY_DRAW, address[3], words)
    lane = 2 * (index & 1)
    for d in range(address[3]):
        re, im = philox.to_normals(words[lane, d], words[lane + 1, d])
        re, im = ratio + re * deviation, im * deviation
        found[d] |= re**2 + im**2 >= threshold
