"""A variable along a coordinate, a line for each value of another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go

from sweep.analysis import along, slices
from sweep.analysis.figures import Study
from sweep.analysis.selection import Points, split
from sweep.report import looks, wording
from sweep.report.choosing import parts
from sweep.report.page import Chart, Control, when
from sweep.spec import Slices

MARKED = 40
"""Points up to which each has a mark."""


@dataclass(frozen=True)
class Named:
    """A line of one part of a study; `number` is its place among the part's lines."""

    shown_for: str
    name: str
    number: int
    points: Points


def chart(study: Study, figure: Slices) -> Chart | None:
    """Lines along a coordinate; of long ones the mean of stretches, and the band of their points.

    None where no point is within the figure's limits.

    Parameters
    ----------
    study, figure
        The study, and what it asks for.
    """
    by = [figure.by] if figure.by else []
    found, fewer = parts(study, [figure.x, *by], figure.where)
    if not found:
        return None
    named, lacking = lines_of(found, by)
    made = along.lines([(own.points, figure.variable) for own in named], figure.x)
    ruler = wording.Ruler.of(study, figure.x, longest(named, figure.x))
    words = study.words(figure.variable)
    return Chart(
        heading=figure.title or words,
        alt=alternative(words, ruler.span(longest(named, figure.x)), named, made),
        caption=wording.sentences(
            [wording.held(figure), *remarks(made), wording.left_out(fewer + lacking)]
        ),
        figure=go.Figure(
            [t for own, line in zip(named, made, strict=True) for t in traces(own, line, ruler)],
            _layout(figure.variable, words, ruler, made),
        ),
        controls=[Control("part", "Shown for", [part for part, _ in found])],
    )


def lines_of(found: Sequence[tuple[str, Points]], by: list[str]) -> tuple[list[Named], int]:
    """Lines of every part, and how many are left out."""
    named: list[Named] = []
    fewer = 0
    for shown_for, part in found:
        own, lacking = split(part, by, slices.MOST_LINES)
        fewer += lacking
        named += [Named(shown_for, name, k, points) for k, (name, points) in enumerate(own)]
    return named, fewer


def longest(named: Sequence[Named], x: str) -> np.ndarray:
    """Values of the coordinate along the longest line."""
    return max((own.points.side(x).values for own in named), key=np.size)


def traces(own: Named, line: along.Line, ruler: wording.Ruler, **choices: str) -> list[go.Scatter]:
    """The line, over its band where it has one; shown at some choices as well as for its part."""
    x = ruler.shown(line.x)
    meta = when(own.number, part=own.shown_for, **choices)
    look = {"dash": looks.DASHES[own.number % len(looks.DASHES)], "width": 2}
    common: dict[str, Any] = {"legendgroup": own.name}
    drawn = go.Scatter(
        x=x, y=line.mean.astype(np.float32), name=own.name, meta=meta, line=look,
        mode="lines+markers" if x.size <= MARKED else "lines", showlegend=bool(own.name), **common,
    )  # fmt: skip
    if line.low is None or line.high is None:
        return [drawn]
    known = np.isfinite(line.low) & np.isfinite(line.high)
    there, back = np.flatnonzero(known), np.flatnonzero(known)[::-1]
    band = go.Scatter(
        x=np.concatenate([x[there], x[back]]),
        y=np.concatenate([line.high[there], line.low[back]]).astype(np.float32),
        fill="toself", mode="none", hoverinfo="skip", showlegend=False, meta=meta | {"band": True},
        **common,
    )  # fmt: skip
    return [band, drawn]


def _layout(
    variable: str, words: str, ruler: wording.Ruler, made: Sequence[along.Line]
) -> dict[str, object]:
    """Axes: probabilities of detection from 0 to 1, what spans decades by decades."""
    up = looks.upright(words)
    if variable.startswith("pd_"):
        up |= {"range": [-0.03, 1.03]}
    else:
        scale = wording.Scale.of(variable, words, [line.mean for line in made])
        up |= {"type": "log" if scale.decades else "linear"}
    return looks.layout(xaxis=ruler.axis, yaxis=up)


def alternative(words: str, span: str, named: Sequence[Named], made: Sequence[along.Line]) -> str:
    """What the lines of the first part show, in words."""
    told = [
        f"{own.name or 'the line'}: {wording.spread(line.mean)}"
        for own, line in zip(named, made, strict=True)
        if own.shown_for == named[0].shown_for
    ]
    return f"Lines of {words} over {span}. {'; '.join(told)}."


def remarks(made: Sequence[along.Line]) -> list[str]:
    """How lines are drawn, once each."""
    return [*dict.fromkeys(line.remark for line in made)]
