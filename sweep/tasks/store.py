"""A study's Zarr store: a template made whole at once, then whole chunks written block by block.

No two blocks share a chunk, so writers need no locks between them. Only `.sweep/`, the journal,
knows hosts and times: every other byte follows from the study, and from the versions of the
software. All that a store held before there were results is listed there with digests.
"""

from __future__ import annotations

import ctypes
import errno
import json
import os
import platform
import shlex
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import google_crc32c
import numpy as np
import zarr
from numcodecs.zstd import Zstd
from zarr.codecs import Crc32cCodec, ZstdCodec

from sweep.messages import option, option_name, suggestion
from sweep.model import VERSION
from sweep.plain_files import UnfitFileError
from sweep.spec import SceneSpec, Spec, difference
from sweep.storage import locations, opening
from sweep.storage.chunks import DraftFiles, packed_bytes_max
from sweep.storage.foreign import foreign_names, is_litter
from sweep.storage.locations import (
    JOURNAL,
    Location,
    ObjectPath,
    ObjectStoreError,
    discard,
    draft,
    each,
    entries_below,
    files_below,
    in_words,
    located,
    names_below,
    put_whole,
    reason,
    settle,
    successor,
    write_remedy,
)
from sweep.storage.opening import (
    LAYOUT,
    MANIFEST,
    ZSTD_LEVEL,
    digest,
    digest_of,
    has_digest,
    read_lines,
    read_sealed,
    sealed,
    software_versions,
    versions_text,
)
from sweep.storage.sound import CHUNK
from sweep.tasks.journal import LOCK, LOGS, REPLACES, Lock, Receipt, read_recipe, write_recipe
from sweep.tasks.progress import BusyError, StoreError
from sweep.tasks.study import CONVENTIONS, ArrayLayout, Content, Study

ROOT = "zarr.json"

LIST = f"{JOURNAL}/{MANIFEST}"

#: Object that says that what lies at a place in an object store is a store half made or removed.
UNFINISHED = "partial"

#: Files of others that are named where they are in the way.
MOST_NAMED = 5

#: Chunks are packed, and with a checksum.
CODECS = [ZstdCodec(level=ZSTD_LEVEL), Crc32cCodec()]

_ZSTD = Zstd(level=ZSTD_LEVEL)

_libc = ctypes.CDLL(None, use_errno=True)


def create(
    path: str | Location,
    study: Content,
    *,
    replace: bool = False,
    recipe: Mapping[str, Any] | None = None,
    durable: bool = False,
) -> Location:
    """Make a new store without results: metadata, known arrays, and the spec.

    It is built in the same folder and renamed, so that a creation cut short leaves nothing that
    looks like a store; one in an object store is built here and sent, its root last. StoreError
    where something is in its place, or the place can't be written.
    """
    path = located(path)
    try:
        if isinstance(path, Path):
            with draft(path, replace=replace) as building:
                try:
                    _build_new(building, study, recipe)
                except OSError as error:  # told before the draft goes, and makes room
                    raise OSError(error.errno, reason(error, building), str(building)) from error
                if durable:
                    sync(building)
        else:
            with tempfile.TemporaryDirectory() as here:
                _build_new(Path(here) / path.name, study, recipe)
                _send(Path(here) / path.name, path)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST) and path.exists():
            raise BusyError(f"{path} is there already: another process has made it") from error
        remedy = write_remedy(error, path, f"name another place, {option_name('store')}")
        raise StoreError(f"{path} can't be made: {error.strerror or error}; {remedy}") from error
    return path


def _build_new(path: Path, study: Content, recipe: Mapping[str, Any] | None) -> None:
    build(path, study, new_attributes(study))
    if recipe:
        write_recipe(path, **recipe)


def _send(built: Path, path: ObjectPath) -> None:
    """Copy a store that was built on disk to its place in an object store, its root last."""
    names = files_below(built).keys() - {ROOT}
    with making(path):
        each(path, lambda name: (path / name).write_bytes((built / name).read_bytes()), names)
        (path / ROOT).write_bytes((built / ROOT).read_bytes())


@contextmanager
def making(path: ObjectPath) -> Iterator[None]:
    """Reserve a place while a store is made there, marked so; StoreError where it is taken."""
    mark = path / JOURNAL / UNFINISHED
    with Lock(path):
        if mark.exists():  # what a creation or removal cut short has left
            remove(path)
        elif found := [name for name, _ in path.below() if not name.startswith(f"{JOURNAL}/")]:
            raise StoreError(
                f"something else is at {path} ({found[0]}): name another {option_name('store')}"
            )
        mark.write_bytes(b"")
        yield
        mark.unlink()


def remove(path: Location) -> None:
    """Take a store away in one step; in an object store its root first: it is none then."""
    if isinstance(path, Path):
        discard(path)
        return
    mark = path / JOURNAL / UNFINISHED
    mark.write_bytes(b"")
    (path / ROOT).unlink()
    kept = {f"{JOURNAL}/{LOCK}", f"{JOURNAL}/{UNFINISHED}"}
    names = [name for name, _ in path.below() if name not in kept]
    each(path, lambda name: (path / name).unlink(), names)
    mark.unlink()


def build(
    path: Path,
    study: Content,
    attributes: dict[str, Any],
    *,
    shards: Callable[[ArrayLayout], tuple[int, ...] | None] = lambda layout: None,
) -> None:
    """Make a store without results; a file holds one chunk, or as many as `shards` has."""
    group = zarr.create_group(DraftFiles(path), zarr_format=3, attributes=attributes)
    for name, own in study.groups().items():
        group.create_group(name, attributes=own)
    for layout in study.arrays():
        _add(group, layout, shards(layout))
    _consolidate(path)
    list_objects(path, attributes, {name: digest(path, [name]) for name in names_below(path)})


def new_attributes(study: Content) -> dict[str, Any]:
    """Attributes of the group of a new store: the study's own, and versions."""
    return study.attributes() | {
        "Conventions": CONVENTIONS,
        "study_id": study.id,
        "model_version": VERSION,
        "software": versions_text(software()),
        "processor": processor(),
        "layout": LAYOUT,
    }


def list_objects(path: Location, attributes: dict[str, Any], digests: Mapping[str, str]) -> None:
    """Put down a store's attributes, and digests of what it is made of before results."""
    lines = [sealed({"attributes": attributes, "objects": len(digests)})]
    lines += [sealed({"object": name, "digest": found}) for name, found in sorted(digests.items())]
    put_whole(path / JOURNAL / MANIFEST, b"".join(lines))


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
        compressors=CODECS,
    )
    if layout.values is not None:
        array[...] = layout.values


def _consolidate(path: Path) -> None:
    """Put the metadata of all arrays in the group's own; Zarr's library warns on doing it."""
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


def encoded(layout: ArrayLayout, values: np.ndarray) -> bytes:
    """Bytes of a chunk of numbers, at the array's edge a part of one, as Zarr writes them.

    They are packed little-endian values in C order, and the crc32c of that. Zarr takes ten times as
    long, some 2 % of a second's work for a block of 26 arrays.
    """
    dtype = np.dtype(layout.dtype).newbyteorder("<")
    if values.shape == layout.chunks:
        chunk = np.ascontiguousarray(values, dtype).reshape(layout.chunks)
    else:
        chunk = np.full(layout.chunks, layout.fill, dtype)
        chunk[tuple(slice(size) for size in values.shape)] = values
    content: bytes = _ZSTD.encode(chunk)
    return content + google_crc32c.value(content).to_bytes(4, "little")


class Written(NamedTuple):
    """Digest and size of a block as stored."""

    digest: str  # of its bytes and their places, `digest`
    bytes: int


class Arrays:
    """Arrays of a study's store, for writing blocks."""

    def __init__(self, path: str | Location, study: Study) -> None:
        self.path, self.study = located(path), study

    def write(self, block: int, results: Mapping[str, np.ndarray]) -> Written:
        """Write the chunks of one block, each whole; ValueError where results are not its own."""
        positions = self.study.chunks(block)
        if results.keys() != positions.keys():
            odd = sorted(results.keys() ^ positions.keys())
            raise ValueError(f"results don't match the block's arrays: {', '.join(odd)}")

        def put(name: str) -> tuple[str, bytes]:
            """Write a chunk; its path inside the store, and its bytes."""
            layout, position, values = self.study.layouts[name], positions[name], results[name]
            whole = tuple(s.stop - s.start for s in layout.region(position))
            if values.shape != whole:
                raise ValueError(
                    f"{name} has shape {values.shape} for its chunk {whole} at {position}: "
                    "blocks write whole chunks only"
                )
            stored, content = chunk_object(name, position), encoded(layout, values)
            if isinstance(self.path, Path):
                locations.put(f"{self.path}/{stored}", content)
            else:
                (self.path / stored).write_bytes(content)
            return stored, content

        with in_words(self.path):
            stored = each(self.path, put, positions)
        return Written(digest_of(stored), sum(len(content) for _, content in stored))


def block_objects(study: Study, block: int) -> list[str]:
    """Paths, inside the store, of the chunks of one block."""
    return [chunk_object(name, position) for name, position in study.chunks(block).items()]


def chunk_bytes_max(study: Study) -> Callable[[str], int]:
    """Bytes that a chunk of a study can have at most, by its path inside the store."""

    def bytes_max(name: str) -> int:
        layout = study.layouts[array_of(name)]
        return packed_bytes_max(layout.bytes_of(layout.chunks))

    return bytes_max


def array_of(name: str) -> str:
    """Path, inside the store, of the array that an object is a chunk of; empty if of none.

    >>> array_of("tile/pd_up/c/0/3"), array_of("weight/c"), array_of("pd_up/zarr.json")
    ('tile/pd_up', 'weight', '')
    """
    found = CHUNK.fullmatch(name)
    return found[1] if found else ""


def chunk_object(name: str, position: tuple[int, ...]) -> str:
    """Path, inside the store, of one chunk of an array."""
    return "/".join([name, "c", *map(str, position)])


def sync(path: Location) -> None:
    """Have all that was written to a store on its disk; OSError where the disk did not take it.

    One call syncs the whole file system, which costs as much as a few files one by one.
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
    """Remove the remains of writers that were killed within a file."""
    if isinstance(path, Path):
        drafts = (e for e in entries_below(str(path)) if e.name.endswith(locations.PARTIAL))
        for entry in _without_foreign(path, drafts):
            with suppress(FileNotFoundError):
                os.unlink(entry.path)


def refuse_links(path: Location) -> None:
    """Refuse a store through whose links something would be written elsewhere.

    A link, or a pipe, in the place of a file is no harm: a new file is renamed into its place.
    """
    if isinstance(path, Path):
        links = (
            entry
            for entry in entries_below(str(path))
            if entry.is_symlink() and (entry.is_dir() or not os.path.exists(entry.path))
        )
        for entry in _without_foreign(path, links):
            raise StoreError(
                f"{entry.path} is a symbolic link, no folder: sweep made none such, remove it"
            )


def _without_foreign(path: Path, entries: Iterable[os.DirEntry[str]]) -> list[os.DirEntry[str]]:
    """Leave out entries, few of those below a store, that are files of others."""
    entries = list(entries)
    if not entries:
        return []  # so that a large store is walked through once
    foreign, start = foreign_names(path), len(str(path)) + 1
    folders = tuple(name for name in foreign if name.endswith("/"))
    return [
        entry
        for entry in entries
        if entry.path[start:] not in foreign and not entry.path[start:].startswith(folders)
    ]


class Damage(NamedTuple):
    """An object of a store that is not as it was written."""

    object: str  # path inside the store; a line of a log by its number
    what: str  # what is wrong with it
    block: int = -1  # that it belongs to
    mended_by: str = "resume"  # "repair" what was there before results, "hand" what is surplus


def digests(path: Location) -> dict[str, str]:
    """Digests of what a store was made of, by object, as far as its list is undamaged."""
    return {r["object"]: r["digest"] for r in read_lines(path / LIST) if "object" in r}


def damages(path: Location) -> list[Damage]:
    """Objects that a store was made of, and lines of their list, that are not as they were."""
    lines = [record for _, record in read_sealed(path / LIST)]
    if not lines:
        return [Damage(LIST, "is missing or empty", mended_by="repair")]
    found = [
        Damage(f"{LIST} line {n}", "is damaged", mended_by="repair")
        for n, each in enumerate(lines, 1)
        if each is None
    ]
    whole = [record for record in lines if record]
    if not found and whole[0].get("objects") != len(whole) - 1:
        found.append(Damage(LIST, "lacks lines", mended_by="repair"))
    return found + [
        Damage(name, what, mended_by="repair")
        for name, known in digests(path).items()
        if (what := altered(path, name, known))
    ]


def altered(path: Location, name: str, known: str) -> str:
    """Damage of an object of the template, whose digest is known."""
    return wrong_with(lambda: "" if has_digest(path, [name], known) else "is not as it was made")


def refuse_damaged(path: Location) -> None:
    """Refuse a store whose template is not as it was made: what is added might not fit it."""
    refuse_links(path)
    if found := damages(path):
        listed = "\n".join(f"  {damage.object} {damage.what}" for damage in found)
        raise StoreError(
            f"{path} is not as it was made:\n{listed}\n"
            f"{suggestion('verify', path, repair=True)} puts back what was there."
        )


def wrong_with(damage: Callable[[], str]) -> str:
    """Damage of an object in words, as a function says that reads it; empty if there is none.

    ObjectStoreError where an object store does not give it.
    """
    try:
        return damage()
    except (FileNotFoundError, NotADirectoryError):
        return "is missing"
    except UnfitFileError as error:
        return str(error.strerror)
    except ObjectStoreError:
        raise  # its service's fault, of which the object says nothing
    except OSError as error:
        return f"can't be read: {error.strerror}"


def is_seen(path: Location, study: Study, receipt: Receipt, read: bool) -> bool:
    """Tell whether a block that a worker has written is here: by size, or digest where `read`."""
    objects = block_objects(study, receipt.block)
    try:
        if read:
            return digest(path, objects, chunk_bytes_max(study)) == receipt.digest
        if isinstance(path, Path):
            return sum(os.lstat(f"{path}/{name}").st_size for name in objects) == receipt.bytes
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError, UnfitFileError):
        return False
    return (path / objects[-1]).size() > 0


#: Distributions whose version can change a result or how it is stored.
DISTRIBUTIONS = ("numba", "numpy", "scipy", "sweep", "zarr")


@cache
def software() -> dict[str, str]:
    """Versions of the software that a result depends on, by name."""
    return {name: version(name) for name in DISTRIBUTIONS}


@cache
def processor() -> str:
    """Machine, processor and vector instructions, by which numpy and LLVM choose their code."""
    import llvmlite.binding
    import numpy as np

    simd = np.show_config(mode="dicts").get("SIMD Extensions", {})  # type: ignore[call-overload]
    found = simd.get("found") or simd.get("baseline") or []
    name = llvmlite.binding.get_host_cpu_name()
    return f"{platform.machine()} {name} {' '.join(found)}".strip()


def refuse_foreign(path: Location) -> None:
    """Refuse what no version of this program has made; a damaged store of ours passes."""
    if not any(any(read_lines(path / JOURNAL / name)) for name in (MANIFEST, *LOGS)):
        opening.refuse_foreign(path)


def refuse_to_replace(path: Location) -> None:
    """Refuse to replace what no version of this program has made, or what can't be renamed."""
    if not isinstance(path, Path):
        raise StoreError(
            f"{path} can't be replaced or extended in its place, as an object store has no "
            f"renaming: name another place with {option_name('store')}; this one then stays"
        )
    refuse_foreign(path)


def refuse_foreign_files(path: Location) -> None:
    """Refuse to replace a store with files in its folder that are not sweep's."""
    if not isinstance(path, Path):
        return
    if names := [name for name in foreign_names(path) if not is_litter(name)]:
        listed = ", ".join(names[:MOST_NAMED]) + (", ..." if len(names) > MOST_NAMED else "")
        raise StoreError(
            f"{path} has files in it that are not sweep's ({listed}): move them elsewhere, as "
            f"{option('overwrite')} replaces the whole folder"
        )


def under_way(path: Location) -> Path | None:
    """Return the unfinished store that is to replace the one at a path; StoreError for another."""
    settle(path)
    if not isinstance(path, Path) or not (new := successor(path)).exists():
        return None
    if read_recipe(new).get(REPLACES) != opening.study_id(path):
        now = "holds another study now" if path.exists() else "is gone"
        raise StoreError(
            f"{new} was begun to take the place of a store at {path}, which {now}: "
            f"`rm -r {shlex.quote(str(new))}`, or have {option('overwrite')} begin anew"
        )
    return new


def refuse_other_study(
    path: Location, attributes: dict[str, Any], held: Spec | SceneSpec, asked: Spec | SceneSpec
) -> None:
    """Refuse a store that holds another study than the one asked for."""
    if attributes["study_id"] == asked.id:
        return
    refuse_other_versions(path, attributes, where="this machine")  # the version is in the id too
    lines = "\n".join(f"  {line}" for line in difference(held, asked))
    raise StoreError(
        f"{path} holds another study (in the store -> in the spec):\n{lines}\n"
        f"Name another {option_name('store')}, or replace this one with {option('overwrite')}."
    )


def refuse_other_versions(path: str | Location, attributes: dict[str, Any], *, where: str) -> None:
    """Refuse a store begun with another model or other software: the bits could differ."""
    recorded = {"model": attributes["model_version"], **software_versions(attributes)}
    here = {"model": VERSION, **software()}
    if recorded != here:
        listed = "\n".join(
            f"  {name}: {recorded.get(name, 'none')} in the store, {here.get(name, 'none')} here"
            for name in here | recorded
            if here.get(name) != recorded.get(name)
        )
        raise StoreError(
            f"{path} was begun with other versions than {where} has:\n{listed}\n"
            "Its results could not be told apart from new ones. Install those versions to resume "
            "it, or run the study anew into another store."
        )
