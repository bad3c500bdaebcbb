"""Noise of a segment's bins: how alike neighbours are, and how often any of many crosses.

The bins' noise is the transform of white noise times the window w, so that bins y apart (in bins of
fs/L) are correlated as W2(y) / W2(0), W2 the transform of w^2. Of n adjacent bins the alarms are
taken as a Markov chain of first order. With p the probability that a bin crosses a threshold of b
sigma,

    P(none) = (1 - p) (1 - h)^(n - 1),    h = (p - p11) / (1 - p),

h the probability that a bin crosses after one that does not. p11, that both do, is the joint tail
of two Rayleigh magnitudes [Simon and Alouini, Digital Communication over Fading Channels, 6.1.2].
With rho^2 = |W2/W2(0)|^2 of neighbours

    p - p11 = p (Q_1(s b, s rho b) - Q_1(s rho b, s b)),    s^2 = 1 / (1 - rho^2).

A real record's noise is real at DC and Nyquist and nearly so next to them, where it alarms far more
often. Bins whose noise is not circular are not searched for alarms.

So n bins alarm as 1 + (n - 1) ln(1 - h) / ln(1 - p) independent ones do: everything that is known
of independent bins serves, in logarithms too. At TNR 6 it is within 2 % of drawn noise for
rectangular, Hamming, Hann and Blackman windows, 3 % for flattop and Hann padded by 4.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.detection.looks import SINGLE_LOOK, Looks
from sweep.model.window import Window, window_samples

CIRCULAR_RATIO_MAX = 0.01
"""Share |W2(2k)| / W2(0) by which quadratures of a bin may differ that is taken to be circular."""


@lru_cache(maxsize=64)
def neighbour_noise_correlation(window: Window, fft_size: int) -> float:
    """Correlation |W2(1)| / W2(0), 0..1, of the noise of adjacent bins, fs/N apart."""
    return _noise_correlation_at(window, fft_size, 1)


@lru_cache(maxsize=64)
def first_circular_bin(window: Window, fft_size: int) -> int:
    """First bin, counted from DC or from Nyquist, whose noise is circular; 1 or more.

    Noise in bin k of a real record has quadratures of variance sigma^2 (1 +- |W2(2k)| / W2(0)).
    """
    padding_factor, last_noncircular_bin = fft_size / window.length, 0
    for k in range(1, math.ceil(8 * padding_factor), max(int(padding_factor / 16), 1)):
        if _noise_correlation_at(window, fft_size, 2 * k) > CIRCULAR_RATIO_MAX:
            last_noncircular_bin = k
    return last_noncircular_bin + 1


def _noise_correlation_at(window: Window, fft_size: int, bin_distance: int) -> float:
    squared_window = window_samples(window.name, window.length) ** 2
    exponentials = np.exp(
        -2j * np.pi * (bin_distance * np.arange(window.length) % fft_size) / fft_size
    )
    correlation = abs((squared_window * exponentials).sum()) / squared_window.sum()
    return (
        float(correlation) if correlation > 1e-12 else 0.0
    )  # none but rounding, of unpadded rectangles


def alarm_equivalent_bins(
    n_bins: ArrayLike, *, threshold_ratio: ArrayLike, correlation: float, looks: Looks = SINGLE_LOOK
) -> np.ndarray:
    """Return the number, 0..n, of independent bins that raise an alarm as often as n adjacent ones.

    By the threshold over sigma, and the correlation of neighbours
    (:func:`neighbour_noise_correlation`).
    """
    n_bins = np.asarray(n_bins, float)
    equivalent_per_bin = _equivalent_bins_per_bin(
        np.asarray(threshold_ratio, float), correlation, looks
    )
    return np.where(n_bins > 0, 1 + (n_bins - 1) * equivalent_per_bin, 0.0)


def _equivalent_bins_per_bin(
    threshold_ratio: np.ndarray, correlation: float, looks: Looks
) -> np.ndarray:
    """ln(1 - h) / ln(1 - p), what each further bin counts for."""
    from sweep.model.detection.marcum import marcum_q1

    if correlation in (0.0, 1.0):  # of one sample all bins are alike
        return np.full_like(threshold_ratio, 1.0 - correlation)
    if looks.is_noncoherent:
        p_stay_if_neighbour_crosses = looks.p_stay_given_neighbour_crosses(
            threshold_ratio, correlation
        )
    else:
        scaled_threshold = threshold_ratio / np.sqrt((1 - correlation) * (1 + correlation))
        # Of complements, which keep their digits where thresholds are low.
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
"""Independent numbers of which a bin's noise is made."""


@lru_cache(maxsize=16)
def noise_filter(window: Window, fft_size: int, n_bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Weights that make the noise of adjacent bins of independent numbers, one each fs/L.

    The noise of a bin at y [bins of fs/L] is sum_j W(y - j) z_j, as the transform of a record is
    that of its own bins. In phase with the middle of a line's main lobe W is real. Returns weights
    (bins, TAPS), their squares' sum 1, and the number of each bin's first (bins,).
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
