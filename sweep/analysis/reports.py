"""Reports of a unit's interface: quantised, clipped, flagged, at its rate and late.

They are made of stored points and change none of them. A shot is valid where it has a return that a
Doppler peak confirms, as far as the instrument can tell; without a Doppler segment, where it has
one. Its first return is taken. Each beam has one report in every period of the interface's rate,
valid or not: of the mean or the last of the period's valid shots.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.export import chosen
from sweep.analysis.figures import SceneStudy
from sweep.analysis.scenes.recording import INTERPOLATED, Recording, by_ranges
from sweep.messages import STORE, suggestion
from sweep.model.pairing import UNCONFIRMED
from sweep.spec import Mistake, SpecError
from sweep.spec.scene import Interface
from sweep.storage.locations import Location, draft

VALUES = ("range", "radial_velocity")
COLUMNS = {
    "time": ("s", "time stamp: that of the measurement, and the latency"),
    "beam": ("1", "number of the beam"),
    "range": ("m", "range as reported"),
    "radial_velocity": ("m s-1", "radial velocity as reported, positive when closing"),
    "range_standard_error": ("m", "standard error of the range, its quantum's among it"),
    "radial_velocity_standard_error": (
        "m s-1", "standard error of the radial velocity, its quantum's among it"
    ),
    "valid": ("1", "1: enough valid shots, and neither value beyond its limits"),
    "range_saturated": ("1", "1: range beyond its limits, and clipped to them"),
    "radial_velocity_saturated": ("1", "1: radial velocity beyond its limits, and clipped to them"),
    "shots": ("1", "valid shots in the report's period"),
    "true_range": ("m", "true range of the beam's axis at the time stamp"),
    "true_radial_velocity": ("m s-1", "true radial velocity of the beam's axis at the time stamp"),
}  # fmt: skip
"""Units and words of each column of reports."""

_TRUTH = {"true_range": "beam_range", "true_radial_velocity": "beam_radial_velocity"}
_EDGE = 1e-6
"""Share of a period before its end from which on a shot counts to the next: for rounded times."""
_SPARSEST = 10
"""Reports for each shot from which on an interface's rate is refused: most would be empty."""

Table = dict[str, np.ndarray]


def reports(
    store: str | Location,
    file: str | Path | None = None,
    *,
    scanner: str | None = None,
    draw: int = 0,
    ranges: str = INTERPOLATED,
    where: Mapping[str, object] | None = None,
    interface: Mapping[str, object] | None = None,
) -> xr.Dataset:
    """Return what a unit with a stated interface reports of a flight.

    Parameters
    ----------
    store, scanner, draw, ranges, where
        As of :func:`sweep.export`.
    file
        CSV file to write the reports to as well, names and units in its first line.
    interface
        Fields of the spec's section ``interface`` to be set anew, written as in a spec:
        ``{"rate": "10 Hz"}``.

    Returns
    -------
    xarray.Dataset
        Variables along ``report``, by period and beam, with units and words. Values of a report
        without a valid shot are nan, and so are standard errors of clipped values.

    Raises
    ------
    NotAStoreError
        Where there is no store of a scene.
    SpecError
        With every mistake in what is asked for.
    OSError
        Where the file can't be written.
    """
    study, mistakes = SceneStudy.of(store), []
    if file is not None and Path(file).suffix.lower() != ".csv":
        remedy = "name a .csv, or export points"
        mistakes.append(Mistake("file", "must end in .csv to hold reports", str(file), remedy))
    recording, _ = chosen(study, scanner, draw, ranges, where or {}, mistakes)
    shots = _shots(recording, draw, ranges)
    table = reported(shots, study.spec.interface_with(interface or {}))
    if file is not None:
        with draft(Path(file), replace=True) as made:
            headers = {name: labels.with_brackets(name, u) for name, (u, _) in COLUMNS.items()}
            frame = pandas.DataFrame({header: table[name] for name, header in headers.items()})
            frame.to_csv(made, index=False, na_rep="nan", lineterminator="\r\n")
    arrays = {
        name: ("report", table[name], {"units": units, "long_name": words})
        for name, (units, words) in COLUMNS.items()
    }
    return xr.Dataset(arrays)


def _shots(recording: Recording, draw: int, ranges: str) -> Table:
    """Columns over the computed shots of a draw: geometry, and the first return of each."""
    of_points = {name: by_ranges(name, ranges) for name in (*VALUES, *map(_error, VALUES))}
    parts: list[Table] = []
    for part in recording.stretches():
        known = recording.computed(part, draw)
        names = ("time", "beam", *_TRUTH.values())
        table = {name: recording.read(name, part)[known] for name in names}
        for name, stored in (of_points | {"flags": "flags"}).items():
            table[name] = recording.read(stored, part, draw)[known, 0]
        parts.append(table)
    if not any(part["time"].size for part in parts):
        rule = f"holds no shot of {recording.scanner} and draw {draw} yet"
        remedy = f"{suggestion('resume', STORE)} goes on with it"
        raise SpecError([Mistake("store", rule, "", remedy)])
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def reported(shots: Table, interface: Interface) -> Table:
    """Columns of reports, (m,) each, from those of shots in the order of time, (n,) each.

    Shots have ``time``, ``beam``, ``flags``, the values and standard errors of their first return,
    and the truth on the beam's axis, ``beam_range`` and ``beam_radial_velocity``.
    """
    valid = (shots["flags"] > 0) & (shots["flags"] & UNCONFIRMED == 0)
    report, table = _periods(shots, interface.rate)
    number = np.bincount(report[valid], minlength=table["beam"].size)
    weights = _weights(report, valid, number, interface.value)

    def held(values: np.ndarray) -> np.ndarray:
        total = np.bincount(report[valid], (weights * values)[valid], number.size)
        return np.where(number > 0, total, np.nan)

    measured = np.where(number > 0, held(shots["time"]), table["time"])
    found = {"time": measured + interface.latency, "beam": table["beam"]}
    is_valid = number >= interface.valid_shots
    for name in VALUES:
        quantum = getattr(interface, f"{name}_quantum")
        limits = getattr(interface, f"min_{name}"), getattr(interface, f"max_{name}")
        found[name], beyond = quantised(held(shots[name]), quantum, *limits)
        variance = held(weights * shots[_error(name)] ** 2) + (quantum or 0.0) ** 2 / 12
        found[_error(name)] = np.where(beyond, np.nan, np.sqrt(variance))
        found[f"{name}_saturated"] = beyond.astype(np.int8)
        is_valid &= ~beyond
    found |= {"valid": is_valid.astype(np.int8), "shots": number}
    for name, stored in _TRUTH.items():
        found[name] = _at(found["time"], found["beam"], shots, stored)
    return {name: found[name] for name in COLUMNS}


def quantised(
    values: np.ndarray, quantum: float | None, low: float | None, high: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Values in whole quanta, clipped to the limits, and a mask of those beyond; none for no rule.

    Limits are clipped to their nearest whole quantum, so that what lies within them is off by half
    a quantum at the most.

    >>> values, beyond = quantised(np.array([0.3, 2.6, 9.0]), 0.5, None, 4.0)
    >>> values.tolist(), beyond.tolist()
    ([0.5, 2.5, 4.0], [False, False, True])
    """
    low, high = -np.inf if low is None else low, np.inf if high is None else high
    beyond = (values < low) | (values > high)
    if quantum is None:
        return np.clip(values, low, high), beyond
    steps = np.clip(np.rint(values / quantum), np.rint(low / quantum), np.rint(high / quantum))
    return steps * quantum, beyond


def _error(name: str) -> str:
    return f"{name}_standard_error"


def _periods(shots: Table, rate: float | None) -> tuple[np.ndarray, Table]:
    """Report of each shot, (n,); beam and middle of the period of each report, (m,)."""
    if rate is None:
        return np.arange(shots["time"].size), {name: shots[name] for name in ("time", "beam")}
    start = shots["time"][0]
    beams, beam = np.unique(shots["beam"], return_inverse=True)
    period = np.floor((shots["time"] - start) * rate + _EDGE).astype(np.int64)
    if (period[-1] + 1) * beams.size > _SPARSEST * (beam.size + beams.size):
        often = beam.size / beams.size / max(np.ptp(shots["time"]), 1 / rate)
        rule = f"must be at most some {_SPARSEST * often:.3g} Hz: beams are measured less often"
        remedy = f"write e.g. '{often:.3g} Hz', or leave it out for a report of each shot"
        raise SpecError([Mistake("interface.rate", rule, f"{rate:.10g} Hz", remedy)])
    periods = np.arange(period[-1] + 1)
    return period * beams.size + beam, {
        "time": np.repeat(start + (periods + 0.5) / rate, beams.size),
        "beam": np.tile(beams, periods.size),
    }


def _weights(report: np.ndarray, valid: np.ndarray, number: np.ndarray, value: str) -> np.ndarray:
    """Weight of each shot in its report, (n,): as much as any, or all to the last."""
    if value == "mean":
        return np.where(valid, 1 / np.maximum(number[report], 1), 0.0)
    last = np.full(number.size, -1)
    np.maximum.at(last, report[valid], np.flatnonzero(valid))
    return (last[report] == np.arange(report.size)).astype(float)


def _at(time: np.ndarray, beam: np.ndarray, shots: Table, name: str) -> np.ndarray:
    """Truth of beams at times, linear between their shots; nan outside of them and of nothing."""
    found = np.full(time.size, np.nan)
    truth = np.where(np.isfinite(shots[name]), shots[name], np.nan)
    for number in np.unique(beam):
        here, own = beam == number, shots["beam"] == number
        found[here] = np.interp(time[here], shots["time"][own], truth[own], np.nan, np.nan)
    return found
