"""Permanent line: the beat of light other than the echo, such as leaked light, in every record.

The line's beat has the amplitude A, the delay tau and the phase phi. With the window's transform W,
the receiver's transfer function H, the chirp rate S, the FFT size N and the sample rate fs, its
spectrum L_k in bin k is

    L_k = A H / 2 (e^{j phi} W(k - nu) + e^{-j phi} W(k + nu)),   nu = S tau N / fs

in a real record. A complex record has only the first term, at -nu or nu by the chirp's sign. The
phase phi drifts, and is assumed to be uniform.

The line is always present, so the processing knows it. Bins in which it reaches
:data:`MASK_THRESHOLD_FRACTION` of the threshold, at any phase, are **masked**. They raise no alarm,
and an echo whose largest bin is masked is not detected. In other bins the line's skirts, which add
as powers, help an echo over the threshold. They also help noise, which counts as leakage
(`p_leakage_up`, `p_leakage_down`): the mean over the phase, which all bins share. An echo that
fades in developed speckle crosses with Q_1(L / s, Th / s), s^2 = sigma^2 + |X|^2 / 2.

If echoes may begin within the record, so does the line, at its own delay. Otherwise it fills the
record.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from sweep.model import receiver_chain
from sweep.model.detection.looks import Looks
from sweep.model.preparation import Shots
from sweep.model.waveform import count_samples_before_echo
from sweep.model.window import Window, window_samples

MASK_THRESHOLD_FRACTION = 0.5
"""Magnitude of a permanent line in a bin, over the threshold, from which on the line masks the bin.
A masked bin raises no alarm. Smaller lines raise few alarms."""
N_PHASES = 16
"""Number of phases of the permanent line over which its false alarms are averaged."""


class LineTransforms(NamedTuple):
    """Spectrum of a permanent line of amplitude 2.

    Bins are 0 .. N/2 of a real record, 0 .. N - 1 of a complex one, N being the FFT size.
    """

    transform: np.ndarray
    """(bins,) complex: transform of the line at its own frequency."""
    image_transform: np.ndarray
    """(bins,) complex: transform of the line's image at the negative frequency; 0 in a complex
    record."""
    magnitude_max: np.ndarray
    """(bins,): magnitude of the line's spectrum at the phase where it is largest."""
    magnitude_rms: np.ndarray
    """(bins,): root mean square of the magnitude of the line's spectrum over all its phases."""


@lru_cache(maxsize=16)
def _line_transforms(
    window: Window, fft_size: int, line_bin: float, is_complex: bool, n_missing: int = 0
) -> LineTransforms:
    """Return the :class:`LineTransforms` of a line at ``line_bin`` [bins].

    The line is absent from the first ``n_missing`` samples of the record.
    """
    cycles = line_bin * np.arange(window.length) / fft_size
    record = window_samples(window.name, window.length) * np.exp(
        2j * np.pi * (cycles - np.rint(cycles))
    )
    record[:n_missing] = 0.0
    spectrum = np.fft.fft(record, fft_size)
    real_bins = np.arange(fft_size // 2 + 1)
    transform_rows = (
        [spectrum, 0 * spectrum]
        if is_complex
        else [spectrum[real_bins], spectrum[-real_bins].conj()]
    )
    transforms = np.array(transform_rows)
    magnitudes = np.abs(transforms)
    return LineTransforms(
        transform=transforms[0],
        image_transform=transforms[1],
        magnitude_max=magnitudes.sum(axis=0),
        magnitude_rms=np.hypot(*magnitudes),
    )


def permanent_line_of_point(
    shots: Shots, i: int, segment: int, noise_frequency: float | None = None
) -> tuple[float, LineTransforms]:
    """Return the permanent line in one segment of one point.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    i, segment : int
        Indices of the point and of the segment.
    noise_frequency : float, optional
        Frequency [Hz] of the noise density by which the line is whitened; by default that of the
        line. For skirts of the line under an echo it is the frequency of the echo's largest bin.

    Returns
    -------
    half_amplitude : float
        Half of the line's amplitude [V].
    line : LineTransforms
        Line of amplitude 2.
    """
    assert shots.permanent_line is not None
    shot_columns = (
        shots.permanent_line.amplitude,
        shots.permanent_line.delay,
        shots.waveform.chirp_rate,
        shots.sample_rate,
        shots.receiver_filter.detector_bandwidth,
        shots.receiver_filter.amplifier_bandwidth,
        shots.record.acquisition_delay,
    )
    (
        amplitude,
        delay,
        chirp_rate,
        sample_rate,
        detector_bandwidth,
        amplifier_bandwidth,
        acquisition_delay,
    ) = (float(np.broadcast_to(np.asarray(column), shots.size)[i]) for column in shot_columns)
    beat_frequency = -shots.waveform_segments[segment].chirp_rate_ratio * chirp_rate * delay
    transfer_gain = receiver_chain.receiver_transfer_function(
        np.array(beat_frequency),
        detector_bandwidth=np.array(detector_bandwidth),
        amplifier_bandwidth=np.array(amplifier_bandwidth),
    )
    whitened = shots.whitening_gain_at_frequency(
        np.array(beat_frequency), None if noise_frequency is None else np.array(noise_frequency)
    )
    whitening_gain = float(np.broadcast_to(whitened, shots.size)[i])
    half_amplitude = 0.5 * amplitude * abs(complex(transfer_gain)) * whitening_gain
    line_bin = beat_frequency * shots.fft_size / sample_rate
    n_missing = 0
    if shots.echo_record.n_samples_before_echo is not None:
        n_missing = int(
            count_samples_before_echo(
                delay=np.array(delay),
                doppler_ratio=0.0,
                record_start=np.array(acquisition_delay),
                sample_rate=np.array(sample_rate),
                length=shots.window.length,
            )
        )
    return half_amplitude, _line_transforms(
        shots.window, shots.fft_size, line_bin, shots.complex_record, n_missing
    )


def line_alarm_probability(
    looks: Looks,
    line: LineTransforms,
    bins: np.ndarray,
    *,
    amplitude_ratio: float,
    threshold_ratio: float,
) -> float:
    """Return the probability that a permanent line raises a false alarm where noise does not.

    Parameters
    ----------
    looks : Looks
        Number and combination of records.
    line : LineTransforms
        Line of amplitude 2.
    bins : ndarray of int
        Bins that may raise an alarm.
    amplitude_ratio, threshold_ratio : float
        Half of the line's amplitude, and the threshold, over the noise sigma.
    """
    line_term = amplitude_ratio * line.transform[bins]
    image_term = amplitude_ratio * line.image_transform[bins]
    phases = np.pi * (np.arange(N_PHASES) + 0.5) / N_PHASES  # period of the magnitude
    log_no_alarm = [
        np.log1p(
            -np.minimum(
                looks.crossing_probability_added_by_signal(
                    np.abs(line_term * phasor + image_term * phasor.conjugate()),
                    threshold_ratio,
                ),
                1.0,
            )
        )
        for phasor in np.exp(1j * phases)
    ]
    return float(-np.expm1(np.sum(log_no_alarm, axis=1)).mean())


def line_bin_masks(
    shots: Shots, i: int, line: LineTransforms, *, half_amplitude: float, echo_bins: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the bins that a permanent line masks, the searched bins, and those of false alarms.

    A masked bin raises no alarm. An echo whose largest bin is masked is not detected.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    i : int
        Index of the point.
    line : LineTransforms
        Line of amplitude 2.
    half_amplitude : float
        Half of the line's amplitude [V].
    echo_bins : ndarray of int
        Bins of the echo.

    Returns
    -------
    is_masked : ndarray (bins,) bool
        Masked bins.
    is_searched : ndarray (bins,) bool
        Bins searched for alarms, masked or not.
    may_raise_alarm : ndarray (bins,) bool
        Bins in which the line may raise an alarm.
    """
    noise_sigma, threshold, floor = (
        float(np.broadcast_to(value, shots.size)[i])
        for value in (shots.bin_noise_sigma, shots.threshold, shots.negligible_signal_ratio)
    )
    magnitude_max = half_amplitude * line.magnitude_max
    is_masked, is_searched = (
        magnitude_max >= MASK_THRESHOLD_FRACTION * threshold,
        np.ones(line.magnitude_max.size, bool),
    )
    if not shots.complex_record:
        first_searched = shots.first_searched_bin
        is_searched[:first_searched] = is_searched[is_searched.size - first_searched :] = False
    is_searched[echo_bins % shots.fft_size if shots.complex_record else echo_bins] = False
    return is_masked, is_searched, is_searched & ~is_masked & (magnitude_max >= floor * noise_sigma)


def echo_magnitude_with_line(
    echo_magnitude: np.ndarray,
    line_rms: np.ndarray,
    *,
    noise_sigma: float,
    threshold: float,
    in_speckle: bool,
) -> np.ndarray:
    """Return the |X| that an echo alone needs to cross the threshold as often as with the line.

    Parameters
    ----------
    echo_magnitude : ndarray (m,)
        |X| of the echo [V]; its root mean square in speckle.
    line_rms : ndarray (m,)
        Root mean square of the line over its phase [V].
    noise_sigma, threshold : float
        Noise per quadrature, and threshold [V].
    in_speckle : bool
        True for an echo in developed speckle.

    Notes
    -----
    Without speckle the powers of echo and line add. In speckle, echo and line cross the threshold
    Th with the probability Q_1(L / s, Th / s), Marcum's function, with the line's rms magnitude L
    and s^2 = sigma^2 + |X|^2 / 2. The result is the |X| of a fading echo of the same probability.
    """
    from sweep.model.detection.marcum import marcum_q1  # imports the compiler

    if not in_speckle:
        return np.hypot(echo_magnitude, line_rms)
    total_sigma = np.sqrt(noise_sigma**2 + echo_magnitude**2 / 2)
    pd, miss = marcum_q1(line_rms / total_sigma, threshold / total_sigma)
    with np.errstate(divide="ignore"):
        power = threshold**2 / -np.where(miss < 0.5, np.log1p(-miss), np.log(pd))
    return np.where(
        line_rms > 1e-6 * noise_sigma,
        np.sqrt(np.maximum(power - 2 * noise_sigma**2, 0)),
        echo_magnitude,
    )


def apply_permanent_line(shots: Shots, bin_spans: Any) -> Any:
    """Apply a permanent line to spectra: mask some bins and raise the magnitude of others.

    A permanent line is light in every record that does not come from the target. Probabilities of
    detection are not set here: :func:`sweep.model.detection.detection_probability.detect_in_spans`
    computes them from the changed bins.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    bin_spans : BinSpans
        Spectra around the echoes, as in :func:`sweep.model.spectrum.segment_spectra.iter_spans`.

    Returns
    -------
    BinSpans
        Spectra with changed magnitudes, masked peaks, exempt bins and leakage. The magnitude of the
        peak remains that of the echo alone.
    """
    magnitudes, peak_is_masked, n_exempt, leakage = (
        values.copy()
        for values in (
            bin_spans.magnitudes,
            bin_spans.peak_is_masked,
            bin_spans.n_exempt,
            bin_spans.leakage_probability,
        )
    )
    noise_sigma, line_noise_sigma, threshold = (
        np.broadcast_to(values, shots.size)[bin_spans.point_numbers]
        for values in (shots.bin_noise_sigma, shots.line_noise_sigma, shots.threshold)
    )
    fft_size = shots.fft_size
    for segment_index, i in np.argwhere(bin_spans.n_bins > 0):
        bin_slice = slice(
            bin_spans.span_start[segment_index, i],
            bin_spans.span_start[segment_index, i] + bin_spans.n_bins[segment_index, i],
        )
        bins = bin_spans.first_bin[segment_index, i] + np.arange(bin_spans.n_bins[segment_index, i])
        bins = bins % fft_size if shots.complex_record else bins
        (half_amplitude, line), peak = (
            permanent_line_of_point(shots, int(bin_spans.point_numbers[i]), segment_index),
            bin_spans.peak_index[segment_index, i],
        )
        is_echo = bin_spans.is_exempt[bin_slice]
        is_masked, is_searched, may_raise_alarm = line_bin_masks(
            shots,
            int(bin_spans.point_numbers[i]),
            line,
            half_amplitude=half_amplitude,
            echo_bins=bins[is_echo],
        )
        peak_frequency = float(
            bins[peak]
            / fft_size
            * np.broadcast_to(shots.sample_rate, shots.size)[bin_spans.point_numbers[i]]
        )
        skirt_half_amplitude, _ = permanent_line_of_point(
            shots, int(bin_spans.point_numbers[i]), segment_index, peak_frequency
        )
        skirt_rms = np.where(is_masked[bins], 0.0, skirt_half_amplitude * line.magnitude_rms[bins])
        equivalent_magnitudes = echo_magnitude_with_line(
            bin_spans.magnitudes[bin_slice],
            skirt_rms,
            noise_sigma=line_noise_sigma[i],
            threshold=threshold[i],
            in_speckle=shots.speckle.segment_correlations is not None,
        )
        equivalent_magnitudes[is_masked[bins]] = 0.0
        magnitudes[bin_slice] = equivalent_magnitudes
        peak_is_masked[segment_index, i] = is_masked[bins[peak]]
        n_exempt[segment_index, i] += np.count_nonzero(is_masked & is_searched)
        if shots.waveform_segments[segment_index].evaluates_leakage:
            alarm_probability = line_alarm_probability(
                shots.looks,
                line,
                np.flatnonzero(may_raise_alarm),
                amplitude_ratio=half_amplitude / noise_sigma[i],
                threshold_ratio=threshold[i] / noise_sigma[i],
            )
            leakage[segment_index, i] += (1 - leakage[segment_index, i]) * alarm_probability
    return bin_spans._replace(
        magnitudes=magnitudes,
        peak_is_masked=peak_is_masked,
        n_exempt=n_exempt,
        leakage_probability=leakage,
    )
