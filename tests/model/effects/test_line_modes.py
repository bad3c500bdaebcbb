"""Phase errors in modes, against the phase factor itself."""

import numpy as np
import pytest
from numpy.polynomial.chebyshev import chebval

from sweep.model.effects import line_modes
from sweep.model.effects.line_modes import CENTRE, IM, MODES, NUMBER, ORDER, PLACES, RE

X = np.linspace(-1, 1, 401)


def in_modes(phase, tolerance):
    """Modes of lines of one segment."""
    return line_modes.in_modes(phase[None], np.asarray(tolerance))[0]


def drift(bins):
    """A drift of so many bins over the record, off its middle, and a cubic phase [cycles]."""
    bins = np.atleast_1d(bins)[:, None]
    return lambda x: bins * (x**2 / 8 + x**3 / 60 + 0.1 * x) + 0.3


def factor(numbers, x):
    """What modes make of a line's record, but for a constant phase."""
    coefficient = np.zeros(MODES, complex)
    coefficient[list(ORDER)] = numbers[RE : RE + MODES] + 1j * numbers[IM : IM + MODES]
    return chebval(x, coefficient) * np.exp(1j * np.pi * numbers[CENTRE] * x)


@pytest.mark.parametrize("tolerance, reach", [(1e-9, 1.0), (1e-7, 1.7), (1e-5, 3.0)])
def test_modes_make_up_the_phase_factor(tolerance, reach):
    bins = np.concatenate([[0.0], np.geomspace(1e-4, reach, 30), [30.0]])
    bins[1::2] *= -1
    found = in_modes(drift(bins)(PLACES), np.full(bins.size, tolerance))
    for numbers, exact in zip(found[:-1], np.exp(2j * np.pi * drift(bins)(X)), strict=False):
        assert numbers[NUMBER] > 0
        for made in (factor(numbers, X), from_lines(numbers, X)):
            turned = made * np.exp(1j * np.angle(np.vdot(made, exact)))
            assert abs(turned - exact).max() < tolerance
    assert found[-1, NUMBER] == 0  # too far for so few


def from_lines(numbers, x):
    """The same from the pure lines that modes are made of."""
    known = line_modes.modes()
    place, re, im = line_modes.lines_of(numbers, known.offset, known.strength)
    return np.exp(1j * np.pi * np.outer(x, place)) @ (re + 1j * im)


def test_even_phases_take_even_modes_alone():
    found = in_modes(np.array([0.1 * PLACES**2]), [1e-9])[0]
    assert found[NUMBER] > 3 and found[NUMBER + 1] == 0 and abs(found[CENTRE]) < 1e-15


def test_no_phase_is_a_plain_line():
    found = in_modes(np.zeros((1, PLACES.size)), [1e-9])[0]
    assert line_modes.is_plain(found)
    assert not line_modes.is_plain(in_modes(drift(0.1)(PLACES), [1e-5])[0])
    shifted = in_modes(np.array([0.5 * PLACES]), [1e-9])[0]
    assert shifted[CENTRE] == pytest.approx(1.0) and not line_modes.is_plain(shifted)
