"""Chirp nonlinearity: its phase against the sweep integrated."""

import numpy as np
import pytest

from sweep.model.effects import phase_errors

LIGHT = 299792458.0
CHIRP, START, RECORD = 500e-6, 3e-5, 300e-6


def frequency_error(u, *, quadratic, cubic, sinusoidal, periods):
    """Frequency error [Hz] at place u along the sweep, -1..1 from lowest to highest frequency."""
    return (
        quadratic * (2 * u**2 - 1)
        + cubic * (4 * u**3 - 3 * u)
        + sinusoidal * np.sin(np.pi * periods * u)
    )


def error_of(sign, *, quadratic=0.0, cubic=0.0, sinusoidal=0.0, periods=1.0, **scene):
    return {
        "sign": sign, "chirp_duration": CHIRP, "range": np.array([3000.0]),
        "radial_velocity": np.array([0.0]), "start": START, "duration": RECORD,
        "quadratic": np.array([quadratic]), "cubic": np.array([cubic]),
        "sinusoidal": np.array([sinusoidal]), "periods": np.array([periods]), **scene,
    }  # fmt: skip


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize(
    "peaks",
    [{"quadratic": 2e5}, {"cubic": -3e5}, {"sinusoidal": 1e5, "periods": 3.3}],
)
@pytest.mark.parametrize(("range_", "velocity"), [(1.0, 0.0), (9000.0, 3000.0), (50.0, -200.0)])
def test_the_phase_is_the_frequency_error_integrated_over_the_delay(sign, peaks, range_, velocity):
    scene = error_of(sign, **peaks, range=np.array([range_]), radial_velocity=np.array([velocity]))
    x = np.linspace(-1, 1, 7)
    found = phase_errors.sweep_phase(x, **scene)[0]
    nodes, weights = np.polynomial.legendre.leggauss(20)
    shape = {k: scene[k] for k in ("quadratic", "cubic", "sinusoidal", "periods")}
    for value, t in zip(found, START + RECORD * (x + 1) / 2, strict=True):
        delay = 2 * (range_ - velocity * t) / LIGHT
        at = t - delay * (1 + nodes) / 2
        place = (2 * at / CHIRP - 1) * sign
        error = frequency_error(place, **shape)
        # The delayed wave is behind by what the local oscillator did during the delay.
        assert value == pytest.approx(-delay / 2 * (weights @ error), rel=1e-11, abs=1e-13)


def test_no_delay_no_sweep_no_error():
    x = np.linspace(-1, 1, 5)
    some = {"quadratic": 1e6, "cubic": 1e6, "sinusoidal": 1e6}
    none = phase_errors.sweep_phase(x, **error_of(1, **some, range=np.array([0.0])))
    assert not none.any()
    assert not phase_errors.sweep_phase(x, **error_of(0, **some)).any()
