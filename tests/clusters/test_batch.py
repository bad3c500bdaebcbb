"""Batch systems without one: what is submitted, and a PBS played by two scripts."""

import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path

import pytest
from small_studies import file_digests, receipt_blocks, run_serially, small_spec

from sweep.spec import cluster_config_from_mapping
from sweep.tasks.engine.deploy import jobqueue

BATCH = {
    "workers": {"least": 3, "most": 40},
    "worker": {"memory": "4 GB", "threads": 2},
    "job": {
        "workers": 8,
        "walltime": "2 h",
        "queue": "normal",
        "account": "lidar",
        "directives": ["--exclusive"],
        "prologue": ["module load python/3.12"],
    },
    "scheduler": {"host": "127.0.0.1", "dashboard": "127.0.0.1:0"},
    "environment": {"SCENES": "/data/my scenes"},
    "python": "/opt/sweep/bin/python",
}


def described(kind, **changes):
    return cluster_config_from_mapping({"kind": kind, **BATCH, **changes})


def script_of(cluster) -> list[str]:
    job = {"slurm": jobqueue.SLURMJob, "pbs": jobqueue.PBSJob}[cluster.kind]
    options = jobqueue.jobqueue_options(cluster)
    for name in ("n_workers", "scheduler_options"):
        options.pop(name)
    return job("tls://10.0.0.5:8786", name="sweep-1", **options).job_script().splitlines()


@pytest.fixture
def working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_slurm_gets_the_options_of_the_file(working_directory):
    lines = script_of(described("slurm"))
    for line in (
        "#SBATCH -p normal", "#SBATCH -A lidar", "#SBATCH -n 1", "#SBATCH --cpus-per-task=16",
        "#SBATCH --mem=30G", "#SBATCH -t 02:00:00", "#SBATCH --exclusive",
        "module load python/3.12", "export OMP_NUM_THREADS=1",
        "export SCENES='/data/my scenes'",
    ):  # fmt: skip
        assert line in lines, line


def test_pbs_gets_the_options_of_the_file(working_directory):
    lines = script_of(described("pbs"))
    for line in (
        "#PBS -q normal", "#PBS -A lidar", "#PBS -l select=1:ncpus=16:mem=30GB",
        "#PBS -l walltime=02:00:00", "#PBS --exclusive", "module load python/3.12",
    ):  # fmt: skip
        assert line in lines, line


@pytest.mark.parametrize("kind", ["slurm", "pbs"])
def test_a_jobs_workers_are_those_of_the_file(working_directory, kind):
    words = shlex.split(script_of(described(kind))[-1])
    assert words[0] == "/opt/sweep/bin/python"
    assert "tls://10.0.0.5:8786" in words
    options = {a: b for a, b in pairwise(words) if a.startswith("--")}
    assert (options["--nthreads"], options["--nworkers"]) == ("2", "8")
    assert options["--preload"] == "sweep.tasks.preload"
    assert options["--lifetime"] == "6660s"
    assert options["--lifetime-stagger"] == "180s"
    assert "--no-dashboard" in words


@pytest.mark.parametrize("walltime", [60.0, 600.0, 3600.0, 7200.0, 86400.0, 14 * 86400.0])
def test_workers_leave_before_their_job_ends_and_not_all_at_once(walltime):
    lifetime, stagger = jobqueue.worker_lifetime(walltime)
    last, first = lifetime + stagger, lifetime - stagger
    assert walltime - last >= min(60.0, walltime / 4) - 1e-9
    assert 0.4 * walltime < first < last < walltime
    assert last - first >= min(15.0, 0.05 * walltime)


@pytest.mark.parametrize(
    ("seconds", "text"), [(60, "00:01:00"), (7265.4, "02:01:05"), (360000, "100:00:00")]
)
def test_times_are_written_as_batch_systems_read_them(seconds, text):
    assert jobqueue.walltime_text(seconds) == text


@pytest.mark.parametrize(("workers", "jobs"), [(1, 1), (8, 1), (9, 2), (40, 5)])
def test_workers_come_in_whole_jobs(workers, jobs):
    assert jobqueue.jobs_needed(described("pbs"), workers) == jobs


#: Takes a job, as PBS does, and runs it here; once it has run one it refuses the next.
QSUB = """\
#!/bin/sh
cd "{directory}"
count=$(($(cat count 2>/dev/null || echo 0) + 1))
echo $count > count
if [ $count -eq 2 ]; then echo "qsub: the server is busy" >&2; exit 1; fi
cp "$1" job-$count.sh
setsid sh job-$count.sh > job-$count.out 2>&1 < /dev/null &
echo $! > job-$count.pid
echo $count.server
"""
QDEL = """\
#!/bin/sh
job=${{1%%.*}}
echo $job >> "{directory}/deleted"
kill -s KILL -- -$(cat "{directory}/job-$job.pid") 2>/dev/null
exit 0
"""


@pytest.fixture
def played_pbs(working_directory, monkeypatch):
    """A PBS of two scripts, its jobs processes of this machine, none left at the end."""
    programs = working_directory / "bin"
    programs.mkdir()
    for name, text in (("qsub", QSUB), ("qdel", QDEL)):
        (programs / name).write_text(text.format(directory=working_directory))
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    monkeypatch.setattr(jobqueue, "RESUBMIT_PAUSE_SECONDS", 0.2)
    yield working_directory
    for pid in working_directory.glob("job-*.pid"):
        subprocess.run([programs / "qdel", pid.stem.removeprefix("job-")], check=True)


def test_a_job_lost_and_one_refused_are_made_up_for(played_pbs, serial_store):
    from dask import config

    def evaluate(study, block):
        time.sleep(0.2)
        return study.evaluate(block)

    def kill_the_first() -> None:
        deadline = time.monotonic() + 100
        while not receipt_blocks(played_pbs / "played.zarr"):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        subprocess.run(["qdel", "1.server"], check=True)

    killer = threading.Thread(target=kill_the_first)
    one = {"walltime": "10 min", "logs": str(played_pbs)}
    cluster = {
        "kind": "pbs", "workers": 1, "worker": {"memory": "1 GB"}, "job": one,
        "scheduler": BATCH["scheduler"],
    }  # fmt: skip
    killer.start()
    with config.set({"distributed.deploy.lost-worker-timeout": "200ms"}):
        outcome = run_serially(
            small_spec(), Path("played.zarr"), cluster=cluster, evaluate=evaluate
        )
    killer.join()
    assert outcome.complete
    assert file_digests(outcome.store) == file_digests(serial_store)
    assert int((played_pbs / "count").read_text()) >= 3  # the first, the refused, another
    assert (played_pbs / "deleted").read_text().split()[-1] == "3"  # none is left in the queue


def test_ctrl_c_stays_what_it_is_where_batch_systems_are_used():
    code = (
        "import signal, sweep.tasks.engine.deploy.jobqueue; print(signal.getsignal(signal.SIGINT))"
    )
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert process.stdout.strip() == str(signal.default_int_handler)


def test_a_batch_system_is_used_from_any_thread(tmp_path):
    """Signals are the main thread's, and dask_jobqueue sets one as it is imported."""
    code = f"""
import sys
from concurrent.futures import ThreadPoolExecutor
sys.path.insert(0, {str(Path(__file__).parents[1] / "tasks")!r})
from small_studies import small_spec
import sweep
from sweep.tasks.engine.progress import ClusterError

cluster = {{"kind": "slurm", "worker": {{"memory": "1 GB"}}, "job": {{"walltime": "10 min"}},
           "scheduler": {{"host": "127.0.0.1", "dashboard": "127.0.0.1:0"}}, "workers": 1}}
with ThreadPoolExecutor(1) as pool:
    asked = pool.submit(sweep.run, small_spec(), store="s.zarr", cluster=cluster, progress=False)
    try:
        asked.result()
    except ClusterError as error:
        print(error)
"""
    process = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path,
        env=os.environ | {"PATH": "/nowhere"},
    )  # fmt: skip
    assert "no workers could be started" in process.stdout and "sbatch" in process.stdout
    assert "signal" not in process.stdout
