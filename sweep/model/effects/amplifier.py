"""Spontaneous emission of an optical amplifier, which beats with the local oscillator.

An amplifier of gain G and inversion factor n_sp emits, besides the light that it amplifies,

    N = n_sp (G - 1) h nu                                                       [W/Hz]

into the mode of that light, in its polarisation [Desurvire, Erbium-Doped Fiber Amplifiers, 1994,
ch. 2; its noise figure is 2 n_sp (G - 1) / G + 1 / G]. The part of it that reaches the detector
beats with the local oscillator's power P_lo: a signal-spontaneous beat noise, of current variance

    4 (M Re)^2 P N' B_e                     [Olsson, J. Lightwave Technol. 7, 1071, 1989, eq. 12]

within the electrical bandwidth B_e, for light P and a density N' that has twice that bandwidth on
either side of it. Two ways lead there:

- **With what is sent.** A circulator of the isolation I, a window or a splice puts 1 / I of the
  sent light, and of the emission with it, onto the detector. P is the part eta P_lo that mixes, and
  N' = N / I. A balanced receiver sees the beat in full.
- **With the local oscillator**, where that is tapped behind the amplifier. Emission and light go
  with each other, N' = N P_lo / P_sent, and beat on each diode as a fluctuation of the local
  oscillator does, of a relative intensity noise of 4 N / P_sent. The common-mode rejection divides
  it.

Emission that comes back with the echo is left out: it is below the echo's own beat by P_sent / (2 N
B_e), some 60 dB before the FFT. The beat of emission with itself is left out too, below these by N
B_e / P_lo. Direct detection has no local oscillator.
"""

from collections.abc import Mapping

import numpy as np

from sweep.model import link
from sweep.model.constants import PLANCK, SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, Parameter, Scene, Size, noisier
from sweep.model.effects.points import Points
from sweep.model.preparation import LASER, RECEIVER, TELESCOPE, Shots

_INVERSION, _GAIN = LASER + "spontaneous_emission", LASER + "amplifier_gain"
_AMPLIFIED, _ISOLATION = LASER + "amplified_light", TELESCOPE + "isolation"
SENT, BOTH = "sent", "sent and local oscillator"


def emission(p: Mapping[str, np.ndarray]) -> np.ndarray:
    """Density n_sp (G - 1) h nu [W/Hz] of spontaneous emission, in one polarisation.

    >>> given = {_INVERSION: 1.0, _GAIN: 1001.0, LASER + "wavelength": 1550e-9}
    >>> f"{emission(given):.3g}"
    '1.28e-16'
    """
    energy = PLANCK * SPEED_OF_LIGHT / p[LASER + "wavelength"]
    return np.asarray(energy * p[_INVERSION] * (p[_GAIN] - 1))


def current_variance(p: Mapping[str, np.ndarray], amplified: str) -> np.ndarray:
    """Return the current variance 4 (M Re)^2 P N B_e [A^2] of light that beats with emission."""
    oscillator = p[RECEIVER + "local_oscillator_power"]
    mixed = p[RECEIVER + "mixing_efficiency"] / p[_ISOLATION]
    if amplified == BOTH:
        rejected = p[RECEIVER + "common_mode_rejection"] * p[LASER + "power"]
        mixed = mixed + oscillator / rejected
    scale = (p[RECEIVER + "apd_gain"] * p[RECEIVER + "responsivity"]) ** 2
    light = oscillator * (emission(p) * mixed)
    bandwidth = link.electrical_bandwidth(link.receiver_values(p))
    return np.asarray(4 * scale * light * bandwidth)


def emission_size(points: Points) -> Size | None:
    """Return the beat noise, exactly; the threshold is set on it."""
    if points.architecture == "direct" or not points.has(_INVERSION):
        return None
    current = current_variance(points.parameters, points.word(_AMPLIFIED))
    return Size(noise=current * points.receiver.per_ampere / points.noise_variance)


def add_emission(shots: Shots, scene: Scene) -> Shots:
    """Beat noise of spontaneous emission; direct detection has none."""
    if shots.architecture == "direct":
        return shots
    current = current_variance(scene.parameters, str(scene.parameters[_AMPLIFIED]))
    return noisier(shots, spontaneous_emission=current * shots.noise_scale)


SPONTANEOUS_EMISSION = Effect(
    name="spontaneous_emission",
    about="light that an optical amplifier adds",
    stage="noise",
    size=emission_size,
    act=add_emission,
    parameters=(
        Parameter(
            path=_INVERSION,
            about="Inversion factor n_sp of an optical amplifier of the laser, half its noise "
            "figure at high gain; 0 for no amplifier",
            example="1.6",
            limits=("0", "1000"),
        ),
        Parameter(
            path=_GAIN,
            about="Gain of that amplifier",
            default=1000.0,
            example="30 dB",
            limits=("0 dB", "100 dB"),
        ),
        Parameter(
            path=_AMPLIFIED,
            about="Light that the amplifier raises: what is sent, or the local oscillator too",
            default=SENT,
            options=(SENT, BOTH),
        ),
        Parameter(
            path=_ISOLATION,
            about="Isolation of the detector from the light sent, by circulator and window; the "
            "amplifier's emission passes it, and with leak_path the light itself",
            default=1e30,
            example="50 dB",
            limits=("0 dB", "300 dB"),
        ),
    ),
)
