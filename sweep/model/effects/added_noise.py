"""What noise of one more source changes: the common part of the effects that only add noise."""

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.constants import ELEMENTARY_CHARGE
from sweep.model.effects.change import Change


def shot_noise(
    *,
    power: ArrayLike,
    apd_gain: ArrayLike,
    excess_noise_factor: ArrayLike,
    responsivity: ArrayLike,
    electrical_bandwidth: ArrayLike,
) -> np.ndarray:
    """Current variance 2 q M^2 F Re P B_e [A^2] of light of power P [W] on the detector.

    As in PHYSICS section 4, referred to the detector and before the factor 2 F_RF by which a
    heterodyne receiver multiplies all current noise. Arguments (n,) or scalars, all >= 0.
    """
    gain = np.asarray(apd_gain, float) ** 2 * np.asarray(excess_noise_factor, float)
    current = np.asarray(responsivity, float) * np.asarray(power, float)
    return 2 * ELEMENTARY_CHARGE * gain * current * np.asarray(electrical_bandwidth, float)


def change(
    *,
    least: ArrayLike,
    largest: ArrayLike,
    noise_variance: ArrayLike,
    threshold_follows: bool = True,
) -> Change:
    """Change by a further source whose variance lies between two values.

    Parameters
    ----------
    least, largest : array_like
        Variance that the source adds, (n,) or scalar, >= 0.
    noise_variance : array_like
        Variance of all others, > 0, in the same unit and at the same place in the chain: the
        ratio is the same for currents, and for volts at the ADC if it holds no ADC noise.
    threshold_follows : bool
        Whether the source is there without an echo, so that the threshold is set on it.
    """
    others = np.asarray(noise_variance, float)
    factors = tuple(1 + np.asarray(v, float) / others for v in (least, largest))
    return Change(noise=(factors[0], factors[1]), threshold_follows=threshold_follows)
