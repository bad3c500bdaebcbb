"""Reports that a lidar unit sends over its interface: quantised, clipped, flagged and delayed.

Reports are made from stored points, which stay unchanged. A shot is valid if it has a return that a
Doppler peak confirms, as far as the instrument can tell. Without a Doppler segment any return is
enough. The first return of a shot counts. Each beam has one report per period of the interface's
rate, valid or not. It is the mean, or the last, of the period's valid shots.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.scene_results.point_export import resolve_recording
from sweep.analysis.scene_results.recordings import (
    INTERPOLATED_RANGES,
    ColumnArrays,
    Recording,
    quantity_array_name,
)
from sweep.analysis.study_figures import SceneResults
from sweep.messages import STORE_PLACEHOLDER, suggested_call
from sweep.model.pointcloud.pairing import UNCONFIRMED_FLAG
from sweep.spec import Mistake, SpecError
from sweep.spec.scene_sections import Interface
from sweep.storage.locations import Location, write_path_atomically

MEASURED_QUANTITIES = ("range", "radial_velocity")
"""Names of the quantities that a lidar unit reports."""

REPORT_COLUMNS = {
    "time": ("s", "time stamp: time of the measurement plus the latency"),
    "beam": ("1", "number of the beam"),
    "range": ("m", "range as reported"),
    "radial_velocity": ("m s-1", "radial velocity as reported, positive when closing"),
    "range_standard_error": ("m", "standard error of the range, quantisation included"),
    "radial_velocity_standard_error": (
        "m s-1", "standard error of the radial velocity, quantisation included"
    ),
    "valid": ("1", "1: enough valid shots, and no value outside its limits"),
    "range_saturated": ("1", "1: range clipped, as it lies outside its limits"),
    "radial_velocity_saturated": (
        "1", "1: radial velocity clipped, as it lies outside its limits"
    ),
    "shots": ("1", "number of valid shots in the report's period"),
    "true_range": ("m", "true range of the beam's axis at the time stamp"),
    "true_radial_velocity": ("m s-1", "true radial velocity of the beam's axis at the time stamp"),
}  # fmt: skip
"""Unit and description of each column of a table of reports, by the column's name."""

_TRUTH_VARIABLE_BY_COLUMN = {
    "true_range": "beam_range",
    "true_radial_velocity": "beam_radial_velocity",
}
"""Stored variable with true values along the beam, for each column of true values in reports."""

_PERIOD_END_TOLERANCE_FRACTION = 1e-6
"""Shots in the last part of a report's period, of this fraction of it, count to the next period.

This allows for rounding errors of times.
"""
_REPORTS_PER_SHOT_MAX = 10
"""Largest number of reports per shot. A higher rate is refused: most reports would be empty."""


def reports(
    store: str | Location,
    file: str | Path | None = None,
    *,
    scanner: str | None = None,
    draw: int = 0,
    ranges: str = INTERPOLATED_RANGES,
    where: Mapping[str, object] | None = None,
    interface: Mapping[str, object] | None = None,
) -> xr.Dataset:
    """Return the reports that a lidar unit sends over its data interface during a flight.

    Parameters
    ----------
    store, scanner, draw, ranges, where
        As in :func:`sweep.export`.
    file
        CSV file to which the reports are also written, with names and units in its first line.
    interface
        Changed fields of the spec's section ``interface``, written as in a spec: ``{"rate": "10
        Hz"}``.

    Returns
    -------
    xarray.Dataset
        Variables along ``report``, ordered by period and beam, with units and descriptions. Values
        of a report without a valid shot are nan. Standard errors of clipped values are nan too.

    Raises
    ------
    NotAStoreError
        The path has no store of a scene.
    SpecError
        The request has mistakes, all of which are listed.
    OSError
        The file can't be written.

    Examples
    --------
    >>> import sweep
    >>> outcome = sweep.run(sweep.load("flight.yaml"), store="reports.zarr", progress=False)
    >>> reports = sweep.reports("reports.zarr", "reports.csv", interface={"rate": "1 Hz"})
    >>> reports.sizes["report"] > 0
    True
    """
    results, mistakes = SceneResults.from_store(store), []
    if file is not None and Path(file).suffix.lower() != ".csv":
        remedy = "name a .csv, or export points"
        mistakes.append(Mistake("file", "must end in .csv to hold reports", str(file), remedy))
    recording = resolve_recording(results, scanner, draw, ranges, where or {}, mistakes).recording
    shot_columns = _read_shot_columns(recording, draw, ranges)
    report_columns = make_reports(
        shot_columns, results.spec.interface_with_overrides(interface or {})
    )
    if file is not None:
        with write_path_atomically(Path(file), replace=True) as draft_path:
            headers = {
                name: labels.column_label(name, u) for name, (u, _) in REPORT_COLUMNS.items()
            }
            frame = pandas.DataFrame(
                {header: report_columns[name] for name, header in headers.items()}
            )
            frame.to_csv(draft_path, index=False, na_rep="nan", lineterminator="\r\n")
    arrays = {
        name: ("report", report_columns[name], {"units": units, "long_name": words})
        for name, (units, words) in REPORT_COLUMNS.items()
    }
    return xr.Dataset(arrays)


def _read_shot_columns(recording: Recording, draw: int, ranges: str) -> ColumnArrays:
    """Return the columns of computed shots that :func:`make_reports` needs, for one draw."""
    stored_by_name = {
        name: quantity_array_name(name, ranges)
        for name in (*MEASURED_QUANTITIES, *map(_standard_error_name, MEASURED_QUANTITIES))
    }
    column_parts: list[ColumnArrays] = []
    for shot_slice in recording.iter_shot_slices():
        is_computed = recording.computed_shot_mask(shot_slice, draw)
        names = ("time", "beam", *_TRUTH_VARIABLE_BY_COLUMN.values())
        column_arrays = {
            name: recording.read_array(name, shot_slice)[is_computed] for name in names
        }
        for name, stored_name in (stored_by_name | {"flags": "flags"}).items():
            column_arrays[name] = recording.read_array(stored_name, shot_slice, draw)[
                is_computed, 0
            ]
        column_parts.append(column_arrays)
    if not any(column_part["time"].size for column_part in column_parts):
        problem = f"holds no shot of {recording.scanner} and draw {draw} yet"
        remedy = f"{suggested_call('resume', STORE_PLACEHOLDER)} goes on with it"
        raise SpecError([Mistake("store", problem, "", remedy)])
    return {
        name: np.concatenate([column_part[name] for column_part in column_parts])
        for name in column_parts[0]
    }


def make_reports(shot_columns: ColumnArrays, interface: Interface) -> ColumnArrays:
    """Return the reports that a lidar unit sends over its data interface, made from its shots.

    Parameters
    ----------
    shot_columns
        Columns of n shots, sorted by time: ``time``, ``beam``, ``flags``, the values and standard
        errors of the first return, and the truth along the beam's axis, ``beam_range`` and
        ``beam_radial_velocity``.
    interface
        Rate, quantisation steps, limits and latency of reports; whether a report is the mean or
        the last of its valid shots; and the least number of valid shots of a valid report.

    Returns
    -------
    dict of numpy.ndarray
        Columns of m reports, as listed in `REPORT_COLUMNS`.

    Notes
    -----
    The variance of a report is that of the weighted mean of its shots, plus q^2 / 12 for a
    quantisation step q.
    """
    is_valid_shot = (shot_columns["flags"] > 0) & (shot_columns["flags"] & UNCONFIRMED_FLAG == 0)
    report_index, report_periods = _assign_shots_to_reports(shot_columns, interface.rate)
    n_valid = np.bincount(report_index[is_valid_shot], minlength=report_periods["beam"].size)
    weights = _shot_weights(report_index, is_valid_shot, n_valid, interface.value)

    def weighted_sum(values: np.ndarray) -> np.ndarray:
        total = np.bincount(
            report_index[is_valid_shot], (weights * values)[is_valid_shot], n_valid.size
        )
        return np.where(n_valid > 0, total, np.nan)

    measurement_time = np.where(
        n_valid > 0, weighted_sum(shot_columns["time"]), report_periods["time"]
    )
    columns = {"time": measurement_time + interface.latency, "beam": report_periods["beam"]}
    is_valid_report = n_valid >= interface.valid_shots
    for name in MEASURED_QUANTITIES:
        quantisation_step = getattr(interface, f"{name}_quantum")
        limits = getattr(interface, f"min_{name}"), getattr(interface, f"max_{name}")
        columns[name], is_saturated = quantise_and_clip(
            weighted_sum(shot_columns[name]), quantisation_step, *limits
        )
        variance = (
            weighted_sum(weights * shot_columns[_standard_error_name(name)] ** 2)
            + (quantisation_step or 0.0) ** 2 / 12
        )
        columns[_standard_error_name(name)] = np.where(is_saturated, np.nan, np.sqrt(variance))
        columns[f"{name}_saturated"] = is_saturated.astype(np.int8)
        is_valid_report &= ~is_saturated
    columns |= {"valid": is_valid_report.astype(np.int8), "shots": n_valid}
    for name, truth_name in _TRUTH_VARIABLE_BY_COLUMN.items():
        columns[name] = _interpolate_truth(
            columns["time"], columns["beam"], shot_columns, truth_name
        )
    return {name: columns[name] for name in REPORT_COLUMNS}


def quantise_and_clip(
    values: np.ndarray, quantisation_step: float | None, low: float | None, high: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return values rounded to quantisation steps and clipped, and a mask of those out of limits.

    ``quantisation_step`` and the limits ``low`` and ``high`` are optional (None). Limits are
    rounded to the nearest step, so that a value within limits changes by at most half a step.

    >>> values, beyond = quantise_and_clip(np.array([0.3, 2.6, 9.0]), 0.5, None, 4.0)
    >>> values.tolist(), beyond.tolist()
    ([0.5, 2.5, 4.0], [False, False, True])
    """
    low, high = -np.inf if low is None else low, np.inf if high is None else high
    is_beyond = (values < low) | (values > high)
    if quantisation_step is None:
        return np.clip(values, low, high), is_beyond
    steps = np.clip(
        np.rint(values / quantisation_step),
        np.rint(low / quantisation_step),
        np.rint(high / quantisation_step),
    )
    return steps * quantisation_step, is_beyond


def _standard_error_name(quantity: str) -> str:
    """Return the name of the column that holds the standard error of a quantity."""
    return f"{quantity}_standard_error"


def _assign_shots_to_reports(
    shot_columns: ColumnArrays, rate: float | None
) -> tuple[np.ndarray, ColumnArrays]:
    """Return the report to which each of n shots belongs, and beam and time of m reports.

    There is a report for each beam and period of the rate. Without a rate each shot has its own
    report.

    Returns
    -------
    report_index : numpy.ndarray
        Index of each shot's report, (n,).
    report_periods : dict of numpy.ndarray
        ``beam`` and ``time`` of each report, (m,). The time [s] is the middle of the period, or the
        time of the shot.
    """
    if rate is None:
        return np.arange(shot_columns["time"].size), {
            name: shot_columns[name] for name in ("time", "beam")
        }
    start = shot_columns["time"][0]
    beams, beam_index = np.unique(shot_columns["beam"], return_inverse=True)
    period_index = np.floor(
        (shot_columns["time"] - start) * rate + _PERIOD_END_TOLERANCE_FRACTION
    ).astype(np.int64)
    if (period_index[-1] + 1) * beams.size > _REPORTS_PER_SHOT_MAX * (beam_index.size + beams.size):
        beam_rate = beam_index.size / beams.size / max(np.ptp(shot_columns["time"]), 1 / rate)
        problem = (
            f"must be at most some {_REPORTS_PER_SHOT_MAX * beam_rate:.3g} Hz: beams are measured "
            "less often"
        )
        remedy = f"write e.g. '{beam_rate:.3g} Hz', or leave it out for a report of each shot"
        raise SpecError([Mistake("interface.rate", problem, f"{rate:.10g} Hz", remedy)])
    periods = np.arange(period_index[-1] + 1)
    return period_index * beams.size + beam_index, {
        "time": np.repeat(start + (periods + 0.5) / rate, beams.size),
        "beam": np.tile(beams, periods.size),
    }


def _shot_weights(
    report_index: np.ndarray, is_valid_shot: np.ndarray, n_valid: np.ndarray, reported_value: str
) -> np.ndarray:
    """Return the weight (n,) of each of n shots in the value of its report.

    If `reported_value` is ``mean``, the valid shots of a report have equal weights with the sum 1.
    Otherwise the last valid shot of a report has the weight 1, and all others 0.
    """
    if reported_value == "mean":
        return np.where(is_valid_shot, 1 / np.maximum(n_valid[report_index], 1), 0.0)
    last_shot = np.full(n_valid.size, -1)
    np.maximum.at(last_shot, report_index[is_valid_shot], np.flatnonzero(is_valid_shot))
    return (last_shot[report_index] == np.arange(report_index.size)).astype(float)


def _interpolate_truth(
    time: np.ndarray, beam: np.ndarray, shot_columns: ColumnArrays, name: str
) -> np.ndarray:
    """Return a true value at the times and beams of n reports, (n,).

    The value is interpolated between the shots of the report's beam. It is nan before the first and
    after the last shot of the beam. `name` is the column of shots with the true value.
    """
    truth_at_times = np.full(time.size, np.nan)
    truth = np.where(np.isfinite(shot_columns[name]), shot_columns[name], np.nan)
    for beam_number in np.unique(beam):
        is_of_beam, is_shot_of_beam = beam == beam_number, shot_columns["beam"] == beam_number
        truth_at_times[is_of_beam] = np.interp(
            time[is_of_beam],
            shot_columns["time"][is_shot_of_beam],
            truth[is_shot_of_beam],
            np.nan,
            np.nan,
        )
    return truth_at_times
