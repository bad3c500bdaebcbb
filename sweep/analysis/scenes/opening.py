"""A scene's store as an xarray DataTree, with how much of it is there."""

from __future__ import annotations

import math
from typing import Any

import xarray as xr

from sweep.analysis.opening import SCENE, progress, read_attributes, refuse_lost
from sweep.storage.locations import Location, located
from sweep.storage.opening import CHECKED
from sweep.storage.unreplaced import readable

STRETCH = 8192
"""Shots, times draws, that are read at a time."""


def open_scene(path: str | Location) -> xr.DataTree:
    """The store of a scene's point clouds as a tree: a group for each scanner.

    Arrays are read when they are needed, as Dask arrays in the chunks of the store. What is not
    computed yet is nan, -1 for numbers of beams, surfaces and cycles, 0 for flags.

    Parameters
    ----------
    path
        The store, complete or not.

    Returns
    -------
    xarray.DataTree
        Its attributes are the store's and: `started`, `finished` (UTC; empty where there is
        nothing to tell), `points`, `points_committed` (shots times draws), `blocks` and
        `blocks_committed`.

    Raises
    ------
    NotAStoreError
        Where there is no store of a scene.
    """
    return opened(located(path), chunks={})


def opened(path: Location, chunks: dict[str, int] | None = None) -> xr.DataTree:
    """As :func:`open_scene`; without chunks, arrays are plain ones that are read where sliced."""
    attributes = read_attributes(path, SCENE)
    refuse_lost(path)
    store = readable(path, attributes["study_id"])
    tree = xr.open_datatree(store, engine="zarr", chunks=chunks, **CHECKED)
    tree.encoding["source"] = str(path)
    tree.attrs |= progress(path, *_extent(tree, attributes))
    return tree


def _extent(tree: xr.DataTree, attributes: dict[str, Any]) -> tuple[int, int]:
    """Shots times draws of all scanners, and the blocks that they are computed in."""
    points, blocks = 0, 0
    for scanner in attributes["scanners"]:
        flags = tree[scanner]["flags"]
        cuts = flags.encoding["chunks"]
        points += flags.size // flags.sizes["return_number"]
        blocks += math.prod(math.ceil(n / cut) for n, cut in zip(flags.shape, cuts, strict=True))
    return points, blocks


def chunk(array: xr.DataArray, dim: str) -> int:
    """Length along a dimension of the chunks that an array is stored in."""
    return int(array.encoding.get("preferred_chunks", {}).get(dim, array.sizes[dim]))


def stretches(array: xr.DataArray, dim: str, size: int = STRETCH) -> list[slice]:
    """Slices along a dimension: whole chunks of the array in each, and few of them."""
    number, cut = array.sizes[dim], chunk(array, dim)
    step = cut * max(1, size // cut)
    return [slice(first, min(first + step, number)) for first in range(0, number, step)]
