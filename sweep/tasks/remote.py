"""Stores in an object store made and removed: many objects, and no renaming of them all at once."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sweep.storage.locations import JOURNAL, each, files_below
from sweep.storage.objects import ObjectPath
from sweep.tasks.errors import StoreError
from sweep.tasks.lock import LOCK, Lock

#: Object that says that what lies at a place is a store half made or half removed.
PARTIAL = "partial"

ROOT = "zarr.json"


def send(built: Path, path: ObjectPath) -> ObjectPath:
    """Copy a store that was built on disk to its place, its root last.

    Raises
    ------
    StoreError
        Where something is in its place, or it can't be written.
    """
    names = files_below(built).keys() - {ROOT}
    try:
        with making(path):
            each(path, lambda name: (path / name).write_bytes((built / name).read_bytes()), names)
            (path / ROOT).write_bytes((built / ROOT).read_bytes())
    except OSError as error:
        raise StoreError(f"{path} can't be made: {error.strerror or error}") from error
    return path


@contextmanager
def making(path: ObjectPath) -> Iterator[None]:
    """A place while a store is made there: nobody else's, and marked as half made till the end.

    Raises
    ------
    StoreError
        Where something is there, or somebody makes a store there.
    """
    lock = Lock(path)
    try:
        _clear(path)
        mark = path / JOURNAL / PARTIAL
        mark.write_bytes(b"")
        yield
        mark.unlink()
    finally:
        lock.release()


def _clear(path: ObjectPath) -> None:
    """Take away what a creation or removal cut short has left; refuse what is somebody's."""
    if not (path / JOURNAL / PARTIAL).exists():
        found = [name for name, _ in path.below() if not name.startswith(f"{JOURNAL}/")]
        if found:
            raise StoreError(f"something else is at {path} ({found[0]}): name another --store")
        return
    remove(path)


def remove(path: ObjectPath) -> None:
    """Take a store away: its root first, so that what is left looks like none; not its lock."""
    mark, lock = path / JOURNAL / PARTIAL, f"{JOURNAL}/{LOCK}"
    mark.write_bytes(b"")
    (path / ROOT).unlink()
    names = [name for name, _ in path.below() if name not in (lock, f"{JOURNAL}/{PARTIAL}")]
    each(path, lambda name: (path / name).unlink(), names)
    mark.unlink()
