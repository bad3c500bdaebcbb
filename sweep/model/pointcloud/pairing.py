"""Pairing of up, Doppler and down peaks into returns, and their comparison with the truth.

Each surface in a footprint makes a peak in all three segments, but peaks do not show which of them
belong together. A pair of an up and a down peak has 16 readings: each of the three peaks is folded
at Nyquist or not, and the Doppler frequency is the half sum or the half difference. Each reading
predicts a Doppler peak. A pair is *confirmed* by a peak within the tolerance of that prediction. Up
and down peaks are paired one to one such that the number of confirmed pairs is largest. Of several
such pairings, that with the smallest sum of mismatches is chosen, where a fold counts as
:data:`sweep.model.waveform.FOLD_PENALTY_BINS` bins. A Doppler peak may confirm several pairs, as
surfaces with a common velocity share a Doppler peak.

The remaining up and down peaks are paired in their order, strongest first, and marked as
unconfirmed. A Doppler peak may still select the reading of such a pair. It must be so near to the
prediction that a false peak comes as near only once in a hundred cases. Otherwise the pair has the
reading of two beats without a Doppler segment. If that reading is wrong, range and velocity are
exchanged. [T] leaves the choice open (docs/physics.md, *Folding*).

If the lines of two surfaces make one up or down peak, it is part of one return only.

An instrument that accelerates has another closing speed in each segment. With the default slopes
this cancels in the half sum, as the Doppler segment is in the middle. With other slopes it does not
cancel, and the tolerance is wider by the known motion.

Complex records keep the signs of beats. Their only reading is
:data:`sweep.model.waveform.SIGNED_BEATS_READING`, and each surface's Doppler peak confirms it.
Segments of other slopes are paired in the same way, by the Doppler beat that an up and a down beat
predict. Their pairs are then evaluated by :func:`sweep.model.waveform.fit_range_velocity`.

Without a Doppler segment no peak can confirm a pair, and no pair is marked as unconfirmed. The
strongest up peak is paired with the strongest down peak, and so on. The reading is
:data:`sweep.model.waveform.FAR_TARGET_READING`, :data:`~sweep.model.waveform.FAST_TARGET_READING`
or :data:`~sweep.model.waveform.SIGNED_BEATS_READING`.
"""

import math
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.kernel_integers import NO_INDEX
from sweep.model.waveform import (
    FOLD_PENALTY_BINS,
    N_POSSIBLE_BEAT_READINGS,
    NEGATIVE_BEAT_FRACTION_MAX,
    SIGNED_BEATS_READING,
)

CONFIRMATION_TOLERANCE_BINS = 3.0
"""Default tolerance [bins] for the confirmation of a pair of an up and a down peak: largest
distance of a Doppler peak from the position that the pair predicts.

Rounding to bins moves the prediction and the Doppler peak by half a bin each. Noise near the
threshold moves them by as much again. A pair has 16 readings (ways to read its beats as range and
velocity), each with a predicted position. A peak at a random position confirms one of them with a
probability of at most 16 (2 tolerance) / (N/2), with N the FFT size: 1.5e-3 at N = 2^17.
"""

CHANCE_MATCH_PROBABILITY_MAX = 0.01
"""Largest probability that a false Doppler peak selects the reading (way to interpret the beats as
range and velocity) of a pair that no Doppler peak confirms. It limits the distance of a Doppler
peak from the predicted position."""

_UNPAIRED_COST_BINS = 1e9
"""Cost [bins] of an up peak without a down peak, in the search for the best pairing. It exceeds any
sum of distances between Doppler peaks and their predicted positions."""

TRUE_RETURN_FLAG = 1
"""Flag bit of a true return: range and velocity are those of a surface that a beamlet hits."""
FALSE_ALARM_FLAG = 2
"""Flag bit of a return with a peak of noise, or of leaked signal raised by noise."""
MISPAIRED_FLAG = 4
"""Flag bit of a return whose up, Doppler and down peaks belong to different beamlets."""
MISREAD_FLAG = 8
"""Flag bit of a return whose peaks belong to one beamlet, but were converted to a wrong range or
velocity."""
SIDELOBE_FLAG = 16
"""Flag bit of a return with a peak of signal that contains no beamlet's line, such as a sidelobe.
"""
UNCONFIRMED_FLAG = 32
"""Flag bit of a return for which no Doppler peak is near the position that its up and down peak
predict."""
FLAG_BITS = {
    "true": TRUE_RETURN_FLAG,
    "false_alarm": FALSE_ALARM_FLAG,
    "mispaired": MISPAIRED_FLAG,
    "misread": MISREAD_FLAG,
    "sidelobe": SIDELOBE_FLAG,
    "unconfirmed": UNCONFIRMED_FLAG,
}
"""Bits of the flags of a return (a measured point), by name.

Exactly one of the first five bits is set. They follow from a comparison with the truth.

- true: all peaks of the return contain lines of one beamlet, and its range and velocity are those
  of this beamlet to within the width of the peaks;
- false alarm: one of its peaks is noise, or leaked signal raised by noise;
- mispaired: its peaks are signal, but contain lines of no common beamlet;
- misread: all its peaks contain lines of one beamlet, but were converted to a wrong range or
  velocity;
- sidelobe: one of its peaks contains no beamlet's line;
- unconfirmed, which the instrument knows: no Doppler peak is within the tolerance.
"""


FALSE_PEAK_GROUP = NO_INDEX
"""Group number of a false peak, which belongs to no group of bins of an echo."""
NO_PEAK_GROUP = -2
"""Group number of a missing peak. It is missing if no Doppler peak confirms the return, or if the
segment does not exist."""


class DopplerPrediction(NamedTuple):
    """Coefficients that predict the Doppler beat from the up and the down beat.

    The fields are arrays (n,) of n points, or numbers of one point.
    """

    up_coefficient: np.ndarray | float
    """Derivative of the predicted Doppler beat with respect to the up beat."""
    down_coefficient: np.ndarray | float
    """Derivative of the predicted Doppler beat with respect to the down beat."""
    motion_shift_max_bins: np.ndarray | float
    """Largest shift of the Doppler beat by the instrument's motion between the segments [bins]. It
    is added to the tolerance of the predicted position."""

    def select(self, indices: np.ndarray) -> "DopplerPrediction":
        """Return the record for the points with the given indices."""
        return DopplerPrediction(*(np.asarray(values)[indices] for values in self))


class PeakPairs(NamedTuple):
    """Pairs of an up and a down peak of one draw, (pairs,) each.

    Peaks have indices in the list of their segment.
    """

    up_index: np.ndarray
    """(pairs,) int64: index of the pair's up peak in the list of up peaks."""
    doppler_index: np.ndarray
    """(pairs,) int64: index of the Doppler peak that confirms the pair; -1 for none."""
    down_index: np.ndarray
    """(pairs,) int64: index of the pair's down peak in the list of down peaks."""
    reading: np.ndarray
    """(pairs,) int64: number of the reading (way to interpret the beats) that gives range and
    velocity, as in :func:`sweep.model.waveform.doppler_and_range_beat`."""

    @classmethod
    def allocate(cls, pairs_max: int) -> "PeakPairs":
        """Return a record with uninitialised arrays for at most ``pairs_max`` pairs."""
        return cls(*np.empty((4, pairs_max), np.int64))


class ConfirmingPeak(NamedTuple):
    """Doppler peak and reading of the beats that fit an up and a down peak best.

    A reading is one way to interpret beats as range and velocity: far or fast target, folded at
    Nyquist or not.
    """

    cost: float
    """Distance between the Doppler peak and its predicted position, plus penalties for folds at
    Nyquist [bins]; inf if no peak fits."""
    doppler_index: int
    """Index of the Doppler peak in the list of the segment's peaks; -1 if no peak fits."""
    reading: int
    """Number of the reading (way to interpret the beats) that gives range and velocity, as in
    :func:`sweep.model.waveform.doppler_and_range_beat`; -1 if no peak fits."""


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
    """Pair up and down peaks one to one; return the numbers of confirmed and of all pairs.

    A pair is confirmed by a Doppler peak near the position that the pair predicts.

    Parameters
    ----------
    up, doppler, down
        Positions of the peaks of each segment [bins], strongest first; signed if `down_beat_sign`
        is not 0.
    doppler_prediction, fft_size, down_beat_sign, tolerance
        Arguments of :func:`find_confirming_peak`.
    two_beat_reading
        Reading (way to interpret the beats) of pairs that no Doppler peak confirms.
    pairs
        :class:`PeakPairs` for at least min(ups, downs) pairs; the result. Confirmed pairs come
        first, in the order of the up peaks.
    """
    if up.size == 1 and down.size == 1:  # fast path for the most frequent case
        confirming_peak = find_confirming_peak(
            up[0], doppler, down[0], doppler_prediction, fft_size, down_beat_sign, tolerance
        )
        if math.isfinite(confirming_peak.cost):
            pairs.up_index[0], pairs.down_index[0] = 0, 0
            pairs.doppler_index[0], pairs.reading[0] = (
                confirming_peak.doppler_index,
                confirming_peak.reading,
            )
            return 1, 1
    cost = np.empty((up.size, down.size))
    doppler_of_pair = np.empty((up.size, down.size), np.int64)
    reading_of_pair = np.empty((up.size, down.size), np.int64)
    for i in range(up.size):
        for j in range(down.size):
            cost[i, j], doppler_of_pair[i, j], reading_of_pair[i, j] = find_confirming_peak(
                up[i], doppler, down[j], doppler_prediction, fft_size, down_beat_sign, tolerance
            )
    down_of_up, is_down_used = _find_best_pairing(cost)
    n_pairs = 0
    for i in range(up.size):
        j = down_of_up[i]
        if j >= 0:
            pairs.up_index[n_pairs], pairs.down_index[n_pairs] = i, j
            pairs.doppler_index[n_pairs] = doppler_of_pair[i, j]
            pairs.reading[n_pairs] = reading_of_pair[i, j]
            n_pairs += 1
    n_confirmed, j = n_pairs, 0
    for i in range(up.size):
        while j < down.size and is_down_used[j]:
            j += 1
        if down_of_up[i] < 0 and j < down.size:
            n_readings = 1 if down_beat_sign else N_POSSIBLE_BEAT_READINGS
            chance_tolerance = CHANCE_MATCH_PROBABILITY_MAX * fft_size / (4.0 * n_readings)
            reading = find_confirming_peak(
                up[i],
                doppler,
                down[j],
                doppler_prediction,
                fft_size,
                down_beat_sign,
                chance_tolerance,
            ).reading
            pairs.up_index[n_pairs], pairs.doppler_index[n_pairs], pairs.down_index[n_pairs] = (
                i,
                -1,
                j,
            )
            pairs.reading[n_pairs] = reading if reading >= 0 else two_beat_reading
            n_pairs, j = n_pairs + 1, j + 1
    return n_confirmed, n_pairs


@njit(cache=True, error_model="numpy", borrows=True)
def find_confirming_peak(
    up, doppler, down, doppler_prediction, fft_size, down_beat_sign, tolerance
):
    """Find the Doppler peak and the reading that fit an up and a down peak best.

    A reading is one way to interpret the beats as range and velocity: far or fast, folded at
    Nyquist or not.

    Parameters
    ----------
    up, down
        Positions of the up and down peak [bins].
    doppler
        (k,): positions of the Doppler peaks [bins].
    doppler_prediction
        :class:`DopplerPrediction` of the point.
    fft_size
        FFT size N.
    down_beat_sign
        For complex records 1 if the down beat minus the up beat rises with the range, -1 if it
        falls; 0 for real records.
    tolerance
        Largest distance of a Doppler peak from its predicted position [bins].

    Returns
    -------
    ConfirmingPeak
        The peak of least cost within the tolerance.
    """
    least_cost, doppler_index, best_reading = np.inf, -1, -1
    up_coefficient, down_coefficient, motion_shift_max_bins = doppler_prediction
    tolerance += motion_shift_max_bins
    for k in range(doppler.size):
        for reading in range(
            SIGNED_BEATS_READING if down_beat_sign else 0,
            SIGNED_BEATS_READING + 1 if down_beat_sign else N_POSSIBLE_BEAT_READINGS,
        ):
            if down_beat_sign:
                rate_fraction = down_beat_sign * (down - up) / fft_size
                beat_difference = (
                    down_beat_sign
                    * (rate_fraction - math.floor(rate_fraction + NEGATIVE_BEAT_FRACTION_MAX))
                    * fft_size
                )
                mismatch = (
                    up_coefficient * up + down_coefficient * (up + beat_difference) - doppler[k]
                )
                mismatch = abs(mismatch - fft_size * math.floor(mismatch / fft_size + 0.5))
            else:
                up_beat = fft_size - up if reading & 8 else up
                doppler_beat = fft_size - doppler[k] if reading & 4 else doppler[k]
                down_beat = fft_size - down if reading & 2 else down
                predicted_beat = (
                    up_coefficient * (-up_beat if reading & 1 else up_beat)
                    + down_coefficient * down_beat
                )
                mismatch = abs(abs(predicted_beat) - doppler_beat)
            n_folds = (reading >> 3 & 1) + (reading >> 2 & 1) + (reading >> 1 & 1)
            cost = mismatch + n_folds * FOLD_PENALTY_BINS
            if cost < least_cost and mismatch <= tolerance:
                least_cost, doppler_index, best_reading = cost, k, reading
    return ConfirmingPeak(least_cost, doppler_index, best_reading)


@njit(cache=True, error_model="numpy")
def _find_best_pairing(cost):
    """Find the one-to-one pairing with the most pairs and, among these, the least total cost.

    Parameters
    ----------
    cost
        (ups, downs): cost of each pair of an up and a down peak; inf for a pair that is not
        allowed.

    Returns
    -------
    best_down
        (ups,) int64: index of the down peak paired with each up peak, -1 for none.
    is_down_used
        (downs,) bool: True for down peaks that are paired.

    Notes
    -----
    A depth-first search over pairs of finite cost, which leaves a branch as soon as it cannot be
    better than the best solution so far.
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
            cost[depth, j] if j < n_down else _UNPAIRED_COST_BINS
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
def compare_return_with_truth(
    groups, positions, first_bin, last_bin, line_positions, beamlet_amplitude
):
    """Compare a return's peaks with the truth; return its flag and the nearest beamlet.

    Range and velocity of the return are not compared here.

    Parameters
    ----------
    groups, positions
        (3,): number of the group and position [bins] of the peak in each segment.
    first_bin, last_bin
        (3, groups): first and last bin of the groups in each segment.
    line_positions, beamlet_amplitude
        (3, beamlets) [bins] and (beamlets,): position of each beamlet's line in each segment, and
        amplitude of its echo. Beamlets of amplitude 0 do not count.

    Returns
    -------
    flag
        TRUE_RETURN_FLAG, FALSE_ALARM_FLAG, MISPAIRED_FLAG or SIDELOBE_FLAG.
    beamlet
        Index of the beamlet nearest to the peaks, among those with a line in every peak; -1 for
        none.
    """
    for s in range(3):
        if groups[s] == FALSE_PEAK_GROUP:
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
                first_bin[s, group] - 1.0 <= line_positions[s, beamlet] <= last_bin[s, group] + 1.0
            ):
                held_segments |= 1 << s
                distance += abs(line_positions[s, beamlet] - positions[s])
            else:
                distance = np.inf
        if distance < least_distance:
            nearest_beamlet, least_distance = beamlet, distance
    if held_segments != 7:
        return SIDELOBE_FLAG, -1
    return (TRUE_RETURN_FLAG if nearest_beamlet >= 0 else MISPAIRED_FLAG), nearest_beamlet
