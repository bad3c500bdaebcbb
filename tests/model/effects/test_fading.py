"""Developed speckle in closed form: against draws, printed values, records, and flights' draws."""

from dataclasses import replace

import numpy as np
import pytest

from sweep.model import window
from sweep.model.beamlets import plane_footprint
from sweep.model.detection.echo_detection import (
    NO_SPECKLE,
    BinThreshold,
    DetectionRule,
    EchoBins,
    SegmentCorrelations,
    joint_pd_in_speckle,
    pd_and_miss,
    speckle_mixing_of_point,
)
from sweep.model.detection.joint_tail import joint_tail_quadrature
from sweep.model.detection.marcum import marcum_q1
from sweep.model.detection.speckle_correlation import SEGMENT_PAIRS
from sweep.model.detection.speckle_modes import NO_MODES
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.evaluation import (
    evaluate_segments,
    prepare_ray_traced_shots,
    prepare_shots,
    shot_statistics,
)
from sweep.model.ground import BeamletTable, RayTracedGround
from sweep.model.outputs import DRAW_COUNT_OUTPUTS
from sweep.model.pointcloud.bin_groups import list_bin_groups
from sweep.model.pointcloud.returns import draw_returns
from sweep.model.sampling import philox
from sweep.model.sampling.draws import (
    DrawRanges,
    count_by_probability,
    count_in_noise,
    speckle_factors,
)
from sweep.model.sampling.realisations import iter_realisations

FADING = (*DEFAULT_EFFECTS, "fading")
COUNTS = list(DRAW_COUNT_OUTPUTS)


def amplitudes(rng, size):
    """Standard circular complex normal numbers."""
    return (rng.normal(size=size) + 1j * rng.normal(size=size)) / np.sqrt(2)


def of_one_bin(magnitude, level):
    """Chances of a bin in noise of power 1 to be found, and to be missed."""
    rule = DetectionRule(
        False, 0, False, 64, True, 0.0, False, joint_tail_quadrature(0.0), np.empty(0), NO_MODES
    )
    noise = np.sqrt(0.5)
    levels, one = BinThreshold(noise, level, noise, noise), np.ones(1, bool)
    return pd_and_miss(EchoBins(np.array([magnitude]), one, 5), 0, rule, levels, NO_SPECKLE)


def db(value):
    return 10 ** (value / 10)


@pytest.mark.parametrize("snr", [0, 10, 20, 30])
@pytest.mark.parametrize("correlation", [0.0, 0.5, 1.0])
def test_closed_forms_are_the_mean_over_draws(snr, correlation):
    rng, number, level = np.random.default_rng(snr + int(10 * correlation)), 200_000, 3.0
    first = amplitudes(rng, number)
    second = correlation * first + np.sqrt(1 - correlation**2) * amplitudes(rng, number)
    root = np.sqrt(db(snr))
    up = np.abs(root * first + amplitudes(rng, number)) > level
    down = np.abs(0.7 * root * second + amplitudes(rng, number)) > level
    pd, weaker = of_one_bin(root, level)[0], of_one_bin(0.7 * root, level)[0]
    both = joint_pd_in_speckle(pd, weaker, np.sqrt(2) * level, np.asarray(correlation))
    for actual, expected in ((up.mean(), pd), ((up & down).mean(), both)):
        assert abs(actual - expected) < 5 * np.sqrt(expected * (1 - expected) / number)


@pytest.mark.parametrize(("snr", "pd"), [(6.8, 0.2036), (16.0, 0.7980)])
def test_printed_values_of_swerlings_first_case(snr, pd):
    level = np.sqrt(-np.log(1e-4))
    detection_probability, missed = of_one_bin(np.sqrt(db(snr)), level)
    assert detection_probability == pytest.approx(pd, abs=6e-5)
    assert missed == pytest.approx(1 - pd, abs=6e-5)


@pytest.mark.parametrize(("snr", "pd"), [(11.0, 0.1683), (13.0, 0.6287)])
def test_printed_values_without_fading(snr, pd):
    level = np.sqrt(-2 * np.log(1e-8))
    assert marcum_q1(np.sqrt(2 * db(snr)), level).q == pytest.approx(pd, abs=6e-5)


def prepared(parameters, effects=FADING):
    ((_, shots),) = prepare_shots(parameters, effects)
    return shots


@pytest.fixture
def sloping(table_4_1):
    """A beam across which velocities differ: its segments share a part of their speckle."""
    return table_4_1() | {
        "footprint.phases": "incoherent", "footprint.beamlets": 19, "target.range": 4000.0,
        "target.grazing_angle": np.pi / 2, "instrument.laser.power": 0.3,
        "target.transverse_velocity": 6.0, "footprint.pattern": "hexagonal",
    }  # fmt: skip


def test_it_is_what_drawn_speckle_comes_to(sloping):
    """The random effect draws each beamlet's amplitude, and has a spectrum for each draw."""
    shots = prepared(sloping)
    assert 0.2 < abs(shots.speckle.segment_correlations.up_down[0]) < 0.98
    outputs = shot_statistics(shots)
    number, key = 10_000, philox.point_keys(np.zeros((1, 1)), domain="tests", seed=1)
    rough = sloping | {"target.roughness": np.inf}
    drawn = [
        shot_statistics(realisation.shots)
        for realisation in iter_realisations(
            rough, (*DEFAULT_EFFECTS, "speckle"), keys=key, draws=number
        )
    ]
    for name in ("pd_up", "pd_shot"):
        values = np.concatenate([realisation[name] for realisation in drawn])
        error = values.std() / np.sqrt(number)
        # The random effect's largest bin may be another in each draw.
        assert -5 * error - 0.004 < outputs[name][0] - values.mean() < 5 * error


def beamlet_correlation(shots, first, second):
    """Correlation of two segments' strongest bins as a sum over beamlets, by the exact phases.

    Amplitudes count by the window's transform about its middle at each beamlet's line.
    """
    samples = np.arange(shots.window.length)
    w = window.window_samples(shots.window.name, shots.window.length)
    middle = float(shots.record.acquisition_delay + shots.record.duration[0] / 2)
    delay = 2 * float(shots.range[0]) / 299792458
    fields = []
    for s in (first, second):
        segment = shots.waveform_segments[s]
        rate, carrier = float(segment.chirp_rate), float(segment.carrier)
        start = float(np.ravel(shots.waveform.segment_starts[s])[0])
        frequency_difference = delay * shots.footprint.relative_range_offset[
            0
        ] - shots.footprint.doppler_ratio_offset[0] * (start + middle)  # of delays, then
        cycles = -(carrier + rate * (middle - delay)) * frequency_difference
        line = (
            carrier * shots.footprint.doppler_ratio_offset[0]
            - rate * delay * shots.footprint.relative_range_offset[0]
        ) / shots.sample_rate[0]
        axis = carrier * float(np.ravel(segment.doppler_ratio)[0]) - rate * delay
        place = axis / shots.sample_rate[0] * shots.fft_size
        fraction = (np.rint(place) - place) / shots.fft_size
        turns = (fraction - line)[:, None] * (samples - shots.window.length / 2)
        fields.append((w * np.cos(2 * np.pi * turns)).sum(axis=1) * np.exp(2j * np.pi * cycles))
    power = shots.footprint.relative_amplitude[0] ** 2
    strength = [(power * np.abs(field) ** 2).sum() for field in fields]
    return (power * fields[1] * fields[0].conj()).sum() / np.sqrt(np.prod(strength))


@pytest.mark.parametrize("order", ["up doppler down", "down doppler up", "up down doppler"])
@pytest.mark.parametrize(
    "changes, near",
    [
        ({}, 5e-4),
        ({"target.radial_velocity": 150.0, "instrument.laser.beam_divergence": 2e-3,
          "target.transverse_velocity": 0.0}, 1e-3),
        ({"target.grazing_angle": 1.5}, 1e-3),
    ],
)  # fmt: skip
def test_correlations_are_the_sum_over_many_beamlets(order, changes, near, sloping):
    """Of up and Doppler, up and down, Doppler and down segment.

    However few the beamlets that the power of a bin needs: here two.
    """
    several = sloping | {
        "instrument.chirp.segments": order, "instrument.chirp.gap": 50e-6, "target.range": 3000.0,
        "instrument.processing.fft_size": 8192,
    }  # fmt: skip
    shots = prepared(several | changes | {"footprint.beamlets": 2})
    fine = prepared(several | changes | {"footprint.beamlets": 1024, "footprint.pattern": "square"})
    for correlation, pair in zip(shots.speckle.segment_correlations, SEGMENT_PAIRS, strict=True):
        assert correlation[0] == pytest.approx(beamlet_correlation(fine, *pair), abs=near)


@pytest.mark.parametrize("transverse", [1.0, 12.0, 20.0, 32.0])
def test_segments_of_a_cast_footprint_do_not_agree_by_few_rays(transverse, sloping):
    """Nineteen rays of a hexagon repeat themselves where the Doppler shifts turn by 5 rad."""
    p = sloping | {"target.radial_velocity": 30.0}
    offset, cosine, weight, closing = plane_footprint(
        grazing_angle=np.array([np.pi / 2]), beam_divergence=np.array([50e-6]), n_beamlets=19,
        radial_velocity=30.0, transverse_velocity=transverse,
    )  # fmt: skip
    cast = RayTracedGround(
        BeamletTable(np.zeros(1, int), offset, 2 * closing / 299792458, weight * cosine)
    )
    shots = prepare_ray_traced_shots(p, cast, FADING)
    turn = 2 * np.pi * 2 / 1550e-9 * transverse * 12.5e-6 * 1e-3
    assert abs(shots.speckle.segment_correlations.up_down[0]) == pytest.approx(
        np.exp(-0.5 * turn**2), abs=1e-4
    )


@pytest.mark.parametrize("angle", [np.pi / 2, np.pi / 4])
@pytest.mark.parametrize("divergence", [1e-4, 1e-3])
def test_drawn_speckle_has_as_many_beamlets_as_its_segments_need(divergence, angle, sloping):
    """Two are enough for the power of a bin; their Doppler shifts turn until the last segment."""
    p = sloping | {
        "footprint.beamlets": 0, "footprint.pattern": "auto", "target.transverse_velocity": 0.0,
        "target.radial_velocity": 150.0, "accuracy.tolerance": 1e-3, "target.range": 100.0,
        "instrument.laser.beam_divergence": divergence, "target.grazing_angle": angle,
    }  # fmt: skip
    drawn = prepared(p | {"target.roughness": np.inf})
    share = abs(beamlet_correlation(drawn, 0, 2)) ** 2
    assert share == pytest.approx(
        abs(prepared(p).speckle.segment_correlations.up_down[0]) ** 2, abs=2e-3
    )


@pytest.mark.parametrize("near", [0.3 + 0.2j, 1.0, 0.0])
def test_drawn_factors_have_the_correlations(near):
    number = 50_000
    far = 0.1 - 0.4j if near != 1.0 else 1.0
    fading = SegmentCorrelations(*np.array([[near + 0j], [far + 0j], [near + 0j]]))
    key, mixing = (np.uint64(3), np.uint64(4)), speckle_mixing_of_point(fading.speckle_mixing(), 0)
    factors = [
        speckle_factors(philox.DrawAddress(*key, draw), 0, mixing) for draw in np.arange(number)
    ]
    power = np.array(factors).T ** 2
    assert power.mean(axis=1) == pytest.approx(np.ones(3), abs=5 / np.sqrt(number))
    pairs = np.corrcoef(power)[[0, 1, 0], [1, 2, 2]]  # of powers, |mu|^2
    squares = np.abs([near, near, far]) ** 2
    assert pairs == pytest.approx(squares, abs=15 / np.sqrt(number))


@pytest.mark.parametrize("noisy", [False, True])
@pytest.mark.parametrize("rule", ["peak_bin", "any_bin"])
def test_grid_and_flight_count_the_detections_that_the_closed_form_tells(sloping, noisy, rule):
    number, key = 10_000, philox.point_keys(np.zeros((1, 1)), domain="tests", seed=7)
    shots = prepared(sloping | {"instrument.processing.detection": rule})
    outputs = shot_statistics(shots)
    rows = DrawRanges(np.zeros(1, np.int64), key, np.array([0]), np.array([number]))
    counts = np.zeros((len(COUNTS), 1, 1), np.int64)
    if noisy:
        count_in_noise(rows, np.array([0, number]), shots, counts)
    else:
        count_by_probability(rows, np.array([0, number]), outputs, counts)
    expected = [outputs[f"pd_{name}"][0] for name in ("up", "down", "shot")]
    share = counts[[0, 1, 3], 0, 0] / number
    assert np.all(
        np.abs(share - expected)
        < 5 * np.sqrt(np.multiply(expected, 1 - np.array(expected)) / number)
    )
    assert expected[2] > expected[0] * expected[1] + 0.02
    method = "noise" if noisy else "probabilities"
    drawn = draw_returns(shots, list_bin_groups(shots), keys=key, draws=number, method=method)
    paired = ((drawn.group[0, :, :, 0] == 0) & (drawn.group[0, :, :, 2] == 0)).any(axis=1)
    # Flights draw the lines of footprints, which grids do not.
    spread = np.sqrt(2 * expected[2] * (1 - expected[2]) / number)
    assert abs(paired.mean() - counts[3, 0, 0] / number) < 5 * spread


@pytest.mark.parametrize("noisy", [False, True])
def test_powers_of_detected_peaks_are_exponential_above_the_threshold(sloping, noisy):
    number, key = 10_000, philox.point_keys(np.zeros((1, 1)), domain="tests", seed=9)
    shots = prepared(sloping | {"target.range": 8000.0})
    added = np.zeros(1, complex)
    turn = np.array([0.0, 20.0, 40.0])[:, None] + np.zeros((1, 3, 2))
    shots = replace(
        shots,
        speckle=shots.speckle._replace(
            segment_correlations=SegmentCorrelations(added, added, added),
            line_gradients=shots.speckle.line_gradients._replace(phase_gradient=turn),
        ),
    )
    method = "noise" if noisy else "probabilities"
    groups = list_bin_groups(shots)
    returns = draw_returns(shots, groups, keys=key, draws=number, method=method)
    is_first_pair = (returns.group[0, :, 0, 0] == 0) & (returns.group[0, :, 0, 2] == 0)
    sigma, level = shots.line_noise_sigma[0], shots.threshold[0]
    up, down = groups.magnitude[0, 0, 0], groups.magnitude[0, 2, 0]
    loud = (
        returns.snr[0, is_first_pair, 0] > (level / sigma) ** 2
    )  # of the weaker one: twice the least
    expected_mean, higher = (
        np.exp(-(factor * level**2) * (1 / (2 * sigma**2 + up**2) + 1 / (2 * sigma**2 + down**2)))
        for factor in (1, 2)
    )
    chance = higher / expected_mean
    assert abs(loud.mean() - chance) < 5 * np.sqrt(chance * (1 - chance) / is_first_pair.sum())


def test_a_smooth_surface_does_not_fade(sloping):
    coherent = sloping | {"footprint.phases": "coherent"}
    assert prepared(coherent).speckle.segment_correlations is None
    assert np.array_equal(
        evaluate_segments(prepared(coherent)),
        evaluate_segments(prepared(coherent, DEFAULT_EFFECTS)),
    )
