"""Workers in pods, which the Dask operator of a Kubernetes cluster starts: `sweep[kubernetes]`."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from sweep.extras import remedy
from sweep.spec.clusters import Bounds, Kubernetes
from sweep.tasks.clusters import machines
from sweep.tasks.progress import ClusterError

API = "kubernetes.dask.org/v1"
PORT = 8786

#: Seconds in which the scheduler's pod must be ready: an image may have to be fetched first.
READY_SECONDS = 600.0

#: Where certificates are in the pods.
CERTIFICATES = "/etc/sweep-tls"

#: Pages of the scheduler that the operator asks about workers.
ROUTES = ["distributed.http.scheduler.api", "distributed.http.health"]


@contextmanager
def deployed(cluster: Kubernetes, bounds: Bounds) -> Iterator[str]:
    """Address of the scheduler while the cluster is there; ClusterError where that can't be had."""
    try:
        from httpx import HTTPError
        from kr8s import APITimeoutError, NotFoundError, ServerError
        from kr8s.objects import Service, new_class
    except ImportError as error:
        raise ClusterError(remedy(error) or str(error)) from error
    refused = (APITimeoutError, HTTPError, NotFoundError, OSError, ServerError, ValueError)
    with ExitStack() as stack:
        try:
            for asked in (resource(cluster, bounds), autoscaler(cluster, bounds)):
                if asked is not None:
                    kind = new_class(asked["kind"], API)(asked, namespace=cluster.namespace)
                    kind.create()
                    stack.callback(_delete, kind)
            service = _wait_for(Service, cluster)
            address = stack.enter_context(_reachable(service, cluster))
        except refused as error:
            raise ClusterError(f"Kubernetes starts no workers: {error}") from error
        yield address


def _delete(asked: Any) -> None:
    with suppress(Exception):  # gone already, or out of reach: the study is stored all the same
        asked.delete()


def _wait_for(kind: Any, cluster: Kubernetes) -> Any:
    """Return the scheduler's service, once its pod is ready."""
    from kr8s import NotFoundError

    deadline = time.monotonic() + READY_SECONDS
    while time.monotonic() < deadline:
        with suppress(NotFoundError):
            service = kind.get(f"{cluster.name}-scheduler", namespace=cluster.namespace)
            if service.ready_pods():
                return service
        time.sleep(1)
    raise ConnectionError(f"the scheduler's pod is not ready after {READY_SECONDS:.0f} s")


@contextmanager
def _reachable(service: Any, cluster: Kubernetes) -> Iterator[str]:
    """Address of the service: its own from inside the cluster, a forwarded port from outside."""
    if _is_known(host(cluster)):
        yield f"{protocol(cluster)}://{host(cluster)}:{PORT}"
        return
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    forward = service.portforward(PORT, local_port=port)
    forward.start()
    try:
        yield f"{protocol(cluster)}://127.0.0.1:{port}"
    finally:
        forward.stop()


def _is_known(name: str) -> bool:
    try:
        socket.getaddrinfo(name, PORT)
    except OSError:
        return False
    return True


def protocol(cluster: Kubernetes) -> str:
    """Protocol by which all parts talk to each other."""
    return "tls" if cluster.security else "tcp"


def host(cluster: Kubernetes) -> str:
    """Name of the scheduler inside the Kubernetes cluster."""
    return f"{cluster.name}-scheduler.{cluster.namespace}.svc.cluster.local"


def autoscaler(cluster: Kubernetes, bounds: Bounds) -> dict[str, Any] | None:
    """Resource that keeps the number of workers between bounds; None where it is fixed."""
    if bounds.least == bounds.most:
        return None
    return {
        "apiVersion": API,
        "kind": "DaskAutoscaler",
        "metadata": {"name": cluster.name},
        "spec": {"cluster": cluster.name, "minimum": bounds.least, "maximum": bounds.most},
    }


def resource(cluster: Kubernetes, bounds: Bounds) -> dict[str, Any]:
    """Return the cluster as Kubernetes declares it."""
    try:
        from dask_kubernetes.operator import make_cluster_spec
    except ImportError as error:
        raise ClusterError(remedy(error) or str(error)) from error
    worker = cluster.worker
    size = {"cpu": str(worker.threads), "memory": str(int(worker.memory))}
    asked: dict[str, Any] = make_cluster_spec(
        name=cluster.name,
        image=cluster.image,
        n_workers=bounds.least,
        resources={"requests": size, "limits": size},
    )
    scheduler, workers = asked["spec"]["scheduler"]["spec"], asked["spec"]["worker"]["spec"]
    words = ["--host", "0.0.0.0", "--port", str(PORT), "--dashboard-address", ":8787"]
    variables = {
        "DASK_DISTRIBUTED__ADAPTIVE__TARGET_DURATION": machines.WORK_AHEAD,
        "DASK_DISTRIBUTED__SCHEDULER__HTTP__ROUTES": str(ROUTES),
    }
    _fill(scheduler, ["scheduler", *words], variables, cluster)
    words = ["--name", "$(DASK_WORKER_NAME)", "--no-dashboard", "--preload", machines.PRELOAD]
    words += ["--nthreads", size["cpu"], "--memory-limit", size["memory"]]
    address = f"{protocol(cluster)}://{host(cluster)}:{PORT}"
    variables = {"DASK_SCHEDULER_ADDRESS": address, **machines.environment(cluster.environment)}
    _fill(workers, ["worker", *words], variables, cluster)
    workers["containers"][0].pop("ports")  # a worker shows no pages
    return asked


def _fill(
    pod: dict[str, Any], words: list[str], variables: dict[str, str], cluster: Kubernetes
) -> None:
    """Put command, environment and volumes into a pod's only container."""
    (container,) = pod["containers"]
    container["args"] = ["dask", *words, *_tls(cluster)]
    container["env"] = [{"name": name, "value": value} for name, value in variables.items()]
    volumes: list[dict[str, Any]] = []
    mounts: list[dict[str, Any]] = []
    if cluster.volume:
        claim = {"claimName": cluster.volume.claim}
        volumes.append({"name": "studies", "persistentVolumeClaim": claim})
        mounts.append({"name": "studies", "mountPath": cluster.volume.path})
    if cluster.secret:
        volumes.append({"name": "tls", "secret": {"secretName": cluster.secret}})
        mounts.append({"name": "tls", "mountPath": CERTIFICATES, "readOnly": True})
    if volumes:
        pod["volumes"], container["volumeMounts"] = volumes, mounts


def _tls(cluster: Kubernetes) -> list[str]:
    if not cluster.security:
        return []
    files = {"ca-file": "ca", "cert": "certificate", "key": "key"}
    words = [(f"--tls-{option}", f"{CERTIFICATES}/{name}.pem") for option, name in files.items()]
    return ["--protocol", "tls", *(word for pair in words for word in pair)]
