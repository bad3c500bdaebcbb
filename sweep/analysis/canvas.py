"""Figures with matplotlib: sheets, the common style, charts drawn on sheets, and picture files.

A sheet is a matplotlib figure, which may have several panels.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib import colormaps, patheffects, rc_context, rcdefaults, rcParams
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.figure import Figure as Sheet

from sweep.analysis import labels
from sweep.analysis.charts import (
    CATEGORY_SCALE,
    LOG_SCALE,
    Chart,
    ChartAxis,
    ChartLine,
    ColourScale,
    HeatMap,
    Panel,
)

PNG_DPI = 150
"""Resolution of PNG files [dots per inch]."""

COLOUR_MAP_NAME = "viridis"
"""Name of the colour map of matplotlib for all continuous quantities."""
MISSING_VALUE_COLOUR = "0.75"
"""Grey for missing values, which are nan or belong to points that are not computed yet."""

LINE_COLOURS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#E69F00",
    "#56B4E9",
    "#000000",
    "#785A2D",
)
"""Colours of lines by style index: those of Okabe and Ito (2008), and a brown.

Red-blind readers distinguish the brown from the other colours.
"""

DASH_STYLES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)), (0, (3, 3)))
"""Dash styles of lines in matplotlib's notation, by style index."""


PICTURE_FORMATS = ("png", "pdf", "svg")
"""File formats of pictures; pdf and svg keep text and lines as vectors."""

VECTOR_FORMAT_DPI = 300
"""Resolution [dpi] of the rasterised parts of PDF and SVG: surfaces and large point clouds."""

MATPLOTLIB_RC_PARAMS: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # part of matplotlib, so the same on every machine
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "pdf.fonttype": 42,  # embedded TrueType fonts, as publishers require
    "svg.fonttype": "path",
    "svg.hashsalt": "sweep",
    "path.simplify": True,
    "path.snap": True,
}
"""Settings of matplotlib for all pictures."""

PNG_SOURCE_FIELD = "Source"
"""Name of the PNG metadata field that names the data from which a picture was made."""

_SOURCE_FIELD_BY_FORMAT = {"png": PNG_SOURCE_FIELD, "pdf": "Subject", "svg": "Description"}
"""Names, by file format, of the metadata field that names the data of a picture."""

_OMITTED_METADATA_BY_FORMAT: dict[str, dict[str, str | None]] = {
    "png": {"Software": None},
    "pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    "svg": {"Creator": None, "Date": None},
}
"""Metadata fields set to None by file format, because they differ between runs or machines."""


@contextmanager
def uniform_style() -> Iterator[None]:
    """Context manager that applies the common style of all pictures, not the user's settings."""
    with rc_context():
        rcdefaults()
        rcParams.update(MATPLOTLIB_RC_PARAMS)
        yield


def blank_sheet(width: float, height: float) -> Sheet:
    """Return an empty sheet of the given width and height [inches]."""
    new_sheet = Sheet(figsize=(width, height), dpi=PNG_DPI, layout="constrained")
    FigureCanvasAgg(new_sheet)
    return new_sheet


class SheetWithAxes(NamedTuple):
    """Sheet with a grid of axes."""

    sheet: Sheet
    """Sheet that holds the axes."""
    axes: list[Axes]
    """Axes of the panels, row by row."""


def sheet_with_axes(
    width: float, height: float, rows: int, columns: int, **options: Any
) -> SheetWithAxes:
    """Return a sheet of the given size [inches] with a grid of axes, and the axes row by row."""
    new_sheet = blank_sheet(width, height)
    axes = new_sheet.subplots(rows, columns, squeeze=False, **options)
    return SheetWithAxes(new_sheet, list(axes.ravel()))


def message_sheet(message: str) -> Sheet:
    """Return a sheet that shows only a message, in place of a figure without data."""
    new_sheet = blank_sheet(8.0, 2.0)
    new_sheet.text(0.5, 0.5, message, ha="center", va="center", color="0.3", parse_math=False)
    return new_sheet


def set_title(target_sheet: Sheet, text: str) -> None:
    """Set the title of a sheet as plain text, in which a dollar sign does not start a formula."""
    target_sheet.suptitle(text, fontsize=11, fontweight="bold", parse_math=False)


def set_caption(target_sheet: Sheet, text: str) -> None:
    """Set the caption at the foot of a sheet, wrapped to the width of the sheet."""
    if text:
        characters_per_line = int(target_sheet.get_figwidth() * 15)
        target_sheet.supxlabel(
            "\n".join(textwrap.wrap(text, characters_per_line)), fontsize=8, color="0.25", x=0.02,
            ha="left", parse_math=False,
        )  # fmt: skip


def save_sheet(finished_sheet: Sheet, file_path: Path, *, source: str = "") -> Path:
    """Write a sheet to a file in the format of its suffix; return the path of the file.

    Equal sheets give equal bytes. ``source`` names the data from which the sheet was drawn, and is
    written to the file's metadata.
    """
    file_path.parent.mkdir(parents=True, exist_ok=True)
    picture_format = file_path.suffix.removeprefix(".")
    dpi = PNG_DPI if picture_format == "png" else VECTOR_FORMAT_DPI
    with uniform_style():
        metadata = _OMITTED_METADATA_BY_FORMAT[picture_format] | (
            {_SOURCE_FIELD_BY_FORMAT[picture_format]: source} if source else {}
        )
        finished_sheet.savefig(file_path, format=picture_format, dpi=dpi, metadata=metadata)
    return file_path


LINES_PER_SHARED_PANEL_MAX = 4
"""Largest number of lines that share a panel. With more lines, each line has its own panel."""

MARKED_POINTS_MAX = 40
"""Largest number of points that a line may have for its points to be drawn with markers."""

LINE_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
"""Markers of matplotlib for the points of lines, by style index."""

HEAT_MAP_PANEL_INCHES, MULTI_LINE_PANEL_INCHES, SINGLE_LINE_PANEL_INCHES, ROW_PANEL_INCHES = (
    (9.5, 4.4),
    (10.0, 3.6),
    (10.0, 1.75),
    (4.3, 3.0),
)
"""Widths and heights of panels [inches].

In order: panel with a heat map, panel with several lines, panel with a single line, and panel in a
row of panels.
"""


def draw_chart(chart: Chart, heading: str, footnote: str) -> Sheet:
    """Draw a chart on a new sheet, with a heading above and a caption below; return the sheet.

    ``footnote`` is the last sentence of the caption.
    """
    drawn_sheet = (
        _draw_heat_map_panels(chart, chart.colour_scale)
        if chart.colour_scale
        else _draw_line_panels(chart)
    )
    set_title(drawn_sheet, heading)
    set_caption(drawn_sheet, labels.join_sentences([*chart.caption, footnote]))
    return drawn_sheet


def _draw_heat_map_panels(chart: Chart, colour_scale: ColourScale) -> Sheet:
    """Draw the heat maps of a chart on a new sheet, in two columns if it has several parts."""
    n_columns = min(2, len({panel.facet_choices["part"] for panel in chart.panels}))
    n_rows = -(-len(chart.panels) // n_columns)
    maps_sheet, axes_list = sheet_with_axes(
        HEAT_MAP_PANEL_INCHES[0] * (1 + 0.4 * (n_columns - 1)),
        HEAT_MAP_PANEL_INCHES[1] * n_rows + 0.8,
        n_rows,
        n_columns,
        sharex=True,
        sharey=True,
    )
    norm = colour_norm(colour_scale)
    for panel_axes in axes_list[len(chart.panels) :]:
        panel_axes.set_visible(False)
    for i, (panel_axes, panel) in enumerate(zip(axes_list, chart.panels, strict=False)):
        _draw_heat_map(panel_axes, norm, panel)
        panel_axes.set_title(panel.title, size=10)
        if i + n_columns >= len(chart.panels):
            panel_axes.set_xlabel(panel.x_axis.label)
            panel_axes.tick_params(labelbottom=True)
        if i % n_columns == 0:
            panel_axes.set_ylabel(panel.y_axis.label)
    maps_sheet.colorbar(
        ScalarMappable(norm, colour_map()),
        ax=axes_list,
        label=textwrap.fill(colour_scale.label, 44),
        pad=0.015,
        fraction=0.05,
    )
    return maps_sheet


def colour_norm(colour_scale: ColourScale) -> Normalize:
    """Return matplotlib's normalisation of values for a colour scale."""
    return (LogNorm if colour_scale.is_log else Normalize)(colour_scale.low, colour_scale.high)


def colour_map() -> Colormap:
    """Return the colour map of continuous quantities, with grey for missing values."""
    return colormaps[COLOUR_MAP_NAME].with_extremes(bad=MISSING_VALUE_COLOUR)


def cell_edges(centres: np.ndarray, logarithmic: bool) -> np.ndarray:
    """Return the edges of adjacent cells with given centres.

    Parameters
    ----------
    centres
        Positions of the cell centres, (n,), rising.
    logarithmic
        If true, edges are halfway between the logarithms of the centres.

    Returns
    -------
    numpy.ndarray
        Edges, (n + 1,). The first and the last centre lie in the middle of their cells.
    """
    if centres.size == 1:
        return centres[0] * np.array([0.9, 1.1]) if centres[0] else np.array([-0.5, 0.5])
    positions = np.log(centres) if logarithmic else centres.astype(float)
    midpoints = (positions[1:] + positions[:-1]) / 2
    edge_positions = np.concatenate(
        [[2 * positions[0] - midpoints[0]], midpoints, [2 * positions[-1] - midpoints[-1]]]
    )
    return np.exp(edge_positions) if logarithmic else edge_positions


def _draw_heat_map(axes: Axes, norm: Normalize, panel: Panel) -> None:
    """Draw the heat map of a panel on axes with contours; set scales and limits of the axes."""
    heat_map, mesh_edges = panel.heat_map, []
    assert heat_map is not None
    for axis_name, values, axis in (
        ("x", heat_map.x, panel.x_axis),
        ("y", heat_map.y, panel.y_axis),
    ):
        if axis.scale == CATEGORY_SCALE:
            axes.set(
                **{f"{axis_name}ticks": np.arange(values.size), f"{axis_name}ticklabels": values}
            )
            values = np.arange(values.size)
        mesh_edges.append(cell_edges(values, axis.scale == LOG_SCALE))
    values = np.ma.masked_invalid(heat_map.values)
    axes.pcolormesh(*mesh_edges, values, norm=norm, cmap=colour_map(), rasterized=True)
    if len(heat_map.contour_levels) and min(values.shape) > 1 and values.count():
        _draw_contours(axes, heat_map, values)
    _set_scale_and_limits(axes, "x", panel.x_axis)
    _set_scale_and_limits(axes, "y", panel.y_axis)
    axes.set_facecolor(MISSING_VALUE_COLOUR)


def _draw_contours(axes: Axes, heat_map: HeatMap, values: np.ma.MaskedArray) -> None:
    """Draw labelled contours of a heat map on axes, in black with a pale outline.

    Such contours are visible on every colour.
    """
    levels_in_range = [
        level for level in heat_map.contour_levels if values.min() < level < values.max()
    ]
    if not levels_in_range:
        return
    outline: list[patheffects.AbstractPathEffect] = [
        patheffects.withStroke(linewidth=3.2, foreground="white", alpha=0.75)
    ]
    contours = axes.contour(
        heat_map.x,
        heat_map.y,
        values,
        levels=levels_in_range,
        colors="black",
        linewidths=1.3,
        zorder=3,
    )
    contours.set_path_effects(outline)
    x_span, y_span = (np.ptp(coordinates) for coordinates in (heat_map.x, heat_map.y))
    label_positions = []
    for segments in contours.allsegs:
        longest_segment = max(segments, key=len)
        steps = np.hypot(
            np.diff(longest_segment[:, 0]) / x_span, np.diff(longest_segment[:, 1]) / y_span
        )
        arc_length = np.concatenate([[0.0], np.cumsum(steps)])
        label_positions.append(
            tuple(longest_segment[np.searchsorted(arc_length, arc_length[-1] / 2)])
        )
    for label in axes.clabel(contours, fmt="%g", fontsize=10, manual=label_positions):
        label.set_path_effects(outline)


def _set_scale_and_limits(axes: Axes, axis_name: Literal["x", "y"], axis: ChartAxis) -> None:
    """Set the scale and the limits of one of matplotlib's axes, x or y, from a chart's axis."""
    if axis.scale != CATEGORY_SCALE:
        axes.set(**{f"{axis_name}scale": axis.scale})
    if axis.limits is not None:
        axes.set(**{f"{axis_name}lim": axis.limits})


def _draw_line_panels(chart: Chart) -> Sheet:
    """Draw the line panels of a chart on a new sheet; return the sheet.

    Panels are one below the other, unless the chart states numbers of panels per row.
    """
    drawn_panels, is_split = (
        (chart.panels, False) if chart.panels_per_row else _split_crowded_panels(chart.panels)
    )
    panels_per_row = chart.panels_per_row or [1] * len(drawn_panels)
    width, height = (
        ROW_PANEL_INCHES
        if chart.panels_per_row
        else SINGLE_LINE_PANEL_INCHES
        if is_split
        else MULTI_LINE_PANEL_INCHES
    )
    share_y_axis = len({panel.y_axis for panel in drawn_panels}) == 1
    n_columns = max(panels_per_row)
    lines_sheet, axes_list = sheet_with_axes(
        width * n_columns + 1.9 * bool(chart.panels_per_row),
        height * len(panels_per_row) + 1.4,
        len(panels_per_row),
        n_columns,
        sharex=True,
        sharey=share_y_axis,
    )
    occupied_cells = [
        (row, column) for row, n_panels in enumerate(panels_per_row) for column in range(n_panels)
    ]
    for i, axes in enumerate(axes_list):
        axes.set_visible(divmod(i, n_columns) in occupied_cells)
    for (row, column), panel in zip(occupied_cells, drawn_panels, strict=True):
        axes = axes_list[row * n_columns + column]
        _draw_line_panel(axes, panel)
        has_panel_below = (row + 1, column) in occupied_cells
        axes.tick_params(
            labelbottom=not has_panel_below, labelsize=8 if chart.panels_per_row else None
        )
        if not has_panel_below:
            axes.set_xlabel(panel.x_axis.label)
        if not share_y_axis:
            axes.set_ylabel(panel.y_axis.label, size=9)
    if share_y_axis:
        lines_sheet.supylabel(textwrap.fill(drawn_panels[0].y_axis.label, 44), fontsize=10)
    if not is_split:
        _draw_legend(lines_sheet, axes_list)
    return lines_sheet


def _split_crowded_panels(panels: Sequence[Panel]) -> tuple[Sequence[Panel], bool]:
    """Return panels with one line each in place of panels with too many lines.

    Returns
    -------
    panels : sequence of Panel
        The given panels, or one for each line.
    is_split : bool
        True if the panels were split.
    """
    is_reduced = any(line.n_averaged_points > 1 for panel in panels for line in panel.lines)
    split_panels = [
        (panel, [line for line in panel.lines if line.style != "level"],
         [line for line in panel.lines if line.style == "level"])
        for panel in panels
    ]  # fmt: skip
    if max(len(lines) for _, lines, _ in split_panels) <= (
        1 if is_reduced else LINES_PER_SHARED_PANEL_MAX
    ):
        return panels, False
    return [
        replace(
            panel, lines=[line, *levels], facet_choices={**panel.facet_choices, "line": line.name}
        )
        for panel, lines, levels in split_panels
        for line in lines
    ], True


def _draw_line_panel(axes: Axes, panel: Panel) -> None:
    """Draw the lines, axes and title of a panel."""
    has_stated = any(line.style == "stated" for line in panel.lines)
    for line in panel.lines:
        _draw_line(axes, line, solid=has_stated or line.n_averaged_points > 1)
    _set_scale_and_limits(axes, "x", panel.x_axis)
    _set_scale_and_limits(axes, "y", panel.y_axis)
    if panel.x_axis.scale != CATEGORY_SCALE:
        axes.margins(x=0.0 if max(line.x.size for line in panel.lines) > 1 else 0.05)
    if panel.y_axis.scale != LOG_SCALE:
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-3, 5))
    axes.grid(True)
    axes.set_axisbelow(True)
    axes.set_title(panel.title, size=9, loc="left")


def _draw_line(axes: Axes, line: ChartLine, *, solid: bool) -> None:
    """Draw one line on axes, with its band or error bars if it has them.

    With `solid` the line is not dashed, whatever its style index is.
    """
    if line.style == "level":
        axes.axhline(line.y[0], color="0.6", linewidth=0.8, zorder=1)
        if not line.name:
            return
        axes.annotate(
            line.name, (1.0, line.y[0]), xycoords=("axes fraction", "data"), xytext=(4, 0),
            textcoords="offset points", va="center", fontsize=8, color="0.35",
        )  # fmt: skip
        return
    plot_options: dict[str, Any] = {"color": LINE_COLOURS[line.style_index % 8], "linewidth": 1.3}
    has_markers = line.x.size <= MARKED_POINTS_MAX
    if line.style == "stated":
        axes.plot(
            line.x, line.y, linestyle="--", label=line.name, **plot_options | {"linewidth": 1.1}
        )
        return
    plot_options |= {"label": line.name, "markersize": 4}
    plot_options |= {"marker": LINE_MARKERS[line.style_index % 8]} if has_markers else {}
    if line.low is not None and line.high is not None:
        if line.style == "bars":
            error_bars = [line.y - line.low, line.high - line.y]
            axes.errorbar(line.x, line.y, error_bars, elinewidth=0.8, capsize=2, **plot_options)
            return
        axes.fill_between(
            line.x, line.low, line.high, color=plot_options["color"], alpha=0.22, linewidth=0,
            step="mid" if line.n_averaged_points > 1 else None,
        )  # fmt: skip
    axes.plot(
        line.x,
        line.y,
        linestyle="-" if solid else DASH_STYLES[line.style_index % 8],
        **plot_options,
    )


def _draw_legend(lines_sheet: Sheet, axes_list: Sequence[Axes]) -> None:
    """Draw one legend for all axes of a sheet, in which each line name appears once."""
    handle_by_name: dict[str, Any] = {}
    for axes in axes_list:
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
            handle_by_name.setdefault(name, handle)
    if handle_by_name:
        legend_location: Any = "outside right upper"
        lines_sheet.legend(
            handle_by_name.values(), handle_by_name, loc=legend_location, frameon=False, fontsize=8
        )
