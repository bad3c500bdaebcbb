"""Developed speckle at and near DC and Nyquist, where a real record's bins hold image and line.

Compared with drawn records of scatterers, which share the mean echo power, noise and threshold.
"""

import numpy as np
import pytest
import validate_speckle
from scatterer_shots import (
    COMPARED_EFFECTS,
    LANDER_PARAMETERS,
    draw_segment_detections,
    prepare_single_category,
    with_signal_over_threshold,
)

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.hoyt import hoyt_tails
from sweep.model.detection.look_speckle import phase_rotated_look_covariances
from sweep.model.detection.looks import Looks
from sweep.model.detection.pseudo_variance import multilook_pd_and_miss_near_ends
from sweep.model.effects.catalogue import PARAMETER_DEFAULTS
from sweep.model.evaluation import evaluate_segments, shot_statistics
from sweep.model.sampling.samplers import simulate_draws
from sweep.model.time_domain_truth import evaluate_segments_in_time_domain

DRAWS = 20_000
BIN_WIDTH = (
    LANDER_PARAMETERS["instrument.processing.sample_rate"]
    / LANDER_PARAMETERS["instrument.processing.fft_size"]
)
RANGE_BEAT = 1e9 / 50e-6 * 2 * 300.0 / SPEED_OF_LIGHT
HOVER = LANDER_PARAMETERS | {
    "target.range": 300.0, "target.grazing_angle": np.pi / 2, "instrument.processing.tnr": 6.0,
    "target.transverse_velocity": 0.0, "instrument.processing.detection": "peak_bin",
}  # fmt: skip


def at_doppler(parameters, frequency):
    """Parameters with the radial velocity of a Doppler frequency [Hz]."""
    wavelength = parameters["instrument.laser.wavelength"]
    return parameters | {"target.radial_velocity": frequency * wavelength / 2}


def with_circular_pd(parameters, pd):
    """Parameters with the laser power for which a circular number in the Doppler segment has pd."""
    shots = prepare_single_category(parameters)
    snr = 0.5 * float(shots.threshold[0] / shots.bin_noise_sigma[0]) ** 2 / -np.log(pd) - 1
    now = 0.5 * float(evaluate_segments(shots).magnitude[1, 0] / shots.bin_noise_sigma[0]) ** 2
    factor = parameters["instrument.laser.power"] * snr / now
    return parameters | {"instrument.laser.power": factor}


@pytest.mark.parametrize(
    ("bins", "circular", "expected_share", "error"),
    [
        (0.0, 0.8195, 0.6570, 0.0024),
        (0.11, 0.8075, 0.6496, 0.0024),
        (0.42, 0.6968, 0.5468, 0.0025),
        (0.63, 0.5984, 0.4746, 0.0025),
    ],
)
def test_a_hovering_lidar_detects_a_real_number(bins, circular, expected_share, error, table_4_1):
    """Shares drawn by another simulation, with the probabilities of circular numbers there."""
    p = at_doppler(PARAMETER_DEFAULTS | table_4_1() | HOVER, bins * BIN_WIDTH)
    p = with_circular_pd(p, circular)
    outputs = shot_statistics(prepare_single_category(p))
    assert abs(outputs["pd_doppler"][0] - expected_share) < 3 * error
    assert outputs["pd_doppler"][0] + outputs["miss_doppler"][0] == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize(
    ("window", "rule", "doppler", "grazing", "tolerance"),
    [
        ("hamming", "peak_bin", 0.0, np.pi / 2, 0.0),
        ("hamming", "any_bin", 0.42, np.pi / 2, 0.004),
        ("rectangular", "peak_bin", 0.42, np.pi / 2, 0.0),
        ("rectangular", "any_bin", 0.11, np.pi / 2, 0.004),
        ("hann", "any_bin", 1.06, np.radians(30), 0.008),
    ],
)
def test_slow_echoes_are_detected_as_often_as_drawn_ones(
    window, rule, doppler, grazing, tolerance, table_4_1
):
    p = PARAMETER_DEFAULTS | table_4_1() | HOVER | {
        "instrument.processing.window": window, "instrument.processing.detection": rule,
        "target.grazing_angle": grazing,
    }  # fmt: skip
    p = with_signal_over_threshold(at_doppler(p, doppler * BIN_WIDTH), 1.6)
    shots = prepare_single_category(p)
    drawn = draw_segment_detections(p, shots, draws=DRAWS, seed=7)["doppler"].mean()
    expected = float(shot_statistics(shots)["pd_doppler"][0])
    assert abs(drawn - expected) < 4 * np.sqrt(expected * (1 - expected) / DRAWS) + tolerance


@pytest.mark.parametrize(("rule", "tolerance"), [("peak_bin", 0.008), ("any_bin", 0.014)])
def test_an_up_beat_at_dc_is_a_real_number(rule, tolerance, table_4_1):
    """The Doppler frequency takes the range beat away; the down beat is at twice that."""
    p = PARAMETER_DEFAULTS | table_4_1() | HOVER | {"instrument.processing.detection": rule}
    p = with_signal_over_threshold(at_doppler(p, RANGE_BEAT + 0.3 * BIN_WIDTH), 1.6)
    shots = prepare_single_category(p)
    detections, outputs = (
        draw_segment_detections(p, shots, draws=DRAWS, seed=3),
        shot_statistics(shots),
    )
    joint_share = (detections["up"] & detections["down"]).mean()
    error = np.sqrt(0.25 / DRAWS)
    assert abs(detections["up"].mean() - outputs["pd_up"][0]) < 4 * error
    # The poles take 1 % of the power at the down beat that the simulation leaves.
    assert abs(joint_share - outputs["pd_shot"][0]) < 4 * error + tolerance


def test_any_two_segments_detect_a_hovering_lidar_as_drawn(table_4_1):
    p = (
        PARAMETER_DEFAULTS
        | table_4_1()
        | HOVER
        | {"instrument.processing.shot_detection": "any_two"}
    )
    p = with_signal_over_threshold(at_doppler(p, 0.2 * BIN_WIDTH), 1.6)
    shots = prepare_single_category(p)
    detections = draw_segment_detections(p, shots, draws=DRAWS, seed=3)
    two = (np.sum([detections[name] for name in detections], axis=0) >= 2).mean()
    outputs = shot_statistics(shots)
    assert abs(two - outputs["pd_shot"][0]) < 0.003 + 4 * np.sqrt(two * (1 - two) / DRAWS)
    assert outputs["pd_shot"][0] + outputs["miss_shot"][0] == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("combine", ["power", "binary"])
@pytest.mark.parametrize("speckle", ["common", "independent"])
@pytest.mark.parametrize("place", [0.0, 0.3, 1.06])
def test_looks_near_dc_detect_as_often_as_drawn_ones(combine, speckle, place, table_4_1):
    looks, draws, rng = 4, 20_000, np.random.default_rng(5)
    p = PARAMETER_DEFAULTS | table_4_1() | HOVER | {
        "instrument.processing.tnr": 4.0, "instrument.looks.number": looks,
        "instrument.looks.combine": combine, "instrument.looks.votes": 2,
        "instrument.looks.speckle": speckle,
    }  # fmt: skip
    shots = prepare_single_category(
        with_signal_over_threshold(at_doppler(p, place * BIN_WIDTH), 1.3)
    )
    w = shots.window.samples()
    time, k = (np.arange(w.size) - w.size / 2) / w.size, round(place)
    line, image = ((w * np.cos(2 * np.pi * y * time)).sum() for y in (k - place, k + place))
    power = float(evaluate_segments(shots).magnitude[1, 0]) ** 2 / (line**2 + image**2)
    amplitude = rng.normal(size=(draws, looks, 2)) @ [1, 1j] * np.sqrt(power / 2)
    if speckle == "common":
        cycles = place * BIN_WIDTH * np.ravel(shots.waveform.look_period)[0] * np.arange(looks)
        amplitude = amplitude[:, :1] * np.exp(2j * np.pi * cycles)
    pseudo = (w**2 * np.cos(4 * np.pi * k * time)).sum() / (w**2).sum()
    noise = rng.normal(size=(draws, looks, 2)) * np.sqrt([1 + pseudo, 1 - pseudo])
    noise = float(shots.bin_noise_sigma[0]) * (noise @ [1, 1j])
    magnitude = abs(amplitude * line + amplitude.conj() * image + noise)
    level = float(shots.threshold[0])
    if combine == "power":
        detected = (magnitude**2).mean(axis=1) >= level**2
    else:
        detected = (magnitude >= level).sum(axis=1) >= 2
    drawn, expected = detected.mean(), float(shot_statistics(shots)["pd_doppler"][0])
    assert abs(drawn - expected) < 4 * np.sqrt(expected * (1 - expected) / draws)


@pytest.mark.parametrize("waveform", ["three segments", "two segments"])
@pytest.mark.parametrize("speckle", ["common", "independent"])
def test_looks_near_dc_are_detected_alike_in_the_time_domain(speckle, waveform, table_4_1):
    p = PARAMETER_DEFAULTS | table_4_1() | HOVER | {
        "instrument.processing.tnr": 4.0, "instrument.looks.number": 4,
        "instrument.looks.speckle": speckle,
    }  # fmt: skip
    if waveform == "two segments":
        p |= {"instrument.chirp.segments": "up down"}
    shots = prepare_single_category(
        with_signal_over_threshold(at_doppler(p, 0.3 * BIN_WIDTH), 1.3),
        tuple(name for name in COMPARED_EFFECTS if name != "range_walk"),
    )
    in_time = evaluate_segments_in_time_domain(shots, with_range_walk=False)
    results = evaluate_segments(shots)
    for name in ("pd", "miss", "magnitude", "frequency"):
        np.testing.assert_allclose(getattr(in_time, name), getattr(results, name), rtol=1e-4)


@pytest.mark.parametrize("share", [-1.0, -0.4, 0.0, 1e-6, 0.3, 0.9, 0.9999, 1.0])
@pytest.mark.parametrize("level", [1e-3, 0.7, 2.0, 9.0])
def test_the_hoyt_law_is_the_mean_of_exponentials(share, level):
    """Of |X|^2 = P (1 + q cos t) times an exponential variable, t uniform."""
    pd, missed = hoyt_tails(1.7, share, level)
    t = np.pi * (np.arange(20_000) + 0.5) / 20_000
    exponent = level**2 / (1.7 * (1 + share * np.cos(t)))
    assert pd == pytest.approx(np.exp(-exponent).mean(), rel=1e-9, abs=1e-300)
    assert missed == pytest.approx(-np.expm1(-exponent).mean(), rel=1e-5)


@pytest.mark.parametrize("rule", ["peak_bin", "any_bin"])
@pytest.mark.parametrize("place", [0.0, 0.42])
def test_draws_in_noise_detect_slow_echoes_as_often(rule, place, table_4_1):
    p = PARAMETER_DEFAULTS | table_4_1() | HOVER | {"instrument.processing.detection": rule}
    p = with_signal_over_threshold(at_doppler(p, place * BIN_WIDTH), 1.6)
    p["target.range"] = np.array([300.0])
    keys, draws = np.array([[1, 2]], np.uint64), 20_000
    counts = simulate_draws(p, COMPARED_EFFECTS, keys=keys, batch_sizes=[draws], method="noise")
    drawn = counts["n_detected_doppler"][0, 0] / draws
    expected = float(shot_statistics(prepare_single_category(p))["pd_doppler"][0])
    assert abs(drawn - expected) < 0.004 + 4 * np.sqrt(expected * (1 - expected) / draws)


@pytest.mark.parametrize("combine", ["power", "binary"])
@pytest.mark.parametrize("cycles", [0.0, 0.13, 0.5])
@pytest.mark.parametrize("memory", [0.0, 0.8, 1.0])
def test_looks_whose_phase_turns_are_detected_as_gaussian_numbers(combine, cycles, memory):
    """Complex numbers with an image each, drawn look by look, against the law of their looks."""
    rng, number, draws = np.random.default_rng(5), 4, 100_000
    signal, level, q = 5.0, 4.3, 0.8
    looks = Looks(number, combine, 2)
    by_lag = (memory ** np.arange(number)).astype(complex)[None]
    covariance = phase_rotated_look_covariances(by_lag, np.ones((1, number)), np.array([cycles]))
    columns = (np.array([value]) for value in (signal, level, q, 0.0))
    pd, miss = multilook_pd_and_miss_near_ends(looks, *columns, covariance)
    amplitude = np.empty((draws, number), complex)
    innovation = [complex_normal(rng, draws) for _ in range(number)]
    amplitude[:, 0] = innovation[0]
    for k in range(1, number):
        amplitude[:, k] = memory * amplitude[:, k - 1] + np.sqrt(1 - memory**2) * innovation[k]
    turned = amplitude * np.exp(2j * np.pi * cycles * np.arange(number))
    # A line and its image of amplitudes a and b: a^2 + b^2 = signal^2, 2 a b = q signal^2.
    line, image = (0.5 * (np.sqrt(1 + q) + sign * np.sqrt(1 - q)) * signal for sign in (1, -1))
    noise = np.sqrt(2) * np.stack([complex_normal(rng, draws) for _ in range(number)], axis=1)
    power = np.abs(line * turned + image * np.conj(turned) + noise) ** 2
    is_detected = (power >= level**2).sum(axis=1) >= 2
    if combine == "power":
        is_detected = power.mean(axis=1) >= level**2
    lattice_error = 0.004 if combine == "binary" else 0.0
    assert abs(is_detected.mean() - pd[0]) < 4 * np.sqrt(0.25 / draws) + lattice_error
    assert pd[0] + miss[0] == pytest.approx(1, abs=1e-9)


def complex_normal(rng, draws):
    """Circular complex Gaussian numbers of mean power 1."""
    return (rng.normal(size=draws) + 1j * rng.normal(size=draws)) / np.sqrt(2)


@pytest.mark.parametrize(("seed", "number"), [(3, 72), (7, 56)])
def test_looks_with_a_beat_at_dc_are_detected_as_drawn_ones(seed, number):
    """Two of the specs of ``make validate-speckle``: five looks of a turning phase, four votes."""
    row = validate_speckle.compare_spec(seed, number)
    for comparison in row.comparisons:
        if comparison.quantity != "shot":
            assert abs(comparison.difference) < 4 * comparison.drawn_deviation + 0.002, comparison
