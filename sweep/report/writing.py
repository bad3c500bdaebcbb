"""The report of a store: what is on it, in which order, and the file that it becomes."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pandas
import xarray as xr
import yaml

from sweep.analysis import labels
from sweep.analysis.charts import Chart, Room
from sweep.analysis.consistency import consistency
from sweep.analysis.figures import SceneStudy, Study, held
from sweep.analysis.opening import ACCURACY, GRID, SCENE, NotAStoreError, read_attributes
from sweep.analysis.scenes.recording import INTERPOLATED, QUANTITIES, shown
from sweep.analysis.selection import known
from sweep.analysis.tables import Page as TablePage
from sweep.analysis.tables import outputs_page
from sweep.messages import command_line
from sweep.model.effects.catalogue import EFFECTS
from sweep.report import detector, flights
from sweep.report.flights import Seen
from sweep.report.page import Item, Page, Section, Table, Text, plot, rendered
from sweep.spec import SceneSpec, Slices, Spec, Surface
from sweep.spec.noise_alarms import alarms_of_study
from sweep.spec.sections import parameter_rules
from sweep.storage.locations import Location, draft, located
from sweep.storage.opening import software_versions

PAGE = Room(parts=detector.MOST_PARTS, columns=500, rows=180, cells=400_000, abreast=1)
"""Cells of all heat maps of a page together, which keep it to a few megabytes."""

MOST_ROWS = 1000
"""Points in a table."""

COLUMNS = (
    "pd_shot", "pd_shot_half_width", "pd_up", "pd_doppler", "pd_down", "pfa_segment", "pfa_shot",
    "pfa_both_chirps",
    "p_leakage_up", "false_alarms", "snr_up", "snr_doppler", "range_error",
    "radial_velocity_error", "range_rmse", "range_bound", "radial_velocity_rmse",
    "radial_velocity_bound", "beamlets", "n_draws", "effects_error",
)  # fmt: skip

OF_POINTS = (
    "time", "beam", "x", "y", "z", "range", "radial_velocity", "snr", "pd", "true_range",
    "true_radial_velocity", "flags",
)  # fmt: skip


def write(store: str | Location, file: str | Path) -> Path:
    """Write the report of a study as one page that needs nothing else.

    Parameters
    ----------
    store
        Store of a grid of points or of a scene, complete or not.
    file
        The page to write; nothing is in its place before it is whole.

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
    page = _scene_page(store) if kind == SCENE else _grid_page(store)
    text = rendered(page)
    with draft(file, replace=True) as made:
        made.write_text(text, encoding="utf-8")
    return file


Made = Chart | Item | None

Declared = Spec | SceneSpec


def _grid_page(store: Location) -> Page:
    study = Study.of(store)
    dataset, spec = study.dataset, study.spec
    figures: list[Made] = list(_figures(study))
    tables = list(_tables(study))
    reach = detector.maximum_range(study)
    figures.append(None if detector.is_empty(reach) else reach)
    found = detector.tracks(study)
    trades: list[Made] = [detector.noise_budget(study, *found)]
    if not spec.draws.whole_spectra:  # of what looks at those there are no closed forms
        trades = [detector.roc(study, *found), detector.false_alarms(study, *found), *trades]
    asked = _asked(spec, [dataset["effects"]], dataset)
    sizes = [f"{axis.size:,} {labels.coordinate(axis.name)}" for axis in spec.axes]
    facts = [("points", f"{dataset.attrs['points']:,}"),
             ("grid", " x ".join(sizes) or "a single point")]  # fmt: skip
    sections = [
        _answer(spec, [dataset], "points", detector.reached(reach)),
        _section("figures", "Figures", figures),
        _section("detector", "Detection and noise", trades),
        asked,
        _section("tables", "Tables", [*tables, _grid_points(study)]),
    ]
    return _page(spec, dataset.attrs, "points", facts, sections, store)


def _answer(
    spec: Declared, groups: Sequence[xr.Dataset], unit: str, further: Sequence[str]
) -> Section:
    """Section that opens the page: detection, false alarms, and whether the tolerance is kept."""
    tolerance, level = spec.accuracy.tolerance, detector.PD
    limits = {"effects_error": tolerance, "beamlets_error": tolerance, "accuracy_missed": 0.0}
    found = []
    for group in groups:
        pd = group["pd_shot"]
        over = [group[name] > most for name, most in limits.items() if name in group]
        missed = sum(over, xr.DataArray(0)) > 0
        unchecked = pd.notnull() & group["beamlets_error"].isnull()
        found.append(
            (pd.count(), (pd >= level).sum(), pd.sum(), pd.min(), missed.sum(), unchecked.sum())
        )
    columns = np.array(dask.compute(found)[0], float).T  # a column a group
    count, often, total, _, missed, unchecked = columns.sum(axis=1)
    if not count:
        return Section("answer", "Answer", ["No result is there yet."])
    told = [
        f"The probability of detection of a shot is {level:g} or more at {often:,.0f} of "
        f"{count:,.0f} {unit}; its mean is {total / count:.3g}, its lowest "
        f"{np.nanmin(columns[3]):.3g}.",
        *further,
    ]
    if alarms := alarms_of_study(spec):
        most = max(any_ for any_, _ in alarms)
        chance = f"{most:.3g}" + " at the most" * (len(alarms) > 1)
        told.append(f"Noise alone raises a false alarm in either chirp with probability {chance}.")
    kept = f"missed at {missed:,.0f} {unit}" if missed else f"kept at all of these {unit}"
    told.append(f"The tolerance of {tolerance:g} is {kept}.")
    if unchecked:
        told.append(
            f"Whether the number of beamlets keeps it is not checked at {unchecked:,.0f} of them: "
            "their number is given, or their amplitudes add."
        )
    return Section("answer", "Answer", told)


def _asked(spec: Declared, flags: Sequence[xr.DataArray], dataset: xr.Dataset) -> Section:
    """Section on the study's fields, the effects simulated and the accuracy reached."""
    made = [_axes(spec), _effects(flags, spec.modes()), _fields(spec)]
    return _section("asked", "What was asked and simulated", made, accuracy(dataset, spec))


def _page(
    spec: Declared, attributes: Mapping[Any, Any], unit: str,
    counted: Sequence[tuple[str, str]], sections: Sequence[Section], store: Location,
) -> Page:  # fmt: skip
    """Return the page: a summary, its sections, and how to make it again."""
    facts = [
        *counted,
        ("study", attributes["study_id"][:8]),
        ("model", str(attributes["model_version"])),
        ("sweep", software_versions(attributes).get("sweep", "")),
        ("finished (UTC)", str(attributes["finished"])[:16].replace("T", " ")),
    ]
    done, number = attributes[f"{unit}_committed"], attributes[unit]
    remark = (
        f"The study is not complete: {done:,} of {number:,} {unit} are computed. "
        "sweep resume goes on."
    )
    return Page(
        spec.title,
        spec.question,
        [(name, value) for name, value in facts if value],
        [remark] if done < number else [],
        [*sections, _reproduction(attributes, spec, str(store))],
    )


def _figures(study: Study) -> Iterator[Made]:
    """Charts of the surfaces and slices that a study asks for, or of a usual set."""
    wanted = [figure for figure in study.figures if isinstance(figure, Surface | Slices)]
    maps = sum(isinstance(figure, Surface) for figure in wanted)
    for figure in wanted:
        chart = study.chart(figure, replace(PAGE, cells=PAGE.cells / max(1, maps)))
        if chart is None:
            yield Text(figure.title, ["No point of the study is within its limits."], "")
        else:
            yield replace(
                chart, heading=figure.title or chart.heading, caption=[held(figure), *chart.caption]
            )


def _tables(study: Study) -> Iterator[Table]:
    """Return the tables that a study asks for; every output of a single point."""
    if not study.spec.axes:
        yield from _sheets(outputs_page(study.dataset), "outputs")
    for figure in study.figures:
        if not isinstance(figure, Surface | Slices):
            yield from _sheets(study.page(figure), figure.stem)


def _sheets(page: TablePage, stem: str) -> Iterator[Table]:
    """Tables of a page of tables."""
    for number, block in enumerate(page.blocks):
        frame = pandas.DataFrame([list(row) for row in block.rows], columns=list(block.columns))
        last = number + 1 == len(page.blocks)
        heading = f"{page.title}: {block.heading}" if page.title else block.heading
        notes = [" ".join(" ".join(page.notes).split())] if last and page.notes else []
        yield Table(heading, notes, frame, f"{stem}_{number + 1}" if number else stem)


def _scene_page(store: Location) -> Page:
    study = SceneStudy.of(store)
    spec, attributes = study.spec, study.tree.attrs
    seen, fewer = flights.recordings(study)
    cloud = flights.solid(study, seen, fewer)
    flight: list[Made] = [
        flights.along(seen),
        flights.errors(seen),
        flights.navigation(spec, seen),
        flights.noise_budget(study, seen),
    ]
    groups = [study.tree[name].to_dataset() for name in study.scanners]
    asked = _asked(spec, [g["effects"].chunk() for g in groups], groups[0])
    facts = [("shots times draws", f"{attributes['points']:,}"),
             ("scanners", ", ".join(map(labels.coordinate, study.scanners)))]  # fmt: skip
    came_back = flights.returns(seen)
    sections = [
        _answer(spec, groups, "shots", [
            *flights.came_back(came_back.frame, groups, fewer), *consistency_words(study.tree)
        ]),
        _section("cloud", "Point cloud", [cloud],
                 [] if cloud else ["No shot has brought back a point."]),
        _section("flight", "Along the flight", flight),
        asked,
        _section("tables", "Tables", [came_back, _cloud_points(seen)]),
    ]  # fmt: skip
    return _page(spec, attributes, "blocks", facts, sections, store)


def consistency_words(tree: xr.DataTree) -> list[str]:
    """Return sentences on errors against the standard errors that are stated."""
    results = consistency(tree)
    if words := [result.words for result in results if not result.is_consistent]:
        return words
    if not any(result.number for result in results):
        return []
    return ["Errors of points and of navigation agree with the standard errors that are stated."]


def _section(anchor: str, title: str, items: Sequence[Made], words: Sequence[str] = ()) -> Section:
    made = [plot(item) if isinstance(item, Chart) else item for item in items]
    return Section(anchor, title, words, [item for item in made if item is not None])


def _grid_points(study: Study) -> Table | None:
    """Points of a grid, every k-th along its longest axes; none where there is a single one."""
    dataset = study.dataset
    if not study.spec.axes:
        return None
    names = [name for name in COLUMNS if name in dataset]
    dims = dict(zip(dataset[names[0]].dims, dataset[names[0]].shape, strict=True))
    size = dict(dims)
    while np.prod(list(size.values())) > MOST_ROWS:
        longest = max(size, key=lambda dim: size[dim])
        size[longest] -= max(1, size[longest] // 10)
    chosen = {
        dim: np.unique(np.linspace(0, dims[dim] - 1, number).round().astype(int))
        for dim, number in size.items()
    }
    part = dataset[names].isel(chosen)  # type: ignore[arg-type]
    for name in names:
        part[name] = known(part[name]).assign_attrs(dataset[name].attrs)
    frame = part.to_dataframe().reset_index()
    frame = frame[[c for c in frame.columns if c in dataset.coords or c in names]]
    frame = frame.rename(
        columns={
            c: labels.with_brackets(c, dataset[c].attrs.get("units", "")) for c in frame.columns
        }
    )
    total = int(np.prod(list(dims.values())))
    return Table("Points", _told(len(frame), total), frame, "points")


def _told(rows: int, total: int) -> list[str]:
    if rows == total:
        return [f"All {total:,} points."]
    return [
        f"{rows:,} of {total:,} points, spread over all: reduced for this page. The store has "
        "every one."
    ]


def _cloud_points(found: list[Seen]) -> Table:
    """Points of clouds of the first draw, with what a reader wants of each."""
    frames, total = [], 0
    for seen in found:
        rows = seen.recording.rows(OF_POINTS, MOST_ROWS // len(found), ranges=INTERPOLATED)
        total += rows.total
        if rows.total:
            table = rows.rows()
            columns = {
                labels.with_brackets(name, "dB" if name == "snr" else QUANTITIES[name].units): (
                    shown(name, values) if name != "flags" else values
                )
                for name, values in table.items()
            }
            frames.append(pandas.DataFrame({"recorded by": seen.words or "the scanner"} | columns))
    frame = pandas.concat(frames, ignore_index=True) if frames else pandas.DataFrame()
    return Table("Points", _told(len(frame), total), frame, "points")


def _fields(spec: Declared) -> Table:
    """Every field of the spec with what it means."""
    rules = parameter_rules()
    written = spec.to_yaml_mapping()
    rows = [
        (path, _shown(value), rules[path].about if path in rules else "")
        for path, value in _leaves(written)
        if path.split(".")[0] not in ("title", "question", "figures", "axes", "effects")
    ]
    frame = pandas.DataFrame(rows, columns=["field", "value", "meaning"])
    return Table("Every field", ["Defaults included."], frame, "fields")


def _leaves(written: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in written.items():
        path = f"{prefix}{name}"
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{path}.")
        else:
            yield path, value


def _shown(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 120 else f"{text[:117]}..."


def _axes(spec: Declared) -> Table | None:
    """Axes with their values."""
    rows = [
        (axis.name, member.path, axis.size, _values(member.display, member.units))
        for axis in spec.axes
        for member in axis.members
    ]
    if not rows:
        return None
    frame = pandas.DataFrame(rows, columns=["axis", "parameter", "values", "which"])
    return Table("What varies", [], frame, "axes")


def _values(values: np.ndarray, units: str) -> str:
    told = [labels.quantity(v, units) for v in values[:4]]
    if len(values) > 5:
        return ", ".join([*told[:2], "...", labels.quantity(values[-1], units)])
    return ", ".join(labels.quantity(v, units) for v in values)


def _effects(arrays: Sequence[xr.DataArray], modes: Mapping[str, str]) -> Table:
    """Effects that were simulated: at how many points, and in which part of the study."""
    lazy = []
    for k in range(len(EFFECTS)):
        present = [array // 2**k % 2 > 0 for array in arrays]
        lazy.append(
            [(own.sum(), [own.any(set(own.dims) - {dim}) for dim in own.dims]) for own in present]
        )
    (found,) = dask.compute(lazy)
    size = sum(array.size for array in arrays)
    rows = []
    for effect, every in zip(EFFECTS, found, strict=True):
        number = sum(int(own) for own, _ in every)
        spans = [_span(along) for _, own in every for along in own]
        where = ", ".join(dict.fromkeys(filter(None, spans))) if number < size else "everywhere"
        rows.append(
            (effect.name.replace("_", " "), modes[effect.name], round(100 * number / size, 2),
             where, effect.about)
        )  # fmt: skip
    rows.sort(key=lambda row: -row[2])
    names = ["effect", "asked", "% of points", "within", "what it is"]
    caption = [
        "Asked: auto simulates an effect where leaving it out could change a probability, or the "
        "magnitude of a bin, by more than the tolerance allows.",
        "Within: the smallest part of the study that holds all points with the effect.",
    ]
    return Table("Effects", caption, pandas.DataFrame(rows, columns=names), "effects")


def _span(present: xr.DataArray) -> str:
    """Return ends of the coordinates along a dimension between which an effect is present."""
    there, told = present.values, []
    for name, coordinate in present.coords.items():
        if coordinate.ndim != 1 or there.all() or not there.any():
            continue
        if labels.is_words(coordinate.values):
            continue
        chosen = coordinate.values[there]
        units = coordinate.attrs.get("units", "")
        ends = [labels.quantity(v, units) for v in (chosen.min(), chosen.max())]
        told.append(f"{labels.coordinate(str(name))} {ends[0]} to {ends[1]}")
    return ", ".join(told)


def accuracy(dataset: xr.Dataset, spec: Declared) -> list[str]:
    """Accuracy of the results, in sentences."""
    tolerance = spec.accuracy.tolerance
    told = [
        f"Asked for: no probability of detection off by more than {tolerance:g}"
        + (f", with a confidence of {spec.accuracy.confidence:g}" if "n_draws" in dataset else "")
        + "."
    ]
    if "effects_error" in dataset:
        told.append(
            "What was left out changes a probability by "
            f"{float(dataset['effects_error'].max()):.2g} at the most, at any point."
        )
    left = float(dataset["beamlets_error"].max()) if "beamlets_error" in dataset else 0.0
    if left > 0:
        told.append(f"More beamlets would change one by {left:.2g} at the most.")
    elif math.isnan(left):
        told.append("What more beamlets would change is not checked.")
    if "n_draws" in dataset:
        missed = dataset["accuracy_missed"]
        known = int(missed.notnull().sum())
        met = int((missed <= 0).sum())
        told.append(
            f"Drawn to that accuracy at {met:,} of {known:,} points; the largest half-width of "
            f"pd_shot is {float(dataset['pd_shot_half_width'].max()):.2g}, and "
            f"{int(dataset['n_draws'].where(dataset['n_draws'] > 0).sum()):,} draws were made."
        )
    return told


def _reproduction(attributes: Mapping[Any, Any], spec: Declared, store: str) -> Section:
    """Citation of the study, and commands that make it again."""
    software = software_versions(attributes)
    version = software.get("sweep", "")
    year = str(attributes.get("finished") or attributes.get("started") or "")[:4]
    identity = f"study {attributes['study_id']}, model {attributes['model_version']}"
    cite = (
        f"{attributes['title']}. Simulated with sweep {version}, {identity}"
        f"{f', {year}' if year else ''}."
    )
    bibtex = (
        f"@misc{{sweep-{attributes['study_id'][:8]},\n"
        f"  title = {{{{{attributes['title']}}}}},\n"
        f"  howpublished = {{Simulated with sweep {version}}},\n"
        f"  note = {{{identity}}},\n" + (f"  year = {{{year}}},\n" if year else "") + "}"
    )
    text = yaml.safe_dump(spec.to_yaml_mapping(), sort_keys=False, allow_unicode=True, width=100)
    commands = "\n".join(
        [
            command_line("run", "study.yaml", store=store),
            command_line("figures", store),
            command_line("report", store),
        ]
    )
    versions = ", ".join(f"{name} {number}" for name, number in software.items())
    words = [
        f"Made with {versions}, on a processor {attributes['processor']}. The same spec, seed and "
        "versions give the same numbers, bit for bit, on any number of workers."
    ]
    return Section(
        "reproduce",
        "Cite and reproduce",
        words,
        [
            Text("Citation", [], cite),
            Text("BibTeX", [], bibtex, "study.bib"),
            Text("Commands", ["With the spec below saved as study.yaml."], commands),
            Text("Spec", ["As it was computed, every default written out."], text, "study.yaml"),
        ],
    )
