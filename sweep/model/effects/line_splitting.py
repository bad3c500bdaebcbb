"""One line with a phase error over the record as a few pure lines: for the closed-form kernel.

A deterministic phase error psi(t) [cycles] multiplies a line's record by exp(2 pi i psi). With x
running over the record from -1 to 1, sample n of L being x = 2 n / L - 1,

    exp(2 pi i psi(x)) = sum_k w_k exp(i pi o_k x)

to a stated error, so that the line is the sum of lines o_k bins of fs/L away with weights w_k.
The o_k are equally spaced, closer than a bin, about the middle of the phase's slope: exponentials
whose period is longer than the record (a Fourier extension), which converge geometrically for any
smooth phase without its being periodic. The w_k are least squares on Chebyshev nodes, from a
singular value decomposition that depends on the number of lines alone and is kept. Its factors
are applied one after the other: their product, the pseudo-inverse, would lose half the digits.
All sums are in an order of their own (a library's would depend on the number of its threads), and
no row's bits depend on the rows beside it.

Weights are referred to the middle of the record. Where C = 1/2 a e^{i (phi + pi nu r)} is a line
of :mod:`sweep.model.spectrum` at nu bins of fs/N, r = L/N, the lines that take its place are

    nu + s o_k N / L    with    C w_k  (s = +1),   C conj(w_k)  (s = -1, a line folded over)
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit

from sweep.model.elementary import sincos_cycles
from sweep.model.lanes import dot
from sweep.model.unsupported import UnsupportedShot

Phase = Callable[[np.ndarray], np.ndarray]
"""Phase error [cycles], (n, m), at places x of the record, (m,), -1..1."""

TOLERANCE = 1e-9
"""Largest error of exp(2 pi i psi) anywhere in the record."""

MOST_LINES = 800

CUTOFF = 1e-12
"""Least singular value, relative to the largest, that is made use of."""

_SLOPE_NODES = 129

_ORTHOGONAL = 1e-14
"""Cosine of the angle between two columns that counts as none."""

_MOST_SWEEPS = 60


class Split(NamedTuple):
    """Lines that take the place of each of n lines; rows with fewer than k end in zero weights."""

    offset: np.ndarray
    """(n, k): places from the line that is split [bins of fs/L]."""
    weight: np.ndarray
    """(n, k) complex: relative weights, referred to the middle of the record."""
    number: np.ndarray
    """(n,) int64: lines of each row that count."""
    error: np.ndarray
    """(n,): largest error of the phase factor seen between the nodes. A bin's error is at most
    this times sum |w| of the window, which is the peak for windows without negative samples."""


class _Fit(NamedTuple):
    nodes: np.ndarray
    checks: np.ndarray
    offset: np.ndarray
    to_modes: np.ndarray
    from_modes: np.ndarray
    at_checks: np.ndarray


def split_lines(phase: Phase, *, tolerance: float = TOLERANCE) -> Split:
    """Lines of which each of n lines with a phase error over the record is made up.

    Parameters
    ----------
    phase : callable
        Phase errors [cycles]; smooth. Those of several effects add.
    tolerance : float
        Error of the phase factor that may remain, 1e-11 at the least.

    Raises
    ------
    UnsupportedShot
        A phase error wanders over more bins than :data:`MOST_LINES` lines can stand for (some
        500), or is not smooth.

    Notes
    -----
    A drift of d bins (psi = d x^2 / 8) takes 7 lines for d = 0.001, 11 for 0.1, 21 for 1, 39 for
    5, 49 for 15 and some 1.6 d + 30 beyond.
    """
    centre, half = _slopes(phase)
    fits: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
    left = np.arange(centre.size)
    for lines, spacing in _ladder():
        inside = half[left] <= spacing * (lines - 1) / 2 + 0.01
        tried = left[inside]
        if not tried.size:
            continue
        fit = _fit(lines, spacing)
        weight, error = np.zeros((tried.size, lines), complex), np.zeros(tried.size)
        _fit_rows(
            _slow(phase, fit.nodes, centre, tried), _slow(phase, fit.checks, centre, tried),
            fit.to_modes, fit.from_modes, fit.at_checks, weight, error,
        )  # fmt: skip
        good = error <= tolerance
        offset = centre[tried[good], None] + fit.offset
        fits.append((tried[good], offset, weight[good], error[good]))
        left = np.concatenate([tried[~good], left[~inside]])
        if not left.size:
            return _assembled(fits, centre.size)
    raise UnsupportedShot(
        "range walk, acceleration and the errors of the chirp together spread a line over "
        f"{2 * half[left].max():.3g} bins within a record, and some 500 can be simulated: lower "
        "target.radial_velocity, target.acceleration or instrument.chirp.quadratic_error, "
        "cubic_error, sinusoidal_error or error_periods; or shorten the record by "
        "instrument.processing.fft_size"
    )


def fitted(
    values: Callable[[np.ndarray, np.ndarray], np.ndarray],
    rows: np.ndarray,
    lines: int,
    spacing: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lines of which real functions of the record are made up, whatever their error.

    Parameters
    ----------
    values : callable
        Functions (n, m) at places x (m,), given ``rows``.
    rows : (n,) ndarray
        Which functions.
    lines, spacing
        Lines, and bins of fs/L from one to the next.

    Returns
    -------
    offset, weight, error : (lines,), (n, lines) complex, (n,)
        As of :class:`Split`.
    """
    fit = _fit(lines, spacing)
    weight = np.zeros((rows.size, lines), complex)
    modes = np.zeros((rows.size, fit.to_modes.shape[1]), complex)
    for value, to_modes in zip(values(fit.nodes, rows).T, fit.to_modes, strict=True):
        modes += value[:, None] * to_modes  # in an order of its own
    for mode, from_modes in zip(modes.T, fit.from_modes, strict=True):
        weight += mode[:, None] * from_modes
    seen = np.zeros((rows.size, fit.checks.size), complex)
    for share, line in zip(weight.T, fit.at_checks.T, strict=True):
        seen += share[:, None] * line
    return fit.offset, weight, abs(seen - values(fit.checks, rows)).max(axis=1)


def _assembled(fits: list, size: int) -> Split:
    """Rows put back in order, ended with zero weights to one length."""
    most = max((offset.shape[1] for index, offset, *_ in fits if index.size), default=1)
    offset, weight = np.zeros((size, most)), np.zeros((size, most), complex)
    number, error = np.zeros(size, np.int64), np.zeros(size)
    for index, part, weights, errors in fits:
        lines = part.shape[1]
        offset[index, :lines], weight[index, :lines] = part, weights
        number[index], error[index] = lines, errors
    return Split(offset, weight, number, error)


def _slopes(phase: Phase) -> tuple[np.ndarray, np.ndarray]:
    """Middle and half width of the bins that the phase's slope covers, (n,) each."""
    x = np.cos(np.pi * np.arange(_SLOPE_NODES) / (_SLOPE_NODES - 1))[::-1]
    slope = 2 * np.diff(phase(x), axis=1) / np.diff(x)
    low, high = slope.min(axis=1), slope.max(axis=1)
    return (low + high) / 2, (high - low) / 2


def _slow(phase: Phase, x: np.ndarray, centre: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Phase of some rows at x [cycles], with the middle of its slope taken off."""
    return np.ascontiguousarray(phase(x)[rows] - centre[rows, None] * x / 2)


@njit(cache=True, error_model="numpy")
def _fit_rows(at_nodes, at_checks, to_modes, from_modes, lines, weight, error):
    """Weights of lines that make up phase factors, and the largest error at the checks.

    Parameters
    ----------
    at_nodes, at_checks : (m, nodes) and (m, checks) float64
        Phases [cycles].
    to_modes, from_modes, lines : (nodes, modes), (modes, k) and (checks, k) complex
        Of :class:`_Fit`.
    weight, error : (m, k) complex, (m,) float64
        Results, zero at first.
    """
    modes = np.empty(to_modes.shape[1], np.complex128)
    for row in range(weight.shape[0]):
        modes[:] = 0.0
        for i in range(to_modes.shape[0]):
            sine, cosine = sincos_cycles(at_nodes[row, i])
            factor = complex(cosine, sine)
            for m in range(modes.size):
                modes[m] += factor * to_modes[i, m]
        for m in range(modes.size):
            for k in range(weight.shape[1]):
                weight[row, k] += modes[m] * from_modes[m, k]
        for i in range(lines.shape[0]):
            sine, cosine = sincos_cycles(at_checks[row, i])
            missing = complex(-cosine, -sine)
            for k in range(weight.shape[1]):
                missing += weight[row, k] * lines[i, k]
            error[row] = max(error[row], abs(missing))


@lru_cache(maxsize=1)
def _ladder() -> tuple[tuple[int, float], ...]:
    """Numbers of lines to try in turn, all odd, and their spacing [bins].

    The gentler the phase, the closer its lines: nearly polynomials.
    """
    steps = [
        (1, 1.0),
        (3, 0.2),
        (5, 0.2),
        (7, 0.2),
        (9, 0.2),
        (11, 0.25),
        (15, 0.35),
        (21, 0.5),
        (31, 0.65),
    ]
    while (lines := int(1.25 * steps[-1][0]) | 1) <= MOST_LINES:
        steps.append((lines, 0.65 if lines < 60 else 0.8))
    return tuple(steps)


@lru_cache(maxsize=32)
def _fit(lines: int, spacing: float) -> _Fit:
    """Nodes, places to check at, offsets, the decomposition, and the lines at the checks.

    Nodes and offsets lie symmetrically, so that cosines and sines are fitted apart: two real
    decompositions of half the size.
    """
    above = spacing * np.arange(1, lines // 2 + 1)
    offset = np.concatenate([above, [0.0], -above])
    half = int(1.3 * np.pi * above.size * spacing + lines + 9) // 2
    right = np.cos(np.pi * (np.arange(half) + 0.5) / (2 * half))
    turn = np.pi * np.outer(right, above)
    even = np.hstack([2 * np.cos(turn), np.full((half, 1), math.sqrt(2))])
    halves = [(even, 1.0)] + ([(2 * np.sin(turn), -1.0)] if above.size else [])
    to_modes, from_modes, values = [], [], []
    for matrix, parity in halves:
        u, s, v = _decomposed(matrix)
        root = math.sqrt(2) if parity > 0 else math.sqrt(2) * 1j  # sines come with an i
        side = v[:, : above.size] / math.sqrt(2)
        centre = v[:, above.size :] if parity > 0 else np.zeros((s.size, 1))
        to_modes.append(np.vstack([u, parity * u]) / root)
        from_modes.append(np.hstack([side, centre, parity * side]))
        values.append(s)
    size = np.concatenate(values)
    kept = size > CUTOFF * size.max()
    checks = np.cos(np.pi * np.arange(2 * half + 1) / (2 * half))
    return _Fit(
        np.concatenate([right, -right]),
        checks,
        offset,
        np.ascontiguousarray(np.hstack(to_modes)[:, kept] / size[kept]),
        np.vstack(from_modes)[kept] + 0j,
        np.exp(1j * np.pi * np.outer(checks, offset)),
    )


def _decomposed(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u, s, v with u diag(s) v = matrix (m, n), m >= n: (m, n), (n,), (n, n); s in no order."""
    columns, turned = matrix.T.copy(), np.eye(matrix.shape[1])
    _orthogonalise(columns, turned)
    s = np.sqrt((columns**2).sum(axis=1))
    return (columns / np.maximum(s, 1e-300)[:, None]).T, s, turned


@njit(cache=True, error_model="numpy")
def _orthogonalise(columns, turned):
    """Rotates rows of columns (n, m), two at a time, until all are orthogonal; `turned` likewise.

    Hestenes's and Jacobi's way to singular values, exact to rounding for the smallest ones too.
    """
    n, m = columns.shape
    for _ in range(_MOST_SWEEPS):
        rotated = False
        for p in range(n - 1):
            for q in range(p + 1, n):
                one, other = columns[p], columns[q]
                a, b, c = dot(one, one, m), dot(other, other, m), dot(one, other, m)
                if not abs(c) > _ORTHOGONAL * math.sqrt(a * b):
                    continue
                rotated = True
                zeta = (b - a) / (2.0 * c)
                tangent = math.copysign(1.0, zeta) / (abs(zeta) + math.hypot(1.0, zeta))
                cosine = 1.0 / math.hypot(1.0, tangent)
                _rotate(one, other, cosine, cosine * tangent)
                _rotate(turned[p], turned[q], cosine, cosine * tangent)
        if not rotated:
            return


@njit(cache=True, error_model="numpy")
def _rotate(one, other, cosine, sine):
    for i in range(one.size):
        x, y = one[i], other[i]
        one[i] = cosine * x - sine * y
        other[i] = sine * x + cosine * y
