"""Leakage of echoes in developed speckle: the mean over its power, against direct means."""

import numpy as np
import pytest

from sweep.model import leakage
from sweep.model.detection import mark
from sweep.model.effects.catalogue import CORE, DEFAULTS
from sweep.model.marcum import marcum_q1
from sweep.model.segments import spectrum
from sweep.model.shot import evaluate, prepare

POWERS = (np.arange(40_000) + 0.5) * (20.0 / 40_000)


def mean_over_power(chance):
    """Mean over an exponential power of a probability as a function of it."""
    return float((chance(POWERS) * np.exp(-POWERS)).sum() * (POWERS[1] - POWERS[0]))


@pytest.mark.parametrize("level", [4.0, 6.5, 12.0])
@pytest.mark.parametrize("signals", [[0.3] * 50, [3.0], [0.5, 1.0, 2.0, 4.0, 8.0, 3.5], [20.0] * 9])
def test_the_mean_of_few_powers_is_that_of_all(signals, level):
    def chance(power):
        crossing = marcum_q1(np.sqrt(power)[:, None] * signals, np.array(level))
        quiet = np.exp(-(level**2) / 2)
        added = np.maximum(crossing.q - quiet, 0.0) / -np.expm1(-(level**2) / 2)
        return -np.expm1(np.log1p(-np.minimum(added, 1 - 1e-16)).sum(axis=1))

    few = np.minimum(chance(leakage.SPECKLE_POWERS), 1 - 1e-15)
    rates = np.log(np.maximum(-np.log1p(-few), leakage.FAINTEST_RATE))
    expected = mean_over_power(chance)
    if expected > 1e-5:
        assert leakage.fading_mean(rates) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("window", ["hamming", "rectangular", "hann"])
@pytest.mark.parametrize("every_bin", [False, True])
def test_leakage_of_a_grid_is_the_mean_over_speckle_of_all_bins(table_4_1, window, every_bin):
    """Bins that the mean echo leaves exempt stay so; the others cross with the faded echo."""
    effects = (*CORE, "fading")
    p = DEFAULTS | table_4_1(window=window, beamlets=1, fft_size=4096, radial_velocity=0.0)
    p |= {
        "target.range": np.array([150.3, 900.7, 2500.0]), "footprint.phases": "incoherent",
        "instrument.laser.power": 1.0, "accuracy.leakage_floor": 0.0 if every_bin else -1.0,
    }  # fmt: skip
    if every_bin:  # a padded FFT has each bin looked at
        p["instrument.processing.fft_size"] = 2**19
        p["target.range"] = np.array([150.3])
    told = evaluate(p, effects)["p_leakage_up"]
    ((_, shots),) = prepare(p, effects)
    for i in range(shots.size):
        bins, magnitude = spectrum(shots, i, 0)
        sigma, level = float(shots.bin_deviation[i]), float(shots.threshold[i])

        exempt = np.zeros(magnitude.size, bool)
        mark(magnitude, magnitude.size, level, exempt, shots.echo_rule.beside)
        signals = magnitude[~exempt & (bins > 0)] / sigma
        quiet = np.log(-np.expm1(-((level / sigma) ** 2) / 2))
        powers = np.linspace(0, 16, 321)[1:]
        stays = [
            np.log(marcum_q1(np.sqrt(u) * signals, np.array(level / sigma)).p).sum()
            - signals.size * quiet
            for u in powers
        ]
        expected = np.trapezoid(
            np.maximum(-np.expm1(np.array(stays)), 0.0) * np.exp(-powers), powers
        )
        if expected > 1e-7:
            assert told[i] == pytest.approx(expected, rel=0.05)
