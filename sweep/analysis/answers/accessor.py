"""`ds.sweep` and `tree.sweep`: answers from what `sweep.open` and `sweep.open_scene` gave."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.answers import (
    alarms,
    comparison,
    contours,
    errors,
    flight_comparison,
    limits,
    physical,
    probability,
    roc,
    summary,
)
from sweep.spec import SceneSpec, Spec

ONE_OF_EACH = "a grid of points and a flight have nothing to match: compare two of a kind"


@xr.register_dataset_accessor("sweep")
class SweepAccessor:
    """Answers from a store. All but `roc` and `contour` are lazy: `.compute()` works them out.

    Parameters
    ----------
    dataset
        As `sweep.open` gives it, or a part of it.
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    @property
    def spec(self) -> Spec:
        """The study."""
        return physical.spec_of(self._dataset)

    def sel(self, *, method: str | None = None, **coordinates: Any) -> xr.Dataset:
        """Points by physical value: ``ds.sweep.sel(range="2 km", grazing_angle="20 deg")``.

        Parameters
        ----------
        method
            ``nearest``, or none: the value must be on the grid.
        **coordinates
            A value with its unit, a list of them, or a slice (:func:`.physical.select`).

        Raises
        ------
        ValueError
            No such coordinate, a value that cannot be read, or one that is not on the grid.
        """
        return physical.select(self._dataset, coordinates, method=method)

    def detection_probability(self, segment: str = "shot") -> xr.Dataset:
        """Pd with its interval: :func:`.probability.detection_probability`."""
        return probability.detection_probability(self._dataset, segment)

    def roc(
        self,
        pfa: Sequence[float] | np.ndarray | None = None,
        *,
        segment: str = "shot",
        draws: int = 1000,
    ) -> xr.Dataset:
        """Pd over the probability of a false alarm in a bin: :func:`.roc.roc`."""
        return roc.roc(self._dataset, pfa, segment=segment, draws=draws)

    def limit(
        self, along: str, pd: float = 0.9, *, segment: str = "shot", from_highest: bool = False
    ) -> xr.Dataset:
        """How far along any coordinate pd keeps to a level: :func:`.limits.limit`."""
        return limits.limit(self._dataset, along, pd=pd, segment=segment, from_highest=from_highest)

    def maximum_range(self, pd: float = 0.9, *, segment: str = "shot") -> xr.Dataset:
        """Range up to which pd keeps to a level, unbroken and at all: :func:`.limits.limit`."""
        return self.limit("target.range", pd, segment=segment)

    def minimum_grazing_angle(self, pd: float = 0.9, *, segment: str = "shot") -> xr.Dataset:
        """Least grazing angle down to which pd keeps to a level: :func:`.limits.limit`."""
        return self.limit("target.grazing_angle", pd, segment=segment, from_highest=True)

    def contour(
        self, pd: float = 0.9, *, x: str = "range", y: str = "grazing_angle", segment: str = "shot"
    ) -> xr.Dataset:
        """Lines of constant pd over two coordinates: :func:`.contours.contour`."""
        return contours.contour(self._dataset, pd, x=x, y=y, segment=segment)

    def false_alarms_per_second(
        self, rate: str | float | None = None, *, leakage: bool = False
    ) -> xr.DataArray:
        """False alarms a second: :func:`.alarms.false_alarms_per_second`."""
        return alarms.false_alarms_per_second(self._dataset, rate, leakage=leakage)

    def false_alarms_per_kilometre(
        self, speed: str | float, rate: str | float | None = None, *, leakage: bool = False
    ) -> xr.DataArray:
        """False alarms a kilometre of flight: :func:`.alarms.false_alarms_per_kilometre`."""
        return alarms.false_alarms_per_kilometre(self._dataset, speed, rate, leakage=leakage)

    def range_error(self) -> xr.Dataset:
        """Error of range beside its Cramer-Rao bound: :func:`.errors.range_error`."""
        return errors.range_error(self._dataset)

    def velocity_error(self) -> xr.Dataset:
        """Error of radial velocity beside its Cramer-Rao bound: :func:`.errors.velocity_error`."""
        return errors.velocity_error(self._dataset)

    def compare(self, other: xr.Dataset) -> xr.Dataset:
        """Differences from another study: :func:`.comparison.compare`.

        Raises
        ------
        ValueError
            No point is in both; or the other is a flight.
        """
        if not isinstance(other, xr.Dataset):
            raise ValueError(ONE_OF_EACH)
        return comparison.compare(self._dataset, other)

    def summary(self) -> xr.Dataset:
        """Mean, extremes and number of every output: :func:`.summary.summary`."""
        return summary.summary(self._dataset)


@xr.register_datatree_accessor("sweep")
class FlightAccessor:
    """Answers from a flight's store, lazy but for the matching of shots.

    Parameters
    ----------
    tree
        As `sweep.open_scene` gives it.
    """

    def __init__(self, tree: xr.DataTree) -> None:
        self._tree = tree

    @property
    def spec(self) -> Spec | SceneSpec:
        """The study."""
        return physical.study_of(self._tree)

    def compare(self, other: xr.DataTree) -> xr.DataTree:
        """Differences from another flight, shot by shot: :func:`.flight_comparison.compare`.

        Raises
        ------
        ValueError
            No shot is in both; or the other is a grid.
        """
        if not isinstance(other, xr.DataTree):
            raise ValueError(ONE_OF_EACH)
        return flight_comparison.compare(self._tree, other)
