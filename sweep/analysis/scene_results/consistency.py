"""Comparison of a flight's actual errors with the standard errors that it states.

A flight's store contains the truth. Errors of true points divided by their standard errors should
have a size of about 1. The same holds for errors of velocity and altitude relative to their
covariances. Far larger ratios come from effects that the standard errors do not include, such as
unstated relief or speckle.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import xarray as xr

from sweep.model.pointcloud.navigation import STATUS_EXCLUDED
from sweep.model.pointcloud.pairing import TRUE_RETURN_FLAG
from sweep.storage.locations import Location

CONSISTENT_ERROR_RATIO_MAX = 2.0
"""Largest ratio of actual errors to stated standard errors at which they count as consistent."""

_ERRORS_FOR_JUDGEMENT_MIN = 20
"""Least number of errors from which their consistency with standard errors is judged."""

_SAMPLED_SHOTS_MAX, _SAMPLED_DRAWS_MAX, _SAMPLED_VALUES_PER_AXIS_MAX = 1 << 15, 16, 6
"""Largest numbers of shots, of draws, and of values per axis from which errors are read."""

_N_SAMPLED_FLIGHT_INTERVALS = 16
"""Number of evenly spaced intervals of a long flight from which errors are read."""

_COMPARED_QUANTILE_LEVELS = 0.6827, 0.9545
"""Levels, 0..1, of the quantiles in which actual and normally distributed errors are compared."""

_SCALAR_NORMAL_ERROR_QUANTILES, _VECTOR_NORMAL_ERROR_QUANTILES = (1.0, 2.0), (1.8780, 2.8328)
"""Quantiles at 68.27 % and 95.45 % of the length of a normal error, in standard errors.

The first pair is for a number, the second for a vector of three components.
"""


_LIKELY_CAUSE_BY_QUANTITY = {
    "range": "Ground steeper than navigation.terrain_slope, or targets that move otherwise than "
    "navigation.target_speed and target_acceleration state, may be the cause.",
    "radial velocity": "Targets that move otherwise than navigation.target_speed and "
    "target_acceleration state may be the cause.",
    "altitude": "Relief other than navigation.relief states may be the cause.",
}
"""Sentence on the likely cause of errors far larger than stated, by the quantity's name."""


class ConsistencyResult(NamedTuple):
    """Ratio of a quantity's errors to their stated standard errors, for one scanner."""

    scanner: str
    """Name of the scanner."""
    quantity: str
    """Name of the quantity, as in messages."""
    error_ratio: float
    """Ratio of the actual errors to their stated standard errors; ideally 1."""
    n_errors: int
    """Number of errors that were read."""

    @property
    def is_consistent(self) -> bool:
        """True if errors are about as large as stated, or too few to judge."""
        return (
            self.n_errors < _ERRORS_FOR_JUDGEMENT_MIN
            or not self.error_ratio > CONSISTENT_ERROR_RATIO_MAX
        )

    @property
    def message(self) -> str:
        """Sentence that states the ratio of actual to stated errors, and the likely cause."""
        return (
            f"{self.scanner}: {self.quantity} is inconsistent: residuals are "
            f"{self.error_ratio:.3g} "
            f"times the stated errors. {_LIKELY_CAUSE_BY_QUANTITY.get(self.quantity, '')}".rstrip()
        )


def check_error_consistency(tree: xr.DataTree) -> list[ConsistencyResult]:
    """Return the ratios of actual to stated errors for each scanner and quantity of a flight.

    Parameters
    ----------
    tree
        Tree of `sweep.open_scene`. Only evenly spaced parts of a long flight are read.

    Returns
    -------
    list of ConsistencyResult
        Results for range and radial velocity of true points, and for velocity and altitude if the
        scanner navigates.

    Notes
    -----
    The size of an error is relative to its standard error. For a velocity vector it is the
    Mahalanobis distance by the stated covariance. At 68.27 % and at 95.45 %, the quantile of these
    sizes is divided by the quantile for normal errors; the ratio is the larger quotient.
    """
    results = []
    for scanner in map(str, tree.attrs["scanners"]):
        errors_by_sample = [
            _normalised_errors(sample)
            for sample in _iter_flight_samples(tree[scanner].to_dataset())
        ]
        for quantity in dict.fromkeys(key for sample in errors_by_sample for key in sample):
            normalised_errors = np.concatenate(
                [sample[quantity] for sample in errors_by_sample if quantity in sample]
            )
            error_ratio = float("nan")
            if normalised_errors.size:
                reference_quantiles = (
                    _VECTOR_NORMAL_ERROR_QUANTILES
                    if quantity == _VELOCITY_QUANTITY
                    else _SCALAR_NORMAL_ERROR_QUANTILES
                )
                error_ratio = np.max(
                    np.quantile(normalised_errors, _COMPARED_QUANTILE_LEVELS) / reference_quantiles
                )
            results.append(
                ConsistencyResult(scanner, quantity, float(error_ratio), normalised_errors.size)
            )
    return results


def understated_error_messages(store: str | Location, scanner: str | None = None) -> list[str]:
    """Return a sentence for each quantity of a store whose errors are far larger than stated.

    ``scanner`` is the only scanner to check; None stands for all. Raise NotAStoreError if the store
    is not that of a flight.
    """
    from sweep.analysis.datasets import open_scene_tree
    from sweep.storage.locations import parse_location

    tree = open_scene_tree(parse_location(store))
    if "scanners" not in tree.attrs:
        return []
    return [
        result.message
        for result in check_error_consistency(tree)
        if not result.is_consistent and scanner in (None, result.scanner)
    ]


def _iter_flight_samples(group: xr.Dataset) -> Iterator[xr.Dataset]:
    """Yield parts of a scanner's arrays as datasets in memory.

    A short flight is one part. The parts of a long flight are evenly spaced intervals.
    """
    n_shots, shots_per_cycle = group.sizes["shot"], int(group.attrs["shots_a_cycle"])
    axis_indices = {
        str(dim): np.unique(
            np.linspace(0, size - 1, min(size, _SAMPLED_VALUES_PER_AXIS_MAX)).astype(int)
        )
        for dim, size in group["pd_shot"].sizes.items()
        if dim != "shot"
    }
    group = group.isel({"draw": slice(_SAMPLED_DRAWS_MAX), **axis_indices})
    n_cycles = n_shots // shots_per_cycle
    n_sampled_cycles = min(n_cycles, max(1, _SAMPLED_SHOTS_MAX // shots_per_cycle))
    n_intervals = 1 if n_sampled_cycles == n_cycles else _N_SAMPLED_FLIGHT_INTERVALS
    cycles_per_interval = max(1, n_sampled_cycles // n_intervals)
    for first_cycle in np.unique(
        np.linspace(0, n_cycles - cycles_per_interval, n_intervals).astype(int)
    ).tolist():
        sample = group.isel(
            shot=slice(
                first_cycle * shots_per_cycle, (first_cycle + cycles_per_interval) * shots_per_cycle
            )
        )
        if "cycle" in sample.dims:
            sample = sample.isel(cycle=slice(first_cycle, first_cycle + cycles_per_interval))
        variables = [name for name in _CONSISTENCY_VARIABLES if name in sample]
        yield sample[variables].load()


_VELOCITY_QUANTITY = "velocity"
"""Name, in messages, of the velocity vector that navigation computes."""
_VARIABLE_BY_QUANTITY = {"range": "range", "radial velocity": "radial_velocity"}
"""Stored variable of each measured quantity, by the quantity's name in messages."""

_CONSISTENCY_VARIABLES = (
    "flags",
    "velocity",
    "velocity_covariance",
    "velocity_status",
    "true_velocity",
    "altitude",
    "altitude_variance",
    "altitude_status",
    "true_altitude",
    *(
        f"{q}_interpolated{end}"
        for q in _VARIABLE_BY_QUANTITY.values()
        for end in ("", "_standard_error")
    ),
    *(f"true_{q}" for q in _VARIABLE_BY_QUANTITY.values()),
)
"""Names of the stored variables that are read to compare actual with stated errors."""


def _normalised_errors(sample: xr.Dataset) -> Mapping[str, np.ndarray]:
    """Return finite errors over their standard errors, as magnitudes (n,) by quantity."""
    is_true = (sample["flags"] & TRUE_RETURN_FLAG).values > 0
    errors_by_quantity: dict[str, np.ndarray] = {}
    for quantity, variable in _VARIABLE_BY_QUANTITY.items():
        reported = sample[f"{variable}_interpolated"].values[is_true]
        error = np.abs(reported - sample[f"true_{variable}"].values[is_true])
        standard_error = sample[f"{variable}_interpolated_standard_error"].values[is_true]
        # Interpolation between bins is accurate to about 1e-9 of the value.
        errors_by_quantity[quantity] = _finite_values(
            error / np.maximum(standard_error, 1e-9 * np.abs(reported))
        )
    if "velocity" in sample:
        is_solved = _solved_mask(sample["velocity_status"])
        dims = (*sample["velocity_status"].dims, "xyz")
        error = (sample["velocity"] - sample["true_velocity"]).transpose(*dims).values[is_solved]
        covariance = sample["velocity_covariance"].values[is_solved]
        errors_by_quantity[_VELOCITY_QUANTITY] = _mahalanobis_distances(error, covariance)
        is_solved = _solved_mask(sample["altitude_status"])
        dims = sample["altitude_status"].dims
        altitude_error = (
            (sample["altitude"] - sample["true_altitude"]).transpose(*dims).values[is_solved]
        )
        errors_by_quantity["altitude"] = _finite_values(
            np.abs(altitude_error) / np.sqrt(sample["altitude_variance"].values[is_solved])
        )
    return errors_by_quantity


def _solved_mask(status: xr.DataArray) -> np.ndarray:
    """Return a mask of the navigation attempts that gave a solution, from their status.

    A negative status means that the solution is not computed yet.
    """
    return ((status >= 0) & (status <= STATUS_EXCLUDED)).values


def _mahalanobis_distances(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the Mahalanobis distances of vectors (n, 3) by their covariances (n, 3, 3).

    Vectors with a non-finite component or covariance are left out.
    """
    is_finite = np.isfinite(error).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    error, covariance = error[is_finite], covariance[is_finite]
    inverse_covariance = np.linalg.pinv(covariance, hermitian=True)
    chi_square = np.einsum("ni,nij,nj->n", error, inverse_covariance, error)
    return np.asarray(np.sqrt(np.maximum(chi_square, 0.0)))


def _finite_values(values: np.ndarray) -> np.ndarray:
    """Return the finite values of an array, (n,)."""
    return values[np.isfinite(values)]
