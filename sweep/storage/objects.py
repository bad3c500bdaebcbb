"""Keys in an object store, spoken to as far as needed in the words of `pathlib`.

Which credentials and which endpoint is for the environment to say (AWS_ACCESS_KEY_ID,
AWS_ENDPOINT_URL and so on); nothing of it is kept in a store.
"""

from __future__ import annotations

import errno
import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

#: Kinds of addresses; `memory` is for tests, and lives as long as its process.
SCHEMES = ("s3", "gs", "az", "memory")

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
"""What an object store knows a state of an object by."""

_clients: dict[str, Any] = {}
_opening = threading.RLock()


class ObjectStoreError(OSError):
    """An object store that can't be used as asked: the text says why and what to do."""

    def __str__(self) -> str:
        return f"{self.filename}: {self.strerror}"


@dataclass(frozen=True, order=True)
class ObjectPath:
    """A key in an object store.

    Parameters
    ----------
    root
        Kind and bucket: ``s3://bucket``.
    key
        The key, without a slash at either end.
    """

    root: str
    key: str

    def __str__(self) -> str:
        return f"{self.root}/{self.key}"

    def __truediv__(self, other: str) -> ObjectPath:
        return ObjectPath(self.root, "/".join(filter(None, [self.key, str(other).strip("/")])))

    def joinpath(self, *others: str) -> ObjectPath:
        """The key below this one."""
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
        """A key beside this one."""
        return self.parent / name

    def absolute(self) -> ObjectPath:
        """Itself."""
        return self

    @property
    def client(self) -> Any:
        """The object store, connected once a process."""
        return _connected(self)

    def exists(self) -> bool:
        """Whether there is an object at the key, or a Zarr group or array under it."""
        return self.size() >= 0 or (self / "zarr.json").size() >= 0

    def size(self) -> int:
        """Bytes of the object; -1 where there is none."""
        import obstore

        with in_words(self):
            try:
                return int(obstore.head(self.client, self.key)["size"])
            except FileNotFoundError:
                return -1

    def read_bytes(self) -> bytes:
        """The object whole."""
        import obstore

        with in_words(self):
            return bytes(obstore.get(self.client, self.key).bytes())

    def read_text(self, encoding: str = "utf-8") -> str:
        """The object as text."""
        return self.read_bytes().decode(encoding)

    def write_bytes(self, content: bytes) -> None:
        """Put an object, whole, in the place of whatever is there."""
        import obstore

        with in_words(self):
            obstore.put(self.client, self.key, content)

    def unlink(self, missing_ok: bool = False) -> None:
        """Take the object away; that there is none is no error, whatever is asked for."""
        import obstore

        with in_words(self), suppress(FileNotFoundError):
            obstore.delete(self.client, self.key)

    def below(self) -> Iterator[tuple[str, int]]:
        """Keys under this one, relative to it, and their sizes, a page in memory at a time."""
        import obstore

        with in_words(self):
            for page in obstore.list(self.client, self.key or None):
                for found in page:
                    yield found["path"][len(self.key) :].lstrip("/"), found["size"]

    def children(self) -> list[str]:
        """Names right under this key."""
        import obstore

        with in_words(self):
            found = obstore.list_with_delimiter(self.client, self.key or None)
        paths = [*found["common_prefixes"], *(one["path"] for one in found["objects"])]
        return sorted(path.rpartition("/")[2] for path in paths)

    def is_dir(self) -> bool:
        """Whether keys lie under this one."""
        return bool(self.children())

    def glob(self, pattern: str) -> list[ObjectPath]:
        """Keys right under this one whose name fits a pattern."""
        from fnmatch import fnmatch

        return [self / name for name in self.children() if fnmatch(name, pattern)]

    def read_tagged(self) -> tuple[bytes, Tag] | None:
        """The object and the tag of what it holds; None where there is none."""
        import obstore

        with in_words(self):
            try:
                found = obstore.get(self.client, self.key)
                return bytes(found.bytes()), _tag(found.meta)
            except FileNotFoundError:
                return None

    def put_if(self, content: bytes, tag: Tag | None) -> Tag | None:
        """Put an object if none is there, or only what has a tag.

        Returns
        -------
        dict or None
            The new tag; None where somebody was quicker.
        """
        import obstore
        from obstore.exceptions import AlreadyExistsError, PreconditionError

        with in_words(self):
            try:
                found = obstore.put(
                    self.client, self.key, content, mode="create" if tag is None else tag
                )
            except (AlreadyExistsError, PreconditionError, FileNotFoundError):
                return None
            return _tag(found)

    def modified(self) -> float | None:
        """When the object was last written [s since the epoch]; None where there is none."""
        import obstore

        with in_words(self):
            try:
                return float(obstore.head(self.client, self.key)["last_modified"].timestamp())
            except FileNotFoundError:
                return None


def _tag(found: Any) -> Tag:
    return {key: found[key] for key in ("e_tag", "version") if found[key] is not None}


def _connected(path: ObjectPath) -> Any:
    """The object store of a path; on first contact it is asked whether it is there at all."""
    with _opening:
        if path.root not in _clients:
            import obstore

            with in_words(path):
                if not path.root.startswith("memory:"):
                    obstore.list_with_delimiter(_client(path.root, FIRST_RETRIES), path.key or None)
                _clients[path.root] = _client(path.root, RETRIES)
        return _clients[path.root]


def _client(root: str, retries: Any) -> Any:
    from obstore.store import MemoryStore, from_url

    if root.startswith("memory:"):
        return MemoryStore()
    plain = _endpoint().startswith("http:")
    options: Any = {**CLIENT, "allow_http": plain or _is_set("AWS_ALLOW_HTTP")}
    return from_url(root, client_options=options, retry_config=retries)


def _endpoint() -> str:
    return os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL", "")


def _is_set(name: str) -> bool:
    return os.environ.get(name, "").lower() in ("1", "true", "yes")


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
    """An error as it is, or in words where an object store raised it through Zarr or xarray."""
    if type(error).__module__.partition(".")[0] != "obstore":
        return error
    return ObjectStoreError(*explained(str(error), ""), "the store")


def explained(text: str, root: str) -> tuple[int, str]:
    """Number and words of an object store's error, with a remedy.

    Parameters
    ----------
    text
        What the library says.
    root
        Kind and bucket.
    """
    bucket, at = root.partition("://")[2], _endpoint() or f"the service of {root.split(':')[0]}://"
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
    if "error sending request" in text or "onnect" in said:
        return errno.ECONNREFUSED, (
            f"{at} can't be reached: is it up, and are AWS_ENDPOINT_URL and the network right?"
        )
    if answer:
        return errno.EIO, f"{at} keeps failing ({answer}): try again"
    return errno.EIO, said
