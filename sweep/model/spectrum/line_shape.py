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
(:func:`build_late_line_shape`).
"""

import math
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial.chebyshev import cheb2poly, chebfit
from scipy.special import i0

from sweep.kernel_cache import njit
from sweep.model.elementary_functions import sincos_cycles
from sweep.model.window import COSINE_SUM_COEFFICIENTS, Window, window_samples

CELLS_PER_BIN = (2, 4)
"""Cells of the table in a bin of fs/N, for amplitudes and for powers."""

KERNEL_CELLS = 14
"""Cells among which a line is shared out: -6 .. 7 beside its place between 0 and 1."""

KERNEL_BETA = 32.32432
"""Parameter of the kernel I_0(b sqrt(1 - (2 z / POINTS)^2)) / I_0(b) over z cells."""

DECONVOLUTION_TAPS = np.array([
    27.059814524108916, -24.069297462538476, 18.21886188994693, -12.301303141361002,
    7.584228285544723, -4.313600790782408, 2.270108868623467, -1.1041027145184494,
    0.49429836881691397, -0.2024309201966936, 0.07519960545439297, -0.025063737807734597,
    0.007388544649665242, -0.0018900276225103194, 0.0004085782830266439, -7.179287548481712e-05,
    9.634021822884657e-06, -8.798393952475983e-07, 4.1136322681806606e-08,
])  # fmt: skip
"""Even filter over cells whose transform is 1 over the kernel's, to 1e-13 below pi / 2."""

MODE_TIERS = ((24, 20, 64), (48, 56, 96), (128, 200, 256))
"""Modes at the most; bins of fs/L beyond which the record's ends then tell a shape; bins that its
table holds on either side, where few points share it."""

SHARED_TABLE_BINS = 256
"""Bins that it holds where many do: wide footprints are then served by it."""

END_DERIVATIVES_MAX = 12
"""Derivatives at the record's ends."""

MODE_SIZE_MIN = 1e-13
"""Size below which modes are left out, relative to the record."""

_RECORD_LENGTH_MIN, _PADDING_MAX = 4096, 8
"""Samples of a record, and its padding N/L, between which sums over it are integrals."""

_N_FAR_DISTANCES = 48
"""Distances at which the envelope is known beyond the table."""

_ENVELOPE_MARGIN = 1.05
"""On the envelope, for what happens between cells."""

_TAP_REACH_CELLS = DECONVOLUTION_TAPS.size - 1
"""Cells on either side of a table that its filter looks at."""

KERNEL_DEGREE = 13

ZERO_WEIGHT_CELLS = 2
"""Cells of no weight beyond those among which a line is shared out, for whole vectors."""

LENGTH_CLASS_RATIO = math.sqrt(2.0)
"""Most to least samples of the echoes whose shapes share a table's width."""

_LATE_SAMPLES_PER_BIN_MIN = 16
"""Least samples of an echo to the bins of fs/L' in its table: sums over it are then integrals and
six of Euler and Maclaurin's corrections."""

_LATE_TABLE_MARGIN_BINS = 16
"""Bins of fs/L' by which the table of such an echo holds more than those that its ends do not tell:
as many as lines that are shared out together need."""

_LATE_PADDING_MAX = 16
"""Most padding N/L' of an echo whose shape is made of modes."""

_LATE_VALUES_PER_BIN = 2
"""Tabulated values in a bin of fs/L'."""

EULER_MACLAURIN_COEFFICIENTS = {
    1: 1 / 12, 3: -1 / 720, 5: 1 / 30240, 7: -1 / 1209600, 9: 1 / 47900160,
    11: -691 / 1307674368000,
}  # fmt: skip
"""B_(m+1) / (m+1)! by the order m of the derivatives at the ends."""

_EULER_MACLAURIN_ORDER_MAX = max(EULER_MACLAURIN_COEFFICIENTS)


class LineShapeTables(NamedTuple):
    """Line shapes of one window and FFT, as the compiled code takes them; see `segments`."""

    layout: np.ndarray
    """(7,) int64: FFT size N, window length L, bins T of the table on either side, cells a bin,
    whether the table is of powers, whether it holds all bins; bins beyond which ends tell."""
    mode_transforms: np.ndarray
    """(modes, places): of each mode the real (even modes) or imaginary part (odd ones), by cell,
    that does not come from the record's first sample. Of amplitudes then, in further places, what
    this comes to in a table."""
    first_sample_terms: np.ndarray
    """(2, places): the window's first sample times cos and sin of pi r y, and likewise."""
    end_polynomials: np.ndarray
    """(modes, 4, DERIVATIVES + 2): real and imaginary parts of A and of B, lowest power first."""
    envelope_distances: np.ndarray
    """(2, m): distances d [bins of fs/N] at which the envelope is known; cot(pi d / N)."""
    full_tables: np.ndarray
    """(segments, 2, cells * columns): tables that hold all bins; else empty."""
    full_envelopes: np.ndarray
    """(segments, 2, m): their envelopes, as of :func:`build_line_shape`; else empty."""
    echo_lengths: np.ndarray
    """(segments, shapes) int64: samples of the record that the echo has, where these are not all
    and shapes are made of modes; else empty. ``mode_transforms`` then are transforms over u = -U ..
    U, in steps of half a bin of fs/L', with the kernel divided out."""
    taylor_coefficients: np.ndarray
    """(modes, DERIVATIVES + 1): Taylor's coefficients of such modes at x = 1; else empty."""


_NO_LATE_TABLES = np.empty((0, 0), np.int64), np.empty((0, 0))
"""Of shapes of echoes that have all samples of the record."""

_gauss_legendre = lru_cache(maxsize=8)(np.polynomial.legendre.leggauss)


@lru_cache(maxsize=24)
def line_shape_tables(
    window: Window, fft_size: int, adds_powers: bool, tier: int, *, shared: bool = True
) -> LineShapeTables:
    """Prepare the tables from which shapes of up to some modes (:data:`MODE_TIERS`) are built."""
    n_modes, clearance_bins, table_half_width = MODE_TIERS[tier]
    table_half_width = SHARED_TABLE_BINS if shared else table_half_width
    ratio, length = window.length / fft_size, window.length
    table_bins = math.ceil(table_half_width / ratio)
    cell_distances = _cell_distances(table_bins, adds_powers)
    n_nodes = 4 * ((math.ceil(math.pi * table_half_width) + n_modes) // 4) + 64
    node, weight = _gauss_legendre(n_nodes)
    cosine_coefficients = np.array(
        [float(coefficient) for coefficient in COSINE_SUM_COEFFICIENTS[window.name]]
    )
    w = np.cos(np.pi * np.outer(node, np.arange(cosine_coefficients.size))) @ np.diag(
        cosine_coefficients
    )
    weighted_modes = np.cos(np.outer(np.arange(n_modes), np.arccos(node))) * (
        w.sum(axis=1) * weight * length / 2
    )
    mode_transforms = _mode_integrals(weighted_modes, node, ratio * cell_distances)
    taylor_coefficients = _taylor_coefficients(COSINE_SUM_COEFFICIENTS[window.name], n_modes)
    mode_transforms += _euler_maclaurin_corrections(
        taylor_coefficients, ratio * cell_distances, length
    )
    first_sample_terms = taylor_coefficients[0, 0] * np.array(
        [np.cos(np.pi * ratio * cell_distances), np.sin(np.pi * ratio * cell_distances)]
    )
    if not adds_powers:
        mode_transforms, first_sample_terms = (
            np.hstack([values, _deconvolve_into_rows(values, CELLS_PER_BIN[adds_powers])])
            for values in (mode_transforms, first_sample_terms)
        )
    layout = [
        fft_size,
        length,
        table_bins,
        CELLS_PER_BIN[adds_powers],
        adds_powers,
        False,
        math.ceil(clearance_bins / ratio),
    ]
    end_polynomials, envelope_distances, no_tables = (
        _end_polynomials(taylor_coefficients, length),
        _envelope_distances(table_bins, fft_size),
        np.empty((0, 2, 0)),
    )
    return LineShapeTables(
        np.array(layout),
        mode_transforms,
        first_sample_terms,
        end_polynomials,
        envelope_distances,
        no_tables,
        no_tables,
        *_NO_LATE_TABLES,
    )


def late_length_class(window: Window, length_min: np.ndarray) -> np.ndarray:
    """Class of a late echo's length: powers of :data:`LENGTH_CLASS_RATIO` below all samples."""
    ratio = window.length / np.maximum(length_min, 1)
    return np.ceil(np.log(ratio) / math.log(LENGTH_CLASS_RATIO) - 1e-9).astype(np.int64)


def late_echo_has_modes(
    window: Window, fft_size: int, tier: int, length_min: np.ndarray, length_max: np.ndarray
) -> np.ndarray:
    """Return true for echoes of some samples whose shapes may be made of modes, (n,).

    ``length_min`` and ``length_max`` are the samples of the segments that have fewest and most.
    """
    if window.name not in COSINE_SUM_COEFFICIENTS:
        return np.zeros(length_min.shape, np.bool_)
    table_half_width = MODE_TIERS[tier][1] + _LATE_TABLE_MARGIN_BINS
    is_long_enough = (length_min >= _LATE_SAMPLES_PER_BIN_MIN * table_half_width) & (
        length_min * _LATE_PADDING_MAX >= fft_size
    )
    class_length_max = window.length * LENGTH_CLASS_RATIO ** (
        1.0 - late_length_class(window, length_min)
    )
    return np.asarray(is_long_enough & (length_max <= 1.01 * class_length_max))


def late_window_samples(
    window: Window, late_position: np.ndarray, n_samples: np.ndarray
) -> np.ndarray:
    """Window (*length, x) at positions x, -1 .. 1, of the record's last ``n_samples`` samples."""
    fraction = np.asarray(n_samples)[..., None] / window.length
    record_position = 1.0 - fraction * (1.0 - late_position)
    coefficients = [float(coefficient) for coefficient in COSINE_SUM_COEFFICIENTS[window.name]]
    return np.asarray(
        sum(
            coefficient * np.cos(np.pi * m * record_position)
            for m, coefficient in enumerate(coefficients)
        )
    )


@lru_cache(maxsize=48)
def late_line_shape_tables(
    window: Window, fft_size: int, adds_powers: bool, tier: int, length_class: int
) -> LineShapeTables:
    """Prepare the tables for echoes that have part of a record's samples, of a class of them."""
    clearance_bins = MODE_TIERS[tier][1]
    table_half_width = clearance_bins + _LATE_TABLE_MARGIN_BINS
    filled_fraction = window.length * LENGTH_CLASS_RATIO ** (-float(length_class)) / fft_size
    table_bins = math.ceil(table_half_width / filled_fraction)
    layout = [
        fft_size,
        window.length,
        table_bins,
        CELLS_PER_BIN[adds_powers],
        adds_powers,
        False,
        math.ceil(clearance_bins / filled_fraction),
    ]
    mode_transforms, taylor_coefficients = _late_mode_transforms(tier)
    no_tables, no_polynomials = np.empty((0, 2, 0)), np.empty((0, 4, 1))
    envelope_distances = _envelope_distances(table_bins, fft_size)
    return LineShapeTables(
        np.array(layout),
        mode_transforms,
        np.empty((2, 0)),
        no_polynomials,
        envelope_distances,
        no_tables,
        no_tables,
        np.empty((0, 0), np.int64),
        taylor_coefficients,
    )


@lru_cache(maxsize=len(MODE_TIERS))
def _late_mode_transforms(tier: int) -> tuple[np.ndarray, np.ndarray]:
    """Half the integrals of T_j(x) exp(-i pi u x) with the kernel divided out; their Taylor."""
    n_modes, clearance_bins, _ = MODE_TIERS[tier]
    half_count = math.ceil(
        (1.02 * LENGTH_CLASS_RATIO * (clearance_bins + _LATE_TABLE_MARGIN_BINS) + 14)
        * _LATE_VALUES_PER_BIN
        + KERNEL_CELLS
    )
    frequency = np.arange(-half_count, half_count + 1) / _LATE_VALUES_PER_BIN
    n_nodes = 4 * ((math.ceil(math.pi * frequency[-1]) + n_modes) // 4) + 96
    node, weight = _gauss_legendre(n_nodes)
    weighted_modes = np.cos(np.outer(np.arange(n_modes), np.arccos(node))) * weight / 2
    return _mode_integrals(
        weighted_modes / spreading_kernel_transform(np.pi / _LATE_VALUES_PER_BIN * node),
        node,
        frequency,
    ), _taylor_coefficients(("1",), n_modes)


def window_has_modes(window: Window, fft_size: int) -> bool:
    """Return true if a window's shapes are made of modes; else they have tables of all bins."""
    is_long_enough = (
        window.length >= _RECORD_LENGTH_MIN and window.length * _PADDING_MAX >= fft_size
    )
    return is_long_enough and window.name in COSINE_SUM_COEFFICIENTS


def full_line_shape_tables(
    window: Window,
    fft_size: int,
    adds_powers: bool,
    phase: np.ndarray,
    first_sample: np.ndarray | None = None,
) -> LineShapeTables:
    """Shapes that have tables of all bins, of phase errors [cycles] by segment, (segments, L).

    ``first_sample`` (segments,) is the first sample that the echo has, by default 0.
    """
    cells_per_bin, nyquist_bin, length = CELLS_PER_BIN[adds_powers], fft_size // 2, window.length
    n_cells = cells_per_bin * fft_size
    cell_index = (np.arange(fft_size) - nyquist_bin) * cells_per_bin - np.arange(cells_per_bin)[
        :, None
    ]
    phase_factor = np.exp(1j * np.pi * (length / fft_size / cells_per_bin) * cell_index)
    full_tables = np.empty((len(phase), 2, n_cells))
    envelope_distances = _envelope_distances(nyquist_bin, fft_size)
    full_envelopes = np.zeros((len(phase), 2, envelope_distances.shape[1]))
    w, record_position = window_samples(window.name, length), 2 * np.arange(length) / length - 1
    first_samples = np.zeros(len(phase), np.int64) if first_sample is None else first_sample
    for table, envelope, psi, begin_sample in zip(
        full_tables, full_envelopes, phase, first_samples, strict=True
    ):
        record = w * np.exp(2j * np.pi * (psi - np.rint(psi)))
        record[:begin_sample] = 0.0
        squared_magnitude = np.abs(np.fft.fft(record, n_cells)) ** 2
        _fill_full_envelope(squared_magnitude, cells_per_bin, envelope)
        if adds_powers:
            deconvolved = DECONVOLUTION_TAPS[0] * squared_magnitude
            for k in range(1, DECONVOLUTION_TAPS.size):
                deconvolved += DECONVOLUTION_TAPS[k] * (
                    np.roll(squared_magnitude, k) + np.roll(squared_magnitude, -k)
                )
            table[0], table[1] = deconvolved[cell_index % n_cells].ravel(), 0.0
        else:
            record /= spreading_kernel_transform(
                np.pi * (length / fft_size / cells_per_bin) * record_position
            )
            deconvolved = (np.fft.fft(record, n_cells)[cell_index % n_cells] * phase_factor).ravel()
            table[0], table[1] = deconvolved.real, deconvolved.imag
    layout = np.array(
        [fft_size, length, nyquist_bin, cells_per_bin, adds_powers, True, nyquist_bin]
    )
    no_tables = np.empty((0, 0)), np.empty((2, 0)), np.empty((0, 4, 1))
    return LineShapeTables(
        layout, *no_tables, envelope_distances, full_tables, full_envelopes, *_NO_LATE_TABLES
    )


def _fill_full_envelope(
    squared_magnitude: np.ndarray, cells_per_bin: int, envelope: np.ndarray
) -> None:
    """Envelope of |G|^2 at all cells of the circle."""
    paired = squared_magnitude + np.maximum(
        np.roll(squared_magnitude, cells_per_bin // 2),
        np.roll(squared_magnitude, -(cells_per_bin // 2)),
    )
    half_count = squared_magnitude.size // 2
    folded = np.maximum(paired[: half_count + 1], paired[-np.arange(half_count + 1)])
    maximum_beyond = np.maximum.accumulate(folded[::-1])[::-1]
    maximum_beyond = maximum_beyond[
        np.maximum(np.arange(0, half_count + 1, cells_per_bin) - 1, 0)
    ]  # from the cell before on
    maximum_beyond *= _ENVELOPE_MARGIN**2
    envelope[0, : maximum_beyond.size] = np.sqrt(maximum_beyond)
    step_areas = 0.5 * (maximum_beyond + np.append(maximum_beyond[1:], 0.0))
    envelope[1, : maximum_beyond.size] = np.cumsum(step_areas[::-1])[::-1]


def spreading_kernel(cell_distance: np.ndarray) -> np.ndarray:
    """Evaluate the kernel that shares lines out among cells, at z cells, |z| <= POINTS / 2."""
    root = np.sqrt(np.maximum(1 - (2 * cell_distance / KERNEL_CELLS) ** 2, 0.0))
    return np.asarray(i0(KERNEL_BETA * root) / i0(KERNEL_BETA))


_kernel_coordinate = np.cos(np.pi * (np.arange(KERNEL_DEGREE + 1) + 0.5) / (KERNEL_DEGREE + 1))
KERNEL_BASIS = np.zeros((KERNEL_DEGREE + 1, KERNEL_CELLS + ZERO_WEIGHT_CELLS))
"""Polynomials of the kernel, by power of s = -1 .. 1 across a cell and by cell."""

for _j in range(KERNEL_CELLS):
    KERNEL_BASIS[:, _j] = cheb2poly(
        chebfit(
            _kernel_coordinate,
            spreading_kernel((_kernel_coordinate + 1) / 2 - _j + KERNEL_CELLS // 2 - 1),
            KERNEL_DEGREE,
        )
    )


def spreading_kernel_transform(theta: np.ndarray) -> np.ndarray:
    """Its transform at theta radians a cell, |theta| <= pi."""
    root = np.sqrt(KERNEL_BETA**2 - (KERNEL_CELLS * theta / 2) ** 2)
    return np.asarray(KERNEL_CELLS * np.sinh(root) / root / i0(KERNEL_BETA))


def table_row_size(layout: np.ndarray) -> int:
    """Numbers in a row of a table of these sizes."""
    return int(layout[3] * (layout[0] if layout[5] else 2 * layout[2] + 1))


def chebyshev_nodes(n_nodes: int) -> np.ndarray:
    """Places in the record, -1 .. 1, at which phase errors are taken to find modes, (nodes,)."""
    return np.cos(np.pi * (np.arange(n_nodes) + 0.5) / n_nodes)


@lru_cache(maxsize=8)
def chebyshev_coefficient_matrix(n_nodes: int) -> np.ndarray:
    """Chebyshev coefficients from values at :func:`chebyshev_nodes`, (nodes, coefficients)."""
    matrix = 2 / n_nodes * np.cos(np.outer(np.arccos(chebyshev_nodes(n_nodes)), np.arange(n_nodes)))
    matrix[:, 0] /= 2
    return matrix


def _cell_distances(table_bins: int, adds_powers: bool) -> np.ndarray:
    """Distances y of a table's cells from their line, and of those that its filter looks at."""
    cells_per_bin = CELLS_PER_BIN[adds_powers]
    return (
        np.arange(
            -table_bins * cells_per_bin - cells_per_bin + 1 - _TAP_REACH_CELLS,
            table_bins * cells_per_bin + _TAP_REACH_CELLS + 1,
        )
        / cells_per_bin
    )


def _deconvolve_into_rows(values: np.ndarray, cells_per_bin: int) -> np.ndarray:
    """Values at :func:`_cell_distances` with the kernel divided out, in rows by cell of a bin."""
    n_inner = values.shape[1] - 2 * _TAP_REACH_CELLS
    filtered = DECONVOLUTION_TAPS[0] * values[:, _TAP_REACH_CELLS : _TAP_REACH_CELLS + n_inner]
    for k in range(1, DECONVOLUTION_TAPS.size):
        for start in (_TAP_REACH_CELLS - k, _TAP_REACH_CELLS + k):
            filtered += DECONVOLUTION_TAPS[k] * values[:, start : start + n_inner]
    rows = [filtered[:, cells_per_bin - 1 - m :: cells_per_bin] for m in range(cells_per_bin)]
    return np.hstack(rows)


def _envelope_distances(table_bins: int, fft_size: int) -> np.ndarray:
    """Distances at which envelopes are known: each bin of the table, then in even ratios."""
    far_distances = np.geomspace(
        table_bins + 1, max(fft_size / 2, table_bins + 2), _N_FAR_DISTANCES
    )
    distances = np.append(np.arange(table_bins + 1.0), far_distances)
    with np.errstate(divide="ignore"):
        return np.array([distances, 1 / np.tan(np.pi * distances / fft_size)])


@njit(cache=True, error_model="numpy")
def _mode_integrals(weighted_modes, node, distance):
    """Real (even modes) or imaginary part (odd ones) of sums over nodes x, (modes, places)."""
    integrals = np.zeros((weighted_modes.shape[0], distance.size))
    cosine, sine = np.empty(distance.size), np.empty(distance.size)
    for k in range(node.size):
        for i in range(distance.size):
            sine[i], cosine[i] = sincos_cycles(-0.5 * distance[i] * node[k])
        for j in range(weighted_modes.shape[0]):
            factor = weighted_modes[j, k]
            sine_or_cosine = sine if j & 1 else cosine
            for i in range(distance.size):
                integrals[j, i] += factor * sine_or_cosine[i]
    return integrals


def _taylor_coefficients(coefficient_texts: tuple[str, ...], n_modes: int) -> np.ndarray:
    """Taylor's coefficients of w T_j at the record's end x = 1, (modes, DERIVATIVES + 1).

    What the cosines add up to there may be next to nothing: their sums are exact.
    """
    order = np.arange(END_DERIVATIVES_MAX + 1)
    even = np.where(order % 2 == 0, (-1.0) ** (order // 2), 0.0)
    exact_sums = [
        sum(
            (-1) ** m * m**i * Fraction(coefficient_text)
            for m, coefficient_text in enumerate(coefficient_texts)
        )
        for i in order.tolist()
    ]
    window_coefficients = (
        even
        * np.array([float(exact_sum) / math.factorial(i) for i, exact_sum in enumerate(exact_sums)])
        * np.pi**order
    )
    j = np.arange(n_modes, dtype=float)[:, None]
    ratio = (j * j - order[:-1] ** 2) / (2 * order[:-1] + 1) / (order[:-1] + 1)
    mode_coefficients = np.cumprod(np.hstack([np.ones((n_modes, 1)), ratio]), axis=1)
    coefficients = np.zeros((n_modes, END_DERIVATIVES_MAX + 1))
    for i in range(END_DERIVATIVES_MAX + 1):
        coefficients[:, i:] += (
            window_coefficients[i] * mode_coefficients[:, : END_DERIVATIVES_MAX + 1 - i]
        )
    return coefficients


def _euler_maclaurin_corrections(
    taylor_coefficients: np.ndarray, distance: np.ndarray, length: int
) -> np.ndarray:
    """Compute the excess of sums over integrals (Euler and Maclaurin), (modes, places)."""
    bernoulli = {1: 1 / 12, 3: -1 / 720, 5: 1 / 30240}
    phase_factor = np.exp(-1j * np.pi * distance)
    parity = (-1.0) ** np.arange(len(taylor_coefficients))[:, None]
    corrections = np.zeros((len(taylor_coefficients), distance.size), complex)
    for m, coefficient in bernoulli.items():
        for i in range(m + 1):
            # d^m/dx^m of w T_j e^{-i pi y x}, at x = 1 less that at x = -1
            derivative_factor = (
                math.comb(m, i) * math.factorial(i) * (-1j * np.pi * distance) ** (m - i)
            )
            end_difference = phase_factor - (-1) ** i * parity * np.conj(phase_factor)
            corrections += (
                coefficient
                * (2 / length) ** m
                * taylor_coefficients[:, i : i + 1]
                * derivative_factor
                * end_difference
            )
    return np.where(parity > 0, corrections.real, corrections.imag)


def _power_sum_polynomials() -> np.ndarray:
    """Compute sums of n^j e^{-i theta n} as polynomials in cot(theta / 2), by j and power."""
    n_coefficients = END_DERIVATIVES_MAX + 2
    sums = np.zeros((END_DERIVATIVES_MAX + 1, n_coefficients), complex)
    sums[0, :2] = 0.5, -0.5j
    for j in range(END_DERIVATIVES_MAX):
        derivative = sums[j, 1:] * np.arange(1, n_coefficients)
        sums[j + 1, : n_coefficients - 1] -= 0.5j * derivative
        sums[j + 1, 2:] -= 0.5j * derivative[: n_coefficients - 2]
    return sums


_POWER_SUMS = _power_sum_polynomials()
_POWER_SUMS_RE, _POWER_SUMS_IM = (
    np.ascontiguousarray(_POWER_SUMS.real),
    np.ascontiguousarray(_POWER_SUMS.imag),
)

_CORRECTION_FACTORS = np.zeros((_EULER_MACLAURIN_ORDER_MAX + 1, _EULER_MACLAURIN_ORDER_MAX + 1))
"""Factors of Taylor's coefficients i at an end in the power d of -i theta of its correction."""

for _m, _coefficient in EULER_MACLAURIN_COEFFICIENTS.items():
    for _i in range(_m + 1):
        _CORRECTION_FACTORS[_m - _i, _i] += _coefficient * math.comb(_m, _i) * math.factorial(_i)


def _end_polynomials(taylor_coefficients: np.ndarray, length: int) -> np.ndarray:
    """Polynomials A and B of modes, (modes, 4, DERIVATIVES + 2)."""
    power_sums = _POWER_SUMS
    step_powers = (2 / length) ** np.arange(END_DERIVATIVES_MAX + 1)
    polynomial_last = ((taylor_coefficients * step_powers)[:, :, None] * power_sums).sum(axis=1)
    parity = (-1.0) ** (
        np.arange(len(taylor_coefficients))[:, None] + np.arange(END_DERIVATIVES_MAX + 1)
    )
    polynomial_first = ((taylor_coefficients * step_powers * parity)[:, :, None] * power_sums).sum(
        axis=1
    )
    return np.stack(
        [polynomial_first.real, polynomial_first.imag, polynomial_last.real, polynomial_last.imag],
        axis=1,
    )


@njit(cache=True, error_model="numpy")
def decompose_phase_errors(
    phase, window_values, coefficient_matrix, line_shift, mode_coefficients, n_modes
):
    """Take phase errors, and a window beside them, apart.

    ``phase`` (segments, n, nodes) [cycles] is at :func:`chebyshev_nodes`, and so is the window
    ``window_values``, of the same shape or empty where it is not among the modes;
    ``coefficient_matrix`` is
    :func:`chebyshev_coefficient_matrix`. Results: ``line_shift`` (segments, n), shift of the line
    [bins of fs/L]. ``mode_coefficients``
    (segments, n, 2, >= nodes // 2), real and imaginary parts of the modes. ``n_modes`` (segments,
    n), modes that count, 0 where half as many as there are nodes are too few.
    """
    n_nodes = coefficient_matrix.shape[0]
    coefficients_re, coefficients_im = np.empty(n_nodes), np.empty(n_nodes)
    for s in range(phase.shape[0]):
        for i in range(phase.shape[1]):
            slope = 0.0
            for k in range(n_nodes):
                slope += coefficient_matrix[k, 1] * phase[s, i, k]
            line_shift[s, i] = 2.0 * slope
            coefficients_re[:] = 0.0
            coefficients_im[:] = 0.0
            for k in range(n_nodes):
                node = 0.5 * n_nodes * coefficient_matrix[k, 1]
                sine, cosine = sincos_cycles(phase[s, i, k] - slope * node)
                if window_values.size:
                    sine, cosine = sine * window_values[s, i, k], cosine * window_values[s, i, k]
                for j in range(n_nodes):
                    coefficients_re[j] += coefficient_matrix[k, j] * cosine
                    coefficients_im[j] += coefficient_matrix[k, j] * sine
            count = n_nodes
            while (
                count > 1
                and abs(coefficients_re[count - 1]) + abs(coefficients_im[count - 1])
                < MODE_SIZE_MIN
            ):
                count -= 1
            n_modes[s, i] = count if count <= n_nodes // 2 else 0
            for j in range(min(count, n_nodes // 2)):
                mode_coefficients[s, i, 0, j], mode_coefficients[s, i, 1, j] = (
                    coefficients_re[j],
                    coefficients_im[j],
                )


@njit(cache=True, error_model="numpy")
def build_line_shape(segment, shape_and_previous, shape_modes, tables, table, outline):
    """Build a shape from its modes, or take it from a table that holds all bins.

    ``shape_and_previous``: the shape's, and that of the one that stands in the results, or -1.
    ``shape_modes``:
    modes (segments, shapes, 2, modes) second, and third how many count (segments, shapes).
    ``tables``: tables to build from. Results: ``table`` (2, cells * columns), G, or |G|^2 in the
    first row. ``outline`` (7, >= m), in rows 1 and 2 the most that |G| comes to from each of m
    distances on, and the integral of its square. The other rows have A and B of DERIVATIVES + 2
    terms.
    """
    layout, mode_transforms, first_sample_terms, mode_end_polynomials, envelope_distances = (
        tables[0],
        tables[1],
        tables[2],
        tables[3],
        tables[4],
    )
    shape_index, previous_index = shape_and_previous
    mode_re, mode_im = (
        shape_modes[1][segment, shape_index, 0],
        shape_modes[1][segment, shape_index, 1],
    )
    count = shape_modes[2][segment, shape_index]
    if previous_index >= 0 and count == 1 and shape_modes[2][segment, previous_index] == 1:
        previous_mode = shape_modes[1][segment, previous_index]
        if previous_mode[0, 0] == mode_re[0] and previous_mode[1, 0] == mode_im[0]:
            return
    envelope, end_polynomials = outline[1:3], outline[3:7, : END_DERIVATIVES_MAX + 2]
    adds_powers = layout[4] != 0
    if layout[5]:
        for i in range(2):
            for k in range(table.shape[1]):
                table[i, k] = tables[5][segment, i, k]
            for k in range(envelope.shape[1]):
                envelope[i, k] = tables[6][segment, i, k]
        return
    even_re, even_im, odd_re, odd_im = 0.0, 0.0, 0.0, 0.0  # T_j is 1 at the end, +-1 at the start
    n_values = mode_transforms.shape[1]
    transform = np.zeros((2, n_values))
    end_polynomials[:] = 0.0
    for j in range(count):
        a, b = mode_re[j], mode_im[j]
        if j & 1:
            odd_re, odd_im = odd_re + a, odd_im + b
            a, b = -b, a
        else:
            even_re, even_im = even_re + a, even_im + b
        for i in range(n_values):
            transform[0, i] += a * mode_transforms[j, i]
            transform[1, i] += b * mode_transforms[j, i]
        for k in range(0, 4, 2):
            for d in range(end_polynomials.shape[1]):
                previous_mode, polynomial_im = (
                    mode_end_polynomials[j, k, d],
                    mode_end_polynomials[j, k + 1, d],
                )
                end_polynomials[k, d] += mode_re[j] * previous_mode - mode_im[j] * polynomial_im
                end_polynomials[k + 1, d] += mode_re[j] * polynomial_im + mode_im[j] * previous_mode
    # The record's first sample counts whole, its end not at all.
    for i in range(n_values):
        cosine, sine = first_sample_terms[0, i], first_sample_terms[1, i]
        transform[0, i] -= odd_re * cosine + even_im * sine
        transform[1, i] += even_re * sine - odd_im * cosine
    count = (
        n_values if adds_powers else n_values - table.shape[1]
    )  # places on either side of the line
    for i in range(table.shape[1] * (not adds_powers)):
        table[0, i], table[1, i] = transform[0, count + i], transform[1, count + i]
    for i in range(count):
        transform[0, i] = transform[0, i] * transform[0, i] + transform[1, i] * transform[1, i]
    if adds_powers:
        _fill_table_row(transform[0], layout, table[0])
    _fill_envelope(transform[0, :count], end_polynomials, layout, envelope_distances, envelope)


@njit(cache=True, error_model="numpy", borrows=True)
def first_segment_of_same_shape(segment, shape_index, shape_modes, echo_lengths, segment_exists):
    """First earlier segment whose shape is the same, -1 for none."""
    n_modes = shape_modes[2][segment, shape_index]
    for s in range(segment):
        if (
            not segment_exists[s]
            or echo_lengths[s, shape_index] != echo_lengths[segment, shape_index]
        ):
            continue
        is_same = shape_modes[2][s, shape_index] == n_modes
        for j in range(n_modes):
            is_same &= (
                shape_modes[1][s, shape_index, 0, j] == shape_modes[1][segment, shape_index, 0, j]
            )
            is_same &= (
                shape_modes[1][s, shape_index, 1, j] == shape_modes[1][segment, shape_index, 1, j]
            )
        if is_same:
            return s
    return -1


@njit(cache=True, error_model="numpy")
def build_late_line_shape(segment, shape_index, shape_modes, tables, table, outline):
    """Build the shape of an echo that has the last ``sizes[1]`` samples of the record.

    Arguments and results as of :func:`build_line_shape`. With f = w exp(2 pi i psi) over these
    samples and theta = 2 pi y / N,

        G(y) = L'/2 int f(x) e^{-i pi r' y x} dx + (f(-1) e^{i pi r' y} - f(1) e^{-i pi r' y}) / 2
               + sum_m B_{m+1} / (m+1)! [ d^m / dn^m (f e^{-i theta n}) ] at the ends,

    whose derivatives are polynomials in theta.
    """
    layout, mode_transforms, taylor_coefficients, envelope_distances = (
        tables.layout,
        tables.mode_transforms,
        tables.taylor_coefficients,
        tables.envelope_distances,
    )
    mode_re, mode_im = (
        shape_modes[1][segment, shape_index, 0],
        shape_modes[1][segment, shape_index, 1],
    )
    n_modes, adds_powers = shape_modes[2][segment, shape_index], layout[4] != 0
    envelope, end_polynomials = outline[1:3], outline[3:7, : END_DERIVATIVES_MAX + 2]
    half_length, sample_step, length_ratio = 0.5 * layout[1], 2.0 / layout[1], layout[1] / layout[0]
    mode_sum = np.zeros((2, mode_transforms.shape[1]))
    derivatives_first, derivatives_last = (
        np.zeros((2, END_DERIVATIVES_MAX + 1)),
        np.zeros((2, END_DERIVATIVES_MAX + 1)),
    )
    for j in range(n_modes):
        a, b = mode_re[j], mode_im[j]
        for i in range(END_DERIVATIVES_MAX + 1):
            value = taylor_coefficients[j, i]
            sign = -1.0 if (i + j) & 1 else 1.0
            derivatives_last[0, i], derivatives_last[1, i] = (
                derivatives_last[0, i] + a * value,
                derivatives_last[1, i] + b * value,
            )
            derivatives_first[0, i] += sign * a * value
            derivatives_first[1, i] += sign * b * value
        if j & 1:
            a, b = -b, a
        for i in range(mode_transforms.shape[1]):
            mode_sum[0, i] += a * mode_transforms[j, i]
            mode_sum[1, i] += b * mode_transforms[j, i]
    scale = 1.0
    for i in range(END_DERIVATIVES_MAX + 1):
        for k in range(2):
            derivatives_first[k, i], derivatives_last[k, i] = (
                derivatives_first[k, i] * scale,
                derivatives_last[k, i] * scale,
            )
        scale *= sample_step
    end_polynomials[:] = 0.0
    for i in range(END_DERIVATIVES_MAX + 1):
        for d in range(END_DERIVATIVES_MAX + 2):
            p, q = _POWER_SUMS_RE[i, d], _POWER_SUMS_IM[i, d]
            end_polynomials[0, d] += derivatives_first[0, i] * p - derivatives_first[1, i] * q
            end_polynomials[1, d] += derivatives_first[0, i] * q + derivatives_first[1, i] * p
            end_polynomials[2, d] += derivatives_last[0, i] * p - derivatives_last[1, i] * q
            end_polynomials[3, d] += derivatives_last[0, i] * q + derivatives_last[1, i] * p
    # Corrections of the two ends by power of theta: (-i)^d turns real and imaginary parts about.
    end_corrections = np.zeros((4, _EULER_MACLAURIN_ORDER_MAX + 1))
    for d in range(_EULER_MACLAURIN_ORDER_MAX + 1):
        a, b, c, e = 0.0, 0.0, 0.0, 0.0
        for i in range(_EULER_MACLAURIN_ORDER_MAX + 1 - d):
            factor = _CORRECTION_FACTORS[d, i]
            a, b = a - factor * derivatives_first[0, i], b - factor * derivatives_first[1, i]
            c, e = c + factor * derivatives_last[0, i], e + factor * derivatives_last[1, i]
        if d == 0:  # the first sample counts whole, the end not at all
            a, b = a + 0.5 * derivatives_first[0, 0], b + 0.5 * derivatives_first[1, 0]
            c, e = c - 0.5 * derivatives_last[0, 0], e - 0.5 * derivatives_last[1, 0]
        for _ in range(d % 4):
            a, b, c, e = b, -a, e, -c
        (
            end_corrections[0, d],
            end_corrections[1, d],
            end_corrections[2, d],
            end_corrections[3, d],
        ) = a, b, c, e
    cells_per_bin, table_bins = layout[3], layout[2]
    n_cells = 2 * table_bins * cells_per_bin + cells_per_bin + 2 * _TAP_REACH_CELLS
    first_cell = -table_bins * cells_per_bin - cells_per_bin + 1 - _TAP_REACH_CELLS
    transform, kernel_weights = np.empty((2, n_cells)), np.empty(KERNEL_CELLS + ZERO_WEIGHT_CELLS)
    middle = mode_transforms.shape[1] // 2
    for i in range(n_cells):
        y = (first_cell + i) / cells_per_bin
        u = length_ratio * y
        value_position = u * _LATE_VALUES_PER_BIN + middle
        cell = math.floor(value_position)
        kernel_coordinate = 2.0 * (value_position - cell) - 1.0
        kernel_weights[:] = KERNEL_BASIS[KERNEL_DEGREE]
        for d in range(KERNEL_DEGREE - 1, -1, -1):
            for j in range(KERNEL_CELLS + ZERO_WEIGHT_CELLS):
                kernel_weights[j] = kernel_weights[j] * kernel_coordinate + KERNEL_BASIS[d, j]
        sum_re, sum_im = 0.0, 0.0
        first_value = np.uint64(cell - KERNEL_CELLS // 2 + 1)
        for j in range(np.uint64(KERNEL_CELLS)):
            sum_re += kernel_weights[j] * mode_sum[0, first_value + j]
            sum_im += kernel_weights[j] * mode_sum[1, first_value + j]
        theta = 2.0 * np.pi * y / layout[0]
        a, b, c, e = 0.0, 0.0, 0.0, 0.0
        for d in range(_EULER_MACLAURIN_ORDER_MAX, -1, -1):
            a, b = a * theta + end_corrections[0, d], b * theta + end_corrections[1, d]
            c, e = c * theta + end_corrections[2, d], e * theta + end_corrections[3, d]
        sine, cosine = sincos_cycles(0.5 * u)
        transform[0, i] = (
            2.0 * half_length * sum_re + (a * cosine - b * sine) + (c * cosine + e * sine)
        )
        transform[1, i] = (
            2.0 * half_length * sum_im + (a * sine + b * cosine) + (e * cosine - c * sine)
        )
    if not adds_powers:
        _fill_table_row(transform[0], layout, table[0])
        _fill_table_row(transform[1], layout, table[1])
    for i in range(n_cells):
        transform[0, i] = transform[0, i] * transform[0, i] + transform[1, i] * transform[1, i]
    if adds_powers:
        _fill_table_row(transform[0], layout, table[0])
    _fill_envelope(transform[0], end_polynomials, layout, envelope_distances, envelope)


@njit(cache=True, error_model="numpy")
def _fill_table_row(values, layout, table_row):
    """Values at cells with the kernel divided out of them, in rows by cell of a bin."""
    cells_per_bin, columns = layout[3], 2 * layout[2] + 1
    n_values = np.uint64(cells_per_bin * columns)
    filtered = np.empty(cells_per_bin * columns)
    for i in range(n_values):
        filtered[i] = DECONVOLUTION_TAPS[0] * values[i + np.uint64(_TAP_REACH_CELLS)]
    for k in range(1, DECONVOLUTION_TAPS.size):
        low, high = np.uint64(_TAP_REACH_CELLS - k), np.uint64(_TAP_REACH_CELLS + k)
        for i in range(n_values):
            filtered[i] += DECONVOLUTION_TAPS[k] * (values[i + low] + values[i + high])
    for m in range(cells_per_bin):
        for q in range(columns):
            table_row[m * columns + q] = filtered[q * cells_per_bin + cells_per_bin - 1 - m]


@njit(cache=True, error_model="numpy")
def _fill_envelope(squared_magnitude, end_polynomials, layout, envelope_distances, envelope):
    """Envelope of |G|^2 at cells, and of what is beyond them; as of :func:`build_line_shape`.

    |G|^2 goes as a sine of y with a period of a bin, so that it is nowhere more than two values
    half a bin apart have together.
    """
    table_bins, cells_per_bin = layout[2], layout[3]
    line_cell, half_bin_cells = (
        table_bins * cells_per_bin + cells_per_bin - 1 + _TAP_REACH_CELLS,
        cells_per_bin // 2,
    )
    for i in range(np.uint64(table_bins + 1), np.uint64(envelope_distances.shape[1])):
        c, a, b, p, q = envelope_distances[1, i], 0.0, 0.0, 0.0, 0.0
        for k in range(END_DERIVATIVES_MAX + 2):
            d = END_DERIVATIVES_MAX + 1 - k
            a, b = a * c + end_polynomials[0, d], b * c + end_polynomials[1, d]
            p, q = p * c + end_polynomials[2, d], q * c + end_polynomials[3, d]
        squared_first, squared_last = a * a + b * b, p * p + q * q
        envelope[0, i] = (
            squared_first + squared_last + 2.0 * math.sqrt(squared_first * squared_last)
        )
    half_bin_sums = np.empty(
        table_bins * cells_per_bin + cells_per_bin + 1
    )  # from the cell before the line on
    for i in range(half_bin_sums.size):
        cell_above, cell_below = np.uint64(line_cell - 1 + i), np.uint64(line_cell + 1 - i)
        sum_above = (
            squared_magnitude[cell_above]
            + squared_magnitude[cell_above + np.uint64(half_bin_cells)]
        )
        sum_below = (
            squared_magnitude[cell_below]
            + squared_magnitude[cell_below - np.uint64(half_bin_cells)]
        )
        half_bin_sums[i] = _ENVELOPE_MARGIN * _ENVELOPE_MARGIN * max(sum_above, sum_below)
    maximum_beyond, area, previous_maximum = 0.0, 0.0, 0.0  # of the square
    for i in range(envelope_distances.shape[1] - 1, -1, -1):
        if i > table_bins:
            maximum_beyond = max(maximum_beyond, envelope[0, i])
        else:
            for k in range(i * cells_per_bin, (i + 1) * cells_per_bin + 1):
                maximum_beyond = max(maximum_beyond, half_bin_sums[k])
        width = (
            envelope_distances[0, i + 1] - envelope_distances[0, i]
            if i + 1 < envelope_distances.shape[1]
            else 0.0
        )
        area += (
            width * 0.5 * (maximum_beyond + previous_maximum)
        )  # an upper sum, where it falls ever slower
        previous_maximum = maximum_beyond
        envelope[0, i], envelope[1, i] = maximum_beyond, area
    for i in range(envelope_distances.shape[1]):
        envelope[0, i] = math.sqrt(envelope[0, i])
