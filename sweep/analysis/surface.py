"""A quantity over two coordinates, seen from above."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import dask
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.figure import Figure as Sheet

from sweep.analysis import canvas, labels
from sweep.analysis.cells import Side
from sweep.analysis.selection import Points

MOST_COLUMNS, MOST_ROWS = 1100, 500
"""Cells of a panel as wide as the sheet: no more than its pixels, so that none is lost."""

MOST_PANELS = 9

_DECADES_FOR_LOG = 3
_CHANCES_OF_HARM = ("miss_", "pfa_", "log10_pfa_", "p_leakage_")


@dataclass(frozen=True)
class Grid:
    """Values (rows, columns) over y and x, nan where there is none."""

    x: np.ndarray
    y: np.ndarray
    values: np.ndarray


def grids(
    parts: Sequence[Points],
    variable: str,
    x: str,
    y: str,
    kinds: Sequence[str],
    most: Sequence[int],
) -> list[Grid]:
    """A variable over two coordinates, of every part and kind: the kinds of the first part first.

    Parameters
    ----------
    parts, variable, x, y
        Points, with the variable and the coordinates.
    kinds
        "mean", "lowest" or "highest" of the values that share a cell; nan only where all are.
    most
        Most cells along x and along y.
    """
    made = [_spread(part, variable, x, y) for part in parts]
    sides = [((up, most[1]), (across, most[0])) for _, across, up in made]
    lazy = [
        found.cells(variable, pair, kind).data
        for (found, _, _), pair in zip(made, sides, strict=True)
        for kind in kinds
    ]
    layers = iter(dask.compute(*lazy))
    return [
        Grid(across.middles(columns), up.middles(rows), np.asarray(next(layers), float))
        for (up, rows), (across, columns) in sides
        for _ in kinds
    ]


def _spread(found: Points, variable: str, x: str, y: str) -> tuple[Points, Side, Side]:
    """Points over two axes, and the places along x and along y."""
    if found.axis_of(x) != found.axis_of(y):
        return found, found.side(x), found.side(y)
    columns, column = np.unique(found.column(x).values, return_inverse=True)
    rows, row = np.unique(found.column(y).values, return_inverse=True)
    both = found.axis_of(x)
    along = Side(both, found.axes[both].positions, found.axes[both].positions)
    values = np.full((rows.size, columns.size), np.nan)
    values[row.ravel(), column.ravel()] = found.cells(
        variable, [(along, along.values.size)], "mean"
    )
    plane = Points.of(xr.Dataset({variable: (("y", "x"), values)}))
    across, up = Side("x", np.arange(columns.size), columns), Side("y", np.arange(rows.size), rows)
    return plane, across, up


def worst(variable: str) -> str:
    """Which of the values that share a cell is the worst; empty where none is."""
    if variable.startswith(("pd_", "snr_")):
        return "lowest"
    return "highest" if variable.startswith(_CHANCES_OF_HARM) else ""


def edges(centres: np.ndarray, logarithmic: bool) -> np.ndarray:
    """Edges (n + 1,) of cells around their centres (n,)."""
    if centres.size == 1:
        return centres[0] * np.array([0.9, 1.1]) if centres[0] else np.array([-0.5, 0.5])
    c = np.log(centres) if logarithmic else centres.astype(float)
    middle = (c[1:] + c[:-1]) / 2
    e = np.concatenate([[2 * c[0] - middle[0]], middle, [2 * c[-1] - middle[-1]]])
    return np.exp(e) if logarithmic else e


def is_geometric(values: np.ndarray) -> bool:
    """Whether values are spread evenly in their logarithm, over a decade or more."""
    if values.size < 3 or values.min() <= 0 or values.max() < 10 * values.min():
        return False
    steps = np.diff(np.log(values))
    return bool(steps.max() < 1.5 * steps.min())


def scale(variable: str, values: np.ndarray) -> Normalize:
    """Colour scale: 0..1 for probabilities of detection, else what the values span."""
    if variable.startswith("pd_"):
        return Normalize(0.0, 1.0)
    known = values[np.isfinite(values)]
    if not known.size:
        return Normalize(0.0, 1.0)
    low, high = float(known.min()), float(known.max())
    above = known[known > 0]
    if low >= 0 and above.size and high > 10**_DECADES_FOR_LOG * float(np.median(above)):
        return LogNorm(max(float(np.percentile(above, 1)), high * 1e-12), high)
    return Normalize(low, high if high > low else low + 1.0)


def colours() -> Colormap:
    """Colour map, grey where there is no value."""
    from matplotlib import colormaps

    return colormaps[canvas.SCALE].with_extremes(bad=canvas.NOT_COMPUTED)


def place(values: np.ndarray, factor: float) -> np.ndarray:
    """Where values stand on an axis: in the units shown, words one after the other."""
    return np.arange(values.size) if labels.is_words(values) else values * factor


def shown_along(found: Points, x: str) -> tuple[float, str]:
    """Factor and units in which a coordinate is shown."""
    column = found.column(x)
    if labels.is_words(column.values):
        return 1.0, ""
    return labels.shown_in(np.unique(column.values), column.units)


def paint(axes: Axes, grid: Grid, factors: tuple[float, float], norm: Normalize) -> None:
    """One panel: cells of a grid over x and y, in units that are the factors' multiples."""
    x, y = (place(*pair) for pair in zip((grid.x, grid.y), factors, strict=True))
    geometric = is_geometric(x), is_geometric(y)
    axes.pcolormesh(
        edges(x, geometric[0]),
        edges(y, geometric[1]),
        np.ma.masked_invalid(grid.values),
        norm=norm,
        cmap=colours(),
        rasterized=True,
    )
    axes.set_xscale("log" if geometric[0] else "linear")
    axes.set_yscale("log" if geometric[1] else "linear")
    axes.set_facecolor(canvas.NOT_COMPUTED)
    for names, ticks in ((grid.x, axes.set_xticks), (grid.y, axes.set_yticks)):
        if labels.is_words(names):
            ticks(np.arange(names.size), [str(name) for name in names])


def bar(figure: Sheet, axes: list[Axes], norm: Normalize, label: str) -> None:
    """Colour bar beside the panels."""
    figure.colorbar(
        ScalarMappable(norm, colours()),
        ax=axes,
        label=textwrap.fill(label, 44),
        pad=0.015,
        fraction=0.05,
    )
