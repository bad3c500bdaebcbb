"""Workers over SSH: a server of our own on loopback, with keys of its own."""

import asyncio
import os
import shlex
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import asyncssh
import pytest
from small_studies import file_digests, run_serially, small_spec

from sweep.spec import cluster_config_from_mapping
from sweep.tasks.engine.deploy import local_ssh
from sweep.tasks.engine.progress import ClusterError

SSH = {
    "kind": "ssh",
    "hosts": ["127.0.0.1"],
    "workers": 2,
    "worker": {"memory": "1 GB"},
    "scheduler": {"host": "127.0.0.1", "dashboard": "127.0.0.1:0"},
}


def test_workers_are_dealt_out_evenly():
    hosts = ["a", "b", "c", "d"]
    cluster = cluster_config_from_mapping({**SSH, "hosts": hosts, "workers": 10})
    shares = {
        host: options["options"]["kwargs"]["n_workers"]
        for host, options in local_ssh.ssh_worker_specs(cluster, 10).items()
    }
    assert shares == {"a": 3, "b": 3, "c": 2, "d": 2}
    assert list(local_ssh.ssh_worker_specs(cluster, 2)) == ["a", "b"]


def test_workers_have_the_threads_of_the_file():
    cluster = cluster_config_from_mapping({**SSH, "worker": {"memory": "1 GB", "threads": 3}})
    assert local_ssh.ssh_nanny_options(cluster)["nthreads"] == 3


@contextmanager
def server(directory: Path):
    """An SSH server that runs commands here: its port, and what was asked of it."""
    keys = {name: asyncssh.generate_private_key("ssh-ed25519") for name in ("host", "user")}
    for name, key in keys.items():
        key.write_private_key(directory / name)
        key.write_public_key(directory / f"{name}.pub")
    commands: list[str] = []
    children: list[subprocess.Popen] = []

    async def serve(process) -> None:
        commands.append(process.command)
        child = subprocess.Popen(
            process.command, shell=True, start_new_session=True, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        children.append(child)
        await process.redirect(stdout=child.stdout, stderr=child.stderr)
        process.exit(await asyncio.to_thread(child.wait))

    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()

    async def listen():
        return await asyncssh.listen(
            "127.0.0.1", 0, server_host_keys=[str(directory / "host")],
            authorized_client_keys=str(directory / "user.pub"), process_factory=serve,
        )  # fmt: skip

    async def end() -> None:
        listener.close()
        if rest := asyncio.all_tasks() - {asyncio.current_task()}:
            await asyncio.wait(rest, timeout=5)

    listener = asyncio.run_coroutine_threadsafe(listen(), loop).result(30)
    port = listener.get_port()
    host_key = (directory / "host.pub").read_text()
    (directory / "known").write_text(f"[127.0.0.1]:{port} {host_key}")
    try:
        yield port, commands
    finally:
        for child in children:
            if child.poll() is None:
                os.killpg(child.pid, 9)
            child.wait()
        asyncio.run_coroutine_threadsafe(end(), loop).result(30)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


def test_a_study_over_ssh_with_tls(tmp_path, serial_store):
    files = local_ssh.make_certificates(tmp_path / "tls")
    with server(tmp_path) as (port, commands):
        cluster = {
            **SSH, "port": port, "user": "lidar", "identity": str(tmp_path / "user"),
            "known_hosts": str(tmp_path / "known"), "python": sys.executable,
            "security": {name: str(path) for name, path in files._asdict().items()},
            "environment": {"MARK": "a value"},
        }  # fmt: skip
        outcome = run_serially(small_spec(), tmp_path / "ssh.zarr", cluster=cluster)
        assert outcome.complete
        assert file_digests(outcome.store) == file_digests(serial_store)
        (started,) = [words for words in map(shlex.split, commands) if len(words) > 1]
        assert sys.executable in started
        assert any(word.startswith("tls://127.0.0.1:") for word in started)

        unknown = {**cluster, "known_hosts": str(tmp_path / "user.pub")}
        with pytest.raises(ClusterError, match="no workers could be started"):
            run_serially(small_spec(), tmp_path / "unknown.zarr", cluster=unknown)
