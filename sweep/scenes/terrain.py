"""Terrain as a grid of heights: triangles, cropping, refinement, smoothing and random relief.

Heights are given at the nodes of the grid: row i at y = i dy, column j at x = j dx from the first
node. A cell of four nodes becomes two triangles. Missing heights (NaN) leave holes; a cell that
lacks one node keeps the triangle of the other three.

Random terrain is a Gaussian field with exact statistics, drawn by circulant embedding. Its
covariance is continued periodically on a torus of at least twice the size, where the FFT
diagonalises it. A corner of the torus is used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from sweep.scenes.map_frames import MapFrame
from sweep.scenes.meshes import Facets

_NEGATIVE_VARIANCE_FRACTION_MAX = 1e-6
"""Largest sum of negative values in a power spectrum of relief, over the total variance.

Rounding may cause a smaller sum. A larger sum means that the covariance is not valid.
"""

_COVARIANCE_BATCH_NODES = 1 << 20
"""Number of grid nodes at which the covariance of random relief is computed in one batch."""

AreaBounds = tuple[float, float, float, float]
"""Smallest x, smallest y, largest x and largest y of an area in world coordinates [m]."""


@dataclass(frozen=True, eq=False)
class Terrain:
    """Heights on a regular grid."""

    heights: np.ndarray
    """Heights (rows, columns) of the nodes above the origin [m]; NaN for missing heights."""
    spacing: tuple[float, float]
    """Grid steps (dx, dy) from column to column and from row to row [m]; may be negative."""
    origin: np.ndarray
    """World position (3,) of node (0, 0) at height 0 [m]."""
    map_frame: MapFrame | None = None
    """Map to which the coordinates belong; None if the terrain does not come from a map."""
    warnings: tuple[str, ...] = ()
    """Warnings about heights that may be wrong, as sentences."""

    def __post_init__(self) -> None:
        z, spacing = self.heights, self.spacing
        if np.ndim(z) != 2 or min(np.shape(z)) < 2:
            raise ValueError(f"heights need at least 2 rows and 2 columns, not shape {np.shape(z)}")
        if not (np.isfinite(spacing).all() and spacing[0] * spacing[1] != 0):
            raise ValueError(f"the grid's steps must be finite and other than 0, not {spacing}")

    @property
    def bounds(self) -> AreaBounds:
        """Smallest x, smallest y, largest x and largest y of the grid in world coordinates [m]."""
        rows, columns = self.heights.shape
        x = sorted((0.0, (columns - 1) * self.spacing[0]))
        y = sorted((0.0, (rows - 1) * self.spacing[1]))
        east, north = self.origin[:2].tolist()
        return x[0] + east, y[0] + north, x[1] + east, y[1] + north

    @property
    def centre(self) -> np.ndarray:
        """World position (3,) of the centre of the grid, at the height of the ground [m]."""
        west, south, east, north = self.bounds
        x, y = (west + east) / 2, (south + north) / 2
        return np.array([x, y, self.height_at(np.array(x), np.array(y))])

    def height_at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the height of the triangulated ground at world positions.

        Parameters
        ----------
        x, y : ndarray
            World coordinates [m], of equal shape.

        Returns
        -------
        ndarray
            World heights [m], of the same shape; NaN outside the grid and in holes.
        """
        column = (np.asarray(x, float) - self.origin[0]) / self.spacing[0]
        row = (np.asarray(y, float) - self.origin[1]) / self.spacing[1]
        return np.asarray(_interpolate_on_triangles(self.heights, row, column) + self.origin[2])

    def to_facets(self) -> Facets:
        """Return the ground as facets: upward-facing triangles, and the nodes that they use."""
        z, (dx, dy) = self.heights, self.spacing
        has_height = np.isfinite(z)
        faces = _grid_triangles(has_height)
        if dx * dy < 0:
            faces = faces[:, ::-1]
        rows, columns = z.shape
        vertices = np.empty((rows, columns, 3))
        vertices[..., 0] = np.arange(columns) * dx
        vertices[..., 1] = (np.arange(rows) * dy)[:, None]
        vertices[..., 2] = z
        vertices += 0.0  # turns -0.0 into 0.0
        nodes = vertices.reshape(-1, 3)
        if not has_height.all():
            used = np.zeros(z.size, bool)
            used[faces] = True
            new_number = np.cumsum(used, dtype=np.int32) - 1
            faces, nodes = new_number[faces], nodes[used]
        surface = np.zeros(len(faces), np.int16)
        return Facets(nodes, faces, surface, self.origin, is_clean=True)


def _grid_triangles(has_height: np.ndarray) -> np.ndarray:
    """Return the triangles of all cells of a grid, as node indices (m, 3) int32.

    `has_height` (rows, columns) is True for a node with a height. Triangles are counter-clockwise
    for positive grid steps. A cell with four heights is cut along the diagonal from node (i, j) to
    (i+1, j+1). The lower triangles of all cells come first, and the upper triangles last.
    """
    node = np.arange(has_height.size, dtype=np.int32).reshape(has_height.shape)
    # Corners of each cell, counter-clockwise from (i, j).
    a, b, c, d = node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]
    if has_height.all():
        faces = np.empty((2, *a.shape, 3), np.int32)
        for k, corner in enumerate((a, b, c)):
            faces[0, ..., k] = corner
        for k, corner in enumerate((a, c, d)):
            faces[1, ..., k] = corner
        return faces.reshape(-1, 3)
    node_has_height = has_height.ravel()
    is_missing = [~node_has_height[corner] for corner in (a, b, c, d)]
    n_missing = sum(is_gap.astype(np.int8) for is_gap in is_missing)
    lower = np.where(is_missing[0], d, a), b, c
    upper = a, np.where(is_missing[2], b, c), d
    # Without node b a cell has no lower triangle, without d no upper one. Without a or c the cell
    # is cut along the other diagonal, which leaves one triangle.
    keep_lower = (n_missing == 0) | ((n_missing == 1) & (is_missing[0] | is_missing[3]))
    keep_upper = (n_missing == 0) | ((n_missing == 1) & (is_missing[1] | is_missing[2]))
    return np.concatenate(
        [
            np.stack([corner[keep] for corner in corners], axis=1)
            for corners, keep in ((lower, keep_lower), (upper, keep_upper))
        ]
    )


def _interpolate_on_triangles(
    heights: np.ndarray, row: np.ndarray, column: np.ndarray
) -> np.ndarray:
    """Return heights that are interpolated linearly on the triangles of a grid.

    `row` and `column` are the positions, in grid steps from the first node. The result is NaN
    outside the grid and in holes.
    """
    rows, columns = heights.shape
    i = np.clip(np.floor(row), 0, rows - 2).astype(np.int64)
    j = np.clip(np.floor(column), 0, columns - 2).astype(np.int64)
    v, u = row - i, column - j
    a, b, c, d = heights[i, j], heights[i, j + 1], heights[i + 1, j + 1], heights[i + 1, j]
    lower = a + u * (b - a) + v * (c - b)
    upper = a + u * (c - d) + v * (d - a)
    value = np.where(u >= v, lower, upper)
    # A cell without node a or c is cut along the other diagonal.
    value = np.where(np.isnan(a) & (u + v >= 1), c + (1 - u) * (d - c) + (1 - v) * (b - c), value)
    value = np.where(np.isnan(c) & (u + v <= 1), a + u * (b - a) + v * (d - a), value)
    inside = (row >= 0) & (row <= rows - 1) & (column >= 0) & (column <= columns - 1)
    return np.where(inside, value, np.nan)


def refine_terrain(terrain: Terrain, *, factor: int) -> Terrain:
    """Return a terrain on a finer grid, interpolated by a cubic spline through all heights.

    Slopes of the spline are continuous, so that a narrow beam does not resolve the facets of the
    original grid. A new node has a height if all original nodes around it have heights.

    Parameters
    ----------
    terrain : Terrain
        Grid of at least 4 x 4 nodes.
    factor : int
        Number of new grid steps per original step, >= 1.

    Returns
    -------
    Terrain
        Grid with `factor` times as many steps along each side.

    Raises
    ------
    ValueError
        If the factor is below 1, the grid is too small, or the terrain has no heights.
    """
    from scipy.interpolate import RectBivariateSpline
    from scipy.ndimage import distance_transform_edt

    rows, columns = terrain.heights.shape
    if factor < 1 or min(rows, columns) < 4:
        raise ValueError("refining needs a factor of at least 1 and a grid of 4 x 4 nodes or more")
    heights, holes = terrain.heights, ~np.isfinite(terrain.heights)
    if holes.all():
        raise ValueError("the terrain has no heights at all")
    if holes.any():  # fill each hole with the height of the nearest node
        heights = heights[
            tuple(distance_transform_edt(holes, return_distances=False, return_indices=True))
        ]
    fine_rows = np.arange((rows - 1) * factor + 1)
    fine_columns = np.arange((columns - 1) * factor + 1)
    spline = RectBivariateSpline(range(rows), range(columns), heights)
    fine_heights = spline(fine_rows / factor, fine_columns / factor)
    is_near_hole = holes[fine_rows // factor] | holes[-(-fine_rows // factor)]
    fine_heights[
        is_near_hole[:, fine_columns // factor] | is_near_hole[:, -(-fine_columns // factor)]
    ] = np.nan
    spacing = terrain.spacing[0] / factor, terrain.spacing[1] / factor
    return replace(terrain, heights=fine_heights, spacing=spacing)


def smooth_terrain(terrain: Terrain, *, standard_deviation: float) -> Terrain:
    """Return a terrain smoothed by a Gaussian filter.

    Holes stay holes, and have no weight.

    Parameters
    ----------
    terrain : Terrain
        Terrain to smooth.
    standard_deviation : float
        Standard deviation of the Gaussian [m], from 0 to the longer side of the terrain.

    Raises
    ------
    ValueError
        If the standard deviation is out of range.
    """
    from scipy.ndimage import gaussian_filter

    west, south, east, north = terrain.bounds
    side = max(east - west, north - south)
    if not 0 <= standard_deviation <= side:
        raise ValueError(
            f"the smoothing width must be 0 m to the ground's {side:g} m, not {standard_deviation}"
        )
    has_height = np.isfinite(terrain.heights)
    sigma = [standard_deviation / abs(step) for step in reversed(terrain.spacing)]
    filled_heights = np.where(has_height, terrain.heights, 0.0)
    blurred = gaussian_filter(filled_heights, sigma, mode="nearest")
    weight = gaussian_filter(has_height.astype(float), sigma, mode="nearest")
    smoothed = np.divide(
        blurred, weight, where=has_height, out=np.full_like(filled_heights, np.nan)
    )
    return replace(terrain, heights=smoothed)


def crop_to_square(terrain: Terrain, *, centre: Sequence[float], size: float) -> Terrain:
    """Return the part of a terrain that covers a square.

    Parameters
    ----------
    terrain : Terrain
        Terrain to cut.
    centre : sequence of float
        World x and y of the square's centre [m].
    size : float
        Side of the square [m]. The result covers the square, as far as the terrain reaches.

    Raises
    ------
    ValueError
        If the square contains no cell of the terrain.
    """
    node_ranges, corner = [], terrain.origin.copy()
    for axis in (1, 0):
        step, number = terrain.spacing[axis], terrain.heights.shape[1 - axis]
        middle = (centre[axis] - terrain.origin[axis]) / step
        half_width = size / 2 / abs(step)
        # Positions are rounded sums: tolerate 1e-9 of a step beyond a node.
        first = max(math.floor(middle - half_width + 1e-9), 0)
        last = min(math.ceil(middle + half_width - 1e-9), number - 1)
        if last <= first:
            raise _no_ground_error(centre, size)
        corner[axis] += first * step
        node_ranges.append(slice(first, last + 1))
    return replace(terrain, heights=terrain.heights[node_ranges[0], node_ranges[1]], origin=corner)


def clipped_square_bounds(terrain: Terrain, *, centre: Sequence[float], size: float) -> AreaBounds:
    """Return the bounds of a square with centre (x, y) [m], clipped to the terrain.

    Raises
    ------
    ValueError
        If the square lies outside the terrain.
    """
    west, south, east, north = terrain.bounds
    (x, y), half = centre[:2], size / 2
    bounds = max(x - half, west), max(y - half, south), min(x + half, east), min(y + half, north)
    if not (bounds[0] < bounds[2] and bounds[1] < bounds[3]):
        raise _no_ground_error(centre, size)
    return bounds


def _no_ground_error(centre: Sequence[float], size: float) -> ValueError:
    """Return the error for a square that contains no terrain."""
    return ValueError(
        f"there is no ground within {size / 2:g} m of ({centre[0]:g}, {centre[1]:g}) m"
    )


def draw_fractal_relief(
    generator: np.random.Generator,
    *,
    shape: tuple[int, int],
    spacing: tuple[float, float],
    hurst: float,
    rms_slope: float,
    baseline: float,
) -> np.ndarray:
    """Draw self-affine relief: a fractional Brownian surface.

    Parameters
    ----------
    generator : numpy.random.Generator
        Source of random numbers.
    shape : (int, int)
        Number of rows and columns.
    spacing : (float, float)
        Grid steps along x and y [m].
    hurst : float
        Hurst exponent, 0 < hurst < 1: 0.5 for a random walk, towards 1 for smooth ground.
    rms_slope : float
        Standard deviation of the height difference over the baseline, divided by the baseline.
    baseline : float
        Distance at which `rms_slope` is stated [m].

    Returns
    -------
    ndarray, shape (rows, columns)
        Heights [m], 0 at the first node.

    Notes
    -----
    The height difference of two nodes at distance L is normal with standard deviation
    ``rms_slope * baseline * (L / baseline)**hurst``, the deviogram by which planetary roughness is
    measured [1]_. Stein's exact method [2]_ draws a stationary field whose covariance differs from
    the fractal's by a paraboloid only, and adds a random plane that compensates for the paraboloid.

    The lunar surface has a median Hurst exponent near 0.95 in the highlands and 0.76 in the maria,
    over 57 m to 2.7 km [3]_.

    References
    ----------
    .. [1] Shepard et al., J. Geophys. Res. 106, 32777 (2001).
    .. [2] Stein, J. Comput. Graph. Stat. 11, 587 (2002).
    .. [3] Rosenburg et al., J. Geophys. Res. 116, E02001 (2011).
    """
    steps = abs(spacing[1]), abs(spacing[0])
    diagonal = math.hypot(*((n - 1) * step for n, step in zip(shape, steps, strict=True)))
    # Distances are in units of the grid's diagonal: the covariance must be exact up to distance 1.
    period, paraboloid, covariance = _stein_covariance(2 * hurst)
    relative_steps = [step / diagonal for step in steps]
    stationary = _draw_gaussian_field(generator, shape, relative_steps, covariance, period)
    plane_slopes = generator.standard_normal(2) * math.sqrt(2 * paraboloid)
    rows, columns = (np.arange(n) * step for n, step in zip(shape, relative_steps, strict=True))
    relief = stationary + (plane_slopes[0] * rows)[:, None] + plane_slopes[1] * columns
    # Differences of the field have the variance 2 r^(2H); scale them to the slope at the baseline.
    scale = rms_slope * baseline * (diagonal / baseline) ** hurst / math.sqrt(2)
    return np.asarray((relief - relief[0, 0]) * scale)


def _stein_covariance(alpha: float):  # type: ignore[no-untyped-def]  # returns a function with the constants
    """Return the covariance function of Stein's method for fractal relief, with its parameters.

    `alpha` is twice the Hurst exponent. Distances are in units of the grid's diagonal.

    Returns
    -------
    period : float
        Period of the torus on which the relief is drawn.
    paraboloid : float
        Coefficient of the paraboloid by which the covariance differs from that of the fractal.
    covariance : callable
        Function that returns the covariance at each distance.
    """
    if alpha <= 1.5:
        torus_half_period, tail_coefficient, paraboloid = 1.0, 0.0, alpha / 2
        constant = 1 - alpha / 2
    else:
        torus_half_period = 2.0
        tail_coefficient = (
            alpha * (2 - alpha) / (3 * torus_half_period * (torus_half_period**2 - 1))
        )
        paraboloid = (
            alpha - tail_coefficient * (torus_half_period - 1) ** 2 * (torus_half_period + 2)
        ) / 2
        constant = tail_coefficient * (torus_half_period - 1) ** 3 + 1 - paraboloid

    def covariance(distance: np.ndarray) -> np.ndarray:
        within_diagonal = constant - distance**alpha + paraboloid * distance**2
        beyond_diagonal = (
            tail_coefficient
            * np.maximum(torus_half_period - distance, 0.0) ** 3
            / np.maximum(distance, 1.0)
        )
        return np.where(distance <= 1, within_diagonal, beyond_diagonal)

    return 2 * torus_half_period, paraboloid, covariance


def draw_hills(
    generator: np.random.Generator,
    *,
    shape: tuple[int, int],
    spacing: tuple[float, float],
    rms_height: float,
    correlation_length: float,
) -> np.ndarray:
    """Draw smooth rolling ground: a stationary field with a Gaussian covariance.

    Parameters
    ----------
    generator : numpy.random.Generator
        Source of random numbers.
    shape : (int, int)
        Number of rows and columns.
    spacing : (float, float)
        Grid steps along x and y [m], smaller than a third of the correlation length.
    rms_height : float
        Standard deviation of the height [m].
    correlation_length : float
        Distance at which the correlation is 1/e [m].

    Returns
    -------
    ndarray, shape (rows, columns)
        Heights [m], of expected mean 0.

    Notes
    -----
    The covariance of two nodes at distance L is
    ``rms_height**2 * exp(-(L / correlation_length)**2)``.
    """
    steps = abs(spacing[1]), abs(spacing[0])
    relative_steps = [step / correlation_length for step in steps]
    # Beyond 6 correlation lengths the correlation is 2e-16: opposite edges of the grid are
    # independent although the torus is periodic.
    longest_side = max((n - 1) * step for n, step in zip(shape, relative_steps, strict=True))
    field = _draw_gaussian_field(
        generator, shape, relative_steps, lambda r: np.exp(-(r**2)), longest_side + 6.0
    )
    return np.asarray(field * rms_height)


def _draw_gaussian_field(generator, shape, steps, covariance, period):  # type: ignore[no-untyped-def]
    """Draw a stationary Gaussian field with a given covariance.

    The field is drawn on a torus; the result is a corner of the torus.

    Parameters
    ----------
    generator : numpy.random.Generator
        Source of random numbers.
    shape : (int, int)
        Number of rows and columns of the result.
    steps : (float, float)
        Distance from row to row and from column to column.
    covariance : callable
        Function that returns the covariance at each distance, in the unit of the steps.
    period : float
        Smallest period of the torus, in the unit of the steps.
    """
    torus_shape = [fft.next_fast_len(math.ceil(period / step), real=True) for step in steps]
    if math.prod(torus_shape) > 2e8:
        raise ValueError(
            f"relief on {shape} nodes needs a torus of {torus_shape}; use a coarser grid"
        )
    squared_distances = [
        (np.minimum(np.arange(n), n - np.arange(n)) * step) ** 2
        for n, step in zip(torus_shape, steps, strict=True)
    ]
    covariances = np.empty(torus_shape)  # computed in batches, because a torus may be large
    batch_rows = max(_COVARIANCE_BATCH_NODES // torus_shape[1], 1)
    for row_range in (
        slice(first, first + batch_rows) for first in range(0, torus_shape[0], batch_rows)
    ):
        covariances[row_range] = covariance(
            np.sqrt(squared_distances[0][row_range, None] + squared_distances[1])
        )
    power_spectrum = fft.rfft2(covariances, overwrite_x=True).real.copy()
    del covariances
    negative_fraction = (
        -power_spectrum[power_spectrum < 0].sum() / power_spectrum[power_spectrum > 0].sum()
    )
    if negative_fraction > _NEGATIVE_VARIANCE_FRACTION_MAX:
        raise ArithmeticError(
            f"{negative_fraction:.1e} of the relief's variance is negative on this grid"
        )
    noise = fft.rfft2(generator.standard_normal(torus_shape), overwrite_x=True)
    noise *= np.sqrt(np.maximum(power_spectrum, 0.0, out=power_spectrum), out=power_spectrum)
    return fft.irfft2(noise, s=torus_shape, overwrite_x=True)[: shape[0], : shape[1]]
