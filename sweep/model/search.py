"""Runs of bins and beamlets' lines in a search band (:mod:`sweep.model.band`)."""

import math
from typing import Any

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.crossings import any_crossing, leave_out_joined
from sweep.model.detection import echo_of, found_pair, levels_of, speckle_of
from sweep.model.marcum import excess_crossing


def cut(shots: Any, runs: Any) -> Any:
    """Cut runs of bins to the band: what is not searched neither detects nor raises an alarm.

    Of an echo whose strongest bin is not searched nothing is detected, but for other groups of
    bins about lines of its footprint; the magnitude stays that of its strongest bin.
    """
    if shots.band is None:
        return runs
    part = runs.part
    numbers = np.array([runs.low, runs.bins, runs.peak, runs.exempted, runs.start])
    chances = np.array([runs.pd, runs.miss, runs.leakage])
    period = shots.fft_size if shots.complex_record else 0
    band = np.ascontiguousarray(shots.band[:, :, part])
    apart = runs.low + runs.peak - band[:, 0]
    apart = apart % period if period else apart
    inside = (runs.bins == 0) | ((apart >= 0) & (apart < band[:, 1]))
    lines = np.empty((part.size, 3, 0)) if inside.all() else beamlet_lines(shots)[part]
    floor = np.broadcast_to(shots.floor, shots.size)[part]
    levels = np.concatenate([shots.bin_levels[:, part], floor[None]])
    leaks = np.array([shots.leakage and each.leaks for each in shots.waveform])
    where = band, period, lines, inside
    speckle = part, shots.speckle_table
    _cut(
        numbers, where, levels, (shots.echo_rule, leaks), speckle, runs.magnitudes, runs.exempt,
        chances,
    )  # fmt: skip
    low, count, peak, exempted, start = numbers
    return runs._replace(
        low=low, bins=count, peak=peak, exempted=exempted, start=start, pd=chances[0],
        miss=chances[1], leakage=chances[2], inside=inside,
    )  # fmt: skip


def beamlet_lines(shots: Any, points: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Places of each beamlet's line in the three spectra [bins, 0..N/2], (m, 3, beamlets).

    In spectra of complex records -N/2 .. N/2. Lines that drift within the record, by range walk and
    acceleration, lie where they are at its middle.
    """

    def column(values: np.ndarray | float) -> np.ndarray:
        return columns(shots, values)[points]

    per_metre = column(shots.chirp_rate) * (2 / SPEED_OF_LIGHT)  # as a beat [Hz]
    distance = per_metre * column(shots.range), 1 + shots.offset[shots.row[points]]
    own = shots.doppler[shots.row[points]]
    lines = np.empty((own.shape[0], 3, own.shape[1]))
    for s, each in enumerate(shots.waveform):
        beta = column(each.beta) + own
        drifted = SPEED_OF_LIGHT / 2 * own * column(each.start)
        far = distance[0] * distance[1] - per_metre * (column(each.nearer) + drifted)
        beat = column(each.carrier) * beta - each.slope * far * (1 + beta)
        beat += column(shots.drifts[s])
        lines[:, s] = _folded(shots, beat / column(shots.sample_rate))
    return lines


def middle_lines(shots: Any, points: np.ndarray, strongest: np.ndarray) -> np.ndarray:
    """Mean places of the beamlets' lines, weighted by power, (m, 3) [bins].

    Next to the ``strongest`` bins (m, 3) of complex records, whose bins may be numbered from
    anywhere on.
    """
    apart = beamlet_lines(shots, points) - strongest[..., None]
    if shots.complex_record:
        apart -= shots.fft_size * np.rint(apart / shots.fft_size)
    power = shots.amplitude[shots.row[points]][:, None] ** 2
    return np.asarray(strongest + (power * apart).sum(axis=-1) / power.sum(axis=-1))


def centre_lines(shots: Any) -> np.ndarray:
    """Places of the lines on the beam's axis, as of :func:`beamlet_lines`, (segments, n)."""
    turns = [
        (beat + drift) / shots.sample_rate
        for beat, drift in zip(shots.beats, shots.drifts, strict=True)
    ]
    return np.array([np.broadcast_to(_folded(shots, turn), shots.size) for turn in turns])


def _folded(shots: Any, turns: np.ndarray) -> np.ndarray:
    """Places [bins] in a spectrum at which lines of a frequency over the sample rate are seen."""
    places = (turns - np.floor(turns + 0.5)) * shots.fft_size
    return np.asarray(places if shots.complex_record else abs(places))


def columns(shots: Any, values: np.ndarray | float, dims: int = 1) -> np.ndarray:
    """One value a point, with so many dimensions behind it."""
    return np.broadcast_to(values, shots.size).reshape(-1, *[1] * dims)


@njit(cache=True, error_model="numpy", borrows=True)
def _is_in(bin_, band, period):
    """Return true for a bin of the band (2,): first, number; ``period`` N of complex records."""
    apart = bin_ - band[0]
    if period > 0:
        apart %= period
    return 0 <= apart < band[1]


@njit(cache=True, nogil=True, error_model="numpy")
def _cut(numbers, where, levels, how, speckle, magnitudes, exempts, chances):
    """Cut runs to the band, in place.

    ``numbers`` (5, segments, m) are low, count, peak, exempted and start of runs; ``where`` the
    band (3, 2, m), N of complex records or 0, places of lines (m, 3, beamlets), and whether a run's
    largest bin is searched; ``levels`` (8, m) those of :class:`sweep.model.detection.BinLevels`,
    and the floor of leakage over the noise; ``how`` the rule of detection and segments whose
    leakage is looked at; ``speckle`` points (m,) and the speckle of all; ``chances`` (3, segments,
    m) pd, miss and leakage.
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
                    beside = max(rule.beside, int(levels[4, j]))
                    _keep_echoes(
                        run, exempt, at, levels[1, j], beside, (band[s, :, j], period), lines[j, s]
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
                    run, exempt, peak[s, j], low[s, j], rule, levels_of(levels, j),
                    speckle_of(speckle[1], s, speckle[0][j]),
                )  # fmt: skip
            if leaks[s]:
                chances[2, s, j] = leakage_of(
                    run, exempt, (levels[1, j], levels[2, j], levels[7, j]), levels[1, j],
                    rule.sidelobe_correlation,
                )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _keep_echoes(run, exempt, low, level, beside, band, lines):
    """Mark the bins of groups about lines whose largest bin is searched, and those beside them."""
    at, period = 0, band[1]
    while at < run.size:
        if not run[at] >= level:  # true of nan too, which would end no loop
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
def leakage_of(run, exempt, levels, threshold, correlation):
    """Return the probability that leaked signal in a run raises a further group to a level.

    Parameters
    ----------
    run, exempt
        |X| of its bins, and whether they are of an echo.
    levels
        Level, noise per quadrature sigma, and lowest |X| / sigma that is looked at.
    threshold
        Threshold on |X|, which groups hang together by.
    correlation
        Correlation of neighbours' noise in phase with the signal.
    """
    level, sigma, floor = levels
    b, chances = level / sigma, np.zeros(run.size)
    stays = -math.expm1(-0.5 * b * b)
    for k in range(run.size):
        if not exempt[k] and run[k] >= floor * sigma and run[k] > 0.0:
            chances[k] = excess_crossing(run[k] / sigma, b) / stays
    leave_out_joined(chances, 0, run.size, run, exempt, (sigma, threshold), correlation)
    return any_crossing(chances, 0, run.size)
