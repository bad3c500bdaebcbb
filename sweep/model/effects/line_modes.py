"""A phase error over the record as few polynomials of time, that all shots share.

With x running over the record from -1 to 1, a phase error psi(x) [cycles] that wanders little makes
of a line's record

    exp(2 pi i psi(x)) = exp(i pi o x) sum_k a_k T_k(x)

times a constant phase, to a stated error: the line is moved by o bins of fs/L, the middle of the
phase's slope, and its window is a sum of few *modes*, the window times a Chebyshev polynomial. Only
the numbers a_k are the shot's own, so that kernels of the modes serve every shot
(:mod:`sweep.model.mode_kernels`).

A mode in turn is a sum of pure lines on places that all modes share, weights i^k b_kp with b_kp
real (:mod:`sweep.model.effects.line_splitting`); so is a line in modes, where its bins are looked
at one by one.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.model.compiling import borrowing, owning
from sweep.model.effects.line_splitting import fitted
from sweep.model.elementary import sincos_cycles
from sweep.model.lanes import COLUMNS, combine

MODES, EVENS = 17, 9
"""Modes; how many of them are even, which come first: 0, 2 .. 16, 1, 3 .. 15."""

ORDER = (*range(0, MODES, 2), *range(1, MODES, 2))
"""Degree of each mode."""

NUMBER, CENTRE, RE, IM = 0, 2, 3, 3 + MODES
"""What a line in modes is known by: modes that count, even and odd; o; a_k."""

NUMBERS = 3 + 2 * MODES

LINES, SPACING = 25, 0.4
"""Lines that a mode is made of, and bins of fs/L from one to the next."""

_TURN = np.pi * (np.arange(COLUMNS) + 0.5) / COLUMNS

PLACES = np.cos(_TURN)
"""Places x of the record at which the phase is looked at."""

_TO_DEGREES = np.cos(np.outer(_TURN, np.arange(COLUMNS))) * (2 / COLUMNS)
_TO_DEGREES[:, 0] *= 0.5


class Modes(NamedTuple):
    """Modes as sums of pure lines."""

    offset: np.ndarray
    """(lines,): places [bins of fs/L]."""
    strength: np.ndarray
    """(modes, lines): b_kp; of odd modes the weight is i times it."""
    error: np.ndarray
    """(modes,): largest error anywhere in the record."""


@lru_cache(maxsize=1)
def modes() -> Modes:
    """The modes, worked out when they are first needed."""
    return mode_weights(LINES, SPACING)


def mode_weights(lines: int, spacing: float) -> Modes:
    """The modes as sums of so many lines, as well as these can be."""
    offset, weight, error = fitted(_polynomials, np.array(ORDER), lines, spacing)
    strength = np.where(np.arange(MODES)[:, None] < EVENS, weight.real, weight.imag)
    return Modes(offset, np.ascontiguousarray(strength), error)


def _polynomials(x: np.ndarray, degree: np.ndarray) -> np.ndarray:
    """T_k(x), (degrees, m)."""
    return np.asarray(np.cos(degree[:, None] * np.arccos(np.clip(x, -1, 1))))


def in_modes(phase: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
    """Lines with phase errors as modes.

    Parameters
    ----------
    phase : (segments, n, COLUMNS) ndarray
        Phase errors at :data:`PLACES` [cycles].
    tolerance : (n,) ndarray
        Error of the phase factor that may remain anywhere in the record.

    Returns
    -------
    (segments, n, NUMBERS) ndarray
        See :data:`NUMBER`; no modes count where there are not enough for a phase.

    Notes
    -----
    A drift of two bins within the record (psi = x^2 / 4) is within the reach at 1e-9, one of four
    bins at 1e-5.

    Where the last segment drifts just as the first does, but the other way, as a target's motion
    has it in the two chirps, its modes are those of the first, conjugated.
    """
    found = np.zeros((*phase.shape[:2], NUMBERS))
    phase, room = np.ascontiguousarray(phase), np.empty((6, COLUMNS))
    _fit_all(phase, tolerance + 0.0, modes().error, _TO_DEGREES, room, found)
    return found


def middles_of(phase: np.ndarray) -> np.ndarray:
    """Cosine and sine of the constant phases that modes leave out, (segments, n, 2)."""
    found = np.empty((*phase.shape[:2], 2))
    _turn_middles(np.ascontiguousarray(phase), found)
    return found


@borrowing()
def _turn_middles(phase, found):
    """Cosine and sine of the middle of every row of every segment."""
    for segment in range(phase.shape[0]):
        for row in range(phase.shape[1]):
            middle = 0.0
            for i in range(COLUMNS):
                middle += phase[segment, row, i] / COLUMNS
            sine, cosine = sincos_cycles(middle)
            found[segment, row, 0], found[segment, row, 1] = cosine, sine


@borrowing()
def _fit_all(phase, tolerance, errors, to_degrees, room, found):
    """Fit the modes of every row of every segment."""
    flat = to_degrees.reshape(-1)
    last = phase.shape[0] - 1
    for segment in range(phase.shape[0]):
        for row in range(phase.shape[1]):
            own, out = phase[segment, row], found[segment, row]
            if segment == last and segment > 0 and _are_opposite(own, phase[0, row]):
                _conjugate(found[0, row], out)
            else:
                _fit_row(own, tolerance[row], errors, flat, room, out)


@borrowing()
def _are_opposite(one, other):
    """Whether phases are each other's opposite, at all places."""
    apart = 0
    for i in range(COLUMNS):
        apart += one[i] != -other[i]
    return apart == 0


@borrowing()
def _conjugate(numbers, out):
    """Modes of the opposite phases."""
    for i in range(NUMBERS):
        out[i] = numbers[i]
    out[CENTRE] = -numbers[CENTRE]
    for i in range(IM, NUMBERS):
        out[i] = -numbers[i]


@borrowing()
def _fit_row(own, tolerance, errors, flat, room, out):
    """Fit the modes of one row."""
    slope, re, im, one, other, size = room[0], room[1], room[2], room[3], room[4], room[5]
    wanders = False
    for i in range(COLUMNS):
        wanders |= own[i] != 0.0
    if not wanders:
        out[NUMBER], out[RE] = 1.0, 1.0
        return
    combine(own, flat, COLUMNS, 0, COLUMNS, slope)
    middle, rise = slope[0], slope[1]
    for i in range(COLUMNS):  # a loop of its own, so that the next one vectorises
        size[i] = own[i] - middle - rise * PLACES[i]
    for i in range(COLUMNS):
        im[i], re[i] = sincos_cycles(size[i])
    combine(re, flat, COLUMNS, 0, COLUMNS, one)
    combine(im, flat, COLUMNS, 0, COLUMNS, other)
    for k in range(COLUMNS):
        size[k] = math.sqrt(one[k] * one[k] + other[k] * other[k])
    if _keep(one, other, size, tolerance, errors, out):
        out[CENTRE] = 2.0 * rise


@borrowing()
def _keep(re, im, size, tolerance, errors, out):
    """Takes the modes that count, so that what is left out comes to less than the tolerance."""
    count_even, count_odd, left_out, error = 0, 0, 0.0, 0.0
    for k in range(COLUMNS - 1, -1, -1):
        count = count_odd if k & 1 else count_even
        if count == 0 and left_out + size[k] <= 0.5 * tolerance:
            left_out += size[k]
            continue
        if k >= MODES:
            return False
        error += size[k] * errors[k // 2 + (EVENS if k & 1 else 0)]
        if k & 1:
            count_odd = max(count, k // 2 + 1)
        else:
            count_even = max(count, k // 2 + 1)
    if error > 0.5 * tolerance:
        return False
    for i in range(count_even):
        out[RE + i], out[IM + i] = re[2 * i], im[2 * i]
    for i in range(count_odd):
        out[RE + EVENS + i], out[IM + EVENS + i] = re[2 * i + 1], im[2 * i + 1]
    out[NUMBER], out[NUMBER + 1] = count_even, count_odd
    return True


@borrowing()
def is_plain(numbers):
    """Whether a line in modes is just a line, where it was."""
    alone = numbers[NUMBER] == 1.0 and numbers[NUMBER + 1] == 0.0
    return alone and numbers[CENTRE] == 0.0


@owning()
def lines_of(numbers, offset, strength):
    """Pure lines that a line in modes is: places [bins of fs/L], real and imaginary weights.

    ``offset`` and ``strength`` are those of :func:`modes`.
    """
    place, re, im = np.zeros((3, offset.size))
    for p in range(offset.size):
        place[p] = numbers[CENTRE] + offset[p]
        for k in range(MODES):
            a, b = strength[k, p] * numbers[RE + k], strength[k, p] * numbers[IM + k]
            re[p] += a if k < EVENS else -b
            im[p] += b if k < EVENS else a
    return place, re, im
