"""Bundles of lines around a bin as moments, whose kernels in the bins next to it are known.

As a function of a line's place nu within +-h of a bin, its kernel in bin q is a series of Chebyshev
polynomials (:mod:`sweep.model.equivalent`). Lines C_b therefore hold in bins next to them

    sum_m M_m g_m[q],   M_m = sum_b C_b T_m(nu_b / h)

    g_m[q] = (2 - [m = 0]) / J sum_j T_m(x_j) s_j K(q - h x_j),   s_j = sin(pi h x_j)

with J Chebyshev nodes x_j, and K^2 and s_j^2 where they add as powers. Images about mirrored places
hold the same with (-1)^m. Far from them sum_m M_m f_mi are the strengths of few sources at other
nodes (:mod:`sweep.model.far_field`). The widths h are on a ladder: g and f are worked out for each
when it is first met, to the last digit, and are in a row of scratch for all that follows; fewer
moments than there are serve a looser tolerance.
"""

import math

from numba import njit

from sweep.model.elementary import fma, sincos_cycles
from sweep.model.equivalent import CHEBYSHEV, nodes_for
from sweep.model.far_field import kernel_beside, sources_needed
from sweep.model.lanes import COLUMNS, combine

HALVES = tuple(0.6 * 1.35**level for level in range(11))
"""Half widths h of bundles [bins]."""

MOST_MOMENTS = 64

REACH = 32
"""Bins on either side of the middle in which kernels are known."""

_MOST_SOURCES = COLUMNS
_COLUMNS = 2 * REACH + COLUMNS
_NODES, _SOURCES, _TO_NODES = 8, 8 + MOST_MOMENTS, 8 + 2 * MOST_MOMENTS
_TABLE = _TO_NODES + MOST_MOMENTS**2
_TO_SOURCES = _TABLE + MOST_MOMENTS * _COLUMNS

WIDTH = _TO_SOURCES + MOST_MOMENTS * _MOST_SOURCES
"""Numbers that a row of scratch must hold."""

ROWS = 2 * len(HALVES)
"""Rows of scratch; their first elements are 0 at first."""


@njit(cache=True, error_model="numpy")
def level_for(farthest):
    """Least level of the ladder that holds lines so far from the bin [bins], or -1."""
    for level in range(len(HALVES)):
        if farthest <= HALVES[level]:
            return level
    return -1


@njit(cache=True, error_model="numpy")
def known(slot, half, power, kernel):
    """Works out what a row is to hold, if it does not yet."""
    if slot[0] > 0.0:
        return
    band = math.pi * (2.0 if power else 1.0)
    size = min(nodes_for(band * half, 0.0, kernel[3]), MOST_MOMENTS)
    slot[0] = size
    slot[_TO_NODES:WIDTH] = 0.0
    _nodes(slot, half, size, power)
    to_nodes, row = strengths_at_nodes(slot), slot[_TO_SOURCES : _TO_SOURCES + _COLUMNS]
    fft_size, coefficients = kernel[0][0], kernel[1][0]
    square, scale = (math.pi / fft_size) ** 2, fft_size / math.pi
    for j in range(size):
        for k in range(_COLUMNS):
            row[k] = scale * kernel_beside(k - REACH, slot[_NODES + j], coefficients, square)
        for m in range(size):
            factor, start = to_nodes[m, j], _TABLE + m * _COLUMNS
            into = slot[start : start + _COLUMNS]
            for k in range(_COLUMNS):
                into[k] = fma(factor * row[k] if power else factor, row[k], into[k])
    _sources(slot, half, size, len(kernel[1][2]))


@njit(cache=True, error_model="numpy")
def _nodes(slot, half, size, power):
    """Nodes, and the strengths at them of moments of 1."""
    to_nodes = strengths_at_nodes(slot)
    for j in range(size):
        turn = CHEBYSHEV[size, j]
        node = half * turn
        if node == math.floor(node):  # on a bin: moved off it by the last digit
            node += max(3e-16 * abs(node), 1e-30)
        slot[_NODES + j] = node
        sine = sincos_cycles(0.5 * node)[0]
        now = (sine * sine if power else sine) / size
        to_nodes[0, j] = now
        now *= 2.0
        before = now * turn  # T_-1 is T_1
        for m in range(1, size):
            before, now = now, 2.0 * turn * now - before
            to_nodes[m, j] = now


@njit(cache=True, error_model="numpy")
def _sources(slot, half, size, poles):
    """Sources that stand for the nodes seen from afar, and their strengths of moments of 1."""
    number = min(sources_needed(half, size, poles), _MOST_SOURCES)
    slot[1] = number
    to_nodes, to_sources = strengths_at_nodes(slot), strengths_at_sources(slot)
    to_sources[:] = 0.0
    for i in range(number):
        place = CHEBYSHEV[number, i]
        slot[_SOURCES + i] = half * place
        for j in range(size):
            turn = CHEBYSHEV[size, j]
            share = 0.5
            here, before_here, there, before_there = place, 1.0, turn, 1.0
            for _ in range(1, number):
                share += here * there
                here, before_here = 2.0 * place * here - before_here, here
                there, before_there = 2.0 * turn * there - before_there, there
            share *= 2.0 / number
            for m in range(size):
                to_sources[m, i] += to_nodes[m, j] * share


@njit(cache=True, error_model="numpy")
def strengths_at_nodes(slot):
    """Of moments of 1, (moments, nodes); 0 where there are no more."""
    return slot[_TO_NODES:_TABLE].reshape((MOST_MOMENTS, MOST_MOMENTS))


@njit(cache=True, error_model="numpy")
def strengths_at_sources(slot):
    """f_mi, (moments, sources); 0 where there are no more."""
    return slot[_TO_SOURCES:WIDTH].reshape((MOST_MOMENTS, _MOST_SOURCES))


@njit(cache=True, error_model="numpy")
def sources_of(slot):
    """Places of the sources [bins]."""
    return slot[_SOURCES : _SOURCES + int(slot[1])]


@njit(cache=True, error_model="numpy")
def total_strength(re, im, size, power, slot, work):
    """Sum of the magnitudes of the strengths of moments; two rows of scratch."""
    total = 0.0
    for first in range(0, size, COLUMNS):
        combine(re, slot, size, _TO_NODES + first, MOST_MOMENTS, work[0])
        if power:
            for j in range(COLUMNS):
                total += abs(work[0, j])
            continue
        combine(im, slot, size, _TO_NODES + first, MOST_MOMENTS, work[1])
        for j in range(COLUMNS):
            total += math.sqrt(work[0, j] * work[0, j] + work[1, j] * work[1, j])
    return total


@njit(cache=True, error_model="numpy")
def at_sources(moments, size, slot, out):
    """Strengths of moments at the sources, into a row of :data:`COLUMNS` or more."""
    combine(moments, slot, size, _TO_SOURCES, _MOST_SOURCES, out)


@njit(cache=True, error_model="numpy")
def kernels_beside(first, size, image, power, slot, kernel, row, buffer):
    """Rows of g_m of bins first .. first + COLUMNS - 1, for :func:`sweep.model.lanes.combine`.

    Of images, where ``first`` counts from the mirrored middle. ``row`` and ``buffer`` are scratch.

    Returns
    -------
    rows : (n,) float64
    at, stride : int
    """
    start = first + REACH
    within = start >= 0 and start + COLUMNS <= _COLUMNS
    if within and not image:
        return slot, _TABLE + start, _COLUMNS
    out = buffer[: size * COLUMNS].reshape((size, COLUMNS))
    if within:
        for m in range(size):
            from_ = _TABLE + m * _COLUMNS + start
            out[m] = slot[from_ : from_ + COLUMNS]
    else:
        _kernels_anew(first, size, power, slot, kernel, row, out)
    if image:  # about -nu, but with the strength at nu
        for m in range(1 if power else 0, size, 2):
            out[m] *= -1.0
    return buffer, 0, COLUMNS


@njit(cache=True, error_model="numpy")
def _kernels_anew(first, size, power, slot, kernel, row, out):
    """g_m of bins beyond the table's."""
    to_nodes, fft_size, coefficients = strengths_at_nodes(slot), kernel[0][0], kernel[1][0]
    square, scale = (math.pi / fft_size) ** 2, fft_size / math.pi
    out[:] = 0.0
    for j in range(int(slot[0])):
        for k in range(COLUMNS):
            row[k] = scale * kernel_beside(first + k, slot[_NODES + j], coefficients, square)
        for k in range(COLUMNS):
            row[k] *= row[k] if power else 1.0
        for m in range(size):
            for k in range(COLUMNS):
                out[m, k] = fma(to_nodes[m, j], row[k], out[m, k])
