"""Signal shot noise: the echo's own light, which close by rivals the local oscillator's.

What it does is in :func:`sweep.model.noise.current_variances`: 2 q M^2 F Re P B_e of the whole
echo, which makes the rise of false alarms below some 5 m that [T 4.2] reports. Here is what
leaving it out can change, from the echo that one ray along the beam's axis would give.

On a plane at the grazing angle g a beamlet tilted by y towards the near side (small against 1)
has cos(incidence) = (sin g + y cos g) / sqrt(1 + x^2 + y^2) and R_0/R_b = cos(incidence) / sin g.
Its echo, w_b times the law's backscatter (const. or as cos(incidence)) times (R_0/R_b)^2, so lies
between the values at the footprint's near and far rim.
"""

import numpy as np
from numpy.typing import ArrayLike

from sweep.model import reflectance
from sweep.model.effects import added_noise
from sweep.model.effects.change import Change, Interval


def plane_backscatter(
    law: str, *, grazing_angle: ArrayLike, beam_divergence: ArrayLike, reach: float
) -> Interval:
    """Least and largest relative echo [1/sr] that a footprint on a plane can sum to, (n,) each.

    Parameters
    ----------
    law : str
        Reflectance law, see :func:`sweep.model.reflectance.backscatter`.
    grazing_angle : array_like
        Angle between axis and plane [rad], 0 < . <= pi/2.
    beam_divergence : array_like
        Full 1/e^2 angle [rad].
    reach : float
        Farthest beamlet from the axis in standard deviations, of
        :func:`sweep.model.footprint.beamlets`: 2.97 for 109 beamlets in a hexagon.
    """
    sine, cosine = (f(np.asarray(grazing_angle, float)) for f in (np.sin, np.cos))
    rim = reach / 4 * np.asarray(beam_divergence, float)
    near = np.minimum(sine + rim * cosine, 1.0)
    far = np.maximum(sine - rim * cosine, 0.0) / np.sqrt(1 + rim**2)
    least, largest = (
        reflectance.backscatter(law, cos_incidence) * (cos_incidence / sine) ** 2
        for cos_incidence in (far, near)
    )
    return least, largest


def bound(
    *,
    echo_power_scale: ArrayLike,
    backscatter: Interval,
    apd_gain: ArrayLike,
    excess_noise_factor: ArrayLike,
    responsivity: ArrayLike,
    electrical_bandwidth: ArrayLike,
    noise_variance: ArrayLike,
) -> Change:
    """Change by the echo's shot noise, which the threshold does not follow.

    Parameters
    ----------
    echo_power_scale : array_like
        Echo power [W] for a backscatter of 1/sr, :func:`sweep.model.link.echo_power_scale`.
    backscatter : interval
        Least and largest relative echo [1/sr], as of :func:`plane_backscatter`.
    apd_gain, excess_noise_factor, responsivity, electrical_bandwidth : array_like
        As for :func:`sweep.model.noise.current_variances`.
    noise_variance : array_like
        Current variance [A^2] of all other sources, before a heterodyne receiver's factor.
    """
    least, largest = (
        added_noise.shot_noise(
            power=np.asarray(echo_power_scale, float) * relative,
            apd_gain=apd_gain,
            excess_noise_factor=excess_noise_factor,
            responsivity=responsivity,
            electrical_bandwidth=electrical_bandwidth,
        )
        for relative in backscatter
    )
    return added_noise.change(
        least=least, largest=largest, noise_variance=noise_variance, threshold_follows=False
    )
