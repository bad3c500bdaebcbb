"""Two studies side by side: where they meet, how far they differ, and whether that is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas
import xarray as xr

from sweep.analysis.answers.physical import parameter, si, study_of
from sweep.model.outputs import OUTPUTS, PROMISED, SPECTRA_OUTPUTS

ROUNDING = 1e-12
"""What another processor's last digits may change of a probability."""

_DIGITS = 12


def compare(ours: xr.Dataset, other: xr.Dataset) -> xr.Dataset:
    """Differences, other less ours, at the points that both studies have.

    Parameters
    ----------
    ours, other
        As `sweep.open` gives them, or parts of them. Points are matched by the values of their
        coordinates, whatever these are written in. Where a parameter is on an axis of one study
        only, the value that the other has is taken, if it is there; else the axis stays.

    Returns
    -------
    xarray.Dataset
        Lazy, over the axes of `ours` and those of `other` that stay: the difference of every
        output by its name; of each probability of detection `pd_.._allowed`, how large it may be
        by what is known of both: half-widths of what is drawn, and what effects and beamlets
        left out may change; and `pd_.._agrees`, whether it is no larger (false where either is
        not computed).

    Raises
    ------
    ValueError
        No point is in both.
    """
    names = [n for n in {**OUTPUTS, **SPECTRA_OUTPUTS} if n in ours and n in other]
    return differences(ours, other, names, bounded=PROMISED)


def differences(
    ours: xr.Dataset, other: xr.Dataset, names: Sequence[str], *, bounded: Sequence[str]
) -> xr.Dataset:
    """Differences of variables where they meet; of those that are bounded, whether they agree."""
    left, right = _matched(ours, other)
    result = xr.Dataset(attrs={"ours": titled(ours), "other": titled(other)})
    for name in names:
        result[name] = (right[name] - left[name]).assign_attrs(
            left[name].attrs, long_name=f"difference of {left[name].attrs.get('long_name', name)}"
        )
    for name in (name for name in bounded if name in names):
        allowed = _unknown(left, name) + _unknown(right, name) + ROUNDING
        result[f"{name}_allowed"] = allowed.assign_attrs(
            units="1", long_name=f"largest difference of {name} within what is known of both"
        )
        result[f"{name}_agrees"] = (abs(result[name]) <= allowed).assign_attrs(
            units="1", long_name=f"whether {name} agrees within what is known of both"
        )
    return result


def titled(store: xr.Dataset | xr.DataTree) -> str:
    """Title and number of a study."""
    return f"{store.attrs.get('title', '')} ({str(store.attrs.get('study_id', ''))[:8]})"


def _unknown(dataset: xr.Dataset, name: str) -> xr.DataArray:
    """How far a probability may be from the true one."""
    parts = [dataset[n] for n in (f"{name}_half_width", "effects_error", "beamlets_error")
             if n in dataset]  # fmt: skip
    return sum((part.fillna(0.0) for part in parts), xr.zeros_like(dataset[name]))


def _matched(ours: xr.Dataset, other: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Both datasets at the points that they share, along dimensions of the same names."""
    other = _at_fixed(other, ours)
    ours = _at_fixed(ours, other)
    for dim in [d for d in ours.dims if d in other.dims]:
        left, right = _places(ours, str(dim)), _places(other, str(dim))
        shared = left.intersection(right, sort=False)
        if not shared.size:
            raise ValueError(f"along {dim} the two studies have no value in common")
        ours = ours.isel({dim: left.get_indexer(shared)})
        other = other.isel({dim: right.get_indexer(shared)})
        # the coordinates of ours stand for both, so that xarray takes no offence at last digits
        other = other.drop_vars([n for n, c in other.coords.items() if dim in c.dims])
        other = other.assign_coords({n: c for n, c in ours.coords.items() if c.dims == (dim,)})
    scalars = [n for n, c in other.coords.items() if not c.dims]
    return ours, other.drop_vars(scalars)


def _at_fixed(dataset: xr.Dataset, reference: xr.Dataset) -> xr.Dataset:
    """A dataset at the values of the parameters that the reference has off its axes."""
    paths = {c.attrs.get("path") for c in reference.coords.values() if c.dims}
    study = study_of(reference)
    for array in list(dataset.coords.values()):
        path = array.attrs.get("path", "")
        if not array.dims or path in paths or array.name not in dataset.dims:
            continue
        value = parameter(reference, path, study).values.item()
        values = si(array).values
        same = values == value if isinstance(value, str) else np.isclose(values, value, 1e-9, 0.0)
        if same.any():
            dataset = dataset.isel({array.name: int(np.argmax(same))})
    return dataset


def _places(dataset: xr.Dataset, dim: str) -> pandas.Index:
    """SI values along a dimension, to 12 digits; of several coordinates together."""
    arrays = [c for c in dataset.coords.values() if c.dims == (dim,)]
    if not arrays:
        return pandas.RangeIndex(dataset.sizes[dim])
    columns = [_rounded(np.asarray(si(c).values)) for c in
               sorted(arrays, key=lambda c: str(c.attrs.get("path", c.name)))]  # fmt: skip
    index = columns[0] if len(columns) == 1 else pandas.MultiIndex.from_arrays(columns)
    index = pandas.Index(index)
    if index.has_duplicates:
        # A point that stands twice along a zipped axis is matched once, with the first of them.
        unique = index.to_frame(index=False)
        unique["again"] = unique.groupby(list(unique.columns)).cumcount()
        index = pandas.MultiIndex.from_frame(unique)
    return index


def _rounded(values: np.ndarray) -> np.ndarray:
    """Numbers to 12 significant digits."""
    if values.dtype.kind not in "fiu":
        return values
    values = values.astype(float)
    with np.errstate(divide="ignore"):
        scale = 10.0 ** (_DIGITS - 1 - np.floor(np.log10(np.abs(np.where(values, values, 1.0)))))
    return np.rint(values * scale) / scale
