"""Main lobe of a window, and bounds on the change of its power, for error bounds of effects.

F(x) = |W(x r)|^2 / (sum w)^2 is the power of a bin x FFT bins away from a line, r = L/N. It is a
cosine series in the autocorrelation of the window,

    F(x) = sum_{n,m} w_n w_m cos(2 pi (n - m) x / N) / (sum w)^2,

so that |F''| <= (2 pi r)^2 2 V, with the variance V of n/L under the weights |w_n| (times (sum|w| /
sum w)^2). |F'| is at most the root of that bound times sum|w| / sum w. Near the peak W follows from
the window's moments,

    |W(y)| = hypot(sum_n w_n cos(2 pi y (n/L - 1/2)), w_0 sin(pi y)).

Over all bins F sums to ENBW / r (Parseval), wherever the line lies.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.model.window import Window, get_window, window_samples

_MAIN_LOBE_ROUNDING_MARGIN = 1e-6
"""Relative margin by which the smallest magnitude within half a bin is lowered for rounding errors.
"""
_N_MAIN_LOBE_SERIES_TERMS = 28
"""Number of terms of the power series of a window's main lobe."""
_N_MAIN_LOBE_STEPS = 1024
"""Number of steps of the table of main-lobe magnitudes, from 0 to half an FFT bin."""
_ENVELOPE_CELLS, _ENVELOPE_KNEE_WINDOW_BINS = 8192, 16.0
"""Number of cells of the sidelobe table, and the distance at its middle [bins of fs/L]. Cells are
equally spaced in d / (d + middle distance) of the distance d."""
_TABLE_CELLS_PER_OCTAVE = 64
"""Number of cells per factor of 2 in magnitude, in the table of distances from a line by magnitude.
"""
_MAGNITUDE_OCTAVE_MIN = -80
"""Smallest magnitude in the table of distances from a line by magnitude [octaves relative to the
peak]."""


class WindowResponse(NamedTuple):
    """Magnitude of a window's transform at the FFT bins around a line, relative to its peak."""

    main_lobe: np.ndarray
    """(m,): magnitude, relative to the peak, at distances of 0..1/2 FFT bin from a line, in equal
    steps."""
    power_slope_max: float
    """Upper bound on the slope of the power over distance from a line, as a magnitude, relative to
    the peak power [1/bin]."""
    power_curvature_max: float
    """Upper bound on the second derivative of the power by distance from a line, as a magnitude,
    relative to the peak power [1/bin^2]."""
    padding_factor: float
    """FFT size N divided by the number of samples L, which is the number of FFT bins per bin of
    fs/L."""
    central_energy_min: float
    """Sum of the powers, relative to the peak, of the FFT bins within ``padding_factor`` bins of a
    line. It is the smallest sum for any position of the line between two bins."""
    sidelobe_envelope: np.ndarray
    """(cells + 1,): largest magnitude, relative to the peak, at or beyond tabulated distances d
    from a line. d / (d + knee) has equal steps, with a fixed distance called knee."""
    distance_by_octave: np.ndarray
    """(cells,): distance from a line [FFT bins] beyond which all magnitudes are smaller than a
    tabulated magnitude. The tabulated magnitudes fall in equal steps of octaves."""
    scalloping_gain_min: float
    """Smallest magnitude, relative to the peak, that the FFT bin nearest to a line can have. The
    bin is at most half a bin away from the line."""

    def scalloping_gain(self, distance: np.ndarray) -> np.ndarray:
        """Return the magnitude, relative to the peak, of a bin at ``distance`` from a line.

        The distance is 0..1/2 FFT bin; larger distances count as 1/2.
        """
        clipped_distance = np.fmin(distance, 0.5)
        return self.main_lobe[(clipped_distance * (2 * _N_MAIN_LOBE_STEPS) + 0.5).astype(np.int64)]

    def magnitude_max_beyond(self, distance: np.ndarray) -> np.ndarray:
        """Return the largest magnitude, relative to the peak, at or beyond a distance from a line.

        ``distance`` is in FFT bins.
        """
        knee = _ENVELOPE_KNEE_WINDOW_BINS * self.padding_factor
        table_position = 1 - knee / (np.fmax(distance, 0.0) + knee)
        return self.sidelobe_envelope[(table_position * _ENVELOPE_CELLS).astype(np.int64)]

    def reach_of_magnitude(self, magnitude: np.ndarray) -> np.ndarray:
        """Return the distance from a line [FFT bins] beyond which all bins are below ``magnitude``.

        Magnitudes are relative to the peak. The result is inf if no distance is known.
        """
        octave = np.log2(np.fmin(np.fmax(magnitude, 2.0**_MAGNITUDE_OCTAVE_MIN), 1.0))
        return self.distance_by_octave[np.ceil(-octave * _TABLE_CELLS_PER_OCTAVE).astype(np.int64)]


@lru_cache(maxsize=32)
def window_response(window_name: str, length: int, fft_size: int) -> WindowResponse:
    """Return the magnitude response of a window at FFT bins around a line (cached).

    Parameters
    ----------
    window_name : str
        Name of the window.
    length, fft_size : int
        Length L of the record and FFT size N.
    """
    fft_window = get_window(window_name, length)
    w = window_samples(fft_window.name, length)
    position = np.arange(length) / length - 0.5
    weight = np.abs(w) / np.abs(w).sum()
    position_variance = float((weight * position**2).sum() - (weight * position).sum() ** 2)
    magnitude_sum_ratio = float(np.abs(w).sum() / w.sum())
    record_fraction = length / fft_size
    power_curvature_max = (
        2 * position_variance * (2 * math.pi * record_fraction * magnitude_sum_ratio) ** 2
    )
    coefficients = _main_lobe_series(w, position)
    main_lobe_samples = main_lobe_magnitude(
        fft_window, coefficients, np.linspace(0.0, 0.5, _N_MAIN_LOBE_STEPS + 1) * record_fraction
    )
    envelope_distance = np.concatenate([[0.0], fft_window.envelope_distances])
    envelope = np.concatenate(
        [
            [max(1.0, main_lobe_samples.max(), fft_window.sidelobe_envelope[0])],
            fft_window.sidelobe_envelope,
        ]
    )
    table_position = np.arange(_ENVELOPE_CELLS + 1) / _ENVELOPE_CELLS
    with np.errstate(divide="ignore"):
        table_distance = _ENVELOPE_KNEE_WINDOW_BINS * table_position / (1 - table_position)
    magnitude = 2.0 ** (
        -np.arange(-_MAGNITUDE_OCTAVE_MIN * _TABLE_CELLS_PER_OCTAVE + 2) / _TABLE_CELLS_PER_OCTAVE
    )
    first_below = np.searchsorted(-envelope, -magnitude)
    return WindowResponse(
        main_lobe=main_lobe_samples,
        power_slope_max=magnitude_sum_ratio * math.sqrt(power_curvature_max),
        power_curvature_max=power_curvature_max,
        padding_factor=1 / record_fraction,
        central_energy_min=_central_energy_min(
            fft_window,
            coefficients,
            record_fraction,
            magnitude_sum_ratio * math.sqrt(power_curvature_max),
        ),
        sidelobe_envelope=envelope[np.searchsorted(envelope_distance, table_distance, "right") - 1],
        distance_by_octave=np.append(envelope_distance, np.inf)[first_below] / record_fraction,
        scalloping_gain_min=float(main_lobe_samples.min()) * (1 - _MAIN_LOBE_ROUNDING_MARGIN),
    )


def _main_lobe_series(w: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return coefficients of the power series of a window's main lobe in y^2.

    y is the distance from the line [bins of fs/L]. The series is that of the window's cosine
    transform over the window's sum. `w` are the samples, `position` their places in the record.
    """
    moments = np.empty(_N_MAIN_LOBE_SERIES_TERMS)
    weighted_power = w / w.sum()
    for k in range(_N_MAIN_LOBE_SERIES_TERMS):
        moments[k] = weighted_power.sum()
        weighted_power = weighted_power * (position * position)
    exponent = np.arange(_N_MAIN_LOBE_SERIES_TERMS)
    series_factors = [(2 * math.pi) ** (2 * k) / math.factorial(2 * k) for k in exponent.tolist()]
    return np.asarray((-1.0) ** exponent * series_factors * moments)


def main_lobe_magnitude(fft_window: Window, coefficients: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the magnitude of a window's transform in its main lobe, relative to the peak.

    It is computed from a power series.

    Parameters
    ----------
    fft_window : Window
        Window of the record.
    coefficients : ndarray
        Coefficients of the power series in y^2, from :func:`_main_lobe_series`.
    y : ndarray
        Distance from the line [bins of fs/L], |y| <= 1.5.

    Returns
    -------
    ndarray
        |W(y)| / sum w.
    """
    real_part = np.polynomial.polynomial.polyval(np.asarray(y, float) ** 2, coefficients)
    return np.hypot(
        real_part, fft_window.first_value / fft_window.sum * np.sin(np.pi * np.asarray(y, float))
    )


def _central_energy_min(
    fft_window: Window, coefficients: np.ndarray, record_fraction: float, power_slope_max: float
) -> float:
    """Return the smallest sum of powers, relative to the peak, of the bins near a line.

    Bins within one bin of fs/L (sample rate over number of samples) are near. The minimum is over
    positions of the line between FFT bins.
    """
    reach_bins = math.floor(1 / record_fraction) + 1
    bin_offset = np.arange(64) / 64
    distance = (np.arange(-reach_bins, reach_bins + 1)[:, None] - bin_offset) * record_fraction
    power = np.where(
        abs(distance) <= 1,
        main_lobe_magnitude(fft_window, coefficients, distance.clip(-1, 1)) ** 2,
        0.0,
    )
    if reach_bins <= 2:
        # A bin leaves the sum where it crosses the margin; the others change at most by their
        # slope.
        return float(max(power.sum(axis=0).min() - 2 * reach_bins * power_slope_max / 128, 0.5))
    return float(0.98 * power.sum(axis=0).min())


class MissingSampleBounds(NamedTuple):
    """Bounds on the effect of samples that precede the echo in a record."""

    lost_fraction: np.ndarray
    """Sum of the window's magnitude over the missing samples, divided by the window's sum."""
    step_sidelobe_factor: np.ndarray
    """Bound on the sidelobes that missing samples add, divided by the sidelobes of a rectangular
    window. Both are relative to the sum of their window."""
    n_missing: np.ndarray
    """Number of samples that precede the echo."""
    centroid_bound: np.ndarray
    """Upper bound on the magnitude of the mean position of the remaining samples in the record,
    -1..1."""
    all_missing: np.ndarray
    """True where all samples precede the echo."""


def missing_sample_bounds(window: Window, n_missing: np.ndarray) -> MissingSampleBounds:
    """Return bounds on the effect of samples at the record's start that precede the echo.

    Parameters
    ----------
    window : Window
        Window of the record.
    n_missing : ndarray of int
        Number of missing samples.

    Notes
    -----
    The transform of the missing samples at y bins of fs/L from the line is at most their total
    variation divided by 2 sin(pi y / L). The same holds for the remaining samples. The lesser of
    both bounds is used.
    """
    lost_fraction_by_count, bound_by_missing, bound_by_remaining = _bounds_by_missing_count(window)
    lost_fraction = lost_fraction_by_count[n_missing]
    step_sidelobe_factor = np.minimum(
        bound_by_missing[n_missing], bound_by_remaining[n_missing]
    ) * (window.length / window.sum)
    with np.errstate(divide="ignore"):
        centroid_bound = np.minimum(lost_fraction / np.maximum(1 - lost_fraction, 1e-300), 1.0)
    step_sidelobe_factor = np.where(n_missing > 0, step_sidelobe_factor, 0.0)
    return MissingSampleBounds(
        lost_fraction, step_sidelobe_factor, n_missing, centroid_bound, n_missing >= window.length
    )


@lru_cache(maxsize=8)
def _bounds_by_missing_count(window: Window) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return bounds of :func:`missing_sample_bounds` by number of missing samples, (L + 1,) each.

    They are the lost fraction, the bound on sidelobes from the variation of the missing samples,
    and that from the variation of the remaining samples.
    """
    w = window_samples(window.name, window.length)
    magnitude = np.abs(w)
    lost_fraction = np.append(0.0, np.cumsum(magnitude)) / window.sum
    variation = np.append(0.0, np.cumsum(np.abs(np.diff(w))))  # variation up to each sample
    bound_by_missing = 0.5 * (magnitude[0] + variation + magnitude)
    bound_by_remaining = 0.5 * (magnitude + variation[-1] - variation + magnitude[-1])
    bound_by_missing, bound_by_remaining = (
        np.append(0.0, bound_by_missing),
        np.append(bound_by_remaining, 0.0),
    )
    return lost_fraction, bound_by_missing, bound_by_remaining


def window_max_near(
    window: Window, first_sample: np.ndarray, reach_samples: np.ndarray
) -> np.ndarray:
    """Return the largest magnitude of the window near a sample, divided by the window's sum.

    Parameters
    ----------
    window : Window
        Window of the record.
    first_sample : ndarray of int
        Index of the sample.
    reach_samples : ndarray
        Distance from the sample [samples], rounded up to a power of two.
    """
    exponents = np.ceil(np.log2(np.clip(reach_samples, 1, window.length))).astype(int)
    window_max = np.empty(np.broadcast_shapes(first_sample.shape, exponents.shape))
    first_sample, exponents = np.broadcast_arrays(first_sample, exponents)
    for exponent in np.unique(exponents):
        has_exponent = exponents == exponent
        window_max[has_exponent] = _window_max_within(window, int(exponent))[
            first_sample[has_exponent]
        ]
    return window_max


@lru_cache(maxsize=64)
def _window_max_within(window: Window, exponent: int) -> np.ndarray:
    """Return the largest magnitude of a window near each sample, divided by its sum, (L + 1,).

    Near are samples at distances up to 2^``exponent``.
    """
    from scipy.ndimage import maximum_filter1d  # slow to import

    magnitude = np.abs(window_samples(window.name, window.length))
    magnitude = np.append(magnitude, magnitude[-1])
    return np.asarray(maximum_filter1d(magnitude, 2 * 2**exponent + 1, mode="nearest")) / window.sum
