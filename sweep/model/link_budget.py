"""Link budget: waveform, record, receiver filter, target, link scales, noise and threshold.

One derivation serves the simulation, :func:`sweep.model.preparation.prepare_axis_line`, and the
planning of effects, :class:`sweep.model.effects.planner_inputs.PlannerInputs`. Nothing in this
module depends on a footprint or on a single effect.

Values are arrays that broadcast over points, in SI units. Tuples by segment are in the order up,
Doppler, down. All points share text parameters and integers that size an array.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from sweep.model import beam, receiver_chain, waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.looks import Looks
from sweep.model.threshold import tnr_from_parameters
from sweep.model.waveform import WaveformSegment
from sweep.model.window import Window, canonical_window_name, get_window

LASER_PREFIX, CHIRP_PREFIX, TELESCOPE_PREFIX, RECEIVER_PREFIX, PROCESSING_PREFIX = (
    f"instrument.{section}."
    for section in ("laser", "chirp", "telescope", "receiver", "processing")
)
RECORD_PATH = RECEIVER_PREFIX + "record"
"""Path of the kind of samples of a record: ``real``, or ``complex`` from I and Q."""

BEAM_ELEVATION_PATH = "path.elevation"
"""Path of the angle of the beam below the horizon [rad], by shot; present only in scenes."""

APPROACH_SPEED_PATH = "target.approach"
"""Path of the speed [m/s] at which the range along the beam falls, present if it was found by ray
tracing."""

ADC_NOISE_SOURCE = "quantisation"
"""Noise source that does not pass the receiver."""

ECHO_NOISE_SOURCES = frozenset({"signal_shot"})
"""Noise sources that are present only with an echo; the threshold does not depend on them."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TargetState:
    """Target on the beam's axis at the start of a shot."""

    range: np.ndarray
    """Range [m]."""
    radial_velocity: np.ndarray
    """Radial velocity [m/s], positive when closing."""
    acceleration: np.ndarray
    """Rate at which the radial velocity grows [m/s^2]."""
    approach_speed: np.ndarray
    """Speed [m/s] at which the range along the beam falls (:func:`approach_speed`)."""

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, np.ndarray]) -> "TargetState":
        """Return the target of parameters by dotted path."""
        return cls(
            range=parameters["target.range"],
            radial_velocity=parameters["target.radial_velocity"],
            acceleration=parameters["target.acceleration"],
            approach_speed=approach_speed(parameters),
        )

    @property
    def delay(self) -> np.ndarray:
        """Delay of the echo 2 R / c [s]."""
        return 2 / SPEED_OF_LIGHT * self.range

    @property
    def doppler_ratio(self) -> np.ndarray:
        """Doppler ratio 2 v_r / c."""
        return doppler_ratio(self.radial_velocity)


class LineMotion(NamedTuple):
    """Motion of the target that lines and measurement include, (n,) or scalars; none by default."""

    doppler_ratio: np.ndarray | float = 0.0
    """Doppler ratio 2 v_r / c of the line on the axis at the shot's start."""
    segment_starts: tuple[np.ndarray | float, ...] = (0.0, 0.0, 0.0)
    """Time [s] from the shot's start to the start of each segment, during which the target moves;
    0 if the target does not move between segments."""
    line_drift_per_look: np.ndarray | float = 0.0
    """(3, n): shift of the lines from look to look [bins of fs/N]."""
    range_walk_time: np.ndarray | float = 0.0
    """Time of closing [s] by which the beats' range is below the range at the shot's start."""
    velocity_drift_time: np.ndarray | float = 0.0
    """Time of acceleration [s] by which a beat's velocity is above that at its segment's start."""
    velocity_bias_fraction: np.ndarray | float = 0.0
    """Fractional underestimation of the radial velocity by the beats."""


@dataclass(frozen=True, eq=False, kw_only=True)
class WaveformSettings:
    """Segments of a shot: chirp rates, carriers and times."""

    architecture: str
    """Receiver architecture: ``homodyne``, ``heterodyne`` or ``direct``."""
    segment_order: tuple[str, ...]
    """Names of the segments that exist, in the order of time."""
    chirp_slopes: tuple[Any, ...]
    """Chirp rates of the three segments over :attr:`chirp_rate`, signed: numbers, or arrays if
    points differ."""
    carriers: tuple[np.ndarray, np.ndarray, np.ndarray]
    """Frequency of each segment that the delay turns into phase [Hz]."""
    chirp_bandwidth: np.ndarray
    """Bandwidth B of the up-chirp [Hz]."""
    chirp_duration: np.ndarray
    """Duration T of each segment [s]."""
    segment_gap: np.ndarray
    """Time from a segment's end to the start of the next segment [s]."""

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any]) -> "WaveformSettings":
        """Return the waveform of parameters by dotted path; chirp slopes may differ by point."""
        architecture = str(parameters[RECEIVER_PREFIX + "architecture"])
        chirp_slopes: tuple[Any, ...] = (
            1.0,
            *(
                np.asarray(parameters.get(path, waveform.WAVEFORM_DEFAULTS[path]), float)
                for path in (waveform.DOPPLER_SLOPE_PATH, waveform.DOWN_SLOPE_PATH)
            ),
        )
        chirp_bandwidth = parameters[CHIRP_PREFIX + "bandwidth"]
        return cls(
            architecture=architecture,
            segment_order=waveform.existing_segments(
                architecture, str(parameters[waveform.SEGMENT_ORDER_PATH])
            ),
            chirp_slopes=chirp_slopes,
            carriers=waveform.carrier_frequencies(
                architecture,
                wavelength=parameters[LASER_PREFIX + "wavelength"],
                start_frequency=parameters[CHIRP_PREFIX + "start_frequency"],
                bandwidth=chirp_bandwidth,
                chirp_slopes=chirp_slopes,
            ),
            chirp_bandwidth=chirp_bandwidth,
            chirp_duration=parameters[CHIRP_PREFIX + "duration"],
            segment_gap=parameters[waveform.SEGMENT_GAP_PATH],
        )

    @property
    def chirp_rate(self) -> np.ndarray:
        """Chirp rate of the up-chirp S = B/T [Hz/s]."""
        return self.chirp_bandwidth / self.chirp_duration

    @property
    def has_segment(self) -> np.ndarray:
        """(3,) bool: existence of up, Doppler and down segment."""
        return np.array([name in self.segment_order for name in waveform.SEGMENT_NAMES])

    @property
    def segment_starts(self) -> tuple[np.ndarray, ...]:
        """Times [s] from the start of a look to the start of each of its segments."""
        return waveform.segment_starts(
            self.segment_order, duration=self.chirp_duration, gap=self.segment_gap
        )

    @property
    def look_period(self) -> np.ndarray:
        """Time [s] from one look to the next: the duration of all segments and gaps."""
        return len(self.segment_order) * (self.chirp_duration + self.segment_gap)

    def middle_look_delay(self, looks: Looks) -> np.ndarray | float:
        """Return the time [s] from the start of the first look to that of the middle look."""
        return 0.5 * (looks.number - 1) * self.look_period if looks.number > 1 else 0.0

    def middle_look_starts(self, looks: Looks) -> tuple[np.ndarray, ...]:
        """Return the times [s] from the shot's start to each segment's start in the middle look."""
        delay = self.middle_look_delay(looks)
        return tuple(start + delay for start in self.segment_starts)

    def segments(self, target: TargetState, motion: LineMotion) -> tuple[WaveformSegment, ...]:
        """Return the three segments, with range and velocity of the target at their starts.

        Parameters
        ----------
        target : TargetState
            Target at the start of the shot.
        motion : LineMotion
            Motion that the lines include.

        Notes
        -----
        With the approach speed u and the acceleration a, a segment that starts at t finds the range
        lower by u t + a t^2 / 2, and the Doppler ratio higher by 2 a t / c. Leakage is evaluated in
        up- and down-chirp only, as no output reports that of the Doppler segment.
        """
        return tuple(
            WaveformSegment(
                name,
                slope,
                slope * self.chirp_rate,
                carrier,
                name != waveform.SEGMENT_NAMES[1],
                target.approach_speed * start + 0.5 * target.acceleration * start * start,
                motion.doppler_ratio + doppler_ratio(target.acceleration * start),
                start,
            )
            for name, slope, carrier, start in zip(
                waveform.SEGMENT_NAMES,
                self.chirp_slopes,
                self.carriers,
                motion.segment_starts,
                strict=True,
            )
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordSettings:
    """Samples of a segment that are recorded, their window and FFT."""

    window: Window
    """Window of the record, of L samples."""
    fft_size: int
    """FFT size N."""
    sample_rate: np.ndarray
    """Sample rate f_s [Hz]."""
    acquisition_delay: np.ndarray
    """Time from a segment's start to the start of its record [s]."""
    is_complex: bool
    """True if the record is I + iQ; its spectrum then has signed bins and no images."""

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any]) -> "RecordSettings":
        """Read the settings of the record from parameters by dotted path.

        All points must have the same number L of samples and the same FFT size N.
        """
        length = waveform.record_length(parameters)
        window_name = canonical_window_name(str(parameters[PROCESSING_PREFIX + "window"]))
        return cls(
            window=get_window(window_name, int(np.ravel(length)[0])),
            fft_size=int(np.ravel(parameters[PROCESSING_PREFIX + "fft_size"])[0]),
            sample_rate=parameters[PROCESSING_PREFIX + "sample_rate"],
            acquisition_delay=parameters[PROCESSING_PREFIX + "acquisition_delay"],
            is_complex=samples_iq(parameters),
        )

    @property
    def bin_width(self) -> np.ndarray:
        """Width of a bin f_s/N [Hz]."""
        return self.sample_rate / self.fft_size

    @property
    def duration(self) -> np.ndarray:
        """Length of the record L/f_s [s]."""
        return self.window.length / self.sample_rate

    def bin_noise_sigma(self, noise_variance: np.ndarray, looks: Looks) -> np.ndarray:
        """Return a bin's noise sigma per quadrature [V] for a noise variance at the ADC [V^2].

        Records that are added in amplitude are averaged, and have the variance of their mean.
        """
        return receiver_chain.bin_noise_sigma(
            noise_variance=noise_variance / looks.n_coherent,
            window_energy=np.asarray(self.window.energy),
        )

    def count_samples_before_echo(
        self, segment: WaveformSegment, range: np.ndarray | float
    ) -> np.ndarray:
        """Return the number of samples of a segment's record before the echo arrives, 0..L.

        Parameters
        ----------
        segment : WaveformSegment
            Segment of the waveform.
        range : ndarray or float
            Range of the target at the shot's start [m].
        """
        return waveform.count_samples_before_echo(
            delay=segment.delay(range),
            doppler_ratio=segment.doppler_ratio,
            record_start=self.acquisition_delay,
            sample_rate=self.sample_rate,
            length=self.window.length,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class ReceiverFilter:
    """Poles and anti-alias filter of the receiver, by which signals and noise are shaped."""

    detector_bandwidth: np.ndarray
    """Bandwidth of the detector's pole [Hz]."""
    amplifier_bandwidth: np.ndarray
    """Bandwidth of the amplifier's pole [Hz]."""
    sample_rate: np.ndarray
    """Sample rate f_s [Hz]."""
    noise_shape: str
    """Shape of the noise: ``receiver``, filtered as signals are, or ``white``, unfiltered, as in
    [T]."""
    antialias_filter: dict[str, np.ndarray] = field(default_factory=dict)
    """Bandwidth [Hz] and order of the anti-alias filter; empty without one."""

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any]) -> "ReceiverFilter":
        """Return the filter of parameters by dotted path."""
        return cls(
            detector_bandwidth=parameters[RECEIVER_PREFIX + "detector_bandwidth"],
            amplifier_bandwidth=parameters[RECEIVER_PREFIX + "amplifier_bandwidth"],
            sample_rate=parameters[PROCESSING_PREFIX + "sample_rate"],
            noise_shape=str(parameters[RECEIVER_PREFIX + "noise_shape"]),
            antialias_filter=receiver_chain.antialias_filter_parameters(
                receiver_chain.receiver_parameters(parameters)
            ),
        )

    def pole_gain(self, frequency: np.ndarray) -> np.ndarray:
        """Return the gain of a signal by detector and amplifier, relative to DC.

        Parameters
        ----------
        frequency : ndarray
            Signed frequency [Hz], before the ADC folds it.
        """
        return np.abs(self._pole_transfer(frequency))

    def _pole_transfer(self, frequency: np.ndarray) -> np.ndarray:
        """Return the complex transfer function of detector and amplifier, relative to DC."""
        return receiver_chain.receiver_transfer(
            frequency,
            detector_bandwidth=self.detector_bandwidth,
            amplifier_bandwidth=self.amplifier_bandwidth,
        )

    def antialias_gain(self, frequency: np.ndarray) -> np.ndarray | float:
        """Return the gain of a signal by the anti-alias filter; 1 without one.

        Parameters
        ----------
        frequency : ndarray
            Signed frequency [Hz], before the ADC folds it.
        """
        if not self.antialias_filter:
            return 1.0
        return np.sqrt(
            receiver_chain.antialias_power_transmission(frequency, **self.antialias_filter)
        )

    def gain(self, frequency: np.ndarray) -> np.ndarray:
        """Return the gain of a signal by poles and anti-alias filter, relative to DC.

        Parameters
        ----------
        frequency : ndarray
            Signed frequency [Hz], before the ADC folds it.
        """
        return np.abs(self._pole_transfer(frequency) * self.antialias_gain(frequency))

    def relative_noise_density(self, frequency: np.ndarray) -> np.ndarray | float:
        """Return the density of the receiver's noise over that of white noise of the same variance.

        Parameters
        ----------
        frequency : ndarray
            Frequency [Hz], of either sign, folded or not.
        """
        if self.noise_shape == "white":
            return 1.0
        return receiver_chain.relative_noise_density(
            frequency,
            sample_rate=self.sample_rate,
            detector_bandwidth=self.detector_bandwidth,
            amplifier_bandwidth=self.amplifier_bandwidth,
            **self.antialias_filter,
        )

    def whitening_gain(
        self,
        beat_frequency: np.ndarray,
        adc_noise_fraction: np.ndarray | float,
        bin_frequency: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the gain of a line after the noise of the spectrum is whitened.

        Parameters
        ----------
        beat_frequency : ndarray
            Beat frequency of the line [Hz].
        adc_noise_fraction : ndarray or float
            Fraction of the noise variance that the ADC adds, which is white already.
        bin_frequency : ndarray, optional
            Frequency [Hz] of the bins whose noise density applies, for skirts of the line; by
            default that of the line.

        Returns
        -------
        ndarray
            Amplitude gain. It includes the anti-alias filter and excludes the receiver's poles. It
            is 1 if the noise is taken as white.

        Notes
        -----
        With the relative density d of the receiver's noise and the ADC's fraction q, the gain is (d
        + (1 - d) q)^(-1/2) times that of the anti-alias filter.
        """
        if self.noise_shape == "white":
            return np.ones(())
        density = self.relative_noise_density(
            beat_frequency if bin_frequency is None else bin_frequency
        )
        gain = (density + (1 - density) * adc_noise_fraction) ** -0.5
        return np.asarray(gain * self.antialias_gain(beat_frequency))


@dataclass(frozen=True, eq=False)
class NoiseBudget:
    """Noise at the ADC, by source."""

    variances: dict[str, np.ndarray]
    """Noise variance [V^2] by source."""
    gain: np.ndarray | float = 1.0
    """Factor on the noise variance by changes of the record after the threshold was set."""

    def with_sources(self, **variances: np.ndarray) -> "NoiseBudget":
        """Return the budget with sources added or replaced: variances [V^2] by source."""
        return NoiseBudget(self.variances | variances, self.gain)

    @cached_property
    def variance_without_echo(self) -> np.ndarray:
        """Noise variance without an echo [V^2], which sets the threshold."""
        variances = (v for name, v in self.variances.items() if name not in ECHO_NOISE_SOURCES)
        return np.asarray(sum(variances))

    @cached_property
    def variance(self) -> np.ndarray:
        """Noise variance sigma_x^2 [V^2] of all sources."""
        echo_variances = (v for name, v in self.variances.items() if name in ECHO_NOISE_SOURCES)
        return (self.variance_without_echo + sum(echo_variances)) * self.gain

    @property
    def adc_noise_fraction(self) -> np.ndarray | float:
        """Fraction of the noise variance without an echo that the ADC adds."""
        return self.variances.get(ADC_NOISE_SOURCE, 0.0) / self.variance_without_echo


class LinkScales(NamedTuple):
    """Light and beat of a relative echo of one, and losses on the way from the ground."""

    echo_power: np.ndarray
    """Echo power [W] for a relative echo of 1/sr."""
    beat_amplitude: np.ndarray
    """Amplitude of the beat at the ADC [V] for a relative amplitude of 1, before the poles."""
    ground_transmission: np.ndarray | float = 1.0
    """Fraction of light from the ground, such as sunlight, that reaches the receiver."""

    def scale_echo(
        self, *, power_factor: np.ndarray | float = 1.0, amplitude_factor: np.ndarray | float
    ) -> "LinkScales":
        """Return the scales with factors on the echo's power and on the beat's amplitude."""
        return self._replace(
            echo_power=self.echo_power * power_factor,
            beat_amplitude=self.beat_amplitude * amplitude_factor,
        )


class LinkBudget:
    """Link budget of points that share text parameters; each part is derived on first use.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path, as arrays that broadcast against each other.
    """

    def __init__(self, parameters: Mapping[str, np.ndarray]) -> None:
        self.parameters = parameters

    @cached_property
    def waveform(self) -> WaveformSettings:
        """Segments of a shot."""
        return WaveformSettings.from_parameters(self.parameters)

    @cached_property
    def record(self) -> RecordSettings:
        """Samples, window and FFT of a segment."""
        return RecordSettings.from_parameters(self.parameters)

    @cached_property
    def receiver_filter(self) -> ReceiverFilter:
        """Poles and anti-alias filter."""
        return ReceiverFilter.from_parameters(self.parameters)

    @cached_property
    def target(self) -> TargetState:
        """Target on the beam's axis at the start of a shot."""
        return TargetState.from_parameters(self.parameters)

    @cached_property
    def looks(self) -> Looks:
        """Number of records of each segment, and their combination."""
        return Looks.from_parameters(self.parameters)

    @cached_property
    def link_scales(self) -> LinkScales:
        """Echo power and beat amplitude of a relative echo of one."""
        echo_power, current = echo_power_and_beat_current(
            self.waveform.architecture, self.parameters
        )
        return LinkScales(echo_power, current * self.parameters[RECEIVER_PREFIX + "transimpedance"])

    @cached_property
    def receiver_noise(self) -> receiver_chain.ReceiverNoise:
        """Noise variances of the receiver at the ADC [V^2]."""
        return receiver_chain.receiver_noise(
            self.waveform.architecture,
            receiver_chain.receiver_parameters(self.parameters),
            samples_iq(self.parameters),
        )

    @cached_property
    def noise(self) -> NoiseBudget:
        """Noise of the receiver's own sources."""
        return NoiseBudget(self.receiver_noise.variances)

    @cached_property
    def tnr(self) -> np.ndarray:
        """Threshold-to-noise ratio."""
        return tnr_from_parameters(self.parameters)

    @cached_property
    def threshold_ratio(self) -> np.ndarray:
        """Threshold on |X| over the noise sigma of a bin without an echo."""
        return np.asarray(threshold(self.tnr, np.asarray(1.0)))


def threshold(tnr: np.ndarray, bin_noise_sigma: np.ndarray) -> np.ndarray:
    """Return the threshold on |X| [V].

    Parameters
    ----------
    tnr : ndarray
        Threshold-to-noise ratio.
    bin_noise_sigma : ndarray
        Noise sigma of a bin without an echo, per quadrature [V].
    """
    from sweep.model.detection.echo_detection import threshold_from_tnr  # kernels load slowly

    return threshold_from_tnr(tnr=tnr, bin_deviation=bin_noise_sigma)


def samples_iq(parameters: Mapping[str, Any]) -> bool:
    """Return True if two receivers sample I and Q of a complex record."""
    return str(parameters[RECORD_PATH]) == "complex"


def adc_noise_variance(parameters: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the noise variance of the ADC's quantisation [V^2]."""
    full_scale, bits = (parameters[PROCESSING_PREFIX + name] for name in ("full_scale", "bits"))
    return receiver_chain.quantisation_variance(
        full_scale=full_scale, bits=bits, samples_iq=samples_iq(parameters)
    )


def approach_speed(parameters: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the speed at which the range along the beam falls [m/s], (n,) or scalar.

    It differs from the radial velocity if the beam slides over sloping ground.

    Notes
    -----
    Let V = v d + u e, with d along the beam and e across it towards the near side. The range of a
    plane of normal n at the grazing angle g then falls at V.n / d.n = v + u cot g.
    """
    if APPROACH_SPEED_PATH in parameters:
        return parameters[APPROACH_SPEED_PATH]
    transverse_velocity = parameters["target.transverse_velocity"]
    if not np.any(transverse_velocity):
        return parameters["target.radial_velocity"]
    return np.asarray(
        parameters["target.radial_velocity"]
        + transverse_velocity / np.tan(parameters["target.grazing_angle"])
    )


def relative_amplitude(architecture: str, relative_echo: np.ndarray) -> np.ndarray:
    """Return the relative amplitude of the beat for a relative echo.

    Parameters
    ----------
    architecture : str
        Receiver architecture.
    relative_echo : ndarray
        Relative echo [1/sr].

    Returns
    -------
    ndarray
        Square root of the relative echo; with direct detection, where the beat is proportional to
        power, the relative echo itself.
    """
    return relative_echo if architecture == "direct" else np.sqrt(relative_echo)


def doppler_ratio(radial_velocity: np.ndarray) -> np.ndarray:
    """Return the Doppler ratio beta = 2 v_r / c of a radial velocity [m/s]."""
    return 2 * radial_velocity / SPEED_OF_LIGHT


def echo_power_and_beat_current(
    architecture: str, parameters: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the echo power and beat current for a backscatter of 1/sr.

    Returns
    -------
    echo_power : ndarray
        Echo power [W] with the full beam at ``target.range``.
    beat_current : ndarray
        Amplitude of its beat photocurrent [A].

    Notes
    -----
    The law is [T 4.4] without its factor 1/(2 pi), which belongs to the reflectance law. A
    beamlet's echo is this power times its power fraction and its backscatter [1/sr], divided by the
    range loss of :func:`sweep.model.beam.range_loss_coefficients`.
    """
    power_times_area = (
        parameters[LASER_PREFIX + "power"]
        * beam.effective_collecting_area(parameters)
        * parameters[TELESCOPE_PREFIX + "optical_efficiency"]
    )
    echo_power = (
        power_times_area * parameters["target.reflectance"] / parameters["target.range"] ** 2
    )
    return echo_power, beat_current(architecture, parameters, echo_power)


def beat_current(
    architecture: str, parameters: Mapping[str, np.ndarray], power: np.ndarray
) -> np.ndarray:
    """Return the amplitude of the beat photocurrent [A] of received light.

    Parameters
    ----------
    architecture : str
        Receiver architecture.
    parameters : mapping
        Parameters by dotted path, as arrays.
    power : ndarray
        Power P of the light [W].

    Notes
    -----
    Coherent architectures: 2 M Re sqrt(eta P_lo P), with the heterodyne efficiency eta, a fraction
    of power. Direct detection: m M Re P, hence 2 dB of SNR for each dB of light. [T 2.22] takes 2
    Re^2 P^2 as the mean square current, which is the peak of a fully modulated echo. With the mean
    echo power P the mean square is m^2 Re^2 P^2 / 2, a quarter of it.
    """
    gain, responsivity = (
        parameters[RECEIVER_PREFIX + "apd_gain"],
        parameters[RECEIVER_PREFIX + "responsivity"],
    )
    if architecture == "direct":
        return parameters[RECEIVER_PREFIX + "modulation_index"] * gain * responsivity * power
    power_product = parameters[RECEIVER_PREFIX + "local_oscillator_power"] * power
    return (
        2
        * gain
        * responsivity
        * np.sqrt(parameters[RECEIVER_PREFIX + "mixing_efficiency"] * power_product)
    )
