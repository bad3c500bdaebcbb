"""Pages: sections with plots, tables and texts, and the one file that they become."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import itables.options
import jinja2
import pandas
from itables import to_html_datatable
from itables.javascript import generate_init_offline_itables_html
from markupsafe import Markup
from plotly.io.json import to_json_plotly
from plotly.offline import get_plotlyjs

from sweep.report.interactive import Plot, themes


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
        "chart": lambda item: isinstance(item, Plot),
        "sheet": lambda item: isinstance(item, Table),
        "text": lambda item: isinstance(item, Text),
    }
    return environment.get_template("report.html").render(
        page=page,
        plotly=Markup(get_plotlyjs().replace("</script", "<\\/script")),
        tables=Markup(generate_init_offline_itables_html(itables.options.dt_bundle)),
        themes=_in_script(to_json_plotly(themes())),
    )


def _in_script(json_text: str) -> Markup:
    """JSON that can stand in a page, whatever words it holds."""
    return Markup(json_text.replace("<", "\\u003c").replace("&", "\\u0026"))


def _chart_json(plot: Plot) -> Markup:
    """What the page's script needs of a plot."""
    relayouts: dict[str, Any] = {c.name: dict(c.relayout) for c in plot.controls if c.relayout}
    return _in_script(
        to_json_plotly({"figure": plot.figure.to_dict(), "relayouts": relayouts, "cut": plot.cut})
    )


def _table(table: Table, number: int) -> Markup:
    """A table with its sorting, searching and downloading."""
    csv = {"extend": "csvHtml5", "text": "Download CSV", "filename": table.file}
    with pandas.option_context("display.float_format", "{:.6g}".format):
        made = to_html_datatable(
            table.frame, connected=False, table_id=f"table-{number}", showIndex=False, maxBytes=0,
            maxColumns=0, classes="display compact", style="width:100%",
            columnDefs=[{"targets": _long(table.frame), "className": "long"}],
            buttons=[csv, "copyHtml5"], pageLength=ROWS, display_logo_when_loading=False,
        )  # fmt: skip
    return Markup(str(made))


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
