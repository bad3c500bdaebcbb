"""Stores as xarray Datasets and DataTrees; `ds.sweep` and `tree.sweep`, answers from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import wraps
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.answers import (
    comparison,
    errors,
    limits,
    physical,
    probability,
    provenance,
)
from sweep.analysis.answers.physical import STUDY_ID, marker_of
from sweep.messages import suggestion
from sweep.model.outputs import RUNNING
from sweep.spec import SceneSpec, Spec
from sweep.storage import opening
from sweep.storage.locations import JOURNAL, Location, located
from sweep.storage.opening import (
    CHECKED,
    MAP,
    NotAStoreError,
    read_lines,
    read_receipts,
    versions_text,
)
from sweep.storage.sound import readable

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


def open(
    path: str | Location | Sequence[str | Location] | Mapping[str, str | Location],
    *,
    dim: str = "design",
) -> xr.Dataset:
    """Open the store of a study as a dataset, or those of several as one, a design each.

    Dimensions bear the names of the study's axes, coordinates are in the units that the study was
    written in, and every variable has its units and what it is. Arrays are read when they are
    needed, as Dask arrays in pieces of whole chunks of the store. Points not computed yet are nan;
    -1 for counts of draws, which are summed over their batches, and for their number `n_draws`.

    Parameters
    ----------
    path
        The store, complete or not. A list of stores, or a mapping from names of designs to stores,
        is joined along a new dimension; designs of a list are named by the titles of their studies.
        Answers of `ds.sweep` from the result are per design, from each design's own spec.
    dim
        Name of that dimension.

    Returns
    -------
    xarray.Dataset
        Its coordinate `study_id` is the id of the study. With the marker, a coordinate named by
        that id, it proves to `ds.sweep` that a part of the dataset is of one study. Its
        attributes are the store's and: `started`, `finished` (UTC; empty where there is nothing to
        tell), `points`, `points_committed`, `blocks` and `blocks_committed`.

    Raises
    ------
    NotAStoreError
        Where there is no store of a study, or one whose coordinates are lost or damaged.
    ReplacedError
        Later, where values are read that are not read yet, and another study's store is in the
        place by then: the store was extended, or run anew.
    ValueError
        Studies that can't be joined: `dim` is taken, one comes twice, or zipped axes differ.

    Examples
    --------
    >>> ds = sweep.open({"25 mm": "small.zarr", "50 mm": "large.zarr"})  # doctest: +SKIP
    >>> ds.sweep.maximum_range(pd=0.9).unbroken                          # doctest: +SKIP
    """
    if isinstance(path, Mapping) and path:
        return provenance.joined({str(name): open(store) for name, store in path.items()}, dim)
    if isinstance(path, Sequence | Mapping) and not isinstance(path, str):
        return provenance.joined(_by_title([open(store) for store in path]), dim)
    path = located(path)
    study = read_attributes(path, GRID)
    refuse_lost(path)
    dataset = xr.open_zarr(readable(path, study["study_id"]), chunks=None, **CHECKED)
    points = dataset["effects"]
    blocks = _blocks(points)
    dataset = in_pieces(dataset.drop_vars(RUNNING, errors="ignore"))
    if BATCH in dataset.dims:
        dataset = merged(dataset)
    dataset = _with_study_id(_with_plain_words(dataset), study["study_id"])
    return dataset.assign_attrs(progress(path, points.size, blocks))


def _by_title(datasets: Sequence[xr.Dataset]) -> dict[str, xr.Dataset]:
    """Return datasets by the titles of their studies, with the ids of those that share a title."""
    titles = [str(dataset.attrs["title"]) for dataset in datasets]
    named = {
        comparison.titled(dataset) if titles.count(title) > 1 else title: dataset
        for title, dataset in zip(titles, datasets, strict=True)
    }
    if not named:
        raise ValueError("the list of stores to join is empty: name two or more")
    if len(named) < len(datasets):
        raise ValueError("the list of stores to join has one study twice: leave one out")
    return named


def _with_plain_words(dataset: xr.Dataset) -> xr.Dataset:
    """Load coordinates, words as numpy's own type of text, which xarray plots and writes."""
    loaded = {name: array.compute() for name, array in dataset.coords.items()}
    return dataset.assign_coords({
        name: array.copy(data=np.array(array.values.tolist(), str))
        if array.dtype.kind in "OT" else array
        for name, array in loaded.items()
    })  # fmt: skip


def _with_study_id(dataset: xr.Dataset, identity: str) -> xr.Dataset:
    """Return a dataset with its study's id and marker as coordinates, and flat attributes."""
    about = {"long_name": "id of the study"}
    marks = {"long_name": "marker of the study, which shows where another's points join"}
    dataset = dataset.assign_coords({
        STUDY_ID: xr.DataArray(identity, attrs=about),
        marker_of([identity]): xr.DataArray(True, attrs=marks),
    })  # fmt: skip
    return dataset.assign_attrs({name: versions_text(v) for name, v in dataset.attrs.items()})


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
    whole = xr.open_datatree(store, engine="zarr", chunks=chunks, **CHECKED)
    groups = {name: group.to_dataset(inherit=False) for name, group in whole.children.items()}
    root = whole.to_dataset()
    if _OLD_MAP.keys() <= root.variables.keys():  # where earlier versions have it
        groups[MAP] = root[list(_OLD_MAP)].rename(_OLD_MAP)
        root = root.drop_vars(list(_OLD_MAP))
    for name in attributes["scanners"]:
        groups[name] = _with_study_id(_with_plain_words(groups[name]), attributes["study_id"])
    tree = xr.DataTree.from_dict({"/": _with_study_id(root, attributes["study_id"]), **groups})
    tree.encoding["source"] = str(path)
    flags = [tree[scanner].to_dataset()["flags"] for scanner in attributes["scanners"]]
    points = sum(int(own.size) // own.sizes["return_number"] for own in flags)
    blocks = sum(_blocks(own) for own in flags)
    tree.attrs |= progress(path, points, blocks)
    return tree


_OLD_MAP = {"map_x": "x", "map_y": "y", "map_height": "height"}
"""Names of the scene's map in the root of stores of earlier versions, and in its group."""


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
                if opening.has_digest(path, [name], record["digest"]):
                    continue
            raise NotAStoreError(
                f"{path} has lost {name}, of a coordinate: "
                f"{suggestion('verify', path, repair=True)} puts it back"
            )


def read_attributes(path: Location, kind: str = "") -> dict[str, Any]:
    """Attributes of a store, which must hold a ``grid`` or a ``scene`` where that is asked for."""
    attributes = opening.read_attributes(path)
    if kind and attributes["kind"] != kind:
        raise NotAStoreError(f"{path} holds {_HOLDS[attributes['kind']]}")
    return attributes


def in_pieces(dataset: xr.Dataset) -> xr.Dataset:
    """Arrays as Dask arrays, in pieces of whole stored chunks of no more than `PIECE` values.

    A piece grows along the last dimension first, in which values lie next to each other.
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


def _answer(answer: Callable[..., Any], *, every_axis: bool = False) -> Callable[..., Any]:
    """Return a function of a dataset as a method, with its words and arguments.

    The dataset has to prove that it is one study's; of a join of several the method answers per
    design. ``every_axis``: the answer needs the coordinates of all axes.
    """

    @wraps(answer)
    def method(self: SweepAccessor, *given: Any, **options: Any) -> Any:
        def of_study(dataset: xr.Dataset) -> Any:
            return answer(dataset, *given, **options)

        return provenance.answer_per_study(self._held, of_study, every_axis=every_axis)

    return method


@xr.register_dataset_accessor("sweep")
class SweepAccessor:
    """Answers from a dataset of `sweep.open`, or a part of one.

    All but `roc` and `contour` are lazy: `.compute()` works them out.
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        self._held = dataset

    @property
    def spec(self) -> Spec:
        """The study."""
        return physical.spec_of(provenance.proven(self._held, every_axis=False))

    def sel(self, *, method: str | None = None, **coordinates: Any) -> xr.Dataset:
        """Points by physical value: ``ds.sweep.sel(range="2 km", grazing_angle="20 deg")``.

        Values, and what is raised, are those of :func:`.physical.select`.
        """
        return physical.select(self._held, coordinates, method=method)

    detection_probability = _answer(probability.detection_probability)
    roc = _answer(probability.roc, every_axis=True)
    limit = _answer(limits.limit)
    maximum_range = _answer(limits.maximum_range)
    minimum_grazing_angle = _answer(limits.minimum_grazing_angle)
    contour = _answer(limits.contour)
    false_alarms_per_second = _answer(probability.false_alarms_per_second, every_axis=True)
    false_alarms_per_kilometre = _answer(probability.false_alarms_per_kilometre, every_axis=True)
    range_error = _answer(errors.range_error, every_axis=True)
    velocity_error = _answer(errors.velocity_error, every_axis=True)
    summary = _answer(probability.summary)
    compare = _answer(comparison.compare, every_axis=True)


@xr.register_datatree_accessor("sweep")
class FlightAccessor:
    """Answers from a tree of `sweep.open_scene`, lazy but for the matching of shots."""

    def __init__(self, tree: xr.DataTree) -> None:
        self._held = tree

    @property
    def spec(self) -> Spec | SceneSpec:
        """The study."""
        return physical.study_of(self._held)

    @wraps(comparison.compare_flights)
    def compare(self, other: xr.DataTree) -> xr.DataTree:
        """Compare two flights; as :func:`.comparison.compare_flights`."""
        return comparison.compare_flights(self._held, other)
