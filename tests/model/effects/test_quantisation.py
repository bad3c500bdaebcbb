"""Rounding: against records quantised sample by sample."""

import numpy as np
import pytest
from adc import truth_quantise

from sweep.model.effects.noise_sources import step, variance


def test_levels_fill_the_full_scale_and_hold_at_its_ends():
    ramp = np.linspace(-1.5, 1.5, 3001)
    out = truth_quantise(ramp, full_scale=1.0, bits=3)
    assert np.array_equal(np.unique(out), np.arange(-7, 8, 2) / 8)
    inside = abs(ramp) < 1
    assert step(full_scale=1.0, bits=3) == 0.25
    assert abs(out - ramp)[inside].max() <= 0.125 + 1e-12


@pytest.mark.parametrize("bits", range(4, 15))
def test_rounding_a_tone_with_noise_of_a_step_adds_white_noise(bits):
    """2^17 samples; a mean over M independent bins strays by 1/sqrt(M) of itself, 5 sigma."""
    number, rng = 2**17, np.random.default_rng(bits)
    lsb = float(step(full_scale=1.0, bits=bits))
    noise = lsb * rng.standard_normal(number)
    tone = min(0.7, 1 - 6 * lsb) * np.cos(2 * np.pi * 17321 * np.arange(number) / number + 0.3)
    record = truth_quantise(tone + noise, full_scale=1.0, bits=bits)
    error = abs(np.fft.rfft(record - tone - noise)[1:-1]) ** 2 / number
    white = float(variance(step=lsb))
    assert error.mean() / white == pytest.approx(1, abs=5 / np.sqrt(error.size))
    for band in np.array_split(error, 8):
        assert band.mean() / white == pytest.approx(1, abs=5 / np.sqrt(band.size))
    heard = abs(np.fft.rfft(record - tone)[1:-1]) ** 2 / number
    assert heard.mean() / (lsb**2 + white) == pytest.approx(1, abs=5 / np.sqrt(heard.size))
