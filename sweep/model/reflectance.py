"""Reflectance laws: light scattered back along the beam, per steradian and unit reflectance.

A surface of bidirectional reflectance f [1/sr] that fills a beam of power P at incidence i sends
the intensity f P cos(i) [W/sr] back along it: the beam spreads over 1/cos(i) of its cross-section
and the patch, seen from the beam, shrinks to cos(i) of itself again. So Lambert's f = rho/pi gives
rho cos(i)/pi.

Lommel and Seeliger's law is that of dark, porous ground (regolith), where light that has been
scattered once outshines all other [Hapke 1981; 2012, ch. 10]:

    f = w / (4 pi) / (cos i + cos e) * p(g) (1 + B(g))

with the single-scattering albedo w, the phase function p and the opposition surge B of shadows
that hide behind their grains. A lidar looks at the phase angle g = 0 and i = e, where f cos(i) is
w p(0) (1 + B(0)) / (8 pi) whatever the incidence: a ball of it shines as evenly as the full Moon.
"""

import math

import numpy as np

LAWS = ("thesis", "lambert", "lommel_seeliger")


def backscatter(law: str, cos_incidence: np.ndarray) -> np.ndarray:
    """Backscattered fraction per steradian of a surface of reflectance 1 [1/sr].

    Parameters
    ----------
    law : str
        ``thesis``: the diffuse law of [T 4.4], 1/(2 pi) whatever the incidence.
        ``lambert``: cos(incidence)/pi.
        ``lommel_seeliger``: 1/pi whatever the incidence; the reflectance is the normal albedo
        w p(0) (1 + B(0)) / 8 (single-scattering albedo, phase function, opposition surge), which
        at normal incidence is what Lambert's law means by it.
    cos_incidence : ndarray
        Cosine of the incidence angle, 0..1.

    Raises
    ------
    ValueError
        `law` is none of these.
    """
    if law == "thesis":
        return np.full_like(cos_incidence, 0.5 / math.pi)
    if law == "lambert":
        return cos_incidence / math.pi
    if law == "lommel_seeliger":
        return np.full_like(cos_incidence, 1 / math.pi)
    raise ValueError(f"no reflectance law {law!r}: choose from {', '.join(LAWS)}")
