import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sweep.model.geometry import scanner
from sweep.model.geometry.scanner import BeamCycle, LineScan, fixed_beams, raster_scan

DEGREE = math.pi / 180
NADIR = np.array([0.0, 0.0, -1.0])


def from_nadir(directions):
    return np.degrees(np.arccos(-directions[:, 2]))


def axis_angles(directions):
    return np.degrees(np.arctan2(directions[:, :2], -directions[:, 2:]))


def test_three_beams_stand_22_5_deg_from_nadir_and_120_deg_apart():
    three = scanner.cone_directions(3, half_angle=22.5 * DEGREE, azimuth=0.4)
    np.testing.assert_allclose(np.linalg.norm(three, axis=1), 1)
    np.testing.assert_allclose(from_nadir(three), 22.5)
    azimuth = np.unwrap(np.arctan2(three[:, 1], three[:, 0]))
    np.testing.assert_allclose(np.degrees(np.diff(azimuth)), 120)
    assert azimuth[0] == pytest.approx(0.4)
    # Their sum points down and no component across is left.
    np.testing.assert_allclose(three.sum(axis=0)[:2], 0, atol=1e-15)


@pytest.mark.parametrize("angle", [22.5, 7.5])
def test_the_four_corners_draw_a_square_on_level_ground(angle):
    corners = scanner.corner_directions(angle * DEGREE)
    ground = corners / -corners[:, 2:]
    side = 2 * math.tan(angle * DEGREE)
    np.testing.assert_allclose(np.linalg.norm(np.diff(ground, axis=0), axis=1), side)
    np.testing.assert_allclose(np.abs(axis_angles(corners)), angle)


def test_stacked_elements_reach_the_four_angles_of_the_steerer():
    reached = np.degrees(scanner.stacked_deflections([15 * DEGREE, 7.5 * DEGREE]))
    np.testing.assert_allclose(reached, [-22.5, -7.5, 7.5, 22.5])


def test_the_sixteen_angles_make_four_squares_from_the_widest_to_the_narrowest():
    directions, patterns = scanner.square_patterns([15 * DEGREE, 7.5 * DEGREE])
    grid = axis_angles(directions)
    expected = {(x, y) for x in (-22.5, -7.5, 7.5, 22.5) for y in (-22.5, -7.5, 7.5, 22.5)}
    assert {tuple(pair) for pair in np.round(grid, 9)} == expected
    np.testing.assert_allclose(np.abs(grid[patterns[0]]), 22.5)
    np.testing.assert_allclose(np.abs(grid[patterns[3]]), 7.5)
    ground = directions / -directions[:, 2:]
    for pattern in patterns:
        corners = ground[pattern][:, :2]
        sides = np.roll(corners, -1, axis=0) - corners
        lengths = np.linalg.norm(sides, axis=1)
        np.testing.assert_allclose(lengths, lengths[0])
        np.testing.assert_allclose((sides * np.roll(sides, -1, axis=0)).sum(axis=1), 0, atol=1e-14)
        np.testing.assert_allclose(corners.sum(axis=0), 0, atol=1e-14)
        assert np.cross([*sides[0], 0], [*sides[1], 0])[2] > 0  # counter-clockwise
    assert len(set(patterns.ravel())) == 16


def test_equal_elements_reach_the_same_angle_twice_and_are_refused():
    with pytest.raises(ValueError, match="different angles"):
        scanner.square_patterns([10 * DEGREE, 10 * DEGREE])


def test_cycles_take_the_patterns_in_turn_at_the_measurement_rate():
    directions, patterns = scanner.square_patterns([15 * DEGREE, 7.5 * DEGREE])
    scan = BeamCycle(directions, patterns, cycle_rate=20.0)
    shots = scan.shots(np.arange(40))
    np.testing.assert_array_equal(shots.cycle_number, np.arange(40) // 4)
    np.testing.assert_array_equal(shots.beam_number, np.concatenate([patterns.ravel()] * 3)[:40])
    np.testing.assert_allclose(shots.time[::4], np.arange(10) / 20, rtol=1e-15)
    np.testing.assert_allclose(np.diff(shots.time), 1 / 80, rtol=1e-12)
    np.testing.assert_allclose(shots.direction, directions[shots.beam_number], atol=1e-15)


def test_fixed_telescopes_fire_at_once_and_a_steered_beam_takes_its_time():
    three = scanner.cone_directions(3, half_angle=0.4)
    at_once = fixed_beams(three, rate=1.0).shots(np.arange(6))
    np.testing.assert_array_equal(at_once.time, [0, 0, 0, 1, 1, 1])
    in_turn = fixed_beams(three, rate=1.0, interval=1.5e-3).shots(np.arange(6))
    np.testing.assert_allclose(in_turn.time, [0, 1.5e-3, 3e-3, 1, 1.0015, 1.003])


SCANS = [
    fixed_beams(scanner.cone_directions(3, half_angle=0.4), rate=1.0),
    fixed_beams(scanner.corner_directions(0.1), rate=20.0, interval=None),
    fixed_beams(scanner.corner_directions(0.1), rate=7.0, interval=1.5e-3),
    LineScan(0.1, line_rate=3.0, rate=11.0, along=(1e-3, -1e-3)),
    LineScan(0.1, line_rate=3.0, rate=11.0, along=(1e-3, 0.0, -1e-3), interval=0.02),
    raster_scan(columns=5, rows=3, half_angles=(0.2, 0.1), rate=2.0),
]


@pytest.mark.parametrize("scan", SCANS)
@given(duration=st.floats(0, 50))
def test_the_number_of_shots_counts_all_that_begin(scan, duration):
    number = scan.count_shots(duration)
    times = scan.shots(np.arange(number + 10)).time
    assert (times[:number] <= duration * (1 + 1e-9) + 1e-7).all()
    assert (times[number:] >= duration * (1 - 1e-9) - 1e-7).all()
    assert (np.diff(times) >= 0).all()


@pytest.mark.parametrize("scan", SCANS)
def test_a_shot_that_begins_just_at_the_end_is_counted_however_its_time_was_rounded(scan):
    times = scan.shots(np.arange(500)).time
    for last in (0, 7, 123, 399):
        expected = (times <= times[last]).sum()  # with those that are fired at the same time
        for rounded in (times[last], np.nextafter(times[last], 0), np.nextafter(times[last], 99)):
            assert scan.count_shots(rounded) == expected
    assert scan.count_shots(-1e-3) == 0


@pytest.mark.parametrize("scan", SCANS)
def test_any_stretch_of_shots_is_what_it_is_in_the_whole(scan):
    all_shots, part = scan.shots(np.arange(1000)), scan.shots(np.arange(700, 730))
    for one, other in zip(all_shots, part, strict=True):
        np.testing.assert_array_equal(one[700:730], other)


def test_a_million_shots_in_the_clock_has_not_drifted():
    scan = fixed_beams(scanner.corner_directions(0.1), rate=20.0, interval=None)
    assert scan.shots(np.array([4 * 10**9])).time[0] == 10**9 / 20


def test_fore_and_aft_beams_keep_their_angle_while_they_sweep():
    scan = LineScan(8 * DEGREE, line_rate=10.0, rate=2000.0, along=(250e-6, -250e-6))
    shots = scan.shots(np.arange(800))
    forward = np.arcsin(shots.direction[:, 0])
    np.testing.assert_allclose(forward[shots.beam_number == 0], 250e-6, rtol=1e-9)
    np.testing.assert_allclose(forward[shots.beam_number == 1], -250e-6, rtol=1e-9)
    np.testing.assert_array_equal(shots.time[::2], shots.time[1::2])
    across = np.degrees(np.arctan2(shots.direction[:, 1], -shots.direction[:, 2]))
    assert across.min() == pytest.approx(-8) and across.max() == pytest.approx(8)
    assert across[0] == pytest.approx(-8)  # from the right, where y is negative
    np.testing.assert_allclose(np.radians(across), scan.sweep_angle(shots.time), atol=1e-14)
    # Closing on level ground for the fore beam, opening for the aft one, as the platform moves on.
    radial = shots.direction @ [10.0, 0.0, 0.0]
    assert (radial[shots.beam_number == 0] > 0).all() and (radial[shots.beam_number == 1] < 0).all()


def test_a_triangle_sweeps_at_a_constant_rate_and_a_sine_like_a_resonant_mirror():
    t = np.linspace(0.01, 0.09, 9)
    triangle = LineScan(0.2, line_rate=10.0, rate=100.0)
    np.testing.assert_allclose(np.diff(triangle.sweep_angle(t)), 0.4 * 10 * 0.01, rtol=1e-9)
    sine = LineScan(0.2, line_rate=10.0, rate=100.0, wave="sine")
    step = 1e-4
    bend = (
        sine.sweep_angle(t + step) - 2 * sine.sweep_angle(t) + sine.sweep_angle(t - step)
    ) / step**2
    np.testing.assert_allclose(
        bend, -((math.pi * 10) ** 2) * sine.sweep_angle(t), rtol=1e-5, atol=1e-6
    )
    for scan in (triangle, sine):
        assert scan.sweep_angle(0.0) == pytest.approx(-0.2) == scan.sweep_angle(0.2)
        assert scan.sweep_angle(0.1) == pytest.approx(0.2)
        assert scan.sweep_angle(0.05) == pytest.approx(0.0, abs=1e-15)


def test_a_raster_visits_its_grid_row_by_row_and_back():
    scan = raster_scan(columns=4, rows=3, half_angles=(6 * DEGREE, 2 * DEGREE), rate=1.0)
    grid = axis_angles(scan.shots(np.arange(12)).direction)
    np.testing.assert_allclose(grid[:, 0], np.repeat([-2, 0, 2], 4), atol=1e-12)
    row = [-6, -2, 2, 6]
    np.testing.assert_allclose(grid[:, 1], [*row, *row[::-1], *row], atol=1e-12)
    one_way = raster_scan(
        columns=4, rows=3, half_angles=(6 * DEGREE, 2 * DEGREE), rate=1.0, both_ways=False
    )
    grid = axis_angles(one_way.shots(np.arange(12)).direction)
    np.testing.assert_allclose(grid[:, 1], row * 3, atol=1e-12)


def test_a_raster_of_one_direction_looks_at_nadir():
    scan = raster_scan(columns=1, rows=1, half_angles=(0.1, 0.1), rate=5.0)
    np.testing.assert_array_equal(scan.shots(np.arange(3)).direction, [NADIR] * 3)


@pytest.mark.parametrize(
    "make",
    [
        lambda: fixed_beams([[0, 0, 0]], rate=1.0),
        lambda: fixed_beams(scanner.corner_directions(0.1), rate=0.0),
        lambda: fixed_beams(scanner.corner_directions(0.1), rate=100.0, interval=3e-3),
        lambda: BeamCycle(scanner.corner_directions(0.1), [[0, 4]], cycle_rate=1.0),
        lambda: BeamCycle(scanner.corner_directions(0.1), [[]], cycle_rate=1.0),
        lambda: LineScan(2.0, line_rate=1.0, rate=1.0),
        lambda: LineScan(0.1, line_rate=0.0, rate=1.0),
        lambda: LineScan(0.1, line_rate=1.0, rate=1.0, wave="square"),
        lambda: LineScan(0.1, line_rate=1.0, rate=10.0, along=(0.0, 0.1), interval=0.06),
    ],
)
def test_scans_that_can_not_be_are_refused(make):
    with pytest.raises(ValueError, match=r"cycle|rate|fit|beams|patterns|scan"):
        make()
