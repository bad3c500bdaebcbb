"""Pieces cut out of a ground."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sweep.model.geometry.terrain import Terrain


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
