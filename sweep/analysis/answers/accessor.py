"""`ds.sweep` and `tree.sweep`: answers from what `sweep.open` and `sweep.open_scene` gave."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import xarray as xr

from sweep.analysis.answers import comparison, errors, limits, physical, probability
from sweep.spec import SceneSpec, Spec

ONE_OF_EACH = "a grid of points and a flight have nothing to match: compare two of a kind"


def _of_dataset(answer: Callable[..., Any]) -> Callable[..., Any]:
    """A function of a dataset as a method, with its words and arguments."""

    @wraps(answer)
    def method(self: SweepAccessor, *given: Any, **options: Any) -> Any:
        return answer(self._dataset, *given, **options)

    return method


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

    detection_probability = _of_dataset(probability.detection_probability)
    roc = _of_dataset(probability.roc)
    limit = _of_dataset(limits.limit)
    contour = _of_dataset(limits.contour)
    false_alarms_per_second = _of_dataset(probability.false_alarms_per_second)
    false_alarms_per_kilometre = _of_dataset(probability.false_alarms_per_kilometre)
    range_error = _of_dataset(errors.range_error)
    velocity_error = _of_dataset(errors.velocity_error)
    summary = _of_dataset(probability.summary)

    def maximum_range(self, pd: float = 0.9, *, segment: str = "shot") -> xr.Dataset:
        """Range up to which pd keeps to a level, unbroken and at all: :func:`.limits.limit`."""
        return limits.limit(self._dataset, "target.range", pd, segment=segment)

    def minimum_grazing_angle(self, pd: float = 0.9, *, segment: str = "shot") -> xr.Dataset:
        """Least grazing angle down to which pd keeps to a level: :func:`.limits.limit`."""
        return limits.limit(
            self._dataset, "target.grazing_angle", pd, segment=segment, from_highest=True
        )

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
        """Differences from another flight, shot by shot: :func:`.comparison.compare_flights`.

        Raises
        ------
        ValueError
            No shot is in both; or the other is a grid.
        """
        if not isinstance(other, xr.DataTree):
            raise ValueError(ONE_OF_EACH)
        return comparison.compare_flights(self._tree, other)
