"""Coarse grids made finer, and quantised ones smooth."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import distance_transform_edt, gaussian_filter

from sweep.model.geometry.terrain import Terrain


def refine(terrain: Terrain, *, factor: int) -> Terrain:
    """Terrain with `factor` times as many steps a side, through all the given heights.

    A cubic spline: slopes are continuous, so that a beam a few centimetres wide sees no facets of
    the size of the survey's posts. Holes stay as they are: a new node has a height where all the
    nodes around it have one.

    Parameters
    ----------
    terrain : Terrain
        Grid of at least 4 x 4 nodes.
    factor : int
        New steps to each old one, at least 1.

    Raises
    ------
    ValueError
        For a factor below 1 or a grid too small for a cubic.
    """
    rows, columns = terrain.heights.shape
    if factor < 1 or min(rows, columns) < 4:
        raise ValueError("refining needs a factor of at least 1 and a grid of 4 x 4 nodes or more")
    holes = ~np.isfinite(terrain.heights)
    spline = RectBivariateSpline(range(rows), range(columns), _filled(terrain.heights, holes))
    fine_rows = np.arange((rows - 1) * factor + 1)
    fine_columns = np.arange((columns - 1) * factor + 1)
    fine = spline(fine_rows / factor, fine_columns / factor)
    fine[_near_a_hole(holes, fine_rows, fine_columns, factor)] = np.nan
    spacing = terrain.spacing[0] / factor, terrain.spacing[1] / factor
    return Terrain(fine, spacing, terrain.origin)


def _near_a_hole(
    holes: np.ndarray, fine_rows: np.ndarray, fine_columns: np.ndarray, factor: int
) -> np.ndarray:
    """Where one of the (up to four) old nodes around a new node has no height."""
    low, high = fine_rows // factor, -(-fine_rows // factor)
    left, right = fine_columns // factor, -(-fine_columns // factor)
    rows = holes[low] | holes[high]
    return np.asarray(rows[:, left] | rows[:, right])


def _filled(z: np.ndarray, holes: np.ndarray) -> np.ndarray:
    """Heights with each hole given the value of the nearest node that has one."""
    if not holes.any():
        return z
    if holes.all():
        raise ValueError("the terrain has no heights at all")
    nearest = distance_transform_edt(holes, return_distances=False, return_indices=True)
    return np.asarray(z[tuple(nearest)])


def smooth(terrain: Terrain, *, width: float) -> Terrain:
    """Terrain blurred by a Gaussian; holes stay holes and lend nothing to their neighbours.

    Parameters
    ----------
    terrain : Terrain
        Grid of heights.
    width : float
        Standard deviation of the Gaussian [m], >= 0.

    Raises
    ------
    ValueError
        For a negative width, or one beyond the ground's longer side: its memory goes by the width.
    """
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
