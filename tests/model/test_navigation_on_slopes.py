"""Errors of velocity and altitude over their covariances in descents onto slopes.

Beams are so narrow that noise alone moves what is measured. Errors for motion, if there were any,
would be tens of standard errors.
"""

import math

import numpy as np
import pytest
from small_scenes import observe_shots, scene_parameters, straight_flight

from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.geometry.body_motion import SpinningAttitude
from sweep.model.geometry.mesh import SurfaceMaterial
from sweep.model.geometry.scanner import cone_directions, corner_directions, fixed_beams
from sweep.model.pointcloud.error_floor import ErrorFloor, apply_error_floor
from sweep.model.pointcloud.navigation import solve_navigation
from sweep.model.pointcloud.point_cloud import simulate_cloud
from sweep.model.sampling import philox
from sweep.scenes.eyepoint_arrays import eyepoints_to_arrays
from sweep.scenes.meshes import clean_mesh

MOVING = {*DEFAULT_EFFECTS, "range_walk", "acceleration", "segment_motion"}
CYCLES, DRAWS = 8, 150
FOUR, THREE = (
    corner_directions(math.radians(22.5)),
    cone_directions(3, half_angle=math.radians(22.5)),
)
DESCENTS = {
    "constant": {"velocity": (0.0, 0.0, -60.0)},
    "oblique": {"velocity": (40.0, 10.0, -50.0)},
    "braking": {"velocity": (0.0, 0.0, -60.0), "acceleration": (0.0, 0.0, 1.0)},
    "braking hard": {"velocity": (30.0, 0.0, -60.0), "acceleration": (-5.0, 2.0, 12.0)},
    "turning": {
        "velocity": (20.0, 0.0, -60.0),
        "attitude": SpinningAttitude((math.radians(3), 0.0, math.radians(60))),
    },
}


def slanting(slope):
    """A plane that rises along x, and half as much along y."""
    x, y = np.array([-1e5, 1e5, 1e5, -1e5]), np.array([-1e5, -1e5, 1e5, 1e5])
    corner = np.column_stack([x, y, slope * x + slope / 2 * y])
    return clean_mesh(corner, np.array([[0, 1, 2], [0, 2, 3]]), 0)[0]


def solved(
    parameters, descent, slope, beams, *, interval=0.0, floor=None, stated_floor=None, **ground
):
    """Mean NEES / 3 of velocity, rms of altitude's z, and mean errors of each cycle's altitude."""
    shot_eyepoints = observe_shots(
        straight_flight(**({"position": (0.0, 0.0, 800.0)} | descent)), bodies=[slanting(slope)],
        scanner=fixed_beams(beams, rate=2.0, interval=interval), index=range(CYCLES * len(beams)),
        beam_divergence=1e-7,
    )  # fmt: skip
    keys = philox.point_keys(
        np.arange(len(shot_eyepoints.time), dtype=float)[:, None], domain="o", seed=1
    )
    points = simulate_cloud(
        shot_eyepoints,
        parameters=parameters,
        surfaces=[SurfaceMaterial("ground", 0.2)],
        keys=keys,
        draws=DRAWS,
        effects=MOVING,
    )
    if floor is not None:
        points = apply_error_floor(points, shot_eyepoints, floor, keys=keys, seed=1)
    stated_floor = (
        {} if floor is None and stated_floor is None else {"error_floor": stated_floor or floor}
    )
    shots = eyepoints_to_arrays(shot_eyepoints)
    solution = solve_navigation(
        shots,
        points,
        shots_per_cycle=len(beams),
        **({"ground_slope": 10.0} | ground),
        **stated_floor,
    )
    position, velocity = (
        shots[f"platform_{name}"].reshape(CYCLES, -1, 3) for name in ("position", "velocity")
    )
    error = solution["velocity"] - velocity.mean(axis=1)[:, None]
    inverse = np.linalg.inv(solution["velocity_covariance"])
    nees = np.einsum("cdi,cdij,cdj->cd", error, inverse, error) / 3
    x, y, z = position[:, 0].T
    height = solution["altitude"] - (z - slope * x - slope / 2 * y)[:, None]
    scores = height / np.sqrt(solution["altitude_variance"])
    return nees.mean(), np.sqrt((scores**2).mean()), height.mean(axis=1)


@pytest.mark.parametrize("slope", [0.0, 0.2, 0.5])
@pytest.mark.parametrize("descent", DESCENTS)
@pytest.mark.parametrize(("beams", "interval"), [(FOUR, 0.0), (FOUR, 0.05), (THREE, 0.0)])
def test_errors_are_as_large_as_stated(table_4_1, descent, slope, beams, interval):
    """And a slope moves the altitude by no more than noise does: 14 mm if it is not known."""
    parameters = scene_parameters(table_4_1)
    nees, score, height = solved(parameters, DESCENTS[descent], slope, beams, interval=interval)
    assert nees == pytest.approx(1, abs=0.2)
    assert score == pytest.approx(1, abs=0.2)
    assert np.abs(height).max() < 1.5e-3


@pytest.mark.parametrize("down_slope", [-0.5, 0.5, 2.0])
def test_segments_of_other_slopes_are_paired_and_solved_alike(table_4_1, down_slope):
    """Braking hard moves the Doppler beat that the chirps predict by more than the tolerance.

    Lines that drift within a record add an error that is steady over draws, of the stated size.
    """
    parameters = scene_parameters(table_4_1) | {"instrument.chirp.down_slope": down_slope}
    for name in ("oblique", "braking hard", "turning"):
        nees, score, height = solved(parameters, DESCENTS[name], 0.3, FOUR)
        assert nees == pytest.approx(1, abs=0.25)
        assert score == pytest.approx(1, abs=0.15)
        assert np.abs(height).max() < 5e-3


def test_ground_that_is_known_to_be_level_needs_no_slope(table_4_1):
    nees, score, _ = solved(
        scene_parameters(table_4_1), DESCENTS["oblique"], 0.0, FOUR, ground_slope=0.0
    )
    assert nees == pytest.approx(1, abs=0.2)
    assert score == pytest.approx(1, abs=0.2)


def test_where_relief_is_stated_velocities_have_the_error_of_unknown_slopes(table_4_1):
    """A turn of 60 deg/s slides the beams by hundreds of m/s: more than noise."""
    parameters, turning = scene_parameters(table_4_1), DESCENTS["turning"]
    plane, *_ = solved(parameters, turning, 0.2, FOUR)
    rough, *_ = solved(parameters, turning, 0.2, FOUR, relief=1e-6)
    assert plane == pytest.approx(1, abs=0.2) and rough < 0.5


@pytest.mark.parametrize("name", ["pointing", "clock", "wavelength", "vibration", "range_noise"])
def test_a_stated_floor_is_in_the_covariances(table_4_1, name):
    """Errors that one draw has in common are 150 numbers: their mean square is known to 12 %."""
    size = {"pointing": 2e-4, "clock": 1e-5, "wavelength": 1e-5}.get(name, 0.05)
    nees, score, _ = solved(
        scene_parameters(table_4_1),
        DESCENTS["oblique"],
        0.2,
        FOUR,
        floor=ErrorFloor(**{name: size}),
    )
    assert nees == pytest.approx(1, abs=0.3)
    assert score == pytest.approx(1, abs=0.2)
