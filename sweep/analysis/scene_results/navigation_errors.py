"""Navigation errors over altitude: availability, bias and RMS error; their chart and table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import dask
import numpy as np
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.charts import LINEAR_SCALE, LOG_SCALE, Chart, ChartAxis, ChartLine, Panel
from sweep.analysis.datasets import chunk_aligned_slices, stored_chunk_length
from sweep.analysis.scene_results.recordings import Recording
from sweep.analysis.tables import TableCell, TablePage, TextTable
from sweep.model.pointcloud.navigation import STATUS_EXCLUDED, STATUS_SOLVED

VELOCITY_QUANTITY, ALTITUDE_QUANTITY = "velocity", "altitude"
"""Names of the quantities that navigation solves for."""

SOLUTIONS_PER_READ = 65_536
"""Approximate number of navigation solutions that are read from a store at once."""


@dataclass(frozen=True, eq=False)
class ErrorTally:
    """Error statistics of navigation solutions, by altitude bin. A solution has m components.

    The sum of two tallies is the tally of all their solutions.
    """

    n_attempts: np.ndarray
    """Number of attempts to compute a navigation solution, in each altitude bin (bins,)."""
    n_solutions: np.ndarray
    """Number of attempts that gave a navigation solution, in each altitude bin (bins,)."""
    mean_error: np.ndarray
    """Mean error of the solutions (bins, m), by altitude bin and component."""
    sum_of_squared_deviations: np.ndarray
    """Sum of squared deviations of errors from their mean (bins, m), by bin and component."""
    mean_stated_variance: np.ndarray
    """Mean of the error variances that solutions state (bins, m), by altitude bin and component."""

    def __add__(self, other: ErrorTally) -> ErrorTally:
        """Return the tally of both, by the method of Chan, Golub and LeVeque (1983).

        It never subtracts large sums.
        """
        n_solutions = self.n_solutions + other.n_solutions
        other_fraction = (other.n_solutions / np.maximum(n_solutions, 1))[..., None]
        mean_difference = other.mean_error - self.mean_error
        between_squares = (
            self.n_solutions[..., None] * other_fraction * mean_difference * mean_difference
        )
        return ErrorTally(
            self.n_attempts + other.n_attempts,
            n_solutions,
            self.mean_error + other_fraction * mean_difference,
            self.sum_of_squared_deviations + other.sum_of_squared_deviations + between_squares,
            self.mean_stated_variance
            + other_fraction * (other.mean_stated_variance - self.mean_stated_variance),
        )

    @property
    def availability(self) -> np.ndarray:
        """Share of attempts that gave a solution (bins,), 0..1, by bin; nan without attempts."""
        return _quotient_or_nan(self.n_solutions, self.n_attempts)

    @property
    def bias(self) -> np.ndarray:
        """Mean error (bins, m), by altitude bin and component; nan without solutions."""
        return np.where(self.n_solutions[..., None] > 0, self.mean_error, np.nan)

    @property
    def rmse(self) -> np.ndarray:
        """RMS error including the bias (bins, m), by bin and component; nan without solutions."""
        return np.sqrt(
            _quotient_or_nan(self.sum_of_squared_deviations, self.n_solutions[..., None])
            + self.mean_error**2
        )

    @property
    def variance(self) -> np.ndarray:
        """Unbiased variance of each component's errors (bins, m); nan below two solutions."""
        return _quotient_or_nan(self.sum_of_squared_deviations, self.n_solutions[..., None] - 1)

    @property
    def stated_variance(self) -> np.ndarray:
        """Mean of the error variances that solutions state (bins, m); nan without solutions."""
        return np.where(self.n_solutions[..., None] > 0, self.mean_stated_variance, np.nan)


@dataclass(frozen=True)
class ErrorCurve:
    """Errors of the velocity or altitude that a scanner's navigation gives, over true altitude."""

    scanner: str
    """Name of the scanner, or label of its recording."""
    quantity: str
    """Name of the quantity: ``velocity`` or ``altitude``."""
    altitude_edges: np.ndarray
    """Edges of the altitude bins (bins + 1,) [m]."""
    tally: ErrorTally
    """Error statistics in each altitude bin."""

    @property
    def label(self) -> str:
        """Display name of the scanner; 'measured' for a recording without a name."""
        return labels.coordinate_label(self.scanner) or "measured"

    @property
    def bin_centres(self) -> np.ndarray:
        """Altitudes at the centres of the bins (bins,) [m]."""
        return (self.altitude_edges[1:] + self.altitude_edges[:-1]) / 2

    @property
    def bias_standard_error(self) -> np.ndarray:
        """Standard error of each component's bias (bins, m); nan with fewer than two solutions."""
        return np.sqrt(self.tally.variance / np.maximum(self.tally.n_solutions, 1)[:, None])

    @property
    def rmse(self) -> np.ndarray:
        """RMS error of each component, and for velocity that of the vector as the last column.

        The shape is (bins, 1) for altitude and (bins, 4) for velocity.
        """
        return _append_vector_length(self.tally.rmse)

    @property
    def stated_deviation(self) -> np.ndarray:
        """Root of the mean error variance that solutions state, by component.

        For velocity the last column is that of the vector. The shape is (bins, 1) for altitude and
        (bins, 4) for velocity.
        """
        return _append_vector_length(np.sqrt(self.tally.stated_variance))


def _append_vector_length(components: np.ndarray) -> np.ndarray:
    """Return vectors (..., m) with their lengths as an additional component, (..., m + 1).

    Vectors with a single component are returned unchanged.
    """
    if components.shape[-1] == 1:
        return components
    return np.concatenate([components, np.linalg.norm(components, axis=-1, keepdims=True)], axis=-1)


def navigation_error_curves(
    named_recordings: Sequence[tuple[str, Recording]], *, quantity: str, n_bins: int
) -> list[ErrorCurve]:
    """Return the error curves of scanners that navigate, all with the same altitude bins.

    Parameters
    ----------
    named_recordings
        Recordings with their names. Scanners without navigation are skipped.
    quantity
        ``velocity`` or ``altitude``.
    n_bins
        Number of bins between the lowest and the highest true altitude of all scanners.
    """
    navigating = [
        (name, recording.dataset)
        for name, recording in named_recordings
        if "velocity_status" in recording.dataset
    ]
    altitude_edges = _altitude_bin_edges([dataset for _, dataset in navigating], n_bins)
    if altitude_edges is None:
        return []
    return [
        ErrorCurve(
            name,
            quantity,
            altitude_edges,
            merge_tallies(list(_iter_error_tallies(dataset, quantity, altitude_edges))),
        )
        for name, dataset in navigating
    ]


def _altitude_bin_edges(datasets: Sequence[xr.Dataset], n_bins: int) -> np.ndarray | None:
    """Return the edges of equal altitude bins [m] that contain the true altitudes of all datasets.

    The result is None if no altitude is known.
    """
    altitudes = [dataset["true_altitude"].chunk(cycle=SOLUTIONS_PER_READ) for dataset in datasets]
    extremes = dask.compute([altitude.min() for altitude in altitudes],
                        [altitude.max() for altitude in altitudes])  # fmt: skip
    if not np.isfinite(extremes).any():
        return None
    low, high = float(np.nanmin(extremes[0])), float(np.nanmax(extremes[1]))
    if high - low < 1e-6 * max(abs(high), 1.0):
        low, high, n_bins = low - 0.5, high + 0.5, 1
    edges = np.linspace(low, high, n_bins + 1)
    edges[-1] = np.nextafter(high, np.inf)  # so that the last bin contains the highest cycle
    return edges


def _iter_error_tallies(
    dataset: xr.Dataset, quantity: str, altitude_edges: np.ndarray
) -> Iterator[ErrorTally]:
    """Yield an error tally for each of consecutive parts of a scanner's navigation solutions."""
    status = dataset[f"{quantity}_status"]
    draws_per_chunk = stored_chunk_length(status, "draw")
    draw_slices = chunk_aligned_slices(status, "draw", draws_per_chunk)
    cycle_slices = chunk_aligned_slices(
        status, "cycle", max(1, SOLUTIONS_PER_READ // draws_per_chunk)
    )
    for cycle_slice, draw_slice in product(cycle_slices, draw_slices):
        part = dataset.isel(cycle=cycle_slice, draw=draw_slice)
        status_values, solution = part[f"{quantity}_status"].values, part[quantity].values
        altitude = np.broadcast_to(part["true_altitude"].values[:, None], status_values.shape)
        altitude_bin = np.digitize(np.nan_to_num(altitude.ravel(), nan=-np.inf), altitude_edges) - 1
        altitude_bin = np.where(status_values.ravel() >= STATUS_SOLVED, altitude_bin, -1)
        if quantity == ALTITUDE_QUANTITY:
            variance = part["altitude_variance"].values
        else:
            variance = np.diagonal(part["velocity_covariance"].values, axis1=-2, axis2=-1)
        error = solution - part[f"true_{quantity}"].values[:, None]
        component_shape = -1, len(COMPONENT_NAMES_BY_QUANTITY[quantity])
        yield tally_errors(
            error.reshape(component_shape),
            variance.reshape(component_shape),
            (status_values.ravel() >= STATUS_SOLVED) & (status_values.ravel() <= STATUS_EXCLUDED),
            altitude_bin,
            altitude_edges.size - 1,
        )


def tally_errors(
    error: np.ndarray,
    variance: np.ndarray,
    is_available: np.ndarray,
    altitude_bin: np.ndarray,
    n_bins: int,
) -> ErrorTally:
    """Return the error tally of n attempts at a solution, by altitude bin.

    Sums are computed in two passes for accuracy.

    Parameters
    ----------
    error
        Errors of the m components, (n, m).
    variance
        Variances that the solutions state, (n, m).
    is_available
        Mask of the attempts that gave a solution, (n,).
    altitude_bin
        Index of each attempt's altitude bin, (n,). Attempts with an index outside 0 to ``n_bins`` -
        1 do not count.
    n_bins
        Number of bins.
    """
    is_in_range = (altitude_bin >= 0) & (altitude_bin < n_bins)
    n_attempts = np.bincount(altitude_bin[is_in_range], minlength=n_bins)
    is_counted = is_in_range & is_available
    error, variance, altitude_bin = (
        error[is_counted],
        variance[is_counted],
        altitude_bin[is_counted],
    )
    n_solutions = np.bincount(altitude_bin, minlength=n_bins)
    divisor = np.maximum(n_solutions, 1)[:, None]
    mean_error = _sum_by_bin(error, altitude_bin, n_bins) / divisor
    residual = error - mean_error[altitude_bin]
    mean_correction = (
        _sum_by_bin(residual, altitude_bin, n_bins) / divisor
    )  # rounding error of the mean
    sum_of_squared_deviations = _sum_by_bin(residual * residual, altitude_bin, n_bins)
    mean_stated_variance = _sum_by_bin(variance, altitude_bin, n_bins) / divisor
    return ErrorTally(
        n_attempts,
        n_solutions,
        mean_error + mean_correction,
        sum_of_squared_deviations,
        mean_stated_variance,
    )


def merge_tallies(tallies: Sequence[ErrorTally]) -> ErrorTally:
    """Return the sum of tallies as one tally.

    Tallies are added in pairs in a fixed order, so that rounding is always the same.
    """
    if not tallies:
        raise ValueError("there is no tally to merge")
    remaining_tallies = list(tallies)
    while len(remaining_tallies) > 1:
        pair_sums = [
            a + b for a, b in zip(remaining_tallies[::2], remaining_tallies[1::2], strict=False)
        ]
        remaining_tallies = pair_sums + remaining_tallies[2 * len(pair_sums) :]
    return remaining_tallies[0]


def _sum_by_bin(values: np.ndarray, bin_index: np.ndarray, n_bins: int) -> np.ndarray:
    """Return the sums (n_bins, m) of the rows of `values` (n, m) that fall in each bin.

    `bin_index` (n,) is the bin of each row.
    """
    return np.stack([np.bincount(bin_index, column, n_bins) for column in values.T], axis=-1)


def _quotient_or_nan(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Return a total divided by a count; nan where the count is not positive."""
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


AVAILABILITY, BIAS, RMSE = "availability", "bias", "rmse"
"""Names of the statistics: share of attempts that gave a solution, mean error, and RMS error."""
COMPONENT_NAMES_BY_QUANTITY = {VELOCITY_QUANTITY: ("x", "y", "z"), ALTITUDE_QUANTITY: ("",)}
"""Names of the components of each quantity; the only component of altitude has the name ''."""

UNIT_BY_QUANTITY = {VELOCITY_QUANTITY: "m/s", ALTITUDE_QUANTITY: "m"}
"""Units of the errors of each quantity."""
VECTOR_LENGTH_LABEL = "vector"
"""Label for the error of a complete vector, the length of the error vector."""

ComponentStatistic = tuple[str, int]
"""Name of a statistic, and index of a component of the quantity.

The index that follows the last component stands for the length of the vector.
"""


def navigation_error_chart(curves: Sequence[ErrorCurve], show: str) -> Chart:
    """Return a chart of navigation errors over altitude, with a panel for each statistic.

    Each panel has a line for each curve. ``show`` names the statistic: ``availability``, ``bias``,
    ``rmse``, or ``all``.
    """
    panels, panels_per_row = [], []
    for quantity in dict.fromkeys(curve.quantity for curve in curves):
        quantity_curves = [curve for curve in curves if curve.quantity == quantity]
        panel_rows = _statistics_of_panel_rows(quantity, show)
        panels_per_row += [len(row) for row in panel_rows]
        panels += [
            _statistic_panel(quantity_curves, quantity, *statistic)
            for row in panel_rows
            for statistic in row
        ]
    titles = [panel.title for panel in panels]
    caption = [f"{curves[0].altitude_edges.size - 1} bins of altitude, over all draws"]
    if any("bias" in title for title in titles):
        caption[0] += "; bars: standard error of the bias"
    if any("error" in title for title in titles):
        caption.append("as stated: root of the mean variance that solutions give for themselves")
    return Chart(
        "Navigation", f"Lines of navigation's errors over altitude: {', '.join(titles)}.", caption,
        panels, {"statistic": "Shown"}, panels_per_row=panels_per_row,
    )  # fmt: skip


def _statistics_of_panel_rows(quantity: str, show: str) -> list[list[ComponentStatistic]]:
    """Return the statistics that panels show, as a list for each row of panels.

    Availability and the error of the complete vector precede the components.
    """
    n_components = len(COMPONENT_NAMES_BY_QUANTITY[quantity])
    component_indices = list(range(n_components))
    if n_components == 1:
        statistics = [AVAILABILITY, BIAS, RMSE] if show == "all" else [show]
        return [[(statistic, 0) for statistic in statistics]]
    if show == "all":
        first_row = [(AVAILABILITY, 0), (RMSE, n_components)]
        return [
            first_row,
            [(BIAS, i) for i in component_indices],
            [(RMSE, i) for i in component_indices],
        ]
    if show == RMSE:
        return [[(RMSE, n_components), (RMSE, 0)], [(RMSE, i) for i in component_indices[1:]]]
    return [[(show, i) for i in (component_indices if show == BIAS else [0])]]


def _statistic_panel(
    curves: Sequence[ErrorCurve], quantity: str, statistic: str, component_index: int
) -> Panel:
    """Return the panel of one statistic of a component over altitude, with a line per curve."""
    component_names = COMPONENT_NAMES_BY_QUANTITY[quantity]
    component = (
        component_names[component_index]
        if component_index < len(component_names)
        else VECTOR_LENGTH_LABEL
    )
    phrase = f"of the {quantity}" + (f", {component}" if len(component_names) > 1 else "")
    units, altitudes = UNIT_BY_QUANTITY[quantity], curves[0].bin_centres
    lines: list[ChartLine] = []
    if statistic == AVAILABILITY:
        title, y_axis = f"{quantity} available", ChartAxis("share of cycles (%)", limits=(-4, 104))
        lines += [ChartLine(altitudes, 100 * curve.tally.availability, curve.label, k)
                  for k, curve in enumerate(curves)]  # fmt: skip
    elif statistic == BIAS:
        title, y_axis = f"bias {phrase}", ChartAxis(f"bias ({units})")
        lines.append(ChartLine(altitudes[[0, -1]], np.zeros(2), style="level"))
        for k, curve in enumerate(curves):
            bias, error = (
                curve.tally.bias[:, component_index],
                curve.bias_standard_error[:, component_index],
            )
            lines.append(
                ChartLine(altitudes, bias, curve.label, k, low=bias - error, high=bias + error,
                     style="bars")
            )  # fmt: skip
    else:
        values = np.concatenate(
            [c[:, component_index] for k in curves for c in (k.rmse, k.stated_deviation)]
        )
        positive_values = values[np.isfinite(values) & (values > 0)]
        is_wide = positive_values.size > 0 and positive_values.max() > 4 * positive_values.min()
        title = f"RMS error {phrase}"
        y_axis = ChartAxis(
            f"error ({units})",
            LOG_SCALE if is_wide else LINEAR_SCALE,
            None if is_wide else (0.0, None),
        )
        for k, curve in enumerate(curves):
            lines.append(ChartLine(altitudes, curve.rmse[:, component_index], curve.label, k))
            stated_name = f"{curve.label}, as stated"
            lines.append(
                ChartLine(
                    altitudes,
                    curve.stated_deviation[:, component_index],
                    stated_name,
                    k,
                    style="stated",
                )
            )
    if statistic != AVAILABILITY and not any(curve.tally.n_solutions.any() for curve in curves):
        title += ": no solution"
    return Panel({"statistic": title}, ChartAxis("altitude above ground (m)"), y_axis, lines)


def navigation_error_page(
    curves: Sequence[ErrorCurve], *, show: str, title: str, remarks: Sequence[str]
) -> TablePage:
    """Return a page of navigation errors with a table for each curve, and a row per altitude bin.

    ``show`` names the statistic: ``availability``, ``bias``, ``rmse``, or ``all``.
    """
    statistics = (AVAILABILITY, BIAS, RMSE) if show == "all" else (show,)
    page_tables, records = [], []
    for curve in curves:
        curve_records = [
            _altitude_bin_record(curve, i, statistics) for i in range(curve.altitude_edges.size - 1)
        ]
        columns = [name for name in curve_records[0] if name != "scanner"]
        rows = [[record[name] for name in columns] for record in curve_records]
        page_tables.append(TextTable(f"{curve.label}: {curve.quantity}", columns, rows))
        records += curve_records
    units = ", ".join(dict.fromkeys(UNIT_BY_QUANTITY[curve.quantity] for curve in curves))
    notes = [
        "from, to: true altitude above ground [m]; cycles: measurement cycles times draws.",
        f"bias, rmse, stated: in {units}; stated: root of the mean variance that",
        "  solutions give for themselves; error of bias: its standard error.",
        *remarks,
    ]
    return TablePage(title, page_tables, notes, records)


def _altitude_bin_record(
    curve: ErrorCurve, bin_index: int, statistics: Sequence[str]
) -> dict[str, TableCell]:
    """Return the row of an altitude bin in the CSV file: its statistics by column name."""
    record: dict[str, TableCell] = {
        "scanner": curve.scanner,
        "from": float(curve.altitude_edges[bin_index]),
        "to": float(curve.altitude_edges[bin_index + 1]),
        "cycles": int(curve.tally.n_attempts[bin_index]),
        "solved": int(curve.tally.n_solutions[bin_index]),
    }
    component_names = COMPONENT_NAMES_BY_QUANTITY[curve.quantity]
    if AVAILABILITY in statistics:
        record["available"] = float(curve.tally.availability[bin_index])
    if BIAS in statistics:
        for k, name in enumerate(component_names):
            record[f"bias {name}".strip()] = float(curve.tally.bias[bin_index, k])
            record[f"error of bias {name}".strip()] = float(curve.bias_standard_error[bin_index, k])
    if RMSE in statistics:
        for k, name in enumerate(
            (*component_names, VECTOR_LENGTH_LABEL) if len(component_names) > 1 else component_names
        ):
            record[f"rmse {name}".strip()] = float(curve.rmse[bin_index, k])
            record[f"stated {name}".strip()] = float(curve.stated_deviation[bin_index, k])
    return record
