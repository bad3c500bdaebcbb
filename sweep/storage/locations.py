"""Places of stores: a folder on disk, or a key in an object store, and what is put there whole.

The environment gives credentials and endpoint of an object store; nothing of it is kept in a store.

Files and folders are made in the folder of what they replace, under a hidden name, and renamed into
its place. The old one is renamed aside and removed last. The hidden names in the folder of
``NAME`` are

    .NAME.next                                 a store that is to take the place of NAME, under way
    .NAME.creating-HOST-PID.START-ab12cd34     half made by a process
    .NAME.replaced-HOST-PID.START-ab12cd34     what stood at NAME until it was replaced
    .NAME.removing-HOST-PID.START-ab12cd34     half removed

and `settle` sees to the last three where a process has died. In an object store, which has no
renaming, nothing is ever replaced.
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
from typing import Any, TypeVar

from sweep.messages import escape_unprintable
from sweep.regular_files import check_size, open_below, read_below

#: Kinds of addresses; `memory` is for tests, and lives as long as its process.
URL_SCHEMES = ("s3", "gs", "az", "memory")

#: Directory of the journal inside a store.
JOURNAL_DIR = ".sweep"

#: What the name of a file ends in that is still being written.
DRAFT_SUFFIX = ".partial"

#: Attribute of a copy of a store with many chunks to a file.
PACKED_ATTRIBUTE = "packed"

#: Requests to an object store at once: each takes some ms, nearly all of it waiting.
CONCURRENT_REQUESTS_MAX = 16

#: What is tried again, and for how long: replies of 500 and more, none in time, lost connections.
RETRY_CONFIG = {
    "max_retries": 8,
    "retry_timeout": timedelta(seconds=90),
    "backoff": {
        "init_backoff": timedelta(milliseconds=100),
        "max_backoff": timedelta(seconds=10),
        "base": 2,
    },
}

#: The same at first contact, where a wrong address is likelier than a passing fault.
FIRST_CONTACT_RETRY_CONFIG = {
    **RETRY_CONFIG,
    "max_retries": 3,
    "retry_timeout": timedelta(seconds=10),
}

CLIENT_OPTIONS = {"timeout": "30s", "connect_timeout": "5s"}

ObjectVersion = Any
"""Mark by which an object store knows a state of an object."""

Item = TypeVar("Item")
Result = TypeVar("Result")

#: Words of the library for a body that is cut, and for a list that is.
_CUT = ("body error", "invalid list response")

_clients: dict[str, Any] = {}
_clients_lock = threading.RLock()


class ObjectStoreError(OSError):
    """An object store that can't be used as asked: the text says why and what to do."""

    def __str__(self) -> str:
        return escape_unprintable(f"{self.filename}: {self.strerror}")


@dataclass(frozen=True, order=True)
class ObjectPath:
    """A key in an object store, spoken to as far as needed in the words of `pathlib`."""

    bucket_url: str  # kind and bucket: s3://bucket
    key: str  # without a slash at either end

    def __str__(self) -> str:
        return f"{self.bucket_url}/{self.key}"

    def __truediv__(self, other: str) -> ObjectPath:
        return ObjectPath(
            self.bucket_url, "/".join(filter(None, [self.key, str(other).strip("/")]))
        )

    def joinpath(self, *others: str) -> ObjectPath:
        """Return the key below this one."""
        return self / "/".join(others)

    @property
    def name(self) -> str:
        """Last part of the key."""
        return self.key.rpartition("/")[2]

    @property
    def parent(self) -> ObjectPath:
        """The key without its last part."""
        return ObjectPath(self.bucket_url, self.key.rpartition("/")[0])

    def with_name(self, name: str) -> ObjectPath:
        """Return a key in the same folder."""
        return self.parent / name

    def absolute(self) -> ObjectPath:
        """Itself."""
        return self

    @property
    def client(self) -> Any:
        """The object store, connected once a process; the first contact checks that it exists."""
        with _clients_lock:
            if self.bucket_url not in _clients:
                with translate_errors(self):
                    if not self.bucket_url.startswith("memory:"):
                        first_client = _connect(self.bucket_url, FIRST_CONTACT_RETRY_CONFIG)
                        _ask_twice(lambda: first_client.list_with_delimiter(self.key or None))
                    _clients[self.bucket_url] = _connect(self.bucket_url, RETRY_CONFIG)
            return _clients[self.bucket_url]

    def _head_object(self) -> Any:
        """Metadata of the object; None where there is none."""
        with translate_errors(self), suppress(FileNotFoundError):
            return self.client.head(self.key)

    def exists(self) -> bool:
        """Tell whether there is an object at the key, or a Zarr group or array under it."""
        return self.size() >= 0 or (self / "zarr.json").size() >= 0

    def size(self) -> int:
        """Bytes of the object; -1 where there is none."""
        head = self._head_object()
        return -1 if head is None else int(head["size"])

    def last_modified(self) -> float | None:
        """Time at which the object was last written [s since the epoch]; None without one."""
        head = self._head_object()
        return None if head is None else float(head["last_modified"].timestamp())

    def read_bytes(self, bytes_max: int | None = None) -> bytes:
        """Return the object whole; once more where the body of the answer is cut.

        RefusedFileError where it is larger than so many bytes.
        """
        from obstore.exceptions import BaseError

        with translate_errors(self):
            response = self.client.get(self.key)
            if bytes_max is not None:
                check_size(response.meta["size"], bytes_max, str(self))
            try:
                return bytes(response.bytes())
            except BaseError:
                return bytes(self.client.get(self.key).bytes())

    def write_bytes(self, content: bytes) -> None:
        """Put an object, whole, in the place of whatever is there."""
        with translate_errors(self):
            self.client.put(self.key, content)

    def unlink(self, missing_ok: bool = False) -> None:
        """Take the object away; that there is none is no error, whatever is asked for."""
        with translate_errors(self), suppress(FileNotFoundError):
            self.client.delete(self.key)

    def iter_objects_below(self) -> Iterator[tuple[str, int]]:
        """Keys under this one, relative to it, and their sizes, a page in memory at a time."""
        from obstore.exceptions import BaseError

        last, is_repeated = None, False
        with translate_errors(self):
            while True:
                try:
                    for page in self.client.list(self.key or None, offset=last):
                        for entry in page:
                            yield entry["path"][len(self.key) :].lstrip("/"), entry["size"]
                            last, is_repeated = entry["path"], False
                    return
                except BaseError as error:
                    if is_repeated or not _is_cut(error):
                        raise
                    is_repeated = True  # the list goes on after the last key that came

    def _child_names(self) -> list[str]:
        with translate_errors(self):
            listing = _ask_twice(lambda: self.client.list_with_delimiter(self.key or None))
        paths = [*listing["common_prefixes"], *(entry["path"] for entry in listing["objects"])]
        return sorted(path.rpartition("/")[2] for path in paths)

    def is_dir(self) -> bool:
        """Tell whether keys lie under this one."""
        return bool(self._child_names())

    def glob(self, pattern: str) -> list[ObjectPath]:
        """Keys right under this one whose name fits a pattern."""
        return [self / name for name in self._child_names() if fnmatch(name, pattern)]

    def read_with_version(self) -> tuple[bytes, ObjectVersion] | None:
        """Return the object and the tag of what it holds; None where there is none."""

        def ask() -> tuple[bytes, ObjectVersion]:
            response = self.client.get(self.key)
            return bytes(response.bytes()), _object_version(response.meta)

        with translate_errors(self), suppress(FileNotFoundError):
            return _ask_twice(ask)
        return None

    def refuse_cut(self, content: bytes) -> None:
        """Raise ObjectStoreError if an answer with this content lacks a part of the object.

        A proxy may announce the part of a body that it has as the whole of it.
        """
        if len(content) < self.size():
            raise ObjectStoreError(errno.EIO, _cut_in_words(self.bucket_url), str(self))

    def put_if_unchanged(
        self, content: bytes, expected_version: ObjectVersion | None
    ) -> ObjectVersion | None:
        """Put an object if none is there, or only what has a tag; None if somebody was quicker."""
        from obstore.exceptions import AlreadyExistsError, PreconditionError

        mode = "create" if expected_version is None else expected_version
        conflict_errors = (AlreadyExistsError, PreconditionError, FileNotFoundError)
        with translate_errors(self), suppress(*conflict_errors):
            return _object_version(self.client.put(self.key, content, mode=mode))
        return None


def _ask_twice(ask: Callable[[], Result]) -> Result:
    """Return what an object store answers, asked once more where the answer is cut."""
    from obstore.exceptions import BaseError

    try:
        return ask()
    except BaseError as error:
        if not _is_cut(error):
            raise
        return ask()


def _is_cut(error: Exception) -> bool:
    """Tell whether the body of an answer, or the document of a list in it, was cut short."""
    return any(words in str(error) for words in _CUT)


def _object_version(meta: Any) -> ObjectVersion:
    return {field: meta[field] for field in ("e_tag", "version") if meta[field] is not None}


def _connect(bucket_url: str, retry_config: Any) -> Any:
    from obstore.store import MemoryStore, from_url

    if bucket_url.startswith("memory:"):
        return MemoryStore()
    allow_http = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true", "yes")
    options: Any = {
        **CLIENT_OPTIONS,
        "allow_http": allow_http or _s3_endpoint().startswith("http:"),
    }
    return from_url(bucket_url, client_options=options, retry_config=retry_config)


def _cut_in_words(bucket_url: str) -> str:
    return f"{_service(bucket_url)} cuts its answers short: try again, or look at the network"


def _service(bucket_url: str) -> str:
    return _s3_endpoint() or f"the service of {bucket_url.split(':')[0]}://"


def _s3_endpoint() -> str:
    return os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL", "")


@contextmanager
def translate_errors(location: object) -> Iterator[None]:
    """Errors of an object store in words, with what to do; nothing where a path is a file's."""
    if not isinstance(location, ObjectPath):
        yield
        return
    from obstore.exceptions import BaseError

    try:
        yield
    except BaseError as error:
        error_number, explanation = classify_error_text(str(error), location.bucket_url)
        raise ObjectStoreError(error_number, explanation, str(location)) from error


def to_readable_error(error: Exception) -> Exception:
    """Put an error into words if an object store raised it through Zarr or xarray."""
    if type(error).__module__.partition(".")[0] != "obstore":
        return error
    return ObjectStoreError(*classify_error_text(str(error), ""), "the store")


def classify_error_text(error_text: str, bucket_url: str) -> tuple[int, str]:
    """Return the number and words of what an object store's library says, of a kind and bucket."""
    bucket, service = bucket_url.partition("://")[2], _service(bucket_url)
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
    if any(words in error_text for words in _CUT):
        return errno.EIO, _cut_in_words(bucket_url)
    if "error sending request" in error_text or "onnect" in error_summary:
        return errno.ECONNREFUSED, (
            f"{service} can't be reached: is it up, and are AWS_ENDPOINT_URL and the network right?"
        )
    if http_status:
        return errno.EIO, f"{service} keeps failing ({http_status}): try again"
    return errno.EIO, error_summary


Location = Path | ObjectPath
"""A place; both know `/`, `name`, `parent`, `exists()` and `read_bytes()`."""


def parse_location(address: str | Location) -> Location:
    """Parse a place: a path, ``s3://bucket/key``, ``gs://...``, ``az://...``."""
    if isinstance(address, ObjectPath):
        return address
    if not isinstance(address, str | os.PathLike):
        type_name = type(address).__name__
        raise TypeError(
            f"a store is named by its path, such as 'study.zarr', and not by a {type_name}"
        )
    address_text = str(address)
    if not re.match(rf"({'|'.join(URL_SCHEMES)}):/", address_text):
        if re.match(r"(?!file:)[A-Za-z][A-Za-z0-9+.-]+:/", address_text):
            schemes_text = ", ".join(f"{scheme}://" for scheme in URL_SCHEMES if scheme != "memory")
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
    """Return a place as Zarr and xarray open it."""
    if isinstance(location, Path):
        return location
    from zarr.storage import ObjectStore, StorePath

    return StorePath(ObjectStore(location.client), location.key)


def map_concurrently(
    location: Location, function: Callable[[Item], Result], items: Iterable[Item]
) -> list[Result]:
    """Map a function, in order; concurrently if each call is a request over the network."""
    if isinstance(location, Path):
        return [function(item) for item in items]
    return list(_request_pool().map(function, items))


@cache
def _request_pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(CONCURRENT_REQUESTS_MAX, thread_name_prefix="object-store")


def read_object(location: Location, object_name: str, bytes_max: int) -> bytes:
    """Read a file below a place whole; RefusedFileError where it is none, or larger than that."""
    if isinstance(location, ObjectPath):
        return (location / object_name).read_bytes(bytes_max)
    return read_below(location, object_name, bytes_max)


def iter_names_below(location: Location) -> Iterator[str]:
    """Names of all that is below a place but folders, relative to it, however many; also links."""
    if isinstance(location, ObjectPath):
        yield from (name for name, _ in location.iter_objects_below())
        return
    prefix_length = len(str(location)) + 1
    yield from (entry.path[prefix_length:] for entry in iter_entries_below(str(location)))


def iter_entries_below(folder: str) -> Iterator[os.DirEntry[str]]:
    """Everything below a folder but folders; no link is followed."""
    with os.scandir(folder) as entries:
        for entry in entries:  # no look at a file: there may be millions
            if entry.is_dir(follow_symlinks=False):
                yield from iter_entries_below(entry.path)
            else:
                yield entry


def file_sizes_below(location: Location) -> dict[str, int]:
    """Sizes of all files below a place by their names, relative to it."""
    if isinstance(location, ObjectPath):
        return dict(location.iter_objects_below())
    return {name: (location / name).lstat().st_size for name in iter_names_below(location)}


def output_dir(location: Location) -> Path:
    """Folder for what is made of a store: where it is, or here where it is in an object store."""
    return location.parent if isinstance(location, Path) else Path()


def atomic_write(location: Location, content: bytes) -> None:
    """Write a small file in one step: readers, and power cuts, find the old one or the new one."""
    if isinstance(location, ObjectPath):
        location.write_bytes(content)
    else:
        atomic_write_file(str(location), content, durable=True)


def atomic_write_file(file_path: str, content: bytes, *, durable: bool = False) -> None:
    """Write a file on disk in one step, also where a directory has got into its place.

    A power cut can't leave the name of a `durable` one with nothing behind it.
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
    descriptor = os.open(file_path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        remaining = memoryview(content)
        while remaining:
            remaining = remaining[os.write(descriptor, remaining) :]
        if durable:
            os.fsync(descriptor)
    finally:
        os.close(descriptor)


STAGING_SUFFIX = ".next"

#: Seconds after which what another host has half made is taken for abandoned.
ABANDONED_DRAFT_AGE = 86400.0

#: Seconds that the clock of a file server may be behind.
CLOCK_SKEW_MAX = 60.0

_LEFTOVER_NAME = re.compile(
    r"\.(?P<name>.+)\.(?P<state>creating|packing|replaced|removing)-"
    r"(?:(?P<host>.+)-)?(?P<pid>\d+)(?:\.(?P<start>\d+))?-[0-9a-f]{8}"
)
"""Names of what is left by processes; those of earlier versions name no host, or no start."""

#: Start of a process that is there, but hidden from other users.
HIDDEN_PROCESS = -1


PID_MAX = 2**31 - 1
"""Largest number of a process that a system can give."""


def process_start_id(pid: int) -> int:
    """Start of a process, which tells it from others that had its number; no clock changes it.

    In clock ticks since the machine was started on Linux, in hundredths of a second since the
    epoch elsewhere. 0 where no such process runs, `HIDDEN_PROCESS` where it can't be seen.
    """
    import psutil

    if not 0 < pid <= PID_MAX:  # a lock may name any number
        return 0
    if sys.platform == "linux":
        try:
            stat_line = Path(f"/proc/{pid}/stat").read_bytes()
        except OSError:
            return HIDDEN_PROCESS if psutil.pid_exists(pid) else 0
        state, *fields = stat_line.rpartition(b")")[2].split()
        return 0 if state in (b"Z", b"X") else int(fields[18])
    try:
        return int(100 * psutil.Process(pid).create_time())
    except psutil.AccessDenied:
        return HIDDEN_PROCESS
    except psutil.Error:
        return 0


def resolve_links(location: Location) -> Location:
    """Follow symbolic links: the folder is renamed, not the link. OSError where they never end."""
    if not isinstance(location, Path):
        return location
    if not location.is_symlink():
        return location.absolute()
    try:
        resolved = location.resolve()
    except RuntimeError:  # Python's word for a loop before 3.13
        resolved = location
    if resolved.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(location))
    return resolved


def eyepoints_path(store: Location, geometry_id: str) -> Location:
    """Eyepoint store of a geometry, in a folder next to the stores of the studies that use it."""
    return resolve_links(store).parent / "eyepoints" / f"{geometry_id}.zarr"


def staging_path_for(path: Path) -> Path:
    """Place of a store that is to replace another once it is complete."""
    return path.with_name(f".{path.name}{STAGING_SUFFIX}")


def final_path_for(path: Path) -> Path:
    """Return the place that a store is made for: its own, or that of the store it replaces."""
    staging_match = re.fullmatch(rf"\.(.+){re.escape(STAGING_SUFFIX)}", path.name)
    return path.with_name(staging_match[1]) if staging_match else path


def is_free(location: Location) -> bool:
    """Tell whether a store can be made at a place: nothing is there, or an empty folder."""
    if isinstance(location, ObjectPath):
        return not location.exists()
    try:
        with os.scandir(location) as entries:
            return next(entries, None) is None
    except OSError as error:  # also a file, or something below one, or in a closed folder
        return error.errno != errno.ELOOP and not location.exists()


@contextmanager
def atomic_path(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Make a file or folder in a hidden place, and put it in its own at the end."""
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
    """Put a file or folder in the place of another, which is removed then."""
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
                continue  # `settle` elsewhere saw the gap, and has put the old one back
            if not path.exists():  # else it has put the new one there
                with suppress(OSError):
                    os.rename(retired_path, path)
                raise
        remove_replaced_store(retired_path, path)
        return


def remove_replaced_store(old_path: Path, new_path: Path) -> None:
    """Remove what another has taken the place of, but for files of the user's: they move there.

    All of it stays, under its hidden name, where they can't be moved.
    """
    from sweep.storage.foreign_files import move_foreign_files

    try:
        move_foreign_files(old_path, new_path)
    except OSError:
        return
    remove_atomically(old_path)


def remove_atomically(path: Path) -> None:
    """Take a file or folder away, out of its place in one step."""
    removal_path = _hidden_path(path, "removing")
    with suppress(FileNotFoundError):
        os.rename(path, removal_path)
    _remove_tree(removal_path)


def recover_interrupted_replace(location: Location) -> None:
    """Finish or undo what processes that died have left in the folder of a store.

    A store whose replacement was interrupted is replaced if its successor is whole, or is put
    back. Drafts of dead processes are removed. Everything is left alone where the folder can't
    be written.
    """
    if not isinstance(location, Path):
        return
    with suppress(OSError):
        path = resolve_links(location)
        assert isinstance(path, Path)
        for name in os.listdir(path.parent):
            if leftover_match := _LEFTOVER_NAME.fullmatch(name):
                with suppress(OSError):
                    _recover_leftover(path.parent / name, leftover_match)


def store_identity(location: Location) -> tuple[int, ...] | None:
    """Identity of the store at a place, unlike any other that was or will be there; or None."""
    if not isinstance(location, Path):
        return None
    try:
        descriptor = open_below(location, "zarr.json")  # opened: a file server is asked anew
    except OSError:
        return None
    try:
        status = os.fstat(descriptor)
    finally:
        os.close(descriptor)
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _recover_leftover(leftover: Path, leftover_match: re.Match[str]) -> None:
    path = leftover.with_name(leftover_match["name"])
    if leftover_match["state"] == "replaced":
        if not path.exists():
            os.rename(staging_path_for(path) if staging_path_for(path).exists() else leftover, path)
        if leftover.exists():
            remove_replaced_store(leftover, path)
    elif leftover_match["state"] == "removing" or not _is_being_written(leftover, leftover_match):
        _remove_tree(leftover)


def _is_being_written(draft_path: Path, leftover_match: re.Match[str]) -> bool:
    """Tell whether the process that makes a draft may still be at it."""
    import psutil

    modified_time = draft_path.stat().st_mtime
    if leftover_match["host"] not in (None, socket.gethostname()):
        return time.time() - modified_time < ABANDONED_DRAFT_AGE
    if leftover_match["start"]:
        return process_start_id(int(leftover_match["pid"])) in (
            int(leftover_match["start"]),
            HIDDEN_PROCESS,
        )
    try:  # a process that is younger than the draft has got its maker's number
        return (
            psutil.Process(int(leftover_match["pid"])).create_time()
            < modified_time + CLOCK_SKEW_MAX
        )
    except psutil.Error:
        return False


def _hidden_path(path: Path, state: str) -> Path:
    process_tag = f"{os.getpid()}.{process_start_id(os.getpid())}"
    unique_tag = f"{socket.gethostname()}-{process_tag}-{uuid.uuid4().hex[:8]}"
    name = (
        leftover_match["name"]
        if (leftover_match := _LEFTOVER_NAME.fullmatch(path.name))
        else path.name
    )
    return path.with_name(f".{name}.{state}-{unique_tag}")


def _remove_tree(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


#: Words for a disk that has room, but takes no further file.
NO_INODES_TEXT = "No inodes left on device"


#: What to do where a store can't be written, by the number of the error.
REMEDY_BY_ERRNO = {
    errno.ENOSPC: "make room on its disk",
    errno.EDQUOT: "make room in your quota",
    errno.EMFILE: "raise the limit of open files, `ulimit -n`",
    errno.ENFILE: "raise the machine's limit of open files",
    errno.EROFS: "have its disk mounted for writing",
    errno.EACCES: "have the permission to write there",
    errno.EPERM: "have the permission to write there",
}


def os_error_reason(error: OSError, path: object) -> str:
    """Words for why a place can't be written or read.

    The system says "no space" also where a disk has room, but no inode for a further file.
    """
    reason_text = error.strerror or str(error)
    if error.errno == errno.ENOSPC and isinstance(path, Path) and _lacks_inodes(path):
        return NO_INODES_TEXT
    return reason_text


def write_remedy(error: OSError, place: object, otherwise: str) -> str:
    """Return what to do where a place can't be written: by the error, or else as is proposed."""
    if NO_INODES_TEXT in (error.strerror, os_error_reason(error, place)):
        return "remove files from its disk, or have one with more inodes"
    return REMEDY_BY_ERRNO.get(error.errno or 0, otherwise)


def _lacks_inodes(path: Path) -> bool:
    """Tell whether the disk of a place, which need not exist, has no inodes left."""
    while not path.exists() and path != path.parent:
        path = path.parent
    with suppress(OSError):
        disk = os.statvfs(path)
        return disk.f_files > 0 and disk.f_favail == 0 and disk.f_bavail > 0
    return False
