"""Blocks that take too long, too much memory or their worker with them."""

import contextlib
import contextvars
import os
import signal
import threading
import time
from functools import partial

import dask
import pytest
from small_studies import (
    copy_store,
    file_digests,
    logged_blocks,
    receipt_blocks,
    run_serially,
    small_spec,
    thread_cluster_client,
)

from sweep.tasks.driver import resume, run
from sweep.tasks.engine import worker
from sweep.tasks.engine.deploy import local_ssh
from sweep.tasks.engine.worker import BlockTimeoutError
from sweep.tasks.studies.store_summary import status


def endless(block, log):
    """The model, with a block that never ends."""

    def evaluate(study, number):
        with open(log, "a") as lines:
            lines.write(f"{number} {os.getpid()}\n")
        while number == block:
            time.sleep(0.01)
        return study.evaluate(number)

    return evaluate


@pytest.mark.parametrize(
    "place",
    [
        pytest.param({"scheduler": "none"}, marks=pytest.mark.slow),
        {"workers": 2, "processes": False},
    ],
)
def test_a_block_that_takes_longer_than_it_may_is_given_up(serial_store, tmp_path, place):
    path, log = tmp_path / "small.zarr", tmp_path / "log"
    study = small_spec()
    outcome = run(
        study, store=path, progress=False, block_timeout=2.0, evaluate=endless(4, log), **place
    )
    assert outcome.blocks_done == 11
    (failure,) = outcome.failures
    assert failure.block == 4
    assert failure.error == "BlockTimeoutError: took longer than the 2 s that a block may take"
    assert "time.sleep(0.01)" in failure.traceback  # where it was
    assert logged_blocks(log).count(4) == 2
    assert resume(path, progress=False, scheduler="none").blocks_skipped == 1
    assert resume(path, progress=False, scheduler="none", retry_failed=True).complete
    assert file_digests(path) == file_digests(serial_store)


def stuck_or_hungry(stuck, hungry):
    """The model, with a block stuck in compiled code and one that takes all memory."""

    def evaluate(study, block):
        from sweep.tasks.engine import worker

        worker.INTERRUPT_GRACE_SECONDS = 0.2
        if block == stuck:
            time.sleep(600)
        attempts = []
        while block == hungry:
            attempts.append(b"x" * (50 << 20))
            time.sleep(0.05)
        return study.evaluate(block)

    return evaluate


@pytest.mark.slow
def test_workers_that_are_stuck_or_out_of_memory_are_replaced_and_their_blocks_given_up(
    serial_store, tmp_path, monkeypatch
):
    path = tmp_path / "small.zarr"
    monkeypatch.setattr(local_ssh, "worker_memory_limit", lambda cluster, bounds: 1 << 30)
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}):
        outcome = run(
            small_spec(), store=path, progress=False, workers=2, block_timeout=20.0,
            evaluate=stuck_or_hungry(2, 8),
        )  # fmt: skip
    assert outcome.blocks_done == 10
    assert sorted(failure.block for failure in outcome.failures) == [2, 8]
    for failure in outcome.failures:
        assert failure.error.startswith("KilledWorker: 1 worker died at it")
        assert "--block-timeout" in failure.error and "memory" in failure.error
    assert set(status(path).failures) == {2, 8}
    assert resume(path, progress=False, scheduler="none", retry_failed=True).complete
    assert file_digests(path) == file_digests(serial_store)


def test_a_block_that_failed_goes_to_another_worker(tmp_path):
    log = tmp_path / "log"

    def evaluate(study, block):
        from sweep.tasks.engine.worker import worker_address

        with open(log, "a") as lines:
            lines.write(f"{block} {worker_address()}\n")
        if block == 5:
            raise ValueError("nothing good comes of it")
        return study.evaluate(block)

    with thread_cluster_client(3) as client:
        run(
            small_spec(),
            store=tmp_path / "s.zarr",
            client=client,
            evaluate=evaluate,
            progress=False,
        )
    first, second = (line.split()[1] for line in log.read_text().splitlines() if line[:2] == "5 ")
    assert first != second


def forever():
    while True:
        time.sleep(0.001)


def until_about(seconds):
    until = time.perf_counter() + seconds
    while time.perf_counter() < until:
        pass
    return "done"


def test_a_time_limit_interrupts_what_it_limits_and_nothing_after_it():
    with pytest.raises(BlockTimeoutError, match=r"longer than the 0\.05 s"):
        worker.run_with_timeout(forever, 0.05)
    for _ in range(200):  # ends about when the alarm rings
        with contextlib.suppress(BlockTimeoutError):
            assert worker.run_with_timeout(partial(until_about, 0.002), 0.002) == "done"
        sum(range(1000))  # where a stray interruption would arrive
    assert worker.run_with_timeout(lambda: "done", 60.0) == "done"
    assert worker.run_with_timeout(lambda: "done", None) == "done"
    deadline = time.monotonic() + 10
    while any(isinstance(t, threading.Timer) and t.is_alive() for t in threading.enumerate()):
        assert time.monotonic() < deadline, "an alarm is still set"
        time.sleep(0.01)


def test_an_interruption_that_comes_too_late_is_overtime_and_leaves_no_thread():
    interruptions = []

    def done_after_all():
        interruptions.append(threading.current_thread())
        with contextlib.suppress(BaseException):
            forever()
        return "done"

    with pytest.raises(BlockTimeoutError):
        worker.run_with_timeout(done_after_all, 0.05)
    assert not interruptions[0].is_alive()


def test_limited_work_sees_what_is_set_where_it_was_asked_for_as_dasks_worker_is():
    variable = contextvars.ContextVar("here")
    variable.set("a worker")
    assert worker.run_with_timeout(variable.get, 60.0) == "a worker"


def test_a_limited_work_that_raises_or_is_stopped_by_ctrl_c_ends_with_it():
    with pytest.raises(ValueError, match="nothing good"):
        worker.run_with_timeout(lambda: int("nothing good"), 60.0)
    interruptions = []

    def asleep():
        interruptions.append(threading.current_thread())
        forever()

    threading.Timer(0.2, os.kill, [os.getpid(), signal.SIGINT]).start()
    with pytest.raises(KeyboardInterrupt):
        worker.run_with_timeout(asleep, 60.0)
    interruptions[0].join(10)
    assert not interruptions[0].is_alive()


def test_a_durable_study_is_the_same_and_has_its_disk_synced_before_its_receipts(
    serial_store, tmp_path, monkeypatch
):
    from sweep.tasks.engine import study_store

    path, at = tmp_path / "small.zarr", []
    sync = study_store.sync_file_system
    monkeypatch.setattr(
        study_store,
        "sync_file_system",
        lambda place: (sync(place), at.append(receipt_blocks(path))),
    )
    assert run_serially(small_spec(), path, scheduler="none", durable=True).complete
    assert file_digests(path) == file_digests(serial_store)
    # the store as it is made, then each block before it is committed
    assert [len(before) for before in at] == [0, *range(12)]


def test_what_cannot_be_synced_is_not_committed(serial_store, tmp_path, monkeypatch):
    from sweep.tasks.engine import study_store

    path = copy_store(serial_store, tmp_path)
    (path / "pd_up" / "c" / "0" / "5" / "0").unlink()

    def broken(place):
        raise OSError(5, "Input/output error", str(place))

    monkeypatch.setattr(study_store, "sync_file_system", broken)
    outcome = resume(path, progress=False, scheduler="none", durable=True)
    assert outcome.blocks_computed == 0 and "Input/output error" in outcome.stop_reason
