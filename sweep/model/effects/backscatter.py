"""Atmospheric backscatter: light that haze or dust returns all along the beam.

A continuous beam lights all the air up to the target at once. The light that comes back is

    P = P_tx A tau_o  integral over 0..R of  beta(r) T(r)^2 / (r^2 + r_0^2) dr,   r_0 = D / Theta

with the backscatter coefficient beta = alpha / S [1/m/sr] from the extinction and the lidar ratio
S [sr]. r^2 / (r^2 + r_0^2) is the overlap of a collimated beam with its own receiver: nearer than
r_0 a point's image is larger than the field of view. For a beam at the limit of diffraction,
Theta = 4 lambda / (pi D), it is the coherent lidar's of Sonnenschein and Horrigan (Appl. Opt. 10,
1971, 1600, focus at infinity): r_0 = pi D^2 / (4 lambda).

It counts as light on the detector: shot noise. Its beat with the local oscillator, from ever new
grains, is spread over the bins from the nearest range to the target's and is left out; [T 3.3.1]
counts backscatter among the noise likewise.

Lidar ratios: haze 30 to 70 sr, Martian dust about 40 sr, water drops 18 sr.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.atmosphere import Profile, optical_depth, path_heights, profile_of
from sweep.model.effects.effect import Effect, Parameter, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.link import aperture_area
from sweep.model.preparation import Shots

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_FOLDS = (0.0, 1.0, 3.0, 7.0, 15.0, 40.0)
"""Where a row of the table is cut for the integral, in e-foldings of its extinction."""
_NEAR = (1.0, 2.0, 4.0, 10.0, 30.0, 100.0)
"""Where the path is cut for the integral, in units of r_0."""


def power(
    profile: Profile,
    *,
    start_height: ArrayLike,
    end_height: ArrayLike,
    range: ArrayLike,
    laser_power: ArrayLike,
    aperture: ArrayLike,
    optical_efficiency: ArrayLike,
    beam_divergence: ArrayLike,
    lidar_ratio: ArrayLike,
) -> np.ndarray:
    """Backscattered light on the detector [W], (n,).

    By Gauss's rule over atan(r / r_0) between the rows of the profile that the path crosses,
    those cut where the extinction or the overlap has fallen; within 1e-8.

    Parameters
    ----------
    profile : Profile
        Extinction over height.
    start_height, end_height, range : array_like
        Heights of lidar and target and the path's length [m]; (n,) or scalars, as all.
    laser_power, aperture, optical_efficiency, beam_divergence : array_like
        As in the link budget: [W], diameter [m], [1], full angle [rad].
    lidar_ratio : array_like
        Extinction over backscatter [sr], > 0.
    """
    h0, h1, far, near, ratio = _columns(
        start_height, end_height, range, np.asarray(aperture, float) / beam_divergence, lidar_ratio
    )
    rise = h1 - h0
    crossed = (_cut_heights(profile) - h0) / np.where(rise == 0, np.inf, rise)
    inner = [np.clip(crossed, 0, 1) * far, np.minimum(np.asarray(_NEAR) * near, far)]
    cuts = np.sort(np.concatenate([np.zeros_like(far), *inner, far], axis=-1), axis=-1)
    angle = np.arctan(cuts / near)
    half = np.diff(angle)[..., None] / 2
    u = (angle[..., :-1, None] + half) + half * _NODES
    r = near[..., None] * np.tan(u)
    share = r / far[..., None]
    height = h0[..., None] + rise[..., None] * share
    depth = optical_depth(profile, start_height=h0[..., None], end_height=height, range=r)
    local = optical_depth(profile, start_height=height, end_height=height, range=1.0)
    returned = (half * _WEIGHTS * local * np.exp(-2 * depth)).sum(axis=(-1, -2))
    collected = _collected(laser_power, aperture, optical_efficiency)
    return np.asarray(collected * returned / near[..., 0] / ratio[..., 0])


def _cut_heights(profile: Profile) -> np.ndarray:
    """Heights between which extinction is smooth and falls by a few e-foldings at most."""
    cuts = [profile.height[0]]
    rows = zip(
        profile.height, profile.height[1:], profile.extinction, profile.extinction[1:], strict=False
    )
    for z0, z1, a0, a1 in rows:
        folds = abs(math.log(a1 / a0)) if a0 > 0 and a1 > 0 else 0.0
        steps = [fold / folds for fold in _FOLDS if fold < folds]
        cuts += [z0 + step * (z1 - z0) if a1 < a0 else z1 - step * (z1 - z0) for step in steps]
        cuts.append(z1)
    return np.array(cuts)


def _collected(power: ArrayLike, aperture: ArrayLike, efficiency: ArrayLike) -> np.ndarray:
    """P_tx A tau_o [W m^2]."""
    area = aperture_area(np.asarray(aperture, float))
    return np.asarray(power, float) * area * np.asarray(efficiency, float)


def _columns(*values: ArrayLike) -> tuple[np.ndarray, ...]:
    """Arrays of one shape with an axis for places along the path behind."""
    return tuple(a[..., None] for a in np.broadcast_arrays(*(np.asarray(v, float) for v in values)))


def act(shots: Shots, scene: Scene) -> Shots:
    """Shot noise of the light that the air sends back."""
    p = scene.parameters
    air = profile_of(p)
    if air is None:
        return shots
    lidar, target = path_heights(p, shots.range)
    light = power(
        air,
        start_height=lidar,
        end_height=target,
        range=shots.range,
        laser_power=p["instrument.laser.power"],
        aperture=p["instrument.telescope.aperture"],
        optical_efficiency=p["instrument.telescope.optical_efficiency"],
        beam_divergence=p["instrument.laser.beam_divergence"],
        lidar_ratio=p["atmosphere.lidar_ratio"],
    )
    sources = {"backscatter_shot": np.asarray(shots.shot_noise_scale * light)}
    return replace(shots, noise_sources=shots.noise_sources | sources)


def size(points: Points) -> Size | None:
    """The most that backscatter can be; the threshold is set on it.

    All the path with the air at its lower end, undimmed; or all the light that it takes, sent back
    from the beam's own end.
    """
    air = profile_of(points.parameters)
    if air is None:
        return None
    lidar, target = path_heights(points.parameters, points.range)
    lowest = np.minimum(lidar, target)
    near = points["instrument.telescope.aperture"] / points["instrument.laser.beam_divergence"]
    local = optical_depth(air, start_height=lowest, end_height=lowest, range=1.0)
    depth = optical_depth(air, start_height=lidar, end_height=target, range=points.range)
    even = local * np.arctan(points.range / near) / near
    returned = np.minimum(even, -np.expm1(-2 * depth) / 2 / near**2)
    light = (
        returned
        / points["atmosphere.lidar_ratio"]
        * _collected(
            points["instrument.laser.power"],
            points["instrument.telescope.aperture"],
            points["instrument.telescope.optical_efficiency"],
        )
    )
    return Size(noise=light * points.receiver.per_watt / points.noise_variance)


EFFECT = Effect(
    name="backscatter",
    about="shot noise of light that the air sends back",
    stage="noise",
    size=size,
    act=act,
    parameters=(
        Parameter(
            path="atmosphere.lidar_ratio",
            about="Extinction over backscatter",
            si_unit="sr",
            default=50.0,
            example="50 sr",
            at_least="1e-6 sr",
            at_most="1e9 sr",
        ),
    ),
)
