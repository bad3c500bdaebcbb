"""All figures and tables of a scene's study, as its spec asks for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis import canvas, labels
from sweep.analysis.opening import opened
from sweep.analysis.scenes import pictures
from sweep.analysis.scenes.clouds import AXES, Ground, gathered
from sweep.analysis.scenes.navigation import Curve, curves, navigation_chart, navigation_page
from sweep.analysis.scenes.recording import (
    QUANTITIES,
    Interval,
    Place,
    Recording,
    eyepoints_of,
    place,
    read_eyepoints,
    several_surfaces,
)
from sweep.analysis.selection import parameters_at
from sweep.analysis.shot_figure import scene_shot_sheet, simulated_shot
from sweep.analysis.tables import Page
from sweep.model.effects.catalogue import names_of
from sweep.model.eyepoints import prepare_eyepoints
from sweep.spec import SceneSpec
from sweep.spec.figures import (
    CloudFigure,
    NavigationFigure,
    NavigationTable,
    Scatter,
    SceneFigure,
    ShotSpectra,
)
from sweep.storage.locations import Location, located

COLOURS = ("range", "radial_velocity")


def default_figures(tree: xr.DataTree) -> list[SceneFigure]:
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
        return list(self.spec.figures) or default_figures(self.tree)

    def made(self, figure: SceneFigure) -> canvas.Sheet | Page | str:
        """Return the sheet or the page of a figure; why there is none."""
        makers: dict[type, Callable[[SceneStudy, Any, Place], canvas.Sheet | Page | str]] = {
            CloudFigure: _cloud,
            Scatter: _scatter,
            ShotSpectra: _shot,
            NavigationFigure: _navigation,
            NavigationTable: _navigation_table,
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


def _interval(limits: tuple[float, ...] | None) -> Interval | None:
    return Interval(*limits) if limits is not None else None


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
    asked = {name: _interval(getattr(figure, name)) for name in (*AXES, "time")}
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
        ranges=figure.ranges, time=_interval(figure.time),
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
    eyepoints = read_eyepoints(eyepoints_of(study.path, recording.dataset), np.array([number]))
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


def _curves(
    study: SceneStudy, figure: NavigationFigure | NavigationTable, at: Place
) -> list[Curve]:
    scanners = figure.scanners or study.scanners
    named = [(scanner, at.recording(study.tree, scanner)) for scanner in scanners]
    return curves(named, quantity=figure.quantity, bins=figure.bins)


def _navigation(study: SceneStudy, figure: NavigationFigure, at: Place) -> canvas.Sheet | str:
    found = _curves(study, figure, at)
    if not found:
        return "no measurement cycle of three shots or more"
    return canvas.sheet_of(
        navigation_chart(found, figure.show),
        study.titled(figure, f"Navigation: {figure.quantity}"),
        labels.joined([at.words, study.note]),
    )


def _navigation_table(study: SceneStudy, figure: NavigationTable, at: Place) -> Page:
    return navigation_page(
        _curves(study, figure, at), show=figure.show, title=figure.title or study.spec.title,
        remarks=[labels.joined([at.words, study.note])],
    )  # fmt: skip
