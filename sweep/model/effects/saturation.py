"""Saturation: a record beyond the ADC's full scale is clipped.

A beat of amplitude A with Gaussian noise of deviation s is cut at +-V. As a memoryless law on a
sine it leaves [Blachman, IRE Trans. Inf. Theory 10 (1964) 162, in the manner of Bussgang]

- the line, by the gain  2/A <m(A sin t) sin t>, where m(x) is the mean of x + n once clipped and
  < > the mean over the phase t;
- odd harmonics, amplitudes 2 <m(A sin t) sin(k t)>, folded at Nyquist: the distortion power;
- noise, white still, by the mean of the clipped noise's variance over s^2.

For s -> 0 and r = V/A < 1 the gain is 2/pi (asin r + r sqrt(1 - r^2)) and noise passes for the
share 2/pi asin(r) of the time.

The record is taken for one sine of constant amplitude; a footprint that spreads over bins makes
an envelope that changes over the record, which clips less than its peak says.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from sweep.model.effects.change import Change

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)
_CUTS = np.array([-8.0, 0.0, 8.0])
"""Where the quarter of a period is cut, in deviations of the noise off full scale: the integrands
are smooth in between."""
_SMALLEST = 1e-30
"""Stands for a factor of which no more is known than that it is positive."""


class Clipping(NamedTuple):
    """What clipping makes of a sine with noise, (n,) each."""

    signal_gain: np.ndarray
    """Factor on the line's amplitude, 0..1."""
    noise_gain: np.ndarray
    """Factor on the noise variance, 0..1."""
    distortion: np.ndarray
    """Mean square of all harmonics together [V^2]."""


def clipping(*, amplitude: ArrayLike, deviation: ArrayLike, full_scale: ArrayLike) -> Clipping:
    """Gain of line and noise, and power of the harmonics.

    Parameters
    ----------
    amplitude : array_like
        Of the beat at the ADC [V], > 0; (n,) or scalar, as all.
    deviation : array_like
        Of the noise at the ADC [V], > 0.
    full_scale : array_like
        Largest voltage that does not clip, to either side [V], > 0.
    """
    a, s, v = _columns(amplitude, deviation, full_scale)
    phase, weight = _phases(a, s, v)
    sine = np.sin(phase)
    loss, spread = _lost(a * sine, s, v)
    taken = 2 * (weight * loss * sine).sum(axis=-1)  # off the line's amplitude
    gone = (weight * loss**2).sum(axis=-1)
    return Clipping(
        signal_gain=1 - taken / a[..., 0],
        noise_gain=(weight * spread).sum(axis=-1) / s[..., 0] ** 2,
        distortion=np.maximum(gone - taken**2 / 2, 0.0),
    )


def harmonic_amplitude(
    order: int, *, amplitude: ArrayLike, deviation: ArrayLike, full_scale: ArrayLike
) -> np.ndarray:
    """Signed amplitude [V] of the harmonic sin(order t) of a clipped A sin t, (n,).

    Odd orders up to 31; there are no even ones. Other parameters as of :func:`clipping`.
    """
    a, s, v = _columns(amplitude, deviation, full_scale)
    phase, weight = _phases(a, s, v)
    loss, _ = _lost(a * np.sin(phase), s, v)
    line = a[..., 0] if order == 1 else 0.0
    return np.asarray(line - 2 * (weight * loss * np.sin(order * phase)).sum(axis=-1))


def bound(
    *,
    peak: ArrayLike,
    deviation: ArrayLike,
    full_scale: ArrayLike,
    magnitude: ArrayLike,
    window_sum: ArrayLike,
) -> Change:
    """Change by clipping, whatever the envelope; the threshold is taken to stay.

    A sample loses at most, in the mean, what the highest does: d = peak - m(peak), so a bin at
    most d sum(w). Clipping contracts, so the variance of a sample never rises, and by the
    inequality of Cramer and Rao, Var f(n) >= (s E f')^2, it is at least the square of the chance
    that the highest sample is not clipped. Noise alone is taken to fit within full scale.

    Parameters
    ----------
    peak : array_like
        Highest |voltage| of the record without noise [V], or above: the sum of all amplitudes.
    deviation, full_scale : array_like
        As of :func:`clipping`.
    magnitude : array_like
        |X| of the detecting bin [V], >= 0, in the convention of X = sum w x.
    window_sum : array_like
        sum(w).
    """
    x, s, v = (np.asarray(value, float) for value in (peak, deviation, full_scale))
    loss, _ = _lost(x, s, v)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = loss * np.asarray(window_sum, float) / np.asarray(magnitude, float)
    relative = np.where(loss > 0, relative, 0.0)
    signal = (np.maximum(1 - relative, _SMALLEST), np.minimum(1 + relative, 1 / _SMALLEST))
    unclipped = ndtr((v - x) / s) - ndtr((-v - x) / s)
    noise = (np.maximum(unclipped**2, _SMALLEST), np.ones_like(unclipped))
    return Change(signal=signal, noise=noise, threshold_follows=False)


def _columns(*values: ArrayLike) -> tuple[np.ndarray, ...]:
    """Arrays of one shape with an axis for phases behind."""
    return tuple(a[..., None] for a in np.broadcast_arrays(*(np.asarray(v, float) for v in values)))


def _phases(a: np.ndarray, s: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Phases in a quarter of a period and weights whose sum is 1, (n, nodes) each."""
    inner = np.arcsin(np.clip((v + _CUTS * s) / a, 0.0, 1.0))
    ends = np.zeros(a.shape)
    cuts = np.concatenate([ends, inner, ends + math.pi / 2], axis=-1)
    half = np.diff(cuts)[..., None] / 2
    phase = (cuts[..., :-1, None] + half) + half * _NODES
    weight = half * _WEIGHTS / (math.pi / 2)
    shape = (*a.shape[:-1], -1)
    return phase.reshape(shape), weight.reshape(shape)


def _lost(x: np.ndarray, s: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean of what clipping takes off x + n, x >= 0, and the variance of what it leaves.

    In units of s, with ends a = (V - x)/s and b = (-V - x)/s: clipped noise is a above a, b below
    b. What is cut off above has the mean f(a) - a Q(a), below likewise.
    """
    a, b = (v - x) / s, (-v - x) / s
    density = [np.exp(-0.5 * z * z) / math.sqrt(2 * math.pi) for z in (a, b)]
    above, below = ndtr(-a), ndtr(b)
    cut = (density[0] - a * above) - (density[1] + b * below)
    square = a * a * above + b * b * below + (ndtr(a) - below) + b * density[1] - a * density[0]
    return s * np.maximum(cut, 0.0), s * s * np.maximum(square - cut * cut, 0.0)
