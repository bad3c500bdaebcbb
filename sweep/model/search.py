"""The search band: bins into which the ranges and radial velocities that are looked for put a beat.

A target of the band, range R0 .. R1 as a segment starts and velocity v0 .. v1, has its beat

    f_seg beta - s S (2 R / c) (1 + beta),    beta = 2 v / c

(:mod:`sweep.model.waveform`) between the least and the largest at the band's four corners, as it is
monotonic in R and in v. Searched are the bins nearest to all these beats, the outermost ones among
them. A real record folds the stretch: from 0 where it holds a whole multiple of the sample rate, up
to N/2 where it holds an odd multiple of half of it. In a complex record it goes round the circle of
signed bins.

An echo is in the band where its strongest bin is. It is then detected as without a band, by those
of its bins that are searched. Else it is not detected, and what it shows in searched bins is
leakage. Bins outside raise no alarm of any kind.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from sweep.model import waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection import echo_of, found_pair
from sweep.model.marcum import excess_crossing

SEARCH = "instrument.processing.search."
RANGES = SEARCH + "min_range", SEARCH + "max_range"
VELOCITIES = SEARCH + "min_radial_velocity", SEARCH + "max_radial_velocity"
ENDS = RANGES + VELOCITIES
"""Parameters of which a search band has all four."""


def band_of(p: Mapping[str, Any], points: int | None = None) -> np.ndarray | None:
    """First bin and number of bins that are searched, (3, 2, points) int64; None for all.

    By segment: up, Doppler, down. Bins are 0..N/2, of a complex record -N/2 .. N/2 - 1.

    Parameters
    ----------
    p : mapping
        Dotted path to SI scalar or array, of points that share their words and sizes; all or none
        of :data:`ENDS` [m; m/s, positive when closing].
    points : int, optional
        Number of points, where the values may be those of all; (3, 2, ...) without it.

    Examples
    --------
    >>> given = {
    ...     "instrument.receiver.architecture": "homodyne", "instrument.laser.wavelength": 1.55e-6,
    ...     "instrument.chirp.start_frequency": 0.0, "instrument.chirp.bandwidth": 1e9,
    ...     "instrument.chirp.duration": 1e-3, "instrument.processing.sample_rate": 100e6,
    ...     "instrument.processing.fft_size": 2**16,
    ... }
    >>> band = dict(zip(ENDS, (100.0, 200.0, -1.0, 1.0)))
    >>> [[int(v) for v in segment] for segment in band_of(given | band)]
    [[436, 1721], [0, 847], [436, 1721]]
    """
    if RANGES[0] not in p:
        return None
    slopes, carriers = waveform.slopes_of(p), waveform.carriers_of(p)
    size = int(np.max(p["instrument.processing.fft_size"]))
    width = p["instrument.processing.sample_rate"] / size
    rate = p["instrument.chirp.bandwidth"] / p["instrument.chirp.duration"]
    is_signed = str(p.get("instrument.receiver.record", "real")) == "complex"
    bands = []
    for slope, carrier in zip(slopes, carriers, strict=True):
        corners = [
            waveform.beat_frequency(
                slope, carrier=carrier, chirp_rate=rate, range=np.asarray(p[far], float),
                radial_velocity=np.asarray(p[fast], float),
            ) / width
            for far in RANGES for fast in VELOCITIES
        ]  # fmt: skip
        beats = np.array(np.broadcast_arrays(*corners))
        bands.append(_bins(beats.min(axis=0), beats.max(axis=0), size, is_signed))
    found = np.array(bands)
    return found if points is None else np.broadcast_to(found.T, (points, 2, 3)).T


def _bins(low: np.ndarray, high: np.ndarray, size: int, is_signed: bool) -> np.ndarray:
    """First bin and number of bins, (2, ...), nearest to beats from ``low`` to ``high`` [bins]."""
    if is_signed:
        first, last = np.floor(low + 0.5), np.floor(high + 0.5)
        first, number = (first + size // 2) % size - size // 2, np.minimum(last - first + 1, size)
        return np.array([first, number], np.int64)
    ends = waveform.fold(np.array([low, high]), np.asarray(float(size)))
    least = np.where(np.floor(high / size) * size >= low, 0.0, ends.min(axis=0))
    odd = (np.floor(high / size - 0.5) + 0.5) * size
    most = np.where(odd >= low, 0.5 * size, ends.max(axis=0))
    first, last = (np.minimum(np.floor(v + 0.5), size // 2) for v in (least, most))
    return np.array([first, last - first + 1], np.int64)


def number_of(band: np.ndarray, size: int, first: int, *, is_signed: bool) -> np.ndarray:
    """Count the bins of a band (3, 2, ...) that may raise an alarm, (3, ...).

    Of a real record those from ``first`` on, counted from DC and from Nyquist.
    """
    if is_signed:
        return band[:, 1].astype(float)
    low, high = np.maximum(band[:, 0], first), np.minimum(band.sum(axis=1) - 1, size // 2 - first)
    return np.maximum(high - low + 1.0, 0.0)


def is_searched(shots: Any, segment: int, i: int, bins: ArrayLike) -> np.ndarray:
    """Tell which bins of a segment of point i are searched."""
    if shots.band is None:
        return np.ones(np.shape(bins), bool)
    first, number = shots.band[segment, :, i]
    apart = np.asarray(bins) - first
    if shots.complex_record:
        apart %= shots.fft_size
    return np.asarray((apart >= 0) & (apart < number))


def cut(shots: Any, runs: Any) -> Any:
    """Cut runs of bins to the band: what is not searched neither detects nor raises an alarm.

    Of an echo whose strongest bin is not searched nothing is detected, but for other groups of
    bins about lines of its footprint; the magnitude stays that of its strongest bin.
    """
    if shots.band is None:
        return runs
    part, inside = runs.part, np.ones(runs.low.shape, np.bool_)
    numbers = np.array([runs.low, runs.bins, runs.peak, runs.exempted, runs.start])
    chances = np.array([runs.pd, runs.miss, runs.leakage])
    period = shots.fft_size if shots.complex_record else 0
    band = np.ascontiguousarray(shots.band[:, :, part])
    _find_outside(numbers, band, period, inside)
    lines = np.empty((part.size, 3, 0)) if inside.all() else beamlet_lines(shots)[part]
    each = shots.line_deviation, shots.threshold, shots.bin_deviation, shots.floor
    levels = np.array([np.broadcast_to(column, shots.size)[part] for column in each])
    leaks = np.array([shots.leakage and each.leaks for each in shots.waveform])
    where = band, period, lines, inside
    _cut(numbers, where, levels, (shots.echo_rule, leaks), runs.magnitudes, runs.exempt, chances)
    low, count, peak, exempted, start = numbers
    return runs._replace(
        low=low, bins=count, peak=peak, exempted=exempted, start=start, pd=chances[0],
        miss=chances[1], leakage=chances[2], inside=inside,
    )  # fmt: skip


def beamlet_lines(shots: Any) -> np.ndarray:
    """Places of each beamlet's line in the three spectra [bins, 0..N/2], (n, 3, beamlets).

    In spectra of complex records -N/2 .. N/2.
    """
    per_metre = columns(shots, shots.chirp_rate) * (2 / SPEED_OF_LIGHT)  # as a beat [Hz]
    distance = per_metre * columns(shots, shots.range), 1 + shots.offset[shots.row]
    own = shots.doppler[shots.row]
    lines = np.empty((shots.size, 3, own.shape[1]))
    for s, each in enumerate(shots.waveform):
        beta = columns(shots, each.beta) + own
        drifted = SPEED_OF_LIGHT / 2 * own * columns(shots, each.start)
        far = distance[0] * distance[1] - per_metre * (columns(shots, each.nearer) + drifted)
        beat = columns(shots, each.carrier) * beta - each.slope * far * (1 + beta)
        turns = beat / columns(shots, shots.sample_rate)
        lines[:, s] = (turns - np.floor(turns + 0.5)) * shots.fft_size
    return lines if shots.complex_record else abs(lines)


def columns(shots: Any, values: np.ndarray | float, dims: int = 1) -> np.ndarray:
    """One value a point, with so many dimensions behind it."""
    return np.broadcast_to(values, shots.size).reshape(-1, *[1] * dims)


@njit(cache=True, error_model="numpy")
def _is_in(bin_, band, period):
    """Return true for a bin of the band (2,): first, number; ``period`` N of complex records."""
    apart = bin_ - band[0]
    if period > 0:
        apart %= period
    return 0 <= apart < band[1]


@njit(cache=True, error_model="numpy")
def _find_outside(numbers, band, period, inside):
    """Unmark the runs whose largest bin is not searched."""
    low, count, peak, _, _ = numbers
    for s in range(low.shape[0]):
        for j in range(low.shape[1]):
            if count[s, j] > 0:
                inside[s, j] = _is_in(low[s, j] + peak[s, j], band[s, :, j], period)


@njit(cache=True, nogil=True, error_model="numpy")
def _cut(numbers, where, levels, how, magnitudes, exempts, chances):
    """Cut runs to the band, in place.

    Parameters
    ----------
    numbers : (5, segments, m) int64
        Low, count, peak, exempted and start of each run.
    where : tuple
        Band (3, 2, m), N of complex records or 0, places of lines (m, 3, beamlets), and runs whose
        largest bin is searched (3, m).
    levels : (4, m) float64
        Noise under lines, threshold, noise of other bins, floor of leakage over that.
    how : tuple
        :attr:`sweep.model.preparation.Shots.echo_rule`; segments (3,) whose leakage is looked at.
    magnitudes, exempts : ndarray
        Of all runs.
    chances : (3, segments, m) float64
        pd, miss and leakage.
    """
    (band, period, lines, inside), (rule, leaks) = where, how
    low, count, peak, exempted, start = numbers
    for s in range(low.shape[0]):
        for j in range(low.shape[1]):
            first, last = count[s, j], -1
            searched = 0
            at, begun = low[s, j], start[s, j]
            for k in range(count[s, j]):
                if _is_in(at + k, band[s, :, j], period):
                    first, last, searched = min(first, k), k, searched + 1
            if searched == count[s, j]:
                continue
            run = magnitudes[begun : begun + count[s, j]]
            exempt = exempts[begun : begun + count[s, j]]
            if not inside[s, j]:
                exempt[:] = False
                if levels[1, j] <= run[peak[s, j]]:
                    _keep_echoes(
                        run, exempt, at, levels[1, j], rule[1], (band[s, :, j], period),
                        lines[j, s],
                    )  # fmt: skip
            best = first
            for k in range(first, last + 1):
                if not _is_in(at + k, band[s, :, j], period):  # between both ends of the band
                    run[k], exempt[k] = 0.0, False
                best = k if run[k] > run[best] else best
            low[s, j], start[s, j], count[s, j] = at + first, begun + first, last + 1 - first
            if last < 0:
                low[s, j], start[s, j], count[s, j] = at, begun, 0
            run, exempt = run[first : last + 1], exempt[first : last + 1]
            peak[s, j] = peak[s, j] - first if inside[s, j] else max(best - first, 0)
            exempted[s, j] = exempt.sum()
            chances[0, s, j], chances[1, s, j] = 0.0, 1.0
            if inside[s, j]:
                chances[0, s, j], chances[1, s, j] = found_pair(
                    run, exempt, peak[s, j], low[s, j], rule, (levels[0, j], levels[1, j])
                )
            if leaks[s]:
                chances[2, s, j] = _leakage(run, exempt, levels[1:, j])


@njit(cache=True, error_model="numpy")
def _keep_echoes(run, exempt, low, level, beside, band, lines):
    """Mark the bins of groups about lines whose largest bin is searched, and those beside them."""
    at, period = 0, band[1]
    while at < run.size:
        if run[at] < level:
            at += 1
            continue
        first = best = at
        while at < run.size and run[at] >= level:
            best = at if run[at] > run[best] else best
            at += 1
        holds = False
        for line in lines:
            apart = line - (low + first - 1)
            if period > 0:
                apart -= period * math.floor(apart / period)
            holds |= 0.0 <= apart <= at - first + 1
        if holds and _is_in(low + best, band[0], period):
            begin, end = echo_of(run, first, at - 1, level, beside)
            exempt[max(min(begin, first - 1), 0) : max(end, at) + 1] = True


@njit(cache=True, error_model="numpy")
def _leakage(run, exempt, levels):
    """Chance that any bin of a run that is not exempt adds a crossing to that of noise."""
    level, sigma, floor = levels
    b, any_ = level / sigma, 0.0
    stays = -math.expm1(-0.5 * b * b)
    for k in range(run.size):
        if not exempt[k] and run[k] >= floor * sigma and run[k] > 0.0:
            any_ += excess_crossing(run[k] / sigma, b) / stays * (1.0 - any_)
    return any_
