"""Reference simulation in the time domain: every beamlet, every sample, the full FFT.

The beat of each beamlet follows from the exact delay tau(t) (:mod:`sweep.model.waveform`), sample
by sample. The records are summed, windowed and transformed. Tests compare every fast path with this
one. It shares link budget, noise and footprint with the fast path, but neither lines nor kernels
nor bins. A shot takes seconds. Its error, by rounding of phases, is 1e-11 of the peak.

With the effect of overlap, a beamlet has an echo in samples from its own delay tau(t) until the
chirp ends.
"""

from fractions import Fraction

import numpy as np

from sweep.model import receiver_chain, window
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.detection_probability import pd_and_miss_in_looks
from sweep.model.detection.echo_detection import detect_in_spectra
from sweep.model.preparation import Shots
from sweep.model.spectrum.segment_spectra import SegmentResults, allocate_segment_results
from sweep.model.waveform import TIME_TOLERANCE_SAMPLES, round_trip_delay


def time_domain_spectrum(
    shots: Shots,
    point: int,
    segment: int,
    *,
    with_range_walk: bool = True,
    with_acceleration: bool = False,
    laser_phase: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Return the magnitudes |X| of the noiseless spectrum of one segment of one point.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    point, segment : int
        Indices of the point and of the segment.
    with_range_walk : bool
        True to include range walk: the drift of the frequency while the target moves.
    with_acceleration : bool
        True to include the drift of the frequency while the target's velocity changes.
    laser_phase : ndarray (L,) or float
        Phase noise theta(t) - theta(t - tau) of the laser in each sample [rad]; tau is the echo's
        delay.

    Returns
    -------
    ndarray (n_bins,)
        |X| [V] in bins k = 0..N/2, or -N/2..N/2 - 1 of a complex record. If beamlets add as powers,
        it is the root-mean-square of |X| over independent, uniformly random phases of the beamlets.
    """
    w = window.window_samples(shots.window.name, shots.window.length)
    n_real_bins, is_complex = shots.fft_size // 2 + 1, shots.complex_record
    record_sum = np.zeros(shots.window.length, complex)
    power, image_gain = (
        np.zeros(shots.n_bins),
        _value_of_point(shots.line_images.iq_image_gain, point),
    )
    for beamlet in range(shots.footprint.n_beamlets):
        beamlet_record = beamlet_analytic_signal(
            shots,
            point,
            segment,
            beamlet,
            with_range_walk=with_range_walk,
            with_acceleration=with_acceleration,
        )
        beamlet_record *= np.exp(1j * np.asarray(laser_phase))
        record_sum += beamlet_record
        if shots.footprint.adds_powers:
            power_spectrum = abs(np.fft.fft(w * beamlet_record, shots.fft_size) / 2) ** 2
            if is_complex:
                power += np.fft.fftshift(
                    power_spectrum + image_gain**2 * np.roll(power_spectrum[::-1], 1)
                )
            else:
                power += power_spectrum[:n_real_bins] + power_spectrum[-np.arange(n_real_bins)]
    if shots.footprint.adds_powers:
        return np.sqrt(power)
    if is_complex:
        record = w * (record_sum + image_gain * record_sum.conj()) / 2
        return np.abs(np.fft.fftshift(np.fft.fft(record, shots.fft_size)))
    return np.abs(np.fft.rfft(w * record_sum.real, shots.fft_size))


def evaluate_segments_in_time_domain(
    shots: Shots, *, with_range_walk: bool = True
) -> SegmentResults:
    """Return results of all segments, such as pd, from spectra computed in the time domain.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points.
    with_range_walk : bool
        As in :func:`time_domain_spectrum`.

    Returns
    -------
    SegmentResults
        Arrays (3, n). Leakage is 0.

    Notes
    -----
    Range walk is the only change of frequency within a record that is included.
    """
    results = allocate_segment_results(shots.size)
    for point in range(shots.size):
        for segment in map(int, np.flatnonzero(shots.has_segment)):
            look_magnitudes = [
                time_domain_spectrum(look, point, segment, with_range_walk=with_range_walk)
                for look in (
                    shots.split_by_look() if np.any(shots.motion.line_drift_per_look) else [shots]
                )
            ]
            magnitude = np.sqrt(np.mean(np.square(look_magnitudes), axis=0))
            detections = detect_in_spectra(
                magnitude[None],
                np.zeros(1, np.int64),
                shots.n_bins - 1,
                float(shots.sample_rate[point]) / shots.fft_size,
                shots.detection_rule,
                shots.bin_thresholds.select(np.array([point])),
                shots.speckle_table.select(segment, np.array([point])),
            )
            for name, (value,) in detections._asdict().items():
                getattr(results, name)[segment, point] = value
            if shots.complex_record:
                results.frequency[segment, point] -= float(shots.sample_rate[point]) / 2
    if not shots.looks.is_noncoherent:
        return results
    peak_bins = np.rint(results.frequency / (shots.sample_rate / shots.fft_size))
    pd, miss = pd_and_miss_in_looks(
        shots,
        results.magnitude,
        np.where(np.isnan(peak_bins), -1, peak_bins).astype(np.int64),  # no segment: no bin
    )
    return results._replace(pd=pd, miss=miss)


def beamlet_analytic_signal(
    shots: Shots,
    point: int,
    segment: int,
    beamlet: int,
    *,
    with_range_walk: bool = True,
    with_acceleration: bool = False,
) -> np.ndarray:
    """Return the record of one beamlet's voltage at the ADC as a complex (analytic) signal.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    point, segment, beamlet : int
        Indices of the point, the segment and the beamlet.
    with_range_walk, with_acceleration : bool
        As in :func:`time_domain_spectrum`.

    Returns
    -------
    ndarray (L,) complex
        Voltage [V]; a real ADC samples its real part.

    Notes
    -----
    From the shot's start on, the range of the ground along the beam falls at ``approach_speed``,
    and that of its scatterers at their own radial velocity. If these speeds differ, the beam slides
    over the ground: scatterers in the beam are replaced by new ones, and the beat has the delay of
    the scatterers in the beam.
    """
    chirp_rate_ratio, carrier = (
        shots.waveform.chirp_rate_ratios[segment],
        float(_value_of_point(shots.waveform.carriers[segment], point)),
    )
    doppler_ratio_offset, segment_start = (
        float(shots.footprint.doppler_ratio_offset[shots.footprint.row_of_point[point], beamlet]),
        float(_value_of_point(shots.motion.segment_starts[segment], point)),
    )
    approach_speed, acceleration_value = (
        float(_value_of_point(shots.target.approach_speed, point)),
        float(_value_of_point(shots.target.acceleration, point)),
    )
    alpha = acceleration_value / SPEED_OF_LIGHT
    doppler_ratio = (
        float(_value_of_point(shots.motion.doppler_ratio, point))
        + 2 * alpha * segment_start
        + doppler_ratio_offset
    )
    chirp_rate = float(_value_of_point(shots.waveform.chirp_rate, point))
    axis_range = float(shots.range[point])
    range_offset = axis_range * float(
        shots.footprint.relative_range_offset[shots.footprint.row_of_point[point], beamlet]
    )
    range_offset -= SPEED_OF_LIGHT / 2 * doppler_ratio_offset * segment_start
    range_decrease_since_shot_start = (
        approach_speed * segment_start + acceleration_value * segment_start**2 / 2
    )
    t = float(_value_of_point(shots.record.acquisition_delay, point)) + np.arange(
        shots.window.length
    ) / float(shots.sample_rate[point])
    start_delay = round_trip_delay(axis_range - range_decrease_since_shot_start + range_offset)
    delay_change = -doppler_ratio * t - with_acceleration * alpha * t**2  # tau(t) - tau_0
    chirp_phase = delay_change * (2 * start_delay + delay_change) / 2 - t * (
        start_delay + delay_change
    )
    chirp_phase += (
        (approach_speed - float(shots.target.radial_velocity[point])) / SPEED_OF_LIGHT * t**2
    )
    if not with_range_walk:
        chirp_phase = start_delay * (delay_change - t)
    cycles = -carrier * delay_change + chirp_rate_ratio * chirp_rate * chirp_phase
    start_phase = _start_phase_cycles(
        chirp_rate_ratio,
        carrier,
        chirp_rate,
        axis_range,
        range_offset,
        range_decrease_since_shot_start,
    )
    beat = carrier * doppler_ratio - chirp_rate_ratio * chirp_rate * start_delay * (
        1 + doppler_ratio
    )
    gain = receiver_chain.receiver_transfer_function(
        np.array(beat),
        detector_bandwidth=_value_of_point(shots.receiver_filter.detector_bandwidth, point),
        amplifier_bandwidth=_value_of_point(shots.receiver_filter.amplifier_bandwidth, point),
    )
    amplitude = (
        _value_of_point(shots.echo_scales.beat_amplitude_scale, point)
        * shots.footprint.relative_amplitude[shots.footprint.row_of_point[point], beamlet]
    )
    amplitude = amplitude * shots.whitening_gain[segment][point]
    record = amplitude * gain * np.exp(2j * np.pi * (cycles - np.rint(cycles) + start_phase))
    if shots.echo_record.n_samples_before_echo is not None:
        has_arrived = (
            t >= start_delay + delay_change - TIME_TOLERANCE_SAMPLES / shots.sample_rate[point]
        )
        record *= has_arrived & (t <= _value_of_point(shots.waveform.chirp_duration, point))
    return np.asarray(record)


def _start_phase_cycles(
    chirp_rate_ratio: float,
    carrier: float,
    chirp_rate: float,
    axis_range: float,
    range_offset: float,
    range_decrease_since_shot_start: float,
) -> float:
    """Return the phase of a beamlet's beat at the segment's start [cycles], by exact fractions.

    The phase is -f tau + s S tau^2 / 2, with the delay tau = 2 (R + dR - decrease) / c. f is
    ``carrier``, s ``chirp_rate_ratio``, S ``chirp_rate`` of the up-chirp, R ``axis_range``, dR
    ``range_offset`` and decrease ``range_decrease_since_shot_start``.
    """
    delay = (
        Fraction(axis_range) + Fraction(range_offset) - Fraction(range_decrease_since_shot_start)
    )
    delay = 2 * delay / Fraction(SPEED_OF_LIGHT)
    phase = (
        -Fraction(carrier) * delay
        + Fraction(chirp_rate_ratio) * Fraction(chirp_rate) * delay**2 / 2
    )
    return float(phase - round(phase))


def _value_of_point(column: np.ndarray | float, point: int) -> np.ndarray:
    """Return one point's value from an array (n,), or from a number that all points share."""
    column = np.asarray(column)
    return column[point] if column.ndim else column
