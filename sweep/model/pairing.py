"""Up, Doppler and down peaks put together into returns, and returns judged against the truth.

Each surface in a footprint leaves a peak in all three segments, and which belong together is not
written on them. A pair of an up and a down peak has 16 readings (each of the three peaks as it
stands or folded at Nyquist, half sum or half difference being the Doppler frequency). Each reading
predicts a Doppler peak. A pair is *confirmed* by a peak within the tolerance of that prediction. Of
all ways to pair up and down peaks one to one, that with the most confirmed pairs is taken, and
among those the least sum of mismatches, a fold counting as
:data:`sweep.model.waveform.FOLD_PENALTY` bins. A Doppler peak may confirm several pairs, as
surfaces with a common velocity share theirs.

Up and down peaks that are left over are paired in the order in which they are listed (strongest
first) and marked as unconfirmed. A Doppler peak that is nearer to one of their readings than a
false one is, but once in a hundred times, still tells which to take. Else nothing does, and they
take the reading that two beats have without a Doppler segment. PHYSICS section 2 leaves it open.
Range and velocity are exchanged where that is wrong.

An up (or down) peak in which two surfaces coincide serves one return only.

An instrument that accelerates closes at another speed in each segment. With the default slopes this
cancels in the half sum, as the Doppler segment is in the middle; with others it does not, and the
tolerance is wider by what the instrument knows of it.

Complex records keep their beats' signs: there is the one reading
:data:`sweep.model.waveform.SIGNED`, and each surface's Doppler peak confirms it. Segments of other
slopes are paired alike, by the Doppler beat that an up and a down beat predict; readings of a pair
that is found are left to :func:`sweep.model.waveform.fit`.

Without a Doppler segment nothing tells which peaks belong together, and none is unconfirmed: the
strongest up peak goes with the strongest down peak, and so on, by the reading
:data:`sweep.model.waveform.FAR`, FAST or SIGNED.
"""

import math

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.groups import FIRST, LAST
from sweep.model.waveform import BELOW, FOLD_PENALTY, READINGS, SIGNED

TOLERANCE = 3.0
"""Default mismatch [bins] up to which a Doppler peak confirms a pair.

Rounding to bins moves the prediction and the Doppler peak by half a bin each, noise near the
threshold as much again. A peak anywhere confirms one of the 16 readings at random with
16 (2 TOLERANCE) / (N/2) or less: 1.5e-3 at N = 2^17.
"""

NEAR_BY_CHANCE = 0.01
"""Probability with which a false Doppler peak is as near to a reading as one that tells which."""

_UNPAIRED = 1e9
"""Cost of an up peak without a down peak: more than any sum of mismatches."""

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


FALSE, ABSENT = -1, -2
"""In place of a peak's group: a false peak; no Doppler peak, or no Doppler segment."""


@njit(cache=True, error_model="numpy")
def pair_peaks(up, doppler, down, third, fft_size, signed, assumed, tolerance, pairs):
    """Pairs of peaks, one to one: confirmed ones first, in the order of the up peaks.

    Peaks are positions [bins], strongest first, with signs if ``signed``; the rest as of
    :func:`confirm`. ``assumed`` is the reading of pairs that are not confirmed. ``pairs`` (>=
    min(ups, downs), 4) int64 takes the index of up, Doppler (-1 where unconfirmed) and down peak,
    and the reading. Returns the numbers of confirmed pairs, and of all.
    """
    if up.size == 1 and down.size == 1:  # the pair that most shots have
        mismatch, peak, code = confirm(up[0], doppler, down[0], third, fft_size, signed, tolerance)
        if math.isfinite(mismatch):
            pairs[0, 0], pairs[0, 1], pairs[0, 2], pairs[0, 3] = 0, peak, 0, code
            return 1, 1
    cost, via = np.empty((up.size, down.size)), np.empty((up.size, down.size, 2), np.int64)
    for i in range(up.size):
        for j in range(down.size):
            cost[i, j], via[i, j, 0], via[i, j, 1] = confirm(
                up[i], doppler, down[j], third, fft_size, signed, tolerance
            )
    chosen, used = _match(cost)
    number = 0
    for i in range(up.size):
        j = chosen[i]
        if j >= 0:
            pairs[number, 0], pairs[number, 2] = i, j
            pairs[number, 1], pairs[number, 3] = via[i, j, 0], via[i, j, 1]
            number += 1
    confirmed, j = number, 0
    for i in range(up.size):
        while j < down.size and used[j]:
            j += 1
        if chosen[i] < 0 and j < down.size:
            readings = 1 if signed else READINGS
            near = NEAR_BY_CHANCE * fft_size / (4.0 * readings)
            _, _, code = confirm(up[i], doppler, down[j], third, fft_size, signed, near)
            pairs[number, 0], pairs[number, 1], pairs[number, 2] = i, -1, j
            pairs[number, 3] = code if code >= 0 else assumed
            number, j = number + 1, j + 1
    return confirmed, number


@njit(cache=True, error_model="numpy", borrows=True)
def confirm(up, doppler, down, third, fft_size, signed, tolerance):
    """Doppler peak and reading of an up and a down peak that fit best, within a tolerance [bins].

    ``third`` (3,) is the share of up and of down beat in the Doppler segment's, and what the
    instrument's motion between the segments moves that by [bins], which adds to the tolerance.
    ``signed``, of complex records, is 1 where the down beat rises against the up beat as the range
    does, -1 where it falls; 0 of real records. Returns mismatch and penalties [bins], inf where
    none comes within the tolerance; the Doppler peak and the reading, -1 for none.
    """
    least, peak, best = np.inf, -1, -1
    tolerance += third[2]
    for k in range(doppler.size):
        for code in range(SIGNED if signed else 0, SIGNED + 1 if signed else READINGS):
            if signed:
                turns = signed * (down - up) / fft_size
                apart = signed * (turns - math.floor(turns + BELOW)) * fft_size
                mismatch = third[0] * up + third[1] * (up + apart) - doppler[k]
                mismatch = abs(mismatch - fft_size * math.floor(mismatch / fft_size + 0.5))
            else:
                u = fft_size - up if code & 8 else up
                place = fft_size - doppler[k] if code & 4 else doppler[k]
                d = fft_size - down if code & 2 else down
                shift = third[0] * (-u if code & 1 else u) + third[1] * d
                mismatch = abs(abs(shift) - place)
            folds = (code >> 3 & 1) + (code >> 2 & 1) + (code >> 1 & 1)
            cost = mismatch + folds * FOLD_PENALTY
            if cost < least and mismatch <= tolerance:
                least, peak, best = cost, k, code
    return least, peak, best


@njit(cache=True, error_model="numpy")
def _match(cost):
    """Down peak of each up peak, or -1, and which are used: most pairs, then least cost.

    A search in depth over the pairs of finite cost, cut where it can't beat the best so far.
    """
    ups, downs = cost.shape
    best, choice = np.full(ups, -1), np.full(ups, -1)
    used, sums = np.zeros(downs, np.bool_), np.zeros(ups + 1)
    level, least = 0 if ups else -1, np.inf
    while level >= 0:
        j = choice[level]
        if 0 <= j < downs:
            used[j] = False
        j += 1
        while j < downs and (used[j] or not math.isfinite(cost[level, j])):
            j += 1
        choice[level] = j  # without a partner where all are tried
        if j > downs:
            choice[level] = -1
            level -= 1
            continue
        sums[level + 1] = sums[level] + (cost[level, j] if j < downs else _UNPAIRED)
        if j < downs:
            used[j] = True
        if sums[level + 1] < least:
            if level + 1 < ups:
                level += 1
                continue
            least = sums[ups]
            for i in range(ups):
                best[i] = choice[i] if choice[i] < downs else -1
    for i in range(ups):
        if best[i] >= 0:
            used[best[i]] = True
    return best, used


@njit(cache=True, error_model="numpy", borrows=True)
def judge(group, centres, bins, lines, amplitude):
    """Flag of a return, but for its reading; and the beamlet next to its peaks that all hold.

    ``group`` and ``centres`` (3,) are groups and positions [bins] of the peaks of the segments; the
    rest as of :class:`sweep.model.returns.Known`, at one point. Beamlets of amplitude 0 do not
    count.
    """
    if group[0] == FALSE or group[1] == FALSE or group[2] == FALSE:
        return FALSE_ALARM, -1
    found, nearest, holds = -1, np.inf, 0
    for b in range(amplitude.size):
        if not amplitude[b] > 0.0:
            continue
        distance = 0.0
        for s in range(3):
            g = group[s]
            if g < 0:
                holds |= 1 << s
            elif bins[s, FIRST, g] - 1.0 <= lines[s, b] <= bins[s, LAST, g] + 1.0:
                holds |= 1 << s
                distance += abs(lines[s, b] - centres[s])
            else:
                distance = np.inf
        if distance < nearest:
            found, nearest = b, distance
    if holds != 7:
        return SIDELOBE, -1
    return (TRUE if found >= 0 else MISPAIRED), found
