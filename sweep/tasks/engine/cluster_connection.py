"""Connections to a Dask cluster: a running one, or workers that the session starts and ends."""

from __future__ import annotations

import asyncio
import gc
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sweep.extras import install_hint
from sweep.spec.cluster_config import (
    AnyClusterConfig,
    BatchClusterConfig,
    ExistingSchedulerConfig,
    KubernetesClusterConfig,
    LocalClusterConfig,
    SSHClusterConfig,
    WorkerBounds,
)
from sweep.tasks.engine.deploy import kubernetes, local_ssh
from sweep.tasks.engine.progress import ClusterError
from sweep.tasks.engine.text_streams import make_dask_logs_stall_tolerant

if TYPE_CHECKING:
    from distributed import Client, Security

#: Time in which a Dask scheduler must respond to a new client [s].
CONNECT_TIMEOUT_SECONDS = 15.0


class ClusterConnection(NamedTuple):
    """Connection to a Dask cluster: client, number of worker threads, and restart of workers."""

    client: Client
    n_expected_worker_threads: int  # largest number of worker threads; 0 if unknown
    restart_workers: Callable[[], object] = lambda: None  # replaces lost workers


def cpu_count() -> int:
    """Return the number of processor cores that this process may use."""
    from dask.system import CPU_COUNT

    return int(CPU_COUNT)


@contextmanager
def connect_cluster(
    cluster: AnyClusterConfig, *, max_workers: int, processes: bool, say: Callable[[str], None]
) -> Iterator[ClusterConnection]:
    """Context manager that yields a connection to a Dask cluster.

    A cluster that does not run yet is started, with at most `max_workers` workers, and is ended
    with the context. ClusterError is raised if no scheduler responds or no worker starts.
    """
    from distributed import Client

    make_dask_logs_stall_tolerant()
    if isinstance(cluster, ExistingSchedulerConfig):
        with _connect_client(cluster.address, cluster) as client:
            say(f"scheduler {cluster.address}: dashboard {client.dashboard_link}")
            yield ClusterConnection(client, 0)
        return
    bounds = _worker_bounds(cluster, max_workers)
    if isinstance(cluster, KubernetesClusterConfig):
        with (
            kubernetes.deploy_cluster(cluster, bounds) as address,
            _connect_client(address, cluster) as client,
        ):
            say(f"{_workers_text(cluster, bounds)}: scheduler {address}")
            yield ClusterConnection(client, bounds.most * cluster.worker.threads)
        return
    with (
        local_ssh.isolate_spawned_workers(),
        _start_workers(cluster, bounds, processes) as dask_cluster,
        Client(dask_cluster, set_as_default=False) as client,
    ):
        _keep_workers_in_bounds(dask_cluster, cluster, bounds)
        shows_dashboard = local_ssh.shows_dashboard(cluster.scheduler)
        dashboard_text = (
            f": dashboard {local_ssh.dashboard_link(dask_cluster)}" if shows_dashboard else ""
        )
        say(f"{_workers_text(cluster, bounds)}{dashboard_text}")
        n_expected_worker_threads = bounds.most * cluster.worker.threads
        if isinstance(cluster, LocalClusterConfig):
            yield ClusterConnection(
                client, n_expected_worker_threads, lambda: dask_cluster.scale(bounds.least)
            )
        else:  # the cluster itself replaces lost workers, or can't
            yield ClusterConnection(client, n_expected_worker_threads)


def _worker_bounds(cluster: Any, max_workers: int) -> WorkerBounds:
    """Return a cluster's least and largest number of workers, neither above `max_workers`."""
    requested = cluster.workers or WorkerBounds(cpu_count(), cpu_count())
    return WorkerBounds(*(min(n_workers, max(1, max_workers)) for n_workers in requested))


def _connect_client(address: str, cluster: AnyClusterConfig) -> Client:
    """Return a Dask client that is connected to the scheduler at an address.

    It does not become Dask's default client, as a client that fails to connect would remain the
    default. ClusterError is raised if no scheduler responds.
    """
    from distributed import Client

    security = local_ssh.make_security(cluster)
    # Checked first, as closing a client that failed to connect takes another half minute.
    with ThreadPoolExecutor(
        1
    ) as executor:  # this thread may have a running event loop, as in a notebook
        try:
            executor.submit(asyncio.run, _check_scheduler(address, security)).result()
        except (OSError, ValueError, ImportError) as error:
            raise ClusterError(f"no Dask scheduler answers at {address}: {error}") from error
        except Exception as error:  # decoding of another protocol may raise anything
            raise ClusterError(
                f"what answers at {address} is no Dask scheduler ({type(error).__name__})"
            ) from error
    try:
        return Client(
            address, timeout=CONNECT_TIMEOUT_SECONDS, security=security, set_as_default=False
        )
    except (OSError, ValueError) as error:
        # Collected here: if it is collected while another client is made, it waits for the lock of
        # that client for ever.
        traceback.clear_frames(error.__traceback__)
        gc.collect()
        raise ClusterError(f"no Dask scheduler answers at {address}: {error}") from error


async def _check_scheduler(address: str, security: Security | None) -> None:
    """Ask the scheduler at an address for its identity.

    An exception is raised if it does not respond in time.
    """
    from distributed import Security, rpc

    connection_args = (security or Security()).get_connection_args("client")
    async with asyncio.timeout(CONNECT_TIMEOUT_SECONDS + 1.0):  # the timeout of `rpc` has a message
        async with rpc(
            address, timeout=CONNECT_TIMEOUT_SECONDS, connection_args=connection_args
        ) as scheduler:
            await scheduler.identity()


def _start_workers(
    cluster: LocalClusterConfig | BatchClusterConfig | SSHClusterConfig,
    bounds: WorkerBounds,
    processes: bool,
) -> Any:
    """Start workers that end with this process. Return the Dask cluster object.

    ClusterError is raised on failure.
    """
    import dask

    try:
        shows_dashboard = local_ssh.shows_dashboard(cluster.scheduler)
        page_settings = {} if shows_dashboard else local_ssh.NO_HTTP_PAGES_CONFIG
        with dask.config.set({**local_ssh.DASK_CONFIG, **page_settings}):
            if isinstance(cluster, LocalClusterConfig):
                return local_ssh.start_local_cluster(cluster, bounds, processes=processes)
            if isinstance(cluster, BatchClusterConfig):
                from sweep.tasks.engine.deploy import jobqueue

                return jobqueue.start_batch_cluster(cluster, bounds)
            return local_ssh.start_ssh_cluster(cluster, bounds)
    except (OSError, RuntimeError, ImportError) as error:
        raise ClusterError(
            f"no workers could be started: {install_hint(error) or error}"
        ) from error


def _keep_workers_in_bounds(
    dask_cluster: Any, cluster: AnyClusterConfig, bounds: WorkerBounds
) -> None:
    """Have Dask adapt the number of workers, within bounds, and replace batch jobs that end."""
    if isinstance(cluster, BatchClusterConfig):
        from sweep.tasks.engine.deploy import jobqueue

        jobqueue.keep_workers_in_bounds(dask_cluster, cluster, bounds)
    elif bounds.least < bounds.most:
        workers_min, workers_max = bounds
        dask_cluster.adapt(
            minimum=workers_min,
            maximum=workers_max,
            target_duration=local_ssh.ADAPTIVE_TARGET_DURATION,
        )


def _workers_text(cluster: AnyClusterConfig, bounds: WorkerBounds) -> str:
    """Return number and place of workers as text, such as `4 workers on this machine`."""
    count_text = (
        f"{bounds.least} to {bounds.most}" if bounds.least < bounds.most else f"{bounds.most}"
    )
    workers_text = f"{count_text} worker{'s' if bounds.most > 1 else ''}"
    if isinstance(cluster, BatchClusterConfig):
        workers_per_job = cluster.job.workers
        per_job_text = f" of {workers_per_job}" if workers_per_job > 1 else ""
        return f"{workers_text} in {cluster.kind.upper()} jobs{per_job_text}"
    if isinstance(cluster, SSHClusterConfig):
        return f"{workers_text} on {', '.join(cluster.hosts)}"
    if isinstance(cluster, KubernetesClusterConfig):
        return f"{workers_text} in pods of {cluster.namespace}"
    return f"{workers_text} on this machine"


@contextmanager
def write_performance_report(
    client: Client, report_path: Path, say: Callable[[str], None]
) -> Iterator[None]:
    """Context manager that writes Dask's report of the computations in its body to a file.

    The report is written at the end. If that fails, `say` gets a message, and no error is raised.
    """
    from distributed import performance_report

    report = performance_report(filename=str(report_path))
    with client.as_current():
        report.__enter__()
    try:
        yield
    finally:
        try:
            report_path.parent.mkdir(parents=True, exist_ok=True)
            with client.as_current():
                report.__exit__(None, None, None)
            say(f"performance report: {report_path}")
        except Exception as error:  # the scheduler may be gone, and its records with it
            say(f"no performance report: {error}")
