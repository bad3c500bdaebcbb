"""What a page is made of: sections with charts, tables and facts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas
import plotly.graph_objects as go


@dataclass(frozen=True)
class Control:
    """A choice that a chart offers.

    Attributes
    ----------
    name, label
        What traces call it (see :func:`when`), and what stands beside it.
    options
        What can be chosen, the first at the start.
    relayout
        What an option changes of the chart's layout, by option; nothing by default.
    """

    name: str
    label: str
    options: Sequence[str]
    relayout: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Chart:
    """An interactive figure.

    Attributes
    ----------
    heading, alt
        What stands over it; what it shows, in words, for those who do not see it.
    caption
        Sentences under it.
    figure
        Traces and layout; `meta` of a trace says when it is shown and which colour it takes.
    controls
        Choices; one with a single option is left out.
    cut
        Whether the first heat map that is shown can be cut along either of its sides.
    tall
        Whether it needs the height of a solid view.
    """

    heading: str
    alt: str
    caption: Sequence[str]
    figure: go.Figure
    controls: Sequence[Control] = ()
    cut: bool = False
    tall: bool = False


@dataclass(frozen=True)
class Table:
    """Rows that can be sorted, searched and downloaded.

    Attributes
    ----------
    heading
        What stands over it.
    caption
        Sentences under it.
    frame
        Columns and rows.
    file
        Name of the file that it is downloaded as, without its ending.
    """

    heading: str
    caption: Sequence[str]
    frame: pandas.DataFrame
    file: str


@dataclass(frozen=True)
class Text:
    """Text that keeps its lines, such as a spec, to read, copy or download.

    Attributes
    ----------
    heading, caption, text
        What stands over it, sentences under that, and the text.
    file
        Name of the file that it is downloaded as; empty where it is only to be copied.
    """

    heading: str
    caption: Sequence[str]
    text: str
    file: str = ""


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes
    ----------
    anchor, title
        Its name in addresses, and for readers.
    words
        Paragraphs at its head.
    items
        Charts, tables and texts.
    """

    anchor: str
    title: str
    words: Sequence[str] = ()
    items: Sequence[Chart | Table | Text] = ()


@dataclass(frozen=True)
class Page:
    """A whole report.

    Attributes
    ----------
    title, question
        Of the study.
    facts
        What a reader wants to know first: name and value of each.
    remarks
        What must not be overlooked, such as that the study is not complete.
    sections
        In the order of the page.
    """

    title: str
    question: str
    facts: Sequence[tuple[str, str]]
    remarks: Sequence[str]
    sections: Sequence[Section]


def when(series: int | None = None, **choices: str) -> dict[str, Any]:
    """`meta` of a trace: at which choices it is shown, and which colour of the palette it takes."""
    return {"when": choices} | ({} if series is None else {"series": series})
