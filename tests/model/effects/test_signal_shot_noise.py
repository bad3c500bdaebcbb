"""The echo's own shot noise: its rise at short range."""

import numpy as np
import pytest
from effect_points import points_of

from sweep.model import shot
from sweep.model.effects.noise_sources import echo_size

OTHERS = 1.53715e-13
"""Current variance of Table 4.1 [A^2]: 1.40992e-13 of it shot noise of 1 mW."""


def test_false_alarms_rise_below_five_metres_as_the_thesis_reports(table_4_1):
    """Threshold without the echo, noise with it: Pfa = exp(-Th^2/2s^2 / (1 + share)), [T 4.2].

    At 2 km the echo is 1.953125e-12 W beside 1 mW: 17 % more false alarms at 1 m, 0.6 % at 5 m.
    """
    distance = np.array([1.0, 2.0, 5.0, 20.0])
    parameters = table_4_1(range=distance, fft_size=1024, radial_velocity=10.0)
    found = echo_size(points_of(parameters))
    share = 1.40992e-13 / OTHERS * 1.953125e-12 * (2000.0 / distance) ** 2 / 1e-3
    np.testing.assert_allclose(found.noise, share, rtol=1e-4)
    assert not found.threshold_follows
    predicted = np.exp(-(4 - np.pi) / 4 * 100 / (1 + found.noise))
    np.testing.assert_allclose(shot.evaluate(parameters)["pfa_bin"], predicted, rtol=1e-5)
    rise = predicted / np.exp(-(4 - np.pi) / 4 * 100) - 1
    assert rise == pytest.approx([0.166, 0.0392, 0.00617, 3.8e-4], rel=0.02)
