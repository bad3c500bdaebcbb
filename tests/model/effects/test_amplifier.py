"""An amplifier's spontaneous emission: on two diodes, field by field, and through a whole shot."""

import numpy as np
import pytest
from random_planner_points import planner_inputs

from sweep.model import evaluation
from sweep.model.effects.amplifier import (
    SENT_AND_OSCILLATOR_LIGHT,
    emission_beat_current_variance,
    error_bound,
    spontaneous_emission_density,
)
from sweep.model.effects.catalogue import DEFAULT_EFFECTS

RATE, NUMBER = 600e6, 2**18
GAIN, RESPONSIVITY, OSCILLATOR = 3.0, 1.1, 1e-3
DENSITY = 1e-15
"""Of emission on the detector [W/Hz]; as much as its light within 600 MHz is 1/1700 of that."""


def _emission():
    """Field of white emission over the sample rate [sqrt W], complex."""
    parts = np.random.default_rng(2).standard_normal((2, NUMBER))
    return np.sqrt(DENSITY * RATE / 2) * (parts[0] + 1j * parts[1])


LIGHT = {"instrument.laser.wavelength": 1550e-9, "instrument.laser.spontaneous_emission": 1.6}


def _variance():
    """By an amplifier of which so much passes an isolation."""
    receiver = {
        "local_oscillator_power": OSCILLATOR, "mixing_efficiency": 1.0, "apd_gain": GAIN,
        "responsivity": RESPONSIVITY,
    }  # fmt: skip
    parameters = {f"instrument.receiver.{name}": value for name, value in receiver.items()}
    parameters |= LIGHT | {"instrument.laser.amplifier_gain": 1000.0}
    isolation = {
        "instrument.telescope.isolation": spontaneous_emission_density(parameters) / DENSITY
    }
    return emission_beat_current_variance(parameters | isolation, "sent", RATE / 2)


def test_emission_beats_with_the_local_oscillator_on_both_diodes_of_a_receiver():
    """A coupler halves both fields, one turned by half a cycle; the diodes' currents subtract."""
    field, oscillator_field = _emission(), np.sqrt(OSCILLATOR)
    one, other = (np.abs(oscillator_field + sign * field) ** 2 / 2 for sign in (1, -1))
    current = GAIN * RESPONSIVITY * (one - other)
    assert current.var() == pytest.approx(_variance(), rel=5 * np.sqrt(2 / NUMBER))


def test_emission_that_comes_with_the_local_oscillator_is_rejected_as_its_fluctuations_are():
    """Diodes of the gains 1 and 0.8: a rejection of (1.8 / 0.2)^2 against one of the mean gain."""
    light = np.abs(np.sqrt(OSCILLATOR) + _emission()) ** 2
    current = GAIN * RESPONSIVITY / 0.9 * (1.0 * light / 2 - 0.8 * light / 2)
    # emission with itself adds N B / P_lo of the beat, 3e-4, which is left out
    expected = _variance() / 81
    assert current.var() == pytest.approx(expected, rel=5 * np.sqrt(2 / NUMBER) + 6e-4)


@pytest.mark.parametrize("amplified", ["sent", SENT_AND_OSCILLATOR_LIGHT])
def test_a_shot_has_as_much_noise_more_as_the_law_says_of_its_receiver(table_4_1, amplified):
    """By hand: h nu = 1.2816e-19 J; a diode's shot noise 2 q Re P_lo B_e, of which the beat is
    2 Re N / q; the rest of the receiver's noise is known from what the shot has without."""
    inversion, gain, isolation, rejection = 1.6, 1000.0, 1e4, 1e3
    parameters = table_4_1(fft_size=2**13, range=300.0) | {
        "instrument.laser.spontaneous_emission": inversion,
        "instrument.laser.amplifier_gain": gain,
        "instrument.laser.amplified_light": amplified,
        "instrument.telescope.isolation": isolation,
        "instrument.receiver.common_mode_rejection": rejection,
    }
    density = 6.62607015e-34 * 299792458.0 / 1550e-9 * inversion * (gain - 1)
    assert spontaneous_emission_density(
        LIGHT | {"instrument.laser.amplifier_gain": gain}
    ) == pytest.approx(density)
    on_detector = density / isolation  # and 1 mW of the local oscillator, of 1 W sent
    on_detector += (
        density * 1e-3 / 1.0 / rejection if amplified == SENT_AND_OSCILLATOR_LIGHT else 0.0
    )
    (_, bare), (_, noisy) = (
        next(evaluation.prepare_shots(parameters, effects))
        for effects in (DEFAULT_EFFECTS, (*DEFAULT_EFFECTS, "spontaneous_emission"))
    )
    own_shot = bare.noise.variances["local_oscillator_shot"]
    added_variance = noisy.noise.variances["spontaneous_emission"]
    assert added_variance / own_shot == pytest.approx(
        2 * 1.1 * on_detector / 1.602176634e-19, rel=1e-9
    )
    assert noisy.noise_variance_without_echo == pytest.approx(
        bare.noise_variance_without_echo + added_variance
    )
    size = error_bound(planner_inputs(parameters))
    assert size.noise_variance_change == pytest.approx(added_variance / sum(
        value for name, value in bare.noise.variances.items() if name != "signal_shot"
    ))  # fmt: skip
    assert size.threshold_follows_noise
    snrs = [
        evaluation.evaluate(parameters, e)["snr_up"]
        for e in (DEFAULT_EFFECTS, (*DEFAULT_EFFECTS, "spontaneous_emission"))
    ]
    assert snrs[0] / snrs[1] == pytest.approx(noisy.noise_variance / bare.noise_variance)


def test_nothing_is_there_without_an_amplifier_or_a_local_oscillator(table_4_1):
    assert error_bound(planner_inputs(table_4_1())) is None
    amplified = {"instrument.laser.spontaneous_emission": 1.6}
    assert error_bound(planner_inputs(table_4_1(architecture="direct") | amplified)) is None
