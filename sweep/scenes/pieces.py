"""Pieces of a ground, cut out or marked off."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sweep.scenes.terrain import Terrain


def piece(terrain: Terrain, *, centre: Sequence[float], size: float) -> Terrain:
    """The part of a terrain within a square, widened to whole grid steps.

    Parameters
    ----------
    terrain : Terrain
        The ground.
    centre : (x, y) of float
        World position of the middle of the square [m].
    size : float
        Side of the square [m], > 0.

    Raises
    ------
    ValueError
        Where the square holds no cell of the terrain.
    """
    cuts, corner = [], terrain.origin.copy()
    for axis in (1, 0):
        step, number = terrain.spacing[axis], terrain.heights.shape[1 - axis]
        middle = (centre[axis] - terrain.origin[axis]) / step
        reach = size / 2 / abs(step)
        # A hair past a node is that node: positions come from sums that were rounded.
        first = max(math.floor(middle - reach + 1e-9), 0)
        last = min(math.ceil(middle + reach - 1e-9), number - 1)
        if last <= first:
            raise ValueError(
                f"there is no ground within {size / 2:g} m of ({centre[0]:g}, {centre[1]:g}) m"
            )
        corner[axis] += first * step
        cuts.append(slice(first, last + 1))
    return Terrain(terrain.heights[cuts[0], cuts[1]], terrain.spacing, corner)


def square(
    terrain: Terrain, *, centre: Sequence[float], size: float
) -> tuple[float, float, float, float]:
    """World (x least, y least, x largest, y largest) of a square, as far as there is ground [m].

    Parameters as of :func:`piece`.

    Raises
    ------
    ValueError
        Where the square holds nothing of the terrain.
    """
    west, south, east, north = terrain.bounds
    (x, y), half = centre[:2], size / 2
    bounds = max(x - half, west), max(y - half, south), min(x + half, east), min(y + half, north)
    if not (bounds[0] < bounds[2] and bounds[1] < bounds[3]):
        raise ValueError(f"there is no ground within {half:g} m of ({x:g}, {y:g}) m")
    return bounds
