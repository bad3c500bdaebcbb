"""Errors of peak positions due to the shape that speckle gives to peaks.

A footprint broadens the line of an echo, and speckle deforms it. The positions that
:mod:`sweep.model.detection.sub_bin_interpolation` estimates from the magnitudes of three bins are
exact for tones alone.
"""

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection.sub_bin_interpolation import (
    TWO_BINS,
    Interpolator,
    estimate_sub_bin_offset,
    interpolator,
)
from sweep.model.table_interpolation import interpolate_tables
from sweep.model.window import Window, window_samples

if TYPE_CHECKING:
    from sweep.model.preparation import Shots

_SPREAD_GRID_CELLS = np.array([0.01, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3, 1.7, 2.2, 3.0, 4.0])
"""Tabulated spreads of a footprint's lines, as standard deviations in units of fs/L, the sample
rate over the number of samples in the record."""
_QUADRATURE_SHIFT_VARIANCES = np.concatenate([[1e-4], np.geomspace(3e-3, 30.0, 13)])
"""Tabulated variances of Im s [(fs/L)^2], with the complex shift s by which speckle deforms a peak
(:class:`PeakShapeErrors`), the sample rate fs and the number L of samples in the record."""
_SHAPE_OFFSETS_BINS = np.linspace(0.0, 1.0, 33)
"""Tabulated offsets of a peak from the bin about which it is estimated [bins]."""
_SHAPE_SAMPLES_MAX = 2048
"""Largest number of window samples from which deformed peaks are computed."""
_SHAPE_NODES, _SHAPE_WEIGHTS = np.polynomial.hermite_e.hermegauss(20)


class PeakShapeErrors(NamedTuple):
    """Errors of peak positions because speckle deforms peaks.

    Notes
    -----
    A is the amplitude of the echo, G(x) the window's transform at the distance x, and b the spread
    of the lines along the beam's coordinate y [bins]. In units of its mean, the power of the peak
    is q^2, and v is the fraction of the echo in this mean. Lines have weights a^2 and random
    amplitudes z. Given A, the mean of the bin at the distance x is A H(x), with the line H as the
    footprint broadens it,

        H(x) = sum a^2 G(x - b y).                                                              (1)

    It is the transform of the window times exp(-(2 pi b n / N)^2 / 2), with the sample n counted
    from the middle of the record and the FFT size N. The estimate for the magnitudes of H differs
    from that for G by the spread's error. It is proportional to b^2 for small b, and less for wide
    footprints.

    To first order in b, a bin departs from A H by -A s H', with the complex shift s. Its real and
    imaginary part each have the variance |b|^2 v / (2 q^2). The real part is the wander. The
    imaginary part is in quadrature with the line, and gives three bins the magnitudes

        |A| (H^2 + (Im s)^2 H'^2)^(1/2).                                                        (2)

    They are not those of any tone. Mean and deviation of the error follow from the normal
    distribution of Im s.
    """

    spread_error: np.ndarray
    """(m, 3): error of the peak position [bins] by the broadening of the line, equation (1)."""
    quadrature_error: np.ndarray
    """(m, 3): mean error of the peak position [bins] by the imaginary part of the complex shift,
    equation (2)."""
    quadrature_deviation: np.ndarray
    """(m, 3): standard deviation of the error by the imaginary part [bins], with the sign of the
    mean error at small shifts."""

    @classmethod
    def from_offset(
        cls, offset: np.ndarray, squared_shift: np.ndarray, variance: np.ndarray, shots: "Shots"
    ) -> "PeakShapeErrors":
        """Return the errors of the positions of peaks at given offsets from their strongest bin.

        Parameters
        ----------
        offset
            (m, 3): offset of each peak [bins].
        squared_shift
            (m, 3): b^2, the variance of the lines' positions [bins^2].
        variance
            (m, 3): variance of the real, and of the imaginary part of the complex shift [bins^2].
        shots
            Prepared shots, for window and FFT size.
        """
        tables = _peak_shape_error_tables(shots.window, shots.fft_size)
        squared_cell = (shots.fft_size / shots.window.length) ** 2
        spread = np.clip(
            np.sqrt(squared_shift / squared_cell), _SPREAD_GRID_CELLS[0], _SPREAD_GRID_CELLS[-1]
        )
        limited_square = np.minimum(squared_shift / squared_cell, _SPREAD_GRID_CELLS[-1] ** 2)
        limited_variance = np.minimum(variance / squared_cell, _QUADRATURE_SHIFT_VARIANCES[-1])
        log_variance = np.log(np.maximum(limited_variance, _QUADRATURE_SHIFT_VARIANCES[0]))
        sign, distance = np.sign(offset), np.abs(offset)
        (spread_error,) = interpolate_tables(
            (_SPREAD_GRID_CELLS, _SHAPE_OFFSETS_BINS), (tables.spread_error,), (spread, distance)
        )
        quadrature_error, quadrature_deviation = interpolate_tables(
            (_SPREAD_GRID_CELLS, np.log(_QUADRATURE_SHIFT_VARIANCES), _SHAPE_OFFSETS_BINS),
            (tables.quadrature_error, tables.quadrature_deviation),
            (spread, log_variance, distance),
        )
        return cls(
            sign * limited_square * spread_error,
            sign * limited_variance * quadrature_error,
            sign * limited_variance * quadrature_deviation,
        )


class PeakShapeErrorTables(NamedTuple):
    """Tables of :class:`PeakShapeErrors` by spread [fs/L], log variance, and offset [bins].

    fs/L is the sample rate over the number of samples in the record. The variance is that of the
    imaginary part of the complex shift [(fs/L)^2].
    """

    spread_error: np.ndarray
    """Error by the broadening of the line [bins], over b^2 [(fs/L)^2]; by spread and offset."""
    quadrature_error: np.ndarray
    """Mean error by the imaginary shift [bins], over its variance; by spread, log variance and
    offset."""
    quadrature_deviation: np.ndarray
    """Standard deviation of that error [bins], over the variance; by the same coordinates."""


@lru_cache(maxsize=16)
def _peak_shape_error_tables(window: Window, fft_size: int) -> PeakShapeErrorTables:
    """Tabulate errors of peak positions by deformed peaks."""
    interpolation, padding = interpolator(window, fft_size), fft_size / window.length
    n_samples = min(window.length, _SHAPE_SAMPLES_MAX)
    window_values = window_samples(window.name, n_samples)
    # Phase of a sample per bin, about the middle of the record.
    sample_phase = 2 * np.pi * (np.arange(n_samples) / n_samples - 0.5) / padding
    phase = sample_phase * (np.array([[-1.0], [0.0], [1.0]]) - _SHAPE_OFFSETS_BINS)[..., None]
    cosine, sine = np.cos(phase), np.sin(phase)
    spread_error = np.empty((len(_SPREAD_GRID_CELLS), _SHAPE_OFFSETS_BINS.size))
    mean, deviation = np.empty((2, len(_SPREAD_GRID_CELLS), *_quadrature_table_shape()))
    unbroadened = _offsets_of_magnitudes(np.abs(cosine @ window_values), interpolation)
    imaginary_shift = padding * np.sqrt(_QUADRATURE_SHIFT_VARIANCES)[:, None] * _SHAPE_NODES
    node_weights = _SHAPE_WEIGHTS / _SHAPE_WEIGHTS.sum()
    for i, spread in enumerate(_SPREAD_GRID_CELLS):
        taper = window_values * np.exp(-0.5 * (spread * padding * sample_phase) ** 2)
        line, slope = cosine @ taper, -(sine @ (taper * sample_phase))
        offset = _offsets_of_magnitudes(np.abs(line), interpolation)
        spread_error[i] = (offset - unbroadened) / spread**2
        magnitudes = np.hypot(
            line[:, None, None], imaginary_shift[..., None] * slope[:, None, None]
        )
        errors = _offsets_of_magnitudes(magnitudes, interpolation) - offset
        mean[i] = np.einsum("n,vno->vo", node_weights, errors)
        mean_square = np.einsum("n,vno->vo", node_weights, errors**2)
        deviation[i] = np.sqrt(np.maximum(mean_square - mean[i] ** 2, 0.0))
    mean /= _QUADRATURE_SHIFT_VARIANCES[:, None]
    deviation /= _QUADRATURE_SHIFT_VARIANCES[:, None]
    return PeakShapeErrorTables(spread_error, mean, deviation)


def _quadrature_table_shape() -> tuple[int, int]:
    """Return the numbers of tabulated variances and offsets."""
    return _QUADRATURE_SHIFT_VARIANCES.size, _SHAPE_OFFSETS_BINS.size


@njit(cache=True, error_model="numpy")
def _estimate_sub_bin_offsets(magnitudes, interpolation, offset):
    """Set ``offset`` (m,) to the estimates from magnitudes (3, m) below, at and above a bin."""
    for i in range(offset.size):
        offset[i] = estimate_sub_bin_offset(
            magnitudes[0, i], magnitudes[1, i], magnitudes[2, i], interpolation
        )


def _offsets_of_magnitudes(magnitudes: np.ndarray, interpolation: Interpolator) -> np.ndarray:
    """Return the estimated offset [bins] of peaks with magnitudes (3, ...) of three bins."""
    offset = np.empty(magnitudes.shape[1:])
    _estimate_sub_bin_offsets(
        np.ascontiguousarray(magnitudes.reshape(3, -1)), interpolation, offset.reshape(-1)
    )
    return offset


_TWO_BIN_SPREADS_CELLS = np.array([0.005, 0.03, 0.1, 0.2, 0.35, 0.6, 1.0, 2.0])
_TWO_BIN_SHIFT_RATIOS = np.geomspace(0.05, 200.0, 8)
_TWO_BIN_NOISE_RATIOS = np.concatenate([[1e-4], np.geomspace(2e-3, 0.3, 6)])
_TWO_BIN_OFFSETS_BINS = np.array(
    [0, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.65, 0.8, 1.0]
)
"""Coordinates of the tables of :func:`_two_bin_error_tables`: spread of the lines [fs/L], echo
fraction over relative power, noise per quadrature over the peak's |X|, and estimated offset."""
_TWO_BIN_DRAWS = 8192
"""Number of drawn peaks from which each entry of these tables is averaged."""
_EMPTY_TABLE_ENTRY_DRAWS = 2.0
"""Number of draws below which the value of a neighbouring offset is taken."""


def estimates_by_two_bins(shots: "Shots") -> bool:
    """Return True if positions are estimated from the strongest bin and its larger neighbour."""
    return interpolator(shots.window, shots.fft_size).magnitude_ratio_kind == TWO_BINS


class TwoBinErrors(NamedTuple):
    """Errors, beyond wander, of positions by the strongest bin and its larger neighbour, (m, 3).

    Notes
    -----
    In windows whose neighbours of a tone on a bin vanish, noise and speckle in quadrature with the
    line decide on the side of a peak near a bin. The error on the wrong side is twice the offset.
    Even on the right side, a complex shift D of a tone gives the estimate |D|, and not its real
    part. The errors are not small against the offset. So they are averages over draws, for peaks
    that have the estimated offset. Tones are anywhere between bins with equal density. To second
    order in the lines' spread b, the bin at the distance x from the tone is

        A (H(x) - i Im(s) H'(x) + Q H''(x) / 2).

    H is the broadened line of :class:`PeakShapeErrors`, s the complex shift, and Q = sum a z b^2
    (y^2 - 1) / A a circular Gaussian number of the variance 2 b^4 v / q^2. Noise is independent
    from bin to bin, as it is in the rectangular window.
    """

    mean: np.ndarray
    """(m, 3): mean error [bins]."""
    excess_variance: np.ndarray
    """(m, 3): variance about the mean [bins^2], beyond the standard error by noise that
    :func:`sweep.model.detection.sub_bin_interpolation.sub_bin_standard_error` states."""

    @classmethod
    def from_offset(
        cls,
        offset: np.ndarray,
        squared_shift: np.ndarray,
        shift_ratio: np.ndarray,
        noise_ratio: np.ndarray,
        shots: "Shots",
    ) -> "TwoBinErrors":
        """Return the errors of peaks at given estimated offsets from their strongest bin.

        Parameters
        ----------
        offset
            (m, 3): estimated offset of each peak [bins].
        squared_shift
            (m, 3): b^2, the variance of the lines' positions [bins^2].
        shift_ratio
            (m, 3): v / q^2, the echo fraction over the relative power.
        noise_ratio
            (m, 3): noise per quadrature over the peak's |X|.
        shots
            Prepared shots, for window, FFT size and rule of detection.
        """
        tables = _two_bin_error_tables(
            shots.window, shots.fft_size, shots.detection_settings.echo_bins == "peak_bin"
        )
        spread_cells = np.sqrt(squared_shift) * shots.window.length / shots.fft_size
        log_coordinates = (
            np.log(np.clip(values, grid[0], grid[-1]))
            for values, grid in (
                (spread_cells, _TWO_BIN_SPREADS_CELLS),
                (shift_ratio, _TWO_BIN_SHIFT_RATIOS),
                (noise_ratio, _TWO_BIN_NOISE_RATIOS),
            )
        )
        relative_mean, log_mean_square = interpolate_tables(
            _two_bin_error_grids(), tables, (*log_coordinates, np.abs(offset))
        )
        mean_square = np.exp(log_mean_square)
        mean = relative_mean * np.sqrt(mean_square)
        error_at_sigma = interpolator(shots.window, shots.fft_size).error_at_sigma
        noise_error = noise_ratio * np.interp(
            np.abs(offset), np.linspace(0, 1, error_at_sigma.size), error_at_sigma
        )
        variance = mean_square - mean**2 - np.minimum(noise_error, 0.5) ** 2
        return cls(np.sign(offset) * mean, np.maximum(variance, 0.0))


@lru_cache(maxsize=8)
def _two_bin_error_tables(
    window: Window, fft_size: int, keeps_strongest_bin: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Tabulate moments of :class:`TwoBinErrors`.

    ``keeps_strongest_bin`` is True if peaks are estimated about the bin that is strongest without
    noise and speckle; else they are estimated about the largest bin.

    Returns
    -------
    relative_mean : ndarray
        Mean error over its root mean square, by the logarithms of spread, shift ratio and noise
        ratio, and by offset.
    log_mean_square : ndarray
        Logarithm of the mean square error [bins^2], by the same coordinates.
    """
    interpolation, padding = interpolator(window, fft_size), fft_size / window.length
    n_samples = min(window.length, _SHAPE_SAMPLES_MAX)
    window_values = window_samples(window.name, n_samples)
    sample_phase = 2 * np.pi * (np.arange(n_samples) / n_samples - 0.5) / padding
    distance = np.linspace(-2.0, 1.0, 385)
    cosine, sine = (f(np.outer(distance, sample_phase)) for f in (np.cos, np.sin))
    rng = np.random.default_rng(0)
    position = rng.uniform(0.0, 1.0 if keeps_strongest_bin else 0.75, _TWO_BIN_DRAWS)
    imaginary_shift = rng.normal(size=_TWO_BIN_DRAWS)
    curvature, noise_below, noise_above = rng.normal(size=(3, _TWO_BIN_DRAWS)) + 1j * rng.normal(
        size=(3, _TWO_BIN_DRAWS)
    )
    mean, mean_square = np.empty((2, *(grid.size for grid in _two_bin_error_grids())))
    for i, spread in enumerate(_TWO_BIN_SPREADS_CELLS * padding):
        taper = window_values * np.exp(-0.5 * (spread * sample_phase) ** 2)
        line, slope, second_slope = (
            np.stack([np.interp(k - position, distance, values) for k in (-1, 0, 1)])
            for values in (
                cosine @ taper,
                -(sine @ (taper * sample_phase)),
                -(cosine @ (taper * sample_phase**2)),
            )
        )
        for j, ratio in enumerate(_TWO_BIN_SHIFT_RATIOS):
            shift = spread * np.sqrt(ratio / 2) * imaginary_shift
            bins = line - 1j * shift * slope
            bins += 0.5 * spread**2 * np.sqrt(ratio) * curvature * second_slope
            centre = np.abs(bins[1])
            for k, noise_ratio in enumerate(_TWO_BIN_NOISE_RATIOS):
                noise = noise_ratio * centre
                below = np.abs(bins[0] + noise * noise_below)
                above = np.abs(bins[2] + noise * noise_above)
                estimate = _offsets_of_magnitudes(np.stack([below, centre, above]), interpolation)
                is_peak = keeps_strongest_bin | (np.maximum(below, above) <= centre)
                error = np.abs(estimate) - np.where(estimate < 0, -position, position)
                mean[i, j, k], mean_square[i, j, k] = _mean_errors_by_offset(
                    np.abs(estimate)[is_peak], error[is_peak]
                )
    return mean / np.sqrt(mean_square), np.log(mean_square)


def _two_bin_error_grids() -> tuple[np.ndarray, ...]:
    """Return the coordinates of :func:`_two_bin_error_tables`, in the order of their axes."""
    return (
        np.log(_TWO_BIN_SPREADS_CELLS),
        np.log(_TWO_BIN_SHIFT_RATIOS),
        np.log(_TWO_BIN_NOISE_RATIOS),
        _TWO_BIN_OFFSETS_BINS,
    )


def _mean_errors_by_offset(offset: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and mean square of errors (m,) at the tabulated offsets, from peaks near each."""
    n_offsets = _TWO_BIN_OFFSETS_BINS.size
    position = np.interp(offset, _TWO_BIN_OFFSETS_BINS, np.arange(n_offsets))
    index = np.minimum(position.astype(int), n_offsets - 2)
    above = position - index
    weight, weighted_error, weighted_square = (
        np.bincount(index, values * (1 - above), n_offsets)
        + np.bincount(index + 1, values * above, n_offsets)
        for values in (np.ones_like(error), error, error**2)
    )
    is_known = weight > _EMPTY_TABLE_ENTRY_DRAWS
    known_weight = weight[is_known]
    return (
        np.interp(
            _TWO_BIN_OFFSETS_BINS, _TWO_BIN_OFFSETS_BINS[is_known],
            weighted_error[is_known] / known_weight,
        ),
        np.interp(
            _TWO_BIN_OFFSETS_BINS, _TWO_BIN_OFFSETS_BINS[is_known],
            weighted_square[is_known] / known_weight + 1e-14,
        ),
    )  # fmt: skip
