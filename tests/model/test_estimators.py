"""Estimators of frequency: tones without noise, and errors in noise against the bounds."""

import numpy as np
import pytest
from shot_helpers import parametrize_product

from sweep.model.detection import estimators
from sweep.model.detection.detectors import SpectrumSettings, cached_window_samples
from sweep.model.detection.estimators import (
    ESTIMATORS,
    jacobsen_coefficients,
    position_error_at_unit_signal,
)
from sweep.model.window import get_window

SIZE, BIN, DRAWS = 512, 120, 1500
"""5 standard errors of a root mean square of 1500 normal numbers are 5 / sqrt(3000) = 9 %."""


def spectra(name, length, delta, cnr=np.inf, seed=2):
    """Spectra of tones `delta` bins above BIN, phases at random; what is told of them."""
    rng, w = np.random.default_rng(seed), get_window(name, length)
    turns = np.outer(BIN + np.asarray(delta), np.arange(length)) / SIZE
    record = np.cos(2 * np.pi * turns + rng.uniform(0, 2 * np.pi, (len(delta), 1)))
    variance = 0.5 / cnr
    record += rng.normal(0, np.sqrt(variance), record.shape)
    setting = SpectrumSettings(
        fft_size=SIZE, sample_rate=float(SIZE), window=w, noise_power=w.energy * variance,
        threshold=1.0, training=32, guard=4, rank=24, pfa=1e-3,
    )  # fmt: skip
    spectrum = np.fft.rfft(record * cached_window_samples(w), SIZE)
    peak = BIN - 8 + np.argmax(np.abs(spectrum[:, BIN - 8 : BIN + 9]), axis=1)
    return spectrum, peak, setting


WINDOWS = [("rectangular", SIZE), ("hamming", SIZE), ("hann", SIZE), ("hamming", 400)]
BIASES = {
    "peak_bin": 0.5, "parabolic": 0.25, "parabolic_log": 0.2, "jacobsen": 0.07, "candan": 4e-3,
    "centroid": 0.25, "chirp_z": 4e-3, "maximum_likelihood": 1e-5,
}  # fmt: skip
"""Largest errors without noise over WINDOWS; of the best three the tone's own image, which in the
rectangular window stands at 1 / (2 pi 120) of it, and 1e-5 where that is taken off."""


@pytest.mark.parametrize("name", BIASES)
@pytest.mark.parametrize(("shape", "length"), WINDOWS)
def test_a_tone_without_noise_is_placed_within_the_estimators_bias(name, shape, length):
    delta = np.linspace(-0.49, 0.49, 41)
    spectrum, peak, setting = spectra(shape, length, delta)
    offset_estimate = ESTIMATORS[name](spectrum, peak, setting)
    assert offset_estimate.shape == peak.shape and offset_estimate.dtype == float
    assert np.abs(offset_estimate - BIN - delta).max() <= BIASES[name]


@pytest.mark.parametrize("shift", [0, 1, 511])  # a peak in the last bin, the first, the middle
@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_a_complex_spectrum_has_no_ends(name, shift):
    """A record turned by whole bins has its spectrum rolled, and its tone so many bins on."""
    size, rng = 1024, np.random.default_rng(8)
    setting = SpectrumSettings(
        fft_size=size, sample_rate=600e6, window=get_window("hann", size), noise_power=1.0,
        threshold=1.0, training=32, guard=8, rank=24, pfa=1e-4, complex_record=True,
    )  # fmt: skip
    noise = 0.1 * (rng.normal(size=size) + 1j * rng.normal(size=size))
    record = np.exp(2j * np.pi * (size - 1 + 0.3) * np.arange(size) / size) + noise
    spectrum = np.fft.fft(cached_window_samples(setting.window) * record)[None]
    (expected,) = ESTIMATORS[name](np.roll(spectrum, 512, 1), np.array([511]), setting)
    (estimate,) = ESTIMATORS[name](
        np.roll(spectrum, shift, 1), np.array([(shift - 1) % size]), setting
    )
    assert (estimate - shift) % size == pytest.approx((expected - 512) % size, abs=1e-6)


def test_every_estimator_is_looked_at():
    assert set(BIASES) == set(ESTIMATORS)


def test_jacobsens_factors_are_those_of_his_table():
    """Q of Jacobsen and Kootsookos [2007], which they fitted by eye to two digits."""
    table = {"hamming": 0.60, "hann": 0.55, "blackman": 0.55, "blackmanharris": 0.56}
    for name, factor in table.items():
        assert jacobsen_coefficients(get_window(name, SIZE), SIZE) == (
            -1,
            pytest.approx(factor, abs=0.025),
        )
    assert jacobsen_coefficients(get_window("rectangular", SIZE), SIZE) == (1, 1.0)


def errors(name, shape, length, decibel):
    """Errors [bins] of tones anywhere between bins, the Cramer-Rao bound, the windowed one."""
    w = get_window(shape, length)
    cnr = estimators.carrier_to_noise_ratio(snr=10 ** (decibel / 10), window=w)
    delta = np.random.default_rng(9).uniform(-0.5, 0.5, DRAWS)
    spectrum, peak, setting = spectra(shape, length, delta, cnr)
    error = ESTIMATORS[name](spectrum, peak, setting) - BIN - delta
    bound = estimators.beat_frequency_cramer_rao_bound(
        cnr=cnr, n_samples=length, sample_rate=float(SIZE)
    )
    return error, bound, estimators.windowed_peak_frequency_deviation(
        cnr=cnr, window=w, sample_rate=float(SIZE)
    )  # fmt: skip


@pytest.mark.parametrize(("window", "decibel"), parametrize_product(3, WINDOWS, [20, 30, 40, 60]))
def test_the_most_likely_frequency_reaches_the_bound(window, decibel):
    """Within 10 %, whatever the window; and without bias, by 5 standard errors."""
    error, bound, _ = errors("maximum_likelihood", *window, decibel)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(bound, rel=0.1)
    assert abs(error.mean()) < 5 * error.std() / np.sqrt(DRAWS)


@pytest.mark.parametrize(("shape", "length"), WINDOWS)
@pytest.mark.parametrize("decibel", [20, 30])
def test_the_largest_value_of_the_windowed_spectrum_is_as_good_as_the_window_allows(
    shape, length, decibel
):
    error, bound, windowed = errors("chirp_z", shape, length, decibel)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(windowed, rel=0.1)
    assert windowed == pytest.approx(bound) if shape == "rectangular" else windowed > 1.05 * bound


@pytest.mark.parametrize("name", ["candan", "chirp_z", "maximum_likelihood"])
@pytest.mark.parametrize("shape", ["rectangular", "hann", "hamming"])
@pytest.mark.parametrize("padding", [1, 4])
def test_the_standard_error_of_a_position_is_the_spread_of_estimates_in_noise(name, shape, padding):
    """Complex records, as their tones have no image."""
    length, number, noise = 256, 1500, 0.02
    fft_size, rng = padding * length, np.random.default_rng(0)
    window, middle = get_window(shape, length), fft_size // 2
    settings = SpectrumSettings(
        fft_size=fft_size, sample_rate=1.0, window=window, noise_power=1.0, threshold=1.0,
        training=4, guard=1, rank=3, pfa=1e-6, complex_record=True,
    )  # fmt: skip
    stated_error = position_error_at_unit_signal(name, window, fft_size)
    peak, samples = fft_size // 5, np.arange(length)
    for delta in (0.0, 0.2, 0.45):
        phase = 2 * np.pi * ((peak + delta) * samples / fft_size + rng.random((number, 1)))
        normal = rng.normal(size=(2, number, length)) / np.sqrt(2)
        record = np.exp(1j * phase) + noise * (normal[0] + 1j * normal[1])
        spectrum = np.fft.fftshift(np.fft.fft(settings.taper * record, fft_size), axes=1)
        ratio = np.abs(spectrum[:, peak + middle]).mean() / (noise * np.sqrt(window.energy / 2))
        position = ESTIMATORS[name](spectrum, np.full(number, peak + middle), settings) - middle
        error = np.interp(delta, np.linspace(0, 1, stated_error.size), stated_error) / ratio
        assert position.std() == pytest.approx(error, rel=0.09)
        assert abs(position.mean() - peak - delta) < 5 * error / np.sqrt(number) + 1e-5


@pytest.mark.parametrize("name", BIASES)
def test_no_estimator_beats_the_bound(name):
    """Over 40 dB; 5 standard errors are 9 %, and a biased one may only be worse."""
    for decibel in (20, 40, 60):
        error, bound, _ = errors(name, "hamming", SIZE, decibel)
        assert np.sqrt(np.mean(error**2)) > 0.91 * bound
