"""What bounds on bins need to know of a window: its main lobe and how fast its power can change.

F(x) = |W(x r)|^2 / (sum w)^2 is the power of a bin x FFT bins away from a line, r = L/N. It is a
cosine series in the autocorrelation of the window,

    F(x) = sum_{n,m} w_n w_m cos(2 pi (n - m) x / N) / (sum w)^2,

so that |F''| <= (2 pi r)^2 2 V, V the variance of n/L under the weights |w_n| (times
(sum|w| / sum w)^2), and |F'| <= the root of it times sum|w| / sum w. Near the peak W follows from
the window's moments,

    |W(y)| = hypot(sum_n w_n cos(2 pi y (n/L - 1/2)), w_0 sin(pi y)).

Over all bins F adds up to ENBW / r (Parseval), wherever the line lies.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit

from sweep.model.window import Window, samples, window

_TERMS = 28
_STEPS = 1024
_ROUNDING = 1e-6
"""Relative room for reading the main lobe from a table of its values, h^2 |W''| / 8 at most."""


class Lobe(NamedTuple):
    """Main lobe of a window over an FFT's bins; powers and magnitudes relative to the peak's."""

    highest: np.ndarray
    """(m,): largest magnitude at or beyond each distance, 0..1/2 bin in equal steps."""
    lowest: np.ndarray
    """(m,): least magnitude up to each distance."""
    slope: float
    """Bound on |F'| [1/bin]."""
    curvature: float
    """Bound on |F''| [1/bin^2]."""
    margin: float
    """Bins to either side that are counted for ``energy``: 1/r, one of the window's."""
    energy: float
    """Least sum of F over the bins within ``margin`` of a line."""
    reach: np.ndarray
    """(k,): distances [bins], 0 and up."""
    envelope: np.ndarray
    """(k,): largest magnitude at or beyond each."""
    worst: float
    """Least magnitude of the bin nearest to a line."""

    def tail(self, distance: np.ndarray) -> np.ndarray:
        """Largest magnitude of a bin at least ``distance`` [bins] from a line."""
        away = np.asarray(distance, float)
        found = np.empty(away.shape)
        _put_tails(self.reach, self.envelope, away.ravel(), found.reshape(-1))
        return found

    def within(self, magnitude: np.ndarray) -> np.ndarray:
        """Distance [bins] from which on all bins are smaller; infinite where none is known."""
        sizes = np.asarray(magnitude, float)
        found = np.empty(sizes.shape)
        _put_within(self.reach, self.envelope, sizes.ravel(), found.reshape(-1))
        return found

    def most(self, distance: np.ndarray) -> np.ndarray:
        """Largest magnitude of a bin at least ``distance`` [bins] from a line, 0..1/2."""
        return _read(self.highest, distance) * (1 + _ROUNDING)

    def least(self, distance: np.ndarray) -> np.ndarray:
        """Least magnitude of a bin at most ``distance`` [bins] from a line, 0..1/2."""
        return _read(self.lowest, distance) * (1 - _ROUNDING)


def _read(table: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Main lobe's table at distances, of their shape."""
    away = np.asarray(distance, float)
    found = np.empty(away.shape)
    _read_each(table, away.ravel(), found.reshape(-1))
    return found


@njit(cache=True, error_model="numpy")
def _read_each(table, distance, found):
    for i in range(distance.size):
        found[i] = _at(table, distance[i])


@njit(cache=True, error_model="numpy")
def _at(table, distance):
    x = np.minimum(np.maximum(distance, 0.0), 0.5) * (2 * (table.size - 1))
    low = max(min(int(x), table.size - 2), 0)
    return table[low] + (x - low) * (table[low + 1] - table[low])


@njit(cache=True, error_model="numpy")
def lobe_most(highest, distance):
    """:meth:`Lobe.most` of one distance, compiled."""
    return _at(highest, distance) * (1 + _ROUNDING)


@njit(cache=True, error_model="numpy")
def lobe_least(lowest, distance):
    """:meth:`Lobe.least` of one distance, compiled."""
    return _at(lowest, distance) * (1 - _ROUNDING)


@njit(cache=True, error_model="numpy")
def lobe_tail(reach, envelope, distance):
    """:meth:`Lobe.tail` of one distance, compiled."""
    return envelope[np.searchsorted(reach, np.fmax(distance, 0.0), "right") - 1]


@njit(cache=True, error_model="numpy")
def lobe_within(reach, envelope, magnitude):
    """:meth:`Lobe.within` of one magnitude, compiled."""
    if np.isnan(magnitude):
        return np.inf
    first, last = 0, envelope.size
    while first < last:
        middle = (first + last) // 2
        if envelope[middle] > magnitude:
            first = middle + 1
        else:
            last = middle
    return reach[first] if first < reach.size else np.inf


@njit(cache=True, error_model="numpy")
def _put_tails(reach, envelope, distance, found):
    for i in range(distance.size):
        found[i] = lobe_tail(reach, envelope, distance[i])


@njit(cache=True, error_model="numpy")
def _put_within(reach, envelope, magnitude, found):
    for i in range(magnitude.size):
        found[i] = lobe_within(reach, envelope, magnitude[i])


@lru_cache(maxsize=32)
def lobe(name: str, length: int, fft_size: int) -> Lobe:
    """The main lobe of the window of this name over an FFT, prepared once and kept."""
    shape = window(name, length)
    w = samples(shape.name, length)
    place = np.arange(length) / length - 0.5
    weight = np.abs(w) / np.abs(w).sum()
    variance = float((weight * place**2).sum() - (weight * place).sum() ** 2)
    excess = float(np.abs(w).sum() / w.sum())
    ratio = length / fft_size
    curvature = 2 * variance * (2 * math.pi * ratio * excess) ** 2
    coefficients = _series(w, place)
    distance = np.linspace(0.0, 0.5, _STEPS + 1)
    value = main_lobe(shape, coefficients, distance * ratio)
    lowest = np.minimum.accumulate(value)
    return Lobe(
        highest=np.maximum.accumulate(value[::-1])[::-1].copy(),
        lowest=lowest,
        slope=excess * math.sqrt(curvature),
        curvature=curvature,
        margin=1 / ratio,
        energy=_least_energy(shape, coefficients, ratio, excess * math.sqrt(curvature)),
        reach=np.concatenate([[0.0], shape.reach / ratio]),
        envelope=np.concatenate([[max(1.0, value.max(), shape.envelope[0])], shape.envelope]),
        worst=lobe_least(lowest, 0.5),
    )


def _series(w: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Coefficients of S(y) / sum w in powers of y^2, from the window's even moments."""
    moments = np.empty(_TERMS)
    power = w / w.sum()
    for k in range(_TERMS):
        moments[k] = power.sum()
        power = power * (place * place)
    order = np.arange(_TERMS)
    sizes = [(2 * math.pi) ** (2 * k) / math.factorial(2 * k) for k in order.tolist()]
    return np.asarray((-1.0) ** order * sizes * moments)


def main_lobe(shape: Window, coefficients: np.ndarray, y: np.ndarray) -> np.ndarray:
    """|W(y)| / sum w for |y| <= 1.5 bins of fs/L, by its series."""
    real = np.polynomial.polynomial.polyval(np.asarray(y, float) ** 2, coefficients)
    return np.hypot(real, shape.edge / shape.sum * np.sin(np.pi * np.asarray(y, float)))


def _least_energy(shape: Window, series: np.ndarray, ratio: float, slope: float) -> float:
    """Least sum of F over the bins within one window bin of a line, over where the line lies."""
    reach = math.floor(1 / ratio) + 1
    shift = np.arange(64) / 64
    away = (np.arange(-reach, reach + 1)[:, None] - shift) * ratio
    power = np.where(abs(away) <= 1, main_lobe(shape, series, away.clip(-1, 1)) ** 2, 0.0)
    if reach <= 2:
        # a bin leaves the sum where it crosses the margin, the others change by their slope
        return float(max(power.sum(axis=0).min() - 2 * reach * slope / 128, 0.5))
    return float(0.98 * power.sum(axis=0).min())
