"""Spectra of a single shot of a grid or a scene, with its detections, as a figure and a report."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet

from sweep.analysis import canvas, labels
from sweep.analysis.selection import GRAZING_ANGLE_PATH
from sweep.analysis.tables import TablePage, TextTable
from sweep.model import evaluation as shot_model
from sweep.model import waveform, window
from sweep.model.beam import DIVERGENCE_PATH, WAIST_PATH
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.catalogue import DEFAULT_EFFECTS, EFFECTS
from sweep.model.evaluation import prepare_shots
from sweep.model.pointcloud.eyepoints import Eyepoints
from sweep.model.pointcloud.returns import beamlet_line_positions
from sweep.model.spectrum.segment_spectra import SegmentResults, full_segment_spectrum
from sweep.model.threshold import THRESHOLD_PATHS
from sweep.spec import GridSpec, SpecError
from sweep.spec.rules import Mistake
from sweep.spec.sections import parameter_rules
from sweep.units import percent_text

ParameterValues = Mapping[str, float | int | str]
"""SI values of parameters, by dotted path."""

SEGMENT_DISPLAY_NAMES = ("up-chirp", "Doppler", "down-chirp")
"""Display name of each segment of a shot, by the segment's index."""


@dataclass(frozen=True)
class BinGroup:
    """Group of adjacent bins above the threshold, by their indices in a spectrum."""

    first_index: int
    """Index of the first bin of the group."""
    last_index: int
    """Index of the last bin of the group."""
    peak_index: int
    """Index of the strongest bin of the group."""


@dataclass(frozen=True)
class DisplayedSegment:
    """Spectrum of one segment (chirp) of a shot, with n bins, and its detections."""

    name: str
    """Display name of the segment."""
    chirp_rate_ratio: float
    """Frequency slope divided by the chirp rate: 1 for the up-chirp, 0 for constant frequency."""
    bin_numbers: np.ndarray
    """Numbers of the bins (n,), rising. A complex record has negative bin numbers too."""
    frequency: np.ndarray
    """Frequencies of the bins (n,) [Hz]."""
    signal_magnitude: np.ndarray
    """Magnitude |X| of each bin (n,) without noise [V]."""
    magnitude: np.ndarray
    """Magnitude |X| of each bin (n,), with noise if noise was drawn [V]."""
    beat_frequency: float
    """Signed beat frequency, before it is folded at the Nyquist frequency [Hz]."""
    carrier_frequency: float
    """Carrier frequency of the segment [Hz]."""
    bin_groups: tuple[BinGroup, ...]
    """Groups of adjacent bins above the threshold. Each group is one detection."""
    snr: float
    """Signal-to-noise power ratio in the strongest bin of the signal."""
    pd: float
    """Probability of detection in the segment."""

    @property
    def peak_index(self) -> int:
        """Index of the strongest bin of the segment, with noise if noise was drawn."""
        return int(np.argmax(self.magnitude))


@dataclass(frozen=True)
class SimulatedShot:
    """One simulated shot: parameters, spectra with detections, reported range and velocity."""

    label: str
    """Label of the shot in figures and tables."""
    parameters: ParameterValues
    """SI values of the shot's parameters, by dotted path."""
    prepared_shot: shot_model.Shots
    """Lines, noise and threshold on which the shot's spectra depend, as arrays of one shot."""
    outputs: dict[str, float]
    """Results of the model for the shot, by the name of the output variable."""
    segments: tuple[DisplayedSegment, ...]
    """Spectra of the segments that the shot has."""
    reported_range: float
    """Range that follows from the strongest bins of the segments [m]."""
    reported_radial_velocity: float
    """Radial velocity that follows from the strongest bins of the segments [m/s]."""

    @property
    def noise_sigma(self) -> float:
        """Standard deviation of the real part, or of the imaginary part, of a bin's noise [V]."""
        return float(self.prepared_shot.bin_noise_sigma[0])

    @property
    def threshold(self) -> float:
        """Detection threshold on the magnitude |X| of a bin [V]."""
        return float(self.prepared_shot.threshold[0])

    @property
    def noise_rms(self) -> float:
        """Root mean square of the magnitude |X| of a bin that holds noise alone [V]."""
        return float(np.sqrt(2)) * self.noise_sigma

    def magnitude_to_dbv(self, magnitude: np.ndarray | float) -> np.ndarray:
        """Return the amplitude [dBV] of a tone whose magnitude |X| in its bin is given [V]."""
        with np.errstate(divide="ignore"):
            return 20 * np.log10(2 * np.asarray(magnitude) / self.prepared_shot.window.sum)

    @property
    def is_detected(self) -> bool:
        """True if the segments that a detection requires exceed the threshold.

        They are the up- and the down-chirp, or any two segments, as the spec's detection rule says.
        """
        if self.prepared_shot.detects_by_any_two_segments:
            return sum(bool(segment.bin_groups) for segment in self.segments) >= 2
        return all(
            segment.bin_groups
            for segment in self.segments
            if segment.name != SEGMENT_DISPLAY_NAMES[1]
        )


def simulate_shot(
    parameters: ParameterValues,
    effects: Collection[str] = DEFAULT_EFFECTS,
    *,
    label: str = "",
    seed: int | None = None,
) -> SimulatedShot:
    """Simulate one shot at a flat target; return its spectra, detections and measurement.

    Parameters
    ----------
    parameters
        SI values of all parameters, by dotted path.
    effects
        Names of the effects to simulate.
    label
        Label of the shot in figures and tables.
    seed
        Seed of the noise in the spectra. Without a seed the spectra have no noise.
    """
    ((_, prepared_shot),) = prepare_shots(parameters, effects)
    return simulate_prepared_shot(prepared_shot, parameters, label=label, seed=seed)


def simulate_prepared_shot(
    prepared_shot: shot_model.Shots,
    parameters: ParameterValues,
    *,
    label: str = "",
    seed: int | None = None,
) -> SimulatedShot:
    """Simulate one shot of a grid or a scene from all that its spectra depend on.

    `prepared_shot` holds lines, noise and threshold. Other arguments and the result are those of
    :func:`simulate_shot`.
    """
    segment_results = shot_model.evaluate_segments(prepared_shot)
    segments = tuple(
        _segment_spectrum(prepared_shot, segment_results, k, seed)
        for k in range(3)
        if prepared_shot.has_segment[k]
    )
    peak_frequency = segment_results.frequency.copy()
    for segment in segments:
        peak_frequency[SEGMENT_DISPLAY_NAMES.index(segment.name), 0] = segment.frequency[
            segment.peak_index
        ]
    measurement = shot_model.measure_range_velocity(
        prepared_shot, segment_results._replace(frequency=peak_frequency)
    )
    return SimulatedShot(
        label=label,
        parameters=parameters,
        prepared_shot=prepared_shot,
        outputs={
            name: float(value[0])
            for name, value in shot_model.shot_statistics(prepared_shot).items()
        },
        segments=segments,
        reported_range=float(measurement.range[0]),
        reported_radial_velocity=float(measurement.radial_velocity[0]),
    )


def _segment_spectrum(
    prepared_shot: shot_model.Shots,
    segment_results: SegmentResults,
    segment_index: int,
    seed: int | None,
) -> DisplayedSegment:
    """Return the spectrum of a segment with its detections.

    `segment_results` are the results of the model for the shot's segments. Noise is drawn if `seed`
    is given.
    """
    signed_bins, signal_magnitude = (
        prepared_shot.all_signed_bins,
        full_segment_spectrum(prepared_shot, 0, segment_index),
    )
    magnitude, looks = np.abs(signal_magnitude), prepared_shot.looks
    if seed is not None:
        noise = np.array(
            [
                simulate_noise_spectrum(
                    prepared_shot, seed=seed, segment=segment_index, look=look
                ).take(signed_bins, mode="wrap")
                for look in range(looks.number)
            ]
        )
        noise = noise if looks.n_coherent == 1 else noise.mean(axis=0, keepdims=True)
        noisy_magnitudes = np.abs(signal_magnitude + noise)
        magnitude = (
            looks.decisive_magnitude(noisy_magnitudes)
            if looks.is_noncoherent
            else noisy_magnitudes[0]
        )
    segment = prepared_shot.waveform_segments[segment_index]
    carrier_frequency = np.asarray(segment.carrier).item()
    beat_frequency = waveform.beat_frequency(
        segment.chirp_rate_ratio,
        carrier=carrier_frequency,
        chirp_rate=np.asarray(prepared_shot.waveform.chirp_rate),
        range=prepared_shot.range[0] - np.ravel(segment.range_decrease_since_shot_start)[0],
        radial_velocity=np.ravel(segment.doppler_ratio)[0] * SPEED_OF_LIGHT / 2,
    )
    return DisplayedSegment(
        name=SEGMENT_DISPLAY_NAMES[segment_index],
        chirp_rate_ratio=segment.chirp_rate_ratio,
        bin_numbers=signed_bins,
        frequency=signed_bins * float(prepared_shot.sample_rate[0]) / prepared_shot.fft_size,
        signal_magnitude=signal_magnitude,
        magnitude=magnitude,
        beat_frequency=np.asarray(beat_frequency).item(),
        carrier_frequency=carrier_frequency,
        bin_groups=find_bin_groups(magnitude, float(prepared_shot.threshold[0])),
        snr=float(prepared_shot.snr(segment_results.magnitude[segment_index])[0]),
        pd=float(segment_results.pd[segment_index, 0]),
    )


def simulate_noise_spectrum(
    prepared_shot: shot_model.Shots, *, seed: int, segment: int, look: int = 0
) -> np.ndarray:
    """Return a random noise spectrum of the windowed record of one look.

    Parameters
    ----------
    prepared_shot
        Shot whose noise variance, window and FFT size are used.
    seed
        Seed of the random numbers. Each segment and look has its own stream.
    segment
        Index of the segment: 0 up, 1 Doppler, 2 down.
    look
        Index of the look.

    Returns
    -------
    numpy.ndarray
        Complex spectrum [V] of a record with FFT size N: (N/2 + 1,) for a real record, (N,) for a
        complex one.
    """
    window_shape = prepared_shot.window
    spawn_key = (segment, look) if look else (segment,)
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=spawn_key))
    deviation = float(np.sqrt(prepared_shot.noise_variance[0]))
    in_phase = generator.normal(0.0, deviation, window_shape.length)
    taper = window.window_samples(window_shape.name, window_shape.length)
    if prepared_shot.complex_record:
        quadrature = generator.normal(0.0, deviation, window_shape.length)
        return np.fft.fft((in_phase + 1j * quadrature) / np.sqrt(2) * taper, prepared_shot.fft_size)
    return np.fft.rfft(in_phase * taper, prepared_shot.fft_size)


def find_bin_groups(magnitude: np.ndarray, threshold: float) -> tuple[BinGroup, ...]:
    """Return the groups of adjacent bins with magnitudes at or above the threshold, in order."""
    bins_above = np.flatnonzero(magnitude >= threshold)
    runs = (
        np.split(bins_above, np.flatnonzero(np.diff(bins_above) > 1) + 1) if bins_above.size else []
    )
    return tuple(
        BinGroup(int(run[0]), int(run[-1]), int(run[np.argmax(magnitude[run])])) for run in runs
    )


def range_or_velocity_from_frequency(
    shot: SimulatedShot, segment: DisplayedSegment, frequency: np.ndarray
) -> np.ndarray:
    """Return the range or radial velocity for frequencies in a segment's spectrum.

    Parameters
    ----------
    shot
        Simulated shot.
    segment
        Segment of this shot.
    frequency
        Frequencies in the spectrum [Hz]. They are taken to be folded at the Nyquist frequency like
        the segment's beat frequency.

    Returns
    -------
    numpy.ndarray
        Range [m] for a chirp, given the true radial velocity. Radial velocity [m/s] for a segment
        of constant frequency.

    Notes
    -----
    The unfolded frequency is f, the carrier f_c, and the Doppler ratio beta = 2 v / c, with the
    radial velocity v and the speed of light c. The slope of the segment is s times the chirp rate
    S. The range R, or the velocity v, is

        R = c (f_c beta - f) / (2 s S (1 + beta)) for a chirp, v = c f / (2 f_c) for s = 0.
    """
    prepared_shot = shot.prepared_shot
    sample_rate = float(prepared_shot.sample_rate[0])
    fold_frequency = np.rint(segment.beat_frequency / sample_rate) * sample_rate
    is_mirrored = segment.beat_frequency < fold_frequency and not prepared_shot.complex_record
    signed_frequency = fold_frequency + (-1.0 if is_mirrored else 1.0) * np.asarray(frequency)
    if segment.chirp_rate_ratio == 0:
        return signed_frequency * SPEED_OF_LIGHT / (2 * segment.carrier_frequency)
    beta = float(np.asarray(prepared_shot.motion.doppler_ratio).flat[0])
    range_beat = (segment.carrier_frequency * beta - signed_frequency) / segment.chirp_rate_ratio
    return (
        range_beat
        * SPEED_OF_LIGHT
        / (2 * np.asarray(prepared_shot.waveform.chirp_rate).item() * (1 + beta))
    )


SPECTRUM_COLOUR, THRESHOLD_COLOUR, NOISE_COLOUR, DETECTION_COLOUR = (
    canvas.LINE_COLOURS[0],
    canvas.LINE_COLOURS[2],
    canvas.LINE_COLOURS[1],
    "black",
)
"""Colours of the spectrum, the threshold, the noise level and detections."""
LEVEL_AXIS_MARGIN_BELOW_DB, LEVEL_AXIS_MARGIN_ABOVE_DB = 25.0, 12.0
"""Margins of the vertical axis of a spectrum [dB].

The first is the margin below the noise, the second that above the strongest bin or the threshold.
"""

PEAK_VIEW_HALF_WIDTH_MIN_BINS = 12
"""Least distance from a peak to the edges of a close-up of the peak [bins]."""

DETECTION_VIEW_MARGIN_MIN_BINS = 8
"""Least distance from the outermost detections in a close-up to the close-up's edges [bins]."""

NEARBY_DETECTION_BAND_FRACTION_MAX = 0.05
"""Largest distance from a peak at which the peak's close-up still shows a detection.

The distance is a fraction of the width of the spectrum.
"""


def draw_spectra_sheet(
    shots: Sequence[SimulatedShot], *, title: str, footnote: str, shows_detections: bool = False
) -> Sheet:
    """Return a sheet of spectra, with a row for each segment and two columns for each shot.

    The first column of a shot shows the full band, the second a close-up of the peak. With
    ``shows_detections`` the close-up includes all detections near the peak.
    """
    n_rows, n_columns = len(shots[0].segments), 2 * len(shots)
    width = 5.4 if len(shots) == 1 else 4.2
    sheet, axes = canvas.sheet_with_axes(width * n_columns, 3.1 * n_rows + 1.2, n_rows, n_columns)
    decibel_limits = _level_axis_limits_db(shots)
    for j, shot in enumerate(shots):
        for i, segment in enumerate(shot.segments):
            whole_axes, close_axes = axes[i * n_columns + 2 * j], axes[i * n_columns + 2 * j + 1]
            _draw_spectrum(whole_axes, shot, segment, slice(None), 0.5)
            view = (
                detection_bin_slice(segment)
                if shows_detections
                else peak_bin_slice(segment.signal_magnitude)
            )
            _draw_spectrum(close_axes, shot, segment, view, 1.0)
            _annotate_snr_and_pd(close_axes, shot, segment)
            for panel in (whole_axes, close_axes):
                panel.set_ylim(*decibel_limits)
                panel.grid(True)
            if not segment.bin_groups:
                whole_axes.text(
                    0.02,
                    0.95,
                    "no detection",
                    transform=whole_axes.transAxes,
                    color=DETECTION_COLOUR,
                    va="top",
                    size=9,
                )
            whole_axes.set_title(", ".join(filter(None, [segment.name, shot.label])), size=10)
            if j == 0:
                whole_axes.set_ylabel("amplitude (dB re 1 V)")
    axes[0].legend(fontsize=7.5, loc="upper right", framealpha=0.9, ncols=3)
    for panel in axes[(n_rows - 1) * n_columns :]:
        panel.set_xlabel("frequency (MHz)")
    canvas.set_title(sheet, title)
    canvas.set_caption(sheet, footnote)
    return sheet


def _level_axis_limits_db(shots: Sequence[SimulatedShot]) -> tuple[float, float]:
    """Return the limits of a vertical axis [dBV] that shows the noise and peaks of all shots."""
    low = (
        min(float(shot.magnitude_to_dbv(shot.noise_rms)) for shot in shots)
        - LEVEL_AXIS_MARGIN_BELOW_DB
    )
    high = max(
        float(shot.magnitude_to_dbv(max(segment.magnitude.max(), shot.threshold)))
        for shot in shots
        for segment in shot.segments
    )
    return low, high + LEVEL_AXIS_MARGIN_ABOVE_DB


def _draw_spectrum(
    axes: Axes, shot: SimulatedShot, segment: DisplayedSegment, view: slice, line_width: float
) -> None:
    """Draw a slice of a segment's spectrum on axes, with threshold, noise level and detections."""
    frequency_mhz = segment.frequency[view] / 1e6
    level_db = np.maximum(shot.magnitude_to_dbv(segment.magnitude[view]), -500.0)
    marker = "." if frequency_mhz.size <= 200 else ""
    axes.plot(
        frequency_mhz,
        level_db,
        color=SPECTRUM_COLOUR,
        linewidth=line_width,
        marker=marker,
        markersize=4,
    )
    for value, colour, dash, label in (
        (shot.threshold, THRESHOLD_COLOUR, "--", "threshold"),
        (shot.noise_rms, NOISE_COLOUR, "-.", "noise (rms)"),
    ):
        height_db = float(shot.magnitude_to_dbv(value))
        axes.axhline(height_db, color=colour, linestyle=dash, linewidth=1.2, label=label)
    peak_indices = np.array([group.peak_index for group in segment.bin_groups], dtype=int)
    axes.plot(
        segment.frequency[peak_indices] / 1e6,
        shot.magnitude_to_dbv(segment.magnitude[peak_indices]),
        linestyle="",
        marker="v",
        markersize=7,
        color=DETECTION_COLOUR,
        markeredgecolor="white",
        label="detection",
    )
    axes.set_xlim(float(frequency_mhz[0]), float(frequency_mhz[-1]))


def _annotate_snr_and_pd(axes: Axes, shot: SimulatedShot, segment: DisplayedSegment) -> None:
    """Write SNR and pd into a corner of the axes, and add a top axis of range or velocity."""
    annotation_lines = (
        [f"signal-to-noise {10 * np.log10(segment.snr):.1f} dB"] if segment.snr > 0 else []
    )
    axes.text(
        0.98,
        0.95,
        "\n".join([*annotation_lines, f"pd {segment.pd:.4g}"]),
        transform=axes.transAxes,
        size=8,
        color=DETECTION_COLOUR,
        ha="right",
        va="top",
    )
    value_at_zero, value_at_1_mhz = (
        float(q) for q in range_or_velocity_from_frequency(shot, segment, np.array([0.0, 1e6]))
    )

    def to_range_or_velocity(mhz: Any) -> Any:
        return value_at_zero + (value_at_1_mhz - value_at_zero) * mhz

    def to_mhz(value: Any) -> Any:
        return (value - value_at_zero) / (value_at_1_mhz - value_at_zero)

    top_axis = axes.secondary_xaxis("top", functions=(to_range_or_velocity, to_mhz))
    top_axis.set_xlabel(
        "range (m)" if segment.chirp_rate_ratio else "radial velocity (m/s)", size=8, labelpad=4
    )
    top_axis.tick_params(labelsize=8)
    top_axis.ticklabel_format(axis="x", useOffset=False)
    axes.ticklabel_format(axis="x", useOffset=False)


def peak_bin_slice(magnitude: np.ndarray) -> slice:
    """Return the slice of bins that a close-up of the largest magnitude shows.

    It contains the bins near the peak with at least a tenth of the largest magnitude, and a margin.
    """
    peak = int(np.argmax(magnitude))
    strong_bins = np.flatnonzero(magnitude >= 0.1 * magnitude[peak])
    nearby_bins = strong_bins[np.abs(strong_bins - peak) < magnitude.size // 8]
    half_width = max(
        PEAK_VIEW_HALF_WIDTH_MIN_BINS, int(1.5 * max(peak - nearby_bins[0], nearby_bins[-1] - peak))
    )
    return slice(max(peak - half_width, 0), min(peak + half_width + 1, magnitude.size))


def detection_bin_slice(segment: DisplayedSegment) -> slice:
    """Return the slice of bins that a close-up of a segment's peak and nearby detections shows."""
    view, n_bins = peak_bin_slice(segment.signal_magnitude), segment.signal_magnitude.size
    peak = int(np.argmax(segment.signal_magnitude))
    near_groups = [
        group
        for group in segment.bin_groups
        if abs(group.peak_index - peak) <= NEARBY_DETECTION_BAND_FRACTION_MAX * n_bins
    ]
    if not near_groups:
        return view
    first_index, last_index = (
        min(g.first_index for g in near_groups),
        max(g.last_index for g in near_groups),
    )
    margin = max(DETECTION_VIEW_MARGIN_MIN_BINS, (last_index - first_index) // 6)
    return slice(
        max(min(view.start, first_index - margin), 0),
        min(max(view.stop, last_index + margin + 1), n_bins),
    )


def draw_scene_shot_sheet(
    shot: SimulatedShot,
    eyepoints: Eyepoints,
    surfaces: Sequence[str],
    *,
    title: str,
    remarks: Sequence[str],
) -> Sheet:
    """Return a sheet of the spectra of a scene's shot, with marks at its beamlets' lines."""
    notes = [*remarks, "marks at the foot: where the beamlets' own lines are, by surface"]
    sheet = draw_spectra_sheet(
        [shot], title=title, footnote=labels.join_sentences(notes), shows_detections=True
    )
    is_hit, line_bins = eyepoints.surface[0] >= 0, beamlet_line_positions(shot.prepared_shot)[0]
    bin_width = float(shot.prepared_shot.sample_rate[0]) / shot.prepared_shot.fft_size
    for i, segment in enumerate(shot.segments):
        line_frequencies = (
            line_bins[SEGMENT_DISPLAY_NAMES.index(segment.name), is_hit] * bin_width / 1e6
        )
        close_axes = sheet.axes[2 * i + 1]
        line_marks = [
            close_axes.plot(
                surface_lines,
                np.full(surface_lines.size, 0.02),
                "|",
                transform=close_axes.get_xaxis_transform(),
                color=canvas.LINE_COLOURS[k % 8],
                markersize=9,
                scalex=False,
                scaley=False,
                label=surfaces[surface_number],
            )[0]
            for k, surface_number in enumerate(np.unique(eyepoints.surface[0, is_hit]))
            for surface_lines in [line_frequencies[eyepoints.surface[0, is_hit] == surface_number]]
        ]
        if i == 0:
            close_axes.legend(handles=line_marks, fontsize=7.5, loc="upper left", framealpha=0.9)
    return sheet


def _noise_table(shot: SimulatedShot) -> TextTable:
    """Return a table of the noise at the ADC: volts and share of the noise variance, by source."""
    variance_by_source = {
        n: float(np.asarray(v).item()) for n, v in shot.prepared_shot.noise.variances.items()
    }
    total_variance = sum(variance_by_source.values())
    rows = [
        (
            name.replace("_", " "),
            f"{math.sqrt(variance):.4e}",
            percent_text(variance / total_variance, ".4g"),
        )
        for name, variance in sorted(variance_by_source.items(), key=lambda item: -item[1])
        if variance > 0
    ]
    rows.append(("total", f"{math.sqrt(total_variance):.4e}", percent_text(1.0, ".4g")))
    return TextTable("Noise at the ADC", ("source", "V rms", "share"), rows)


def _segment_table(shot: SimulatedShot) -> TextTable:
    """Return a table with beat frequency, peak, level, SNR, pd and bin groups of each segment."""
    columns = (
        "segment", "beat (MHz)", "seen (MHz)", "peak bin", "level (dBV)", "SNR (dB)", "pd",
        "groups",
    )  # fmt: skip
    heading = (
        f"Segments (noise of a bin {shot.magnitude_to_dbv(shot.noise_rms):.1f} dBV rms, threshold "
        f"{shot.magnitude_to_dbv(shot.threshold):.1f} dBV)"
    )
    rows = [
        (
            segment.name,
            f"{segment.beat_frequency / 1e6:+.6f}",
            f"{segment.frequency[segment.peak_index] / 1e6:.6f}",
            int(segment.bin_numbers[segment.peak_index]),
            f"{shot.magnitude_to_dbv(segment.magnitude[segment.peak_index]):.1f}",
            f"{10 * math.log10(segment.snr):.2f}" if segment.snr > 0 else "-",
            f"{segment.pd:.6g}",
            len(segment.bin_groups),
        )
        for segment in shot.segments
    ]
    return TextTable(heading, columns, rows)


def _measurement_table(shot: SimulatedShot) -> TextTable:
    """Return a table of range and radial velocity: true value, reported value, and error."""
    prepared_shot = shot.prepared_shot
    rows = [
        (
            name,
            f"{true_value:.{digits}f}",
            f"{reported_value:.{digits}f}",
            f"{reported_value - true_value:+.{digits}f}",
        )
        for name, digits, true_value, reported_value in (
            ("range (m)", 4, float(prepared_shot.range[0]), shot.reported_range),
            (
                "radial velocity (m/s)",
                5,
                float(prepared_shot.target.radial_velocity[0]),
                shot.reported_radial_velocity,
            ),
        )
    ]
    verdict = "detected" if shot.is_detected else "NOT detected: read off the strongest bins"
    return TextTable(f"Report ({verdict})", ("", "true", "reported", "error"), rows)


def _false_alarm_table(shot: SimulatedShot) -> TextTable:
    """Return a table of the false-alarm and leakage probabilities of a shot."""
    label_by_variable = {
        "pfa_bin": "one bin, noise", "pfa_segment": "up-chirp segment, noise",
        "pfa_both_chirps": "both chirp segments, noise", "pfa_shot": "any segment, noise",
        "p_leakage_up": "up-chirp segment, leakage",
        "p_leakage_down": "down-chirp segment, leakage",
    }  # fmt: skip
    rows = [(label, f"{shot.outputs[name]:.4e}") for name, label in label_by_variable.items()]
    return TextTable("False alarms", ("", "probability"), rows)


REPORTED_AXIS_VALUES_MAX = 3
"""Largest number of values of an only axis for which a report shows a shot at every value."""

_REPORTED_PARAMETER_PATHS = (
    "target.range",
    "target.grazing_angle",
    "target.radial_velocity",
    "target.reflectance",
    "target.reflectance_law",
    "instrument.laser.power",
    "instrument.telescope.aperture",
    DIVERGENCE_PATH,
    WAIST_PATH,
    "instrument.processing.fft_size",
    "instrument.processing.window",
    *THRESHOLD_PATHS,
)
"""Dotted paths of the parameters that the report of a shot lists."""


class ShotReport(NamedTuple):
    """Report of the spectra of shots, as text and in files."""

    text: str
    """Tables of the shots as text."""
    files: list[Path]
    """Paths of the written files: pictures and text."""


def write_shot_report(
    spec: GridSpec,
    coordinate_values: Mapping[str, str],
    directory: str | Path,
    *,
    draws_noise: bool = False,
    seed: int = 0,
    picture_format: str = "png",
) -> ShotReport:
    """Write the spectra and tables of one shot of a grid; return the text and the written files.

    Parameters
    ----------
    spec
        Spec of the grid.
    coordinate_values
        Values of coordinates, written with units, by name or path. A coordinate without a value
        has the first value of its axis. Without any values, a study with a single axis of few
        values has a shot for each of them.
    directory
        Output directory.
    draws_noise
        If true, noise is drawn into the spectra.
    seed
        Seed of the noise.
    picture_format
        ``png``, ``pdf`` or ``svg``.

    Raises
    ------
    SpecError
        A value can't be read, or is given twice.
    """
    effect_modes = spec.effect_modes()
    effects = [e.name for e in EFFECTS if not e.is_random and effect_modes[e.name] != "off"]
    shots = [
        simulate_shot(parameters, effects, label=label, seed=seed if draws_noise else None)
        for label, parameters in select_shot_parameters(spec, coordinate_values)
    ]
    name_parts = [
        re.sub(r"[^A-Za-z0-9.+-]+", "", f"{name.split('.')[-1]}{v}")
        for name, v in coordinate_values.items()
    ]
    directory, stem = Path(directory), "_".join(["shot", *name_parts])[:120]
    remark = f"noise drawn with seed {seed}" if draws_noise else "the signal alone, no noise drawn"
    with canvas.uniform_style():
        sheet = draw_spectra_sheet(
            shots,
            title=spec.title,
            footnote=labels.join_sentences([remark, _describe_shared_parameters(shots)]),
        )
        paths = [
            canvas.save_sheet(sheet, directory / f"{stem}.{picture_format}"),
            directory / f"{stem}.txt",
        ]
    page = TablePage(spec.title, _shot_tables(shots), [f"Spectra: {remark}."], [])
    paths[1].write_text(page.to_text(), encoding="utf-8")
    return ShotReport(page.to_text(), paths)


class LabelledParameters(NamedTuple):
    """Parameters of a shot that is drawn."""

    label: str
    """Coordinate value of the shot along the study's only axis; '' for a report of one shot."""
    parameters: ParameterValues
    """SI values of all parameters by dotted path."""


def select_shot_parameters(
    spec: GridSpec, coordinate_values: Mapping[str, str]
) -> list[LabelledParameters]:
    """Return the label and the parameters of each shot that :func:`write_shot_report` draws.

    ``coordinate_values`` are values with units, by name or path of a coordinate. Raise SpecError if
    a value can't be read, or is given twice.
    """
    axis_parameters = [axis_parameter for axis in spec.axes for axis_parameter in axis.parameters]
    path_by_name, rule_by_path = (
        {m.coordinate_name: m.path for m in axis_parameters},
        parameter_rules(),
    )
    names_by_path: dict[str, str] = {}
    for name in coordinate_values:
        path = path_by_name.get(name, name)
        if path in names_by_path:
            problem = f"is given twice, as {names_by_path[path]} and as {name}"
            raise SpecError([Mistake(path, problem, suggestion="keep one of them")])
        names_by_path[path] = name
    draws_all_values = (
        not coordinate_values
        and len(spec.axes) == 1
        and spec.axes[0].size <= REPORTED_AXIS_VALUES_MAX
    )
    labelled_parameters: list[LabelledParameters] = []
    for i in range(spec.axes[0].size if draws_all_values else 1):
        raw_values: dict[str, object] = {
            m.path: rule_by_path[m.path].format(m.values[i]) for m in axis_parameters
        }
        # Names that are no coordinates are passed on as paths: the spec reads or refuses them.
        raw_values |= {
            path_by_name.get(name, name): value for name, value in coordinate_values.items()
        }
        label = ", ".join(
            labels.format_coordinate_value(m.coordinate_name, m.display_values[i], m.units)
            for m in axis_parameters
        )
        labelled_parameters.append(
            LabelledParameters(
                label if draws_all_values else "", spec.parameters_with_overrides(raw_values)
            )
        )
    return labelled_parameters


def _format_parameters(shot: SimulatedShot, paths: tuple[str, ...]) -> list[tuple[str, str]]:
    """Return pairs of the name and the formatted value of a shot's parameters at given paths."""
    rule_by_path = parameter_rules()
    descriptions = []
    for path in paths:
        value = shot.parameters.get(path)
        if value is None:  # another parameter sets the threshold
            continue
        if (
            path in (DIVERGENCE_PATH, WAIST_PATH) and value == 0
        ):  # the other parameter defines the beam
            continue
        if isinstance(value, str):
            value_text = value
        elif path == GRAZING_ANGLE_PATH:
            value_text = labels.format_quantity(math.degrees(value), "deg")
        else:
            value_text = labels.format_with_si_prefix(value, rule_by_path[path].value_unit)
        descriptions.append((labels.coordinate_label(path.rsplit(".", 1)[-1]), value_text))
    return descriptions


def _describe_shared_parameters(shots: list[SimulatedShot]) -> str:
    """Return a line of text with the reported parameters that are equal in all shots."""
    descriptions = [_format_parameters(shot, _REPORTED_PARAMETER_PATHS) for shot in shots]
    return ", ".join(
        f"{name} {value_text}"
        for name, value_text in descriptions[0]
        if all((name, value_text) in e for e in descriptions)
    )


def _shot_tables(shots: list[SimulatedShot]) -> list[TextTable]:
    """Return the tables of all shots; their headings begin with the label of the shot."""
    tables = []
    for shot in shots:
        prefix = f"{shot.label}: " if shot.label else ""
        parameter_table = TextTable(
            f"{prefix}Shot",
            ("parameter", "value"),
            _format_parameters(shot, _REPORTED_PARAMETER_PATHS),
        )
        further_tables = [
            _noise_table(shot),
            _segment_table(shot),
            _measurement_table(shot),
            _false_alarm_table(shot),
        ]
        tables += [
            parameter_table,
            *(TextTable(prefix + b.heading, b.columns, b.rows) for b in further_tables),
        ]
    return tables
