"""A quantity along one coordinate, a line for each value of another."""

from __future__ import annotations

import textwrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet

from sweep.analysis import along, canvas, labels, surface
from sweep.analysis.selection import Points, split

MOST_LINES = 8
MOST_TOGETHER = 4
"""Lines that one panel can hold and still be read; more have panels of their own."""

MOST_PANELS = 6
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
    made = along.lines([(own, variable) for _, _, own in drawn], x)
    packed = any(line.together > 1 for line in made)
    apart = len(lines) > (1 if packed else MOST_TOGETHER)
    factor, units = surface.shown_along(found, x)
    a_part = len(lines) if apart else 1
    rows = len(parts) * a_part
    height = 1.75 if apart else PANEL_HEIGHT
    sheet, axes = canvas.panels(WIDTH, height * rows + 1.4, rows, 1, sharex=True, sharey=True)
    for (i, j, _), line in zip(drawn, made, strict=True):
        _line(axes[i * a_part + (j if apart else 0)], line, factor, j, names[j])
    wide = surface.scale(variable, np.concatenate([line.mean for line in made]))
    for i, panel in enumerate(axes):
        decades = isinstance(wide, surface.LogNorm)
        _finish(panel, variable, parts[i // a_part][0], decades, legend=not apart and bool(by))
    _label(axes[-1], found, x, factor)
    axes[-1].set_xlabel(labels.with_units(labels.coordinate(x), units))
    sheet.supylabel(textwrap.fill(long_name, 44), fontsize=10)
    canvas.title(sheet, title)
    left_out = without_panel + without_line
    remarks = [*dict.fromkeys(line.remark for line in made)]
    remarks += [f"{left_out} further values are not drawn"] if left_out else []
    canvas.caption(sheet, labels.joined([*remarks, note]))
    return sheet


def _line(axes: Axes, line: along.Line, factor: float, index: int, name: str) -> None:
    """One line over its band."""
    colour = canvas.LINES[index % len(canvas.LINES)]
    dash = canvas.DASHES[index % len(canvas.DASHES)]
    x = surface.place(line.x, factor)
    if line.low is not None and line.high is not None:
        axes.fill_between(
            x, line.low, line.high, color=colour, alpha=0.22, linewidth=0,
            step="mid" if line.together > 1 else None,
        )  # fmt: skip
    axes.plot(
        x, line.mean, color=colour, linestyle="-" if line.together > 1 else dash, linewidth=1.3,
        marker="o" if x.size <= 40 else "", markersize=3.5, label=name,
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
