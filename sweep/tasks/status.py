"""State of a store, seen from any process, whoever works on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sweep.storage.locations import PACKED, Location, files_below, located
from sweep.storage.logs import read_receipts
from sweep.tasks import journal, lock, studies
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.journal import begun_points


@dataclass(frozen=True, kw_only=True)
class Status:
    """State of a store."""

    store: Location
    title: str
    study_id: str
    unit: str  # what the points are called
    points: int
    points_done: int
    blocks: int
    blocks_done: int
    points_begun: float  # drawn in part, in blocks that take long
    failures: dict[int, dict[str, Any]]  # of blocks that are not done, by block
    holder: lock.Holder | None  # who writes to it
    holder_lives: bool
    draws_done: int  # where each point has a fixed number; else 0
    bytes: int  # of all results, as they were stored; of a packed copy all its files
    rate: float  # points a second in the last run, 0 where none committed anything
    workers: int  # processes that computed in the last run
    heartbeat: float  # age of its holder's last sign of life [s]; infinite without one

    @property
    def complete(self) -> bool:
        """Tell whether every block is committed."""
        return self.blocks_done == self.blocks

    @property
    def left(self) -> float:
        """Seconds that are left at the rate of the last run; infinite where there is none."""
        return (self.points - self.points_done) / self.rate if self.rate else float("inf")


def status(store: str | Location) -> Status:
    """State of a store, by its log of receipts; whether all chunks are there is not looked at.

    Raises
    ------
    StoreError
        Where there is no store of sweep's.
    """
    path = located(store)
    attributes, study = studies.read(path)
    begun = journal.last_begun(path)
    receipts = read_receipts(path, study.n_blocks, since=begun)
    packed = sum(files_below(path).values()) if PACKED in attributes else 0
    holder = lock.holder(path)
    points = study.points_in(receipts.points > 0)
    spent = receipts.last - begun
    return Status(
        store=path,
        title=attributes.get("title", ""),
        study_id=attributes["study_id"],
        unit=study.unit,
        points=study.points,
        points_done=points,
        blocks=study.n_blocks,
        blocks_done=receipts.blocks,
        points_begun=sum(begun_points(path, study.id).values()),
        failures=journal.given_up(path, study.n_blocks),
        holder=holder,
        holder_lives=holder is not None and lock.is_live(path, holder),
        draws_done=points * int(study.spec.draws.number) if isinstance(study, GridStudy) else 0,
        bytes=packed or int(receipts.sizes.sum()),
        rate=receipts.recent / spent if receipts.recent and spent > 0 else 0.0,
        workers=len(receipts.workers),
        heartbeat=lock.heartbeat_age(path) if holder else float("inf"),
    )
