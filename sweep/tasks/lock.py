"""One driver a store: a lock that says who holds it and whether they still live."""

from __future__ import annotations

import fcntl
import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

import psutil

from sweep.tasks.errors import StoreError
from sweep.tasks.store import JOURNAL

LOCK = "lock"

#: Seconds between heartbeats, and how old one may be before a holder on another host is dead.
HEARTBEAT = 10.0
EXPIRY = 120.0


@dataclass(frozen=True, kw_only=True)
class Holder:
    """Who holds a lock."""

    host: str
    pid: int
    started: float  # of the process [s since the epoch]: a number is used again, a start is not
    token: str

    @classmethod
    def myself(cls) -> Holder:
        """The running process, with a token of its own."""
        pid = os.getpid()
        return cls(
            host=socket.gethostname(), pid=pid, started=_start_of(pid), token=uuid.uuid4().hex
        )


def _start_of(pid: int) -> float:
    try:
        return psutil.Process(pid).create_time()
    except psutil.Error:
        return 0.0


def holder(store_path: Path) -> Holder | None:
    """Who holds the lock of a store, living or dead; None where nobody does."""
    try:
        return Holder(**json.loads((store_path / JOURNAL / LOCK).read_text()))
    except FileNotFoundError:
        return None
    except (ValueError, TypeError):
        return Holder(host="unknown", pid=0, started=0.0, token="")


def is_live(store_path: Path, who: Holder) -> bool:
    """Whether the holder of a lock still runs.

    On this host the process itself is asked for. Elsewhere the heartbeat decides, its age taken by
    the clock of the file system that both write to.
    """
    if who.host == socket.gethostname():
        return abs(_start_of(who.pid) - who.started) < 1.0
    return heartbeat_age(store_path) < EXPIRY


def heartbeat_age(store_path: Path) -> float:
    """Age of a lock's last heartbeat [s]; infinite where there is no lock."""
    probe = store_path / JOURNAL / f"clock-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    try:
        probe.touch()
        return probe.stat().st_mtime - (store_path / JOURNAL / LOCK).stat().st_mtime
    except FileNotFoundError:
        return float("inf")
    except PermissionError:  # a reader of a store that it can't write to
        return time.time() - (store_path / JOURNAL / LOCK).stat().st_mtime
    finally:
        with suppress(OSError):
            probe.unlink()


class Lock:
    """A store's lock, held and kept alive until released.

    Raises
    ------
    StoreError
        Where a living driver holds it, or the store can't be written.
    """

    def __init__(self, store_path: Path) -> None:
        self._store, self._path = store_path, store_path / JOURNAL / LOCK
        self._me = Holder.myself()
        self._released = threading.Event()
        try:
            self._acquire()
        except OSError as error:
            raise StoreError(f"{store_path} can't be locked: {error.strerror or error}") from error
        self._beating = threading.Thread(target=self._beat, name="lock-heartbeat", daemon=True)
        self._beating.start()

    def _acquire(self) -> None:
        self._path.parent.mkdir(exist_ok=True)
        with _guard(self._path.with_name("lock.guard")):
            other = holder(self._store)
            if other and is_live(self._store, other):
                raise StoreError(
                    f"{self._store} is being written by process {other.pid} on {other.host}: "
                    "wait for it, or stop it; `sweep status` shows how far it is"
                )
            self._path.unlink(missing_ok=True)
            mine = self._path.with_name(f"lock.{self._me.token}")
            mine.write_text(json.dumps(asdict(self._me)))
            try:
                os.link(mine, self._path)  # fails where somebody was quicker, on NFS too
            finally:
                mine.unlink()

    def _beat(self) -> None:
        while not self._released.wait(HEARTBEAT):
            with suppress(OSError):
                if self.is_mine():
                    os.utime(self._path)

    def is_mine(self) -> bool:
        """Whether the lock is still this driver's."""
        who = holder(self._store)
        return who is not None and who.token == self._me.token

    def release(self) -> None:
        """Give the lock up, if it is still ours."""
        self._released.set()
        self._beating.join()
        with suppress(OSError):
            if self.is_mine():
                self._path.unlink(missing_ok=True)


@contextmanager
def _guard(path: Path) -> Iterator[None]:
    """Only one process at a time judges whether a lock is dead and takes its place."""
    with open(path, "a") as guard:
        fcntl.flock(guard, fcntl.LOCK_EX)
        yield
