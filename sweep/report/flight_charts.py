"""Charts of a flight: rotatable point clouds, shots over time, navigation errors and noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import pandas
import plotly.graph_objects as go
import xarray as xr

from sweep.analysis import canvas, labels
from sweep.analysis.charts import (
    PROBABILITY_AXIS_LIMITS,
    Chart,
    ChartAxis,
    ChartLine,
    Panel,
    omission_remark,
)
from sweep.analysis.datasets import NotAStoreError
from sweep.analysis.scene_results.cloud_figures import HeightMap
from sweep.analysis.scene_results.navigation_errors import (
    navigation_error_chart,
    navigation_error_curves,
)
from sweep.analysis.scene_results.recordings import (
    INTERPOLATED_RANGES,
    POINT_KIND_BITS,
    WORLD_AXES,
    AxisPosition,
    PointCloud,
    Recording,
    axis_position_at,
    gather_point_cloud,
    point_kind_indices,
    quantity_label,
    read_eyepoints,
    to_displayed_values,
)
from sweep.analysis.selection import parameters_at
from sweep.analysis.study_figures import SceneResults
from sweep.model.effects.catalogue import effect_names_in_flags
from sweep.model.pointcloud.eyepoints import prepare_eyepoint_shots
from sweep.model.pointcloud.navigation import STATUS_EXCLUDED
from sweep.model.pointcloud.pairing import TRUE_RETURN_FLAG
from sweep.report.detector_charts import (
    NOISE_BUDGET_POINTS_MAX,
    noise_budget_chart,
    noise_budget_panel,
)
from sweep.report.html_page import (
    COLOUR_BAR_LAYOUT,
    HtmlTable,
    InteractivePlot,
    PlotControl,
    colour_bar_title_layout,
    plot_layout,
    to_sentences,
    trace_meta,
)
from sweep.spec import SceneSpec

CLOUD_COLOUR_QUANTITIES = ("range", "radial_velocity", "snr")
"""Names of the quantities by which the reader can colour the points of a cloud."""

PAGE_POINTS_MAX = 36_000
"""Largest number of points of all clouds on a page."""

PAGE_CLOUDS_MAX = 8
"""Largest number of clouds on a page. Each scanner has one per position along the study's axes."""

TERRAIN_SIDE_NODES_MAX = 90
"""Largest number of nodes of the drawn terrain along its longer side."""

TERRAIN_LOWERING_FRACTION = 0.012
"""Depth by which terrain is drawn too low, as a fraction of its horizontal size.

Points on the terrain are thus visible.
"""

CAMERA_FIELD_OF_VIEW = math.radians(45)
"""Vertical field of view of plotly's camera [rad]."""

VIEW_FILL_FRACTION, VIEW_ASPECT_MIN = 0.88, 1.2
"""Framing of the points of a cloud in plotly's view.

The first number is the fraction of the field of view that the points' box fills; the rest is for
labels. The second is the least width-to-height ratio of the plot, which is that on a phone.
"""

CAMERA_POSITION_BY_VIEW = {
    "at an angle": {"x": 1.1, "y": -1.3, "z": 0.6},
    "from above": {"x": 0.0, "y": -0.01, "z": 1.8},
    "from the south": {"x": 0.0, "y": -1.8, "z": 0.1},
    "from the east": {"x": 1.8, "y": 0.0, "z": 0.1},
}
"""Position of the camera for each view, in plotly's units of length."""

CAMERA_TARGET = {"x": 0.0, "y": 0.0, "z": -0.1}
"""Point at which plotly's camera looks, in plotly's units of length."""


@dataclass(frozen=True)
class LabelledRecording:
    """Recording of a scanner at one position along the study's axes, with a label."""

    label: str
    """Label on the page: scanner and axis values, each if there are several."""
    recording: Recording
    """Shots and points of the scanner at the axis position."""
    axis_position: AxisPosition
    """Position along the study's axes."""


class ShownRecordings(NamedTuple):
    """Recordings that a report has room for."""

    recordings: list[LabelledRecording]
    """Shown recordings, evenly spread over all of them."""
    n_omitted: int
    """Number of omitted recordings."""


def select_recordings(results: SceneResults) -> ShownRecordings:
    """Return the recordings that a report shows, and the number of omitted ones.

    There is a recording for each scanner and position along the study's axes.
    """
    axis_index_tuples = product(*(range(axis.size) for axis in results.spec.axes))
    candidates = list(product(results.scanners, axis_index_tuples))
    chosen_numbers = np.unique(
        np.linspace(0, len(candidates) - 1, min(PAGE_CLOUDS_MAX, len(candidates))).round()
    )
    labelled_recordings = []
    for scanner, index in (candidates[int(i)] for i in chosen_numbers):
        axis_position = axis_position_at(results.spec, index)
        scanner_label = labels.coordinate_label(scanner) if len(results.scanners) > 1 else ""
        recording_label = ", ".join(filter(None, [scanner_label, axis_position.label]))
        labelled_recordings.append(
            LabelledRecording(
                recording_label, axis_position.open_recording(results.tree, scanner), axis_position
            )
        )
    return ShownRecordings(labelled_recordings, len(candidates) - len(labelled_recordings))


def cloud_plot(
    results: SceneResults, labelled_recordings: Sequence[LabelledRecording], n_omitted: int
) -> InteractivePlot | None:
    """Return the plot of the point clouds of all recordings; None if there are no points.

    The plot shows one cloud at a time. `n_omitted` is the number of omitted recordings.
    """
    points_max = PAGE_POINTS_MAX // len(labelled_recordings)
    cloud_by_label = {
        labelled_recording.label: gather_point_cloud(
            labelled_recording.recording,
            [*CLOUD_COLOUR_QUANTITIES, "pd"],
            ranges=INTERPOLATED_RANGES,
            with_path=True,
            points_max=points_max,
        )
        for labelled_recording in labelled_recordings
    }
    shown_clouds = {
        cloud_label: cloud for cloud_label, cloud in cloud_by_label.items() if cloud is not None
    }
    if not shown_clouds:
        return None
    height_map = HeightMap.from_tree(results.tree)
    traces = [
        trace
        for cloud_label, cloud in shown_clouds.items()
        for trace in _cloud_traces(cloud_label, cloud, height_map)
    ]
    first_cloud = next(iter(shown_clouds.values()))
    n_draws = labelled_recordings[0].recording.dataset.sizes["draw"]
    count_texts = [
        f"{cloud_label}: {', '.join(cloud.remarks)}" if cloud_label else ", ".join(cloud.remarks)
        for cloud_label, cloud in shown_clouds.items()
    ]
    return InteractivePlot(
        heading="Points, flight path and terrain",
        alt=(
            f"Point cloud in three dimensions of {first_cloud.thinned_points.n_total:,} points, "
            "heights in metres: "
            f"{labels.describe_value_extent(first_cloud.points['z'])}; ranges: "
            f"{labels.describe_value_extent(first_cloud.points['range'])}; "
            f"with the flight path{' over the terrain' if height_map else ''}."
        ),
        caption=to_sentences(
            [
                *count_texts,
                f"Draw 0 of {n_draws}" if n_draws > 1 else "",
                "Ranges interpolated between bins; terrain shaded, and drawn a little below itself "
                "so that points show",
                omission_remark(n_omitted),
            ]
        ),
        figure=go.Figure(traces, _cloud_view_layout()),
        controls=[
            PlotControl("cloud", "Shown for", list(shown_clouds)),
            PlotControl(
                "colour",
                "Colour",
                [_colour_option_label(name) for name in CLOUD_COLOUR_QUANTITIES],
                {
                    _colour_option_label(name): {
                        "title": colour_bar_title_layout(quantity_label(name))
                    }
                    for name in CLOUD_COLOUR_QUANTITIES
                },
            ),
            PlotControl(
                "view",
                "View",
                list(CAMERA_POSITION_BY_VIEW),
                {
                    name: {"scene.camera": _camera_layout(name)} | _hidden_axis_layout(name)
                    for name in CAMERA_POSITION_BY_VIEW
                },
            ),
            PlotControl(
                "frame",
                "Frame",
                ["whole flight", "ground"],
                {
                    "whole flight": _framing_layout(list(shown_clouds.values()), with_path=True),
                    "ground": _framing_layout(list(shown_clouds.values())),
                },
            ),
            PlotControl("ground", "Terrain", ["shown", "hidden"] if height_map else ["none"]),
        ],
        is_tall=True,
    )


def _colour_option_label(quantity: str) -> str:
    """Return the text of the option by which the reader colours points by a quantity."""
    return {"snr": "signal-to-noise ratio"}.get(quantity, labels.coordinate_label(quantity))


def _xyz_columns(
    column_arrays: dict[str, np.ndarray], row_selection: np.ndarray | slice
) -> dict[str, np.ndarray]:
    """Return the columns x, y and z of selected rows of a table by name, in single precision."""
    return {axis: column_arrays[axis][row_selection].astype(np.float32) for axis in WORLD_AXES}


def _cloud_traces(
    cloud_label: str, cloud: PointCloud, height_map: HeightMap | None
) -> Iterator[go.Scatter3d | go.Surface]:
    """Yield plotly's traces of a cloud: terrain, flight path, and points in each colouring."""
    if height_map is not None:
        yield from _terrain_traces(cloud_label, cloud, height_map)
    yield go.Scatter3d(
        **_xyz_columns(cloud.flight_path, slice(None)),
        mode="lines",
        line={"width": 5},
        name="flight path",
        meta=trace_meta(0, cloud=cloud_label),
        hoverinfo="name",
    )
    is_true = cloud.true_point_mask
    for quantity in CLOUD_COLOUR_QUANTITIES:
        values = to_displayed_values(quantity, cloud.points[quantity])
        scale_values = values[is_true] if is_true.any() else values
        scale_values = scale_values[np.isfinite(scale_values)]
        low, high = (
            (float(scale_values.min()), float(scale_values.max()))
            if scale_values.size
            else (0.0, 1.0)
        )
        for kind_label, is_of_kind in (("true points", is_true), ("false points", ~is_true)):
            if is_of_kind.any():
                kind_values = values[is_of_kind].astype(np.float32)
                is_true_kind = kind_label == "true points"
                yield go.Scatter3d(
                    **_xyz_columns(cloud.points, is_of_kind),
                    mode="markers",
                    name=kind_label,
                    customdata=kind_values,
                    meta=trace_meta(cloud=cloud_label, colour=_colour_option_label(quantity))
                    | {"scaled": True},
                    hovertemplate=f"{quantity_label(quantity)}: "
                    f"%{{customdata:.5g}}<extra>{kind_label}</extra>",
                    marker={
                        "size": 3 if is_true_kind else 5,
                        "symbol": "circle" if is_true_kind else "diamond",
                        "color": kind_values,
                        "cmin": low,
                        "cmax": high,
                        "showscale": is_true_kind or not is_true.any(),
                        "colorbar": COLOUR_BAR_LAYOUT,
                    },
                )


def _terrain_traces(
    cloud_label: str, cloud: PointCloud, height_map: HeightMap
) -> Iterator[go.Surface]:
    """Yield plotly's trace of the shaded terrain around a cloud; nothing outside the height map."""
    map_limits = {}
    for axis in ("x", "y"):
        values = np.concatenate([cloud.points[axis], cloud.flight_path[axis]])
        margin = 0.1 * (np.ptp(values) + 1.0)
        map_limits[axis] = float(values.min() - margin), float(values.max() + margin)
    cropped = height_map.crop(map_limits["x"], map_limits["y"], TERRAIN_SIDE_NODES_MAX)
    if cropped is None:
        return
    map_size = max(high - low for low, high in map_limits.values())
    yield go.Surface(
        x=cropped.x.astype(np.float32), y=cropped.y.astype(np.float32),
        z=(cropped.height - TERRAIN_LOWERING_FRACTION * map_size).astype(np.float32),
        surfacecolor=cropped.hillshade().astype(np.float32), cmin=0, cmax=1, showscale=False,
        lighting={"ambient": 1, "diffuse": 0, "specular": 0, "fresnel": 0}, hoverinfo="skip",
        name="terrain", meta=trace_meta(cloud=cloud_label, ground="shown") | {"ground": True},
    )  # fmt: skip


def _camera_layout(view: str) -> dict[str, dict[str, float]]:
    """Return plotly's layout of the camera for a named view."""
    return {
        "eye": CAMERA_POSITION_BY_VIEW[view],
        "up": {"x": 0.0, "y": 0.0, "z": 1.0},
        "center": CAMERA_TARGET,
    }


def _hidden_axis_layout(view: str) -> dict[str, bool]:
    """Return the change of plotly's layout that hides the axis along which a view looks.

    The labels of that axis would overlap. A view at an angle hides no axis: the change is empty.
    """
    low, _, high = sorted(WORLD_AXES, key=lambda axis: abs(CAMERA_POSITION_BY_VIEW[view][axis]))
    return {f"scene.{high}axis.visible": False} if CAMERA_POSITION_BY_VIEW[view][low] == 0 else {}


def _largest_fitting_side(side_ratios: np.ndarray) -> float:
    """Return the largest size at which the box around the points fits into every view.

    The size is the length of the box's longest side, in plotly's units. `side_ratios` (3,) are the
    sides relative to the longest one.
    """
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * side_ratios
    eye_positions = [
        np.array([view[axis] for axis in WORLD_AXES]) for view in CAMERA_POSITION_BY_VIEW.values()
    ]
    side_lengths = np.linspace(2.0, 0.1, 191).tolist()
    fitting_lengths = (
        side_length
        for side_length in side_lengths
        if all(_is_in_view(side_length * corners, eye) for eye in eye_positions)
    )
    return next(fitting_lengths, side_lengths[0])


def _is_in_view(corners: np.ndarray, eye: np.ndarray) -> bool:
    """Return True if all points (n, 3) are in the field of view of a camera at `eye` (3,)."""
    view_direction = np.array([CAMERA_TARGET[axis] for axis in WORLD_AXES]) - eye
    view_direction /= np.linalg.norm(view_direction)
    right_direction = np.cross(view_direction, [0.0, 0.0, 1.0])
    right_direction /= np.linalg.norm(right_direction)
    from_eye = corners - eye
    depth = from_eye @ view_direction
    offset = np.maximum(
        np.abs(from_eye @ right_direction) / VIEW_ASPECT_MIN,
        np.abs(from_eye @ np.cross(right_direction, view_direction)),
    )
    return bool((offset <= VIEW_FILL_FRACTION * math.tan(CAMERA_FIELD_OF_VIEW / 2) * depth).all())


def _framing_layout(clouds: Sequence[PointCloud], *, with_path: bool = False) -> dict[str, Any]:
    """Return the changes of plotly's layout by which the true points of all clouds fill the view.

    With ``with_path`` the flight paths are in the view too. All axes have the same scale.
    """
    axis_ranges: dict[str, Any] = {}
    lengths = {}
    for axis in WORLD_AXES:
        true_values = [
            c.points[axis][c.true_point_mask if c.true_point_mask.any() else slice(None)]
            for c in clouds
        ]
        values = np.concatenate(
            [*true_values, *(cloud.flight_path[axis] for cloud in clouds if with_path)]
        )
        margin = 0.06 * np.ptp(values) + 2.0
        axis_ranges[f"scene.{axis}axis.range"] = [values.min() - margin, values.max() + margin]
        lengths[axis] = np.ptp(values) + 2 * margin
    side_ratios = np.array([lengths[axis] for axis in WORLD_AXES]) / max(lengths.values())
    aspect_ratio = _largest_fitting_side(side_ratios) * side_ratios
    return axis_ranges | {
        "scene.aspectratio": dict(zip(WORLD_AXES, aspect_ratio.tolist(), strict=True))
    }


def _cloud_view_layout() -> dict[str, Any]:
    """Return plotly's layout of the three-dimensional view."""
    axis_style = {"showbackground": False, "showspikes": False, "nticks": 5}
    return plot_layout(
        scene={
            "aspectmode": "manual",
            **{
                f"{axis}axis": {"title": {"text": f"{axis} (m)"}} | axis_style
                for axis in WORLD_AXES
            },
        },
        legend={"orientation": "h", "x": 0, "y": 0, "yanchor": "top", "itemsizing": "constant"},
        margin={"l": 0, "r": 0, "t": 88, "b": 40},
    )


SHOT_CHART_QUANTITIES = ("pd_shot", "snr_up", "beam_range", "beam_radial_velocity", "pfa_up")
"""Names of the quantities of shots that a report draws over time."""

ERROR_CHART_QUANTITIES = ("range", "radial_velocity")
"""Names of the quantities of a point whose errors a report draws over time."""

PAGE_SHOTS_MAX = 12_000
"""Largest number of shots of all charts over time on a page."""

N_NAVIGATION_ALTITUDE_BINS = 20
"""Number of altitude bins in the charts of navigation errors."""


def shots_over_time_chart(labelled_recordings: Sequence[LabelledRecording]) -> Chart | None:
    """Return the chart of the `SHOT_CHART_QUANTITIES` over time; None if no shot is computed."""
    quantities = [
        name for name in SHOT_CHART_QUANTITIES if name in labelled_recordings[0].recording.dataset
    ]

    def quantity_lines(column_arrays: dict[str, np.ndarray]) -> Iterator[QuantityLines]:
        for name in quantities:
            y_axis = ChartAxis(
                quantity_label(name), limits=PROBABILITY_AXIS_LIMITS if name == "pd_shot" else None
            )
            yield quantity_label(name), y_axis, _lines_by_beam(column_arrays, name)

    panels, reduction_remark = _panels_over_time(
        labelled_recordings, "shot", [*quantities, "beam"], quantity_lines
    )
    extent_texts = [
        f"{panel.y_axis.label}: "
        f"{labels.describe_value_extent(np.concatenate([line.y for line in panel.lines]))}"
        for panel in panels[: len(quantities)]
    ]
    alt = f"Marks of a quantity of each shot over time. {'; '.join(extent_texts)}."
    return _chart_over_time("Shots over time", alt, [reduction_remark], panels)


def measurement_error_chart(labelled_recordings: Sequence[LabelledRecording]) -> Chart | None:
    """Return the chart of errors of range and velocity over time; None if no point is true."""

    def quantity_lines(column_arrays: dict[str, np.ndarray]) -> Iterator[QuantityLines]:
        is_true = (column_arrays["flags"].astype(int) & TRUE_RETURN_FLAG) > 0
        for name in ERROR_CHART_QUANTITIES if is_true.any() else ():
            error_column = {"error": column_arrays[name] - column_arrays[f"true_{name}"]}
            true_columns = {
                key: values[is_true] for key, values in (column_arrays | error_column).items()
            }
            error_label = quantity_label(name).replace(" (", " error (")
            rms_text = labels.format_number(
                float(f"{np.sqrt(np.mean(true_columns['error'] ** 2)):.3g}")
            )
            yield (
                f"{error_label}, rms {rms_text}",
                ChartAxis(error_label),
                _lines_by_beam(true_columns, "error"),
            )

    names = [
        "time",
        "beam",
        "flags",
        *ERROR_CHART_QUANTITIES,
        *(f"true_{name}" for name in ERROR_CHART_QUANTITIES),
    ]
    panels, reduction_remark = _panels_over_time(
        labelled_recordings, "point", names, quantity_lines
    )
    error_texts = "; ".join(
        panel.facet_choices["quantity"] for panel in panels[: len(ERROR_CHART_QUANTITIES)]
    )
    alt = f"Marks of the error of each true point over time. {error_texts}."
    method_remark = "Measured less true, of true points, interpolated between bins"
    return _chart_over_time("Errors against truth", alt, [method_remark, reduction_remark], panels)


QuantityLines = tuple[str, ChartAxis, list[ChartLine]]
"""Label of a quantity of shots or points, its vertical axis, and its lines over time."""


def _panels_over_time(
    labelled_recordings: Sequence[LabelledRecording], noun: str, names: Sequence[str],
    quantity_lines: Callable[[dict[str, np.ndarray]], Iterator[QuantityLines]],
) -> tuple[list[Panel], str]:  # fmt: skip
    """Return panels of quantities over time, and a caption phrase on thinning; '' if not thinned.

    Parameters
    ----------
    labelled_recordings
        Recordings, each of which has its own panels.
    noun
        Name of what is drawn: ``shot`` or ``point``.
    names
        Names of the quantities that are read.
    quantity_lines
        Function that yields the label, axis and lines of each drawn quantity, from the columns that
        were read.
    """
    panels: list[Panel] = []
    thinning_step = 1
    for labelled_recording in labelled_recordings:
        thinned_rows = labelled_recording.recording.read_thinned_rows(
            names, PAGE_SHOTS_MAX // len(labelled_recordings), ranges=INTERPOLATED_RANGES
        )
        thinning_step = max(thinning_step, thinned_rows.step)
        column_arrays = thinned_rows.to_columns()
        for quantity_text, y_axis, lines in (
            quantity_lines(column_arrays) if column_arrays and column_arrays["time"].size else ()
        ):
            facet_choices = {"cloud": labelled_recording.label, "quantity": quantity_text}
            panels.append(Panel(facet_choices, ChartAxis("time (s)"), y_axis, lines))
    return panels, f"One {noun} in {thinning_step} shown: reduced for this page" * (
        thinning_step > 1
    )


def _chart_over_time(
    heading: str, alt: str, caption: list[str], panels: list[Panel]
) -> Chart | None:
    """Return a chart with panels of quantities over time; None without panels."""
    facets = {"cloud": "Shown for", "quantity": "Quantity"}
    return Chart(heading, alt, caption, panels, facets) if panels else None


def _lines_by_beam(column_arrays: dict[str, np.ndarray], name: str) -> list[ChartLine]:
    """Return a line of dots for each beam: the named quantity over time.

    If there are more beams than colours, all beams share one line.
    """
    values = to_displayed_values(name, column_arrays[name])
    beams = np.unique(column_arrays["beam"])
    if beams.size > len(canvas.LINE_COLOURS):
        return [ChartLine(column_arrays["time"], values, "all beams", style="dots")]
    return [
        ChartLine(
            column_arrays["time"][is_of_beam],
            values[is_of_beam],
            f"beam {int(beam)}",
            number,
            style="dots",
        )
        for number, beam in enumerate(beams)
        for is_of_beam in [column_arrays["beam"] == beam]
    ]


def point_count_table(labelled_recordings: Sequence[LabelledRecording]) -> HtmlTable:
    """Return a table of the numbers of shots, and of points by kind, for each recording.

    Shots and points are counted over all draws.
    """
    rows = []
    for labelled_recording in labelled_recordings:
        kind_counts, n_shots = np.zeros(len(POINT_KIND_BITS), int), 0
        for shot_slice in labelled_recording.recording.iter_shot_slices():
            flags = np.asarray(
                labelled_recording.recording.dataset["flags"].isel(shot=shot_slice).values
            )
            n_shots += flags.shape[0] * flags.shape[1]
            kind_counts += np.bincount(
                point_kind_indices(flags).ravel() + 1, minlength=len(POINT_KIND_BITS) + 1
            )[1:]
        count_by_kind = dict(
            zip(map(labels.coordinate_label, POINT_KIND_BITS), kind_counts.tolist(), strict=True)
        )
        rows.append({"what": labelled_recording.label or "all", "shots": n_shots} | count_by_kind)
    caption = ["Shots times draws, and points by kind."]
    return HtmlTable("Shots and points", caption, pandas.DataFrame(rows), "returns")


def point_count_sentences(
    returns_frame: pandas.DataFrame, groups: Sequence[xr.Dataset], n_omitted: int = 0
) -> list[str]:
    """Return sentences on the numbers of points and of velocities that navigation computed.

    Parameters
    ----------
    returns_frame
        Data frame of the table that :func:`point_count_table` returns.
    groups
        Datasets of the scanners.
    n_omitted
        Number of recordings that the page leaves out.
    """
    n_shots, n_true = (int(returns_frame[name].sum()) for name in ("shots", "true"))
    n_false = int(returns_frame.iloc[:, 2:].sum(axis=None)) - n_true
    n_parts = len(returns_frame)
    parts_text = (
        f"In the {n_parts} of {n_parts + n_omitted} parts of the study shown here, "
        if n_omitted
        else ""
    )
    messages = [
        f"{parts_text}{n_shots:,} shots brought back {n_true:,} true points and {n_false:,} false "
        "ones; "
        "a shot counts once a draw."
    ]
    status = [group["velocity_status"] for group in groups if "velocity_status" in group]
    if n_known := sum(int((status_array >= 0).sum()) for status_array in status):
        n_solved = sum(
            int(((status_array >= 0) & (status_array <= STATUS_EXCLUDED)).sum())
            for status_array in status
        )
        messages.append(f"Velocity was solved in {n_solved:,} of {n_known:,} cycles.")
    return messages


def flight_navigation_error_chart(
    spec: SceneSpec, labelled_recordings: Sequence[LabelledRecording]
) -> Chart | None:
    """Return the chart of the errors of navigated velocity and altitude over altitude.

    The result is None if no scanner navigates.
    """
    named_recordings = [
        (labelled_recording.label, labelled_recording.recording)
        for labelled_recording in labelled_recordings
    ]
    error_curves = [
        curve
        for quantity in ("velocity", "altitude")
        for curve in navigation_error_curves(
            named_recordings, quantity=quantity, n_bins=N_NAVIGATION_ALTITUDE_BINS
        )
    ]
    if not error_curves:
        return None
    chart = navigation_error_chart(error_curves, "all")
    return replace(chart, caption=[*chart.caption, *_error_floor_remarks(spec)])


def _error_floor_remarks(spec: SceneSpec) -> list[str]:
    """Return caption phrases on the spec's error floor, and on errors that it leaves out."""
    floor_mapping = spec.to_yaml_mapping()["error_floor"]
    floor_texts = [
        f"{labels.coordinate_label(name)} {floor_mapping[name]}"
        for name, value in spec.error_floor
        if value > 0
    ]
    floor_remark = [f"errors that no echo lowers: {', '.join(floor_texts)}"] if floor_texts else []
    return floor_remark + spec.unstated_error_sentences()


def flight_noise_budget_chart(
    results: SceneResults, labelled_recordings: Sequence[LabelledRecording]
) -> Chart | None:
    """Return the chart of the shares of noise sources along a flight.

    The result is None if the eyepoints are missing, or if no shot hits a target.
    """
    try:
        panels = [
            panel
            for labelled_recording in labelled_recordings
            if (panel := _flight_noise_panel(results, labelled_recording)).lines
        ]
    except NotAStoreError:
        return None
    if not panels:
        return None
    return noise_budget_chart(
        panels,
        ["Shares of the variance at the ADC in shots spread over the flight, simulated for "
         "this page with the effects that the study simulates; the standard deviation is shown "
         "on hovering"],
    )  # fmt: skip


def _flight_noise_panel(results: SceneResults, labelled_recording: LabelledRecording) -> Panel:
    """Return the panel with the shares of noise sources in shots spread over a flight.

    Shots without a target are left out.
    """
    recording = labelled_recording.recording
    n_shots = recording.n_shots
    shot_indices = np.unique(
        np.linspace(0, n_shots - 1, min(NOISE_BUDGET_POINTS_MAX, n_shots)).round().astype(int)
    )
    eyepoints = read_eyepoints(results.store_path, recording.dataset, shot_indices)
    seen_indices = np.flatnonzero(eyepoints.has_target)
    flags = np.asarray(recording.dataset["effects"].isel(shot=shot_indices[seen_indices]).values)
    parameters, surfaces = (
        parameters_at(results.spec, labelled_recording.axis_position.axis_indices),
        results.spec.surface_materials(),
    )
    budgets = [
        prepare_eyepoint_shots(
            eyepoints.select(np.array([i])), parameters, surfaces, effect_names_in_flags(int(flag))
        ).noise.variances
        for i, flag in zip(seen_indices, flags, strict=True)
    ]
    facet_choices = {"part": labelled_recording.label}
    return noise_budget_panel(
        facet_choices, ChartAxis("time (s)"), eyepoints.time[seen_indices], budgets
    )
