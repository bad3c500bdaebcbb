"""Few lines for many with a phase error, against the record that they stand for."""

from itertools import product

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from sweep.model.bundles import DELTA, ROOM, STRENGTH_IM, STRENGTH_RE, WIDTH
from sweep.model.effects.line_modes import (
    EVENS,
    IM,
    MODES,
    NUMBER,
    NUMBERS,
    ORDER,
    PLACES,
    RE,
    in_modes,
    middles_of,
)
from sweep.model.equivalent import MOST_NODES, nodes_for
from sweep.model.phase_moments import (
    ALONE,
    LEAST_GROWTH,
    MORE,
    MOST,
    nodes_beside,
    take_phases,
)
from sweep.model.window import COSINE_SUMS, samples, window

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
    at = phase(PLACES)[None, None]
    numbers, middle = in_modes(at, np.array([tolerance]))[0, 0], middles_of(at)[0, 0]
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
    spread=st.floats(-3, 1.5), wander=st.floats(-9, 0.6), degree=st.integers(0, 5),
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
    assume(
        in_modes(phase(PLACES)[None, None], np.array([tolerance]))[..., NUMBER : NUMBER + 2].any()
    )
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


def left_out(z, own, nodes, weights):
    """What so many moments of a line leave out of exp(i z x t) T_k(t), k to 16: the mean over t.

    By dense matrices, for the worst of places x; own are the radians they lie within.
    """
    t, x, m = np.linspace(0, 1, len(weights)), np.linspace(0, own / z, 9), np.arange(nodes)
    odd = (m[:, None] > m) & ((m[:, None] - m) % 2 == 1)
    derivative = np.where(odd, 2.0 * m[:, None], 0) / np.where(m == 0, 2, 1)
    moments = [np.cos(np.outer(m, np.arccos(x))) + 0j]
    before = moments[0]
    for k in range(1, MODES):
        now = (1 if k == 1 else 2) * derivative @ moments[-1] / (1j * z)
        moments.append(now - (before if k > 1 else 0))
        before = moments[-2]
    places = np.pi * (m + 0.5) / nodes
    put = (2 / nodes) * np.cos(np.outer(places, m))
    put[:, 0] /= 2
    seen, exact = np.exp(1j * z * np.outer(t, np.cos(places))), np.exp(1j * z * np.outer(t, x))
    waves = [np.cos(k * np.arccos(t))[:, None] * exact for k in range(MODES)]
    missed = [abs(seen @ (put @ m_k) - wave) for m_k, wave in zip(moments, waves, strict=True)]
    return np.array([(weights @ each).max() for each in missed])


@pytest.mark.parametrize("name", COSINE_SUMS)
def test_what_moments_leave_out_grows_with_derivatives_as_the_bound_has_it(name):
    """All that adds up to any phase error of any lines: each mode of one line anywhere."""
    shape = window(name, SIZE)
    limits, weights, k = shape.node_limits(False), np.array(shape.band_weights), np.arange(MODES)
    for beside, own, tolerance in product(
        np.pi * np.array([0.25, 0.5, 1, 3, 8, 12]), [0, 0.3, 1, 5, 20, 60], limits[4::3, 0]
    ):
        z = own + beside
        scale = np.sqrt(z**2 - own**2)
        least = nodes_for(z, tolerance, limits)
        for nodes in sorted({max(least, 2), max(least, 5), max(least, 9), max(least, MODES)}):
            if nodes > MOST_NODES:
                continue
            bound = np.cosh(k * np.arccosh(max(LEAST_GROWTH, (nodes + MORE) / scale)))
            told = bound * 1e-15 < tolerance  # else rounding shows
            missed = left_out(z, own, nodes, weights)
            assert (missed <= tolerance * bound)[told].all()


@pytest.mark.parametrize("name", COSINE_SUMS)
def test_as_many_moments_are_taken_as_leave_out_less_than_is_allowed(name):
    shape = window(name, SIZE)
    limits, weights = shape.node_limits(False), np.array(shape.band_weights)
    for size, own, tolerance in product(np.geomspace(0.01, 3, 9), [0, 1, 20], [1e-9, 1e-6, 1e-3]):
        phase = size * (PLACES**2 + PLACES**3 / 3)
        numbers = in_modes(phase[None, None], np.array([tolerance]))[0, 0]
        if not numbers[NUMBER : NUMBER + 2].any():
            continue  # too far for so few
        nodes, beside = nodes_beside(own, numbers, tolerance, limits)
        amplitude = np.zeros(MODES)
        amplitude[list(ORDER)] = np.hypot(numbers[RE : RE + MODES], numbers[IM : IM + MODES])
        assert amplitude @ left_out(own + beside, own, nodes, weights) < tolerance


def test_one_line_becomes_no_more_than_there_is_room_for():
    """At the most beside it, and the least error there is: where growth is bounded by nothing."""
    numbers = np.zeros(NUMBERS)
    numbers[[NUMBER, NUMBER + 1]] = EVENS, MODES - EVENS
    numbers[RE : RE + MODES] = 1e3
    for name in COSINE_SUMS:
        limits = window(name, SIZE).node_limits(False)
        nodes, beside = nodes_beside(0.0, numbers, 0.0, limits)
        assert beside == np.pi * MOST and MODES < nodes <= ALONE


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
