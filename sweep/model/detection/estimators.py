"""Estimators of a peak's frequency from the complex spectrum around it, and bounds of their error.

All take spectra of windowed records and return positions as fractional indices. In a real record
these are frequencies in bins. In a complex record N/2 is added, and the last bin is a neighbour of
the first. What an estimator needs to know of the window follows from the window's samples, so that
any window and any padding is supported. Z_j are the bins about the peak without the linear phase of
half a record per bin; those of a single tone are then real and even in the distance from the tone:

- ``peak_bin``: the strongest bin, with an error of up to half a bin.
- ``parabolic``, ``parabolic_log``: the vertex of a parabola through three magnitudes, or through
  their logarithms [Smith and Serra, PARSHL, 1987]; biased between bins.
- ``jacobsen``: Q Re[(Z_+ - Z_-) / (2 Z_0 - Z_- - Z_+)] for tapered windows, and
  Re[(Z_+ - Z_-) / (2 Z_0 + Z_- + Z_+)] where the neighbours of a tone on a bin vanish [Jacobsen and
  Kootsookos, IEEE Signal Process. Mag. 24(3), 123, 2007]. Z_0 is the peak bin, Z_- and Z_+ are its
  neighbours. Q is the window's factor, by least squares over half a bin (equal to the published
  table to its digits); biased between bins.
- ``candan``: the second form for every window, without its bias. Candan's factor [IEEE Signal
  Process. Lett. 18, 351, 2011, and 20, 913, 2013; Signal Process. 114, 245, 2015, for windows] is
  the slope at the bin; here the whole curve is inverted.
- ``centroid``: centre of the power minus the mean noise power, within two resolution cells; biased
  by the remaining noise.
- ``chirp_z``: the maximum of the windowed record's spectrum on a grid of 1/32 bin, by a chirp-z
  transform [Rabiner, Schafer and Rader, Bell Syst. Tech. J. 48, 1249, 1969], refined by a parabola;
  it reaches :func:`windowed_peak_frequency_deviation`.
- ``maximum_likelihood``: the record is divided by the window, and Newton's method finds the maximum
  of the unwindowed spectrum. This is repeated without the tone's image at negative frequency. For a
  single tone in white noise this is the maximum-likelihood estimate [Rife and Boorstyn, IEEE Trans.
  Inf. Theory 20, 591, 1974], which reaches the Cramer-Rao bound.

The Cramer-Rao bound is the least error of any unbiased estimate of a beat, a range or a velocity.
Consider a tone A cos(2 pi f n / fs + phi) in L samples with white Gaussian noise of variance s^2,
where A, f and phi are unknown. With cnr = A^2 / (2 s^2), the tone's power over the noise power
before the FFT,

    var(f) >= 12 / (cnr L (L^2 - 1)) (fs / 2 pi)^2

[Rife and Boorstyn, IEEE Trans. Inf. Theory 20, 591, 1974; Kay, Fundamentals of Statistical Signal
Processing: Estimation Theory, 1993, section 3.11]. This holds for a tone some bins away from DC and
Nyquist, where the bound does not depend on its phase. For a complex tone, with cnr its power over
the noise power of I and Q together, the variance is half of that. The bound is that of the whole
record. A window attenuates samples, so the maximum of a windowed spectrum has a larger error
(:func:`windowed_peak_frequency_deviation`), unless the window is undone first.

Three segments determine two unknowns: the Fisher information of independent beats adds, weighted
with the derivatives of each beat by range and velocity (:mod:`sweep.model.waveform`). Only the
frequency of a segment's beat is used, as its phase, 4 pi R / lambda, is known modulo 2 pi.

Below some SNR estimates are biased, and the bound does not apply: noise elsewhere in the spectrum
is mistaken for the tone (the threshold effect).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.detectors import (
    FIXED_THRESHOLD_KIND,
    SpectrumSettings,
    cached_window_samples,
)
from sweep.model.waveform import DEFAULT_CHIRP_RATE_RATIOS
from sweep.model.window import Window

Estimator = Callable[[np.ndarray, np.ndarray, SpectrumSettings], np.ndarray]
"""Function that estimates the frequencies (m,) [bins] of the peaks of m complex spectra.

The arguments are the spectra, the indices (m,) int64 of their peak bins, and the settings. With the
FFT size N, spectra are (m, N/2 + 1) for real and (m, N) for complex records. Peak indices are
1..N/2 - 1 for real and 0..N - 1 for complex records."""

PEAK_BIN = "peak_bin"
"""Name of the estimator that returns the frequency of the strongest bin."""

DETECTOR_PREFIX, ESTIMATOR_PREFIX = (
    "instrument.processing.detector.",
    "instrument.processing.estimator.",
)
SPECTRUM_METHOD_DEFAULTS: dict[str, float | int | str] = {
    DETECTOR_PREFIX + "kind": FIXED_THRESHOLD_KIND,
    DETECTOR_PREFIX + "training": 32,
    DETECTOR_PREFIX + "guard": 4,
    DETECTOR_PREFIX + "rank": 0,
    DETECTOR_PREFIX + "pfa": 1e-6,
    ESTIMATOR_PREFIX + "kind": PEAK_BIN,
}
"""Default parameters, by dotted path, of detector and estimator in full spectra."""

_TONE_STEPS_PER_BIN = 512
"""Number of steps per bin in tables over the offset, -1..1 bin, of a tone from a bin."""
_NEIGHBOUR_MAGNITUDE_RATIO_MIN = 0.25
"""Ratio below which the two neighbours of a bin on which a tone lies count as 0: |X| of a neighbour
over |X| of that bin."""
_CENTROID_REACH_CELLS = 2
"""Number of resolution cells on either side of the peak over which the centroid is taken. A cell is
the sample rate over the number of samples in the record."""
_ZOOM_POINTS_PER_BIN = 32
"""Number of frequencies per FFT bin at which the chirp-z transform is evaluated."""
_WINDOW_VALUE_FRACTION_MIN = 1e-3
"""Smallest window value, over the window's maximum, by which a sample is divided to undo the
window. Samples with a smaller window value are left out."""
_NEWTON_STEPS_MAX = 6
"""Largest number of steps of Newton's method in the maximum-likelihood estimate."""
_NEWTON_REACH_BINS = 0.5
"""Largest distance [FFT bins] of the result of Newton's method from its starting frequency."""


def peak_bin(spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Return the index of the peak bin; an :data:`Estimator`.

    Parameters
    ----------
    spectrum : ndarray (m, bins) complex
        Spectra without or with noise [V]. Bins are 0 .. N/2 for real and -N/2 .. N/2 - 1 for
        complex records, with the FFT size N.
    peak : ndarray (m,) int64
        Index of the peak's bin in each spectrum.
    settings : SpectrumSettings
        Not used.

    Returns
    -------
    ndarray (m,)
        Frequency of each peak, as a fractional index [bins].
    """
    return peak.astype(float)


def parabolic(spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Return the vertex of the parabola through three magnitudes; an :data:`Estimator`.

    Parameters
    ----------
    spectrum : ndarray (m, bins) complex
        Spectra without or with noise [V]. Bins are 0 .. N/2 for real and -N/2 .. N/2 - 1 for
        complex records, with the FFT size N.
    peak : ndarray (m,) int64
        Index of the peak's bin in each spectrum.
    settings : SpectrumSettings
        Not used.

    Returns
    -------
    ndarray (m,)
        Frequency of each peak, as a fractional index [bins].

    Notes
    -----
    With the magnitudes a, b and c of the bins below, at and above the peak, the vertex lies (a - c)
    / (2 (a - 2 b + c)) bins above it.
    """
    return peak + _parabola_vertex(np.abs(_three_bins(spectrum, peak)))


def parabolic_log(spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Return the vertex of the parabola through three log magnitudes; an :data:`Estimator`.

    Parameters
    ----------
    spectrum : ndarray (m, bins) complex
        Spectra without or with noise [V]. Bins are 0 .. N/2 for real and -N/2 .. N/2 - 1 for
        complex records, with the FFT size N.
    peak : ndarray (m,) int64
        Index of the peak's bin in each spectrum.
    settings : SpectrumSettings
        Not used.

    Returns
    -------
    ndarray (m,)
        Frequency of each peak, as a fractional index [bins].

    Notes
    -----
    The parabola of :func:`parabolic`, through ln |X|. It is exact for a Gaussian line [Smith and
    Serra, PARSHL, 1987].
    """
    with np.errstate(divide="ignore"):
        return peak + _parabola_vertex(np.log(np.abs(_three_bins(spectrum, peak))))


def jacobsen(spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Return the peak bin plus Jacobsen's ratio of three bins times a factor; an :data:`Estimator`.

    Parameters
    ----------
    spectrum : ndarray (m, bins) complex
        Spectra without or with noise [V]. Bins are 0 .. N/2 for real and -N/2 .. N/2 - 1 for
        complex records, with the FFT size N.
    peak : ndarray (m,) int64
        Index of the peak's bin in each spectrum.
    settings : SpectrumSettings
        Window and FFT size, on which the sign in the ratio and the factor depend.

    Returns
    -------
    ndarray (m,)
        Frequency of each peak, as a fractional index [bins].

    Notes
    -----
    Both forms of the ratio are in the description of this module [Jacobsen and Kootsookos, IEEE
    Signal Process. Mag. 24(3), 123, 2007].
    """
    sign, factor = jacobsen_coefficients(settings.window, settings.fft_size)
    return peak + factor * _jacobsen_ratio(
        _three_bins_with_centred_phase(spectrum, peak, settings), sign
    )


def candan(spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Return the frequency of the tone with the peak's Jacobsen ratio; an :data:`Estimator`.

    Parameters
    ----------
    spectrum : ndarray (m, bins) complex
        Spectra without or with noise [V]. Bins are 0 .. N/2 for real and -N/2 .. N/2 - 1 for
        complex records, with the FFT size N.
    peak : ndarray (m,) int64
        Index of the peak's bin in each spectrum.
    settings : SpectrumSettings
        Window and FFT size, for which the ratio is tabulated.

    Returns
    -------
    ndarray (m,)
        Frequency of each peak, as a fractional index [bins].

    Notes
    -----
    Jacobsen's ratio of three complex bins is tabulated for single tones in this window, and the
    table is inverted, so that the estimate has no bias. The published factor [Candan, IEEE Signal
    Process. Lett. 18, 351, 2011] is the slope of that curve at the bin.
    """
    offset, tone_bins = _tone_offsets_and_bins(settings.window, settings.fft_size)
    tone_ratios = np.maximum.accumulate(_jacobsen_ratio(tone_bins, 1))
    return peak + np.interp(
        _jacobsen_ratio(_three_bins_with_centred_phase(spectrum, peak, settings), 1),
        tone_ratios,
        offset,
    )


def centroid(spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Return the centroid of the power around the peak; an :data:`Estimator`.

    Parameters
    ----------
    spectrum : ndarray (m, bins) complex
        Spectra without or with noise [V]. Bins are 0 .. N/2 for real and -N/2 .. N/2 - 1 for
        complex records, with the FFT size N.
    peak : ndarray (m,) int64
        Index of the peak's bin in each spectrum.
    settings : SpectrumSettings
        Window and FFT size, which set the reach, and the mean noise power of a bin.

    Returns
    -------
    ndarray (m,)
        Frequency of each peak, as a fractional index [bins].

    Notes
    -----
    sum_k k w_k / sum_k w_k over the bins within two resolution cells, with w_k = max(|X_k|^2 - P,
    0) and the mean noise power P. The peak bin has at least the weight P.
    """
    reach_bins = math.ceil(_CENTROID_REACH_CELLS * settings.fft_size / settings.window.length)
    distance = np.arange(-reach_bins, reach_bins + 1)
    bins = peak[:, None] + distance
    if not settings.complex_record:
        bins = np.clip(bins, 0, settings.fft_size // 2)
    values = np.take_along_axis(spectrum, bins % spectrum.shape[1], axis=1)
    power = np.abs(values) ** 2 - settings.noise_power
    weight = np.where(
        distance == 0, np.maximum(power, settings.noise_power), np.maximum(power, 0.0)
    )
    return peak + (weight * (bins - peak[:, None])).sum(axis=1) / weight.sum(axis=1)


def chirp_z(spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Return the maximum of a finely sampled spectrum around the peak; an :data:`Estimator`.

    Parameters
    ----------
    spectrum : ndarray (m, bins) complex
        Spectra without or with noise [V]. Bins are 0 .. N/2 for real and -N/2 .. N/2 - 1 for
        complex records, with the FFT size N.
    peak : ndarray (m,) int64
        Index of the peak's bin in each spectrum.
    settings : SpectrumSettings
        Window, FFT size and kind of the record.

    Returns
    -------
    ndarray (m,)
        Frequency of each peak, as a fractional index [bins].

    Notes
    -----
    A chirp-z transform samples each spectrum at every 1/32 bin around its peak [Rabiner, Schafer
    and Rader, Bell Syst. Tech. J. 48, 1249, 1969]. A parabola refines the maximum.
    """
    zoom, positions = (
        _make_zoom_transform(settings.window.length, settings.fft_size),
        np.empty(peak.size),
    )
    zoom_grid = np.arange(2 * _ZOOM_POINTS_PER_BIN + 1)
    for row, bin_ in enumerate(peak):  # one by one: bits must not depend on other rows
        magnitude = np.abs(
            zoom(
                _shift_bin_to_zero(
                    _record_from_spectrum(spectrum[row], settings), int(bin_), settings
                )
            )
        )
        maximum_index = int(np.clip(np.argmax(magnitude), 1, zoom_grid[-2]))
        vertex = _parabola_vertex(magnitude[None, maximum_index - 1 : maximum_index + 2])[0]
        positions[row] = bin_ + (maximum_index + vertex) / _ZOOM_POINTS_PER_BIN - 1.0
    return positions


def maximum_likelihood(
    spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings
) -> np.ndarray:
    """Return the maximum-likelihood frequency of a tone in white noise; an :data:`Estimator`.

    Parameters
    ----------
    spectrum : ndarray (m, bins) complex
        Spectra without or with noise [V]. Bins are 0 .. N/2 for real and -N/2 .. N/2 - 1 for
        complex records, with the FFT size N.
    peak : ndarray (m,) int64
        Index of the peak's bin in each spectrum.
    settings : SpectrumSettings
        Window, FFT size and kind of the record.

    Returns
    -------
    ndarray (m,)
        Frequency of each peak, as a fractional index [bins].

    Notes
    -----
    The window is undone, except in samples where it nearly vanishes, and Newton's method finds the
    maximum of the spectrum near the estimate of :func:`candan`. For a real record this is repeated
    without the tone's image [Rife and Boorstyn, IEEE Trans. Inf. Theory 20, 591, 1974].
    """
    from sweep.model.detection.sub_bin_interpolation import complex_exponentials

    w = settings.taper
    is_used = np.abs(w) > _WINDOW_VALUE_FRACTION_MIN * np.abs(w).max()
    weight = np.where(is_used, 1.0 / np.where(is_used, w, 1.0), 0.0)
    start = candan(spectrum, peak, settings)
    fft_size, n_used, frequencies = float(settings.fft_size), float(is_used.sum()), start.copy()
    for row in range(peak.size):
        record = _record_from_spectrum(spectrum[row], settings) * weight
        frequencies[row] = _refine_peak_frequency(record, start[row], fft_size)
        if not settings.complex_record:
            tone = complex_exponentials(frequencies[row] / fft_size, record.size)
            image = ((record * tone).sum() / n_used).conjugate() * tone
            # Samples in which the window was not undone hold no tone.
            frequencies[row] = _refine_peak_frequency(
                np.where(is_used, record - image, 0.0), start[row], fft_size
            )
    return frequencies


ESTIMATORS: dict[str, Estimator] = {
    PEAK_BIN: peak_bin,
    "parabolic": parabolic,
    "parabolic_log": parabolic_log,
    "jacobsen": jacobsen,
    "candan": candan,
    "centroid": centroid,
    "chirp_z": chirp_z,
    "maximum_likelihood": maximum_likelihood,
}


def _three_bins(spectrum: np.ndarray, peak: np.ndarray) -> np.ndarray:
    """Return the complex values of the bins below, at and above each peak, (m, 3)."""
    bins = (peak[:, None] + np.array([-1, 0, 1])) % spectrum.shape[1]
    return np.take_along_axis(spectrum, bins, axis=1)


def _three_bins_with_centred_phase(
    spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings
) -> np.ndarray:
    """Return the three bins about each peak with phases relative to the record's middle, (m, 3)."""
    cycles_per_bin = 0.5 * settings.window.length / settings.fft_size
    return _three_bins(spectrum, peak) * np.exp(2j * np.pi * cycles_per_bin * np.array([-1, 0, 1]))


def _parabola_vertex(values: np.ndarray) -> np.ndarray:
    """Return the vertex, -1/2..1/2 from the middle, of parabolas through values (m, 3).

    The vertex is 0 where the parabola has no maximum.
    """
    below, middle, above = values.T
    curvature = 2 * middle - below - above
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = 0.5 * (above - below) / curvature
    return np.where(np.isfinite(vertex) & (curvature > 0), np.clip(vertex, -0.5, 0.5), 0.0)


def _jacobsen_ratio(three_bins: np.ndarray, neighbour_sign: int) -> np.ndarray:
    """Return Jacobsen's ratio Re[(Z_+ - Z_-) / (2 Z_0 +- (Z_- + Z_+))], -1..1, of bins (m, 3).

    Z_-, Z_0 and Z_+ are the complex bins below, at and above a peak. ``neighbour_sign`` is the sign
    in the denominator.
    """
    below, middle, above = three_bins.T
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = ((above - below) / (2 * middle + neighbour_sign * (below + above))).real
    return np.clip(np.nan_to_num(ratio), -1.0, 1.0)


@lru_cache(maxsize=16)
def _tone_offsets_and_bins(window: Window, fft_size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return offsets -1 .. 1 [bins] of tones from a bin, and three bins of each tone, (k, 3).

    The values are real, as their phases are relative to the record's middle.
    """
    from sweep.model.detection.sub_bin_interpolation import tone_spectrum_function

    offset = np.arange(-_TONE_STEPS_PER_BIN, _TONE_STEPS_PER_BIN + 1) / _TONE_STEPS_PER_BIN
    return offset, tone_spectrum_function(window, fft_size)(
        np.array([-1, 0, 1]) - offset[:, None]
    ).real


@lru_cache(maxsize=16)
def jacobsen_coefficients(window: Window, fft_size: int) -> tuple[int, float]:
    """Return the sign and the factor of Jacobsen's estimator for a window and an FFT size.

    Parameters
    ----------
    window : Window
        Window of the record, of L samples (:class:`sweep.model.window.Window`).
    fft_size : int
        FFT size N >= L.

    Returns
    -------
    sign : int
        Sign s of the two neighbours in the denominator of Jacobsen's ratio, -1 or 1.
    factor : float
        Offset of the tone from the peak bin over the ratio [bins].

    Notes
    -----
    The ratio is r = Re[(Z_+ - Z_-) / (2 Z_0 + s (Z_- + Z_+))], with the complex peak bin Z_0 and
    its neighbours Z_- below and Z_+ above [Jacobsen and Kootsookos, IEEE Signal Process. Mag.
    24(3), 123, 2007]. If the neighbours of a tone on a bin vanish, as for an unpadded rectangular
    window, sign and factor are 1, and r is the offset. Otherwise the sign is -1. The factor is then
    sum(r d) / sum(r^2), by least squares over tones at the offsets d in -1/2 .. 1/2 bin.
    """
    offset, tone_bins = _tone_offsets_and_bins(window, fft_size)
    _, centre, above = tone_bins[_TONE_STEPS_PER_BIN]
    if abs(above) < _NEIGHBOUR_MAGNITUDE_RATIO_MIN * centre:
        return 1, 1.0
    is_near = np.abs(offset) <= 0.5
    ratio = _jacobsen_ratio(tone_bins[is_near], -1)
    return -1, float((ratio * offset[is_near]).sum() / (ratio**2).sum())


@lru_cache(maxsize=4)
def _make_zoom_transform(length: int, fft_size: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that transforms records (m, length) to their spectra at -1 .. 1 FFT bin."""
    from scipy import signal  # slow to import

    edge = 1.0 / fft_size
    return signal.ZoomFFT(
        length, [-edge, edge], 2 * _ZOOM_POINTS_PER_BIN + 1, fs=1.0, endpoint=True
    )


def _record_from_spectrum(spectrum: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Return the windowed record (L,) of a spectrum.

    A complex record is shifted by half the sample rate, so that the frequency of a tone [bins] is
    its index in the spectrum.
    """
    if settings.complex_record:
        return np.asarray(fft.ifft(spectrum))[: settings.window.length]
    return np.asarray(fft.irfft(spectrum, settings.fft_size))[: settings.window.length]


def _shift_bin_to_zero(record: np.ndarray, bin_: int, settings: SpectrumSettings) -> np.ndarray:
    """Return a record shifted in frequency so that the bin ``bin_`` comes to frequency 0."""
    cycles = np.arange(record.size) * bin_ % settings.fft_size / settings.fft_size
    return np.asarray(record * np.exp(-2j * np.pi * cycles))


def _refine_peak_frequency(record: np.ndarray, start: float, fft_size: float) -> float:
    """Return the frequency [FFT bins] of the periodogram's maximum next to a starting frequency.

    The periodogram is |sum_n x_n e^{-2 pi i n f / N}|^2 of the record x, with the FFT size N. The
    start is returned if Newton's method does not converge near it.
    """
    from sweep.model.detection.sub_bin_interpolation import complex_exponentials

    n = np.arange(record.size) - 0.5 * (record.size - 1)
    position = start
    for _ in range(_NEWTON_STEPS_MAX):
        shifted_record = record * complex_exponentials(position / fft_size, record.size)
        s0, s1, s2 = (
            shifted_record.sum(),
            (n * shifted_record).sum(),
            (n * n * shifted_record).sum(),
        )
        # Derivatives of |s0|^2 by the phase per sample.
        slope = 2.0 * (1j * s1 * s0.conjugate()).real
        curvature = 2.0 * (abs(s1) ** 2 - (s2 * s0.conjugate()).real)
        if not curvature < 0.0:
            break
        step = slope / curvature * fft_size / (2.0 * math.pi)
        position += step
        if abs(position - start) > _NEWTON_REACH_BINS:
            return start
        if abs(step) < 1e-9:
            break
    return float(position)


class RangeVelocityDeviation(NamedTuple):
    """Least standard deviations of range and radial velocity, by the Cramer-Rao bound."""

    range: np.ndarray
    """Least standard deviation of an unbiased estimate of the range [m]."""
    radial_velocity: np.ndarray
    """Least standard deviation of an unbiased estimate of the radial velocity [m/s]."""


def carrier_to_noise_ratio(*, snr: ArrayLike, window: Window) -> np.ndarray:
    """Return the power of a tone over the noise power before the FFT, from its strongest bin's SNR.

    Parameters
    ----------
    snr
        Power of the strongest bin over the mean noise power of a bin, after the FFT.
    window
        Window of the record.

    Notes
    -----
    The tone is assumed to lie on a bin. For a tone between bins the true ratio is higher by the
    scalloping loss. For a tone of amplitude A, window w and noise s per sample, |X| = A sum(w) / 2
    on a bin, and the noise power of a bin is sum(w^2) s^2.
    """
    return np.asarray(snr, float) * 2 * window.energy / window.sum**2


def beat_frequency_cramer_rao_bound(
    *, cnr: ArrayLike, n_samples: ArrayLike, sample_rate: ArrayLike
) -> np.ndarray:
    """Return the least standard deviation of a tone's frequency [Hz], by the Cramer-Rao bound.

    Parameters
    ----------
    cnr
        Power of the tone over the noise power before the FFT; for a complex record twice that.
    n_samples
        Number of samples of the record, without padding.
    sample_rate
        Sample rate [Hz].
    """
    count = np.asarray(n_samples, float)
    with np.errstate(divide="ignore"):
        variance = 12 / (np.asarray(cnr, float) * count * (count**2 - 1))
    return np.sqrt(variance) * np.asarray(sample_rate) / (2 * math.pi)


def phase_noise_beat_deviation(
    *, line_width: ArrayLike, delay: ArrayLike, duration: ArrayLike
) -> np.ndarray:
    """Return the standard deviation of a beat's frequency [Hz] due to laser phase noise.

    Parameters
    ----------
    line_width
        FWHM dnu of the laser's Lorentzian line [Hz].
    delay
        Delay tau of the echo [s].
    duration
        Duration T of the record [s].

    Notes
    -----
    The error is the slope over 2 pi of the least-squares line through theta(t) - theta(t - tau)
    over the record. theta is a Wiener process of variance Gamma |t| = 2 pi dnu |t|. With
    r = tau / T, or 1 for longer delays,

        var(f) = 12 Gamma / T r^2 (1 - r + r^3 / 5) / (2 pi)^2

    The maximum-likelihood frequency in white noise has this error in addition to
    :func:`beat_frequency_cramer_rao_bound`. Estimates that use the correlation of the phase
    noise could be better by a few percent for short delays, and by a fifth for r = 1/3.
    """
    delay_fraction = np.minimum(np.asarray(delay, float) / duration, 1.0)
    walk_variance = 12 * np.asarray(line_width, float) / np.asarray(duration, float)
    return (
        np.sqrt(walk_variance * (1 - delay_fraction + delay_fraction**3 / 5) / (2 * math.pi))
        * delay_fraction
    )


def windowed_peak_frequency_deviation(
    *, cnr: ArrayLike, window: Window, sample_rate: ArrayLike
) -> np.ndarray:
    """Return the standard deviation [Hz] of the frequency at which a windowed |X(f)| is largest.

    Parameters
    ----------
    cnr
        Power of the tone over the noise power before the FFT.
    window
        Window w of the record.
    sample_rate
        Sample rate fs [Hz].

    Notes
    -----
    To first order in the noise, with m the number of a sample minus the centroid of the window
    [1]_,

        var(f) = sum(w^2 m^2) / (cnr sum(w m^2)^2) (fs / 2 pi)^2.

    This is the Cramer-Rao bound for the rectangular window, and larger for every other window.

    References
    ----------
    .. [1] D. C. Rife and G. A. Vincent, "Use of the discrete Fourier transform in the measurement
       of frequencies and levels of tones," Bell Syst. Tech. J. 49, 197, 1970.
    """
    w = cached_window_samples(window)
    centred_index = np.arange(window.length) - (w * np.arange(window.length)).sum() / w.sum()
    variance_factor = ((w * centred_index) ** 2).sum() / (w * centred_index**2).sum() ** 2
    with np.errstate(divide="ignore"):
        return (
            np.sqrt(variance_factor / np.asarray(cnr, float))
            * np.asarray(sample_rate)
            / (2 * math.pi)
        )


@lru_cache(maxsize=32)
def position_error_at_unit_signal(
    estimator: str, window: Window, fft_size: int
) -> np.ndarray | None:
    """Return the standard error [bins] of an estimator's position of a tone in noise, (m,).

    The error is that at |X| of the peak bin equal to the noise per quadrature. It falls as 1/|X|.

    Parameters
    ----------
    estimator
        Name of the estimator.
    window, fft_size
        Window of the record, and number of bins of its FFT.

    Returns
    -------
    numpy.ndarray or None
        The error at m evenly spaced distances, 0..1 bin, of the tone from the peak bin; m is the
        size of :attr:`.sub_bin_interpolation.Interpolator.error_at_unit_signal`. The result is None
        for estimators whose error has no known law.

    Notes
    -----
    Errors are to first order in white noise. Let rho be |X| of the peak bin over the noise per
    quadrature, W the transform of the window w at the tone's distance, and E = sum(w^2). The tone's
    power over the noise power before the FFT is then cnr = rho^2 E / W^2.

    ``maximum_likelihood`` has the Cramer-Rao bound of the samples that it uses. ``chirp_z`` has the
    error of :func:`windowed_peak_frequency_deviation`. ``candan`` uses the ratio R = Re[N / D] with
    N = Z_+ - Z_- and D = 2 Z_0 + Z_- + Z_+, where Z_-, Z_0 and Z_+ are the bins below, at and above
    the peak. Noise n_j in phase with the tone in bin j changes R by sum_j g_j n_j, with
    g_+- = +-1 / D - R / D and g_0 = -2 R / D. If C is the covariance matrix of the n_j and delta
    the tone's distance, the variance of the position is g^T C g / (dR / d delta)^2.
    """
    from sweep.model.detection.sub_bin_interpolation import (
        in_phase_noise_correlations,
        interpolator,
        tone_spectrum_function,
    )

    offset = np.linspace(0.0, 1.0, interpolator(window, fft_size).error_at_unit_signal.size)
    tone_bins = tone_spectrum_function(window, fft_size)(
        np.array([-1, 0, 1]) - offset[:, None]
    ).real
    height = np.maximum(np.abs(tone_bins[:, 1]), 1e-3 * np.abs(tone_bins[0, 1]))
    cnr = window.energy / height**2
    if estimator == "maximum_likelihood":
        w = np.abs(cached_window_samples(window))
        sample = np.flatnonzero(w > _WINDOW_VALUE_FRACTION_MIN * w.max())
        squared_length = ((sample - sample.mean()) ** 2).sum()
        return np.asarray(fft_size / (2 * math.pi) / np.sqrt(cnr * squared_length))
    if estimator == "chirp_z":
        return windowed_peak_frequency_deviation(cnr=cnr, window=window, sample_rate=fft_size)
    if estimator != "candan":
        return None
    correlation_1, correlation_2 = in_phase_noise_correlations(window, fft_size)
    covariance = np.array(
        [
            [1, correlation_1, correlation_2],
            [correlation_1, 1, correlation_1],
            [correlation_2, correlation_1, 1],
        ]
    )
    ratio = _jacobsen_ratio(tone_bins, 1)
    denominator = tone_bins @ np.array([1.0, 2.0, 1.0])
    gradient = np.stack([-1 - ratio, -2 * ratio, 1 - ratio], axis=-1) / denominator[:, None]
    slope = np.maximum(np.gradient(ratio, offset), 1e-6)
    variance = np.einsum("mi,ij,mj->m", gradient, covariance, gradient)
    return np.asarray(height * np.sqrt(np.maximum(variance, 0.0)) / slope)


def range_velocity_deviation(
    *,
    up: ArrayLike,
    doppler: ArrayLike,
    down: ArrayLike,
    carriers: tuple[ArrayLike, ArrayLike, ArrayLike],
    chirp_rate: ArrayLike,
    range: ArrayLike,
    radial_velocity: ArrayLike,
    slopes: Sequence[ArrayLike] = DEFAULT_CHIRP_RATE_RATIOS,
) -> RangeVelocityDeviation:
    """Return the least standard deviations of range and radial velocity from those of the beats.

    Parameters
    ----------
    up, doppler, down
        Standard deviation of each segment's beat frequency [Hz]; inf if the beat is not used.
        :func:`sweep.model.waveform.resolve_range_velocity` uses the Doppler beat only to resolve an
        ambiguity; for its bound pass ``doppler=np.inf``.
    carriers
        Carrier frequency of each segment [Hz].
    chirp_rate
        Chirp rate [Hz/s].
    range, radial_velocity
        Range [m] and radial velocity [m/s].
    slopes
        Signed chirp rate of each segment over `chirp_rate`.

    Returns
    -------
    RangeVelocityDeviation
        Both least standard deviations; inf where the used beats do not determine range and
        velocity.
    """
    two_over_c = 2 / SPEED_OF_LIGHT
    delay, beta = two_over_c * np.asarray(range, float), two_over_c * np.asarray(radial_velocity)
    rate = np.asarray(chirp_rate, float)
    beat_per_metre = [-np.asarray(s) * rate * two_over_c * (1 + beta) for s in slopes]
    beat_per_velocity = [
        two_over_c * (np.asarray(carrier) - np.asarray(slope) * rate * delay)
        for slope, carrier in zip(slopes, carriers, strict=True)
    ]
    with np.errstate(divide="ignore"):
        information = [1 / np.asarray(deviation, float) ** 2 for deviation in (up, doppler, down)]
    # Cauchy-Binet writes the determinant as a sum of squares, so nothing cancels.
    determinant = sum(
        information[i] * information[j]
        * (beat_per_metre[i] * beat_per_velocity[j] - beat_per_metre[j] * beat_per_velocity[i]) ** 2
        for i, j in ((0, 1), (0, 2), (1, 2))
    )  # fmt: skip
    range_information = sum(
        weight_of_beat * derivative**2
        for weight_of_beat, derivative in zip(information, beat_per_metre, strict=True)
    )
    velocity_information = sum(
        weight_of_beat * derivative**2
        for weight_of_beat, derivative in zip(information, beat_per_velocity, strict=True)
    )
    is_determined = np.asarray(determinant) > 0
    safe_determinant = np.where(is_determined, determinant, 1.0)
    return RangeVelocityDeviation(
        np.where(is_determined, np.sqrt(velocity_information / safe_determinant), np.inf),
        np.where(is_determined, np.sqrt(range_information / safe_determinant), np.inf),
    )
