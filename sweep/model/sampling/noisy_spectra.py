"""Complex spectra of a shot with noise in every bin, and what is found in them, draw by draw.

Noise is drawn as the receiver makes it: white Gaussian in the record, which is windowed, padded and
transformed. So bins are alike as far as window and padding make them, and DC and Nyquist are what
they are. Every sample is addressed by point, draw, segment and place
(:mod:`sweep.model.sampling.philox`).

A real record has bins 0..N/2. A complex one, of I and Q, has N: bin k stands at index k + N/2, and
the last is a neighbour of the first. Indices that name an echo's bins may go on below 0 and beyond
N - 1.

The signal has the magnitudes that :func:`sweep.model.spectrum.segment_spectra.segment_spectrum`
gives, with all
effects. If beamlets add as powers these are root mean squares, and have no phases: the signal
is then given those of a lone tone at its place, bin by bin. For footprints of less than a bin that
is what the spectrum is. In developed speckle the bins of an echo have the amplitudes that the lines
of its footprint make in a draw (:mod:`sweep.model.sampling.speckle_lines`), and its leaked signal
fades with
the strongest of them. If a shot of a flight has several echoes, each has the phases of a tone of
its own, and its own speckle.
A phase common to all bins makes no difference to circular noise and is left out.

The phase of a laser of Lorentzian line width walks randomly: of each draw a walk is taken, at every
sample, and turns the signal's record (:func:`sweep.model.effects.line_width.phase_walk`).

In several looks (:mod:`sweep.model.detection.looks`) each record has its signal where the target
has come to,
its noise, its walk, and the speckle that all have, or its own. Flags are those of the mean of
|X|^2, of enough records, or of the mean record; the frequency is the mean of the looks' estimates.

A detector and an estimator of frequency look at each segment's spectrum. The detector flags bins of
|X|^2. A segment is detected where it flags any bin that the signal occupies (``peak_bin``: the one
that is the strongest without noise and speckle); adjacent flagged bins form a group. A group
outside the bins that the signal occupies is a false alarm. The estimator is given the spectrum and
the largest bin of the detected group. If all segments are detected, their frequencies are resolved
into range and radial velocity.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import fft

from sweep.model import waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.detectors import (
    DETECTORS,
    FIXED_THRESHOLD,
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
    beat_frequency_bound,
    phase_noise_deviation,
    range_velocity_deviation,
)
from sweep.model.detection.looks import COMBINE_BINARY
from sweep.model.detection.sub_bin_interpolation import (
    complex_exponentials,
    estimate_sub_bin_offset,
    interpolator,
)
from sweep.model.effects.line_width import (
    apparent_line_and_pedestal,
    n_phase_walk_steps,
    phase_walk,
)
from sweep.model.effects.segment_motion import split_looks
from sweep.model.evaluation import fit_peaks
from sweep.model.preparation import Parameters, Shots
from sweep.model.sampling.philox import (
    STREAM_LASER_PHASE,
    STREAM_RECORD,
    to_normals_by_row,
    uniforms,
)
from sweep.model.sampling.speckle_lines import (
    LOOK_DRAW_STRIDE,
    RECORD_LINE_DEVIATION_MAX_BINS,
    FootprintRecord,
    SpeckleLineGrid,
    SpecklePeaks,
    draw_segment_amplitudes,
    folding_signs,
    speckle_line_grid,
)
from sweep.model.sampling.speckle_wander import wander_variance
from sweep.model.spectrum.search_band import is_searched
from sweep.model.spectrum.search_restriction import mean_line_positions
from sweep.model.spectrum.segment_spectra import full_segment_spectrum
from sweep.model.window import zero_first_samples

AVERAGED_VALUES = (
    "pfa_bin",
    "false_alarms",
    "range",
    "radial_velocity",
    "range_2",
    "radial_velocity_2",
)
"""Values that are averaged over draws; the last two are squares of bounds."""


class SpectrumMethods(NamedTuple):
    """Detectors and estimators by name: those of the program, and any others."""

    detectors: Mapping[str, Detector] = DETECTORS
    estimators: Mapping[str, Estimator] = ESTIMATORS


class SegmentSignal(NamedTuple):
    """A segment's spectrum without noise, and what is true of it."""

    spectrum: np.ndarray
    """(N/2 + 1,) complex [V]; of a complex record (N,)."""
    strongest_bin: int
    """Index of the largest bin; of a real record 1..N/2 - 1 where noise is taken to be circular in
    all."""
    first_bin: int
    """First of the bins that the signal occupies: those from the first to the last of half its
    largest magnitude, and a main lobe's half-width to either side."""
    last_bin: int
    """Last of them; below ``first_bin`` if there is no echo, or its largest bin is not searched."""
    frequency: float
    """Place of a lone tone of these magnitudes about the largest bin [bins], with its sign."""
    cnr: float
    """Power of the signal over that of the noise in the record, before the FFT."""
    segment: int
    """0 up, 1 Doppler, 2 down."""
    nearest_echo: np.ndarray | None = None
    """Number of the echo that each bin is nearest to, int64; None where all are one."""
    echo_peaks: tuple[np.ndarray, np.ndarray] | None = None
    """Strongest bin of each of several echoes, and the place of a lone tone about it, as indices.
    """
    echo_half_width: int = 0
    """Bins on either side of such an echo that it occupies."""
    footprint_records: tuple[FootprintRecord, ...] | None = None
    """Records of the speckle of each echo, none where lines spread over more than a bin; None where
    they are not known yet."""
    record_scalings: tuple[np.ndarray, ...] = ()
    """(bins,) complex of each: what makes factors on ``spectrum`` of the record's transform."""
    is_exempt: np.ndarray | None = None
    """(bins,) bool: bins that raise no false alarm: ``first_bin`` to ``last_bin``, and those at
    or above the threshold with their neighbours, as of
    :func:`sweep.model.detection.echo_detection.mark_exempt_bins`."""


def noiseless_signal(
    shots: Shots, point: int, segment: int, echo_bins: Sequence[int] | np.ndarray = (),
    fixed_threshold: float = math.inf,
) -> SegmentSignal:  # fmt: skip
    """Spectrum of point i's segment without noise: 0 up, 1 Doppler, 2 down.

    ``echo_bins``: strongest bins of the echoes of several surfaces, where there are several.
    ``fixed_threshold``: fixed threshold [V], if there is one: bins that reach it raise no false
    alarm.
    """
    magnitude = full_segment_spectrum(shots, point, segment)
    if (laser_timing := _laser_timing(shots, point))[
        "line_width"
    ] > 0:  # as it is before its phase walks
        echo_window = shots.window
        if shots.n_samples_before_echo is not None:
            echo_window = zero_first_samples(
                echo_window, int(shots.n_samples_before_echo[0, point])
            )
        line_power_fraction = apparent_line_and_pedestal(
            window=echo_window, looks=shots.looks.n_coherent, **laser_timing
        )[0][0]
        magnitude = magnitude / math.sqrt(line_power_fraction)
    window, last_index = shots.window, magnitude.size - 1
    margin = 0 if shots.real_fft_size or shots.complex_record else 1  # at DC and Nyquist taken as 0
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
    peak_position = _tone_position(shots, magnitude, strongest_bin)
    shift = unrolling_shift(shots, strongest_bin)
    bins_above_half = (
        np.flatnonzero(
            unroll_bins(shots, magnitude, strongest_bin) >= 0.5 * magnitude[strongest_bin]
        )
        - shift
    )
    lobe_half_width = math.ceil(main_lobe_half_width(window) * shots.fft_size / window.length)
    energy = (magnitude**2).sum()
    if not shots.complex_record:  # and as much at negative frequencies
        energy = 2 * energy - magnitude[0] ** 2 - magnitude[-1] ** 2
    signal_power = energy / (
        shots.fft_size * max(float(shots.echo_window_energy(segment)[point]), 1e-300)
    )
    echo_margin = max(
        lobe_half_width, int(shots.bin_threshold_table[4, point])
    )  # where its pedestal is above the noise
    first_bin, last_bin = (
        int(bins_above_half[0]) - echo_margin,
        int(bins_above_half[-1]) + echo_margin,
    )
    if not shots.complex_record:
        first_bin, last_bin = max(first_bin, margin), min(last_bin, last_index - margin)
    first_sample = (
        0
        if shots.n_samples_before_echo is None
        else int(shots.n_samples_before_echo[segment, point])
    )
    phases = _tone_phases(peak_position, shots, first_sample)
    if (
        bins_above_half[-1] - bins_above_half[0] > lobe_half_width
    ):  # wider than a tone: in step, as in one's main lobe
        bin_offset = np.arange(first_bin, last_bin + 1) - strongest_bin
        phases[(strongest_bin + bin_offset) % phases.size] = phases[strongest_bin] * np.exp(
            -1j * np.pi * bin_offset * ((window.length + first_sample) / shots.fft_size)
        )
    if not is_searched(shots, segment, point, strongest_bin - zero_frequency_index(shots)):
        first_bin, last_bin = 1, 0
    nearest_echo, echo_peaks = None, None
    if len(echo_bins) > 1:
        bin_offset = np.arange(magnitude.size)[:, None] - np.asarray(echo_bins)
        if shots.complex_record:
            bin_offset -= shots.fft_size * np.rint(bin_offset / shots.fft_size).astype(np.int64)
        nearest_echo = np.abs(bin_offset).argmin(axis=1)
        echo_peaks = (
            np.asarray(echo_bins),
            np.array(
                [
                    _tone_position(shots, magnitude, int(strongest_bin))
                    for strongest_bin in echo_bins
                ]
            ),
        )
        for echo_number, echo_bin in enumerate(echo_bins):
            if (echo_bin - first_bin) % magnitude.size > last_bin - first_bin:
                echo_position = _tone_position(shots, magnitude, int(echo_bin))
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
        frequency=peak_position - zero_frequency_index(shots),
        cnr=float(signal_power / shots.noise_variance[point]),
        segment=segment,
        nearest_echo=nearest_echo,
        echo_peaks=echo_peaks,
        echo_half_width=lobe_half_width,
        is_exempt=_exempt_bin_mask(
            shots, magnitude, strongest_bin, (first_bin, last_bin), fixed_threshold
        ),
    )


def _exempt_bin_mask(
    shots: Shots,
    magnitude: np.ndarray,
    strongest_bin: int,
    echo_bins: tuple[int, int],
    fixed_threshold: float,
) -> np.ndarray:
    """Bins that raise no false alarm (bins,) bool; none of an echo that is not searched for."""
    first_bin, last_bin = echo_bins
    is_exempt = np.zeros(magnitude.size, bool)
    if last_bin < first_bin:
        return is_exempt
    unrolled_magnitude = unroll_bins(shots, magnitude, strongest_bin)
    is_marked = np.zeros(unrolled_magnitude.size, bool)
    mark_exempt_bins(
        unrolled_magnitude,
        unrolled_magnitude.size,
        fixed_threshold,
        is_marked,
        shots.detection_rule.lobe_half_width,
    )
    if shots.complex_record:
        is_marked = np.roll(is_marked[1:-1], 1 - unrolling_shift(shots, strongest_bin))
    is_exempt[np.arange(first_bin, last_bin + 1) % is_exempt.size] = True
    return is_exempt | is_marked


def zero_frequency_index(shots: Shots) -> int:
    """Index of the bin at frequency 0 in a spectrum."""
    return int(shots.bin_indices(np.zeros((), int)))


def unrolling_shift(shots: Shots, middle_index: int) -> int:
    """Places by which :func:`unroll_bins` moves a bin."""
    return 1 + shots.fft_size // 2 - middle_index if shots.complex_record else 0


def unroll_bins(shots: Shots, values: np.ndarray, middle_index: int) -> np.ndarray:
    """Values of bins (..., bins) without a seam near one of them.

    Those of a complex record are turned until index ``middle_index`` stands in the middle, with a 0
    put
    at either end as if it were DC and Nyquist of a real one. Those of a real one are as they are.
    """
    if not shots.complex_record:
        return values
    values = np.roll(values, unrolling_shift(shots, middle_index) - 1, axis=-1)
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(1, 1)])


def _tone_position(shots: Shots, magnitude: np.ndarray, peak_index: int) -> float:
    """Place of a lone tone whose largest bin is k, as an index."""
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
    """Phase factors of a lone tone at a place, by index; 1 where it vanishes.

    It begins with sample ``first_sample`` of the record.
    """
    fft_size = shots.fft_size
    cycles = (position - zero_frequency_index(shots)) / fft_size
    record = cached_window_samples(shots.window) * complex_exponentials(
        -cycles, shots.window.length
    )
    record[:first_sample] = 0.0
    tone = record_spectrum(shots, record if shots.complex_record else record.real)
    magnitude = np.abs(tone)
    return np.where(magnitude > 0, tone / np.where(magnitude > 0, magnitude, 1.0), 1.0)


def record_spectrum(shots: Shots, record: np.ndarray) -> np.ndarray:
    """Spectrum of a windowed record (L,), which is padded."""
    if shots.complex_record:
        return np.asarray(fft.fftshift(fft.fft(record, shots.fft_size)))
    return np.asarray(fft.rfft(record, shots.fft_size))


def _laser_timing(shots: Shots, point: int) -> dict[str, np.ndarray]:
    """Width of the laser's line [Hz]; delay of the echo and length of the record [s]."""
    return {
        "line_width": _value_at(shots.lorentzian_line_width, point),
        "delay": 2 * _value_at(shots.range, point) / SPEED_OF_LIGHT,
        "duration": _value_at(shots.record_duration, point),
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
    """Spectra (m or 1, bins) complex of the signal in some draws, without noise [V]."""
    laser_timing, sample_rate = (
        _laser_timing(shots, point),
        float(_value_at(shots.sample_rate, point)),
    )
    if not laser_timing["line_width"] > 0:
        return signal.spectrum[None]
    record_length, fft_size = shots.window.length, shots.fft_size
    delay_samples = float(laser_timing["delay"]) * sample_rate
    analytic_spectrum = np.zeros(fft_size, complex)  # spectrum of the analytic record
    if shots.complex_record:
        analytic_spectrum = fft.ifftshift(signal.spectrum)
    else:
        analytic_spectrum[: fft_size // 2 + 1] = 2 * signal.spectrum
        analytic_spectrum[[0, fft_size // 2]] /= 2
    record = fft.ifft(analytic_spectrum)[:record_length]
    phase_variance_per_sample, spectra = (
        2 * math.pi * float(laser_timing["line_width"]) / sample_rate,
        [],
    )
    for draw in draws:
        uniform_numbers = uniforms(
            key[None], draw[None], STREAM_LASER_PHASE[segment],
            n_phase_walk_steps(delay=delay_samples, length=record_length),
        )  # fmt: skip
        # |X| does not tell the phase that a record begins with, and their sum does.
        phase = phase_walk(
            to_normals_by_row(uniform_numbers)[0],
            variance_per_sample=phase_variance_per_sample,
            delay=delay_samples,
            from_first_sample=shots.looks.n_coherent > 1,
        )
        rotated_record = record * np.exp(1j * phase)
        spectra.append(
            record_spectrum(shots, rotated_record if shots.complex_record else rotated_record.real)
        )
    return np.array(spectra)


def draw_noise_spectra(
    shots: Shots, point: int, segment: int, *, key: np.ndarray, draws: np.ndarray
) -> np.ndarray:
    """Noise (m, bins) complex of some draws of point i's segment, by their numbers [V]."""
    record_length, stream = shots.window.length, STREAM_RECORD[segment]
    keys = np.broadcast_to(key, (draws.size, 2))
    n_numbers = 2 * record_length if shots.complex_record else record_length + record_length % 2
    record = to_normals_by_row(uniforms(keys, draws, stream, n_numbers))
    if shots.complex_record:  # I and Q with half of the noise each
        record = (record[:, :record_length] + 1j * record[:, record_length:]) * math.sqrt(0.5)
    record = (
        record[:, :record_length]
        * math.sqrt(float(shots.noise_variance[point]))
        * cached_window_samples(shots.window)
    )
    # A transform at a time: bits do not depend on how many there are.
    return np.array([record_spectrum(shots, noise_record) for noise_record in record])


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
    """Complex factors on the bins of point i's segment in some draws, (m, bins); 1 without speckle.

    The bins that an echo occupies have those of the lines of its footprint, its other bins the one
    of its strongest bin.
    """
    if shots.line_gradients is None:
        return np.ones((1, 1))
    line_grid = speckle_line_grid(shots) if line_grid is None else line_grid
    if signal.footprint_records is None:
        signal = add_footprint_records(shots, point, signal, line_grid)
    if signal.footprint_records:
        return _draw_speckle_from_records(shots, signal, key, draws)
    n_bins, zero_index = signal.spectrum.size, zero_frequency_index(shots)
    factors = np.empty((draws.size, n_bins), complex)
    is_real_bin = np.zeros(n_bins, bool)  # one part is left, which has all of the power
    is_real_bin[[0, -1]] = shots.real_fft_size > 0
    echo_windows = [
        (signal.strongest_bin, signal.frequency + zero_index, signal.first_bin, signal.last_bin)
    ]
    if signal.nearest_echo is not None and signal.echo_peaks is not None:
        echo_windows = [
            (
                int(own),
                position,
                int(own) - signal.echo_half_width,
                int(own) + signal.echo_half_width,
            )
            if (own - signal.first_bin) % n_bins > signal.last_bin - signal.first_bin
            else (int(own), position, signal.first_bin, signal.last_bin)
            for own, position in zip(*signal.echo_peaks, strict=True)
        ]
    for echo_number, (strongest_bin, position, first_bin, last_bin) in enumerate(echo_windows):
        first_bin, last_bin = min(first_bin, strongest_bin - 1), max(last_bin, strongest_bin + 1)
        positions = np.full(3, np.nan)
        positions[segment] = position
        amplitudes = draw_segment_amplitudes(
            line_grid,
            point,
            positions,
            (first_bin, last_bin - first_bin + 1),
            key=key,
            draws=draws,
            group=echo_number,
        )
        own = slice(None) if signal.nearest_echo is None else signal.nearest_echo == echo_number
        factors[:, own] = amplitudes[:, strongest_bin - first_bin, None]
        bins = np.arange(first_bin, last_bin + 1)
        has_speckle = (amplitudes != 0).any(axis=0)
        if not shots.complex_record:
            has_speckle &= (bins >= 0) & (bins < n_bins)
        if signal.nearest_echo is not None:
            has_speckle &= signal.nearest_echo[bins % n_bins] == echo_number
        bins = bins[has_speckle] % n_bins
        factors[:, bins] = amplitudes[:, has_speckle]
        if shots.real_fft_size and shots.speckle_table.ratio_row[segment, point] > 0:
            # Their phases are those about the record's middle, as the noise's are.
            first_sample = (
                0
                if shots.n_samples_before_echo is None
                else int(shots.n_samples_before_echo[segment, point])
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
    """Return a signal of point i with the records of its echoes' speckle."""
    if shots.line_gradients is None:
        return signal
    segment, zero_index = signal.segment, zero_frequency_index(shots)
    line_deviation = (
        np.hypot(*line_grid.line_shift[point, segment]) * shots.window.length / shots.fft_size
    )
    if line_deviation > RECORD_LINE_DEVIATION_MAX_BINS:
        return signal._replace(footprint_records=())
    first_sample = (
        0
        if shots.n_samples_before_echo is None
        else int(shots.n_samples_before_echo[segment, point])
    )
    if not cached_window_samples(shots.window)[first_sample:].any():
        return signal._replace(footprint_records=())
    strongest_bins = np.full((1, 3), signal.strongest_bin - zero_index)
    positions = [float(mean_line_positions(shots, np.array([point]), strongest_bins)[0, segment])]
    if signal.echo_peaks is not None:
        positions = [float(position) - zero_index for position in signal.echo_peaks[1]]
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
        if not shots.complex_record:  # half of the line and of its image
            power = 0.25 * (power + record.mean_bin_power[-bin_numbers % fft_size])
        scalings.append(conjugate_phase / np.sqrt(power))
    return signal._replace(footprint_records=records, record_scalings=tuple(scalings))


def _draw_speckle_from_records(
    shots: Shots, signal: SegmentSignal, key: np.ndarray, draws: np.ndarray
) -> np.ndarray:
    """Draw the speckle of bins by the records of a footprint's lines, which all bins see."""
    assert signal.footprint_records is not None
    factors = np.empty((draws.size, signal.spectrum.size), complex)
    for echo_number, record in enumerate(signal.footprint_records):
        echo_bins = (
            slice(None) if signal.nearest_echo is None else signal.nearest_echo == echo_number
        )
        for row, draw in enumerate(draws):
            drawn_record = record.draw_record(key, int(draw), echo_number)
            drawn_record = drawn_record if shots.complex_record else drawn_record.real
            scaling = signal.record_scalings[echo_number]
            factors[row, echo_bins] = (record_spectrum(shots, drawn_record) * scaling)[echo_bins]
    return factors


def iter_look_spectra(
    view: "SpectrumView", segment: int, draws: np.ndarray
) -> Iterator[np.ndarray]:
    """Spectra (m, bins) complex of a segment in some draws, with noise [V], look by look.

    Of looks that are added in amplitude their mean alone.
    """
    looks, look_sum = view.shots.looks, np.zeros(1, complex)
    for look, shots in enumerate(view.look_shots):
        look_draws = draws + look * LOOK_DRAW_STRIDE
        draw_arguments = {"key": view.key, "draws": look_draws}
        signal = view.get_signal_in_look(segment, look)
        factors = _draw_look_speckle(view, shots, segment, look, draws, signal)
        spectra = (
            draw_signal_spectra(shots, view.point, segment, signal, **draw_arguments) * factors
        )
        spectra = spectra + draw_noise_spectra(shots, view.point, segment, **draw_arguments)
        if looks.n_coherent == 1:
            yield spectra
        else:
            look_sum = look_sum + spectra
    if looks.n_coherent > 1:
        yield look_sum / looks.n_coherent


def _draw_look_speckle(
    view: "SpectrumView",
    shots: Shots,
    segment: int,
    look: int,
    draws: np.ndarray,
    signal: SegmentSignal,
) -> np.ndarray:
    """Factors (m, bins) on a look's bins: of speckle common to all looks, its own, or a mixture.

    Speckle that changes from look to look is a sum of independent ones.
    """
    draw_arguments: dict[str, Any] = {"key": view.key, "line_grid": view.line_grid}
    if shots.look_speckle is None:
        look_draws = (
            draws + look * LOOK_DRAW_STRIDE if shots.looks.has_independent_speckle else draws
        )
        return draw_bin_speckle(
            shots, view.point, segment, signal, draws=look_draws, **draw_arguments
        )
    root_row = shots.look_speckle.covariance_root(segment, view.point)[look]
    # The mean power of the looks differs in the signal itself.
    root_row = root_row / np.sqrt((np.abs(root_row) ** 2).sum())
    return np.asarray(
        sum(
            coefficient
            * draw_bin_speckle(
                shots,
                view.point,
                segment,
                signal,
                draws=draws + term * LOOK_DRAW_STRIDE,
                **draw_arguments,
            )
            for term, coefficient in enumerate(root_row)
        )
    )


class SpectrumView(NamedTuple):
    """A shot, and how it is looked at."""

    shots: Shots
    point: int
    """Number of the shot."""
    key: np.ndarray
    """(2,) uint64: random key of the point."""
    signals: tuple[SegmentSignal | None, ...]
    """By segment; None for one that does not exist."""
    look_shots: list[Shots]
    """The shots as each look finds them."""
    setting: SpectrumSettings
    detect: Detector
    estimate: Estimator
    signal_cache: dict[tuple[int, int], SegmentSignal]
    """Signals of looks that find the target elsewhere, by segment and look, as they are asked for.
    """
    echo_bins: np.ndarray | None = None
    """(3, k) int64: strongest bins of the shot's echoes in each segment, -1 for none."""
    line_grid: SpeckleLineGrid | None = None
    """Lines of all shots' footprints in developed speckle."""
    fixed_threshold: float = math.inf
    """Fixed threshold [V], if the detector has one."""

    def get_signal_in_look(self, segment: int, look: int) -> SegmentSignal:
        """Return the signal of a segment as a look finds it."""
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
        """Return indices of the echoes' strongest bins in a segment; none where echoes are one."""
        bins = np.empty(0, np.int64) if self.echo_bins is None else self.echo_bins[segment]
        bins = bins[bins >= 0]
        return self.shots.bin_indices(bins)


class SegmentDetections(NamedTuple):
    """Detections, alarms and frequency of a segment in m draws, (m,) each."""

    is_detected: np.ndarray
    n_false_groups: np.ndarray
    """Groups outside the signal."""
    n_false_bins: np.ndarray
    """Bins in them."""
    frequency: np.ndarray
    """[bins], with signs of a complex record."""
    peak_offset: np.ndarray
    """Place past the strongest bin [bins]."""
    peak_power: np.ndarray
    """|X|^2 of the echo's strongest bin in the mean, and at least the threshold's [V^2]."""


def make_spectrum_view(
    shots: Shots, point: int, parameters: Parameters, key: np.ndarray, methods: SpectrumMethods,
    echo_bins: np.ndarray | None = None, line_grid: SpeckleLineGrid | None = None,
) -> SpectrumView:  # fmt: skip
    """View of one of some shots, by the parameters p of its point, those of `DEFAULTS`."""
    training, rank = (
        int(parameters[DETECTOR_PREFIX + "training"]),
        int(parameters[DETECTOR_PREFIX + "rank"]),
    )
    setting = SpectrumSettings(
        fft_size=shots.fft_size,
        sample_rate=float(shots.sample_rate[point]),
        window=shots.window,
        noise_power=float(
            shots.window.energy * shots.noise_variance_without_echo[point] / shots.looks.n_coherent
        ),
        threshold=float(shots.threshold[point]),
        training=training,
        guard=int(parameters[DETECTOR_PREFIX + "guard"]),
        rank=rank or math.ceil(0.75 * training),  # 0 stands for three quarters
        pfa=float(parameters[DETECTOR_PREFIX + "pfa"]),
        complex_record=shots.complex_record,
    )
    line_grid = speckle_line_grid(shots) if line_grid is None else line_grid
    view = SpectrumView(
        shots,
        point,
        key,
        (),
        split_looks(shots),
        setting,
        methods.detectors[str(parameters[DETECTOR_PREFIX + "kind"])],
        methods.estimators[str(parameters[ESTIMATOR_PREFIX + "kind"])],
        {},
        echo_bins,
        line_grid,
        setting.threshold
        if str(parameters[DETECTOR_PREFIX + "kind"]) == FIXED_THRESHOLD
        else math.inf,
    )
    signals = tuple(
        add_footprint_records(
            shots,
            point,
            noiseless_signal(shots, point, s, view.echo_indices(s), view.fixed_threshold),
            line_grid,
        )
        if exists
        else None
        for s, exists in enumerate(shots.has_segment)
    )
    return view._replace(signals=signals)


def flag_bins(
    spectra: Sequence[np.ndarray], view: SpectrumView, segment: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mean power of a segment's looks, and the bins that are flagged, (m, bins) each."""
    powers = [spectrum.real**2 + spectrum.imag**2 for spectrum in spectra]
    power = powers[0] if len(powers) == 1 else np.mean(powers, axis=0)
    if view.shots.looks.combine == COMBINE_BINARY:
        votes = sum(np.array(view.detect(spectrum, view.setting), np.int64) for spectrum in powers)
        flags = np.asarray(votes >= view.shots.looks.votes)
    else:
        flags = np.array(view.detect(power, view.setting), bool)
    bins = np.arange(flags.shape[1]) - zero_frequency_index(view.shots)
    return power, flags & is_searched(view.shots, segment, view.point, bins)


def estimate_positions(
    spectra: Sequence[np.ndarray], peak_bins: np.ndarray, view: SpectrumView
) -> np.ndarray:
    """Places (m,) of peaks in a segment's spectra, by index: the mean of the looks' estimates."""
    positions = [view.estimate(spectrum, peak_bins, view.setting) for spectrum in spectra]
    return positions[0] if len(positions) == 1 else np.asarray(np.mean(positions, axis=0))


def detect_and_estimate(
    spectra: Sequence[np.ndarray], signal: SegmentSignal, view: SpectrumView
) -> SegmentDetections:
    """Detect and estimate in spectra (m, bins) of a segment, of one or several looks."""
    power, flags = flag_bins(spectra, view, signal.segment)
    shots, shift = view.shots, unrolling_shift(view.shots, signal.strongest_bin)
    power, flags = (unroll_bins(shots, values, signal.strongest_bin) for values in (power, flags))
    strongest_index, first_index, last_index = (
        k + shift for k in (signal.strongest_bin, signal.first_bin, signal.last_bin)
    )
    bins, end_index = np.arange(power.shape[1]), power.shape[1] - 1
    first_detecting, end_detecting = strongest_index, strongest_index + 1
    if shots.detection == "any_bin" and last_index >= first_index:
        first_detecting, end_detecting = first_index, last_index + 1
        if not shots.real_fft_size:
            first_detecting, end_detecting = max(first_detecting, 1), min(end_detecting, end_index)
    signed_peak = signal.strongest_bin - zero_frequency_index(shots)
    own = flags[:, first_detecting:end_detecting] & is_searched(
        shots, signal.segment, view.point, signed_peak
    )
    detecting_power = np.where(own, power[:, first_detecting:end_detecting], -1.0)
    detected_index, is_detected = (
        first_detecting + detecting_power.argmax(axis=1),
        detecting_power.max(axis=1) >= 0,
    )
    flags[:, [0, -1]] = False  # DC and Nyquist
    flag_edges = np.diff(flags.astype(np.int8), axis=1)
    draw_of_group, start = np.nonzero(flag_edges > 0)  # of each group of flagged bins
    start, end = start + 1, np.nonzero(flag_edges < 0)[1] + 1
    assert signal.is_exempt is not None
    n_exempt_below = np.cumsum(
        np.pad(unroll_bins(shots, signal.is_exempt, signal.strongest_bin), (1, 0))
    )
    is_false = n_exempt_below[start] == n_exempt_below[end]  # no bin of theirs is exempt
    is_false &= (start <= end_index - shots.first_searched_bin) & (end > shots.first_searched_bin)
    n_false_groups, n_false_bins = (
        np.bincount(draw_of_group[is_false], weights, len(power)).astype(np.int64)
        for weights in (None, (end - start)[is_false])
    )
    own = (
        is_detected[draw_of_group]
        & (start <= detected_index[draw_of_group])
        & (detected_index[draw_of_group] < end)
    )
    search_first, search_end = np.ones((len(power), 1)), np.full((len(power), 1), end_index)
    search_first[draw_of_group[own], 0], search_end[draw_of_group[own], 0] = start[own], end[own]
    peak_index = np.where((search_first <= bins) & (bins < search_end), power, -1.0).argmax(axis=1)
    # The largest of several bins would be brighter than a bin whose place wanders.
    capped_power = np.minimum(power[np.arange(len(power)), peak_index], view.setting.threshold**2)
    peak_power = np.maximum(power[:, strongest_index], capped_power)
    peak_bin = (peak_index - shift) % shots.fft_size if shots.complex_record else peak_index
    peak_place = estimate_positions(spectra, peak_bin, view)
    frequency = peak_place - zero_frequency_index(shots)
    return SegmentDetections(
        is_detected, n_false_groups, n_false_bins, frequency, peak_place - peak_bin, peak_power
    )


def count_detections(view: SpectrumView, draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count detections and alarms in some draws, and find values to be averaged over them.

    By the names of DRAW_OUTPUTS and of VALUES, (names, m); nan where there is no value.
    """
    zeros = np.zeros(draws.size, np.int64)
    detections = [SegmentDetections(zeros > 0, zeros, zeros, *np.zeros((3, draws.size)))] * 3
    n_searched = 0
    for s, signal in enumerate(view.signals):
        if signal is not None:
            detections[s] = detect_and_estimate(
                list(iter_look_spectra(view, s, draws)), signal, view
            )
            bins = np.arange(view.shots.n_bins)
            in_band = is_searched(
                view.shots, s, view.point, bins - zero_frequency_index(view.shots)
            )
            n_exempt = in_band[signal.is_exempt].sum()
            first_bin = 0 if view.shots.complex_record else view.shots.first_searched_bin
            n_searched += int(in_band[first_bin : bins.size - first_bin].sum() - n_exempt)
    up, doppler, down = detections
    is_detected, has_alarm = (
        np.array([f.is_detected for f in detections]),
        (up.n_false_groups > 0, down.n_false_groups > 0),
    )
    shot_detected = up.is_detected & down.is_detected
    is_resolved = shot_detected & (doppler.is_detected | (view.signals[1] is None))
    if view.shots.any_two:
        shot_detected = is_resolved = is_detected.sum(axis=0) >= 2
    counts = np.array(
        [
            up.is_detected,
            down.is_detected,
            doppler.is_detected,
            shot_detected,
            *has_alarm,
            has_alarm[0] & has_alarm[1],
        ],
        np.int64,
    )
    n_false_bins, n_false_groups = (
        sum(f.n_false_bins for f in detections),
        sum(f.n_false_groups for f in detections),
    )
    squared_bounds = np.square(_bounds_by_draw(view, is_detected)) + _wander_variances(
        view, detections, is_detected
    )
    if view.shots.any_two:  # they differ by what is detected
        squared_bounds = np.where(is_resolved, squared_bounds, np.nan)
    errors = [
        np.where(is_resolved, error, np.nan)
        for error in _measurement_errors(view, detections, is_detected)
    ]
    return counts, np.array(
        [n_false_bins / max(n_searched, 1), n_false_groups, *errors, *squared_bounds]
    )


def _bounds_by_draw(view: SpectrumView, is_detected: np.ndarray) -> np.ndarray:
    """Bounds of range and velocity in draws (2, m) by the segments (3, m) that tell of them."""
    bounds = np.empty((2, is_detected.shape[1]))
    bounds[...] = np.reshape(measurement_bound(view), (2, 1))
    if view.shots.any_two:
        for is_missing in np.eye(3, dtype=bool):
            has_pattern = (is_detected == ~is_missing[:, None]).all(axis=0)
            bounds[:, has_pattern] = np.reshape(measurement_bound(view, ~is_missing), (2, 1))
    return bounds


def _wander_variances(
    view: SpectrumView, detections: Sequence[SegmentDetections], is_detected: np.ndarray
) -> np.ndarray:
    """Mean square errors of range and velocity by speckle in draws, (2, m)."""
    shots, point, n_draws = view.shots, view.point, is_detected.shape[1]
    if shots.line_gradients is None:
        return np.zeros((2, n_draws))
    point_indices = np.full(n_draws, point)
    line_noise_sigma = float(np.broadcast_to(shots.line_noise_sigma, shots.size)[point])
    signal = np.array([
        np.nan if s is None else np.abs(s.spectrum[s.strongest_bin]) ** 2 for s in view.signals
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
    return wander_variance(shots, point_indices, peaks, is_detected)


def measurement_bound(
    view: SpectrumView, is_used: Sequence[bool] | np.ndarray | None = None
) -> RangeVelocityDeviation:
    """Bound of range and velocity that are resolved from the beats that are ``is_used``.

    By default of up and down beat; where segments have slopes of their own, of all. Of
    Cramer and Rao in white noise, and what the laser's phase adds; looks tell independently.
    """
    shots, point = view.shots, view.point
    sample_rate, root_n_looks, laser_timing = (
        float(shots.sample_rate[point]),
        math.sqrt(shots.looks.number),
        _laser_timing(shots, point),
    )
    record_lengths = np.full(len(view.signals), shots.window.length)
    if shots.n_samples_before_echo is not None:
        record_lengths = np.maximum(record_lengths - shots.n_samples_before_echo[:, point], 2)
        laser_timing["duration"] = record_lengths[0] / np.asarray(sample_rate)
    laser_deviation = phase_noise_deviation(**laser_timing)
    cnr_factor = 2 if shots.complex_record else 1  # as much noise has two samples for one
    if is_used is None:
        is_used = (True, shots.chirp_slopes != waveform.DEFAULT_CHIRP_SLOPES, True)
    up, doppler, down = (
        np.inf
        if s is None or not exists
        else np.hypot(
            beat_frequency_bound(
                cnr=cnr_factor * s.cnr, n_samples=record_length, sample_rate=sample_rate
            ),
            laser_deviation,
        )
        / root_n_looks
        for s, exists, record_length in zip(
            view.signals, is_used, record_lengths.tolist(), strict=True
        )
    )
    return range_velocity_deviation(
        up=up, doppler=doppler, down=down, carriers=_carriers_at(shots, point),
        chirp_rate=_value_at(shots.chirp_rate, point), range=shots.range[point],
        radial_velocity=shots.radial_velocity[point], slopes=shots.chirp_slopes,
    )  # fmt: skip


def _measurement_errors(
    view: SpectrumView, detections: Sequence[SegmentDetections], is_detected: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute reported less true range [m] and radial velocity [m/s], (m,) each.

    By the segments (3, m) that are detected; up, Doppler and down beat are resolved as ever.
    """
    shots, point = view.shots, view.point
    bin_width = view.setting.sample_rate / view.setting.fft_size
    up, doppler, down = (segment.frequency * bin_width for segment in detections)
    measured = waveform.resolve_range_velocity(
        up=up,
        doppler=doppler if shots.has_segment[1] else None,
        down=down,
        carrier=_carriers_at(shots, point)[0],
        bandwidth=_value_at(shots.chirp_bandwidth, point),
        duration=_value_at(shots.chirp_duration, point),
        sample_rate=shots.sample_rate[point],
        bin_width=np.asarray(bin_width),
        two_beat_assumption=shots.two_beat_assumption,
        has_signs=shots.complex_record,
    )
    measured_velocity = measured.radial_velocity * (
        1 + _value_at(shots.velocity_bias_fraction, point)
    )
    range_walk = _value_at(shots.range_walk_time, point) * measured_velocity  # within the shot
    measured_range = measured.range + range_walk
    uses_fit = shots.chirp_slopes != waveform.DEFAULT_CHIRP_SLOPES or (
        shots.any_two & ~is_detected.all(axis=0)
    )
    if np.any(uses_fit):
        cnr = np.array([[0.0 if s is None else s.cnr] for s in view.signals])
        fitted_values = fit_peaks(
            shots, np.array([up, doppler, down]), is_detected * cnr, np.array([point])
        )
        measured_range = np.where(uses_fit, fitted_values.range, measured_range)
        measured_velocity = np.where(uses_fit, fitted_values.radial_velocity, measured_velocity)
    return measured_range - shots.range[point], measured_velocity - shots.radial_velocity[point]


def _carriers_at(shots: Shots, point: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    up, doppler, down = (_value_at(carrier, point) for carrier in shots.carriers)
    return up, doppler, down


def _value_at(column: np.ndarray | float, point: int) -> np.ndarray:
    """Point i of a column that may be one value for all."""
    column = np.asarray(column)
    return np.asarray(column[point] if column.ndim else column)
