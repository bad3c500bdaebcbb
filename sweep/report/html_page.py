"""HTML pages in a single file: interactive plots by plotly, with controls, tables and texts."""

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
from sweep.analysis.charts import LOG_SCALE, Chart, ChartAxis, ChartLine, ColourScale, Panel
from sweep.report.isolated_itables import get_itable_arguments, options

PAGE_LINE_COLOURS = {
    "light": ("#0072B2", "#C44E00", "#005A4B", "#A51E78", "#78784B", "#003CD2", "#000000",
              "#784B2D"),
    "dark": ("#56B4E9", "#FF9A4D", "#3CF0C3", "#FF4BB4", "#F0E442", "#6987FF", "#FFFFFF",
             "#B4875A"),
}  # fmt: skip
"""Colours of lines on a light and on a dark page, derived from those of Okabe and Ito (2008).

The contrast of each colour to the page is 4.5 or more. For normal and colour-blind vision, the
CIEDE2000 distance between two colours is 10 or more, and 12 or more among the first four.
"""

PLOTLY_DASH_STYLES = (
    "solid", "dash", "dashdot", "dot", "longdash", "longdashdot", "5px 2px 1px 2px", "2px 6px",
)  # fmt: skip
"""Dash styles of lines in plotly's notation, by which lines differ in addition to colour."""

_COLOUR_MAP_SPANS = {"light": (0.0, 0.75), "dark": (0.3, 1.0)}
"""Part of the colour map, within 0..1, that contrasts with a light and with a dark page."""

_GROUND_COLOURS = {"light": ("#8a8a86", "#f2f1ec"), "dark": ("#1b1d20", "#6d7176")}
"""Colours of the darkest and the brightest terrain, for a light and for a dark page."""

COLOUR_BAR_LAYOUT: dict[str, Any] = {
    "orientation": "h", "x": 0.5, "yref": "container", "y": 0.91, "yanchor": "top", "len": 1.0,
    "thickness": 12,
}  # fmt: skip
"""Layout of the colour bar: horizontal above the plot, which also fits narrow screens."""


@dataclass(frozen=True)
class PlotControl:
    """Control of a plot by which the reader selects one of several options."""

    name: str
    """Name of the control, by which the `meta` of traces refers to it (:func:`trace_meta`)."""
    label: str
    """Label of the control on the page."""
    options: Sequence[str]
    """Texts of the options, in order."""
    relayout_by_option: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Changes of plotly's layout that choosing an option makes, by option."""

    @property
    def initial_option_index(self) -> int:
        """Index of the option that a page shows first.

        It is the middle option if the control selects a part of the study, otherwise the first.
        """
        return (len(self.options) - 1) // 2 if self.name == "part" else 0


@dataclass(frozen=True)
class InteractivePlot:
    """Interactive plot of a page, with its controls."""

    heading: str
    """Heading above the plot."""
    alt: str
    """Text for readers who can't see the plot."""
    caption: Sequence[str]
    """Sentences of the caption."""
    figure: go.Figure
    """Figure of plotly. The `meta` of its traces state when they are shown (:func:`trace_meta`)."""
    controls: Sequence[PlotControl] = ()
    """Controls of the plot. Controls with a single option are hidden."""
    offers_cuts: bool = False
    """True if the reader can show cuts (rows and columns) of the plot's first heat map."""
    is_tall: bool = False
    """True if the plot is given more height, as views in three dimensions need."""


def trace_meta(palette_index: int | None = None, **choices: str) -> dict[str, Any]:
    """Return the `meta` of a trace of plotly, from which the page's script shows and colours it.

    Parameters
    ----------
    palette_index
        Index of the colour; None for a trace with colours of its own.
    choices
        Options at which the trace is shown, by the name of the control.
    """
    return {"when": choices} | ({} if palette_index is None else {"series": palette_index})


def to_sentences(parts: Sequence[str]) -> list[str]:
    """Return a list with each phrase as a sentence; empty phrases are left out."""
    return [labels.join_sentences([part]) for part in parts if part]


def make_interactive_plot(chart: Chart) -> InteractivePlot:
    """Return a chart as an interactive plot of a page."""
    first_panel = chart.panels[0]
    layout_options: dict[str, Any] = {}
    area_lines = [line for line in first_panel.lines if line.style == "area"]
    if area_lines:
        layout_options = {"barmode": "stack"}
        layout_options["hovermode"] = "x unified" if area_lines[0].x.size > 1 else "closest"
    if chart.colour_scale is not None:
        layout_options |= {"margin": {"l": 10, "r": 16, "t": 88, "b": 55}}
        layout_options |= {
            "title": colour_bar_title_layout(
                "log10 of " * chart.colour_scale.is_log + chart.colour_scale.label
            )
        }
    return InteractivePlot(
        chart.heading,
        chart.alt,
        to_sentences(chart.caption),
        go.Figure(
            [trace for panel in chart.panels for trace in _panel_traces(panel, chart.colour_scale)],
            plot_layout(
                xaxis=_axis_layout(first_panel.x_axis),
                yaxis=_axis_layout(first_panel.y_axis, automargin=True),
                **layout_options,
            ),
        ),
        [_make_control(chart.panels, name, label) for name, label in chart.facet_labels.items()],
        offers_cuts=chart.colour_scale is not None,
    )


def _make_control(panels: Sequence[Panel], name: str, label: str) -> PlotControl:
    """Return the control by which the reader chooses among the panels of a chart.

    The control changes one facet, a property by which panels differ. `name` is the name of the
    facet, `label` its label. If the panels differ in their vertical axes, the options change that
    axis.
    """
    axes_by_option: dict[str, set[ChartAxis]] = {}
    for panel in panels:
        axes_by_option.setdefault(panel.facet_choices[name], set()).add(panel.y_axis)
    relayout_by_option: dict[str, dict[str, Any]] = {}
    if (
        all(len(option_axes) == 1 for option_axes in axes_by_option.values())
        and len(set().union(*axes_by_option.values())) > 1
    ):
        for option, (axis,) in axes_by_option.items():
            axis_options = {
                k: v for k, v in _axis_layout(axis).items() if k in ("type", "range", "rangemode")
            }
            relayout_by_option[option] = {
                f"yaxis.{key}": value for key, value in axis_options.items()
            }
            relayout_by_option[option]["yaxis.title.text"] = wrap_with_html_breaks(axis.label, 36)
    return PlotControl(name, label, list(axes_by_option), relayout_by_option)


def _panel_traces(panel: Panel, colour_scale: ColourScale | None) -> Iterator[Any]:
    """Yield plotly's traces of the lines or of the heat map of a panel."""
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
        colorbar=COLOUR_BAR_LAYOUT,
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
    """Return an array in single precision, enough for a screen; arrays without floats unchanged."""
    return values.astype(np.float32) if values.dtype.kind == "f" else values


def _line_traces(panel: Panel, line: ChartLine) -> Iterator[go.Scatter | go.Bar]:
    """Yield plotly's traces of a line: one of its band, if it has a band, and one of the line."""
    meta = trace_meta(line.style_index, **panel.facet_choices)
    if panel.y_axis.scale == LOG_SCALE:
        line = _mask_nonpositive(line)
    x, y, low, high = line.x, line.y, line.low, line.high
    trace_options: dict[str, Any] = {
        "x": _to_float32(x), "y": _to_float32(y), "name": line.name, "meta": meta,
        "legendgroup": f"{line.style_index}", "showlegend": bool(line.name),
    }  # fmt: skip
    if line.hover_texts:
        trace_options |= {"text": list(line.hover_texts)}
    dash = PLOTLY_DASH_STYLES[line.style_index % len(PLOTLY_DASH_STYLES)]
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
    """Return a line whose values that are not positive are nan, for a logarithmic axis."""
    masked_values: dict[str, Any] = {
        name: np.where(values > 0, values, np.nan)
        for name, values in (("y", line.y), ("low", line.low), ("high", line.high))
        if values is not None
    }
    return replace(line, **masked_values)


def _band_trace(
    line: ChartLine, x: np.ndarray, low: np.ndarray, high: np.ndarray, meta: dict[str, Any]
) -> go.Scatter:
    """Return plotly's trace of the band about a line: the area from its lower to its upper ends."""
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
    """Return the colours and plotly's template for a light and a dark page, by scheme."""
    fractions, colours = np.linspace(0, 1, 11), colormaps[canvas.COLOUR_MAP_NAME]
    return {
        scheme: {
            "lines": PAGE_LINE_COLOURS[scheme],
            "scale": [[float(s), to_hex(colours(low + (high - low) * s))] for s in fractions],
            "ground": [[0, _GROUND_COLOURS[scheme][0]], [1, _GROUND_COLOURS[scheme][1]]],
            "template": plotly.io.templates[template].to_plotly_json(),
        }
        for scheme, template in (("light", "plotly_white"), ("dark", "plotly_dark"))
        for low, high in [_COLOUR_MAP_SPANS[scheme]]
    }


def plot_layout(**options_set: Any) -> dict[str, Any]:
    """Return plotly's layout of a plot with the legend above; `options_set` replace defaults."""
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


def wrap_with_html_breaks(text: str, width: int = 44) -> str:
    """Return a text with HTML line breaks, in lines of at most `width` characters."""
    return "<br>".join(textwrap.wrap(text, width, break_on_hyphens=False))


def _axis_layout(axis: ChartAxis, **options_set: Any) -> dict[str, Any]:
    """Return plotly's layout of an axis: title, scale, limits; `options_set` replace defaults."""
    label = wrap_with_html_breaks(axis.label) if options_set else axis.label
    axis_options = {"title": {"text": label, "standoff": 12}, "zeroline": False, "type": axis.scale}
    if axis.limits is not None:
        axis_options |= (
            {"rangemode": "tozero"} if None in axis.limits else {"range": list(axis.limits)}
        )
    if axis.scale == "log":
        axis_options["nticks"] = (
            6  # few ticks, so that only decades are labelled and not 2 and 5 between them
        )
    if axis.label.startswith("number of") and axis.scale == "linear":  # 8,000, not 8 x 10^3
        return axis_options | {"exponentformat": "none", "separatethousands": True} | options_set
    return axis_options | {"exponentformat": "power"} | options_set


def colour_bar_title_layout(text: str) -> dict[str, Any]:
    """Return plotly's layout of a plot title that stands above the colour bar."""
    return {
        "text": wrap_with_html_breaks(text, 48), "x": 0.5, "xanchor": "center",
        "yref": "container", "y": 1, "yanchor": "top", "pad": {"t": 2}, "font": {"size": 15},
    }  # fmt: skip


@dataclass(frozen=True)
class HtmlTable:
    """Table of a page, which the reader can sort, search and download."""

    heading: str
    """Heading above the table."""
    caption: Sequence[str]
    """Sentences of the caption."""
    frame: pandas.DataFrame
    """Cells of the table, with its column names."""
    csv_stem: str
    """Name, without suffix, of the CSV file that the reader can download."""


@dataclass(frozen=True)
class TextItem:
    """Preformatted text of a page, which the reader can copy or download."""

    heading: str
    """Heading above the text."""
    caption: Sequence[str]
    """Sentences of the caption."""
    text: str
    """Text itself."""
    download_name: str = ""
    """Name of the file that the reader can download; empty for no download."""


PageItem = InteractivePlot | HtmlTable | TextItem
"""Type of an item of a section of a page: plot, table or text."""


@dataclass(frozen=True)
class PageSection:
    """Section of a page."""

    anchor: str
    """Name of the section in links to it."""
    title: str
    """Title of the section."""
    paragraphs: Sequence[str] = ()
    """Paragraphs of text at the beginning of the section."""
    items: Sequence[PageItem] = ()
    """Plots, tables and texts that follow the paragraphs."""


@dataclass(frozen=True)
class ReportPage:
    """Contents of the report of a study."""

    title: str
    """Title of the study."""
    question: str
    """Question of the study, from its spec."""
    key_facts: Sequence[tuple[str, str]]
    """Name and value of each key fact."""
    remarks: Sequence[str]
    """Sentences above the sections that the reader must not miss."""
    sections: Sequence[PageSection]
    """Sections in order."""


ROWS_PER_TABLE_PAGE = 10
"""Number of rows of a long table that are shown at a time in the HTML report."""


UNWRAPPED_CELL_CHARACTERS_MAX = 40
"""Largest number of characters in the cells of a column for which its text is not wrapped."""


def render_html(page: ReportPage) -> str:
    """Return a report as the HTML of a self-contained page."""
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
    environment.globals |= {"chart_json": _plot_json}
    script_path = Path(options.dt_bundle)
    return environment.get_template("report.html").render(
        page=page,
        plotly=get_plotlyjs(),
        tables=script_path.read_text(encoding="utf-8"),
        tables_style=script_path.with_suffix(".css").read_text(encoding="utf-8"),
        themes=to_json_plotly(colour_themes()),
    )


def _compress_base64(text: str) -> str:
    """Return a text compressed by gzip, in base64. That has about a third of the text's size."""
    return b64encode(gzip.compress(text.encode(), mtime=0)).decode()


def _plot_json(plot: InteractivePlot) -> str:
    """Return a plot as JSON for the page's script."""
    relayouts: dict[str, Any] = {
        c.name: dict(c.relayout_by_option) for c in plot.controls if c.relayout_by_option
    }
    content = {"figure": plot.figure.to_dict(), "relayouts": relayouts, "cut": plot.offers_cuts}
    return str(to_json_plotly(content))


def _table_json(table: HtmlTable) -> str:
    """Return a table as JSON for the page's script, with the options of sorting and download."""
    csv_button = {"extend": "csvHtml5", "text": "Download CSV", "filename": table.csv_stem}
    widths = table.frame.map(lambda cell: len(str(cell))).max()
    with pandas.option_context("display.float_format", "{:.6g}".format):
        arguments = get_itable_arguments(
            table.frame,
            showIndex=False,
            maxBytes=0,
            maxColumns=0,
            pageLength=ROWS_PER_TABLE_PAGE,
            columnDefs=[
                {
                    "targets": np.flatnonzero(widths > UNWRAPPED_CELL_CHARACTERS_MAX).tolist(),
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
    """Return the text of an item as a data URL, from which a browser can save a file."""
    return f"data:text/plain;charset=utf-8;base64,{b64encode(text_item.text.encode()).decode()}"
