"""Memory that is available to the processes that compute blocks of a study."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sweep.spec.cluster_config import AnyClusterConfig, LocalClusterConfig, WorkerBounds

if TYPE_CHECKING:
    from distributed import Client


#: Amount of memory that is assumed to be available everywhere [bytes]; the program itself takes as
#: much. For smaller needs the memory limit is not read, as this imports Dask, which takes longer
#: than a small study.
ALWAYS_AVAILABLE_MEMORY_BYTES = 6e8


@dataclass(frozen=True)
class WorkerMemory:
    """Memory available to a process that computes blocks."""

    find_bytes_max: Callable[[], float]
    """Function that returns the largest memory that the process may use [bytes]."""
    process_name: str
    """Name of the process in messages, such as `this machine` or `a worker of the client`."""
    n_workers_sharing_memory: int = 1
    """Number of workers that share the machine's memory; 1 if each worker has its own limit."""

    @cached_property
    def bytes_max(self) -> float:
        """Largest memory that the process may use [bytes]; inf if it is unknown."""
        return self.find_bytes_max()

    def suffices_for(self, bytes_needed: float) -> bool:
        """Return True if the process may use `bytes_needed` of memory [bytes]."""
        return bytes_needed < ALWAYS_AVAILABLE_MEMORY_BYTES or bytes_needed <= self.bytes_max


def available_process_memory() -> WorkerMemory:
    """Return the memory that this process may use to compute blocks."""

    def machine_limit() -> float:
        from distributed.system import MEMORY_LIMIT

        return float(MEMORY_LIMIT)

    return WorkerMemory(machine_limit, "this machine")


def available_worker_memory(
    client: Client | None, cluster: AnyClusterConfig | None
) -> WorkerMemory:
    """Return the memory of the smallest worker of a Dask client, or of a cluster to be started.

    The cluster counts only if `client` is None. The memory limit is read when it is first needed.
    """
    if client is not None:
        return WorkerMemory(lambda: _smallest_worker_memory_limit(client), "a worker of the client")
    if isinstance(cluster, LocalClusterConfig):
        from sweep.tasks.engine.cluster_connection import cpu_count
        from sweep.tasks.engine.deploy.local_ssh import worker_memory_limit

        bounds = cluster.workers or WorkerBounds(cpu_count(), cpu_count())
        n_workers_sharing_memory = 1 if cluster.worker.memory else bounds.most
        return WorkerMemory(
            lambda: worker_memory_limit(cluster, bounds), "each worker", n_workers_sharing_memory
        )
    bytes_max = getattr(getattr(cluster, "worker", None), "memory", None)
    return WorkerMemory(lambda: bytes_max or np.inf, "each worker of the cluster")


def _smallest_worker_memory_limit(client: Client) -> float:
    """Return the smallest memory limit among a client's workers [bytes].

    The result is inf if there are no workers or none has a limit, and also if the client is closed
    or its scheduler is gone. In the latter case a study with missing blocks fails later, when it
    connects to the workers; a complete study needs no workers.
    """
    if client.status != "running":
        return np.inf
    try:
        workers = client.scheduler_info(n_workers=-1).get("workers", {}).values()
    except (OSError, RuntimeError, CancelledError):  # the scheduler has just gone
        return np.inf
    return min((worker.get("memory_limit") or np.inf for worker in workers), default=np.inf)
