"""The sheet of navigation's errors over altitude, a line for each scanner."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet
from matplotlib.lines import Line2D

from sweep.analysis import canvas, labels
from sweep.analysis.scenes.errors_over_altitude import ALTITUDE, Curve

AVAILABILITY, BIAS, RMSE = "availability", "bias", "rmse"
COMPONENTS = {"velocity": ("x", "y", "z"), ALTITUDE: ("",)}
UNITS = {"velocity": "m/s", ALTITUDE: "m"}
PANEL = 4.3, 3.0
"""Width and height of a panel [inches]."""

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")

_Panel = tuple[str, int]
"""A statistic, and the number of the component that it is of; one past the last is the length."""


def draw(
    curves: Sequence[Curve], *, quantity: str, show: str, title: str, remarks: Sequence[str]
) -> Sheet:
    """The sheet.

    Parameters
    ----------
    curves
        Errors of each scanner, at least one.
    quantity
        ``velocity`` or ``altitude``.
    show
        ``availability``, ``bias``, ``rmse`` or ``all``.
    title, remarks
        What stands over the sheet, and what is to be said at its foot.
    """
    rows = _rows(quantity, show)
    columns = max(len(row) for row in rows)
    sheet, axes = canvas.panels(
        PANEL[0] * columns + 1.9, PANEL[1] * len(rows) + 1.3, len(rows), columns, sharex=True
    )
    for number, panel in enumerate(axes):
        row, column = divmod(number, columns)
        if column >= len(rows[row]):
            panel.set_visible(False)
            continue
        _panel(panel, curves, rows[row][column], quantity)
        below = row + 1 < len(rows) and column < len(rows[row + 1])
        panel.tick_params(labelbottom=not below, labelsize=8)
        if not below:
            panel.set_xlabel(labels.with_units("altitude above ground", "m"), size=9)
    sheet.legend(
        handles=_handles(curves, any(s == RMSE for row in rows for s, _ in row)),
        loc="outside right upper", frameon=False, fontsize=9,
    )  # fmt: skip
    canvas.title(sheet, title)
    bins = curves[0].edges.size - 1
    said = f"{bins} bins of altitude"
    if any(s == BIAS for row in rows for s, _ in row):
        said += "; bars: standard error of the bias"
    canvas.caption(sheet, labels.joined([said, *remarks]))
    return sheet


def _rows(quantity: str, show: str) -> list[list[_Panel]]:
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


def _panel(axes: Axes, curves: Sequence[Curve], panel: _Panel, quantity: str) -> None:
    statistic, part = panel
    for i, curve in enumerate(curves):
        look: dict[str, Any] = {
            "color": canvas.LINES[i % 8], "marker": MARKERS[i % 8], "markersize": 4,
        }  # fmt: skip
        if statistic == AVAILABILITY:
            axes.plot(curve.middle, 100 * curve.tally.availability, linewidth=1.5, **look)
        elif statistic == BIAS:
            axes.errorbar(
                curve.middle, curve.bias[:, part], curve.bias_error[:, part], linewidth=1.3,
                elinewidth=0.8, capsize=2, **look,
            )  # fmt: skip
        else:
            axes.plot(curve.middle, curve.rmse[:, part], linewidth=1.5, **look)
            axes.plot(
                curve.middle, curve.predicted[:, part], linestyle="--", linewidth=1.1,
                color=look["color"],
            )  # fmt: skip
    axes.grid(True, color="0.92", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.set_title(_named(statistic, part, quantity), size=10)
    _scale(axes, curves, panel, quantity)
    if statistic != AVAILABILITY and not any(curve.tally.count.any() for curve in curves):
        axes.text(0.5, 0.5, "no solution", transform=axes.transAxes, ha="center", color="0.4")


def _scale(axes: Axes, curves: Sequence[Curve], panel: _Panel, quantity: str) -> None:
    """Units, and a logarithmic axis for errors."""
    statistic, part = panel
    if statistic == AVAILABILITY:
        axes.set_ylabel("share of cycles (%)", size=9)
        axes.set_ylim(-4, 104)
        return
    axes.set_ylabel(f"{'bias' if statistic == BIAS else 'error'} ({UNITS[quantity]})", size=9)
    if statistic == BIAS:
        axes.axhline(0.0, color="0.6", linewidth=0.8, zorder=1)
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-3, 4))
        return
    every = np.concatenate([c[:, part] for k in curves for c in (k.rmse, k.predicted)])
    known = every[np.isfinite(every) & (every > 0)]
    if known.size and known.max() > 4 * known.min():
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0.0)


def _named(statistic: str, part: int, quantity: str) -> str:
    """Title of a panel."""
    if statistic == AVAILABILITY:
        return f"{labels.coordinate(quantity)} available"
    names = COMPONENTS[quantity]
    word = "bias" if statistic == BIAS else "RMS error"
    if len(names) == 1:
        return f"{word} of the {quantity}"
    return f"{word} of the {quantity}" + (f", {names[part]}" if part < len(names) else " vector")


def _handles(curves: Sequence[Curve], predicted: bool) -> list[Line2D]:
    found = [
        Line2D(
            [], [], color=canvas.LINES[i % 8], marker=MARKERS[i % 8], markersize=4,
            label=labels.coordinate(curve.scanner),
        )
        for i, curve in enumerate(curves)
    ]  # fmt: skip
    if predicted:
        text = "standard deviation\nthat is stated"
        found.append(Line2D([], [], color="0.3", linestyle="--", label=text))
    return found
