"""`ds.sweep` and `tree.sweep`: answers from what `sweep.open` and `sweep.open_scene` gave."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import dask.array
import numpy as np
import xarray as xr
from contourpy import contour_generator
from scipy.special import ndtri

from sweep.analysis.answers import (
    alarms,
    comparison,
    errors,
    flight_comparison,
    limits,
    physical,
    probability,
    roc,
)
from sweep.analysis.answers.limits import deviate
from sweep.analysis.answers.physical import coordinate
from sweep.analysis.answers.probability import named
from sweep.spec import SceneSpec, Spec

STATISTICS = ("mean", "least", "largest", "number")


def summarised(dataset: xr.Dataset) -> xr.Dataset:
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


def contour(
    dataset: xr.Dataset,
    pd: float = 0.9,
    *,
    x: str = "range",
    y: str = "grazing_angle",
    segment: str = "shot",
) -> xr.Dataset:
    """Lines along which the probability of detection is at a level.

    Parameters
    ----------
    dataset
        As `sweep.open` gives it; of any dimension other than the two one value selected.
    pd
        The level, 0 < pd < 1.
    x, y
        Coordinates, each with a dimension of its own.
    segment
        ``shot``, ``up``, ``doppler`` or ``down``.

    Returns
    -------
    xarray.Dataset
        Over `vertex`: the two coordinates in their units, and `line`, the number of the line that
        the vertex is of, in order along it; none where pd is nowhere at the level. Between the
        grid's points, places are interpolated as :mod:`sweep.analysis.answers.limits` does.

    Raises
    ------
    ValueError
        A coordinate that is not there, or further dimensions.
    """
    if not 0 < pd < 1:
        raise ValueError(f"a level of pd lies between 0 and 1, and {pd!r} does not")
    across, up = coordinate(dataset, x), coordinate(dataset, y)
    array = dataset[named("pd", segment)]
    if set(array.dims) != {across.name, up.name}:
        others = ", ".join(str(d) for d in array.dims if d not in (across.name, up.name))
        raise ValueError(
            f"a contour goes over {across.name} and {up.name} as dimensions: "
            + (f"select one value along {others}" if others else "they share one, or lack it")
        )
    z = deviate(array, dataset.get(named("miss", segment))).transpose(up.name, across.name)
    found = contour_generator(
        across.values, up.values, np.ma.masked_invalid(z.values)
    ).lines(float(ndtri(pd)))  # fmt: skip
    lines = [np.asarray(line) for line in found]
    vertices = np.concatenate(lines) if lines else np.empty((0, 2))
    numbers = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    return xr.Dataset(
        {
            str(across.name): ("vertex", vertices[:, 0], across.attrs),
            str(up.name): ("vertex", vertices[:, 1], up.attrs),
            "line": ("vertex", numbers, {"units": "1", "long_name": "number of the line"}),
        },
        attrs=dataset.attrs,
    )


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
        """Lines of constant pd over two coordinates: :func:`contour`."""
        return contour(self._dataset, pd, x=x, y=y, segment=segment)

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
        """Mean, extremes and number of every output: :func:`summarised`."""
        return summarised(self._dataset)


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
