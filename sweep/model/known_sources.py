"""Bundles seen from afar: the few sources, or the form of sources, that moments stand for there.

The other half of :mod:`sweep.model.known_kernels`: sum_m M_m f_mi are the strengths of sources at
Chebyshev nodes over the lines and their parts; of powers of lines in parts every coefficient of a
form is such a sum.
"""

from sweep.model.compiling import borrowing, owning
from sweep.model.elementary import fma
from sweep.model.equivalent import CHEBYSHEV
from sweep.model.far_field import sources_needed
from sweep.model.kernel_rows import (
    ASIDE,
    AT_NODES,
    COEFFICIENTS,
    FAR,
    FORM_WIDTH,
    HALF,
    KEY,
    MOST_MOMENTS,
    MOST_SOURCES,
    NUMBER,
    PLACES,
    SEEN,
    SIZE,
    SOURCES,
    SUM_IM,
    SUM_RE,
    TILE,
    TO_NODES,
    parts_of,
    to_nodes_of,
)
from sweep.model.lanes import COLUMNS, LANES, combine


@owning()
def sources_of(power, slot, kernel):
    """Places of the sources [bins] that moments are seen as from afar."""
    if slot[SEEN] == 0.0:
        slot[SEEN] = 1.0
        _see_from_afar(power, slot, kernel)
    return slot[SOURCES : SOURCES + int(slot[PLACES])]


@owning()
def _see_from_afar(power, slot, kernel):
    half, size = slot[HALF] + slot[ASIDE], int(slot[SIZE])
    number = min(sources_needed(half, MOST_MOMENTS, len(kernel[1][2])), MOST_SOURCES)
    slot[PLACES] = number
    for i in range(number):
        slot[SOURCES + i] = half * CHEBYSHEV[number, i]
    seen = slot[AT_NODES:SOURCES].reshape((2, MOST_MOMENTS, MOST_SOURCES))
    seen[:] = 0.0
    for j in range(size):
        _node_from_afar(j, number, half, slot, seen[0, j], seen[1, j])
    stride = _far_stride(power, slot)
    far = slot[FAR : FAR + MOST_MOMENTS * stride].reshape((MOST_MOMENTS, stride))
    far[:size] = 0.0
    row, to_nodes = slot[COEFFICIENTS:TO_NODES], to_nodes_of(slot)
    for j in range(size):
        width = _coefficients(power, j, number, kernel[1][3], slot, seen[0, j], seen[1, j], row)
        for m in range(size):
            factor, into = to_nodes[m, j], far[m]
            for k in range(width):
                into[k] = fma(factor, row[k], into[k])


@borrowing()
def _node_from_afar(j, number, half, slot, re, im):
    """Strengths of the sources that a line at a node is seen as: its parts, interpolated."""
    place, strength_re, strength_im = parts_of(slot)
    before, now = slot[TILE : TILE + COLUMNS], slot[TILE + COLUMNS : TILE + 2 * COLUMNS]
    share = slot[TILE + 2 * COLUMNS : TILE + 3 * COLUMNS]
    for p in range(int(slot[NUMBER])):
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


@borrowing()
def _coefficients(power, j, number, edge, slot, re, im, out):
    """What a line at a node adds to what is seen from afar; how many numbers that is.

    Real and imaginary strengths of the sources, of powers those of their squared kernels; where
    lines have parts the form: products of two sources, those of different ones doubled, what goes
    with each kernel by itself, and what with none.
    """
    sum_re, sum_im = slot[SUM_RE + j], slot[SUM_IM + j]
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


@borrowing()
def _is_form(power, slot):
    return power and slot[KEY] != 1.0


@borrowing()
def _far_stride(power, slot):
    """Elements from moment to moment of what is seen from afar."""
    return FORM_WIDTH if _is_form(power, slot) else 2 * MOST_SOURCES + LANES


@borrowing()
def strengths_afar(power, slot):
    """Where the sources' strengths of moments of 1 are.

    As of :func:`sweep.model.known_kernels.kernels_beside`.
    """
    return FAR, FAR + MOST_SOURCES, _far_stride(power, slot)


@borrowing()
def form_of(moments, size, number, whole, slot, out):
    """The form of moments; into ``out``, up to FORM_WIDTH numbers; the place of the last of them.

    That is the constant, which is all that is sure to be there if not the ``whole`` is asked for.
    """
    last = number * (number + 1) // 2 + number
    for first in range(0 if whole else last // COLUMNS * COLUMNS, last + 1, COLUMNS):
        combine(moments, slot, size, FAR + first, FORM_WIDTH, out[first:])
    return last
