"""A claim that only one can hold: a file that is linked into place, or an object put if absent."""

from __future__ import annotations

import fcntl
import os
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sweep.storage.locations import Location, put_whole
from sweep.storage.objects import ObjectPath, ObjectStoreError, Tag

#: Tries at a claim that others try for, too.
TRIES = 5


class FileClaim:
    """A claim as a file.

    Parameters
    ----------
    path
        The file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self) -> str | None:
        """What its holder wrote; None where nobody holds it."""
        try:
            return self._path.read_text()
        except FileNotFoundError:
            return None

    def age(self) -> float:
        """Seconds since it last beat, by the clock of the file system; inf where nobody holds it.

        That clock is read off a file made for it.
        """
        probe = self._path.with_name(f"clock-{os.getpid()}-{uuid.uuid4().hex[:8]}")
        try:
            probe.touch()
            return probe.stat().st_mtime - self._path.stat().st_mtime
        except FileNotFoundError:
            return float("inf")
        except OSError:  # a reader of a store that it can't write to
            return time.time() - self._path.stat().st_mtime
        finally:
            with suppress(OSError):
                probe.unlink()

    def take(self, text: str, judge: Callable[[], None]) -> None:
        """Take the claim, unless `judge`, asked while no other process judges, raises."""
        self._path.parent.mkdir(exist_ok=True)
        with _guard(self._path.with_name("lock.guard")):
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
        """Give the claim up."""
        self._path.unlink(missing_ok=True)


@contextmanager
def _guard(path: Path) -> Iterator[None]:
    """Only one process at a time judges whether a lock is dead and takes its place."""
    with open(path, "a") as guard:
        fcntl.flock(guard, fcntl.LOCK_EX)
        yield


class ObjectClaim:
    """A claim as an object: every change of it is a conditional put, of what was seen before.

    Its first line is the holder's; a second counts its heartbeats, so that no two states of it are
    alike. Nobody holds an empty one.

    Parameters
    ----------
    path
        Its key.
    """

    def __init__(self, path: ObjectPath) -> None:
        self._path = path
        self._text, self._beats = "", 0
        self._tag: Tag | None = None

    def read(self) -> str | None:
        """What its holder wrote; None where nobody holds it."""
        found = self._path.read_tagged()
        return _first_line(found[0]) if found and found[0] else None

    def age(self) -> float:
        """Seconds since it last beat, by the clock of the object store; inf where there is none.

        That clock is read off an object made for it.
        """
        probe = self._path.with_name(f"clock-{os.getpid()}-{uuid.uuid4().hex[:8]}")
        now: float | None = None
        try:
            probe.write_bytes(b"clock")
            now = probe.modified()
        except ObjectStoreError:
            pass  # a reader of a store that it can't write to
        finally:
            with suppress(OSError):
                probe.unlink()
        beaten = self._path.modified()
        return float("inf") if beaten is None else (now or time.time()) - beaten

    def take(self, text: str, judge: Callable[[], None]) -> None:
        """Take the claim, unless `judge` raises."""
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
        """Give the claim up."""
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


Claim = FileClaim | ObjectClaim


def claim(path: Location) -> Claim:
    """A claim at a place."""
    return ObjectClaim(path) if isinstance(path, ObjectPath) else FileClaim(path)
