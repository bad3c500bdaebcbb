"""Parameters of a study's points along its axes, and blocks of points that share a geometry."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from sweep.spec.rules import Mistake, SpecError
from sweep.tasks.engine.blocks import BLOCKS_MAX, BlockGrid

if TYPE_CHECKING:
    from sweep.spec import GridSpec, SceneSpec

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
