import errno
import fcntl
import json
import logging
import multiprocessing
import os
import re
import socket
import subprocess
import sys
import threading
import time
from dataclasses import asdict, replace
from pathlib import Path

import psutil
import pytest
from click.testing import CliRunner
from small_studies import STUDY_MAPPING, RecordingProgress, receipt_blocks, run_serially, small_spec

from sweep.cli import main
from sweep.storage import locations
from sweep.storage.locations import JOURNAL_DIR, parse_location, process_start_id
from sweep.tasks.driver import resume, run
from sweep.tasks.engine import journal
from sweep.tasks.engine.journal import LockHolder, StoreLock, is_holder_alive, read_lock_holder
from sweep.tasks.engine.progress import StoreBusyError, StoreError
from sweep.tasks.studies.store_verification import pack_store


def put(store, who: LockHolder, *, age: float = 0.0) -> None:
    """A lock of someone else's, its last heartbeat some seconds old."""
    path = store / JOURNAL_DIR / journal.LOCK_FILE
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(asdict(who)))
    os.utime(path, (time.time() - age, time.time() - age))


def test_a_held_lock_refuses_a_second_driver_and_says_who_holds_it(tmp_path):
    held = StoreLock(tmp_path)
    with pytest.raises(StoreError, match=f"process {os.getpid()} on {socket.gethostname()}"):
        StoreLock(tmp_path)
    assert held.is_held_by_this_process()
    held.release()
    assert read_lock_holder(tmp_path) is None
    StoreLock(tmp_path).release()


def test_the_lock_of_a_dead_process_is_taken_over(tmp_path, caplog):
    caplog.set_level(logging.DEBUG, logger="sweep.journal")
    code = (
        "import os, sys; from pathlib import Path;"
        "from sweep.tasks.engine.journal import StoreLock;"
        "StoreLock(Path(sys.argv[1])); os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    dead = read_lock_holder(tmp_path)
    assert dead is not None and dead.pid != os.getpid()
    assert not is_holder_alive(tmp_path, dead)
    lock = StoreLock(tmp_path)
    assert lock.is_held_by_this_process()
    lock.release()
    waited, taken_over, locked, released = (record.getMessage() for record in caplog.records)
    lock_path = tmp_path / JOURNAL_DIR / journal.LOCK_FILE
    assert waited == f"waiting until no other process acquires {lock_path}"
    assert taken_over.startswith(f"{lock_path}: taking over from ")
    assert f'"pid": {dead.pid}' in taken_over
    assert locked == f"{tmp_path}: locked by this process, {os.getpid()}"
    assert released == f"{tmp_path}: lock released"


def test_a_pid_used_again_by_another_process_does_not_keep_a_lock_alive(tmp_path):
    put(
        tmp_path,
        replace(LockHolder.of_this_process(), start=LockHolder.of_this_process().start - 3600),
    )
    assert not is_holder_alive(tmp_path, read_lock_holder(tmp_path))
    lock = StoreLock(tmp_path)
    assert lock.is_held_by_this_process()
    lock.release()


@pytest.mark.parametrize("pid", [-1, 0, 2**31, 10**30])
def test_a_lock_of_a_number_that_no_process_can_have_is_taken_over(tmp_path, pid):
    put(tmp_path, replace(LockHolder.of_this_process(), pid=pid))
    assert not is_holder_alive(tmp_path, read_lock_holder(tmp_path))
    StoreLock(tmp_path).release()


@pytest.mark.parametrize(("age", "live"), [(0.0, True), (60.0, True), (600.0, False)])
def test_on_another_host_the_heartbeat_decides(tmp_path, monkeypatch, age, live):
    monkeypatch.setattr(journal, "HEARTBEAT_WATCH_SECONDS", 0.1)
    put(tmp_path, LockHolder(host="elsewhere", pid=1, start=1, token="t"), age=age)
    if live:
        with pytest.raises(StoreError, match="process 1 on elsewhere"):
            StoreLock(tmp_path)
    else:
        StoreLock(tmp_path).release()


def test_a_held_lock_beats(tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "HEARTBEAT_INTERVAL_SECONDS", 0.02)
    held = StoreLock(tmp_path)
    path = tmp_path / JOURNAL_DIR / journal.LOCK_FILE
    os.utime(path, (0, 0))
    deadline = time.monotonic() + 5
    while path.stat().st_mtime == 0 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert journal.heartbeat_age(tmp_path) < 5
    held.release()


def test_a_lock_taken_by_someone_else_is_not_ours_to_release(tmp_path):
    held = StoreLock(tmp_path)
    other = LockHolder(host="elsewhere", pid=1, start=1, token="t")
    put(tmp_path, other)
    assert not held.is_held_by_this_process()
    held.release()
    assert read_lock_holder(tmp_path) == other


def _try(store, results, over) -> None:
    try:
        StoreLock(store)
        results.put(True)
        over.wait(60)  # hold it while the others try
    except StoreError:
        results.put(False)


def test_of_many_that_find_a_stale_lock_one_gets_it(tmp_path):
    put(tmp_path, replace(LockHolder.of_this_process(), pid=2**22 + 1))
    context = multiprocessing.get_context("fork")
    results, over = context.SimpleQueue(), context.Event()
    tries = [context.Process(target=_try, args=(tmp_path, results, over)) for _ in range(6)]
    for process in tries:
        process.start()
    outcomes = [results.get() for _ in tries]
    over.set()
    for process in tries:
        process.join()
    assert outcomes.count(True) == 1


def test_a_driver_whose_lock_was_taken_commits_nothing_more(tmp_path):
    """As one that stood still so long that another host held it for dead."""
    other = LockHolder(host="elsewhere", pid=1, start=1, token="t")

    def evaluate(study, block):
        if block == 4:
            put(study_path, other)
        return study.evaluate(block)

    study_path = tmp_path / "small.zarr"
    outcome = run_serially(small_spec(), study_path, scheduler="none", evaluate=evaluate)
    assert outcome.stop_reason == "another process took the store's lock"
    assert receipt_blocks(study_path) == [0, 1, 2, 3]
    assert read_lock_holder(study_path) == other
    with pytest.raises(StoreError, match="process 1 on elsewhere"):
        resume(study_path, progress=False, scheduler="none")


@pytest.mark.parametrize("kind", ["file", "object"])
def test_a_lock_beats_from_the_first_on_and_not_once_it_is_left(kind, tmp_path):
    store = (
        tmp_path if kind == "file" else parse_location(f"memory://bucket/{time.time_ns()}/s.zarr")
    )
    assert read_lock_holder(store) is None and journal.heartbeat_age(store) == float("inf")
    held = StoreLock(store)
    assert held.is_held_by_this_process() and journal.heartbeat_age(store) < 60
    held.release()
    assert read_lock_holder(store) is None


def test_a_lock_on_a_read_only_disk_has_an_age(tmp_path, monkeypatch):
    held = StoreLock(tmp_path)

    def refuse(*_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    with monkeypatch.context() as patched:
        patched.setattr("pathlib.Path.write_bytes", refuse)
        assert journal.heartbeat_age(tmp_path) < 60
    held.release()


def test_no_two_heartbeats_of_an_object_are_alike():
    """Its tag may be a digest: one who saw it before a beat must not replace it after."""
    store = parse_location(f"memory://bucket/{time.time_ns()}/s.zarr")
    held, states = StoreLock(store), []
    for _ in range(3):
        states.append((store / JOURNAL_DIR / journal.LOCK_FILE).read_bytes())
        held._lock.send_heartbeat()
        assert held.is_held_by_this_process()
    held.release()
    assert len(set(states)) == 3


# Clocks that are set, and file systems that have no locks or links


class Clock:
    """A wall clock that a test sets."""

    def __init__(self):
        self.ahead = 0.0
        self._time = time.time

    def time(self):
        return self._time() + self.ahead


@pytest.fixture
def holding(tmp_path):
    """A store that another living process of this machine has locked."""
    code = (
        "import sys; from pathlib import Path; from sweep.tasks.engine.journal import StoreLock;"
        "held = StoreLock(Path(sys.argv[1])); print('held', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout.readline() == "held\n"
        yield tmp_path, process
        process.stdin.close()


@pytest.mark.parametrize("step", [5.0, -5.0, 3600.0, -3600.0, 1e9])
def test_a_clock_that_is_set_takes_no_lock_from_a_living_process(holding, monkeypatch, step):
    """As ntpd does: psutil's start of a process moves with the clock, its ticks do not."""
    store, process = holding
    boot_time = psutil.boot_time()
    monkeypatch.setattr(psutil, "boot_time", lambda: boot_time + step)
    monkeypatch.setattr("psutil._pslinux.boot_time", lambda: boot_time + step)
    clock = Clock()
    clock.ahead = step
    monkeypatch.setattr(time, "time", clock.time)
    os.utime(store / JOURNAL_DIR / journal.LOCK_FILE, (1e9, 1e9))
    assert is_holder_alive(store, read_lock_holder(store))
    with pytest.raises(StoreBusyError, match=f"process {process.pid} on"):
        StoreLock(store)


def test_a_dead_process_that_nobody_has_waited_for_holds_no_lock(tmp_path):
    code = (
        "import os, sys; from pathlib import Path;"
        "from sweep.tasks.engine.journal import StoreLock;"
        "StoreLock(Path(sys.argv[1])); os.kill(os.getpid(), 9)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path)]) as process:
        deadline = time.monotonic() + 60
        while process_start_id(process.pid) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert psutil.pid_exists(process.pid)
        StoreLock(tmp_path).release()


def lock_of_other_host(store, *, age):
    """The lock of a process of another host, with a heartbeat of that age by the file's clock."""
    put(store, LockHolder(host="elsewhere", pid=1, start=1, token="t"), age=age)


@pytest.mark.parametrize("age", [600.0, 1e9, -600.0])
@pytest.mark.parametrize("kind", ["beating", "silent"])
def test_a_heartbeat_that_is_seen_to_change_is_alive_whatever_its_clock_says(
    tmp_path, monkeypatch, kind, age
):
    """The clock of the file server may have been set: an age that it gives proves nothing."""
    monkeypatch.setattr(journal, "HEARTBEAT_WATCH_SECONDS", 1.0)
    lock_of_other_host(tmp_path, age=age)
    stop = threading.Event()

    def beat():
        path, at = tmp_path / JOURNAL_DIR / journal.LOCK_FILE, time.time() - age
        while not stop.wait(0.2):
            at += 0.2
            os.utime(path, (at, at))

    beating = threading.Thread(target=beat)
    messages = []
    if kind == "beating":
        beating.start()
    try:
        if kind == "beating":
            with pytest.raises(StoreBusyError, match="process 1 on elsewhere"):
                StoreLock(tmp_path, messages.append)
        else:
            StoreLock(tmp_path, messages.append).release()
    finally:
        stop.set()
        if kind == "beating":
            beating.join()
    assert messages and "waiting up to 1 s to see whether process 1 on elsewhere" in messages[0]


def test_an_object_whose_heartbeats_are_counted_is_alive(monkeypatch):
    monkeypatch.setattr(journal, "HEARTBEAT_WATCH_SECONDS", 1.0)
    monkeypatch.setattr(journal, "HEARTBEAT_INTERVAL_SECONDS", 0.1)
    monkeypatch.setattr(journal, "heartbeat_age", lambda path: 1e6)
    monkeypatch.setattr(LockHolder, "is_on_this_machine", False)
    store = parse_location(f"memory://bucket/{time.time_ns()}/s.zarr")
    held = StoreLock(store)
    with pytest.raises(StoreBusyError):
        StoreLock(store, lambda text: None)
    held._is_released.set()  # it stands still
    held._heartbeat_thread.join()
    StoreLock(store, lambda text: None).release()


def test_a_lock_that_changes_hands_while_it_is_watched_is_not_taken(tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "HEARTBEAT_WATCH_SECONDS", 0.5)
    lock_of_other_host(tmp_path, age=600.0)
    mark = journal._FileLock.heartbeat_version

    def overtaken(self):
        marked = mark(self)
        put(tmp_path, LockHolder(host="third", pid=3, start=1, token="u"), age=600.0)
        return marked

    monkeypatch.setattr(journal._FileLock, "heartbeat_version", overtaken)
    with pytest.raises(StoreBusyError):
        StoreLock(tmp_path, lambda text: None)
    assert read_lock_holder(tmp_path).host == "third"


def test_a_lock_of_another_version_is_judged_by_its_heartbeat(tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "HEARTBEAT_WATCH_SECONDS", 0.2)
    path = tmp_path / JOURNAL_DIR / journal.LOCK_FILE
    path.parent.mkdir()
    for text in (
        json.dumps({"host": socket.gethostname(), "pid": 2**22, "started": 1e9, "token": "t"}),
        "", "[]", '{"pid": "x"}', "[" * 10**5,
    ):  # fmt: skip
        path.write_text(text)
        with pytest.raises(StoreBusyError):
            StoreLock(tmp_path)
        os.utime(path, (1e9, 1e9))
        StoreLock(tmp_path, lambda text: None).release()


def fails(number):
    def refuse(*_, **__):
        raise OSError(number, os.strerror(number))

    return refuse


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP])
def test_a_file_system_without_flock_is_warned_of_once_and_used(tmp_path, monkeypatch, number):
    """As Lustre without its option, or NFS without lockd."""
    monkeypatch.setattr(fcntl, "flock", fails(number))
    monkeypatch.setattr(journal, "_issued_warning_kinds", set())
    messages = []
    held = StoreLock(tmp_path, messages.append)
    assert (
        messages == [messages[0]]
        and messages[0].startswith("warning: ")
        and "has no flock" in messages[0]
    )
    with pytest.raises(StoreBusyError):
        StoreLock(tmp_path, messages.append)
    held.release()
    StoreLock(tmp_path, messages.append).release()
    assert len(messages) == 1


@pytest.mark.parametrize(
    "number", [errno.EPERM, errno.ENOSYS, errno.ENOTSUP, errno.EXDEV, errno.EMLINK]
)
def test_a_file_system_without_links_is_warned_of_once_and_used(tmp_path, monkeypatch, number):
    """As FUSE and SMB have none, and exFAT."""
    monkeypatch.setattr(os, "link", fails(number))
    monkeypatch.setattr(journal, "_issued_warning_kinds", set())
    messages = []
    held = StoreLock(tmp_path, messages.append)
    assert (
        held.is_held_by_this_process() and len(messages) == 1 and "has no hard links" in messages[0]
    )
    with pytest.raises(StoreBusyError):
        StoreLock(tmp_path, messages.append)
    held.release()
    put(tmp_path, replace(LockHolder.of_this_process(), pid=2**22 + 1))
    StoreLock(tmp_path, messages.append).release()
    assert len(messages) == 1 and sorted(os.listdir(tmp_path / JOURNAL_DIR)) == ["lock.guard"]


@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES])
def test_other_faults_of_a_file_system_refuse(tmp_path, monkeypatch, number):
    monkeypatch.setattr(fcntl, "flock", fails(number))
    with pytest.raises(StoreError, match="can't be locked"):
        StoreLock(tmp_path)


@pytest.mark.parametrize("lacking", ["flock", "link", "both"])
def test_of_many_that_find_a_stale_lock_without_locks_or_links_one_gets_it(
    tmp_path, monkeypatch, lacking
):
    if lacking in ("flock", "both"):
        monkeypatch.setattr(fcntl, "flock", fails(errno.ENOSYS))
    if lacking in ("link", "both"):
        monkeypatch.setattr(os, "link", fails(errno.EPERM))
    test_of_many_that_find_a_stale_lock_one_gets_it(tmp_path)


@pytest.mark.parametrize("links", [True, False])
def test_a_lock_that_another_takes_between_is_left_to_it(tmp_path, monkeypatch, links):
    """Without flock, nothing keeps two from judging one dead lock at once."""
    monkeypatch.setattr(fcntl, "flock", fails(errno.ENOSYS))
    if not links:
        monkeypatch.setattr(os, "link", fails(errno.EPERM))
    put(tmp_path, replace(LockHolder.of_this_process(), pid=2**22 + 1))
    judge, quicker = StoreLock._refuse_living_holder, []

    def overtaken(self):
        judge(self)
        if not quicker:
            quicker.append(None)
            quicker.append(StoreLock(tmp_path, lambda text: None))

    monkeypatch.setattr(StoreLock, "_refuse_living_holder", overtaken)
    with pytest.raises(StoreBusyError):
        StoreLock(tmp_path, lambda text: None)
    assert quicker[1].is_held_by_this_process()
    quicker[1].release()


def test_a_run_without_flock_or_links_goes_to_its_end(tmp_path, monkeypatch):
    monkeypatch.setattr(fcntl, "flock", fails(errno.ENOLCK))
    monkeypatch.setattr(os, "link", fails(errno.EPERM))
    monkeypatch.setattr(journal, "_issued_warning_kinds", set())
    progress = RecordingProgress()
    store = tmp_path / "s.zarr"
    assert run(small_spec(), store=store, progress=progress, scheduler="none").complete
    assert sum("warning: " in line for line in progress) == 2
    range_ = {"linear": ["10 m", "5 km"], "number": 3}
    axes = {**STUDY_MAPPING["axes"], "target.range": range_}
    outcome = run(
        small_spec(axes=axes), store=store, overwrite=True, progress=progress, scheduler="none"
    )
    assert outcome.complete and pack_store(store, tmp_path / "packed.zarr", progress=False)
    spectra = ["spectra", str(store), "--at", "range=10m", "-o", str(tmp_path / "spectra.zarr")]
    assert CliRunner().invoke(main, spectra, catch_exceptions=False).exit_code == 0


def test_what_a_living_process_makes_is_not_cleared_up_after_the_clock_was_set(tmp_path):
    hidden_path = locations._hidden_path(tmp_path / "s.zarr", "creating")
    hidden_path.mkdir()
    os.utime(hidden_path, (1e9, 1e9))
    locations.recover_interrupted_replace(tmp_path / "other.zarr")
    assert hidden_path.exists()
    dead = Path(str(hidden_path).replace(f"-{os.getpid()}.", f"-{2**22 + 1}."))
    dead.mkdir()
    reused = Path(re.sub(rf"-{os.getpid()}\.\d+", f"-{os.getpid()}.7", str(hidden_path)))
    reused.mkdir()
    locations.recover_interrupted_replace(tmp_path / "other.zarr")
    assert hidden_path.exists() and not dead.exists() and not reused.exists()


def test_many_stores_on_one_file_system_are_warned_of_once(tmp_path, monkeypatch):
    """A flight has a lock for each of its eyepoints' stores, and an extension has two."""
    monkeypatch.setattr(fcntl, "flock", fails(errno.ENOSYS))
    monkeypatch.setattr(os, "link", fails(errno.EPERM))
    monkeypatch.setattr(journal, "_issued_warning_kinds", set())
    messages = []
    for name in ("one.zarr", "two.zarr", "three.zarr"):
        (tmp_path / name).mkdir()
        StoreLock(tmp_path / name, messages.append).release()
    assert ["flock" in text for text in messages] == [True, False]


def test_a_heartbeat_that_fails_is_warned_of_once(tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "HEARTBEAT_INTERVAL_SECONDS", 0.02)
    monkeypatch.setattr(journal, "_issued_warning_kinds", set())
    beats, beat = [], journal._FileLock.send_heartbeat

    def fails_twice(self):
        beats.append(None)
        if len(beats) < 3:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        beat(self)

    monkeypatch.setattr(journal._FileLock, "send_heartbeat", fails_twice)
    messages = []
    with StoreLock(tmp_path, messages.append):
        end = time.monotonic() + 20
        while len(beats) < 5 and time.monotonic() < end:
            time.sleep(0.01)
    (warning,) = messages
    assert "heartbeat" in warning and "Permission denied" in warning and "other hosts" in warning
    assert len(beats) >= 5  # it goes on


def test_a_lock_that_a_full_disk_cuts_is_taken_away(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "link", fails(errno.EPERM))
    monkeypatch.setattr(journal, "_issued_warning_kinds", set())
    sync, path = os.fsync, tmp_path / JOURNAL_DIR / journal.LOCK_FILE

    def full(opened):
        if path.exists():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(opened)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StoreError, match="No space left"):
        StoreLock(tmp_path, lambda text: None)
    assert sorted(os.listdir(tmp_path / JOURNAL_DIR)) == ["lock.guard"]
    monkeypatch.setattr(os, "fsync", sync)
    StoreLock(tmp_path, lambda text: None).release()
