"""A variable over two coordinates, reduced to what a page can hold."""

from __future__ import annotations

import math
from dataclasses import dataclass

import dask
import numpy as np
import plotly.graph_objects as go

from sweep.analysis import surface
from sweep.analysis.cells import MEAN, Side
from sweep.analysis.figures import Study
from sweep.analysis.selection import Points
from sweep.report import looks, wording
from sweep.report.choosing import parts
from sweep.report.page import Chart, Control, when
from sweep.spec import Surface

COLUMNS, ROWS = 500, 180
"""Cells of a heat map across and up, at the most."""

CELLS = 400_000
"""Cells of all heat maps of a page together, which keep it to a few megabytes."""


@dataclass(frozen=True)
class _Map:
    """One part of a study over two sides."""

    words: str
    part: Points
    x: Side
    y: Side


def fits(study: Study, figure: Surface) -> bool:
    """Whether a figure's coordinates span a plane: two that vary together do not."""
    return study.points.axis_of(figure.x) != study.points.axis_of(figure.y)


def chart(study: Study, figure: Surface, share: float) -> Chart | None:
    """A heat map, with cuts through it; none where no point is within its limits.

    Parameters
    ----------
    study, figure
        The study, and what it asks for.
    share
        Part of the page's cells that it may take.
    """
    found, fewer = parts(study, [figure.x, figure.y], figure.where)
    if not found:
        return None
    maps = [_Map(words, p, p.side(figure.x), p.side(figure.y)) for words, p in found]
    worst = surface.worst(figure.variable)
    most = _most(maps, CELLS * share / (len(maps) * (1 + bool(worst))))
    each = math.prod(side.together(m) for side, m in zip((maps[0].x, maps[0].y), most, strict=True))
    kinds = [MEAN, worst] if each > 1 and worst else [MEAN]
    layers = _layers(figure.variable, maps, kinds, most)
    scale = wording.Scale.of(figure.variable, study.words(figure.variable), layers)
    across = wording.Ruler.of(study, figure.x, maps[0].x.values)
    up = wording.Ruler.of(study, figure.y, maps[0].y.values)
    traces = [
        go.Heatmap(
            x=across.shown(one.x.middles(most[0])),
            y=up.shown(one.y.middles(most[1])),
            z=scale.shown(layer).astype(np.float32),
            zmin=scale.low, zmax=scale.high, colorscale="Viridis",
            colorbar=looks.COLOUR_BAR,
            name=one.words, meta=when(part=one.words, cell=kind),
        )
        for (one, kind), layer in zip(((m, k) for m in maps for k in kinds), layers, strict=True)
    ]  # fmt: skip
    size = maps[0].x.values.size * maps[0].y.values.size
    return Chart(
        heading=figure.title or study.words(figure.variable),
        alt=(
            f"Heat map of {study.words(figure.variable)} over {across.span(maps[0].x.values)} and "
            f"{up.span(maps[0].y.values)}: {wording.spread(layers[0])}."
        ),
        caption=wording.sentences(
            [wording.held(figure), _reduction(each, size, kinds), wording.left_out(fewer),
             wording.gaps(layers)]
        ),
        figure=go.Figure(
            traces,
            looks.layout(
                xaxis=across.axis,
                yaxis=up.at_side,
                margin=looks.UNDER_A_BAR,
                title=looks.title(scale.words),
            ),
        ),
        controls=[
            Control("part", "Shown for", [words for words, _ in found]),
            Control("cell", "Each cell shows the", kinds),
        ],
        cut=True,
    )  # fmt: skip


def _most(maps: list[_Map], cells: float) -> tuple[int, int]:
    """Cells across and up that all maps keep to."""
    width = min(COLUMNS, max(m.x.values.size for m in maps))
    height = min(ROWS, max(m.y.values.size for m in maps))
    shrink = min(1.0, math.sqrt(cells / (width * height)))
    return max(2, int(width * shrink)), max(2, int(height * shrink))


def _layers(
    variable: str, maps: list[_Map], kinds: list[str], most: tuple[int, int]
) -> list[np.ndarray]:
    """Cells of every map and kind, (rows, columns) each."""
    lazy = [
        m.part.cells(variable, [(m.y, most[1]), (m.x, most[0])], kind).data
        for m in maps
        for kind in kinds
    ]
    return [np.asarray(layer, float) for layer in dask.compute(*lazy)]


def _reduction(each: int, size: int, kinds: list[str]) -> str:
    if each == 1:
        return ""
    choice = f"choose their mean, or the {kinds[1]} of them" if len(kinds) > 1 else "their mean"
    return (
        f"Reduced for this page: each cell stands for {each} neighbouring points of {size:,}: "
        + choice
    )
