"""Tables of any variable: averaged over all but rows and columns, or of a single point."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.cuts import beyond
from sweep.analysis.selection import Points, confined
from sweep.analysis.tabular import Block, Cell, Page
from sweep.analysis.tallies import Search, Tally, for_median, median, pieces, search, tallied

if TYPE_CHECKING:
    from sweep.spec import Spec


def mean_page(found: Points, spec: Spec, figure: Mapping[str, Any], units: str, title: str) -> Page:
    """A variable's mean and median over all but rows and columns.

    Parameters
    ----------
    found, spec
        Points with the variable, and the study.
    figure
        `variable`, `rows`, `columns` (may be empty), `where`, `minimum_range` [m], `printed`.
    units, title
        Of the variable; what stands over the page.
    """
    found = confined(found, spec, figure["where"])
    if figure["minimum_range"]:
        found = beyond(found, spec, f"{figure['minimum_range']!r} m", included=True)
    columns = found.distinct(figure["columns"]) if figure["columns"] else [None]
    named = [
        (row, column, of_row.where(figure["columns"], [column]) if figure["columns"] else of_row)
        for row, of_row in found.apart(figure["rows"])
        for column in columns
    ]
    statistics = _statistics([part for _, _, part in named], figure["variable"])
    records = [
        _record(
            part,
            figure,
            (row, column),
            own,
            _published(figure["printed"], *divmod(k, len(columns))),
        )
        for k, ((row, column, part), own) in enumerate(zip(named, statistics, strict=True))
    ]
    names = list(dict.fromkeys(str(r["column"]) for r in records))
    blocks = [
        _matrix(f"{heading} of {figure['variable']}{_units(units)}", key, records, names, figure)
        for key, heading in (("mean", "Mean"), ("median", "Median"), ("printed", "Printed value"),
                             ("printed_over_mean", "Printed over mean"))
        if any(r[key] == r[key] for r in records)
    ]  # fmt: skip
    return Page(title, blocks, [], records)


def _units(units: str) -> str:
    return f" [{units}]" if units not in ("", "1") else ""


def _published(printed: Any, row: int, column: int) -> float:
    """The printed figure of a row and column; of one row of numbers, that of the row."""
    if row >= len(printed):
        return math.nan
    values = printed[row] if isinstance(printed[row], tuple | list) else (printed[row],)
    return float(values[column]) if column < len(values) else math.nan


def _statistics(parts: list[Points], variable: str) -> list[tuple[Tally, float]]:
    """Tally and median of a variable over each part."""
    tallies = tallied(parts, variable)
    searches = [for_median(tally.number) for tally in tallies]

    def read() -> Iterator[tuple[Search, np.ndarray, None]]:
        for number, _, values in pieces(parts, [variable]):
            own = values[variable]
            yield searches[number], own[np.isfinite(own)], None

    search(searches, read)
    return [(tally, median(found)) for tally, found in zip(tallies, searches, strict=True)]


def _record(
    part: Points, figure: Mapping[str, Any], place: tuple[object, object],
    statistics: tuple[Tally, float], printed: float,
) -> dict[str, Cell]:  # fmt: skip
    tally, middle = statistics
    names = zip((figure["rows"], figure["columns"]), place, strict=True)
    labelled = [
        labels.quantity(value, part.column(name).units) if value is not None else "all"
        for name, value in names
    ]
    return {
        "row": labelled[0],
        "column": f"{labels.coordinate(figure['columns'])} {labelled[1]}".strip(),
        "points": tally.number,
        "mean": tally.mean,
        "median": middle,
        "lowest": tally.least if tally.number else math.nan,
        "highest": tally.largest if tally.number else math.nan,
        "printed": printed,
        "printed_over_mean": printed / tally.mean if tally.mean else math.nan,
    }


def _matrix(
    heading: str, key: str, records: list[dict[str, Cell]], names: list[str],
    figure: Mapping[str, Any],
) -> Block:  # fmt: skip
    """One figure of every record, rows down and columns across."""
    rows: dict[str, list[Cell]] = {}
    for record in records:
        rows.setdefault(str(record["row"]), []).append(record[key])
    corner = labels.coordinate(figure["rows"])
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
