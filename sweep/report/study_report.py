"""Reports of grids and flights: the contents of each section, and the HTML file."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import dask
import numpy as np
import pandas
import xarray as xr
import yaml

from sweep.analysis import labels
from sweep.analysis.charts import Chart, ChartSizeLimits
from sweep.analysis.datasets import NotAStoreError, read_attributes_of_kind
from sweep.analysis.scene_results.consistency import check_error_consistency
from sweep.analysis.scene_results.recordings import (
    INTERPOLATED_RANGES,
    QUANTITY_BY_NAME,
    to_displayed_values,
)
from sweep.analysis.selection import to_float_with_nan
from sweep.analysis.study_figures import GridResults, SceneResults, describe_selection
from sweep.analysis.tables import TablePage as TablePage
from sweep.analysis.tables import single_point_page
from sweep.messages import sweep_shell_command
from sweep.model.effects.catalogue import EFFECTS
from sweep.report import detector_charts, flight_charts
from sweep.report.flight_charts import LabelledRecording
from sweep.report.html_page import (
    HtmlTable,
    PageItem,
    PageSection,
    ReportPage,
    TextItem,
    make_interactive_plot,
    render_html,
)
from sweep.spec import GridSpec, SceneSpec, SlicesFigure, SurfaceFigure
from sweep.spec.noise_alarms import false_alarm_probabilities
from sweep.spec.sections import parameter_rules
from sweep.storage.locations import Location, parse_location, write_path_atomically
from sweep.storage.store_format import (
    ACCURACY_STORE_KIND,
    GRID_STORE_KIND,
    SCENE_STORE_KIND,
    parse_software_versions,
)

PAGE_CHART_SIZE_LIMITS = ChartSizeLimits(
    parts_max=detector_charts.CHART_PARTS_MAX,
    columns_max=500,
    rows_max=180,
    cells_max=400_000,
    maps_per_row=1,
)
"""Limits of the charts on a page: number of parts of the study, and size of heat maps.

The limit of cells applies to all heat maps together, and keeps the page to a few megabytes.
"""

TABLE_POINTS_MAX = 1000
"""Largest number of points in the table of points of a report."""

GRID_TABLE_VARIABLES = (
    "pd_shot", "pd_shot_half_width", "pd_up", "pd_doppler", "pd_down", "pfa_segment", "pfa_shot",
    "pfa_both_chirps",
    "p_leakage_up", "false_alarms", "snr_up", "snr_doppler", "range_error",
    "radial_velocity_error", "range_rmse", "range_bound", "radial_velocity_rmse",
    "radial_velocity_bound", "beamlets", "n_draws", "effects_error",
)  # fmt: skip
"""Names of the variables in the table of points of a grid's report."""

CLOUD_TABLE_QUANTITIES = (
    "time", "beam", "x", "y", "z", "range", "radial_velocity", "snr", "pd", "true_range",
    "true_radial_velocity", "flags",
)  # fmt: skip
"""Names of the quantities in the table of points of a flight's report."""


def write_report(store: str | Location, file: str | Path) -> Path:
    """Write the report of a study as a single self-contained HTML file.

    Parameters
    ----------
    store
        Store of a grid or of a scene, complete or not.
    file
        HTML file to write. It appears only once it is complete.

    Returns
    -------
    Path
        Written file.

    Raises
    ------
    NotAStoreError
        The path has no store of a grid or of a scene.
    OSError
        The file can't be written.
    """
    store, file = parse_location(store), Path(file)
    kind = read_attributes_of_kind(store)["kind"]
    if kind == ACCURACY_STORE_KIND:
        raise NotAStoreError(f"{store} holds what accuracy costs: sweep figures {store}  draws it")
    if kind not in (GRID_STORE_KIND, SCENE_STORE_KIND):
        read_attributes_of_kind(store, GRID_STORE_KIND)  # raises an error that names its kind
    page = _scene_report(store) if kind == SCENE_STORE_KIND else _grid_report(store)
    html = render_html(page)
    with write_path_atomically(file, replace=True) as draft_path:
        draft_path.write_text(html, encoding="utf-8")
    return file


SectionItem = Chart | PageItem | None
"""Item that a section of a report is made from.

Charts become interactive plots. None is left out.
"""

AnySpec = GridSpec | SceneSpec
"""Type of the spec of a grid or of a scene."""


def _grid_report(store: Location) -> ReportPage:
    """Return the report of a grid's store."""
    results = GridResults.from_store(store)
    dataset, spec = results.dataset, results.spec
    figure_items: list[SectionItem] = list(_iter_figure_charts(results))
    table_items = list(_iter_spec_tables(results))
    max_range_item = detector_charts.maximum_range_chart_or_table(results)
    figure_items.append(
        None if detector_charts.is_chart_without_values(max_range_item) else max_range_item
    )
    profiles_and_omitted = detector_charts.grid_profiles(results)
    detector_items: list[SectionItem] = [
        detector_charts.grid_noise_budget_chart(results, *profiles_and_omitted)
    ]
    if not spec.draws.draws_whole_spectra:  # detectors of whole spectra have no closed forms
        detector_items = [
            detector_charts.roc_chart(results, *profiles_and_omitted),
            detector_charts.false_alarm_chart(results, *profiles_and_omitted),
            *detector_items,
        ]
    request_section = _spec_and_effects_section(spec, [dataset["effects"]], dataset)
    axis_texts = [f"{axis.size:,} {labels.coordinate_label(axis.name)}" for axis in spec.axes]
    key_facts = [("points", f"{dataset.attrs['points']:,}"),
             ("grid", " x ".join(axis_texts) or "a single point")]  # fmt: skip
    sections = [
        _main_results_section(
            spec, [dataset], "points", detector_charts.maximum_range_sentences(max_range_item)
        ),
        _page_section("figures", "Figures", figure_items),
        _page_section("detector", "Detection and noise", detector_items),
        request_section,
        _page_section("tables", "Tables", [*table_items, _grid_point_table(results)]),
    ]
    return _report_page(spec, dataset.attrs, "points", key_facts, sections, store)


def _main_results_section(
    spec: AnySpec, groups: Sequence[xr.Dataset], counted_unit: str, further_sentences: Sequence[str]
) -> PageSection:
    """Return the section with the main results: detection, false alarms, and the tolerance.

    Parameters
    ----------
    spec
        Spec of the study.
    groups
        Datasets with the variables of all points, or of the shots of each scanner.
    counted_unit
        Name of what the datasets count: ``points`` or ``shots``.
    further_sentences
        Sentences that follow the first sentence of the section.
    """
    tolerance, pd_level = spec.accuracy.tolerance, detector_charts.REPORTED_PD_LEVEL
    limits = {"effects_error": tolerance, "beamlets_error": tolerance, "accuracy_missed": 0.0}
    lazy_counts = []
    for group in groups:
        pd = group["pd_shot"]
        exceedances = [group[name] > limit for name, limit in limits.items() if name in group]
        is_missed = sum(exceedances, xr.DataArray(0)) > 0
        is_unchecked = pd.notnull() & group["beamlets_error"].isnull()
        lazy_counts.append(
            (
                pd.count(),
                (pd >= pd_level).sum(),
                pd.sum(),
                pd.min(),
                is_missed.sum(),
                is_unchecked.sum(),
            )
        )
    counts_by_statistic = np.array(dask.compute(lazy_counts)[0], float).T  # one column per group
    n_computed, n_at_level, pd_sum, _, n_missed, n_unchecked = counts_by_statistic.sum(axis=1)
    if not n_computed:
        return PageSection("answer", "Answer", ["No result is there yet."])
    sentences = [
        f"The probability of detection of a shot is {pd_level:g} or more at {n_at_level:,.0f} of "
        f"{n_computed:,.0f} {counted_unit}; its mean is {pd_sum / n_computed:.3g}, its lowest "
        f"{np.nanmin(counts_by_statistic[3]):.3g}.",
        *further_sentences,
    ]
    if alarms := false_alarm_probabilities(spec):
        alarm_probability_max = max(alarm.either_chirp for alarm in alarms)
        alarm_text = f"{alarm_probability_max:.3g}" + " at the most" * (len(alarms) > 1)
        sentences.append(
            f"Noise alone raises a false alarm in either chirp with probability {alarm_text}."
        )
    tolerance_text = (
        f"missed at {n_missed:,.0f} {counted_unit}"
        if n_missed
        else f"kept at all of these {counted_unit}"
    )
    sentences.append(f"The tolerance of {tolerance:g} is {tolerance_text}.")
    if n_unchecked:
        sentences.append(
            f"Whether the number of beamlets keeps it is not checked at {n_unchecked:,.0f} of "
            "them: their number is given, or their amplitudes add."
        )
    return PageSection("answer", "Answer", sentences)


def _spec_and_effects_section(
    spec: AnySpec, effect_flags: Sequence[xr.DataArray], dataset: xr.Dataset
) -> PageSection:
    """Return the section on the spec's axes and fields, the simulated effects, and the accuracy.

    `effect_flags` are the flags of simulated effects at all points. `dataset` has the error bounds.
    """
    items = [
        _axis_table(spec),
        _effect_table(effect_flags, spec.effect_modes()),
        _spec_field_table(spec),
    ]
    return _page_section(
        "asked", "What was asked and simulated", items, accuracy_sentences(dataset, spec)
    )


def _report_page(
    spec: AnySpec, attributes: Mapping[Any, Any], counted_unit: str,
    first_facts: Sequence[tuple[str, str]], sections: Sequence[PageSection], store: Location,
) -> ReportPage:  # fmt: skip
    """Return a report with its key facts, its sections, and instructions to reproduce the study."""
    key_facts = [
        *first_facts,
        ("study", attributes["study_id"][:8]),
        ("model", str(attributes["model_version"])),
        ("sweep", parse_software_versions(attributes).get("sweep", "")),
        ("finished (UTC)", str(attributes["finished"])[:16].replace("T", " ")),
    ]
    n_done, n_total = attributes[f"{counted_unit}_committed"], attributes[counted_unit]
    remark = (
        f"The study is not complete: {n_done:,} of {n_total:,} {counted_unit} are computed. "
        "sweep resume goes on."
    )
    return ReportPage(
        spec.title,
        spec.question,
        [(name, value) for name, value in key_facts if value],
        [remark] if n_done < n_total else [],
        [*sections, _reproduction_section(attributes, spec, str(store))],
    )


def _iter_figure_charts(results: GridResults) -> Iterator[SectionItem]:
    """Yield the charts of a grid's surfaces and slices: those of the spec, or a default set."""
    figure_specs = [
        figure_spec
        for figure_spec in results.figure_specs
        if isinstance(figure_spec, SurfaceFigure | SlicesFigure)
    ]
    n_maps = sum(isinstance(figure_spec, SurfaceFigure) for figure_spec in figure_specs)
    for figure_spec in figure_specs:
        chart = results.make_chart(
            figure_spec,
            replace(
                PAGE_CHART_SIZE_LIMITS, cells_max=PAGE_CHART_SIZE_LIMITS.cells_max / max(1, n_maps)
            ),
        )
        if chart is None:
            yield TextItem(figure_spec.title, ["No point of the study is within its limits."], "")
        else:
            yield replace(
                chart,
                heading=figure_spec.title or chart.heading,
                caption=[describe_selection(figure_spec), *chart.caption],
            )


def _iter_spec_tables(results: GridResults) -> Iterator[HtmlTable]:
    """Yield the tables that a grid's spec defines.

    For a grid with a single point, yield a table of all outputs first.
    """
    if not results.spec.axes:
        yield from _iter_html_tables(single_point_page(results.dataset), "outputs")
    for figure_spec in results.figure_specs:
        if not isinstance(figure_spec, SurfaceFigure | SlicesFigure):
            yield from _iter_html_tables(
                results.make_table_page(figure_spec), figure_spec.file_stem
            )


def _iter_html_tables(table_page: TablePage, stem: str) -> Iterator[HtmlTable]:
    """Yield the tables of a page of text tables as HTML tables.

    `stem` is the beginning of the names of the CSV files that the reader can download.
    """
    for table_number, page_table in enumerate(table_page.page_tables):
        frame = pandas.DataFrame(
            [list(row) for row in page_table.rows], columns=list(page_table.columns)
        )
        is_last = table_number + 1 == len(table_page.page_tables)
        heading = (
            f"{table_page.title}: {page_table.heading}" if table_page.title else page_table.heading
        )
        notes = (
            [" ".join(" ".join(table_page.notes).split())] if is_last and table_page.notes else []
        )
        yield HtmlTable(
            heading, notes, frame, f"{stem}_{table_number + 1}" if table_number else stem
        )


def _scene_report(store: Location) -> ReportPage:
    """Return the report of a flight's store."""
    results = SceneResults.from_store(store)
    spec, attributes = results.spec, results.tree.attrs
    labelled_recordings, n_omitted = flight_charts.select_recordings(results)
    cloud_plot = flight_charts.cloud_plot(results, labelled_recordings, n_omitted)
    flight_items: list[SectionItem] = [
        flight_charts.shots_over_time_chart(labelled_recordings),
        flight_charts.measurement_error_chart(labelled_recordings),
        flight_charts.flight_navigation_error_chart(spec, labelled_recordings),
        flight_charts.flight_noise_budget_chart(results, labelled_recordings),
    ]
    scanner_datasets = [results.tree[name].to_dataset() for name in results.scanners]
    request_section = _spec_and_effects_section(
        spec, [g["effects"].chunk() for g in scanner_datasets], scanner_datasets[0]
    )
    key_facts = [("shots times draws", f"{attributes['points']:,}"),
             ("scanners", ", ".join(map(labels.coordinate_label, results.scanners)))]  # fmt: skip
    point_count_table = flight_charts.point_count_table(labelled_recordings)
    sections = [
        _main_results_section(
            spec,
            scanner_datasets,
            "shots",
            [
                *flight_charts.point_count_sentences(
                    point_count_table.frame, scanner_datasets, n_omitted
                ),
                *error_consistency_sentences(results.tree),
            ],
        ),
        _page_section(
            "cloud",
            "Point cloud",
            [cloud_plot],
            [] if cloud_plot else ["No shot has brought back a point."],
        ),
        _page_section("flight", "Along the flight", flight_items),
        request_section,
        _page_section(
            "tables", "Tables", [point_count_table, _cloud_point_table(labelled_recordings)]
        ),
    ]
    return _report_page(spec, attributes, "blocks", key_facts, sections, store)


def error_consistency_sentences(tree: xr.DataTree) -> list[str]:
    """Return sentences on how a flight's errors compare with their stated standard errors."""
    results = check_error_consistency(tree)
    if messages := [result.message for result in results if not result.is_consistent]:
        return messages
    if not any(result.n_errors for result in results):
        return []
    return ["Errors of points and of navigation agree with the standard errors that are stated."]


def _page_section(
    anchor: str, title: str, items: Sequence[SectionItem], paragraphs: Sequence[str] = ()
) -> PageSection:
    """Return a section of a page. Charts become interactive plots, and None is left out."""
    page_items = [
        make_interactive_plot(item) if isinstance(item, Chart) else item for item in items
    ]
    return PageSection(anchor, title, paragraphs, [item for item in page_items if item is not None])


def _grid_point_table(results: GridResults) -> HtmlTable | None:
    """Return a table of a grid's points, at most `TABLE_POINTS_MAX`; None for a single point."""
    dataset = results.dataset
    if not results.spec.axes:
        return None
    variables = [name for name in GRID_TABLE_VARIABLES if name in dataset]
    size_by_dim = dict(zip(dataset[variables[0]].dims, dataset[variables[0]].shape, strict=True))
    reduced_size = dict(size_by_dim)
    while np.prod(list(reduced_size.values())) > TABLE_POINTS_MAX:
        longest_dim = max(reduced_size, key=lambda dim: reduced_size[dim])
        reduced_size[longest_dim] -= max(1, reduced_size[longest_dim] // 10)
    indices = {
        dim: np.unique(np.linspace(0, size_by_dim[dim] - 1, length).round().astype(int))
        for dim, length in reduced_size.items()
    }
    reduced_dataset = dataset[variables].isel(indices)  # type: ignore[arg-type]
    for name in variables:
        reduced_dataset[name] = to_float_with_nan(reduced_dataset[name]).assign_attrs(
            dataset[name].attrs
        )
    frame = reduced_dataset.to_dataframe().reset_index()
    frame = frame[[c for c in frame.columns if c in dataset.coords or c in variables]]
    frame = frame.rename(
        columns={
            c: labels.column_label(c, dataset[c].attrs.get("units", "")) for c in frame.columns
        }
    )
    n_total = int(np.prod(list(size_by_dim.values())))
    return HtmlTable("Points", _table_share_caption(len(frame), n_total), frame, "points")


def _table_share_caption(n_rows: int, n_total: int) -> list[str]:
    """Return the caption of a table of points that states how many of all points it contains."""
    if n_rows == n_total:
        return [f"All {n_total:,} points."]
    return [
        f"{n_rows:,} of {n_total:,} points, spread over all: reduced for this page. The store has "
        "every one."
    ]


def _cloud_point_table(labelled_recordings: list[LabelledRecording]) -> HtmlTable:
    """Return a table of points of all recordings in the first draw.

    The points are thinned to at most `TABLE_POINTS_MAX`.
    """
    frames, n_total = [], 0
    for labelled_recording in labelled_recordings:
        thinned_rows = labelled_recording.recording.read_thinned_rows(
            CLOUD_TABLE_QUANTITIES,
            TABLE_POINTS_MAX // len(labelled_recordings),
            ranges=INTERPOLATED_RANGES,
        )
        n_total += thinned_rows.n_total
        if thinned_rows.n_total:
            column_arrays = thinned_rows.to_columns()
            columns = {
                labels.column_label(
                    name, "dB" if name == "snr" else QUANTITY_BY_NAME[name].units
                ): (to_displayed_values(name, values) if name != "flags" else values)
                for name, values in column_arrays.items()
            }
            frames.append(
                pandas.DataFrame(
                    {"recorded by": labelled_recording.label or "the scanner"} | columns
                )
            )
    frame = pandas.concat(frames, ignore_index=True) if frames else pandas.DataFrame()
    return HtmlTable("Points", _table_share_caption(len(frame), n_total), frame, "points")


def _spec_field_table(spec: AnySpec) -> HtmlTable:
    """Return a table of the spec's fields, with their values and descriptions."""
    rule_by_path = parameter_rules()
    spec_mapping = spec.to_yaml_mapping()
    rows = [
        (
            path,
            _format_field_value(value),
            rule_by_path[path].description if path in rule_by_path else "",
        )
        for path, value in _iter_spec_fields(spec_mapping)
        if path.split(".")[0] not in ("title", "question", "figures", "axes", "effects")
    ]
    frame = pandas.DataFrame(rows, columns=["field", "value", "meaning"])
    return HtmlTable("Every field", ["Defaults included."], frame, "fields")


def _iter_spec_fields(mapping: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted path and the value of every field of a nested mapping.

    `prefix` is the beginning of every path.
    """
    for name, value in mapping.items():
        path = f"{prefix}{name}"
        if isinstance(value, Mapping) and value:
            yield from _iter_spec_fields(value, f"{path}.")
        else:
            yield path, value


def _format_field_value(value: object) -> str:
    """Return the value of a field as text of at most 120 characters."""
    value_text = (
        value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)
    )
    return value_text if len(value_text) <= 120 else f"{value_text[:117]}..."


def _axis_table(spec: AnySpec) -> HtmlTable | None:
    """Return a table of the study's axes with their values; None for a study without axes."""
    rows = [
        (
            axis.name,
            axis_parameter.path,
            axis.size,
            _format_values(axis_parameter.display_values, axis_parameter.units),
        )
        for axis in spec.axes
        for axis_parameter in axis.parameters
    ]
    if not rows:
        return None
    frame = pandas.DataFrame(rows, columns=["axis", "parameter", "values", "which"])
    return HtmlTable("What varies", [], frame, "axes")


def _format_values(values: np.ndarray, units: str) -> str:
    """Return the values of an axis as text; of many values only the first two and the last."""
    value_texts = [labels.format_quantity(v, units) for v in values[:4]]
    if len(values) > 5:
        return ", ".join([*value_texts[:2], "...", labels.format_quantity(values[-1], units)])
    return ", ".join(labels.format_quantity(v, units) for v in values)


def _effect_table(flag_arrays: Sequence[xr.DataArray], modes: Mapping[str, str]) -> HtmlTable:
    """Return a table of the effects: the share of points that simulate each effect, and where.

    `flag_arrays` hold the effects simulated at each point. `modes` are the spec's modes by effect.
    """
    lazy_counts = []
    for k in range(len(EFFECTS)):
        presence = [array // 2**k % 2 > 0 for array in flag_arrays]
        lazy_counts.append(
            [
                (
                    effect_presence.sum(),
                    [
                        effect_presence.any(set(effect_presence.dims) - {dim})
                        for dim in effect_presence.dims
                    ],
                )
                for effect_presence in presence
            ]
        )
    (effect_counts,) = dask.compute(lazy_counts)
    n_points = sum(array.size for array in flag_arrays)
    rows = []
    for effect, group_counts in zip(EFFECTS, effect_counts, strict=True):
        n_with_effect = sum(int(n_in_group) for n_in_group, _ in group_counts)
        extent_texts = [
            _describe_effect_extent(along)
            for _, presence_by_dim in group_counts
            for along in presence_by_dim
        ]
        where_text = (
            ", ".join(dict.fromkeys(filter(None, extent_texts)))
            if n_with_effect < n_points
            else "everywhere"
        )
        rows.append(
            (
                effect.name.replace("_", " "),
                modes[effect.name],
                round(100 * n_with_effect / n_points, 2),
                where_text,
                effect.description,
            )
        )
    rows.sort(key=lambda row: -row[2])
    columns = ["effect", "asked", "% of points", "within", "what it is"]
    caption = [
        "Asked: auto simulates an effect where leaving it out could change a probability, or the "
        "magnitude of a bin, by more than the tolerance allows.",
        "Within: the smallest part of the study that holds all points with the effect.",
    ]
    return HtmlTable("Effects", caption, pandas.DataFrame(rows, columns=columns), "effects")


def _describe_effect_extent(presence: xr.DataArray) -> str:
    """Return a text that states where along a dimension points simulate an effect.

    `presence` is a mask along the dimension. The text is empty if all points or none are in the
    mask.
    """
    is_present, extent_texts = presence.values, []
    for name, coordinate in presence.coords.items():
        if coordinate.ndim != 1 or is_present.all() or not is_present.any():
            continue
        if labels.is_categorical(coordinate.values):
            continue
        present_values = coordinate.values[is_present]
        units = coordinate.attrs.get("units", "")
        end_texts = [
            labels.format_quantity(v, units) for v in (present_values.min(), present_values.max())
        ]
        extent_texts.append(
            f"{labels.coordinate_label(str(name))} {end_texts[0]} to {end_texts[1]}"
        )
    return ", ".join(extent_texts)


def accuracy_sentences(dataset: xr.Dataset, spec: AnySpec) -> list[str]:
    """Return sentences on the accuracy that the spec requires, and on the errors of the results."""
    tolerance = spec.accuracy.tolerance
    sentences = [
        f"Asked for: no probability of detection off by more than {tolerance:g}"
        + (f", with a confidence of {spec.accuracy.confidence:g}" if "n_draws" in dataset else "")
        + "."
    ]
    if "effects_error" in dataset:
        sentences.append(
            "What was left out changes a probability by "
            f"{float(dataset['effects_error'].max()):.2g} at the most, at any point."
        )
    beamlets_error = float(dataset["beamlets_error"].max()) if "beamlets_error" in dataset else 0.0
    if beamlets_error > 0:
        sentences.append(f"More beamlets would change one by {beamlets_error:.2g} at the most.")
    elif math.isnan(beamlets_error):
        sentences.append("What more beamlets would change is not checked.")
    if "n_draws" in dataset:
        accuracy_missed = dataset["accuracy_missed"]
        n_known = int(accuracy_missed.notnull().sum())
        n_met = int((accuracy_missed <= 0).sum())
        sentences.append(
            f"Drawn to that accuracy at {n_met:,} of {n_known:,} points; the largest half-width of "
            f"pd_shot is {float(dataset['pd_shot_half_width'].max()):.2g}, and "
            f"{int(dataset['n_draws'].where(dataset['n_draws'] > 0).sum()):,} draws were made."
        )
    return sentences


def _reproduction_section(
    attributes: Mapping[Any, Any], spec: AnySpec, store_path: str
) -> PageSection:
    """Return the section with the citation of the study, and commands to reproduce it."""
    version_by_package = parse_software_versions(attributes)
    version = version_by_package.get("sweep", "")
    year = str(attributes.get("finished") or attributes.get("started") or "")[:4]
    id_text = f"study {attributes['study_id']}, model {attributes['model_version']}"
    citation = (
        f"{attributes['title']}. Simulated with sweep {version}, {id_text}"
        f"{f', {year}' if year else ''}."
    )
    bibtex = (
        f"@misc{{sweep-{attributes['study_id'][:8]},\n"
        f"  title = {{{{{attributes['title']}}}}},\n"
        f"  howpublished = {{Simulated with sweep {version}}},\n"
        f"  note = {{{id_text}}},\n" + (f"  year = {{{year}}},\n" if year else "") + "}"
    )
    spec_yaml = yaml.safe_dump(
        spec.to_yaml_mapping(), sort_keys=False, allow_unicode=True, width=100
    )
    commands = "\n".join(
        [
            sweep_shell_command("run", "study.yaml", store=store_path),
            sweep_shell_command("figures", store_path),
            sweep_shell_command("report", store_path),
        ]
    )
    versions_text = ", ".join(
        f"{name} {package_version}" for name, package_version in version_by_package.items()
    )
    paragraphs = [
        f"Made with {versions_text}, on a processor {attributes['processor']}. The same spec, seed "
        "and "
        "versions give the same numbers, bit for bit, on any number of workers."
    ]
    return PageSection(
        "reproduce",
        "Cite and reproduce",
        paragraphs,
        [
            TextItem("Citation", [], citation),
            TextItem("BibTeX", [], bibtex, "study.bib"),
            TextItem("Commands", ["With the spec below saved as study.yaml."], commands),
            TextItem(
                "Spec", ["As it was computed, every default written out."], spec_yaml, "study.yaml"
            ),
        ],
    )
