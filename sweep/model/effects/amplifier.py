"""Spontaneous emission of an optical amplifier, which beats with the local oscillator.

An amplifier of gain G and inversion factor n_sp emits, besides the light that it amplifies,

    N = n_sp (G - 1) h nu                                                       [W/Hz]

into the mode of that light, in its polarisation [1]_. h nu is the photon energy. The amplifier's
noise figure is 2 n_sp (G - 1) / G + 1 / G. The part of the emission that reaches the detector beats
with the local oscillator's power P_lo.
This signal-spontaneous beat noise has the current variance

    4 (M Re)^2 P N' B_e                                                         [2]_, eq. 12

within the electrical bandwidth B_e, for light of power P and emission of density N' on both sides
of it. M is the detector's gain and Re its responsivity. The emission takes two paths:

- **With the transmitted light.** A circulator of isolation I, a window or a splice sends 1 / I of
  the transmitted light, and of its emission, onto the detector. P is the part eta P_lo that mixes,
  and N' = N / I. A balanced receiver sees this beat in full.
- **With the local oscillator**, if that is tapped behind the amplifier. Then N' = N P_lo / P_sent.
  On each diode the emission acts like a relative intensity noise of the local oscillator, of 4 N /
  P_sent. The common-mode rejection divides it.

Emission that returns with the echo is neglected: it is below the echo's own beat by P_sent / (2 N
B_e), some 60 dB before the FFT. The beat of emission with itself is neglected too; it is lower by N
B_e / P_lo. Direct detection has no local oscillator.

References
----------
.. [1] Desurvire, Erbium-Doped Fiber Amplifiers, 1994, ch. 2.
.. [2] Olsson, J. Lightwave Technol. 7, 1071, 1989.
"""

from collections.abc import Mapping

import numpy as np

from sweep.model.constants import PLANCK, SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, EffectContext, Parameter, add_noise_sources
from sweep.model.effects.error_bounds import ErrorBound
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.link_budget import LASER_PREFIX, RECEIVER_PREFIX, TELESCOPE_PREFIX
from sweep.model.preparation import Shots

_INVERSION_PATH, _GAIN_PATH = LASER_PREFIX + "spontaneous_emission", LASER_PREFIX + "amplifier_gain"
_AMPLIFIED_LIGHT_PATH, _ISOLATION_PATH = (
    LASER_PREFIX + "amplified_light",
    TELESCOPE_PREFIX + "isolation",
)
SENT_LIGHT, SENT_AND_OSCILLATOR_LIGHT = "sent", "sent and local oscillator"


def spontaneous_emission_density(parameters: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the power density of an amplifier's spontaneous emission in one polarisation [W/Hz].

    The density is n_sp (G - 1) h nu, with the inversion factor n_sp, the gain G and the photon
    energy h nu.

    >>> given = {_INVERSION_PATH: 1.0, _GAIN_PATH: 1001.0, LASER_PREFIX + "wavelength": 1550e-9}
    >>> f"{spontaneous_emission_density(given):.3g}"
    '1.28e-16'
    """
    photon_energy = PLANCK * SPEED_OF_LIGHT / parameters[LASER_PREFIX + "wavelength"]
    return np.asarray(photon_energy * parameters[_INVERSION_PATH] * (parameters[_GAIN_PATH] - 1))


def emission_beat_current_variance(
    parameters: Mapping[str, np.ndarray], amplified_light: str, electrical_bandwidth: np.ndarray
) -> np.ndarray:
    """Compute the current variance of the beat of the local oscillator with spontaneous emission.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path.
    amplified_light : str
        Light that passes the amplifier: `SENT_LIGHT` or `SENT_AND_OSCILLATOR_LIGHT`.
    electrical_bandwidth : ndarray
        Electrical bandwidth B_e of the receiver [Hz].

    Returns
    -------
    ndarray
        Variance [A^2], summed over the emission with the transmitted light and with the local
        oscillator (see the module's description).
    """
    oscillator_power = parameters[RECEIVER_PREFIX + "local_oscillator_power"]
    mixing_factor = parameters[RECEIVER_PREFIX + "mixing_efficiency"] / parameters[_ISOLATION_PATH]
    if amplified_light == SENT_AND_OSCILLATOR_LIGHT:
        rejected_power = (
            parameters[RECEIVER_PREFIX + "common_mode_rejection"]
            * parameters[LASER_PREFIX + "power"]
        )
        mixing_factor = mixing_factor + oscillator_power / rejected_power
    squared_responsivity = (
        parameters[RECEIVER_PREFIX + "apd_gain"] * parameters[RECEIVER_PREFIX + "responsivity"]
    ) ** 2
    beat_power_density = oscillator_power * (
        spontaneous_emission_density(parameters) * mixing_factor
    )
    return np.asarray(4 * squared_responsivity * beat_power_density * electrical_bandwidth)


def error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return the noise variance of spontaneous emission over that of the noise without an echo.

    The value is exact, not a bound. The threshold is set on the noise with the emission. The result
    is None for direct detection or without spontaneous emission.
    """
    if points.waveform.architecture == "direct" or not points.any_nonzero(_INVERSION_PATH):
        return None
    current_variance = emission_beat_current_variance(
        points.parameters,
        points.shared_option(_AMPLIFIED_LIGHT_PATH),
        points.receiver_noise.electrical_bandwidth,
    )
    return ErrorBound(
        noise_variance_change=current_variance
        * points.receiver_noise.variance_per_square_ampere
        / points.noise.variance_without_echo
    )


def apply(shots: Shots, context: EffectContext) -> Shots:
    """Add the beat noise of spontaneous emission; direct detection has none.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Parameters of amplifier, laser and receiver; the ground is not used
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the noise source ``spontaneous_emission`` [V^2], or unchanged with direct
        detection.

    Notes
    -----
    The current variance [A^2] is that of :func:`emission_beat_current_variance`. The noise
    variance at the ADC is this variance times a factor [V^2/A^2] of the receiver.
    """
    if shots.waveform.architecture == "direct":
        return shots
    current_variance = emission_beat_current_variance(
        context.parameters,
        str(context.parameters[_AMPLIFIED_LIGHT_PATH]),
        shots.receiver_noise.electrical_bandwidth,
    )
    return add_noise_sources(
        shots,
        spontaneous_emission=current_variance * shots.receiver_noise.variance_per_square_ampere,
    )


SPONTANEOUS_EMISSION = Effect(
    name="spontaneous_emission",
    description="light that an optical amplifier adds",
    stage="noise",
    error_bound=error_bound,
    apply=apply,
    parameters=(
        Parameter(
            path=_INVERSION_PATH,
            description="Inversion factor n_sp of an optical amplifier of the laser, half its "
            "noise "
            "figure at high gain; 0 for no amplifier",
            example="1.6",
            limits=("0", "1000"),
        ),
        Parameter(
            path=_GAIN_PATH,
            description="Gain of that amplifier",
            default=1000.0,
            example="30 dB",
            limits=("0 dB", "100 dB"),
        ),
        Parameter(
            path=_AMPLIFIED_LIGHT_PATH,
            description="Light that the amplifier raises: what is sent, or the local oscillator "
            "too",
            default=SENT_LIGHT,
            options=(SENT_LIGHT, SENT_AND_OSCILLATOR_LIGHT),
        ),
        Parameter(
            path=_ISOLATION_PATH,
            description="Isolation of the detector from the light sent, by circulator and window; "
            "the "
            "amplifier's emission passes it, and with leak_path the light itself",
            default=1e30,
            example="50 dB",
            limits=("0 dB", "300 dB"),
        ),
    ),
)
"""Effect that adds the beat noise of an optical amplifier's spontaneous emission."""
