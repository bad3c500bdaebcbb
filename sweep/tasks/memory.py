"""Check that a study's memory fits its workers, before anything is computed."""

from __future__ import annotations

from concurrent.futures import CancelledError
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sweep.messages import option
from sweep.spec import SceneSpec
from sweep.spec.clusters import AnyCluster, Bounds, Local
from sweep.spec.rules import Mistake, SpecError

if TYPE_CHECKING:
    from distributed import Client

    from sweep.spec import Spec
    from sweep.tasks.flight_study import FlightStudy
    from sweep.tasks.grid_study import GridStudy
    from sweep.tasks.study import Study

FFT_SIZE = "instrument.processing.fft_size"

BYTES_PER_BIN = 250
BYTES_PER_DRAWN_BIN = 300
"""Peak memory of a point per point of its FFT [bytes], measured at 2^20 and 2^22: for closed-form
results, and for draws of whole spectra."""


def largest_fft(spec: Spec | SceneSpec) -> int:
    """Return the largest number of points of the FFT in a study."""
    sizes = [m.values for axis in spec.axes for m in axis.members if m.path == FFT_SIZE]
    return int(np.max(sizes[0])) if sizes else int(spec.parameters()[FFT_SIZE])


def point_bytes(spec: Spec | SceneSpec) -> int:
    """Return the peak memory of one point, or shot [bytes]."""
    drawn = getattr(spec.draws, "whole_spectra", False)
    return largest_fft(spec) * (BYTES_PER_DRAWN_BIN if drawn else BYTES_PER_BIN)


def scene_bytes(spec: SceneSpec) -> int:
    """Return the size of a scene's triangles and search trees, copied into each process [bytes]."""
    from sweep.tasks.eyepoint_study import world_of

    return world_of(spec).caster.nbytes


class WorkerMemory(NamedTuple):
    """Memory available to a process that computes points."""

    limit: float
    """Largest memory that the process may use [bytes]; inf if unknown."""
    owner: str
    """Name of the process in messages, as the subject of a sentence: `this machine`."""
    workers: int = 1
    """Number of workers that share this machine's memory; 1 if each has a limit of its own."""


def this_machine() -> WorkerMemory:
    """Return the memory available to serial computation in this process."""
    # Here, as a spec with mistakes is told without the second that this import takes.
    from distributed.system import MEMORY_LIMIT

    return WorkerMemory(MEMORY_LIMIT, "this machine")


def worker_memory(client: Client | None, cluster: AnyCluster | None) -> WorkerMemory:
    """Return the memory of the smallest worker of a client, or of a cluster to be started."""
    if client is not None:
        return WorkerMemory(_smallest_worker(client), "a worker of the client")
    if isinstance(cluster, Local):
        from sweep.tasks.cluster import cores
        from sweep.tasks.clusters.machines import memory_of_worker

        bounds = cluster.workers or Bounds(cores(), cores())
        shared = 1 if cluster.worker.memory else bounds.most
        return WorkerMemory(memory_of_worker(cluster, bounds), "each worker", shared)
    memory = getattr(getattr(cluster, "worker", None), "memory", None)
    return WorkerMemory(memory or np.inf, "each worker of the cluster")


def _smallest_worker(client: Client) -> float:
    """Return the least memory of a client's workers [bytes]; inf if there is none, or no limit.

    Of a client that is closed, or whose scheduler is gone, nothing is known: a study with blocks
    left says so when it reaches for the workers, and a complete one needs none.
    """
    if client.status != "running":
        return np.inf
    try:
        workers = client.scheduler_info(n_workers=-1).get("workers", {}).values()
    except (OSError, RuntimeError, CancelledError):  # gone meanwhile
        return np.inf
    return min((worker.get("memory_limit") or np.inf for worker in workers), default=np.inf)


def refuse_too_large(spec: Spec | SceneSpec, memory: WorkerMemory) -> None:
    """Raise a SpecError if one point needs more memory than a process has."""
    needed = point_bytes(spec)
    if needed > memory.limit:
        rule = f"makes a point take about {_gigabytes(needed)} of memory, {_shortage(memory)}"
        size = f"{largest_fft(spec):,} points"
        remedy = f"take fewer points of the FFT{_or_fewer_workers(memory, needed)}"
        raise SpecError([Mistake(FFT_SIZE, rule, size, remedy)])


def refuse_too_large_study(study: GridStudy | FlightStudy, memory: WorkerMemory) -> None:
    """Refuse a study of which a point, a block or the scene takes more than a process has."""
    refuse_too_large(study.spec, memory)
    refuse_too_large_blocks(study, memory)
    if isinstance(study.spec, SceneSpec):
        refuse_too_large_scene(study.spec, memory)


def refuse_too_large_scene(spec: SceneSpec, memory: WorkerMemory) -> None:
    """Raise a SpecError if a scene and one point need more memory than a process has."""
    needed = point_bytes(spec) + scene_bytes(spec)
    if needed > memory.limit:
        rule = (
            f"takes about {_gigabytes(needed)} of memory in each process that computes, "
            f"{_shortage(memory)}"
        )
        remedy = f"take coarser grounds and meshes{_or_fewer_workers(memory, needed)}"
        raise SpecError([Mistake("scene.objects", rule, "", remedy)])


def refuse_too_large_blocks(study: Study, memory: WorkerMemory) -> None:
    """Raise a SpecError if the results of one block need more memory than a process has."""
    needed = 2 * study.block_bytes  # its own, and those being encoded
    if needed > memory.limit:
        rule = f"makes a block take about {_gigabytes(needed)} of memory, {_shortage(memory)}"
        raise SpecError([Mistake("storage", rule, "", "lower the number that a block holds")])


def _shortage(memory: WorkerMemory) -> str:
    return f"and {memory.owner} has {_gigabytes(memory.limit)}"


def _or_fewer_workers(memory: WorkerMemory, needed: float) -> str:
    """Return a remedy such as ', or --workers 4' if fewer workers would suffice, else ''."""
    fewer = int(memory.limit * memory.workers / needed)
    return f", or {option('workers', fewer)}" if 1 <= fewer < memory.workers else ""


def _gigabytes(size: float) -> str:
    return f"{size / 1e9:,.1f} GB"
