"""Files and folders put in the place of others, whole, by whoever may be killed meanwhile.

Everything is made in the same folder, under a hidden name, and renamed into its place. The old one
is renamed aside and removed last. The hidden names in the folder of ``NAME`` are

    .NAME.next                           a store that is to take the place of NAME, under way
    .NAME.creating-HOST-PID-ab12cd34     half made by a process
    .NAME.replaced-HOST-PID-ab12cd34     what stood at NAME until it was replaced
    .NAME.removing-HOST-PID-ab12cd34     half removed

and `settle` sees to the last three where a process has died. In an object store, which has no
renaming, nothing is ever replaced.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import socket
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sweep.storage.locations import Location

NEXT = ".next"

#: Seconds after which what another host has half made is taken for abandoned.
ABANDONED = 86400.0

#: Seconds that the clock of a file server may be behind.
SKEW = 60.0

_LEFT = re.compile(
    r"\.(?P<name>.+)\.(?P<state>creating|packing|replaced|removing)-"
    r"(?:(?P<host>.+)-)?(?P<pid>\d+)-[0-9a-f]{8}"
)
"""Names of what is left by processes; those of earlier versions name no host."""


def real(location: Location) -> Location:
    """Follow symbolic links: the folder is renamed, not the link."""
    if not isinstance(location, Path):
        return location
    return location.resolve() if location.is_symlink() else location.absolute()


def eyepoints_path(store: Location, geometry_id: str) -> Location:
    """Eyepoint store of a geometry, in a folder next to the stores of the studies that use it."""
    return real(store).parent / "eyepoints" / f"{geometry_id}.zarr"


def beside(path: Path) -> Path:
    """Place of a store that is to replace another once it is complete."""
    return path.with_name(f".{path.name}{NEXT}")


def replaced_by(path: Path) -> Path:
    """Return the place that a store is made for: its own, or that of the store it replaces."""
    made = re.fullmatch(rf"\.(.+){re.escape(NEXT)}", path.name)
    return path.with_name(made[1]) if made else path


@contextmanager
def draft(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Make a file or folder in a hidden place, and put it in its own at the end."""
    settle(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    made = _hidden(path, "creating")
    try:
        yield made
        if replace:
            put(made, path)
        else:
            os.rename(made, path)
    finally:
        _delete(made)


def put(new: Path, path: Path) -> None:
    """Put a file or folder in the place of another, which is removed then."""
    if new.is_file():
        os.replace(new, path)
        return
    while True:
        old = _hidden(path, "replaced")
        with suppress(FileNotFoundError):
            os.rename(path, old)
        try:
            os.rename(new, path)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                continue  # `settle` elsewhere saw the gap, and has put the old one back
            if not path.exists():  # else it has put the new one there
                with suppress(OSError):
                    os.rename(old, path)
                raise
        discard(old)
        return


def discard(path: Path) -> None:
    """Take a file or folder away, out of its place in one step."""
    removing = _hidden(path, "removing")
    with suppress(FileNotFoundError):
        os.rename(path, removing)
    _delete(removing)


def settle(location: Location) -> None:
    """Finish or undo what processes that died have left in the folder of a store.

    A store whose replacement was interrupted is replaced if its successor is whole, or is put
    back. Drafts of dead processes are removed. Everything is left alone where the folder can't
    be written.
    """
    path = real(location)
    if not isinstance(path, Path):
        return
    with suppress(OSError):
        for name in os.listdir(path.parent):
            if left := _LEFT.fullmatch(name):
                with suppress(OSError):
                    _settle(path.parent / name, left)


def stamp(location: Location) -> tuple[int, ...] | None:
    """Identity of the store at a place, unlike any other that was or will be there; or None."""
    if not isinstance(location, Path):
        return None
    try:
        with open(location / "zarr.json", "rb") as file:  # opened: a file server is asked anew
            found = os.fstat(file.fileno())
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


def _settle(left: Path, made: re.Match[str]) -> None:
    path = left.with_name(made["name"])
    if made["state"] == "replaced":
        if not path.exists():
            os.rename(beside(path) if beside(path).exists() else left, path)
        if left.exists():
            discard(left)
    elif made["state"] == "removing" or not _is_made(left, made):
        _delete(left)


def _is_made(draft: Path, made: re.Match[str]) -> bool:
    """Tell whether the process that makes a draft may still be at it."""
    import psutil

    begun = draft.stat().st_mtime
    if made["host"] not in (None, socket.gethostname()):
        return time.time() - begun < ABANDONED
    try:  # a process that is younger than the draft has got its maker's number
        return psutil.Process(int(made["pid"])).create_time() < begun + SKEW
    except psutil.Error:
        return False


def _hidden(path: Path, state: str) -> Path:
    maker = f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"
    name = made["name"] if (made := _LEFT.fullmatch(path.name)) else path.name
    return path.with_name(f".{name}.{state}-{maker}")


def _delete(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()
