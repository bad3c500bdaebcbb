"""The log of receipts, read for what is asked of it often: which blocks are done, when, how fast.

A receipt is some 300 bytes; a million of them are read in a few seconds, into a few bytes a block.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from sweep.storage.locations import JOURNAL, Location
from sweep.storage.logs import raw_lines
from sweep.storage.sealing import body_of

RECEIPTS = "receipts.jsonl"

_HEAD = re.compile(
    rb'\{"block":(\d{1,18}),"(?:points":(\d{1,18})(?:,"bytes":(\d{1,18}))?|withdrawn")'
)
_TIME = re.compile(rb'"time":(\d{1,10}(?:\.\d{1,20})?)$')
_WORKER = re.compile(rb'"host":"([^"]*)","pid":(\d+)')


@dataclass
class Receipts:
    """What a log of receipts comes to."""

    points: np.ndarray
    """(blocks,) int64: points of every block that is committed, 0 of the others."""
    sizes: np.ndarray
    """(blocks,) int64: bytes of these as they are stored, where the receipt says."""
    first: float = np.inf
    last: float = -np.inf
    """Times of the first and last receipt [s since the epoch]."""
    recent: int = 0
    """Points committed since the time asked for."""
    workers: set[bytes] = field(default_factory=set)
    """Hosts and processes that computed them."""

    @property
    def blocks(self) -> int:
        """Number of blocks that are committed."""
        return int(np.count_nonzero(self.points))


def read_receipts(store: Location, n_blocks: int, *, since: float = np.inf) -> Receipts:
    """What the log of a store says; damaged lines count for nothing, and nor do other blocks.

    Parameters
    ----------
    store
        The store.
    n_blocks
        How many blocks its study has.
    since
        Time from which on points and workers are counted [s since the epoch].
    """
    found = Receipts(np.zeros(n_blocks, np.int64), np.zeros(n_blocks, np.int64))
    for line in raw_lines(store / JOURNAL / RECEIPTS):
        body = body_of(line)
        head = body and _HEAD.match(body)
        if not body or not head or (block := int(head[1])) >= n_blocks:
            continue
        if head[2] is None:
            found.points[block] = found.sizes[block] = 0
            continue
        points, time = int(head[2]), _TIME.search(body, len(body) - 40)
        found.points[block], found.sizes[block] = points, int(head[3] or 0)
        if time:
            _date(found, body, points, float(time[1]), since)
    return found


def _date(found: Receipts, body: bytes, points: int, time: float, since: float) -> None:
    found.first, found.last = min(found.first, time), max(found.last, time)
    if time >= since:
        found.recent += points
        if worker := _WORKER.search(body):
            found.workers.add(worker[0])
