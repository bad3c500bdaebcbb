"""Main lobe of a window, and bounds on how its power changes, for the sizes of effects.

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

from sweep.model.window import Window, samples, window

_ROUNDING = 1e-6
_TERMS = 28
_STEPS = 1024
_CELLS, _KNEE = 8192, 16.0
"""Cells of the table of sidelobes, even in d / (d + knee), and its knee [bins of fs/L]."""
_OCTAVES = 64
"""Cells an octave of the table of how far lines reach."""
_LEAST = -80
"""Octaves below the peak at which that table ends."""


class Lobe(NamedTuple):
    """A window over an FFT's bins; powers and magnitudes relative to the peak's."""

    main: np.ndarray
    """(m,): magnitude at distances of 0..1/2 bin in equal steps."""
    slope: float
    """Bound on |F'| [1/bin]."""
    curvature: float
    """Bound on |F''| [1/bin^2]."""
    margin: float
    """Bins to either side that are counted for ``energy``: 1/r, one of the window's."""
    energy: float
    """Least sum of F over the bins within ``margin`` of a line."""
    envelope: np.ndarray
    """(cells + 1,): largest magnitude at or beyond distances even in d / (d + knee)."""
    away: np.ndarray
    """(cells,): distance [bins] from which on all are smaller, by octaves of magnitude."""
    worst: float
    """Least magnitude of the bin nearest to a line."""

    def near(self, distance: np.ndarray) -> np.ndarray:
        """Magnitude of a bin at a distance from a line, 0..1/2 bin."""
        away = np.fmin(distance, 0.5)
        return self.main[(away * (2 * _STEPS) + 0.5).astype(np.int64)]

    def tail(self, distance: np.ndarray) -> np.ndarray:
        """Largest magnitude of a bin at least ``distance`` [bins] from a line."""
        knee = _KNEE * self.margin
        share = 1 - knee / (np.fmax(distance, 0.0) + knee)
        return self.envelope[(share * _CELLS).astype(np.int64)]

    def within(self, magnitude: np.ndarray) -> np.ndarray:
        """Distance [bins] from which on all bins are smaller; infinite where none is known."""
        octave = np.log2(np.fmin(np.fmax(magnitude, 2.0**_LEAST), 1.0))
        return self.away[np.ceil(-octave * _OCTAVES).astype(np.int64)]


@lru_cache(maxsize=32)
def lobe(name: str, length: int, fft_size: int) -> Lobe:
    """Return the lobe of the window of this name over an FFT, prepared once and cached."""
    shape = window(name, length)
    w = samples(shape.name, length)
    place = np.arange(length) / length - 0.5
    weight = np.abs(w) / np.abs(w).sum()
    variance = float((weight * place**2).sum() - (weight * place).sum() ** 2)
    excess = float(np.abs(w).sum() / w.sum())
    ratio = length / fft_size
    curvature = 2 * variance * (2 * math.pi * ratio * excess) ** 2
    coefficients = _series(w, place)
    value = main_lobe(shape, coefficients, np.linspace(0.0, 0.5, _STEPS + 1) * ratio)
    reach = np.concatenate([[0.0], shape.reach])
    envelope = np.concatenate([[max(1.0, value.max(), shape.envelope[0])], shape.envelope])
    share = np.arange(_CELLS + 1) / _CELLS
    with np.errstate(divide="ignore"):
        distance = _KNEE * share / (1 - share)
    magnitude = 2.0 ** (-np.arange(-_LEAST * _OCTAVES + 2) / _OCTAVES)
    first = np.searchsorted(-envelope, -magnitude)
    return Lobe(
        main=value,
        slope=excess * math.sqrt(curvature),
        curvature=curvature,
        margin=1 / ratio,
        energy=_least_energy(shape, coefficients, ratio, excess * math.sqrt(curvature)),
        envelope=envelope[np.searchsorted(reach, distance, "right") - 1],
        away=np.append(reach, np.inf)[first] / ratio,
        worst=float(value.min()) * (1 - _ROUNDING),
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
