"""Open stores as xarray Datasets and DataTrees, with the accessors `ds.sweep` and `tree.sweep`."""

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
    dataset_lookup,
    detection_limits,
    measurement_errors,
    probability,
    provenance,
)
from sweep.analysis.answers.dataset_lookup import STUDY_ID_NAME, study_marker_name
from sweep.messages import suggested_call
from sweep.model.outputs import DRAW_BATCH_DIM, RUNNING_SUMS_NAME
from sweep.spec import GridSpec, SceneSpec
from sweep.storage import store_format
from sweep.storage.locations import JOURNAL_DIR, Location, parse_location
from sweep.storage.store_format import (
    ACCURACY_STORE_KIND,
    EYEPOINTS_STORE_KIND,
    GRID_STORE_KIND,
    OPEN_ZARR_KWARGS,
    SCENE_STORE_KIND,
    TERRAIN_MAP_GROUP,
    NotAStoreError,
    format_software_versions,
    iter_log_records,
    read_receipt_totals,
)
from sweep.storage.verified_store import open_verified_store

READ_CHUNK_VALUES_MAX = 2**20
"""Largest number of array values in a Dask chunk.

A chunk of floats has at most 8 MB. Much smaller chunks would make a large task graph, because each
chunk takes about 7 kB in the graph.
"""

READ_SHOTS_MAX = 8192
"""Largest number of shots that are read at once, unless a single stored chunk has more shots."""

COUNT_FILL_VALUE = -1
"""Value that a store has in place of counts that are not computed yet."""

_DESCRIPTION_BY_STORE_KIND = {
    GRID_STORE_KIND: "a grid of points: sweep.open() opens it",
    SCENE_STORE_KIND: "a scene's point clouds: sweep.open_scene() opens it",
    ACCURACY_STORE_KIND: "what accuracy costs: xarray.open_zarr() opens it, sweep figures draws it",
    EYEPOINTS_STORE_KIND: (
        "the eyepoints of a flight, which point clouds are made of: open one of those"
    ),
}
"""Description of each kind of store, with the function that opens it, for error messages."""


def open(
    path: str | Location | Sequence[str | Location] | Mapping[str, str | Location],
    *,
    dim: str = "design",
) -> xr.Dataset:
    """Open the store of a study as a dataset, or several stores as one dataset of designs.

    Dimensions are named by the axes of the study. Coordinates are in the units of the study's spec.
    Every variable has its units and its description as attributes. Arrays are read lazily, as Dask
    arrays whose chunks are multiples of the store's chunks. Points that are not computed yet are
    nan. Counts of draws are summed over their batches. Counts that are not computed yet, `n_draws`
    among them, are -1.

    Parameters
    ----------
    path
        Store, complete or not. A list of stores, or a mapping from names of designs to stores, is
        joined along a new dimension. The designs of a list are named by the titles of their
        studies. From a join, `ds.sweep` answers for each design, by the design's own spec.
    dim
        Name of the new dimension of a join.

    Returns
    -------
    xarray.Dataset
        Dataset with the scalar coordinate `study_id`, the id of the study. A second coordinate,
        with the id in its name, proves to `ds.sweep` that the dataset comes from one study. The
        attributes are those of the store, and `started` and `finished` (UTC; empty if not known),
        `points`, `points_committed`, `blocks` and `blocks_committed`.

    Raises
    ------
    NotAStoreError
        The path has no store of a study, or a store whose coordinates are lost or damaged.
    StoreReplacedError
        Raised when values are read later, if the store was extended or replaced after it was
        opened.
    ValueError
        The studies can't be joined: `dim` is taken, a study occurs twice, or zipped axes differ.

    Examples
    --------
    >>> ds = sweep.open({"25 mm": "small.zarr", "50 mm": "large.zarr"})  # doctest: +SKIP
    >>> ds.sweep.maximum_range(pd=0.9).unbroken                          # doctest: +SKIP
    """
    if isinstance(path, Mapping) and path:
        return provenance.join_designs(
            {str(name): open(store) for name, store in path.items()}, dim
        )
    if isinstance(path, Sequence | Mapping) and not isinstance(path, str):
        return provenance.join_designs(_datasets_by_title([open(store) for store in path]), dim)
    path = parse_location(path)
    attributes = read_attributes_of_kind(path, GRID_STORE_KIND)
    require_intact_coordinates(path)
    dataset = xr.open_zarr(
        open_verified_store(path, attributes["study_id"]), chunks=None, **OPEN_ZARR_KWARGS
    )
    effect_flags = dataset["effects"]
    n_blocks = _count_chunks(effect_flags)
    dataset = rechunk_for_reading(dataset.drop_vars(RUNNING_SUMS_NAME, errors="ignore"))
    if DRAW_BATCH_DIM in dataset.dims:
        dataset = sum_draw_batches(dataset)
    dataset = _add_study_id(_load_coordinates(dataset), attributes["study_id"])
    return dataset.assign_attrs(progress_attributes(path, effect_flags.size, n_blocks))


def _datasets_by_title(datasets: Sequence[xr.Dataset]) -> dict[str, xr.Dataset]:
    """Return a mapping of datasets by the titles of their studies.

    Where several studies have the same title, the study id is part of the key.
    """
    titles = [str(dataset.attrs["title"]) for dataset in datasets]
    dataset_by_name = {
        comparison.study_title_with_id(dataset) if titles.count(title) > 1 else title: dataset
        for title, dataset in zip(titles, datasets, strict=True)
    }
    if not dataset_by_name:
        raise ValueError("the list of stores to join is empty: name two or more")
    if len(dataset_by_name) < len(datasets):
        raise ValueError("the list of stores to join has one study twice: leave one out")
    return dataset_by_name


def _load_coordinates(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset with all coordinates in memory, and text coordinates as NumPy strings."""
    loaded = {name: array.compute() for name, array in dataset.coords.items()}
    return dataset.assign_coords({
        name: array.copy(data=np.array(array.values.tolist(), str))
        if array.dtype.kind in "OT" else array
        for name, array in loaded.items()
    })  # fmt: skip


def _add_study_id(dataset: xr.Dataset, study_id: str) -> xr.Dataset:
    """Return a dataset with the id of its study and the study's marker as two more coordinates.

    Attributes that are mappings of versions become text.
    """
    id_attributes = {"long_name": "id of the study"}
    marker_attributes = {
        "long_name": "marker of the study, which shows where another's points join"
    }
    dataset = dataset.assign_coords({
        STUDY_ID_NAME: xr.DataArray(study_id, attrs=id_attributes),
        study_marker_name([study_id]): xr.DataArray(True, attrs=marker_attributes),
    })  # fmt: skip
    return dataset.assign_attrs(
        {name: format_software_versions(v) for name, v in dataset.attrs.items()}
    )


def open_scene(path: str | Location) -> xr.DataTree:
    """Open the store of a flight's point clouds as a tree with a group for each scanner.

    Arrays are read lazily, as Dask arrays in the chunks of the store. Values that are not computed
    yet are nan, -1 for numbers of beams, surfaces and cycles, and 0 for flags.

    Parameters
    ----------
    path
        Store, complete or not.

    Returns
    -------
    xarray.DataTree
        Tree whose attributes are those of the store, and `started` and `finished` (UTC; empty if
        not known), `points` and `points_committed` (shots times draws), `blocks` and
        `blocks_committed`.

    Raises
    ------
    NotAStoreError
        The path has no store of a scene.

    Examples
    --------
    >>> import sweep
    >>> outcome = sweep.run(sweep.load("flight.yaml"), store="flight.zarr", progress=False)
    >>> tree = sweep.open_scene("flight.zarr")
    >>> list(tree.children)
    ['scene_map', 'three']
    """
    return open_scene_tree(parse_location(path), chunks={})


def open_scene_tree(store_path: Location, chunks: dict[str, int] | None = None) -> xr.DataTree:
    """Return the tree of a scene's store as :func:`open_scene` does, with given Dask chunks.

    `chunks` has the length of chunks by dimension; {} stands for the stored chunks. With
    ``chunks=None`` no Dask array is made: values are read when an array is sliced.
    """
    attributes = read_attributes_of_kind(store_path, SCENE_STORE_KIND)
    require_intact_coordinates(store_path)
    store = open_verified_store(store_path, attributes["study_id"])
    whole_tree = xr.open_datatree(store, engine="zarr", chunks=chunks, **OPEN_ZARR_KWARGS)
    groups = {name: group.to_dataset(inherit=False) for name, group in whole_tree.children.items()}
    root = whole_tree.to_dataset()
    if _NAME_BY_OLD_MAP_VARIABLE.keys() <= root.variables.keys():  # a store of an earlier version
        groups[TERRAIN_MAP_GROUP] = root[list(_NAME_BY_OLD_MAP_VARIABLE)].rename(
            _NAME_BY_OLD_MAP_VARIABLE
        )
        root = root.drop_vars(list(_NAME_BY_OLD_MAP_VARIABLE))
    for name in attributes["scanners"]:
        groups[name] = _add_study_id(_load_coordinates(groups[name]), attributes["study_id"])
    tree = xr.DataTree.from_dict({"/": _add_study_id(root, attributes["study_id"]), **groups})
    tree.encoding["source"] = str(store_path)
    flags = [tree[scanner].to_dataset()["flags"] for scanner in attributes["scanners"]]
    n_points = sum(
        int(flag_array.size) // flag_array.sizes["return_number"] for flag_array in flags
    )
    n_blocks = sum(_count_chunks(flag_array) for flag_array in flags)
    tree.attrs |= progress_attributes(store_path, n_points, n_blocks)
    return tree


_NAME_BY_OLD_MAP_VARIABLE = {"map_x": "x", "map_y": "y", "map_height": "height"}
"""Present name of each map variable that stores of earlier versions have in their root."""


def _count_chunks(array: xr.DataArray) -> int:
    """Return the number of chunks of an array in its store."""
    return math.prod(map(math.ceil, np.divide(array.shape, array.encoding["chunks"])))


def stored_chunk_length(array: xr.DataArray, dim: str) -> int:
    """Return the length of an array's stored chunks along a dimension, in elements."""
    return int(array.encoding.get("preferred_chunks", {}).get(dim, array.sizes[dim]))


def chunk_aligned_slices(
    array: xr.DataArray, dim: str, slice_length_max: int = READ_SHOTS_MAX
) -> list[slice]:
    """Return consecutive slices that cover a dimension of an array.

    Each slice consists of complete stored chunks. A slice has at most `slice_length_max` elements,
    or one chunk if a chunk is longer.
    """
    length, stored_chunk = array.sizes[dim], stored_chunk_length(array, dim)
    step = stored_chunk * max(1, slice_length_max // stored_chunk)
    return [slice(start, min(start + step, length)) for start in range(0, length, step)]


def require_intact_coordinates(store_path: Location) -> None:
    """Raise NotAStoreError if coordinates of a store are lost or changed.

    Zarr would read the values of a lost coordinate as zeros.
    """
    document = store_format.read_root_metadata(store_path)
    nodes = {"": document, **document["consolidated_metadata"]["metadata"]}
    coordinate_paths = set()
    for name, node in nodes.items():
        parent, coordinate_names = name, node["attributes"].get("coordinates", "").split()
        if "dimension_names" in node:
            parent, coordinate_names = name.rpartition("/")[0], node["dimension_names"]
        coordinate_paths |= {
            f"{parent}/{coordinate_name}".lstrip("/") for coordinate_name in coordinate_names
        }
    for record in iter_log_records(store_path / JOURNAL_DIR / store_format.MANIFEST_FILE):
        name = record.get("object", "")
        if f"{name}/".partition("/c/")[0] in coordinate_paths:
            with suppress(OSError):
                if store_format.objects_match_digest(store_path, [name], record["digest"]):
                    continue
            raise NotAStoreError(
                f"{store_path} has lost {name}, of a coordinate: "
                f"{suggested_call('verify', store_path, repair=True)} puts it back"
            )


def read_attributes_of_kind(store_path: Location, kind: str = "") -> dict[str, Any]:
    """Return the attributes of a store; raise NotAStoreError if the store is of another kind.

    ``kind`` is the required kind: ``grid``, ``scene``, ``accuracy`` or ``eyepoints``. Empty stands
    for any kind.
    """
    attributes = store_format.read_attributes(store_path)
    if kind and attributes["kind"] != kind:
        raise NotAStoreError(f"{store_path} holds {_DESCRIPTION_BY_STORE_KIND[attributes['kind']]}")
    return attributes


def rechunk_for_reading(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset of Dask arrays in chunks of at most `READ_CHUNK_VALUES_MAX` values.

    A chunk consists of complete stored chunks. Stored chunks are joined along the last dimension
    first, along which values are adjacent in the files.
    """
    largest_array = max(dataset.data_vars.values(), key=lambda array: array.ndim)
    chunk_sizes = dict(zip(largest_array.dims, largest_array.encoding["chunks"], strict=True))
    for dim in reversed(largest_array.dims):
        growth = READ_CHUNK_VALUES_MAX // math.prod(chunk_sizes.values())
        chunk_sizes[dim] = min(largest_array.sizes[dim], chunk_sizes[dim] * max(1, growth))
    return dataset.chunk(chunk_sizes)


def sum_draw_batches(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset with counts summed over batches of draws; -1 if a batch is not computed."""
    batched_counts = {
        name: array for name, array in dataset.data_vars.items() if DRAW_BATCH_DIM in array.dims
    }
    sums = {
        name: array.sum(DRAW_BATCH_DIM, keep_attrs=True).where(
            (array != COUNT_FILL_VALUE).all(DRAW_BATCH_DIM), COUNT_FILL_VALUE
        )
        for name, array in batched_counts.items()
    }
    return dataset.drop_dims(DRAW_BATCH_DIM).assign(sums)


def progress_attributes(store_path: Location, n_points: int, n_blocks: int) -> dict[str, Any]:
    """Return the times and the progress of a study as a dict of attributes of a dataset.

    ``n_points`` and ``n_blocks`` are the numbers of points and blocks of the complete study.
    """
    receipts = read_receipt_totals(store_path, n_blocks)
    sessions = iter_log_records(store_path / JOURNAL_DIR / "sessions.jsonl")
    start_times = [s["time"] for s in sessions if s.get("event") == "begun" and "time" in s]
    start_times += (
        [receipts.first_receipt_time] if receipts.n_committed_blocks and not start_times else []
    )
    return {
        "started": _format_utc(min(start_times)) if start_times else "",
        "finished": _format_utc(receipts.last_receipt_time)
        if receipts.n_committed_blocks >= n_blocks
        else "",
        "points": n_points,
        "points_committed": int(receipts.points_by_block.sum()),
        "blocks": n_blocks,
        "blocks_committed": receipts.n_committed_blocks,
    }


def _format_utc(time: float) -> str:
    """Return a time [s since 1970-01-01 UTC] as ISO 8601 text in UTC."""
    return datetime.fromtimestamp(time, UTC).isoformat(timespec="seconds")


def _as_accessor_method(
    answer: Callable[..., Any], *, require_axes: bool = False
) -> Callable[..., Any]:
    """Return a method of `ds.sweep` that calls a function of a dataset, with its docstring.

    The method checks that the dataset comes from one study. For a join of studies it returns an
    answer for each design. With ``require_axes`` it checks that the coordinates of all axes exist.
    """

    @wraps(answer)
    def method(self: SweepAccessor, *arguments: Any, **options: Any) -> Any:
        def answer_of_study(dataset: xr.Dataset) -> Any:
            return answer(dataset, *arguments, **options)

        return provenance.compute_answer_per_study(
            self._dataset, answer_of_study, require_axes=require_axes
        )

    return method


@xr.register_dataset_accessor("sweep")
class SweepAccessor:
    """Answers from a dataset of `sweep.open`, or from a selection of one.

    All answers except `roc` and `contour` are lazy: `.compute()` evaluates them.
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    @property
    def spec(self) -> GridSpec:
        """Spec of the study."""
        return dataset_lookup.grid_spec_of_dataset(
            provenance.check_single_study(self._dataset, require_axes=False)
        )

    def sel(self, *, method: str | None = None, **coordinates: Any) -> xr.Dataset:
        """Return the points at given values: ``ds.sweep.sel(range="2 km", grazing_angle="9 deg")``.

        Accepted values, and errors, are described in :func:`.dataset_lookup.select_points`.
        """
        return dataset_lookup.select_points(self._dataset, coordinates, method=method)

    detection_probability = _as_accessor_method(probability.detection_probability)
    roc = _as_accessor_method(probability.roc, require_axes=True)
    limit = _as_accessor_method(detection_limits.limit)
    maximum_range = _as_accessor_method(detection_limits.maximum_range)
    minimum_grazing_angle = _as_accessor_method(detection_limits.minimum_grazing_angle)
    contour = _as_accessor_method(detection_limits.contour)
    false_alarms_per_second = _as_accessor_method(
        probability.false_alarms_per_second, require_axes=True
    )
    false_alarms_per_flight_kilometre = _as_accessor_method(
        probability.false_alarms_per_flight_kilometre, require_axes=True
    )
    range_error = _as_accessor_method(measurement_errors.range_error, require_axes=True)
    velocity_error = _as_accessor_method(measurement_errors.velocity_error, require_axes=True)
    summary = _as_accessor_method(probability.summary)
    compare = _as_accessor_method(comparison.compare, require_axes=True)


@xr.register_datatree_accessor("sweep")
class FlightAccessor:
    """Answers from a tree of `sweep.open_scene`.

    They are lazy, but the shots of two flights are matched at once.
    """

    def __init__(self, tree: xr.DataTree) -> None:
        self._tree = tree

    @property
    def spec(self) -> GridSpec | SceneSpec:
        """Spec of the study."""
        return dataset_lookup.spec_of_dataset(self._tree)

    @wraps(comparison.compare_flights)
    def compare(self, other: xr.DataTree) -> xr.DataTree:
        """Compare this flight with another one by :func:`.comparison.compare_flights`."""
        return comparison.compare_flights(self._tree, other)
