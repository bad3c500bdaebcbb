import numpy as np
import pytest
from small import copied, quiet, small
from small_flights import small_scene

from sweep.storage.locations import located
from sweep.tasks.eyepoint_study import EyepointStudy
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.listing import chunk_sizes, listed
from sweep.tasks.status import status

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
    files = [f for name in study.owners() for f in (store / name / "c").rglob("*") if f.is_file()]
    found = listed(store, study, every)
    assert found.whole.all() and found.bytes == sum(file.stat().st_size for file in files)
    (store / "pd_up" / "c" / "0" / "5" / "0").unlink()
    (store / "pd_shot" / "c" / "0" / "7" / "0").write_bytes(b"")
    (store / "pd_shot" / "c" / "0" / "notes").write_bytes(b"not a chunk")
    (store / "pd_shot" / "c" / "0" / "99").mkdir()
    assert np.flatnonzero(~listed(store, study, every).whole).tolist() == [5, 7]
    assert not listed(store, study, ~every).whole.any()


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
    expected = [[0, 2], [0, 0], [0, 3]]
    assert chunk_sizes(here, (3, 2)).tolist() == chunk_sizes(there, (3, 2)).tolist() == expected
    (tmp_path / "scalar").write_bytes(b"four")
    assert chunk_sizes(tmp_path / "scalar", ()) == 4 and chunk_sizes(tmp_path / "none", ()) == 0


def test_status_says_what_there_is_of_a_run(tmp_path):
    outcome = quiet(small(draws={"number": 20, "batch": 10}), tmp_path / "small.zarr")
    found = status(outcome.store)
    assert found.draws_done == 72 * 20 and found.workers == 1
    assert found.rate > 0 and found.left == 0
    assert found.heartbeat == float("inf") and found.bytes > 72 * 8
