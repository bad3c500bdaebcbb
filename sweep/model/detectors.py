"""Detectors: which bins of a spectrum hold a signal, by a fixed threshold or by their neighbours.

All look at the power |X|^2 of every bin (a square-law detector). A constant-false-alarm-rate (CFAR)
detector holds each bin against ``factor`` times a level that it takes from *training* cells, half
of them on either side, with *guard* cells between. Guard cells are left out so that the signal does
not train its own threshold:

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
(Swerling 1). A cell whose mean is 1 + snr times the noise's crosses as noise does a factor smaller
by 1 + snr.

The spectrum of a white record has no ends: training cells beyond DC are those below Nyquist, and
the other way round; in a complex record's spectrum those beyond its last bin are its first.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import gammaln

from sweep.model.window import Window, samples

FIXED = "fixed"
CA, OS, GOCA = "ca_cfar", "os_cfar", "goca_cfar"


@lru_cache(maxsize=8)
def taper(window: Window) -> np.ndarray:
    """Return the samples (L,) of a window, computed once and read-only."""
    values = samples(window.name, window.length)
    values.flags.writeable = False
    return values


@lru_cache(maxsize=8)
def main_lobe(window: Window) -> float:
    """Distance [bins of fs/L] of the first minimum of |W| below its half, to 1/8 bin."""
    magnitude = np.abs(np.fft.rfft(taper(window), 8 * window.length))
    low = magnitude[:-1] < 0.5 * magnitude[0]  # a flattop's top has minima of its own
    return float(np.argmax(low & (np.diff(magnitude) > 0))) / 8


@dataclass(frozen=True, eq=False, kw_only=True)
class Setting:
    """Settings by which spectra were made, and by which they are detected."""

    fft_size: int
    """Points N of the FFT; spectra have the bins 0..N/2, or -N/2..N/2 - 1 of a complex record."""
    sample_rate: float
    """[Hz]; a bin is ``sample_rate / fft_size`` wide."""
    window: Window
    """Its ``length`` L <= N is that of the record, which is padded with zeros to N."""
    noise_power: float
    """Mean |X|^2 of a bin of noise alone, by the receiver's noise budget [V^2]."""
    threshold: float
    """Fixed threshold on |X| [V]."""
    training: int
    """Training cells, half of them on either side; even."""
    guard: int
    """Guard cells on either side."""
    rank: int
    """Rank of the ordered statistic among the training cells, 1 for the least."""
    pfa: float
    """Design probability of a false alarm in a bin of noise alone."""
    complex_record: bool = False
    """True for records of I and Q: bin k stands at index k + N/2."""

    @property
    def taper(self) -> np.ndarray:
        """Samples (L,) of the window."""
        return taper(self.window)


Detector = Callable[[np.ndarray, Setting], np.ndarray]
"""From power |X|^2 (m, N/2 + 1) of m spectra, (m, N) of complex records, and the setting to bool of
the same shape."""


def crossing_probability(kind: str, factor: float, *, training: int, rank: int) -> float:
    """Probability that a cell of exponential power exceeds its CFAR threshold.

    `factor` is the threshold over the level that training cells give; where the cell's own mean is
    1 + snr times theirs, over 1 + snr. `rank` is 1..training, and training even.
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
    below, above = _sums(power, setting)
    return _at_or_above(power, (below + above) / (setting.training // 2 * 2), CA, setting)


def goca_cfar(power: np.ndarray, setting: Setting) -> np.ndarray:
    """Bins at or above the greatest-of cell-averaging threshold."""
    level = np.maximum(*_sums(power, setting)) / (setting.training // 2)
    return _at_or_above(power, level, GOCA, setting)


def os_cfar(power: np.ndarray, setting: Setting) -> np.ndarray:
    """Bins at or above the threshold of an ordered statistic: so many cells stay below the bin."""
    cells = _cells(power, setting)
    least, count = cells / _factor(OS, setting), np.zeros(cells.shape, np.int64)
    for below, above in _training_cells(power, setting):
        count += below <= least
        count += above <= least
    return _of_all(count >= setting.rank, setting)


DETECTORS: dict[str, Detector] = {FIXED: fixed, CA: ca_cfar, OS: os_cfar, GOCA: goca_cfar}


def _factor(kind: str, setting: Setting) -> float:
    return cfar_factor(kind, training=setting.training, rank=setting.rank, pfa=setting.pfa)


def _cells(power: np.ndarray, setting: Setting) -> np.ndarray:
    """Bins whose noise is circular: all but DC and Nyquist of a real record."""
    return power if setting.complex_record else power[:, 1:-1]


def _of_all(flags: np.ndarray, setting: Setting) -> np.ndarray:
    """Extend flags to all bins from those of :func:`_cells`."""
    return flags if setting.complex_record else np.pad(flags, ((0, 0), (1, 1)))


def _training_cells(power: np.ndarray, setting: Setting) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Training cells of the bins of :func:`_cells`, one below and one above at a time.

    The spectrum goes on at either end with its other end's bins.
    """
    cells, half = _cells(power, setting), setting.training // 2
    number, reach = cells.shape[1], half + setting.guard
    cells = cells[:, np.arange(-reach, number + reach) % number]
    for i in range(half):
        above = reach + setting.guard + 1 + i
        yield cells[:, i : i + number], cells[:, above : above + number]


def _sums(power: np.ndarray, setting: Setting) -> tuple[np.ndarray, np.ndarray]:
    """Sum the training cells below and above each bin."""
    sums = np.zeros((2, *_cells(power, setting).shape))
    for pair in _training_cells(power, setting):
        sums += pair
    return sums[0], sums[1]


def _at_or_above(power: np.ndarray, level: np.ndarray, kind: str, setting: Setting) -> np.ndarray:
    return _of_all(_cells(power, setting) >= _factor(kind, setting) * level, setting)
