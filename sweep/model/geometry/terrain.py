"""Ground as a grid of heights, and its triangles.

Heights sit at the grid's nodes; row i lies at y = i dy and column j at x = j dx from the grid's
first node, so a raster that runs southwards has dy < 0. A cell of four nodes becomes two
triangles. Missing heights (NaN) leave holes; a cell that lacks one node keeps the triangle of the
other three.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sweep.model.geometry.mesh import Facets


@dataclass(frozen=True, eq=False)
class Terrain:
    """Heights on a grid.

    Parameters
    ----------
    heights : (rows, columns) float64 ndarray
        Height of each node above the origin [m]; NaN where there is none.
    spacing : (dx, dy) of float
        Step from column to column and from row to row [m]; either may be negative.
    origin : (3,) float64 ndarray
        World position of node (0, 0) at height 0 [m].
    """

    heights: np.ndarray
    spacing: tuple[float, float]
    origin: np.ndarray

    def __post_init__(self) -> None:
        z, spacing = self.heights, self.spacing
        if np.ndim(z) != 2 or min(np.shape(z)) < 2:
            raise ValueError(f"heights need at least 2 rows and 2 columns, not shape {np.shape(z)}")
        if not (np.isfinite(spacing).all() and spacing[0] * spacing[1] != 0):
            raise ValueError(f"the grid's steps must be finite and other than 0, not {spacing}")

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """World (x least, y least, x largest, y largest) [m]."""
        rows, columns = self.heights.shape
        x = sorted((0.0, (columns - 1) * self.spacing[0]))
        y = sorted((0.0, (rows - 1) * self.spacing[1]))
        east, north = self.origin[:2]
        edges = x[0] + east, y[0] + north, x[1] + east, y[1] + north
        return tuple(float(edge) for edge in edges)  # type: ignore[return-value]

    @property
    def centre(self) -> np.ndarray:
        """World position of the middle of the grid, on the ground [m], (3,)."""
        west, south, east, north = self.bounds
        x, y = (west + east) / 2, (south + north) / 2
        return np.array([x, y, self.height_at(np.array(x), np.array(y))])

    def height_at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """World height of the ground [m] at world (x, y) [m], on its triangles.

        NaN outside the grid and in holes.
        """
        column = (np.asarray(x, float) - self.origin[0]) / self.spacing[0]
        row = (np.asarray(y, float) - self.origin[1]) / self.spacing[1]
        return np.asarray(_on_triangles(self.heights, row, column) + self.origin[2])

    def facets(self, *, surface: int = 0) -> Facets:
        """Triangles of the ground, facing upwards, and the nodes that they use."""
        z, (dx, dy) = self.heights, self.spacing
        faces = _triangles(np.isfinite(z))
        if dx * dy < 0:
            faces = faces[:, ::-1]
        used = np.zeros(z.size, bool)
        used[faces.ravel()] = True
        number = np.cumsum(used) - 1
        row, column = np.divmod(np.flatnonzero(used), z.shape[1])
        vertices = np.column_stack([column * dx, row * dy, z.ravel()[used]]) + 0.0  # never -0.0
        return Facets.of(vertices, number[faces], surface=surface, origin=self.origin)


def _triangles(present: np.ndarray) -> np.ndarray:
    """Triangles of all cells, counter-clockwise where rows and columns both increase, (m, 3).

    Whole cells are cut along the diagonal from node (i, j) to (i+1, j+1).
    """
    node = np.arange(present.size).reshape(present.shape)
    # Corners of each cell, counter-clockwise from (i, j).
    a, b, c, d = node[:-1, :-1], node[:-1, 1:], node[1:, 1:], node[1:, :-1]
    here = present.ravel()
    missing = [~here[corner] for corner in (a, b, c, d)]
    lacks = sum(gap.astype(np.int8) for gap in missing)
    lower = np.where(missing[0], d, a), b, c
    upper = a, np.where(missing[2], b, c), d
    # One gap at b spoils the lower triangle, one at d the upper; gaps at a and c are bridged above
    # by the other diagonal, which makes one triangle and leaves the other to be dropped.
    keep_lower = (lacks == 0) | ((lacks == 1) & (missing[0] | missing[3]))
    keep_upper = (lacks == 0) | ((lacks == 1) & (missing[1] | missing[2]))
    return np.concatenate(
        [
            np.stack([corner[keep] for corner in corners], axis=1)
            for corners, keep in ((lower, keep_lower), (upper, keep_upper))
        ]
    )


def _on_triangles(z: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Height of the triangulated grid at fractional rows and columns; NaN where it has none."""
    rows, columns = z.shape
    i = np.clip(np.floor(row), 0, rows - 2).astype(np.int64)
    j = np.clip(np.floor(column), 0, columns - 2).astype(np.int64)
    v, u = row - i, column - j
    a, b, c, d = z[i, j], z[i, j + 1], z[i + 1, j + 1], z[i + 1, j]
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

    A cubic spline: slopes are continuous, so that a beam a few centimetres wide sees no facets of
    the size of the survey's posts. Holes stay as they are: a new node has a height where all the
    nodes around it have one.

    Raises
    ------
    ValueError
        For a factor below 1 or a grid too small for a cubic.
    """
    from scipy.interpolate import RectBivariateSpline
    from scipy.ndimage import distance_transform_edt

    rows, columns = terrain.heights.shape
    if factor < 1 or min(rows, columns) < 4:
        raise ValueError("refining needs a factor of at least 1 and a grid of 4 x 4 nodes or more")
    z, holes = terrain.heights, ~np.isfinite(terrain.heights)
    if holes.all():
        raise ValueError("the terrain has no heights at all")
    if holes.any():  # each is given the height of the nearest node that has one
        z = z[tuple(distance_transform_edt(holes, return_distances=False, return_indices=True))]
    fine_rows = np.arange((rows - 1) * factor + 1)
    fine_columns = np.arange((columns - 1) * factor + 1)
    spline = RectBivariateSpline(range(rows), range(columns), z)
    fine = spline(fine_rows / factor, fine_columns / factor)
    near = holes[fine_rows // factor] | holes[-(-fine_rows // factor)]
    fine[near[:, fine_columns // factor] | near[:, -(-fine_columns // factor)]] = np.nan
    spacing = terrain.spacing[0] / factor, terrain.spacing[1] / factor
    return Terrain(fine, spacing, terrain.origin)


def smooth(terrain: Terrain, *, width: float) -> Terrain:
    """Terrain blurred by a Gaussian of that standard deviation [m].

    Holes stay holes and lend nothing to their neighbours.

    Raises
    ------
    ValueError
        For a negative width, or one beyond the ground's longer side: its memory goes by the width.
    """
    from scipy.ndimage import gaussian_filter

    west, south, east, north = terrain.bounds
    side = max(east - west, north - south)
    if not 0 <= width <= side:
        raise ValueError(f"the smoothing width must be 0 m to the ground's {side:g} m, not {width}")
    there = np.isfinite(terrain.heights)
    sigma = [width / abs(step) for step in reversed(terrain.spacing)]
    kept = np.where(there, terrain.heights, 0.0)
    blurred = gaussian_filter(kept, sigma, mode="nearest")
    weight = gaussian_filter(there.astype(float), sigma, mode="nearest")
    smoothed = np.divide(blurred, weight, where=there, out=np.full_like(kept, np.nan))
    return Terrain(smoothed, terrain.spacing, terrain.origin)
