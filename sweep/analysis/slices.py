"""A quantity along one coordinate, a line for each value of another."""

from __future__ import annotations

import math
import textwrap

import dask
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet

from sweep.analysis import canvas, labels, surface
from sweep.analysis.cells import HIGHEST, LOWEST, MEAN
from sweep.analysis.selection import Points, split

MOST_LINES = 8
MOST_TOGETHER = 4
"""Lines that one panel can hold and still be read; more have panels of their own."""

MOST_PANELS = 6
COLUMNS = 500
"""Stretches into which a long line is cut, a mean and a worst value of each."""

KINDS = (MEAN, LOWEST, HIGHEST)

WIDTH, PANEL_HEIGHT = 10.0, 3.6


def draw(
    found: Points, *, x: str, by: str, variable: str, long_name: str, title: str, note: str
) -> Sheet:
    """A variable along `x`, a line for each value of `by` (none where empty).

    Parameters
    ----------
    found
        The points, with the variable.
    x, by, variable, long_name
        Coordinates, and the variable with its name in words.
    title, note
        What stands over the sheet, and what is to be added at its foot.
    """
    others = found.further([x, by] if by else [x])
    parts, without_panel = split(found, others, MOST_PANELS)
    lines, without_line = split(found, [by] if by else [], MOST_LINES)
    names = [name for name, _ in lines]
    drawn = [
        (i, names.index(line), own)
        for i, (_, part) in enumerate(parts)
        for line, own in split(part, [by] if by else [], MOST_LINES)[0]
        if line in names
    ]
    values = _values([own for _, _, own in drawn], x, variable)
    packed = any(LOWEST in own for _, own in values)
    apart = len(lines) > (1 if packed else MOST_TOGETHER)
    factor, units = surface.shown_along(found, x)
    a_part = len(lines) if apart else 1
    rows = len(parts) * a_part
    height = 1.75 if apart else PANEL_HEIGHT
    sheet, axes = canvas.panels(WIDTH, height * rows + 1.4, rows, 1, sharex=True, sharey=True)
    for (i, j, _), (along, own) in zip(drawn, values, strict=True):
        panel = axes[i * a_part + (j if apart else 0)]
        _line(panel, surface.place(along, factor), own, j, names[j])
    wide = surface.scale(
        variable, np.concatenate([line for _, own in values for line in own.values()])
    )
    for i, panel in enumerate(axes):
        decades = isinstance(wide, surface.LogNorm)
        _finish(panel, variable, parts[i // a_part][0], decades, legend=not apart and bool(by))
    _label(axes[-1], found, x, factor)
    axes[-1].set_xlabel(labels.with_units(labels.coordinate(x), units))
    sheet.supylabel(textwrap.fill(long_name, 44), fontsize=10)
    canvas.title(sheet, title)
    remarks = _remarks(packed, len(found.distinct(x)), without_panel + without_line)
    canvas.caption(sheet, labels.joined([*remarks, note]))
    return sheet


def _values(
    lines: list[Points], x: str, variable: str
) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Where each line's points or stretches lie, and its values there by kind."""
    sides = [line.side(x) for line in lines]
    most = [COLUMNS if side.values.size > 2 * COLUMNS else 2 * COLUMNS for side in sides]
    kinds = [
        KINDS if side.together(m) > 1 else KINDS[:1] for side, m in zip(sides, most, strict=True)
    ]
    lazy = [
        line.cells(variable, [(side, m)], kind).data
        for line, side, m, own in zip(lines, sides, most, kinds, strict=True)
        for kind in own
    ]
    flat = iter(dask.compute(*lazy))
    return [
        (side.middles(m), {kind: np.asarray(next(flat), float) for kind in own})
        for side, m, own in zip(sides, most, kinds, strict=True)
    ]


def _line(
    axes: Axes, along: np.ndarray, values: dict[str, np.ndarray], index: int, name: str
) -> None:
    """One line; of a long one the mean of each stretch, over the band that its points fill."""
    colour = canvas.LINES[index % len(canvas.LINES)]
    dash = canvas.DASHES[index % len(canvas.DASHES)]
    if LOWEST in values:
        low, high = values[LOWEST], values[HIGHEST]
        axes.fill_between(along, low, high, color=colour, alpha=0.22, linewidth=0, step="mid")
        dash = "-"
    markers = "o" if along.size <= 40 else ""
    axes.plot(
        along, values[MEAN], color=colour, linestyle=dash, linewidth=1.3, marker=markers,
        markersize=3.5, label=name,
    )  # fmt: skip


def _label(axes: Axes, found: Points, x: str, factor: float) -> None:
    """Limits, scale and words of the coordinate along which lines run."""
    distinct = np.unique(found.column(x).values)
    if labels.is_words(distinct):
        axes.set_xticks(np.arange(distinct.size), [str(word) for word in distinct])
    elif distinct.size > 1:
        values = distinct * factor
        axes.set_xlim(float(values.min()), float(values.max()))
        axes.set_xscale("log" if surface.is_geometric(values) else "linear")


def _finish(axes: Axes, variable: str, name: str, decades: bool, *, legend: bool) -> None:
    """Limits, grid, legend and title of one panel."""
    if variable.startswith("pd_"):
        axes.set_ylim(-0.03, 1.03)
    elif decades:
        axes.set_yscale("log")
    axes.grid(True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    lines = axes.get_legend_handles_labels()[1]
    if legend:
        axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    names = [name] if legend else [name, *lines]
    axes.set_title(", ".join(filter(None, names)), size=9, loc="left")


def _remarks(packed: bool, points: int, left_out: int) -> list[str]:
    """What a reader has to know of how it was drawn."""
    remarks = []
    if packed:
        each = math.ceil(points / COLUMNS)
        remarks.append(
            f"line: mean of {each} neighbouring points; band: from the lowest of them to the "
            "highest, so that no narrow dip is hidden"
        )
    if left_out:
        remarks.append(f"{left_out} further values are not drawn")
    return remarks
