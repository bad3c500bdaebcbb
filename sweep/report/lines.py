"""A variable along a coordinate, a line for each value of another."""

from __future__ import annotations

from dataclasses import dataclass

import dask
import numpy as np
import plotly.graph_objects as go

from sweep.analysis import slices
from sweep.analysis.cells import HIGHEST, LOWEST, MEAN, Side
from sweep.analysis.figures import Study
from sweep.analysis.selection import Points, split
from sweep.report import looks, wording
from sweep.report.choosing import parts
from sweep.report.page import Chart, Control, when
from sweep.spec import Slices

STRETCHES = 500
"""Stretches that a long line is cut into."""

MARKED = 40
"""Points up to which each has a mark."""


@dataclass(frozen=True)
class _Line:
    """One line of one part of a study; `number` is its place among the part's lines."""

    shown_for: str
    name: str
    number: int
    part: Points
    side: Side


def chart(study: Study, figure: Slices) -> Chart | None:
    """Lines along a coordinate; of long ones the mean of stretches, and the band of their points.

    None where no point is within the figure's limits.

    Parameters
    ----------
    study, figure
        The study, and what it asks for.
    """
    names = [figure.x, figure.by] if figure.by else [figure.x]
    found, fewer = parts(study, names, figure.where)
    if not found:
        return None
    lines: list[_Line] = []
    for shown_for, part in found:
        own, lacking = split(part, names[1:], slices.MOST_LINES)
        fewer += lacking
        lines += [
            _Line(shown_for, name, number, line, line.side(figure.x))
            for number, (name, line) in enumerate(own)
        ]
    packed = max(line.side.together(STRETCHES) for line in lines)
    kinds = (MEAN, LOWEST, HIGHEST) if packed > 1 else (MEAN,)
    values = _values(figure.variable, lines, kinds)
    along = wording.Ruler.of(study, figure.x, max((ln.side.values for ln in lines), key=np.size))
    traces = [t for line, own in zip(lines, values, strict=True) for t in _traces(line, own, along)]
    words = study.words(figure.variable)
    return Chart(
        heading=figure.title or words,
        alt=_alt(words, along, lines, values),
        caption=wording.sentences(
            [wording.held(figure), _reduction(packed), wording.left_out(fewer)]
        ),
        figure=go.Figure(traces, _layout(figure.variable, words, along, values)),
        controls=[Control("part", "Shown for", [words for words, _ in found])],
    )


def _values(
    variable: str, lines: list[_Line], kinds: tuple[str, ...]
) -> list[dict[str, np.ndarray]]:
    """Values of each line, of each kind."""
    lazy = [
        line.part.cells(variable, [(line.side, STRETCHES)], kind).data
        for line in lines
        for kind in kinds
    ]
    flat = iter(np.asarray(value, np.float32) for value in dask.compute(*lazy))
    return [{kind: next(flat) for kind in kinds} for _ in lines]


def _traces(line: _Line, values: dict[str, np.ndarray], along: wording.Ruler) -> list[go.Scatter]:
    """The line, over the band that its points fill where it is reduced."""
    x = along.shown(line.side.middles(STRETCHES))
    meta = when(line.number, part=line.shown_for)
    marked = x.size <= MARKED
    look = {"dash": looks.DASHES[line.number % len(looks.DASHES)], "width": 2}
    drawn = go.Scatter(
        x=x, y=values[MEAN], name=line.name, meta=meta, line=look,
        mode="lines+markers" if marked else "lines", legendgroup=line.name,
        showlegend=bool(line.name),
    )  # fmt: skip
    if LOWEST not in values:
        return [drawn]
    known = np.isfinite(values[MEAN])
    band = go.Scatter(
        x=np.concatenate([x[known], x[known][::-1]]),
        y=np.concatenate([values[HIGHEST][known], values[LOWEST][known][::-1]]),
        fill="toself", mode="none", hoverinfo="skip", legendgroup=line.name, showlegend=False,
        meta=meta | {"band": True},
    )  # fmt: skip
    return [band, drawn]


def _layout(
    variable: str, words: str, along: wording.Ruler, values: list[dict[str, np.ndarray]]
) -> dict[str, object]:
    """Axes: probabilities of detection from 0 to 1, what spans decades by decades."""
    up = looks.upright(words)
    if variable.startswith("pd_"):
        up |= {"range": [-0.03, 1.03]}
    else:
        scale = wording.Scale.of(variable, words, [own[MEAN] for own in values])
        up |= {"type": "log" if scale.decades else "linear"}
    return looks.layout(xaxis=along.axis, yaxis=up)


def _alt(
    words: str, along: wording.Ruler, lines: list[_Line], values: list[dict[str, np.ndarray]]
) -> str:
    first = lines[0].shown_for
    told = [
        f"{line.name or 'the line'}: {wording.spread(own[MEAN])}"
        for line, own in zip(lines, values, strict=True)
        if line.shown_for == first
    ]
    span = along.span(max((line.side.values for line in lines), key=np.size))
    return f"Lines of {words} over {span}. {'; '.join(told)}."


def _reduction(each: int) -> str:
    if each == 1:
        return ""
    return (
        f"Reduced for this page: a line is the mean of {each} neighbouring points, the band about "
        "it goes from the lowest of them to the highest, so that no narrow dip is hidden"
    )
