"""Pictures: sheets to draw on, their looks, charts drawn on them, and files made of them."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib import colormaps, patheffects, rc_context, rcdefaults, rcParams
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.figure import Figure as Sheet

from sweep.analysis import labels
from sweep.analysis.charts import LOG, WORDS, Axis, Chart, Line, Map, Panel, Scale

DPI = 150
SCALE = "viridis"
NOT_COMPUTED = "0.75"
"""Grey of what is not there: nan, or a point not computed yet."""

LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#785A2D")
"""Colours for lines: of Okabe and Ito (2008), and a brown that red-blind eyes tell from them."""

DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)), (0, (3, 3)))


FORMATS = ("png", "pdf", "svg")
"""Formats of pictures; text and lines of the last two are no pixels."""

PRINTED_DPI = 300
"""Of what stays pixels in PDF and SVG: surfaces and clouds of many points."""

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same on every machine
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "pdf.fonttype": 42,  # whole outlines, as publishers ask for
    "svg.fonttype": "path",
    "svg.hashsalt": "sweep",
    "path.simplify": True,
    "path.snap": True,
}

SOURCE = "Source"
"""Field of a PNG's metadata that says what it was drawn from; of other formats, the subject."""

_SOURCES = {"png": SOURCE, "pdf": "Subject", "svg": "Description"}

_NO_TRACES: dict[str, dict[str, str | None]] = {
    "png": {"Software": None},
    "pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    "svg": {"Creator": None, "Date": None},
}
"""Metadata that would make a file differ from one run, or one machine, to the next."""


@contextmanager
def style() -> Iterator[None]:
    """Return the one style of all pictures, whatever its user has set."""
    with rc_context():
        rcdefaults()
        rcParams.update(STYLE)
        yield


def sheet(width: float, height: float) -> Sheet:
    """Return an empty sheet, width and height in inches."""
    figure = Sheet(figsize=(width, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def panels(
    width: float, height: float, rows: int, columns: int, **options: Any
) -> tuple[Sheet, list[Axes]]:
    """Return a sheet with a grid of axes, listed row by row."""
    figure = sheet(width, height)
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    return figure, list(axes.ravel())


def empty(message: str) -> Sheet:
    """Return a sheet that says why there is nothing on it."""
    figure = sheet(8.0, 2.0)
    figure.text(0.5, 0.5, message, ha="center", va="center", color="0.3", parse_math=False)
    return figure


def title(figure: Sheet, text: str) -> None:
    """Title of a whole sheet, as it is written: a dollar in it is no formula."""
    figure.suptitle(text, fontsize=11, fontweight="bold", parse_math=False)


def caption(figure: Sheet, text: str) -> None:
    """Small print at the foot of a sheet, broken into lines that fit it."""
    if text:
        characters = int(figure.get_figwidth() * 15)
        figure.supxlabel(
            "\n".join(textwrap.wrap(text, characters)), fontsize=8, color="0.25", x=0.02,
            ha="left", parse_math=False,
        )  # fmt: skip


def save(figure: Sheet, path: Path, *, source: str = "") -> Path:
    """Write the sheet in the format of the suffix; the same sheet gives the same bytes.

    ``source`` says what it was drawn from, and goes into the file's metadata.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    kind = path.suffix.removeprefix(".")
    dpi = DPI if kind == "png" else PRINTED_DPI
    with style():
        metadata = _NO_TRACES[kind] | ({_SOURCES[kind]: source} if source else {})
        figure.savefig(path, format=kind, dpi=dpi, metadata=metadata)
    return path


MOST_TOGETHER = 4
"""Lines that one panel can hold and still be read; more have panels of their own."""

MARKED = 40
"""Points up to which each has a mark."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")

MAP, HIGH_LINES, LOW_LINES, SMALL = (9.5, 4.4), (10.0, 3.6), (10.0, 1.75), (4.3, 3.0)
"""Widths of rows and heights of panels [inches]; of charts with several in a row, of a panel."""


def sheet_of(chart: Chart, heading: str, note: str) -> Sheet:
    """Return the sheet of a chart, with what stands over it and what is added at its foot."""
    figure = _sheet_of_maps(chart, chart.scale) if chart.scale else _sheet_of_lines(chart)
    title(figure, heading)
    caption(figure, labels.joined([*chart.caption, note]))
    return figure


def _sheet_of_maps(chart: Chart, scale: Scale) -> Sheet:
    """Arrange maps in one column, or in two if there are several parts."""
    columns = min(2, len({panel.when["part"] for panel in chart.panels}))
    rows = -(-len(chart.panels) // columns)
    sheet, axes = panels(
        MAP[0] * (1 + 0.4 * (columns - 1)), MAP[1] * rows + 0.8, rows, columns, sharex=True,
        sharey=True,
    )  # fmt: skip
    norm = norm_of(scale)
    for own in axes[len(chart.panels) :]:
        own.set_visible(False)
    for i, (own, panel) in enumerate(zip(axes, chart.panels, strict=False)):
        _map(own, norm, panel)
        own.set_title(panel.title, size=10)
        if i + columns >= len(chart.panels):
            own.set_xlabel(panel.x.words)
            own.tick_params(labelbottom=True)
        if i % columns == 0:
            own.set_ylabel(panel.y.words)
    sheet.colorbar(
        ScalarMappable(norm, colours()), ax=axes, label=textwrap.fill(scale.words, 44), pad=0.015,
        fraction=0.05,
    )  # fmt: skip
    return sheet


def norm_of(scale: Scale) -> Normalize:
    """Colours' norm of a scale."""
    return (LogNorm if scale.decades else Normalize)(scale.low, scale.high)


def colours() -> Colormap:
    """Colour map, grey where there is no value."""
    return colormaps[SCALE].with_extremes(bad=NOT_COMPUTED)


def edges(centres: np.ndarray, logarithmic: bool) -> np.ndarray:
    """Edges (n + 1,) of cells around their centres (n,)."""
    if centres.size == 1:
        return centres[0] * np.array([0.9, 1.1]) if centres[0] else np.array([-0.5, 0.5])
    c = np.log(centres) if logarithmic else centres.astype(float)
    middle = (c[1:] + c[:-1]) / 2
    e = np.concatenate([[2 * c[0] - middle[0]], middle, [2 * c[-1] - middle[-1]]])
    return np.exp(e) if logarithmic else e


def _map(axes: Axes, norm: Normalize, panel: Panel) -> None:
    layer, sides = panel.map, []
    assert layer is not None
    for side, values, axis in (("x", layer.x, panel.x), ("y", layer.y, panel.y)):
        if axis.kind == WORDS:
            axes.set(**{f"{side}ticks": np.arange(values.size), f"{side}ticklabels": values})
            values = np.arange(values.size)
        sides.append(edges(values, axis.kind == LOG))
    values = np.ma.masked_invalid(layer.values)
    axes.pcolormesh(*sides, values, norm=norm, cmap=colours(), rasterized=True)
    if len(layer.levels) and min(values.shape) > 1 and values.count():
        _contours(axes, layer, values)
    _scale(axes, "x", panel.x)
    _scale(axes, "y", panel.y)
    axes.set_facecolor(NOT_COMPUTED)


def _contours(axes: Axes, layer: Map, values: np.ma.MaskedArray) -> None:
    """Contours with their levels, black with a pale rim: they stand out from every colour."""
    known = [level for level in layer.levels if values.min() < level < values.max()]
    if not known:
        return
    rim: list[patheffects.AbstractPathEffect] = [
        patheffects.withStroke(linewidth=3.2, foreground="white", alpha=0.75)
    ]
    contours = axes.contour(
        layer.x, layer.y, values, levels=known, colors="black", linewidths=1.3, zorder=3
    )
    contours.set_path_effects(rim)
    width, height = (np.ptp(own) for own in (layer.x, layer.y))
    middles = []
    for lines in contours.allsegs:
        line = max(lines, key=len)
        steps = np.hypot(np.diff(line[:, 0]) / width, np.diff(line[:, 1]) / height)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        middles.append(tuple(line[np.searchsorted(along, along[-1] / 2)]))
    for label in axes.clabel(contours, fmt="%g", fontsize=10, manual=middles):
        label.set_path_effects(rim)


def _scale(axes: Axes, side: Literal["x", "y"], axis: Axis) -> None:
    """Kind and ends of an axis."""
    if axis.kind != WORDS:
        axes.set(**{f"{side}scale": axis.kind})
    if axis.limits is not None:
        axes.set(**{f"{side}lim": axis.limits})


def _sheet_of_lines(chart: Chart) -> Sheet:
    """Panels of lines one under the other, or in the chart's own rows."""
    every, apart = (chart.panels, False) if chart.rows else _apart(chart.panels)
    rows = chart.rows or [1] * len(every)
    width, height = SMALL if chart.rows else LOW_LINES if apart else HIGH_LINES
    alike = len({panel.y for panel in every}) == 1
    columns = max(rows)
    sheet, grid = panels(
        width * columns + 1.9 * bool(chart.rows), height * len(rows) + 1.4, len(rows), columns,
        sharex=True, sharey=alike,
    )  # fmt: skip
    places = [(row, column) for row, number in enumerate(rows) for column in range(number)]
    for i, axes in enumerate(grid):
        axes.set_visible(divmod(i, columns) in places)
    for (row, column), panel in zip(places, every, strict=True):
        axes = grid[row * columns + column]
        _panel(axes, panel)
        below = (row + 1, column) in places
        axes.tick_params(labelbottom=not below, labelsize=8 if chart.rows else None)
        if not below:
            axes.set_xlabel(panel.x.words)
        if not alike:
            axes.set_ylabel(panel.y.words, size=9)
    if alike:
        sheet.supylabel(textwrap.fill(every[0].y.words, 44), fontsize=10)
    if not apart:
        _legend(sheet, grid)
    return sheet


def _apart(panels: Sequence[Panel]) -> tuple[Sequence[Panel], bool]:
    """Panels with a single line each, where lines of one would lie over each other."""
    packed = any(line.together > 1 for panel in panels for line in panel.lines)
    split = [
        (panel, [line for line in panel.lines if line.look != "level"],
         [line for line in panel.lines if line.look == "level"])
        for panel in panels
    ]  # fmt: skip
    if max(len(lines) for _, lines, _ in split) <= (1 if packed else MOST_TOGETHER):
        return panels, False
    return [
        replace(panel, lines=[line, *levels], when={**panel.when, "line": line.name})
        for panel, lines, levels in split
        for line in lines
    ], True


def _panel(axes: Axes, panel: Panel) -> None:
    stated = any(line.look == "stated" for line in panel.lines)
    for line in panel.lines:
        _line(axes, line, solid=stated or line.together > 1)
    _scale(axes, "x", panel.x)
    _scale(axes, "y", panel.y)
    if panel.x.kind != WORDS:
        axes.margins(x=0.0 if max(line.x.size for line in panel.lines) > 1 else 0.05)
    if panel.y.kind != LOG:
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-3, 5))
    axes.grid(True)
    axes.set_axisbelow(True)
    axes.set_title(panel.title, size=9, loc="left")


def _line(axes: Axes, line: Line, *, solid: bool) -> None:
    """One line over its band."""
    if line.look == "level":
        axes.axhline(line.y[0], color="0.6", linewidth=0.8, zorder=1)
        if not line.name:
            return
        axes.annotate(
            line.name, (1.0, line.y[0]), xycoords=("axes fraction", "data"), xytext=(4, 0),
            textcoords="offset points", va="center", fontsize=8, color="0.35",
        )  # fmt: skip
        return
    look: dict[str, Any] = {"color": LINES[line.number % 8], "linewidth": 1.3}
    marked = line.x.size <= MARKED
    if line.look == "stated":
        axes.plot(line.x, line.y, linestyle="--", label=line.name, **look | {"linewidth": 1.1})
        return
    look |= {"label": line.name, "markersize": 4}
    look |= {"marker": MARKERS[line.number % 8]} if marked else {}
    if line.low is not None and line.high is not None:
        if line.look == "bars":
            ends = [line.y - line.low, line.high - line.y]
            axes.errorbar(line.x, line.y, ends, elinewidth=0.8, capsize=2, **look)
            return
        axes.fill_between(
            line.x, line.low, line.high, color=look["color"], alpha=0.22, linewidth=0,
            step="mid" if line.together > 1 else None,
        )  # fmt: skip
    axes.plot(line.x, line.y, linestyle="-" if solid else DASHES[line.number % 8], **look)


def _legend(sheet: Sheet, grid: Sequence[Axes]) -> None:
    """Each name of a line once."""
    handles: dict[str, Any] = {}
    for axes in grid:
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(name, handle)
    if handles:
        place: Any = "outside right upper"
        sheet.legend(handles.values(), handles, loc=place, frameon=False, fontsize=8)
