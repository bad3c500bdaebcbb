"""Runs whose workers answer nothing for long, and the log that shows what they do."""

import logging
import re
import threading

import pytest
from small_studies import file_digests, small_spec, thread_cluster_client
from test_absence import Told

from sweep.tasks.driver import run
from sweep.tasks.engine import dispatcher

RELEASED = threading.Event()


def blocked_at_block_3(study, block):
    """Compute a block; the one of number 3 waits until it is released."""
    if block == 3:
        assert RELEASED.wait(60)
    return study.evaluate(block)


@pytest.fixture
def impatient(monkeypatch):
    """A client of one worker, whose stalls are told after half a second."""
    RELEASED.clear()
    monkeypatch.setattr(dispatcher, "IDLE_POLL_SECONDS", 0.05)
    monkeypatch.setattr(dispatcher, "STALL_REPORT_SECONDS", 0.5)
    with thread_cluster_client(1) as client:
        yield client


def test_a_run_that_stalls_shows_its_tasks_and_workers_and_then_goes_on(
    undisturbed, tmp_path, impatient, caplog
):
    class Releasing(Told):
        def say(self, text):
            self.lines.append(text)
            if sum(line.startswith("no block has come back for ") for line in self.lines) == 2:
                RELEASED.set()

    told = Releasing(lambda: None)
    with caplog.at_level(logging.INFO, logger="sweep"):
        outcome = run(
            small_spec(), store=tmp_path / "s.zarr", client=impatient, progress=told,
            evaluate=blocked_at_block_3,
        )  # fmt: skip
    assert outcome.complete and file_digests(outcome.store) == file_digests(undisturbed)
    first, second = (line for line in told.lines if line.startswith("no block has come back for "))
    (address,) = impatient.nthreads()
    assert re.search(r"task of block [0-3] and \d+ more: sent .* ago, .*pending", first)
    assert f"worker {address}: 1 thread, last answer " in first
    assert "\n" not in second
    assert sum("nothing came back" in record.message for record in caplog.records) == 2


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

    class Releasing(Told):
        def say(self, text):
            self.lines.append(text)
            if "last answer never" in text:
                RELEASED.set()

    told = Releasing(lambda: None)
    outcome = run(
        small_spec(), store=tmp_path / "s.zarr", client=impatient, progress=told,
        evaluate=blocked_at_first,
    )  # fmt: skip
    assert outcome.complete
    *early, late = (line for line in told.lines if line.startswith("no block has come back for "))
    assert early and all("workers load the model, or compile it" in line for line in early)
    assert not any("last answer" in line for line in early)
    assert "last answer never" in late  # beyond the time that compiling takes
