"""Strongest speckle mode of an echo: the part that fades in all of its bins as one amplitude.

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
from sweep.model.detectors import main_lobe
from sweep.model.speckle_correlation import window_transform
from sweep.model.window import COSINE_SUMS, Window, window

SPREADS = np.array([0, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.4, 2.0, 3.0, 4.5, 7.0, 11.0])
"""Standard deviations of p in the tables, in units of a bin of fs/L, or of a quarter of the main
lobe's width where that is more."""

OFFSETS = 9
"""Number of positions of p's centre in the tables, evenly spaced over -1/2 .. 1/2 bin of fs/N."""

_STAND_IN_LENGTH = 1024
_ITERATIONS = 80
_NODES_MIN = 41
_NODE_DISTANCE = 0.4
"""Distance of lines that stand for a Gaussian [bins, as of SPREADS]; a wider one is a comb."""
_DEVIATIONS_MAX = 4.5
_SPREAD_OF_BINS = 3.0
"""Spread up to which twice the deviation is in tables; the strongest mode of wider ones is."""


class ModeTable(NamedTuple):
    """Power fraction of the strongest mode, and the correlation of neighbouring bins."""

    spread: np.ndarray
    """(s,): standard deviations of the lines' density [bins of fs/N]; empty in NO_MODES."""
    share: np.ndarray
    """(s, OFFSETS, k): power fraction of the strongest mode in a bin, k bins about the nearest
    one."""
    coherence: np.ndarray
    """(s, OFFSETS, k): correlation of the echo's amplitudes in a bin and in the one below it,
    signed."""
    lean: np.ndarray
    """(s, OFFSETS): :func:`lean_of` the three bins about the nearest one; rises with the offset."""


NO_MODES = ModeTable(np.empty(0), np.empty((0, 0, 0)), np.empty((0, 0, 0)), np.empty((0, 0)))


@lru_cache(maxsize=32)
def mode_table(shape: Window, fft_size: int) -> ModeTable:
    """Tabulate the strongest mode for a window and an FFT size (cached)."""
    ratio, lobe = fft_size / shape.length, main_lobe(shape)
    if shape.name in COSINE_SUMS:
        shape = window(shape.name, min(shape.length, _STAND_IN_LENGTH))
    deviations = SPREADS * max(1.0, lobe / 2)
    half = math.ceil((lobe + 2 * _SPREAD_OF_BINS * max(1.0, lobe / 2)) * ratio)
    bins = np.arange(-half, half + 1) / ratio
    offsets = np.linspace(-0.5, 0.5, OFFSETS) / ratio
    share = np.empty((deviations.size, OFFSETS, bins.size))
    coherence, lean = np.zeros_like(share), np.empty(share.shape[:2])
    for s, deviation in enumerate(deviations):
        node, weight = _gaussian_nodes(SPREADS[s])
        for d, offset in enumerate(offsets):
            lines = offset + deviation * node
            of_bins = window_transform(shape, bins[:, None] - lines)
            # Sums, not products of matrices, whose order depends on the number of threads.
            power, beside = np.zeros(bins.size), np.zeros(bins.size - 1)
            for b in range(node.size):
                power += weight[b] * of_bins[:, b] ** 2
                beside += weight[b] * of_bins[1:, b] * of_bins[:-1, b]
            power = np.maximum(power, 1e-300)
            mode = _strongest_mode(of_bins, weight, np.sqrt(power))
            share[s, d] = np.minimum(mode**2 / power, 1.0)
            lean[s, d] = lean_of(*np.sqrt(power[half - 1 : half + 2]))
            coherence[s, d, 1:] = beside / (np.sqrt(power[1:]) * np.sqrt(power[:-1]))
    # Of a lone line, in bins where its transform is 0 as well.
    share[0], coherence[0] = 1.0, np.where(coherence[0] < 0, -1.0, 1.0)
    coherence[:, :, 0] = coherence[:, :, 1]
    return ModeTable(deviations * ratio, share, coherence, np.maximum.accumulate(lean, axis=1))


def _gaussian_nodes(spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Return evenly spaced nodes and weights of a mean over a standard normal number."""
    number = max(_NODES_MIN, math.ceil(2 * _DEVIATIONS_MAX * spread / _NODE_DISTANCE))
    node = np.linspace(-_DEVIATIONS_MAX, _DEVIATIONS_MAX, number)
    weight = np.exp(-0.5 * node * node)
    return node, weight / weight.sum()


def _strongest_mode(of_bins: np.ndarray, weight: np.ndarray, mode: np.ndarray) -> np.ndarray:
    """Return the leading eigenvector of a covariance, times the root of its eigenvalue.

    Power iteration from ``mode`` (bins,). The covariance is the sum of the amplitudes (bins, lines)
    of each line's bins with themselves, by the weights (lines,) of the lines' powers. It is not
    formed if there are more bins than lines: of padded spectra it has millions of elements.
    """
    covariance, value = None, 1.0
    if len(of_bins) <= weight.size:
        covariance = np.zeros((len(of_bins), len(of_bins)))
        for b in range(weight.size):
            covariance += weight[b] * of_bins[:, b, None] * of_bins[None, :, b]
    for _ in range(_ITERATIONS):
        if covariance is None:
            of_lines = weight * (of_bins * mode[:, None]).sum(axis=0)
            after = (of_bins * of_lines).sum(axis=1)
        else:
            after = (covariance * mode).sum(axis=1)
        value = math.sqrt((after**2).sum())
        mode = after / max(value, 1e-300)
    return mode * math.sqrt(value)


@njit(cache=True, error_model="numpy", borrows=True)
def lean_of(below, middle, above):
    """Return (P_above - P_below) / (P_above + P_below) of the largest bin's neighbours; 0 if faint.

    Arguments are magnitudes |X|. The ratio tells on which side of the bin the echo's centre lies.
    """
    whole = below * below + above * above
    if not whole > 1e-6 * middle * middle:
        return 0.0
    return (above * above - below * below) / whole


@njit(cache=True, error_model="numpy", borrows=True)
def modes_of(table, spread, lean):
    """Return the cell (s, d) of a table around a spread and an asymmetry, and the weights in it.

    Result: s, weight of s + 1, d, weight of d + 1; weights 0 .. 1 (bilinear interpolation).
    """
    s = 0
    while s < table.spread.size - 2 and table.spread[s + 1] <= spread:
        s += 1
    width = table.spread[s + 1] - table.spread[s]
    over = min(max((spread - table.spread[s]) / width, 0.0), 1.0)
    d = 0
    while d < OFFSETS - 2 and table.lean[s, d + 1] <= lean:
        d += 1
    step = table.lean[s, d + 1] - table.lean[s, d]
    aside = (lean - table.lean[s, d]) / step if step > 0.0 else 0.0
    return s, over, d, min(max(aside, 0.0), 1.0)


@njit(cache=True, error_model="numpy", borrows=True)
def interpolated(values, at, k):
    """Interpolate a table (s, OFFSETS, bins) k bins from the bin nearest to the echo's centre.

    The cell ``at`` is a result of :func:`modes_of`.
    """
    s, over, d, aside = at
    half = values.shape[2] // 2
    k = min(max(k, -half), half) + half
    low = (1.0 - aside) * values[s, d, k] + aside * values[s, d + 1, k]
    high = (1.0 - aside) * values[s + 1, d, k] + aside * values[s + 1, d + 1, k]
    return (1.0 - over) * low + over * high
