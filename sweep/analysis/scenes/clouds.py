"""Point clouds gathered within limits, and the ground under them from the map in their store."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.ndimage import map_coordinates

from sweep.analysis import labels
from sweep.analysis.scenes.recording import Interval, Recording, Table, Thinned, confined
from sweep.model.pairing import TRUE

MOST_POINTS, MOST_DROPOUTS, MOST_PATH = 120_000, 20_000, 2000
"""Most points, dropouts and places of the path in a picture; more is thinned."""

MARGIN = 0.04
"""Room around the points, as a share of the longest side of the box that holds them."""

AXES = ("x", "y", "z")

Box = dict[str, tuple[float, float]]
"""Lowest and highest value of x, y and z [m]."""


@dataclass(frozen=True)
class Cloud:
    """Points of a picture, and what else is in it.

    Points have `x`, `y`, `z`, `flags` and the quantities asked for; dropouts (what shots without a
    point aimed at) and the path of the platform `x`, `y`, `z`, empty where not asked for. Total
    numbers are those within the limits, one of `every` is shown; false points `outside` of the box
    of the picture [m] are left out.
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

    @property
    def true(self) -> np.ndarray:
        """Mask of the true points."""
        return np.asarray((self.points["flags"] & TRUE) > 0)

    @property
    def remarks(self) -> list[str]:
        """Numbers of points, dropouts and false points outside, and how many of them are shown."""
        said = [labels.counted(self.total, "point") + _one_in(self.every)]
        if self.dropouts:
            lost = labels.counted(self.total_dropouts, "shot")
            said.append(f"{lost} without a point{_one_in(self.every_dropout)}")
        if self.outside:
            said.append(f"{labels.counted(self.outside, 'false point')} outside of the picture")
        return said


def _one_in(every: int) -> str:
    return f", one in {every} of them shown" if every > 1 else ""


def gathered(
    recording: Recording,
    names: Sequence[str],
    *,
    ranges: str,
    draw: int = 0,
    crops: Mapping[str, Interval] | None = None,
    dropouts: bool = False,
    path: bool = False,
    most: int = MOST_POINTS,
) -> Cloud | None:
    """Points within limits; none where there is none."""
    crops = dict(crops or {})
    places = {name: crop for name, crop in crops.items() if name in AXES}
    kept = list(dict.fromkeys([*AXES, "flags", *names]))
    found, lost, track = Thinned(most), Thinned(MOST_DROPOUTS), Thinned(MOST_PATH)
    for part in recording.stretches(crops.get("time")):
        every = recording.points(list(dict.fromkeys([*kept, *crops])), part, draw, ranges)
        inside = confined(every, crops)
        found.add({name: inside[name] for name in kept})
        time = recording.read("time", part)
        chosen = crops.get("time", Interval()).holds(time)
        if dropouts:
            none = ~(recording.read("flags", part, draw) > 0).any(axis=-1)
            none &= recording.computed(part, draw) & (chosen | ("time" not in crops))
            aims = recording.aims(part)[none]
            aims = aims[np.isfinite(aims[:, 0])]
            lost.add(confined(dict(zip(AXES, aims.T, strict=True)), places))
        if path:
            position = recording.read("platform_position", part)[chosen]
            track.add(dict(zip(AXES, position.T, strict=True)))
    if not found.total:
        return None
    rows = found.rows()
    box = _box(rows, lost.rows(), track.rows(), places)
    inside_box = np.logical_and.reduce([Interval(*box[axis]).holds(rows[axis]) for axis in AXES])
    return Cloud(
        points={name: values[inside_box] for name, values in rows.items()},
        dropouts=lost.rows(),
        path=track.rows(),
        total=found.total,
        total_dropouts=lost.total,
        outside=int((~inside_box).sum()) * found.every,
        every=found.every,
        every_dropout=lost.every,
        box=box,
    )


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


SUN_AZIMUTH, SUN_ELEVATION = 315.0, 40.0
"""Direction of the light that shades the ground [deg], from north by east; and its height."""

STEEPEST = 1.5
"""Slope above which ground is left open: at the edges of crowns and walls, which hide points."""


@dataclass(frozen=True)
class Ground:
    """Heights of the ground (rows, columns) on an even grid; nan where there is none.

    World coordinates x (columns,) and y (rows,) rise; all in metres.
    """

    x: np.ndarray
    y: np.ndarray
    height: np.ndarray

    @classmethod
    def of(cls, tree: xr.DataTree) -> Ground | None:
        """Return the map of a store, or None if it has none, or nothing is on it."""
        if "map_height" not in tree.ds:
            return None
        x, y, height = (np.asarray(tree.ds[f"map_{name}"].values) for name in ("x", "y", "height"))
        return cls(x, y, height) if np.isfinite(height).any() else None

    def cropped(
        self, x: tuple[float, float], y: tuple[float, float], most: int = 120
    ) -> Ground | None:
        """Return the ground within limits, on a grid of as many nodes at the most along each side.

        Heights between the map's nodes are interpolated; none is left where limits miss the map.
        """
        cuts = [
            (max(float(own[0]), low), min(float(own[-1]), high))
            for own, (low, high) in ((self.x, x), (self.y, y))
        ]
        if any(high <= low for low, high in cuts):
            return None
        step = max(high - low for low, high in cuts) / (most - 1)
        nodes = [np.linspace(low, high, max(2, round((high - low) / step) + 1))
                 for low, high in cuts]  # fmt: skip
        places = [
            np.interp(node, own, np.arange(own.size))
            for node, own in zip(nodes, (self.x, self.y), strict=True)
        ]
        rows, columns = np.meshgrid(places[1], places[0], indexing="ij")
        height = map_coordinates(self.height, [rows, columns], order=1, mode="nearest")
        return Ground(nodes[0], nodes[1], height)

    def without_walls(self) -> Ground:
        """Return the ground without what is too steep to be drawn as a surface."""
        steep = np.hypot(*np.gradient(self.height, self.y, self.x)) > STEEPEST
        return Ground(self.x, self.y, np.where(steep, np.nan, self.height))

    def shade(self) -> np.ndarray:
        """Brightness of the ground under a low sun, 0..1, (rows, columns).

        Slopes are stretched until half of them stand out, so that gentle ground shows as well.
        """
        down, across = np.gradient(self.height, self.y, self.x)
        slope = np.hypot(down, across)
        known = slope[np.isfinite(slope)]
        typical = float(np.percentile(known, 80)) if known.size else 0.0
        stretch = 0.6 / typical if typical > 0 else 1.0
        azimuth, elevation = np.radians(90.0 - SUN_AZIMUTH), np.radians(SUN_ELEVATION)
        towards = np.cos(elevation) * (np.cos(azimuth) * across + np.sin(azimuth) * down) * stretch
        lit = (np.sin(elevation) - towards) / np.sqrt(1 + (stretch * slope) ** 2)
        return np.clip(np.where(np.isfinite(lit), lit, 1.0), 0.0, 1.0)
