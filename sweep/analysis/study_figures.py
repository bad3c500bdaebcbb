"""Figures and tables that the spec of a study defines, for grids and scenes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis import accuracy_results, canvas, charts, labels, tables
from sweep.analysis.datasets import open as open_store
from sweep.analysis.datasets import open_scene_tree, read_attributes_of_kind
from sweep.analysis.scene_results import cloud_figures
from sweep.analysis.scene_results.cloud_figures import HeightMap
from sweep.analysis.scene_results.navigation_errors import (
    navigation_error_chart,
    navigation_error_curves,
    navigation_error_page,
)
from sweep.analysis.scene_results.recordings import (
    QUANTITY_BY_NAME,
    WORLD_AXES,
    AxisPosition,
    Recording,
    find_axis_position,
    find_multi_surface_shot,
    gather_point_cloud,
    read_eyepoints,
)
from sweep.analysis.selection import (
    GRAZING_ANGLE_PATH,
    RANGE_PATH,
    PointSelection,
    parameters_at,
    select_where,
)
from sweep.analysis.shot_spectra import draw_scene_shot_sheet, simulate_prepared_shot
from sweep.analysis.tables import TablePage
from sweep.model.effects.catalogue import effect_names_in_flags
from sweep.model.pointcloud.eyepoints import prepare_eyepoint_shots
from sweep.spec import (
    FalseAlarmTable,
    GridFigure,
    GridSpec,
    SceneSpec,
    SlicesFigure,
    SurfaceFigure,
    TableFigure,
    ThresholdTable,
)
from sweep.spec.figure_sections import (
    CloudFigure,
    NavigationFigure,
    NavigationTable,
    ScatterFigure,
    SceneFigure,
    ShotSpectraFigure,
)
from sweep.storage.locations import Location, derived_files_dir, parse_location
from sweep.storage.store_format import ACCURACY_STORE_KIND, SCENE_STORE_KIND

SURFACE_AXIS_VALUES_MIN = 8
"""Least number of values that an axis needs for a default surface figure over it."""

DEFAULT_FIGURE_VARIABLES = ("pd_shot", "pd_doppler")
"""Names of the variables that the default figures of a grid show."""


@dataclass(frozen=True)
class GridResults:
    """Opened store of a grid, with its spec."""

    dataset: xr.Dataset
    """Dataset of the store, as `sweep.open` returns it."""
    spec: GridSpec
    """Spec of the study."""

    @classmethod
    def from_store(cls, store_path: str | Location) -> GridResults:
        """Open the store of a grid; return its dataset and spec."""
        dataset = open_store(store_path)
        return cls(dataset, GridSpec.from_stored(dataset.attrs["spec"]))

    @property
    def points(self) -> PointSelection:
        """Selection of all points of the grid."""
        return PointSelection.from_dataset(self.dataset)

    @property
    def figure_specs(self) -> list[GridFigure]:
        """Specs of the figures: those in the study's spec, or a default set."""
        return list(self.spec.figures) or default_grid_figures(self.spec)

    def make_chart(
        self, figure_spec: SurfaceFigure | SlicesFigure, size_limits: charts.ChartSizeLimits
    ) -> charts.Chart | None:
        """Return the chart of a surface or slices figure; None if the figure selects no points."""
        points = select_where(self.points, self.spec, figure_spec.where)
        if not points.n_points:
            return None
        variable_attributes = self.dataset[figure_spec.variable].attrs
        label = labels.axis_label(
            variable_attributes.get("long_name", figure_spec.variable),
            variable_attributes.get("units", ""),
        )
        chart_options: dict[str, Any] = {
            "x": figure_spec.x,
            "variable": figure_spec.variable,
            "label": label,
        }
        if isinstance(figure_spec, SurfaceFigure):
            return charts.surface_chart(
                points,
                y=figure_spec.y,
                size_limits=size_limits,
                levels=figure_spec.levels,
                **chart_options,
            )
        return charts.slice_chart(
            points, by=figure_spec.by, levels=figure_spec.levels, **chart_options
        )

    def make_table_page(
        self, figure_spec: TableFigure | FalseAlarmTable | ThresholdTable
    ) -> tables.TablePage:
        """Return the page of a table that the spec of the study defines."""
        title = figure_spec.title or self.spec.title
        if isinstance(figure_spec, TableFigure):
            units = str(self.dataset[figure_spec.variable].attrs.get("units", ""))
            return tables.mean_table_page(self.points, self.spec, figure_spec, units, title)
        is_threshold_table = isinstance(figure_spec, ThresholdTable)
        page_function = tables.threshold_page if is_threshold_table else tables.false_alarm_page
        return page_function(
            self.points, self.spec, by=figure_spec.by, printed=figure_spec.printed, title=title
        )

    def render_figure(self, figure_spec: GridFigure) -> canvas.Sheet | tables.TablePage | str:
        """Return a figure as a sheet, or a table as a page; a message text if it would be empty."""
        if not isinstance(figure_spec, SurfaceFigure | SlicesFigure):
            return self.make_table_page(figure_spec)
        chart = self.make_chart(figure_spec, charts.SHEET_CHART_SIZE_LIMITS)
        if chart is None:
            return f"no point of the study has {describe_selection(figure_spec)}"
        title = "\n".join(filter(None, [self.spec.title, figure_spec.title]))
        note = labels.join_sentences(
            [describe_selection(figure_spec), labels.source_note(self.dataset.attrs, "points")]
        )
        return canvas.draw_chart(chart, title, note)


def describe_selection(figure_spec: SurfaceFigure | SlicesFigure) -> str:
    """Return a text with the single coordinate values that a figure selects; '' if none."""
    return ", ".join(
        f"{labels.coordinate_label(name)} {value}"
        for name, value in figure_spec.where.items()
        if not isinstance(value, tuple)
    )


@canvas.uniform_style()
def draw_figures(
    store_path: str | Location, directory: str | Path | None = None, picture_format: str = "png"
) -> list[Path]:
    """Draw every figure and table that the spec of a store defines, or a default set.

    Parameters
    ----------
    store_path
        Store, complete or not.
    directory
        Output directory. The default for ``NAME.zarr`` is ``NAME-figures``, next to the store, or
        in the current directory for an object store.
    picture_format
        ``png``, ``pdf`` or ``svg``. The same store gives the same bytes.

    Returns
    -------
    list of Path
        Written files: pictures of figures, TXT and CSV of tables.

    Raises
    ------
    NotAStoreError
        The path has no store of a grid, a scene or an accuracy measurement, or eyepoints that a
        figure needs are missing.
    """
    store = parse_location(store_path)
    attributes = read_attributes_of_kind(store)
    kind = attributes["kind"]
    if kind == ACCURACY_STORE_KIND:
        return accuracy_results.write_figure_and_tables(
            store, None if directory is None else Path(directory), picture_format
        )
    stem = store.name.removesuffix(".zarr")
    directory = (
        derived_files_dir(store) / f"{stem}-figures" if directory is None else Path(directory)
    )
    if kind == SCENE_STORE_KIND:
        results: Any = SceneResults.from_store(store)
    else:
        results = GridResults.from_store(store)
        if not results.figure_specs:
            return tables.single_point_page(results.dataset).save_files(directory, "outputs")
    paths = []
    for figure_spec in results.figure_specs:
        output = results.render_figure(figure_spec)
        if isinstance(output, tables.TablePage):
            paths += output.save_files(directory, figure_spec.file_stem)
        else:
            sheet = (
                canvas.message_sheet(f"{results.spec.title}: {output}")
                if isinstance(output, str)
                else output
            )
            source_text = picture_source_text(str(attributes["study_id"]), figure_spec)
            paths.append(
                canvas.save_sheet(
                    sheet,
                    directory / f"{figure_spec.file_stem}.{picture_format}",
                    source=source_text,
                )
            )
    return paths


def picture_source_text(study_id: str, figure_spec: GridFigure | SceneFigure) -> str:
    """Return the text in a picture's metadata that identifies the study and the figure.

    The study id depends on everything that determines the results, including the model version.
    """
    spec_json = json.dumps(figure_spec.model_dump(mode="json"), sort_keys=True)
    return f"study {study_id}, figure {hashlib.sha256(spec_json.encode()).hexdigest()[:16]}"


def default_grid_figures(spec: GridSpec) -> list[GridFigure]:
    """Return the specs of a grid's default figures.

    The figures are surfaces over two long axes. Without two long axes they are slices along a
    zipped axis or the longest axis. A study whose axes have no numbers gets slices over categories,
    and tables.
    """
    zipped_axes = [axis for axis in spec.axes if axis.is_zipped][:1]
    axes = zipped_axes or sorted(spec.axes, key=lambda axis: -axis.size)
    numeric_parameters = [
        (axis, axis_parameter.coordinate_name)
        for axis in axes
        for axis_parameter in axis.parameters
        if not labels.is_categorical(np.asarray(axis_parameter.display_values))
    ]
    long_axes = [axis for axis, _ in numeric_parameters if axis.size >= SURFACE_AXIS_VALUES_MIN]
    if not zipped_axes and len(long_axes) >= 2:
        # Prefer range and angle to other axes, with the angle as vertical axis.
        path_by_axis = {axis.name: axis.parameters[0].path for axis in long_axes}
        rank = {RANGE_PATH: 0, GRAZING_ANGLE_PATH: 1}
        axis_names = sorted(path_by_axis, key=lambda name: rank.get(path_by_axis[name], 2))[:2]
        x, y = sorted(axis_names, key=lambda name: path_by_axis[name] == GRAZING_ANGLE_PATH)
        return [
            SurfaceFigure(kind="surface", variable=v, x=x, y=y) for v in DEFAULT_FIGURE_VARIABLES
        ]
    if numeric_parameters:
        axis, x = numeric_parameters[0]
        other_axes = [a for a in spec.axes if a is not axis and not a.is_zipped]
        by_option = next(
            ({"by": a.name} for a in other_axes if a.size <= charts.LINES_PER_PANEL_MAX), {}
        )
        return [
            SlicesFigure(kind="slices", variable=v, x=x, **by_option)
            for v in DEFAULT_FIGURE_VARIABLES
        ]
    by_option = {"by": axes[1].parameters[0].coordinate_name} if len(axes) > 1 else {}
    columns_option = {"columns": by_option["by"]} if by_option else {}
    figure_specs: list[GridFigure] = [
        SlicesFigure(kind="slices", variable=v, x=a.parameters[0].coordinate_name, **by_option)
        for a in axes[:1]
        for v in DEFAULT_FIGURE_VARIABLES
    ]
    return figure_specs + [
        TableFigure(
            kind="table", variable=v, rows=a.parameters[0].coordinate_name, **columns_option
        )
        for a in axes[:1]
        for v in DEFAULT_FIGURE_VARIABLES
    ]


DEFAULT_CLOUD_COLOUR_QUANTITIES = ("range", "radial_velocity")
"""Names of the quantities by which the default figures colour a point cloud."""


def default_scene_figures(tree: xr.DataTree) -> list[SceneFigure]:
    """Return the specs of a flight's default figures.

    For each scanner there is a point cloud by range, with the flight path, and one by radial
    velocity. Figures of navigation errors follow if navigation was computed.
    """
    scanners = [str(name) for name in tree.attrs["scanners"]]
    figure_specs: list[SceneFigure] = [
        CloudFigure(kind="cloud", scanner=scanner, colour=colour, path=colour == "range")
        for scanner in scanners
        for colour in DEFAULT_CLOUD_COLOUR_QUANTITIES
    ]
    if any("velocity_status" in tree[scanner] for scanner in scanners):
        figure_specs += [
            NavigationFigure(kind="navigation", quantity=quantity)
            for quantity in ("velocity", "altitude")
        ]
    return figure_specs


@dataclass(frozen=True)
class SceneResults:
    """Opened store of a flight's point clouds, with its spec."""

    store_path: Location
    """Path of the store."""
    tree: xr.DataTree
    """Tree of the store, whose arrays are read as NumPy arrays when they are sliced."""
    spec: SceneSpec
    """Spec of the study."""

    @classmethod
    def from_store(cls, store_path: str | Location) -> SceneResults:
        """Open the store of a scene; return its tree and spec."""
        tree = open_scene_tree(parse_location(store_path))
        return cls(parse_location(store_path), tree, SceneSpec.from_stored(str(tree.attrs["spec"])))

    @property
    def scanners(self) -> list[str]:
        """Names of the scanners."""
        return [str(name) for name in self.tree.attrs["scanners"]]

    @property
    def surface_labels(self) -> list[str]:
        """Display names of the scene's surfaces, in the order of their numbers."""
        return [labels.coordinate_label(str(name)) for name in self.tree.attrs["surfaces"]]

    @property
    def source_note(self) -> str:
        """Sentence for captions that names the study, the model version and the progress."""
        return labels.source_note(self.tree.attrs, "blocks")

    @property
    def figure_specs(self) -> list[SceneFigure]:
        """Specs of the figures: those in the study's spec, or a default set."""
        return list(self.spec.figures) or default_scene_figures(self.tree)

    def render_figure(self, figure_spec: SceneFigure) -> canvas.Sheet | TablePage | str:
        """Return a figure as a sheet, or a table as a page; a message text if it would be empty."""
        draw_by_type: dict[
            type, Callable[[SceneResults, Any, AxisPosition], canvas.Sheet | TablePage | str]
        ] = {
            CloudFigure: _render_cloud_figure,
            ScatterFigure: _render_scatter_figure,
            ShotSpectraFigure: _render_shot_spectra_figure,
            NavigationFigure: _render_navigation_figure,
            NavigationTable: _render_navigation_figure,
        }
        return draw_by_type[type(figure_spec)](
            self, figure_spec, find_axis_position(self.spec, figure_spec.where)
        )

    def figure_title(self, figure_spec: SceneFigure, default_title: str) -> str:
        """Return the title of a figure, below the title of the study in a line of its own."""
        return "\n".join([self.spec.title, figure_spec.title or default_title])


SCATTER_POINTS_MAX = 200_000
"""Largest number of points in a scatter plot. If there are more, only some are shown."""

NO_POINT_MESSAGE = "there is no point within the figure's limits"
"""Message in place of a figure without points."""


def _recording_of_figure(
    results: SceneResults,
    figure_spec: CloudFigure | ScatterFigure | ShotSpectraFigure,
    axis_position: AxisPosition,
) -> Recording:
    """Return the recording of the scanner that a figure names, or of the first scanner."""
    return axis_position.open_recording(results.tree, figure_spec.scanner or results.scanners[0])


def _picture_remarks(
    results: SceneResults, recording: Recording, axis_position: AxisPosition, figure_spec: Any
) -> list[str]:
    """Return caption sentences with the picture's scanner, ranges, draw, axis values and source.

    The scanner and the draw are stated only if there are several.
    """
    choice_texts = []
    if len(results.scanners) > 1:
        choice_texts.append(f"scanner {labels.coordinate_label(recording.scanner)}")
    if ranges := getattr(figure_spec, "ranges", ""):
        choice_texts.append(f"ranges {'by whole bins' if ranges == 'quantised' else ranges}")
    if recording.dataset.sizes["draw"] > 1:
        choice_texts.append(f"draw {figure_spec.draw}")
    return [", ".join([*choice_texts, *filter(None, [axis_position.label])]), results.source_note]


def _render_cloud_figure(
    results: SceneResults, figure_spec: CloudFigure, axis_position: AxisPosition
) -> canvas.Sheet | str:
    """Return the sheet of a point cloud; a message text if there are no points."""
    recording = _recording_of_figure(results, figure_spec, axis_position)
    crop_by_name = {name: getattr(figure_spec, name) for name in (*WORLD_AXES, "time")}
    cloud = gather_point_cloud(
        recording,
        [figure_spec.colour],
        ranges=figure_spec.ranges,
        draw=figure_spec.draw,
        crops={name: crop for name, crop in crop_by_name.items() if crop is not None},
        with_dropouts=figure_spec.dropouts,
        with_path=figure_spec.path,
    )
    if cloud is None:
        return NO_POINT_MESSAGE
    view: str | tuple[float, float] = (
        figure_spec.view
        if isinstance(figure_spec.view, str)
        else (np.degrees(figure_spec.view["azimuth"]), np.degrees(figure_spec.view["elevation"]))
    )
    return cloud_figures.draw_cloud_sheet(
        cloud,
        quantity=figure_spec.colour,
        surfaces=results.surface_labels,
        view=view,
        height_map=HeightMap.from_tree(results.tree) if figure_spec.terrain else None,
        title=results.figure_title(
            figure_spec, f"Point cloud by {QUANTITY_BY_NAME[figure_spec.colour].long_name}"
        ),
        remarks=_picture_remarks(results, recording, axis_position, figure_spec),
    )


def _render_scatter_figure(
    results: SceneResults, figure_spec: ScatterFigure, axis_position: AxisPosition
) -> canvas.Sheet | str:
    """Return the sheet of a scatter plot; a message text if there are no points."""
    recording = _recording_of_figure(results, figure_spec, axis_position)
    thinned_rows = recording.read_thinned_rows(
        [figure_spec.x, figure_spec.y, figure_spec.colour],
        SCATTER_POINTS_MAX,
        draw=figure_spec.draw,
        ranges=figure_spec.ranges,
        time_limits=figure_spec.time,
    )
    if not thinned_rows.n_total:
        return NO_POINT_MESSAGE
    default_title = (
        f"{QUANTITY_BY_NAME[figure_spec.y].long_name} over "
        f"{QUANTITY_BY_NAME[figure_spec.x].long_name}"
    )
    return cloud_figures.draw_scatter_sheet(
        thinned_rows,
        x=figure_spec.x,
        y=figure_spec.y,
        colour=figure_spec.colour,
        surfaces=results.surface_labels,
        title=results.figure_title(figure_spec, default_title.capitalize()),
        remarks=_picture_remarks(results, recording, axis_position, figure_spec),
    )


def _render_shot_spectra_figure(
    results: SceneResults, figure_spec: ShotSpectraFigure, axis_position: AxisPosition
) -> canvas.Sheet | str:
    """Return the sheet of a shot's spectra; a message text if the shot or its target is missing."""
    recording = _recording_of_figure(results, figure_spec, axis_position)
    shot_choice = figure_spec.shot
    shot_number = (
        shot_choice
        if isinstance(shot_choice, int)
        else find_multi_surface_shot(recording, figure_spec.draw)
    )
    if shot_number is None:
        return "no shot tells several surfaces apart"
    if shot_number >= recording.n_shots:
        return f"there is no shot {shot_number}"
    eyepoints = read_eyepoints(results.store_path, recording.dataset, np.array([shot_number]))
    if not eyepoints.has_target.all():
        return f"shot {shot_number} sees nothing"
    parameters = parameters_at(results.spec, axis_position.axis_indices)
    effects = effect_names_in_flags(
        int(recording.read_array("effects", slice(shot_number, shot_number + 1))[0])
    )
    prepared = prepare_eyepoint_shots(
        eyepoints, parameters, results.spec.surface_materials(), effects
    )
    shot_remark = (
        f"shot {shot_number:,} of {recording.n_shots:,} at {eyepoints.time[0]:.6g} s, "
        f"beam {eyepoints.beam[0]}, noise drawn for the picture"
    )
    return draw_scene_shot_sheet(
        simulate_prepared_shot(prepared, parameters, seed=results.spec.seed),
        eyepoints,
        results.surface_labels,
        title=results.figure_title(figure_spec, "Spectra of one shot"),
        remarks=[shot_remark, *_picture_remarks(results, recording, axis_position, figure_spec)],
    )


def _render_navigation_figure(
    results: SceneResults,
    figure_spec: NavigationFigure | NavigationTable,
    axis_position: AxisPosition,
) -> canvas.Sheet | TablePage | str:
    """Return navigation errors as the sheet of a chart, or as the page of a table.

    If no scanner navigated, return a message text.
    """
    scanners = figure_spec.scanners or results.scanners
    named_recordings = [
        (scanner, axis_position.open_recording(results.tree, scanner)) for scanner in scanners
    ]
    error_curves = navigation_error_curves(
        named_recordings, quantity=figure_spec.quantity, n_bins=figure_spec.bins
    )
    note = labels.join_sentences([axis_position.label, results.source_note])
    if isinstance(figure_spec, NavigationTable):
        title = figure_spec.title or results.spec.title
        return navigation_error_page(
            error_curves, show=figure_spec.show, title=title, remarks=[note]
        )
    if not error_curves:
        return "no measurement cycle of three shots or more"
    title = results.figure_title(figure_spec, f"Navigation: {figure_spec.quantity}")
    return canvas.draw_chart(navigation_error_chart(error_curves, figure_spec.show), title, note)
