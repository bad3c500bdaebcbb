"""Some points of a study as rows, spread over all of it."""

from __future__ import annotations

import numpy as np
import pandas

from sweep.analysis.cells import known
from sweep.analysis.figures import Study
from sweep.analysis.scenes.quantities import INTERPOLATED, QUANTITIES, shown
from sweep.analysis.scenes.recording import Thinned
from sweep.report.clouds import Seen
from sweep.report.page import Table

MOST_ROWS = 1000

COLUMNS = (
    "pd_shot", "pd_shot_half_width", "pd_up", "pd_doppler", "pd_down", "pfa_segment", "pfa_shot",
    "p_leakage_up", "false_alarms", "snr_up", "snr_doppler", "range_error",
    "radial_velocity_error", "range_rmse", "range_bound", "radial_velocity_rmse",
    "radial_velocity_bound", "beamlets", "n_draws", "effects_error",
)  # fmt: skip

OF_POINTS = (
    "time", "beam", "x", "y", "z", "range", "radial_velocity", "snr", "pd", "true_range",
    "true_radial_velocity", "flags",
)  # fmt: skip


def grid_points(study: Study) -> Table | None:
    """Points of a grid, every k-th along its longest axes; none where there is a single one."""
    dataset = study.dataset
    if not study.spec.axes:
        return None
    names = [name for name in COLUMNS if name in dataset]
    dims = dict(zip(dataset[names[0]].dims, dataset[names[0]].shape, strict=True))
    size = dict(dims)
    while np.prod(list(size.values())) > MOST_ROWS:
        longest = max(size, key=lambda dim: size[dim])
        size[longest] -= max(1, size[longest] // 10)
    chosen = {
        dim: np.unique(np.linspace(0, dims[dim] - 1, number).round().astype(int))
        for dim, number in size.items()
    }
    part = dataset[names].isel(chosen)  # type: ignore[arg-type]
    for name in names:
        part[name] = known(part[name]).assign_attrs(dataset[name].attrs)
    frame = part.to_dataframe().reset_index()
    frame = frame[[c for c in frame.columns if c in dataset.coords or c in names]]
    frame = frame.rename(columns={c: _headed(c, dataset[c].attrs) for c in frame.columns})
    total = int(np.prod(list(dims.values())))
    return Table("Points", _told(len(frame), total), frame, "points")


def _headed(name: str, attributes: dict[str, str]) -> str:
    units = str(attributes.get("units", ""))
    return name if units in ("", "1") else f"{name} [{units}]"


def _told(rows: int, total: int) -> list[str]:
    if rows == total:
        return [f"All {total:,} points."]
    return [
        f"{rows:,} of {total:,} points, spread over all: reduced for this page. The store has "
        "every one."
    ]


def cloud_points(found: list[Seen]) -> Table:
    """Points of clouds of the first draw, with what a reader wants of each."""
    frames, total = [], 0
    for seen in found:
        rows = Thinned(MOST_ROWS // len(found))
        for part in seen.recording.stretches():
            rows.add(seen.recording.points(list(OF_POINTS), part, ranges=INTERPOLATED))
        total += rows.total
        if rows.total:
            table = rows.rows()
            columns = {
                _unit(name): shown(name, values) if name != "flags" else values
                for name, values in table.items()
            }
            frames.append(pandas.DataFrame({"recorded by": seen.words or "the scanner"} | columns))
    frame = pandas.concat(frames, ignore_index=True) if frames else pandas.DataFrame()
    return Table("Points", _told(len(frame), total), frame, "points")


def _unit(name: str) -> str:
    units = "dB" if name == "snr" else QUANTITIES[name].units
    return name if units in ("", "1") else f"{name} [{units}]"
