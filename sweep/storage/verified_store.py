"""Stores whose chunks are checked against their checksums and the journal when they are read.

For a missing chunk Zarr returns fill values, and for a damaged chunk it raises errors of its
codecs. These stores raise `DamagedChunkError` for both, which names block, chunk and remedy.
"""

from __future__ import annotations

import asyncio
import atexit
import math
import re
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import zarr
from zarr.core.buffer import default_buffer_prototype
from zarr.storage import StorePath, WrapperStore

from sweep.messages import STORE_PLACEHOLDER, suggested_call
from sweep.storage import store_format
from sweep.storage.locations import (
    JOURNAL_DIR,
    PACKED_ATTRIBUTE,
    Location,
    ObjectPath,
    to_object_store_error,
    translate_object_store_errors,
)
from sweep.storage.store_format import (
    MANIFEST_FILE,
    iter_log_records,
    read_receipt_totals,
    read_root_metadata,
)

#: Pattern of chunk names: the array, and the chunk's position in the grid of chunks.
CHUNK_NAME_PATTERN = re.compile(r"(.+)/c((?:/\d+)*)")

#: Dimensions along which the shots of a flight are divided into blocks; they vary fastest.
CYCLE_DIM, SHOT_DIM = "cycle", "shot"

#: Longest wait for the cancellation of pending reads when the program ends [s].
PENDING_READS_TIMEOUT_SECONDS = 5.0

_CHECKSUM_BYTES = 4
_SHARD_INDEX_ENTRY_BYTES = 16  # uint64 offset and length of a chunk in a shard
_EMPTY_SHARD_INDEX_ENTRY = 2**64 - 1


class DamagedChunkError(ValueError):
    """Error of a chunk that is missing, or has changed since it was written."""


def describe_chunk_damage(content: bytes) -> str:
    """Return what is wrong with a chunk, given as stored bytes, in words; '' if it is undamaged.

    The CRC32C checksum at the end of the chunk is checked.
    """
    if not content:
        return "is empty"
    checksum = google_crc32c.value(content[:-_CHECKSUM_BYTES]).to_bytes(_CHECKSUM_BYTES, "little")
    return "" if content[-_CHECKSUM_BYTES:] == checksum else "fails its checksum"


def describe_shard_damage(content: bytes, n_chunks: int) -> str:
    """Return what is wrong with a shard (a file of many chunks), in words; '' if it is undamaged.

    The checksums of its index and of its chunks are checked.
    """
    index_bytes = n_chunks * _SHARD_INDEX_ENTRY_BYTES + _CHECKSUM_BYTES
    if damage := describe_chunk_damage(content[-index_bytes:]):
        return damage
    index = np.frombuffer(content[-index_bytes:-_CHECKSUM_BYTES], "<u8").reshape(-1, 2)
    for offset, length in index[index[:, 0] != _EMPTY_SHARD_INDEX_ENTRY].tolist():
        if describe_chunk_damage(content[offset : offset + length]):
            return "fails a checksum"
    return ""


class ChunkBlockMap:
    """Map from the chunks of a store's arrays to the blocks that write them.

    The map follows from the root document. In each group of the store the blocks form a grid, as
    the chunks of its outputs do. If an array lacks a dimension of this grid, the blocks at position
    0 along that dimension write it.
    """

    def __init__(self, location: Location) -> None:
        root_metadata = read_root_metadata(location)
        attributes = root_metadata["attributes"]
        self.kind, self.is_packed = attributes["kind"], PACKED_ATTRIBUTE in attributes
        nodes = root_metadata["consolidated_metadata"]["metadata"]
        self._arrays = {name: node for name, node in nodes.items() if "data_type" in node}
        records = iter_log_records(location / JOURNAL_DIR / MANIFEST_FILE)
        self.template_objects = frozenset(record.get("object", "") for record in records)
        groups_by_kind = {"grid": [""], "eyepoints": [""], "scene": attributes.get("scanners", [])}
        self.n_blocks = 0
        self._block_grids: dict[str, tuple[int, dict[str, int]]] = {}
        for group in [] if self.is_packed else groups_by_kind.get(self.kind, []):
            chunks_by_dim = self._block_grid_shape(group)
            self._block_grids[group] = self.n_blocks, chunks_by_dim
            self.n_blocks += math.prod(chunks_by_dim.values())

    def _block_grid_shape(self, group: str) -> dict[str, int]:
        """Return the number of blocks of a group along each dimension that is cut into blocks."""
        chunks_by_dim: dict[str, int] = {}
        for name, node in self._arrays.items():
            if name.rpartition("/")[0] != group or self._is_in_template(name, node):
                continue
            array_chunks_by_dim = {dim: n for dim, n in _chunk_counts_by_dim(node).items() if n > 1}
            chunks_by_dim = (
                array_chunks_by_dim
                if len(array_chunks_by_dim) > len(chunks_by_dim)
                else chunks_by_dim
            )
        return dict(sorted(chunks_by_dim.items(), key=lambda item: item[0] == CYCLE_DIM))

    def _is_in_template(self, name: str, node: dict[str, Any]) -> bool:
        return "/".join([name, "c", *("0" for _ in node["shape"])]) in self.template_objects

    def block_of_chunk(self, chunk_name: str) -> int:
        """Return the number of the block that writes a chunk, or -1 if no block does."""
        name_match = CHUNK_NAME_PATTERN.fullmatch(chunk_name)
        node = self._arrays.get(name_match[1]) if name_match else None
        block_grid = self._block_grids.get(name_match[1].rpartition("/")[0]) if name_match else None
        if (
            not name_match
            or node is None
            or block_grid is None
            or chunk_name in self.template_objects
        ):
            return -1
        first_block, chunks_by_dim = block_grid
        position = dict(
            zip(_block_dim_names(node), map(int, name_match[2].split("/")[1:]), strict=True)
        )
        index = 0
        for dim, count in chunks_by_dim.items():
            index = index * count + position.get(dim, 0)
        return first_block + index

    def chunks_per_shard(self, chunk_name: str) -> int:
        """Return the number of chunks in the file of a chunk; 0 if files hold one chunk each."""
        name_match = CHUNK_NAME_PATTERN.fullmatch(chunk_name)
        node = self._arrays.get(name_match[1]) if name_match else None
        if node is None or node["codecs"][0]["name"] != "sharding_indexed":
            return 0
        file_shape = node["chunk_grid"]["configuration"]["chunk_shape"]
        chunk_shape = node["codecs"][0]["configuration"]["chunk_shape"]
        return math.prod(
            -(-file_length // chunk_length)
            for file_length, chunk_length in zip(file_shape, chunk_shape, strict=True)
        )


def _chunk_counts_by_dim(node: dict[str, Any]) -> dict[str, int]:
    """Return the number of chunks of an array along each dimension, by dimension name.

    The dimension `shot` is named `cycle`, as blocks divide both in the same way.
    """
    chunk_shape = node["chunk_grid"]["configuration"]["chunk_shape"]
    lengths_by_dim = zip(_block_dim_names(node), node["shape"], chunk_shape, strict=True)
    return {dim: -(-length // chunk_length) for dim, length, chunk_length in lengths_by_dim}


def _block_dim_names(node: dict[str, Any]) -> list[str]:
    """Return the dimension names of an array, with `cycle` in place of `shot`.

    Blocks divide both dimensions in the same way.
    """
    return [CYCLE_DIM if dim == SHOT_DIM else dim for dim in node.get("dimension_names", ())]


class VerifiedStore(WrapperStore[Any]):
    """Read-only Zarr store that checks each chunk before it is decoded."""

    def __init__(self, store: Any, location: Location, prefix: str = "") -> None:
        super().__init__(store)
        self._location, self._prefix = location, prefix

    def _with_store(self, store: Any) -> VerifiedStore:
        return type(self)(store, self._location, self._prefix)

    def with_read_only(self, read_only: bool = False) -> VerifiedStore:
        """Return the store itself; raise ValueError if a writable store is requested."""
        if not read_only:
            raise ValueError("the store is opened to be read")
        return self

    @cached_property
    def _block_map(self) -> ChunkBlockMap:
        return ChunkBlockMap(self._location)

    async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
        """Return the bytes of a file, or of a part of it, as a Zarr buffer; None if it is missing.

        DamagedChunkError is raised for a chunk that is damaged, or missing though it was written.
        """
        prototype = prototype or default_buffer_prototype()
        try:
            with translate_object_store_errors(self._location):
                return await self._get_verified(key, prototype, byte_range)
        except Exception:
            _event_loops_with_failed_reads.add(asyncio.get_running_loop())
            raise

    async def _get_verified(self, key: str, prototype: Any, byte_range: Any) -> Any:
        """Return the bytes of a file, or of a part of it, as a Zarr buffer; None if it is missing.

        Chunks are checked. A damaged chunk is read once more before DamagedChunkError is raised.
        """
        content = await self._fetch(key, prototype, byte_range)
        name = key.removeprefix(self._prefix).lstrip("/")
        if not CHUNK_NAME_PATTERN.fullmatch(name) or not (
            damage := self._describe_damage(name, content, byte_range)
        ):
            return content
        # Read again: the response may be truncated, or another process may be writing the chunk.
        complete_content = await self._fetch(key, prototype, None)
        if damage := self._describe_damage(name, complete_content, None):
            if isinstance(self._location, ObjectPath) and complete_content is not None:
                refuse_truncated_content = (self._location / name).refuse_truncated_content
                await asyncio.to_thread(refuse_truncated_content, complete_content.to_bytes())
            raise DamagedChunkError(self._damage_message(name, damage))
        return await self._fetch(key, prototype, byte_range)

    async def _fetch(self, key: str, prototype: Any, byte_range: Any) -> Any:
        """Return the bytes of a file, unchecked. Repeat the request if an object store failed."""
        try:
            return await self._store.get(key, prototype, byte_range)
        except Exception as error:
            if isinstance(self._location, Path) or to_object_store_error(error) is error:
                raise
            return await self._store.get(key, prototype, byte_range)

    async def get_partial_values(self, prototype: Any, key_ranges: Any) -> list[Any]:
        """Return the checked bytes of several parts of files, as Zarr buffers."""
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]

    def _describe_damage(self, name: str, content: Any, byte_range: Any) -> str:
        """Return the damage of a chunk in words; '' if it is undamaged or not yet computed.

        ``content`` holds the chunk's bytes, or is None if the chunk is missing.
        """
        if content is None:
            return "is missing" if self._should_chunk_exist(name) else ""
        if byte_range is None and (n_chunks := self._block_map.chunks_per_shard(name)):
            return describe_shard_damage(content.to_bytes(), n_chunks)
        return describe_chunk_damage(
            content.to_bytes()
        )  # a chunk, a chunk of a shard, or a shard index

    def _should_chunk_exist(self, name: str) -> bool:
        """Return True if a chunk must exist, as it was made with the store or its block is done."""
        block_map = self._block_map
        if block_map.is_packed or name in block_map.template_objects:
            return True
        if (block := block_map.block_of_chunk(name)) < 0 or block not in self._committed_blocks:
            return False
        self.__dict__.pop("_committed_blocks")  # read again: a receipt may have been withdrawn
        return block in self._committed_blocks

    @cached_property
    def _committed_blocks(self) -> frozenset[int]:
        """Numbers of the committed blocks, as last read from the journal."""
        points = read_receipt_totals(self._location, self._block_map.n_blocks).points_by_block
        return frozenset(np.flatnonzero(points).tolist())

    def _damage_message(self, name: str, damage: str) -> str:
        """Return the error message for a damaged chunk, with its block and the remedy."""
        block_map, location = self._block_map, self._location
        block = block_map.block_of_chunk(name)
        chunk_text = f"{location}: block {block}: {name}" if block >= 0 else f"{location}: {name}"
        if block_map.is_packed:
            verify_command = suggested_call("verify", location)
            remedy = f"{verify_command} names all that is damaged; copy the store anew"
        elif name in block_map.template_objects:
            remedy = f"{suggested_call('verify', location, repair=True)} puts it back"
        elif block_map.kind == "eyepoints":
            remedy = (
                f"{suggested_call('verify', STORE_PLACEHOLDER)} and "
                f"{suggested_call('resume', STORE_PLACEHOLDER)} of the study that uses them mend it"
            )
        else:
            remedy = (
                f"{suggested_call('verify', location)} marks what is damaged, "
                f"and {suggested_call('resume', location)} computes it again"
            )
        return f"{chunk_text} {damage}: {remedy}"


_event_loops_with_failed_reads: set[asyncio.AbstractEventLoop] = set()
"""Event loops of Zarr in which a read has failed.

Other reads may still be pending in these loops when Python exits.
"""


@atexit.register
def _cancel_pending_reads() -> None:
    """Cancel pending reads at exit; asyncio would print a traceback for each."""

    async def cancel_tasks() -> None:
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    for loop in _event_loops_with_failed_reads:
        with suppress(Exception):
            asyncio.run_coroutine_threadsafe(cancel_tasks(), loop).result(
                PENDING_READS_TIMEOUT_SECONDS
            )


def open_verified_store(location: Location, study_id: str) -> Any:
    """Return the store of a study as a read-only Zarr store, for xarray and Zarr.

    Chunks are checked when they are read.
    """
    return _wrap_in_verified_store(
        store_format.open_size_checked_store(location, study_id), location
    )


def open_verified_group(location: Location) -> zarr.Group:
    """Return a store as a Zarr group whose chunks are checked when they are read.

    NotAStoreError is raised if the root document differs from what this program writes.
    """
    store = _wrap_in_verified_store(store_format.open_size_checked_store(location), location)
    return zarr.open_group(store, mode="r", zarr_format=3, use_consolidated=True)


def _wrap_in_verified_store(store: Any, location: Location) -> Any:
    """Return a Zarr store, or a path in one, wrapped so that its chunks are checked when read."""
    if isinstance(location, Path):
        return VerifiedStore(store, location)
    return StorePath(VerifiedStore(store.store, location, location.key), location.key)
