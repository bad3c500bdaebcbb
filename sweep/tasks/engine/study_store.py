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

from sweep.messages import option_name, option_text, suggestion
from sweep.model import VERSION
from sweep.regular_files import RefusedFileError
from sweep.spec import GridSpec, SceneSpec, describe_differences
from sweep.storage import locations, store_format
from sweep.storage.foreign_files import is_litter, list_foreign_files
from sweep.storage.locations import (
    JOURNAL_DIR,
    Location,
    ObjectPath,
    ObjectStoreError,
    atomic_path,
    atomic_write,
    file_sizes_below,
    iter_entries_below,
    iter_names_below,
    map_concurrently,
    os_error_reason,
    parse_location,
    recover_interrupted_replace,
    remove_atomically,
    staging_path_for,
    translate_errors,
    write_remedy,
)
from sweep.storage.size_checks import SingleWriterLocalStore, compressed_bytes_max
from sweep.storage.store_format import (
    LAYOUT_VERSION,
    MANIFEST_FILE,
    ZSTD_LEVEL,
    contents_digest,
    encode_record,
    format_versions,
    has_digest,
    iter_lines_and_records,
    iter_records,
    parse_software_versions,
    stored_objects_digest,
)
from sweep.storage.verified_store import CHUNK_NAME
from sweep.tasks.engine.blocks import CF_CONVENTIONS, ArrayLayout, BlockStudy, StoreTemplate
from sweep.tasks.engine.journal import (
    LOCK_FILE,
    LOG_NAMES,
    REPLACES_KEY,
    Receipt,
    StoreLock,
    read_recipe,
    write_recipe,
)
from sweep.tasks.engine.progress import BusyError, StoreError

ROOT_DOCUMENT = "zarr.json"

MANIFEST_PATH = f"{JOURNAL_DIR}/{MANIFEST_FILE}"

#: Object that says that what lies at a place in an object store is a store half made or removed.
UNFINISHED_MARKER = "partial"

#: Files of others that are named where they are in the way.
FOREIGN_FILES_NAMED_MAX = 5

#: Chunks are packed, and with a checksum.
CODECS = [ZstdCodec(level=ZSTD_LEVEL), Crc32cCodec()]

_ZSTD = Zstd(level=ZSTD_LEVEL)

_libc = ctypes.CDLL(None, use_errno=True)


def create_store(
    store_path: str | Location,
    template: StoreTemplate,
    *,
    replace_existing: bool = False,
    recipe: Mapping[str, Any] | None = None,
    durable: bool = False,
) -> Location:
    """Make a new store without results: metadata, known arrays, and the spec.

    It is built in the same folder and renamed, so that a creation cut short leaves nothing that
    looks like a store; one in an object store is built here and sent, its root last. StoreError
    where something is in its place, or the place can't be written.
    """
    store_path = parse_location(store_path)
    try:
        if isinstance(store_path, Path):
            with atomic_path(store_path, replace=replace_existing) as draft_path:
                try:
                    _build_store(draft_path, template, recipe)
                except OSError as error:  # told before the draft goes, and makes room
                    raise OSError(
                        error.errno, os_error_reason(error, draft_path), str(draft_path)
                    ) from error
                if durable:
                    sync_to_disk(draft_path)
        else:
            with tempfile.TemporaryDirectory() as temporary_folder:
                _build_store(Path(temporary_folder) / store_path.name, template, recipe)
                _upload_store(Path(temporary_folder) / store_path.name, store_path)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST) and store_path.exists():
            raise BusyError(
                f"{store_path} is there already: another process has made it"
            ) from error
        remedy = write_remedy(error, store_path, f"name another place, {option_name('store')}")
        raise StoreError(
            f"{store_path} can't be made: {error.strerror or error}; {remedy}"
        ) from error
    return store_path


def _build_store(
    store_path: Path, template: StoreTemplate, recipe: Mapping[str, Any] | None
) -> None:
    build_template(store_path, template, template_attributes(template))
    if recipe:
        write_recipe(store_path, **recipe)


def _upload_store(local_path: Path, store_path: ObjectPath) -> None:
    """Copy a store that was built on disk to its place in an object store, its root last."""
    names = file_sizes_below(local_path).keys() - {ROOT_DOCUMENT}
    with reserve_object_location(store_path):
        map_concurrently(
            store_path,
            lambda name: (store_path / name).write_bytes((local_path / name).read_bytes()),
            names,
        )
        (store_path / ROOT_DOCUMENT).write_bytes((local_path / ROOT_DOCUMENT).read_bytes())


@contextmanager
def reserve_object_location(store_path: ObjectPath) -> Iterator[None]:
    """Reserve a place while a store is made there, marked so; StoreError where it is taken."""
    marker = store_path / JOURNAL_DIR / UNFINISHED_MARKER
    with StoreLock(store_path):
        if marker.exists():  # what a creation or removal cut short has left
            remove_store(store_path)
        elif foreign := [
            name
            for name, _ in store_path.iter_objects_below()
            if not name.startswith(f"{JOURNAL_DIR}/")
        ]:
            raise StoreError(
                f"something else is at {store_path} ({foreign[0]}): name another "
                f"{option_name('store')}"
            )
        marker.write_bytes(b"")
        yield
        marker.unlink()


def remove_store(store_path: Location) -> None:
    """Take a store away in one step; in an object store its root first: it is none then."""
    if isinstance(store_path, Path):
        remove_atomically(store_path)
        return
    marker = store_path / JOURNAL_DIR / UNFINISHED_MARKER
    marker.write_bytes(b"")
    (store_path / ROOT_DOCUMENT).unlink()
    kept_names = {f"{JOURNAL_DIR}/{LOCK_FILE}", f"{JOURNAL_DIR}/{UNFINISHED_MARKER}"}
    object_names = [name for name, _ in store_path.iter_objects_below() if name not in kept_names]
    map_concurrently(store_path, lambda name: (store_path / name).unlink(), object_names)
    marker.unlink()


def build_template(
    store_path: Path,
    template: StoreTemplate,
    attributes: dict[str, Any],
    *,
    shard_shape_of: Callable[[ArrayLayout], tuple[int, ...] | None] = lambda layout: None,
) -> None:
    """Make a store without results; a file holds one chunk, or as many as `shards` has."""
    group = zarr.create_group(
        SingleWriterLocalStore(store_path), zarr_format=3, attributes=attributes
    )
    for name, group_attributes in template.group_attributes().items():
        group.create_group(name, attributes=group_attributes)
    for layout in template.array_layouts():
        _create_array(group, layout, shard_shape_of(layout))
    _consolidate_metadata(store_path)
    write_manifest(
        store_path,
        attributes,
        {name: stored_objects_digest(store_path, [name]) for name in iter_names_below(store_path)},
    )


def template_attributes(template: StoreTemplate) -> dict[str, Any]:
    """Attributes of the group of a new store: the study's own, and versions."""
    return template.store_attributes() | {
        "Conventions": CF_CONVENTIONS,
        "study_id": template.id,
        "model_version": VERSION,
        "software": format_versions(current_versions()),
        "processor": processor_text(),
        "layout": LAYOUT_VERSION,
    }


def write_manifest(
    store_path: Location, attributes: dict[str, Any], digests: Mapping[str, str]
) -> None:
    """Put down a store's attributes, and digests of what it is made of before results."""
    records = [encode_record({"attributes": attributes, "objects": len(digests)})]
    records += [
        encode_record({"object": name, "digest": object_digest})
        for name, object_digest in sorted(digests.items())
    ]
    atomic_write(store_path / JOURNAL_DIR / MANIFEST_FILE, b"".join(records))


def _create_array(
    group: zarr.Group, layout: ArrayLayout, shard_shape: tuple[int, ...] | None
) -> None:
    fill_option: dict[str, Any] = (
        {} if layout.fill_value is None else {"fill_value": layout.fill_value}
    )
    array = group.create_array(
        layout.name,
        shape=layout.shape,
        chunks=layout.chunks,
        shards=shard_shape,
        dtype=layout.dtype,
        **fill_option,
        dimension_names=layout.dims,
        attributes=dict(layout.attributes),
        compressors=CODECS,
    )
    if layout.values is not None:
        array[...] = layout.values


def _consolidate_metadata(store_path: Path) -> None:
    """Put the metadata of all arrays in the group's own; Zarr's library warns on doing it."""
    documents = {
        str(file.parent.relative_to(store_path)): json.loads(file.read_text())
        for file in sorted(store_path.rglob("zarr.json"))
        if file.parent != store_path
    }
    root_document = json.loads((store_path / "zarr.json").read_text())
    root_document["consolidated_metadata"] = {
        "kind": "inline",
        "must_understand": False,
        "metadata": documents,
    }
    (store_path / "zarr.json").write_text(
        json.dumps(root_document)
    )  # not indented: ten times as fast


def encode_chunk(layout: ArrayLayout, values: np.ndarray) -> bytes:
    """Bytes of a chunk of numbers, at the array's edge a part of one, as Zarr writes them.

    They are packed little-endian values in C order, and the crc32c of that. Zarr takes ten times as
    long, some 2 % of a second's work for a block of 26 arrays.
    """
    dtype = np.dtype(layout.dtype).newbyteorder("<")
    if values.shape == layout.chunks:
        chunk = np.ascontiguousarray(values, dtype).reshape(layout.chunks)
    else:
        chunk = np.full(layout.chunks, layout.fill_value, dtype)
        chunk[tuple(slice(length) for length in values.shape)] = values
    content: bytes = _ZSTD.encode(chunk)
    return content + google_crc32c.value(content).to_bytes(4, "little")


class StoredBlock(NamedTuple):
    """Digest and size of a block as stored."""

    digest: str  # of its bytes and their places, `digest`
    n_bytes: int


class BlockWriter:
    """Arrays of a study's store, for writing blocks."""

    def __init__(self, store_path: str | Location, study: BlockStudy) -> None:
        self.store_path, self.study = parse_location(store_path), study

    def write(self, block: int, results: Mapping[str, np.ndarray]) -> StoredBlock:
        """Write the chunks of one block, each whole; ValueError where results are not its own."""
        positions = self.study.chunk_positions(block)
        if results.keys() != positions.keys():
            mismatched_names = sorted(results.keys() ^ positions.keys())
            raise ValueError(
                f"results don't match the block's arrays: {', '.join(mismatched_names)}"
            )

        def write_chunk(array_name: str) -> tuple[str, bytes]:
            """Write a chunk; its path inside the store, and its bytes."""
            layout, position, values = (
                self.study.layout_by_name[array_name],
                positions[array_name],
                results[array_name],
            )
            region_shape = tuple(s.stop - s.start for s in layout.region(position))
            if values.shape != region_shape:
                raise ValueError(
                    f"{array_name} has shape {values.shape} for its chunk {region_shape} at "
                    f"{position}: "
                    "blocks write whole chunks only"
                )
            chunk_path, content = chunk_name(array_name, position), encode_chunk(layout, values)
            if isinstance(self.store_path, Path):
                locations.atomic_write_file(f"{self.store_path}/{chunk_path}", content)
            else:
                (self.store_path / chunk_path).write_bytes(content)
            return chunk_path, content

        with translate_errors(self.store_path):
            chunk_contents = map_concurrently(self.store_path, write_chunk, positions)
        return StoredBlock(
            contents_digest(chunk_contents), sum(len(content) for _, content in chunk_contents)
        )


def chunk_names_of_block(study: BlockStudy, block: int) -> list[str]:
    """Paths, inside the store, of the chunks of one block."""
    return [
        chunk_name(array_name, position)
        for array_name, position in study.chunk_positions(block).items()
    ]


def chunk_size_limits(study: BlockStudy) -> Callable[[str], int]:
    """Bytes that a chunk of a study can have at most, by its path inside the store."""

    def size_limit(chunk_path: str) -> int:
        layout = study.layout_by_name[array_of_chunk(chunk_path)]
        return compressed_bytes_max(layout.nbytes_of(layout.chunks))

    return size_limit


def array_of_chunk(chunk_path: str) -> str:
    """Path, inside the store, of the array that an object is a chunk of; empty if of none.

    >>> [array_of_chunk(name) for name in ("tile/pd_up/c/0/3", "weight/c", "pd_up/zarr.json")]
    ['tile/pd_up', 'weight', '']
    """
    match = CHUNK_NAME.fullmatch(chunk_path)
    return match[1] if match else ""


def chunk_name(array_name: str, position: tuple[int, ...]) -> str:
    """Path, inside the store, of one chunk of an array."""
    return "/".join([array_name, "c", *map(str, position)])


def sync_to_disk(store_path: Location) -> None:
    """Have all that was written to a store on its disk; OSError where the disk did not take it.

    One call syncs the whole file system, which costs as much as a few files one by one.
    """
    if not isinstance(store_path, Path):
        return
    descriptor = os.open(store_path, os.O_RDONLY)
    try:
        if not hasattr(_libc, "syncfs"):  # not Linux
            os.sync()
        elif _libc.syncfs(descriptor):
            error_number = ctypes.get_errno()
            raise OSError(error_number, os.strerror(error_number), str(store_path))
    finally:
        os.close(descriptor)


def remove_partial_files(store_path: Location) -> None:
    """Remove the remains of writers that were killed within a file."""
    if isinstance(store_path, Path):
        partial_files = (
            candidate
            for candidate in iter_entries_below(str(store_path))
            if candidate.name.endswith(locations.DRAFT_SUFFIX)
        )
        for entry in _exclude_foreign(store_path, partial_files):
            with suppress(FileNotFoundError):
                os.unlink(entry.path)


def refuse_links(store_path: Location) -> None:
    """Refuse a store through whose links something would be written elsewhere.

    A link, or a pipe, in the place of a file is no harm: a new file is renamed into its place.
    """
    if isinstance(store_path, Path):
        links = (
            entry
            for entry in iter_entries_below(str(store_path))
            if entry.is_symlink() and (entry.is_dir() or not os.path.exists(entry.path))
        )
        for entry in _exclude_foreign(store_path, links):
            raise StoreError(
                f"{entry.path} is a symbolic link, no folder: sweep made none such, remove it"
            )


def _exclude_foreign(
    store_path: Path, entries: Iterable[os.DirEntry[str]]
) -> list[os.DirEntry[str]]:
    """Leave out entries, few of those below a store, that are files of others."""
    entries = list(entries)
    if not entries:
        return []  # so that a large store is walked through once
    foreign_paths, prefix_length = list_foreign_files(store_path), len(str(store_path)) + 1
    folders = tuple(name for name in foreign_paths if name.endswith("/"))
    return [
        entry
        for entry in entries
        if entry.path[prefix_length:] not in foreign_paths
        and not entry.path[prefix_length:].startswith(folders)
    ]


class Damage(NamedTuple):
    """An object of a store that is not as it was written."""

    object: str  # path inside the store; a line of a log by its number
    what: str  # what is wrong with it
    block: int = -1  # that it belongs to
    mended_by: str = "resume"  # "repair" what was there before results, "hand" what is surplus


def manifest_digests(store_path: Location) -> dict[str, str]:
    """Digests of what a store was made of, by object, as far as its list is undamaged."""
    return {
        record["object"]: record["digest"]
        for record in iter_records(store_path / MANIFEST_PATH)
        if "object" in record
    }


def template_damages(store_path: Location) -> list[Damage]:
    """Objects that a store was made of, and lines of their list, that are not as they were."""
    records = [record for _, record in iter_lines_and_records(store_path / MANIFEST_PATH)]
    if not records:
        return [Damage(MANIFEST_PATH, "is missing or empty", mended_by="repair")]
    problems = [
        Damage(f"{MANIFEST_PATH} line {line_number}", "is damaged", mended_by="repair")
        for line_number, record_or_none in enumerate(records, 1)
        if record_or_none is None
    ]
    undamaged = [record for record in records if record]
    if not problems and undamaged[0].get("objects") != len(undamaged) - 1:
        problems.append(Damage(MANIFEST_PATH, "lacks lines", mended_by="repair"))
    return problems + [
        Damage(name, problem, mended_by="repair")
        for name, expected_digest in manifest_digests(store_path).items()
        if (problem := template_object_damage(store_path, name, expected_digest))
    ]


def template_object_damage(store_path: Location, object_name: str, expected_digest: str) -> str:
    """Damage of an object of the template, whose digest is known."""
    return damage_or_read_error(
        lambda: (
            ""
            if has_digest(store_path, [object_name], expected_digest)
            else "is not as it was made"
        )
    )


def refuse_damaged_template(store_path: Location) -> None:
    """Refuse a store whose template is not as it was made: what is added might not fit it."""
    refuse_links(store_path)
    if problems := template_damages(store_path):
        problem_lines = "\n".join(f"  {damage.object} {damage.what}" for damage in problems)
        raise StoreError(
            f"{store_path} is not as it was made:\n{problem_lines}\n"
            f"{suggestion('verify', store_path, repair=True)} puts back what was there."
        )


def damage_or_read_error(read_damage: Callable[[], str]) -> str:
    """Damage of an object in words, as a function says that reads it; empty if there is none.

    ObjectStoreError where an object store does not give it.
    """
    try:
        return read_damage()
    except (FileNotFoundError, NotADirectoryError):
        return "is missing"
    except RefusedFileError as error:
        return str(error.strerror)
    except ObjectStoreError:
        raise  # its service's fault, of which the object says nothing
    except OSError as error:
        return f"can't be read: {error.strerror}"


def is_block_visible(
    store_path: Location, study: BlockStudy, receipt: Receipt, check_digest: bool
) -> bool:
    """Tell whether a block that a worker has written is here: by size, or digest where `read`."""
    chunk_paths = chunk_names_of_block(study, receipt.block)
    try:
        if check_digest:
            return (
                stored_objects_digest(store_path, chunk_paths, chunk_size_limits(study))
                == receipt.digest
            )
        if isinstance(store_path, Path):
            return (
                sum(os.lstat(f"{store_path}/{name}").st_size for name in chunk_paths)
                == receipt.bytes
            )
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError, RefusedFileError):
        return False
    return (store_path / chunk_paths[-1]).size() > 0


#: Distributions whose version can change a result or how it is stored.
VERSIONED_DISTRIBUTIONS = ("numba", "numpy", "scipy", "sweep", "zarr")


@cache
def current_versions() -> dict[str, str]:
    """Versions of the software that a result depends on, by name."""
    return {name: version(name) for name in VERSIONED_DISTRIBUTIONS}


@cache
def processor_text() -> str:
    """Machine, processor and vector instructions, by which numpy and LLVM choose their code."""
    import llvmlite.binding
    import numpy as np

    simd = np.show_config(mode="dicts").get("SIMD Extensions", {})  # type: ignore[call-overload]
    instructions = simd.get("found") or simd.get("baseline") or []
    name = llvmlite.binding.get_host_cpu_name()
    return f"{platform.machine()} {name} {' '.join(instructions)}".strip()


def refuse_foreign_store(store_path: Location) -> None:
    """Refuse what no version of this program has made; a damaged store of ours passes."""
    if not any(
        any(iter_records(store_path / JOURNAL_DIR / name)) for name in (MANIFEST_FILE, *LOG_NAMES)
    ):
        store_format.refuse_foreign_store(store_path)


def refuse_to_replace(store_path: Location) -> None:
    """Refuse to replace what no version of this program has made, or what can't be renamed."""
    if not isinstance(store_path, Path):
        raise StoreError(
            f"{store_path} can't be replaced or extended in its place, as an object store has no "
            f"renaming: name another place with {option_name('store')}; this one then stays"
        )
    refuse_foreign_store(store_path)


def refuse_foreign_files(store_path: Location) -> None:
    """Refuse to replace a store with files in its folder that are not sweep's."""
    if not isinstance(store_path, Path):
        return
    if names := [name for name in list_foreign_files(store_path) if not is_litter(name)]:
        names_text = ", ".join(names[:FOREIGN_FILES_NAMED_MAX]) + (
            ", ..." if len(names) > FOREIGN_FILES_NAMED_MAX else ""
        )
        raise StoreError(
            f"{store_path} has files in it that are not sweep's ({names_text}): move them "
            f"elsewhere, as {option_text('overwrite')} replaces the whole folder"
        )


def pending_replacement(store_path: Location) -> Path | None:
    """Return the unfinished store that is to replace the one at a path; StoreError for another."""
    recover_interrupted_replace(store_path)
    if (
        not isinstance(store_path, Path)
        or not (staging_path := staging_path_for(store_path)).exists()
    ):
        return None
    if read_recipe(staging_path).get(REPLACES_KEY) != store_format.read_study_id(store_path):
        situation = "holds another study now" if store_path.exists() else "is gone"
        raise StoreError(
            f"{staging_path} was begun to take the place of a store at {store_path}, which "
            f"{situation}: "
            f"`rm -r {shlex.quote(str(staging_path))}`, or have {option_text('overwrite')} begin "
            "anew"
        )
    return staging_path


def refuse_other_study(
    store_path: Location,
    attributes: dict[str, Any],
    stored_spec: GridSpec | SceneSpec,
    requested_spec: GridSpec | SceneSpec,
) -> None:
    """Refuse a store that holds another study than the one asked for."""
    if attributes["study_id"] == requested_spec.id:
        return
    refuse_other_versions(
        store_path, attributes, reader="this machine"
    )  # the version is in the id too
    lines = "\n".join(f"  {line}" for line in describe_differences(stored_spec, requested_spec))
    raise StoreError(
        f"{store_path} holds another study (in the store -> in the spec):\n{lines}\n"
        f"Name another {option_name('store')}, or replace this one with {option_text('overwrite')}."
    )


def refuse_other_versions(
    store_path: str | Location, attributes: dict[str, Any], *, reader: str
) -> None:
    """Refuse a store begun with another model or other software: the bits could differ."""
    recorded = {"model": attributes["model_version"], **parse_software_versions(attributes)}
    current = {"model": VERSION, **current_versions()}
    if recorded != current:
        difference_lines = "\n".join(
            f"  {name}: {recorded.get(name, 'none')} in the store, {current.get(name, 'none')} here"
            for name in current | recorded
            if current.get(name) != recorded.get(name)
        )
        raise StoreError(
            f"{store_path} was begun with other versions than {reader} has:\n{difference_lines}\n"
            "Its results could not be told apart from new ones. Install those versions to resume "
            "it, or run the study anew into another store."
        )
