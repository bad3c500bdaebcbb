"""Tables as plain text and as CSV; of any variable, averaged over all but rows and columns."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import xarray as xr

from sweep.analysis import labels
from sweep.analysis.selection import Points, beyond, confined
from sweep.analysis.tallies import Tally, medians, tallied

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
        """The page as plain text."""
        parts = [f"{self.title}\n{'=' * len(self.title)}"]
        parts += [f"{b.heading}\n\n{aligned(b.columns, b.rows)}" for b in self.blocks]
        parts += ["\n".join(self.notes)] if self.notes else []
        return "\n\n".join(parts) + "\n"

    def save(self, directory: Path, stem: str) -> list[Path]:
        """The page as `stem`.txt and `stem`.csv."""
        directory.mkdir(parents=True, exist_ok=True)
        text, table = directory / f"{stem}.txt", directory / f"{stem}.csv"
        text.write_text(self.text(), encoding="utf-8")
        with table.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(self.records[0]) if self.records else [])
            writer.writeheader()
            writer.writerows(self.records)
        return [text, table]


def written(cell: Cell) -> str:
    """A cell's text; nothing for nan."""
    if isinstance(cell, float):
        return "-" if math.isnan(cell) else f"{cell:.5g}"
    return str(cell)


def percent(value: float, form: str = ".3f") -> str:
    """A fraction in percent; nothing for nan."""
    return "-" if math.isnan(value) else f"{100 * value:{form}} %"


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
    """A variable's mean and median over all but rows and columns."""
    found = confined(found, spec, asked.where)
    if asked.minimum_range:
        found = beyond(found, spec, f"{asked.minimum_range!r} m", included=True)
    columns = found.distinct(asked.columns) if asked.columns else [None]
    named = [
        (row, column, of_row.where(asked.columns, [column]) if asked.columns else of_row)
        for row, of_row in found.apart(asked.rows)
        for column in columns
    ]
    parts = [part for _, _, part in named]
    tallies = tallied(parts, asked.variable)
    middles = medians(parts, asked.variable, [tally.number for tally in tallies])
    records = [
        {
            "row": labels.quantity(row, found.units(asked.rows)),
            "column": _column(found, asked.columns, column),
            **_statistics(tally, middle, _published(asked.printed, *divmod(k, len(columns)))),
        }
        for k, ((row, column, _), tally, middle) in enumerate(
            zip(named, tallies, middles, strict=True)
        )
    ]
    names = list(dict.fromkeys(str(r["column"]) for r in records))
    of = f"of {labels.with_brackets(asked.variable, units)}"
    blocks = [
        _matrix(f"{heading} {of}", labels.coordinate(asked.rows), key, records, names)
        for key, heading in (("mean", "Mean"), ("median", "Median"), ("printed", "Printed value"),
                             ("printed_over_mean", "Printed over mean"))
        if any(r[key] == r[key] for r in records)
    ]  # fmt: skip
    return Page(title, blocks, [], records)


def _column(found: Points, name: str, value: object) -> str:
    return labels.valued(name, value, found.units(name)) if name else "all"


def _published(printed: Any, row: int, column: int) -> float:
    """The printed figure of a row and column; of one row of numbers, that of the row."""
    if row >= len(printed):
        return math.nan
    values = printed[row] if isinstance(printed[row], tuple | list) else (printed[row],)
    return float(values[column]) if column < len(values) else math.nan


def _statistics(tally: Tally, middle: float, printed: float) -> dict[str, Cell]:
    return {
        "points": tally.number,
        "mean": tally.mean,
        "median": middle,
        "lowest": tally.least if tally.number else math.nan,
        "highest": tally.largest if tally.number else math.nan,
        "printed": printed,
        "printed_over_mean": printed / tally.mean if tally.mean else math.nan,
    }


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
