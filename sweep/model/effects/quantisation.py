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

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.effect import Effect, Parameter, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.preparation import Shots

_BITS = "instrument.processing.bits"


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


def size(points: Points) -> Size | None:
    """Rounding, without clipping; the threshold is set on it."""
    if not points.has(_BITS):
        return None
    bits = points[_BITS]
    lsb = step(full_scale=points["instrument.processing.full_scale"], bits=bits)
    return Size(noise=np.where(bits > 0, variance(step=lsb), 0.0) / points.noise_variance)


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
    size=size,
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
