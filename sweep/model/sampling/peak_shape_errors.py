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

_TABULATED_SPREADS_CELLS = np.array(
    [0.01, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.3, 1.7, 2.2, 3.0, 4.0]
)
"""Standard deviations of a footprint's lines for which errors are tabulated [resolution cells]. A
cell is the sample rate over the number of samples in the record."""
_IMAGINARY_SHIFT_VARIANCES = np.concatenate([[1e-4], np.geomspace(3e-3, 30.0, 13)])
"""Variances of Im s for which errors are tabulated [squared resolution cells]. s is the complex
shift by which speckle deforms a peak (:class:`PeakShapeErrors`). A cell is the sample rate over the
number of samples in the record."""
_SHAPE_OFFSETS_BINS = np.linspace(0.0, 1.0, 33)
"""Distances of a peak from its strongest bin for which errors are tabulated [bins]."""
_SHAPE_SAMPLES_MAX = 2048
"""Largest number of window samples that is used to compute deformed peaks."""
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
    """(m, 3): error of the peak position [bins] because the footprint broadens the line, equation
    (1) of the class."""
    imaginary_shift_error: np.ndarray
    """(m, 3): mean error of the peak position [bins] due to the imaginary part of the complex
    shift, equation (2) of the class."""
    imaginary_shift_deviation: np.ndarray
    """(m, 3): standard deviation [bins] of the error due to the imaginary part of the complex
    shift. It has the sign of the mean error at small shifts."""

    @classmethod
    def from_offset(
        cls, offset: np.ndarray, squared_shift: np.ndarray, variance: np.ndarray, shots: "Shots"
    ) -> "PeakShapeErrors":
        """Return the position errors of peaks at given offsets from their strongest bin.

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
            np.sqrt(squared_shift / squared_cell),
            _TABULATED_SPREADS_CELLS[0],
            _TABULATED_SPREADS_CELLS[-1],
        )
        limited_square = np.minimum(squared_shift / squared_cell, _TABULATED_SPREADS_CELLS[-1] ** 2)
        limited_variance = np.minimum(variance / squared_cell, _IMAGINARY_SHIFT_VARIANCES[-1])
        log_variance = np.log(np.maximum(limited_variance, _IMAGINARY_SHIFT_VARIANCES[0]))
        sign, distance = np.sign(offset), np.abs(offset)
        (spread_error,) = interpolate_tables(
            (_TABULATED_SPREADS_CELLS, _SHAPE_OFFSETS_BINS),
            (tables.spread_error,),
            (spread, distance),
        )
        imaginary_shift_error, imaginary_shift_deviation = interpolate_tables(
            (_TABULATED_SPREADS_CELLS, np.log(_IMAGINARY_SHIFT_VARIANCES), _SHAPE_OFFSETS_BINS),
            (tables.imaginary_shift_error, tables.imaginary_shift_deviation),
            (spread, log_variance, distance),
        )
        return cls(
            sign * limited_square * spread_error,
            sign * limited_variance * imaginary_shift_error,
            sign * limited_variance * imaginary_shift_deviation,
        )


class PeakShapeErrorTables(NamedTuple):
    """Tables of :class:`PeakShapeErrors` by spread, log variance, and offset [bins].

    The spread is in resolution cells: sample rate over number of samples in the record. The
    variance is that of the imaginary part of the complex shift [squared cells].
    """

    spread_error: np.ndarray
    """Position error [bins] because a footprint broadens the line, divided by b^2 [squared
    resolution cells], with b the spread of the lines. Axes are spread and offset."""
    imaginary_shift_error: np.ndarray
    """Mean position error [bins] due to the imaginary part of the complex shift, divided by the
    variance of this part. Axes are spread, log variance and offset."""
    imaginary_shift_deviation: np.ndarray
    """Standard deviation [bins] of the error due to the imaginary part of the complex shift,
    divided by the variance of this part. Axes are spread, log variance and offset."""


@lru_cache(maxsize=16)
def _peak_shape_error_tables(window: Window, fft_size: int) -> PeakShapeErrorTables:
    """Return the :class:`PeakShapeErrorTables` of a window.

    Peaks are deformed by the spread of a footprint's lines and by speckle. The errors are those of
    positions that are estimated from the magnitudes of three bins.
    """
    interpolation, padding = interpolator(window, fft_size), fft_size / window.length
    n_samples = min(window.length, _SHAPE_SAMPLES_MAX)
    window_values = window_samples(window.name, n_samples)
    # Phase of a sample per bin, about the middle of the record.
    sample_phase = 2 * np.pi * (np.arange(n_samples) / n_samples - 0.5) / padding
    phase = sample_phase * (np.array([[-1.0], [0.0], [1.0]]) - _SHAPE_OFFSETS_BINS)[..., None]
    cosine, sine = np.cos(phase), np.sin(phase)
    spread_error = np.empty((len(_TABULATED_SPREADS_CELLS), _SHAPE_OFFSETS_BINS.size))
    mean, deviation = np.empty((2, len(_TABULATED_SPREADS_CELLS), *_imaginary_shift_table_shape()))
    unbroadened = _offsets_of_magnitudes(np.abs(cosine @ window_values), interpolation)
    imaginary_shift = padding * np.sqrt(_IMAGINARY_SHIFT_VARIANCES)[:, None] * _SHAPE_NODES
    node_weights = _SHAPE_WEIGHTS / _SHAPE_WEIGHTS.sum()
    for i, spread in enumerate(_TABULATED_SPREADS_CELLS):
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
    mean /= _IMAGINARY_SHIFT_VARIANCES[:, None]
    deviation /= _IMAGINARY_SHIFT_VARIANCES[:, None]
    return PeakShapeErrorTables(spread_error, mean, deviation)


def _imaginary_shift_table_shape() -> tuple[int, int]:
    """Return the numbers of tabulated variances and offsets, in this order."""
    return _IMAGINARY_SHIFT_VARIANCES.size, _SHAPE_OFFSETS_BINS.size


@njit(cache=True, error_model="numpy")
def _estimate_sub_bin_offsets(magnitudes, interpolation, offset):
    """Fill ``offset`` (m,) with estimated offsets of peaks from a bin [bins].

    The magnitudes (3, m) are those of the bin below, the bin itself, and the bin above.
    """
    for i in range(offset.size):
        offset[i] = estimate_sub_bin_offset(
            magnitudes[0, i], magnitudes[1, i], magnitudes[2, i], interpolation
        )


def _offsets_of_magnitudes(magnitudes: np.ndarray, interpolation: Interpolator) -> np.ndarray:
    """Return the estimated offsets (...) [bins] of peaks from the middle one of three bins.

    ``magnitudes`` (3, ...) are those of the bin below, the middle bin, and the bin above.
    """
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
"""Estimated offsets of a peak from its strongest bin for which two-bin errors are tabulated [bins].
The three arrays before are the other coordinates of the tables: spread of the lines [resolution
cells], echo fraction over relative power, and noise per quadrature over the peak's |X|."""
_TWO_BIN_DRAWS_PER_ENTRY = 4096
"""Number of drawn peaks over which each entry of the two-bin tables is averaged."""
_TWO_BIN_LINES, _TWO_BIN_LINE_POWERS = np.polynomial.hermite_e.hermegauss(24)
"""Positions y_j of the lines of a drawn footprint, in units of the spread, and their powers a_j^2.
"""
_TWO_BIN_SEARCH_BINS = 5
"""Largest distance [bins] from bin 0 at which the mean echo of a drawn footprint may be largest."""
_VARIANCE_ADDED_BEFORE_LOG = 1e-10
"""Variance [bins^2] that is added to the variances of the two-bin tables, so that their logarithms
are finite."""
_TABLE_ENTRY_DRAWS_MIN = 2.0
"""Smallest effective number of draws of an entry of the two-bin tables. An entry with fewer draws
is interpolated from entries at other offsets."""


def uses_two_bin_estimator(shots: "Shots") -> bool:
    """Return True if positions are estimated from the strongest bin and its larger neighbour."""
    return interpolator(shots.window, shots.fft_size).magnitude_ratio_kind == TWO_BINS


class TwoBinErrors(NamedTuple):
    """Errors of positions by the strongest bin and its larger neighbour, (m, 3).

    Notes
    -----
    With some windows a tone in the middle of a bin leaves no signal in the neighbouring bins. Noise
    and speckle then decide on which side of the bin a peak near its middle seems to be. On the
    wrong side the error is twice the offset. A dim peak is the slope of its neighbours' light, and
    wanders by less than the linear law says. None of these errors is small against the offset. So
    they are averages over drawn lines, given the power of the peak bin and the estimated offset.
    Line j is at b y_j from the tone, with the spread b, and has the weight a_j and a complex
    Gaussian amplitude z_j. Tones are at any position between bins with equal density. Noise is
    independent from bin to bin, as it is in the rectangular window.

    Two segments share speckle, so their errors are correlated. The common part is the linear
    wander w = b Re(sum a z y / X) of the peak X, times a gain: the regression of the error on w.
    """

    mean: np.ndarray
    """(m, 3): mean error of the peak position [bins]."""
    wander_gain: np.ndarray
    """(m, 3): slope of the regression of the position error on the linear wander w, the shift of
    the peak by speckle to first order."""
    excess_variance: np.ndarray
    """(m, 3): variance of the position error [bins^2] minus two parts: the variance of the product
    of ``wander_gain`` and the linear wander, and the square of the standard error by noise
    (:func:`sweep.model.detection.sub_bin_interpolation.sub_bin_standard_error`)."""

    @classmethod
    def from_offset(
        cls,
        offset: np.ndarray,
        squared_shift: np.ndarray,
        shift_ratio: np.ndarray,
        noise_ratio: np.ndarray,
        shots: "Shots",
    ) -> "TwoBinErrors":
        """Return the position errors of peaks at given estimated offsets from their strongest bin.

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
            shots.window, shots.fft_size, shots.detection_settings.echo_bin_rule == "peak_bin"
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
        relative_mean, log_variance, wander_gain = interpolate_tables(
            _two_bin_error_grids(), tables, (*log_coordinates, np.abs(offset))
        )
        variance = np.exp(log_variance)
        mean = relative_mean * np.sqrt(variance)
        error_at_unit_signal = interpolator(shots.window, shots.fft_size).error_at_unit_signal
        noise_error = noise_ratio * np.interp(
            np.abs(offset), np.linspace(0, 1, error_at_unit_signal.size), error_at_unit_signal
        )
        variance -= np.minimum(noise_error, 0.5) ** 2
        return cls(np.sign(offset) * mean, wander_gain, np.maximum(variance, 0.0))


class TwoBinErrorTables(NamedTuple):
    """Tables of :class:`TwoBinErrors`.

    Coordinates are the logarithms of spread, shift ratio and noise ratio, and the offset.
    """

    relative_mean: np.ndarray
    """Mean position error, divided by the square root of the variance whose logarithm is
    ``log_variance``."""
    log_variance: np.ndarray
    """Logarithm of the residual variance [bins^2]: variance of the position error, noise included,
    minus the variance of the product of ``wander_gain`` and the linear wander."""
    wander_gain: np.ndarray
    """Slope of the regression of the position error on the linear wander, the shift of the peak by
    speckle to first order."""


@lru_cache(maxsize=8)
def _two_bin_error_tables(
    window: Window, fft_size: int, keeps_strongest_bin: bool
) -> TwoBinErrorTables:
    """Tabulate mean, variance and wander gain of the position errors of randomly drawn peaks.

    ``keeps_strongest_bin`` is True if peaks are estimated about the bin that is strongest without
    noise and speckle, False if about the largest bin.
    """
    interpolation, padding = interpolator(window, fft_size), fft_size / window.length
    bins = np.arange(-1, 2) if keeps_strongest_bin else np.arange(-2, 3)
    centre = bins.size // 2
    # About the bin that is strongest without speckle, a neighbour may be the largest of the three.
    largest_bins = range(bins.size) if keeps_strongest_bin else (centre,)
    rng = np.random.default_rng(0)
    shape = tuple(grid.size for grid in _two_bin_error_grids())
    mean, log_variance, gain = np.empty((3, *shape))
    for i, spread in enumerate(_TWO_BIN_SPREADS_CELLS * padding):
        tone_position_max = 0.5 if keeps_strongest_bin else 1.5 + spread
        footprints = _DrawnFootprints.draw(rng, window, padding, spread, tone_position_max, bins)
        for k, noise_ratio in enumerate(_TWO_BIN_NOISE_RATIOS):
            known_moments = None
            for j, shift_ratio in enumerate(_TWO_BIN_SHIFT_RATIOS):
                peaks = [
                    footprints.errors_and_weights(shift_ratio, noise_ratio, index, interpolation)
                    for index in largest_bins
                ]
                moments = _moments_by_offset(*np.concatenate(peaks, axis=1))
                # A wide footprint hardly ever has a largest bin that is very dim.
                known_moments = moments if moments is not None else known_moments
                assert known_moments is not None
                mean[i, j, k], log_variance[i, j, k], gain[i, j, k] = known_moments
    return TwoBinErrorTables(mean / np.exp(0.5 * log_variance), log_variance, gain)


class _DrawnFootprints(NamedTuple):
    """Random lines about tones at random positions, and their echo and noise in bins about 0.

    There are m draws. Echo amplitudes and noise have mean power 1.
    """

    bins: np.ndarray
    """(bins,): numbers of the bins."""
    tone_position: np.ndarray
    """(m,): position of the middle of each footprint's lines [bins]."""
    echo: np.ndarray
    """(bins, m) complex: echo of each footprint's lines in each bin."""
    echo_covariance: np.ndarray
    """(bins, bins, m): covariance of the echo in two bins, over random amplitudes of the lines."""
    noise: np.ndarray
    """(bins, m) complex: noise in each bin."""
    weighted_offset: np.ndarray
    """(m,): b Re(sum_j a_j y_j z_j), with the spread b of the lines [bins], and for line j the
    weight a_j, the relative offset y_j and the random amplitude z_j."""
    weighted_offset_covariance: np.ndarray
    """(bins, m): covariance, with the echo in each bin, of the complex sum b sum_j a_j y_j z_j
    [bins]. Symbols are those of ``weighted_offset``."""
    strongest_mean_power: np.ndarray
    """(m,): mean power of the echo in the bin where this power is largest."""

    @classmethod
    def draw(
        cls,
        rng: np.random.Generator,
        window: Window,
        padding: float,
        spread: float,
        tone_position_max: float,
        bins: np.ndarray,
    ) -> "_DrawnFootprints":
        """Draw the echo and noise of m footprints about tones at random positions.

        The tone of each footprint is at a position x, uniform between the limits. The echo in bin k
        is

            sum_j a_j z_j G(k - x - b y_j)

        with the window's transform G, 1 at distance 0, the spread b of the lines, and for line j
        its relative offset y_j, weight a_j and complex Gaussian amplitude z_j of mean power 1.
        Noise is independent from bin to bin.

        Parameters
        ----------
        rng : numpy.random.Generator
            Source of the random numbers.
        window : Window
            Window of the record (:class:`sweep.model.window.Window`).
        padding : float
            FFT size over the number of samples in the record.
        spread : float
            Spread b: standard deviation of the lines' positions [bins].
        tone_position_max : float
            Largest distance of a tone from bin 0 [bins].
        bins : ndarray (bins,) int64
            Numbers of the bins.

        Returns
        -------
        _DrawnFootprints
            ``_TWO_BIN_DRAWS_PER_ENTRY`` footprints.
        """
        n_samples = min(window.length, _SHAPE_SAMPLES_MAX)
        window_values = window_samples(window.name, n_samples)
        sample_phase = 2 * np.pi * (np.arange(n_samples) / n_samples - 0.5) / padding
        powers = _TWO_BIN_LINE_POWERS / _TWO_BIN_LINE_POWERS.sum()
        tone_position = rng.uniform(-tone_position_max, tone_position_max, _TWO_BIN_DRAWS_PER_ENTRY)
        line_positions = tone_position + spread * _TWO_BIN_LINES[:, None]
        reach = np.abs(line_positions).max() + _TWO_BIN_SEARCH_BINS
        distance = np.linspace(-reach, reach, int(128 * reach))
        transform = np.cos(np.outer(distance, sample_phase)) @ window_values / window_values.sum()
        mean_powers = [
            powers @ np.interp(bin_ - line_positions, distance, transform) ** 2
            for bin_ in range(-_TWO_BIN_SEARCH_BINS, _TWO_BIN_SEARCH_BINS + 1)
        ]
        shapes = np.interp(bins[:, None, None] - line_positions, distance, transform)
        amplitudes, noise = (
            (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)
            for shape in (
                (powers.size, _TWO_BIN_DRAWS_PER_ENTRY),
                (bins.size, _TWO_BIN_DRAWS_PER_ENTRY),
            )
        )
        weighted_offsets = spread * np.sqrt(powers) * _TWO_BIN_LINES
        return cls(
            bins=bins,
            tone_position=tone_position,
            echo=np.einsum("l,klm,lm->km", np.sqrt(powers), shapes, amplitudes),
            echo_covariance=np.einsum("l,jlm,klm->jkm", powers, shapes, shapes),
            noise=noise,
            weighted_offset=weighted_offsets @ amplitudes.real,
            weighted_offset_covariance=np.einsum(
                "l,klm->km", weighted_offsets * np.sqrt(powers), shapes
            ),
            strongest_mean_power=np.max(mean_powers, axis=0),
        )

    def errors_and_weights(
        self,
        shift_ratio: float,
        noise_ratio: float,
        largest_index: int,
        interpolation: Interpolator,
    ) -> np.ndarray:
        """Return errors of peaks, scaled to X = 1 in the largest bin, and weights of the draws.

        Parameters
        ----------
        shift_ratio
            Mean power of the echo in the bin where it is largest, over the peak's power: v / q^2.
        noise_ratio
            Noise per quadrature, over the peak's |X|.
        largest_index
            Index of the largest bin.
        interpolation
            Estimator by the strongest bin and its larger neighbour.

        Returns
        -------
        numpy.ndarray
            (4, m): size of the estimated offset [bins]; error [bins], and linear wander [bins],
            both positive away from the middle bin on the side of the estimate; and weight.

        Notes
        -----
        Echo and noise were drawn for any X, and are moved to X = 1: a Gaussian number Y becomes
        Y + cov(Y, X) (1 - X) / var(X). The weight is the density exp(-1 / var(X)) / var(X) of X at
        1, and 0 if another bin is larger. For any X the wander has the variance b^2 v / (2 q^2),
        which :func:`sweep.model.sampling.speckle_lines.position_error_moments` uses. Given X,
        bright peaks have up to 1.6 times this, and dim ones a third of it: their standard errors
        are up to 1.25 times too large.
        """
        ratio, noise_power = shift_ratio / self.strongest_mean_power, 2 * noise_ratio**2
        drawn = np.sqrt(ratio) * self.echo + np.sqrt(noise_power) * self.noise
        variance = ratio * self.echo_covariance[largest_index, largest_index] + noise_power
        correction = ratio * (1 - drawn[largest_index]) / variance
        spectrum = drawn + self.echo_covariance[largest_index] * correction
        spectrum[largest_index] = 1.0
        magnitude, middle = np.abs(spectrum), self.bins.size // 2
        shift = (
            np.sqrt(ratio) * self.weighted_offset
            + self.weighted_offset_covariance[largest_index] * correction.real
        )
        estimate = _offsets_of_magnitudes(magnitude[middle - 1 : middle + 2], interpolation)
        density = np.exp(1 / variance.max() - 1 / variance) / variance
        side = np.where(estimate < 0, -1.0, 1.0)
        return np.stack(
            [
                np.abs(estimate),
                side * (estimate - self.tone_position),
                side * shift * np.sqrt(self.strongest_mean_power),
                np.where(magnitude.max(axis=0) <= 1, density, 0.0),
            ]
        )


def _two_bin_error_grids() -> tuple[np.ndarray, ...]:
    """Return the coordinates of :func:`_two_bin_error_tables`, in the order of the tables' axes."""
    return (
        np.log(_TWO_BIN_SPREADS_CELLS),
        np.log(_TWO_BIN_SHIFT_RATIOS),
        np.log(_TWO_BIN_NOISE_RATIOS),
        _TWO_BIN_OFFSETS_BINS,
    )


def _moments_by_offset(
    offset: np.ndarray, error: np.ndarray, shift: np.ndarray, draw_weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return mean error, logarithm of the residual variance, and gain, at the tabulated offsets.

    Arguments are (m,), by draw: estimated offset, error, shift (linear wander) and weight. The gain
    is the slope of the regression of the error on the shift. The residual variance [bins^2] is the
    variance of the error about this regression. A draw counts at the two tabulated offsets next to
    its own offset. The result is None if no offset has _TABLE_ENTRY_DRAWS_MIN draws.
    """
    n_offsets = _TWO_BIN_OFFSETS_BINS.size
    position = np.interp(offset, _TWO_BIN_OFFSETS_BINS, np.arange(n_offsets))
    index = np.minimum(position.astype(int), n_offsets - 2)
    above = position - index

    def sums(values: np.ndarray) -> np.ndarray:
        return np.asarray(
            np.bincount(index, values * (1 - above), n_offsets)
            + np.bincount(index + 1, values * above, n_offsets)
        )

    weight = sums(draw_weight)
    is_known = weight**2 > _TABLE_ENTRY_DRAWS_MIN * sums(draw_weight**2)
    if not is_known.any():
        return None
    mean_error, mean_shift, squared_error, squared_shift, product = (
        sums(draw_weight * values)[is_known] / weight[is_known]
        for values in (error, shift, error**2, shift**2, error * shift)
    )
    gain = (product - mean_error * mean_shift) / (squared_shift - mean_shift**2)
    variance = squared_error - mean_error**2 - gain * (product - mean_error * mean_shift)
    log_variance = np.log(np.maximum(variance, 0.0) + _VARIANCE_ADDED_BEFORE_LOG)
    known_offsets = _TWO_BIN_OFFSETS_BINS[is_known]
    mean_error, log_variance, gain = (
        np.interp(_TWO_BIN_OFFSETS_BINS, known_offsets, values)
        for values in (mean_error, log_variance, gain)
    )
    return mean_error, log_variance, gain
