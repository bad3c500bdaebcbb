"""One link budget: bounds of the planner are stated for the very shots that are simulated."""

from itertools import product

import numpy as np
import pytest
from shot_helpers import prepare_single_category

from sweep.model import receiver_chain, waveform
from sweep.model.detection.looks import LOOKS_NUMBER_PATH
from sweep.model.effects.catalogue import PARAMETER_DEFAULTS
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.link_budget import LinkBudget, NoiseBudget

N_POINTS = 25
ROUNDING = 4e-15
MOTION = ("doppler", "segment_motion", "overlap")
"""Effects by which lines and records follow the target's motion."""
FILTERS = {
    "white": {"noise_shape": "white"},
    "receiver": {"noise_shape": "receiver"},
    "antialias": {"noise_shape": "receiver", "antialias_bandwidth": 250e6, "antialias_order": 5.0},
}
SLOPES = {"triangle": (0.0, -1.0), "three slopes": (0.5, -1.0), "unequal": (0.0, -0.7)}
CASES = list(product(receiver_chain.ARCHITECTURES, ("real", "complex"), FILTERS, SLOPES, (1, 4)))


def random_scene(table_4_1, seed, case):
    """Random points of one category, and the same as the planner takes them."""
    rng = np.random.default_rng((51, seed))
    architecture, record, receiver_filter, slopes, n_looks = case
    scene = PARAMETER_DEFAULTS | table_4_1(
        architecture=architecture,
        range=10 ** rng.uniform(0, 4.7, N_POINTS),
        radial_velocity=rng.choice([-1, 1], N_POINTS) * 10 ** rng.uniform(-3, 3, N_POINTS),
        grazing_angle=np.radians(rng.uniform(5, 90, N_POINTS)),
        power=10 ** rng.uniform(-4, 1, N_POINTS),
        tnr=rng.uniform(2, 12, N_POINTS),
        detector_bandwidth=10 ** rng.uniform(7, 9, N_POINTS),
        amplifier_bandwidth=10 ** rng.uniform(7, 9, N_POINTS),
        reflectance_law=str(rng.choice(["thesis", "lambert", "lommel_seeliger"])),
        window=str(rng.choice(["hamming", "hann", "rectangular", "kaiser(8.6)"])),
        acquisition_delay=float(rng.choice([0.0, 3e-6, 330e-6])),
        fft_size=int(rng.choice([2**12, 2**17])),
        duration=float(rng.choice([500e-6, 400e-6])),
        beamlets=1,
    )
    scene |= {f"instrument.receiver.{k}": v for k, v in FILTERS[receiver_filter].items()}
    return scene | {
        "instrument.receiver.record": record,
        waveform.DOPPLER_CHIRP_RATE_RATIO_PATH: SLOPES[slopes][0],
        waveform.DOWN_CHIRP_RATE_RATIO_PATH: SLOPES[slopes][1],
        waveform.SEGMENT_ORDER_PATH: str(rng.choice(waveform.SEGMENT_ORDERS)),
        waveform.SEGMENT_GAP_PATH: float(rng.choice([0.0, 20e-6])),
        "target.acceleration": rng.uniform(-20, 20, N_POINTS),
        "target.transverse_velocity": rng.uniform(-100, 100, N_POINTS),
        "instrument.processing.bits": 8.0,
        "instrument.processing.full_scale": 1.0,
        LOOKS_NUMBER_PATH: n_looks,
    }


def existing(shots, values_by_segment):
    """Values of the segments that exist, (segments, n)."""
    rows = [np.broadcast_to(value, shots.size) for value in values_by_segment]
    return np.array(rows)[shots.has_segment]


def assert_equal(actual, expected, shape=(N_POINTS,)):
    """Equal but for rounding, relative to each value."""
    actual, expected = (np.broadcast_to(value, shape) for value in (actual, expected))
    assert np.isfinite(expected).all()
    np.testing.assert_allclose(actual, expected, rtol=ROUNDING, atol=0)


@pytest.mark.parametrize("case", CASES, ids=lambda case: " ".join(map(str, case)))
def test_the_planner_has_the_link_budget_of_the_shots(case, table_4_1):
    scene = random_scene(table_4_1, CASES.index(case), case)
    points = PlannerInputs({path: np.asarray(value) for path, value in scene.items()})
    has_adc_noise = case[2] == "antialias"  # the planner counts it where filters leave no noise
    at_rest = prepare_single_category(scene, ())
    assert_equal(points.noise.variance_without_echo, at_rest.noise_variance)
    bin_noise_sigma = points.record.bin_noise_sigma(
        points.noise.variance_without_echo, points.looks
    )
    assert_equal(bin_noise_sigma, at_rest.bin_noise_sigma)
    assert_equal(points.threshold_ratio * bin_noise_sigma, at_rest.threshold)
    assert_equal(
        points.beat_amplitude, at_rest.echo_scales.beat_amplitude_scale * axis_amplitude(at_rest)
    )
    assert_equal(points.record.duration, at_rest.record.duration)
    assert_equal(points.record.bin_width, at_rest.sample_rate / at_rest.fft_size)
    assert_equal(points.target.approach_speed, at_rest.target.approach_speed)
    assert_equal(points.waveform.look_period, at_rest.waveform.look_period)
    assert points.window == at_rest.window

    effects = (*MOTION, "quantisation") if has_adc_noise else MOTION
    shots = prepare_single_category(scene, effects)
    shape = int(shots.has_segment.sum()), N_POINTS
    assert_equal(points.carriers, existing(shots, shots.waveform.carriers), shape)
    assert_equal(points.segment_starts, existing(shots, shots.motion.segment_starts), shape)
    beats = existing(shots, shots.beat_frequencies)
    assert_equal(points.beat_frequency, beats, shape)
    n_missing = (
        0 if points.missing_sample_bounds is None else points.missing_sample_bounds.n_missing
    )
    before_echo = shots.echo_record.n_samples_before_echo
    expected = 0 if before_echo is None else before_echo[shots.has_segment]
    assert np.array_equal(np.broadcast_to(n_missing, shape), np.broadcast_to(expected, shape))

    pole_gain = np.abs(
        receiver_chain.receiver_transfer_function(
            beats,
            detector_bandwidth=shots.receiver_filter.detector_bandwidth,
            amplifier_bandwidth=shots.receiver_filter.amplifier_bandwidth,
        )
    )
    magnitude = (
        shots.echo_scales.beat_amplitude_scale * axis_amplitude(shots) * shots.window.sum / 2
    )
    signal_ratio = magnitude * pole_gain * shots.whitening_gain[shots.has_segment]
    assert_equal(points.line_magnitude_over_sigma, signal_ratio / shots.bin_noise_sigma, shape)


def axis_amplitude(shots):
    """Relative amplitude of the echo on the axis, (n,), alone without a footprint."""
    assert shots.footprint.n_beamlets == 1
    return shots.footprint.relative_amplitude[shots.footprint.row_of_point, 0]


def test_effects_that_are_off_leave_lines_at_rest(table_4_1):
    case = CASES[0]
    scene = random_scene(table_4_1, 1, case)
    arrays = {path: np.asarray(value) for path, value in scene.items()}
    for effects in ((), ("doppler",), ("doppler", "segment_motion")):
        points = PlannerInputs(arrays)
        points.effects_off = {"doppler", "segment_motion", "overlap"} - set(effects)
        shots = prepare_single_category(scene, effects)
        beats = existing(shots, shots.beat_frequencies)
        assert_equal(points.beat_frequency, beats, beats.shape)
        assert points.missing_sample_bounds is None


def test_noise_of_the_echo_moves_no_threshold_and_the_adcs_passes_no_filter():
    noise = NoiseBudget({"detector": np.array(2.0), "amplifier": np.array([1.0, 3.0])})
    noise = noise.with_sources(signal_shot=np.array([4.0, 0.0]), quantisation=np.array(1.0))
    assert noise.variance_without_echo.tolist() == [4.0, 6.0]
    assert noise.variance.tolist() == [8.0, 6.0]
    assert noise.adc_noise_fraction == pytest.approx([1 / 4, 1 / 6])
    clipped = NoiseBudget(noise.variances, variance_factor=0.5)
    assert clipped.variance.tolist() == [4.0, 3.0]
    assert clipped.variance_without_echo.tolist() == [4.0, 6.0]
    assert clipped.with_sources(thermal=np.array(2.0)).variance.tolist() == [5.0, 4.0]


def test_a_budget_of_a_tile_broadcasts(table_4_1):
    """Axes of parameters stay apart until they meet in a product."""
    scene = random_scene(table_4_1, 2, CASES[0])
    ranges, powers = np.geomspace(1, 1e4, 7)[:, None], np.array([[0.1, 1.0]])
    tile = {path: np.asarray(value).flat[0] for path, value in scene.items()}
    budget = LinkBudget(tile | {"target.range": ranges, "instrument.laser.power": powers})
    assert budget.target.delay.shape == (7, 1)
    assert budget.echo_scales.echo_power_scale.shape == (7, 2)
    for i, j in np.ndindex(7, 2):
        of_point = LinkBudget(
            tile | {"target.range": ranges[i, 0], "instrument.laser.power": powers[0, j]}
        )
        assert_equal(
            budget.echo_scales.echo_power_scale[i, j], of_point.echo_scales.echo_power_scale, ()
        )
