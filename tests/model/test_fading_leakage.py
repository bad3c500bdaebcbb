"""Leakage of echoes in developed speckle: the mean over its power, against direct means."""

import numpy as np
import pytest
from drawn_leakage import drawn_leakage

from sweep.model.detection.added_crossings import (
    any_crossing_probability,
    exclude_crossings_joining_echo,
)
from sweep.model.detection.echo_detection import mark_exempt_bins
from sweep.model.detection.marcum import marcum_q1
from sweep.model.detection.sub_bin_interpolation import sidelobe_neighbour_noise_correlation
from sweep.model.effects.catalogue import DEFAULT_EFFECTS, PARAMETER_DEFAULTS
from sweep.model.evaluation import evaluate, prepare_shots
from sweep.model.spectrum import leakage
from sweep.model.spectrum.segment_spectra import segment_spectrum

POWERS = (np.arange(40_000) + 0.5) * (20.0 / 40_000)


def mean_over_power(chance):
    """Mean over an exponential power of a probability as a function of it."""
    return float((chance(POWERS) * np.exp(-POWERS)).sum() * (POWERS[1] - POWERS[0]))


@pytest.mark.parametrize("level", [4.0, 6.5, 12.0])
@pytest.mark.parametrize("signals", [[0.3] * 50, [3.0], [0.5, 1.0, 2.0, 4.0, 8.0, 3.5], [20.0] * 9])
@pytest.mark.parametrize("per_octave", [1, 2])
def test_the_mean_of_few_powers_is_that_of_all(signals, level, per_octave):
    def chance(power):
        crossing = marcum_q1(np.sqrt(power)[:, None] * signals, np.array(level))
        quiet = np.exp(-(level**2) / 2)
        added = np.maximum(crossing.q - quiet, 0.0) / -np.expm1(-(level**2) / 2)
        return -np.expm1(np.log1p(-np.minimum(added, 1 - 1e-16)).sum(axis=1))

    number = per_octave * leakage.N_SPECKLE_OCTAVES + 1
    few = chance(leakage.SPECKLE_POWER_MAX * 2.0 ** (-np.arange(number) / per_octave))
    few = np.minimum(few, 1 - 1e-15)
    rates = np.log(np.maximum(-np.log1p(-few), leakage.LEAKAGE_RATE_MIN))
    expected = mean_over_power(chance)
    if expected > 1e-5:
        assert leakage.mean_leakage_from_log_rates(rates, per_octave) == pytest.approx(
            expected, rel=0.02
        )


@pytest.mark.parametrize("window", ["hamming", "rectangular", "hann"])
@pytest.mark.parametrize("every_bin", [False, True])
def test_leakage_of_a_grid_is_the_mean_over_speckle_of_all_bins(table_4_1, window, every_bin):
    """Bins that the mean echo leaves exempt stay so; the others cross with the faded echo.

    Runs that join the echo are none of them (drawn spectra hold that).
    """
    effects = (*DEFAULT_EFFECTS, "fading")
    p = PARAMETER_DEFAULTS | table_4_1(
        window=window, beamlets=1, fft_size=4096, radial_velocity=0.0
    )
    p |= {
        "target.range": np.array([150.3, 900.7, 2500.0]), "footprint.phases": "incoherent",
        "instrument.laser.power": 1.0, "accuracy.leakage_floor": 0.0 if every_bin else -1.0,
    }  # fmt: skip
    if every_bin:  # a padded FFT has each bin looked at
        p["instrument.processing.fft_size"] = 2**19
        p["target.range"] = np.array([150.3])
    grid_leakage = evaluate(p, effects)["p_leakage_up"]
    ((_, shots),) = prepare_shots(p, effects)
    for i in range(shots.size):
        bins, magnitude = segment_spectrum(shots, i, 0)
        sigma, level = float(shots.bin_noise_sigma[i]), float(shots.threshold[i])

        exempt = np.zeros(magnitude.size, bool)
        mark_exempt_bins(
            magnitude, magnitude.size, level, exempt, shots.detection_rule.lobe_half_width
        )
        counts = ~exempt & (bins > 0)
        quiet = -np.expm1(-((level / sigma) ** 2) / 2)
        powers, raised = np.linspace(0, 16, 321)[1:], []
        near = sidelobe_neighbour_noise_correlation(shots.window, shots.fft_size)
        for u in powers:
            stays = marcum_q1(np.sqrt(u) * magnitude / sigma, np.array(level / sigma)).p / quiet
            chances = np.where(counts, np.maximum(1.0 - stays, 0.0), 0.0)
            noise, threshold = sigma / np.sqrt(u), level / np.sqrt(u)
            exclude_crossings_joining_echo(
                chances, 0, chances.size, magnitude, exempt, noise, threshold, near
            )
            raised.append(any_crossing_probability(chances, 0, chances.size))
        expected = np.trapezoid(np.array(raised) * np.exp(-powers), powers)
        if expected > 1e-7:
            assert grid_leakage[i] == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("fades", [False, True])
@pytest.mark.parametrize(
    ("window", "power"), [("rectangular", 1.0), ("hann", 60.0), ("hamming", 60.0)]
)
def test_leakage_is_that_of_further_groups_in_drawn_spectra(table_4_1, window, power, fades):
    p = PARAMETER_DEFAULTS | table_4_1(
        window=window, beamlets=1, fft_size=1024, radial_velocity=0.0, tnr=6.5
    )
    p |= {
        "target.range": np.array([300.0, 700.0]), "footprint.phases": "incoherent",
        "instrument.laser.power": power, "accuracy.leakage_floor": 0.0,
        "instrument.receiver.noise_shape": "white",
    }  # fmt: skip
    effects = (*DEFAULT_EFFECTS, "fading") if fades else DEFAULT_EFFECTS
    expected = evaluate(p, effects)["p_leakage_up"]
    ((_, shots),) = prepare_shots(p, effects)
    for i in range(shots.size):
        drawn, deviation = drawn_leakage(shots, i, draws=4000, fades=fades)
        assert expected[i] == pytest.approx(drawn, abs=4 * deviation + 0.1 * drawn)
