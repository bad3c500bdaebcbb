"""The air between lidar and target: how much of it dims the light, and over which path.

The extinction coefficient alpha [1/m] is a table over height above the ground. Between two
heights it goes as an exponential (as a straight line where one end is 0), below the first it
stays, above the last there is none. An exponential atmosphere so is a table of two rows, and its
optical depth comes out in closed form. The path is straight and the ground level, which holds for
paths short against a planet's radius.

Sources of the tables:

- Earth: Koschmieder's law with the wavelength exponent of Kruse, McGlauchlin and McQuistan
  (Elements of Infrared Technology, 1962) as revised by Kim, McArthur and Korevaar (Proc. SPIE
  4214, 2001) below 6 km; visibility 23 km (clear) and 5 km (haze); aerosol scale height 1.2 km
  (Elterman, AFCRL-68-0153, 1968). Molecules add less than 2e-7/m at 1.55 um.
- Mars: well-mixed dust of scale height 11 km (Conrath, Icarus 24, 1975); optical depths 0.5 (a
  usual season), 1 and 5 (a global storm), after the record of Lemmon et al., Icarus 251, 2015, at
  0.88 um. Grains of 1.5 um dim 1.55 um alike to some 10 %.
- A dust layer raised from the ground, by a landing say, is :func:`layer`.
- The Moon has no air: what the air does is absent.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.effect import Parameter

_LEVEL = 1e-9
"""Difference in height [m] given to level paths, about their middle, so that there is a mean."""


class Profile(NamedTuple):
    """Extinction over height, as a table."""

    height: tuple[float, ...]
    """Heights above the ground [m], rising; twice the same for a step."""
    extinction: tuple[float, ...]
    """Extinction coefficient at each [1/m], >= 0."""


def exponential(*, surface_extinction: float, scale_height: float) -> Profile:
    """Atmosphere whose extinction [1/m] falls by e over each scale height [m], 40 of them high."""
    top = 40.0
    return Profile(
        (0.0, top * scale_height), (surface_extinction, surface_extinction * math.exp(-top))
    )


def layer(*, optical_depth: float, depth: float) -> Profile:
    """Even layer on the ground, of this optical depth seen from straight above, `depth` m high."""
    return Profile((0.0, depth), (optical_depth / depth, optical_depth / depth))


def visibility_extinction(*, visibility: ArrayLike, wavelength: ArrayLike) -> np.ndarray:
    """Extinction [1/m] of haze from the visibility [m] (2 % contrast at 0.55 um), Kruse and Kim.

    3.912/V (wavelength / 0.55 um)^-q with q = 1.6 above 50 km, 1.3 above 6 km, 0.16 V + 0.34
    above 1 km, V - 0.5 above 0.5 km (V in km), 0 in fog.
    """
    v = np.asarray(visibility, float)
    km = v / 1e3
    q = np.select(
        [km > 50, km > 6, km > 1, km > 0.5], [1.6, 1.3, 0.16 * km + 0.34, km - 0.5], default=0.0
    )
    return -math.log(0.02) / v * (np.asarray(wavelength, float) / 0.55e-6) ** -q


def _haze(visibility: float) -> Profile:
    surface = visibility_extinction(visibility=visibility, wavelength=1.55e-6)
    return exponential(surface_extinction=float(surface), scale_height=1.2e3)


def _dust(optical_depth: float) -> Profile:
    return exponential(surface_extinction=optical_depth / 11e3, scale_height=11e3)


PROFILES = {
    "earth_clear": _haze(23e3),
    "earth_haze": _haze(5e3),
    "mars_clear": _dust(0.5),
    "mars_dusty": _dust(1.0),
    "mars_storm": _dust(5.0),
}


def optical_depth(
    profile: Profile, *, start_height: ArrayLike, end_height: ArrayLike, range: ArrayLike
) -> np.ndarray:
    """Optical depth of a straight path, one way.

    Parameters
    ----------
    start_height, end_height : array_like
        Heights of its ends above the ground [m]; (n,) or scalar, as all.
    range : array_like
        Its length [m], at least the difference of heights.
    """
    ends = np.broadcast_arrays(np.asarray(start_height, float), np.asarray(end_height, float))
    low, high = np.minimum(*ends), np.maximum(*ends)
    level = np.maximum(_LEVEL - (high - low), 0.0) / 2
    low, high = low - level, high + level
    bottoms = (-np.inf, *profile.height[:-1])
    below = (profile.extinction[0], *profile.extinction[:-1])
    total = np.zeros(low.shape)
    for z0, z1, a0, a1 in zip(bottoms, profile.height, below, profile.extinction, strict=True):
        start, end = np.clip(low, z0, z1), np.clip(high, z0, z1)
        total += (end - start) * _mean_extinction(start, end, z0, z1, a0, a1)
    return np.asarray(total / (high - low) * np.asarray(range, float))


def transmission(
    profile: Profile, *, start_height: ArrayLike, end_height: ArrayLike, range: ArrayLike
) -> np.ndarray:
    """Transmission T = exp(-tau) of a path, one way, 0..1; parameters of :func:`optical_depth`."""
    depth = optical_depth(profile, start_height=start_height, end_height=end_height, range=range)
    return np.exp(-depth)


def _mean_extinction(
    start: np.ndarray, end: np.ndarray, z0: float, z1: float, a0: float, a1: float
) -> np.ndarray | float:
    """Mean of the extinction between two heights within one row of the table."""
    if a0 == a1 or z0 == z1 or not math.isfinite(z0):
        return a0
    if a0 > 0 and a1 > 0:
        rate = math.log(a1 / a0) / (z1 - z0)
        x = rate * (end - start)
        growth = np.where(x == 0, 1.0, np.expm1(x) / np.where(x == 0, 1.0, x))
        return np.asarray(a0 * np.exp(rate * (start - z0)) * growth)
    return np.asarray(a0 + (a1 - a0) * ((start + end) / 2 - z0) / (z1 - z0))


PATH_ELEVATION = "path.elevation"
"""Where a scene gives it: angle of the beam below the horizon [rad], shot by shot."""

PARAMETERS = (
    Parameter(
        path="atmosphere.profile",
        about="Extinction over height: none, one of the tables, an exponential one, an even layer",
        default="none",
        options=("none", *PROFILES, "exponential", "layer"),
    ),
    Parameter(
        path="atmosphere.extinction",
        about="Extinction coefficient on the ground, of the profiles exponential and layer",
        si_unit="1/m",
        default=0.0,
        example="1e-4 1/m",
        at_least="0 1/m",
        at_most="1e9 1/m",
        category=True,
    ),
    Parameter(
        path="atmosphere.depth",
        about="Scale height of the profile exponential, depth of the profile layer",
        si_unit="m",
        default=1e3,
        example="1 km",
        at_least="1 um",
        at_most="1e15 m",
        category=True,
    ),
    Parameter(
        path="atmosphere.path",
        about="Whether the beam slants down at the grazing angle, or runs level over the ground",
        default="slant",
        options=("slant", "level"),
    ),
    Parameter(
        path="atmosphere.target_height",
        about="Height of the target above the ground that profiles count from",
        si_unit="m",
        default=0.0,
        example="10 m",
        at_least="-20 km",
        at_most="1000 km",
    ),
)


def profile_of(p: Mapping[str, np.ndarray]) -> Profile | None:
    """Extinction over height for points of one category; None without an atmosphere."""
    name = str(p["atmosphere.profile"])
    surface, depth = float(p["atmosphere.extinction"]), float(p["atmosphere.depth"])
    if name == "exponential":
        return exponential(surface_extinction=surface, scale_height=depth)
    if name == "layer":
        return layer(optical_depth=surface * depth, depth=depth)
    return PROFILES.get(name)


def path_heights(p: Mapping[str, np.ndarray], range: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heights of lidar and target above the ground [m], (n,) each."""
    target = np.asarray(p["atmosphere.target_height"], float) + np.zeros_like(range)
    if str(p["atmosphere.path"]) == "level":
        return target, target
    elevation = p.get(PATH_ELEVATION, p.get("target.grazing_angle"))
    return target + range * np.sin(np.asarray(elevation, float)), target
