"""Where a store is: a folder on disk, or a key in an object store."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from sweep.storage.objects import SCHEMES, ObjectPath, ObjectStoreError

if TYPE_CHECKING:
    import zarr

Location = Path | ObjectPath
"""What stands for a place; both know `/`, `name`, `parent`, `exists()` and `read_bytes()`."""

#: Directory of the journal inside a store.
JOURNAL = ".sweep"

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
        For an address without a bucket or a key.
    """
    if isinstance(where, ObjectPath):
        return where
    text = str(where)
    if not is_url(text):
        return Path(text.removeprefix("file://"))
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


def read_array(location: Location) -> zarr.Array[Any]:
    """A Zarr array for reading."""
    import zarr

    return zarr.open_array(zarr_store(location), mode="r")


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
    """Write a small file in one step: what reads it finds the old one or the new one."""
    if isinstance(location, ObjectPath):
        location.write_bytes(content)
        return
    location.parent.mkdir(parents=True, exist_ok=True)
    draft = location.with_name(f"{location.name}.{os.getpid()}")
    draft.write_bytes(content)
    os.replace(draft, location)
