"""Parameters of a study's points along its axes, and blocks of points that share a geometry."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sweep.spec.rules import Mistake, SpecError
from sweep.spec.specs import GridSpec, SceneSpec
from sweep.tasks.engine.blocks import BLOCKS_PER_STUDY_MAX, BlockGrid

ParameterValue = float | int | str | np.ndarray
"""Value of a parameter: one value for all points, or an array with the value of each point."""

GEOMETRIC_PARAMETERS = (
    "target.range",
    "target.grazing_angle",
    "target.radial_velocity",
    "target.transverse_velocity",
    "target.pointing_jitter",
)
"""Dotted paths of parameters that change the frequencies of spectral lines.

Parameters that begin with `GEOMETRIC_PARAMETER_PREFIXES` change the frequencies, too. All others
only scale lines or change how lines are evaluated, which is cheap once frequencies are known.
"""
GEOMETRIC_PARAMETER_PREFIXES = (
    "instrument.laser.beam_", "instrument.laser.focus", "instrument.telescope.coupling",
    "instrument.receiver.local_oscillator_waist", "footprint.",
)  # fmt: skip
"""Beginnings of dotted paths of parameters that change the frequencies of spectral lines.

They complement `GEOMETRIC_PARAMETERS`, which lists complete paths.
"""

TOLERANCE_PARAMETER = "accuracy.tolerance"
"""Dotted path of the parameter that sets the tolerance of numerical errors."""

SHOTS_PER_TILE = 256
"""Number of consecutive shots of a flight whose effects are planned together."""

BLOCK_CPU_SECONDS_MAX = 60.0
"""Largest time of a block on one core, estimated by `worst_cpu_seconds_per_point` [s].

A block's time is lost if its worker dies. The limit also keeps the counts of draws in a block, one
per point and batch, below some 100 MB.
"""

DEFAULT_BLOCK_POINTS = 1 << 16
"""Largest number of points of a block if the spec states none.

It does not hold for a study that would have more than `BLOCKS_OF_DEFAULT_SIZE_MAX` such blocks.
"""
BLOCKS_OF_DEFAULT_SIZE_MAX = 1 << 14
"""Largest number of blocks of `DEFAULT_BLOCK_POINTS` points; a larger study has larger blocks.

A block has some 25 files, which are listed, copied and removed one by one.
"""

POINT_DRAW_CPU_SECONDS = 4e-5
"""Time of one draw of a grid point, or of a grid point without draws, on one core [s]."""
SPECKLE_CPU_SECONDS = 1.6e-4
"""Time that developed speckle adds to that of a grid point, on one core [s]."""

SHOT_CPU_SECONDS = 7e-5
"""Time of a flight's shot, without that of its draws, on one core [s]."""
SHOT_DRAW_CPU_SECONDS = 2e-5
"""Time of one draw of a flight's shot, on one core [s]."""

DEFAULT_BLOCKS_MIN = 32
"""Smallest number of blocks of a study if the spec states no size of blocks.

This number gives work to all cores of a machine at once. A study has fewer blocks if they would
otherwise take less than `DEFAULT_BLOCK_CPU_SECONDS_MIN`.
"""
DEFAULT_BLOCK_CPU_SECONDS_MIN = 0.5
"""Smallest estimated time, on one core, of a block whose size the spec does not state [s]."""

DEFAULT_BLOCK_DRAWS_MAX = 128
"""Largest number of draws of a shot in a flight's block, if the spec states none."""


def worst_cpu_seconds_per_draw(spec: GridSpec | SceneSpec) -> float:
    """Return an upper estimate of the time of one draw of a point or shot on one core [s].

    The estimate uses constants that were measured on one machine and rounded up, because the
    content of a block must not depend on the machine.
    """
    worst_parameters = {
        path: value for path, value in spec.parameters().items() if not isinstance(value, str)
    }
    for axis in spec.axes:
        for member in axis.parameters:
            if isinstance(member.values, np.ndarray) and member.values.dtype.kind in "iuf":
                worst_parameters[member.path] = member.values.max()
    seconds_per_draw = POINT_DRAW_CPU_SECONDS
    if isinstance(spec, SceneSpec):
        seconds_per_draw = SHOT_DRAW_CPU_SECONDS + SHOT_CPU_SECONDS / max(spec.draws.number, 1)
    seconds_per_draw += 2e-7 * float(worst_parameters.get("footprint.beamlets", 0.0))
    if spec.draws.draws_whole_spectra:
        seconds_per_draw += 2e-7 * float(worst_parameters["instrument.processing.fft_size"])
    return seconds_per_draw


def worst_cpu_seconds_per_point(spec: GridSpec) -> float:
    """Return an upper estimate of the time of any point of a grid study on one core [s].

    If draws continue until a tolerance is met, the largest permitted number of draws is assumed.
    """
    n_draws = max(spec.draws.number, spec.draws.limit, 1)
    speckle_modes = {spec.parameters()["footprint.speckle"]}
    for axis in spec.axes:
        for member in axis.parameters:
            if member.path == "footprint.speckle":
                speckle_modes = set(member.values)
    speckle_seconds = SPECKLE_CPU_SECONDS if "developed" in speckle_modes else 0.0
    return worst_cpu_seconds_per_draw(spec) * n_draws + speckle_seconds


def default_block_cpu_seconds(study_cpu_seconds: float) -> float:
    """Return the time on one core of a block, if the spec states no size of blocks [s].

    `study_cpu_seconds` is the time of all blocks together on one core [s].
    """
    return max(study_cpu_seconds / DEFAULT_BLOCKS_MIN, DEFAULT_BLOCK_CPU_SECONDS_MIN)


class FlightBlockSize(NamedTuple):
    """Numbers of shots and of draws of a flight's block."""

    n_shots: int
    """Number of shots of one scanner."""
    n_draws: int
    """Number of draws of each shot."""


def flight_block_size_max(
    spec: SceneSpec, n_axis_points: int, n_shots: int, n_draws: int
) -> FlightBlockSize:
    """Return upper limits on the shots and on the draws of any block of a flight.

    If the spec's section `storage` differs from its defaults, it states both limits. Otherwise:

    * A study is divided into DEFAULT_BLOCKS_MIN blocks or more, or into fewer blocks if they would
      take less than DEFAULT_BLOCK_CPU_SECONDS_MIN.
    * A block contains complete tiles, because the effects of a tile's shots are chosen together.
    * The draws of a shot are divided among blocks only if a tile with all draws takes longer than
      the study's time over DEFAULT_BLOCKS_MIN, and longer than twice DEFAULT_BLOCK_CPU_SECONDS_MIN.
      The reason is that each of the blocks computes the spectra of the shot again.
    * A block has at most DEFAULT_BLOCK_DRAWS_MAX draws of a shot.

    Parameters
    ----------
    spec
        Flight.
    n_axis_points
        Number of points of the grid that the flight's axes span.
    n_shots
        Number of shots of one scanner.
    n_draws
        Number of draws of each shot.
    """
    block_shots, block_draws = int(spec.storage.block_shots), int(spec.storage.block_draws)
    if spec.storage != type(spec.storage)():
        return FlightBlockSize(block_shots, block_draws)
    block_draws = DEFAULT_BLOCK_DRAWS_MAX
    seconds_per_draw = worst_cpu_seconds_per_draw(spec)
    study_cpu_seconds = n_axis_points * n_shots * n_draws * seconds_per_draw
    seconds_per_draw_of_tile = min(n_shots, SHOTS_PER_TILE) * seconds_per_draw
    whole_tile_seconds_max = max(
        study_cpu_seconds / DEFAULT_BLOCKS_MIN, 2 * DEFAULT_BLOCK_CPU_SECONDS_MIN
    )
    draws_per_block_max = max(whole_tile_seconds_max / seconds_per_draw_of_tile, 1)
    n_draw_blocks = math.ceil(n_draws / min(block_draws, draws_per_block_max))
    block_draws = math.ceil(n_draws / n_draw_blocks)  # a last block is not much smaller
    tile_seconds = seconds_per_draw_of_tile * block_draws
    tiles_per_block = max(
        int(study_cpu_seconds / DEFAULT_BLOCKS_MIN / tile_seconds),
        math.ceil(DEFAULT_BLOCK_CPU_SECONDS_MIN / tile_seconds),
    )
    block_shots = min(tiles_per_block * SHOTS_PER_TILE, block_shots)
    return FlightBlockSize(block_shots, block_draws)


def fit_block_shape(
    sizes: tuple[int, ...], is_geometric: tuple[bool, ...], block_points: int
) -> tuple[int, ...]:
    """Return the number of points of a block along each axis of a grid.

    `sizes` are the numbers of points of the grid along its axes, `block_points` is the largest
    number of points of a block. `is_geometric` is True for an axis that changes the geometry of
    beam and target. Blocks first extend along axes that are not geometric, from the last axis to
    the first, and after that along geometric axes in the same order. A block thus contains all
    points of a geometry.
    """
    order = sorted(range(len(sizes)), key=lambda k: (is_geometric[k], -k))
    shape, points_left = [1] * len(sizes), block_points
    for axis in order:
        shape[axis] = min(sizes[axis], points_left)
        points_left //= shape[axis]
    return tuple(shape)


def default_block_points(n_points: int, cpu_seconds_per_point: float) -> int:
    """Return the number of points per block if the spec states none.

    `n_points` is the number of points of the study.
    """
    block_cpu_seconds = default_block_cpu_seconds(n_points * cpu_seconds_per_point)
    block_points = min(DEFAULT_BLOCK_POINTS, math.ceil(block_cpu_seconds / cpu_seconds_per_point))
    return max(block_points, -(-n_points // BLOCKS_OF_DEFAULT_SIZE_MAX))


def block_points_limit(spec: GridSpec, n_points: int) -> int:
    """Return the largest permitted number of points of a block.

    It is the number that the spec states, or a smaller one if points take long.
    """
    cpu_seconds_per_point = worst_cpu_seconds_per_point(spec)
    requested_points = spec.storage.block_points or default_block_points(
        n_points, cpu_seconds_per_point
    )
    return max(1, min(requested_points, int(BLOCK_CPU_SECONDS_MAX / cpu_seconds_per_point)))


class ParameterGrid:
    """Parameters of a study's points: fixed values, and values along the axes of the grid."""

    def __init__(self, spec: GridSpec | SceneSpec) -> None:
        self.fixed_parameters: dict[str, float | int | str] = dict(spec.parameters())
        self.shape = tuple(int(axis.size) for axis in spec.axes)
        self.values_by_axis = [
            {member.path: np.asarray(member.values) for member in axis.parameters}
            for axis in spec.axes
        ]
        """Values along each axis, one dict per axis, by the dotted paths of the parameters."""

    def values_by_dim(self) -> list[dict[str, np.ndarray]]:
        """Return the values along each dimension of the grid.

        The list has a dict for each dimension, with arrays of values by dotted path.
        """
        return self.values_by_axis


class ParameterBlockGrid(ParameterGrid, BlockGrid):
    """Points of a grid study, cut into blocks, with the parameters of each point."""

    def __init__(self, spec: GridSpec) -> None:
        ParameterGrid.__init__(self, spec)
        self.spec = spec
        self.is_geometric_axis = tuple(
            any(
                path in GEOMETRIC_PARAMETERS or path.startswith(GEOMETRIC_PARAMETER_PREFIXES)
                for path in values
            )
            for values in self.values_by_axis
        )
        points_max = block_points_limit(spec, math.prod(self.shape))
        dims = tuple(axis.name for axis in spec.axes)
        BlockGrid.__init__(
            self, dims, self.shape, fit_block_shape(self.shape, self.is_geometric_axis, points_max)
        )
        if self.n_blocks > BLOCKS_PER_STUDY_MAX:
            rule = (
                f"makes {self.n_points:.3g} points in {self.n_blocks:.3g} blocks, and a study has "
                f"at most {BLOCKS_PER_STUDY_MAX:.0e}"
            )
            remedy = "take fewer values or fewer draws, or raise storage.block_points"
            raise SpecError([Mistake("axes", rule, "", remedy)])

    def parameters_of_block(self, block: int) -> dict[str, ParameterValue]:
        """Return the parameters of a block's points by dotted path: scalars, or arrays (n,).

        Points are in C order.
        """
        return self.parameters_at(
            self.point_indices_in_grid(block, np.arange(self.count_block_points(block)))
        )

    def parameters_at(self, grid_indices: np.ndarray) -> dict[str, ParameterValue]:
        """Return the parameters of some points by dotted path: scalars, or arrays (n,).

        `grid_indices` (n,) are the indices of the points in C order over the grid.
        """
        parameters: dict[str, ParameterValue] = dict(self.fixed_parameters)
        indices = np.unravel_index(grid_indices, self.shape) if self.shape else ()
        for values, axis_indices in zip(self.values_by_axis, indices, strict=True):
            parameters |= {path: array[axis_indices] for path, array in values.items()}
        return parameters

    def point_order_by_geometry(self, block: int) -> np.ndarray:
        """Return the indices (n,) of a block's points, with points of equal geometry adjacent.

        Axes that do not change the geometry vary fastest, and velocities slowest, because the
        change of a spectral line within a record depends on velocity.
        """
        indices_in_block = np.arange(self.count_block_points(block)).reshape(
            self.actual_block_shape(block)
        )
        is_velocity_axis = ["target.radial_velocity" in values for values in self.values_by_axis]
        axes = sorted(
            range(len(self.shape)),
            key=lambda axis: (not self.is_geometric_axis[axis], not is_velocity_axis[axis], axis),
        )
        return indices_in_block.transpose(axes).ravel()
