"""Navigation from measurement cycles, against closed forms, random draws and itself turned."""

from math import radians

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, ncx2
from shot_helpers import DRAWS, is_within_5_sigma

from sweep.model.geometry.scanner import cone_directions, corner_directions, square_patterns
from sweep.model.pointcloud import navigation
from sweep.model.pointcloud.navigation import (
    STATUS_EXCLUDED,
    STATUS_SOLVED,
    STATUS_UNDETERMINED,
    STATUS_WITHHELD,
    solve_velocity,
)

THREE = cone_directions(3, half_angle=radians(22.5))
FOUR = corner_directions(radians(22.5))
NARROW = corner_directions(radians(7.5))
SIXTEEN = square_patterns([radians(15.0), radians(7.5)])[0].reshape(-1, 3)
PATTERNS = pytest.mark.parametrize("beams", [THREE, FOUR, NARROW, SIXTEEN], ids=len)

MOVING = np.array([12.0, -7.0, -85.0])
NORMAL = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])


FREE = 1e7
"""Slope known so vaguely beforehand that the plane is free."""


def altitude(**keywords):
    """Altitudes over ground of any slope unless said otherwise."""
    return navigation.solve_altitude(**({"slope": FREE} | keywords))


def _ranges(beams, height, *, normal=(0.0, 0.0, 1.0), offset=0.0):
    """Ranges to the plane that passes `height` under the zero: n . (o + R u) = -height n_z."""
    normal = np.asarray(normal)
    ahead = np.broadcast_to(offset, (len(beams), 3)) @ normal
    return (-height * normal[2] - ahead) / (beams @ normal)


# ---- velocity ----


@pytest.mark.parametrize("half_angle", np.radians([2.0, 22.5, 45.0, 70.0]))
@pytest.mark.parametrize("number", [3, 4, 7])
def test_standard_errors_go_as_1_over_sine_across_and_1_over_cosine_along(number, half_angle):
    beams = cone_directions(number, half_angle=half_angle, azimuth=0.3)
    solution = solve_velocity(
        direction=beams, radial_velocity=np.zeros(number), standard_error=0.02
    )
    across = 0.02**2 * 2 / (number * np.sin(half_angle) ** 2)
    along = 0.02**2 / (number * np.cos(half_angle) ** 2)
    expected = np.diag([across, across, along])
    np.testing.assert_allclose(solution.covariance, expected, rtol=1e-11, atol=1e-11 * across)


@PATTERNS
def test_mean_and_covariance_of_drawn_velocities_are_those_propagated(beams):
    error = 0.01 * (1 + np.arange(len(beams)) % 3)  # unequal: the weights matter
    noise = np.random.default_rng(1).standard_normal((DRAWS, len(beams))) * error
    solution = solve_velocity(
        direction=beams, radial_velocity=beams @ MOVING + noise, standard_error=error
    )
    errors, stated_covariance = solution.estimate - MOVING, solution.covariance[0]
    variance = np.diag(stated_covariance)
    assert (np.abs(errors.mean(axis=0)) <= 5 * np.sqrt(variance / DRAWS)).all()
    # of a sample covariance of normal numbers: (C_ii C_jj + C_ij^2) / (n - 1)
    spread = np.sqrt((np.outer(variance, variance) + stated_covariance**2) / (DRAWS - 1))
    assert (np.abs(np.cov(errors.T) - stated_covariance) <= 5 * spread).all()
    degrees = len(beams) - 3
    assert abs(solution.chi_square.mean() - degrees) <= 5 * np.sqrt(2 * degrees / DRAWS) + 1e-9


def test_a_turned_frame_turns_the_solution():
    noise = np.random.default_rng(2).standard_normal(16) * 0.05
    error = np.linspace(0.01, 0.1, 16)
    measured = SIXTEEN @ MOVING + noise
    unturned = solve_velocity(direction=SIXTEEN, radial_velocity=measured, standard_error=error)
    for turn in Rotation.random(5, random_state=3).as_matrix():
        turned = solve_velocity(
            direction=SIXTEEN @ turn.T, radial_velocity=measured, standard_error=error
        )
        np.testing.assert_allclose(turned.estimate, turn @ unturned.estimate, atol=1e-11)
        np.testing.assert_allclose(
            turned.covariance, turn @ unturned.covariance @ turn.T, atol=1e-13 * 0.1
        )
        assert turned.chi_square == pytest.approx(unturned.chi_square, rel=1e-9)


def test_four_beams_can_spare_any_one_and_three_can_not():
    for beams, status in ((FOUR, STATUS_SOLVED), (THREE, STATUS_UNDETERMINED)):
        valid = ~np.eye(len(beams), dtype=bool)
        measured = np.where(valid, beams @ MOVING, np.nan)
        solution = solve_velocity(direction=beams, radial_velocity=measured, standard_error=0.01)
        assert (solution.status == status).all()
        assert (solution.is_beam_used == valid).all() and (solution.degrees_of_freedom == 0).all()
        if status == STATUS_SOLVED:
            np.testing.assert_allclose(solution.estimate, np.tile(MOVING, (4, 1)), atol=1e-12)
            full = solve_velocity(
                direction=beams, radial_velocity=beams @ MOVING, standard_error=0.01
            )
            lost = np.linalg.eigvalsh(solution.covariance - full.covariance)
            assert (lost > -1e-15).all()  # a beam less never makes anything better known
        else:
            assert np.isnan(solution.estimate).all() and np.isnan(solution.covariance).all()


def test_no_cycles_make_no_solutions():
    nothing = np.empty((0, 5, 4))
    solution = solve_velocity(
        direction=FOUR, radial_velocity=nothing, standard_error=0.01, test_level=0.01
    )
    assert solution.estimate.shape == (0, 5, 3) and solution.is_available.shape == (0, 5)


@pytest.mark.parametrize("half_angle", [1e-1, 1e-3, 1e-5, 1e-7])
def test_a_cone_so_narrow_that_rounding_spoils_it_is_refused(half_angle):
    """Singular values sqrt(3/2) sin and sqrt(3) cos: a condition number of 1e6 at 1.4e-6 rad."""
    beams = cone_directions(3, half_angle=half_angle)
    solution = solve_velocity(direction=beams, radial_velocity=beams @ MOVING, standard_error=0.01)
    assert solution.is_available == (np.sqrt(2) / np.tan(half_angle) < 1e6)
    assert np.isfinite(solution.estimate).all() == solution.is_available


def test_beams_in_a_plane_leave_the_velocity_across_undetermined():
    angle = np.radians([-20.0, -5.0, 5.0, 30.0])
    beams = np.column_stack([np.sin(angle), 0 * angle, -np.cos(angle)])
    beams = beams @ Rotation.from_rotvec([0.3, -0.5, 1.0]).as_matrix().T
    solution = solve_velocity(direction=beams, radial_velocity=beams @ MOVING, standard_error=0.01)
    assert solution.status == STATUS_UNDETERMINED and np.isnan(solution.estimate).all()


# ---- one false beam ----

LEVEL = 0.02


def _drawn_with_alarm(beams, *, alarm, beam, seed):
    measured = beams @ MOVING + np.random.default_rng(seed).normal(0, 0.01, (DRAWS, len(beams)))
    measured[:, beam] += alarm
    return solve_velocity(
        direction=beams, radial_velocity=measured, standard_error=0.01, test_level=LEVEL
    )


@PATTERNS
def test_true_beams_are_suspect_at_the_stated_level(beams):
    solution = _drawn_with_alarm(beams, alarm=0.0, beam=0, seed=6)
    suspect = (solution.status != STATUS_SOLVED).sum()
    assert suspect == 0 if len(beams) == 3 else is_within_5_sigma(suspect, LEVEL)


@pytest.mark.parametrize("beam", [0, 13])
def test_a_false_alarm_among_sixteen_beams_is_found_and_left_out(beam):
    """Far out, it is found whenever the fit without it passes: in 1 - level of the draws."""
    solution = _drawn_with_alarm(SIXTEEN, alarm=50.0, beam=beam, seed=7)
    right = (solution.status == STATUS_EXCLUDED) & ~solution.is_beam_used[:, beam]
    assert is_within_5_sigma(right.sum(), 1 - LEVEL)
    assert (solution.status[~right] == STATUS_WITHHELD).all() and np.isnan(
        solution.estimate[~right]
    ).all()
    assert (solution.is_beam_used[right].sum(axis=1) == 15).all() and (
        solution.degrees_of_freedom[right] == 12
    ).all()
    left = np.delete(SIXTEEN, beam, axis=0)
    stated_covariance = 0.01**2 * np.linalg.inv(left.T @ left)
    np.testing.assert_allclose(
        solution.covariance[right][0], stated_covariance, rtol=1e-9, atol=1e-16
    )
    errors = solution.estimate[right] - MOVING
    assert (np.abs(errors.mean(axis=0)) <= 5 * np.sqrt(np.diag(stated_covariance) / DRAWS)).all()


def test_the_power_of_the_test_is_that_of_the_noncentral_chi_square():
    beam, alarm = 3, 0.05  # 5 standard errors
    leverage = SIXTEEN[beam] @ np.linalg.solve(SIXTEEN.T @ SIXTEEN, SIXTEEN[beam])
    power = ncx2.sf(chi2.isf(LEVEL, 13), 13, (alarm / 0.01) ** 2 * (1 - leverage))
    assert 0.3 < power < 0.95
    solution = _drawn_with_alarm(SIXTEEN, alarm=alarm, beam=beam, seed=8)
    assert is_within_5_sigma((solution.status != STATUS_SOLVED).sum(), power)
    excluded = solution.status == STATUS_EXCLUDED
    assert (
        ~solution.is_beam_used[excluded, beam]
    ).mean() > 0.8  # a beam told from 15 others: 1/16 by chance


def test_two_false_alarms_are_withheld():
    measured = SIXTEEN @ MOVING
    measured[[2, 9]] += [40.0, -25.0]
    solution = solve_velocity(
        direction=SIXTEEN, radial_velocity=measured, standard_error=0.01, test_level=LEVEL
    )
    assert solution.status == STATUS_WITHHELD


def test_level_ground_tells_which_of_four_ranges_is_false():
    rng = np.random.default_rng(10)
    ranges = _ranges(FOUR, 400.0) + rng.normal(0, 0.1, (DRAWS, 4))
    ranges[np.arange(DRAWS), np.arange(DRAWS) % 4] = rng.uniform(0, 300, DRAWS)
    known = {"direction": FOUR, "range": ranges, "standard_error": 0.1, "test_level": LEVEL}
    solution = altitude(**known, slope=0.0)
    right = (solution.status == STATUS_EXCLUDED) & (
        solution.is_beam_used.argmin(axis=1) == np.arange(DRAWS) % 4
    )
    assert is_within_5_sigma(right.sum(), 1 - LEVEL)
    assert (
        altitude(**known).status == STATUS_WITHHELD
    ).all()  # a free plane has one degree of freedom


# ---- altitude ----


def test_a_platform_that_moves_between_beams_is_put_right_by_their_offsets():
    offset = np.linspace(-1.5, 1.5, 4)[:, None] * MOVING / 80
    ranges = _ranges(FOUR, 90.0, normal=NORMAL, offset=offset)
    solution = altitude(direction=FOUR, range=ranges, standard_error=0.1, offset=offset)
    assert solution.estimate == pytest.approx(90.0, rel=1e-13)


@PATTERNS
@pytest.mark.parametrize("slope", [FREE, 0.1, 0.0])
def test_the_altitudes_variance_is_its_response_to_each_range(beams, slope):
    """Variance = sum of (dh/dR_i)^2 sigma_i^2, by central differences, plus what slopes add."""
    error = np.linspace(0.05, 0.2, len(beams))
    ranges = _ranges(beams, 200.0)
    solution = altitude(direction=beams, range=ranges, standard_error=error, slope=slope)
    step = 1e-3 * np.eye(len(beams))
    high, low = (
        altitude(direction=beams, range=ranges + s, standard_error=error, slope=slope).estimate
        for s in (step, -step)
    )
    response = (high - low) / 2e-3
    from_slopes = 0.0
    if 0 < slope < FREE:  # the response to the ground's own slope, along x and y
        tilts = 1e-5 * np.array([[1, 0], [0, 1]])
        for tilt in tilts:
            normal = np.array([-tilt[0], -tilt[1], 1.0])
            tilted = altitude(
                direction=beams,
                range=_ranges(beams, 200.0, normal=normal),
                standard_error=error,
                slope=slope,
            )
            from_slopes += slope**2 * ((tilted.estimate - 200.0) / 1e-5) ** 2
    expected = np.sum((response * error) ** 2) + from_slopes
    # steps of 1e-5 relative leave that much, squared or not, of curvature
    assert solution.covariance == pytest.approx(expected, rel=2e-5)


@PATTERNS
def test_mean_and_variance_of_drawn_altitudes_are_those_propagated(beams):
    rng = np.random.default_rng(13)
    error = 0.05 * (1 + np.arange(len(beams)) % 3)
    down = -(beams @ NORMAL) / NORMAL[2]
    heights = rng.normal(0, 0.3, (DRAWS, len(beams)))  # relief lifts a point, the range shrinks
    ranges = (500.0 - heights) / down + rng.normal(0, 1, heights.shape) * error
    solution = altitude(direction=beams, range=ranges, standard_error=error, relief=0.3)
    errors, variance = solution.estimate - 500.0, solution.covariance.mean()
    # the curvature of the problem is of order variance / altitude, far below 5 sigma / sqrt(n)
    assert variance / 500 < 0.2 * np.sqrt(variance / DRAWS)
    assert abs(errors.mean()) <= 5 * np.sqrt(variance / DRAWS)
    assert abs(errors.var(ddof=1) / variance - 1) <= 5 * np.sqrt(2 / DRAWS)
    degrees = len(beams) - 3
    assert abs(solution.chi_square.mean() - degrees) <= 5 * np.sqrt(2 * degrees / DRAWS) + 1e-6


def test_on_a_steep_slope_errors_count_by_how_the_beams_meet_it():
    """At 30 deg the sines of beams uphill and downhill differ by a factor of 1.6."""
    normal = np.array([np.sin(radians(30.0)), 0.0, np.cos(radians(30.0))])
    noise = np.random.default_rng(16).normal(0, 0.1, (DRAWS, 4))
    ranges = _ranges(FOUR, 500.0, normal=normal) + noise
    solution = altitude(direction=FOUR, range=ranges, standard_error=0.1)
    assert abs(solution.estimate.var(ddof=1) / solution.covariance.mean() - 1) <= 5 * np.sqrt(
        2 / DRAWS
    )
    assert abs(solution.chi_square.mean() - 1) <= 5 * np.sqrt(2 / DRAWS)


def test_a_slope_known_beforehand_counts_in_the_variance_of_one_beam():
    solution = altitude(
        direction=FOUR[:1], range=[100.0], standard_error=0.1, slope=0.05, relief=0.2
    )
    cosine = -FOUR[0, 2]
    assert solution.estimate == pytest.approx(100 * cosine)
    expected = (0.1 * cosine) ** 2 + 0.2**2 + 0.05**2 * 100**2 * (1 - cosine**2)
    assert solution.covariance == pytest.approx(expected, rel=1e-12)


def test_two_beams_see_the_slope_along_their_line():
    """Nadir lies between them, so that the slope across it does not matter."""
    beams, height = FOUR[[0, 2]], 300.0
    solution = altitude(
        direction=beams, range=_ranges(beams, height, normal=NORMAL), standard_error=0.1
    )
    assert (
        solution.estimate == pytest.approx(height, rel=1e-12) and solution.degrees_of_freedom == 1
    )


def test_no_beam_gives_no_altitude():
    solution = altitude(
        direction=FOUR, range=np.full(4, np.nan), standard_error=0.1, test_level=0.01
    )
    assert solution.status == STATUS_UNDETERMINED and not solution.is_available
    assert np.isnan(solution.estimate) and np.isnan(solution.covariance)


def test_a_tiny_slope_is_level_ground():
    ranges = _ranges(SIXTEEN, 300.0, normal=NORMAL)
    ranges += np.random.default_rng(14).normal(0, 1.0, 16)
    near, at = (
        altitude(direction=SIXTEEN, range=ranges, standard_error=1.0, slope=s) for s in (1e-9, 0.0)
    )
    for name in ("estimate", "covariance", "chi_square"):
        assert getattr(near, name) == pytest.approx(getattr(at, name), rel=1e-9), name


def test_ground_of_random_slope_is_off_by_the_stated_variance():
    """Two beams at one side; slopes of 0.03 curve the problem by 0.03 tan(30 deg), squared 3e-4."""
    rng = np.random.default_rng(15)
    tilt = rng.normal(0, 0.03, (DRAWS, 2))
    beams = FOUR[:2]
    ranges = 200.0 / (tilt @ beams[:, :2].T - beams[:, 2]) + rng.normal(0, 0.1, (DRAWS, 2))
    solution = altitude(direction=beams, range=ranges, standard_error=0.1, slope=0.03)
    ratio = np.mean((solution.estimate - 200.0) ** 2) / solution.covariance.mean()
    assert abs(ratio - 1) <= 5 * np.sqrt(2 / DRAWS) + 0.01
    assert solution.covariance.mean() > 100 * 0.1**2  # by far the slope's doing
    assert (
        solution.degrees_of_freedom == 1
    ).all()  # two heights and two slopes known, three sought
    assert abs(solution.chi_square.mean() - 1) <= 5 * np.sqrt(2 / DRAWS) + 0.01


def test_a_beam_that_grazes_the_fitted_plane_does_not_run_off_with_the_weight():
    """A false range tilts the plane until another beam runs along it or past it."""
    ranges = _ranges(SIXTEEN, 100.0)
    ranges[0] = 9000.0
    solution = altitude(direction=SIXTEEN, range=ranges, standard_error=0.1, test_level=1e-3)
    assert solution.status == STATUS_EXCLUDED and not solution.is_beam_used[0]
    assert solution.estimate == pytest.approx(100.0, rel=1e-12)
