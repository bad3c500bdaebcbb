"""Footprints on a plane with a velocity across the beam, and effects of the air in the shot."""

import numpy as np
import pytest
from scipy.integrate import quad

from sweep.model import evaluation
from sweep.model.beamlets import place_beamlets, plane_footprint
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.effects.noise_sources import solar_irradiance

STORM = {"atmosphere.profile": "mars_storm"}


def test_velocities_of_beamlets_by_vectors():
    """The instrument moves with v_r along the axis and v_t across it, towards the near side."""
    (across, along), _ = place_beamlets(37)
    divergence, radial, transverse = 0.2, 40.0, -70.0
    *_, (velocities,) = plane_footprint(
        radial_velocity=[radial], transverse_velocity=[transverse], grazing_angle=np.ones(1),
        beam_divergence=np.array([divergence]), n_beamlets=37,
    )  # fmt: skip
    rays = np.stack([across * divergence / 4, along * divergence / 4, np.ones(37)])
    rays /= np.linalg.norm(rays, axis=0)
    velocity = np.array([0.0, transverse, radial])
    assert velocities == pytest.approx(velocity @ rays - radial, abs=1e-11)


@pytest.mark.parametrize("grazing", [0.2, 1.2])
def test_air_dims_the_echo_by_the_integral_over_the_path(table_4_1, grazing):
    """tau = integral of 5/11 km exp(-h/11 km) along a slant path of 5 km; SNR falls by T^2."""
    parameters = table_4_1(range=5000.0, grazing_angle=grazing)
    names = [name for name in DEFAULT_EFFECTS if name != "signal_shot_noise"]
    clear = evaluation.evaluate(parameters, names)
    dusty = evaluation.evaluate(parameters | STORM, (*names, "extinction"))
    depth, _ = quad(lambda s: 5 / 11e3 * np.exp(-s * np.sin(grazing) / 11e3), 0, 5000.0)
    assert dusty["snr_up"] / clear["snr_up"] == pytest.approx(np.exp(-2 * depth), rel=1e-6)
    level = {"atmosphere.path": "level", "atmosphere.target_height": 100.0}
    along = evaluation.evaluate(parameters | STORM | level, (*names, "extinction"))
    expected = np.exp(-2 * 5000.0 * 5 / 11e3 * np.exp(-100 / 11e3))
    assert along["snr_up"] / clear["snr_up"] == pytest.approx(expected, rel=1e-6)


def test_all_sunlight_together_is_the_solar_constant():
    """1361 W/m^2 at the Earth's distance, and a quarter of it at twice that, lit from 30 deg."""
    one = {"distance": 149597870700.0, "elevation": np.pi / 2}

    def total(**place):
        return quad(lambda x: solar_irradiance(wavelength=x, **place), 1e-8, 1e-4, limit=500,
                    points=[5e-7, 2e-6, 1e-5])[0]  # fmt: skip

    assert total(**one) == pytest.approx(1361.0, rel=1e-3)
    at_two_au = {"distance": 2 * one["distance"], "elevation": np.pi / 6}
    assert total(**at_two_au) == pytest.approx(1361.0 / 8, rel=1e-3)
    assert solar_irradiance(wavelength=1.55e-6, distance=0.0, elevation=1.0) == 0.0
    # the sun shines through its least opaque wavelengths there, a fifth brighter than a black body
    assert 0.2 < solar_irradiance(wavelength=1.55e-6, **one) * 1e-9 < 0.27
