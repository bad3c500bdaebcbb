import os

import pytest

from sweep.storage.locations import JOURNAL_DIR
from sweep.storage.store_format import (
    RECEIPTS_FILE,
    decode_log_record,
    encode_log_record,
    iter_log_lines,
    iter_log_records,
    read_receipt_totals,
)
from sweep.tasks.engine import journal
from sweep.tasks.engine.journal import Failure, Journal, Receipt


def receipt(block: int) -> Receipt:
    return Receipt(
        bytes=100,
        block=block,
        points=8,
        digest="ab",
        seconds=1.0,
        write_seconds=0.1,
        host="here",
        pid=1,
        versions={},
    )


def test_receipts_are_lines_that_a_second_opening_appends_to(tmp_path):
    for blocks in ((4, 2), (7,)):
        opened = Journal(tmp_path)
        for block in blocks:
            opened.commit(receipt(block))
    records = list(iter_log_records(tmp_path / JOURNAL_DIR / RECEIPTS_FILE))
    assert [record["block"] for record in records] == [4, 2, 7]
    assert records[0]["digest"] == "ab"


def test_lines_that_are_not_as_they_were_written_are_passed_over_and_dropped(tmp_path):
    log = tmp_path / JOURNAL_DIR / RECEIPTS_FILE
    log.parent.mkdir()
    one, two, three = (encode_log_record({"block": block}) for block in (1, 2, 3))
    log.write_bytes(one + b'nonsense\n[3]\n{"block":4}\n' + two.replace(b"2", b"5", 1) + three)
    assert [record["block"] for record in iter_log_records(log)] == [1, 3]
    records = [record for _, record in iter_log_lines(log)]
    assert [n for n, record in enumerate(records, 1) if record is None] == [2, 3, 4, 5]
    Journal(tmp_path)
    assert log.read_bytes() == one + three
    log.write_bytes(b'{"block"')
    for _ in range(2):
        Journal(tmp_path)
        assert log.read_bytes() == b""


def test_no_byte_of_a_line_can_change_unseen():
    line = encode_log_record({"block": 12, "digest": "ab", "time": 1.5})
    assert decode_log_record(line) == {"block": 12, "digest": "ab", "time": 1.5}
    for place in range(len(line)):
        for bit in range(8):
            flipped = bytearray(line)
            flipped[place] ^= 1 << bit
            assert decode_log_record(bytes(flipped)) is None
        assert decode_log_record(line[:place]) is None
        assert decode_log_record(line[:place] + line[place + 1 :]) is None
        assert decode_log_record(line[:place] + b"x" + line[place:]) is None


def test_a_receipt_that_was_withdrawn_leaves_its_block_to_be_done_again(tmp_path):
    opened = Journal(tmp_path)
    opened.commit(receipt(1))
    opened.commit(receipt(2))
    opened.withdraw_receipt(1, "a chunk is damaged")
    assert journal.read_committed_digests(tmp_path, 4).tolist() == [b"", b"", b"ab", b""]
    opened.commit(receipt(1))
    assert journal.read_committed_digests(tmp_path, 4).tolist() == [b"", b"ab", b"ab", b""]


def test_a_block_that_failed_and_was_done_since_is_not_given_up(tmp_path):
    opened = Journal(tmp_path)
    for block in (1, 2):
        opened.record_failure(Failure(block=block, error="e", traceback="t", host="h", pid=1))
    opened.commit(receipt(1))
    assert list(journal.read_permanent_failures(tmp_path, 4)) == [2]
    assert list(journal.read_permanent_failures(tmp_path, 2)) == []
    opened.withdraw_receipt(1, "a chunk is damaged")
    assert list(journal.read_permanent_failures(tmp_path, 4)) == [2]


def test_a_line_that_the_disk_takes_in_part_is_taken_back(tmp_path, monkeypatch):
    opened = Journal(tmp_path)
    opened.commit(receipt(1))
    before = (tmp_path / JOURNAL_DIR / RECEIPTS_FILE).read_bytes()
    write = os.write
    monkeypatch.setattr(os, "write", lambda log, line: write(log, line[:20]))
    with pytest.raises(OSError, match="No space left"):
        opened.commit(receipt(2))
    assert (tmp_path / JOURNAL_DIR / RECEIPTS_FILE).read_bytes() == before


def test_runs_are_recorded_with_their_times(tmp_path):
    opened = Journal(tmp_path)
    assert journal.read_last_run(tmp_path) == journal.LastRun(start_time=float("inf"), n_threads=0)
    opened.record_run_event("begun", pid=5, threads=3)
    opened.record_run_event("ended", blocks=3)
    start_record, ended = iter_log_records(tmp_path / JOURNAL_DIR / journal.SESSION_LOG_FILE)
    assert start_record["event"] == "begun" and start_record["pid"] == 5 and ended["blocks"] == 3
    last_run = journal.read_last_run(tmp_path)
    assert last_run.start_time == start_record["time"] > 0 and last_run.n_threads == 3


@pytest.mark.parametrize(("n_blocks", "points"), [(2, [5, 0]), (3, [5, 0, 7]), (4, [5, 0, 7, 0])])
def test_receipts_of_other_blocks_count_for_nothing(tmp_path, n_blocks, points):
    (tmp_path / JOURNAL_DIR).mkdir()
    lines = [encode_log_record({"block": b, "points": p, "time": 1.5}) for b, p in ((0, 5), (2, 7))]
    (tmp_path / JOURNAL_DIR / RECEIPTS_FILE).write_bytes(b"".join(lines))
    assert read_receipt_totals(tmp_path, n_blocks).points_by_block.tolist() == points
