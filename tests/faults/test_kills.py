"""Processes killed in the midst of a study, what is said of it, and what resuming makes of it.

`chaos.py` kills clients, workers, nannies and schedulers in more ways.
"""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from small_studies import (
    file_digests,
    logged_blocks,
    make_logging_evaluate,
    receipt_blocks,
    small_spec,
)

from sweep.tasks.driver import resume, run
from sweep.tasks.studies.store_summary import status
from sweep.tasks.studies.store_verification import verify

BLOCKS = 12
SLOW = 0.15

#: A client of its own: runs the small study, slowed down and logged.
CLIENT = """
import sys
from pathlib import Path
from small_studies import make_logging_evaluate, small_spec
from sweep.tasks.driver import run

if __name__ == "__main__":
    store, log, slow = sys.argv[1:]
    evaluate = make_logging_evaluate(Path(log), float(slow))
    outcome = run(small_spec(), store=store, evaluate=evaluate, progress=False, workers=2)
    print(outcome.stop_reason)
"""

ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": os.pathsep.join(
        [str(Path(__file__).parents[1] / "tasks"), os.environ.get("PYTHONPATH", "")]
    ),
    "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "5s",
}


@contextmanager
def process(*command: str):
    """A process of our own in a session of its own, gone at the end."""
    child = subprocess.Popen(
        command,
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        yield child
    finally:
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()
        child.stdout.close()


@contextmanager
def client_process(tmp_path: Path):
    script = tmp_path / "client.py"
    script.write_text(CLIENT)
    paths = [str(tmp_path / name) for name in ("small.zarr", "log")]
    with process(sys.executable, str(script), *paths, str(SLOW)) as child:
        yield child


def wait_for(condition, timeout: float = 120.0) -> None:
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


def finish(tmp_path: Path, serial_digests: dict[str, str]) -> None:
    """Resume, and see that the store is the undisturbed one and committed work was not repeated."""
    store = tmp_path / "small.zarr"
    committed = receipt_blocks(store)
    assert 0 < len(committed) < BLOCKS
    assert not status(store).is_lock_holder_alive
    log = tmp_path / "resumed"
    outcome = resume(store, progress=False, scheduler="none", evaluate=make_logging_evaluate(log))
    assert outcome.complete
    assert sorted(logged_blocks(log)) == sorted(set(range(BLOCKS)) - set(committed))
    assert sorted(receipt_blocks(store)) == list(range(BLOCKS))
    before = Counter(logged_blocks(tmp_path / "log"))
    assert all(before[block] == 1 for block in committed)
    assert file_digests(store) == serial_digests


#: Repairs a store, and dies as the first, second, ... object is about to get its place.
REPAIRS = """
import os, sys
from sweep.tasks.studies.store_verification import verify

store, replace, deaths = sys.argv[1], os.replace, 0

def deadly(draft, name):
    if str(name).startswith(store) and next(left, None) is None:
        os._exit(9)
    replace(draft, name)

for last in range(3):
    if not os.fork():
        left, os.replace = iter(range(last)), deadly
        verify(store, repair=True, progress=False)
    deaths += os.waitstatus_to_exitcode(os.wait()[1]) == 9
print(deaths)
"""


def test_a_repair_killed_at_each_object_is_repeated_to_the_undisturbed_bytes(
    tmp_path, serial_digests
):
    store = tmp_path / "small.zarr"
    run(small_spec(), store=store, scheduler="none", progress=False)
    for name in ("beamlets", "effects", "noise_variance", "pd_up", "snr_up", ""):
        (store / name / "zarr.json").write_bytes(b"damaged")
    with process(sys.executable, "-c", REPAIRS, str(store)) as repairs:
        assert repairs.communicate()[0] == "3\n"
    (report,) = verify(store, repair=True, progress=False)
    assert report.is_undamaged
    assert resume(store, progress=False, scheduler="none").complete
    assert file_digests(store) == serial_digests


@pytest.mark.slow
def test_ctrl_c_reaches_every_process_and_still_commits_what_runs(tmp_path, serial_digests):
    store = tmp_path / "small.zarr"
    with client_process(tmp_path) as client:
        wait_for(lambda: len(receipt_blocks(store)) >= 2)
        os.killpg(client.pid, signal.SIGINT)
        output, _ = client.communicate(timeout=120)
        assert output.strip().splitlines()[-1] == "interrupted"
        assert "/sweep/" not in output  # no traceback of ours
    assert set(logged_blocks(tmp_path / "log")) == set(receipt_blocks(store))
    finish(tmp_path, serial_digests)
