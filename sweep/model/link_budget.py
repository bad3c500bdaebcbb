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

from sweep.model import beam, receiver_chain
from sweep.model.detection.looks import Looks
from sweep.model.shot_settings import (
    LASER_PREFIX,
    PROCESSING_PREFIX,
    RECEIVER_PREFIX,
    TELESCOPE_PREFIX,
    RecordSettings,
    TargetState,
    WaveformSettings,
    is_iq_sampled,
)
from sweep.model.threshold import tnr_from_parameters

BEAM_ELEVATION_PATH = "path.elevation"
"""Parameter path of the beam's angle below the horizon [rad], one value per shot. Only shots of a
scene have it."""

ADC_NOISE_SOURCE = "quantisation"
"""Name of the ADC's noise source, quantisation, which the receiver's filters do not affect."""

ECHO_NOISE_SOURCES = frozenset({"signal_shot"})
"""Names of noise sources that exist only with an echo, so that the threshold does not depend on
them."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ReceiverFilter:
    """Low-pass poles and anti-alias filter of the receiver, which filter signals and noise."""

    detector_bandwidth: np.ndarray
    """3 dB bandwidth of the detector's single-pole low-pass [Hz]."""
    amplifier_bandwidth: np.ndarray
    """3 dB bandwidth of the amplifier's single-pole low-pass [Hz]."""
    sample_rate: np.ndarray
    """Sample rate of the ADC [Hz]."""
    noise_shape: str
    """Spectrum of the noise: ``receiver``, filtered as signals are; or ``white``, unfiltered, as in
    [T]."""
    antialias_parameters: dict[str, np.ndarray] = field(default_factory=dict)
    """Bandwidth [Hz] and order of the anti-alias filter, by parameter name; empty if there is no
    filter."""

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any]) -> "ReceiverFilter":
        """Return the receiver's filter from parameters by dotted path."""
        return cls(
            detector_bandwidth=parameters[RECEIVER_PREFIX + "detector_bandwidth"],
            amplifier_bandwidth=parameters[RECEIVER_PREFIX + "amplifier_bandwidth"],
            sample_rate=parameters[PROCESSING_PREFIX + "sample_rate"],
            noise_shape=str(parameters[RECEIVER_PREFIX + "noise_shape"]),
            antialias_parameters=receiver_chain.antialias_filter_parameters(
                receiver_chain.receiver_parameters(parameters)
            ),
        )

    def pole_amplitude_gain(self, frequency: np.ndarray) -> np.ndarray:
        """Return the amplitude gain of detector and amplifier at a frequency, relative to DC.

        Parameters
        ----------
        frequency : ndarray
            Signed frequency [Hz], before the ADC folds it.
        """
        return np.abs(self._pole_transfer(frequency))

    def _pole_transfer(self, frequency: np.ndarray) -> np.ndarray:
        """Return the complex transfer function of detector and amplifier, relative to DC.

        ``frequency`` is that of a signal, with its sign [Hz].
        """
        return receiver_chain.receiver_transfer_function(
            frequency,
            detector_bandwidth=self.detector_bandwidth,
            amplifier_bandwidth=self.amplifier_bandwidth,
        )

    def antialias_amplitude_gain(self, frequency: np.ndarray) -> np.ndarray | float:
        """Return the amplitude gain of the anti-alias filter at a frequency; 1 without a filter.

        Parameters
        ----------
        frequency : ndarray
            Signed frequency [Hz], before the ADC folds it.
        """
        if not self.antialias_parameters:
            return 1.0
        return np.sqrt(
            receiver_chain.antialias_power_transmission(frequency, **self.antialias_parameters)
        )

    def amplitude_gain(self, frequency: np.ndarray) -> np.ndarray:
        """Return the amplitude gain of detector, amplifier and anti-alias filter, relative to DC.

        Parameters
        ----------
        frequency : ndarray
            Signed frequency [Hz], before the ADC folds it.
        """
        return np.abs(self._pole_transfer(frequency) * self.antialias_amplitude_gain(frequency))

    def relative_noise_density(self, frequency: np.ndarray) -> np.ndarray | float:
        """Return the receiver's noise density, relative to white noise of the same variance.

        The result is 1 if the noise is taken as white.

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
            **self.antialias_parameters,
        )

    def whitening_gain(
        self,
        beat_frequency: np.ndarray,
        adc_noise_fraction: np.ndarray | float,
        bin_frequency: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the factor on a line's amplitude in a spectrum whose noise is whitened.

        Whitening divides the spectrum by the square root of the noise's relative density, so that
        all bins have the same noise.

        Parameters
        ----------
        beat_frequency : ndarray
            Beat frequency of the line [Hz].
        adc_noise_fraction : ndarray or float
            Fraction of the noise variance that the ADC adds, which is white already.
        bin_frequency : ndarray, optional
            Frequency [Hz] of the bins in which the line is observed, whose noise density applies;
            by default the line's frequency.

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
        return np.asarray(gain * self.antialias_amplitude_gain(beat_frequency))


@dataclass(frozen=True, eq=False)
class NoiseBudget:
    """Noise variance of a sample at the ADC by source, and a factor on the total variance."""

    variances: dict[str, np.ndarray]
    """Noise variance of a sample [V^2] by the source's name."""
    variance_factor: np.ndarray | float = 1.0
    """Factor on the total noise variance, for changes of the record that the threshold does not
    follow."""

    def with_sources(self, **variances: np.ndarray) -> "NoiseBudget":
        """Return a copy of the budget with noise sources added or replaced.

        ``variances`` are noise variances [V^2] by the source's name.
        """
        return NoiseBudget(self.variances | variances, self.variance_factor)

    @cached_property
    def variance_without_echo(self) -> np.ndarray:
        """Noise variance of a sample without an echo [V^2], which determines the threshold."""
        variances = (v for name, v in self.variances.items() if name not in ECHO_NOISE_SOURCES)
        return np.asarray(sum(variances))

    @cached_property
    def variance(self) -> np.ndarray:
        """Noise variance of a sample [V^2], the sum over all sources times `variance_factor`."""
        echo_variances = (v for name, v in self.variances.items() if name in ECHO_NOISE_SOURCES)
        return (self.variance_without_echo + sum(echo_variances)) * self.variance_factor

    @property
    def adc_noise_fraction(self) -> np.ndarray | float:
        """Fraction, 0..1, of the noise variance without an echo that the ADC adds."""
        return self.variances.get(ADC_NOISE_SOURCE, 0.0) / self.variance_without_echo


class EchoScales(NamedTuple):
    """Echo power [W] and beat amplitude [V] of a target with a relative echo of 1 [1/sr].

    The relative echo [1/sr] is the sum over beamlets of power fraction times backscatter. Effects
    multiply the fields by factors.
    """

    echo_power_scale: np.ndarray
    """Echo power on the detector [W] for a relative echo of 1 [1/sr], the sum over beamlets of
    power fraction times backscatter."""
    beat_amplitude_scale: np.ndarray
    """Amplitude of the beat at the ADC [V] for a relative amplitude of 1, without the receiver's
    low-pass poles. The relative amplitude is the root of the relative echo [1/sr], or this echo
    with direct detection."""
    ground_light_transmission: np.ndarray | float = 1.0
    """Fraction, 0..1, of light from the ground other than the echo, such as sunlight, that reaches
    the receiver."""

    def with_scaled_echo(
        self, *, power_factor: np.ndarray | float = 1.0, amplitude_factor: np.ndarray | float
    ) -> "EchoScales":
        """Return a copy with factors on the echo's power and on the beat's amplitude.

        Parameters
        ----------
        power_factor : ndarray or float
            Factor on the echo power, >= 0.
        amplitude_factor : ndarray or float
            Factor on the amplitude of the beat, >= 0.

        Returns
        -------
        EchoScales
            Scaled echo power [W] and beat amplitude [V]; the transmission of light from the ground
            is unchanged.
        """
        return self._replace(
            echo_power_scale=self.echo_power_scale * power_factor,
            beat_amplitude_scale=self.beat_amplitude_scale * amplitude_factor,
        )


class LinkBudget:
    """Link budget of points that share text parameters; each part is computed on first use.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path, as arrays that broadcast against each other.
    """

    def __init__(self, parameters: Mapping[str, np.ndarray]) -> None:
        self.parameters = parameters

    @cached_property
    def waveform(self) -> WaveformSettings:
        """Chirp rates, frequencies and times of a shot's segments."""
        return WaveformSettings.from_parameters(self.parameters)

    @cached_property
    def record(self) -> RecordSettings:
        """Window, FFT size, sample rate and start of the record of a segment."""
        return RecordSettings.from_parameters(self.parameters)

    @cached_property
    def receiver_filter(self) -> ReceiverFilter:
        """Low-pass poles and anti-alias filter of the receiver."""
        return ReceiverFilter.from_parameters(self.parameters)

    @cached_property
    def target(self) -> TargetState:
        """Range, velocity and acceleration of the target on the beam's axis at the shot's start."""
        return TargetState.from_parameters(self.parameters)

    @cached_property
    def looks(self) -> Looks:
        """Number of looks (records of each segment), and how they are combined."""
        return Looks.from_parameters(self.parameters)

    @cached_property
    def echo_scales(self) -> EchoScales:
        """Echo power [W] and beat amplitude [V] of a target with a relative echo of 1 [1/sr].

        The relative echo is the sum over beamlets of power fraction times backscatter.
        """
        echo_power, current = echo_power_and_beat_current(
            self.waveform.architecture, self.parameters
        )
        return EchoScales(echo_power, current * self.parameters[RECEIVER_PREFIX + "transimpedance"])

    @cached_property
    def receiver_noise(self) -> receiver_chain.ReceiverNoise:
        """Noise variances at the ADC [V^2] of the receiver's own sources."""
        return receiver_chain.receiver_noise(
            self.waveform.architecture,
            receiver_chain.receiver_parameters(self.parameters),
            is_iq_sampled(self.parameters),
        )

    @cached_property
    def noise(self) -> NoiseBudget:
        """Noise budget of the receiver's own sources, before effects add sources."""
        return NoiseBudget(self.receiver_noise.variances)

    @cached_property
    def tnr(self) -> np.ndarray:
        """Threshold-to-noise ratio that the processing parameters set.

        It is the threshold divided by the standard deviation of the magnitude of a noise-only bin.
        """
        return tnr_from_parameters(self.parameters)

    @cached_property
    def threshold_ratio(self) -> np.ndarray:
        """Threshold on a bin's magnitude, divided by the noise sigma per quadrature.

        The noise is that of a bin without an echo.
        """
        return np.asarray(threshold(self.tnr, np.asarray(1.0)))


def threshold(tnr: np.ndarray, bin_noise_sigma: np.ndarray) -> np.ndarray:
    """Return the threshold on a bin's magnitude [V] for a threshold-to-noise ratio.

    The ratio is the threshold over the standard deviation of a noise-only bin's magnitude.

    Parameters
    ----------
    tnr : ndarray
        Threshold-to-noise ratio.
    bin_noise_sigma : ndarray
        Noise sigma of a bin without an echo, per quadrature [V].
    """
    from sweep.model.detection.echo_detection import threshold_from_tnr  # kernels load slowly

    return threshold_from_tnr(tnr=tnr, bin_deviation=bin_noise_sigma)


def adc_noise_variance(parameters: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the variance of the ADC's quantisation noise [V^2], (n,) or a scalar."""
    full_scale, bits = (parameters[PROCESSING_PREFIX + name] for name in ("full_scale", "bits"))
    return receiver_chain.quantisation_variance(
        full_scale=full_scale, bits=bits, is_iq_sampled=is_iq_sampled(parameters)
    )


def relative_amplitude(architecture: str, relative_echo: np.ndarray) -> np.ndarray:
    """Return the beat amplitude that a relative echo causes, divided by its scale.

    The scale is :attr:`EchoScales.beat_amplitude_scale`.

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


def echo_power_and_beat_current(
    architecture: str, parameters: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the echo power [W] and the beat photocurrent [A] for a backscatter of 1 [1/sr].

    Parameters
    ----------
    architecture : str
        Receiver architecture: ``homodyne``, ``heterodyne`` or ``direct``.
    parameters : mapping
        Parameters of laser, telescope, receiver and target by dotted path, as arrays that broadcast
        against each other.

    Returns
    -------
    echo_power : ndarray
        Echo power [W] with the full beam at ``target.range``.
    beat_current : ndarray
        Amplitude of its beat photocurrent [A], by :func:`beat_current`.

    Notes
    -----
    The echo power is

        P = P_tx A tau_o rho / R^2

    with the transmitted power P_tx, the area A of
    :func:`sweep.model.beam.effective_collecting_area`, the optical efficiency tau_o, the
    reflectance rho and the range R. The law is [T 4.4] without its factor 1/(2 pi), which belongs
    to the reflectance law, and without the atmosphere's transmission, which is an effect. A
    beamlet's echo is this power times its power fraction and its backscatter [1/sr] for a
    reflectance of 1, divided by the range loss of :func:`sweep.model.beam.range_loss_coefficients`.
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
    """Return the amplitude of the beat photocurrent [A] that received light causes.

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
    M is the gain and Re the responsivity of the detector. Coherent architectures: 2 M Re sqrt(eta
    P_lo P), with the power P_lo of the local oscillator and the heterodyne efficiency eta, a
    fraction of power. Direct detection: m M Re P, with the modulation depth m; hence 2 dB of SNR
    for each dB of light. [T 2.22] takes 2 Re^2 P^2 as the mean square current, which is the peak of
    a fully modulated echo. With the mean echo power P the mean square is m^2 Re^2 P^2 / 2, a
    quarter of it.
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
