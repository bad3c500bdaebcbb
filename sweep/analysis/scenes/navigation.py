"""Errors of navigation by altitude: availability, bias and scatter; their chart and table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import dask
import numpy as np
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.charts import LINEAR, LOG, Axis, Chart, Line, Panel
from sweep.analysis.opening import chunk, stretches
from sweep.analysis.scenes.recording import Recording
from sweep.analysis.tables import Block, Cell, Page
from sweep.model.navigation import EXCLUDED, SOLVED

VELOCITY, ALTITUDE = "velocity", "altitude"

STRETCH = 65_536
"""Solutions that are read at a time, about."""


@dataclass(frozen=True, eq=False)
class Tally:
    """Errors of a vector of m components, by bin of altitude; parts add up to the whole.

    Solutions asked for, and those that there were (bins,); their mean error, the sum of squares of
    deviations from it, and the mean of the variances that they came with (bins, m).
    """

    attempts: np.ndarray
    count: np.ndarray
    mean: np.ndarray
    deviation: np.ndarray
    predicted: np.ndarray

    def __add__(self, other: Tally) -> Tally:
        """Tally of both, by Chan, Golub and LeVeque (1983), which never subtracts large sums."""
        count = self.count + other.count
        share = (other.count / np.maximum(count, 1))[..., None]
        apart = other.mean - self.mean
        between = self.count[..., None] * share * apart * apart
        return Tally(
            self.attempts + other.attempts,
            count,
            self.mean + share * apart,
            self.deviation + other.deviation + between,
            self.predicted + share * (other.predicted - self.predicted),
        )

    @property
    def availability(self) -> np.ndarray:
        """Share of attempts with a solution (...,), 0..1; nan without attempts."""
        return _over(self.count, self.attempts)

    @property
    def bias(self) -> np.ndarray:
        """Mean error (..., m); nan without solutions."""
        return np.where(self.count[..., None] > 0, self.mean, np.nan)

    @property
    def rmse(self) -> np.ndarray:
        """Root mean square error of each component (..., m), bias included; nan without any."""
        return np.sqrt(_over(self.deviation, self.count[..., None]) + self.mean**2)

    @property
    def variance(self) -> np.ndarray:
        """Unbiased variance of the errors (..., m); nan with fewer than two solutions."""
        return _over(self.deviation, self.count[..., None] - 1)

    @property
    def stated(self) -> np.ndarray:
        """Mean variance that the solutions stated (..., m); nan without any."""
        return np.where(self.count[..., None] > 0, self.predicted, np.nan)


@dataclass(frozen=True)
class Curve:
    """Errors of one scanner's velocity or altitude, by bins between edges of true altitude [m]."""

    scanner: str
    quantity: str
    edges: np.ndarray
    tally: Tally

    @property
    def words(self) -> str:
        """Name for a reader."""
        return labels.coordinate(self.scanner) or "measured"

    @property
    def middle(self) -> np.ndarray:
        """Altitudes in the middle of the bins [m]."""
        return (self.edges[1:] + self.edges[:-1]) / 2

    @property
    def bias_error(self) -> np.ndarray:
        """Standard error of the bias (bins, m); nan with fewer than two solutions."""
        return np.sqrt(self.tally.variance / np.maximum(self.tally.count, 1)[:, None])

    @property
    def rmse(self) -> np.ndarray:
        """Root mean square error of each component and of the vector's length, (bins, m [+ 1])."""
        return _with_length(self.tally.rmse)

    @property
    def predicted(self) -> np.ndarray:
        """Standard deviation that solutions state of themselves, as `rmse`: root of the mean."""
        return _with_length(np.sqrt(self.tally.stated))


def _with_length(parts: np.ndarray) -> np.ndarray:
    """Components (..., m), and of vectors the root of the sum of their squares after them."""
    if parts.shape[-1] == 1:
        return parts
    return np.concatenate([parts, np.linalg.norm(parts, axis=-1, keepdims=True)], axis=-1)


def curves(named: Sequence[tuple[str, Recording]], *, quantity: str, bins: int) -> list[Curve]:
    """Errors of scanners that navigate, all over the same bins of altitude."""
    able = [(name, own.dataset) for name, own in named if "velocity_status" in own.dataset]
    edges = _edges([dataset for _, dataset in able], bins)
    if edges is None:
        return []
    return [
        Curve(name, quantity, edges, merge(list(_tallies(dataset, quantity, edges))))
        for name, dataset in able
    ]


def _edges(datasets: Sequence[xr.Dataset], bins: int) -> np.ndarray | None:
    """Edges of the bins; none where no cycle's altitude is known."""
    altitudes = [dataset["true_altitude"].chunk(cycle=STRETCH) for dataset in datasets]
    ends = dask.compute([altitude.min() for altitude in altitudes],
                        [altitude.max() for altitude in altitudes])  # fmt: skip
    if not np.isfinite(ends).any():
        return None
    low, high = float(np.nanmin(ends[0])), float(np.nanmax(ends[1]))
    if high - low < 1e-6 * max(abs(high), 1.0):
        low, high, bins = low - 0.5, high + 0.5, 1
    edges = np.linspace(low, high, bins + 1)
    edges[-1] = np.nextafter(high, np.inf)  # the highest cycle is in the last bin
    return edges


def _tallies(dataset: xr.Dataset, quantity: str, edges: np.ndarray) -> Iterator[Tally]:
    status = dataset[f"{quantity}_status"]
    draws_a_chunk = chunk(status, "draw")
    draws = stretches(status, "draw", draws_a_chunk)
    cycles = stretches(status, "cycle", max(1, STRETCH // draws_a_chunk))
    for cycle, draw in product(cycles, draws):
        part = dataset.isel(cycle=cycle, draw=draw)
        state, found = part[f"{quantity}_status"].values, part[quantity].values
        altitude = np.broadcast_to(part["true_altitude"].values[:, None], state.shape)
        cell = np.digitize(np.nan_to_num(altitude.ravel(), nan=-np.inf), edges) - 1
        cell = np.where(state.ravel() >= SOLVED, cell, -1)
        if quantity == ALTITUDE:
            variance = part["altitude_variance"].values
        else:
            variance = np.diagonal(part["velocity_covariance"].values, axis1=-2, axis2=-1)
        error = found - part[f"true_{quantity}"].values[:, None]
        components = -1, len(COMPONENTS[quantity])
        yield tally(
            error.reshape(components), variance.reshape(components),
            (state.ravel() >= SOLVED) & (state.ravel() <= EXCLUDED), cell, edges.size - 1,
        )  # fmt: skip


def tally(
    error: np.ndarray, variance: np.ndarray, available: np.ndarray, cell: np.ndarray, cells: int
) -> Tally:
    """Tally of n solutions by cell, in two passes for the digits' sake.

    Of each its error and the variance that it states (n, m), and its cell.
    """
    inside = (cell >= 0) & (cell < cells)
    attempts = np.bincount(cell[inside], minlength=cells)
    held = inside & available
    error, variance, cell = error[held], variance[held], cell[held]
    count = np.bincount(cell, minlength=cells)
    some = np.maximum(count, 1)[:, None]
    mean = _add_up(error, cell, cells) / some
    apart = error - mean[cell]
    rest = _add_up(apart, cell, cells) / some  # what rounding left in the mean
    deviation = _add_up(apart * apart, cell, cells)
    predicted = _add_up(variance, cell, cells) / some
    return Tally(attempts, count, mean + rest, deviation, predicted)


def merge(tallies: Sequence[Tally]) -> Tally:
    """Tally of all, added pair by pair, then pairs of pairs: the same bits for the same order."""
    if not tallies:
        raise ValueError("there is no tally to merge")
    level = list(tallies)
    while len(level) > 1:
        pairs = [a + b for a, b in zip(level[::2], level[1::2], strict=False)]
        level = pairs + level[2 * len(pairs) :]
    return level[0]


def _add_up(values: np.ndarray, cell: np.ndarray, size: int) -> np.ndarray:
    """Return sums of values (n, m) by cell (size, m), each in the order of the rows."""
    return np.stack([np.bincount(cell, column, size) for column in values.T], axis=-1)


def _over(total: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Quotient, nan where the number is not positive."""
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


AVAILABILITY, BIAS, RMSE = "availability", "bias", "rmse"
COMPONENTS = {VELOCITY: ("x", "y", "z"), ALTITUDE: ("",)}
UNITS = {VELOCITY: "m/s", ALTITUDE: "m"}
LENGTH = "vector"

Statistic = tuple[str, int]
"""A statistic, and the number of the component that it is of; one past the last is the length."""


def navigation_chart(curves: Sequence[Curve], show: str) -> Chart:
    """Errors over altitude, a panel for each statistic and a line for each curve."""
    panels, rows = [], []
    for quantity in dict.fromkeys(curve.quantity for curve in curves):
        own = [curve for curve in curves if curve.quantity == quantity]
        every = _rows(quantity, show)
        rows += [len(row) for row in every]
        panels += [_panel(own, quantity, *statistic) for row in every for statistic in row]
    titles = [panel.title for panel in panels]
    caption = [f"{curves[0].edges.size - 1} bins of altitude, over all draws"]
    if any("bias" in title for title in titles):
        caption[0] += "; bars: standard error of the bias"
    if any("error" in title for title in titles):
        caption.append("as stated: root of the mean variance that solutions give for themselves")
    return Chart(
        "Navigation", f"Lines of navigation's errors over altitude: {', '.join(titles)}.", caption,
        panels, {"statistic": "Shown"}, rows=rows,
    )  # fmt: skip


def _rows(quantity: str, show: str) -> list[list[Statistic]]:
    """Panels row by row: what there is over all components first, then component by component."""
    number = len(COMPONENTS[quantity])
    parts = list(range(number))
    if number == 1:
        asked = [AVAILABILITY, BIAS, RMSE] if show == "all" else [show]
        return [[(statistic, 0) for statistic in asked]]
    if show == "all":
        first = [(AVAILABILITY, 0), (RMSE, number)]
        return [first, [(BIAS, i) for i in parts], [(RMSE, i) for i in parts]]
    if show == RMSE:
        return [[(RMSE, number), (RMSE, 0)], [(RMSE, i) for i in parts[1:]]]
    return [[(show, i) for i in (parts if show == BIAS else [0])]]


def _panel(curves: Sequence[Curve], quantity: str, statistic: str, part: int) -> Panel:
    names = COMPONENTS[quantity]
    component = names[part] if part < len(names) else LENGTH
    of = f"of the {quantity}" + (f", {component}" if len(names) > 1 else "")
    units, middle = UNITS[quantity], curves[0].middle
    lines: list[Line] = []
    if statistic == AVAILABILITY:
        title, up = f"{quantity} available", Axis("share of cycles (%)", limits=(-4, 104))
        lines += [Line(middle, 100 * curve.tally.availability, curve.words, k)
                  for k, curve in enumerate(curves)]  # fmt: skip
    elif statistic == BIAS:
        title, up = f"bias {of}", Axis(f"bias ({units})")
        lines.append(Line(middle[[0, -1]], np.zeros(2), look="level"))
        for k, curve in enumerate(curves):
            bias, error = curve.tally.bias[:, part], curve.bias_error[:, part]
            lines.append(
                Line(middle, bias, curve.words, k, low=bias - error, high=bias + error,
                     look="bars")
            )  # fmt: skip
    else:
        every = np.concatenate([c[:, part] for k in curves for c in (k.rmse, k.predicted)])
        known = every[np.isfinite(every) & (every > 0)]
        wide = known.size > 0 and known.max() > 4 * known.min()
        title = f"RMS error {of}"
        up = Axis(f"error ({units})", LOG if wide else LINEAR, None if wide else (0.0, None))
        for k, curve in enumerate(curves):
            lines.append(Line(middle, curve.rmse[:, part], curve.words, k))
            name = f"{curve.words}, as stated"
            lines.append(Line(middle, curve.predicted[:, part], name, k, look="stated"))
    if statistic != AVAILABILITY and not any(curve.tally.count.any() for curve in curves):
        title += ": no solution"
    return Panel({"statistic": title}, Axis("altitude above ground (m)"), up, lines)


def navigation_page(
    curves: Sequence[Curve], *, show: str, title: str, remarks: Sequence[str]
) -> Page:
    """Return a block for each curve of a quantity, a row for each bin of altitude."""
    shown = (AVAILABILITY, BIAS, RMSE) if show == "all" else (show,)
    blocks, records = [], []
    for curve in curves:
        own = [_record(curve, i, shown) for i in range(curve.edges.size - 1)]
        columns = [name for name in own[0] if name != "scanner"]
        rows = [[record[name] for name in columns] for record in own]
        blocks.append(Block(f"{curve.words}: {curve.quantity}", columns, rows))
        records += own
    units = ", ".join(dict.fromkeys(UNITS[curve.quantity] for curve in curves))
    notes = [
        "from, to: true altitude above ground [m]; cycles: measurement cycles times draws.",
        f"bias, rmse, stated: in {units}; stated: root of the mean variance that",
        "  solutions give for themselves; error of bias: its standard error.",
        *remarks,
    ]
    return Page(title, blocks, notes, records)


def _record(curve: Curve, i: int, shown: Sequence[str]) -> dict[str, Cell]:
    """One line of the CSV file."""
    record: dict[str, Cell] = {
        "scanner": curve.scanner,
        "from": float(curve.edges[i]),
        "to": float(curve.edges[i + 1]),
        "cycles": int(curve.tally.attempts[i]),
        "solved": int(curve.tally.count[i]),
    }
    names = COMPONENTS[curve.quantity]
    if AVAILABILITY in shown:
        record["available"] = float(curve.tally.availability[i])
    if BIAS in shown:
        for k, name in enumerate(names):
            record[f"bias {name}".strip()] = float(curve.tally.bias[i, k])
            record[f"error of bias {name}".strip()] = float(curve.bias_error[i, k])
    if RMSE in shown:
        for k, name in enumerate((*names, LENGTH) if len(names) > 1 else names):
            record[f"rmse {name}".strip()] = float(curve.rmse[i, k])
            record[f"stated {name}".strip()] = float(curve.predicted[i, k])
    return record
