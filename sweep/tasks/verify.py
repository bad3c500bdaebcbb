"""Every byte of a store held against the digests that were taken as it was written."""

from __future__ import annotations

import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import google_crc32c
import numpy as np

from sweep.storage import sealing
from sweep.storage.atomic_replace import settle
from sweep.storage.locations import JOURNAL, PACKED, PARTIAL, Location, located, names_below
from sweep.storage.sealing import damaged_lines, read_sealed
from sweep.tasks import identity, journal, lock, store, studies, template
from sweep.tasks.errors import StoreError
from sweep.tasks.eyepoint_study import eyepoints_path
from sweep.tasks.flight_study import FlightStudy
from sweep.tasks.journal import Journal
from sweep.tasks.progress import Late, Progress, chosen
from sweep.tasks.recipe import RECIPE, read_recipe
from sweep.tasks.studies import AnyStudy
from sweep.tasks.study import Study
from sweep.tasks.template import Damage

if TYPE_CHECKING:
    from sweep.spec import SceneSpec, Spec

#: Blocks that are read at a time, and by how many threads: reading is waiting.
BATCH = 256
THREADS = 4

#: Name of a chunk: its array, and its place in it.
CHUNK = re.compile(r"(.+)/c((?:/\d+)*)")


@dataclass(frozen=True, kw_only=True)
class Report:
    """What a store was found to be."""

    store: Location
    blocks: int
    whole: int  # blocks that are committed and undamaged
    damages: tuple[Damage, ...]
    restored: tuple[str, ...]  # objects of the template that were put back
    unmarked: str  # why damaged blocks could not be marked for `resume`; empty where they are

    @property
    def sound(self) -> bool:
        """Whether nothing is damaged."""
        return not self.damages

    @property
    def complete(self) -> bool:
        """Whether every block is committed and undamaged."""
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
    writes to the store. Whole lines that are missing at the end of a log are not seen as such: the
    blocks of missing receipts count as not done.

    Parameters
    ----------
    path
        The store.
    repair
        Whether to put back what was in the store before there were results: metadata,
        coordinates, the spec.
    spec
        The study that the store holds, to repair one that no longer says so itself.
    progress
        As in `run`; shown after two seconds.

    Returns
    -------
    list of Report
        Of the store, and of each eyepoint store that is there.

    Raises
    ------
    StoreError
        Where there is no store, or not one of this program's, or one of another study than
        `spec`; where it can't be repaired.
    """
    path, told = located(path).absolute(), Late(chosen(progress))
    settle(path)
    study = _study(path, spec if repair else None)
    stores: dict[Location, AnyStudy | None] = {path: study}
    if isinstance(study, FlightStudy):
        stores |= {eyepoints_path(path, each.id): each for each in study.eyepoint_studies()}
    return [_verify(each, held, repair, told) for each, held in stores.items() if each.exists()]


def _study(path: Location, spec: Spec | SceneSpec | None) -> AnyStudy | None:
    """The study in a store; None where it holds none, or only who made it could tell."""
    try:
        attributes = template.attributes(path)
    except StoreError:
        if spec is None or not path.exists():
            raise
        return studies.study_of(spec, path)
    if spec and attributes["study_id"] != spec.id:
        raise StoreError(f"{path} holds another study than the spec: `sweep status` names it")
    if (
        attributes["kind"] == studies.ACCURACY
        or (attributes["kind"] == "eyepoints" and not read_recipe(path))
        or PACKED in attributes
    ):
        return None
    return studies.study_of(spec, path) if spec else studies.described(path, attributes)


def _verify(path: Location, study: AnyStudy | None, repair: bool, told: Progress) -> Report:
    found, restored = template.damages(path), []
    if found and study and repair:
        found, restored = [], _restore(path, study)
    logs = _of_logs(path)
    blocks = list(_of_blocks(path, study, told)) if study else []
    surplus = [] if template.damages(path) else _surplus(path, study)
    return Report(
        store=path,
        blocks=study.n_blocks if study else 0,
        whole=_whole(path, study, blocks) if study else 0,
        damages=(*found, *logs, *blocks, *surplus),
        restored=tuple(restored),
        unmarked=_mark(path, blocks) if logs or blocks else "",
    )


def _whole(path: Location, study: Study, damages: list[Damage]) -> int:
    done = journal.receipted(path, study)
    done[[damage.block for damage in damages]] = False
    return int(np.count_nonzero(done))


def _restore(path: Location, study: AnyStudy) -> list[str]:
    identity.refuse_foreign(path)  # a lock would be the first thing of ours in it
    held = lock.Lock(path)
    try:
        return template.restore(path, study)
    finally:
        held.release()


def _of_logs(path: Location) -> list[Damage]:
    """Damaged lines of the journal; the last of a log that is being written may be unfinished."""
    holder = lock.holder(path)
    alive = holder is not None and lock.is_live(path, holder)
    found = []
    for name in (*journal.LOGS, RECIPE):
        file = path / store.JOURNAL / name
        unfinished = _unfinished(file) if alive else 0
        found += [
            Damage(f"{store.JOURNAL}/{name} line {number}", "is damaged or cut short")
            for number in damaged_lines(file)
            if number != unfinished
        ]
    return found


def _unfinished(log: Location) -> int:
    """Number of a log's last line where it has no end, else 0."""
    number = 0
    for number, (line, _) in enumerate(read_sealed(log), start=1):
        if not line.endswith(b"\n"):
            return number
    return 0


def _surplus(path: Location, study: AnyStudy | None) -> Iterator[Damage]:
    """Files of a store that are no part of it; drafts of writers that were killed are not told."""
    listed = template.digests(path)
    grids = {name: owner.shape for name, owner in study.owners().items()} if study else {}
    for name in names_below(path):
        if name in listed or name.startswith(f"{JOURNAL}/") or name.endswith(PARTIAL):
            continue
        chunk = CHUNK.fullmatch(name)
        array, place = (chunk[1], chunk[2].split("/")[1:]) if chunk else ("", [])
        if chunk and not study and f"{array}/zarr.json" in listed:
            continue  # only who made it could tell which chunks it has
        grid = grids.get(array, (0,))
        if len(place) != len(grid) or any(int(i) >= n for i, n in zip(place, grid, strict=True)):
            yield Damage(name, "is no part of the store", mended_by="hand")


def _of_blocks(path: Location, study: Study, told: Progress) -> Iterator[Damage]:
    """Damages of the blocks that were committed."""
    digests = journal.digests(path, study.n_blocks)
    blocks = np.flatnonzero(digests != b"")
    told.begin(points=len(blocks), done=0, unit="blocks")
    try:
        with ThreadPoolExecutor(THREADS) as pool:
            for start in range(0, len(blocks), BATCH):
                batch = [int(block) for block in blocks[start : start + BATCH]]
                for found in pool.map(
                    lambda b: _of_block(path, study, b, bytes(digests[b])), batch
                ):
                    yield from found
                told.advance(points=len(batch), failed=0)
    finally:
        told.end()


def _of_block(path: Location, study: Study, block: int, digest: bytes) -> list[Damage]:
    objects = store.block_objects(study, block)
    try:
        if sealing.digest(path, objects) == digest.decode():
            return []
    except OSError:
        pass  # told below, object by object
    found = [Damage(name, what, block) for name in objects if (what := _wrong(path / name))]
    count = f"one of its {len(objects)} chunks"
    return found or [Damage(count, "is whole but not the one that was committed", block)]


def _wrong(chunk: Location) -> str:
    """What is wrong with a chunk, by the checksum that Zarr's codec put at its end."""
    try:
        content = chunk.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return "is missing"
    except OSError as error:
        return f"can't be read: {error.strerror}"
    if not content:
        return "is empty"
    checksum = google_crc32c.value(content[:-4]).to_bytes(4, "little")
    return "" if content[-4:] == checksum else "fails its checksum"


def _mark(path: Location, damages: list[Damage]) -> str:
    """Withdraw receipts of damaged blocks; why that can't be, where it can't."""
    try:
        held = lock.Lock(path)
    except StoreError as error:
        return str(error)
    try:
        log = Journal(path)
        for block in sorted({damage.block for damage in damages}):
            named = [f"{d.object} {d.what}" for d in damages if d.block == block]
            log.withdraw(block, "; ".join(named))
        log.flush(now=True)
    except OSError as error:
        return f"{path} can't be written: {error.strerror or error}"
    finally:
        held.release()
    return ""
