"""Probabilities of detection with what is known of how far they may be off."""

from __future__ import annotations

import xarray as xr

from sweep.analysis.answers.physical import spec_of

SEGMENTS = ("up", "doppler", "down", "shot")


def named(quantity: str, segment: str) -> str:
    """Name of a variable of a segment, or of a shot.

    Raises
    ------
    ValueError
        There is no such segment.
    """
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
