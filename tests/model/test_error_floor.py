"""Errors that no echo lowers: closed forms, draws of them, what navigation makes of them."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from small_scenes import observe_shots, straight_flight

import sweep
from sweep.model.geometry.scanner import BeamCycle
from sweep.model.pointcloud.error_floor import ErrorFloor, apply_error_floor
from sweep.model.pointcloud.navigation import solve_navigation
from sweep.model.pointcloud.pairing import TRUE_RETURN_FLAG
from sweep.model.sampling import philox
from sweep.scenes.eyepoint_arrays import eyepoints_to_arrays
from sweep.spec import SceneSpec

DRAWS = 20_000
MOVING = np.array([60.0, -25.0, -90.0])
BEAMS = np.array([
    [-0.2998, -0.3996, -0.8663], [0.0810, -0.4900, -0.8680],
    [0.1178, -0.7326, -0.6703], [0.4192, -0.2778, -0.8643],
])  # fmt: skip
"""Of the Doppler lidar of NASA's deorbit, descent and landing flights, DDL-F1."""
BEAMS /= np.linalg.norm(BEAMS, axis=1, keepdims=True)
FLOOR = ErrorFloor(pointing=2e-3, clock=3e-4, wavelength=2e-4, vibration=0.05, range_noise=0.2)
EACH_FLOOR_TERM = pytest.mark.parametrize(
    "name", [name for name, value in FLOOR._asdict().items() if value > 0]
)
NOISE = {"range": 0.02, "radial_velocity": 3e-3}
"""Standard errors of noise."""


def _spread_is(values, expected):
    """True if normal numbers have a standard deviation, within 5 of its errors."""
    return abs(values.std() / expected - 1) < 5 / np.sqrt(2 * values.size)


@EACH_FLOOR_TERM
def test_standard_errors_are_those_of_an_instrument_that_takes_its_errors_for_none(name):
    """Beats are counted by a clock, light has a wavelength, beams point, and the frame shakes."""
    random, sigma = np.random.default_rng(7), FLOOR._asdict()[name]
    wavelength, per_metre, beam, far = 1.55e-6, 1.3e4, BEAMS[2], 900.0
    normal = random.standard_normal((DRAWS, 3)) * sigma
    known, lengths, shaken, rate = beam, wavelength, 0.0, 1.0
    if name == "pointing":  # about two axes across the beam, exactly
        axes = np.cross(beam, [[0, 0, 1.0], np.cross(beam, [0, 0, 1.0])])
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        known = Rotation.from_rotvec(normal[:, :2] @ axes).apply(beam)
    elif name == "clock":  # so many samples of a beat are thought to take another time
        rate = 1 + normal[:, 0]
    elif name == "wavelength":
        lengths = wavelength * (1 + normal[:, 0])
    elif name == "vibration":
        shaken = normal[:, 0]
    doppler = 2 * (MOVING @ beam + shaken) / wavelength
    closing = doppler * rate * lengths / 2 - known @ MOVING
    floor = ErrorFloor(**{name: sigma})
    across = np.linalg.norm(np.cross(beam, MOVING))
    expected = floor.velocity_error(np.array(MOVING @ beam), across)
    assert _spread_is(np.ravel(closing), expected) if expected else not closing.any()
    if name == "clock":
        assert _spread_is(per_metre * far * rate / per_metre, floor.clock * far)


def _flown(cycles=2):
    """Shots of four beams over level ground, one cycle after the other."""
    scanner = BeamCycle(BEAMS, [[0, 1, 2, 3]], 5.0, 0.0)
    path = straight_flight(position=(0.0, 0.0, 900.0), velocity=MOVING)
    return observe_shots(path, scanner=scanner, index=np.arange(4 * cycles), number=1)


def _points(shot_eyepoints, draws, noise=0.0):
    """Points that state the truth but for noise of a share of its standard errors."""
    shape, random = (len(shot_eyepoints.time), draws, 1), np.random.default_rng(3)
    points = {
        "flags": np.full(shape, TRUE_RETURN_FLAG, np.uint8),
        "position": np.full((*shape, 3), np.nan),
    }
    for name, error in NOISE.items():
        points[f"{name}_per_slip"] = np.zeros(shape)
        truth = getattr(shot_eyepoints, name)[:, None, None] + np.zeros(shape)
        for suffix in ("", "_interpolated"):
            noise_deviates = noise * error * random.standard_normal(shape) if noise else 0.0
            points[name + suffix] = truth + noise_deviates
            points[f"{name}{suffix}_standard_error"] = np.full(shape, error)
    return points


def with_error_floor(shot_eyepoints, points, floor, first_draw=0, shots=slice(None)):
    index = np.arange(len(shot_eyepoints.time))[shots]
    keys = philox.point_keys(index[:, None].astype(float), domain="shots", seed=5)
    return apply_error_floor(
        points, shot_eyepoints.select(shots), floor, keys=keys, seed=5, first_draw=first_draw
    )


@EACH_FLOOR_TERM
def test_points_deviate_by_their_stated_errors_jointly_or_independently(name):
    eyepoints, floor = _flown(), ErrorFloor(**{name: FLOOR._asdict()[name]})
    perturbed = with_error_floor(eyepoints, _points(eyepoints, DRAWS), floor)
    far, closing = (
        perturbed[f"{key}_interpolated"][..., 0] - getattr(eyepoints, key)[:, None] for key in NOISE
    )
    for key, error in (("range", far), ("radial_velocity", closing)):
        stated_error = perturbed[f"{key}_interpolated_standard_error"][..., 0]
        floor_errors = np.sqrt((stated_error**2 - NOISE[key] ** 2).mean(axis=1))
        for shot in range(8):
            is_affected = name == "clock" or (key == "range") == (name == "range_noise")
            assert (
                _spread_is(error[shot], floor_errors[shot])
                if is_affected
                else not error[shot].any()
            )
    np.testing.assert_allclose(perturbed["radial_velocity_compensated"][..., 0], closing, atol=1e-9)
    correlations = np.corrcoef(far if name == "range_noise" else closing)
    number = np.arange(8) % 4
    together = {
        "clock": np.ones((8, 8), bool), "wavelength": np.ones((8, 8), bool),
        "pointing": number == number[:, None],
    }.get(name, np.eye(8, dtype=bool))  # fmt: skip
    sign = np.sign(np.outer(eyepoints.radial_velocity, eyepoints.radial_velocity))
    assert correlations[together] == pytest.approx(sign[together], abs=1e-9)
    assert np.abs(correlations[~together]).max(initial=0) < 5 / np.sqrt(DRAWS)
    at = eyepoints.position[:, None] + eyepoints.range[:, None, None] * eyepoints.direction[:, None]
    displacement = np.linalg.norm(perturbed["position"][:, :, 0] - at, axis=2)
    expected = {
        "clock": floor.clock * eyepoints.range,
        "pointing": np.sqrt(2) * floor.pointing * eyepoints.range,
        "range_noise": np.full(8, floor.range_noise),
    }.get(name, np.zeros(8))
    rms = np.sqrt((displacement**2).mean(axis=1))
    assert rms == pytest.approx(expected, rel=5 / np.sqrt(DRAWS), abs=1e-9)


def test_any_stretch_of_shots_and_draws_is_the_same_bit_for_bit():
    shot_eyepoints = _flown()
    points = _points(shot_eyepoints, 50)
    at_once = with_error_floor(shot_eyepoints, points, FLOOR)
    part = {name: values[3:6, 20:31] for name, values in points.items()}
    perturbed = with_error_floor(shot_eyepoints, part, FLOOR, first_draw=20, shots=slice(3, 6))
    for name, values in perturbed.items():
        np.testing.assert_array_equal(values, at_once[name][3:6, 20:31], err_msg=name)


@pytest.mark.parametrize("floor", [
    *(ErrorFloor(**{name: 10 * value}) for name, value in FLOOR._asdict().items()), FLOOR,
])  # fmt: skip
def test_velocity_and_altitude_deviate_by_their_covariances(floor):
    """And residuals show the pointing and the vibration alone."""
    shot_eyepoints = _flown(1)
    perturbed = with_error_floor(shot_eyepoints, _points(shot_eyepoints, DRAWS, noise=1.0), floor)
    solution = solve_navigation(
        eyepoints_to_arrays(shot_eyepoints),
        perturbed,
        shots_per_cycle=4,
        ground_slope=0.0,
        error_floor=floor,
    )
    errors, stated_covariance = (
        solution["velocity"][0] - MOVING,
        solution["velocity_covariance"][0].mean(axis=0),
    )
    variance = np.diag(stated_covariance)
    spread = np.sqrt((np.outer(variance, variance) + stated_covariance**2) / DRAWS)
    assert (np.abs(np.cov(errors.T) - stated_covariance) <= 5 * spread).all()
    height = solution["altitude"][0]
    assert abs(height.mean() - 900.0) < 1.0
    share = height.var() / solution["altitude_variance"][0].mean()
    # points that pointing has moved lie on no level plane through the others: second order, 1 %
    assert share == pytest.approx(1, abs=5 * np.sqrt(2 / DRAWS) + 0.01)
    residual = (
        perturbed["radial_velocity_interpolated"][:, :, 0].T - solution["velocity"][0] @ BEAMS.T
    )
    across = np.linalg.norm(np.cross(BEAMS, MOVING), axis=1)
    velocity_sigma = np.hypot(
        NOISE["radial_velocity"], np.hypot(floor.pointing * across, floor.vibration)
    )
    weighed, square = BEAMS / velocity_sigma[:, None], np.eye(4)
    expected = velocity_sigma * np.sqrt(np.diag(square - weighed @ np.linalg.pinv(weighed)))
    assert np.sqrt((residual**2).mean(axis=0)) == pytest.approx(
        expected, rel=5 / np.sqrt(2 * DRAWS) + 1e-3
    )


EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def _descent(
    tmp_path, *, power, top, bottom, rate="5 Hz", draws=1, speckle="developed", **sections
):
    """A descent by the four beams of DDL-F1 over level ground."""
    instrument = yaml.safe_load((EXPERIMENTS / "instruments" / "table_5_1.yaml").read_text())
    instrument["laser"]["power"] = power
    instrument["telescope"]["coupling"] = "single_mode"
    instrument["receiver"]["noise_shape"] = "receiver"
    instrument["processing"] |= {"detection": "any_bin", "noise_bins": "correlated"}
    spec = SceneSpec.from_mapping({
        "title": "Four beams", "instrument": instrument,
        "scene": {"origin": "ground", "objects": {
            "ground": {"kind": "plane", "size": "60 km", "reflectance": 0.1},
        }},
        "platform": {"path": {
            "kind": "straight", "from": ["0 m", "0 m", top], "to": ["300 m", "0 m", bottom],
            "initial_speed": "100 m/s", "final_speed": "100 m/s",
        }},
        "scanners": {"four": {
            "kind": "fixed", "beams": [[str(x) for x in beam] for beam in BEAMS], "rate": rate,
        }},
        "footprint": {"beamlets": 1, "speckle": speckle}, "draws": {"number": draws},
    } | sections)  # fmt: skip
    store = tmp_path / "descent.zarr"
    assert sweep.run(spec, store=store, scheduler="none", progress=False).complete
    return sweep.open_scene(store)["four"].to_dataset().load()


def test_the_flattest_of_four_beams_is_lost_first(tmp_path):
    """At 0.91 of its neighbour's range, within a tenth: sqrt(cos i) by Lambert is 0.88."""
    navigation = _descent(tmp_path, power="20 mW", top="4 km", bottom="1 km")
    far, pd = (
        navigation[name].to_numpy().reshape(-1, 4)[::-1] for name in ("beam_range", "pd_shot")
    )
    lost = [np.interp(-0.5, -pd[:, k], far[:, k]) for k in range(4)]
    assert lost[2] / lost[1] == pytest.approx(0.91, rel=0.1)


@pytest.mark.parametrize(("floor", "low", "high"), [
    ({}, 4e-6, 6e-6),
    ({"vibration": "0.27 m/s", "pointing_error": "0.5 mrad", "clock_error": 1e-5,
      "wavelength_error": 1e-5}, 0.13, 0.145),
])  # fmt: skip
def test_velocities_of_four_beams_close_as_the_floor_has_it(tmp_path, floor, low, high):
    """RMS residual of a beam in the four's least squares, by the floor and by noise alone.

    Three unknowns leave one direction n to four beams' errors e, of which beam k's residual is
    n_k (n . e): half an error in all, if errors are alike. Segments begin together, or the slide
    of beams over slanting ground between them would bias velocities by 1e-4 m/s.
    """
    navigation = _descent(
        tmp_path, power="1 W", top="700 m", bottom="500 m", rate="50 Hz", draws=40,
        speckle="none", effects={"segment_motion": "off"}, error_floor=floor,
    )  # fmt: skip
    closing, stated_error = (
        navigation[f"radial_velocity_interpolated{name}"].to_numpy()[..., 0].reshape(-1, 4, 40)
        for name in ("", "_standard_error")
    )
    beams = navigation["beam_direction"].to_numpy().reshape(-1, 4, 3)
    residual = closing - np.einsum("cbi,cdi->cbd", beams, navigation["velocity"].to_numpy())
    closure = np.sqrt((residual**2).mean())
    assert low < closure < high
    null = np.linalg.svd(beams[0].T)[2][3]
    expected = np.sqrt((null[:, None] ** 2 * stated_error**2).sum(axis=1).mean()) / 2
    # Corrections for motion are of first order: 2e-6 m/s is left of 50 m/s.
    assert closure == pytest.approx(expected, rel=0.05, abs=2e-6)
    assert (navigation["velocity_beams"] == 4).all()
