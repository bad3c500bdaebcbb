"""Lines around a bin as moments, whose kernels in the bins next to it are worked out once.

A phase error over the record makes a line at nu several: parts w_p at nu + o_p
(:mod:`sweep.model.effects.line_splitting`); without one there is one part, 1 at 0. With K and w_0,
the window's first sample (:mod:`sweep.model.far_field`), a line of C = 1 holds in bin q, but for a
sign,

    A(q) + i w_0 S,   A(q) = sum_p u_p K(q - nu - o_p),   S = sum_p u_p,
    u_p = w_p sin(pi (nu + o_p))

or, where lines add as powers, the |.|^2 of that. As a function of nu within +-h of a bin either is
a series of Chebyshev polynomials (:mod:`sweep.model.equivalent`), so that lines C_b hold

    sum_m M_m g_m[q],   M_m = sum_b C_b T_m(nu_b / h)
    g_m[q] = (2 - [m = 0]) / J sum_j T_m(x_j) A_j(q)

with J Chebyshev nodes x_j; for powers |C_b|^2, and |A_j|^2 + 2 w_0 Im(A_j S_j*) in A's place. What
w_0 adds is the same in every bin, and is left to the far field. Spectra of real records are even:
images hold in bin q the conjugate of what the lines hold in -q.

Seen from afar sum_m M_m f_mi are the strengths of few sources at other nodes; powers of lines in
parts are forms of their kernels, of which each coefficient is a sum over the moments. The widths h
are on a ladder. Everything is worked out when it is first asked for, to the last digit, and kept in
a row of scratch for all lines with the same parts; fewer moments serve a looser tolerance.
"""

import math

import numpy as np
from numba import njit

from sweep.model.elementary import fma, sincos_cycles
from sweep.model.equivalent import CHEBYSHEV, nodes_for
from sweep.model.far_field import kernel_beside, sources_needed
from sweep.model.lanes import COLUMNS, LANES, combine

HALVES = tuple(0.6 * 1.35**level for level in range(10))
"""Half widths h of bundles [bins]."""

MOST_MOMENTS = 64

MOST_PARTS = 64

REACHES = 32, 256
"""Bins on either side of the middle in which kernels are kept: of one bundle, of several."""

MOST_SOURCES = COLUMNS

FORM_WIDTH = -(-(MOST_SOURCES * (MOST_SOURCES + 3) // 2 + 1) // COLUMNS) * COLUMNS + LANES
"""Numbers of a form, at the most: whole vectors.

And one more, as in rows of kernels: rows as long as a power of two would share few places of the
processor's cache.
"""

_KEY, _HALF, _SIZE, _NUMBER, _ASIDE, _EACH, _SEEN, _PLACES, _REACH = range(
    9
)  # of the row's numbers
_NODES = 16
_BOUND = _NODES + MOST_MOMENTS
_SUM_RE = _BOUND + MOST_MOMENTS
_SUM_IM = _SUM_RE + MOST_MOMENTS
_KNOWN = _SUM_IM + MOST_MOMENTS
_TILE = _KNOWN + 2 * REACHES[1] // LANES + COLUMNS
_COEFFICIENTS = _TILE + 3 * COLUMNS
_TO_NODES = _COEFFICIENTS + FORM_WIDTH
_PARTS = _TO_NODES + MOST_MOMENTS**2
_AT_NODES = _PARTS + 3 * MOST_PARTS * MOST_MOMENTS
_SOURCES = _AT_NODES + 2 * MOST_MOMENTS * MOST_SOURCES
_FAR = _SOURCES + MOST_SOURCES
_TABLE = _FAR + MOST_MOMENTS * FORM_WIDTH

WIDTH = _TABLE + 2 * MOST_MOMENTS * (2 * REACHES[1] + 2 * COLUMNS + LANES)
"""Numbers that a row of scratch must hold."""

_LADDER = len(HALVES) + 1

ROWS = 4 * _LADDER
"""Rows of scratch, for each width and for bundles side by side: of whole lines, and of lines in
parts for each segment."""


def unknown_kernels() -> np.ndarray:
    """Scratch in which nothing is known of any kernel yet, (ROWS, WIDTH)."""
    rows = np.empty((ROWS, WIDTH))
    rows[:, [_KEY, _HALF]] = 0.0
    return rows


@njit(cache=True, error_model="numpy")
def level_for(farthest):
    """Least level of the ladder that holds lines so far from the bin [bins], or -1."""
    for level in range(len(HALVES)):
        if farthest <= HALVES[level]:
            return level
    return -1


@njit(cache=True, error_model="numpy")
def slot_for(segment, own, fold, width, power, parts, kernel):
    """Row of scratch for lines of a level and their parts, and its number.

    Parameters
    ----------
    segment, own : int
        Where in ``parts`` the lines' are; -1 for whole lines.
    fold : float
        -1 where lines are seen as their images: parts lie on the other side, conjugated.
    width : (int, bool)
        Half width's place in :data:`HALVES`; whether the bundle is by itself.
    power : bool
        Whether lines add as powers.
    parts : tuple
        Of :class:`sweep.model.modulation.Stretch`; at most :data:`MOST_PARTS`.
    kernel : tuple
        :meth:`sweep.model.preparation.Shots.kernel`.
    """
    level, alone = width
    row = level if alone else _LADDER - 1
    if own >= 0:
        row += (segment + 1) * _LADDER
    slot = kernel[5][row]
    if slot[_HALF] == 0.0:
        slot[_REACH] = REACHES[0 if alone else 1]
        _nodes(slot, HALVES[level], power, kernel)
    key = 1.0 if own < 0 else 2.0 * (own + 1) + (1.0 if fold < 0.0 else 0.0)
    if slot[_KEY] != key:
        slot[_KEY] = key
        slot[_SEEN] = 0.0
        slot[_KNOWN:_TILE] = 0.0
        _take_parts(slot, segment, own, fold, parts)
    return slot, row


@njit(cache=True, error_model="numpy")
def _nodes(slot, half, power, kernel):
    """Nodes, and the weights at them of moments of 1."""
    slot[_HALF] = half
    band = math.pi * (2.0 if power else 1.0)
    size = min(nodes_for(band * half, 0.0, kernel[3]), MOST_MOMENTS)
    slot[_SIZE] = size
    to_nodes = _to_nodes(slot)
    to_nodes[:] = 0.0
    for j in range(size):
        turn = CHEBYSHEV[size, j]
        slot[_NODES + j] = half * turn
        now = 1.0 / size
        to_nodes[0, j] = now
        now *= 2.0
        before = now * turn  # T_-1 is T_1
        for m in range(1, size):
            before, now = now, 2.0 * turn * now - before
            to_nodes[m, j] = now


@njit(cache=True, error_model="numpy")
def _take_parts(slot, segment, own, fold, parts):
    """Places and strengths u_p of the parts of lines at the nodes."""
    size, number = int(slot[_SIZE]), 1
    if own >= 0:
        number = parts[3][segment, own]
    slot[_NUMBER] = number
    slot[_BOUND:_KNOWN] = 0.0
    place, strength_re, strength_im = _parts_of(slot)
    aside, each = 0.0, 0.0
    for p in range(number):
        apart, re, im = 0.0, 1.0, 0.0
        if own >= 0:
            apart, re = fold * parts[0][segment, own, p], parts[1][segment, own, p]
            im = fold * parts[2][segment, own, p]
        whole = math.hypot(re, im)
        aside, each = max(aside, abs(apart)), each + whole
        for j in range(size):
            at = slot[_NODES + j] + apart
            if at == math.floor(at):  # on a bin: moved off it by the last digit
                at += max(3e-16 * abs(at), 1e-30)
            sine = sincos_cycles(0.5 * at)[0]
            place[p, j], strength_re[p, j], strength_im[p, j] = at, re * sine, im * sine
            slot[_BOUND + j] += whole * abs(sine)
            slot[_SUM_RE + j] += re * sine
            slot[_SUM_IM + j] += im * sine
    slot[_ASIDE], slot[_EACH] = aside, each


@njit(cache=True, error_model="numpy")
def _to_nodes(slot):
    """Of moments of 1, (moments, nodes); 0 where there are no more."""
    return slot[_TO_NODES:_PARTS].reshape((MOST_MOMENTS, MOST_MOMENTS))


@njit(cache=True, error_model="numpy")
def _parts_of(slot):
    """Places, real and imaginary strengths, (parts, nodes) each."""
    of_all = slot[_PARTS:_AT_NODES].reshape((3, MOST_PARTS, MOST_MOMENTS))
    return of_all[0], of_all[1], of_all[2]


@njit(cache=True, error_model="numpy")
def width_of(slot):
    """Half width of lines and their parts [bins]; sum of the parts' magnitudes."""
    return slot[_HALF] + slot[_ASIDE], slot[_EACH]


@njit(cache=True, error_model="numpy")
def total_strength(re, im, size, power, slot, work):
    """Bound on the sum of the magnitudes of the strengths of moments; two rows of scratch."""
    total = 0.0
    for first in range(0, int(slot[_SIZE]), COLUMNS):
        combine(re, slot, size, _TO_NODES + first, MOST_MOMENTS, work[0])
        if not power:
            combine(im, slot, size, _TO_NODES + first, MOST_MOMENTS, work[1])
        for j in range(COLUMNS):
            bound = slot[_BOUND + first + j]
            if power:
                total += abs(work[0, j]) * bound * bound
            else:
                total += math.sqrt(work[0, j] * work[0, j] + work[1, j] * work[1, j]) * bound
    return total


@njit(cache=True, error_model="numpy")
def kernels_beside(first, power, slot, kernel):
    """Where the rows of g_m of bins first .. first + COLUMNS - 1 are.

    Returns
    -------
    at, imaginary, stride : int
        Of the first row's real and imaginary elements in the slot, and from row to row; real
        kernels have no imaginary ones (:func:`is_real`).
    """
    reach = int(slot[_REACH])
    start, kept = first + reach, 2 * reach + COLUMNS
    if start < 0 or start + COLUMNS > kept:
        for step in range(0, COLUMNS, LANES):
            _work_out(first + step, kept + step, power, slot, kernel)
        start = kept
    else:
        for step in range(start // LANES, (start + COLUMNS - 1) // LANES + 1):
            if slot[_KNOWN + step] == 0.0:
                slot[_KNOWN + step] = 1.0
                _work_out(step * LANES - reach, step * LANES, power, slot, kernel)
    stride = _stride(slot)
    return _TABLE + start, _TABLE + start + MOST_MOMENTS * stride, stride


@njit(cache=True, error_model="numpy")
def _stride(slot):
    """Elements from row to row of the table: kept ones, and some for bins beyond the reach."""
    return 2 * int(slot[_REACH]) + 2 * COLUMNS + LANES


@njit(cache=True, error_model="numpy")
def is_real(power, slot):
    """Whether kernels have no imaginary part: those of powers, and of whole lines."""
    return power or slot[_KEY] == 1.0


@njit(cache=True, error_model="numpy")
def _work_out(first, column, power, slot, kernel):
    """g_m of LANES bins from ``first`` on, into columns of the table."""
    to_nodes, real, size = _to_nodes(slot), is_real(power, slot), int(slot[_SIZE])
    re, im = slot[_TILE : _TILE + LANES], slot[_TILE + LANES : _TILE + 2 * LANES]
    start, stride = _TABLE + column, _stride(slot)
    imaginary = MOST_MOMENTS * stride
    for m in range(size):
        at = start + m * stride
        slot[at : at + LANES] = 0.0
        if not real:
            slot[at + imaginary : at + imaginary + LANES] = 0.0
    for j in range(size):
        _at_node(first, j, power, slot, kernel, re, im)
        for m in range(size):
            at, factor = start + m * stride, to_nodes[m, j]
            into = slot[at : at + LANES]
            for k in range(LANES):
                into[k] = fma(factor, re[k], into[k])
            if not real:
                into = slot[at + imaginary : at + imaginary + LANES]
                for k in range(LANES):
                    into[k] = fma(factor, im[k], into[k])


@njit(cache=True, error_model="numpy")
def _at_node(first, j, power, slot, kernel, re, im):
    """A_j, or what stands in its place for powers, in LANES bins."""
    place, strength_re, strength_im = _parts_of(slot)
    fft_size, coefficients, edge = kernel[0][0], kernel[1][0], kernel[1][3]
    square, scale = (math.pi / fft_size) ** 2, fft_size / math.pi
    re[:] = 0.0
    im[:] = 0.0
    for p in range(int(slot[_NUMBER])):
        at, a, b = place[p, j], scale * strength_re[p, j], scale * strength_im[p, j]
        for k in range(LANES):
            beside = kernel_beside(first + k, at, coefficients, square)
            re[k] = fma(a, beside, re[k])
            im[k] = fma(b, beside, im[k])
    if power:
        c, d = 2.0 * edge * slot[_SUM_RE + j], 2.0 * edge * slot[_SUM_IM + j]
        for k in range(LANES):
            cross = im[k] * c - re[k] * d
            re[k] = fma(re[k], re[k], fma(im[k], im[k], cross))


@njit(cache=True, error_model="numpy")
def sources_of(power, slot, kernel):
    """Places of the sources [bins] that moments are seen as from afar."""
    if slot[_SEEN] == 0.0:
        slot[_SEEN] = 1.0
        _see_from_afar(power, slot, kernel)
    return slot[_SOURCES : _SOURCES + int(slot[_PLACES])]


@njit(cache=True, error_model="numpy")
def _see_from_afar(power, slot, kernel):
    half, size = slot[_HALF] + slot[_ASIDE], int(slot[_SIZE])
    number = min(sources_needed(half, MOST_MOMENTS, len(kernel[1][2])), MOST_SOURCES)
    slot[_PLACES] = number
    for i in range(number):
        slot[_SOURCES + i] = half * CHEBYSHEV[number, i]
    seen = slot[_AT_NODES:_SOURCES].reshape((2, MOST_MOMENTS, MOST_SOURCES))
    seen[:] = 0.0
    for j in range(size):
        _node_from_afar(j, number, half, slot, seen[0, j], seen[1, j])
    stride = _far_stride(power, slot)
    far = slot[_FAR : _FAR + MOST_MOMENTS * stride].reshape((MOST_MOMENTS, stride))
    far[:size] = 0.0
    row, to_nodes = slot[_COEFFICIENTS:_TO_NODES], _to_nodes(slot)
    for j in range(size):
        width = _coefficients(power, j, number, kernel[1][3], slot, seen[0, j], seen[1, j], row)
        for m in range(size):
            factor, into = to_nodes[m, j], far[m]
            for k in range(width):
                into[k] = fma(factor, row[k], into[k])


@njit(cache=True, error_model="numpy")
def _node_from_afar(j, number, half, slot, re, im):
    """Strengths of the sources that a line at a node is seen as: its parts, interpolated."""
    place, strength_re, strength_im = _parts_of(slot)
    before, now = slot[_TILE : _TILE + COLUMNS], slot[_TILE + COLUMNS : _TILE + 2 * COLUMNS]
    share = slot[_TILE + 2 * COLUMNS : _TILE + 3 * COLUMNS]
    for p in range(int(slot[_NUMBER])):
        x = place[p, j] / half
        there, before_there = x, 1.0
        for i in range(number):
            before[i], now[i], share[i] = 1.0, CHEBYSHEV[number, i], 0.5
        for _ in range(1, number):
            for i in range(number):
                share[i] = fma(there, now[i], share[i])
                after = 2.0 * CHEBYSHEV[number, i] * now[i] - before[i]
                before[i], now[i] = now[i], after
            there, before_there = 2.0 * x * there - before_there, there
        a, b = 2.0 / number * strength_re[p, j], 2.0 / number * strength_im[p, j]
        for i in range(number):
            re[i] = fma(a, share[i], re[i])
            im[i] = fma(b, share[i], im[i])


@njit(cache=True, error_model="numpy")
def _coefficients(power, j, number, edge, slot, re, im, out):
    """What a line at a node adds to what is seen from afar; how many numbers that is.

    Real and imaginary strengths of the sources, of powers those of their squared kernels; where
    lines have parts the form: products of two sources, those of different ones doubled, what goes
    with each kernel by itself, and what with none.
    """
    sum_re, sum_im = slot[_SUM_RE + j], slot[_SUM_IM + j]
    if not _is_form(power, slot):
        for i in range(number):
            out[i], out[MOST_SOURCES + i] = re[i] * (sum_re if power else 1.0), im[i]
        return 2 * MOST_SOURCES
    k = 0
    for i in range(number):
        for other in range(i + 1):
            both = re[i] * re[other] + im[i] * im[other]
            out[k] = both if i == other else 2.0 * both
            k += 1
    for i in range(number):
        out[k] = 2.0 * edge * (im[i] * sum_re - re[i] * sum_im)
        k += 1
    out[k] = edge * edge * (sum_re * sum_re + sum_im * sum_im)
    return k + 1


@njit(cache=True, error_model="numpy")
def _is_form(power, slot):
    return power and slot[_KEY] != 1.0


@njit(cache=True, error_model="numpy")
def _far_stride(power, slot):
    """Elements from moment to moment of what is seen from afar."""
    return FORM_WIDTH if _is_form(power, slot) else 2 * MOST_SOURCES + LANES


@njit(cache=True, error_model="numpy")
def at_sources(moments, size, power, slot, imaginary, out):
    """Strengths at the sources of moments, or their imaginary parts; into COLUMNS numbers."""
    first = _FAR + (MOST_SOURCES if imaginary else 0)
    combine(moments, slot, size, first, _far_stride(power, slot), out)


@njit(cache=True, error_model="numpy")
def form_of(moments, size, number, slot, out):
    """The form of moments; into ``out``, up to FORM_WIDTH numbers, the constant last."""
    width = number * (number + 1) // 2 + number + 1
    for first in range(0, width, COLUMNS):
        combine(moments, slot, size, _FAR + first, FORM_WIDTH, out[first:])
