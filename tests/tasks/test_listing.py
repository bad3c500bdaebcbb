import json
import time

import numpy as np
import pytest
from small import copied, evaluated, logged, quiet, small, tree
from small_flights import small_scene

from sweep.storage.locations import located
from sweep.tasks import journal, session
from sweep.tasks.driver import resume
from sweep.tasks.eyepoint_study import EyepointStudy
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.journal import Look, chunks_there, listed
from sweep.tasks.summary import status

STUDIES = {
    "grid": lambda path: GridStudy(small()),
    "grid with draws": lambda path: GridStudy(small(draws={"number": 20, "batch": 10})),
    "no axes": lambda path: GridStudy(small(axes={})),
    "flight": lambda path: FlightStudy(small_scene(), path),
    "flight without axes": lambda path: FlightStudy(small_scene(axes={}), path),
    "eyepoints": lambda path: EyepointStudy(small_scene(), "three"),
}


@pytest.mark.parametrize("name", STUDIES)
def test_the_owner_of_a_chunk_is_the_block_that_writes_it(tmp_path, name):
    """By the chunks of every block, one by one: all of them owned, and by no other."""
    study = STUDIES[name](tmp_path / "some.zarr")
    owners = study.owners()
    left = {array: np.full(owner.shape, -1) for array, owner in owners.items()}
    for block in range(study.n_blocks):
        for array, position in study.chunks(block).items():
            left[array][position] = block
    for array, owner in owners.items():
        np.testing.assert_array_equal(left[array], owner, err_msg=array)


def test_a_block_is_whole_where_all_of_its_chunks_are_and_hold_something(undisturbed, tmp_path):
    store, study = copied(undisturbed, tmp_path), GridStudy(small())
    every = np.ones(12, bool)
    assert listed(store, study, every).all()
    (store / "pd_up" / "c" / "0" / "5" / "0").unlink()
    (store / "pd_shot" / "c" / "0" / "7" / "0").write_bytes(b"")
    (store / "pd_shot" / "c" / "0" / "notes").write_bytes(b"not a chunk")
    (store / "pd_shot" / "c" / "0" / "99").mkdir()
    assert np.flatnonzero(~listed(store, study, every)).tolist() == [5, 7]
    assert not listed(store, study, ~every).any()
    but_five = np.arange(12) != 5
    assert np.flatnonzero(but_five & ~listed(store, study, but_five)).tolist() == [7]


def test_folders_and_object_stores_are_listed_alike(tmp_path):
    here, there = tmp_path / "c", located(f"memory://bucket{tmp_path}/c")
    for name, content in {
        "0/1": b"ab",
        "2/0": b"",
        "2/1": b"abc",
        "9/9": b"x",
        "1/x": b"x",
    }.items():
        (here / name).parent.mkdir(parents=True, exist_ok=True)
        (here / name).write_bytes(content)
        (there / name).write_bytes(content)
    expected = [[False, True], [False, False], [False, True]]
    assert chunks_there(here, (3, 2)).tolist() == chunks_there(there, (3, 2)).tolist() == expected
    (tmp_path / "scalar").write_bytes(b"four")
    assert chunks_there(tmp_path / "scalar", ()) and not chunks_there(tmp_path / "none", ())


def test_status_says_what_there_is_of_a_run(tmp_path):
    outcome = quiet(small(draws={"number": 20, "batch": 10}), tmp_path / "small.zarr")
    found = status(outcome.store)
    assert found.draws_done == 72 * 20 and found.workers == 1
    assert found.rate > 0 and found.left == 0
    assert found.heartbeat == float("inf")
    chunks = [
        file.stat().st_size
        for name in GridStudy(small(draws={"number": 20, "batch": 10})).owners()
        for file in (outcome.store / name / "c").rglob("*")
        if file.is_file()
    ]
    assert found.bytes == sum(chunks)


def slow_to_look(monkeypatch, seconds):
    """Folders that show what they hold only after some time, and a run that waits for nothing."""
    there = journal.chunks_there

    def late(folder, shape):
        time.sleep(seconds)
        return there(folder, shape)

    monkeypatch.setattr(journal, "chunks_there", late)
    monkeypatch.setattr(session, "LOOKING", 0.01)


@pytest.mark.parametrize("to_do", ["nothing", "a block"])
def test_a_run_begins_before_the_folders_are_seen_and_mends_what_they_lack(
    undisturbed, tmp_path, monkeypatch, to_do
):
    """A chunk that is gone is found while other blocks are computed, or when all are done."""
    store, log = copied(undisturbed, tmp_path), tmp_path / "log"
    (store / "pd_up" / "c" / "0" / "5" / "0").unlink()
    (store / "effects" / "c" / "0" / "7" / "0").write_bytes(b"")
    lines = (store / ".sweep" / "receipts.jsonl").read_bytes().splitlines(keepends=True)
    if to_do == "a block":
        (store / ".sweep" / "receipts.jsonl").write_bytes(b"".join(lines[:-1]))
    slow_to_look(monkeypatch, 0.05)
    outcome = resume(store, progress=False, scheduler="none", evaluate=logged(log))
    last = [json.loads(lines[-1])["block"]] if to_do == "a block" else []
    assert evaluated(log)[: len(last)] == last
    assert sorted(evaluated(log)[len(last) :]) == [5, 7]
    assert outcome.complete and outcome.blocks_computed == 2 + len(last)
    assert tree(store) == tree(undisturbed)


def test_a_look_that_is_stopped_ends_soon(undisturbed, monkeypatch):
    slow_to_look(monkeypatch, 0.02)
    look = Look(undisturbed, GridStudy(small()), np.ones(12, bool))
    look.stop()
    assert look.within(1.0) and look.whole().all()
