"""Receiver: its poles and filter, and the noise in the photocurrent and at the ADC."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.constants import BOLTZMANN, ELEMENTARY_CHARGE

RECEIVER_PREFIX = "instrument.receiver."
ARCHITECTURES = ("homodyne", "heterodyne", "direct")


def aperture_area(diameter: np.ndarray) -> np.ndarray:
    """Area of a circular aperture [m^2] from its diameter [m], [T 4.3]."""
    return math.pi * (np.asarray(diameter) / 2) ** 2


def shot_noise_current_variance(
    *,
    power: np.ndarray | float,
    apd_gain: np.ndarray,
    excess_noise_factor: np.ndarray,
    responsivity: np.ndarray,
    electrical_bandwidth: np.ndarray,
) -> np.ndarray:
    """Compute current variance 2 q M^2 F Re P B_e [A^2] of light of power P [W] on the detector."""
    squared_gain = np.asarray(apd_gain) ** 2 * excess_noise_factor
    return 2 * ELEMENTARY_CHARGE * squared_gain * responsivity * power * electrical_bandwidth


class ReceiverNoise(NamedTuple):
    """Variances at the ADC [V^2]."""

    variance_per_square_ampere: np.ndarray
    """Of 1 A^2 of current."""
    shot_noise_variance_per_watt: np.ndarray
    """Of the shot noise of 1 W of light."""
    variances: dict[str, np.ndarray]
    """Of the receiver's own, by source."""


ANTIALIAS_DEFAULTS = {"antialias_bandwidth": 0.0, "antialias_order": 6.0}
"""Parameters of the filter before the ADC, none by default, which points need not have."""

_ALIASES_PER_SIDE = 32
"""Aliases on either side that pass an anti-alias filter: of order 3 and a bandwidth of the whole
sample rate those beyond have 1e-8 of the density."""

_LOG_ATTENUATION_MAX = 345.0
"""Natural logarithm of the most that such a filter takes from a power: nothing becomes 0."""


def receiver_noise(
    architecture: str, receiver: Mapping[str, np.ndarray], samples_iq: bool = False
) -> ReceiverNoise:
    """Noise of receivers of an architecture, from :func:`receiver_parameters`, (n,) or scalars.

    The local oscillator's shot noise, the detector's own (M Re NEP)^2 B_e, the amplifier's rms
    current squared. Direct detection has no local oscillator and adds its load's thermal noise,
    4 k T B_e / R_L [T 2.22]. A heterodyne receiver mixes an IF down: noise from both sides of the
    IF lands in the record, which makes the shot-limited SNR Re P / (2 q B_e) [T 2.23], half the
    homodyne's. Its RF noise figure multiplies all of it.

    ``samples_iq``: of two receivers that sample I and Q, as the noise of a bin of a real record.
    A 90 degree hybrid gives each of them half of echo and local oscillator, and the bins of I + iQ
    show a line as those of a real record do. Shot noise is the same altogether, each one's own
    noise twice as much; that of currents which go with the light, a quarter of the variance each,
    is half.
    """
    bandwidth = electrical_bandwidth(receiver)
    detector_parameters = {
        name: receiver[name] for name in ("apd_gain", "excess_noise_factor", "responsivity")
    }
    detector_variance = (
        receiver["apd_gain"] * receiver["responsivity"] * receiver["noise_equivalent_power"]
    ) ** 2 * bandwidth
    # what the anti-alias filter leaves of the rms
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
    if samples_iq:
        for name in variances.keys() - {"local_oscillator_shot"}:
            variances[name] = 2 * variances[name]
    variance_per_square_ampere = (
        squared_transimpedance / 2 if samples_iq else squared_transimpedance
    )
    return ReceiverNoise(
        variance_per_square_ampere,
        np.asarray(shot_noise_variance_per_watt * squared_transimpedance),
        variances,
    )


def quantisation_variance(
    *, full_scale: ArrayLike, bits: ArrayLike, samples_iq: bool = False
) -> np.ndarray:
    """Variance lsb^2/12 [V^2] that rounding adds at the ADC, lsb = 2 V / 2^bits; 0 for 0 bits.

    If the noise's deviation s spans a step or so the error is white and independent of the signal
    [Widrow and Kollar, Quantization Noise, 2008, ch. 4, 9]: it departs from that by exp(-2 pi^2 s^2
    / lsb^2), 2.7e-9 for s = lsb and 0.7 % for s = lsb/2. Neither the receiver's gain nor its noise
    figure acts on it. ``full_scale`` is the largest voltage V [V] to either side; the effective
    number of bits, which need not be whole, makes the noise of a real ADC. Two ADCs sample I and Q.
    """
    bits = np.asarray(bits, float)
    lsb = 2 * np.asarray(full_scale, float) * 2.0**-bits
    return np.where(bits > 0, (2 if samples_iq else 1) * (lsb**2 / 12), 0.0)


def bin_noise_sigma(*, noise_variance: np.ndarray, window_energy: np.ndarray) -> np.ndarray:
    """Noise sigma of a bin, per quadrature: sqrt(E_w sigma_x^2 / 2), [T 3.2]."""
    return np.sqrt(window_energy * noise_variance / 2)


def receiver_transfer(
    frequency: np.ndarray,
    *,
    detector_bandwidth: np.ndarray,
    amplifier_bandwidth: np.ndarray,
) -> np.ndarray:
    """Complex transfer of the receiver at a signed frequency [Hz], over that at DC.

    Two single-pole low-passes, each 3 dB down at its stated bandwidth. Lines are taken at the
    frequency they have before the ADC folds them.
    """
    poles = (1 + 1j * frequency / detector_bandwidth) * (1 + 1j * frequency / amplifier_bandwidth)
    return 1 / poles


def electrical_bandwidth(receiver: Mapping[str, np.ndarray]) -> np.ndarray:
    """Bandwidth B_e [Hz] over which noise is counted: the narrowest of all stages.

    [T] states one figure for detector and amplifier and uses it as the noise bandwidth; so does
    this. An anti-alias filter counts as a further stage.
    """
    narrowest_pole = np.minimum(receiver["detector_bandwidth"], receiver["amplifier_bandwidth"])
    antialias = antialias_filter_parameters(receiver)
    return (
        np.minimum(narrowest_pole, antialias["antialias_bandwidth"])
        if antialias
        else narrowest_pole
    )


def receiver_parameters(parameters: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Parameters of the receiver, by their names alone."""
    return {
        path.removeprefix(RECEIVER_PREFIX): value
        for path, value in parameters.items()
        if path.startswith(RECEIVER_PREFIX)
    }


def antialias_filter_parameters(receiver: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Parameters of the filter before the ADC, of the receiver's; empty without one."""
    filter_parameters = {
        name: np.asarray(receiver.get(name, default))
        for name, default in ANTIALIAS_DEFAULTS.items()
    }
    return filter_parameters if np.any(filter_parameters["antialias_bandwidth"]) else {}


def antialias_power_transmission(
    frequency: np.ndarray, *, antialias_bandwidth: np.ndarray, antialias_order: np.ndarray
) -> np.ndarray:
    """Power that passes the anti-alias filter at a signed frequency [Hz], before it folds.

    A Butterworth low-pass of order n, 3 dB down at its bandwidth B [Hz]: 1 / (1 + (f / B)^(2 n)).

    >>> given = {"antialias_bandwidth": np.array(1e8), "antialias_order": np.array(6)}
    >>> [round(10 * float(np.log10(antialias_power(f, **given))), 1) for f in (5e7, 1e8, 2e8)]
    [-0.0, -3.0, -36.1]
    """
    with np.errstate(divide="ignore"):  # ln 0 at DC
        log_frequency_ratio = np.log(np.abs(frequency) / antialias_bandwidth)
    return np.asarray(
        1
        / (1 + np.exp(np.minimum(2 * antialias_order * log_frequency_ratio, _LOG_ATTENUATION_MAX)))
    )


def relative_noise_density(
    frequency: np.ndarray, *, sample_rate: np.ndarray, **filters: np.ndarray
) -> np.ndarray:
    """Density of the noise in a record, over that of white noise of the same sources.

    The sources' noise passes |H|^2 and folds: f_s / (2 B_e) sum_m |H(f + m f_s)|^2 at a frequency f
    [Hz] of any sign, folded or not. With a = 2 pi B / f_s a single pole's sum is

        sum_m 1 / (1 + (f + m f_s)^2 / B^2) = (a / 2) sinh a / (cosh a - cos(2 pi f / f_s))

    and that of two poles follows by partial fractions, or by the derivative where they are equal.
    Behind an anti-alias filter |H|^2 has its power too, and aliases are summed one by one.
    """
    poles = {
        name: np.asarray(filters[name], float)
        for name in ("detector_bandwidth", "amplifier_bandwidth")
    }
    if antialias := antialias_filter_parameters(filters):
        folded_frequency = frequency - sample_rate * np.rint(frequency / sample_rate)
        density = np.zeros(())
        for alias_number in range(-_ALIASES_PER_SIDE, _ALIASES_PER_SIDE + 1):
            alias_frequency = folded_frequency + alias_number * sample_rate
            amplitude = receiver_transfer(alias_frequency, **poles)
            density = density + np.abs(amplitude) ** 2 * antialias_power_transmission(
                alias_frequency, **antialias
            )
        return density * sample_rate / (2 * electrical_bandwidth(filters))
    bandwidth_1, bandwidth_2 = poles.values()
    cosine = np.cos(2 * np.pi * (np.asarray(frequency) / sample_rate))
    are_equal = np.abs(bandwidth_1 - bandwidth_2) <= 1e-4 * np.minimum(bandwidth_1, bandwidth_2)
    alias_sum_1, derivative_1 = _single_pole_alias_sum(
        2 * np.pi * np.where(are_equal, (bandwidth_1 + bandwidth_2) / 2, bandwidth_1) / sample_rate,
        cosine,
    )
    alias_sum_2, _ = _single_pole_alias_sum(2 * np.pi * bandwidth_2 / sample_rate, cosine)
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
    )  # where all else rounds
    return np.asarray(
        np.maximum(density, unaliased) * sample_rate / (2 * np.minimum(bandwidth_1, bandwidth_2))
    )


def _single_pole_alias_sum(a: np.ndarray, cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum s over the aliases of a single pole, a > 0, and (a / 2) ds/da."""
    q, one_minus_q = np.exp(-a), -np.expm1(-a)
    denominator = one_minus_q * one_minus_q + 2 * q * (1 - cosine)
    hyperbolic_ratio = one_minus_q * (2 - one_minus_q) / denominator
    ratio_derivative = 2 * q * (2 * q - cosine * (1 + q * q)) / denominator**2
    return a / 2 * hyperbolic_ratio, a / 4 * (hyperbolic_ratio + a * ratio_derivative)
