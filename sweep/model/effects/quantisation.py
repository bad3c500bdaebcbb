"""Quantisation: the ADC rounds a voltage to steps of lsb = 2 V / 2^n within -V .. V.

Where the noise spans a step or so, the rounding error is white, independent of the signal and of
variance lsb^2/12, which adds to the noise at the ADC [Widrow and Kollar, Quantization Noise,
2008, ch. 4, 9]. It is a voltage: neither the receiver's gain nor its noise figure acts on it.

How far from that it can be follows from the Fourier series of the error e of a voltage x with
Gaussian noise n of deviation s on it, with q = exp(-2 pi^2 s^2 / lsb^2) and u = 2 pi x / lsb:

    E[e]                = lsb/pi     sum_m  (+-1)  sin(m u) / m    q^(m^2)
    2 Cov[n, e] / s^2   = 4          sum_m  (+-1)  cos(m u)        q^(m^2)
    E[e^2]              = lsb^2/12 + lsb^2/pi^2 sum_m (+-1) cos(m u) / m^2  q^(m^2)

(the second by Stein's lemma). q is 2.7e-9 for s = lsb and 0.7 % for s = lsb/2. Clipping is an
effect of its own (saturation).
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.change import Change

_TERMS = 8
_SMALLEST = 1e-30
"""Stands for a factor of which no more is known than that it is positive."""


def step(*, full_scale: ArrayLike, bits: ArrayLike) -> np.ndarray:
    """Voltage of one step, lsb [V].

    Parameters
    ----------
    full_scale : array_like
        Largest voltage V [V] that does not clip, to either side; > 0.
    bits : array_like
        Bits n, 1 or more; the effective number of bits, which need not be whole, makes the noise
        that of a real ADC.
    """
    return 2 * np.asarray(full_scale, float) * 2.0 ** -np.asarray(bits, float)


def variance(*, step: ArrayLike) -> np.ndarray:
    """Variance lsb^2/12 [V^2] that rounding adds at the ADC."""
    return np.asarray(step, float) ** 2 / 12


def truth_quantise(voltage: np.ndarray, *, full_scale: float, bits: int) -> np.ndarray:
    """Record as the ADC gives it: 2^bits levels, each in the middle of its step, the ends held."""
    lsb = 2 * full_scale / 2**bits
    code = np.clip(np.floor(voltage / lsb), -(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    return (code + 0.5) * lsb


def bound(
    *,
    step: ArrayLike,
    noise_variance: ArrayLike,
    magnitude: ArrayLike,
    window_sum: ArrayLike,
) -> Change:
    """Change by rounding, without clipping; the threshold is set on it.

    The error's mean given the signal is at most d = lsb/pi sum q^(m^2)/m in any sample, and never
    above lsb/2, so it adds at most d sum(w) to a bin. The variance of a sample is the noise's,
    with lsb^2/12, and at most the series above off that; and between (s - lsb/2)^2 and
    (s + lsb/2)^2, as an error within lsb/2 has no more deviation than that. With samples of
    noise independent, a bin's variance is a weighted mean of the samples'.

    Parameters
    ----------
    step : array_like
        lsb [V], (n,) or scalar, as all.
    noise_variance : array_like
        Of the voltage before rounding [V^2], > 0.
    magnitude : array_like
        |X| of the detecting bin [V], >= 0, in the convention of X = sum w x.
    window_sum : array_like
        sum(w).
    """
    lsb, s = np.asarray(step, float), np.sqrt(np.asarray(noise_variance, float))
    exponent = -2 * (math.pi * s / np.maximum(lsb, 1e-100)) ** 2
    plain, once, twice = (_series(exponent, power) for power in (0, 1, 2))
    mean_error = np.minimum(lsb / 2, lsb / math.pi * once)
    with np.errstate(divide="ignore"):
        relative = mean_error * np.asarray(window_sum, float) / np.asarray(magnitude, float)
    signal = (np.maximum(1 - relative, _SMALLEST), np.minimum(1 + relative, 1 / _SMALLEST))
    ratio = lsb / s
    white = 1 + ratio**2 / 12
    spread = 4 * plain + (ratio / math.pi) ** 2 * twice
    low = np.maximum(white - spread - (mean_error / s) ** 2, np.maximum(1 - ratio / 2, 0.0) ** 2)
    high = np.minimum(white + spread, (1 + ratio / 2) ** 2)
    return Change(signal=signal, noise=(np.maximum(low, _SMALLEST), high))


def _series(exponent: np.ndarray, power: int) -> np.ndarray:
    """Upper bound on the sum over m >= 1 of q^(m^2) / m^power, q = exp(exponent) < 1.

    Eight terms, and for all beyond a geometric series: q^(m^2) <= q^81 q^(18 (m - 9)).
    """
    total = sum(np.exp(m * m * exponent) / m**power for m in range(1, _TERMS + 1))
    first = _TERMS + 1
    with np.errstate(divide="ignore"):
        rest = np.exp(first**2 * exponent) / -np.expm1(2 * first * exponent) / first**power
    return np.asarray(total + rest)
