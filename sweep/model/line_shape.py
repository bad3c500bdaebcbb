"""The line shape of a record: what one line shows in the bins around it.

All lines of a segment share the window and what befalls the record, a phase error psi(t), so they
share one shape. With x = -1 .. 1 over the record of L samples, r = L/N, and y bins of fs/N,

    G(y) = sum_n w(x_n) exp(2 pi i psi(x_n)) exp(-i pi r y x_n)

whose phase counts from the middle of the record. G is kept in three forms:

- **A table** of G, or of |G|^2 where lines add as powers, at every 1/16 (1/32) bin out to some
  bins on either side. Ten values beside each other make any other, to 1e-12 of the peak.
- **Beyond the table** by the record's two ends alone. With c = cot(pi y / N),

      G(y) = e^{i pi r y} A(c) - e^{-i pi r y} B(c)

  where A and B are polynomials made of the derivatives of w exp(2 pi i psi) at either end, because
  sum_n n^j e^{-i theta n} is a polynomial in cot(theta / 2).
- **An envelope**: the most that |G| comes to at any distance from there on.

A phase error is taken apart into a shift of the line, by its mean slope, and few Chebyshev modes:
exp(2 pi i psi) = sum_j a_j T_j(x). All of the above is linear in a_j, so each shape is a sum over
modes of tables that are made once for a window. Phases that need too many modes, windows that are
no sum of cosines, and short or much padded records have a table of all bins, by one FFT.
"""

import math
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit

from sweep.model.elementary import sincos_cycles
from sweep.model.window import COSINE_SUMS, Window, samples

CELLS = (16, 32)
"""Cells of the table in a bin of fs/N, for amplitudes and for powers."""

TIERS = ((24, 24), (48, 56), (128, 200))
"""Modes at the most, and bins of fs/L on either side that the table then holds."""

DERIVATIVES = 12
"""Derivatives at the record's ends."""

MODES_ERROR = 1e-13
"""Size below which modes are left out, relative to the record."""

_SHORTEST, _MOST_PADDED = 4096, 8
"""Samples of a record, and its padding N/L, between which sums over it are integrals."""

_FAR = 48
"""Distances at which the envelope is known beyond the table."""

_MARGIN = 1.1
"""On the envelope, which is looked at every quarter of a bin."""


class Shapes(NamedTuple):
    """Line shapes of one window and FFT, as the compiled code takes them; see `segments`."""

    sizes: np.ndarray
    """(6,) int64: FFT size N, window length L, bins T of the table on either side, cells a bin,
    whether the table is of powers, whether it holds all bins."""
    modes: np.ndarray
    """(modes, cells * columns): of each mode the real (even modes) or imaginary part (odd ones)
    that does not come from the record's first sample."""
    edges: np.ndarray
    """(2, cells * columns): half of the window's first sample times cos and sin of pi r y."""
    ends: np.ndarray
    """(modes, 4, DERIVATIVES + 2): real and imaginary parts of A and of B, lowest power first."""
    reach: np.ndarray
    """(m,): distances [bins of fs/N] at which the envelope is known."""
    whole: np.ndarray
    """(segments, 2, cells * columns): tables that hold all bins; else empty."""


@lru_cache(maxsize=24)
def shapes(window: Window, fft_size: int, power: bool, tier: int) -> Shapes:
    """What shapes of up to some modes (:data:`TIERS`) are made of."""
    number, beside = TIERS[tier]
    ratio, length = window.length / fft_size, window.length
    bins = math.ceil(beside / ratio)
    y = _places(bins, power)
    order = 4 * ((math.ceil(math.pi * beside) + number) // 4) + 64
    x, weight = np.polynomial.legendre.leggauss(order)
    cosines = np.array([float(c) for c in COSINE_SUMS[window.name]])
    w = np.cos(np.pi * np.outer(x, np.arange(cosines.size))) @ np.diag(cosines)
    strength = np.cos(np.outer(np.arange(number), np.arccos(x))) * (
        w.sum(axis=1) * weight * length / 2
    )
    modes = _integrals(strength, x, ratio * y)
    taylor = _taylor(COSINE_SUMS[window.name], number)
    modes += _corrections(taylor, ratio * y, length)
    edge = float(taylor[0, 0])
    return Shapes(
        np.array([fft_size, length, bins, CELLS[power], power, False]),
        modes,
        0.5 * edge * np.array([np.cos(np.pi * ratio * y), np.sin(np.pi * ratio * y)]),
        _ends(taylor, length),
        _distances(bins, fft_size),
        np.empty((0, 2, 0)),
    )


def has_modes(window: Window, fft_size: int) -> bool:
    """Whether a window's shapes are made of modes; else they have tables of all bins."""
    return (
        window.name in COSINE_SUMS
        and window.length >= _SHORTEST
        and window.length * _MOST_PADDED >= fft_size
    )


def whole_shapes(window: Window, fft_size: int, power: bool, phase: np.ndarray) -> Shapes:
    """Shapes that have tables of all bins, of phase errors [cycles] by segment, (segments, L)."""
    cells, columns = CELLS[power], fft_size
    place = (np.arange(columns) - columns // 2) * cells - np.arange(cells)[:, None]
    turn = np.exp(1j * np.pi * (window.length / fft_size) * (place / cells))
    whole = np.empty((len(phase), 2, cells * columns))
    w = samples(window.name, window.length)
    for table, psi in zip(whole, phase, strict=True):
        record = w * np.exp(2j * np.pi * (psi - np.rint(psi)))
        found = (np.fft.fft(record, cells * fft_size)[place % (cells * fft_size)] * turn).ravel()
        table[0], table[1] = (np.abs(found) ** 2, 0) if power else (found.real, found.imag)
    return Shapes(
        np.array([fft_size, window.length, columns // 2, cells, power, True]),
        np.empty((0, 0)),
        np.empty((2, 0)),
        np.empty((0, 4, 1)),
        _distances(columns // 2, fft_size),
        whole,
    )


def record_places(nodes: int) -> np.ndarray:
    """Places in the record, -1 .. 1, at which phase errors are taken to find modes, (nodes,)."""
    return np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes)


@lru_cache(maxsize=8)
def to_modes(nodes: int) -> np.ndarray:
    """Chebyshev coefficients from values at :func:`record_places`, (nodes, coefficients)."""
    matrix = 2 / nodes * np.cos(np.outer(np.arccos(record_places(nodes)), np.arange(nodes)))
    matrix[:, 0] /= 2
    return matrix


def _places(bins: int, power: bool) -> np.ndarray:
    """Distances y of a table's cells from their line, flat."""
    cell = np.arange(CELLS[power]) / CELLS[power]
    return np.ravel(np.arange(-bins, bins + 1)[None, :] - cell[:, None])


def _distances(bins: int, fft_size: int) -> np.ndarray:
    """Distances at which envelopes are known: each bin of the table, then in even ratios."""
    far = np.geomspace(bins + 1, max(fft_size / 2, bins + 2), _FAR)
    return np.append(np.arange(bins + 1.0), far)


@njit(cache=True, error_model="numpy")
def _integrals(strength, x, y):
    """Real (even modes) or imaginary part (odd ones) of sums over nodes x, (modes, places)."""
    found = np.zeros((strength.shape[0], y.size))
    cosine, sine = np.empty(y.size), np.empty(y.size)
    for k in range(x.size):
        for i in range(y.size):
            sine[i], cosine[i] = sincos_cycles(-0.5 * y[i] * x[k])
        for j in range(strength.shape[0]):
            factor = strength[j, k]
            part = sine if j & 1 else cosine
            for i in range(y.size):
                found[j, i] += factor * part[i]
    return found


def _taylor(cosines: tuple[str, ...], modes: int) -> np.ndarray:
    """Taylor's coefficients of w T_j at the record's end x = 1, (modes, DERIVATIVES + 1).

    What the cosines add up to there may be next to nothing: their sums are exact.
    """
    order = np.arange(DERIVATIVES + 1)
    even = np.where(order % 2 == 0, (-1.0) ** (order // 2), 0.0)
    exact = [
        sum((-1) ** m * m**i * Fraction(c) for m, c in enumerate(cosines)) for i in order.tolist()
    ]
    w = even * np.array([float(x) / math.factorial(i) for i, x in enumerate(exact)]) * np.pi**order
    j = np.arange(modes, dtype=float)[:, None]
    ratio = (j * j - order[:-1] ** 2) / (2 * order[:-1] + 1) / (order[:-1] + 1)
    polynomial = np.cumprod(np.hstack([np.ones((modes, 1)), ratio]), axis=1)
    found = np.zeros((modes, DERIVATIVES + 1))
    for i in range(DERIVATIVES + 1):
        found[:, i:] += w[i] * polynomial[:, : DERIVATIVES + 1 - i]
    return found


def _corrections(taylor: np.ndarray, y: np.ndarray, length: int) -> np.ndarray:
    """By which sums over samples exceed integrals (Euler's and Maclaurin's), (modes, places)."""
    bernoulli = {1: 1 / 12, 3: -1 / 720, 5: 1 / 30240}
    turn = np.exp(-1j * np.pi * y)
    parity = (-1.0) ** np.arange(len(taylor))[:, None]
    found = np.zeros((len(taylor), y.size), complex)
    for m, share in bernoulli.items():
        for i in range(m + 1):
            # d^m/dx^m of w T_j e^{-i pi y x}, at x = 1 less that at x = -1
            rest = math.comb(m, i) * math.factorial(i) * (-1j * np.pi * y) ** (m - i)
            ends = turn - (-1) ** i * parity * np.conj(turn)
            found += share * (2 / length) ** m * taylor[:, i : i + 1] * rest * ends
    return np.where(parity > 0, found.real, found.imag)


def _ends(taylor: np.ndarray, length: int) -> np.ndarray:
    """Polynomials A and B of modes, (modes, 4, DERIVATIVES + 2)."""
    number = DERIVATIVES + 2
    sums = np.zeros((DERIVATIVES + 1, number), complex)  # of n^j e^{-i theta n} in cot(theta / 2)
    sums[0, :2] = 0.5, -0.5j
    for j in range(DERIVATIVES):
        slope = sums[j, 1:] * np.arange(1, number)
        sums[j + 1, : number - 1] -= 0.5j * slope
        sums[j + 1, 2:] -= 0.5j * slope[: number - 2]
    step = (2 / length) ** np.arange(DERIVATIVES + 1)
    last = ((taylor * step)[:, :, None] * sums).sum(axis=1)
    parity = (-1.0) ** (np.arange(len(taylor))[:, None] + np.arange(DERIVATIVES + 1))
    first = ((taylor * step * parity)[:, :, None] * sums).sum(axis=1)
    return np.stack([first.real, first.imag, last.real, last.imag], axis=1)


@njit(cache=True, error_model="numpy")
def find_modes(phase, matrix, centre, found, number):
    """Take phase errors apart.

    Parameters
    ----------
    phase : (segments, n, nodes) float64
        Phase errors [cycles] at :func:`record_places`.
    matrix : (nodes, nodes) float64
        :func:`to_modes`.
    centre : (segments, n) float64
        Result: shift of the line [bins of fs/L].
    found : (segments, n, 2, >= nodes // 2) float64
        Result: real and imaginary parts of the modes.
    number : (segments, n) int64
        Result: modes that count; 0 where half as many as there are nodes are too few.
    """
    nodes = matrix.shape[0]
    one, other = np.empty(nodes), np.empty(nodes)
    for s in range(phase.shape[0]):
        for i in range(phase.shape[1]):
            slope = 0.0
            for k in range(nodes):
                slope += matrix[k, 1] * phase[s, i, k]
            centre[s, i] = 2.0 * slope
            one[:] = 0.0
            other[:] = 0.0
            for k in range(nodes):
                place = 0.5 * nodes * matrix[k, 1]
                sine, cosine = sincos_cycles(phase[s, i, k] - slope * place)
                for j in range(nodes):
                    one[j] += matrix[k, j] * cosine
                    other[j] += matrix[k, j] * sine
            count = nodes
            while count > 1 and abs(one[count - 1]) + abs(other[count - 1]) < MODES_ERROR:
                count -= 1
            number[s, i] = count if count <= nodes // 2 else 0
            for j in range(min(count, nodes // 2)):
                found[s, i, 0, j], found[s, i, 1, j] = one[j], other[j]


@njit(cache=True, error_model="numpy")
def build(re, im, number, shapes, table, ends, envelope):
    """A shape of its modes.

    Parameters
    ----------
    re, im : (>= number,) float64
        Modes.
    number : int
    shapes : Shapes
        What they are made of, as a tuple.
    table : (2, cells * columns) float64
        Result: G, or |G|^2 in the first row.
    ends : (4, DERIVATIVES + 2) float64
        Result: A and B.
    envelope : (2, m) float64
        Result: most that |G| comes to from each of the distances on; integral of its square.
    """
    sizes, modes, edges, mode_ends, reach = shapes[0], shapes[1], shapes[2], shapes[3], shapes[4]
    at_first_re, at_first_im, at_last_re, at_last_im = 0.0, 0.0, 0.0, 0.0
    size = table.shape[1]
    table[:] = 0.0
    ends[:] = 0.0
    for j in range(number):
        a, b = re[j], im[j]
        sign = -1.0 if j & 1 else 1.0
        at_first_re += sign * a
        at_first_im += sign * b
        at_last_re += a
        at_last_im += b
        if j & 1:
            a, b = -b, a
        for i in range(size):
            table[0, i] += a * modes[j, i]
            table[1, i] += b * modes[j, i]
        for d in range(ends.shape[1]):
            for k in range(0, 4, 2):
                one, other = mode_ends[j, k, d], mode_ends[j, k + 1, d]
                ends[k, d] += re[j] * one - im[j] * other
                ends[k + 1, d] += re[j] * other + im[j] * one
    # The record's first sample counts whole, its end not at all.
    a, b = at_first_re - at_last_re, at_first_im - at_last_im
    c, d = at_first_re + at_last_re, at_first_im + at_last_im
    for i in range(size):
        cosine, sine = edges[0, i], edges[1, i]
        table[0, i] += a * cosine - d * sine
        table[1, i] += b * cosine + c * sine
    if sizes[4]:
        for i in range(size):
            table[0, i] = table[0, i] * table[0, i] + table[1, i] * table[1, i]
    put_envelope(table, ends, sizes, reach, envelope)


@njit(cache=True, error_model="numpy")
def put_envelope(table, ends, sizes, reach, envelope):
    """Envelope of a table, and of what is beyond it; as of :func:`build`."""
    bins, cells, power = sizes[2], sizes[3], sizes[4]
    columns = table.shape[1] // cells
    most, area, before = 0.0, 0.0, 0.0
    for i in range(reach.size - 1, -1, -1):
        if i <= bins:
            for row in range(0, cells, cells // 4):
                for side in range(2):
                    column = bins - i if side == 0 else min(bins + i, columns - 1)
                    at = row * columns + column
                    square = table[0, at]
                    if not power:
                        square = square * square + table[1, at] * table[1, at]
                    most = max(most, _MARGIN * math.sqrt(square))
        elif not sizes[5]:
            c = 1.0 / math.tan(math.pi * reach[i] / sizes[0])
            a_re, a_im, b_re, b_im = 0.0, 0.0, 0.0, 0.0
            for d in range(ends.shape[1] - 1, -1, -1):
                a_re = a_re * c + ends[0, d]
                a_im = a_im * c + ends[1, d]
                b_re = b_re * c + ends[2, d]
                b_im = b_im * c + ends[3, d]
            most = max(most, math.hypot(a_re, a_im) + math.hypot(b_re, b_im))
        further = reach[i + 1] - reach[i] if i + 1 < reach.size else 0.0
        area += further * 0.5 * (most * most + before)  # an upper sum, where it falls ever slower
        before = most * most
        envelope[0, i], envelope[1, i] = most, area
