"""Chirp nonlinearity: its phase against the sweep integrated, side lobes, symmetry, its bound."""

import numpy as np
import pytest
from scipy.special import jv

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


def test_every_shape_peaks_at_its_peak_and_square_and_cube_have_no_slope_to_offer():
    u = np.linspace(-1, 1, 100001)
    for name in ("quadratic", "cubic", "sinusoidal"):
        peaks = dict.fromkeys(("quadratic", "cubic", "sinusoidal"), 0.0) | {name: 7e4}
        error = frequency_error(u, periods=2.0, **peaks)
        assert np.abs(error).max() == pytest.approx(7e4, rel=1e-6)
        if name != "sinusoidal":
            for slope in (-1e3, 1e3):  # no straight line makes the peak lower
                assert np.abs(error - slope * u).max() > 7e4 - 1e-3


def test_no_delay_no_sweep_no_error():
    x = np.linspace(-1, 1, 5)
    some = {"quadratic": 1e6, "cubic": 1e6, "sinusoidal": 1e6}
    none = phase_errors.sweep_phase(x, **error_of(1, **some, range=np.array([0.0])))
    assert not none.any()
    assert not phase_errors.sweep_phase(x, **error_of(0, **some)).any()


def test_a_small_sine_raises_the_side_lines_of_bessels_functions():
    """Whole periods over the record: lines at +-j periods with J_j, as Jacobi and Anger say."""
    length, periods, bins = 1024, 15.0, 200
    scene = error_of(1, sinusoidal=4e4, periods=periods, start=0.0, duration=CHIRP)
    delay = 2 * 3000.0 / LIGHT
    index = 2 * np.pi * 4e4 * delay * np.sinc(periods * delay / CHIRP)
    n = np.arange(length)
    error = np.exp(2j * np.pi * phase_errors.sweep_phase(2 * n / length - 1, **scene)[0])
    spectrum = np.abs(np.fft.fft(np.exp(2j * np.pi * bins * n / length) * error)) / length
    for j in range(4):
        for side in (-1, 1):
            found = spectrum[bins + side * j * int(periods)]
            assert found == pytest.approx(abs(jv(j, index)), rel=1e-8, abs=1e-12)


def test_the_down_chirp_runs_through_the_error_backwards():
    """A chirp of the whole record: up's phase error reversed in time, as far as the delay goes."""
    x = np.linspace(-1, 1, 11)
    whole = {"start": 0.0, "duration": CHIRP, "range": np.array([1e-3])}
    for name in ("quadratic", "cubic", "sinusoidal"):
        up, down = (
            phase_errors.sweep_phase(x, **error_of(sign, **{name: 1e5}, **whole))[0]
            for sign in (1, -1)
        )
        np.testing.assert_allclose(down[::-1], up, atol=1e-6 * np.abs(up).max())
