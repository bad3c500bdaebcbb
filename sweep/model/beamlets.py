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

BEAMLET_PATTERNS = ("hexagonal", "sunflower", "line", "square")

PATTERN_RADIUS_SIGMA = 3.0
"""Radius of the pattern before the mapping, in standard deviations: 98.9 % of the power."""

SQUARED_RADIUS_GROWTH = 2.9
"""Growth of a lattice's squared radius with the logarithm of its number of beamlets, from 19 on.

What lies beyond the radius is left out, and its spacing misses what is narrow. So both fall as
beamlets are added: a radius of 3.3 deviations for 37 beamlets, 3.8 for 109, 4.7 for 2,029."""

_LATTICE_ROTATION = 0.191
"""Rotation [rad] of the lattice against the slope, so that no two rows project onto each other."""


GAUSS_HERMITE_NODES_MAX = 15
"""Nodes up to which the rule is Gauss and Hermite's."""

UNIFORM_RULE_RADIUS_SIGMA = 7.0
"""Standard deviations on either side over which more nodes step evenly; 3e-12 is beyond."""


@lru_cache(maxsize=64)
def gaussian_rule(n_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights for the mean over the standard normal distribution, (number,) each.

    The weights sum to 1; the mean is 0 and, from two nodes on, the variance 1.
    """
    if n_nodes <= GAUSS_HERMITE_NODES_MAX:
        nodes, weights = np.polynomial.hermite_e.hermegauss(n_nodes)
    else:
        nodes = np.linspace(-UNIFORM_RULE_RADIUS_SIGMA, UNIFORM_RULE_RADIUS_SIGMA, n_nodes)
        weights = np.exp(-0.5 * nodes**2)
    weights /= weights.sum()
    if n_nodes > GAUSS_HERMITE_NODES_MAX:
        nodes /= math.sqrt((weights * nodes**2).sum())
    return nodes, weights


@lru_cache(maxsize=32)
def place_beamlets(n_beamlets: int, pattern: str = "hexagonal") -> tuple[np.ndarray, np.ndarray]:
    """Directions (2, number) and weights (number,) of a Gaussian beam's beamlets.

    Directions are angles off the axis in units of the beam's standard deviation (Theta/4), across
    the plane's slope and along it. Their weighted mean is 0 and, from three beamlets on, their
    covariance the identity; but that those of lines all lie to the same side, which has the mean
    square of both sides. [T 3.3.1] uses 109, a full hexagonal lattice. The pattern is one of
    :data:`BEAMLET_PATTERNS`, or ``3 lines`` for as many parallel ones; a square has the whole root
    of the number on each side.
    """
    if n_beamlets == 1:
        return np.zeros((2, 1)), np.ones(1)
    if pattern.endswith(("line", "lines", "square")):
        return _product_rule(pattern, n_beamlets)
    if n_beamlets == 2:
        return np.array([[0.0, 0.0], [-1.0, 1.0]]), np.array([0.5, 0.5])
    offsets = _PATTERN_FUNCTIONS[pattern](n_beamlets)
    weights = np.exp(-0.5 * (offsets**2).sum(axis=0))
    weights /= weights.sum()
    # Sums, not products of matrices, whose order depends on the number of threads.
    offsets = offsets - (offsets * weights).sum(axis=1)[:, None]
    covariance = (offsets[:, None] * offsets * weights).sum(axis=-1)
    eigenvalues, eigenvectors = np.linalg.eigh(covariance)
    return (eigenvectors / np.sqrt(eigenvalues)) @ eigenvectors.T @ offsets, weights


def _hexagonal_lattice(n_points: int) -> np.ndarray:
    """Return the points of a hexagonal lattice nearest to one of its points, (2, number)."""
    search_radius = 2 + math.ceil(math.sqrt(n_points))
    i, j = np.mgrid[-search_radius : search_radius + 1, -search_radius : search_radius + 1].reshape(
        2, -1
    )
    squared_distance = i * i + i * j + j * j  # whole numbers, so that shells are told apart exactly
    angle = np.arctan2(math.sqrt(0.75) * j, i + 0.5 * j)
    nearest = np.lexsort((angle, squared_distance))[:n_points]
    i, j = i[nearest], j[nearest]
    x, y = i + 0.5 * j, math.sqrt(0.75) * j
    c, s = math.cos(_LATTICE_ROTATION), math.sin(_LATTICE_ROTATION)
    spacing = lattice_radius(n_points) * math.sqrt(2 * math.pi / (math.sqrt(3) * n_points))
    return spacing * np.array([c * x - s * y, s * x + c * y])


def lattice_radius(n_beamlets: int) -> float:
    """Return the radius of a hexagonal lattice before the mapping [standard deviations]."""
    return math.sqrt(
        PATTERN_RADIUS_SIGMA**2 + SQUARED_RADIUS_GROWTH * math.log(max(n_beamlets, 19) / 19)
    )


def _sunflower_pattern(n_points: int) -> np.ndarray:
    """Points of equal areas of the circle, each turned by the golden angle, (2, number)."""
    k = np.arange(n_points) + 0.5
    radius, angle = PATTERN_RADIUS_SIGMA * np.sqrt(k / n_points), k * math.pi * (3 - math.sqrt(5))
    return np.array([radius * np.cos(angle), radius * np.sin(angle)])


def _product_rule(pattern: str, n_beamlets: int) -> tuple[np.ndarray, np.ndarray]:
    """Offsets and weights of a Gaussian's rules along the slope, and across it."""
    if pattern == "square":
        nodes_per_side = max(math.isqrt(n_beamlets), 2)
        (x, x_weights), (y, y_weights) = (
            gaussian_rule(nodes_per_side),
            gaussian_rule(nodes_per_side),
        )
    else:
        n_lines = 1 if pattern == "line" else int(pattern.split()[0])
        y, y_weights = gaussian_rule(n_beamlets // n_lines)
        nodes, weights = gaussian_rule(2 * n_lines)
        x, x_weights = nodes[n_lines:], 2 * weights[n_lines:]
    across, along = (v.ravel() for v in np.meshgrid(x, y))
    return np.array([across, along]), np.outer(y_weights, x_weights).ravel()


_PATTERN_FUNCTIONS = {"hexagonal": _hexagonal_lattice, "sunflower": _sunflower_pattern}


def plane_footprint(
    *,
    grazing_angle: np.ndarray,
    beam_divergence: np.ndarray,
    n_beamlets: int,
    pattern: str = "hexagonal",
    radial_velocity: ArrayLike = 0.0,
    transverse_velocity: ArrayLike = 0.0,
    direction_angle: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Beamlets of a beam on a flat plane, per unit of range along its axis, (n, number) each.

    A plane's footprint scales with range, so one row serves every range. A beamlet y off the axis
    towards the plane's near side, and x across, sees the velocity (v_r + v_t y) / |d| with
    |d|^2 = 1 + x^2 + y^2. The grazing angle is the axis's to the plane, above 0 to pi/2 [rad].
    Angles of the beam are full ones at 1/e^2, ``direction_angle`` those along which velocities are
    seen [rad]. v_r is positive closing, v_t towards the near side [m/s].

    Returns four arrays: (R_b - R_0) / R_0, formed without subtracting the two ranges; the cosine of
    the incidence angle; power fractions; and closing speed less that of the beam's axis [m/s].
    A beamlet that passes over the horizon has fraction 0 and offset 0.
    """
    (across, along), weights = place_beamlets(n_beamlets, pattern)
    sigma = np.asarray(beam_divergence, float)[:, None] / 4
    sine = np.sin(np.asarray(grazing_angle, float))[:, None]
    cosine = np.cos(np.asarray(grazing_angle, float))[:, None]
    x, y = across * sigma, along * sigma
    squared_angle = x * x + y * y
    excess_length = squared_angle / (1 + np.sqrt(1 + squared_angle))  # |direction| - 1
    height_slope = sine + y * cosine
    hits_plane = height_slope > 0
    safe_height_slope = np.where(hits_plane, height_slope, 1.0)
    relative_range_offset = np.where(
        hits_plane, (excess_length * sine - y * cosine) / safe_height_slope, 0.0
    )
    cos_incidence = np.where(hits_plane, height_slope / (1 + excess_length), 0.0)
    if direction_angle is not None:
        x, y = (v * (np.asarray(direction_angle, float)[:, None] / 4) for v in (across, along))
        excess_length = (squared_angle := x * x + y * y) / (1 + np.sqrt(1 + squared_angle))
    radial_column, transverse_column = (
        np.asarray(v, float)[..., None] for v in (radial_velocity, transverse_velocity)
    )
    closing_offset = (transverse_column * y - radial_column * excess_length) / (1 + excess_length)
    return relative_range_offset, cos_incidence, np.where(hits_plane, weights, 0.0), closing_offset


class OffsetMoments(NamedTuple):
    """Offsets from the beam's axis, weighted by echo power: sizes of mean, rms and extreme."""

    mean: np.ndarray | float
    rms: np.ndarray | float
    extreme: np.ndarray | float

    def scaled_by(self, factor: np.ndarray) -> "OffsetMoments":
        """Scale the offsets by a factor; infinite ones may be multiplied by 0."""
        return OffsetMoments(*(np.minimum(value, 1e200) * factor for value in self))

    def sum_bound(self, other: "OffsetMoments") -> "OffsetMoments":
        """Bounds on those of sums."""
        return OffsetMoments(
            *(value + other_value for value, other_value in zip(self, other, strict=True))
        )


NO_SPREAD = OffsetMoments(0.0, 0.0, 0.0)


def pattern_radius(n_beamlets: int, pattern: str) -> float:
    """Largest angle of a beamlet off the axis, in standard deviations."""
    directions, _ = place_beamlets(n_beamlets, pattern)
    return float(np.sqrt((directions**2).sum(axis=0)).max())


def plane_moments(
    *,
    transverse_velocity: ArrayLike,
    radial_velocity: ArrayLike,
    grazing_angle: ArrayLike,
    beam_divergence: ArrayLike,
    n_beamlets: int,
    pattern: str,
    direction_angle: ArrayLike | None = None,
) -> tuple[OffsetMoments, OffsetMoments]:
    """Bounds for a beam on a plane: (R_b - R_0)/R_0, and radial velocities off the axis's [m/s].

    Both weighted by echo power. u has the rms q; the rest bounds Taylor's remainders. At a velocity
    off the beam a beamlet x off the axis sees v_across x / |d| + v_along (1/|d| - 1),
    |d|^2 = 1 + x^2, with x by `direction_angle` where that is another angle than the places'.
    """
    radius, sigma = pattern_radius(n_beamlets, pattern), np.asarray(beam_divergence, float) / 4
    transverse_velocity, radial_velocity = np.abs(transverse_velocity), np.abs(radial_velocity)
    range_rms = sigma / np.tan(grazing_angle)
    range_extreme, curvature_term = radius * range_rms, (radius * sigma) * (radius * sigma) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        lower_factor, upper_factor = 1 - range_extreme, 1 + range_extreme
        echo_weight_max = upper_factor * upper_factor * upper_factor * np.exp(6 * curvature_term)
        weighted_shift = (
            3 * range_rms * range_rms * upper_factor * upper_factor * np.exp(6 * curvature_term)
            + 6 * range_rms * curvature_term
        )
        mean_bound = (
            weighted_shift
            + (range_rms * range_rms + sigma * sigma) * echo_weight_max / lower_factor
        )
        rms_bound = (
            (range_rms + sigma * np.sqrt(curvature_term)) * np.sqrt(echo_weight_max) / lower_factor
        )
        extreme_bound = (range_extreme + curvature_term) / lower_factor
    range_moments = OffsetMoments(
        *(
            np.where(range_extreme < 1, value, np.inf)
            for value in (mean_bound, rms_bound, extreme_bound)
        )
    )
    upper_factor = 1 + np.minimum(
        range_extreme, 1.0
    )  # velocities have bounds beyond the horizon too
    echo_weight_max = upper_factor * upper_factor * upper_factor * np.exp(6 * curvature_term)
    if direction_angle is not None:
        sigma = np.asarray(direction_angle, float) / 4
        curvature_term = (radius * sigma) * (radius * sigma) / 2
    weighted_shift = sigma * (3 * range_rms * echo_weight_max + 8 * radius * curvature_term)
    velocity_moments = OffsetMoments(
        transverse_velocity * weighted_shift + radial_velocity * (sigma * sigma) * echo_weight_max,
        (transverse_velocity * sigma + radial_velocity * sigma * np.sqrt(curvature_term))
        * np.sqrt(echo_weight_max),
        transverse_velocity * radius * sigma + radial_velocity * curvature_term,
    )
    return range_moments, velocity_moments


def plane_echo_ratio(
    law: str,
    *,
    grazing_angle: np.ndarray,
    beam_divergence: np.ndarray,
    n_beamlets: int,
    pattern: str,
) -> np.ndarray:
    """Echo of all beamlets on a plane over what they would have on the axis, at the most.

    As u has the mean 0 and this rms, it differs from 1 in the second order, upwards by the slope
    and downwards by the beamlets' own length: that is taken for more too.
    """
    echo_exponent, sigma = 3 if law == "lambert" else 2, beam_divergence / 4
    range_rms = sigma / np.tan(grazing_angle)
    range_extreme = pattern_radius(n_beamlets, pattern) * range_rms
    second_order_factor = echo_exponent * (echo_exponent - 1) / 2 + (
        range_extreme if echo_exponent == 3 else 0.0
    )
    ratio_max = np.minimum(1 + range_extreme, 1 / np.sin(grazing_angle)) ** echo_exponent
    second_order_ratio = (
        1 + second_order_factor * range_rms * range_rms + echo_exponent * sigma * sigma
    )
    return np.asarray(np.where(range_extreme < 1, second_order_ratio, ratio_max))


def bins_per_velocity(
    *, range: ArrayLike, carrier: ArrayLike, chirp_rate: ArrayLike, bin_width: ArrayLike
) -> np.ndarray:
    """Bins for 1 m/s: 2/c times the carrier, and the range's beat that beta scales."""
    doubled_range_beat = (
        np.asarray(chirp_rate, float) * (4 / SPEED_OF_LIGHT) * np.asarray(range, float)
    )
    return np.asarray(
        (2 / SPEED_OF_LIGHT) * (np.asarray(carrier) + doubled_range_beat) / np.asarray(bin_width)
    )
