"""The log of what is committed: one JSON line a block, written after its chunks.

A block is done when its receipt is in the log and its objects are in the store; what is not done is
computed again, to the same bytes. The log is only appended to, by the one driver that holds the
store's lock.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from sweep.tasks import store
from sweep.tasks.study import Study

RECEIPTS = "receipts.jsonl"
FAILURES = "failures.jsonl"
SESSIONS = "sessions.jsonl"


@dataclass(frozen=True, kw_only=True)
class Receipt:
    """What a worker says of a block it has written."""

    block: int
    points: int
    digest: str  # of the bytes stored, `store.digest`
    seconds: float  # evaluating and writing
    write_seconds: float
    host: str
    pid: int
    versions: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class Failure:
    """What went wrong with a block, and where."""

    block: int
    error: str
    traceback: str
    host: str
    pid: int


def receipts_path(store_path: Path) -> Path:
    """The log of receipts of a store."""
    return store_path / store.JOURNAL / RECEIPTS


class Journal:
    """Logs of a store, open for appending; a torn last line is cut off on opening.

    Parameters
    ----------
    store_path
        The store, whose lock the caller holds.
    """

    def __init__(self, store_path: Path) -> None:
        self._directory = store_path / store.JOURNAL
        self._directory.mkdir(exist_ok=True)
        for name in (RECEIPTS, FAILURES, SESSIONS):
            cut_torn_line(self._directory / name)
        self._receipts = open(self._directory / RECEIPTS, "a", encoding="utf-8")  # noqa: SIM115

    def commit(self, receipt: Receipt) -> None:
        """Append a receipt: from here on its block is done."""
        self._receipts.write(_line({**asdict(receipt), "time": round(time.time(), 3)}))
        self._receipts.flush()

    def record_failure(self, failure: Failure) -> None:
        """Append the error of a block that was given up."""
        _append(self._directory / FAILURES, asdict(failure))

    def record_session(self, event: str, **facts: Any) -> None:
        """Append what happened to a run: begun, ended, by whom and when."""
        _append(
            self._directory / SESSIONS,
            {"event": event, "time": time.time(), "utc": _now(), **facts},
        )

    def close(self) -> None:
        """Close the log of receipts."""
        self._receipts.close()


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _line(record: dict[str, Any]) -> str:
    return json.dumps(record, separators=(",", ":")) + "\n"


def _append(path: Path, record: dict[str, Any]) -> None:
    with open(path, "a", encoding="utf-8") as log:
        log.write(_line(record))


def cut_torn_line(path: Path) -> None:
    """Cut what follows the last line end: a line whose writer was killed in its midst."""
    if not path.exists():
        return
    with open(path, "rb+") as log:
        size = log.seek(0, os.SEEK_END)
        end = _last_line_end(log, size)
        if end < size:
            log.truncate(end)


def _last_line_end(log: BinaryIO, size: int) -> int:
    step = 1 << 16
    for end in range(size, 0, -step):
        start = max(0, end - step)
        log.seek(start)
        found = log.read(end - start).rfind(b"\n")
        if found >= 0:
            return start + found + 1
    return 0


def read_lines(path: Path) -> Iterator[dict[str, Any]]:
    """Whole records of a log, in order; a line cut short is passed over."""
    if not path.exists():
        return
    with open(path, encoding="utf-8", errors="replace") as log:
        for line in log:
            if not line.endswith("\n"):
                return
            try:
                record = json.loads(line)
            except json.JSONDecodeError:
                continue
            if isinstance(record, dict):
                yield record


def committed(store_path: Path, study: Study) -> np.ndarray:
    """Which blocks are done.

    Returns
    -------
    ndarray of bool (blocks,)
        True where there is a receipt and every object of the block is in the store.
    """
    done = np.zeros(study.n_blocks, dtype=bool)
    for record in read_lines(receipts_path(store_path)):
        block = record.get("block", -1)
        if isinstance(block, int) and 0 <= block < study.n_blocks and not done[block]:
            done[block] = store.is_whole(store_path, store.block_objects(study, block))
    return done


def failures(store_path: Path) -> dict[int, dict[str, Any]]:
    """Last recorded failure of each block that was given up."""
    records = read_lines(store_path / store.JOURNAL / FAILURES)
    return {record["block"]: record for record in records if "block" in record}


def sessions(store_path: Path) -> list[dict[str, Any]]:
    """Runs of a store, in order: when each began and how it ended."""
    return list(read_lines(store_path / store.JOURNAL / SESSIONS))
