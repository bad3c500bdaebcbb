"""Up, Doppler and down peaks put together into returns, and returns judged against the truth.

Each surface in a footprint leaves a peak in all three segments, and which belong together is not
written on them. A pair of an up and a down peak has 16 readings (each of the three peaks as it
stands or folded at Nyquist, half sum or half difference being the Doppler frequency). Each reading
predicts a Doppler peak. A pair is *confirmed* by a peak within the tolerance of that prediction. Of
all ways to pair up and down peaks one to one, that with the most confirmed pairs is taken, and
among those the least sum of mismatches, a fold counting as
:data:`sweep.model.waveform.FOLD_PENALTY_BINS` bins. A Doppler peak may confirm several pairs, as
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
:data:`sweep.model.waveform.SIGNED_READING`, and each surface's Doppler peak confirms it. Segments
of other
slopes are paired alike, by the Doppler beat that an up and a down beat predict; readings of a pair
that is found are left to :func:`sweep.model.waveform.fit_range_velocity`.

Without a Doppler segment nothing tells which peaks belong together, and none is unconfirmed: the
strongest up peak goes with the strongest down peak, and so on, by the reading
:data:`sweep.model.waveform.FAR_READING`, FAST or SIGNED.
"""

import math

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.pointcloud.bin_groups import FIRST_ROW, LAST_ROW
from sweep.model.waveform import (
    FOLD_PENALTY_BINS,
    N_READINGS,
    NEGATIVE_BEAT_FRACTION_MAX,
    SIGNED_READING,
)

CONFIRMATION_TOLERANCE_BINS = 3.0
"""Default mismatch [bins] up to which a Doppler peak confirms a pair.

Rounding to bins moves the prediction and the Doppler peak by half a bin each, noise near the
threshold as much again. A peak anywhere confirms one of the 16 readings at random with
16 (2 TOLERANCE) / (N/2) or less: 1.5e-3 at N = 2^17.
"""

CHANCE_MATCH_PROBABILITY = 0.01
"""Probability with which a false Doppler peak is as near to a reading as one that tells which."""

_UNPAIRED_COST = 1e9
"""Cost of an up peak without a down peak: more than any sum of mismatches."""

TRUE_FLAG, FALSE_ALARM_FLAG, MISPAIRED_FLAG, MISREAD_FLAG, SIDELOBE_FLAG, UNCONFIRMED_FLAG = (
    1,
    2,
    4,
    8,
    16,
    32,
)
FLAG_BITS = {
    "true": TRUE_FLAG,
    "false_alarm": FALSE_ALARM_FLAG,
    "mispaired": MISPAIRED_FLAG,
    "misread": MISREAD_FLAG,
    "sidelobe": SIDELOBE_FLAG,
    "unconfirmed": UNCONFIRMED_FLAG,
}
"""Bits of a return's flags. Of the first five, which need the truth, exactly one is set:

true: its peaks hold a common beamlet, whose range and velocity it reports to within their width;
false alarm: one of its peaks is noise (or leaked signal lifted by noise); mispaired: its peaks
are signal, of no common beamlet; misread: a common beamlet, but the wrong one of the readings;
sidelobe: one of its peaks holds no beamlet's line. Unconfirmed, which the instrument knows: no
Doppler peak within the tolerance.
"""


FALSE_PEAK, NO_PEAK = -1, -2
"""In place of a peak's group: a false peak; no Doppler peak, or no Doppler segment."""


@njit(cache=True, error_model="numpy")
def pair_peaks(
    up,
    doppler,
    down,
    doppler_prediction,
    fft_size,
    down_beat_sign,
    two_beat_reading,
    tolerance,
    pairs,
):
    """Pairs of peaks, one to one: confirmed ones first, in the order of the up peaks.

    Peaks are positions [bins], strongest first, with signs if ``down_beat_sign``; the rest as of
    :func:`find_confirming_peak`. ``two_beat_reading`` is the reading of pairs that are not
    confirmed. ``pairs`` (>=
    min(ups, downs), 4) int64 takes the index of up, Doppler (-1 where unconfirmed) and down peak,
    and the reading. Returns the numbers of confirmed pairs, and of all.
    """
    if up.size == 1 and down.size == 1:  # the pair that most shots have
        mismatch, doppler_index, reading = find_confirming_peak(
            up[0], doppler, down[0], doppler_prediction, fft_size, down_beat_sign, tolerance
        )
        if math.isfinite(mismatch):
            pairs[0, 0], pairs[0, 1], pairs[0, 2], pairs[0, 3] = 0, doppler_index, 0, reading
            return 1, 1
    cost, confirmed_by = np.empty((up.size, down.size)), np.empty((up.size, down.size, 2), np.int64)
    for i in range(up.size):
        for j in range(down.size):
            cost[i, j], confirmed_by[i, j, 0], confirmed_by[i, j, 1] = find_confirming_peak(
                up[i], doppler, down[j], doppler_prediction, fft_size, down_beat_sign, tolerance
            )
    down_of_up, is_down_used = _match_pairs(cost)
    n_pairs = 0
    for i in range(up.size):
        j = down_of_up[i]
        if j >= 0:
            pairs[n_pairs, 0], pairs[n_pairs, 2] = i, j
            pairs[n_pairs, 1], pairs[n_pairs, 3] = confirmed_by[i, j, 0], confirmed_by[i, j, 1]
            n_pairs += 1
    n_confirmed, j = n_pairs, 0
    for i in range(up.size):
        while j < down.size and is_down_used[j]:
            j += 1
        if down_of_up[i] < 0 and j < down.size:
            n_readings = 1 if down_beat_sign else N_READINGS
            chance_tolerance = CHANCE_MATCH_PROBABILITY * fft_size / (4.0 * n_readings)
            _, _, reading = find_confirming_peak(
                up[i],
                doppler,
                down[j],
                doppler_prediction,
                fft_size,
                down_beat_sign,
                chance_tolerance,
            )
            pairs[n_pairs, 0], pairs[n_pairs, 1], pairs[n_pairs, 2] = i, -1, j
            pairs[n_pairs, 3] = reading if reading >= 0 else two_beat_reading
            n_pairs, j = n_pairs + 1, j + 1
    return n_confirmed, n_pairs


@njit(cache=True, error_model="numpy", borrows=True)
def find_confirming_peak(
    up, doppler, down, doppler_prediction, fft_size, down_beat_sign, tolerance
):
    """Doppler peak and reading of an up and a down peak that fit best, within a tolerance [bins].

    ``doppler_prediction`` (3,) is the share of up and of down beat in the Doppler segment's, and
    what the
    instrument's motion between the segments moves that by [bins], which adds to the tolerance.
    ``down_beat_sign``, of complex records, is 1 where the down beat rises against the up beat as
    the range
    does, -1 where it falls; 0 of real records. Returns mismatch and penalties [bins], inf where
    none comes within the tolerance; the Doppler peak and the reading, -1 for none.
    """
    least_cost, doppler_index, best_reading = np.inf, -1, -1
    tolerance += doppler_prediction[2]
    for k in range(doppler.size):
        for reading in range(
            SIGNED_READING if down_beat_sign else 0,
            SIGNED_READING + 1 if down_beat_sign else N_READINGS,
        ):
            if down_beat_sign:
                rate_fraction = down_beat_sign * (down - up) / fft_size
                beat_difference = (
                    down_beat_sign
                    * (rate_fraction - math.floor(rate_fraction + NEGATIVE_BEAT_FRACTION_MAX))
                    * fft_size
                )
                mismatch = (
                    doppler_prediction[0] * up
                    + doppler_prediction[1] * (up + beat_difference)
                    - doppler[k]
                )
                mismatch = abs(mismatch - fft_size * math.floor(mismatch / fft_size + 0.5))
            else:
                up_beat = fft_size - up if reading & 8 else up
                doppler_beat = fft_size - doppler[k] if reading & 4 else doppler[k]
                down_beat = fft_size - down if reading & 2 else down
                predicted_beat = (
                    doppler_prediction[0] * (-up_beat if reading & 1 else up_beat)
                    + doppler_prediction[1] * down_beat
                )
                mismatch = abs(abs(predicted_beat) - doppler_beat)
            n_folds = (reading >> 3 & 1) + (reading >> 2 & 1) + (reading >> 1 & 1)
            cost = mismatch + n_folds * FOLD_PENALTY_BINS
            if cost < least_cost and mismatch <= tolerance:
                least_cost, doppler_index, best_reading = cost, k, reading
    return least_cost, doppler_index, best_reading


@njit(cache=True, error_model="numpy")
def _match_pairs(cost):
    """Down peak of each up peak, or -1, and which are used: most pairs, then least cost.

    A search in depth over the pairs of finite cost, cut where it can't beat the best so far.
    """
    n_up, n_down = cost.shape
    best_down, current_down = np.full(n_up, -1), np.full(n_up, -1)
    is_down_used, partial_costs = np.zeros(n_down, np.bool_), np.zeros(n_up + 1)
    depth, least_cost = 0 if n_up else -1, np.inf
    while depth >= 0:
        j = current_down[depth]
        if 0 <= j < n_down:
            is_down_used[j] = False
        j += 1
        while j < n_down and (is_down_used[j] or not math.isfinite(cost[depth, j])):
            j += 1
        current_down[depth] = j  # without a partner where all are tried
        if j > n_down:
            current_down[depth] = -1
            depth -= 1
            continue
        partial_costs[depth + 1] = partial_costs[depth] + (
            cost[depth, j] if j < n_down else _UNPAIRED_COST
        )
        if j < n_down:
            is_down_used[j] = True
        if partial_costs[depth + 1] < least_cost:
            if depth + 1 < n_up:
                depth += 1
                continue
            least_cost = partial_costs[n_up]
            for i in range(n_up):
                best_down[i] = current_down[i] if current_down[i] < n_down else -1
    for i in range(n_up):
        if best_down[i] >= 0:
            is_down_used[best_down[i]] = True
    return best_down, is_down_used


@njit(cache=True, error_model="numpy", borrows=True)
def judge_return(groups, positions, group_bins, line_positions, beamlet_amplitude):
    """Flag of a return, but for its reading; and the beamlet next to its peaks that all hold.

    ``groups`` and ``positions`` (3,) are groups and positions [bins] of the peaks of the segments;
    the rest as of :class:`sweep.model.pointcloud.returns.DrawInputs`, at one point. Beamlets of
    amplitude 0 do not count.
    """
    if groups[0] == FALSE_PEAK or groups[1] == FALSE_PEAK or groups[2] == FALSE_PEAK:
        return FALSE_ALARM_FLAG, -1
    nearest_beamlet, least_distance, held_segments = -1, np.inf, 0
    for beamlet in range(beamlet_amplitude.size):
        if not beamlet_amplitude[beamlet] > 0.0:
            continue
        distance = 0.0
        for s in range(3):
            group = groups[s]
            if group < 0:
                held_segments |= 1 << s
            elif (
                group_bins[s, FIRST_ROW, group] - 1.0
                <= line_positions[s, beamlet]
                <= group_bins[s, LAST_ROW, group] + 1.0
            ):
                held_segments |= 1 << s
                distance += abs(line_positions[s, beamlet] - positions[s])
            else:
                distance = np.inf
        if distance < least_distance:
            nearest_beamlet, least_distance = beamlet, distance
    if held_segments != 7:
        return SIDELOBE_FLAG, -1
    return (TRUE_FLAG if nearest_beamlet >= 0 else MISPAIRED_FLAG), nearest_beamlet
