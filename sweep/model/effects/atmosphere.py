"""The air between lidar and target: it dims the light on its way, and sends some of it back.

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
- Mars: well-mixed dust of scale height 11 km (Conrath, Icarus 24, 1975). Optical depths are 0.5 (a
  usual season), 1 and 5 (a global storm), after the record of Lemmon et al., Icarus 251, 2015, at
  0.88 um. Grains of 1.5 um dim 1.55 um alike to some 10 %.
- Lidar ratios: haze 30 to 70 sr, Martian dust about 40 sr, water drops 18 sr.
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model import beam
from sweep.model.effects import noise_sources
from sweep.model.effects.effect import Effect, Parameter, Scene, Size, noisier
from sweep.model.effects.points import Points
from sweep.model.link import aperture_area
from sweep.model.preparation import LASER, TELESCOPE, Shots

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
    """Optical depth of a straight path `range` [m] long between two heights [m], one way."""
    ends = np.broadcast_arrays(np.asarray(start_height, float), np.asarray(end_height, float))
    low, high = np.minimum(*ends), np.maximum(*ends)
    # So high up that float64 knows no such difference, by what it does know.
    least = np.maximum(_LEVEL, 4 * np.spacing(np.maximum(np.abs(low), np.abs(high))))
    level = np.maximum(least - (high - low), 0.0) / 2
    low, high = low - level, high + level
    bottoms = (-np.inf, *profile.height[:-1])
    below = (profile.extinction[0], *profile.extinction[:-1])
    total = np.zeros(low.shape)
    for z0, z1, a0, a1 in zip(bottoms, profile.height, below, profile.extinction, strict=True):
        start, end = np.clip(low, z0, z1), np.clip(high, z0, z1)
        total += (end - start) * _mean_extinction(start, end, z0, z1, a0, a1)
    return np.asarray(total / (high - low) * np.asarray(range, float))


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
"""Angle of the beam below the horizon [rad] by shot; only of scenes."""


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


def _path(p: Mapping[str, np.ndarray], range: np.ndarray) -> dict[str, np.ndarray]:
    lidar, target = path_heights(p, range)
    return {"start_height": lidar, "end_height": target, "range": range}


def dim(shots: Shots, scene: Scene) -> Shots:
    """Echoes dimmed by T^2 [T 4.4], light from the ground, such as the sun's, by T."""
    air = profile_of(scene.parameters)
    if air is None:
        return shots
    t = np.exp(-optical_depth(air, **_path(scene.parameters, shots.range)))
    return replace(
        shots,
        echo_scale=shots.echo_scale * t**2,
        beat_scale=shots.beat_scale * (t**2 if shots.architecture == "direct" else t),
        ground_transmission=t,
    )


def dimming_size(points: Points) -> Size | None:
    """Loss of the echo by the air, and of the shot noise of light from the target."""
    air = profile_of(points.parameters)
    if air is None:
        return None
    t = np.exp(-optical_depth(air, **_path(points.parameters, points.range)))
    light = points.echo_noise
    if (sun := noise_sources.sun_size(points)) is not None:
        light = light + sun.noise
    # the threshold follows the sun's part and not the echo's: the worse is taken
    return Size(
        magnitude=1 - (t**2 if points.architecture == "direct" else t),
        noise=-(1 - t**2) * light / (1 + light),
        threshold_follows=False,
    )


EXTINCTION = Effect(
    name="extinction",
    about="air, haze and dust that dim the light",
    stage="light",
    size=dimming_size,
    act=dim,
    parameters=(
        Parameter(
            path="atmosphere.profile",
            about="Extinction over height: none, one of the tables, an exponential one, an even "
            "layer",
            default="none",
            options=("none", *PROFILES, "exponential", "layer"),
        ),
        Parameter(
            path="atmosphere.extinction",
            about="Extinction coefficient on the ground, of the profiles exponential and layer",
            example="1e-4 1/m",
            limits=("0 1/m", "1e9 1/m"),
            category=True,
        ),
        Parameter(
            path="atmosphere.depth",
            about="Scale height of the profile exponential, depth of the profile layer",
            default=1e3,
            example="1 km",
            limits=("1 um", "1e15 m"),
            si_unit="m",
            category=True,
        ),
        Parameter(
            path="atmosphere.path",
            about="Whether the beam slants down at the grazing angle, or runs level over the "
            "ground",
            default="slant",
            options=("slant", "level"),
        ),
        Parameter(
            path="atmosphere.target_height",
            about="Height of the target above the ground that profiles count from",
            example="10 m",
            limits=("-20 km", "1000 km"),
            si_unit="m",
        ),
    ),
)


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_FOLDS = (0.0, 1.0, 3.0, 7.0, 15.0, 40.0)
"""Cuts of a row of the table for the integral, in e-foldings of its extinction."""
_NEAR = (1.0, 2.0, 4.0, 10.0, 30.0, 100.0)
"""Cuts of the path for the integral, in units of r_0."""


def returned(
    profile: Profile,
    *,
    start_height: ArrayLike,
    end_height: ArrayLike,
    range: ArrayLike,
    near: ArrayLike,
) -> np.ndarray:
    """Integral over 0..R of alpha(r) T(r)^2 / (r^2 + r_0^2) dr [1/m^2], r_0 = D / Theta = `near`.

    A continuous beam has P_tx A tau_o / S times it sent back by the air to the detector [W], S the
    lidar ratio [sr]. The factor r^2 / (r^2 + r_0^2) is the overlap of a collimated beam with its
    own receiver. Nearer than r_0 a point's image is larger than the field of view. For a beam at
    the limit of diffraction, Theta = 4 lambda / (pi D), it is the coherent lidar's of Sonnenschein
    and Horrigan (Appl. Opt. 10, 1971, 1600, focus at infinity). By Gauss's rule over atan(r / r_0)
    between the rows of the profile that the path crosses, those cut where the extinction or the
    overlap has fallen; within 1e-8. Heights as of :func:`optical_depth`.
    """
    given = (np.asarray(value, float) for value in (start_height, end_height, range, near))
    h0, h1, far, near = (np.expand_dims(column, -1) for column in np.broadcast_arrays(*given))
    rise = h1 - h0
    crossed = (_cut_heights(profile) - h0) / np.where(rise == 0, np.inf, rise)
    inner = [np.clip(crossed, 0, 1) * far, np.minimum(np.asarray(_NEAR) * near, far)]
    cuts = np.sort(np.concatenate([np.zeros_like(far), *inner, far], axis=-1), axis=-1)
    angle = np.arctan(cuts / near)
    half = np.diff(angle)[..., None] / 2
    u = (angle[..., :-1, None] + half) + half * _NODES
    r = near[..., None] * np.tan(u)
    height = h0[..., None] + rise[..., None] * (r / far[..., None])
    depth = optical_depth(profile, start_height=h0[..., None], end_height=height, range=r)
    local = optical_depth(profile, start_height=height, end_height=height, range=1.0)
    total = (half * _WEIGHTS * local * np.exp(-2 * depth)).sum(axis=(-1, -2))
    return np.asarray(total / near[..., 0])


def _cut_heights(profile: Profile) -> np.ndarray:
    """Heights between which extinction is smooth and falls by a few e-foldings at most."""
    cuts = [profile.height[0]]
    rows = [*zip(profile.height, profile.extinction, strict=True)]
    for (z0, a0), (z1, a1) in itertools.pairwise(rows):
        folds = abs(math.log(a1 / a0)) if a0 > 0 and a1 > 0 else 0.0
        steps = [fold / folds for fold in _FOLDS if fold < folds]
        cuts += [z0 + step * (z1 - z0) if a1 < a0 else z1 - step * (z1 - z0) for step in steps]
        cuts.append(z1)
    return np.array(cuts)


def _light(p: Mapping[str, np.ndarray], integral: np.ndarray) -> np.ndarray:
    """Light [W] that the air sends back, from :func:`returned`."""
    collected = p[LASER + "power"] * aperture_area(beam.receiving_field(p)[0])
    collected = collected * p[TELESCOPE + "optical_efficiency"]
    return np.asarray(collected * integral / p["atmosphere.lidar_ratio"])


def scatter_back(shots: Shots, scene: Scene) -> Shots:
    """Shot noise of the light that the air sends back.

    Its beat with the local oscillator, from ever new grains, is spread over the bins from the
    nearest range to the target's and is left out; [T 3.3.1] counts it among the noise too.
    """
    p = scene.parameters
    air = profile_of(p)
    if air is None:
        return shots
    aperture, angle = beam.receiving_field(p)
    light = _light(p, returned(air, near=aperture / angle, **_path(p, shots.range)))
    return noisier(shots, backscatter_shot=np.asarray(shots.shot_noise_scale * light))


def backscatter_size(points: Points) -> Size | None:
    """Return an upper bound on backscatter; the threshold follows it.

    It is the lesser of two: the whole path with the air of its lower end, without extinction; or
    all the light that is lost on the path, sent back from the beam's near end.
    """
    p = points.parameters
    air = profile_of(p)
    if air is None:
        return None
    path = _path(p, points.range)
    aperture, angle = beam.receiving_field(p)
    lowest = np.minimum(path["start_height"], path["end_height"])
    near = aperture / angle
    local = optical_depth(air, start_height=lowest, end_height=lowest, range=1.0)
    even = local * np.arctan(points.range / near) / near
    most = np.minimum(even, -np.expm1(-2 * optical_depth(air, **path)) / 2 / near**2)
    return Size(noise=_light(p, most) * points.receiver.per_watt / points.noise_variance)


BACKSCATTER = Effect(
    name="backscatter",
    about="shot noise of light that the air sends back",
    stage="noise",
    size=backscatter_size,
    act=scatter_back,
    parameters=(
        Parameter(
            path="atmosphere.lidar_ratio",
            about="Extinction over backscatter",
            default=50.0,
            example="50 sr",
            limits=("1e-6 sr", "1e9 sr"),
        ),
    ),
)
