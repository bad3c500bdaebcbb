"""Link budget, receiver and noise: energy, published laws of the SNR, sums by hand."""

import numpy as np
import pytest
import scipy.constants
from scipy import integrate
from scipy.constants import c as speed_of_light
from shot_helpers import prepare_single_category

from sweep.model import constants, evaluation, receiver_chain
from sweep.model.beamlets import place_beamlets
from sweep.model.ground import backscatter
from sweep.model.receiver_chain import (
    bin_noise_sigma,
    electrical_bandwidth,
    receiver_transfer_function,
)

ELECTRON, BOLTZMANN = 1.602176634e-19, 1.380649e-23
GAIN = 7e3
"""Transimpedance of Table 4.1 [ohm]."""


# Light


@pytest.mark.parametrize("law", ["thesis", "lambert"])
def test_a_white_surface_scatters_all_its_light_into_the_hemisphere(law):
    total, _ = integrate.quad(
        lambda polar: 2 * np.pi * np.sin(polar) * backscatter(law, np.array(np.cos(polar))),
        0, np.pi / 2,
    )  # fmt: skip
    assert total == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("law", ["thesis", "lambert"])
def test_each_beamlets_echo_falls_with_the_square_of_its_own_range(law, table_4_1):
    """Grazing 0.03 rad, divergence 20 mrad: rays by vectors from 1 m of range on the axis."""
    scene = table_4_1(
        reflectance_law=law, grazing_angle=0.03, beam_divergence=20e-3, beamlets=37,
        fft_size=1024, phases="incoherent", range=100.0,
    )  # fmt: skip
    (across, along), share = place_beamlets(37)
    x, y = 5e-3 * across, 5e-3 * along
    ray = np.array([np.cos(0.03) - y * np.sin(0.03), x, -np.sin(0.03) - y * np.cos(0.03)])
    down = -ray[2] / np.sqrt((ray**2).sum(axis=0))
    far = np.sin(0.03) / down
    lit = down > 0
    assert far[lit].max() / far[lit].min() > 2
    shots = prepare_single_category(scene)
    power = (
        shots.echo_scales.beat_amplitude_scale
        * shots.footprint.relative_amplitude[0]
        / (2 * 1.1 * GAIN)
    ) ** 2 / 1e-3
    scattered = down / np.pi if law == "lambert" else 1 / (2 * np.pi)
    expected = 0.1 * np.pi * 0.0125**2 * share * scattered / (100.0 * far) ** 2
    assert power[lit] == pytest.approx(expected[lit], rel=1e-10)
    assert np.all(power[~lit] == 0)


# Signal-to-noise ratio. A line in the middle of a bin has after the FFT the ratio of its mean
# square to the noise's variance times N / (2 ENBW): its power is a sine's, shared by two bins.


def carrier_to_noise(parameters, bins=1000):
    """Mean square signal over noise variance in the record, from the Doppler segment's SNR."""
    n = int(parameters["instrument.processing.fft_size"])
    beat = bins * 600e6 / n
    velocity = beat * 1550e-9 / 2
    results = evaluation.evaluate(parameters | {"target.radial_velocity": velocity})
    poles = 1 + (beat / parameters["instrument.receiver.detector_bandwidth"]) ** 2
    poles *= 1 + (beat / parameters["instrument.receiver.amplifier_bandwidth"]) ** 2
    hamming = 0.54**2 + 0.46**2 / 2
    return results["snr_doppler"][0] * poles * hamming / 0.54**2 * 2 / n


@pytest.fixture
def shot_limited(table_4_1):
    """Shot noise of the local oscillator alone, one beamlet."""
    return table_4_1(
        local_oscillator_power=0.5, noise_equivalent_power=0.0, amplifier_noise_current=0.0,
        beamlets=1, fft_size=8192,
    )  # fmt: skip


def test_heterodyne_shot_limited_snr_is_that_of_equation_2_23(shot_limited):
    """Re P / (2 q B), half of the homodyne receiver's; an RF noise figure divides it."""
    scene = shot_limited | {"instrument.receiver.architecture": "heterodyne"}
    expected = 1.1 * 1.953125e-12 / (2 * ELECTRON * 400e6)
    assert carrier_to_noise(scene) == pytest.approx(expected, rel=1e-8)
    for figure_db in (0.0, 3.0, 10.0):
        figure = 10 ** (figure_db / 10)
        noisy = scene | {"instrument.receiver.noise_figure": figure}
        assert carrier_to_noise(noisy) == pytest.approx(expected / figure, rel=1e-8)


def test_a_noise_figure_is_the_heterodyne_receivers_alone(shot_limited):
    noisy = shot_limited | {"instrument.receiver.noise_figure": 2.0}
    assert carrier_to_noise(noisy) == carrier_to_noise(shot_limited)


def test_shot_limited_snr_is_linear_in_light_and_ignores_the_local_oscillator(shot_limited):
    one = carrier_to_noise(shot_limited)
    for path, factor, expected in (
        ("instrument.laser.power", 2.0, 2.0),
        ("instrument.telescope.aperture", 2.0, 4.0),
        ("instrument.telescope.optical_efficiency", 0.3, 0.3),
        ("target.range", 2.0, 1 / 4),
        ("instrument.receiver.mixing_efficiency", 0.5, 0.5),
        ("instrument.receiver.excess_noise_factor", 3.0, 1 / 3),
        ("instrument.receiver.apd_gain", 5.0, 1.0),
        ("instrument.receiver.local_oscillator_power", 7.0, 1.0),
        ("instrument.receiver.transimpedance", 0.3, 1.0),
        ("instrument.processing.fft_size", 2, 1.0),
    ):
        scene = shot_limited | {path: shot_limited[path] * factor}
        bins = 2000 if path.endswith("fft_size") else 1000
        assert carrier_to_noise(scene, bins) / one == pytest.approx(expected, rel=1e-7), path


def direct_snr(parameters):
    """Mean square signal over noise variance in the record, from the up-chirp segment's SNR."""
    n = 8192
    scene = parameters | {
        "instrument.processing.fft_size": n, "footprint.beamlets": 1, "target.range": 4 * 749.48,
        "target.radial_velocity": 0.0, "instrument.processing.window": "rectangular",
    }  # fmt: skip
    beat = 2e12 * 2 * scene["target.range"] / speed_of_light
    bins = round(beat / (600e6 / n))
    scene["target.range"] *= bins * 600e6 / n / beat
    snr = evaluation.evaluate(scene)["snr_up"][0]
    poles = (1 + (bins * 600e6 / n / 400e6) ** 2) ** 2
    return snr * poles * 2 / n, 1.953125e-12 * (2000.0 / scene["target.range"]) ** 2


@pytest.fixture
def thermally_limited(table_4_1):
    """Direct detection of 4e6 times the light, with the thermal noise of its load alone."""
    return table_4_1(
        architecture="direct", noise_equivalent_power=0.0, amplifier_noise_current=0.0,
        load_resistance=75.0, temperature=310.0,
    )  # fmt: skip


def test_direct_thermal_snr_is_a_quarter_of_equation_2_22(thermally_limited):
    """2 Re^2 P^2 / (4 k T B / R_L) is for the peak current of full modulation, as link.py says."""
    snr, echo = direct_snr(thermally_limited)
    thesis = 2 * 1.1**2 * echo**2 / (4 * BOLTZMANN * 310.0 * 400e6 / 75.0)
    assert snr == pytest.approx(thesis / 4, rel=1e-6)
    half, _ = direct_snr(thermally_limited | {"instrument.receiver.modulation_index": 0.5})
    assert half == pytest.approx(snr / 4, rel=1e-12)


def test_direct_snr_falls_two_decibels_for_each_decibel_of_light(thermally_limited):
    snr, _ = direct_snr(thermally_limited)
    dimmed, _ = direct_snr(thermally_limited | {"target.reflectance": 0.1 * 10**-0.1})
    assert 10 * np.log10(snr / dimmed) == pytest.approx(2.0, abs=1e-5)


def test_direct_detection_ignores_the_local_oscillator_and_has_no_shot_noise_of_it(
    thermally_limited,
):
    scene = thermally_limited | {"instrument.receiver.local_oscillator_power": 5.0}
    assert direct_snr(scene) == direct_snr(thermally_limited)
    assert "local_oscillator_shot" not in prepare_single_category(scene).noise.variances


# Noise


def test_the_noise_of_table_4_1_by_hand(table_4_1):
    """1.4099e-13 A^2 shot, 1.21e-14 detector, 6.25e-16 amplifier; times (7 kohm)^2."""
    shots = prepare_single_category(table_4_1(fft_size=1024))
    by_hand = {"local_oscillator_shot": 1.40992e-13, "detector": 1.21e-14, "amplifier": 6.25e-16}
    for source, current in by_hand.items():
        assert shots.noise.variances[source] == pytest.approx(current * 4.9e7, rel=1e-5)
    assert shots.noise_variance == pytest.approx(7.53211e-6, rel=1e-5)
    assert set(shots.noise.variances) == {*by_hand, "signal_shot", "solar_shot"}
    assert shots.noise.variances["solar_shot"] == 0.0
    # 2 q Re P B of the echo, 1.953e-12 W.
    assert shots.noise.variances["signal_shot"] == pytest.approx(2.7537e-22 * 4.9e7, rel=1e-3)


def test_gain_raises_light_and_detector_noise_as_its_square_and_leaves_the_amplifiers(table_4_1):
    noise_variances = prepare_single_category(
        table_4_1(fft_size=1024, solar_irradiance=2.6e8)
    ).noise.variances
    gained = prepare_single_category(
        table_4_1(fft_size=1024, solar_irradiance=2.6e8, apd_gain=10.0, excess_noise_factor=4.0)
    ).noise.variances
    factors = {
        "local_oscillator_shot": 400.0, "signal_shot": 400.0, "solar_shot": 400.0,
        "detector": 100.0, "amplifier": 1.0,
    }  # fmt: skip
    for source, factor in factors.items():
        assert gained[source] == pytest.approx(factor * noise_variances[source], rel=1e-13), source


def test_the_narrower_stage_sets_the_bandwidth_of_the_noise(table_4_1):
    for detector, amplifier in ((100e6, 400e6), (400e6, 100e6), (100e6, 100e6)):
        stages = {"detector_bandwidth": detector, "amplifier_bandwidth": amplifier}
        assert electrical_bandwidth(stages) == 100e6
        scene = table_4_1(detector_bandwidth=detector, amplifier_bandwidth=amplifier, fft_size=1024)
        shot_noise = prepare_single_category(scene).noise.variances["local_oscillator_shot"]
        assert shot_noise == pytest.approx(1.40992e-13 / 4 * 4.9e7, rel=1e-5)


def test_noise_of_a_bin_is_half_the_windowed_records_in_each_quadrature():
    """White noise of variance 3 through a Hann window: its covariance, summed sample by sample."""
    n = np.arange(128)
    w = 0.5 - 0.5 * np.cos(2 * np.pi * n / 128)
    sigma = bin_noise_sigma(noise_variance=3.0, window_energy=(w**2).sum())
    for k in (5, 31, 60):
        turn = 2 * np.pi * k * n / 128
        assert 3.0 * ((w * np.cos(turn)) ** 2).sum() == pytest.approx(sigma**2, rel=1e-12)
        assert 3.0 * ((w * np.sin(turn)) ** 2).sum() == pytest.approx(sigma**2, rel=1e-12)
        assert (w**2 * np.cos(turn) * np.sin(turn)).sum() == pytest.approx(0, abs=1e-12)


# Receiver


def response(frequency, detector=400e6, amplifier=200e6):
    return 7e3 * receiver_transfer_function(
        frequency, detector_bandwidth=detector, amplifier_bandwidth=amplifier
    )


def test_each_pole_takes_three_decibels_and_an_eighth_of_a_turn():
    assert response(0.0) == 7e3
    assert abs(response(200e6, detector=1e30)) == pytest.approx(7e3 / np.sqrt(2), rel=1e-12)
    assert abs(response(400e6, amplifier=1e30)) == pytest.approx(7e3 / np.sqrt(2), rel=1e-12)
    assert np.angle(response(200e6, detector=1e30)) == pytest.approx(-np.pi / 4, rel=1e-12)
    assert abs(response(400e6, amplifier=400e6)) == pytest.approx(3500.0, rel=1e-12)
    assert np.angle(response(400e6, amplifier=400e6)) == pytest.approx(-np.pi / 2, rel=1e-12)


def test_the_receiver_answers_a_step_after_it_and_never_before():
    """A causal decay: the impulse response is that of two cascaded RC stages."""
    rate, size = 64e9, 2**16
    frequency = np.fft.fftfreq(size, 1 / rate)
    impulse = np.fft.ifft(response(frequency)).real * rate
    t = np.arange(size) / rate
    a, b = 2 * np.pi * 400e6, 2 * np.pi * 200e6
    exact = 7e3 * a * b / (a - b) * (np.exp(-b * t) - np.exp(-a * t))
    assert np.abs(impulse[: size // 2] - exact[: size // 2]).max() < 0.01 * exact.max()
    assert np.abs(impulse[size // 2 :]).max() < 0.01 * exact.max()


def test_the_receiver_sees_lines_where_they_are_before_they_fold(table_4_1):
    """A 400 MHz beat folds to 200 MHz and keeps the 6 dB of 400 MHz."""
    scene = table_4_1(beamlets=1, fft_size=4096, window="rectangular")
    beat = 2731 * 600e6 / 4096  # the bin nearest to 400 MHz
    results = [
        evaluation.evaluate(scene | {"target.radial_velocity": f * 1550e-9 / 2})["snr_doppler"][0]
        for f in (600e6 - beat, beat)
    ]
    losses = [(1 + (f / 400e6) ** 2) ** 2 for f in (600e6 - beat, beat)]
    assert results[0] / results[1] == pytest.approx(losses[1] / losses[0], rel=1e-6)


@pytest.mark.parametrize("other", [400e6, 400.01e6, 130e6, 3e9])
def test_the_noises_density_is_the_sum_of_its_aliases(other):
    frequency = np.linspace(-1.2e9, 1.2e9, 97)
    aliases = frequency[:, None] + 600e6 * np.arange(-4000, 4001)
    poles = (1 + (aliases / 400e6) ** 2) * (1 + (aliases / other) ** 2)
    summed = (1 / poles).sum(axis=1) * 600e6 / (2 * min(400e6, other))
    density = receiver_chain.relative_noise_density(
        frequency, detector_bandwidth=400e6, amplifier_bandwidth=other, sample_rate=600e6
    )
    assert density == pytest.approx(summed, rel=2e-8)


def test_drawn_noise_that_passes_the_receiver_has_its_density(table_4_1):
    """White noise at 16 times the rate through both poles, sampled: per bin of 64, to 1.2 %.

    White noise would be 0.4 dB too much at DC and 1.4 dB at 193 MHz.
    """
    rng, over, n = np.random.default_rng(4), 16, 64
    high = np.fft.rfftfreq(over * n, 1 / (over * 600e6))
    gain = receiver_chain.receiver_transfer_function(
        high, detector_bandwidth=400e6, amplifier_bandwidth=400e6
    )
    power = np.zeros(n // 2 + 1)
    for _ in range(40):
        white = np.fft.rfft(rng.normal(size=(1000, over * n)), axis=1)
        record = np.fft.irfft(gain * white, axis=1)[:, ::over]
        power += (np.abs(np.fft.rfft(record, axis=1)) ** 2).mean(axis=0) / (40 * n)
    # of a density of one sample's variance over the half of the high rate, within 400 MHz
    expected = power / (400e6 / (over * 300e6))
    density = receiver_chain.relative_noise_density(
        np.fft.rfftfreq(n, 1 / 600e6), detector_bandwidth=400e6, amplifier_bandwidth=400e6,
        sample_rate=600e6,
    )  # fmt: skip
    assert density[1:-1] == pytest.approx(expected[1:-1], rel=0.025)
    assert 10 * np.log10(density[[0, 21]]) == pytest.approx([-0.4, -1.4], abs=0.05)


@pytest.mark.parametrize(
    ("constant", "name"),
    [
        (constants.SPEED_OF_LIGHT, "speed of light in vacuum"),
        (constants.ELEMENTARY_CHARGE, "elementary charge"),
        (constants.PLANCK, "Planck constant"),
        (constants.BOLTZMANN, "Boltzmann constant"),
    ],
)
def test_constants_are_those_of_the_si(constant, name):
    assert constant == scipy.constants.value(name)
