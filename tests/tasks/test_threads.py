"""Blocks that threads of the command's own process compute."""

import os
import re
import signal
import threading
import time

import pytest
from click.testing import CliRunner
from small_flights import small_scene_spec
from small_studies import (
    RecordingProgress,
    file_digests,
    receipt_blocks,
    run_serially,
    small_spec,
)

from sweep.cli import main
from sweep.storage.store_format import read_attributes
from sweep.tasks.driver import resume, run
from sweep.tasks.engine import interrupts, study_store, worker_memory
from sweep.tasks.engine.progress import Progress
from sweep.tasks.studies.store_summary import status

N_BLOCKS = 12


def test_threads_compute_blocks_at_the_same_time(serial_store, tmp_path):
    """Each block waits until three are at work; one after the other they would wait in vain."""
    three_at_work = threading.Barrier(3)

    def meet(study, block):
        three_at_work.wait(30)
        return study.evaluate(block)

    outcome = run_serially(small_spec(), tmp_path / "s.zarr", threads=3, evaluate=meet)
    assert outcome.complete and not outcome.failures
    assert sorted(receipt_blocks(outcome.store)) == list(range(N_BLOCKS))
    assert file_digests(outcome.store) == file_digests(serial_store)


class ThreadCounts(Progress):
    """Progress that keeps the numbers of threads it is told of."""

    def __init__(self):
        self.counts = set()

    def update_threads(self, *, threads, stored):
        self.counts.add(threads)


@pytest.mark.parametrize("options, number", [({"threads": 3}, 3), ({"scheduler": "none"}, 1)])
def test_progress_and_status_count_threads(tmp_path, options, number):
    counter = ThreadCounts()
    outcome = run(small_spec(), store=tmp_path / "s.zarr", progress=counter, **options)
    assert counter.counts == {number}
    assert status(outcome.store).threads_in_last_run == number
    output = CliRunner().invoke(main, ["status", str(outcome.store)]).output
    assert re.search(rf"in the last run, by {number} thread{'s' * (number > 1)}\n", output)


def test_lost_results_leave_the_number_of_threads(tmp_path, monkeypatch):
    """Also where a receipt's block is not seen in the store, and fails in its place."""
    monkeypatch.setattr(study_store, "is_block_visible", lambda *_: False)
    counter = ThreadCounts()
    run(small_spec(), store=tmp_path / "s.zarr", progress=counter, threads=2)
    assert counter.counts == {2}


def test_a_flight_by_threads_has_the_bytes_of_a_plain_loop(flight, tmp_path):
    outcome = run_serially(small_scene_spec(), tmp_path / "scene.zarr", threads=3)
    assert file_digests(outcome.store) == file_digests(flight)


@pytest.mark.parametrize("error", [ValueError("no"), SystemExit(1), KeyboardInterrupt()])
def test_a_block_that_fails_twice_is_recorded_and_the_others_are_computed(tmp_path, error):
    tries = []

    def fail_third(study, block):
        if block == 2:
            tries.append(block)
            raise error
        return study.evaluate(block)

    outcome = run_serially(small_spec(), tmp_path / "s.zarr", threads=2, evaluate=fail_third)
    assert outcome.blocks_done == N_BLOCKS - 1 and len(tries) == 2
    assert [failure.block for failure in outcome.failures] == [2]
    assert type(error).__name__ in outcome.failures[0].error
    assert resume(outcome.store, retry_failed=True, threads=2, progress=False).complete


def test_blocks_that_run_at_sigterm_are_committed_and_no_other_begins(serial_store, tmp_path):
    both_at_work = threading.Barrier(2)

    def stop_at_once(study, block):
        if block < 2:
            both_at_work.wait(30)
        if block == 1:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.5)
        return study.evaluate(block)

    outcome = run_serially(small_spec(), tmp_path / "s.zarr", threads=2, evaluate=stop_at_once)
    assert outcome.stop_reason == "interrupted"
    assert {0, 1} <= set(receipt_blocks(outcome.store)) and outcome.blocks_done < N_BLOCKS
    assert resume(outcome.store, progress=False).complete
    assert file_digests(outcome.store) == file_digests(serial_store)


def test_blocks_that_outlast_sigterm_do_not_hold_the_run(serial_store, tmp_path, monkeypatch):
    monkeypatch.setattr(interrupts, "SIGTERM_GRACE_SECONDS", 0.5)
    may_end = threading.Event()

    def hang(study, block):
        if block == 3:
            os.kill(os.getpid(), signal.SIGTERM)
            may_end.wait(60)
        return study.evaluate(block)

    start = time.monotonic()
    outcome = run_serially(small_spec(), tmp_path / "s.zarr", threads=2, evaluate=hang)
    assert outcome.stop_reason == "stopped at once" and time.monotonic() - start < 20
    assert 3 not in receipt_blocks(outcome.store)
    may_end.set()  # the thread now ends its block, while another run computes it too
    assert resume(outcome.store, threads=2, progress=False).complete
    assert file_digests(outcome.store) == file_digests(serial_store)


def test_a_store_that_is_moved_away_meanwhile_ends_the_run(tmp_path):
    def move_store(study, block):
        if block == 4:
            os.rename(tmp_path / "s.zarr", tmp_path / "moved.zarr")
        return study.evaluate(block)

    outcome = run_serially(small_spec(), tmp_path / "s.zarr", threads=2, evaluate=move_store)
    assert not outcome.complete and "is no longer there" in outcome.stop_reason


def test_only_as_many_threads_compute_as_memory_suffices_for(tmp_path, monkeypatch):
    monkeypatch.setattr("distributed.system.MEMORY_LIMIT", 25 * 10**9)
    monkeypatch.setattr("sweep.tasks.driver.block_peak_memory_bytes", lambda study: 10 * 10**9)
    at_work, most_at_work, lock = [], [], threading.Lock()

    def count(study, block):
        with lock:
            at_work.append(block)
            most_at_work.append(len(at_work))
        time.sleep(0.05)
        results = study.evaluate(block)
        with lock:
            at_work.remove(block)
        return results

    progress = RecordingProgress()
    outcome = run(
        small_spec(), store=tmp_path / "s.zarr", threads=4, evaluate=count, progress=progress
    )
    assert outcome.complete and max(most_at_work) == 2
    assert "memory suffices for 2 of 4 threads: a block takes up to 10.0 GB" in progress


def test_a_machine_is_not_asked_for_little_memory():
    memory = worker_memory.WorkerMemory(lambda: pytest.fail("it was asked"), "this machine")
    assert memory.suffices_for(1e6)


def test_threads_are_no_part_of_a_study(serial_store, tmp_path):
    outcome = run_serially(small_spec(), tmp_path / "s.zarr", threads=2)
    assert read_attributes(outcome.store) == read_attributes(serial_store)
