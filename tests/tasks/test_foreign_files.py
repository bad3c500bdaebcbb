"""Files of users and other programs in a store's folder: listed, carried over, never lost."""

import json
import os
import shutil
import threading
from contextlib import suppress
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner
from small_studies import (
    STUDY_MAPPING,
    RecordingProgress,
    copy_store,
    file_digests,
    make_failing_evaluate,
    run_serially,
    small_mapping,
    small_spec,
)

from sweep.cli import main
from sweep.storage import locations
from sweep.storage.foreign_files import list_foreign_files
from sweep.storage.locations import can_create_store, recover_interrupted_replace, staging_path_for
from sweep.tasks.driver import extend, resume, run
from sweep.tasks.engine import journal
from sweep.tasks.engine.progress import StoreError
from sweep.tasks.studies.store_verification import pack_store, verify

POWERS = {**STUDY_MAPPING["axes"], "instrument.laser.power": ["1 W", "2 W", "3 W"]}

MINE = {
    "notes.txt": "mine", "plots/a.png": "picture", "plots/more/b.png": "another",
    "pd_up/remark.txt": "odd", ".sweep/todo.txt": "do", "pd_up/c/0/here.txt": "lost?",
    "my.zarr/zarr.json": "{}", "my.zarr/c/0/0": "chunk", "download.partial": "half",
    "reflectance": "a file where the larger study has an array",
}  # fmt: skip
FOREIGN_OBJECTS = [
    ".sweep/todo.txt", "download.partial", "my.zarr/", "notes.txt", "pd_up/c/0/here.txt",
    "pd_up/remark.txt", "plots/", "reflectance",
]  # fmt: skip
LITTER = [".snakemake_timestamp", ".DS_Store", ".nfs00000000012345", "pd_up/.DS_Store", "._notes"]


def put(store: Path, files=MINE) -> None:
    for name, text in files.items():
        (store / name).parent.mkdir(parents=True, exist_ok=True)
        (store / name).write_text(text)


def own_files(store: Path, files=MINE) -> dict[str, str]:
    return {name: (store / name).read_text() for name in files if (store / name).is_file()}


def without_mine(store: Path) -> dict:
    names = {*MINE, "reflectance.1"}
    return {
        name: content for name, content in file_digests(store).items() if str(name) not in names
    }


@pytest.fixture(scope="module")
def larger(tmp_path_factory):
    """The larger study, run at once."""
    path = tmp_path_factory.mktemp("larger") / "larger.zarr"
    assert run_serially(small_spec(axes=POWERS), path).complete
    return path


def test_a_store_as_it_is_made_has_no_foreign_files(serial_store, tmp_path):
    assert list_foreign_files(serial_store) == []
    assert (
        list_foreign_files(pack_store(serial_store, tmp_path / "packed.zarr", progress=False)) == []
    )


def test_verify_tells_of_them_and_is_content(serial_store, tmp_path):
    store = copy_store(serial_store, tmp_path)
    put(store)
    (store / "elsewhere").symlink_to(tmp_path)
    (report,) = verify(store, progress=False)
    assert report.is_undamaged and report.complete
    assert list(report.foreign_objects) == sorted([*FOREIGN_OBJECTS, "elsewhere"])
    result = CliRunner().invoke(main, ["verify", str(store)], catch_exceptions=False)
    assert result.exit_code == 0 and "not sweep's, and left alone: .sweep/todo.txt" in result.output
    assert resume(store, progress=False, scheduler="none").complete
    assert own_files(store) == MINE  # the unfinished download too


@pytest.mark.parametrize("name", LITTER)
def test_what_programs_leave_behind_is_no_damage(serial_store, tmp_path, name):
    store = copy_store(serial_store, tmp_path)
    (store / name).write_text("")
    result = CliRunner().invoke(main, ["verify", str(store)], catch_exceptions=False)
    assert result.exit_code == 0 and name in result.output
    assert run(
        small_spec(seed=4), store=store, overwrite=True, progress=False, scheduler="none"
    ).complete


def test_extending_carries_them_over(serial_store, larger, tmp_path):
    store = copy_store(serial_store, tmp_path)
    put(store)
    (store / "elsewhere").symlink_to(tmp_path)
    assert extend(store, small_spec(axes=POWERS), progress=False, scheduler="none").complete
    assert own_files(store) == MINE and (store / "elsewhere").readlink() == tmp_path
    (store / "elsewhere").unlink()
    assert without_mine(store) == file_digests(larger)
    assert os.listdir(tmp_path) == [store.name]


def test_one_in_the_way_of_a_new_array_gets_a_name_of_its_own(serial_store, tmp_path):
    store = copy_store(serial_store, tmp_path)
    put(store)
    axes = {**STUDY_MAPPING["axes"], "target.reflectance": [0.02, 0.1]}
    assert extend(store, small_spec(axes=axes), progress=False, scheduler="none").complete
    assert (store / "reflectance" / "zarr.json").exists()
    assert (store / "reflectance.1").read_text() == MINE["reflectance"]
    assert verify(store, progress=False)[0].is_undamaged


def test_those_that_come_while_a_store_is_extended_are_carried_over(serial_store, larger, tmp_path):
    store = copy_store(serial_store, tmp_path)
    first = extend(store, small_spec(axes=POWERS), progress=False, scheduler="none",
                   evaluate=make_failing_evaluate(set(range(99)), tmp_path / "log"))  # fmt: skip
    assert not first.complete and staging_path_for(store).exists()
    put(store)
    assert resume(store, progress=False, scheduler="none", retry_failed=True).complete
    assert own_files(store) == MINE and without_mine(store).keys() == file_digests(larger).keys()


@pytest.mark.parametrize("number", range(1, 12))
def test_a_kill_at_any_renaming_loses_none(serial_store, tmp_path, monkeypatch, number):
    """Killed within the replacement; the next command ends it."""
    store = copy_store(serial_store, tmp_path)
    put(store)
    rename, count = os.rename, [0]

    class Killed(BaseException):
        pass

    def counted(*places):
        count[0] += 1
        if count[0] >= number:
            raise Killed
        rename(*places)

    succeed = locations.replace_path

    def watched(new, path):
        monkeypatch.setattr(os, "rename", counted)
        succeed(new, path)

    monkeypatch.setattr("sweep.tasks.driver.replace_path", watched)
    with suppress(Killed):
        extend(store, small_spec(axes=POWERS), progress=False, scheduler="none")
    monkeypatch.undo()
    for left in tmp_path.glob(".copy.zarr.*"):  # as of a process that is no more
        if "-" in left.name:
            left.rename(left.with_name(left.name.replace(f"-{os.getpid()}.", f"-{2**22 + 1}.")))
    assert resume(store, progress=False, scheduler="none").complete
    recover_interrupted_replace(store)
    assert own_files(store) == MINE
    assert os.listdir(tmp_path) == [store.name]
    assert verify(store, progress=False)[0].is_undamaged


def test_overwriting_refuses_and_names_them(serial_store, tmp_path):
    store = copy_store(serial_store, tmp_path)
    put(store)
    before = file_digests(store)
    with pytest.raises(StoreError, match=r"notes\.txt.*move them elsewhere"):
        run_serially(small_spec(seed=9), store, overwrite=True, scheduler="none")
    assert file_digests(store) == before and os.listdir(tmp_path) == [store.name]
    (tmp_path / "other").mkdir()
    other = copy_store(serial_store, tmp_path / "other")
    with pytest.raises(StoreError, match="not sweep's"):
        extend(other, small_spec(axes=POWERS), to=store, overwrite=True, progress=False)
    assert own_files(store) == MINE


def test_those_that_come_while_a_store_is_overwritten_are_carried_over(serial_store, tmp_path):
    store = copy_store(serial_store, tmp_path)
    run_serially(small_spec(seed=9), store, overwrite=True, scheduler="none",
          evaluate=make_failing_evaluate({3}, tmp_path / "log"))  # fmt: skip
    put(store)
    assert resume(store, progress=False, scheduler="none", retry_failed=True).complete
    assert own_files(store) == MINE


def test_where_they_cannot_be_moved_the_old_folder_stays(serial_store, tmp_path, monkeypatch):
    store = copy_store(serial_store, tmp_path)
    put(store)
    rename = os.rename

    def no_notes(old, new):
        if str(old).endswith("notes.txt"):
            raise PermissionError(1, "Operation not permitted")
        rename(old, new)

    monkeypatch.setattr(os, "rename", no_notes)
    assert extend(store, small_spec(axes=POWERS), progress=False, scheduler="none").complete
    (old,) = tmp_path.glob(".copy.zarr.replaced-*")
    assert (old / "notes.txt").read_text() == "mine"


def test_an_empty_folder_is_a_free_place(serial_store, tmp_path):
    for name in ("a.zarr", "b.zarr", "c.zarr", "d.zarr"):
        (tmp_path / name).mkdir()
    assert run_serially(small_spec(), tmp_path / "a.zarr").complete
    assert file_digests(tmp_path / "a.zarr") == file_digests(serial_store)
    assert pack_store(serial_store, tmp_path / "b.zarr", progress=False)
    grown = small_spec(axes=POWERS)
    to = tmp_path / "c.zarr"
    assert extend(serial_store, grown, to=to, progress=False, scheduler="none").complete
    assert run_serially(
        small_spec(), tmp_path / "d.zarr", overwrite=True, scheduler="none"
    ).complete
    assert sorted(os.listdir(tmp_path)) == ["a.zarr", "b.zarr", "c.zarr", "d.zarr"]


def test_a_folder_with_anything_in_it_is_not(tmp_path):
    (tmp_path / "a.zarr").mkdir()
    (tmp_path / "a.zarr" / "notes.txt").write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(StoreError, match="not a Zarr store"):
            run_serially(small_spec(), tmp_path / "a.zarr", overwrite=overwrite, scheduler="none")
    assert not can_create_store(tmp_path / "a.zarr" / "notes.txt") and can_create_store(
        tmp_path / "b" / "c"
    )
    assert (tmp_path / "a.zarr" / "notes.txt").read_text() == "mine"


# One command for a job that is started again and again


def test_run_with_resume_begins_goes_on_and_is_content(serial_store, tmp_path):
    store, study = tmp_path / "a.zarr", small_spec()
    arguments = {"store": store, "resume": True, "progress": False, "scheduler": "none"}
    first = run(study, **arguments, evaluate=make_failing_evaluate({3, 4}, tmp_path / "log"))
    assert not first.complete and first.blocks_done == first.blocks - 2
    second = run(study, **arguments, retry_failed=True)
    assert second.complete and second.blocks_computed == 2
    assert file_digests(store) == file_digests(serial_store)
    third = run(study, **arguments)
    assert third.complete and third.blocks_computed == 0
    with pytest.raises(StoreError, match="holds another study"):
        run(small_spec(seed=9), **arguments)
    assert file_digests(store) == file_digests(serial_store)
    with pytest.raises(ValueError, match="give one of them"):
        run(study, **arguments, overwrite=True)


def test_run_with_resume_goes_on_with_what_is_to_replace_a_store(serial_store, tmp_path):
    store = copy_store(serial_store, tmp_path)
    arguments = {"store": store, "progress": False, "scheduler": "none"}
    run(
        small_spec(seed=9),
        **arguments,
        overwrite=True,
        evaluate=make_failing_evaluate({3}, tmp_path / "log"),
    )
    outcome = run(small_spec(seed=9), **arguments, resume=True, retry_failed=True)
    assert outcome.complete and outcome.blocks_computed == 1 and outcome.store == store
    assert not staging_path_for(store).exists()


def test_run_with_resume_is_one_command_for_all_starts_of_a_job(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("small.yaml").write_text(yaml.safe_dump(small_mapping()))
    command = ["run", "small.yaml", "--resume", "--scheduler", "none"]

    def start(*options):
        return CliRunner().invoke(main, [*command, *options], catch_exceptions=False)

    assert start().exit_code == 0
    second_result = start()
    assert (
        second_result.exit_code == 0
        and "was complete already: nothing was left" in second_result.output
    )
    next(file for file in Path("results/small.zarr/pd_up/c").rglob("*") if file.is_file()).unlink()
    mended = start()
    assert mended.exit_code == 0 and "computed 1 of 9 blocks" in mended.output
    Path("small.yaml").write_text(yaml.safe_dump(small_mapping(seed=9)))
    refused = start()
    assert refused.exit_code == 2 and "seed: 3 -> 9" in refused.output
    result = start("--overwrite")
    assert result.exit_code == 2 and "give one of them" in result.output
    shutil.rmtree("results/small.zarr")
    Path("results/small.zarr").mkdir()
    assert start().exit_code == 0


@pytest.mark.parametrize("lives", [False, True])
def test_run_with_resume_waits_for_a_driver_killed_elsewhere(
    serial_store, tmp_path, monkeypatch, lives
):
    """As of a job that is started again on another node, seconds after it was killed."""
    monkeypatch.setattr(journal, "HEARTBEAT_AGE_SECONDS_MAX", 2.0)
    monkeypatch.setattr(journal, "HEARTBEAT_WATCH_SECONDS", 0.5)
    store = copy_store(serial_store, tmp_path)
    lock = store / ".sweep" / "lock"
    lock.write_text(json.dumps({"host": "elsewhere", "pid": 1, "start": 1, "token": "t"}))
    progress, stop = RecordingProgress(), threading.Event()

    def beat():
        while not stop.wait(0.1):
            os.utime(lock)

    beating = threading.Thread(target=beat)
    arguments = {"store": store, "progress": progress, "scheduler": "none"}
    try:
        if lives:
            beating.start()
            with pytest.raises(StoreError, match="process 1 on elsewhere"):
                run(small_spec(), **arguments, resume=True)
        else:
            with pytest.raises(StoreError, match="process 1 on elsewhere"):
                resume(store, progress=False, scheduler="none")
            assert run(small_spec(), **arguments, resume=True).complete
    finally:
        stop.set()
        if lives:
            beating.join()
    assert progress[0].startswith("waiting up to ") and "process 1 on elsewhere" in progress[0]
