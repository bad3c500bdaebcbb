"""Workers of this machine: how they start, what ends them, and that they are started again."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import dask
import psutil
import pytest
from small_studies import file_digests, receipt_blocks, small_spec

from sweep.tasks.driver import run
from sweep.tasks.engine import dispatcher, session
from sweep.tasks.engine.deploy import local_ssh
from sweep.tasks.engine.progress import Progress

SCRIPT = """
import sys
import sweep
from small_studies import small_spec

def evaluate(study, block):
    return study.evaluate(block)

spec = small_spec()
outcome = sweep.run(spec, store=sys.argv[1], workers=1, evaluate=evaluate, progress=False)
print(outcome.complete)
"""


@pytest.mark.slow
def test_a_script_without_a_guard_runs_and_workers_import_nothing_from_where_it_is_run(
    serial_store, tmp_path
):
    folder = tmp_path / "downloads"
    folder.mkdir()
    (folder / "socket.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w').close()\n")
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    path = os.pathsep.join(
        map(str, [Path(__file__).parents[1] / "tasks", Path(__file__).parents[2]])
    )
    ended = subprocess.run(
        [sys.executable, str(script), str(tmp_path / "s.zarr")], cwd=folder, timeout=300,
        env={**os.environ, "PYTHONPATH": str(path)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ended.stdout == "True\n" and ended.returncode == 0, ended.stderr
    assert file_digests(tmp_path / "s.zarr") == file_digests(serial_store)
    assert not (tmp_path / "imported").exists()


@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_a_frozen_worker_holds_up_neither_a_run_nor_its_end(
    serial_store, tmp_path, monkeypatch, workers
):
    monkeypatch.setattr(local_ssh, "WORKER_TTL", "1 s")  # ten heartbeats at least
    monkeypatch.setattr(dispatcher, "WORKER_SILENCE_SECONDS", 1.0)
    pid = tmp_path / "pid"

    def evaluate(study, block):
        if block == 3 and not pid.exists():
            pid.write_text(str(os.getpid()))
            os.kill(os.getpid(), signal.SIGSTOP)
        return study.evaluate(block)

    outcome = run(
        small_spec(), store=tmp_path / "s.zarr", workers=workers, evaluate=evaluate, progress=False
    )
    assert outcome.complete and file_digests(outcome.store) == file_digests(serial_store)
    assert sorted(receipt_blocks(outcome.store)) == list(range(12))
    assert not psutil.pid_exists(int(pid.read_text()))


class EndingProgress(Progress):
    """Progress that has all workers end as the first points arrive, and gives up in the end."""

    def __init__(self, workers) -> None:
        self._workers, self.lines = workers, []

    def advance(self, *, points, failed):
        while points and self._workers:
            started = self._workers.pop()
            for worker in list(started.workers.values()):
                started.sync(worker.close)

    def say(self, text):
        self.lines.append(text)
        if len(self.lines) == 8:
            os.kill(os.getpid(), signal.SIGINT)


def test_workers_are_started_again_where_none_is_left(serial_store, tmp_path, monkeypatch):
    monkeypatch.setattr(session, "NO_WORKER_WARNING_SECONDS", 1.0)
    monkeypatch.setattr(dispatcher, "WORKER_THREADS_REFRESH_SECONDS", 0.1)
    clusters, start = [], local_ssh.start_local_cluster

    def started(*keywords, **options):
        clusters.append(start(*keywords, **options))
        return clusters[-1]

    def evaluate(study, block):
        time.sleep(0.05)  # so that some are left
        return study.evaluate(block)

    monkeypatch.setattr(local_ssh, "start_local_cluster", started)
    progress = EndingProgress(clusters)
    with dask.config.set({"distributed.deploy.lost-worker-timeout": "100ms"}):
        outcome = run(
            small_spec(), store=tmp_path / "s.zarr", workers=2, processes=False, progress=progress,
            evaluate=evaluate,
        )  # fmt: skip
    assert any(line.startswith("no worker is left (") for line in progress.lines)
    assert outcome.complete and file_digests(outcome.store) == file_digests(serial_store)
