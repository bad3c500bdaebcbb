"""Eyepoints against the flat-plane model and closed forms of motion; their invariances."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_scenes import level_plate, observe_shots, straight_flight

from sweep.model.beamlets import place_beamlets
from sweep.model.evaluation import evaluate, shot_statistics
from sweep.model.geometry.body_motion import ConstantAcceleration, MovingBody, SpinningAttitude
from sweep.model.geometry.mesh import SurfaceMaterial
from sweep.model.geometry.ray_casting import RayCaster
from sweep.model.geometry.scanner import LineScan, cone_directions, corner_directions, fixed_beams
from sweep.model.pointcloud.eyepoints import compute_eyepoints, prepare_eyepoint_shots

GROUND = SurfaceMaterial("ground", 0.1, "lambert")


def square(half):
    return level_plate((-half, half), (-half, half))


@pytest.mark.parametrize("tilt", [0.0, 30.0, 75.0])
@pytest.mark.parametrize("phases", ["incoherent", "coherent"])
def test_level_ground_gives_what_the_flat_plane_gives(table_4_1, tilt, phases):
    """The footprint of a tilted beam on level ground is the plane's, along another azimuth."""
    beams = cone_directions(1, half_angle=np.radians(tilt), azimuth=np.pi / 2)
    pattern = "sunflower" if phases == "coherent" else "hexagonal"
    along = 45.0 * beams[0]  # no velocity across the beam: no Doppler spread, as on the plane
    shot_eyepoints = observe_shots(
        straight_flight(velocity=along), beams=beams, number=109, pattern=pattern
    )
    parameters = table_4_1(phases=phases, reflectance_law="lambert")
    shots = prepare_eyepoint_shots(shot_eyepoints, parameters, [GROUND])
    statistics = shot_statistics(shots)
    expected = evaluate(
        parameters
        | {
            "target.range": 1000.0 / np.cos(np.radians(tilt)),
            "target.grazing_angle": np.radians(90.0 - tilt),
            "target.radial_velocity": 45.0,
        }
    )
    assert shot_eyepoints.range[0] == pytest.approx(1000.0 / np.cos(np.radians(tilt)), rel=2e-5)
    assert statistics["noise_variance"] == pytest.approx(expected["noise_variance"], rel=1e-6)
    if phases == "incoherent":
        # turned about its axis the pattern samples the slope elsewhere: 1 % of the power
        assert statistics["snr_up"] == pytest.approx(expected["snr_up"], rel=0.02)
        assert statistics["snr_doppler"] == pytest.approx(expected["snr_doppler"], rel=0.02)
    elif tilt == 0.0:
        assert statistics["snr_doppler"] == pytest.approx(expected["snr_doppler"], rel=0.02)
    assert abs(statistics["radial_velocity_error"][0]) < 0.01
    assert abs(statistics["range_error"][0]) < 0.6


def _beamlet_vectors(turn, beam, divergence, number):
    """Unit vectors of a beam's beamlets in the world, of a beam in the body's x-z plane."""
    (across, along), _ = place_beamlets(number)
    # transverse: the first axis lies in the plane of the beam and x, the second across it
    first, second = np.array([-beam[2], 0.0, beam[0]]), np.array([0.0, -1.0, 0.0])
    body = beam + divergence / 4 * (np.outer(across, first) + np.outer(along, second))
    return turn.apply(body / np.linalg.norm(body, axis=1)[:, None])


@pytest.mark.parametrize("time", [0, 2])
def test_velocity_across_the_footprint_of_a_spinning_target_is_that_of_its_points(time):
    """Each beamlet meets the turned plate n.P = 0 at P and closes with u.(V - omega x P)."""
    omega, place, platform_velocity = (
        np.array([0.05, 0.3, 0.1]),
        np.array([8.0, -3.0, 300.0]),
        (2.0, 1.0, -9.0),
    )
    path = ConstantAcceleration((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 10.0)
    shot_eyepoints = observe_shots(
        straight_flight(position=place, velocity=platform_velocity),
        bodies=[square(400.0)],
        body_motion=[MovingBody(path, SpinningAttitude(omega))],
        index=[time],
        number=37,
        beam_divergence=0.02,
    )
    location = place + time * np.array(platform_velocity)
    u = _beamlet_vectors(Rotation.identity(), np.array([0.0, 0.0, -1.0]), 0.02, 37)
    normal = Rotation.from_rotvec(omega * time).apply([0.0, 0.0, 1.0])
    ranges = -(location @ normal) / (u @ normal)
    point = location + ranges[:, None] * u
    closing = np.sum(u * (platform_velocity - np.cross(omega, point)), axis=1)
    np.testing.assert_allclose(
        shot_eyepoints.range[0] + shot_eyepoints.offset[0], ranges, rtol=1e-12
    )
    velocities = shot_eyepoints.radial_velocity[0] + shot_eyepoints.velocity_offset[0]
    np.testing.assert_allclose(velocities, closing, rtol=0, atol=1e-11)
    assert np.ptp(closing) > 1.0
    if time == 0:
        # level and from straight above, angles a and b off the beam meet x + 300 a, y + 300 b
        spread = np.sqrt(
            shot_eyepoints.weight @ (velocities - shot_eyepoints.weight @ velocities) ** 2
        )
        by_a = platform_velocity[0] - 300.0 * omega[1] + omega[2] * place[1]
        by_b = platform_velocity[1] + 300.0 * omega[0] - omega[2] * place[0]
        across = np.hypot(by_a, by_b)
        assert spread == pytest.approx(across * 0.02 / 4, rel=1e-3)


@pytest.mark.parametrize("time", [0, 3])
def test_velocity_across_the_footprint_of_a_tumbling_instrument_is_that_of_its_arm(time):
    """Ground at rest: u_b.(V + omega x a), the arm a and the beamlets u_b turned with the body."""
    omega, arm = np.array([0.04, -0.08, 0.3]), np.array([3.0, 1.5, -0.5])
    platform_velocity, place = np.array([20.0, -5.0, -30.0]), np.array([0.0, 0.0, 900.0])
    beam = np.array([np.sin(0.3), 0.0, -np.cos(0.3)])
    shot_eyepoints = observe_shots(
        straight_flight(
            position=place,
            velocity=platform_velocity,
            attitude=SpinningAttitude(omega),
            lever_arm=arm,
        ),
        beams=beam[None],
        index=[time],
        number=37,
        beam_divergence=0.02,
    )
    turn = Rotation.from_rotvec(omega * time)
    u = _beamlet_vectors(turn, beam, 0.02, 37)
    moving = platform_velocity + np.cross(omega, turn.apply(arm))
    np.testing.assert_allclose(shot_eyepoints.velocity[0], moving, atol=1e-12)
    velocities = shot_eyepoints.radial_velocity[0] + shot_eyepoints.velocity_offset[0]
    np.testing.assert_allclose(velocities, u @ moving, rtol=0, atol=1e-11)
    height = (place + time * platform_velocity + turn.apply(arm))[2]
    np.testing.assert_allclose(
        shot_eyepoints.range[0] + shot_eyepoints.offset[0], -height / u[:, 2], rtol=1e-12
    )
    assert np.ptp(velocities) > 0.2
    # to first order, the velocity across the beam times its angle
    axis = turn.apply(beam)
    spread = np.sqrt(shot_eyepoints.weight @ (velocities - shot_eyepoints.weight @ velocities) ** 2)
    across = np.linalg.norm(np.cross(axis, moving))
    assert spread == pytest.approx(across * 0.02 / 4, rel=1e-3)


def test_beamlets_that_miss_send_nothing_back(table_4_1):
    edge = [square(5.0)]
    shot_eyepoints = observe_shots(
        straight_flight(position=(5.0, 0.0, 100.0)), bodies=edge, beam_divergence=2e-3, number=109
    )
    hit = shot_eyepoints.surface[0] >= 0
    assert 0 < hit.sum() < hit.size
    shots = prepare_eyepoint_shots(shot_eyepoints, table_4_1(), [GROUND])
    assert (shots.footprint.relative_amplitude[0][~hit] == 0).all() and (
        shots.footprint.relative_amplitude[0][hit] > 0
    ).all()
    assert not observe_shots(
        straight_flight(position=(50.0, 0.0, 100.0)), bodies=edge
    ).has_target.any()


def _turning(rate, arm=(0.0, 0.0, 0.0)):
    """A falling instrument on an arm of a body that turns."""
    path = ConstantAcceleration((0.0, 0.0, 900.0), (35.0, -10.0, -60.0), (1.0, 2.0, 11.4), 10.0)
    return MovingBody(path, SpinningAttitude(rate), arm)


def _body(rate):
    path = ConstantAcceleration((0.0, 0.0, 0.0), (3.0, -4.0, 5.0), (0.5, 0.2, -2.0), 10.0)
    return MovingBody(path, SpinningAttitude(rate))


SLANTED = corner_directions(0.2)[:1]
MOTIONS = {
    "falling straight down": (
        _turning((0.0, 0.0, 0.0)),
        fixed_beams(np.array([[0, 0, -1.0]]), rate=1e4),
    ),
    "slanting beam": (_turning((0.0, 0.0, 0.0)), fixed_beams(SLANTED, rate=1e4)),
    "turning": (_turning((0.3, -0.2, 0.4)), fixed_beams(SLANTED, rate=1e4)),
    "on a lever arm": (
        _turning((0.3, -0.2, 0.4), (2.0, -1.0, 3.0)),
        fixed_beams(SLANTED, rate=1e4),
    ),
    "resonant mirror": (_turning((0.0, 0.0, 0.0)), LineScan(0.3, 5.0, 1e4, wave="sine")),
    "triangular sweep": (_turning((0.1, 0.0, 0.0)), LineScan(0.3, 5.0, 1e4, along=(0.2,))),
}


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("body", [None, (0.0, 0.0, 0.0), (0.02, -0.05, 0.01)])
def test_acceleration_and_approach_are_what_the_next_shots_see(name, body):
    """Central differences over 0.1 ms to either side, on level ground or on moving."""
    flight, scanner = MOTIONS[name]
    shot_eyepoints = compute_eyepoints(
        np.array([99, 100, 101]), flight=flight, scanner=scanner, caster=RayCaster([level_plate()]),
        beam_divergence=50e-6, n_beamlets=7, body_motions=None if body is None else [_body(body)],
    )  # fmt: skip
    grows = (shot_eyepoints.radial_velocity[2] - shot_eyepoints.radial_velocity[0]) / 2e-4
    falls = (shot_eyepoints.range[0] - shot_eyepoints.range[2]) / 2e-4
    assert shot_eyepoints.acceleration[1] == pytest.approx(grows, rel=1e-5, abs=1e-6)
    assert shot_eyepoints.approach_speed[1] == pytest.approx(falls, rel=1e-5)
    turned = np.linalg.norm(shot_eyepoints.direction[2] - shot_eyepoints.direction[0]) / 2e-4
    assert shot_eyepoints.turn_rate[1] == pytest.approx(turned, rel=1e-5, abs=1e-9)


def test_a_shot_that_sees_nothing_has_no_acceleration():
    shot_eyepoints = observe_shots(
        straight_flight(), beams=np.array([[0, 0, 1.0], [0, 0, -1.0]]), index=(0, 1)
    )
    assert (
        np.isnan(shot_eyepoints.acceleration).tolist()
        == np.isnan(shot_eyepoints.approach_speed).tolist()
        == [True, False]
    )
