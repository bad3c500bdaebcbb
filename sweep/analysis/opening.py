"""Stores as xarray Datasets and DataTrees; `ds.sweep` and `tree.sweep`, answers from them."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from functools import wraps
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.answers import comparison, errors, limits, physical, probability
from sweep.model.outputs import RUNNING
from sweep.spec import SceneSpec, Spec
from sweep.storage import logs, opening
from sweep.storage.locations import JOURNAL, Location, located
from sweep.storage.logs import read_lines, read_receipts
from sweep.storage.opening import CHECKED, NotAStoreError, readable

BATCH = "batch"
PIECE = 2**20
"""Values of an array that are read at a time: few enough for any memory, and enough that Dask's
list of what is to be read stays short (some 7 kB a piece; a piece of floats has 8 MB)."""

STRETCH = 8192
"""Shots, times draws, that are read at a time."""

NOT_COUNTED = -1
"""Value of a count in a block that is not computed."""

GRID, SCENE, ACCURACY = "grid", "scene", "accuracy"
_HOLDS = {
    GRID: "a grid of points: sweep.open() opens it",
    SCENE: "a scene's point clouds: sweep.open_scene() opens it",
    ACCURACY: "what accuracy costs: xarray.open_zarr() opens it, sweep figures draws it",
    "eyepoints": "the eyepoints of a flight, which point clouds are made of: open one of those",
}
"""Contents of the kinds of stores, and the functions that open them."""


def open(path: str | Location) -> xr.Dataset:
    """Open the store of a study as a dataset.

    Dimensions bear the names of the study's axes, coordinates are in the units that the study was
    written in, and every variable has its units and what it is. Arrays are read when they are
    needed, as Dask arrays in pieces of whole chunks of the store. Points not computed yet are nan;
    -1 for counts of draws, which are summed over their batches, and for their number `n_draws`.

    Parameters
    ----------
    path
        The store, complete or not.

    Returns
    -------
    xarray.Dataset
        Its attributes are the store's and: `started`, `finished` (UTC; empty where there is
        nothing to tell), `points`, `points_committed`, `blocks` and `blocks_committed`.

    Raises
    ------
    NotAStoreError
        Where there is no store of a study, or one whose coordinates are lost or damaged.
    ReplacedError
        Later, where values are read that are not read yet, and another study's store is in the
        place by then: the store was extended, or run anew.
    """
    path = located(path)
    study = read_attributes(path, GRID)
    refuse_lost(path)
    dataset = xr.open_zarr(readable(path, study["study_id"]), chunks=None, **CHECKED)
    points = dataset["effects"]
    blocks = _blocks(points)
    dataset = in_pieces(dataset.drop_vars(RUNNING, errors="ignore"))
    if BATCH in dataset.dims:
        dataset = merged(dataset)
    dataset = dataset.assign_coords({name: c.compute() for name, c in dataset.coords.items()})
    return dataset.assign_attrs(progress(path, points.size, blocks))


def open_scene(path: str | Location) -> xr.DataTree:
    """Open the store of a scene's point clouds as a tree: a group for each scanner.

    Arrays are read when they are needed, as Dask arrays in the chunks of the store. Values not
    computed yet are nan, -1 for numbers of beams, surfaces and cycles, 0 for flags.

    Parameters
    ----------
    path
        The store, complete or not.

    Returns
    -------
    xarray.DataTree
        Its attributes are the store's and: `started`, `finished` (UTC; empty where there is
        nothing to tell), `points`, `points_committed` (shots times draws), `blocks` and
        `blocks_committed`.

    Raises
    ------
    NotAStoreError
        Where there is no store of a scene.
    """
    return opened(located(path), chunks={})


def opened(path: Location, chunks: dict[str, int] | None = None) -> xr.DataTree:
    """As :func:`open_scene`; without chunks, arrays are plain ones that are read where sliced."""
    attributes = read_attributes(path, SCENE)
    refuse_lost(path)
    store = readable(path, attributes["study_id"])
    tree = xr.open_datatree(store, engine="zarr", chunks=chunks, **CHECKED)
    tree.encoding["source"] = str(path)
    flags = [tree[scanner].to_dataset()["flags"] for scanner in attributes["scanners"]]
    points = sum(int(own.size) // own.sizes["return_number"] for own in flags)
    blocks = sum(_blocks(own) for own in flags)
    tree.attrs |= progress(path, points, blocks)
    return tree


def _blocks(array: xr.DataArray) -> int:
    """Return the number of chunks that an array is stored in."""
    return math.prod(map(math.ceil, np.divide(array.shape, array.encoding["chunks"])))


def chunk(array: xr.DataArray, dim: str) -> int:
    """Length along a dimension of the chunks that an array is stored in."""
    return int(array.encoding.get("preferred_chunks", {}).get(dim, array.sizes[dim]))


def stretches(array: xr.DataArray, dim: str, size: int = STRETCH) -> list[slice]:
    """Slices along a dimension: whole chunks of the array in each, and few of them."""
    number, cut = array.sizes[dim], chunk(array, dim)
    step = cut * max(1, size // cut)
    return [slice(first, min(first + step, number)) for first in range(0, number, step)]


def refuse_lost(path: Location) -> None:
    """Refuse a store whose coordinates are lost or changed; of a lost one Zarr reads zeros."""
    document = opening.read_document(path)
    nodes = {"": document, **document["consolidated_metadata"]["metadata"]}
    names = set()
    for name, node in nodes.items():
        inside, own = name, node["attributes"].get("coordinates", "").split()
        if "dimension_names" in node:
            inside, own = name.rpartition("/")[0], node["dimension_names"]
        names |= {f"{inside}/{each}".lstrip("/") for each in own}
    for record in read_lines(path / JOURNAL / opening.MANIFEST):
        name = record.get("object", "")
        if f"{name}/".partition("/c/")[0] in names:
            with suppress(OSError):
                if logs.digest(path, [name]) == record["digest"]:
                    continue
            raise NotAStoreError(
                f"{path} has lost {name}, of a coordinate: `sweep verify {path} --repair` puts "
                "it back"
            )


def read_attributes(path: Location, kind: str = "") -> dict[str, Any]:
    """Attributes of a store, which must hold a ``grid`` or a ``scene`` where that is asked for."""
    attributes = opening.read_attributes(path)
    if kind and attributes["kind"] != kind:
        raise NotAStoreError(f"{path} holds {_HOLDS[attributes['kind']]}")
    return attributes


def in_pieces(dataset: xr.Dataset) -> xr.Dataset:
    """Arrays that are read where they are sliced as Dask arrays, in pieces of whole stored chunks.

    A piece has no more than `PIECE` values, or is one chunk where that has more. It grows
    along the last dimension first, in which values lie next to each other.
    """
    largest = max(dataset.data_vars.values(), key=lambda array: array.ndim)
    pieces = dict(zip(largest.dims, largest.encoding["chunks"], strict=True))
    for dim in reversed(largest.dims):
        room = PIECE // math.prod(pieces.values())
        pieces[dim] = min(largest.sizes[dim], pieces[dim] * max(1, room))
    return dataset.chunk(pieces)


def merged(dataset: xr.Dataset) -> xr.Dataset:
    """Sum counts of draws over their batches; -1 if any of these is."""
    counts = {name: array for name, array in dataset.data_vars.items() if BATCH in array.dims}
    sums = {
        name: array.sum(BATCH, keep_attrs=True).where(
            (array != NOT_COUNTED).all(BATCH), NOT_COUNTED
        )
        for name, array in counts.items()
    }
    return dataset.drop_dims(BATCH).assign(sums)


def progress(path: Location, points: int, blocks: int) -> dict[str, Any]:
    """Return times and amount of what is committed of all points and blocks, as attributes."""
    receipts = read_receipts(path, blocks)
    sessions = read_lines(path / JOURNAL / "sessions.jsonl")
    started = [s["time"] for s in sessions if s.get("event") == "begun" and "time" in s]
    started += [receipts.first] if receipts.blocks and not started else []
    return {
        "started": _utc(min(started)) if started else "",
        "finished": _utc(receipts.last) if receipts.blocks >= blocks else "",
        "points": points,
        "points_committed": int(receipts.points.sum()),
        "blocks": blocks,
        "blocks_committed": receipts.blocks,
    }


def _utc(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).isoformat(timespec="seconds")


ONE_OF_EACH = "a grid of points and a flight have nothing to match: compare two of a kind"


def _of_dataset(answer: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of a dataset as a method, with its words and arguments."""

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
