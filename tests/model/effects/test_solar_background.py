"""Sunlight's share of the noise, by hand and against prepared shots."""

import numpy as np
import pytest

from sweep.model.effects.solar_background import bound
from sweep.model.preparation import prepare

DETECTOR = {
    "apd_gain": 1.0, "excess_noise_factor": 1.0, "responsivity": 1.1, "electrical_bandwidth": 400e6,
}  # fmt: skip
OTHERS = 1.53715e-13
"""Current variance of Table 4.1 [A^2]."""


def test_the_share_of_sunlight_by_radiometry_of_the_patch_seen():
    """0.26 W/m^2/nm at 1.55 um on white ground, 1 km away, through 25 nm, 1 mrad and 25 mm.

    The patch is 0.785 m^2 and receives 5.105 W; Lambert's law sends P/pi per steradian, and the
    aperture is 4.909e-10 sr: 7.977e-10 W, 1.125e-19 A^2 of shot noise, 7.3e-7 of the whole.
    """
    light = 0.26 * 25 * (np.pi * 0.5**2) / np.pi * (np.pi * 0.0125**2 / 1000.0**2)
    assert light == pytest.approx(7.977e-10, rel=1e-3)
    change = bound(solar_power=light, noise_variance=OTHERS, **DETECTOR)
    assert change.noise[0] == change.noise[1]
    assert change.noise[0] - 1 == pytest.approx(1.125e-19 / OTHERS, rel=1e-3)
    assert change.threshold_follows


def test_the_bound_is_what_prepared_shots_gain_in_noise(table_4_1):
    sun = np.array([0.0, 2.6e8, 2.6e11, 2.6e16])
    scene = {"fft_size": 1024, "reflectance": 0.7, "apd_gain": 4.0, "excess_noise_factor": 2.5}
    ((_, shots),) = prepare(table_4_1(solar_irradiance=sun, **scene))
    ((_, dark),) = prepare(table_4_1(**scene))
    light = 0.7 * sun * 25e-9 * np.pi * (25e-6) ** 2 * 0.0125**2  # E rho pi (div/2)^2 (D/2)^2
    change = bound(
        solar_power=light, noise_variance=dark.noise_variance / 7e3**2,
        **DETECTOR | {"apd_gain": 4.0, "excess_noise_factor": 2.5},
    )  # fmt: skip
    true = shots.noise_variance / dark.noise_variance
    assert true[-1] > 1.01
    np.testing.assert_allclose(change.noise[0], true, rtol=1e-12)
    np.testing.assert_allclose(change.noise[1], true, rtol=1e-12)
