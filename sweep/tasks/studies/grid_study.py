"""Study over a grid of parameters: arrays of its store, and blocks computed by the model.

Effects are selected by tiles: boxes of neighbouring points, or consecutive shots of a flight. The
selection follows from the study alone, so the effects of a point do not depend on the blocks.
"""

from __future__ import annotations

import hashlib
import math
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.model.beamlet_counts import (
    BEAMLETS_PATH,
    effects_tolerance,
    has_numerics_set_by_tolerance,
)
from sweep.model.detection.looks import LOOKS_NUMBER_PATH, LOOKS_VOTES_PATH
from sweep.model.effects.catalogue import (
    EFFECT_CATEGORY_KEY_PATHS,
    PARAMETER_DEFAULTS,
    SEPARATE_BATCHES_MASK,
    effect_flag_attributes,
    effect_names_in_flags,
    pack_effect_flags,
)
from sweep.model.effects.catalogue import EFFECTS as EFFECT_CATALOGUE
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.error_budget import ErrorBudget
from sweep.model.outputs import (
    ACCURACY_OUTPUTS,
    DRAW_BATCH_DIM,
    DRAW_COUNT_OUTPUTS,
    EFFECT_VARIABLES,
    GRID_OUTPUTS,
    RUNNING_SUM_OUTPUTS,
    RUNNING_SUMS_NAME,
    RUNNING_SUMS_ROW_LENGTH,
    SPECTRA_STUDY_OUTPUTS,
    STANDARD_ERROR_OUTPUTS,
    STRONGEST_PEAK_OUTPUTS,
    OutputVariable,
)
from sweep.model.unsupported_shot import UnsupportedShotError
from sweep.model.waveform import REPORTED_PEAKS_PATH
from sweep.tasks.engine.block_study import (
    NO_RESULTS,
    Deadline,
    EarlierResults,
    PartialResults,
    UnfinishedBlockException,
    concatenate_results,
)
from sweep.tasks.engine.blocks import ArrayLayout, BlockGrid, Results
from sweep.tasks.studies.extendable_study import CHUNK_READ_ERRORS, ExtendableStudy
from sweep.tasks.studies.output_layouts import cf_attributes, make_output_layout
from sweep.tasks.studies.parameter_grid import (
    TOLERANCE_PARAMETER,
    ParameterBlockGrid,
    ParameterValue,
)

if TYPE_CHECKING:
    from sweep.model.effects.planning import EffectPlan
    from sweep.model.sampling.samplers import PriorDraws
    from sweep.spec import Axis, GridSpec


def canonical_point_rows(parameters: Mapping[str, ParameterValue], n_points: int) -> np.ndarray:
    """Return a float64 row for each point, (n_points, parameters), made of its parameters.

    Points have equal rows if their parameters are equal. The parameters are sorted by dotted path.
    A string is represented by 62 bits of its hash.
    """
    rows = np.empty((n_points, len(parameters)), dtype=np.uint64)
    for column, path in enumerate(sorted(parameters)):
        rows[:, column] = _value_bits(parameters[path])
    return rows.view(np.float64)


def _value_bits(value: ParameterValue) -> np.ndarray:
    """Return values as uint64 for comparison: bits of float64 numbers, or hashes of strings."""
    array = np.asarray(value)
    if array.dtype.kind == "U":
        names, inverse = np.unique(array, return_inverse=True)
        hashes = np.array([_text_hash(str(name)) for name in names], dtype=np.uint64)
        return hashes[inverse].reshape(array.shape)
    return (array.astype(np.float64) + 0.0).view(np.uint64)  # maps -0.0 to 0.0


@lru_cache(maxsize=256)
def _text_hash(word: str) -> int:
    """Return a hash of a string as an integer of 62 bits."""
    # 62 bits: as a float64 with the upper two bits clear the hash is never nan
    digest = hashlib.blake2b(word.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 2


EFFECTS_ARRAY, EFFECTS_ERROR_ARRAY = "effects", "effects_error"
"""Names of the arrays with the simulated effects, and with the error bound of the omitted ones."""

POINTS_PER_TILE_MAX = 1024
"""Largest number of points of a tile, a box of grid points whose effects are chosen together.

The limit keeps the points of a tile similar, and the planning of effects cheap.
"""

POINTS_PER_PLAN_MAX, PREVIEW_POINTS_PER_TILE = 1 << 14, 64
"""Number of points whose effects are planned at once, and number per tile in a rough first plan.
"""

PARAMETERS_CONSTANT_IN_TILE = (
    "instrument.processing.fft_size",
    "instrument.processing.sample_rate",
    "instrument.processing.acquisition_delay",
    "instrument.chirp.duration",
    "footprint.beamlets",
    LOOKS_NUMBER_PATH,
    LOOKS_VOTES_PATH,
    TOLERANCE_PARAMETER,
)
"""Dotted paths of numeric parameters that must be equal at all points of a tile.

They set the sizes of records, the number of beamlets or looks, or the tolerance.
"""


class PointsWithSameEffects(NamedTuple):
    """Points at which the same effects are simulated."""

    point_indices: np.ndarray
    """Indices (m,) of the group's points among all points whose effects were selected."""
    effect_names: tuple[str, ...]
    """Names of the effects that are simulated at all points of the group."""


class PointsComputedTogether(NamedTuple):
    """Points that are computed together though their effects may differ."""

    point_indices: np.ndarray
    """Indices (m,) of the group's points among all points whose effects were selected."""
    effect_names: tuple[str, ...]
    """Names of the effects that are simulated at one or more points of the group."""
    effect_flags: np.ndarray
    """Effects of each point as a bit mask (m,) uint32: bit k is effect k of the catalogue."""


class SelectedEffects(NamedTuple):
    """Effects that are simulated at each of n points, one bit per effect."""

    effect_flags: np.ndarray
    """Effects of each point as a bit mask (n,) uint32: bit k is effect k of the catalogue."""
    error_bound: np.ndarray
    """Upper bound (n,) of the change by all effects that are omitted at a point."""

    def subset(self, index: slice | np.ndarray) -> SelectedEffects:
        """Return the effects of the points at an index or slice, as a new record."""
        return SelectedEffects(self.effect_flags[index], self.error_bound[index])

    def iter_groups_by_effects(self) -> Iterator[PointsWithSameEffects]:
        """Yield groups of points with equal simulated effects, and the names of these effects."""
        for group_flags in np.unique(self.effect_flags):
            yield PointsWithSameEffects(
                np.flatnonzero(self.effect_flags == group_flags),
                effect_names_in_flags(int(group_flags)),
            )

    def iter_groups_computed_together(
        self,
    ) -> Iterator[PointsComputedTogether]:
        """Yield groups of points that are computed together, with the effects of each point.

        The points of a group share those effects that need a batch of their own; other effects may
        differ.
        """
        separating_flags = self.effect_flags & SEPARATE_BATCHES_MASK
        for shared_flags in np.unique(separating_flags):
            index = np.flatnonzero(separating_flags == shared_flags)
            group_flags = self.effect_flags[index]
            effect_names = effect_names_in_flags(int(np.bitwise_or.reduce(group_flags)))
            yield PointsComputedTogether(index, effect_names, group_flags)


class TileGroup(NamedTuple):
    """Tiles (boxes of neighbouring points) with equal text parameters and equal record sizes.

    Record sizes are the :data:`PARAMETERS_CONSTANT_IN_TILE`, such as the FFT size.
    """

    group_number: int
    """Number that distinguishes the group from other groups of the grid."""
    positions_in_request: np.ndarray
    """Indices (m,) of the group's tiles in the array of tiles passed to `TileGrid.group_tiles`."""
    parameters: dict[str, ParameterValue]
    """Parameters of the tiles' points by dotted path.

    Values are strings, numbers, or arrays that broadcast over (m, k1, k2, ...), with k1, k2, ...
    points of a tile along the axes. A tile that is cut by the edge of the grid repeats its last
    points.
    """


class BlockTiles(NamedTuple):
    """Tiles that overlap a block."""

    tile_numbers: np.ndarray
    """Numbers (m,) in the grid of the tiles that overlap the block."""
    tile_index: np.ndarray
    """Index (n,) in `tile_numbers` of the tile of each point of the block, in C order."""


class TilePlans(NamedTuple):
    """Effects that were chosen for a batch of tiles."""

    positions_in_request: np.ndarray
    """Indices (m,) of the batch's tiles in the array of tiles passed to the planner."""
    effect_plan: EffectPlan
    """Choice of effects for the m tiles of the batch."""


class TileGrid(BlockGrid):
    """Tiles of a grid: boxes of neighbouring points whose effects are chosen together.

    The points of a tile have equal text parameters, and equal
    :data:`PARAMETERS_CONSTANT_IN_TILE`, such as the FFT size.
    """

    def __init__(self, grid: ParameterBlockGrid) -> None:
        self.grid = grid
        self._is_constant_axis = tuple(
            self._must_be_constant_in_tile(axis) for axis in range(len(grid.dims))
        )
        super().__init__(grid.dims, grid.shape, fit_tile_shape(grid.shape, self._is_constant_axis))

    def tiles_of_block(self, block: int) -> BlockTiles:
        """Return the numbers of the tiles that overlap a block, and the tile of each point."""
        tile_indices = [
            np.arange(block_slice.start, block_slice.stop) // tile_length
            for block_slice, tile_length in zip(
                self.grid.block_slices(block), self.block_shape, strict=True
            )
        ]
        tile_mesh = np.ix_(*tile_indices) if tile_indices else ()
        tile_of_point = (
            np.ravel_multi_index(tile_mesh, self.blocks_per_dim)
            if tile_indices
            else np.zeros((), np.int64)
        )
        tiles, tile_index = np.unique(tile_of_point, return_inverse=True)
        return BlockTiles(tiles, tile_index.ravel())

    def group_tiles(self, tiles: np.ndarray, stride: int = 1) -> Iterator[TileGroup]:
        """Yield groups of tiles that can be planned together, with the parameters of their points.

        ``tiles`` are the numbers of the tiles. With ``stride`` 1 all points of a tile are included.
        With a larger ``stride`` n, only some points are included: every n-th along each axis, and
        the point with the largest value of each parameter.
        """
        positions = np.unravel_index(tiles, self.blocks_per_dim) if self.blocks_per_dim else ()
        group_codes = np.zeros(len(tiles), np.int64)
        for axis, position in enumerate(positions):
            if self._is_constant_axis[axis]:
                group_codes = group_codes * self.blocks_per_dim[axis] + position
        for group_code in (
            np.unique(group_codes) if any(self._is_constant_axis) else group_codes[:1]
        ):
            members = np.flatnonzero(group_codes == group_code)
            parameters: dict[str, ParameterValue] = {**self.grid.fixed_parameters}
            for axis, position in enumerate(positions):
                parameters |= self._values_along_axis(axis, position[members], stride)
            yield TileGroup(int(group_code), members, parameters)

    def _must_be_constant_in_tile(self, axis: int) -> bool:
        """Return True if a tile must have one value along the axis with number `axis`.

        Such an axis varies a text parameter or a :data:`PARAMETERS_CONSTANT_IN_TILE`, such as the
        FFT size.
        """
        return any(
            values.dtype.kind in "UO"
            or path in PARAMETERS_CONSTANT_IN_TILE
            or path in EFFECT_CATEGORY_KEY_PATHS
            for path, values in self.grid.values_by_axis[axis].items()
        )

    def _values_along_axis(
        self, axis: int, tile_index_along: np.ndarray, stride: int
    ) -> dict[str, ParameterValue]:
        """Return the parameter values along an axis at the points of m tiles, by dotted path.

        ``tile_index_along`` (m,) are the positions of the tiles along the axis. The values have the
        shape (m, 1, ..., k, ..., 1), with k points of a tile along the axis. They are scalars if
        the axis has one value per tile. ``stride`` is that of `group_tiles`.
        """
        members = self.grid.values_by_axis[axis]
        if self._is_constant_axis[axis]:
            tile_index = int(tile_index_along[0])
            return {path: values[tile_index].item() for path, values in members.items()}
        tile_length, size = self.block_shape[axis], self.shape[axis]
        axis_indices = np.minimum(
            tile_index_along[:, None] * tile_length + np.arange(tile_length), size - 1
        )
        sampled_indices = axis_indices[:, ::stride]
        if stride > 1:  # with the largest values, so that no effect of the tile is missed
            largest_at = [
                np.abs(array[axis_indices].astype(float)).argmax(axis=1)
                for array in members.values()
            ]
            rows = np.arange(len(tile_index_along))[:, None]
            sampled_indices = np.hstack(
                [sampled_indices, axis_indices[rows, np.transpose(largest_at)]]
            )
        shape = [len(tile_index_along), *(1,) * len(self.shape)]
        shape[axis + 1] = sampled_indices.shape[1]
        sampled_indices = sampled_indices.reshape(shape)
        return {path: values[sampled_indices].astype(float) for path, values in members.items()}


def fit_tile_shape(sizes: tuple[int, ...], is_constant: tuple[bool, ...]) -> tuple[int, ...]:
    """Return the number of points of a tile along each axis of a grid.

    `sizes` are the numbers of points of the grid along the axes. The numbers of a tile are about
    equal, but 1 along an axis that `is_constant` marks: a tile has a single value along such an
    axis.
    """
    shape, points_left = [1] * len(sizes), POINTS_PER_TILE_MAX
    divisible_axes = sorted(
        (axis for axis in range(len(sizes)) if not is_constant[axis]), key=lambda k: sizes[k]
    )
    for n_shaped, axis in enumerate(divisible_axes):
        shape[axis] = min(
            sizes[axis], max(1, int(points_left ** (1 / (len(divisible_axes) - n_shaped)) + 1e-9))
        )
        points_left //= shape[axis]
    return tuple(shape)


class EffectPlanner:
    """Planner that chooses the effects to simulate in each tile (box of neighbouring points).

    Each tile is planned once.
    """

    def __init__(self, spec: GridSpec, grid: ParameterBlockGrid) -> None:
        self._effect_modes, self.tiles = spec.effect_modes(), TileGrid(grid)
        self._plan_by_tile: dict[int, tuple[int, float]] = {}

    def select_for_block(
        self, block: int, indices_in_block: np.ndarray | None = None
    ) -> SelectedEffects:
        """Return the effects that are simulated at each point of a block, in C order.

        If `indices_in_block` (m,) is given, only the points of the block with these indices are
        considered, and only their tiles are planned.
        """
        tiles, tile_index = self.tiles.tiles_of_block(block)
        parameters = self.tiles.grid.parameters_of_block(block)
        if indices_in_block is not None:
            needed_tiles, tile_index = np.unique(tile_index[indices_in_block], return_inverse=True)
            tiles = tiles[needed_tiles]
            parameters = select_parameters_of_points(parameters, indices_in_block)
        unplanned_tiles = np.array(
            [
                tile_number
                for tile_number in tiles.tolist()
                if tile_number not in self._plan_by_tile
            ],
            np.int64,
        )
        for plan_indices, plan in self.iter_tile_plans(unplanned_tiles):
            flags_of_tiles = pack_effect_flags(plan.is_kept)
            for tile, flag, error in zip(
                unplanned_tiles[plan_indices], flags_of_tiles, plan.total_error, strict=True
            ):
                self._plan_by_tile[int(tile)] = int(flag), float(error)
        planned = [self._plan_by_tile[tile_number] for tile_number in tiles.tolist()]
        flags_of_tiles, errors = (
            np.array([tile_flags for tile_flags, _ in planned], np.uint32),
            np.array([tile_error for _, tile_error in planned]),
        )
        inactive = self.absent_effect_flags(parameters, len(tile_index))
        return SelectedEffects(flags_of_tiles[tile_index] & ~inactive, errors[tile_index])

    def absent_effect_flags(
        self, parameters: Mapping[str, ParameterValue], n_points: int
    ) -> np.ndarray:
        """Return the effects that are absent at each point as a bit mask (n_points,) uint32.

        Bit k is effect k of the catalogue. An absent effect has no cause at the point. It is not
        simulated at the point even if it is chosen for the point's tile.
        """
        inactive_bits = np.zeros(n_points, np.uint32)
        for bit, effect in enumerate(EFFECT_CATALOGUE):
            is_inactive = effect.is_absent(PARAMETER_DEFAULTS | dict(parameters))
            inactive_bits |= np.where(is_inactive, np.uint32(1 << bit), np.uint32(0))
        return inactive_bits

    def iter_tile_plans(self, tiles: np.ndarray) -> Iterator[TilePlans]:
        """Yield the effects chosen for batches of tiles; every tile in `tiles` is in one batch.

        A tile is first planned from a few of its points. If this plan simulates every optional
        effect, it is final. Otherwise the tile is planned again from all its points.
        """
        tile_lengths = [tile_length for tile_length in self.tiles.block_shape if tile_length > 1]
        preview_stride = max(
            int(
                (math.prod(tile_lengths) / PREVIEW_POINTS_PER_TILE)
                ** (1 / max(len(tile_lengths), 1))
            ),
            1,
        )
        remaining_tiles = np.arange(len(tiles))
        for stride in (preview_stride, 1) if preview_stride > 1 else (1,):
            points_per_tile = math.prod(-(-tile_length // stride) for tile_length in tile_lengths)
            tiles_per_plan = max(POINTS_PER_PLAN_MAX // points_per_tile, 1)
            unsettled_tiles = []
            for start in range(0, len(remaining_tiles), tiles_per_plan):
                batch = remaining_tiles[start : start + tiles_per_plan]
                for tile_group in self.tiles.group_tiles(tiles[batch], stride):
                    plan = self._plan_group(tile_group)
                    is_settled = (
                        np.full(len(tile_group.positions_in_request), stride == 1)
                        | plan.keeps_all_optional_effects
                    )
                    if is_settled.any():
                        yield TilePlans(
                            batch[tile_group.positions_in_request[is_settled]],
                            plan.select(is_settled),
                        )
                    unsettled_tiles.append(batch[tile_group.positions_in_request[~is_settled]])
            remaining_tiles = (
                np.concatenate(unsettled_tiles) if unsettled_tiles else remaining_tiles[:0]
            )

    def _plan_group(self, tile_group: TileGroup) -> EffectPlan:
        """Return the effects chosen for each tile of a group."""
        from sweep.model.effects.planning import plan_effects

        parameters, n_tiles = tile_group.parameters, len(tile_group.positions_in_request)
        point_axes = tuple(range(1, len(self.tiles.shape) + 1))

        def max_over_tile(values: np.ndarray) -> np.ndarray:
            tile_max = np.max(values, axis=point_axes) if values.ndim else values
            return np.broadcast_to(tile_max, (n_tiles,))

        tolerance = effects_tolerance(parameters, int(parameters[BEAMLETS_PATH]))  # type: ignore[arg-type]
        return plan_effects(
            PlannerInputs(PARAMETER_DEFAULTS | parameters),
            max_over_tile,
            self._effect_modes,
            tolerance,
        )


def block_output_variables(spec: GridSpec) -> dict[str, OutputVariable]:
    """Return the output variables that blocks write, by name in sorted order.

    The dimensions of a variable do not include the study's axes.
    """
    error_output = replace(
        EFFECT_VARIABLES[EFFECTS_ERROR_ARRAY],
        comment="sum over the effects left out of what each may change: of pd in all three "
        "segments, of log10 of the probability of a false alarm, or of a relative magnitude, "
        "whichever is most",
    )
    outputs = {
        EFFECTS_ARRAY: replace(EFFECT_VARIABLES[EFFECTS_ARRAY], dims=()),
        EFFECTS_ERROR_ARRAY: replace(error_output, dims=()),
    }
    draw_outputs = ACCURACY_OUTPUTS | DRAW_COUNT_OUTPUTS
    if not spec.draws.has_draws:
        outputs |= GRID_OUTPUTS | (STRONGEST_PEAK_OUTPUTS if spec.reports_strongest_peak else {})
    elif spec.draws.draws_whole_spectra:
        outputs |= SPECTRA_STUDY_OUTPUTS | draw_outputs
    else:
        running_outputs = RUNNING_SUM_OUTPUTS if spec.has_random_effects else {}
        outputs |= GRID_OUTPUTS | STANDARD_ERROR_OUTPUTS | draw_outputs | running_outputs
    extra_dims = {RUNNING_SUMS_NAME: ("sum",)}
    if not spec.draws.is_adaptive:
        extra_dims |= dict.fromkeys(DRAW_COUNT_OUTPUTS, (DRAW_BATCH_DIM,))
    return {name: replace(outputs[name], dims=extra_dims.get(name, ())) for name in sorted(outputs)}


class GridStudy(ExtendableStudy):
    """Study over a grid of parameters. Its points are computed independently of each other."""

    def __init__(self, spec: GridSpec) -> None:
        super().__init__(spec)
        self.grid = ParameterBlockGrid(spec)
        self.effect_planner = EffectPlanner(spec, self.grid)

    @property
    def grids(self) -> tuple[ParameterBlockGrid]:
        """Grid that divides the study's points into blocks, as the only element of a tuple."""
        return (self.grid,)

    def has_numerics_set_by_tolerance(self, block: int) -> np.ndarray | bool:
        """Return True for each point of a block whose numerics depend on the tolerance.

        The result is a mask (points,), or one bool for all points.
        """
        return has_numerics_set_by_tolerance(self.grid.parameters_of_block(block))

    def store_attributes(self) -> dict[str, Any]:
        """Return the attributes of the store by name, such as title, spec and shape of blocks."""
        coordinate_names = [
            member.coordinate_name for axis in self.spec.axes for member in axis.parameters
        ]
        coordinate_names += ["batch_draws"] if draw_batch_sizes(self.spec) else []
        return {
            "kind": "grid",
            "title": self.spec.title,
            "question": self.spec.question,
            "spec": self.spec.to_json(),
            "block_shape": list(self.grid.block_shape),
            # by this attribute xarray distinguishes coordinates from variables
            "coordinates": " ".join(coordinate_names),
        }

    def constant_array_layouts(self) -> list[ArrayLayout]:
        """Return the layouts of arrays known in advance: axis coordinates and batch sizes.

        A batch is a run of draws of a point whose detections are counted together.
        """
        arrays = axis_coordinate_layouts(self.spec.axes)
        if draws_per_batch := draw_batch_sizes(self.spec):
            batch_attributes = cf_attributes("1", "draws in the batch")
            arrays.append(
                ArrayLayout.from_values(
                    "batch_draws",
                    (DRAW_BATCH_DIM,),
                    np.array(draws_per_batch, np.int64),
                    batch_attributes,
                )
            )
        return arrays

    def output_layouts(self) -> list[ArrayLayout]:
        """Return the layouts of the arrays that blocks write: outputs of the model, and effects."""
        sizes = {DRAW_BATCH_DIM: len(draw_batch_sizes(self.spec)), "sum": RUNNING_SUMS_ROW_LENGTH}
        off_axes = self.spec.parameters_off_axes()
        promised_accuracy = {  # accuracy that the half-widths of intervals are compared with
            name: float(off_axes[f"accuracy.{name}"])
            for name in ("tolerance", "confidence")
            if f"accuracy.{name}" in off_axes
        }
        layouts = []
        for name, output in block_output_variables(self.spec).items():
            layout = make_output_layout(
                self.grid, name, output, self.grid.dims + output.dims, sizes
            )
            layout_attributes = dict(layout.attributes)
            if name == EFFECTS_ARRAY:
                layout_attributes |= effect_flag_attributes()
            elif name in ACCURACY_OUTPUTS and output.dtype != "int64":
                layout_attributes |= promised_accuracy
            layouts.append(replace(layout, attributes=layout_attributes))
        return layouts

    def evaluate(
        self,
        block: int,
        checkpoint_results: EarlierResults = EarlierResults(),  # noqa: B008
        deadline: Deadline | None = None,
    ) -> Results:
        """Compute a block. Return arrays in the block's shape by name.

        Points that the model does not support get fill values. Finished points in
        `checkpoint_results` are not computed again; unfinished points are continued.
        `UnfinishedBlockException` is raised at the deadline.
        """
        selected_effects = self.effect_planner.select_for_block(block)
        reused_results = self._read_reused_results(block, selected_effects)
        extent, n_points = self.grid.actual_block_shape(block), self.grid.count_block_points(block)
        results = {
            name: np.full((n_points, *layout.shape[len(extent) :]), layout.fill_value, layout.dtype)
            for name, layout in self.output_layout_by_name.items()
        }
        results |= {
            EFFECTS_ARRAY: selected_effects.effect_flags,
            EFFECTS_ERROR_ARRAY: selected_effects.error_bound,
        }
        computed = iter_block_results(
            self.spec,
            self.grid,
            block,
            selected_effects,
            reused_results,
            checkpoint_results,
            deadline or Deadline(),
        )
        for indices_in_block, part_results in (
            reused_results.finished,
            checkpoint_results.finished,
            *computed,
        ):
            for name in (
                results.keys() & part_results.keys()
            ):  # other results serve to continue draws only
                results[name][indices_in_block] = part_results[name]
        return {name: values.reshape(extent + values.shape[1:]) for name, values in results.items()}

    @property
    def supports_checkpoints(self) -> bool:
        """True if the study makes random draws, so that a block can stop between two draws."""
        return self.spec.draws.has_draws

    def evaluate_until(
        self, block: int, checkpoint_results: EarlierResults, deadline: Deadline
    ) -> Results:
        """Compute a block from its checkpoint; raise `UnfinishedBlockException` at the deadline."""
        return self.evaluate(block, checkpoint_results, deadline)

    def _read_reused_results(self, block: int, selected_effects: SelectedEffects) -> EarlierResults:
        """Return the smaller study's results of a block's points with the same effects.

        The results are finished, or unfinished ones to be continued if they have only the first
        draws.
        """
        if (reuse_source := self.reuse_source) is None:
            return EarlierResults()
        parts = []
        for shared_points in reuse_source.iter_shared_points(block):
            if (source_results := reuse_source.read_block(shared_points.source_block)) is None:
                continue
            n_axes, n_source_points = (
                len(reuse_source.source_study.grids[0].shape),
                reuse_source.source_study.count_block_points(shared_points.source_block),
            )
            has_same_effects = (
                source_results[EFFECTS_ARRAY].ravel()[shared_points.source_local_indices]
                == selected_effects.effect_flags[shared_points.indices_in_block]
            )
            results = {
                name: values.reshape(n_source_points, *values.shape[n_axes:])[
                    shared_points.source_local_indices[has_same_effects]
                ]
                for name, values in source_results.items()
                if name not in (EFFECTS_ARRAY, EFFECTS_ERROR_ARRAY)
            }
            parts.append(PartialResults(shared_points.indices_in_block[has_same_effects], results))
        indices_in_block, results = concatenate_results(parts)
        reused_results = PartialResults(
            indices_in_block, initial_running_sums(self.spec, indices_in_block.size) | results
        )
        reuse_source.reused_points_by_block[block] = (
            indices_in_block.size if reuse_source.has_final_results else 0
        )
        return (
            EarlierResults(finished=reused_results)
            if reuse_source.has_final_results
            else EarlierResults(unfinished=reused_results)
        )

    def count_reusable_points_of_block(self, block: int) -> int:
        """Return how many points of a block the smaller study's store has with the same effects."""
        if (reuse_source := self.reuse_source) is None:
            return 0
        selected_effects, n_reusable = self.effect_planner.select_for_block(block), 0
        for shared_points in reuse_source.iter_shared_points(block):
            with suppress(*CHUNK_READ_ERRORS):
                flags = reuse_source.read_chunk(EFFECTS_ARRAY, shared_points.source_block).ravel()
                n_reusable += int(
                    np.sum(
                        flags[shared_points.source_local_indices]
                        == selected_effects.effect_flags[shared_points.indices_in_block]
                    )
                )
        return n_reusable

    def compile_kernels(self) -> None:
        """Compile all kernels, by computing a point with all effects, and a point with none.

        Effects that are off in the spec are left out.
        """
        effect_modes, single_draw_spec = self.spec.effect_modes(), limit_draws(self.spec, 1)
        possible_effects = [
            effect.name
            for effect in EFFECT_CATALOGUE
            if effect_modes[effect.name] != "off" and not effect.is_random
        ]
        first_point_effects = effect_names_in_flags(
            int(self.effect_planner.select_for_block(0, np.zeros(1, np.int64)).effect_flags[0])
        )
        for effects in ({*possible_effects, *first_point_effects}, ()):
            with suppress(UnsupportedShotError):
                evaluate_points(
                    single_draw_spec, self.grid.parameters_at(np.zeros(1, np.int64)), 1, effects
                )


def axis_coordinate_layouts(axes: tuple[Axis, ...]) -> list[ArrayLayout]:
    """Return the layouts of the coordinate arrays of axes. Values are in the units of the spec."""
    return [
        ArrayLayout.from_values(
            member.coordinate_name,
            (axis.name,),
            np.asarray(member.display_values),
            cf_attributes(
                member.units, member.coordinate_name.replace("_", " "), name=member.coordinate_name
            )
            | {"path": member.path},
        )
        for axis in axes
        for member in axis.parameters
    ]


POINTS_PER_MODEL_CALL_MAX = 1 << 16
"""Largest number of points per call of the model.

The number makes the overhead of calls negligible. The limit keeps memory from growing with the
block.
"""

DRAW_COUNTS_PER_MODEL_CALL_MAX = 1 << 19
"""Largest number of draw counts per call of the model, which returns one per point and batch.

A batch is a run of draws of a point whose detections are counted together.
"""

NON_PHYSICAL_PARAMETER_PREFIXES = (
    "accuracy.", "instrument.processing.detector.", "instrument.processing.estimator.",
    REPORTED_PEAKS_PATH
)  # fmt: skip
"""Beginnings of paths of parameters that change how draws are evaluated, not what is drawn."""

GRID_RANDOM_KEY_DOMAIN = "sweep.draws"
"""Text that, with the seed and a point's parameters, determines the random numbers of its draws.

These random numbers differ from all others of the same seed.
"""


def iter_block_results(
    spec: GridSpec,
    grid: ParameterBlockGrid,
    block: int,
    selected_effects: SelectedEffects,
    reused_results: EarlierResults,
    checkpoint_results: EarlierResults,
    deadline: Deadline,
) -> Iterator[PartialResults]:
    """Yield the results of a block's points that are not finished, in groups with the same effects.

    ``reused_results`` are from the store of a smaller study, ``checkpoint_results`` from an earlier
    task. Their finished points are not computed again, and their unfinished points are continued.

    At the deadline `UnfinishedBlockException` is raised, which holds the results so far. A later
    call that continues from these results gives bit for bit the results of a call without a
    deadline.
    """
    parameters, order = grid.parameters_of_block(block), grid.point_order_by_geometry(block)
    order = order[
        ~np.isin(
            order,
            [
                *reused_results.finished.indices_in_block,
                *checkpoint_results.finished.indices_in_block,
            ],
        )
    ]
    finished, points_per_call = [checkpoint_results.finished], _points_per_model_call(spec)
    pending = deque(
        (effects, indices_in_block)
        for members, effects in selected_effects.subset(order).iter_groups_by_effects()
        for indices_in_block in np.split(
            order[members], range(points_per_call, len(members), points_per_call)
        )
    )
    while pending:
        effects, indices_in_block = pending.popleft()
        if len(finished) > 1 and deadline():
            raise _make_unfinished_block(spec, finished, NO_RESULTS)
        is_resumed = np.isin(indices_in_block, checkpoint_results.unfinished.indices_in_block).any()
        prior_draws = extract_prior_draws(
            spec,
            (checkpoint_results if is_resumed else reused_results).unfinished,
            indices_in_block,
        )
        subset = select_parameters_of_points(parameters, indices_in_block)
        try:
            results = evaluate_points(
                spec, subset, len(indices_in_block), effects, prior_draws, deadline
            )
        except UnsupportedShotError:  # halved until only unsupported points are left out
            if len(indices_in_block) > 1:
                pending.extendleft(
                    (effects, half) for half in np.array_split(indices_in_block, 2)[::-1]
                )
            continue
        if deadline.has_passed:
            raise _make_unfinished_block(spec, finished, PartialResults(indices_in_block, results))
        finished.append(PartialResults(indices_in_block, results))
        yield finished[-1]


def _make_unfinished_block(
    spec: GridSpec, finished: list[PartialResults], unfinished: PartialResults
) -> UnfinishedBlockException:
    """Return the exception that ends a block at its deadline, and that holds the results so far."""
    results = EarlierResults(
        concatenate_results([part for part in finished if part.indices_in_block.size]), unfinished
    )
    n_draws = unfinished.results["n_draws"].sum() if unfinished.indices_in_block.size else 0
    point_fraction = float(n_draws) / max(spec.draws.number, spec.draws.limit, 1)
    return UnfinishedBlockException(
        results, results.finished.indices_in_block.size + point_fraction
    )


def evaluate_points(
    spec: GridSpec,
    parameters: Mapping[str, ParameterValue],
    n_points: int,
    effects: Collection[str],
    prior_draws: PriorDraws | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Results:
    """Return the results of points as arrays by name, of shape (n_points,) or (n_points, ...).

    Parameters are scalars, strings or arrays (n_points,). Draws continue after ``prior_draws``
    until all are made or ``should_stop`` returns True. Numbers of draws have the shape (n_points,
    batches).
    """
    if spec.draws.has_draws:
        return _simulate_draws(spec, parameters, n_points, effects, prior_draws, should_stop)
    from sweep.model.evaluation import evaluate
    from sweep.model.sampling.realisations import random_effects

    if random_effect_names := [effect.name for effect in random_effects(effects)]:
        raise ValueError(
            f"{', '.join(random_effect_names)}: simulated by draws, and the study has none"
        )
    outputs = evaluate(parameters, effects)
    return {name: np.broadcast_to(values, (n_points,)) for name, values in outputs.items()}


def select_parameters_of_points(
    parameters: Mapping[str, ParameterValue], indices: np.ndarray
) -> dict[str, ParameterValue]:
    """Return the parameters by dotted path of the points at `indices`; scalars are unchanged."""
    return {
        path: value[indices] if isinstance(value, np.ndarray) else value
        for path, value in parameters.items()
    }


def _points_per_model_call(spec: GridSpec) -> int:
    """Return the number of points that one call of the model computes."""
    return max(
        1,
        min(
            POINTS_PER_MODEL_CALL_MAX,
            DRAW_COUNTS_PER_MODEL_CALL_MAX // max(1, len(draw_batch_sizes(spec))),
        ),
    )


def draw_batch_sizes(spec: GridSpec) -> list[int]:
    """Return the number of draws in each batch of a point; the last batch may be smaller.

    All batches together have `draws.number` draws; the list is empty if this number is 0.
    """
    n_draws, draws_per_batch = spec.draws.number, spec.draws.batch
    return [min(draws_per_batch, n_draws - first) for first in range(0, n_draws, draws_per_batch)]


def random_keys_of_points(
    spec: GridSpec, parameters: Mapping[str, ParameterValue], n_points: int
) -> np.ndarray:
    """Return the keys (n_points, 2) uint64 of the points' random numbers.

    A key does not depend on the `NON_PHYSICAL_PARAMETER_PREFIXES`, such as settings of accuracy.
    """
    from sweep.model.sampling.philox import point_keys

    physical = {
        path: value
        for path, value in parameters.items()
        if not path.startswith(NON_PHYSICAL_PARAMETER_PREFIXES)
    }
    return point_keys(
        canonical_point_rows(physical, n_points), domain=GRID_RANDOM_KEY_DOMAIN, seed=spec.seed
    )


def extract_prior_draws(
    spec: GridSpec, previous: PartialResults, indices_in_block: np.ndarray
) -> PriorDraws | None:
    """Return the draws that `previous` results hold of some points of a block.

    The result is None if they hold none. A point without previous results gets 0 draws.
    """
    from sweep.model.sampling.samplers import PriorDraws

    _, previous_rows, rows = np.intersect1d(
        previous.indices_in_block, indices_in_block, return_indices=True
    )
    if not rows.size:
        return None

    def spread_over_points(name: str) -> np.ndarray:
        values = previous.results[name][previous_rows]
        spread = np.zeros((len(indices_in_block), *values.shape[1:]), values.dtype)
        spread[rows] = values
        return spread

    counts = np.stack(
        [spread_over_points(name).reshape(len(indices_in_block), -1) for name in DRAW_COUNT_OUTPUTS]
    )
    n_missing_batches = max(1, len(draw_batch_sizes(spec))) - counts.shape[-1]
    counts = np.pad(counts, ((0, 0), (0, 0), (0, n_missing_batches)))
    means = {
        name: spread_over_points(name)
        for name in (*GRID_OUTPUTS, RUNNING_SUMS_NAME)
        if name in previous.results
    }
    return PriorDraws(spread_over_points("n_draws"), counts, means)


def _simulate_draws(
    spec: GridSpec,
    parameters: Mapping[str, ParameterValue],
    n_points: int,
    effects: Collection[str],
    prior_draws: PriorDraws | None,
    should_stop: Callable[[], bool] | None,
) -> Results:
    """Simulate draws of points after `prior_draws`. Return results as arrays by name.

    Draws end if all are made, the tolerance is met, or `should_stop` returns True.
    """
    from sweep.model.sampling.samplers import never_stop, simulate_draws
    from sweep.tasks.studies.user_functions import spectrum_methods

    draws = spec.draws
    keywords: dict[str, Any] = {
        "keys": random_keys_of_points(spec, parameters, n_points),
        "prior_draws": prior_draws,
        "should_stop": should_stop or never_stop,
        "method": draws.method,
        "error_budget": ErrorBudget.from_parameters(parameters, count_interval_name=draws.interval),
    }
    if draws.is_adaptive:
        keywords |= {"batch": draws.batch, "limit": draws.limit}
    else:
        keywords |= {"batch_sizes": draw_batch_sizes(spec)}
    if draws.draws_whole_spectra:
        return simulate_draws(parameters, effects, methods=spectrum_methods(parameters), **keywords)
    return initial_running_sums(spec, n_points) | simulate_draws(parameters, effects, **keywords)


def initial_running_sums(spec: GridSpec, n_points: int) -> Results:
    """Return running sums of 0, as an array (n_points, sums) by name.

    The result is an empty dict if the study stores no running sums.
    """
    has_running_sums = spec.has_random_effects and not spec.draws.draws_whole_spectra
    return (
        {RUNNING_SUMS_NAME: np.zeros((n_points, RUNNING_SUMS_ROW_LENGTH))}
        if has_running_sums
        else {}
    )


def limit_draws(spec: GridSpec, draws_max: int) -> GridSpec:
    """Return a copy of a spec with at most `draws_max` draws of a point."""
    draw_counts = {
        "number": min(spec.draws.number, draws_max),
        "limit": min(spec.draws.limit, draws_max),
    }
    return spec.model_copy(update={"draws": spec.draws.model_copy(update=draw_counts)})
