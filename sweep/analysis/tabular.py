"""Tables as plain text and as CSV."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

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
    """Whether a cell holds a number, as such or as text."""
    try:
        float(str(cell).removesuffix(" %").replace(",", ""))
    except ValueError:
        return False
    return True
