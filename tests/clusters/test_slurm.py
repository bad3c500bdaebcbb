"""Studies on SLURM itself: the same bytes as in a plain loop, also of killed jobs and drivers."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress

import pytest
import yaml
from slurm_daemons import reason_slurm_is_missing, run_command, run_slurm_daemons, running_job_ids
from small_studies import STUDY_MAPPING, file_digests, receipt_blocks, small_mapping

from sweep.storage.store_format import read_receipt_totals
from sweep.tasks.driver import run

pytestmark = pytest.mark.skipif(bool(reason_slurm_is_missing()), reason=reason_slurm_is_missing())

#: Blocks of a second (nearer, where more bins count, of minutes): time enough for
#: another job in the place of a killed one.
SLOW = {
    **STUDY_MAPPING,
    "footprint": {"beamlets": 109, "speckle": "none"},
    "draws": {"number": 120_000, "method": "noise", "batch": 1000},
    "axes": {"target.range": {"linear": ["2 km", "5 km"], "number": 20}},
    "storage": {"block_points": 1},
}
BLOCKS = 20
WAIT = 120.0


@pytest.fixture(scope="module")
def environment():
    with run_slurm_daemons() as environment:
        yield environment | {"DASK_DISTRIBUTED__DEPLOY__LOST_WORKER_TIMEOUT": "1s"}


@pytest.fixture
def working_directory(tmp_path, monkeypatch):
    """A directory with a study and a cluster of two jobs."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "slow.yaml").write_text(yaml.safe_dump(SLOW))
    cluster = {
        "kind": "slurm",
        "workers": 2,
        "worker": {"memory": "1 GB"},
        "job": {"walltime": "10 min", "directives": ["--no-requeue"]},
        "scheduler": {"host": "127.0.0.1", "dashboard": "127.0.0.1:0"},
    }
    (tmp_path / "slurm.yaml").write_text(yaml.safe_dump(cluster))
    return tmp_path


@contextmanager
def sweep(environment, *words: str):
    """The command in a process of its own, gone at the end."""
    child = subprocess.Popen(
        [sys.executable, "-c", "from sweep.cli import main; main()", *words],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        yield child
    finally:
        with suppress(ProcessLookupError):
            child.kill()
        child.communicate()


def wait_for(condition, child) -> None:
    deadline = time.monotonic() + WAIT
    while not condition():
        assert child.poll() is None, child.stdout.read()
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)


def workers(store) -> set[bytes]:
    """Processes that committed blocks."""
    return read_receipt_totals(store, BLOCKS, since=0.0).recent_workers


def test_a_study_in_a_job_ends_as_in_a_plain_loop(working_directory, environment, serial_store):
    (working_directory / "small.yaml").write_text(yaml.safe_dump(small_mapping(), sort_keys=False))
    cluster = yaml.safe_load((working_directory / "slurm.yaml").read_text())
    (working_directory / "slurm.yaml").write_text(yaml.safe_dump(cluster | {"workers": 1}))
    options = ("--store", "small.zarr", "--cluster", "slurm.yaml")
    with sweep(environment, "run", "small.yaml", *options) as child:
        output, _ = child.communicate(timeout=WAIT)
    assert child.returncode == 0, output
    assert file_digests(working_directory / "small.zarr") == file_digests(serial_store)
    assert running_job_ids(environment) == []


@pytest.mark.slow
def test_jobs_and_driver_killed_the_study_ends_as_in_a_plain_loop(working_directory, environment):
    store = working_directory / "slow.zarr"
    options = ("--store", "slow.zarr", "--cluster", "slurm.yaml")
    with sweep(environment, "run", "slow.yaml", *options) as child:
        # Both jobs work, so that the one that is killed takes a worker that the cluster knows.
        wait_for(lambda: len(workers(store)) == 2 and len(receipt_blocks(store)) >= 5, child)
        before = running_job_ids(environment)
        run_command(environment, "scancel", "-s", "KILL", before[0])
        wait_for(
            lambda: set(running_job_ids(environment)) - set(before), child
        )  # another in its place
        os.kill(child.pid, signal.SIGKILL)
    committed = receipt_blocks(store)
    assert 5 <= len(committed) < BLOCKS
    with sweep(environment, "resume", "slow.zarr", "--cluster", "slurm.yaml") as child:
        output, _ = child.communicate(timeout=WAIT)
        assert child.returncode == 0, output
    assert f"computed {BLOCKS - len(committed)} of {BLOCKS} blocks" in output
    assert sorted(receipt_blocks(store)) == list(range(BLOCKS))
    from sweep.spec import load

    outcome = run(load("slow.yaml"), store="plain.zarr", scheduler="none", progress=False)
    assert outcome.complete
    assert file_digests(store) == file_digests(working_directory / "plain.zarr")


@pytest.mark.slow
def test_jobs_that_the_batch_system_refuses_are_reported_at_once(working_directory, environment):
    cluster = yaml.safe_load((working_directory / "slurm.yaml").read_text())
    cluster["job"]["queue"] = "absent"
    (working_directory / "slurm.yaml").write_text(yaml.safe_dump(cluster))
    with sweep(environment, "run", "slow.yaml", "--cluster", "slurm.yaml") as child:
        output, _ = child.communicate(timeout=WAIT)
    assert child.returncode == 2
    assert "no workers could be started" in output
    assert "invalid partition" in output
    assert "Traceback" not in output
    assert not (working_directory / "results" / "slow.zarr").exists()
