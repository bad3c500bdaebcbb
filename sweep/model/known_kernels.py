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

from sweep.model.compiling import borrowing, owning
from sweep.model.elementary import fma, sincos_cycles
from sweep.model.equivalent import CHEBYSHEV, nodes_for
from sweep.model.far_field import kernel_beside
from sweep.model.kernel_rows import (
    ASIDE,
    BOUND,
    HALF,
    HALVES,
    KEY,
    KNOWN,
    LADDER,
    MOST_MOMENTS,
    NODES,
    NUMBER,
    REACH,
    REACHES,
    SEEN,
    SIZE,
    SUM_IM,
    SUM_RE,
    TABLE,
    TILE,
    TO_NODES,
    WAYS,
    parts_of,
    to_nodes_of,
)
from sweep.model.lanes import COLUMNS, LANES, combine


@borrowing()
def level_for(farthest):
    """Least level of the ladder that holds lines so far from the bin [bins], or -1."""
    for level in range(len(HALVES)):
        if farthest <= HALVES[level]:
            return level
    return -1


@owning()
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
    row = level if alone else LADDER - 1
    if own >= 0:
        row += (1 + segment * WAYS + own % WAYS) * LADDER
    slot = kernel[5][row]
    if slot[HALF] == 0.0:
        slot[REACH] = REACHES[0 if alone else 1]
        _nodes(slot, HALVES[level], power, kernel)
    key = 1.0 if own < 0 else fold * parts[5][segment, own]
    if slot[KEY] != key:
        slot[KEY] = key
        slot[SEEN] = 0.0
        slot[KNOWN:TILE] = 0.0
        _take_parts(slot, segment, own, fold, parts)
    return slot, row


@borrowing()
def _nodes(slot, half, power, kernel):
    """Nodes, and the weights at them of moments of 1."""
    slot[HALF] = half
    band = math.pi * (2.0 if power else 1.0)
    size = min(nodes_for(band * half, 0.0, kernel[3]), MOST_MOMENTS)
    slot[SIZE] = size
    to_nodes = to_nodes_of(slot)
    to_nodes[:] = 0.0
    for j in range(size):
        turn = CHEBYSHEV[size, j]
        slot[NODES + j] = half * turn
        now = 1.0 / size
        to_nodes[0, j] = now
        now *= 2.0
        before = now * turn  # T_-1 is T_1
        for m in range(1, size):
            before, now = now, 2.0 * turn * now - before
            to_nodes[m, j] = now


@borrowing()
def _take_parts(slot, segment, own, fold, parts):
    """Places and strengths u_p of the parts of lines at the nodes."""
    size, number = int(slot[SIZE]), 1
    if own >= 0:
        number = parts[3][segment, own]
    slot[NUMBER] = number
    slot[BOUND:KNOWN] = 0.0
    place, strength_re, strength_im = parts_of(slot)
    aside = 0.0
    for p in range(number):
        apart, re, im = 0.0, 1.0, 0.0
        if own >= 0:
            apart, re = fold * parts[0][segment, own, p], parts[1][segment, own, p]
            im = fold * parts[2][segment, own, p]
        whole = math.hypot(re, im)
        aside = max(aside, abs(apart))
        for j in range(size):
            at = slot[NODES + j] + apart
            if at == math.floor(at):  # on a bin: moved off it by the last digit
                at += max(3e-16 * abs(at), 1e-30)
            sine = sincos_cycles(0.5 * at)[0]
            place[p, j], strength_re[p, j], strength_im[p, j] = at, re * sine, im * sine
            slot[BOUND + j] += whole * abs(sine)
            slot[SUM_RE + j] += re * sine
            slot[SUM_IM + j] += im * sine
    slot[ASIDE] = aside


@borrowing()
def total_strength(re, im, size, power, slot, work):
    """Bound on the sum of the magnitudes of the strengths of moments; two rows of scratch."""
    total = 0.0
    for first in range(0, int(slot[SIZE]), COLUMNS):
        combine(re, slot, size, TO_NODES + first, MOST_MOMENTS, work[0])
        if not power:
            combine(im, slot, size, TO_NODES + first, MOST_MOMENTS, work[1])
        for j in range(COLUMNS):
            bound = slot[BOUND + first + j]
            if power:
                total += abs(work[0, j]) * bound * bound
            else:
                total += math.sqrt(work[0, j] * work[0, j] + work[1, j] * work[1, j]) * bound
    return total


@borrowing()
def kernels_beside(first, power, slot, kernel):
    """Where the rows of g_m of bins first .. first + COLUMNS - 1 are.

    Returns
    -------
    at, imaginary, stride : int
        Of the first row's real and imaginary elements in the slot, and from row to row; real
        kernels have no imaginary ones (:func:`is_real`).
    """
    reach = int(slot[REACH])
    start, kept = first + reach, 2 * reach + COLUMNS
    if start < 0 or start + COLUMNS > kept:
        for step in range(0, COLUMNS, LANES):
            _work_out(first + step, kept + step, power, slot, kernel)
        start = kept
    else:
        for step in range(start // LANES, (start + COLUMNS - 1) // LANES + 1):
            if slot[KNOWN + step] == 0.0:
                slot[KNOWN + step] = 1.0
                _work_out(step * LANES - reach, step * LANES, power, slot, kernel)
    stride = _stride(slot)
    return TABLE + start, TABLE + start + MOST_MOMENTS * stride, stride


@borrowing()
def _stride(slot):
    """Elements from row to row of the table: kept ones, and some for bins beyond the reach."""
    return 2 * int(slot[REACH]) + 2 * COLUMNS + LANES


@borrowing()
def is_real(power, slot):
    """Whether kernels have no imaginary part: those of powers, and of whole lines."""
    return power or slot[KEY] == 1.0


@borrowing()
def _work_out(first, column, power, slot, kernel):
    """g_m of LANES bins from ``first`` on, into columns of the table."""
    to_nodes, real, size = to_nodes_of(slot), is_real(power, slot), int(slot[SIZE])
    re, im = slot[TILE : TILE + LANES], slot[TILE + LANES : TILE + 2 * LANES]
    start, stride = TABLE + column, _stride(slot)
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


@borrowing()
def _at_node(first, j, power, slot, kernel, re, im):
    """A_j, or what stands in its place for powers, in LANES bins."""
    place, strength_re, strength_im = parts_of(slot)
    fft_size, coefficients, edge = kernel[0][0], kernel[1][0], kernel[1][3]
    square, scale = (math.pi / fft_size) ** 2, fft_size / math.pi
    re[:] = 0.0
    im[:] = 0.0
    for p in range(int(slot[NUMBER])):
        at, a, b = place[p, j], scale * strength_re[p, j], scale * strength_im[p, j]
        for k in range(LANES):
            beside = kernel_beside(first + k, at, coefficients, square)
            re[k] = fma(a, beside, re[k])
            im[k] = fma(b, beside, im[k])
    if power:
        c, d = 2.0 * edge * slot[SUM_RE + j], 2.0 * edge * slot[SUM_IM + j]
        for k in range(LANES):
            cross = im[k] * c - re[k] * d
            re[k] = fma(re[k], re[k], fma(im[k], im[k], cross))
