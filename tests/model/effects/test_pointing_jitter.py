"""Jitter over a plane: vectors that meet it, and laws of small angles."""

import numpy as np
import pytest
from engine import by_vectors, keys
from scipy import stats

from sweep.model.effects.effect import Realisation
from sweep.model.effects.pointing_jitter import angles, turned

DRAWS = 20_000


def angles_of(draws, sigma):
    """Angles of one point's draws."""
    realisation = Realisation(np.repeat(keys(1), draws, axis=0), np.arange(draws))
    return angles(realisation, np.full(draws, sigma))


@pytest.mark.parametrize("grazing", [0.05, 0.4, 1.2, np.pi / 2])
def test_turned_beams_meet_the_plane_where_rays_do(grazing):
    off = angles_of(2000, 3e-3)
    seen = turned(
        range=1500.0, grazing_angle=grazing, radial_velocity=80.0, angles=off,
        velocity_across=(30.0, -20.0),
    )  # fmt: skip
    far, angle, direction = by_vectors(1500.0, grazing, off)
    np.testing.assert_allclose(seen.range, far, rtol=1e-12)
    np.testing.assert_allclose(np.sin(seen.grazing_angle), np.sin(angle), rtol=1e-12)
    aim = np.array([np.cos(grazing), 0.0, -np.sin(grazing)])
    up = np.array([np.sin(grazing), 0.0, np.cos(grazing)])
    velocity = 80.0 * aim + 30.0 * up - 20.0 * np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(seen.radial_velocity, direction @ velocity, rtol=1e-12)


def test_ranges_are_normal_off_the_normal_and_exponential_along_it():
    """R'/R - 1 is a cot(grazing) to first order, t^2/2 with mean sigma^2 at 90 deg."""
    sigma = 1e-5
    off = angles_of(DRAWS, sigma)
    slant = turned(range=1.0, grazing_angle=0.5, radial_velocity=0.0, angles=off).range - 1
    assert stats.kstest(slant, stats.norm(scale=sigma / np.tan(0.5)).cdf).pvalue > 1e-6
    along = turned(range=1.0, grazing_angle=np.pi / 2, radial_velocity=0.0, angles=1e3 * off)
    law = stats.expon(scale=(1e3 * sigma) ** 2)
    assert stats.kstest(along.range - 1, law.cdf).pvalue > 1e-6
