"""Pipes, links, huge and hostile files in the place of a store's: result at once, never read."""

import errno
import json
import os
import pickle
import shutil
import signal
import socket
import stat
import time
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from numcodecs.zstd import Zstd
from small_studies import STUDY_MAPPING, file_digests, run_serially, small_mapping, small_spec

import sweep
from sweep.cli import main
from sweep.regular_files import RefusedFileError, open_regular_file, read_file_below_root
from sweep.safe_json import parse_json
from sweep.storage.locations import parse_location
from sweep.storage.size_checks import ArrayFileLayout, declared_zstd_content_size
from sweep.storage.store_format import NotAStoreError, encode_log_record, log_line_with_digest
from sweep.tasks.driver import extend, resume
from sweep.tasks.engine import journal
from sweep.tasks.studies.store_verification import pack_store, verify

CHUNK, COORDINATE = "pd_up/c/0/0/0", "range/c/0"


@pytest.fixture(autouse=True)
def patience():
    """A test that waits for a pipe fails after a minute."""

    def give_up(*_):
        raise TimeoutError("it hangs")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def complete_store(tmp_path_factory):
    """A complete store of two blocks, not to be changed."""
    path = tmp_path_factory.mktemp("made") / "made.zarr"
    outcome = run_serially(small_spec(storage={"block_points": 36}), path)
    assert outcome.complete and outcome.blocks == 2
    return path


def pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def endless(file: Path) -> None:
    """A link to a device that never ends."""
    file.unlink()
    file.symlink_to("/dev/zero")


def linked(file: Path) -> None:
    """A link to the very file, elsewhere."""
    outside = file.parents[len(file.parts) - file.parts.index("theirs.zarr") - 1] / "outside"
    shutil.move(file, outside)
    file.symlink_to(outside)


def sparse(file: Path) -> None:
    """A file of a TB that takes no room."""
    with open(file, "wb") as opened:
        opened.truncate(1 << 40)


def bound(file: Path) -> None:
    """A socket."""
    file.unlink()
    directory = os.getcwd()
    os.chdir(file.parent)
    try:
        socket.socket(socket.AF_UNIX).bind(file.name)
    finally:
        os.chdir(directory)


def device(file: Path) -> None:
    file.unlink()
    try:
        os.mknod(file, stat.S_IFCHR | 0o666, os.makedev(1, 5))
    except PermissionError:
        pytest.skip("only root makes devices")


KINDS = {
    pipe: "is a named pipe, no plain file", endless: "is a symbolic link, no plain file",
    linked: "is a symbolic link, no plain file", sparse: "has 1,099,511,627,776 bytes",
    bound: "is a socket, no plain file", device: "is a device, no plain file",
}  # fmt: skip


@pytest.fixture
def store_copy(complete_store, tmp_path):
    """A copy that a test may spoil."""
    return shutil.copytree(complete_store, tmp_path / "theirs.zarr")


@pytest.mark.parametrize("spoil", KINDS, ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("name", [CHUNK, COORDINATE, "zarr.json", "pd_up/zarr.json"])
def test_verify_tells_what_stands_in_a_files_place(store_copy, spoil, name):
    spoil(store_copy / name)
    (report,) = verify(store_copy, progress=False)
    (damage,) = report.damages
    assert damage.object_name == name and damage.description.startswith(KINDS[spoil])
    assert report.undamaged_blocks == (1 if name == CHUNK else 2)


@pytest.mark.parametrize("spoil", KINDS, ids=lambda kind: kind.__name__)
def test_the_readers_of_a_chunk_raise_at_once_and_name_it(store_copy, spoil):
    spoil(store_copy / CHUNK)
    dataset = sweep.open(store_copy)
    with pytest.raises(RefusedFileError, match=f"{CHUNK} {KINDS[spoil]}.*`sweep.verify"):
        dataset.pd_up.compute()
    result = CliRunner().invoke(
        main, ["compare", str(store_copy), str(store_copy)], catch_exceptions=False
    )
    assert result.exit_code == 2 and f"{CHUNK} {KINDS[spoil]}" in result.output


@pytest.mark.parametrize("command", ["report S -o x.html", "compare S S", "figures S", "status S"])
@pytest.mark.parametrize("name", [CHUNK, "pd_shot/c/0/0/0", COORDINATE, "zarr.json"])
def test_no_command_waits_for_a_pipe(store_copy, tmp_path, monkeypatch, command, name):
    monkeypatch.chdir(tmp_path)
    pipe(store_copy / name)
    words = command.replace("S", store_copy.name).split()
    result = CliRunner().invoke(main, words, catch_exceptions=False)
    needed = name == "zarr.json" or (name == COORDINATE and "status" not in command)
    if needed or result.exit_code:
        assert result.exit_code == 2 and name in result.output, result.output


@pytest.mark.parametrize("spoil", [pipe, endless, linked, sparse])
def test_a_block_with_something_else_for_a_chunk_is_computed_again(
    store_copy, complete_store, tmp_path, spoil
):
    """A new file is renamed into its place: what a link leads to stays as it was."""
    spoil(store_copy / CHUNK)
    before = {file: file.read_bytes() for file in tmp_path.glob("outside")}
    if spoil is sparse:
        verify(store_copy, progress=False)  # there is a file: only a look into it tells
    assert resume(store_copy, progress=False, scheduler="none").blocks_computed == 1
    assert file_digests(store_copy) == file_digests(complete_store)
    assert all(file.read_bytes() == content for file, content in before.items())


@pytest.mark.parametrize("spoil", [pipe, endless, linked, bound])
@pytest.mark.parametrize("name", [COORDINATE, "zarr.json"])
def test_what_a_store_was_made_of_is_put_back_over_something_else(
    store_copy, complete_store, spoil, name
):
    spoil(store_copy / name)
    verify(store_copy, repair=True, progress=False)
    assert file_digests(store_copy) == file_digests(complete_store)


@pytest.mark.parametrize("folder", ["pd_up", "pd_up/c", "pd_up/c/0", "range/c"])
def test_a_folder_behind_a_link_is_no_part_of_a_store(store_copy, tmp_path, folder):
    shutil.move(store_copy / folder, tmp_path / "outside")
    (store_copy / folder).symlink_to(tmp_path / "outside")
    reports = verify(store_copy, progress=False)
    named = {damage.object_name for report in reports for damage in report.damages}
    assert {f"{folder.partition('/')[0]}/c/0/0/0", COORDINATE} & named
    with pytest.raises((RefusedFileError, NotAStoreError)):
        sweep.open(store_copy).pd_up.compute()


def test_a_store_that_is_itself_reached_through_links_is_read(complete_store, tmp_path):
    (tmp_path / "folder").symlink_to(complete_store.parent)
    (tmp_path / "link.zarr").symlink_to(tmp_path / "folder" / complete_store.name)
    assert verify(tmp_path / "link.zarr", progress=False)[0].is_undamaged
    assert sweep.open(tmp_path / "link.zarr").pd_up.notnull().all()


@pytest.mark.parametrize("name", ["receipts.jsonl", "sessions.jsonl", "lock", "lock.guard"])
def test_a_pipe_in_the_journal_is_named_and_hangs_nothing(store_copy, name):
    file = store_copy / ".sweep" / name
    file.touch()
    pipe(file)
    result = CliRunner().invoke(main, ["verify", str(store_copy)], catch_exceptions=False)
    assert (
        result.exit_code == 1 and f".sweep/{name} is a named pipe, no plain file" in result.output
    )
    result = CliRunner().invoke(main, ["status", str(store_copy)], catch_exceptions=False)
    assert result.exit_code == 2 and f"{name} is a named pipe" in result.output


def test_a_log_without_end_is_read_in_parts_and_mended(store_copy, complete_store):
    receipts = store_copy / ".sweep" / "receipts.jsonl"
    content = receipts.read_bytes()
    with open(receipts, "r+b") as log:
        log.truncate(1 << 40)
        log.seek(0, os.SEEK_END)
        log.write(b"\n" + content)
    (report,) = verify(store_copy, progress=False)
    assert report.undamaged_blocks == 2 and report.damages[0].object_name.startswith(
        ".sweep/receipts"
    )
    assert resume(store_copy, progress=False, scheduler="none").blocks_computed == 0
    assert receipts.read_bytes() == content + content


# Chunks that decode to more than they should


def frame(declared: int | None, blocks: int = 4) -> bytes:
    """A zstd frame of runs of 128 kB, that declares a size or none (RFC 8878, section 3.1.1)."""
    head = b"\xe0" + declared.to_bytes(8, "little") if declared is not None else b"\x00\x58"
    run = (131072 << 3 | 1 << 1).to_bytes(3, "little") + b"\0"
    last = (131072 << 3 | 1 << 1 | 1).to_bytes(3, "little") + b"\0"
    return b"\x28\xb5\x2f\xfd" + head + run * (blocks - 1) + last


def packed(content: bytes) -> bytes:
    return content + google_crc32c.value(content).to_bytes(4, "little")


BOMBS = {
    "a declared TB": (packed(frame(1 << 40)), "declares 1,099,511,627,776 bytes, where 288 are"),
    "more than its chunk": (packed(frame(131072 * 4)), "declares 524,288 bytes, where 288 are"),
    "less than its chunk": (packed(bytes(Zstd().encode(bytes(280)))), "declares 280 bytes"),
    "no declared size": (packed(frame(None)), "does not declare its size"),
}


def test_frames_declare_what_zstd_says():
    assert declared_zstd_content_size(frame(None)) is None and bytes(
        Zstd().decode(frame(None))
    ) == bytes(1 << 19)
    assert declared_zstd_content_size(frame(1 << 40)) == 1 << 40
    for size in (0, 1, 255, 256, 257, 65535, 65536, 65791, 65792, 1 << 20):
        for content in (bytes(size), np.random.default_rng(1).bytes(size)):
            assert declared_zstd_content_size(bytes(Zstd().encode(content))) == size


@pytest.mark.parametrize(("bomb", "message"), BOMBS.values(), ids=BOMBS)
def test_a_chunk_that_would_not_decode_to_its_size_is_not_decoded(store_copy, bomb, message):
    (store_copy / CHUNK).write_bytes(bomb)
    with pytest.raises(RefusedFileError, match=f"{CHUNK} has a chunk that {message}"):
        sweep.open(store_copy).pd_up.compute()
    result = CliRunner().invoke(
        main, ["compare", str(store_copy), str(store_copy)], catch_exceptions=False
    )
    assert result.exit_code == 2 and message in result.output
    assert not verify(store_copy, progress=False)[0].is_undamaged


@pytest.mark.parametrize(("bomb", "message"), BOMBS.values(), ids=BOMBS)
@pytest.mark.parametrize("reading", ["a shard", "a chunk of it"])
def test_a_shard_with_such_a_chunk_is_not_decoded(complete_store, tmp_path, bomb, message, reading):
    copy = pack_store(complete_store, tmp_path / "packed.zarr", progress=False)
    (shard,) = (file for file in (copy / "pd_up" / "c").rglob("*") if file.is_file())
    content = shard.read_bytes()
    index = np.frombuffer(content[-36:-4], "<u8").reshape(2, 2).copy()
    index[1] = len(content) - 36, len(bomb)
    free_bytes = ArrayFileLayout(36, 8, 2).file_bytes_max - len(content)
    assert free_bytes > len(bomb) or len(bomb) < 400
    shard.write_bytes(content[:-36] + bomb + packed(index.tobytes()))
    dataset = sweep.open(copy)
    part = dataset.pd_up if reading == "a shard" else dataset.pd_up[:, 6:]
    with pytest.raises(RefusedFileError, match=f"has a chunk that {message}"):
        part.compute()


def test_words_of_an_axis_are_counted_before_room_is_made(tmp_path):
    path = tmp_path / "text.zarr"
    axes = {"instrument.processing.window": ["hann", "hamming"]}
    assert run_serially(small_spec(axes=axes), path).complete
    text = (2**31).to_bytes(4, "little") + b"\4\0\0\0hann"
    (path / "window" / "c" / "0").write_bytes(packed(bytes(Zstd().encode(text))))
    (path / ".sweep" / "template.jsonl").unlink()  # has a digest of it, which they can forge
    with pytest.raises(RefusedFileError, match="another number of words"):
        sweep.open(path)


def test_a_dataset_is_checked_on_other_processes_too(store_copy):
    dataset = pickle.loads(pickle.dumps(sweep.open(store_copy)))
    assert dataset.pd_up.notnull().all()
    (store_copy / CHUNK).write_bytes(BOMBS["a declared TB"][0])
    with pytest.raises(RefusedFileError):
        dataset.pd_up.compute()


def test_objects_are_looked_at_as_files_are(complete_store):
    store = parse_location(f"memory://bucket/{time.time_ns()}/small.zarr")
    assert run_serially(small_spec(storage={"block_points": 36}), store).complete
    assert sweep.open(store).pd_up.notnull().all()
    for content, message in (*BOMBS.values(), (bytes(1 << 20), "has 1,048,576 bytes")):
        (store / CHUNK).write_bytes(content)
        with pytest.raises(RefusedFileError, match=message):
            sweep.open(store).pd_up.compute()
    (store / "zarr.json").write_bytes(bytes(65 << 20))
    with pytest.raises(NotAStoreError, match="damaged"):
        sweep.open(store)


# Documents


def nested(depth: int) -> str:
    return "[" * depth + "]" * depth


@pytest.mark.parametrize("depth", [61, 500, 10**5])
@pytest.mark.parametrize("location", ["attributes", "array", "spec", "log", "listed"])
def test_deep_nesting_ends_in_words(store_copy, location, depth):
    document = json.loads((store_copy / "zarr.json").read_text())
    if location == "log":
        (store_copy / ".sweep" / "sessions.jsonl").write_bytes(
            log_line_with_digest(b'{"event":"begun","time":' + nested(depth).encode())
        )
    elif location == "listed":
        body = json.dumps({"objects": 0})[:-1].encode() + b',"attributes":' + nested(depth).encode()
        (store_copy / ".sweep" / "template.jsonl").write_bytes(log_line_with_digest(body))
        (store_copy / "zarr.json").write_text("")
    else:
        if location == "attributes":
            document["attributes"]["more"] = "HERE"
        elif location == "array":
            document["consolidated_metadata"]["metadata"]["pd_up"]["attributes"]["more"] = "HERE"
        else:
            document["attributes"]["spec"] = '{"title": ' + nested(depth) + "}"
        (store_copy / "zarr.json").write_text(json.dumps(document).replace('"HERE"', nested(depth)))
    for command in ("status", "report", "verify", "resume"):
        result = CliRunner().invoke(main, [command, str(store_copy)], catch_exceptions=False)
        assert result.exit_code in (0, 1, 2, 3)
        if location in ("attributes", "array", "spec") and command in ("status", "report"):
            assert result.exit_code == 2 and str(store_copy) in result.output


def test_half_a_surrogate_pair_in_a_title_is_refused(store_copy, tmp_path):
    document = (store_copy / "zarr.json").read_text()
    (store_copy / "zarr.json").write_text(
        document.replace('"title": "Small"', '"title": "\\ud800"')
    )
    result = CliRunner().invoke(main, ["report", str(store_copy)], catch_exceptions=False)
    assert result.exit_code == 2 and "damaged" in result.output
    assert parse_json('"\\ud83d\\ude80"') == "\U0001f680"
    with pytest.raises(ValueError, match="no text"):
        parse_json('{"\\udc00": 1}')


def test_half_a_surrogate_pair_in_a_spec_is_refused_with_its_line(tmp_path):
    file = tmp_path / "spec.yaml"
    file.write_text(yaml.safe_dump(STUDY_MAPPING).replace("title: Small", 'title: "Small \\ud800"'))
    result = CliRunner().invoke(main, ["plan", str(file)], catch_exceptions=False)
    line = file.read_text().splitlines().index('title: "Small \\ud800"') + 1
    assert (
        result.exit_code == 2 and f"spec.yaml:{line}: is no valid YAML: an escape" in result.output
    )
    with pytest.raises(sweep.spec.SpecError, match="title: "):
        small_spec(title="Small \ud800")


# What is saved of a block


def test_saved_parts_of_others_make_no_room_for_what_they_declare(tmp_path):
    import io
    import zipfile

    (tmp_path / ".sweep").mkdir()
    for kind in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        head = io.BytesIO()
        shape = (1 << 42,)
        np.lib.format.write_array_header_1_0(
            head, {"descr": "<f8", "fortran_order": False, "shape": shape}
        )
        archive = io.BytesIO()
        with zipfile.ZipFile(archive, "w", kind) as out:
            out.writestr("done/points.npy", head.getvalue() + bytes(100))
        content = archive.getvalue()
        facts = {
            "study": "one", "block": 7, "points": 1.0, "seconds": 1.0,
            "digest": journal._content_digest(content),
        }  # fmt: skip
        (tmp_path / ".sweep" / "begun-7").write_bytes(encode_log_record(facts) + content)
        assert journal.read_checkpoint(tmp_path, "one", 7) == journal.Checkpoint()


# Specs, and files that they name


@pytest.mark.parametrize("kind", ["spec", "instrument", "instrument file", "table", "cluster"])
def test_a_pipe_for_a_spec_or_what_it_names_is_refused(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe.yaml")
    study = small_mapping()
    if kind == "instrument":
        study["instrument"] = "./pipe.yaml"
    elif kind == "instrument file":
        study["instrument"] = {"file": "pipe.yaml"}
    elif kind == "table":
        chirp = {**STUDY_MAPPING["instrument"]["chirp"], "error_table": "pipe.yaml"}
        study["instrument"] = {**STUDY_MAPPING["instrument"], "chirp": chirp}
    Path("study.yaml").write_text(yaml.safe_dump(study))
    command = {
        "spec": ["plan", "pipe.yaml"],
        "cluster": ["run", "study.yaml", "--cluster", "pipe.yaml"],
    }
    result = CliRunner().invoke(
        main, command.get(kind, ["plan", "study.yaml"]), catch_exceptions=False
    )
    assert result.exit_code == 2 and "pipe" in result.output


def test_a_loop_of_links_ends_in_words(complete_store, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("loop.zarr").symlink_to("loop.zarr")
    Path("study.yaml").write_text(yaml.safe_dump(small_mapping()))
    for command in (
        "status loop.zarr", "verify loop.zarr", "resume loop.zarr", "report loop.zarr",
        "compare loop.zarr loop.zarr", "run study.yaml --store loop.zarr --scheduler none",
        "extend loop.zarr study.yaml", f"finalize {complete_store} loop.zarr",
    ):  # fmt: skip
        result = CliRunner().invoke(main, command.split(), catch_exceptions=False)
        assert result.exit_code == 2 and "loop.zarr" in result.output, command
    assert Path("loop.zarr").is_symlink()


def test_plain_files_are_opened_as_they_are(tmp_path):
    (tmp_path / "file").write_bytes(b"0123456789")
    assert read_file_below_root(tmp_path, "file", 10) == b"0123456789"
    assert read_file_below_root(tmp_path, "file", 10, slice(-3, None)) == b"789"
    assert read_file_below_root(tmp_path, "file", 10, slice(2, 4)) == b"23"
    assert read_file_below_root(tmp_path, "file", 10, slice(8, 99)) == b"89"
    for name in ("../file", "a/../file", "./file", "a//file"):
        with pytest.raises(RefusedFileError, match="leads out"):
            read_file_below_root(tmp_path, name, 10)
    with pytest.raises(RefusedFileError, match="no more than 9"):
        read_file_below_root(tmp_path, "file", 9)
    with pytest.raises(IsADirectoryError):
        open_regular_file(tmp_path)
    with pytest.raises(RefusedFileError) as refusal:
        open_regular_file("/dev/null")
    assert refusal.value.errno == errno.EINVAL and "is a device" in str(refusal.value)


def test_a_folder_whose_name_is_no_text_holds_stores_as_any(tmp_path, monkeypatch):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff"))
    folder.mkdir()
    store = folder / "a.zarr"
    assert run_serially(small_spec(storage={"block_points": 36}), store).complete
    axes = {**STUDY_MAPPING["axes"], "instrument.laser.power": ["1 W", "2 W", "3 W"]}
    grown = extend(
        store, small_spec(axes=axes), to=folder / "b.zarr", progress=False, scheduler="none"
    )
    assert grown.complete and resume(folder / "b.zarr", progress=False, scheduler="none").complete
    assert verify(folder / "b.zarr", progress=False)[0].is_undamaged
