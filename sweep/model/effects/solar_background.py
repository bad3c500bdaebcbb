"""Solar background: sunlight scattered into the receiver, as shot noise.

What it does is in :func:`sweep.model.noise.solar_power` and
:func:`sweep.model.noise.current_variances`; here is what leaving it out can change.
"""

from numpy.typing import ArrayLike

from sweep.model.effects import added_noise
from sweep.model.effects.change import Change


def bound(
    *,
    solar_power: ArrayLike,
    apd_gain: ArrayLike,
    excess_noise_factor: ArrayLike,
    responsivity: ArrayLike,
    electrical_bandwidth: ArrayLike,
    noise_variance: ArrayLike,
) -> Change:
    """Change by sunlight on the detector: exact, its share of the other noise.

    The threshold is set on it: the sun shines with and without an echo.

    Parameters
    ----------
    solar_power : array_like
        Sunlight on the detector [W], of :func:`sweep.model.noise.solar_power`.
    apd_gain, excess_noise_factor, responsivity, electrical_bandwidth : array_like
        As for :func:`sweep.model.noise.current_variances`.
    noise_variance : array_like
        Current variance [A^2] of all other sources, before a heterodyne receiver's factor.
    """
    variance = added_noise.shot_noise(
        power=solar_power,
        apd_gain=apd_gain,
        excess_noise_factor=excess_noise_factor,
        responsivity=responsivity,
        electrical_bandwidth=electrical_bandwidth,
    )
    return added_noise.change(least=variance, largest=variance, noise_variance=noise_variance)
