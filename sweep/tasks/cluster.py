"""Where tasks run: a cluster of this machine's cores, a scheduler elsewhere, or a given client."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from sweep.tasks.errors import ClusterError

if TYPE_CHECKING:
    from distributed import Client

#: Scheduler "address" of the plain loop.
NONE = "none"

DASHBOARD_PORT = 8787
CONNECT_TIMEOUT = 15.0
LEAST_MEMORY = 1 << 30

#: One thread a worker slot in every library that would start its own.
ONE_THREAD = {
    "OMP_NUM_THREADS": 1,
    "MKL_NUM_THREADS": 1,
    "OPENBLAS_NUM_THREADS": 1,
    "NUMBA_NUM_THREADS": 1,
}


def cores() -> int:
    """Cores that this process may use."""
    from dask.system import CPU_COUNT

    return int(CPU_COUNT)


@contextmanager
def connected(
    *,
    scheduler: str | None,
    workers: int,
    threads: int,
    processes: bool,
    say: Callable[[str], None],
) -> Iterator[Client]:
    """A client of a scheduler, or of a cluster started here that ends with it.

    Parameters
    ----------
    scheduler
        Address of a scheduler; None starts workers on this machine.
    workers
        Number of workers to start.
    threads
        Threads of each.
    processes
        Whether they are processes or threads of this one.
    say
        Takes the dashboard's address.

    Raises
    ------
    ClusterError
        Where no scheduler answers or no worker starts.
    """
    from distributed import Client

    if scheduler is not None:
        with _reached(scheduler) as client:
            say(f"scheduler {scheduler}: dashboard {client.dashboard_link}")
            yield client
        return
    with _local(workers, threads, processes) as cluster, Client(cluster) as client:
        count = f"{workers} worker{'s' if workers > 1 else ''}"
        say(f"{count} on this machine: dashboard {cluster.dashboard_link}")
        yield client


def _reached(address: str) -> Client:
    from distributed import Client

    try:
        return Client(address, timeout=CONNECT_TIMEOUT)
    except (OSError, ValueError) as error:
        raise ClusterError(f"no Dask scheduler answers at {address}: {error}") from error


def _local(workers: int, threads: int, processes: bool) -> Any:
    import dask
    from distributed import LocalCluster

    options = {
        "n_workers": workers,
        "threads_per_worker": threads,
        "processes": processes,
        "host": "127.0.0.1" if processes else None,
        "memory_limit": memory_limit(workers) if processes else 0,
        "preload": ["sweep.tasks.preload"],
    }
    environment = {**dask.config.get("distributed.nanny.pre-spawn-environ"), **ONE_THREAD}
    with dask.config.set({"distributed.nanny.pre-spawn-environ": environment}):
        try:
            return LocalCluster(dashboard_address=_dashboard(), **options)
        except (OSError, ImportError, RuntimeError):  # a study needs no dashboard
            try:
                return LocalCluster(dashboard_address=None, **options)
            except (OSError, RuntimeError) as error:
                raise ClusterError(f"no workers could be started: {error}") from error


def _dashboard() -> str:
    """Loopback address for a dashboard: its usual port, or any where that is taken."""
    with socket.socket() as probe:
        try:
            probe.bind(("127.0.0.1", DASHBOARD_PORT))
        except OSError:
            return "127.0.0.1:0"
    return f"127.0.0.1:{DASHBOARD_PORT}"


def memory_limit(workers: int) -> int:
    """Bytes that a worker may take before Dask restarts it: its share of 90 % of the memory."""
    from distributed.system import MEMORY_LIMIT

    return max(LEAST_MEMORY, int(0.9 * MEMORY_LIMIT / workers))
