"""Intensity noise of the local oscillator, against a fluctuating laser on two diodes."""

import numpy as np
import pytest

from sweep.model import window
from sweep.model.effects.noise_sources import current_variance
from sweep.model.link import bin_deviation

ELECTRON = 1.602176634e-19
LASER = {
    "relative_intensity_noise": 1e-15, "common_mode_rejection": 1.0, "local_oscillator_power": 1e-3,
    "apd_gain": 1.0, "responsivity": 1.1, "electrical_bandwidth": 400e6,
}  # fmt: skip


def test_two_diodes_that_do_not_match_see_what_is_left_of_a_fluctuating_laser():
    """White dP/P of density RIN up to half the sample rate; 2^17 samples, 5 sigma.

    Half the light on each diode, whose gains are 1 and 0.8: their currents differ by 0.1 of the
    sum that would fluctuate in full, a rejection of (1.8 / 0.2)^2 = 81 against one diode of the
    mean gain 0.9.
    """
    rate, number, rin, power = 600e6, 2**17, 1e-13, 1e-3
    rng = np.random.default_rng(1)
    light = power * (1 + np.sqrt(rin * rate / 2) * rng.standard_normal(number))
    current = 3.0 * 1.1 * (1.0 * light / 2 - 0.8 * light / 2)
    expected = current_variance(
        relative_intensity_noise=rin, common_mode_rejection=81.0, local_oscillator_power=power,
        apd_gain=3.0, responsivity=0.9 * 1.1, electrical_bandwidth=rate / 2,
    )  # fmt: skip
    assert current.var() == pytest.approx(expected, rel=5 * np.sqrt(2 / number))
    hann = window.samples("hann", number)
    bins = np.fft.rfft(hann * (current - current.mean()))[4:-4:4]  # every fourth is independent
    sigma = bin_deviation(noise_variance=expected, window_energy=(hann**2).sum())
    assert (abs(bins) ** 2).mean() / 2 / sigma**2 == pytest.approx(1, abs=5 / np.sqrt(bins.size))


def test_a_milliampere_has_as_much_of_it_as_shot_noise_at_minus_155_decibels():
    level = 10**-15.494  # 2 q / 1 mA
    seen = current_variance(
        **LASER | {"relative_intensity_noise": level, "local_oscillator_power": 1e-3 / 1.1}
    )
    assert seen == pytest.approx(2 * ELECTRON * 1e-3 * 400e6, rel=2e-3)


def test_it_outgrows_shot_noise_with_power_and_direct_detection_has_none():
    one, two = (current_variance(**LASER | {"local_oscillator_power": p}) for p in (1e-3, 2e-3))
    assert two == pytest.approx(4 * one, rel=1e-14)
    assert current_variance(**LASER | {"local_oscillator_power": 0.0}) == 0.0
    balanced = current_variance(**LASER | {"common_mode_rejection": 10**2.5})
    assert 10 * np.log10(one / balanced) == pytest.approx(25.0, rel=1e-12)
