import errno
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

from sweep.storage.locations import JOURNAL, located
from sweep.tasks import journal
from sweep.tasks.driver import resume
from sweep.tasks.journal import Holder, Lock, holder, is_live
from sweep.tasks.progress import StoreError


def put(store, who: Holder, *, age: float = 0.0) -> None:
    """A lock of someone else's, its last heartbeat some seconds old."""
    path = store / JOURNAL / journal.LOCK
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
        "import os, sys; from pathlib import Path; from sweep.tasks.journal import Lock;"
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
    monkeypatch.setattr(journal, "HEARTBEAT", 0.02)
    held = Lock(tmp_path)
    path = tmp_path / JOURNAL / journal.LOCK
    os.utime(path, (0, 0))
    deadline = time.monotonic() + 5
    while path.stat().st_mtime == 0 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert journal.heartbeat_age(tmp_path) < 5
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


@pytest.mark.parametrize("kind", ["file", "object"])
def test_a_lock_beats_from_the_first_on_and_not_once_it_is_left(kind, tmp_path):
    store = tmp_path if kind == "file" else located(f"memory://bucket/{time.time_ns()}/s.zarr")
    assert holder(store) is None and journal.heartbeat_age(store) == float("inf")
    held = Lock(store)
    assert held.is_mine() and journal.heartbeat_age(store) < 60
    held.release()
    assert holder(store) is None


def test_a_lock_on_a_read_only_disk_has_an_age(tmp_path, monkeypatch):
    held = Lock(tmp_path)

    def refuse(*_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    with monkeypatch.context() as patched:
        patched.setattr("pathlib.Path.write_bytes", refuse)
        assert journal.heartbeat_age(tmp_path) < 60
    held.release()


def test_no_two_heartbeats_of_an_object_are_alike():
    """Its tag may be a digest: one who saw it before a beat must not replace it after."""
    store = located(f"memory://bucket/{time.time_ns()}/s.zarr")
    held, states = Lock(store), []
    for _ in range(3):
        states.append((store / JOURNAL / journal.LOCK).read_bytes())
        held._claim.beat()
        assert held.is_mine()
    held.release()
    assert len(set(states)) == 3
