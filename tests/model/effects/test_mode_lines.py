"""Lines put together from modes, against the phase factor that they stand for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sweep.model.effects.line_splitting import Split, split_lines
from sweep.model.effects.mode_lines import STEPS
from sweep.model.effects.mode_lines import split as split_segments

PLACES = np.linspace(-1, 1, 1001)


def phases(wander, rows=50, seed=7):
    """Phases of the first degrees and a wave, of so many cycles at the most, as a function of x."""
    c = wander * np.random.default_rng(seed).uniform(-1, 1, (rows, 5))

    def phase(x):
        powers = np.stack([x**k for k in range(4)])
        return c[:, :4] @ powers + 0.1 * c[:, 4:] * np.sin(4 * x)

    return phase


def split(phase, *, tolerance):
    """Lines of rows that are all of one segment."""
    rows = phase(np.zeros(1)).shape[0]
    found = split_segments(lambda x: phase(x)[None], np.broadcast_to(tolerance, rows))
    return Split(*(values[0] for values in found))


def factor_of(found, x):
    """What the lines come to over the record, (n, x.size)."""
    turns = found.offset[..., None] * x
    return (found.weight[..., None] * np.exp(1j * np.pi * turns)).sum(axis=1)


@pytest.mark.parametrize("tolerance", [1e-9, 1e-6, 1e-3])
@given(st.floats(-9, 1))
def test_lines_make_up_the_phase_factor_to_the_tolerance(tolerance, exponent):
    """However far the phase wanders, modes or not."""
    phase = phases(10.0**exponent)
    found = split(phase, tolerance=tolerance)
    missed = abs(factor_of(found, PLACES) - np.exp(2j * np.pi * phase(PLACES))).max(axis=1)
    rounding = 1e-15 * abs(found.weight).sum(axis=1) + 1e-14
    assert (missed <= 1.3 * tolerance + rounding).all()  # fits look at fewer places
    assert (found.error <= tolerance).all() and (found.number > 0).all()


@pytest.mark.parametrize("wander", [1e-8, 1e-5, 1e-3, 0.05])
def test_they_are_as_few_as_a_fit_of_the_phase_itself_takes_but_for_a_step(wander):
    numbers = [lines for lines, _ in STEPS]
    for tolerance in (1e-8, 1e-5, 1e-3):
        found = split(phases(wander), tolerance=tolerance).number
        fitted = split_lines(phases(wander), tolerance=tolerance).number
        taken = np.searchsorted(numbers, found) - np.searchsorted(numbers, fitted)
        assert taken.max() <= 2 and taken.mean() <= 1


def test_no_phase_is_one_line_and_a_constant_slope_one_beside():
    def phase(x):
        return np.array([0.0, 0.3])[:, None] + np.array([0.0, 0.7])[:, None] * x

    found = split(phase, tolerance=1e-9)
    np.testing.assert_array_equal(found.number, [1, 1])
    np.testing.assert_allclose(found.offset[:, 0], [0.0, 1.4], atol=1e-14)
    np.testing.assert_allclose(found.weight[:, 0], [1, np.exp(0.6j * np.pi)], atol=1e-14)


def test_a_row_does_not_depend_on_those_beside_it():
    """Bit for bit, with rows that modes serve and rows that they do not in one call."""
    scale = np.repeat([1e-4, 0.02, 0.3, 4.0], 5)[:, None]

    def phase(x, rows=slice(None)):
        return (scale * (x**2 + 0.3 * x**3))[rows]

    whole = split(phase, tolerance=1e-8)
    assert len(set(whole.number)) >= 4
    for row in range(scale.size):
        alone = split(lambda x, row=row: phase(x, slice(row, row + 1)), tolerance=1e-8)
        lines = alone.number[0]
        assert whole.number[row] == lines
        np.testing.assert_array_equal(whole.offset[row, :lines], alone.offset[0, :lines])
        np.testing.assert_array_equal(whole.weight[row, :lines], alone.weight[0, :lines])
        assert not whole.weight[row, lines:].any()


def test_each_line_has_a_tolerance_of_its_own_in_every_segment():
    """Bit for bit as alone; up and down chirp are each other's opposite, the Doppler segment is
    none, and the farthest wanders too far for modes."""
    scale = np.array([1e-4, 0.02, 0.3, 4.0, 0.02])
    tolerance = np.array([1e-8, 1e-5, 1e-5, 1e-6, 1e-3])

    def phase(x):
        return np.stack([sign * scale[:, None] * (x**2 + 0.3 * x**3) for sign in (1, 0, -1)])

    whole = split_segments(phase, tolerance)
    assert whole.number.shape == (3, 5) and (whole.number[1] == 1).all()
    assert (whole.error <= tolerance).all() and (whole.number[0, 4] < whole.number[0, 1])
    for segment in range(3):
        for row in range(5):
            alone = split(
                lambda x, s=segment, r=row: phase(x)[s, r : r + 1], tolerance=tolerance[row]
            )
            lines = alone.number[0]
            assert whole.number[segment, row] == lines
            own = whole.offset[segment, row, :lines], whole.weight[segment, row, :lines]
            np.testing.assert_array_equal(own[0], alone.offset[0, :lines])
            np.testing.assert_array_equal(own[1], alone.weight[0, :lines])
