"""Reflectance laws: light scattered back along the beam, per steradian and unit reflectance."""

import math

import numpy as np

LAWS = ("thesis", "lambert")


def backscatter(law: str, cos_incidence: np.ndarray) -> np.ndarray:
    """Backscattered fraction per steradian of a surface of reflectance 1 [1/sr].

    Parameters
    ----------
    law : str
        ``thesis``: the diffuse law of [T 4.4], 1/(2 pi) whatever the incidence.
        ``lambert``: cos(incidence)/pi.
    cos_incidence : ndarray
        Cosine of the incidence angle, 0..1.
    """
    if law == "thesis":
        return np.full_like(cos_incidence, 0.5 / math.pi)
    if law == "lambert":
        return cos_incidence / math.pi
    raise ValueError(f"no reflectance law {law!r}: choose from {', '.join(LAWS)}")
