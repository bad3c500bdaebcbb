"""Receiver: low-passes, anti-alias filter, and the noise in the photocurrent and at the ADC."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.constants import BOLTZMANN, ELEMENTARY_CHARGE

RECEIVER_PREFIX = "instrument.receiver."
"""Common beginning of the dotted paths of the receiver's parameters."""
ARCHITECTURES = ("homodyne", "heterodyne", "direct")
"""Names of the receiver architectures that can be simulated."""


def aperture_area(diameter: np.ndarray) -> np.ndarray:
    """Return the area [m^2] of a circular aperture from its ``diameter`` [m], [T 4.3]."""
    return math.pi * (np.asarray(diameter) / 2) ** 2


def shot_noise_current_variance(
    *,
    power: np.ndarray | float,
    apd_gain: np.ndarray,
    excess_noise_factor: np.ndarray,
    responsivity: np.ndarray,
    electrical_bandwidth: np.ndarray,
) -> np.ndarray:
    """Return the variance of the shot-noise current [A^2] that light causes in the detector.

    Parameters
    ----------
    power : ndarray or float
        Power P of the light [W].
    apd_gain, excess_noise_factor : ndarray
        Gain M and excess noise factor F of an avalanche photodiode; 1 without one.
    responsivity : ndarray
        Responsivity Re [A/W].
    electrical_bandwidth : ndarray
        Bandwidth B_e [Hz].

    Returns
    -------
    ndarray
        Variance 2 q M^2 F Re P B_e [A^2].
    """
    squared_gain = np.asarray(apd_gain) ** 2 * excess_noise_factor
    return 2 * ELEMENTARY_CHARGE * squared_gain * responsivity * power * electrical_bandwidth


class ReceiverNoise(NamedTuple):
    """Noise variances at the ADC: by source, per noise current, and per power of light."""

    electrical_bandwidth: np.ndarray
    """Noise bandwidth B_e of the receiver [Hz] (:func:`electrical_bandwidth`)."""
    variance_per_square_ampere: np.ndarray
    """Variance of the voltage at the ADC, divided by that of the noise current in the detector
    [V^2/A^2]."""
    shot_noise_variance_per_watt: np.ndarray
    """Variance of the shot noise at the ADC, divided by the power of light on the detector [V^2/W].
    """
    variances: dict[str, np.ndarray]
    """Noise variance at the ADC [V^2] by name of the source, for the receiver's own sources."""


ANTIALIAS_DEFAULTS = {"antialias_bandwidth": 0.0, "antialias_order": 6.0}
"""Default bandwidth [Hz] and order of the anti-alias filter, by parameter name. A bandwidth of 0
means no filter."""

_N_ALIASES_PER_SIDE = 32
"""Number of aliases on each side of a frequency over which the noise after an anti-alias filter is
summed. With order 3 and a bandwidth of the full sample rate, omitted aliases have 1e-8 of the noise
density."""

_LOG_ATTENUATION_MAX = 345.0
"""Limit of the natural logarithm of the anti-alias filter's power attenuation. It keeps the
transmitted power above 0."""


def receiver_noise(
    architecture: str, receiver: Mapping[str, np.ndarray], is_iq_sampled: bool = False
) -> ReceiverNoise:
    """Return the noise variances at the ADC that the receiver's own sources cause.

    Parameters
    ----------
    architecture : str
        One of :data:`ARCHITECTURES`.
    receiver : mapping
        Parameters, as in :func:`receiver_parameters`, (n,) or scalars.
    is_iq_sampled : bool
        True for two receivers that sample I and Q. The variances are then those of a real record
        whose bins have the same noise.

    Returns
    -------
    ReceiverNoise
        Variances [V^2].

    Notes
    -----
    The sources are the local oscillator's shot noise, the detector's (M Re NEP)^2 B_e, and the
    square of the amplifier's rms current. Direct detection has no local oscillator and adds the
    thermal noise of its load, 4 k T B_e / R_L [T 2.22].

    A heterodyne receiver mixes an IF down, and noise from both sides of the IF enters the record.
    The shot-limited SNR is then Re P / (2 q B_e) [T 2.23], half the homodyne's. The RF noise figure
    multiplies all of this noise.

    With I and Q, a 90 degree hybrid gives each receiver half of echo and local oscillator. The bins
    of I + iQ show a line as those of a real record do. The total shot noise is the same, and the
    receivers' own noise doubles. The variance of currents proportional to the light is a quarter in
    each receiver and half in total.
    """
    bandwidth = electrical_bandwidth(receiver)
    detector_parameters = {
        name: receiver[name] for name in ("apd_gain", "excess_noise_factor", "responsivity")
    }
    detector_variance = (
        receiver["apd_gain"] * receiver["responsivity"] * receiver["noise_equivalent_power"]
    ) ** 2 * bandwidth
    # fraction of the amplifier's noise that passes the anti-alias filter
    passed_fraction = bandwidth / np.minimum(
        receiver["detector_bandwidth"], receiver["amplifier_bandwidth"]
    )
    current_variances = {
        "detector": detector_variance,
        "amplifier": receiver["amplifier_noise_current"] ** 2 * passed_fraction,
    }
    if architecture == "direct":
        thermal_variance = (
            4 * BOLTZMANN * receiver["temperature"] * bandwidth / receiver["load_resistance"]
        )
        current_variances = current_variances | {"thermal": thermal_variance}
    else:
        oscillator_power = receiver["local_oscillator_power"]
        oscillator_variance = shot_noise_current_variance(
            power=oscillator_power, electrical_bandwidth=bandwidth, **detector_parameters
        )
        current_variances = {"local_oscillator_shot": oscillator_variance} | current_variances
    noise_factor = 2.0 * receiver["noise_figure"] if architecture == "heterodyne" else 1.0
    squared_transimpedance = np.asarray(noise_factor * receiver["transimpedance"] ** 2)
    shot_noise_variance_per_watt = shot_noise_current_variance(
        power=1.0, electrical_bandwidth=bandwidth, **detector_parameters
    )
    variances = {
        source: np.asarray(value * squared_transimpedance)
        for source, value in current_variances.items()
    }
    if is_iq_sampled:
        for name in variances.keys() - {"local_oscillator_shot"}:
            variances[name] = 2 * variances[name]
    variance_per_square_ampere = (
        squared_transimpedance / 2 if is_iq_sampled else squared_transimpedance
    )
    return ReceiverNoise(
        bandwidth,
        variance_per_square_ampere,
        np.asarray(shot_noise_variance_per_watt * squared_transimpedance),
        variances,
    )


def quantisation_variance(
    *, full_scale: ArrayLike, bits: ArrayLike, is_iq_sampled: bool = False
) -> np.ndarray:
    """Return the noise variance [V^2] that the ADC adds by rounding to steps.

    Parameters
    ----------
    full_scale : array_like
        Largest magnitude V of the voltage [V].
    bits : array_like
        Effective number of bits, not necessarily an integer; 0 for no rounding. With it, rounding
        causes as much noise as all noise sources of the real ADC.
    is_iq_sampled : bool
        True for two ADCs that sample I and Q.

    Returns
    -------
    ndarray
        Variance lsb^2/12 [V^2], lsb = 2 V / 2^bits; twice that with I and Q.

    Notes
    -----
    If the standard deviation s of the noise is about a step or more, the error is white and
    independent of the signal [1]_. It departs from that by exp(-2 pi^2 s^2 / lsb^2): 2.7e-9 for s =
    lsb and 0.7 % for s = lsb/2. The receiver's gain and noise figure do not act on it.

    References
    ----------
    .. [1] Widrow and Kollar, Quantization Noise, 2008, ch. 4, 9.
    """
    bits = np.asarray(bits, float)
    lsb = 2 * np.asarray(full_scale, float) * 2.0**-bits
    return np.where(bits > 0, (2 if is_iq_sampled else 1) * (lsb**2 / 12), 0.0)


def bin_noise_sigma(*, noise_variance: np.ndarray, window_energy: np.ndarray) -> np.ndarray:
    """Return the noise standard deviation per quadrature of an FFT bin [V], [T 3.2].

    Parameters
    ----------
    noise_variance : ndarray
        Variance sigma_x^2 of a sample [V^2].
    window_energy : ndarray
        Energy of the window E_w = sum w^2.

    Returns
    -------
    ndarray
        Sigma [V] of a bin of the FFT, which is not normalised.

    Notes
    -----
    sqrt(E_w sigma_x^2 / 2).
    """
    return np.sqrt(window_energy * noise_variance / 2)


def receiver_transfer_function(
    frequency: np.ndarray,
    *,
    detector_bandwidth: np.ndarray,
    amplifier_bandwidth: np.ndarray,
) -> np.ndarray:
    """Return the complex transfer function of detector and amplifier, relative to DC.

    Parameters
    ----------
    frequency : ndarray
        Signed frequency [Hz], before the ADC folds it.
    detector_bandwidth, amplifier_bandwidth : ndarray
        Bandwidths of two single-pole low-passes [Hz], at which each is 3 dB down.

    Returns
    -------
    ndarray complex
        Ratio of voltages, 1 at DC.

    Notes
    -----
    1 / ((1 + i f / B_d) (1 + i f / B_a)).
    """
    poles = (1 + 1j * frequency / detector_bandwidth) * (1 + 1j * frequency / amplifier_bandwidth)
    return 1 / poles


def electrical_bandwidth(receiver: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the receiver's noise bandwidth [Hz]: the smallest bandwidth of its stages.

    The stages are detector, amplifier and, if there is one, the anti-alias filter. [T] states one
    bandwidth for detector and amplifier, and uses it as the noise bandwidth.
    """
    narrowest_pole = np.minimum(receiver["detector_bandwidth"], receiver["amplifier_bandwidth"])
    antialias = antialias_filter_parameters(receiver)
    return (
        np.minimum(narrowest_pole, antialias["antialias_bandwidth"])
        if antialias
        else narrowest_pole
    )


def receiver_parameters(parameters: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the receiver's parameters by name, the dotted path without RECEIVER_PREFIX."""
    return {
        path.removeprefix(RECEIVER_PREFIX): value
        for path, value in parameters.items()
        if path.startswith(RECEIVER_PREFIX)
    }


def antialias_filter_parameters(receiver: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return bandwidth and order of the anti-alias filter by name; an empty dict without a filter.

    `receiver` are the receiver's parameters by name.
    """
    filter_parameters = {
        name: np.asarray(receiver.get(name, default))
        for name, default in ANTIALIAS_DEFAULTS.items()
    }
    return filter_parameters if np.any(filter_parameters["antialias_bandwidth"]) else {}


def antialias_power_transmission(
    frequency: np.ndarray, *, antialias_bandwidth: np.ndarray, antialias_order: np.ndarray
) -> np.ndarray:
    """Return the power transmission of the anti-alias filter at a frequency, 0..1.

    Parameters
    ----------
    frequency : ndarray
        Signed frequency [Hz], before the ADC folds it.
    antialias_bandwidth, antialias_order : ndarray
        Bandwidth B [Hz] and order n.

    Returns
    -------
    ndarray
        Ratio of powers, 0..1.

    Notes
    -----
    A Butterworth low-pass, 3 dB down at B: 1 / (1 + (f / B)^(2 n)).

    Examples
    --------
    >>> given = {"antialias_bandwidth": np.array(1e8), "antialias_order": np.array(6)}
    >>> transmission = antialias_power_transmission(np.array([5e7, 1e8, 2e8]), **given)
    >>> [round(10 * float(np.log10(power)), 1) for power in transmission]
    [-0.0, -3.0, -36.1]
    """
    with np.errstate(divide="ignore"):  # log of 0 at DC
        log_frequency_ratio = np.log(np.abs(frequency) / antialias_bandwidth)
    return np.asarray(
        1
        / (1 + np.exp(np.minimum(2 * antialias_order * log_frequency_ratio, _LOG_ATTENUATION_MAX)))
    )


def relative_noise_density(
    frequency: np.ndarray, *, sample_rate: np.ndarray, **filters: np.ndarray
) -> np.ndarray:
    """Return the noise density of a record, relative to white noise of the same variance.

    Parameters
    ----------
    frequency : ndarray
        Frequency [Hz] of either sign, before or after the ADC folds it.
    sample_rate : ndarray
        Sample rate f_s [Hz].
    **filters : ndarray
        ``detector_bandwidth``, ``amplifier_bandwidth`` [Hz], and the parameters of an anti-alias
        filter if there is one.

    Notes
    -----
    The sources' noise passes |H|^2 and folds: f_s / (2 B_e) sum_m |H(f + m f_s)|^2. With a = 2 pi B
    / f_s a single pole's sum is

        sum_m 1 / (1 + (f + m f_s)^2 / B^2) = (a / 2) sinh a / (cosh a - cos(2 pi f / f_s))

    and that of two poles follows by partial fractions, or by the derivative if they are equal. With
    an anti-alias filter |H|^2 includes its transmission, and the aliases are summed one by one.
    """
    poles = {
        name: np.asarray(filters[name], float)
        for name in ("detector_bandwidth", "amplifier_bandwidth")
    }
    if antialias := antialias_filter_parameters(filters):
        folded_frequency = frequency - sample_rate * np.rint(frequency / sample_rate)
        density = np.zeros(())
        for alias_number in range(-_N_ALIASES_PER_SIDE, _N_ALIASES_PER_SIDE + 1):
            alias_frequency = folded_frequency + alias_number * sample_rate
            amplitude = receiver_transfer_function(alias_frequency, **poles)
            density = density + np.abs(amplitude) ** 2 * antialias_power_transmission(
                alias_frequency, **antialias
            )
        return density * sample_rate / (2 * electrical_bandwidth(filters))
    bandwidth_1, bandwidth_2 = poles.values()
    cosine = np.cos(2 * np.pi * (np.asarray(frequency) / sample_rate))
    are_equal = np.abs(bandwidth_1 - bandwidth_2) <= 1e-4 * np.minimum(bandwidth_1, bandwidth_2)
    alias_sum_1, derivative_1 = _single_pole_alias_sum_and_derivative(
        2 * np.pi * np.where(are_equal, (bandwidth_1 + bandwidth_2) / 2, bandwidth_1) / sample_rate,
        cosine,
    )
    alias_sum_2, _ = _single_pole_alias_sum_and_derivative(
        2 * np.pi * bandwidth_2 / sample_rate, cosine
    )
    squared_bandwidth_ratio = np.where(are_equal, 0.5, np.square(bandwidth_2 / bandwidth_1))
    with np.errstate(over="ignore", invalid="ignore"):
        partial_fractions = np.where(
            np.isinf(squared_bandwidth_ratio),
            alias_sum_1,
            (squared_bandwidth_ratio * alias_sum_1 - alias_sum_2) / (squared_bandwidth_ratio - 1),
        )
    density = np.where(are_equal, alias_sum_1 - derivative_1, partial_fractions)
    folded_frequency = np.arccos(np.clip(cosine, -1, 1)) * sample_rate / (2 * np.pi)
    unaliased = 1 / (
        (1 + (folded_frequency / bandwidth_1) ** 2) * (1 + (folded_frequency / bandwidth_2) ** 2)
    )  # rounding may leave less
    return np.asarray(
        np.maximum(density, unaliased) * sample_rate / (2 * np.minimum(bandwidth_1, bandwidth_2))
    )


def _single_pole_alias_sum_and_derivative(
    a: np.ndarray, cosine: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a single-pole low-pass's power transmission, summed over aliases, and a derivative.

    Parameters
    ----------
    a : ndarray
        2 pi B / f_s, with the bandwidth B and the sample rate f_s; above 0.
    cosine : ndarray
        cos(2 pi f / f_s) at the frequency f.

    Returns
    -------
    alias_sum : ndarray
        Sum s over all aliases of the frequency.
    derivative : ndarray
        (a / 2) ds/da.
    """
    q, one_minus_q = np.exp(-a), -np.expm1(-a)
    denominator = one_minus_q * one_minus_q + 2 * q * (1 - cosine)
    hyperbolic_ratio = one_minus_q * (2 - one_minus_q) / denominator
    ratio_derivative = 2 * q * (2 * q - cosine * (1 + q * q)) / denominator**2
    return a / 2 * hyperbolic_ratio, a / 4 * (hyperbolic_ratio + a * ratio_derivative)
