"""Detectors: which bins of a spectrum hold a signal, by a fixed threshold or by their neighbours.

All look at the power |X|^2 of every bin (a square-law detector). A constant-false-alarm-rate (CFAR)
detector holds each bin against ``factor`` times a level that it takes from *training* cells, half
of them on either side, with *guard* cells between that are left out so that the signal does not
train its own threshold:

- ``ca_cfar``, cell averaging: the mean of all training cells [Finn and Johnson, RCA Review 29, 414,
  1968].
- ``goca_cfar``, greatest of: the larger of the means of the two halves, against clutter edges
  [Hansen, IEE Conf. Radar, 325, 1973].
- ``os_cfar``, ordered statistic: the cell of a rank among all sorted training cells, against other
  targets among them [Rohling, IEEE Trans. Aerosp. Electron. Syst. 19, 608, 1983].

The factors follow from the design probability of a false alarm in closed form, for independent
cells of exponential noise [Gandhi and Kassam, IEEE Trans. Aerosp. Electron. Syst. 24, 427, 1988;
Richards, Fundamentals of Radar Signal Processing, 2014, chapter 6]. A tapered window or a padded
FFT makes the noise of neighbouring bins alike: fewer independent cells stand behind the level, and
more false alarms come than by design (docs/detectors.md has how many).

The same forms give the probability of detection of a signal that fluctuates as speckle does
(Swerling 1): a cell whose mean is 1 + snr times the noise's crosses as noise does a factor smaller
by 1 + snr.

The spectrum of a white record has no ends: training cells beyond DC are those below Nyquist, and
the other way round.
"""

import math
from collections.abc import Callable

import numpy as np
from numba import njit
from scipy.special import gammaln

from sweep.model.processing import Setting

FIXED = "fixed"
CA, OS, GOCA = "ca_cfar", "os_cfar", "goca_cfar"

Detector = Callable[[np.ndarray, Setting], np.ndarray]
"""From power |X|^2 (m, N/2 + 1) of m spectra and the setting to bool of the same shape."""


def crossing_probability(kind: str, factor: float, *, training: int, rank: int) -> float:
    """Probability that a cell of exponential power exceeds its CFAR threshold.

    Parameters
    ----------
    kind : str
        ``ca_cfar``, ``os_cfar`` or ``goca_cfar``.
    factor : float
        Threshold over the level that training cells give, >= 0; where the cell's own mean is
        1 + snr times theirs, over 1 + snr.
    training, rank : int
        Number of training cells, even; rank of the ordered statistic, 1..training.
    """
    if kind == CA:
        return float((1 + factor / training) ** -training)
    if kind == OS:
        # prod_{i < rank} (N - i) / (N - i + factor)
        upper, lower = training + 1, training - rank + 1
        logarithm = (gammaln(upper) - gammaln(lower)) - (
            gammaln(upper + factor) - gammaln(lower + factor)
        )
        return float(np.exp(logarithm))
    half = training // 2
    step = factor / half
    k = np.arange(half)
    terms = gammaln(half + k) - gammaln(half) - gammaln(k + 1) - (half + k) * np.log(2 + step)
    return float(2 * ((1 + step) ** -half - np.exp(terms).sum()))


def cfar_factor(kind: str, *, training: int, rank: int, pfa: float) -> float:
    """Factor on the level of training cells for a design probability of a false alarm in a bin."""
    from scipy.optimize import brentq  # slow to import, and only CFAR has a factor to find

    if kind == CA:
        return training * math.expm1(-math.log(pfa) / training)

    def excess(logarithm: float) -> float:
        found = crossing_probability(kind, math.exp(logarithm), training=training, rank=rank)
        return math.log(max(found, 1e-300)) - math.log(pfa)

    high = 0.0
    while excess(high) > 0:
        high += 1.0
    return math.exp(brentq(excess, -60.0, high, xtol=1e-14, rtol=1e-14))


def fixed(power: np.ndarray, setting: Setting) -> np.ndarray:
    """Bins at or above the fixed threshold (:func:`sweep.model.detection.threshold`)."""
    return power >= setting.threshold**2


def ca_cfar(power: np.ndarray, setting: Setting) -> np.ndarray:
    """Bins at or above the cell-averaging threshold."""
    return _averaged(power, setting.training // 2, setting.guard, _factor(CA, setting), False)


def goca_cfar(power: np.ndarray, setting: Setting) -> np.ndarray:
    """Bins at or above the greatest-of cell-averaging threshold."""
    return _averaged(power, setting.training // 2, setting.guard, _factor(GOCA, setting), True)


def os_cfar(power: np.ndarray, setting: Setting) -> np.ndarray:
    """Bins at or above the threshold of an ordered statistic."""
    return _ordered(
        power, setting.training // 2, setting.guard, _factor(OS, setting), setting.rank
    )  # fmt: skip


DETECTORS: dict[str, Detector] = {FIXED: fixed, CA: ca_cfar, OS: os_cfar, GOCA: goca_cfar}


def _factor(kind: str, setting: Setting) -> float:
    return cfar_factor(kind, training=setting.training, rank=setting.rank, pfa=setting.pfa)


@njit(cache=True, nogil=True, error_model="numpy")
def _unfolded(power, reach, cells):
    """Bins of a spectrum but DC and Nyquist, with ``reach`` more at either end, its other end's."""
    number = power.size - 2
    for i in range(number + 2 * reach):
        cells[i] = power[1 + (i - reach) % number]


@njit(cache=True, nogil=True, error_model="numpy")
def _averaged(power, half, guard, factor, greatest):
    """Means of training cells, or the greater of the means of both sides, times the factor."""
    rows, bins = power.shape
    found = np.zeros((rows, bins), np.bool_)
    reach = half + guard
    cells = np.empty(bins - 2 + 2 * reach)
    for row in range(rows):
        _unfolded(power[row], reach, cells)
        for k in range(1, bins - 1):
            below, above = 0.0, 0.0
            for i in range(half):
                below += cells[k - 1 + i]
                above += cells[k + reach + guard + i]
            level = max(below, above) / half if greatest else (below + above) / (2 * half)
            found[row, k] = power[row, k] >= factor * level
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _ordered(power, half, guard, factor, rank):
    """The same with a training cell of a rank: as many of them must stay below the bin."""
    rows, bins = power.shape
    found = np.zeros((rows, bins), np.bool_)
    reach = half + guard
    cells = np.empty(bins - 2 + 2 * reach)
    for row in range(rows):
        _unfolded(power[row], reach, cells)
        for k in range(1, bins - 1):
            least, count = power[row, k] / factor, 0
            for i in range(half):
                count += cells[k - 1 + i] <= least
                count += cells[k + reach + guard + i] <= least
            found[row, k] = count >= rank
    return found
