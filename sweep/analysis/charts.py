"""Charts as data: the general classes, and the charts of grids over two coordinates or along one.

:mod:`sweep.analysis.canvas` draws charts to files, and :mod:`sweep.report.html_page` to pages. A
sheet shows all panels side by side. A page shows one panel at a time. Facets are the properties by
which panels differ, such as the part of the study: the reader selects a panel by them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, NamedTuple

import dask
import numpy as np
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.answers.probability import (
    SEGMENTS_AND_SHOT,
    detection_probability,
    pd_half_width,
)
from sweep.analysis.selection import (
    CELL_HIGHEST,
    CELL_LOWEST,
    CELL_MEAN,
    NamedPart,
    PointSelection,
    ShownParts,
    SortedCoordinate,
    split_by_coordinates,
    thin_parts_evenly,
)

LINEAR_SCALE, LOG_SCALE, CATEGORY_SCALE = "linear", "log", "category"
"""Scales of axes: linear, logarithmic, or categories."""

PROBABILITY_AXIS_LIMITS = (-0.03, 1.03)
"""Lower and upper limit of an axis that shows probabilities."""


@dataclass(frozen=True)
class ChartAxis:
    """Axis of a panel."""

    label: str = ""
    """Label of the axis, with units."""
    scale: str = LINEAR_SCALE
    """Scale of the axis: ``linear``, ``log`` or ``category``."""
    limits: tuple[float | None, float | None] | None = None
    """Lowest and highest value of the axis; None for the extent of the data."""


@dataclass(frozen=True, eq=False)
class ChartLine:
    """Line of a panel."""

    x: np.ndarray
    """Positions of the values along the horizontal axis (n,)."""
    y: np.ndarray
    """Values of the line (n,); nan where missing."""
    name: str = ""
    """Name of the line in the legend."""
    style_index: int = 0
    """Index of the line's colour, dash and marker in the common lists of styles."""
    low: np.ndarray | None = None
    """Lower end of a band about the line at each position (n,); None for a line without a band."""
    high: np.ndarray | None = None
    """Upper end of a band about the line at each position (n,); None for a line without a band."""
    style: str = "line"
    """Style of the line.

    The style is ``line``, ``stated`` (dashed), ``dots``, ``bars`` (error bars), ``level``
    (horizontal line) or ``area`` (stacked on the areas that precede it in the panel).
    """
    n_averaged_points: int = 1
    """Number of points of the study whose mean is one value of the line; 1 for no averaging."""
    hover_texts: Sequence[str] = ()
    """Texts that a page shows when the mouse is over a value of the line, one text per value."""


@dataclass(frozen=True, eq=False)
class HeatMap:
    """Map of values over two coordinates, shown by colours."""

    x: np.ndarray
    """Positions of the columns of cells along the horizontal axis."""
    y: np.ndarray
    """Positions of the rows of cells along the vertical axis."""
    values: np.ndarray
    """Values of the cells (rows, columns); nan where missing."""
    contour_levels: Sequence[float] = ()
    """Values of the map at which contours are drawn."""


@dataclass(frozen=True)
class ColourScale:
    """Colour scale of a heat map."""

    low: float
    """Lowest value of the scale."""
    high: float
    """Highest value of the scale."""
    is_log: bool
    """True if colours depend on the logarithm of the value."""
    label: str
    """Label of the scale, with units."""


@dataclass(frozen=True, eq=False)
class Panel:
    """Panel of a chart: lines or a heat map over two axes.

    The panel belongs to one choice of each facet, a property by which panels differ, such as the
    part of the study.
    """

    facet_choices: Mapping[str, str]
    """Choice for each facet at which a page shows the panel, by the name of the facet.

    A facet is a property by which panels differ, such as the part of the study.
    """
    x_axis: ChartAxis
    """Horizontal axis."""
    y_axis: ChartAxis
    """Vertical axis."""
    lines: Sequence[ChartLine] = ()
    """Lines of the panel."""
    heat_map: HeatMap | None = None
    """Heat map of the panel; None for a panel of lines."""

    @property
    def title(self) -> str:
        """Title of the panel: its choices for all facets, joined by commas.

        A facet is a property by which panels differ, such as the part of the study.
        """
        return ", ".join(filter(None, self.facet_choices.values()))


@dataclass(frozen=True, eq=False)
class Chart:
    """Contents of a figure."""

    heading: str
    """Heading above the figure."""
    alt: str
    """Text of the figure for readers who can't see it."""
    caption: Sequence[str]
    """Phrases of the caption, which become sentences."""
    panels: Sequence[Panel]
    """Panels in the order in which they are drawn."""
    facet_labels: Mapping[str, str] = field(default_factory=dict)
    """Labels of the controls with which a reader selects a panel.

    There is one control for each facet, a property by which panels differ, such as the part of the
    study.
    """
    colour_scale: ColourScale | None = None
    """Colour scale of all heat maps; None for charts of lines."""
    panels_per_row: Sequence[int] = ()
    """Number of panels in each row of a sheet; empty for one panel per row."""


@dataclass(frozen=True)
class ChartSizeLimits:
    """Limits of the size of a chart."""

    parts_max: int
    """Largest number of parts of the study that a chart shows. Each part has a panel."""
    columns_max: int
    """Largest total number of columns of cells in heat maps that are side by side."""
    rows_max: int
    """Largest number of rows of cells in one heat map."""
    cells_max: float
    """Largest number of cells of all heat maps together."""
    maps_per_row: int
    """Number of heat maps side by side, if there are several parts."""


SHEET_CHART_SIZE_LIMITS = ChartSizeLimits(
    parts_max=9, columns_max=1100, rows_max=500, cells_max=math.inf, maps_per_row=2
)
"""Limits of the size of charts on sheets (matplotlib figures).

A heat map has no more cells than the sheet has pixels for it, so that no cell is lost.
"""

LINES_PER_PANEL_MAX = 8
"""Largest number of lines in a panel. Lines beyond this number are omitted."""

REDUCED_LINE_CELLS_MAX = 500
"""Largest number of cells along the horizontal axis for a line whose points are averaged by cells.

A line with at most twice as many points shows all of its points.
"""

_LOG_SCALE_DECADES_MIN = 3
"""Decades between median and largest value above which a colour scale is logarithmic."""

_LARGEST_IS_WORST_PREFIXES = ("miss_", "pfa_", "log10_pfa_", "p_leakage_")
"""Beginnings of the names of variables whose largest value is the worst one."""


@dataclass(frozen=True)
class CoordinateAxis:
    """Axis along which a coordinate of a study is shown, in display units."""

    chart_axis: ChartAxis
    """Label, scale and limits of the axis in a chart."""
    unit_factor: float
    """Factor by which values in the coordinate's units are multiplied to give the axis's units."""
    units: str
    """Units of the axis; empty for categories."""

    @classmethod
    def from_points(cls, points: PointSelection, name: str) -> CoordinateAxis:
        """Return the axis for the named coordinate of a selection of points."""
        values, units = np.unique(points.coordinate_values(name)), points.coordinate_units(name)
        if labels.is_categorical(values):
            return cls(ChartAxis(labels.coordinate_label(name), CATEGORY_SCALE), 1.0, "")
        factor, units = labels.display_factor_and_units(values, units)
        label = labels.axis_label(labels.coordinate_label(name), units)
        return cls(
            ChartAxis(label, LOG_SCALE if is_log_spaced(values) else LINEAR_SCALE), factor, units
        )

    def to_axis_units(self, values: np.ndarray) -> np.ndarray:
        """Return values of the coordinate in the units of the axis; categories become text."""
        if self.chart_axis.scale == CATEGORY_SCALE:
            return np.array([str(value) for value in values])
        return values * self.unit_factor

    def describe_span(self, values: np.ndarray) -> str:
        """Return a text with the axis's label, and the first and the last of the given values."""
        axis_values = self.to_axis_units(values)
        end_texts = [
            labels.format_quantity(v, self.units) for v in (axis_values[0], axis_values[-1])
        ]
        return f"{self.chart_axis.label} from {end_texts[0]} to {end_texts[1]}"


def is_log_spaced(values: np.ndarray) -> bool:
    """Return True if values span at least a decade, with about equal ratios of neighbours."""
    if values.size < 3 or values.min() <= 0 or values.max() < 10 * values.min():
        return False
    steps = np.diff(np.log(values))
    return bool(steps.max() < 1.5 * steps.min())


def fit_colour_scale(variable: str, label: str, layers: Sequence[np.ndarray]) -> ColourScale:
    """Return the colour scale for the values of a variable.

    Parameters
    ----------
    variable
        Name of the variable. Probabilities of detection (``pd_...``) are always shown from 0 to 1.
    label
        Label of the scale, with units.
    layers
        Values of all maps with this scale.

    Returns
    -------
    ColourScale
        Scale from the lowest to the highest finite value. It is logarithmic if all values are at
        least 0, and the largest exceeds 1000 times the median of the positive ones. A logarithmic
        scale starts at the first percentile of the positive values, but not below 1e-12 of the
        largest.
    """
    values = np.concatenate([layer.ravel() for layer in layers])
    finite_values = values[np.isfinite(values)]
    if variable.startswith("pd_") or not finite_values.size:
        return ColourScale(0.0, 1.0, False, label)
    low, high = float(finite_values.min()), float(finite_values.max())
    positive_values = finite_values[finite_values > 0]
    if (
        low >= 0
        and positive_values.size
        and high > 10**_LOG_SCALE_DECADES_MIN * float(np.median(positive_values))
    ):
        return ColourScale(
            max(float(np.percentile(positive_values, 1)), high * 1e-12), high, True, label
        )
    return ColourScale(low, high if high > low else low + 1.0, False, label)


def worst_value_statistic(variable: str) -> str:
    """Return the name of the statistic of a cell of points that shows a variable's worst value.

    The statistic is the lowest value for detection and SNR, and the highest one for misses and
    false alarms. For other variables the name is ''.
    """
    if variable.startswith(("pd_", "snr_")):
        return CELL_LOWEST
    return CELL_HIGHEST if variable.startswith(_LARGEST_IS_WORST_PREFIXES) else ""


def split_into_parts(
    points: PointSelection, shown_names: Sequence[str], parts_max: int
) -> ShownParts:
    """Split a selection of points into at most ``parts_max`` parts, each for one panel.

    Within a part only the coordinates with ``shown_names`` vary.
    """
    if not points.n_points:
        return ShownParts([], 0)
    all_parts = split_by_coordinates(
        points, points.distinguishing_coordinates(shown_names), points.n_points
    ).parts
    varied_parts = [
        part
        for part in all_parts
        if all(len(part.points.unique_values(n)) > 1 for n in shown_names)
    ]
    return thin_parts_evenly(varied_parts or all_parts, parts_max)


def omission_remark(n_omitted: int) -> str:
    """Return a caption phrase with the number of omitted values; '' if none is omitted."""
    return f"{labels.number_with_noun(n_omitted, 'further value')} not shown" if n_omitted else ""


def surface_chart(
    points: PointSelection,
    *,
    x: str,
    y: str,
    variable: str,
    label: str,
    size_limits: ChartSizeLimits = SHEET_CHART_SIZE_LIMITS,
    levels: Sequence[float] = (),
) -> Chart:
    """Return a chart of heat maps of a variable over two coordinates.

    Each combination of values of the remaining coordinates has a panel.

    Parameters
    ----------
    points
        Points of the study.
    x, y
        Names of the coordinates along the axes.
    variable
        Name of the variable.
    label
        Label of the variable, with units.
    size_limits
        Largest numbers of panels, and of columns, rows and cells of the maps. Adjacent points of
        larger maps are combined to cells. A map shows the mean of each cell, and for probabilities
        and SNRs a second map shows the worst value.
    levels
        Values of the variable at which contours are drawn, if both coordinates are numeric.
    """
    parts, n_omitted = split_into_parts(points, [x, y], size_limits.parts_max)
    planes = [_arrange_on_plane(part.points, variable, x, y) for part in parts]
    cell_statistics = (
        [CELL_MEAN, worst_value_statistic(variable)]
        if worst_value_statistic(variable)
        else [CELL_MEAN]
    )
    cells_max = _map_cells_max(planes, size_limits, len(cell_statistics) * len(parts))
    points_per_cell = [
        max(x_coordinate.points_per_cell(cells_max[0]) for _, x_coordinate, _ in planes),
        max(y_coordinate.points_per_cell(cells_max[1]) for _, _, y_coordinate in planes),
    ]
    cell_statistics = cell_statistics if max(points_per_cell) > 1 else [CELL_MEAN]
    lazy_cells = [
        plane.coarsen(
            variable, [(y_coordinate, cells_max[1]), (x_coordinate, cells_max[0])], cell_statistic
        ).data
        for plane, x_coordinate, y_coordinate in planes
        for cell_statistic in cell_statistics
    ]
    layers = [np.asarray(layer, float) for layer in dask.compute(*lazy_cells)]
    x_axis, y_axis = CoordinateAxis.from_points(points, x), CoordinateAxis.from_points(points, y)
    panels: list[Panel] = []
    for ((part_label, _), (_, x_coordinate, y_coordinate)), cell_statistic in product(
        zip(parts, planes, strict=True), cell_statistics
    ):
        facet_choices = {
            "part": part_label,
            "cell": f"{cell_statistic} of each cell" if max(points_per_cell) > 1 else "",
        }
        x_values, y_values = (
            x_coordinate.cell_means(cells_max[0]),
            y_coordinate.cell_means(cells_max[1]),
        )
        contour_levels = (
            () if CATEGORY_SCALE in (x_axis.chart_axis.scale, y_axis.chart_axis.scale) else levels
        )
        layer = HeatMap(
            x_axis.to_axis_units(x_values),
            y_axis.to_axis_units(y_values),
            layers[len(panels)],
            contour_levels,
        )
        panels.append(Panel(facet_choices, x_axis.chart_axis, y_axis.chart_axis, heat_map=layer))
    span_texts = [
        coordinate_axis.describe_span(np.unique(points.coordinate_values(n)))
        for coordinate_axis, n in ((x_axis, x), (y_axis, y))
    ]
    remarks = [
        _reduction_remark(math.prod(points_per_cell), planes[0][1:], cell_statistics),
        omission_remark(n_omitted),
    ]
    if levels and panels and panels[0].heat_map and panels[0].heat_map.contour_levels:
        remarks.append(f"contours: {' and '.join(f'{level:g}' for level in levels)}")
    if any(np.isnan(layer).any() for layer in layers):
        remarks.append("grey or empty: not computed, or without a value")
    return Chart(
        label,
        f"Heat map of {label} over {' and '.join(span_texts)}: "
        f"{labels.describe_value_extent(layers[0])}.",
        remarks,
        panels,
        {"part": "Shown for", "cell": "Each cell shows the"},
        fit_colour_scale(variable, label, layers),
    )


def _map_cells_max(
    planes: Sequence[tuple[PointSelection, SortedCoordinate, SortedCoordinate]],
    size_limits: ChartSizeLimits,
    n_layers: int,
) -> tuple[int, int]:
    """Return the largest number of columns and of rows that each heat map may have.

    `planes` are the maps before reduction. `n_layers` is the total number of maps in the chart.
    """
    columns_max = size_limits.columns_max // (size_limits.maps_per_row if len(planes) > 1 else 1)
    n_columns = min(columns_max, max(x_coordinate.values.size for _, x_coordinate, _ in planes))
    n_rows = min(
        size_limits.rows_max, max(y_coordinate.values.size for _, _, y_coordinate in planes)
    )
    shrink = min(1.0, math.sqrt(size_limits.cells_max / n_layers / (n_columns * n_rows)))
    return max(2, int(n_columns * shrink)), max(2, int(n_rows * shrink))


def _arrange_on_plane(
    points: PointSelection, variable: str, x: str, y: str
) -> tuple[PointSelection, SortedCoordinate, SortedCoordinate]:
    """Return the points of a heat map on a plane of two dimensions, and their two coordinates.

    If x and y lie along one zipped axis, the points are rearranged on a grid of both.

    Returns
    -------
    tuple of PointSelection, SortedCoordinate, SortedCoordinate
        The points, and their coordinates along x and y.
    """
    if points.dim_of_coordinate(x) != points.dim_of_coordinate(y):
        return points, points.sorted_coordinate(x), points.sorted_coordinate(y)
    x_values, column_index = np.unique(points.coordinate_values(x), return_inverse=True)
    y_values, row_index = np.unique(points.coordinate_values(y), return_inverse=True)
    shared_dim = points.dim_of_coordinate(x)
    point_indices = np.asarray(points.table_by_dim[shared_dim].index)
    flat_coordinate = SortedCoordinate(shared_dim, point_indices, point_indices)
    values = np.full((y_values.size, x_values.size), np.nan)
    values[row_index.ravel(), column_index.ravel()] = points.coarsen(
        variable, [(flat_coordinate, flat_coordinate.values.size)], CELL_MEAN
    )
    plane = PointSelection.from_dataset(xr.Dataset({variable: (("y", "x"), values)}))
    x_coordinate, y_coordinate = (
        SortedCoordinate("x", np.arange(x_values.size), x_values),
        SortedCoordinate("y", np.arange(y_values.size), y_values),
    )
    return plane, x_coordinate, y_coordinate


def _reduction_remark(
    points_per_cell: int, coordinates: Sequence[SortedCoordinate], cell_statistics: Sequence[str]
) -> str:
    """Return a caption phrase on how many points a cell combines; '' for one point per cell."""
    if points_per_cell == 1:
        return ""
    n_points = math.prod(coordinate.values.size for coordinate in coordinates)
    remark = (
        f"reduced: each cell stands for {points_per_cell} neighbouring points of {n_points:,}: "
        "their mean"
    )
    if len(cell_statistics) > 1:
        remark += f", and the {cell_statistics[1]} of them, which hides no narrow dip or peak"
    return remark


def slice_chart(
    points: PointSelection,
    *,
    x: str,
    by: str,
    variable: str,
    label: str,
    parts_max: int = 6,
    levels: Sequence[float] = (),
) -> Chart:
    """Return a chart of a variable as lines over a coordinate.

    Parameters
    ----------
    points
        Points of the study.
    x
        Name of the coordinate along the horizontal axis.
    by
        Name of the coordinate that has a line for each value; '' for none.
    variable
        Name of the variable.
    label
        Label of the variable, with units.
    parts_max
        Largest number of panels, one for each value of the remaining coordinates.
    levels
        Values at which horizontal lines are drawn.
    """
    line_coordinates = [by] if by else []
    parts, n_omitted_parts = split_into_parts(points, [x, *line_coordinates], parts_max)
    labelled_lines, n_omitted_lines = split_into_lines(parts, line_coordinates)
    drawn_lines, remarks = read_lines_along(
        [(labelled_line.points, variable) for labelled_line in labelled_lines], x
    )
    x_axis = CoordinateAxis.from_points(points, x)
    value_scale = fit_colour_scale(variable, label, [line.y for line in drawn_lines])
    limits = PROBABILITY_AXIS_LIMITS if variable.startswith("pd_") else None
    y_axis = ChartAxis(label, LOG_SCALE if value_scale.is_log else LINEAR_SCALE, limits)
    panels = make_line_panels(labelled_lines, drawn_lines, x_axis, y_axis)
    alt_text = lines_alt_text(
        label, x_axis.describe_span(np.unique(points.coordinate_values(x))), panels[0]
    )
    panels = [
        replace(panel, lines=[*panel.lines, *_horizontal_level_lines(panel, levels)])
        for panel in panels
    ]
    return Chart(
        label,
        alt_text,
        [*remarks, omission_remark(n_omitted_parts + n_omitted_lines)],
        panels,
        {"part": "Shown for"},
    )


def _horizontal_level_lines(panel: Panel, levels: Sequence[float]) -> list[ChartLine]:
    """Return a horizontal line for each level, as long as the first line of a panel."""
    x = panel.lines[0].x
    return [ChartLine(x, np.full(x.size, level), f"{level:g}", style="level") for level in levels]


class LabelledLinePoints(NamedTuple):
    """Points of a line of a chart, with the names of the line and of its panel."""

    part_name: str
    """Name of the part of the study, and of the panel, to which the line belongs."""
    line_name: str
    """Name of the line in the legend."""
    points: PointSelection
    """Points of the study that the line shows."""


class ShownLines(NamedTuple):
    """Lines that the panels of a chart have room for."""

    labelled_lines: list[LabelledLinePoints]
    """Part, name and points of each line that is shown."""
    n_omitted: int
    """Number of omitted lines."""


class LinesWithRemarks(NamedTuple):
    """Lines of a chart that were read from a store."""

    lines: list[ChartLine]
    """Lines of a chart, with x in the units of the dataset."""
    remarks: list[str]
    """Caption phrases on how the lines were reduced, and on what their bands show."""


def split_into_lines(parts: Sequence[NamedPart], line_coordinates: Sequence[str]) -> ShownLines:
    """Split each part of a chart into lines, one for each value of the named coordinates.

    Lines beyond `LINES_PER_PANEL_MAX` of a part are omitted and counted.
    """
    labelled_lines: list[LabelledLinePoints] = []
    n_omitted = 0
    for part_label, part_points in parts:
        part_lines, n_omitted_lines = split_by_coordinates(
            part_points, line_coordinates, LINES_PER_PANEL_MAX
        )
        n_omitted += n_omitted_lines
        labelled_lines += [
            LabelledLinePoints(part_label, line_name, line_points)
            for line_name, line_points in part_lines
        ]
    return ShownLines(labelled_lines, n_omitted)


def make_line_panels(
    labelled_lines: Sequence[LabelledLinePoints],
    drawn_lines: Sequence[ChartLine],
    x_axis: CoordinateAxis,
    y_axis: ChartAxis,
    **further_choices: str,
) -> list[Panel]:
    """Return the panels of a chart of lines, one for each part of the study.

    Parameters
    ----------
    labelled_lines
        Part, name and points of each line.
    drawn_lines
        The lines in the same order, with x in the units of the dataset. Lines of the same name get
        the same style.
    x_axis, y_axis
        Axes of all panels.
    further_choices
        Choice for each additional facet, a property by which panels differ; equal for all these
        panels.
    """
    style_by_name = {
        name: k
        for k, name in enumerate(
            dict.fromkeys(labelled_line.line_name for labelled_line in labelled_lines)
        )
    }
    lines_by_part: dict[str, list[ChartLine]] = {}
    for (part, name, _), line in zip(labelled_lines, drawn_lines, strict=True):
        styled_line = replace(
            line, x=x_axis.to_axis_units(line.x), name=name, style_index=style_by_name[name]
        )
        lines_by_part.setdefault(part, []).append(styled_line)
    return [
        Panel({"part": p} | further_choices, x_axis.chart_axis, y_axis, lines)
        for p, lines in lines_by_part.items()
    ]


def lines_alt_text(label: str, span_text: str, panel: Panel) -> str:
    """Return a chart's text for readers who can't see it: the extent of each line of a panel."""
    line_texts = [
        f"{line.name or 'the line'}: {labels.describe_value_extent(line.y)}" for line in panel.lines
    ]
    return f"Lines of {label} over {span_text}. {'; '.join(line_texts)}."


def read_lines_along(
    points_and_variables: Sequence[tuple[PointSelection, str]], x: str
) -> LinesWithRemarks:
    """Read variables along a coordinate as lines of a chart, in one pass.

    Parameters
    ----------
    points_and_variables
        Points and name of the variable of each line.
    x
        Name of the coordinate. Along other dimensions the first selected index is taken.

    Returns
    -------
    LinesWithRemarks
        Lines in the order of `points_and_variables`. A line with many points shows the means of
        adjacent points, with a band from the lowest to the highest of them. The band of any other
        line is the confidence interval of each point, if there is one.
    """
    lazy_arrays: list[list[Any]] = []
    reductions: list[tuple[SortedCoordinate, int, float, bool]] = []
    for points, variable in points_and_variables:
        coordinate = points.sorted_coordinate(x)
        dataset_with_ends, confidence = _value_and_interval_ends(points.dataset, variable)
        cells_max = REDUCED_LINE_CELLS_MAX * (
            1 if coordinate.values.size > 2 * REDUCED_LINE_CELLS_MAX else 2
        )
        has_ends = len(dataset_with_ends) > 1
        cell_statistics = (
            (CELL_MEAN, CELL_LOWEST, CELL_HIGHEST)
            if has_ends or coordinate.points_per_cell(cells_max) > 1
            else (CELL_MEAN,)
        )
        points_with_ends = replace(points, dataset=dataset_with_ends)
        lazy_arrays.append(
            [
                points_with_ends.coarsen(
                    k if has_ends else CELL_MEAN, [(coordinate, cells_max)], k
                ).data
                for k in cell_statistics
            ]
        )
        reductions.append((coordinate, cells_max, confidence, has_ends))
    chart_lines, remarks = [], []
    for (coordinate, cells_max, confidence, has_ends), arrays in zip(
        reductions, dask.compute(*lazy_arrays), strict=True
    ):
        mean, *ends = (np.asarray(a, float) for a in arrays)
        n_averaged_points = coordinate.points_per_cell(cells_max)
        band: dict[str, Any] = dict(zip(("low", "high"), ends, strict=False))
        chart_lines.append(
            ChartLine(
                coordinate.cell_means(cells_max), mean, n_averaged_points=n_averaged_points, **band
            )
        )
        remarks.append(_band_remark(n_averaged_points, confidence, has_ends))
    return LinesWithRemarks(chart_lines, list(dict.fromkeys(remarks)))


def _value_and_interval_ends(dataset: xr.Dataset, variable: str) -> tuple[xr.Dataset, float]:
    """Return a dataset with a variable and the ends of its confidence interval, and the level.

    The dataset has the variable as `mean`, and `lowest` and `highest` if there is an interval. The
    level is that of confidence, 0..1; it is 0 if there is no interval or no single level.
    """
    segment = variable.removeprefix("pd_")
    if f"{variable}_low" in dataset:
        variable_by_statistic = {
            CELL_MEAN: variable,
            CELL_LOWEST: f"{variable}_low",
            CELL_HIGHEST: f"{variable}_high",
        }
        dataset_with_ends = xr.Dataset(
            {kind: dataset[name] for kind, name in variable_by_statistic.items()}
        )
    elif segment in SEGMENTS_AND_SHOT and pd_half_width(dataset, segment) is not None:
        dataset_with_ends = detection_probability(dataset, segment)
        dataset_with_ends = dataset_with_ends.rename(
            {"pd": CELL_MEAN, "low": CELL_LOWEST, "high": CELL_HIGHEST}
        )
    else:
        return xr.Dataset({CELL_MEAN: dataset[variable]}), 0.0
    return dataset_with_ends, float(dataset_with_ends[CELL_LOWEST].attrs.get("confidence", 0.0))


def _band_remark(n_averaged_points: int, confidence: float, has_ends: bool) -> str:
    """Return a caption phrase on what the band of a line shows; '' for a line without a band."""
    interval_text = f"{100 * confidence:g} % confidence interval" if confidence else "interval"
    if n_averaged_points > 1:
        ends_note = f", their {interval_text}s included" if confidence else ""
        return (
            f"line: mean of {n_averaged_points} neighbouring points; band: from the lowest of them "
            f"to the highest{ends_note}, so that no narrow dip is hidden"
        )
    return f"band: {interval_text} of each point" if has_ends else ""
