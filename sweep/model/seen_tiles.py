"""Blocks of what a flight's shots see, tile by tile, from their rays in one pass.

The same as of :func:`sweep.model.eyepoints.seen_ground`, but for effects' bounds, which need
extremes over tiles only: nothing is kept of single beamlets.
"""

from collections.abc import Sequence

import numpy as np

from sweep.model.compiling import borrowing
from sweep.model.effects import tile_geometry
from sweep.model.effects.block import Block
from sweep.model.effects.footprint_fields import FIELDS, ROOM, set_fields
from sweep.model.effects.span import Span
from sweep.model.effects.tile_link import TileLink
from sweep.model.eyepoints import (
    HEIGHT,
    SUNLIGHT,
    Eyepoints,
    axis_parameters,
    height_of_target,
    look_at,
    to_look_at,
)
from sweep.model.geometry.surfaces import Surface


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
    axes = axis_parameters(eyepoints)
    axes[HEIGHT] = instrument[HEIGHT].low + height_of_target(eyepoints)
    values = np.empty((FIELDS + 1 + len(axes), len(eyepoints.time)))
    sun = instrument[SUNLIGHT]
    sent = np.empty(eyepoints.offset.size if not sun.is_zero else 0)
    by_roots = instrument.architecture != "direct"
    _put_fields(eyepoints, surfaces, by_roots, sent, values[:FIELDS])
    lit = sent.reshape(eyepoints.offset.shape).sum(axis=1) if sent.size else 0.0
    values[FIELDS] = sun.low * lit
    for row, value in zip(values[FIELDS + 1 :], axes.values(), strict=True):
        row[:] = value
    spans = tile_geometry.over(values, edges)
    low, high = np.asarray(spans.low), np.asarray(spans.high)
    seen = {path: Span(low[k], high[k]) for k, path in enumerate((SUNLIGHT, *axes), FIELDS)}
    geometry = tile_geometry.of_fields(spans, rotating)
    parameters = {**instrument.parameters, "target.reflectance": Span.of(1.0), **seen}
    return Block(parameters, len(edges) - 1, geometry, instrument=instrument)


def _put_fields(
    eyepoints: Eyepoints,
    surfaces: Sequence[Surface],
    by_roots: bool,
    sent: np.ndarray,
    out: np.ndarray,
) -> None:
    """Fields of footprints, and what beamlets send back where there is room for it."""
    rays, materials = to_look_at(eyepoints, surfaces)
    room = np.empty((ROOM + 5, materials[0].size))
    _look(rays, materials, by_roots, sent, room, np.empty(materials[0].size, np.bool_), out)


@borrowing(nogil=True)
def _look(rays, materials, by_roots, sent, room, beside, out):
    """Fields of footprints, (fields, n); what beamlets send back, where there is room for it."""
    ranges, offset = rays[0], rays[1]
    beamlets = offset.size // ranges.size
    group = beside.size // beamlets
    for first in range(0, ranges.size, group):
        stop = min(first + group, ranges.size)
        start, number = first * beamlets, (stop - first) * beamlets
        relative, doppler, echo = (
            room[ROOM, :number],
            room[ROOM + 1, :number],
            room[ROOM + 2, :number],
        )
        here = sent[start : start + number] if sent.size else room[ROOM + 3, :number]
        others = beside[:number]
        found = here, relative, doppler, echo, others
        several = look_at(first, stop, rays, materials, room[ROOM + 4], found)
        seen = relative, doppler, echo, others
        set_fields(seen, stop - first, several, by_roots, room[:ROOM], out[:, first:stop])
