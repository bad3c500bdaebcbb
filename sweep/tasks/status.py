"""How far a store is, seen from any process, whoever works on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.storage.locations import Location, located
from sweep.tasks import journal, lock, studies


@dataclass(frozen=True, kw_only=True)
class Status:
    """How far a store is."""

    store: Location
    title: str
    study_id: str
    unit: str  # what the points are called
    points: int
    points_done: int
    blocks: int
    blocks_done: int
    failures: dict[int, dict[str, Any]]  # of blocks that are not done, by block
    holder: lock.Holder | None  # who writes to it
    holder_lives: bool
    rate: float  # points a second in the last run, 0 where none committed anything

    @property
    def complete(self) -> bool:
        """Whether every block is committed."""
        return self.blocks_done == self.blocks


def status(store: str | Location) -> Status:
    """How far a store is.

    Raises
    ------
    StoreError
        Where there is no store of sweep's.
    """
    path = located(store)
    attributes, study = studies.read(path)
    done = journal.committed(path, study)
    holder = lock.holder(path)
    return Status(
        store=path,
        title=attributes.get("title", ""),
        study_id=attributes["study_id"],
        unit=study.unit,
        points=study.points,
        points_done=study.points_in(done),
        blocks=study.n_blocks,
        blocks_done=int(np.count_nonzero(done)),
        failures=journal.given_up(path, done.size),
        holder=holder,
        holder_lives=holder is not None and lock.is_live(path, holder),
        rate=_rate(path),
    )


def _rate(path: Location) -> float:
    begun = [s["time"] for s in journal.sessions(path) if s.get("event") == "begun"]
    if not begun:
        return 0.0
    points, last = 0, begun[-1]
    for receipt in journal.read_lines(journal.receipts_path(path)):
        if receipt.get("time", 0.0) >= begun[-1]:
            points += receipt["points"]
            last = max(last, receipt["time"])
    return points / (last - begun[-1]) if points else 0.0
