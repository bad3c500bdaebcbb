"""Opening of regular files in untrusted directories, without blocking and within a size limit.

A path in a spec or store may be a named pipe, which blocks until a writer opens it, an endless
device, or a link out of the store. The functions of this module open files without blocking, and
refuse everything that is not a regular file.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

_FILE_TYPE_NAMES = {
    stat.S_IFIFO: "a named pipe", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket", stat.S_IFLNK: "a symbolic link", stat.S_IFDIR: "a directory",
}  # fmt: skip
"""Name of a type of irregular file, such as "a device", by the type bits of its `st_mode`."""

READ_BUFFER_BYTES = 1 << 20
"""Number of bytes per read of a file whose content is not kept in memory."""


class RefusedFileError(OSError):
    """Error for a path that is no regular file, is too large, or leads out of its directory."""

    def __str__(self) -> str:
        return f"{self.filename} {self.strerror}"


def file_type(mode: int) -> str:
    """Return the name of a file's type, given the `st_mode` of its stat result.

    Examples
    --------
    >>> file_type(stat.S_IFIFO)
    'a named pipe'
    """
    return _FILE_TYPE_NAMES.get(stat.S_IFMT(mode), "a plain file")


def open_regular_file(path: str | Path, *, follow_links: bool = True) -> int:
    """Open a regular file for reading without blocking, and return its descriptor.

    Parameters
    ----------
    path : str or Path
        Path of the file.
    follow_links : bool
        False refuses a symbolic link.

    Raises
    ------
    RefusedFileError
        If the path is a pipe, a device, a socket, or a symbolic link that is not followed.
    OSError
        If the file can't be opened, as from `os.open`.
    """
    return _open_refusing_irregular(
        str(path), str(path), 0 if follow_links else os.O_NOFOLLOW, None
    )


def open_file_below_root(root: str | Path, name: str) -> int:
    """Open the regular file ``name`` below the directory ``root``, and return its descriptor.

    Parameters
    ----------
    root : str or Path
        Directory that the user has named; may be reached through symbolic links.
    name : str
        Path below ``root`` with components separated by '/'. No component may be a symbolic link,
        '.' or '..'.

    Raises
    ------
    RefusedFileError
        If the path is no regular file or leaves ``root``.
    OSError
        If the file can't be opened, as from `os.open`.
    """
    *parent_names, base_name = name.split("/")
    path_in_messages = f"{root}/{name}"
    if not {"", ".", ".."}.isdisjoint((*parent_names, base_name)):
        raise RefusedFileError(errno.EINVAL, "leads out of its folder", path_in_messages)
    folder_descriptor = os.open(root, os.O_RDONLY | os.O_DIRECTORY)
    try:
        for depth, folder_name in enumerate(parent_names, start=1):
            try:
                inner_descriptor = _open_refusing_irregular(
                    folder_name, path_in_messages, os.O_NOFOLLOW | os.O_DIRECTORY, folder_descriptor
                )
            except RefusedFileError as error:
                problem = f"lies behind {'/'.join(parent_names[:depth])}, which is a symbolic link"
                raise RefusedFileError(error.errno, problem, path_in_messages) from None
            os.close(folder_descriptor)
            folder_descriptor = inner_descriptor
        return _open_refusing_irregular(
            base_name, path_in_messages, os.O_NOFOLLOW, folder_descriptor
        )
    finally:
        os.close(folder_descriptor)


def _open_refusing_irregular(
    name: str, path_in_messages: str, flags: int, folder_descriptor: int | None
) -> int:
    """Open a regular file and return its descriptor; refuse any other type of file.

    `flags` are those of `os.open`; with O_DIRECTORY a directory is opened instead. `name` is
    relative to the directory `folder_descriptor`, if one is passed. Errors name the file as
    `path_in_messages`.
    """
    descriptor = -1
    try:
        descriptor = os.open(
            name, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | flags, dir_fd=folder_descriptor
        )
        mode = os.fstat(descriptor).st_mode
    except OSError as error:
        mode = 0
        with suppress(OSError):
            mode = os.stat(
                name, dir_fd=folder_descriptor, follow_symlinks=not flags & os.O_NOFOLLOW
            ).st_mode
        if stat.S_ISLNK(mode) and flags & os.O_NOFOLLOW:
            problem = "is a symbolic link, no plain file"
            raise RefusedFileError(errno.ELOOP, problem, path_in_messages) from None
        if not stat.S_ISSOCK(mode):
            raise OSError(error.errno, error.strerror, path_in_messages) from None
    if flags & os.O_DIRECTORY:
        return descriptor
    if not stat.S_ISREG(mode):
        if descriptor >= 0:
            os.close(descriptor)
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), path_in_messages)
        raise RefusedFileError(
            errno.EINVAL, f"is {file_type(mode)}, no plain file", path_in_messages
        )
    return descriptor


def read_regular_file(path: str | Path, bytes_max: int) -> bytes:
    """Return the content of a regular file of at most ``bytes_max`` bytes.

    Symbolic links are followed.
    """
    return _read_slice_and_close(open_regular_file(path), bytes_max, str(path))


def read_file_below_root(
    root: str | Path, name: str, bytes_max: int, byte_slice: slice = slice(None)
) -> bytes:
    """Return the bytes ``byte_slice`` of a regular file below the directory ``root``.

    The file is opened by :func:`open_file_below_root`.

    Raises
    ------
    RefusedFileError
        If the file has more than ``bytes_max`` bytes, or :func:`open_file_below_root` refuses it.
    """
    return _read_slice_and_close(
        open_file_below_root(root, name), bytes_max, f"{root}/{name}", byte_slice
    )


def _read_slice_and_close(
    descriptor: int, bytes_max: int, path_in_messages: str, byte_slice: slice = slice(None)
) -> bytes:
    """Return the bytes `byte_slice` of an open file, and close its descriptor.

    Raise `RefusedFileError`, naming `path_in_messages`, if the file exceeds `bytes_max`.
    """
    with open(descriptor, "rb", buffering=0) as file:
        start, stop, _ = byte_slice.indices(
            checked_file_size(descriptor, bytes_max, path_in_messages)
        )
        file.seek(start)
        pieces: list[bytes] = []
        remaining = stop - start
        while remaining > 0 and (piece := file.read(remaining)):
            pieces.append(piece)
            remaining -= len(piece)
    return pieces[0] if len(pieces) == 1 else b"".join(pieces)


class FileStream(NamedTuple):
    """Open file that is read piece by piece."""

    size_bytes: int
    """Size of the file [bytes]."""
    content_pieces: Iterator[bytes]
    """Iterator over the file's content in pieces; a piece is read when the iterator reaches it."""


@contextmanager
def stream_file_below_root(root: str | Path, name: str, bytes_max: int) -> Iterator[FileStream]:
    """Context manager that opens a file below the directory ``root``; yields a :class:`FileStream`.

    The file is opened by :func:`open_file_below_root`. `RefusedFileError` is raised if it has more
    than ``bytes_max`` bytes.
    """
    descriptor = open_file_below_root(root, name)
    with open(descriptor, "rb", buffering=0) as file:
        size = checked_file_size(descriptor, bytes_max, f"{root}/{name}")
        yield FileStream(size, iter(lambda: file.read(READ_BUFFER_BYTES), b""))


def checked_file_size(descriptor: int, bytes_max: int, path_in_messages: str) -> int:
    """Return the size of an open file [bytes].

    `RefusedFileError`, naming ``path_in_messages``, is raised if the size exceeds ``bytes_max``.
    """
    size = os.fstat(descriptor).st_size
    check_file_size(size, bytes_max, path_in_messages)
    return size


def check_file_size(size: int, bytes_max: int, path_in_messages: str) -> None:
    """Raise `RefusedFileError` if ``size`` [bytes], of a file or object, exceeds ``bytes_max``.

    The error names the file or object as ``path_in_messages``.
    """
    if size > bytes_max:
        problem = f"has {size:,} bytes, and can have no more than {bytes_max:,}"
        raise RefusedFileError(errno.EFBIG, problem, path_in_messages)
