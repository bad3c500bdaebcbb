"""All figures and tables of a study, as its spec asks for them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis import canvas, charts, labels, tables
from sweep.analysis.opening import ACCURACY, SCENE, read_attributes
from sweep.analysis.opening import open as open_store
from sweep.analysis.selection import GRAZING_ANGLE, RANGE, Points, confined, cuts
from sweep.spec import (
    Axis,
    FalseAlarmTable,
    Figure,
    Slices,
    Spec,
    Surface,
    Table,
    ThresholdTable,
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

    def words(self, variable: str) -> str:
        """Return a variable's name in words, with its units."""
        attributes = self.dataset[variable].attrs
        return labels.with_units(attributes.get("long_name", variable), attributes.get("units", ""))

    def chart(self, figure: Surface | Slices, room: charts.Room) -> charts.Chart | None:
        """Return the chart of a figure, or None if no point is within its limits."""
        found = confined(self.points, self.spec, figure.where)
        if not found.size:
            return None
        options: dict[str, Any] = {
            "x": figure.x, "variable": figure.variable, "words": self.words(figure.variable),
        }  # fmt: skip
        if isinstance(figure, Surface):
            return charts.surface(found, y=figure.y, room=room, **options)
        return charts.slices(found, by=figure.by, **options)

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
        Where there is no store of a grid of points, of a scene or of what accuracy costs; or the
        eyepoints that a figure needs are gone.
    """
    with canvas.style():
        return _drawn(located(store_path), directory, form)


def _drawn(store_path: Location, directory: str | Path | None, form: str) -> list[Path]:
    """All of it, whichever kind of store."""
    kind = read_attributes(store_path)["kind"]
    if kind == ACCURACY:
        from sweep.analysis import accuracy_figure

        return accuracy_figure.draw(
            store_path, None if directory is None else Path(directory), form
        )
    stem = store_path.name.removesuffix(".zarr")
    directory = beside(store_path) / f"{stem}-figures" if directory is None else Path(directory)
    if kind == SCENE:
        from sweep.analysis.scenes.figures import SceneStudy

        study: Any = SceneStudy.of(store_path)
    else:
        study = Study.of(store_path)
        if not study.figures:
            return tables.outputs_page(study.dataset).save(directory, "outputs")
    files = []
    for figure in study.figures:
        made = study.made(figure)
        if isinstance(made, tables.Page):
            files += made.save(directory, figure.stem)
        else:
            sheet = canvas.empty(f"{study.spec.title}: {made}") if isinstance(made, str) else made
            files.append(canvas.save(sheet, directory / f"{figure.stem}.{form}"))
    return files


def default_figures(spec: Spec) -> list[Figure]:
    """Surfaces where two axes are long, slices where one is, else a table; none without axes."""
    if not spec.axes:
        return []
    zipped = next((axis for axis in spec.axes if axis.zipped), None)
    if zipped is not None:
        return _along_zipped(spec, zipped)
    numeric = sorted((a for a in spec.axes if _is_numeric(a)), key=lambda axis: -axis.size)
    long = [axis for axis in numeric if axis.size >= LONG]
    if len(long) >= 2:
        x, y = _range_before_angle(long)
        return [Surface(kind="surface", variable=v, x=x, y=y) for v in VARIABLES]
    if numeric:
        by = _lines(spec, numeric[0])
        return [Slices(kind="slices", variable=v, x=numeric[0].name, **by) for v in VARIABLES]
    rows = spec.axes[0].name
    return [Table(kind="table", variable=v, rows=rows) for v in VARIABLES]


def _is_numeric(axis: Axis) -> bool:
    return not labels.is_words(np.asarray(axis.members[0].display))


def _range_before_angle(long: list[Axis]) -> tuple[str, str]:
    """Range along x and angle along y where they are long, else the longest two."""
    rank = {RANGE: 0, GRAZING_ANGLE: 1}
    first = sorted(long, key=lambda axis: rank.get(axis.members[0].path, 2))[:2]
    if first[0].members[0].path == GRAZING_ANGLE:
        first.reverse()
    return first[0].name, first[1].name


def _lines(spec: Spec, along: Axis) -> dict[str, str]:
    """Coordinate that has a line for each value, the first with few, as `by`; none where none."""
    others = [a for a in spec.axes if a is not along and not a.zipped]
    return next(({"by": a.name} for a in others if a.size <= charts.MOST_LINES), {})


def _along_zipped(spec: Spec, zipped: Axis) -> list[Figure]:
    """Slices along each cut of range and angle, or along a zipped axis's first number."""
    by = _lines(spec, zipped)
    members = {member.name: member for member in zipped.members}
    figures: list[Figure] = []
    for i, cut in enumerate(cuts(spec)):
        if cut.held in members and cut.along in members:
            written = f"{cut.value!r} {members[cut.held].units}".strip()
            figures.append(
                Slices(
                    kind="slices", name=f"pd_shot_{cut.along}_{i + 1}", variable="pd_shot",
                    x=cut.along, **by, where={cut.held: written},
                    title=f"Probability of detection at {cut.name}",
                )
            )  # fmt: skip
    if figures:
        return figures
    numeric = [m.name for m in zipped.members if not labels.is_words(np.asarray(m.display))]
    if not numeric:
        return [Table(kind="table", variable=v, rows=zipped.members[0].name) for v in VARIABLES]
    return [Slices(kind="slices", variable=v, x=numeric[0], **by) for v in VARIABLES]
