"""Workers on this machine."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sweep.spec.clusters import Bounds, Local
from sweep.tasks.clusters import common

LEAST_MEMORY = 1 << 30

#: Time after which a worker that shows no sign of life is ended, and started anew.
FROZEN = "2 minutes"


@contextmanager
def spawning() -> Iterator[None]:
    """Surroundings in which workers are started, and started anew, as processes.

    A process that is spawned imports from the working directory, unless told otherwise, and runs
    the script that its parent runs, up to ``if __name__ == "__main__"``, which many scripts lack.
    Workers need nothing of it: functions in it travel by value.
    """
    main, safe = vars(sys.modules["__main__"]), os.environ.get(common.SAFE_PATH)
    kept = {name: main.pop(name) for name in [*main] if name in ("__file__", "__spec__")}
    main["__spec__"] = None
    os.environ[common.SAFE_PATH] = "1"  # for what multiprocessing starts itself, too
    try:
        yield
    finally:
        main.update(kept)
        os.environ.pop(common.SAFE_PATH)
        if safe is not None:
            os.environ[common.SAFE_PATH] = safe


def start(cluster: Local, bounds: Bounds, *, processes: bool) -> Any:
    """Workers of this machine, as processes or as threads of this one.

    Raises
    ------
    OSError, RuntimeError, ImportError
        Where they can't be started.
    """
    import dask
    from distributed import LocalCluster, Security

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
    if processes:  # threads need no port
        options |= listening | {"scheduler_port": port}
        options["scheduler_kwargs"] = {"worker_ttl": FROZEN}
        options["security"] = options["security"] or Security.temporary()
    else:
        options["worker_dashboard_address"] = "127.0.0.1:0"  # which is for everyone to see without
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
