"""Windows: samples, sums, and the envelope of their transforms."""

import math
import re
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

COSINE_SUMS: dict[str, tuple[str, ...]] = {
    "rectangular": ("1", "0"),
    "hann": ("0.5", "0.5"),
    "hamming": ("0.54", "0.46"),
    "blackman": ("0.42", "0.50", "0.08"),
    "nuttall": ("0.3635819", "0.4891775", "0.1365995", "0.0106411"),
    "blackmanharris": ("0.35875", "0.48829", "0.14128", "0.01168"),
    "flattop": ("0.21557895", "0.41663158", "0.277263158", "0.083578947", "0.006947368"),
}
"""Coefficients c_m, as written in scipy.signal.windows; alternating signs are applied outside."""

ALIASES = {"boxcar": "rectangular", "rect": "rectangular", "hanning": "hann"}

OVERSAMPLING = 16
"""Samples a bin in the tabulated kernel."""

_SHORTEST_CLOSED_FORM = 64
_STAND_IN = 256


@dataclass(frozen=True, eq=False)
class Window:
    """A window of a given length with all that the spectrum's kernel needs."""

    name: str
    length: int
    """Number of samples L."""
    edge: float
    """First sample w[0]."""
    sum: float
    """sum w, W at its peak."""
    energy: float
    """E_w = sum w^2."""
    reach: np.ndarray
    envelope: np.ndarray
    """(m,): max |W(y)| / sum over |y| >= `reach` [bins of fs/L]."""
    missing: int = 0
    """First samples that are 0, as of :func:`last_part`."""

    def samples(self) -> np.ndarray:
        """All samples (L,)."""
        w = samples(self.name, self.length)
        if self.missing:
            w = w.copy()
            w[: self.missing] = 0.0
        return w

    def band_weights(self, power: bool) -> tuple[float, ...]:
        """Shares of the sum that |w| has at places |t| evenly spaced over 0..1, the record's end.

        Of powers those of its autocorrelation, of transform |W|^2: t is the lag over L. All at the
        end for other windows than sums of cosines: an upper bound.
        """
        if self.name not in COSINE_SUMS or self.length < _SHORTEST_CLOSED_FORM:
            return 0.0, 1.0
        length = min(self.length, _STAND_IN)
        w = np.abs(samples(self.name, length if power else length // 2 * 2))
        if power:
            weights = np.append(np.correlate(w, w, "full")[w.size - 1 :], 0.0)
            weights[1:] *= 2  # either sign
        else:
            half = w.size // 2
            weights = np.append(w[half:], 0.0) + np.append(0.0, w[half - 1 :: -1])
        return tuple(map(float, weights / weights.sum()))

    def node_limits(self, power: bool) -> np.ndarray:
        """Return the limits pi h of J equivalent lines (:func:`sweep.model.lines.node_limits`)."""
        from sweep.model.lines import AMPLITUDE_TOLERANCES, POWER_TOLERANCES, node_limits

        tolerances = POWER_TOLERANCES if power else AMPLITUDE_TOLERANCES
        return node_limits(self.band_weights(power), tolerances)

    @property
    def equivalent_noise_bandwidth(self) -> float:
        """Equivalent noise bandwidth [bins of fs/L]."""
        return self.length * self.energy / self.sum**2


def canonical_name(name: str) -> str:
    """One spelling for every window: aliases resolved, blanks dropped, lower case."""
    compact = re.sub(r"\s+", "", name).lower()
    return ALIASES.get(compact, compact)


def samples(name: str, length: int) -> np.ndarray:
    """DFT-even window samples (length,), peak about 1.

    ``name`` is a cosine sum, or any window of scipy.signal.get_window, its parameters in brackets:
    ``kaiser(8.6)``; a ValueError where scipy knows none such or refuses its parameters.
    """
    name = canonical_name(name)
    if name in COSINE_SUMS:
        return _cosine_samples(name, length)

    from scipy import signal  # which takes longer to import than all else that a spec needs

    match = re.fullmatch(r"([a-z_]+)\(([-+0-9.e,]*)\)", name)
    if match:
        parameters = tuple(float(p) for p in match[2].split(",") if p)
        return np.asarray(signal.get_window((match[1], *parameters), length, fftbins=True))
    return np.asarray(signal.get_window(name, length, fftbins=True))


def _cosine_samples(name: str, length: int) -> np.ndarray:
    """Compute a cosine sum's samples, bit for bit those of scipy.signal."""
    c = [float(t) for t in COSINE_SUMS[name]]
    if len(c) == 2:
        c[1] = 1.0 - c[0]
    if length == 1 or name == "rectangular":
        return np.ones(length)
    turn = np.linspace(-np.pi, np.pi, length + 1)
    w = np.zeros(length + 1)
    for m, weight in enumerate(c):
        w += weight * np.cos(m * turn)
    return w[:-1]


@lru_cache(maxsize=32)
def window(name: str, length: int) -> Window:
    """Return the window of this name and length, prepared once and cached."""
    name = canonical_name(name)
    if name in COSINE_SUMS and length >= _SHORTEST_CLOSED_FORM:
        return _closed_form(name, length)
    return _tabulated(name, length)


PARTS = 32
"""Steps of the length in which :func:`last_part` counts the samples that lack."""


def last_part(window: Window, missing: int) -> Window:
    """Return the window with some of its first samples 0, to a step of :data:`PARTS` of them.

    For the sums over a window that depend little on how many these are: the envelope stays.
    """
    step = min(round(PARTS * missing / window.length), PARTS - 1)
    return _last_part(window, step) if step else window


@lru_cache(maxsize=2 * PARTS)
def _last_part(window: Window, step: int) -> Window:
    part = replace(window, missing=step * window.length // PARTS)
    w = part.samples()
    return replace(part, sum=float(w.sum()), energy=float((w**2).sum()))


def transform(window: Window, y: np.ndarray) -> np.ndarray:
    """W(y) by direct sum over the samples: slow and plain, (n,) complex for (n,) bins of fs/L."""
    w, n = samples(window.name, window.length), np.arange(window.length)
    turns = np.outer(np.asarray(y, float), n) / window.length
    # A sum, not a product of matrices, whose order depends on the number of threads.
    return (np.exp(-2j * np.pi * (turns - np.rint(turns))) * w).sum(axis=-1)


def _closed_form(name: str, length: int) -> Window:
    c = tuple(float(t) for t in COSINE_SUMS[name])
    reach, envelope = _sidelobe_envelope(c, length)
    edge = math.fsum((-1) ** m * x for m, x in enumerate(c))
    energy = length * (c[0] ** 2 + sum(x * x for x in c[1:]) / 2)
    return Window(name, length, edge, length * c[0], energy, reach, envelope)


def _sidelobe_envelope(c: tuple[float, ...], length: int) -> tuple[np.ndarray, np.ndarray]:
    """Largest |W| / sum at and beyond each distance, from dense samples of the closed form."""
    near = np.arange(1, min(256, length // 2) * 8) / 8
    far = np.geomspace(256, length / 2, 64) if length > 512 else np.empty(0)
    y = np.unique(np.concatenate([near, np.floor(far) + 0.5, [length / 2]]))
    y = y[y <= length / 2]
    theta = np.pi * (y + 1e-9) / length
    kernel = c[0] / np.tan(theta)
    for m in range(1, len(c)):
        a = np.pi * m / length
        kernel += (-1) ** m * c[m] / 2 * (1 / np.tan(theta - a) + 1 / np.tan(theta + a))
    edge = sum((-1) ** m * x for m, x in enumerate(c))
    magnitude = np.abs(np.sin(np.pi * (y + 1e-9))) * np.hypot(kernel, edge) / (length * c[0])
    return _thinned(y, np.maximum.accumulate(magnitude[::-1])[::-1])


def _thinned(y: np.ndarray, envelope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thin the envelope to some 2 % steps of distance, each a bound for all beyond it.

    The 3 % on top is for sidelobes whose peaks lie between samples.
    """
    keep = np.unique(np.searchsorted(y, np.geomspace(y[0], y[-1], 512)).clip(0, y.size - 1))
    return y[keep].copy(), 1.03 * envelope[keep]


def _tabulated(name: str, length: int) -> Window:
    w = samples(name, length)
    size = OVERSAMPLING * length
    y = np.arange(size // 2 + 1) / OVERSAMPLING
    spectrum = np.fft.rfft(w, size)
    magnitude = np.abs(spectrum) / w.sum()
    reach, envelope = _thinned(y[1:], np.maximum.accumulate(magnitude[::-1])[::-1][1:])
    sums = float(w[0]), float(w.sum()), float((w**2).sum())
    return Window(name, length, *sums, reach, envelope)
