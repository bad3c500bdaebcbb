"""Two studies compared, in a table and in a sentence."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import xarray as xr

from sweep.analysis import labels
from sweep.analysis.answers.flight_comparison import DETECTED
from sweep.model.outputs import PROMISED

COLUMNS = ("quantity", "differ", "median", "largest", "agree", "largest at")

Store = xr.Dataset | xr.DataTree

SHOWN = (
    *PROMISED, "log10_pfa_bin", "log10_pfa_segment", "log10_pfa_both_chirps",
    "log10_pfa_shot", "p_leakage_up", "p_leakage_down", "snr_up", "snr_doppler", "snr_down",
    "noise_variance", "range_error", "radial_velocity_error", "false_alarms", "range_rmse",
    "radial_velocity_rmse", "pfa_up", "pfa_down", DETECTED,
)  # fmt: skip


def compared(ours: Store, other: Store) -> dict[str, xr.Dataset]:
    """Differences of what a table shows, computed: by scanner, or of a grid under no name.

    Raises
    ------
    ValueError
        Of a grid and a flight; of studies that share no point, or no shot.
    """
    found = ours.sweep.compare(other)
    parts = {"": found} if isinstance(found, xr.Dataset) else _groups(found)
    return {part: _shown(dataset).compute() for part, dataset in parts.items()}


def _groups(tree: xr.DataTree) -> dict[str, xr.Dataset]:
    return {name: group.to_dataset() for name, group in tree.children.items()}


def _shown(found: xr.Dataset) -> xr.Dataset:
    return found[
        [n for n in found.data_vars if str(n).removesuffix("_allowed").removesuffix("_agrees")
         in SHOWN]
    ]  # fmt: skip


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
    return ", ".join(_told(c) for c in point.coords.values())


def _told(coordinate: xr.DataArray) -> str:
    """A coordinate's value; with its name where no unit tells what it is."""
    units = str(coordinate.attrs.get("units", ""))
    value = labels.quantity(coordinate.values.item(), units)
    return value if units not in ("", "1") else f"{labels.coordinate(str(coordinate.name))} {value}"


def met(found: xr.Dataset) -> str:
    """How many shots two flights share, in words."""
    number, ours, other = found.sizes["shot"], found.attrs["shots"], found.attrs["other_shots"]
    if number == ours == other:
        return f"all {labels.counted(number, 'shot')}"
    return f"{labels.counted(number, 'shot')} that both have, of {ours:,} and {other:,}"


def verdict(parts: Iterable[xr.Dataset]) -> tuple[str, str]:
    """``same``, ``different`` or ``nothing``, and a sentence that says so."""
    number, apart, thing, counted = 0, 0, "point", ""
    for found in parts:
        if "shot" in found.dims:
            several = any(n > 1 for dim, n in found.sizes.items() if dim != "shot")
            thing, counted = "shot", ", counted at each place along the axes" * several
        pairs = [(found[n], found[f"{n}_agrees"]) for n in PROMISED if n in found]
        number += max((int(array.notnull().sum()) for array, _ in pairs), default=0)
        apart += max((int((array.notnull() & ~agrees).sum()) for array, agrees in pairs), default=0)
    if not number:
        return "nothing", "Nothing that both stores have is computed yet."
    if not apart:
        told = f"agree at {labels.counted(number, thing)}"
        return "same", f"Probabilities of detection {told}{counted}."
    told = f"differ at {apart:,} of {labels.counted(number, thing)}"
    return "different", f"Probabilities of detection {told}{counted}."
