import os
import socket
import subprocess
import sys
import time
import urllib.request
from datetime import timedelta

import pytest
from faulty_server import FaultyServer
from six_block_study import six_block_spec
from small_studies import run_serially

from sweep.storage import locations

BUCKET = "bucket"
SHORT_BACKOFF = {
    "init_backoff": timedelta(milliseconds=5),
    "max_backoff": timedelta(milliseconds=50),
    "base": 2,
}


@pytest.fixture(scope="session")
def serial_store(tmp_path_factory):
    """The store of the small study on disk, run as a plain loop."""
    outcome = run_serially(six_block_spec(), tmp_path_factory.mktemp("undisturbed") / "small.zarr")
    assert outcome.complete
    return outcome.store


@pytest.fixture(scope="session")
def server():
    """Port of an S3 server on loopback, with a bucket."""
    pytest.importorskip("moto.server", reason="moto is not installed")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while True:
            try:
                request = urllib.request.Request(f"http://127.0.0.1:{port}/{BUCKET}", method="PUT")
                urllib.request.urlopen(request, timeout=5).close()
                break
            except OSError:
                assert time.monotonic() < deadline and child.poll() is None, "no S3 server"
                time.sleep(0.1)
        yield port
    finally:
        child.kill()
        child.wait()


@pytest.fixture
def faults(server, monkeypatch):
    """A server in front of it that can fail, which the environment names as the endpoint."""
    with FaultyServer(server) as faulty:
        for name in [name for name in os.environ if name.startswith("AWS_")]:
            monkeypatch.delenv(name)
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{faulty.port}")
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", "key")
        monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
        monkeypatch.setenv("AWS_REGION", "us-east-1")
        for name in ("RETRY_CONFIG", "FIRST_CONTACT_RETRY_CONFIG"):  # without the long waits
            monkeypatch.setattr(
                locations, name, {**getattr(locations, name), "backoff": SHORT_BACKOFF}
            )
        locations._client_by_bucket_url.clear()
        yield faulty
        locations._client_by_bucket_url.clear()


@pytest.fixture
def place(faults, request):
    """A place for a store, on the server, that nobody else uses."""
    return f"s3://{BUCKET}/{request.node.name.partition('[')[0]}/{time.time_ns()}/small.zarr"


@pytest.fixture
def memory():
    """A place for a store, in an object store in memory, that nobody else uses."""
    return f"memory://bucket/{time.time_ns()}/small.zarr"
