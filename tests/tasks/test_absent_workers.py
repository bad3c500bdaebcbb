"""Runs whose cluster has no worker, a silent one or an unfit one."""

import asyncio
import errno
import os
import shutil
import signal
import socket
import threading
import time
from concurrent.futures import CancelledError, ThreadPoolExecutor

import dask
import pytest
from distributed import Client
from small_studies import (
    copy_store,
    file_digests,
    receipt_blocks,
    small_spec,
    thread_cluster_client,
)

from sweep.storage.store_format import NotAStoreError
from sweep.tasks.driver import resume, run
from sweep.tasks.engine import (
    cluster_connection,
    dispatcher,
    progress,
    session,
    study_store,
    worker,
    worker_memory,
)
from sweep.tasks.engine.progress import ClusterError, Progress, StoreError
from sweep.tasks.engine.worker import worker_address
from sweep.tasks.studies.grid_study import GridStudy


class ActingProgress(Progress):
    """Progress that does something when a line is said, and once as the first points arrive."""

    def __init__(self, at_line, at_first=lambda: None) -> None:
        self.lines, self.work, self._at_line, self._at_first = [], [], at_line, at_first

    def advance(self, *, points, failed):
        if points:
            self._at_first()
            self._at_first = lambda: None

    def update_workers(self, *, workers, stored):
        self.work.append((workers, stored))

    def say(self, text):
        self.lines.append(text)
        self._at_line()


@pytest.fixture
def without_workers(monkeypatch):
    """A cluster that has none, looked at often."""
    monkeypatch.setattr(session, "NO_WORKER_WARNING_SECONDS", 0.2)
    monkeypatch.setattr(dispatcher, "WORKER_THREADS_REFRESH_SECONDS", 0.1)
    monkeypatch.setattr(dispatcher, "IDLE_POLL_SECONDS", 0.1)
    with thread_cluster_client(0) as client:
        yield client


def test_that_workers_do_not_come_or_went_away_is_said_and_the_run_goes_on_with_the_next(
    serial_store, tmp_path, without_workers
):
    cluster = without_workers.cluster

    def slowly(study, block):
        time.sleep(0.05)
        return study.evaluate(block)

    progress = ActingProgress(lambda: cluster.scale(1), lambda: cluster.scale(0))
    outcome = run(
        small_spec(),
        store=tmp_path / "s.zarr",
        client=without_workers,
        progress=progress,
        evaluate=slowly,
    )
    assert outcome.complete and file_digests(outcome.store) == file_digests(serial_store)
    assert progress.lines[0].startswith("no worker yet (")
    assert "Ctrl-C stops, nothing is lost" in progress.lines[0]
    assert any(line.startswith("no worker is left (") for line in progress.lines)
    assert {0, 1} <= {workers for workers, _ in progress.work}
    assert progress.work[-1][1] > 72 * 8


def test_one_ctrl_c_stops_a_run_that_no_worker_will_end(tmp_path, without_workers):
    progress = ActingProgress(
        lambda: os.kill(os.getpid(), signal.SIGINT) if len(progress.lines) == 1 else None
    )
    outcome = run(
        small_spec(), store=tmp_path / "s.zarr", client=without_workers, progress=progress
    )
    assert outcome.stop_reason == "interrupted" and outcome.blocks_done == 0
    assert progress.lines[0].startswith("no worker yet (")


def test_word_of_absent_workers_comes_ever_less_often(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(session.time, "monotonic", lambda: clock[0])
    absence, messages = session.NoWorkerMonitor(), []
    for clock[0] in range(1000):
        workers = 1 if 300 <= clock[0] < 310 else 0
        if absence.warning_text(workers):
            messages.append(clock[0])
    assert messages == [20, 40, 80, 160, 329, 349, 389, 469, 629, 949]


def test_a_worker_that_went_before_it_was_counted_had_been_there_if_it_answered(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(session.time, "monotonic", lambda: clock[0])
    absence = session.NoWorkerMonitor()
    assert absence.warning_text(0) == absence.warning_text(0, has_receipts=True) == ""
    clock[0] = session.NO_WORKER_WARNING_SECONDS + 1
    assert absence.warning_text(0).startswith("no worker is left (")


@pytest.fixture
def two_workers(monkeypatch):
    """A client of a cluster with two workers, whose silence is soon noticed."""
    monkeypatch.setattr(dispatcher, "WORKER_THREADS_REFRESH_SECONDS", 0.1)
    monkeypatch.setattr(dispatcher, "IDLE_POLL_SECONDS", 0.1)
    monkeypatch.setattr(dispatcher, "WORKER_SILENCE_SECONDS", 1.0)
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),  # of a scheduler that is gone
        thread_cluster_client(2) as client,
    ):
        yield client


SILENT: list[str] = []
FROZEN, THAWED = threading.Event(), threading.Event()


def silent_from_block_3(study, block):
    """The model, on a worker that stands still as it comes to a block, and on the other ones."""
    if block == 3 and not SILENT:
        SILENT.append(worker_address())
        FROZEN.set()
    if worker_address() in SILENT:
        assert THAWED.wait(300)
    return study.evaluate(block)


@pytest.mark.parametrize("interrupted", [False, True])
def test_blocks_of_a_silent_worker_are_computed_by_others_and_committed_once(
    serial_store, tmp_path, two_workers, interrupted
):
    SILENT.clear(), FROZEN.clear(), THAWED.clear()
    progress = ActingProgress(lambda: None)
    if interrupted:
        progress = ActingProgress(
            lambda: None, lambda: FROZEN.wait(60) and os.kill(os.getpid(), signal.SIGINT)
        )
    try:
        outcome = run(
            small_spec(), store=tmp_path / "s.zarr", client=two_workers, progress=progress,
            evaluate=silent_from_block_3,
        )  # fmt: skip
    finally:
        THAWED.set()
    assert any(line.startswith(f"worker {SILENT[0]} is silent (") for line in progress.lines)
    assert len(receipt_blocks(outcome.store)) == len(set(receipt_blocks(outcome.store)))
    assert 3 in receipt_blocks(outcome.store)  # it ran as the run was interrupted
    if interrupted:
        assert outcome.stop_reason == "interrupted"
        assert resume(outcome.store, scheduler="none", progress=False).complete
    else:
        assert outcome.complete and outcome.blocks_computed == 12
    assert file_digests(outcome.store) == file_digests(serial_store)


@pytest.mark.parametrize("lost", ["client", "cluster"])
def test_a_client_closed_before_is_reported_in_words_where_blocks_are_left(
    serial_store, tmp_path, lost
):
    with thread_cluster_client(1) as client:
        (client if lost == "client" else client.cluster).close()
        outcome = run(small_spec(), store=tmp_path / "s.zarr", client=client, progress=False)
        assert outcome.stop_reason == "the scheduler is gone (the client is closed)"
        assert outcome.blocks_done == 0
        complete_outcome = resume(copy_store(serial_store, tmp_path), client=client, progress=False)
    assert complete_outcome.complete and not complete_outcome.blocks_computed


class LeavingPlugin:
    """A client whose scheduler goes as it is asked."""

    status = "running"

    def __init__(self, error):
        self.error = error

    def scheduler_info(self, n_workers):
        raise self.error


@pytest.mark.parametrize(
    "error", [OSError("gone"), TimeoutError(), RuntimeError("IOLoop is closed"), CancelledError()]
)
def test_nothing_is_known_of_the_memory_of_workers_that_go(error):
    assert worker_memory.available_worker_memory(LeavingPlugin(error), None).bytes_max == float(
        "inf"
    )


def test_a_scheduler_that_goes_away_ends_the_run_in_words(serial_store, tmp_path, two_workers):
    def slowly(study, block):
        time.sleep(0.05)
        return study.evaluate(block)

    cluster = two_workers.cluster
    progress = ActingProgress(lambda: None, lambda: cluster.sync(cluster.scheduler.close))
    path = tmp_path / "s.zarr"
    outcome = run(small_spec(), store=path, client=two_workers, progress=progress, evaluate=slowly)
    assert outcome.stop_reason.startswith("the scheduler is gone") and outcome.blocks_done < 12
    assert resume(path, scheduler="none", progress=False).complete
    assert file_digests(path) == file_digests(serial_store)


def versions_differ(path, opened):
    raise StoreError(f"{path} was begun with other versions than worker on here has")


def disk_is_read_only(path, opened):
    def write(block, results):
        raise OSError(errno.EROFS, "Read-only file system", path)

    opened.write = write
    return opened


def another_store(path, opened):
    return study_store.BlockWriter(f"{path}-copy", opened.study)


UNFIT = [
    (versions_differ, "was begun with other versions than worker on here has"),
    (disk_is_read_only, "Read-only file system"),
    (another_store, "does the worker see the same file system?"),
]


@pytest.mark.parametrize(
    ("fault", "message", "all_unfit"),
    [
        *((*case, False) for case in UNFIT),
        *(pytest.param(*case, True, marks=pytest.mark.slow) for case in UNFIT[:2]),
        (*UNFIT[2], True),
    ],
)
def test_an_unfit_worker_is_left_out_by_name_and_host_and_the_run_ends_where_none_is_left(
    serial_store, tmp_path, two_workers, monkeypatch, fault, message, all_unfit
):
    monkeypatch.setattr(dispatcher, "FILE_VISIBILITY_SECONDS_MAX", 0.5)
    path = copy_store(serial_store, tmp_path)
    (path / ".sweep" / "receipts.jsonl").unlink()
    held = GridStudy(small_spec())
    for block in range(12):
        for name in study_store.chunk_names_of_block(
            held, block
        ):  # of the right size, and of another study
            (path / name).write_bytes(bytes((path / name).stat().st_size))
    shutil.copytree(serial_store, f"{path}-copy")
    unfit = sorted(two_workers.nthreads())[: 1 + all_unfit]

    def study(path, study_id, read_study):
        opened = worker._open_block_writer(path, study_id, read_study)
        return fault(path, opened) if worker_address() in unfit else opened

    def evaluate(study, block):
        time.sleep(0.02)  # so that both get some
        return study.evaluate(block)

    monkeypatch.setattr(worker, "get_block_writer", study)
    progress, outcome = ActingProgress(lambda: None), None
    options = {"client": two_workers, "progress": progress, "evaluate": evaluate}
    try:
        outcome = resume(path, **options)
    except StoreError as error:
        assert all_unfit and message in str(error)
    lines = [line for line in progress.lines if "is left out" in line]
    assert lines[0].startswith(
        tuple(f"worker {w} on {os.uname().nodename} is left out" for w in unfit)
    )
    assert message in lines[0] and len(lines) == 1
    if all_unfit:
        assert outcome is None or (not outcome.blocks_done and message in outcome.stop_reason)
    else:
        assert outcome.complete and not outcome.failures
        assert file_digests(path) == file_digests(serial_store)


def test_an_asynchronous_client_is_refused_in_words(tmp_path):
    async def ask():
        async with Client(processes=False, asynchronous=True, dashboard_address=None) as client:
            run(small_spec(), store=tmp_path / "s.zarr", client=client, progress=False)

    # In a thread of its own: a browser that other tests drive leaves a loop running in this one.
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(asyncio.run, ask())
        with pytest.raises(ClusterError, match="the client is asynchronous"):
            future.result()
    assert not (tmp_path / "s.zarr").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_heard_while_kernels_compile(tmp_path, monkeypatch, number):
    compiled = threading.Event()
    monkeypatch.setattr(progress, "ACTIVITY_MESSAGE_DELAY_SECONDS", 0.1)
    monkeypatch.setattr(GridStudy, "compile_kernels", lambda self: compiled.wait(60))
    recorder = ActingProgress(
        lambda: os.kill(os.getpid(), number) if len(recorder.lines) == 1 else None
    )
    start_time = time.monotonic()
    try:
        outcome = run(small_spec(), store=tmp_path / "s.zarr", scheduler="none", progress=recorder)
    finally:
        compiled.set()
    assert recorder.lines[0].startswith("loading the model") and time.monotonic() - start_time < 50
    assert outcome.stop_reason == "interrupted" and outcome.blocks_done == 0


def test_an_address_at_which_no_scheduler_answers_is_reported_in_time(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster_connection, "CONNECT_TIMEOUT_SECONDS", 1.0)
    start_time = time.monotonic()
    with pytest.raises(ClusterError, match=r"answers at tcp://127\.0\.0\.1:1: Timed out trying"):
        run(small_spec(), store=tmp_path / "s.zarr", scheduler="tcp://127.0.0.1:1", progress=False)
    assert time.monotonic() - start_time < 20 and not (tmp_path / "s.zarr").exists()


def test_what_is_no_scheduler_is_reported_as_that(tmp_path):
    def answer(server):
        connection, _ = server.accept()
        with connection:
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n" + bytes(100))
            connection.recv(1000)

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=answer, args=(server,), daemon=True).start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(ClusterError, match=r"what answers at .* is no Dask scheduler"):
            run(small_spec(), store=tmp_path / "s.zarr", scheduler=address, progress=False)
    assert not (tmp_path / "s.zarr").exists()


def test_an_only_worker_that_does_not_see_the_folder_is_named(tmp_path, monkeypatch):
    def unseen(path, study_id, read_study):
        raise NotAStoreError(f"there is no store at {path}")

    monkeypatch.setattr(worker, "get_block_writer", unseen)
    with Client(processes=False, n_workers=1, dashboard_address=None) as client:
        words = r"no worker is left: inproc://.* on .*: there is no store at .*same path"
        with pytest.raises(StoreError, match=words):
            run(small_spec(), store=tmp_path / "s.zarr", client=client, progress=False)
