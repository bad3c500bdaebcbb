"""Position of a tone between bins, from the magnitudes of the largest bin and its two neighbours.

With the window's transform W at the spacing of the bins, a lone tone delta bins past the centre bin
has the magnitudes |W(-1 - delta)|, |W(-delta)|, |W(1 - delta)|. The inversion depends on the
window:

- If the neighbours of a tone on a bin are strong (Hann, Hamming, wider windows), the
  magnitude ratio (above - below) / (below + 2 centre + above) is inverted by a table (for Hann it
  is delta / 2). One step of least squares follows, weighted by the noise's covariance between the
  three bins. It gives the least error that three magnitudes allow.
- If the neighbours vanish (rectangular window), the larger one gives the side. The
  magnitude ratio is larger / (centre + larger), which is delta itself for the rectangular window.

The tables follow from the window's transform, so the position of a noise-free single tone is exact
(1e-6 bins). Three things bias the estimate: other lines within the main lobe, the tone's image near
DC and Nyquist, and a footprint that spreads over bins. The estimate then refers to the centre of
the footprint. Noise biases it in the rectangular window, where the wrong neighbour may be larger.

An echo that arrives after its record has begun lacks the first samples, and its line has the shape
of a shortened window. :func:`late_echo_correction` corrects the position. The instrument knows its
window and, from the strongest bin, the delay. The correction is exact for a single tone.

A footprint whose lines add as powers and spread by s [bins, standard deviation] about their mean
broadens the peak. This changes the estimate in proportion to s^2, by the tabulated
``spread_error_factor``.

The standard error follows to first order from the noise in phase with the signal, which the window
correlates between bins. It does not reach the Cramer-Rao bound
(:mod:`sweep.model.detection.estimators`), which is that of the whole record without a window.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev

from sweep.kernel_cache import njit
from sweep.model.table_interpolation import interpolate_tables
from sweep.model.window import Window, window_samples

_N_TABLE_INTERVALS = 2048
"""Number of intervals in the tables that turn magnitudes into an offset of a tone from a bin.
Linear interpolation in these tables errs by about 1e-7 bins."""

_N_SPREAD_POSITIONS, _SPREAD_BINS = 129, 0.05
"""Number of positions between bins at which ``spread_error_factor`` is evaluated, and standard
deviation [bins] of the spread lines in this evaluation."""

_TONE_POLYNOMIAL_DEGREE = 32
"""Degree of the polynomial that gives a bin's complex value at -2 .. 2 bins from a tone."""

_NEIGHBOUR_MAGNITUDE_RATIO_MIN = 0.25
"""Ratio below which a tone's position is estimated from TWO_BINS: |X| of the neighbour of a bin on
which a tone lies over |X| of that bin."""

THREE_BINS, TWO_BINS = 0, 1
"""Kinds of magnitude ratio from which a tone's position between bins is estimated. THREE_BINS uses
the |X| of three bins, TWO_BINS that of the centre bin and its larger neighbour."""


class NoiseMixing(NamedTuple):
    """Cholesky factors of the noise covariance of three adjacent bins.

    Let z0, z1, z2 be independent standard normal numbers. The noise in one quadrature is the sum of
    ``neighbours_from_centre`` z0 and ``above_from_independent`` z1 in the bin above, z0 in the
    centre bin, and the sum of ``neighbours_from_centre`` z0, ``below_from_above`` z1 and
    ``below_from_independent`` z2 in the bin below.
    """

    neighbours_from_centre: float
    """Factor on z0, the noise of the centre bin, in the noise of both neighbouring bins."""
    above_from_independent: float
    """Factor on z1 in the noise of the bin above: the part independent of the centre bin's noise.
    """
    below_from_above: float
    """Factor on z1 in the noise of the bin below."""
    below_from_independent: float
    """Factor on z2 in the noise of the bin below: the part independent of the noise of both other
    bins."""


class NeighbourWeights(NamedTuple):
    """Least-squares weights of the |X| of three bins in the position of a tone.

    Weights are tabulated over the tone's distance from the centre bin, (m,) each. They apply to |X|
    over the |X| of the centre bin. If only two bins give the position, all weights are 0.
    """

    smaller: np.ndarray
    """(m,): weight [bins] of the |X| of the smaller neighbour of the centre bin."""
    centre: np.ndarray
    """(m,): weight [bins] of the |X| of the centre bin."""
    larger: np.ndarray
    """(m,): weight [bins] of the |X| of the larger neighbour of the centre bin."""


class Interpolator(NamedTuple):
    """Tables of a window and FFT size that convert three magnitudes to a position between bins.

    m is the number of tabulated positions in 0 .. 1 bin.
    """

    magnitude_ratio_kind: int
    """Kind of the magnitude ratio from which a tone's position follows, THREE_BINS or TWO_BINS:
    number of bins whose |X| enter the ratio."""
    magnitude_ratio_at_centre: float
    """Magnitude ratio (a ratio of the bins' |X|) for a tone on the centre bin."""
    magnitude_ratio_step: float
    """Spacing of the magnitude ratios (ratios of the bins' |X|) at which ``offset`` is
    tabulated."""
    offset: np.ndarray
    """(m,): distance of the tone from the centre bin [bins], 0 .. 1. The magnitude ratio
    rises from ``magnitude_ratio_at_centre`` by ``magnitude_ratio_step``."""
    neighbour_weights: NeighbourWeights
    """(m,) in each field: weights by which the |X| of the three bins correct the position."""
    error_at_unit_signal: np.ndarray
    """(m,): standard error of the position [bins] if the centre bin's |X| equals the noise per
    quadrature, by the tone's distance from the centre bin. The error falls as 1/|X|."""
    noise_mixing: NoiseMixing
    """Factors on independent normal numbers whose sums are the noise of three adjacent bins."""
    sidelobe_neighbour_noise_correlation: float
    """Correlation of neighbouring bins' noise components in phase with a tone's sidelobes. Among N
    successive bins of sidelobes, L have the opposite sign of the bin below. N is the FFT size, L
    the number of samples in the record."""
    spread_error_factor: np.ndarray
    """(m,): error of the position [bins] over the variance [bins^2] of lines that add as powers. It
    is tabulated over the tone's distance from the centre bin."""


@lru_cache(maxsize=64)
def in_phase_noise_correlations(window: Window, fft_size: int) -> tuple[float, float]:
    """Return the noise correlations of two bins that are one bin apart, and two bins apart.

    The correlations are those of the noise components in phase with the main lobe of a tone.

    Parameters
    ----------
    window : Window
        Window of the record, of L samples (:class:`sweep.model.window.Window`).
    fft_size : int
        FFT size N >= L.

    Returns
    -------
    correlation_1, correlation_2 : float
        Correlation, -1..1, of bins that are d = 1 and d = 2 bins apart.

    Notes
    -----
    sum_n w_n^2 cos(2 pi d (n - L/2) / N) / sum_n w_n^2, with the samples w_n of the window.
    """
    squared_window = window_samples(window.name, window.length) ** 2
    record_position = (np.arange(window.length) - window.length / 2) / fft_size
    correlation_1, correlation_2 = (
        float((squared_window * np.cos(2 * np.pi * d * record_position)).sum()) for d in (1, 2)
    )
    return correlation_1 / window.energy, correlation_2 / window.energy


def sidelobe_neighbour_noise_correlation(window: Window, fft_size: int) -> float:
    """Return the correlation of adjacent bins' noise components in phase with a tone's sidelobes.

    Parameters
    ----------
    window : Window
        Window of the record, of L samples (:class:`sweep.model.window.Window`).
    fft_size : int
        FFT size N >= L.

    Returns
    -------
    float
        Correlation, -1..1: the first of :func:`in_phase_noise_correlations` times 1 - 2 L/N.

    Notes
    -----
    Among N successive bins of sidelobes, L have the opposite sign of the bin below. The mean
    product of the signs of two adjacent bins is thus 1 - 2 L/N.
    """
    correlation_1, _ = in_phase_noise_correlations(window, fft_size)
    return correlation_1 * (1.0 - 2.0 * window.length / fft_size)


@lru_cache(maxsize=32)
def interpolator(window: Window, fft_size: int) -> Interpolator:
    """Return the tables that give a peak's position from three magnitudes (cached).

    Parameters
    ----------
    window : Window
        Window of the record, of L samples (:class:`sweep.model.window.Window`).
    fft_size : int
        FFT size N >= L.

    Returns
    -------
    Interpolator
        Tables over the magnitude ratio, and over the tone's offset of 0 .. 1 bin.

    Notes
    -----
    Let below, centre and above be |X| of the three bins. The magnitude ratio is

        (above - below) / (below + 2 centre + above),

    or above / (centre + above) if the neighbours of a tone on a bin vanish. For a flat-top window
    in a padded FFT, no ratio of the magnitudes rises with the offset of the tone from the centre
    bin. The offset is then given as 0, with an error that :func:`sub_bin_standard_error` limits to
    half a bin.
    """
    offset = np.arange(_N_TABLE_INTERVALS + 1) / _N_TABLE_INTERVALS
    tone_magnitudes = _tone_magnitudes(window, fft_size, offset)
    below, centre, above = tone_magnitudes
    neighbours_vanish = above[0] < _NEIGHBOUR_MAGNITUDE_RATIO_MIN * centre[0]
    magnitude_ratios = (
        above / (centre + above)
        if neighbours_vanish
        else (above - below) / (tone_magnitudes.sum(0) + centre)
    )
    correlation_1, correlation_2 = in_phase_noise_correlations(window, fft_size)
    weight, error = _least_squares_weights(
        tone_magnitudes, offset, correlation_1, correlation_2, two_bins=bool(neighbours_vanish)
    )
    if not (np.diff(magnitude_ratios[: _N_TABLE_INTERVALS // 2 + 1]) > 0).all():
        weight, error, offset = 0 * weight, np.full_like(error, 1e30), 0 * offset
    magnitude_ratios = np.maximum.accumulate(magnitude_ratios)
    even_ratios = np.linspace(magnitude_ratios[0], magnitude_ratios[-1], _N_TABLE_INTERVALS + 1)
    interpolation = Interpolator(
        magnitude_ratio_kind=TWO_BINS if neighbours_vanish else THREE_BINS,
        magnitude_ratio_at_centre=float(magnitude_ratios[0]),
        magnitude_ratio_step=max(float(even_ratios[1] - even_ratios[0]), 1e-12),
        offset=np.interp(even_ratios, magnitude_ratios, offset),
        neighbour_weights=NeighbourWeights(*(0 * weight if neighbours_vanish else weight)),
        error_at_unit_signal=error,
        noise_mixing=_noise_mixing(correlation_1, correlation_2),
        sidelobe_neighbour_noise_correlation=sidelobe_neighbour_noise_correlation(window, fft_size),
        spread_error_factor=np.zeros(0),
    )
    return interpolation._replace(
        spread_error_factor=_spread_error_factor(window, fft_size, interpolation)
    )


def complex_exponentials(cycles: float, n_values: int) -> np.ndarray:
    """Return exp(-2 pi i c n) for n = 0 .. ``n_values`` - 1.

    Parameters
    ----------
    cycles : float
        Phase c from one value to the next [cycles].
    n_values : int
        Number of values.

    Returns
    -------
    ndarray (n_values,) complex
        Exponentials, as products of about 2 sqrt(n_values) exponentials.
    """
    step = math.isqrt(n_values) + 1
    angle = -2j * np.pi * cycles * np.arange(step)
    return np.multiply.outer(np.exp(step * angle), np.exp(angle)).ravel()[:n_values]


@lru_cache(maxsize=32)
def tone_spectrum_function(window: Window, fft_size: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that gives the complex value of a bin at -2 .. 2 bins from a tone.

    Parameters
    ----------
    window : Window
        Window of the record, of L samples (:class:`sweep.model.window.Window`).
    fft_size : int
        FFT size N >= L.

    Returns
    -------
    callable
        Function from the distances d of bins from the tone [bins] to the bins' complex values, of
        the same shape. d is positive for bins above the tone.

    Notes
    -----
    For a complex tone of amplitude 1 the value is

        sum_n w_n exp(-2 pi i d (n - L/2) / N),

    with the samples w_n of the window. The linear phase of half a record is removed, so that the
    value is real for a symmetric window. Only the first sample, which has no counterpart at n = L,
    leaves an imaginary part. The remaining phase changes by at most one cycle. A polynomial thus
    represents the value to 1e-14 of the largest bin.
    """
    w, record_middle = window_samples(window.name, window.length), window.length / 2

    def bin_values(distances: np.ndarray) -> np.ndarray:
        """Return the complex values of bins at distances -2 .. 2 [bins] from the tone.

        The linear phase of half a record is removed.
        """
        values = [
            (w * complex_exponentials(distance / fft_size, w.size)).sum() for distance in distances
        ]
        return np.array(values) * np.exp(2j * np.pi * record_middle / fft_size * distances)

    return Chebyshev.interpolate(bin_values, _TONE_POLYNOMIAL_DEGREE, domain=[-2, 2])


def _tone_magnitudes(window: Window, fft_size: int, offset: np.ndarray) -> np.ndarray:
    """Return |X| of three bins about single tones ``offset`` (m,) bins above the middle, (3, m)."""
    return np.abs(
        tone_spectrum_function(window, fft_size)(np.array([[-1.0], [0.0], [1.0]]) - offset)
    )


def _least_squares_weights(
    tone_magnitudes: np.ndarray,
    offset: np.ndarray,
    correlation_1: float,
    correlation_2: float,
    *,
    two_bins: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of three bins that give a tone's position with the least standard error.

    The least standard error is returned as well.

    Parameters
    ----------
    tone_magnitudes
        (3, m): |X| of the three bins for tones at the positions ``offset`` (m,) [bins].
    offset
        (m,): positions delta [bins].
    correlation_1, correlation_2
        Noise correlations of bins one and two apart.
    two_bins
        True if only the centre and the bin above are used.

    Returns
    -------
    weight : ndarray (3, m)
        Weights [bins] of the |X| of the bin below, the centre bin and the bin above, each over that
        of the centre bin.
    standard_error : ndarray (m,)
        Standard error [bins] at |X| = sigma in the centre bin.

    Notes
    -----
    The weights respond with 0 to a change of the amplitude and with 1 to a change of delta, for
    |X| = 1 in the centre bin. They are u = C^-1 G (G' C^-1 G)^-1 (0, 1)', with the noise covariance
    C. The columns of G are the tone's magnitudes and their derivatives by delta.
    """
    slope = np.gradient(tone_magnitudes, offset, axis=1)
    used_bins = slice(1 if two_bins else 0, 3)
    covariance = np.array(
        [
            [1, correlation_1, correlation_2],
            [correlation_1, 1, correlation_1],
            [correlation_2, correlation_1, 1],
        ]
    )[used_bins, used_bins]
    inverse = np.linalg.inv(covariance + 1e-12 * np.eye(len(covariance)))
    _, centre, _ = tone_magnitudes
    scale = np.maximum(centre, 1e-3 * centre[0])
    design = np.stack(
        [tone_magnitudes[used_bins] / scale, slope[used_bins] / scale], axis=-1
    ).swapaxes(0, 1)
    solution = np.linalg.pinv(design.mT @ inverse @ design, hermitian=True)[:, :, 1]
    weight = np.zeros_like(tone_magnitudes)
    weight[used_bins] = (inverse @ design @ solution[:, :, None])[:, :, 0].T
    return weight, np.sqrt(np.maximum(solution[:, 1], 0.0))


def _spread_error_factor(window: Window, fft_size: int, interpolation: Interpolator) -> np.ndarray:
    """Return a position's error per variance of the lines' narrow Gaussian spread, (m,) [1/bins].

    The ratio is tabulated over the distance, 0 .. 1 bin, of the lines' mean from the centre bin.
    Three lines of weights 1/6, 2/3, 1/6 represent the spread, with the moments of a Gaussian up to
    the fifth.
    """
    positions = np.linspace(0.0, 1.0, _N_SPREAD_POSITIONS)
    power = np.zeros((3, _N_SPREAD_POSITIONS))
    for shift, weight in ((-math.sqrt(3), 1 / 6), (0.0, 2 / 3), (math.sqrt(3), 1 / 6)):
        offset = positions + shift * _SPREAD_BINS
        tone_magnitudes = _tone_magnitudes(window, fft_size, np.abs(offset))
        power += weight * np.where(offset < 0, tone_magnitudes[::-1], tone_magnitudes) ** 2
    estimates = np.array(
        [estimate_sub_bin_offset(a, b, c, interpolation) for a, b, c in np.sqrt(power).T]
    )
    table_positions = np.linspace(0.0, 1.0, _N_TABLE_INTERVALS + 1)
    return np.interp(table_positions, positions, np.abs(estimates - positions)) / _SPREAD_BINS**2


def _noise_mixing(correlation_1: float, correlation_2: float) -> NoiseMixing:
    """Return the Cholesky factors of the noise covariance of three adjacent bins.

    The arguments are the correlations of the noise of bins one and two apart.
    """
    above_from_independent = math.sqrt(max(1 - correlation_1**2, 0.0))
    below_from_above = (
        (correlation_2 - correlation_1**2) / above_from_independent
        if above_from_independent > 0
        else 0.0
    )
    return NoiseMixing(
        neighbours_from_centre=correlation_1,
        above_from_independent=above_from_independent,
        below_from_above=below_from_above,
        below_from_independent=math.sqrt(max(1 - correlation_1**2 - below_from_above**2, 0.0)),
    )


@njit(cache=True, error_model="numpy", borrows=True)
def estimate_sub_bin_offset(below, centre, above, interpolation):
    """Estimate a tone's offset from the centre bin [bins, -1 .. 1] from three magnitudes.

    Parameters
    ----------
    below, centre, above
        |X| of three adjacent bins.
    interpolation
        :class:`Interpolator`.
    """
    offsets = interpolation.offset
    larger, smaller = max(below, above), min(below, above)
    if not larger > 0.0:
        return 0.0
    if interpolation.magnitude_ratio_kind == THREE_BINS:
        magnitude_ratio = (larger - smaller) / (smaller + 2.0 * centre + larger)
    else:
        magnitude_ratio = larger / (centre + larger)
    offset = _interpolate_table(
        offsets,
        (magnitude_ratio - interpolation.magnitude_ratio_at_centre)
        / interpolation.magnitude_ratio_step,
    )
    if interpolation.magnitude_ratio_kind == THREE_BINS and centre > 0.0:
        table_index = offset * (offsets.size - 1)
        weights = interpolation.neighbour_weights
        correction = smaller * _interpolate_table(
            weights.smaller, table_index
        ) + larger * _interpolate_table(weights.larger, table_index)
        offset = min(
            max(
                offset + _interpolate_table(weights.centre, table_index) + correction / centre,
                -1.0,
            ),
            1.0,
        )
    return offset if above >= below else -offset


@njit(cache=True, error_model="numpy", borrows=True)
def _interpolate_table(values, index):
    """Interpolate a table linearly at a fractional index, which is clipped to the table."""
    index = min(max(index, 0.0), values.size - 1.0)
    i = min(int(index), values.size - 2)
    return values[i] + (index - i) * (values[i + 1] - values[i])


@njit(cache=True, error_model="numpy", borrows=True)
def sub_bin_standard_error(offset, magnitude_ratio, interpolation):
    """Return the standard error of :func:`estimate_sub_bin_offset` [bins], at most 1/2.

    Parameters
    ----------
    offset
        Estimated offset from the centre bin [bins].
    magnitude_ratio
        |X| of the centre bin over the noise per quadrature sigma.
    interpolation
        :class:`Interpolator`.
    """
    if not magnitude_ratio > 0.0:
        return 0.5
    return min(
        _interpolate_table(
            interpolation.error_at_unit_signal,
            abs(offset) * (interpolation.error_at_unit_signal.size - 1),
        )
        / magnitude_ratio,
        0.5,
    )


def drift_error(offset: np.ndarray, drift: np.ndarray, window: Window, fft_size: int) -> np.ndarray:
    """Return the error of the sub-bin offset [bins] for a tone that drifts within the record.

    Parameters
    ----------
    offset : ndarray
        Position of the tone in the middle of the record, relative to the centre bin [bins].
    drift : ndarray
        Linear change of the position over the whole record [bins].
    window : Window
        Window of the record.
    fft_size : int
        FFT size.
    """
    (error_factor,) = interpolate_tables(
        (_DRIFTS_BINS, _DRIFT_POSITIONS_BINS),
        (_drift_error_table(window, fft_size),),
        (drift, np.abs(offset)),
    )
    return np.asarray(np.minimum(error_factor * drift * drift, drift / 2))


_DRIFTS_BINS = np.array([0.5, 1.0, 2.0, 4.0])
"""Tabulated changes of a tone's position over the record [bins]."""
_DRIFT_POSITIONS_BINS = np.linspace(0.0, 1.0, 17)
"""Tabulated positions of a drifting tone in the middle of the record, relative to a bin [bins]."""


@lru_cache(maxsize=32)
def _drift_error_table(window: Window, fft_size: int) -> np.ndarray:
    """Tabulate the position error of a drifting tone, divided by its squared drift [1/bins].

    The table is (drifts, positions), for drifts over the record and positions in the middle of the
    record.
    """
    w, interpolation = window_samples(window.name, window.length), interpolator(window, fft_size)
    record_position = np.arange(w.size) / w.size - 0.5
    error_factor = np.empty((_DRIFTS_BINS.size, _DRIFT_POSITIONS_BINS.size))
    for i, drift in enumerate(_DRIFTS_BINS):
        drifting_window = w * np.exp(1j * np.pi * drift * w.size / fft_size * record_position**2)
        for j, position in enumerate(_DRIFT_POSITIONS_BINS):
            below, centre, above = (
                abs(
                    (
                        drifting_window * complex_exponentials((k - position) / fft_size, w.size)
                    ).sum()
                )
                for k in (-1, 0, 1)
            )
            estimate = estimate_sub_bin_offset(below, centre, above, interpolation)
            error_factor[i, j] = abs(estimate - position) / drift**2
    return error_factor


_N_LATE_ECHO_POSITIONS = 65
"""Number of tone positions, 0 .. 1 bin, in the tables for echoes that arrive after the record has
begun."""
_MISSING_RECORD_FRACTIONS = np.concatenate([np.arange(0.0, 0.8, 0.02), np.arange(0.8, 0.985, 0.01)])
"""Tabulated fractions of the record that pass before the echo arrives."""
_ESTIMATE_SLOPE_MIN = 0.05
"""Lower limit of the derivative of the estimated position by the true one. Errors are divided by
this derivative."""
_MAGNITUDE_DIFFERENCE_STEP = 1e-4
"""Step in a bin's |X| for numerical derivatives, as a fraction of the centre bin's |X|."""


class LateEchoCorrection(NamedTuple):
    """Correction of the sub-bin offset of echoes that arrive after the record has begun."""

    shift: np.ndarray
    """Number of bins to add to the estimated offset of the tone from the centre bin."""
    error_factor: np.ndarray
    """Factor on the offset's standard error, :func:`sub_bin_standard_error`, because the echo lacks
    samples."""


def late_echo_correction(
    offset: np.ndarray, n_missing: np.ndarray, window: Window, fft_size: int
) -> LateEchoCorrection:
    """Return the correction of the sub-bin offset of an echo that lacks the record's first samples.

    Parameters
    ----------
    offset : ndarray
        Result of :func:`estimate_sub_bin_offset` [bins].
    n_missing : ndarray
        Number of samples at the record's start without an echo.
    window : Window
        Window of the record.
    fft_size : int
        FFT size.

    Returns
    -------
    LateEchoCorrection
        Shift of the offset [bins], and factor on its standard error.
    """
    missing_fraction = np.asarray(n_missing) / window.length
    shift_at, factor_at = interpolate_tables(
        (_MISSING_RECORD_FRACTIONS, np.linspace(0.0, 1.0, _N_LATE_ECHO_POSITIONS)),
        _late_echo_tables(window, fft_size),
        (missing_fraction, np.abs(offset)),
    )
    is_late = missing_fraction > 0
    return LateEchoCorrection(
        np.where(is_late, np.sign(offset) * shift_at, 0.0), np.where(is_late, factor_at, 1.0)
    )


@lru_cache(maxsize=32)
def _late_echo_tables(window: Window, fft_size: int) -> tuple[np.ndarray, np.ndarray]:
    """Tabulate the fields of :class:`LateEchoCorrection`, (missing fractions, positions) each."""
    w, interpolation = window_samples(window.name, window.length), interpolator(window, fft_size)
    first_sample = np.minimum(np.rint(_MISSING_RECORD_FRACTIONS * w.size).astype(int), w.size - 2)
    positions = np.linspace(0.0, 1.0, _N_LATE_ECHO_POSITIONS)
    tone_bins = np.empty((first_sample.size, positions.size, 3), complex)
    for j, position in enumerate(positions):
        for k in (-1, 0, 1):
            terms = w * complex_exponentials((k - position) / fft_size, w.size)
            tone_bins[:, j, k + 1] = np.cumsum(terms[::-1])[::-1][first_sample]
    record_position = np.arange(w.size) / fft_size
    correlation_1, correlation_2 = (
        (w**2 * np.exp(-2j * np.pi * d * record_position)).sum() / window.energy for d in (1, 2)
    )
    noise_covariance = np.array(
        [
            [1, correlation_1.conjugate(), correlation_2.conjugate()],
            [correlation_1, 1, correlation_1.conjugate()],
            [correlation_2, correlation_1, 1],
        ]
    )
    shift, error_factor = np.zeros((2, first_sample.size, positions.size))
    for i in range(first_sample.size):
        magnitudes = np.abs(tone_bins[i])
        scale = np.maximum(magnitudes[:, 1:2], 1e-300)
        phase, magnitudes = tone_bins[i] / np.maximum(magnitudes, 1e-300), magnitudes / scale
        estimates = np.array([estimate_sub_bin_offset(*row, interpolation) for row in magnitudes])
        estimates = np.maximum.accumulate(np.maximum(estimates, 0.0))
        slope = np.maximum(np.gradient(estimates, positions), _ESTIMATE_SLOPE_MIN)
        derivatives = np.empty(magnitudes.shape)
        for k in range(3):
            lowered, raised = magnitudes.copy(), magnitudes.copy()
            lowered[:, k] -= _MAGNITUDE_DIFFERENCE_STEP
            raised[:, k] += _MAGNITUDE_DIFFERENCE_STEP
            for j in range(positions.size):
                derivatives[j, k] = (
                    estimate_sub_bin_offset(*raised[j], interpolation)
                    - estimate_sub_bin_offset(*lowered[j], interpolation)
                ) / (2 * _MAGNITUDE_DIFFERENCE_STEP)
        weight = derivatives * phase
        variance = np.einsum("jk,kl,jl->j", weight.conj(), noise_covariance, weight).real
        error = np.sqrt(np.maximum(variance, 0.0)) / slope
        if interpolation.magnitude_ratio_kind == TWO_BINS:
            # On a bin either neighbour may be the larger one.
            error[0] = error[1]
        # The error factor is relative to the standard error at the uncorrected position.
        whole_echo_error = np.interp(
            estimates,
            np.linspace(0, 1, interpolation.error_at_unit_signal.size),
            interpolation.error_at_unit_signal,
        )
        is_distinct = np.append(True, np.diff(estimates) > 1e-9)
        shift[i] = np.interp(positions, estimates[is_distinct], positions[is_distinct]) - positions
        error_factor[i] = np.interp(
            positions, estimates[is_distinct], (error / whole_echo_error)[is_distinct]
        )
    return shift, error_factor


@njit(cache=True, error_model="numpy", borrows=True)
def line_spread_error(offset, line_deviation_bins, adds_powers, interpolation):
    """Return the error of the sub-bin offset [bins] due to the spread of a footprint's lines.

    Parameters
    ----------
    offset : float
        Offset from the centre bin [bins].
    line_deviation_bins : float
        Standard deviation of the lines' positions [bins].
    adds_powers : bool
        True if the lines add as powers. If False, they add as amplitudes and may cancel, and the
        error returned is ``line_deviation_bins``.
    interpolation : Interpolator
        Interpolator of the window; its ``spread_error_factor`` is a table over the offset.
    """
    if not adds_powers:
        return line_deviation_bins
    table_index = abs(offset) * (interpolation.spread_error_factor.size - 1)
    return min(
        _interpolate_table(interpolation.spread_error_factor, table_index)
        * line_deviation_bins
        * line_deviation_bins,
        line_deviation_bins,
    )
