"""Detectors: which bins of a spectrum hold a signal, by a fixed threshold or by their neighbours.

All are square-law detectors: they compare the power |X|^2 of every bin with a threshold. In a
constant-false-alarm-rate (CFAR) detector the threshold is ``factor`` times a level, which is
estimated from *training* cells, half of them on either side. *Guard* cells next to the bin are
excluded, so that a signal does not raise its own threshold:

- ``ca_cfar``, cell averaging: the mean of all training cells [Finn and Johnson, RCA Review 29, 414,
  1968].
- ``goca_cfar``, greatest of: the larger of the means of the two halves, against clutter edges
  [Hansen, IEE Conf. Radar, 325, 1973].
- ``os_cfar``, ordered statistic: the cell of a rank among all sorted training cells, against other
  targets among them [Rohling, IEEE Trans. Aerosp. Electron. Syst. 19, 608, 1983].

The factors follow from the design probability of a false alarm in closed form, for independent
cells of exponential noise [Gandhi and Kassam, IEEE Trans. Aerosp. Electron. Syst. 24, 427, 1988;
Richards, Fundamentals of Radar Signal Processing, 2014, chapter 6]. A tapered window or a padded
FFT correlates the noise of neighbouring bins. The level then comes from fewer independent cells,
and false alarms are more frequent than by design (numbers in docs/detectors.md).

The same formulas give the probability of detection of a signal that fluctuates like speckle
(Swerling 1). Let snr be the ratio of its mean power to the noise power. A cell with the signal
exceeds its threshold as often as a cell of noise would with the factor divided by 1 + snr.

Training cells wrap around. In a real record's spectrum, cells below DC are those below Nyquist, and
vice versa; in a complex record's spectrum, the cells after its last bin are its first.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import gammaln

from sweep.model.window import Window, window_samples

FIXED_THRESHOLD_KIND = "fixed"
CA_CFAR, OS_CFAR, GOCA_CFAR = "ca_cfar", "os_cfar", "goca_cfar"


@lru_cache(maxsize=8)
def cached_window_samples(window: Window) -> np.ndarray:
    """Return the samples (L,) of a window, computed once and read-only."""
    samples_of_window = window_samples(window.name, window.length)
    samples_of_window.flags.writeable = False
    return samples_of_window


@lru_cache(maxsize=8)
def main_lobe_half_width(window: Window) -> float:
    """Return the distance [bins] from the centre of |W| to its first minimum, a multiple of 1/8.

    W is the window's transform. Only minima below half of the maximum of |W| count. A bin is the
    sample rate over the number of samples in the window.
    """
    magnitude = np.abs(np.fft.rfft(cached_window_samples(window), 8 * window.length))
    is_below_half = magnitude[:-1] < 0.5 * magnitude[0]  # flattop windows have minima above it
    return float(np.argmax(is_below_half & (np.diff(magnitude) > 0))) / 8


@dataclass(frozen=True, eq=False, kw_only=True)
class SpectrumSettings:
    """Properties of spectra, and settings of the detector that is applied to them."""

    fft_size: int
    """FFT size N. Spectra of real records have the bins 0..N/2, of complex ones -N/2..N/2 - 1."""
    sample_rate: float
    """Sample rate [Hz]; a bin is ``sample_rate / fft_size`` wide."""
    window: Window
    """Window of the record. Window and record have L <= N samples; the record is zero-padded to
    N."""
    noise_power: float
    """Mean power |X|^2 of a bin of noise alone [V^2], from the receiver's noise sources."""
    threshold: float
    """Fixed threshold on |X| [V]."""
    training: int
    """Number of training cells (bins from which a CFAR detector estimates the noise level). The
    number is even; half of the cells lie on either side of the tested bin."""
    guard: int
    """Number of guard cells (bins left out next to the tested bin) on either side."""
    rank: int
    """Rank k: ``os_cfar`` takes the power of the k-th weakest training cell as the noise level."""
    pfa: float
    """Design probability of a false alarm in a bin of noise alone."""
    complex_record: bool = False
    """True for complex records (I and Q). Bin k of their spectra has the index k + fft_size/2."""

    @property
    def taper(self) -> np.ndarray:
        """Samples (L,) of the window."""
        return cached_window_samples(self.window)


Detector = Callable[[np.ndarray, SpectrumSettings], np.ndarray]
"""Function that marks the detected bins of m spectra. The arguments are the power |X|^2 and the
settings. The power is (m, N/2 + 1) for real and (m, N) for complex records, with the FFT size N.
The result is a bool array of the same shape, True in detected bins."""


def cfar_crossing_probability(kind: str, factor: float, *, training: int, rank: int) -> float:
    """Return the probability that a cell of exponentially distributed power exceeds its threshold.

    Parameters
    ----------
    kind : str
        CFAR detector: ``ca_cfar``, ``goca_cfar`` or ``os_cfar``.
    factor : float
        Threshold over the noise level estimated from the training cells. For a cell whose mean
        power is 1 + snr times that of the training cells, pass the factor divided by 1 + snr.
    training : int
        Number of training cells, even.
    rank : int
        Rank of the training cell that gives the noise level, 1 (weakest) .. training; used by
        ``os_cfar``.

    Returns
    -------
    float
        Probability, 0..1.
    """
    if kind == CA_CFAR:
        return float((1 + factor / training) ** -training)
    if kind == OS_CFAR:
        # prod_{i < rank} (N - i) / (N - i + factor)
        upper_argument, lower_argument = training + 1, training - rank + 1
        log_probability = (gammaln(upper_argument) - gammaln(lower_argument)) - (
            gammaln(upper_argument + factor) - gammaln(lower_argument + factor)
        )
        return float(np.exp(log_probability))
    half_cells = training // 2
    factor_per_cell = factor / half_cells
    k = np.arange(half_cells)
    terms = (
        gammaln(half_cells + k)
        - gammaln(half_cells)
        - gammaln(k + 1)
        - (half_cells + k) * np.log(2 + factor_per_cell)
    )
    return float(2 * ((1 + factor_per_cell) ** -half_cells - np.exp(terms).sum()))


def cfar_factor(kind: str, *, training: int, rank: int, pfa: float) -> float:
    """Return the threshold factor for a design probability of a false alarm in a bin.

    Parameters
    ----------
    kind, training, rank
        As in :func:`cfar_crossing_probability`.
    pfa : float
        Probability of a false alarm in a bin of noise alone.

    Returns
    -------
    float
        Threshold over the noise level estimated from the training cells.
    """
    from scipy.optimize import brentq  # slow to import, and used by CFAR detectors only

    if kind == CA_CFAR:
        return training * math.expm1(-math.log(pfa) / training)

    def log_pfa_excess(log_factor: float) -> float:
        """Return ln of the false-alarm probability at a factor, minus ln of the design value."""
        probability = cfar_crossing_probability(
            kind, math.exp(log_factor), training=training, rank=rank
        )
        return math.log(max(probability, 1e-300)) - math.log(pfa)

    log_factor_max = 0.0
    while log_pfa_excess(log_factor_max) > 0:
        log_factor_max += 1.0
    return math.exp(brentq(log_pfa_excess, -60.0, log_factor_max, xtol=1e-14, rtol=1e-14))


def exceeds_fixed_threshold(power: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Detect bins at or above the fixed threshold; a :data:`Detector`.

    Parameters
    ----------
    power : ndarray (m, bins)
        |X|^2 [V^2] of m spectra. Bins are 0 .. N/2 for real and -N/2 .. N/2 - 1 for complex
        records, with the FFT size N.
    settings : SpectrumSettings
        Threshold on |X| [V].

    Returns
    -------
    ndarray (m, bins) bool
        True in bins whose |X|^2 is at least the squared threshold.
    """
    return power >= settings.threshold**2


def ca_cfar(power: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Detect bins by cell averaging: the threshold follows from the mean of all training cells.

    This is a :data:`Detector`.

    Parameters
    ----------
    power : ndarray (m, bins)
        |X|^2 [V^2] of m spectra. Bins are 0 .. N/2 for real and -N/2 .. N/2 - 1 for complex
        records, with the FFT size N.
    settings : SpectrumSettings
        Number M of training cells, guard cells, and design probability of a false alarm.

    Returns
    -------
    ndarray (m, bins) bool
        True in detected bins. Bins at DC and Nyquist of a real record are False.

    Notes
    -----
    A bin is detected if |X|^2 >= alpha / M times the sum of the training cells' powers [Finn and
    Johnson, RCA Review 29, 414, 1968]. alpha is the factor of :func:`cfar_factor`.
    """
    below, above = _training_power_sums(power, settings)
    return _exceeds_cfar_threshold(
        power, (below + above) / (settings.training // 2 * 2), CA_CFAR, settings
    )


def goca_cfar(power: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Detect bins by the larger of two noise levels, one from each side of the bin.

    This is a :data:`Detector`.

    Parameters
    ----------
    power : ndarray (m, bins)
        |X|^2 [V^2] of m spectra. Bins are 0 .. N/2 for real and -N/2 .. N/2 - 1 for complex
        records, with the FFT size N.
    settings : SpectrumSettings
        Number M of training cells, guard cells, and design probability of a false alarm.

    Returns
    -------
    ndarray (m, bins) bool
        True in detected bins. Bins at DC and Nyquist of a real record are False.

    Notes
    -----
    A bin is detected if |X|^2 >= alpha max(mean below, mean above), with the mean powers of the M/2
    training cells on either side [Hansen, IEE Conf. Radar, 325, 1973]. alpha is the factor of
    :func:`cfar_factor`.
    """
    level = np.maximum(*_training_power_sums(power, settings)) / (settings.training // 2)
    return _exceeds_cfar_threshold(power, level, GOCA_CFAR, settings)


def os_cfar(power: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Detect bins by the power of the training cell of a given rank; a :data:`Detector`.

    Parameters
    ----------
    power : ndarray (m, bins)
        |X|^2 [V^2] of m spectra. Bins are 0 .. N/2 for real and -N/2 .. N/2 - 1 for complex
        records, with the FFT size N.
    settings : SpectrumSettings
        Number of training cells, guard cells, rank, and design probability of a false alarm.

    Returns
    -------
    ndarray (m, bins) bool
        True in detected bins. Bins at DC and Nyquist of a real record are False.

    Notes
    -----
    A bin is detected if |X|^2 >= alpha P_k, with the power P_k of the k-th weakest training cell
    and the factor alpha of :func:`cfar_factor` [Rohling, IEEE Trans. Aerosp. Electron. Syst. 19,
    608, 1983]. Without sorting: a bin is detected if at least k training cells have at most the
    power |X|^2 / alpha. The rank k is ``settings.rank``.
    """
    circular_bins = _power_in_circular_bins(power, settings)
    level_max, n_below = (
        circular_bins / _cfar_factor_of_settings(OS_CFAR, settings),
        np.zeros(circular_bins.shape, np.int64),
    )
    for below, above in _iter_training_cell_pairs(power, settings):
        n_below += below <= level_max
        n_below += above <= level_max
    return _pad_to_all_bins(n_below >= settings.rank, settings)


DETECTORS: dict[str, Detector] = {
    FIXED_THRESHOLD_KIND: exceeds_fixed_threshold,
    CA_CFAR: ca_cfar,
    OS_CFAR: os_cfar,
    GOCA_CFAR: goca_cfar,
}


def _cfar_factor_of_settings(kind: str, settings: SpectrumSettings) -> float:
    """Return the threshold over the estimated noise level of a CFAR detector with these settings.

    ``kind`` is a name of :data:`DETECTORS`, such as ``ca_cfar``.
    """
    return cfar_factor(kind, training=settings.training, rank=settings.rank, pfa=settings.pfa)


def _power_in_circular_bins(power: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Return the columns of ``power`` without DC and Nyquist of a real record."""
    return power if settings.complex_record else power[:, 1:-1]


def _pad_to_all_bins(flags: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Return ``flags`` with columns of False added for DC and Nyquist of a real record."""
    return flags if settings.complex_record else np.pad(flags, ((0, 0), (1, 1)))


def _iter_training_cell_pairs(
    power: np.ndarray, settings: SpectrumSettings
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield pairs of arrays: power of one training cell below each bin, and of one above it.

    There is a pair for each training cell of one side. Both arrays have the shape of ``power``
    without the columns of DC and Nyquist of real records. Cells wrap around the ends of the
    spectrum.
    """
    circular_bins, half_cells = _power_in_circular_bins(power, settings), settings.training // 2
    n_bins, reach_cells = circular_bins.shape[1], half_cells + settings.guard
    circular_bins = circular_bins[:, np.arange(-reach_cells, n_bins + reach_cells) % n_bins]
    for i in range(half_cells):
        above_begin = reach_cells + settings.guard + 1 + i
        yield circular_bins[:, i : i + n_bins], circular_bins[:, above_begin : above_begin + n_bins]


def _training_power_sums(
    power: np.ndarray, settings: SpectrumSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Return two arrays: summed power of the training cells below each bin, and above it."""
    below, above = np.zeros((2, *_power_in_circular_bins(power, settings).shape))
    for cells_below, cells_above in _iter_training_cell_pairs(power, settings):
        below += cells_below
        above += cells_above
    return below, above


def _exceeds_cfar_threshold(
    power: np.ndarray, level: np.ndarray, kind: str, settings: SpectrumSettings
) -> np.ndarray:
    """Return a bool array, True in bins whose power is at least the CFAR factor times ``level``."""
    return _pad_to_all_bins(
        _power_in_circular_bins(power, settings)
        >= _cfar_factor_of_settings(kind, settings) * level,
        settings,
    )
