"""Workers in pods that the Dask operator of a Kubernetes cluster starts: `sweep[kubernetes]`."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

from sweep.extras import install_hint
from sweep.spec.cluster_config import KubernetesClusterConfig, WorkerBounds
from sweep.tasks.engine.deploy import local_ssh
from sweep.tasks.engine.progress import ClusterError

#: API version of the resources of the Dask operator.
DASK_OPERATOR_API_VERSION = "kubernetes.dask.org/v1"

#: Port at which the scheduler listens in its pod.
SCHEDULER_PORT = 8786

#: Time in which the scheduler's pod must be ready [s]; an image may have to be fetched first.
POD_READY_SECONDS_MAX = 600.0

#: Folder in which pods find the TLS certificates.
CERTIFICATE_FOLDER = "/etc/sweep-tls"

#: HTTP routes of the scheduler from which the Dask operator reads the state of workers.
SCHEDULER_HTTP_ROUTES = ["distributed.http.scheduler.api", "distributed.http.health"]


@contextmanager
def deploy_cluster(cluster: KubernetesClusterConfig, bounds: WorkerBounds) -> Iterator[str]:
    """Context manager that creates a Dask cluster in Kubernetes and yields its address.

    The address is that of the scheduler. The cluster is deleted at the end. ClusterError is raised
    on failure.
    """
    try:
        from httpx import HTTPError
        from kr8s import APITimeoutError, NotFoundError, ServerError
        from kr8s.objects import Service, new_class
    except ImportError as error:
        raise ClusterError(install_hint(error) or str(error)) from error
    kubernetes_errors = (
        APITimeoutError,
        HTTPError,
        NotFoundError,
        OSError,
        ServerError,
        ValueError,
    )
    with ExitStack() as stack:
        try:
            for declaration in (
                cluster_resource(cluster, bounds),
                autoscaler_resource(cluster, bounds),
            ):
                if declaration is not None:
                    kubernetes_object = new_class(declaration["kind"], DASK_OPERATOR_API_VERSION)(
                        declaration, namespace=cluster.namespace
                    )
                    kubernetes_object.create()
                    stack.callback(_delete_resource, kubernetes_object)
            service = _wait_for_service(Service, cluster)
            address = stack.enter_context(_open_service_address(service, cluster))
        except kubernetes_errors as error:
            raise ClusterError(f"Kubernetes starts no workers: {error}") from error
        yield address


def _delete_resource(kubernetes_object: Any) -> None:
    """Delete a Kubernetes resource; errors are ignored."""
    with suppress(Exception):  # removed, or out of reach: the results are stored anyway
        kubernetes_object.delete()


def _wait_for_service(service_class: Any, cluster: KubernetesClusterConfig) -> Any:
    """Wait until the scheduler's pod is ready. Return the Kubernetes service of the scheduler.

    ConnectionError is raised if the pod is not ready after `POD_READY_SECONDS_MAX`.
    """
    from kr8s import NotFoundError

    deadline = time.monotonic() + POD_READY_SECONDS_MAX
    while time.monotonic() < deadline:
        with suppress(NotFoundError):
            service = service_class.get(f"{cluster.name}-scheduler", namespace=cluster.namespace)
            if service.ready_pods():
                return service
        time.sleep(1)
    raise ConnectionError(f"the scheduler's pod is not ready after {POD_READY_SECONDS_MAX:.0f} s")


@contextmanager
def _open_service_address(service: Any, cluster: KubernetesClusterConfig) -> Iterator[str]:
    """Context manager that yields an address at which the scheduler's service can be reached.

    Inside the Kubernetes cluster this is the service's own address. Outside the cluster it is the
    address of a port of this machine, which is forwarded to the service.
    """
    if _is_resolvable_host(scheduler_host(cluster)):
        yield f"{connection_protocol(cluster)}://{scheduler_host(cluster)}:{SCHEDULER_PORT}"
        return
    with socket.socket() as free_socket:
        free_socket.bind(("127.0.0.1", 0))
        port = free_socket.getsockname()[1]
    forward = service.portforward(SCHEDULER_PORT, local_port=port)
    forward.start()
    try:
        yield f"{connection_protocol(cluster)}://127.0.0.1:{port}"
    finally:
        forward.stop()


def _is_resolvable_host(name: str) -> bool:
    """Return True if the host name can be resolved to an address."""
    try:
        socket.getaddrinfo(name, SCHEDULER_PORT)
    except OSError:
        return False
    return True


def connection_protocol(cluster: KubernetesClusterConfig) -> str:
    """Return the protocol of connections between scheduler, workers and client: `tls` or `tcp`."""
    return "tls" if cluster.security else "tcp"


def scheduler_host(cluster: KubernetesClusterConfig) -> str:
    """Return the host name of the scheduler inside the Kubernetes cluster."""
    return f"{cluster.name}-scheduler.{cluster.namespace}.svc.cluster.local"


def autoscaler_resource(
    cluster: KubernetesClusterConfig, bounds: WorkerBounds
) -> dict[str, Any] | None:
    """Return the Kubernetes resource that adapts the number of workers to the work.

    The result is None if the number of workers is fixed.
    """
    if bounds.least == bounds.most:
        return None
    return {
        "apiVersion": DASK_OPERATOR_API_VERSION,
        "kind": "DaskAutoscaler",
        "metadata": {"name": cluster.name},
        "spec": {"cluster": cluster.name, "minimum": bounds.least, "maximum": bounds.most},
    }


def cluster_resource(cluster: KubernetesClusterConfig, bounds: WorkerBounds) -> dict[str, Any]:
    """Return the Kubernetes resource that describes the Dask cluster."""
    try:
        from dask_kubernetes.operator import make_cluster_spec
    except ImportError as error:
        raise ClusterError(install_hint(error) or str(error)) from error
    worker = cluster.worker
    worker_size = {"cpu": str(worker.threads), "memory": str(int(worker.memory))}
    declaration: dict[str, Any] = make_cluster_spec(
        name=cluster.name,
        image=cluster.image,
        n_workers=bounds.least,
        resources={"requests": worker_size, "limits": worker_size},
    )
    scheduler_pod, worker_pod = (
        declaration["spec"]["scheduler"]["spec"],
        declaration["spec"]["worker"]["spec"],
    )
    arguments = ["--host", "0.0.0.0", "--port", str(SCHEDULER_PORT), "--dashboard-address", ":8787"]
    variables = {
        "DASK_DISTRIBUTED__ADAPTIVE__TARGET_DURATION": local_ssh.ADAPTIVE_TARGET_DURATION,
        "DASK_DISTRIBUTED__SCHEDULER__HTTP__ROUTES": str(SCHEDULER_HTTP_ROUTES),
    }
    _configure_pod(scheduler_pod, ["scheduler", *arguments], variables, cluster)
    arguments = [
        "--name",
        "$(DASK_WORKER_NAME)",
        "--no-dashboard",
        "--preload",
        local_ssh.PRELOAD_MODULE,
    ]
    arguments += ["--nthreads", worker_size["cpu"], "--memory-limit", worker_size["memory"]]
    address = f"{connection_protocol(cluster)}://{scheduler_host(cluster)}:{SCHEDULER_PORT}"
    variables = {
        "DASK_SCHEDULER_ADDRESS": address,
        **local_ssh.worker_environment(cluster.environment),
    }
    _configure_pod(worker_pod, ["worker", *arguments], variables, cluster)
    worker_pod["containers"][0].pop("ports")  # a worker has no HTTP server
    return declaration


def _configure_pod(
    pod: dict[str, Any],
    arguments: list[str],
    variables: dict[str, str],
    cluster: KubernetesClusterConfig,
) -> None:
    """Set the command, environment and volumes of the only container of a pod, in place."""
    (container,) = pod["containers"]
    container["args"] = ["dask", *arguments, *_tls_arguments(cluster)]
    container["env"] = [{"name": name, "value": value} for name, value in variables.items()]
    volumes: list[dict[str, Any]] = []
    mounts: list[dict[str, Any]] = []
    if cluster.volume:
        claim_reference = {"claimName": cluster.volume.claim}
        volumes.append({"name": "studies", "persistentVolumeClaim": claim_reference})
        mounts.append({"name": "studies", "mountPath": cluster.volume.path})
    if cluster.secret:
        volumes.append({"name": "tls", "secret": {"secretName": cluster.secret}})
        mounts.append({"name": "tls", "mountPath": CERTIFICATE_FOLDER, "readOnly": True})
    if volumes:
        pod["volumes"], container["volumeMounts"] = volumes, mounts


def _tls_arguments(cluster: KubernetesClusterConfig) -> list[str]:
    """Return the command-line arguments that enable TLS; empty if there are no certificates."""
    if not cluster.security:
        return []
    name_by_option = {"ca-file": "ca", "cert": "certificate", "key": "key"}
    arguments = [
        (f"--tls-{option}", f"{CERTIFICATE_FOLDER}/{name}.pem")
        for option, name in name_by_option.items()
    ]
    return [
        "--protocol",
        "tls",
        *(argument for option_and_path in arguments for argument in option_and_path),
    ]
