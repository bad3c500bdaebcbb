"""All figures and tables of a study, of a grid or of a scene, as its spec asks for them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis import accuracy, canvas, charts, labels, tables
from sweep.analysis.opening import ACCURACY, SCENE, opened, read_attributes
from sweep.analysis.opening import open as open_store
from sweep.analysis.scenes import pictures
from sweep.analysis.scenes.navigation import curves, navigation_chart, navigation_page
from sweep.analysis.scenes.pictures import Ground
from sweep.analysis.scenes.recording import (
    AXES,
    QUANTITIES,
    Place,
    Recording,
    gathered,
    place,
    read_eyepoints,
    several_surfaces,
)
from sweep.analysis.selection import (
    GRAZING_ANGLE,
    RANGE,
    Points,
    confined,
    parameters_at,
)
from sweep.analysis.shot_figure import scene_shot_sheet, simulated_shot
from sweep.analysis.tables import Page
from sweep.model.effects.catalogue import names_of
from sweep.model.eyepoints import prepare_eyepoints
from sweep.spec import (
    FalseAlarmTable,
    Figure,
    SceneSpec,
    Slices,
    Spec,
    Surface,
    Table,
    ThresholdTable,
)
from sweep.spec.figures import (
    CloudFigure,
    NavigationFigure,
    NavigationTable,
    Scatter,
    SceneFigure,
    ShotSpectra,
)
from sweep.storage.locations import Location, beside, located

LONG = 8
"""Values from which on an axis is worth a side of a surface."""

VARIABLES = ("pd_shot", "pd_doppler")


@dataclass(frozen=True)
class Study:
    """A store opened, with the spec that it holds."""

    dataset: xr.Dataset
    spec: Spec

    @classmethod
    def of(cls, store_path: str | Location) -> Study:
        """Return the study in a store."""
        dataset = open_store(store_path)
        return cls(dataset, Spec.from_stored(dataset.attrs["spec"]))

    @property
    def points(self) -> Points:
        """All points."""
        return Points.of(self.dataset)

    @property
    def figures(self) -> list[Figure]:
        """The figures that it asks for; a usual set where it asks for none."""
        return list(self.spec.figures) or default_figures(self.spec)

    def chart(self, figure: Surface | Slices, room: charts.Room) -> charts.Chart | None:
        """Return the chart of a figure, or None if no point is within its limits."""
        found = confined(self.points, self.spec, figure.where)
        if not found.size:
            return None
        about = self.dataset[figure.variable].attrs
        words = labels.with_units(about.get("long_name", figure.variable), about.get("units", ""))
        options: dict[str, Any] = {"x": figure.x, "variable": figure.variable, "words": words}
        if isinstance(figure, Surface):
            return charts.surface(found, y=figure.y, room=room, levels=figure.levels, **options)
        return charts.slices(found, by=figure.by, levels=figure.levels, **options)

    def page(self, figure: Table | FalseAlarmTable | ThresholdTable) -> tables.Page:
        """Tables of one that it asks for."""
        title = figure.title or self.spec.title
        if isinstance(figure, Table):
            units = str(self.dataset[figure.variable].attrs.get("units", ""))
            return tables.mean_page(self.points, self.spec, figure, units, title)
        threshold = isinstance(figure, ThresholdTable)
        make = tables.threshold_page if threshold else tables.false_alarm_page
        return make(self.points, self.spec, by=figure.by, printed=figure.printed, title=title)

    def made(self, figure: Figure) -> canvas.Sheet | tables.Page | str:
        """Return the sheet or the page of a figure; why there is none."""
        if not isinstance(figure, Surface | Slices):
            return self.page(figure)
        chart = self.chart(figure, charts.SHEET)
        if chart is None:
            return f"no point of the study has {held(figure)}"
        title = "\n".join(filter(None, [self.spec.title, figure.title]))
        note = labels.joined([held(figure), labels.source(self.dataset.attrs, "points")])
        return canvas.sheet_of(chart, title, note)


def held(figure: Surface | Slices) -> str:
    """Words for what a figure is confined to."""
    return ", ".join(
        f"{labels.coordinate(name)} {value}"
        for name, value in figure.where.items()
        if not isinstance(value, tuple)
    )


@canvas.style()
def draw(
    store_path: str | Location, directory: str | Path | None = None, form: str = "png"
) -> list[Path]:
    """Every figure and table that the spec in a store asks for; a usual set where it asks for none.

    Parameters
    ----------
    store_path
        The store, complete or not.
    directory
        Where to; by default ``NAME-figures`` for ``NAME.zarr``, in the folder of the store, or
        in this one for an object store.
    form
        ``png``, ``pdf`` or ``svg``. The same store gives the same bytes.

    Returns
    -------
    list of Path
        The files written: pictures of figures, TXT and CSV of tables.

    Raises
    ------
    NotAStoreError
        Where there is no store of a grid of points, of a scene or of what accuracy costs; or the
        eyepoints that a figure needs are gone.
    """
    store = located(store_path)
    attributes = read_attributes(store)
    kind = attributes["kind"]
    if kind == ACCURACY:
        return accuracy.draw(store, None if directory is None else Path(directory), form)
    stem = store.name.removesuffix(".zarr")
    directory = beside(store) / f"{stem}-figures" if directory is None else Path(directory)
    if kind == SCENE:
        study: Any = SceneStudy.of(store)
    else:
        study = Study.of(store)
        if not study.figures:
            return tables.outputs_page(study.dataset).save(directory, "outputs")
    files = []
    for figure in study.figures:
        made = study.made(figure)
        if isinstance(made, tables.Page):
            files += made.save(directory, figure.stem)
        else:
            sheet = canvas.empty(f"{study.spec.title}: {made}") if isinstance(made, str) else made
            about = source(str(attributes["study_id"]), figure)
            files.append(canvas.save(sheet, directory / f"{figure.stem}.{form}", source=about))
    return files


def source(study_id: str, figure: Figure | SceneFigure) -> str:
    """Words that tell whether a picture is of a study and a figure as these are now.

    The id of a study counts all that its results depend on, the model's version included.
    """
    fields = json.dumps(figure.model_dump(mode="json"), sort_keys=True)
    return f"study {study_id}, figure {hashlib.sha256(fields.encode()).hexdigest()[:16]}"


def default_figures(spec: Spec) -> list[Figure]:
    """Surfaces where two axes are long; slices along a zipped or the longest axis.

    Axes of words alone make slices, by category, and tables.
    """
    zipped = [axis for axis in spec.axes if axis.zipped][:1]
    axes = zipped or sorted(spec.axes, key=lambda axis: -axis.size)
    numeric = [
        (axis, member.name)
        for axis in axes
        for member in axis.members
        if not labels.is_words(np.asarray(member.display))
    ]
    long = [axis for axis, _ in numeric if axis.size >= LONG]
    if not zipped and len(long) >= 2:
        # range and angle before others, and the angle up
        paths = {axis.name: axis.members[0].path for axis in long}
        rank = {RANGE: 0, GRAZING_ANGLE: 1}
        two = sorted(paths, key=lambda name: rank.get(paths[name], 2))[:2]
        x, y = sorted(two, key=lambda name: paths[name] == GRAZING_ANGLE)
        return [Surface(kind="surface", variable=v, x=x, y=y) for v in VARIABLES]
    if numeric:
        axis, x = numeric[0]
        others = [a for a in spec.axes if a is not axis and not a.zipped]
        by = next(({"by": a.name} for a in others if a.size <= charts.MOST_LINES), {})
        return [Slices(kind="slices", variable=v, x=x, **by) for v in VARIABLES]
    by = {"by": axes[1].members[0].name} if len(axes) > 1 else {}
    columns = {"columns": by["by"]} if by else {}
    drawn: list[Figure] = [Slices(kind="slices", variable=v, x=a.members[0].name, **by)
                           for a in axes[:1] for v in VARIABLES]  # fmt: skip
    return drawn + [Table(kind="table", variable=v, rows=a.members[0].name, **columns)
                    for a in axes[:1] for v in VARIABLES]  # fmt: skip


COLOURS = ("range", "radial_velocity")


def default_scene_figures(tree: xr.DataTree) -> list[SceneFigure]:
    """Each scanner's cloud by range, with the flight path, and by velocity; navigation."""
    scanners = [str(name) for name in tree.attrs["scanners"]]
    figures: list[SceneFigure] = [
        CloudFigure(kind="cloud", scanner=scanner, colour=colour, path=colour == "range")
        for scanner in scanners
        for colour in COLOURS
    ]
    if any("velocity_status" in tree[scanner] for scanner in scanners):
        figures += [
            NavigationFigure(kind="navigation", quantity=quantity)
            for quantity in ("velocity", "altitude")
        ]
    return figures


@dataclass(frozen=True)
class SceneStudy:
    """A store of point clouds opened, with the spec that it holds."""

    path: Location
    tree: xr.DataTree
    spec: SceneSpec

    @classmethod
    def of(cls, store_path: str | Location) -> SceneStudy:
        """Return the study in a store."""
        tree = opened(located(store_path))
        return cls(located(store_path), tree, SceneSpec.from_stored(str(tree.attrs["spec"])))

    @property
    def scanners(self) -> list[str]:
        """Names of the scanners."""
        return [str(name) for name in self.tree.attrs["scanners"]]

    @property
    def surfaces(self) -> list[str]:
        """Names of surfaces by number."""
        return [labels.coordinate(str(name)) for name in self.tree.attrs["surfaces"]]

    @property
    def note(self) -> str:
        """Words at a picture's foot."""
        return labels.source(self.tree.attrs, "blocks")

    @property
    def figures(self) -> list[SceneFigure]:
        """The figures that it asks for; a usual set where it asks for none."""
        return list(self.spec.figures) or default_scene_figures(self.tree)

    def made(self, figure: SceneFigure) -> canvas.Sheet | Page | str:
        """Return the sheet or the page of a figure; why there is none."""
        makers: dict[type, Callable[[SceneStudy, Any, Place], canvas.Sheet | Page | str]] = {
            CloudFigure: _cloud,
            Scatter: _scatter,
            ShotSpectra: _shot,
            NavigationFigure: _navigation,
            NavigationTable: _navigation,
        }
        return makers[type(figure)](self, figure, place(self.spec, figure.where))

    def titled(self, figure: SceneFigure, otherwise: str) -> str:
        """Title of a figure."""
        return "\n".join([self.spec.title, figure.title or otherwise])


MOST_SCATTERED = 200_000
"""Points that a scatter still shows apart; more is thinned."""

NO_POINT = "there is no point within the figure's limits"


def _recording(
    study: SceneStudy, figure: CloudFigure | Scatter | ShotSpectra, at: Place
) -> Recording:
    return at.recording(study.tree, figure.scanner or study.scanners[0])


def _remarks(study: SceneStudy, recording: Recording, at: Place, figure: Any) -> list[str]:
    """Scanner, ranges, draw and place of what is shown, as far as there is a choice."""
    said = []
    if len(study.scanners) > 1:
        said.append(f"scanner {labels.coordinate(recording.scanner)}")
    if ranges := getattr(figure, "ranges", ""):
        said.append(f"ranges {'by whole bins' if ranges == 'quantised' else ranges}")
    if recording.dataset.sizes["draw"] > 1:
        said.append(f"draw {figure.draw}")
    return [", ".join([*said, *filter(None, [at.words])]), study.note]


def _cloud(study: SceneStudy, figure: CloudFigure, at: Place) -> canvas.Sheet | str:
    recording = _recording(study, figure, at)
    asked = {name: getattr(figure, name) for name in (*AXES, "time")}
    found = gathered(
        recording,
        [figure.colour],
        ranges=figure.ranges,
        draw=figure.draw,
        crops={name: crop for name, crop in asked.items() if crop is not None},
        dropouts=figure.dropouts,
        path=figure.path,
    )
    if found is None:
        return NO_POINT
    view: str | tuple[float, float] = (
        figure.view
        if isinstance(figure.view, str)
        else (np.degrees(figure.view["azimuth"]), np.degrees(figure.view["elevation"]))
    )
    return pictures.cloud_sheet(
        found,
        quantity=figure.colour,
        surfaces=study.surfaces,
        view=view,
        ground=Ground.of(study.tree) if figure.terrain else None,
        title=study.titled(figure, f"Point cloud by {QUANTITIES[figure.colour].words}"),
        remarks=_remarks(study, recording, at, figure),
    )


def _scatter(study: SceneStudy, figure: Scatter, at: Place) -> canvas.Sheet | str:
    recording = _recording(study, figure, at)
    found = recording.rows(
        [figure.x, figure.y, figure.colour], MOST_SCATTERED, draw=figure.draw,
        ranges=figure.ranges, time=figure.time,
    )  # fmt: skip
    if not found.total:
        return NO_POINT
    words = f"{QUANTITIES[figure.y].words} over {QUANTITIES[figure.x].words}"
    return pictures.scatter_sheet(
        found,
        x=figure.x,
        y=figure.y,
        colour=figure.colour,
        surfaces=study.surfaces,
        title=study.titled(figure, words.capitalize()),
        remarks=_remarks(study, recording, at, figure),
    )


def _shot(study: SceneStudy, figure: ShotSpectra, at: Place) -> canvas.Sheet | str:
    recording = _recording(study, figure, at)
    asked = figure.shot
    number = asked if isinstance(asked, int) else several_surfaces(recording, figure.draw)
    if number is None:
        return "no shot tells several surfaces apart"
    if number >= recording.shots:
        return f"there is no shot {number}"
    eyepoints = read_eyepoints(study.path, recording.dataset, np.array([number]))
    if not eyepoints.seen.all():
        return f"shot {number} sees nothing"
    parameters = parameters_at(study.spec, at.index)
    effects = names_of(int(recording.read("effects", slice(number, number + 1))[0]))
    prepared = prepare_eyepoints(eyepoints, parameters, study.spec.surfaces(), effects)
    told = (
        f"shot {number:,} of {recording.shots:,} at {eyepoints.time[0]:.6g} s, "
        f"beam {eyepoints.beam[0]}, noise drawn for the picture"
    )
    return scene_shot_sheet(
        simulated_shot(prepared, parameters, seed=study.spec.seed),
        eyepoints,
        study.surfaces,
        title=study.titled(figure, "Spectra of one shot"),
        remarks=[told, *_remarks(study, recording, at, figure)],
    )


def _navigation(
    study: SceneStudy, figure: NavigationFigure | NavigationTable, at: Place
) -> canvas.Sheet | Page | str:
    scanners = figure.scanners or study.scanners
    named = [(scanner, at.recording(study.tree, scanner)) for scanner in scanners]
    found = curves(named, quantity=figure.quantity, bins=figure.bins)
    note = labels.joined([at.words, study.note])
    if isinstance(figure, NavigationTable):
        title = figure.title or study.spec.title
        return navigation_page(found, show=figure.show, title=title, remarks=[note])
    if not found:
        return "no measurement cycle of three shots or more"
    title = study.titled(figure, f"Navigation: {figure.quantity}")
    return canvas.sheet_of(navigation_chart(found, figure.show), title, note)
