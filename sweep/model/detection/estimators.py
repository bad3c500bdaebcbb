"""Estimators of a peak's frequency from the complex spectrum around it, and their bounds.

All take spectra of records, windowed and transformed, and give places by index. These are
frequencies in bins of a real record; for a complex one N/2 is added, and its last bin is a
neighbour of its first. If a window matters, what they need of it comes from its own samples, so
that any window and any padding will do. With Z_j the bins about the peak, turned so that a lone
tone's are real and even in its distance (the phase of half a record a bin taken off):

- ``peak_bin``: the largest bin, off by up to half a bin.
- ``parabolic``, ``parabolic_log``: the vertex of a parabola through three magnitudes, or through
  their logarithms [Smith and Serra, PARSHL, 1987]; biased between bins.
- ``jacobsen``: Q Re[(Z_+ - Z_-) / (2 Z_0 - Z_- - Z_+)] for tapered windows, and
  Re[(Z_+ - Z_-) / (2 Z_0 + Z_- + Z_+)] where the neighbours of a tone on a bin vanish [Jacobsen and
  Kootsookos, IEEE Signal Process. Mag. 24(3), 123, 2007], Q the window's factor, by least squares
  over half a bin (that of the published table within its digits); biased between bins.
- ``candan``: the second form for every window, its bias taken out: Candan's factor [IEEE Signal
  Process. Lett. 18, 351, 2011, and 20, 913, 2013; Signal Process. 114, 245, 2015, for windows] is
  the slope at the bin, here the whole curve is inverted.
- ``centroid``: centre of the power, less the noise's, within two resolution cells; biased by
  what noise is left.
- ``chirp_z``: the largest value of the windowed record's spectrum, on a grid of 1/32 bin by a
  chirp-z transform [Rabiner, Schafer and Rader, Bell Syst. Tech. J. 48, 1249, 1969], and a
  parabola; it reaches :func:`windowed_peak_deviation`.
- ``maximum_likelihood``: the window is divided out of the record again, and the largest value of
  the unwindowed spectrum found by Newton's method. This is repeated without the tone's image at
  negative frequency. For a lone tone in white noise the result is the most likely one [Rife and
  Boorstyn, IEEE Trans. Inf. Theory 20, 591, 1974], which reaches the Cramer-Rao bound.

The Cramer-Rao bound is the least error of any unbiased estimate of a beat, a range, a velocity. For
a tone A cos(2 pi f n / fs + phi) in L samples with white Gaussian noise of variance s^2, all of A,
f and phi are unknown. With cnr = A^2 / (2 s^2), the tone's power over the noise's before the FFT,

    var(f) >= 12 / (cnr L (L^2 - 1)) (fs / 2 pi)^2

[Rife and Boorstyn, IEEE Trans. Inf. Theory 20, 591, 1974; Kay, Fundamentals of Statistical Signal
Processing: Estimation Theory, 1993, section 3.11]. For a tone some bins away from DC and Nyquist,
where the bound does not depend on its phase. Of a complex tone of power cnr over the noise's, I and
Q together, it is half as much. It is that of the whole record. A window throws away
what it tapers off, and the largest value of a windowed spectrum knows the tone less well
(:func:`windowed_peak_deviation`), unless the window is taken back first.

Three segments know two unknowns: the Fisher information of independent beats adds, weighted with
what range and velocity change in each (:mod:`sweep.model.waveform`). The record of a segment is
taken to tell of its beat's frequency only; its phase, 4 pi R / lambda, is known modulo 2 pi.

Below some SNR estimates are not unbiased and the bound says nothing: noise elsewhere in the
spectrum is taken for the tone (the threshold effect).
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
from sweep.model.detection.detectors import FIXED_THRESHOLD, SpectrumSettings, cached_window_samples
from sweep.model.waveform import DEFAULT_CHIRP_SLOPES
from sweep.model.window import Window

Estimator = Callable[[np.ndarray, np.ndarray, SpectrumSettings], np.ndarray]
"""From complex spectra (m, N/2 + 1), the bins of their peaks (m,) int64, 1..N/2 - 1, and the
setting to frequencies (m,) [bins], float64; by index 0..N - 1 in spectra (m, N) of complex
records."""

PEAK_BIN = "peak_bin"

DETECTOR_PREFIX, ESTIMATOR_PREFIX = (
    "instrument.processing.detector.",
    "instrument.processing.estimator.",
)
SPECTRUM_METHOD_DEFAULTS: dict[str, float | int | str] = {
    DETECTOR_PREFIX + "kind": FIXED_THRESHOLD,
    DETECTOR_PREFIX + "training": 32,
    DETECTOR_PREFIX + "guard": 4,
    DETECTOR_PREFIX + "rank": 0,
    DETECTOR_PREFIX + "pfa": 1e-6,
    ESTIMATOR_PREFIX + "kind": PEAK_BIN,
}
"""Of the parameters that say how whole spectra are looked at."""

_TABLE_STEPS = 512
"""Places between -1 and 1 bin at which curves are known."""
_NEIGHBOUR_HEIGHT_MIN = 0.25
"""Height of the neighbours of a tone on a bin, over its own, under which they count as none."""
_CENTROID_REACH_CELLS = 2
"""Resolution cells fs/L to either side over which a centroid is taken."""
_ZOOM_POINTS_PER_BIN = 32
"""Places a bin of the chirp-z transform."""
_WINDOW_FRACTION_MIN = 1e-3
"""Samples where the window is less than that, of its largest, are left out when it is undone."""
_NEWTON_STEPS = 6
_NEWTON_REACH_BINS = 0.5
"""Steps of Newton's method, and bins that they may go in all."""


def peak_bin(spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Return the peak bin itself."""
    return peak.astype(float)


def parabolic(spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Vertex of the parabola through three magnitudes."""
    return peak + _parabola_vertex(np.abs(_three_bins(spectrum, peak)))


def parabolic_log(spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Vertex of the parabola through the logarithms of three magnitudes."""
    with np.errstate(divide="ignore"):
        return peak + _parabola_vertex(np.log(np.abs(_three_bins(spectrum, peak))))


def jacobsen(spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Jacobsen's ratio with the window's factor."""
    sign, factor = jacobsen_coefficients(settings.window, settings.fft_size)
    return peak + factor * _jacobsen_ratio(_three_bins_about_middle(spectrum, peak, settings), sign)


def candan(spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Jacobsen's ratio, as a lone tone in this window has it, inverted."""
    offset, tone_bins = _tone_bins(settings.window, settings.fft_size)
    tone_ratios = np.maximum.accumulate(_jacobsen_ratio(tone_bins, 1))
    return peak + np.interp(
        _jacobsen_ratio(_three_bins_about_middle(spectrum, peak, settings), 1), tone_ratios, offset
    )


def centroid(spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Centre of the power about the peak, less that of the noise."""
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
    """Largest value of the spectrum between bins, by a chirp-z transform."""
    zoom, positions = (
        _zoom_transform(settings.window.length, settings.fft_size),
        np.empty(peak.size),
    )
    zoom_grid = np.arange(2 * _ZOOM_POINTS_PER_BIN + 1)
    for row, bin_ in enumerate(peak):  # one by one, so that bits do not depend on the others
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
    """Most likely frequency of a lone tone in white noise."""
    from sweep.model.detection.sub_bin_interpolation import complex_exponentials

    w = settings.taper
    is_used = np.abs(w) > _WINDOW_FRACTION_MIN * np.abs(w).max()
    weight = np.where(is_used, 1.0 / np.where(is_used, w, 1.0), 0.0)
    start = candan(spectrum, peak, settings)
    fft_size, n_used, frequencies = float(settings.fft_size), float(is_used.sum()), start.copy()
    for row in range(peak.size):
        record = _record_from_spectrum(spectrum[row], settings) * weight
        frequencies[row] = _refine_maximum(record, start[row], fft_size)
        if not settings.complex_record:
            tone = complex_exponentials(frequencies[row] / fft_size, record.size)
            image = ((record * tone).sum() / n_used).conjugate() * tone
            # Where the window was not undone there is no tone.
            frequencies[row] = _refine_maximum(
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
    """Bins below, at and above each peak, (m, 3)."""
    bins = (peak[:, None] + np.array([-1, 0, 1])) % spectrum.shape[1]
    return np.take_along_axis(spectrum, bins, axis=1)


def _three_bins_about_middle(
    spectrum: np.ndarray, peak: np.ndarray, settings: SpectrumSettings
) -> np.ndarray:
    """Return the same bins, with phases counted from the middle of the record."""
    cycles_per_bin = 0.5 * settings.window.length / settings.fft_size
    return _three_bins(spectrum, peak) * np.exp(2j * np.pi * cycles_per_bin * np.array([-1, 0, 1]))


def _parabola_vertex(values: np.ndarray) -> np.ndarray:
    """Vertex of the parabola through (m, 3), -1/2..1/2 from the middle; 0 where there is none."""
    below, middle, above = values.T
    curvature = 2 * middle - below - above
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = 0.5 * (above - below) / curvature
    return np.where(np.isfinite(vertex) & (curvature > 0), np.clip(vertex, -0.5, 0.5), 0.0)


def _jacobsen_ratio(three_bins: np.ndarray, neighbour_sign: int) -> np.ndarray:
    """Re[(Z_+ - Z_-) / (2 Z_0 +- (Z_- + Z_+))] of (m, 3), within -1..1."""
    below, middle, above = three_bins.T
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = ((above - below) / (2 * middle + neighbour_sign * (below + above))).real
    return np.clip(np.nan_to_num(ratio), -1.0, 1.0)


@lru_cache(maxsize=16)
def _tone_bins(window: Window, fft_size: int) -> tuple[np.ndarray, np.ndarray]:
    """Distances [bins] from -1 to 1, and the turned bins of tones that far above one, (k, 3)."""
    from sweep.model.detection.sub_bin_interpolation import tone_spectrum

    offset = np.arange(-_TABLE_STEPS, _TABLE_STEPS + 1) / _TABLE_STEPS
    return offset, tone_spectrum(window, fft_size)(np.array([-1, 0, 1]) - offset[:, None]).real


@lru_cache(maxsize=16)
def jacobsen_coefficients(window: Window, fft_size: int) -> tuple[int, float]:
    """Sign of the neighbours in Jacobsen's denominator, and the factor of his ratio."""
    offset, tone_bins = _tone_bins(window, fft_size)
    middle = tone_bins[_TABLE_STEPS]
    if abs(middle[2]) < _NEIGHBOUR_HEIGHT_MIN * middle[1]:
        return 1, 1.0
    is_near = np.abs(offset) <= 0.5
    ratio = _jacobsen_ratio(tone_bins[is_near], -1)
    return -1, float((ratio * offset[is_near]).sum() / (ratio**2).sum())


@lru_cache(maxsize=4)
def _zoom_transform(length: int, fft_size: int) -> Callable[[np.ndarray], np.ndarray]:
    """Chirp-z transform of a record at rest, from -1 to 1 bin."""
    from scipy import signal  # slow to import

    edge = 1.0 / fft_size
    return signal.ZoomFFT(
        length, [-edge, edge], 2 * _ZOOM_POINTS_PER_BIN + 1, fs=1.0, endpoint=True
    )


def _record_from_spectrum(spectrum: np.ndarray, settings: SpectrumSettings) -> np.ndarray:
    """Return the windowed record (L,) of a spectrum; of a complex one shifted by half its rate.

    A tone then has the frequency that its index says.
    """
    if settings.complex_record:
        return np.asarray(fft.ifft(spectrum))[: settings.window.length]
    return np.asarray(fft.irfft(spectrum, settings.fft_size))[: settings.window.length]


def _shift_bin_to_zero(record: np.ndarray, bin_: int, settings: SpectrumSettings) -> np.ndarray:
    """Shift a record in frequency so that a bin lies at zero."""
    cycles = np.arange(record.size) * bin_ % settings.fft_size / settings.fft_size
    return np.asarray(record * np.exp(-2j * np.pi * cycles))


def _refine_maximum(record: np.ndarray, start: float, fft_size: float) -> float:
    """Place [bins] of the nearest maximum of |sum x e^{-2 pi i n f / N}|^2, from a start."""
    from sweep.model.detection.sub_bin_interpolation import complex_exponentials

    n = np.arange(record.size) - 0.5 * (record.size - 1)
    position = start
    for _ in range(_NEWTON_STEPS):
        turned_record = record * complex_exponentials(position / fft_size, record.size)
        s0, s1, s2 = turned_record.sum(), (n * turned_record).sum(), (n * n * turned_record).sum()
        # of |S|^2 by the angle
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
    """Least standard deviations of what three beats are resolved into."""

    range: np.ndarray
    """[m]"""
    radial_velocity: np.ndarray
    """[m/s]"""


def carrier_to_noise_ratio(*, snr: ArrayLike, window: Window) -> np.ndarray:
    """Return the tone-to-noise power ratio before the FFT, by the SNR of its strongest bin.

    The tone is taken to lie on a bin; between bins the true ratio is higher by the scalloping loss.
    For a tone of amplitude A, window w and noise s per sample, |X| = A sum(w) / 2 on a bin, and a
    bin's noise power is sum(w^2) s^2.
    """
    return np.asarray(snr, float) * 2 * window.energy / window.sum**2


def beat_frequency_bound(
    *, cnr: ArrayLike, n_samples: ArrayLike, sample_rate: ArrayLike
) -> np.ndarray:
    """Least standard deviation [Hz] of a tone's frequency in a record of `n_samples`, unpadded.

    `cnr` is the tone's power over the noise's before the FFT, for a complex record twice that.
    """
    count = np.asarray(n_samples, float)
    with np.errstate(divide="ignore"):
        variance = 12 / (np.asarray(cnr, float) * count * (count**2 - 1))
    return np.sqrt(variance) * np.asarray(sample_rate) / (2 * math.pi)


def phase_noise_deviation(
    *, line_width: ArrayLike, delay: ArrayLike, duration: ArrayLike
) -> np.ndarray:
    """Compute the standard deviation [Hz] of a beat's frequency from its laser's phase walk.

    The error is the slope over 2 pi of the least-squares line through theta(t) - theta(t - tau) in
    a record of length T. theta is a Wiener process of variance Gamma |t| = 2 pi dnu |t|, dnu the
    FWHM of the laser's Lorentzian line. With r = tau / T, or 1 where the delay is longer,

        var(f) = 12 Gamma / T r^2 (1 - r + r^3 / 5) / (2 pi)^2

    The maximum-likelihood frequency in white noise has this error in addition to
    :func:`beat_frequency_bound`. Estimates that knew the walk's correlation could do better by a
    few percent for short delays, by a fifth for r = 1/3.
    """
    delay_fraction = np.minimum(np.asarray(delay, float) / duration, 1.0)
    walk_variance = 12 * np.asarray(line_width, float) / np.asarray(duration, float)
    return (
        np.sqrt(walk_variance * (1 - delay_fraction + delay_fraction**3 / 5) / (2 * math.pi))
        * delay_fraction
    )


def windowed_peak_deviation(
    *, cnr: ArrayLike, window: Window, sample_rate: ArrayLike
) -> np.ndarray:
    """Compute the standard deviation [Hz] of the frequency at which a windowed |X(f)| peaks.

    To first order in the noise, with m = n less the middle of the record,

        var(f) = sum(w^2 m^2) / (cnr sum(w m^2)^2) (fs / 2 pi)^2

    which is the bound for the rectangular window and more for every other: the expansion of the
    periodogram about its maximum [Rife and Vincent, Bell Syst. Tech. J. 49, 197, 1970].
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


def range_velocity_deviation(
    *,
    up: ArrayLike,
    doppler: ArrayLike,
    down: ArrayLike,
    carriers: tuple[ArrayLike, ArrayLike, ArrayLike],
    chirp_rate: ArrayLike,
    range: ArrayLike,
    radial_velocity: ArrayLike,
    slopes: Sequence[ArrayLike] = DEFAULT_CHIRP_SLOPES,
) -> RangeVelocityDeviation:
    """Least standard deviations of range and radial velocity, of the beats' own [Hz].

    Those of beats that are not used are inf. :func:`sweep.model.waveform.resolve_range_velocity`
    takes no more
    from the Doppler beat than which reading of the others is right: the bound of what it reports
    has ``doppler=np.inf``. `slopes` are chirp rates over `chirp_rate`, signed.
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
    # The determinant of a sum of squares as squares again (Cauchy and Binet): nothing cancels.
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
