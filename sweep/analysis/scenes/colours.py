"""Colours of points: a scale for amounts, a colour for each name."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, LogNorm, Normalize, to_rgba
from matplotlib.figure import Figure as Sheet
from matplotlib.lines import Line2D

from sweep.analysis import canvas, labels
from sweep.analysis.scenes.quantities import CATEGORIES, KINDS, SIGNED, WIDE, label

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
class Scale:
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

    def bar(self, sheet: Sheet, axes: Axes) -> None:
        """A colour bar that fills the axes."""
        bar = sheet.colorbar(ScalarMappable(self.norm, self.cmap), cax=axes, extend=self.extend)
        bar.set_label(self.label, fontsize=9)
        bar.ax.tick_params(labelsize=8)
        if not isinstance(self.norm, LogNorm):
            bar.ax.ticklabel_format(useOffset=False)


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
        """What a legend shows."""
        return [
            Line2D(
                [], [], linestyle="", marker="o", markersize=6, label=name,
                color=self.colours.get(number, NOTHING),
            )
            for number, name in self.names.items()
        ]  # fmt: skip


def chosen(
    quantity: str, values: np.ndarray, *, trusted: np.ndarray, surfaces: Sequence[str]
) -> Scale | Names:
    """Colours for values of a quantity.

    Parameters
    ----------
    quantity
        Name of the quantity.
    values : (n,) ndarray
        Of every point, as :func:`sweep.analysis.scenes.quantities.shown` gives them.
    trusted : (n,) ndarray of bool
        Points from which the ends of a scale are taken, if there are any; others may lie beyond.
    surfaces
        Names of surfaces by number.
    """
    if quantity in CATEGORIES:
        numbers = [int(n) for n in np.unique(values[np.isfinite(values)])]
        if quantity == "flags":
            return Names("point", {n: labels.coordinate(list(KINDS)[n]) for n in numbers})
        if len(numbers) <= len(canvas.LINES):
            named = dict(enumerate(surfaces)) if quantity == "surface" else {}
            every = {n: named.get(n, "none" if n < 0 else f"{n}") for n in numbers}
            return Names(labels.coordinate(quantity), every)
    return _scale(quantity, values, trusted)


def _ends(known: np.ndarray) -> tuple[float, float]:
    """Ends of a scale: lowest and highest value, but no few values that lie far from all others."""
    if not known.size:
        return 1.0, 1.0
    low, bottom, top, high = (float(q) for q in np.quantile(known, [0.0, 0.005, 0.995, 1.0]))
    far = LONELY * (top - bottom)
    return (bottom if bottom - low > far else low), (top if high - top > far else high)


def _scale(quantity: str, values: np.ndarray, trusted: np.ndarray) -> Scale:
    finite = values[np.isfinite(values)]
    known = values[trusted & np.isfinite(values)]
    known = known if known.size else finite
    wide = quantity in WIDE
    known = known[known > 0] if wide else known
    low, high = _ends(known)
    cmap = colormaps[canvas.SCALE]
    if quantity in SIGNED and low < 0 < high:
        cmap, low, high = BOTH_SIGNS, -max(-low, high), max(-low, high)
    if high <= low:
        low, high = (low / 2, high * 2) if wide else (low - 0.5, high + 0.5)
    below, above = bool((finite < low).any()), bool((finite > high).any())
    return Scale(
        cmap,
        LogNorm(low, high) if wide else Normalize(low, high),
        textwrap.fill(label(quantity), 44),
        {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above],
    )
