"""The log of what is committed: one JSON line a block, written after its chunks.

A block is done when its receipt is in the log and its objects are in the store; what is not done is
computed again, to the same bytes. The log is only appended to, by the one driver that holds the
store's lock; a receipt whose chunks were later found damaged is withdrawn by a further line. Every
line carries its own digest, and one that is damaged counts for nothing.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np

from sweep.storage.locations import Location
from sweep.storage.logs import open_log
from sweep.storage.receipts import RECEIPTS, read_receipts
from sweep.storage.sealing import body_of, read_lines, sealed
from sweep.tasks import store
from sweep.tasks.listing import listed
from sweep.tasks.study import Study

FAILURES = "failures.jsonl"
SESSIONS = "sessions.jsonl"
LOGS = (RECEIPTS, FAILURES, SESSIONS)


@dataclass(frozen=True, kw_only=True)
class Receipt:
    """What a worker says of a block it has written."""

    block: int
    points: int
    bytes: int  # as stored
    digest: str  # of the bytes stored, `sealing.digest`
    seconds: float  # evaluating and writing
    write_seconds: float
    host: str
    pid: int
    versions: dict[str, str]
    taken: int = 0  # of its points, those that a smaller study's store had


@dataclass(frozen=True, kw_only=True)
class Failure:
    """What went wrong with a block, and where."""

    block: int
    error: str
    traceback: str
    host: str
    pid: int


def receipts_path(store_path: Location) -> Location:
    """The log of receipts of a store."""
    return store_path / store.JOURNAL / RECEIPTS


class Journal:
    """Logs of a store, to append to; on opening, lines that are damaged or cut short are dropped.

    Parameters
    ----------
    store_path
        The store, whose lock the caller holds.
    durable
        Whether a receipt is on the disk, and not only with the operating system, once committed.
    """

    def __init__(self, store_path: Location, *, durable: bool = False) -> None:
        directory = store_path / store.JOURNAL
        self._logs = {name: open_log(directory / name, durable=durable) for name in LOGS}
        for name in LOGS:
            drop_damaged(directory / name)

    def commit(self, *receipts: Receipt) -> None:
        """Append receipts: from here on their blocks are done.

        In an object store that is so some seconds later (`flush`): till then they are gathered.
        """
        now = round(time.time(), 3)
        self._append(RECEIPTS, *({**asdict(receipt), "time": now} for receipt in receipts))

    def withdraw(self, block: int, why: str) -> None:
        """Take back the receipt of a block: from here on it is to be computed again."""
        self._append(RECEIPTS, {"block": block, "withdrawn": why, "time": round(time.time(), 3)})

    def flush(self, *, now: bool = False) -> bool:
        """Write what was gathered, if it is time to; whether nothing is left to write."""
        written = [log.flush(now=now) for log in self._logs.values()]
        return all(written)

    def record_failure(self, failure: Failure) -> None:
        """Append the error of a block that was given up."""
        self._append(FAILURES, asdict(failure))

    def record_session(self, event: str, **facts: Any) -> None:
        """Append what happened to a run: begun, ended, by whom and when; all else is written."""
        self._append(SESSIONS, {"event": event, "time": time.time(), "utc": _now(), **facts})
        self.flush(now=True)

    def _append(self, name: str, *records: dict[str, Any]) -> None:
        """Append lines, whole or not at all.

        Raises
        ------
        OSError
            Where they can't be written.
        """
        if records:
            self._logs[name].append(b"".join(map(sealed, records)))


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def drop_damaged(path: Location) -> None:
    """Take lines out of a log that are damaged, or cut short by their writer's death."""
    open_log(path).keep(lambda line: body_of(line) is not None)


def digests(store_path: Location, n_blocks: int) -> np.ndarray:
    """Digests of the blocks that were committed, (blocks,) of bytes, empty where there is none."""
    found = np.zeros(n_blocks, dtype="S32")
    for record in read_lines(receipts_path(store_path)):
        if 0 <= record["block"] < n_blocks:
            found[record["block"]] = record.get("digest", "")  # none in a line that withdraws
    return found


def receipted(store_path: Location, study: Study) -> np.ndarray:
    """Which blocks have a receipt, (blocks,) bool; whether their chunks are there is not seen."""
    return read_receipts(store_path, study.n_blocks).points > 0


def committed(store_path: Location, study: Study) -> np.ndarray:
    """Which blocks are done.

    Returns
    -------
    ndarray of bool (blocks,)
        True where there is a receipt and every object of the block is in the store.
    """
    return listed(store_path, study, receipted(store_path, study))


def failures(store_path: Location) -> dict[int, dict[str, Any]]:
    """Last recorded failure of each block that was given up."""
    records = read_lines(store_path / store.JOURNAL / FAILURES)
    return {record["block"]: record for record in records}


def given_up(store_path: Location, n_blocks: int) -> dict[int, dict[str, Any]]:
    """Last failure of each block that was given up and never done since."""
    found = failures(store_path)
    if found:
        for record in read_lines(receipts_path(store_path)):
            found.pop(record["block"], None)
    return {block: failure for block, failure in found.items() if block < n_blocks}


def sessions(store_path: Location) -> list[dict[str, Any]]:
    """Runs of a store, in order: when each began and how it ended."""
    return list(read_lines(store_path / store.JOURNAL / SESSIONS))
