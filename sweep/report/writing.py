"""The report of a store: what is on it, in which order, and the file that it becomes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pandas

from sweep.analysis import labels
from sweep.analysis.defaults import default_figures
from sweep.analysis.figures import Study, made_page
from sweep.analysis.mean_table import outputs_page
from sweep.analysis.opening import ACCURACY, GRID, SCENE, NotAStoreError, read_attributes
from sweep.analysis.scenes.figures import SceneStudy
from sweep.analysis.tabular import Page as TablePage
from sweep.report import asked, clouds, detector, flights, heat_maps, lines, reach, samples
from sweep.report.page import Chart, Page, Section, Table, Text
from sweep.report.rendering import rendered
from sweep.spec import Slices, Surface
from sweep.storage.locations import Location, located

Say = Callable[[str], None]
"""Is told what is being made."""

Item = Chart | Table | Text


def write(store: str | Location, file: str | Path, say: Say = lambda text: None) -> Path:
    """The report of a study as one page that needs nothing else.

    Parameters
    ----------
    store
        Store of a grid of points or of a scene, complete or not.
    file
        The page to write; nothing is in its place before it is whole.
    say
        Is told what is being made, step by step.

    Raises
    ------
    NotAStoreError
        Where there is no store of a grid or of a scene.
    OSError
        Where the file can't be written.
    """
    store, file = located(store), Path(file)
    kind = read_attributes(store)["kind"]
    if kind == ACCURACY:
        raise NotAStoreError(f"{store} holds what accuracy costs: sweep figures {store}  draws it")
    if kind not in (GRID, SCENE):
        read_attributes(store, GRID)  # says what it holds instead
    page = _scene_page(store, say) if kind == SCENE else _grid_page(store, say)
    say("the page")
    text = rendered(page)
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_name(f".{file.name}.{os.getpid()}.partial")
    try:
        partial.write_text(text, encoding="utf-8")
        os.replace(partial, file)
    finally:
        partial.unlink(missing_ok=True)
    return file


def _grid_page(store: Location, say: Say) -> Page:
    study = Study.of(store)
    dataset, spec = study.dataset, study.spec
    figures: list[Item | None] = list(_figures(study, say))
    tables = list(_tables(study, say))
    say("the maximum range")
    figures.append(reach.chart(study))
    say("the detector")
    tracks, fewer = detector.tracks(study)
    trades: list[Item | None] = [detector.noise_budget(study, tracks, fewer)]
    if not spec.draws.whole_spectra:  # of what looks at those there are no closed forms
        trades = [
            detector.roc(study, tracks, fewer),
            detector.false_alarms(study, tracks, fewer),
            *trades,
        ]
    say("effects and accuracy")
    effects = asked.effects([dataset["effects"]], spec.modes(), dataset.coords)
    told = asked.accuracy(dataset, spec)
    say("points")
    points = samples.grid_points(study)
    return Page(
        spec.title,
        spec.question,
        _facts(dataset.attrs, ("points", f"{dataset.attrs['points']:,}"), ("grid", _shape(study))),
        _incomplete(dataset.attrs, "points"),
        [
            _section("figures", "Figures", figures),
            _section("detector", "Detection and noise", trades),
            _section("asked", "What was asked and simulated", [asked.axes(spec), effects,
                                                               asked.fields(spec)], told),
            _section("tables", "Tables", [*tables, points]),
            asked.reproduction(dataset.attrs, spec, str(store)),
        ],
    )  # fmt: skip


def _figures(study: Study, say: Say) -> Iterator[Item]:
    """Charts of the surfaces and slices that a study asks for, or of a usual set."""
    wanted = [
        figure
        for figure in study.spec.figures or default_figures(study.spec)
        if isinstance(figure, Surface | Slices)
    ]
    maps = [f for f in wanted if isinstance(f, Surface) and heat_maps.fits(study, f)]
    for figure in wanted:
        say(figure.title or study.words(figure.variable))
        made = (
            lines.chart(study, figure)
            if isinstance(figure, Slices)
            else heat_maps.chart(study, figure, 1 / len(maps))
            if figure in maps
            else lines.chart(study, _as_lines(figure))
        )
        yield made or Text(figure.title, ["No point of the study is within its limits."], "")


def _as_lines(figure: Surface) -> Slices:
    """Lines in the place of a surface whose coordinates vary together."""
    return Slices(kind="slices", title=figure.title, variable=figure.variable, x=figure.x,
                  where=figure.where)  # fmt: skip


def _tables(study: Study, say: Say) -> Iterator[Item]:
    """The tables that a study asks for; every output of a single point."""
    if not study.spec.axes:
        yield from _sheets(outputs_page(study.dataset), "outputs")
    for figure in study.spec.figures or default_figures(study.spec):
        if isinstance(figure, Surface | Slices):
            continue
        say(figure.title or figure.stem)
        yield from _sheets(made_page(study, figure), figure.stem)


def _sheets(page: TablePage, stem: str) -> Iterator[Table]:
    """Tables of a page of tables."""
    for number, block in enumerate(page.blocks):
        frame = pandas.DataFrame([list(row) for row in block.rows], columns=list(block.columns))
        last = number + 1 == len(page.blocks)
        heading = f"{page.title}: {block.heading}" if page.title else block.heading
        notes = [" ".join(" ".join(page.notes).split())] if last and page.notes else []
        yield Table(heading, notes, frame, f"{stem}_{number + 1}" if number else stem)


def _shape(study: Study) -> str:
    sizes = [f"{axis.size:,} {labels.coordinate(axis.name)}" for axis in study.spec.axes]
    return " x ".join(sizes) or "a single point"


def _scene_page(store: Location, say: Say) -> Page:
    study = SceneStudy.of(store)
    spec, attributes = study.spec, study.tree.attrs
    seen, fewer = clouds.recordings(study)
    say("point clouds")
    cloud = clouds.chart(study, seen, fewer)
    say("the flight")
    flight: list[Item | None] = [
        flights.along(seen), flights.navigation(seen), flights.noise_budget(study, seen),
    ]  # fmt: skip
    say("effects and accuracy")
    groups = [study.tree[name].to_dataset() for name in study.scanners]
    effects = asked.effects([g["effects"].chunk() for g in groups], spec.modes(), {})
    told = asked.accuracy(groups[0], spec)
    say("points")
    came = flights.returns(seen)
    points = samples.cloud_points(seen)
    without = [] if cloud else ["No shot has brought back a point."]
    return Page(
        spec.title,
        spec.question,
        _facts(
            attributes,
            ("shots times draws", f"{attributes['points']:,}"),
            ("scanners", ", ".join(map(labels.coordinate, study.scanners))),
        ),
        _incomplete(attributes, "blocks"),
        [
            _section("cloud", "Point cloud", [cloud], without),
            _section("flight", "Along the flight", flight),
            _section("asked", "What was asked and simulated", [asked.axes(spec), effects,
                                                               asked.fields(spec)], told),
            _section("tables", "Tables", [came, points]),
            asked.reproduction(attributes, spec, str(store)),
        ],
    )  # fmt: skip


def _section(anchor: str, title: str, items: list[Any], words: list[str] | None = None) -> Section:
    return Section(anchor, title, words or [], [item for item in items if item is not None])


def _facts(attributes: Mapping[Any, Any], *counted: tuple[str, str]) -> list[tuple[str, str]]:
    """What a reader wants to know first."""
    facts = [
        *counted,
        ("study", attributes["study_id"][:8]),
        ("model", str(attributes["model_version"])),
        ("sweep", attributes["software"]["sweep"]),
        ("finished", str(attributes["finished"])[:16].replace("T", " ")),
    ]
    return [(name, value) for name, value in facts if value]


def _incomplete(attributes: Mapping[Any, Any], unit: str) -> list[str]:
    done, number = attributes[f"{unit}_committed"], attributes[unit]
    if done >= number:
        return []
    return [
        f"The study is not complete: {done:,} of {number:,} {unit} are computed. "
        "sweep resume goes on."
    ]
