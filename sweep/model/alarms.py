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

from sweep.model.looks import ONE, Looks
from sweep.model.window import Window, samples

CIRCULAR = 0.01
"""Share |W2(2k)| / W2(0) by which quadratures of a bin may differ that is taken to be circular."""


@lru_cache(maxsize=64)
def neighbour_correlation(window: Window, fft_size: int) -> float:
    """Correlation |W2(1)| / W2(0), 0..1, of the noise of adjacent bins, fs/N apart."""
    return _correlation(window, fft_size, 1)


@lru_cache(maxsize=64)
def first_circular(window: Window, fft_size: int) -> int:
    """First bin, counted from DC or from Nyquist, whose noise is circular; 1 or more.

    Noise in bin k of a real record has quadratures of variance sigma^2 (1 +- |W2(2k)| / W2(0)).
    """
    ratio, found = fft_size / window.length, 0
    for k in range(1, math.ceil(8 * ratio), max(int(ratio / 16), 1)):
        if _correlation(window, fft_size, 2 * k) > CIRCULAR:
            found = k
    return found + 1


def _correlation(window: Window, fft_size: int, apart: int) -> float:
    squares = samples(window.name, window.length) ** 2
    turns = np.exp(-2j * np.pi * (apart * np.arange(window.length) % fft_size) / fft_size)
    found = abs((squares * turns).sum()) / squares.sum()
    return float(found) if found > 1e-12 else 0.0  # none but rounding, of unpadded rectangles


def independent_bins(
    bins: ArrayLike, *, level: ArrayLike, correlation: float, looks: Looks = ONE
) -> np.ndarray:
    """Return the number, 0..n, of independent bins that raise an alarm as often as n adjacent ones.

    By the threshold over sigma, and the correlation of neighbours (:func:`neighbour_correlation`).
    """
    bins = np.asarray(bins, float)
    share = _share(np.asarray(level, float), correlation, looks)
    return np.where(bins > 0, 1 + (bins - 1) * share, 0.0)


def _share(level: np.ndarray, correlation: float, looks: Looks) -> np.ndarray:
    """ln(1 - h) / ln(1 - p), what each further bin counts for."""
    from sweep.model.marcum import marcum_q1

    if correlation in (0.0, 1.0):  # of one sample all bins are alike
        return np.full_like(level, 1.0 - correlation)
    if looks.several:
        fresh = looks.fresh(level, correlation)
    else:
        scaled = level / np.sqrt((1 - correlation) * (1 + correlation))
        # Of complements, which keep their digits where thresholds are low.
        fresh = marcum_q1(correlation * scaled, scaled).p
        fresh = fresh - marcum_q1(scaled, correlation * scaled).p
    log_p = looks.log_alarm(level)
    p, quiet = np.exp(log_p), -np.expm1(log_p)
    with np.errstate(divide="ignore", invalid="ignore"):
        after = np.log1p(-np.minimum(p * fresh / quiet, p)) / np.log(quiet)
    return np.where(p > 1e-15, np.minimum(after, 1.0), fresh)


@lru_cache(maxsize=64)
def pair_nodes(correlation: float) -> np.ndarray:
    """Rule for the joint tail of two normal numbers (:func:`sweep.model.detection.any_pair`).

    Twelve Gauss points u in 0 .. asin(correlation): sin u, weights, 1 / (2 cos^2 u), (3, 12); or
    none, (3, 0), for independent numbers.
    """
    if correlation == 0.0:
        return np.empty((3, 0))
    node, weight = np.polynomial.legendre.leggauss(12)
    half = 0.5 * math.asin(correlation)
    sine = np.sin(half * (node + 1))
    return np.stack([sine, half * weight / (2 * math.pi), 0.5 / (1 - sine**2)])


TAPS = 17
"""Independent numbers of which a bin's noise is made."""


@lru_cache(maxsize=16)
def noise_filter(window: Window, fft_size: int, bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Weights that make the noise of adjacent bins of independent numbers, one each fs/L.

    The noise of a bin at y [bins of fs/L] is sum_j W(y - j) z_j, as the transform of a record is
    that of its own bins. In phase with the middle of a line's main lobe W is real. Returns weights
    (bins, TAPS), their squares' sum 1, and the number of each bin's first (bins,).
    """
    length = min(window.length, 512) // 2 * 2
    taper = samples(window.name, max(length, 1))
    place = np.arange(bins) * (window.length / fft_size)
    start = np.rint(place).astype(np.int64) - TAPS // 2
    shift, which = np.unique(np.round(place - start, 9), return_inverse=True)
    turns = (np.arange(taper.size) - taper.size // 2) / taper.size
    angles = (shift[:, None] - np.arange(TAPS))[..., None] * turns
    weights = (np.cos(2 * np.pi * angles) * taper).sum(axis=-1)
    weights /= np.sqrt((weights**2).sum(axis=1, keepdims=True))
    return weights[which.ravel()], start
