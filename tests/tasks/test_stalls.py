"""Runs whose workers answer nothing for long, and the log that shows what they do."""

import logging
import re
import threading

import pytest
from small_studies import file_digests, small_spec, thread_cluster_client
from test_absent_workers import ActingProgress

from sweep.tasks.driver import run
from sweep.tasks.engine import dispatcher, stalls, worker

RELEASED = threading.Event()


def blocked_at_block_3(study, block):
    """Compute a block; the one of number 3 waits until it is released."""
    if block == 3:
        assert RELEASED.wait(60)
    return study.evaluate(block)


@pytest.fixture
def impatient(monkeypatch):
    """A client of one worker, whose stalls are reported after half a second."""
    RELEASED.clear()
    monkeypatch.setattr(dispatcher, "IDLE_POLL_SECONDS", 0.05)
    monkeypatch.setattr(stalls, "STALL_REPORT_SECONDS", 0.5)
    with thread_cluster_client(1) as client:
        yield client


def test_a_run_that_stalls_shows_its_tasks_and_workers_and_then_goes_on(
    serial_store, tmp_path, impatient, caplog
):
    class Releasing(ActingProgress):
        def say(self, text):
            self.lines.append(text)
            if sum(line.startswith("no block has come back for ") for line in self.lines) == 2:
                RELEASED.set()

    progress = Releasing(lambda: None)
    with caplog.at_level(logging.INFO, logger="sweep"):
        outcome = run(
            small_spec(), store=tmp_path / "s.zarr", client=impatient, progress=progress,
            evaluate=blocked_at_block_3,
        )  # fmt: skip
    assert outcome.complete and file_digests(outcome.store) == file_digests(serial_store)
    first, second = (
        line for line in progress.lines if line.startswith("no block has come back for ")
    )
    (address,) = impatient.nthreads()
    assert re.search(r"task of block [0-3] and \d+ more: sent .* ago, .*pending", first)
    assert f"worker {address}: 1 thread, last answer " in first
    assert "\n" not in second
    assert sum("nothing came back" in record.message for record in caplog.records) == 2


class ReleasingNamedBlock(ActingProgress):
    """Progress that lets the blocked block go on once a report names it."""

    def say(self, text):
        self.lines.append(text)
        if "block 3: " in text:
            RELEASED.set()


@pytest.mark.parametrize(
    ("options", "thread"), [({"scheduler": "none"}, "MainThread"), ({"threads": 2}, r"compute-\d")]
)
def test_a_block_that_holds_up_this_process_is_named_with_its_thread(
    serial_store, tmp_path, monkeypatch, caplog, options, thread
):
    RELEASED.clear()
    monkeypatch.setattr(worker, "IDLE_POLL_SECONDS", 0.05)
    monkeypatch.setattr(stalls, "STALL_REPORT_SECONDS", 0.5)
    progress = ReleasingNamedBlock(lambda: None)
    with caplog.at_level(logging.INFO, logger="sweep.stalls"):
        outcome = run(
            small_spec(), store=tmp_path / "s.zarr", progress=progress, evaluate=blocked_at_block_3,
            **options,
        )  # fmt: skip
    assert outcome.complete and file_digests(outcome.store) == file_digests(serial_store)
    (report,) = (line for line in progress.lines if "block 3: " in line)
    assert report.startswith("no block has come back for ")
    assert re.search(
        r"\d+ blocks? not yet begun, [12] blocks? being computed; \d+ blocks? ", report
    )
    assert re.search(rf"block 3: computed by thread {thread} since \d\d:\d\d:\d\d, .* ago", report)
    logged = [record.message for record in caplog.records if "block 3: " in record.message]
    assert logged and "nothing came back for " in logged[0]


def test_patience_grows_with_the_time_of_a_task_and_waits_for_nothing_that_is_not_computed(
    monkeypatch,
):
    monkeypatch.setattr(stalls, "STALL_REPORT_SECONDS", 0.0)
    messages = []
    monitor = stalls.InProcessMonitor(messages.append, lambda: 7)
    monitor.report_if_stalled()
    assert not messages
    with monitor.mark_in_progress(5):
        monitor.report_if_stalled()
        assert "the model is being loaded, or compiled once" in messages[0]
        monitor.record_result(1, 0.0)
        monitor.report_if_stalled()
        assert "7 blocks not yet begun, 1 block being computed; 1 block done" in messages[1]
        assert "block 5: computed by thread MainThread since " in messages[1]
        monitor.record_result(1, 100.0)  # 50 s a block: the patience is 250 s
        monitor.report_if_stalled()
    assert len(messages) == 2


def test_a_run_is_quiet_by_default_and_logs_its_steps_where_asked(tmp_path, caplog, capfd):
    run(small_spec(), store=tmp_path / "quiet.zarr", scheduler="none", progress=False)
    assert capfd.readouterr() == ("", "")
    caplog.clear()
    with caplog.at_level(logging.DEBUG, logger="sweep"):
        run(small_spec(), store=tmp_path / "s.zarr", scheduler="none", progress=False)
    words = [record.message for record in caplog.records if record.name == "sweep.session"]
    assert f"{tmp_path / 's.zarr'}: study " in words[0] and " of 12 blocks, 0 done" in words[0]
    assert "blocks are computed in this process, one after the other" in words
    assert words[-1].startswith(f"{tmp_path / 's.zarr'}: 12 blocks computed in ")


def blocked_at_first(study, block):
    """Compute a block once it is released."""
    assert RELEASED.wait(60)
    return study.evaluate(block)


def test_workers_that_have_yet_to_answer_are_said_to_compile(tmp_path, impatient, monkeypatch):
    monkeypatch.setattr(dispatcher, "COMPILATION_SECONDS_MAX", 1.2)

    class Releasing(ActingProgress):
        def say(self, text):
            self.lines.append(text)
            if "last answer never" in text:
                RELEASED.set()

    progress = Releasing(lambda: None)
    outcome = run(
        small_spec(), store=tmp_path / "s.zarr", client=impatient, progress=progress,
        evaluate=blocked_at_first,
    )  # fmt: skip
    assert outcome.complete
    *early, late = (
        line for line in progress.lines if line.startswith("no block has come back for ")
    )
    assert early and all("workers load the model, or compile it" in line for line in early)
    assert not any("last answer" in line for line in early)
    assert "last answer never" in late  # beyond the time that compiling takes
