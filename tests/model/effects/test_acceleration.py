"""Radial acceleration: its phase against the exact delay."""

import mpmath
import numpy as np
import pytest

from sweep.model.effects import phase_errors

LIGHT = mpmath.mpf(299792458)


def exact_phase(t, *, sign, carrier, chirp_rate, range, radial_velocity, acceleration):
    """Beat phase [cycles] of the delayed wave less the local oscillator's, in 40 digits."""
    with mpmath.workdps(40):
        t = mpmath.mpf(t)
        distance = range - radial_velocity * t - mpmath.mpf(acceleration) * t * t / 2
        delay = 2 * distance / LIGHT
        emitted = lambda at: carrier * at + sign * mpmath.mpf(chirp_rate) * at * at / 2  # noqa: E731
        return emitted(t - delay) - emitted(t)


@pytest.mark.parametrize("sign", [-1, 0, 1])
@pytest.mark.parametrize("a", [-9.81, 300.0, 1e5])
def test_the_phase_is_what_acceleration_adds_to_the_delays_own(sign, a):
    scene = {
        "sign": sign, "carrier": 1.934e14, "chirp_rate": 2e12, "range": 3500.0,
        "radial_velocity": -120.0,
    }  # fmt: skip
    x = np.linspace(-1, 1, 9)
    start, duration = 4e-5, 4e-4
    phase = phase_errors.acceleration_phase(
        x, **{k: np.array([v]) if k != "sign" else v for k, v in scene.items()},
        acceleration=np.array([a]), start=np.array([start]), duration=np.array([duration]),
    )[0]  # fmt: skip
    times = [start + duration * (v + 1) / 2 for v in x]
    expected = [
        float(exact_phase(t, **scene, acceleration=a) - exact_phase(t, **scene, acceleration=0))
        for t in times
    ]
    np.testing.assert_allclose(phase, expected, rtol=1e-12, atol=1e-14)
