"""The log of what is committed: one JSON line a block, written after its chunks.

A block is done when its receipt is in the log and its objects are in the store; what is not done is
computed again, to the same bytes. The log is only appended to, by the one driver that holds the
store's lock; a receipt whose chunks were later found damaged is withdrawn by a further line. Every
line carries its own digest, and one that is damaged counts for nothing.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from sweep.tasks import store
from sweep.tasks.sealing import damaged_lines, read_sealed, sealed
from sweep.tasks.study import Study

RECEIPTS = "receipts.jsonl"
FAILURES = "failures.jsonl"
SESSIONS = "sessions.jsonl"
LOGS = (RECEIPTS, FAILURES, SESSIONS)


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
    """Logs of a store, to append to; on opening, lines that are damaged or cut short are dropped.

    No file stays open: a log in a directory that went away takes nothing more.

    Parameters
    ----------
    store_path
        The store, whose lock the caller holds.
    durable
        Whether a receipt is on the disk, and not only with the operating system, once committed.
    """

    def __init__(self, store_path: Path, *, durable: bool = False) -> None:
        self._directory, self._durable = store_path / store.JOURNAL, durable
        self._directory.mkdir(exist_ok=True)
        for name in LOGS:
            drop_damaged(self._directory / name)

    def commit(self, receipt: Receipt) -> None:
        """Append a receipt: from here on its block is done."""
        self._append(RECEIPTS, {**asdict(receipt), "time": round(time.time(), 3)})

    def withdraw(self, block: int, why: str) -> None:
        """Take back the receipt of a block: from here on it is to be computed again."""
        self._append(RECEIPTS, {"block": block, "withdrawn": why, "time": round(time.time(), 3)})

    def record_failure(self, failure: Failure) -> None:
        """Append the error of a block that was given up."""
        self._append(FAILURES, asdict(failure))

    def record_session(self, event: str, **facts: Any) -> None:
        """Append what happened to a run: begun, ended, by whom and when."""
        self._append(SESSIONS, {"event": event, "time": time.time(), "utc": _now(), **facts})

    def _append(self, name: str, record: dict[str, Any]) -> None:
        """Append one line, whole or not at all.

        Raises
        ------
        OSError
            Where it can't be written.
        """
        line = sealed(record)
        log = os.open(self._directory / name, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        try:
            size = os.fstat(log).st_size
            if os.write(log, line) < len(line):  # the disk is full
                os.ftruncate(log, size)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._directory / name))
            if self._durable:
                os.fsync(log)
        finally:
            os.close(log)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def drop_damaged(path: Path) -> None:
    """Take lines out of a log that are damaged, or cut short by their writer's death."""
    if not damaged_lines(path):
        return
    draft = path.with_name(f"{path.name}.{os.getpid()}")
    with open(draft, "wb") as whole:
        whole.writelines(line for line, record in read_sealed(path) if record is not None)
    os.replace(draft, path)


def read_lines(path: Path) -> Iterator[dict[str, Any]]:
    """Records of a log, in order; a line that is damaged or cut short is passed over."""
    return (record for _, record in read_sealed(path) if record is not None)


def digests(store_path: Path, n_blocks: int) -> np.ndarray:
    """Digests of the blocks that were committed, (blocks,) of bytes, empty where there is none."""
    found = np.zeros(n_blocks, dtype="S32")
    for record in read_lines(receipts_path(store_path)):
        if 0 <= record["block"] < n_blocks:
            found[record["block"]] = record.get("digest", "")  # none in a line that withdraws
    return found


def committed(store_path: Path, study: Study) -> np.ndarray:
    """Which blocks are done.

    Returns
    -------
    ndarray of bool (blocks,)
        True where there is a receipt and every object of the block is in the store.
    """
    done = np.zeros(study.n_blocks, dtype=bool)
    for record in read_lines(receipts_path(store_path)):
        if 0 <= record["block"] < study.n_blocks:
            done[record["block"]] = "withdrawn" not in record
    for block in np.flatnonzero(done):
        done[block] = store.is_whole(store_path, store.block_objects(study, int(block)))
    return done


def failures(store_path: Path) -> dict[int, dict[str, Any]]:
    """Last recorded failure of each block that was given up."""
    records = read_lines(store_path / store.JOURNAL / FAILURES)
    return {record["block"]: record for record in records}


def given_up(store_path: Path, n_blocks: int) -> dict[int, dict[str, Any]]:
    """Last failure of each block that was given up and never done since."""
    found = failures(store_path)
    if found:
        for record in read_lines(receipts_path(store_path)):
            found.pop(record["block"], None)
    return {block: failure for block, failure in found.items() if block < n_blocks}


def sessions(store_path: Path) -> list[dict[str, Any]]:
    """Runs of a store, in order: when each began and how it ended."""
    return list(read_lines(store_path / store.JOURNAL / SESSIONS))
