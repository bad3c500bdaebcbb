"""Ground as a grid of heights: its triangles, pieces, refining, and random relief.

Heights sit at the grid's nodes, row i at y = i dy and column j at x = j dx from the first. A cell
of four nodes becomes two triangles. Missing heights (NaN) leave holes; a cell that lacks one node
keeps the triangle of the other three.

Random ground is a Gaussian field, exact in its statistics, drawn by circulant embedding. The
covariance is laid on a torus at least twice as large, where the FFT diagonalises it; a corner is
kept.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from sweep.scenes.map_frames import MapFrame
from sweep.scenes.meshes import Facets

_NEGATIVE_VARIANCE_MAX = 1e-6
"""Share of the variance that may be missing where rounding makes a spectrum negative."""

_NODES_PER_BATCH = 1 << 20
"""Nodes whose covariance is worked out at a time."""

AreaBounds = tuple[float, float, float, float]
"""World (x least, y least, x largest, y largest) [m]."""


@dataclass(frozen=True, eq=False)
class Terrain:
    """Heights (rows, columns) of nodes on a grid above its origin [m]; NaN where there is none.

    Steps (dx, dy) [m] may be negative; the origin (3,) is that of node (0, 0) at height 0 [m].
    One that was read from a map has the frame of that map; warnings say what is doubtful about it.
    """

    heights: np.ndarray
    spacing: tuple[float, float]
    origin: np.ndarray
    map_frame: MapFrame | None = None
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        z, spacing = self.heights, self.spacing
        if np.ndim(z) != 2 or min(np.shape(z)) < 2:
            raise ValueError(f"heights need at least 2 rows and 2 columns, not shape {np.shape(z)}")
        if not (np.isfinite(spacing).all() and spacing[0] * spacing[1] != 0):
            raise ValueError(f"the grid's steps must be finite and other than 0, not {spacing}")

    @property
    def bounds(self) -> AreaBounds:
        """Edges of the grid."""
        rows, columns = self.heights.shape
        x = sorted((0.0, (columns - 1) * self.spacing[0]))
        y = sorted((0.0, (rows - 1) * self.spacing[1]))
        east, north = self.origin[:2].tolist()
        return x[0] + east, y[0] + north, x[1] + east, y[1] + north

    @property
    def centre(self) -> np.ndarray:
        """World position of the middle of the grid, on the ground [m], (3,)."""
        west, south, east, north = self.bounds
        x, y = (west + east) / 2, (south + north) / 2
        return np.array([x, y, self.height_at(np.array(x), np.array(y))])

    def height_at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """World height of the ground at world (x, y) [m], on its triangles; NaN where none is."""
        column = (np.asarray(x, float) - self.origin[0]) / self.spacing[0]
        row = (np.asarray(y, float) - self.origin[1]) / self.spacing[1]
        return np.asarray(_interpolate_on_triangles(self.heights, row, column) + self.origin[2])

    def to_facets(self) -> Facets:
        """Triangles of the ground, facing upwards, and the nodes that they use."""
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
        vertices += 0.0  # never -0.0
        nodes = vertices.reshape(-1, 3)
        if not has_height.all():
            used = np.zeros(z.size, bool)
            used[faces] = True
            new_number = np.cumsum(used, dtype=np.int32) - 1
            faces, nodes = new_number[faces], nodes[used]
        surface = np.zeros(len(faces), np.int16)
        return Facets(nodes, faces, surface, self.origin, is_grid=True)


def _grid_triangles(has_height: np.ndarray) -> np.ndarray:
    """Triangles of all cells, counter-clockwise where rows and columns both increase, (m, 3) int32.

    Whole cells are cut along the diagonal from node (i, j) to (i+1, j+1). First come the lower
    triangles of all cells, then the upper ones.
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
    # One gap at b spoils the lower triangle, one at d the upper; gaps at a and c are bridged above
    # by the other diagonal, which makes one triangle and leaves the other to be dropped.
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
    """Height of the triangulated grid at fractional rows and columns; NaN where it has none."""
    rows, columns = heights.shape
    i = np.clip(np.floor(row), 0, rows - 2).astype(np.int64)
    j = np.clip(np.floor(column), 0, columns - 2).astype(np.int64)
    v, u = row - i, column - j
    a, b, c, d = heights[i, j], heights[i, j + 1], heights[i + 1, j + 1], heights[i + 1, j]
    lower = a + u * (b - a) + v * (c - b)
    upper = a + u * (c - d) + v * (d - a)
    value = np.where(u >= v, lower, upper)
    # A cell that lacks one corner is cut along the other diagonal if that is what is left of it.
    value = np.where(np.isnan(a) & (u + v >= 1), c + (1 - u) * (d - c) + (1 - v) * (b - c), value)
    value = np.where(np.isnan(c) & (u + v <= 1), a + u * (b - a) + v * (d - a), value)
    inside = (row >= 0) & (row <= rows - 1) & (column >= 0) & (column <= columns - 1)
    return np.where(inside, value, np.nan)


def refine(terrain: Terrain, *, factor: int) -> Terrain:
    """Terrain with `factor` times as many steps a side, through all the given heights.

    A cubic spline: slopes are continuous, so that a narrow beam sees no facets of the survey's
    posts. A new node has a height where all the nodes around it have one. ValueError for a
    factor below 1 or a grid too small for a cubic.
    """
    from scipy.interpolate import RectBivariateSpline
    from scipy.ndimage import distance_transform_edt

    rows, columns = terrain.heights.shape
    if factor < 1 or min(rows, columns) < 4:
        raise ValueError("refining needs a factor of at least 1 and a grid of 4 x 4 nodes or more")
    heights, holes = terrain.heights, ~np.isfinite(terrain.heights)
    if holes.all():
        raise ValueError("the terrain has no heights at all")
    if holes.any():  # each is given the height of the nearest node that has one
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


def smooth(terrain: Terrain, *, standard_deviation: float) -> Terrain:
    """Terrain blurred by a Gaussian of that standard deviation [m]; holes stay holes.

    ValueError for a negative width, or one beyond the ground's longer side: its memory goes by
    it.
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


def cut_square(terrain: Terrain, *, centre: Sequence[float], size: float) -> Terrain:
    """Cut out a square of a terrain about (x, y) [m]; ValueError where it holds no cell."""
    node_ranges, corner = [], terrain.origin.copy()
    for axis in (1, 0):
        step, number = terrain.spacing[axis], terrain.heights.shape[1 - axis]
        middle = (centre[axis] - terrain.origin[axis]) / step
        half_width = size / 2 / abs(step)
        # A hair past a node is that node: positions come from sums that were rounded.
        first = max(math.floor(middle - half_width + 1e-9), 0)
        last = min(math.ceil(middle + half_width - 1e-9), number - 1)
        if last <= first:
            raise _no_ground_error(centre, size)
        corner[axis] += first * step
        node_ranges.append(slice(first, last + 1))
    return replace(terrain, heights=terrain.heights[node_ranges[0], node_ranges[1]], origin=corner)


def square_bounds(terrain: Terrain, *, centre: Sequence[float], size: float) -> AreaBounds:
    """Bounds of a square about (x, y) [m], as far as there is ground; ValueError for none."""
    west, south, east, north = terrain.bounds
    (x, y), half = centre[:2], size / 2
    bounds = max(x - half, west), max(y - half, south), min(x + half, east), min(y + half, north)
    if not (bounds[0] < bounds[2] and bounds[1] < bounds[3]):
        raise _no_ground_error(centre, size)
    return bounds


def _no_ground_error(centre: Sequence[float], size: float) -> ValueError:
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
    """Self-affine relief: a fractional Brownian surface, (rows, columns) [m], 0 at its first node.

    The difference of height of two nodes, a distance L apart, is normal with the standard
    deviation ``rms_slope * baseline * (L / baseline)**hurst``: the deviogram by which planetary
    roughness is measured (Shepard et al., J. Geophys. Res. 106, 32777, 2001). Drawn by Stein's
    exact method (J. Comput. Graph. Stat. 11, 587, 2002): a stationary field whose covariance
    differs from the fractal's by a paraboloid only, plus the random plane that makes up for it.

    Hurst's exponent, 0 < . < 1, is 0.5 for a random walk, towards 1 for smooth ground. Lunar
    ground has a median near 0.95 in the highlands and 0.76 in the maria over 57 m to 2.7 km
    (Rosenburg et al., J. Geophys. Res. 116, E02001, 2011).
    """
    steps = abs(spacing[1]), abs(spacing[0])
    diagonal = math.hypot(*((n - 1) * step for n, step in zip(shape, steps, strict=True)))
    # In units of the grid's diagonal, the longest distance that must be right is 1.
    period, paraboloid, covariance = _stein_covariance(2 * hurst)
    relative_steps = [step / diagonal for step in steps]
    stationary = _draw_gaussian_field(generator, shape, relative_steps, covariance, period)
    plane_slopes = generator.standard_normal(2) * math.sqrt(2 * paraboloid)
    rows, columns = (np.arange(n) * step for n, step in zip(shape, relative_steps, strict=True))
    relief = stationary + (plane_slopes[0] * rows)[:, None] + plane_slopes[1] * columns
    # The field's differences have the variance 2 r^(2H); the wanted one is per baseline.
    scale = rms_slope * baseline * (diagonal / baseline) ** hurst / math.sqrt(2)
    return np.asarray((relief - relief[0, 0]) * scale)


def _stein_covariance(alpha: float):  # type: ignore[no-untyped-def]  # returns a function with the constants
    """Torus period, coefficient of the paraboloid and the covariance on the torus."""
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
    """Smooth rolling ground with a Gaussian covariance, (rows, columns) [m].

    The covariance of two nodes L apart is ``rms_height**2 * exp(-(L /
    correlation_length)**2)``. Other parameters are as of `fractal`; steps are finer than a
    third of the correlation length.
    """
    steps = abs(spacing[1]), abs(spacing[0])
    relative_steps = [step / correlation_length for step in steps]
    # Beyond 6 correlation lengths the covariance is 2e-16: the two ends of the torus are apart.
    longest_side = max((n - 1) * step for n, step in zip(shape, relative_steps, strict=True))
    field = _draw_gaussian_field(
        generator, shape, relative_steps, lambda r: np.exp(-(r**2)), longest_side + 6.0
    )
    return np.asarray(field * rms_height)


def _draw_gaussian_field(generator, shape, steps, covariance, period):  # type: ignore[no-untyped-def]
    """Stationary Gaussian field of a function of distance, on a torus of at least a period."""
    torus_shape = [fft.next_fast_len(math.ceil(period / step), real=True) for step in steps]
    if math.prod(torus_shape) > 2e8:
        raise ValueError(
            f"relief on {shape} nodes needs a torus of {torus_shape}; use a coarser grid"
        )
    squared_distances = [
        (np.minimum(np.arange(n), n - np.arange(n)) * step) ** 2
        for n, step in zip(torus_shape, steps, strict=True)
    ]
    covariances = np.empty(torus_shape)  # a torus may be large; what makes it need not be
    batch_rows = max(_NODES_PER_BATCH // torus_shape[1], 1)
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
    if negative_fraction > _NEGATIVE_VARIANCE_MAX:
        raise ArithmeticError(
            f"{negative_fraction:.1e} of the relief's variance is negative on this grid"
        )
    noise = fft.rfft2(generator.standard_normal(torus_shape), overwrite_x=True)
    noise *= np.sqrt(np.maximum(power_spectrum, 0.0, out=power_spectrum), out=power_spectrum)
    return fft.irfft2(noise, s=torus_shape, overwrite_x=True)[: shape[0], : shape[1]]
