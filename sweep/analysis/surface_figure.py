"""The sheet of a surface: a panel for each value of what else varies, mean and worst of each."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet

from sweep.analysis import canvas, labels, surface
from sweep.analysis.cells import MEAN
from sweep.analysis.selection import Points, split

WIDTH, PANEL_HEIGHT = 9.5, 4.4


def draw(
    found: Points, *, x: str, y: str, variable: str, long_name: str, title: str, note: str
) -> Sheet:
    """A variable over two coordinates.

    Parameters
    ----------
    found
        The points, with the variable.
    x, y, variable, long_name
        Coordinates, and the variable with its name in words.
    title, note
        What stands over the sheet, and what is to be added at its foot.
    """
    parts, left_out = split(found, found.further([x, y]), surface.MOST_PANELS)
    columns = 1 if len(parts) == 1 else 2
    most = surface.MOST_COLUMNS // columns, surface.MOST_ROWS
    by = tuple(
        max(part.side(name).together(m) for _, part in parts)
        for name, m in zip((x, y), most, strict=True)
    )
    kinds = [MEAN, surface.worst(variable)] if max(by) > 1 else [MEAN]
    kinds = [kind for kind in kinds if kind]
    grids = surface.grids([part for _, part in parts], variable, x, y, kinds, most)
    rows = math.ceil(len(grids) / columns)
    sheet, axes = canvas.panels(
        WIDTH * (1 + 0.4 * (columns - 1)), PANEL_HEIGHT * rows + 0.8, rows, columns,
        sharex=True, sharey=True,
    )  # fmt: skip
    norm = surface.scale(variable, np.concatenate([grid.values.ravel() for grid in grids]))
    (across, x_units), (up, y_units) = surface.shown_along(found, x), surface.shown_along(found, y)
    names = [(name, f"{kind} of each cell" * (max(by) > 1)) for name, _ in parts for kind in kinds]
    for panel, grid, words in zip(axes, grids, names, strict=False):
        surface.paint(panel, grid, (across, up), norm)
        panel.set_title(", ".join(filter(None, words)), size=10)
    _label(axes, len(grids), columns, (x, x_units), (y, y_units))
    surface.bar(sheet, axes, norm, long_name)
    canvas.title(sheet, title)
    canvas.caption(sheet, labels.joined([*_remarks(grids, by, kinds, left_out), note]))
    return sheet


def _label(
    axes: list[Axes], number: int, columns: int, x: tuple[str, str], y: tuple[str, str]
) -> None:
    """Names and units of the two coordinates, on the outer ones of the panels in use."""
    for i, panel in enumerate(axes):
        panel.set_visible(i < number)
        if i + columns >= number:
            panel.set_xlabel(labels.with_units(labels.coordinate(x[0]), x[1]))
            panel.tick_params(labelbottom=True)
        if i % columns == 0:
            panel.set_ylabel(labels.with_units(labels.coordinate(y[0]), y[1]))


def _remarks(
    grids: list[surface.Grid], by: tuple[int, ...], kinds: list[str], left_out: int
) -> list[str]:
    """What a reader has to know of how it was drawn."""
    remarks = []
    if max(by) > 1:
        remarks.append(f"each cell stands for {math.prod(by)} neighbouring points: their mean")
        if len(kinds) > 1:
            remarks[0] += f", and the {kinds[1]} of them, which hides no narrow dip or peak"
    if left_out:
        remarks.append(f"{left_out} further values have no panel here")
    if any(np.isnan(grid.values).any() for grid in grids):
        remarks.append("grey: not computed")
    return remarks
