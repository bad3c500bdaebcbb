"""Charts of a grid's detector: ROC curves, noise by source, false alarms, maximum range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import pandas
import xarray as xr

from sweep.analysis import charts, labels
from sweep.analysis.answers import probability
from sweep.analysis.charts import (
    LINEAR_SCALE,
    LOG_SCALE,
    PROBABILITY_AXIS_LIMITS,
    Chart,
    ChartAxis,
    ChartLine,
    CoordinateAxis,
    Panel,
)
from sweep.analysis.selection import (
    GRAZING_ANGLE_PATH,
    RANGE_PATH,
    NamedPart,
    PointSelection,
    SortedCoordinate,
    find_axis_parameter,
    parameters_at,
    split_by_coordinates,
    thin_parts_evenly,
)
from sweep.analysis.study_figures import GridResults
from sweep.model.detection import noise_false_alarms
from sweep.model.detection.looks import (
    LOOKS_COMBINE_PATH,
    LOOKS_NUMBER_PATH,
    LOOKS_VOTES_PATH,
    Looks,
)
from sweep.model.effects.catalogue import EFFECTS, effect_names_in_flags
from sweep.model.evaluation import prepare_shots
from sweep.model.threshold import THRESHOLD_PATHS, tnr_from_parameters
from sweep.report.html_page import HtmlTable
from sweep.units import percent_text

CHART_PARTS_MAX = 6
"""Largest number of parts of a study that the reader of a chart can choose from."""

NOISE_BUDGET_POINTS_MAX = 24
"""Largest number of points at which a chart of noise sources is computed.

The points lie along a coordinate of a grid, or are shots along a flight.
"""

ROC_POINT_SELECTION_PDS = (0.999, 0.9, 0.5, 0.1, 0.01)
"""Values of pd; for each value a ROC curve is drawn, that of the point with the closest pd."""

ROC_PFA_BIN_VALUES = np.logspace(-0.05, -16, 90)
"""Probabilities of a false alarm in one bin at which ROC curves are computed."""

N_ROC_DRAWS = 400
"""Number of draws with which the ROC curve of a point with random effects is simulated."""

PFA_WITH_LEAKAGE_VARIABLE = "pfa_both_chirps_with_leakage"
"""Name of the variable with the probability of false alarms in both chirps, by noise or leakage.

Leakage is signal in the window's sidelobes.
"""

_LABEL_BY_ALARM_VARIABLE = {
    "pfa_bin": "noise, one bin",
    "pfa_segment": "noise, a segment",
    "pfa_both_chirps": "noise, both",
    "pfa_shot": "noise, any",
    "p_leakage_up": "leakage, up",
    "p_leakage_down": "leakage, down",
    PFA_WITH_LEAKAGE_VARIABLE: "either, both",
}
"""Short legend label of each false-alarm variable."""

_RANDOM_EFFECT_NAMES = {effect.name for effect in EFFECTS if effect.is_random}
"""Names of the effects that are simulated by random draws."""


@dataclass(frozen=True)
class GridProfile:
    """Points of one part of a study along the coordinate that charts show, or the only point."""

    label: str
    """Name of the part of the study; '' for the complete study."""
    points: PointSelection
    """Points of the part."""
    coordinate_name: str
    """Name of the coordinate along the profile; empty for a single point."""
    coordinate: SortedCoordinate | None
    """Coordinate along the profile; None for a single point."""

    @property
    def coordinate_axis(self) -> CoordinateAxis:
        """Axis along which a chart shows the profile's coordinate."""
        return CoordinateAxis.from_points(self.points, self.coordinate_name)

    def evenly_spread_indices(self, n_max: int) -> np.ndarray:
        """Return at most ``n_max`` evenly spread indices of points along the profile, rising."""
        if self.coordinate is None:
            return np.zeros(1, int)
        size = self.coordinate.values.size
        return np.unique(np.linspace(0, size - 1, min(n_max, size)).round().astype(int))

    def axis_indices(self, index: Any) -> dict[str, Any]:
        """Return the index along each axis of the study, by the axis's name.

        `index` is the index along the profile, or an array of such indices. Along all other axes
        the index is that of the profile.
        """
        if self.coordinate is None:
            return self.points.first_indices()
        return self.points.first_indices(self.coordinate) | {
            self.coordinate.dim: self.coordinate.indices[index]
        }

    def variable_values(self, variable: str, indices: np.ndarray) -> np.ndarray:
        """Return the values (n,) of a variable at n indices along the profile."""
        return np.ravel(self.points.dataset[variable].isel(self.axis_indices(indices)).values)


class GridProfiles(NamedTuple):
    """Profiles of a grid that charts have room for."""

    profiles: list[GridProfile]
    """Shown profiles, evenly spread over all profiles."""
    n_omitted: int
    """Number of omitted profiles."""


def grid_profiles(results: GridResults) -> GridProfiles:
    """Return the profiles of a grid along its main coordinate, and the number of omitted profiles.

    The main coordinate is range if it varies, otherwise the numeric coordinate with the most
    values.
    """
    axis_parameters = [
        axis_parameter for axis in results.spec.axes for axis_parameter in axis.parameters
    ]
    numeric_parameters = [
        axis_parameter
        for axis_parameter in axis_parameters
        if not isinstance(axis_parameter.values, tuple)
    ]
    longest_parameter = max(
        numeric_parameters, key=lambda m: np.unique(m.display_values).size, default=None
    )
    main_parameter = find_axis_parameter(results.spec, RANGE_PATH) or longest_parameter
    name = main_parameter.coordinate_name if main_parameter else ""
    parts, n_omitted = charts.split_into_parts(
        results.points, [name] if name else [], CHART_PARTS_MAX
    )
    profiles = [
        GridProfile(words, p, name, p.sorted_coordinate(name) if name else None)
        for words, p in parts
    ]
    return GridProfiles(profiles, n_omitted)


def roc_chart(results: GridResults, profiles: Sequence[GridProfile], n_omitted: int) -> Chart:
    """Return the chart of ROC curves: pd over the probability of a false alarm.

    The curves are those of a few points of each profile. `n_omitted` is the number of omitted
    profiles.
    """
    panels = [panel for profile in profiles for panel in _roc_panels(results, profile)]
    line_names = [line.name for line in panels[0].lines if line.name]
    return Chart(
        heading="Receiver operating characteristic",
        alt=(
            "Lines of the probability of detection of a shot over the probability of a false "
            f"alarm, as the threshold moves, {'; '.join(line_names) or 'at the point'}."
        ),
        caption=[
            "From the stored signal-to-noise ratio; where that alone does not give the stored "
            "probability of detection, simulated for this page with the effects that the study "
            "simulates at the point"
            + (f", in {N_ROC_DRAWS} draws" if results.spec.draws.has_draws else ""),
            "False alarms of noise alone, in all bins that are counted",
            "Dots: the study's own threshold",
            "Points: those whose probability of detection comes nearest to "
            + ", ".join(f"{pd_value:g}" for pd_value in ROC_POINT_SELECTION_PDS),
            charts.omission_remark(n_omitted),
        ],
        panels=panels,
        facet_labels={"part": "Shown for", "alarm": "False alarm"},
    )


_PFA_FUNCTION_BY_ALARM_KIND = {
    "in a segment": noise_false_alarms.segment_pfa,
    "in a bin": lambda bin_probability, bins: bin_probability,
    "in both chirps": lambda p, bins: noise_false_alarms.segment_pfa(p, bins) ** 2,
}
"""Function that returns the probability of each kind of false alarm, by the kind's name.

The arguments are the false-alarm probability of one bin, and the number of independent bins.
"""


def _roc_panels(results: GridResults, profile: GridProfile) -> list[Panel]:
    """Return a panel for each kind of false alarm, with the ROC curves of a profile's points.

    Dots mark the threshold of the study.
    """
    lines_by_alarm: dict[str, list[ChartLine]] = {
        alarm: [] for alarm in _PFA_FUNCTION_BY_ALARM_KIND
    }
    for style_index, index in enumerate(_roc_point_indices(profile)):
        point = results.dataset.isel(profile.axis_indices(index)).compute()
        curve = point.sweep.roc(ROC_PFA_BIN_VALUES, draws=N_ROC_DRAWS)
        parameters = parameters_at(results.spec, profile.axis_indices(index))
        study_pfa, study_pd = 10.0 ** point["log10_pfa_bin"].values, point["pd_shot"].values
        n_bins, study_n_bins = (
            noise_false_alarms.n_alarm_equivalent_bins(parameters, p)
            for p in (ROC_PFA_BIN_VALUES, study_pfa)
        )
        tnr_texts = [f"TNR {t:.3g}" for t in curve["curve_tnr"].values]
        for alarm, pfa_from_bin in _PFA_FUNCTION_BY_ALARM_KIND.items():
            x = np.asarray(pfa_from_bin(ROC_PFA_BIN_VALUES, n_bins))
            line = ChartLine(
                x,
                curve["pd"].values,
                _point_label(profile, index),
                style_index,
                hover_texts=tnr_texts,
            )
            study_point = ChartLine(
                np.atleast_1d(pfa_from_bin(study_pfa, study_n_bins)),
                np.atleast_1d(study_pd),
                style_index=style_index,
                style="dots",
            )
            lines_by_alarm[alarm] += [line, study_point]
    x_axis = ChartAxis("probability of a false alarm", LOG_SCALE)
    y_axis = ChartAxis("probability of detection, shot", limits=PROBABILITY_AXIS_LIMITS)
    return [Panel({"part": profile.label, "alarm": alarm}, x_axis, y_axis, lines)
            for alarm, lines in lines_by_alarm.items()]  # fmt: skip


def _point_label(profile: GridProfile, index: int) -> str:
    """Return a text with the main coordinate of the point at an index along a profile."""
    if profile.coordinate is None:
        return ""
    value = profile.coordinate_axis.to_axis_units(profile.coordinate.values[index : index + 1])[0]
    return labels.format_coordinate_value(
        profile.coordinate_name, value, profile.coordinate_axis.units
    )


def _roc_point_indices(profile: GridProfile) -> np.ndarray:
    """Return the indices along a profile of the points whose ROC curves are drawn.

    Their pd is closest to one of `ROC_POINT_SELECTION_PDS`.
    """
    indices = profile.evenly_spread_indices(4 * charts.REDUCED_LINE_CELLS_MAX)
    pd = profile.variable_values("pd_shot", indices)
    if not np.isfinite(pd).any():
        return np.zeros(0, int)
    nearest_indices = [
        int(indices[np.nanargmin(np.abs(pd - pd_value))]) for pd_value in ROC_POINT_SELECTION_PDS
    ]
    return np.unique(nearest_indices)


def grid_noise_budget_chart(
    results: GridResults, profiles: Sequence[GridProfile], n_omitted: int
) -> Chart:
    """Return the chart of noise sources' shares of the noise at the ADC, along parts of a grid.

    A profile is a part of the grid along its main coordinate. `n_omitted` is the number of omitted
    profiles.
    """
    panels = []
    for profile in profiles:
        indices = profile.evenly_spread_indices(NOISE_BUDGET_POINTS_MAX)
        budgets = []
        for index, flags in zip(indices, profile.variable_values("effects", indices), strict=True):
            parameters = parameters_at(results.spec, profile.axis_indices(index))
            effects = [
                name
                for name in effect_names_in_flags(int(flags))
                if name not in _RANDOM_EFFECT_NAMES
            ]
            ((_, shots),) = prepare_shots(parameters, effects)
            budgets.append(shots.noise.variances)
        if profile.coordinate is None:
            x_axis, x = ChartAxis(), indices
        else:
            x_axis, x = (
                profile.coordinate_axis.chart_axis,
                profile.coordinate_axis.to_axis_units(profile.coordinate.values[indices]),
            )
        panels.append(noise_budget_panel({"part": profile.label}, x_axis, x, budgets))
    return noise_budget_chart(
        panels,
        ["Shares of the variance at the ADC, simulated for this page with the effects that the "
         "study simulates at each point; the standard deviation is shown on hovering",
         charts.omission_remark(n_omitted)],
    )  # fmt: skip


def noise_budget_panel(
    facet_choices: Mapping[str, str],
    x_axis: ChartAxis,
    x: np.ndarray,
    budgets: Sequence[Mapping[str, Any]],
) -> Panel:
    """Return the panel with the shares of noise sources in the noise variance.

    Parameters
    ----------
    facet_choices
        Choices of facets at which the panel is shown.
    x_axis, x
        Horizontal axis, and positions of n points along it.
    budgets
        Variances of the noise sources by name [V^2], at each of n points. The largest source at
        the first point is drawn first.
    """
    variances_by_point = [
        {n: float(np.ravel(v)[0]) for n, v in budget.items()} for budget in budgets
    ]
    sources = list(
        dict.fromkeys(n for variances in variances_by_point for n, v in variances.items() if v > 0)
    )
    sources.sort(key=lambda name: -variances_by_point[0].get(name, 0.0))
    total_variance = np.array([sum(variances.values()) for variances in variances_by_point])
    lines = []
    for style_index, source in enumerate(sources):
        variance = np.array([variances.get(source, 0.0) for variances in variances_by_point])
        lines.append(
            ChartLine(
                x,
                100 * variance / np.where(total_variance > 0, total_variance, 1.0),
                source.replace("_", " "),
                style_index,
                style="area",
                hover_texts=[f"{1e3 * np.sqrt(v):.3g} mV rms" for v in variance],
            )
        )
    return Panel(
        facet_choices, x_axis, ChartAxis("share of the noise variance (%)", limits=(0, 100)), lines
    )


def noise_budget_chart(panels: Sequence[Panel], caption: Sequence[str]) -> Chart:
    """Return the chart of the shares of noise sources from its panels and the caption's phrases."""
    share_texts = ", ".join(
        f"{line.name} {percent_text(line.y[0] / 100)} at first" for line in panels[0].lines
    )
    alt = f"Shares of noise sources in the noise variance at the ADC. {share_texts}."
    return Chart("Noise by source", alt, caption, panels, {"part": "Shown for"})


def false_alarm_chart(
    results: GridResults, profiles: Sequence[GridProfile], n_omitted: int
) -> Chart | None:
    """Return the chart of false alarms by noise and by leakage, along each profile of a grid.

    Leakage is signal in the window's sidelobes. The result is None for a grid with a single point.
    `n_omitted` is the number of omitted profiles.
    """
    if profiles[0].coordinate is None:
        return None
    coordinate_name = profiles[0].coordinate_name
    pfa_with_leakage = probability.false_alarms_per_shot(results.dataset, leakage=True)
    alarm_dataset = results.dataset[
        [v for v in _LABEL_BY_ALARM_VARIABLE if v != PFA_WITH_LEAKAGE_VARIABLE]
    ].assign({PFA_WITH_LEAKAGE_VARIABLE: pfa_with_leakage})
    labelled_lines: list[charts.LabelledLinePoints] = []
    drawn_lines: list[ChartLine] = []
    remarks: list[str] = []
    for variable, alarm_label in _LABEL_BY_ALARM_VARIABLE.items():
        variable_points = [
            charts.LabelledLinePoints(
                profile.label, alarm_label, replace(profile.points, dataset=alarm_dataset)
            )
            for profile in profiles
        ]
        # One reading pass per variable: in a joint pass chunks would accumulate in memory.
        lines, remarks = charts.read_lines_along(
            [(labelled_line.points, variable) for labelled_line in variable_points], coordinate_name
        )
        drawn_lines += lines
        labelled_lines += variable_points
    x_axis = CoordinateAxis.from_points(results.points, coordinate_name)
    panels = charts.make_line_panels(
        labelled_lines, drawn_lines, x_axis, ChartAxis("probability", LOG_SCALE)
    )
    # All points share one threshold if no axis changes it or the looks.
    off_axes = results.spec.parameters_off_axes()
    has_one_threshold = (
        set(THRESHOLD_PATHS[:3]) & off_axes.keys()
        and {LOOKS_NUMBER_PATH, LOOKS_COMBINE_PATH, LOOKS_VOTES_PATH} <= off_axes.keys()
    )
    parameters = results.spec.parameters()
    closed_form = noise_false_alarms.bin_pfa(
        float(tnr_from_parameters(parameters)), Looks.from_parameters(parameters)
    )
    return Chart(
        "False alarms",
        charts.lines_alt_text(
            "probabilities of false alarms and leakage", x_axis.chart_axis.label, panels[0]
        ),
        [f"A bin of noise alone crosses with probability {closed_form:.3g} in closed form"
         if has_one_threshold else "",
         *remarks,
         "Leakage: extra groups raised by the signal's own sidelobes, over noise alone",
         "Either: by noise or by leakage; both: in the up- and in the down-chirp of a shot",
         charts.omission_remark(n_omitted)],
        panels,
        {"part": "Shown for"},
    )  # fmt: skip


REPORTED_PD_LEVEL = 0.9
"""Level of pd that a report requires up to the maximum range, and at points that it counts."""

UNBROKEN_RANGE_LABEL = "kept all the way"
"""Label of the maximum range up to which pd is at the level without interruption."""

LIMIT_VARIABLE_BY_LABEL = {UNBROKEN_RANGE_LABEL: "unbroken", "reached at all": "farthest"}
"""Variable of :func:`.detection_limits.limit` for each of two kinds of maximum range, by label."""

INTERVAL_END_LABEL_BY_SUFFIX = {"low": "lower end", "high": "upper end"}
"""Column name for each end of the maximum range's confidence interval, by the variable's suffix."""

MAXIMUM_RANGE_TITLE = f"Maximum range at a pd of {REPORTED_PD_LEVEL:g}"
"""Heading of the chart and of the table of the maximum range."""

MAXIMUM_RANGE_CAPTION = [
    "Kept all the way: up to here the probability of detection of a shot is "
    f"{REPORTED_PD_LEVEL:g} or more at "
    "every range of the study; reached at all: the farthest range at which it is.",
    "Between ranges it is interpolated in its normal deviate.",
    f"There is none where it is below {REPORTED_PD_LEVEL:g} from the first range on, "
    "not below it at the last, or "
    "not computed.",
]
"""Caption of the chart and of the table of the maximum range."""


def maximum_range_chart_or_table(results: GridResults) -> Chart | HtmlTable | None:
    """Return the maximum range of a grid as a chart over a coordinate other than range.

    If only range varies, the result is a table. If range does not vary, the result is None.
    """
    range_parameter = find_axis_parameter(results.spec, RANGE_PATH)
    if range_parameter is None:
        return None
    points = results.points
    range_axis = CoordinateAxis.from_points(points, range_parameter.coordinate_name)
    other_names = points.distinguishing_coordinates_along(
        points.dim_of_coordinate(range_parameter.coordinate_name), [range_parameter.coordinate_name]
    )
    varied_parts = [
        part
        for part in split_by_coordinates(points, other_names, points.n_points).parts
        if len(part.points.unique_values(range_parameter.coordinate_name)) > 1
    ]
    shown_parts, n_omitted = thin_parts_evenly(varied_parts, CHART_PARTS_MAX)
    max_ranges = [
        NamedPart(
            words,
            _compute_maximum_range(
                shown_points, range_parameter.coordinate_name, range_axis.unit_factor
            ),
        )
        for words, shown_points in shown_parts
    ]
    if not max_ranges:
        return None
    words = labels.axis_label("maximum range", range_axis.units)
    x = _choose_x_coordinate(results, max_ranges[0].points)
    return (
        _maximum_range_chart(max_ranges, x, words, n_omitted)
        if x
        else _maximum_range_table(max_ranges, words)
    )


def is_chart_without_values(item: Chart | HtmlTable | None) -> bool:
    """Return True for a chart of lines without any finite value, False for everything else."""
    if not isinstance(item, Chart):
        return False
    return not any(np.isfinite(line.y).any() for panel in item.panels for line in panel.lines)


def maximum_range_sentences(item: Chart | HtmlTable | None) -> list[str]:
    """Return sentences on the maximum range, given as :func:`maximum_range_chart_or_table`."""
    unbroken_label = next(iter(LIMIT_VARIABLE_BY_LABEL))
    if isinstance(item, Chart):
        range_label, unbroken_panels = (
            item.panels[0].y_axis.label,
            [p for p in item.panels if p.facet_choices["answer"] == unbroken_label],
        )
        values = np.concatenate([line.y for panel in unbroken_panels for line in panel.lines])
    elif item is not None:
        range_label = next(name for name in item.frame if name.startswith("maximum range"))
        values = item.frame[range_label][
            item.frame[f"a pd of {REPORTED_PD_LEVEL:g}"] == unbroken_label
        ].to_numpy(float)
    else:
        return []
    finite_values = values[np.isfinite(values)]
    sentences = []
    if finite_values.size:
        range_texts = " to ".join(
            dict.fromkeys(
                f"{range_end:.3g}" for range_end in (finite_values.min(), finite_values.max())
            )
        )
        parts_note = (
            ", of the parts shown here" if any("not shown" in c for c in item.caption) else ""
        )
        quantity, _, units = range_label.rstrip(")").partition(" (")
        sentences = [
            f"{quantity.capitalize()} with a probability of {REPORTED_PD_LEVEL:g} or more all the "
            f"way{parts_note}: "
            f"{range_texts} {units}."
        ]
    if n_missing := values.size - finite_values.size:
        sentences.append(
            f"No maximum range at {n_missing:,} of {values.size:,} places: there the probability "
            f"is below {REPORTED_PD_LEVEL:g} from the first range on, "
            f"or {REPORTED_PD_LEVEL:g} or more up to the last."
        )
    return sentences


def _compute_maximum_range(points: PointSelection, name: str, unit_factor: float) -> PointSelection:
    """Return the maximum range over all coordinates except range, as lazy variables of points.

    `name` is the name of the range coordinate. The result is in display units, to which
    `unit_factor` converts the units of that coordinate.
    """
    dim = points.dim_of_coordinate(name)
    indices = np.sort(points.sorted_coordinate(name).indices)
    dataset = points.dataset
    if indices.size < dataset.sizes[dim]:
        dataset = dataset.isel({dim: indices})
    max_range = dataset.sweep.maximum_range(REPORTED_PD_LEVEL)
    converted_arrays = {
        str(variable): (array * unit_factor).assign_attrs(array.attrs)
        for variable, array in max_range.data_vars.items()
        if not str(variable).endswith("reason")
    }
    return PointSelection.from_dataset(max_range.assign(converted_arrays))


def _choose_x_coordinate(results: GridResults, points: PointSelection) -> str:
    """Return the name of the coordinate over which the maximum range is drawn; '' if none varies.

    It is the grazing angle if it varies, otherwise the numeric coordinate with the most values.
    """
    varying_names = points.varying_coordinates()
    angle_parameter = find_axis_parameter(results.spec, GRAZING_ANGLE_PATH)
    if angle_parameter is not None and angle_parameter.coordinate_name in varying_names:
        return angle_parameter.coordinate_name
    numeric_names = [
        name for name in varying_names if not labels.is_categorical(points.coordinate_values(name))
    ]
    return max(
        numeric_names or varying_names, key=lambda name: len(points.unique_values(name)), default=""
    )


def _maximum_range_chart(
    max_ranges: Sequence[NamedPart], x: str, range_label: str, n_omitted: int
) -> Chart:
    """Return the chart of the maximum range, with panels by part and kind of maximum range.

    Parameters
    ----------
    max_ranges
        Name and maximum range of each part.
    x
        Name of the coordinate along the horizontal axis.
    range_label
        Label of the vertical axis.
    n_omitted
        Number of omitted parts.
    """
    first_points = max_ranges[0].points
    line_coordinates = [
        n
        for n in first_points.distinguishing_coordinates([x])
        if len(first_points.unique_values(n)) <= charts.LINES_PER_PANEL_MAX
    ][:1]
    parts: list[NamedPart] = []
    for part_label, max_range in max_ranges:
        subparts, n_omitted_parts = split_by_coordinates(
            max_range, max_range.distinguishing_coordinates([x, *line_coordinates]), CHART_PARTS_MAX
        )
        parts += [
            NamedPart(", ".join(filter(None, (part_label, subpart_label))), part)
            for subpart_label, part in subparts
        ]
        n_omitted += n_omitted_parts
    n_omitted += max(0, len(parts) - CHART_PARTS_MAX)
    labelled_lines = charts.split_into_lines(
        parts[:CHART_PARTS_MAX], line_coordinates
    ).labelled_lines
    pairs = [
        (labelled_line.points, answer)
        for answer in LIMIT_VARIABLE_BY_LABEL.values()
        for labelled_line in labelled_lines
    ]
    drawn_lines, remarks = charts.read_lines_along(pairs, x)
    x_axis = CoordinateAxis.from_points(first_points, x)
    y_axis = ChartAxis(range_label, LINEAR_SCALE, (0.0, None))
    panels = [
        panel
        for answer_label, answer_lines in zip(
            LIMIT_VARIABLE_BY_LABEL,
            (drawn_lines[: len(labelled_lines)], drawn_lines[len(labelled_lines) :]),
            strict=True,
        )
        for panel in charts.make_line_panels(
            labelled_lines, answer_lines, x_axis, y_axis, answer=answer_label
        )
    ]
    span_text = x_axis.describe_span(np.unique(first_points.coordinate_values(x)))
    return Chart(
        MAXIMUM_RANGE_TITLE,
        charts.lines_alt_text(
            f"{range_label} at a probability of detection of {REPORTED_PD_LEVEL:g}",
            span_text,
            panels[0],
        ),
        [*MAXIMUM_RANGE_CAPTION, *remarks, charts.omission_remark(n_omitted)],
        panels,
        {"part": "Shown for", "answer": f"A pd of {REPORTED_PD_LEVEL:g}"},
    )


def _maximum_range_table(max_ranges: Sequence[NamedPart], range_label: str) -> HtmlTable:
    """Return the table of the maximum range, with a row for each part and kind of maximum range.

    If pd is drawn, columns show the confidence interval. A column shows why a value is missing.
    """
    rows = []
    for part, range_points in max_ranges:
        max_range: xr.Dataset = range_points.dataset.isel(range_points.first_indices()).compute()
        reason_texts = str(max_range["unbroken_reason"].attrs["flag_meanings"]).split()
        for answer_label, answer in LIMIT_VARIABLE_BY_LABEL.items():
            label_by_end = {
                f"{answer}_{end_name}": end_label
                for end_name, end_label in INTERVAL_END_LABEL_BY_SUFFIX.items()
            }
            rows.append(
                {
                    "for": part,
                    f"a pd of {REPORTED_PD_LEVEL:g}": answer_label,
                    range_label: max_range[answer].item(),
                }
                | {
                    end_label: max_range[name].item()
                    for name, end_label in label_by_end.items()
                    if name in max_range
                }
                | {"which is": reason_texts[int(max_range[f"{answer}_reason"])].replace("_", " ")}
            )
    frame = pandas.DataFrame(rows)
    if not any(part for part, _ in max_ranges):
        frame = frame.drop(columns="for")
    return HtmlTable(MAXIMUM_RANGE_TITLE, MAXIMUM_RANGE_CAPTION, frame, "maximum_range")
