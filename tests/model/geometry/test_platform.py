import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sweep.model.geometry import quaternion as quat
from sweep.model.geometry.attitude import AlongTrack, Fixed, Nadir, Spin
from sweep.model.geometry.platform import ConstantAcceleration, Flight, Waypoints, straight

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


@pytest.mark.parametrize("path", [CURVE, BURN, Waypoints(TIMES, PLACES, smooth=False)])
def test_velocity_and_acceleration_are_the_derivatives_of_the_position(path):
    t = np.linspace(path.start + 0.01, path.stop - 0.01, 57)
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
    descent = straight(begin=(5, 6, high), end=(5, 6, low), initial_speed=fast, final_speed=slow)
    first, last = (descent.motion(np.array([t])) for t in (descent.start, descent.stop))
    np.testing.assert_allclose(first.position[0], [5, 6, high])
    np.testing.assert_allclose(last.position[0], [5, 6, low], atol=1e-9)
    np.testing.assert_allclose(first.velocity[0], [0, 0, -fast])
    np.testing.assert_allclose(last.velocity[0], [0, 0, -slow], atol=1e-9)
    # The work done on a unit mass is the change of its kinetic energy.
    work = -first.acceleration[0, 2] * (high - low)
    assert work == pytest.approx((slow**2 - fast**2) / 2)


def test_a_straight_path_at_one_speed_has_no_acceleration():
    way = straight(begin=(0, 0, 500), end=(300, 0, 100), initial_speed=25.0)
    assert way.stop == pytest.approx(20.0)
    motion = way.motion(np.linspace(0, 20, 5))
    assert not motion.acceleration.any()
    np.testing.assert_allclose(motion.velocity, [[15, 0, -20]] * 5)


@pytest.mark.parametrize("smooth", [True, False])
def test_waypoints_are_passed_at_their_times(smooth):
    path = Waypoints(TIMES, PLACES, smooth=smooth)
    np.testing.assert_allclose(path.motion(TIMES).position, PLACES, atol=1e-10)
    assert (path.start, path.stop) == (0.0, 11.0)


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
    flight = Flight(CURVE, AlongTrack(roll=0.2), lever_arm=(2.0, -1.0, 0.5))
    t = np.linspace(0.1, 10.9, 31)
    after, before = flight.state(t + STEP), flight.state(t - STEP)
    velocity = (after.position - before.position) / (2 * STEP)
    np.testing.assert_allclose(flight.state(t).velocity, velocity, atol=1e-6)
    arm = flight.state(t).position - CURVE.motion(t).position
    np.testing.assert_allclose(np.linalg.norm(arm, axis=1), math.sqrt(5.25), rtol=1e-9)


def test_an_arm_on_a_spinning_body_runs_round_a_circle():
    hover = ConstantAcceleration([0, 0, 100.0], [0, 0, 0], [0, 0, 0], 10.0)
    flight = Flight(hover, Spin(rate=(0, 0, 0.5)), lever_arm=(3.0, 0.0, 0.0))
    t = np.linspace(0, 10, 21)
    state = flight.state(t)
    circle = [3 * np.cos(t / 2), 3 * np.sin(t / 2), np.full(21, 100.0)]
    np.testing.assert_allclose(state.position, np.column_stack(circle), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(state.velocity, axis=1), 1.5)


def test_radial_velocity_is_the_closing_of_the_range_to_a_fixed_point():
    flight = Flight(BURN, Nadir(), lever_arm=(1.0, 0.0, 0.0))
    point, t = np.array([200.0, 30.0, 0.0]), np.linspace(0.1, 9.9, 9)
    state = flight.state(t)
    line = (point - state.position) / np.linalg.norm(point - state.position, axis=1)[:, None]
    radial = (state.velocity * line).sum(axis=1)
    ranges = [np.linalg.norm(point - flight.state(t + s).position, axis=1) for s in (STEP, -STEP)]
    np.testing.assert_allclose(radial, -(ranges[0] - ranges[1]) / (2 * STEP), atol=1e-6)


@given(st.floats(0, 10), st.floats(0, 2 * math.pi))
def test_a_fixed_attitude_does_not_turn(t, angle):
    q = quat.about(1, angle)
    state = Flight(BURN, Fixed(3 * q)).state(np.array([t]))
    np.testing.assert_allclose(state.attitude, [q], atol=1e-15)
    assert not state.rate.any()


@pytest.mark.parametrize("t", [-0.1, 10.1, math.nan])
def test_times_beside_the_path_are_refused(t):
    with pytest.raises(ValueError, match="on the path"):
        BURN.motion(np.array([1.0, t]))


def test_the_very_end_is_on_the_path_however_it_was_rounded():
    assert BURN.motion(np.array([10.0 * (1 + 1e-15)])).position[0] == pytest.approx(
        BURN.motion(np.array([10.0])).position[0]
    )


@pytest.mark.parametrize(
    "make",
    [
        lambda: straight(begin=(0, 0, 1), end=(0, 0, 1), initial_speed=1),
        lambda: straight(begin=(0, 0, 1), end=(0, 0, 2), initial_speed=0, final_speed=0),
        lambda: straight(begin=(0, 0, 1), end=(0, 0, 2), initial_speed=-1, final_speed=5),
        lambda: ConstantAcceleration([0] * 3, [0] * 3, [0] * 3, 0.0),
        lambda: Waypoints([0, 1, 1], np.zeros((3, 3))),
        lambda: Waypoints([0], np.zeros((1, 3))),
        lambda: Waypoints([0, 1], np.zeros((2, 2))),
    ],
)
def test_paths_that_lead_nowhere_are_refused(make):
    with pytest.raises(ValueError, match=r"path|times|waypoints"):
        make()
