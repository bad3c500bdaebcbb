"""Pictures of point clouds, oblique or along a world axis, and scatter plots."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, ClassVar, Literal

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d import proj3d

from sweep.analysis import canvas, labels
from sweep.analysis.scene_results import point_styles
from sweep.analysis.scene_results.point_styles import SheetWithLegends
from sweep.analysis.scene_results.recordings import (
    CATEGORICAL_QUANTITIES,
    LOG_SCALE_QUANTITIES,
    SIGNED_QUANTITIES,
    WORLD_AXES,
    ColumnArrays,
    PointCloud,
    ThinnedRows,
    quantity_label,
    to_displayed_values,
    within_limits_mask,
)
from sweep.model.pointcloud.pairing import TRUE_RETURN_FLAG
from sweep.storage.store_format import TERRAIN_MAP_GROUP

SUN_AZIMUTH_DEG, SUN_ELEVATION_DEG = 315.0, 40.0
"""Azimuth and elevation of the light that shades the ground [deg].

The azimuth is measured from north towards east.
"""

DRAWN_GROUND_SLOPE_MAX = 1.5
"""Slope of the ground (rise over run) above which the ground is not drawn.

Walls and the edges of tree crowns, if drawn, would hide points.
"""


@dataclass(frozen=True)
class HeightMap:
    """Heights of the ground on a regular grid."""

    x: np.ndarray
    """World x of the map's columns [m], rising."""
    y: np.ndarray
    """World y of the map's rows [m], rising."""
    height: np.ndarray
    """World z of the ground (rows, columns) [m]; nan where unknown."""

    @classmethod
    def from_tree(cls, tree: xr.DataTree) -> HeightMap | None:
        """Return the height map of a flight's tree; None if no height is known."""
        if TERRAIN_MAP_GROUP not in tree.children:
            return None
        x, y, height = (
            np.asarray(tree[TERRAIN_MAP_GROUP][name].values) for name in ("x", "y", "height")
        )
        return cls(x, y, height) if np.isfinite(height).any() else None

    def crop(
        self, x: tuple[float, float], y: tuple[float, float], nodes_max: int = 120
    ) -> HeightMap | None:
        """Return the part of the map within limits of x and y [m], interpolated on a new grid.

        The longer side of the new grid has ``nodes_max`` nodes. The result is None if the limits
        lie outside the map.
        """
        overlaps = [
            (max(float(coordinates[0]), low), min(float(coordinates[-1]), high))
            for coordinates, (low, high) in ((self.x, x), (self.y, y))
        ]
        if any(high <= low for low, high in overlaps):
            return None
        step = max(high - low for low, high in overlaps) / (nodes_max - 1)
        x_nodes, y_nodes = (np.linspace(low, high, max(2, round((high - low) / step) + 1))
                      for low, high in overlaps)  # fmt: skip
        height = xr.DataArray(self.height, [("y", self.y), ("x", self.x)]).interp(
            x=x_nodes, y=y_nodes
        )
        return HeightMap(x_nodes, y_nodes, height.values)

    def mask_steep_ground(self) -> HeightMap:
        """Return a copy of the map with nan where the slope exceeds `DRAWN_GROUND_SLOPE_MAX`."""
        is_steep = np.hypot(*np.gradient(self.height, self.y, self.x)) > DRAWN_GROUND_SLOPE_MAX
        return HeightMap(self.x, self.y, np.where(is_steep, np.nan, self.height))

    def hillshade(self) -> np.ndarray:
        """Return the brightness (rows, columns), 0..1, of the ground in the light of a low sun.

        Slopes are exaggerated. Ground of unknown height has the brightness 1.
        """
        slope_y, slope_x = np.gradient(self.height, self.y, self.x)
        slope = np.hypot(slope_y, slope_x)
        finite_slopes = slope[np.isfinite(slope)]
        typical_slope = float(np.percentile(finite_slopes, 80)) if finite_slopes.size else 0.0
        stretch = 0.6 / typical_slope if typical_slope > 0 else 1.0
        azimuth, elevation = np.radians(90.0 - SUN_AZIMUTH_DEG), np.radians(SUN_ELEVATION_DEG)
        sunward_slope = (
            np.cos(elevation) * (np.cos(azimuth) * slope_x + np.sin(azimuth) * slope_y) * stretch
        )
        brightness = (np.sin(elevation) - sunward_slope) / np.sqrt(1 + (stretch * slope) ** 2)
        return np.clip(np.where(np.isfinite(brightness), brightness, 1.0), 0.0, 1.0)


DROPOUT_COLOUR, PATH_COLOUR, GROUND_COLOUR = "#C1121F", "#1A1A1A", "0.86"
"""Colours of shots without a point, of the flight path, and of the ground seen from the side."""

OBLIQUE_WIDTH_MAX_INCHES, OBLIQUE_HEIGHT_MAX_INCHES = 7.6, 6.4
"""Largest width and height, on an oblique picture, of the box around the points [inches]."""

OBLIQUE_MARGINS_INCHES = (0.55, 0.75, 0.85, 0.1)
"""Margins of an oblique picture for ticks and labels: left, below, right and above [inches]."""

_TRIAL_SHEET_SIDE_INCHES = 10.0
"""Side of the square trial sheet on which the points' box is projected and measured [inches]."""


class ObliqueView:
    """Oblique picture of a point cloud, in orthographic projection.

    ``azimuth`` is the direction of the eye, from x towards y, and ``elevation`` its angle above the
    ground plane [deg].
    """

    scatter_options: ClassVar[dict[str, Any]] = {"depthshade": False}
    """Options of matplotlib's `scatter` for points of an oblique view."""

    def __init__(
        self, cloud: PointCloud, azimuth: float, elevation: float, *, title: str, caption: str
    ) -> None:
        self.cloud = cloud
        self.draw_order = np.arange(cloud.true_point_mask.size)
        low, high = self._projected_box(azimuth, elevation)
        inches_per_unit = min(
            OBLIQUE_WIDTH_MAX_INCHES / (high[0] - low[0]),
            OBLIQUE_HEIGHT_MAX_INCHES / (high[1] - low[1]),
        )
        self.inches_per_unit = inches_per_unit
        self.size_inches = (
            inches_per_unit * (high[0] - low[0]),
            inches_per_unit * (high[1] - low[1]),
        )
        left, below, right, above = OBLIQUE_MARGINS_INCHES
        self.picture_sheet = SheetWithLegends(
            self.size_inches[0] + left + right,
            self.size_inches[1] + below + above,
            title=title,
            caption=caption,
        )
        # Matplotlib's square axes may extend beyond the sheet, but the box inside does not.
        self.axes: Any = self.picture_sheet.add_axes(
            left - inches_per_unit * low[0],
            below - inches_per_unit * low[1],
            inches_per_unit,
            inches_per_unit,
            projection="3d",
            computed_zorder=False,
        )
        self._set_box_axes(self.axes, azimuth, elevation)
        side_ratios = self._side_ratios()
        for name, side_ratio in zip(WORLD_AXES, side_ratios, strict=True):
            side_inches = 0.62 * inches_per_unit * side_ratio
            axis = getattr(self.axes, f"{name}axis")
            tick_spacing = (
                point_styles.TICK_SPACING_MIN_Y_INCHES
                if name == "z"
                else point_styles.TICK_SPACING_MIN_X_INCHES
            )
            point_styles.set_length_axis(axis, name, cloud.box[name], side_inches, tick_spacing)
            axis.labelpad = 2 if side_inches < 0.8 else 9 + 4 * (name == "z")
            axis.set_tick_params(pad=2 + 4 * (name == "z") * side_ratio)

    def _side_ratios(self) -> np.ndarray:
        """Return the sides (3,) of the cloud's box, divided by the longest side."""
        sides = np.array([self.cloud.box[axis][1] - self.cloud.box[axis][0] for axis in WORLD_AXES])
        return sides / sides.max()

    def _set_box_axes(self, axes: Any, azimuth: float, elevation: float) -> None:
        """Set the projection, limits and background of three-dimensional axes, in place."""
        axes.patch.set_visible(False)
        axes.set_proj_type("ortho")
        axes.view_init(elev=elevation, azim=azimuth)
        axes.set_box_aspect(self._side_ratios())
        for name in WORLD_AXES:
            getattr(axes, f"set_{name}lim")(*self.cloud.box[name])
            axis = getattr(axes, f"{name}axis")
            axis.pane.set_facecolor("white")
            axis.pane.set_edgecolor("0.8")

    def _projected_box(self, azimuth: float, elevation: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower left and the upper right corner (2,) of the cloud's box, as projected.

        Corners are fractions of matplotlib's square axes.
        """
        trial_sheet = SheetWithLegends(
            _TRIAL_SHEET_SIDE_INCHES, _TRIAL_SHEET_SIDE_INCHES, title="", caption=""
        )
        axes = trial_sheet.add_axes(
            0, 0, _TRIAL_SHEET_SIDE_INCHES, _TRIAL_SHEET_SIDE_INCHES, projection="3d"
        )
        self._set_box_axes(axes, azimuth, elevation)
        corners = np.array(list(product(*(self.cloud.box[axis] for axis in WORLD_AXES)))).T
        projected = self._project(axes, corners)
        return projected.min(axis=1), projected.max(axis=1)

    @staticmethod
    def _project(axes: Any, positions: np.ndarray) -> np.ndarray:
        """Return world positions (3, n) as positions (2, n) in fractions of the square axes."""
        x, y, _ = proj3d.proj_transform(*positions, axes.get_proj())
        view_limits = axes.viewLim
        return np.array(
            [(x - view_limits.x0) / view_limits.width, (y - view_limits.y0) / view_limits.height]
        )

    def to_axes_coordinates(self, positions: np.ndarray) -> Sequence[np.ndarray]:
        """Return world positions (3, n) as the coordinates (n,) that the axes plot: x, y and z."""
        return list(positions)

    def to_picture_inches(self, positions: np.ndarray) -> np.ndarray:
        """Return world positions (3, n) as positions on the picture, (2, n) [inches]."""
        return self.inches_per_unit * self._project(self.axes, positions)

    def draw_ground(self, height_map: HeightMap) -> bool:
        """Draw a shaded relief of the ground within the cloud's box, without steep ground.

        Return False, because the legend needs no entry for the relief.
        """
        cropped = height_map.crop(self.cloud.box["x"], self.cloud.box["y"])
        if cropped is None:
            return False
        low, high = self.cloud.box["z"]
        cropped = cropped.mask_steep_ground()
        is_in_box = (cropped.height >= low) & (cropped.height <= high)
        x, y = np.meshgrid(cropped.x, cropped.y)
        self.axes.plot_surface(
            x,
            y,
            np.where(is_in_box, cropped.height, np.nan),
            facecolors=_shaded_ground_colours(cropped),
            rcount=200,
            ccount=200,
            shade=False,
            linewidth=0,
            antialiased=False,
            zorder=1,
        )
        return False


AXIS_MARGINS_INCHES = 0.8, 0.55
"""Margins of a picture for ticks and labels: left and bottom [inches]."""

AXIS_VIEW_WIDTH_MAX_INCHES, AXIS_VIEW_HEIGHT_MAX_INCHES, AXIS_VIEW_SIDE_MIN_INCHES = 7.4, 7.0, 1.5
"""Largest width, largest height and smallest side of a picture along a world axis [inches]."""


class AxisAlignedView:
    """Picture of a point cloud, viewed along a world axis.

    `axis_names` are the horizontal, the vertical and the viewing axis. `nearest_sign` is
    1 if the eye is at the upper end of the viewing axis, and -1 at its lower end.
    """

    scatter_options: ClassVar[dict[str, Any]] = {}
    """Options of matplotlib's `scatter` for points of a view along an axis."""

    def __init__(
        self,
        cloud: PointCloud,
        axis_names: tuple[str, str, str],
        nearest_sign: int,
        *,
        title: str,
        caption: str,
    ) -> None:
        self.cloud, self.axis_names = cloud, axis_names
        self.draw_order = np.argsort(nearest_sign * cloud.points[axis_names[2]], kind="stable")
        sides = [cloud.box[axis][1] - cloud.box[axis][0] for axis in axis_names[:2]]
        self.inches_per_unit = min(
            AXIS_VIEW_WIDTH_MAX_INCHES / sides[0], AXIS_VIEW_HEIGHT_MAX_INCHES / sides[1]
        )
        self.size_inches = (
            max(self.inches_per_unit * sides[0], AXIS_VIEW_SIDE_MIN_INCHES),
            max(self.inches_per_unit * sides[1], AXIS_VIEW_SIDE_MIN_INCHES),
        )
        self.picture_sheet = SheetWithLegends(
            self.size_inches[0] + AXIS_MARGINS_INCHES[0],
            self.size_inches[1] + AXIS_MARGINS_INCHES[1],
            title=title,
            caption=caption,
        )
        self.axes = self.picture_sheet.add_axes(*AXIS_MARGINS_INCHES, *self.size_inches)
        self.axes.set_aspect("equal")
        x_name, y_name = axis_names[:2]
        point_styles.set_length_axis(
            self.axes.xaxis, x_name, cloud.box[x_name], self.size_inches[0]
        )
        point_styles.set_length_axis(
            self.axes.yaxis,
            y_name,
            cloud.box[y_name],
            self.size_inches[1],
            point_styles.TICK_SPACING_MIN_Y_INCHES,
        )
        self._set_axis_limits()

    def _set_axis_limits(self) -> None:
        """Set the limits of both axes to the cloud's box."""
        self.axes.set(
            xlim=self.cloud.box[self.axis_names[0]], ylim=self.cloud.box[self.axis_names[1]]
        )

    def to_axes_coordinates(self, positions: np.ndarray) -> Sequence[np.ndarray]:
        """Return world positions (3, n) as the two coordinates (n,) that the axes plot."""
        return [positions[WORLD_AXES.index(axis)] for axis in self.axis_names[:2]]

    def to_picture_inches(self, positions: np.ndarray) -> np.ndarray:
        """Return world positions (3, n) as positions on the picture, (2, n) [inches]."""
        return self.inches_per_unit * np.array(self.to_axes_coordinates(positions))

    def draw_ground(self, height_map: HeightMap) -> bool:
        """Draw the ground: as relief with contours if seen from above, as an area if from the side.

        Return True if the legend needs an entry for the ground.
        """
        cropped = height_map.crop(self.cloud.box["x"], self.cloud.box["y"], nodes_max=480)
        if cropped is None:
            return False
        if self.axis_names[2] == "z":
            self._draw_relief(cropped.mask_steep_ground())
        else:
            self._draw_profile(cropped)
        self._set_axis_limits()
        return self.axis_names[2] != "z"

    def _draw_relief(self, height_map: HeightMap) -> None:
        """Draw a shaded relief from above, with labelled contours."""
        half_dx, half_dy = ((nodes[1] - nodes[0]) / 2 for nodes in (height_map.x, height_map.y))
        extent = (
            height_map.x[0] - half_dx,
            height_map.x[-1] + half_dx,
            height_map.y[0] - half_dy,
            height_map.y[-1] + half_dy,
        )
        self.axes.imshow(
            _shaded_ground_colours(height_map),
            extent=extent,
            origin="lower",
            zorder=0,
            interpolation="bilinear",
        )
        finite_heights = height_map.height[np.isfinite(height_map.height)]
        if finite_heights.size and finite_heights.max() > finite_heights.min():
            contours = self.axes.contour(
                height_map.x,
                height_map.y,
                height_map.height,
                levels=7,
                colors="0.42",
                linewidths=0.5,
                zorder=1,
            )
            self.axes.clabel(contours, fontsize=7, fmt="%g m")

    def _draw_profile(self, height_map: HeightMap) -> None:
        """Fill the area between the lowest and the highest ground, seen from the side."""
        coordinates, collapsed_axis = (
            (height_map.x, 0) if self.axis_names[0] == "x" else (height_map.y, 1)
        )
        is_known = np.isfinite(height_map.height)
        low = np.where(is_known, height_map.height, np.inf).min(axis=collapsed_axis)
        high = np.where(is_known, height_map.height, -np.inf).max(axis=collapsed_axis)
        self.axes.fill_between(
            coordinates,
            low,
            high,
            where=is_known.any(axis=collapsed_axis),
            color=GROUND_COLOUR,
            linewidth=0,
            zorder=0,
        )


def _draw_cloud_marks(picture: AxisAlignedView | ObliqueView, point_colours: np.ndarray) -> None:
    """Draw true points, false points, shots without a point, and the flight path on a picture."""
    axes: Any = picture.axes
    cloud, to_columns = picture.cloud, picture.to_axes_coordinates
    positions = np.array([cloud.points[axis] for axis in WORLD_AXES])
    area = point_styles.marker_area(picture.to_picture_inches(positions), *picture.size_inches)
    is_true = cloud.true_point_mask[picture.draw_order]
    true_indices, false_indices = picture.draw_order[is_true], picture.draw_order[~is_true]
    axes.scatter(
        *to_columns(positions[:, true_indices]),
        s=area,
        c=point_colours[true_indices],
        linewidths=0,
        zorder=3,
        **picture.scatter_options,
    )
    if false_indices.size:
        axes.scatter(
            *to_columns(positions[:, false_indices]),
            c=point_colours[false_indices],
            zorder=4,
            **picture.scatter_options,
            **point_styles.false_point_marker_style(area),
        )
    if cloud.dropouts:
        axes.scatter(
            *to_columns(_positions_in_box(cloud, cloud.dropouts)),
            s=max(1.6 * area, 10.0),
            facecolors="none",
            edgecolors=DROPOUT_COLOUR,
            linewidths=0.8,
            zorder=5,
            **picture.scatter_options,
        )
    if cloud.flight_path:
        path_columns = to_columns(_positions_in_box(cloud, cloud.flight_path))
        axes.plot(*path_columns, color=PATH_COLOUR, linewidth=1.5, zorder=6)
        axes.plot(
            *(column[:1] for column in path_columns), "o", color=PATH_COLOUR, markersize=5, zorder=6
        )


def _positions_in_box(cloud: PointCloud, column_arrays: ColumnArrays) -> np.ndarray:
    """Return positions (3, n) from a table's columns x, y, z, with nan outside the cloud's box."""
    positions = np.array([column_arrays[axis] for axis in WORLD_AXES])
    return np.where(within_limits_mask(column_arrays, cloud.box), positions, np.nan)


def _shaded_ground_colours(height_map: HeightMap) -> np.ndarray:
    """Return the shaded RGBA colours of the ground, (rows, columns, 4); transparent if unknown."""
    rgba = np.array(colormaps["gray"](0.62 + 0.36 * height_map.hillshade()))
    rgba[~np.isfinite(height_map.height)] = 0.0
    return rgba


AXIS_ALIGNED_VIEWS = {
    "above": (("x", "y", "z"), 1),
    "side": (("x", "z", "y"), -1),
    "front": (("y", "z", "x"), 1),
}
"""Views along a world axis, by name.

Each has the arguments `axis_names` and `nearest_sign` of :class:`AxisAlignedView`.
"""

OBLIQUE_ANGLES_DEG = -60.0, 28.0
"""Azimuth and elevation of the default oblique view [deg]."""


def draw_cloud_sheet(
    cloud: PointCloud,
    *,
    quantity: str,
    surfaces: Sequence[str],
    view: str | tuple[float, float],
    height_map: HeightMap | None,
    title: str,
    remarks: Sequence[str],
) -> Sheet:
    """Return the sheet of a point cloud, coloured by a quantity.

    Parameters
    ----------
    cloud
        Points, flight path and dropouts.
    quantity
        Name of the quantity that colours the points.
    surfaces
        Display names of the surfaces.
    view
        Name of a view, or azimuth and elevation of the eye [deg].
    height_map
        Ground to draw below the points; None for none.
    title
        Title of the sheet.
    remarks
        Sentences that follow in the caption.
    """
    values = to_displayed_values(quantity, cloud.points[quantity])
    colouring = point_styles.choose_colours(
        quantity, values, is_trusted=cloud.true_point_mask, surfaces=surfaces
    )
    caption = labels.join_sentences([*cloud.remarks, *remarks])
    picture: AxisAlignedView | ObliqueView
    if isinstance(view, str) and view in AXIS_ALIGNED_VIEWS:
        picture = AxisAlignedView(cloud, *AXIS_ALIGNED_VIEWS[view], title=title, caption=caption)
    else:
        angles = OBLIQUE_ANGLES_DEG if isinstance(view, str) else view
        picture = ObliqueView(cloud, *angles, title=title, caption=caption)
    ground_in_legend = height_map is not None and picture.draw_ground(height_map)
    _draw_cloud_marks(picture, colouring.to_rgba_colours(values))
    picture.picture_sheet.draw_legends(
        colouring, _legend_handles(cloud, shows_ground=ground_in_legend)
    )
    return picture.picture_sheet.sheet


def _legend_handles(cloud: PointCloud, *, shows_ground: bool) -> list[Any]:
    """Return the legend entries for everything in a picture except the colours of points."""
    handles: list[Any] = []
    if not cloud.true_point_mask.all():
        handles.append(point_styles.false_point_legend_marker())
    if cloud.dropouts and cloud.dropouts["x"].size:
        style = {"markerfacecolor": "none", "markeredgecolor": DROPOUT_COLOUR, "markersize": 5}
        handles.append(point_styles.legend_marker("o", "shot without\na point", **style))
    if cloud.flight_path:
        handles.append(
            Line2D([], [], color=PATH_COLOUR, linewidth=1.6, label="flight path,\ndot: start")
        )
    if shows_ground:
        handles.append(Patch(color=GROUND_COLOUR, label="heights of\nthe scene"))
    return handles


SCATTER_PLOT_SIZE_INCHES = 7.6, 4.6
"""Width and height of a scatter plot [inches]."""


def draw_scatter_sheet(
    thinned_rows: ThinnedRows,
    *,
    x: str,
    y: str,
    colour: str,
    surfaces: Sequence[str],
    title: str,
    remarks: Sequence[str],
) -> Sheet:
    """Return the sheet of a scatter plot of quantity y over quantity x, coloured by a third."""
    column_arrays = thinned_rows.to_columns()
    is_true = (
        (column_arrays["flags"] & TRUE_RETURN_FLAG) > 0
        if "flags" in column_arrays
        else np.ones(len(column_arrays[x]), bool)
    )
    values = to_displayed_values(colour, column_arrays[colour])
    colouring = point_styles.choose_colours(colour, values, is_trusted=is_true, surfaces=surfaces)
    columns = {name: to_displayed_values(name, column_arrays[name]) for name in (x, y)}
    limits = {name: _scatter_axis_limits(name, columns[name], is_true) for name in (x, y)}
    is_inside = within_limits_mask(columns, limits)
    count_texts = [thinned_rows.describe_count("point" if "flags" in column_arrays else "shot")]
    if n_outside := int((~is_inside & ~is_true).sum()) * thinned_rows.step:
        count_texts.append(
            f"{labels.number_with_noun(n_outside, 'false point')} outside of the picture"
        )
    picture_sheet = SheetWithLegends(
        SCATTER_PLOT_SIZE_INCHES[0] + AXIS_MARGINS_INCHES[0],
        SCATTER_PLOT_SIZE_INCHES[1] + AXIS_MARGINS_INCHES[1],
        title=title,
        caption=labels.join_sentences([*count_texts, *remarks]),
    )
    axes = picture_sheet.add_axes(*AXIS_MARGINS_INCHES, *SCATTER_PLOT_SIZE_INCHES)
    _set_scatter_axes(axes, limits, (x, y))
    rgba = colouring.to_rgba_colours(values)
    positions = np.array([columns[x], columns[y]])
    area = point_styles.marker_area(
        axes.transData.transform(positions[:, is_inside].T).T / canvas.PNG_DPI,
        *SCATTER_PLOT_SIZE_INCHES,
    )
    is_true_inside, is_false_inside = is_inside & is_true, is_inside & ~is_true
    x_values, y_values = positions
    axes.scatter(
        x_values[is_true_inside],
        y_values[is_true_inside],
        s=area,
        c=rgba[is_true_inside],
        linewidths=0,
        zorder=3,
    )
    false_style = point_styles.false_point_marker_style(area)
    axes.scatter(
        x_values[is_false_inside],
        y_values[is_false_inside],
        c=rgba[is_false_inside],
        zorder=2,
        **false_style,
    )
    picture_sheet.draw_legends(
        colouring, [point_styles.false_point_legend_marker()] if is_false_inside.any() else []
    )
    return picture_sheet.sheet


def _scatter_axis_limits(
    quantity: str, values: np.ndarray, is_true: np.ndarray
) -> tuple[float, float]:
    """Return the limits of an axis that contain all finite values of true points, with a margin.

    If no true point has a finite value, those of all points count. On a logarithmic axis only
    positive values count. Without values the limits are 0 and 1.
    """
    finite_values = values[is_true & np.isfinite(values)]
    finite_values = finite_values if finite_values.size else values[np.isfinite(values)]
    finite_values = (
        finite_values[finite_values > 0] if quantity in LOG_SCALE_QUANTITIES else finite_values
    )
    if not finite_values.size:
        return 0.0, 1.0
    low, high = float(finite_values.min()), float(finite_values.max())
    if quantity in LOG_SCALE_QUANTITIES:
        return low / 1.3, high * 1.3
    margin = 0.04 * (high - low) or 0.05 * abs(high) or 0.5
    return low - margin, high + margin


def _set_scatter_axes(
    axes: Axes, limits: dict[str, tuple[float, float]], quantities: tuple[str, str]
) -> None:
    """Set the limits, scales, labels and grid of a scatter plot of two quantities, in place."""
    axis_names: tuple[Literal["x", "y"], ...] = ("x", "y")
    for axis_name, quantity in zip(axis_names, quantities, strict=True):
        axes.set(**{f"{axis_name}scale": "log" if quantity in LOG_SCALE_QUANTITIES else "linear"})
        axes.set(
            **{
                f"{axis_name}label": textwrap.fill(quantity_label(quantity), 52),
                f"{axis_name}lim": limits[quantity],
            }
        )
        if quantity in CATEGORICAL_QUANTITIES:
            axes.locator_params(axis=axis_name, integer=True)
    axes.grid(True)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8)
    if (
        quantities[1] in SIGNED_QUANTITIES
        and limits[quantities[1]][0] < 0 < limits[quantities[1]][1]
    ):
        axes.axhline(0.0, color="0.6", linewidth=0.8, zorder=1)
