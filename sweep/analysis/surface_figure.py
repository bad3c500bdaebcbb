"""The sheet of a surface: a panel for each value of what else varies, mean and worst of each."""

from __future__ import annotations

import math
from itertools import product

from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet

from sweep.analysis import canvas, labels, surface
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
    others = found.further([x, y])
    parts, left_out = split(found, others, surface.MOST_PANELS)
    grids = [(name, surface.gridded(part, x, y, variable)) for name, part in parts]
    most = surface.MOST_COLUMNS if len(grids) == 1 else surface.MOST_COLUMNS // 2
    packed = max(max(g.x.size / most, g.y.size / surface.MOST_ROWS) for _, g in grids) > 1
    kinds = ["mean", surface.worst(variable)] if packed else ["mean"]
    kinds = [kind for kind in kinds if kind]
    columns = 1 if len(grids) == 1 else 2
    rows = math.ceil(len(grids) * len(kinds) / columns)
    sheet, axes = canvas.panels(
        WIDTH * (1 + 0.4 * (columns - 1)), PANEL_HEIGHT * rows + 0.8, rows, columns,
        sharex=True, sharey=True,
    )  # fmt: skip
    norm = surface.scale(variable, found.variables[variable])
    (across, x_units), (up, y_units) = surface.shown_along(found, x), surface.shown_along(found, y)
    for panel, ((name, grid), kind) in zip(axes, product(grids, kinds), strict=False):
        cells = surface.reduced(grid, kind, most, surface.MOST_ROWS)
        surface.paint(panel, cells, (across, up), norm)
        panel.set_title(", ".join(filter(None, [name, f"{kind} of each cell" * packed])), size=10)
    _label(axes, len(grids) * len(kinds), columns, (x, x_units), (y, y_units))
    surface.bar(sheet, axes, norm, long_name)
    canvas.title(sheet, title)
    canvas.caption(sheet, labels.joined([*_remarks(grids[0][1], most, kinds, left_out), note]))
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


def _remarks(grid: surface.Grid, most: int, kinds: list[str], left_out: int) -> list[str]:
    """What a reader has to know of how it was drawn."""
    across = -(-grid.x.size // most)
    up = -(-grid.y.size // surface.MOST_ROWS)
    remarks = []
    if across * up > 1:
        remarks.append(f"each cell stands for {across * up} neighbouring points: their mean")
        if len(kinds) > 1:
            remarks[0] += f", and the {kinds[1]} of them, which hides no narrow dip or peak"
    if left_out:
        remarks.append(f"{left_out} further values have no panel here")
    if (grid.values != grid.values).any():
        remarks.append("grey: not computed")
    return remarks
