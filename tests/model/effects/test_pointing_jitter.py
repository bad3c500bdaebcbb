"""Jitter over a plane: vectors that meet it, and laws of small angles."""

import numpy as np
import pytest
from shot_helpers import intersect_level_plane, make_point_keys

from sweep.model.effects.effect import DrawAddresses
from sweep.model.effects.pointing_jitter import draw_jitter_angles, perturb_geometry


def angles_of(draws, sigma):
    """Angles of one point's draws."""
    realisation = DrawAddresses(np.repeat(make_point_keys(1), draws, axis=0), np.arange(draws))
    return draw_jitter_angles(realisation, np.full(draws, sigma))


@pytest.mark.parametrize("grazing", [0.05, 0.4, 1.2, np.pi / 2])
def test_turned_beams_meet_the_plane_where_rays_do(grazing):
    jitter_angles = angles_of(2000, 3e-3)
    geometry = perturb_geometry(
        range=1500.0, grazing_angle=grazing, radial_velocity=80.0, jitter_angles=jitter_angles,
        transverse_velocity=(30.0, -20.0),
    )  # fmt: skip
    far, angle, direction = intersect_level_plane(1500.0, grazing, jitter_angles)
    np.testing.assert_allclose(geometry.range, far, rtol=1e-12)
    np.testing.assert_allclose(np.sin(geometry.grazing_angle), np.sin(angle), rtol=1e-12)
    aim = np.array([np.cos(grazing), 0.0, -np.sin(grazing)])
    up = np.array([np.sin(grazing), 0.0, np.cos(grazing)])
    velocity = 80.0 * aim + 30.0 * up - 20.0 * np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(geometry.radial_velocity, direction @ velocity, rtol=1e-12)
