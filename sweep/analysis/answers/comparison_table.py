"""Two studies compared: in a table, in a figure and in a sentence."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from sweep.analysis import canvas, labels
from sweep.analysis.answers.comparison import DETECTED
from sweep.analysis.charts import LOG, Axis, Chart, Line, Panel
from sweep.analysis.drawing import sheet_of
from sweep.model.outputs import PROMISED

COLUMNS = ("quantity", "differ", "median", "largest", "agree", "largest at")

Store = xr.Dataset | xr.DataTree

SHOWN = (
    *PROMISED, "log10_pfa_bin", "log10_pfa_segment", "log10_pfa_both_chirps",
    "log10_pfa_shot", "p_leakage_up", "p_leakage_down", "snr_up", "snr_doppler", "snr_down",
    "noise_variance", "range_error", "radial_velocity_error", "false_alarms", "range_rmse",
    "radial_velocity_rmse", "pfa_up", "pfa_down", DETECTED,
)  # fmt: skip


def compared(ours: Store, other: Store) -> dict[str, xr.Dataset]:
    """Differences of what a table shows, computed: by scanner, or of a grid under no name."""
    found = ours.sweep.compare(other)
    parts = {"": found} if isinstance(found, xr.Dataset) else _groups(found)
    return {part: _shown(dataset).compute() for part, dataset in parts.items()}


def _groups(tree: xr.DataTree) -> dict[str, xr.Dataset]:
    return {name: group.to_dataset() for name, group in tree.children.items()}


def _shown(found: xr.Dataset) -> xr.Dataset:
    return found[
        [n for n in found.data_vars if str(n).removesuffix("_allowed").removesuffix("_agrees")
         in SHOWN]
    ]  # fmt: skip


def rows(found: xr.Dataset) -> list[list[str]]:
    """A row for each quantity, in the order of `COLUMNS`; quantities without a point left out."""
    return [_row(found, name) for name in SHOWN if name in found and found[name].notnull().any()]


def _row(found: xr.Dataset, name: str) -> list[str]:
    array = found[name]
    known = np.isfinite(array.values)
    size = np.where(known, np.abs(array.values), -1.0)
    worst = np.unravel_index(int(np.argmax(size)), size.shape)
    share = "-"
    if f"{name}_agrees" in found:
        agrees = (found[f"{name}_agrees"].values & known).sum() / known.sum()
        # rounded down: nothing but all is 100 %
        share = f"{np.floor(1e4 * agrees) / 100:g} %"
    different = int((size > 0).sum())
    return [
        labels.with_units(name, str(array.attrs.get("units", ""))),
        f"{different:,}",
        f"{np.median(size[known]):.2g}",
        f"{array.values[worst]:+.3g}" if different else "0",
        share,
        _where(array, worst) if different else "-",
    ]


def _where(array: xr.DataArray, index: tuple[np.intp, ...]) -> str:
    """Coordinates of a point, in the order of the axes."""
    point = array.isel(dict(zip(array.dims, map(int, index), strict=True)))
    return ", ".join(_told(c) for c in point.coords.values())


def _told(coordinate: xr.DataArray) -> str:
    """A coordinate's value; with its name where no unit tells what it is."""
    units = str(coordinate.attrs.get("units", ""))
    value = labels.quantity(coordinate.values.item(), units)
    return value if units not in ("", "1") else f"{labels.coordinate(str(coordinate.name))} {value}"


def met(found: xr.Dataset) -> str:
    """How many shots two flights share, in words."""
    number, ours, other = found.sizes["shot"], found.attrs["shots"], found.attrs["other_shots"]
    if number == ours == other:
        return f"all {labels.counted(number, 'shot')}"
    return f"{labels.counted(number, 'shot')} that both have, of {ours:,} and {other:,}"


def verdict(parts: Iterable[xr.Dataset]) -> tuple[str, str]:
    """``same``, ``different`` or ``nothing``, and a sentence that says so."""
    number, apart, thing, counted = 0, 0, "point", ""
    for found in parts:
        if "shot" in found.dims:
            several = any(n > 1 for dim, n in found.sizes.items() if dim != "shot")
            thing, counted = "shot", ", counted at each place along the axes" * several
        pairs = [(found[n], found[f"{n}_agrees"]) for n in PROMISED if n in found]
        number += max((int(array.notnull().sum()) for array, _ in pairs), default=0)
        apart += max((int((array.notnull() & ~agrees).sum()) for array, agrees in pairs), default=0)
    if not number:
        return "nothing", "Nothing that both stores have is computed yet."
    if not apart:
        told = f"agree at {labels.counted(number, thing)}"
        return "same", f"Probabilities of detection {told}{counted}."
    told = f"differ at {apart:,} of {labels.counted(number, thing)}"
    return "different", f"Probabilities of detection {told}{counted}."


LEAST = 1e-16
"""Differences below it stand at the left edge of a figure."""


def save_figure(found: Mapping[str, xr.Dataset], path: Path) -> Path:
    """Draw the shares of points that differ by more than some amount, a colour a scanner."""
    with canvas.style():
        chart = figure(found)
        if chart is None:
            return canvas.save(canvas.empty("Nothing that both stores have is computed yet"), path)
        return canvas.save(sheet_of(chart, title=chart.heading, note=""), path)


def figure(found: Mapping[str, xr.Dataset]) -> Chart | None:
    """The chart of the differences; none where nothing that both have is computed."""
    parts = list(found.values())
    names = [n for n in PROMISED if any(n in part and part[n].notnull().any() for part in parts)]
    if not names:
        return None
    thing = "shot" if any("shot" in part.dims for part in parts) else "point"
    number = sum(int(part[names[0]].notnull().sum()) for part in parts)
    up = Axis(f"share of {thing}s beyond (%)", limits=(-3, 103))
    across = Axis("difference of pd, either way", LOG, (LEAST, 1.0))
    return Chart(
        f"{parts[0].attrs['other']}\nless {parts[0].attrs['ours']}",
        f"Shares of {thing}s that differ by more than some amount, of {', '.join(names)}.",
        [f"{number:,} {thing}s that both studies have"],
        [
            Panel({"probability": name}, across, up, [
                line for i, (scanner, part) in enumerate(found.items())
                for line in _shares(part, name, scanner, i)
            ])
            for name in names
        ],
        rows=[2] * (len(names) // 2) + [1] * (len(names) % 2),
    )  # fmt: skip


def _shares(found: xr.Dataset, name: str, scanner: str, number: int) -> list[Line]:
    """Shares of points beyond each difference that is, and beyond each that is allowed."""
    known = np.isfinite(found[name].values)
    lines = []
    for values, words, look in (
        (np.abs(found[name].values), "found", "line"),
        (found[f"{name}_allowed"].values, "allowed", "stated"),
    ):
        ordered = np.sort(np.maximum(np.broadcast_to(values, known.shape)[known], LEAST))
        share = 100 * (1 - np.arange(ordered.size + 1) / max(ordered.size, 1))
        x = np.repeat([LEAST, *ordered, 1.0], 2)[1:-1]
        y = np.repeat(share, 2)
        lines.append(Line(x, y, f"{scanner} {words}".strip(), number, look=look))
    return lines if known.any() else []
