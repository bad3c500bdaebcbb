"""Reflectance laws against each other and against light scattered once in a half-space."""

import math

import numpy as np
import pytest
from scipy import integrate

from sweep.model.ground import backscatter

COSINES = np.array([0.01, 0.1, 0.5, 0.9, 1.0])


def _once_scattered(albedo, phase, returning):
    """Share of a beam's power sent back per steradian by an absorbing half-space of scatterers.

    At the optical depth s along the beam, e^-s is left, albedo ds of it scattered, phase/(4 pi) of
    that per steradian back along the beam, and `returning` (s) of this comes out again. The slope
    of the half-space's face does not enter.
    """
    share = integrate.quad(lambda s: math.exp(-s) * returning(s), 0, np.inf)[0]
    return albedo * phase / (4 * math.pi) * share


@pytest.mark.parametrize(("albedo", "phase"), [(0.1, 1.0), (0.6, 2.5)])
def test_lommel_seeliger_is_light_scattered_once(albedo, phase):
    """Out again through what it came in by: e^-s. Where shadows hide wholly, unhindered: 1."""
    for surge, returning in ((0.0, lambda s: math.exp(-s)), (1.0, lambda s: 1.0)):
        reflectance = albedo * phase * (1 + surge) / 8
        np.testing.assert_allclose(
            reflectance * backscatter("lommel_seeliger", COSINES),
            _once_scattered(albedo, phase, returning),
            rtol=1e-9,
        )


def test_lommel_seeliger_agrees_with_lambert_along_the_normal_and_does_not_darken_aslant():
    flat, lambert = (backscatter(law, COSINES) for law in ("lommel_seeliger", "lambert"))
    assert flat[-1] == lambert[-1]
    np.testing.assert_allclose(lambert / flat, COSINES, rtol=1e-15)


def test_the_thesis_law_is_half_of_lommel_seeligers():
    np.testing.assert_array_equal(
        2 * backscatter("thesis", COSINES), backscatter("lommel_seeliger", COSINES)
    )
