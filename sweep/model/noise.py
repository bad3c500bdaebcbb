"""Noise at the ADC by source, and what it becomes in a bin of the spectrum."""

import math

import numpy as np

from sweep.model.constants import BOLTZMANN, ELEMENTARY_CHARGE
from sweep.model.link import aperture_area

SOURCES = ("local_oscillator_shot", "signal_shot", "solar_shot", "detector", "amplifier", "thermal")


def solar_power(
    *,
    solar_irradiance: np.ndarray,
    reflectance: np.ndarray,
    aperture: np.ndarray,
    beam_divergence: np.ndarray,
    optical_passband: np.ndarray,
    optical_efficiency: np.ndarray,
) -> np.ndarray:
    """Sunlight [W] scattered into the receiver by a diffuse surface that fills its field of view.

    Radiance E rho / pi, seen through the aperture, over the solid angle of the beam's full
    divergence and the optical passband. E is the spectral irradiance on the surface [W/m^3].
    """
    solid_angle = math.pi * (np.asarray(beam_divergence) / 2) ** 2
    radiance = solar_irradiance * reflectance / math.pi
    return radiance * aperture_area(aperture) * solid_angle * optical_passband * optical_efficiency


def current_variances(
    architecture: str,
    *,
    local_oscillator_power: np.ndarray,
    echo_power: np.ndarray,
    solar_power: np.ndarray,
    apd_gain: np.ndarray,
    excess_noise_factor: np.ndarray,
    responsivity: np.ndarray,
    noise_equivalent_power: np.ndarray,
    amplifier_noise_current: np.ndarray,
    electrical_bandwidth: np.ndarray,
    noise_figure: np.ndarray,
    load_resistance: np.ndarray,
    temperature: np.ndarray,
) -> dict[str, np.ndarray]:
    """Input-referred current variance of each source [A^2] inside the electrical bandwidth.

    Shot noise is 2 q M^2 F Re P B_e for each light on the detector, the detector's own
    (M Re NEP)^2 B_e, the amplifier's its rms current squared. Direct detection has no local
    oscillator and adds its load's thermal noise 4 k T B_e / R_L [T 2.22]. Heterodyne detection
    mixes an IF down: noise from both sides of the IF lands in the record, which makes the
    shot-limited SNR Re P / (2 q B_e) [T 2.23], half the homodyne's; its RF noise figure
    multiplies all of it.
    """
    per_watt = (
        2 * ELEMENTARY_CHARGE * apd_gain**2 * excess_noise_factor * responsivity
    ) * electrical_bandwidth
    direct = architecture == "direct"
    variances = {
        "local_oscillator_shot": per_watt * (0.0 if direct else local_oscillator_power),
        "signal_shot": per_watt * echo_power,
        "solar_shot": per_watt * solar_power,
        "detector": (apd_gain * responsivity * noise_equivalent_power) ** 2 * electrical_bandwidth,
        "amplifier": amplifier_noise_current**2,
        "thermal": (
            4 * BOLTZMANN * temperature * electrical_bandwidth / load_resistance if direct else 0.0
        ),
    }
    if architecture == "heterodyne":
        return {source: 2 * noise_figure * value for source, value in variances.items()}
    return variances


def bin_deviation(*, noise_variance: np.ndarray, window_energy: np.ndarray) -> np.ndarray:
    """Noise sigma of a bin, per quadrature: sqrt(E_w sigma_x^2 / 2), [T 3.2]."""
    return np.sqrt(window_energy * noise_variance / 2)
