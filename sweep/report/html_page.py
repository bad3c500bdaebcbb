"""HTML pages: interactive plotly plots with controls, tables, texts, and their single file."""

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
from sweep.analysis.canvas import MARKED_POINTS_MAX
from sweep.analysis.charts import LOG, Chart, ChartAxis, ChartLine, ColourScale, Panel
from sweep.report.isolated_itables import get_itable_arguments, options

LINE_COLOURS = {
    "light": ("#0072B2", "#C44E00", "#005A4B", "#A51E78", "#78784B", "#003CD2", "#000000",
              "#784B2D"),
    "dark": ("#56B4E9", "#FF9A4D", "#3CF0C3", "#FF4BB4", "#F0E442", "#6987FF", "#FFFFFF",
             "#B4875A"),
}  # fmt: skip
"""Line colours for a light and a dark page, derived from those of Okabe and Ito (2008).

Their contrast to the page is 4.5 or more. Their CIEDE2000 distance from each other is 10 or more
(12 for the first four) for normal and colour-blind vision.
"""

DASH_STYLES = (
    "solid", "dash", "dashdot", "dot", "longdash", "longdashdot", "5px 2px 1px 2px", "2px 6px",
)  # fmt: skip
"""Dash styles of lines, so that lines differ not only by colour."""

_COLOUR_MAP_PARTS = {"light": (0.0, 0.75), "dark": (0.3, 1.0)}
"""Parts of the colour map that contrast with the page."""

_GROUND_COLOURS = {"light": ("#8a8a86", "#f2f1ec"), "dark": ("#1b1d20", "#6d7176")}

COLOUR_BAR: dict[str, Any] = {
    "orientation": "h", "x": 0.5, "yref": "container", "y": 0.91, "yanchor": "top", "len": 1.0,
    "thickness": 12,
}  # fmt: skip
"""Horizontal colour bar above the chart, which also fits narrow screens."""


@dataclass(frozen=True)
class Control:
    """Control of a plot that selects one of several options.

    `name` is the key of the choice in a trace's `meta`, and `label` its text on the page.
    `relayout` has the layout changes of each option.
    """

    name: str
    label: str
    options: Sequence[str]
    relayout: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def initial_option(self) -> int:
        """Index of the initial option: the middle one for parts of a study, else the first."""
        return (len(self.options) - 1) // 2 if self.name == "part" else 0


@dataclass(frozen=True)
class Plot:
    """Interactive chart of a page, with its controls; a control with one option is not shown.

    `meta` of a trace defines when it is shown and which colour it takes (see :func:`trace_meta`).
    With `has_cut` the page offers cuts through the first heat map. `is_tall` is for views in three
    dimensions.
    """

    heading: str
    alt: str
    caption: Sequence[str]
    figure: go.Figure
    controls: Sequence[Control] = ()
    has_cut: bool = False
    is_tall: bool = False


def trace_meta(palette_index: int | None = None, **choices: str) -> dict[str, Any]:
    """Return `meta` of a trace: the choices at which it is shown, and its index in the palette."""
    return {"when": choices} | ({} if palette_index is None else {"series": palette_index})


def to_sentences(parts: Sequence[str]) -> list[str]:
    """Return parts as sentences; skip empty parts."""
    return [labels.join_sentences([part]) for part in parts if part]


def make_plot(chart: Chart) -> Plot:
    """Return a chart as an interactive plot."""
    first_panel = chart.panels[0]
    layout_options: dict[str, Any] = {}
    area_lines = [line for line in first_panel.lines if line.style == "area"]
    if area_lines:
        layout_options = {"barmode": "stack"}
        layout_options["hovermode"] = "x unified" if area_lines[0].x.size > 1 else "closest"
    if chart.colour_scale is not None:
        layout_options |= {"margin": {"l": 10, "r": 16, "t": 88, "b": 55}}
        layout_options |= {
            "title": title_layout(
                "log10 of " * chart.colour_scale.is_log + chart.colour_scale.label
            )
        }
    return Plot(
        chart.heading,
        chart.alt,
        to_sentences(chart.caption),
        go.Figure(
            [trace for panel in chart.panels for trace in _panel_traces(panel, chart.colour_scale)],
            plot_layout(
                xaxis=_axis_layout(first_panel.x),
                yaxis=_axis_layout(first_panel.y, automargin=True),
                **layout_options,
            ),
        ),
        [_make_control(chart.panels, name, label) for name, label in chart.facet_labels.items()],
        has_cut=chart.colour_scale is not None,
    )


def _make_control(panels: Sequence[Panel], name: str, label: str) -> Control:
    """Return the control of a facet; an option changes the y axis if panels differ in it."""
    axes_by_option: dict[str, set[ChartAxis]] = {}
    for panel in panels:
        axes_by_option.setdefault(panel.facet_choices[name], set()).add(panel.y)
    relayout: dict[str, dict[str, Any]] = {}
    if (
        all(len(option_axes) == 1 for option_axes in axes_by_option.values())
        and len(set().union(*axes_by_option.values())) > 1
    ):
        for option, (axis,) in axes_by_option.items():
            axis_options = {
                k: v for k, v in _axis_layout(axis).items() if k in ("type", "range", "rangemode")
            }
            relayout[option] = {f"yaxis.{key}": value for key, value in axis_options.items()}
            relayout[option]["yaxis.title.text"] = wrap_html(axis.label, 36)
    return Control(name, label, list(axes_by_option), relayout)


def _panel_traces(panel: Panel, colour_scale: ColourScale | None) -> Iterator[Any]:
    """Yield the traces of a panel's lines, or of its map."""
    for line in panel.lines:
        yield from _line_traces(panel, line)
    if (heat_map := panel.heat_map) is None or colour_scale is None:
        return
    values, colour_limits = heat_map.values, (colour_scale.low, colour_scale.high)
    if colour_scale.is_log:
        values, colour_limits = (
            np.log10(np.where(values > 0, values, np.nan)),
            tuple(np.log10(colour_limits)),
        )
    yield go.Heatmap(
        x=_to_float32(heat_map.x),
        y=_to_float32(heat_map.y),
        z=_to_float32(values),
        zmin=colour_limits[0],
        zmax=colour_limits[1],
        colorscale="Viridis",
        colorbar=COLOUR_BAR,
        name=panel.facet_choices["part"],
        meta=trace_meta(None, **panel.facet_choices),
    )
    for level in heat_map.contour_levels:
        yield go.Contour(
            x=_to_float32(heat_map.x),
            y=_to_float32(heat_map.y),
            z=_to_float32(heat_map.values),
            name=f"{level:g}",
            contours={
                "start": level,
                "end": level,
                "size": 1,
                "coloring": "none",
                "showlabels": True,
                "labelfont": {"size": 12, "color": "white"},
            },
            line={"width": 2, "color": "white"},
            showscale=False,
            showlegend=False,
            hoverinfo="skip",
            meta=trace_meta(None, **panel.facet_choices),
        )


def _to_float32(values: np.ndarray) -> np.ndarray:
    """Return floats in single precision, which is enough for a screen."""
    return values.astype(np.float32) if values.dtype.kind == "f" else values


def _line_traces(panel: Panel, line: ChartLine) -> Iterator[go.Scatter | go.Bar]:
    """Yield the traces of a line, preceded by its band if it has one."""
    meta = trace_meta(line.style_index, **panel.facet_choices)
    if panel.y.kind == LOG:
        line = _mask_nonpositive(line)
    x, y, low, high = line.x, line.y, line.low, line.high
    trace_options: dict[str, Any] = {
        "x": _to_float32(x), "y": _to_float32(y), "name": line.name, "meta": meta,
        "legendgroup": f"{line.style_index}", "showlegend": bool(line.name),
    }  # fmt: skip
    if line.hover_texts:
        trace_options |= {"text": list(line.hover_texts)}
    dash = DASH_STYLES[line.style_index % len(DASH_STYLES)]
    mode = "lines+markers" if x.size <= MARKED_POINTS_MAX else "lines"
    if line.style == "area":
        hover_template = "%{y:.3g} %" + ", %{text}" * bool(line.hover_texts)
        if x.size == 1:
            yield go.Bar(
                textposition="none",
                hovertemplate=hover_template,
                **trace_options | {"x": ["the point"]},
            )
        else:
            stack_group = panel.title or "all"
            yield go.Scatter(
                mode="lines", stackgroup=stack_group, hovertemplate=hover_template, **trace_options
            )
    elif line.style == "dots":
        marker = {"size": 9 if x.size <= MARKED_POINTS_MAX else 5, "symbol": line.style_index % 8}
        yield go.Scatter(mode="markers", marker=marker, **trace_options)
    elif line.style == "level":
        yield go.Scatter(
            mode="lines", line={"width": 1, "color": "#888"}, hoverinfo="skip",
            **trace_options | {"meta": trace_meta(None, **panel.facet_choices)},
        )  # fmt: skip
    else:
        if low is not None and high is not None:
            if line.style == "bars":
                trace_options |= {"error_y": {"array": _to_float32(high - y), "width": 2}}
            else:
                yield _band_trace(line, x, low, high, meta)
        is_stated = line.style == "stated"
        line_options = {"dash": "dot" if is_stated else dash, "width": 2}
        connects_gaps = line.style in ("stated", "bars")
        yield go.Scatter(mode=mode, line=line_options, connectgaps=connects_gaps, **trace_options)


def _mask_nonpositive(line: ChartLine) -> ChartLine:
    """Return a line with nan for values that a logarithmic axis can't show."""
    masked_values: dict[str, Any] = {
        name: np.where(values > 0, values, np.nan)
        for name, values in (("y", line.y), ("low", line.low), ("high", line.high))
        if values is not None
    }
    return replace(line, **masked_values)


def _band_trace(
    line: ChartLine, x: np.ndarray, low: np.ndarray, high: np.ndarray, meta: dict[str, Any]
) -> go.Scatter:
    """Return the trace of the area between the ends of a line's band."""
    finite_indices = np.flatnonzero(np.isfinite(low) & np.isfinite(high))
    reversed_indices = finite_indices[::-1]
    return go.Scatter(
        x=_to_float32(np.concatenate([x[finite_indices], x[reversed_indices]])),
        y=_to_float32(np.concatenate([high[finite_indices], low[reversed_indices]])),
        fill="toself",
        mode="none",
        hoverinfo="skip",
        showlegend=False,
        legendgroup=f"{line.style_index}",
        meta=meta | {"band": True},
    )


def colour_themes() -> dict[str, Any]:
    """Return palette, colour scales and template of each colour scheme, for the page's script."""
    fractions, colours = np.linspace(0, 1, 11), colormaps[canvas.COLOUR_MAP_NAME]
    return {
        scheme: {
            "lines": LINE_COLOURS[scheme],
            "scale": [[float(s), to_hex(colours(low + (high - low) * s))] for s in fractions],
            "ground": [[0, _GROUND_COLOURS[scheme][0]], [1, _GROUND_COLOURS[scheme][1]]],
            "template": plotly.io.templates[template].to_plotly_json(),
        }
        for scheme, template in (("light", "plotly_white"), ("dark", "plotly_dark"))
        for low, high in [_COLOUR_MAP_PARTS[scheme]]
    }


def plot_layout(**options_set: Any) -> dict[str, Any]:
    """Return the layout of a plot: legend above, margins for labels, no title."""
    default_options: dict[str, Any] = {
        "margin": {"l": 10, "r": 16, "t": 30, "b": 55},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom",
                   "itemsizing": "constant", "font": {"size": 11}},
        "hovermode": "closest",
        "uirevision": "kept",
        "font": {"size": 13},
    }  # fmt: skip
    return default_options | options_set


def wrap_html(text: str, width: int = 44) -> str:
    """Return text with line breaks in HTML, so that it fits next to a plot."""
    return "<br>".join(textwrap.wrap(text, width, break_on_hyphens=False))


def _axis_layout(axis: ChartAxis, **options_set: Any) -> dict[str, Any]:
    """Return the layout of an axis: title, scale and limits."""
    label = wrap_html(axis.label) if options_set else axis.label
    axis_options = {"title": {"text": label, "standoff": 12}, "zeroline": False, "type": axis.kind}
    if axis.limits is not None:
        axis_options |= (
            {"rangemode": "tozero"} if None in axis.limits else {"range": list(axis.limits)}
        )
    if axis.kind == "log":
        axis_options["nticks"] = (
            6  # few ticks, so that only decades are labelled and not 2 and 5 between them
        )
    if axis.label.startswith("number of") and axis.kind == "linear":  # 8,000, not 8 x 10^3
        return axis_options | {"exponentformat": "none", "separatethousands": True} | options_set
    return axis_options | {"exponentformat": "power"} | options_set


def title_layout(text: str) -> dict[str, Any]:
    """Return the layout of the title above the colour bar."""
    return {
        "text": wrap_html(text, 48), "x": 0.5, "xanchor": "center", "yref": "container", "y": 1,
        "yanchor": "top", "pad": {"t": 2}, "font": {"size": 15},
    }  # fmt: skip


@dataclass(frozen=True)
class HtmlTable:
    """Table that the reader can sort, search and download as `file`.csv, below a caption."""

    heading: str
    caption: Sequence[str]
    frame: pandas.DataFrame
    file: str


@dataclass(frozen=True)
class TextItem:
    """Preformatted text to read, copy, or download as `file`; '' for no download."""

    heading: str
    caption: Sequence[str]
    text: str
    file: str = ""


PageItem = Plot | HtmlTable | TextItem
"""Item of a page's section."""


@dataclass(frozen=True)
class PageSection:
    """Section of a page: paragraphs and items; `anchor` is its name in links."""

    anchor: str
    title: str
    paragraphs: Sequence[str] = ()
    items: Sequence[PageItem] = ()


@dataclass(frozen=True)
class ReportPage:
    """Complete report: key facts, important remarks, and sections in order."""

    title: str
    question: str
    facts: Sequence[tuple[str, str]]
    remarks: Sequence[str]
    sections: Sequence[PageSection]


TABLE_ROWS_SHOWN = 10
"""Number of table rows that are shown at once."""


LONG_CELL_CHARACTERS = 40
"""Length above which the text of a cell counts as a sentence [characters]."""


def render_html(page: ReportPage) -> str:
    """Return the page as HTML."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sweep.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals |= {
        "packed": _compress_base64,
        "table_json": _table_json,
        "download": _data_url,
    }
    environment.globals |= {"chart_json": _chart_json}
    script_path = Path(options.dt_bundle)
    return environment.get_template("report.html").render(
        page=page,
        plotly=get_plotlyjs(),
        tables=script_path.read_text(encoding="utf-8"),
        tables_style=script_path.with_suffix(".css").read_text(encoding="utf-8"),
        themes=to_json_plotly(colour_themes()),
    )


def _compress_base64(text: str) -> str:
    """Return text compressed by gzip and encoded in base64, about a third of its size."""
    return b64encode(gzip.compress(text.encode(), mtime=0)).decode()


def _chart_json(plot: Plot) -> str:
    """Return the JSON of a plot for the page's script."""
    relayouts: dict[str, Any] = {c.name: dict(c.relayout) for c in plot.controls if c.relayout}
    content = {"figure": plot.figure.to_dict(), "relayouts": relayouts, "cut": plot.has_cut}
    return str(to_json_plotly(content))


def _table_json(table: HtmlTable) -> str:
    """Return the JSON of a table for the page's script, including its sorting and download."""
    csv_button = {"extend": "csvHtml5", "text": "Download CSV", "filename": table.file}
    widths = table.frame.map(lambda cell: len(str(cell))).max()
    with pandas.option_context("display.float_format", "{:.6g}".format):
        arguments = get_itable_arguments(
            table.frame,
            showIndex=False,
            maxBytes=0,
            maxColumns=0,
            pageLength=TABLE_ROWS_SHOWN,
            columnDefs=[
                {
                    "targets": np.flatnonzero(widths > LONG_CELL_CHARACTERS).tolist(),
                    "className": "long",
                }
            ],
            buttons=[csv_button, "copyHtml5"],
        )
    # The template sets class and style, which the script does not accept as options. Keys are
    # sorted, because the order of itables' options varies from run to run.
    table_options = {k: v for k, v in arguments.items() if k not in ("classes", "style")}
    return json.dumps(table_options, sort_keys=True)


def _data_url(text_item: TextItem) -> str:
    """Return a text as a data URL, which the browser can save."""
    return f"data:text/plain;charset=utf-8;base64,{b64encode(text_item.text.encode()).decode()}"
