"""Rounding and clipping: against records quantised sample by sample."""

import numpy as np
import pytest
from scipy.special import erf

from sweep.model.effects.saturation import clipping_gains
from sweep.model.receiver_chain import quantisation_variance


def truth_quantise(voltage: np.ndarray, *, full_scale: float, bits: int) -> np.ndarray:
    """Record as the ADC gives it: 2^bits levels, each in the middle of its step, the ends held."""
    lsb = 2 * full_scale / 2**bits
    code = np.clip(np.floor(voltage / lsb), -(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return (code + 0.5) * lsb


@pytest.mark.parametrize("bits", range(4, 15))
def test_rounding_a_tone_with_noise_of_a_step_adds_white_noise(bits):
    """2^17 samples; a mean over M independent bins strays by 1/sqrt(M) of itself, 5 sigma."""
    number, rng = 2**17, np.random.default_rng(bits)
    lsb = 2 / 2**bits
    noise = lsb * rng.standard_normal(number)
    tone = min(0.7, 1 - 6 * lsb) * np.cos(2 * np.pi * 17321 * np.arange(number) / number + 0.3)
    record = truth_quantise(tone + noise, full_scale=1.0, bits=bits)
    error = abs(np.fft.rfft(record - tone - noise)[1:-1]) ** 2 / number
    white = float(quantisation_variance(full_scale=1.0, bits=bits))
    assert error.mean() / white == pytest.approx(1, abs=5 / np.sqrt(error.size))
    for band in np.array_split(error, 8):
        assert band.mean() / white == pytest.approx(1, abs=5 / np.sqrt(band.size))
    noise_power = abs(np.fft.rfft(record - tone)[1:-1]) ** 2 / number
    assert noise_power.mean() / (lsb**2 + white) == pytest.approx(
        1, abs=5 / np.sqrt(noise_power.size)
    )


@pytest.mark.parametrize("bits", [4, 6, 8, 12, 14])
@pytest.mark.parametrize("amplitude", [0.5, 0.9, 1.0, 1.3, 4.0])
def test_a_quantised_record_past_full_scale_shows_gain_and_noise(bits, amplitude):
    """Two records that differ in noise: their sum has the line, their difference the noise.

    The highest level, which is held, is half a step below full scale. 2^16 samples, 5 sigma: an
    amplitude strays by 5 s / sqrt(N), a mean over bins by 5 / sqrt(bins) of itself. Rounding
    bends the mean of a sample by lsb^2/24 of its second derivative, at most 0.4/s, and adds up to
    lsb^2/12 of variance.
    """
    number, lsb = 2**16, 2 * 0.5**bits
    s, full_scale = max(0.09, lsb), 1 - lsb / 2
    rng = np.random.default_rng(bits)
    turn = 2 * np.pi * 10007 * np.arange(number) / number
    records = [
        truth_quantise(
            amplitude * np.cos(turn) + s * rng.standard_normal(number), full_scale=1.0, bits=bits
        )
        for _ in range(2)
    ]
    gains = clipping_gains(amplitude=amplitude, deviation=s, full_scale=full_scale)
    line = ((records[0] + records[1]) * np.cos(turn)).mean()
    bend = lsb**2 / 24 * 0.4 / s * 4 / np.pi
    assert line == pytest.approx(gains.signal_gain * amplitude, abs=5 * s / np.sqrt(number) + bend)
    bins = abs(np.fft.rfft((records[0] - records[1]) / np.sqrt(2))[1:-1]) ** 2 / number
    expected = gains.noise_gain * s**2
    assert bins.mean() == pytest.approx(
        expected + lsb**2 / 24, abs=5 / np.sqrt(bins.size) * expected + lsb**2 / 24
    )


def test_the_gain_of_next_to_nothing_is_the_share_of_unclipped_noise():
    gain = clipping_gains(amplitude=[1e-4, 1e-9, 1e-30], deviation=1.0, full_scale=1.5).signal_gain
    np.testing.assert_allclose(gain, erf(1.5 / np.sqrt(2)), rtol=1e-8)
