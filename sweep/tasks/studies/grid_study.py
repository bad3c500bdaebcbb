"""A study over a grid of parameters: arrays of its store, and points of a block by the model.

The effects of a block's points are planned tile by tile: boxes of neighbouring points, of a flight
consecutive shots. They follow from the study alone: what is simulated at a point does not depend on
how a study is cut.
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

from sweep.model.beamlet_counts import BEAMLETS_PATH, effects_tolerance, is_set_by_tolerance
from sweep.model.detection.looks import LOOKS_NUMBER_PATH, LOOKS_VOTES_PATH
from sweep.model.effects.catalogue import (
    EFFECT_CATEGORY_PATHS,
    OWN_BATCH_FLAGS,
    PARAMETER_DEFAULTS,
    effect_flag_attributes,
    pack_effect_flags,
    unpack_effect_flags,
)
from sweep.model.effects.catalogue import EFFECTS as EFFECT_CATALOGUE
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.error_budget import ErrorBudget
from sweep.model.outputs import (
    ACCURACY_OUTPUTS,
    DRAW_COUNT_OUTPUTS,
    EFFECT_VARIABLES,
    GRID_OUTPUTS,
    N_RUNNING_SUMS,
    RUNNING_SUM_OUTPUTS,
    RUNNING_SUMS,
    SPECTRA_OUTPUTS,
    STANDARD_ERROR_OUTPUTS,
    STRONGEST_PEAK_OUTPUTS,
    OutputVariable,
)
from sweep.model.unsupported_shot import UnsupportedShotError
from sweep.model.waveform import PEAKS_PATH
from sweep.tasks.engine.block_study import (
    NO_RESULTS,
    Deadline,
    PartialResults,
    ReusedResults,
    UnfinishedBlock,
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
    """Rows of float64, (count, parameters), that say what a point is by its values alone.

    A row holds every parameter, in the order of the sorted paths; strings stand as 62 bits of
    their hash.
    """
    rows = np.empty((n_points, len(parameters)), dtype=np.uint64)
    for column, path in enumerate(sorted(parameters)):
        rows[:, column] = _value_bits(parameters[path])
    return rows.view(np.float64)


def _value_bits(value: ParameterValue) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind == "U":
        names, inverse = np.unique(array, return_inverse=True)
        hashes = np.array([_text_hash(str(name)) for name in names], dtype=np.uint64)
        return hashes[inverse].reshape(array.shape)
    return (array.astype(np.float64) + 0.0).view(np.uint64)  # -0.0 and 0.0 are the same value


@lru_cache(maxsize=256)
def _text_hash(word: str) -> int:
    # 62 bits: with the upper two clear it is no nan, which no row may hold
    digest = hashlib.blake2b(word.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 2


#: Arrays of a store that say what was simulated.
EFFECTS_ARRAY, EFFECTS_ERROR_ARRAY = "effects", "effects_error"

#: Points of a tile at the most: few enough that they are much alike, enough that planning is cheap.
TILE_POINTS_MAX = 1024

#: Points of a grid that are looked at together; of a tile, that are looked at first.
POINTS_PER_PLAN_MAX, PREVIEW_POINTS_PER_TILE = 1 << 14, 64

#: Numbers that set the length of records, or how closely all is computed.
CONSTANT_IN_TILE = (
    "instrument.processing.fft_size",
    "instrument.processing.sample_rate",
    "instrument.processing.acquisition_delay",
    "instrument.chirp.duration",
    "footprint.beamlets",
    LOOKS_NUMBER_PATH,
    LOOKS_VOTES_PATH,
    TOLERANCE_PARAMETER,
)


class SelectedEffects(NamedTuple):
    """Effects that are simulated at some points, (n,) each."""

    effect_flags: np.ndarray  # uint32: bit k for the k-th effect of the catalogue
    error_bound: np.ndarray  # largest change of a probability that all that is left out may make

    def subset(self, index: slice | np.ndarray) -> SelectedEffects:
        """Select some of the points."""
        return SelectedEffects(self.effect_flags[index], self.error_bound[index])

    def iter_equal_groups(self) -> Iterator[tuple[np.ndarray, tuple[str, ...]]]:
        """Points with the same effects, and these."""
        for group_flags in np.unique(self.effect_flags):
            yield (
                np.flatnonzero(self.effect_flags == group_flags),
                unpack_effect_flags(int(group_flags)),
            )

    def iter_joint_groups(self) -> Iterator[tuple[np.ndarray, tuple[str, ...], np.ndarray]]:
        """Points that are computed together, the effects of all of them, and their flags."""
        separating_flags = self.effect_flags & OWN_BATCH_FLAGS
        for shared_flags in np.unique(separating_flags):
            index = np.flatnonzero(separating_flags == shared_flags)
            group_flags = self.effect_flags[index]
            yield index, unpack_effect_flags(int(np.bitwise_or.reduce(group_flags))), group_flags


class TileGroup(NamedTuple):
    """Tiles that share every word and size."""

    code: int  # the same for all tiles of the grid that share them
    requested_indices: np.ndarray  # (m,): their numbers among those asked for
    parameters: dict[str, ParameterValue]
    """By dotted path: words, numbers, and arrays that broadcast over (m, *tile): tiles that the
    grid's edge cuts have their last points several times."""


class TileGrid(BlockGrid):
    """Tiles of a grid; points of one tile share every word and every size."""

    def __init__(self, grid: ParameterBlockGrid) -> None:
        self.grid = grid
        self._is_constant_axis = tuple(
            self._is_constant_in_tile(axis) for axis in range(len(grid.dims))
        )
        super().__init__(grid.dims, grid.shape, fit_tile_shape(grid.shape, self._is_constant_axis))

    def tiles_of_block(self, block: int) -> tuple[np.ndarray, np.ndarray]:
        """Tiles that a block meets, (m,), and the index into them of each of its points."""
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
        return tiles, tile_index.ravel()

    def group_tiles(self, tiles: np.ndarray, stride: int = 1) -> Iterator[TileGroup]:
        """Parameters of the points of some tiles, those together that share words and sizes.

        ``stride``: of every so manieth point along each axis, and of the largest of each
        parameter.
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
                parameters |= self._values_along(axis, position[members], stride)
            yield TileGroup(int(group_code), members, parameters)

    def _is_constant_in_tile(self, axis: int) -> bool:
        return any(
            values.dtype.kind in "UO" or path in CONSTANT_IN_TILE or path in EFFECT_CATEGORY_PATHS
            for path, values in self.grid.values_by_axis[axis].items()
        )

    def _values_along(
        self, axis: int, tile_index_along: np.ndarray, stride: int
    ) -> dict[str, ParameterValue]:
        members = self.grid.values_by_axis[axis]
        if self._is_constant_axis[axis]:
            tile_index = int(tile_index_along[0])
            return {path: values[tile_index].item() for path, values in members.items()}
        tile_length, size = self.block_shape[axis], self.shape[axis]
        axis_indices = np.minimum(
            tile_index_along[:, None] * tile_length + np.arange(tile_length), size - 1
        )
        sampled_indices = axis_indices[:, ::stride]
        if stride > 1:  # with the largest of each, so that none is missed that is there at all
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
    """Points of a tile along each axis: alike on all, but 1 where values are not to be joined."""
    shape, points_left = [1] * len(sizes), TILE_POINTS_MAX
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
    """Plans of a grid's tiles, each made once."""

    def __init__(self, spec: GridSpec, grid: ParameterBlockGrid) -> None:
        self._effect_modes, self.tiles = spec.effect_modes(), TileGrid(grid)
        self._plan_by_tile: dict[int, tuple[int, float]] = {}

    def select_for_block(
        self, block: int, local_indices: np.ndarray | None = None
    ) -> SelectedEffects:
        """Effects simulated at the points of a block, in C order over it, or at some of these.

        Only the tiles of the points asked for are planned.
        """
        tiles, tile_index = self.tiles.tiles_of_block(block)
        parameters = self.tiles.grid.parameters(block)
        if local_indices is not None:
            needed_tiles, tile_index = np.unique(tile_index[local_indices], return_inverse=True)
            tiles = tiles[needed_tiles]
            parameters = select_parameters(parameters, local_indices)
        unplanned_tiles = np.array(
            [
                tile_number
                for tile_number in tiles.tolist()
                if tile_number not in self._plan_by_tile
            ],
            np.int64,
        )
        for members, plan in self.iter_plans(unplanned_tiles):
            flags_of_tiles = pack_effect_flags(plan.is_kept)
            for tile, flag, error in zip(
                unplanned_tiles[members], flags_of_tiles, plan.total_error, strict=True
            ):
                self._plan_by_tile[int(tile)] = int(flag), float(error)
        planned = [self._plan_by_tile[tile_number] for tile_number in tiles.tolist()]
        flags_of_tiles, errors = (
            np.array([tile_flags for tile_flags, _ in planned], np.uint32),
            np.array([tile_error for _, tile_error in planned]),
        )
        inactive = self.inactive_flags(parameters, len(tile_index))
        return SelectedEffects(flags_of_tiles[tile_index] & ~inactive, errors[tile_index])

    def inactive_flags(self, parameters: Mapping[str, ParameterValue], n_points: int) -> np.ndarray:
        """Return the flags of effects absent from points, whatever their tiles have."""
        inactive_bits = np.zeros(n_points, np.uint32)
        for bit, effect in enumerate(EFFECT_CATALOGUE):
            is_inactive = effect.is_absent(PARAMETER_DEFAULTS | dict(parameters))
            inactive_bits |= np.where(is_inactive, np.uint32(1 << bit), np.uint32(0))
        return inactive_bits

    def iter_plans(self, tiles: np.ndarray) -> Iterator[tuple[np.ndarray, EffectPlan]]:
        """Plans of some tiles: places among them, and the plan of these.

        A few points are looked at first: if these need all effects, the others can't need
        more.
        """
        tile_lengths = [tile_length for tile_length in self.tiles.block_shape if tile_length > 1]
        preview_stride = max(
            int(
                (math.prod(tile_lengths) / PREVIEW_POINTS_PER_TILE)
                ** (1 / max(len(tile_lengths), 1))
            ),
            1,
        )
        remaining = np.arange(len(tiles))
        for stride in (preview_stride, 1) if preview_stride > 1 else (1,):
            points_per_tile = math.prod(-(-tile_length // stride) for tile_length in tile_lengths)
            tiles_per_plan = max(POINTS_PER_PLAN_MAX // points_per_tile, 1)
            unsettled = []
            for start in range(0, len(remaining), tiles_per_plan):
                batch = remaining[start : start + tiles_per_plan]
                for tile_group in self.tiles.group_tiles(tiles[batch], stride):
                    plan = self._plan_group(tile_group)
                    is_settled = (
                        np.full(len(tile_group.requested_indices), stride == 1)
                        | plan.keeps_all_optional
                    )
                    if is_settled.any():
                        yield (
                            batch[tile_group.requested_indices[is_settled]],
                            plan.select(is_settled),
                        )
                    unsettled.append(batch[tile_group.requested_indices[~is_settled]])
            remaining = np.concatenate(unsettled) if unsettled else remaining[:0]

    def _plan_group(self, tile_group: TileGroup) -> EffectPlan:
        """Return the plan of tiles that share words and sizes."""
        from sweep.model.effects.planning import plan_effects

        parameters, n_tiles = tile_group.parameters, len(tile_group.requested_indices)
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


#: Dimension of the batches of draws.
BATCH_DIM = "batch"


def block_outputs(spec: GridSpec) -> dict[str, OutputVariable]:
    """Arrays that blocks of a study write, sorted by name, with dimensions besides the axes."""
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
        outputs |= SPECTRA_OUTPUTS | draw_outputs
    else:
        running_outputs = RUNNING_SUM_OUTPUTS if spec.has_random_effects else {}
        outputs |= GRID_OUTPUTS | STANDARD_ERROR_OUTPUTS | draw_outputs | running_outputs
    extra_dims = {RUNNING_SUMS: ("sum",)}
    if not spec.draws.is_adaptive:
        extra_dims |= dict.fromkeys(DRAW_COUNT_OUTPUTS, (BATCH_DIM,))
    return {name: replace(outputs[name], dims=extra_dims.get(name, ())) for name in sorted(outputs)}


class GridStudy(ExtendableStudy):
    """A study over a grid of parameters."""

    def __init__(self, spec: GridSpec) -> None:
        super().__init__(spec)
        self.grid = ParameterBlockGrid(spec)
        self.effect_planner = EffectPlanner(spec, self.grid)

    @property
    def grids(self) -> tuple[ParameterBlockGrid]:
        """Its points."""
        return (self.grid,)

    def depends_on_tolerance(self, block: int) -> np.ndarray | bool:
        """Mark the points of a block that a tighter tolerance computes more closely, (points,)."""
        return is_set_by_tolerance(self.grid.parameters(block))

    def store_attributes(self) -> dict[str, Any]:
        """Title, question, spec and the blocks' shape."""
        coordinate_names = [
            member.coordinate for axis in self.spec.axes for member in axis.parameters
        ]
        coordinate_names += ["batch_draws"] if batch_sizes(self.spec) else []
        return {
            "kind": "grid",
            "title": self.spec.title,
            "question": self.spec.question,
            "spec": self.spec.to_json(),
            "block_shape": list(self.grid.block_shape),
            # xarray's way to tell coordinates that share a dimension from variables
            "coordinates": " ".join(coordinate_names),
        }

    def constant_arrays(self) -> list[ArrayLayout]:
        """Coordinates, and the sizes of batches."""
        arrays = axis_coordinate_layouts(self.spec.axes)
        if draws_per_batch := batch_sizes(self.spec):
            batch_attributes = cf_attributes("1", "draws in the batch")
            arrays.append(
                ArrayLayout.from_values(
                    "batch_draws",
                    (BATCH_DIM,),
                    np.array(draws_per_batch, np.int64),
                    batch_attributes,
                )
            )
        return arrays

    def output_layouts(self) -> list[ArrayLayout]:
        """Return an array for each output of the model, and for the effects simulated."""
        sizes = {BATCH_DIM: len(batch_sizes(self.spec)), "sum": N_RUNNING_SUMS}
        off_axes = self.spec.parameters_off_axes()
        promised_accuracy = {  # that half-widths are held against
            name: float(off_axes[f"accuracy.{name}"])
            for name in ("tolerance", "confidence")
            if f"accuracy.{name}" in off_axes
        }
        layouts = []
        for name, output in block_outputs(self.spec).items():
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
        checkpoint_results: ReusedResults = ReusedResults(),  # noqa: B008
        deadline: Deadline | None = None,
    ) -> Results:
        """Return the outputs of a block; fill values where a point is beyond the model."""
        selected_effects = self.effect_planner.select_for_block(block)
        reused = self._reused_results(block, selected_effects)
        extent, n_points = self.grid.block_extent(block), self.grid.block_size(block)
        results = {
            name: np.full((n_points, *layout.shape[len(extent) :]), layout.fill_value, layout.dtype)
            for name, layout in self.layout_by_name.items()
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
            reused,
            checkpoint_results,
            deadline or Deadline(),
        )
        for local_indices, part_results in (reused.done, checkpoint_results.done, *computed):
            for name in (
                results.keys() & part_results.keys()
            ):  # some are of use to later draws alone
                results[name][local_indices] = part_results[name]
        return {name: values.reshape(extent + values.shape[1:]) for name, values in results.items()}

    @property
    def has_checkpoints(self) -> bool:
        """True if points are drawn: a block may stop between draws."""
        return self.spec.draws.has_draws

    def evaluate_until(
        self, block: int, checkpoint_results: ReusedResults, deadline: Deadline
    ) -> Results:
        """Return the outputs of a block, whose first draws are there; stop at the deadline."""
        return self.evaluate(block, checkpoint_results, deadline)

    def _reused_results(self, block: int, selected_effects: SelectedEffects) -> ReusedResults:
        """Points of a block that a smaller study has: whole, or their first draws."""
        if (reuse_source := self.reuse_source) is None:
            return ReusedResults()
        parts = []
        for shared in reuse_source.iter_shared_points(block):
            if (source_results := reuse_source.read_block(shared.source_block)) is None:
                continue
            n_axes, n_source_points = (
                len(reuse_source.source_study.grids[0].shape),
                reuse_source.source_study.block_size(shared.source_block),
            )
            has_same_effects = (
                source_results[EFFECTS_ARRAY].ravel()[shared.source_local_indices]
                == selected_effects.effect_flags[shared.local_indices]
            )
            results = {
                name: values.reshape(n_source_points, *values.shape[n_axes:])[
                    shared.source_local_indices[has_same_effects]
                ]
                for name, values in source_results.items()
                if name not in (EFFECTS_ARRAY, EFFECTS_ERROR_ARRAY)
            }
            parts.append(PartialResults(shared.local_indices[has_same_effects], results))
        local_indices, results = concatenate_results(parts)
        reused = PartialResults(
            local_indices, empty_running_sums(self.spec, local_indices.size) | results
        )
        reuse_source.reused_points_by_block[block] = (
            local_indices.size if reuse_source.has_final_results else 0
        )
        return (
            ReusedResults(done=reused)
            if reuse_source.has_final_results
            else ReusedResults(begun=reused)
        )

    def count_reusable_points(self, block: int) -> int:
        """Points of a block that the smaller study has, with the same effects."""
        if (reuse_source := self.reuse_source) is None:
            return 0
        selected_effects, n_reusable = self.effect_planner.select_for_block(block), 0
        for shared in reuse_source.iter_shared_points(block):
            with suppress(*CHUNK_READ_ERRORS):
                flags = reuse_source.read_chunk(EFFECTS_ARRAY, shared.source_block).ravel()
                n_reusable += int(
                    np.sum(
                        flags[shared.source_local_indices]
                        == selected_effects.effect_flags[shared.local_indices]
                    )
                )
        return n_reusable

    def compile_kernels(self) -> None:
        """Compile what the model compiles: a point with all effects that may be, and with none."""
        effect_modes, single_draw_spec = self.spec.effect_modes(), limit_draws(self.spec, 1)
        possible_effects = [
            effect.name
            for effect in EFFECT_CATALOGUE
            if effect_modes[effect.name] != "off" and not effect.is_random
        ]
        first_point_effects = unpack_effect_flags(
            int(self.effect_planner.select_for_block(0, np.zeros(1, np.int64)).effect_flags[0])
        )
        for effects in ({*possible_effects, *first_point_effects}, ()):
            with suppress(UnsupportedShotError):
                evaluate_points(
                    single_draw_spec, self.grid.parameters_at(np.zeros(1, np.int64)), 1, effects
                )


def axis_coordinate_layouts(axes: tuple[Axis, ...]) -> list[ArrayLayout]:
    """Arrays of the values along axes, in the units that they were written in."""
    return [
        ArrayLayout.from_values(
            member.coordinate,
            (axis.name,),
            np.asarray(member.display_values),
            cf_attributes(member.units, member.coordinate.replace("_", " "), name=member.coordinate)
            | {"path": member.path},
        )
        for axis in axes
        for member in axis.parameters
    ]


#: Points evaluated at once: enough that a call costs nothing beside them, few enough that a
#: worker's memory does not grow with the block. Their draws are cut further by the model.
POINTS_PER_CALL_MAX = 1 << 16

#: Counts of draws held at once; many batches make a point larger.
COUNTS_PER_CALL_MAX = 1 << 19

#: Parameters that change how draws are looked at, and not what is drawn.
NON_PHYSICAL_PREFIXES = (
    "accuracy.", "instrument.processing.detector.", "instrument.processing.estimator.", PEAKS_PATH
)  # fmt: skip

#: Domain of the keys of draws, so that no other use of the same seed meets their streams.
GRID_KEY_DOMAIN = "sweep.draws"


def iter_block_results(
    spec: GridSpec,
    grid: ParameterBlockGrid,
    block: int,
    selected_effects: SelectedEffects,
    reused: ReusedResults,
    checkpoint_results: ReusedResults,
    deadline: Deadline,
) -> Iterator[PartialResults]:
    """Compute a block's points that are not done, grouped by their effects.

    Those that need not be computed are ``reused``, of another study, or ``checkpoint_results`` by a
    call that was stopped. Unfinished where it is stopped; the next call goes on, to the same bits.
    """
    parameters, order = grid.parameters(block), grid.geometry_order(block)
    order = order[
        ~np.isin(order, [*reused.done.local_indices, *checkpoint_results.done.local_indices])
    ]
    finished, points_per_call = [checkpoint_results.done], _points_per_call(spec)
    pending = deque(
        (effects, local_indices)
        for members, effects in selected_effects.subset(order).iter_equal_groups()
        for local_indices in np.split(
            order[members], range(points_per_call, len(members), points_per_call)
        )
    )
    while pending:
        effects, local_indices = pending.popleft()
        if len(finished) > 1 and deadline():
            raise _unfinished_block(spec, finished, NO_RESULTS)
        is_resumed = np.isin(local_indices, checkpoint_results.begun.local_indices).any()
        prior_draws = previous_draws(
            spec, (checkpoint_results if is_resumed else reused).begun, local_indices
        )
        subset = select_parameters(parameters, local_indices)
        try:
            results = evaluate_points(
                spec, subset, len(local_indices), effects, prior_draws, deadline
            )
        except UnsupportedShotError:  # costs the point that is beyond the model, and no other
            if len(local_indices) > 1:
                pending.extendleft(
                    (effects, half) for half in np.array_split(local_indices, 2)[::-1]
                )
            continue
        if deadline.has_passed:
            raise _unfinished_block(spec, finished, PartialResults(local_indices, results))
        finished.append(PartialResults(local_indices, results))
        yield finished[-1]


def _unfinished_block(
    spec: GridSpec, finished: list[PartialResults], unfinished: PartialResults
) -> UnfinishedBlock:
    results = ReusedResults(
        concatenate_results([part for part in finished if part.local_indices.size]), unfinished
    )
    n_draws = unfinished.results["n_draws"].sum() if unfinished.local_indices.size else 0
    point_fraction = float(n_draws) / max(spec.draws.number, spec.draws.limit, 1)
    return UnfinishedBlock(results, results.done.local_indices.size + point_fraction)


def evaluate_points(
    spec: GridSpec,
    parameters: Mapping[str, ParameterValue],
    n_points: int,
    effects: Collection[str],
    prior_draws: PriorDraws | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Results:
    """Results of points, (count,) each; counts of a fixed number of draws (count, batches).

    Parameters are scalars, strings or arrays (count,). Draws go on from those ``prior_draws``,
    until there are all or ``should_stop`` says so.
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


def select_parameters(
    parameters: Mapping[str, ParameterValue], indices: np.ndarray
) -> dict[str, ParameterValue]:
    """Parameters of some of the points: arrays are taken from, scalars stay."""
    return {
        path: value[indices] if isinstance(value, np.ndarray) else value
        for path, value in parameters.items()
    }


def _points_per_call(spec: GridSpec) -> int:
    return max(1, min(POINTS_PER_CALL_MAX, COUNTS_PER_CALL_MAX // max(1, len(batch_sizes(spec)))))


def batch_sizes(spec: GridSpec) -> list[int]:
    """Draws in each batch of a fixed number; the last one holds what is left."""
    n_draws, draws_per_batch = spec.draws.number, spec.draws.batch
    return [min(draws_per_batch, n_draws - first) for first in range(0, n_draws, draws_per_batch)]


def draw_keys(
    spec: GridSpec, parameters: Mapping[str, ParameterValue], n_points: int
) -> np.ndarray:
    """Random keys (count, 2) uint64 of points, however closely these are looked at."""
    from sweep.model.sampling.philox import point_keys

    physical = {
        path: value
        for path, value in parameters.items()
        if not path.startswith(NON_PHYSICAL_PREFIXES)
    }
    return point_keys(
        canonical_point_rows(physical, n_points), domain=GRID_KEY_DOMAIN, seed=spec.seed
    )


def previous_draws(
    spec: GridSpec, previous: PartialResults, local_indices: np.ndarray
) -> PriorDraws | None:
    """Draws that there are of some points of a block; None where there are none."""
    from sweep.model.sampling.samplers import PriorDraws

    _, previous_rows, rows = np.intersect1d(
        previous.local_indices, local_indices, return_indices=True
    )
    if not rows.size:
        return None

    def spread_over_points(name: str) -> np.ndarray:
        values = previous.results[name][previous_rows]
        spread = np.zeros((len(local_indices), *values.shape[1:]), values.dtype)
        spread[rows] = values
        return spread

    counts = np.stack(
        [spread_over_points(name).reshape(len(local_indices), -1) for name in DRAW_COUNT_OUTPUTS]
    )
    n_missing_batches = max(1, len(batch_sizes(spec))) - counts.shape[-1]
    counts = np.pad(counts, ((0, 0), (0, 0), (0, n_missing_batches)))
    means = {
        name: spread_over_points(name)
        for name in (*GRID_OUTPUTS, RUNNING_SUMS)
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
    from sweep.model.sampling.samplers import never_stop, simulate_draws
    from sweep.tasks.studies.user_functions import spectrum_methods

    draws = spec.draws
    keywords: dict[str, Any] = {
        "keys": draw_keys(spec, parameters, n_points),
        "prior_draws": prior_draws,
        "should_stop": should_stop or never_stop,
        "method": draws.method,
        "error_budget": ErrorBudget.from_parameters(parameters, interval=draws.interval),
    }
    if draws.is_adaptive:
        keywords |= {"batch": draws.batch, "limit": draws.limit}
    else:
        keywords |= {"batch_sizes": batch_sizes(spec)}
    if draws.draws_whole_spectra:
        return simulate_draws(parameters, effects, methods=spectrum_methods(parameters), **keywords)
    return empty_running_sums(spec, n_points) | simulate_draws(parameters, effects, **keywords)


def empty_running_sums(spec: GridSpec, n_points: int) -> Results:
    """Return empty running sums, if any point of the study may have some."""
    has_running_sums = spec.has_random_effects and not spec.draws.draws_whole_spectra
    return {RUNNING_SUMS: np.zeros((n_points, N_RUNNING_SUMS))} if has_running_sums else {}


def limit_draws(spec: GridSpec, draws_max: int) -> GridSpec:
    """Limit the draws of a study, if it has any."""
    draw_counts = {
        "number": min(spec.draws.number, draws_max),
        "limit": min(spec.draws.limit, draws_max),
    }
    return spec.model_copy(update={"draws": spec.draws.model_copy(update=draw_counts)})
