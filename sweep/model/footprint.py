"""The beam's footprint as beamlets: where they point, what they weigh, and where they meet a plane.

A Gaussian beam of full divergence Theta (between the 1/e^2 intensity points) has the standard
deviation Theta/4 on each axis. A pattern of points in a circle is weighted by the beam, then
mapped linearly so that its mean and covariance are the beam's own exactly. The beam keeps its
pointing, its size and its power whatever the number of beamlets.

Two patterns. If beamlets add as powers, a hexagonal lattice is the better quadrature. If they add
as amplitudes with the phases of a smooth plane, a lattice cancels. Off normal incidence its phases
step evenly from row to row, and the sum is nearly nothing but at grating lobes. A sunflower has no
rows; its sum fades like the random one that rough ground would give, which is what [T 4.2]
describes (first dips of Pd at some 4 km).

Moments of a plane's lines: let u be the angle of a beamlet along the slope times cot(grazing), and
d its direction, whose length on the axis is 1. Then (1 + d)/(1 + u) is R_b/R_0, and ((1 + u)/|d|)^m
is its echo over that on the axis, with m = 2 for laws that are even in all directions, 3 for
Lambert's. The pattern has exactly the beam's covariance, so that u has the mean 0 and the rms q =
(divergence/4) cot(grazing). If a beamlet may pass over the horizon moments are infinite.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.constants import SPEED_OF_LIGHT

PATTERNS = ("hexagonal", "sunflower", "line", "square")

REACH = 3.0
"""Radius of the pattern before the mapping, in standard deviations: 98.9 % of the power."""

REACH_BY_NUMBER = 2.9
"""Growth of a lattice's squared radius with the logarithm of its number of beamlets, from 19 on.

What lies beyond the radius is left out, and its spacing misses what is narrow. So both fall as
beamlets are added: a radius of 3.3 deviations for 37 beamlets, 3.8 for 109, 4.7 for 2,029."""

_TILT = 0.191
"""Rotation [rad] of the lattice against the slope, so that no two rows project onto each other."""


HERMITE = 15
"""Nodes up to which the rule is Gauss and Hermite's."""

RULE_REACH = 7.0
"""Standard deviations on either side over which more nodes step evenly; 3e-12 is beyond."""


@lru_cache(maxsize=64)
def gaussian_rule(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights for the mean over the standard normal distribution, (number,) each.

    The weights sum to 1; the mean is 0 and, from two nodes on, the variance 1.
    """
    if number <= HERMITE:
        nodes, weights = np.polynomial.hermite_e.hermegauss(number)
    else:
        nodes = np.linspace(-RULE_REACH, RULE_REACH, number)
        weights = np.exp(-0.5 * nodes**2)
    weights /= weights.sum()
    if number > HERMITE:
        nodes /= math.sqrt((weights * nodes**2).sum())
    return nodes, weights


@lru_cache(maxsize=32)
def beamlets(number: int, pattern: str = "hexagonal") -> tuple[np.ndarray, np.ndarray]:
    """Directions (2, number) and weights (number,) of a Gaussian beam's beamlets.

    Directions are angles off the axis in units of the beam's standard deviation (Theta/4), across
    the plane's slope and along it. Their weighted mean is 0 and, from three beamlets on, their
    covariance the identity; but that those of lines all lie to the same side, which has the mean
    square of both sides. [T 3.3.1] uses 109, a full hexagonal lattice. The pattern is one of
    :data:`PATTERNS`, or ``3 lines`` for as many parallel ones; a square has the whole root of the
    number on each side.
    """
    if number == 1:
        return np.zeros((2, 1)), np.ones(1)
    if pattern.endswith(("line", "lines", "square")):
        return _product(pattern, number)
    if number == 2:
        return np.array([[0.0, 0.0], [-1.0, 1.0]]), np.array([0.5, 0.5])
    offsets = _PATTERNS[pattern](number)
    weights = np.exp(-0.5 * (offsets**2).sum(axis=0))
    weights /= weights.sum()
    # Sums, not products of matrices, whose order depends on the number of threads.
    offsets = offsets - (offsets * weights).sum(axis=1)[:, None]
    moments = (offsets[:, None] * offsets * weights).sum(axis=-1)
    values, vectors = np.linalg.eigh(moments)
    return (vectors / np.sqrt(values)) @ vectors.T @ offsets, weights


def _hexagonal(number: int) -> np.ndarray:
    """Return the points of a hexagonal lattice nearest to one of its points, (2, number)."""
    reach = 2 + math.ceil(math.sqrt(number))
    i, j = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    squared = i * i + i * j + j * j  # whole numbers, so that shells are told apart exactly
    angle = np.arctan2(math.sqrt(0.75) * j, i + 0.5 * j)
    nearest = np.lexsort((angle, squared))[:number]
    i, j = i[nearest], j[nearest]
    x, y = i + 0.5 * j, math.sqrt(0.75) * j
    c, s = math.cos(_TILT), math.sin(_TILT)
    spacing = lattice_radius(number) * math.sqrt(2 * math.pi / (math.sqrt(3) * number))
    return spacing * np.array([c * x - s * y, s * x + c * y])


def lattice_radius(number: int) -> float:
    """Return the radius of a hexagonal lattice before the mapping [standard deviations]."""
    return math.sqrt(REACH**2 + REACH_BY_NUMBER * math.log(max(number, 19) / 19))


def _sunflower(number: int) -> np.ndarray:
    """Points of equal areas of the circle, each turned by the golden angle, (2, number)."""
    k = np.arange(number) + 0.5
    radius, angle = REACH * np.sqrt(k / number), k * math.pi * (3 - math.sqrt(5))
    return np.array([radius * np.cos(angle), radius * np.sin(angle)])


def _product(pattern: str, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Offsets and weights of a Gaussian's rules along the slope, and across it."""
    if pattern == "square":
        side = max(math.isqrt(number), 2)
        (x, x_weights), (y, y_weights) = gaussian_rule(side), gaussian_rule(side)
    else:
        lines = 1 if pattern == "line" else int(pattern.split()[0])
        y, y_weights = gaussian_rule(number // lines)
        nodes, weights = gaussian_rule(2 * lines)
        x, x_weights = nodes[lines:], 2 * weights[lines:]
    across, along = (v.ravel() for v in np.meshgrid(x, y))
    return np.array([across, along]), np.outer(y_weights, x_weights).ravel()


_PATTERNS = {"hexagonal": _hexagonal, "sunflower": _sunflower}


def plane_footprint(
    *,
    grazing_angle: np.ndarray,
    beam_divergence: np.ndarray,
    number: int,
    pattern: str = "hexagonal",
    radial: ArrayLike = 0.0,
    transverse: ArrayLike = 0.0,
    directions: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Beamlets of a beam on a flat plane, per unit of range along its axis, (n, number) each.

    A plane's footprint scales with range, so one row serves every range. A beamlet y off the axis
    towards the plane's near side, and x across, sees the velocity (v_r + v_t y) / |d| with
    |d|^2 = 1 + x^2 + y^2. The grazing angle is the axis's to the plane, above 0 to pi/2 [rad].
    Angles of the beam are full ones at 1/e^2, ``directions`` those along which velocities are seen
    [rad]. v_r is positive closing, v_t towards the near side [m/s].

    Returns four arrays: (R_b - R_0) / R_0, formed without subtracting the two ranges; the cosine of
    the incidence angle; power fractions; and closing speed less that of the beam's axis [m/s].
    A beamlet that passes over the horizon has fraction 0 and offset 0.
    """
    (across, along), share = beamlets(number, pattern)
    sigma = np.asarray(beam_divergence, float)[:, None] / 4
    sine = np.sin(np.asarray(grazing_angle, float))[:, None]
    cosine = np.cos(np.asarray(grazing_angle, float))[:, None]
    x, y = across * sigma, along * sigma
    square = x * x + y * y
    stretch = square / (1 + np.sqrt(1 + square))  # |direction| - 1
    height = sine + y * cosine
    hits = height > 0
    safe = np.where(hits, height, 1.0)
    offset = np.where(hits, (stretch * sine - y * cosine) / safe, 0.0)
    cos_incidence = np.where(hits, height / (1 + stretch), 0.0)
    if directions is not None:
        x, y = (v * (np.asarray(directions, float)[:, None] / 4) for v in (across, along))
        stretch = (square := x * x + y * y) / (1 + np.sqrt(1 + square))
    along_beam, across_beam = (np.asarray(v, float)[..., None] for v in (radial, transverse))
    closing = (across_beam * y - along_beam * stretch) / (1 + stretch)
    return offset, cos_incidence, np.where(hits, share, 0.0), closing


class Moments(NamedTuple):
    """Offsets from the beam's axis, weighted by echo power: sizes of mean, rms and extreme."""

    mean: np.ndarray | float
    rms: np.ndarray | float
    extreme: np.ndarray | float

    def times(self, factor: np.ndarray) -> "Moments":
        """Scale the offsets by a factor; infinite ones may be multiplied by 0."""
        return Moments(*(np.minimum(value, 1e200) * factor for value in self))

    def plus(self, other: "Moments") -> "Moments":
        """Bounds on those of sums."""
        return Moments(*(one + another for one, another in zip(self, other, strict=True)))


NO_SPREAD = Moments(0.0, 0.0, 0.0)


def reach_of(number: int, pattern: str) -> float:
    """Largest angle of a beamlet off the axis, in standard deviations."""
    points, _ = beamlets(number, pattern)
    return float(np.sqrt((points**2).sum(axis=0)).max())


def plane_moments(
    *,
    across: ArrayLike,
    along: ArrayLike,
    grazing_angle: ArrayLike,
    beam_divergence: ArrayLike,
    number: int,
    pattern: str,
    directions: ArrayLike | None = None,
) -> tuple[Moments, Moments]:
    """Bounds for a beam on a plane: (R_b - R_0)/R_0, and radial velocities off the axis's [m/s].

    Both weighted by echo power. u has the rms q; the rest bounds Taylor's remainders. At a velocity
    off the beam a beamlet x off the axis sees v_across x / |d| + v_along (1/|d| - 1),
    |d|^2 = 1 + x^2, with x by `directions` where that is another angle than the places'.
    """
    radius, sigma = reach_of(number, pattern), np.asarray(beam_divergence, float) / 4
    across, along = np.abs(across), np.abs(along)
    rms = sigma / np.tan(grazing_angle)
    widest, bulge = radius * rms, (radius * sigma) * (radius * sigma) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        inside, side = 1 - widest, 1 + widest
        heavier = side * side * side * np.exp(6 * bulge)
        lean = 3 * rms * rms * side * side * np.exp(6 * bulge) + 6 * rms * bulge
        mean = lean + (rms * rms + sigma * sigma) * heavier / inside
        far = (rms + sigma * np.sqrt(bulge)) * np.sqrt(heavier) / inside
        extreme = (widest + bulge) / inside
    ranges = Moments(*(np.where(widest < 1, value, np.inf) for value in (mean, far, extreme)))
    side = 1 + np.minimum(widest, 1.0)  # velocities have bounds beyond the horizon too
    heavier = side * side * side * np.exp(6 * bulge)
    if directions is not None:
        sigma = np.asarray(directions, float) / 4
        bulge = (radius * sigma) * (radius * sigma) / 2
    lean = sigma * (3 * rms * heavier + 8 * radius * bulge)
    velocities = Moments(
        across * lean + along * (sigma * sigma) * heavier,
        (across * sigma + along * sigma * np.sqrt(bulge)) * np.sqrt(heavier),
        across * radius * sigma + along * bulge,
    )
    return ranges, velocities


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


def velocity_to_bins(
    *, range: ArrayLike, carrier: ArrayLike, chirp_rate: ArrayLike, bin_width: ArrayLike
) -> np.ndarray:
    """Bins for 1 m/s: 2/c times the carrier, and the range's beat that beta scales."""
    beat = np.asarray(chirp_rate, float) * (4 / SPEED_OF_LIGHT) * np.asarray(range, float)
    return np.asarray((2 / SPEED_OF_LIGHT) * (np.asarray(carrier) + beat) / np.asarray(bin_width))
