"""Zarr store of a study: created at once without results, then written block by block.

No two blocks share a chunk, so writers need no locks between them. Only the journal, `.sweep/`,
contains hosts and times. Every other byte follows from the study and from the versions of the
software. The journal also lists everything that the store contained before any result, with
digests.
"""

from __future__ import annotations

import ctypes
import errno
import json
import logging
import os
import platform
import shlex
import tempfile
import time
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

from sweep.messages import option_name, option_text, suggested_call
from sweep.regular_files import RefusedFileError
from sweep.storage import locations, store_format
from sweep.storage.foreign_files import is_ignorable_file, list_foreign_files
from sweep.storage.locations import (
    JOURNAL_DIR,
    Location,
    ObjectPath,
    ObjectStoreError,
    atomic_write,
    file_sizes_below,
    iter_file_entries_below,
    iter_file_names_below,
    map_concurrently,
    os_error_reason,
    parse_location,
    recover_interrupted_replace,
    remedy_for_write_error,
    remove_atomically,
    staging_path_for,
    translate_object_store_errors,
    write_path_atomically,
)
from sweep.storage.size_checks import SingleWriterLocalStore, compressed_bytes_max
from sweep.storage.store_format import (
    LAYOUT_VERSION,
    MANIFEST_FILE,
    ZSTD_LEVEL,
    contents_digest,
    encode_log_record,
    format_software_versions,
    iter_log_lines,
    iter_log_records,
    objects_match_digest,
    parse_software_versions,
    read_root_metadata,
    stored_objects_digest,
)
from sweep.storage.verified_store import CHUNK_NAME_PATTERN
from sweep.tasks.engine.block_study import BlockStudy, StoreTemplate
from sweep.tasks.engine.blocks import CF_CONVENTIONS_VERSION, ArrayLayout
from sweep.tasks.engine.journal import (
    LOCK_FILE,
    LOG_FILE_NAMES,
    REPLACED_STUDY_ID_KEY,
    Receipt,
    StoreLock,
    read_store_recipe,
    write_store_recipe,
)
from sweep.tasks.engine.progress import StoreBusyError, StoreError

ROOT_DOCUMENT_FILE = "zarr.json"

MANIFEST_PATH = f"{JOURNAL_DIR}/{MANIFEST_FILE}"

#: Name of the object that marks a store in an object store as created or removed only in part.
UNFINISHED_MARKER_FILE = "partial"

#: Largest number of foreign files that an error message names.
FOREIGN_FILES_IN_MESSAGE_MAX = 5

#: Codecs that compress a chunk and add its checksum.
CHUNK_CODECS = [ZstdCodec(level=ZSTD_LEVEL), Crc32cCodec()]

_ZSTD_ENCODER = Zstd(level=ZSTD_LEVEL)

_log = logging.getLogger("sweep.study_store")

_libc = ctypes.CDLL(None, use_errno=True)


def create_store(
    store_path: str | Location,
    template: StoreTemplate,
    *,
    replace_existing: bool = False,
    recipe: Mapping[str, Any] | None = None,
    durable: bool = False,
) -> Location:
    """Create a store without results, and return its location.

    The store has metadata and arrays with known values. ``recipe`` has facts about how the store is
    made. On disk the store is built under a hidden name and then renamed, so that an interrupted
    creation leaves no incomplete store. For an object store it is built on this machine and
    uploaded, its root document last. StoreError is raised if something is at the path, or the path
    is not writable.
    """
    store_path = parse_location(store_path)
    try:
        if isinstance(store_path, Path):
            with write_path_atomically(store_path, replace=replace_existing) as draft_path:
                try:
                    _build_store(draft_path, template, recipe)
                except OSError as error:  # the reason is found before the draft is removed
                    raise OSError(
                        error.errno, os_error_reason(error, draft_path), str(draft_path)
                    ) from error
                if durable:
                    sync_file_system(draft_path)
        else:
            with tempfile.TemporaryDirectory() as temporary_folder:
                _build_store(Path(temporary_folder) / store_path.name, template, recipe)
                _upload_store(Path(temporary_folder) / store_path.name, store_path)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST) and store_path.exists():
            raise StoreBusyError(
                f"{store_path} is there already: another process has made it"
            ) from error
        remedy = remedy_for_write_error(
            error, store_path, f"name another place, {option_name('store')}"
        )
        raise StoreError(
            f"{store_path} can't be made: {error.strerror or error}; {remedy}"
        ) from error
    return store_path


def _build_store(
    store_path: Path, template: StoreTemplate, recipe: Mapping[str, Any] | None
) -> None:
    """Create a store without results on disk, with its recipe (facts about how it is made)."""
    build_template(store_path, template, template_attributes(template))
    if recipe:
        write_store_recipe(store_path, **recipe)


def _upload_store(local_path: Path, store_path: ObjectPath) -> None:
    """Copy a store on disk to a path in an object store. The root metadata is copied last."""
    names = file_sizes_below(local_path).keys() - {ROOT_DOCUMENT_FILE}
    with reserve_object_location(store_path):
        map_concurrently(
            store_path,
            lambda name: (store_path / name).write_bytes((local_path / name).read_bytes()),
            names,
        )
        (store_path / ROOT_DOCUMENT_FILE).write_bytes(
            (local_path / ROOT_DOCUMENT_FILE).read_bytes()
        )


@contextmanager
def reserve_object_location(store_path: ObjectPath) -> Iterator[None]:
    """Context manager that reserves a path in an object store while a store is created there.

    Files of an interrupted creation at the path are removed. StoreError is raised if anything else
    is at the path.
    """
    marker = store_path / JOURNAL_DIR / UNFINISHED_MARKER_FILE
    with StoreLock(store_path):
        if marker.exists():  # an interrupted creation or removal has left files
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
    """Delete a store.

    On disk a single rename hides the store first. In an object store the root document is deleted
    first; without it no store exists.
    """
    if isinstance(store_path, Path):
        remove_atomically(store_path)
        return
    marker = store_path / JOURNAL_DIR / UNFINISHED_MARKER_FILE
    marker.write_bytes(b"")
    (store_path / ROOT_DOCUMENT_FILE).unlink()
    kept_names = {f"{JOURNAL_DIR}/{LOCK_FILE}", f"{JOURNAL_DIR}/{UNFINISHED_MARKER_FILE}"}
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
    """Create a template on disk: a store without results.

    `attributes` are the root attributes. `shard_shape_of` returns the shape of an array's shards,
    if each file holds a shard of many chunks. It returns None if each file holds one chunk, which
    is the default.
    """
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
        {
            name: stored_objects_digest(store_path, [name])
            for name in iter_file_names_below(store_path)
        },
    )


def template_attributes(template: StoreTemplate) -> dict[str, Any]:
    """Return the root attributes of a new store: of its study, software versions and processor."""
    return template.store_attributes() | {
        "Conventions": CF_CONVENTIONS_VERSION,
        "study_id": template.id,
        "model_version": template.model_version,
        "software": format_software_versions(current_software_versions()),
        "processor": processor_description(),
        "layout": LAYOUT_VERSION,
    }


def write_manifest(
    store_path: Location, attributes: dict[str, Any], digests: Mapping[str, str]
) -> None:
    """Write a store's manifest: root attributes, and digests of all objects without results.

    ``digests`` has the digest of each object by the object's path inside the store.
    """
    records = [encode_log_record({"attributes": attributes, "objects": len(digests)})]
    records += [
        encode_log_record({"object": name, "digest": object_digest})
        for name, object_digest in sorted(digests.items())
    ]
    atomic_write(store_path / JOURNAL_DIR / MANIFEST_FILE, b"".join(records))


def _create_array(
    group: zarr.Group, layout: ArrayLayout, shard_shape: tuple[int, ...] | None
) -> None:
    """Create an array in a group, and write the array's values if they are known."""
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
        compressors=CHUNK_CODECS,
    )
    if layout.known_values is not None:
        array[...] = layout.known_values


def _consolidate_metadata(store_path: Path) -> None:
    """Copy the metadata of all arrays into the root document of a store.

    Zarr's own function does the same, but warns that such a document is not part of the standard.
    """
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
    )  # without indentation, which is ten times as fast


def encode_chunk(layout: ArrayLayout, values: np.ndarray) -> bytes:
    """Return the bytes of a chunk of numbers, equal to those that Zarr writes.

    `values` may be smaller than a chunk at the edge of the array; the rest of the chunk has fill
    values. The bytes are compressed little-endian values in C order, and a CRC32C checksum. Zarr's
    own encoder takes ten times as long: 20 ms for a block of 26 arrays.
    """
    dtype = np.dtype(layout.dtype).newbyteorder("<")
    if values.shape == layout.chunks:
        chunk = np.ascontiguousarray(values, dtype).reshape(layout.chunks)
    else:
        chunk = np.full(layout.chunks, layout.fill_value, dtype)
        chunk[tuple(slice(length) for length in values.shape)] = values
    content: bytes = _ZSTD_ENCODER.encode(chunk)
    return content + google_crc32c.value(content).to_bytes(4, "little")


class WrittenBlock(NamedTuple):
    """Digest and size [bytes] of a stored block."""

    digest: str  # digest of the bytes and their paths, by `contents_digest`
    n_bytes: int  # size as stored


class BlockWriter:
    """Writer of blocks into the arrays of a study's store."""

    def __init__(self, store_path: str | Location, study: BlockStudy) -> None:
        self.store_path, self.study = parse_location(store_path), study

    def write(self, block: int, results: Mapping[str, np.ndarray]) -> WrittenBlock:
        """Write all chunks of one block. Return the digest and the size of the block.

        `results` has the values of the block's chunk of each array, by array name. ValueError is
        raised if names or shapes don't match the block's arrays.
        """
        positions = self.study.chunk_positions_of_block(block)
        if results.keys() != positions.keys():
            mismatched_names = sorted(results.keys() ^ positions.keys())
            raise ValueError(
                f"results don't match the block's arrays: {', '.join(mismatched_names)}"
            )

        def write_chunk(array_name: str) -> tuple[str, bytes]:
            """Write a chunk. Return its path inside the store, and its bytes."""
            layout, position, values = (
                self.study.output_layout_by_name[array_name],
                positions[array_name],
                results[array_name],
            )
            region_shape = tuple(s.stop - s.start for s in layout.chunk_region(position))
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

        started_at = time.monotonic()
        with translate_object_store_errors(self.store_path):
            chunk_contents = map_concurrently(self.store_path, write_chunk, positions)
        n_bytes = sum(len(content) for _, content in chunk_contents)
        _log.debug(
            "%s: wrote block %s, %s chunks of %s bytes in all, in %.3f s",
            self.store_path,
            block,
            len(chunk_contents),
            n_bytes,
            time.monotonic() - started_at,
        )
        return WrittenBlock(contents_digest(chunk_contents), n_bytes)


def chunk_names_of_block(study: BlockStudy, block: int) -> list[str]:
    """Return the paths, inside the store, of the chunks of one block."""
    return [
        chunk_name(array_name, position)
        for array_name, position in study.chunk_positions_of_block(block).items()
    ]


def make_chunk_size_limit(study: BlockStudy) -> Callable[[str], int]:
    """Return a function that gives the largest valid size of a chunk [bytes] from its path."""

    def size_limit(chunk_path: str) -> int:
        layout = study.output_layout_by_name[array_name_of_chunk(chunk_path)]
        return compressed_bytes_max(layout.nbytes_of_part(layout.chunks))

    return size_limit


def array_name_of_chunk(chunk_path: str) -> str:
    """Return the path, inside the store, of the array that a chunk is part of.

    The result is '' if the path is not that of a chunk.

    >>> [array_name_of_chunk(name) for name in ("east/wind/c/0/3", "weight/c", "wind/zarr.json")]
    ['east/wind', 'weight', '']
    """
    match = CHUNK_NAME_PATTERN.fullmatch(chunk_path)
    return match[1] if match else ""


def chunk_name(array_name: str, position: tuple[int, ...]) -> str:
    """Return the path, inside the store, of one chunk of an array."""
    return "/".join([array_name, "c", *map(str, position)])


def sync_file_system(store_path: Location) -> None:
    """Write all cached data of the file system that holds a store to disk.

    OSError is raised if the disk fails. Syncing the whole file system costs as much as syncing a
    few files. Nothing happens for an object store.
    """
    if not isinstance(store_path, Path):
        return
    descriptor = os.open(store_path, os.O_RDONLY)
    try:
        if not hasattr(_libc, "syncfs"):  # systems other than Linux
            os.sync()
        elif _libc.syncfs(descriptor):
            error_number = ctypes.get_errno()
            raise OSError(error_number, os.strerror(error_number), str(store_path))
    finally:
        os.close(descriptor)


def remove_draft_files(store_path: Location) -> None:
    """Remove unfinished files that killed processes have left in a store."""
    if isinstance(store_path, Path):
        partial_files = (
            candidate
            for candidate in iter_file_entries_below(str(store_path))
            if candidate.name.endswith(locations.DRAFT_SUFFIX)
        )
        for entry in _exclude_foreign_files(store_path, partial_files):
            with suppress(FileNotFoundError):
                os.unlink(entry.path)


def refuse_links(store_path: Location) -> None:
    """Raise a StoreError if a symbolic link would direct writes outside the store.

    A link or a pipe in place of a file does no harm, as a new file is renamed over the link or
    pipe.
    """
    if isinstance(store_path, Path):
        links = (
            entry
            for entry in iter_file_entries_below(str(store_path))
            if entry.is_symlink() and (entry.is_dir() or not os.path.exists(entry.path))
        )
        for entry in _exclude_foreign_files(store_path, links):
            raise StoreError(
                f"{entry.path} is a symbolic link, no folder: sweep made none such, remove it"
            )


def _exclude_foreign_files(
    store_path: Path, entries: Iterable[os.DirEntry[str]]
) -> list[os.DirEntry[str]]:
    """Return directory entries without those of foreign files, which sweep did not make.

    `entries` are files, folders and links below the store.
    """
    entries = list(entries)
    if not entries:
        return []  # without a search for foreign files, which walks through the store
    foreign_paths, prefix_length = list_foreign_files(store_path), len(str(store_path)) + 1
    folders = tuple(name for name in foreign_paths if name.endswith("/"))
    return [
        entry
        for entry in entries
        if entry.path[prefix_length:] not in foreign_paths
        and not entry.path[prefix_length:].startswith(folders)
    ]


class Damage(NamedTuple):
    """Damage of an object in a store: its difference from what was written."""

    object_name: str  # path inside the store; with the line number in a log
    description: str  # what is wrong, as a predicate such as "is missing"
    block: int = -1  # number of the block that wrote the object; -1 for other objects
    repaired_by: str = "resume"  # "repair" for objects of the template, "hand" for surplus ones


def read_manifest_digests(store_path: Location) -> dict[str, str]:
    """Return the digests in a store's manifest, by the path of the object inside the store.

    Damaged lines are skipped.
    """
    return {
        record["object"]: record["digest"]
        for record in iter_log_records(store_path / MANIFEST_PATH)
        if "object" in record
    }


def find_template_damages(store_path: Location) -> list[Damage]:
    """Return a list of damaged objects of a store's template, and damaged lines of the manifest.

    The template is everything that the store contained before the first result.
    """
    records = [record for _, record in iter_log_lines(store_path / MANIFEST_PATH)]
    if not records:
        return [Damage(MANIFEST_PATH, "is missing or empty", repaired_by="repair")]
    problems = [
        Damage(f"{MANIFEST_PATH} line {line_number}", "is damaged", repaired_by="repair")
        for line_number, record_or_none in enumerate(records, 1)
        if record_or_none is None
    ]
    undamaged_records = [record for record in records if record]
    if not problems and undamaged_records[0].get("objects") != len(undamaged_records) - 1:
        problems.append(Damage(MANIFEST_PATH, "lacks lines", repaired_by="repair"))
    return problems + [
        Damage(name, problem, repaired_by="repair")
        for name, expected_digest in read_manifest_digests(store_path).items()
        if (problem := describe_template_object_damage(store_path, name, expected_digest))
    ]


def describe_template_object_damage(
    store_path: Location, object_name: str, expected_digest: str
) -> str:
    """Return what is wrong with an object of the manifest, in words; '' if it is undamaged.

    `expected_digest` is the object's digest in the manifest.
    """
    return damage_or_read_error(
        lambda: (
            ""
            if objects_match_digest(store_path, [object_name], expected_digest)
            else "is not as it was made"
        )
    )


def refuse_damaged_template(store_path: Location) -> None:
    """Raise a StoreError if an object that was written before the first result is damaged.

    New results might not fit a damaged store.
    """
    refuse_links(store_path)
    if problems := find_template_damages(store_path):
        problem_lines = "\n".join(
            f"  {damage.object_name} {damage.description}" for damage in problems
        )
        raise StoreError(
            f"{store_path} is not as it was made:\n{problem_lines}\n"
            f"{suggested_call('verify', store_path, repair=True)} puts back what was there."
        )


def refuse_other_blocks(store_path: Location, study: BlockStudy) -> None:
    """Raise a StoreError if a store lacks an array of results, or has blocks of other shapes.

    Arrays and shapes must be those of `study`.
    """
    nodes = read_root_metadata(store_path)["consolidated_metadata"]["metadata"]
    for name in study.output_layout_by_name:
        if name not in nodes:
            raise StoreError(
                f"{store_path} has no array {name}, which this version of sweep computes. "
                "Install the version that began it to resume it, or run the study anew into "
                "another store."
            )
    refuse_other_block_shapes(store_path, study)


def refuse_other_block_shapes(store_path: Location, study: BlockStudy) -> None:
    """Raise a StoreError if a store's blocks have other shapes than those of the study.

    Another version of this program may have cut the study into other blocks. The store's receipts
    and chunks would then be attributed to the wrong points. Arrays that the store lacks are not
    checked. The store must not be a packed copy.
    """
    nodes = read_root_metadata(store_path)["consolidated_metadata"]["metadata"]
    for layout in study.output_layout_by_name.values():
        if layout.name not in nodes:
            continue
        chunk_shape = tuple(nodes[layout.name]["chunk_grid"]["configuration"]["chunk_shape"])
        if chunk_shape != layout.chunks:
            raise StoreError(
                f"{store_path} has blocks of {_shape_text(chunk_shape)} in {layout.name}, and this "
                f"version of sweep cuts the study into blocks of {_shape_text(layout.chunks)}. "
                "Install the version that began it to go on with it, or run the study anew into "
                "another store; its results can be read with xarray."
            )


def _shape_text(shape: tuple[int, ...]) -> str:
    """Return a shape as text, such as '728 x 90'."""
    return " x ".join(str(length) for length in shape)


def damage_or_read_error(read_damage: Callable[[], str]) -> str:
    """Return what is wrong with an object, in words; '' if it is as it was written.

    `read_damage` reads the object and returns its damage. If the object can't be read, the reason
    is returned. ObjectStoreError is raised if an object store fails.
    """
    try:
        return read_damage()
    except (FileNotFoundError, NotADirectoryError):
        return "is missing"
    except RefusedFileError as error:
        return str(error.strerror)
    except ObjectStoreError:
        raise  # a fault of the service says nothing about the object
    except OSError as error:
        return f"can't be read: {error.strerror}"


def is_block_visible(
    store_path: Location, study: BlockStudy, receipt: Receipt, check_digest: bool
) -> bool:
    """Return True if this process sees the block of a receipt in the store.

    If `check_digest`, the digest of the block's chunks must be that of the receipt. Otherwise, on
    disk, their total size must be that of the receipt; in an object store, the last chunk must not
    be empty.
    """
    chunk_paths = chunk_names_of_block(study, receipt.block)
    try:
        if check_digest:
            return (
                stored_objects_digest(store_path, chunk_paths, make_chunk_size_limit(study))
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


#: Names of Python packages whose version can change a result, or the bytes in which it is stored.
RESULT_AFFECTING_PACKAGES = ("numba", "numpy", "scipy", "sweep", "zarr")


@cache
def current_software_versions() -> dict[str, str]:
    """Return the versions of the software that results depend on, by name."""
    return {name: version(name) for name in RESULT_AFFECTING_PACKAGES}


@cache
def processor_description() -> str:
    """Return machine, processor and vector instructions as text.

    The last bits of results may depend on all three, as NumPy and LLVM choose machine code for
    them.
    """
    import llvmlite.binding
    import numpy as np

    simd = np.show_config(mode="dicts").get("SIMD Extensions", {})  # type: ignore[call-overload]
    instructions = simd.get("found") or simd.get("baseline") or []
    name = llvmlite.binding.get_host_cpu_name()
    return f"{platform.machine()} {name} {' '.join(instructions)}".strip()


def refuse_foreign_store(store_path: Location) -> None:
    """Raise a StoreError if there is no store at a path, or if sweep did not make it.

    Damaged stores are accepted.
    """
    if not any(
        any(iter_log_records(store_path / JOURNAL_DIR / name))
        for name in (MANIFEST_FILE, *LOG_FILE_NAMES)
    ):
        store_format.refuse_foreign_store(store_path)


def refuse_irreplaceable_store(store_path: Location) -> None:
    """Raise a StoreError if a store is in an object store, or if sweep did not make it.

    In an object store nothing can be renamed, and so no store can be replaced.
    """
    if not isinstance(store_path, Path):
        raise StoreError(
            f"{store_path} can't be replaced or extended in its place, as an object store has no "
            f"renaming: name another place with {option_name('store')}; this one then stays"
        )
    refuse_foreign_store(store_path)


def refuse_foreign_files(store_path: Location) -> None:
    """Raise a StoreError if the folder of a store contains files that are not sweep's."""
    if not isinstance(store_path, Path):
        return
    if names := [name for name in list_foreign_files(store_path) if not is_ignorable_file(name)]:
        names_text = ", ".join(names[:FOREIGN_FILES_IN_MESSAGE_MAX]) + (
            ", ..." if len(names) > FOREIGN_FILES_IN_MESSAGE_MAX else ""
        )
        raise StoreError(
            f"{store_path} has files in it that are not sweep's ({names_text}): move them "
            f"elsewhere, as {option_text('overwrite')} replaces the whole folder"
        )


def find_pending_replacement(store_path: Location) -> Path | None:
    """Return the path of an unfinished store that will replace the store at ``store_path``.

    The result is None if no such store exists. First, replacements that dead processes have left
    are completed or undone. StoreError is raised if the unfinished store is to replace the store of
    another study than the one now at ``store_path``.
    """
    recover_interrupted_replace(store_path)
    if (
        not isinstance(store_path, Path)
        or not (staging_path := staging_path_for(store_path)).exists()
    ):
        return None
    if read_store_recipe(staging_path).get(REPLACED_STUDY_ID_KEY) != store_format.read_study_id(
        store_path
    ):
        situation = "holds another study now" if store_path.exists() else "is gone"
        raise StoreError(
            f"{staging_path} was begun to take the place of a store at {store_path}, which "
            f"{situation}: "
            f"`rm -r {shlex.quote(str(staging_path))}`, or have {option_text('overwrite')} begin "
            "anew"
        )
    return staging_path


def refuse_other_versions(
    store_path: str | Location, attributes: dict[str, Any], model_version: str, *, reader: str
) -> None:
    """Raise a StoreError if a store was begun with other versions of the model or of software.

    New results could differ from the stored ones. `reader` names this process in the message.
    """
    recorded = {"model": attributes["model_version"], **parse_software_versions(attributes)}
    current = {"model": model_version, **current_software_versions()}
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
