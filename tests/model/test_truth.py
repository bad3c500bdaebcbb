"""The time-domain truth against closed forms and optical fields; the fast path against it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.constants import c as speed_of_light
from shot_helpers import magnitude_error, parametrize_product, prepare_single_category

from sweep.model import time_domain_truth
from sweep.model.shot_records import EchoRecord
from sweep.model.spectrum import segment_spectra
from sweep.model.window import window_samples

AGREEMENT = 1e-9
"""Largest difference between fast path and truth, all bins; as of :func:`engine.difference`."""

WINDOWS = (
    "rectangular", "hann", "hamming", "blackman", "nuttall", "blackmanharris", "flattop",
    "kaiser(8.6)", "chebwin(100)", "dpss(3)", "gaussian(200)", "tukey(0.3)", "bartlett", "parzen",
    "bohman", "cosine", "barthann",
)  # fmt: skip
ARCHITECTURES = ("homodyne", "heterodyne", "direct")
BATCHES, BATCH = 12, 18


def drawn_scene(number):
    """Scene of this number: continuous parameters drawn, categories so that all are met."""
    rng = np.random.default_rng((20, number))

    def either(*values):
        return values[rng.integers(len(values))]

    return {
        "architecture": ARCHITECTURES[number % 3],
        "window": WINDOWS[number % len(WINDOWS)],
        "phases": either("coherent", "incoherent"),
        "reflectance_law": either("thesis", "lambert"),
        "beamlets": either(1, 2, 3, 19, 109, 300, int(rng.integers(1, 301))),
        "fft_size": either(1000, 1023, 1024, 2048, 2187, 3001, 4096, 8192, 16384),
        "range": 10 ** rng.uniform(0, 4),
        "grazing_angle": np.radians(either(1, 45, 90, *rng.uniform(1, 90, 3))),
        "beam_divergence": 10 ** rng.uniform(-6, np.log10(5e-3)),
        "radial_velocity": either(0.0, *rng.uniform(-160, 160, 2), *rng.uniform(-400, 400, 2)),
        "wavelength": either(905e-9, 1064e-9, 1550e-9, 10.6e-6),
        "sample_rate": either(20e6, 250e6, 600e6, 600e6),
        "bandwidth": either(1e8, 1e9, 4e9),
        "duration": either(100e-6, 500e-6),
        "acquisition_delay": either(0.0, 0.0, 70e-6, 99e-6),
        "detector_bandwidth": 10 ** rng.uniform(7, 10),
        "amplifier_bandwidth": 10 ** rng.uniform(7, 10),
    }


def disagreement(shots):
    """Of the fast path and the truth, over all segments and all bins 0..N/2."""
    worst = 0.0
    for segment in np.flatnonzero(shots.has_segment):
        bins, fast = segment_spectra.segment_spectrum(shots, 0, int(segment))
        exact = time_domain_truth.time_domain_spectrum(
            shots, 0, int(segment), with_range_walk=False
        )
        assert np.array_equal(bins, np.arange(shots.fft_size // 2 + 1))
        worst = max(worst, magnitude_error(shots, fast, exact))
    return worst


@pytest.mark.parametrize(
    "batch", [pytest.param(b, marks=[pytest.mark.slow] * (b % 6 > 0)) for b in range(BATCHES)]
)
def test_the_fast_path_is_the_truth_over_the_whole_range_of_every_parameter(batch, table_4_1):
    for scene in map(drawn_scene, range(batch * BATCH, (batch + 1) * BATCH)):
        assert disagreement(prepare_single_category(table_4_1(**scene))) < AGREEMENT, scene


def velocity_for(frequency, *, sign, parameters):
    """Radial velocity that puts a segment's beat exactly on a frequency."""
    carrier = speed_of_light / parameters["instrument.laser.wavelength"]
    carrier += parameters["instrument.chirp.bandwidth"] * (sign < 0)
    rate = parameters["instrument.chirp.bandwidth"] / parameters["instrument.chirp.duration"]
    range_beat = sign * rate * 2 * parameters["target.range"] / speed_of_light
    return (frequency + range_beat) / (carrier - range_beat) * speed_of_light / 2


@pytest.mark.parametrize(
    ("window", "phases", "fft_size"),
    parametrize_product(
        5, ["rectangular", "hamming", "chebwin(80)"], ["coherent", "incoherent"], [1024, 625]
    ),
)
def test_the_fast_path_is_the_truth_with_beats_at_dc_and_at_nyquist(
    window, phases, fft_size, table_4_1
):
    for beamlets, grazing_angle in ((1, np.pi / 2), (109, 1.0)):
        scene = table_4_1(
            window=window, phases=phases, fft_size=fft_size, beamlets=beamlets, range=3210.0,
            grazing_angle=grazing_angle,
        )  # fmt: skip
        for sign in (1, 0, -1):
            for frequency in (0.0, 300e6, -300e6, 600e6):
                v = velocity_for(frequency, sign=sign, parameters=scene)
                shots = prepare_single_category(scene | {"target.radial_velocity": v})
                assert disagreement(shots) < AGREEMENT


@pytest.mark.parametrize(
    "changes",
    [
        {"range": 9876.5, "grazing_angle": 0.3, "window": "hann"},
        {"range": 3.0, "grazing_angle": 0.02, "phases": "incoherent", "beamlets": 19},
        pytest.param({"range": 10e3, "grazing_angle": np.pi / 2}, marks=pytest.mark.slow),
        pytest.param({"fft_size": 2**18, "window": "nuttall"}, marks=pytest.mark.slow),
        pytest.param({"fft_size": 2**19, "phases": "incoherent"}, marks=pytest.mark.slow),
        pytest.param({"window": "kaiser(6)", "grazing_angle": 0.2}, marks=pytest.mark.slow),
    ],
)
def test_the_fast_path_is_the_truth_at_the_published_fft_sizes(changes, table_4_1):
    assert disagreement(prepare_single_category(table_4_1(**changes))) < AGREEMENT


def test_the_fast_path_is_the_truth_where_each_beamlet_has_a_doppler_shift_of_its_own(table_4_1):
    """Shifts of up to 1.5 m/s: a line's width of bins at 2^13, in phase and in place."""
    rng = np.random.default_rng(21)
    for phases, v in (("coherent", 150.0), ("incoherent", 150.0), ("coherent", 0.0)):
        scene = table_4_1(fft_size=8192, phases=phases, radial_velocity=v, grazing_angle=0.4)
        shots = prepare_single_category(scene | {"footprint.beamlets": 19, "target.range": 9000.0})
        perturbed_shots = replace(
            shots,
            footprint=shots.footprint._replace(
                doppler_ratio_offset=rng.uniform(
                    -1e-8, 1e-8, shots.footprint.relative_range_offset.shape
                )
            ),
        )
        assert disagreement(perturbed_shots) < AGREEMENT
        _, with_shifts = segment_spectra.segment_spectrum(perturbed_shots, 0, 1)
        _, without = segment_spectra.segment_spectrum(shots, 0, 1)
        assert np.abs(with_shifts - without).max() > 0.01 * without.max()


# The truth itself


ONE_WAY = {
    "beamlets": 1, "fft_size": 4096, "detector_bandwidth": 1e30, "amplifier_bandwidth": 1e30,
}  # fmt: skip
"""A single beamlet seen by a receiver without poles."""


@pytest.mark.parametrize("segment, sign", [(0, 1), (1, 0), (2, -1)])
@pytest.mark.parametrize("v", [150.0, -40.0, 0.0])
@pytest.mark.parametrize(
    "architecture, start",
    [("homodyne", speed_of_light / 1550e-9), ("heterodyne", speed_of_light / 1550e-9),
     ("direct", 5.5e9)],
)  # fmt: skip
def test_the_frequency_of_the_record_is_that_of_the_delayed_chirp_less_the_chirp(
    segment, sign, v, architecture, start, table_4_1
):
    """Derivative of the unwrapped phase against (f + s S (t - tau)) (1 - tau') - (f + s S t)."""
    shots = prepare_single_category(
        table_4_1(**ONE_WAY, radial_velocity=v, acquisition_delay=5e-6, architecture=architecture)
    )
    rate, f = 1e9 / 500e-6, start + 1e9 * (sign < 0)
    t = 5e-6 + (np.arange(4095) + 0.5) / 600e6
    delay = 2 * (2000.0 - v * t) / speed_of_light
    received_less_sent = f * 2 * v / speed_of_light + sign * rate * (
        -delay + (t - delay) * 2 * v / speed_of_light
    )
    record = time_domain_truth.beamlet_analytic_signal(shots, 0, segment, 0)
    measured = np.diff(np.unwrap(np.angle(record))) * 600e6 / (2 * np.pi)
    # Rounding: 1e-11 cycles a sample; the walk is 8 v/300 Hz a sample and 4 kHz v/150 in all.
    assert np.abs(measured - received_less_sent).max() < 0.05
    steady = time_domain_truth.beamlet_analytic_signal(shots, 0, segment, 0, with_range_walk=False)
    measured = np.diff(np.unwrap(np.angle(steady))) * 600e6 / (2 * np.pi)
    at_start = f * 2 * v / speed_of_light - sign * rate * 2 * 2000.0 / speed_of_light * (
        1 + 2 * v / speed_of_light
    )
    assert np.abs(measured - at_start).max() < 0.05


@pytest.mark.parametrize("segment, sign", [(0, 1), (1, 0), (2, -1)])
def test_the_record_is_what_a_balanced_detector_makes_of_two_optical_fields(
    segment, sign, table_4_1
):
    """Fields of a 2 GHz carrier, where float64 holds the optical phase itself."""
    carrier, v, start = 2e9, 3000.0, 12e-6
    scene = table_4_1(
        **ONE_WAY, wavelength=speed_of_light / carrier, radial_velocity=v, power=2.0,
        acquisition_delay=start, mixing_efficiency=0.5, apd_gain=3.0, range=700.0,
    )  # fmt: skip
    first = carrier + 1e9 * (sign < 0)
    t = start + np.arange(4096) / 600e6
    delay = 2 * (700.0 - v * t) / speed_of_light

    def field(power, time):
        return np.sqrt(power) * np.exp(2j * np.pi * (first * time + sign * 2e12 * time**2 / 2))

    echo = 2.0 * 0.1 * np.pi * 0.0125**2 / (2 * np.pi * 700.0**2)
    oscillator, received = field(1e-3, t), np.sqrt(0.5) * field(echo, t - delay)
    one, other = (oscillator + received) / np.sqrt(2), (oscillator - received) / np.sqrt(2)
    voltage = 7e3 * 1.1 * 3.0 * (np.abs(one) ** 2 - np.abs(other) ** 2)
    record = time_domain_truth.beamlet_analytic_signal(
        prepare_single_category(scene), 0, segment, 0
    ).real
    # Phases of 2e9 t + 1e12 t^2 < 1e5 cycles round to 1e-11; powers of 1e-3 W to 1e-19 W, against
    # a beat of sqrt(1e-3 echo) = 2e-7 W.
    assert np.abs(record - voltage).max() < 1e-8 * np.abs(voltage).max()


@pytest.mark.parametrize(
    "window, loss_db", [("rectangular", 3.92), ("hann", 1.42), ("hamming", 1.75)]
)
def test_a_tone_stands_at_half_its_amplitude_times_the_windows_sum(window, loss_db, table_4_1):
    """On a bin; half-way to the next it is lower by the textbook scalloping loss."""
    scene = table_4_1(**ONE_WAY, window=window)
    echo = 0.1 * np.pi * 0.0125**2 / (2 * np.pi * 2000.0**2)
    amplitude = 2 * 1.1 * np.sqrt(1e-3 * echo) * 7e3
    mean_weight = {"rectangular": 1.0, "hann": 0.5, "hamming": 0.54}[window]
    heights = []
    for bins in (1000.0, 1000.5):
        v = velocity_for(bins * 600e6 / 4096, sign=0, parameters=scene)
        shots = prepare_single_category(scene | {"target.radial_velocity": v})
        magnitude = time_domain_truth.time_domain_spectrum(shots, 0, 1, with_range_walk=False)
        heights.append(magnitude[1000])
        if bins == 1000.0:
            assert np.argmax(magnitude) == 1000
        else:  # the image, at -1000.5, is 5e-4 or less of the line
            assert magnitude[1001] == pytest.approx(magnitude[1000], rel=1e-3)
    assert heights[0] == pytest.approx(amplitude * 4096 * mean_weight / 2, rel=1e-9)
    assert 20 * np.log10(heights[0] / heights[1]) == pytest.approx(loss_db, abs=0.0055)


def test_incoherent_truth_is_the_root_mean_square_over_independent_phases(table_4_1):
    """Three beamlets, each phase over five equal steps: the mean of a product of two is exact.

    The line is brought next to DC so that its image takes part.
    """
    scene = table_4_1(
        beamlets=3, fft_size=512, range=40.0, radial_velocity=0.6, grazing_angle=0.05,
        beam_divergence=4e-3, window="hamming",
    )  # fmt: skip
    shots = prepare_single_category(scene | {"footprint.phases": "incoherent"})
    weights = 0.54 - 0.46 * np.cos(2 * np.pi * np.arange(512) / 512)
    for segment in range(3):
        records = [
            time_domain_truth.beamlet_analytic_signal(shots, 0, segment, b) for b in range(3)
        ]
        power = np.zeros(257)
        for steps in np.ndindex(5, 5, 5):
            turned = sum(
                r * np.exp(2j * np.pi * s / 5) for r, s in zip(records, steps, strict=True)
            )
            power += np.abs(np.fft.rfft(weights * turned.real)) ** 2 / 125
        exact = time_domain_truth.time_domain_spectrum(shots, 0, segment)
        assert np.abs(np.sqrt(power) - exact).max() < 1e-12 * exact.max()


@pytest.mark.parametrize("velocity", [-40.0, 0.02, 90.0])
@pytest.mark.parametrize("window", ["hann", "kaiser(8.6)"])
@pytest.mark.parametrize("phases", ["coherent", "incoherent"])
def test_a_complex_record_has_signed_bins_and_no_images(table_4_1, phases, window, velocity):
    """Against the FFT of the beamlets' analytic records, all N bins; peaks keep their sign."""
    scene = table_4_1(
        window=window, phases=phases, fft_size=4096, beamlets=7, range=30.0,
        radial_velocity=velocity,
    )  # fmt: skip
    shots = prepare_single_category(scene)
    record = replace(shots.record, is_complex=True)
    shots = replace(shots, record=record, echo_record=EchoRecord())
    w, half = window_samples(window, 4096), 2048
    evaluated = segment_spectra.evaluate_segments(shots)
    for segment in range(3):
        records = [
            time_domain_truth.beamlet_analytic_signal(shots, 0, segment, b, with_range_walk=False)
            for b in range(7)
        ]
        spectra = np.fft.fft(w * np.array(records)) / 2
        coherent = abs(spectra.sum(axis=0))
        exact = coherent if phases == "coherent" else np.sqrt((abs(spectra) ** 2).sum(axis=0))
        bins, magnitude = segment_spectra.segment_spectrum(shots, 0, segment)
        assert bins.size == 4096
        assert magnitude_error(shots, magnitude, exact[bins % 4096]) <= AGREEMENT
        peak = (exact.argmax() + half) % 4096 - half
        assert evaluated.frequency[segment, 0] == peak * shots.sample_rate / 4096
