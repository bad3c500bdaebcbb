"""All figures and tables of a study, as its spec asks for them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import xarray as xr

from sweep.analysis import canvas, labels, mean_table, slices, surface_figure, tables
from sweep.analysis.defaults import default_figures
from sweep.analysis.opening import ACCURACY, SCENE, read_attributes
from sweep.analysis.opening import open as open_store
from sweep.analysis.selection import Points, confined
from sweep.analysis.tabular import Page
from sweep.spec import FalseAlarmTable, Figure, Slices, Spec, Surface, Table, ThresholdTable
from sweep.storage.locations import Location, beside, located


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
        from sweep.analysis.accuracy import report

        return report.draw(store_path, None if directory is None else Path(directory), form)
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
        return surface_figure.draw(found, y=figure.y, **options)
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
