"""The points that a figure of a cloud shows, gathered within its limits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sweep.analysis.scenes.recording import Interval, Recording, Table, Thinned, confined
from sweep.model.pairing import TRUE

MOST_POINTS, MOST_DROPOUTS, MOST_PATH = 120_000, 20_000, 2000
"""What a picture still shows apart; more is thinned."""

MARGIN = 0.04
"""Room around the points, as a share of the longest side of the box that holds them."""

AXES = ("x", "y", "z")

Box = dict[str, tuple[float, float]]
"""Lowest and highest value of x, y and z [m]."""


@dataclass(frozen=True)
class Cloud:
    """Points of a picture, and what else is in it.

    Attributes
    ----------
    points : dict of (n,) ndarray
        `x`, `y`, `z`, `colour` and `flags`.
    dropouts, path : dict of (k,) ndarray
        `x`, `y`, `z` of what shots without a point aimed at, and of the platform; empty where
        they are not asked for. A shot that aims at nothing has no place.
    total, total_dropouts, outside : int
        Points and dropouts within the limits; false points that lie outside of the box.
    every, every_dropout : int
        Of how many points one is shown, and of how many dropouts.
    box : dict
        What the picture shows, [m].
    """

    points: Table
    dropouts: Table
    path: Table
    total: int
    total_dropouts: int
    outside: int
    every: int
    every_dropout: int
    box: Box


def gathered(
    recording: Recording,
    *,
    colour: str,
    ranges: str,
    draw: int = 0,
    crops: Mapping[str, Interval] | None = None,
    dropouts: bool = False,
    path: bool = False,
) -> Cloud | None:
    """Points within limits; none where there is none.

    Parameters
    ----------
    recording
        Shots and points of a scanner.
    colour, ranges, draw
        Quantity that colours the points; `quantised` or `interpolated`; number of the draw.
    crops
        Intervals of `x`, `y`, `z` [m] and `time` [s].
    dropouts, path
        Whether to gather what shots without a point aimed at, and where the platform was.
    """
    crops = dict(crops or {})
    places = {name: crop for name, crop in crops.items() if name in AXES}
    names = list(dict.fromkeys([*AXES, "flags", colour, *crops]))
    found, lost, track = Thinned(MOST_POINTS), Thinned(MOST_DROPOUTS), Thinned(MOST_PATH)
    for part in recording.stretches(crops.get("time")):
        table = recording.points(names, part, draw=draw, ranges=ranges)
        found.add(_chosen(confined(table, crops), colour))
        if dropouts:
            lost.add(confined(_aims_of_dropouts(recording, part, draw, crops), places))
        if path:
            track.add(_track(recording, part, crops))
    rows = found.rows()
    if not found.total:
        return None
    box = _box(rows, lost.rows(), track.rows(), places)
    inside = np.logical_and.reduce([Interval(*box[axis]).holds(rows[axis]) for axis in AXES])
    return Cloud(
        points={name: values[inside] for name, values in rows.items()},
        dropouts=lost.rows(),
        path=track.rows(),
        total=found.total,
        total_dropouts=lost.total,
        outside=int((~inside).sum()) * found.every,
        every=found.every,
        every_dropout=lost.every,
        box=box,
    )


def _chosen(table: Table, colour: str) -> Table:
    return {axis: table[axis] for axis in AXES} | {
        "colour": table[colour],
        "flags": table["flags"],
    }


def _aims_of_dropouts(
    recording: Recording, part: slice, draw: int, crops: Mapping[str, Interval]
) -> Table:
    """What computed shots without a point truly aimed at."""
    time = recording.read("time", part)
    none = ~(recording.read("flags", part, draw) > 0).any(axis=-1)
    none &= recording.computed(part, draw)
    if "time" in crops:
        none &= crops["time"].holds(time)
    aims = recording.aims(part)[none]
    return dict(zip(AXES, aims[np.isfinite(aims[:, 0])].T, strict=True))


def _track(recording: Recording, part: slice, crops: Mapping[str, Interval]) -> Table:
    """Where the platform was."""
    time = recording.read("time", part)
    chosen = crops.get("time", Interval()).holds(time)
    return dict(zip(AXES, recording.read("platform_position", part)[chosen].T, strict=True))


def _box(rows: Table, lost: Table, track: Table, places: Mapping[str, Interval]) -> Box:
    """Box around what a figure shows: asked limits, else true points, dropouts and the path."""
    true = (rows["flags"] & TRUE) > 0
    box: Box = {}
    for axis in AXES:
        values = rows[axis][true] if true.any() else rows[axis]
        every = [values, *(t[axis] for t in (lost, track) if t)]
        crop = places.get(axis, Interval())
        low = min(float(v.min()) for v in every if v.size)
        high = max(float(v.max()) for v in every if v.size)
        box[axis] = (max(low, crop.low), min(high, crop.high))
    room = MARGIN * max(max(high - low for low, high in box.values()), 1.0)
    return {axis: (low - room, high + room) for axis, (low, high) in box.items()}
