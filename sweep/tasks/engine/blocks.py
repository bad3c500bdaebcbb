"""Arrays with named dimensions, cut into chunks, and grids of points, cut into blocks.

A :class:`BlockGrid` cuts points into blocks. An array is cut into chunks in the same way along
each dimension that it shares with the grid. This decides which chunks a block writes (owns)::

    blocks of (y, x)       array (y, x)           array (x,)
    +---+---+---+          +---+---+---+
    | 0 | 1 | 2 |          | 0 | 1 | 2 |          +---+---+---+
    +---+---+---+          +---+---+---+          | 0 | 1 | 2 |
    | 3 | 4 | 5 |          | 3 | 4 | 5 |          +---+---+---+
    +---+---+---+          +---+---+---+

If an array lacks a dimension of the grid, the first block along that dimension owns its chunks.
:mod:`sweep.tasks.engine.block_study` defines what a study of these blocks must implement.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

Results = dict[str, np.ndarray]
"""Arrays of results, by the name of the output variable."""

#: Fill value of arrays by the kind of their data type (NumPy code). No stored integer is -1.
FILL_VALUE_BY_DTYPE_KIND = {"f": float("nan"), "i": -1, "u": 0}


def chunk_slices(
    position: tuple[int, ...], chunks: tuple[int, ...], shape: tuple[int, ...]
) -> tuple[slice, ...]:
    """Return the part of an array that one chunk covers, as slices, cut at the edge of the array.

    `position` is the index of the chunk along each dimension. `chunks` is the shape of a chunk, and
    `shape` that of the array.
    """
    return tuple(
        slice(index * chunk, min((index + 1) * chunk, size))
        for index, chunk, size in zip(position, chunks, shape, strict=True)
    )


@dataclass(frozen=True, kw_only=True)
class ArrayLayout:
    """Layout of one array of a store: name, dimensions, shape, chunks and attributes.

    `known_values` are the values of an array that is known before any block is computed; None for
    arrays that blocks write.
    """

    name: str  # path inside the store
    shape: tuple[int, ...]
    chunks: tuple[int, ...]  # shape of a chunk
    dims: tuple[str, ...]  # names of the dimensions
    dtype: str  # name of the NumPy data type, or "string"
    fill_value: float | int | str | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    known_values: np.ndarray | None = None

    @classmethod
    def from_values(
        cls,
        name: str,
        dims: tuple[str, ...],
        values: np.ndarray,
        attributes: Mapping[str, Any],
        *,
        fill_value: float | None = None,
    ) -> ArrayLayout:
        """Return the layout of an array whose values are known. One chunk holds the array."""
        is_text = values.dtype.kind in "UOT"
        return cls(
            name=name,
            shape=values.shape,
            chunks=values.shape,
            dims=dims,
            dtype="string" if is_text else str(values.dtype),
            fill_value=fill_value,
            attributes=attributes,
            known_values=values.astype(object) if is_text else values,
        )

    @property
    def group_path(self) -> str:
        """Path of the store's group that contains the array; '' for the root."""
        return self.name.rpartition("/")[0]

    @property
    def n_chunks(self) -> int:
        """Number of chunks of the array."""
        return math.prod(
            -(-length // chunk) for length, chunk in zip(self.shape, self.chunks, strict=True)
        )

    def nbytes_of_part(self, shape: tuple[int, ...]) -> int:
        """Return the uncompressed size [bytes] of a part of the array, given the part's shape."""
        return math.prod(shape) * np.dtype(self.dtype).itemsize

    def chunk_region(self, position: tuple[int, ...]) -> tuple[slice, ...]:
        """Return the part of the array that one chunk covers, as slices.

        `position` is the index of the chunk along each dimension of the array's grid of chunks.
        """
        return chunk_slices(position, self.chunks, self.shape)


CF_CONVENTIONS_VERSION = "CF-1.11"
"""Version of the Climate and Forecast (CF) metadata conventions that all stores follow."""


class PointLocations(NamedTuple):
    """Blocks that contain points of a grid, and indices of the points within these blocks."""

    blocks: np.ndarray
    """Number of the block that contains each point, (n,) int64."""
    indices_in_block: np.ndarray
    """Index of each point within its block, in C order, (n,) int64."""


class BlockGrid:
    """Grid of points, cut into blocks along named dimensions; the last dimension varies fastest.

    Blocks and points are numbered in C order. ``fine_dim`` names a finer dimension: one step along
    the last grid dimension is ``fine_steps`` steps along the finer one. Arrays are in the ``group``
    of the store, or in its root if ``group`` is empty.
    """

    def __init__(
        self,
        dims: tuple[str, ...],
        shape: tuple[int, ...],
        block_shape: tuple[int, ...],
        *,
        group: str = "",
        fine_dim: str = "",
        fine_steps: int = 1,
    ) -> None:
        self.dims, self.shape, self.block_shape = dims, shape, block_shape
        self.group, self.fine_dim, self.fine_steps = group, fine_dim, fine_steps
        self.blocks_per_dim = tuple(
            -(-length // chunk) for length, chunk in zip(shape, block_shape, strict=True)
        )
        self.n_blocks = math.prod(self.blocks_per_dim)

    @property
    def n_points(self) -> int:
        """Number of points of all blocks."""
        return math.prod(self.shape) * self.fine_steps

    def block_position(self, block: int) -> tuple[int, ...]:
        """Return the index of a block along each dimension, given the block's number.

        IndexError is raised if the grid has no block of this number.
        """
        if not 0 <= block < self.n_blocks:
            raise IndexError(f"block {block} of {self.n_blocks}")
        return tuple(map(int, np.unravel_index(block, self.blocks_per_dim)))

    def block_at(self, block_position: tuple[int, ...]) -> int:
        """Return the number of a block, given its index along each dimension of the grid."""
        return (
            int(np.ravel_multi_index(block_position, self.blocks_per_dim)) if block_position else 0
        )

    def block_slices(self, block: int) -> tuple[slice, ...]:
        """Return the part of the grid that a block covers, as a slice for each dimension.

        The slices count grid steps. A block at the edge of the grid is cut at the edge.
        """
        return chunk_slices(self.block_position(block), self.block_shape, self.shape)

    def actual_block_shape(self, block: int) -> tuple[int, ...]:
        """Return the number of grid steps that a block covers along each dimension.

        A block at the edge of the grid may be smaller than `block_shape`.
        """
        return tuple(
            block_slice.stop - block_slice.start for block_slice in self.block_slices(block)
        )

    def count_block_points(self, block: int) -> int:
        """Return the number of points of a block."""
        return math.prod(self.actual_block_shape(block)) * self.fine_steps

    def count_points_in_blocks(self, is_included: np.ndarray) -> int:
        """Return the total number of points in the blocks for which `is_included` is True.

        `is_included` is a mask (blocks,).
        """
        counts = np.asarray(is_included, bool).reshape(self.blocks_per_dim)
        for size, chunk in zip(self.shape[::-1], self.block_shape[::-1], strict=True):
            counts = counts @ np.minimum(chunk, size - np.arange(0, size, chunk))
        return int(counts) * self.fine_steps

    def locate_points(self, grid_indices: np.ndarray) -> PointLocations:
        """Return the block of each point, by number, and the point's index within the block.

        `grid_indices` (n,) are the indices of the points in C order over the whole grid.
        """
        blocks, indices_in_block = np.zeros((2, grid_indices.size), np.int64)
        index = np.unravel_index(grid_indices, self.shape) if self.shape else ()
        for axis_index, size, chunk, n_blocks_along in zip(
            index, self.shape, self.block_shape, self.blocks_per_dim, strict=True
        ):
            start = axis_index // chunk * chunk
            blocks = blocks * n_blocks_along + axis_index // chunk
            indices_in_block = (
                indices_in_block * np.minimum(chunk, size - start) + axis_index - start
            )
        return PointLocations(blocks, indices_in_block)

    def point_indices_in_grid(self, block: int, indices_in_block: np.ndarray) -> np.ndarray:
        """Convert indices of points within a block to indices within the whole grid.

        `indices_in_block` (m,) and the result (m,) count points in C order. This is the inverse of
        `locate_points`.
        """
        if not self.shape:
            return np.zeros(indices_in_block.size, np.int64)
        axis_offsets = np.unravel_index(indices_in_block, self.actual_block_shape(block))
        axis_indices = [
            offset + block_slice.start
            for offset, block_slice in zip(axis_offsets, self.block_slices(block), strict=True)
        ]
        return np.asarray(np.ravel_multi_index(axis_indices, self.shape))

    def make_output_layout(
        self,
        name: str,
        dtype: str,
        dims: tuple[str, ...],
        sizes: Mapping[str, int],
        attributes: Mapping[str, Any],
    ) -> ArrayLayout:
        """Return the layout of an array of results, cut into chunks as the grid is cut into blocks.

        `sizes` has the lengths of those dimensions in `dims` that the grid lacks, by name.
        """
        array_sizes = dict(sizes) | dict(zip(self.dims, self.shape, strict=True))
        chunk_sizes = dict(sizes) | dict(zip(self.dims, self.block_shape, strict=True))
        if self.fine_dim:
            last_dim = self.dims[-1]
            array_sizes[self.fine_dim], chunk_sizes[self.fine_dim] = (
                array_sizes[last_dim] * self.fine_steps,
                chunk_sizes[last_dim] * self.fine_steps,
            )
        return ArrayLayout(
            name=f"{self.group}/{name}" if self.group else name,
            shape=tuple(array_sizes[dim] for dim in dims),
            chunks=tuple(chunk_sizes[dim] for dim in dims),
            dims=dims,
            dtype=dtype,
            fill_value=FILL_VALUE_BY_DTYPE_KIND[dtype[0]],
            attributes=attributes,
        )

    def grid_dim_indices(self, layout: ArrayLayout) -> tuple[int | None, ...]:
        """Return, for each dimension of an array, the grid dimension along which it is cut.

        A grid dimension is stated as its index. None stands for a dimension that is not cut.
        """
        grid_dim_of: dict[str, int] = {self.fine_dim: len(self.dims) - 1} if self.fine_dim else {}
        grid_dim_of |= {dim: position for position, dim in enumerate(self.dims)}
        return tuple(grid_dim_of.get(dim) for dim in layout.dims)

    def chunk_owner_blocks(self, layout: ArrayLayout) -> np.ndarray:
        """Return the number of the block that writes each chunk of an array.

        The result has the shape of the array's grid of chunks.
        """
        grid_dims = self.grid_dim_indices(layout)
        blocks = np.arange(self.n_blocks).reshape(self.blocks_per_dim)
        first_blocks = blocks[
            tuple(slice(None) if grid_dim in grid_dims else 0 for grid_dim in range(len(self.dims)))
        ]
        order = [grid_dim for grid_dim in grid_dims if grid_dim is not None]
        owners_by_dim = first_blocks.transpose(np.argsort(np.argsort(order)))
        return owners_by_dim.reshape(
            [1 if grid_dim is None else self.blocks_per_dim[grid_dim] for grid_dim in grid_dims]
        )


#: Largest number of blocks of a study. A run keeps some 30 bytes per block in memory, and a block
#: is one file per array in the store.
BLOCKS_PER_STUDY_MAX = 2 * 10**7
