"""Comparison of two studies or two flights at their common points: differences and a verdict."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pandas
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.answers import provenance
from sweep.analysis.answers.dataset_lookup import (
    STUDY_ID_NAME,
    coordinate_in_si,
    parameter_in_si,
    spec_of_dataset,
    study_marker_names,
)
from sweep.analysis.charts import LOG_SCALE, Chart, ChartAxis, ChartLine, Panel
from sweep.model.error_budget import clopper_pearson_interval
from sweep.model.error_budget import interval_half_width as interval_half_width
from sweep.model.outputs import (
    GRID_OUTPUTS,
    PD_OUTPUT_NAMES,
    SHOT_STATISTIC_VARIABLES,
    SPECTRA_STUDY_OUTPUTS,
)
from sweep.model.pointcloud.pairing import TRUE_RETURN_FLAG

PD_ROUNDING_ERROR_MAX = 1e-12
"""Largest difference of pd between two processors that counts as a rounding error."""

_MATCHED_SIGNIFICANT_DIGITS = 12
"""Number of significant digits to which the coordinates of matching points agree."""

GRID_FLIGHT_COMPARISON_MESSAGE = (
    "a grid of points and a flight have nothing to match: compare two of a kind"
)
"""Error message that refuses to compare a grid with a flight."""


def compare(ours: xr.Dataset, other: xr.Dataset) -> xr.Dataset:
    """Return the differences, other minus ours, at the points that both studies have.

    Parameters
    ----------
    ours, other
        Datasets of `sweep.open`, or selections of them. Points are matched by the values of their
        coordinates, in any units. If a parameter is on an axis of only one study, that axis is
        reduced to the fixed value of the other study. An axis without this value stays.

    Returns
    -------
    xarray.Dataset
        Lazy dataset over the axes of `ours` and the remaining axes of `other`. It has the
        difference of every output under the name of the output. For each probability of detection
        it also has two variables. `pd_.._allowed` is the largest difference explained by the
        half-widths of draws and the errors of skipped effects and few beamlets. `pd_.._agrees` is
        true if the difference is no larger, and false if either study has no value.

    Raises
    ------
    ValueError
        The studies have no common point, or `other` is a flight.
    """
    if not isinstance(other, xr.Dataset):
        raise ValueError(GRID_FLIGHT_COMPARISON_MESSAGE)
    ours, other = (
        provenance.check_single_study(dataset, require_axes=True) for dataset in (ours, other)
    )
    variables = [n for n in {**GRID_OUTPUTS, **SPECTRA_STUDY_OUTPUTS} if n in ours and n in other]
    return compute_differences(ours, other, variables, bounded_variables=PD_OUTPUT_NAMES)


def compute_differences(
    ours: xr.Dataset,
    other: xr.Dataset,
    variables: Sequence[str],
    *,
    bounded_variables: Sequence[str],
) -> xr.Dataset:
    """Return a dataset of the differences of variables, other minus ours, at common points.

    For ``bounded_variables`` the result also has the largest allowed difference, `NAME_allowed`,
    and whether the difference is no larger, `NAME_agrees`.
    """
    matched_ours, matched_other = _restrict_to_common_points(ours, other)
    result = xr.Dataset(
        attrs={"ours": study_title_with_id(ours), "other": study_title_with_id(other)}
    )
    for name in variables:
        result[name] = (matched_other[name] - matched_ours[name]).assign_attrs(
            matched_ours[name].attrs,
            long_name=f"difference of {matched_ours[name].attrs.get('long_name', name)}",
        )
    for name in (name for name in bounded_variables if name in variables):
        allowed_difference = (
            _pd_error_bound(matched_ours, name)
            + _pd_error_bound(matched_other, name)
            + PD_ROUNDING_ERROR_MAX
        )
        result[f"{name}_allowed"] = allowed_difference.assign_attrs(
            units="1", long_name=f"largest difference of {name} within what is known of both"
        )
        result[f"{name}_agrees"] = (abs(result[name]) <= allowed_difference).assign_attrs(
            units="1", long_name=f"whether {name} agrees within what is known of both"
        )
    return result


def study_title_with_id(opened_store: xr.Dataset | xr.DataTree) -> str:
    """Return the title of a study, followed by the first eight digits of its id."""
    return (
        f"{opened_store.attrs.get('title', '')} ({str(opened_store.attrs.get('study_id', ''))[:8]})"
    )


def _pd_error_bound(dataset: xr.Dataset, name: str) -> xr.DataArray:
    """Return an upper bound of the error of the probability of detection in a variable.

    The bound is the sum of the half-width of random draws and the errors due to skipped effects and
    few beamlets. `name` is the name of the variable in the dataset.
    """
    error_bounds = [dataset[n] for n in (f"{name}_half_width", "effects_error", "beamlets_error")
             if n in dataset]  # fmt: skip
    return sum(
        (error_bound.fillna(0.0) for error_bound in error_bounds), xr.zeros_like(dataset[name])
    )


def _restrict_to_common_points(
    ours: xr.Dataset, other: xr.Dataset
) -> tuple[xr.Dataset, xr.Dataset]:
    """Return two datasets restricted to their common points, with equal coordinates."""
    other = _select_points_at_fixed_values(other, ours)
    ours = _select_points_at_fixed_values(ours, other)
    for dim in [d for d in ours.dims if d in other.dims]:
        our_index, other_index = (
            _pandas_index_of_dimension(ours, str(dim)),
            _pandas_index_of_dimension(other, str(dim)),
        )
        common_index = our_index.intersection(other_index, sort=False)
        if not common_index.size:
            raise ValueError(f"along {dim} the two studies have no value in common")
        ours = ours.isel({dim: our_index.get_indexer(common_index)})
        other = other.isel({dim: other_index.get_indexer(common_index)})
        # Both get the coordinates of ours, because xarray requires exact equality.
        other = other.drop_vars([n for n, c in other.coords.items() if dim in c.dims])
        other = other.assign_coords({n: c for n, c in ours.coords.items() if c.dims == (dim,)})
    scalar_names = [n for n, c in other.coords.items() if not c.dims]
    ours = ours.drop_vars([STUDY_ID_NAME, *study_marker_names(ours)], errors="ignore")
    return ours, other.drop_vars(scalar_names)


def _select_points_at_fixed_values(dataset: xr.Dataset, reference: xr.Dataset) -> xr.Dataset:
    """Return the points of a dataset at the parameter values that a reference dataset has fixed.

    An axis without the fixed value of its parameter is kept.
    """
    varying_paths = {c.attrs.get("path") for c in reference.coords.values() if c.dims}
    spec = spec_of_dataset(reference)
    for coord in list(dataset.coords.values()):
        path = coord.attrs.get("path", "")
        if not coord.dims or path in varying_paths or coord.name not in dataset.dims:
            continue
        fixed_value = parameter_in_si(reference, path, spec).values.item()
        values = coordinate_in_si(coord).values
        matches = (
            values == fixed_value
            if isinstance(fixed_value, str)
            else np.isclose(values, fixed_value, 1e-9, 0.0)
        )
        if matches.any():
            dataset = dataset.isel({coord.name: int(np.argmax(matches))})
    return dataset


def _pandas_index_of_dimension(dataset: xr.Dataset, dim: str) -> pandas.Index:
    """Return a pandas index of the coordinate values along a dimension, for matching.

    Values are in SI, rounded to 12 significant digits. Several coordinates make a multi-index.
    """
    coords = [c for c in dataset.coords.values() if c.dims == (dim,)]
    if not coords:
        return pandas.RangeIndex(dataset.sizes[dim])
    columns = [_round_to_12_digits(np.asarray(coordinate_in_si(c).values)) for c in
               sorted(coords, key=lambda c: str(c.attrs.get("path", c.name)))]  # fmt: skip
    index = columns[0] if len(columns) == 1 else pandas.MultiIndex.from_arrays(columns)
    index = pandas.Index(index)
    if index.has_duplicates:
        # A counter distinguishes repeated points of a zipped axis, so that the n-th one is matched
        # with the n-th one of the other study.
        index_frame = index.to_frame(index=False)
        index_frame["again"] = index_frame.groupby(list(index_frame.columns)).cumcount()
        index = pandas.MultiIndex.from_frame(index_frame)
    return index


def _round_to_12_digits(values: np.ndarray) -> np.ndarray:
    """Return numbers rounded to 12 significant digits; arrays of other types are unchanged."""
    if values.dtype.kind not in "fiu":
        return values
    values = values.astype(float)
    with np.errstate(divide="ignore"):
        scale = 10.0 ** (
            _MATCHED_SIGNIFICANT_DIGITS
            - 1
            - np.floor(np.log10(np.abs(np.where(values, values, 1.0))))
        )
    return np.rint(values * scale) / scale


SHOT_TIME_TOLERANCE = 1e-9
"""Largest time difference of matching shots of a beam [s]."""

SHOT_POSITION_TOLERANCE = 1e-6
"""Largest distance between the platform positions of matching shots [m]."""

BEAM_DIRECTION_TOLERANCE = 1e-9
"""Largest angle between the beam directions of matching shots [rad]."""

DETECTED_FRACTION_VARIABLE = "detected"
"""Name of the variable with the share, 0..1, of draws in which a shot has a true point."""

ERROR_BOUND_VARIABLES = ("effects_error", "beamlets_error")
"""Names of the variables with bounds on the errors of a shot's probabilities."""

COMPARED_SHOT_STATISTICS = tuple(
    name
    for name, output in SHOT_STATISTIC_VARIABLES.items()
    if output.dtype == "float64" and name not in ERROR_BOUND_VARIABLES
)
"""Names of the variables of a shot that a comparison of flights includes."""


def compare_flights(ours: xr.DataTree, other: xr.DataTree) -> xr.DataTree:
    """Return the differences, other minus ours, at the shots that both flights have.

    Parameters
    ----------
    ours, other
        Trees of `sweep.open_scene`. Scanners are matched by name. Shots are matched by time, beam,
        position and direction of the beam, to :data:`SHOT_TIME_TOLERANCE`,
        :data:`SHOT_POSITION_TOLERANCE` and :data:`BEAM_DIRECTION_TOLERANCE`. Positions along axes
        are matched as in :func:`compare`.

    Returns
    -------
    xarray.DataTree
        Tree with a group for each common scanner, over the axes and `shot`. A group has the
        differences of the probabilities and SNRs of a shot. If both stores are complete, a group
        also has the difference of `detected`, the share of draws in which the shot has a true
        point. Probabilities of detection and `detected` also have `.._allowed` and `.._agrees`, as
        in :func:`compare`. The intervals of `detected` are Clopper-Pearson intervals with the
        confidence of each study. The attributes `shots` and `other_shots` are the numbers of shots
        of both flights.

    Raises
    ------
    ValueError
        The flights have no common scanner, or no common shot of a scanner; or `other` is a grid.
    """
    if not isinstance(other, xr.DataTree):
        raise ValueError(GRID_FLIGHT_COMPARISON_MESSAGE)
    scanners = [name for name in scanner_names(ours) if name in scanner_names(other)]
    if not scanners:
        scanner_lists = (", ".join(scanner_names(tree)) for tree in (ours, other))
        raise ValueError("the flights have no scanner in common: {}; and {}".format(*scanner_lists))
    group_by_scanner = {name: _compare_scanner(ours, other, name) for name in scanners}
    root = xr.Dataset(
        attrs={"ours": study_title_with_id(ours), "other": study_title_with_id(other)}
    )
    return xr.DataTree.from_dict({"/": root, **group_by_scanner})


def scanner_names(tree: xr.DataTree) -> list[str]:
    """Return the names of the scanners of a flight's tree.

    The attribute may be a string, because netCDF stores a list of one name as a string.
    """
    names = tree.attrs["scanners"]
    return [names] if isinstance(names, str) else [str(name) for name in names]


def _compare_scanner(ours: xr.DataTree, other: xr.DataTree, scanner: str) -> xr.Dataset:
    """Return a dataset of the differences, other minus ours, at the common shots of a scanner."""
    our_group, other_group = (
        provenance.check_single_study(
            tree.children[scanner].to_dataset(inherit=False).assign_attrs(tree.attrs),
            require_axes=True,
        )
        for tree in (ours, other)
    )
    our_shots, matching_shots = _common_shot_indices(our_group, other_group, scanner)
    shot_coords = {
        name: our_group[name].isel(shot=our_shots).compute() for name in ("time", "beam")
    }
    # Only the number of committed points shows that all draws are computed: a draw that is not
    # computed looks like one without a point.
    all_drawn = all(t.attrs["points_committed"] >= t.attrs["points"] for t in (ours, other))
    quantities_of_both = [
        _select_compared_variables(group.isel(shot=index), tree, all_drawn=all_drawn)
        for group, tree, index in (
            (our_group, ours, our_shots),
            (other_group, other, matching_shots),
        )
    ]
    variables = [
        name
        for name in (*COMPARED_SHOT_STATISTICS, DETECTED_FRACTION_VARIABLE)
        if all(name in quantities for quantities in quantities_of_both)
    ]
    result = compute_differences(
        quantities_of_both[0],
        quantities_of_both[1],
        variables,
        bounded_variables=(*PD_OUTPUT_NAMES, DETECTED_FRACTION_VARIABLE),
    )
    return result.assign_coords(shot_coords).assign_attrs(
        ours=study_title_with_id(ours), other=study_title_with_id(other), scanner=scanner,
        shots=our_group.sizes["shot"], other_shots=other_group.sizes["shot"],
    )  # fmt: skip


def _common_shot_indices(
    ours: xr.Dataset, other: xr.Dataset, scanner: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the shots that two flights have in common.

    Returns
    -------
    tuple of numpy.ndarray
        Index of each common shot in `ours`, rising, and in `other`. Both arrays are empty if a
        flight has no computed shots.
    """
    our_frame, other_frame = _computed_shot_table(ours), _computed_shot_table(other)
    if our_frame.empty or other_frame.empty:
        return np.empty(0, int), np.empty(0, int)
    merged = pandas.merge_asof(
        our_frame,
        other_frame,
        on="time",
        by="beam",
        direction="nearest",
        tolerance=SHOT_TIME_TOLERANCE,
    ).dropna()
    if merged.empty:
        raise ValueError(
            f"scanner {scanner}: no shot of one flight is at the time of one of the other"
        )
    our_shots, matching_shots = merged["number_x"].to_numpy(int), merged["number_y"].to_numpy(int)
    distance, chord = (
        np.linalg.norm(ours[name].values[our_shots] - other[name].values[matching_shots], axis=1)
        for name in ("platform_position", "beam_direction")
    )
    angle = 2 * np.arcsin(np.minimum(chord / 2, 1.0))
    is_match = (distance <= SHOT_POSITION_TOLERANCE) & (angle <= BEAM_DIRECTION_TOLERANCE)
    if not is_match.any():
        raise ValueError(
            f"scanner {scanner}: the flights look from other places, or elsewhere: at one time "
            f"they are {distance.min():.3g} m apart at the least, their beams "
            f"{np.degrees(angle.min()):.3g} deg; compare flights of one path, attitude and scanner"
        )
    order = np.argsort(our_shots[is_match])
    return our_shots[is_match][order], matching_shots[is_match][order]


def _computed_shot_table(group: xr.Dataset) -> pandas.DataFrame:
    """Return a table with the time [s], beam and number of every computed shot, sorted by time."""
    frame = pandas.DataFrame({name: group[name].values for name in ("time", "beam")})
    return frame.assign(number=frame.index).dropna().sort_values("time")


def _select_compared_variables(
    group: xr.Dataset, tree: xr.DataTree, *, all_drawn: bool
) -> xr.Dataset:
    """Return the variables of a scanner's group that a comparison of flights needs, as a dataset.

    ``all_drawn`` is true if all draws are computed. The variables include `detected` and its
    half-width only in this case.
    """
    variables = [
        name for name in (*COMPARED_SHOT_STATISTICS, *ERROR_BOUND_VARIABLES) if name in group
    ]
    quantities = group[variables].assign_attrs(tree.attrs)
    if not all_drawn:
        return quantities
    confidence, draws = spec_of_dataset(quantities).accuracy.confidence, group.sizes["draw"]
    detections = ((group["flags"] & TRUE_RETURN_FLAG) > 0).any("return_number").sum("draw")

    def half_width(successes: np.ndarray) -> np.ndarray:
        interval = clopper_pearson_interval(
            successes=successes, trials=draws, confidence=confidence
        )
        return interval_half_width(successes / draws, interval)

    half_widths = xr.apply_ufunc(half_width, detections, dask="parallelized", output_dtypes=[float])
    is_computed = quantities["pd_shot"].notnull()
    detected_fraction = (detections / draws).where(is_computed)
    detected_fraction.attrs = {
        "units": "1",
        "long_name": "share of draws in which the shot has a true point",
    }
    return quantities.assign(
        {
            DETECTED_FRACTION_VARIABLE: detected_fraction,
            f"{DETECTED_FRACTION_VARIABLE}_half_width": half_widths.where(is_computed),
        }
    )


DIFFERENCE_TABLE_COLUMNS = ("quantity", "differ", "median", "largest", "agree", "largest at")
"""Column names of the table of differences between two stores."""

OpenedStore = xr.Dataset | xr.DataTree
"""Dataset of a grid, or tree of a flight, as `sweep.open` and `sweep.open_scene` return them."""

DIFFERENCE_TABLE_VARIABLES = (
    *PD_OUTPUT_NAMES, "log10_pfa_bin", "log10_pfa_segment", "log10_pfa_both_chirps",
    "log10_pfa_shot", "p_leakage_up", "p_leakage_down", "snr_up", "snr_doppler", "snr_down",
    "noise_variance", "range_error", "radial_velocity_error", "false_alarms", "range_rmse",
    "radial_velocity_rmse", "pfa_up", "pfa_down", DETECTED_FRACTION_VARIABLE,
)  # fmt: skip
"""Names of the variables in the table of differences, in the order of its rows."""


def compute_tabulated_differences(ours: OpenedStore, other: OpenedStore) -> dict[str, xr.Dataset]:
    """Compute the differences, other minus ours, that the table of a comparison shows.

    The result has a dataset in memory for each scanner, by the scanner's name. For grids it is a
    single dataset under the name ''.
    """
    result = ours.sweep.compare(other)
    is_grid = isinstance(result, xr.Dataset)
    groups = (
        {"": result} if is_grid else {n: group.to_dataset() for n, group in result.children.items()}
    )
    tabulated = {
        f"{name}{suffix}"
        for name in DIFFERENCE_TABLE_VARIABLES
        for suffix in ("", "_allowed", "_agrees")
    }
    return {
        n: group_differences[[v for v in group_differences if v in tabulated]].compute()
        for n, group_differences in groups.items()
    }


def difference_table_rows(differences: xr.Dataset) -> list[list[str]]:
    """Return a row for each tabulated variable that has values, in `DIFFERENCE_TABLE_COLUMNS`."""
    return [
        _difference_table_row(differences, name)
        for name in DIFFERENCE_TABLE_VARIABLES
        if name in differences and differences[name].notnull().any()
    ]


def _difference_table_row(differences: xr.Dataset, name: str) -> list[str]:
    """Return the row of a variable in the table of differences, in `DIFFERENCE_TABLE_COLUMNS`."""
    array = differences[name]
    is_finite = np.isfinite(array.values)
    abs_difference = np.where(is_finite, np.abs(array.values), -1.0)
    worst_index = np.unravel_index(int(np.argmax(abs_difference)), abs_difference.shape)
    agreement_text = "-"
    if f"{name}_agrees" in differences:
        agreeing_fraction = (
            differences[f"{name}_agrees"].values & is_finite
        ).sum() / is_finite.sum()
        # Rounded down, so that 100 % means all points.
        agreement_text = f"{np.floor(1e4 * agreeing_fraction) / 100:g} %"
    n_different = int((abs_difference > 0).sum())
    return [
        labels.axis_label(name, str(array.attrs.get("units", ""))),
        f"{n_different:,}",
        f"{np.median(abs_difference[is_finite]):.2g}",
        f"{array.values[worst_index]:+.3g}" if n_different else "0",
        agreement_text,
        _describe_point(array, worst_index) if n_different else "-",
    ]


def _describe_point(array: xr.DataArray, index: tuple[np.intp, ...]) -> str:
    """Return a text with the coordinates of the point at a given index of an array."""
    point = array.isel(dict(zip(array.dims, map(int, index), strict=True)))
    return ", ".join(_describe_coordinate(c) for c in point.coords.values())


def _describe_coordinate(coordinate: xr.DataArray) -> str:
    """Return a text with the value of a scalar coordinate, after its name if it has no unit."""
    units = str(coordinate.attrs.get("units", ""))
    value = labels.format_quantity(coordinate.values.item(), units)
    return (
        value
        if units not in ("", "1")
        else f"{labels.coordinate_label(str(coordinate.name))} {value}"
    )


def describe_common_shots(differences: xr.Dataset) -> str:
    """Return a text with the number of shots common to two flights, and that of each flight."""
    n_common, n_ours, n_other = (
        differences.sizes["shot"],
        differences.attrs["shots"],
        differences.attrs["other_shots"],
    )
    if n_common == n_ours == n_other:
        return f"all {labels.number_with_noun(n_common, 'shot')}"
    return (
        f"{labels.number_with_noun(n_common, 'shot')} that both have, of {n_ours:,} and {n_other:,}"
    )


class AgreementVerdict(NamedTuple):
    """Verdict on whether the probabilities of detection of two stores agree."""

    verdict: Literal["same", "different", "nothing"]
    """Verdict: ``same``, ``different`` or ``nothing``.

    It is ``same`` if the probabilities agree at all common points, ``different`` if they differ at
    any, and ``nothing`` if no common point is computed.
    """
    sentence: str
    """Verdict as a sentence for the user."""


def agreement_verdict(compared_groups: Iterable[xr.Dataset]) -> AgreementVerdict:
    """Return the verdict on whether the probabilities of detection of two stores agree.

    It is ``same``, ``different`` or, if no common point is computed, ``nothing``.
    ``compared_groups`` are datasets of differences, as of :func:`compute_tabulated_differences`.
    """
    n_points, n_different, noun, count_note = 0, 0, "point", ""
    for differences in compared_groups:
        if "shot" in differences.dims:
            has_other_axes = any(n > 1 for dim, n in differences.sizes.items() if dim != "shot")
            noun, count_note = "shot", ", counted at each place along the axes" * has_other_axes
        pairs = [
            (differences[n], differences[f"{n}_agrees"])
            for n in PD_OUTPUT_NAMES
            if n in differences
        ]
        n_points += max((int(array.notnull().sum()) for array, _ in pairs), default=0)
        n_different += max(
            (int((array.notnull() & ~agrees).sum()) for array, agrees in pairs), default=0
        )
    if not n_points:
        return AgreementVerdict("nothing", "Nothing that both stores have is computed yet.")
    if not n_different:
        phrase = f"agree at {labels.number_with_noun(n_points, noun)}"
        return AgreementVerdict("same", f"Probabilities of detection {phrase}{count_note}.")
    phrase = f"differ at {n_different:,} of {labels.number_with_noun(n_points, noun)}"
    return AgreementVerdict("different", f"Probabilities of detection {phrase}{count_note}.")


PLOTTED_DIFFERENCE_MIN = 1e-16
"""Smallest difference of pd on the axis of the figure; smaller differences are drawn there."""


def save_difference_figure(
    differences_by_scanner: Mapping[str, xr.Dataset], file_path: Path
) -> Path:
    """Save a figure of the differences of pd; return the path of the picture.

    The figure shows the share of points whose pd differs by more than d, over d. Each scanner has
    its own colour. ``differences_by_scanner`` is the result of
    :func:`compute_tabulated_differences`.
    """
    from sweep.analysis import canvas

    with canvas.uniform_style():
        chart = pd_difference_chart(differences_by_scanner)
        if chart is None:
            return canvas.save_sheet(
                canvas.message_sheet("Nothing that both stores have is computed yet"), file_path
            )
        return canvas.save_sheet(canvas.draw_chart(chart, chart.heading, ""), file_path)


def pd_difference_chart(differences_by_scanner: Mapping[str, xr.Dataset]) -> Chart | None:
    """Return the chart of the differences of pd; None if no common point is computed."""
    compared_groups = list(differences_by_scanner.values())
    variables = [
        n
        for n in PD_OUTPUT_NAMES
        if any(n in part and part[n].notnull().any() for part in compared_groups)
    ]
    if not variables:
        return None
    noun = "shot" if any("shot" in part.dims for part in compared_groups) else "point"
    n_common = sum(int(part[variables[0]].notnull().sum()) for part in compared_groups)
    y_axis = ChartAxis(f"share of {noun}s beyond (%)", limits=(-3, 103))
    x_axis = ChartAxis("difference of pd, either way", LOG_SCALE, (PLOTTED_DIFFERENCE_MIN, 1.0))
    return Chart(
        f"{compared_groups[0].attrs['other']}\nless {compared_groups[0].attrs['ours']}",
        f"Shares of {noun}s that differ by more than some amount, of {', '.join(variables)}.",
        [f"{n_common:,} {noun}s that both studies have"],
        [
            Panel({"probability": name}, x_axis, y_axis, [
                line for i, (scanner, part) in enumerate(differences_by_scanner.items())
                for line in _exceedance_lines(part, name, scanner, i)
            ])
            for name in variables
        ],
        panels_per_row=[2] * (len(variables) // 2) + [1] * (len(variables) % 2),
    )  # fmt: skip


def _exceedance_lines(
    differences: xr.Dataset, name: str, scanner: str, style_index: int
) -> list[ChartLine]:
    """Return two lines of shares of points [%] over a difference d of pd; [] without values.

    The first is the share of points whose difference exceeds d. The second is the share of points
    whose allowed difference exceeds d.
    """
    is_finite = np.isfinite(differences[name].values)
    lines = []
    for values, label_suffix, style in (
        (np.abs(differences[name].values), "found", "line"),
        (differences[f"{name}_allowed"].values, "allowed", "stated"),
    ):
        sorted_values = np.sort(
            np.maximum(np.broadcast_to(values, is_finite.shape)[is_finite], PLOTTED_DIFFERENCE_MIN)
        )
        percent_beyond = 100 * (1 - np.arange(sorted_values.size + 1) / max(sorted_values.size, 1))
        x = np.repeat([PLOTTED_DIFFERENCE_MIN, *sorted_values, 1.0], 2)[1:-1]
        y = np.repeat(percent_beyond, 2)
        lines.append(ChartLine(x, y, f"{scanner} {label_suffix}".strip(), style_index, style=style))
    return lines if is_finite.any() else []
