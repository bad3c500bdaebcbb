"""Studies as blocks: arrays with named dimensions, cut into chunks, whole ones for each block.

A :class:`BlockGrid` cuts points into blocks. An array follows it along the dimensions that it has,
so that which chunks a block owns needs no further rule::

    blocks of (y, x)       array (y, x)           array (x,)
    +---+---+---+          +---+---+---+
    | 0 | 1 | 2 |          | 0 | 1 | 2 |          +---+---+---+
    +---+---+---+          +---+---+---+          | 0 | 1 | 2 |
    | 3 | 4 | 5 |          | 3 | 4 | 5 |          +---+---+---+
    +---+---+---+          +---+---+---+

Of what lacks a dimension the first block along it is the owner. A grid's dimensions are its axes; a
flight has a grid for each scanner, of (axes, draw, cycle); eyepoints have (cycle).
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from sweep.spec.rules import Mistake, SpecError

if TYPE_CHECKING:
    from sweep.model.outputs import OutputVariable
    from sweep.spec import GridSpec, SceneSpec

Results = dict[str, np.ndarray]

#: Fill of arrays by the kind of their numbers: a count or a surface's number is never negative.
FILL_VALUE_BY_KIND = {"f": float("nan"), "i": -1, "u": 0}


def chunk_slices(
    position: tuple[int, ...], chunks: tuple[int, ...], shape: tuple[int, ...]
) -> tuple[slice, ...]:
    """Slices of the chunk at a position among chunks, cut at the far edge."""
    return tuple(
        slice(index * chunk, min((index + 1) * chunk, size))
        for index, chunk, size in zip(position, chunks, shape, strict=True)
    )


@dataclass(frozen=True, kw_only=True)
class ArrayLayout:
    """An array of a store: its path inside, shape, chunks; its values if they are known."""

    name: str
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dims: tuple[str, ...]
    dtype: str
    fill_value: float | int | str | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    values: np.ndarray | None = None

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
        """Return an array whose values are known as the store is made, in a single chunk."""
        is_text = values.dtype.kind in "UOT"
        return cls(
            name=name,
            shape=values.shape,
            chunks=values.shape,
            dims=dims,
            dtype="string" if is_text else str(values.dtype),
            fill_value=fill_value,
            attributes=attributes,
            values=values.astype(object) if is_text else values,
        )

    @property
    def group_path(self) -> str:
        """Group that it is in; empty for the root."""
        return self.name.rpartition("/")[0]

    @property
    def n_chunks(self) -> int:
        """Number of its chunks."""
        return math.prod(
            -(-length // chunk) for length, chunk in zip(self.shape, self.chunks, strict=True)
        )

    def nbytes_of(self, shape: tuple[int, ...]) -> int:
        """Bytes of a part of such a shape, before compression."""
        return math.prod(shape) * np.dtype(self.dtype).itemsize

    def region(self, position: tuple[int, ...]) -> tuple[slice, ...]:
        """Slices of the chunk at a position."""
        return chunk_slices(position, self.chunks, self.shape)


CF_CONVENTIONS = "CF-1.11"
"""Metadata conventions of a store's attributes: units, names, flags."""

_CLOSING_VELOCITY_NAME = "radial_velocity_of_scatterers_toward_instrument"
CF_STANDARD_NAMES = {
    "altitude": "height",
    "true_altitude": "height",
    "beam_radial_velocity": _CLOSING_VELOCITY_NAME,
    "radial_velocity": _CLOSING_VELOCITY_NAME,
    "radial_velocity_interpolated": _CLOSING_VELOCITY_NAME,
    "true_radial_velocity": _CLOSING_VELOCITY_NAME,
    "sun_elevation": "solar_elevation_angle",
    "wavelength": "radiation_wavelength",
}
"""Arrays and coordinates whose quantities are in the CF standard name table (version 90)."""


def cf_attributes(units: str, long_name: str, comment: str = "", name: str = "") -> dict[str, Any]:
    """Attributes that say what an array of this name holds, by the CF conventions."""
    attributes = {"units": units, "long_name": long_name}
    optional = {"comment": comment, "standard_name": CF_STANDARD_NAMES.get(name, "")}
    return attributes | {key: value for key, value in optional.items() if value}


class BlockGrid:
    """Points cut into blocks along named dimensions, the last one fastest.

    A ``fine_dim`` dimension divides every step of the last one into ``fine_steps``: shots of a
    cycle. Arrays are in a ``group`` of the store; empty for the root.
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
        """Position of a block among the blocks; IndexError where there is no such block."""
        if not 0 <= block < self.n_blocks:
            raise IndexError(f"block {block} of {self.n_blocks}")
        return tuple(map(int, np.unravel_index(block, self.blocks_per_dim)))

    def block_at(self, block_position: tuple[int, ...]) -> int:
        """Return the number of the block at a position."""
        return (
            int(np.ravel_multi_index(block_position, self.blocks_per_dim)) if block_position else 0
        )

    def block_slices(self, block: int) -> tuple[slice, ...]:
        """Slices of a block along each dimension, cut at the edge of the grid."""
        return chunk_slices(self.block_position(block), self.block_shape, self.shape)

    def block_extent(self, block: int) -> tuple[int, ...]:
        """Return steps of a block along each dimension."""
        return tuple(
            block_slice.stop - block_slice.start for block_slice in self.block_slices(block)
        )

    def block_size(self, block: int) -> int:
        """Return the number of points of a block."""
        return math.prod(self.block_extent(block)) * self.fine_steps

    def count_points(self, is_included: np.ndarray) -> int:
        """Points in the blocks that are marked in an ndarray of bool (blocks,)."""
        counts = np.asarray(is_included, bool).reshape(self.blocks_per_dim)
        for size, chunk in zip(self.shape[::-1], self.block_shape[::-1], strict=True):
            counts = counts @ np.minimum(chunk, size - np.arange(0, size, chunk))
        return int(counts) * self.fine_steps

    def locate_points(self, grid_indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Blocks of points, which are given in C order over the grid, and places in these."""
        blocks, local_indices = np.zeros((2, grid_indices.size), np.int64)
        index = np.unravel_index(grid_indices, self.shape) if self.shape else ()
        for axis_index, size, chunk, n_blocks_along in zip(
            index, self.shape, self.block_shape, self.blocks_per_dim, strict=True
        ):
            start = axis_index // chunk * chunk
            blocks = blocks * n_blocks_along + axis_index // chunk
            local_indices = local_indices * np.minimum(chunk, size - start) + axis_index - start
        return blocks, local_indices

    def grid_indices(self, block: int, local_indices: np.ndarray) -> np.ndarray:
        """Points at places of a block, in C order over the grid: inverse of `locate_points`."""
        if not self.shape:
            return np.zeros(local_indices.size, np.int64)
        axis_offsets = np.unravel_index(local_indices, self.block_extent(block))
        axis_indices = [
            offset + block_slice.start
            for offset, block_slice in zip(axis_offsets, self.block_slices(block), strict=True)
        ]
        return np.asarray(np.ravel_multi_index(axis_indices, self.shape))

    def make_layout(
        self,
        name: str,
        output: OutputVariable,
        dims: tuple[str, ...],
        sizes: Mapping[str, int],
        attributes: Mapping[str, Any] | None = None,
    ) -> ArrayLayout:
        """Return an array of the model's, cut along the dimensions that follow the grid."""
        array_sizes = dict(sizes) | dict(zip(self.dims, self.shape, strict=True))
        chunk_sizes = dict(sizes) | dict(zip(self.dims, self.block_shape, strict=True))
        if self.fine_dim:
            last_dim = self.dims[-1]
            array_sizes[self.fine_dim], chunk_sizes[self.fine_dim] = (
                array_sizes[last_dim] * self.fine_steps,
                chunk_sizes[last_dim] * self.fine_steps,
            )
        output_attributes = cf_attributes(output.units, output.long_name, output.comment, name)
        return ArrayLayout(
            name=f"{self.group}/{name}" if self.group else name,
            shape=tuple(array_sizes[dim] for dim in dims),
            chunks=tuple(chunk_sizes[dim] for dim in dims),
            dims=dims,
            dtype=output.dtype,
            fill_value=FILL_VALUE_BY_KIND[output.dtype[0]],
            attributes=output_attributes | dict(attributes or {}),
        )

    def grid_dims_of(self, layout: ArrayLayout) -> tuple[int | None, ...]:
        """Dimension of the grid that each of an array's dimensions follows; None for none."""
        grid_dim_of: dict[str, int] = {self.fine_dim: len(self.dims) - 1} if self.fine_dim else {}
        grid_dim_of |= {dim: position for position, dim in enumerate(self.dims)}
        return tuple(grid_dim_of.get(dim) for dim in layout.dims)

    def chunk_owners(self, layout: ArrayLayout) -> np.ndarray:
        """Block that writes each chunk of an array, in the shape of its grid of chunks."""
        grid_dims = self.grid_dims_of(layout)
        blocks = np.arange(self.n_blocks).reshape(self.blocks_per_dim)
        first_blocks = blocks[
            tuple(slice(None) if grid_dim in grid_dims else 0 for grid_dim in range(len(self.dims)))
        ]
        order = [grid_dim for grid_dim in grid_dims if grid_dim is not None]
        owners_by_dim = first_blocks.transpose(np.argsort(np.argsort(order)))
        return owners_by_dim.reshape(
            [1 if grid_dim is None else self.blocks_per_dim[grid_dim] for grid_dim in grid_dims]
        )


ParameterValue = float | int | str | np.ndarray

#: Parameters that move the beamlets over the target; every other one only scales or reads lines
#: that are already placed, and is cheap once they are.
GEOMETRIC_PARAMETERS = (
    "target.range",
    "target.grazing_angle",
    "target.radial_velocity",
    "target.transverse_velocity",
    "target.pointing_jitter",
)
GEOMETRIC_PREFIXES = (
    "instrument.laser.beam_", "instrument.laser.focus", "instrument.telescope.coupling",
    "instrument.receiver.local_oscillator_waist", "footprint.",
)  # fmt: skip

TOLERANCE_PARAMETER = "accuracy.tolerance"

#: Shots of a flight that are planned together.
SHOTS_PER_TILE = 256

#: Seconds that a block takes at the most, as :func:`worst_cpu_seconds_per_point` has it: what is
#: lost where a worker dies. It also bounds the counts of draws, one a point and batch, to some
#: 100 MB.
BLOCK_CPU_SECONDS_MAX = 60.0

#: Points of a block at the most, and blocks beyond which it grows: a block is some 25 files, and
#: what lists, copies or removes a store handles them one by one.
DEFAULT_BLOCK_POINTS = 1 << 16
DEFAULT_BLOCKS_MAX = 1 << 14


def worst_cpu_seconds_per_point(spec: GridSpec) -> float:
    """Time of the dearest point of a study on one core, by the study alone [s].

    Measured on one machine and rounded up: the content of a block must not depend on the
    machine. Draws until a tolerance is met are reckoned with their limit.
    """
    worst_parameters = {
        path: value for path, value in spec.parameters().items() if not isinstance(value, str)
    }
    for axis in spec.axes:
        for member in axis.parameters:
            if isinstance(member.values, np.ndarray):
                worst_parameters[member.path] = member.values.max()
    draws = spec.draws
    seconds_per_draw = 4e-5 + 2e-7 * float(worst_parameters.get("footprint.beamlets", 0.0))
    if draws.draws_whole_spectra:
        seconds_per_draw += 2e-7 * float(worst_parameters["instrument.processing.fft_size"])
    return seconds_per_draw * max(draws.number, draws.limit, 1)


def fit_block_shape(
    sizes: tuple[int, ...], is_geometric: tuple[bool, ...], block_points: int
) -> tuple[int, ...]:
    """Points of a block along each axis, given whether each axis changes the geometry.

    Radiometric axes are kept whole before geometric ones, and the last axis before the first,
    as far as the block has room: it then holds every radiometric variation of its geometry.
    """
    order = sorted(range(len(sizes)), key=lambda k: (is_geometric[k], -k))
    shape, points_left = [1] * len(sizes), block_points
    for axis in order:
        shape[axis] = min(sizes[axis], points_left)
        points_left //= shape[axis]
    return tuple(shape)


def default_block_points(n_points: int) -> int:
    """Points that a block holds at most in a study of so many, where it does not say."""
    return max(DEFAULT_BLOCK_POINTS, -(-n_points // DEFAULT_BLOCKS_MAX))


def block_points_limit(spec: GridSpec, n_points: int) -> int:
    """Points that a block may hold: as the spec says, or fits it; less where each takes long."""
    requested_points = spec.storage.block_points or default_block_points(n_points)
    return max(
        1, min(requested_points, int(BLOCK_CPU_SECONDS_MAX / worst_cpu_seconds_per_point(spec)))
    )


#: Blocks of a study at most: a run remembers some 30 bytes of each, and makes files of it.
BLOCKS_MAX = 2 * 10**7


class ParameterGrid:
    """Parameters along the axes of a study: those that are fixed, and those of each axis."""

    def __init__(self, spec: GridSpec | SceneSpec) -> None:
        self.fixed_parameters: dict[str, float | int | str] = dict(spec.parameters())
        self.shape = tuple(int(axis.size) for axis in spec.axes)
        self.values_by_axis = [
            {member.path: np.asarray(member.values) for member in axis.parameters}
            for axis in spec.axes
        ]
        """Values along each axis by the parameters that they set."""

    def values_by_dim(self) -> list[dict[str, np.ndarray]]:
        """Values along each dimension, by what they are of."""
        return self.values_by_axis


class ParameterBlockGrid(ParameterGrid, BlockGrid):
    """Points of a study over a grid, their parameters, and the blocks they are computed in."""

    def __init__(self, spec: GridSpec) -> None:
        ParameterGrid.__init__(self, spec)
        self.spec = spec
        self.is_geometric_axis = tuple(
            any(
                path in GEOMETRIC_PARAMETERS or path.startswith(GEOMETRIC_PREFIXES)
                for path in values
            )
            for values in self.values_by_axis
        )
        points_max = block_points_limit(spec, math.prod(self.shape))
        dims = tuple(axis.name for axis in spec.axes)
        BlockGrid.__init__(
            self, dims, self.shape, fit_block_shape(self.shape, self.is_geometric_axis, points_max)
        )
        if self.n_blocks > BLOCKS_MAX:
            rule = (
                f"makes {self.n_points:.3g} points in {self.n_blocks:.3g} blocks, and a study has "
                f"at most {BLOCKS_MAX:.0e}"
            )
            remedy = "take fewer values or fewer draws, or raise storage.block_points"
            raise SpecError([Mistake("axes", rule, "", remedy)])

    def parameters(self, block: int) -> dict[str, ParameterValue]:
        """Parameters of a block's points by path: scalars, or arrays (n,) in C order over it."""
        return self.parameters_at(self.grid_indices(block, np.arange(self.block_size(block))))

    def parameters_at(self, grid_indices: np.ndarray) -> dict[str, ParameterValue]:
        """Parameters of points given by their numbers in C order over the whole grid, (n,)."""
        parameters: dict[str, ParameterValue] = dict(self.fixed_parameters)
        indices = np.unravel_index(grid_indices, self.shape) if self.shape else ()
        for values, axis_indices in zip(self.values_by_axis, indices, strict=True):
            parameters |= {path: array[axis_indices] for path, array in values.items()}
        return parameters

    def geometry_order(self, block: int) -> np.ndarray:
        """Order of a block's points, (n,) in C order over it, that brings equal geometry together.

        Radiometric axes run fastest, and velocities slowest: a line's change within a
        record follows them.
        """
        local_indices = np.arange(self.block_size(block)).reshape(self.block_extent(block))
        is_velocity_axis = ["target.radial_velocity" in values for values in self.values_by_axis]
        axes = sorted(
            range(len(self.shape)),
            key=lambda axis: (not self.is_geometric_axis[axis], not is_velocity_axis[axis], axis),
        )
        return local_indices.transpose(axes).ravel()


class StoreTemplate(Protocol):
    """Anything that a store is made of."""

    @property
    def id(self) -> str:
        """Hash of all that its results depend on."""

    def store_attributes(self) -> dict[str, Any]:
        """Attributes of its store, but for versions; the same wherever it is made."""

    def group_attributes(self) -> dict[str, dict[str, Any]]:
        """Return groups of its store and their attributes; none but the root."""
        return {}

    def array_layouts(self) -> list[ArrayLayout]:
        """Every array of its store."""


class BlockStudy(StoreTemplate, ABC):
    """A study as the driver and its workers see it; blocks are numbered grid by grid."""

    points_noun = "points"
    """Name of its points, in the plural."""

    @property
    @abstractmethod
    def grids(self) -> Sequence[BlockGrid]:
        """Blocks of each group of its store."""

    @abstractmethod
    def constant_arrays(self) -> list[ArrayLayout]:
        """Arrays whose values are known as the store is made."""

    @abstractmethod
    def output_layouts(self) -> list[ArrayLayout]:
        """Arrays that blocks write."""

    @abstractmethod
    def evaluate(self, block: int) -> Results:
        """Results of a block by the names of its arrays, each with its chunk's shape."""

    @abstractmethod
    def compile_kernels(self) -> None:
        """Compile what evaluation compiles, so that workers find it on disk."""

    def array_layouts(self) -> list[ArrayLayout]:
        """Every array of its store."""
        return [*self.constant_arrays(), *self.layout_by_name.values()]

    @cached_property
    def layout_by_name(self) -> dict[str, ArrayLayout]:
        """Arrays that blocks write, by name."""
        return {layout.name: layout for layout in self.output_layouts()}

    @property
    def n_chunks(self) -> int:
        """Number of chunks of all blocks."""
        return sum(layout.n_chunks for layout in self.layout_by_name.values())

    @property
    def nbytes(self) -> int:
        """Bytes of all results, before compression."""
        return sum(layout.nbytes_of(layout.shape) for layout in self.layout_by_name.values())

    @property
    def block_nbytes_max(self) -> int:
        """Bytes of the results of the largest block, before compression."""
        nbytes_by_group = dict.fromkeys(self._first_block_and_grid_by_group, 0)
        for layout in self.layout_by_name.values():
            nbytes_by_group[layout.group_path] += layout.nbytes_of(layout.chunks)
        return max(nbytes_by_group.values())

    @property
    def n_points(self) -> int:
        """Number of points of all blocks."""
        return sum(grid.n_points for grid in self.grids)

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return sum(grid.n_blocks for grid in self.grids)

    def locate_in_grid(self, block: int) -> tuple[BlockGrid, int]:
        """Return the grid that a block is of, and its number there; IndexError if there is none."""
        block_in_grid = block
        for grid in self.grids:
            if 0 <= block_in_grid < grid.n_blocks:
                return grid, block_in_grid
            block_in_grid -= grid.n_blocks
        raise IndexError(f"block {block} of {self.n_blocks}")

    @cached_property
    def _first_block_and_grid_by_group(self) -> dict[str, tuple[int, BlockGrid]]:
        """Number of the first block of each group, and its grid."""
        last_blocks = np.cumsum([grid.n_blocks for grid in self.grids]).tolist()
        return {
            block_grid.group: (end - block_grid.n_blocks, block_grid)
            for block_grid, end in zip(self.grids, last_blocks, strict=True)
        }

    def first_block_of_group(self, group: str) -> int:
        """Return the number of the first block of a group."""
        return self._first_block_and_grid_by_group[group][0]

    def block_size(self, block: int) -> int:
        """Points of a block."""
        grid, block_in_grid = self.locate_in_grid(block)
        return grid.block_size(block_in_grid)

    def count_points(self, is_included: np.ndarray) -> int:
        """Points in the blocks that are marked in an ndarray of bool (blocks,)."""
        parts = np.split(is_included, np.cumsum([grid.n_blocks for grid in self.grids])[:-1])
        return sum(grid.count_points(part) for grid, part in zip(self.grids, parts, strict=True))

    @cached_property
    def _grid_dims_by_array(self) -> dict[str, dict[str, tuple[int | None, ...]]]:
        """Dimensions of the grid that each array follows, by group and name."""
        grid_dims: dict[str, dict[str, tuple[int | None, ...]]] = {
            group: {} for group in self._first_block_and_grid_by_group
        }
        for name, layout in self.layout_by_name.items():
            grid_dims[layout.group_path][name] = self._first_block_and_grid_by_group[
                layout.group_path
            ][1].grid_dims_of(layout)
        return grid_dims

    def chunk_positions(self, block: int) -> dict[str, tuple[int, ...]]:
        """Chunks that a block writes, whole: the position of one in each of some arrays."""
        grid, block_in_grid = self.locate_in_grid(block)
        position = grid.block_position(block_in_grid)
        nonzero_dims = {
            dim for dim, index in enumerate(position) if index
        }  # of these an array must have them all
        return {
            name: tuple(0 if dim is None else position[dim] for dim in grid_dims)
            for name, grid_dims in self._grid_dims_by_array[grid.group].items()
            if nonzero_dims.issubset(grid_dims)
        }

    def chunk_regions(self, block: int) -> dict[str, tuple[slice, ...]]:
        """Slices of the arrays that a block writes."""
        return {
            name: self.layout_by_name[name].region(position)
            for name, position in self.chunk_positions(block).items()
        }

    def chunk_owners(self) -> dict[str, np.ndarray]:
        """Block that writes each chunk, in the shape of the grid of chunks, of every output."""
        owners_by_array = {}
        for array_name, layout in self.layout_by_name.items():
            first_block, grid = self._first_block_and_grid_by_group[layout.group_path]
            owners_by_array[array_name] = first_block + grid.chunk_owners(layout)
        return owners_by_array


#: Errors of Zarr at a chunk that is not there, or not as it was written.
CHUNK_READ_ERRORS = (OSError, ValueError, RuntimeError)


class ExtendableStudy(BlockStudy):
    """A study that may be extended, and may extend another."""

    def __init__(self, spec: Any) -> None:
        self.spec = spec
        self.find_reuse_source: Callable[[], Any] = lambda: None

    @cached_property
    def reuse_source(self) -> Any:
        """Results of a smaller study, or None; looked for as the first block is computed."""
        return self.find_reuse_source()

    @property
    def id(self) -> str:
        """Hash of the spec's identity."""
        return str(self.spec.id)

    @abstractmethod
    def depends_on_tolerance(self, block: int) -> np.ndarray | bool:
        """Mark the points of a block that a tighter tolerance computes more closely, (points,)."""

    def first_draw_block(self, block: int) -> int:
        """Block with all that the draws of a block have in common."""
        return block

    def count_reusable_points(self, block: int) -> int:
        """Points of a block that the smaller study has, if nothing is damaged."""
        shared = self.reuse_source.iter_shared_points(block) if self.reuse_source else ()
        return (
            sum(shared_points.local_indices.size for shared_points in shared)
            * self.locate_in_grid(block)[0].fine_steps
        )


SPECTRUM_METHOD_PARAMETERS = {
    "detector": "instrument.processing.detector.kind",
    "estimator": "instrument.processing.estimator.kind",
}
"""Parameters that name what looks at whole spectra: one of ours, or a function of the user's."""


def user_functions(spec: Any) -> Iterator[tuple[str, str]]:
    """Roles and names of the functions of the user's that a study names."""
    draws = getattr(spec, "draws", None)
    if not getattr(draws, "draws_whole_spectra", False):
        return
    for role, path in SPECTRUM_METHOD_PARAMETERS.items():
        axis_values = [
            member.values for axis in spec.axes for member in axis.parameters if member.path == path
        ]
        names = axis_values[0] if axis_values else [spec.parameters()[path]]
        yield from ((role, name) for name in dict.fromkeys(map(str, names)) if ":" in name)


BlockEvaluator = Callable[[Any, int], Results]
"""Computes a block of a study in its place, with the same results by name."""


class PartialResults(NamedTuple):
    """Results of some points of a block."""

    local_indices: np.ndarray  # (m,) int64: their numbers in C order over the block
    results: Results  # (m, ...) each, by name


NO_RESULTS = PartialResults(np.zeros(0, np.int64), {})


class ReusedResults(NamedTuple):
    """Results of a block that are there before it is computed."""

    done: PartialResults = NO_RESULTS  # points that need not be computed
    begun: PartialResults = NO_RESULTS  # points that were drawn less often


def concatenate_results(parts: Sequence[PartialResults]) -> PartialResults:
    """Results of several parts of a block as one; the names are those of the first."""
    if not parts:
        return NO_RESULTS
    names = parts[0].results
    return PartialResults(
        np.concatenate([part.local_indices for part in parts]),
        {name: np.concatenate([part.results[name] for part in parts]) for name in names},
    )


@dataclass
class Deadline:
    """End of the time that a piece of a block's work may take, asked for between draws."""

    at: float = float("inf")  # by `time.monotonic`
    has_passed: bool = False  # true once it was over when asked

    def __call__(self) -> bool:
        """Tell whether the time is over."""
        self.has_passed = self.has_passed or time.monotonic() >= self.at
        return self.has_passed


class UnfinishedBlock(Exception):
    """A block was stopped: what there is of it, and to how many points that comes."""

    def __init__(self, results: ReusedResults, n_points: float) -> None:
        super().__init__()
        self.results, self.n_points = results, n_points
