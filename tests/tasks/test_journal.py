import json

import pytest

from sweep.tasks import journal
from sweep.tasks.journal import Failure, Journal, Receipt


def receipt(block: int) -> Receipt:
    return Receipt(
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
        opened.close()
    records = list(journal.read_lines(journal.receipts_path(tmp_path)))
    assert [record["block"] for record in records] == [4, 2, 7]
    assert records[0]["digest"] == "ab"


@pytest.mark.parametrize(
    "tail", ['{"block":9', "\x00\xff", '{"block": 9, "seconds": 1}', "x" * 200_000]
)
def test_a_torn_last_line_is_cut_and_what_stands_before_it_stays(tmp_path, tail):
    opened = Journal(tmp_path)
    opened.commit(receipt(1))
    opened.close()
    path = journal.receipts_path(tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole + tail.encode("latin-1"))
    assert [record["block"] for record in journal.read_lines(path)] == [1]
    Journal(tmp_path).close()
    assert path.read_bytes() == whole


def test_a_log_that_is_one_torn_line_becomes_empty(tmp_path):
    log = tmp_path / "log"
    log.write_bytes(b'{"block"')
    journal.cut_torn_line(log)
    assert log.read_bytes() == b""
    journal.cut_torn_line(log)
    journal.cut_torn_line(tmp_path / "absent")
    assert log.read_bytes() == b""


def test_lines_that_are_no_records_are_passed_over(tmp_path):
    log = tmp_path / "log"
    log.write_text('{"block":1}\nnonsense\n[3]\n{"block":2}\n')
    assert [record["block"] for record in journal.read_lines(log)] == [1, 2]


def test_failures_keep_the_last_error_of_a_block_with_its_traceback(tmp_path):
    opened = Journal(tmp_path)
    for text in ("first", "second"):
        opened.record_failure(Failure(block=3, error=text, traceback="trace", host="h", pid=1))
    opened.close()
    assert journal.failures(tmp_path)[3]["error"] == "second"
    assert journal.failures(tmp_path)[3]["traceback"] == "trace"


def test_sessions_are_recorded_with_their_times(tmp_path):
    opened = Journal(tmp_path)
    opened.record_session("begun", pid=5)
    opened.close()
    (session,) = journal.sessions(tmp_path)
    assert session["event"] == "begun" and session["pid"] == 5 and session["time"] > 0
    assert json.dumps(session)
