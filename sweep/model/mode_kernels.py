"""Kernels of lines in modes, worked out once for all shots, whatever their phase errors are.

A line of power 1 at nu, its phase error in modes a_k (:mod:`sweep.model.effects.line_modes`), holds
in bin q, K and w_0 as in :mod:`sweep.model.far_field`,

    |A(q) + i w_0 S|^2,   A(q) = sum_k a_k F_k(q - nu),   S = sum_k a_k S_k(nu)
    F_k(q - nu) = sum_p b_kp sin(pi (nu + o_p)) K(q - nu - o_p)

As a function of nu that is a series of Chebyshev polynomials, so that any lines within +-h of a bin
are as good as lines at few nodes x_j: their moments say how strong these are. The F_k of the nodes
in the bins next to them are kept here, and likewise the sources that they are seen as from afar.
For every width on the ladder there is a row of scratch for each tolerance, which the number of
nodes follows.
"""

import math
from collections.abc import Hashable

import numpy as np

from sweep.model.compiling import borrowing, owning
from sweep.model.effects.line_modes import IM, LINES, MODES, RE, modes
from sweep.model.elementary import flat, fma, sincos_cycles
from sweep.model.equivalent import CHEBYSHEV, POWER_TOLERANCES, nodes_for
from sweep.model.far_field import kernel_beside, sources_needed
from sweep.model.kernel_rows import (
    HALVES,
    MOST_MOMENTS,
    MOST_SOURCES,
    REACHES,
    ROWS,
    WIDTH,
    kernels_of,
)
from sweep.model.lanes import COLUMNS, LANES

ASIDE = 0.5
"""Bins beyond the lines within which sources serve modes too."""

HALF, SIZE, REACH, PLACES = range(4)  # of a row's numbers
NODES = 8
SQUARES = NODES + MOST_MOMENTS
BOUND = SQUARES + MOST_MOMENTS
SUMS = BOUND + COLUMNS
KNOWN = SUMS + MODES * MOST_MOMENTS
TILE = KNOWN + 2 * REACHES[1] // LANES + COLUMNS
TO_NODES = TILE + 3 * COLUMNS
SOURCES = TO_NODES + MOST_MOMENTS**2
SEEN = SOURCES + MOST_SOURCES
TABLE = SEEN + MOST_SOURCES * MODES * MOST_MOMENTS

_ROWS = len(HALVES) * len(POWER_TOLERANCES)
_WIDTHS = tuple(
    TABLE + MOST_MOMENTS * MODES * (2 * reach + 2 * COLUMNS + LANES) + COLUMNS for reach in REACHES
)

_FIRST = ROWS * WIDTH + COLUMNS * (MODES + 1)
"""Where rows begin, of all numbers of scratch, and what the modes are made of ends."""

_NUMBERS = _FIRST + _ROWS * _WIDTHS[0] + len(POWER_TOLERANCES) * _WIDTHS[1]


def with_modes(*key: Hashable) -> np.ndarray:
    """Scratch of :func:`sweep.model.kernel_rows.kernels_of`, with rows for modes at its end."""
    kernels = kernels_of(*key, further=-(-_NUMBERS // WIDTH) - ROWS)
    own = kernels[ROWS:].reshape(-1)
    if own[0] == 0.0:
        for k, values in enumerate((modes().offset, *modes().strength)):
            own[k * LINES : (k + 1) * LINES] = values
    return kernels


@owning()
def modes_in(kernel):
    """Offsets and strengths of :func:`sweep.model.effects.line_modes.modes`."""
    numbers, start = flat(kernel[5]), ROWS * WIDTH
    strength = numbers[start + LINES : start + LINES + MODES * LINES]
    return numbers[start : start + LINES], strength.reshape((MODES, LINES))


@borrowing()
def modes_row(level, alone, relative, kernel):
    """Row for bundles of a level, by themselves or not, to a tolerance of their power."""
    limits = kernel[3]
    loose = limits.shape[0] - 1
    while loose > 0 and limits[loose, 0] > relative:
        loose -= 1
    row = loose * len(HALVES) + level if alone else _ROWS + loose
    slot = slot_of(row, kernel)
    if slot[HALF] == 0.0:
        size = nodes_for(2.0 * math.pi * HALVES[level], relative, limits)
        slot[SIZE] = size
        slot[REACH] = REACHES[0 if alone else 1]
        if size <= MOST_MOMENTS:
            _prepare(slot, HALVES[level], size, kernel)
        slot[HALF] = HALVES[level]
    return row


@owning()
def slot_of(row, kernel):
    """A row of scratch."""
    numbers = flat(kernel[5])
    if row < _ROWS:
        start = _FIRST + row * _WIDTHS[0]
        return numbers[start : start + _WIDTHS[0]]
    start = _FIRST + _ROWS * _WIDTHS[0] + (row - _ROWS) * _WIDTHS[1]
    return numbers[start : start + _WIDTHS[1]]


@borrowing()
def _prepare(slot, half, size, kernel):
    """All but what the bins next to lines need."""
    offset, strength = modes_in(kernel)
    number = min(sources_needed(half + ASIDE, MOST_MOMENTS, len(kernel[1][2])), MOST_SOURCES)
    slot[PLACES] = number
    for i in range(number):
        slot[SOURCES + i] = (half + ASIDE) * CHEBYSHEV[number, i]
    seen = slot[SEEN:TABLE].reshape((MOST_SOURCES, MODES, MOST_MOMENTS))
    to_nodes = slot[TO_NODES:SOURCES].reshape((MOST_MOMENTS, MOST_MOMENTS))
    for j in range(size):
        turn = CHEBYSHEV[size, j]
        slot[NODES + j] = half * turn
        slot[SQUARES + j] = sincos_cycles(0.5 * half * turn)[0] ** 2
        now, before = 2.0 / size * turn, 2.0 / size
        to_nodes[0, j] = 1.0 / size
        for m in range(1, size):
            to_nodes[m, j] = now
            now, before = 2.0 * turn * now - before, now
        for p in range(offset.size):
            at = _off_bins(slot[NODES + j] + offset[p])
            sine = sincos_cycles(0.5 * at)[0]
            _shares(at / (half + ASIDE), number, slot[TILE:])
            for k in range(MODES):
                strong = strength[k, p] * sine
                slot[SUMS + k * MOST_MOMENTS + j] += strong
                for i in range(number):
                    seen[i, k, j] += strong * slot[TILE + i]
    _take_bounds(slot, kernel)


@borrowing()
def _off_bins(at):
    """A place, off a bin by the last digit if it is on one: there are then both sine and pole."""
    return at + max(3e-16 * abs(at), 1e-30) if at == math.floor(at) else at


@borrowing()
def _shares(x, number, out):
    """Shares that sources at Chebyshev nodes have in one at x."""
    before, now = out[COLUMNS : 2 * COLUMNS], out[2 * COLUMNS : 3 * COLUMNS]
    there, before_there = x, 1.0
    for i in range(number):
        before[i], now[i], out[i] = 1.0, CHEBYSHEV[number, i], 1.0 / number
    for _ in range(1, number):
        for i in range(number):
            out[i] += 2.0 / number * there * now[i]
            before[i], now[i] = now[i], 2.0 * CHEBYSHEV[number, i] * now[i] - before[i]
        there, before_there = 2.0 * x * there - before_there, there


@borrowing()
def _take_bounds(slot, kernel):
    """How much more than a line, at most, each mode shows anywhere beside it."""
    offset, strength = modes_in(kernel)
    window_sum, envelope, reach, _ = kernel[2]
    coefficients, fft_size = kernel[1][0], kernel[0][0]
    square, scale = (math.pi / fft_size) ** 2, fft_size / math.pi
    y = 0.0
    while y < min(1000.0, 0.01 * fft_size):
        for quarter in range(4):
            at = math.floor(y) + 0.25 * quarter + 0.01
            place = max(np.searchsorted(reach, at, "right") - 1, 0)
            least = window_sum * envelope[place]
            for k in range(MODES):
                total = 0.0
                for p in range(offset.size):
                    beside = kernel_beside(0, offset[p] - at, coefficients, square)
                    total += strength[k, p] * sincos_cycles(0.5 * (offset[p] - at))[0] * beside
                slot[BOUND + k] = max(slot[BOUND + k], abs(total) * scale / least)
        y = max(y + 1.0, 1.2 * y)


@borrowing()
def bound_of(numbers, kernel):
    """Bound on what a line in modes shows anywhere beside it, relative to the line by itself."""
    slot = slot_of(modes_row(0, True, 1.0, kernel), kernel)
    total = math.hypot(numbers[RE], numbers[IM])
    for k in range(1, MODES):
        total += math.hypot(numbers[RE + k], numbers[IM + k]) * slot[BOUND + k]
    return total


@borrowing()
def columns_beside(first, slot, kernel):
    """Where F_k of the first node and mode in bins first .. first + COLUMNS - 1 are.

    Those of each next mode are so many elements further, of each next node MODES times as many.
    """
    reach = int(slot[REACH])
    start, kept = first + reach, 2 * reach + COLUMNS
    if start < 0 or start + COLUMNS > kept:
        for step in range(0, COLUMNS, LANES):
            _work_out(first + step, kept + step, slot, kernel)
        start = kept
    else:
        for step in range(start // LANES, (start + COLUMNS - 1) // LANES + 1):
            if slot[KNOWN + step] == 0.0:
                slot[KNOWN + step] = 1.0
                _work_out(step * LANES - reach, step * LANES, slot, kernel)
    return TABLE + start, 2 * reach + 2 * COLUMNS + LANES


@borrowing()
def _work_out(first, column, slot, kernel):
    """F_k of LANES bins from ``first`` on, into columns of the table."""
    offset, strength = modes_in(kernel)
    coefficients, fft_size = kernel[1][0], kernel[0][0]
    square, scale = (math.pi / fft_size) ** 2, fft_size / math.pi
    stride = 2 * int(slot[REACH]) + 2 * COLUMNS + LANES
    beside = slot[TILE : TILE + LANES]
    for j in range(int(slot[SIZE])):
        at = TABLE + column + j * MODES * stride
        for k in range(MODES):
            slot[at + k * stride : at + k * stride + LANES] = 0.0
        for p in range(offset.size):
            place = _off_bins(slot[NODES + j] + offset[p])
            sine = scale * sincos_cycles(0.5 * place)[0]
            for i in range(LANES):
                beside[i] = sine * kernel_beside(first + i, place, coefficients, square)
            for k in range(MODES):
                into = slot[at + k * stride : at + k * stride + LANES]
                for i in range(LANES):
                    into[i] = fma(strength[k, p], beside[i], into[i])
