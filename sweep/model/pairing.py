"""Up, Doppler and down peaks put together into returns, and returns judged against the truth.

Each surface in a footprint leaves a peak in all three segments, and which belong together is not
written on them. A pair of an up and a down peak has 16 readings (each of the three peaks as it
stands or folded at Nyquist, half sum or half difference being the Doppler frequency), and each
reading predicts a Doppler peak; a pair is *confirmed* by a peak within the tolerance of that
prediction. Of all ways to pair up and down peaks one to one, that with the most confirmed pairs
is taken, and among those the least sum of mismatches, a fold counting as
:data:`sweep.model.waveform.FOLD_PENALTY` bins. A Doppler peak may confirm several pairs, as
surfaces with a common velocity share theirs.

Up and down peaks that are left over are paired in the order in which they are listed (strongest
first) and marked as unconfirmed: with the reading that comes nearest to any Doppler peak, or,
where there is none, **with the half sum as the Doppler frequency**, the order of a fast mover
(PHYSICS section 2 leaves both open): range and velocity are exchanged where that is wrong.

An up (or down) peak in which two surfaces coincide serves one return only.
"""

import math

import numpy as np
from numba import njit

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.readings import best_reading
from sweep.model.segments import SIGNS
from sweep.model.waveform import FOLD_PENALTY

TOLERANCE = 3.0
"""Default mismatch [bins] up to which a Doppler peak confirms a pair.

Rounding to bins moves the prediction and the Doppler peak by half a bin each, noise near the
threshold as much again. A peak anywhere confirms one of the 16 readings by chance with
16 (2 TOLERANCE) / (N/2) or less: 1.5e-3 at N = 2^17.
"""

_UNPAIRED = 1e9
"""Cost of an up peak without a down peak: more than any sum of mismatches."""

ASSUMED = 0
"""Reading without folds in which the half sum is the Doppler frequency."""

TRUE, FALSE_ALARM, MISPAIRED, MISREAD, SIDELOBE, UNCONFIRMED = 1, 2, 4, 8, 16, 32
FLAGS = {
    "true": TRUE,
    "false_alarm": FALSE_ALARM,
    "mispaired": MISPAIRED,
    "misread": MISREAD,
    "sidelobe": SIDELOBE,
    "unconfirmed": UNCONFIRMED,
}
"""Bits of a return's flags. Of the first five, which need the truth, exactly one is set:

true: its peaks hold a common beamlet, whose range and velocity it reports to within their width;
false alarm: one of its peaks is noise (or leaked signal lifted by noise); mispaired: its peaks
are signal, of no common beamlet; misread: a common beamlet, but the wrong one of the readings;
sidelobe: one of its peaks holds no beamlet's line. Unconfirmed, which the instrument knows: no
Doppler peak within the tolerance.
"""


@njit(cache=True, error_model="numpy")
def pair_peaks(up, doppler, down, at_start, fft_size, tolerance, pairs, work):
    """Pairs of peaks, one to one: confirmed ones first, in the order of the up peaks.

    Parameters
    ----------
    up, doppler, down : (any,) float64
        Positions of the peaks [bins], strongest first.
    at_start, fft_size, tolerance : float
        As of :func:`best_reading`; N; mismatch [bins] up to which a Doppler peak confirms a pair.
    pairs : (>= min(ups, downs), 4) int64
        Result: index of up, Doppler (-1 where unconfirmed) and down peak, and reading.
    work : tuple
        :func:`workspace`.

    Returns
    -------
    confirmed, number : int
        Confirmed pairs; all pairs.
    """
    cost, via, partner, sums = work
    for i in range(up.size):
        for j in range(down.size):
            cost[i, j] = _confirm(up[i], doppler, down[j], at_start, fft_size, tolerance, via[i, j])
    chosen = partner[0]
    _match(cost, up.size, down.size, partner, sums)
    number = 0
    for i in range(up.size):
        if chosen[i] >= 0:
            pairs[number, 0], pairs[number, 2] = i, chosen[i]
            pairs[number, 1], pairs[number, 3] = via[i, chosen[i]]
            number += 1
    confirmed = number
    j = -1
    for i in range(up.size):
        if chosen[i] < 0:
            j = _next_free(chosen[: up.size], j, down.size)
            if j == down.size:
                break
            _confirm(up[i], doppler, down[j], at_start, fft_size, np.inf, via[i, j])
            code = via[i, j, 1] if doppler.size else ASSUMED
            pairs[number, 0], pairs[number, 1], pairs[number, 2], pairs[number, 3] = i, -1, j, code
            number += 1
    return confirmed, number


@njit(cache=True, error_model="numpy")
def _confirm(up, doppler, down, at_start, fft_size, tolerance, via):
    """Least cost of a pair over all Doppler peaks; that peak and its reading into ``via``."""
    least = np.inf
    via[0], via[1] = -1, -1
    for k in range(doppler.size):
        code, cost = best_reading(up, doppler[k], down, at_start, fft_size, FOLD_PENALTY, tolerance)
        if cost < least:
            least, via[0], via[1] = cost, k, code
    return least


@njit(cache=True, error_model="numpy")
def _next_free(chosen, j, downs):
    """First down peak after j that no up peak has chosen; ``downs`` where none is left."""
    j += 1
    while j < downs:
        taken = False
        for i in range(chosen.size):
            taken |= chosen[i] == j
        if not taken:
            return j
        j += 1
    return downs


@njit(cache=True, error_model="numpy")
def _match(cost, ups, downs, partner, sums):
    """Partner of each up peak (or -1) in partner[0]: most pairs, then least cost.

    A search in depth over the pairs of finite cost, cut where it can't beat the best so far.
    """
    best, choice, used = partner[0], partner[1], partner[2]
    if ups == 0:
        return
    for j in range(downs):
        used[j] = 0
    level, least = 0, np.inf
    choice[0], sums[0] = -1, 0.0
    while level >= 0:
        j = choice[level]
        if 0 <= j < downs:
            used[j] = 0
        j = _next_open(cost, used, level, j, downs)
        if j > downs:
            level -= 1
            continue
        choice[level] = j
        sums[level + 1] = sums[level] + (cost[level, j] if j < downs else _UNPAIRED)
        if j < downs:
            used[j] = 1
        if sums[level + 1] >= least:
            continue
        if level + 1 < ups:
            level += 1
            choice[level] = -1
            continue
        least = sums[ups]
        for i in range(ups):
            best[i] = choice[i] if choice[i] < downs else -1


@njit(cache=True, error_model="numpy")
def _next_open(cost, used, level, j, downs):
    """Next down peak after j that may be paired with an up peak; ``downs`` means none."""
    j += 1
    while j < downs and (used[j] or not math.isfinite(cost[level, j])):
        j += 1
    return j


def workspace(peaks: int) -> tuple[np.ndarray, ...]:
    """Scratch of :func:`pair_peaks` for up to so many peaks in each segment."""
    return (
        np.empty((peaks, peaks)),
        np.empty((peaks, peaks, 2), np.int64),
        np.empty((3, peaks), np.int64),
        np.empty(peaks + 1),
    )


@njit(cache=True, error_model="numpy")
def common_beamlet(spans, centres, lines, amplitude):
    """Beamlet whose lines lie within all spans, next to the centres; whether spans hold any line.

    Parameters
    ----------
    spans : (3, 2) float64
        First and last bin of the peaks of the three segments; -inf to inf for one without.
    centres : (3,) float64
        Positions of the peaks [bins]; without meaning where there is none.
    lines : (3, b) float64
        Where each beamlet's line appears [bins].
    amplitude : (b,) float64
        Beamlets of amplitude 0 do not count.

    Returns
    -------
    beamlet : int
        -1 for none.
    filled : bool
        Whether each of the three spans holds a line.
    """
    found, nearest = -1, np.inf
    holds = 0
    for b in range(amplitude.size):
        if not amplitude[b] > 0.0:
            continue
        distance = 0.0
        for s in range(3):
            if spans[s, 0] - 1.0 <= lines[s, b] <= spans[s, 1] + 1.0:
                holds |= 1 << s
                if spans[s, 1] < np.inf:
                    distance += abs(lines[s, b] - centres[s])
            else:
                distance = np.inf
        if distance < nearest:
            found, nearest = b, distance
    return found, holds == 7


@njit(cache=True, error_model="numpy")
def beamlet_lines(p, fft_size, footprint, row, lines):
    """Where each beamlet's line appears in the three spectra [bins, 0..N/2], into lines (3, b).

    Parameters as of :func:`sweep.model.segments.segment_spectrum`.
    """
    rate = p[2] * (2.0 / SPEED_OF_LIGHT)
    offset, doppler = footprint[0][row], footprint[1][row]
    for s in range(3):
        carrier = p[9] if s == 2 else p[8]
        for b in range(offset.size):
            beta = p[1] + doppler[b]
            beat = carrier * beta - SIGNS[s] * rate * p[0] * (1.0 + offset[b]) * (1.0 + beta)
            lines[s, b] = abs(beat / p[6] - math.floor(beat / p[6] + 0.5)) * fft_size
