"""Files of a store's arrays, looked at before Zarr decodes them: their size, and what they declare.

A few kilobytes of zstd can declare, and decode to, more than any memory holds. The metadata of an
array, which are checked before, give the size of its chunks. So a file that is larger than it can
be, or a frame that declares another size, or none, is refused unread.
"""

from __future__ import annotations

import asyncio
import errno
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numcodecs.zstd import Zstd
from zarr.abc.store import OffsetByteRequest, RangeByteRequest, SuffixByteRequest
from zarr.core.buffer import default_buffer_prototype
from zarr.storage import LocalStore, ObjectStore

from sweep.messages import suggestion
from sweep.plain_files import UnfitFileError, read_below, refuse_larger

#: Bytes of the document of a group or an array at most.
DOCUMENT_BYTES_MAX = 64 << 20

#: Bytes of a word on a text axis at most.
TEXT_BYTES_MAX = 1 << 16

#: Bytes of any file of an array at most: 2 GB before compression, which may add a little.
FILE_BYTES_MAX = (1 << 31) + (1 << 25)

_CHECKSUM_BYTES = 4
_INDEX_BYTES = 16  # offset and length of a chunk in a shard
_NO_CHUNK = 2**64 - 1
_HEADER_BYTES_MAX = 18  # of a zstd frame
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_ZSTD = Zstd()


def packed_bytes_max(size: int) -> int:
    """Bytes that so many can come to as a chunk: zstd's own bound, and the checksum's.

    >>> packed_bytes_max(1_000_000)
    1003970
    """
    return size + (size >> 8) + 64 + _CHECKSUM_BYTES


class ArrayFiles(NamedTuple):
    """Form of the files of an array."""

    items: int  # values of a chunk
    item_bytes: int  # 0 of text
    chunks: int  # of a shard; 0 where a file is one chunk

    @classmethod
    def of(cls, node: Mapping[str, Any]) -> ArrayFiles:
        """Return the form that the checked metadata of an array declare."""
        file = chunk = node["chunk_grid"]["configuration"]["chunk_shape"]
        text = node["data_type"] == "string"
        codec, chunks = node["codecs"][0], 0
        if codec["name"] == "sharding_indexed":
            chunk = codec["configuration"]["chunk_shape"]
            chunks = math.prod(-(-n // cut) for n, cut in zip(file, chunk, strict=True))
        item_bytes = 0 if text else np.dtype(node["data_type"]).itemsize
        return cls(math.prod(chunk), item_bytes, chunks)

    @property
    def chunk_bytes_max(self) -> int:
        """Bytes of a chunk before compression; of text at most."""
        if self.item_bytes:
            return self.items * self.item_bytes
        return 4 + self.items * (4 + TEXT_BYTES_MAX)

    @property
    def file_bytes_max(self) -> int:
        """Bytes that a file can have."""
        if not self.chunks:
            return packed_bytes_max(self.chunk_bytes_max)
        chunk = packed_bytes_max(self.chunk_bytes_max)
        return self.chunks * (chunk + _INDEX_BYTES) + _CHECKSUM_BYTES

    def check_file(self, content: bytes, whole: str) -> None:
        """Refuse a file with a chunk that would not decode to its size; UnfitFileError."""
        for chunk in self._chunks_in(content):
            self.check_chunk(chunk, whole)

    def _chunks_in(self, content: bytes) -> Iterator[bytes]:
        if not self.chunks:
            yield content
            return
        end = len(content) - _CHECKSUM_BYTES
        if end < self.chunks * _INDEX_BYTES:
            return  # too short for an index: Zarr says so
        index = np.frombuffer(content[end - self.chunks * _INDEX_BYTES : end], "<u8").reshape(-1, 2)
        for offset, length in index[index[:, 0] != _NO_CHUNK].tolist():
            needed = min(length, _HEADER_BYTES_MAX) if self.item_bytes else length
            yield content[offset : offset + needed]

    def check_chunk(self, content: bytes, whole: str) -> None:
        """Refuse a packed chunk that would not decode to its size; UnfitFileError.

        One that is no zstd frame is left to the codecs, which refuse it.
        """
        if not content.startswith(_ZSTD_MAGIC):
            return
        declared = declared_bytes(content)
        if declared is None:
            raise UnfitFileError(errno.EINVAL, "has a chunk that does not declare its size", whole)
        if declared > self.chunk_bytes_max or (self.item_bytes and declared < self.chunk_bytes_max):
            raise UnfitFileError(
                errno.EINVAL,
                f"has a chunk that declares {declared:,} bytes, where {self.chunk_bytes_max:,} "
                f"are {'right' if self.item_bytes else 'the most'}",
                whole,
            )
        if not self.item_bytes:
            self._check_text(content, whole)

    def _check_text(self, content: bytes, whole: str) -> None:
        """Refuse text that declares another number of words: room is made for all of them."""
        try:
            decoded = bytes(_ZSTD.decode(content[:-_CHECKSUM_BYTES]))
        except RuntimeError:
            return  # damaged: the codecs say so
        if int.from_bytes(decoded[:4], "little") != self.items:
            raise UnfitFileError(errno.EINVAL, "has another number of words than its array", whole)


def declared_bytes(frame: bytes) -> int | None:
    """Size that a zstd frame declares for what is packed in it; None where it declares none.

    The header is that of RFC 8878, section 3.1.1.1.

    >>> declared_bytes(bytes(Zstd().encode(b"x" * 1000)))
    1000
    """
    if len(frame) < 5:
        return None
    descriptor = frame[4]
    is_single_segment = bool(descriptor & 0b0010_0000)
    size_bytes = (int(is_single_segment), 2, 4, 8)[descriptor >> 6]
    start = 5 + (not is_single_segment) + (0, 1, 2, 4)[descriptor & 0b11]
    if not size_bytes or len(frame) < start + size_bytes:
        return None
    declared = int.from_bytes(frame[start : start + size_bytes], "little")
    return declared + 256 if size_bytes == 2 else declared


class StoreFiles:
    """Files of a store by its checked document: which there are, and what they may hold."""

    def __init__(self, document: Mapping[str, Any]) -> None:
        nodes = document["consolidated_metadata"]["metadata"]
        self._arrays = {
            name: ArrayFiles.of(node) for name, node in nodes.items() if "data_type" in node
        }

    def array_of(self, name: str) -> ArrayFiles | None:
        """Form of the array that a file is a chunk of; None of a document."""
        return self._arrays.get(name.rpartition("/c/")[0] or name.removesuffix("/c"))

    def bytes_max(self, name: str) -> int:
        """Bytes that a file of the store can have, by its name."""
        array = self.array_of(name)
        return DOCUMENT_BYTES_MAX if array is None else array.file_bytes_max

    def check(self, name: str, content: bytes, whole: str, *, is_part: bool) -> None:
        """Refuse content that would not decode to its size; ``is_part``: one chunk of a shard."""
        if array := self.array_of(name):
            (array.check_chunk if is_part else array.check_file)(content, whole)


class DraftFiles(LocalStore):
    """A store on disk that only this process knows yet, made on a disk without hard links too."""

    async def set_if_not_exists(self, key: str, value: Any) -> None:
        """Write a file unless there is one; Zarr's own way, by a link, is for several writers."""
        if not await self.exists(key):
            await self.set(key, value)


class CheckedFiles(LocalStore):
    """A store on disk, to be read: what is no plain file, or can't be right, raises."""

    def __init__(self, root: Path, files: StoreFiles) -> None:
        super().__init__(root, read_only=True)
        self._files = files

    def with_read_only(self, read_only: bool = False) -> CheckedFiles:
        """Return itself, which is for reading."""
        if not read_only:
            raise ValueError("the store is opened to be read")
        return self

    def read(self, key: str, byte_range: Any) -> bytes | None:
        """Return the bytes of a file, or of a part of one; None where there is none."""
        bytes_max = self._files.bytes_max(key)
        try:
            content = read_below(self.root, key, bytes_max, _slice(byte_range))
            if byte_range is None or isinstance(byte_range, RangeByteRequest):
                whole = f"{self.root}/{key}"
                self._files.check(key, content, whole, is_part=byte_range is not None)
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            return None
        except UnfitFileError as error:
            remedy = f"{error.strerror}: {suggestion('verify', self.root)} names what is damaged"
            raise UnfitFileError(error.errno, remedy, error.filename) from None
        return content

    async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
        """Return the bytes of a file, checked."""
        content = await asyncio.to_thread(self.read, key, byte_range)
        return _buffer(content, prototype)

    def get_sync(self, key: str, *, prototype: Any = None, byte_range: Any = None) -> Any:
        """As :meth:`get`, at once."""
        return _buffer(self.read(key, byte_range), prototype)

    async def get_partial_values(self, prototype: Any, key_ranges: Any) -> list[Any]:
        """Return parts of files, checked."""
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]


def _buffer(content: bytes | None, prototype: Any) -> Any:
    if content is None:
        return None
    return (prototype or default_buffer_prototype()).buffer.from_bytes(content)


def _slice(byte_range: Any) -> slice:
    """Part of a file that Zarr asks for."""
    match byte_range:
        case RangeByteRequest():
            return slice(byte_range.start, byte_range.end)
        case OffsetByteRequest():
            return slice(byte_range.offset, None)
        case SuffixByteRequest():
            return slice(-byte_range.suffix, None)
        case _:
            return slice(None)


class CheckedObjects(ObjectStore[Any]):
    """A store in an object store, to be read: objects that can't be right raise."""

    def __init__(self, client: Any, key: str, files: StoreFiles) -> None:
        super().__init__(client, read_only=True)
        self._key, self._files = key, files

    def with_read_only(self, read_only: bool = False) -> CheckedObjects:
        """Return itself, which is for reading."""
        if not read_only:
            raise ValueError("the store is opened to be read")
        return self

    async def get(self, key: str, prototype: Any, byte_range: Any = None) -> Any:
        """Return the bytes of an object, checked."""
        import obstore

        name = key.removeprefix(f"{self._key}/")
        bytes_max = self._files.bytes_max(name)
        if isinstance(byte_range, RangeByteRequest):
            refuse_larger(byte_range.end - byte_range.start, bytes_max, key)
        if byte_range is not None:
            buffer = await super().get(key, prototype, byte_range)
        else:
            try:
                response = await obstore.get_async(self.store, key)
            except FileNotFoundError:
                return None
            refuse_larger(response.meta["size"], bytes_max, key)
            buffer = prototype.buffer.from_bytes(await response.bytes_async())
        if buffer is not None and (byte_range is None or isinstance(byte_range, RangeByteRequest)):
            self._files.check(name, buffer.to_bytes(), key, is_part=byte_range is not None)
        return buffer
