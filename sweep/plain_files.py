"""Open regular files of untrusted directories without blocking, and within a size limit.

A path that a study or a store names may be a named pipe, whose opening waits for a writer, a device
that never ends, or a link out of the store. These functions open without waiting, and refuse
anything that is not a regular file.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_KINDS = {
    stat.S_IFIFO: "a named pipe", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket", stat.S_IFLNK: "a symbolic link", stat.S_IFDIR: "a directory",
}  # fmt: skip

#: Bytes that are read at a time where content is not kept in memory.
PIECE_BYTES = 1 << 20


class UnfitFileError(OSError):
    """A path is not a regular file of a permitted size, or leads out of its directory."""

    def __str__(self) -> str:
        return f"{self.filename} {self.strerror}"


def kind_of(mode: int) -> str:
    """Return the name of a file type, from the mode of its stat result.

    >>> kind_of(stat.S_IFIFO)
    'a named pipe'
    """
    return _KINDS.get(stat.S_IFMT(mode), "a plain file")


def open_plain(path: str | Path, *, follow: bool = True) -> int:
    """Open a regular file for reading without blocking, and return its descriptor.

    Raises
    ------
    UnfitFileError
        The path is a pipe, a device, a socket, or (unless ``follow``) a symbolic link.
    OSError
        As of `os.open`.
    """
    return _open(str(path), str(path), 0 if follow else os.O_NOFOLLOW, None)


def open_below(root: str | Path, name: str) -> int:
    """Open the regular file ``name`` below the directory ``root``; return its descriptor.

    ``name`` has components separated by '/'. No component below ``root`` may be a symbolic link,
    '.' or '..'. ``root`` itself may be reached through links, because the user has named it.
    """
    *folders, last = name.split("/")
    whole = f"{root}/{name}"
    if not {"", ".", ".."}.isdisjoint((*folders, last)):
        raise UnfitFileError(errno.EINVAL, "leads out of its folder", whole)
    folder = os.open(root, os.O_RDONLY | os.O_DIRECTORY)
    try:
        for number, part in enumerate(folders, start=1):
            try:
                inner = _open(part, whole, os.O_NOFOLLOW | os.O_DIRECTORY, folder)
            except UnfitFileError as error:
                what = f"lies behind {'/'.join(folders[:number])}, which is a symbolic link"
                raise UnfitFileError(error.errno, what, whole) from None
            os.close(folder)
            folder = inner
        return _open(last, whole, os.O_NOFOLLOW, folder)
    finally:
        os.close(folder)


def _open(name: str, whole: str, flags: int, folder: int | None) -> int:
    """Open a regular file, or a directory for O_DIRECTORY; errors name it ``whole``."""
    opened = -1
    try:
        opened = os.open(name, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | flags, dir_fd=folder)
        mode = os.fstat(opened).st_mode
    except OSError as error:
        mode = 0
        with suppress(OSError):
            mode = os.stat(name, dir_fd=folder, follow_symlinks=not flags & os.O_NOFOLLOW).st_mode
        if stat.S_ISLNK(mode) and flags & os.O_NOFOLLOW:
            what = "is a symbolic link, no plain file"
            raise UnfitFileError(errno.ELOOP, what, whole) from None
        if not stat.S_ISSOCK(mode):
            raise OSError(error.errno, error.strerror, whole) from None
    if flags & os.O_DIRECTORY:
        return opened
    if not stat.S_ISREG(mode):
        if opened >= 0:
            os.close(opened)
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), whole)
        raise UnfitFileError(errno.EINVAL, f"is {kind_of(mode)}, no plain file", whole)
    return opened


def read_plain(path: str | Path, bytes_max: int) -> bytes:
    """Read a regular file of at most ``bytes_max`` bytes; symbolic links are followed."""
    return _read(open_plain(path), bytes_max, str(path))


def read_below(root: str | Path, name: str, bytes_max: int, part: slice = slice(None)) -> bytes:
    """Read a regular file, or the bytes ``part`` of it, as :func:`open_below` opens it."""
    return _read(open_below(root, name), bytes_max, f"{root}/{name}", part)


def _read(opened: int, bytes_max: int, whole: str, part: slice = slice(None)) -> bytes:
    with open(opened, "rb", buffering=0) as file:
        start, stop, _ = part.indices(size_within(opened, bytes_max, whole))
        file.seek(start)
        pieces: list[bytes] = []
        left = stop - start
        while left > 0 and (piece := file.read(left)):
            pieces.append(piece)
            left -= len(piece)
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


@contextmanager
def pieces_below(
    root: str | Path, name: str, bytes_max: int
) -> Iterator[tuple[int, Iterator[bytes]]]:
    """Context manager: size of a regular file below a directory, and an iterator over its bytes."""
    opened = open_below(root, name)
    with open(opened, "rb", buffering=0) as file:
        size = size_within(opened, bytes_max, f"{root}/{name}")
        yield size, iter(lambda: file.read(PIECE_BYTES), b"")


def size_within(opened: int, bytes_max: int, whole: str) -> int:
    """Return the size of an open file; raise UnfitFileError if it exceeds ``bytes_max``."""
    size = os.fstat(opened).st_size
    refuse_larger(size, bytes_max, whole)
    return size


def refuse_larger(size: int, bytes_max: int, whole: str) -> None:
    """Raise UnfitFileError if the size of a file or object exceeds ``bytes_max``."""
    if size > bytes_max:
        what = f"has {size:,} bytes, and can have no more than {bytes_max:,}"
        raise UnfitFileError(errno.EFBIG, what, whole)
