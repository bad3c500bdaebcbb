"""Pages: charts drawn by plotly with their choices, tables, texts, and the one file of all."""

from __future__ import annotations

import gzip
import json
import textwrap
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pandas
import plotly.graph_objects as go
import plotly.io
from matplotlib import colormaps
from matplotlib.colors import to_hex
from plotly.io.json import to_json_plotly
from plotly.offline import get_plotlyjs

from sweep.analysis import canvas, labels
from sweep.analysis.canvas import MARKED
from sweep.analysis.charts import LOG, Axis, Chart, Line, Panel, Scale
from sweep.report.itables_alone import get_itable_arguments, options

LINES = {
    "light": ("#0072B2", "#C44E00", "#005A4B", "#A51E78", "#78784B", "#003CD2", "#000000",
              "#784B2D"),
    "dark": ("#56B4E9", "#FF9A4D", "#3CF0C3", "#FF4BB4", "#F0E442", "#6987FF", "#FFFFFF",
             "#B4875A"),
}  # fmt: skip
"""At a contrast of 4.5 or more to the page, and at a CIEDE2000 of 10 or more from each other for
every eye (the first four 12): found from the colours of Okabe and Ito (2008)."""

DASHES = (
    "solid", "dash", "dashdot", "dot", "longdash", "longdashdot", "5px 2px 1px 2px", "2px 6px",
)  # fmt: skip
"""Lines differ in these as well, so that colour is not all that tells them apart."""

_ENDS = {"light": (0.0, 0.75), "dark": (0.3, 1.0)}
"""Parts of the colour scale that stand out from the page."""

_GROUND = {"light": ("#8a8a86", "#f2f1ec"), "dark": ("#1b1d20", "#6d7176")}

COLOUR_BAR: dict[str, Any] = {
    "orientation": "h", "x": 0.5, "yref": "container", "y": 0.91, "yanchor": "top", "len": 1.0,
    "thickness": 12,
}  # fmt: skip
"""A colour bar over the chart, as wide as it is, which suits narrow screens too."""


@dataclass(frozen=True)
class Control:
    """A choice that a plot offers: its name as traces call it, and the text next to it.

    `relayout` is what each option changes of the layout.
    """

    name: str
    label: str
    options: Sequence[str]
    relayout: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def start(self) -> int:
        """The option chosen at the start: the middle one of a study's parts, else the first."""
        return (len(self.options) - 1) // 2 if self.name == "part" else 0


@dataclass(frozen=True)
class Plot:
    """A chart as a page shows it, with its choices; one of a single option is left out.

    `meta` of a trace says when it is shown and which colour it takes (see :func:`when`). The first
    heat map shown may be `cut` along either side; a solid view is `tall`.
    """

    heading: str
    alt: str
    caption: Sequence[str]
    figure: go.Figure
    controls: Sequence[Control] = ()
    cut: bool = False
    tall: bool = False


def when(series: int | None = None, **choices: str) -> dict[str, Any]:
    """`meta` of a trace: at which choices it is shown, and which colour of the palette it takes."""
    return {"when": choices} | ({} if series is None else {"series": series})


def sentences(parts: Sequence[str]) -> list[str]:
    """Parts as sentences, empty ones left out."""
    return [labels.joined([part]) for part in parts if part]


def plot(chart: Chart) -> Plot:
    """Return a chart to choose from, hover and zoom."""
    first = chart.panels[0]
    further: dict[str, Any] = {}
    areas = [line for line in first.lines if line.look == "area"]
    if areas:
        further = {"barmode": "stack"}
        further["hovermode"] = "x unified" if areas[0].x.size > 1 else "closest"
    if chart.scale is not None:
        further |= {"margin": {"l": 10, "r": 16, "t": 88, "b": 55}}
        further |= {"title": title("log10 of " * chart.scale.decades + chart.scale.words)}
    return Plot(
        chart.heading,
        chart.alt,
        sentences(chart.caption),
        go.Figure(
            [trace for panel in chart.panels for trace in _traces(panel, chart.scale)],
            layout(xaxis=_axis(first.x), yaxis=_axis(first.y, automargin=True), **further),
        ),
        [_control(chart.panels, name, label) for name, label in chart.facets.items()],
        cut=chart.scale is not None,
    )


def _control(panels: Sequence[Panel], name: str, label: str) -> Control:
    """Return the choice of a facet's options, which may change the upright axis."""
    axes: dict[str, set[Axis]] = {}
    for panel in panels:
        axes.setdefault(panel.when[name], set()).add(panel.y)
    relayout: dict[str, dict[str, Any]] = {}
    if all(len(own) == 1 for own in axes.values()) and len(set().union(*axes.values())) > 1:
        for option, (axis,) in axes.items():
            kept = {k: v for k, v in _axis(axis).items() if k in ("type", "range", "rangemode")}
            relayout[option] = {f"yaxis.{key}": value for key, value in kept.items()}
            relayout[option]["yaxis.title.text"] = broken(axis.words, 36)
    return Control(name, label, list(axes), relayout)


def _traces(panel: Panel, scale: Scale | None) -> Iterator[Any]:
    """Traces of a panel's lines, or of its map."""
    for line in panel.lines:
        yield from _line(panel, line)
    if (layer := panel.map) is None or scale is None:
        return
    values, ends = layer.values, (scale.low, scale.high)
    if scale.decades:
        values, ends = np.log10(np.where(values > 0, values, np.nan)), tuple(np.log10(ends))
    yield go.Heatmap(
        x=_short(layer.x), y=_short(layer.y), z=_short(values), zmin=ends[0], zmax=ends[1],
        colorscale="Viridis", colorbar=COLOUR_BAR, name=panel.when["part"],
        meta=when(None, **panel.when),
    )  # fmt: skip
    for level in layer.levels:
        yield go.Contour(
            x=_short(layer.x), y=_short(layer.y), z=_short(layer.values), name=f"{level:g}",
            contours={"start": level, "end": level, "size": 1, "coloring": "none",
                      "showlabels": True, "labelfont": {"size": 12, "color": "white"}},
            line={"width": 2, "color": "white"}, showscale=False, showlegend=False,
            hoverinfo="skip", meta=when(None, **panel.when),
        )  # fmt: skip


def _short(values: np.ndarray) -> np.ndarray:
    """Numbers in the digits that a screen can show."""
    return values.astype(np.float32) if values.dtype.kind == "f" else values


def _line(panel: Panel, line: Line) -> Iterator[go.Scatter | go.Bar]:
    """Return the line, over its band where it has one."""
    meta = when(line.number, **panel.when)
    if panel.y.kind == LOG:
        line = _above_zero(line)
    x, y, low, high = line.x, line.y, line.low, line.high
    common: dict[str, Any] = {
        "x": _short(x), "y": _short(y), "name": line.name, "meta": meta,
        "legendgroup": f"{line.number}", "showlegend": bool(line.name),
    }  # fmt: skip
    if line.told:
        common |= {"text": list(line.told)}
    dash = DASHES[line.number % len(DASHES)]
    mode = "lines+markers" if x.size <= MARKED else "lines"
    if line.look == "area":
        hover = "%{y:.3g} %" + ", %{text}" * bool(line.told)
        if x.size == 1:
            yield go.Bar(textposition="none", hovertemplate=hover, **common | {"x": ["the point"]})
        else:
            group = panel.title or "all"
            yield go.Scatter(mode="lines", stackgroup=group, hovertemplate=hover, **common)
    elif line.look == "dots":
        marker = {"size": 9 if x.size <= MARKED else 5, "symbol": line.number % 8}
        yield go.Scatter(mode="markers", marker=marker, **common)
    elif line.look == "level":
        yield go.Scatter(
            mode="lines", line={"width": 1, "color": "#888"}, hoverinfo="skip",
            **common | {"meta": when(None, **panel.when)},
        )  # fmt: skip
    else:
        if low is not None and high is not None:
            if line.look == "bars":
                common |= {"error_y": {"array": _short(high - y), "width": 2}}
            else:
                yield _band(line, x, low, high, meta)
        stated = line.look == "stated"
        look = {"dash": "dot" if stated else dash, "width": 2}
        gaps = line.look in ("stated", "bars")
        yield go.Scatter(mode=mode, line=look, connectgaps=gaps, **common)


def _above_zero(line: Line) -> Line:
    """Return the line where it is above zero, as an axis of decades needs."""
    ends: dict[str, Any] = {
        name: np.where(values > 0, values, np.nan)
        for name, values in (("y", line.y), ("low", line.low), ("high", line.high))
        if values is not None
    }
    return replace(line, **ends)


def _band(
    line: Line, x: np.ndarray, low: np.ndarray, high: np.ndarray, meta: dict[str, Any]
) -> go.Scatter:
    """Return the area between the ends of a line's band."""
    known = np.flatnonzero(np.isfinite(low) & np.isfinite(high))
    back = known[::-1]
    return go.Scatter(
        x=_short(np.concatenate([x[known], x[back]])),
        y=_short(np.concatenate([high[known], low[back]])), fill="toself", mode="none",
        hoverinfo="skip", showlegend=False, legendgroup=f"{line.number}",
        meta=meta | {"band": True},
    )  # fmt: skip


def themes() -> dict[str, Any]:
    """Palette, scales and template of each colour scheme, for the page's script."""
    stops, colours = np.linspace(0, 1, 11), colormaps[canvas.SCALE]
    return {
        scheme: {
            "lines": LINES[scheme],
            "scale": [[float(s), to_hex(colours(low + (high - low) * s))] for s in stops],
            "ground": [[0, _GROUND[scheme][0]], [1, _GROUND[scheme][1]]],
            "template": plotly.io.templates[template].to_plotly_json(),
        }
        for scheme, template in (("light", "plotly_white"), ("dark", "plotly_dark"))
        for low, high in [_ENDS[scheme]]
    }


def layout(**further: Any) -> dict[str, Any]:
    """Layout of a plot: legend above, no title (the page has it), room for labels."""
    common: dict[str, Any] = {
        "margin": {"l": 10, "r": 16, "t": 30, "b": 55},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom",
                   "itemsizing": "constant", "font": {"size": 11}},
        "hovermode": "closest",
        "uirevision": "kept",
        "font": {"size": 13},
    }  # fmt: skip
    return common | further


def broken(words: str, width: int = 44) -> str:
    """Words in lines that fit next to a plot."""
    return "<br>".join(textwrap.wrap(words, width, break_on_hyphens=False))


def _axis(axis: Axis, **further: Any) -> dict[str, Any]:
    """Return an axis with its name, kind and ends."""
    words = broken(axis.words) if further else axis.words
    made = {"title": {"text": words, "standoff": 12}, "zeroline": False, "type": axis.kind}
    if axis.limits is not None:
        made |= {"rangemode": "tozero"} if None in axis.limits else {"range": list(axis.limits)}
    if axis.kind == "log":
        made["nticks"] = 6  # decades without digits 2 and 5 between them, unless there are few
    if axis.words.startswith("number of") and axis.kind == "linear":  # 8,000 rather than 0.8 10^4
        return made | {"exponentformat": "none", "separatethousands": True} | further
    return made | {"exponentformat": "power"} | further


def title(words: str) -> dict[str, Any]:
    """Title over the bar of colours."""
    return {
        "text": broken(words, 48), "x": 0.5, "xanchor": "center", "yref": "container", "y": 1,
        "yanchor": "top", "pad": {"t": 2}, "font": {"size": 15},
    }  # fmt: skip


@dataclass(frozen=True)
class Table:
    """Rows that can be sorted, searched and downloaded as `file`.csv, under some sentences."""

    heading: str
    caption: Sequence[str]
    frame: pandas.DataFrame
    file: str


@dataclass(frozen=True)
class Text:
    """Text that keeps its lines, to read, copy or download as `file` (empty: not to download)."""

    heading: str
    caption: Sequence[str]
    text: str
    file: str = ""


Item = Plot | Table | Text


@dataclass(frozen=True)
class Section:
    """A part of the page, with paragraphs at its head; the anchor is its name in addresses."""

    anchor: str
    title: str
    words: Sequence[str] = ()
    items: Sequence[Item] = ()


@dataclass(frozen=True)
class Page:
    """A whole report: facts to know first, remarks not to be overlooked, sections in order."""

    title: str
    question: str
    facts: Sequence[tuple[str, str]]
    remarks: Sequence[str]
    sections: Sequence[Section]


ROWS = 10
"""Rows of a table that are shown at a time."""


LONG = 40
"""Characters from which on a cell holds a sentence."""


def rendered(page: Page) -> str:
    """Return the page as the text of a file."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sweep.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {"packed": _packed, "table_json": _table_json, "download": _download}
    environment.globals |= {"chart_json": _chart_json}
    tables = Path(options.dt_bundle)
    return environment.get_template("report.html").render(
        page=page,
        plotly=get_plotlyjs(),
        tables=tables.read_text(encoding="utf-8"),
        tables_style=tables.with_suffix(".css").read_text(encoding="utf-8"),
        themes=to_json_plotly(themes()),
    )


def _packed(text: str) -> str:
    """Text compressed, a third of what it is, in letters that can stand in a page."""
    return b64encode(gzip.compress(text.encode(), mtime=0)).decode()


def _chart_json(plot: Plot) -> str:
    """JSON of a plot for the page's script."""
    relayouts: dict[str, Any] = {c.name: dict(c.relayout) for c in plot.controls if c.relayout}
    made = {"figure": plot.figure.to_dict(), "relayouts": relayouts, "cut": plot.cut}
    return str(to_json_plotly(made))


def _table_json(table: Table) -> str:
    """JSON of a table for the page's script, with its sorting, searching and downloading."""
    csv = {"extend": "csvHtml5", "text": "Download CSV", "filename": table.file}
    widths = table.frame.map(lambda cell: len(str(cell))).max()
    with pandas.option_context("display.float_format", "{:.6g}".format):
        made = get_itable_arguments(
            table.frame, showIndex=False, maxBytes=0, maxColumns=0, pageLength=ROWS,
            columnDefs=[{"targets": np.flatnonzero(widths > LONG).tolist(), "className": "long"}],
            buttons=[csv, "copyHtml5"],
        )  # fmt: skip
    # As words the library refuses them here; the template has the class. It lists its options
    # in another order from run to run.
    options = {k: v for k, v in made.items() if k not in ("classes", "style")}
    return json.dumps(options, sort_keys=True)


def _download(text: Text) -> str:
    """Return a text as an address that can be saved."""
    return f"data:text/plain;charset=utf-8;base64,{b64encode(text.text.encode()).decode()}"
