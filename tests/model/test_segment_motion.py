"""Motion between segments: closed forms, the exact delay, and the fast path against the truth."""

from dataclasses import replace

import mpmath
import numpy as np
import pytest
from scipy.constants import speed_of_light
from shot_helpers import magnitude_error
from small_scenes import observe_shots, scene_parameters, straight_flight

from sweep.model import time_domain_truth
from sweep.model.effects.catalogue import DEFAULT_EFFECTS, PARAMETER_DEFAULTS, effect_names_in_flags
from sweep.model.evaluation import prepare_shots
from sweep.model.geometry.mesh import SurfaceMaterial
from sweep.model.geometry.scanner import cone_directions, fixed_beams
from sweep.model.pointcloud.bin_groups import list_bin_groups
from sweep.model.pointcloud.eyepoints import prepare_eyepoint_shots
from sweep.model.pointcloud.returns import beamlet_line_positions, draw_returns
from sweep.model.sampling.realisations import iter_realisations
from sweep.model.spectrum import segment_spectra
from sweep.model.waveform import (
    DEFAULT_CHIRP_RATE_RATIOS,
    SEGMENT_GAP_PATH,
    SEGMENT_NAMES,
    SEGMENT_ORDER_PATH,
    SEGMENT_ORDERS,
)
from sweep.tasks.studies.flight_study import plan_shot_effects

MOVING = (*DEFAULT_EFFECTS, "segment_motion")


def prepared(parameters, effects=MOVING):
    ((_, shots),) = prepare_shots(parameters, effects)
    return shots


def test_a_target_at_150_metres_a_second_is_7_5_centimetres_nearer_after_500_microseconds(
    table_4_1,
):
    """S 2/c 7.5 cm is 1.0007 kHz a segment: less by S 2/c times both the range and beta."""
    shots = prepared(table_4_1(range=2000.0, radial_velocity=150.0, beamlets=1))
    assert [
        float(segment.range_decrease_since_shot_start) for segment in shots.waveform_segments
    ] == pytest.approx([0, 0.075, 0.15])
    at_rest = prepared(table_4_1(range=2000.0, radial_velocity=150.0, beamlets=1), DEFAULT_EFFECTS)
    bins = beamlet_line_positions(shots)[0, :, 0] - beamlet_line_positions(at_rest)[0, :, 0]
    moved = 2e12 * 2 * 0.15 / speed_of_light * (1 + 300 / speed_of_light) / (600e6 / 2**17)
    np.testing.assert_allclose(bins, [0, 0, -moved], atol=1e-9)


def test_acceleration_moves_the_doppler_shift_on_from_segment_to_segment(table_4_1):
    """2 a t / lambda: 10 m/s^2 for 500 us is 6.45 kHz."""
    parameters = table_4_1(range=2000.0, radial_velocity=100.0, beamlets=1)
    moving, steady = (
        beamlet_line_positions(prepared(parameters | {"target.acceleration": a}))[0, :, 0]
        for a in (10, 0)
    )
    kilohertz = (moving - steady) * 600e3 / 2**17
    np.testing.assert_allclose(kilohertz, [0, 6.4516, 12.9032], rtol=1e-4)


@pytest.mark.parametrize(
    "architecture, order, gap, starts",
    [
        ("homodyne", "up doppler down", 0.0, [0.0, 500e-6, 1000e-6]),
        ("homodyne", "down doppler up", 20e-6, [1040e-6, 520e-6, 0.0]),
        ("homodyne", "up down", 20e-6, [0.0, 0.0, 520e-6]),
        ("direct", "up doppler down", 0.0, [0.0, 0.0, 500e-6]),
        ("direct", "doppler down up", 0.0, [500e-6, 0.0, 0.0]),
    ],
)
def test_segments_follow_those_that_there_are(architecture, order, gap, starts, table_4_1):
    scene = table_4_1(architecture=architecture, radial_velocity=80.0)
    shots = prepared(scene | {SEGMENT_ORDER_PATH: order, SEGMENT_GAP_PATH: gap})
    np.testing.assert_allclose(
        [float(start) for start in shots.motion.segment_starts], starts, rtol=1e-12
    )
    assert shots.has_segment.tolist() == [True, architecture != "direct" and "dopp" in order, True]


@pytest.mark.parametrize("segment", [0, 1, 2])
@pytest.mark.parametrize("a, order", [(0.0, 0), (-11.4, 3), (900.0, 4)])
def test_the_records_are_those_of_one_delay_over_the_whole_shot(segment, a, order, table_4_1):
    """In 40 digits: R - v T - a T^2 / 2 from the shot's start, and each segment's own chirp."""
    place = SEGMENT_ORDERS[order].split().index(SEGMENT_NAMES[segment])
    range_0, v, start = 1400.0, -130.0, place * 500e-6
    shots = prepared(
        table_4_1(
            range=range_0, radial_velocity=v, beamlets=1, fft_size=512, sample_rate=1.2e6,
            acquisition_delay=20e-6, detector_bandwidth=1e30, amplifier_bandwidth=1e30,
        )
        | {"target.acceleration": a, SEGMENT_ORDER_PATH: SEGMENT_ORDERS[order]}
    )  # fmt: skip
    record = time_domain_truth.beamlet_analytic_signal(shots, 0, segment, 0, with_acceleration=True)
    sign, carrier = DEFAULT_CHIRP_RATE_RATIOS[segment], float(shots.waveform.carriers[segment])
    expected = []
    with mpmath.workdps(40):
        for n in range(0, 512, 73):
            t = 20e-6 + mpmath.mpf(n) / mpmath.mpf(1.2e6)
            since = start + t
            delay = 2 * (range_0 - v * since - mpmath.mpf(a) * since**2 / 2) / 299792458
            emitted = [carrier * at + sign * mpmath.mpf(2e12) * at**2 / 2 for at in (t - delay, t)]
            cycles = emitted[0] - emitted[1]
            expected.append(complex(mpmath.expjpi(2 * (cycles - mpmath.nint(cycles)))))
    rotation = record[::73] / abs(record[::73])
    # a range of 1400 m is rounded to 2e-13 m of 775 nm a turn, cycles of 1e5 to 1e-11
    assert np.abs(rotation - expected).max() < 1e-5


def draw_scene(number):
    rng = np.random.default_rng((23, number))
    scene = {
        "architecture": ("homodyne", "heterodyne", "direct")[number % 3],
        "phases": ("coherent", "incoherent")[number // 3 % 2],
        "window": ("hann", "hamming", "rectangular", "kaiser(8.6)")[number % 4],
        "beamlets": int(rng.integers(1, 60)), "fft_size": int(rng.choice([1000, 1023, 4096])),
        "range": 10 ** rng.uniform(0.5, 4), "grazing_angle": rng.uniform(0.1, 1.5),
        "beam_divergence": 10 ** rng.uniform(-5, -2.5), "radial_velocity": rng.uniform(-300, 300),
        "acquisition_delay": float(rng.choice([0.0, 70e-6])),
    }  # fmt: skip
    further_parameters = {
        "target.acceleration": rng.choice([-1, 1]) * 10 ** rng.uniform(0, 5),
        "target.transverse_velocity": rng.uniform(-200, 200),
        SEGMENT_ORDER_PATH: SEGMENT_ORDERS[number % len(SEGMENT_ORDERS)],
        SEGMENT_GAP_PATH: float(rng.choice([0.0, 130e-6])),
    }
    return scene, further_parameters


def disagreement(shots, **keeps_walk):
    return max(
        magnitude_error(
            shots,
            segment_spectra.segment_spectrum(shots, 0, int(segment))[1],
            time_domain_truth.time_domain_spectrum(shots, 0, int(segment), **keeps_walk),
        )
        for segment in np.flatnonzero(shots.has_segment)
    )


@pytest.mark.parametrize("number", range(24))
def test_the_fast_path_is_the_truth_as_the_target_moves_on(number, table_4_1):
    scene, further_parameters = draw_scene(number)
    parameters = table_4_1(**scene) | further_parameters
    assert disagreement(prepared(parameters), with_range_walk=False) < 1e-9, scene


@pytest.mark.parametrize("number", range(0, 24, 5))
def test_the_drift_within_a_record_is_that_of_its_own_segment(number, table_4_1):
    """One beamlet: range walk, acceleration and a beam that slides, from where its segment is."""
    scene, further_parameters = draw_scene(number)
    parameters = table_4_1(**scene | {"beamlets": 1}) | further_parameters
    shots = prepared(parameters, (*MOVING, "range_walk", "acceleration"))
    assert disagreement(shots, with_acceleration=True) < 1e-8, scene


@pytest.mark.parametrize("frequency", [0.0, 300e6, -600e6])
def test_lines_meet_their_images_at_the_phase_of_where_they_have_come_to(frequency, table_4_1):
    rate, carrier = 2e12, speed_of_light / 1550e-9
    scene = table_4_1(range=1234.5, fft_size=1024, phases="coherent", beamlets=5)
    v = (frequency + rate * 2 * 1234.5 / speed_of_light) / carrier * speed_of_light / 2
    for a in (0.0, 3.0):
        shots = prepared(scene | {"target.radial_velocity": -v, "target.acceleration": a})
        assert disagreement(shots, with_range_walk=False) < 1e-9


def test_beamlets_keep_their_own_velocities_from_segment_to_segment(table_4_1):
    """A millimetre a second for a millisecond is 1.3 cycles at 1550 nm, which phases show."""
    rng = np.random.default_rng(3)
    scene = table_4_1(fft_size=4096, phases="coherent", radial_velocity=20.0, range=900.0)
    shots = prepared(scene | {"footprint.beamlets": 19})
    perturbed_shots = replace(
        shots,
        footprint=shots.footprint._replace(
            doppler_ratio_offset=rng.uniform(
                -1e-8, 1e-8, shots.footprint.relative_range_offset.shape
            )
        ),
    )
    assert disagreement(perturbed_shots, with_range_walk=False) < 1e-9


@pytest.mark.parametrize("velocity", [150.0, -90.0])
@pytest.mark.parametrize("across", [0.0, 40.0])
@pytest.mark.parametrize("order, up, down", [(0, 0, 2), (1, 0, 1), (3, 2, 0), (7, 1, 0)])
def test_what_is_reported_is_put_right_by_the_velocity_that_is_measured(
    velocity, across, order, up, down, table_4_1
):
    """Down to 0.1 mm and 3 um/s; what slides over the slope is not known, nor put right."""
    if order == 1:  # |f_d| < f_r
        velocity /= 20
    scene = table_4_1(
        range=812.34, radial_velocity=velocity, power=100.0, beamlets=1, grazing_angle=1.1
    )
    moving = {"target.transverse_velocity": across, SEGMENT_ORDER_PATH: SEGMENT_ORDERS[order]}
    shots = prepared(scene | moving, (*MOVING, "range_walk"))
    keys = np.ones((1, 2), np.uint64)
    returns = draw_returns(shots, list_bin_groups(shots), keys=keys, draws=400)
    slid = across / np.tan(1.1)
    within = (up + down) / 2 * 500e-6 + 2**17 / 600e6 / 2
    error = np.median(returns.range_interpolated[0, :, 0]) - 812.34
    assert error == pytest.approx(-slid * within, abs=1e-4)
    mixed = slid * 2e12 * (down - up) / 2 * 500e-6 / (speed_of_light / 1550e-9)
    speed = np.median(returns.radial_velocity_interpolated[0, :, 0])
    assert speed == pytest.approx(velocity - mixed, abs=3e-6)


TILT = np.radians(22.5)
SLOWS = (100.0**2 - 30.0**2) / (2 * 400.0)
"""Morpheus' deceleration from 100 to 30 m/s over 400 m [m/s^2]."""


def of_flight(table_4_1, effects):
    """The first shots of three beams, falling straight at level ground from 500 m."""
    shot_eyepoints = observe_shots(
        straight_flight(
            (0.0, 0.0, 500.0), (0.0, 0.0, -100.0), acceleration=(0.0, 0.0, SLOWS), duration=6.0
        ),
        scanner=fixed_beams(cone_directions(3, half_angle=TILT), rate=1.0),
        index=np.arange(3),
        number=1,
    )
    ground = [SurfaceMaterial("ground", 0.1, "lambert")]
    return prepare_eyepoint_shots(
        shot_eyepoints,
        PARAMETER_DEFAULTS | scene_parameters(table_4_1, beamlets=1),
        ground,
        effects,
    )


def of_grid(table_4_1, effects):
    """The same as a plane at 67.5 degrees."""
    along = {"target.acceleration": -SLOWS * np.cos(TILT)}
    across = {"target.transverse_velocity": 100.0 * np.sin(TILT)}
    scene = table_4_1(
        range=500.0 / np.cos(TILT), radial_velocity=100.0 * np.cos(TILT), beamlets=1,
        grazing_angle=np.pi / 2 - TILT, reflectance_law="lambert", phases="incoherent",
    )  # fmt: skip
    return prepared(scene | along | across, effects)


@pytest.mark.parametrize("make_shots", [of_flight, of_grid])
def test_morpheus_magnitudes_are_those_of_the_truth_that_decelerates(make_shots, table_4_1):
    """Without the acceleration they are off by a tenth, 14 kHz of drift over bins of 4.6 kHz."""
    within = (*MOVING, "range_walk")
    slowing, steady = (make_shots(table_4_1, (*within, *also)) for also in (["acceleration"], []))
    assert float(np.ravel(slowing.target.acceleration)[0]) == pytest.approx(-10.509, abs=1e-3)
    assert float(np.ravel(slowing.target.approach_speed)[0]) == pytest.approx(100.0 / np.cos(TILT))
    assert disagreement(slowing, with_acceleration=True) < 1e-8
    lost = disagreement(steady, with_acceleration=True)
    assert 0.05 < lost < 0.3


def test_a_flight_s_plan_lists_what_its_path_calls_for(table_4_1):
    """Deceleration by 11 m/s^2; a hovering lidar has neither."""
    ground = [SurfaceMaterial("ground", 0.1, "lambert")]
    called = []
    for slows in (SLOWS, 0.0):
        eyepoints = observe_shots(
            straight_flight(velocity=(0.0, 0.0, -slows), acceleration=(0.0, 0.0, slows)), number=7
        )
        planned = plan_shot_effects(
            eyepoints,
            np.zeros(1, np.int64),
            scene_parameters(table_4_1, beamlets=7),
            ground,
            modes={},
            has_rotating_bodies=False,
        )
        flags = planned.selected_effects(1).effect_flags
        called.append(
            {"acceleration", "segment_motion"} & set(effect_names_in_flags(int(flags[0])))
        )
    assert called == [{"acceleration", "segment_motion"}, set()]


def test_speckles_turn_once_between_segments(table_4_1):
    """By their own Doppler shifts, in the lines' phases or in the speckle's; never in both."""
    scene = table_4_1(
        range=900.0, phases="incoherent", beamlets=7, grazing_angle=np.pi / 2, radial_velocity=0.0,
        beam_divergence=1e-3, fft_size=2**13,
    )  # fmt: skip
    rough = scene | {"target.roughness": 1e-3, "target.transverse_velocity": 3.0}
    (one,), (other,) = (
        iter_realisations(
            rough, (*DEFAULT_EFFECTS, *also), keys=np.ones((1, 2), np.uint64), draws=1
        )
        for also in (["speckle"], ["speckle", "segment_motion"])
    )
    for segment in range(3):
        first, second = (
            segment_spectra.segment_spectrum(pair.shots, 0, segment)[1] for pair in (one, other)
        )
        np.testing.assert_allclose(first, second, atol=1e-5 * first.max())
    starts = [
        segment_spectra.segment_spectrum(one.shots, 0, segment)[1].max() for segment in (0, 2)
    ]
    assert abs(starts[0] / starts[1] - 1) > 0.05
