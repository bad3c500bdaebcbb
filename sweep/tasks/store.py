"""A study's Zarr store: a template made whole at once, then whole chunks written block by block.

No two blocks share a chunk of any array, so writers need no locks between them; a chunk is either
there, whole, or absent. Only `.sweep/`, the journal, knows hosts and times: every other byte
follows from the study.
"""

from __future__ import annotations

import ctypes
import errno
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from sweep.storage import chunks, locations
from sweep.storage.atomic_replace import discard, draft
from sweep.storage.locations import JOURNAL, Location, each, located
from sweep.storage.objects import in_words
from sweep.storage.opening import LAYOUT, MANIFEST, open_group
from sweep.storage.sealing import digest, digest_of, sealed
from sweep.tasks import remote, versions
from sweep.tasks.errors import BusyError, StoreError
from sweep.tasks.recipe import write_recipe
from sweep.tasks.study import ArrayLayout, Content, Study

if TYPE_CHECKING:
    import zarr
    from zarr.core.array_spec import ArrayConfigLike

_libc = ctypes.CDLL(None, use_errno=True)

WRITTEN_WHOLE: ArrayConfigLike = {
    "write_empty_chunks": True
}  # else a chunk equal to the fill looks undone


def create(
    path: str | Location,
    study: Content,
    *,
    replace: bool = False,
    recipe: Mapping[str, Any] | None = None,
    durable: bool = False,
) -> Location:
    """A new store without results: every array's metadata, what is known beforehand, and the spec.

    It is built beside its place and renamed into it, so that a creation cut short leaves nothing
    that looks like a store; one in an object store is built here and sent, its root last.

    Parameters
    ----------
    path, study
        Its place, and what it is to hold.
    replace
        Whether it replaces what is there; never in an object store.
    recipe
        Facts for :mod:`sweep.tasks.recipe`.
    durable
        Whether all of it is to be on the disk before it is in its place.

    Raises
    ------
    StoreError
        Where something is in its place, or the place can't be written.
    """
    path = located(path)
    try:
        if isinstance(path, Path):
            with draft(path, replace=replace) as building:
                _build_new(building, study, recipe)
                if durable:
                    sync(building)
        else:
            with tempfile.TemporaryDirectory() as here:
                _build_new(Path(here) / path.name, study, recipe)
                remote.send(Path(here) / path.name, path)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST) and path.exists():
            raise BusyError(f"{path} is there already: another process has made it") from error
        raise StoreError(f"{path} can't be made: {error.strerror or error}") from error
    return path


def _build_new(path: Path, study: Content, recipe: Mapping[str, Any] | None) -> None:
    build(path, study, new_attributes(study))
    if recipe:
        write_recipe(path, **recipe)


def remove(path: Location) -> None:
    """Take a store away, out of its place in one step."""
    if isinstance(path, Path):
        discard(path)
    else:
        remote.remove(path)


def build(
    path: Path,
    study: Content,
    attributes: dict[str, Any],
    *,
    shards: Callable[[ArrayLayout], tuple[int, ...] | None] = lambda layout: None,
) -> None:
    """Make a store without results, in a place of its own.

    Parameters
    ----------
    path
        Where; nothing is there.
    study, attributes
        What it is to hold, and what its group is to say of it.
    shards
        Points that a file of an array holds, many chunks; by default a chunk is a file.
    """
    import zarr

    group = zarr.create_group(path, zarr_format=3, attributes=attributes)
    for name, own in study.groups().items():
        group.create_group(name, attributes=own)
    for layout in study.arrays():
        _add(group, layout, shards(layout))
    (path / JOURNAL).mkdir()
    _consolidate(path)
    _list(path, attributes)


def new_attributes(study: Content) -> dict[str, Any]:
    """What the group of a new store says of it: the study's own, and versions."""
    return study.attributes() | {
        "study_id": study.id,
        "model_version": versions.model(),
        "software": versions.software(),
        "processor": versions.processor(),
        "layout": LAYOUT,
    }


def _list(path: Path, attributes: dict[str, Any]) -> None:
    """Put down what the template is made of; the attributes, too, which all of it follows from."""
    objects = sorted(
        str(file.relative_to(path))
        for file in path.rglob("*")
        if file.is_file() and JOURNAL not in file.relative_to(path).parts
    )
    lines = [sealed({"attributes": attributes, "objects": len(objects)})]
    lines += [sealed({"object": name, "digest": digest(path, [name])}) for name in objects]
    (path / JOURNAL / MANIFEST).write_bytes(b"".join(lines))


def codecs() -> dict[str, Any]:
    """How chunks are encoded: packed, and with a checksum."""
    from zarr.codecs import Crc32cCodec, ZstdCodec

    return {"compressors": [ZstdCodec(level=chunks.ZSTD_LEVEL), Crc32cCodec()]}


def _add(group: zarr.Group, layout: ArrayLayout, shards: tuple[int, ...] | None) -> None:
    fill: dict[str, Any] = {} if layout.fill is None else {"fill_value": layout.fill}
    array = group.create_array(
        layout.name,
        shape=layout.shape,
        chunks=layout.chunks,
        shards=shards,
        dtype=layout.dtype,
        **fill,
        dimension_names=layout.dims,
        attributes=dict(layout.attributes),
        **codecs(),
    )
    if layout.values is not None:
        array[...] = layout.values


def _consolidate(path: Path) -> None:
    """Put the metadata of all arrays in the group's own, as Zarr's Python library lays it out.

    Written by hand because the library warns on doing it. It can't go stale: neither shapes nor
    attributes change after creation.
    """
    documents = {
        str(file.parent.relative_to(path)): json.loads(file.read_text())
        for file in sorted(path.rglob("zarr.json"))
        if file.parent != path
    }
    root = json.loads((path / "zarr.json").read_text())
    root["consolidated_metadata"] = {
        "kind": "inline",
        "must_understand": False,
        "metadata": documents,
    }
    (path / "zarr.json").write_text(json.dumps(root))  # not indented: ten times as fast


class Written(NamedTuple):
    """What is stored of a block."""

    digest: str  # of its bytes and their places, `digest`
    bytes: int


class Arrays:
    """Arrays of a store for writing blocks, opened when they are first written and kept open.

    Parameters
    ----------
    path
        The store.
    study
        The study that it holds.
    """

    def __init__(self, path: str | Location, study: Study) -> None:
        self.path = located(path)
        self._study = study
        self._arrays: dict[str, tuple[zarr.Array[Any], chunks.Chunked]] = {}

    def write(self, block: int, results: Mapping[str, np.ndarray]) -> Written:
        """Write the chunks of one block, each whole.

        Returns
        -------
        Written
            What is stored.

        Raises
        ------
        ValueError
            Where the results are not exactly the block's: a missing or unknown name, or a shape
            that would fill its chunks in part.
        """
        positions = self._study.chunks(block)
        if results.keys() != positions.keys():
            odd = sorted(results.keys() ^ positions.keys())
            raise ValueError(f"results don't match the block's arrays: {', '.join(odd)}")

        def put(name: str) -> tuple[str, bytes]:
            return self._put(name, positions[name], results[name])

        with in_words(self.path):
            stored = each(self.path, put, positions)
        return Written(digest_of(stored), sum(len(content) for _, content in stored))

    def _put(self, name: str, position: tuple[int, ...], values: np.ndarray) -> tuple[str, bytes]:
        """Write a chunk; its path inside the store, and the bytes that are there."""
        array, chunked = self._array(name)
        place = chunked.place(position)
        whole = tuple(s.stop - s.start for s in place)
        if values.shape != whole:
            raise ValueError(
                f"{name} has shape {values.shape} for its chunk {whole} at {position}: "
                "blocks write whole chunks only"
            )
        stored = chunk_object(name, position)
        if isinstance(self.path, Path) and chunked.is_plain:
            content = chunked.encoded(values)
            locations.put(f"{self.path}/{stored}", content)
        else:
            array[place or ...] = values
            content = (self.path / stored).read_bytes()
        return stored, content

    def _array(self, name: str) -> tuple[zarr.Array[Any], chunks.Chunked]:
        if name not in self._arrays:
            opened = cast("zarr.Array[Any]", self._group[name])
            self._arrays[name] = opened.with_config(WRITTEN_WHOLE), chunks.Chunked.of(opened)
        return self._arrays[name]

    @cached_property
    def _group(self) -> zarr.Group:
        """The store, its metadata read once for all arrays."""
        return open_group(self.path, mode="r+")


def block_objects(study: Study, block: int) -> list[str]:
    """Paths, inside the store, of the chunks of one block."""
    return [chunk_object(name, position) for name, position in study.chunks(block).items()]


def chunk_object(name: str, position: tuple[int, ...]) -> str:
    """Path, inside the store, of one chunk of an array."""
    return "/".join([name, "c", *map(str, position)])


def sync(path: Location) -> None:
    """Have everything written to a store so far on its disk, not only with the operating system.

    One call for the whole file system, which costs as much as syncing the files one by one costs
    for a few of them. What an object store has taken it keeps.

    Raises
    ------
    OSError
        Where the disk did not take it.
    """
    if not isinstance(path, Path):
        return
    place = os.open(path, os.O_RDONLY)
    try:
        if not hasattr(_libc, "syncfs"):  # not Linux
            os.sync()
        elif _libc.syncfs(place):
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(path))
    finally:
        os.close(place)


def remove_partials(path: Location) -> None:
    """Remove what writers that were killed in the midst of a file have left."""
    if isinstance(path, Path):
        for entry in _entries(str(path)):
            if entry.name.endswith(locations.PARTIAL):
                with suppress(FileNotFoundError):
                    os.unlink(entry.path)


def refuse_links(path: Location) -> None:
    """Refuse a store through whose links something would be written elsewhere.

    Raises
    ------
    StoreError
        With a link, or what else is neither a file nor a folder.
    """
    if isinstance(path, Path):
        for entry in _entries(str(path)):
            if not entry.is_file(follow_symlinks=False):
                raise StoreError(f"{entry.path} is no plain file: sweep made none such, remove it")


def _entries(folder: str) -> Iterator[os.DirEntry[str]]:
    """Everything below a folder but folders."""
    with os.scandir(folder) as entries:
        for entry in entries:  # no look at a file: there may be millions
            if entry.is_dir(follow_symlinks=False):
                yield from _entries(entry.path)
            else:
                yield entry


def is_seen(path: Location, objects: list[str], wanted: Written, *, read: bool) -> bool:
    """Tell whether a block that a worker has written is here, too: it is, but in another place.

    It is known by its size, or by its digest where it is `read`. An object store shows what is
    written, whole, to everyone at once: one object tells.
    """
    try:
        if read:
            return digest(path, objects) == wanted.digest
        if isinstance(path, Path):
            return sum(os.stat(f"{path}/{name}").st_size for name in objects) == wanted.bytes
    except (FileNotFoundError, NotADirectoryError):
        return False
    return (path / objects[-1]).size() > 0
