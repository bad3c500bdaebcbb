"""Relative intensity noise: the local oscillator's power fluctuates by itself.

A laser's relative intensity noise RIN [1/Hz] is the one-sided spectral density of dP/P. Detected
by one diode it makes the current variance (M Re P_lo)^2 RIN B_e. The two diodes of a balanced
receiver see the same fluctuation and subtract it, all but their mismatch: the common-mode
rejection, a ratio of powers (in dB 20 log10 of the ratio of the currents), divides the variance.
Both are taken to be flat over the electrical bandwidth, so the noise is white like the rest.

RIN of the echo is left out: it is below that of the local oscillator by P/P_lo. At
RIN = 2 q / (Re P_lo), -155 dB/Hz for a milliampere, one diode sees as much of it as shot noise.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sweep.model import receiver
from sweep.model.effects.change import Change, added_noise
from sweep.model.effects.effect import Effect, Parameter, Scene
from sweep.model.effects.span import monotone
from sweep.model.preparation import Shots

if TYPE_CHECKING:
    from sweep.model.effects.block import Block


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


def bound(block: "Block") -> Change | None:
    """Change by intensity noise: exact, a ratio of variances; the threshold is set on it."""
    if block.architecture == "direct" or not block.has(_RIN):
        return None
    current = monotone(
        current_variance,
        falling=("common_mode_rejection",),
        relative_intensity_noise=block[_RIN],
        common_mode_rejection=block[_REJECTION],
        electrical_bandwidth=block.electrical_bandwidth,
        **{
            name: block["instrument.receiver." + name]
            for name in ("local_oscillator_power", "apd_gain", "responsivity")
        },
    )
    variance = current * block.noise_scale
    return added_noise(
        least=variance.low, largest=variance.high, noise_variance=block.noise_variance
    )


_RIN = "instrument.laser.relative_intensity_noise"
_REJECTION = "instrument.receiver.common_mode_rejection"


def act(shots: Shots, scene: Scene) -> Shots:
    """Intensity noise of the local oscillator; direct detection has none."""
    if shots.architecture == "direct":
        return shots
    p = scene.parameters
    current = current_variance(
        relative_intensity_noise=p[_RIN],
        common_mode_rejection=p[_REJECTION],
        electrical_bandwidth=receiver.electrical_bandwidth(
            detector_bandwidth=shots.detector_bandwidth,
            amplifier_bandwidth=shots.amplifier_bandwidth,
        ),
        **{
            name: p["instrument.receiver." + name]
            for name in ("local_oscillator_power", "apd_gain", "responsivity")
        },
    )
    noise = {"relative_intensity": current * shots.noise_scale}
    return replace(shots, noise_sources=shots.noise_sources | noise)


EFFECT = Effect(
    name="relative_intensity_noise",
    about="fluctuation of the local oscillator's power",
    stage="noise",
    bound=bound,
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
