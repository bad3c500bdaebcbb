import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sweep.model.geometry import quaternion as quat
from sweep.model.geometry.body_motion import (
    AlongTrackAttitude,
    AttitudeTrack,
    ConstantAcceleration,
    FixedAttitude,
    MountedAttitude,
    MovingBody,
    NadirAttitude,
    SpinningAttitude,
    Waypoints,
    straight_trajectory,
)
from sweep.model.geometry.scanner import transverse_axes

TIMES = np.array([0.0, 2.0, 3.5, 7.0, 8.0, 11.0])
PLACES = np.array(
    [[0, 0, 500], [50, 10, 450], [90, 40, 420], [140, 20, 400], [150, 0, 390], [160, -60, 300]]
)
CURVE = Waypoints(TIMES, PLACES)
BURN = ConstantAcceleration([1.0, 2.0, 500.0], [30.0, -5.0, -40.0], [-2.0, 1.0, 3.0], 10.0)
STEP = 1e-4


def differentiated(path, t, step=STEP):
    after, before = path.motion(t + step), path.motion(t - step)
    return (after.position - before.position) / (2 * step), (after.velocity - before.velocity) / (
        2 * step
    )


@pytest.mark.parametrize("path", [CURVE, BURN, Waypoints(TIMES, PLACES, is_smooth=False)])
def test_velocity_and_acceleration_are_the_derivatives_of_the_position(path):
    t = np.linspace(path.start_time + 0.01, path.stop_time - 0.01, 57)
    t = t[np.abs(t[:, None] - TIMES).min(axis=1) > 2 * STEP]  # straight legs have corners
    velocity, acceleration = differentiated(path, t)
    motion = path.motion(t)
    # Central differences: third derivatives of 10 m/s^3 times step^2/6, and rounding of 500 m.
    np.testing.assert_allclose(motion.velocity, velocity, atol=1e-7)
    np.testing.assert_allclose(motion.acceleration, acceleration, atol=1e-5)


@pytest.mark.parametrize(
    ("high", "low", "fast", "slow"),
    [(2000, 500, 100, 32), (500, 100, 100, 30), (500, 10, 32, 0), (2000, 10, 100, 50)],
)
def test_a_descent_begins_and_ends_at_the_stated_heights_and_speeds(high, low, fast, slow):
    descent = straight_trajectory(
        start_point=(5, 6, high), end_point=(5, 6, low), initial_speed=fast, final_speed=slow
    )
    first, last = (descent.motion(np.array([t])) for t in (descent.start_time, descent.stop_time))
    np.testing.assert_allclose(first.position[0], [5, 6, high])
    np.testing.assert_allclose(last.position[0], [5, 6, low], atol=1e-9)
    np.testing.assert_allclose(first.velocity[0], [0, 0, -fast])
    np.testing.assert_allclose(last.velocity[0], [0, 0, -slow], atol=1e-9)
    # The work done on a unit mass is the change of its kinetic energy.
    work = -first.acceleration[0, 2] * (high - low)
    assert work == pytest.approx((slow**2 - fast**2) / 2)


def test_a_straight_path_at_one_speed_has_no_acceleration():
    way = straight_trajectory(start_point=(0, 0, 500), end_point=(300, 0, 100), initial_speed=25.0)
    assert way.stop_time == pytest.approx(20.0)
    motion = way.motion(np.linspace(0, 20, 5))
    assert not motion.acceleration.any()
    np.testing.assert_allclose(motion.velocity, [[15, 0, -20]] * 5)


@pytest.mark.parametrize("smooth", [True, False])
def test_waypoints_are_passed_at_their_times(smooth):
    path = Waypoints(TIMES, PLACES, is_smooth=smooth)
    np.testing.assert_allclose(path.motion(TIMES).position, PLACES, atol=1e-10)
    assert (path.start_time, path.stop_time) == (0.0, 11.0)


def test_a_spline_through_points_of_a_cubic_is_that_cubic():
    def cubic(t):
        return np.column_stack([t**3 - 4 * t, 2 * t**2, 500 - t])

    t = np.linspace(0, 11, 40)
    np.testing.assert_allclose(
        Waypoints(TIMES, cubic(TIMES)).motion(t).position, cubic(t), atol=1e-10
    )


def test_far_off_waypoints_move_like_near_ones():
    far = Waypoints(TIMES, PLACES + np.array([8e6, -3e5, 0]))
    t = np.linspace(0, 11, 30)
    np.testing.assert_allclose(far.motion(t).velocity, CURVE.motion(t).velocity, atol=1e-8)


def test_an_instrument_on_an_arm_moves_with_the_body_that_turns_it():
    flight = MovingBody(CURVE, AlongTrackAttitude(roll=0.2), lever_arm=(2.0, -1.0, 0.5))
    t = np.linspace(0.1, 10.9, 31)
    after, before = flight.state(t + STEP), flight.state(t - STEP)
    velocity = (after.position - before.position) / (2 * STEP)
    np.testing.assert_allclose(flight.state(t).velocity, velocity, atol=1e-6)
    arm = flight.state(t).position - CURVE.motion(t).position
    np.testing.assert_allclose(np.linalg.norm(arm, axis=1), math.sqrt(5.25), rtol=1e-9)


@given(st.floats(0, 10), st.floats(0, 2 * math.pi))
def test_a_fixed_attitude_does_not_turn(t, angle):
    q = quat.from_axis_angle(1, angle)
    state = MovingBody(BURN, FixedAttitude(3 * q)).state(np.array([t]))
    np.testing.assert_allclose(state.attitude, [q], atol=1e-15)
    assert not state.angular_velocity.any()


@pytest.mark.parametrize("t", [-0.1, 10.1, math.nan])
def test_times_outside_the_path_are_refused(t):
    with pytest.raises(ValueError, match="on the path"):
        BURN.motion(np.array([1.0, t]))


def test_the_very_end_is_on_the_path_however_it_was_rounded():
    assert BURN.motion(np.array([10.0 * (1 + 1e-15)])).position[0] == pytest.approx(
        BURN.motion(np.array([10.0])).position[0]
    )


@pytest.mark.parametrize(
    "make",
    [
        lambda: straight_trajectory(start_point=(0, 0, 1), end_point=(0, 0, 1), initial_speed=1),
        lambda: straight_trajectory(
            start_point=(0, 0, 1), end_point=(0, 0, 2), initial_speed=0, final_speed=0
        ),
        lambda: straight_trajectory(
            start_point=(0, 0, 1), end_point=(0, 0, 2), initial_speed=-1, final_speed=5
        ),
        lambda: ConstantAcceleration([0] * 3, [0] * 3, [0] * 3, 0.0),
        lambda: Waypoints([0, 1, 1], np.zeros((3, 3))),
        lambda: Waypoints([0], np.zeros((1, 3))),
        lambda: Waypoints([0, 1], np.zeros((2, 2))),
    ],
)
def test_paths_that_lead_nowhere_are_refused(make):
    with pytest.raises(ValueError, match=r"path|times|waypoints"):
        make()


FORWARD, LEFT, UP = np.eye(3)

NODES_AT = np.array([0.0, 1.0, 2.5, 4.0, 6.0])
TURNING = Waypoints(NODES_AT, [[0, 0, 90], [20, 5, 80], [45, 30, 85], [50, 60, 60], [20, 90, 40]])
NODES = Rotation.random(5, rng=np.random.default_rng(1)).as_quat(scalar_first=True)

angles = st.floats(-math.pi, math.pi)
vectors = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


def unit(seed, number=20):
    return Rotation.random(number, rng=np.random.default_rng(seed)).as_quat(scalar_first=True)


def scipys(q):
    return Rotation.from_quat(q, scalar_first=True)


def same_rotation(p, q, atol=1e-12):
    np.testing.assert_allclose(np.abs(np.sum(p * q, axis=-1)), 1, atol=atol)


def turned(law, t):
    motion = TURNING.motion(t)
    return law.attitude_and_rate(t, motion.velocity, motion.acceleration)


def test_products_inverses_and_turned_vectors_agree_with_scipy():
    p, q = unit(1), unit(2)
    v = np.random.default_rng(3).normal(size=(20, 3))
    same_rotation(quat.multiply(p, q), (scipys(p) * scipys(q)).as_quat(scalar_first=True))
    same_rotation(quat.conjugate(p), scipys(p).inv().as_quat(scalar_first=True))
    np.testing.assert_allclose(quat.rotate(p, v), scipys(p).apply(v), atol=1e-14)
    np.testing.assert_allclose(quat.rotate(p[0], v), scipys(p[0]).apply(v), atol=1e-14)


@given(vectors)
def test_rotation_vectors_agree_with_scipy_there_and_back(vector):
    q = quat.from_rotation_vector(vector)
    same_rotation(q, Rotation.from_rotvec(vector).as_quat(scalar_first=True))
    back = quat.to_rotation_vector(q)
    assert np.linalg.norm(back) <= math.pi + 1e-12
    same_rotation(quat.from_rotation_vector(back), q)
    if np.linalg.norm(vector) < 3.14:
        np.testing.assert_allclose(back, vector, atol=1e-12)


@given(angles, st.floats(-1.5, 1.5), angles)
def test_heading_pitch_and_roll_are_turns_about_up_right_and_forward(heading, pitch, roll):
    """Intrinsic z, -y, x: nose up for a positive pitch, left side up for a positive roll."""
    q = quat.from_heading(heading=heading, pitch=pitch, roll=roll)
    expected = Rotation.from_euler("ZYX", [heading, -pitch, roll])
    same_rotation(q, expected.as_quat(scalar_first=True))


@pytest.mark.parametrize(
    "law",
    [
        NadirAttitude(0.3),
        NadirAttitude(None),
        AlongTrackAttitude(),
        AlongTrackAttitude(roll=0.7),
        SpinningAttitude(
            angular_velocity=(0.3, -0.2, 0.9), initial_quaternion=NODES[0], initial_time=1.0
        ),
        AttitudeTrack(NODES_AT, NODES),
        MountedAttitude(AlongTrackAttitude(), quat.from_axis_angle(1, 0.8)),
        FixedAttitude(NODES[1]),
    ],
    ids=lambda law: type(law).__name__,
)
def test_the_rate_is_the_derivative_of_the_attitude_in_the_world_frame(law):
    step = 1e-5
    t = np.linspace(0.05, 5.95, 33)
    t = t[
        np.abs(t[:, None] - NODES_AT).min(axis=1) > 2 * step
    ]  # a track turns abruptly at its nodes
    q, rate = turned(law, t)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-12)
    after, before = turned(law, t + step)[0], turned(law, t - step)[0]
    change = quat.to_rotation_vector(quat.multiply(after, quat.conjugate(before)))
    np.testing.assert_allclose(rate, change / (2 * step), atol=1e-8)


@pytest.mark.parametrize("law", [NadirAttitude(), NadirAttitude(1.2), NadirAttitude(None)])
def test_a_nadir_beam_points_straight_down(law):
    q, _ = turned(law, np.linspace(0, 6, 9))
    np.testing.assert_allclose(quat.rotate(q, -UP), [-UP] * 9, atol=1e-15)


def test_along_track_the_nose_follows_the_velocity_and_the_wings_are_level():
    t = np.linspace(0, 6, 25)
    q, _ = turned(AlongTrackAttitude(), t)
    velocity = TURNING.motion(t).velocity
    heading = velocity / np.linalg.norm(velocity, axis=1)[:, None]
    np.testing.assert_allclose(quat.rotate(q, FORWARD), heading, atol=1e-12)
    np.testing.assert_allclose(quat.rotate(q, LEFT)[:, 2], 0, atol=1e-15)
    assert (quat.rotate(q, UP)[:, 2] > 0).all()


@pytest.mark.parametrize("law", [AlongTrackAttitude(roll=0.3), NadirAttitude(None)])
@pytest.mark.parametrize("power", [-200, -100, 100])
def test_a_movement_in_slow_motion_turns_the_same_way(law, power):
    """Turns follow from ratios of velocity and acceleration: powers of two change no bit."""
    t = np.linspace(0, 6, 25)
    _, velocity, acceleration = TURNING.motion(t)[:3]
    slow = np.ldexp(velocity, power), np.ldexp(acceleration, power)
    for one, other in zip(
        law.attitude_and_rate(t, velocity, acceleration),
        law.attitude_and_rate(t, *slow),
        strict=True,
    ):
        assert np.array_equal(one, other)
    straight = law.attitude_and_rate(t, slow[0], np.zeros_like(velocity))[1]
    assert not straight.any()


@pytest.mark.parametrize("law", [AlongTrackAttitude(), NadirAttitude(None)])
@pytest.mark.parametrize("velocity", [[1e-320, 0.0, 0.0], [0.0, 0.0, -5.0]])
def test_next_to_no_speed_and_a_vertical_descent_have_no_heading(law, velocity):
    with pytest.raises(ValueError, match="has no heading to follow"):
        law.attitude_and_rate(np.zeros(1), np.array([velocity]), np.array([[0.0, 1.0, 0.0]]))


def test_a_bank_lifts_the_left_wing_by_its_angle():
    level, banked = (turned(AlongTrackAttitude(roll=r), np.array([1.0]))[0] for r in (0.0, 0.4))
    left, lifted = quat.rotate(level, LEFT), quat.rotate(banked, LEFT)
    assert (left * lifted).sum() == pytest.approx(math.cos(0.4))
    assert lifted[0, 2] > 0


def test_a_track_passes_its_nodes_and_rests_beyond_them():
    track = AttitudeTrack(
        NODES_AT, NODES * np.array([1, -1, 1, -1, 1])[:, None]
    )  # q and -q are one
    zero = np.zeros((5, 3))
    q, _ = track.attitude_and_rate(NODES_AT, zero, zero)
    same_rotation(q, NODES)
    q, rate = track.attitude_and_rate(np.array([-5.0, 99.0]), zero[:2], zero[:2])
    same_rotation(q, NODES[[0, -1]])
    assert not rate.any()


def test_a_track_turns_at_a_constant_rate_between_nodes():
    t = np.linspace(1.01, 2.49, 20)
    zero = np.zeros((20, 3))
    _, rate = AttitudeTrack(NODES_AT, NODES).attitude_and_rate(t, zero, zero)
    np.testing.assert_allclose(rate, rate[:1].repeat(20, 0), atol=1e-12)
    assert np.linalg.norm(rate[0]) == pytest.approx(
        (scipys(NODES[1]).inv() * scipys(NODES[2])).magnitude() / 1.5
    )


def test_a_mounted_instrument_is_turned_first():
    q, _ = turned(
        MountedAttitude(NadirAttitude(), quat.from_axis_angle(1, -math.pi / 4)), np.array([1.0])
    )
    # Tilted about -y by 45 deg, the nadir beam looks half forward.
    forward = quat.rotate(q, -UP)[0]
    np.testing.assert_allclose(forward, [math.sqrt(0.5), 0, -math.sqrt(0.5)], atol=1e-12)


def test_transverse_axes_complete_a_right_handed_frame():
    u = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.6, 0.0, -0.8], [0.0, 0.6, 0.8]])
    first, second = transverse_axes(u)
    np.testing.assert_allclose(np.cross(first, second), u, atol=1e-15)
    np.testing.assert_allclose((first * u).sum(axis=1), 0, atol=1e-15)
    np.testing.assert_allclose(first[0], FORWARD, atol=1e-15)
