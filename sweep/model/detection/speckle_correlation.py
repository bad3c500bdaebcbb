"""Correlation of the speckle in the strongest bins of two segments of a shot.

A scatterer of delay tau and Doppler ratio beta has, in the middle t_c of the record of a segment
that starts at t_s, the beat phase

    -2 pi F tau + 2 pi F beta (t_s + t_c),    F = f + S (t_c - tau_0)                            (1)

with the carrier f and the signed chirp rate S of the segment, and the delay tau_0 on the beam's
axis. The Doppler ratio is 2 v / c for the radial velocity v. F is the optical frequency of the echo
in the middle of the record. If the echo fills only part of the record, t_c is the centroid of the
window over that part. The phase difference between
two segments depends on the scatterer's position. If all scatterers lie in one bin, the two
amplitudes are circular complex Gaussian numbers with the correlation

    mu = E[exp(i (phase_2 - phase_1))]                                                          (2)

over the beam's power. This is exp(-t^2 / 2) if the phase difference is normal with deviation t.

A bin weighs scatterers by the window's transform G about its own frequency. If the footprint spans
a good part of a bin, or more, the strongest bins of two segments weigh different parts of it. With
the places nu_i(y) of the lines, y the coordinate along which they spread most,

    mu = int p G(k_1 - nu_1) G(k_2 - nu_2) e^(i t y) dy / sqrt(S_1 S_2),
    S_i = int p G(k_i - nu_i)^2 dy                                                              (3)

with the beam's power density p over y, the strongest bins k_i, and the phase difference t per unit
of y. Line positions are taken as linear in y. (3) thus neglects Doppler shifts that change as the
square of the angle across the beam (150 m/s in a beam of 5 mrad: 3 bins), which (2) includes.

The probability that both bins cross a threshold is that of two correlated Rayleigh magnitudes,
:func:`sweep.model.detection.echo_detection.joint_pd_in_speckle`, by |mu|.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.model.window import Window, centred_transform, window_samples

SEGMENT_PAIRS = ((0, 1), (0, 2), (1, 2))
"""Pairs of segment indices (0 up, 1 Doppler, 2 down), in the order of arrays over pairs."""

LINE_SHIFT_MIN_CELLS = 0.01
"""Shift of the spectral line, per standard deviation of the beam, below which all lines of a
footprint count as lying in one bin. The unit is a resolution cell, the sample rate over the number
of samples in the record."""

TRANSFORM_REACH_CELLS = 6.0
"""Distance from the centre of the window's transform beyond which the transform is neglected in
correlation integrals. The unit is a resolution cell, the sample rate over the number of samples in
the record."""

TRANSFORM_SAMPLES_PER_CELL = 64
"""Number of samples of the tabulated window transform per resolution cell. A cell is the sample
rate over the number of samples in the record."""
_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(48)
_INTEGRATED_BEAM_DEVIATIONS_MAX = 5.0
"""Largest half-width of the interval across the beam over which the correlation is integrated, in
standard deviations of the beam's power."""
_RESOLVED_PHASE_MAX = 40.0
"""Largest phase [rad] of the integrand, at the ends of the interval of integration, that the
quadrature resolves."""


class LineGradients(NamedTuple):
    """Gradients of line position and phase across the beams of n points, along two coordinates."""

    line_shift: np.ndarray
    """(n, 3, 2): shift of the line per standard deviation of the beam [FFT bins], by point, segment
    and coordinate. It is positive towards higher beat frequency."""
    phase_gradient: np.ndarray
    """(n, 3, 2): change of the line's phase per standard deviation of the beam, minus that in the
    up segment [rad]. The axes are point, segment and coordinate."""

    def select(self, points: np.ndarray) -> "LineGradients":
        """Return the gradients of the points with the given indices."""
        return LineGradients(self.line_shift[points], self.phase_gradient[points])


class LinePairGradients(NamedTuple):
    """Gradients across the beam of the lines of two segments, arrays (n,).

    The gradients are along the coordinate y across the beam in which the lines spread most. The
    unit of frequency is fs/L, the sample rate over the number of samples in the record.
    """

    strongest_bin_offset: tuple[np.ndarray, np.ndarray]
    """Frequency [fs/L] of each segment's strongest bin minus that of the line on the beam's axis.
    fs/L is the sample rate over the number of samples in the record."""
    line_shift: tuple[np.ndarray, np.ndarray]
    """Signed shift [fs/L] of each segment's line per standard deviation of the beam. fs/L is the
    sample rate over the number of samples in the record."""
    phase_difference: np.ndarray
    """Change across the beam of the phase between the two segments [rad per standard deviation of
    the beam]."""
    relative_power_gradient: np.ndarray
    """Relative change of the echo's power across the beam, per standard deviation of the beam."""

    @property
    def line_shift_max(self) -> np.ndarray:
        """Larger of the two segments' line shifts, in modulus, per standard deviation of the beam.

        The unit is the sample rate over the number of samples in the record.
        """
        return np.maximum(np.abs(self.line_shift[0]), np.abs(self.line_shift[1]))

    def select(self, points: np.ndarray) -> "LinePairGradients":
        """Return the gradients of the points with the given indices."""
        (distance_first, distance_second), (shift_first, shift_second) = (
            self.strongest_bin_offset,
            self.line_shift,
        )
        return LinePairGradients(
            (distance_first[points], distance_second[points]),
            (shift_first[points], shift_second[points]),
            self.phase_difference[points],
            self.relative_power_gradient[points],
        )


def peak_bin_correlation(window: Window, gradients: LinePairGradients) -> np.ndarray:
    """Return the correlation of the speckle in the strongest bins of two segments, (n,) complex.

    Parameters
    ----------
    window : Window
        Window of the record (:class:`sweep.model.window.Window`).
    gradients : LinePairGradients
        Position of the strongest bins, and gradients of the lines across the beam, of n points.

    Returns
    -------
    ndarray (n,) complex
        Correlation mu, 0 <= |mu| <= 1.

    Notes
    -----
    mu is equation (3) of the module's description,

        mu = int p G(k_1 - nu_1) G(k_2 - nu_2) e^(i t y) dy / sqrt(S_1 S_2),
        S_i = int p G(k_i - nu_i)^2 dy,

    with the window's transform G, the strongest bins k_i, the places nu_i(y) of the lines and the
    phase difference t per unit of y. The power density p is a Gaussian times max(1 + g y, 0), with
    the relative power gradient g. y is in standard deviations of the beam. If the phase varies too
    fast across the beam for the quadrature, the result is |mu| for a Gaussian window transform of
    the same half-width and g = 0, which is close to 0.
    """
    from sweep.model.detection.speckle_correlation_integral import (
        fill_peak_bin_correlation,  # a compiler is slow to import
    )

    half_interval = np.minimum(
        _INTEGRATED_BEAM_DEVIATIONS_MAX,
        TRANSFORM_REACH_CELLS / np.maximum(gradients.line_shift_max, 1e-300),
    )
    is_resolved = np.abs(gradients.phase_difference) * half_interval <= _RESOLVED_PHASE_MAX
    correlation = _gaussian_correlation(window, gradients).astype(complex)
    _, transform = window_transform_table(window)
    fill_peak_bin_correlation(
        np.flatnonzero(is_resolved),
        half_interval,
        np.stack(gradients.strongest_bin_offset),
        np.stack(gradients.line_shift),
        gradients.phase_difference,
        gradients.relative_power_gradient,
        transform,
        TRANSFORM_SAMPLES_PER_CELL,
        _GAUSS_NODES,
        _GAUSS_WEIGHTS,
        correlation,
    )
    return correlation


def _gaussian_correlation(window: Window, gradients: LinePairGradients) -> np.ndarray:
    """Return the modulus of :func:`peak_bin_correlation` for a Gaussian window transform, (n,).

    The transform is exp(-x^2 / (4 v)). The variance v is chosen so that the transform falls to 1/2
    at the same distance as that of the window. All factors of the integrals are then Gaussian.
    """
    transform_variance = _half_maximum_distance(window) ** 2 / (4 * np.log(2))
    (shift_first, shift_second), (distance_first, distance_second) = (
        gradients.line_shift,
        gradients.strongest_bin_offset,
    )
    quadratic_coefficient = 1 + (shift_first * shift_first + shift_second * shift_second) / (
        2 * transform_variance
    )
    linear_coefficient = (distance_first * shift_first + distance_second * shift_second) / (
        2 * transform_variance
    )
    exponent = (linear_coefficient**2 - gradients.phase_difference**2) / (
        2 * quadratic_coefficient
    ) - (distance_first * distance_first + distance_second * distance_second) / (
        4 * transform_variance
    )
    log_powers = sum(
        -np.log1p(line_shift * line_shift / transform_variance) / 2
        - strongest_bin_offset
        * strongest_bin_offset
        / (2 * (transform_variance + line_shift * line_shift))
        for line_shift, strongest_bin_offset in (
            (shift_first, distance_first),
            (shift_second, distance_second),
        )
    )
    return np.exp(np.minimum(exponent - np.log(quadratic_coefficient) / 2 - log_powers / 2, 0.0))


def window_transform(window: Window, distance: np.ndarray) -> np.ndarray:
    """Return the normalised window transform G, G(0) = 1, about the record's middle; it is real.

    Parameters
    ----------
    window : Window
        Window of L samples (:class:`sweep.model.window.Window`).
    distance : ndarray
        Distance from the centre, of either sign, in units of the sample rate over L.

    Returns
    -------
    ndarray
        G at each distance, by linear interpolation in :func:`window_transform_table`. G is 0 beyond
        2 TRANSFORM_REACH_CELLS.

    Examples
    --------
    >>> from sweep.model.window import get_window
    >>> float(np.round(window_transform(get_window("hann", 1024), np.array([1.0]))[0], 3))
    0.5
    """
    distances, transform = window_transform_table(window)
    return np.interp(np.abs(distance), distances, transform, right=0.0)


@lru_cache(maxsize=16)
def late_echo_centroid_shift(window: Window) -> np.ndarray:
    """Return the shift [samples] of a window's centroid if its first k samples are missing.

    The result is (L + 1,) for a window of L samples: element k is the shift for k = 0 .. L.
    """
    w, n = window_samples(window.name, window.length), np.arange(window.length)
    sum_from = np.cumsum(w[::-1])[::-1]
    moment_from = np.cumsum((w * n)[::-1])[::-1]
    delay = np.zeros(window.length + 1)
    is_defined = sum_from > 1e-6 * w.sum()  # an echo of fewer samples is not detected
    centroid_of_all = moment_from[0] / sum_from[0]
    delay[:-1][is_defined] = moment_from[is_defined] / sum_from[is_defined] - centroid_of_all
    return delay


def _half_maximum_distance(window: Window) -> float:
    """Return the distance at which a window's normalised transform falls to 1/2.

    The distance is in units of the sample rate over the number of samples. It is at most 2
    TRANSFORM_REACH_CELLS.
    """
    distances, transform = window_transform_table(window)
    is_below_half = transform < 0.5  # nowhere if all samples but one are 0, as in Hann's of two
    first_below_half = int(np.argmax(is_below_half)) if is_below_half.any() else transform.size - 1
    return float(
        np.interp(-0.5, -transform[: first_below_half + 1], distances[: first_below_half + 1])
    )


@lru_cache(maxsize=16)
def window_transform_table(window: Window) -> tuple[np.ndarray, np.ndarray]:
    """Return distances 0 .. 2 TRANSFORM_REACH_CELLS, and a window's transform at these distances.

    The unit of distance is the sample rate over the number of samples. The transform is 1 at 0.
    """
    distances = (
        np.arange(int(2 * TRANSFORM_REACH_CELLS * TRANSFORM_SAMPLES_PER_CELL) + 1)
        / TRANSFORM_SAMPLES_PER_CELL
    )
    transform = centred_transform(window, distances).real
    return distances, transform / transform[0]
