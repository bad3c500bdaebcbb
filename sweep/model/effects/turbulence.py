"""Turbulent air: how strongly a path through it makes light twinkle.

The strength of turbulence C_n^2(h) gives the Rytov variance of a plane or a spherical wave over
the path, and this the variances of the logarithms of large and small eddies' factors, averaged
over an aperture, at any strength [Andrews and Phillips, Laser Beam Propagation through Random
Media, 2nd ed. 2005, ch. 9, 10; zero inner scale, infinite outer scale].
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

WAVES = ("plane", "spherical")

_ENDS = {"plane": (5 / 6, 0.0), "spherical": (5 / 6, 5 / 6)}
"""Powers of the distances to receiver and source in the integral over the path."""
_LARGE = {"plane": (0.65, 1.11), "spherical": (0.18, 0.56)}


class Turbulence(NamedTuple):
    """Profile of the refractive index's structure constant over height above the ground."""

    uniform: float = 0.0
    """Part that is the same at all heights [m^(-2/3)]: alone, a constant C_n^2."""
    surface: float = 0.0
    """Hufnagel and Valley's A [m^(-2/3)] on the ground, e-folding over 100 m: 1.7e-14."""
    wind: float = 0.0
    """Their rms wind speed aloft [m/s]: 21."""
    middle: float = 0.0
    """Their [m^(-2/3)] of e-folding height 1500 m: 2.7e-16."""


HUFNAGEL_VALLEY = Turbulence(surface=1.7e-14, wind=21.0, middle=2.7e-16)
"""The 5/7 model: at 0.5 um 5 cm of coherence and 7 urad of isoplanatic angle [Valley 1980]."""


class LogVariances(NamedTuple):
    """Variances of the logarithm of the irradiance by large and by small eddies, (n,) each."""

    large: np.ndarray
    small: np.ndarray


def structure_constant(turbulence: Turbulence, height: ArrayLike) -> np.ndarray:
    """C_n^2 [m^(-2/3)] at heights above the ground [m]; below the ground that on it."""
    h = np.maximum(np.asarray(height, float), 0.0)
    aloft = 0.00594 * (turbulence.wind / 27) ** 2 * (1e-5 * h) ** 10 * np.exp(-h / 1e3)
    middle = turbulence.middle * np.exp(-h / 1.5e3)
    return turbulence.uniform + aloft + middle + turbulence.surface * np.exp(-h / 100)


def rytov_variance(
    wave: str,
    turbulence: Turbulence,
    *,
    wavelength: ArrayLike,
    range: ArrayLike,
    start_height: ArrayLike,
    end_height: ArrayLike,
) -> np.ndarray:
    """Variance of the log irradiance of weak turbulence along a straight path, (n,).

    2.25 k^(7/6) integral of C_n^2 (L - z)^(5/6) [(z/L)^(5/6) for a spherical wave] over z from
    source to receiver; 1.23 and 0.50 C_n^2 k^(7/6) L^(11/6) in even turbulence. By a rule of
    Gauss and Jacobi, which holds the powers exactly; paths may span 20 km of height.

    Parameters
    ----------
    wave : str
        ``plane`` or ``spherical``.
    wavelength, range, start_height, end_height : array_like
        [m], (n,) or scalar; start is the wave's source.
    """
    share, weights = _rule(wave)
    h0, h1 = (np.asarray(h, float)[..., None] for h in (start_height, end_height))
    mean = (structure_constant(turbulence, h0 + (h1 - h0) * share) * weights).sum(axis=-1)
    k = 2 * math.pi / np.asarray(wavelength, float)
    return np.asarray(2.25 * k ** (7 / 6) * np.asarray(range, float) ** (11 / 6) * mean)


@lru_cache(maxsize=2)
def _rule(wave: str) -> tuple[np.ndarray, np.ndarray]:
    """Shares of the way from source to receiver and weights that hold the powers."""
    to_receiver, to_source = _ENDS[wave]
    x, weights = special.roots_jacobi(64, to_receiver, to_source)
    return (1 + x) / 2, weights / 2 ** (1 + to_receiver + to_source)


def log_variances(
    wave: str,
    *,
    rytov_variance: ArrayLike,
    wavelength: ArrayLike,
    range: ArrayLike,
    aperture: ArrayLike,
) -> LogVariances:
    """What large and small eddies make of the irradiance averaged over an aperture.

    exp(large + small) - 1 is the scintillation index: the Rytov variance for a point in weak
    turbulence, and 1 + 0.86 sigma_R^(-4/5) for a plane wave in strong. As it serves any strength
    the published fit averages too little over wide apertures: in weak turbulence it is 1.3 times
    Kolmogorov's integral where k D^2 / 4 L is 1, and 2 (plane) or 1.5 (spherical) where it is 10.

    Parameters
    ----------
    wave : str
        ``plane`` or ``spherical``.
    rytov_variance : array_like
        Of that wave, >= 0, (n,) or scalar, as all.
    wavelength, range, aperture : array_like
        [m]; the diameter of the aperture that averages, 0 for a point.
    """
    v = np.asarray(rytov_variance, float)
    k = 2 * math.pi / np.asarray(wavelength, float)
    d2 = k * np.asarray(aperture, float) ** 2 / (4 * np.asarray(range, float))
    strength = v**1.2  # sigma_R^(12/5)
    by_aperture, by_strength = _LARGE[wave]
    large = 0.49 * v / (1 + by_aperture * d2 + by_strength * strength) ** (7 / 6)
    small = 0.51 * v * (1 + 0.69 * strength) ** (-5 / 6)
    return LogVariances(large, small / (1 + 0.90 * d2 + 0.62 * d2 * strength))


def both_ways(
    turbulence: Turbulence,
    *,
    wavelength: ArrayLike,
    range: ArrayLike,
    lidar_height: ArrayLike,
    target_height: ArrayLike,
    aperture: ArrayLike,
    beam_divergence: ArrayLike,
) -> tuple[LogVariances, LogVariances]:
    """Log variances of the way out, averaged over the footprint, and back, over the aperture."""
    out = rytov_variance(
        "plane", turbulence, wavelength=wavelength, range=range,
        start_height=lidar_height, end_height=target_height,
    )  # fmt: skip
    back = rytov_variance(
        "spherical", turbulence, wavelength=wavelength, range=range,
        start_height=target_height, end_height=lidar_height,
    )  # fmt: skip
    footprint = np.asarray(aperture, float) + np.asarray(beam_divergence, float) * range
    return (
        log_variances(
            "plane", rytov_variance=out, wavelength=wavelength, range=range, aperture=footprint
        ),
        log_variances(
            "spherical", rytov_variance=back, wavelength=wavelength, range=range, aperture=aperture
        ),
    )
