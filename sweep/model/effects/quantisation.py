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
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.change import Change
from sweep.model.effects.effect import Effect, Parameter, Scene
from sweep.model.effects.span import Span, monotone
from sweep.model.preparation import Shots

if TYPE_CHECKING:
    from sweep.model.effects.block import Block


_BITS = "instrument.processing.bits"
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


def bound(block: "Block") -> Change | None:
    """Change by rounding, without clipping; the threshold is set on it."""
    bits = block[_BITS]
    if not block.has(_BITS):
        return None
    lsb = monotone(
        step, falling=("bits",), full_scale=block["instrument.processing.full_scale"], bits=bits
    )
    magnitude = block.amplitude.low * block.deviation.low
    change = rounding_change(
        step=lsb, noise_variance=block.noise_variance, magnitude=magnitude,
        window_sum=block.window.sum,
    )  # fmt: skip
    if np.any(bits.low <= 0):  # no steps at all, in some points
        least, most = change.noise
        least = np.where(np.less_equal(bits.low, 0), np.minimum(least, 1.0), least)
        change = change._replace(noise=(least, most))
    return change


def rounding_change(
    *, step: Span, noise_variance: Span, magnitude: ArrayLike, window_sum: float
) -> Change:
    """Change by steps of a size.

    The error's mean given the signal is at most d = lsb/pi sum q^(m^2)/m in any sample, and never
    above lsb/2, so it adds at most d sum(w) to a bin. The variance of a sample is the noise's,
    with lsb^2/12, and at most the series above off that; and between (s - lsb/2)^2 and
    (s + lsb/2)^2, as an error within lsb/2 has no more deviation than that. With samples of
    noise independent, a bin's variance is a weighted mean of the samples'.

    Parameters
    ----------
    step : Span
        lsb [V].
    noise_variance : Span
        Of the voltage before rounding [V^2], > 0.
    magnitude : array_like
        |X| of the detecting bin [V] at the least, >= 0, in the convention of X = sum w x.
    window_sum : float
        sum(w).
    """
    s, lsb = noise_variance.sqrt(), step.high
    exponent = -2 * (math.pi * s.low / np.maximum(lsb, 1e-100)) ** 2
    plain, once, twice = (_series(exponent, power) for power in (0, 1, 2))
    mean_error = np.minimum(lsb / 2, lsb / math.pi * once)
    added = mean_error * window_sum / np.maximum(magnitude, _SMALLEST)
    ratio, least_ratio = lsb / s.low, step.low / s.high
    spread = 4 * plain + (ratio / math.pi) ** 2 * twice
    low = np.maximum(
        1 + least_ratio**2 / 12 - spread - (mean_error / s.low) ** 2,
        np.maximum(1 - ratio / 2, 0.0) ** 2,
    )
    high = np.minimum(1 + ratio**2 / 12 + spread, (1 + ratio / 2) ** 2)
    return Change(noise=(np.maximum(low, _SMALLEST), high), added=added)


def _series(exponent: np.ndarray, power: int) -> np.ndarray:
    """Upper bound on the sum over m >= 1 of q^(m^2) / m^power, q = exp(exponent) < 1.

    Eight terms, and for all beyond a geometric series: q^(m^2) <= q^81 q^(18 (m - 9)).
    """
    total = sum(np.exp(m * m * exponent) / m**power for m in range(1, _TERMS + 1))
    first = _TERMS + 1
    with np.errstate(divide="ignore"):
        rest = np.exp(first**2 * exponent) / -np.expm1(2 * first * exponent) / first**power
    return np.asarray(total + rest)


def act(shots: Shots, scene: Scene) -> Shots:
    """White noise of lsb^2/12, where the ADC has a number of bits."""
    bits = np.asarray(scene.parameters[_BITS], float)
    lsb = step(full_scale=scene.parameters["instrument.processing.full_scale"], bits=bits)
    noise = {"quantisation": np.where(bits > 0, variance(step=lsb), 0.0)}
    return replace(shots, noise_sources=shots.noise_sources | noise)


EFFECT = Effect(
    name="quantisation",
    about="the ADC's steps",
    stage="noise",
    bound=bound,
    act=act,
    parameters=(
        Parameter(
            path=_BITS,
            about="Effective number of bits of the ADC; 0 for one without steps",
            default=0.0,
            example="12",
            at_least="0",
            at_most="64",
        ),
    ),
)
