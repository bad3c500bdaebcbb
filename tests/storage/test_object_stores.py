"""Studies in an object store, over a real S3 protocol, with faults put in its way."""

import errno
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import timedelta

import numpy as np
import pytest
import xarray as xr
from click.testing import CliRunner
from faulty_server import (
    CUT_BODY,
    DROP_REPLY,
    HALVE_BODY,
    PASS_ON,
    REPLY_403,
    REPLY_503,
    REPLY_LATE,
)
from six_block_study import N_BLOCKS, six_block_spec
from small_studies import file_digests, logged_blocks, make_logging_evaluate, run_serially

import sweep
from sweep.cli import main
from sweep.storage import locations, store_format
from sweep.storage.locations import JOURNAL_DIR, ObjectStoreError, parse_location
from sweep.storage.store_format import decode_log_record, encode_log_record, iter_log_records
from sweep.tasks.driver import extend, resume, run
from sweep.tasks.engine.journal import LOCK_FILE, LockHolder, StoreLock, read_lock_holder
from sweep.tasks.engine.progress import StoreError
from sweep.tasks.studies.store_summary import status
from sweep.tasks.studies.store_verification import verify


def remote_tree(place) -> dict[str, str]:
    """As `tree`, of a store in an object store."""
    store = parse_location(place)
    return {
        name: hashlib.blake2b((store / name).read_bytes()).hexdigest()
        for name, _ in store.iter_objects_below()
        if not name.startswith(f"{JOURNAL_DIR}/")
    }


def receipts(place) -> list[int]:
    """Blocks with a receipt, in the order of the log."""
    return [
        r["block"] for r in iter_log_records(parse_location(place) / JOURNAL_DIR / "receipts.jsonl")
    ]


def troubled(number, method, path):
    """Of every 20 requests two fail, one is slow, and of one the answer is lost."""
    return {3: REPLY_503, 7: REPLY_LATE, 12: REPLY_503, 17: DROP_REPLY}.get(number % 20, PASS_ON)


@pytest.mark.parametrize(
    "workers",
    [
        pytest.param({"scheduler": "none"}, marks=pytest.mark.slow),
        {"workers": 2, "processes": False},
    ],
)
def test_the_bytes_are_those_of_a_store_on_disk_whatever_the_network_does(
    faults, place, serial_store, workers
):
    faults.fate = troubled
    outcome = run(six_block_spec(), store=place, progress=False, **workers)
    assert outcome.complete and not outcome.failures
    faults.fate = lambda *_: PASS_ON
    assert faults.seen[REPLY_503] > 20 and faults.seen[DROP_REPLY] > 10
    assert remote_tree(place) == file_digests(serial_store)
    assert sorted(receipts(place)) == list(range(N_BLOCKS))
    assert read_lock_holder(parse_location(place)) is None
    assert all(report.complete and report.is_undamaged for report in verify(place, progress=False))


def test_what_is_stored_opens_as_from_disk_and_says_how_far_it_is(memory, serial_store):
    run_serially(six_block_spec(), memory)
    on_disk, in_memory = sweep.open(serial_store), sweep.open(memory)
    assert in_memory.attrs["points_committed"] == on_disk.attrs["points_committed"] == 12
    for name in on_disk.data_vars:
        np.testing.assert_array_equal(in_memory[name].values, on_disk[name].values)
    assert status(memory).complete
    result = CliRunner().invoke(main, ["status", memory])
    assert result.exit_code == 0 and "12 of 12 points" in result.output


def test_a_store_is_extended_into_another_place(memory, tmp_path):
    axes = {
        **six_block_spec().to_yaml_mapping()["axes"],
        "instrument.laser.power": ["1 W", "2 W", "3 W"],
    }
    larger, place = six_block_spec(axes=axes), {"scheduler": "none", "progress": False}
    run_serially(six_block_spec(), memory)
    with pytest.raises(StoreError, match=r"an object store has no renaming: .* store="):
        extend(memory, larger, **place)
    memory_path, disk_path = memory.replace("small", "larger"), tmp_path / "here.zarr"
    before = remote_tree(memory)
    assert extend(memory, larger, to=memory_path, **place).complete
    assert extend(memory, larger, to=disk_path, **place).complete
    assert remote_tree(memory) == before
    expected = file_digests(run_serially(larger, tmp_path / "at_once.zarr").store)
    assert remote_tree(memory_path) == file_digests(disk_path) == expected


@pytest.mark.slow
def test_a_killed_driver_is_resumed_to_the_same_bytes(faults, place, serial_store, tmp_path):
    script = tmp_path / "client.py"
    script.write_text(
        "import sys, time\n"
        "from six_block_study import six_block_spec\n"
        "from sweep.storage import store_format\n"
        "from sweep.tasks.driver import run\n"
        "store_format.LOG_OBJECT_INTERVAL_SECONDS = 0\n"
        "def evaluate(study, block):\n"
        "    time.sleep(60 * (block == 3))\n"
        "    return study.evaluate(block)\n"
        "run(six_block_spec(), store=sys.argv[1], scheduler='none', "
        "progress=False, evaluate=evaluate)\n"
    )
    child = subprocess.Popen(
        [sys.executable, str(script), place],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    try:
        deadline = time.monotonic() + 120
        while len(receipts(place)) < 3:
            assert time.monotonic() < deadline and child.poll() is None
            time.sleep(0.1)
        with pytest.raises(StoreError, match=f"is being written by process {child.pid}"):
            resume(place, scheduler="none", progress=False)
        assert status(place).is_lock_holder_alive
        child.send_signal(signal.SIGKILL)
        child.wait()
        assert not status(place).is_lock_holder_alive
        assert receipts(place) == [0, 1, 2]
        outcome = resume(
            place,
            scheduler="none",
            progress=False,
            evaluate=make_logging_evaluate(tmp_path / "resumed"),
        )
        assert outcome.complete
        assert logged_blocks(tmp_path / "resumed") == [3, 4, 5]
        assert remote_tree(place) == file_digests(serial_store)
    finally:
        with suppress(ProcessLookupError):
            child.kill()
        child.wait()


def test_a_store_that_goes_away_ends_a_run_in_words_and_is_resumed(
    faults, place, serial_store, monkeypatch
):
    soon = {**locations.RETRY_CONFIG, "max_retries": 2, "retry_timeout": timedelta(seconds=2)}
    monkeypatch.setattr(locations, "RETRY_CONFIG", soon)

    def fails_later(study, block):
        if block == 3:
            faults.fate = lambda *_: REPLY_503
        return study.evaluate(block)

    outcome = run(
        six_block_spec(), store=place, scheduler="none", progress=False, evaluate=fails_later
    )
    assert not outcome.complete and "keeps failing (503" in outcome.stop_reason
    faults.fate = lambda *_: PASS_ON
    n_receipts = receipts(place)
    assert outcome.blocks_done == len(n_receipts) <= 3
    assert resume(place, scheduler="none", progress=False).complete
    assert remote_tree(place) == file_digests(serial_store)


def test_of_many_that_find_the_lock_of_a_dead_driver_one_gets_it(faults, place):
    path = parse_location(place)
    dead = replace(LockHolder.of_this_process(), pid=2**22 + 1)
    (path / JOURNAL_DIR / LOCK_FILE).write_bytes(json.dumps(asdict(dead)).encode())
    outcomes, refused = [], []

    def try_it():
        try:
            outcomes.append(StoreLock(path))
        except (StoreError, OSError) as error:
            refused.append(str(error))

    tries = [threading.Thread(target=try_it) for _ in range(6)]
    for lock in tries:
        lock.start()
    for lock in tries:
        lock.join()
    assert len(outcomes) == 1 and len(refused) == 5
    assert outcomes[0].is_held_by_this_process()
    outcomes[0].release()
    assert read_lock_holder(path) is None
    StoreLock(path).release()


def test_a_lock_whose_answers_are_lost_is_had_kept_and_left(faults, place):
    faults.fate = lambda number, method, path: (
        DROP_REPLY if method == "PUT" and number % 2 else PASS_ON
    )
    lock = StoreLock(parse_location(place))
    assert lock.is_held_by_this_process()
    lock._lock.send_heartbeat()
    lock._lock.send_heartbeat()
    assert lock.is_held_by_this_process()
    lock.release()
    assert read_lock_holder(parse_location(place)) is None


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f, m: None, "has no bucket 'absent'"),
        (lambda f, m: m.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9"), "can't be reached"),
        (lambda f, m: m.delenv("AWS_SECRET_ACCESS_KEY"), "no credentials are set"),
        (lambda f, m: setattr(f, "fate", lambda *_: REPLY_403), "refuses access"),
        (lambda f, m: setattr(f, "fate", lambda *_: REPLY_503), "keeps failing"),
    ],
    ids=["no bucket", "nobody there", "no credentials", "refused", "broken"],
)
@pytest.mark.parametrize("command", ["status", "resume"])
def test_what_is_wrong_is_said_in_one_line(faults, monkeypatch, spoil, message, command):
    few = {**locations.FIRST_CONTACT_RETRY_CONFIG, "max_retries": 1}
    monkeypatch.setattr(locations, "FIRST_CONTACT_RETRY_CONFIG", few)
    spoil(faults, monkeypatch)
    result = CliRunner().invoke(main, [command, "s3://absent/x.zarr"])
    assert result.exit_code == 2 and message in result.output
    assert result.output.count("\n") == 1 and "Traceback" not in result.output


def test_figures_that_are_no_status_are_not_taken_for_one():
    message = "Server error, status code: 503 Service Unavailable, after 2.403s"
    number, words = locations.object_store_errno_and_message(message, "s3://bucket")
    assert number == errno.EIO and words.endswith(
        "keeps failing (503 Service Unavailable): try again"
    )


def test_an_address_without_a_key_is_refused():
    result = CliRunner().invoke(main, ["status", "s3://bucket"])
    assert result.exit_code == 2 and "write s3://BUCKET/NAME.zarr" in result.output


def test_what_is_somebody_elses_is_not_written_over(memory):
    foreign_file = parse_location(memory) / "letters" / "one.txt"
    foreign_file.write_bytes(b"dear")
    with pytest.raises(StoreError, match="something else is at"):
        run_serially(six_block_spec(), memory)
    assert foreign_file.read_bytes() == b"dear"


def test_a_creation_cut_short_looks_like_no_store_and_is_cleared(
    faults, place, serial_store, monkeypatch
):
    monkeypatch.setattr(locations, "RETRY_CONFIG", {**locations.RETRY_CONFIG, "max_retries": 0})
    faults.fate = lambda n, method, path: REPLY_503 if path.endswith("range/zarr.json") else PASS_ON
    with pytest.raises(StoreError, match="can't be made"):
        run_serially(six_block_spec(seed=4), place)
    assert not parse_location(place).exists()
    faults.fate = lambda *_: PASS_ON
    assert run_serially(six_block_spec(), place).complete
    assert remote_tree(place) == file_digests(serial_store)


def test_nothing_is_overwritten_where_nothing_can_be_set_aside(memory, serial_store):
    run_serially(six_block_spec(), memory)
    with pytest.raises(StoreError, match="another study"):
        run_serially(six_block_spec(seed=4), memory)
    with pytest.raises(StoreError, match="an object store has no renaming: name another place"):
        run_serially(six_block_spec(seed=4), memory, scheduler="none", overwrite=True)
    assert remote_tree(memory) == file_digests(serial_store)


def test_damage_is_found_and_mended(memory, serial_store):
    run_serially(six_block_spec(), memory)
    chunk = parse_location(memory) / "pd_up" / "c" / "0" / "2"
    chunk.write_bytes(b"x" + chunk.read_bytes()[1:])
    (parse_location(memory) / "range" / "zarr.json").unlink()
    (report,) = verify(memory, repair=True, progress=False)
    assert report.restored_objects == ("range/zarr.json",)
    assert {damage.block for damage in report.damages} == {2}
    outcome = resume(memory, scheduler="none", progress=False)
    assert outcome.complete and outcome.blocks_computed == 1
    assert remote_tree(memory) == file_digests(serial_store)


def test_receipts_are_gathered_in_objects_of_some_seconds(memory, monkeypatch):
    monkeypatch.setattr(store_format, "LOG_OBJECT_INTERVAL_SECONDS", 1e9)
    outcome = run_serially(six_block_spec(), memory)
    assert outcome.complete and outcome.blocks_computed == N_BLOCKS
    log = parse_location(memory) / JOURNAL_DIR / "receipts.jsonl"
    assert len(store_format.list_log_objects(log)) <= 2  # the first at once, the others at the end
    assert sorted(receipts(memory)) == list(range(N_BLOCKS))


@pytest.mark.parametrize("objects_max", [1, 2, 100])
def test_many_objects_of_a_log_become_few_and_say_the_same(memory, monkeypatch, objects_max):
    monkeypatch.setattr(store_format, "LOG_OBJECTS_MAX", objects_max)
    monkeypatch.setattr(store_format, "MERGED_LOG_OBJECT_TARGET_BYTES", 200)
    path = parse_location(memory) / "log"
    log = store_format.ObjectStoreLog(path)
    lines = [encode_log_record({"block": block, "text": "x" * 50}) for block in range(9)]
    for line in lines:
        log.append(line)
        log.flush(force=True)
    (path / store_format.list_log_objects(path)[4]).write_bytes(lines[4][:-9] + b"\n")
    log.remove_damaged_lines(lambda line: decode_log_record(line) is not None)
    assert list(store_format.iter_raw_lines(path)) == lines[:4] + lines[5:]
    assert len(store_format.list_log_objects(path)) == (9 if objects_max == 100 else 3)
    reopened = store_format.ObjectStoreLog(path)
    reopened.append(lines[4])
    reopened.flush(force=True)
    assert list(store_format.iter_raw_lines(path)) == [*lines[:4], *lines[5:], lines[4]]


def test_plain_zarr_libraries_read_it(faults, place, serial_store):
    """Without a line of ours between: through obstore and Zarr as anybody uses them."""
    from obstore.store import S3Store
    from zarr.storage import ObjectStore

    run_serially(six_block_spec(), place)
    key = place.removeprefix("s3://bucket/")
    client = S3Store("bucket", prefix=key, client_options={"allow_http": True})
    dataset = xr.open_zarr(ObjectStore(client))
    expected = xr.open_zarr(serial_store)
    assert set(dataset.data_vars) == set(expected.data_vars)
    np.testing.assert_array_equal(dataset.pd_shot.values, expected.pd_shot.values)


@pytest.fixture(scope="module")
def read_only_place(server):
    return f"s3://bucket/cut_bodies/{time.time_ns()}/small.zarr"


@pytest.mark.parametrize("fate", [CUT_BODY, HALVE_BODY])
@pytest.mark.parametrize("part", ["small.zarr/zarr.json", "range/c/0", "pd_shot/c/", "receipts"])
def test_a_body_that_is_cut_is_read_once_more(faults, read_only_place, part, fate):
    if not parse_location(read_only_place).exists():
        assert run_serially(six_block_spec(), read_only_place).complete
    cut: set[str] = set()

    def once(number, method, path):
        if method != "GET" or part not in path or "list-type" in path or path in cut:
            return PASS_ON
        cut.add(path)
        return fate

    faults.fate = once
    dataset = sweep.open(read_only_place)
    assert np.isfinite(dataset.pd_shot.compute()).all() and cut
    cut.clear()
    (report,) = verify(read_only_place, progress=False)
    assert cut and report.is_undamaged and report.complete
    assert dataset.blocks_committed == dataset.blocks


@pytest.mark.parametrize("fate", [CUT_BODY, HALVE_BODY])
def test_a_body_that_is_cut_each_time_is_reported(faults, read_only_place, fate):
    if not parse_location(read_only_place).exists():
        assert run_serially(six_block_spec(), read_only_place).complete
    faults.fate = lambda number, method, path: fate if path.endswith("/zarr.json") else PASS_ON
    result = CliRunner().invoke(main, ["status", read_only_place])
    assert result.exit_code == 2 and "Traceback" not in result.output
    assert ("is damaged" if fate == HALVE_BODY else "cuts its answers short") in result.output


def one_in(period, fate, is_one):
    """Fate of one in so many requests for the same, the first among them; the others pass."""
    requests = Counter()  # requests come from several threads

    def of(number, method, path):
        if method != "GET" or not is_one(path):
            return PASS_ON
        requests[path] += 1
        return fate if requests[path] % period == 1 % period else PASS_ON

    return of


def is_lock(path):
    return path.partition("?")[0].endswith("/lock") and "list-type" not in path


def is_listing(path):
    return "list-type" in path


@pytest.mark.parametrize("fate", [CUT_BODY, HALVE_BODY])
def test_a_lock_whose_answers_are_cut_is_read_once_more(faults, place, fate):
    faults.fate = one_in(3, fate, is_lock)
    outcome = run_serially(six_block_spec(), place)
    assert faults.seen[fate] > 2
    assert outcome.complete and not outcome.stop_reason


@pytest.mark.parametrize("fate", [CUT_BODY, HALVE_BODY])
def test_a_lock_that_is_cut_twice_is_no_strangers(faults, place, fate):
    with StoreLock(parse_location(place)) as lock:
        faults.fate = one_in(1, fate, is_lock)
        with pytest.raises(ObjectStoreError, match="cuts its answers short: try again"):
            lock.is_held_by_this_process()
        faults.fate = lambda *_: PASS_ON
        assert lock.is_held_by_this_process()


def test_a_lock_that_is_damaged_as_a_whole_is_nobodys(faults, place):
    path = parse_location(place) / JOURNAL_DIR / "lock"
    path.write_bytes(b'{"host":"elsewhe')
    assert read_lock_holder(parse_location(place)) == LockHolder()


@pytest.mark.parametrize("fate", [CUT_BODY, HALVE_BODY])
def test_a_listing_that_is_cut_is_asked_for_once_more(faults, read_only_place, fate):
    if not parse_location(read_only_place).exists():
        assert run_serially(six_block_spec(), read_only_place).complete
    listed = sorted(parse_location(read_only_place).iter_objects_below())
    names = [key for key in listed if "sessions" not in key[0]]
    faults.fate = one_in(2, fate, is_listing)
    for command in ("status", "verify"):
        result = CliRunner().invoke(main, [command, read_only_place])
        assert result.exit_code == 0, result.output
    assert np.isfinite(sweep.open(read_only_place).pd_shot.compute()).all()
    assert resume(read_only_place, scheduler="none", progress=False).complete
    listed = sorted(parse_location(read_only_place).iter_objects_below())
    assert [key for key in listed if "sessions" not in key[0]] == names
    locations._client_by_bucket_url.clear()
    assert parse_location(read_only_place).exists()  # at first contact too
    assert faults.seen[fate] > 4


def test_a_listing_of_several_pages_goes_on_where_it_was_cut(faults, place):
    names = [f"{number:04d}" for number in range(1100)]  # a page of S3's has 1000
    locations.map_concurrently(
        parse_location(place), lambda name: (parse_location(place) / name).write_bytes(b"x"), names
    )
    listings = [0]

    def second(number, method, path):
        listings[0] += is_listing(path)
        return CUT_BODY if is_listing(path) and listings[0] == 2 else PASS_ON

    faults.fate = second
    assert [name for name, _ in parse_location(place).iter_objects_below()] == names
    assert listings[0] == 3


@pytest.mark.parametrize("fate", [CUT_BODY, HALVE_BODY])
def test_a_listing_that_is_cut_twice_is_reported_in_words(faults, read_only_place, fate):
    if not parse_location(read_only_place).exists():
        assert run_serially(six_block_spec(), read_only_place).complete
    faults.fate = one_in(1, fate, is_listing)
    for command in ("status", "verify"):
        result = CliRunner().invoke(main, [command, read_only_place])
        assert result.exit_code == 2
        assert "cuts its answers short: try again" in result.output
        assert "Generic" not in result.output and "Traceback" not in result.output


@pytest.mark.parametrize("fate", [CUT_BODY, HALVE_BODY])
def test_chunks_that_are_cut_twice_are_not_damaged(faults, read_only_place, fate):
    if not parse_location(read_only_place).exists():
        assert run_serially(six_block_spec(), read_only_place).complete
    n_receipts = receipts(read_only_place)
    faults.fate = one_in(1, fate, lambda path: "pd_shot/c/" in path)
    with pytest.raises(
        ObjectStoreError, match=r"pd_shot.*cuts its answers short|small.zarr: .*cuts"
    ):
        sweep.open(read_only_place).pd_shot.compute()
    checked = CliRunner().invoke(main, ["verify", read_only_place])
    assert checked.exit_code == 2
    assert "cuts its answers short" in checked.output
    assert "damaged" not in checked.output and "checksum" not in checked.output
    faults.fate = lambda *_: PASS_ON
    assert receipts(read_only_place) == n_receipts


def test_lines_of_a_log_that_are_cut_twice_are_not_dropped(faults, place):
    assert run_serially(six_block_spec(), place).complete
    n_receipts = receipts(place)
    faults.fate = one_in(
        1, HALVE_BODY, lambda path: "receipts.jsonl/" in path and "list-type" not in path
    )
    with pytest.raises(ObjectStoreError, match="cuts its answers short"):
        store_format.open_log(
            parse_location(place) / JOURNAL_DIR / "receipts.jsonl"
        ).remove_damaged_lines(lambda line: decode_log_record(line) is not None)
    faults.fate = lambda *_: PASS_ON
    assert receipts(place) == n_receipts
