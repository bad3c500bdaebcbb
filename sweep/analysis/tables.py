"""Tables as text and CSV: of any variable, and of false alarms in the form of the thesis.

[T] is the thesis that :mod:`sweep.model` names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.answers.probability import false_alarms_per_shot
from sweep.analysis.selection import (
    FALSE_ALARM_AVERAGING_RANGE_MIN,
    PointSelection,
    compute_statistics,
    parameters_at,
    select_beyond_range,
    select_where,
    split_by_coordinates,
    study_cuts,
)
from sweep.model.detection import noise_false_alarms
from sweep.model.detection.looks import Looks
from sweep.model.evaluation import evaluate
from sweep.model.threshold import tnr_from_parameters
from sweep.units import percent_text

if TYPE_CHECKING:
    from sweep.spec import GridSpec
    from sweep.spec import TableFigure as TableSpec

TableCell = str | float | int
"""Type of a value in a table cell."""


@dataclass(frozen=True)
class TextTable:
    """Heading, column names and rows of a table on a page."""

    heading: str
    """Heading above the table."""
    columns: Sequence[str]
    """Names of the columns."""
    rows: Sequence[Sequence[TableCell]]
    """Cells of each row, in the order of the columns."""


@dataclass(frozen=True)
class TablePage:
    """Page of tables as text, and the same numbers as records for a CSV file."""

    title: str
    """Title of the page."""
    page_tables: Sequence[TextTable]
    """Tables of the page, from top to bottom."""
    notes: Sequence[str]
    """Lines of text below the tables."""
    records: Sequence[dict[str, TableCell]]
    """Rows of the CSV file, each as a mapping by column name."""

    def to_text(self) -> str:
        """Return the page as plain text: title, tables and notes."""
        parts = [f"{self.title}\n{'=' * len(self.title)}"]
        parts += [
            f"{b.heading}\n\n{format_aligned_table(b.columns, b.rows)}" for b in self.page_tables
        ]
        parts += ["\n".join(self.notes)] if self.notes else []
        return "\n\n".join(parts) + "\n"

    def save_files(self, directory: Path, stem: str) -> list[Path]:
        """Write the page to the files STEM.txt and STEM.csv of a directory; return their paths."""
        directory.mkdir(parents=True, exist_ok=True)
        text_path, csv_path = directory / f"{stem}.txt", directory / f"{stem}.csv"
        text_path.write_text(self.to_text(), encoding="utf-8")
        frame = pandas.DataFrame(self.records)
        frame.to_csv(csv_path, index=False, na_rep="nan", lineterminator="\r\n")
        return [text_path, csv_path]


def format_cell(cell: TableCell) -> str:
    """Return the text of a table cell: numbers with five digits, '-' for nan."""
    if isinstance(cell, float):
        return "-" if math.isnan(cell) else f"{cell:.5g}"
    return str(cell)


def format_aligned_table(columns: Sequence[str], rows: Sequence[Sequence[TableCell]]) -> str:
    """Return a table as text with aligned columns: words to the left, numbers to the right."""
    cells = [list(columns), *([format_cell(cell) for cell in row] for row in rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(columns))]
    is_left_aligned = [not any(_is_numeric(row[i]) for row in rows) for i in range(len(columns))]
    lines = [
        "  ".join(
            cell_text.ljust(width) if is_left else cell_text.rjust(width)
            for cell_text, width, is_left in zip(row, widths, is_left_aligned, strict=True)
        ).rstrip()
        for row in cells
    ]
    return "\n".join([lines[0], "-" * sum((*widths, 2 * len(widths) - 2)), *lines[1:]])


def _is_numeric(cell: TableCell) -> bool:
    """Return True if a cell holds a number, or the text of a number."""
    try:
        float(str(cell).removesuffix(" %").replace(",", ""))
    except ValueError:
        return False
    return True


def mean_table_page(
    points: PointSelection, spec: GridSpec, table_spec: TableSpec, units: str, title: str
) -> TablePage:
    """Return a page with tables of the mean and the median of a variable over two coordinates.

    Parameters
    ----------
    points
        Points of the study.
    spec
        Spec of the study.
    table_spec
        Spec of the table: variable, coordinates of its rows and columns, selected points, and
        published values for comparison.
    units
        Units of the variable.
    title
        Title of the page.
    """
    points = select_where(points, spec, table_spec.where)
    if table_spec.minimum_range:
        points = select_beyond_range(
            points, spec, f"{table_spec.minimum_range!r} m", inclusive=True
        )
    column_values = points.unique_values(table_spec.columns) if table_spec.columns else [None]
    cells = [
        (
            row,
            column,
            row_points.sel(table_spec.columns, [column]) if table_spec.columns else row_points,
        )
        for row, row_points in points.group_by(table_spec.rows)
        for column in column_values
    ]
    cell_statistics = compute_statistics(
        [cell_points for *_, cell_points in cells], table_spec.variable
    )
    records: list[dict[str, TableCell]] = []
    for k, ((row, column, _), statistic) in enumerate(zip(cells, cell_statistics, strict=True)):
        printed_value = _published_value(table_spec.printed, *divmod(k, len(column_values)))
        records.append(
            {
                "row": labels.format_quantity(row, points.coordinate_units(table_spec.rows)),
                "column": labels.format_coordinate_value(
                    table_spec.columns, column, points.coordinate_units(table_spec.columns)
                )
                if table_spec.columns
                else "all",
                "points": statistic.n_finite,
                "mean": statistic.mean,
                "median": statistic.median,
                "lowest": statistic.minimum,
                "highest": statistic.maximum,
                "printed": printed_value,
                "printed_over_mean": printed_value / statistic.mean if statistic.mean else math.nan,
            }
        )
    column_names = list(dict.fromkeys(str(r["column"]) for r in records))
    variable_phrase = f"of {labels.column_label(table_spec.variable, units)}"
    page_tables = [
        _pivot_table(
            f"{heading} {variable_phrase}",
            labels.coordinate_label(table_spec.rows),
            key,
            records,
            column_names,
        )
        for key, heading in (
            ("mean", "Mean"),
            ("median", "Median"),
            ("printed", "Printed value"),
            ("printed_over_mean", "Printed over mean"),
        )
        if any(r[key] == r[key] for r in records)
    ]
    return TablePage(title, page_tables, [], records)


def _published_value(printed_rows: Any, row: int, column: int) -> float:
    """Return the published value at a row and column of a table; nan if the spec has none.

    `printed_rows` are the published values in the spec: for each row a list, or a number if the row
    has a single column.
    """
    if row >= len(printed_rows):
        return math.nan
    row_values = (
        printed_rows[row] if isinstance(printed_rows[row], tuple | list) else (printed_rows[row],)
    )
    return float(row_values[column]) if column < len(row_values) else math.nan


def _pivot_table(
    heading: str,
    corner: str,
    record_key: str,
    records: list[dict[str, TableCell]],
    column_names: list[str],
) -> TextTable:
    """Return a table with the value under one key of each record.

    The records' entries `row` and `column` state the place in the table. `corner` is the heading of
    the row names, `record_key` the key of the value.
    """
    rows: dict[str, list[TableCell]] = {}
    for record in records:
        rows.setdefault(str(record["row"]), []).append(record[record_key])
    return TextTable(
        heading, (corner, *column_names), [(name, *cells) for name, cells in rows.items()]
    )


def single_point_page(dataset: xr.Dataset) -> TablePage:
    """Return a page with all variables of a study that has a single point."""
    records: list[dict[str, TableCell]] = [
        {
            "variable": str(name),
            "value": float(array.values),
            "units": str(array.attrs.get("units", "")),
            "meaning": str(array.attrs.get("long_name", "")),
        }
        for name, array in sorted(dataset.data_vars.items())
    ]
    columns = ("variable", "value", "units", "meaning")
    outputs_table = TextTable("Outputs of the point", columns, [tuple(r.values()) for r in records])
    return TablePage(str(dataset.attrs.get("title", "")), [outputs_table], [], records)


TABLE_ROWS_MAX = 100
"""Largest number of settings, and so of rows, in a table."""


def leakage_records(groups: Sequence[PointSelection]) -> list[dict[str, TableCell]]:
    """Return statistics of the leakage probabilities of each group of points, as parts of records.

    The statistics are mean and median of the probability of a false alarm due to leakage in the
    up-chirp, due to leakage in the down-chirp, and due to noise or leakage in both chirps.
    """
    dataset = groups[0].dataset
    dataset_with_shot = dataset.assign(
        shot_with_leakage=false_alarms_per_shot(dataset, leakage=True)
    )
    groups = [replace(group, dataset=dataset_with_shot) for group in groups]
    records: list[dict[str, TableCell]] = [{} for _ in groups]
    for name in ("p_leakage_up", "p_leakage_down", "shot_with_leakage"):
        for record, group_statistics in zip(records, compute_statistics(groups, name), strict=True):
            record |= {
                f"{name}_mean": group_statistics.mean,
                f"{name}_median": group_statistics.median,
            }
    return records


class NoiseAlarmReference(NamedTuple):
    """Probabilities of false alarms due to noise alone, at one setting of the instrument."""

    record: dict[str, TableCell]
    """Part of a record, by key.

    It has `tnr`, `bins` (independent bins of a chirp), and the probability of a false alarm in both
    chirps: `closed_form`, and `noise_only` by the model.
    """
    pfa_bin: float
    """Probability of a false alarm in a bin, by the model."""


def noise_false_alarm_reference(
    spec: GridSpec, setting_parameters: dict[str, Any]
) -> NoiseAlarmReference:
    """Return the probabilities of false alarms due to noise alone, in closed form and by the model.

    Parameters
    ----------
    spec
        Spec of the study; its first point supplies all other parameters.
    setting_parameters
        SI values of the parameters that define a setting of the instrument, by dotted path.

    Returns
    -------
    NoiseAlarmReference
        Probabilities of a false alarm in both chirps and in a bin.

    Notes
    -----
    The closed form is the product of 1 - (1 - p)^N over both chirps, with the probability p in a
    bin and the number N of independent bins. In the model, the target has a reflectance of 0.
    """
    first_parameters = parameters_at(spec, dict.fromkeys((axis.name for axis in spec.axes), 0))
    parameters = first_parameters | setting_parameters | {"target.reflectance": 0.0}
    tnr = float(tnr_from_parameters(parameters))
    pfa_bin = noise_false_alarms.bin_pfa(tnr, Looks.from_parameters(parameters))
    n_bins = [
        noise_false_alarms.n_alarm_equivalent_bins(parameters, pfa_bin, s) for s in ("up", "down")
    ]
    closed_form = noise_false_alarms.segment_pfa(np.asarray(pfa_bin), n_bins).prod()
    outputs = evaluate(parameters)
    record: dict[str, TableCell] = {
        "tnr": tnr,
        "bins": float(n_bins[0]),
        "closed_form": float(closed_form),
        "noise_only": float(outputs["pfa_both_chirps"].item()),
    }
    return NoiseAlarmReference(record, float(outputs["pfa_bin"].item()))


class PointsOfSetting(NamedTuple):
    """Points with one setting of the instrument."""

    name: str
    """Name of the setting."""
    parameters: dict[str, Any]
    """SI values of the parameters that define the setting, by dotted path."""
    points: PointSelection
    """Points with this setting."""


def split_by_setting(points: PointSelection, spec: GridSpec, by: str) -> list[PointsOfSetting]:
    """Group points by the setting of the instrument: all coordinates except range and angle.

    The coordinate `by` comes first in the names of the groups.

    Returns
    -------
    list of PointsOfSetting
        Name, parameters and points of each setting.
    """
    cut_names = {
        name for cut in study_cuts(spec) for name in (cut.varying_coordinate, cut.fixed_coordinate)
    }
    names = [by, *(n for n in points.varying_coordinates() if n != by and n not in cut_names)]
    paths = [spec.axis_parameter(name).path for name in names]
    parts = split_by_coordinates(points, names, TABLE_ROWS_MAX).parts
    parameters_of_parts = [parameters_at(spec, part.points.first_indices()) for part in parts]
    return [
        PointsOfSetting(name, {path: parameters[path] for path in paths}, part)
        for (name, part), parameters in zip(parts, parameters_of_parts, strict=True)
    ]


def false_alarm_records(
    grid_points: PointSelection, spec: GridSpec, *, by: str, printed: Sequence[Sequence[float]] = ()
) -> list[dict[str, TableCell]]:
    """Return statistics of false alarms for each setting of the instrument and each cut.

    Parameters
    ----------
    grid_points
        Points of the study.
    spec
        Spec of the study.
    by
        Name of the coordinate that comes first in the names of settings.
    printed
        Published values: for each setting a list with a value for each cut.
    """
    setting_parts = split_by_setting(grid_points, spec, by)
    noise_references = [
        noise_false_alarm_reference(spec, part.parameters).record for part in setting_parts
    ]
    cut_groups = [
        (
            i,
            j,
            cut.name,
            select_beyond_range(
                cut.select_from(setting_points), spec, FALSE_ALARM_AVERAGING_RANGE_MIN
            ),
        )
        for i, (_, _, setting_points) in enumerate(setting_parts)
        for j, cut in enumerate(study_cuts(spec))
    ]
    pfa_statistics = compute_statistics(
        [cut_points for *_, cut_points in cut_groups], "pfa_both_chirps"
    )
    leakage_rows = leakage_records([cut_points for *_, cut_points in cut_groups])
    records: list[dict[str, TableCell]] = []
    for (i, j, cut, cut_points), pfa_statistic, leakage_row in zip(
        cut_groups, pfa_statistics, leakage_rows, strict=True
    ):
        noise_reference, printed_value = noise_references[i], _published_value(printed, i, j)
        mean_excess, printed_excess = (
            noise_false_alarms.variance_excess_from_shot_pfa(
                p, float(noise_reference["tnr"]), float(noise_reference["bins"])
            )
            for p in (pfa_statistic.mean, printed_value)
        )
        records.append(
            {
                "setting": setting_parts[i][0],
                "cut": cut,
                "points": cut_points.n_points,
                **noise_reference,
                "study_mean": pfa_statistic.mean,
                "study_variance_excess": mean_excess,
                "printed": printed_value,
                "printed_over_closed_form": printed_value / float(noise_reference["closed_form"]),
                "printed_variance_excess": printed_excess,
                **leakage_row,
            }
        )
    return records


_FALSE_ALARM_COLUMNS = {
    "setting": ("setting", ""), "cut": ("cut", ""), "points": ("points", ""),
    "closed form": ("closed_form", ".6e"), "noise only": ("noise_only", ".6e"),
    "study's mean": ("study_mean", ".6e"), "excess of mean": ("study_variance_excess", ".1e%"),
}  # fmt: skip
"""Record key and number format of each column of the table of false alarms, by column name."""
_PUBLISHED_VALUE_COLUMNS = {
    "printed": ("printed", ".3e"), "printed/closed": ("printed_over_closed_form", ".3f"),
    "excess of printed": ("printed_variance_excess", ".4f%"),
}  # fmt: skip
"""Record key and number format of the false-alarm table's columns with published values."""
_LEAKAGE_COLUMNS = {
    "setting": ("setting", ""), "cut": ("cut", ""),
    "up: mean": ("p_leakage_up_mean", ".3e"), "up: median": ("p_leakage_up_median", ".3e"),
    "down: mean": ("p_leakage_down_mean", ".3e"), "down: median": ("p_leakage_down_median", ".3e"),
    "shot: mean": ("shot_with_leakage_mean", ".3e"),
    "shot: median": ("shot_with_leakage_median", ".3e"),
}  # fmt: skip
"""Record key and number format of each column of the table of leakage, by column name.

Leakage is the probability of a false alarm due to the window's sidelobes.
"""
_THRESHOLD_COLUMNS = {
    "setting": ("setting", ""), "closed form": ("closed_form", ".6e"),
    "noise only": ("noise_only", ".6e"), "study's mean": ("study_mean", ".6e"),
    "printed": ("printed", ".3g"), "printed/closed": ("printed_over_closed_form", ".3f"),
    "excess of printed": ("printed_variance_excess", ".3f%"),
}  # fmt: skip
"""Record key and number format of each column of the table of thresholds, by column name."""


def false_alarm_page(
    points: PointSelection, spec: GridSpec, *, by: str, printed: Any = (), title: str
) -> TablePage:
    """Return a page with the false-alarm probabilities of a shot for each value of a coordinate.

    The page has the form of tables 4.3 to 4.5 of the thesis [T]. ``by`` is the name of the
    coordinate. ``printed`` are published values for comparison.
    """
    records = false_alarm_records(points, spec, by=by, printed=printed)
    has_printed = any(record["printed"] == record["printed"] for record in records)
    page_tables = [
        _record_table(
            "Probability of a false alarm in both chirp segments, from noise",
            _FALSE_ALARM_COLUMNS | (_PUBLISHED_VALUE_COLUMNS if has_printed else {}), records,
        ),
        _record_table(
            "Leakage: extra groups raised by the signal's own sidelobes", _LEAKAGE_COLUMNS, records
        ),
    ]  # fmt: skip
    bins_text = ", ".join(
        labels.format_number(n) for n in sorted({float(r["bins"]) for r in records})
    )
    notes = [
        f"closed form: (1 - (1 - p)^N)^2, p = exp(-(4 - pi)/4 TNR^2), N = {bins_text}.",
        *_FALSE_ALARM_NOTES,
        "With bins_counted 'half' the model leaves out the bins of the detection, the closed form",
        "  none. Shot (leakage): noise or leakage raises an extra group in both chirp segments.",
    ]
    return TablePage(title, page_tables, notes, records)


def threshold_page(
    points: PointSelection, spec: GridSpec, *, by: str, printed: Any = (), title: str
) -> TablePage:
    """Return a page with the probability of a false alarm in a bin, for each threshold.

    The page has the form of table 4.2 of the thesis [T]. ``by`` is the name of the threshold's
    coordinate. ``printed`` are published values for comparison.
    """
    records: list[dict[str, TableCell]] = []
    setting_parts = split_by_setting(points, spec, by)
    pfa_statistics = compute_statistics(
        [
            select_beyond_range(part.points, spec, FALSE_ALARM_AVERAGING_RANGE_MIN)
            for part in setting_parts
        ],
        "pfa_bin",
    )
    for i, (name, setting, _) in enumerate(setting_parts):
        noise_reference, pfa_bin = noise_false_alarm_reference(spec, setting)
        tnr = float(noise_reference["tnr"])
        closed_form = noise_false_alarms.bin_pfa(tnr)
        printed_value = _published_value(printed, i, 0)
        records.append(
            {
                "setting": name,
                "tnr": tnr,
                "closed_form": closed_form,
                "noise_only": pfa_bin,
                "study_mean": pfa_statistics[i].mean,
                "printed": printed_value,
                "printed_over_closed_form": printed_value / closed_form,
                "printed_variance_excess": noise_false_alarms.variance_excess_from_bin_pfa(
                    printed_value, tnr
                ),
            }
        )
    heading = "Probability that a bin of noise crosses the threshold"
    notes = ["closed form: exp(-(4 - pi)/4 TNR^2)", *_FALSE_ALARM_NOTES]
    return TablePage(title, [_record_table(heading, _THRESHOLD_COLUMNS, records)], notes, records)


_FALSE_ALARM_NOTES = (
    "noise only: the model with a reflectance of 0.",
    f"study's mean: over points beyond {FALSE_ALARM_AVERAGING_RANGE_MIN} of range, the echo's own "
    "shot noise included.",
    "excess: noise variance above the one that sets the threshold, as a figure implies.",
    "  Nothing is tuned to the printed figures.",
)
"""Notes below the tables of false alarms and of thresholds."""


def _record_table(
    heading: str, columns: Mapping[str, tuple[str, str]], records: Sequence[dict[str, TableCell]]
) -> TextTable:
    """Return a text table with a row for each record.

    `columns` are the record key and the number format of each column, by column name.
    """
    rows = [
        [
            _format_record_value(record[key], number_format)
            for key, number_format in columns.values()
        ]
        for record in records
    ]
    return TextTable(heading, tuple(columns), rows)


def _format_record_value(value: TableCell, number_format: str) -> TableCell:
    """Return a record's value in a number format; '-' for nan. An empty format changes nothing."""
    if not number_format:
        return value
    if number_format.endswith("%"):
        return percent_text(float(value), number_format[:-1]) if value == value else "-"
    return format(value, number_format) if value == value else "-"
