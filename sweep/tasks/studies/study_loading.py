"""Reading of the study in a store, and reuse of a smaller study's results.

A larger study takes results from the store of a smaller one, bit for bit. A result depends on the
parameters of its point, its draws and the simulated effects. Points are matched axis by axis. The
older store is only read. Its blocks that do not match the digests in their receipts count as
missing.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from functools import cache, cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sweep.messages import (
    NEW_PLACEHOLDER,
    SPEC_PLACEHOLDER,
    option_name,
    option_text,
    suggested_call,
    sweep_shell_command,
)
from sweep.model import MODEL_VERSION
from sweep.scenes.scene_files import SceneError
from sweep.spec import GridSpec, SceneSpec, SpecError, describe_differences, from_stored
from sweep.spec.grid_checks import is_detector_or_estimator_parameter
from sweep.spec.rules import Mistake
from sweep.spec.sections import parameter_rules
from sweep.storage import store_format
from sweep.storage.locations import PACKED_ATTRIBUTE, Location, parse_location, resolve_links
from sweep.storage.verified_store import open_verified_group
from sweep.tasks.engine import study_store
from sweep.tasks.engine.block_study import StoredStudy
from sweep.tasks.engine.blocks import Results
from sweep.tasks.engine.journal import (
    EXTENDED_STORE_KEY,
    committed_block_mask,
    read_committed_digests,
    read_store_recipe,
)
from sweep.tasks.engine.progress import StoreError
from sweep.tasks.studies.extendable_study import CHUNK_READ_ERRORS
from sweep.tasks.studies.eyepoint_study import EyepointStudy
from sweep.tasks.studies.flight_study import FlightStudy
from sweep.tasks.studies.grid_study import GridStudy, canonical_point_rows
from sweep.tasks.studies.parameter_grid import TOLERANCE_PARAMETER, ParameterGrid, ParameterValue

AnySpec = GridSpec | SceneSpec

GridOrFlightStudy = GridStudy | FlightStudy
AnyStudy = GridOrFlightStudy | EyepointStudy


def make_study(
    spec: GridSpec | SceneSpec, store_path: Location, source_path: Location | None = None
) -> GridOrFlightStudy:
    """Return the study of a spec, whose results are stored at ``store_path``.

    If ``source_path`` is given, the study reuses results of the store at that path.
    """
    study = FlightStudy(spec, store_path) if isinstance(spec, SceneSpec) else GridStudy(spec)
    if source_path:
        study.find_reuse_source = partial(_find_reuse_source, source_path, study)
    return study


def _find_reuse_source(
    source_path: Location, target_study: GridOrFlightStudy
) -> ReuseSource | None:
    """Return the results in a store that a study can reuse; None if the store is unusable."""
    try:
        attributes = store_format.read_attributes(source_path)
        study_store.refuse_other_versions(
            source_path, attributes, MODEL_VERSION, reader="this machine"
        )
        source_spec = _read_spec(
            source_path, read_store_recipe(source_path), attributes.get("spec", "{}")
        )
        if (
            type(source_spec) is not type(target_study.spec)
            or source_spec.seed != target_study.spec.seed
        ):
            return None
        if isinstance(target_study, FlightStudy) and extension_obstacles(
            source_spec, target_study.spec
        ):
            return None  # a grid needs no such test, as its points have unique parameters
        source_study = make_study(source_spec, source_path)
        if PACKED_ATTRIBUTE not in attributes:
            study_store.refuse_other_block_shapes(source_path, source_study)
        return ReuseSource(source_path, source_study, target_study)
    except (StoreError, SceneError):
        return None


def read_study(store_path: Location) -> StoredStudy[AnyStudy]:
    """Return the attributes of a store, and its study; raise StoreError if it is unreadable."""
    attributes = store_format.read_attributes(store_path)
    if attributes["kind"] == store_format.ACCURACY_STORE_KIND:
        figures_command = sweep_shell_command("figures", store_path)
        raise StoreError(
            f"{store_path} holds what accuracy costs, no study: `{figures_command}` draws it"
        )
    return StoredStudy(attributes, load_study(store_path, attributes))


def read_study_and_check_blocks(store_path: Location) -> StoredStudy[AnyStudy]:
    """Return the attributes and the study of a store, after a check of its shape of blocks.

    StoreError is raised if the store's blocks have another shape than those of the study. Receipts
    are numbered by block, and would be taken for receipts of other points.
    """
    stored_study = read_study(store_path)
    if PACKED_ATTRIBUTE not in stored_study.attributes:  # a packed copy joins blocks in its chunks
        study_store.refuse_other_block_shapes(store_path, stored_study.study)
    return stored_study


def load_study(store_path: Location, attributes: dict[str, Any]) -> AnyStudy:
    """Return the study that the attributes of a store describe.

    StoreError is raised if the study can't be read.
    """
    recipe = read_store_recipe(store_path)
    if attributes["kind"] == store_format.EYEPOINTS_STORE_KIND:
        if "spec" not in recipe:
            raise StoreError(
                f"{store_path} does not say how its eyepoints were made: run their study again"
            )
        return EyepointStudy(_read_spec(store_path, recipe, recipe["spec"]), recipe["scanner"])
    spec = _read_spec(store_path, recipe, attributes["spec"])
    source_path = (
        parse_location(recipe[EXTENDED_STORE_KEY]) if EXTENDED_STORE_KEY in recipe else None
    )
    return make_study(
        spec, store_path, source_path if source_path != resolve_links(store_path) else None
    )


def _read_spec(store_path: Location, recipe: dict[str, Any], spec_json: str) -> Any:
    """Return the spec in the attributes of a store.

    StoreError is raised if this version of sweep can't read the spec.
    """
    try:
        return from_stored(spec_json, base=Path(recipe["base"]) if "base" in recipe else None)
    except (SpecError, ValueError) as error:
        raise StoreError(
            f"{store_path} holds a spec that this version of sweep can't read:\n{error}"
        ) from error


def refuse_other_study(
    store_path: Location,
    attributes: dict[str, Any],
    stored_spec: GridSpec | SceneSpec,
    requested_spec: GridSpec | SceneSpec,
) -> None:
    """Raise a StoreError if a store holds another study than the requested one.

    `stored_spec` is the spec in the store, `requested_spec` that of the requested study.
    """
    if attributes["study_id"] == requested_spec.id:
        return
    study_store.refuse_other_versions(
        store_path, attributes, MODEL_VERSION, reader="this machine"
    )  # the id depends on the version too
    lines = "\n".join(f"  {line}" for line in describe_differences(stored_spec, requested_spec))
    raise StoreError(
        f"{store_path} holds another study (in the store -> in the spec):\n{lines}\n"
        f"Name another {option_name('store')}, or replace this one with {option_text('overwrite')}."
    )


FIELDS_THAT_MAY_GROW = ("draws.number", "draws.limit")
"""Fields of a spec that an extension may increase."""
FIELDS_THAT_MAY_SHRINK = (TOLERANCE_PARAMETER,)
"""Fields of a spec that an extension may decrease."""
FIELDS_THAT_MAY_CHANGE = ("storage.block_points", "storage.block_shots", "storage.block_draws")
"""Fields of a spec that an extension may increase or decrease."""

LOST_VALUES_LISTED_MAX = 5
"""Largest number of an axis's lost values that an error message lists."""

CACHED_SOURCE_BLOCKS_MAX = 2
"""Largest number of the smaller study's blocks that a process keeps in memory."""


class SharedPoints(NamedTuple):
    """Points that a block of the larger study and a block of the smaller one have in common."""

    source_block: int
    """Number of the block of the smaller study."""
    indices_in_block: np.ndarray
    """Indices (m,) int64 of the shared points in the larger study's block, in C order."""
    source_local_indices: np.ndarray
    """Indices (m,) int64 of the shared points in the block `source_block`, in C order."""


class ReuseSource:
    """Results of a smaller study, read from its store, that a larger study takes over.

    The smaller study is the source, the larger one the target.
    """

    def __init__(
        self,
        source_path: Location,
        source_study: GridOrFlightStudy,
        target_study: GridOrFlightStudy,
    ) -> None:
        self._source_path, self.source_study, self._target_study = (
            source_path,
            source_study,
            target_study,
        )
        self.reused_points_by_block: dict[
            int, int
        ] = {}  # number of points of each block that were not computed
        self.has_final_results = have_equal_results(source_study.spec, target_study.spec)
        self.has_first_draws = not self.has_final_results and continues_draws(
            source_study.spec, target_study.spec
        )
        self._has_other_tolerance = have_different_tolerances(source_study.spec, target_study.spec)
        self._committed_digests = read_committed_digests(source_path, source_study.n_blocks)
        self.read_block = lru_cache(maxsize=CACHED_SOURCE_BLOCKS_MAX)(self._read_block)
        self._matching_of_group = cache(self._match_points_of_group)

    def iter_shared_points(self, block: int) -> Iterator[SharedPoints]:
        """Yield the points of a block that committed blocks of the smaller study contain.

        Each item has the points in one block of the smaller study. `block` is a number in the
        larger study.
        """
        target_grid, block_in_grid = self._target_study.locate_block(block)
        source_grids = {grid.group: grid for grid in self.source_study.grids}
        if (
            not (self.has_final_results or self.has_first_draws)
            or target_grid.group not in source_grids
        ):
            return
        source_grid, first_source_block = (
            source_grids[target_grid.group],
            self.source_study.first_block_of_group(target_grid.group),
        )
        source_grid_indices = self._matching_of_group(target_grid.group).match_slices(
            target_grid.block_slices(block_in_grid)
        )
        is_reusable = source_grid_indices >= 0
        if self._has_other_tolerance:
            is_reusable = is_reusable & ~np.asarray(
                self._target_study.has_numerics_set_by_tolerance(block)
            )
        indices_in_block = np.flatnonzero(is_reusable)
        source_blocks, source_local_indices = source_grid.locate_points(
            source_grid_indices[indices_in_block]
        )
        for source_block in np.unique(source_blocks).tolist():
            if (
                self._committed_digests[first_source_block + source_block]
                and self._committed_digests[
                    self.source_study.block_of_first_draws(first_source_block + source_block)
                ]
            ):
                is_in_block = source_blocks == source_block
                yield SharedPoints(
                    first_source_block + source_block,
                    indices_in_block[is_in_block],
                    source_local_indices[is_in_block],
                )

    def _match_points_of_group(self, group: str) -> PointMatching:
        """Return the mapping of points from the grid of a group to the smaller study's grid."""
        source_grid, target_grid = (
            next(grid for grid in study.grids if grid.group == group)
            for study in (self.source_study, self._target_study)
        )
        return PointMatching(
            source_grid,
            target_grid,
            parameters_ignored_in_matching(self.source_study.spec, self._target_study.spec),
        )

    def _read_block(self, source_block: int) -> Results | None:
        """Return the results of a block of the smaller study as arrays by name.

        The result is None if a chunk is damaged or missing.
        """
        try:
            chunk_paths = study_store.chunk_names_of_block(self.source_study, source_block)
            digest = store_format.stored_objects_digest(
                self._source_path, chunk_paths, study_store.make_chunk_size_limit(self.source_study)
            )
            if digest.encode() != self._committed_digests[source_block]:
                return None
            return {
                name: self.read_chunk(name, source_block)
                for name in self.source_study.chunk_positions_of_block(source_block)
            }
        except CHUNK_READ_ERRORS:
            return None

    def read_chunk(self, name: str, source_block: int) -> np.ndarray:
        """Return the chunk of an array that holds a block of the smaller study, unchecked.

        The digest of the block is not compared with its receipt.
        """
        return np.asarray(
            self._source_arrays[name].blocks[
                self.source_study.chunk_positions_of_block(source_block)[name]
            ]
        )

    @cached_property
    def _source_arrays(self) -> Any:
        """Arrays of the smaller study's store by name, opened once."""
        return open_verified_group(self._source_path)

    def reuse_obstacle_remark(self) -> str:
        """Return a remark on stored results that can't be reused as they are; '' if all can."""
        if not (self.has_final_results or self.has_first_draws):
            return "whole spectra are drawn anew"
        remarks = ["points that are there are drawn further"] if self.has_first_draws else []
        spec = self._target_study.spec
        has_closer_points = self._has_other_tolerance and np.any(
            self._target_study.has_numerics_set_by_tolerance(0)
        )
        if self._has_other_tolerance and isinstance(spec, SceneSpec) and not has_closer_points:
            remarks.append("shots that call for more effects with the tolerance are computed anew")
        elif self._has_other_tolerance:
            beamlets_field = (
                "footprint.beamlets, "
                if getattr(spec, "is_ray_number_set_by_tolerance", True)
                else ""
            )
            remarks.append(
                "with the tolerance all is computed more closely, and anew, but where "
                f"{beamlets_field}accuracy.line_error and accuracy.leakage_error are numbers"
            )
        return "; ".join(remarks)


def reusable_points_text(store_path: Location, study: GridOrFlightStudy) -> str:
    """Return a message on how many points of a study need not be computed.

    They are in the study's store, or in the store of the smaller study that it extends.
    """
    is_done = committed_block_mask(store_path, study)
    n_points_there, remark = study.count_points_in_blocks(is_done), ""
    if study.reuse_source is not None:
        n_points_there += sum(
            study.count_reusable_points_of_block(int(block)) for block in np.flatnonzero(~is_done)
        )
        remark = study.reuse_source.reuse_obstacle_remark()
    count_text = f"{n_points_there:,} of {study.n_points:,} {study.points_noun} are there; "
    count_text += f"{study.n_points - n_points_there:,} to compute"
    return f"{count_text} ({remark})" if remark else count_text


def parameters_ignored_in_matching(source_spec: AnySpec, target_spec: AnySpec) -> tuple[str, ...]:
    """Return the dotted paths of parameters that may differ between points with the same results.

    They are the tolerance, if neither study varies it, and detector and estimator, if no spectra
    are drawn.
    """
    draws_spectra = target_spec.draws.draws_whole_spectra
    method_paths = [
        path
        for path in target_spec.parameters()
        if is_detector_or_estimator_parameter(path) and not draws_spectra
    ]
    has_fixed_tolerances = (
        _fixed_tolerance(source_spec) is not None and _fixed_tolerance(target_spec) is not None
    )
    return (*method_paths, TOLERANCE_PARAMETER) if has_fixed_tolerances else tuple(method_paths)


def have_different_tolerances(source_spec: AnySpec, target_spec: AnySpec) -> bool:
    """Return True if two studies have different tolerances, both the same at all points."""
    source_tolerance, target_tolerance = (
        _fixed_tolerance(source_spec),
        _fixed_tolerance(target_spec),
    )
    return (
        source_tolerance is not None
        and target_tolerance is not None
        and source_tolerance != target_tolerance
    )


def have_equal_results(source_spec: AnySpec, target_spec: AnySpec) -> bool:
    """Return True if two studies give equal results where parameters and numerics are equal."""
    if isinstance(target_spec, SceneSpec) or isinstance(source_spec, SceneSpec):
        return True
    if not target_spec.draws.has_draws:
        return not source_spec.draws.has_draws
    return source_spec.draws == target_spec.draws and _fixed_tolerance(
        source_spec
    ) == _fixed_tolerance(target_spec)


def continues_draws(source_spec: GridSpec, target_spec: GridSpec) -> bool:
    """Return True if the draws of the source study are the first draws of the target study.

    The result is False for studies that draw whole spectra.
    """
    draw_counts = {"number": target_spec.draws.number, "limit": target_spec.draws.limit}
    is_looser = (_fixed_tolerance(source_spec) or 1.0) < (_fixed_tolerance(target_spec) or 0.0)
    return (
        target_spec.draws.has_draws
        and not target_spec.draws.draws_whole_spectra
        and source_spec.draws.is_adaptive == target_spec.draws.is_adaptive
        and source_spec.draws.model_copy(update=draw_counts) == target_spec.draws
        and source_spec.draws.number <= target_spec.draws.number
        and source_spec.draws.limit <= target_spec.draws.limit
        and not is_looser
    )


def _fixed_tolerance(spec: AnySpec) -> float | None:
    """Return the tolerance at all points of a study; None if an axis varies it."""
    value = spec.parameters_off_axes().get(TOLERANCE_PARAMETER)
    return None if value is None else float(value)


def apply_changes(spec: AnySpec, changes: Mapping[str, Any]) -> AnySpec:
    """Return a copy of a spec with new values.

    ``changes`` maps dotted paths to values, such as ``{"axes.target.range": ["1 km"]}``. SpecError
    is raised if the result is no valid spec.
    """
    mapping = spec.to_yaml_mapping()
    for path, value in changes.items():
        section_name, _, field_path = path.partition(".")
        if section_name == "axes" and field_path:
            mapping[section_name] = {**mapping.get(section_name, {}), field_path: value}
            continue
        *sections, field_name = path.split(".")
        section: Any = mapping
        for name in sections:
            section = section.setdefault(name, {}) if isinstance(section, dict) else None
        if not isinstance(section, dict):
            parent = ".".join(sections)
            raise SpecError([Mistake(path, f"is no field: {parent} holds none", str(value))])
        section[field_name] = value
    base = spec.base_folder if isinstance(spec, SceneSpec) else "."
    return type(spec).from_mapping(mapping, base=base)


def refuse_not_larger_study(
    source_path: Location, source_spec: AnySpec, target_spec: AnySpec
) -> None:
    """Raise a StoreError if the target study is not larger than the source study in a store."""
    if type(source_spec) is not type(target_spec):
        raise StoreError(
            f"{source_path} can't be extended to this study: a flight over a scene and a study "
            "over a "
            "grid have nothing in common. Run it into a store of its own: "
            f"{suggested_call('run', SPEC_PLACEHOLDER, store=NEW_PLACEHOLDER)}"
        )
    obstacles = extension_obstacles(source_spec, target_spec)
    if obstacles:
        obstacle_lines = "\n".join(f"  {obstacle}" for obstacle in obstacles)
        scanners = " new scanners," if _scanner_names(target_spec) else ""
        raise StoreError(
            f"{source_path} can't be extended to this study (in the store -> asked "
            f"for):\n{obstacle_lines}\n"
            f"A store is extended by values on axes, new axes,{scanners} more draws or a tighter "
            "accuracy.tolerance. Any other study needs a store of its own: "
            f"{suggested_call('run', SPEC_PLACEHOLDER, store=NEW_PLACEHOLDER)}"
        )


def extension_obstacles(source_spec: AnySpec, target_spec: AnySpec) -> list[str]:
    """Return the reasons why a target study is not larger than a source study, one per field.

    Both are studies over a grid, or both are flights. The list is empty if the target is larger.
    """
    return [
        *_iter_disallowed_changes(source_spec, target_spec),
        *_iter_lost_axis_values(source_spec, target_spec),
    ]


def _iter_disallowed_changes(source_spec: AnySpec, target_spec: AnySpec) -> Iterator[str]:
    """Yield a text for each difference between two specs that an extension does not allow."""
    on_axes = {
        member.path
        for any_spec in (source_spec, target_spec)
        for axis in any_spec.axes
        for member in axis.parameters
    }
    for line in describe_differences(source_spec, target_spec):
        path = line.partition(": ")[0]
        section, _, field_path = path.partition(".")
        if path in on_axes or path in FIELDS_THAT_MAY_CHANGE or section == "axes":
            continue
        if section == "scanners" and field_path.partition(".")[0] not in _scanner_names(
            source_spec
        ):
            continue
        increase = (
            _field_value(target_spec, path) - _field_value(source_spec, path)
            if path in FIELDS_THAT_MAY_GROW + FIELDS_THAT_MAY_SHRINK
            else 0
        )
        if path in FIELDS_THAT_MAY_GROW and not increase > 0 < _field_value(source_spec, path):
            yield f"{line}, and may only grow"
        elif path in FIELDS_THAT_MAY_SHRINK and not increase < 0:
            yield f"{line}, and may only become tighter"
        elif path not in FIELDS_THAT_MAY_GROW + FIELDS_THAT_MAY_SHRINK:
            yield f"{line}, and must stay as it is"


def _scanner_names(spec: AnySpec) -> Collection[str]:
    """Return the names of the scanners of a flight; an empty collection for a grid."""
    return getattr(spec, "scanners", ())


def _field_value(spec: AnySpec, path: str) -> float:
    """Return the value of a numeric field of a spec, given its dotted path."""
    section, _, name = path.partition(".")
    return float(getattr(getattr(spec, section), name))


def _iter_lost_axis_values(source_spec: AnySpec, target_spec: AnySpec) -> Iterator[str]:
    """Yield a text for each axis of the source study with values that the target study lacks."""
    source_grid, target_grid = ParameterGrid(source_spec), ParameterGrid(target_spec)
    varying_paths = {
        path
        for any_grid in (source_grid, target_grid)
        for values in any_grid.values_by_axis
        for path in values
    }
    for lookup in PointMatching(
        target_grid, source_grid, parameters_ignored_in_matching(source_spec, target_spec)
    ).lookups:
        if (lookup.index_along_axis >= 0).all() or varying_paths.isdisjoint(lookup.paths):
            continue
        lost_indices = np.argwhere(lookup.index_along_axis < 0).T
        values_text = ", ".join(
            _lost_values_text(source_grid, path, lost_indices) for path in lookup.paths
        )
        yield f"{values_text}: lost, and must stay among the values"


def _lost_values_text(grid: ParameterGrid, path: str, indices: np.ndarray) -> str:
    """Return the values of a parameter at some points of a grid as text.

    `indices` (axes, n) are the indices of the n points along the axes.
    """
    values: list[object] = [grid.fixed_parameters[path]]
    for axis_values, index in zip(grid.values_by_axis, indices, strict=True):
        if path in axis_values:
            values = axis_values[path][np.unique(index)].tolist()
    value_texts = [f"{value:g}" if isinstance(value, float) else str(value) for value in values]
    ellipsis_texts = ["..."] if len(value_texts) > LOST_VALUES_LISTED_MAX else []
    units = parameter_rules()[path].value_unit
    values_text = ", ".join(value_texts[:LOST_VALUES_LISTED_MAX] + ellipsis_texts)
    return f"{path}: {values_text}{f' {units}' if units else ''}"


class AxisLookup(NamedTuple):
    """Positions of parameter values of this study along an axis of the other study.

    Both studies are those of :class:`PointMatching`.
    """

    paths: tuple[str, ...]
    """Dotted paths of the parameters whose values are looked up."""
    axis: int | None
    """Number of the axis of the other study that varies these parameters; None if none does."""
    index_along_axis: np.ndarray
    """Index along the other study's axis of each value in this study, int64; -1 if missing.

    The shape is that of this study's grid, with length 1 along axes without any of the parameters.
    """


class PointMatching:
    """Mapping from each point of this study to the point of the other one with equal parameters.

    ``grid`` is the grid of this study, ``other_grid`` that of the other one. Axes may be longer, in
    another order, new, or zipped differently. Parameters in ``ignored`` may differ.
    """

    def __init__(
        self, other_grid: ParameterGrid, grid: ParameterGrid, ignored: Collection[str] = ()
    ) -> None:
        self._other_grid = other_grid
        self.lookups = [
            _match_values_to_other_axis(
                grid, axis, {path: array for path, array in values.items() if path not in ignored}
            )
            for axis, values in _iter_parameter_groups(other_grid, grid)
        ]

    def match_slices(self, grid_slices: tuple[slice, ...]) -> np.ndarray:
        """Return the index in the other grid of each point in slices of this grid.

        Indices and points are in C order. The index is -1 for a point that the other grid lacks.
        """
        grid_indices = np.zeros((1,) * len(grid_slices), np.int64)
        is_missing = np.zeros((1,) * len(grid_slices), bool)
        for lookup in self.lookups:
            is_varying = [size > 1 for size in lookup.index_along_axis.shape]
            lookup_slices = (
                axis_slice if varies else slice(None)
                for axis_slice, varies in zip(grid_slices, is_varying, strict=True)
            )
            index = lookup.index_along_axis[tuple(lookup_slices)]
            is_missing = is_missing | (index < 0)
            if lookup.axis is not None:
                grid_indices = grid_indices + index * math.prod(
                    self._other_grid.shape[lookup.axis + 1 :]
                )
        grid_indices = np.where(is_missing, -1, grid_indices)
        return np.broadcast_to(
            grid_indices, [axis_slice.stop - axis_slice.start for axis_slice in grid_slices]
        ).ravel()


def _iter_parameter_groups(
    other_grid: ParameterGrid, grid: ParameterGrid
) -> Iterator[tuple[int | None, dict[str, np.ndarray]]]:
    """Yield the other grid's parameters in groups, each with the number of an axis.

    The parameters of one axis make a group, with the values along the axis by dotted path. Fixed
    parameters make groups whose number of the axis is None.
    """
    yield from enumerate(other_grid.values_by_dim())
    on_axes = {path for values in other_grid.values_by_dim() for path in values}
    fixed_values = {
        path: np.array([value])
        for path, value in other_grid.fixed_parameters.items()
        if path not in on_axes
    }
    for values in grid.values_by_dim():
        yield None, {path: fixed_values.pop(path) for path in values if path in fixed_values}
    yield None, fixed_values


def _match_values_to_other_axis(
    grid: ParameterGrid, axis: int | None, other_values: dict[str, np.ndarray]
) -> AxisLookup:
    """Return where the values of some parameters in `grid` occur in the other grid.

    ``other_values`` are the values of these parameters along ``axis`` of the other grid, by dotted
    path. ``axis`` is None for parameters that the other grid does not vary.
    """
    varying_axes = [
        axis_number
        for axis_number, axis_values in enumerate(grid.values_by_dim())
        if not axis_values.keys().isdisjoint(other_values)
    ]
    shape = tuple(
        size if axis_number in varying_axes else 1 for axis_number, size in enumerate(grid.shape)
    )
    axis_indices = [
        i.ravel() for i in np.indices([grid.shape[axis_number] for axis_number in varying_axes])
    ]
    values_by_dim = grid.values_by_dim()
    parameters: dict[str, ParameterValue] = {
        path: grid.fixed_parameters[path] for path in other_values if path in grid.fixed_parameters
    }
    for axis_number, i in zip(varying_axes, axis_indices, strict=True):
        parameters |= {
            path: array[i]
            for path, array in values_by_dim[axis_number].items()
            if path in other_values
        }
    n_values = len(next(iter(other_values.values()))) if other_values else 1
    rows = canonical_point_rows(other_values, n_values)
    row_indices = _find_row_indices(rows, canonical_point_rows(parameters, math.prod(shape)))
    return AxisLookup(tuple(other_values), axis, row_indices.reshape(shape))


def _find_row_indices(known_rows: np.ndarray, wanted_rows: np.ndarray) -> np.ndarray:
    """Return the index (m,) in `known_rows` of each row of `wanted_rows`; -1 if it is missing."""
    if not known_rows.shape[1]:
        return np.zeros(len(wanted_rows), np.int64)
    all_rows = np.concatenate([known_rows, wanted_rows]).view(np.uint64)
    row_codes = np.unique(all_rows, axis=0, return_inverse=True)[1].ravel()
    index_of_code = np.full(len(all_rows), -1)
    index_of_code[row_codes[: len(known_rows)]] = np.arange(len(known_rows))
    return index_of_code[row_codes[len(known_rows) :]]
