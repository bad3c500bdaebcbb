"""Light from the air along the beam: closed forms, another quadrature, the bound's bracket."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import exp1

from sweep.model.effects.atmosphere import (
    EXTINCTION_PROFILES,
    ExtinctionProfile,
    backscatter_integral,
    exponential_profile,
    layer_profile,
    optical_depth,
)

AREA = np.pi * 0.0125**2
NEAR = 500.0
"""Aperture over divergence [m]."""


def power(profile, near=NEAR, **path):
    """Of 1 W, 0.8 of which passes the optics, with a lidar ratio of 50 sr."""
    return 0.8 * AREA / 50 * backscatter_integral(profile, near_range=near, **path)


def even(extinction):
    return layer_profile(optical_depth=extinction * 1e5, depth=1e5)


@pytest.mark.parametrize(
    "extinction, length",
    [(1e-6, 1.0), (1e-6, 1e5), (4e-5, 300.0), (4e-5, 1e4), (1e-3, 300.0), (1e-3, 1e4), (2e-2, 1e3)],
)
def test_even_air_has_the_closed_form_of_exponential_integrals(extinction, length):
    """Im[e^(-2i a z) (E1(-2i a z) - E1(2 a (R - i z)))] / z, by 1/(r^2 + z^2) = Im[1/(r - iz)] / z.

    Optical depths to 20, one way.
    """
    a, z = extinction, NEAR
    integral = np.exp(-2j * a * z) * (exp1(-2j * a * z) - exp1(2 * a * (length - 1j * z)))
    expected = 0.8 * AREA * a / 50 * integral.imag / z
    backscatter = power(even(a), start_height=7.0, end_height=7.0, range=length)
    assert backscatter == pytest.approx(expected, rel=1e-8)


def test_diffraction_limited_overlap_is_that_of_the_coherent_lidar():
    """r_0 = pi D^2 / (4 lambda): the nearest air gives 1/r_0^2, whatever its distance."""
    divergence = 4 * 1.55e-6 / (np.pi * 25e-3)
    near = 25e-3 / divergence
    backscatter = power(even(1e-6), near, start_height=7.0, end_height=7.0, range=1.0)
    limit = np.pi * 25e-3**2 / (4 * 1.55e-6)
    assert limit == pytest.approx(316.7, rel=1e-3)
    assert backscatter == pytest.approx(0.8 * AREA * 2e-8 / limit**2, rel=1e-4)


def scenes(number=150):
    rng = np.random.default_rng(6)
    profiles = [
        *EXTINCTION_PROFILES.values(),
        layer_profile(optical_depth=2.0, depth=40.0),
        exponential_profile(surface_extinction=1e-3, scale_height=50.0),
        ExtinctionProfile((0.0, 200.0, 200.0, 350.0), (1e-5, 1e-5, 2e-3, 1e-3)),
    ]
    for _ in range(number):
        profile = profiles[rng.integers(len(profiles))]
        start, end = 10 ** rng.uniform(0, 4, 2) * (rng.random(2) > 0.3)
        length = abs(end - start) * rng.uniform(1, 5) + rng.uniform(1, 2000)
        yield profile, start, end, length


def test_slant_paths_agree_with_adaptive_quadrature_over_range():
    for profile, start, end, length in scenes(40):

        def local(r, profile=profile, start=start, end=end, length=length):
            h = start + (end - start) * r / length
            depth = optical_depth(profile, start_height=start, end_height=h, range=r)
            slope = optical_depth(profile, start_height=h, end_height=h, range=1.0)
            return float(slope * np.exp(-2 * depth) / (r * r + NEAR**2))

        rise = end - start
        at = [(h - start) / rise * length for h in profile.height] if rise else []
        breaks = sorted(r for r in (*at, *np.geomspace(1, 1e4, 13)) if 0 < r < length)
        total, error = quad(
            local, 0, length, points=breaks or None, limit=400, epsabs=0, epsrel=1e-9
        )
        backscatter = power(profile, start_height=start, end_height=end, range=length)
        expected = 0.8 * AREA / 50 * total
        assert backscatter == pytest.approx(expected, rel=1e-8, abs=2 * 0.8 * AREA / 50 * error)
