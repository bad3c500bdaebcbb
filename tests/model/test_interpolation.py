"""Places of tones between bins: exact without noise, errors under noise by the time domain."""

import numpy as np
import pytest
from scipy import stats
from shot_helpers import parametrize_product

from sweep.model.detection.estimators import beat_frequency_cramer_rao_bound, carrier_to_noise_ratio
from sweep.model.detection.sub_bin_interpolation import (
    estimate_sub_bin_offset,
    in_phase_noise_correlations,
    interpolator,
    late_echo_correction,
    line_spread_error,
    sub_bin_standard_error,
)
from sweep.model.window import direct_transform, get_window, window_samples

LENGTH = 128
DRAWS = 20_000
"""5 sigma of a standard deviation from as many normal numbers is 5 / sqrt(2 * 20,000) = 2.5 %."""


def least_error(w, ratio):
    """Cramer-Rao bound [bins] of a tone whose |X| on a bin is `ratio` sigmas."""
    cnr = carrier_to_noise_ratio(snr=ratio**2 / 2, window=w)
    return float(beat_frequency_cramer_rao_bound(cnr=cnr, n_samples=w.length, sample_rate=w.length))


def _spectrum(name, position, *, length, fft_size, phase):
    """|FFT| of windowed tones [bins of the FFT], (m, 3) around the nearest bin; that bin, (m,)."""
    n = np.arange(length)
    record = np.cos(2 * np.pi * np.outer(position, n) / fft_size + phase)
    full = np.abs(np.fft.rfft(record * window_samples(name, length), fft_size))
    low, high = int(np.min(position)) - 3, int(np.max(position)) + 5
    centre = low + full[:, low:high].argmax(axis=1)
    return full[np.arange(len(full))[:, None], centre[:, None] + [-1, 0, 1]], centre


@pytest.mark.parametrize(
    "name", ["hann", "hamming", "rectangular", "blackmanharris", "kaiser(8.6)"]
)
@pytest.mark.parametrize(("length", "fft_size"), [(4096, 4096), (3000, 4096)])
def test_a_tone_without_noise_is_placed_where_it_is(name, length, fft_size):
    """Mean over two phases in quadrature, which takes out the image of a real tone.

    What is left is the square of the image: 1/(2000 pi) of the tone for the rectangular window.
    """
    tables = interpolator(get_window(name, length), fft_size)
    position = 1000.0 + np.linspace(-0.49, 0.49, 33)
    spectra = [
        _spectrum(name, position, length=length, fft_size=fft_size, phase=phase)
        for phase in (0.3, 0.3 + np.pi / 2)
    ]
    placed = [
        [c + estimate_sub_bin_offset(*m, tables) for m, c in zip(*spectrum, strict=True)]
        for spectrum in spectra
    ]
    np.testing.assert_allclose(np.mean(placed, axis=0), position, atol=1e-4)
    np.testing.assert_allclose(placed[0], position, atol=1e-3)


def test_the_rectangular_and_hann_windows_have_their_closed_forms():
    """delta = m / (m0 + m) and 2 (a - b) / (a + 2 m0 + b), for long records."""
    for below, centre, above in [(0.2, 1.0, 0.7), (0.1, 1.0, 0.9)]:
        rectangular = interpolator(get_window("rectangular", 2**17), 2**17)
        expected = above / (centre + above)
        assert estimate_sub_bin_offset(below, centre, above, rectangular) == pytest.approx(
            expected, abs=1e-6
        )
        assert estimate_sub_bin_offset(above, centre, below, rectangular) == pytest.approx(
            -expected, abs=1e-6
        )
    hann = interpolator(get_window("hann", 2**17), 2**17)
    for delta in (-0.4, 0.0, 0.25, 0.5):
        y = np.array([-1.0, 0.0, 1.0]) - delta
        magnitudes = np.abs(np.sinc(y) / (1 - y**2 + 1e-300 * (abs(y) == 1)))
        magnitudes[np.abs(y) == 1] = 0.5
        a, m0, b = magnitudes[2], magnitudes[1], magnitudes[0]
        assert 2 * (a - b) / (a + 2 * m0 + b) == pytest.approx(delta, abs=1e-12)
        assert estimate_sub_bin_offset(b, m0, a, hann) == pytest.approx(delta, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "ratio"),
    parametrize_product(4, ["hann", "hamming", "rectangular"], [30.0, 100.0, 1000.0]),
)
def test_errors_under_noise_are_those_reported_and_no_less_than_the_bound(name, ratio):
    """White noise in the time domain; the spread around known places over an SNR of 30 dB.

    Complex records, so that no image adds to the noise. Beyond sampling, 2.5 %, noise of 1/30 is
    left to first order. The rectangular window is looked at between bins, where noise of 1/30
    doesn't make the wrong neighbour the larger one.
    """
    generator = np.random.default_rng(int(ratio))
    w = get_window(name, LENGTH)
    tables = interpolator(w, LENGTH)
    sigma = w.sum / ratio
    bound = least_error(w, ratio)
    steps = 2j * np.pi * np.outer([31, 32, 33], np.arange(LENGTH)) / LENGTH
    basis = (window_samples(name, LENGTH) * np.exp(-steps)).T
    for delta in (0.4, 0.48) if name == "rectangular" else (0.0, 0.35):
        noise = generator.standard_normal((DRAWS, 2 * LENGTH)).view(complex)
        tone = np.exp(2j * np.pi * (32 + delta) * np.arange(LENGTH) / LENGTH)
        clean = np.abs(tone @ basis)
        magnitudes = np.abs((tone + sigma / np.sqrt(w.energy) * noise) @ basis)
        placed = np.array([estimate_sub_bin_offset(*m, tables) for m in magnitudes])
        expected = sub_bin_standard_error(delta, clean[1] / sigma, tables)
        spread = np.sqrt(np.mean((placed - delta) ** 2))
        assert spread == pytest.approx(expected, rel=0.025 + 1 / ratio)
        assert abs(np.mean(placed - delta)) < 5 * expected / np.sqrt(DRAWS) + 1 / ratio**2
        assert expected > 0.999 * bound


def test_the_rectangular_window_reaches_the_bound_between_bins():
    """Half-way two bins hold 81 % of the power: 1 % is lost; Hann and Hamming lose 52 and 28 %."""
    for name, loss in (("rectangular", 1.01), ("hamming", 1.28), ("hann", 1.52)):
        w = get_window(name, 4096)
        tables = interpolator(w, 4096)
        scalloping = abs(direct_transform(w, np.array([0.5]))[0]) / w.sum
        error = sub_bin_standard_error(0.5, 1e4 * scalloping, tables)
        assert error / least_error(w, 1e4) == pytest.approx(loss, abs=0.02)


@pytest.mark.parametrize(("length", "fft_size"), [(512, 512), (400, 512)])
def test_the_noise_of_three_bins_is_correlated_as_by_the_window(length, fft_size):
    """Against windowed white noise in the time domain, in phase with a tone at the middle bin.

    5 sigma of a correlation from 20,000 is at most 5 / sqrt(20,000) = 0.035.
    """
    generator = np.random.default_rng(3)
    noise = generator.standard_normal((DRAWS, length)) * window_samples("hamming", length)
    turns = np.outer(np.arange(99, 102), np.arange(length) - length / 2) / fft_size
    bins = (noise @ np.exp(-2j * np.pi * turns).T).real
    measured = np.corrcoef(bins.T)
    near, far = in_phase_noise_correlations(get_window("hamming", length), fft_size)
    expected = np.array([[1, near, far], [near, 1, near], [far, near, 1]])
    np.testing.assert_allclose(measured, expected, atol=5 / np.sqrt(DRAWS))
    tables = interpolator(get_window("hamming", length), fft_size)
    m0, m1, m2, m3 = tables.noise_mixing
    mixed = np.array([[m0, m2, m3], [1.0, 0.0, 0.0], [m0, m1, 0.0]])
    np.testing.assert_allclose(mixed @ mixed.T, expected, atol=1e-12)


@pytest.mark.parametrize("name", ["hann", "hamming", "blackmanharris"])
@pytest.mark.parametrize(("length", "fft_size"), [(512, 512), (400, 512)])
def test_lines_that_spread_move_the_place_as_tabulated(name, length, fft_size):
    """Powers of 400 tones at the quantiles of a normal spread, from the time domain.

    Its fourth moment moves the place too, by some 4 spread^2 of what the second does: 4 %.
    """
    tables = interpolator(get_window(name, length), fft_size)
    n = np.arange(length)
    basis = np.exp(-2j * np.pi * np.outer(n, np.arange(99, 102)) / fft_size)
    basis *= window_samples(name, length)[:, None]
    quantiles = stats.norm.ppf((np.arange(400) + 0.5) / 400)
    for delta in (-0.45, 0.1, 0.3):
        for spread in (0.05, 0.1):
            lines = 100 + delta + spread * quantiles
            tones = np.exp(2j * np.pi * np.outer(lines, n) / fft_size)
            powers = np.mean(np.abs(tones @ basis) ** 2, axis=0)
            moved = estimate_sub_bin_offset(*np.sqrt(powers), tables) - delta
            expected = line_spread_error(delta, spread, True, tables)
            assert abs(moved) == pytest.approx(expected, rel=0.05, abs=1e-6)
            assert expected > 3e-5


def test_a_spread_can_not_move_the_place_by_more_than_itself():
    tables = interpolator(get_window("rectangular", 512), 512)
    assert line_spread_error(0.0, 0.2, True, tables) == 0.2
    assert line_spread_error(0.3, 0.2, False, tables) == 0.2
    assert line_spread_error(0.3, 0.0, True, tables) == 0.0


def test_a_flat_top_in_a_padded_fft_says_that_it_places_nothing():
    tables = interpolator(get_window("flattop", 700), 4096)
    assert estimate_sub_bin_offset(0.9, 1.0, 0.95, tables) == 0.0
    assert sub_bin_standard_error(0.0, 100.0, tables) == 0.5


def test_nothing_at_all_is_placed_on_its_bin():
    tables = interpolator(get_window("hann", 4096), 4096)
    assert estimate_sub_bin_offset(0.0, 0.0, 0.0, tables) == 0.0
    assert sub_bin_standard_error(0.0, 0.0, tables) == 0.5


@pytest.mark.parametrize(("name", "length", "size"), [
    ("hann", 4096, 4096), ("hamming", 3000, 4096), ("rectangular", 2048, 4096),
    ("blackman", 2000, 2048),
])  # fmt: skip
@pytest.mark.parametrize("share", [0.01, 0.07, 0.15])
def test_places_of_late_echoes_are_those_of_their_lines(name, length, size, share):
    """Lone tones in part of a record, their bias, and the deviation of drawn noise."""
    shape, missing = get_window(name, length), int(share * length)
    tables, taper, n = interpolator(shape, size), window_samples(name, length), np.arange(length)
    turns = np.exp(-2j * np.pi * np.outer(n, [99, 100, 101]) / size)
    rng, draws, ratio = np.random.default_rng(length), 1000, 60.0
    noise = rng.normal(size=(2, draws, length)) * taper
    for place in (0.15, 0.35, 0.45):
        tone = taper * (n >= missing) * np.exp(2j * np.pi * (100 + place) * n / size)
        bins = tone @ turns
        read = estimate_sub_bin_offset(*np.abs(bins), tables)
        late = late_echo_correction(np.array(read), np.array(missing), shape, size)
        assert read + late.shift == pytest.approx(place, abs=2e-3)
        sigma = abs(bins[1]) / ratio / np.sqrt((taper**2).sum())
        noisy = np.abs(bins + sigma * (noise[0] + 1j * noise[1]) @ turns)
        estimates = np.array([estimate_sub_bin_offset(*row, tables) for row in noisy])
        estimates = (
            estimates + late_echo_correction(estimates, np.full(draws, missing), shape, size).shift
        )
        stated_error = sub_bin_standard_error(read, ratio, tables) * late.error_factor
        assert estimates.std() == pytest.approx(float(stated_error), rel=0.15)
        assert estimates.mean() == pytest.approx(place, abs=0.2 * float(stated_error) + 2e-3)


@pytest.mark.parametrize("share", [0.31, 0.5, 0.7])
@pytest.mark.parametrize("place", [0.0, 0.02, 0.3, 0.5])
def test_half_a_record_and_less_tells_a_place_with_a_rectangular_window(share, place):
    """Errors of drawn noise are far below half a bin, and as large as stated, on bins too."""
    length = size = 1024
    shape, missing, n = get_window("rectangular", length), int(share * length), np.arange(length)
    tables, rng, draws, ratio = interpolator(shape, size), np.random.default_rng(2), 2000, 300.0
    turns = np.exp(-2j * np.pi * np.outer(n, [99, 100, 101]) / size)
    bins = ((n >= missing) * np.exp(2j * np.pi * (100 + place) * n / size)) @ turns
    sigma = abs(bins[1]) / ratio / np.sqrt(length)
    noise = rng.normal(size=(2, draws, length))
    noisy = np.abs(bins + sigma * (noise[0] + 1j * noise[1]) @ turns)
    read = np.array([estimate_sub_bin_offset(*row, tables) for row in noisy])
    late = late_echo_correction(read, np.full(draws, missing), shape, size)
    error = np.sqrt(np.square(np.abs(read + late.shift) - place).mean())
    stated_error = np.median(
        sub_bin_standard_error(np.median(read), ratio, tables) * late.error_factor
    )
    assert stated_error < 0.03
    floor = 0.06 if share > 0.6 else 0.01  # next to a bin, where reads hardly rise with the place
    assert 0.85 * stated_error < error < 1.15 * stated_error + (floor if place < 0.1 else 0.0)


def test_whole_echoes_stay_as_they_are():
    late = late_echo_correction(
        np.array([-0.4, 0.2]), np.array([0, 0]), get_window("hann", 512), 512
    )
    np.testing.assert_array_equal(late.shift, 0.0)
    np.testing.assert_array_equal(late.error_factor, 1.0)
