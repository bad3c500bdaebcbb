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

from sweep.messages import printable
from sweep.plain_files import (
    open_below,
    read_below,
    refuse_larger,
)

#: Kinds of addresses; `memory` is for tests, and lives as long as its process.
SCHEMES = ("s3", "gs", "az", "memory")

#: Directory of the journal inside a store.
JOURNAL = ".sweep"

#: What the name of a file ends in that is still being written.
PARTIAL = ".partial"

#: Attribute of a copy of a store with many chunks to a file.
PACKED = "packed"

#: Requests to an object store at once: each takes some ms, nearly all of it waiting.
REQUESTS = 16

#: What is tried again, and for how long: replies of 500 and more, none in time, lost connections.
RETRIES = {
    "max_retries": 8,
    "retry_timeout": timedelta(seconds=90),
    "backoff": {
        "init_backoff": timedelta(milliseconds=100),
        "max_backoff": timedelta(seconds=10),
        "base": 2,
    },
}

#: The same at first contact, where a wrong address is likelier than a passing fault.
FIRST_RETRIES = {**RETRIES, "max_retries": 3, "retry_timeout": timedelta(seconds=10)}

CLIENT = {"timeout": "30s", "connect_timeout": "5s"}

Tag = Any
"""Mark by which an object store knows a state of an object."""

Item = TypeVar("Item")
Found = TypeVar("Found")

#: Words of the library for a body that is cut, and for a list that is.
_CUT = ("body error", "invalid list response")

_clients: dict[str, Any] = {}
_opening = threading.RLock()


class ObjectStoreError(OSError):
    """An object store that can't be used as asked: the text says why and what to do."""

    def __str__(self) -> str:
        return printable(f"{self.filename}: {self.strerror}")


@dataclass(frozen=True, order=True)
class ObjectPath:
    """A key in an object store, spoken to as far as needed in the words of `pathlib`."""

    root: str  # kind and bucket: s3://bucket
    key: str  # without a slash at either end

    def __str__(self) -> str:
        return f"{self.root}/{self.key}"

    def __truediv__(self, other: str) -> ObjectPath:
        return ObjectPath(self.root, "/".join(filter(None, [self.key, str(other).strip("/")])))

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
        return ObjectPath(self.root, self.key.rpartition("/")[0])

    def with_name(self, name: str) -> ObjectPath:
        """Return a key in the same folder."""
        return self.parent / name

    def absolute(self) -> ObjectPath:
        """Itself."""
        return self

    @property
    def client(self) -> Any:
        """The object store, connected once a process; the first contact checks that it exists."""
        with _opening:
            if self.root not in _clients:
                with in_words(self):
                    if not self.root.startswith("memory:"):
                        first = _client(self.root, FIRST_RETRIES)
                        _ask_twice(lambda: first.list_with_delimiter(self.key or None))
                    _clients[self.root] = _client(self.root, RETRIES)
            return _clients[self.root]

    def _head(self) -> Any:
        """Metadata of the object; None where there is none."""
        with in_words(self), suppress(FileNotFoundError):
            return self.client.head(self.key)

    def exists(self) -> bool:
        """Tell whether there is an object at the key, or a Zarr group or array under it."""
        return self.size() >= 0 or (self / "zarr.json").size() >= 0

    def size(self) -> int:
        """Bytes of the object; -1 where there is none."""
        head = self._head()
        return -1 if head is None else int(head["size"])

    def modified(self) -> float | None:
        """Time at which the object was last written [s since the epoch]; None without one."""
        head = self._head()
        return None if head is None else float(head["last_modified"].timestamp())

    def read_bytes(self, bytes_max: int | None = None) -> bytes:
        """Return the object whole; once more where the body of the answer is cut.

        UnfitFileError where it is larger than so many bytes.
        """
        from obstore.exceptions import BaseError

        with in_words(self):
            answer = self.client.get(self.key)
            if bytes_max is not None:
                refuse_larger(answer.meta["size"], bytes_max, str(self))
            try:
                return bytes(answer.bytes())
            except BaseError:
                return bytes(self.client.get(self.key).bytes())

    def write_bytes(self, content: bytes) -> None:
        """Put an object, whole, in the place of whatever is there."""
        with in_words(self):
            self.client.put(self.key, content)

    def unlink(self, missing_ok: bool = False) -> None:
        """Take the object away; that there is none is no error, whatever is asked for."""
        with in_words(self), suppress(FileNotFoundError):
            self.client.delete(self.key)

    def below(self) -> Iterator[tuple[str, int]]:
        """Keys under this one, relative to it, and their sizes, a page in memory at a time."""
        from obstore.exceptions import BaseError

        last, is_repeated = None, False
        with in_words(self):
            while True:
                try:
                    for page in self.client.list(self.key or None, offset=last):
                        for found in page:
                            yield found["path"][len(self.key) :].lstrip("/"), found["size"]
                            last, is_repeated = found["path"], False
                    return
                except BaseError as error:
                    if is_repeated or not _is_cut(error):
                        raise
                    is_repeated = True  # the list goes on after the last key that came

    def _children(self) -> list[str]:
        with in_words(self):
            found = _ask_twice(lambda: self.client.list_with_delimiter(self.key or None))
        paths = [*found["common_prefixes"], *(one["path"] for one in found["objects"])]
        return sorted(path.rpartition("/")[2] for path in paths)

    def is_dir(self) -> bool:
        """Tell whether keys lie under this one."""
        return bool(self._children())

    def glob(self, pattern: str) -> list[ObjectPath]:
        """Keys right under this one whose name fits a pattern."""
        return [self / name for name in self._children() if fnmatch(name, pattern)]

    def read_tagged(self) -> tuple[bytes, Tag] | None:
        """Return the object and the tag of what it holds; None where there is none."""

        def ask() -> tuple[bytes, Tag]:
            answer = self.client.get(self.key)
            return bytes(answer.bytes()), _tag(answer.meta)

        with in_words(self), suppress(FileNotFoundError):
            return _ask_twice(ask)
        return None

    def refuse_cut(self, content: bytes) -> None:
        """Raise ObjectStoreError if an answer with this content lacks a part of the object.

        A proxy may announce the part of a body that it has as the whole of it.
        """
        if len(content) < self.size():
            raise ObjectStoreError(errno.EIO, _cut_in_words(self.root), str(self))

    def put_if(self, content: bytes, tag: Tag | None) -> Tag | None:
        """Put an object if none is there, or only what has a tag; None if somebody was quicker."""
        from obstore.exceptions import AlreadyExistsError, PreconditionError

        mode = "create" if tag is None else tag
        quicker = (AlreadyExistsError, PreconditionError, FileNotFoundError)
        with in_words(self), suppress(*quicker):
            return _tag(self.client.put(self.key, content, mode=mode))
        return None


def _ask_twice(ask: Callable[[], Found]) -> Found:
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


def _tag(found: Any) -> Tag:
    return {key: found[key] for key in ("e_tag", "version") if found[key] is not None}


def _client(root: str, retries: Any) -> Any:
    from obstore.store import MemoryStore, from_url

    if root.startswith("memory:"):
        return MemoryStore()
    allowed = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true", "yes")
    options: Any = {**CLIENT, "allow_http": allowed or _endpoint().startswith("http:")}
    return from_url(root, client_options=options, retry_config=retries)


def _cut_in_words(root: str) -> str:
    return f"{_service(root)} cuts its answers short: try again, or look at the network"


def _service(root: str) -> str:
    return _endpoint() or f"the service of {root.split(':')[0]}://"


def _endpoint() -> str:
    return os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL", "")


@contextmanager
def in_words(where: object) -> Iterator[None]:
    """Errors of an object store in words, with what to do; nothing where a path is a file's."""
    if not isinstance(where, ObjectPath):
        yield
        return
    from obstore.exceptions import BaseError

    try:
        yield
    except BaseError as error:
        number, why = explained(str(error), where.root)
        raise ObjectStoreError(number, why, str(where)) from error


def worded(error: Exception) -> Exception:
    """Put an error into words if an object store raised it through Zarr or xarray."""
    if type(error).__module__.partition(".")[0] != "obstore":
        return error
    return ObjectStoreError(*explained(str(error), ""), "the store")


def explained(text: str, root: str) -> tuple[int, str]:
    """Return the number and words of what an object store's library says, of a kind and bucket."""
    bucket, at = root.partition("://")[2], _service(root)
    said = text.partition("\n\nDebug source")[0]
    status = re.search(r"status code: (\d+ [A-Za-z ]+)|\b([45]\d\d [A-Z][a-z ]+)", said)
    answer = (status[1] or status[2]).strip() if status else ""
    if "NoSuchBucket" in text or "ContainerNotFound" in text:
        return errno.ENXIO, f"{at} has no bucket {bucket!r}: make it, or mend its name"
    if (
        "169.254.169.254" in text
        or re.search(r"Missing \w*Key", said)
        or "metadata.google.internal" in text
    ):
        return errno.EACCES, (
            "no credentials are set: give AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY (workers "
            "need them too); AWS_SKIP_SIGNATURE=true reads what is public"
        )
    if answer[:3] in ("401", "403") or "PermissionDenied" in text:
        return errno.EACCES, (
            f"{at} refuses access{f' ({answer})' if answer else ''}: "
            "check the credentials, and that they may list, read and write there"
        )
    if "imed out" in text or "Timeout" in text:
        return errno.ETIMEDOUT, f"{at} does not answer in time: try again, or look at the network"
    if any(words in text for words in _CUT):
        return errno.EIO, _cut_in_words(root)
    if "error sending request" in text or "onnect" in said:
        return errno.ECONNREFUSED, (
            f"{at} can't be reached: is it up, and are AWS_ENDPOINT_URL and the network right?"
        )
    if answer:
        return errno.EIO, f"{at} keeps failing ({answer}): try again"
    return errno.EIO, said


Location = Path | ObjectPath
"""A place; both know `/`, `name`, `parent`, `exists()` and `read_bytes()`."""


def located(where: str | Location) -> Location:
    """Parse a place: a path, ``s3://bucket/key``, ``gs://...``, ``az://...``."""
    if isinstance(where, ObjectPath):
        return where
    if not isinstance(where, str | os.PathLike):
        kind = type(where).__name__
        raise TypeError(f"a store is named by its path, such as 'study.zarr', and not by a {kind}")
    text = str(where)
    if not re.match(rf"({'|'.join(SCHEMES)}):/", text):
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
    """Return a place as Zarr and xarray open it."""
    if isinstance(location, Path):
        return location
    from zarr.storage import ObjectStore, StorePath

    return StorePath(ObjectStore(location.client), location.key)


def each(
    location: Location, function: Callable[[Item], Found], items: Iterable[Item]
) -> list[Found]:
    """Map a function, in order; concurrently if each call is a request over the network."""
    if isinstance(location, Path):
        return [function(item) for item in items]
    return list(_requests().map(function, items))


@cache
def _requests() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(REQUESTS, thread_name_prefix="object-store")


def read_object(location: Location, name: str, bytes_max: int) -> bytes:
    """Read a file below a place whole; UnfitFileError where it is none, or larger than that."""
    if isinstance(location, ObjectPath):
        return (location / name).read_bytes(bytes_max)
    return read_below(location, name, bytes_max)


def names_below(location: Location) -> Iterator[str]:
    """Names of all that is below a place but folders, relative to it, however many; also links."""
    if isinstance(location, ObjectPath):
        yield from (name for name, _ in location.below())
        return
    start = len(str(location)) + 1
    yield from (entry.path[start:] for entry in entries_below(str(location)))


def entries_below(folder: str) -> Iterator[os.DirEntry[str]]:
    """Everything below a folder but folders; no link is followed."""
    with os.scandir(folder) as entries:
        for entry in entries:  # no look at a file: there may be millions
            if entry.is_dir(follow_symlinks=False):
                yield from entries_below(entry.path)
            else:
                yield entry


def files_below(location: Location) -> dict[str, int]:
    """Sizes of all files below a place by their names, relative to it."""
    if isinstance(location, ObjectPath):
        return dict(location.below())
    return {name: (location / name).lstat().st_size for name in names_below(location)}


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

    A power cut can't leave the name of a `durable` one with nothing behind it.
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


NEXT = ".next"

#: Seconds after which what another host has half made is taken for abandoned.
ABANDONED = 86400.0

#: Seconds that the clock of a file server may be behind.
SKEW = 60.0

_LEFT = re.compile(
    r"\.(?P<name>.+)\.(?P<state>creating|packing|replaced|removing)-"
    r"(?:(?P<host>.+)-)?(?P<pid>\d+)(?:\.(?P<start>\d+))?-[0-9a-f]{8}"
)
"""Names of what is left by processes; those of earlier versions name no host, or no start."""

#: Start of a process that is there, but hidden from other users.
HIDDEN = -1


PID_MAX = 2**31 - 1
"""Largest number of a process that a system can give."""


def process_start(pid: int) -> int:
    """Start of a process, which tells it from others that had its number; no clock changes it.

    In clock ticks since the machine was started on Linux, in hundredths of a second since the
    epoch elsewhere. 0 where no such process runs, `HIDDEN` where it can't be seen.
    """
    import psutil

    if not 0 < pid <= PID_MAX:  # a lock may name any number
        return 0
    if sys.platform == "linux":
        try:
            content = Path(f"/proc/{pid}/stat").read_bytes()
        except OSError:
            return HIDDEN if psutil.pid_exists(pid) else 0
        state, *fields = content.rpartition(b")")[2].split()
        return 0 if state in (b"Z", b"X") else int(fields[18])
    try:
        return int(100 * psutil.Process(pid).create_time())
    except psutil.AccessDenied:
        return HIDDEN
    except psutil.Error:
        return 0


def real(location: Location) -> Location:
    """Follow symbolic links: the folder is renamed, not the link. OSError where they never end."""
    if not isinstance(location, Path):
        return location
    if not location.is_symlink():
        return location.absolute()
    try:
        place = location.resolve()
    except RuntimeError:  # Python's word for a loop before 3.13
        place = location
    if place.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(location))
    return place


def eyepoints_path(store: Location, geometry_id: str) -> Location:
    """Eyepoint store of a geometry, in a folder next to the stores of the studies that use it."""
    return real(store).parent / "eyepoints" / f"{geometry_id}.zarr"


def successor(path: Path) -> Path:
    """Place of a store that is to replace another once it is complete."""
    return path.with_name(f".{path.name}{NEXT}")


def replaced_by(path: Path) -> Path:
    """Return the place that a store is made for: its own, or that of the store it replaces."""
    made = re.fullmatch(rf"\.(.+){re.escape(NEXT)}", path.name)
    return path.with_name(made[1]) if made else path


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
def draft(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Make a file or folder in a hidden place, and put it in its own at the end."""
    settle(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    made = _hidden(path, "creating")
    try:
        yield made
        if replace:
            take_place(made, path)
        else:
            os.rename(made, path)
    finally:
        _delete(made)


def take_place(new: Path, path: Path) -> None:
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
        retire(old, path)
        return


def retire(old: Path, new: Path) -> None:
    """Remove what another has taken the place of, but for files of the user's: they move there.

    All of it stays, under its hidden name, where they can't be moved.
    """
    from sweep.storage.foreign import carry_over

    try:
        carry_over(old, new)
    except OSError:
        return
    discard(old)


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
    if not isinstance(location, Path):
        return
    with suppress(OSError):
        path = real(location)
        assert isinstance(path, Path)
        for name in os.listdir(path.parent):
            if left := _LEFT.fullmatch(name):
                with suppress(OSError):
                    _settle(path.parent / name, left)


def stamp(location: Location) -> tuple[int, ...] | None:
    """Identity of the store at a place, unlike any other that was or will be there; or None."""
    if not isinstance(location, Path):
        return None
    try:
        opened = open_below(location, "zarr.json")  # opened: a file server is asked anew
    except OSError:
        return None
    try:
        found = os.fstat(opened)
    finally:
        os.close(opened)
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


def _settle(left: Path, made: re.Match[str]) -> None:
    path = left.with_name(made["name"])
    if made["state"] == "replaced":
        if not path.exists():
            os.rename(successor(path) if successor(path).exists() else left, path)
        if left.exists():
            retire(left, path)
    elif made["state"] == "removing" or not _is_made(left, made):
        _delete(left)


def _is_made(draft: Path, made: re.Match[str]) -> bool:
    """Tell whether the process that makes a draft may still be at it."""
    import psutil

    begun = draft.stat().st_mtime
    if made["host"] not in (None, socket.gethostname()):
        return time.time() - begun < ABANDONED
    if made["start"]:
        return process_start(int(made["pid"])) in (int(made["start"]), HIDDEN)
    try:  # a process that is younger than the draft has got its maker's number
        return psutil.Process(int(made["pid"])).create_time() < begun + SKEW
    except psutil.Error:
        return False


def _hidden(path: Path, state: str) -> Path:
    process = f"{os.getpid()}.{process_start(os.getpid())}"
    maker = f"{socket.gethostname()}-{process}-{uuid.uuid4().hex[:8]}"
    name = made["name"] if (made := _LEFT.fullmatch(path.name)) else path.name
    return path.with_name(f".{name}.{state}-{maker}")


def _delete(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


#: Words for a disk that has room, but takes no further file.
NO_INODES = "No inodes left on device"


#: What to do where a store can't be written, by the number of the error.
REMEDIES = {
    errno.ENOSPC: "make room on its disk",
    errno.EDQUOT: "make room in your quota",
    errno.EMFILE: "raise the limit of open files, `ulimit -n`",
    errno.ENFILE: "raise the machine's limit of open files",
    errno.EROFS: "have its disk mounted for writing",
    errno.EACCES: "have the permission to write there",
    errno.EPERM: "have the permission to write there",
}


def reason(error: OSError, place: object) -> str:
    """Words for why a place can't be written or read.

    The system says "no space" also where a disk has room, but no inode for a further file.
    """
    words = error.strerror or str(error)
    if error.errno == errno.ENOSPC and isinstance(place, Path) and _lacks_inodes(place):
        return NO_INODES
    return words


def write_remedy(error: OSError, place: object, otherwise: str) -> str:
    """Return what to do where a place can't be written: by the error, or else as is proposed."""
    if NO_INODES in (error.strerror, reason(error, place)):
        return "remove files from its disk, or have one with more inodes"
    return REMEDIES.get(error.errno or 0, otherwise)


def _lacks_inodes(place: Path) -> bool:
    """Tell whether the disk of a place, which need not exist, has no inodes left."""
    while not place.exists() and place != place.parent:
        place = place.parent
    with suppress(OSError):
        disk = os.statvfs(place)
        return disk.f_files > 0 and disk.f_favail == 0 and disk.f_bavail > 0
    return False
