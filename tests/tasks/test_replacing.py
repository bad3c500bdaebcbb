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
from small import STUDY, copied, failing, quiet, small, tree

import sweep
from sweep.cli import main
from sweep.storage.locations import successor
from sweep.storage.opening import ReplacedError
from sweep.tasks import cluster
from sweep.tasks.driver import extend, resume, run
from sweep.tasks.journal import Lock
from sweep.tasks.progress import ClusterError, StoreError
from sweep.tasks.spectra_export import write
from sweep.tasks.summary import status
from sweep.tasks.verify import _pack_array, pack, verify

POWERS = {**STUDY["axes"], "instrument.laser.power": ["1 W", "2 W", "3 W"]}
NOWHERE = {"scheduler": "tcp://127.0.0.1:9"}


def larger():
    return small(axes=POWERS)


def begun(store, tmp_path):
    """An extension of a store of which no block is done."""
    outcome = extend(store, larger(), progress=False, scheduler="none",
                     evaluate=failing(set(range(99)), tmp_path / "log"))  # fmt: skip
    assert outcome.blocks_done == 0 and successor(store).exists()
    (tmp_path / "log").unlink()


@pytest.mark.parametrize("under_way", [False, True], ids=["nothing", "an extension"])
def test_overwriting_without_a_cluster_takes_nothing_away(
    undisturbed, tmp_path, monkeypatch, under_way
):
    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT", 0.5)
    store = copied(undisturbed, tmp_path)
    if under_way:
        begun(store, tmp_path)
        before = tree(successor(store))
    with pytest.raises(ClusterError):
        quiet(small(seed=9), store, overwrite=True, **NOWHERE)
    assert tree(store) == tree(undisturbed) and status(store).complete
    if under_way:
        assert tree(successor(store)) == before
    else:
        assert list(tmp_path.iterdir()) == [store]


def test_what_is_to_replace_a_store_does_so_once_it_is_complete(undisturbed, tmp_path):
    store, other = copied(undisturbed, tmp_path), small(seed=9)
    failed = failing({3}, tmp_path / "log")
    outcome = quiet(other, store, scheduler="none", overwrite=True, evaluate=failed)
    assert not outcome.complete and tree(store) == tree(undisturbed)
    told = CliRunner().invoke(main, ["status", str(store)]).output
    assert "complete" in told and f"being replaced: sweep status {successor(store)}" in told
    assert resume(outcome.store, progress=False, scheduler="none", retry_failed=True).complete
    assert tree(store) == tree(quiet(other, tmp_path / "at_once.zarr").store)
    assert not successor(store).exists()


def test_a_forgotten_extension_never_takes_another_studys_place(undisturbed, tmp_path):
    store, other = copied(undisturbed, tmp_path), small(seed=9)
    begun(store, tmp_path)
    assert quiet(other, store, scheduler="none", overwrite=True).complete
    assert resume(store, progress=False, scheduler="none").blocks_computed == 0
    assert status(store).study_id == other.id and list(tmp_path.iterdir()) == [store]


@pytest.mark.parametrize("then", ["gone", "another study"])
def test_an_extension_of_what_was_removed_by_hand_is_refused(undisturbed, tmp_path, then):
    store = copied(undisturbed, tmp_path)
    begun(store, tmp_path)
    shutil.rmtree(store)
    if then != "gone":
        made = quiet(small(seed=9, axes={"target.range": ["1 km"]}), tmp_path / "made.zarr")
        os.rename(made.store, store)
    for command in (
        lambda: resume(store, progress=False, scheduler="none"),
        lambda: quiet(larger(), store),
    ):
        with pytest.raises(StoreError, match=f"{then}|holds another study"):
            command()
    assert store.exists() == (then != "gone") and successor(store).exists()
    assert quiet(small(seed=9), store, scheduler="none", overwrite=True).complete
    assert status(store).study_id == small(seed=9).id and list(tmp_path.iterdir()) == [store]


def test_an_extension_that_is_refused_leaves_nothing(undisturbed, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT", 0.5)
    store = copied(undisturbed, tmp_path)
    lock = Lock(store)
    with pytest.raises(StoreError, match="is being written by process"):
        extend(store, larger(), progress=False, scheduler="none")
    lock.release()
    with pytest.raises(ClusterError):
        extend(store, larger(), progress=False, **NOWHERE)
    assert list(tmp_path.iterdir()) == [store]


@pytest.mark.parametrize("how", [pytest.param("extend", marks=pytest.mark.slow), "overwrite"])
def test_links_to_stores_stay_and_lead_to_the_new_one(undisturbed, tmp_path, how):
    (tmp_path / "disk").mkdir()
    store, link = copied(undisturbed, tmp_path / "disk"), tmp_path / "link.zarr"
    link.symlink_to(store)
    if how == "extend":
        assert extend(link, larger(), progress=False, scheduler="none").complete
    else:
        assert quiet(larger(), link, scheduler="none", overwrite=True).complete
    assert link.is_symlink() and link.resolve() == store
    os.rename(store, store.with_name(f".copy.zarr.replaced-{dead()}-ab12cd34"))
    assert status(link).study_id == larger().id
    assert list((tmp_path / "disk").iterdir()) == [store]


def test_a_dataset_that_is_open_says_that_its_store_was_extended(undisturbed, tmp_path):
    store = copied(undisturbed, tmp_path)
    (store / "pd_up" / "zarr.json").unlink()
    kept = sweep.open(store)
    assert verify(store, repair=True, progress=False)  # the same study's metadata, anew
    values = kept.snr_up.values
    opened, scattered = sweep.open(store), sweep.open(store).snr_up.chunk(range=1)
    assert extend(store, larger(), progress=False, scheduler="none").complete
    for array in (kept.pd_up, opened.snr_up, scattered, opened.effects):
        with pytest.raises(ReplacedError, match="open it again"):
            array.compute()
    again = sweep.open(store).snr_up.sel(power=[1, 3])
    np.testing.assert_array_equal(again.values, values)


def test_a_copy_is_never_of_two_studies(undisturbed, tmp_path, monkeypatch):
    store, real = copied(undisturbed, tmp_path), _pack_array

    def extended_meanwhile(path, output):
        real(path, output)
        if status(store).study_id == small().id:
            run(small(seed=9), store=store, progress=False, scheduler="none", overwrite=True)

    monkeypatch.setattr("sweep.tasks.verify._pack_array", extended_meanwhile)
    with pytest.raises(StoreError, match="extended or replaced while it was copied"):
        pack(store, tmp_path / "copy_final.zarr", progress=False)
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
def test_the_next_command_clears_up_after_dead_processes_only(undisturbed, tmp_path, command):
    store, maker = copied(undisturbed, tmp_path), f"{socket.gethostname()}-{dead()}-ab12cd34"
    left = [f".copy.zarr.{state}-{maker}" for state in ("creating", "removing", "replaced")]
    left += [f".copy.zarr.{state}-{dead()}-ab12cd34" for state in ("creating", "packing")]
    for name in left:
        whole = "replaced" in name  # it is renamed once more before it is removed
        shutil.copytree(store if whole else store / "pd_up", tmp_path / name)
    living = tmp_path / f".copy.zarr.creating-{socket.gethostname()}-{os.getpid()}-ab12cd34"
    living.mkdir()
    command(store)
    assert sorted(tmp_path.iterdir()) == sorted([store, living])
    os.rename(store, tmp_path / f".copy.zarr.replaced-{maker}")  # and killed before what follows
    command(store)
    assert sorted(tmp_path.iterdir()) == sorted([store, living])
    assert tree(store) == tree(undisturbed)


def test_spectra_replace_nothing_but_spectra(undisturbed, tmp_path):
    store, spectra = copied(undisturbed, tmp_path), xr.Dataset({"spectrum": ("draw", [1.0])})
    np.savez(tmp_path / "mine.npz", spectrum=[1.0])
    (tmp_path / "mine.zarr").mkdir()
    (tmp_path / "mine.zarr" / "notes.txt").write_text("mine")  # an empty folder is a free place
    before = tree(tmp_path)
    for path in (store, tmp_path / "mine.npz", tmp_path / "mine.zarr"):
        with pytest.raises(StoreError, match="holds no spectra"):
            write(spectra, path, overwrite=True)
    assert tree(tmp_path) == before
