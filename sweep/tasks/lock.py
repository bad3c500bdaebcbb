"""One driver a store: a lock that says who holds it and whether they still live."""

from __future__ import annotations

import json
import os
import socket
import threading
import uuid
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import psutil

from sweep.storage.claims import Claim, claim
from sweep.storage.locations import JOURNAL, Location
from sweep.tasks.errors import BusyError, StoreError

LOCK = "lock"

_left: set[str] = set()
"""Tokens of locks that this process has given up, which a store out of reach may not know."""

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
    machine: str = ""  # hosts of one name may be many, where a store is seen from everywhere

    @classmethod
    def myself(cls) -> Holder:
        """The running process, with a token of its own."""
        pid = os.getpid()
        return cls(
            host=socket.gethostname(),
            pid=pid,
            started=_start_of(pid),
            token=uuid.uuid4().hex,
            machine=machine(),
        )


def _start_of(pid: int) -> float:
    try:
        return psutil.Process(pid).create_time()
    except psutil.Error:
        return 0.0


@cache
def machine() -> str:
    """What tells where a process number has a meaning: the boot, and the numbers' namespace."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def _claim(store_path: Location) -> Claim:
    return claim(store_path / JOURNAL / LOCK)


def holder(store_path: Location) -> Holder | None:
    """Who holds the lock of a store, living or dead; None where nobody does."""
    text = _claim(store_path).read()
    if text is None:
        return None
    try:
        return Holder(**json.loads(text))
    except (ValueError, TypeError):
        return Holder(host="unknown", pid=0, started=0.0, token="")


def is_live(store_path: Location, who: Holder) -> bool:
    """Whether the holder of a lock still runs.

    On this host the process itself is asked for. Elsewhere the heartbeat decides, its age taken by
    the clock of the file system, or object store, that both write to.
    """
    if who.host == socket.gethostname() and who.machine in ("", machine()):
        return abs(_start_of(who.pid) - who.started) < 1.0
    return heartbeat_age(store_path) < EXPIRY


def heartbeat_age(store_path: Location) -> float:
    """Age of a lock's last heartbeat [s]; infinite where there is no lock."""
    return _claim(store_path).age()


class Lock:
    """A store's lock, held and kept alive until released.

    Raises
    ------
    BusyError, StoreError
        Where a living driver holds it; where the store can't be written.
    """

    def __init__(self, store_path: Location) -> None:
        self._store, self._claim = store_path, _claim(store_path)
        self._me = Holder.myself()
        self._released = threading.Event()
        try:
            self._claim.take(json.dumps(asdict(self._me)), self._refuse_a_living_one)
        except OSError as error:
            raise StoreError(f"{store_path} can't be locked: {error.strerror or error}") from error
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
        """Whether the lock is still this driver's."""
        who = holder(self._store)
        return who is not None and who.token == self._me.token

    def release(self) -> None:
        """Give the lock up, if it is still ours."""
        self._released.set()
        self._beating.join()
        _left.add(self._me.token)
        with suppress(OSError):
            if self.is_mine():
                self._claim.leave()
