import errno
import json
import math
import os
import signal
from collections import Counter

import dask
import numpy as np
import pytest
import xarray as xr
from small_studies import (
    STUDY_MAPPING,
    file_digests,
    logged_blocks,
    make_failing_evaluate,
    make_killing_evaluate,
    make_logging_evaluate,
    receipt_blocks,
    run_serially,
    small_spec,
    thread_cluster_client,
)

from sweep.model.outputs import ACCURACY_OUTPUTS, DRAW_COUNT_OUTPUTS
from sweep.tasks.driver import resume, run
from sweep.tasks.engine import session, study_store
from sweep.tasks.engine.progress import Progress
from sweep.tasks.engine.study_store import BlockWriter, WrittenBlock
from sweep.tasks.engine.worker import TaskSettings, run_blocks
from sweep.tasks.studies.grid_study import GridStudy
from sweep.tasks.studies.store_summary import status
from sweep.tasks.studies.study_loading import read_study


def test_a_plain_loop_computes_every_point_and_receipts_every_block_once(serial_store):
    dataset = xr.open_zarr(serial_store)
    assert bool(dataset.pd_shot.notnull().all())
    assert np.ptp(dataset.pd_shot.values) > 0
    assert sorted(receipt_blocks(serial_store)) == list(range(12))


@pytest.mark.parametrize(
    "place",
    [
        pytest.param({"workers": 3}, marks=pytest.mark.slow),
        {"workers": 2, "processes": False},
        {"threads": 3},
    ],
    ids=["3 processes", "2 workers in threads", "3 threads"],
)
def test_the_bytes_are_the_plain_loops_wherever_the_blocks_are_computed(
    serial_store, tmp_path, place
):
    outcome = run_serially(small_spec(), tmp_path / "small.zarr", **place)
    assert outcome.complete and outcome.blocks_computed == 12
    assert sorted(receipt_blocks(outcome.store)) == list(range(12))
    assert file_digests(outcome.store) == file_digests(serial_store)


FEW = {**STUDY_MAPPING["axes"], "target.range": {"linear": ["10 m", "5 km"], "number": 6}}
FIXED = {"axes": FEW, "draws": {"number": 70, "batch": 30}}
ADAPTIVE = {
    "axes": FEW,
    "draws": {"limit": 60, "batch": 20},
    "accuracy": {"tolerance": 0.09, "confidence": 0.9},
    "target": STUDY_MAPPING["target"] | {"roughness": "10 um"},
    "footprint": {"beamlets": 1, "speckle": "none"},
    "effects": {"signal_shot_noise": "on"},  # which tiles of several powers may keep for all
}
"""Drawn until pd is known within 0.09, but 60 times at most."""


@pytest.mark.parametrize("sections", [FIXED, ADAPTIVE], ids=["a fixed number", "to an accuracy"])
def test_what_is_drawn_does_not_depend_on_blocks_workers_or_axes(tmp_path, sections):
    outcome = run_serially(small_spec(**sections), tmp_path / "plain.zarr")
    threads = run_serially(small_spec(**sections), tmp_path / "t.zarr", threads=2)
    assert file_digests(outcome.store) == file_digests(threads.store)
    expected = xr.open_zarr(outcome.store)
    if sections is FIXED:
        assert expected.batch_draws.values.tolist() == [30, 30, 10]
        assert 0 < expected.n_detected_up.values.sum() < 70 * 36
    else:
        numbers = expected.n_draws.values
        assert set(np.unique(numbers)) == {40, 60} and "batch" not in expected.dims
        assert ((expected.accuracy_missed > 0).values <= (numbers == 60)).all()
    store = run_serially(
        small_spec(**sections, storage={"block_points": 1000}), tmp_path / "whole.zarr"
    )
    axes = {path: values for path, values in FEW.items() if "power" not in path}
    one_watt = run_serially(small_spec(**sections | {"axes": axes}), tmp_path / "one_watt.zarr")
    restored, at_one_watt = xr.open_zarr(store.store), xr.open_zarr(one_watt.store)
    for name, values in expected.data_vars.items():
        assert restored[name].values.tobytes() == values.values.tobytes(), name
    for name in (*ACCURACY_OUTPUTS, *DRAW_COUNT_OUTPUTS):
        np.testing.assert_array_equal(at_one_watt[name].values, expected[name].values[0])


def test_a_client_of_the_callers_is_used_and_left_open(serial_store, tmp_path):
    with thread_cluster_client(1, threads_per_worker=2) as client:
        outcome = run_serially(small_spec(), tmp_path / "small.zarr", client=client)
        second_outcome = run_serially(small_spec(), tmp_path / "again.zarr", client=client)
        assert client.status == "running"
    assert (
        file_digests(outcome.store)
        == file_digests(second_outcome.store)
        == file_digests(serial_store)
    )


class StopAfter(Progress):
    """Progress that asks a plain loop to stop after some points, as Ctrl-C would."""

    def __init__(self, points: int) -> None:
        self.points, self.said = points, []

    def advance(self, *, points, failed):
        self.points -= points
        if points and -6 < self.points <= 0:
            os.kill(os.getpid(), signal.SIGINT)

    def say(self, text):
        self.said.append(text)


@pytest.mark.parametrize("place", [{"scheduler": "none"}, {"workers": 2, "processes": False}])
def test_an_interrupted_run_commits_what_runs_and_resumes_to_the_same_bytes(
    serial_store, tmp_path, place
):
    path, log = tmp_path / "small.zarr", tmp_path / "log"
    progress = StopAfter(18)
    outcome = run(
        small_spec(), store=path, progress=progress, evaluate=make_logging_evaluate(log), **place
    )
    assert not outcome.complete and outcome.stop_reason == "interrupted"
    assert 3 <= outcome.blocks_done < 12
    assert len(logged_blocks(log)) == outcome.blocks_done  # what was begun was committed
    assert any("stopping" in text for text in progress.said)
    resumed = resume(path, progress=False, scheduler="none", evaluate=make_logging_evaluate(log))
    assert resumed.complete and resumed.blocks_computed == 12 - outcome.blocks_done
    assert Counter(logged_blocks(log)) == Counter(range(12))
    assert file_digests(path) == file_digests(serial_store)


@pytest.mark.parametrize("place", [{"scheduler": "none"}, {"workers": 2, "processes": False}])
def test_a_block_that_raises_is_tried_twice_recorded_and_does_not_stop_the_rest(
    serial_store, tmp_path, place
):
    path, log = tmp_path / "small.zarr", tmp_path / "log"
    outcome = run(
        small_spec(),
        store=path,
        progress=False,
        evaluate=make_failing_evaluate({2, 7}, log),
        **place,
    )
    assert not outcome.complete and outcome.blocks_done == 10
    assert sorted(failure.block for failure in outcome.failures) == [2, 7]
    expected = Counter({**dict.fromkeys(range(12), 1), 2: 2, 7: 2})
    assert Counter(logged_blocks(log)) == expected
    recorded = status(path).failures
    assert recorded[2]["error"] == "ValueError: nothing good comes of block 2"
    assert "Traceback" in recorded[7]["traceback"]
    resumed = resume(path, progress=False, scheduler="none")
    assert not resumed.complete and resumed.blocks_skipped == 2 and resumed.blocks_computed == 0
    assert set(status(path).failures) == {2, 7}
    assert resume(path, progress=False, scheduler="none", retry_failed=True).complete
    assert status(path).failures == {}
    assert file_digests(path) == file_digests(serial_store)


def test_a_block_that_kills_its_worker_is_given_up_and_the_rest_finishes(serial_store, tmp_path):
    path = tmp_path / "small.zarr"
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}):
        outcome = run(
            small_spec(), store=path, progress=False, workers=1, evaluate=make_killing_evaluate({4})
        )
    assert [failure.block for failure in outcome.failures] == [4]
    assert outcome.failures[0].error.startswith("KilledWorker")
    assert outcome.blocks_done == 11
    assert resume(path, progress=False, scheduler="none", retry_failed=True).complete
    assert file_digests(path) == file_digests(serial_store)


def test_a_study_of_which_every_block_fails_is_given_up_early(tmp_path):
    spec, log = small_spec(storage={"block_points": 1}), tmp_path / "log"
    outcome = run(
        spec,
        store=tmp_path / "small.zarr",
        progress=False,
        scheduler="none",
        evaluate=make_failing_evaluate(set(range(72)), log),
    )
    assert len(outcome.failures) == session.MAX_INITIAL_FAILURES
    assert "all failed" in outcome.stop_reason


def full_disk(study, block):
    """The model, on a machine whose disk is full from block 3 on."""
    if block >= 3:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    return study.evaluate(block)


@pytest.mark.parametrize("place", [{"scheduler": "none"}, {"workers": 2, "processes": False}])
def test_a_full_disk_stops_the_run_and_leaves_what_is_committed(serial_store, tmp_path, place):
    path = tmp_path / "small.zarr"
    outcome = run(small_spec(), store=path, progress=False, evaluate=full_disk, **place)
    assert "No space left" in outcome.stop_reason and not outcome.complete
    assert set(receipt_blocks(path)) <= {0, 1, 2}
    assert resume(path, progress=False, scheduler="none").complete
    assert file_digests(path) == file_digests(serial_store)


def test_a_task_left_over_from_a_dead_driver_writes_nothing_into_another_study(tmp_path):
    path, old = tmp_path / "small.zarr", small_spec(seed=5)
    study_store.create_store(path, GridStudy(old))

    def replaced_meanwhile(study, block):
        study_store.remove_store(path)
        study_store.create_store(path, GridStudy(small_spec(seed=6)))
        return study.evaluate(block)

    unfit = run_blocks(
        TaskSettings(str(path), old.id, read_study, replaced_meanwhile), [0]
    ).worker_error
    assert f"now holds study {small_spec(seed=6).id}, not {old.id}" in str(unfit)
    assert not list(path.glob("*/c/0/0/0"))


@pytest.mark.parametrize("times", [1, 2])
def test_a_block_whose_chunks_do_not_reach_the_store_is_not_committed(
    serial_store, tmp_path, monkeypatch, times
):
    path, lost = tmp_path / "small.zarr", []
    write = BlockWriter.write

    def forgetful(self, block, results):
        if block == 3 and len(lost) < times:
            lost.append(block)
            return WrittenBlock("0" * 32, 1)
        return write(self, block, results)

    monkeypatch.setattr(BlockWriter, "write", forgetful)
    outcome = run_serially(small_spec(), path)
    assert len(lost) == times
    assert receipt_blocks(path).count(3) == (1 if times == 1 else 0)
    assert outcome.complete == (times == 1)
    assert all("not in the store here" in failure.error for failure in outcome.failures)
    assert resume(path, progress=False, scheduler="none", retry_failed=True).complete
    assert file_digests(path) == file_digests(serial_store)


def test_the_client_never_has_more_tasks_out_than_its_window(tmp_path):
    spec = small_spec(storage={"block_points": 1})
    n_outstanding = []

    class Watching(Progress):
        def advance(self, *, points, failed):
            n_outstanding.append(len(client.futures))

    with thread_cluster_client(2) as client:
        outcome = run(spec, store=tmp_path / "s.zarr", client=client, progress=Watching())
    assert outcome.complete and outcome.blocks == 72
    assert max(n_outstanding) <= 2 * 2 + 1


def test_receipts_say_what_was_done_where_and_with_what(serial_store):
    lines = (serial_store / ".sweep" / "receipts.jsonl").read_text().splitlines()
    for record in map(json.loads, lines):
        assert record["points"] == 6
        assert 0 < record["write_seconds"] < record["seconds"]
        assert record["host"] and record["pid"] and record["versions"]["numpy"]
        assert len(record["digest"]) == 32
    assert math.isclose(sum(json.loads(line)["points"] for line in lines), 72)
