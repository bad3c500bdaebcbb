"""Sunlight, the echo's own shot noise and a fluctuating laser: by hand, and on two diodes."""

import numpy as np
import pytest
from random_planner_points import planner_inputs

from sweep.model import evaluation, window
from sweep.model.effects.noise_sources import (
    intensity_noise_current_variance,
    signal_shot_noise_error_bound,
    solar_background_error_bound,
)
from sweep.model.receiver_chain import bin_noise_sigma

OTHERS = 1.53715e-13
"""Current variance of Table 4.1 [A^2]: 1.40992e-13 of it shot noise of 1 mW."""

ELECTRON = 1.602176634e-19


def fluctuating(density, power, *, rejection=1.0, apd_gain=1.0, responsivity=1.1, bandwidth=400e6):
    """Current variance of a laser's intensity noise [A^2]."""
    receiver = {
        "common_mode_rejection": rejection, "local_oscillator_power": power, "apd_gain": apd_gain,
        "responsivity": responsivity,
    }  # fmt: skip
    parameters = {f"instrument.receiver.{name}": value for name, value in receiver.items()}
    return intensity_noise_current_variance(
        parameters | {"instrument.laser.relative_intensity_noise": density}, bandwidth
    )


def test_the_share_of_sunlight_by_radiometry_of_the_patch_seen(table_4_1):
    """0.26 W/m^2/nm at 1.55 um on white ground, 1 km away, through 25 nm, 1 mrad and 25 mm; of
    which the optics let 0.8 through.

    The patch is 0.785 m^2 and receives 5.105 W; Lambert's law sends P/pi per steradian, and the
    aperture is 4.909e-10 sr: 7.977e-10 W, 1.125e-19 A^2 of shot noise, 7.3e-7 of the whole.
    """
    light = 0.26 * 25 * (np.pi * 0.5**2) / np.pi * (np.pi * 0.0125**2 / 1000.0**2)
    assert light == pytest.approx(7.977e-10, rel=1e-3)
    scene = table_4_1(
        solar_irradiance=2.6e8, reflectance=1.0, range=1000.0, beam_divergence=1e-3, fft_size=1024,
        optical_efficiency=0.8,
    )  # fmt: skip
    bound = solar_background_error_bound(planner_inputs(scene))
    assert bound.threshold_follows_noise
    assert bound.noise_variance_change == pytest.approx(0.8 * 1.125e-19 / OTHERS, rel=1e-3)


def test_false_alarms_rise_below_five_metres_as_the_thesis_reports(table_4_1):
    """Threshold without the echo, noise with it: Pfa = exp(-Th^2/2s^2 / (1 + share)), [T 4.2].

    At 2 km the echo is 1.953125e-12 W beside 1 mW: 17 % more false alarms at 1 m, 0.6 % at 5 m.
    """
    distance = np.array([1.0, 2.0, 5.0, 20.0])
    parameters = table_4_1(range=distance, fft_size=1024, radial_velocity=10.0)
    bound = signal_shot_noise_error_bound(planner_inputs(parameters))
    share = 1.40992e-13 / OTHERS * 1.953125e-12 * (2000.0 / distance) ** 2 / 1e-3
    np.testing.assert_allclose(bound.noise_variance_change, share, rtol=1e-4)
    assert not bound.threshold_follows_noise
    predicted = np.exp(-(4 - np.pi) / 4 * 100 / (1 + bound.noise_variance_change))
    np.testing.assert_allclose(evaluation.evaluate(parameters)["pfa_bin"], predicted, rtol=1e-5)
    rise = predicted / np.exp(-(4 - np.pi) / 4 * 100) - 1
    assert rise == pytest.approx([0.166, 0.0392, 0.00617, 3.8e-4], rel=0.02)


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
    expected = fluctuating(
        rin, power, rejection=81.0, apd_gain=3.0, responsivity=0.9 * 1.1, bandwidth=rate / 2
    )
    assert current.var() == pytest.approx(expected, rel=5 * np.sqrt(2 / number))
    hann = window.window_samples("hann", number)
    bins = np.fft.rfft(hann * (current - current.mean()))[4:-4:4]  # every fourth is independent
    sigma = bin_noise_sigma(noise_variance=expected, window_energy=(hann**2).sum())
    assert (abs(bins) ** 2).mean() / 2 / sigma**2 == pytest.approx(1, abs=5 / np.sqrt(bins.size))


def test_a_milliampere_has_as_much_of_it_as_shot_noise_at_minus_155_decibels():
    level = 10**-15.494  # 2 q / 1 mA
    noise_ratio = fluctuating(level, 1e-3 / 1.1)
    assert noise_ratio == pytest.approx(2 * ELECTRON * 1e-3 * 400e6, rel=2e-3)
