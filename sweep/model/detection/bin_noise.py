"""Noise of a segment's bins: its correlation between neighbours, and alarms in any of many bins.

The bins' noise is the transform of white noise times the window w. W2 is the transform of w^2. Two
bins at a distance y have the correlation W2(y) / W2(0). The unit of y is fs/L, the sample rate over
the number of samples in the record. False alarms of n adjacent bins are treated as a first-order
Markov chain. Let a bin cross a threshold of b sigma with the probability p, sigma being the noise
per quadrature. Then

    P(none) = (1 - p) (1 - h)^(n - 1),    h = (p - p11) / (1 - p).

Here h is the probability that a bin crosses after one that does not. Two neighbours both cross with
the probability p11, the joint tail of two Rayleigh magnitudes [Simon and Alouini, Digital
Communication over Fading Channels, 6.1.2]. With rho = |W2/W2(0)| of neighbours and Marcum's Q_1

    p - p11 = p (Q_1(s b, s rho b) - Q_1(s rho b, s b)),    s^2 = 1 / (1 - rho^2).

The noise of a real record is real at DC and Nyquist and nearly real next to them. It raises alarms
far more often there. Bins whose noise is not circular are not searched for alarms.

n bins thus raise alarms as often as 1 + (n - 1) ln(1 - h) / ln(1 - p) independent bins. The
formulas for independent bins apply to this number. The threshold-to-noise ratio is the threshold
over the standard deviation of |X| in noise alone. At a ratio of 6 the result is within 2 % of
simulated noise for rectangular, Hamming, Hann and Blackman windows. It is within 3 % for flattop,
and for Hann in a record padded to four times its length.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.detection.looks import SINGLE_LOOK, Looks
from sweep.model.shot_settings import RecordSettings
from sweep.model.spectrum.search_band import SearchBand, n_alarm_bins
from sweep.model.window import Window, centred_transform, window_samples

CIRCULAR_PSEUDO_VARIANCE_RATIO_MAX = 0.01
"""Largest pseudo-variance ratio at which a bin's noise counts as circular. The ratio is (v1 - v2) /
(v1 + v2), with the larger variance v1 and the smaller variance v2 of the two quadratures."""


@lru_cache(maxsize=64)
def neighbour_noise_correlation(window: Window, fft_size: int) -> float:
    """Return the modulus of the noise correlation of adjacent bins of the FFT, 0..1.

    Parameters
    ----------
    window : Window
        Window of the record, of L samples (:class:`sweep.model.window.Window`).
    fft_size : int
        FFT size N >= L.

    Returns
    -------
    float
        rho = |W2(L/N)| / W2(0), with the transform W2 of the squared window. The argument of W2 is
        a frequency over the sample rate divided by L; L/N is one bin of the FFT.
    """
    return float(_noise_correlations_at(window, fft_size, np.array([1]))[0])


@lru_cache(maxsize=64)
def first_circular_bin(window: Window, fft_size: int) -> int:
    """Return the least distance [bins] from DC and Nyquist at which noise counts as circular; >= 1.

    Parameters
    ----------
    window : Window
        Window of the record, of L samples (:class:`sweep.model.window.Window`).
    fft_size : int
        FFT size N >= L.

    Returns
    -------
    int
        Distance [bins of the FFT] from the nearer of DC and Nyquist.

    Notes
    -----
    Circular noise has equal variances in both quadratures. In a real record, the noise k bins from
    DC or Nyquist has the variances sigma^2 (1 +- |W2(2k)| / W2(0)), with their mean sigma^2 and the
    transform W2 of the squared window. The noise counts as circular if the ratio is at most
    :data:`CIRCULAR_PSEUDO_VARIANCE_RATIO_MAX` in this bin and in all bins farther away. Distances
    below 8 N/L bins are tested. For N >= 32 L only every floor(N / (16 L))-th of them is tested.
    """
    padding_factor = fft_size / window.length
    step = max(int(padding_factor / 16), 1)
    bins = np.arange(1, math.ceil(8 * padding_factor), step)
    is_circular = (
        _noise_correlations_at(window, fft_size, 2 * bins) <= CIRCULAR_PSEUDO_VARIANCE_RATIO_MAX
    )
    return int(np.max(bins[~is_circular], initial=0)) + 1


def _noise_correlations_at(window: Window, fft_size: int, bin_distances: np.ndarray) -> np.ndarray:
    """Return the modulus of the noise correlation of two bins at given distances, (n,), 0..1.

    ``bin_distances`` (n,) are in bins of the FFT of ``fft_size`` samples.
    """
    frequencies = np.append(0.0, bin_distances * (window.length / fft_size))
    transform = np.abs(centred_transform(window, frequencies, squared=True))
    correlations = transform[1:] / transform[0]
    # Bins of an unpadded rectangular window are uncorrelated except for rounding.
    return np.where(correlations > 1e-12, correlations, 0.0)


def n_alarm_equivalent_bins(
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
        Number of looks (records of each segment) and how they are combined.
    """
    n_bins = np.asarray(n_bins, float)
    equivalent_per_bin = _equivalent_bins_per_bin(
        np.asarray(threshold_ratio, float), correlation, looks
    )
    return np.where(n_bins > 0, 1 + (n_bins - 1) * equivalent_per_bin, 0.0)


def _equivalent_bins_per_bin(
    threshold_ratio: np.ndarray, correlation: float, looks: Looks
) -> np.ndarray:
    """Return the number of independent bins, 0..1, that raise alarms as often as one more bin does.

    The added bin is adjacent to those already counted. The number is ln(1 - h) / ln(1 - p), by
    ``threshold_ratio``. A bin crosses with the probability p, and a bin whose neighbour does not
    cross with the probability h.
    """
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


class SearchedBins(NamedTuple):
    """Bins in which noise may raise false alarms, and the correlation of their noise.

    The threshold (:mod:`sweep.model.threshold`) is set for these bins, and prepared shots count
    false alarms in the same bins.
    """

    n_bins: float | np.ndarray
    """Number of bins. Without a search band it is one number for all segments and points. With a
    search band it is an array (3, n) for the segments up, Doppler, down of n points, or (n,) after
    :meth:`select_segment`."""
    first_bin: int
    """Distance of the first searched bin from DC and from Nyquist [bins]. The distance is above 1
    in a real record whose noise is correlated, since the noise of bins nearer to DC and Nyquist is
    not circular."""
    neighbour_noise_correlation: float
    """Correlation coefficient of the noise of adjacent bins, 0..1; 0 if bins count as
    independent."""
    includes_echo: bool
    """True if noise may raise false alarms in the bins of a detected echo as well, as in [T]."""

    @classmethod
    def from_record(
        cls,
        record: RecordSettings,
        *,
        noise_bins: str,
        bins_counted: str,
        search_band: SearchBand | None,
    ) -> "SearchedBins":
        """Return the searched bins of a record's spectra.

        Parameters
        ----------
        record : RecordSettings
            Window, FFT size and kind of the samples.
        noise_bins : str
            ``correlated``, the noise of adjacent bins in a record, or ``independent``.
        bins_counted : str
            ``half``, the bins of a real spectrum, or ``all`` N bins of the FFT. A search band has
            its own bins in either case.
        search_band : SearchBand or None
            Searched bins of each segment; None if all bins are searched.

        Examples
        --------
        >>> from sweep.model.window import get_window
        >>> record = RecordSettings(
        ...     window=get_window("rectangular", 1024), fft_size=1024, sample_rate=np.array(1e8),
        ...     acquisition_delay=np.array(0.0), is_complex=False,
        ... )
        >>> bins = SearchedBins.from_record(
        ...     record, noise_bins="correlated", bins_counted="half", search_band=None
        ... )
        >>> bins.n_bins, bins.first_bin
        (511.0, 1)
        """
        is_correlated, fft_size = noise_bins == "correlated", record.fft_size
        has_real_ends = is_correlated and not record.is_complex
        first_bin = first_circular_bin(record.window, fft_size) if has_real_ends else 1
        n_bins: float | np.ndarray
        if search_band is not None:
            n_bins = n_alarm_bins(search_band, fft_size, first_bin)
        elif record.is_complex or bins_counted == "all":
            n_bins = float(fft_size)
        elif has_real_ends:
            n_bins = max(fft_size // 2 + 1.0 - 2 * first_bin, 0.0)
        else:
            n_bins = float(fft_size // 2)
        return cls(
            n_bins=n_bins,
            first_bin=first_bin,
            neighbour_noise_correlation=(
                neighbour_noise_correlation(record.window, fft_size) if is_correlated else 0.0
            ),
            includes_echo=bins_counted == "all" and search_band is None,
        )

    def select_segment(self, segment: int) -> "SearchedBins":
        """Return the searched bins of one segment: 0 up, 1 Doppler, 2 down."""
        if not np.ndim(self.n_bins):
            return self
        return self._replace(n_bins=np.asarray(self.n_bins)[segment])

    def select_points(self, point_indices: np.ndarray | slice) -> "SearchedBins":
        """Return the searched bins of the points at the given indices (m,) or slice."""
        if not np.ndim(self.n_bins):
            return self
        return self._replace(n_bins=np.asarray(self.n_bins)[:, point_indices])

    def n_bins_outside_echo(self, n_exempt: np.ndarray) -> np.ndarray:
        """Return the number of bins outside a detected echo in which noise may raise false alarms.

        Parameters
        ----------
        n_exempt : ndarray (3, n)
            Number of bins of the detected echo, by segment.

        Returns
        -------
        ndarray (3, n)
            Number of bins outside the echo, 0 or more; all bins if :attr:`includes_echo`.
        """
        if self.includes_echo:
            return np.full(np.shape(n_exempt), self.n_bins)
        return np.asarray(np.maximum(self.n_bins - n_exempt, 0.0))

    def n_alarm_equivalent_bins(self, threshold_ratio: ArrayLike, looks: Looks) -> np.ndarray:
        """Return the number of independent bins that raise a false alarm as often as these bins.

        Parameters
        ----------
        threshold_ratio : ndarray
            Threshold over sigma, the noise of a bin per quadrature.
        looks : Looks
            Number of looks (records of each segment) and how they are combined.
        """
        return n_alarm_equivalent_bins(
            self.n_bins,
            threshold_ratio=threshold_ratio,
            correlation=self.neighbour_noise_correlation,
            looks=looks,
        )


N_NOISE_FILTER_TAPS = 17
"""Number of independent normal numbers whose weighted sum is the simulated noise of a bin."""


@lru_cache(maxsize=16)
def noise_filter(window: Window, fft_size: int, n_bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of independent normal numbers whose sums are the noise of adjacent bins.

    Parameters
    ----------
    window, fft_size
        Window of L samples, and FFT size N.
    n_bins
        Number of adjacent bins.

    Returns
    -------
    weights
        (n_bins, N_NOISE_FILTER_TAPS): row k weights successive normal numbers; their weighted sum
        is the noise of bin k. The squares of a row have the sum 1.
    first_number_index
        (n_bins,): index of the normal number to which the first weight of each row applies.

    Notes
    -----
    The unit of frequency is fs/L, the sample rate over the number of samples in the window. The
    noise of a bin at the frequency y is sum_j W(y - j) z_j, with one normal number z_j per unit of
    frequency. W is the window's transform, which is real about the middle of the record.
    """
    filter_length = min(window.length, 512) // 2 * 2
    window_values = window_samples(window.name, max(filter_length, 1))
    position = np.arange(n_bins) * (window.length / fft_size)
    first_number_index = np.rint(position).astype(np.int64) - N_NOISE_FILTER_TAPS // 2
    offset, offset_index = np.unique(
        np.round(position - first_number_index, 9), return_inverse=True
    )
    record_position = (np.arange(window_values.size) - window_values.size // 2) / window_values.size
    cycles = (offset[:, None] - np.arange(N_NOISE_FILTER_TAPS))[..., None] * record_position
    weights = (np.cos(2 * np.pi * cycles) * window_values).sum(axis=-1)
    weights /= np.sqrt((weights**2).sum(axis=1, keepdims=True))
    return weights[offset_index.ravel()], first_number_index
