"""Size checks of array files before Zarr decodes them.

A few kilobytes of zstd can decode to more bytes than any memory holds. The metadata of an array,
which are checked first, define the size of its chunks. A file that is larger than its chunks can be
is therefore refused unread. A chunk is refused if its zstd frame declares another size, or none.
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

from sweep.messages import suggested_call
from sweep.regular_files import RefusedFileError, check_file_size, read_file_below_root

#: Largest size of the metadata document of a group or an array [bytes].
METADATA_BYTES_MAX = 64 << 20

#: Largest size of a string on a text axis [bytes].
STRING_BYTES_MAX = 1 << 16

#: Largest size of an array file [bytes]: 2 GiB of values, and the overhead of compression.
ARRAY_FILE_BYTES_MAX = (1 << 31) + (1 << 25)

_CHECKSUM_BYTES = 4
_SHARD_INDEX_ENTRY_BYTES = 16  # uint64 offset and length of a chunk in a shard
_EMPTY_SHARD_INDEX_ENTRY = 2**64 - 1
_ZSTD_HEADER_BYTES_MAX = 18  # largest header of a zstd frame
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_ZSTD_CODEC = Zstd()


def compressed_bytes_max(raw_bytes: int) -> int:
    """Return the largest size of a chunk of ``raw_bytes`` after compression, with checksum [bytes].

    >>> compressed_bytes_max(1_000_000)
    1003974
    """
    return raw_bytes + (raw_bytes >> 8) + 64 + _CHECKSUM_BYTES


class ArrayFileLayout(NamedTuple):
    """Layout of an array in files: number of values per chunk, and of chunks per file."""

    values_per_chunk: int  # number of values in a chunk
    bytes_per_value: int  # size of a value [bytes]; 0 for strings
    chunks_per_shard: int  # number of chunks in a shard; 0 if a file is a single chunk

    @classmethod
    def from_metadata(cls, node: Mapping[str, Any]) -> ArrayFileLayout:
        """Return the layout of an array, given its metadata.

        The caller has checked the metadata.
        """
        file_shape = chunk_shape = node["chunk_grid"]["configuration"]["chunk_shape"]
        is_string = node["data_type"] == "string"
        codec, chunks_per_shard = node["codecs"][0], 0
        if codec["name"] == "sharding_indexed":
            chunk_shape = codec["configuration"]["chunk_shape"]
            chunks_per_shard = math.prod(
                -(-file_length // chunk_length)
                for file_length, chunk_length in zip(file_shape, chunk_shape, strict=True)
            )
        bytes_per_value = 0 if is_string else np.dtype(node["data_type"]).itemsize
        return cls(math.prod(chunk_shape), bytes_per_value, chunks_per_shard)

    @property
    def uncompressed_chunk_bytes_max(self) -> int:
        """Size of an uncompressed chunk [bytes]; the largest valid size if it holds strings."""
        if self.bytes_per_value:
            return self.values_per_chunk * self.bytes_per_value
        return 4 + self.values_per_chunk * (4 + STRING_BYTES_MAX)

    @property
    def file_bytes_max(self) -> int:
        """Largest valid size of a file of the array [bytes], as stored."""
        if not self.chunks_per_shard:
            return compressed_bytes_max(self.uncompressed_chunk_bytes_max)
        compressed_chunk_bytes = compressed_bytes_max(self.uncompressed_chunk_bytes_max)
        return (
            self.chunks_per_shard * (compressed_chunk_bytes + _SHARD_INDEX_ENTRY_BYTES)
            + _CHECKSUM_BYTES
        )

    def check_file_decoded_sizes(self, content: bytes, path_in_messages: str) -> None:
        """Raise RefusedFileError if a chunk of a file would not decode to its expected size."""
        for chunk in self._iter_chunks(content):
            self.check_chunk_decoded_size(chunk, path_in_messages)

    def _iter_chunks(self, content: bytes) -> Iterator[bytes]:
        """Yield the compressed chunks in a file of an array, given the content of the file.

        If the file is a shard (a file of many chunks), only the first bytes of a numeric chunk are
        yielded. They contain the chunk's zstd header.
        """
        if not self.chunks_per_shard:
            yield content
            return
        index_end = len(content) - _CHECKSUM_BYTES
        if index_end < self.chunks_per_shard * _SHARD_INDEX_ENTRY_BYTES:
            return  # too short for an index: Zarr raises an error
        index = np.frombuffer(
            content[index_end - self.chunks_per_shard * _SHARD_INDEX_ENTRY_BYTES : index_end], "<u8"
        ).reshape(-1, 2)
        for offset, length in index[index[:, 0] != _EMPTY_SHARD_INDEX_ENTRY].tolist():
            bytes_needed = min(length, _ZSTD_HEADER_BYTES_MAX) if self.bytes_per_value else length
            yield content[offset : offset + bytes_needed]

    def check_chunk_decoded_size(self, content: bytes, path_in_messages: str) -> None:
        """Raise RefusedFileError if a compressed chunk would not decode to its expected size.

        Content that is no zstd frame is not checked: the codecs refuse it.
        """
        if not content.startswith(_ZSTD_MAGIC):
            return
        content_bytes = declared_zstd_content_size(content)
        if content_bytes is None:
            raise RefusedFileError(
                errno.EINVAL, "has a chunk that does not declare its size", path_in_messages
            )
        if content_bytes > self.uncompressed_chunk_bytes_max or (
            self.bytes_per_value and content_bytes < self.uncompressed_chunk_bytes_max
        ):
            raise RefusedFileError(
                errno.EINVAL,
                f"has a chunk that declares {content_bytes:,} bytes, where "
                f"{self.uncompressed_chunk_bytes_max:,} "
                f"are {'right' if self.bytes_per_value else 'the most'}",
                path_in_messages,
            )
        if not self.bytes_per_value:
            self._check_string_count(content, path_in_messages)

    def _check_string_count(self, content: bytes, path_in_messages: str) -> None:
        """Raise RefusedFileError if a chunk of strings declares a wrong number of strings.

        The decoder would allocate memory for the declared number.
        """
        try:
            decoded = bytes(_ZSTD_CODEC.decode(content[:-_CHECKSUM_BYTES]))
        except RuntimeError:
            return  # damaged: the codecs raise an error
        if int.from_bytes(decoded[:4], "little") != self.values_per_chunk:
            raise RefusedFileError(
                errno.EINVAL, "has another number of words than its array", path_in_messages
            )


def declared_zstd_content_size(frame: bytes) -> int | None:
    """Return the content size that a zstd frame declares [bytes], or None if it declares none.

    RFC 8878, section 3.1.1.1, defines the header.

    >>> declared_zstd_content_size(bytes(Zstd().encode(b"x" * 1000)))
    1000
    """
    if len(frame) < 5:
        return None
    descriptor = frame[4]
    is_single_segment = bool(descriptor & 0b0010_0000)
    size_field_bytes = (int(is_single_segment), 2, 4, 8)[descriptor >> 6]
    size_field_start = 5 + (not is_single_segment) + (0, 1, 2, 4)[descriptor & 0b11]
    if not size_field_bytes or len(frame) < size_field_start + size_field_bytes:
        return None
    content_bytes = int.from_bytes(
        frame[size_field_start : size_field_start + size_field_bytes], "little"
    )
    return content_bytes + 256 if size_field_bytes == 2 else content_bytes


class StoreFileSizeLimits:
    """File names of a store and their largest sizes, derived from its checked root document."""

    def __init__(self, root_metadata: Mapping[str, Any]) -> None:
        nodes = root_metadata["consolidated_metadata"]["metadata"]
        self._layouts = {
            array_name: ArrayFileLayout.from_metadata(node)
            for array_name, node in nodes.items()
            if "data_type" in node
        }

    def array_layout(self, file_name: str) -> ArrayFileLayout | None:
        """Return the layout of the array of which a file, given by name, is a part.

        The result is None for a metadata document.
        """
        return self._layouts.get(file_name.rpartition("/c/")[0] or file_name.removesuffix("/c"))

    def file_bytes_max(self, file_name: str) -> int:
        """Return the largest valid size of a file of the store [bytes], given its name."""
        layout = self.array_layout(file_name)
        return METADATA_BYTES_MAX if layout is None else layout.file_bytes_max

    def check_decoded_size(
        self, file_name: str, content: bytes, path_in_messages: str, *, is_single_chunk: bool
    ) -> None:
        """Raise RefusedFileError if the content of a file would not decode to its expected size.

        ``is_single_chunk`` is True if the content is one chunk of a shard, and not that of a file.
        """
        if layout := self.array_layout(file_name):
            (
                layout.check_chunk_decoded_size
                if is_single_chunk
                else layout.check_file_decoded_sizes
            )(content, path_in_messages)


class SingleWriterLocalStore(LocalStore):
    """Local Zarr store that only this process writes. Its disk need not have hard links."""

    async def set_if_not_exists(self, key: str, value: Any) -> None:
        """Write a file unless it exists. Zarr's own method would need hard links."""
        if not await self.exists(key):
            await self.set(key, value)


class SizeCheckedLocalStore(LocalStore):
    """Read-only store on disk whose reads fail for irregular files and files of a wrong size."""

    def __init__(self, root: Path, limits: StoreFileSizeLimits) -> None:
        super().__init__(root, read_only=True)
        self._limits = limits

    def with_read_only(self, read_only: bool = False) -> SizeCheckedLocalStore:
        """Return the store itself; raise ValueError if a writable store is requested."""
        if not read_only:
            raise ValueError("the store is opened to be read")
        return self

    def read(self, key: str, byte_range: Any) -> bytes | None:
        """Return the bytes of a file, or of a part of it; None if the file does not exist.

        RefusedFileError is raised for an irregular file, or a file of a wrong size.
        """
        bytes_max = self._limits.file_bytes_max(key)
        try:
            content = read_file_below_root(
                self.root, key, bytes_max, _byte_range_to_slice(byte_range)
            )
            if byte_range is None or isinstance(byte_range, RangeByteRequest):
                path_in_messages = f"{self.root}/{key}"
                self._limits.check_decoded_size(
                    key, content, path_in_messages, is_single_chunk=byte_range is not None
                )
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            return None
        except RefusedFileError as error:
            problem_and_remedy = (
                f"{error.strerror}: {suggested_call('verify', self.root)} names what is damaged"
            )
            raise RefusedFileError(error.errno, problem_and_remedy, error.filename) from None
        return content

    async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
        """Return the checked bytes of a file as a Zarr buffer; None if the file does not exist."""
        content = await asyncio.to_thread(self.read, key, byte_range)
        return _to_zarr_buffer(content, prototype)

    def get_sync(self, key: str, *, prototype: Any = None, byte_range: Any = None) -> Any:
        """Return the checked bytes of a file as a Zarr buffer; None if it does not exist."""
        return _to_zarr_buffer(self.read(key, byte_range), prototype)

    async def get_partial_values(self, prototype: Any, key_ranges: Any) -> list[Any]:
        """Return the checked bytes of several parts of files, as Zarr buffers."""
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]


def _to_zarr_buffer(content: bytes | None, prototype: Any) -> Any:
    if content is None:
        return None
    return (prototype or default_buffer_prototype()).buffer.from_bytes(content)


def _byte_range_to_slice(byte_range: Any) -> slice:
    """Return a byte range of Zarr as a slice. None stands for all bytes."""
    match byte_range:
        case RangeByteRequest():
            return slice(byte_range.start, byte_range.end)
        case OffsetByteRequest():
            return slice(byte_range.offset, None)
        case SuffixByteRequest():
            return slice(-byte_range.suffix, None)
        case _:
            return slice(None)


class SizeCheckedObjectStore(ObjectStore[Any]):
    """Read-only store in an object store whose reads fail for objects of a wrong size."""

    def __init__(self, client: Any, key_prefix: str, limits: StoreFileSizeLimits) -> None:
        super().__init__(client, read_only=True)
        self._key_prefix, self._limits = key_prefix, limits

    def with_read_only(self, read_only: bool = False) -> SizeCheckedObjectStore:
        """Return the store itself; raise ValueError if a writable store is requested."""
        if not read_only:
            raise ValueError("the store is opened to be read")
        return self

    async def get(self, key: str, prototype: Any, byte_range: Any = None) -> Any:
        """Return the checked bytes of an object as a Zarr buffer; None if it does not exist."""
        import obstore

        file_name = key.removeprefix(f"{self._key_prefix}/")
        bytes_max = self._limits.file_bytes_max(file_name)
        if isinstance(byte_range, RangeByteRequest):
            check_file_size(byte_range.end - byte_range.start, bytes_max, key)
        if byte_range is not None:
            buffer = await super().get(key, prototype, byte_range)
        else:
            try:
                response = await obstore.get_async(self.store, key)
            except FileNotFoundError:
                return None
            check_file_size(response.meta["size"], bytes_max, key)
            buffer = prototype.buffer.from_bytes(await response.bytes_async())
        if buffer is not None and (byte_range is None or isinstance(byte_range, RangeByteRequest)):
            self._limits.check_decoded_size(
                file_name, buffer.to_bytes(), key, is_single_chunk=byte_range is not None
            )
        return buffer
