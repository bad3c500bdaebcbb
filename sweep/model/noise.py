"""Noise at the ADC by source, and what it becomes in a bin of the spectrum."""

import math

import numpy as np

from sweep.model.constants import BOLTZMANN, ELEMENTARY_CHARGE
from sweep.model.link import aperture_area


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


def shot_noise(
    *,
    power: np.ndarray | float,
    apd_gain: np.ndarray,
    excess_noise_factor: np.ndarray,
    responsivity: np.ndarray,
    electrical_bandwidth: np.ndarray,
) -> np.ndarray:
    """Current variance 2 q M^2 F Re P B_e [A^2] of light of power P [W] on the detector."""
    gain = np.asarray(apd_gain) ** 2 * excess_noise_factor
    return 2 * ELEMENTARY_CHARGE * gain * responsivity * power * electrical_bandwidth


def receiver_currents(
    architecture: str,
    *,
    local_oscillator_power: np.ndarray,
    apd_gain: np.ndarray,
    excess_noise_factor: np.ndarray,
    responsivity: np.ndarray,
    noise_equivalent_power: np.ndarray,
    amplifier_noise_current: np.ndarray,
    electrical_bandwidth: np.ndarray,
    load_resistance: np.ndarray,
    temperature: np.ndarray,
) -> dict[str, np.ndarray]:
    """Current variance of each source in the receiver [A^2] inside the electrical bandwidth.

    The local oscillator's shot noise, the detector's own (M Re NEP)^2 B_e, the amplifier's rms
    current squared. Direct detection has no local oscillator and adds its load's thermal noise
    4 k T B_e / R_L [T 2.22]. What light from outside adds are effects.
    """
    detector = (apd_gain * responsivity * noise_equivalent_power) ** 2 * electrical_bandwidth
    own = {"detector": detector, "amplifier": np.asarray(amplifier_noise_current) ** 2}
    if architecture == "direct":
        thermal = 4 * BOLTZMANN * temperature * electrical_bandwidth / load_resistance
        return own | {"thermal": thermal}
    oscillator = shot_noise(
        power=local_oscillator_power,
        apd_gain=apd_gain,
        excess_noise_factor=excess_noise_factor,
        responsivity=responsivity,
        electrical_bandwidth=electrical_bandwidth,
    )
    return {"local_oscillator_shot": oscillator} | own


def current_scale(architecture: str, *, noise_figure: np.ndarray) -> np.ndarray:
    """Factor on all current variances: 2 F_RF for a heterodyne receiver, else 1.

    It mixes an IF down: noise from both sides of the IF lands in the record, which makes the
    shot-limited SNR Re P / (2 q B_e) [T 2.23], half the homodyne's; its RF noise figure
    multiplies all of it.
    """
    return np.asarray(2.0 * noise_figure if architecture == "heterodyne" else 1.0)


def bin_deviation(*, noise_variance: np.ndarray, window_energy: np.ndarray) -> np.ndarray:
    """Noise sigma of a bin, per quadrature: sqrt(E_w sigma_x^2 / 2), [T 3.2]."""
    return np.sqrt(window_energy * noise_variance / 2)
