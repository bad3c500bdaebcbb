"""Pairing of up, Doppler and down peaks into returns, and their comparison with the truth.

Each surface in a footprint makes a peak in all three segments, but peaks do not show which of them
belong together. A pair of an up and a down peak has 16 readings: each of the three peaks is folded
at Nyquist or not, and the Doppler frequency is the half sum or the half difference. Each reading
predicts a Doppler peak. A pair is *confirmed* by a peak within the tolerance of that prediction. Up
and down peaks are paired one to one such that the number of confirmed pairs is largest. Among equal
numbers the sum of mismatches is smallest, where a fold counts as
:data:`sweep.model.waveform.FOLD_PENALTY_BINS` bins. A Doppler peak may confirm several pairs, as
surfaces with a common velocity share a Doppler peak.

The remaining up and down peaks are paired in their order, strongest first, and marked as
unconfirmed. A Doppler peak may still select the reading of such a pair. It must be so near to the
prediction that a false peak comes as near only once in a hundred cases. Otherwise the pair has the
reading of two beats without a Doppler segment. If that reading is wrong, range and velocity are
exchanged. [T] leaves the choice open (docs/physics.md, *Folding*).

An up or down peak in which two surfaces coincide serves one return only.

An instrument that accelerates has another closing speed in each segment. With the default slopes
this cancels in the half sum, as the Doppler segment is in the middle. With other slopes it does not
cancel, and the tolerance is wider by the known motion.

Complex records keep the signs of beats. Their only reading is
:data:`sweep.model.waveform.SIGNED_READING`, and each surface's Doppler peak confirms it. Segments
of other slopes are paired in the same way, by the Doppler beat that an up and a down beat predict.
Their pairs are then evaluated by :func:`sweep.model.waveform.fit_range_velocity`.

Without a Doppler segment no peak can confirm a pair, and no pair is marked as unconfirmed. The
strongest up peak is paired with the strongest down peak, and so on. The reading is
:data:`sweep.model.waveform.FAR_READING`, :data:`~sweep.model.waveform.FAST_READING` or
:data:`~sweep.model.waveform.SIGNED_READING`.
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

Rounding to bins moves the prediction and the Doppler peak by half a bin each. Noise near the
threshold moves them by as much again. A peak at a random position confirms one of the 16 readings
with a probability of at most 16 (2 tolerance) / (N/2): 1.5e-3 at N = 2^17.
"""

CHANCE_MATCH_PROBABILITY = 0.01
"""Probability that a false Doppler peak selects the reading of an unconfirmed pair."""

_UNPAIRED_COST = 1e9
"""Cost of an up peak without a down peak: larger than any sum of mismatches."""

TRUE_FLAG, FALSE_ALARM_FLAG, MISPAIRED_FLAG, MISREAD_FLAG, SIDELOBE_FLAG, UNCONFIRMED_FLAG = (
    1,
    2,
    4,
    8,
    16,
    32,
)
"""Bits of a return's flags, described at :data:`FLAG_BITS`."""
FLAG_BITS = {
    "true": TRUE_FLAG,
    "false_alarm": FALSE_ALARM_FLAG,
    "mispaired": MISPAIRED_FLAG,
    "misread": MISREAD_FLAG,
    "sidelobe": SIDELOBE_FLAG,
    "unconfirmed": UNCONFIRMED_FLAG,
}
"""Bits of a return's flags. Exactly one of the first five is set, which require the truth.

- true: all its peaks contain lines of one beamlet, whose range and velocity it reports to within
  the width of the peaks;
- false alarm: one of its peaks is noise, or leaked signal raised by noise;
- mispaired: its peaks are signal, but contain lines of no common beamlet;
- misread: all its peaks contain lines of one beamlet, but the reading is wrong;
- sidelobe: one of its peaks contains no beamlet's line;
- unconfirmed, which the instrument knows: no Doppler peak is within the tolerance.
"""


FALSE_PEAK, NO_PEAK = -1, -2
"""Values in place of the number of a peak's group: for a false peak; and for no Doppler peak or
segment."""


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
    """Pair up and down peaks one to one, and return the numbers of confirmed and of all pairs.

    Parameters
    ----------
    up, doppler, down
        Positions of the peaks [bins], strongest first; signed if `down_beat_sign` is not 0.
    doppler_prediction, fft_size, down_beat_sign, tolerance
        Arguments of :func:`find_confirming_peak`.
    two_beat_reading
        Reading of pairs that no Doppler peak confirms.
    pairs
        (>= min(ups, downs), 4) int64; the result. Columns are the index of the up peak, of the
        Doppler peak (-1 if unconfirmed) and of the down peak, and the reading. Confirmed pairs come
        first, in the order of the up peaks.
    """
    if up.size == 1 and down.size == 1:  # fast path for the most frequent case
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
    """Find the Doppler peak and the reading that fit an up and a down peak best.

    Parameters
    ----------
    up, down
        Positions of the up and down peak [bins].
    doppler
        (k,): positions of the Doppler peaks [bins].
    doppler_prediction
        (3,): coefficients of the up and down beat in the Doppler beat, and the change of that by
        the instrument's motion between the segments [bins], which is added to the tolerance.
    fft_size
        FFT size N.
    down_beat_sign
        For complex records 1 if the down beat minus the up beat rises with the range, -1 if it
        falls; 0 for real records.
    tolerance
        Largest mismatch [bins].

    Returns
    -------
    tuple
        Mismatch plus penalties for folds [bins], index of the Doppler peak, and reading; inf, -1,
        -1 if no peak is within the tolerance.
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
    """Return the down peak of each up peak, or -1, and the mask of down peaks that are used.

    The solution has the most pairs, and among those the least cost. It is found by a depth-first
    search over pairs of finite cost, which stops where it cannot be better than the best so far.
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
        current_down[depth] = j  # n_down: no partner, after all others were tried
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
    """Return the flag of a return, apart from its reading, and its nearest beamlet.

    Parameters
    ----------
    groups, positions
        (3,): group and position [bins] of the peak in each segment.
    group_bins, line_positions, beamlet_amplitude
        Fields of :class:`sweep.model.pointcloud.returns.DrawInputs` for one point. Beamlets of
        amplitude 0 do not count.

    Returns
    -------
    tuple
        TRUE_FLAG, FALSE_ALARM_FLAG, MISPAIRED_FLAG or SIDELOBE_FLAG; and the beamlet nearest to the
        peaks, of those whose lines are in all of them, or -1.
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
