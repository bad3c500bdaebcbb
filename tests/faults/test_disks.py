"""Disks that are full, read-only or gone in the midst of a study."""

import os
import shutil
import subprocess

import pytest
from small_studies import file_digests, receipt_blocks, small_spec

from sweep.tasks.driver import resume, run
from sweep.tasks.engine.progress import StoreError
from sweep.tasks.studies.store_summary import status
from sweep.tasks.studies.store_verification import verify


@pytest.fixture
def disk(tmp_path):
    """A small disk of our own."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = os.geteuid() == 0 and mount("-t", "tmpfs", "-o", "size=64k", "tmpfs", str(place))
    if not mounted:
        pytest.skip("a disk can't be mounted here")
    yield place
    subprocess.run(["umount", "--lazy", str(place)], check=True)


def mount(*options: str) -> bool:
    try:
        return subprocess.run(["mount", *options], capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


def committed_is_whole(store) -> None:
    (report,) = verify(store, progress=False)
    assert report.is_undamaged and report.undamaged_blocks == len(set(receipt_blocks(store))) < 12


@pytest.mark.parametrize(
    "size, place", [("640k", {"scheduler": "none"}), ("1M", {"workers": 2, "processes": False})]
)
def test_a_full_disk_stops_a_study_that_goes_on_when_there_is_room(
    disk, serial_digests, size, place
):
    store = disk / "small.zarr"
    assert mount("-o", f"remount,size={size}", str(disk))
    outcome = run(small_spec(), store=store, progress=False, **place)
    assert not outcome.complete
    assert "No space left on device" in outcome.stop_reason and "make room" in outcome.stop_reason
    committed_is_whole(store)
    before = receipt_blocks(store)
    assert len(before) == outcome.blocks_done
    second_outcome = resume(store, progress=False, **place)
    assert not second_outcome.complete and "make room" in second_outcome.stop_reason
    assert mount("-o", "remount,size=16M", str(disk))
    assert resume(store, progress=False, scheduler="none").complete
    assert receipt_blocks(store)[: len(before)] == before and sorted(receipt_blocks(store)) == list(
        range(12)
    )
    assert file_digests(store) == serial_digests


def test_a_disk_that_is_full_from_the_start_is_left_as_it_was(disk):
    with pytest.raises(StoreError, match="can't be made: No space left on device"):
        run(small_spec(), store=disk / "small.zarr", progress=False, scheduler="none")
    assert list(disk.iterdir()) == []


def test_a_disk_without_inodes_is_not_reported_as_full(disk):
    store = disk / "small.zarr"
    assert mount("-o", "remount,size=16M,nr_inodes=300", str(disk))
    outcome = run(small_spec(), store=store, progress=False, scheduler="none")
    assert not outcome.complete and "No space left" not in outcome.stop_reason
    assert "(No inodes left on device): remove files from its disk" in outcome.stop_reason
    committed_is_whole(store)
    other = disk / "other.zarr"
    with pytest.raises(StoreError, match=r"can't be made: No inodes left on device; remove f"):
        run(small_spec(), store=other, progress=False, scheduler="none")
    assert not other.exists()
    assert mount("-o", "remount,nr_inodes=9000", str(disk))
    assert resume(store, progress=False, scheduler="none").complete


def at_block(number, happening):
    """The model, with something that happens, once, before a block."""
    happened = []

    def evaluate(study, block):
        if block == number and not happened:
            happened.append(block)
            happening()
        return study.evaluate(block)

    return evaluate


def test_a_disk_that_becomes_read_only_stops_a_study_that_goes_on_later(disk, serial_digests):
    store = disk / "small.zarr"
    assert mount("-o", "remount,size=16M", str(disk))
    evaluate = at_block(5, lambda: mount("-o", "remount,ro", str(disk)) or pytest.fail("busy"))
    outcome = run(small_spec(), store=store, progress=False, scheduler="none", evaluate=evaluate)
    assert outcome.blocks_done == 5
    assert "Read-only file system" in outcome.stop_reason and "for writing" in outcome.stop_reason
    committed_is_whole(store)
    assert not status(store).complete  # with the lock that could not be given up
    with pytest.raises(StoreError, match="can't be locked: Read-only file system"):
        resume(store, progress=False, scheduler="none")
    assert mount("-o", "remount,rw", str(disk))
    assert resume(store, progress=False, scheduler="none").complete
    assert (
        sorted(receipt_blocks(store)) == list(range(12)) and file_digests(store) == serial_digests
    )


@pytest.mark.parametrize("place", [{"scheduler": "none"}, {"workers": 2, "processes": False}])
def test_a_folder_that_vanishes_stops_a_study_that_goes_on_when_it_is_back(
    tmp_path, serial_digests, place
):
    store, other_path = tmp_path / "small.zarr", tmp_path / "elsewhere.zarr"
    evaluate = at_block(5, lambda: shutil.move(store, other_path))
    outcome = run(small_spec(), store=store, progress=False, evaluate=evaluate, **place)
    assert "small.zarr is no longer there" in outcome.stop_reason and not outcome.complete
    with pytest.raises(StoreError, match=r"there is no store|not a Zarr store"):
        resume(store, progress=False, scheduler="none")
    shutil.rmtree(store, ignore_errors=True)  # what another worker was at meanwhile
    before = receipt_blocks(other_path)
    assert before
    shutil.move(other_path, store)
    assert resume(store, progress=False, scheduler="none").complete
    assert receipt_blocks(store)[: len(before)] == before and sorted(receipt_blocks(store)) == list(
        range(12)
    )
    assert file_digests(store) == serial_digests
