"""Position of a tone between bins, from the magnitudes of the largest bin and its two neighbours.

With the window's transform W at the spacing of the bins, a lone tone delta bins past the centre bin
has the magnitudes |W(-1 - delta)|, |W(-delta)|, |W(1 - delta)|. The way back to delta depends on
the window:

- If the neighbours of a tone on a bin still stand high (Hann, Hamming, wider ones), the measure
  (above - below) / (below + 2 centre + above) is inverted by a table (for Hann it is delta / 2).
  One step of least squares follows, weighted by the noise's covariance between the three bins: the
  least error that three magnitudes allow.
- If the neighbours vanish (rectangular) the larger of them says the side, and the measure is
  larger / (centre + larger), for the rectangular window delta itself.

The tables are made of the window's own transform, so a noise-free lone tone is placed exactly (1e-6
bins). Three things bias the estimate: other lines within the reach of the kernel, the tone's own
image near DC and Nyquist, and a footprint that spreads over bins. A footprint's estimate is that of
its centre. Noise biases it in the rectangular window, where the wrong neighbour may be larger.

An echo that arrives after its record has begun lacks the first samples, and its line is that of a
shortened window. The place that these tables give is corrected for that, as the instrument knows
its window and, from the whole bins, the delay (:func:`late_echo`): exact for a lone tone.

A footprint whose lines add as powers and spread by s [bins, standard deviation] about their mean
broadens the peak, which moves the estimate by some multiple of s^2, tabulated as `widening`.

The error under noise follows to first order from the noise in phase with the signal, which the
window correlates between bins. The Cramer-Rao bound (:mod:`sweep.model.estimators`) is that of the
whole record without a window; three magnitudes of a windowed spectrum do not reach it.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev
from scipy.interpolate import RegularGridInterpolator

from sweep.kernel_cache import njit
from sweep.model.window import Window, samples

_STEPS = 2048
"""Number of intervals in the tables; linear interpolation errs by some 1e-7 bins."""

_WIDENED, _NARROW = 129, 0.05
"""Number of places, and standard deviation [bins], at which ``widening`` is evaluated."""

_DEGREE = 32
"""Degree of the polynomial that represents a tone's complex bin within +-2 bins."""

_VANISHING = 0.25
"""Relative height of a centred tone's neighbours below which TWO_BINS is used."""

THREE_BINS, TWO_BINS = 0, 1


class Interpolator(NamedTuple):
    """Tables of one window and FFT size that convert bin magnitudes to a position between bins.

    m is the number of places 0 .. 1 bin at which they are given.
    """

    measure: int
    """THREE_BINS or TWO_BINS."""
    low: float
    """Measure of a tone exactly on the centre bin."""
    step: float
    """Spacing of the measures at which ``position`` is tabulated."""
    position: np.ndarray
    """(m,): |delta| [bins], 0 .. 1, for the measures low, low + step, .."""
    weight: np.ndarray
    """(3, m): least-squares weights by |delta|, on the bin away from the tone, the centre and the
    bin on the tone's side, for magnitudes over the centre's. Zero for TWO_BINS."""
    error: np.ndarray
    """(m,): standard error [bins] by |delta| if the centre bin's magnitude equals sigma."""
    mixing: tuple[float, float, float, float]
    """Factors m0 .. m3 that make the correlated noise of three adjacent bins, in one quadrature, of
    independent normal numbers z0 (centre), z1, z2: above m0 z0 + m1 z1, below m0 z0 + m2 z1 + m3
    z2."""
    sidelobe_correlation: float
    """Correlation of the noise of neighbouring bins in phase with a tone's sidelobes there, which
    change sign from one to the next: once in L of N bins, for records of L samples."""
    widening: np.ndarray
    """(m,): position error by |delta| over the variance of lines that add as powers [1/bins]."""


@lru_cache(maxsize=64)
def noise_correlation(window: Window, fft_size: int) -> tuple[float, float]:
    """Return the noise correlation of bins one and two apart, in phase with a tone's signal."""
    squared = samples(window.name, window.length) ** 2
    turns = (np.arange(window.length) - window.length / 2) / fft_size
    near, far = (float((squared * np.cos(2 * np.pi * d * turns)).sum()) for d in (1, 2))
    return near / window.energy, far / window.energy


def sidelobe_correlation(window: Window, fft_size: int) -> float:
    """Return the noise correlation of adjacent bins in phase with a tone's sidelobes there.

    See :attr:`Interpolator.sidelobe_correlation`.
    """
    near, _ = noise_correlation(window, fft_size)
    return near * (1.0 - 2.0 * window.length / fft_size)


@lru_cache(maxsize=32)
def interpolator(window: Window, fft_size: int) -> Interpolator:
    """Prepare the tables for a window and FFT size (cached).

    If the window's top is so flat that no measure grows with delta (flat-top windows in a padded
    FFT), positions are not resolved: delta is 0 and its error half a bin.
    """
    delta = np.arange(_STEPS + 1) / _STEPS
    tone = _tone(window, fft_size, delta)
    vanishing = tone[2, 0] < _VANISHING * tone[1, 0]
    below, centre, above = tone
    values = above / (centre + above) if vanishing else (above - below) / (tone.sum(0) + centre)
    near, far = noise_correlation(window, fft_size)
    weight, error = _least_squares(tone, delta, near, far, two_bins=bool(vanishing))
    if not (np.diff(values[: _STEPS // 2 + 1]) > 0).all():
        weight, error, delta = 0 * weight, np.full_like(error, 1e30), 0 * delta
    values = np.maximum.accumulate(values)
    grid = np.linspace(values[0], values[-1], _STEPS + 1)
    tables = Interpolator(
        measure=TWO_BINS if vanishing else THREE_BINS,
        low=float(values[0]),
        step=max(float(grid[1] - grid[0]), 1e-12),
        position=np.interp(grid, values, delta),
        weight=0 * weight if vanishing else weight,
        error=error,
        mixing=_mixing(near, far),
        sidelobe_correlation=sidelobe_correlation(window, fft_size),
        widening=np.zeros(0),
    )
    return tables._replace(widening=_widening(window, fft_size, tables))


def phasors(cycles: float, number: int) -> np.ndarray:
    """Return exp(-2 pi i cycles n), n = 0 .. number - 1, from some 2 sqrt(number) exponentials."""
    step = math.isqrt(number) + 1
    angle = -2j * np.pi * cycles * np.arange(step)
    return np.multiply.outer(np.exp(step * angle), np.exp(angle)).ravel()[:number]


@lru_cache(maxsize=32)
def lone_tone(window: Window, fft_size: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that gives the complex bin at distances -2 .. 2 [bins] from a lone tone.

    The phase of half a record is removed, so that it is real for a symmetric window. It turns by at
    most one cycle, so that a polynomial represents it to 1e-14 of the largest bin.
    """
    w, middle = samples(window.name, window.length), window.length / 2

    def at(distances: np.ndarray) -> np.ndarray:
        each = [(w * phasors(y / fft_size, w.size)).sum() for y in distances]
        return np.array(each) * np.exp(2j * np.pi * middle / fft_size * distances)

    return Chebyshev.interpolate(at, _DEGREE, domain=[-2, 2])


def _tone(window: Window, fft_size: int, delta: np.ndarray) -> np.ndarray:
    """Magnitudes of three bins around lone tones delta bins past the middle one, (3, m)."""
    return np.abs(lone_tone(window, fft_size)(np.array([[-1.0], [0.0], [1.0]]) - delta))


def _least_squares(
    tone: np.ndarray, delta: np.ndarray, near: float, far: float, *, two_bins: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return minimum-variance weights (3, m) on three bins for a small change of delta.

    The weights annihilate a change of amplitude and respond with 1 to a change of delta, for a
    centre bin of 1: u = C^-1 G (G' C^-1 G)^-1 (0, 1)', G = (tone, its slope), with the noise
    covariance C. The standard error is (m,) [bins], at a centre bin of one sigma.
    """
    slope = np.gradient(tone, delta, axis=1)
    used = slice(1 if two_bins else 0, 3)
    covariance = np.array([[1, near, far], [near, 1, near], [far, near, 1]])[used, used]
    inverse = np.linalg.inv(covariance + 1e-12 * np.eye(len(covariance)))
    scale = np.maximum(tone[1], 1e-3 * tone[1, 0])
    g = np.stack([tone[used] / scale, slope[used] / scale], axis=-1).swapaxes(0, 1)
    solution = np.linalg.pinv(g.mT @ inverse @ g, hermitian=True)[:, :, 1]
    weight = np.zeros_like(tone)
    weight[used] = (inverse @ g @ solution[:, :, None])[:, :, 0].T
    return weight, np.sqrt(np.maximum(solution[:, 1], 0.0))


def _widening(window: Window, fft_size: int, tables: Interpolator) -> np.ndarray:
    """Return the position error over the variance of a narrow Gaussian spread, by |delta| (m,).

    The spread is represented by three lines of weights 1/6, 2/3, 1/6, which has its moments up to
    the fifth.
    """
    place = np.linspace(0.0, 1.0, _WIDENED)
    power = np.zeros((3, _WIDENED))
    for step, weight in ((-math.sqrt(3), 1 / 6), (0.0, 2 / 3), (math.sqrt(3), 1 / 6)):
        delta = place + step * _NARROW
        tone = _tone(window, fft_size, np.abs(delta))
        power += weight * np.where(delta < 0, tone[::-1], tone) ** 2
    found = np.array([sub_bin(a, b, c, tables) for a, b, c in np.sqrt(power).T])
    every = np.linspace(0.0, 1.0, _STEPS + 1)
    return np.interp(every, place, np.abs(found - place)) / _NARROW**2


def _mixing(near: float, far: float) -> tuple[float, float, float, float]:
    """Return the Cholesky factors m0 .. m3 of the noise covariance of bins 0, +1, -1."""
    rest = math.sqrt(max(1 - near**2, 0.0))
    across = (far - near**2) / rest if rest > 0 else 0.0
    return near, rest, across, math.sqrt(max(1 - near**2 - across**2, 0.0))


@njit(cache=True, error_model="numpy", borrows=True)
def sub_bin(below, centre, above, tables):
    """Estimate a tone's offset from the centre bin [bins, -1 .. 1] from three magnitudes."""
    position, weight = tables.position, tables.weight
    larger, lesser = max(below, above), min(below, above)
    if not larger > 0.0:
        return 0.0
    if tables.measure == THREE_BINS:
        value = (larger - lesser) / (lesser + 2.0 * centre + larger)
    else:
        value = larger / (centre + larger)
    delta = _at(position, (value - tables.low) / tables.step)
    if tables.measure == THREE_BINS and centre > 0.0:
        place = delta * (position.size - 1)
        change = lesser * _at(weight[0], place) + larger * _at(weight[2], place)
        delta = min(max(delta + _at(weight[1], place) + change / centre, -1.0), 1.0)
    return delta if above >= below else -delta


@njit(cache=True, error_model="numpy", borrows=True)
def _at(values, place):
    """Linear interpolation in a table at a fractional index, which is clipped to the table."""
    place = min(max(place, 0.0), values.size - 1.0)
    i = min(int(place), values.size - 2)
    return values[i] + (place - i) * (values[i + 1] - values[i])


@njit(cache=True, error_model="numpy", borrows=True)
def sub_bin_error(delta, ratio, tables):
    """Return the standard error of :func:`sub_bin` [bins], at most 1/2.

    ``delta``: estimated position [bins]; ``ratio``: magnitude of the centre bin over sigma.
    """
    if not ratio > 0.0:
        return 0.5
    return min(_at(tables.error, abs(delta) * (tables.error.size - 1)) / ratio, 0.5)


def drift_error(delta: np.ndarray, drift: np.ndarray, window: Window, fft_size: int) -> np.ndarray:
    """Return the error of :func:`sub_bin` [bins] for a tone that drifts within the record.

    The tone lies ``delta`` bins from the centre bin at the record's middle, and moves at a constant
    rate by ``drift`` bins in all.
    """
    shift = RegularGridInterpolator(
        (_DRIFTS, _DRIFTING_PLACES), _drift_shifts(window, fft_size), bounds_error=False
    )
    delta, drift = np.broadcast_arrays(np.abs(delta), drift)
    place = np.clip(delta, 0.0, _DRIFTING_PLACES[-1]), np.clip(drift, _DRIFTS[0], _DRIFTS[-1])
    return np.asarray(np.minimum(shift(place[::-1]) * drift * drift, drift / 2))


_DRIFTS = np.array([0.5, 1.0, 2.0, 4.0])
_DRIFTING_PLACES = np.linspace(0.0, 1.0, 17)
"""Drifts of a tone within the record, and its places at the record's middle, in the tables
[bins]."""


@lru_cache(maxsize=32)
def _drift_shifts(window: Window, fft_size: int) -> np.ndarray:
    """Tabulate the position error over the square of a tone's drift [1/bins], (drifts, places)."""
    w, tables = samples(window.name, window.length), interpolator(window, fft_size)
    middle = np.arange(w.size) / w.size - 0.5
    found = np.empty((_DRIFTS.size, _DRIFTING_PLACES.size))
    for i, drift in enumerate(_DRIFTS):
        moving = w * np.exp(1j * np.pi * drift * w.size / fft_size * middle**2)
        for j, place in enumerate(_DRIFTING_PLACES):
            magnitudes = [
                abs((moving * phasors((k - place) / fft_size, w.size)).sum()) for k in (-1, 0, 1)
            ]
            estimate = sub_bin(magnitudes[0], magnitudes[1], magnitudes[2], tables)
            found[i, j] = abs(estimate - place) / drift**2
    return found


_LATE_PLACES = 65
"""Number of places 0 .. 1 bin in the tables of late echoes."""
_LATE_SHARES = np.concatenate([np.arange(0.0, 0.8, 0.02), np.arange(0.8, 0.985, 0.01)])
"""Fractions of the record without an echo in the tables of late echoes."""
_LEAST_SLOPE = 0.05
_STEP = 1e-4


class LateEcho(NamedTuple):
    """Correction of positions between bins for echoes that arrive after the record has begun."""

    shift: np.ndarray
    """Shift to add to the estimated position [bins]."""
    wider: np.ndarray
    """Factor on the standard error of :func:`sub_bin_error`."""


def late_echo(delta: np.ndarray, lacking: np.ndarray, window: Window, fft_size: int) -> LateEcho:
    """Return the correction of :func:`sub_bin` for an echo that misses the record's first samples.

    Parameters
    ----------
    delta
        Position that :func:`sub_bin` gives, relative to the centre bin [bins].
    lacking
        Number of samples at the record's start without an echo.
    """
    shift, wider = _late_tables(window, fft_size)
    delta, share = np.broadcast_arrays(delta, np.asarray(lacking) / window.length)
    at = np.clip(share, 0.0, _LATE_SHARES[-1]), np.minimum(np.abs(delta), 1.0)
    places = _LATE_SHARES, np.linspace(0.0, 1.0, _LATE_PLACES)
    own_shift, own_width = (
        RegularGridInterpolator(places, table, bounds_error=False)(at) for table in (shift, wider)
    )
    late = share > 0
    return LateEcho(np.where(late, np.sign(delta) * own_shift, 0.0), np.where(late, own_width, 1.0))


@lru_cache(maxsize=32)
def _late_tables(window: Window, fft_size: int) -> tuple[np.ndarray, np.ndarray]:
    """Tabulate shift [bins] and error factor, (shares, places), for :func:`late_echo`."""
    w, tables = samples(window.name, window.length), interpolator(window, fft_size)
    first = np.minimum(np.rint(_LATE_SHARES * w.size).astype(int), w.size - 2)
    place = np.linspace(0.0, 1.0, _LATE_PLACES)
    tone = np.empty((first.size, place.size, 3), complex)
    for j, delta in enumerate(place):
        for k in (-1, 0, 1):
            terms = w * phasors((k - delta) / fft_size, w.size)
            tone[:, j, k + 1] = np.cumsum(terms[::-1])[::-1][first]
    turns = np.arange(w.size) / fft_size
    near, far = ((w**2 * np.exp(-2j * np.pi * d * turns)).sum() / window.energy for d in (1, 2))
    noise = np.array(
        [[1, near.conjugate(), far.conjugate()], [near, 1, near.conjugate()], [far, near, 1]]
    )
    shift, wider = np.zeros((2, first.size, place.size))
    for i in range(first.size):
        size = np.abs(tone[i])
        scale = np.maximum(size[:, 1:2], 1e-300)
        phase, size = tone[i] / np.maximum(size, 1e-300), size / scale
        read = np.array([sub_bin(*row, tables) for row in size])
        read = np.maximum.accumulate(np.maximum(read, 0.0))
        slope = np.maximum(np.gradient(read, place), _LEAST_SLOPE)
        rises = np.empty(size.shape)
        for k in range(3):
            less, more = size.copy(), size.copy()
            less[:, k] -= _STEP
            more[:, k] += _STEP
            for j in range(place.size):
                rises[j, k] = (sub_bin(*more[j], tables) - sub_bin(*less[j], tables)) / (2 * _STEP)
        weight = rises * phase
        variance = np.einsum("jk,kl,jl->j", weight.conj(), noise, weight).real
        error = np.sqrt(np.maximum(variance, 0.0)) / slope
        if tables.measure == TWO_BINS:  # on a bin either neighbour may be the larger one
            error[0] = error[1]
        # Of a whole echo's error at the place that is read, by which it is stated.
        whole = np.interp(read, np.linspace(0, 1, tables.error.size), tables.error)
        distinct = np.append(True, np.diff(read) > 1e-9)
        shift[i] = np.interp(place, read[distinct], place[distinct]) - place
        wider[i] = np.interp(place, read[distinct], (error / whole)[distinct])
    return shift, wider


@njit(cache=True, error_model="numpy", borrows=True)
def spread_error(delta, spread, power, tables):
    """Return the error of :func:`sub_bin` [bins] for lines that spread about their mean.

    Parameters
    ----------
    delta
        Position relative to the centre bin [bins].
    spread
        Standard deviation of the lines [bins].
    power
        True if the lines add as powers. If they add as amplitudes they may cancel, and the error is
        the whole spread.
    """
    if not power:
        return spread
    place = abs(delta) * (tables.widening.size - 1)
    return min(_at(tables.widening, place) * spread * spread, spread)
