"""Preparation of points for the spectrum: link budget, receiver noise, one line on the beam's axis.

This module prepares the minimum that every shot has. Everything else is an effect
(:mod:`sweep.model.effects`), which :mod:`sweep.model.evaluation` applies one by one.

Points that share a category (architecture, window, law, sizes ...) are prepared together. A
footprint's geometry is computed once for all points that share it, whatever their radiometry.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model import waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.bin_noise import SearchedBins, n_alarm_equivalent_bins
from sweep.model.detection.detectors import main_lobe_half_width
from sweep.model.detection.looks import LOOKS_NUMBER_PATH, LOOKS_VOTES_PATH, Looks
from sweep.model.error_budget import SET_BY_TOLERANCE
from sweep.model.ground import Ground
from sweep.model.laser_line import LaserLine
from sweep.model.link_budget import (
    PROCESSING_PREFIX,
    EchoScales,
    LinkBudget,
    NoiseBudget,
    ReceiverFilter,
    relative_amplitude,
    threshold,
)
from sweep.model.receiver_chain import ReceiverNoise
from sweep.model.shot_records import (
    DetectionSettings,
    EchoRecord,
    EchoSpeckle,
    FootprintLines,
    LineImages,
    PermanentLine,
    SpectrumTolerances,
)
from sweep.model.shot_settings import LineMotion, RecordSettings, TargetState, WaveformSettings
from sweep.model.unsupported_shot import UnsupportedShotError
from sweep.model.waveform import WaveformSegment
from sweep.model.window import Window

if TYPE_CHECKING:
    from sweep.model.detection.echo_detection import BinThresholds, DetectionRule, SpeckleTable
    from sweep.model.spectrum.lines import BeamletArrays, PointParameters, SegmentParameters

Parameters = Mapping[str, float | int | str | np.ndarray]

BEAMLETS_ERROR_PATH = "footprint.beamlets_error"
"""Parameter path of the error of the detection probability due to the number of beamlets. It is
present only if the tolerance determines that number."""

CHIRP_RATE_RATIO_PATHS = waveform.DOPPLER_CHIRP_RATE_RATIO_PATH, waveform.DOWN_CHIRP_RATE_RATIO_PATH
"""Parameter paths of the chirp rates of the Doppler and the down segment, each relative to the
up-chirp's."""
SHARED_PARAMETER_PATHS = (
    PROCESSING_PREFIX + "fft_size",
    "footprint.beamlets",
    "record",
    LOOKS_NUMBER_PATH,
    LOOKS_VOTES_PATH,
    *CHIRP_RATE_RATIO_PATHS,
)
"""Paths of numeric parameters that points of one category must share. They must also share all text
parameters."""

LINE_APPROXIMATIONS_MAX = 2
"""Largest number of approximations that a sum of lines may contain. The tolerated error of a bin's
magnitude is divided equally among so many."""


class _PedestalShapes(NamedTuple):
    """Shapes of the pedestals that laser phase noise leaves around the lines of n points."""

    reach_bins: np.ndarray
    """(n,): distance from the lines up to which the pedestal counts as part of the echo [FFT bins].
    """
    line_width_bins: np.ndarray
    """(n,): line width of the laser [FFT bins]."""
    delay_bin_width_product: np.ndarray
    """(n,): delay of the echo times the width of an FFT bin [cycles]; the delay is at most the
    record's duration."""


class BeatCoefficients(NamedTuple):
    """Carriers and chirp rates from which the beats of n points follow, (3, n) each.

    A beat [Hz] is the carrier times the Doppler ratio, minus the chirp rate times the delay 2R/c.
    Rows are the segments up, Doppler and down.
    """

    carrier: np.ndarray
    """(3, n): optical frequency of the segment at the time to which the beat refers [Hz]."""
    chirp_rate: np.ndarray
    """(3, n): signed chirp rate of the segment [Hz/s]."""

    def select_points(self, point_indices: np.ndarray | slice) -> "BeatCoefficients":
        """Return the coefficients of selected points: (m,) indices or a slice."""
        return BeatCoefficients(self.carrier[:, point_indices], self.chirp_rate[:, point_indices])


@dataclass(frozen=True, eq=False, kw_only=True)
class Shots:
    """Prepared shots of points of one category: all that their spectra depend on, as records.

    An effect replaces a record by a changed one. Records with a default stay neutral unless an
    effect sets them. Arrays are (n,) or scalars unless stated otherwise, in SI units. Segments are
    in the order up, Doppler, down.

    Values are read from their records, such as ``shots.target.radial_velocity``. Only what nearly
    every module reads has a property here as well: :attr:`size`, :attr:`range`, :attr:`window`,
    :attr:`fft_size`, :attr:`sample_rate`, :attr:`complex_record` and :attr:`has_segment`. The other
    properties and methods combine several records.
    """

    waveform: WaveformSettings
    """Waveform of a shot: chirp rates, frequencies and times of its segments. Chirp slopes are
    numbers that all points share.
    """
    record: RecordSettings
    """Recorded samples of a segment, their window and FFT; sample rates are (n,)."""
    receiver_filter: ReceiverFilter
    """Low-pass poles and anti-alias filter of the receiver."""
    target: TargetState
    """Range and velocity of the target on the beam's axis at the shot's start, (n,) each. Spectral
    lines use the Doppler ratio of :attr:`motion` instead of this velocity."""
    echo_scales: EchoScales
    """Echo power on the detector [W] and beat amplitude at the ADC [V] of a target with a relative
    echo of 1 [1/sr], (n,) or scalars."""
    receiver_noise: ReceiverNoise
    """Noise variances at the ADC: of the receiver's own sources [V^2], per square of a noise
    current in the detector [V^2/A^2], and per power of light [V^2/W]."""
    noise: NoiseBudget
    """Noise variance of a sample at the ADC by source, and a factor on the total variance."""
    footprint: FootprintLines
    """Ranges, Doppler ratios and amplitudes of the beamlets, relative to the beam's axis."""
    detection_settings: DetectionSettings
    """Detection threshold, searched bins, and rules of detection."""
    looks: Looks
    """Number of looks (records of each segment), and how they are combined."""
    tolerances: SpectrumTolerances
    """Tolerated errors of bin magnitudes and of leakage in the evaluation of spectra."""
    motion: LineMotion = LineMotion()  # noqa: RUF009  # a tuple, as all records below
    """Motion of the target during a shot, as far as it is simulated; none by default."""
    echo_record: EchoRecord = EchoRecord()  # noqa: RUF009
    """Number of samples before the echo arrives, and phase errors of the echo over the record; none
    by default."""
    line_images: LineImages = LineImages()  # noqa: RUF009
    """Amplitudes of the images of lines, which lie at the negative frequencies; no images by
    default."""
    laser_line: LaserLine = LaserLine()  # noqa: RUF009
    """Width of the laser's line, and power of its phase-noise pedestal; a pure tone by default."""
    speckle: EchoSpeckle = EchoSpeckle()  # noqa: RUF009
    """Developed speckle of the echo; none by default."""
    permanent_line: PermanentLine | None = None
    """Line of light other than the echo, such as leaked light, that is in every record; None
    without one."""

    @property
    def range(self) -> np.ndarray:
        """(n,): range of the target on the beam's axis at the start of the shot [m]."""
        return self.target.range

    @property
    def window(self) -> Window:
        """Window that is applied to the samples of the record."""
        return self.record.window

    @property
    def fft_size(self) -> int:
        """FFT size N, the number of samples after zero padding."""
        return self.record.fft_size

    @property
    def sample_rate(self) -> np.ndarray:
        """(n,): sample rate f_s of the record [Hz]."""
        return self.record.sample_rate

    @property
    def complex_record(self) -> bool:
        """True if the record consists of complex samples I + iQ.

        Its spectrum then has bins of signed frequency and no images of lines.
        """
        return self.record.is_complex

    @property
    def has_segment(self) -> np.ndarray:
        """(3,) bool: True for segments that exist, in the order up, Doppler, down."""
        return self.waveform.has_segment

    @property
    def size(self) -> int:
        """Number n of points."""
        return self.range.size

    @property
    def n_bins(self) -> int:
        """Number of bins of a spectrum.

        With the FFT size N the bins are 0 .. N/2 of a real record, and -N/2 .. N/2 - 1 of a complex
        one.
        """
        return self.fft_size if self.complex_record else self.fft_size // 2 + 1

    def to_signed_bins(self, bin_numbers: np.ndarray) -> np.ndarray:
        """Return bin numbers within the spectrum that are equivalent to any integers.

        The range is -N/2 .. N/2 - 1 for a complex record, whose bins are periodic in the FFT size
        N. Bin numbers of a real record, 0 .. N/2, are returned unchanged.
        """
        if not self.complex_record:
            return np.asarray(bin_numbers)
        nyquist_bin = self.fft_size // 2
        return np.asarray((np.asarray(bin_numbers) + nyquist_bin) % self.fft_size - nyquist_bin)

    def bin_indices(self, bin_numbers: np.ndarray) -> np.ndarray:
        """Return the positions of bins in an array of the spectrum that is sorted by frequency.

        Bin 0, of frequency 0, is at position 0 in a real record and at N/2 in a complex one, with
        the FFT size N.
        """
        zero_frequency_index = self.fft_size // 2 if self.complex_record else 0
        return self.to_signed_bins(bin_numbers) + zero_frequency_index

    @property
    def all_signed_bins(self) -> np.ndarray:
        """Numbers of all bins of a spectrum, sorted by frequency, (bins,)."""
        return self.to_signed_bins(np.arange(self.n_bins) - self.bin_indices(np.zeros((), int)))

    @property
    def echo_interval_in_record(self) -> dict[str, Any]:
        """``start`` and ``duration`` [s] of the part of the record with the echo, in a dict.

        ``start`` counts from the segment's start. Each is a scalar or (n,). If the echo does not
        fill the record, each is a tuple of these, by segment.
        """
        if self.echo_record.n_samples_before_echo is None:
            return {"start": self.record.acquisition_delay, "duration": self.record.duration}
        missing_times = [
            n_missing / self.sample_rate for n_missing in self.echo_record.n_samples_before_echo
        ]
        echo_durations = [
            (self.window.length - n_missing) / self.sample_rate
            for n_missing in self.echo_record.n_samples_before_echo
        ]
        return {
            "start": tuple(self.record.acquisition_delay + time for time in missing_times),
            "duration": tuple(echo_durations),
        }

    def echo_window_energy(self, segment: int) -> np.ndarray:
        """Return the sum of the squared window over the samples with the echo, (n,).

        `segment` is the index of the segment.
        """
        if self.echo_record.n_samples_before_echo is None:
            return np.full(self.size, self.window.energy)
        return window_energy_from_sample(self.window)[
            self.echo_record.n_samples_before_echo[segment]
        ]

    @cached_property
    def total_relative_echo(self) -> np.ndarray:
        """Sum over beamlets of the echo power over `EchoScales.echo_power_scale` [1/sr], (n,).

        So the echo power on the detector is this sum times `echo_power_scale`.
        """
        relative_echo = (
            self.footprint.relative_amplitude
            if self.waveform.architecture == "direct"
            else self.footprint.relative_amplitude**2
        )
        return relative_echo.sum(axis=1)[self.footprint.row_of_point]

    @property
    def echo_power(self) -> np.ndarray:
        """Echo power on the detector [W], (n,)."""
        return self.echo_scales.echo_power_scale * self.total_relative_echo

    @cached_property
    def noise_variance_without_echo(self) -> np.ndarray:
        """Noise variance of a sample without an echo [V^2], (n,); it determines the threshold."""
        return self.noise.variance_without_echo + np.zeros(self.size)

    @cached_property
    def whitening_gain(self) -> np.ndarray:
        """Factor on the amplitude of each segment's lines by whitening of the noise, (segments, n).

        Whitening divides the spectrum by the square root of the noise density, relative to white
        noise. The ADC's noise is white already. The factor is that of the line on the beam's axis,
        because it varies little across an echo.
        """
        return broadcast_rows(
            [
                self.whitening_gain_at_frequency(beat_frequency)
                for beat_frequency in self.beat_frequencies
            ],
            (self.size,),
        )

    @property
    def beat_frequencies(self) -> tuple[np.ndarray, ...]:
        """Signed beat frequencies [Hz] of the line on the beam's axis, (n,) for each segment."""
        return tuple(segment.beat_frequency(self.range) for segment in self.waveform_segments)

    def whitening_gain_at_frequency(
        self, beat_frequency: np.ndarray, bin_frequency: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the factor on a line's amplitude in a spectrum whose noise is whitened, (n,).

        Parameters
        ----------
        beat_frequency : ndarray (n,)
            Beat frequency of the line [Hz].
        bin_frequency : ndarray (n,), optional
            Frequency [Hz] of the bins in which the line is observed, whose noise density applies;
            by default the line's frequency.

        Returns
        -------
        ndarray
            Amplitude gain. It includes the anti-alias filter and excludes the receiver's poles,
            which are applied to each line.
        """
        return self.receiver_filter.whitening_gain(
            beat_frequency, self.noise.adc_noise_fraction, bin_frequency
        )

    @cached_property
    def noise_variance(self) -> np.ndarray:
        """Noise variance of a sample at the ADC [V^2], (n,)."""
        return np.asarray(self.noise.variance + np.zeros(self.size))

    @cached_property
    def bin_noise_sigma(self) -> np.ndarray:
        """Noise standard deviation per quadrature of a bin of the unscaled FFT [V], (n,)."""
        return self._bin_noise_sigma_from_variance(self.noise_variance)

    @cached_property
    def line_noise_sigma(self) -> np.ndarray:
        """Noise standard deviation per quadrature of a bin that contains lines [V], (n,)."""
        return self._bin_noise_sigma_from_variance(
            self.noise_variance + self.laser_line.pedestal_variance_under_line
        )

    @cached_property
    def bin_thresholds(self) -> "BinThresholds":
        """Thresholds and noise sigmas of each point's bins, as a record of arrays."""
        from sweep.model.detection.echo_detection import BinThresholds

        noise_sigma_next_to_lines = self._bin_noise_sigma_from_variance(
            self.noise_variance + self.laser_line.pedestal_variance_beside_line
        )
        shapes = self._pedestal_shapes
        values = BinThresholds(
            line_noise_sigma=self.line_noise_sigma,
            threshold=self.threshold,
            noise_sigma_without_pedestal=self.bin_noise_sigma,
            noise_sigma_next_to_lines=noise_sigma_next_to_lines,
            pedestal_reach_bins=shapes.reach_bins,
            pedestal_line_width_bins=shapes.line_width_bins,
            pedestal_delay_bin_width_product=shapes.delay_bin_width_product,
        )
        return BinThresholds(*broadcast_rows(values, (self.size,)))

    @property
    def _pedestal_shapes(self) -> _PedestalShapes:
        """Shapes of phase-noise pedestals; `reach_bins` is 0 where they add no bins to an echo."""
        if (
            self.detection_settings.echo_bin_rule == "peak_bin"
            or self.looks.is_noncoherent
            or not np.any(self.laser_line.lorentzian_fwhm)
        ):
            return _PedestalShapes(*np.zeros((3, self.size)))
        from sweep.model.detection.echo_detection import pedestal_reach_bins

        line_width_bins = self.laser_line.lorentzian_fwhm * self.fft_size / self.sample_rate
        delay = np.minimum(waveform.round_trip_delay(self.range), self.record.duration)
        delay = delay * self.sample_rate / self.fft_size
        power_ratio = self.laser_line.pedestal_variance_beside_line / self.noise_variance
        power_ratio, line_width_bins, delay = broadcast_rows(
            (power_ratio, line_width_bins, delay), (self.size,)
        )
        reach_bins = pedestal_reach_bins(power_ratio, line_width_bins, delay, self.fft_size // 2)
        return _PedestalShapes(
            np.where(reach_bins > self.detection_rule.lobe_half_width, reach_bins, 0.0),
            line_width_bins,
            delay,
        )

    def snr(self, magnitude: np.ndarray) -> np.ndarray:
        """Return the ratio of mean signal power to mean noise power in a bin.

        Parameters
        ----------
        magnitude : ndarray (..., n)
            |X| of the lines in the bin [V].

        Returns
        -------
        ndarray (..., n)
            |X|^2 / (2 sigma^2) plus the pedestal's power ratio. The pedestal of a laser's phase
            noise counts as signal: it fades and is detected with the lines.
        """
        line_snr = np.square(magnitude / self.bin_noise_sigma) / 2
        return np.asarray(
            line_snr + self.laser_line.pedestal_variance_under_line / self.noise_variance
        )

    @cached_property
    def threshold(self) -> np.ndarray:
        """Threshold on a bin's magnitude in the unscaled FFT [V], (n,)."""
        return threshold(
            self.detection_settings.tnr,
            self._bin_noise_sigma_from_variance(self.noise_variance_without_echo),
        )

    @property
    def negligible_signal_ratio(self) -> np.ndarray:
        """Leaked signal in a bin, over the noise sigma, below which the bin counts as noise.

        It applies to bins that are evaluated one by one.
        """
        from sweep.model.detection import echo_detection

        stated_floor, n_bins = self.tolerances.leakage_floor, self.n_bins
        if not np.any(stated_floor == SET_BY_TOLERANCE):
            return stated_floor
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            threshold_ratio = self.threshold / self.bin_noise_sigma
        negligible_signal_law = (
            self.looks.negligible_signal_ratio
            if self.looks.is_noncoherent
            else echo_detection.negligible_signal_ratio
        )
        automatic_floor = negligible_signal_law(
            leakage_probability=self.tolerances.leakage_probability,
            threshold_ratio=threshold_ratio,
            n_bins=n_bins,
        )
        return np.where(stated_floor == SET_BY_TOLERANCE, automatic_floor, stated_floor)

    @property
    def detects_by_any_two_segments(self) -> bool:
        """True if any two segments can detect a shot; False if both chirps must detect the echo."""
        return (
            self.detection_settings.shot_detection_rule == waveform.ANY_TWO
            and len(self.waveform.segment_order) == 3
        )

    def _bin_noise_sigma_from_variance(self, variance: np.ndarray) -> np.ndarray:
        """Return the noise standard deviation per quadrature of a bin of the unscaled FFT [V].

        ``variance`` is the noise variance of a sample at the ADC [V^2]; the result has its shape.
        """
        return self.record.bin_noise_sigma(variance, self.looks)

    @cached_property
    def beamlet_arrays(self) -> "BeamletArrays":
        """Ranges, Doppler ratios, amplitudes and phases of all beamlets, relative to the axis.

        The result is a record of arrays for kernels.
        """
        from sweep.model.spectrum.lines import BeamletArrays

        range_offset, doppler_offset, amplitude = (
            np.array(values, float, order="C")  # kernels take writable arrays in C order
            for values in (
                self.footprint.relative_range_offset,
                self.footprint.doppler_ratio_offset,
                self.footprint.relative_amplitude,
            )
        )
        phase_cycles = np.array(self.footprint.phase_cycles, float, order="C")
        if not phase_cycles.size:
            phase_cycles = np.empty((0, *range_offset.shape))
        return BeamletArrays(range_offset, doppler_offset, amplitude, phase_cycles)

    @cached_property
    def waveform_segments(self) -> tuple[WaveformSegment, ...]:
        """Segments up, Doppler and down, with the target's range and velocity at their starts."""
        return self.waveform.segments(self.target, self.motion)

    @property
    def range_and_velocity_by_segment(self) -> dict[str, Any]:
        """``range`` [m] and ``radial_velocity`` [m/s] of the target, (n,) each, in a dict.

        If the target moves between segments, ``range`` is a tuple by segment. If it also
        accelerates, ``radial_velocity`` is a tuple by segment as well.
        """
        motion: dict[str, Any] = {
            "range": self.range,
            "radial_velocity": self.target.radial_velocity,
        }
        if self.target_moves_between_segments:
            motion["range"] = tuple(
                self.range - segment.range_decrease_since_shot_start
                for segment in self.waveform_segments
            )
            if np.any(self.target.acceleration):
                motion["radial_velocity"] = tuple(
                    self.target.radial_velocity + self.target.acceleration * start
                    for start in self.motion.segment_starts
                )
        return motion

    @property
    def record_middle_time(self) -> np.ndarray:
        """Time from a segment's start to the middle of its record [s], (n,).

        It is 0 if motion within the record (range walk) is not simulated.
        """
        return (
            np.asarray(
                self.motion.range_reference_time
                - (self.motion.segment_starts[0] + self.motion.segment_starts[2]) / 2
            )
            / 2
        )

    @property
    def mid_record_frequency_drifts(self) -> tuple[np.ndarray, ...]:
        """Change of the frequency of each segment's lines from its start to mid-record [Hz].

        The result is a tuple by segment of (n,).
        """
        return tuple(
            self._frequency_drift(segment, self.record_middle_time, self.motion.velocity_drift_time)
            for segment in self.waveform_segments
        )

    @property
    def frequency_drift_rates(self) -> tuple[np.ndarray, ...]:
        """Rate at which the frequency of each segment's lines changes in its record [Hz/s].

        The result is a tuple by segment of (n,).
        """
        walk_sign, drift_sign = (
            np.sign(self.record_middle_time),
            np.sign(self.motion.velocity_drift_time),
        )
        return tuple(
            self._frequency_drift(segment, walk_sign, drift_sign)
            for segment in self.waveform_segments
        )

    def _frequency_drift(
        self, segment: WaveformSegment, walk_time: np.ndarray, drift_time: np.ndarray | float
    ) -> np.ndarray:
        """Return the change of a segment's line frequencies [Hz] by the target's motion, (n,).

        Range walk acts for `walk_time` [s], acceleration for `drift_time` [s].
        """
        closing_speed = self.target.radial_velocity + self.target.approach_speed
        closing_speed = closing_speed + self.target.acceleration * (
            2 * segment.start_time + 1.5 * self.motion.velocity_drift_time
        )
        doppler_term = segment.carrier * self.target.acceleration * drift_time
        return np.asarray(
            2 / SPEED_OF_LIGHT * (doppler_term + segment.chirp_rate * closing_speed * walk_time)
        )

    @property
    def beat_coefficients(self) -> BeatCoefficients:
        """Carriers f [Hz] and chirp rates S [Hz/s] from which each segment's beat follows.

        The beat is f beta - S tau, with the Doppler ratio beta and the delay tau = 2R/c of a target
        of constant speed at the shot's start. Each f is the segment's carrier, shifted by S times a
        time. This time is the segment's start plus twice the time to the middle of its record. The
        factor 2 arises because the phase is quadratic in the delay.
        """
        starts, chirp_rate_ratios, carriers, walk_time, chirp_rate = (
            np.array([np.broadcast_to(v, self.size) for v in values])
            for values in (
                self.motion.segment_starts,
                self.waveform.chirp_rate_ratios,
                self.waveform.carriers,
                (self.motion.range_reference_time,),
                (self.waveform.chirp_rate,),
            )
        )
        delay_times = starts + walk_time - (starts[0] + starts[2]) / 2
        return BeatCoefficients(
            carrier=carriers + chirp_rate_ratios * chirp_rate * delay_times,
            chirp_rate=chirp_rate_ratios * chirp_rate,
        )

    def split_by_look(self) -> "list[Shots]":
        """Return copies of these shots, one for each look, with the lines at the time of that look.

        A look is one of several records of a segment. If lines do not drift, the list holds these
        shots themselves, once for each look.
        """
        if not np.any(self.motion.line_drift_per_look):
            return [self] * self.looks.number
        looks_from_middle = np.arange(self.looks.number) - (self.looks.number - 1) / 2
        return [
            replace(
                self,
                motion=self.motion._replace(
                    line_drift_per_look=0.0,
                    segment_starts=tuple(
                        start + look_offset * self.waveform.look_period
                        for start in self.motion.segment_starts
                    ),
                ),
            )
            for look_offset in looks_from_middle
        ]

    @property
    def target_moves_between_segments(self) -> bool:
        """True if the target's motion between segments is simulated."""
        return any(np.any(start) for start in self.motion.segment_starts)

    def point_parameters(self) -> "PointParameters":
        """Return the parameters of points that all segments share, in a record for kernels."""
        from sweep.model.spectrum.lines import PointParameters

        up_carrier, _, down_carrier = self.waveform.carriers
        bin_thresholds = self.bin_thresholds
        values = PointParameters(
            range=self.range,
            doppler_ratio=np.asarray(self.motion.doppler_ratio),
            chirp_rate=self.waveform.chirp_rate,
            beat_amplitude_scale=self.echo_scales.beat_amplitude_scale,
            detector_bandwidth=self.receiver_filter.detector_bandwidth,
            amplifier_bandwidth=self.receiver_filter.amplifier_bandwidth,
            sample_rate=self.sample_rate,
            record_start=self.record.acquisition_delay,
            up_carrier=up_carrier,
            down_carrier=down_carrier,
            noise_sigma=self.bin_noise_sigma,
            threshold=self.threshold,
            negligible_signal_ratio=self.negligible_signal_ratio,
            line_noise_sigma=self.line_noise_sigma,
            leakage_tolerance=self.tolerances.leakage_probability,
            line_error_tolerance=self.tolerances.line_error,
            image_gain=np.asarray(self.line_images.iq_image_gain),
            noise_sigma_next_to_lines=bin_thresholds.noise_sigma_next_to_lines,
            pedestal_reach_bins=bin_thresholds.pedestal_reach_bins,
            pedestal_line_width_bins=bin_thresholds.pedestal_line_width_bins,
            pedestal_delay_bin_width_product=bin_thresholds.pedestal_delay_bin_width_product,
        )
        return PointParameters(*broadcast_rows(values, (self.size,)))

    def segment_parameters(self) -> "SegmentParameters":
        """Return the parameters of points that differ by segment, in a record for kernels."""
        from sweep.model.spectrum.lines import SegmentParameters

        rows_by_segment = [
            broadcast_rows(
                SegmentParameters(
                    chirp_rate=segment.chirp_rate,
                    carrier=segment.carrier,
                    whitening_gain=gain,
                    range_decrease_since_shot_start=np.asarray(
                        segment.range_decrease_since_shot_start
                    ),
                    doppler_ratio=np.asarray(segment.doppler_ratio),
                    start_time=np.asarray(segment.start_time),
                ),
                (self.size,),
            )
            for segment, gain in zip(self.waveform_segments, self.whitening_gain, strict=True)
        ]
        return SegmentParameters(*np.stack(rows_by_segment, axis=1))

    @property
    def fft_size_if_end_bins_real(self) -> int:
        """FFT size N if the noise in bins 0 and N/2 is real-valued; 0 if it is complex.

        The noise is real-valued in a real record, if noise bins are simulated as correlated.
        """
        is_real = (
            self.detection_settings.noise_bin_model == "correlated" and not self.complex_record
        )
        return self.fft_size if is_real else 0

    @cached_property
    def searched_bins(self) -> SearchedBins:
        """Bins of each segment that are searched for false alarms, with their noise correlation."""
        return SearchedBins.from_record(
            self.record,
            noise_bins=self.detection_settings.noise_bin_model,
            bins_counted=self.detection_settings.counted_bins_rule,
            search_band=self.detection_settings.search_band,
        )

    @property
    def first_searched_bin(self) -> int:
        """Distance [bins] from DC of the first bin that is searched for false alarms.

        The last searched bin is as far from Nyquist.
        """
        return self.searched_bins.first_bin

    @property
    def noise_bin_correlation(self) -> float:
        """Correlation coefficient of the noise in adjacent bins, 0..1."""
        return self.searched_bins.neighbour_noise_correlation

    @property
    def detection_rule(self) -> "DetectionRule":
        """Rule by which the bins of one record detect an echo."""
        from sweep.model.detection.echo_detection import DetectionRule
        from sweep.model.detection.joint_tail import joint_tail_quadrature
        from sweep.model.detection.pseudo_variance import noise_pseudo_variance_ratio
        from sweep.model.detection.speckle_modes import NO_MODES, mode_table
        from sweep.model.detection.sub_bin_interpolation import sidelobe_neighbour_noise_correlation

        in_speckle, any_bin = (
            self.speckle.segment_correlations is not None,
            self.detection_settings.echo_bin_rule != "peak_bin",
        )
        is_real_record_in_speckle = in_speckle and not self.complex_record
        has_real_noise_at_ends = self.fft_size_if_end_bins_real > 0
        noise_ratio, lobe_half_width, modes = np.empty(0), 0, NO_MODES
        if is_real_record_in_speckle and has_real_noise_at_ends:
            noise_ratio = noise_pseudo_variance_ratio(self.window, self.fft_size)
        if any_bin:
            lobe_half_width = math.ceil(
                main_lobe_half_width(self.window) * self.fft_size / self.window.length
            )
            if in_speckle:
                modes = mode_table(self.window, self.fft_size)
        return DetectionRule(
            detects_by_any_bin=any_bin,
            lobe_half_width=lobe_half_width,
            has_real_noise_at_ends=has_real_noise_at_ends,
            fft_size=self.fft_size,
            in_speckle=in_speckle,
            neighbour_noise_correlation=self.noise_bin_correlation,
            is_real_record_in_speckle=is_real_record_in_speckle,
            neighbour_crossing_quadrature=joint_tail_quadrature(self.noise_bin_correlation),
            noise_pseudo_variance_ratio=noise_ratio,
            mode_table=modes,
            sidelobe_neighbour_noise_correlation=sidelobe_neighbour_noise_correlation(
                self.window, self.fft_size
            ),
        )

    @cached_property
    def speckle_table(self) -> "SpeckleTable":
        """Speckle parameters of the bins of each segment, as a record for kernels."""
        from sweep.model.detection.echo_detection import SpeckleTable
        from sweep.model.detection.pseudo_variance import signal_pseudo_variance

        shape = (len(self.waveform_segments), self.size)
        # A writable copy: kernels would be compiled anew for an array that can't be written.
        line_deviation_bins = np.array(np.broadcast_to(self.speckle.line_deviation_bins, shape))
        # Without images, bins near DC and Nyquist hold half of the echo, and their values are not
        # real.
        if (
            self.speckle.segment_correlations is None
            or self.complex_record
            or not self.line_images.are_summed
        ):
            return SpeckleTable(
                line_deviation_bins, np.zeros(shape, np.int64), np.zeros((1, 0)), np.ones((1, 1))
            )
        return SpeckleTable(line_deviation_bins, *signal_pseudo_variance(self))

    def n_searched_bins(
        self, n_exempt: np.ndarray, point_indices: np.ndarray | slice = slice(None)
    ) -> np.ndarray:
        """Return the number of bins of each segment in which noise can raise a false alarm.

        Parameters
        ----------
        n_exempt : ndarray (3, m)
            Number of bins of each segment that belong to an echo, which are subtracted.
        point_indices : ndarray (m,) or slice
            Points to which the columns of the arrays belong.

        Returns
        -------
        ndarray (3, m)
            Number of bins, 0 or more.
        """
        return self.searched_bins.select_points(point_indices).n_bins_outside_echo(n_exempt)

    def n_alarm_equivalent_bins(
        self, n_exempt: np.ndarray, point_indices: np.ndarray | slice = slice(None)
    ) -> np.ndarray:
        """Return the number of independent bins that are equivalent to the searched bins, (3, m).

        Noise raises a false alarm in the searched bins as probably as in this number of independent
        bins.

        Parameters
        ----------
        n_exempt : ndarray (3, m)
            Number of bins of each segment that belong to an echo.
        point_indices : ndarray (m,) or slice
            Points to which the columns of the arrays belong.
        """
        n_searched = self.n_searched_bins(n_exempt, point_indices)
        if self.detection_settings.noise_bin_model == "independent":
            return n_searched
        threshold_ratio = np.broadcast_to(self.threshold / self.bin_noise_sigma, self.size)[
            point_indices
        ]
        return n_alarm_equivalent_bins(
            n_searched,
            threshold_ratio=threshold_ratio,
            correlation=self.noise_bin_correlation,
            looks=self.looks,
        )


def split_by_category(
    parameters: Parameters, further_paths: Collection[str] = ()
) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Split points into categories; points of a category share text parameters and array sizes.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path: scalars or (n,) arrays.
    further_paths : collection of str
        Paths of numeric parameters that points of a category must share, besides
        :data:`SHARED_PARAMETER_PATHS`.

    Yields
    ------
    point_indices : ndarray (m,)
        Indices of the points of a category.
    category_parameters : dict
        Parameters of the category's points as arrays, and ``record``, the record's length
        [samples].
    """
    arrays = parameters_as_arrays(parameters)
    n_points = max((a.size for a in arrays.values() if a.ndim), default=1)
    shared_paths = {*SHARED_PARAMETER_PATHS, *further_paths}
    varying_paths = [
        path
        for path, a in arrays.items()
        if a.ndim and (path in shared_paths or a.dtype.kind in "UO")
    ]
    if not varying_paths:
        yield np.arange(n_points), arrays
        return
    category_of_point = np.zeros(n_points, np.int64)
    for path in varying_paths:
        if (arrays[path] == arrays[path][0]).all():  # the usual case, needs no sorting
            continue
        distinct_values, value_codes = np.unique(arrays[path], return_inverse=True)
        category_of_point = np.unique(
            category_of_point * distinct_values.size + value_codes, return_inverse=True
        )[1]
    for category in range(category_of_point.max() + 1):
        point_indices = np.flatnonzero(category_of_point == category)
        category_parameters = {
            path: a[point_indices] if a.ndim else a for path, a in arrays.items()
        }
        yield (
            point_indices,
            category_parameters | {path: category_parameters[path][0] for path in varying_paths},
        )


def broadcast_rows(values: Sequence[np.ndarray | float], shape: tuple[int, ...]) -> np.ndarray:
    """Return one array whose rows are the values, each broadcast to one shape.

    Parameters
    ----------
    values : sequence of ndarray or float
        Values of r rows, in any unit; each broadcasts to ``shape``.
    shape : tuple of int
        Shape of a row.

    Returns
    -------
    ndarray (r, ...) float64
        Rows, of the shape ``shape`` each.
    """
    rows = np.empty((len(values), *shape))
    for row, value in zip(rows, values, strict=True):
        row[...] = value
    return rows


def parameters_as_arrays(parameters: Parameters) -> dict[str, np.ndarray]:
    """Return the parameters as arrays, and add ``record``, the number of samples of the record."""
    arrays = {path: np.asarray(value) for path, value in parameters.items()}
    arrays["record"] = waveform.n_record_samples(arrays)
    return arrays


def prepare_axis_line(parameters: Mapping[str, np.ndarray], n_points: int, ground: Ground) -> Shots:
    """Return shots of one category with a single line, on the beam's axis, in the receiver's noise.

    No effect is applied. Points of a category share text parameters and array sizes.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path, as arrays.
    n_points : int
        Number of points n.
    ground : Ground
        Ground that the beams meet.
    """
    budget = LinkBudget(parameters)
    row_of_point, relative_range_offset, doppler_ratio_offset, relative_echo = (
        ground.axis_beamlet_table(n_points)
    )
    zeros, architecture = np.zeros(n_points), budget.waveform.architecture
    sample_rate = budget.record.sample_rate + zeros
    return Shots(
        waveform=replace(budget.waveform, chirp_rate_ratios=waveform.chirp_rate_ratios(parameters)),
        record=replace(budget.record, sample_rate=sample_rate),
        receiver_filter=replace(budget.receiver_filter, sample_rate=sample_rate),
        target=replace(
            budget.target,
            range=budget.target.range + zeros,
            radial_velocity=budget.target.radial_velocity + zeros,
        ),
        echo_scales=budget.echo_scales,
        receiver_noise=budget.receiver_noise,
        noise=budget.noise,
        footprint=FootprintLines(
            row_of_point=row_of_point,
            relative_range_offset=relative_range_offset,
            doppler_ratio_offset=doppler_ratio_offset,
            relative_amplitude=relative_amplitude(architecture, relative_echo),
            adds_powers=architecture != "direct",
            beamlets_error=parameters.get(BEAMLETS_ERROR_PATH, math.nan),
        ),
        detection_settings=DetectionSettings.from_budget(budget, n_points),
        looks=budget.looks,
        tolerances=SpectrumTolerances.from_parameters(parameters, budget.looks),
    )


@lru_cache(maxsize=8)
def window_energy_from_sample(window: Window) -> np.ndarray:
    """Return the sum of the squared window from each sample to the last, (L + 1,).

    L is the number of samples of the window. The last value is 0.
    """
    return np.append(np.cumsum(window.samples()[::-1] ** 2)[::-1], 0.0)


_LABEL_BY_POINT_FIELD = {
    "target.range": "range",
    "target.radial_velocity": "radial velocity",
    "target.acceleration": "acceleration",
    "motion.doppler_ratio": "Doppler shift",
    "echo_scales.echo_power_scale": "echo's power",
    "echo_scales.beat_amplitude_scale": "beat's amplitude",
    "bin_noise_sigma": "noise",
    "threshold": "threshold",
}
"""Names, for error messages, of fields of `Shots` that must be finite, by the field's dotted path.
These fields have one value for each point."""
_LABEL_BY_BEAMLET_FIELD = {
    "footprint.relative_range_offset": "beamlets' ranges",
    "footprint.doppler_ratio_offset": "beamlets' velocities",
    "footprint.relative_amplitude": "beamlets' echoes",
}
"""Names, for error messages, of fields of `Shots` that must be finite, by the field's dotted path.
These fields have one value for each beamlet."""


def require_finite(shots: Shots) -> None:
    """Raise an error if any value of the shots is not finite, because spectra would have no peak.

    Raises
    ------
    UnsupportedShotError
        If a value is not finite. The error names the quantity and the shot.
    """
    for name, label in (_LABEL_BY_POINT_FIELD | _LABEL_BY_BEAMLET_FIELD).items():
        values = np.asarray(attrgetter(name)(shots))
        if math.isfinite(float(values.sum())):  # the sum is not finite with any nan or inf
            continue
        is_not_finite = ~np.isfinite(values)
        if not is_not_finite.any():
            continue
        if name in _LABEL_BY_BEAMLET_FIELD:
            row_has_wrong = is_not_finite.any(axis=1)
            point_index = int(row_has_wrong[shots.footprint.row_of_point].argmax())
            value = values[shots.footprint.row_of_point[point_index]][
                is_not_finite[shots.footprint.row_of_point[point_index]]
            ][0]
        else:
            point_index = int(np.broadcast_to(is_not_finite, (shots.size,)).argmax())
            value = np.broadcast_to(values, (shots.size,))[point_index]
        raise UnsupportedShotError(
            f"the {label} can not be computed ({value}), at a range of "
            f"{shots.range[point_index]:.6g} m: "
            "check the scene and the path there for numbers out of all proportion",
            point_index,
        )
