"""Points of a study along its axes, and their parameters, block by block.

A block is worked out from its number when it is asked for, so that a grid of any size costs the
length of its axes and no more.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from sweep.tasks.study import BlockGrid

if TYPE_CHECKING:
    from sweep.spec import Axis, SceneSpec, Spec

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

#: Seconds that a block takes at the most, as :func:`seconds_a_point` has it: what is lost where a
#: worker dies. It also bounds the counts of draws, one a point and batch, to some 100 MB.
BLOCK_SECONDS = 60.0

#: Points of a block at the most, and blocks beyond which it grows: a block is some 25 files, and
#: what lists, copies or removes a store handles them one by one.
BLOCK_POINTS = 1 << 16
MOST_BLOCKS = 1 << 14


def is_geometric(axis: Axis) -> bool:
    """Tell whether any member of an axis changes where the beamlets fall."""
    return any(
        member.path in GEOMETRIC or member.path.startswith(GEOMETRIC_PREFIXES)
        for member in axis.members
    )


def points_a_block(points: int) -> int:
    """Points that a block holds at most in a study of so many, where it does not say."""
    return max(BLOCK_POINTS, -(-points // MOST_BLOCKS))


def seconds_a_point(spec: Spec) -> float:
    """Time of the dearest point of a study on one core, by the study alone [s].

    Measured on one machine and rounded up, which is all that a block's size asks for: results'
    places must not depend on who computes them. A draw of a whole spectrum takes time by its bins,
    all else by the beamlets; draws until a tolerance is met are reckoned with their limit.
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
    """Points of a block along each axis.

    Radiometric axes are kept whole before geometric ones, and the last axis before the first, as
    far as the block has room: a block then holds every radiometric variation of the geometry that
    it places. ``geometric``: whether each axis changes the geometry.
    """
    order = sorted(range(len(sizes)), key=lambda k: (geometric[k], -k))
    shape, room = [1] * len(sizes), block_points
    for k in order:
        shape[k] = min(sizes[k], room)
        room //= shape[k]
    return tuple(shape)


def most_points(spec: Spec, points: int) -> int:
    """Points that a block of a study of so many may hold: what the spec says, or fits the study.

    Less where each takes long.
    """
    asked = spec.storage.block_points or points_a_block(points)
    return max(1, min(asked, int(BLOCK_SECONDS / seconds_a_point(spec))))


class Lattice:
    """Parameters along the axes of a study: those that are fixed, and those of each axis."""

    def __init__(self, spec: Spec | SceneSpec) -> None:
        self.fixed: dict[str, float | int | str] = dict(spec.parameters())
        self._axes = tuple(spec.axes)
        self.shape = tuple(int(axis.size) for axis in self._axes)
        self.values = [{m.path: np.asarray(m.values) for m in axis.members} for axis in self._axes]
        """Values along each dimension by the parameters that they set."""


class LatticeGrid(Lattice, BlockGrid):
    """Points along axes, and perhaps further dimensions, cut into blocks."""


class Grid(LatticeGrid):
    """Points of a study over a grid, their parameters, and the blocks they are computed in."""

    def __init__(self, spec: Spec) -> None:
        Lattice.__init__(self, spec)
        self.spec = spec
        self.geometric = tuple(is_geometric(axis) for axis in self._axes)
        most = most_points(spec, math.prod(self.shape))
        dims = tuple(axis.name for axis in self._axes)
        BlockGrid.__init__(self, dims, self.shape, block_shape(self.shape, self.geometric, most))

    def parameters(self, block: int) -> dict[str, Value]:
        """Parameters of the points of a block, by dotted path.

        SI scalars and strings where all points agree, arrays (n,) along which the points of the
        block run in C order where an axis varies them.
        """
        slices = self.block(block)
        index = [along.ravel() for along in np.indices(self.extent(block))]
        return self._select([s.start + along for s, along in zip(slices, index, strict=True)])

    def parameters_at(self, points: np.ndarray) -> dict[str, Value]:
        """Parameters of points given by their numbers in C order over the whole grid, (n,)."""
        return self._select(list(np.unravel_index(points, self.shape)) if self.shape else [])

    def _select(self, indices: list[np.ndarray]) -> dict[str, Value]:
        selected: dict[str, Value] = dict(self.fixed)
        for values, along in zip(self.values, indices, strict=True):
            for path, array in values.items():
                selected[path] = array[along]
        return selected

    def geometry_order(self, block: int) -> np.ndarray:
        """Order of a block's points, (n,) in C order over it, that brings equal geometry together.

        Radiometric axes run fastest, and velocities slowest: what a line becomes within a record
        follows from them.
        """
        numbers = np.arange(self.block_size(block)).reshape(self.extent(block))
        moving = ["target.radial_velocity" in {m.path for m in axis.members} for axis in self._axes]
        axes = sorted(
            range(len(self.shape)), key=lambda k: (not self.geometric[k], not moving[k], k)
        )
        return numbers.transpose(axes).ravel()


def canonical_rows(parameters: Mapping[str, Value], count: int) -> np.ndarray:
    """Rows of float64, (count, parameters), that say what a point is by its values alone.

    A row holds every parameter, in the order of the sorted paths: which of them are axes, in what
    order and with which neighbours does not show. Strings stand as 62 bits of their hash.
    """
    rows = np.empty((count, len(parameters)), dtype=np.uint64)
    for column, path in enumerate(sorted(parameters)):
        rows[:, column] = _bits(parameters[path])
    return rows.view(np.float64)


def _bits(value: Value) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind == "U":
        names, inverse = np.unique(array, return_inverse=True)
        hashes = np.array([_hashed(str(name)) for name in names], dtype=np.uint64)
        return hashes[inverse].reshape(array.shape)
    return (array.astype(np.float64) + 0.0).view(np.uint64)  # -0.0 and 0.0 are the same value


@lru_cache(maxsize=256)
def _hashed(text: str) -> int:
    # 62 bits: with the upper two clear it is no nan, which no row may hold
    digest = hashlib.blake2b(text.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 2
