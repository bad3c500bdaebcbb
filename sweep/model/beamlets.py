"""Beamlets of a beam's footprint: directions, weights, and intersections with a plane.

A Gaussian beam of full divergence Theta (between the 1/e^2 intensity points) has the standard
deviation Theta/4 on each axis. A pattern of points in a circle is weighted by the beam, then mapped
linearly so that its mean and covariance are exactly those of the beam. So the beam keeps its
pointing, its width and its power with any number of beamlets.

There are two patterns for footprints of given numbers. If beamlets add as powers, a hexagonal
lattice is the better quadrature. If beamlets add as amplitudes with the phases of a smooth plane, a
lattice cancels. Off normal incidence its phases step evenly from row to row, and the sum almost
vanishes except at grating lobes. A sunflower pattern has no rows. Its sum fades like the random sum
of rough ground, as [T 4.2] describes (first dips of Pd at some 4 km).

Moments of the lines on a plane: let u be the angle of a beamlet along the slope times cot(grazing),
and d its direction, of length 1 on the axis. Then R_b/R_0 = (1 + d)/(1 + u). The echo relative to
that on the axis is ((1 + u)/|d|)^m, where m = 2 for isotropic reflectance laws and m = 3 for
Lambert's. The pattern has exactly the beam's covariance, so u has mean 0 and rms q = (divergence/4)
cot(grazing). If a beamlet may pass over the horizon, the moments are infinite.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.constants import SPEED_OF_LIGHT

BEAMLET_PATTERNS = ("hexagonal", "sunflower", "line", "square")
"""Names of beamlet patterns. A text such as ``3 lines`` also names a pattern: parallel lines of
beamlets, as many as the number says."""

PATTERN_RADIUS_SIGMA = 3.0
"""Radius of a beamlet pattern [standard deviations of the beam], before the pattern is scaled to
the beam's covariance. 98.9 % of the beam's power lies within this radius."""

SQUARED_RADIUS_PER_LOG_COUNT = 2.9
"""Increase of a hexagonal lattice's squared radius [variances of the beam] when the number of
beamlets grows by the factor e. It applies from 19 beamlets on.

A lattice's error depends on the power outside its radius and on its spacing. A radius that grows
with the number of beamlets reduces both: 3.3 standard deviations for 37 beamlets, 3.8 for 109, 4.7
for 2,029."""

_LATTICE_ROTATION = 0.191
"""Rotation [rad] of the hexagonal lattice relative to the slope. With it no two rows of beamlets
have the same coordinate along the slope."""


GAUSS_HERMITE_NODES_MAX = 15
"""Largest number of nodes of a Gauss-Hermite quadrature. With more nodes a quadrature of evenly
spaced nodes is used."""

UNIFORM_QUADRATURE_RADIUS_SIGMA = 7.0
"""Distance of the outermost evenly spaced quadrature nodes from the mean [standard deviations]. A
fraction of 3e-12 of the normal distribution lies beyond these nodes."""


@lru_cache(maxsize=64)
def normal_distribution_quadrature(n_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of a quadrature over the standard normal distribution.

    Parameters
    ----------
    n_nodes : int
        Number of nodes; Gauss-Hermite up to :data:`GAUSS_HERMITE_NODES_MAX`, evenly spaced above.

    Returns
    -------
    nodes, weights : ndarray (n_nodes,)
        Weights sum to 1. The nodes have the mean 0 and, if there are two or more, the variance 1.
    """
    if n_nodes <= GAUSS_HERMITE_NODES_MAX:
        nodes, weights = np.polynomial.hermite_e.hermegauss(n_nodes)
    else:
        nodes = np.linspace(
            -UNIFORM_QUADRATURE_RADIUS_SIGMA, UNIFORM_QUADRATURE_RADIUS_SIGMA, n_nodes
        )
        weights = np.exp(-0.5 * nodes**2)
    weights /= weights.sum()
    if n_nodes > GAUSS_HERMITE_NODES_MAX:
        nodes /= math.sqrt((weights * nodes**2).sum())
    return nodes, weights


@lru_cache(maxsize=32)
def place_beamlets(n_beamlets: int, pattern: str = "hexagonal") -> tuple[np.ndarray, np.ndarray]:
    """Place the beamlets of a Gaussian beam: return their directions and weights.

    Parameters
    ----------
    n_beamlets : int
        Number of beamlets: for ``square`` the square of the number per side, which is at least 2;
        for parallel lines a multiple of the number of lines.
    pattern : str
        One of :data:`BEAMLET_PATTERNS`, or ``3 lines`` for that many parallel lines.

    Returns
    -------
    directions : ndarray (2, n_beamlets)
        Angles off the axis [standard deviations of the beam, Theta/4]: across the plane's slope in
        the first row, along the slope in the second. Theta is the full 1/e^2 divergence.
    weights : ndarray (n_beamlets,)
        Fractions of the power; they sum to 1.

    Notes
    -----
    The weighted mean of directions is 0 and, with three beamlets or more, their covariance is the
    identity. Parallel lines are an exception: all lie on one side of the axis, with the mean square
    that lines on both sides would have. [T 3.3.1] uses 109 beamlets, a full hexagonal lattice.
    """
    if n_beamlets == 1:
        return np.zeros((2, 1)), np.ones(1)
    if pattern.endswith(("line", "lines", "square")):
        return _product_quadrature(pattern, n_beamlets)
    if n_beamlets == 2:
        return np.array([[0.0, 0.0], [-1.0, 1.0]]), np.array([0.5, 0.5])
    offsets = _PATTERN_FUNCTIONS[pattern](n_beamlets)
    weights = np.exp(-0.5 * (offsets**2).sum(axis=0))
    weights /= weights.sum()
    # Sums in place of matrix products, whose order of summation depends on the number of threads.
    offsets = offsets - (offsets * weights).sum(axis=1)[:, None]
    covariance = (offsets[:, None] * offsets * weights).sum(axis=-1)
    eigenvalues, eigenvectors = np.linalg.eigh(covariance)
    return (eigenvectors / np.sqrt(eigenvalues)) @ eigenvectors.T @ offsets, weights


def _hexagonal_lattice(n_points: int) -> np.ndarray:
    """Return a point of a hexagonal lattice and the points nearest to it, (2, n_points).

    Coordinates are in standard deviations of the beam.
    """
    search_radius = 2 + math.ceil(math.sqrt(n_points))
    i, j = np.mgrid[-search_radius : search_radius + 1, -search_radius : search_radius + 1].reshape(
        2, -1
    )
    squared_distance = i * i + i * j + j * j  # integers: shells are separated exactly
    angle = np.arctan2(math.sqrt(0.75) * j, i + 0.5 * j)
    nearest = np.lexsort((angle, squared_distance))[:n_points]
    i, j = i[nearest], j[nearest]
    x, y = i + 0.5 * j, math.sqrt(0.75) * j
    c, s = math.cos(_LATTICE_ROTATION), math.sin(_LATTICE_ROTATION)
    spacing = lattice_radius(n_points) * math.sqrt(2 * math.pi / (math.sqrt(3) * n_points))
    return spacing * np.array([c * x - s * y, s * x + c * y])


def lattice_radius(n_beamlets: int) -> float:
    """Return the radius of a hexagonal lattice of beamlets [standard deviations of the beam].

    The radius is that before the lattice is scaled to the beam's covariance.
    """
    return math.sqrt(
        PATTERN_RADIUS_SIGMA**2 + SQUARED_RADIUS_PER_LOG_COUNT * math.log(max(n_beamlets, 19) / 19)
    )


def _sunflower_pattern(n_points: int) -> np.ndarray:
    """Return the points of a sunflower pattern, (2, n_points) [standard deviations of the beam].

    Every point represents the same area of a circle. Directions to successive points differ by the
    golden angle.
    """
    k = np.arange(n_points) + 0.5
    radius, angle = PATTERN_RADIUS_SIGMA * np.sqrt(k / n_points), k * math.pi * (3 - math.sqrt(5))
    return np.array([radius * np.cos(angle), radius * np.sin(angle)])


def _product_quadrature(pattern: str, n_beamlets: int) -> tuple[np.ndarray, np.ndarray]:
    """Return directions and weights of beamlets at the nodes of a product of two quadratures.

    One quadrature runs along the slope, the second across it. The arrays are those of
    :func:`place_beamlets`.
    """
    if pattern == "square":
        nodes_per_side = max(math.isqrt(n_beamlets), 2)
        (x, x_weights), (y, y_weights) = (
            normal_distribution_quadrature(nodes_per_side),
            normal_distribution_quadrature(nodes_per_side),
        )
    else:
        n_lines = 1 if pattern == "line" else int(pattern.split()[0])
        y, y_weights = normal_distribution_quadrature(n_beamlets // n_lines)
        nodes, weights = normal_distribution_quadrature(2 * n_lines)
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
    direction_spread_angle: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Compute where the beamlets of a beam meet a flat plane, relative to the point on its axis.

    Parameters
    ----------
    grazing_angle : ndarray (n,)
        Angle between the axis and the plane [rad], above 0 to pi/2.
    beam_divergence : ndarray (n,)
        Full 1/e^2 angle of the beam [rad].
    n_beamlets, pattern
        Number and pattern, as in :func:`place_beamlets`.
    radial_velocity, transverse_velocity : array_like
        Velocity along the beam, positive when closing, and across it, positive towards the near
        side of the plane [m/s].
    direction_spread_angle : ndarray (n,), optional
        Full 1/e^2 angle of the directions along which velocities are seen [rad]; by default
        `beam_divergence`.

    Returns
    -------
    relative_range_offset : ndarray (n, n_beamlets)
        (R_b - R_0) / R_0, with the ranges R_b of a beamlet and R_0 on the axis.
    cos_incidence : ndarray (n, n_beamlets)
        Cosine of the incidence angle.
    weights : ndarray (n, n_beamlets)
        Fractions of the beam's power.
    closing_offset : ndarray (n, n_beamlets)
        Closing speed of a beamlet minus that on the beam's axis [m/s].

    Notes
    -----
    A plane's footprint scales with range, so one row serves every range. A beamlet y off the axis
    towards the near side, and x across, sees the closing speed (v_r + v_t y) / |d| with |d|^2 = 1 +
    x^2 + y^2. A beamlet that passes over the horizon has the power fraction 0 and offsets 0.
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
    if direction_spread_angle is not None:
        x, y = (
            v * (np.asarray(direction_spread_angle, float)[:, None] / 4) for v in (across, along)
        )
        excess_length = (squared_angle := x * x + y * y) / (1 + np.sqrt(1 + squared_angle))
    radial_column, transverse_column = (
        np.asarray(v, float)[..., None] for v in (radial_velocity, transverse_velocity)
    )
    closing_offset = (transverse_column * y - radial_column * excess_length) / (1 + excess_length)
    return relative_range_offset, cos_incidence, np.where(hits_plane, weights, 0.0), closing_offset


class OffsetMoments(NamedTuple):
    """Moments of beamlets' offsets from the beam's axis in range or velocity.

    The moments are weighted by echo power.
    """

    mean: np.ndarray | float
    """Magnitude of the mean offset from the axis, in the offsets' unit."""
    rms: np.ndarray | float
    """Root mean square of the offsets from the axis, in the offsets' unit."""
    largest_magnitude: np.ndarray | float
    """Largest magnitude of an offset from the axis, in the offsets' unit."""

    def scaled_by(self, factor: np.ndarray) -> "OffsetMoments":
        """Return the moments that result if every offset is multiplied by `factor`.

        An infinite moment times 0 gives 0.
        """
        return OffsetMoments(*(np.minimum(value, 1e200) * factor for value in self))

    def bound_on_summed_offsets(self, other: "OffsetMoments") -> "OffsetMoments":
        """Return upper bounds on the moments of the sums of two kinds of offset.

        This record holds the moments of the first kind, ``other`` those of the second kind.
        """
        return OffsetMoments(
            *(value + other_value for value, other_value in zip(self, other, strict=True))
        )


ZERO_OFFSET_MOMENTS = OffsetMoments(0.0, 0.0, 0.0)
"""Moments of offsets that are all 0, as those of a single beamlet on the axis."""


def pattern_radius(n_beamlets: int, pattern: str) -> float:
    """Return the largest angle between the axis and a beamlet [standard deviations of the beam].

    Parameters
    ----------
    n_beamlets : int
        Number of beamlets.
    pattern : str
        Pattern of the beamlets, as in :func:`place_beamlets`.

    Returns
    -------
    float
        Angle in standard deviations of the beam, Theta/4 with the full divergence Theta.
    """
    directions, _ = place_beamlets(n_beamlets, pattern)
    return float(np.sqrt((directions**2).sum(axis=0)).max())


def plane_offset_moment_bounds(
    *,
    transverse_velocity: ArrayLike,
    radial_velocity: ArrayLike,
    grazing_angle: ArrayLike,
    beam_divergence: ArrayLike,
    n_beamlets: int,
    pattern: str,
    direction_spread_angle: ArrayLike | None = None,
) -> tuple[OffsetMoments, OffsetMoments]:
    """Return upper bounds on the moments of beamlets' range and velocity offsets on a flat plane.

    An offset is a beamlet's value minus that on the beam's axis.

    Parameters
    ----------
    transverse_velocity, radial_velocity : array_like
        Velocity across the beam and along it [m/s].
    grazing_angle : array_like
        Angle between the axis and the plane [rad].
    beam_divergence : array_like
        Full 1/e^2 angle of the positions [rad].
    n_beamlets, pattern
        Number and pattern, as in :func:`place_beamlets`.
    direction_spread_angle : array_like, optional
        Full 1/e^2 angle of the directions along which velocities are seen [rad]; by default
        `beam_divergence`.

    Returns
    -------
    range_moments : OffsetMoments
        Bounds for (R_b - R_0) / R_0, with the ranges R_b of a beamlet and R_0 on the axis; infinite
        if a beamlet may pass over the horizon.
    velocity_moments : OffsetMoments
        Bounds for radial velocities minus that on the axis [m/s].

    Notes
    -----
    Moments are weighted by echo power. They follow from Taylor series in the offset u of the
    module's description, whose rms is q = (divergence / 4) cot(grazing angle). Bounds on the
    remainders of the series are added. A beamlet at the angle x from the axis has the radial
    velocity of the axis plus

        v_across x / |d| + v_along (1/|d| - 1),    |d|^2 = 1 + x^2.
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
    if direction_spread_angle is not None:
        sigma = np.asarray(direction_spread_angle, float) / 4
        curvature_term = (radius * sigma) * (radius * sigma) / 2
    weighted_shift = sigma * (3 * range_rms * echo_weight_max + 8 * radius * curvature_term)
    velocity_moments = OffsetMoments(
        transverse_velocity * weighted_shift + radial_velocity * (sigma * sigma) * echo_weight_max,
        (transverse_velocity * sigma + radial_velocity * sigma * np.sqrt(curvature_term))
        * np.sqrt(echo_weight_max),
        transverse_velocity * radius * sigma + radial_velocity * curvature_term,
    )
    return range_moments, velocity_moments


def plane_echo_ratio_bound(
    law: str,
    *,
    grazing_angle: np.ndarray,
    beam_divergence: np.ndarray,
    n_beamlets: int,
    pattern: str,
) -> np.ndarray:
    """Return an upper bound on the echo of all beamlets on a plane, relative to the axis's, (n,).

    Parameters
    ----------
    law : str
        Reflectance law, one of :data:`sweep.model.ground.REFLECTANCE_LAWS`.
    grazing_angle, beam_divergence : ndarray (n,)
        Angle between axis and plane, and full 1/e^2 angle of the beam [rad].
    n_beamlets, pattern
        Number and pattern, as in :func:`place_beamlets`.

    Notes
    -----
    Let u be a beamlet's angle along the slope times cot(grazing angle). It has the mean 0 and a
    known rms, so the ratio differs from 1 in second order. The slope increases the ratio, the
    greater length of beamlets off the axis reduces it. The bound takes both as increases.
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
    """Return the shift of a spectral line [FFT bins] per radial velocity of 1 m/s.

    Parameters
    ----------
    range, carrier, chirp_rate, bin_width : array_like
        Range [m], carrier frequency [Hz], chirp rate [Hz/s], width of a bin [Hz].

    Notes
    -----
    The shift is (2 / c) (f + 2 f_R) divided by the bin width, with the carrier f and the range beat
    f_R = 2 S R / c of the chirp rate S and the range R.
    """
    doubled_range_beat = (
        np.asarray(chirp_rate, float) * (4 / SPEED_OF_LIGHT) * np.asarray(range, float)
    )
    return np.asarray(
        (2 / SPEED_OF_LIGHT) * (np.asarray(carrier) + doubled_range_beat) / np.asarray(bin_width)
    )
