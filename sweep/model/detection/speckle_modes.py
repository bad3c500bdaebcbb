"""Strongest speckle mode of an echo: the part that fades with one amplitude in all bins.

If the lines of a footprint spread over the bins with the density p(nu), the amplitudes of bins k
and l in developed speckle have the covariance

    C(k, l) = int p(nu) G(k - nu) G(l - nu) dnu,

with the window's transform G. C is a sum of independently fading modes (its eigenvectors: a
Karhunen-Loeve expansion [Goodman, Speckle Phenomena in Optics, 2007, 3.3]). A single line has one
mode: all bins fade together. The strongest mode u, of the eigenvalue m, has the fraction
m u(k)^2 / C(k, k) of the power of bin k. The other modes are treated as additional noise, whose
correlation between neighbouring bins is what C leaves for them.

p is taken to be Gaussian. The tables are over its standard deviation and the position of its centre
between bins.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection.detectors import main_lobe_half_width
from sweep.model.detection.speckle_correlation import window_transform
from sweep.model.window import COSINE_SUM_COEFFICIENTS, Window, get_window

LINE_DEVIATIONS = np.array(
    [0, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.4, 2.0, 3.0, 4.5, 7.0, 11.0]
)
"""Standard deviations of the lines' Gaussian density for which speckle modes are tabulated. The
unit is max(1, h/2) fs/L, with the sample rate fs, the record's number of samples L, and the main
lobe's half-width h [fs/L]."""

N_CENTRE_OFFSETS = 9
"""Number of tabulated positions of an echo's centre relative to the nearest bin. They are evenly
spaced over -1/2 .. 1/2 FFT bin."""

_N_TABLE_WINDOW_SAMPLES = 1024
"""Number of samples of the window with which tables are computed in place of longer windows of the
same shape."""
_POWER_ITERATIONS_MAX = 80
"""Largest number of steps of the power iteration for an eigenvector."""
_N_NODES_MIN = 41
"""Smallest number of lines that represent a Gaussian density."""
_NODE_SPACING_MAX = 0.4
"""Largest spacing (approximate) of the lines that represent a Gaussian density, in the unit of
LINE_DEVIATIONS."""
_NODE_DEVIATIONS_MAX = 4.5
"""Distance from the centre of the outermost line that represents a Gaussian density, in standard
deviations of the density."""
_FULL_REACH_LINE_DEVIATION_MAX = 3.0
"""Largest standard deviation of the lines' density for which tables of speckle modes include bins
up to two deviations beyond the main lobe. The unit is that of LINE_DEVIATIONS."""


class ModeTable(NamedTuple):
    """Power fraction of the strongest speckle mode, and correlation of neighbouring bins.

    A speckle mode is a part of an echo that fades with one amplitude in all bins. The lines of the
    echo have a Gaussian density of positions. The tables are over the density's standard deviation,
    and over the position of its centre relative to the nearest bin.
    """

    line_deviation_bins: np.ndarray
    """(s,): tabulated standard deviations of the lines' positions [FFT bins]; empty in NO_MODES."""
    power_fraction: np.ndarray
    """(s, N_CENTRE_OFFSETS, k): fraction of a bin's power in the strongest speckle mode. The k bins
    lie about the bin nearest to the echo's centre."""
    neighbour_correlation: np.ndarray
    """(s, N_CENTRE_OFFSETS, k): correlation of the echo's amplitudes in a bin and in the bin below,
    -1..1."""
    power_asymmetry: np.ndarray
    """(s, N_CENTRE_OFFSETS): :func:`power_asymmetry` of the bin nearest to the echo's centre and
    its two neighbours. The asymmetry rises with the offset of the echo's centre from the nearest
    bin."""


NO_MODES = ModeTable(np.empty(0), np.empty((0, 0, 0)), np.empty((0, 0, 0)), np.empty((0, 0)))
"""Speckle-mode table without entries, for shots whose detection needs none."""


class ModeTableCell(NamedTuple):
    """Place in a :class:`ModeTable`: indices of a cell, and weights of bilinear interpolation."""

    deviation_index: int
    """Index in the table of the line deviation at the lower end of the cell."""
    deviation_weight: float
    """Interpolation weight, 0..1, of the table's next larger line deviation."""
    offset_index: int
    """Index in the table of the position of the echo's centre at the lower end of the cell."""
    offset_weight: float
    """Interpolation weight, 0..1, of the table's next position of the echo's centre."""


@lru_cache(maxsize=32)
def mode_table(record_window: Window, fft_size: int) -> ModeTable:
    """Tabulate the strongest speckle mode for a window and an FFT size (cached).

    Parameters
    ----------
    record_window : Window
        Window of the record, of L samples (:class:`sweep.model.window.Window`).
    fft_size : int
        FFT size N >= L.

    Returns
    -------
    ModeTable
        Power fraction of the strongest mode, and correlation of neighbouring bins, over the
        standard deviation of the lines and the position of their centre.

    Notes
    -----
    The amplitudes of bins k and l have the covariance

        C(k, l) = int p(nu) G(k - nu) G(l - nu) dnu,

    with the window's transform G and a Gaussian density p of the lines. The strongest mode is the
    eigenvector u of the largest eigenvalue m [Goodman, Speckle Phenomena in Optics, 2007, 3.3]. It
    has the fraction m u(k)^2 / C(k, k) of the power of bin k. The correlation of neighbours is
    C(k, k - 1) / sqrt(C(k, k) C(k - 1, k - 1)). Cosine-sum windows of more than 1024 samples are
    represented by a window of 1024 samples.
    """
    padding_factor, lobe_half_width = (
        fft_size / record_window.length,
        main_lobe_half_width(record_window),
    )
    if record_window.name in COSINE_SUM_COEFFICIENTS:
        record_window = get_window(
            record_window.name, min(record_window.length, _N_TABLE_WINDOW_SAMPLES)
        )
    deviations = LINE_DEVIATIONS * max(1.0, lobe_half_width / 2)
    half_bins = math.ceil(
        (lobe_half_width + 2 * _FULL_REACH_LINE_DEVIATION_MAX * max(1.0, lobe_half_width / 2))
        * padding_factor
    )
    bin_positions = np.arange(-half_bins, half_bins + 1) / padding_factor
    offsets = np.linspace(-0.5, 0.5, N_CENTRE_OFFSETS) / padding_factor
    power_fraction = np.empty((deviations.size, N_CENTRE_OFFSETS, bin_positions.size))
    neighbour_correlation, asymmetry = (
        np.zeros_like(power_fraction),
        np.empty(power_fraction.shape[:2]),
    )
    for s, deviation in enumerate(deviations):
        node, weight = _gaussian_nodes(LINE_DEVIATIONS[s])
        for d, offset in enumerate(offsets):
            bin_transforms = window_transform(
                record_window, bin_positions[:, None] - (offset + deviation * node)
            )
            # Sums, not products of matrices, whose order depends on the number of threads.
            power = np.maximum((weight * bin_transforms**2).sum(axis=1), 1e-300)
            neighbour_product = (weight * bin_transforms[1:] * bin_transforms[:-1]).sum(axis=1)
            amplitude = np.sqrt(power)
            mode = _strongest_mode_amplitudes(bin_transforms, weight, amplitude)
            power_fraction[s, d] = np.minimum(mode**2 / power, 1.0)
            asymmetry[s, d] = power_asymmetry(*amplitude[half_bins - 1 : half_bins + 2])
            neighbour_correlation[s, d, 1:] = neighbour_product / (amplitude[1:] * amplitude[:-1])
    # A single line has one mode, also in bins where its transform is 0.
    power_fraction[0], neighbour_correlation[0] = (
        1.0,
        np.where(neighbour_correlation[0] < 0, -1.0, 1.0),
    )
    neighbour_correlation[:, :, 0] = neighbour_correlation[:, :, 1]
    return ModeTable(
        deviations * padding_factor,
        power_fraction,
        neighbour_correlation,
        np.maximum.accumulate(asymmetry, axis=1),
    )


def _gaussian_nodes(deviation: float) -> tuple[np.ndarray, np.ndarray]:
    """Return evenly spaced nodes and weights of a mean over a standard normal variable.

    ``deviation`` is the standard deviation of the lines in units of LINE_DEVIATIONS.
    """
    n_nodes = max(_N_NODES_MIN, math.ceil(2 * _NODE_DEVIATIONS_MAX * deviation / _NODE_SPACING_MAX))
    node = np.linspace(-_NODE_DEVIATIONS_MAX, _NODE_DEVIATIONS_MAX, n_nodes)
    weight = np.exp(-0.5 * node * node)
    return node, weight / weight.sum()


def _strongest_mode_amplitudes(
    bin_transforms: np.ndarray, line_weights: np.ndarray, mode: np.ndarray
) -> np.ndarray:
    """Return the leading eigenvector of a covariance matrix times the root of its eigenvalue.

    Parameters
    ----------
    bin_transforms
        (bins, lines): amplitude of each line in each bin.
    line_weights
        (lines,): power of each line. The covariance is the weighted sum of the outer products of
        the lines' amplitudes.
    mode
        (bins,): vector from which the power iteration starts.

    Notes
    -----
    With B, the amplitudes times the roots of the powers, the covariance is B B^T. Its leading
    eigenvector times the root of the eigenvalue is B u, with the leading unit eigenvector u of B^T
    B. The smaller of the two matrices is iterated.
    """
    amplitudes = bin_transforms * np.sqrt(line_weights)
    has_fewer_lines = amplitudes.shape[1] < amplitudes.shape[0]
    vector = (amplitudes * mode[:, None]).sum(axis=0) if has_fewer_lines else mode
    factors = amplitudes if has_fewer_lines else amplitudes.T
    # Not a product of matrices, whose order of sums depends on the number of threads.
    matrix = np.einsum("ti,tj->ij", factors, factors, optimize=False)
    eigenvalue = 1.0
    vector = vector / math.sqrt((vector**2).sum())
    for _ in range(_POWER_ITERATIONS_MAX):
        product = (matrix * vector).sum(axis=1)
        eigenvalue = math.sqrt((product**2).sum())
        previous, vector = vector, product / max(eigenvalue, 1e-300)
        if np.abs(vector - previous).max() < 1e-15:
            break
    if has_fewer_lines:
        return (amplitudes * vector).sum(axis=1)
    return vector * math.sqrt(eigenvalue)


@njit(cache=True, error_model="numpy", borrows=True)
def power_asymmetry(below, middle, above):
    """Return the relative difference of the powers above and below the strongest bin, -1..1.

    The sign shows on which side of the bin the echo's centre lies. The result is 0 if both
    neighbours are faint.

    Parameters
    ----------
    below, middle, above : float
        |X| of three adjacent bins, in any unit; the strongest is in the middle.

    Notes
    -----
    (P_above - P_below) / (P_above + P_below), with P = |X|^2.
    """
    neighbour_power = below * below + above * above
    if not neighbour_power > 1e-6 * middle * middle:
        return 0.0
    return (above * above - below * below) / neighbour_power


@njit(cache=True, error_model="numpy", borrows=True)
def locate_in_mode_table(table, line_deviation_bins, asymmetry):
    """Return the :class:`ModeTableCell` of a table that holds a line deviation and an asymmetry.

    Parameters
    ----------
    table
        :class:`ModeTable`.
    line_deviation_bins
        Standard deviation of the lines' positions [FFT bins].
    asymmetry
        Result of :func:`power_asymmetry`, -1..1.
    """
    deviation_index = 0
    while (
        deviation_index < table.line_deviation_bins.size - 2
        and table.line_deviation_bins[deviation_index + 1] <= line_deviation_bins
    ):
        deviation_index += 1
    deviation_step = (
        table.line_deviation_bins[deviation_index + 1] - table.line_deviation_bins[deviation_index]
    )
    deviation_weight = min(
        max(
            (line_deviation_bins - table.line_deviation_bins[deviation_index]) / deviation_step, 0.0
        ),
        1.0,
    )
    offset_index = 0
    while (
        offset_index < N_CENTRE_OFFSETS - 2
        and table.power_asymmetry[deviation_index, offset_index + 1] <= asymmetry
    ):
        offset_index += 1
    asymmetry_step = (
        table.power_asymmetry[deviation_index, offset_index + 1]
        - table.power_asymmetry[deviation_index, offset_index]
    )
    offset_weight = (
        (asymmetry - table.power_asymmetry[deviation_index, offset_index]) / asymmetry_step
        if asymmetry_step > 0.0
        else 0.0
    )
    return ModeTableCell(
        deviation_index, deviation_weight, offset_index, min(max(offset_weight, 0.0), 1.0)
    )


@njit(cache=True, error_model="numpy", borrows=True)
def interpolate_mode_table(values, cell, bin_offset):
    """Interpolate a quantity of a :class:`ModeTable` in a cell, for one bin.

    Parameters
    ----------
    values
        (s, N_CENTRE_OFFSETS, k): table of the quantity.
    cell
        :class:`ModeTableCell`.
    bin_offset
        Number of the bin, counted from the bin nearest to the echo's centre.
    """
    deviation_index, deviation_weight, offset_index, offset_weight = cell
    half_bins = values.shape[2] // 2
    bin_offset = min(max(bin_offset, -half_bins), half_bins) + half_bins
    low = (1.0 - offset_weight) * values[
        deviation_index, offset_index, bin_offset
    ] + offset_weight * values[deviation_index, offset_index + 1, bin_offset]
    high = (1.0 - offset_weight) * values[
        deviation_index + 1, offset_index, bin_offset
    ] + offset_weight * values[deviation_index + 1, offset_index + 1, bin_offset]
    return (1.0 - deviation_weight) * low + deviation_weight * high
