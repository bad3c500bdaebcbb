"""One driver a store: a lock that says who holds it and whether they still live."""

from __future__ import annotations

import fcntl
import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import psutil

from sweep.storage.locations import (
    JOURNAL,
    Location,
    ObjectPath,
    ObjectStoreError,
    Tag,
    put_whole,
)
from sweep.tasks.errors import BusyError, told

LOCK = "lock"

#: Tries at a lock in an object store that others try for, too.
TRIES = 5

#: Seconds between heartbeats, and how old one may be before a holder on another host is dead.
HEARTBEAT = 10.0
EXPIRY = 120.0

_left: set[str] = set()
"""Tokens of locks that this process has given up, which a store out of reach may not know."""


@dataclass(frozen=True, kw_only=True)
class Holder:
    """Holder of a lock."""

    host: str
    pid: int
    started: float  # of the process [s since the epoch]: a number is used again, a start is not
    token: str
    machine: str = ""  # hosts of one name may be many, where a store is seen from everywhere

    @classmethod
    def myself(cls) -> Holder:
        """Return the running process, with a token of its own."""
        pid = os.getpid()
        return cls(
            host=socket.gethostname(),
            pid=pid,
            started=_start_of(pid),
            token=uuid.uuid4().hex,
            machine=_machine(),
        )


def _start_of(pid: int) -> float:
    try:
        return psutil.Process(pid).create_time()
    except psutil.Error:
        return 0.0


@cache
def _machine() -> str:
    """Boot and namespace in which a process number has a meaning."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def holder(store_path: Location) -> Holder | None:
    """Holder of the lock of a store, living or dead; None where nobody does."""
    text = _claim(store_path).read()
    if text is None:
        return None
    try:
        return Holder(**json.loads(text))
    except (ValueError, TypeError):
        return Holder(host="unknown", pid=0, started=0.0, token="")


def is_live(store_path: Location, who: Holder) -> bool:
    """Tell whether the holder of a lock runs: its process here, its heartbeat elsewhere."""
    if who.host == socket.gethostname() and who.machine in ("", _machine()):
        return abs(_start_of(who.pid) - who.started) < 1.0
    return heartbeat_age(store_path) < EXPIRY


def heartbeat_age(store_path: Location) -> float:
    """Age of a lock's last heartbeat [s], by the file system's clock; infinite without one."""
    path = store_path / JOURNAL / LOCK
    probe = path.with_name(f"clock-{os.getpid()}-{uuid.uuid4().hex[:8]}")
    now: float | None = None
    try:
        probe.write_bytes(b"clock")
        now = _modified(probe)
    except OSError:
        pass  # a reader of a store that it can't write to
    finally:
        with suppress(OSError):
            probe.unlink()
    beaten = _modified(path)
    return float("inf") if beaten is None else (now or time.time()) - beaten


def _modified(path: Location) -> float | None:
    if isinstance(path, ObjectPath):
        return path.modified()
    try:
        return path.stat().st_mtime
    except FileNotFoundError:
        return None


class _FileClaim:
    """A lock as a file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self) -> str | None:
        """Text of its holder; None where nobody holds it."""
        try:
            return self._path.read_text()
        except FileNotFoundError:
            return None

    def take(self, text: str, judge: Callable[[], None]) -> None:
        """Take it, unless `judge`, asked while no other process judges, raises."""
        self._path.parent.mkdir(exist_ok=True)
        with open(self._path.with_name("lock.guard"), "a") as guard:
            fcntl.flock(guard, fcntl.LOCK_EX)  # one process at a time judges and takes
            judge()
            self._path.unlink(missing_ok=True)
            mine = self._path.with_name(f"lock.{uuid.uuid4().hex}")
            put_whole(mine, text.encode())  # an empty lock, after a power cut, would look alive
            try:
                os.link(mine, self._path)  # fails where somebody was quicker, on NFS too
            finally:
                mine.unlink()

    def beat(self) -> None:
        """Say that the holder lives."""
        os.utime(self._path)

    def leave(self) -> None:
        """Give it up."""
        self._path.unlink(missing_ok=True)


class _ObjectClaim:
    """A lock as an object, changed by conditional puts: its holder, and a count of heartbeats."""

    def __init__(self, path: ObjectPath) -> None:
        self._path = path
        self._text, self._beats = "", 0
        self._tag: Tag | None = None

    def read(self) -> str | None:
        """Text of its holder; None where nobody holds it."""
        found = self._path.read_tagged()
        return _first_line(found[0]) if found and found[0] else None

    def take(self, text: str, judge: Callable[[], None]) -> None:
        """Take it, unless `judge` raises."""
        for _ in range(TRIES):
            found = self._path.read_tagged()
            if found and _first_line(found[0]) == text:  # put, though its answer was lost
                self._text, self._tag = text, found[1]
                return
            judge()
            tag = self._path.put_if(f"{text}\n0\n".encode(), found[1] if found else None)
            if tag is not None:
                self._text, self._tag = text, tag
                return
        raise ObjectStoreError(11, "others are quicker to lock it: try again", str(self._path))

    def beat(self) -> None:
        """Say that the holder lives."""
        self._change(f"{self._text}\n{self._beats + 1}\n")
        self._beats += 1

    def leave(self) -> None:
        """Give it up."""
        self._change("")

    def _change(self, text: str) -> None:
        """Put something in the place of what was last put; of what is there, where that is ours."""
        tag = self._path.put_if(text.encode(), self._tag)
        if tag is None:
            found = self._path.read_tagged()
            if found and _first_line(found[0]) == self._text:
                tag = self._path.put_if(text.encode(), found[1])
        if tag is not None:
            self._tag = tag


def _first_line(content: bytes) -> str:
    return content.decode("utf-8", "replace").partition("\n")[0]


def _claim(store_path: Location) -> _FileClaim | _ObjectClaim:
    path = store_path / JOURNAL / LOCK
    return _ObjectClaim(path) if isinstance(path, ObjectPath) else _FileClaim(path)


class Lock:
    """A store's lock, held and kept alive until released.

    BusyError where a living driver holds it, StoreError where the store can't be written.
    """

    def __init__(self, store_path: Location) -> None:
        self._store, self._claim = store_path, _claim(store_path)
        self._me = Holder.myself()
        self._released = threading.Event()
        with told(f"{store_path} can't be locked"):
            self._claim.take(json.dumps(asdict(self._me)), self._refuse_a_living_one)
        self._beating = threading.Thread(target=self._beat, name="lock-heartbeat", daemon=True)
        self._beating.start()

    def _refuse_a_living_one(self) -> None:
        other = holder(self._store)
        if other and other.token not in _left and is_live(self._store, other):
            raise BusyError(
                f"{self._store} is being written by process {other.pid} on {other.host}: "
                "wait for it, or stop it; `sweep status` shows how far it is"
            )

    def _beat(self) -> None:
        while not self._released.wait(HEARTBEAT):
            with suppress(OSError):
                if self.is_mine():
                    self._claim.beat()

    def is_mine(self) -> bool:
        """Tell whether the lock is still this driver's."""
        who = holder(self._store)
        return who is not None and who.token == self._me.token

    def __enter__(self) -> Lock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def release(self) -> None:
        """Give the lock up, if it is still ours."""
        self._released.set()
        self._beating.join()
        _left.add(self._me.token)
        with suppress(OSError):
            if self.is_mine():
                self._claim.leave()
