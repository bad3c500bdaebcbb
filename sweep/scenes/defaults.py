"""The terrain that is always there: matplotlib's sample of the Jacksboro fault, Tennessee."""

from __future__ import annotations

from typing import Any

import numpy as np

from sweep.scenes.degrees import metres_per_degree
from sweep.scenes.terrain import Terrain, refine


def jacksboro(*, size: float | None = None, factor: int = 1) -> Terrain:
    """Heights of the Jacksboro fault, from a survey at 3 arc seconds (USGS).

    A post is 74 m from east to west and 92 m from north to south, so that the ground between them
    is as smooth as `refine` makes it: add relief for what the survey could not see.
    World coordinates are metres from the middle of the piece; heights are above sea level.

    Parameters
    ----------
    size : float, optional
        Side of the square to cut from the middle [m], at least 1 km; all of the 30 km by 32 km by
        default.
    factor : int
        New steps to each old one; 1 leaves the survey's posts.

    Raises
    ------
    ValueError
        For a size under 1 km.
    """
    from matplotlib.cbook import get_sample_data

    sample: Any = get_sample_data("jacksboro_fault_dem.npz")
    with sample as data:
        heights = data["elevation"].astype(float)
        dx, dy = float(data["dx"]), float(data["dy"])
        # The sample names its northern edge ymin; the grid's middle is the same either way.
        middle = (float(data["ymin"]) + float(data["ymax"])) / 2
    east, north = metres_per_degree(middle)
    spacing = dx * east, -dy * north
    if size is not None:
        if not size >= 1000:
            raise ValueError(f"a piece of the terrain must be at least 1 km wide, not {size:g} m")
        heights = _middle(heights, size, spacing)
    rows, columns = heights.shape
    west, top = -(columns - 1) / 2 * spacing[0], -(rows - 1) / 2 * spacing[1]
    terrain = Terrain(heights, spacing, np.array([west, top, 0.0]))
    return refine(terrain, factor=factor) if factor > 1 else terrain


def _middle(heights: np.ndarray, size: float, spacing: tuple[float, float]) -> np.ndarray:
    """The middle of a grid, at least `size` [m] wide where the grid is."""
    steps = spacing[1], spacing[0]
    cuts = []
    for number, step in zip(heights.shape, steps, strict=True):
        kept = min(int(np.ceil(size / abs(step))) + 1, number)
        first = (number - kept) // 2
        cuts.append(slice(first, first + kept))
    return heights[cuts[0], cuts[1]]
