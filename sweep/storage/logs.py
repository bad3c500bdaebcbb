"""Logs of lines: files that are appended to, or numbered objects in an object store.

Objects can't be appended to, so there a log is a row of them, each written whole and each holding
the lines of some seconds.
"""

from __future__ import annotations

import errno
import os
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

from sweep.storage.locations import REQUESTS, Location, each, put_whole
from sweep.storage.objects import ObjectPath

#: Seconds for which lines are gathered before they are put as one object.
WAVE = 1.0

#: Objects of a log beyond which they are put into few, and bytes of one of those.
MOST_SEGMENTS = 64
SEGMENT_BYTES = 16 << 20


class FileLog:
    """A file that is appended to, and not kept open: one whose directory went away takes no more.

    Parameters
    ----------
    path
        The file.
    durable
        Whether lines are on the disk, and not only with the operating system, once appended.
    """

    def __init__(self, path: Path, *, durable: bool = False) -> None:
        self._path, self._durable = path, durable

    def append(self, lines: bytes) -> None:
        """Append whole lines, all or none; they are there when this returns.

        Raises
        ------
        OSError
            Where they can't be written.
        """
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
        """Whether all is written: what is appended is."""
        return True

    def keep(self, is_sound: Callable[[bytes], bool]) -> None:
        """Drop the lines that are not sound."""
        if self._path.is_dir() or not all(map(is_sound, raw_lines(self._path))):
            lines = raw_lines(self._path)
            put_whole(self._path, b"".join(line for line in lines if is_sound(line)))


class ObjectLog:
    """A row of objects under a key, numbered in the order of writing.

    Parameters
    ----------
    path
        The key.
    """

    def __init__(self, path: ObjectPath) -> None:
        self._path = path
        self._number = max((_number(name) for name in segments(path)), default=0)
        self._lines: list[bytes] = []
        self._put = 0.0

    def append(self, lines: bytes) -> None:
        """Append whole lines; they are there after the next `flush` that writes."""
        self._lines.append(lines)

    def flush(self, *, now: bool = False) -> bool:
        """Put what was appended as an object, now or if the last one was put `WAVE` s ago.

        Returns
        -------
        bool
            Whether all is written.
        """
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
        """Put the sound lines of some objects in the place of the last one, then remove these.

        Cut short, it leaves lines twice: in their order they say the same as once.
        """
        sound = [line for line in lines if is_sound(line)]
        if len(names) == 1 and len(sound) == len(lines):
            return
        (self._path / _segment(_number(names[-1]))).write_bytes(b"".join(sound))
        each(self._path, lambda name: (self._path / name).unlink(), names)


Log = FileLog | ObjectLog


def open_log(path: Location, *, durable: bool = False) -> Log:
    """A log to append to; the caller sees to it that nobody else does."""
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
