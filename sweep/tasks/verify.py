"""Every byte of a store held against its digests; a finished store copied into few large files.

Everything that a store held before there were results follows from the study, so that any of it can
be made again, to the same bytes. A copy is checked value by value as it is made.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import zarr

from sweep.messages import counted, suggestion
from sweep.storage import opening
from sweep.storage.foreign import foreign_names
from sweep.storage.locations import (
    JOURNAL,
    PACKED,
    PARTIAL,
    Location,
    ObjectPath,
    draft,
    eyepoints_path,
    files_below,
    in_words,
    is_free,
    located,
    names_below,
    put_whole,
    read_object,
    settle,
    zarr_store,
)
from sweep.storage.opening import digest, digest_of, has_digest, read_lines, read_sealed, sealed
from sweep.storage.sound import CHUNK, chunk_damage, open_arrays
from sweep.tasks import journal, store, studies
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.journal import LOGS, RECIPE, committed, read_recipe
from sweep.tasks.progress import Progress, StoreError, chosen, told
from sweep.tasks.store import Damage, altered, wrong_with
from sweep.tasks.studies import AnyStudy
from sweep.tasks.study import ArrayLayout, BlockGrid, Study

if TYPE_CHECKING:
    from sweep.spec import SceneSpec, Spec

#: Blocks that are read at a time, and by how many threads: reading is waiting.
BATCH = 256
THREADS = 4


@dataclass(frozen=True, kw_only=True)
class Report:
    """State that a store was found in."""

    store: Location
    blocks: int
    whole: int  # blocks that are committed and undamaged
    damages: tuple[Damage, ...]
    restored: tuple[str, ...]  # objects of the template that were put back
    foreign: tuple[str, ...]  # files that users and other programs have put there
    unmarked: str  # why damaged blocks could not be marked for `resume`; empty where they are

    @property
    def sound(self) -> bool:
        """Tell whether nothing is damaged."""
        return not self.damages

    @property
    def complete(self) -> bool:
        """Tell whether every block is committed and undamaged."""
        return self.whole == self.blocks


def verify(
    path: str | Location,
    *,
    repair: bool = False,
    spec: Spec | SceneSpec | None = None,
    progress: bool | Progress = True,
) -> list[Report]:
    """Check every byte of a store, and of the eyepoints that its study looks with.

    Receipts of damaged blocks are withdrawn, so that `resume` computes them again, where nobody
    writes to the store. `repair` puts back metadata, coordinates and the spec; a `spec` says
    what the store holds where that no longer says so itself.

    StoreError where there is no store of this program's, or one of another study than `spec`;
    where it can't be repaired.
    """
    path, shown = located(path).absolute(), chosen(progress)
    settle(path)
    study = _study(path, spec if repair else None)
    stores: dict[Location, AnyStudy | None] = {path: study}
    if isinstance(study, FlightStudy):
        stores |= {eyepoints_path(path, each.id): each for each in study.eyepoint_studies()}
    return [_verify(each, held, repair, shown) for each, held in stores.items() if each.exists()]


def _study(path: Location, spec: Spec | SceneSpec | None) -> AnyStudy | None:
    """Return the study in a store; None if it holds none, or it can't be told."""
    try:
        attributes = _made_with(path)
    except StoreError:
        if spec is None or not path.exists():
            raise
        return studies.study_of(spec, path)
    if spec and attributes["study_id"] != spec.id:
        raise StoreError(
            f"{path} holds another study than the spec: {suggestion('status', path)} names it"
        )
    if (
        attributes["kind"] == studies.ACCURACY
        or (attributes["kind"] == "eyepoints" and not read_recipe(path))
        or PACKED in attributes
    ):
        return None
    return studies.study_of(spec, path) if spec else studies.described(path, attributes)


def _verify(path: Location, study: AnyStudy | None, repair: bool, shown: Progress) -> Report:
    found, restored = store.damages(path), []
    if found and study and repair:
        store.refuse_foreign(path)  # a lock would be the first thing of ours in it
        with journal.Lock(path, shown.say):
            found, restored = [], restore(path, study)
    logs = _of_logs(path)
    blocks = list(_of_blocks(path, study, shown)) if study else []
    surplus = [] if store.damages(path) else _surplus(path, study)
    return Report(
        store=path,
        blocks=study.n_blocks if study else 0,
        whole=_whole(path, study, blocks) if study else 0,
        damages=(*found, *logs, *blocks, *surplus),
        restored=tuple(restored),
        foreign=tuple(_foreign(path)),
        unmarked=_mark(path, blocks, shown) if logs or blocks else "",
    )


def _whole(path: Location, study: Study, damages: list[Damage]) -> int:
    done = journal.receipted(path, study)
    done[[damage.block for damage in damages]] = False
    return int(np.count_nonzero(done))


def _of_logs(path: Location) -> list[Damage]:
    """Damaged lines of the journal; the last of a log that is being written may be unfinished."""
    unfit = opening.unfit_in_journal(path)
    holder = None if unfit else journal.holder(path)
    alive = holder is not None and journal.is_live(path, holder)
    return [Damage(name, what, mended_by="hand") for name, what in unfit.items()] + [
        Damage(f"{JOURNAL}/{name} line {number}", "is damaged or cut short")
        for name in (*journal.LOGS, RECIPE)
        for number, (line, record) in enumerate(read_sealed(path / JOURNAL / name), start=1)
        if record is None and not (alive and not line.endswith(b"\n"))
    ]


def _foreign(path: Location) -> list[str]:
    """Names of what users and other programs have put into a store."""
    if isinstance(path, Path):
        return foreign_names(path)
    listed = store.digests(path)
    names = (name for name in names_below(path) if not name.startswith(f"{JOURNAL}/"))
    arrays = {name.removesuffix("/zarr.json") for name in listed}
    return [n for n in names if n not in listed and store.array_of(n) not in arrays]


def _surplus(path: Location, study: AnyStudy | None) -> Iterator[Damage]:
    """Chunks of arrays that are no part of a store; drafts of killed writers are not told."""
    listed = store.digests(path)
    grids = {name: owner.shape for name, owner in study.owners().items()} if study else {}
    for name in names_below(path):
        if name in listed or name.startswith(f"{JOURNAL}/") or name.endswith(PARTIAL):
            continue
        chunk = CHUNK.fullmatch(name)
        if not (chunk and f"{chunk[1]}/zarr.json" in listed):
            continue  # told as foreign
        if not study:
            continue  # only who made it could tell which chunks it has
        array, place = chunk[1], chunk[2].split("/")[1:]
        grid = grids.get(array, (0,))
        if len(place) != len(grid) or any(int(i) >= n for i, n in zip(place, grid, strict=True)):
            yield Damage(name, "is no part of the store", mended_by="hand")


def _of_blocks(path: Location, study: Study, shown: Progress) -> Iterator[Damage]:
    """Damages of the blocks that were committed."""
    committed = journal.digests(path, study.n_blocks)
    blocks = np.flatnonzero(committed != b"")
    shown = shown if len(blocks) > BATCH else Progress()  # what is over soon shows nothing
    shown.begin(points=len(blocks), done=0, unit="blocks")
    try:
        with ThreadPoolExecutor(THREADS) as pool:
            for start in range(0, len(blocks), BATCH):
                batch = [int(block) for block in blocks[start : start + BATCH]]
                for found in pool.map(
                    lambda b: _of_block(path, study, b, bytes(committed[b])), batch
                ):
                    yield from found
                shown.advance(points=len(batch), failed=0)
    finally:
        shown.end()


def _of_block(path: Location, study: Study, block: int, known: bytes) -> list[Damage]:
    objects, bytes_max = store.block_objects(study, block), store.chunk_bytes_max(study)
    try:
        if has_digest(path, objects, known.decode(), bytes_max):
            return []
    except OSError:
        pass  # told below, object by object
    found = []
    for name in objects:
        if what := wrong_with(partial(_of_chunk, path, name, bytes_max(name))):
            found.append(Damage(name, what, block))
    if (
        not found
        and isinstance(path, ObjectPath)
        and has_digest(path, objects, known.decode(), bytes_max)
    ):
        return []  # answers were cut before
    count = f"one of its {counted(len(objects), 'chunk')}"
    return found or [Damage(count, "is whole but not the one that was committed", block)]


def _of_chunk(path: Location, name: str, bytes_max: int) -> str:
    """Damage of a chunk in words; read once more from an object store, as an answer may be cut."""
    what = chunk_damage(read_object(path, name, bytes_max))
    if what and isinstance(path, ObjectPath):
        content = read_object(path, name, bytes_max)
        if what := chunk_damage(content):
            (path / name).refuse_cut(content)
    return what


def _mark(path: Location, damages: list[Damage], shown: Progress) -> str:
    """Withdraw receipts of damaged blocks; why that can't be, where it can't."""
    try:
        with journal.Lock(path, shown.say), told(f"{path} can't be written"):
            log = journal.Journal(path)
            for block in sorted({damage.block for damage in damages}):
                named = [f"{d.object} {d.what}" for d in damages if d.block == block]
                log.withdraw(block, "; ".join(named))
            log.flush(now=True)
    except StoreError as error:
        return str(error)
    return ""


def _made_with(path: Location) -> dict[str, Any]:
    """Attributes that a store was made with, from its list, else from its group, if undamaged."""
    if listed := opening.listed_attributes(path):
        return opening.recognised(path, listed)
    found = opening.read_attributes(path)
    if (known := store.digests(path).get("zarr.json")) and altered(path, "zarr.json", known):
        raise StoreError(f"{path / 'zarr.json'} is damaged{opening.remedy(path)}")
    return found


def restore(path: Location, study: Study) -> list[str]:
    """Put back, each in one step, what a store held before there were results; names of objects.

    The caller holds the store's lock. StoreError where this machine can't make the same again.
    """
    store.refuse_links(path)
    try:
        written = _made_with(path)
    except StoreError:
        written = {}
    if written:
        store.refuse_other_versions(path, written, where="this machine")
    if written.get("study_id", study.id) != study.id:
        raise StoreError(f"{path / 'zarr.json'} is damaged{opening.remedy(path)}")
    with told(f"{path} can't be mended"), tempfile.TemporaryDirectory() as directory:
        aside = Path(directory) / path.name
        store.build(aside, study, written or store.new_attributes(study))
        _refuse_different(path, aside)
        made = {name: digest(aside, [name]) for name in sorted(names_below(aside))}
        wrong = [name for name, known in made.items() if altered(path, name, known)]
        if not (written or "zarr.json" in store.digests(path)):
            _refuse_unproven(path, study, aside, wrong)
        for name in wrong:
            put_whole(path / name, (aside / name).read_bytes())
    return wrong


def _refuse_different(path: Location, aside: Path) -> None:
    """Refuse to put back what an undamaged line of the list says is not what was there."""
    for name, known in store.digests(path).items():
        if altered(aside, name, known):
            raise StoreError(
                f"{name} of {path} can't be made again as it was on this machine, or from this "
                "spec: put it back from a copy, or run the study anew into another store"
            )


def _refuse_unproven(path: Location, study: Study, aside: Path, wrong: list[str]) -> None:
    """Refuse a spec that makes other arrays or results, where all else that could tell is lost."""
    if others := set(wrong) - {"zarr.json", store.LIST}:
        raise StoreError(
            f"{path} holds another study, or too little is left: {min(others)} differs"
        )
    committed = journal.digests(path, study.n_blocks)
    for block in (committed != b"").nonzero()[0][:1].tolist():
        written = store.Arrays(aside, study).write(block, study.evaluate(block))
        for name in store.block_objects(study, block):
            (aside / name).unlink()
        if written.digest.encode() != committed[block]:
            raise StoreError(f"{path} holds another study: its block {block} has other results")


#: Bytes of a shard, before compression, as far as whole chunks allow; one a thread is in memory.
SHARD_BYTES = 64 << 20


def pack(
    path: str | Location, output: str | Location, *, progress: bool | Progress = True
) -> Location:
    """Copy a complete store into one of few files, each many chunks: whole, or not at all.

    StoreError where it is not complete, where something is in the way of the copy, or it can't
    be written or read back as it was.
    """
    path, output = located(path).absolute(), located(output).absolute()
    attributes, study = studies.read(path)
    left = study.n_blocks - int(np.count_nonzero(committed(path, study)))
    if attributes.get(PACKED) or left:
        why = (
            "is packed already"
            if attributes.get(PACKED)
            else f"lacks {counted(left, 'block')}: resume it"
        )
        raise StoreError(f"{path} {why}")
    if not is_free(output):
        raise StoreError(f"{output} is there already: name another place")
    shown = chosen(progress)
    with told(f"{output} can't be made"):
        if isinstance(output, Path):
            with draft(output) as aside:
                aside.mkdir()
                _pack(path, aside, study, shown)
                store.sync(aside)  # else a power cut may leave the name without the values
        else:
            with store.making(output):
                _pack(path, output, study, shown)
    return output


def _pack(path: Location, output: Location, study: Study, shown: Progress) -> None:
    """Write a packed copy, the document of its group last."""
    attributes = {**studies.read(path)[0], PACKED: True}
    with tempfile.TemporaryDirectory() as directory:
        template = Path(directory) / "template"
        store.build(template, study, attributes, shards=shard_shape)
        root = (template / "zarr.json").read_bytes()
        for name in files_below(template).keys() - {"zarr.json", store.LIST}:
            put_whole(output / name, (template / name).read_bytes())
    names, arrays = sorted(study.owners()), open_arrays(path)
    shown.begin(points=len(names), done=0, unit="arrays")
    try:
        for name in names:
            with in_words(path), in_words(output):
                _pack_array(arrays[name], output / name)
            shown.advance(points=1, failed=0)
    finally:
        shown.end()
    if studies.read(path)[0]["study_id"] != study.id:
        raise StoreError(f"{path} was extended or replaced while it was copied: try again")
    for name in (*LOGS, RECIPE):
        lines = read_lines(path / JOURNAL / name)
        # without the machine, as copies are given away
        given = [{k: v for k, v in line.items() if k not in ("host", "pid")} for line in lines]
        if content := b"".join(map(sealed, given)):
            put_whole(output / JOURNAL / name, content)
    names = [name for name in files_below(output) if not name.startswith(f"{JOURNAL}/")]
    digests = {name: digest(output, [name]) for name in names}
    digests["zarr.json"] = digest_of([("zarr.json", root)])
    store.list_objects(output, attributes, digests)
    put_whole(output / "zarr.json", root)


def _pack_array(source: Any, output: Location) -> None:
    """Copy an array, shard by shard, and read each back."""
    target = zarr.open_array(zarr_store(output), mode="r+")
    target = target.with_config({"write_empty_chunks": True})  # else one of fill values is lost
    dims = tuple(map(str, range(target.ndim)))
    files = BlockGrid(dims, target.shape, target.shards or target.chunks)
    with ThreadPoolExecutor(THREADS) as pool:
        for _ in pool.map(lambda n: _copy(source, target, files.block(n)), range(files.n_blocks)):
            pass


def _copy(source: zarr.Array[Any], target: zarr.Array[Any], part: tuple[slice, ...]) -> None:
    values = np.asarray(source[part or ...])
    target[part or ...] = values
    back = np.asarray(target[part or ...])
    if back.tobytes() != values.tobytes():
        raise OSError(5, f"{target.path} does not read back as it was written")


def shard_shape(layout: ArrayLayout) -> tuple[int, ...] | None:
    """Whole chunks along each axis that make a file, the last axis filled first; or None."""
    if layout.values is not None:
        return None
    room = SHARD_BYTES // max(1, layout.bytes_of(layout.chunks))
    counts = [1] * len(layout.shape)
    for k in reversed(range(len(counts))):
        counts[k] = max(1, min(-(-layout.shape[k] // layout.chunks[k]), room))
        room //= counts[k]
    if math.prod(counts) == 1:
        return None
    return tuple(count * chunk for count, chunk in zip(counts, layout.chunks, strict=True))
