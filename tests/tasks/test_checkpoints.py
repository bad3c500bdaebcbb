"""Blocks whose draws take long: computed in pieces, stopped, killed and gone on with."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_studies import STUDY_MAPPING, file_digests, receipt_blocks, run_serially, small_spec

from sweep.model.sampling import samplers
from sweep.storage.locations import ObjectPath
from sweep.tasks.driver import extend, resume, run
from sweep.tasks.engine import journal, progress, worker
from sweep.tasks.engine.block_study import EarlierResults, PartialResults
from sweep.tasks.engine.journal import Checkpoint
from sweep.tasks.engine.progress import Progress, StoreError
from sweep.tasks.studies.grid_study import GridStudy
from sweep.tasks.studies.store_summary import status
from sweep.tasks.studies.store_verification import pack_store, verify

QUICK = {
    **STUDY_MAPPING["instrument"],
    "laser": {**STUDY_MAPPING["instrument"]["laser"], "power": "0.1 W"},
}
QUICK["processing"] = {
    **QUICK["processing"], "fft_size": "2^11", "tnr": 6,
    "acquisition_delay": "41 us",  # 3.4 us are recorded; the echo of 6 km is there from 40.03 us on
}  # fmt: skip

KINDS = {
    "fixed": {"number": 500, "batch": 70},
    "noise alone": {"number": 500, "batch": 200, "method": "noise"},
    "adaptive": {"limit": 700, "batch": 60},
    "spectra": {"number": 90, "batch": 40, "method": "spectra"},
    "adaptive spectra": {"limit": 90, "batch": 25, "method": "spectra"},
}


def drawn_spec(kind="fixed", ranges=("2 km",), **draws):
    """Points that are drawn; their ground is rough but where noise alone is to be random."""
    rough = {**STUDY_MAPPING["target"], "roughness": "10 um", "reflectance": 0.2}
    return small_spec(
        instrument=QUICK, target=STUDY_MAPPING["target"] if kind == "noise alone" else rough,
        draws=KINDS[kind] | draws, accuracy={"tolerance": 0.03}, storage={},
        axes={"target.range": list(ranges)},
    )  # fmt: skip


def cut(assign=setattr, *, piece=90, rows=25, samples=1 << 13, seconds=-1.0):
    """Take so few draws at once; by default save them each time, as though they had taken long."""
    assign(samplers, "NOISE_DRAWS_PER_STEP", piece)
    assign(samplers, "DRAWS_PER_BATCH", rows)
    assign(samplers, "SPECTRUM_SAMPLES_PER_STEP", samples)
    assign(worker, "CHECKPOINT_INTERVAL_SECONDS", seconds)


@pytest.fixture
def saved(monkeypatch):
    """Points of a block that were saved, piece by piece."""
    points, real = [], journal.write_checkpoint

    def write(path, study_id, block, checkpoint):
        points.append(checkpoint.n_points_done)
        real(path, study_id, block, checkpoint)

    monkeypatch.setattr(journal, "write_checkpoint", write)
    cut(monkeypatch.setattr)
    return points


@pytest.fixture(scope="module")
def undivided_stores(tmp_path_factory):
    """Stores computed in one piece, by what is drawn."""
    stores = {}

    def computed_store(kind, ranges=("2 km",)):
        if (kind, ranges) not in stores:
            store = tmp_path_factory.mktemp("whole") / "whole.zarr"
            with pytest.MonkeyPatch.context() as context:
                cut(context.setattr, piece=1 << 16, rows=4096, samples=1 << 18, seconds=600.0)
                context.setattr(journal, "write_checkpoint", None)  # short blocks are never saved
                assert run_serially(drawn_spec(kind, ranges), store).complete
            stores[kind, ranges] = file_digests(store)
        return stores[kind, ranges]

    return computed_store


class PointsProgress(Progress):
    """Notes how far a run is, and does something then."""

    def __init__(self, then=lambda progress: None):
        self.points, self.then = [], then

    def begin(self, *, points, done, unit):
        self.points.append(done)

    def advance(self, *, points, failed):
        if points:
            self.points.append(self.points[-1] + points)
            self.then(self)


PLACES = [{"scheduler": "none"}, {"workers": 2, "processes": False}]


def interrupted(spec, store, pieces=2, place=PLACES[0]):
    """A run that is told to stop, once, as soon as some pieces of a block are there."""
    progress = PointsProgress(
        lambda progress: len(progress.points) == 1 + pieces and os.kill(os.getpid(), signal.SIGINT)
    )
    outcome = run(spec, store=store, progress=progress, **place)
    assert outcome.stop_reason == "interrupted" and not outcome.complete
    return progress


def left(store):
    """Names of what is saved of blocks that are begun."""
    return sorted(file.name for file in (store / ".sweep").glob("begun*"))


@pytest.mark.parametrize(
    "kind, place",
    [
        *((kind, PLACES[0]) for kind in KINDS if kind != "spectra"),
        pytest.param("spectra", PLACES[0], marks=pytest.mark.slow),
        ("fixed", PLACES[1]),
    ],
)
def test_pieces_of_a_block_come_to_the_same_bytes_and_are_reported(
    kind, place, undivided_stores, saved, tmp_path
):
    progress, store = PointsProgress(), tmp_path / "pieces.zarr"
    assert run(drawn_spec(kind), store=store, progress=progress, **place).complete
    assert file_digests(store) == undivided_stores(kind)
    assert len(saved) >= 3 and saved == sorted(set(saved)) and 0 < saved[0] < saved[-1] < 1
    assert progress.points == [0, *saved, 1] and receipt_blocks(store) == [0] and left(store) == []


@pytest.mark.parametrize(
    "kind",
    ["fixed", *(pytest.param(k, marks=pytest.mark.slow) for k in KINDS if k != "fixed")],
)
def test_a_block_of_several_points_is_stopped_at_any_of_them(
    kind, undivided_stores, saved, tmp_path, monkeypatch
):
    ranges = ("100 m", "1 km", "2 km", "6 km")
    expected = undivided_stores(kind, ranges)
    monkeypatch.setattr("sweep.tasks.studies.grid_study.POINTS_PER_MODEL_CALL_MAX", 2)
    assert run_serially(drawn_spec(kind, ranges), tmp_path / "pieces.zarr").complete
    assert file_digests(tmp_path / "pieces.zarr") == expected
    assert any(0 < points < 2 for points in saved) and any(2 < points < 4 for points in saved)


@pytest.mark.parametrize("place", PLACES)
def test_one_ctrl_c_stops_after_a_piece_and_resume_goes_on_from_there(
    place, undivided_stores, saved, tmp_path
):
    store = tmp_path / "stopped.zarr"
    interrupted(drawn_spec(), store, place=place)
    assert len(saved) == 2 and left(store) == ["begun-0"] and receipt_blocks(store) == []
    assert status(store).points_in_unfinished_blocks == saved[-1] and status(store).points_done == 0
    assert verify(store)[0].is_undamaged and not verify(store)[0].complete
    with pytest.raises(StoreError, match="lacks 1 block"):
        pack_store(store, tmp_path / "packed.zarr")
    progress = PointsProgress()
    assert resume(store, progress=progress, **place).complete
    assert progress.points[0] == saved[1] < saved[2] and saved == sorted(set(saved))
    assert file_digests(store) == undivided_stores("fixed") and left(store) == []
    assert status(store).points_in_unfinished_blocks == 0


KILLED = """
import os, sys
from pathlib import Path
from test_checkpoints import cut, drawn_spec, run_serially
from sweep.tasks.engine import journal

def write(path, study_id, block, found, real=journal.write_checkpoint):
    real(path, study_id, block, found)
    if found.n_points_done > 0.5:
        os.kill(os.getpid(), 9)

journal.write_checkpoint = write
cut()
run_serially(drawn_spec(sys.argv[2]), Path(sys.argv[1]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fixed", "spectra"])
def test_what_is_saved_outlives_a_kill_and_is_not_drawn_again(
    kind, undivided_stores, saved, tmp_path, monkeypatch
):
    store = tmp_path / "killed.zarr"
    python_path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, str(store), kind],
        env={**os.environ, "PYTHONPATH": python_path},
    )
    assert killed.returncode == -signal.SIGKILL and left(store) == ["begun-0"]
    before = status(store).points_in_unfinished_blocks * drawn_spec(kind).draws.number
    monkeypatch.setattr(GridStudy, "compile_kernels", lambda study: None)  # it draws once
    pieces, real = [], samplers.Sampler.draw

    def take(self, points, number):
        pieces.append((self.number[points[0]], number))
        real(self, points, number)

    monkeypatch.setattr(samplers.Sampler, "draw", take)
    assert quiet_resume(store).complete
    assert pieces[0][0] == before > 0
    assert sum(number for _, number in pieces) == drawn_spec(kind).draws.number - before
    assert file_digests(store) == undivided_stores(kind) and left(store) == []


def quiet_resume(store, **changes):
    return resume(store, scheduler="none", progress=False, **changes)


def flipped(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def cut_short(file):
    file.write_bytes(file.read_bytes()[:-1])


def emptied(file):
    file.write_bytes(b"")


def anothers(file):
    """A saved piece of the same block of another study."""
    interrupted(drawn_spec(number=600), file.parents[2] / "other.zarr")
    file.write_bytes((file.parents[2] / "other.zarr" / ".sweep" / file.name).read_bytes())


@pytest.mark.parametrize("damage", [flipped, cut_short, emptied, anothers])
def test_what_is_saved_and_damaged_or_foreign_is_drawn_again(
    damage, undivided_stores, saved, tmp_path
):
    store = tmp_path / "damaged.zarr"
    interrupted(drawn_spec(), store)
    damage(store / ".sweep" / "begun-0")
    assert status(store).points_in_unfinished_blocks == 0
    saved.clear()
    assert quiet_resume(store).complete
    assert saved[0] < 0.5 and file_digests(store) == undivided_stores("fixed") and left(store) == []


@pytest.mark.parametrize("place", [Path, lambda path: ObjectPath("memory://bucket", str(path))])
def test_what_is_saved_is_read_as_it_was_in_a_folder_and_in_an_object_store(place, tmp_path):
    store = place(tmp_path / "store.zarr")
    part = PartialResults(
        np.array([4, 2]), {"pd_up": np.array([0.5, np.nan]), "n": np.array([[1], [2]])}
    )
    assert (
        journal.read_checkpoint(store, "one", 7) == Checkpoint()
        and journal.read_checkpoint_point_counts(store, "one") == {}
    )
    for points in (0.5, 0.25):  # less than there is takes no place
        journal.write_checkpoint(
            store, "one", 7, Checkpoint(EarlierResults(unfinished=part), points, 1.5)
        )
    checkpoint = journal.read_checkpoint(store, "one", 7)
    assert (checkpoint.n_points_done, checkpoint.seconds) == (
        0.5,
        1.5,
    ) and not checkpoint.results.finished.indices_in_block.size
    np.testing.assert_array_equal(
        checkpoint.results.unfinished.indices_in_block, part.indices_in_block
    )
    for name, values in part.results.items():
        np.testing.assert_array_equal(checkpoint.results.unfinished.results[name], values)
    assert (
        journal.read_checkpoint_point_counts(store, "one") == {7: 0.5}
        and journal.read_checkpoint_point_counts(store, "two") == {}
    )
    journal.delete_checkpoints(store, 7)
    journal.delete_checkpoints(store, 7)
    assert journal.read_checkpoint_point_counts(store, "one") == {}


def test_an_extended_study_goes_on_in_pieces_too(undivided_stores, saved, tmp_path):
    store = tmp_path / "extended.zarr"
    assert run_serially(drawn_spec(number=170), store).complete
    saved.clear()
    changes = {"draws.number": 500}
    assert extend(store, changes=changes, scheduler="none", progress=False).complete
    assert (
        len(saved) >= 2
        and saved[0] > 170 / 500
        and file_digests(store) == undivided_stores("fixed")
    )
    assert left(store) == []


def test_workers_that_do_not_find_what_others_saved_end_the_run(saved, tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "read_checkpoint", lambda *place: Checkpoint())
    with pytest.raises(StoreError, match="do all of them see the same store"):
        run_serially(drawn_spec(), tmp_path / "lost.zarr")
    assert len(saved) == 2


def test_a_block_may_take_no_longer_in_pieces_than_at_once(saved, tmp_path):
    store = tmp_path / "slow.zarr"
    interrupted(drawn_spec(), store)
    place = store, status(store).study_id, 0
    checkpoint = journal.read_checkpoint(*place)
    journal.delete_checkpoints(store, 0)
    journal.write_checkpoint(*place, checkpoint._replace(seconds=100.0))
    outcome = quiet_resume(store, block_timeout=99.0)
    assert "longer than the 99 s" in outcome.failures[0].error and left(store) == ["begun-0"]
    assert quiet_resume(store, block_timeout=1000.0, retry_failed=True).complete
    assert left(store) == []


def test_the_time_of_a_block_is_that_of_all_its_pieces(saved, tmp_path):
    store = tmp_path / "timed.zarr"
    interrupted(drawn_spec(), store)
    spent = journal.read_checkpoint(store, status(store).study_id, 0).seconds
    outcome = quiet_resume(store)
    assert outcome.work_seconds > spent > 0


def test_lines_tell_the_part_of_a_point(capsys, monkeypatch):
    monkeypatch.setattr(progress, "PROGRESS_LINE_INTERVAL_SECONDS", -1.0)
    lines = progress.ProgressLines()
    lines.begin(points=2, done=0, unit="points")
    for part in (0.31, 0.69, 1.0):
        lines.advance(points=part, failed=0)
    starts = [line.split(",")[0] for line in capsys.readouterr().err.splitlines()]
    assert starts == ["0 of 2 points", "0.31 of 2 points", "1 of 2 points", "2 of 2 points"]
