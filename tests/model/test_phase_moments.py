"""Few lines for many with a phase error, against the record that they stand for."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from sweep.model.bundles import DELTA, ROOM, STRENGTH_IM, STRENGTH_RE, WIDTH
from sweep.model.effects.line_modes import NUMBER, PLACES, in_modes, middles_of
from sweep.model.phase_moments import take_phases
from sweep.model.window import samples, window

SIZE = 512


def kernel_of(name, padding):
    """What is looked at of a window's kernel, of a record that is padded so many times."""
    shape = window(name, SIZE)
    return (
        (SIZE * padding, SIZE),
        (),
        (shape.sum, shape.envelope, shape.reach, shape.beyond),
        shape.node_limits(False),
    )


def taken(places, weights, phase, kernel, *, fold=1.0, tolerance, relative):
    """Lines with a phase error in the place of others, and how exactly they should be that."""
    room, n = np.zeros((ROOM, WIDTH)), places.size
    room[DELTA, :n], room[STRENGTH_RE, :n], room[STRENGTH_IM, :n] = (
        places, weights.real, weights.imag,
    )  # fmt: skip
    at = phase(PLACES)[None]
    numbers, middle = in_modes(at, np.array([tolerance]))[0], middles_of(at[None])[0, 0]
    assert numbers[NUMBER : NUMBER + 2].any()
    together = min(np.sqrt(n), max(3.0, 0.1 * np.sqrt(n)))
    error = relative * kernel[2][0] * np.sqrt((abs(weights) ** 2).sum()) * together
    few = take_phases(n, numbers, middle, fold, (error, 0.0), kernel, room)
    found = room[DELTA, :few], room[STRENGTH_RE, :few] + 1j * room[STRENGTH_IM, :few]
    return found, error + tolerance * kernel[2][0] * abs(weights).sum()


def seen(places, weights, t, kernel, name, bins):
    """Spectrum of lines, by their record."""
    fft_size, length = kernel[0]
    record = np.exp(1j * np.pi * length / fft_size * np.outer(t, places)) @ weights
    return record, np.exp(-1j * np.pi * length / fft_size * np.outer(bins, t)), samples(name, SIZE)


def wandering(generator, degree, size):
    """A polynomial of the record's time, of a size [cycles]."""
    c = size * generator.uniform(-1, 1, degree + 1)
    return lambda x: np.polynomial.polynomial.polyval(x, c)


@pytest.mark.parametrize("name", ["hann", "hamming", "rectangular", "flattop"])
@pytest.mark.parametrize("padding", [1, 2])
@given(
    seed=st.integers(0, 2**32 - 1), lines=st.sampled_from([1, 2, 5, 37, 109]),
    spread=st.floats(-3, 1.5), wander=st.floats(-9, 0.2), degree=st.integers(0, 5),
    tolerance=st.sampled_from([1e-9, 1e-6, 1e-3]), fold=st.sampled_from([1.0, -1.0]),
)  # fmt: skip
def test_spectra_are_those_of_the_records_with_the_phase_error(
    name, padding, seed, lines, spread, wander, degree, tolerance, fold
):
    """One line, tight footprints and wide ones; lines seen as their images; as far as modes go."""
    generator, kernel = np.random.default_rng(seed), kernel_of(name, padding)
    places = padding * 10.0**spread * generator.uniform(-1, 1, lines) + generator.uniform(-3, 3)
    weights = generator.normal(size=lines) + 1j * generator.normal(size=lines)
    phase = wandering(generator, degree, 10.0**wander)
    assume(in_modes(phase(PLACES)[None], np.array([tolerance]))[0, NUMBER : NUMBER + 2].any())
    found, allowed = taken(
        places, weights, phase, kernel, fold=fold, tolerance=tolerance, relative=tolerance
    )
    t, bins = 2 * np.arange(SIZE) / SIZE - 1, np.linspace(-40, 40, 161)
    factor = np.exp(2j * np.pi * fold * phase(t))
    own, turns, w = seen(places, weights, t, kernel, name, bins)
    few, _, _ = seen(*found, t, kernel, name, bins)
    missed = abs(turns @ (w * (few - own * factor))).max()
    rounding = 1e-11 * kernel[2][0] * abs(weights).sum()
    assert missed <= allowed + rounding


def test_many_lines_are_as_few_as_their_spread_takes_and_far_ones_stay_apart():
    generator, kernel = np.random.default_rng(3), kernel_of("hann", 1)
    weights = generator.normal(size=109) + 0j
    drift = lambda x: 0.05 * x**2  # noqa: E731
    for spread, most in ((0.01, 14), (2.0, 25), (2000.0, 109 * 16)):
        places = spread * generator.uniform(-1, 1, 109)
        found, _ = taken(places, weights, drift, kernel, tolerance=1e-6, relative=1e-6)
        assert 1 < found[0].size <= most
        assert found[0].size >= (109 if spread > 100 else 1)


def test_no_phase_leaves_lines_what_they_are_and_a_constant_turns_them():
    kernel = kernel_of("hamming", 1)
    places, weights = np.array([0.3]), np.array([2.0 - 1.0j])
    for turn in (0.0, 0.3):
        constant = lambda x, turn=turn: turn + 0.0 * x  # noqa: E731
        found, _ = taken(places, weights, constant, kernel, tolerance=1e-9, relative=1e-9)
        total = found[1].sum()
        np.testing.assert_allclose(total, weights[0] * np.exp(2j * np.pi * turn), rtol=1e-9)
        np.testing.assert_allclose((found[0] * found[1]).sum() / total, 0.3, atol=1e-8)
