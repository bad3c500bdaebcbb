"""Logs of lines that tell whether they are as they were written, and digests of stored objects.

A line is JSON with its own digest at the end. A log is a file that is appended to; in an object
store it is a row of numbered objects, each written whole, with the lines of some seconds.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sweep.storage.locations import JOURNAL, REQUESTS, Location, ObjectPath, each, put_whole

RECEIPTS = "receipts.jsonl"

#: Seconds for which lines are gathered before they are put as one object.
WAVE = 1.0

#: Objects of a log beyond which they are put into few, and bytes of one of those.
MOST_SEGMENTS = 64
SEGMENT_BYTES = 16 << 20

_SUM = b',"sum":"'
_END = b'"}\n'

_HEAD = re.compile(
    rb'\{"block":(\d{1,18}),"(?:points":(\d{1,18})(?:,"bytes":(\d{1,18}))?|withdrawn")'
)
_TIME = re.compile(rb'"time":(\d{1,10}(?:\.\d{1,20})?)$')
_WORKER = re.compile(rb'"host":"([^"]*)","pid":(\d+)')


def sealed(record: dict[str, Any]) -> bytes:
    """Write a record, not empty, as a line of JSON that ends with a digest of the others."""
    return closed(json.dumps(record, separators=(",", ":")).encode()[:-1])


def closed(body: bytes) -> bytes:
    """Return a line of the fields of a record, written without the last brace."""
    return body + _SUM + _digest(body) + _END


def unsealed(line: bytes) -> dict[str, Any] | None:
    """Return the record of a line, or None if any byte of it has changed."""
    body = body_of(line)
    if body is None:
        return None
    try:
        record = json.loads(body + b"}")
    except (ValueError, RecursionError):  # a stranger's, with a digest of its own
        return None
    return record if isinstance(record, dict) else None


def body_of(line: bytes) -> bytes | None:
    """Return the fields of a line, unread, without the last brace; None as of :func:`unsealed`."""
    body, found, end = line.rpartition(_SUM)
    return body if found and end == _digest(body) + _END else None


def _digest(body: bytes) -> bytes:
    return hashlib.blake2b(body, digest_size=8).hexdigest().encode()


def read_sealed(path: Location) -> Iterator[tuple[bytes, dict[str, Any] | None]]:
    """Lines of a log, and their records: None where damaged or cut short."""
    for line in raw_lines(path):
        yield line, unsealed(line)


def read_lines(path: Location) -> Iterator[dict[str, Any]]:
    """Read the records of a log, in order; damaged or truncated lines are skipped."""
    return (record for _, record in read_sealed(path) if record is not None)


def damaged_lines(path: Location) -> list[int]:
    """Numbers, from 1, of the lines of a log that are damaged or cut short."""
    return [n for n, (_, record) in enumerate(read_sealed(path), start=1) if record is None]


def digest(path: Location, objects: list[str]) -> str:
    """blake2b-128 of names and bytes of stored objects, in hex."""
    contents = each(path, lambda name: (path / name).read_bytes(), objects)
    return digest_of(zip(objects, contents, strict=True))


def digest_of(contents: Iterable[tuple[str, bytes]]) -> str:
    """As :func:`digest`, of names and bytes at hand."""
    sum_ = hashlib.blake2b(digest_size=16)
    for name, content in contents:
        sum_.update(f"{name}\0{len(content)}\0".encode())
        sum_.update(content)
    return sum_.hexdigest()


class FileLog:
    """A file that is appended to, and not kept open; on the disk at once where it is `durable`."""

    def __init__(self, path: Path, *, durable: bool = False) -> None:
        self._path, self._durable = path, durable

    def append(self, lines: bytes) -> None:
        """Append whole lines, all or none; OSError where they can't be written."""
        log = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o666)
        try:
            size = os.fstat(log).st_size
            if os.write(log, lines) < len(lines):  # the disk is full
                os.ftruncate(log, size)
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))
            if self._durable:
                os.fsync(log)
        finally:
            os.close(log)

    def flush(self, *, now: bool = False) -> bool:
        """Tell whether all is written: what is appended is."""
        return True

    def keep(self, is_sound: Callable[[bytes], bool]) -> None:
        """Drop the lines that are not sound."""
        if self._path.is_dir() or not all(map(is_sound, raw_lines(self._path))):
            lines = raw_lines(self._path)
            put_whole(self._path, b"".join(line for line in lines if is_sound(line)))


class ObjectLog:
    """A row of objects under a key, numbered in the order of writing."""

    def __init__(self, path: ObjectPath) -> None:
        self._path = path
        self._number = max((_number(name) for name in segments(path)), default=0)
        self._lines: list[bytes] = []
        self._put = 0.0

    def append(self, lines: bytes) -> None:
        """Append whole lines; they are there after the next `flush` that writes."""
        self._lines.append(lines)

    def flush(self, *, now: bool = False) -> bool:
        """Put what was appended as an object, now or `WAVE` s after the last; True if none left."""
        if not self._lines:
            return True
        if time.monotonic() - self._put < WAVE and not now:
            return False
        segment = self._path / _segment(self._number + 1)
        segment.write_bytes(b"".join(self._lines))
        self._number += 1
        self._lines.clear()
        self._put = time.monotonic()
        return True

    def keep(self, is_sound: Callable[[bytes], bool]) -> None:
        """Drop the lines that are not sound; where objects are many, put their lines in few."""
        names = segments(self._path)
        merging = len(names) > MOST_SEGMENTS
        group: list[str] = []
        lines: list[bytes] = []
        size = 0
        for name, content in _contents(self._path, names):
            group.append(name)
            lines += content.splitlines(keepends=True)
            size += len(content)
            if not merging or size > SEGMENT_BYTES or name == names[-1]:
                self._rewrite(group, lines, is_sound)
                group, lines, size = [], [], 0

    def _rewrite(
        self, names: list[str], lines: list[bytes], is_sound: Callable[[bytes], bool]
    ) -> None:
        """Put sound lines of objects in the last one's place; cut short, they are there twice."""
        sound = [line for line in lines if is_sound(line)]
        if len(names) == 1 and len(sound) == len(lines):
            return
        (self._path / _segment(_number(names[-1]))).write_bytes(b"".join(sound))
        each(self._path, lambda name: (self._path / name).unlink(), names)


def open_log(path: Location, *, durable: bool = False) -> FileLog | ObjectLog:
    """Open a log to append to; the caller ensures that nobody else does."""
    if isinstance(path, ObjectPath):
        return ObjectLog(path)
    path.parent.mkdir(exist_ok=True)
    return FileLog(path, durable=durable)


def segments(path: ObjectPath) -> list[str]:
    """Names of the objects of a log, in order."""
    return sorted(name for name, _ in path.below() if _number(name) > 0)


def _segment(number: int) -> str:
    """Name of an object; nobody else's, should two write against all precautions."""
    return f"{number:08d}-{uuid.uuid4().hex[:8]}"


def _number(segment: str) -> int:
    number = segment.partition("-")[0]
    return int(number) if number.isdigit() else 0


def _contents(path: ObjectPath, names: list[str]) -> Iterator[tuple[str, bytes]]:
    """Objects of a log with their names, some of them in memory at a time."""
    for start in range(0, len(names), REQUESTS):
        some = names[start : start + REQUESTS]
        yield from zip(some, each(path, lambda name: (path / name).read_bytes(), some), strict=True)


def raw_lines(path: Location) -> Iterator[bytes]:
    """Lines of a log in order, with their ends; of a small file too, in an object store."""
    if isinstance(path, ObjectPath):
        names = segments(path)
        if not names and path.size() > 0:
            yield from path.read_bytes().splitlines(keepends=True)
        for _, content in _contents(path, names):
            yield from content.splitlines(keepends=True)
    elif path.is_file():
        with open(path, "rb") as log:
            yield from log


@dataclass
class Receipts:
    """Sums of a log of receipts: which blocks are done, when, how fast."""

    points: np.ndarray  # (blocks,) int64: points of every block that is committed, 0 of the others
    sizes: np.ndarray  # (blocks,) int64: bytes of these as they are stored, where the receipt says
    first: float = np.inf
    last: float = -np.inf  # times of the first and last receipt [s since the epoch]
    recent: int = 0  # points committed since the time asked for
    workers: set[bytes] = field(default_factory=set)  # hosts and processes that computed them

    @property
    def blocks(self) -> int:
        """Number of blocks that are committed."""
        return int(np.count_nonzero(self.points))


def read_receipts(store: Location, n_blocks: int, *, since: float = np.inf) -> Receipts:
    """Sum the log of a store, points and workers `since` a time; damaged lines do not count."""
    found = Receipts(np.zeros(n_blocks, np.int64), np.zeros(n_blocks, np.int64))
    for line in raw_lines(store / JOURNAL / RECEIPTS):
        body = body_of(line)
        head = body and _HEAD.match(body)
        if not body or not head or (block := int(head[1])) >= n_blocks:
            continue
        found.points[block], found.sizes[block] = int(head[2] or 0), int(head[3] or 0)
        if head[2] and (said := _TIME.search(body, len(body) - 40)):
            _date(found, body, int(head[2]), float(said[1]), since)
    return found


def _date(found: Receipts, body: bytes, points: int, time: float, since: float) -> None:
    found.first, found.last = min(found.first, time), max(found.last, time)
    if time >= since:
        found.recent += points
        if worker := _WORKER.search(body):
            found.workers.add(worker[0])
