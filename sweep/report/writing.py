"""The report of a store: what is on it, in which order, and the file that it becomes."""

from __future__ import annotations

import os
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import itables.options
import jinja2
import numpy as np
import pandas
import plotly.graph_objects as go
from itables import to_html_datatable
from itables.javascript import generate_init_offline_itables_html
from markupsafe import Markup
from plotly.io.json import to_json_plotly
from plotly.offline import get_plotlyjs

from sweep.analysis import along, labels
from sweep.analysis.cells import known
from sweep.analysis.cuts import GRAZING_ANGLE, RANGE, coordinate_of
from sweep.analysis.defaults import default_figures
from sweep.analysis.figures import Study, made_page
from sweep.analysis.mean_table import outputs_page
from sweep.analysis.opening import ACCURACY, GRID, SCENE, NotAStoreError, read_attributes
from sweep.analysis.scenes.figures import SceneStudy
from sweep.analysis.scenes.quantities import INTERPOLATED, QUANTITIES, shown
from sweep.analysis.scenes.recording import Thinned
from sweep.analysis.selection import Points, split, spread
from sweep.analysis.slices import MOST_LINES
from sweep.analysis.tabular import Page as TablePage
from sweep.report import asked, clouds, detector, flights, heat_maps, lines, looks, wording
from sweep.report.choosing import MOST_PARTS
from sweep.report.clouds import Seen
from sweep.report.page import Chart, Control, Page, Section, Table, Text
from sweep.spec import Slices, Surface
from sweep.storage.locations import Location, located

PD = 0.9

KEPT = "kept all the way"
ANSWERS = {KEPT: "unbroken", "reached at all": "farthest"}
"""Answers of :func:`.limits.limit` by what is chosen of them."""

ENDS = {"low": "lower end", "high": "upper end"}

TOLD = [
    f"Kept all the way: up to here the probability of detection of a shot is {PD:g} or more at "
    "every range of the study; reached at all: the farthest range at which it is.",
    "Between ranges it is interpolated in its normal deviate.",
    f"There is none where it is below {PD:g} from the first range on, not below it at the last, or "
    "not computed.",
]


def chart(study: Study) -> Chart | Table | None:
    """Maximum range along another coordinate; a table where there is none to go along.

    None where range does not vary.
    """
    member = coordinate_of(study.spec, RANGE)
    if member is None:
        return None
    ruler = wording.Ruler.of(study, member.name, np.asarray(member.display))
    pieces, fewer = _pieces(study, member.name)
    reaches = [(words, _reach(piece, member.name, ruler.factor)) for words, piece in pieces]
    if not reaches:
        return None
    words = labels.with_units("maximum range", ruler.units)
    x = _along(study, reaches[0][1])
    if not x:
        return _reach_table(reaches, words)
    parts, by, lacking = _parts(reaches, x)
    return _chart(study, parts, (x, by), words, wording.left_out(fewer + lacking))


def _pieces(study: Study, name: str) -> tuple[list[tuple[str, Points]], int]:
    """Points with several ranges, apart by what varies with range along a zipped axis."""
    found = study.points
    apart, _ = split(found, found.axes[found.axis_of(name)].further([name]), found.size)
    several = [(words, own) for words, own in apart if len(own.distinct(name)) > 1]
    return spread(several, MOST_PARTS)


def _reach(piece: Points, name: str, factor: float) -> Points:
    """The maximum range in the units shown, with what it varies over; not computed."""
    dim = piece.axis_of(name)
    positions = np.sort(piece.side(name).positions)
    dataset = piece.dataset
    if positions.size < dataset.sizes[dim]:
        dataset = dataset.isel({dim: positions})
    reach = dataset.sweep.maximum_range(PD)
    in_units = {
        str(own): (array * factor).assign_attrs(array.attrs)
        for own, array in reach.data_vars.items()
        if not str(own).endswith("reason")
    }
    return Points.of(reach.assign(in_units))


def _along(study: Study, found: Points) -> str:
    """The grazing angle where it varies, else the longest coordinate of numbers; empty for none."""
    varying = found.varying()
    angle = coordinate_of(study.spec, GRAZING_ANGLE)
    if angle is not None and angle.name in varying:
        return angle.name
    numbers = [name for name in varying if not labels.is_words(found.column(name).values)]
    return max(numbers or varying, key=lambda name: len(found.distinct(name)), default="")


def _parts(
    reaches: list[tuple[str, Points]], x: str
) -> tuple[list[tuple[str, Points]], list[str], int]:
    """Parts of which one is shown at a time, what their lines are for, how many are left out."""
    first = reaches[0][1]
    by = [name for name in first.further([x]) if len(first.distinct(name)) <= MOST_LINES][:1]
    parts, fewer = [], 0
    for words, reach in reaches:
        own, lacking = split(reach, reach.further([x, *by]), MOST_PARTS)
        parts += [(", ".join(filter(None, (words, told))), part) for told, part in own]
        fewer += lacking
    return parts[:MOST_PARTS], by, fewer + max(0, len(parts) - MOST_PARTS)


def _chart(
    study: Study, parts: list[tuple[str, Points]], over: tuple[str, list[str]], words: str,
    left_out: str,
) -> Chart:  # fmt: skip
    x, by = over
    named, _ = lines.lines_of(parts, by)
    pairs = [(own.points, answer) for answer in ANSWERS.values() for own in named]
    both = along.lines(pairs, x)
    made = dict(zip(ANSWERS, (both[: len(named)], both[len(named) :]), strict=True))
    ruler = wording.Ruler.of(study, x, lines.longest(named, x))
    return Chart(
        heading=f"Maximum range at a pd of {PD:g}",
        alt=lines.alternative(
            f"{words} at a probability of detection of {PD:g}",
            ruler.span(lines.longest(named, x)), named, made[KEPT],
        ),
        caption=wording.sentences([*TOLD, *lines.remarks(made[KEPT]), left_out]),
        figure=go.Figure(
            [
                trace
                for choice, drawn in made.items()
                for own, line in zip(named, drawn, strict=True)
                for trace in lines.traces(own, line, ruler, answer=choice)
            ],
            looks.layout(xaxis=ruler.axis, yaxis=looks.upright(words, rangemode="tozero")),
        ),
        controls=[
            Control("part", "Shown for", [part for part, _ in parts]),
            Control("answer", f"A pd of {PD:g}", list(ANSWERS)),
        ],
    )  # fmt: skip


def _reach_table(reaches: list[tuple[str, Points]], words: str) -> Table:
    """Both answers of each part, with their intervals or why there are none."""
    rows: list[tuple[str | float, ...]] = []
    columns: list[str] = []
    for part, found in reaches:
        reach = found.dataset.isel(found.first()).compute()
        meanings = str(reach["unbroken_reason"].attrs["flag_meanings"]).split()
        for choice, answer in ANSWERS.items():
            ends = {end: f"{answer}_{end}" for end in ENDS if f"{answer}_{end}" in reach}
            columns = ["for", f"a pd of {PD:g}", words, *(ENDS[end] for end in ends), "which is"]
            values = [reach[name].item() for name in (answer, *ends.values())]
            told = meanings[int(reach[f"{answer}_reason"])].replace("_", " ")
            rows.append((part, choice, *values, told))
    frame = pandas.DataFrame(rows, columns=columns)
    if not any(part for part, _ in reaches):
        frame = frame.drop(columns="for")
    return Table(f"Maximum range at a pd of {PD:g}", TOLD, frame, "maximum_range")


ROWS = 10
"""Rows of a table that are shown at a time."""


LONG = 40
"""Characters from which on a cell holds a sentence."""


def rendered(page: Page) -> str:
    """The page as the text of a file."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sweep.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {"table": _table, "chart_json": _chart_json, "download": _download}
    environment.tests |= {
        "chart": lambda item: isinstance(item, Chart),
        "sheet": lambda item: isinstance(item, Table),
        "text": lambda item: isinstance(item, Text),
    }
    return environment.get_template("report.html").render(
        page=page,
        plotly=Markup(get_plotlyjs().replace("</script", "<\\/script")),
        tables=Markup(generate_init_offline_itables_html(itables.options.dt_bundle)),
        themes=_in_script(to_json_plotly(looks.themes())),
    )


def _in_script(json_text: str) -> Markup:
    """JSON that can stand in a page, whatever words it holds."""
    return Markup(json_text.replace("<", "\\u003c").replace("&", "\\u0026"))


def _chart_json(chart: Chart) -> Markup:
    """What the page's script needs of a chart."""
    relayouts: dict[str, Any] = {c.name: dict(c.relayout) for c in chart.controls if c.relayout}
    return _in_script(
        to_json_plotly({"figure": chart.figure.to_dict(), "relayouts": relayouts, "cut": chart.cut})
    )


def _table(table: Table, number: int) -> Markup:
    """A table with its sorting, searching and downloading."""
    csv = {"extend": "csvHtml5", "text": "Download CSV", "filename": table.file}
    with pandas.option_context("display.float_format", "{:.6g}".format):
        return Markup(_datatable(table.frame, number, csv))


def _datatable(frame: pandas.DataFrame, number: int, csv: dict[str, str]) -> str:
    return str(
        to_html_datatable(
            frame,
            connected=False,
            table_id=f"table-{number}",
            showIndex=False,
            maxBytes=0,
            maxColumns=0,
            classes="display compact",
            style="width:100%",
            columnDefs=[{"targets": _long(frame), "className": "long"}],
            buttons=[csv, "copyHtml5"],
            pageLength=ROWS,
            display_logo_when_loading=False,
        )
    )


def _long(frame: pandas.DataFrame) -> list[int]:
    """Columns of sentences, which need some width."""
    return [
        i
        for i, name in enumerate(frame.columns)
        if frame[name].map(lambda cell: len(str(cell))).max() > LONG
    ]


def _download(text: Text) -> str:
    """A text as an address that can be saved."""
    return f"data:text/plain;charset=utf-8;base64,{b64encode(text.text.encode()).decode()}"


MOST_ROWS = 1000

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


def grid_points(study: Study) -> Table | None:
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
    frame = frame.rename(columns={c: _headed(c, dataset[c].attrs) for c in frame.columns})
    total = int(np.prod(list(dims.values())))
    return Table("Points", _told(len(frame), total), frame, "points")


def _headed(name: str, attributes: dict[str, str]) -> str:
    units = str(attributes.get("units", ""))
    return name if units in ("", "1") else f"{name} [{units}]"


def _told(rows: int, total: int) -> list[str]:
    if rows == total:
        return [f"All {total:,} points."]
    return [
        f"{rows:,} of {total:,} points, spread over all: reduced for this page. The store has "
        "every one."
    ]


def cloud_points(found: list[Seen]) -> Table:
    """Points of clouds of the first draw, with what a reader wants of each."""
    frames, total = [], 0
    for seen in found:
        rows = Thinned(MOST_ROWS // len(found))
        for part in seen.recording.stretches():
            rows.add(seen.recording.points(list(OF_POINTS), part, ranges=INTERPOLATED))
        total += rows.total
        if rows.total:
            table = rows.rows()
            columns = {
                _unit(name): shown(name, values) if name != "flags" else values
                for name, values in table.items()
            }
            frames.append(pandas.DataFrame({"recorded by": seen.words or "the scanner"} | columns))
    frame = pandas.concat(frames, ignore_index=True) if frames else pandas.DataFrame()
    return Table("Points", _told(len(frame), total), frame, "points")


def _unit(name: str) -> str:
    units = "dB" if name == "snr" else QUANTITIES[name].units
    return name if units in ("", "1") else f"{name} [{units}]"


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
    figures.append(chart(study))
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
    points = grid_points(study)
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
    points = cloud_points(seen)
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
