import json
import time

import numpy as np
import pytest
from small_flights import small_scene_spec
from small_studies import (
    copy_store,
    file_digests,
    logged_blocks,
    make_logging_evaluate,
    run_serially,
    small_spec,
)

from sweep.storage.locations import parse_location
from sweep.tasks.driver import resume
from sweep.tasks.engine import journal, session
from sweep.tasks.engine.journal import ChunkScan, find_complete_block_mask, find_existing_chunk_mask
from sweep.tasks.studies.eyepoint_study import EyepointStudy
from sweep.tasks.studies.flight_study import FlightStudy
from sweep.tasks.studies.grid_study import GridStudy
from sweep.tasks.studies.store_summary import status

STUDIES = {
    "grid": lambda path: GridStudy(small_spec()),
    "grid with draws": lambda path: GridStudy(small_spec(draws={"number": 20, "batch": 10})),
    "no axes": lambda path: GridStudy(small_spec(axes={})),
    "flight": lambda path: FlightStudy(small_scene_spec(), path),
    "flight without axes": lambda path: FlightStudy(small_scene_spec(axes={}), path),
    "eyepoints": lambda path: EyepointStudy(small_scene_spec(), "three"),
}


@pytest.mark.parametrize("name", STUDIES)
def test_the_owner_of_a_chunk_is_the_block_that_writes_it(tmp_path, name):
    """By the chunks of every block, one by one: all of them owned, and by no other."""
    study = STUDIES[name](tmp_path / "some.zarr")
    owners = study.chunk_owner_blocks()
    left = {array: np.full(owner.shape, -1) for array, owner in owners.items()}
    for block in range(study.n_blocks):
        for array, position in study.chunk_positions_of_block(block).items():
            left[array][position] = block
    for array, owner in owners.items():
        np.testing.assert_array_equal(left[array], owner, err_msg=array)


def test_a_block_is_whole_where_all_of_its_chunks_are_and_hold_something(serial_store, tmp_path):
    store, study = copy_store(serial_store, tmp_path), GridStudy(small_spec())
    every = np.ones(12, bool)
    assert find_complete_block_mask(store, study, every).all()
    (store / "pd_up" / "c" / "0" / "5" / "0").unlink()
    (store / "pd_shot" / "c" / "0" / "7" / "0").write_bytes(b"")
    (store / "pd_shot" / "c" / "0" / "notes").write_bytes(b"not a chunk")
    (store / "pd_shot" / "c" / "0" / "99").mkdir()
    assert np.flatnonzero(~find_complete_block_mask(store, study, every)).tolist() == [5, 7]
    assert not find_complete_block_mask(store, study, ~every).any()
    but_five = np.arange(12) != 5
    assert np.flatnonzero(
        but_five & ~find_complete_block_mask(store, study, but_five)
    ).tolist() == [7]


def test_folders_and_object_stores_are_listed_alike(tmp_path):
    local_path, remote_path = tmp_path / "c", parse_location(f"memory://bucket{tmp_path}/c")
    for name, content in {
        "0/1": b"ab",
        "2/0": b"",
        "2/1": b"abc",
        "9/9": b"x",
        "1/x": b"x",
    }.items():
        (local_path / name).parent.mkdir(parents=True, exist_ok=True)
        (local_path / name).write_bytes(content)
        (remote_path / name).write_bytes(content)
    expected = [[False, True], [False, False], [False, True]]
    assert (
        find_existing_chunk_mask(local_path, (3, 2)).tolist()
        == find_existing_chunk_mask(remote_path, (3, 2)).tolist()
        == expected
    )
    (tmp_path / "scalar").write_bytes(b"four")
    assert find_existing_chunk_mask(tmp_path / "scalar", ()) and not find_existing_chunk_mask(
        tmp_path / "none", ()
    )


def test_status_says_what_there_is_of_a_run(tmp_path):
    outcome = run_serially(small_spec(draws={"number": 20, "batch": 10}), tmp_path / "small.zarr")
    statuses = status(outcome.store)
    assert statuses.draws_done == 72 * 20 and statuses.workers_in_last_run == 1
    assert statuses.points_per_second > 0 and statuses.seconds_left == 0
    assert statuses.heartbeat_age == float("inf")
    chunks = [
        file.stat().st_size
        for name in GridStudy(small_spec(draws={"number": 20, "batch": 10})).chunk_owner_blocks()
        for file in (outcome.store / name / "c").rglob("*")
        if file.is_file()
    ]
    assert statuses.bytes_stored == sum(chunks)


def slow_to_look(monkeypatch, seconds):
    """Folders that show what they hold only after some time, and a run that waits for nothing."""
    find_existing_chunk_mask = journal.find_existing_chunk_mask

    def late(folder, shape):
        time.sleep(seconds)
        return find_existing_chunk_mask(folder, shape)

    monkeypatch.setattr(journal, "find_existing_chunk_mask", late)
    monkeypatch.setattr(session, "CHUNK_SCAN_TIMEOUT_SECONDS", 0.01)


@pytest.mark.parametrize("to_do", ["nothing", "a block"])
def test_a_run_begins_before_the_folders_are_seen_and_mends_what_they_lack(
    serial_store, tmp_path, monkeypatch, to_do
):
    """A chunk that is gone is found while other blocks are computed, or when all are done."""
    store, log = copy_store(serial_store, tmp_path), tmp_path / "log"
    (store / "pd_up" / "c" / "0" / "5" / "0").unlink()
    (store / "effects" / "c" / "0" / "7" / "0").write_bytes(b"")
    lines = (store / ".sweep" / "receipts.jsonl").read_bytes().splitlines(keepends=True)
    if to_do == "a block":
        (store / ".sweep" / "receipts.jsonl").write_bytes(b"".join(lines[:-1]))
    slow_to_look(monkeypatch, 0.05)
    outcome = resume(store, progress=False, scheduler="none", evaluate=make_logging_evaluate(log))
    last = [json.loads(lines[-1])["block"]] if to_do == "a block" else []
    assert logged_blocks(log)[: len(last)] == last
    assert sorted(logged_blocks(log)[len(last) :]) == [5, 7]
    assert outcome.complete and outcome.blocks_computed == 2 + len(last)
    assert file_digests(store) == file_digests(serial_store)


def test_a_look_that_is_stopped_ends_soon(serial_store, monkeypatch):
    slow_to_look(monkeypatch, 0.02)
    look = ChunkScan(serial_store, GridStudy(small_spec()), np.ones(12, bool))
    look.stop()
    assert look.wait(1.0) and look.complete_block_mask().all()
