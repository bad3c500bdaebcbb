"""Relative intensity noise: the local oscillator's power fluctuates by itself.

A laser's relative intensity noise RIN [1/Hz] is the one-sided spectral density of dP/P. Detected
by one diode it makes the current variance (M Re P_lo)^2 RIN B_e. The two diodes of a balanced
receiver see the same fluctuation and subtract it, all but their mismatch: the common-mode
rejection, a ratio of powers (in dB 20 log10 of the ratio of the currents), divides the variance.
Both are taken to be flat over the electrical bandwidth, so the noise is white like the rest.

RIN of the echo is left out: it is below that of the local oscillator by P/P_lo. At
RIN = 2 q / (Re P_lo), -155 dB/Hz for a milliampere, one diode sees as much of it as shot noise.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from sweep.model import receiver
from sweep.model.effects.effect import Effect, Parameter, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.preparation import Shots


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
        As for :func:`sweep.model.noise.shot_noise`.
    """
    current = (
        np.asarray(apd_gain, float)
        * np.asarray(responsivity, float)
        * np.asarray(local_oscillator_power, float)
    )
    seen = np.asarray(relative_intensity_noise, float) / np.asarray(common_mode_rejection, float)
    return current**2 * seen * np.asarray(electrical_bandwidth, float)


_RIN = "instrument.laser.relative_intensity_noise"
_REJECTION = "instrument.receiver.common_mode_rejection"


def size(points: Points) -> Size | None:
    """Intensity noise: exact, a ratio of variances; the threshold is set on it."""
    if points.architecture == "direct" or not points.has(_RIN):
        return None
    current = _current(points.numbers)
    return Size(noise=current * points.receiver.per_ampere / points.noise_variance)


def _current(p: Mapping[str, np.ndarray]) -> np.ndarray:
    """Current variance of points by their parameters [A^2]."""
    own = {
        name: p["instrument.receiver." + name]
        for name in ("local_oscillator_power", "apd_gain", "responsivity")
    }
    return current_variance(
        relative_intensity_noise=p[_RIN],
        common_mode_rejection=p[_REJECTION],
        electrical_bandwidth=receiver.electrical_bandwidth(
            detector_bandwidth=p["instrument.receiver.detector_bandwidth"],
            amplifier_bandwidth=p["instrument.receiver.amplifier_bandwidth"],
        ),
        **own,
    )


def act(shots: Shots, scene: Scene) -> Shots:
    """Intensity noise of the local oscillator; direct detection has none."""
    if shots.architecture == "direct":
        return shots
    current = _current(scene.parameters)
    noise = {"relative_intensity": current * shots.noise_scale}
    return replace(shots, noise_sources=shots.noise_sources | noise)


EFFECT = Effect(
    name="relative_intensity_noise",
    about="fluctuation of the local oscillator's power",
    stage="noise",
    size=size,
    act=act,
    parameters=(
        Parameter(
            path=_RIN,
            about="One-sided spectral density of the laser's relative intensity",
            si_unit="1/Hz",
            default=0.0,
            example="-155 dB/Hz",
            at_least="0 1/Hz",
            at_most="100 1/Hz",
        ),
        Parameter(
            path=_REJECTION,
            about="Common-mode rejection of a balanced receiver; 0 dB for a single diode",
            si_unit="dB",
            default=1.0,
            example="25 dB",
            at_least="0 dB",
            at_most="300 dB",
        ),
    ),
)
