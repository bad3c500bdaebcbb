"""Share of an echo's bins that fades as one complex amplitude, where speckle is developed.

Lines of a footprint that spread over the bins with the density p(nu) give bins k, l the covariance

    C(k, l) = int p G(k - nu) G(l - nu) dnu,

G the window's transform. It is a sum over modes, which fade independently [Goodman, Speckle
Phenomena in Optics, 2007, 3.3]. Of a lone line there is one mode: all bins fade together. The
strongest mode u, of the eigenvalue m, has the share m u(k)^2 / C(k, k) of the power of bin k. The
others are taken as further noise, with the correlation of neighbours that C leaves them.

p is taken to be Gaussian. Tables are over its deviation and the place of its middle between bins.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.kernels import njit
from sweep.model.detectors import main_lobe
from sweep.model.speckle_correlation import window_transform
from sweep.model.window import COSINE_SUMS, Window, window

SPREADS = np.array([0, 0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0, 1.4, 2.0, 3.0, 4.5, 7.0, 11.0])
"""Deviations of p that tables have [bins of fs/L, or half main lobes over two if that is more]."""

OFFSETS = 9
"""Places of the middle that tables have, from -1/2 to 1/2 bin of fs/N."""

_STAND_IN_LENGTH = 1024
_ITERATIONS = 80
_NODES_MIN = 41
_NODE_DISTANCE = 0.4
"""Distance of lines that stand for a Gaussian [bins, as of SPREADS]; a wider one is a comb."""
_DEVIATIONS_MAX = 4.5
_SPREAD_OF_BINS = 3.0
"""Spread up to which twice the deviation is in tables; the strongest mode of wider ones is."""


class ModeTable(NamedTuple):
    """Shares of the strongest mode, and what correlation the others have."""

    spread: np.ndarray
    """(s,): deviations of the lines [bins of fs/N]; none where no law needs them."""
    share: np.ndarray
    """(s, OFFSETS, k): share of the strongest mode in the power of bins, about the nearest one."""
    coherence: np.ndarray
    """(s, OFFSETS, k): correlation of the signal of a bin and the one below."""
    lean: np.ndarray
    """(s, OFFSETS): :func:`lean_of` the bins about the nearest one; rises with the offset."""


NO_MODES = ModeTable(np.empty(0), np.empty((0, 0, 0)), np.empty((0, 0, 0)), np.empty((0, 0)))


@lru_cache(maxsize=32)
def mode_table(shape: Window, fft_size: int) -> ModeTable:
    """Return the table of a window and an FFT size."""
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
            covariance = np.zeros((bins.size, bins.size))
            for b in range(node.size):
                covariance += weight[b] * of_bins[:, b, None] * of_bins[None, :, b]
            power = np.maximum(np.diag(covariance), 1e-300)
            mode = _strongest_mode(covariance)
            share[s, d] = np.minimum(mode**2 / power, 1.0)
            lean[s, d] = lean_of(*np.sqrt(power[half - 1 : half + 2]))
            scale = np.sqrt(power[1:]) * np.sqrt(power[:-1])
            coherence[s, d, 1:] = np.diag(covariance, 1) / scale
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


def _strongest_mode(covariance: np.ndarray) -> np.ndarray:
    """Eigenvector of the largest eigenvalue, times its root, by iteration."""
    mode = np.sqrt(np.diag(covariance))
    value = 1.0
    for _ in range(_ITERATIONS):
        after = (covariance * mode).sum(axis=1)
        value = math.sqrt((after**2).sum())
        mode = after / max(value, 1e-300)
    return mode * math.sqrt(value)


@njit(cache=True, error_model="numpy")
def lean_of(below, middle, above):
    """Difference of the powers above and below the largest bin over their sum, from magnitudes."""
    whole = below * below + above * above
    if not whole > 1e-6 * middle * middle:
        return 0.0
    return (above * above - below * below) / whole


@njit(cache=True, error_model="numpy")
def modes_of(table, spread, lean):
    """Return where to interpolate in a table: row and weight of the next, of either index."""
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


@njit(cache=True, error_model="numpy")
def interpolated(values, at, k):
    """Value of a table at the place of :func:`modes_of`, k bins from the nearest to the middle."""
    s, over, d, aside = at
    half = values.shape[2] // 2
    k = min(max(k, -half), half) + half
    low = (1.0 - aside) * values[s, d, k] + aside * values[s, d + 1, k]
    high = (1.0 - aside) * values[s + 1, d, k] + aside * values[s + 1, d + 1, k]
    return (1.0 - over) * low + over * high
