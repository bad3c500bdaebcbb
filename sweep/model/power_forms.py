"""Lines whose powers add, each of several parts in phase: one quadratic form for all of them.

A phase error over the record splits line b into parts w_k at nu_b + o_k
(:mod:`sweep.model.effects.line_splitting`). Taken as moments mu_bm with known kernels g_m
(:mod:`sweep.model.known_kernels`), bins of lines that have powers c_b hold

    sum_b c_b |sum_m mu_bm g_m + i w_0 S_b|^2 = sum_mn G_mn g_m g_n + 2 w_0 sum_m g'_m g_m + w_0^2 g

    G_mn = sum_b c_b Re(mu_bm mu*_bn),   g'_m = sum_b c_b Im(mu_bm S*_b),   g = sum_b c_b |S_b|^2

with w_0 the window's first sample and S_b the sum of the line's strengths; images hold the same
about mirrored places, with -g'_m. Far from the lines it is the same with sources in the moments'
place (:mod:`sweep.model.far_field`). This is as smooth a function of the bin as the power of a
line without a phase error, and takes as many kernels as there are moments or sources, however many
lines and parts there are.
"""

import math

from numba import njit

from sweep.model.elementary import fma
from sweep.model.equivalent import nodes_for
from sweep.model.known_kernels import (
    HALVES,
    MOST_MOMENTS,
    known,
    level_for,
    sources_of,
    strengths_at_nodes,
    strengths_at_sources,
)
from sweep.model.lanes import COLUMNS, combine, dot
from sweep.model.spectrum import fraction

WIDTH = 8192
"""Numbers that a row of scratch must hold: products of moments, moments of lines."""

LEAST_ERROR = 1e-13
"""Error of amplitudes taken as moments, relative to the sum of all, that is the least asked for."""

FORM = 22
"""First of the rows of scratch that hold a form.

Products G_mn and g'_m of moments; kernels; w_0^2 g, a bound on the sum of strengths, squared, and
the number of moments; products and g'_i of sources.
"""

FAR = FORM + 4
"""First of the two rows of these."""


@njit(cache=True, error_model="numpy")
def power_form(delta, power, n, fold, parts, edge, tolerance, kernel, slots, room):
    """The form of n lines, into rows FORM ..; the places of its sources take the lines' place.

    Parameters
    ----------
    delta, power : (>= n,) float64
        Positions of the lines [bins] and |C_b|^2; the sources' positions.
    fold : float
        -1 where lines are seen as their images: parts lie on the other side, conjugated.
    parts : tuple of (k,) float64
        Places from the line [bins], real and imaginary weight.
    edge : float
        w_0.
    tolerance : float
        Error of |X|, over that of all lines in phase on the peak.
    kernel : tuple
        :meth:`sweep.model.preparation.Shots.kernel`.
    slots : (levels, >= WIDTH) float64
        Rows of :mod:`sweep.model.known_kernels`.
    room : (>= FAR + 2, >= WIDTH) float64
        Scratch.

    Returns
    -------
    sources, level : int
        Their number; 0 where the lines are too many or too wide apart, and all is as it was. Which
        of the slots the form is made with.
    """
    place, re, im = parts
    farthest, aside, total, each = 0.0, 0.0, 0.0, 0.0
    for b in range(n):
        farthest = max(farthest, abs(delta[b]))
        total += abs(power[b])
    for k in range(place.size):
        aside = max(aside, abs(place[k]))
        each += math.hypot(re[k], im[k])
    level = level_for(farthest + aside)
    if level < 0:
        return 0, -1
    half = HALVES[level]
    size = nodes_for(math.pi * half, max(tolerance / each, LEAST_ERROR), kernel[3])
    if size > MOST_MOMENTS or (size + 1) * 2 * n > WIDTH:
        return 0, -1
    slot = slots[level]
    known(slot, half, False, kernel)
    _products(delta, power, n, fold, parts, half, size, slot, room)
    for m in range(size):
        room[FORM + 1, m] *= 2.0 * edge
    sources = sources_of(slot)
    for i in range(sources.size):
        room[FAR + 1, i] *= 2.0 * edge
        delta[i] = sources[i]
    room[FORM + 3, 0] *= edge * edge
    room[FORM + 3, 1], room[FORM + 3, 2] = total * each * each, size
    return sources.size, level


@njit(cache=True, error_model="numpy")
def _products(delta, power, n, fold, parts, half, size, slot, room):
    """G and g_m of moments, and of sources; g."""
    both = 2 * n
    moments = room[11, : size * both].reshape((size, both))
    _moments(delta, n, fold, parts, half, room[8, :both], room[9, :both], room[10, :both], moments)
    weight, sums, turned = room[5, :both], room[6, :both], room[7, :both]
    to_nodes = strengths_at_nodes(slot)
    sums[:] = 0.0
    for m in range(size):
        toward = 0.0
        for j in range(int(slot[0])):
            toward += to_nodes[m, j]  # S_b of a moment of 1
        for b in range(both):
            sums[b] = fma(toward, moments[m, b], sums[b])
    for b in range(n):
        weight[b], weight[n + b] = power[b], power[b]
        turned[b], turned[n + b] = -power[b] * sums[n + b], power[b] * sums[b]
    scaled = room[8, :both]
    for b in range(both):
        scaled[b] = weight[b] * sums[b]
    room[FORM + 3, 0] = dot(scaled, sums, both)
    _gram(moments, size, both, weight, turned, scaled, room[FORM], room[FORM + 1])
    to_sources = strengths_at_sources(slot)
    number = int(slot[1])
    at_sources = room[12, : number * both].reshape((number, both))
    at_sources[:] = 0.0
    for i in range(number):
        for m in range(size):
            factor = to_sources[m, i]
            for b in range(both):
                at_sources[i, b] = fma(factor, moments[m, b], at_sources[i, b])
    _gram(at_sources, number, both, weight, turned, scaled, room[FAR], room[FAR + 1])


@njit(cache=True, error_model="numpy")
def _moments(delta, n, fold, parts, half, x, even, odd, moments):
    """Chebyshev moments of each line's parts, (moments, 2 lines): real, then imaginary ones."""
    place, re, im = parts
    moments[:] = 0.0
    for k in range(place.size):
        a, b, apart = re[k], fold * im[k], fold * place[k]
        for line in range(n):
            x[line] = (delta[line] + apart) / half
            even[line], odd[line] = 1.0, x[line]
        for m in range(0, moments.shape[0], 2):
            into = moments[m]
            for line in range(n):
                into[line] = fma(a, even[line], into[line])
                into[n + line] = fma(b, even[line], into[n + line])
            if m + 1 < moments.shape[0]:
                into = moments[m + 1]
                for line in range(n):
                    into[line] = fma(a, odd[line], into[line])
                    into[n + line] = fma(b, odd[line], into[n + line])
            for line in range(n):
                twice = 2.0 * x[line]
                even[line] = fma(twice, odd[line], -even[line])
                odd[line] = fma(twice, even[line], -odd[line])


@njit(cache=True, error_model="numpy")
def _gram(rows, size, both, weight, turned, scaled, gram, linear):
    """Products of rows, those beside the diagonal doubled and put below it; g of each."""
    for m in range(size):
        linear[m] = dot(rows[m], turned, both)
        for b in range(both):
            scaled[b] = 2.0 * weight[b] * rows[m, b]
        for j in range(m):
            gram[m * size + j] = dot(scaled, rows[j], both)
        gram[m * size + m] = 0.5 * dot(scaled, rows[m], both)


@njit(cache=True, error_model="numpy")
def add_form_afar(t, tangents, size, numerator, poles, side, room, out):
    """Adds the form of sources at points where t is tan(pi q / N), but for its constant.

    ``tangents`` are those of the sources' places; ``side`` is -1 for images.
    """
    buffer, sums = room[FORM + 2], room[FORM + 3, 8 : 8 + COLUMNS]
    for start in range(0, t.size, COLUMNS):
        at = t[start : start + COLUMNS]
        for j in range(size):
            row = buffer[j * COLUMNS : j * COLUMNS + at.size]
            for i in range(at.size):
                row[i] = fraction(at[i], tangents[j], numerator, poles)
        form_of(buffer, 0, COLUMNS, size, side, FAR, room, sums)
        for i in range(at.size):
            out[start + i] += sums[i]


@njit(cache=True, error_model="numpy")
def form_of(rows, at, stride, size, side, which, room, out):
    """Sum g_m (sum_n<=m G_mn g_n + g'_m) of rows of g as of :func:`sweep.model.lanes.combine`.

    ``which`` is FORM or FAR; COLUMNS elements of ``out`` are the result.
    """
    gram, linear = room[which], room[which + 1]
    inner = room[FORM + 3, 8 + COLUMNS : 8 + 2 * COLUMNS]
    out[:COLUMNS] = 0.0
    for i in range(size):
        combine(gram[i * size : i * size + i + 1], rows, i + 1, at, stride, inner)
        start = at + i * stride
        own, constant = rows[start : start + COLUMNS], side * linear[i]
        for k in range(COLUMNS):
            out[k] = fma(inner[k] + constant, own[k], out[k])
