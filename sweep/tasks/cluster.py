"""Clusters to compute blocks: one that is there, or workers that are started and ended here."""

from __future__ import annotations

import asyncio
import gc
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sweep.extras import remedy
from sweep.spec.clusters import (
    SSH,
    Address,
    AnyCluster,
    Batch,
    Bounds,
    Kubernetes,
    Local,
)
from sweep.tasks.clusters import kubernetes, machines
from sweep.tasks.progress import ClusterError
from sweep.tasks.streams import make_dask_logs_patient

if TYPE_CHECKING:
    from distributed import Client, Security

#: Time in which a scheduler has to answer [s].
CONNECT_TIMEOUT = 15.0


class Reached(NamedTuple):
    """A cluster in use."""

    client: Client
    slots: int  # worker threads that it may come to have; 0 where that is unknown
    revive: Callable[[], object] = lambda: None  # starts workers in the place of lost ones


def cores() -> int:
    """Cores that this process may use."""
    from dask.system import CPU_COUNT

    return int(CPU_COUNT)


@contextmanager
def connected(
    cluster: AnyCluster, *, most: int, processes: bool, say: Callable[[str], None]
) -> Iterator[Reached]:
    """Connect a client to a cluster; one that is started here ends with it.

    No more workers are started than there can be tasks at once (`most`). ClusterError where no
    scheduler answers or no worker starts.
    """
    from distributed import Client

    make_dask_logs_patient()
    if isinstance(cluster, Address):
        with _reached(cluster.address, cluster) as client:
            say(f"scheduler {cluster.address}: dashboard {client.dashboard_link}")
            yield Reached(client, 0)
        return
    bounds = _bounds(cluster, most)
    if isinstance(cluster, Kubernetes):
        with kubernetes.deployed(cluster, bounds) as address, _reached(address, cluster) as client:
            say(f"{_described(cluster, bounds)}: scheduler {address}")
            yield Reached(client, bounds.most * cluster.worker.threads)
        return
    with (
        machines.spawning(),
        _started(cluster, bounds, processes) as started,
        Client(started, set_as_default=False) as client,
    ):
        _keep(started, cluster, bounds)
        shows_dashboard = machines.shows_dashboard(cluster.scheduler)
        link = f": dashboard {machines.dashboard_link(started)}" if shows_dashboard else ""
        say(f"{_described(cluster, bounds)}{link}")
        slots = bounds.most * cluster.worker.threads
        if isinstance(cluster, Local):
            yield Reached(client, slots, lambda: started.scale(bounds.least))
        else:  # what is lost comes again by itself, or not at all
            yield Reached(client, slots)


def _bounds(cluster: Any, most: int) -> Bounds:
    """Bounds of the number of workers, none of which shall have nothing to do."""
    wanted = cluster.workers or Bounds(cores(), cores())
    return Bounds(*(min(number, max(1, most)) for number in wanted))


def _reached(address: str, cluster: AnyCluster) -> Client:
    """Make a client that is not Dask's default: one that fails to connect would stay it."""
    from distributed import Client

    security = machines.security_of(cluster)
    # A client that fails to connect takes half a minute more to be closed.
    with ThreadPoolExecutor(1) as pool:  # this thread may have a loop that runs, as a notebook's
        try:
            pool.submit(asyncio.run, _check_scheduler(address, security)).result()
        except (OSError, ValueError, ImportError) as error:
            raise ClusterError(f"no Dask scheduler answers at {address}: {error}") from error
        except Exception as error:  # whatever decoding of another protocol raises
            raise ClusterError(
                f"what answers at {address} is no Dask scheduler ({type(error).__name__})"
            ) from error
    try:
        return Client(address, timeout=CONNECT_TIMEOUT, security=security, set_as_default=False)
    except (OSError, ValueError) as error:
        # Collected here, as one that goes while another is made waits for ever for that one's lock.
        traceback.clear_frames(error.__traceback__)
        gc.collect()
        raise ClusterError(f"no Dask scheduler answers at {address}: {error}") from error


async def _check_scheduler(address: str, security: Security | None) -> None:
    """Ask a scheduler who it is; raises where none answers in time."""
    from distributed import Security, rpc

    arguments = (security or Security()).get_connection_args("client")
    async with asyncio.timeout(CONNECT_TIMEOUT + 1.0):  # the other one has words
        async with rpc(address, timeout=CONNECT_TIMEOUT, connection_args=arguments) as scheduler:
            await scheduler.identity()


def _started(cluster: Local | Batch | SSH, bounds: Bounds, processes: bool) -> Any:
    import dask

    try:
        shows_dashboard = machines.shows_dashboard(cluster.scheduler)
        pages = {} if shows_dashboard else machines.WITHOUT_PAGES
        with dask.config.set({**machines.CALM, **pages}):
            if isinstance(cluster, Local):
                return machines.start_here(cluster, bounds, processes=processes)
            if isinstance(cluster, Batch):
                from sweep.tasks.clusters import batch

                return batch.start(cluster, bounds)
            return machines.start_by_ssh(cluster, bounds)
    except (OSError, RuntimeError, ImportError) as error:
        raise ClusterError(f"no workers could be started: {remedy(error) or error}") from error


def _keep(started: Any, cluster: AnyCluster, bounds: Bounds) -> None:
    """Keep the number of workers within bounds; that of jobs, which end, even if it is fixed."""
    if isinstance(cluster, Batch):
        from sweep.tasks.clusters import batch

        batch.keep(started, cluster, bounds)
    elif bounds.least < bounds.most:
        least, most = bounds
        started.adapt(minimum=least, maximum=most, target_duration=machines.WORK_AHEAD)


def _described(cluster: AnyCluster, bounds: Bounds) -> str:
    count = f"{bounds.least} to {bounds.most}" if bounds.least < bounds.most else f"{bounds.most}"
    workers = f"{count} worker{'s' if bounds.most > 1 else ''}"
    if isinstance(cluster, Batch):
        held = cluster.job.workers
        each = f" of {held}" if held > 1 else ""
        return f"{workers} in {cluster.kind.upper()} jobs{each}"
    if isinstance(cluster, SSH):
        return f"{workers} on {', '.join(cluster.hosts)}"
    if isinstance(cluster, Kubernetes):
        return f"{workers} in pods of {cluster.namespace}"
    return f"{workers} on this machine"


@contextmanager
def reported(client: Client, file: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Write Dask's report of what a cluster does meanwhile; that it can't is no reason to fail."""
    from distributed import performance_report

    report = performance_report(filename=str(file))
    with client.as_current():
        report.__enter__()
    try:
        yield
    finally:
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            with client.as_current():
                report.__exit__(None, None, None)
            say(f"performance report: {file}")
        except Exception as error:  # the scheduler may be gone, and with it what it knew
            say(f"no performance report: {error}")
