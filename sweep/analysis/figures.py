"""All figures and tables of a study, as its spec asks for them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet

from sweep.analysis import canvas, labels, mean_table, slices, surface, tables
from sweep.analysis.cells import MEAN
from sweep.analysis.defaults import default_figures
from sweep.analysis.opening import ACCURACY, SCENE, read_attributes
from sweep.analysis.opening import open as open_store
from sweep.analysis.selection import Points, confined, split
from sweep.analysis.tabular import Page
from sweep.spec import FalseAlarmTable, Figure, Slices, Spec, Surface, Table, ThresholdTable
from sweep.storage.locations import Location, beside, located

WIDTH, PANEL_HEIGHT = 9.5, 4.4


def drawn_surface(
    found: Points, *, x: str, y: str, variable: str, long_name: str, title: str, note: str
) -> Sheet:
    """A variable over two coordinates.

    Parameters
    ----------
    found
        The points, with the variable.
    x, y, variable, long_name
        Coordinates, and the variable with its name in words.
    title, note
        What stands over the sheet, and what is to be added at its foot.
    """
    parts, left_out = split(found, found.further([x, y]), surface.MOST_PANELS)
    columns = 1 if len(parts) == 1 else 2
    most = surface.MOST_COLUMNS // columns, surface.MOST_ROWS
    by = tuple(
        max(part.side(name).together(m) for _, part in parts)
        for name, m in zip((x, y), most, strict=True)
    )
    kinds = [MEAN, surface.worst(variable)] if max(by) > 1 else [MEAN]
    kinds = [kind for kind in kinds if kind]
    grids = surface.grids([part for _, part in parts], variable, x, y, kinds, most)
    rows = math.ceil(len(grids) / columns)
    sheet, axes = canvas.panels(
        WIDTH * (1 + 0.4 * (columns - 1)), PANEL_HEIGHT * rows + 0.8, rows, columns,
        sharex=True, sharey=True,
    )  # fmt: skip
    norm = surface.scale(variable, np.concatenate([grid.values.ravel() for grid in grids]))
    (across, x_units), (up, y_units) = surface.shown_along(found, x), surface.shown_along(found, y)
    names = [(name, f"{kind} of each cell" * (max(by) > 1)) for name, _ in parts for kind in kinds]
    for panel, grid, words in zip(axes, grids, names, strict=False):
        surface.paint(panel, grid, (across, up), norm)
        panel.set_title(", ".join(filter(None, words)), size=10)
    _label(axes, len(grids), columns, (x, x_units), (y, y_units))
    surface.bar(sheet, axes, norm, long_name)
    canvas.title(sheet, title)
    canvas.caption(sheet, labels.joined([*_remarks(grids, by, kinds, left_out), note]))
    return sheet


def _label(
    axes: list[Axes], number: int, columns: int, x: tuple[str, str], y: tuple[str, str]
) -> None:
    """Names and units of the two coordinates, on the outer ones of the panels in use."""
    for i, panel in enumerate(axes):
        panel.set_visible(i < number)
        if i + columns >= number:
            panel.set_xlabel(labels.with_units(labels.coordinate(x[0]), x[1]))
            panel.tick_params(labelbottom=True)
        if i % columns == 0:
            panel.set_ylabel(labels.with_units(labels.coordinate(y[0]), y[1]))


def _remarks(
    grids: list[surface.Grid], by: tuple[int, ...], kinds: list[str], left_out: int
) -> list[str]:
    """What a reader has to know of how it was drawn."""
    remarks = []
    if max(by) > 1:
        remarks.append(f"each cell stands for {math.prod(by)} neighbouring points: their mean")
        if len(kinds) > 1:
            remarks[0] += f", and the {kinds[1]} of them, which hides no narrow dip or peak"
    if left_out:
        remarks.append(f"{left_out} further values have no panel here")
    if any(np.isnan(grid.values).any() for grid in grids):
        remarks.append("grey: not computed")
    return remarks


@dataclass(frozen=True)
class Study:
    """A store opened, with the spec that it holds."""

    dataset: xr.Dataset
    spec: Spec

    @classmethod
    def of(cls, store_path: str | Location) -> Study:
        """The study in a store."""
        dataset = open_store(store_path)
        return cls(dataset, Spec.from_stored(dataset.attrs["spec"]))

    @property
    def note(self) -> str:
        """What a picture's foot says of where it comes from."""
        attributes = self.dataset.attrs
        note = (
            f"study '{attributes['title']}', {attributes['study_id'][:8]}, "
            f"model {attributes['model_version']}"
        )
        done, number = attributes["points_committed"], attributes["points"]
        return note if done >= number else f"{note}: {done:,} of {number:,} points computed"

    @property
    def points(self) -> Points:
        """All points."""
        return Points.of(self.dataset)

    def words(self, variable: str) -> str:
        """A variable's name in words, with its units."""
        attributes = self.dataset[variable].attrs
        return labels.with_units(attributes.get("long_name", variable), attributes.get("units", ""))


def draw(
    store_path: str | Location, directory: str | Path | None = None, form: str = "png"
) -> list[Path]:
    """Every figure and table that the spec in a store asks for; a usual set where it asks for none.

    Parameters
    ----------
    store_path
        The store, complete or not.
    directory
        Where to; by default ``NAME-figures`` for ``NAME.zarr``: beside the store, or in the folder
        that one is in where the store is an object store's.
    form
        ``png``, ``pdf`` or ``svg``. The same store gives the same bytes.

    Returns
    -------
    list of Path
        The files written: pictures of figures, TXT and CSV of tables.

    Raises
    ------
    NotAStoreError
        Where there is no store of a grid of points, of a scene or of what accuracy costs.
    """
    with canvas.style():
        return _drawn(located(store_path), directory, form)


def _drawn(store_path: Location, directory: str | Path | None, form: str) -> list[Path]:
    """All of it, whichever kind of store."""
    if read_attributes(store_path)["kind"] == ACCURACY:
        from sweep.analysis import accuracy_figure

        return accuracy_figure.draw(
            store_path, None if directory is None else Path(directory), form
        )
    stem = store_path.name.removesuffix(".zarr")
    directory = beside(store_path) / f"{stem}-figures" if directory is None else Path(directory)
    if read_attributes(store_path)["kind"] == SCENE:
        from sweep.analysis.scenes import figures as of_scenes

        return of_scenes.draw(store_path, directory, form)
    study = Study.of(store_path)
    figures = study.spec.figures or default_figures(study.spec)
    if not figures:
        return mean_table.outputs_page(study.dataset).save(directory, "outputs")
    return [path for figure in figures for path in _made(study, figure, directory, form)]


def _made(study: Study, figure: Figure, directory: Path, form: str) -> list[Path]:
    """Files of one figure."""
    if isinstance(figure, Surface | Slices):
        sheet = _sheet(study, figure)
        return [canvas.save(sheet, directory / f"{figure.stem}.{form}")]
    return made_page(study, figure).save(directory, figure.stem)


def _sheet(study: Study, figure: Surface | Slices) -> canvas.Sheet:
    found = confined(study.points, study.spec, figure.where)
    held = [
        f"{labels.coordinate(name)} {value}"
        for name, value in figure.where.items()
        if not isinstance(value, tuple)
    ]
    if not found.size:
        return canvas.empty(f"{study.spec.title}: no point of the study has {', '.join(held)}")
    options: dict[str, Any] = {
        "x": figure.x,
        "variable": figure.variable,
        "long_name": study.words(figure.variable),
        "title": "\n".join(filter(None, [study.spec.title, figure.title])),
        "note": labels.joined([", ".join(held), study.note]),
    }
    if isinstance(figure, Surface):
        return drawn_surface(found, y=figure.y, **options)
    return slices.draw(found, by=figure.by, **options)


def made_page(study: Study, figure: Table | FalseAlarmTable | ThresholdTable) -> Page:
    """Tables of one that a study asks for."""
    found, spec = study.points, study.spec
    title = figure.title or spec.title
    if isinstance(figure, Table):
        units = str(study.dataset[figure.variable].attrs.get("units", ""))
        return mean_table.mean_page(found, spec, figure.model_dump(), units, title)
    make = tables.threshold_page if isinstance(figure, ThresholdTable) else tables.false_alarm_page
    return make(found, spec, by=figure.by, printed=figure.printed, title=title)
