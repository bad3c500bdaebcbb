"""Workers on this machine and on machines reached by SSH; settings that all clusters share."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sweep.spec.clusters import LOOPBACK, NO_DASHBOARD, SSH, Bounds, Cluster, Local, Scheduler
from sweep.tasks.progress import ClusterError

if TYPE_CHECKING:
    from distributed import Security


#: What a worker runs as it starts.
PRELOAD = "sweep.tasks.preload"

#: One thread a worker slot in every library that would start its own.
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
}

#: Variable that keeps the working directory out of the places that modules are imported from: a
#: file `socket.py` there would be run by every worker.
SAFE_PATH = "PYTHONSAFEPATH"

#: How often Dask looks at itself. By default it does so some 150 times a second in each worker,
#: which takes a tenth of the processor's time from whatever else the worker does. And no pause near
#: the memory's limit: tasks leave nothing behind that could be waited for, so a worker that paused
#: would do so for ever. At the limit it is ended, and its blocks go elsewhere.
CALM: dict[str, Any] = {
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "2s",
    "distributed.worker.profile.interval": "200ms",
    "distributed.worker.profile.cycle": "10s",
    "distributed.worker.memory.monitor-interval": "200ms",
    "distributed.worker.memory.pause": False,
    "distributed.worker.http.routes": [],  # pages that all users of the machine could see
}

#: Settings of a scheduler without a dashboard: its HTTP server, which Dask starts all the same, has
#: no page. By default it shows workers, tasks and logs to all users of the machine.
WITHOUT_PAGES: dict[str, Any] = {"distributed.scheduler.http.routes": []}

#: Seconds of work ahead for which a cluster between bounds takes another worker thread.
WORK_AHEAD = "1s"


def environment(given: Mapping[str, str]) -> dict[str, str]:
    """Environment variables of workers: one thread a slot, calm, wary, and those given."""
    calm = {
        f"DASK_{name.upper().replace('.', '__').replace('-', '_')}": str(setting)
        for name, setting in CALM.items()
    }
    return {**ONE_THREAD, SAFE_PATH: "1", **calm, **given}


def security_of(cluster: Cluster) -> Security | None:
    """Certificates of client, scheduler and workers, which then refuse whoever has none."""
    from distributed import Security

    settings = security_settings(cluster)
    return Security(**settings) if settings else None


def security_settings(cluster: Cluster) -> dict[str, Any]:
    """Return settings of `distributed.Security`; empty without certificates."""
    paths = cluster.certificates()
    if paths is None:
        return {}
    ca, certificate, key = paths
    parts: dict[str, str] = {}
    for role in ("client", "scheduler", "worker"):
        parts |= {f"tls_{role}_cert": certificate, f"tls_{role}_key": key}
    return {"require_encryption": True, "tls_ca_file": ca, **parts}


def scheduler_options(section: Scheduler) -> dict[str, Any]:
    """Address at which a scheduler of this process listens, and that of its dashboard, if any."""
    options: dict[str, Any] = {
        "port": section.port,
        "dashboard": shows_dashboard(section),
        "dashboard_address": dashboard(section),
    }
    if section.interface:
        return options | {"interface": section.interface}
    return options | {"host": section.host or LOOPBACK}


def shows_dashboard(section: Scheduler) -> bool:
    """Tell whether a dashboard is asked for."""
    return section.dashboard != NO_DASHBOARD


def dashboard(section: Scheduler) -> str:
    """Address of a scheduler's pages, on this machine's loopback interface.

    The port is the one asked for; any where that is taken, or where no dashboard is asked for.
    """
    port = int(section.dashboard.rpartition(":")[2]) if shows_dashboard(section) else 0
    with socket.socket() as probe:
        try:
            probe.bind((LOOPBACK, port))
        except (OSError, OverflowError):
            return f"{LOOPBACK}:0"
    return f"{LOOPBACK}:{port}"


LEAST_MEMORY = 1 << 30

#: Time after which a worker that shows no sign of life is ended, and started anew.
FROZEN = "2 minutes"


@contextmanager
def spawning() -> Iterator[None]:
    """Surroundings in which workers are started, and started anew, as processes.

    A process that is spawned imports from the working directory, unless told otherwise, and
    runs the script that its parent runs, of which workers need nothing: functions in it travel
    by value.
    """
    main, safe = vars(sys.modules["__main__"]), os.environ.get(SAFE_PATH)
    kept = {name: main.pop(name) for name in [*main] if name in ("__file__", "__spec__")}
    main["__spec__"] = None
    os.environ[SAFE_PATH] = "1"  # for what multiprocessing starts itself, too
    try:
        yield
    finally:
        main.update(kept)
        os.environ.pop(SAFE_PATH)
        if safe is not None:
            os.environ[SAFE_PATH] = safe


def start_here(cluster: Local, bounds: Bounds, *, processes: bool) -> Any:
    """Start workers of this machine; OSError, RuntimeError, ImportError where they can't be."""
    import dask
    from distributed import LocalCluster, Security

    listening = scheduler_options(cluster.scheduler)
    pages = {name: listening.pop(name) for name in ("dashboard", "dashboard_address")}
    port = listening.pop("port")
    options: dict[str, Any] = {
        "n_workers": bounds.least,
        "threads_per_worker": cluster.worker.threads,
        "processes": processes,
        "memory_limit": memory_of_worker(cluster, bounds) if processes else 0,
        "preload": [PRELOAD],
        "security": security_of(cluster),
    }
    if processes:  # threads need no port
        options |= listening | {"scheduler_port": port}
        pages["worker_ttl"] = FROZEN
        options["security"] = options["security"] or Security.temporary()
    else:
        options["worker_dashboard_address"] = f"{LOOPBACK}:0"  # by default all networks reach it
        options["worker_class"] = _worker_without_pages()
    name = "distributed.nanny.pre-spawn-environ"
    variables = {**dask.config.get(name), **environment(cluster.environment)}
    with dask.config.set({**CALM, name: variables}):
        try:
            return LocalCluster(scheduler_kwargs=pages, **options)
        except (OSError, ImportError, RuntimeError):  # a study needs no dashboard
            pages |= {"dashboard": False, "dashboard_address": f"{LOOPBACK}:0"}
            return LocalCluster(scheduler_kwargs=pages, **options)


def _worker_without_pages() -> type:
    """Class of workers as threads that have an address for pages, as Dask asks for, and no page."""
    from distributed import Worker

    class WorkerWithoutPages(Worker):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options | {"dashboard": False})

    return WorkerWithoutPages


def dashboard_link(started: Any) -> str:
    """Address of the dashboard of a cluster that was started here, for a browser."""
    from distributed.utils import format_dashboard_link

    return str(format_dashboard_link(LOOPBACK, started.scheduler_info["services"]["dashboard"]))


def memory_of_worker(cluster: Local, bounds: Bounds) -> int:
    """Bytes that a worker may take before Dask restarts it: by default its share of 90 %."""
    from distributed.system import MEMORY_LIMIT

    given = cluster.worker.memory
    return int(given) if given else max(LEAST_MEMORY, int(0.9 * MEMORY_LIMIT / bounds.most))


def start_by_ssh(cluster: SSH, bounds: Bounds) -> Any:
    """Start workers on all machines; OSError, RuntimeError where one can't be reached."""
    import asyncssh
    from distributed import Scheduler, SpecCluster

    security = security_of(cluster)
    protocol = {"protocol": "tls://", "security": security} if security else {}
    try:
        return SpecCluster(
            workers=ssh_workers(cluster, bounds.most),
            scheduler={
                "cls": Scheduler,
                "options": scheduler_options(cluster.scheduler) | protocol,
            },
            security=security,
            name="SSH",
        )
    except asyncssh.Error as error:
        raise RuntimeError(f"{type(error).__name__}: {error}") from error


def ssh_workers(cluster: SSH, number: int) -> dict[str, dict[str, Any]]:
    """Workers to start on each machine, by its name: they are dealt out evenly."""
    from distributed.deploy.ssh import Worker

    hosts = cluster.hosts[:number]
    shares = [number // len(hosts) + (i < number % len(hosts)) for i in range(len(hosts))]
    return {
        host: {
            "cls": Worker,
            "options": {
                "address": host,
                "connect_options": _connection(cluster),
                "remote_python": cluster.python or None,
                "worker_class": "distributed.Nanny",
                "kwargs": ssh_nanny(cluster) | {"n_workers": share},
            },
        }
        for host, share in zip(hosts, shares, strict=True)
    }


def _connection(cluster: SSH) -> dict[str, Any]:
    """Arguments of `asyncssh.connect`."""
    given = {
        "username": cluster.user,
        "client_keys": cluster.identity and [cluster.path(cluster.identity)],
        "known_hosts": cluster.known_hosts and cluster.path(cluster.known_hosts),
    }
    return {"port": cluster.port, **{name: value for name, value in given.items() if value}}


def ssh_nanny(cluster: SSH) -> dict[str, Any]:
    """Arguments of the nannies there: what JSON can hold."""
    security = security_settings(cluster)
    return {
        "nthreads": cluster.worker.threads,
        "memory_limit": int(cluster.worker.memory),
        "preload": [PRELOAD],
        "env": environment(cluster.environment),
        "dashboard": False,
        **({"security": security, "protocol": "tls://"} if security else {}),
    }


class Certificates(NamedTuple):
    """Files of a cluster's own certificate, which signs itself."""

    ca: Path
    certificate: Path
    key: Path


def make_certificates(directory: Path) -> Certificates:
    """Make Dask's certificate, of a year, which its owner alone may read; else ClusterError."""
    from distributed import Security

    files = Certificates(*(directory / f"{name}.pem" for name in Certificates._fields))
    if there := [file for file in files if file.exists()]:
        raise ClusterError(f"{there[0]} is there already: name another directory")
    made = Security.temporary()
    try:
        directory.mkdir(parents=True, exist_ok=True, mode=0o700)
        contents = made.tls_ca_file, made.tls_client_cert, made.tls_client_key
        for file, content in zip(files, contents, strict=True):
            with open(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as out:
                out.write(content)
    except OSError as error:
        raise ClusterError(f"{directory} can't be written: {error}") from error
    return files
