"""Charts as data, and those of grids: a variable over two coordinates, or along one.

Files of them are drawn by :mod:`sweep.analysis.canvas`, pages by :mod:`sweep.report.page`: a sheet
shows the panels side by side, a page one at a time, by the choice of each facet.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import dask
import numpy as np
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.answers.probability import SEGMENTS, detection_probability, half_width
from sweep.analysis.selection import HIGHEST, LOWEST, MEAN, Points, Side, split, spread

LINEAR, LOG, WORDS = "linear", "log", "category"

CHANCE = (-0.03, 1.03)
"""Limits of an axis of probabilities."""


@dataclass(frozen=True)
class Axis:
    """An axis: words with units, its kind, and its ends; none where those of the data will do."""

    words: str = ""
    kind: str = LINEAR
    limits: tuple[float | None, float | None] | None = None


@dataclass(frozen=True, eq=False)
class Line:
    """Values along an axis; nan where there is none.

    A legend has its name; a number stands for its colour, dash and mark. A band may be about
    it. Its look is ``line``, ``stated`` (dashed), ``dots``, ``bars`` (with errors), ``level``
    or ``area`` (upon the areas before it). Each value stands for some points together, and may
    have words told of it.
    """

    x: np.ndarray
    y: np.ndarray
    name: str = ""
    number: int = 0
    low: np.ndarray | None = None
    high: np.ndarray | None = None
    look: str = "line"
    together: int = 1
    told: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class Map:
    """Values (rows, columns) over y and x; nan where there is none. Levels have contours."""

    x: np.ndarray
    y: np.ndarray
    values: np.ndarray
    levels: Sequence[float] = ()


@dataclass(frozen=True)
class Scale:
    """Colours of a variable: probabilities from 0 to 1, wide spans by decades."""

    low: float
    high: float
    decades: bool
    words: str


@dataclass(frozen=True, eq=False)
class Panel:
    """Lines or a map over two axes, at one choice of each facet."""

    when: Mapping[str, str]
    x: Axis
    y: Axis
    lines: Sequence[Line] = ()
    map: Map | None = None

    @property
    def title(self) -> str:
        """The choices in words."""
        return ", ".join(filter(None, self.when.values()))


@dataclass(frozen=True, eq=False)
class Chart:
    """Contents of a figure: words over it, for those who do not see it, and under it; panels.

    Facets have the name of each choice. `rows` are numbers of panels in the rows of a sheet.
    """

    heading: str
    alt: str
    caption: Sequence[str]
    panels: Sequence[Panel]
    facets: Mapping[str, str] = field(default_factory=dict)
    scale: Scale | None = None
    rows: Sequence[int] = ()


@dataclass(frozen=True)
class Room:
    """Room for a chart: parts, cells of a map across and up and in all, maps abreast."""

    parts: int
    columns: int
    rows: int
    cells: float
    abreast: int


SHEET = Room(parts=9, columns=1100, rows=500, cells=math.inf, abreast=2)
"""Cells of a panel as wide as the sheet: no more than its pixels, so that none is lost."""

MOST_LINES = 8
STRETCHES = 500
"""Stretches into which a line of more than twice as many points is cut."""

_DECADES_FOR_LOG = 3
_CHANCES_OF_HARM = ("miss_", "pfa_", "log10_pfa_", "p_leakage_")


@dataclass(frozen=True)
class Ruler:
    """A coordinate along an axis: in the units that a reader wants, words as they are."""

    axis: Axis
    factor: float
    units: str

    @classmethod
    def of(cls, found: Points, name: str) -> Ruler:
        """Return the ruler of a coordinate."""
        values, units = np.unique(found.values(name)), found.units(name)
        if labels.is_words(values):
            return cls(Axis(labels.coordinate(name), WORDS), 1.0, "")
        factor, units = labels.shown_in(values, units)
        words = labels.with_units(labels.coordinate(name), units)
        return cls(Axis(words, LOG if is_geometric(values) else LINEAR), factor, units)

    def shown(self, values: np.ndarray) -> np.ndarray:
        """Values as they stand on the axis."""
        if self.axis.kind == WORDS:
            return np.array([str(value) for value in values])
        return values * self.factor

    def span(self, values: np.ndarray) -> str:
        """First and last value in words."""
        shown = self.shown(values)
        ends = [labels.quantity(v, self.units) for v in (shown[0], shown[-1])]
        return f"{self.axis.words} from {ends[0]} to {ends[1]}"


def is_geometric(values: np.ndarray) -> bool:
    """Tell whether values are spread evenly in their logarithm, over a decade or more."""
    if values.size < 3 or values.min() <= 0 or values.max() < 10 * values.min():
        return False
    steps = np.diff(np.log(values))
    return bool(steps.max() < 1.5 * steps.min())


def scale_of(variable: str, words: str, layers: Sequence[np.ndarray]) -> Scale:
    """Colours of a variable: 0..1 for probabilities of detection, else what the values span."""
    values = np.concatenate([layer.ravel() for layer in layers])
    known = values[np.isfinite(values)]
    if variable.startswith("pd_") or not known.size:
        return Scale(0.0, 1.0, False, words)
    low, high = float(known.min()), float(known.max())
    above = known[known > 0]
    if low >= 0 and above.size and high > 10**_DECADES_FOR_LOG * float(np.median(above)):
        return Scale(max(float(np.percentile(above, 1)), high * 1e-12), high, True, words)
    return Scale(low, high if high > low else low + 1.0, False, words)


def worst(variable: str) -> str:
    """Worst kind of the values that share a cell; empty if neither end is bad."""
    if variable.startswith(("pd_", "snr_")):
        return LOWEST
    return HIGHEST if variable.startswith(_CHANCES_OF_HARM) else ""


def facets_of(
    found: Points, shown: Sequence[str], most: int
) -> tuple[list[tuple[str, Points]], int]:
    """Parts of points of which a panel shows one, and how many are left out."""
    if not found.size:
        return [], 0
    every, _ = split(found, found.further(shown), found.size)
    several = [
        (words, part) for words, part in every if all(len(part.distinct(n)) > 1 for n in shown)
    ]
    return spread(several or every, most)


def not_shown(number: int) -> str:
    """Remark that some values are left out; empty where none is."""
    return f"{labels.counted(number, 'further value')} not shown" if number else ""


def surface(
    found: Points,
    *,
    x: str,
    y: str,
    variable: str,
    words: str,
    room: Room = SHEET,
    levels: Sequence[float] = (),
) -> Chart:
    """Return a variable over two coordinates, a panel for each value of what else varies.

    Contours are drawn at some levels of the variable, where both coordinates are numbers.
    """
    parts, left_out = facets_of(found, [x, y], room.parts)
    planes = [_plane(part, variable, x, y) for _, part in parts]
    kinds = [MEAN, worst(variable)] if worst(variable) else [MEAN]
    most = _most(planes, room, len(kinds) * len(parts))
    by = [
        max(across.together(most[0]) for _, across, _ in planes),
        max(up.together(most[1]) for _, _, up in planes),
    ]
    kinds = kinds if max(by) > 1 else [MEAN]
    lazy = [
        plane.cells(variable, [(up, most[1]), (across, most[0])], kind).data
        for plane, across, up in planes
        for kind in kinds
    ]
    layers = [np.asarray(layer, float) for layer in dask.compute(*lazy)]
    x_ruler, y_ruler = Ruler.of(found, x), Ruler.of(found, y)
    panels: list[Panel] = []
    for ((name, _), (_, across, up)), kind in product(zip(parts, planes, strict=True), kinds):
        when = {"part": name, "cell": f"{kind} of each cell" if max(by) > 1 else ""}
        columns, rows = across.middles(most[0]), up.middles(most[1])
        contours = () if WORDS in (x_ruler.axis.kind, y_ruler.axis.kind) else levels
        layer = Map(x_ruler.shown(columns), y_ruler.shown(rows), layers[len(panels)], contours)
        panels.append(Panel(when, x_ruler.axis, y_ruler.axis, map=layer))
    spans = [ruler.span(np.unique(found.values(n))) for ruler, n in ((x_ruler, x), (y_ruler, y))]
    remarks = [_reduction(math.prod(by), planes[0][1:], kinds), not_shown(left_out)]
    if levels and panels and panels[0].map and panels[0].map.levels:
        remarks.append(f"contours: {' and '.join(f'{level:g}' for level in levels)}")
    if any(np.isnan(layer).any() for layer in layers):
        remarks.append("grey or empty: not computed, or without a value")
    return Chart(
        words,
        f"Heat map of {words} over {' and '.join(spans)}: {labels.extent(layers[0])}.",
        remarks,
        panels,
        {"part": "Shown for", "cell": "Each cell shows the"},
        scale_of(variable, words, layers),
    )


def _most(planes: Sequence[tuple[Points, Side, Side]], room: Room, layers: int) -> tuple[int, int]:
    """Cells across and up that all maps keep to."""
    columns = room.columns // (room.abreast if len(planes) > 1 else 1)
    width = min(columns, max(across.values.size for _, across, _ in planes))
    height = min(room.rows, max(up.values.size for _, _, up in planes))
    shrink = min(1.0, math.sqrt(room.cells / layers / (width * height)))
    return max(2, int(width * shrink)), max(2, int(height * shrink))


def _plane(found: Points, variable: str, x: str, y: str) -> tuple[Points, Side, Side]:
    """Points over two axes, and the places along x and along y."""
    if found.dim_of(x) != found.dim_of(y):
        return found, found.side(x), found.side(y)
    columns, column = np.unique(found.values(x), return_inverse=True)
    rows, row = np.unique(found.values(y), return_inverse=True)
    both = found.dim_of(x)
    places = np.asarray(found.places[both].index)
    along = Side(both, places, places)
    values = np.full((rows.size, columns.size), np.nan)
    values[row.ravel(), column.ravel()] = found.cells(variable, [(along, along.values.size)], MEAN)
    plane = Points.of(xr.Dataset({variable: (("y", "x"), values)}))
    across, up = Side("x", np.arange(columns.size), columns), Side("y", np.arange(rows.size), rows)
    return plane, across, up


def _reduction(each: int, sides: Sequence[Side], kinds: Sequence[str]) -> str:
    """Remark on the number of points that share a cell; empty where none do."""
    if each == 1:
        return ""
    number = math.prod(side.values.size for side in sides)
    told = f"reduced: each cell stands for {each} neighbouring points of {number:,}: their mean"
    if len(kinds) > 1:
        told += f", and the {kinds[1]} of them, which hides no narrow dip or peak"
    return told


def slices(
    found: Points,
    *,
    x: str,
    by: str,
    variable: str,
    words: str,
    most: int = 6,
    levels: Sequence[float] = (),
) -> Chart:
    """Return a variable along a coordinate, a line for each value of another; lines at levels."""
    lines_by = [by] if by else []
    parts, left_out = facets_of(found, [x, *lines_by], most)
    named, lacking = lines_of(parts, lines_by)
    drawn, remarks = along([(own, variable) for _, _, own in named], x)
    ruler = Ruler.of(found, x)
    scale = scale_of(variable, words, [line.y for line in drawn])
    limits = CHANCE if variable.startswith("pd_") else None
    up = Axis(words, LOG if scale.decades else LINEAR, limits)
    panels = panels_of(named, drawn, ruler, up)
    told = alternative(words, ruler.span(np.unique(found.values(x))), panels[0])
    panels = [
        replace(panel, lines=[*panel.lines, *_level_lines(panel, levels)]) for panel in panels
    ]
    return Chart(
        words,
        told,
        [*remarks, not_shown(left_out + lacking)],
        panels,
        {"part": "Shown for"},
    )


def _level_lines(panel: Panel, levels: Sequence[float]) -> list[Line]:
    """Return level lines as long as the other lines of a panel."""
    x = panel.lines[0].x
    return [Line(x, np.full(x.size, level), f"{level:g}", look="level") for level in levels]


Named = tuple[str, str, Points]
"""The part that a line is of, its name, and its points."""


def lines_of(parts: Sequence[tuple[str, Points]], by: Sequence[str]) -> tuple[list[Named], int]:
    """Lines of every part, and how many are left out."""
    named: list[Named] = []
    fewer = 0
    for part, points in parts:
        own, lacking = split(points, by, MOST_LINES)
        fewer += lacking
        named += [(part, name, line) for name, line in own]
    return named, fewer


def panels_of(
    named: Sequence[Named], drawn: Sequence[Line], ruler: Ruler, up: Axis, **choices: str
) -> list[Panel]:
    """Return a panel for each part; a name has the same colour in all of them."""
    numbers = {name: k for k, name in enumerate(dict.fromkeys(name for _, name, _ in named))}
    found: dict[str, list[Line]] = {}
    for (part, name, _), line in zip(named, drawn, strict=True):
        own = replace(line, x=ruler.shown(line.x), name=name, number=numbers[name])
        found.setdefault(part, []).append(own)
    return [Panel({"part": p} | choices, ruler.axis, up, lines) for p, lines in found.items()]


def alternative(words: str, span: str, panel: Panel) -> str:
    """Extent of the lines of a panel, in words."""
    told = [f"{line.name or 'the line'}: {labels.extent(line.y)}" for line in panel.lines]
    return f"Lines of {words} over {span}. {'; '.join(told)}."


def along(found: Sequence[tuple[Points, str]], x: str) -> tuple[list[Line], list[str]]:
    """Variables along a coordinate, all in one reading, and remarks on how they are drawn.

    A line of many points is cut into intervals: their means, in a band from the lowest to the
    highest of their points. Else the band is the interval of each point, where pd is drawn or
    the dataset has ``.._low`` and ``.._high``. Of other coordinates the first place is taken.
    """
    lazy: list[list[Any]] = []
    made: list[tuple[Side, int, float, bool]] = []
    for points, variable in found:
        side = points.side(x)
        kinds, confidence = _kinds(points.dataset, variable)
        most = STRETCHES * (1 if side.values.size > 2 * STRETCHES else 2)
        drawn = len(kinds) > 1
        shown = (MEAN, LOWEST, HIGHEST) if drawn or side.together(most) > 1 else (MEAN,)
        own = replace(points, dataset=kinds)
        lazy.append([own.cells(k if drawn else MEAN, [(side, most)], k).data for k in shown])
        made.append((side, most, confidence, drawn))
    result, remarks = [], []
    for (side, most, confidence, drawn), arrays in zip(made, dask.compute(*lazy), strict=True):
        mean, *ends = (np.asarray(a, float) for a in arrays)
        together = side.together(most)
        band: dict[str, Any] = dict(zip(("low", "high"), ends, strict=False))
        result.append(Line(side.middles(most), mean, together=together, **band))
        remarks.append(_remark(together, confidence, drawn))
    return result, list(dict.fromkeys(remarks))


def _kinds(dataset: xr.Dataset, variable: str) -> tuple[xr.Dataset, float]:
    """Mean, lowest and highest of a variable, as far as they differ; confidence of intervals."""
    segment = variable.removeprefix("pd_")
    if f"{variable}_low" in dataset:
        ends = {MEAN: variable, LOWEST: f"{variable}_low", HIGHEST: f"{variable}_high"}
        kinds = xr.Dataset({kind: dataset[name] for kind, name in ends.items()})
    elif segment in SEGMENTS and half_width(dataset, segment) is not None:
        kinds = detection_probability(dataset, segment)
        kinds = kinds.rename({"pd": MEAN, "low": LOWEST, "high": HIGHEST})
    else:
        return xr.Dataset({MEAN: dataset[variable]}), 0.0
    return kinds, float(kinds[LOWEST].attrs.get("confidence", 0.0))


def _remark(together: int, confidence: float, drawn: bool) -> str:
    """Remark on how a line is reduced; empty where each point is on it."""
    interval = f"{100 * confidence:g} % confidence interval" if confidence else "interval"
    if together > 1:
        with_ends = f", their {interval}s included" if confidence else ""
        return (
            f"line: mean of {together} neighbouring points; band: from the lowest of them "
            f"to the highest{with_ends}, so that no narrow dip is hidden"
        )
    return f"band: {interval} of each point" if drawn else ""
