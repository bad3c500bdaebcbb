"""What all pictures of clouds draw alike: marks, ticks, the look of the ground."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator
from scipy.spatial import cKDTree

from sweep.analysis import labels
from sweep.analysis.scenes.cloud import AXES, Box, Cloud
from sweep.analysis.scenes.recording import Table
from sweep.analysis.scenes.terrain import Ground

DROPOUT, PATH, GROUND = "#C1121F", "#1A1A1A", "0.86"

LARGEST = 24.0
"""Area of the largest marks of points [square points]."""

READABLE = ((2000, 9.0), (8000, 5.0), (30_000, 2.0), (math.inf, 0.7))
"""Areas below which marks of so many points are not made [square points]."""

ACROSS, UP = 0.42, 0.25
"""Distances of ticks that can still be read, on level and on upright axes [inches]."""

FAR = 1e5
"""Coordinates [m] from which on axes show them relative to a round number."""


def mark_size(places: np.ndarray, width: float, height: float) -> float:
    """Area of a mark that leaves points apart on a picture, if it can [square points].

    Parameters
    ----------
    places : (2, n) ndarray
        Where they are on the picture [inches].
    width, height
        Size of the picture [inches].
    """
    number = places.shape[1]
    if number < 2:
        return LARGEST
    nearest = cKDTree(places.T).query(places.T[:: max(1, number // 1000)], k=2)[0][:, 1]
    apart = (0.85 * 72 * float(np.median(nearest))) ** 2
    share = 0.1 * 72 * 72 * width * height / number
    least = next(size for most, size in READABLE if number <= most)
    return min(max(min(apart, share), least), LARGEST)


def false_marks(size: float) -> dict[str, Any]:
    """How false points are marked beside true ones of a size."""
    return {"marker": "x", "s": max(1.2 * size, 9.0), "linewidths": 0.7}


def dropout_marks(size: float) -> dict[str, Any]:
    """How shots without a point are marked beside points of a size."""
    return {
        "s": max(1.6 * size, 10.0), "facecolors": "none", "edgecolors": DROPOUT, "linewidths": 0.8,
    }  # fmt: skip


def handles(cloud: Cloud, *, false: bool, ground: bool) -> list[Any]:
    """A legend's entries for the marks of a picture."""
    found: list[Any] = []
    if false:
        found.append(
            Line2D([], [], linestyle="", marker="x", color="0.2", markersize=5, label="false point")
        )
    if cloud.dropouts and cloud.dropouts["x"].size:
        found.append(
            Line2D(
                [], [], linestyle="", marker="o", markerfacecolor="none", markeredgecolor=DROPOUT,
                markersize=5, label="shot without\na point",
            )
        )  # fmt: skip
    if cloud.path:
        found.append(Line2D([], [], color=PATH, linewidth=1.6, label="flight path,\ndot: start"))
    if ground:
        found.append(Patch(color=GROUND, label="heights of\nthe scene"))
    return found


def within(table: Table, box: Box) -> np.ndarray:
    """Places (3, n), nan outside of the box."""
    columns = np.array([table[axis] for axis in AXES])
    low, high = np.array([box[axis] for axis in AXES]).T
    inside = ((columns >= low[:, None]) & (columns <= high[:, None])).all(axis=0)
    return np.where(inside, columns, np.nan)


def label(
    axis: Any, name: str, limits: tuple[float, float], inches: float, apart: float = ACROSS
) -> None:
    """Name, units and ticks of an axis; far-off coordinates relative to a round number.

    Parameters
    ----------
    axis, name, limits
        The axis, what it is called, and its ends [m].
    inches, apart
        Its length on the picture, and the least distance of ticks.
    """
    low, high = limits
    shift = 0.0
    if max(abs(low), abs(high)) > FAR:
        unit = 10.0 ** max(math.ceil(math.log10(high - low)), 0)
        shift = unit * round((low + high) / 2 / unit)
    axis.set_major_locator(FixedLocator(_ticks(low, high, inches / apart)))
    if shift:
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value - shift:g}"))
        name = f"{name} {'-' if shift > 0 else '+'} {abs(shift):.0f}"
    axis.set_label_text(labels.with_units(name, "m"))
    axis.label.set_size(9)
    axis.set_tick_params(labelsize=8)


def _ticks(low: float, high: float, room: float) -> list[float]:
    """Round values on an axis, with at most so many steps between them."""
    found: list[float] = []
    for number in range(max(2, min(int(room), 8)), 0, -1):
        ticks = MaxNLocator(number, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
        found = [float(tick) for tick in ticks if low <= tick <= high] or found
        if len(found) - 1 <= room:
            return found
    return found[len(found) // 2 :][:1]


def paper(ground: Ground) -> np.ndarray:
    """Pale shades of the ground, (rows, columns, 4); see-through where there is none."""
    shade = np.array(colormaps["gray"](0.62 + 0.36 * ground.shade()))
    shade[~np.isfinite(ground.height)] = 0.0
    return shade
