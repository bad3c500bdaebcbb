"""Arrays of stores, read with each chunk held against its checksum and the log of the journal.

Zarr reads fill values where a chunk is missing, and raises errors of its codecs where one is
damaged. Here both are a `DamagedChunkError`, which names the block, the chunk and the remedy.
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

from sweep.messages import STORE, suggestion
from sweep.storage import opening
from sweep.storage.locations import JOURNAL, PACKED, Location, ObjectPath, in_words, worded
from sweep.storage.opening import MANIFEST, read_document, read_lines, read_receipts

#: Name of a chunk: its array, and its position in the grid of chunks.
CHUNK = re.compile(r"(.+)/c((?:/\d+)*)")

#: Dimensions of flights by which their blocks are cut, last.
CYCLE, SHOT = "cycle", "shot"

#: Time that reads which nobody waits for have to end, as the program does [s].
READS_LEFT_SECONDS = 5.0

_CHECKSUM_BYTES = 4
_INDEX_BYTES = 16  # offset and length of a chunk in a shard
_NO_CHUNK = 2**64 - 1


class DamagedChunkError(ValueError):
    """A chunk of a store that is missing, or not as it was written."""


def chunk_damage(content: bytes) -> str:
    """Damage of a chunk in words, by the checksum that Zarr's codec put at its end."""
    if not content:
        return "is empty"
    checksum = google_crc32c.value(content[:-_CHECKSUM_BYTES]).to_bytes(_CHECKSUM_BYTES, "little")
    return "" if content[-_CHECKSUM_BYTES:] == checksum else "fails its checksum"


def shard_damage(content: bytes, chunks: int) -> str:
    """Damage of a file of several chunks in words, by the checksums of these and of their index."""
    index_bytes = chunks * _INDEX_BYTES + _CHECKSUM_BYTES
    if what := chunk_damage(content[-index_bytes:]):
        return what
    index = np.frombuffer(content[-index_bytes:-_CHECKSUM_BYTES], "<u8").reshape(-1, 2)
    for offset, length in index[index[:, 0] != _NO_CHUNK].tolist():
        if chunk_damage(content[offset : offset + length]):
            return "fails a checksum"
    return ""


class ChunkOwners:
    """Blocks that write the chunks of a store, by the document of its root.

    The chunks of the outputs of a group make a grid, of which each block has one position. An array
    that lacks a dimension of it is written by the blocks at its start.
    """

    def __init__(self, location: Location) -> None:
        document = read_document(location)
        attributes = document["attributes"]
        self.kind, self.is_packed = attributes["kind"], PACKED in attributes
        nodes = document["consolidated_metadata"]["metadata"]
        self._arrays = {name: node for name, node in nodes.items() if "data_type" in node}
        records = read_lines(location / JOURNAL / MANIFEST)
        self.template = frozenset(record.get("object", "") for record in records)
        groups = {"grid": [""], "eyepoints": [""], "scene": attributes.get("scanners", [])}
        self.n_blocks = 0
        self._grids: dict[str, tuple[int, dict[str, int]]] = {}
        for group in [] if self.is_packed else groups.get(self.kind, []):
            along = self._grid(group)
            self._grids[group] = self.n_blocks, along
            self.n_blocks += math.prod(along.values())

    def _grid(self, group: str) -> dict[str, int]:
        """Chunks along each dimension that is cut, of the outputs of a group, in their order."""
        largest: dict[str, int] = {}
        for name, node in self._arrays.items():
            if name.rpartition("/")[0] != group or self._is_template(name, node):
                continue
            cut = {dim: n for dim, n in _chunk_counts(node).items() if n > 1}
            largest = cut if len(cut) > len(largest) else largest
        return dict(sorted(largest.items(), key=lambda item: item[0] == CYCLE))

    def _is_template(self, name: str, node: dict[str, Any]) -> bool:
        return "/".join([name, "c", *("0" for _ in node["shape"])]) in self.template

    def block(self, chunk: str) -> int:
        """Block that writes a chunk; -1 where it is none's."""
        found = CHUNK.fullmatch(chunk)
        node = self._arrays.get(found[1]) if found else None
        grid = self._grids.get(found[1].rpartition("/")[0]) if found else None
        if not found or node is None or grid is None or chunk in self.template:
            return -1
        first, along = grid
        position = dict(zip(_dimensions(node), map(int, found[2].split("/")[1:]), strict=True))
        number = 0
        for dim, count in along.items():
            number = number * count + position.get(dim, 0)
        return first + number

    def chunks_of_shard(self, chunk: str) -> int:
        """Chunks that the file of a shard has room for; 0 where a file is one chunk."""
        found = CHUNK.fullmatch(chunk)
        node = self._arrays.get(found[1]) if found else None
        if node is None or node["codecs"][0]["name"] != "sharding_indexed":
            return 0
        file = node["chunk_grid"]["configuration"]["chunk_shape"]
        inner = node["codecs"][0]["configuration"]["chunk_shape"]
        return math.prod(-(-n // cut) for n, cut in zip(file, inner, strict=True))


def _chunk_counts(node: dict[str, Any]) -> dict[str, int]:
    """Chunks of an array along each dimension."""
    cuts = node["chunk_grid"]["configuration"]["chunk_shape"]
    sizes = zip(_dimensions(node), node["shape"], cuts, strict=True)
    return {dim: -(-size // cut) for dim, size, cut in sizes}


def _dimensions(node: dict[str, Any]) -> list[str]:
    """Dimensions of an array; that of the shots of cycles, which is cut as they are, is theirs."""
    return [CYCLE if dim == SHOT else dim for dim in node.get("dimension_names", ())]


class SoundStore(WrapperStore[Any]):
    """A store for reading, each of whose chunks is checked before it is decoded."""

    def __init__(self, store: Any, location: Location, prefix: str = "") -> None:
        super().__init__(store)
        self._location, self._prefix = location, prefix

    def _with_store(self, store: Any) -> SoundStore:
        return type(self)(store, self._location, self._prefix)

    def with_read_only(self, read_only: bool = False) -> SoundStore:
        """Return itself, which is for reading."""
        if not read_only:
            raise ValueError("the store is opened to be read")
        return self

    @cached_property
    def _owners(self) -> ChunkOwners:
        return ChunkOwners(self._location)

    async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
        """Return the bytes of a file, or of a part of it; DamagedChunkError for a damaged chunk."""
        prototype = prototype or default_buffer_prototype()
        try:
            with in_words(self._location):
                return await self._checked(key, prototype, byte_range)
        except Exception:
            _failed_loops.add(asyncio.get_running_loop())
            raise

    async def _checked(self, key: str, prototype: Any, byte_range: Any) -> Any:
        found = await self._fetch(key, prototype, byte_range)
        name = key.removeprefix(self._prefix).lstrip("/")
        if not CHUNK.fullmatch(name) or not (what := self._damage(name, found, byte_range)):
            return found
        # Once more: the body of an answer may be cut, and another process may just have written it.
        whole = await self._fetch(key, prototype, None)
        if what := self._damage(name, whole, None):
            if isinstance(self._location, ObjectPath) and whole is not None:
                await asyncio.to_thread((self._location / name).refuse_cut, whole.to_bytes())
            raise DamagedChunkError(self._described(name, what))
        return await self._fetch(key, prototype, byte_range)

    async def _fetch(self, key: str, prototype: Any, byte_range: Any) -> Any:
        """Return the bytes of a file, asked for twice where the body of the first answer is cut."""
        try:
            return await self._store.get(key, prototype, byte_range)
        except Exception as error:
            if isinstance(self._location, Path) or worded(error) is error:
                raise
            return await self._store.get(key, prototype, byte_range)

    async def get_partial_values(self, prototype: Any, key_ranges: Any) -> list[Any]:
        """Return parts of files, checked."""
        return [await self.get(key, prototype, byte_range) for key, byte_range in key_ranges]

    def _damage(self, name: str, content: Any, byte_range: Any) -> str:
        """Damage of a chunk in words; of one that is not computed yet none."""
        if content is None:
            return "is missing" if self._is_written(name) else ""
        if byte_range is None and (chunks := self._owners.chunks_of_shard(name)):
            return shard_damage(content.to_bytes(), chunks)
        return chunk_damage(content.to_bytes())  # of a chunk of a shard, or of its index

    def _is_written(self, name: str) -> bool:
        """Tell whether a chunk has to be there, by the log of what is committed."""
        owners = self._owners
        if owners.is_packed or name in owners.template:
            return True
        if (block := owners.block(name)) < 0 or block not in self._committed:
            return False
        self.__dict__.pop("_committed")  # a receipt may have been withdrawn since
        return block in self._committed

    @cached_property
    def _committed(self) -> frozenset[int]:
        """Blocks that were committed when the first missing chunk was asked for."""
        points = read_receipts(self._location, self._owners.n_blocks).points
        return frozenset(np.flatnonzero(points).tolist())

    def _described(self, name: str, what: str) -> str:
        owners, path = self._owners, self._location
        block = owners.block(name)
        place = f"{path}: block {block}: {name}" if block >= 0 else f"{path}: {name}"
        if owners.is_packed:
            remedy = f"{suggestion('verify', path)} names all that is damaged; copy the store anew"
        elif name in owners.template:
            remedy = f"{suggestion('verify', path, repair=True)} puts it back"
        elif owners.kind == "eyepoints":
            remedy = (
                f"{suggestion('verify', STORE)} and {suggestion('resume', STORE)} "
                "of the study that uses them mend it"
            )
        else:
            remedy = (
                f"{suggestion('verify', path)} marks what is damaged, "
                f"and {suggestion('resume', path)} computes it again"
            )
        return f"{place} {what}: {remedy}"


_failed_loops: set[asyncio.AbstractEventLoop] = set()
"""Loops of Zarr's in which a read has failed, and others may be left that nobody waits for."""


@atexit.register
def _cancel_reads() -> None:
    """Cancel the reads that are left, of which asyncio would print a traceback each."""

    async def cancel() -> None:
        tasks = asyncio.all_tasks() - {asyncio.current_task()}
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    for loop in _failed_loops:
        with suppress(Exception):
            asyncio.run_coroutine_threadsafe(cancel(), loop).result(READS_LEFT_SECONDS)


def readable(location: Location, held: str) -> Any:
    """Open the store of a study for Zarr and xarray, to read it lazily."""
    return _sound(opening.readable(location, held), location)


def open_arrays(location: Location) -> zarr.Group:
    """Open the arrays of a store to be read; raises as :func:`.opening.read_document`."""
    store = _sound(opening.readable(location), location)
    return zarr.open_group(store, mode="r", zarr_format=3, use_consolidated=True)


def _sound(store: Any, location: Location) -> Any:
    """Wrap a store of Zarr's, or a place in one."""
    if isinstance(location, Path):
        return SoundStore(store, location)
    return StorePath(SoundStore(store.store, location, location.key), location.key)
