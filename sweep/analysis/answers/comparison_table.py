"""Two studies compared, in a table and in a sentence."""

from __future__ import annotations

import numpy as np
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.answers.comparison import compare
from sweep.model.outputs import PROMISED

COLUMNS = ("quantity", "differ", "median", "largest", "agree", "largest at")

SHOWN = (
    *PROMISED, "log10_pfa_bin", "log10_pfa_segment", "log10_pfa_shot", "p_leakage_up",
    "p_leakage_down", "snr_up", "snr_doppler", "snr_down", "noise_variance", "range_error",
    "radial_velocity_error", "false_alarms", "range_rmse", "radial_velocity_rmse",
)  # fmt: skip


def compared(ours: xr.Dataset, other: xr.Dataset) -> xr.Dataset:
    """Differences as :func:`.comparison.compare` gives them, of what a table shows, computed."""
    found = compare(ours, other)
    names = [n for n in found.data_vars if str(n).removesuffix("_allowed").removesuffix("_agrees")
             in SHOWN]  # fmt: skip
    return found[names].compute()


def rows(found: xr.Dataset) -> list[list[str]]:
    """A row for each quantity, in the order of `COLUMNS`; quantities without a point left out."""
    return [_row(found, name) for name in SHOWN if name in found and found[name].notnull().any()]


def _row(found: xr.Dataset, name: str) -> list[str]:
    array = found[name]
    known = np.isfinite(array.values)
    size = np.where(known, np.abs(array.values), -1.0)
    worst = np.unravel_index(int(np.argmax(size)), size.shape)
    share = "-"
    if f"{name}_agrees" in found:
        agrees = (found[f"{name}_agrees"].values & known).sum() / known.sum()
        # rounded down: nothing but all is 100 %
        share = f"{np.floor(1e4 * agrees) / 100:g} %"
    different = int((size > 0).sum())
    return [
        labels.with_units(name, str(array.attrs.get("units", ""))),
        f"{different:,}",
        f"{np.median(size[known]):.2g}",
        f"{array.values[worst]:+.3g}" if different else "0",
        share,
        _where(array, worst) if different else "-",
    ]


def _where(array: xr.DataArray, index: tuple[np.intp, ...]) -> str:
    """Coordinates of a point, in the order of the axes."""
    point = array.isel(dict(zip(array.dims, map(int, index), strict=True)))
    return ", ".join(
        labels.quantity(c.values.item(), str(c.attrs.get("units", "")))
        for c in point.coords.values()
    )


def verdict(found: xr.Dataset) -> tuple[str, str]:
    """``same``, ``different`` or ``nothing``, and a sentence that says so."""
    parts = [(found[n], found[f"{n}_agrees"]) for n in PROMISED if n in found]
    number = max((int(array.notnull().sum()) for array, _ in parts), default=0)
    if not number:
        return "nothing", "Nothing that both stores have is computed yet."
    apart = max(int((array.notnull() & ~agrees).sum()) for array, agrees in parts)
    if not apart:
        return "same", f"Probabilities of detection agree at {labels.counted(number, 'point')}."
    return "different", f"Probabilities of detection differ at {apart:,} of {number:,} points."
