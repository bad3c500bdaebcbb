"""A variable along a coordinate: every point of it or stretches, and the band about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import dask
import numpy as np
import xarray as xr

from sweep.analysis.answers.probability import SEGMENTS, detection_probability, half_width
from sweep.analysis.cells import HIGHEST, LOWEST, MEAN, Side
from sweep.analysis.selection import Points

STRETCHES = 500
"""Stretches into which a line of more than twice as many points is cut."""


@dataclass(frozen=True)
class Line:
    """Values of points, or of stretches of neighbouring ones.

    Attributes
    ----------
    x, mean : (n,) ndarray
        Where they are, and their means; nan where there is none.
    low, high : (n,) ndarray or None
        Lowest and highest value of a stretch, or lower and upper end of a point's interval; of a
        stretch of points with intervals the lowest and highest of their ends.
    together
        Points in a stretch.
    confidence
        Of the intervals; 0 where there are none, or where it is not the same everywhere.
    """

    x: np.ndarray
    mean: np.ndarray
    low: np.ndarray | None
    high: np.ndarray | None
    together: int
    confidence: float

    @property
    def remark(self) -> str:
        """What a reader has to know of how it is drawn; empty where each point is on it."""
        sure = f" of a confidence of {self.confidence:g}" if self.confidence else ""
        if self.together > 1:
            with_ends = f", their intervals{sure} included" if sure else ""
            return (
                f"line: mean of {self.together} neighbouring points; band: from the lowest of them "
                f"to the highest{with_ends}, so that no narrow dip is hidden"
            )
        return f"band: interval of each point{sure}" if self.low is not None else ""


def lines(found: Sequence[tuple[Points, str]], x: str) -> list[Line]:
    """Variables along a coordinate, all in one reading.

    Parameters
    ----------
    found
        Points of each line, and its variable; where coordinates beside `x` vary, their first place
        is taken. A variable has intervals where it is a probability of detection that is drawn,
        or has variables of its own for them, ``.._low`` and ``.._high``.
    x
        The coordinate.
    """
    made = [_Asked(own, variable, own.side(x)) for own, variable in found]
    computed = iter(dask.compute(*(array for one in made for array in one.lazy())))
    result = []
    for one in made:
        values = {kind: np.asarray(next(computed), float) for kind in one.shown}
        result.append(
            Line(
                one.side.middles(one.most), values[MEAN], values.get(LOWEST), values.get(HIGHEST),
                one.side.together(one.most), one.confidence,
            )
        )  # fmt: skip
    return result


class _Asked:
    """A line before it is computed."""

    def __init__(self, found: Points, variable: str, side: Side) -> None:
        kinds, self.confidence, drawn = _kinds(found.dataset, variable)
        self.side, self._found = side, replace(found, dataset=kinds)
        self.most = STRETCHES * (1 if side.values.size > 2 * STRETCHES else 2)
        several = drawn or side.together(self.most) > 1
        self.shown = (MEAN, LOWEST, HIGHEST) if several else (MEAN,)

    def lazy(self) -> list[Any]:
        """Arrays of what is shown, not computed."""
        return [self._found.cells(kind, [(self.side, self.most)], kind).data for kind in self.shown]


def _kinds(dataset: xr.Dataset, variable: str) -> tuple[xr.Dataset, float, bool]:
    """What is taken the mean, lowest and highest of; how sure intervals are; if there are any."""
    segment = variable.removeprefix("pd_")
    if f"{variable}_low" in dataset:
        ends = {MEAN: variable, LOWEST: f"{variable}_low", HIGHEST: f"{variable}_high"}
        kinds = xr.Dataset({kind: dataset[name] for kind, name in ends.items()})
    elif segment in SEGMENTS and half_width(dataset, segment) is not None:
        kinds = detection_probability(dataset, segment)
        kinds = kinds.rename({"pd": MEAN, "low": LOWEST, "high": HIGHEST})
    else:
        return xr.Dataset(dict.fromkeys((MEAN, LOWEST, HIGHEST), dataset[variable])), 0.0, False
    return kinds, float(kinds[LOWEST].attrs.get("confidence", 0.0)), True
