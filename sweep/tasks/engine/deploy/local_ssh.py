"""Workers on this machine and on machines reached by SSH, and settings that all clusters share."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sweep.spec.cluster_config import (
    LOOPBACK_ADDRESS,
    NO_DASHBOARD,
    ClusterConfig,
    LocalClusterConfig,
    SchedulerConfig,
    SSHClusterConfig,
    WorkerBounds,
)
from sweep.tasks.engine.progress import ClusterError

if TYPE_CHECKING:
    from distributed import Security


#: Name of the Python module that a worker runs when it starts.
PRELOAD_MODULE = "sweep.tasks.preload"

#: Environment variables that limit the threads of numerical libraries to one per worker thread.
SINGLE_THREAD_VARIABLES = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
}

#: Environment variable that removes the working directory from Python's search path. Otherwise
#: every worker would run a file `socket.py` in that directory.
SAFE_PATH_VARIABLE = "PYTHONSAFEPATH"

#: Settings of Dask that reduce its self-monitoring, and disable the pause near the memory limit. By
#: default each worker monitors itself some 150 times a second, which takes a tenth of its time.
#: Tasks leave no data on a worker, so a worker that pauses would never resume. A worker at the
#: memory limit is ended, and its blocks go to others.
DASK_CONFIG: dict[str, Any] = {
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "2s",
    "distributed.worker.profile.interval": "200ms",
    "distributed.worker.profile.cycle": "10s",
    "distributed.worker.memory.monitor-interval": "200ms",
    "distributed.worker.memory.pause": False,
    "distributed.worker.http.routes": [],  # all users of the machine could read the pages
}

#: Settings of a scheduler without a dashboard. Dask starts its HTTP server anyway, but without
#: pages; by default it shows workers, tasks and logs to all users of the machine.
NO_HTTP_PAGES_CONFIG: dict[str, Any] = {"distributed.scheduler.http.routes": []}

#: Time of pending work per worker thread above which an adaptive cluster adds a thread (Dask text).
ADAPTIVE_TARGET_DURATION = "1s"


def worker_environment(user_variables: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables of workers, by name: sweep's, and those of the user.

    Sweep's variables limit threads, remove the working directory from the import path, and
    configure Dask. A variable of the user's takes precedence.
    """
    dask_variables = {
        f"DASK_{name.upper().replace('.', '__').replace('-', '_')}": str(setting)
        for name, setting in DASK_CONFIG.items()
    }
    return {**SINGLE_THREAD_VARIABLES, SAFE_PATH_VARIABLE: "1", **dask_variables, **user_variables}


def make_security(cluster: ClusterConfig) -> Security | None:
    """Return the TLS settings of client, scheduler and workers; None if there are no certificates.

    With TLS, all three refuse connections without a certificate.
    """
    from distributed import Security

    settings = security_settings(cluster)
    return Security(**settings) if settings else None


def security_settings(cluster: ClusterConfig) -> dict[str, Any]:
    """Return the keyword arguments of `distributed.Security`; empty without certificates."""
    paths = cluster.certificate_paths()
    if paths is None:
        return {}
    role_files: dict[str, str] = {}
    for role in ("client", "scheduler", "worker"):
        role_files |= {f"tls_{role}_cert": paths.certificate, f"tls_{role}_key": paths.key}
    return {"require_encryption": True, "tls_ca_file": paths.ca, **role_files}


def scheduler_options(scheduler: SchedulerConfig) -> dict[str, Any]:
    """Return Dask's options for a scheduler in this process: its addresses and its dashboard."""
    options: dict[str, Any] = {
        "port": scheduler.port,
        "dashboard": shows_dashboard(scheduler),
        "dashboard_address": dashboard_address(scheduler),
    }
    if scheduler.interface:
        return options | {"interface": scheduler.interface}
    return options | {"host": scheduler.host or LOOPBACK_ADDRESS}


def shows_dashboard(scheduler: SchedulerConfig) -> bool:
    """Return True if the configuration asks for Dask's dashboard."""
    return scheduler.dashboard != NO_DASHBOARD


def dashboard_address(scheduler: SchedulerConfig) -> str:
    """Return the address of a scheduler's HTTP server, on this machine's loopback interface.

    The port is the requested one. If it is taken, or if no dashboard is requested, the port is 0,
    which stands for any free port.
    """
    port = int(scheduler.dashboard.rpartition(":")[2]) if shows_dashboard(scheduler) else 0
    with socket.socket() as test_socket:
        try:
            test_socket.bind((LOOPBACK_ADDRESS, port))
        except (OSError, OverflowError):
            return f"{LOOPBACK_ADDRESS}:0"
    return f"{LOOPBACK_ADDRESS}:{port}"


#: Smallest memory limit of a worker on this machine, unless a limit is configured [bytes].
WORKER_MEMORY_BYTES_MIN = 1 << 30

#: Time without a sign of life from a worker after which it is ended and restarted (Dask text).
WORKER_TTL = "2 minutes"


@contextmanager
def isolate_spawned_workers() -> Iterator[None]:
    """Context manager in which worker processes start without the caller's script and folder.

    By default a spawned process imports from the working directory, and runs the script of its
    parent. Workers need neither: functions of the script are sent by value.
    """
    main_globals, previous_value = vars(sys.modules["__main__"]), os.environ.get(SAFE_PATH_VARIABLE)
    removed_globals = {
        name: main_globals.pop(name) for name in [*main_globals] if name in ("__file__", "__spec__")
    }
    main_globals["__spec__"] = None
    os.environ[SAFE_PATH_VARIABLE] = "1"  # also for processes that multiprocessing starts itself
    try:
        yield
    finally:
        main_globals.update(removed_globals)
        os.environ.pop(SAFE_PATH_VARIABLE)
        if previous_value is not None:
            os.environ[SAFE_PATH_VARIABLE] = previous_value


def start_local_cluster(
    cluster: LocalClusterConfig, bounds: WorkerBounds, *, processes: bool
) -> Any:
    """Start workers on this machine. Return the Dask cluster.

    Workers are processes if `processes`, else threads. OSError, RuntimeError or ImportError is
    raised on failure.
    """
    import dask
    from distributed import LocalCluster, Security

    listen_options = scheduler_options(cluster.scheduler)
    dashboard_options = {
        config_name: listen_options.pop(config_name)
        for config_name in ("dashboard", "dashboard_address")
    }
    port = listen_options.pop("port")
    options: dict[str, Any] = {
        "n_workers": bounds.least,
        "threads_per_worker": cluster.worker.threads,
        "processes": processes,
        "memory_limit": worker_memory_limit(cluster, bounds) if processes else 0,
        "preload": [PRELOAD_MODULE],
        "security": make_security(cluster),
    }
    if processes:  # worker threads need no port
        options |= listen_options | {"scheduler_port": port}
        dashboard_options["worker_ttl"] = WORKER_TTL
        options["security"] = options["security"] or Security.temporary()
    else:
        options["worker_dashboard_address"] = (
            f"{LOOPBACK_ADDRESS}:0"  # by default it listens on all networks
        )
        options["worker_class"] = _make_worker_class_without_pages()
    config_name = "distributed.nanny.pre-spawn-environ"
    environment_variables = {
        **dask.config.get(config_name),
        **worker_environment(cluster.environment),
    }
    with dask.config.set({**DASK_CONFIG, config_name: environment_variables}):
        try:
            return LocalCluster(scheduler_kwargs=dashboard_options, **options)
        except (OSError, ImportError, RuntimeError):  # the run goes on without a dashboard
            dashboard_options |= {"dashboard": False, "dashboard_address": f"{LOOPBACK_ADDRESS}:0"}
            return LocalCluster(scheduler_kwargs=dashboard_options, **options)


def _make_worker_class_without_pages() -> type:
    """Return a class of Dask workers without web pages, for threads of this process.

    Dask starts an HTTP server for each worker. The server of this class has no pages.
    """
    from distributed import Worker

    class WorkerWithoutPages(Worker):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options | {"dashboard": False})

    return WorkerWithoutPages


def dashboard_link(dask_cluster: Any) -> str:
    """Return the URL of the dashboard of a cluster that this process started."""
    from distributed.utils import format_dashboard_link

    return str(
        format_dashboard_link(
            LOOPBACK_ADDRESS, dask_cluster.scheduler_info["services"]["dashboard"]
        )
    )


def worker_memory_limit(cluster: LocalClusterConfig, bounds: WorkerBounds) -> int:
    """Return the memory use at which Dask restarts a worker [bytes].

    By default it is the worker's equal share of 90 % of the machine's memory.
    """
    from distributed.system import MEMORY_LIMIT

    requested_bytes = cluster.worker.memory
    return (
        int(requested_bytes)
        if requested_bytes
        else max(WORKER_MEMORY_BYTES_MIN, int(0.9 * MEMORY_LIMIT / bounds.most))
    )


def start_ssh_cluster(cluster: SSHClusterConfig, bounds: WorkerBounds) -> Any:
    """Start workers on all machines by SSH. Return the Dask cluster.

    OSError or RuntimeError is raised if a machine can't be reached.
    """
    import asyncssh
    from distributed import Scheduler, SpecCluster

    security = make_security(cluster)
    protocol = {"protocol": "tls://", "security": security} if security else {}
    try:
        return SpecCluster(
            workers=ssh_worker_specs(cluster, bounds.most),
            scheduler={
                "cls": Scheduler,
                "options": scheduler_options(cluster.scheduler) | protocol,
            },
            security=security,
            name="SSH",
        )
    except asyncssh.Error as error:
        raise RuntimeError(f"{type(error).__name__}: {error}") from error


def ssh_worker_specs(cluster: SSHClusterConfig, n_workers: int) -> dict[str, dict[str, Any]]:
    """Return one Dask worker specification for each machine, by the machine's host name.

    A specification starts all workers of its machine. The `n_workers` workers are distributed
    evenly over machines.
    """
    from distributed.deploy.ssh import Worker

    hosts = cluster.hosts[:n_workers]
    workers_per_host = [
        n_workers // len(hosts) + (i < n_workers % len(hosts)) for i in range(len(hosts))
    ]
    return {
        host: {
            "cls": Worker,
            "options": {
                "address": host,
                "connect_options": _ssh_connect_options(cluster),
                "remote_python": cluster.python or None,
                "worker_class": "distributed.Nanny",
                "kwargs": ssh_nanny_options(cluster) | {"n_workers": workers_on_host},
            },
        }
        for host, workers_on_host in zip(hosts, workers_per_host, strict=True)
    }


def _ssh_connect_options(cluster: SSHClusterConfig) -> dict[str, Any]:
    """Return the keyword arguments of `asyncssh.connect` for one machine."""
    options = {
        "username": cluster.user,
        "client_keys": cluster.identity and [cluster.resolve_path(cluster.identity)],
        "known_hosts": cluster.known_hosts and cluster.resolve_path(cluster.known_hosts),
    }
    return {"port": cluster.port, **{name: value for name, value in options.items() if value}}


def ssh_nanny_options(cluster: SSHClusterConfig) -> dict[str, Any]:
    """Return the arguments of Dask's nannies, the processes that start and watch workers.

    The arguments are sent to the machines as JSON.
    """
    security = security_settings(cluster)
    return {
        "nthreads": cluster.worker.threads,
        "memory_limit": int(cluster.worker.memory),
        "preload": [PRELOAD_MODULE],
        "env": worker_environment(cluster.environment),
        "dashboard": False,
        **({"security": security, "protocol": "tls://"} if security else {}),
    }


class Certificates(NamedTuple):
    """Paths of the files of a cluster's self-signed TLS certificate."""

    ca: Path  # certificate of the certificate authority
    certificate: Path
    key: Path  # private key


def make_certificates(directory: Path) -> Certificates:
    """Create a TLS certificate for Dask in a directory, and return the paths of its files.

    It is valid for a year. Only the owner can read the files. ClusterError is raised on failure.
    """
    from distributed import Security

    certificates = Certificates(*(directory / f"{name}.pem" for name in Certificates._fields))
    if existing := [file for file in certificates if file.exists()]:
        raise ClusterError(f"{existing[0]} is there already: name another directory")
    security = Security.temporary()
    try:
        directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        contents = security.tls_ca_file, security.tls_client_cert, security.tls_client_key
        for file, content in zip(certificates, contents, strict=True):
            with open(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as stream:
                stream.write(content)
    except OSError as error:
        raise ClusterError(f"{directory} can't be written: {error}") from error
    return certificates
