"""Kubernetes without one: what is asked for, and a server that runs the pods' commands here."""

import json
import os
import re
import subprocess
import sys
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import yaml
from small_studies import file_digests, run_serially, small_spec

from sweep.spec import cluster_config_from_mapping, load_cluster_config
from sweep.spec.cluster_config import WorkerBounds
from sweep.tasks.engine.deploy import kubernetes, local_ssh
from sweep.tasks.engine.progress import ClusterError

pytest.importorskip("dask_kubernetes", reason="the extra sweep[kubernetes] is not installed")

DEPLOY = Path(__file__).parents[2] / "deploy"
CLUSTERS = "/apis/kubernetes.dask.org/v1/namespaces/lidar/daskclusters"
AUTOSCALERS = "/apis/kubernetes.dask.org/v1/namespaces/lidar/daskautoscalers"


def kubernetes_objects(**changes):
    mapping = yaml.safe_load((DEPLOY / "kubernetes.yaml").read_text()) | changes
    cluster = cluster_config_from_mapping(mapping)
    return kubernetes.cluster_resource(cluster, cluster.workers)["spec"]


def container(part):
    (only,) = part["spec"]["containers"]
    return only


def test_the_file_becomes_a_resource_of_the_operator():
    spec = kubernetes_objects(environment={"AWS_REGION": "eu-west-1"})
    worker, scheduler = container(spec["worker"]), container(spec["scheduler"])
    assert spec["worker"]["replicas"] == 4
    assert worker["resources"]["limits"] == {"cpu": "1", "memory": "4000000000"}
    assert {"name": "AWS_REGION", "value": "eu-west-1"} in worker["env"]
    assert {"name": "OMP_NUM_THREADS", "value": "1"} in worker["env"]
    for part in (worker, scheduler):
        assert part["image"] == "registry.example.org/sweep:0.1.0"
        assert part["volumeMounts"] == [{"name": "studies", "mountPath": "/data"}]
    for part in ("worker", "scheduler"):
        (volume,) = spec[part]["spec"]["volumes"]
        assert volume["persistentVolumeClaim"] == {"claimName": "studies"}
    assert "--tls-ca-file" not in worker["args"]


def test_workers_between_bounds_have_an_autoscaler_and_others_none():
    cluster = load_cluster_config(DEPLOY / "kubernetes.yaml")
    scaler = kubernetes.autoscaler_resource(cluster, cluster.workers)
    assert scaler["spec"] == {"cluster": "sweep", "minimum": 4, "maximum": 200}
    assert kubernetes.autoscaler_resource(cluster, WorkerBounds(4, 4)) is None


@contextmanager
def api_server(certificate_directory: Path):
    """An API server that knows of Dask clusters and runs their containers' commands here."""
    requests: list[tuple[str, str]] = []
    children: list[subprocess.Popen] = []

    def run(spec) -> None:
        command = [re.sub("^/etc/sweep-tls", str(certificate_directory), w) for w in spec["args"]]
        command = [w.replace("$(DASK_WORKER_NAME)", "pod-1") for w in command]
        assert command[:1] == ["dask"]
        variables = {variable["name"]: variable["value"] for variable in spec["env"]}
        children.append(
            subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.dask_{command[1]}", *command[2:]],
                env=os.environ | variables, start_new_session=True,
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )
        )  # fmt: skip

    class Handler(BaseHTTPRequestHandler):
        def answer(self, body, status=200):
            text = json.dumps(body).encode()
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(text)))
            self.end_headers()
            self.wfile.write(text)

        def do_POST(self):
            requests.append(("POST", self.path))
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            if body["kind"] == "DaskCluster":
                run(body["spec"]["scheduler"]["spec"]["containers"][0])
                run(body["spec"]["worker"]["spec"]["containers"][0])
            self.answer(body, 201)

        def do_DELETE(self):
            requests.append(("DELETE", self.path))
            self.answer({})

        def do_GET(self):
            path = self.path.split("?")[0].rstrip("/")
            requests.append(("GET", path))
            ready = [{"type": t, "status": "True"} for t in ("Ready", "ContainersReady")]
            meta = {"name": "sweep-scheduler", "namespace": "lidar"}
            pod = {"kind": "Pod", "metadata": meta, "status": {"conditions": ready}, "spec": {}}
            service = {"kind": "Service", "metadata": meta, "spec": {"selector": {"a": "b"}}}
            if path.endswith("/services/sweep-scheduler"):
                self.answer(service)
            elif path.endswith("/services"):
                self.answer({"items": [service]})
            elif path.endswith("/pods"):
                self.answer({"items": [pod]})
            elif path.endswith("/pods/sweep-scheduler"):
                self.answer(pod)
            elif path == "/version":
                self.answer({"major": "1", "minor": "30", "gitVersion": "v1.30.0"})
            else:
                self.answer({"kind": "Status", "message": "not found"}, 404)

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.server_port, requests
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
        for child in children:
            os.killpg(child.pid, 9) if child.poll() is None else None
            child.wait()


def kubeconfig(directory: Path, port: int) -> Path:
    file = directory / "kubeconfig"
    file.write_text(
        yaml.safe_dump(
            {
                "apiVersion": "v1", "kind": "Config", "current-context": "test",
                "contexts": [{"name": "test", "context": {"cluster": "test", "user": "test"}}],
                "clusters": [{"name": "test", "cluster": {"server": f"http://127.0.0.1:{port}"}}],
                "users": [{"name": "test", "user": {}}],
            }
        )
    )  # fmt: skip
    return file


def free_port() -> int:
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_study_in_pods_with_tls_leaves_nothing_behind(tmp_path, serial_store, monkeypatch):
    files = local_ssh.make_certificates(tmp_path / "tls")
    monkeypatch.setattr(kubernetes, "SCHEDULER_PORT", free_port())
    monkeypatch.setattr(kubernetes, "scheduler_host", lambda _: "127.0.0.1")
    mapping = {
        "kind": "kubernetes", "namespace": "lidar", "image": "sweep", "secret": "sweep-tls",
        "workers": {"least": 1, "most": 2}, "worker": {"memory": "1 GB"},
        "security": {name: str(path) for name, path in files._asdict().items()},
    }  # fmt: skip
    with api_server(tmp_path / "tls") as (port, requests):
        monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, port)))
        outcome = run_serially(small_spec(), tmp_path / "pods.zarr", cluster=mapping)
        assert outcome.complete
        assert file_digests(outcome.store) == file_digests(serial_store)
        changes = [request for request in requests if request[0] != "GET"]
    assert changes == [
        ("POST", CLUSTERS), ("POST", AUTOSCALERS),
        ("DELETE", f"{AUTOSCALERS}/sweep"), ("DELETE", f"{CLUSTERS}/sweep"),
    ]  # fmt: skip


def test_no_kubernetes_is_reported_in_words(tmp_path, monkeypatch):
    monkeypatch.setenv("KUBECONFIG", str(kubeconfig(tmp_path, free_port())))
    cluster = DEPLOY / "kubernetes.yaml"
    with pytest.raises(ClusterError, match="Kubernetes starts no workers"):
        run_serially(small_spec(), tmp_path / "none.zarr", cluster=cluster)
    assert not (tmp_path / "none.zarr").exists()
