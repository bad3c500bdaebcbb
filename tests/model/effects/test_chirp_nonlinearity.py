"""Chirp nonlinearity: its phase against the sweep integrated, and tables against whole records."""

import numpy as np
import pytest
from random_planner_points import planner_inputs, prepare_single_category

from sweep.model.effects import phase_errors
from sweep.model.effects.sweep_error_table import fit_sweep_frequency_error
from sweep.model.spectrum.segment_spectra import segment_spectrum

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
    "peaks", [{"quadratic": 2e5}, {"cubic": -3e5}, {"sinusoidal": 1e5, "periods": 3.3}]
)
@pytest.mark.parametrize(("range_", "velocity"), [(1.0, 0.0), (9000.0, 3000.0), (50.0, -200.0)])
def test_the_phase_is_the_frequency_error_integrated_over_the_delay(sign, peaks, range_, velocity):
    scene = error_of(sign, **peaks, range=np.array([range_]), radial_velocity=np.array([velocity]))
    x = np.linspace(-1, 1, 7)
    phase = phase_errors.chirp_nonlinearity_phase(x, **scene)[0]
    nodes, weights = np.polynomial.legendre.leggauss(20)
    shape = {k: scene[k] for k in ("quadratic", "cubic", "sinusoidal", "periods")}
    for value, t in zip(phase, START + RECORD * (x + 1) / 2, strict=True):
        delay = 2 * (range_ - velocity * t) / LIGHT
        at = t - delay * (1 + nodes) / 2
        place = (2 * at / CHIRP - 1) * sign
        error = frequency_error(place, **shape)
        # The delayed wave is behind by what the local oscillator did during the delay.
        assert value == pytest.approx(-delay / 2 * (weights @ error), rel=1e-11, abs=1e-13)


def test_no_delay_no_sweep_no_error():
    x = np.linspace(-1, 1, 5)
    coefficients = {"quadratic": 1e6, "cubic": 1e6, "sinusoidal": 1e6}
    none = phase_errors.chirp_nonlinearity_phase(
        x, **error_of(1, **coefficients, range=np.array([0.0]))
    )
    assert not none.any()
    assert not phase_errors.chirp_nonlinearity_phase(x, **error_of(0, **coefficients)).any()


def table_of(error, *, first=0.0, last=CHIRP, rows=401):
    """Text of a table of an error [Hz] by the time in the up-chirp."""
    times = np.linspace(first, last, rows)
    return ", ".join(f"{t!r} {e!r}" for t, e in zip(times.tolist(), error(times), strict=True))


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize(("range_", "velocity"), [(1.0, 0.0), (4000.0, 3000.0), (50.0, -200.0)])
def test_a_quadratic_error_in_a_table_is_the_quadratic_law(sign, range_, velocity):
    text = table_of(lambda t: frequency_error(2 * t / CHIRP - 1, quadratic=2e5, cubic=0,
                                              sinusoidal=0, periods=1).tolist())  # fmt: skip
    place = {"range": np.array([range_]), "radial_velocity": np.array([velocity])}
    scene = error_of(sign, quadratic=2e5, **place)
    x, names = np.linspace(-1, 1, 9), ("sign", "chirp_duration", "start", "duration")
    table = fit_sweep_frequency_error(text)
    assert table.chebyshev_coefficients.size == 3
    phase = phase_errors.sweep_error_table_phase(
        x, table=table, **place, **{n: scene[n] for n in names}
    )
    expected = phase_errors.chirp_nonlinearity_phase(x, **scene)
    np.testing.assert_allclose(phase, expected, rtol=1e-11, atol=1e-13)


def test_a_table_is_held_beyond_its_ends():
    table = fit_sweep_frequency_error("0.0 -1.0, 1.0 0.0, 2.0 1.0")
    # From -1 to 3: -1 a second long, 0 over the table, 1 a second long; from 1.5 to 3.5 by hand.
    np.testing.assert_allclose(
        table.integrate_error(np.array([-1.0]), np.array([3.0])), 0, atol=1e-15
    )
    np.testing.assert_allclose(table.integrate_error(np.array([1.5]), np.array([3.5])), 0.375 + 1.5)
    np.testing.assert_allclose(table.integrate_error(np.array([-3.0]), np.array([-1.0])), -2.0)


RIPPLE, CYCLES = 2e4, 6.3
"""Peak [Hz] of an error, and its periods over the chirp."""


@pytest.mark.parametrize("delayed", [20e-6, 0.0])
def test_a_ripple_in_a_table_is_that_of_the_whole_record(table_4_1, delayed):
    turn, range_ = 2 * np.pi * CYCLES / CHIRP, 2500.0
    text = table_of(lambda t: (RIPPLE * np.sin(turn * t + 0.3)).tolist())
    p = table_4_1(range=range_, acquisition_delay=delayed, fft_size=2**17, window="hann")
    p = p | {phase_errors.ERROR_TABLE_PATH: text}
    shots = prepare_single_category(p, ("chirp_nonlinearity",))
    delay, rate, length = 2 * range_ / LIGHT, 6e8, shots.window.length
    t = delayed + np.arange(length) / rate

    def emitted(at):  # integral of the error, held before the chirp begins
        inside = -RIPPLE / turn * (np.cos(turn * np.maximum(at, 0) + 0.3) - np.cos(0.3))
        return inside + np.minimum(at, 0) * RIPPLE * np.sin(0.3)

    for segment, sign in ((0, 1), (2, -1)):
        if sign > 0:
            psi = emitted(t - delay) - emitted(t)
        else:  # which runs through the sweep backwards, held beyond its other end
            end = RIPPLE * np.sin(turn * CHIRP + 0.3)
            later = CHIRP - t + delay
            over = np.maximum(later - CHIRP, 0)
            psi = emitted(CHIRP - t) - emitted(later - over) - over * end
        beat = -sign * 1e9 / CHIRP * delay
        record = np.hanning(length + 1)[:-1] * np.exp(2j * np.pi * (beat * t + psi))
        expected = abs(np.fft.fft(record, 2**17))
        tone = np.hanning(length + 1)[:-1] * np.exp(2j * np.pi * beat * t)
        peak = int(np.argmax(abs(np.fft.fft(tone, 2**17))))
        near = (peak + np.arange(-60, 61)) % 2**17
        bins, magnitude = segment_spectrum(shots, 0, segment)
        spectrum = magnitude[np.searchsorted(bins, np.where(near > 2**16, 2**17 - near, near))]
        scale = spectrum.max() / expected[near].max()
        # The series leaves 1e-3 of the span 2 RIPPLE at the most, over the delay.
        phase = 2 * np.pi * delay * 1e-3 * 2 * RIPPLE
        assert expected[near].max() < 0.8 * abs(np.fft.fft(tone, 2**17)).max()  # it matters
        bound = phase * abs(np.fft.fft(tone, 2**17)).max()
        np.testing.assert_allclose(spectrum / scale, expected[near], atol=bound)


def test_a_tables_size_covers_what_it_does_to_the_record(table_4_1):
    text = table_of(lambda t: (2e3 + RIPPLE * np.sin(4e4 * t)).tolist())
    p = table_4_1(range=np.array([100.0, 3000.0]), radial_velocity=30.0)
    smear = phase_errors.chirp_nonlinearity_phase_bound(
        planner_inputs(p | {phase_errors.ERROR_TABLE_PATH: text})
    )
    x, t = np.linspace(-1, 1, 4001), 2**17 / 6e8
    psi = phase_errors.sweep_error_table_phase(
        x, table=fit_sweep_frequency_error(text), sign=1, chirp_duration=CHIRP,
        range=np.array([100.0, 3000.0]), radial_velocity=np.array([30.0, 30.0]), start=0.0,
        duration=t,
    )  # fmt: skip
    error_max = (smear.mid_record_phase + smear.non_polynomial_phase + smear.coefficients[0])[0]
    slope = 2 * np.abs(np.gradient(psi, x, axis=1)).max(axis=1)  # bins of fs/L
    assert (np.abs(psi).max(axis=1) <= error_max).all()
    assert (np.abs(psi).max(axis=1) > 0.8 * error_max).all()
    assert (slope <= np.asarray(smear.shift_window_bins)[0]).all()
    assert (slope > 0.5 * np.asarray(smear.shift_window_bins)[0]).all()
