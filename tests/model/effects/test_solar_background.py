"""Sunlight's share of the noise, by hand and against prepared shots."""

import numpy as np
import pytest
from effect_points import points_of

from sweep.model.effects.noise_sources import sun_size

OTHERS = 1.53715e-13
"""Current variance of Table 4.1 [A^2]."""


def test_the_share_of_sunlight_by_radiometry_of_the_patch_seen(table_4_1):
    """0.26 W/m^2/nm at 1.55 um on white ground, 1 km away, through 25 nm, 1 mrad and 25 mm.

    The patch is 0.785 m^2 and receives 5.105 W; Lambert's law sends P/pi per steradian, and the
    aperture is 4.909e-10 sr: 7.977e-10 W, 1.125e-19 A^2 of shot noise, 7.3e-7 of the whole.
    """
    light = 0.26 * 25 * (np.pi * 0.5**2) / np.pi * (np.pi * 0.0125**2 / 1000.0**2)
    assert light == pytest.approx(7.977e-10, rel=1e-3)
    scene = table_4_1(
        solar_irradiance=2.6e8, reflectance=1.0, range=1000.0, beam_divergence=1e-3, fft_size=1024
    )
    found = sun_size(points_of(scene))
    assert found.threshold_follows
    assert found.noise == pytest.approx(1.125e-19 / OTHERS, rel=1e-3)
