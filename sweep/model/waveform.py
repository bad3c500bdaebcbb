"""Waveform and its segments: beat frequencies, phases, and range and velocity from a set of peaks.

Homodyne beat phase of a segment, for the delay tau(t) = tau_0 - beta t with beta = 2 v_r / c
(docs/physics.md, *Beats*):

    psi(t) = 2 pi [ -f_seg tau(t) + s S ( tau(t)^2 / 2 - t tau(t) ) ],   s = +1, 0, -1

Its terms up to t give one line per segment:

    phase at t = 0   -f_seg tau_0 + s S tau_0^2 / 2          [cycles]
    beat             f_seg beta - s S tau_0 (1 + beta)       [Hz, signed]

f_seg is the optical frequency at the segment's start: c/lambda for the up-chirp and the Doppler
segment, c/lambda + B for the down-chirp. To leading order the beats are f_d - f_r, f_d and f_d +
f_r with f_d = 2 v_r / lambda and f_r = S 2 R / c [T 2.8]. The further terms move the down beat of
Table 4.1 by 0.2 bins at 150 m/s. The terms in t^2 are range walk, a separate effect. In [T] each
segment starts with the target at range R; motion between segments is another effect.

A shot has an up- and a down-chirp, in either order, and may have a Doppler segment before, between
or after them. All segments have the same duration, with equal gaps. Two beats of real records give
both unknowns only with an assumption (docs/physics.md, *A segment that is missed*). Complex records
keep the sign of each beat.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.constants import SPEED_OF_LIGHT

_FloatOrArray = TypeVar("_FloatOrArray", float, np.ndarray)

SEGMENT_NAMES = ("up", "doppler", "down")
"""Names of the three segments, in the order of rows in arrays that have a row per segment."""
SEGMENT_ORDER_PATH = "instrument.chirp.segments"
"""Parameter path of the names of a shot's segments in the order of time, one of `SEGMENT_ORDERS`.
"""
SEGMENT_GAP_PATH = "instrument.chirp.gap"
"""Parameter path of the time between the end of a segment and the start of the next one [s]."""
SEGMENT_ORDERS = (
    "up doppler down", "up down", "down up", "down doppler up", "doppler up down",
    "doppler down up", "up down doppler", "down up doppler",
)  # fmt: skip
"""Possible sequences of a shot's segments, in the order of time."""
DOPPLER_CHIRP_RATE_RATIO_PATH = "instrument.chirp.doppler_slope"
"""Parameter path of the chirp rate of the Doppler segment, relative to that of the up-chirp."""
DOWN_CHIRP_RATE_RATIO_PATH = "instrument.chirp.down_slope"
"""Parameter path of the chirp rate of the down segment, relative to that of the up-chirp."""
SHOT_DETECTION_PATH = "instrument.processing.shot_detection"
"""Parameter path of the rule by which a shot is detected, one of `SHOT_DETECTION_OPTIONS`."""
BOTH_CHIRPS, ANY_TWO = SHOT_DETECTION_OPTIONS = ("both_chirps", "any_two")
"""Names of the rules by which a shot counts as detected: both chirps detect the echo, or any two
segments do."""
TWO_BEAT_ASSUMPTION_PATH = "instrument.processing.two_beats"
"""Parameter path of the assumption by which range and velocity follow from two beats of unknown
sign, one of `TWO_BEAT_ASSUMPTIONS`."""
REPORTED_PEAKS_PATH = "instrument.processing.peaks"
"""Parameter path of the option for which peaks a segment reports, one of `REPORTED_PEAKS_OPTIONS`.
"""
ALL_PEAKS, STRONGEST_PEAK = REPORTED_PEAKS_OPTIONS = ("all", "strongest")
"""Names of the options for which peaks a segment reports: all above the threshold, or only the
strongest."""
FAR_TARGET, FAST_TARGET = TWO_BEAT_ASSUMPTIONS = ("far", "fast")
"""Names of the assumptions that resolve two beats of unknown sign: the range beat exceeds the
Doppler shift (``far``), or the Doppler shift exceeds the range beat (``fast``)."""
DEFAULT_CHIRP_RATE_RATIOS = (1, 0, -1)
"""Default chirp rates of up, Doppler and down segment, each relative to that of the up-chirp."""
WAVEFORM_DEFAULTS: dict[str, float | int | str | np.ndarray] = {
    SEGMENT_ORDER_PATH: SEGMENT_ORDERS[0],
    SEGMENT_GAP_PATH: 0.0,
    DOPPLER_CHIRP_RATE_RATIO_PATH: 0.0,
    DOWN_CHIRP_RATE_RATIO_PATH: -1.0,
    SHOT_DETECTION_PATH: BOTH_CHIRPS,
    TWO_BEAT_ASSUMPTION_PATH: FAR_TARGET,
    REPORTED_PEAKS_PATH: ALL_PEAKS,
}
"""Default values of the waveform's parameters, by dotted path."""

SEARCH_PREFIX = "instrument.processing.search."
"""Common beginning of the dotted paths of the search band's parameters."""
SEARCH_RANGE_LIMIT_PATHS = SEARCH_PREFIX + "min_range", SEARCH_PREFIX + "max_range"
"""Parameter paths of the smallest and the largest range at which echoes are searched [m]."""
SEARCH_VELOCITY_LIMIT_PATHS = (
    SEARCH_PREFIX + "min_radial_velocity",
    SEARCH_PREFIX + "max_radial_velocity",
)
"""Parameter paths of the smallest and the largest radial velocity of searched echoes [m/s]."""
SEARCH_BAND_PATHS = SEARCH_RANGE_LIMIT_PATHS + SEARCH_VELOCITY_LIMIT_PATHS
"""Parameter paths of the search band's limits in range and velocity. A spec states all four or
none."""


class WaveformSegment(NamedTuple):
    """One segment of a shot's waveform, whose frequency rises, falls or is constant.

    Arrays are (n,) for n points, or scalars.
    """

    name: str
    """Name of the segment, one of :data:`SEGMENT_NAMES`."""
    chirp_rate_ratio: float
    """Chirp rate of the segment, divided by that of the up-chirp. By default it is 1, 0 and -1 for
    the up, Doppler and down segment."""
    chirp_rate: np.ndarray
    """Signed chirp rate of the segment [Hz/s]."""
    carrier: np.ndarray
    """Frequency at the segment's start [Hz], optical unless detection is direct. Times a delay, it
    gives the echo's phase [cycles]."""
    evaluates_leakage: bool
    """True if leakage is evaluated in this segment: false alarms due to the echo's signal far from
    its line."""
    range_decrease_since_shot_start: np.ndarray | float
    """Decrease of the target's range from the start of the shot to that of the segment [m]."""
    doppler_ratio: np.ndarray | float
    """Doppler ratio 2 v_r / c of the line on the beam's axis at the start of the segment, with the
    radial velocity v_r."""
    start_time: np.ndarray | float
    """Time [s] from the start of the shot to that of the segment; 0 if motion between segments is
    not simulated."""

    def echo_delay(self, range: np.ndarray | float) -> np.ndarray:
        """Return an echo's delay at the segment's start [s], from its range at the shot's start.

        Parameters
        ----------
        range : ndarray or float
            Range at the shot's start [m].
        """
        return np.asarray(2 / SPEED_OF_LIGHT * (range - self.range_decrease_since_shot_start))

    def beat_frequency(self, range: np.ndarray | float) -> np.ndarray:
        """Return the signed beat frequency [Hz] of an echo, from its range [m] at the shot's start.

        Notes
        -----
        f_seg beta - S tau (1 + beta), with the carrier f_seg, the delay tau and the Doppler ratio
        beta at the segment's start, and the segment's signed chirp rate S.
        """
        beat_of_delay = self.chirp_rate * (self.echo_delay(range) * (1 + self.doppler_ratio))
        return self.carrier * self.doppler_ratio - beat_of_delay


class RangeVelocity(NamedTuple):
    """Range and radial velocity of n shots, (n,) each, as computed from peaks of their spectra."""

    range: np.ndarray
    """Range of the target [m]."""
    radial_velocity: np.ndarray
    """Radial velocity of the target [m/s], positive when closing."""


def carrier_frequencies(
    architecture: str, *, wavelength: np.ndarray, start_frequency: np.ndarray,
    bandwidth: np.ndarray, chirp_rate_ratios: Sequence[ArrayLike] = DEFAULT_CHIRP_RATE_RATIOS,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Return the frequency at the start of each segment [Hz]; its product with a delay is a phase.

    Parameters
    ----------
    architecture : str
        Receiver architecture.
    wavelength : ndarray
        Wavelength at the start of the up-chirp [m].
    start_frequency : ndarray
        Radio frequency at the start of the up-chirp [Hz], used with direct detection.
    bandwidth : ndarray
        Bandwidth of the up-chirp [Hz].
    chirp_rate_ratios : sequence
        Ratios of the segments' chirp rates to that of the up-chirp.

    Returns
    -------
    up, doppler, down : ndarray
        Frequencies at the start of each segment [Hz].

    Notes
    -----
    The start of the up-chirp is the lowest frequency of all segments. A falling segment starts
    above it by its own bandwidth. Direct detection chirps the light's power, so the radio frequency
    replaces the optical frequency.
    """
    lowest_frequency = (
        start_frequency if architecture == "direct" else SPEED_OF_LIGHT / np.asarray(wavelength)
    )
    up, doppler, down = (
        lowest_frequency + bandwidth * np.maximum(np.negative(s), 0.0)
        if np.any(np.less(s, 0))
        else lowest_frequency
        for s in chirp_rate_ratios
    )
    return up, doppler, down


def chirp_rate_ratios(parameters: Mapping[str, Any]) -> tuple[float, ...]:
    """Return the chirp rates of up, Doppler and down segment, divided by that of the up-chirp.

    All points share these numbers.
    """
    doppler, down = (
        float(np.ravel(parameters.get(path, WAVEFORM_DEFAULTS[path]))[0])
        for path in (DOPPLER_CHIRP_RATE_RATIO_PATH, DOWN_CHIRP_RATE_RATIO_PATH)
    )
    return 1.0, doppler, down


def existing_segments(architecture: str, segments: str) -> tuple[str, ...]:
    """Return the names of a shot's segments that exist, in the order of time.

    Parameters
    ----------
    architecture : str
        Receiver architecture; with direct detection there is no Doppler segment.
    segments : str
        One of :data:`SEGMENT_ORDERS`.
    """
    all_names = segments.split()
    return tuple(name for name in all_names if name != "doppler" or architecture != "direct")


def segment_starts(
    segment_order: tuple[str, ...], *, duration: np.ndarray, gap: np.ndarray | float = 0.0
) -> tuple[np.ndarray, ...]:
    """Return the times [s] from the shot's start to the starts of the up, Doppler and down segment.

    Parameters
    ----------
    segment_order : tuple of str
        Names of the existing segments, in the order of time.
    duration : ndarray
        Duration of each segment [s].
    gap : ndarray or float
        Time from a segment's end to the next one's start [s].

    Returns
    -------
    tuple of ndarray
        Times [s]; 0 for a segment that does not exist.
    """
    period = np.asarray(duration, float) + gap
    return tuple(
        period * (segment_order.index(name) if name in segment_order else 0)
        for name in SEGMENT_NAMES
    )


def beat_frequency(
    chirp_rate_ratio: float | np.ndarray,
    *,
    carrier: np.ndarray,
    chirp_rate: np.ndarray,
    range: np.ndarray,
    radial_velocity: np.ndarray,
) -> np.ndarray:
    """Return the signed beat frequency of a segment [Hz].

    Parameters
    ----------
    chirp_rate_ratio : float or ndarray
        Ratio s of the segment's chirp rate to that of the up-chirp.
    carrier : ndarray
        Frequency f_seg at the segment's start [Hz].
    chirp_rate : ndarray
        Chirp rate of the up-chirp S = B/T [Hz/s].
    range, radial_velocity : ndarray
        Range [m] and radial velocity [m/s] of the target.

    Notes
    -----
    f_seg beta - s S (2 R / c) (1 + beta), beta = 2 v_r / c.
    """
    doppler_ratio = 2 * radial_velocity / SPEED_OF_LIGHT
    beat_of_delay = chirp_rate_ratio * chirp_rate * round_trip_delay(range) * (1 + doppler_ratio)
    return carrier * doppler_ratio - beat_of_delay


def round_trip_delay(range: _FloatOrArray) -> _FloatOrArray:
    """Return the delay 2 R / c [s] of an echo from a range R [m].

    Notes
    -----
    The quotient is rounded once. :meth:`WaveformSegment.echo_delay` and
    :attr:`sweep.model.shot_settings.TargetState.delay` multiply by 2 / c, which is rounded before,
    and may differ in the last bit.
    """
    return 2 * range / SPEED_OF_LIGHT


TIME_TOLERANCE_SAMPLES = 1e-6
"""Time [sample intervals] by which a sample may lie outside a time limit and still count as inside.
"""


def n_record_samples(parameters: Mapping[str, Any]) -> np.ndarray:
    """Return the number of samples of the record, (n,) int64, from parameters by dotted path.

    It is the lesser of two numbers: the FFT size, and the number of samples from the acquisition
    delay to the chirp's end.
    """
    time_left = (
        parameters["instrument.chirp.duration"]
        - parameters["instrument.processing.acquisition_delay"]
    )
    n_available = np.floor(
        time_left * parameters["instrument.processing.sample_rate"] + TIME_TOLERANCE_SAMPLES
    )
    return np.minimum(parameters["instrument.processing.fft_size"], n_available).astype(np.int64)


def count_samples_before_echo(
    *, delay: np.ndarray, doppler_ratio: np.ndarray | float, record_start: np.ndarray,
    sample_rate: np.ndarray, length: int,
) -> np.ndarray:  # fmt: skip
    """Return the number of samples of a record that are taken before the echo arrives.

    Parameters
    ----------
    delay : ndarray
        Delay tau_0 at the segment's start [s].
    doppler_ratio : ndarray or float
        Doppler ratio beta; the delay changes as tau(t) = tau_0 - beta t.
    record_start : ndarray
        Time from the segment's start to the first sample [s].
    sample_rate : ndarray
        Sample rate [Hz].
    length : int
        Length of the record [samples].

    Returns
    -------
    ndarray of int64
        Number of samples, 0 to `length`. The sample at t holds an echo if t >= tau(t).
    """
    arrival_samples = (
        np.asarray(delay) / (1 + np.asarray(doppler_ratio)) - record_start
    ) * sample_rate
    return np.clip(np.ceil(arrival_samples - TIME_TOLERANCE_SAMPLES), 0, length).astype(np.int64)


def fold_frequency(frequency: np.ndarray, sample_rate: np.ndarray) -> np.ndarray:
    """Return the frequency, from 0 to half the sample rate, at which a real record shows a signal.

    Parameters
    ----------
    frequency : ndarray
        Frequency f of the signal, of either sign, in any unit.
    sample_rate : ndarray
        Sample rate f_s, in the same unit.

    Returns
    -------
    ndarray
        |f - f_s rint(f / f_s)|, in the same unit; rint rounds to the nearest integer.
    """
    return np.abs(frequency - sample_rate * np.rint(frequency / sample_rate))


FOLD_PENALTY_BINS = 4.0
"""Penalty [bins] for readings of the peaks in which a peak is folded at Nyquist. A reading is one
way to read peaks as range beat and Doppler frequency. The penalty is added to the mismatch between
the third peak and its prediction."""

N_POSSIBLE_BEAT_READINGS = 16
"""Number of readings of peaks of unknown sign: ways to read them as range beat and Doppler
frequency. Readings differ in which peaks are folded at Nyquist, and in whether half the sum or half
the difference is the Doppler frequency. :func:`doppler_and_range_beat` defines their numbers."""

FAR_TARGET_READING = 1
"""Number of the reading for far targets in :func:`doppler_and_range_beat`: the range beat exceeds
the Doppler frequency, and no peak is folded at Nyquist. Half the difference of up and down peak is
the Doppler frequency."""

FAST_TARGET_READING = 0
"""Number of the reading for fast targets in :func:`doppler_and_range_beat`: the Doppler frequency
exceeds the range beat, and no peak is folded at Nyquist. Half the sum of up and down peak is the
Doppler frequency."""


SIGNED_BEATS_READING = 16
"""Number of the reading of signed peaks in :func:`doppler_and_range_beat`. Complex records have
signed peaks. The range beat is half the down peak minus half the up peak. The Doppler frequency is
the up peak plus the range beat. Both follow from values modulo the sample rate: range beats are
from 0 to half the sample rate, Doppler frequencies have either sign, up to half of it."""

NEGATIVE_BEAT_FRACTION_MAX = 1 / 64
"""Largest magnitude, relative to the sample rate, at which a negative down peak minus up peak stays
negative. The difference is twice the range beat; rounding of peaks to bins may make it slightly
negative. Larger negative differences are taken modulo the sample rate."""


def doppler_and_range_beat(reading, up, down, sample_rate):  # type: ignore[no-untyped-def]  # of arrays, or compiled
    """Convert the up and down peak to a Doppler frequency and a range beat, by one reading.

    A reading is one of several ways to read the two peaks, which are known up to signs and folds.

    Parameters
    ----------
    reading : int
        Number of the reading. Bits 8, 4 and 2 are set if the up, Doppler and down peak is folded at
        Nyquist. Bit 1 is set if half the difference of the peaks is the Doppler frequency, not half
        the sum. :data:`SIGNED_BEATS_READING` is the number for signed peaks.
    up, down : float or ndarray
        Peak frequencies of up- and down-chirp, in any unit.
    sample_rate : float or ndarray
        Sample rate in the same unit.

    Returns
    -------
    f_d, f_r : float or ndarray
        Signed Doppler frequency, and range beat, in the same unit.
    """
    if reading == SIGNED_BEATS_READING:
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
    """Return the range [m] and radial velocity [m/s] of a range beat and a Doppler frequency.

    Parameters
    ----------
    f_d, f_r : float or ndarray
        Signed Doppler frequency and range beat [Hz], as in :func:`doppler_and_range_beat`.
    carrier, bandwidth, duration : float or ndarray
        Carrier of the up-chirp [Hz], bandwidth [Hz] and duration [s] of a chirp.

    Returns
    -------
    range, radial_velocity : float or ndarray
        Range [m] and radial velocity [m/s].
    """
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
    """Return range and velocity from the peak frequencies of up, Doppler and down segment.

    A reading is one way to read the peaks as range beat and Doppler frequency.

    Parameters
    ----------
    up, doppler, down : ndarray (n,)
        Peak frequencies [Hz], unsigned and folded, or signed with `has_signs`. None for `doppler`
        without a Doppler segment.
    carrier, bandwidth, duration : ndarray
        Carrier of the up-chirp [Hz], bandwidth [Hz] and duration [s] of a chirp.
    sample_rate, bin_width : ndarray
        Sample rate and width of a bin [Hz].
    has_signs : bool
        True for peaks of complex records, which are read by :data:`SIGNED_BEATS_READING`.
    two_beat_assumption : str
        Reading without a Doppler segment: ``far`` is :data:`FAR_TARGET_READING`, ``fast`` is
        :data:`FAST_TARGET_READING`.

    Returns
    -------
    RangeVelocity
        Range [m] and radial velocity [m/s], (n,) each.

    Notes
    -----
    With a Doppler segment there are two unknowns and three peaks. Every reading predicts the third
    peak: each peak is folded at Nyquist or not, and half sum or half difference is the Doppler
    frequency. The reading with the best prediction is chosen, where a fold counts as
    :data:`FOLD_PENALTY_BINS` bins of mismatch. The velocity has the sign of down - up.

    docs/physics.md, *Folding*, explains the readings. Half sum and half difference are those of the
    carrier and the range in the middle of the chirp. Range and velocity are corrected for this.
    """
    if has_signs or doppler is None:
        reading = (
            SIGNED_BEATS_READING
            if has_signs
            else FAST_TARGET_READING
            if two_beat_assumption == FAST_TARGET
            else FAR_TARGET_READING
        )
        f_d, f_r = doppler_and_range_beat(reading, up, down, sample_rate)
        return RangeVelocity(*range_velocity_of_beats(f_d, f_r, carrier, bandwidth, duration))
    start_carrier_ratio = carrier / (
        carrier + bandwidth / 2
    )  # the Doppler segment's carrier is lower
    least_cost, f_d, f_r = np.array(np.inf), np.zeros(()), np.zeros(())
    for reading in range(N_POSSIBLE_BEAT_READINGS):
        doppler_beat, range_beat = doppler_and_range_beat(reading, up, down, sample_rate)
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
    """Fit range and velocity to the peaks of two or more segments by weighted least squares.

    Parameters
    ----------
    peaks : ndarray (k, n)
        Peak frequencies of k segments [Hz].
    weights : ndarray (k, n)
        Inverse variances in any unit; 0 for a segment that is not detected.
    carriers : ndarray (k, n)
        Carriers [Hz]. To refer results to the start of the shot, add to a carrier its chirp rate
        times the time of its record.
    chirp_rates : ndarray (k, n)
        Signed chirp rates [Hz/s].
    sample_rate, bin_width : ndarray
        Sample rate and width of a bin [Hz].
    has_signs : bool
        True for signed peaks of complex records.
    two_beat_assumption : str
        ``far`` or ``fast``, for two peaks without signs.

    Returns
    -------
    RangeVelocity
        Range [m] and radial velocity [m/s], (n,) each; nan where segments of fewer than two
        different chirp rates are detected.

    Notes
    -----
    A segment's beat is linear in the Doppler ratio beta and in x = tau (1 + beta),

        f_i = carrier_i beta - rate_i x,

    and every assignment of signs (and folds at Nyquist) to the peaks gives a fit. With three peaks
    or more, the assignment of least misfit and non-negative range is chosen, a fold counting as
    :data:`FOLD_PENALTY_BINS` bins. Two peaks fit with any signs, and an assumption decides:

    - ``far``: the range beat exceeds the Doppler shift in every chirp. A beat then has the sign
      opposite to its chirp rate; the beat of a segment without a chirp is positive (closing).
    - ``fast``: the Doppler shift exceeds every range beat. All beats then have one sign, the one
      that makes the range positive.

    Signed peaks of complex records are known modulo the sample rate. The two segments whose chirp
    rates differ most determine the smallest non-negative range, and a Doppler shift within half the
    sample rate.
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
        used_weights = used_weights / used_weights.max(axis=0)  # products must not underflow
        fit_peaks = _fit_signed_peaks if has_signs else _fit_unsigned_peaks
        solutions[:, has_pattern] = fit_peaks(
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


def _fit_signed_beats(
    beats: np.ndarray, weights: np.ndarray, carriers: np.ndarray, chirp_rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return Doppler ratio and delay that fit signed beats best, by weighted least squares.

    The fitted equation is beat = carrier * beta - chirp rate * x, with the Doppler ratio beta and
    x = tau (1 + beta) of the delay tau.

    Parameters
    ----------
    beats, weights, carriers, chirp_rates : ndarray (k, n)
        Signed beats [Hz], and arguments of :func:`fit_range_velocity`.

    Returns
    -------
    beta, x : ndarray (n,)
        Doppler ratio, and x [s].
    """
    # The determinant of the normal equations as a sum of squares over pairs, without cancellation.
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
    with np.errstate(invalid="ignore"):  # carriers of 0 determine no velocity
        beta, x = (
            sum(w * m * v for w, m, v in zip(pair_weights, determinants, numerators, strict=True))
            / total
            for numerators in (beta_numerators, x_numerators)
        )
    return beta, x


def range_velocity_response(
    beats: np.ndarray, *, weights: np.ndarray, carriers: np.ndarray, chirp_rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the changes of fitted range and radial velocity that changes of the beats cause.

    Parameters
    ----------
    beats : ndarray (k, n)
        Changes of the signed beats [Hz].
    weights, carriers, chirp_rates : ndarray (k, n)
        As in :func:`fit_range_velocity`.

    Returns
    -------
    range, radial_velocity : ndarray (n,)
        Changes of range [m] and radial velocity [m/s]; 0 where beats do not determine a value.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        beta, x = _fit_signed_beats(beats, weights, carriers, chirp_rates)
    ranges, velocities = (
        np.where(np.isfinite(value), SPEED_OF_LIGHT / 2 * value, 0.0) for value in (x, beta)
    )
    return ranges, velocities


def _fit_unsigned_peaks(  # type: ignore[no-untyped-def]  # seven arrays and a word
    peaks, weights, carriers, chirp_rates, sample_rate, bin_width, two_beat_assumption
):
    """Return Doppler ratio beta and x = tau (1 + beta) that fit peaks of unknown sign best, (2, n).

    tau is the delay [s]. Signs and folds at Nyquist are those that fit best. The parameters are
    those of :func:`fit_range_velocity`; all segments are detected.
    """
    n_peaks = len(peaks)
    least_cost, solutions = np.full(peaks.shape[1:], np.inf), np.full((2, *peaks.shape[1:]), np.nan)
    delay_min = -bin_width / np.abs(chirp_rates).max(axis=0)  # rounding may make a range negative
    for signs in product((1, -1), repeat=n_peaks):
        for folds in product((0, 1), repeat=n_peaks) if n_peaks > 2 else ((0,) * n_peaks,):
            sign, is_folded = np.reshape(signs, (-1, 1)), np.reshape(folds, (-1, 1))
            beats = sign * np.where(is_folded == 1, sample_rate - peaks, peaks)
            beta, x = _fit_signed_beats(beats, weights, carriers, chirp_rates)
            misfit = carriers * beta - chirp_rates * x - beats
            cost = np.sqrt((weights * misfit**2).sum(axis=0) / weights.sum(axis=0)) / bin_width
            cost = np.where(x < delay_min, np.inf, cost + FOLD_PENALTY_BINS * sum(folds))
            if n_peaks == 2:
                # If every assignment with the assumed signs has a negative range, the first of them
                # is taken.
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


def _fit_signed_peaks(  # type: ignore[no-untyped-def]  # seven arrays and a word
    peaks, weights, carriers, chirp_rates, sample_rate, bin_width, two_beat_assumption
):
    """Return Doppler ratio beta and x = tau (1 + beta) that fit signed peaks best, (n,) each.

    tau is the delay [s]. Peaks are known modulo the sample rate. The parameters are those of
    :func:`fit_range_velocity`; all segments are detected.
    """
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
    return _fit_signed_beats(peaks + n_sample_rates * sample_rate, weights, carriers, chirp_rates)
