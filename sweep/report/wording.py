"""Words under and in the place of charts, and how values stand on their axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm

from sweep.analysis import labels, surface
from sweep.analysis.figures import Study
from sweep.report import looks
from sweep.spec import Slices, Surface


@dataclass(frozen=True)
class Ruler:
    """How a coordinate stands on an axis: in the units that a reader wants, words as they are."""

    words: str
    factor: float
    units: str
    kind: str

    @classmethod
    def of(cls, study: Study, name: str, values: np.ndarray) -> Ruler:
        """The ruler of a coordinate with such values."""
        units = str(study.dataset[name].attrs.get("units", "")) if name in study.dataset else ""
        if labels.is_words(values):
            return cls(labels.coordinate(name), 1.0, "", "category")
        factor, units = labels.shown_in(values, units)
        kind = "log" if surface.is_geometric(values) else "linear"
        return cls(labels.with_units(labels.coordinate(name), units), factor, units, kind)

    def shown(self, values: np.ndarray) -> np.ndarray:
        """Values as they are shown, in the digits that a screen can show."""
        if self.kind == "category":
            return np.array([str(value) for value in values])
        return (values * self.factor).astype(np.float32)

    @property
    def axis(self) -> dict[str, Any]:
        """The axis of a chart."""
        return looks.axis(self.words, type=self.kind)

    @property
    def at_side(self) -> dict[str, Any]:
        """The axis at the side of a chart."""
        return looks.upright(self.words, type=self.kind)

    def span(self, values: np.ndarray) -> str:
        """First and last value in words."""
        shown = self.shown(values)
        ends = [labels.quantity(v, self.units) for v in (shown[0], shown[-1])]
        return f"{self.words} from {ends[0]} to {ends[1]}"


@dataclass(frozen=True)
class Scale:
    """How a variable's values are coloured: probabilities from 0 to 1, wide spans by decades."""

    low: float
    high: float
    decades: bool
    words: str

    @classmethod
    def of(cls, variable: str, words: str, layers: Sequence[np.ndarray]) -> Scale:
        """The scale of some layers of a variable."""
        norm = surface.scale(variable, np.concatenate([layer.ravel() for layer in layers]))
        low, high = float(norm.vmin or 0.0), float(norm.vmax or 0.0)
        if isinstance(norm, LogNorm):
            return cls(np.log10(low), np.log10(high), True, f"log10 of {words}")
        return cls(low, high, False, words)

    def shown(self, values: np.ndarray) -> np.ndarray:
        """Values as they are coloured."""
        if not self.decades:
            return values
        return np.log10(np.where(values > 0, values, np.nan))


def held(figure: Surface | Slices) -> str:
    """What a figure is confined to."""
    return ", ".join(
        f"{labels.coordinate(name)} {value}"
        for name, value in figure.where.items()
        if not isinstance(value, tuple)
    )


def sentences(parts: Sequence[str]) -> list[str]:
    """Parts as sentences, empty ones left out."""
    return [labels.joined([part]) for part in parts if part]


def left_out(number: int) -> str:
    """That some values are not on the page."""
    return f"{labels.counted(number, 'further choice')} not on this page" if number else ""


def gaps(layers: Sequence[np.ndarray]) -> str:
    """That some points have no value."""
    some = any(np.isnan(layer).any() for layer in layers)
    return "Empty: not computed, or without a value" if some else ""


def spread(values: np.ndarray) -> str:
    """Lowest, median and highest of values in words."""
    known = values[np.isfinite(values)]
    if not known.size:
        return "no value is known"
    low, middle, high = (f"{q:.3g}" for q in np.quantile(known, [0, 0.5, 1]))
    return f"lowest {low}, median {middle}, highest {high}"
