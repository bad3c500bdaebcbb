"""The filter before the ADC against scipy's, sums of aliases, and records drawn at a high rate."""

import numpy as np
import pytest
from scipy import signal

from sweep.model import evaluation, receiver_chain, time_domain_truth
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.saturation import total_beat_amplitude
from sweep.model.spectrum import permanent_line

RATE, OVER, BINS = 600e6, 16, 256
BANDWIDTH, ORDER = (f"instrument.receiver.antialias_{name}" for name in ("bandwidth", "order"))
NATURE = {
    "noise_shape": "receiver", "beamlets": 1, "window": "hann", "fft_size": BINS, "range": 30.0,
}  # fmt: skip
ADC = {"instrument.processing.bits": 6.0, "instrument.processing.full_scale": 0.03}
EVERY = (*evaluation.DEFAULT_EFFECTS, "quantisation")


def butterworth(frequency, bandwidth, order):
    """Complex response of scipy's analogue filter."""
    b, a = signal.butter(order, 2 * np.pi * bandwidth, analog=True)
    return signal.freqs(b, a, 2 * np.pi * np.asarray(frequency))[1]


def poles(frequency):
    return 1 / (1 + 1j * np.asarray(frequency) / 400e6) ** 2


def prepared(parameters):
    ((_, shots),) = evaluation.prepare_shots(parameters, EVERY)
    return shots


def filtered(bandwidth, order=6):
    return {BANDWIDTH: bandwidth, ORDER: order}


def scene_of(table_4_1, beat, **changes):
    """A target whose Doppler beat is at a frequency [Hz]."""
    return table_4_1(**NATURE, radial_velocity=beat * 1550e-9 / 2, **changes)


@pytest.mark.parametrize("order", [3, 6, 12])
def test_the_filter_is_a_butterworth_of_its_order(order):
    frequency = np.array([-450e6, -200e6, 0.0, 1e6, 150e6, 200e6, 260e6, 900e6])
    transmission = receiver_chain.antialias_power_transmission(
        frequency, antialias_bandwidth=np.array(200e6), antialias_order=np.array(order)
    )
    assert transmission == pytest.approx(
        np.abs(butterworth(frequency, 200e6, order)) ** 2, rel=1e-9
    )


@pytest.mark.parametrize(("bandwidth", "order"), [(60e6, 12), (250e6, 6), (600e6, 3)])
def test_the_noises_density_is_the_sum_of_aliases_that_pass(bandwidth, order):
    frequency = np.linspace(-1.2e9, 1.2e9, 97)
    aliases = frequency[:, None] + RATE * np.arange(-300, 301)
    passed = np.abs(poles(aliases) * butterworth(aliases, bandwidth, order)) ** 2
    density = receiver_chain.relative_noise_density(
        frequency, detector_bandwidth=400e6, amplifier_bandwidth=400e6, sample_rate=RATE,
        antialias_bandwidth=bandwidth, antialias_order=order,
    )  # fmt: skip
    expected = passed.sum(axis=1) * RATE / (2 * min(bandwidth, 400e6))
    assert density == pytest.approx(expected, rel=2e-8)


def test_without_a_filter_every_answer_is_the_same_bit_for_bit(table_4_1):
    scene = table_4_1(**NATURE | {"range": np.linspace(100.0, 9000, 40), "beamlets": 7}) | ADC
    unfiltered, none = (evaluation.evaluate(p, EVERY) for p in (scene, scene | filtered(0.0, 3)))
    for name, values in unfiltered.items():
        assert np.array_equal(values, none[name], equal_nan=True), name


def test_a_filter_far_beyond_the_poles_changes_nothing():
    """Aliases beyond the 32nd have 2 (400/600)^4 / (3 32.5^3) = 3.8e-6, of a sum of 2/3 or more."""
    parameters = {"detector_bandwidth": 400e6, "amplifier_bandwidth": 400e6, "sample_rate": RATE}
    frequency = np.linspace(0, 3e8, 31)
    wide = receiver_chain.relative_noise_density(
        frequency, **parameters, antialias_bandwidth=1e12, antialias_order=6
    )
    assert wide == pytest.approx(
        receiver_chain.relative_noise_density(frequency, **parameters), rel=6e-6
    )


def test_the_noise_that_is_left_is_that_of_the_narrowest_stage(table_4_1):
    scene = table_4_1(**NATURE)
    wide, narrow = prepared(scene), prepared(scene | filtered(100e6))
    for source, value in wide.noise.variances.items():
        assert narrow.noise.variances[source] == pytest.approx(value / 4, rel=1e-13), source


CASES = [
    pytest.param(100e6, 250e6, 6, {}, marks=pytest.mark.slow),
    pytest.param(295e6, 280e6, 4, {}, marks=pytest.mark.slow),
    (350e6, 280e6, 4, {}),  # folds to 250 MHz
    (180e6, 120e6, 6, ADC),  # in the stop band, on the ADC's own noise
]


def drawn_spectra(scene, beat, bandwidth, order, draws, seed):
    """Spectra (draws, bins) of lone noise, and of a line (bins,), through scipy's filter.

    Noise is drawn at 16 times the rate, with the density that the receiver has without a filter;
    every 16th sample is kept, and the ADC's noise added.
    """
    rng, unfiltered = np.random.default_rng(seed), prepared(scene)
    taper = signal.windows.hann(BINS, sym=False)
    noise_variance = sum(
        v for name, v in unfiltered.noise.variances.items() if name != "quantisation"
    )
    n_samples = OVER * 2 * BINS
    high = np.fft.rfftfreq(n_samples, 1 / (OVER * RATE))
    gain = poles(high) * butterworth(high, bandwidth, order)
    deviation = np.sqrt(noise_variance * (OVER * RATE / 2) / 400e6)
    spectra = []
    for _ in range(draws // 2000):
        white = rng.normal(size=(2000, n_samples)) * deviation
        record = np.fft.irfft(gain * np.fft.rfft(white), n_samples)[:, : OVER * BINS : OVER]
        rounding = np.sqrt(unfiltered.noise.variances.get("quantisation", 0.0))
        record = record + rounding * rng.normal(size=record.shape)
        spectra.append(np.fft.rfft(taper * record))
    line = (
        time_domain_truth.beamlet_analytic_signal(unfiltered, 0, 1, 0)
        / unfiltered.whitening_gain[1, 0]
    )
    line = line * butterworth([beat], bandwidth, order)[0]
    return np.concatenate(spectra), np.fft.rfft(taper * line.real)


@pytest.mark.parametrize(("beat", "bandwidth", "order", "adc"), CASES)
def test_lines_and_noise_are_those_of_drawn_records(table_4_1, beat, bandwidth, order, adc):
    """SNR of the largest bin to 6 %, and pd of a line near the threshold to 4 %: 5 sigma."""
    draws = 8_000
    scene = scene_of(table_4_1, beat, tnr=5.0) | adc
    noise, line = drawn_spectra(scene, beat, bandwidth, order, draws, seed=int(beat))
    k = np.abs(line).argmax()
    power = (np.abs(noise[:, k]) ** 2).mean()
    full = evaluation.evaluate(scene | filtered(bandwidth, order), EVERY)
    assert full["snr_doppler"][0] == pytest.approx(abs(line[k]) ** 2 / power, rel=5 / draws**0.5)
    ratio = (5.0 * np.sqrt(2 - np.pi / 2)) ** 2 / 2 / full["snr_doppler"][0]
    scene = scene | {"instrument.laser.power": ratio}
    faint = evaluation.evaluate(scene | filtered(bandwidth, order), EVERY)
    level = 5.0 * np.sqrt(2 - np.pi / 2) * np.sqrt(power / 2)
    share = np.mean(np.abs(line[k] * np.sqrt(ratio) + noise[:, k]) >= level)
    # The drawn level is off by 1 / (2 root n) of itself, which moves pd by less than its own error.
    assert 0.3 < share < 0.7
    assert faint["pd_doppler"][0] == pytest.approx(share, abs=5 * 0.5 / draws**0.5 * np.sqrt(2))


def test_the_ratio_of_noise_to_line_is_the_aliases(table_4_1):
    """At 100 MHz a filter at 250 MHz keeps out all aliases: SNR as without folding."""
    scene = scene_of(table_4_1, 100e6)
    unfiltered, clean = (
        evaluation.evaluate(p, EVERY)["snr_doppler"][0]
        for p in (scene, scene | filtered(250e6, 12))
    )
    aliases = 100e6 + RATE * np.arange(-4000, 4001)
    every = (np.abs(poles(aliases)) ** 2).sum() / np.abs(poles(100e6)) ** 2
    assert clean / unfiltered == pytest.approx(every, rel=1e-4)
    assert 10 * np.log10(every) == pytest.approx(1.05, abs=0.01)


def test_a_leaked_line_passes_the_filter_at_its_own_frequency(table_4_1):
    scene = scene_of(table_4_1, 280e6) | filtered(100e6)
    scene |= {"instrument.telescope.leak_path": 3.0, "instrument.telescope.isolation": 1e6}
    ((_, shots),) = evaluation.prepare_shots(scene, (*EVERY, "circulator_leak"))
    beat = 1e9 / 500e-6 * 3.0 / SPEED_OF_LIGHT
    aliases = beat + RATE * np.arange(-300, 301)
    density = (np.abs(poles(aliases) * butterworth(aliases, 100e6, 6)) ** 2).sum() * RATE / 2e8
    scale, _ = permanent_line.permanent_line_of_point(shots, 0, 0)
    amplitude = float(np.broadcast_to(shots.permanent_line.amplitude, 1)[0])
    assert scale == pytest.approx(amplitude / 2 / np.sqrt(density), rel=1e-6)


def test_skirts_at_an_echo_are_whitened_as_the_echo_is(table_4_1, monkeypatch):
    """Their share of it is that of a spectrum that is not whitened; a bin's density is 1 % off."""
    shares, raised = [], permanent_line.echo_magnitude_with_line

    def spectrum(magnitudes, skirts, **parameters):
        shares.append(skirts[magnitudes.argmax()] / magnitudes.max())
        return raised(magnitudes, skirts, **parameters)

    monkeypatch.setattr(permanent_line, "echo_magnitude_with_line", spectrum)
    leak = {"instrument.telescope.leak_path": 3.0, "instrument.telescope.isolation": 1e6}
    for shape in ("receiver", "white"):
        scene = scene_of(table_4_1, 280e6) | leak | {"instrument.receiver.noise_shape": shape}
        evaluation.evaluate(scene, (*EVERY, "circulator_leak"))
    receiver, white = np.array(shares).reshape(2, -1)
    assert white.size and (white > 0).all()
    assert receiver == pytest.approx(white, rel=0.01)


@pytest.mark.parametrize("at", [None, 200e6])
def test_a_leaked_line_stands_by_its_alias_in_noise(table_4_1, at):
    """At its own beat near DC, or where its skirts meet an echo; never at the echo's 280 MHz."""
    scene = scene_of(table_4_1, 280e6)
    scene |= {"instrument.telescope.leak_path": 3.0, "instrument.telescope.isolation": 1e6}
    ((_, shots),) = evaluation.prepare_shots(scene, (*EVERY, "circulator_leak"))
    beat = 1e9 / 500e-6 * 3.0 / SPEED_OF_LIGHT
    aliases = (at or beat) + RATE * np.arange(-4000, 4001)
    density = (np.abs(poles(aliases)) ** 2).sum() * RATE / 8e8
    scale, _ = permanent_line.permanent_line_of_point(shots, 0, 0, at)
    amplitude = float(np.broadcast_to(shots.permanent_line.amplitude, 1)[0])
    assert scale == pytest.approx(amplitude / 2 / np.sqrt(density), rel=1e-4)


def test_the_adc_sees_what_the_filter_leaves(table_4_1):
    """In the segment that passes best: the up-chirp, at the Doppler shift less the range's beat."""
    scene = scene_of(table_4_1, 50e6) | {"target.range": 2000.0}
    beat = 50e6 - 1e9 / 500e-6 * 2 * 2000.0 / SPEED_OF_LIGHT
    unfiltered, narrow = (
        total_beat_amplitude(prepared(p))[0] for p in (scene, scene | filtered(10e6, 3))
    )
    assert narrow / unfiltered == pytest.approx(abs(butterworth([beat], 10e6, 3)[0]), rel=1e-5)


def test_the_adc_sees_no_segment_that_the_waveform_lacks(table_4_1):
    """A Doppler beat at DC would pass a filter whole that the chirps' 16 MHz do not."""
    scene = table_4_1(**NATURE, radial_velocity=0.0) | {"target.range": 1200.0}
    scene |= filtered(10e6, 3)
    chirps = scene | {"instrument.chirp.segments": "up down"}
    with_doppler, without = (total_beat_amplitude(prepared(p))[0] for p in (scene, chirps))
    beat = 1e9 / 500e-6 * 2 * 1200.0 / SPEED_OF_LIGHT
    passed = abs(butterworth([beat], 10e6, 3)[0] * poles(beat))
    assert without / with_doppler == pytest.approx(passed, rel=1e-5)
