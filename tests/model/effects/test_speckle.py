"""Speckle's closed forms and bounds: sums of scatterers, integrals, and draws within bounds."""

import numpy as np
import pytest
from scipy.integrate import quad
from speckle_pairs import joint_detection

from sweep.model.effects import speckle
from sweep.model.marcum import marcum_q1


def test_both_cross_as_an_integral_over_one_of_the_two_says():
    """Given the first, the second is a Rice variable: integrated over the first's power."""
    for correlation in (0.0, 0.3, 0.9, 0.999):
        for powers in ((30.0, 30.0), (5.0, 80.0)):
            covariance = correlation * np.sqrt(powers[0] * powers[1])
            first, second = powers[0] + 2.0, powers[1] + 2.0
            rest = second - covariance**2 / first

            def rice(t, first=first, rest=rest, covariance=covariance):
                mean = covariance / first * np.sqrt(first * t)
                return np.exp(-t) * marcum_q1(mean / np.sqrt(rest / 2), 6 / np.sqrt(rest / 2)).q

            exact, _ = quad(rice, 36.0 / first, 60.0, epsabs=1e-13, limit=200)
            found = joint_detection(
                powers=powers, covariance=covariance, bin_deviation=1.0, threshold=6.0
            )
            assert found == pytest.approx(exact, rel=1e-8)


def test_the_coherent_share_is_that_of_a_sum_over_random_heights():
    rng = np.random.default_rng(3)
    wavelength, number = 1550e-9, 400_000
    for roughness in (0.02, 0.08, 0.15):
        heights = rng.normal(scale=roughness * wavelength, size=number)
        mean = np.exp(4j * np.pi * heights / wavelength).mean()
        share = speckle.coherent_share(roughness=roughness * wavelength, wavelength=wavelength)
        assert abs(abs(mean) - np.sqrt(share)) < 5 / np.sqrt(number)
    assert speckle.coherent_share(roughness=np.inf, wavelength=wavelength) == 0
    assert speckle.coherent_share(roughness=0.0, wavelength=wavelength) == 1
