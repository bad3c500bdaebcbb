"""Styles of pictures of point clouds: colours, markers, legends and ticks."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, LogNorm, Normalize, to_rgba
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator
from scipy.spatial import cKDTree

from sweep.analysis import canvas, labels
from sweep.analysis.scene_results.recordings import (
    CATEGORICAL_QUANTITIES,
    LOG_SCALE_QUANTITIES,
    POINT_KIND_BITS,
    SIGNED_QUANTITIES,
    quantity_label,
)

DIVERGING_COLOUR_MAP = LinearSegmentedColormap.from_list(
    "both_signs",
    [(0.0, "#7CC6EE"), (0.36, "#0072B2"), (0.5, "#2B2B33"), (0.64, "#D55E00"), (1.0, "#F5B26B")],
)
"""Colour map for values of both signs: dark at zero, blue below and orange above.

The colours are distinct for colour-blind readers and on a pale ground. Small values already show
their sign; larger ones are paler.
"""

MISSING_POINT_COLOUR = "0.6"
"""Colour of points whose value is not known, or whose category has no colour assigned."""

OUTLIER_MARGIN_FRACTION = 0.25
"""Distance from the 0.5 % or 99.5 % quantile beyond which colour scales leave out values.

The distance is a fraction of the difference between the two quantiles.
"""


@dataclass(frozen=True)
class ContinuousColourScale:
    """Colours of a quantity with continuous values."""

    cmap: Colormap
    """Colour map of matplotlib."""
    norm: Normalize
    """Mapping of values to 0..1, an object of matplotlib."""
    label: str
    """Label of the colour bar, with units."""
    colour_bar_extend: str = "neither"
    """Ends of the colour bar beyond which values lie: neither, min, max or both."""

    def to_rgba_colours(self, values: np.ndarray) -> np.ndarray:
        """Return the colours (n, 4) of values (n,), as red, green, blue and opacity, 0..1."""
        is_finite = np.isfinite(values)
        colours = np.asarray(self.cmap(self.norm(np.where(is_finite, values, 1.0))))
        colours[~is_finite] = to_rgba(MISSING_POINT_COLOUR)
        return colours


@dataclass(frozen=True)
class CategoryColours:
    """Colours of categories that have numbers, such as beams or surfaces."""

    title: str
    """Title of the legend."""
    label_by_number: Mapping[int, str]
    """Name of each category in the legend, by its number."""

    @property
    def colour_by_number(self) -> dict[int, str]:
        """Colours of categories by number; categories beyond the available colours are missing."""
        named_numbers = [number for number in self.label_by_number if number >= 0]
        return dict(zip(named_numbers, canvas.LINE_COLOURS, strict=False))

    def to_rgba_colours(self, values: np.ndarray) -> np.ndarray:
        """Return the colours (n, 4) of category numbers (n,): red, green, blue, opacity, 0..1."""
        rgba = np.tile(to_rgba(MISSING_POINT_COLOUR), (np.size(values), 1))
        for number, colour in self.colour_by_number.items():
            rgba[np.asarray(values) == number] = to_rgba(colour)
        return rgba

    def legend_handles(self) -> list[Line2D]:
        """Return a legend entry of matplotlib for each category."""
        return [
            legend_marker("o", name, color=self.colour_by_number.get(number, MISSING_POINT_COLOUR))
            for number, name in self.label_by_number.items()
        ]


def legend_marker(marker: str, label: str, **style: Any) -> Line2D:
    """Return a legend entry for a marker of matplotlib."""
    return Line2D([], [], linestyle="", marker=marker, label=label, **{"markersize": 6} | style)


def false_point_legend_marker() -> Line2D:
    """Return the legend entry for false points."""
    return legend_marker("x", "false point", color="0.2", markersize=5)


def choose_colours(
    quantity: str, values: np.ndarray, *, is_trusted: np.ndarray, surfaces: Sequence[str]
) -> ContinuousColourScale | CategoryColours:
    """Return the colours for the values of a quantity: a continuous scale, or one per category.

    ``is_trusted`` is a mask of the values that determine the ends of a continuous scale.
    ``surfaces`` are the display names of the surfaces, by number.
    """
    if quantity in CATEGORICAL_QUANTITIES:
        numbers = [int(n) for n in np.unique(values[np.isfinite(values)])]
        if quantity == "flags":
            return CategoryColours(
                "point", {n: labels.coordinate_label(list(POINT_KIND_BITS)[n]) for n in numbers}
            )
        if len(numbers) <= len(canvas.LINE_COLOURS):
            surface_by_number = dict(enumerate(surfaces)) if quantity == "surface" else {}
            label_by_number = {
                n: surface_by_number.get(n, "none" if n < 0 else f"{n}") for n in numbers
            }
            return CategoryColours(labels.coordinate_label(quantity), label_by_number)
    return _continuous_colour_scale(quantity, values, is_trusted)


def _colour_scale_ends(values: np.ndarray) -> tuple[float, float]:
    """Return the lowest and the highest value of a colour scale that leaves out far outliers."""
    if not values.size:
        return 1.0, 1.0
    low, low_quantile, high_quantile, high = (
        float(q) for q in np.quantile(values, [0.0, 0.005, 0.995, 1.0])
    )
    outlier_distance = OUTLIER_MARGIN_FRACTION * (high_quantile - low_quantile)
    return (low_quantile if low_quantile - low > outlier_distance else low), (
        high_quantile if high - high_quantile > outlier_distance else high
    )


def _continuous_colour_scale(
    quantity: str, values: np.ndarray, is_trusted: np.ndarray
) -> ContinuousColourScale:
    """Return a colour scale from the lowest to the highest trusted value, without far outliers.

    If no trusted value is finite, all finite values count.
    """
    finite_values = values[np.isfinite(values)]
    trusted_values = values[is_trusted & np.isfinite(values)]
    trusted_values = trusted_values if trusted_values.size else finite_values
    is_log = quantity in LOG_SCALE_QUANTITIES
    low, high = _colour_scale_ends(trusted_values[trusted_values > 0] if is_log else trusted_values)
    cmap = colormaps[canvas.COLOUR_MAP_NAME]
    if quantity in SIGNED_QUANTITIES and low < 0 < high:
        cmap, low, high = DIVERGING_COLOUR_MAP, -max(-low, high), max(-low, high)
    if high <= low:
        low, high = (low / 2, high * 2) if is_log else (low - 0.5, high + 0.5)
    has_below, has_above = bool((finite_values < low).any()), bool((finite_values > high).any())
    return ContinuousColourScale(
        cmap,
        LogNorm(low, high) if is_log else Normalize(low, high),
        textwrap.fill(quantity_label(quantity), 44),
        {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[has_below, has_above],
    )


LEGEND_WIDTH_INCHES = 1.75
"""Width of the space for legends at the right of a picture [inches]."""

TITLE_HEIGHT_INCHES, CAPTION_HEIGHT_INCHES, CAPTION_LINE_HEIGHT_INCHES = 0.75, 0.55, 0.17
"""Heights of the title, of a one-line caption, and of each additional line [inches]."""


class SheetWithLegends:
    """Sheet with a picture of a given size [inches], and with legends at its right."""

    def __init__(self, width: float, height: float, *, title: str, caption: str) -> None:
        self.width, self.height = width, height
        head_height = TITLE_HEIGHT_INCHES + 0.18 * title.count("\n")
        total_width = width + LEGEND_WIDTH_INCHES
        self.foot_height = CAPTION_HEIGHT_INCHES + CAPTION_LINE_HEIGHT_INCHES * (
            len(caption) // int(15 * total_width)
        )
        self.sheet = canvas.blank_sheet(total_width, height + head_height + self.foot_height)
        self.sheet.set_layout_engine("none")
        canvas.set_title(self.sheet, title)
        canvas.set_caption(self.sheet, caption)

    def to_sheet_fractions(
        self, left: float, bottom: float, width: float, height: float
    ) -> tuple[float, float, float, float]:
        """Return a rectangle [inches] from the picture's lower left corner in sheet fractions.

        The result is left, bottom, width and height.
        """
        sheet_width, sheet_height = self.sheet.get_size_inches()
        return (
            left / sheet_width,
            (self.foot_height + bottom) / sheet_height,
            width / sheet_width,
            height / sheet_height,
        )

    def add_axes(self, *rectangle_inches: float, **options: Any) -> Axes:
        """Add axes to the sheet, and return them.

        Left, bottom, width and height [inches] are measured from the picture's lower left corner.
        """
        return self.sheet.add_axes(self.to_sheet_fractions(*rectangle_inches), **options)

    def draw_legends(
        self, colouring: ContinuousColourScale | CategoryColours, handles: Sequence[Artist]
    ) -> None:
        """Draw the colour bar or the legend of categories, and the legend of the given handles."""
        if isinstance(colouring, ContinuousColourScale):
            bar_height = min(0.72 * self.height, 4.2)
            axes = self.add_axes(
                self.width + 0.15, (self.height - bar_height) * 0.62, 0.17, bar_height
            )
            colour_bar = self.sheet.colorbar(
                ScalarMappable(colouring.norm, colouring.cmap),
                cax=axes,
                extend=colouring.colour_bar_extend,
            )
            colour_bar.set_label(colouring.label, fontsize=9)
            colour_bar.ax.tick_params(labelsize=8)
            if not isinstance(colouring.norm, LogNorm):
                colour_bar.ax.ticklabel_format(useOffset=False)
        elif colouring.label_by_number:
            self._draw_legend(
                colouring.legend_handles(), 0.86 * self.height, colouring.title, "upper left"
            )
        if handles:
            self._draw_legend(handles, 0.0, "", "lower left")

    def _draw_legend(self, handles: Sequence[Artist], bottom: float, title: str, loc: Any) -> None:
        """Draw one legend at the right of the picture.

        `bottom` is the height of the legend's anchor above the picture's foot [inches], `loc` the
        corner of the legend at that anchor.
        """
        x, y, *_ = self.to_sheet_fractions(self.width + 0.02, bottom, 0, 0)
        self.sheet.legend(
            handles=list(handles), title=title or None, loc=loc, bbox_to_anchor=(x, y),
            frameon=False, fontsize=8, handletextpad=0.5, borderaxespad=0.0,
        )  # fmt: skip


MARKER_AREA_MAX = 24.0
"""Largest area of the marker of a point of a cloud [(1/72 inch)^2]."""

MARKER_AREA_MIN_BY_POINT_COUNT = ((2000, 9.0), (8000, 5.0), (30_000, 2.0), (math.inf, 0.7))
"""Pairs (n, area): least area of markers [(1/72 inch)^2] in pictures with up to n points."""

TICK_SPACING_MIN_X_INCHES, TICK_SPACING_MIN_Y_INCHES = 0.42, 0.25
"""Least spacing of ticks at which labels are legible, on x and on y axes [inches]."""

OFFSET_LABEL_COORDINATE_MIN = 1e5
"""Magnitude of coordinates above which ticks show differences from a round number [m]."""


def marker_area(positions: np.ndarray, width: float, height: float) -> float:
    """Return the area of markers [(1/72 inch)^2] at which most markers of a picture do not touch.

    `positions` (2, n), `width` and `height` of the picture are in inches.
    """
    n_points = positions.shape[1]
    if n_points < 2:
        return MARKER_AREA_MAX
    neighbour_distances = cKDTree(positions.T).query(positions.T[:: max(1, n_points // 1000)], k=2)[
        0
    ][:, 1]
    separate_area = (0.85 * 72 * float(np.median(neighbour_distances))) ** 2
    covering_area = 0.1 * 72 * 72 * width * height / n_points
    area_min = next(
        area for points_max, area in MARKER_AREA_MIN_BY_POINT_COUNT if n_points <= points_max
    )
    return min(max(min(separate_area, covering_area), area_min), MARKER_AREA_MAX)


def false_point_marker_style(area: float) -> dict[str, Any]:
    """Return the options of matplotlib's `scatter` for false points.

    `area` is the area of the markers of true points [(1/72 inch)^2].
    """
    return {"marker": "x", "s": max(1.2 * area, 9.0), "linewidths": 0.7}


def set_length_axis(
    axis: Any,
    name: str,
    limits: tuple[float, float],
    axis_inches: float,
    tick_spacing: float = TICK_SPACING_MIN_X_INCHES,
) -> None:
    """Set label and ticks of one of matplotlib's axes that shows a coordinate in metres.

    Parameters
    ----------
    axis
        Axis of matplotlib.
    name
        Name of the coordinate.
    limits
        Lowest and highest coordinate [m]. Large coordinates are shown as differences from a round
        number.
    axis_inches
        Length of the axis [inches].
    tick_spacing
        Least distance between ticks [inches].
    """
    low, high = limits
    offset = 0.0
    if max(abs(low), abs(high)) > OFFSET_LABEL_COORDINATE_MIN:
        rounding_unit = 10.0 ** max(math.ceil(math.log10(high - low)), 0)
        offset = rounding_unit * round((low + high) / 2 / rounding_unit)
    n_ticks = min(max(int(axis_inches / tick_spacing), 1), 8)
    axis.set_major_locator(MaxNLocator(n_ticks, steps=[1, 2, 2.5, 5, 10], min_n_ticks=1))
    if offset:
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value - offset:g}"))
        name = f"{name} {'-' if offset > 0 else '+'} {abs(offset):.0f}"
    axis.set_label_text(labels.axis_label(name, "m"))
    axis.label.set_size(9)
    axis.set_tick_params(labelsize=8)
