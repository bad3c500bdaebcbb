"""Extension of adjacent rasters of one grid, so that no gaps remain between them.

The nodes of a raster lie at the centres of its pixels. Between the last nodes of one tile and the
first nodes of the next there is therefore a gap of one pixel. Each tile is extended by one row and
one column of its neighbours' nodes, towards rising rows and columns, so that each gap is closed
once.

::

    a a a | b b b        a a a b            b b b
    a a a | b b b   ->   a a a b            b b b
    ------+------        c c c d            d d d
    c c c | d d d                   c c c d       d d d
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sweep.scenes.terrain import Terrain

_ALIGNMENT_TOLERANCE_CELLS = 1e-3
"""Largest deviation of the offset between two grids from a multiple of the cell size [cells].

Up to this deviation, two grids count as parts of one grid.
"""

_ADJACENT_GAP_MAX_CELLS = 2.0
"""Largest gap between two grids that count as adjacent [cells of the coarser grid]."""


class ExtendedTiles(NamedTuple):
    """Rasters that meet their neighbours without gaps, as far as their grids agree."""

    terrains: dict[str, Terrain]
    """Tiles after extension, by name."""
    warnings: list[str]
    """Sentences about gaps that remain between adjacent tiles with different grids."""


def extend_tiles_to_neighbours(tiles: Mapping[str, Terrain]) -> ExtendedTiles:
    """Extend each tile by the first row and column of nodes of its neighbours, to close gaps.

    Parameters
    ----------
    tiles : Mapping of str to Terrain
        Tiles by name.

    Returns
    -------
    ExtendedTiles
        Extended tiles, and warnings of gaps that remain.
    """
    names = list(tiles)
    joined = {}
    warnings = []
    for name in names:
        others = [tiles[other] for other in names if other != name]
        joined[name] = _extend_tile(tiles[name], others)
    for k, name in enumerate(names):
        for other in names[:k]:
            width = _gap_width(tiles[name], tiles[other])
            if width:
                warnings.append(
                    f"scene.objects.{name}: between it and {other} lies a gap of {width:.3g} m "
                    "without ground, as their grids differ: join the files with gdalwarp"
                )
    return ExtendedTiles(joined, warnings)


def _grid_offset(tile: Terrain, other: Terrain) -> tuple[int, int] | None:
    """Return the row and column, in the grid of a tile, of another tile's first node.

    The result is None if the two tiles are on different grids.
    """
    (dx, dy), (rows, columns) = tile.spacing, other.heights.shape
    for step, other_step, number in ((dx, other.spacing[0], columns), (dy, other.spacing[1], rows)):
        if not abs(other_step - step) * number <= _ALIGNMENT_TOLERANCE_CELLS * abs(step):
            return None
    origin_shift = other.origin - tile.origin
    column, row = origin_shift[0] / dx, origin_shift[1] / dy
    if max(abs(column - round(column)), abs(row - round(row))) > _ALIGNMENT_TOLERANCE_CELLS:
        return None
    return round(row), round(column)


def _extend_tile(tile: Terrain, others: list[Terrain]) -> Terrain:
    """Return a tile extended by one row and one column of heights from adjacent tiles.

    A row or column without any height is not added. A tile that gains neither is returned
    unchanged.
    """
    rows, columns = tile.heights.shape
    heights = np.full((rows + 1, columns + 1), np.nan)
    heights[:rows, :columns] = tile.heights
    for other in others:
        offset = _grid_offset(tile, other)
        # An overlapping neighbour leaves no gap.
        if offset is None or not (offset[0] == rows or offset[1] == columns):
            continue
        row, column = offset
        first, last = max(row, 0), min(row + other.heights.shape[0], rows + 1)
        left, right = max(column, 0), min(column + other.heights.shape[1], columns + 1)
        if first < last and left < right:
            overlap = other.heights[first - row : last - row, left - column : right - column]
            heights[first:last, left:right] = overlap
    new_rows = rows + int(np.isfinite(heights[rows]).any())
    new_columns = columns + int(np.isfinite(heights[:, columns]).any())
    if (new_rows, new_columns) == (rows, columns):
        return tile
    return replace(tile, heights=heights[:new_rows, :new_columns])


def _gap_width(tile: Terrain, other: Terrain) -> float:
    """Return the width of the gap between two tiles on different grids [m].

    The width is 0 if the tiles are on one grid, overlap, or are not adjacent.
    """
    if _grid_offset(tile, other) is not None:
        return 0.0
    tile_bounds, other_bounds = (
        np.array(tile.bounds).reshape(2, 2),
        np.array(other.bounds).reshape(2, 2),
    )
    separation = np.maximum(tile_bounds[0], other_bounds[0]) - np.minimum(
        tile_bounds[1], other_bounds[1]
    )  # negative if they overlap
    cell_size = np.maximum(np.abs(tile.spacing), np.abs(other.spacing))
    for axis in (0, 1):
        if (
            0 < separation[axis] < _ADJACENT_GAP_MAX_CELLS * cell_size[axis]
            and separation[1 - axis] < 0
        ):
            return float(separation[axis])
    return 0.0
