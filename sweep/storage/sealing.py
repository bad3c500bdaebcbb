"""Lines that tell whether they are as they were written: JSON with its own digest at the end."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from typing import Any

from sweep.storage.locations import Location, each
from sweep.storage.logs import raw_lines

_SUM = b',"sum":"'
_END = b'"}\n'


def sealed(record: dict[str, Any]) -> bytes:
    """A record, not empty, as one line of JSON whose last field is a digest of the others."""
    return closed(json.dumps(record, separators=(",", ":")).encode()[:-1])


def closed(body: bytes) -> bytes:
    """A line of the fields of a record, written without the last brace."""
    return body + _SUM + _digest(body) + _END


def unsealed(line: bytes) -> dict[str, Any] | None:
    """The record of a line; None where any byte of it is not as it was written."""
    body = body_of(line)
    if body is None:
        return None
    try:
        record = json.loads(body + b"}")
    except (ValueError, RecursionError):  # a stranger's, with a digest of its own
        return None
    return record if isinstance(record, dict) else None


def body_of(line: bytes) -> bytes | None:
    """The fields of a line, unread, without the last brace; None as of :func:`unsealed`."""
    body, found, end = line.rpartition(_SUM)
    return body if found and end == _digest(body) + _END else None


def _digest(body: bytes) -> bytes:
    return hashlib.blake2b(body, digest_size=8).hexdigest().encode()


def read_sealed(path: Location) -> Iterator[tuple[bytes, dict[str, Any] | None]]:
    """Lines of a log and their records, None where damaged or cut short; nothing if it is absent.

    A line end that was damaged joins two lines into one that is damaged.
    """
    for line in raw_lines(path):
        yield line, unsealed(line)


def read_lines(path: Location) -> Iterator[dict[str, Any]]:
    """Records of a log, in order; a line that is damaged or cut short is passed over."""
    return (record for _, record in read_sealed(path) if record is not None)


def damaged_lines(path: Location) -> list[int]:
    """Numbers, from 1, of the lines of a log that are damaged or cut short."""
    return [n for n, (_, record) in enumerate(read_sealed(path), start=1) if record is None]


def digest(path: Location, objects: list[str]) -> str:
    """blake2b-128 of names and bytes of stored objects, in hex."""
    contents = each(path, lambda name: (path / name).read_bytes(), objects)
    return digest_of(zip(objects, contents, strict=True))


def digest_of(contents: Iterable[tuple[str, bytes]]) -> str:
    """As :func:`digest`, of names and bytes at hand."""
    sum_ = hashlib.blake2b(digest_size=16)
    for name, content in contents:
        sum_.update(f"{name}\0{len(content)}\0".encode())
        sum_.update(content)
    return sum_.hexdigest()
