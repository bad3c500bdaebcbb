"""Relative intensity noise: the local oscillator's power fluctuates by itself.

A laser's relative intensity noise RIN [1/Hz] is the one-sided spectral density of dP/P. Detected
by one diode it makes the current variance (M Re P_lo)^2 RIN B_e. The two diodes of a balanced
receiver see the same fluctuation and subtract it, all but their mismatch: the common-mode
rejection, a ratio of powers (in dB 20 log10 of the ratio of the currents), divides the variance.
Both are taken to be flat over the electrical bandwidth, so the noise is white like the rest.

RIN of the echo is left out: it is below that of the local oscillator by P/P_lo. At
RIN = 2 q / (Re P_lo), -155 dB/Hz for a milliampere, one diode sees as much of it as shot noise.
"""

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects import added_noise
from sweep.model.effects.change import Change


def current_variance(
    *,
    relative_intensity_noise: ArrayLike,
    common_mode_rejection: ArrayLike,
    local_oscillator_power: ArrayLike,
    apd_gain: ArrayLike,
    responsivity: ArrayLike,
    electrical_bandwidth: ArrayLike,
) -> np.ndarray:
    """Current variance [A^2] by intensity noise of the local oscillator.

    Parameters
    ----------
    relative_intensity_noise : array_like
        One-sided density of dP/P [1/Hz], >= 0; -150 dB/Hz is 1e-15/Hz. (n,) or scalar, as all.
    common_mode_rejection : array_like
        Ratio of powers, >= 1; 1 for a single diode, 25 dB is 316.
    local_oscillator_power : array_like
        Power [W] on the detector; 0 for direct detection.
    apd_gain, responsivity, electrical_bandwidth : array_like
        As for :func:`sweep.model.noise.current_variances`.
    """
    current = (
        np.asarray(apd_gain, float)
        * np.asarray(responsivity, float)
        * np.asarray(local_oscillator_power, float)
    )
    seen = np.asarray(relative_intensity_noise, float) / np.asarray(common_mode_rejection, float)
    return current**2 * seen * np.asarray(electrical_bandwidth, float)


def bound(
    *,
    relative_intensity_noise: ArrayLike,
    common_mode_rejection: ArrayLike,
    local_oscillator_power: ArrayLike,
    apd_gain: ArrayLike,
    responsivity: ArrayLike,
    electrical_bandwidth: ArrayLike,
    noise_variance: ArrayLike,
) -> Change:
    """Change by intensity noise: exact, a ratio of variances; the threshold is set on it.

    Parameters
    ----------
    noise_variance : array_like
        Current variance [A^2] of all other sources, before a heterodyne receiver's factor.
    relative_intensity_noise, common_mode_rejection, local_oscillator_power, apd_gain, \
responsivity, electrical_bandwidth
        Of :func:`current_variance`.
    """
    variance = current_variance(
        relative_intensity_noise=relative_intensity_noise,
        common_mode_rejection=common_mode_rejection,
        local_oscillator_power=local_oscillator_power,
        apd_gain=apd_gain,
        responsivity=responsivity,
        electrical_bandwidth=electrical_bandwidth,
    )
    return added_noise.change(least=variance, largest=variance, noise_variance=noise_variance)
