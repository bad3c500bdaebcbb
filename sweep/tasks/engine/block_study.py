"""Interface between the engine, which schedules and stores, and the studies that it computes.

The engine knows a study as :class:`BlockStudy`: arrays, blocks of points, and a method that
computes one block. :class:`Workload` says what the study needs from the machines. Only the study
knows what a point is, and how it is computed.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from sweep.tasks.engine.blocks import ArrayLayout, BlockGrid, Results

if TYPE_CHECKING:
    from sweep.spec.sections import Execution
    from sweep.storage.locations import Location


class PartialResults(NamedTuple):
    """Results of some of a block's points, with the indices of these points."""

    indices_in_block: np.ndarray  # (m,) int64: indices of the points in C order over the block
    results: Results  # arrays (m, ...) by name


NO_RESULTS = PartialResults(np.zeros(0, np.int64), {})


class EarlierResults(NamedTuple):
    """Results of a block that exist already, from earlier tasks or from another store.

    Finished points are not computed again; unfinished points are continued.
    """

    finished: PartialResults = NO_RESULTS  # points that need not be computed
    unfinished: PartialResults = NO_RESULTS  # points that are computed in part, to be continued


def concatenate_results(parts: Sequence[PartialResults]) -> PartialResults:
    """Return the results of several parts of a block as one; `NO_RESULTS` without parts.

    All parts must have arrays of the same names.
    """
    if not parts:
        return NO_RESULTS
    names = parts[0].results
    return PartialResults(
        np.concatenate([part.indices_in_block for part in parts]),
        {name: np.concatenate([part.results[name] for part in parts]) for name in names},
    )


@dataclass
class Deadline:
    """Time at which a task stops work on a block. A call returns True once it has passed."""

    end_time: float = float("inf")  # time by `time.monotonic` [s]
    has_passed: bool = False  # True if any call so far was after the deadline

    def __call__(self) -> bool:
        """Return True if the time is at or after the deadline."""
        self.has_passed = self.has_passed or time.monotonic() >= self.end_time
        return self.has_passed


class UnfinishedBlockException(Exception):
    """Exception raised by a block that stops at its deadline. It holds the results so far.

    `n_points` is the number of points done. A point that is computed in part counts as a fraction.
    """

    def __init__(self, results: EarlierResults, n_points: float) -> None:
        super().__init__()
        self.results, self.n_points = results, n_points


class StoreTemplate(Protocol):
    """Content of a new store before any result: its identity, attributes, groups and arrays."""

    @property
    def id(self) -> str:
        """Hash, as hexadecimal text, of everything on which the results depend."""

    @property
    def model_version(self) -> str:
        """Version of the model that computes the results. Stores of other versions are refused."""

    def store_attributes(self) -> dict[str, Any]:
        """Return the store's root attributes, by name, without those that depend on the machine.

        Software versions depend on the machine, and are added by the engine.
        """

    def group_attributes(self) -> dict[str, dict[str, Any]]:
        """Return the attributes of each group of the store, by the group's path.

        The result is empty if all arrays are in the root group.
        """
        return {}

    def array_layouts(self) -> list[ArrayLayout]:
        """Return the layouts (names, shapes, chunks) of all arrays of the store."""


class GridBlock(NamedTuple):
    """Block of a study, given by its grid and its number within this grid."""

    grid: BlockGrid
    """Grid that contains the block."""
    block_in_grid: int
    """Number of the block within the grid."""


class GroupGrid(NamedTuple):
    """Grid of the blocks of a group of the store, and the number of the first block."""

    first_block: int
    """Number, within the study, of the grid's first block."""
    grid: BlockGrid
    """Grid of the group's blocks."""


class BlockStudy(StoreTemplate, ABC):
    """Study as the engine sees it: blocks of points, numbered grid by grid.

    A kind of study implements these parts:

    * `id`, `model_version`, `store_attributes` and `group_attributes`: identity, and attributes of
      its store. Equal ids have equal results, to the bit.
    * `grids`: how its points are cut into blocks, one grid per group of the store.
    * `constant_array_layouts`: layouts of the arrays whose values are known when the store is made.
    * `output_layouts`: layouts of the arrays that blocks write.
    * `evaluate` and `compile_kernels`: computation of one block.
    * `supports_checkpoints` and `evaluate_until`, if blocks can stop at a deadline and be continued
      later.
    * `pop_reused_point_count`, if results of another store are reused.

    Workers read the study of a store by `Workload.read_study`.
    """

    points_noun = "points"
    """Noun for the points in messages, in the plural."""

    @property
    @abstractmethod
    def grids(self) -> Sequence[BlockGrid]:
        """Grids that cut the study's points into blocks, one grid for each group of the store."""

    @abstractmethod
    def constant_array_layouts(self) -> list[ArrayLayout]:
        """Return the layouts of the arrays whose values are known when the store is made.

        Each layout holds the values of its array. Coordinates are an example.
        """

    @abstractmethod
    def output_layouts(self) -> list[ArrayLayout]:
        """Return the layouts (names, shapes, chunks) of the arrays of results that blocks write."""

    @abstractmethod
    def evaluate(self, block: int) -> Results:
        """Compute a block, given by its number. Return its results, by the name of the array.

        A block writes at most one chunk of each array. The result for an array has the shape of
        that chunk.
        """

    @abstractmethod
    def compile_kernels(self) -> None:
        """Compile all kernels that `evaluate` needs. Workers load them from the cache on disk."""

    @property
    def supports_checkpoints(self) -> bool:
        """True if a block may be stopped at a deadline and continued in another task."""
        return False

    def evaluate_until(
        self, block: int, checkpoint_results: EarlierResults, deadline: Deadline
    ) -> Results:
        """Continue a block from a checkpoint until it is complete, and return its results.

        The results equal those of `evaluate`. `UnfinishedBlockException` is raised at the deadline.
        If `supports_checkpoints`, the engine calls this method in place of `evaluate`.
        """
        raise NotImplementedError

    def pop_reused_point_count(self, block: int) -> int:
        """Return the number of points of a computed block that were copied from another store.

        The count is deleted on return, so that a second call for the block returns 0.
        """
        return 0

    def array_layouts(self) -> list[ArrayLayout]:
        """Return the layouts of all arrays of the store: constant arrays, then results."""
        return [*self.constant_array_layouts(), *self.output_layout_by_name.values()]

    @cached_property
    def output_layout_by_name(self) -> dict[str, ArrayLayout]:
        """Layouts of the arrays of results that blocks write, by the name of the array."""
        return {layout.name: layout for layout in self.output_layouts()}

    @property
    def n_chunks(self) -> int:
        """Number of chunks that all blocks write, over all arrays."""
        return sum(layout.n_chunks for layout in self.output_layout_by_name.values())

    @property
    def nbytes(self) -> int:
        """Size of all results before compression [bytes]."""
        return sum(
            layout.nbytes_of_part(layout.shape) for layout in self.output_layout_by_name.values()
        )

    @property
    def largest_block_nbytes(self) -> int:
        """Size of the results of the largest block, before compression [bytes]."""
        nbytes_by_group = dict.fromkeys(self._grid_by_group, 0)
        for layout in self.output_layout_by_name.values():
            nbytes_by_group[layout.group_path] += layout.nbytes_of_part(layout.chunks)
        return max(nbytes_by_group.values())

    @property
    def n_points(self) -> int:
        """Total number of points in all blocks."""
        return sum(grid.n_points for grid in self.grids)

    @property
    def n_blocks(self) -> int:
        """Number of blocks in all grids."""
        return sum(grid.n_blocks for grid in self.grids)

    def locate_block(self, block: int) -> GridBlock:
        """Return the grid that contains a block, and the number of the block within that grid.

        IndexError is raised if there is no such block.
        """
        block_in_grid = block
        for grid in self.grids:
            if 0 <= block_in_grid < grid.n_blocks:
                return GridBlock(grid, block_in_grid)
            block_in_grid -= grid.n_blocks
        raise IndexError(f"block {block} of {self.n_blocks}")

    @cached_property
    def _grid_by_group(self) -> dict[str, GroupGrid]:
        """Grid of each group's blocks, and number of the group's first block, by group path."""
        last_blocks = np.cumsum([grid.n_blocks for grid in self.grids]).tolist()
        return {
            block_grid.group: GroupGrid(end - block_grid.n_blocks, block_grid)
            for block_grid, end in zip(self.grids, last_blocks, strict=True)
        }

    def first_block_of_group(self, group: str) -> int:
        """Return the number, within the study, of the first block of a group of the store."""
        return self._grid_by_group[group].first_block

    def count_block_points(self, block: int) -> int:
        """Return the number of points of a block."""
        grid, block_in_grid = self.locate_block(block)
        return grid.count_block_points(block_in_grid)

    def count_points_in_blocks(self, is_included: np.ndarray) -> int:
        """Return the total number of points in the blocks for which `is_included` is True.

        `is_included` is a mask (blocks,).
        """
        parts = np.split(is_included, np.cumsum([grid.n_blocks for grid in self.grids])[:-1])
        return sum(
            grid.count_points_in_blocks(part) for grid, part in zip(self.grids, parts, strict=True)
        )

    @cached_property
    def _grid_dim_indices_by_array(self) -> dict[str, dict[str, tuple[int | None, ...]]]:
        """Grid dimension along which each dimension of an array is cut, by group and array.

        A grid dimension is stated as its index. None stands for a dimension of the array that is
        not cut.
        """
        grid_dims: dict[str, dict[str, tuple[int | None, ...]]] = {
            group: {} for group in self._grid_by_group
        }
        for name, layout in self.output_layout_by_name.items():
            grid = self._grid_by_group[layout.group_path].grid
            grid_dims[layout.group_path][name] = grid.grid_dim_indices(layout)
        return grid_dims

    def chunk_positions_of_block(self, block: int) -> dict[str, tuple[int, ...]]:
        """Return the position of the chunk that a block writes in each array, by array name.

        A position is the index of the chunk along each dimension of the array. If an array lacks a
        dimension of the block grid, only the first block along that dimension writes the array. The
        result for any other block has no entry for that array.
        """
        grid, block_in_grid = self.locate_block(block)
        position = grid.block_position(block_in_grid)
        nonzero_dims = {
            dim for dim, index in enumerate(position) if index
        }  # the array must have all of these dimensions
        return {
            name: tuple(0 if dim is None else position[dim] for dim in grid_dims)
            for name, grid_dims in self._grid_dim_indices_by_array[grid.group].items()
            if nonzero_dims.issubset(grid_dims)
        }

    def chunk_regions_of_block(self, block: int) -> dict[str, tuple[slice, ...]]:
        """Return the part of each array that a block writes, as slices, by array name."""
        return {
            name: self.output_layout_by_name[name].chunk_region(position)
            for name, position in self.chunk_positions_of_block(block).items()
        }

    def chunk_owner_blocks(self) -> dict[str, np.ndarray]:
        """Return the number of the block that writes each chunk, by the name of the array.

        Each value of the result is an integer array in the shape of that array's grid of chunks.
        """
        owners_by_array = {}
        for array_name, layout in self.output_layout_by_name.items():
            first_block, grid = self._grid_by_group[layout.group_path]
            owners_by_array[array_name] = first_block + grid.chunk_owner_blocks(layout)
        return owners_by_array


BlockEvaluator = Callable[[Any, int], Results]
"""Function that computes a block in place of the study: (study, number of the block) -> results."""

StudyT = TypeVar("StudyT", bound=BlockStudy, covariant=True)
"""Type of the study that a `StoredStudy` holds."""


class StoredStudy(NamedTuple, Generic[StudyT]):
    """Study that was read from its store."""

    attributes: dict[str, Any]
    """Root attributes of the store."""
    study: StudyT
    """Study whose results the store holds."""


StudyReader = Callable[["Location"], StoredStudy[BlockStudy]]
"""Function that returns the study in the store at a location, or raises a StoreError.

The function must be defined at the top level of a module, as it is sent to workers by name.
"""


class Workload(Protocol):
    """Requirements of a study on the machines that compute it, known from its spec alone."""

    @property
    def execution(self) -> Execution:
        """Section `execution` of the spec: number of workers and threads, and scheduler."""

    @property
    def user_module_names(self) -> tuple[str, ...]:
        """Names of the user's Python modules that are called while blocks are computed."""

    @property
    def read_study(self) -> StudyReader:
        """Function with which a worker reads the study from its store."""
