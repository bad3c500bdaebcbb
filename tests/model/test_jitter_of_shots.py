"""Pointing jitter of shots: closed forms of what it does to pointing, range and velocity."""

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation
from small_scenes import DOWNWARD_BEAM, observe_shots, straight_flight

from sweep.model.geometry.body_motion import NadirAttitude
from sweep.model.geometry.scanner import (
    BeamCycle,
    PointingJitter,
    cone_directions,
    corner_directions,
)

SHOTS = 20_000
"""A standard deviation is known to 1/sqrt(2 SHOTS) = 0.5 %: at 5 sigma an error of 2.5 % shows.

Kolmogorov and Smirnov's test gives a true hypothesis a p-value below 1e-6 once in a million seeds.
"""
SIGMA = 2e-4
JITTER = PointingJitter(SIGMA, 3)


def _scan(beams):
    beams = np.atleast_2d(beams)
    return BeamCycle(beams, [list(range(len(beams)))], SHOTS / len(beams) / 9.0)


def _seen(beams, jitter=JITTER, **keywords):
    """Shots at a plane 1000 m below, of a platform in level flight."""
    path = straight_flight(velocity=keywords.pop("velocity", (0.0, 0.0, 0.0)))
    keywords = {"index": np.arange(SHOTS), "number": 1} | keywords
    return observe_shots(path, scanner=_scan(beams), jitter=jitter, **keywords)


def _alike(values, deviation):
    """Tell whether values are normal with mean 0 and a standard deviation."""
    return stats.kstest(values / deviation, stats.norm.cdf).pvalue > 1e-6


def test_a_slanting_beam_is_off_by_a_normal_angle_in_its_plane():
    """cos(angle from nadir) = height / range; each of four beams shows another component."""
    shot_eyepoints = _seen(cone_directions(4, half_angle=np.pi / 4, azimuth=0.4))
    errors = (np.arccos(1000.0 / shot_eyepoints.range) - np.pi / 4).reshape(-1, 4)
    assert _alike(errors.ravel(), SIGMA)
    correlation = np.corrcoef(errors.T)[np.triu_indices(4, 1)]
    assert (np.abs(correlation) < 5 / np.sqrt(len(errors))).all()


def test_the_instrument_knows_nothing_of_it():
    steady_eyepoints, jittered = (
        _seen(cone_directions(3, half_angle=0.4), jitter) for jitter in (None, JITTER)
    )
    for name in ("time", "beam", "cycle", "position", "velocity", "direction"):
        np.testing.assert_array_equal(getattr(steady_eyepoints, name), getattr(jittered, name))
    assert (steady_eyepoints.range != jittered.range).mean() > 0.99


def test_the_turn_has_three_independent_normal_angles_about_the_bodys_axes():
    attitude = Rotation.random(random_state=1)
    start = np.tile(attitude.as_quat(scalar_first=True), (SHOTS, 1))
    turned = Rotation.from_quat(JITTER.perturb_attitude(start, np.arange(SHOTS)), scalar_first=True)
    angles = (attitude.inv() * turned).as_rotvec()
    assert all(_alike(angle, SIGMA) for angle in angles.T)
    correlation = np.corrcoef(angles.T)[np.triu_indices(3, 1)]
    assert (np.abs(correlation) < 5 / np.sqrt(SHOTS)).all()
    following = [np.corrcoef(angle[1:], angle[:-1])[0, 1] for angle in angles.T]
    assert (np.abs(following) < 5 / np.sqrt(SHOTS)).all()


def test_no_jitter_and_a_jitter_of_nothing_are_the_same_bit_for_bit():
    index = np.arange(50)
    for a, b in zip(
        _seen(DOWNWARD_BEAM, None, index=index, number=7),
        _seen(DOWNWARD_BEAM, PointingJitter(0.0, 1), index=index, number=7),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


def test_the_seed_decides_on_the_angles():
    one, same, other = (
        _seen(DOWNWARD_BEAM, PointingJitter(SIGMA, seed), index=np.arange(2000)).range
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, same)
    assert abs(np.corrcoef(one, other)[0, 1]) < 5 / np.sqrt(2000)


@pytest.mark.parametrize("shot_index", [[33, 7, 20], [5]])
def test_any_stretch_of_a_flight_is_the_same_bit_for_bit(shot_index):
    path = straight_flight(velocity=(1.0, 2.0, -50.0), attitude=NadirAttitude(0.3))
    scanner = BeamCycle(corner_directions(np.radians(22.5)), [[0, 1, 2, 3]], 4.0)
    all_eyepoints, part = (
        observe_shots(path, scanner=scanner, index=index, jitter=JITTER)
        for index in (np.arange(36), np.array(shot_index))
    )
    for all_shots, expected in zip(all_eyepoints[:-1], part[:-1], strict=True):
        np.testing.assert_array_equal(all_shots[shot_index], expected)
