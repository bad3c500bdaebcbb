"""The waveform and its segments: beats, their phases, and what a set of peaks says.

Homodyne beat phase of a segment (PHYSICS section 2), tau(t) = tau_0 - beta t, beta = 2 v_r / c:

    psi(t) = 2 pi [ -f_seg tau(t) + s S ( tau(t)^2 / 2 - t tau(t) ) ],   s = +1, 0, -1

Its terms up to t give one line per segment:

    phase at t = 0   -f_seg tau_0 + s S tau_0^2 / 2          [cycles]
    beat             f_seg beta - s S tau_0 (1 + beta)       [Hz, signed]

f_seg is the optical frequency at the segment's start: c/lambda for the up-chirp and the Doppler
segment, c/lambda + B for the down-chirp. To leading order the beats are f_d - f_r, f_d and f_d +
f_r with f_d = 2 v_r / lambda and f_r = S 2 R / c [T 2.8]. The further terms move the down beat of
Table 4.1 by 0.2 bins at 150 m/s. The terms in t^2 are range walk, an effect of its own. By [T] each
segment starts with the target at range R; that it moves on in between is an effect too.

A shot has an up- and a down-chirp, in any order, and may have a Doppler segment before, between or
behind them. All last as long, with equal gaps. Two beats of real records tell both unknowns by an
assumption (docs/physics.md, *A segment that is missed*); complex records keep the sign of each.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.constants import SPEED_OF_LIGHT

SEGMENT_NAMES = ("up", "doppler", "down")
SEGMENT_ORDER_PATH, SEGMENT_GAP_PATH = "instrument.chirp.segments", "instrument.chirp.gap"
SEGMENT_ORDERS = (
    "up doppler down", "up down", "down up", "down doppler up", "doppler up down",
    "doppler down up", "up down doppler", "down up doppler",
)  # fmt: skip
"""Segments of a shot in the order of time."""
DOPPLER_SLOPE_PATH, DOWN_SLOPE_PATH = (
    "instrument.chirp.doppler_slope",
    "instrument.chirp.down_slope",
)
SHOT_DETECTION_PATH = "instrument.processing.shot_detection"
BOTH_CHIRPS, ANY_TWO = SHOT_DETECTIONS = ("both_chirps", "any_two")
TWO_BEATS_PATH = "instrument.processing.two_beats"
PEAKS_PATH = "instrument.processing.peaks"
ALL_PEAKS, STRONGEST_PEAK = REPORTED_PEAKS = ("all", "strongest")
FAR_TARGET, FAST_TARGET = TWO_BEAT_ASSUMPTIONS = ("far", "fast")
DEFAULT_CHIRP_SLOPES = (1, 0, -1)
"""Chirp rate of up, Doppler and down segment over the up-chirp's, by default."""
WAVEFORM_DEFAULTS: dict[str, float | int | str | np.ndarray] = {
    SEGMENT_ORDER_PATH: SEGMENT_ORDERS[0],
    SEGMENT_GAP_PATH: 0.0,
    DOPPLER_SLOPE_PATH: 0.0,
    DOWN_SLOPE_PATH: -1.0,
    SHOT_DETECTION_PATH: BOTH_CHIRPS,
    TWO_BEATS_PATH: FAR_TARGET,
    PEAKS_PATH: ALL_PEAKS,
}

SEARCH_PREFIX = "instrument.processing.search."
SEARCH_RANGE_PATHS = SEARCH_PREFIX + "min_range", SEARCH_PREFIX + "max_range"
SEARCH_VELOCITY_PATHS = SEARCH_PREFIX + "min_radial_velocity", SEARCH_PREFIX + "max_radial_velocity"
SEARCH_BAND_PATHS = SEARCH_RANGE_PATHS + SEARCH_VELOCITY_PATHS
"""Parameters of a search band; it has all four."""


class WaveformSegment(NamedTuple):
    """One part of a waveform, in which the frequency rises or falls evenly or stands still."""

    name: str
    chirp_slope: float
    """Chirp rate over the up-chirp's, signed: 1, 0 and -1 by default."""
    chirp_rate: np.ndarray
    """[Hz/s], signed, (n,) or scalar."""
    carrier: np.ndarray
    """Frequency that the delay turns into phase [Hz], (n,) or scalar."""
    includes_leakage: bool
    """Tell whether leakage in it is looked at."""
    range_decrease: np.ndarray | float
    """Range by which the target has come nearer since the shot's start [m], (n,) or scalar."""
    doppler_ratio: np.ndarray | float
    """Doppler ratio 2 v_r / c of the line on the axis, (n,) or scalar."""
    start_time: np.ndarray | float
    """Time since the shot's start [s]; 0 where the target stands still between segments."""


class RangeVelocity(NamedTuple):
    """Range and radial velocity that the peaks of a shot report, (n,) each."""

    range: np.ndarray
    radial_velocity: np.ndarray


def carrier_frequencies(
    architecture: str, *, wavelength: np.ndarray, start_frequency: np.ndarray,
    bandwidth: np.ndarray, chirp_slopes: Sequence[ArrayLike] = DEFAULT_CHIRP_SLOPES,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Frequency f_seg [Hz] that the delay turns into phase, for up, Doppler and down segment.

    The wavelength is that at the start of the up-chirp, the lowest of a segment's: one that falls
    starts above it by its own bandwidth. Direct detection chirps the light's power, so that there
    the radio frequency takes the optical one's place.
    """
    lowest_frequency = (
        start_frequency if architecture == "direct" else SPEED_OF_LIGHT / np.asarray(wavelength)
    )
    up, doppler, down = (
        lowest_frequency + bandwidth * np.maximum(np.negative(s), 0.0)
        if np.any(np.less(s, 0))
        else lowest_frequency
        for s in chirp_slopes
    )
    return up, doppler, down


def chirp_slopes(parameters: Mapping[str, Any]) -> tuple[float, ...]:
    """Chirp rate of each segment over the up-chirp's, of points that share them."""
    doppler, down = (
        float(np.ravel(parameters.get(x, WAVEFORM_DEFAULTS[x]))[0])
        for x in (DOPPLER_SLOPE_PATH, DOWN_SLOPE_PATH)
    )
    return 1.0, doppler, down


def segment_carriers(parameters: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the frequencies of :func:`carrier_frequencies` from parameters by dotted path."""
    return carrier_frequencies(
        str(parameters["instrument.receiver.architecture"]),
        wavelength=parameters["instrument.laser.wavelength"],
        start_frequency=parameters["instrument.chirp.start_frequency"],
        bandwidth=parameters["instrument.chirp.bandwidth"],
        chirp_slopes=chirp_slopes(parameters),
    )


def existing_segments(architecture: str, segments: str) -> tuple[str, ...]:
    """Names of the segments of a shot, of :data:`SEGMENT_ORDERS`, in the order of time.

    Direct detection has no optical Doppler segment.
    """
    all_names = segments.split()
    return tuple(name for name in all_names if name != "doppler" or architecture != "direct")


def segment_starts(
    segment_order: tuple[str, ...], *, duration: np.ndarray, gap: np.ndarray | float = 0.0
) -> tuple[np.ndarray, ...]:
    """Return times [s] from the shot's start to each segment's: up, Doppler, down; 0 for none."""
    period = np.asarray(duration, float) + gap
    return tuple(
        period * (segment_order.index(name) if name in segment_order else 0)
        for name in SEGMENT_NAMES
    )


def beat_frequency(
    chirp_slope: float | np.ndarray,
    *,
    carrier: np.ndarray,
    chirp_rate: np.ndarray,
    range: np.ndarray,
    radial_velocity: np.ndarray,
) -> np.ndarray:
    """Signed beat [Hz] of a segment whose chirp rate is the slope times B/T [Hz/s]."""
    doppler_ratio = 2 * radial_velocity / SPEED_OF_LIGHT
    return carrier * doppler_ratio - chirp_slope * chirp_rate * (2 * range / SPEED_OF_LIGHT) * (
        1 + doppler_ratio
    )


SAMPLE_TIME_TOLERANCE = 1e-6
"""Share of a sample by which one on a limit of time counts as within."""


def record_length(parameters: Mapping[str, Any]) -> np.ndarray:
    """Return the record's length [samples]: the FFT's, or what the chirp leaves after the delay."""
    time_left = (
        parameters["instrument.chirp.duration"]
        - parameters["instrument.processing.acquisition_delay"]
    )
    n_available = np.floor(
        time_left * parameters["instrument.processing.sample_rate"] + SAMPLE_TIME_TOLERANCE
    )
    return np.minimum(parameters["instrument.processing.fft_size"], n_available).astype(np.int64)


def count_samples_before_echo(
    *, delay: np.ndarray, doppler_ratio: np.ndarray | float, record_start: np.ndarray,
    sample_rate: np.ndarray, length: int,
) -> np.ndarray:  # fmt: skip
    """Count the samples of a record, 0 to all ``length``, that are taken before the echo arrives.

    The delay tau_0 at a segment's start [s] changes as tau(t) = tau_0 - beta t; the record begins
    at ``record_start`` [s]. The sample at t has an echo where t >= tau(t).
    """
    arrival_samples = (
        np.asarray(delay) / (1 + np.asarray(doppler_ratio)) - record_start
    ) * sample_rate
    return np.clip(np.ceil(arrival_samples - SAMPLE_TIME_TOLERANCE), 0, length).astype(np.int64)


def fold_frequency(frequency: np.ndarray, sample_rate: np.ndarray) -> np.ndarray:
    """Fold a signed frequency into the spectrum of a real record, 0..fs/2."""
    return np.abs(frequency - sample_rate * np.rint(frequency / sample_rate))


FOLD_PENALTY_BINS = 4.0
"""Bins of mismatch that a reading without folds may have before one with a fold is preferred."""

N_READINGS = 16

FAR_READING = 1
"""Reading without folds in which the half difference is the Doppler frequency: |f_d| < f_r."""

FAST_READING = 0
"""Reading without folds in which the half sum is the Doppler frequency: |f_d| > f_r."""


SIGNED_READING = 16
"""Reading of peaks of a complex record, which keep their signs: 2 f_r = d - u, f_d = u + f_r, each
up to whole sample rates; range beats up to half of it, Doppler shifts to half of either sign."""

NEGATIVE_BEAT_FRACTION_MAX = 1 / 64
"""Share of the sample rate by which 2 f_r may be below 0, as that of peaks rounded to bins."""


def read_beats(reading, up, down, sample_rate):  # type: ignore[no-untyped-def]  # of arrays, or compiled
    """(f_d, f_r): signed Doppler and range beat by one of the readings, in the unit given.

    The bits of ``reading`` are, from the highest, folds of up, Doppler and down peak, and whether
    half sum and half difference are exchanged: in the order in which readings are tried. Or
    :data:`SIGNED_READING`, of peaks -N/2 .. N/2.
    """
    if reading == SIGNED_READING:
        rate_fraction = (down - up) / sample_rate
        f_r = (
            (rate_fraction - np.floor(rate_fraction + NEGATIVE_BEAT_FRACTION_MAX))
            * sample_rate
            / 2.0
        )
        rate_fraction = (up + f_r) / sample_rate
        return (rate_fraction - np.floor(rate_fraction + 0.5)) * sample_rate, f_r
    up_beat = sample_rate - up if reading & 8 else up
    down_beat = sample_rate - down if reading & 2 else down
    half_sum, half_difference = (up_beat + down_beat) / 2.0, abs(down_beat - up_beat) / 2.0
    doppler_beat, range_beat = (
        (half_difference, half_sum) if reading & 1 else (half_sum, half_difference)
    )
    return np.copysign(doppler_beat, down_beat - up_beat), range_beat


def range_velocity_of_beats(  # type: ignore[no-untyped-def]  # of arrays, or compiled
    f_d, f_r, carrier, bandwidth, duration
):
    """(range [m], radial velocity [m/s]) of a Doppler frequency and a range beat [Hz]."""
    beta = f_d / (carrier + bandwidth / 2.0)
    delay = (f_r - bandwidth * beta / 2.0) / (bandwidth / duration * (1.0 + beta))
    return SPEED_OF_LIGHT * delay / 2.0, SPEED_OF_LIGHT * beta / 2.0


def resolve_range_velocity(
    *,
    up: np.ndarray,
    doppler: np.ndarray | None,
    down: np.ndarray,
    carrier: np.ndarray,
    bandwidth: np.ndarray,
    duration: np.ndarray,
    sample_rate: np.ndarray,
    bin_width: np.ndarray,
    has_signs: bool = False,
    two_beat_assumption: str = FAR_TARGET,
) -> RangeVelocity:
    """Range and velocity from unsigned, folded peak frequencies [Hz], (n,) each.

    Frequencies with signs (``has_signs``), of complex records, are read by :data:`SIGNED_READING`.
    Without a Doppler segment, ``doppler=None``, others are read by :data:`FAR_READING`, or by
    :data:`FAST_READING` where a
    fast target is ``two_beat_assumption``. With it there are two unknowns and three peaks: every
    reading (each
    peak as it stands or folded at Nyquist, half sum or half difference being the Doppler frequency)
    predicts the third peak. The reading that predicts it best is taken, a fold counting as
    :data:`FOLD_PENALTY_BINS` bins of mismatch. The sign of down - up is the velocity's.

    PHYSICS section 2 gives the unfolded readings. Half sum and half difference belong to the
    carrier and to the range at mid-chirp; this is corrected here.
    """
    if has_signs or doppler is None:
        reading = (
            SIGNED_READING
            if has_signs
            else FAST_READING
            if two_beat_assumption == FAST_TARGET
            else FAR_READING
        )
        f_d, f_r = read_beats(reading, up, down, sample_rate)
        return RangeVelocity(*range_velocity_of_beats(f_d, f_r, carrier, bandwidth, duration))
    start_carrier_ratio = carrier / (
        carrier + bandwidth / 2
    )  # the Doppler segment's carrier is lower
    least_cost, f_d, f_r = np.array(np.inf), np.zeros(()), np.zeros(())
    for reading in range(N_READINGS):
        doppler_beat, range_beat = read_beats(reading, up, down, sample_rate)
        unfolded_peak = sample_rate - doppler if reading & 4 else doppler
        n_folds = (reading >> 3 & 1) + (reading >> 2 & 1) + (reading >> 1 & 1)
        cost = abs(abs(doppler_beat) * start_carrier_ratio - unfolded_peak) + n_folds * (
            FOLD_PENALTY_BINS * bin_width
        )
        is_better = cost < least_cost
        least_cost, f_d, f_r = (
            np.where(is_better, new, old)
            for new, old in ((cost, least_cost), (doppler_beat, f_d), (range_beat, f_r))
        )
    return RangeVelocity(*range_velocity_of_beats(f_d, f_r, carrier, bandwidth, duration))


def fit_range_velocity(
    peaks: np.ndarray,
    *,
    weights: np.ndarray,
    carriers: np.ndarray,
    chirp_rates: np.ndarray,
    sample_rate: np.ndarray,
    bin_width: np.ndarray,
    has_signs: bool = False,
    two_beat_assumption: str = FAR_TARGET,
) -> RangeVelocity:
    """Range and velocity by weighted least squares over the peaks of two or more segments.

    A segment's beat is linear in the Doppler ratio beta and in x = tau (1 + beta),

        f_i = carrier_i beta - rate_i x,

    and every assignment of signs (and folds at Nyquist) to the peaks gives a fit. Of three peaks or
    more that of the least misfit is taken, of those whose range is not negative, a fold counting as
    :data:`FOLD_PENALTY_BINS` bins. Two peaks fit whatever their signs, and an assumption decides:

    - ``far``: the range beat exceeds the Doppler shift in every chirp, so that a beat has the
      sign opposite to its chirp rate; that of a segment without a chirp is positive (closing);
    - ``fast``: the Doppler shift exceeds every range beat, so that all beats have one sign, that
      which makes the range positive.

    Peaks with signs (``has_signs``), of complex records, are known but for whole sample rates. The
    two
    segments of rates furthest apart give the least range that is not negative, and a Doppler shift
    within half the sample rate.

    Peaks [Hz], inverse variances in any unit (``weights``, 0 for a segment that is not detected),
    carriers [Hz] and signed chirp rates [Hz/s] are (k, n). To refer results to the start of the
    shot, add to a carrier its rate times the time of its record. nan where segments of less than
    two different chirp rates are detected.
    """
    shape = np.shape(peaks)
    carriers, chirp_rates, weights = (
        np.broadcast_to(v, shape) for v in (carriers, chirp_rates, weights)
    )
    sample_rate, bin_width = (np.broadcast_to(v, shape[1:]) for v in (sample_rate, bin_width))
    solutions = np.full((2, *shape[1:]), np.nan)
    is_used = (weights > 0) & np.isfinite(peaks)
    patterns, pattern_of_point = np.unique(is_used, axis=1, return_inverse=True)
    for pattern_index, pattern in enumerate(patterns.T):
        has_pattern = np.ravel(pattern_of_point) == pattern_index
        used_peaks, used_weights, used_carriers, used_rates = (
            v[np.ix_(pattern, has_pattern)] for v in (peaks, weights, carriers, chirp_rates)
        )
        if pattern.sum() < 2 or not np.all(np.ptp(used_rates, axis=0) > 0):
            continue
        used_weights = used_weights / used_weights.max(axis=0)  # products of two do not vanish
        solve_beats = _solve_signed_beats if has_signs else _solve_unsigned_beats
        solutions[:, has_pattern] = solve_beats(
            used_peaks,
            used_weights,
            used_carriers,
            used_rates,
            sample_rate[has_pattern],
            bin_width[has_pattern],
            two_beat_assumption,
        )
    beta, x = solutions
    return RangeVelocity(SPEED_OF_LIGHT * x / (2 * (1 + beta)), SPEED_OF_LIGHT * beta / 2)


def _solve_beats(
    beats: np.ndarray, weights: np.ndarray, carriers: np.ndarray, chirp_rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Doppler ratio beta and x [s] of signed beats (k, n)."""
    # The determinant of the normal equations as a sum over pairs: nothing cancels.
    segment_pairs = [(i, j) for i in range(len(beats)) for j in range(i)]
    pair_weights = [weights[i] * weights[j] for i, j in segment_pairs]
    determinants = [
        carriers[j] * chirp_rates[i] - carriers[i] * chirp_rates[j] for i, j in segment_pairs
    ]
    beta_numerators = [
        beats[j] * chirp_rates[i] - beats[i] * chirp_rates[j] for i, j in segment_pairs
    ]
    x_numerators = [carriers[i] * beats[j] - carriers[j] * beats[i] for i, j in segment_pairs]
    total = sum(w * m * m for w, m in zip(pair_weights, determinants, strict=True))
    with np.errstate(invalid="ignore"):  # carriers of 0 tell no velocity
        beta, x = (
            sum(w * m * v for w, m, v in zip(pair_weights, determinants, numerators, strict=True))
            / total
            for numerators in (beta_numerators, x_numerators)
        )
    return beta, x


def range_velocity_response(
    beats: np.ndarray, *, weights: np.ndarray, carriers: np.ndarray, chirp_rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Change of the fitted range [m] and radial velocity [m/s] by a change of the beats.

    Changes of the signed beats [Hz] and the rest are (k, n), as of :func:`fit_range_velocity`; 0
    where beats tell nothing.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        beta, x = _solve_beats(beats, weights, carriers, chirp_rates)
    ranges, velocities = (
        np.where(np.isfinite(value), SPEED_OF_LIGHT / 2 * value, 0.0) for value in (x, beta)
    )
    return ranges, velocities


def _solve_unsigned_beats(  # type: ignore[no-untyped-def]  # seven arrays and a word
    peaks, weights, carriers, chirp_rates, sample_rate, bin_width, two_beat_assumption
):
    """(beta, x) of unsigned, folded peaks, by the assignment of signs that fits best."""
    n_peaks = len(peaks)
    least_cost, solutions = np.full(peaks.shape[1:], np.inf), np.full((2, *peaks.shape[1:]), np.nan)
    delay_min = -bin_width / np.abs(chirp_rates).max(axis=0)  # a range of less than 0 by rounding
    for signs in product((1, -1), repeat=n_peaks):
        for folds in product((0, 1), repeat=n_peaks) if n_peaks > 2 else ((0,) * n_peaks,):
            sign, is_folded = np.reshape(signs, (-1, 1)), np.reshape(folds, (-1, 1))
            beats = sign * np.where(is_folded == 1, sample_rate - peaks, peaks)
            beta, x = _solve_beats(beats, weights, carriers, chirp_rates)
            misfit = carriers * beta - chirp_rates * x - beats
            cost = np.sqrt((weights * misfit**2).sum(axis=0) / weights.sum(axis=0)) / bin_width
            cost = np.where(x < delay_min, np.inf, cost + FOLD_PENALTY_BINS * sum(folds))
            if n_peaks == 2:
                # Where none keeps to what is assumed the first that does but for its range.
                matches_far = (sign == np.where(chirp_rates == 0, 1, -np.sign(chirp_rates))).all(
                    axis=0
                )
                keeps_assumption = (
                    matches_far
                    if two_beat_assumption == FAR_TARGET
                    else np.full(matches_far.shape, len({*signs}) == 1)
                )
                cost = np.where(keeps_assumption, np.where(x < delay_min, 1e300, 0.0), np.inf)
            is_better = cost < least_cost
            least_cost = np.where(is_better, cost, least_cost)
            solutions = np.where(is_better, (beta, x), solutions)
    return solutions


def _solve_signed_beats(  # type: ignore[no-untyped-def]  # seven arrays and a word
    peaks, weights, carriers, chirp_rates, sample_rate, bin_width, two_beat_assumption
):
    """(beta, x) of peaks with signs, known but for whole sample rates."""
    point_index = np.arange(peaks.shape[1])
    lowest_segment, highest_segment = chirp_rates.argmin(axis=0), chirp_rates.argmax(axis=0)
    beat_difference = (
        peaks[lowest_segment, point_index] - peaks[highest_segment, point_index]
    ) / sample_rate
    beat_difference = (
        beat_difference - np.floor(beat_difference + NEGATIVE_BEAT_FRACTION_MAX)
    ) * sample_rate
    x = beat_difference / (
        chirp_rates[highest_segment, point_index] - chirp_rates[lowest_segment, point_index]
    )
    rate_fraction = (
        peaks[highest_segment, point_index] + chirp_rates[highest_segment, point_index] * x
    ) / sample_rate
    doppler_beat = (rate_fraction - np.floor(rate_fraction + 0.5)) * sample_rate
    n_sample_rates = np.rint((doppler_beat - chirp_rates * x - peaks) / sample_rate)
    return _solve_beats(peaks + n_sample_rates * sample_rate, weights, carriers, chirp_rates)
