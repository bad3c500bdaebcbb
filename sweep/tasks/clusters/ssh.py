"""Workers on machines that are reached by SSH; the scheduler is part of the driver."""

from __future__ import annotations

from typing import Any

from sweep.spec.clusters import SSH, Bounds
from sweep.tasks.clusters import common


def start(cluster: SSH, bounds: Bounds) -> Any:
    """Workers on all machines.

    Raises
    ------
    OSError, RuntimeError
        Where a machine can't be reached, or starts no worker.
    """
    import asyncssh
    from distributed import Scheduler, SpecCluster

    security = common.security_of(cluster)
    protocol = {"protocol": "tls://", "security": security} if security else {}
    try:
        return SpecCluster(
            workers=workers(cluster, bounds.most),
            scheduler={
                "cls": Scheduler,
                "options": common.scheduler_options(cluster.scheduler) | protocol,
            },
            security=security,
            name="SSH",
        )
    except asyncssh.Error as error:
        raise RuntimeError(f"{type(error).__name__}: {error}") from error


def workers(cluster: SSH, number: int) -> dict[str, dict[str, Any]]:
    """Workers to start on each machine, by its name: they are dealt out evenly."""
    from distributed.deploy.ssh import Worker

    hosts = cluster.hosts[:number]
    shares = [number // len(hosts) + (i < number % len(hosts)) for i in range(len(hosts))]
    return {
        host: {
            "cls": Worker,
            "options": {
                "address": host,
                "connect_options": connection(cluster),
                "remote_python": cluster.python or None,
                "worker_class": "distributed.Nanny",
                "kwargs": nanny(cluster) | {"n_workers": share},
            },
        }
        for host, share in zip(hosts, shares, strict=True)
    }


def connection(cluster: SSH) -> dict[str, Any]:
    """Arguments of `asyncssh.connect`."""
    given = {
        "username": cluster.user,
        "client_keys": cluster.identity and [cluster.path(cluster.identity)],
        "known_hosts": cluster.known_hosts and cluster.path(cluster.known_hosts),
    }
    return {"port": cluster.port, **{name: value for name, value in given.items() if value}}


def nanny(cluster: SSH) -> dict[str, Any]:
    """Arguments of the nannies there: what JSON can hold."""
    security = common.security_settings(cluster)
    return {
        "nthreads": cluster.worker.threads,
        "memory_limit": int(cluster.worker.memory),
        "preload": [common.PRELOAD],
        "env": common.environment(cluster.environment),
        "dashboard": False,
        **({"security": security, "protocol": "tls://"} if security else {}),
    }
