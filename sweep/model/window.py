"""Windows: samples, sums, and the envelope of their transforms."""

import math
import re
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

COSINE_SUM_COEFFICIENTS: dict[str, tuple[str, ...]] = {
    "rectangular": ("1", "0"),
    "hann": ("0.5", "0.5"),
    "hamming": ("0.54", "0.46"),
    "blackman": ("0.42", "0.50", "0.08"),
    "nuttall": ("0.3635819", "0.4891775", "0.1365995", "0.0106411"),
    "blackmanharris": ("0.35875", "0.48829", "0.14128", "0.01168"),
    "flattop": ("0.21557895", "0.41663158", "0.277263158", "0.083578947", "0.006947368"),
}
"""Coefficients c_m >= 0 of cosine-sum windows, by window name, as texts.

Sample n of a window of L samples is the sum over m of (-1)^m c_m cos(2 pi m n / L). The digits are
those of scipy.signal.windows."""

WINDOW_NAME_ALIASES = {"boxcar": "rectangular", "rect": "rectangular", "hanning": "hann"}
"""Canonical name of a window, by alternative name."""

ENVELOPE_SAMPLES_PER_BIN = 16
"""Number of samples per bin of fs/L (sample rate over number of samples) at which a window's
transform is computed for its sidelobe envelope. It is used for windows without a closed form."""

_CLOSED_FORM_LENGTH_MIN = 64
"""Smallest number of samples of a cosine-sum window at which its transform is computed in closed
form."""
_WEIGHT_SAMPLES_MAX = 256
"""Largest number of window samples from which :meth:`Window.weights_by_record_position` is
computed; longer windows are sampled more coarsely."""


@dataclass(frozen=True, eq=False)
class Window:
    """Window of a given name and length, with its sums and the envelope of its transform."""

    name: str
    """Name of the window in the spelling of :func:`canonical_window_name`."""
    length: int
    """Number of samples of the window."""
    first_value: float
    """Value of the window's first sample."""
    sum: float
    """Sum of the window's samples, equal to its transform at frequency 0."""
    energy: float
    """Sum of the squares of the window's samples."""
    envelope_distances: np.ndarray
    """(m,): distances from a line at which `sidelobe_envelope` is tabulated [bins of fs/L, sample
    rate over number of samples]."""
    sidelobe_envelope: np.ndarray
    """(m,): largest magnitude of the window's transform at or beyond each of `envelope_distances`,
    relative to the peak."""
    n_missing: int = 0
    """Number of samples at the record's start that are set to 0, because they precede the echo."""

    def samples(self) -> np.ndarray:
        """Return the samples of the window, (L,); the first `n_missing` are 0."""
        w = window_samples(self.name, self.length)
        if self.n_missing:
            w = w.copy()
            w[: self.n_missing] = 0.0
        return w

    def weights_by_record_position(self, adds_powers: bool) -> tuple[float, ...]:
        """Return how the window's magnitude, or its autocorrelation, is distributed over |t|.

        |t| is the distance from the record's middle, or the lag, relative to its largest value.

        Parameters
        ----------
        adds_powers : bool
            False for the samples' magnitude |w| at the distance t from the record's middle; t is 1
            at the record's end. True for the autocorrelation of |w| at the lag t [record lengths].

        Returns
        -------
        tuple of float
            Fractions of the sum over |t|, at |t| evenly spaced over 0..1. For windows other than
            cosine sums the fraction at |t| = 1 is 1, which leads to upper bounds.
        """
        if self.name not in COSINE_SUM_COEFFICIENTS or self.length < _CLOSED_FORM_LENGTH_MIN:
            return 0.0, 1.0
        length = min(self.length, _WEIGHT_SAMPLES_MAX)
        w = np.abs(window_samples(self.name, length if adds_powers else length // 2 * 2))
        if adds_powers:
            weights = np.append(np.correlate(w, w, "full")[w.size - 1 :], 0.0)
            weights[1:] *= 2  # both signs of the lag
        else:
            n_half = w.size // 2
            weights = np.append(w[n_half:], 0.0) + np.append(0.0, w[n_half - 1 :: -1])
        return tuple(map(float, weights / weights.sum()))

    def phase_span_max_table(self, adds_powers: bool) -> np.ndarray:
        """Return the largest half-width of a group of lines that J equivalent lines can represent.

        Half-widths are times pi [rad], by tolerance and by J, as in
        :func:`sweep.model.spectrum.lines.phase_span_max_table`. With `adds_powers` the tolerances
        are those of sums of powers, else those of sums of amplitudes.
        """
        from sweep.model.spectrum.lines import (
            AMPLITUDE_TOLERANCES,
            POWER_TOLERANCES,
            phase_span_max_table,
        )

        tolerances = POWER_TOLERANCES if adds_powers else AMPLITUDE_TOLERANCES
        return phase_span_max_table(self.weights_by_record_position(adds_powers), tolerances)

    @property
    def equivalent_noise_bandwidth(self) -> float:
        """Equivalent noise bandwidth [bins of fs/L, sample rate over number of samples].

        It is L times the sum of squared samples, divided by the squared sum of samples.
        """
        return self.length * self.energy / self.sum**2


def canonical_window_name(name: str) -> str:
    """Return the canonical spelling of a window's name: no alias, no blanks, lower case."""
    compact = re.sub(r"\s+", "", name).lower()
    return WINDOW_NAME_ALIASES.get(compact, compact)


def window_samples(name: str, length: int) -> np.ndarray:
    """Return the samples of a window, in the periodic (DFT-even) form; the largest is about 1.

    Parameters
    ----------
    name : str
        Name of a cosine sum, or of any window of scipy.signal.get_window, with its parameters in
        brackets: ``kaiser(8.6)``.
    length : int
        Number of samples.

    Returns
    -------
    ndarray (length,)

    Raises
    ------
    ValueError
        If scipy does not know the window or rejects its parameters.
    """
    name = canonical_window_name(name)
    if name in COSINE_SUM_COEFFICIENTS:
        return _cosine_sum_samples(name, length)

    from scipy import signal  # slow to import

    match = re.fullmatch(r"([a-z_]+)\(([-+0-9.e,]*)\)", name)
    if match:
        base_name, parameter_text = match.groups()
        parameters = tuple(float(p) for p in parameter_text.split(",") if p)
        return np.asarray(signal.get_window((base_name, *parameters), length, fftbins=True))
    return np.asarray(signal.get_window(name, length, fftbins=True))


def _cosine_sum_samples(name: str, length: int) -> np.ndarray:
    """Return the samples (length,) of a cosine-sum window, bit for bit those of scipy.signal."""
    c = [float(t) for t in COSINE_SUM_COEFFICIENTS[name]]
    if len(c) == 2:
        constant_term, _ = c
        c = [constant_term, 1.0 - constant_term]
    if length == 1 or name == "rectangular":
        return np.ones(length)
    phase = np.linspace(-np.pi, np.pi, length + 1)
    w = np.zeros(length + 1)
    for m, weight in enumerate(c):
        w += weight * np.cos(m * phase)
    return w[:-1]


@lru_cache(maxsize=32)
def get_window(name: str, length: int) -> Window:
    """Return the :class:`Window` with a given name and number of samples (cached).

    Parameters
    ----------
    name : str
        Name of the window, as in :func:`window_samples`.
    length : int
        Number of samples L.

    Returns
    -------
    Window
        Window, with its sums and the envelope of its transform.

    Raises
    ------
    ValueError
        If scipy does not know the window or rejects its parameters.
    """
    name = canonical_window_name(name)
    if name in COSINE_SUM_COEFFICIENTS and length >= _CLOSED_FORM_LENGTH_MIN:
        return _cosine_sum_window(name, length)
    return _window_from_samples(name, length)


ZEROING_STEPS_PER_RECORD = 32
"""Number of equal steps into which a record is divided; :func:`zero_first_samples` zeroes whole
steps."""


def zero_first_samples(window: Window, n_missing: int) -> Window:
    """Return a copy of a window with zeros in its first samples, which precede the echo.

    Parameters
    ----------
    window : Window
        Window of the full record.
    n_missing : int
        Number of first samples that are 0. It is rounded to a multiple of the record's length
        divided by :data:`ZEROING_STEPS_PER_RECORD`, so that few windows are computed.

    Returns
    -------
    Window
        Window with the sums of the remaining samples, and the sidelobe envelope of the full window.
    """
    step = min(
        round(ZEROING_STEPS_PER_RECORD * n_missing / window.length), ZEROING_STEPS_PER_RECORD - 1
    )
    return _zero_first_steps(window, step) if step else window


@lru_cache(maxsize=2 * ZEROING_STEPS_PER_RECORD)
def _zero_first_steps(window: Window, step: int) -> Window:
    """Return a copy of a window with zeros in the first ``step`` steps of the record (cached).

    A record has :data:`ZEROING_STEPS_PER_RECORD` steps.
    """
    shortened = replace(window, n_missing=step * window.length // ZEROING_STEPS_PER_RECORD)
    w = shortened.samples()
    return replace(shortened, sum=float(w.sum()), energy=float((w**2).sum()))


def direct_transform(window: Window, y: np.ndarray) -> np.ndarray:
    """Return the window's Fourier transform by a direct sum over samples; slow, for tests.

    Parameters
    ----------
    window : Window
        Window of length L.
    y : ndarray (n,)
        Frequencies [bins of fs/L].

    Returns
    -------
    ndarray (n,) complex
        W(y) = sum_n w[n] exp(-2 pi i y n / L).
    """
    w, n = window_samples(window.name, window.length), np.arange(window.length)
    cycles = np.outer(np.asarray(y, float), n) / window.length
    # A sum in place of a matrix product, whose order of summation depends on the number of threads.
    return (np.exp(-2j * np.pi * (cycles - np.rint(cycles))) * w).sum(axis=-1)


def centred_transform(window: Window, y: np.ndarray, *, squared: bool = False) -> np.ndarray:
    """Return the Fourier transform of a window, or of its square, about the record's middle.

    Cosine sums of many samples are transformed in closed form, other windows by a direct sum.

    Parameters
    ----------
    window : Window
        Window of L samples; samples that :func:`zero_first_samples` has set to 0 are included.
    y : ndarray (n,)
        Frequencies [bins of fs/L], less than L/2 in modulus.
    squared : bool
        True to transform the squared window.

    Returns
    -------
    ndarray (n,) complex
        sum_n w[n]^p exp(-2 pi i y (n/L - 1/2)), with p = 2 if ``squared``, else 1.

    Notes
    -----
    About its middle u = n - L/2, a cosine sum is the sum of c_m cos(2 pi m u / L). The transform of
    a constant is D(y) = exp(i pi y / L) sin(pi y) / sin(pi y / L), so that the window's is

        c_0 D(y) + sum_m c_m (D(y - m) + D(y + m)) / 2.

    Examples
    --------
    >>> transform = centred_transform(get_window("hann", 1024), np.array([0.0, 1.0, 2.0]))
    >>> np.abs(np.round(transform / 1024, 3)).tolist()
    [0.5, 0.25, 0.0]
    """
    y, length = np.asarray(y, float), window.length
    if window.name not in COSINE_SUM_COEFFICIENTS or length < _CLOSED_FORM_LENGTH_MIN:
        w = window_samples(window.name, length)
        w = w * w if squared else w
        record_position = np.arange(length) / length - 0.5
        # Sums, not products of matrices, whose order depends on the number of threads.
        return np.array([(w * np.exp(-2j * np.pi * f * record_position)).sum() for f in y])
    cosine_coefficients = [float(t) for t in COSINE_SUM_COEFFICIENTS[window.name]]
    amplitudes = np.array(
        [c / 2 for c in cosine_coefficients[:0:-1]]
        + cosine_coefficients[:1]
        + [c / 2 for c in cosine_coefficients[1:]]
    )  # of exp(2 pi i m u / L), m = -M .. M
    if squared:
        amplitudes = np.convolve(amplitudes, amplitudes)
    order_max = amplitudes.size // 2
    transform = np.zeros(y.shape, complex)
    for m, amplitude in enumerate(amplitudes.tolist(), -order_max):
        constant_transform = length * np.sinc(y - m) / np.sinc((y - m) / length)
        transform += amplitude * constant_transform * np.exp(1j * np.pi * (y - m) / length)
    return transform


def _cosine_sum_window(name: str, length: int) -> Window:
    """Return the :class:`Window` of a cosine sum; its sums and envelope are closed forms."""
    coefficients = tuple(float(t) for t in COSINE_SUM_COEFFICIENTS[name])
    envelope_distances, sidelobe_envelope = _cosine_sum_envelope(coefficients, length)
    first_value = math.fsum((-1) ** m * coefficient for m, coefficient in enumerate(coefficients))
    constant_term, *cosine_terms = coefficients
    energy = length * (
        constant_term**2 + sum(coefficient * coefficient for coefficient in cosine_terms) / 2
    )
    return Window(
        name,
        length,
        first_value,
        length * constant_term,
        energy,
        envelope_distances,
        sidelobe_envelope,
    )


def _cosine_sum_envelope(
    coefficients: tuple[float, ...], length: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the sidelobe envelope of a cosine-sum window, computed in closed form.

    Parameters
    ----------
    coefficients : tuple of float
        Coefficients c_m of :data:`COSINE_SUM_COEFFICIENTS`, as numbers.
    length : int
        Length [samples].

    Returns
    -------
    envelope_distances, sidelobe_envelope : ndarray (m,)
        Fields of :class:`Window`.
    """
    near_distances = np.arange(1, min(256, length // 2) * 8) / 8
    far_distances = np.geomspace(256, length / 2, 64) if length > 512 else np.empty(0)
    distances = np.unique(
        np.concatenate([near_distances, np.floor(far_distances) + 0.5, [length / 2]])
    )
    distances = distances[distances <= length / 2]
    theta = np.pi * (distances + 1e-9) / length
    constant_term, *cosine_terms = coefficients
    kernel = constant_term / np.tan(theta)
    for m, coefficient in enumerate(cosine_terms, 1):
        a = np.pi * m / length
        kernel += (-1) ** m * coefficient / 2 * (1 / np.tan(theta - a) + 1 / np.tan(theta + a))
    first_value = sum((-1) ** m * coefficient for m, coefficient in enumerate(coefficients))
    magnitude = (
        np.abs(np.sin(np.pi * (distances + 1e-9)))
        * np.hypot(kernel, first_value)
        / (length * constant_term)
    )
    return _decimate_envelope(distances, np.maximum.accumulate(magnitude[::-1])[::-1])


def _decimate_envelope(
    distances: np.ndarray, envelope: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a sidelobe envelope at fewer distances, which differ by some 2 %.

    `envelope` (m,) is the largest magnitude of a window's transform at or beyond each of
    `distances` (m,), relative to the peak. The result is (distances, envelope). The envelope is
    raised by 3 %, because sidelobes may have their peaks between samples.
    """
    kept_indices = np.unique(
        np.searchsorted(distances, np.geomspace(distances[0], distances[-1], 512)).clip(
            0, distances.size - 1
        )
    )
    return distances[kept_indices].copy(), 1.03 * envelope[kept_indices]


def _window_from_samples(name: str, length: int) -> Window:
    """Return the :class:`Window` of any name, with its envelope from the FFT of its samples."""
    w = window_samples(name, length)
    fft_size = ENVELOPE_SAMPLES_PER_BIN * length
    distances = np.arange(fft_size // 2 + 1) / ENVELOPE_SAMPLES_PER_BIN
    spectrum = np.fft.rfft(w, fft_size)
    magnitude = np.abs(spectrum) / w.sum()
    envelope_distances, sidelobe_envelope = _decimate_envelope(
        distances[1:], np.maximum.accumulate(magnitude[::-1])[::-1][1:]
    )
    return Window(
        name,
        length,
        float(w[0]),
        float(w.sum()),
        float((w**2).sum()),
        envelope_distances,
        sidelobe_envelope,
    )
