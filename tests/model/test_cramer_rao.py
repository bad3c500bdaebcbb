"""Cramer-Rao bounds against the Fisher information, summed or differentiated by itself."""

import numpy as np
import pytest

from sweep.model import waveform
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection import estimators
from sweep.model.window import get_window, window_samples

LENGTH = 128
RATE = 1e6


def test_the_bound_of_a_beat_is_that_of_the_fisher_information():
    """Inverse of the information matrix of amplitude, phase and frequency, summed sample by sample.

    Averaged over the phase, which the closed form leaves out.
    """
    n, amplitude, deviation = np.arange(LENGTH), 0.7, 0.2
    least = []
    for phase in np.arange(8) * np.pi / 8:
        argument = 2 * np.pi * 40.3 * n / LENGTH + phase
        slopes = np.stack([
            np.cos(argument),
            -amplitude * np.sin(argument),
            -amplitude * 2 * np.pi * n / RATE * np.sin(argument),
        ])  # fmt: skip
        least.append(np.linalg.inv(slopes @ slopes.T / deviation**2)[2, 2])
    cnr = amplitude**2 / (2 * deviation**2)
    bound = estimators.beat_frequency_cramer_rao_bound(cnr=cnr, n_samples=LENGTH, sample_rate=RATE)
    assert bound**2 == pytest.approx(np.mean(least), rel=1e-3)
    assert (
        estimators.beat_frequency_cramer_rao_bound(cnr=0.0, n_samples=LENGTH, sample_rate=RATE)
        == np.inf
    )


def test_the_ratio_before_the_fft_follows_from_that_after_it():
    """A tone and noise in the time domain: power over variance; |X|^2 over the noise's mean."""
    w = get_window("hamming", 1024)
    tone = 0.3 * np.cos(2 * np.pi * 100 * np.arange(1024) / 1024)
    signal = abs(np.fft.rfft(tone * window_samples("hamming", 1024))[100]) ** 2
    snr = signal / (w.energy * 0.5**2)
    cnr = estimators.carrier_to_noise_ratio(snr=snr, window=w)
    assert cnr == pytest.approx((tone**2).mean() / 0.5**2, rel=1e-9)


@pytest.mark.parametrize("name", ["rectangular", "hamming", "hann"])
def test_the_largest_value_of_a_windowed_spectrum_is_as_far_off_as_it_says(name):
    """Newton steps to the maximum of |X(f)| of 4000 noisy records; 5 sigma are 5 / sqrt(8000)."""
    generator, draws, n = np.random.default_rng(5), 4000, np.arange(LENGTH)
    w, cnr = window_samples(name, LENGTH), 30.0
    noise = generator.normal(0, np.sqrt(1 / (2 * cnr)), (draws, LENGTH))
    record = (np.cos(2 * np.pi * 40.3 * n / LENGTH) + noise) * w
    f = np.full(draws, 40.3)
    for _ in range(8):
        turning = record * np.exp(-2j * np.pi * np.outer(f, n) / LENGTH)
        x = [(turning * (-2j * np.pi * n / LENGTH) ** k).sum(axis=1) for k in range(3)]
        slope = 2 * (x[1] * x[0].conj()).real
        f -= slope / (2 * (abs(x[1]) ** 2 + (x[2] * x[0].conj()).real))
    expected = estimators.windowed_peak_frequency_deviation(
        cnr=cnr, window=get_window(name, LENGTH), sample_rate=float(LENGTH)
    )
    bound = estimators.beat_frequency_cramer_rao_bound(
        cnr=cnr, n_samples=LENGTH, sample_rate=float(LENGTH)
    )
    assert np.std(f) == pytest.approx(expected, rel=5 / np.sqrt(2 * draws) + 0.02)
    assert expected == pytest.approx(bound, rel=1e-9) if name == "rectangular" else expected > bound


@pytest.mark.parametrize("doppler", [2e3, np.inf])
def test_the_bound_of_range_and_velocity_is_that_of_beats_differentiated(doppler):
    """Least squares weighted by the beats' errors, their slopes by differences of the beats."""
    carriers = (193e12, 193e12, 193e12 + 1e9)
    target, spread = {"range": 2000.0, "radial_velocity": 150.0}, np.array([1e3, doppler, 1.5e3])

    def beats(**at):
        return np.array([
            waveform.beat_frequency(sign, carrier=carrier, chirp_rate=2e12, **(target | at))
            for sign, carrier in zip(waveform.DEFAULT_CHIRP_RATE_RATIOS, carriers, strict=True)
        ])  # fmt: skip

    slopes = np.stack([
        (beats(range=2001.0) - beats(range=1999.0)) / 2,
        (beats(radial_velocity=151.0) - beats(radial_velocity=149.0)) / 2,
    ], axis=1)  # fmt: skip
    expected = np.sqrt(np.diag(np.linalg.inv(slopes.T @ np.diag(spread**-2.0) @ slopes)))
    deviation = estimators.range_velocity_deviation(
        up=spread[0],
        doppler=spread[1],
        down=spread[2],
        carriers=carriers,
        chirp_rate=2e12,
        **target,
    )
    assert deviation == pytest.approx(tuple(expected), rel=1e-6)


def test_range_and_velocity_take_two_beats():
    """Up and down beats alone: half sum and half difference. One beat alone knows neither."""
    arguments = {
        "carriers": (2e14,) * 3, "chirp_rate": 2e12, "range": 0.0, "radial_velocity": 0.0,
        "doppler": np.inf,
    }  # fmt: skip
    deviation = estimators.range_velocity_deviation(up=3e3, down=4e3, **arguments)
    assert deviation.range == pytest.approx(2.5e3 * SPEED_OF_LIGHT / (2 * 2e12))
    assert deviation.radial_velocity == pytest.approx(2.5e3 * SPEED_OF_LIGHT / (2 * 2e14))
    blind = estimators.range_velocity_deviation(up=3e3, down=np.inf, **arguments)
    assert np.isinf(blind.range) and np.isinf(blind.radial_velocity)


@pytest.mark.parametrize("ratio", [1e-3, 0.1, 0.334, 1.0, 3.0])
def test_a_walking_phase_errs_as_the_straight_line_through_it_does(ratio):
    """Least squares through samples whose covariance is the triangle Gamma (tau - |t|)."""
    duration, width = 2e-6, 1e5
    time = (np.arange(4000) + 0.5) / 4000 * duration
    slope = (time - time.mean()) / ((time - time.mean()) ** 2).sum()
    lags = np.abs(time[:, None] - time)
    covariance = 2 * np.pi * width * np.maximum(ratio * duration - lags, 0.0)
    expected = np.sqrt(slope @ covariance @ slope) / (2 * np.pi)
    deviation = estimators.phase_noise_beat_deviation(
        line_width=width, delay=ratio * duration, duration=duration
    )
    assert deviation == pytest.approx(expected, rel=0.02 if ratio < 0.01 else 1e-4)
