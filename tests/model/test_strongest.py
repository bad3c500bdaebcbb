"""The strongest peak alone: chances that it is right, wrong or none, held against drawn records."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate, stats
from shot_helpers import DRAWS, is_within_5_sigma, parametrize_product, prepare_single_category

from sweep.model import time_domain_truth
from sweep.model.detection import bin_noise
from sweep.model.detection.echo_detection import SegmentCorrelations
from sweep.model.detection.marcum import marcum_q1
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.evaluation import evaluate, evaluate_segments, shot_statistics
from sweep.model.outputs import STRONGEST_PEAK_OUTPUTS
from sweep.model.waveform import REPORTED_PEAKS_PATH, SEARCH_BAND_PATHS, STRONGEST_PEAK
from sweep.model.window import window_samples

RECORD = "instrument.receiver.record"
SIZE = 1024
SMALL = {
    "fft_size": SIZE, "duration": 2e-6, "bandwidth": 100e6, "tnr": 4.0, "power": 0.01,
    "range": 220.0, "radial_velocity": 3.0, "beamlets": 1, "detection": "any_bin",
    "noise_bins": "correlated",
}  # fmt: skip
FADING = (*DEFAULT_EFFECTS, "fading")
WITHOUT_LEAKAGE = tuple(effect for effect in FADING if effect != "leakage")


def scene_of(table_4_1, speckle="none", record="real", peaks=STRONGEST_PEAK, **changes):
    """A short record in which the echo is faint, with one beamlet, whose speckle is shared."""
    scene = table_4_1(**(SMALL | changes))
    mixed = {"footprint.phases": "incoherent", "footprint.speckle": speckle}
    return scene | {RECORD: record, REPORTED_PEAKS_PATH: peaks} | mixed


def spectra(shots, segment, echo, rng):
    """|X| of records: the exact echo times a factor of each, and white noise sampled with it."""
    length = shots.window.length
    shape = echo.size, length
    taper, sigma = window_samples(shots.window.name, length), np.sqrt(shots.noise_variance[0])
    signal = echo[:, None] * time_domain_truth.beamlet_analytic_signal(
        shots, 0, segment, 0, with_range_walk=False
    )
    if shots.complex_record:
        noise = np.sqrt(0.5) * (rng.normal(size=shape) + 1j * rng.normal(size=shape))
        return np.abs(np.fft.fft(taper * (signal / 2 + sigma * noise), SIZE))
    return np.abs(np.fft.rfft(taper * (signal.real + sigma * rng.normal(size=shape)), SIZE))


def reported(shots, segment, echo, rng):
    """Count a segment's draws: (right, wrong), bool by draw."""
    place = time_domain_truth.evaluate_segments_in_time_domain(shots).frequency[segment, 0] / (
        600e6 / SIZE
    )
    magnitude = spectra(shots, segment, echo, rng)
    bins = np.arange(magnitude.shape[1])
    near = np.abs((bins - place + SIZE / 2) % SIZE - SIZE / 2) <= 2.01  # a main lobe
    searched = np.ones(bins.size, bool)
    if not shots.complex_record:
        first = bin_noise.first_circular_bin(shots.window, SIZE)
        searched = (bins >= first) & (bins <= SIZE // 2 - first)
    band = shots.detection_settings.search_band
    if band is not None:
        searched &= (bins - band.first_bin[segment, 0]) % SIZE < band.n_bins[segment, 0]
    if shots.detection_settings.echo_bin_rule == "peak_bin":
        echo_magnitude = magnitude[:, int(np.rint(place)) % SIZE]
    else:
        echo_magnitude = magnitude[:, near & searched].max(axis=1)
    other = magnitude[:, ~near & searched].max(axis=1)
    level = shots.threshold[0]
    return (echo_magnitude >= level) & (echo_magnitude > other), (other >= level) & (
        other >= echo_magnitude
    )


def speckle_of(kind, rng):
    """Complex factors of an echo's amplitude, of mean power 1."""
    if kind == "none":
        return np.ones(DRAWS)
    return np.sqrt(0.5) * (rng.normal(size=DRAWS) + 1j * rng.normal(size=DRAWS))


def shares(shots, correlation):
    """Shots whose segments share so much of their speckle."""
    fading = SegmentCorrelations(*(correlation * one for one in shots.speckle.segment_correlations))
    return replace(shots, speckle=shots.speckle._replace(segment_correlations=fading))


@pytest.mark.parametrize(
    ("tnr", "detection", "correlation", "record"),
    parametrize_product(
        5, [2.5, 4.5], ["any_bin", "peak_bin"], [None, 1.0, 0.7], ["real", "complex"]
    ),
)
def test_drawn_records_whose_largest_bin_is_reported(
    tnr, detection, correlation, record, table_4_1
):
    """At TNR 2.5 noise nearly always alarms, at 4.5 hardly ever. Segments share their speckle."""
    speckle = "none" if correlation is None else "developed"
    changes = {"tnr": tnr, "detection": detection}
    shots = prepare_single_category(scene_of(table_4_1, speckle, record, **changes), FADING)
    shots = shots if correlation is None else shares(shots, correlation)
    statistics, rng, pair_shares = shot_statistics(shots), np.random.default_rng(71), []
    first, second = (speckle_of(speckle, rng) for _ in range(2))
    share = 1.0 if correlation is None else correlation
    for segment, name, decorrelation in ((0, "up", 0.0), (2, "down", np.sqrt(1 - share**2))):
        echo = (share if decorrelation else 1.0) * first + decorrelation * second
        right, wrong = reported(shots, segment, echo, rng)
        pair_shares.append((right, wrong))
        assert 0.1 < statistics[f"pd_{name}"][0] < 0.97
        assert is_within_5_sigma(right.sum(), statistics[f"pd_{name}"][0], 0.005 * DRAWS)
        assert is_within_5_sigma(wrong.sum(), statistics[f"p_wrong_range_{name}"][0], 0.003 * DRAWS)
    (up, up_wrong), (down, down_wrong) = pair_shares
    assert is_within_5_sigma((up & down).sum(), statistics["pd_shot"][0], 0.007 * DRAWS)
    spoilt = (up | up_wrong) & (down | down_wrong) & ~(up & down)
    assert is_within_5_sigma(spoilt.sum(), statistics["p_wrong_range_shot"][0], 0.006 * DRAWS)
    if tnr == 2.5:
        assert statistics["p_wrong_range_up"][0] > 0.02


@pytest.mark.parametrize("speckle", ["none", "developed"])
def test_drawn_records_that_are_searched_in_a_band(speckle, table_4_1):
    band = dict(zip(SEARCH_BAND_PATHS, (160.0, 240.0, 2.0, 4.0), strict=True))
    scene = scene_of(table_4_1, speckle, tnr=2.5) | band
    shots, outputs = prepare_single_category(scene, FADING), evaluate(scene, FADING)
    rng = np.random.default_rng(72)
    right, wrong = reported(shots, 0, speckle_of(speckle, rng), rng)
    assert is_within_5_sigma(right.sum(), outputs["pd_up"][0], 0.005 * DRAWS)
    assert is_within_5_sigma(wrong.sum(), outputs["p_wrong_range_up"][0], 0.005 * DRAWS)
    in_all_bins = evaluate(scene_of(table_4_1, speckle, tnr=2.5), FADING)
    assert outputs["p_wrong_range_up"][0] < 0.7 * in_all_bins["p_wrong_range_up"][0]


def of_one_bin(law, bins, level, reach):
    """Chance by Simpson's rule that a bin crosses a level and is not the largest of all."""
    z = np.linspace(level, level + reach, 200_001)
    return integrate.simpson(law.pdf(z) * -np.expm1(bins * np.log1p(-np.exp(-z * z / 2))), x=z)


@given(st.floats(0.5, 14), st.floats(-3, 1.5), st.sampled_from(["none", "developed"]))
def test_chances_are_the_integrals_that_they_stand_for(table_4_1, tnr, decades, speckle):
    """Of single bins in independent noise, down to chances of 1e-20."""
    scene = scene_of(
        table_4_1, speckle, tnr=tnr, power=10**decades, detection="peak_bin",
        noise_bins="independent",
    )  # fmt: skip
    shots, outputs = (
        prepare_single_category(scene, WITHOUT_LEAKAGE),
        evaluate(scene, WITHOUT_LEAKAGE),
    )
    crosses = evaluate(scene | {REPORTED_PEAKS_PATH: "all"}, WITHOUT_LEAKAGE)
    sigma = shots.bin_noise_sigma[0]
    level, signal = shots.threshold[0] / sigma, np.sqrt(2 * crosses["snr_up"][0])
    law, reach = stats.rice(signal), signal + 20
    missed = marcum_q1(signal, level).p
    if speckle == "developed":
        scale = np.sqrt(1 + signal**2 / 2)
        law, reach = stats.rayleigh(scale=scale), 20 * scale
        missed = law.cdf(level)
    alarm = crosses["pfa_segment"][0]
    bins = SIZE // 2 - evaluate_segments(shots).n_exempt[0, 0]  # but those that the echo occupies
    lost = of_one_bin(law, bins, level, min(reach, 40))
    wrong = alarm * missed + lost
    assert outputs["pd_up"][0] == pytest.approx(1 - missed - lost, abs=1e-6)
    assert outputs["p_wrong_range_up"][0] == pytest.approx(wrong, rel=1e-5, abs=1e-7)
    assert outputs["p_wrong_range_up"][0] == pytest.approx(wrong, rel=0.03, abs=1e-20)


@pytest.mark.parametrize("record", ["real", "complex"])
@pytest.mark.parametrize("speckle", ["none", "developed"])
@pytest.mark.parametrize("detection", ["any_bin", "peak_bin"])
def test_right_wrong_and_nothing_add_to_one(detection, speckle, record, table_4_1):
    changes = {"tnr": np.linspace(0.1, 9, 40), "detection": detection}
    outputs = evaluate(scene_of(table_4_1, speckle, record, **changes), WITHOUT_LEAKAGE)
    crosses = evaluate(scene_of(table_4_1, speckle, record, "all", **changes), WITHOUT_LEAKAGE)
    nothing = (1 - crosses["pfa_segment"]) * crosses["miss_up"]
    assert outputs["pd_up"] + outputs["p_wrong_range_up"] + nothing == pytest.approx(np.ones(40))
    for name in ("up", "doppler", "down", "shot"):
        pd, wrong = outputs[f"pd_{name}"], outputs[f"p_wrong_range_{name}"]
        assert pd + outputs[f"miss_{name}"] == pytest.approx(np.ones(40))
        assert (wrong >= 0).all() and (pd + wrong <= 1 + 1e-12).all()
        assert (pd <= crosses[f"pd_{name}"]).all()
        # Where noise hardly alarms what crosses is right.
        rare = crosses["pfa_shot"]
        assert (crosses[f"pd_{name}"] - pd <= rare + 1e-12).all() and rare.min() < 1e-3
    total = outputs["pd_shot"] + outputs["p_wrong_range_shot"]
    assert total[0] == pytest.approx(1, abs=1e-3)  # both chirps report something
    assert {name for name in outputs if name not in crosses} == set(STRONGEST_PEAK_OUTPUTS)


def test_of_strong_echoes_no_peak_is_wrong(table_4_1):
    outputs = evaluate(scene_of(table_4_1, tnr=1.0, power=10.0), DEFAULT_EFFECTS)
    assert outputs["pd_shot"] == pytest.approx([1]) and outputs["p_wrong_range_shot"] < 1e-6


@pytest.mark.parametrize("record", ["real", "complex"])
def test_segments_of_their_own_speckle_are_independent(record, table_4_1):
    scene = scene_of(table_4_1, "developed", record, tnr=np.array([2.5, 4.0, 6.0]))
    statistics = shot_statistics(shares(prepare_single_category(scene, FADING), 0.0))
    assert statistics["pd_shot"] == pytest.approx(
        statistics["pd_up"] * statistics["pd_down"], rel=1e-9
    )
    near, far = (
        shot_statistics(shares(prepare_single_category(scene, FADING), 1e-4 * k)) for k in (0, 1)
    )
    for name in ("pd_shot", "p_wrong_range_shot"):
        assert near[name] == pytest.approx(far[name], rel=1e-4)


def test_an_echo_outside_the_band_is_never_right(table_4_1):
    """All alarms there are of noise, and of the echo's share in the band."""
    band = dict(zip(SEARCH_BAND_PATHS, (20.0, 120.0, 2.0, 4.0), strict=True))
    outputs = evaluate(scene_of(table_4_1, tnr=2.5) | band, DEFAULT_EFFECTS)
    assert outputs["pd_up"] == outputs["pd_shot"] == 0
    assert outputs["p_wrong_range_up"] == pytest.approx(outputs["pfa_segment"], rel=1e-6)
