"""Lines whose powers add, each of several parts in phase: one quadratic form for all of them.

A phase error over the record splits line b into parts w_k at nu_b + o_k
(:mod:`sweep.model.effects.line_splitting`). Put as amplitudes a_bj on Chebyshev nodes nu_j that
serve all lines (:mod:`sweep.model.equivalent`), their strengths are s_bj = a_bj sin(pi nu_j), and
bins of lines that have powers c_b (:mod:`sweep.model.far_field`) hold

    sum_b c_b |sum_j s_bj (K_j + i w_0)|^2 = sum_ij G_ij K_i K_j + 2 w_0 sum_j g_j K_j + w_0^2 g

    G_ij = sum_b c_b Re(s_bi s*_bj),   g_j = sum_b c_b Im(s_bj S*_b),   g = sum_b c_b |S_b|^2

with K_j the window's kernel about node j, w_0 its first sample and S_b = sum_j s_bj; images hold
the same about mirrored nodes, with -g_j. This is as smooth a function of the bin as the power of a
line without a phase error, and takes as many kernels as there are nodes, however many lines and
parts there are.
"""

import math

from numba import njit

from sweep.model.elementary import fma, sincos_cycles
from sweep.model.equivalent import dot, nodes_for
from sweep.model.far_field import kernel_beside
from sweep.model.spectrum import fraction

MOST_FORM = 64
"""Nodes at the most; bundles that spread wider are looked at bin by bin."""

WIDTH = 2 * MOST_FORM**2
"""Numbers that a row of scratch must hold: products of nodes, moments of lines."""

LEAST_ERROR = 1e-13
"""Error of amplitudes put on nodes, relative to the sum of all, that is never asked to be less."""

TILE = 32
"""Bins that are done together."""

FORM = 22
"""First of the rows of scratch that hold a form: products, K_j's factors, kernels, what it is of.

The last are w_0^2 g, a bound on the sum of strengths, squared, and the least and largest nu_j.
"""


@njit(cache=True, error_model="numpy")
def power_form(delta, power, n, fold, parts, edge, tolerance, limits, room):
    """The form of n lines, into rows FORM ..; its nodes take the lines' place.

    Parameters
    ----------
    delta, power : (>= n,) float64
        Positions of the lines [bins] and |C_b|^2; the nodes' positions.
    fold : float
        -1 where lines are seen as their images: parts lie on the other side, conjugated.
    parts : tuple of (k,) float64
        Places from the line [bins], real and imaginary weight.
    edge : float
        w_0.
    tolerance : float
        Error of |X|, over that of all lines in phase on the peak.
    limits : (levels, m) float64
        :func:`sweep.model.equivalent.node_limits`.
    room : (>= FORM + 4, >= WIDTH) float64
        Scratch.

    Returns
    -------
    int
        Number of nodes; 0 where more than :data:`MOST_FORM` are needed, or the lines are too many
        for :data:`WIDTH`, and all is as it was.
    """
    place, re, im = parts
    lowest, highest, least, most = delta[0], delta[0], fold * place[0], fold * place[0]
    total, each = 0.0, 0.0
    for b in range(n):
        lowest, highest = min(lowest, delta[b]), max(highest, delta[b])
        total += abs(power[b])
    for k in range(place.size):
        least, most = min(least, fold * place[k]), max(most, fold * place[k])
        each += math.hypot(re[k], im[k])
    lowest, highest = lowest + least, highest + most
    middle, half = 0.5 * (lowest + highest), 0.5 * (highest - lowest)
    size = nodes_for(math.pi * half, max(tolerance / each, LEAST_ERROR), limits)
    if size > MOST_FORM or size * n > WIDTH:
        return 0
    _products(delta, power, n, fold, parts, middle, half, size, room)
    room[FORM + 3, 0] *= edge * edge
    for j in range(size):
        room[FORM + 1, j] *= 2.0 * edge
        delta[j] = room[4, j]
    room[FORM + 3, 1] = total * each * each
    room[FORM + 3, 2], room[FORM + 3, 3] = lowest, highest
    return size


@njit(cache=True, error_model="numpy")
def _products(delta, power, n, fold, parts, middle, half, size, room):
    """G_ij, those beside the diagonal doubled, g_j and g; the nodes' positions into row 4."""
    gram, linear = room[FORM], room[FORM + 1]
    toward, sum_re, sum_im = room[5], room[6, :n], room[7, :n]
    to_nodes = room[FORM + 2, : size * size].reshape((size, size))
    _nodes(middle, half, size, room[4], room[8], to_nodes)
    moment_re = room[11, : size * n].reshape((size, n))
    moment_im = room[12, : size * n].reshape((size, n))
    x, previous, current = room[8, :n], room[9, :n], room[10, :n]
    _moments(delta, n, fold, parts, middle, half, x, previous, current, moment_re, moment_im)
    sum_re[:] = 0.0
    sum_im[:] = 0.0
    for m in range(size):
        toward[m] = 0.0
        for j in range(size):
            toward[m] += to_nodes[m, j]  # S_b of a moment of 1
        for line in range(n):
            sum_re[line] += toward[m] * moment_re[m, line]
            sum_im[line] += toward[m] * moment_im[m, line]
    constant = 0.0
    for line in range(n):
        x[line] = power[line]
        constant += power[line] * (sum_re[line] * sum_re[line] + sum_im[line] * sum_im[line])
    room[FORM + 3, 0] = constant
    for m in range(size):
        one, two = moment_re[m], moment_im[m]
        for line in range(n):
            previous[line], current[line] = x[line] * one[line], x[line] * two[line]
        linear[m] = dot(current, sum_re, n) - dot(previous, sum_im, n)
        for j in range(m + 1):
            value = dot(previous, moment_re[j], n) + dot(current, moment_im[j], n)
            gram[m * size + j] = value
            gram[j * size + m] = value
    _to_nodes(gram, linear, to_nodes, size, room[0], room[1])


@njit(cache=True, error_model="numpy")
def _moments(delta, n, fold, parts, middle, half, x, previous, current, moment_re, moment_im):
    """Chebyshev moments of each line's parts, (moments, lines)."""
    place, re, im = parts
    inverse = 1.0 / half if half > 0.0 else 0.0
    moment_re[:] = 0.0
    moment_im[:] = 0.0
    for k in range(place.size):
        a, b = re[k], fold * im[k]
        for line in range(n):
            x[line] = (delta[line] + fold * place[k] - middle) * inverse
            previous[line], current[line] = 1.0, x[line]
        for m in range(moment_re.shape[0]):
            into_re, into_im = moment_re[m], moment_im[m]
            for line in range(n):
                into_re[line] += a * previous[line]
                into_im[line] += b * previous[line]
                following = 2.0 * x[line] * current[line] - previous[line]
                previous[line], current[line] = current[line], following


@njit(cache=True, error_model="numpy")
def _nodes(middle, half, size, node, turns, to_nodes):
    """Chebyshev nodes, and the strengths (moments, nodes) of moments of 1."""
    for j in range(size):
        turns[j] = sincos_cycles(0.25 * (2 * j + 1) / size)[1]
        node[j] = middle + half * turns[j]
        if node[j] == math.floor(node[j]):  # on a bin: moved off it by the last digit
            node[j] += max(3e-16 * abs(node[j]), 1e-30)
        to_nodes[0, j] = sincos_cycles(0.5 * node[j])[0] / size
    for m in range(1, size):
        for j in range(size):
            before = to_nodes[m - 2, j] if m > 2 else 2.0 * to_nodes[0, j]
            now = turns[j] * (to_nodes[m - 1, j] if m > 1 else to_nodes[0, j])
            to_nodes[m, j] = 2.0 * now - (before if m > 1 else 0.0)


@njit(cache=True, error_model="numpy")
def _to_nodes(gram, linear, to_nodes, size, rows, total):
    """G and g_j from those of moments; what lies beside the diagonal doubled and put below it."""
    for m in range(size):  # rows of G T
        rows[:size] = 0.0
        for k in range(size):
            factor = gram[m * size + k]
            for j in range(size):
                rows[j] += factor * to_nodes[k, j]
        gram[m * size : m * size + size] = rows[:size]
    rows[:size] = 0.0
    for m in range(size):
        for j in range(size):
            rows[j] += linear[m] * to_nodes[m, j]
    linear[:size] = rows[:size]
    total[: size * size] = gram[: size * size]
    gram[: size * size] = 0.0
    for m in range(size):  # T^t (G T), half of it
        for i in range(size):
            factor = to_nodes[m, i] * 2.0
            for j in range(i + 1):
                gram[i * size + j] += factor * total[m * size + j]
    for i in range(size):
        gram[i * size + i] *= 0.5


@njit(cache=True, error_model="numpy")
def add_form_afar(t, tangents, size, numerator, poles, side, room, out):
    """Adds the form at points where t is tan(pi q / N), but for its constant.

    ``tangents`` are those of the nodes' places; ``side`` is -1 for images.
    """
    kernels = room[FORM + 2, : size * TILE].reshape((size, TILE))
    for start in range(0, t.size, TILE):
        at = t[start : start + TILE]
        for j in range(size):
            for i in range(at.size):
                kernels[j, i] = fraction(at[i], tangents[j], numerator, poles)
        _add(kernels, size, side, room, out[start : start + TILE])


@njit(cache=True, error_model="numpy")
def add_form_beside(first, nodes, size, fft_size, coefficients, side, room, out):
    """Adds the form to bins first, first + 1 .. next to the nodes, likewise."""
    kernels = room[FORM + 2, : size * TILE].reshape((size, TILE))
    square, scale = (math.pi / fft_size) ** 2, fft_size / math.pi
    for start in range(0, out.size, TILE):
        part = out[start : start + TILE]
        for j in range(size):
            for i in range(part.size):
                kernel = kernel_beside(first + start + i, nodes[j], coefficients, square)
                kernels[j, i] = scale * kernel
        _add(kernels, size, side, room, part)


@njit(cache=True, error_model="numpy")
def _add(kernels, size, side, room, out):
    """Adds sum_i K_i (sum_j<=i G_ij K_j + g_i) to bins."""
    gram, linear, count = room[FORM], room[FORM + 1], out.size
    inner = room[FORM + 3, 8 : 8 + TILE]
    for i in range(size):
        for k in range(count):
            inner[k] = side * linear[i]
        for j in range(i + 1):
            factor = gram[i * size + j]
            for k in range(count):
                inner[k] = fma(factor, kernels[j, k], inner[k])
        for k in range(count):
            out[k] = fma(inner[k], kernels[i, k], out[k])
