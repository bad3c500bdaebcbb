"""Spectra by an FFT on an oversampled grid of frequencies, as in the thesis.

Studies do not use them.

`sweep accuracy` compares its time and error with those of the closed form
(:mod:`sweep.model.spectrum.segment_spectra`).

[T 3.3.1] convolves the spectra with the window's transform "with much higher sampling rate in the
frequency domain than the FFT bin spacing", by an FFT "typically of size 2^11 or 2^12". The grid has
16 cells a bin around the beam's centre, and each beamlet's line goes into the nearest cell. An FFT,
a product with the FFT of the window's transform, and an inverse FFT follow. The improvements
`uses_real_transform` ("real" in docs/accuracy.md), `transforms_to_bins_only` ("folded") and
`degree` are described there. Changes of lines within a record (range walk, line width) and leakage
beyond the grid are neglected.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy import fft

from sweep.kernel_cache import njit
from sweep.model import window as windows
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.echo_detection import detect_in_spectra
from sweep.model.preparation import Shots
from sweep.model.spectrum.lines import (
    LineArrays,
    PointParameters,
    SegmentParameters,
    SpectrumLayout,
    add_image_lines,
    beat_parameters_at,
    compute_lines,
    fold_lines,
)
from sweep.model.spectrum.segment_spectra import SegmentResults, allocate_segment_results

GRID_CELLS_PER_BIN = 16
"""Number of cells of the frequency grid per FFT bin."""

GRID_CELLS_MIN = 1 << 12
"""Default number of cells of the frequency grid. Points whose lines cover more bins get more cells.
"""

CLEARANCE_BINS = 16
"""Number of bins on each side of the lines that stay free of light wrapped around by the circular
convolution."""

_SPECTRA_PER_TRANSFORM = 32
"""Number of spectra per call of the FFT, so that they fit into the processor's cache."""


class GridOptions(NamedTuple):
    """Options of :func:`find_peaks_on_grid`."""

    degree: int
    """Degree of the polynomial that spreads each line over cells; 0 for the nearest cell."""
    uses_real_transform: bool
    """True to transform powers as real numbers. It has effect only if the powers of the lines add.
    """
    transforms_to_bins_only: bool
    """True to transform back to the FFT bins alone, not to all cells."""


class GridSpectra(NamedTuple):
    """Spectra of m points in the bins around their lines, without noise."""

    first_bin: np.ndarray
    """(m,): FFT bin number of the first bin of each spectrum."""
    magnitude: np.ndarray
    """(m, cells / GRID_CELLS_PER_BIN): magnitude of each bin [V, summed over the record]."""


def find_peaks_on_grid(
    shots: Shots,
    *,
    degree: int = 0,
    n_cells_min: int = GRID_CELLS_MIN,
    uses_real_transform: bool = False,
    transforms_to_bins_only: bool = False,
) -> SegmentResults:
    """Find the largest bins of each segment's spectrum by FFT on an oversampled grid.

    Parameters
    ----------
    shots
        n shots. Changes of the lines within a record, and leakage, are ignored.
    degree
        Degree of the polynomial that shares each line out among cells: 0 puts it into the nearest
        cell, 9 shares it among ten cells.
    n_cells_min
        Least number of cells of a grid, a power of two. Points whose lines spread farther get more
        cells.
    uses_real_transform
        Whether to transform powers as real numbers, if the powers of the lines add.
    transforms_to_bins_only
        Whether to transform back to the bins alone, not to all cells.

    Returns
    -------
    SegmentResults
        Arrays (3, n), like those of
        :func:`sweep.model.spectrum.segment_spectra.evaluate_segments`. Leakage is 0.
    """
    results = allocate_segment_results(shots.size)
    parameters, parameters_by_segment = shots.point_parameters(), shots.segment_parameters()
    n_cells_of_point = cells_per_point(shots, n_cells_min)
    grid_options = GridOptions(degree, uses_real_transform, transforms_to_bins_only)
    segments = np.flatnonzero(shots.has_segment).tolist()
    for cells, segment in product(np.unique(n_cells_of_point).tolist(), segments):
        members = np.flatnonzero(n_cells_of_point == cells)
        for points in np.split(
            members, range(_SPECTRA_PER_TRANSFORM, members.size, _SPECTRA_PER_TRANSFORM)
        ):
            spectra = grid_magnitudes(
                shots, parameters, parameters_by_segment, points, segment, cells, grid_options
            )
            detections = detect_in_spectra(
                spectra.magnitude,
                spectra.first_bin,
                shots.fft_size // 2,
                1.0 / shots.fft_size,
                shots.detection_rule,
                shots.bin_thresholds.select(points),
                shots.speckle_table.select(segment, points),
            )
            detections.frequency[:] *= np.broadcast_to(shots.sample_rate, shots.size)[points]
            for name, values in detections._asdict().items():
                getattr(results, name)[segment, points] = values
    return results


def cells_per_point(shots: Shots, cells_min: int = GRID_CELLS_MIN) -> np.ndarray:
    """Return the number of grid cells of each point, a power of two.

    The lines are within about b bins of the middle of the grid. On each side of the middle there
    are at least 2 (b + CLEARANCE_BINS) bins, with

        b = (N / fs) [(2 |S| R / c) (max |dR| / R + max |dbeta|) + f max |dbeta|].

    dR and dbeta are a beamlet's offsets of range and Doppler ratio from the beam's axis at the
    range R. S is the chirp rate, f the highest carrier of any segment and point, N the FFT size,
    and fs the sample rate.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    cells_min : int
        Least number of cells, a power of two.

    Returns
    -------
    ndarray (n,) int64
        Number of cells.
    """
    beat_per_ratio = 2 * np.abs(shots.waveform.chirp_rate) * shots.range / SPEED_OF_LIGHT
    carrier_max = np.max([np.max(segment_carriers) for segment_carriers in shots.waveform.carriers])
    offset_max = np.abs(shots.footprint.relative_range_offset).max(axis=1)[
        shots.footprint.row_of_point
    ]
    doppler_max = np.abs(shots.footprint.doppler_ratio_offset).max(axis=1)[
        shots.footprint.row_of_point
    ]
    line_spread = beat_per_ratio * (offset_max + doppler_max) + carrier_max * doppler_max
    line_spread_bins = line_spread * shots.fft_size / shots.sample_rate
    cells_needed = np.ceil(np.log2(4 * GRID_CELLS_PER_BIN * (line_spread_bins + CLEARANCE_BINS)))
    return np.maximum(cells_min, 2 ** cells_needed.astype(np.int64))


def grid_magnitudes(
    shots: Shots,
    parameters: PointParameters,
    parameters_by_segment: SegmentParameters,
    points: np.ndarray,
    segment: int,
    n_cells: int,
    grid_options: GridOptions,
) -> GridSpectra:
    """Return the spectra of one segment of m points around their lines, without noise.

    Parameters
    ----------
    shots
        All shots.
    parameters, parameters_by_segment
        Their parameters by `Shots.point_parameters` and `Shots.segment_parameters`.
    points
        Indices of the m points, (m,), which have `n_cells` cells each.
    segment
        Index of the segment: 0 up, 1 Doppler, 2 down.
    grid_options
        Options of :func:`find_peaks_on_grid`.
    """
    degree, uses_real_transform, transforms_to_bins_only = grid_options
    adds_powers, record_length = shots.footprint.adds_powers, shots.window.length
    uses_real_transform = uses_real_transform and adds_powers
    grid = np.zeros((points.size, n_cells), float if uses_real_transform else complex)
    centre_bin, polynomial_nodes = np.empty(points.size, np.int64), np.arange(degree + 1.0)
    _deposit_lines(
        points,
        parameters,
        parameters_by_segment,
        shots.footprint.row_of_point[points],
        shots.beamlet_arrays,
        segment,
        SpectrumLayout(
            fft_size=shots.fft_size,
            record_length=record_length,
            table_half_width_bins=0,
            cells_per_bin=0,
            adds_powers=adds_powers,
            holds_all_bins=False,
            clearance_bins=0,
        ),
        shots.line_images.are_summed,
        np.array(
            [
                1 / np.prod(np.delete(node - polynomial_nodes, node_number))
                for node_number, node in enumerate(polynomial_nodes)
            ]
        ),
        centre_bin,
        grid.view(float).reshape(points.size, n_cells, -1),
    )
    window_transform = _window_transform(
        shots.window.name, record_length, shots.fft_size, n_cells, adds_powers, uses_real_transform
    )
    convolved = _convolve_with_window(
        grid, window_transform, uses_real_transform, transforms_to_bins_only
    )
    # Rounding may make a small sum of squares negative.
    magnitude = np.sqrt(np.maximum(convolved.real, 0.0)) if adds_powers else np.abs(convolved)
    return GridSpectra(centre_bin - n_cells // (2 * GRID_CELLS_PER_BIN), magnitude)


def _convolve_with_window(
    grid: np.ndarray,
    window_transform: np.ndarray,
    uses_real_transform: bool,
    transforms_to_bins_only: bool,
) -> np.ndarray:
    """Convolve powers or amplitudes (rows, cells) with the window; return one value per bin."""
    n_bins = grid.shape[1] // GRID_CELLS_PER_BIN
    forward_transform, inverse_transform = (
        (fft.rfft, fft.irfft) if uses_real_transform else (fft.fft, fft.ifft)
    )
    transform = forward_transform(grid, axis=1, overwrite_x=True)
    transform *= window_transform
    if not transforms_to_bins_only:
        return np.asarray(
            inverse_transform(transform, grid.shape[1], axis=1, overwrite_x=True)[
                :, ::GRID_CELLS_PER_BIN
            ]
        )
    if uses_real_transform:  # the upper half of the transform is the conjugate of the lower half
        upper_half = transform[:, :-1].reshape(-1, GRID_CELLS_PER_BIN // 2, n_bins)[
            :, :, : n_bins // 2 + 1
        ]
        lower_half = transform[:, 1:].reshape(-1, GRID_CELLS_PER_BIN // 2, n_bins)[
            :, :, : n_bins // 2 - 2 : -1
        ]
        transform = upper_half.sum(axis=1) + lower_half.sum(axis=1).conj()
    else:
        transform = transform.reshape(-1, GRID_CELLS_PER_BIN, n_bins).sum(axis=1)
    return (
        np.asarray(inverse_transform(transform, n_bins, axis=1, overwrite_x=True))
        / GRID_CELLS_PER_BIN
    )


@lru_cache(maxsize=32)
def _window_transform(
    window_name: str,
    length: int,
    fft_size: int,
    n_cells: int,
    adds_powers: bool,
    uses_real_transform: bool,
) -> np.ndarray:
    """Return the FFT over the grid's cells of the window's spectrum, for a convolution by FFT.

    The window's spectrum is the FFT of its samples with phase 0 at mid-record, or its squared
    magnitude if `adds_powers`.
    """
    cell_offsets = np.concatenate([np.arange(n_cells // 2), np.arange(-n_cells // 2, 0)])
    transform = fft.fft(windows.window_samples(window_name, length), GRID_CELLS_PER_BIN * fft_size)[
        cell_offsets
    ]
    transform *= np.exp(1j * np.pi * cell_offsets * (length / fft_size / GRID_CELLS_PER_BIN))
    if adds_powers:
        transform = np.abs(transform) ** 2
    return np.asarray(fft.rfft(transform) if uses_real_transform else fft.fft(transform))


@njit(cache=True, error_model="numpy")
def _deposit_lines(
    points,
    parameters,
    parameters_by_segment,
    footprint_row,
    beamlets,
    segment,
    layout,
    image,
    node_weights,
    centre_bin,
    grid,
):
    """Add the amplitudes or powers of the lines of m points to the cells of their grids.

    Parameters
    ----------
    points
        (m,): indices of the points.
    parameters, parameters_by_segment
        :class:`sweep.model.spectrum.lines.PointParameters` and
        :class:`sweep.model.spectrum.lines.SegmentParameters` of all points.
    footprint_row
        (m,): row of each point's footprint in ``beamlets``.
    beamlets
        :class:`sweep.model.spectrum.lines.BeamletArrays`.
    segment
        Index of the segment: 0 up, 1 Doppler, 2 down.
    layout
        :class:`sweep.model.spectrum.lines.SpectrumLayout`.
    image
        True to add the images of the lines about DC or Nyquist, whichever is nearer.
    node_weights
        Weights of Lagrange interpolation among the cells over which each line is spread; of size 1
        if a line goes into the nearest cell.
    centre_bin
        (m,): output array, bin in the middle of each grid, 0 .. N/2.
    grid
        (m, cells, 2 or 1): output array, real and imaginary parts, or powers.
    """
    n_beamlets, n_cells = beamlets.relative_range_offset.shape[1], grid.shape[1]
    n_lines = 2 * n_beamlets if image else n_beamlets
    lines = LineArrays(np.empty(n_lines), np.empty(n_lines), np.empty(n_lines))
    inverse_gain_re, inverse_gain_im = np.empty(n_beamlets), np.empty(n_beamlets)
    images = LineArrays(lines.position[n_beamlets:], lines.re[n_beamlets:], lines.im[n_beamlets:])
    cell_weights = np.empty(node_weights.size)
    lowest_cell, highest_cell = (
        (-0.5, n_cells - 1.0) if node_weights.size == 1 else (5.0, n_cells - 6.0)
    )
    for i in range(points.size):
        signed_centre_bin = compute_lines(
            beat_parameters_at(parameters, parameters_by_segment, segment, points[i]),
            segment,
            beamlets,
            footprint_row[i],
            layout,
            lines,
            inverse_gain_re,
            inverse_gain_im,
        )
        centre_bin[i] = abs(signed_centre_bin)
        if signed_centre_bin < 0:
            for beamlet in range(n_beamlets):
                lines.position[beamlet] = -lines.position[beamlet]
                lines.im[beamlet] = -lines.im[beamlet]
        if image:
            add_image_lines(lines, n_beamlets, centre_bin[i], 1.0, layout.adds_powers)
            fold_lines(images, n_beamlets, layout)
        for beamlet in range(n_beamlets):
            for line in range(beamlet, n_lines, n_beamlets):
                cell_position = n_cells // 2 + GRID_CELLS_PER_BIN * lines.position[line]
                if lowest_cell < cell_position < highest_cell:
                    _deposit_line(
                        grid[i],
                        cell_position,
                        lines.re[line],
                        lines.im[line],
                        node_weights,
                        cell_weights,
                    )


@njit(cache=True, error_model="numpy")
def _deposit_line(cells, cell_position, re, im, node_weights, cell_weights):
    """Add a line to the nearest cell, or spread it over several cells by Lagrange interpolation.

    At the offset x from the first of the cells, cell j receives the fraction
    (g_j / (x - j)) / sum_k (g_k / (x - k)) of the line, with the barycentric weights g.

    Parameters
    ----------
    cells : ndarray (cells, 2 or 1)
        Result: real and imaginary parts, or powers, to which those of the line are added.
    cell_position : float
        Position of the line [cells] from the first cell of the grid.
    re, im : float
        Complex weight of the line [V]; squared magnitude [V^2] and 0 if powers add.
    node_weights : ndarray (nodes,)
        Barycentric weights g. One weight puts the line into the nearest cell. Otherwise the first
        cell is four below that of the line, which is right for ten weights.
    cell_weights : ndarray (nodes,)
        Scratch.
    """
    first_cell = (
        int(np.rint(cell_position)) if node_weights.size == 1 else int(np.floor(cell_position)) - 4
    )
    offset, weight_sum = cell_position - first_cell, 0.0
    for node in range(node_weights.size):
        if offset == node or node_weights.size == 1:
            cell_weights[:] = 0.0
            cell_weights[node] = weight_sum = 1.0
            break
        cell_weights[node] = node_weights[node] / (offset - node)
        weight_sum += cell_weights[node]
    for node in range(node_weights.size):
        cells[first_cell + node, 0] += re * cell_weights[node] / weight_sum
        if cells.shape[1] > 1:
            cells[first_cell + node, 1] += im * cell_weights[node] / weight_sum
