"""Workers on this machine."""

from __future__ import annotations

from typing import Any

from sweep.spec.cluster_fields import Bounds
from sweep.spec.clusters import Local
from sweep.tasks.clusters import common

LEAST_MEMORY = 1 << 30


def start(cluster: Local, bounds: Bounds, *, processes: bool) -> Any:
    """Workers of this machine, as processes or as threads of this one.

    Raises
    ------
    OSError, RuntimeError, ImportError
        Where they can't be started.
    """
    import dask
    from distributed import LocalCluster

    listening = common.scheduler_options(cluster.scheduler)
    dashboard, port = listening.pop("dashboard_address"), listening.pop("port")
    options: dict[str, Any] = {
        "n_workers": bounds.least,
        "threads_per_worker": cluster.worker.threads,
        "processes": processes,
        "memory_limit": _memory(cluster, bounds) if processes else 0,
        "preload": [common.PRELOAD],
        "security": common.security_of(cluster),
    }
    if processes:
        options |= listening | {"scheduler_port": port}
    name = "distributed.nanny.pre-spawn-environ"
    environment = {**dask.config.get(name), **common.environment(cluster.environment)}
    with dask.config.set({**common.CALM, name: environment}):
        try:
            return LocalCluster(dashboard_address=dashboard, **options)
        except (OSError, ImportError, RuntimeError):  # a study needs no dashboard
            return LocalCluster(dashboard_address=None, **options)


def _memory(cluster: Local, bounds: Bounds) -> int:
    """Bytes that a worker may take before Dask restarts it: by default its share of 90 %."""
    from distributed.system import MEMORY_LIMIT

    given = cluster.worker.memory
    return int(given) if given else max(LEAST_MEMORY, int(0.9 * MEMORY_LIMIT / bounds.most))
