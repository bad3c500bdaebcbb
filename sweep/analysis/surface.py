"""A quantity over two coordinates, seen from above."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.figure import Figure as Sheet

from sweep.analysis import canvas, labels
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


def gridded(found: Points, x: str, y: str, variable: str) -> Grid:
    """A variable on the grid of all values of two coordinates."""
    columns, column = np.unique(found.coordinates[x].values, return_inverse=True)
    rows, row = np.unique(found.coordinates[y].values, return_inverse=True)
    values = np.full((rows.size, columns.size), np.nan)
    values[row.ravel(), column.ravel()] = found.variables[variable]
    return Grid(columns, rows, values)


def worst(variable: str) -> str:
    """Which of the values that share a cell is the worst; empty where none is."""
    if variable.startswith(("pd_", "snr_")):
        return "lowest"
    return "highest" if variable.startswith(_CHANCES_OF_HARM) else ""


def reduced(grid: Grid, kind: str, columns: int, rows: int) -> Grid:
    """A grid of no more than so many cells.

    Parameters
    ----------
    grid
        The whole grid.
    kind
        "lowest", "highest" or "mean" of the values that share a cell; nan only where all are.
    columns, rows
        Most cells along x and along y.
    """
    by = together(grid.y.size, rows), together(grid.x.size, columns)
    return Grid(middles(grid.x, by[1]), middles(grid.y, by[0]), in_cells(grid.values, kind, by))


def together(number: int, most: int) -> int:
    """How many neighbours a cell stands for, so that there are `most` cells or fewer."""
    return -(-number // most)


def middles(along: np.ndarray, by: int) -> np.ndarray:
    """Mean value of a coordinate in each cell of `by` neighbours; of words the first."""
    if by == 1:
        return along
    starts = np.arange(0, along.size, by)
    if is_words(along):
        return along[starts]
    return np.add.reduceat(along, starts) / np.diff(starts, append=along.size)


def in_cells(values: np.ndarray, kind: str, by: Sequence[int]) -> np.ndarray:
    """Values with neighbours taken together, `by` along each axis, the last ones fewer.

    Parameters
    ----------
    values, by
        As many dimensions as numbers.
    kind
        "lowest", "highest" or "mean" of the values that share a cell; nan only where all are.
    """
    starts = [np.arange(0, size, number) for size, number in zip(values.shape, by, strict=True)]
    return told(gathered(tallied(values, kind), kind, starts), kind)


def tallied(values: np.ndarray, kind: str) -> np.ndarray:
    """What is gathered of values (...), in a further last dimension."""
    if kind != "mean":
        return values[..., np.newaxis]
    missing = np.isnan(values)
    return np.stack([np.where(missing, 0.0, values), ~missing], axis=-1)


def gathered(tallies: np.ndarray, kind: str, starts: Sequence[np.ndarray]) -> np.ndarray:
    """Tallies of cells that begin at some places along each axis, from those of their values."""
    ufunc = {"mean": np.add, "lowest": np.fmin, "highest": np.fmax}[kind]
    for axis, places in enumerate(starts):
        if places.size < tallies.shape[axis]:
            tallies = ufunc.reduceat(tallies, places, axis=axis)
    return tallies


def told(tallies: np.ndarray, kind: str) -> np.ndarray:
    """Values of cells (...) from their tallies."""
    if kind != "mean":
        return tallies[..., 0]
    total, number = tallies[..., 0], tallies[..., 1]
    return np.where(number > 0, total / np.maximum(number, 1.0), np.nan)


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


def is_words(values: np.ndarray) -> bool:
    """Whether a coordinate's values are words."""
    return values.dtype.kind not in "fiu"


def place(values: np.ndarray, factor: float) -> np.ndarray:
    """Where values stand on an axis: in the units shown, words one after the other."""
    return np.arange(values.size) if is_words(values) else values * factor


def shown_along(found: Points, x: str) -> tuple[float, str]:
    """Factor and units in which a coordinate is shown."""
    column = found.coordinates[x]
    if is_words(column.values):
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
        if is_words(names):
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
