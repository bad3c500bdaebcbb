"""Noise of a segment's bins: its correlation between neighbours, and alarms in any of many bins.

The bins' noise is the transform of white noise times the window w. Bins that are y apart (in bins
of fs/L) have the correlation W2(y) / W2(0), with W2 the transform of w^2. Alarms of n adjacent bins
are treated as a first-order Markov chain. With the probability p that a bin crosses a threshold of
b sigma,

    P(none) = (1 - p) (1 - h)^(n - 1),    h = (p - p11) / (1 - p).

Here h is the probability that a bin crosses after one that does not. Two neighbours both cross with
the probability p11, the joint tail of two Rayleigh magnitudes [Simon and Alouini, Digital
Communication over Fading Channels, 6.1.2]. With rho^2 = |W2/W2(0)|^2 of neighbours

    p - p11 = p (Q_1(s b, s rho b) - Q_1(s rho b, s b)),    s^2 = 1 / (1 - rho^2).

The noise of a real record is real at DC and Nyquist and nearly real next to them, where it raises
alarms far more often. Bins whose noise is not circular are not searched for alarms.

n bins thus raise alarms as often as 1 + (n - 1) ln(1 - h) / ln(1 - p) independent bins, to which
the formulas for independent bins apply, in logarithms too. At TNR 6 the result is within 2 % of
drawn noise for rectangular, Hamming, Hann and Blackman windows, and within 3 % for flattop and for
Hann padded by 4.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.detection.looks import SINGLE_LOOK, Looks
from sweep.model.window import Window, window_samples

CIRCULAR_RATIO_MAX = 0.01
"""Largest |W2(2k)| / W2(0), the relative difference of the quadratures' variances from their mean,
of bins whose noise counts as circular."""


@lru_cache(maxsize=64)
def neighbour_noise_correlation(window: Window, fft_size: int) -> float:
    """Return the modulus of the noise correlation of adjacent bins, fs/N apart, 0..1."""
    return _noise_correlation_at(window, fft_size, 1)


@lru_cache(maxsize=64)
def first_circular_bin(window: Window, fft_size: int) -> int:
    """Return the distance of the first bin with circular noise from DC or Nyquist [bins]; >= 1.

    Notes
    -----
    In a real record, the noise k bins from DC or Nyquist has quadratures of the variances
    sigma^2 (1 +- |W2(2k)| / W2(0)), with the transform W2 of the squared window. It counts as
    circular if the ratio is at most :data:`CIRCULAR_RATIO_MAX`, there and in all bins beyond.
    """
    padding_factor, last_noncircular_bin = fft_size / window.length, 0
    for k in range(1, math.ceil(8 * padding_factor), max(int(padding_factor / 16), 1)):
        if _noise_correlation_at(window, fft_size, 2 * k) > CIRCULAR_RATIO_MAX:
            last_noncircular_bin = k
    return last_noncircular_bin + 1


def _noise_correlation_at(window: Window, fft_size: int, bin_distance: int) -> float:
    """Return the modulus of the noise correlation of bins at a distance [bins of fs/N], 0..1."""
    squared_window = window_samples(window.name, window.length) ** 2
    exponentials = np.exp(
        -2j * np.pi * (bin_distance * np.arange(window.length) % fft_size) / fft_size
    )
    correlation = abs((squared_window * exponentials).sum()) / squared_window.sum()
    # Bins of an unpadded rectangular window are uncorrelated except for rounding.
    return float(correlation) if correlation > 1e-12 else 0.0


def alarm_equivalent_bins(
    n_bins: ArrayLike, *, threshold_ratio: ArrayLike, correlation: float, looks: Looks = SINGLE_LOOK
) -> np.ndarray:
    """Return the number, 0..n, of independent bins that raise an alarm as often as n adjacent ones.

    Parameters
    ----------
    n_bins
        Number n of adjacent bins.
    threshold_ratio
        Threshold over sigma, the noise per quadrature.
    correlation
        Noise correlation of neighbours, :func:`neighbour_noise_correlation`.
    looks
        Number of looks and how they are combined.
    """
    n_bins = np.asarray(n_bins, float)
    equivalent_per_bin = _equivalent_bins_per_bin(
        np.asarray(threshold_ratio, float), correlation, looks
    )
    return np.where(n_bins > 0, 1 + (n_bins - 1) * equivalent_per_bin, 0.0)


def _equivalent_bins_per_bin(
    threshold_ratio: np.ndarray, correlation: float, looks: Looks
) -> np.ndarray:
    """Return ln(1 - h) / ln(1 - p), the number of independent bins per additional adjacent bin."""
    from sweep.model.detection.marcum import marcum_q1

    if correlation in (0.0, 1.0):  # 1: a record of one sample, whose bins are all equal
        return np.full_like(threshold_ratio, 1.0 - correlation)
    if looks.is_noncoherent:
        p_stay_if_neighbour_crosses = looks.p_stay_given_neighbour_crosses(
            threshold_ratio, correlation
        )
    else:
        scaled_threshold = threshold_ratio / np.sqrt((1 - correlation) * (1 + correlation))
        # By complements, which are precise for low thresholds.
        p_stay_if_neighbour_crosses = marcum_q1(correlation * scaled_threshold, scaled_threshold).p
        p_stay_if_neighbour_crosses = (
            p_stay_if_neighbour_crosses
            - marcum_q1(scaled_threshold, correlation * scaled_threshold).p
        )
    log_p_cross = looks.log_pfa(threshold_ratio)
    p_cross, p_stay = np.exp(log_p_cross), -np.expm1(log_p_cross)
    with np.errstate(divide="ignore", invalid="ignore"):
        equivalent_per_bin = np.log1p(
            -np.minimum(p_cross * p_stay_if_neighbour_crosses / p_stay, p_cross)
        ) / np.log(p_stay)
    return np.where(
        p_cross > 1e-15, np.minimum(equivalent_per_bin, 1.0), p_stay_if_neighbour_crosses
    )


NOISE_FILTER_TAPS = 17
"""Number of independent normal numbers that make the noise of a bin."""


@lru_cache(maxsize=16)
def noise_filter(window: Window, fft_size: int, n_bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the filter that makes the noise of adjacent bins from independent normal numbers.

    Parameters
    ----------
    window, fft_size
        Window of L samples, and FFT size N.
    n_bins
        Number of adjacent bins.

    Returns
    -------
    weights
        (n_bins, NOISE_FILTER_TAPS): weights of the numbers in each bin; their squares have the sum
        1.
    first_number
        (n_bins,): index of the first number in each bin.

    Notes
    -----
    The noise of a bin at the frequency y [bins of fs/L] is sum_j W(y - j) z_j, with one number z_j
    per bin of fs/L and the window's transform W, which is real about the middle of the record.
    """
    filter_length = min(window.length, 512) // 2 * 2
    window_values = window_samples(window.name, max(filter_length, 1))
    position = np.arange(n_bins) * (window.length / fft_size)
    first_number = np.rint(position).astype(np.int64) - NOISE_FILTER_TAPS // 2
    offset, offset_index = np.unique(np.round(position - first_number, 9), return_inverse=True)
    record_position = (np.arange(window_values.size) - window_values.size // 2) / window_values.size
    cycles = (offset[:, None] - np.arange(NOISE_FILTER_TAPS))[..., None] * record_position
    weights = (np.cos(2 * np.pi * cycles) * window_values).sum(axis=-1)
    weights /= np.sqrt((weights**2).sum(axis=1, keepdims=True))
    return weights[offset_index.ravel()], first_number
