"""Blocks of what a flight's shots see, tile by tile, for the effects' bounds."""

from collections.abc import Sequence

import numpy as np

from sweep.model.effects import tile_geometry
from sweep.model.effects.block import Block
from sweep.model.effects.footprint_fields import FIELDS, ROOM, set_fields
from sweep.model.effects.span import Span
from sweep.model.effects.tile_link import TileLink
from sweep.model.eyepoints import HEIGHT, SUNLIGHT, Eyepoints, seen_ground
from sweep.model.geometry.mesh import Surface


def block_of(
    eyepoints: Eyepoints,
    instrument: TileLink,
    surfaces: Sequence[Surface],
    edges: np.ndarray,
    rotating: bool,
) -> Block:
    """The block of some tiles of shots.

    Parameters
    ----------
    eyepoints, surfaces
        As of :func:`sweep.model.eyepoints.seen_ground`.
    instrument : TileLink
        Of the parameters there, each the same for all shots.
    edges : (tiles + 1,) int ndarray
        Tile i holds the shots from ``edges[i]`` up to ``edges[i + 1]``, one at least.
    rotating : bool
        Whether any surface belongs to a body that turns.
    """
    fixed = {path: instrument[path].low for path in (HEIGHT, SUNLIGHT)}
    shots, ground = seen_ground(eyepoints, fixed, surfaces)
    shots = {path: value for path, value in shots.items() if path != "target.reflectance"}
    values = np.empty((FIELDS + len(shots), len(eyepoints.time)))
    rays = tuple(each.ravel() for each in (*ground.beamlets[1:], np.asarray(ground.beside)))
    by_roots, room = instrument.architecture != "direct", np.empty((ROOM, rays[0].size))
    set_fields(rays, len(eyepoints.time), by_roots, room, values[:FIELDS])
    for row, value in zip(values[FIELDS:], shots.values(), strict=True):
        row[:] = value
    spans = tile_geometry.over(values, edges)
    low, high = np.asarray(spans.low), np.asarray(spans.high)
    seen = {path: Span(low[k], high[k]) for k, path in enumerate(shots, FIELDS)}
    geometry = tile_geometry.of_fields(spans, rotating)
    parameters = {**instrument.parameters, "target.reflectance": Span.of(1.0), **seen}
    return Block(parameters, len(edges) - 1, geometry, instrument=instrument)
