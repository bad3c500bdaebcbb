"""Locations of stores, on disk or in an object store, and atomic writes to them.

The environment supplies credentials and endpoint of an object store. None of them is written into a
store.

A file or folder that replaces another is written next to it under a hidden name, and then renamed.
The old one is first renamed to a hidden name, and deleted last. The hidden names in the folder of
``NAME`` are

    .NAME.next                                 unfinished store that will replace NAME
    .NAME.creating-HOST-PID.START-ab12cd34     draft that a process is writing
    .NAME.replaced-HOST-PID.START-ab12cd34     former content of NAME, until it is deleted
    .NAME.removing-HOST-PID.START-ab12cd34     content that is being deleted

:func:`recover_interrupted_replace` handles the last three after a process has died. An object store
can't rename, so nothing in it is ever replaced.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import socket
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from sweep.messages import escape_unprintable
from sweep.regular_files import check_file_size, open_file_below_root, read_file_below_root

#: URL schemes of object stores; `memory` is for tests, and exists only within its process.
OBJECT_STORE_URL_SCHEMES = ("s3", "gs", "az", "memory")

#: Directory of the journal inside a store.
JOURNAL_DIR = ".sweep"

#: Suffix of a file that is still being written.
DRAFT_SUFFIX = ".partial"

#: Attribute that marks a packed copy of a store: its files are shards of many chunks.
PACKED_ATTRIBUTE = "packed"

#: Largest number of simultaneous requests to an object store. A request is mostly waiting.
CONCURRENT_REQUESTS_MAX = 16

#: Settings for repeating a request after HTTP status 500 and above, timeouts and lost connections.
RETRY_CONFIG = {
    "max_retries": 8,
    "retry_timeout": timedelta(seconds=90),
    "backoff": {
        "init_backoff": timedelta(milliseconds=100),
        "max_backoff": timedelta(seconds=10),
        "base": 2,
    },
}

#: Settings for repeating the first request to a bucket. It is repeated less often, as a wrong
#: address is likelier than a transient fault.
FIRST_CONTACT_RETRY_CONFIG = {
    **RETRY_CONFIG,
    "max_retries": 3,
    "retry_timeout": timedelta(seconds=10),
}

#: Timeouts of requests to an object store, and of connecting to it.
OBJECT_STORE_TIMEOUTS = {"timeout": "30s", "connect_timeout": "5s"}

ObjectVersion = Any
"""Tag (ETag or version) by which an object store distinguishes the versions of an object."""


class VersionedContent(NamedTuple):
    """Content of an object in an object store, and the version that has this content."""

    content: bytes
    """Content of the object."""
    version: ObjectVersion
    """Version of the object, by which a later write detects changes by other processes."""


ItemT = TypeVar("ItemT")
"""Type of the items to which `map_concurrently` applies a function."""
ResultT = TypeVar("ResultT")
"""Type of the results of a function that is passed to a function of this module."""

#: Error texts of obstore for a truncated response body and a truncated listing.
_TRUNCATED_RESPONSE_TEXTS = ("body error", "invalid list response")

_client_by_bucket_url: dict[str, Any] = {}
"""Clients of the buckets that this process has connected to, by URL of the bucket."""

_clients_lock = threading.RLock()


class ObjectStoreError(OSError):
    """Error of an object store; its text states the cause and the remedy."""

    def __str__(self) -> str:
        return escape_unprintable(f"{self.filename}: {self.strerror}")


@dataclass(frozen=True, order=True)
class ObjectPath:
    """Key in an object store, with those methods of `pathlib.Path` that sweep needs."""

    bucket_url: str  # scheme and bucket, such as s3://bucket
    key: str  # without a slash at either end

    def __str__(self) -> str:
        return f"{self.bucket_url}/{self.key}"

    def __truediv__(self, other: str) -> ObjectPath:
        return ObjectPath(
            self.bucket_url, "/".join(filter(None, [self.key, str(other).strip("/")]))
        )

    def joinpath(self, *others: str) -> ObjectPath:
        """Return a path below this one. `others` are appended to its key, with slashes between."""
        return self / "/".join(others)

    @property
    def name(self) -> str:
        """Last part of the key, after the last slash."""
        return self.key.rpartition("/")[2]

    @property
    def parent(self) -> ObjectPath:
        """Path of the key without its last part."""
        return ObjectPath(self.bucket_url, self.key.rpartition("/")[0])

    def with_name(self, name: str) -> ObjectPath:
        """Return the path with the last part of its key replaced."""
        return self.parent / name

    def absolute(self) -> ObjectPath:
        """Return the path unchanged, as every key is absolute."""
        return self

    @property
    def client(self) -> Any:
        """Client of the bucket, connected once per process.

        The first access lists the bucket, which checks that it exists and can be read.
        """
        with _clients_lock:
            if self.bucket_url not in _client_by_bucket_url:
                with translate_object_store_errors(self):
                    if not self.bucket_url.startswith("memory:"):
                        first_client = _connect_to_bucket(
                            self.bucket_url, FIRST_CONTACT_RETRY_CONFIG
                        )
                        _retry_if_truncated(
                            lambda: first_client.list_with_delimiter(self.key or None)
                        )
                    _client_by_bucket_url[self.bucket_url] = _connect_to_bucket(
                        self.bucket_url, RETRY_CONFIG
                    )
            return _client_by_bucket_url[self.bucket_url]

    def _read_object_metadata(self) -> Any:
        """Return the metadata of the object, or None if it does not exist."""
        with translate_object_store_errors(self), suppress(FileNotFoundError):
            return self.client.head(self.key)

    def exists(self) -> bool:
        """Return True if the path is that of an object, or of a Zarr group or array."""
        return self.size() >= 0 or (self / "zarr.json").size() >= 0

    def size(self) -> int:
        """Return the size of the object [bytes], or -1 if it does not exist."""
        metadata = self._read_object_metadata()
        return -1 if metadata is None else int(metadata["size"])

    def last_modified(self) -> float | None:
        """Return the time of the last write [s since the epoch], or None if no object exists."""
        metadata = self._read_object_metadata()
        return None if metadata is None else float(metadata["last_modified"].timestamp())

    def read_bytes(self, bytes_max: int | None = None) -> bytes:
        """Return the bytes of the object. Read it once more if the response is truncated.

        RefusedFileError is raised if the object is larger than ``bytes_max``.
        """
        from obstore.exceptions import BaseError

        with translate_object_store_errors(self):
            response = self.client.get(self.key)
            if bytes_max is not None:
                check_file_size(response.meta["size"], bytes_max, str(self))
            try:
                return bytes(response.bytes())
            except BaseError:
                return bytes(self.client.get(self.key).bytes())

    def write_bytes(self, content: bytes) -> None:
        """Write an object, and replace the present one, if any."""
        with translate_object_store_errors(self):
            self.client.put(self.key, content)

    def unlink(self, missing_ok: bool = False) -> None:
        """Delete the object, or do nothing if it does not exist.

        ``missing_ok`` has no effect. The argument exists because `pathlib.Path.unlink` has it.
        """
        with translate_object_store_errors(self), suppress(FileNotFoundError):
            self.client.delete(self.key)

    def iter_objects_below(self) -> Iterator[tuple[str, int]]:
        """Yield the relative key and size [bytes] of each object below this key, page by page."""
        from obstore.exceptions import BaseError

        last, is_repeated = None, False
        with translate_object_store_errors(self):
            while True:
                try:
                    for page in self.client.list(self.key or None, offset=last):
                        for entry in page:
                            yield entry["path"][len(self.key) :].lstrip("/"), entry["size"]
                            last, is_repeated = entry["path"], False
                    return
                except BaseError as error:
                    if is_repeated or not _is_truncation_error(error):
                        raise
                    is_repeated = True  # list again, from the last key that was received

    def _list_child_names(self) -> list[str]:
        with translate_object_store_errors(self):
            listing = _retry_if_truncated(lambda: self.client.list_with_delimiter(self.key or None))
        paths = [*listing["common_prefixes"], *(entry["path"] for entry in listing["objects"])]
        return sorted(path.rpartition("/")[2] for path in paths)

    def is_dir(self) -> bool:
        """Return True if any object lies below this key."""
        return bool(self._list_child_names())

    def glob(self, pattern: str) -> list[ObjectPath]:
        """Return the paths, directly below this one, whose name matches a shell pattern."""
        return [self / name for name in self._list_child_names() if fnmatch(name, pattern)]

    def read_with_version(self) -> VersionedContent | None:
        """Return the content of the object and its version tag, or None if it does not exist."""

        def ask() -> VersionedContent:
            response = self.client.get(self.key)
            return VersionedContent(bytes(response.bytes()), _object_version(response.meta))

        with translate_object_store_errors(self), suppress(FileNotFoundError):
            return _retry_if_truncated(ask)
        return None

    def refuse_truncated_content(self, content: bytes) -> None:
        """Raise ObjectStoreError if the content that was received is shorter than the object.

        The client can't notice this if a proxy sends a truncated body with a matching content
        length.
        """
        if len(content) < self.size():
            raise ObjectStoreError(errno.EIO, _truncation_message(self.bucket_url), str(self))

    def put_if_unchanged(
        self, content: bytes, expected_version: ObjectVersion | None
    ) -> ObjectVersion | None:
        """Write an object only if its version is ``expected_version``.

        Return the new version, or None if another process has written the object meanwhile. If
        ``expected_version`` is None, the object must not exist yet.
        """
        from obstore.exceptions import AlreadyExistsError, PreconditionError

        mode = "create" if expected_version is None else expected_version
        conflict_errors = (AlreadyExistsError, PreconditionError, FileNotFoundError)
        with translate_object_store_errors(self), suppress(*conflict_errors):
            return _object_version(self.client.put(self.key, content, mode=mode))
        return None


def _retry_if_truncated(ask: Callable[[], ResultT]) -> ResultT:
    """Call `ask`, which sends a request, and return the response.

    If the response is truncated, `ask` is called once more.
    """
    from obstore.exceptions import BaseError

    try:
        return ask()
    except BaseError as error:
        if not _is_truncation_error(error):
            raise
        return ask()


def _is_truncation_error(error: Exception) -> bool:
    """Return True if an error means that a response's body or listing was truncated."""
    return any(words in str(error) for words in _TRUNCATED_RESPONSE_TEXTS)


def _object_version(meta: Any) -> ObjectVersion:
    return {field: meta[field] for field in ("e_tag", "version") if meta[field] is not None}


def _connect_to_bucket(bucket_url: str, retry_config: Any) -> Any:
    """Return the client of a bucket, with credentials and endpoint from the environment."""
    from obstore.store import MemoryStore, from_url

    if bucket_url.startswith("memory:"):
        return MemoryStore()
    allow_http = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true", "yes")
    options: Any = {
        **OBJECT_STORE_TIMEOUTS,
        "allow_http": allow_http or _s3_endpoint_url().startswith("http:"),
    }
    return from_url(bucket_url, client_options=options, retry_config=retry_config)


def _truncation_message(bucket_url: str) -> str:
    return f"{_service_name(bucket_url)} cuts its answers short: try again, or look at the network"


def _service_name(bucket_url: str) -> str:
    return _s3_endpoint_url() or f"the service of {bucket_url.split(':')[0]}://"


def _s3_endpoint_url() -> str:
    return os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL", "")


@contextmanager
def translate_object_store_errors(location: object) -> Iterator[None]:
    """Context manager that translates errors of an object store to ObjectStoreError.

    The message states the remedy. If ``location`` is a path on disk, no error is translated.
    """
    if not isinstance(location, ObjectPath):
        yield
        return
    from obstore.exceptions import BaseError

    try:
        yield
    except BaseError as error:
        error_number, explanation = object_store_errno_and_message(str(error), location.bucket_url)
        raise ObjectStoreError(error_number, explanation, str(location)) from error


def to_object_store_error(error: Exception) -> Exception:
    """Translate an error that the object-store library raised through Zarr or xarray.

    Return an ObjectStoreError. An error of any other library is returned unchanged.
    """
    if type(error).__module__.partition(".")[0] != "obstore":
        return error
    return ObjectStoreError(*object_store_errno_and_message(str(error), ""), "the store")


def object_store_errno_and_message(error_text: str, bucket_url: str) -> tuple[int, str]:
    """Return errno and a message that explain an error text of the object-store library.

    The message states the remedy, and names the service or the bucket of ``bucket_url``.
    """
    bucket, service = bucket_url.partition("://")[2], _service_name(bucket_url)
    error_summary = error_text.partition("\n\nDebug source")[0]
    status_match = re.search(
        r"status code: (\d+ [A-Za-z ]+)|\b([45]\d\d [A-Z][a-z ]+)", error_summary
    )
    http_status = (status_match[1] or status_match[2]).strip() if status_match else ""
    if "NoSuchBucket" in error_text or "ContainerNotFound" in error_text:
        return errno.ENXIO, f"{service} has no bucket {bucket!r}: make it, or mend its name"
    if (
        "169.254.169.254" in error_text
        or re.search(r"Missing \w*Key", error_summary)
        or "metadata.google.internal" in error_text
    ):
        return errno.EACCES, (
            "no credentials are set: give AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY (workers "
            "need them too); AWS_SKIP_SIGNATURE=true reads what is public"
        )
    if http_status[:3] in ("401", "403") or "PermissionDenied" in error_text:
        return errno.EACCES, (
            f"{service} refuses access{f' ({http_status})' if http_status else ''}: "
            "check the credentials, and that they may list, read and write there"
        )
    if "imed out" in error_text or "Timeout" in error_text:
        return (
            errno.ETIMEDOUT,
            f"{service} does not answer in time: try again, or look at the network",
        )
    if any(words in error_text for words in _TRUNCATED_RESPONSE_TEXTS):
        return errno.EIO, _truncation_message(bucket_url)
    if "error sending request" in error_text or "onnect" in error_summary:
        return errno.ECONNREFUSED, (
            f"{service} can't be reached: is it up, and are AWS_ENDPOINT_URL and the network right?"
        )
    if http_status:
        return errno.EIO, f"{service} keeps failing ({http_status}): try again"
    return errno.EIO, error_summary


Location = Path | ObjectPath
"""Type of paths of stores and files: on disk, or in an object store.

Both types have `/`, `name`, `parent`, `exists()` and `read_bytes()`.
"""


def parse_location(address: str | Location) -> Location:
    """Return the path that an address names: a path on disk, or one in an object store.

    Addresses in an object store are ``s3://bucket/key``, ``gs://...`` and ``az://...``.
    ObjectStoreError is raised for any other URL.
    """
    if isinstance(address, ObjectPath):
        return address
    if not isinstance(address, str | os.PathLike):
        type_name = type(address).__name__
        raise TypeError(
            f"a store is named by its path, such as 'study.zarr', and not by a {type_name}"
        )
    address_text = str(address)
    if not re.match(rf"({'|'.join(OBJECT_STORE_URL_SCHEMES)}):/", address_text):
        if re.match(r"(?!file:)[A-Za-z][A-Za-z0-9+.-]+:/", address_text):
            schemes_text = ", ".join(
                f"{scheme}://" for scheme in OBJECT_STORE_URL_SCHEMES if scheme != "memory"
            )
            raise ObjectStoreError(
                22, f"is no place for a store: write a path, or {schemes_text}", address_text
            )
        return Path(os.path.expanduser(address_text.removeprefix("file://")))
    scheme, _, bucket_and_key = address_text.partition(":")
    bucket, _, key = bucket_and_key.strip("/").partition("/")
    if not bucket or not key.strip("/"):
        raise ObjectStoreError(
            22, f"is no place for a store: write {scheme}://BUCKET/NAME.zarr", address_text
        )
    return ObjectPath(f"{scheme}://{bucket}", key.strip("/"))


def to_zarr_store(location: Location) -> Any:
    """Return a location as the path or Zarr store that Zarr and xarray can open."""
    if isinstance(location, Path):
        return location
    from zarr.storage import ObjectStore, StorePath

    return StorePath(ObjectStore(location.client), location.key)


def map_concurrently(
    location: Location, function: Callable[[ItemT], ResultT], items: Iterable[ItemT]
) -> list[ResultT]:
    """Return a function's results for all items, in order.

    If ``location`` is in an object store, several threads call the function.
    """
    if isinstance(location, Path):
        return [function(item) for item in items]
    return list(_request_pool().map(function, items))


@cache
def _request_pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(CONCURRENT_REQUESTS_MAX, thread_name_prefix="object-store")


def read_object(location: Location, object_name: str, bytes_max: int) -> bytes:
    """Return the bytes of a file below a location.

    RefusedFileError is raised if it is no regular file, or larger than ``bytes_max``.
    """
    if isinstance(location, ObjectPath):
        return (location / object_name).read_bytes(bytes_max)
    return read_file_below_root(location, object_name, bytes_max)


def iter_file_names_below(location: Location) -> Iterator[str]:
    """Yield the relative paths of all files and links below a location, but not of folders."""
    if isinstance(location, ObjectPath):
        yield from (name for name, _ in location.iter_objects_below())
        return
    prefix_length = len(str(location)) + 1
    yield from (entry.path[prefix_length:] for entry in iter_file_entries_below(str(location)))


def iter_file_entries_below(folder: str) -> Iterator[os.DirEntry[str]]:
    """Yield the directory entries of all files and links below a folder; no link is followed."""
    with os.scandir(folder) as entries:
        for entry in entries:  # no stat of a file: there may be millions
            if entry.is_dir(follow_symlinks=False):
                yield from iter_file_entries_below(entry.path)
            else:
                yield entry


def file_sizes_below(location: Location) -> dict[str, int]:
    """Return the sizes [bytes] of all files below a location, by relative path."""
    if isinstance(location, ObjectPath):
        return dict(location.iter_objects_below())
    return {name: (location / name).lstat().st_size for name in iter_file_names_below(location)}


def derived_files_dir(location: Location) -> Path:
    """Return the folder for files made from a store, such as figures.

    It is the folder that contains the store; for an object store it is the current folder.
    """
    return location.parent if isinstance(location, Path) else Path()


def atomic_write(location: Location, content: bytes) -> None:
    """Write a small file atomically: it has its old or its new content, even after a power cut."""
    if isinstance(location, ObjectPath):
        location.write_bytes(content)
    else:
        atomic_write_file(str(location), content, durable=True)


def atomic_write_file(file_path: str, content: bytes, *, durable: bool = False) -> None:
    """Write a file on disk atomically; a directory of the same name is deleted.

    With ``durable``, the content is flushed to the disk before the draft is renamed, so that a
    power cut can't leave an empty file.
    """
    draft_path = f"{file_path}.{uuid.uuid4().hex}{DRAFT_SUFFIX}"
    try:
        try:
            _write_new_file(draft_path, content, durable)
        except FileNotFoundError:
            os.makedirs(os.path.dirname(file_path), exist_ok=True)
            _write_new_file(draft_path, content, durable)
        try:
            os.replace(draft_path, file_path)
        except IsADirectoryError:
            shutil.rmtree(file_path)
            os.replace(draft_path, file_path)
    except BaseException:
        with suppress(FileNotFoundError):
            os.unlink(draft_path)
        raise


def _write_new_file(file_path: str, content: bytes, durable: bool) -> None:
    """Write a file that must not exist yet; with ``durable``, flush it to the disk."""
    descriptor = os.open(file_path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        remaining = memoryview(content)
        while remaining:
            remaining = remaining[os.write(descriptor, remaining) :]
        if durable:
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


#: Suffix of the hidden name of a store that will replace another once it is complete.
STAGING_SUFFIX = ".next"

#: Age above which a draft (unfinished file) of another host counts as abandoned [s].
ABANDONED_DRAFT_AGE_SECONDS = 86400.0

#: Largest time by which a file server's clock may be behind this machine's [s].
CLOCK_SKEW_SECONDS_MAX = 60.0

_LEFTOVER_NAME_PATTERN = re.compile(
    r"\.(?P<name>.+)\.(?P<state>creating|packing|replaced|removing)-"
    r"(?:(?P<host>.+)-)?(?P<pid>\d+)(?:\.(?P<start>\d+))?-[0-9a-f]{8}"
)
"""Pattern of the hidden names of files that interrupted processes leave.

Earlier versions of sweep wrote no host, or no start time of the process, into these names.
"""

#: Result of `process_start_id` for a process that exists, but is hidden from this user.
HIDDEN_PROCESS_START_ID = -1


PID_MAX = 2**31 - 1
"""Largest process number that an operating system assigns."""


def process_start_id(pid: int) -> int:
    """Return a number that tells a process from earlier and later ones with the same pid.

    It is the start time of the process: in clock ticks since boot on Linux, and in 0.01 s since the
    epoch on other systems. Changes of the clock do not alter it. It is 0 if no such process runs,
    and `HIDDEN_PROCESS_START_ID` if the process is hidden from this user.
    """
    import psutil

    if not 0 < pid <= PID_MAX:  # a damaged lock may contain any number
        return 0
    if sys.platform == "linux":
        try:
            stat_line = Path(f"/proc/{pid}/stat").read_bytes()
        except OSError:
            return HIDDEN_PROCESS_START_ID if psutil.pid_exists(pid) else 0
        state, *fields = stat_line.rpartition(b")")[2].split()
        return 0 if state in (b"Z", b"X") else int(fields[18])
    try:
        return int(100 * psutil.Process(pid).create_time())
    except psutil.AccessDenied:
        return HIDDEN_PROCESS_START_ID
    except psutil.Error:
        return 0


def resolve_links(location: Location) -> Location:
    """Return a location with symbolic links resolved. Renaming it then renames no link.

    OSError is raised if the links form a loop. A location in an object store is returned unchanged.
    """
    if not isinstance(location, Path):
        return location
    if not location.is_symlink():
        return location.absolute()
    try:
        resolved = location.resolve()
    except RuntimeError:  # Python before 3.13 reports a loop of links so
        resolved = location
    if resolved.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(location))
    return resolved


def eyepoint_store_location(store: Location, geometry_id: str) -> Location:
    """Return the path of the store that holds a flight's shot geometry (eyepoints).

    ``store`` is the study's store. The result is in a folder next to it. ``geometry_id`` identifies
    the geometry.
    """
    return resolve_links(store).parent / "eyepoints" / f"{geometry_id}.zarr"


def staging_path_for(path: Path) -> Path:
    """Return the path at which a new store is built before it replaces the store at a path."""
    return path.with_name(f".{path.name}{STAGING_SUFFIX}")


def final_path_for(path: Path) -> Path:
    """Return the path that the store at ``path`` has once it is complete.

    For a staging path this is the path of the store to be replaced, otherwise ``path`` itself.
    """
    staging_match = re.fullmatch(rf"\.(.+){re.escape(STAGING_SUFFIX)}", path.name)
    return path.with_name(staging_match[1]) if staging_match else path


def can_create_store(location: Location) -> bool:
    """Return True if a store can be created at a location: it is free, or is an empty folder."""
    if isinstance(location, ObjectPath):
        return not location.exists()
    try:
        with os.scandir(location) as entries:
            return next(entries, None) is None
    except OSError as error:  # missing, a file, below a file, or in an unreadable folder
        return error.errno != errno.ELOOP and not location.exists()


@contextmanager
def write_path_atomically(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Context manager that yields a hidden path to write, and renames it to ``path`` at the end.

    With ``replace``, whatever is at ``path`` is replaced.
    """
    recover_interrupted_replace(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft_path = _hidden_path(path, "creating")
    try:
        yield draft_path
        if replace:
            replace_path(draft_path, path)
        else:
            os.rename(draft_path, path)
    finally:
        _remove_tree(draft_path)


def replace_path(new_path: Path, path: Path) -> None:
    """Move the file or folder at ``new_path`` to ``path``, and delete what was at ``path``."""
    if new_path.is_file():
        os.replace(new_path, path)
        return
    while True:
        retired_path = _hidden_path(path, "replaced")
        with suppress(FileNotFoundError):
            os.rename(path, retired_path)
        try:
            os.rename(new_path, path)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                continue  # another process recovered meanwhile, and has put the old one back
            if not path.exists():  # else the other process has put the new one there
                with suppress(OSError):
                    os.rename(retired_path, path)
                raise
        remove_replaced_store(retired_path, path)
        return


def remove_replaced_store(old_path: Path, new_path: Path) -> None:
    """Delete the replaced store at ``old_path``, after moving its foreign files to ``new_path``.

    Foreign files are those that sweep did not make. If they can't be moved, the old store stays
    where it is, under a hidden name.
    """
    from sweep.storage.foreign_files import move_foreign_files

    try:
        move_foreign_files(old_path, new_path)
    except OSError:
        return
    remove_atomically(old_path)


def remove_atomically(path: Path) -> None:
    """Delete a file or folder; a single rename hides it before its content is deleted."""
    removal_path = _hidden_path(path, "removing")
    with suppress(FileNotFoundError):
        os.rename(path, removal_path)
    _remove_tree(removal_path)


def recover_interrupted_replace(location: Location) -> None:
    """Complete or undo what dead processes have left unfinished in the folder of a store.

    If the replacement of a store was interrupted, a complete new store takes its path; otherwise
    the old store is restored. Drafts of dead processes are deleted. Nothing happens if the folder
    can't be written, or in an object store.
    """
    if not isinstance(location, Path):
        return
    with suppress(OSError):
        path = resolve_links(location)
        assert isinstance(path, Path)
        for name in os.listdir(path.parent):
            if leftover_match := _LEFTOVER_NAME_PATTERN.fullmatch(name):
                with suppress(OSError):
                    _recover_leftover(path.parent / name, leftover_match)


def store_stat_fingerprint(location: Location) -> tuple[int, ...] | None:
    """Return device, inode, size and times of the root document of a store on disk.

    They identify the store, as no other store ever has the same. The result is None for an object
    store, or if the document can't be opened.
    """
    if not isinstance(location, Path):
        return None
    try:
        descriptor = open_file_below_root(location, "zarr.json")  # opening asks a file server anew
    except OSError:
        return None
    try:
        status = os.fstat(descriptor)
    finally:
        os.close(descriptor)
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _recover_leftover(leftover: Path, leftover_match: re.Match[str]) -> None:
    """Move into place, or delete, a hidden file or folder that a dead process has left.

    ``leftover_match`` is the match of its name, with the state in which the process left it.
    """
    path = leftover.with_name(leftover_match["name"])
    if leftover_match["state"] == "replaced":
        if not path.exists():
            os.rename(staging_path_for(path) if staging_path_for(path).exists() else leftover, path)
        if leftover.exists():
            remove_replaced_store(leftover, path)
    elif leftover_match["state"] == "removing" or not _is_being_written(leftover, leftover_match):
        _remove_tree(leftover)


def _is_being_written(draft_path: Path, leftover_match: re.Match[str]) -> bool:
    """Return True if the process that writes a draft may still be running."""
    import psutil

    modified_time = draft_path.stat().st_mtime
    if leftover_match["host"] not in (None, socket.gethostname()):
        return time.time() - modified_time < ABANDONED_DRAFT_AGE_SECONDS
    if leftover_match["start"]:
        return process_start_id(int(leftover_match["pid"])) in (
            int(leftover_match["start"]),
            HIDDEN_PROCESS_START_ID,
        )
    try:  # a process that started after the draft was made has reused its writer's id
        return (
            psutil.Process(int(leftover_match["pid"])).create_time()
            < modified_time + CLOCK_SKEW_SECONDS_MAX
        )
    except psutil.Error:
        return False


def _hidden_path(path: Path, state: str) -> Path:
    """Return a unique hidden path next to ``path``. Its name states this process and ``state``."""
    process_tag = f"{os.getpid()}.{process_start_id(os.getpid())}"
    unique_tag = f"{socket.gethostname()}-{process_tag}-{uuid.uuid4().hex[:8]}"
    name = (
        leftover_match["name"]
        if (leftover_match := _LEFTOVER_NAME_PATTERN.fullmatch(path.name))
        else path.name
    )
    return path.with_name(f".{name}.{state}-{unique_tag}")


def _remove_tree(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


#: Message for a disk that has free space, but no free inode for another file.
NO_FREE_INODES_MESSAGE = "No inodes left on device"


#: Remedy for a store that can't be written, by errno.
WRITE_REMEDY_BY_ERRNO = {
    errno.ENOSPC: "make room on its disk",
    errno.EDQUOT: "make room in your quota",
    errno.EMFILE: "raise the limit of open files, `ulimit -n`",
    errno.ENFILE: "raise the machine's limit of open files",
    errno.EROFS: "have its disk mounted for writing",
    errno.EACCES: "have the permission to write there",
    errno.EPERM: "have the permission to write there",
}


def os_error_reason(error: OSError, path: object) -> str:
    """Return the reason, in words, why a path can't be read or written.

    If the disk has no inodes for new files, the reason says so. The system would report "no space".
    """
    reason_text = error.strerror or str(error)
    if error.errno == errno.ENOSPC and isinstance(path, Path) and _has_no_free_inodes(path):
        return NO_FREE_INODES_MESSAGE
    return reason_text


def remedy_for_write_error(error: OSError, place: object, otherwise: str) -> str:
    """Return the remedy for an error of writing, in words; ``otherwise`` if none is known."""
    if NO_FREE_INODES_MESSAGE in (error.strerror, os_error_reason(error, place)):
        return "remove files from its disk, or have one with more inodes"
    return WRITE_REMEDY_BY_ERRNO.get(error.errno or 0, otherwise)


def _has_no_free_inodes(path: Path) -> bool:
    """Return True if the disk of a path has no free inodes, so that no file can be created.

    The path need not exist.
    """
    while not path.exists() and path != path.parent:
        path = path.parent
    with suppress(OSError):
        disk = os.statvfs(path)
        return disk.f_files > 0 and disk.f_favail == 0 and disk.f_bavail > 0
    return False
