"""A quantity of shots or of points over another."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet
from matplotlib.lines import Line2D

from sweep.analysis import canvas, labels
from sweep.analysis.scenes import colours, marks
from sweep.analysis.scenes.quantities import CATEGORIES, QUANTITIES, SIGNED, WIDE, label, shown
from sweep.analysis.scenes.recording import Interval, Recording, Thinned, confined
from sweep.analysis.scenes.stage import Stage
from sweep.model.pairing import TRUE

MOST = 200_000
"""Points that a picture still shows apart; more is thinned."""

SIZE = 7.6, 4.6
LABELS = 0.8, 0.55
"""Size of the picture, and room for ticks and labels at its left and foot [inches]."""


def gathered(
    recording: Recording, names: Sequence[str], *, draw: int, ranges: str, time: Interval | None
) -> Thinned:
    """Quantities of every point, or of every shot where all of them are a shot's.

    Parameters
    ----------
    recording
        Shots and points of a scanner.
    names
        The quantities.
    draw, ranges, time
        Number of the draw; `quantised` or `interpolated`; part of the flight [s], all by default.
    """
    of_points = any(QUANTITIES[name].of_points for name in names)
    crops = {"time": time} if time else {}
    found = Thinned(MOST)
    for part in recording.stretches(time):
        if of_points:
            table = recording.points(
                [*dict.fromkeys([*names, "flags", "time"])], part, draw=draw, ranges=ranges
            )
        else:
            known = recording.computed(part)
            table = {
                name: recording.of_shots(name, part)[known]
                for name in dict.fromkeys([*names, "time"])
            }
        found.add(confined(table, crops))
    return found


def draw(
    found: Thinned,
    *,
    x: str,
    y: str,
    colour: str,
    surfaces: Sequence[str],
    title: str,
    remarks: Sequence[str],
) -> Sheet:
    """The sheet.

    Parameters
    ----------
    found
        The quantities.
    x, y, colour
        Those along the axes, and the one that colours the points.
    surfaces
        Names of surfaces by number.
    title, remarks
        What stands over the sheet, and what is to be said at its foot.
    """
    table = found.rows()
    true = (table["flags"] & TRUE) > 0 if "flags" in table else np.ones(len(table[x]), bool)
    values = shown(colour, table[colour])
    scale = colours.chosen(colour, values, trusted=true, surfaces=surfaces)
    columns = {name: shown(name, table[name]) for name in (x, y)}
    limits = {name: _limits(name, columns[name], true) for name in (x, y)}
    inside = np.logical_and.reduce([Interval(*limits[n]).holds(columns[n]) for n in (x, y)])
    stage = Stage(
        SIZE[0] + LABELS[0], SIZE[1] + LABELS[1], title=title,
        note=labels.joined([*_counted(found, inside, true), *remarks]),
    )  # fmt: skip
    axes = stage.axes(*LABELS, *SIZE)
    _dress(axes, limits, (x, y))
    paint = scale.of(values)
    size = marks.mark_size(_on_paper([columns[n][inside] for n in (x, y)], axes), *SIZE)
    real, other = inside & true, inside & ~true
    axes.scatter(columns[x][real], columns[y][real], s=size, c=paint[real], linewidths=0, zorder=3)
    axes.scatter(
        columns[x][other], columns[y][other], c=paint[other], zorder=2, **marks.false_marks(size)
    )
    false = Line2D([], [], linestyle="", marker="x", color="0.2", markersize=5, label="false point")
    stage.explain(scale, [false] if other.any() else [])
    return stage.sheet


def _on_paper(columns: list[np.ndarray], axes: Axes) -> np.ndarray:
    """Where points are on the picture (2, n) [inches]."""
    return axes.transData.transform(np.array(columns).T).T / canvas.DPI


def _limits(name: str, values: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Ends of an axis: those of true points, with a margin; infinite where that must be."""
    known = values[true & np.isfinite(values)]
    known = known if known.size else values[np.isfinite(values)]
    known = known[known > 0] if name in WIDE else known
    if not known.size:
        return 0.0, 1.0
    low, high = float(known.min()), float(known.max())
    if name in WIDE:
        return low / 1.3, high * 1.3
    room = 0.04 * (high - low) or 0.05 * abs(high) or 0.5
    return low - room, high + room


def _dress(axes: Axes, limits: dict[str, tuple[float, float]], names: tuple[str, str]) -> None:
    """Limits, scales, labels and grid."""
    sides: tuple[Literal["x", "y"], ...] = ("x", "y")
    for side, name in zip(sides, names, strict=True):
        axes.set(**{f"{side}scale": "log" if name in WIDE else "linear"})
        axes.set(**{f"{side}label": textwrap.fill(label(name), 52), f"{side}lim": limits[name]})
        if name in CATEGORIES:
            axes.locator_params(axis=side, integer=True)
    axes.grid(True, color="0.92", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8)
    if names[1] in SIGNED and limits[names[1]][0] < 0 < limits[names[1]][1]:
        axes.axhline(0.0, color="0.6", linewidth=0.8, zorder=1)


def _counted(found: Thinned, inside: np.ndarray, true: np.ndarray) -> list[str]:
    what = labels.counted(found.total, "point" if "flags" in found.rows() else "shot")
    said = [what + f", one in {found.every} of them shown" * (found.every > 1)]
    outside = int((~inside & ~true).sum()) * found.every
    if outside:
        said.append(f"{labels.counted(outside, 'false point')} outside of the picture")
    return said
