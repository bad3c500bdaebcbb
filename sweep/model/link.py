"""Link budget: echo power at the aperture and the beat it makes in the photocurrent."""

import math

import numpy as np

ARCHITECTURES = ("homodyne", "heterodyne", "direct")


def aperture_area(aperture: np.ndarray) -> np.ndarray:
    """Area of a circular aperture [m^2] from its diameter [m], [T 4.3]."""
    return math.pi * (np.asarray(aperture) / 2) ** 2


def echo_power_scale(
    *,
    power: np.ndarray,
    aperture: np.ndarray,
    optical_efficiency: np.ndarray,
    reflectance: np.ndarray,
    range: np.ndarray,
) -> np.ndarray:
    """Echo power [W] for a backscatter of 1/sr with the whole beam at one range.

    [T 4.4] without its 1/(2 pi): that belongs to the reflectance law. A beamlet's echo is this
    times its power fraction, its backscatter [1/sr] and (R_0/R_b)^2.
    """
    return power * aperture_area(aperture) * optical_efficiency * reflectance / range**2


def beat_scale(
    architecture: str,
    *,
    echo_power_scale: np.ndarray,
    local_oscillator_power: np.ndarray,
    mixing_efficiency: np.ndarray,
    apd_gain: np.ndarray,
    responsivity: np.ndarray,
    modulation_index: np.ndarray,
) -> np.ndarray:
    """Amplitude of the beat photocurrent [A] that one unit of relative echo makes.

    Coherent architectures: 2 M Re sqrt(eta P_lo P), to be multiplied by the square root of a
    beamlet's relative echo power; eta is the heterodyne efficiency, a share of power. Direct
    detection: m M Re P, to be multiplied by the relative echo power itself, hence 2 dB of SNR for
    each dB of light.

    [T 2.22] takes 2 Re^2 P^2 as the mean square current, which is the peak of a fully modulated
    echo; with P the mean echo power the mean square is m^2 Re^2 P^2 / 2, a quarter of it.
    """
    if architecture == "direct":
        return modulation_index * apd_gain * responsivity * echo_power_scale
    mixed = np.sqrt(mixing_efficiency * (local_oscillator_power * echo_power_scale))
    return 2 * apd_gain * responsivity * mixed
