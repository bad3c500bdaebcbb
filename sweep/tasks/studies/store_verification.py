"""Verification of every byte of a store by digests, repair, and packing into few large files.

What a store contains before the first result follows from the study alone, and can be restored byte
for byte. A packed copy is checked value by value when it is made.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr

from sweep.messages import number_with_noun, suggested_call
from sweep.storage import store_format
from sweep.storage.foreign_files import list_foreign_files
from sweep.storage.locations import (
    DRAFT_SUFFIX,
    JOURNAL_DIR,
    PACKED_ATTRIBUTE,
    Location,
    ObjectPath,
    atomic_write,
    can_create_store,
    eyepoint_store_location,
    file_sizes_below,
    iter_file_names_below,
    parse_location,
    read_object,
    recover_interrupted_replace,
    to_zarr_store,
    translate_object_store_errors,
    write_path_atomically,
)
from sweep.storage.store_format import (
    contents_digest,
    encode_log_record,
    iter_log_lines,
    iter_log_records,
    objects_match_digest,
    stored_objects_digest,
)
from sweep.storage.verified_store import (
    CHUNK_NAME_PATTERN,
    describe_chunk_damage,
    open_verified_group,
)
from sweep.tasks.engine import journal, study_store
from sweep.tasks.engine.block_study import BlockStudy
from sweep.tasks.engine.blocks import ArrayLayout, BlockGrid
from sweep.tasks.engine.journal import (
    LOG_FILE_NAMES,
    RECIPE_FILE,
    committed_block_mask,
    read_store_recipe,
)
from sweep.tasks.engine.progress import Progress, StoreError, make_progress, raise_as_store_error
from sweep.tasks.engine.study_store import (
    Damage,
    damage_or_read_error,
    describe_template_object_damage,
)
from sweep.tasks.studies import study_loading
from sweep.tasks.studies.flight_study import FlightStudy
from sweep.tasks.studies.study_loading import AnyStudy

if TYPE_CHECKING:
    from sweep.spec import GridSpec, SceneSpec

BLOCKS_PER_READ_BATCH = 256
"""Number of blocks of a store that are read in one batch for checking."""
N_READER_THREADS = 4
"""Number of threads that read blocks or shards of a store."""


@dataclass(frozen=True, kw_only=True)
class VerificationReport:
    """Result of checking a store: undamaged blocks, damaged objects, and foreign files."""

    store: Location
    blocks: int
    undamaged_blocks: int  # number of committed and undamaged blocks
    damages: tuple[Damage, ...]
    restored_objects: tuple[str, ...]  # objects of the template that were restored
    foreign_objects: tuple[str, ...]  # files that were not made by sweep
    withdrawal_error: str  # why damaged blocks could not be marked for `resume`; '' if they are

    @property
    def is_undamaged(self) -> bool:
        """True if no object of the store is damaged."""
        return not self.damages

    @property
    def complete(self) -> bool:
        """True if every block is committed and undamaged."""
        return self.undamaged_blocks == self.blocks


def verify(
    path: str | Location,
    *,
    repair: bool = False,
    spec: GridSpec | SceneSpec | None = None,
    progress: bool | Progress = True,
) -> list[VerificationReport]:
    """Check every byte of a store, and of the eyepoint stores that its study uses.

    Receipts of damaged blocks are withdrawn, so that `resume` computes the blocks again. They are
    not withdrawn while another process writes to the store.

    Parameters
    ----------
    path
        Path of a store: on disk, or `s3://bucket/key.zarr` (gs, az).
    repair
        Whether to restore damaged metadata, coordinates and the spec.
    spec
        Study of a store that no longer contains it; used by `repair` only.
    progress
        True for a bar or lines on standard error, False for none, or a `Progress`.

    Returns
    -------
    list of VerificationReport
        Result for the store, then for each eyepoint store that exists.

    Raises
    ------
    StoreError
        If there is no store of sweep, if it holds another study than `spec`, or if it can't be
        repaired.

    Examples
    --------
    >>> import sweep
    >>> outcome = sweep.run(sweep.load("study.yaml"), store="copied.zarr", progress=False)
    >>> (report,) = sweep.verify("copied.zarr", progress=False)
    >>> report.complete, report.is_undamaged
    (True, True)
    """
    path, listener = parse_location(path).absolute(), make_progress(progress)
    recover_interrupted_replace(path)
    study = _study_of_store(path, spec if repair else None)
    studies_by_store: dict[Location, AnyStudy | None] = {path: study}
    if isinstance(study, FlightStudy):
        studies_by_store |= {
            eyepoint_store_location(path, store_path.id): store_path
            for store_path in study.eyepoint_studies()
        }
    return [
        _verify_store(store_path, study_or_none, repair, listener)
        for store_path, study_or_none in studies_by_store.items()
        if store_path.exists()
    ]


def _study_of_store(store_path: Location, spec: GridSpec | SceneSpec | None) -> AnyStudy | None:
    """Return the study in a store, or the study of ``spec`` if given.

    StoreError is raised if it can't be read. The result is None for a store whose blocks can't be
    checked: one without a study, a packed one, or one of eyepoints that does not name their study.
    """
    try:
        attributes = _undamaged_attributes(store_path)
    except StoreError:
        if spec is None or not store_path.exists():
            raise
        return study_loading.make_study(spec, store_path)
    if spec and attributes["study_id"] != spec.id:
        raise StoreError(
            f"{store_path} holds another study than the spec: "
            f"{suggested_call('status', store_path)} names it"
        )
    if (
        attributes["kind"] == store_format.ACCURACY_STORE_KIND
        or (
            attributes["kind"] == store_format.EYEPOINTS_STORE_KIND
            and not read_store_recipe(store_path)
        )
        or PACKED_ATTRIBUTE in attributes
    ):
        return None
    study = (
        study_loading.make_study(spec, store_path)
        if spec
        else study_loading.load_study(store_path, attributes)
    )
    if not _is_root_damaged(store_path):
        # Receipts of other blocks would all be taken for damaged, and withdrawn.
        with suppress(
            store_format.NotAStoreError
        ):  # what can't be read is told with the other damages
            study_store.refuse_other_block_shapes(store_path, study)
    return study


def _verify_store(
    store_path: Location, study: AnyStudy | None, repair: bool, progress: Progress
) -> VerificationReport:
    """Check one store, and restore its template if `repair` is True. Return the report."""
    template_damage, restored_names = study_store.find_template_damages(store_path), []
    if template_damage and study and repair:
        study_store.refuse_foreign_store(store_path)  # a lock would be its first file made by sweep
        with journal.StoreLock(store_path, progress.say):
            template_damage, restored_names = [], restore_template(store_path, study)
    log_damage = _find_log_damages(store_path)
    block_damage = list(_iter_block_damages(store_path, study, progress)) if study else []
    surplus_chunks = (
        []
        if study_store.find_template_damages(store_path)
        else _iter_surplus_chunks(store_path, study)
    )
    return VerificationReport(
        store=store_path,
        blocks=study.n_blocks if study else 0,
        undamaged_blocks=_count_undamaged_blocks(store_path, study, block_damage) if study else 0,
        damages=(*template_damage, *log_damage, *block_damage, *surplus_chunks),
        restored_objects=tuple(restored_names),
        foreign_objects=tuple(_foreign_object_names(store_path)),
        withdrawal_error=_withdraw_receipts(store_path, block_damage, progress)
        if log_damage or block_damage
        else "",
    )


def _count_undamaged_blocks(store_path: Location, study: BlockStudy, damages: list[Damage]) -> int:
    """Return the number of committed blocks of a store without damage."""
    is_undamaged = journal.receipted_block_mask(store_path, study)
    is_undamaged[[damage.block for damage in damages]] = False
    return int(np.count_nonzero(is_undamaged))


def _find_log_damages(store_path: Location) -> list[Damage]:
    """Return the damaged lines of a store's journal.

    The last line of a journal to which a process still writes may be unfinished, and does not
    count.
    """
    unreadable = store_format.find_irregular_journal_files(store_path)
    holder = None if unreadable else journal.read_lock_holder(store_path)
    is_lock_holder_alive = holder is not None and journal.is_holder_alive(store_path, holder)
    return [Damage(name, problem, repaired_by="hand") for name, problem in unreadable.items()] + [
        Damage(f"{JOURNAL_DIR}/{name} line {line_number}", "is damaged or cut short")
        for name in (*journal.LOG_FILE_NAMES, RECIPE_FILE)
        for line_number, (line, record) in enumerate(
            iter_log_lines(store_path / JOURNAL_DIR / name), start=1
        )
        if record is None and not (is_lock_holder_alive and not line.endswith(b"\n"))
    ]


def _foreign_object_names(store_path: Location) -> list[str]:
    """Return the names of the objects (files) in a store that sweep did not make."""
    if isinstance(store_path, Path):
        return list_foreign_files(store_path)
    manifest = study_store.read_manifest_digests(store_path)
    names = (
        name for name in iter_file_names_below(store_path) if not name.startswith(f"{JOURNAL_DIR}/")
    )
    arrays = {name.removesuffix("/zarr.json") for name in manifest}
    return [
        object_name
        for object_name in names
        if object_name not in manifest
        and study_store.array_name_of_chunk(object_name) not in arrays
    ]


def _iter_surplus_chunks(store_path: Location, study: AnyStudy | None) -> Iterator[Damage]:
    """Yield a damage for each chunk file outside the bounds of its array.

    Drafts that killed processes left behind do not count.
    """
    manifest = study_store.read_manifest_digests(store_path)
    chunk_grid_shapes = (
        {name: owner_blocks.shape for name, owner_blocks in study.chunk_owner_blocks().items()}
        if study
        else {}
    )
    for name in iter_file_names_below(store_path):
        if name in manifest or name.startswith(f"{JOURNAL_DIR}/") or name.endswith(DRAFT_SUFFIX):
            continue
        chunk = CHUNK_NAME_PATTERN.fullmatch(name)
        if not (chunk and f"{chunk[1]}/zarr.json" in manifest):
            continue  # reported as foreign
        if not study:
            continue  # the chunks of an array that is not the study's are unknown
        array, chunk_index = chunk[1], chunk[2].split("/")[1:]
        chunk_grid_shape = chunk_grid_shapes.get(array, (0,))
        if len(chunk_index) != len(chunk_grid_shape) or any(
            int(index) >= count for index, count in zip(chunk_index, chunk_grid_shape, strict=True)
        ):
            yield Damage(name, "is no part of the store", repaired_by="hand")


def _iter_block_damages(
    store_path: Location, study: BlockStudy, progress: Progress
) -> Iterator[Damage]:
    """Yield the damages of all committed blocks of a store."""
    committed_digests = journal.read_committed_digests(store_path, study.n_blocks)
    blocks = np.flatnonzero(committed_digests != b"")
    progress = (
        progress if len(blocks) > BLOCKS_PER_READ_BATCH else Progress()
    )  # a short verification shows no progress
    progress.begin(points=len(blocks), done=0, unit="blocks")
    try:
        with ThreadPoolExecutor(N_READER_THREADS) as pool:
            for start in range(0, len(blocks), BLOCKS_PER_READ_BATCH):
                batch = [int(block) for block in blocks[start : start + BLOCKS_PER_READ_BATCH]]
                for damages in pool.map(
                    lambda block_number: _find_block_damages(
                        store_path, study, block_number, bytes(committed_digests[block_number])
                    ),
                    batch,
                ):
                    yield from damages
                progress.advance(points=len(batch), failed=0)
    finally:
        progress.end()


def _find_block_damages(
    store_path: Location, study: BlockStudy, block: int, expected_digest: bytes
) -> list[Damage]:
    """Return the damages of the chunks of one block.

    `expected_digest` is the digest of the block's chunks in the block's receipt.
    """
    chunk_paths, bytes_max = (
        study_store.chunk_names_of_block(study, block),
        study_store.make_chunk_size_limit(study),
    )
    try:
        if objects_match_digest(store_path, chunk_paths, expected_digest.decode(), bytes_max):
            return []
    except OSError:
        pass  # reported below, object by object
    damages = []
    for name in chunk_paths:
        if problem := damage_or_read_error(
            partial(_read_chunk_damage, store_path, name, bytes_max(name))
        ):
            damages.append(Damage(name, problem, block))
    if (
        not damages
        and isinstance(store_path, ObjectPath)
        and objects_match_digest(store_path, chunk_paths, expected_digest.decode(), bytes_max)
    ):
        return []  # earlier responses were incomplete
    description = f"one of its {number_with_noun(len(chunk_paths), 'chunk')}"
    return damages or [Damage(description, "is whole but not the one that was committed", block)]


def _read_chunk_damage(store_path: Location, chunk_path: str, bytes_max: int) -> str:
    """Read a chunk. Return a description of its damage; '' if it has none.

    In an object store a damaged chunk is read twice, as a response may be incomplete.
    """
    problem = describe_chunk_damage(read_object(store_path, chunk_path, bytes_max))
    if problem and isinstance(store_path, ObjectPath):
        content = read_object(store_path, chunk_path, bytes_max)
        if problem := describe_chunk_damage(content):
            (store_path / chunk_path).refuse_truncated_content(content)
    return problem


def _withdraw_receipts(store_path: Location, damages: list[Damage], progress: Progress) -> str:
    """Withdraw the receipts of damaged blocks. Return why this fails, or '' if it succeeds."""
    try:
        with (
            journal.StoreLock(store_path, progress.say),
            raise_as_store_error(f"{store_path} can't be written"),
        ):
            log = journal.Journal(store_path)
            for block in sorted({damage.block for damage in damages}):
                problems = [
                    f"{block_damage.object_name} {block_damage.description}"
                    for block_damage in damages
                    if block_damage.block == block
                ]
                log.withdraw_receipt(block, "; ".join(problems))
            log.flush(force=True)
    except StoreError as error:
        return str(error)
    return ""


def _undamaged_attributes(store_path: Location) -> dict[str, Any]:
    """Return the attributes of a store from its manifest, or else from its root metadata.

    StoreError is raised if the root is needed and damaged.
    """
    if manifest_attributes := store_format.read_manifest_attributes(store_path):
        return store_format.check_attributes(store_path, manifest_attributes)
    attributes = store_format.read_attributes(store_path)
    if _is_root_damaged(store_path):
        raise StoreError(
            f"{store_path / 'zarr.json'} is damaged{store_format.repair_hint(store_path)}"
        )
    return attributes


def _is_root_damaged(store_path: Location) -> bool:
    """Return True if the root metadata of a store differ from their digest in the manifest."""
    expected_digest = study_store.read_manifest_digests(store_path).get("zarr.json")
    return expected_digest is not None and bool(
        describe_template_object_damage(store_path, "zarr.json", expected_digest)
    )


def restore_template(store_path: Location, study: BlockStudy) -> list[str]:
    """Restore damaged objects of a store's template, each in one step. Return their names.

    The template is everything that the store contained before the first result. The caller holds
    the store's lock. StoreError is raised if this machine can't make the same objects.
    """
    study_store.refuse_links(store_path)
    try:
        attributes = _undamaged_attributes(store_path)
    except StoreError:
        attributes = {}
    if attributes:
        study_store.refuse_other_versions(
            store_path, attributes, study.model_version, reader="this machine"
        )
    if attributes.get("study_id", study.id) != study.id:
        raise StoreError(
            f"{store_path / 'zarr.json'} is damaged{store_format.repair_hint(store_path)}"
        )
    with (
        raise_as_store_error(f"{store_path} can't be mended"),
        tempfile.TemporaryDirectory() as directory,
    ):
        template_path = Path(directory) / store_path.name
        study_store.build_template(
            template_path, study, attributes or study_store.template_attributes(study)
        )
        _refuse_unreproducible_template(store_path, template_path)
        template_digests = {
            name: stored_objects_digest(template_path, [name])
            for name in sorted(iter_file_names_below(template_path))
        }
        altered_names = [
            name
            for name, expected_digest in template_digests.items()
            if describe_template_object_damage(store_path, name, expected_digest)
        ]
        if not (attributes or "zarr.json" in study_store.read_manifest_digests(store_path)):
            _refuse_unproven_study(store_path, study, template_path, altered_names)
        for name in altered_names:
            atomic_write(store_path / name, (template_path / name).read_bytes())
    return altered_names


def _refuse_unreproducible_template(store_path: Location, template_path: Path) -> None:
    """Raise a StoreError if newly made objects of a template differ from the manifest's digests.

    Damaged lines of the manifest are ignored. `template_path` is the folder of the new objects.
    """
    for name, expected_digest in study_store.read_manifest_digests(store_path).items():
        if describe_template_object_damage(template_path, name, expected_digest):
            raise StoreError(
                f"{name} of {store_path} can't be made again as it was on this machine, or from "
                "this "
                "spec: put it back from a copy, or run the study anew into another store"
            )


def _refuse_unproven_study(
    store_path: Location, study: BlockStudy, template_path: Path, altered_names: list[str]
) -> None:
    """Raise a StoreError if an object of a store, or its first block, belongs to another study.

    This check replaces digests of the template that are lost.
    """
    if other_names := set(altered_names) - {"zarr.json", study_store.MANIFEST_PATH}:
        raise StoreError(
            f"{store_path} holds another study, or too little is left: {min(other_names)} differs"
        )
    committed_digests = journal.read_committed_digests(store_path, study.n_blocks)
    for block in (committed_digests != b"").nonzero()[0][:1].tolist():
        stored_block = study_store.BlockWriter(template_path, study).write(
            block, study.evaluate(block)
        )
        for name in study_store.chunk_names_of_block(study, block):
            (template_path / name).unlink()
        if stored_block.digest.encode() != committed_digests[block]:
            raise StoreError(
                f"{store_path} holds another study: its block {block} has other results"
            )


SHARD_BYTES_MAX = 64 << 20
"""Largest size of a shard (file of several chunks) before compression [bytes].

A thread that writes a shard holds all of it in memory.
"""


def pack_store(
    store_path: str | Location, output: str | Location, *, progress: bool | Progress = True
) -> Location:
    """Copy a complete store into a store of few files with many chunks each.

    Parameters
    ----------
    store_path, output
        Paths of the store and of its copy. The copy is written completely, or not at all.
    progress
        True for a bar or lines on standard error, False for none, or a `Progress`.

    Returns
    -------
    Location
        Path of the copy.

    Raises
    ------
    StoreError
        If the store is incomplete or packed already, if something is at the path of the copy, or if
        the copy can't be written and read back.
    """
    store_path, output = parse_location(store_path).absolute(), parse_location(output).absolute()
    attributes, study = study_loading.read_study_and_check_blocks(store_path)
    n_missing = study.n_blocks - int(np.count_nonzero(committed_block_mask(store_path, study)))
    if attributes.get(PACKED_ATTRIBUTE) or n_missing:
        reason = (
            "is packed already"
            if attributes.get(PACKED_ATTRIBUTE)
            else f"lacks {number_with_noun(n_missing, 'block')}: resume it"
        )
        raise StoreError(f"{store_path} {reason}")
    if not can_create_store(output):
        raise StoreError(f"{output} is there already: name another place")
    listener = make_progress(progress)
    with raise_as_store_error(f"{output} can't be made"):
        if isinstance(output, Path):
            with write_path_atomically(output) as draft_path:
                draft_path.mkdir()
                _write_packed_store(store_path, draft_path, study, listener)
                study_store.sync_file_system(
                    draft_path
                )  # otherwise a power failure may leave the name without the values
        else:
            with study_store.reserve_object_location(output):
                _write_packed_store(store_path, output, study, listener)
    return output


def _write_packed_store(
    store_path: Location, output: Location, study: BlockStudy, progress: Progress
) -> None:
    """Write a copy of a store in few large files (shards). The root metadata are written last."""
    attributes = {**study_loading.read_study(store_path).attributes, PACKED_ATTRIBUTE: True}
    with tempfile.TemporaryDirectory() as directory:
        template = Path(directory) / "template"
        study_store.build_template(template, study, attributes, shard_shape_of=shard_shape_of_array)
        root_document = (template / "zarr.json").read_bytes()
        for name in file_sizes_below(template).keys() - {"zarr.json", study_store.MANIFEST_PATH}:
            atomic_write(output / name, (template / name).read_bytes())
    names, arrays = sorted(study.chunk_owner_blocks()), open_verified_group(store_path)
    progress.begin(points=len(names), done=0, unit="arrays")
    try:
        for name in names:
            with translate_object_store_errors(store_path), translate_object_store_errors(output):
                _pack_array(arrays[name], output / name)
            progress.advance(points=1, failed=0)
    finally:
        progress.end()
    if study_loading.read_study(store_path).attributes["study_id"] != study.id:
        raise StoreError(f"{store_path} was extended or replaced while it was copied: try again")
    for name in (*LOG_FILE_NAMES, RECIPE_FILE):
        lines = iter_log_records(store_path / JOURNAL_DIR / name)
        # without the name of the machine, as copies are given to others
        anonymous_lines = [
            {key: value for key, value in line.items() if key not in ("host", "pid")}
            for line in lines
        ]
        if content := b"".join(map(encode_log_record, anonymous_lines)):
            atomic_write(output / JOURNAL_DIR / name, content)
    names = [name for name in file_sizes_below(output) if not name.startswith(f"{JOURNAL_DIR}/")]
    digests = {name: stored_objects_digest(output, [name]) for name in names}
    digests["zarr.json"] = contents_digest([("zarr.json", root_document)])
    study_store.write_manifest(output, attributes, digests)
    atomic_write(output / "zarr.json", root_document)


def _pack_array(source: Any, output: Location) -> None:
    """Copy an array shard by shard (file by file). Compare each shard with its source.

    OSError is raised if a shard reads back differently.
    """
    target = zarr.open_array(to_zarr_store(output), mode="r+")
    target = target.with_config({"write_empty_chunks": True})  # else chunks of fill values are lost
    dims = tuple(map(str, range(target.ndim)))
    shard_grid = BlockGrid(dims, target.shape, target.shards or target.chunks)
    with ThreadPoolExecutor(N_READER_THREADS) as pool:
        for _ in pool.map(
            lambda shard: _copy_region(source, target, shard_grid.block_slices(shard)),
            range(shard_grid.n_blocks),
        ):
            pass


def _copy_region(
    source: zarr.Array[Any], target: zarr.Array[Any], region: tuple[slice, ...]
) -> None:
    """Copy a region of an array to another array, and compare it after reading it back.

    OSError is raised if the copy differs.
    """
    values = np.asarray(source[region or ...])
    target[region or ...] = values
    read_back = np.asarray(target[region or ...])
    if read_back.tobytes() != values.tobytes():
        raise OSError(5, f"{target.path} does not read back as it was written")


def shard_shape_of_array(layout: ArrayLayout) -> tuple[int, ...] | None:
    """Return the shape of an array's shards (files of several chunks); None if it gets no shards.

    A shard is filled along the last axis first.
    """
    if layout.known_values is not None:
        return None
    chunks_left = SHARD_BYTES_MAX // max(1, layout.nbytes_of_part(layout.chunks))
    counts = [1] * len(layout.shape)
    for k in reversed(range(len(counts))):
        counts[k] = max(1, min(-(-layout.shape[k] // layout.chunks[k]), chunks_left))
        chunks_left //= counts[k]
    if math.prod(counts) == 1:
        return None
    return tuple(count * chunk for count, chunk in zip(counts, layout.chunks, strict=True))
