"""Results of `sweep accuracy`: time and error of accuracy settings, in tables and a figure.

A setting is a choice of tolerance, effects, beamlets or draws. The thesis's way is the method of
[T], the thesis that :mod:`sweep.model` names; docs/accuracy.md describes it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Sheet
from matplotlib.ticker import FuncFormatter, LogLocator

from sweep.analysis import canvas, labels
from sweep.analysis.datasets import read_attributes_of_kind
from sweep.analysis.tables import TablePage, TextTable
from sweep.model.error_budget import THESIS_BEAMLET_COUNT
from sweep.storage.accuracy_setting_kinds import (
    ADAPTIVE_KIND,
    ALL_EFFECTS_KIND,
    AS_WRITTEN_KIND,
    BEAMLET_LATTICE_KIND,
    BEAMLET_ROW_KIND,
    CLOSED_FORM_KIND,
    COUNTED_DETECTIONS_IN_NOISE_KIND,
    COUNTED_DETECTIONS_KIND,
    FIXED_EFFECTS_KIND,
    IMPROVED_THESIS_METHOD_KIND,
    MEAN_PD_OF_DRAWS_KIND,
    REFERENCE_KIND,
    THESIS_METHOD_KIND,
)
from sweep.storage.locations import Location, derived_files_dir
from sweep.storage.store_format import ACCURACY_STORE_KIND, OPEN_ZARR_KWARGS
from sweep.storage.verified_store import open_verified_store

TABULATED_TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
"""Limits of the error for which a table names the fastest accuracy setting within the limit."""

NEGLIGIBLE_ERROR = 1e-9
"""Error of pd, log10 pfa or |X| up to which accuracy settings count as equally accurate.

The reference setting, from whose results errors are measured, has errors of this size itself.
"""

FIXED_SETTING_KINDS = (
    FIXED_EFFECTS_KIND,
    BEAMLET_LATTICE_KIND,
    BEAMLET_ROW_KIND,
    CLOSED_FORM_KIND,
    ALL_EFFECTS_KIND,
    MEAN_PD_OF_DRAWS_KIND,
    COUNTED_DETECTIONS_KIND,
    COUNTED_DETECTIONS_IN_NOISE_KIND,
)
"""Kinds of accuracy settings with the same effects, beamlets and draws at all points of a study."""

REQUIRED_SPEEDUP_OVER_FIXED, REQUIRED_SPEEDUP_OVER_THESIS = 1 / 1.1, 5.0
"""Least speed-ups of adaptive settings that are required at equal accuracy.

The first is over the best fixed setting, the second over the thesis's method. A speed-up is the
time of the other setting over the time of the adaptive one.
"""

ROUNDS_FOR_MEDIAN_MIN = 3
"""Least number of measurement rounds for which a speed-up is the median over the rounds.

With fewer rounds it is the ratio of the times of the fastest rounds.
"""

RANDOM_ERROR_QUANTILE_LEVEL = 0.95
"""Level, 0..1, of the quantile of pd errors over points that is the error of an accuracy setting.

The quantile is used if any setting of the store uses random draws. Otherwise the error of a setting
is the maximum of its pd errors over points.
"""


@dataclass(frozen=True)
class MeasuredSetting:
    """Measured computing times and errors of one accuracy setting.

    Errors are differences from the results of the reference, the most accurate setting.
    """

    name: str
    """Name of the setting."""
    kind: str
    """Kind of the setting: a constant of :mod:`sweep.storage.accuracy_setting_kinds`."""
    tolerance: float
    """Tolerance for which an adaptive setting chooses effects; meaningless for other settings."""
    seconds_per_point_by_round: np.ndarray
    """Computing time per point of the study in each round of measurement (rounds,) [s]."""
    planning_seconds_per_point: float
    """Time per point that the choice of effects takes, in the fastest round of measurement [s]."""
    pd_error_by_point: np.ndarray
    """Largest error among the probabilities of detection of each point (points,)."""
    log10_pfa_error: float
    """Largest error of log10 of a false-alarm probability at any point; nan if not measured."""
    magnitude_error: float
    """Largest relative error of the magnitude |X| of a bin at any point; nan if not measured."""
    leakage_error: float
    """Largest error, over all points, of the probability of a false peak due to window sidelobes.

    The error is nan if not measured. The tolerance does not limit the error, because the
    probability jumps where a bin reaches the threshold.
    """
    error_quantile_level: float
    """Level, 0..1, of the quantile of pd's errors over the points that `largest_error` returns.

    Level 1 is the largest error. It applies where no setting has random draws.
    """

    @property
    def fastest_seconds_per_point(self) -> float:
        """Computing time per point in the fastest round of measurement [s]."""
        return float(np.min(self.seconds_per_point_by_round))

    @property
    def largest_error(self) -> float:
        """Largest error that the tolerance limits: of pd, log10 pfa or magnitude |X|, at any point.

        If settings have random draws, it is the quantile of pd's errors at `error_quantile_level`.
        """
        if self.error_quantile_level < 1.0:
            return self.pd_error_quantile(self.error_quantile_level)
        promised_errors = self.pd_error_quantile(1.0), self.log10_pfa_error, self.magnitude_error
        return float(np.fmax.reduce(promised_errors))

    @property
    def is_leakage_error_acceptable(self) -> bool:
        """False if the setting is a closed form whose leakage error exceeds its other errors.

        Closed forms of pd omit leakage, the probability of false peaks due to window sidelobes. For
        settings of any other kind, which include leakage, the result is True.
        """
        return self.kind != CLOSED_FORM_KIND or self.leakage_error <= max(
            self.largest_error, NEGLIGIBLE_ERROR
        )

    def pd_error_quantile(self, fraction: float) -> float:
        """Return the quantile of the points' errors of pd at the level `fraction`, 0..1."""
        return float(np.nanquantile(self.pd_error_by_point, fraction))

    def speedup_over(self, other: MeasuredSetting, extra_seconds: float = 0.0) -> float:
        """Return the computing time of another setting divided by the time of this one.

        The ratio is the median over the rounds of measurement. With fewer than
        `ROUNDS_FOR_MEDIAN_MIN` rounds it is the ratio of the times of the fastest rounds.
        ``extra_seconds`` [s] is added to the time per point of both settings.
        """
        if self.seconds_per_point_by_round.size < ROUNDS_FOR_MEDIAN_MIN:
            return (other.fastest_seconds_per_point + extra_seconds) / (
                self.fastest_seconds_per_point + extra_seconds
            )
        return float(
            np.median(
                (other.seconds_per_point_by_round + extra_seconds)
                / (self.seconds_per_point_by_round + extra_seconds)
            )
        )


def read_measured_settings(dataset: xr.Dataset) -> list[MeasuredSetting]:
    """Return the settings in the dataset of a store of `sweep accuracy`, in the order of the store.

    Stores of earlier versions call the dimension of settings `rung`.
    """
    if "rung" in dataset.dims:
        dataset = dataset.rename(rung="setting")
    array_by_name = {name: array.values for name, array in dataset.variables.items()}
    error_quantile_level = (
        RANDOM_ERROR_QUANTILE_LEVEL if np.isfinite(array_by_name["standard_error"]).any() else 1.0
    )
    return [
        MeasuredSetting(
            name=str(name),
            kind=str(array_by_name["kind"][i]),
            tolerance=float(array_by_name["tolerance"][i]),
            seconds_per_point_by_round=array_by_name["seconds"][i],
            planning_seconds_per_point=float(
                array_by_name["planning"][i, np.argmin(array_by_name["seconds"][i])]
            ),
            pd_error_by_point=array_by_name["pd_error"][i],
            log10_pfa_error=float(np.fmax.reduce(array_by_name["log10_pfa_error"][i])),
            magnitude_error=float(np.fmax.reduce(array_by_name["magnitude_error"][i])),
            leakage_error=float(np.fmax.reduce(array_by_name["leakage_error"][i])),
            error_quantile_level=error_quantile_level,
        )
        for i, name in enumerate(array_by_name["setting"])
    ]


def select_settings_of_kinds(
    settings: Iterable[MeasuredSetting], *kinds: str
) -> list[MeasuredSetting]:
    """Return a list of the settings whose kind is one of the given ones."""
    return [setting for setting in settings if setting.kind in kinds]


def drop_reference_setting(settings: Iterable[MeasuredSetting]) -> list[MeasuredSetting]:
    """Return a list of the settings without the reference, which has no error by definition."""
    return [setting for setting in settings if setting.kind != REFERENCE_KIND]


def pareto_front(settings: Sequence[MeasuredSetting]) -> list[MeasuredSetting]:
    """Return the settings that no other setting beats in both time and error, fastest first."""
    front_settings: list[MeasuredSetting] = []
    for setting in sorted(settings, key=lambda s: (s.fastest_seconds_per_point, s.largest_error)):
        if not front_settings or max(setting.largest_error, NEGLIGIBLE_ERROR) < max(
            front_settings[-1].largest_error, NEGLIGIBLE_ERROR
        ):
            front_settings.append(setting)
    return front_settings


def fastest_setting_within_error(
    settings: Sequence[MeasuredSetting], error_max: float
) -> MeasuredSetting | None:
    """Return the fastest setting whose error is at most ``error_max``; None if there is none."""
    error_limit = max(error_max, NEGLIGIBLE_ERROR)
    accurate_settings = [setting for setting in settings if setting.largest_error <= error_limit]
    return min(accurate_settings, key=lambda s: s.fastest_seconds_per_point, default=None)


class SettingComparison(NamedTuple):
    """Fastest adaptive setting, and another setting of comparable error.

    An adaptive setting chooses the effects point by point.
    """

    adaptive_setting: MeasuredSetting
    """Setting that chooses the effects point by point."""
    other_setting: MeasuredSetting | None
    """Setting with which the adaptive one is compared; None if none is accurate enough."""

    def speedup(self, extra_seconds: float = 0.0) -> float:
        """Return the computing time of the other setting divided by the time of the adaptive one.

        Without another setting the ratio is infinite. ``extra_seconds`` [s] is added to the time
        per point of both settings.
        """
        return (
            self.adaptive_setting.speedup_over(self.other_setting, extra_seconds)
            if self.other_setting
            else math.inf
        )


def compare_adaptive_with_fixed(settings: Sequence[MeasuredSetting]) -> list[SettingComparison]:
    """Compare the fastest adaptive with the fastest fixed setting, at several limits of the error.

    The limits are the errors of the adaptive settings, from the largest to the smallest. Each limit
    gives one comparison, in which neither setting exceeds the limit.
    """
    adaptive_settings = select_settings_of_kinds(settings, ADAPTIVE_KIND)
    fixed_settings = [
        setting
        for setting in select_settings_of_kinds(settings, *FIXED_SETTING_KINDS)
        if setting.is_leakage_error_acceptable
    ]
    errors = sorted(
        {max(setting.largest_error, NEGLIGIBLE_ERROR) for setting in adaptive_settings},
        reverse=True,
    )
    cheapest_by_error = (
        (fastest_setting_within_error(adaptive_settings, error), error) for error in errors
    )
    return [
        SettingComparison(cheapest_adaptive, fastest_setting_within_error(fixed_settings, error))
        for cheapest_adaptive, error in cheapest_by_error
        if cheapest_adaptive is not None
    ]


def compare_adaptive_with_thesis(
    settings: Sequence[MeasuredSetting], kind: str = THESIS_METHOD_KIND
) -> list[SettingComparison]:
    """Compare each setting by the thesis's method with an equally accurate adaptive setting.

    The method is that of the thesis [T] (:mod:`sweep.model`). The adaptive setting is the fastest
    one whose error is at most that of the thesis's setting. `kind` is the kind of the thesis's
    settings.
    """
    adaptive_settings = select_settings_of_kinds(settings, ADAPTIVE_KIND)
    cheapest_by_thesis = (
        (fastest_setting_within_error(adaptive_settings, thesis_form.largest_error), thesis_form)
        for thesis_form in select_settings_of_kinds(settings, kind)
    )
    return [
        SettingComparison(cheapest_adaptive, thesis)
        for cheapest_adaptive, thesis in cheapest_by_thesis
        if cheapest_adaptive is not None
    ]


SETTING_TABLE_COLUMNS = (
    "setting", "us a point", "planning", "median", "90 %", "largest", "log10 pfa",
    "magnitude", "leakage", "front",
)  # fmt: skip
"""Column names of the table of accuracy settings: times, quantiles of pd's error, other errors.

The last column, `front`, marks settings that no other setting beats in both time and error.
"""


SHORT_SETTING_TABLE_COLUMNS = ("setting", "time", "90 %", "largest", "log pfa", "peak", "leakage")
"""Column names of the shorter table of accuracy settings that is printed in the terminal."""

FASTEST_SETTING_COLUMNS = ("error allowed", "cheapest setting", "us a point", "its error")
"""Column names of the table that lists the fastest setting for each tolerance."""

STORING_SECONDS_ATTRIBUTE = "storing_seconds"
"""Name of the attribute of an accuracy store with the time that storing the study takes [s].

Stores of earlier versions lack the attribute.
"""


def setting_table_rows(settings: Sequence[MeasuredSetting]) -> list[list[str]]:
    """Return a table row of texts for each setting, in the columns of `SETTING_TABLE_COLUMNS`."""
    front_settings = pareto_front(drop_reference_setting(settings))
    return [
        [
            s.name,
            format_microseconds(s.fastest_seconds_per_point),
            format_microseconds(s.planning_seconds_per_point)
            if s.planning_seconds_per_point
            else "-",
            *(format_error(s.pd_error_quantile(fraction)) for fraction in (0.5, 0.9, 1.0)),
            *map(format_error, (s.log10_pfa_error, s.magnitude_error, s.leakage_error)),
            "*" if s in front_settings else "",
        ]
        for s in settings
    ]


def short_setting_table_rows(settings: Sequence[MeasuredSetting]) -> list[list[str]]:
    """Return a row of texts for each setting, in the columns of `SHORT_SETTING_TABLE_COLUMNS`.

    A star marks the settings of the Pareto front.
    """
    return [
        [f"{front_mark or ' '} {name}", f"{time} us", *errors]
        for name, time, _, _, *errors, front_mark in setting_table_rows(settings)
    ]


def fastest_setting_rows(settings: Sequence[MeasuredSetting]) -> list[list[str]]:
    """Return a row for each of the `TABULATED_TOLERANCES`, in `FASTEST_SETTING_COLUMNS`.

    A row names the fastest setting whose error does not exceed the tolerance.
    """
    table_rows = []
    for tolerance in TABULATED_TOLERANCES:
        cheapest_setting = fastest_setting_within_error(drop_reference_setting(settings), tolerance)
        cells = cheapest_setting and [
            cheapest_setting.name,
            format_microseconds(cheapest_setting.fastest_seconds_per_point),
            format_error(cheapest_setting.largest_error),
        ]
        table_rows.append([f"{tolerance:g}", *(cells or ["none", "", ""])])
    return table_rows


def conclusion_sentences(dataset: xr.Dataset, settings: Sequence[MeasuredSetting]) -> list[str]:
    """Return the conclusions from an accuracy measurement, as sentences for its page."""
    attributes = dataset.attrs
    conclusions = [_spec_as_written_sentences(dataset, settings)]
    conclusions += _fixed_setting_sentences(compare_adaptive_with_fixed(settings), attributes)
    conclusions += _thesis_sentences(
        settings, attributes["thesis_beamlets"]
    ) + _closed_form_sentences(settings)
    conclusions.append(_reference_setting_sentences(attributes))
    notes = attributes["notes"]  # a list in stores of earlier versions
    notes = notes.splitlines() if isinstance(notes, str) else notes
    conclusions += [note[0].upper() + note[1:] + "." for note in notes]
    if stop_reason := attributes["stopped"]:
        points_text = f"{attributes['points']} {attributes['unit']}"
        conclusions.append(f"Not the whole sample ({stop_reason}): {points_text} of it.")
    return conclusions


def accuracy_page(dataset: xr.Dataset, settings: Sequence[MeasuredSetting]) -> TablePage:
    """Return a page with the tables and the conclusions of an accuracy measurement."""
    page_tables = [
        TextTable("Settings", SETTING_TABLE_COLUMNS, setting_table_rows(settings)),
        TextTable(
            "Cheapest setting for each error",
            FASTEST_SETTING_COLUMNS,
            fastest_setting_rows(settings),
        ),
    ]
    return TablePage(
        f"{dataset.attrs['title']}: accuracy",
        page_tables,
        conclusion_sentences(dataset, settings),
        [],
    )


def _spec_as_written_sentences(dataset: xr.Dataset, settings: Sequence[MeasuredSetting]) -> str:
    """Return sentences on the setting that the spec states: time, error, and a faster setting."""
    (as_written,) = select_settings_of_kinds(settings, AS_WRITTEN_KIND)
    n_points, unit = dataset.attrs["study_points"], dataset.attrs["unit"]
    cheapest_setting = fastest_setting_within_error(
        drop_reference_setting(settings), as_written.largest_error
    )
    subject = f"All {n_points:,} {unit} take" if n_points > 1 else "The study takes"
    text = (
        f"As written: {format_microseconds(as_written.fastest_seconds_per_point)} us a point, "
        f"error {format_error(as_written.largest_error)}. "
        f"{subject} {_format_duration(n_points * as_written.fastest_seconds_per_point)} on one core"
    )
    if (storing_seconds := dataset.attrs.get(STORING_SECONDS_ATTRIBUTE)) is not None:
        text += (
            f"; storing them takes at least {_format_duration(storing_seconds)} more with any "
            "setting"
        )
    if (
        cheapest_setting is None
        or cheapest_setting is as_written
        or cheapest_setting.speedup_over(as_written) < 1.05
    ):
        return text + ". No other setting is both faster and as accurate."
    speedup_text = f"{cheapest_setting.speedup_over(as_written):.2g}"
    return (
        text
        + f". The setting {cheapest_setting.name} is {speedup_text} times as fast and as accurate."
    )


def _fixed_setting_sentences(
    comparisons: Sequence[SettingComparison], attributes: dict
) -> list[str]:
    """Return a list of sentences that compare adaptive settings with fixed settings."""
    if not comparisons:
        return []
    worst_comparison = min(comparisons, key=SettingComparison.speedup)
    if worst_comparison.other_setting is None:
        return ["No fixed setting is as accurate as any adaptive one."]
    verdict_text = (
        "met"
        if worst_comparison.speedup() >= REQUIRED_SPEEDUP_OVER_FIXED
        else _slowdown_text(worst_comparison, comparisons, attributes)
    )
    speedups = [
        f"{comparison.speedup():.2g}" for comparison in comparisons if comparison.other_setting
    ]
    low, high = min(speedups, key=float), max(speedups, key=float)
    span_text = low if low == high else f"{low} to {high}"
    return [
        f"At equal error, adaptive settings are {span_text} times as fast as the best single "
        f"fixed setting. Least speed-up: {worst_comparison.adaptive_setting.name} over "
        f"{worst_comparison.other_setting.name}. "
        f"Requirement, never slower by more than 10 %: {verdict_text}."
    ]


def _slowdown_text(
    worst_comparison: SettingComparison, comparisons: Sequence[SettingComparison], attributes: dict
) -> str:
    """Return a text on how much slower adaptive settings are than fixed settings.

    The text gives the extra time for the complete study, the time of planning, and the smallest
    speed-up with the time to store results included. `worst_comparison` is the comparison with the
    smallest speed-up among `comparisons`.
    """
    n_points = attributes["study_points"]
    extra_seconds = worst_comparison.adaptive_setting.fastest_seconds_per_point * (
        1 - worst_comparison.speedup()
    )
    lost_text, planning_text = (
        _format_duration(n_points * point_seconds)
        for point_seconds in (
            extra_seconds,
            worst_comparison.adaptive_setting.planning_seconds_per_point,
        )
    )
    shortfall_text = f"NOT met, by {lost_text} in all; planning takes {planning_text}"
    if (storing_seconds := attributes.get(STORING_SECONDS_ATTRIBUTE)) is None:
        return shortfall_text
    speedup_with_store = min(
        comparison.speedup(storing_seconds / n_points) for comparison in comparisons
    )
    return f"{shortfall_text}; with the study's store it is {speedup_with_store:.2g} times as fast"


def _thesis_sentences(settings: Sequence[MeasuredSetting], beamlets: int) -> list[str]:
    """Return the sentences that compare adaptive settings with the thesis's method.

    Improved versions of the thesis's method are compared too. `beamlets` is the study's number of
    beamlets.
    """
    comparisons = compare_adaptive_with_thesis(settings)
    if not comparisons:
        return []
    verdict_text = " and ".join(
        f"{'met' if comparison.speedup() >= REQUIRED_SPEEDUP_OVER_THESIS else 'NOT met'} over "
        f"{comparison.other_setting.name}"
        for comparison in comparisons
        if comparison.other_setting
    )
    requirement_note = f"Requirement, at least {REQUIRED_SPEEDUP_OVER_THESIS:g}: {verdict_text}."
    if beamlets != THESIS_BEAMLET_COUNT:
        requirement_note = f"This scene has {beamlets} beamlets, the thesis {THESIS_BEAMLET_COUNT}."
    statements = [
        f"The thesis's way is compared at its own error. {_speedup_sentences(comparisons)} "
        f"{requirement_note}"
    ]
    if improved_comparisons := compare_adaptive_with_thesis(settings, IMPROVED_THESIS_METHOD_KIND):
        statements.append(
            "Improved versions of it are compared likewise. "
            f"{_speedup_sentences(improved_comparisons)}"
        )
    return statements


def _speedup_sentences(comparisons: Sequence[SettingComparison]) -> str:
    """Return a text with a sentence on the speed-ups for each adaptive setting and error."""
    speedups_by_case: dict[str, list[str]] = {}
    for comparison in comparisons:
        if comparison.other_setting:
            case = (
                f"{comparison.adaptive_setting.name}, "
                f"error {format_error(comparison.other_setting.largest_error)}"
            )
            speedups_by_case.setdefault(case, []).append(
                f"{comparison.speedup():.2g} over {comparison.other_setting.name}"
            )
    return " ".join(
        f"Speed-up of {case}: {'; '.join(speedups)}." for case, speedups in speedups_by_case.items()
    )


def _closed_form_sentences(settings: Sequence[MeasuredSetting]) -> list[str]:
    """Return the sentences that compare the closed form of pd with the thesis's method.

    Both have the same beamlets and effects. The list is empty without a setting of each kind.
    """
    described_text, improved_text = (
        "; ".join(
            f"{closed_form_setting.speedup_over(thesis_setting):.2g} over {thesis_setting.name}"
            for closed_form_setting in select_settings_of_kinds(settings, CLOSED_FORM_KIND)
            for thesis_setting in select_settings_of_kinds(settings, kind)
        )
        for kind in (THESIS_METHOD_KIND, IMPROVED_THESIS_METHOD_KIND)
    )
    if not described_text:
        return []
    text = (
        "The closed form is compared with the thesis's way for the same beamlets and effects, "
        f"without leakage and changes within a record (range walk). Speed-up: {described_text}."
    )
    return [text + (f" Speed-up over improved versions: {improved_text}." if improved_text else "")]


def _reference_setting_sentences(attributes: dict) -> str:
    """Return a text that names the reference setting and its error against the time domain."""
    text = f"Reference: {attributes['reference']}"
    if not attributes["truth_points"]:
        return text + ". It is not compared with the time domain."
    beamlets_note = (
        f", with {n_beamlets} beamlets in both,"
        if (n_beamlets := attributes["truth_beamlets"])
        else ""
    )
    return text + (
        f". At {attributes['truth_points']} {attributes['unit']}{beamlets_note} it differs from "
        "the time "
        f"domain by {format_error(attributes['truth_pd_difference'])} in pd and by "
        f"{format_error(attributes['truth_magnitude_difference'])} in magnitude."
    )


def _format_duration(seconds: float) -> str:
    """Return a duration, given in seconds, as text in seconds, minutes or hours."""
    if seconds < 100:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:,.0f} min" if seconds < 6000 else f"{seconds / 3600:,.0f} h"


def format_microseconds(seconds: float) -> str:
    """Return a time [s] as text in microseconds with at least three digits."""
    value = 1e6 * seconds
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def format_error(value: float) -> str:
    """Return an error as text with two digits; '<1e-9' if negligible, '-' for nan."""
    if math.isnan(value):
        return "-"
    return (
        f"{value:.1e}"
        if value >= NEGLIGIBLE_ERROR
        else f"<{NEGLIGIBLE_ERROR:.0e}".replace("e-0", "e-")
    )


SETTING_KINDS_NAMED_BY_NUMBER = (
    BEAMLET_LATTICE_KIND,
    BEAMLET_ROW_KIND,
    MEAN_PD_OF_DRAWS_KIND,
    COUNTED_DETECTIONS_KIND,
    COUNTED_DETECTIONS_IN_NOISE_KIND,
)
"""Kinds of accuracy settings whose names begin with a number of beamlets or draws."""

SETTING_KINDS_JOINED_BY_LINE = (ADAPTIVE_KIND, *SETTING_KINDS_NAMED_BY_NUMBER)
"""Kinds of accuracy settings that differ only in tolerance, or in a number of beamlets or draws.

In the figure a line connects the marks of all settings of such a kind.
"""

PLOT_STYLE_BY_SETTING_KIND = {
    ADAPTIVE_KIND: ("o", canvas.LINE_COLOURS[0], "adaptive, by tolerance"),
    FIXED_EFFECTS_KIND: ("s", canvas.LINE_COLOURS[2], "the same effects everywhere"),
    BEAMLET_LATTICE_KIND: ("^", canvas.LINE_COLOURS[1], "number of beamlets in a lattice"),
    BEAMLET_ROW_KIND: ("<", canvas.LINE_COLOURS[7], "number of beamlets in a line"),
    ALL_EFFECTS_KIND: ("D", canvas.LINE_COLOURS[3], "all effects on"),
    MEAN_PD_OF_DRAWS_KIND: ("P", canvas.LINE_COLOURS[5], "mean over so many draws"),
    COUNTED_DETECTIONS_KIND: ("^", canvas.LINE_COLOURS[1], "detections in so many draws"),
    COUNTED_DETECTIONS_IN_NOISE_KIND: ("<", canvas.LINE_COLOURS[7], "the same, noise in every bin"),
    CLOSED_FORM_KIND: ("X", canvas.LINE_COLOURS[5], "in closed form what the thesis's way has"),
    THESIS_METHOD_KIND: ("v", canvas.LINE_COLOURS[4], "the thesis's way"),
    IMPROVED_THESIS_METHOD_KIND: ("p", canvas.LINE_COLOURS[4], "the thesis's way, improved"),
    AS_WRITTEN_KIND: ("*", canvas.LINE_COLOURS[6], "as written"),
}
"""Plot marker, colour and legend text of each kind of accuracy setting."""


def draw_accuracy_sheet(dataset: xr.Dataset, settings: Sequence[MeasuredSetting]) -> Sheet:
    """Return the sheet of an accuracy measurement: the error of every setting over its time."""
    plotted_settings = drop_reference_setting(settings)
    sheet, (axes,) = canvas.sheet_with_axes(10.0, 6.2, 1, 1)
    axes.step(
        *zip(*map(_setting_plot_position, pareto_front(plotted_settings)), strict=True),
        where="post",
        color="0.35",
        linewidth=1.2,
        linestyle="--",
        zorder=1,
        label="Pareto front of time and error",
    )
    for kind, (marker, colour, label) in PLOT_STYLE_BY_SETTING_KIND.items():
        kind_settings = select_settings_of_kinds(plotted_settings, kind)
        for i, setting in enumerate(kind_settings):
            _draw_setting_mark(axes, setting, marker, colour, label if i == 0 else "")
        if kind in SETTING_KINDS_JOINED_BY_LINE and kind_settings:
            polyline = zip(*map(_setting_plot_position, kind_settings), strict=True)
            axes.plot(*polyline, color=colour, linewidth=0.8, alpha=0.5, zorder=1)
            kind_settings = kind_settings[:1] + kind_settings[1:][-1:]
        for setting in kind_settings:
            axes.annotate(
                _short_setting_name(setting),
                _setting_plot_position(setting),
                xytext=(6, 5),
                textcoords="offset points",
                fontsize=7.5,
                color=colour,
            )
    _set_time_and_error_axes(
        axes,
        min(setting.pd_error_quantile(0.5) for setting in plotted_settings),
        max(s.largest_error for s in plotted_settings),
    )
    canvas.set_title(sheet, f"{dataset.attrs['title']}: what accuracy costs")
    canvas.set_caption(sheet, _sheet_caption(dataset, plotted_settings))
    return sheet


def _draw_setting_mark(
    axes: Axes, setting: MeasuredSetting, marker: str, colour: str, label: str
) -> None:
    """Draw a setting as a mark at its largest error, and quantiles of pd's error below the mark.

    A bar reaches down to the 90 % quantile, and a dot marks the median.
    """
    time, largest_error = _setting_plot_position(setting)
    error_90, error_median = (
        max(setting.pd_error_quantile(fraction), NEGLIGIBLE_ERROR) for fraction in (0.9, 0.5)
    )
    if error_90 > NEGLIGIBLE_ERROR:
        axes.plot(
            [time, time],
            [error_90, largest_error],
            color=colour,
            linewidth=1.0,
            alpha=0.6,
            zorder=2,
        )
        axes.plot([time], [error_90], marker="_", color=colour, markersize=7, zorder=2)
    if error_median > NEGLIGIBLE_ERROR:
        axes.plot([time], [error_median], marker=".", color=colour, markersize=4, zorder=2)
    mark_size = 11 if marker == "*" else 7
    axes.plot(
        [time], [largest_error], marker=marker, color=colour, markersize=mark_size, linestyle="",
        markeredgecolor="white", markeredgewidth=0.7, label=label or None, zorder=4,
    )  # fmt: skip


def _setting_plot_position(setting: MeasuredSetting) -> tuple[float, float]:
    """Return the time [us] and the error at which the figure shows a setting."""
    return 1e6 * setting.fastest_seconds_per_point, max(setting.largest_error, NEGLIGIBLE_ERROR)


def _short_setting_name(setting: MeasuredSetting) -> str:
    """Return a short name that distinguishes a setting within its kind; '' if no name is needed."""
    if setting.kind == ADAPTIVE_KIND:
        return f"{setting.tolerance:.0e}".replace("e-0", "e-")
    if setting.kind == THESIS_METHOD_KIND:
        return setting.name.removeprefix("thesis ")
    if setting.kind in SETTING_KINDS_NAMED_BY_NUMBER:
        return setting.name.split()[0]
    return ""


def _set_time_and_error_axes(axes: Axes, error_min: float, error_max: float) -> None:
    """Set limits, labels and legend of logarithmic axes of time and error, in place."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(max(NEGLIGIBLE_ERROR, error_min) / 2, max(2.5, 2 * error_max))
    axes.margins(x=0.16)
    plain_formatter = FuncFormatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(plain_formatter)
    axes.xaxis.set_minor_formatter(FuncFormatter(lambda value, _: ""))
    axes.set_xlabel("time a point on one core (µs)")
    axes.set_ylabel("largest error of pd, log10 pfa and magnitudes")
    axes.grid(True, which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def _sheet_caption(dataset: xr.Dataset, settings: Sequence[MeasuredSetting]) -> str:
    """Return the caption of the figure, on the meaning of marks, the reference and the study."""
    attributes = dataset.attrs
    error_quantile_level = settings[0].error_quantile_level
    mark_meaning = (
        "the largest"
        if error_quantile_level == 1
        else f"that of {100 * error_quantile_level:.0f} %"
    )
    phrases = [
        f"mark: {mark_meaning} of "
        f"{labels.number_with_noun(attributes['points'], attributes['unit'][:-1])}; "
        f"bar and dot: 90 % and half of them, in pd alone; {NEGLIGIBLE_ERROR:g} and less at the "
        "foot",
        f"best of {labels.number_with_noun(dataset.sizes['round'], 'round')}; "
        f"reference: {attributes['reference']}",
    ]
    if attributes["truth_points"]:
        difference_text = format_error(attributes["truth_pd_difference"])
        phrases.append(
            f"time domain at {labels.number_with_noun(attributes['truth_points'], 'point')}: "
            f"within {difference_text} of it"
        )
    phrases.append(f"study {attributes['study_id'][:8]}, model {attributes['model_version']}")
    return labels.join_sentences(phrases)


class AccuracyResults(NamedTuple):
    """Measurement of accuracy, read from its store."""

    dataset: xr.Dataset
    """Dataset of the store, in memory."""
    settings: list[MeasuredSetting]
    """Measured errors and times of each accuracy setting."""


def open_accuracy_store(store: Location) -> AccuracyResults:
    """Load a store of `sweep accuracy`; return its dataset and its settings.

    Raise NotAStoreError if the store is of another kind.
    """
    study_id = read_attributes_of_kind(store, ACCURACY_STORE_KIND)["study_id"]
    with xr.open_zarr(open_verified_store(store, study_id), **OPEN_ZARR_KWARGS) as dataset:
        loaded = dataset.load()
    return AccuracyResults(loaded, read_measured_settings(loaded))


def write_figure_and_tables(
    store: Location, directory: Path | None = None, picture_format: str = "png"
) -> list[Path]:
    """Write the figure and the tables of a store of `sweep accuracy`; return the written files.

    For a store NAME.zarr the files are NAME.png (or pdf, svg) and NAME.txt in the directory.
    Without a directory they lie next to the store.
    """
    dataset, settings = open_accuracy_store(store)
    stem = store.name.removesuffix(".zarr")
    folder = derived_files_dir(store) if directory is None else directory
    table_path = folder / f"{stem}.txt"
    picture_path = canvas.save_sheet(
        draw_accuracy_sheet(dataset, settings), folder / f"{stem}.{picture_format}"
    )
    table_path.write_text(accuracy_page(dataset, settings).to_text(), encoding="utf-8")
    return [picture_path, table_path]
