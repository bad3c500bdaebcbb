"""Errors against standard errors of a flight, by the truth in its store.

A flight's store has the truth. Errors of its true points over their standard errors, and errors of
velocity and altitude over their covariances, should be of size 1. Far larger ones
come from effects that the standard errors leave out, such as unstated relief or speckle.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import xarray as xr

from sweep.model.navigation import EXCLUDED
from sweep.model.pairing import TRUE
from sweep.storage.locations import Location

LARGEST_RATIO = 2.0
"""Errors over standard errors that still count as consistent."""

_LEAST_NUMBER = 20
"""Errors that must be there to be judged."""

_SAMPLED_SHOTS, _SAMPLED_DRAWS, _SAMPLED_PLACES = 1 << 15, 16, 6
"""Shots, draws, and places along each axis that are looked at, evenly apart if there are more."""

_SAMPLED_PARTS = 16
"""Parts along a flight that are read of a long one."""

_SHARES = 0.6827, 0.9545
"""Shares of errors whose size is held against that of normal errors."""

_NORMAL, _VECTOR = (1.0, 2.0), (1.8780, 2.8328)
"""Multiples of the standard error that hold these shares, of a number and of a vector of three."""


_REMEDIES = {
    "range": "Ground steeper than navigation.terrain_slope, or targets that move otherwise than "
    "navigation.target_speed and target_acceleration state, may be the cause.",
    "radial velocity": "Targets that move otherwise than navigation.target_speed and "
    "target_acceleration state may be the cause.",
    "altitude": "Relief other than navigation.relief states may be the cause.",
}
"""What may lie behind errors far larger than stated, by quantity."""


class Consistency(NamedTuple):
    """Errors of one quantity of a scanner over the standard errors that are stated."""

    scanner: str
    quantity: str
    ratio: float
    """Errors over what normal errors of the stated size would be; 1 where they are true."""
    number: int
    """Errors that were looked at."""

    @property
    def is_consistent(self) -> bool:
        """Tell whether errors are about as large as stated, or too few to say."""
        return self.number < _LEAST_NUMBER or not self.ratio > LARGEST_RATIO

    @property
    def words(self) -> str:
        """Sentence on errors that are far larger than stated."""
        return (
            f"{self.scanner}: {self.quantity} is inconsistent: residuals are {self.ratio:.3g} "
            f"times the stated errors. {_REMEDIES.get(self.quantity, '')}".rstrip()
        )


def consistency(tree: xr.DataTree) -> list[Consistency]:
    """Return the ratio of errors to standard errors of each scanner and quantity of a flight."""
    found = []
    for name in map(str, tree.attrs["scanners"]):
        parts = [_scores(part) for part in _sample(tree[name].to_dataset())]
        for quantity in dict.fromkeys(key for part in parts for key in part):
            scores = np.concatenate([part[quantity] for part in parts if quantity in part])
            ratio = float("nan")
            if scores.size:
                holding = _VECTOR if quantity == _VELOCITY else _NORMAL
                ratio = np.max(np.quantile(scores, _SHARES) / holding)
            found.append(Consistency(name, quantity, float(ratio), scores.size))
    return found


def inconsistencies(store: str | Location, scanner: str | None = None) -> list[str]:
    """Return a sentence for each quantity whose errors are far larger than the store states.

    Of one scanner, or of all; none for a grid's store.
    """
    from sweep.analysis.opening import opened
    from sweep.storage.locations import located

    tree = opened(located(store))
    if "scanners" not in tree.attrs:
        return []
    return [
        result.words
        for result in consistency(tree)
        if not result.is_consistent and scanner in (None, result.scanner)
    ]


def _sample(group: xr.Dataset) -> Iterator[xr.Dataset]:
    """Parts of a scanner's arrays, in memory: all of a small one, or parts evenly along it."""
    shots, cycle = group.sizes["shot"], int(group.attrs["shots_a_cycle"])
    places = {
        str(dim): np.unique(np.linspace(0, size - 1, min(size, _SAMPLED_PLACES)).astype(int))
        for dim, size in group["pd_shot"].sizes.items()
        if dim != "shot"
    }
    group = group.isel({"draw": slice(_SAMPLED_DRAWS), **places})
    cycles = shots // cycle
    long = min(cycles, max(1, _SAMPLED_SHOTS // cycle))
    number = 1 if long == cycles else _SAMPLED_PARTS
    each = max(1, long // number)
    for first in np.unique(np.linspace(0, cycles - each, number).astype(int)).tolist():
        part = group.isel(shot=slice(first * cycle, (first + each) * cycle))
        if "cycle" in part.dims:
            part = part.isel(cycle=slice(first, first + each))
        names = [name for name in _NEEDED if name in part]
        yield part[names].load()


_VELOCITY = "velocity"
_QUANTITIES = {"range": "range", "radial velocity": "radial_velocity"}
_NEEDED = (
    "flags", "velocity", "velocity_covariance", "velocity_status", "true_velocity", "altitude",
    "altitude_variance", "altitude_status", "true_altitude",
    *(f"{q}_interpolated{end}" for q in _QUANTITIES.values() for end in ("", "_standard_error")),
    *(f"true_{q}" for q in _QUANTITIES.values()),
)  # fmt: skip


def _scores(part: xr.Dataset) -> Mapping[str, np.ndarray]:
    """Return the errors over standard errors by quantity, without sign; only those there are."""
    true = (part["flags"] & TRUE).values > 0
    found: dict[str, np.ndarray] = {}
    for words, name in _QUANTITIES.items():
        reported = part[f"{name}_interpolated"].values[true]
        error = np.abs(reported - part[f"true_{name}"].values[true])
        stated = part[f"{name}_interpolated_standard_error"].values[true]
        # A millionth of the value is what interpolation between bins is good to.
        found[words] = _finite(error / np.maximum(stated, 1e-9 * np.abs(reported)))
    if "velocity" in part:
        solved = _solved(part["velocity_status"])
        dims = (*part["velocity_status"].dims, "xyz")
        error = (part["velocity"] - part["true_velocity"]).transpose(*dims).values[solved]
        covariance = part["velocity_covariance"].values[solved]
        found[_VELOCITY] = _vector_scores(error, covariance)
        solved = _solved(part["altitude_status"])
        dims = part["altitude_status"].dims
        height = (part["altitude"] - part["true_altitude"]).transpose(*dims).values[solved]
        found["altitude"] = _finite(
            np.abs(height) / np.sqrt(part["altitude_variance"].values[solved])
        )
    return found


def _solved(status: xr.DataArray) -> np.ndarray:
    """Return the mask of solutions that there are; -1 stands for those not computed yet."""
    return ((status >= 0) & (status <= EXCLUDED)).values


def _vector_scores(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the lengths of vectors (n, 3) in standard errors, by their covariances (n, 3, 3)."""
    known = np.isfinite(error).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    error, covariance = error[known], covariance[known]
    weight = np.linalg.pinv(covariance, hermitian=True)
    chi_square = np.einsum("ni,nij,nj->n", error, weight, error)
    return np.asarray(np.sqrt(np.maximum(chi_square, 0.0)))


def _finite(scores: np.ndarray) -> np.ndarray:
    return scores[np.isfinite(scores)]
