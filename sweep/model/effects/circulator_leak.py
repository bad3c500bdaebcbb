"""Light that leaks from the transmitter to the detector, through circulator, splice or window.

A fraction 1 / I of the transmitted light P_tx (I is the isolation) reaches the detector over a path
d longer than the local oscillator's, with the delay tau = d / c. It is present in every record.
The detector has the gain M, the excess noise factor F, the responsivity Re and the electrical
bandwidth B_e. The elementary charge is q, eta the mixing efficiency, P_lo the power of the local
oscillator and S the chirp rate.

- **A line** (:mod:`sweep.model.spectrum.permanent_line`). It beats with the local oscillator as an
  echo does. Its photocurrent is i = 2 M Re sqrt(eta P_lo P_tx / I), at S tau in the chirps and at 0
  in the Doppler segment. Its phase drifts with the path's temperature.
- **Shot noise** 2 q M^2 F Re P_tx / I B_e.
- **Intensity noise**. A balanced receiver rejects the noise of the light, but not that of the
  beat. The variance is RIN B_e ((M Re)^2 (2 P_lo P_l + P_l^2) / CMRR + i^2 / 2). RIN is the laser's
  relative intensity noise, CMRR the common-mode rejection, and P_l = P_tx / I.
- **Phase noise** of a Lorentzian laser of width v. The beat carries theta(t) - theta(t - tau), of
  density 4 v sin^2(pi f tau) / (pi f^2), which is 4 pi v tau^2 for f << 1 / tau [1]_. The line
  turns this phase into noise, of i^2 / 2 times that density. The noise is assumed to be white
  within B_e, and at most 2 pi v tau in total.

The line begins at its own delay tau, as an echo does (:mod:`sweep.model.effects.overlap`): a path
of a metre takes 3 ns of a record that begins with the chirp. With overlap off the line fills the
record.

Three things are neglected: saturation of the ADC by the line, the line's image due to I/Q
imbalance, and bins that only the skirts of echo and line together raise. The spectrum of
:func:`sweep.model.spectrum.segment_spectra.segment_spectrum` is that of the echo alone.

References
----------
.. [1] Richter et al., IEEE J. Quantum Electron. 22, 2070, 1986.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.looks import LOOKS_NUMBER_PATH
from sweep.model.effects.effect import Effect, EffectContext, Parameter, add_noise_sources
from sweep.model.effects.error_bounds import ErrorBound
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.effects.requirements import ParameterRequirement, exceeds_one, is_positive
from sweep.model.link_budget import LASER_PREFIX, RECEIVER_PREFIX, TELESCOPE_PREFIX, beat_current
from sweep.model.preparation import Shots
from sweep.model.shot_records import PermanentLine
from sweep.model.waveform import SEARCH_RANGE_LIMIT_PATHS

LEAK_LENGTH_PATH, ISOLATION_PATH = TELESCOPE_PREFIX + "leak_path", TELESCOPE_PREFIX + "isolation"
"""Dotted paths of two parameters of the leaked light. The first is its optical path less that of
the local oscillator [m]. The second is the ratio of transmitted to leaked power."""


def _leaked_power_and_current(
    parameters: Mapping[str, np.ndarray], architecture: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the power of the leaked light [W] and the amplitude of its beat's photocurrent [A]."""
    power = np.asarray(parameters[LASER_PREFIX + "power"] / parameters[ISOLATION_PATH])
    return power, beat_current(architecture, parameters, power)


def leak_beat_current_variance(
    parameters: Mapping[str, np.ndarray],
    architecture: str,
    line_shape: str,
    electrical_bandwidth: np.ndarray,
) -> np.ndarray:
    """Compute the variance of the noise current from the beat of the leaked light.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path.
    architecture : str
        Receiver architecture; direct detection has no beat.
    line_shape : str
        Shape of the laser's line; only ``lorentzian`` has phase noise.
    electrical_bandwidth : ndarray
        Electrical bandwidth B_e of the receiver [Hz].

    Returns
    -------
    ndarray
        Variance [A^2], >= 0; 0 with direct detection.

    Notes
    -----
    The variance is the sum of intensity noise and phase noise, whose equations are in the module's
    description.
    """
    if architecture == "direct":
        return np.zeros(())
    leaked_power, beat_current = _leaked_power_and_current(parameters, architecture)
    responsivity = (
        parameters[RECEIVER_PREFIX + "apd_gain"] * parameters[RECEIVER_PREFIX + "responsivity"]
    )
    delay = parameters[LEAK_LENGTH_PATH] / SPEED_OF_LIGHT
    beat_power = np.square(beat_current / responsivity) / 2
    rejected_power = (
        2 * parameters[RECEIVER_PREFIX + "local_oscillator_power"] + leaked_power
    ) * leaked_power
    rejected_power = rejected_power / parameters[RECEIVER_PREFIX + "common_mode_rejection"]
    variance = (
        parameters[LASER_PREFIX + "relative_intensity_noise"]
        * electrical_bandwidth
        * (rejected_power + beat_power)
    )
    if line_shape == "lorentzian":
        phase_noise = (
            2
            * np.pi
            * parameters[LASER_PREFIX + "line_width"]
            * delay
            * np.minimum(2 * delay * electrical_bandwidth, 1.0)
        )
        variance = variance + beat_power * phase_noise
    return np.asarray(responsivity**2 * variance)


def error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return the relative noise variance of the leaked light, and a probability change of 1.

    The noise variance is exact, not a bound. The probability change of 1 keeps the effect, because
    the line of the leaked light may hide any echo. The result is None without leaked light.
    """
    if not points.any_nonzero(LEAK_LENGTH_PATH):
        return None
    parameters, receiver_noise = points.parameters, points.receiver_noise
    noise_variance = (
        _leaked_power_and_current(parameters, points.waveform.architecture)[0]
        * receiver_noise.shot_noise_variance_per_watt
    )
    line_shape = points.shared_option(LASER_PREFIX + "line_shape")
    noise_variance = (
        noise_variance
        + leak_beat_current_variance(
            parameters,
            points.waveform.architecture,
            line_shape,
            receiver_noise.electrical_bandwidth,
        )
        * receiver_noise.variance_per_square_ampere
    )
    return ErrorBound(
        noise_variance_change=noise_variance / points.noise.variance_without_echo,
        probability_change=1.0,
    )


def apply(shots: Shots, context: EffectContext) -> Shots:
    """Add the noise sources and the permanent line of the leaked light to shots.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Parameters of laser, telescope and receiver; the ground is not used
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the noise sources ``leak_shot`` and ``leak_excess`` [V^2], and with the line of
        the leaked light: its amplitude at the ADC [V], before the receiver's poles, and its delay
        [s].

    Notes
    -----
    The module's description has the equations of the line's amplitude and delay, and of its shot
    noise, intensity noise and phase noise. It also states what is neglected.
    """
    parameters = context.parameters
    power, beat_current = _leaked_power_and_current(parameters, shots.waveform.architecture)
    beat_noise = (
        leak_beat_current_variance(
            parameters,
            shots.waveform.architecture,
            str(parameters[LASER_PREFIX + "line_shape"]),
            shots.receiver_noise.electrical_bandwidth,
        )
        * shots.receiver_noise.variance_per_square_ampere
    )
    shots = add_noise_sources(
        shots,
        leak_shot=shots.receiver_noise.shot_noise_variance_per_watt * power,
        leak_excess=beat_noise,
    )
    return replace(
        shots,
        permanent_line=PermanentLine(
            amplitude=beat_current * parameters[RECEIVER_PREFIX + "transimpedance"],
            delay=parameters[LEAK_LENGTH_PATH] / SPEED_OF_LIGHT,
        ),
    )


CIRCULATOR_LEAK = Effect(
    name="circulator_leak",
    description="light that leaks to the detector: a line near DC, and its noise",
    stage="noise",
    error_bound=error_bound,
    apply=apply,
    is_in_time_domain_truth=False,
    parameters=(
        Parameter(
            path=LEAK_LENGTH_PATH,
            description="Optical path of the light that leaks past circulator and window "
            "(isolation) "
            "beyond the local oscillator's, in all; 0 for no such light. Its line stands at the "
            "range of half this path; bins in which it alone reaches the threshold are masked, and "
            "hide echoes",
            example="2 m",
            limits=("0 m", "1 km"),
            requirements=(
                ParameterRequirement(
                    ISOLATION_PATH,
                    lambda ratio: ratio >= 1e30,
                    "is that of light which leaks, and none does at an isolation of 300 dB",
                    "set instrument.telescope.isolation",
                ),
                ParameterRequirement(
                    LOOKS_NUMBER_PATH,
                    exceeds_one,
                    "is that of a line which is known in one record of each segment alone",
                    "take instrument.looks.number: 1",
                ),
                ParameterRequirement(
                    SEARCH_RANGE_LIMIT_PATHS[0],
                    is_positive,
                    "is that of a line which masks bins, and no law joins that with a search band",
                    "leave instrument.processing.search out",
                ),
            ),
        ),
    ),
)
"""Effect that adds the line and the noise of light that leaks from transmitter to detector."""
