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

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects import added_noise
from sweep.model.effects.change import Change, Interval
from sweep.model.effects.extinction import Profile, optical_depth
from sweep.model.link import aperture_area

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_FOLDS = (0.0, 1.0, 3.0, 7.0, 15.0, 40.0)
"""Where a row of the table is cut for the integral, in e-foldings of its extinction."""
_NEAR = (1.0, 2.0, 4.0, 10.0, 30.0, 100.0)
"""Where the path is cut for the integral, in units of r_0."""
_BRACKETS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 16.0, 64.0, np.inf)
"""Where the path is cut for the bound, in units of r_0."""


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


def power_bounds(
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
) -> Interval:
    """Least and largest value [W] that :func:`power` can have, from optical depths alone.

    As d(T^2) = -2 alpha T^2 dr, the integral over a piece of the path is the fall of T^2 over it,
    by 2 S, times a mean of 1/(r^2 + r_0^2), which lies between its values at the piece's ends.
    """
    h0, h1, far, near, ratio = _columns(
        start_height, end_height, range, np.asarray(aperture, float) / beam_divergence, lidar_ratio
    )
    r = np.minimum(np.asarray(_BRACKETS) * near, far)
    depth = optical_depth(profile, start_height=h0, end_height=h0 + (h1 - h0) * r / far, range=r)
    fall = np.exp(-2 * depth[..., :-1]) * -np.expm1(-2 * np.maximum(np.diff(depth), 0.0))
    farther = fall / 2 / ratio / (r[..., 1:] ** 2 + near**2)
    nearer = fall / 2 / ratio / (r[..., :-1] ** 2 + near**2)
    collected = _collected(laser_power, aperture, optical_efficiency)
    least, largest = (collected * piece.sum(axis=-1) for piece in (farther, nearer))
    return least, largest


def bound(
    *,
    backscattered_power: Interval,
    apd_gain: ArrayLike,
    excess_noise_factor: ArrayLike,
    responsivity: ArrayLike,
    electrical_bandwidth: ArrayLike,
    noise_variance: ArrayLike,
) -> Change:
    """Change by the shot noise of backscatter; the threshold is set on it.

    Parameters
    ----------
    backscattered_power : interval
        Of :func:`power_bounds` [W].
    apd_gain, excess_noise_factor, responsivity, electrical_bandwidth : array_like
        As for :func:`sweep.model.noise.current_variances`.
    noise_variance : array_like
        Current variance [A^2] of all other sources, before a heterodyne receiver's factor.
    """
    least, largest = (
        added_noise.shot_noise(
            power=light,
            apd_gain=apd_gain,
            excess_noise_factor=excess_noise_factor,
            responsivity=responsivity,
            electrical_bandwidth=electrical_bandwidth,
        )
        for light in backscattered_power
    )
    return added_noise.change(least=least, largest=largest, noise_variance=noise_variance)


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
