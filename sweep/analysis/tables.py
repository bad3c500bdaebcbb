"""Tables as text and as CSV: of any variable, and of false alarms as the thesis prints them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.answers.probability import of_a_shot
from sweep.analysis.selection import (
    NEAREST,
    Points,
    beyond,
    confined,
    cuts,
    parameters_at,
    split,
    statistics,
)
from sweep.model import noise_only
from sweep.model.looks import Looks
from sweep.model.shot import evaluate
from sweep.model.threshold import tnr_of
from sweep.units import percent

if TYPE_CHECKING:
    from sweep.spec import Spec
    from sweep.spec import Table as Asked

Cell = str | float | int


@dataclass(frozen=True)
class Block:
    """One table of a page: a heading, the names of its columns, its rows."""

    heading: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]


@dataclass(frozen=True)
class Page:
    """Tables under one title, with notes; and the same figures as records for a CSV file."""

    title: str
    blocks: Sequence[Block]
    notes: Sequence[str]
    records: Sequence[dict[str, Cell]]

    def text(self) -> str:
        """Return the page as plain text."""
        parts = [f"{self.title}\n{'=' * len(self.title)}"]
        parts += [f"{b.heading}\n\n{aligned(b.columns, b.rows)}" for b in self.blocks]
        parts += ["\n".join(self.notes)] if self.notes else []
        return "\n\n".join(parts) + "\n"

    def save(self, directory: Path, stem: str) -> list[Path]:
        """Write the page as `stem`.txt and `stem`.csv."""
        directory.mkdir(parents=True, exist_ok=True)
        text, table = directory / f"{stem}.txt", directory / f"{stem}.csv"
        text.write_text(self.text(), encoding="utf-8")
        frame = pandas.DataFrame(self.records)
        frame.to_csv(table, index=False, na_rep="nan", lineterminator="\r\n")
        return [text, table]


def written(cell: Cell) -> str:
    """Return a cell's text; nothing for nan."""
    if isinstance(cell, float):
        return "-" if math.isnan(cell) else f"{cell:.5g}"
    return str(cell)


def aligned(columns: Sequence[str], rows: Sequence[Sequence[Cell]]) -> str:
    """Columns side by side: text to the left, numbers to the right."""
    cells = [list(columns), *([written(cell) for cell in row] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(columns))]
    to_left = [not any(_numeric(row[i]) for row in rows) for i in range(len(columns))]
    lines = [
        "  ".join(
            text.ljust(width) if left else text.rjust(width)
            for text, width, left in zip(row, widths, to_left, strict=True)
        ).rstrip()
        for row in cells
    ]
    return "\n".join([lines[0], "-" * sum((*widths, 2 * len(widths) - 2)), *lines[1:]])


def _numeric(cell: Cell) -> bool:
    """Tell whether a cell holds a number, as such or as text."""
    try:
        float(str(cell).removesuffix(" %").replace(",", ""))
    except ValueError:
        return False
    return True


def mean_page(found: Points, spec: Spec, asked: Asked, units: str, title: str) -> Page:
    """Return a variable's mean and median over all but rows and columns."""
    found = confined(found, spec, asked.where)
    if asked.minimum_range:
        found = beyond(found, spec, f"{asked.minimum_range!r} m", included=True)
    columns = found.distinct(asked.columns) if asked.columns else [None]
    named = [
        (row, column, of_row.where(asked.columns, [column]) if asked.columns else of_row)
        for row, of_row in found.apart(asked.rows)
        for column in columns
    ]
    figures = statistics([part for *_, part in named], asked.variable)
    records: list[dict[str, Cell]] = []
    for k, ((row, column, _), own) in enumerate(zip(named, figures, strict=True)):
        printed = _published(asked.printed, *divmod(k, len(columns)))
        records.append(
            {
                "row": labels.quantity(row, found.units(asked.rows)),
                "column": labels.valued(asked.columns, column, found.units(asked.columns))
                if asked.columns else "all",
                "points": own.number, "mean": own.mean, "median": own.median,
                "lowest": own.least, "highest": own.largest, "printed": printed,
                "printed_over_mean": printed / own.mean if own.mean else math.nan,
            }
        )  # fmt: skip
    names = list(dict.fromkeys(str(r["column"]) for r in records))
    of = f"of {labels.with_brackets(asked.variable, units)}"
    blocks = [
        _matrix(f"{heading} {of}", labels.coordinate(asked.rows), key, records, names)
        for key, heading in (("mean", "Mean"), ("median", "Median"), ("printed", "Printed value"),
                             ("printed_over_mean", "Printed over mean"))
        if any(r[key] == r[key] for r in records)
    ]  # fmt: skip
    return Page(title, blocks, [], records)


def _published(printed: Any, row: int, column: int) -> float:
    """Return the printed figure of a row and column; of one row of numbers, that of the row."""
    if row >= len(printed):
        return math.nan
    values = printed[row] if isinstance(printed[row], tuple | list) else (printed[row],)
    return float(values[column]) if column < len(values) else math.nan


def _matrix(
    heading: str, corner: str, key: str, records: list[dict[str, Cell]], names: list[str]
) -> Block:
    """One figure of every record, rows down and columns across."""
    rows: dict[str, list[Cell]] = {}
    for record in records:
        rows.setdefault(str(record["row"]), []).append(record[key])
    return Block(heading, (corner, *names), [(name, *cells) for name, cells in rows.items()])


def outputs_page(dataset: xr.Dataset) -> Page:
    """Every variable of a study of a single point."""
    records: list[dict[str, Cell]] = [
        {
            "variable": str(name),
            "value": float(array.values),
            "units": str(array.attrs.get("units", "")),
            "meaning": str(array.attrs.get("long_name", "")),
        }
        for name, array in sorted(dataset.data_vars.items())
    ]
    columns = ("variable", "value", "units", "meaning")
    block = Block("Outputs of the point", columns, [tuple(r.values()) for r in records])
    return Page(str(dataset.attrs.get("title", "")), [block], [], records)


MOST_ROWS = 100


def leakage(groups: Sequence[Points]) -> list[dict[str, Cell]]:
    """Mean and median of the leakage of points, and of noise or leakage in both chirps."""
    dataset = groups[0].dataset
    with_shot = dataset.assign(shot_with_leakage=of_a_shot(dataset, leakage=True))
    groups = [replace(group, dataset=with_shot) for group in groups]
    found: list[dict[str, Cell]] = [{} for _ in groups]
    for name in ("p_leakage_up", "p_leakage_down", "shot_with_leakage"):
        for record, own in zip(found, statistics(groups, name), strict=True):
            record |= {f"{name}_mean": own.mean, f"{name}_median": own.median}
    return found


def reference(spec: Spec, setting: dict[str, Any]) -> tuple[dict[str, Cell], float]:
    """Noise alone, in closed form and by the model with a target that reflects nothing.

    Of a shot at a setting of the instrument, a part of a record; and of a bin, by the model.
    """
    first = parameters_at(spec, dict.fromkeys((axis.name for axis in spec.axes), 0))
    parameters = first | setting | {"target.reflectance": 0.0}
    tnr = float(tnr_of(parameters))
    in_a_bin = noise_only.bin_probability(tnr, Looks.of(parameters))
    both = [noise_only.bins_counted(parameters, in_a_bin, s) for s in ("up", "down")]
    closed_form = noise_only.segment_probability(np.asarray(in_a_bin), both).prod()
    found = evaluate(parameters)
    return {
        "tnr": tnr,
        "bins": float(both[0]),
        "closed_form": float(closed_form),
        "noise_only": float(found["pfa_both_chirps"].item()),
    }, float(found["pfa_bin"].item())


def settings(found: Points, spec: Spec, by: str) -> list[tuple[str, dict[str, Any], Points]]:
    """Points apart by `by` and what else varies but range and angle: name, SI values, points."""
    cut_names = {name for cut in cuts(spec) for name in (cut.along, cut.held)}
    names = [by, *(n for n in found.varying() if n != by and n not in cut_names)]
    paths = [spec.member(name).path for name in names]
    parts, _ = split(found, names, MOST_ROWS)
    values = [parameters_at(spec, part.first()) for _, part in parts]
    return [
        (name, {path: own[path] for path in paths}, part)
        for (name, part), own in zip(parts, values, strict=True)
    ]


def false_alarms(
    found: Points, spec: Spec, *, by: str, printed: Sequence[Sequence[float]] = ()
) -> list[dict[str, Cell]]:
    """Make a record of false alarms of each setting of the instrument in each cut."""
    settled = settings(found, spec, by)
    alone = [reference(spec, setting)[0] for _, setting, _ in settled]
    groups = [
        (i, j, cut.name, beyond(cut.of(part), spec, NEAREST))
        for i, (_, _, part) in enumerate(settled)
        for j, cut in enumerate(cuts(spec))
    ]
    alarms = statistics([points for *_, points in groups], "pfa_both_chirps")
    leaked = leakage([points for *_, points in groups])
    records: list[dict[str, Cell]] = []
    for (i, j, cut, points), both, leak in zip(groups, alarms, leaked, strict=True):
        noise, figure = alone[i], _published(printed, i, j)
        mean_excess, excess = (
            noise_only.variance_excess_of_shot(p, float(noise["tnr"]), float(noise["bins"]))
            for p in (both.mean, figure)
        )
        records.append(
            {
                "setting": settled[i][0], "cut": cut, "points": points.size, **noise,
                "study_mean": both.mean, "study_variance_excess": mean_excess,
                "printed": figure, "printed_over_closed_form": figure / float(noise["closed_form"]),
                "printed_variance_excess": excess, **leak,
            }
        )  # fmt: skip
    return records


_FALSE_ALARMS = {
    "setting": ("setting", ""), "cut": ("cut", ""), "points": ("points", ""),
    "closed form": ("closed_form", ".6e"), "noise only": ("noise_only", ".6e"),
    "study's mean": ("study_mean", ".6e"), "excess of mean": ("study_variance_excess", ".1e%"),
}  # fmt: skip
_PRINTED = {
    "printed": ("printed", ".3e"), "printed/closed": ("printed_over_closed_form", ".3f"),
    "excess of printed": ("printed_variance_excess", ".4f%"),
}  # fmt: skip
_LEAKAGE = {
    "setting": ("setting", ""), "cut": ("cut", ""),
    "up: mean": ("p_leakage_up_mean", ".3e"), "up: median": ("p_leakage_up_median", ".3e"),
    "down: mean": ("p_leakage_down_mean", ".3e"), "down: median": ("p_leakage_down_median", ".3e"),
    "shot: mean": ("shot_with_leakage_mean", ".3e"),
    "shot: median": ("shot_with_leakage_median", ".3e"),
}  # fmt: skip
_THRESHOLDS = {
    "setting": ("setting", ""), "closed form": ("closed_form", ".6e"),
    "noise only": ("noise_only", ".6e"), "study's mean": ("study_mean", ".6e"),
    "printed": ("printed", ".3g"), "printed/closed": ("printed_over_closed_form", ".3f"),
    "excess of printed": ("printed_variance_excess", ".3f%"),
}  # fmt: skip
"""Columns of tables: the figure of a record in each, and its format."""


def false_alarm_page(found: Points, spec: Spec, *, by: str, printed: Any = (), title: str) -> Page:
    """Tables 4.3 to 4.5: false alarms of a shot, a row for each value of a coordinate."""
    records = false_alarms(found, spec, by=by, printed=printed)
    published = any(record["printed"] == record["printed"] for record in records)
    blocks = [
        _block(
            "Probability of a false alarm in both chirp segments, from noise",
            _FALSE_ALARMS | (_PRINTED if published else {}), records,
        ),
        _block(
            "Leakage: extra groups raised by the signal's own sidelobes", _LEAKAGE, records
        ),
    ]  # fmt: skip
    bins = ", ".join(labels.number(n) for n in sorted({float(r["bins"]) for r in records}))
    notes = [
        f"closed form: (1 - (1 - p)^N)^2, p = exp(-(4 - pi)/4 TNR^2), N = {bins}.",
        *_COMMON_NOTES,
        "With bins_counted 'half' the model leaves out the bins of the detection, the closed form",
        "  none. Shot (leakage): noise or leakage raises an extra group in both chirp segments.",
    ]
    return Page(title, blocks, notes, records)


def threshold_page(found: Points, spec: Spec, *, by: str, printed: Any = (), title: str) -> Page:
    """Table 4.2: false alarms of a bin, a row for each threshold."""
    records: list[dict[str, Cell]] = []
    settled = settings(found, spec, by)
    means = statistics([beyond(part, spec, NEAREST) for _, _, part in settled], "pfa_bin")
    for i, (name, setting, _) in enumerate(settled):
        noise, of_bin = reference(spec, setting)
        tnr = float(noise["tnr"])
        closed = noise_only.bin_probability(tnr)
        published = _published(printed, i, 0)
        records.append(
            {
                "setting": name,
                "tnr": tnr,
                "closed_form": closed,
                "noise_only": of_bin,
                "study_mean": means[i].mean,
                "printed": published,
                "printed_over_closed_form": published / closed,
                "printed_variance_excess": noise_only.variance_excess_of_bin(published, tnr),
            }
        )
    heading = "Probability that a bin of noise crosses the threshold"
    notes = ["closed form: exp(-(4 - pi)/4 TNR^2)", *_COMMON_NOTES]
    return Page(title, [_block(heading, _THRESHOLDS, records)], notes, records)


_COMMON_NOTES = (
    "noise only: the model with a reflectance of 0.",
    f"study's mean: over points beyond {NEAREST} of range, the echo's own shot noise included.",
    "excess: noise variance above the one that sets the threshold, as a figure implies.",
    "  Nothing is tuned to the printed figures.",
)


def _block(
    heading: str, columns: Mapping[str, tuple[str, str]], records: Sequence[dict[str, Cell]]
) -> Block:
    """Return a table of some figures of each record."""
    rows = [[_written(record[key], form) for key, form in columns.values()] for record in records]
    return Block(heading, tuple(columns), rows)


def _written(value: Cell, form: str) -> Cell:
    if not form:
        return value
    if form.endswith("%"):
        return percent(float(value), form[:-1]) if value == value else "-"
    return format(value, form) if value == value else "-"
