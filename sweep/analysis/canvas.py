"""Pictures: sheets to draw on, their looks, and files made of them."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from matplotlib import rc_context, rcdefaults, rcParams
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Sheet

DPI = 150
SCALE = "viridis"
NOT_COMPUTED = "0.75"
"""Grey of what is not there: nan, or a point not computed yet."""

LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#785A2D")
"""Colours for lines: of Okabe and Ito (2008), and a brown that red-blind eyes tell from them."""

DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)), (0, (3, 3)))


FORMATS = ("png", "pdf", "svg")
"""Formats of pictures; text and lines of the last two are no pixels."""

PRINTED_DPI = 300
"""Of what stays pixels in PDF and SVG: surfaces and clouds of many points."""

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same on every machine
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "pdf.fonttype": 42,  # whole outlines, as publishers ask for
    "svg.fonttype": "path",
    "svg.hashsalt": "sweep",
    "path.simplify": True,
    "path.snap": True,
}

_NO_TRACES = {
    "png": {"Software": None},
    "pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    "svg": {"Creator": None, "Date": None},
}
"""Metadata that would make a file differ from one run, or one machine, to the next."""


@contextmanager
def style() -> Iterator[None]:
    """The one style of all pictures, whatever its user has set."""
    with rc_context():
        rcdefaults()
        rcParams.update(STYLE)
        yield


def sheet(width: float, height: float) -> Sheet:
    """An empty sheet, width and height in inches."""
    figure = Sheet(figsize=(width, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def panels(
    width: float, height: float, rows: int, columns: int, **options: Any
) -> tuple[Sheet, list[Axes]]:
    """A sheet with a grid of axes, listed row by row."""
    figure = sheet(width, height)
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    return figure, list(axes.ravel())


def empty(message: str) -> Sheet:
    """A sheet that says why there is nothing on it."""
    figure = sheet(8.0, 2.0)
    figure.text(0.5, 0.5, message, ha="center", va="center", color="0.3", parse_math=False)
    return figure


def title(figure: Sheet, text: str) -> None:
    """Title of a whole sheet, as it is written: a dollar in it is no formula."""
    figure.suptitle(text, fontsize=11, fontweight="bold", parse_math=False)


def caption(figure: Sheet, text: str) -> None:
    """Small print at the foot of a sheet, broken into lines that fit it."""
    if text:
        characters = int(figure.get_figwidth() * 15)
        figure.supxlabel(
            "\n".join(textwrap.wrap(text, characters)), fontsize=8, color="0.25", x=0.02,
            ha="left", parse_math=False,
        )  # fmt: skip


def save(figure: Sheet, path: Path) -> Path:
    """The sheet as a file of the format that its suffix names; the same sheet, the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    kind = path.suffix.removeprefix(".")
    dpi = DPI if kind == "png" else PRINTED_DPI
    with style():
        figure.savefig(path, format=kind, dpi=dpi, metadata=_NO_TRACES[kind])
    return path
