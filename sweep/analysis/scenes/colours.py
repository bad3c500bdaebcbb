"""Sheets of points: colours for amounts and names, marks, legends and ticks."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, LogNorm, Normalize, to_rgba
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator
from scipy.spatial import cKDTree

from sweep.analysis import canvas, labels
from sweep.analysis.scenes.recording import CATEGORIES, KINDS, SIGNED, WIDE, label

BOTH_SIGNS = LinearSegmentedColormap.from_list(
    "both_signs",
    [(0.0, "#7CC6EE"), (0.36, "#0072B2"), (0.5, "#2B2B33"), (0.64, "#D55E00"), (1.0, "#F5B26B")],
)
"""Dark at zero, blue and orange to its sides: apart for the colour-blind, and on a pale ground.

Small values have their sign's colour already; larger ones are paler.
"""

NOTHING = "0.6"
"""Colour of what has no value or name."""

LONELY = 0.25
"""Share of a scale's length by which a few values may lie beyond the others and still be on it."""


@dataclass(frozen=True)
class Amounts:
    """Colours of amounts."""

    cmap: Colormap
    norm: Normalize
    label: str
    extend: str = "neither"

    def of(self, values: np.ndarray) -> np.ndarray:
        """Colours of values, (n, 4)."""
        known = np.isfinite(values)
        colours = np.asarray(self.cmap(self.norm(np.where(known, values, 1.0))))
        colours[~known] = to_rgba(NOTHING)
        return colours


@dataclass(frozen=True)
class Names:
    """Colours of names, by number."""

    title: str
    names: Mapping[int, str]

    @property
    def colours(self) -> dict[int, str]:
        """Colour of each number; what has none is grey."""
        named = [number for number in self.names if number >= 0]
        return dict(zip(named, canvas.LINES, strict=False))

    def of(self, values: np.ndarray) -> np.ndarray:
        """Colours of numbers, (n, 4)."""
        found = np.tile(to_rgba(NOTHING), (np.size(values), 1))
        for number, colour in self.colours.items():
            found[np.asarray(values) == number] = to_rgba(colour)
        return found

    def handles(self) -> list[Line2D]:
        """Entries of a legend."""
        return [
            mark("o", name, color=self.colours.get(number, NOTHING))
            for number, name in self.names.items()
        ]


def mark(marker: str, words: str, **look: Any) -> Line2D:
    """Return a legend's entry for a mark."""
    return Line2D([], [], linestyle="", marker=marker, label=words, **{"markersize": 6} | look)


def false_point() -> Line2D:
    """Return a legend's entry for false points."""
    return mark("x", "false point", color="0.2", markersize=5)


def chosen(
    quantity: str, values: np.ndarray, *, trusted: np.ndarray, surfaces: Sequence[str]
) -> Amounts | Names:
    """Colours for values of a quantity."""
    if quantity in CATEGORIES:
        numbers = [int(n) for n in np.unique(values[np.isfinite(values)])]
        if quantity == "flags":
            return Names("point", {n: labels.coordinate(list(KINDS)[n]) for n in numbers})
        if len(numbers) <= len(canvas.LINES):
            named = dict(enumerate(surfaces)) if quantity == "surface" else {}
            every = {n: named.get(n, "none" if n < 0 else f"{n}") for n in numbers}
            return Names(labels.coordinate(quantity), every)
    return _amounts(quantity, values, trusted)


def _ends(known: np.ndarray) -> tuple[float, float]:
    """Return the ends of a scale: lowest and highest value, without a few outliers."""
    if not known.size:
        return 1.0, 1.0
    low, bottom, top, high = (float(q) for q in np.quantile(known, [0.0, 0.005, 0.995, 1.0]))
    far = LONELY * (top - bottom)
    return (bottom if bottom - low > far else low), (top if high - top > far else high)


def _amounts(quantity: str, values: np.ndarray, trusted: np.ndarray) -> Amounts:
    finite = values[np.isfinite(values)]
    known = values[trusted & np.isfinite(values)]
    known = known if known.size else finite
    wide = quantity in WIDE
    low, high = _ends(known[known > 0] if wide else known)
    cmap = colormaps[canvas.SCALE]
    if quantity in SIGNED and low < 0 < high:
        cmap, low, high = BOTH_SIGNS, -max(-low, high), max(-low, high)
    if high <= low:
        low, high = (low / 2, high * 2) if wide else (low - 0.5, high + 0.5)
    below, above = bool((finite < low).any()), bool((finite > high).any())
    return Amounts(
        cmap,
        LogNorm(low, high) if wide else Normalize(low, high),
        textwrap.fill(label(quantity), 44),
        {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above],
    )


COLUMN = 1.75
"""Width of what stands at the right [inches]."""

HEAD, FOOT, LINE = 0.75, 0.55, 0.17
"""Heights of the title and of the small print's first line and of each further one [inches]."""


class Stage:
    """A sheet with a picture of a given size, and what its colours and marks mean at its right."""

    def __init__(self, width: float, height: float, *, title: str, note: str) -> None:
        self.width, self.height = width, height
        head = HEAD + 0.18 * title.count("\n")
        total = width + COLUMN
        self.foot = FOOT + LINE * (len(note) // int(15 * total))
        self.sheet = canvas.sheet(total, height + head + self.foot)
        self.sheet.set_layout_engine("none")
        canvas.title(self.sheet, title)
        canvas.caption(self.sheet, note)

    def rectangle(
        self, left: float, bottom: float, width: float, height: float
    ) -> tuple[float, float, float, float]:
        """Convert a rectangle in inches from the lower left corner to shares of the sheet."""
        across, up = self.sheet.get_size_inches()
        return left / across, (self.foot + bottom) / up, width / across, height / up

    def axes(self, *at: float, **options: Any) -> Axes:
        """Axes in a rectangle in inches from the picture's lower left corner."""
        return self.sheet.add_axes(self.rectangle(*at), **options)

    def explain(self, scale: Amounts | Names, handles: Sequence[Artist]) -> None:
        """Return the colours' scale or names, and the marks' meaning."""
        if isinstance(scale, Amounts):
            tall = min(0.72 * self.height, 4.2)
            axes = self.axes(self.width + 0.15, (self.height - tall) * 0.62, 0.17, tall)
            bar = self.sheet.colorbar(
                ScalarMappable(scale.norm, scale.cmap), cax=axes, extend=scale.extend
            )
            bar.set_label(scale.label, fontsize=9)
            bar.ax.tick_params(labelsize=8)
            if not isinstance(scale.norm, LogNorm):
                bar.ax.ticklabel_format(useOffset=False)
        elif scale.names:
            self._legend(scale.handles(), 0.86 * self.height, scale.title, "upper left")
        if handles:
            self._legend(handles, 0.0, "", "lower left")

    def _legend(self, handles: Sequence[Artist], bottom: float, title: str, loc: Any) -> None:
        x, y, *_ = self.rectangle(self.width + 0.02, bottom, 0, 0)
        self.sheet.legend(
            handles=list(handles), title=title or None, loc=loc, bbox_to_anchor=(x, y),
            frameon=False, fontsize=8, handletextpad=0.5, borderaxespad=0.0,
        )  # fmt: skip


LARGEST = 24.0
"""Area of the largest marks of points [square points]."""

READABLE = ((2000, 9.0), (8000, 5.0), (30_000, 2.0), (math.inf, 0.7))
"""Areas below which marks of so many points are not made [square points]."""

ACROSS, UP = 0.42, 0.25
"""Distances of ticks that can still be read, on level and on upright axes [inches]."""

FAR = 1e5
"""Coordinates [m] from which on axes show them relative to a round number."""


def mark_size(places: np.ndarray, width: float, height: float) -> float:
    """Area of a mark [square points] that leaves points (2, n) apart on a picture [inches]."""
    number = places.shape[1]
    if number < 2:
        return LARGEST
    nearest = cKDTree(places.T).query(places.T[:: max(1, number // 1000)], k=2)[0][:, 1]
    apart = (0.85 * 72 * float(np.median(nearest))) ** 2
    share = 0.1 * 72 * 72 * width * height / number
    least = next(size for most, size in READABLE if number <= most)
    return min(max(min(apart, share), least), LARGEST)


def false_marks(size: float) -> dict[str, Any]:
    """Look of false points among true ones of a size."""
    return {"marker": "x", "s": max(1.2 * size, 9.0), "linewidths": 0.7}


def lengths(
    axis: Any, name: str, limits: tuple[float, float], inches: float, apart: float = ACROSS
) -> None:
    """Name, units and ticks of an axis of metres; far-off ones relative to a round number."""
    low, high = limits
    shift = 0.0
    if max(abs(low), abs(high)) > FAR:
        unit = 10.0 ** max(math.ceil(math.log10(high - low)), 0)
        shift = unit * round((low + high) / 2 / unit)
    number = min(max(int(inches / apart), 1), 8)
    axis.set_major_locator(MaxNLocator(number, steps=[1, 2, 2.5, 5, 10], min_n_ticks=1))
    if shift:
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value - shift:g}"))
        name = f"{name} {'-' if shift > 0 else '+'} {abs(shift):.0f}"
    axis.set_label_text(labels.with_units(name, "m"))
    axis.label.set_size(9)
    axis.set_tick_params(labelsize=8)
