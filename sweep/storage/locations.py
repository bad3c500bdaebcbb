"""Where a store is: a folder on disk, or a key in an object store."""

from __future__ import annotations

import os
import re
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from sweep.storage.objects import SCHEMES, ObjectPath, ObjectStoreError

Location = Path | ObjectPath
"""What stands for a place; both know `/`, `name`, `parent`, `exists()` and `read_bytes()`."""

#: Directory of the journal inside a store.
JOURNAL = ".sweep"

#: What the name of a file ends in that is still being written.
PARTIAL = ".partial"

#: Attribute of a copy of a store with many chunks to a file.
PACKED = "packed"

#: Requests to an object store at once: each takes some ms, nearly all of it waiting.
REQUESTS = 16

Item = TypeVar("Item")
Found = TypeVar("Found")


def is_url(text: str) -> bool:
    """Whether a text names a place in an object store."""
    return re.match(rf"({'|'.join(SCHEMES)}):/", text) is not None


def located(where: str | Location) -> Location:
    """A place from how it is written: a path, ``s3://bucket/key``, ``gs://...``, ``az://...``.

    Raises
    ------
    ObjectStoreError
        For an address of another kind, or one without a bucket or a key.
    """
    if isinstance(where, ObjectPath):
        return where
    text = str(where)
    if not is_url(text):
        if re.match(r"(?!file:)[A-Za-z][A-Za-z0-9+.-]+:/", text):
            kinds = ", ".join(f"{scheme}://" for scheme in SCHEMES if scheme != "memory")
            raise ObjectStoreError(22, f"is no place for a store: write a path, or {kinds}", text)
        return Path(os.path.expanduser(text.removeprefix("file://")))
    scheme, _, rest = text.partition(":")
    bucket, _, key = rest.strip("/").partition("/")
    if not bucket or not key.strip("/"):
        raise ObjectStoreError(
            22, f"is no place for a store: write {scheme}://BUCKET/NAME.zarr", text
        )
    return ObjectPath(f"{scheme}://{bucket}", key.strip("/"))


def zarr_store(location: Location) -> Any:
    """What Zarr and xarray open."""
    if isinstance(location, Path):
        return location
    from zarr.storage import ObjectStore, StorePath

    return StorePath(ObjectStore(location.client), location.key)


def each(
    location: Location, function: Callable[[Item], Found], items: Iterable[Item]
) -> list[Found]:
    """A function's results, in order; side by side where each is a request over the network."""
    if isinstance(location, Path):
        return [function(item) for item in items]
    return list(_requests().map(function, items))


@cache
def _requests() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(REQUESTS, thread_name_prefix="object-store")


def names_below(location: Location) -> Iterator[str]:
    """Names of all files below a place, relative to it, however many."""
    if isinstance(location, ObjectPath):
        yield from (name for name, _ in location.below())
        return
    for folder, _, names in os.walk(location):
        inside = os.path.relpath(folder, location)
        yield from (os.path.normpath(f"{inside}/{name}") for name in names)


def files_below(location: Location) -> dict[str, int]:
    """Sizes of all files below a place by their names, relative to it."""
    if isinstance(location, ObjectPath):
        return dict(location.below())
    files = (file for file in location.rglob("*") if file.is_file())
    return {str(file.relative_to(location)): file.stat().st_size for file in files}


def beside(location: Location) -> Path:
    """Folder for what is made of a store: where it is, or here where it is in an object store."""
    return location.parent if isinstance(location, Path) else Path()


def put_whole(location: Location, content: bytes) -> None:
    """Write a small file in one step: readers, and power cuts, find the old one or the new one."""
    if isinstance(location, ObjectPath):
        location.write_bytes(content)
    else:
        put(str(location), content, durable=True)


def put(file: str, content: bytes, *, durable: bool = False) -> None:
    """Write a file on disk in one step, also where a directory has got into its place.

    Parameters
    ----------
    file, content
        Its path, and what it is to hold. Folders above it are made.
    durable
        Write the content to the disk before the file gets its name: else a power cut may leave
        the name with nothing behind it.
    """
    draft = f"{file}.{uuid.uuid4().hex}{PARTIAL}"
    try:
        try:
            _write(draft, content, durable)
        except FileNotFoundError:
            os.makedirs(os.path.dirname(file), exist_ok=True)
            _write(draft, content, durable)
        try:
            os.replace(draft, file)
        except IsADirectoryError:
            shutil.rmtree(file)
            os.replace(draft, file)
    except BaseException:
        with suppress(FileNotFoundError):
            os.unlink(draft)
        raise


def _write(file: str, content: bytes, durable: bool) -> None:
    opened = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        left = memoryview(content)
        while left:
            left = left[os.write(opened, left) :]
        if durable:
            os.fsync(opened)
    finally:
        os.close(opened)
