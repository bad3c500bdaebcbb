"""Where tasks run: the workers of a cluster that is described, started and ended with the run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
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
    Cluster,
    Kubernetes,
    Local,
    cluster_of,
    load_cluster,
)
from sweep.tasks.clusters import common, kubernetes, local, ssh
from sweep.tasks.errors import ClusterError

if TYPE_CHECKING:
    from distributed import Client

#: Scheduler "address" of the plain loop.
NONE = "none"

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


def declared(given: str | Path | Mapping[str, Any] | AnyCluster) -> AnyCluster:
    """Cluster from its file, from plain data, or as it is.

    Raises
    ------
    SpecError
        With every mistake in it.
    """
    if isinstance(given, Cluster):
        return given
    return cluster_of(given) if isinstance(given, Mapping) else load_cluster(given)


def of_workers(cluster: AnyCluster, workers: int | None) -> AnyCluster:
    """The same cluster with a fixed number of workers, where one is given.

    Raises
    ------
    ClusterError
        Where its workers are not ours to start.
    """
    if workers is None:
        return cluster
    if isinstance(cluster, Address):
        raise ClusterError(
            f"the workers of {cluster.address} are there already: leave out their number"
        )
    return cluster.model_copy(update={"workers": Bounds(workers, workers)})


@contextmanager
def connected(
    cluster: AnyCluster, *, most: int, processes: bool, say: Callable[[str], None]
) -> Iterator[Reached]:
    """A client of a cluster; where it is started here it ends with it.

    Parameters
    ----------
    cluster
        The cluster.
    most
        Tasks that there can be at once: for more workers than that there is nothing to do.
    processes
        Whether workers on this machine are processes or threads of this one.
    say
        Takes where the cluster is, and its dashboard's address.

    Raises
    ------
    ClusterError
        Where no scheduler answers or no worker starts.
    """
    from distributed import Client

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
        local.spawning(),
        _started(cluster, bounds, processes) as started,
        Client(started, set_as_default=False) as client,
    ):
        _keep(started, cluster, bounds)
        say(f"{_described(cluster, bounds)}: dashboard {started.dashboard_link}")
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
    """A client that is nobody's default: one that fails to connect would stay it."""
    from distributed import Client

    try:
        return Client(
            address,
            timeout=CONNECT_TIMEOUT,
            security=common.security_of(cluster),
            set_as_default=False,
        )
    except (OSError, ValueError) as error:
        raise ClusterError(f"no Dask scheduler answers at {address}: {error}") from error


def _started(cluster: Local | Batch | SSH, bounds: Bounds, processes: bool) -> Any:
    import dask

    try:
        with dask.config.set(common.CALM):
            if isinstance(cluster, Local):
                return local.start(cluster, bounds, processes=processes)
            if isinstance(cluster, Batch):
                from sweep.tasks.clusters import batch

                return batch.start(cluster, bounds)
            return ssh.start(cluster, bounds)
    except (OSError, RuntimeError, ImportError) as error:
        raise ClusterError(f"no workers could be started: {remedy(error) or error}") from error


def _keep(started: Any, cluster: AnyCluster, bounds: Bounds) -> None:
    """Keep the number of workers within bounds, in the place of those that leave.

    Jobs end with their time, so that theirs is kept even where it is fixed.
    """
    if isinstance(cluster, Batch):
        from sweep.tasks.clusters import batch

        batch.keep(started, cluster, bounds)
    elif bounds.least < bounds.most:
        least, most = bounds
        started.adapt(minimum=least, maximum=most, target_duration=common.WORK_AHEAD)


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
