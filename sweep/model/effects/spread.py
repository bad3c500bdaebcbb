"""How far the lines of a footprint lie apart: moments of ranges and velocities, and what bins see.

On a plane, with u the angle of a beamlet along the slope times cot(grazing), (1 + d)/(1 + u) is
R_b/R_0 and ((1 + u)/|d|)^m its echo over that on the axis, d its direction, whose length on the
axis is 1, and m = 2 for laws that are even in all directions, 3 for Lambert's. The pattern has
exactly the beam's covariance, so that u has the mean 0 and the rms q = (divergence/4)
cot(grazing). Where a beamlet may pass over the horizon moments are infinite.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.footprint import beamlets
from sweep.model.ground import Cast


class Moments(NamedTuple):
    """Offsets from the beam's axis, weighted by echo power: sizes of mean, rms and extreme."""

    mean: np.ndarray | float
    rms: np.ndarray | float
    extreme: np.ndarray | float

    def times(self, factor: np.ndarray) -> "Moments":
        """The same of what is so many times as far; infinite ones may be multiplied by 0."""
        return Moments(*(np.minimum(value, 1e200) * factor for value in self))

    def plus(self, other: "Moments") -> "Moments":
        """Bounds on those of sums."""
        return Moments(*(one + another for one, another in zip(self, other, strict=True)))


NO_SPREAD = Moments(0.0, 0.0, 0.0)


class Footprint(NamedTuple):
    """What a footprint is to the line on its axis, by point."""

    echo: np.ndarray
    """Of the bare line, for a reflectance of 1 [1/sr]."""
    echo_ratio: np.ndarray | float
    """Echo of all beamlets over that of the bare line."""
    ranges: Moments
    """Of (R_b - R_0) / R_0."""
    own_ranges: Moments
    """Likewise, of the beamlets on the axis's surface only."""
    velocities: Moments
    """Of the beamlets' radial velocities less the axis's [m/s]."""
    gain: np.ndarray | float = 1.0
    """Most that all beamlets' amplitudes make over the bare line's: all in phase, or as powers."""
    beside: np.ndarray | float = 0.0
    """Share of the echo that comes from other surfaces than the axis's, 0..1."""
    apart: np.ndarray | float = 0.0
    """Largest |R_b - R_0| / R_0 there."""


def of_rays(cast: Cast) -> Footprint:
    """Footprints that rays have found."""
    _, offset, doppler, echo = cast.beamlets
    beside = cast.beside
    whole = echo.sum(axis=1)
    share = echo / np.where(whole > 0, whole, 1.0)[:, None]
    ranges = _moments(offset, share)
    moved = _moments(doppler, share).times(np.asarray(SPEED_OF_LIGHT / 2))
    gain = np.sqrt(share).sum(axis=1)
    if beside is None or not beside.any():
        return Footprint(whole, 1.0, ranges, ranges, moved, gain)
    other = np.where(beside, share, 0.0)
    own = share - other
    rest = own.sum(axis=1)
    own_ranges = _moments(offset, own / np.where(rest > 0, rest, 1.0)[:, None])
    apart = np.where(other > 0, np.abs(offset), 0.0).max(axis=1)
    return Footprint(whole, 1.0, ranges, own_ranges, moved, gain, other.sum(axis=1), apart)


def _moments(values: np.ndarray, weight: np.ndarray) -> Moments:
    weighted = weight * values
    extreme = np.where(weight > 0, np.abs(values), 0.0).max(axis=1)
    return Moments(np.abs(weighted.sum(axis=1)), np.sqrt((weighted * values).sum(axis=1)), extreme)


def reach_of(number: int, pattern: str) -> float:
    """Largest angle of a beamlet off the axis, in standard deviations."""
    points, _ = beamlets(number, pattern)
    return float(np.sqrt((points**2).sum(axis=0)).max())


def plane_range_moments(
    *, grazing_angle: ArrayLike, beam_divergence: ArrayLike, number: int, pattern: str
) -> Moments:
    """Bounds on (R_b - R_0)/R_0 of a beam on a plane, weighted by echo power.

    u has the rms q; the rest bounds Taylor's remainders.
    """
    if number == 1:
        return NO_SPREAD
    radius, sigma = reach_of(number, pattern), np.asarray(beam_divergence, float) / 4
    rms = sigma / np.tan(grazing_angle)
    widest, bulge = radius * rms, (radius * sigma) * (radius * sigma) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        inside, side = 1 - widest, 1 + widest
        heavier = side * side * side * np.exp(6 * bulge)
        lean = 3 * rms * rms * side * side * np.exp(6 * bulge) + 6 * rms * bulge
        mean = lean + (rms * rms + sigma * sigma) * heavier / inside
        far = (rms + sigma * np.sqrt(bulge)) * np.sqrt(heavier) / inside
        extreme = (widest + bulge) / inside
    return Moments(*(np.where(widest < 1, value, np.inf) for value in (mean, far, extreme)))


def plane_velocity_moments(
    *,
    across: ArrayLike,
    along: ArrayLike,
    grazing_angle: ArrayLike,
    beam_divergence: ArrayLike,
    number: int,
    pattern: str,
) -> Moments:
    """Bounds on the beamlets' radial velocities less the axis's [m/s], at a velocity off the beam.

    A beamlet x off the axis sees v_across x / |d| + v_along (1/|d| - 1), |d|^2 = 1 + x^2; its
    weight is that of :func:`plane_range_moments`.
    """
    if number == 1:
        return NO_SPREAD
    radius, sigma = reach_of(number, pattern), np.asarray(beam_divergence, float) / 4
    across, along = np.abs(across), np.abs(along)
    slope = sigma / np.tan(grazing_angle)
    side, bulge = 1 + np.minimum(radius * slope, 1.0), (radius * sigma) * (radius * sigma) / 2
    heavier = side * side * side * np.exp(6 * bulge)
    lean = sigma * (3 * slope * heavier + 8 * radius * bulge)
    return Moments(
        across * lean + along * (sigma * sigma) * heavier,
        (across * sigma + along * sigma * np.sqrt(bulge)) * np.sqrt(heavier),
        across * radius * sigma + along * bulge,
    )


def plane_echo_ratio(
    law: str, *, grazing_angle: np.ndarray, beam_divergence: np.ndarray, number: int, pattern: str
) -> np.ndarray:
    """Echo of all beamlets on a plane over what they would have on the axis, at the most.

    As u has the mean 0 and this rms, it differs from 1 in the second order, upwards by the slope
    and downwards by the beamlets' own length: that is taken for more too.
    """
    power, sigma = 3 if law == "lambert" else 2, beam_divergence / 4
    rms = sigma / np.tan(grazing_angle)
    widest = reach_of(number, pattern) * rms
    bend = power * (power - 1) / 2 + (widest if power == 3 else 0.0)
    most = np.minimum(1 + widest, 1 / np.sin(grazing_angle)) ** power
    more = 1 + bend * rms * rms + power * sigma * sigma
    return np.asarray(np.where(widest < 1, more, most))


def range_to_bins(
    *, range: ArrayLike, beta: ArrayLike, chirp_rate: ArrayLike, bin_width: ArrayLike
) -> np.ndarray:
    """Bins of a chirped segment for a relative difference of range of 1; 0 in the Doppler's."""
    slope = 2 / SPEED_OF_LIGHT * np.asarray(chirp_rate, float) * (1 + np.abs(beta))
    return np.asarray(slope * np.asarray(range, float) / np.asarray(bin_width))


def velocity_to_bins(
    *, range: ArrayLike, carrier: ArrayLike, chirp_rate: ArrayLike, bin_width: ArrayLike
) -> np.ndarray:
    """Bins for 1 m/s: 2/c times the carrier, and the range's beat that beta stretches."""
    beat = np.asarray(chirp_rate, float) * (4 / SPEED_OF_LIGHT) * np.asarray(range, float)
    return np.asarray((2 / SPEED_OF_LIGHT) * (np.asarray(carrier) + beat) / np.asarray(bin_width))
