"""Colours and layout that all charts share, in light and in dark."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np
import plotly.io
from matplotlib import colormaps
from matplotlib.colors import to_hex

from sweep.analysis import canvas

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


CHANCES = {"yaxis.range": [-0.03, 1.03]}
"""What a choice changes of a chart that shows a probability."""

UNDER_A_BAR = {"l": 10, "r": 16, "t": 88, "b": 55}
"""Margins of a chart with a colour bar over it."""


def themes() -> dict[str, Any]:
    """Palette, scales and template of each colour scheme, for the page's script."""
    return {
        scheme: {
            "lines": LINES[scheme],
            "scale": _sampled(*_ENDS[scheme]),
            "ground": [[0, _GROUND[scheme][0]], [1, _GROUND[scheme][1]]],
            "template": plotly.io.templates[template].to_plotly_json(),
        }
        for scheme, template in (("light", "plotly_white"), ("dark", "plotly_dark"))
    }


def _sampled(low: float, high: float) -> list[list[Any]]:
    """Part of the colour scale as stops."""
    stops = np.linspace(0, 1, 11)
    colours = colormaps[canvas.SCALE](low + (high - low) * stops)
    return [[float(s), to_hex(c)] for s, c in zip(stops, colours, strict=True)]


def layout(**further: Any) -> dict[str, Any]:
    """Layout of a chart: legend above, no title (the page has it), room for labels."""
    common: dict[str, Any] = {
        "margin": {"l": 10, "r": 16, "t": 30, "b": 55},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "legend": {
            "orientation": "h",
            "x": 0,
            "y": 1.02,
            "yanchor": "bottom",
            "itemsizing": "constant",
            "font": {"size": 11},
        },
        "hovermode": "closest",
        "uirevision": "kept",
        "font": {"size": 13},
    }
    return common | further


def broken(words: str, width: int = 44) -> str:
    """Words in lines that fit beside a chart."""
    return "<br>".join(textwrap.wrap(words, width, break_on_hyphens=False))


def axis(title: str, **further: Any) -> dict[str, Any]:
    """An axis with its name."""
    common = {"title": {"text": title, "standoff": 12}, "zeroline": False}
    return common | {"exponentformat": "power"} | further


def upright(words: str, **further: Any) -> dict[str, Any]:
    """An axis at the side, its name in lines that fit, with as much room as its labels take."""
    return axis(broken(words), automargin=True, **further)


def title(words: str) -> dict[str, Any]:
    """What colours mean, over their bar."""
    return {
        "text": broken(words, 48), "x": 0.5, "xanchor": "center", "yref": "container", "y": 1,
        "yanchor": "top", "pad": {"t": 2}, "font": {"size": 15},
    }  # fmt: skip


COLOUR_BAR: dict[str, Any] = {
    "orientation": "h", "x": 0.5, "yref": "container", "y": 0.91, "yanchor": "top", "len": 1.0,
    "thickness": 12,
}  # fmt: skip
"""A colour bar over the chart, as wide as it is, which suits narrow screens too."""
