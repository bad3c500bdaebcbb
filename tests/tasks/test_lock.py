import json
import multiprocessing
import os
import socket
import subprocess
import sys
import time
from dataclasses import asdict, replace

import pytest
from small import quiet, receipts, small

from sweep.tasks import lock
from sweep.tasks.driver import resume
from sweep.tasks.errors import StoreError
from sweep.tasks.lock import Holder, Lock, holder, is_live
from sweep.tasks.store import JOURNAL


def put(store, who: Holder, *, age: float = 0.0) -> None:
    """A lock of someone else's, its last heartbeat some seconds old."""
    path = store / JOURNAL / lock.LOCK
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(asdict(who)))
    os.utime(path, (time.time() - age, time.time() - age))


def test_a_held_lock_refuses_a_second_driver_and_says_who_holds_it(tmp_path):
    held = Lock(tmp_path)
    with pytest.raises(StoreError, match=f"process {os.getpid()} on {socket.gethostname()}"):
        Lock(tmp_path)
    assert held.is_mine()
    held.release()
    assert holder(tmp_path) is None
    Lock(tmp_path).release()


def test_the_lock_of_a_dead_process_is_taken_over(tmp_path):
    code = (
        "import os, sys; from pathlib import Path; from sweep.tasks.lock import Lock;"
        "Lock(Path(sys.argv[1])); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    dead = holder(tmp_path)
    assert dead is not None and dead.pid != os.getpid()
    assert not is_live(tmp_path, dead)
    mine = Lock(tmp_path)
    assert mine.is_mine()
    mine.release()


def test_a_pid_used_again_by_another_process_does_not_keep_a_lock_alive(tmp_path):
    put(tmp_path, replace(Holder.myself(), started=Holder.myself().started - 3600))
    assert not is_live(tmp_path, holder(tmp_path))
    mine = Lock(tmp_path)
    assert mine.is_mine()
    mine.release()


@pytest.mark.parametrize(("age", "live"), [(0.0, True), (60.0, True), (600.0, False)])
def test_on_another_host_the_heartbeat_decides(tmp_path, age, live):
    put(tmp_path, Holder(host="elsewhere", pid=1, started=1.0, token="t"), age=age)
    if live:
        with pytest.raises(StoreError, match="process 1 on elsewhere"):
            Lock(tmp_path)
    else:
        Lock(tmp_path).release()


def test_a_held_lock_beats(tmp_path, monkeypatch):
    monkeypatch.setattr(lock, "HEARTBEAT", 0.02)
    held = Lock(tmp_path)
    path = tmp_path / JOURNAL / lock.LOCK
    os.utime(path, (0, 0))
    deadline = time.monotonic() + 5
    while path.stat().st_mtime == 0 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert lock.heartbeat_age(tmp_path) < 5
    held.release()


def test_a_lock_taken_by_someone_else_is_not_ours_to_release(tmp_path):
    held = Lock(tmp_path)
    other = Holder(host="elsewhere", pid=1, started=1.0, token="t")
    put(tmp_path, other)
    assert not held.is_mine()
    held.release()
    assert holder(tmp_path) == other


def _try(store, results) -> None:
    try:
        Lock(store)
        results.put(True)
        time.sleep(1.0)  # hold it while the others try
    except StoreError:
        results.put(False)


def test_of_many_that_find_a_stale_lock_one_gets_it(tmp_path):
    put(tmp_path, replace(Holder.myself(), pid=2**22 + 1))
    context = multiprocessing.get_context("fork")
    results = context.SimpleQueue()
    tries = [context.Process(target=_try, args=(tmp_path, results)) for _ in range(6)]
    for process in tries:
        process.start()
    got = [results.get() for _ in tries]
    for process in tries:
        process.join()
    assert got.count(True) == 1


def test_a_driver_whose_lock_was_taken_commits_nothing_more(tmp_path):
    """As one that stood still so long that another host held it for dead."""
    other = Holder(host="elsewhere", pid=1, started=1.0, token="t")

    def evaluate(study, block):
        if block == 4:
            put(study_path, other)
        return study.evaluate(block)

    study_path = tmp_path / "small.zarr"
    outcome = quiet(small(), study_path, scheduler="none", evaluate=evaluate)
    assert outcome.stopped == "another process took the store's lock"
    assert receipts(study_path) == [0, 1, 2, 3]
    assert holder(study_path) == other
    with pytest.raises(StoreError, match="process 1 on elsewhere"):
        resume(study_path, progress=False, scheduler="none")
