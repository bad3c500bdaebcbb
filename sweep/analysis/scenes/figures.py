"""All figures and tables of a scene's study, as its spec asks for them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis import canvas, labels
from sweep.analysis.scenes import (
    cloud,
    cloud_figure,
    errors_over_altitude,
    navigation_figure,
    scatter_figure,
    shot_figure,
)
from sweep.analysis.scenes.errors_over_altitude import Curve
from sweep.analysis.scenes.eyepoints import eyepoints_of, read_eyepoints
from sweep.analysis.scenes.navigation_figure import AVAILABILITY, BIAS, COMPONENTS, RMSE, UNITS
from sweep.analysis.scenes.opening import opened
from sweep.analysis.scenes.places import Place, place
from sweep.analysis.scenes.quantities import QUANTITIES
from sweep.analysis.scenes.recording import Interval, Recording
from sweep.analysis.scenes.terrain import Ground
from sweep.analysis.tabular import Block, Cell, Page
from sweep.model.effects.catalogue import names_of
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

LENGTH = "vector"


def navigation_page(
    curves: Sequence[Curve], *, quantity: str, show: str, title: str, remarks: Sequence[str]
) -> Page:
    """A block for each scanner, a row for each bin of altitude.

    Parameters
    ----------
    curves
        Errors of each scanner.
    quantity, show
        ``velocity`` or ``altitude``; ``availability``, ``bias``, ``rmse`` or ``all``.
    title, remarks
        What stands over the page and under it.
    """
    shown = (AVAILABILITY, BIAS, RMSE) if show == "all" else (show,)
    blocks, records = [], []
    for curve in curves:
        own = [_record(curve, i, quantity, shown) for i in range(curve.edges.size - 1)]
        columns = [name for name in own[0] if name != "scanner"]
        rows = [[record[name] for name in columns] for record in own]
        blocks.append(Block(f"{labels.coordinate(curve.scanner)}: {quantity}", columns, rows))
        records += own
    notes = [
        "from, to: true altitude above ground [m]; cycles: measurement cycles times draws.",
        f"bias, rmse, stated: in {UNITS[quantity]}; stated: root of the mean variance that",
        "  solutions give for themselves; error of bias: its standard error.",
        *remarks,
    ]
    return Page(title, blocks, notes, records)


def _record(curve: Curve, i: int, quantity: str, shown: Sequence[str]) -> dict[str, Cell]:
    """One line of the CSV file."""
    record: dict[str, Cell] = {
        "scanner": curve.scanner,
        "from": float(curve.edges[i]),
        "to": float(curve.edges[i + 1]),
        "cycles": int(curve.tally.attempts[i]),
        "solved": int(curve.tally.count[i]),
    }
    names = COMPONENTS[quantity]
    if AVAILABILITY in shown:
        record["available"] = float(curve.tally.availability[i])
    if BIAS in shown:
        for k, name in enumerate(names):
            record[f"bias {name}".strip()] = float(curve.bias[i, k])
            record[f"error of bias {name}".strip()] = float(curve.bias_error[i, k])
    if RMSE in shown:
        for k, name in enumerate((*names, LENGTH) if len(names) > 1 else names):
            record[f"rmse {name}".strip()] = float(curve.rmse[i, k])
            record[f"stated {name}".strip()] = float(curve.predicted[i, k])
    return record


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
        """The study in a store."""
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
        """What a picture's foot says of where it comes from."""
        attributes = self.tree.attrs
        note = (
            f"study '{attributes['title']}', {attributes['study_id'][:8]}, "
            f"model {attributes['model_version']}"
        )
        done, number = attributes["blocks_committed"], attributes["blocks"]
        return note if done >= number else f"{note}: {done:,} of {number:,} blocks computed"

    def titled(self, figure: SceneFigure, otherwise: str) -> str:
        """What stands over a figure."""
        return "\n".join([self.spec.title, figure.title or otherwise])


def draw(store_path: str | Location, directory: Path, form: str = "png") -> list[Path]:
    """Every figure and table that the spec in a store asks for; a usual set where it asks for none.

    Parameters
    ----------
    store_path
        The store, complete or not.
    directory
        Where to.
    form
        ``png``, ``pdf`` or ``svg``.

    Returns
    -------
    list of Path
        The files written: pictures of figures, TXT and CSV of tables.

    Raises
    ------
    NotAStoreError
        Where there is no store of a scene, or the eyepoints that a figure needs are gone.
    """
    study = SceneStudy.of(store_path)
    figures: Sequence[SceneFigure] = study.spec.figures or default_figures(study.tree)
    return [path for figure in figures for path in _made(study, figure, directory, form)]


def _made(study: SceneStudy, figure: SceneFigure, directory: Path, form: str) -> list[Path]:
    """Files of one figure."""
    at = place(study.spec, figure.where)
    if isinstance(figure, NavigationTable):
        curves = _curves(study, figure, at)
        page = navigation_page(
            curves, quantity=figure.quantity, show=figure.show,
            title=figure.title or study.spec.title, remarks=[labels.joined([at.words, study.note])],
        )  # fmt: skip
        return page.save(directory, figure.stem)
    makers: dict[type, Callable[[SceneStudy, Any, Place], canvas.Sheet]] = {
        CloudFigure: _cloud,
        Scatter: _scatter,
        ShotSpectra: _shot,
        NavigationFigure: _navigation,
    }
    sheet = makers[type(figure)](study, figure, at)
    return [canvas.save(sheet, directory / f"{figure.stem}.{form}")]


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


def _cloud(study: SceneStudy, figure: CloudFigure, at: Place) -> canvas.Sheet:
    recording = _recording(study, figure, at)
    asked = {name: _interval(getattr(figure, name)) for name in ("x", "y", "z", "time")}
    found = cloud.gathered(
        recording,
        colour=figure.colour,
        ranges=figure.ranges,
        draw=figure.draw,
        crops={name: crop for name, crop in asked.items() if crop is not None},
        dropouts=figure.dropouts,
        path=figure.path,
    )
    if found is None:
        return canvas.empty(f"{study.spec.title}: there is no point within the figure's limits")
    view: cloud_figure.View = (
        figure.view
        if isinstance(figure.view, str)
        else (np.degrees(figure.view["azimuth"]), np.degrees(figure.view["elevation"]))
    )
    return cloud_figure.draw(
        found,
        quantity=figure.colour,
        surfaces=study.surfaces,
        view=view,
        ground=Ground.of(study.tree) if figure.terrain else None,
        title=study.titled(figure, f"Point cloud by {QUANTITIES[figure.colour].words}"),
        remarks=_remarks(study, recording, at, figure),
    )


def _scatter(study: SceneStudy, figure: Scatter, at: Place) -> canvas.Sheet:
    recording = _recording(study, figure, at)
    found = scatter_figure.gathered(
        recording, [figure.x, figure.y, figure.colour], draw=figure.draw, ranges=figure.ranges,
        time=_interval(figure.time),
    )  # fmt: skip
    if not found.total:
        return canvas.empty(f"{study.spec.title}: there is no point within the figure's limits")
    return scatter_figure.draw(
        found,
        x=figure.x,
        y=figure.y,
        colour=figure.colour,
        surfaces=study.surfaces,
        title=study.titled(
            figure, f"{QUANTITIES[figure.y].words} over {QUANTITIES[figure.x].words}".capitalize()
        ),
        remarks=_remarks(study, recording, at, figure),
    )


def _shot(study: SceneStudy, figure: ShotSpectra, at: Place) -> canvas.Sheet:
    recording = _recording(study, figure, at)
    if isinstance(figure.shot, int):
        number: int | None = figure.shot
    else:
        number = shot_figure.several_surfaces(recording, figure.draw)
    if number is None or number >= recording.shots:
        why = "no shot tells several surfaces apart" if number is None else f"no shot {number}"
        return canvas.empty(f"{study.spec.title}: there is {why}")
    eyepoints = read_eyepoints(eyepoints_of(study.path, recording.dataset), np.array([number]))
    if not eyepoints.seen.all():
        return canvas.empty(f"{study.spec.title}: shot {number} sees nothing")
    simulated = recording.read("effects", slice(number, number + 1))
    shot = shot_figure.simulated(
        eyepoints,
        at.parameters(study.spec),
        study.spec.surfaces(),
        names_of(int(simulated[0])),
        seed=study.spec.seed,
    )
    told = (
        f"shot {number:,} of {recording.shots:,} at {eyepoints.time[0]:.6g} s, "
        f"beam {eyepoints.beam[0]}, noise drawn for the picture"
    )
    return shot_figure.draw(
        shot,
        eyepoints,
        study.surfaces,
        title=study.titled(figure, "Spectra of one shot"),
        remarks=[told, *_remarks(study, recording, at, figure)],
    )


def _curves(
    study: SceneStudy, figure: NavigationFigure | NavigationTable, at: Place
) -> list[Curve]:
    scanners = figure.scanners or study.scanners
    recordings = [at.recording(study.tree, scanner) for scanner in scanners]
    return errors_over_altitude.curves(recordings, quantity=figure.quantity, bins=figure.bins)


def _navigation(study: SceneStudy, figure: NavigationFigure, at: Place) -> canvas.Sheet:
    curves = _curves(study, figure, at)
    if not curves:
        return canvas.empty(f"{study.spec.title}: no measurement cycle of three shots or more")
    return navigation_figure.draw(
        curves,
        quantity=figure.quantity,
        show=figure.show,
        title=study.titled(figure, f"Navigation: {figure.quantity}"),
        remarks=[at.words, study.note],
    )
