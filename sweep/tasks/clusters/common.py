"""Settings that all kinds of clusters start their workers with."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from sweep.spec.clusters import Cluster, Scheduler

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
}

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
    """Settings of `distributed.Security`; empty without certificates."""
    paths = cluster.certificates()
    if paths is None:
        return {}
    ca, certificate, key = paths
    parts: dict[str, str] = {}
    for role in ("client", "scheduler", "worker"):
        parts |= {f"tls_{role}_cert": certificate, f"tls_{role}_key": key}
    return {"require_encryption": True, "tls_ca_file": ca, **parts}


def scheduler_options(section: Scheduler) -> dict[str, Any]:
    """Address at which a scheduler of this process listens, and that of its dashboard."""
    options: dict[str, Any] = {"port": section.port, "dashboard_address": dashboard(section)}
    if section.interface:
        return options | {"interface": section.interface}
    return options | {"host": section.host or "127.0.0.1"}


def dashboard(section: Scheduler) -> str:
    """Address for a dashboard: the one asked for, or any port where that is taken."""
    host, _, port = section.dashboard.rpartition(":")
    with socket.socket() as probe:
        try:
            probe.bind((host, int(port)))
        except (OSError, ValueError):
            return f"{host}:0"
    return section.dashboard
