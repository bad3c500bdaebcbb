"""Every byte of a store that is not as it was written is found, and mended."""

import shutil
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner
from shot_helpers import parametrize_product
from small_flights import small_scene_spec
from small_studies import (
    STUDY_MAPPING,
    copy_store,
    file_contents,
    file_digests,
    logged_blocks,
    make_failing_evaluate,
    make_logging_evaluate,
    run_serially,
    small_mapping,
    small_spec,
)

import sweep
from sweep.analysis.datasets import NotAStoreError
from sweep.cli import main
from sweep.spec import load
from sweep.storage.locations import eyepoint_store_location
from sweep.tasks.driver import resume, run
from sweep.tasks.engine import journal
from sweep.tasks.engine.journal import StoreLock
from sweep.tasks.engine.progress import Progress, StoreError
from sweep.tasks.studies import study_loading
from sweep.tasks.studies.store_verification import verify

TINY = {"axes": {"target.range": ["1 km", "2 km"]}, "storage": {"block_points": 1}}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A store of two points in two blocks, with a failure in its past; not to be changed."""
    directory = tmp_path_factory.mktemp("tiny")
    path = directory / "tiny.zarr"
    run_serially(
        small_spec(**TINY),
        path,
        scheduler="none",
        evaluate=make_failing_evaluate({1}, directory / "log"),
    )
    assert resume(path, progress=False, scheduler="none", retry_failed=True).complete
    return path


def damages(store: Path, **options) -> list[str]:
    """Objects that are found damaged; a number of a line and a count of chunks are left out."""
    reports = verify(store, progress=False, **options)
    return [damage.object_name for report in reports for damage in report.damages]


def files(store: Path) -> list[Path]:
    return sorted(file for file in store.rglob("*") if file.is_file() and file.stat().st_size)


def flips(store: Path, places):
    """Flip a bit at each of some places over all files, one after the other: where, each time."""
    for file in files(store):
        content = file.read_bytes()
        for place in places(content):
            flipped = bytearray(content)
            flipped[place] ^= 1 << place % 8
            file.write_bytes(flipped)
            yield file, place
        file.write_bytes(content)


def found_where(store: Path, file: Path) -> bool:
    """Tell whether the one damaged file is found, and nothing else."""
    name = str(file.relative_to(store))
    locations = unmarked(store)
    return len(locations) >= 1 and all(f.startswith(name) for f in locations)


def look_only(store: Path, monkeypatch) -> None:
    """Have the one store verified quickly, without withdrawing anything."""
    _, study = study_loading.read_study(store)
    monkeypatch.setattr(
        "sweep.tasks.studies.store_verification._study_of_store", lambda path, spec: study
    )
    monkeypatch.setattr(
        "sweep.tasks.studies.store_verification._withdraw_receipts",
        lambda path, blocks, label: "only looking",
    )


def unmarked(store: Path) -> list[str]:
    """What is found damaged in the one store."""
    (report,) = verify(store, progress=False)
    return [damage.object_name for damage in report.damages]


@pytest.mark.parametrize(
    "step", [pytest.param(1, marks=pytest.mark.slow), 397], ids=["every byte", "a sample"]
)
def test_a_flipped_bit_in_any_byte_of_a_small_store_is_found(tiny, tmp_path, monkeypatch, step):
    store = copy_store(tiny, tmp_path)
    look_only(store, monkeypatch)
    assert unmarked(store) == []
    number = 0
    for file, place in flips(
        store, lambda content: range(place_of(content, step), len(content), step)
    ):
        assert found_where(store, file), (file, place)
        number += 1
    assert number > (50_000 if step == 1 else 150)
    assert unmarked(store) == []


def place_of(content: bytes, step: int) -> int:
    """First place of a sample: another for each file, and one that each has."""
    return len(content) % min(step, len(content))


@pytest.mark.parametrize("step", [pytest.param(1, marks=pytest.mark.slow), 7])
def test_bytes_cut_off_or_added_anywhere_are_found(tiny, tmp_path, monkeypatch, step):
    """Of all files, or of the root's, the journal's and some arrays'."""
    store = copy_store(tiny, tmp_path)
    look_only(store, monkeypatch)
    arrays = [file for file in files(store) if ".sweep" not in file.parts and file.parent != store]
    for file in set(files(store)) - set(arrays) | set(arrays[::step]):
        content = file.read_bytes()
        half = content[: len(content) // 2 + 1].rstrip(b"\n")  # a log of whole lines is a log
        for wrong in (content[:-1], content[1:], half, content + b"\0"):
            file.write_bytes(wrong)
            assert found_where(store, file), file
        file.unlink()
        assert file.name in journal.LOG_FILE_NAMES or found_where(store, file), file
        file.write_bytes(content)


def test_whole_lines_cut_off_the_receipts_leave_their_blocks_to_be_done(tiny, tmp_path):
    store = copy_store(tiny, tmp_path)
    receipts = store / ".sweep" / "receipts.jsonl"
    receipts.write_bytes(receipts.read_bytes().splitlines(keepends=True)[0])
    (report,) = verify(store, progress=False)
    assert report.is_undamaged and not report.complete and report.undamaged_blocks == 1
    receipts.unlink()
    (report,) = verify(store, progress=False)
    assert report.is_undamaged and report.undamaged_blocks == 0


def test_damaged_blocks_are_named_and_just_they_are_computed_again(serial_store, tmp_path):
    store, log = copy_store(serial_store, tmp_path), tmp_path / "log"
    flip(store / "pd_up" / "c" / "0" / "5" / "0")
    flip(store / "pd_shot" / "c" / "0" / "6" / "0")
    (store / "pd_shot" / "c" / "0" / "2" / "0").unlink()
    (store / "pd_up" / "c" / "0" / "2" / "0").write_bytes(b"")
    (report,) = verify(store, progress=False)
    assert [(d.block, d.object_name, d.description) for d in report.damages] == [
        (2, "pd_shot/c/0/2/0", "is missing"),
        (2, "pd_up/c/0/2/0", "is empty"),
        (5, "pd_up/c/0/5/0", "fails its checksum"),
        (6, "pd_shot/c/0/6/0", "fails its checksum"),
    ]
    assert (report.undamaged_blocks, report.blocks, report.withdrawal_error) == (9, 12, "")
    (second_report,) = verify(store, progress=False)
    assert second_report.is_undamaged and second_report.undamaged_blocks == 9
    assert resume(
        store, progress=False, scheduler="none", evaluate=make_logging_evaluate(log)
    ).complete
    assert logged_blocks(log) == [2, 5, 6]
    assert file_digests(store) == file_digests(serial_store)
    (mended,) = verify(store, progress=False)
    assert mended.is_undamaged and mended.complete


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    file.write_bytes(content)


def put_directory(file: Path) -> None:
    """Have a directory, and something in it, where a file was."""
    file.unlink(missing_ok=True)
    (file / "some").mkdir(parents=True)
    (file / "some" / "notes").write_text("what got here")


def test_a_directory_in_the_place_of_a_chunk_or_a_log_is_healed(serial_store, tmp_path):
    store, log = copy_store(serial_store, tmp_path), tmp_path / "log"
    put_directory(store / "pd_up" / "c" / "0" / "5" / "0")
    put_directory(store / ".sweep" / "failures.jsonl")
    assert resume(
        store, progress=False, scheduler="none", evaluate=make_logging_evaluate(log)
    ).complete
    assert logged_blocks(log) == [5] and damages(store) == []
    assert file_digests(store) == file_digests(serial_store)


@pytest.mark.parametrize("damage", ["missing", "a directory", "flipped"])
def test_a_store_without_a_coordinate_is_not_opened(serial_store, tmp_path, damage):
    store = copy_store(serial_store, tmp_path)
    chunk = store / "range" / "c" / "0"
    flip(chunk) if damage == "flipped" else chunk.unlink()
    if damage == "a directory":
        put_directory(chunk)
    with pytest.raises(
        NotAStoreError, match=r"coordinate.* `sweep.verify\(.*, repair=True\)` puts it"
    ):
        sweep.open(store)
    verify(store, progress=False, repair=True)
    assert (sweep.open(store)["range"] > 0).all()


def test_a_flight_without_a_coordinate_is_not_opened(flight, tmp_path):
    store = shutil.copytree(flight.parent, tmp_path / "copy") / flight.name
    (store / "line" / "power" / "c" / "0").unlink()
    with pytest.raises(NotAStoreError, match="has lost line/power/c/0, of a coordinate"):
        sweep.open_scene(store)


def test_a_chunk_that_is_whole_but_another_blocks_is_found(serial_store, tmp_path):
    store = copy_store(serial_store, tmp_path)
    chunks = store / "pd_shot" / "c" / "0"
    shutil.copy(chunks / "2" / "0", chunks / "5" / "0")
    (report,) = verify(store, progress=False)
    assert [damage.block for damage in report.damages] == [5]
    assert "not the one that was committed" in report.damages[0].description


def test_a_receipt_that_is_damaged_costs_its_block_and_no_other(serial_store, tmp_path):
    store, log = copy_store(serial_store, tmp_path), tmp_path / "log"
    receipts = store / ".sweep" / "receipts.jsonl"
    receipts.write_bytes(receipts.read_bytes().replace(b'"block":7,', b'"block":8,'))
    assert damages(store) == [".sweep/receipts.jsonl line 8"]
    assert resume(
        store, progress=False, scheduler="none", evaluate=make_logging_evaluate(log)
    ).complete
    assert logged_blocks(log) == [7]
    assert damages(store) == [] and file_digests(store) == file_digests(serial_store)


@pytest.mark.parametrize(
    "name, damage",
    parametrize_product(
        2,
        ["zarr.json", "pd_shot/zarr.json", "range/zarr.json", "range/c/0", ".sweep/template.jsonl"],
        ["flipped", "missing", "a directory"],
    ),
)
def test_a_template_is_put_back_as_it_was_made(serial_store, tmp_path, name, damage):
    store = copy_store(serial_store, tmp_path)
    before = file_contents(store)
    flip(store / name) if damage == "flipped" else (store / name).unlink()
    if damage == "a directory":
        put_directory(store / name)
    with pytest.raises(StoreError, match=r"sweep.verify\(.*, repair=True\)"):
        resume(store, progress=False, scheduler="none")
    (report,) = verify(store, progress=False, repair=True)
    assert report.is_undamaged and report.complete and list(report.restored_objects) == [name]
    assert file_contents(store) == before
    assert [child.name for child in tmp_path.iterdir()] == ["copy.zarr"]


def flip_at(file: Path, place: int) -> None:
    """Flip a bit that leaves a letter a letter, and a digit one."""
    content = bytearray(file.read_bytes())
    content[place] ^= 1
    file.write_bytes(content)


def lose_what_it_holds(store: Path, damage: str) -> None:
    """Have neither the group nor the list of a store say undamaged what is in it."""
    root, listed = store / "zarr.json", store / ".sweep" / "template.jsonl"
    if damage == "gone":
        root.unlink()
        listed.write_bytes(b"")
        return
    flip_at(listed, 40)
    flip_at(root, 0 if damage == "no JSON" else root.read_bytes().index(b"0.02") + 3)  # 0.03


@pytest.mark.parametrize("damage", ["no JSON", "JSON", "gone"])
def test_a_store_that_no_longer_says_what_it_holds_is_mended_with_the_spec(
    serial_store, tmp_path, damage
):
    store = copy_store(serial_store, tmp_path)
    before = file_contents(store)
    lose_what_it_holds(store, damage)
    after = file_contents(store)
    with pytest.raises(StoreError, match=r"repair=True, spec=spec"):
        verify(store, progress=False, repair=True)
    power = ["1 W", "3 W", "4 W"]  # as larger studies have it: the first blocks are the same
    axes = {**STUDY_MAPPING["axes"], "instrument.laser.power": power}
    for other in ({"footprint": {"beamlets": 11, "speckle": "none"}}, {"axes": axes}):
        with pytest.raises(StoreError, match=r"from this spec|holds another study"):
            verify(store, progress=False, repair=True, spec=small_spec(**other))
    assert file_contents(store) == after
    (report,) = verify(store, progress=False, repair=True, spec=small_spec())
    assert report.is_undamaged and report.complete
    assert file_contents(store) == before


@pytest.mark.parametrize(
    "damage", ["JSON", *(pytest.param(how, marks=pytest.mark.slow) for how in ("no JSON", "gone"))]
)
def test_a_damaged_store_is_known_for_ours_and_written_over(serial_store, tmp_path, damage):
    store = copy_store(serial_store, tmp_path)
    lose_what_it_holds(store, damage)
    assert run(small_spec(), store=store, overwrite=True, progress=False, scheduler="none").complete
    assert file_digests(store) == file_digests(serial_store) and damages(store) == []


@pytest.mark.parametrize("content", ['{"attributes": {}}', "no JSON"])
def test_a_directory_that_sweep_did_not_make_is_not_written_over(tmp_path, content):
    store = tmp_path / "other.zarr"
    (store / ".sweep").mkdir(parents=True)
    (store / "zarr.json").write_text(content)
    (store / ".sweep" / "sessions.jsonl").write_text('{"event":"begun"}\n')
    before = file_contents(store)
    with pytest.raises(StoreError, match=r"not a Zarr store of sweep's|not one that sweep made"):
        run(small_spec(), store=store, overwrite=True, progress=False, scheduler="none")
    assert file_contents(store) == before


def test_eyepoints_that_no_longer_say_what_they_are_are_mended_by_the_flight(flight, tmp_path):
    directory = shutil.copytree(flight.parent, tmp_path / "copy")
    store = directory / flight.name
    lose_what_it_holds(
        eyepoint_store_location(store, small_scene_spec().geometry_id("line")), "gone"
    )
    assert all(report.is_undamaged for report in verify(store, progress=False, repair=True))
    assert file_digests(directory) == file_digests(flight.parent)


def test_chunks_that_are_no_part_of_a_store_are_named(serial_store, tmp_path):
    store = copy_store(serial_store, tmp_path)
    surplus = ["pd_up/c/0/12/0", "range/c/1"]
    for name in surplus:
        (store / name).parent.mkdir(parents=True, exist_ok=True)
        (store / name).write_text("{}")
    (store / "pd_up/c/0/5/0.1234.partial").write_bytes(b"of a writer that was killed")
    (store / ".sweep" / "receipts.jsonl").write_bytes(b"")  # blocks are no surplus without them
    (report,) = verify(store, progress=False)
    assert sorted(damage.object_name for damage in report.damages) == sorted(surplus)
    result = CliRunner().invoke(main, ["verify", str(store), "--repair"])
    assert result.exit_code == 1 and "range/c/1 is no part of the store" in result.output
    assert "sweep resume" not in result.output and (store / "range/c/1").exists()


def test_a_template_that_cannot_be_made_again_here_is_left_as_it_is(
    serial_store, tmp_path, monkeypatch
):
    store = copy_store(serial_store, tmp_path)
    flip(store / "range" / "c" / "0")
    before = file_contents(store)
    monkeypatch.setattr("sweep.tasks.engine.study_store.CHUNK_CODECS", "auto")
    with pytest.raises(StoreError, match="can't be made again as it was on this machine"):
        verify(store, progress=False, repair=True)
    assert file_contents(store) == before


def test_a_store_that_is_being_written_is_looked_at_and_not_touched(serial_store, tmp_path):
    store = copy_store(serial_store, tmp_path)
    flip(store / "pd_up" / "c" / "0" / "5" / "0")
    receipts = store / ".sweep" / "receipts.jsonl"
    receipts.write_bytes(receipts.read_bytes() + b'{"block":3,')  # about to be written
    held = StoreLock(store)
    before = file_contents(store)
    (report,) = verify(store, progress=False)
    held.release()
    assert [damage.block for damage in report.damages] == [5]
    assert "is being written by process" in report.withdrawal_error
    assert file_contents(store).items() <= before.items()


@pytest.mark.parametrize("whose", ["the flight's", "its eyepoints'"])
def test_a_flights_store_and_its_eyepoints_are_verified_and_mended(flight, tmp_path, whose):
    directory = shutil.copytree(flight.parent, tmp_path / "copy")
    store = directory / flight.name
    eyepoints = eyepoint_store_location(store, small_scene_spec().geometry_id("line"))
    damaged = store if whose == "the flight's" else eyepoints
    assert [report.is_undamaged for report in verify(store, progress=False)] == [True] * 3
    chunk = next(file for file in files(damaged) if file.parent.parent.name == "c")
    flip(chunk)
    flip(damaged / "zarr.json")
    flip(damaged / ".sweep" / "recipe.json")
    reports = {report.store: report for report in verify(store, progress=False)}
    assert [path for path, report in reports.items() if not report.is_undamaged] == [damaged]
    assert {d.object_name for d in reports[damaged].damages} == {
        "zarr.json", ".sweep/recipe.json line 1", str(chunk.relative_to(damaged)),
    }  # fmt: skip
    verify(store, progress=False, repair=True)
    outcome = resume(store, spec=small_scene_spec(), progress=False, scheduler="none")
    assert (outcome.complete and sum(outcome.rays_by_scanner.values()) > 0) or damaged == store
    assert all(r.is_undamaged and r.complete for r in verify(store, progress=False))
    assert file_digests(directory) == file_digests(flight.parent)


def test_where_a_flight_s_files_are_is_not_guessed(flight, tmp_path):
    store = shutil.copytree(flight.parent, tmp_path / "copy") / flight.name
    flip(store / ".sweep" / "recipe.json")
    with pytest.raises(StoreError, match=r"sweep.resume\(.*, spec=spec\)"):
        resume(store, progress=False, scheduler="none")


def test_the_command_tells_what_is_wrong_and_what_to_do(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("small.yaml").write_text(yaml.safe_dump(small_mapping(), sort_keys=False))
    run(load("small.yaml"), store="copy.zarr", scheduler="none", progress=False)
    command = CliRunner()
    result = command.invoke(main, ["verify", "copy.zarr"])
    assert result.exit_code == 0
    assert result.output == "copy.zarr: 12 of 12 blocks committed and undamaged\n"
    flip(Path("copy.zarr/pd_up/c/0/5/0"))
    flip(Path("copy.zarr/pd_up/zarr.json"))
    damaged = command.invoke(main, ["verify", "copy.zarr"])
    assert damaged.exit_code == 1
    assert "block 5: pd_up/c/0/5/0 fails its checksum" in damaged.output
    assert "pd_up/zarr.json is not as it was made" in damaged.output
    assert "sweep verify copy.zarr --repair" in damaged.output
    assert "sweep resume copy.zarr" in damaged.output
    repaired = command.invoke(main, ["verify", "copy.zarr", "--repair"])
    assert "pd_up/zarr.json put back" in repaired.output
    assert repaired.exit_code == 3 and "11 of 12 blocks" in repaired.output
    assert command.invoke(main, ["resume", "copy.zarr", "--scheduler", "none"]).exit_code == 0
    assert command.invoke(main, ["verify", "copy.zarr"]).exit_code == 0
    assert command.invoke(main, ["verify", "nowhere.zarr"]).exit_code == 2
    assert command.invoke(main, ["verify", "copy.zarr", "--spec", "small.yaml"]).exit_code == 2
    lose_what_it_holds(Path("copy.zarr"), "no JSON")
    output = command.invoke(main, ["status", "copy.zarr"]).output
    assert "sweep verify" in output and "--repair --spec SPEC" in output
    mended = command.invoke(main, ["verify", "copy.zarr", "--repair", "--spec", "small.yaml"])
    assert mended.exit_code == 0, mended.output


def test_what_takes_long_shows_how_far_it_is(serial_store, monkeypatch):
    lines = []

    class Watching(Progress):
        def begin(self, *, points, done, unit):
            lines.append((points, done, unit))

        def advance(self, *, points, failed):
            lines.append(points)

        def end(self):
            lines.append("end")

    verify(serial_store, progress=Watching())
    assert lines == []
    monkeypatch.setattr("sweep.tasks.studies.store_verification.BLOCKS_PER_READ_BATCH", 5)
    verify(serial_store, progress=Watching())
    assert lines == [(12, 0, "blocks"), 5, 5, 2, "end"]
