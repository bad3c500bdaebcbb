"""Complex spectra of shots with noise in every bin, and their detections, draw by draw.

Noise is drawn as the receiver makes it: white Gaussian noise in the record, which is windowed,
padded and transformed. So bins are correlated as window and padding make them, and noise at DC and
Nyquist has its true law. Every sample is addressed by point, draw, segment and position
(:mod:`sweep.model.sampling.philox`).

A real record has bins 0..N/2. A complex record of I and Q has N bins: bin k has the index k + N/2,
and the last bin is a neighbour of the first. Indices of an echo's bins may be below 0 or above N -
1.

The signal has the magnitudes of :func:`sweep.model.spectrum.segment_spectra.segment_spectrum`, with
all effects. If beamlets add as powers, these magnitudes are root mean squares and have no phases.
Each bin of the signal then has the phase of a lone tone at the same position. This is exact for
footprints of less than a bin. In developed speckle the bins of an echo have the amplitudes that the
lines of its footprint make in a draw (:mod:`sweep.model.sampling.speckle_lines`). Its leaked signal
fades with the strongest of these bins. If a shot of a flight has several echoes, each has the
phases of a separate tone, and separate speckle. A phase common to all bins makes no difference in
circular noise and is omitted.

The phase of a laser of Lorentzian line width is a random walk. Each draw has a walk, with a step at
every sample, which rotates the signal's record (:func:`sweep.model.laser_line.beat_phase_noise`).

In several looks (:mod:`sweep.model.detection.looks`) each record has noise and a phase walk of its
own, and its signal follows the moving target. Speckle is common to all looks or separate. Bins are
flagged by the mean of |X|^2, by votes of the records, or by the mean record. The frequency is the
mean of the looks' estimates.

A detector and an estimator of frequency process each segment's spectrum. The detector flags bins of
|X|^2. A segment is detected if any bin that the signal occupies is flagged; with ``peak_bin``, if
the bin is flagged that is strongest without noise and speckle. Adjacent flagged bins form a group.
A group outside the bins that the signal occupies is a false alarm. The estimator receives the
spectrum and the largest bin of the detected group. If all segments are detected, their frequencies
are resolved into range and radial velocity.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import fft

from sweep.model import waveform
from sweep.model.detection.detectors import (
    DETECTORS,
    FIXED_THRESHOLD_KIND,
    Detector,
    SpectrumSettings,
    cached_window_samples,
    main_lobe_half_width,
)
from sweep.model.detection.echo_detection import mark_exempt_bins
from sweep.model.detection.estimators import (
    DETECTOR_PREFIX,
    ESTIMATOR_PREFIX,
    ESTIMATORS,
    Estimator,
    RangeVelocityDeviation,
    beat_frequency_cramer_rao_bound,
    phase_noise_beat_deviation,
    range_velocity_deviation,
)
from sweep.model.detection.looks import COMBINE_BINARY
from sweep.model.detection.sub_bin_interpolation import (
    complex_exponentials,
    estimate_sub_bin_offset,
    interpolator,
)
from sweep.model.evaluation import fit_range_velocity_to_peaks
from sweep.model.laser_line import (
    apparent_line_and_pedestal_power,
    beat_phase_noise,
    n_beat_phase_noise_steps,
)
from sweep.model.preparation import Parameters, Shots
from sweep.model.sampling.draws import DrawCounts
from sweep.model.sampling.philox import (
    STREAM_LASER_PHASE,
    STREAM_RECORD_NOISE,
    to_normals_by_row,
    uniforms,
)
from sweep.model.sampling.speckle_lines import (
    LOOK_DRAW_STRIDE,
    RECORD_LINE_DEVIATION_MAX_CELLS,
    FootprintRecord,
    SpeckleLineGrid,
    SpecklePeaks,
    draw_segment_bin_amplitudes,
    folding_signs,
    speckle_line_grid,
)
from sweep.model.sampling.speckle_wander import MeanSquareErrors, range_velocity_wander_variance
from sweep.model.spectrum.search_band import is_searched
from sweep.model.spectrum.search_restriction import mean_line_positions
from sweep.model.spectrum.segment_spectra import full_segment_spectrum
from sweep.model.window import zero_first_samples

AVERAGED_VALUE_NAMES = (
    "pfa_bin",
    "false_alarms",
    "range_error",
    "radial_velocity_error",
    "squared_range_bound",
    "squared_radial_velocity_bound",
)
"""Names of values that are averaged over draws: the fraction of bins with a false alarm, the number
of false alarms, the errors of range [m] and radial velocity [m/s] (measured minus true), and the
squares of the smallest standard deviations of both [m^2, m^2/s^2]."""


class SpectrumMethods(NamedTuple):
    """Detectors and estimators by name, as a study can select them.

    By default they are those of the package.
    """

    detectors: Mapping[str, Detector] = DETECTORS
    """Detectors by name. A detector is a function that flags bins by their power |X|^2."""
    estimators: Mapping[str, Estimator] = ESTIMATORS
    """Estimators by name. An estimator is a function that computes the position of a peak between
    bins."""


class SegmentSignal(NamedTuple):
    """Spectrum of a segment of a point without noise, with the bins and the frequency of its echo.

    Bins are stated by their index in the spectrum. N is the FFT size.
    """

    spectrum: np.ndarray
    """Complex spectrum without noise [V]. It is (N/2 + 1,) for a real record, (N,) for a complex
    record, with N the FFT size."""
    strongest_bin: int
    """Index of the bin with the largest magnitude. The bins at frequency 0 and Nyquist are excluded
    if the noise of a real record counts as circular in all bins."""
    first_bin: int
    """Index of the first bin of the signal. The signal extends from the first to the last bin with
    at least half the largest magnitude, plus half a main lobe on either side."""
    last_bin: int
    """Index of the last bin of the signal. It is below ``first_bin`` if there is no echo, or if the
    strongest bin is outside the search band."""
    frequency_bins: float
    """Signed frequency [bins] of a pure tone that has the magnitudes of the signal about its
    strongest bin."""
    cnr: float
    """Carrier-to-noise ratio: signal power divided by noise power in the record, before the FFT."""
    segment: int
    """Number of the segment: 0 up, 1 Doppler, 2 down."""
    nearest_echo: np.ndarray | None = None
    """(bins,) int64: number of the echo nearest to each bin, if a shot has several; None for a
    single echo."""
    multiple_echo_peaks: "EchoPeaks | None" = None
    """Strongest bins and positions of the echoes, if a shot has several; None for a single echo."""
    echo_half_width: int = 0
    """Number of bins, on either side of an echo's strongest bin, that belong to the echo, if a shot
    has several echoes."""
    footprint_records: tuple[FootprintRecord, ...] | None = None
    """One :class:`FootprintRecord` for each echo, from which the echo's speckle is drawn. It is
    None until :func:`add_footprint_records` sets it. It is empty if speckle is drawn without
    records: for lines that spread over more than RECORD_LINE_DEVIATION_MAX_CELLS, and for an echo
    without samples in the segment."""
    record_scalings: tuple[np.ndarray, ...] = ()
    """One array (bins,) complex for each echo. It times the transform of a drawn record is the
    speckle by which ``spectrum`` is multiplied."""
    is_exempt: np.ndarray | None = None
    """(bins,) bool: True for bins that cannot raise a false alarm. They are ``first_bin`` to
    ``last_bin``, bins of signal at or above the threshold, and the neighbours of these bins
    (:func:`sweep.model.detection.echo_detection.mark_exempt_bins`)."""


class EchoPeaks(NamedTuple):
    """Strongest bins and positions of k echoes in a segment."""

    strongest_bin: np.ndarray
    """(k,) int64: index of the strongest bin of each of k echoes."""
    tone_position: np.ndarray
    """(k,): position, as a fractional index, of a pure tone that has the magnitudes of the echo
    about its strongest bin."""


class EchoBinRange(NamedTuple):
    """Bins of an echo whose speckle is drawn.

    Bins are stated by their index in the spectrum.
    """

    strongest_bin: int
    """Index of the strongest bin of the echo."""
    middle_position: float
    """Position of the middle of the echo, as a fractional index in the spectrum."""
    first_bin: int
    """Index of the first bin whose speckle is drawn."""
    last_bin: int
    """Index of the last bin whose speckle is drawn."""


def noiseless_signal(
    shots: Shots, point: int, segment: int, echo_bins: Sequence[int] | np.ndarray = (),
    fixed_threshold: float = math.inf,
) -> SegmentSignal:  # fmt: skip
    """Return the spectrum of a segment of a point without noise, and the bins of its echoes.

    Parameters
    ----------
    shots
        Prepared shots.
    point
        Index of the point.
    segment
        The segment: 0 up, 1 Doppler, 2 down.
    echo_bins
        Indices of the strongest bins of the echoes, if several surfaces return an echo.
    fixed_threshold
        Threshold [V] of the detector, if it is fixed; bins that reach it raise no false alarm.
    """
    magnitude = full_segment_spectrum(shots, point, segment)
    if (phase_noise_arguments := _phase_noise_arguments(shots, point))[
        "line_width"
    ] > 0:  # magnitude before the phase walk, which draws apply
        echo_window = shots.window
        if shots.echo_record.n_samples_before_echo is not None:
            echo_window = zero_first_samples(
                echo_window, int(shots.echo_record.n_samples_before_echo[0, point])
            )
        (line_power_fraction, *_), *_ = apparent_line_and_pedestal_power(
            window=echo_window, looks=shots.looks.n_coherent, **phase_noise_arguments
        )
        magnitude = magnitude / math.sqrt(line_power_fraction)
    window, last_index = shots.window, magnitude.size - 1
    margin = (
        0 if shots.fft_size_if_end_bins_real or shots.complex_record else 1
    )  # omits DC and Nyquist
    strongest_bin = int(np.clip(np.argmax(magnitude), margin, last_index - margin))
    if not magnitude[strongest_bin] > 0:
        peak_position = float(strongest_bin - zero_frequency_index(shots))
        no_bins = np.zeros(magnitude.size, bool)
        return SegmentSignal(
            magnitude.astype(complex),
            strongest_bin,
            1,
            0,
            peak_position,
            0.0,
            segment,
            is_exempt=no_bins,
        )
    peak_position = _interpolate_tone_position(shots, magnitude, strongest_bin)
    shift = centring_shift(shots, strongest_bin)
    bins_above_half = (
        np.flatnonzero(
            rotate_to_centre(shots, magnitude, strongest_bin) >= 0.5 * magnitude[strongest_bin]
        )
        - shift
    )
    lobe_half_width = math.ceil(main_lobe_half_width(window) * shots.fft_size / window.length)
    energy = (magnitude**2).sum()
    if not shots.complex_record:  # add the energy at negative frequencies
        energy = 2 * energy - magnitude[0] ** 2 - magnitude[-1] ** 2
    signal_power = energy / (
        shots.fft_size * max(float(shots.echo_window_energy(segment)[point]), 1e-300)
    )
    echo_margin = max(
        lobe_half_width, int(shots.bin_thresholds.pedestal_reach_bins[point])
    )  # bins where the echo's pedestal exceeds the noise
    first_bin, last_bin = (
        int(bins_above_half[0]) - echo_margin,
        int(bins_above_half[-1]) + echo_margin,
    )
    if not shots.complex_record:
        first_bin, last_bin = max(first_bin, margin), min(last_bin, last_index - margin)
    first_sample = (
        0
        if shots.echo_record.n_samples_before_echo is None
        else int(shots.echo_record.n_samples_before_echo[segment, point])
    )
    phases = _tone_phases(peak_position, shots, first_sample)
    if (
        bins_above_half[-1] - bins_above_half[0] > lobe_half_width
    ):  # wider than a tone: phases step evenly, as in a main lobe
        bin_offset = np.arange(first_bin, last_bin + 1) - strongest_bin
        phases[(strongest_bin + bin_offset) % phases.size] = phases[strongest_bin] * np.exp(
            -1j * np.pi * bin_offset * ((window.length + first_sample) / shots.fft_size)
        )
    if not is_searched(shots, segment, point, strongest_bin - zero_frequency_index(shots)):
        first_bin, last_bin = 1, 0
    nearest_echo, multiple_echo_peaks = None, None
    if len(echo_bins) > 1:
        bin_offset = np.arange(magnitude.size)[:, None] - np.asarray(echo_bins)
        if shots.complex_record:
            bin_offset -= shots.fft_size * np.rint(bin_offset / shots.fft_size).astype(np.int64)
        nearest_echo = np.abs(bin_offset).argmin(axis=1)
        multiple_echo_peaks = EchoPeaks(
            np.asarray(echo_bins),
            np.array(
                [
                    _interpolate_tone_position(shots, magnitude, int(strongest_bin))
                    for strongest_bin in echo_bins
                ]
            ),
        )
        for echo_number, echo_bin in enumerate(echo_bins):
            if (echo_bin - first_bin) % magnitude.size > last_bin - first_bin:
                echo_position = _interpolate_tone_position(shots, magnitude, int(echo_bin))
                phases = np.where(
                    nearest_echo == echo_number,
                    _tone_phases(echo_position, shots, first_sample),
                    phases,
                )
    return SegmentSignal(
        spectrum=magnitude * phases,
        strongest_bin=strongest_bin,
        first_bin=first_bin,
        last_bin=last_bin,
        frequency_bins=peak_position - zero_frequency_index(shots),
        cnr=float(signal_power / shots.noise_variance[point]),
        segment=segment,
        nearest_echo=nearest_echo,
        multiple_echo_peaks=multiple_echo_peaks,
        echo_half_width=lobe_half_width,
        is_exempt=_exempt_bin_mask(
            shots, magnitude, strongest_bin, first_bin, last_bin, fixed_threshold
        ),
    )


def _exempt_bin_mask(
    shots: Shots,
    magnitude: np.ndarray,
    strongest_bin: int,
    first_bin: int,
    last_bin: int,
    fixed_threshold: float,
) -> np.ndarray:
    """Return a mask (bins,) of the bins of a segment that cannot raise a false alarm.

    These are the bins of the echo, bins of signal at or above the threshold, and their neighbours.

    Parameters
    ----------
    shots
        Prepared shots.
    magnitude
        (bins,): |X| without noise [V].
    strongest_bin, first_bin, last_bin
        Strongest bin, and the bins that the signal occupies. If `last_bin` is below `first_bin`, no
        bin is exempt.
    fixed_threshold
        Threshold [V] of the detector, if it is fixed.
    """
    is_exempt = np.zeros(magnitude.size, bool)
    if last_bin < first_bin:
        return is_exempt
    centred_magnitude = rotate_to_centre(shots, magnitude, strongest_bin)
    is_marked = np.zeros(centred_magnitude.size, bool)
    mark_exempt_bins(
        centred_magnitude,
        centred_magnitude.size,
        fixed_threshold,
        is_marked,
        shots.detection_rule.lobe_half_width,
    )
    if shots.complex_record:
        is_marked = np.roll(is_marked[1:-1], 1 - centring_shift(shots, strongest_bin))
    is_exempt[np.arange(first_bin, last_bin + 1) % is_exempt.size] = True
    return is_exempt | is_marked


def zero_frequency_index(shots: Shots) -> int:
    """Return the index of the bin at frequency 0 in a spectrum of these shots."""
    return int(shots.bin_indices(np.zeros((), int)))


def centring_shift(shots: Shots, middle_index: int) -> int:
    """Return the number that :func:`rotate_to_centre` adds to the index of a bin.

    Parameters
    ----------
    shots : Shots
        Prepared shots (:class:`sweep.model.preparation.Shots`).
    middle_index : int
        Index of the bin in a spectrum.

    Returns
    -------
    int
        1 + N/2 - ``middle_index`` for a complex record, with the FFT size N. The 1 is for the
        element that is added at the lower end. 0 for a real record.
    """
    return 1 + shots.fft_size // 2 - middle_index if shots.complex_record else 0


def rotate_to_centre(shots: Shots, values: np.ndarray, middle_index: int) -> np.ndarray:
    """Return the bins of a complex record's spectrum, rotated until a given bin is in the middle.

    Bins about the given bin are then adjacent, although the first bin of the spectrum follows its
    last. A 0 is added at either end, where a real record has frequency 0 and Nyquist. The bins of a
    real record are returned unchanged.

    Parameters
    ----------
    shots
        Prepared shots.
    values
        (..., bins): any values of the bins of a spectrum.
    middle_index
        Index of the bin that is moved to the middle.
    """
    if not shots.complex_record:
        return values
    values = np.roll(values, centring_shift(shots, middle_index) - 1, axis=-1)
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(1, 1)])


def _interpolate_tone_position(shots: Shots, magnitude: np.ndarray, peak_index: int) -> float:
    """Return the position of a peak between bins, as a fractional index.

    The position is that of a pure tone that has the magnitudes of the three bins about the peak.
    ``magnitude`` (bins,) is |X|, and ``peak_index`` the index of the peak's largest bin.
    """
    last_index = magnitude.size - 1
    if shots.complex_record:
        below, above = magnitude[peak_index - 1], magnitude[(peak_index + 1) % magnitude.size]
    else:
        below, above = (
            magnitude[abs(peak_index - 1)],
            magnitude[min(peak_index + 1, 2 * last_index - peak_index - 1)],
        )
    return peak_index + estimate_sub_bin_offset(
        below, magnitude[peak_index], above, interpolator(shots.window, shots.fft_size)
    )


def _tone_phases(position: float, shots: Shots, first_sample: int) -> np.ndarray:
    """Return X / |X| (bins,) of the spectrum X of a pure tone; 1 where X is 0.

    The tone has a ``position``, as a fractional index, and begins with sample ``first_sample``.
    """
    fft_size = shots.fft_size
    cycles = (position - zero_frequency_index(shots)) / fft_size
    record = cached_window_samples(shots.window) * complex_exponentials(
        -cycles, shots.window.length
    )
    record[:first_sample] = 0.0
    tone = transform_record(shots, record if shots.complex_record else record.real)
    magnitude = np.abs(tone)
    return np.where(magnitude > 0, tone / np.where(magnitude > 0, magnitude, 1.0), 1.0)


def transform_record(shots: Shots, record: np.ndarray) -> np.ndarray:
    """Transform a windowed record to a complex spectrum.

    The spectrum is X[k] = sum_n x[n] exp(-2 pi i k n / N), without a factor 1/N, with the FFT size
    N. The record x of L samples is padded with zeros to N.

    Parameters
    ----------
    shots : Shots
        Prepared shots, for FFT size and type of record (:class:`sweep.model.preparation.Shots`).
    record : ndarray (L,)
        Samples times the window, such as voltages [V]. They are real for a real record.

    Returns
    -------
    ndarray (bins,) complex
        Spectrum, in the unit of the samples summed over the record: bins 0..N/2 of a real record,
        or all N bins of a complex record, lowest frequency first.
    """
    if shots.complex_record:
        return np.asarray(fft.fftshift(fft.fft(record, shots.fft_size)))
    return np.asarray(fft.rfft(record, shots.fft_size))


def _phase_noise_arguments(shots: Shots, point: int) -> dict[str, np.ndarray]:
    """Return the quantities of a point from which its phase noise follows, by name.

    The names are ``line_width`` (of the laser [Hz]), ``delay`` (of the echo [s]) and ``duration``
    (of the record [s]).
    """
    return {
        "line_width": _value_of_point(shots.laser_line.lorentzian_fwhm, point),
        "delay": waveform.round_trip_delay(_value_of_point(shots.range, point)),
        "duration": _value_of_point(shots.record.duration, point),
    }


def draw_signal_spectra(
    shots: Shots,
    point: int,
    segment: int,
    signal: SegmentSignal,
    *,
    key: np.ndarray,
    draws: np.ndarray,
) -> np.ndarray:
    """Draw complex spectra (m, bins) of the signal [V] with the laser's phase noise.

    No receiver noise is added. If the laser has no line width, all draws are equal, and the result
    has one row.

    Parameters
    ----------
    shots, point, segment
        Prepared shots, index of the point, and segment.
    signal
        Signal of the segment.
    key
        (2,) uint64: random key of the point.
    draws
        (m,) int64: numbers of the draws.
    """
    phase_noise_arguments, sample_rate = (
        _phase_noise_arguments(shots, point),
        float(_value_of_point(shots.sample_rate, point)),
    )
    if not phase_noise_arguments["line_width"] > 0:
        return signal.spectrum[None]
    record_length, fft_size = shots.window.length, shots.fft_size
    delay_samples = float(phase_noise_arguments["delay"]) * sample_rate
    analytic_spectrum = np.zeros(fft_size, complex)  # spectrum of the analytic record
    if shots.complex_record:
        analytic_spectrum = fft.ifftshift(signal.spectrum)
    else:
        analytic_spectrum[: fft_size // 2 + 1] = 2 * signal.spectrum
        analytic_spectrum[[0, fft_size // 2]] /= 2
    record = fft.ifft(analytic_spectrum)[:record_length]
    phase_variance_per_sample, spectra = (
        2 * math.pi * float(phase_noise_arguments["line_width"]) / sample_rate,
        [],
    )
    for draw in draws:
        uniform_numbers = uniforms(
            key[None], draw[None], STREAM_LASER_PHASE[segment],
            n_beat_phase_noise_steps(delay=delay_samples, length=record_length),
        )  # fmt: skip
        # The initial phase of a record matters only if looks are added in amplitude.
        phase = beat_phase_noise(
            to_normals_by_row(uniform_numbers)[0],
            variance_per_sample=phase_variance_per_sample,
            delay=delay_samples,
            from_first_sample=shots.looks.n_coherent > 1,
        )
        rotated_record = record * np.exp(1j * phase)
        spectra.append(
            transform_record(shots, rotated_record if shots.complex_record else rotated_record.real)
        )
    return np.array(spectra)


def draw_noise_spectra(
    shots: Shots, point: int, segment: int, *, key: np.ndarray, draws: np.ndarray
) -> np.ndarray:
    """Draw complex spectra (m, bins) of a segment's noise alone [V].

    Parameters
    ----------
    shots, point, segment
        Prepared shots, index of the point, and segment.
    key
        (2,) uint64: random key of the point.
    draws
        (m,) int64: numbers of the draws.
    """
    record_length, stream = shots.window.length, STREAM_RECORD_NOISE[segment]
    keys = np.broadcast_to(key, (draws.size, 2))
    n_numbers = 2 * record_length if shots.complex_record else record_length + record_length % 2
    record = to_normals_by_row(uniforms(keys, draws, stream, n_numbers))
    if shots.complex_record:  # I and Q, each with half of the noise variance
        record = (record[:, :record_length] + 1j * record[:, record_length:]) * math.sqrt(0.5)
    record = (
        record[:, :record_length]
        * math.sqrt(float(shots.noise_variance[point]))
        * cached_window_samples(shots.window)
    )
    # One transform at a time, so that bits do not depend on the number of draws.
    return np.array([transform_record(shots, noise_record) for noise_record in record])


def draw_bin_speckle(
    shots: Shots,
    point: int,
    segment: int,
    signal: SegmentSignal,
    *,
    key: np.ndarray,
    draws: np.ndarray,
    line_grid: SpeckleLineGrid | None = None,
) -> np.ndarray:
    """Draw the complex speckle factors (m, bins) by which the bins of a segment are multiplied.

    In the bins that an echo occupies, the factors follow from the lines of its footprint. The other
    bins of an echo have the factor of its strongest bin. Without speckle the result is (1, 1), with
    the value 1.

    Parameters
    ----------
    shots, point, segment
        Prepared shots, index of the point, and segment.
    signal
        Signal of the segment.
    key
        (2,) uint64: random key of the point.
    draws
        (m,) int64: numbers of the draws.
    line_grid
        Result of :func:`speckle_line_grid` for `shots`; computed if None.
    """
    if shots.speckle.line_gradients is None:
        return np.ones((1, 1))
    line_grid = speckle_line_grid(shots) if line_grid is None else line_grid
    if signal.footprint_records is None:
        signal = add_footprint_records(shots, point, signal, line_grid)
    if signal.footprint_records:
        return _draw_speckle_from_records(shots, signal, key, draws)
    n_bins, zero_index = signal.spectrum.size, zero_frequency_index(shots)
    factors = np.empty((draws.size, n_bins), complex)
    is_real_bin = np.zeros(n_bins, bool)  # the real part alone has all of the power
    is_real_bin[[0, -1]] = shots.fft_size_if_end_bins_real > 0
    echo_bin_ranges = [
        EchoBinRange(
            signal.strongest_bin,
            signal.frequency_bins + zero_index,
            signal.first_bin,
            signal.last_bin,
        )
    ]
    if signal.nearest_echo is not None and signal.multiple_echo_peaks is not None:
        echo_bin_ranges = [
            EchoBinRange(
                int(echo_bin),
                position,
                int(echo_bin) - signal.echo_half_width,
                int(echo_bin) + signal.echo_half_width,
            )
            if (echo_bin - signal.first_bin) % n_bins > signal.last_bin - signal.first_bin
            else EchoBinRange(int(echo_bin), position, signal.first_bin, signal.last_bin)
            for echo_bin, position in zip(*signal.multiple_echo_peaks, strict=True)
        ]
    for echo_number, (strongest_bin, position, first_bin, last_bin) in enumerate(echo_bin_ranges):
        first_bin, last_bin = min(first_bin, strongest_bin - 1), max(last_bin, strongest_bin + 1)
        positions = np.full(3, np.nan)
        positions[segment] = position
        amplitudes = draw_segment_bin_amplitudes(
            line_grid,
            point,
            positions,
            first_bin,
            last_bin - first_bin + 1,
            key=key,
            draws=draws,
            echo_number=echo_number,
        )
        bins_of_echo = (
            slice(None) if signal.nearest_echo is None else signal.nearest_echo == echo_number
        )
        factors[:, bins_of_echo] = amplitudes[:, strongest_bin - first_bin, None]
        bins = np.arange(first_bin, last_bin + 1)
        has_speckle = (amplitudes != 0).any(axis=0)
        if not shots.complex_record:
            has_speckle &= (bins >= 0) & (bins < n_bins)
        if signal.nearest_echo is not None:
            has_speckle &= signal.nearest_echo[bins % n_bins] == echo_number
        bins = bins[has_speckle] % n_bins
        factors[:, bins] = amplitudes[:, has_speckle]
        if (
            shots.fft_size_if_end_bins_real
            and shots.speckle_table.pseudo_variance_row[segment, point] > 0
        ):
            # Refer their phases to the record's middle, as those of the noise are.
            first_sample = (
                0
                if shots.echo_record.n_samples_before_echo is None
                else int(shots.echo_record.n_samples_before_echo[segment, point])
            )
            record_middle_phases = np.exp(
                -1j * np.pi * bins * ((shots.window.length + first_sample) / shots.fft_size)
            )
            magnitude = np.abs(signal.spectrum[bins])
            tone_phases = signal.spectrum[bins] / np.where(magnitude > 0, magnitude, 1.0)
            factors[:, bins] *= (
                record_middle_phases * np.where(magnitude > 0, tone_phases, 1.0).conj()
            )
            is_real_bin[bins] = False
    factors[:, is_real_bin] = math.sqrt(2) * factors[:, is_real_bin].real
    return factors


def add_footprint_records(
    shots: Shots, point: int, signal: SegmentSignal, line_grid: SpeckleLineGrid
) -> SegmentSignal:
    """Return a segment's signal with the records from which its speckle is drawn.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    point : int
        Index of the point.
    signal : SegmentSignal
        Signal of one segment without noise.
    line_grid : SpeckleLineGrid
        Lines that represent the footprints in developed speckle.

    Returns
    -------
    SegmentSignal
        The signal with :attr:`SegmentSignal.footprint_records` and
        :attr:`SegmentSignal.record_scalings`. It has no records where none are needed: without
        developed speckle, for lines that spread too far, and for an echo without samples.
    """
    if shots.speckle.line_gradients is None:
        return signal
    segment, zero_index = signal.segment, zero_frequency_index(shots)
    line_deviation = (
        np.hypot(*line_grid.line_shift_gradient[point, segment])
        * shots.window.length
        / shots.fft_size
    )
    if line_deviation > RECORD_LINE_DEVIATION_MAX_CELLS:
        return signal._replace(footprint_records=())
    first_sample = (
        0
        if shots.echo_record.n_samples_before_echo is None
        else int(shots.echo_record.n_samples_before_echo[segment, point])
    )
    if not cached_window_samples(shots.window)[first_sample:].any():
        return signal._replace(footprint_records=())
    strongest_bins = np.full((1, 3), signal.strongest_bin - zero_index)
    positions = [float(mean_line_positions(shots, np.array([point]), strongest_bins)[0, segment])]
    if signal.multiple_echo_peaks is not None:
        positions = [
            float(position) - zero_index for position in signal.multiple_echo_peaks.tone_position
        ]
    records = tuple(
        FootprintRecord.from_line_grid(
            line_grid, point, segment, position, shots.window, first_sample, shots.fft_size
        )
        for position in positions
    )
    bin_numbers, fft_size = np.arange(signal.spectrum.size) - zero_index, shots.fft_size
    magnitude = np.abs(signal.spectrum)
    conjugate_phase = np.where(magnitude > 0, signal.spectrum, 1.0).conj()
    conjugate_phase = conjugate_phase / np.where(magnitude > 0, magnitude, 1.0)
    scalings = []
    for record in records:
        power = record.mean_bin_power[bin_numbers % fft_size]
        if not shots.complex_record:  # half of the line's amplitude and of its image's
            power = 0.25 * (power + record.mean_bin_power[-bin_numbers % fft_size])
        scalings.append(conjugate_phase / np.sqrt(power))
    return signal._replace(footprint_records=records, record_scalings=tuple(scalings))


def _draw_speckle_from_records(
    shots: Shots, signal: SegmentSignal, key: np.ndarray, draws: np.ndarray
) -> np.ndarray:
    """Draw the complex speckle factors (m, bins) of a segment's bins, from footprint records.

    The record of each echo is a :class:`FootprintRecord`.
    """
    assert signal.footprint_records is not None
    factors = np.empty((draws.size, signal.spectrum.size), complex)
    for echo_number, record in enumerate(signal.footprint_records):
        echo_bins = (
            slice(None) if signal.nearest_echo is None else signal.nearest_echo == echo_number
        )
        for row, draw in enumerate(draws):
            drawn_record = record.draw_speckled_record(key, int(draw), echo_number)
            drawn_record = drawn_record if shots.complex_record else drawn_record.real
            scaling = signal.record_scalings[echo_number]
            factors[row, echo_bins] = (transform_record(shots, drawn_record) * scaling)[echo_bins]
    return factors


def iter_look_spectra(
    point_spectra: "PointSpectra", segment: int, draws: np.ndarray
) -> Iterator[np.ndarray]:
    """Draw and yield the complex noisy spectra of a segment, look by look.

    A look is one record of the segment. If amplitudes of looks are added, only their mean is
    yielded.

    Parameters
    ----------
    point_spectra : PointSpectra
        Signals of a point, with the random key of its draws.
    segment : int
        Index of the segment: up, Doppler, down.
    draws : ndarray (m,) int64
        Numbers of the draws.

    Yields
    ------
    ndarray (m, bins) complex
        Spectra of one look with noise [V, summed over the record].
    """
    looks, look_sum = point_spectra.shots.looks, np.zeros(1, complex)
    for look, shots in enumerate(point_spectra.look_shots):
        look_draws = draws + look * LOOK_DRAW_STRIDE
        draw_arguments = {"key": point_spectra.random_key, "draws": look_draws}
        signal = point_spectra.get_signal_in_look(segment, look)
        factors = _draw_look_speckle(point_spectra, shots, segment, look, draws, signal)
        spectra = (
            draw_signal_spectra(shots, point_spectra.point, segment, signal, **draw_arguments)
            * factors
        )
        spectra = spectra + draw_noise_spectra(
            shots, point_spectra.point, segment, **draw_arguments
        )
        if looks.n_coherent == 1:
            yield spectra
        else:
            look_sum = look_sum + spectra
    if looks.n_coherent > 1:
        yield look_sum / looks.n_coherent


def _draw_look_speckle(
    point_spectra: "PointSpectra",
    shots: Shots,
    segment: int,
    look: int,
    draws: np.ndarray,
    signal: SegmentSignal,
) -> np.ndarray:
    """Draw the complex speckle factors (m, bins) by which the bins of one look are multiplied.

    A look is one record of the segment. Looks have equal, independent or correlated speckle.
    Correlated speckle is a sum of independent realisations, with different coefficients in each
    look.
    """
    draw_arguments: dict[str, Any] = {
        "key": point_spectra.random_key,
        "line_grid": point_spectra.line_grid,
    }
    if shots.speckle.look_speckle is None:
        look_draws = (
            draws + look * LOOK_DRAW_STRIDE if shots.looks.has_independent_speckle else draws
        )
        return draw_bin_speckle(
            shots, point_spectra.point, segment, signal, draws=look_draws, **draw_arguments
        )
    root_row = shots.speckle.look_speckle.covariance_root(segment, point_spectra.point)[look]
    # The mean power of each look is already in its signal.
    root_row = root_row / np.sqrt((np.abs(root_row) ** 2).sum())
    return np.asarray(
        sum(
            coefficient
            * draw_bin_speckle(
                shots,
                point_spectra.point,
                segment,
                signal,
                draws=draws + term * LOOK_DRAW_STRIDE,
                **draw_arguments,
            )
            for term, coefficient in enumerate(root_row)
        )
    )


class PointSpectra(NamedTuple):
    """Noiseless signals of a point, with the detector and estimator for its noisy spectra."""

    shots: Shots
    """Prepared shots."""
    point: int
    """Index of the point in ``shots``."""
    random_key: np.ndarray
    """(2,) uint64: random key of the point."""
    signals: tuple[SegmentSignal | None, ...]
    """Noiseless signal of each segment at the time of ``shots`` (the first look); None for a
    segment that does not exist."""
    look_shots: list[Shots]
    """Prepared shots at the time of each look (record of each segment). The target moves between
    looks."""
    settings: SpectrumSettings
    """Settings of the spectra and of the detector."""
    detect: Detector
    """Detector: a function of powers |X|^2 (m, bins) [V^2] and the settings, which returns a mask
    (m, bins) of flagged bins."""
    estimate: Estimator
    """Estimator of frequency: a function of complex spectra (m, bins), indices of peak bins (m,)
    and the settings, which returns positions (m,) as fractional indices."""
    signal_cache: dict[tuple[int, int], SegmentSignal]
    """Noiseless signals of looks (records of a segment) after the first, by segment and look, as
    far as computed. The target moves between looks."""
    echo_bins: np.ndarray | None = None
    """(3, k) int64: indices of the strongest bins of k echoes in each segment, -1 for no echo. It
    is None for a shot with a single echo."""
    line_grid: SpeckleLineGrid | None = None
    """Lines that represent the footprints of all shots in developed speckle."""
    fixed_threshold: float = math.inf
    """Threshold of the detector [V] if it is fixed; infinite for other detectors."""

    def get_signal_in_look(self, segment: int, look: int) -> SegmentSignal:
        """Return the noiseless signal of a segment at the time of a look.

        A look is one record of the segment. The target moves between looks. Computed signals are
        kept in ``signal_cache``.

        Parameters
        ----------
        segment : int
            Index of the segment: 0 up, 1 Doppler, 2 down.
        look : int
            Index of the look in ``look_shots``.

        Returns
        -------
        SegmentSignal
            The signal (:class:`SegmentSignal`).
        """
        shots, signal = self.look_shots[look], self.signals[segment]
        if shots is self.shots and signal is not None:
            return signal
        if (segment, look) not in self.signal_cache:
            signal = noiseless_signal(
                shots, self.point, segment, self.echo_indices(segment), self.fixed_threshold
            )
            line_grid = speckle_line_grid(shots) if self.line_grid is None else self.line_grid
            self.signal_cache[segment, look] = add_footprint_records(
                shots, self.point, signal, line_grid
            )
        return self.signal_cache[segment, look]

    def echo_indices(self, segment: int) -> np.ndarray:
        """Return the index of each echo's strongest bin in a segment, if there are several echoes.

        The result is empty for a shot with a single echo.
        """
        bins = np.empty(0, np.int64) if self.echo_bins is None else self.echo_bins[segment]
        bins = bins[bins >= 0]
        return self.shots.bin_indices(bins)


class SegmentDetections(NamedTuple):
    """Detections, false alarms and estimated frequency of a segment in m draws, (m,) each."""

    is_detected: np.ndarray
    """(m,) bool: True for draws in which the detector flags a bin of the echo."""
    n_false_groups: np.ndarray
    """(m,) int64: number of false alarms in each draw. A false alarm is a run of adjacent flagged
    bins outside the bins of the echo."""
    n_false_bins: np.ndarray
    """(m,) int64: number of flagged bins in all false alarms of each draw."""
    frequency_bins: np.ndarray
    """(m,): estimated frequency of the echo [bins], signed for a complex record."""
    peak_offset: np.ndarray
    """(m,): estimated position minus the number of the largest bin of the echo's run of flagged
    bins [bins]."""
    peak_power: np.ndarray
    """(m,): |X|^2 [V^2] from which errors due to speckle are computed. It is the larger of two
    powers: the power of the bin that is strongest without noise, and the power of the peak, which
    is limited to the squared threshold."""


def prepare_point_spectra(
    shots: Shots, point: int, parameters: Parameters, key: np.ndarray, methods: SpectrumMethods,
    echo_bins: np.ndarray | None = None, line_grid: SpeckleLineGrid | None = None,
) -> PointSpectra:  # fmt: skip
    """Return the noiseless signals of one point, with the detector and estimator of its parameters.

    Parameters
    ----------
    shots, point
        Prepared shots, and index of the point.
    parameters
        Parameters of the point by dotted path, including those of
        :data:`sweep.model.detection.estimators.SPECTRUM_METHOD_DEFAULTS`.
    key
        (2,) uint64: random key of the point.
    methods
        Detectors and estimators by name.
    echo_bins
        (3, k) int64: strongest bins of the shot's echoes in each segment, -1 for none; None for one
        echo.
    line_grid
        Result of :func:`speckle_line_grid` for `shots`; computed if None.
    """
    training, rank = (
        int(parameters[DETECTOR_PREFIX + "training"]),
        int(parameters[DETECTOR_PREFIX + "rank"]),
    )
    settings = SpectrumSettings(
        fft_size=shots.fft_size,
        sample_rate=float(shots.sample_rate[point]),
        window=shots.window,
        noise_power=float(
            shots.window.energy * shots.noise_variance_without_echo[point] / shots.looks.n_coherent
        ),
        threshold=float(shots.threshold[point]),
        training=training,
        guard=int(parameters[DETECTOR_PREFIX + "guard"]),
        rank=rank or math.ceil(0.75 * training),  # 0: the default, three quarters
        pfa=float(parameters[DETECTOR_PREFIX + "pfa"]),
        complex_record=shots.complex_record,
    )
    line_grid = speckle_line_grid(shots) if line_grid is None else line_grid
    point_spectra = PointSpectra(
        shots,
        point,
        key,
        (),
        shots.split_by_look(),
        settings,
        methods.detectors[str(parameters[DETECTOR_PREFIX + "kind"])],
        methods.estimators[str(parameters[ESTIMATOR_PREFIX + "kind"])],
        {},
        echo_bins,
        line_grid,
        settings.threshold
        if str(parameters[DETECTOR_PREFIX + "kind"]) == FIXED_THRESHOLD_KIND
        else math.inf,
    )
    signals = tuple(
        add_footprint_records(
            shots,
            point,
            noiseless_signal(
                shots, point, s, point_spectra.echo_indices(s), point_spectra.fixed_threshold
            ),
            line_grid,
        )
        if exists
        else None
        for s, exists in enumerate(shots.has_segment)
    )
    return point_spectra._replace(signals=signals)


def flag_detected_bins(
    spectra: Sequence[np.ndarray], point_spectra: PointSpectra, segment: int
) -> tuple[np.ndarray, np.ndarray]:
    """Flag the bins of a segment in which the detector finds a signal, with looks combined.

    A look is one record of the segment.

    Parameters
    ----------
    spectra
        Complex spectra (m, bins) of each look (record of the segment) [V].
    point_spectra
        Point to which the spectra belong.
    segment
        The segment: 0 up, 1 Doppler, 2 down.

    Returns
    -------
    power : ndarray (m, bins)
        Mean of |X|^2 over the looks [V^2].
    is_flagged : ndarray (m, bins) bool
        True for bins that the detector flags and that are searched.
    """
    powers = [spectrum.real**2 + spectrum.imag**2 for spectrum in spectra]
    power = powers[0] if len(powers) == 1 else np.mean(powers, axis=0)
    if point_spectra.shots.looks.combine_kind == COMBINE_BINARY:
        votes = sum(
            np.array(point_spectra.detect(spectrum, point_spectra.settings), np.int64)
            for spectrum in powers
        )
        flags = np.asarray(votes >= point_spectra.shots.looks.votes_needed)
    else:
        flags = np.array(point_spectra.detect(power, point_spectra.settings), bool)
    bins = np.arange(flags.shape[1]) - zero_frequency_index(point_spectra.shots)
    return power, flags & is_searched(point_spectra.shots, segment, point_spectra.point, bins)


def estimate_positions(
    spectra: Sequence[np.ndarray], peak_bins: np.ndarray, point_spectra: PointSpectra
) -> np.ndarray:
    """Return the estimated positions of peaks, averaged over looks (records of a segment).

    Parameters
    ----------
    spectra : sequence of ndarray (m, bins) complex
        Spectra of each look [V].
    peak_bins : ndarray (m,) int64
        Indices of the peaks' bins.
    point_spectra : PointSpectra
        Point to which the spectra belong; it has the estimator and its settings.

    Returns
    -------
    ndarray (m,)
        Positions as fractional indices [bins].
    """
    positions = [
        point_spectra.estimate(spectrum, peak_bins, point_spectra.settings) for spectrum in spectra
    ]
    return positions[0] if len(positions) == 1 else np.asarray(np.mean(positions, axis=0))


def detect_and_estimate_frequency(
    spectra: Sequence[np.ndarray], signal: SegmentSignal, point_spectra: PointSpectra
) -> SegmentDetections:
    """Detect an echo and estimate its frequency in each draw of a segment.

    Parameters
    ----------
    spectra
        Complex spectra (m, bins) of each look (record of the segment) [V].
    signal
        Signal of the segment without noise.
    point_spectra
        Point to which the spectra belong.
    """
    power, flags = flag_detected_bins(spectra, point_spectra, signal.segment)
    shots, shift = point_spectra.shots, centring_shift(point_spectra.shots, signal.strongest_bin)
    power, flags = (
        rotate_to_centre(shots, values, signal.strongest_bin) for values in (power, flags)
    )
    strongest_index, first_index, last_index = (
        k + shift for k in (signal.strongest_bin, signal.first_bin, signal.last_bin)
    )
    bins, end_index = np.arange(power.shape[1]), power.shape[1] - 1
    first_detecting, end_detecting = strongest_index, strongest_index + 1
    if shots.detection_settings.echo_bin_rule == "any_bin" and last_index >= first_index:
        first_detecting, end_detecting = first_index, last_index + 1
        if not shots.fft_size_if_end_bins_real:
            first_detecting, end_detecting = max(first_detecting, 1), min(end_detecting, end_index)
    signed_peak = signal.strongest_bin - zero_frequency_index(shots)
    flags_of_echo = flags[:, first_detecting:end_detecting] & is_searched(
        shots, signal.segment, point_spectra.point, signed_peak
    )
    detecting_power = np.where(flags_of_echo, power[:, first_detecting:end_detecting], -1.0)
    detected_index, is_detected = (
        first_detecting + detecting_power.argmax(axis=1),
        detecting_power.max(axis=1) >= 0,
    )
    flags[:, [0, -1]] = False  # DC and Nyquist
    flag_edges = np.diff(flags.astype(np.int8), axis=1)
    draw_of_group, start = np.nonzero(flag_edges > 0)  # draw and first bin of each group
    start, end = start + 1, np.nonzero(flag_edges < 0)[1] + 1
    assert signal.is_exempt is not None
    n_exempt_below = np.cumsum(
        np.pad(rotate_to_centre(shots, signal.is_exempt, signal.strongest_bin), (1, 0))
    )
    is_false = n_exempt_below[start] == n_exempt_below[end]  # groups without exempt bins
    is_false &= (start <= end_index - shots.first_searched_bin) & (end > shots.first_searched_bin)
    n_false_groups, n_false_bins = (
        np.bincount(draw_of_group[is_false], weights, len(power)).astype(np.int64)
        for weights in (None, (end - start)[is_false])
    )
    is_echo = (
        is_detected[draw_of_group]
        & (start <= detected_index[draw_of_group])
        & (detected_index[draw_of_group] < end)
    )
    search_first, search_end = np.ones((len(power), 1)), np.full((len(power), 1), end_index)
    search_first[draw_of_group[is_echo], 0] = start[is_echo]
    search_end[draw_of_group[is_echo], 0] = end[is_echo]
    peak_index = np.where((search_first <= bins) & (bins < search_end), power, -1.0).argmax(axis=1)
    # The largest of several bins would be brighter than the bin of a wandering peak.
    capped_power = np.minimum(
        power[np.arange(len(power)), peak_index], point_spectra.settings.threshold**2
    )
    peak_power = np.maximum(power[:, strongest_index], capped_power)
    peak_bin = (peak_index - shift) % shots.fft_size if shots.complex_record else peak_index
    peak_position = estimate_positions(spectra, peak_bin, point_spectra)
    frequency = peak_position - zero_frequency_index(shots)
    return SegmentDetections(
        is_detected, n_false_groups, n_false_bins, frequency, peak_position - peak_bin, peak_power
    )


def detections_by_draw(
    point_spectra: PointSpectra, draws: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each draw, which events occur, and values to be averaged over draws.

    The events are detections and false alarms.

    Parameters
    ----------
    point_spectra
        Spectra of the point.
    draws
        (m,) int64: numbers of the draws.

    Returns
    -------
    counts : ndarray (names, m) int64
        1 for a draw with the event, else 0, in the order of
        :data:`sweep.model.outputs.DRAW_COUNT_OUTPUTS`.
    values : ndarray (names, m)
        Values in the order of :data:`AVERAGED_VALUE_NAMES`; nan for a draw without a value.
    """
    zeros = np.zeros(draws.size, np.int64)
    detections = [SegmentDetections(zeros > 0, zeros, zeros, *np.zeros((3, draws.size)))] * 3
    n_searched = 0
    for s, signal in enumerate(point_spectra.signals):
        if signal is not None:
            detections[s] = detect_and_estimate_frequency(
                list(iter_look_spectra(point_spectra, s, draws)), signal, point_spectra
            )
            bins = np.arange(point_spectra.shots.n_bins)
            in_band = is_searched(
                point_spectra.shots,
                s,
                point_spectra.point,
                bins - zero_frequency_index(point_spectra.shots),
            )
            n_exempt = in_band[signal.is_exempt].sum()
            first_bin = (
                0 if point_spectra.shots.complex_record else point_spectra.shots.first_searched_bin
            )
            n_searched += int(in_band[first_bin : bins.size - first_bin].sum() - n_exempt)
    up, doppler, down = detections
    is_detected = np.array([f.is_detected for f in detections])
    alarm_up, alarm_down = up.n_false_groups > 0, down.n_false_groups > 0
    shot_detected = up.is_detected & down.is_detected
    _, doppler_signal, _ = point_spectra.signals
    is_resolved = shot_detected & (doppler.is_detected | (doppler_signal is None))
    if point_spectra.shots.detects_by_any_two_segments:
        shot_detected = is_resolved = is_detected.sum(axis=0) >= 2
    events = DrawCounts(
        up_detections=up.is_detected,
        down_detections=down.is_detected,
        doppler_detections=doppler.is_detected,
        shot_detections=shot_detected,
        up_alarms=alarm_up,
        down_alarms=alarm_down,
        joint_alarms=alarm_up & alarm_down,
    )
    n_false_bins, n_false_groups = (
        sum(f.n_false_bins for f in detections),
        sum(f.n_false_groups for f in detections),
    )
    least_deviations = _measurement_bounds_by_draw(point_spectra, is_detected)
    speckle_errors = _wander_variances(point_spectra, detections, is_detected)
    squared_bounds = [
        np.square(least_deviations.range) + speckle_errors.range,
        np.square(least_deviations.radial_velocity) + speckle_errors.radial_velocity,
    ]
    if point_spectra.shots.detects_by_any_two_segments:  # bounds depend on the detected segments
        squared_bounds = [np.where(is_resolved, bound, np.nan) for bound in squared_bounds]
    errors = [
        np.where(is_resolved, error, np.nan)
        for error in _measurement_errors(point_spectra, detections, is_detected)
    ]
    return np.array(events, np.int64), np.array(
        [n_false_bins / max(n_searched, 1), n_false_groups, *errors, *squared_bounds]
    )


def _measurement_bounds_by_draw(
    point_spectra: PointSpectra, is_detected: np.ndarray
) -> RangeVelocityDeviation:
    """Return the smallest standard deviations of range and radial velocity in m draws, (m,) each.

    :func:`measurement_bound` computes them for the segments that are detected in a draw, by
    ``is_detected`` (3, m).
    """
    bounds = RangeVelocityDeviation(
        *(
            np.full(is_detected.shape[1], deviation, float)
            for deviation in measurement_bound(point_spectra)
        )
    )
    if point_spectra.shots.detects_by_any_two_segments:
        for is_missing in np.eye(3, dtype=bool):
            has_pattern = (is_detected == ~is_missing[:, None]).all(axis=0)
            pattern_bound = measurement_bound(point_spectra, ~is_missing)
            bounds.range[has_pattern] = pattern_bound.range
            bounds.radial_velocity[has_pattern] = pattern_bound.radial_velocity
    return bounds


def _wander_variances(
    point_spectra: PointSpectra, detections: Sequence[SegmentDetections], is_detected: np.ndarray
) -> MeanSquareErrors:
    """Return the mean square errors of range and radial velocity due to speckle, (m,) each.

    `detections` has one record for each segment. A segment counts in the draws in which
    `is_detected` (3, m) is True.
    """
    shots, point, n_draws = point_spectra.shots, point_spectra.point, is_detected.shape[1]
    if shots.speckle.line_gradients is None:
        return MeanSquareErrors(np.zeros(n_draws), np.zeros(n_draws))
    point_indices = np.full(n_draws, point)
    line_noise_sigma = float(np.broadcast_to(shots.line_noise_sigma, shots.size)[point])
    signal = np.array([
        np.nan if s is None else np.abs(s.spectrum[s.strongest_bin]) ** 2
        for s in point_spectra.signals
    ])  # fmt: skip
    mean_power = signal + 2 * line_noise_sigma**2
    power = (
        np.where(
            is_detected,
            [segment_detections.peak_power for segment_detections in detections],
            np.nan,
        ).T
        / mean_power
    )
    offsets = np.clip(
        [segment_detections.peak_offset for segment_detections in detections], -1.0, 1.0
    ).T
    echo_fraction = np.broadcast_to(signal / mean_power, power.shape)
    peaks = SpecklePeaks(offsets, folding_signs(shots)[point_indices], power, echo_fraction)
    return range_velocity_wander_variance(shots, point_indices, peaks, is_detected)


def measurement_bound(
    point_spectra: PointSpectra, is_used: Sequence[bool] | np.ndarray | None = None
) -> RangeVelocityDeviation:
    """Return the smallest standard deviations of range and radial velocity for selected beats.

    Parameters
    ----------
    point_spectra
        Spectra of the point.
    is_used
        True for each segment whose beat is used; by default up and down, or all if the segments'
        chirp slopes differ from the default.

    Notes
    -----
    The bound on a beat's variance is the Cramer-Rao bound in white noise plus the variance by the
    laser's phase noise. Looks count as independent measurements.
    """
    shots, point = point_spectra.shots, point_spectra.point
    sample_rate, root_n_looks, phase_noise_arguments = (
        float(shots.sample_rate[point]),
        math.sqrt(shots.looks.number),
        _phase_noise_arguments(shots, point),
    )
    record_lengths = np.full(len(point_spectra.signals), shots.window.length)
    if shots.echo_record.n_samples_before_echo is not None:
        record_lengths = np.maximum(
            record_lengths - shots.echo_record.n_samples_before_echo[:, point], 2
        )
        phase_noise_arguments["duration"] = record_lengths[0] / np.asarray(sample_rate)
    laser_deviation = phase_noise_beat_deviation(**phase_noise_arguments)
    cnr_factor = 2 if shots.complex_record else 1  # two samples (I, Q) for the noise of one
    if is_used is None:
        is_used = (
            True,
            shots.waveform.chirp_rate_ratios != waveform.DEFAULT_CHIRP_RATE_RATIOS,
            True,
        )
    up, doppler, down = (
        np.inf
        if s is None or not exists
        else np.hypot(
            beat_frequency_cramer_rao_bound(
                cnr=cnr_factor * s.cnr, n_samples=record_length, sample_rate=sample_rate
            ),
            laser_deviation,
        )
        / root_n_looks
        for s, exists, record_length in zip(
            point_spectra.signals, is_used, record_lengths.tolist(), strict=True
        )
    )
    return range_velocity_deviation(
        up=up, doppler=doppler, down=down, carriers=_carrier_frequencies_of_point(shots, point),
        chirp_rate=_value_of_point(shots.waveform.chirp_rate, point), range=shots.range[point],
        radial_velocity=shots.target.radial_velocity[point],
        slopes=shots.waveform.chirp_rate_ratios,
    )  # fmt: skip


def _measurement_errors(
    point_spectra: PointSpectra, detections: Sequence[SegmentDetections], is_detected: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return measured minus true range [m] and radial velocity [m/s] in m draws, (m,) each.

    `detections` has one record for each segment. A segment counts in the draws in which
    `is_detected` (3, m) is True.
    """
    shots, point = point_spectra.shots, point_spectra.point
    bin_width = point_spectra.settings.sample_rate / point_spectra.settings.fft_size
    up_carrier, _, _ = shots.waveform.carriers
    _, has_doppler, _ = shots.has_segment
    up, doppler, down = (segment.frequency_bins * bin_width for segment in detections)
    measured = waveform.resolve_range_velocity(
        up=up,
        doppler=doppler if has_doppler else None,
        down=down,
        carrier=_value_of_point(up_carrier, point),
        bandwidth=_value_of_point(shots.waveform.chirp_bandwidth, point),
        duration=_value_of_point(shots.waveform.chirp_duration, point),
        sample_rate=shots.sample_rate[point],
        bin_width=np.asarray(bin_width),
        two_beat_assumption=shots.detection_settings.two_beat_assumption,
        has_signs=shots.complex_record,
    )
    measured_velocity = measured.radial_velocity * (
        1 + _value_of_point(shots.motion.velocity_bias_fraction, point)
    )
    range_walk = (
        _value_of_point(shots.motion.range_reference_time, point) * measured_velocity
    )  # to the shot's start
    measured_range = measured.range + range_walk
    uses_fit = shots.waveform.chirp_rate_ratios != waveform.DEFAULT_CHIRP_RATE_RATIOS or (
        shots.detects_by_any_two_segments & ~is_detected.all(axis=0)
    )
    if np.any(uses_fit):
        cnr = np.array([[0.0 if s is None else s.cnr] for s in point_spectra.signals])
        fitted_values = fit_range_velocity_to_peaks(
            shots, np.array([up, doppler, down]), is_detected * cnr, np.array([point])
        )
        measured_range = np.where(uses_fit, fitted_values.range, measured_range)
        measured_velocity = np.where(uses_fit, fitted_values.radial_velocity, measured_velocity)
    return measured_range - shots.range[point], measured_velocity - shots.target.radial_velocity[
        point
    ]


def _carrier_frequencies_of_point(
    shots: Shots, point: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the carrier (optical) frequencies of a point in the three segments [Hz]."""
    up, doppler, down = (_value_of_point(carrier, point) for carrier in shots.waveform.carriers)
    return up, doppler, down


def _value_of_point(column: np.ndarray | float, point: int) -> np.ndarray:
    """Return the value at index ``point`` of an array (n,), or a number common to all points."""
    column = np.asarray(column)
    return np.asarray(column[point] if column.ndim else column)
