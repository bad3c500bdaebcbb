"""Navigation from point clouds: what it takes, and its errors through the whole flow."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shot_helpers import DRAWS
from small_scenes import level_plate, observe_shots, scene_parameters, straight_flight

from sweep.model.geometry.body_motion import FixedAttitude
from sweep.model.geometry.mesh import SurfaceMaterial
from sweep.model.geometry.scanner import (
    BeamCycle,
    PointingJitter,
    cone_directions,
    corner_directions,
    square_patterns,
)
from sweep.model.outputs import NAVIGATION_VARIABLES
from sweep.model.pointcloud import navigation
from sweep.model.pointcloud.navigation import (
    STATUS_EXCLUDED,
    STATUS_SOLVED,
    STATUS_UNDETERMINED,
    STATUS_WITHHELD,
    solve_navigation,
)
from sweep.model.pointcloud.pairing import FALSE_ALARM_FLAG, TRUE_RETURN_FLAG, UNCONFIRMED_FLAG
from sweep.model.pointcloud.point_cloud import simulate_cloud
from sweep.model.sampling import philox
from sweep.spec.scene_sections import Navigation

MOVING = np.array([12.0, -7.0, -85.0])
THREE, FOUR = (
    cone_directions(3, half_angle=np.radians(22.5), azimuth=0.2),
    corner_directions(np.radians(22.5)),
)
SIXTEEN = square_patterns(np.radians([15.0, 7.5]))[0].reshape(-1, 3)
PATTERNS = pytest.mark.parametrize("beams", [THREE, FOUR, SIXTEEN], ids=len)


def _shots(shot_eyepoints):
    return {
        "platform_position": shot_eyepoints.position,
        "platform_velocity": shot_eyepoints.velocity,
        "beam_direction": shot_eyepoints.direction,
        "beam_turning": shot_eyepoints.direction_rate,
        "platform_acceleration": shot_eyepoints.platform_acceleration,
    }


def _points(shot_eyepoints, *, draws=1, returns=3, range_error=0.02, velocity_error=3e-4):
    """Points that state the truth exactly, one for each shot and draw, with standard errors."""
    shape = len(shot_eyepoints.time), draws, returns
    points = {"flags": np.zeros(shape, np.uint8)}
    points["flags"][..., 0] = TRUE_RETURN_FLAG
    for name, value, error in (
        ("range", shot_eyepoints.range, range_error),
        ("radial_velocity", shot_eyepoints.radial_velocity, velocity_error),
    ):
        points[f"{name}_per_slip"] = np.zeros(shape)
        for suffix, column in (
            ("_interpolated", value[:, None]),
            ("_interpolated_standard_error", error),
            ("_standard_error", np.hypot(error, 0.1)),
        ):
            points[name + suffix] = np.full(shape, np.nan)
            points[name + suffix][..., 0] = column
    return points


def _seen(beams, *, number=6, path=None, rate=2.0, interval=None, **keywords):
    """Shots of some cycles over level ground."""
    shots_per_cycle = len(beams)
    scanner = BeamCycle(beams, [list(range(shots_per_cycle))], rate, interval)
    path = straight_flight(position=(0.0, 0.0, 900.0), velocity=MOVING) if path is None else path
    return observe_shots(
        path, scanner=scanner, index=np.arange(number * shots_per_cycle), number=1, **keywords
    )


def _solved(shot_eyepoints, points, beams, ground_slope=0.0, **keywords):
    arguments = {"shots_per_cycle": len(beams), "ground_slope": ground_slope}
    return solve_navigation(_shots(shot_eyepoints), points, **arguments, **keywords)


# Without chance


@PATTERNS
def test_true_points_give_the_mean_velocity_and_the_altitude_at_the_start(beams):
    """Of an accelerating, turned platform whose beams fire one after another.

    A relative rounding of 2e-16 in ranges and velocities, times condition numbers under 10.
    """
    attitude = FixedAttitude(
        Rotation.from_euler("xyz", [0.1, -0.2, 0.7]).as_quat(scalar_first=True)
    )
    path = straight_flight((3.0, 4.0, 900.0), MOVING, attitude, acceleration=(3.0, -6.0, 9.0))
    shot_eyepoints = _seen(beams, path=path)
    solution = _solved(shot_eyepoints, _points(shot_eyepoints, draws=2), beams, test_level=0.001)
    beam_velocities = shot_eyepoints.velocity.reshape(6, -1, 3)
    assert np.ptp(beam_velocities, axis=1).max() > 1.0
    expected = np.broadcast_to(beam_velocities.mean(axis=1)[:, None], (6, 2, 3))
    np.testing.assert_allclose(solution["velocity"], expected, atol=1e-11)
    height = shot_eyepoints.position[:: len(beams), 2]
    np.testing.assert_allclose(solution["altitude"], np.stack([height, height], 1), rtol=1e-12)
    assert solution.keys() == NAVIGATION_VARIABLES.keys()
    sizes = {"cycle": 6, "draw": 2, "xyz": 3, "xyz_again": 3}
    for name, output in NAVIGATION_VARIABLES.items():
        assert solution[name].dtype == output.dtype, name
        assert solution[name].shape == tuple(sizes[d] for d in output.dims), name
    for name in ("velocity", "altitude"):
        assert (solution[f"{name}_status"] == STATUS_SOLVED).all()
        assert (solution[f"{name}_beams"] == len(beams)).all()


def test_the_first_confirmed_point_of_a_shot_is_taken_whatever_it_is_in_truth():
    """Wrong values stand where the instrument must not look; a false alarm it can not know."""
    shot_eyepoints = _seen(FOUR)
    points, solution_of_first = (
        _points(shot_eyepoints),
        _solved(shot_eyepoints, _points(shot_eyepoints), FOUR),
    )
    for name in points:
        points[name][..., 1] = points[name][..., 0]  # the truth moves to the second place
    points["flags"][..., 0] = FALSE_ALARM_FLAG | UNCONFIRMED_FLAG
    points["flags"][..., 2] = TRUE_RETURN_FLAG
    for name in ("range", "radial_velocity"):
        for place in (0, 2):
            points[f"{name}_interpolated"][..., place] = 33.0
            points[f"{name}_interpolated_standard_error"][..., place] = 1e-9
            points[f"{name}_standard_error"][..., place] = 1e-3
    solution = _solved(shot_eyepoints, points, FOUR)
    for name in NAVIGATION_VARIABLES:
        np.testing.assert_array_equal(solution[name], solution_of_first[name], err_msg=name)
    points["flags"][..., 0] = FALSE_ALARM_FLAG
    fooled = _solved(shot_eyepoints, points, FOUR)
    assert (np.abs(fooled["altitude"] - solution_of_first["altitude"]) > 100.0).all()
    assert (fooled["velocity_status"] == STATUS_SOLVED).all()


def test_shots_without_a_confirmed_point_are_left_out():
    shot_eyepoints = _seen(FOUR)
    points = _points(shot_eyepoints)
    points["flags"][0] = 0  # nothing
    points["flags"][4 + 1] = TRUE_RETURN_FLAG | UNCONFIRMED_FLAG  # nothing to trust
    points["flags"][8:10] = 0  # two of four
    points["flags"][12:16] = 0  # all
    solution = _solved(shot_eyepoints, points, FOUR)
    assert solution["velocity_beams"][:, 0].tolist() == [3, 3, 0, 0, 4, 4]
    assert solution["altitude_beams"][:, 0].tolist() == [3, 3, 2, 0, 4, 4]
    status = [
        STATUS_SOLVED,
        STATUS_SOLVED,
        STATUS_UNDETERMINED,
        STATUS_UNDETERMINED,
        STATUS_SOLVED,
        STATUS_SOLVED,
    ]
    assert solution["velocity_status"][:, 0].tolist() == status
    assert np.isnan(solution["velocity"][2:4]).all() and np.isnan(solution["altitude"][3]).all()
    assert np.isnan(solution["velocity_covariance"][2:4]).all()
    solved = [0, 1, 4, 5]
    np.testing.assert_allclose(solution["velocity"][solved], np.tile(MOVING, (4, 1, 1)), atol=1e-11)


def test_standard_errors_of_nothing_count_as_a_millionth_of_a_bin_and_others_not_at_all():
    shot_eyepoints = _seen(FOUR)
    points = _points(shot_eyepoints)
    for name in ("range", "radial_velocity"):
        points[f"{name}_interpolated_standard_error"][4:8, :, 0] = 0.0
        points[f"{name}_standard_error"][4:8, :, 0] = 0.2
        points[f"{name}_interpolated_standard_error"][8, :, 0] = np.nan
        points[f"{name}_interpolated_standard_error"][12, :, 0] = np.inf
        points[f"{name}_interpolated_standard_error"][16, :, 0] = 0.0
        points[f"{name}_standard_error"][16, :, 0] = 0.0
    solution = _solved(shot_eyepoints, points, FOUR, pointing_jitter=1e-9)
    assert solution["velocity_beams"][:, 0].tolist() == [4, 4, 3, 3, 3, 4]
    ratio = solution["velocity_covariance"][1, 0] / solution["velocity_covariance"][0, 0]
    expected = ((0.2e-6) ** 2 + (1e-9 * 90) ** 2) / (3e-4) ** 2
    assert 0.4 * expected < np.diag(ratio).min() <= np.diag(ratio).max() < 2 * expected


def test_a_false_beam_is_found_among_sixteen_and_noticed_among_four():
    for beams, status in ((SIXTEEN, STATUS_EXCLUDED), (FOUR, STATUS_WITHHELD)):
        shot_eyepoints = _seen(beams)
        points = _points(shot_eyepoints)
        points["radial_velocity_interpolated"][1, :, 0] += 5.0
        solution = _solved(shot_eyepoints, points, beams, test_level=0.001)
        assert solution["velocity_status"][:, 0].tolist() == [status, *[STATUS_SOLVED] * 5]
        without = _solved(shot_eyepoints, points, beams, test_level=0.0)
        assert (without["velocity_status"] == STATUS_SOLVED).all()
        assert np.abs(without["velocity"][0, 0] - MOVING).max() > 0.1


def test_the_grounds_slope_and_relief_are_passed_on():
    """Free, the plane through sloping ground fits; held level, it does not; relief adds to it."""
    tilted = Rotation.from_euler("y", 0.2)
    path = straight_flight((0.0, 0.0, 900.0), (0.0, 0.0, 0.0))
    rest = straight_flight(
        (0.0, 0.0, 0.0), attitude=FixedAttitude(tilted.as_quat(scalar_first=True))
    )
    shot_eyepoints = _seen(FOUR, path=path, bodies=[level_plate()], body_motion=[rest])
    points = _points(shot_eyepoints)
    free, usual, held, contradicted = (
        _solved(shot_eyepoints, points, FOUR, ground_slope=slope, relief=relief)
        for slope, relief in (
            (1e7, 0.0), (Navigation().ground_slope, 0.0), (0.0, 0.0), (0.0, 7.0)
        )
    )  # fmt: skip
    level = _seen(FOUR, path=path, bodies=[level_plate()])
    rough = _solved(level, _points(level), FOUR, ground_slope=0.0, relief=7.0)
    np.testing.assert_allclose(free["altitude"], 900.0, rtol=1e-12)
    # As a study has it if it says nothing: off by far less than it states.
    scores = np.abs(usual["altitude"] - 900.0) / np.sqrt(usual["altitude_variance"])
    assert scores.max() < 1e-3 and (usual["altitude_variance"] < 1e-2).all()
    assert (np.abs(held["altitude"] - 900.0) > 1.0).all()
    # Of the mean of four points, and of the ground straight below.
    np.testing.assert_allclose(rough["altitude_variance"], 7.0**2 / 4 + 7.0**2, rtol=1e-3)
    # Ranges of a slope contradict level ground of that relief, and the variance follows them.
    assert (contradicted["altitude_variance"] > 100 * rough["altitude_variance"]).all()


@PATTERNS
def test_any_split_of_cycles_gives_the_same_bytes(beams, monkeypatch):
    shots_per_cycle = len(beams)
    shot_eyepoints = _seen(beams, number=40, rate=4.0)
    generator = np.random.default_rng(1)
    points = _points(shot_eyepoints)
    points["flags"][generator.random(points["flags"].shape) < 0.2] = 0
    for name in ("range", "radial_velocity"):
        points[f"{name}_interpolated"] += generator.normal(0, 1e-3, points["flags"].shape)
    options = {"test_level": 0.05, "pointing_jitter": 1e-5, "ground_slope": 0.1}
    solution = _solved(shot_eyepoints, points, beams, **options)
    assert len(np.unique(solution["velocity_status"])) > 1
    for first, last in ((0, 1), (1, 4), (5, 6)):
        shots = slice(shots_per_cycle * first, shots_per_cycle * last)
        part = {name: values[shots] for name, values in points.items()}
        solution_part = _solved(shot_eyepoints.select(shots), part, beams, **options)
        for name in NAVIGATION_VARIABLES:
            assert solution_part[name].tobytes() == solution[name][first:last].tobytes(), name
    monkeypatch.setattr(navigation, "BEAMS_PER_BATCH", 1)
    for name, values in _solved(shot_eyepoints, points, beams, **options).items():
        assert values.tobytes() == solution[name].tobytes(), name


# Through the whole flow


def _flown(table_4_1, beams, *, draws=DRAWS, method="probabilities", **changes):
    """Eyepoints and cloud of one cycle, and the velocity of its platform."""
    shot_eyepoints = _seen(beams, number=1, interval=0.0)
    keys = philox.point_keys(np.arange(float(len(beams)))[:, None], domain="cycles", seed=8)
    parameters = scene_parameters(table_4_1, **({"fft_size": 2**16, "window": "hann"} | changes))
    points = simulate_cloud(
        shot_eyepoints,
        parameters=parameters,
        surfaces=[SurfaceMaterial("ground", 0.1)],
        keys=keys,
        draws=draws,
        method=method,
        returns_max=2,
    )
    return shot_eyepoints, points


def _propagated(beams, velocity_error, range_error):
    """Covariance of the velocity and variance of the altitude over level ground.

    The minimum-variance linear estimates from u.v and from R cos(angle from nadir), by normal
    equations; the errors of beams are independent.
    """
    weighted = beams / velocity_error[:, None] ** 2
    height = 1 / np.sum(1 / (range_error * beams[:, 2]) ** 2)
    return np.linalg.inv(beams.T @ weighted), height


@PATTERNS
@pytest.mark.parametrize("method", ["probabilities", "noise"])
def test_mean_and_covariance_are_those_propagated_from_the_points(table_4_1, beams, method):
    """All beams detected at some 50 dB; the errors that are propagated are those of the points
    about the truth, beam by beam.

    The interpolation is good to 1e-3 bins of bias there, under the 5 sigma of the mean.
    """
    shot_eyepoints, points = _flown(table_4_1, beams, method=method, power=30.0)
    assert (points["flags"][:, :, 0] == TRUE_RETURN_FLAG).all()
    solution = _solved(shot_eyepoints, points, beams)
    assert (solution["velocity_status"] == STATUS_SOLVED).all()
    errors = {
        name: points[f"{name}_interpolated"][:, :, 0] - points[f"true_{name}"][:, :, 0]
        for name in ("range", "radial_velocity")
    }
    covariance, variance = _propagated(
        beams, errors["radial_velocity"].std(axis=1), errors["range"].std(axis=1)
    )
    error = solution["velocity"][0] - MOVING
    spread = np.sqrt(np.diag(covariance))
    assert (np.abs(error.mean(axis=0)) <= 5 * spread / np.sqrt(DRAWS)).all()
    # of a sample covariance of normal numbers: (C_ii C_jj + C_ij^2) / n
    allowed = 5 * np.sqrt((np.outer(spread, spread) ** 2 + covariance**2) / DRAWS)
    assert (np.abs(np.cov(error.T) - covariance) <= allowed).all()
    stated_covariance = solution["velocity_covariance"][0].mean(axis=0)
    assert (np.abs(np.cov(error.T) - stated_covariance) <= allowed).all()
    height = solution["altitude"][0] - shot_eyepoints.position[0, 2]
    assert abs(height.mean()) <= 5 * np.sqrt(variance / DRAWS)
    assert height.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / DRAWS))
    assert height.var() == pytest.approx(
        solution["altitude_variance"][0].mean(), rel=5 * np.sqrt(2 / DRAWS)
    )


@pytest.mark.parametrize("method", ["probabilities", "noise"])
def test_velocity_is_there_as_often_as_three_beams_are_confirmed(table_4_1, method):
    """Of three beams all, up, Doppler and down: the product of their nine probabilities.

    Of four beams any three. A false peak takes a true one's place by chance in at most 1e-4 of
    the draws.
    """
    for beams in (THREE, FOUR):
        shot_eyepoints, points = _flown(table_4_1, beams, method=method, power=0.008, tnr=9.5)
        beam_pd = points["pd_shot"] * points["pd_doppler"]
        assert ((beam_pd > 0.1) & (beam_pd < 0.95)).all()
        chance = np.prod(beam_pd)
        if len(beams) == 4:
            chance += sum(
                np.prod(np.where(np.arange(4) == b, 1 - beam_pd, beam_pd)) for b in range(4)
            )
        solution = _solved(shot_eyepoints, points, beams)
        n_solved = (solution["velocity_status"] == STATUS_SOLVED).sum()
        allowed = 5 * np.sqrt(DRAWS * chance * (1 - chance)) + 1e-4 * DRAWS
        assert abs(n_solved - DRAWS * chance) <= allowed
        assert np.isfinite(solution["velocity"][0]).all(axis=1).sum() == n_solved


def test_jitter_spreads_velocity_and_altitude_as_stated():
    """Points without any other error over many cycles, each with pointing of its own.

    Standard errors of beams then are sigma |v_perp| and sigma R tan(angle).
    """
    sigma, number = 2e-4, 5000
    path = straight_flight(velocity=(60.0, -20.0, 0.0))
    shot_eyepoints = _seen(
        FOUR, number=number, path=path, rate=number / 9.9, interval=0.0,
        jitter=PointingJitter(sigma, 4),
    )  # fmt: skip
    points = _points(shot_eyepoints, range_error=1e-9, velocity_error=1e-9)
    solution = _solved(shot_eyepoints, points, FOUR, pointing_jitter=sigma)
    across = np.linalg.norm(np.cross(FOUR, [60.0, -20.0, 0.0]), axis=1)
    tangent = np.hypot(FOUR[:, 0], FOUR[:, 1]) / -FOUR[:, 2]
    ranges = 1000.0 / -FOUR[:, 2]
    covariance, variance = _propagated(FOUR, sigma * across, sigma * ranges * tangent)
    stated_covariance = solution["velocity_covariance"][:, 0]
    # Covariances follow residuals that contradict them, by chance in one cycle of ten thousand.
    as_stated = (np.abs(stated_covariance - covariance) <= 0.01 * covariance.max()).all(axis=(1, 2))
    assert as_stated.mean() > 0.996
    close = np.isclose(solution["altitude_variance"], variance, rtol=0.01)
    assert close.mean() > 0.996
    error = solution["velocity"][:, 0] - [60.0, -20.0, 0.0]
    spread = np.sqrt(np.diag(covariance))
    assert (np.abs(error.mean(axis=0)) <= 5 * spread / np.sqrt(number)).all()
    allowed = 5 * np.sqrt((np.outer(spread, spread) ** 2 + covariance**2) / number)
    assert (np.abs(np.cov(error.T) - covariance) <= allowed).all()
    height = solution["altitude"][:, 0] - 1000.0
    assert height.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / number))
    screened = _solved(shot_eyepoints, points, FOUR, pointing_jitter=sigma, test_level=0.01)
    withheld = (screened["velocity_status"] == STATUS_WITHHELD).sum()
    assert abs(withheld - 0.01 * number) <= 5 * np.sqrt(0.01 * number)
