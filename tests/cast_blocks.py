"""Blocks of tiles of shots from footprints that rays have found, beamlet by beamlet."""

from collections.abc import Mapping

import numpy as np

from sweep.model.effects import tile_geometry
from sweep.model.effects.block import Block
from sweep.model.effects.footprint_fields import FIELDS, ROOM, set_fields
from sweep.model.effects.span import Span
from sweep.model.ground import Footprints


def block_of_cast(
    parameters: Mapping[str, np.ndarray | float | str],
    footprints: Footprints,
    beside: np.ndarray | None,
    edges: np.ndarray,
    rotating: bool = False,
) -> Block:
    """The same as of :func:`sweep.model.seen_tiles.block_of`, from footprints that are there.

    Parameters
    ----------
    parameters : mapping
        As of :func:`sweep.model.chain.prepare_cast`: scalars, or (n,) by shot.
    footprints : Footprints
        Of the n shots.
    beside : (rows, beamlets) bool ndarray, optional
        Beamlets on other surfaces than the axis's.
    edges, rotating
        As there.
    """
    edges = np.asarray(edges)
    spans: dict[str, Span | str] = {}
    for path, value in parameters.items():
        array = np.asarray(value)
        if array.dtype.kind in "UO":
            spans[path] = str(array.flat[0])
        else:
            spans[path] = tile_geometry.over(array, edges) if array.ndim else Span.of(array[()])
    row, *seen = footprints
    seen.append(np.zeros(footprints.echo.shape, np.bool_) if beside is None else beside)
    number, beamlets = footprints.echo.shape
    found, room = np.empty((FIELDS, number)), np.empty((ROOM, number * beamlets))
    flat = tuple(np.ascontiguousarray(values).ravel() for values in seen)
    by_roots = spans["instrument.receiver.architecture"] != "direct"
    set_fields(flat, number, by_roots, room, found)
    geometry = tile_geometry.of_fields(tile_geometry.over(found[:, row], edges), rotating)
    return Block(spans, edges.size - 1, geometry)
