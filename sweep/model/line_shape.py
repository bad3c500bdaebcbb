"""The line shape of a record: what one line shows in the bins around it.

All lines of a segment share the window and what befalls the record, a phase error psi(t), so they
share one shape. With x = -1 .. 1 over the record of L samples, r = L/N, and y bins of fs/N,

    G(y) = sum_n w(x_n) exp(2 pi i psi(x_n)) exp(-i pi r y x_n)

whose phase counts from the middle of the record. G is kept in three forms:

- **A table** of G, or of |G|^2 where lines add as powers, at cells of 1/2 (1/4) bin out to some
  bins on either side. Lines are shared out among the fourteen cells around them, by a kernel that
  all but vanishes beyond; the table has divided out what that does. It is a Kaiser-Bessel kernel,
  as of non-uniform FFTs [Fessler and Sutton 2003], and right to 1e-12 of the peak.
- **Beyond the table** by the record's two ends alone. With c = cot(pi y / N),

      G(y) = e^{i pi r y} A(c) - e^{-i pi r y} B(c)

  where A and B are polynomials made of the derivatives of w exp(2 pi i psi) at either end, because
  sum_n n^j e^{-i theta n} is a polynomial in cot(theta / 2).
- **An envelope**: the most that |G| comes to at any distance from there on.

A phase error is taken apart into a shift of the line, by its mean slope, and few Chebyshev modes:
exp(2 pi i psi) = sum_j a_j T_j(x). All of the above is linear in a_j, so each shape is a sum over
modes of tables that are made once for a window. Phases that need too many modes, windows that are
no sum of cosines, and short or much padded records have a table of all bins, by one FFT.

An echo that arrives after the record has begun has the last L' of its samples. They are a record of
their own, with a window that is the rest of the whole one. In the place x' = -1 .. 1 within it,
w exp(2 pi i psi) is smooth and has few Chebyshev modes, each with a transform that depends on the
product of y and L' alone. These are tabulated once for all windows and lengths; a shape is their
sum, interpolated at its own places. Its far sidelobes fall as 1/y, as its window begins with a step
(:func:`build_part`).
"""

import math
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial.chebyshev import cheb2poly, chebfit
from scipy.special import i0

from sweep.kernel_cache import njit
from sweep.model.elementary import sincos_cycles
from sweep.model.window import COSINE_SUMS, Window, samples

CELLS = (2, 4)
"""Cells of the table in a bin of fs/N, for amplitudes and for powers."""

POINTS = 14
"""Cells among which a line is shared out: -6 .. 7 beside its place between 0 and 1."""

WIDEN = 32.32432
"""Parameter of the kernel I_0(b sqrt(1 - (2 z / POINTS)^2)) / I_0(b) over z cells."""

TAPS = np.array([
    27.059814524108916, -24.069297462538476, 18.21886188994693, -12.301303141361002,
    7.584228285544723, -4.313600790782408, 2.270108868623467, -1.1041027145184494,
    0.49429836881691397, -0.2024309201966936, 0.07519960545439297, -0.025063737807734597,
    0.007388544649665242, -0.0018900276225103194, 0.0004085782830266439, -7.179287548481712e-05,
    9.634021822884657e-06, -8.798393952475983e-07, 4.1136322681806606e-08,
])  # fmt: skip
"""Even filter over cells whose transform is 1 over the kernel's, to 1e-13 below pi / 2."""

TIERS = ((24, 20, 64), (48, 56, 96), (128, 200, 256))
"""Modes at the most; bins of fs/L beyond which the record's ends then tell a shape; bins that its
table holds on either side, where few points share it."""

SHARED = 256
"""Bins that it holds where many do: wide footprints are then served by it."""

DERIVATIVES = 12
"""Derivatives at the record's ends."""

MODES_ERROR = 1e-13
"""Size below which modes are left out, relative to the record."""

_SHORTEST, _MOST_PADDED = 4096, 8
"""Samples of a record, and its padding N/L, between which sums over it are integrals."""

_FAR = 48
"""Distances at which the envelope is known beyond the table."""

_MARGIN = 1.05
"""On the envelope, for what happens between cells."""

_BEYOND = TAPS.size - 1
"""Cells on either side of a table that its filter looks at."""

KERNEL_DEGREE = 13

SPARE_CELLS = 2
"""Cells of no weight beyond those among which a line is shared out, for whole vectors."""

PART_STEP = math.sqrt(2.0)
"""Most to least samples of the echoes whose shapes share a table's width."""

_PART_SAMPLES_PER_BIN = 16
"""Least samples of an echo to the bins of fs/L' in its table: sums over it are then integrals and
six of Euler and Maclaurin's corrections."""

_PART_BESIDE = 16
"""Bins of fs/L' by which the table of such an echo holds more than those that its ends do not tell:
as many as lines that are shared out together need."""

_PART_PADDED_MAX = 16
"""Most padding N/L' of an echo whose shape is made of modes."""

_PART_CELLS = 2
"""Tabulated values in a bin of fs/L'."""

EULER_MACLAURIN = {
    1: 1 / 12, 3: -1 / 720, 5: 1 / 30240, 7: -1 / 1209600, 9: 1 / 47900160,
    11: -691 / 1307674368000,
}  # fmt: skip
"""B_(m+1) / (m+1)! by the order m of the derivatives at the ends."""

_ORDER_MAX = max(EULER_MACLAURIN)


class Shapes(NamedTuple):
    """Line shapes of one window and FFT, as the compiled code takes them; see `segments`."""

    sizes: np.ndarray
    """(7,) int64: FFT size N, window length L, bins T of the table on either side, cells a bin,
    whether the table is of powers, whether it holds all bins; bins beyond which ends tell."""
    modes: np.ndarray
    """(modes, places): of each mode the real (even modes) or imaginary part (odd ones), by cell,
    that does not come from the record's first sample. Of amplitudes then, in further places, what
    this comes to in a table."""
    edges: np.ndarray
    """(2, places): the window's first sample times cos and sin of pi r y, and likewise."""
    ends: np.ndarray
    """(modes, 4, DERIVATIVES + 2): real and imaginary parts of A and of B, lowest power first."""
    reach: np.ndarray
    """(2, m): distances d [bins of fs/N] at which the envelope is known; cot(pi d / N)."""
    whole: np.ndarray
    """(segments, 2, cells * columns): tables that hold all bins; else empty."""
    outlines: np.ndarray
    """(segments, 2, m): their envelopes, as of :func:`build`; else empty."""
    lengths: np.ndarray
    """(segments, shapes) int64: samples of the record that the echo has, where these are not all
    and shapes are made of modes; else empty. ``modes`` then are transforms over u = -U .. U, in
    steps of half a bin of fs/L', with the kernel divided out."""
    taylor: np.ndarray
    """(modes, DERIVATIVES + 1): Taylor's coefficients of such modes at x = 1; else empty."""


_ALL_SAMPLES = np.empty((0, 0), np.int64), np.empty((0, 0))
"""Of shapes of echoes that have all samples of the record."""

_gauss_legendre = lru_cache(maxsize=8)(np.polynomial.legendre.leggauss)


@lru_cache(maxsize=24)
def shapes(window: Window, fft_size: int, power: bool, tier: int, *, shared: bool = True) -> Shapes:
    """Prepare the tables from which shapes of up to some modes (:data:`TIERS`) are built."""
    number, clear, beside = TIERS[tier]
    beside = SHARED if shared else beside
    ratio, length = window.length / fft_size, window.length
    bins = math.ceil(beside / ratio)
    y = _places(bins, power)
    order = 4 * ((math.ceil(math.pi * beside) + number) // 4) + 64
    x, weight = _gauss_legendre(order)
    cosines = np.array([float(c) for c in COSINE_SUMS[window.name]])
    w = np.cos(np.pi * np.outer(x, np.arange(cosines.size))) @ np.diag(cosines)
    strength = np.cos(np.outer(np.arange(number), np.arccos(x))) * (
        w.sum(axis=1) * weight * length / 2
    )
    modes = _integrals(strength, x, ratio * y)
    taylor = _taylor(COSINE_SUMS[window.name], number)
    modes += _corrections(taylor, ratio * y, length)
    edges = taylor[0, 0] * np.array([np.cos(np.pi * ratio * y), np.sin(np.pi * ratio * y)])
    if not power:
        modes, edges = (np.hstack([one, _in_table(one, CELLS[power])]) for one in (modes, edges))
    sizes = [fft_size, length, bins, CELLS[power], power, False, math.ceil(clear / ratio)]
    ends, reach, none = _ends(taylor, length), _distances(bins, fft_size), np.empty((0, 2, 0))
    return Shapes(np.array(sizes), modes, edges, ends, reach, none, none, *_ALL_SAMPLES)


def part_class(window: Window, least: np.ndarray) -> np.ndarray:
    """Count the :data:`PART_STEP` by which the least of an echo's samples falls short of all."""
    ratio = window.length / np.maximum(least, 1)
    return np.ceil(np.log(ratio) / math.log(PART_STEP) - 1e-9).astype(np.int64)


def part_has_modes(
    window: Window, fft_size: int, tier: int, least: np.ndarray, largest: np.ndarray
) -> np.ndarray:
    """Return true for echoes of some samples whose shapes may be made of modes, (n,).

    ``least`` and ``largest`` are the samples of the segments that have fewest and most.
    """
    if window.name not in COSINE_SUMS:
        return np.zeros(least.shape, np.bool_)
    held = TIERS[tier][1] + _PART_BESIDE
    enough = (least >= _PART_SAMPLES_PER_BIN * held) & (least * _PART_PADDED_MAX >= fft_size)
    widest = window.length * PART_STEP ** (1.0 - part_class(window, least))
    return np.asarray(enough & (largest <= 1.01 * widest))


def part_window(window: Window, x: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Window at places x, -1 .. 1, of the last ``length`` samples of the record, (*length, x)."""
    share = np.asarray(length)[..., None] / window.length
    place = 1.0 - share * (1.0 - x)
    cosines = [float(c) for c in COSINE_SUMS[window.name]]
    return np.asarray(sum(c * np.cos(np.pi * m * place) for m, c in enumerate(cosines)))


@lru_cache(maxsize=48)
def part_shapes(window: Window, fft_size: int, power: bool, tier: int, step: int) -> Shapes:
    """Prepare the tables for echoes that have part of a record's samples, of a class of them."""
    clear = TIERS[tier][1]
    beside = clear + _PART_BESIDE
    least = window.length * PART_STEP ** (-float(step)) / fft_size
    bins = math.ceil(beside / least)
    sizes = [fft_size, window.length, bins, CELLS[power], power, False, math.ceil(clear / least)]
    modes, taylor = _part_modes(tier)
    none, no_ends = np.empty((0, 2, 0)), np.empty((0, 4, 1))
    reach = _distances(bins, fft_size)
    return Shapes(
        np.array(sizes), modes, np.empty((2, 0)), no_ends, reach, none, none,
        np.empty((0, 0), np.int64), taylor,
    )  # fmt: skip


@lru_cache(maxsize=len(TIERS))
def _part_modes(tier: int) -> tuple[np.ndarray, np.ndarray]:
    """Half the integrals of T_j(x) exp(-i pi u x) with the kernel divided out; their Taylor."""
    number, clear, _ = TIERS[tier]
    half = math.ceil((1.02 * PART_STEP * (clear + _PART_BESIDE) + 14) * _PART_CELLS + POINTS)
    u = np.arange(-half, half + 1) / _PART_CELLS
    order = 4 * ((math.ceil(math.pi * u[-1]) + number) // 4) + 96
    x, weight = _gauss_legendre(order)
    strength = np.cos(np.outer(np.arange(number), np.arccos(x))) * weight / 2
    return _integrals(strength / kernel_transform(np.pi / _PART_CELLS * x), x, u), _taylor(
        ("1",), number
    )


def has_modes(window: Window, fft_size: int) -> bool:
    """Return true if a window's shapes are made of modes; else they have tables of all bins."""
    long = window.length >= _SHORTEST and window.length * _MOST_PADDED >= fft_size
    return long and window.name in COSINE_SUMS


def whole_shapes(
    window: Window, fft_size: int, power: bool, phase: np.ndarray, first: np.ndarray | None = None
) -> Shapes:
    """Shapes that have tables of all bins, of phase errors [cycles] by segment, (segments, L).

    ``first`` (segments,) is the first sample that the echo has, by default 0.
    """
    cells, half, length = CELLS[power], fft_size // 2, window.length
    number = cells * fft_size
    place = (np.arange(fft_size) - half) * cells - np.arange(cells)[:, None]
    turn = np.exp(1j * np.pi * (length / fft_size / cells) * place)
    whole = np.empty((len(phase), 2, number))
    reach = _distances(half, fft_size)
    outlines = np.zeros((len(phase), 2, reach.shape[1]))
    w, x = samples(window.name, length), 2 * np.arange(length) / length - 1
    begins = np.zeros(len(phase), np.int64) if first is None else first
    for table, outline, psi, begin in zip(whole, outlines, phase, begins, strict=True):
        record = w * np.exp(2j * np.pi * (psi - np.rint(psi)))
        record[:begin] = 0.0
        square = np.abs(np.fft.fft(record, number)) ** 2
        _outline_of_all(square, cells, outline)
        if power:
            found = TAPS[0] * square
            for k in range(1, TAPS.size):
                found += TAPS[k] * (np.roll(square, k) + np.roll(square, -k))
            table[0], table[1] = found[place % number].ravel(), 0.0
        else:
            record /= kernel_transform(np.pi * (length / fft_size / cells) * x)
            found = (np.fft.fft(record, number)[place % number] * turn).ravel()
            table[0], table[1] = found.real, found.imag
    sizes = np.array([fft_size, length, half, cells, power, True, half])
    none = np.empty((0, 0)), np.empty((2, 0)), np.empty((0, 4, 1))
    return Shapes(sizes, *none, reach, whole, outlines, *_ALL_SAMPLES)


def _outline_of_all(square: np.ndarray, cells: int, outline: np.ndarray) -> None:
    """Envelope of |G|^2 at all cells of the circle."""
    both = square + np.maximum(np.roll(square, cells // 2), np.roll(square, -(cells // 2)))
    half = square.size // 2
    folded = np.maximum(both[: half + 1], both[-np.arange(half + 1)])
    beyond = np.maximum.accumulate(folded[::-1])[::-1]
    beyond = beyond[np.maximum(np.arange(0, half + 1, cells) - 1, 0)]  # from the cell before on
    beyond *= _MARGIN**2
    outline[0, : beyond.size] = np.sqrt(beyond)
    steps = 0.5 * (beyond + np.append(beyond[1:], 0.0))
    outline[1, : beyond.size] = np.cumsum(steps[::-1])[::-1]


def kernel(z: np.ndarray) -> np.ndarray:
    """Evaluate the kernel that shares lines out among cells, at z cells, |z| <= POINTS / 2."""
    root = np.sqrt(np.maximum(1 - (2 * z / POINTS) ** 2, 0.0))
    return np.asarray(i0(WIDEN * root) / i0(WIDEN))


_s = np.cos(np.pi * (np.arange(KERNEL_DEGREE + 1) + 0.5) / (KERNEL_DEGREE + 1))
KERNEL_BASIS = np.zeros((KERNEL_DEGREE + 1, POINTS + SPARE_CELLS))
"""Polynomials of the kernel, by power of s = -1 .. 1 across a cell and by cell."""

for _j in range(POINTS):
    KERNEL_BASIS[:, _j] = cheb2poly(
        chebfit(_s, kernel((_s + 1) / 2 - _j + POINTS // 2 - 1), KERNEL_DEGREE)
    )


def kernel_transform(theta: np.ndarray) -> np.ndarray:
    """Its transform at theta radians a cell, |theta| <= pi."""
    root = np.sqrt(WIDEN**2 - (POINTS * theta / 2) ** 2)
    return np.asarray(POINTS * np.sinh(root) / root / i0(WIDEN))


def places_of(sizes: np.ndarray) -> int:
    """Numbers in a row of a table of these sizes."""
    return int(sizes[3] * (sizes[0] if sizes[5] else 2 * sizes[2] + 1))


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
    """Distances y of a table's cells from their line, and of those that its filter looks at."""
    cells = CELLS[power]
    return np.arange(-bins * cells - cells + 1 - _BEYOND, bins * cells + _BEYOND + 1) / cells


def _in_table(values: np.ndarray, cells: int) -> np.ndarray:
    """Values at :func:`_places` with the kernel divided out, in rows by cell of a bin."""
    inner = values.shape[1] - 2 * _BEYOND
    filtered = TAPS[0] * values[:, _BEYOND : _BEYOND + inner]
    for k in range(1, TAPS.size):
        for at in (_BEYOND - k, _BEYOND + k):
            filtered += TAPS[k] * values[:, at : at + inner]
    rows = [filtered[:, cells - 1 - m :: cells] for m in range(cells)]
    return np.hstack(rows)


def _distances(bins: int, fft_size: int) -> np.ndarray:
    """Distances at which envelopes are known: each bin of the table, then in even ratios."""
    far = np.geomspace(bins + 1, max(fft_size / 2, bins + 2), _FAR)
    reach = np.append(np.arange(bins + 1.0), far)
    with np.errstate(divide="ignore"):
        return np.array([reach, 1 / np.tan(np.pi * reach / fft_size)])


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
    """Compute the excess of sums over integrals (Euler and Maclaurin), (modes, places)."""
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


def _sums_of_powers() -> np.ndarray:
    """Compute sums of n^j e^{-i theta n} as polynomials in cot(theta / 2), by j and power."""
    number = DERIVATIVES + 2
    sums = np.zeros((DERIVATIVES + 1, number), complex)
    sums[0, :2] = 0.5, -0.5j
    for j in range(DERIVATIVES):
        slope = sums[j, 1:] * np.arange(1, number)
        sums[j + 1, : number - 1] -= 0.5j * slope
        sums[j + 1, 2:] -= 0.5j * slope[: number - 2]
    return sums


_SUMS = _sums_of_powers()
_SUMS_RE, _SUMS_IM = np.ascontiguousarray(_SUMS.real), np.ascontiguousarray(_SUMS.imag)

_CORRECTIONS = np.zeros((_ORDER_MAX + 1, _ORDER_MAX + 1))
"""Factors of Taylor's coefficients i at an end in the power d of -i theta of its correction."""

for _m, _share in EULER_MACLAURIN.items():
    for _i in range(_m + 1):
        _CORRECTIONS[_m - _i, _i] += _share * math.comb(_m, _i) * math.factorial(_i)


def _ends(taylor: np.ndarray, length: int) -> np.ndarray:
    """Polynomials A and B of modes, (modes, 4, DERIVATIVES + 2)."""
    sums = _SUMS
    step = (2 / length) ** np.arange(DERIVATIVES + 1)
    last = ((taylor * step)[:, :, None] * sums).sum(axis=1)
    parity = (-1.0) ** (np.arange(len(taylor))[:, None] + np.arange(DERIVATIVES + 1))
    first = ((taylor * step * parity)[:, :, None] * sums).sum(axis=1)
    return np.stack([first.real, first.imag, last.real, last.imag], axis=1)


@njit(cache=True, error_model="numpy")
def find_modes(phase, weight, matrix, centre, found, number):
    """Take phase errors, and a window beside them, apart.

    ``phase`` (segments, n, nodes) [cycles] is at :func:`record_places`, and so is the window
    ``weight``, of the same shape or empty where it is not among the modes; ``matrix`` is
    :func:`to_modes`. Results: ``centre`` (segments, n), shift of the line [bins of fs/L]. ``found``
    (segments, n, 2, >= nodes // 2), real and imaginary parts of the modes. ``number`` (segments,
    n), modes that count, 0 where half as many as there are nodes are too few.
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
                if weight.size:
                    sine, cosine = sine * weight[s, i, k], cosine * weight[s, i, k]
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
def build(segment, numbers, parts, shapes, table, form):
    """Build a shape from its modes, or take it from a table that holds all bins.

    ``numbers``: the shape's, and that of the one that stands in the results, or -1. ``parts``:
    modes (segments, shapes, 2, modes) second, and third how many count (segments, shapes).
    ``shapes``: tables to build from. Results: ``table`` (2, cells * columns), G, or |G|^2 in the
    first row. ``form`` (7, >= m), in rows 1 and 2 the most that |G| comes to from each of m
    distances on, and the integral of its square. The other rows have A and B of DERIVATIVES + 2
    terms.
    """
    sizes, modes, edges, mode_ends, reach = shapes[0], shapes[1], shapes[2], shapes[3], shapes[4]
    which, before = numbers
    re, im = parts[1][segment, which, 0], parts[1][segment, which, 1]
    number = parts[2][segment, which]
    if before >= 0 and number == 1 and parts[2][segment, before] == 1:
        one = parts[1][segment, before]
        if one[0, 0] == re[0] and one[1, 0] == im[0]:
            return
    envelope, ends = form[1:3], form[3:7, : DERIVATIVES + 2]
    power = sizes[4] != 0
    if sizes[5]:
        for i in range(2):
            for k in range(table.shape[1]):
                table[i, k] = shapes[5][segment, i, k]
            for k in range(envelope.shape[1]):
                envelope[i, k] = shapes[6][segment, i, k]
        return
    even_re, even_im, odd_re, odd_im = 0.0, 0.0, 0.0, 0.0  # T_j is 1 at the end, +-1 at the start
    size = modes.shape[1]
    raw = np.zeros((2, size))
    ends[:] = 0.0
    for j in range(number):
        a, b = re[j], im[j]
        if j & 1:
            odd_re, odd_im = odd_re + a, odd_im + b
            a, b = -b, a
        else:
            even_re, even_im = even_re + a, even_im + b
        for i in range(size):
            raw[0, i] += a * modes[j, i]
            raw[1, i] += b * modes[j, i]
        for k in range(0, 4, 2):
            for d in range(ends.shape[1]):
                one, other = mode_ends[j, k, d], mode_ends[j, k + 1, d]
                ends[k, d] += re[j] * one - im[j] * other
                ends[k + 1, d] += re[j] * other + im[j] * one
    # The record's first sample counts whole, its end not at all.
    for i in range(size):
        cosine, sine = edges[0, i], edges[1, i]
        raw[0, i] -= odd_re * cosine + even_im * sine
        raw[1, i] += even_re * sine - odd_im * cosine
    number = size if power else size - table.shape[1]  # places on either side of the line
    for i in range(table.shape[1] * (not power)):
        table[0, i], table[1, i] = raw[0, number + i], raw[1, number + i]
    for i in range(number):
        raw[0, i] = raw[0, i] * raw[0, i] + raw[1, i] * raw[1, i]
    if power:
        _put_table(raw[0], sizes, table[0])
    _put_envelope(raw[0, :number], ends, sizes, reach, envelope)


@njit(cache=True, error_model="numpy", borrows=True)
def same_part(segment, which, parts, lengths, segments):
    """First segment before this one whose shape is the same, -1 for none; as of :func:`build`."""
    number = parts[2][segment, which]
    for s in range(segment):
        if not segments[s] or lengths[s, which] != lengths[segment, which]:
            continue
        alike = parts[2][s, which] == number
        for j in range(number):
            alike &= parts[1][s, which, 0, j] == parts[1][segment, which, 0, j]
            alike &= parts[1][s, which, 1, j] == parts[1][segment, which, 1, j]
        if alike:
            return s
    return -1


@njit(cache=True, error_model="numpy")
def build_part(segment, which, parts, shapes, table, form):
    """Build the shape of an echo that has the last ``sizes[1]`` samples of the record.

    Arguments and results as of :func:`build`. With f = w exp(2 pi i psi) over these samples and
    theta = 2 pi y / N,

        G(y) = L'/2 int f(x) e^{-i pi r' y x} dx + (f(-1) e^{i pi r' y} - f(1) e^{-i pi r' y}) / 2
               + sum_m B_{m+1} / (m+1)! [ d^m / dn^m (f e^{-i theta n}) ] at the ends,

    whose derivatives are polynomials in theta.
    """
    sizes, modes, taylor, reach = shapes.sizes, shapes.modes, shapes.taylor, shapes.reach
    re, im = parts[1][segment, which, 0], parts[1][segment, which, 1]
    number, power = parts[2][segment, which], sizes[4] != 0
    envelope, ends = form[1:3], form[3:7, : DERIVATIVES + 2]
    half, step, ratio = 0.5 * sizes[1], 2.0 / sizes[1], sizes[1] / sizes[0]
    series = np.zeros((2, modes.shape[1]))
    first, last = np.zeros((2, DERIVATIVES + 1)), np.zeros((2, DERIVATIVES + 1))
    for j in range(number):
        a, b = re[j], im[j]
        for i in range(DERIVATIVES + 1):
            value = taylor[j, i]
            sign = -1.0 if (i + j) & 1 else 1.0
            last[0, i], last[1, i] = last[0, i] + a * value, last[1, i] + b * value
            first[0, i] += sign * a * value
            first[1, i] += sign * b * value
        if j & 1:
            a, b = -b, a
        for i in range(modes.shape[1]):
            series[0, i] += a * modes[j, i]
            series[1, i] += b * modes[j, i]
    scale = 1.0
    for i in range(DERIVATIVES + 1):
        for k in range(2):
            first[k, i], last[k, i] = first[k, i] * scale, last[k, i] * scale
        scale *= step
    ends[:] = 0.0
    for i in range(DERIVATIVES + 1):
        for d in range(DERIVATIVES + 2):
            p, q = _SUMS_RE[i, d], _SUMS_IM[i, d]
            ends[0, d] += first[0, i] * p - first[1, i] * q
            ends[1, d] += first[0, i] * q + first[1, i] * p
            ends[2, d] += last[0, i] * p - last[1, i] * q
            ends[3, d] += last[0, i] * q + last[1, i] * p
    # Corrections of the two ends by power of theta: (-i)^d turns real and imaginary parts about.
    at_ends = np.zeros((4, _ORDER_MAX + 1))
    for d in range(_ORDER_MAX + 1):
        a, b, c, e = 0.0, 0.0, 0.0, 0.0
        for i in range(_ORDER_MAX + 1 - d):
            factor = _CORRECTIONS[d, i]
            a, b = a - factor * first[0, i], b - factor * first[1, i]
            c, e = c + factor * last[0, i], e + factor * last[1, i]
        if d == 0:  # the first sample counts whole, the end not at all
            a, b = a + 0.5 * first[0, 0], b + 0.5 * first[1, 0]
            c, e = c - 0.5 * last[0, 0], e - 0.5 * last[1, 0]
        for _ in range(d % 4):
            a, b, c, e = b, -a, e, -c
        at_ends[0, d], at_ends[1, d], at_ends[2, d], at_ends[3, d] = a, b, c, e
    cells, bins = sizes[3], sizes[2]
    places = 2 * bins * cells + cells + 2 * _BEYOND
    begin = -bins * cells - cells + 1 - _BEYOND
    raw, weight = np.empty((2, places)), np.empty(POINTS + SPARE_CELLS)
    middle = modes.shape[1] // 2
    for i in range(places):
        y = (begin + i) / cells
        u = ratio * y
        at = u * _PART_CELLS + middle
        cell = math.floor(at)
        s = 2.0 * (at - cell) - 1.0
        weight[:] = KERNEL_BASIS[KERNEL_DEGREE]
        for d in range(KERNEL_DEGREE - 1, -1, -1):
            for j in range(POINTS + SPARE_CELLS):
                weight[j] = weight[j] * s + KERNEL_BASIS[d, j]
        x, z = 0.0, 0.0
        start = np.uint64(cell - POINTS // 2 + 1)
        for j in range(np.uint64(POINTS)):
            x += weight[j] * series[0, start + j]
            z += weight[j] * series[1, start + j]
        theta = 2.0 * np.pi * y / sizes[0]
        a, b, c, e = 0.0, 0.0, 0.0, 0.0
        for d in range(_ORDER_MAX, -1, -1):
            a, b = a * theta + at_ends[0, d], b * theta + at_ends[1, d]
            c, e = c * theta + at_ends[2, d], e * theta + at_ends[3, d]
        sine, cosine = sincos_cycles(0.5 * u)
        raw[0, i] = 2.0 * half * x + (a * cosine - b * sine) + (c * cosine + e * sine)
        raw[1, i] = 2.0 * half * z + (a * sine + b * cosine) + (e * cosine - c * sine)
    if not power:
        _put_table(raw[0], sizes, table[0])
        _put_table(raw[1], sizes, table[1])
    for i in range(places):
        raw[0, i] = raw[0, i] * raw[0, i] + raw[1, i] * raw[1, i]
    if power:
        _put_table(raw[0], sizes, table[0])
    _put_envelope(raw[0], ends, sizes, reach, envelope)


@njit(cache=True, error_model="numpy")
def _put_table(square, sizes, table):
    """Values at cells with the kernel divided out of them, in rows by cell of a bin."""
    cells, columns = sizes[3], 2 * sizes[2] + 1
    number = np.uint64(cells * columns)
    filtered = np.empty(cells * columns)
    for i in range(number):
        filtered[i] = TAPS[0] * square[i + np.uint64(_BEYOND)]
    for k in range(1, TAPS.size):
        low, high = np.uint64(_BEYOND - k), np.uint64(_BEYOND + k)
        for i in range(number):
            filtered[i] += TAPS[k] * (square[i + low] + square[i + high])
    for m in range(cells):
        for q in range(columns):
            table[m * columns + q] = filtered[q * cells + cells - 1 - m]


@njit(cache=True, error_model="numpy")
def _put_envelope(square, ends, sizes, reach, envelope):
    """Envelope of |G|^2 at cells, and of what is beyond them; as of :func:`build`.

    |G|^2 goes as a sine of y with a period of a bin, so that it is nowhere more than two values
    half a bin apart have together.
    """
    bins, cells = sizes[2], sizes[3]
    middle, half = bins * cells + cells - 1 + _BEYOND, cells // 2
    for i in range(np.uint64(bins + 1), np.uint64(reach.shape[1])):
        c, a, b, p, q = reach[1, i], 0.0, 0.0, 0.0, 0.0
        for k in range(DERIVATIVES + 2):
            d = DERIVATIVES + 1 - k
            a, b = a * c + ends[0, d], b * c + ends[1, d]
            p, q = p * c + ends[2, d], q * c + ends[3, d]
        first, last = a * a + b * b, p * p + q * q
        envelope[0, i] = first + last + 2.0 * math.sqrt(first * last)
    pairs = np.empty(bins * cells + cells + 1)  # from the cell before the line on
    for i in range(pairs.size):
        up, down = np.uint64(middle - 1 + i), np.uint64(middle + 1 - i)
        above = square[up] + square[up + np.uint64(half)]
        below = square[down] + square[down - np.uint64(half)]
        pairs[i] = _MARGIN * _MARGIN * max(above, below)
    most, area, before = 0.0, 0.0, 0.0  # of the square
    for i in range(reach.shape[1] - 1, -1, -1):
        if i > bins:
            most = max(most, envelope[0, i])
        else:
            for k in range(i * cells, (i + 1) * cells + 1):
                most = max(most, pairs[k])
        width = reach[0, i + 1] - reach[0, i] if i + 1 < reach.shape[1] else 0.0
        area += width * 0.5 * (most + before)  # an upper sum, where it falls ever slower
        before = most
        envelope[0, i], envelope[1, i] = most, area
    for i in range(reach.shape[1]):
        envelope[0, i] = math.sqrt(envelope[0, i])
