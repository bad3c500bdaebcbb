"""Detection by any bin of an echo, and false alarms: closed forms against drawn records.

`Instrument.drawn` makes records sample by sample (white noise at eight times the rate through the
receiver's poles, the exact delay's beat), and shares nothing with the closed forms but the link
budget. Further effects join where it makes its records.
"""

import math
from typing import NamedTuple

import numpy as np
import pytest
from shot_helpers import parametrize_product

from sweep.model import evaluation, receiver_chain, time_domain_truth
from sweep.model.detection.bin_noise import (
    first_circular_bin,
    neighbour_noise_correlation,
)
from sweep.model.detection.detectors import main_lobe_half_width
from sweep.model.detection.echo_detection import (
    BinSpeckle,
    BinThreshold,
    DetectionRule,
    EchoBins,
    mark_exempt_bins,
    pd_and_miss,
)
from sweep.model.detection.joint_tail import joint_tail_quadrature
from sweep.model.detection.speckle_modes import mode_table
from sweep.model.sampling import philox
from sweep.model.sampling.samplers import simulate_draws
from sweep.model.window import get_window, window_samples

OVER, DRAWS = 8, 6_000
NATURE = {"noise_bins": "correlated", "detection": "any_bin", "noise_shape": "receiver"}


class Instrument(NamedTuple):
    """A prepared shot and its parameters."""

    parameters: dict
    shots: evaluation.Shots

    @classmethod
    def of(cls, parameters, effects=evaluation.DEFAULT_EFFECTS):
        ((_, shots),) = evaluation.prepare_shots(parameters, effects)
        return cls(parameters, shots)

    @property
    def size(self):
        return self.shots.fft_size

    def noise(self, draws, rng):
        """Noise (draws, L) in the record: white within the bandwidth, through H, sampled."""
        shots, length = self.shots, self.shots.window.length
        rate = float(shots.sample_rate[0])
        poles = {
            "detector_bandwidth": shots.receiver_filter.detector_bandwidth,
            "amplifier_bandwidth": shots.receiver_filter.amplifier_bandwidth,
        }
        # enough samples that what a transform's circle brings back is far from the record
        n_samples = OVER * (length + 64)
        high = np.fft.rfftfreq(n_samples, 1 / (OVER * rate))
        gain = receiver_chain.receiver_transfer_function(high, **poles)
        within = receiver_chain.electrical_bandwidth(poles) / (OVER * rate / 2)
        white = rng.normal(size=(draws, n_samples)) * np.sqrt(shots.noise_variance[0] / within)
        return np.fft.irfft(gain * np.fft.rfft(white, axis=1), axis=1)[:, : OVER * length : OVER]

    def spectra(self, records):
        """|X| of records, in every bin over the noise's density there."""
        shots = self.shots
        taper = window_samples(shots.window.name, shots.window.length)
        density = receiver_chain.relative_noise_density(
            np.fft.rfftfreq(self.size, 1 / shots.sample_rate[0]),
            detector_bandwidth=shots.receiver_filter.detector_bandwidth,
            amplifier_bandwidth=shots.receiver_filter.amplifier_bandwidth,
            sample_rate=shots.sample_rate[0],
        )
        return np.abs(np.fft.rfft(taper * records, self.size, axis=-1)) / np.sqrt(density)

    def drawn(self, seed):
        """Shares of draws in which the echo is detected, and in which another bin alarms.

        (3,) of up, down and both; (2,) of up and down. In developed speckle each beamlet has a
        random complex amplitude, one for all segments. A footprint of one beamlet has amplitudes
        that correlate between segments as those of its scatterers do; drawn scatterers test that
        correlation (`tests/validate_speckle.py`).
        """
        shots, rng = self.shots, np.random.default_rng(seed)
        lines, level = shots.footprint.n_beamlets, float(shots.threshold[0])
        lobe = int(np.ceil(main_lobe_half_width(shots.window) * self.size / shots.window.length))
        edge = first_circular_bin(shots.window, self.size)
        speckle = np.ones((DRAWS, lines), complex)
        if shots.speckle.segment_correlations is not None:
            speckle, of_down_alone = rng.normal(size=(2, DRAWS, lines, 2)) @ [1, 1j] / np.sqrt(2)
        spectra, alarms = [], []
        for segment in (0, 2):
            if segment == 2 and lines == 1 and shots.speckle.segment_correlations is not None:
                shared = abs(shots.speckle.segment_correlations.up_down[0])
                speckle = shared * speckle + np.sqrt(1 - shared**2) * of_down_alone
            beats = np.array(
                [time_domain_truth.beamlet_analytic_signal(shots, 0, segment, b)
                 for b in range(lines)]
            ) / shots.whitening_gain[segment, 0]  # fmt: skip
            signal = np.sqrt((self.spectra(beats.real) ** 2).sum(axis=0))
            echo = np.zeros(signal.size, bool)
            for k in np.flatnonzero((signal >= signal.max() / 2) & (signal > 0)):
                echo[max(k - lobe, 0) : k + lobe + 1] = True
            for k in np.flatnonzero(signal >= level):
                echo[max(k - 1, 0) : k + 2] = True
            searched = ~echo
            searched[:edge] = searched[signal.size - edge :] = False
            above = []
            for first in range(0, DRAWS, 2000):
                speckle_part = speckle[first : first + 2000]
                records = (speckle_part @ beats).real + self.noise(len(speckle_part), rng)
                above.append(self.spectra(records) >= level)
            above = np.concatenate(above)
            spectra.append(above[:, echo].any(axis=1))
            alarms.append(above[:, searched].any(axis=1))
        spectra.append(spectra[0] & spectra[1])
        return np.mean(spectra, axis=1), np.mean(alarms, axis=1)


def spread(p):
    return 5 * np.sqrt(max(p * (1 - p), 1e-3) / DRAWS)


def random_scene(table_4_1, seed):
    """Parameters and effects: an echo neither sure nor lost, off DC by a main lobe.

    Every other one is in developed speckle; every third beam has several lines.
    """
    rng = np.random.default_rng((71, seed))
    window = ("hamming", "hann", "blackman", "rectangular", "flattop")[seed % 5]
    length, size = (256, 256) if seed % 2 else (128, 256)
    fades = seed % 6 in (1, 2, 5)
    scene = table_4_1(
        **NATURE, window=window, fft_size=size, beamlets=7 if seed % 3 == 2 else 1,
        phases="incoherent" if fades else "coherent", tnr=rng.uniform(5, 8),
        range=rng.uniform(1000, 4000), radial_velocity=rng.uniform(1, 5), leakage_floor=0.0,
        acquisition_delay=500e-6 - length / 600e6,
        detector_bandwidth=rng.uniform(150e6, 600e6), amplifier_bandwidth=rng.uniform(150e6, 600e6),
    )  # fmt: skip
    scene["target.acceleration"] = rng.uniform(-15, 15)
    scene["target.transverse_velocity"] = rng.uniform(0, 8)
    effects = {*evaluation.DEFAULT_EFFECTS, "segment_motion", *(["fading"] if fades else [])}
    faint = evaluation.evaluate(scene | {"instrument.laser.power": 1e-6}, effects)
    snr = 1e6 * faint["snr_up"][0]
    mean_power = (scene["instrument.processing.tnr"] * 0.655 + rng.uniform(-1, 1)) ** 2 / 2
    mean_power *= rng.uniform(1, 4) if fades else 1
    return scene | {"instrument.laser.power": mean_power / snr}, effects


@pytest.mark.parametrize(
    "seed", [*range(4), *(pytest.param(k, marks=pytest.mark.slow) for k in range(4, 30))]
)
def test_drawn_records_detect_and_alarm_as_often_as_the_closed_forms(table_4_1, seed):
    """Noise through H(f), windowed; speckle, motion between segments, any bin of the echo.

    The rule for neighbours' joint chances is good to 0.005 for lone lines, and to 0.015 (0.1 for
    rectangular windows) in speckle.
    """
    scene, effects = random_scene(table_4_1, seed)
    instrument, outputs = Instrument.of(scene, effects), evaluation.evaluate(scene, effects)
    pd, alarm = instrument.drawn(seed)
    rule = 0.005
    if "fading" in effects:
        rule = 0.015
    for name, drawn in zip(("up", "down", "shot"), pd, strict=True):
        assert 0.01 < drawn < 0.99
        assert outputs[f"pd_{name}"][0] == pytest.approx(drawn, abs=rule + spread(drawn)), name
    for name, drawn in zip(("up", "down"), alarm, strict=True):
        leaks = outputs[f"p_leakage_{name}"][0]
        expected = 1 - (1 - outputs["pfa_segment"][0]) * (1 - leaks)
        assert expected == pytest.approx(drawn, abs=0.04 * drawn + spread(drawn)), name


@pytest.mark.parametrize(("tnr", "snr", "excess_max"), [(2.5, 4.0, 0.03), (4.5, 8.0, 0.02)])
def test_both_chirps_in_common_speckle_are_overrated_at_low_thresholds(
    table_4_1, tnr, snr, excess_max
):
    """By no more than docs/physics.md says: noise in an echo's other bins counts as its fading."""
    scene = table_4_1(
        **NATURE, window="hamming", fft_size=256, beamlets=1, phases="incoherent", tnr=tnr,
        range=2000.0, radial_velocity=3.0, leakage_floor=0.0,
        acquisition_delay=500e-6 - 256 / 600e6,
    )  # fmt: skip
    effects = {*evaluation.DEFAULT_EFFECTS, "fading"}
    faint = evaluation.evaluate(scene | {"instrument.laser.power": 1e-6}, effects)
    scene["instrument.laser.power"] = snr / (1e6 * faint["snr_up"][0])
    pd, _ = Instrument.of(scene, effects).drawn(seed=1)
    outputs = evaluation.evaluate(scene, effects)
    for name, drawn in zip(("up", "down"), pd, strict=False):
        assert outputs[f"pd_{name}"][0] == pytest.approx(drawn, abs=0.005 + spread(drawn)), name
    assert -spread(pd[2]) < outputs["pd_shot"][0] - pd[2] < excess_max + spread(pd[2])


@pytest.mark.parametrize(
    ("name", "place", "snr"),
    parametrize_product(
        4, ["rectangular", "hann", "hamming"], [100.0, 100.25, 100.475], [40, 143, 1000]
    ),
)
def test_sidelobes_of_a_fading_line_fade_with_it(name, place, snr):
    """One line in speckle: sidelobes that cross raise pd no further. Drawn, bin by bin."""
    size, draws, level = 256, 20_000, 3.9
    shape, w = get_window(name, size), window_samples(name, size)
    line = np.exp(2j * np.pi * place * np.arange(size) / size)
    spectrum = np.fft.fft(w * line)[70:131]
    spectrum *= np.sqrt(2 * snr) / abs(spectrum).max()  # over the noise per quadrature
    magnitude, echo = abs(spectrum), np.zeros(61, bool)
    half_width = math.ceil(main_lobe_half_width(shape))
    mark_exempt_bins(magnitude, 61, level, echo, half_width)
    rule = DetectionRule(
        True,
        half_width,
        False,
        size,
        True,
        neighbour_noise_correlation(shape, size),
        False,
        joint_tail_quadrature(0.0),
        np.empty(0),
        mode_table(shape, size),
    )
    speckle, levels = BinSpeckle(0.0, np.empty(0)), BinThreshold(1.0, level, 1.0, 1.0)
    pd, _ = pd_and_miss(
        EchoBins(magnitude, echo, 70), int(magnitude.argmax()), rule, levels, speckle
    )
    rng, n_alarms = np.random.default_rng(int(10 * place) + snr), 0
    for _ in range(draws // 2000):
        noise = rng.normal(size=(2000, size, 2)) @ np.array([1, 1j])
        noise = np.fft.fft(noise * w, axis=1)[:, 70:131] / np.sqrt((w**2).sum())
        speckle = (rng.normal(size=(2000, 2)) @ np.array([1, 1j])) / np.sqrt(2)
        crosses = abs(noise + speckle[:, None] * spectrum) >= level
        n_alarms += crosses[:, echo].any(axis=1).sum()
    drawn = n_alarms / draws
    assert pd == pytest.approx(drawn, abs=0.004 + 5 * np.sqrt(drawn * (1 - drawn) / draws))


def test_an_echo_without_light_is_found_as_often_as_its_bins_alarm(table_4_1):
    """Five bins beside each other of a Hamming window: pd goes over into pfa."""
    scene = table_4_1(**NATURE, reflectance=1e-12, beamlets=1, fft_size=4096, tnr=6.0)
    shots, outputs = Instrument.of(scene).shots, evaluation.evaluate(scene)
    occupied = evaluation.evaluate_segments(shots).n_exempt[0, 0]
    per_bin = -np.log1p(-outputs["pfa_segment"][0]) / (2045 - occupied)
    assert outputs["pd_up"][0] == pytest.approx(occupied * per_bin, rel=0.1)
    assert 5 <= occupied <= 7


@pytest.mark.parametrize("method", ["probabilities", "noise"])
@pytest.mark.parametrize("independent", [False, True])
def test_an_echo_over_many_bins_is_detected_by_any_of_them(table_4_1, method, independent):
    changes = {"noise_bins": "independent"} if independent else {}
    scene = table_4_1(
        **(NATURE | changes), range=9000.0 + 0.17 * np.arange(2), grazing_angle=np.radians(10),
        phases="incoherent",
    )  # fmt: skip
    outputs = evaluation.evaluate(scene)
    peak = evaluation.evaluate(scene | {"instrument.processing.detection": "peak_bin"})
    assert (outputs["pd_up"] > peak["pd_up"] + 0.1).all()
    keys = philox.point_keys(np.arange(2.0)[:, None], domain="tests", seed=3)
    counts = simulate_draws(
        scene, evaluation.DEFAULT_EFFECTS, keys=keys, batch_sizes=[DRAWS], method=method
    )
    for name in ("up", "down", "shot"):
        drawn = counts[f"n_detected_{name}"][:, 0] / DRAWS
        assert drawn == pytest.approx(outputs[f"pd_{name}"], abs=0.01 + spread(0.5)), name
