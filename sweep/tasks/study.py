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
    from sweep.model.outputs import Output
    from sweep.spec import SceneSpec, Spec

Results = dict[str, np.ndarray]

#: Fill of arrays by the kind of their numbers: a count or a surface's number is never negative.
FILLS = {"f": float("nan"), "i": -1, "u": 0}


def slices(
    position: tuple[int, ...], chunks: tuple[int, ...], shape: tuple[int, ...]
) -> tuple[slice, ...]:
    """Slices of the chunk at a position among chunks, cut at the far edge."""
    return tuple(
        slice(at * chunk, min((at + 1) * chunk, size))
        for at, chunk, size in zip(position, chunks, shape, strict=True)
    )


@dataclass(frozen=True, kw_only=True)
class ArrayLayout:
    """An array of a store: its path inside, shape, chunks; its values if they are known."""

    name: str
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dims: tuple[str, ...]
    dtype: str
    fill: float | int | str | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    values: np.ndarray | None = None

    @classmethod
    def known(
        cls,
        name: str,
        dims: tuple[str, ...],
        values: np.ndarray,
        attributes: Mapping[str, Any],
        *,
        fill: float | None = None,
    ) -> ArrayLayout:
        """Return an array whose values are known as the store is made, in a single chunk."""
        text = values.dtype.kind in "UOT"
        return cls(
            name=name, shape=values.shape, chunks=values.shape, dims=dims,
            dtype="string" if text else str(values.dtype), fill=fill, attributes=attributes,
            values=values.astype(object) if text else values,
        )  # fmt: skip

    @property
    def group(self) -> str:
        """Group that it is in; empty for the root."""
        return self.name.rpartition("/")[0]

    @property
    def n_chunks(self) -> int:
        """Number of its chunks."""
        return math.prod(-(-n // chunk) for n, chunk in zip(self.shape, self.chunks, strict=True))

    def bytes_of(self, shape: tuple[int, ...]) -> int:
        """Bytes of a part of such a shape, before compression."""
        return math.prod(shape) * np.dtype(self.dtype).itemsize

    def region(self, position: tuple[int, ...]) -> tuple[slice, ...]:
        """Slices of the chunk at a position."""
        return slices(position, self.chunks, self.shape)


CONVENTIONS = "CF-1.11"
"""Metadata conventions of a store's attributes: units, names, flags."""

_CLOSING = "radial_velocity_of_scatterers_toward_instrument"
STANDARD_NAMES = {
    "altitude": "height", "true_altitude": "height",
    "beam_radial_velocity": _CLOSING, "radial_velocity": _CLOSING,
    "radial_velocity_interpolated": _CLOSING, "true_radial_velocity": _CLOSING,
    "sun_elevation": "solar_elevation_angle", "wavelength": "radiation_wavelength",
}  # fmt: skip
"""Arrays and coordinates whose quantities are in the CF standard name table (version 90)."""


def described(units: str, long_name: str, comment: str = "", name: str = "") -> dict[str, Any]:
    """Attributes that say what an array of this name holds, by the CF conventions."""
    attributes = {"units": units, "long_name": long_name}
    further = {"comment": comment, "standard_name": STANDARD_NAMES.get(name, "")}
    return attributes | {key: text for key, text in further.items() if text}


class BlockGrid:
    """Points cut into blocks along named dimensions, the last one fastest.

    A ``finer`` dimension divides every step of the last one into ``each``: shots of a cycle.
    Arrays are in a ``group`` of the store; empty for the root.
    """

    def __init__(
        self,
        dims: tuple[str, ...],
        shape: tuple[int, ...],
        block_shape: tuple[int, ...],
        *,
        group: str = "",
        finer: str = "",
        each: int = 1,
    ) -> None:
        self.dims, self.shape, self.block_shape = dims, shape, block_shape
        self.group, self.finer, self.each = group, finer, each
        self.along = tuple(-(-n // chunk) for n, chunk in zip(shape, block_shape, strict=True))
        self.n_blocks = math.prod(self.along)

    @property
    def points(self) -> int:
        """Number of points of all blocks."""
        return math.prod(self.shape) * self.each

    def position(self, block: int) -> tuple[int, ...]:
        """Position of a block among the blocks; IndexError where there is no such block."""
        if not 0 <= block < self.n_blocks:
            raise IndexError(f"block {block} of {self.n_blocks}")
        return tuple(map(int, np.unravel_index(block, self.along)))

    def number(self, position: tuple[int, ...]) -> int:
        """Return the number of the block at a position."""
        return int(np.ravel_multi_index(position, self.along)) if position else 0

    def block(self, block: int) -> tuple[slice, ...]:
        """Slices of a block along each dimension, cut at the edge of the grid."""
        return slices(self.position(block), self.block_shape, self.shape)

    def extent(self, block: int) -> tuple[int, ...]:
        """Return steps of a block along each dimension."""
        return tuple(s.stop - s.start for s in self.block(block))

    def block_size(self, block: int) -> int:
        """Return the number of points of a block."""
        return math.prod(self.extent(block)) * self.each

    def points_in(self, blocks: np.ndarray) -> int:
        """Points in the blocks that are marked in an ndarray of bool (blocks,)."""
        marked = np.asarray(blocks, bool).reshape(self.along)
        for size, chunk in zip(self.shape[::-1], self.block_shape[::-1], strict=True):
            marked = marked @ np.minimum(chunk, size - np.arange(0, size, chunk))
        return int(marked) * self.each

    def locate(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Blocks of points, which are given in C order over the grid, and places in these."""
        blocks, place = np.zeros((2, numbers.size), np.int64)
        index = np.unravel_index(numbers, self.shape) if self.shape else ()
        for i, size, chunk, along in zip(
            index, self.shape, self.block_shape, self.along, strict=True
        ):
            start = i // chunk * chunk
            blocks = blocks * along + i // chunk
            place = place * np.minimum(chunk, size - start) + i - start
        return blocks, place

    def numbers(self, block: int, places: np.ndarray) -> np.ndarray:
        """Points at some places of a block, in C order over the grid: the inverse of `locate`."""
        if not self.shape:
            return np.zeros(places.size, np.int64)
        along = np.unravel_index(places, self.extent(block))
        index = [i + s.start for i, s in zip(along, self.block(block), strict=True)]
        return np.asarray(np.ravel_multi_index(index, self.shape))

    def array(
        self,
        name: str,
        output: Output,
        dims: tuple[str, ...],
        sizes: Mapping[str, int],
        attributes: Mapping[str, Any] | None = None,
    ) -> ArrayLayout:
        """Return an array of the model's, cut along the dimensions that follow the grid."""
        whole = dict(sizes) | dict(zip(self.dims, self.shape, strict=True))
        cut = dict(sizes) | dict(zip(self.dims, self.block_shape, strict=True))
        if self.finer:
            last = self.dims[-1]
            whole[self.finer], cut[self.finer] = whole[last] * self.each, cut[last] * self.each
        about = described(output.units, output.long_name, output.comment, name)
        return ArrayLayout(
            name=f"{self.group}/{name}" if self.group else name,
            shape=tuple(whole[dim] for dim in dims),
            chunks=tuple(cut[dim] for dim in dims),
            dims=dims,
            dtype=output.dtype,
            fill=FILLS[output.dtype[0]],
            attributes=about | dict(attributes or {}),
        )

    def follows(self, layout: ArrayLayout) -> tuple[int | None, ...]:
        """Dimension of the grid that each of an array's dimensions follows; None for none."""
        place: dict[str, int] = {self.finer: len(self.dims) - 1} if self.finer else {}
        place |= {dim: k for k, dim in enumerate(self.dims)}
        return tuple(place.get(dim) for dim in layout.dims)

    def owners(self, layout: ArrayLayout) -> np.ndarray:
        """Block that writes each chunk of an array, in the shape of its grid of chunks."""
        follows = self.follows(layout)
        blocks = np.arange(self.n_blocks).reshape(self.along)
        own = blocks[tuple(slice(None) if k in follows else 0 for k in range(len(self.dims)))]
        order = [k for k in follows if k is not None]
        turned = own.transpose(np.argsort(np.argsort(order)))
        return turned.reshape([1 if k is None else self.along[k] for k in follows])


Value = float | int | str | np.ndarray

#: Parameters that move the beamlets over the target; every other one only scales or reads lines
#: that are already placed, and is cheap once they are.
GEOMETRIC = (
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

TOLERANCE = "accuracy.tolerance"

#: Shots of a flight that are planned together.
TILE_SHOTS = 256

#: Seconds that a block takes at the most, as :func:`seconds_a_point` has it: what is lost where a
#: worker dies. It also bounds the counts of draws, one a point and batch, to some 100 MB.
BLOCK_SECONDS = 60.0

#: Points of a block at the most, and blocks beyond which it grows: a block is some 25 files, and
#: what lists, copies or removes a store handles them one by one.
BLOCK_POINTS = 1 << 16
MOST_BLOCKS = 1 << 14


def seconds_a_point(spec: Spec) -> float:
    """Time of the dearest point of a study on one core, by the study alone [s].

    Measured on one machine and rounded up: the content of a block must not depend on the
    machine. Draws until a tolerance is met are reckoned with their limit.
    """
    dearest = {path: v for path, v in spec.parameters().items() if not isinstance(v, str)}
    for axis in spec.axes:
        for member in axis.members:
            if isinstance(member.values, np.ndarray):
                dearest[member.path] = member.values.max()
    draws = spec.draws
    once = 4e-5 + 2e-7 * float(dearest.get("footprint.beamlets", 0.0))
    if draws.whole_spectra:
        once += 2e-7 * float(dearest["instrument.processing.fft_size"])
    return once * max(draws.number, draws.limit, 1)


def block_shape(
    sizes: tuple[int, ...], geometric: tuple[bool, ...], block_points: int
) -> tuple[int, ...]:
    """Points of a block along each axis, given whether each axis changes the geometry.

    Radiometric axes are kept whole before geometric ones, and the last axis before the first,
    as far as the block has room: it then holds every radiometric variation of its geometry.
    """
    order = sorted(range(len(sizes)), key=lambda k: (geometric[k], -k))
    shape, room = [1] * len(sizes), block_points
    for k in order:
        shape[k] = min(sizes[k], room)
        room //= shape[k]
    return tuple(shape)


def points_a_block(points: int) -> int:
    """Points that a block holds at most in a study of so many, where it does not say."""
    return max(BLOCK_POINTS, -(-points // MOST_BLOCKS))


def most_points(spec: Spec, points: int) -> int:
    """Points that a block may hold: as the spec says, or fits it; less where each takes long."""
    asked = spec.storage.block_points or points_a_block(points)
    return max(1, min(asked, int(BLOCK_SECONDS / seconds_a_point(spec))))


#: Blocks of a study at most: a run remembers some 30 bytes of each, and makes files of it.
BLOCKS_MAX = 2 * 10**7


class Lattice:
    """Parameters along the axes of a study: those that are fixed, and those of each axis."""

    def __init__(self, spec: Spec | SceneSpec) -> None:
        self.fixed: dict[str, float | int | str] = dict(spec.parameters())
        self.shape = tuple(int(axis.size) for axis in spec.axes)
        self.values = [{m.path: np.asarray(m.values) for m in axis.members} for axis in spec.axes]
        """Values along each axis by the parameters that they set."""

    def values_along(self) -> list[dict[str, np.ndarray]]:
        """Values along each dimension, by what they are of."""
        return self.values


class Grid(Lattice, BlockGrid):
    """Points of a study over a grid, their parameters, and the blocks they are computed in."""

    def __init__(self, spec: Spec) -> None:
        Lattice.__init__(self, spec)
        self.spec = spec
        self.geometric = tuple(
            any(path in GEOMETRIC or path.startswith(GEOMETRIC_PREFIXES) for path in values)
            for values in self.values
        )
        most = most_points(spec, math.prod(self.shape))
        dims = tuple(axis.name for axis in spec.axes)
        BlockGrid.__init__(self, dims, self.shape, block_shape(self.shape, self.geometric, most))
        if self.n_blocks > BLOCKS_MAX:
            rule = (
                f"makes {self.points:.3g} points in {self.n_blocks:.3g} blocks, and a study has "
                f"at most {BLOCKS_MAX:.0e}"
            )
            remedy = "take fewer values or fewer draws, or raise storage.block_points"
            raise SpecError([Mistake("axes", rule, "", remedy)])

    def parameters(self, block: int) -> dict[str, Value]:
        """Parameters of a block's points by path: scalars, or arrays (n,) in C order over it."""
        return self.parameters_at(self.numbers(block, np.arange(self.block_size(block))))

    def parameters_at(self, points: np.ndarray) -> dict[str, Value]:
        """Parameters of points given by their numbers in C order over the whole grid, (n,)."""
        selected: dict[str, Value] = dict(self.fixed)
        indices = np.unravel_index(points, self.shape) if self.shape else ()
        for values, along in zip(self.values, indices, strict=True):
            selected |= {path: array[along] for path, array in values.items()}
        return selected

    def geometry_order(self, block: int) -> np.ndarray:
        """Order of a block's points, (n,) in C order over it, that brings equal geometry together.

        Radiometric axes run fastest, and velocities slowest: a line's change within a
        record follows them.
        """
        numbers = np.arange(self.block_size(block)).reshape(self.extent(block))
        moving = ["target.radial_velocity" in values for values in self.values]
        axes = sorted(
            range(len(self.shape)), key=lambda k: (not self.geometric[k], not moving[k], k)
        )
        return numbers.transpose(axes).ravel()


class Content(Protocol):
    """Anything that a store is made of."""

    @property
    def id(self) -> str:
        """Hash of all that its results depend on."""

    def attributes(self) -> dict[str, Any]:
        """Attributes of its store, but for versions; the same wherever it is made."""

    def groups(self) -> dict[str, dict[str, Any]]:
        """Return groups of its store and their attributes; none but the root."""
        return {}

    def arrays(self) -> list[ArrayLayout]:
        """Every array of its store."""


class Study(Content, ABC):
    """A study as the driver and its workers see it; blocks are numbered grid by grid."""

    unit = "points"
    """Name of its points, in the plural."""

    @property
    @abstractmethod
    def grids(self) -> Sequence[BlockGrid]:
        """Blocks of each group of its store."""

    @abstractmethod
    def known_arrays(self) -> list[ArrayLayout]:
        """Arrays whose values are known as the store is made."""

    @abstractmethod
    def outputs(self) -> list[ArrayLayout]:
        """Arrays that blocks write."""

    @abstractmethod
    def evaluate(self, block: int) -> Results:
        """Results of a block by the names of its arrays, each with its chunk's shape."""

    @abstractmethod
    def compile(self) -> None:
        """Compile what evaluation compiles, so that workers find it on disk."""

    def arrays(self) -> list[ArrayLayout]:
        """Every array of its store."""
        return [*self.known_arrays(), *self.layouts.values()]

    @cached_property
    def layouts(self) -> dict[str, ArrayLayout]:
        """Arrays that blocks write, by name."""
        return {layout.name: layout for layout in self.outputs()}

    @property
    def n_chunks(self) -> int:
        """Number of chunks of all blocks."""
        return sum(layout.n_chunks for layout in self.layouts.values())

    @property
    def bytes(self) -> int:
        """Bytes of all results, before compression."""
        return sum(layout.bytes_of(layout.shape) for layout in self.layouts.values())

    @property
    def block_bytes(self) -> int:
        """Bytes of the results of the largest block, before compression."""
        of_groups = dict.fromkeys(self._groups, 0)
        for layout in self.layouts.values():
            of_groups[layout.group] += layout.bytes_of(layout.chunks)
        return max(of_groups.values())

    @property
    def points(self) -> int:
        """Number of points of all blocks."""
        return sum(grid.points for grid in self.grids)

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return sum(grid.n_blocks for grid in self.grids)

    def find(self, block: int) -> tuple[BlockGrid, int]:
        """Return the grid that a block is of, and its number there; IndexError if there is none."""
        number = block
        for grid in self.grids:
            if 0 <= number < grid.n_blocks:
                return grid, number
            number -= grid.n_blocks
        raise IndexError(f"block {block} of {self.n_blocks}")

    @cached_property
    def _groups(self) -> dict[str, tuple[int, BlockGrid]]:
        """Number of the first block of each group, and its grid."""
        ends = np.cumsum([grid.n_blocks for grid in self.grids]).tolist()
        return {g.group: (end - g.n_blocks, g) for g, end in zip(self.grids, ends, strict=True)}

    def first_block(self, group: str) -> int:
        """Return the number of the first block of a group."""
        return self._groups[group][0]

    def block_size(self, block: int) -> int:
        """Points of a block."""
        grid, number = self.find(block)
        return grid.block_size(number)

    def points_in(self, blocks: np.ndarray) -> int:
        """Points in the blocks that are marked in an ndarray of bool (blocks,)."""
        marked = np.split(blocks, np.cumsum([grid.n_blocks for grid in self.grids])[:-1])
        return sum(grid.points_in(part) for grid, part in zip(self.grids, marked, strict=True))

    @cached_property
    def _follows(self) -> dict[str, dict[str, tuple[int | None, ...]]]:
        """Dimensions of the grid that each array follows, by group and name."""
        found: dict[str, dict[str, tuple[int | None, ...]]] = {group: {} for group in self._groups}
        for name, layout in self.layouts.items():
            found[layout.group][name] = self._groups[layout.group][1].follows(layout)
        return found

    def chunks(self, block: int) -> dict[str, tuple[int, ...]]:
        """Chunks that a block writes, whole: the position of one in each of some arrays."""
        grid, number = self.find(block)
        position = grid.position(number)
        apart = {k for k, at in enumerate(position) if at}  # of these an array must have them all
        return {
            name: tuple(0 if k is None else position[k] for k in follows)
            for name, follows in self._follows[grid.group].items()
            if apart.issubset(follows)
        }

    def regions(self, block: int) -> dict[str, tuple[slice, ...]]:
        """Slices of the arrays that a block writes."""
        return {name: self.layouts[name].region(at) for name, at in self.chunks(block).items()}

    def owners(self) -> dict[str, np.ndarray]:
        """Block that writes each chunk, in the shape of the grid of chunks, of every output."""
        found = {}
        for name, layout in self.layouts.items():
            first, grid = self._groups[layout.group]
            found[name] = first + grid.owners(layout)
        return found


#: Errors of Zarr at a chunk that is not there, or not as it was written.
DAMAGED = (OSError, ValueError, RuntimeError)


class GrowingStudy(Study):
    """A study that may be extended, and may extend another."""

    def __init__(self, spec: Any) -> None:
        self.spec = spec
        self.look_up: Callable[[], Any] = lambda: None

    @cached_property
    def earlier(self) -> Any:
        """Results of a smaller study, or None; looked for as the first block is computed."""
        return self.look_up()

    @property
    def id(self) -> str:
        """Hash of the spec's identity."""
        return str(self.spec.id)

    @abstractmethod
    def follows_tolerance(self, block: int) -> np.ndarray | bool:
        """Mark the points of a block that a tighter tolerance computes more closely, (points,)."""

    def home(self, block: int) -> int:
        """Block with all that the draws of a block have in common."""
        return block

    def there(self, block: int) -> int:
        """Points of a block that the smaller study has, if nothing is damaged."""
        shares = self.earlier.shares(block) if self.earlier else ()
        return sum(share.points.size for share in shares) * self.find(block)[0].each


METHODS = {
    "detector": "instrument.processing.detector.kind",
    "estimator": "instrument.processing.estimator.kind",
}
"""Parameters that name what looks at whole spectra: one of ours, or a function of the user's."""


def own_functions(spec: Any) -> Iterator[tuple[str, str]]:
    """Roles and names of the functions of the user's that a study names."""
    draws = getattr(spec, "draws", None)
    if not getattr(draws, "whole_spectra", False):
        return
    for role, path in METHODS.items():
        on_axes = [m.values for axis in spec.axes for m in axis.members if m.path == path]
        names = on_axes[0] if on_axes else [spec.parameters()[path]]
        yield from ((role, name) for name in dict.fromkeys(map(str, names)) if ":" in name)


Evaluate = Callable[[Any, int], Results]
"""Computes a block of a study in its place, with the same results by name."""


class Found(NamedTuple):
    """Results of some points of a block."""

    points: np.ndarray  # (m,) int64: their numbers in C order over the block
    results: Results  # (m, ...) each, by name


NONE_FOUND = Found(np.zeros(0, np.int64), {})


class Known(NamedTuple):
    """Results of a block that are there before it is computed."""

    done: Found = NONE_FOUND  # points that need not be computed
    begun: Found = NONE_FOUND  # points that were drawn less often


def together(found: Sequence[Found]) -> Found:
    """Results of several parts of a block as one; the names are those of the first."""
    if not found:
        return NONE_FOUND
    names = found[0].results
    return Found(
        np.concatenate([each.points for each in found]),
        {name: np.concatenate([each.results[name] for each in found]) for name in names},
    )


@dataclass
class Stop:
    """End of the time that a piece of a block's work may take, asked for between draws."""

    at: float = float("inf")  # by `time.monotonic`
    told: bool = False  # true once it was over when asked

    def __call__(self) -> bool:
        """Tell whether the time is over."""
        self.told = self.told or time.monotonic() >= self.at
        return self.told


class Unfinished(Exception):
    """A block was stopped: what there is of it, and to how many points that comes."""

    def __init__(self, known: Known, points: float) -> None:
        super().__init__()
        self.known, self.points = known, points
