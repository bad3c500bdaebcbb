"""CFAR detectors: factors by other routes, false alarms and detections in noise, losses."""

import math

import numpy as np
import pytest
from scipy import integrate, stats
from scipy.optimize import brentq

from sweep.model.detection.detectors import (
    CA_CFAR,
    DETECTORS,
    GOCA_CFAR,
    OS_CFAR,
    SpectrumSettings,
    cached_window_samples,
    cfar_crossing_probability,
    cfar_factor,
)
from sweep.model.window import get_window

TRAINING, RANK = 24, 18


def setting(**changes):
    settings = {
        "fft_size": 512, "sample_rate": 1.0, "window": get_window("rectangular", 512),
        "noise_power": 1.0, "threshold": 2.0, "training": TRAINING, "guard": 2, "rank": RANK,
        "pfa": 1e-2,
    }  # fmt: skip
    return SpectrumSettings(**settings | changes)


def by_integral(kind, factor):
    """Mean of exp(-factor level) over the level's own density, for training cells of mean 1."""
    half = TRAINING // 2
    density = {
        CA_CFAR: lambda x: stats.gamma.pdf(x, TRAINING, scale=1 / TRAINING),
        OS_CFAR: lambda x: (
            RANK * math.comb(TRAINING, RANK) * np.exp(-x * (TRAINING - RANK + 1))
            * (1 - np.exp(-x)) ** (RANK - 1)
        ),
        GOCA_CFAR: lambda x: (
            2 * stats.gamma.pdf(x, half, scale=1 / half) * stats.gamma.cdf(x, half, scale=1 / half)
        ),
    }[kind]  # fmt: skip
    return integrate.quad(lambda x: np.exp(-factor * x) * density(x), 0, 30, epsabs=0, limit=500)[0]


@pytest.mark.parametrize("kind", [CA_CFAR, OS_CFAR, GOCA_CFAR])
@pytest.mark.parametrize("pfa", [0.3, 1e-3, 1e-6, 1e-9])
def test_factors_give_the_design_probability_by_an_integral_over_the_level(kind, pfa):
    factor = cfar_factor(kind, training=TRAINING, rank=RANK, pfa=pfa)
    assert by_integral(kind, factor) == pytest.approx(pfa, rel=1e-6)
    probability = cfar_crossing_probability(kind, factor, training=TRAINING, rank=RANK)
    assert probability == pytest.approx(pfa, rel=1e-9)


def test_a_factor_in_print():
    """N = 24, 1e-6: 24 (10^(6/24) - 1) = 18.679 [Gandhi and Kassam 1988, (7)]."""
    assert cfar_factor(CA_CFAR, training=24, rank=1, pfa=1e-6) == pytest.approx(18.679, abs=5e-4)


@pytest.mark.parametrize("kind", [CA_CFAR, OS_CFAR, GOCA_CFAR])
def test_flags_are_those_of_each_bin_by_itself(kind):
    """Cells picked and sorted bin by bin in numpy, wrapped around between DC and Nyquist."""
    s, power = setting(), np.random.default_rng(1).exponential(size=(3, 257))
    factor, inner = cfar_factor(kind, training=TRAINING, rank=RANK, pfa=s.pfa), power[:, 1:-1]
    expected = np.zeros(power.shape, bool)
    for k in range(inner.shape[1]):
        distances = np.arange(s.guard + 1, s.guard + TRAINING // 2 + 1)
        below, above = (inner.take(k + sign * distances, axis=1, mode="wrap") for sign in (-1, 1))
        cells = np.concatenate([below, above], axis=1)
        level = {
            CA_CFAR: cells.mean(axis=1),
            OS_CFAR: np.sort(cells, axis=1)[:, RANK - 1],
            GOCA_CFAR: np.maximum(below.mean(axis=1), above.mean(axis=1)),
        }[kind]
        expected[:, k + 1] = inner[:, k] > factor * level
    assert 0 < expected.sum() < 40
    np.testing.assert_array_equal(DETECTORS[kind](power, s), expected)


def rate(kind, name, fft_size, rows, pfa=1e-2):
    """Share of bins of windowed white noise that a detector flags, and its standard error."""
    w = get_window(name, 512)
    noise = np.random.default_rng(7).standard_normal((rows, 512)) * cached_window_samples(w)
    power = np.abs(np.fft.rfft(noise, fft_size)) ** 2
    flags = DETECTORS[kind](power, setting(fft_size=fft_size, window=w, pfa=pfa))[:, 1:-1]
    shares = flags.mean(axis=1)
    return shares.mean(), shares.std() / np.sqrt(rows)


@pytest.mark.parametrize("kind", [CA_CFAR, OS_CFAR, GOCA_CFAR])
def test_false_alarms_of_independent_bins_come_at_the_design_rate(kind):
    """Untapered records of white noise; 5 standard errors of 8000 spectra are some 4 %."""
    alarm_rate, error = rate(kind, "rectangular", 512, 8000)
    assert 5 * error < 0.05 * 1e-2
    assert abs(alarm_rate - 1e-2) < 5 * error


@pytest.mark.parametrize("kind", [CA_CFAR, OS_CFAR, GOCA_CFAR])
def test_a_fluctuating_signal_is_detected_as_often_as_it_should(kind):
    """Swerling 1 in one bin of independent ones: noise made larger by 1 + snr."""
    rows, snr, s = 40_000, 30.0, setting(fft_size=64, pfa=1e-3)
    power = np.random.default_rng(3).exponential(size=(rows, 33))
    power[:, 16] *= 1 + snr
    pd = DETECTORS[kind](power, s)[:, 16].mean()
    factor = cfar_factor(kind, training=TRAINING, rank=RANK, pfa=s.pfa)
    expected = cfar_crossing_probability(kind, factor / (1 + snr), training=TRAINING, rank=RANK)
    assert 0.5 < expected < 0.9
    assert abs(pd - expected) < 5 * np.sqrt(expected * (1 - expected) / rows)


def loss(kind, training, rank, pfa=1e-6, pd=0.5):
    """SNR that a detector needs over that of a known noise level [dB], Swerling 1."""
    factor = cfar_factor(kind, training=training, rank=rank, pfa=pfa)

    def short(snr):
        detection_probability = cfar_crossing_probability(
            kind, factor / (1 + snr), training=training, rank=rank
        )
        return detection_probability - pd

    return 10 * np.log10(brentq(short, 1, 1e6) / (np.log(pfa) / np.log(pd) - 1))


def test_losses_are_those_in_print():
    """Nitzberg [IEEE Trans. AES 14, 44, 1978]: SNR (r - 1) / (1 - pd^(1/M)), r = (pd / pfa)^(1/M),
    by which twice the cells halve the loss in dB. Richards [2014, section 6.5.6]: ordered
    statistics lose typically 0.3 to 0.5 dB more than cell averaging; of 32 cells here. Hansen and
    Sawyers [IEEE Trans. AES 16, 115, 1980]: the greatest of two halves, 0.1 to 0.3 dB more.
    """
    pd, pfa = 0.5, 1e-6
    for cells in (12, 24, 48):
        needed = ((pd / pfa) ** (1 / cells) - 1) / (1 - pd ** (1 / cells))
        known = np.log(pfa) / np.log(pd) - 1
        assert loss(CA_CFAR, cells, 1) == pytest.approx(10 * np.log10(needed / known), abs=1e-9)
    assert loss(CA_CFAR, 24, 1) / loss(CA_CFAR, 48, 1) == pytest.approx(2.0, abs=0.1)
    assert 0.3 < loss(OS_CFAR, 32, 24) - loss(CA_CFAR, 32, 1) < 0.5
    assert 0.1 < loss(GOCA_CFAR, 32, 1) - loss(CA_CFAR, 32, 1) < 0.3
