"""Footprint, Doppler, Doppler spread, several returns: true changes within and near bounds."""

import numpy as np
import pytest


def test_rotation_is_a_velocity_of_the_instrument():
    # a ball of radius 3 that turns about a point off its centre, seen by beamlets all over it
    rng = np.random.default_rng(9)
    centre, pivot, rate = np.array([100.0, 5.0, -2.0]), rng.normal(size=3), rng.normal(size=3)
    rays = centre + rng.uniform(-1.5, 1.5, (200, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    along = rays @ centre
    far = along - np.sqrt(along**2 - centre @ centre + 9.0)
    surface = np.cross(rate, far[:, None] * rays - pivot)
    closing = -(surface * rays).sum(axis=1)
    velocity = -np.cross(rate, np.zeros(3) - pivot)  # that of an instrument at the origin
    assert closing == pytest.approx((velocity * rays).sum(axis=1), rel=1e-11)
