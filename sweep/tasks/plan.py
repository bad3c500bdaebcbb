"""What a study will take, before anything runs: points, blocks, bytes, time, memory."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import psutil

from sweep.tasks import cluster
from sweep.tasks.calling import Calling
from sweep.tasks.evaluate import compile_kernels, select
from sweep.tasks.grid import Grid
from sweep.tasks.grid_study import further_dims, output_names
from sweep.tasks.timing import timed

if TYPE_CHECKING:
    from sweep.spec import Spec

#: Time that measuring may take [s], and places of the grid that it looks at.
MEASURING = 1.0
PLACES = 16

#: Draws of a point while measuring.
MOST_DRAWS = 1000

#: The same, of whole spectra.
MOST_SPECTRA = 10

#: What a worker takes to start [s], and to write a chunk [s].
START = 3.0
WRITE_CHUNK = 2e-3


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a study will take."""

    points: int
    blocks: int
    block_shape: dict[str, int]  # points along each axis
    chunks: int
    bytes: int  # before compression, of all results
    workers: int
    seconds_a_point: float  # on one worker, measured
    seconds: float  # of the whole study, estimated
    worker_memory: int  # bytes, estimated


def plan(spec: Spec, *, workers: int | None = None) -> Plan:
    """What a study will take, from its size and a second of measuring its own points.

    Parameters
    ----------
    spec
        The study.
    workers
        Workers it would run on; default those of the spec, else all cores.
    """
    grid, names = Grid(spec), output_names(spec)
    workers = workers or spec.execution.workers or cluster.cores()
    each = measured(spec, grid)
    writing = grid.n_blocks * len(names) * WRITE_CHUNK
    busy = min(workers, grid.n_blocks)
    return Plan(
        points=grid.points,
        blocks=grid.n_blocks,
        block_shape=dict(zip(grid.dims, grid.block_shape, strict=True)),
        chunks=grid.n_blocks * len(names),
        bytes=grid.points * point_bytes(spec, names),
        workers=workers,
        seconds_a_point=each,
        seconds=START + (grid.points * each + writing) / busy,
        worker_memory=worker_memory(spec, grid, names),
    )


def point_bytes(spec: Spec, names: list[str]) -> int:
    """Bytes of one point's results: 8 an output, or as often as that has a further dimension."""
    further = further_dims(spec)
    return 8 * sum(further[name][1] if name in further else 1 for name in names)


def worker_memory(spec: Spec, grid: Grid, names: list[str]) -> int:
    """Bytes a worker takes: as this process does with the model loaded, and two copies of a block's
    results, its own and the one being encoded.
    """
    block = grid.block_size(0) * point_bytes(spec, names)
    return psutil.Process().memory_info().rss + 2 * block


def measured(spec: Spec, grid: Grid) -> float:
    """Time a point takes on one core [s], measured on points spread over the grid.

    Whole sets of points that share a geometry are taken, so that sharing shows as it will. Where
    points are drawn until their accuracy is met, those that are not after few draws are taken to
    reach their limit.
    """
    compile_kernels(spec, grid)
    calling = Calling(spec, grid)
    rows, begun = 1, time.perf_counter()
    while True:  # once at the least, however long this process has been held up
        points, left_out = 0, 0.0
        round_begun = time.perf_counter()
        for block in np.unique(np.linspace(0, grid.n_blocks - 1, PLACES).astype(np.int64)):
            more, seconds = _evaluate_some(spec, calling, int(block), rows)
            points, left_out = points + more, left_out + seconds
        now = time.perf_counter()
        taken = now - round_begun
        if points >= grid.points or taken > MEASURING / 4 or now - begun > MEASURING / 2:
            return (taken + left_out) / points
        rows *= 4


def _evaluate_some(spec: Spec, calling: Calling, block: int, rows: int) -> tuple[int, float]:
    """Number of points evaluated, and the time [s] that draws left out of them would take."""
    left_out = 0.0
    grid, sharing = calling.tiles.grid, 1
    for size, geometric in zip(grid.extent(block), grid.geometric, strict=True):
        sharing *= 1 if geometric else size
    sets = grid.geometry_order(block).reshape(-1, sharing)
    few = np.unique(np.linspace(0, len(sets) - 1, rows).astype(np.int64))
    chosen = sets[few].ravel()
    parameters = grid.parameters(block)
    for members, effects in calling.of_block(block).some(chosen).groups():
        part = select(parameters, chosen[members])
        most = MOST_SPECTRA if spec.draws.whole_spectra else MOST_DRAWS
        left_out += timed(spec, part, len(members), effects, most_draws=most).left_out
    return len(chosen), left_out
