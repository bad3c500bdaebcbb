"""Stores replaced by others: one of the two is whole at any instant, and no reader mixes them."""

import os
import shutil
import socket
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from small_studies import (
    STUDY_MAPPING,
    copy_store,
    file_digests,
    make_failing_evaluate,
    run_serially,
    small_spec,
)

import sweep
from sweep.cli import main
from sweep.storage.locations import staging_path_for
from sweep.storage.store_format import StoreReplacedError
from sweep.tasks.driver import extend, resume, run
from sweep.tasks.engine import cluster_connection
from sweep.tasks.engine.journal import StoreLock
from sweep.tasks.engine.progress import ClusterError, StoreError
from sweep.tasks.studies.spectra_export import write_spectra
from sweep.tasks.studies.store_summary import status
from sweep.tasks.studies.store_verification import _pack_array, pack_store, verify

POWERS = {**STUDY_MAPPING["axes"], "instrument.laser.power": ["1 W", "2 W", "3 W"]}
NOWHERE = {"scheduler": "tcp://127.0.0.1:9"}


def larger():
    return small_spec(axes=POWERS)


def start_extension(store, tmp_path):
    """An extension of a store of which no block is done."""
    outcome = extend(store, larger(), progress=False, scheduler="none",
                     evaluate=make_failing_evaluate(set(range(99)), tmp_path / "log"))  # fmt: skip
    assert outcome.blocks_done == 0 and staging_path_for(store).exists()
    (tmp_path / "log").unlink()


@pytest.mark.parametrize("under_way", [False, True], ids=["nothing", "an extension"])
def test_overwriting_without_a_cluster_takes_nothing_away(
    serial_store, tmp_path, monkeypatch, under_way
):
    monkeypatch.setattr(cluster_connection, "CONNECT_TIMEOUT_SECONDS", 0.5)
    store = copy_store(serial_store, tmp_path)
    if under_way:
        start_extension(store, tmp_path)
        before = file_digests(staging_path_for(store))
    with pytest.raises(ClusterError):
        run_serially(small_spec(seed=9), store, overwrite=True, **NOWHERE)
    assert file_digests(store) == file_digests(serial_store) and status(store).complete
    if under_way:
        assert file_digests(staging_path_for(store)) == before
    else:
        assert list(tmp_path.iterdir()) == [store]


def test_what_is_to_replace_a_store_does_so_once_it_is_complete(serial_store, tmp_path):
    store, other = copy_store(serial_store, tmp_path), small_spec(seed=9)
    failed = make_failing_evaluate({3}, tmp_path / "log")
    outcome = run_serially(other, store, scheduler="none", overwrite=True, evaluate=failed)
    assert not outcome.complete and file_digests(store) == file_digests(serial_store)
    output = CliRunner().invoke(main, ["status", str(store)]).output
    assert (
        "complete" in output and f"being replaced: sweep status {staging_path_for(store)}" in output
    )
    assert resume(outcome.store, progress=False, scheduler="none", retry_failed=True).complete
    assert file_digests(store) == file_digests(run_serially(other, tmp_path / "at_once.zarr").store)
    assert not staging_path_for(store).exists()


def test_a_forgotten_extension_never_takes_another_studys_place(serial_store, tmp_path):
    store, other = copy_store(serial_store, tmp_path), small_spec(seed=9)
    start_extension(store, tmp_path)
    assert run_serially(other, store, scheduler="none", overwrite=True).complete
    assert resume(store, progress=False, scheduler="none").blocks_computed == 0
    assert status(store).study_id == other.id and list(tmp_path.iterdir()) == [store]


@pytest.mark.parametrize("then", ["gone", "another study"])
def test_an_extension_of_what_was_removed_by_hand_is_refused(serial_store, tmp_path, then):
    store = copy_store(serial_store, tmp_path)
    start_extension(store, tmp_path)
    shutil.rmtree(store)
    if then != "gone":
        new_outcome = run_serially(
            small_spec(seed=9, axes={"target.range": ["1 km"]}), tmp_path / "made.zarr"
        )
        os.rename(new_outcome.store, store)
    for command in (
        lambda: resume(store, progress=False, scheduler="none"),
        lambda: run_serially(larger(), store),
    ):
        with pytest.raises(StoreError, match=f"{then}|holds another study"):
            command()
    assert store.exists() == (then != "gone") and staging_path_for(store).exists()
    assert run_serially(small_spec(seed=9), store, scheduler="none", overwrite=True).complete
    assert status(store).study_id == small_spec(seed=9).id and list(tmp_path.iterdir()) == [store]


def test_an_extension_that_is_refused_leaves_nothing(serial_store, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster_connection, "CONNECT_TIMEOUT_SECONDS", 0.5)
    store = copy_store(serial_store, tmp_path)
    lock = StoreLock(store)
    with pytest.raises(StoreError, match="is being written by process"):
        extend(store, larger(), progress=False, scheduler="none")
    lock.release()
    with pytest.raises(ClusterError):
        extend(store, larger(), progress=False, **NOWHERE)
    assert list(tmp_path.iterdir()) == [store]


@pytest.mark.parametrize("link_kind", [pytest.param("extend", marks=pytest.mark.slow), "overwrite"])
def test_links_to_stores_stay_and_lead_to_the_new_one(serial_store, tmp_path, link_kind):
    (tmp_path / "disk").mkdir()
    store, link = copy_store(serial_store, tmp_path / "disk"), tmp_path / "link.zarr"
    link.symlink_to(store)
    if link_kind == "extend":
        assert extend(link, larger(), progress=False, scheduler="none").complete
    else:
        assert run_serially(larger(), link, scheduler="none", overwrite=True).complete
    assert link.is_symlink() and link.resolve() == store
    os.rename(store, store.with_name(f".copy.zarr.replaced-{dead()}-ab12cd34"))
    assert status(link).study_id == larger().id
    assert list((tmp_path / "disk").iterdir()) == [store]


def test_a_dataset_that_is_open_says_that_its_store_was_extended(serial_store, tmp_path):
    store = copy_store(serial_store, tmp_path)
    (store / "pd_up" / "zarr.json").unlink()
    dataset = sweep.open(store)
    assert verify(store, repair=True, progress=False)  # the same study's metadata, anew
    values = dataset.snr_up.values
    opened, scattered = sweep.open(store), sweep.open(store).snr_up.chunk(range=1)
    assert extend(store, larger(), progress=False, scheduler="none").complete
    for array in (dataset.pd_up, opened.snr_up, scattered, opened.effects):
        with pytest.raises(StoreReplacedError, match="open it again"):
            array.compute()
    reopened = sweep.open(store).snr_up.sel(power=[1, 3])
    np.testing.assert_array_equal(reopened.values, values)


def test_a_copy_is_never_of_two_studies(serial_store, tmp_path, monkeypatch):
    store, real = copy_store(serial_store, tmp_path), _pack_array

    def extended_meanwhile(path, output):
        real(path, output)
        if status(store).study_id == small_spec().id:
            run(small_spec(seed=9), store=store, progress=False, scheduler="none", overwrite=True)

    monkeypatch.setattr("sweep.tasks.studies.store_verification._pack_array", extended_meanwhile)
    with pytest.raises(StoreError, match="extended or replaced while it was copied"):
        pack_store(store, tmp_path / "copy_final.zarr", progress=False)
    assert list(tmp_path.iterdir()) == [store]


def dead() -> int:
    """Number of a process that is no more."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


COMMANDS = {
    "status": lambda store: status(store),
    "open": lambda store: sweep.open(store),
    "resume": lambda store: resume(store, progress=False, scheduler="none"),
    "verify": lambda store: verify(store, progress=False),
}


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_the_next_command_clears_up_after_dead_processes_only(serial_store, tmp_path, command):
    store, maker = copy_store(serial_store, tmp_path), f"{socket.gethostname()}-{dead()}-ab12cd34"
    left = [f".copy.zarr.{state}-{maker}" for state in ("creating", "removing", "replaced")]
    left += [f".copy.zarr.{state}-{dead()}-ab12cd34" for state in ("creating", "packing")]
    for name in left:
        is_complete = "replaced" in name  # it is renamed once more before it is removed
        shutil.copytree(store if is_complete else store / "pd_up", tmp_path / name)
    living = tmp_path / f".copy.zarr.creating-{socket.gethostname()}-{os.getpid()}-ab12cd34"
    living.mkdir()
    command(store)
    assert sorted(tmp_path.iterdir()) == sorted([store, living])
    os.rename(store, tmp_path / f".copy.zarr.replaced-{maker}")  # and killed before what follows
    command(store)
    assert sorted(tmp_path.iterdir()) == sorted([store, living])
    assert file_digests(store) == file_digests(serial_store)


def test_spectra_replace_nothing_but_spectra(serial_store, tmp_path):
    store, spectra = copy_store(serial_store, tmp_path), xr.Dataset({"spectrum": ("draw", [1.0])})
    np.savez(tmp_path / "mine.npz", spectrum=[1.0])
    (tmp_path / "mine.zarr").mkdir()
    (tmp_path / "mine.zarr" / "notes.txt").write_text("mine")  # an empty folder is a free place
    before = file_digests(tmp_path)
    for path in (store, tmp_path / "mine.npz", tmp_path / "mine.zarr"):
        with pytest.raises(StoreError, match="holds no spectra"):
            write_spectra(spectra, path, overwrite=True)
    assert file_digests(tmp_path) == before
