"""Probabilities of detection with their intervals, false alarms by time and way, summaries."""

from __future__ import annotations

import dask.array
import numpy as np
import xarray as xr

from sweep.analysis import noise_only
from sweep.analysis.answers.physical import parameter, quantity, spec_of

SEGMENTS = ("up", "doppler", "down", "shot")


def named(quantity: str, segment: str) -> str:
    """Name of a variable of a segment, or of a shot."""
    if segment not in SEGMENTS:
        raise ValueError(f"there is no segment '{segment}': take one of {', '.join(SEGMENTS)}")
    return f"{quantity}_{segment}"


def half_width(dataset: xr.Dataset, segment: str) -> xr.DataArray | None:
    """Half-widths of the intervals of pd; None where nothing is drawn."""
    return dataset.get(f"{named('pd', segment)}_half_width")


def detection_probability(dataset: xr.Dataset, segment: str = "shot") -> xr.Dataset:
    """Probability of detection, and the interval that holds the true one.

    Parameters
    ----------
    dataset
        As `sweep.open` gives it, or a part of it.
    segment
        ``shot`` (up- and down-chirp both), ``up``, ``doppler`` or ``down``.

    Returns
    -------
    xarray.Dataset
        `pd`, `low` and `high`, 0..1, lazy as the store's arrays are. The interval is pd plus and
        minus the half-width that is stored, within 0..1; its attribute `confidence` says how sure
        it is. Where a study draws nothing pd is a closed form and the interval has no width.
        What effects that were left out may change is apart, in `effects_error`.
    """
    pd = dataset[named("pd", segment)]
    reach = half_width(dataset, segment)
    low, high = (pd, pd) if reach is None else ((pd - reach).clip(0, 1), (pd + reach).clip(0, 1))
    result = xr.Dataset({"pd": pd, "low": low, "high": high}).assign_attrs(dataset.attrs)
    for name, words in (("low", "lower"), ("high", "upper")):
        result[name].attrs = {
            "units": "1", "long_name": f"{words} end of the interval of {pd.attrs['long_name']}",
            **confidence(dataset, reach),
        }  # fmt: skip
    return result


def confidence(dataset: xr.Dataset, reach: xr.DataArray | None) -> dict[str, float]:
    """How sure an interval is, where that is one number; certain where nothing is drawn."""
    if reach is None:
        return {"confidence": 1.0}
    stored = reach.attrs.get("confidence")
    if stored is None and "confidence" not in dataset.coords:
        stored = spec_of(dataset).accuracy.confidence
    return {} if stored is None else {"confidence": float(stored)}


SEGMENTS_OF_A_SHOT = 3
"""Up-chirp, Doppler segment and down-chirp follow each other without a pause."""


def false_alarms_per_second(
    dataset: xr.Dataset, rate: str | float | None = None, *, leakage: bool = False
) -> xr.DataArray:
    """Mean number of shots a second whose up- and down-chirp both raise a false alarm.

    Parameters
    ----------
    dataset
        As `sweep.open` gives it, or a part of it.
    rate
        Shots a second, ``"20 Hz"`` or a number; by default as many as chirps leave time for,
        1 / (3 T), 3 being the segments.
    leakage
        Whether extra groups that leaked signal raises count as well as noise. A study that draws
        whole spectra counts every false alarm of a shot, of either cause, whatever is asked.

    Returns
    -------
    xarray.DataArray
        [1/s], lazy.

    Raises
    ------
    ValueError
        The rate cannot be read, or is not positive.
    """
    shots: xr.DataArray | float
    if rate is None:
        duration = parameter(dataset, "instrument.chirp.duration", spec_of(dataset))
        shots = 1 / (SEGMENTS_OF_A_SHOT * duration)
    else:
        shots = quantity(rate, si_unit="Hz", name="the rate of shots")
        if not shots > 0:
            raise ValueError("the rate of shots is a positive number")
    alarms = (shots * of_a_shot(dataset, leakage)).rename("false_alarms_per_second")
    text = "noise and leaked signal" if leakage else "noise alone"
    return alarms.assign_attrs(
        units="s-1", long_name="false alarms a second", comment=f"shots with false alarms by {text}"
    )


def false_alarms_per_kilometre(
    dataset: xr.Dataset,
    speed: str | float,
    rate: str | float | None = None,
    *,
    leakage: bool = False,
) -> xr.DataArray:
    """The same for a kilometre of flight.

    Parameters
    ----------
    dataset, rate, leakage
        As of :func:`false_alarms_per_second`.
    speed
        Along the path, ``"50 m/s"`` or a number of m/s.

    Returns
    -------
    xarray.DataArray
        [1/km], lazy.

    Raises
    ------
    ValueError
        Speed or rate cannot be read, or are not positive.
    """
    metres_a_second = quantity(speed, si_unit="m/s", name="the speed")
    if not metres_a_second > 0:
        raise ValueError("the speed is a positive number")
    per_second = false_alarms_per_second(dataset, rate, leakage=leakage)
    per_kilometre = (per_second * (1000 / metres_a_second)).rename("false_alarms_per_kilometre")
    return per_kilometre.assign_attrs(
        per_second.attrs, units="km-1", long_name="false alarms a kilometre"
    )


def of_a_shot(dataset: xr.Dataset, leakage: bool) -> xr.DataArray:
    """Probability of a false alarm in both chirp segments; where spectra are drawn their number."""
    if "pfa_both_chirps" not in dataset:
        # whole spectra were drawn: counted false alarms of all segments, leaked signal's as well
        return dataset["false_alarms"]
    noise = dataset["pfa_both_chirps"]
    if not leakage:
        return noise
    segments = (dataset["p_leakage_up"], dataset["p_leakage_down"])
    return noise_only.shot_with_leakage(dataset["pfa_segment"], noise, *segments)


STATISTICS = ("mean", "least", "largest", "number")


def summary(dataset: xr.Dataset) -> xr.Dataset:
    """Mean, extremes and number of the computed points of every output.

    Parameters
    ----------
    dataset
        As `sweep.open` gives it, or a part of it.

    Returns
    -------
    xarray.Dataset
        Every variable of floats over `statistic`, lazy; nan where no point is finite. The store
        goes through memory chunk by chunk, each chunk once.
    """
    result = xr.Dataset(coords={"statistic": list(STATISTICS)}, attrs=dataset.attrs)
    for name, array in dataset.data_vars.items():
        if array.dtype.kind == "f":
            result[name] = xr.DataArray(_reduced(array), dims=["statistic"], attrs=array.attrs)
    return result


def _reduced(array: xr.DataArray) -> dask.array.Array:
    """The statistics of an array, (4,)."""
    data = array.chunk().data if array.chunks is None else array.data
    axis = data.ndim
    parts = data.map_blocks(
        _of_block, dtype=float, new_axis=axis, chunks=(*((1,) * n for n in data.numblocks), (4,))
    )
    return parts.reshape(-1, 4).rechunk(-1).map_blocks(
        _of_all, dtype=float, drop_axis=0, chunks=((4,),)
    )  # fmt: skip


def _of_block(block: np.ndarray) -> np.ndarray:
    """Sum, extremes and number of the finite values of a block, (1, .., 1, 4)."""
    known = block[np.isfinite(block)]
    least, largest = (known.min(), known.max()) if known.size else (np.inf, -np.inf)
    return np.array([known.sum(), least, largest, known.size]).reshape((1,) * block.ndim + (4,))


def _of_all(parts: np.ndarray) -> np.ndarray:
    """The statistics of all blocks together, from (blocks, 4)."""
    number = parts[:, 3].sum()
    if not number:
        return np.array([np.nan, np.nan, np.nan, 0.0])
    return np.array([parts[:, 0].sum() / number, parts[:, 1].min(), parts[:, 2].max(), number])
