"""Blocks still to be computed, handed out lazily; what fails comes back once, alone."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import islice

import numpy as np


class Todo:
    """Blocks of a study that are not done.

    Parameters
    ----------
    done : ndarray of bool (blocks,)
        Which blocks are done already.
    """

    def __init__(self, done: np.ndarray) -> None:
        self.left = int(done.size - np.count_nonzero(done))  # not yet handed out
        self._fresh = _numbers(done)
        self._suspects: deque[int] = deque()
        self._returned: deque[int] = deque()
        self._failed_once: set[int] = set()

    def take(self, count: int, *, suspects: bool = True) -> list[int]:
        """Up to `count` blocks for one task; one that failed before comes by itself.

        Parameters
        ----------
        count
            Most blocks.
        suspects
            Whether a block that failed before may come.
        """
        if self._suspects and suspects:
            return [self._suspects.popleft()]
        if self._returned:
            return [self._returned.popleft()]
        blocks = list(islice(self._fresh, count))
        self.left -= len(blocks)
        return blocks

    def again(self, block: int) -> bool:
        """Put a failed block back; False where this was its second failure."""
        if block in self._failed_once:
            return False
        self._failed_once.add(block)
        self._suspects.append(block)
        return True

    def put_back(self, blocks: list[int]) -> None:
        """Put blocks back whose answer was lost, by no fault of theirs, or that are begun."""
        self._returned.extend(blocks)

    @property
    def any_failed(self) -> bool:
        """Whether any block has failed so far."""
        return bool(self._failed_once)

    def attempt(self, block: int) -> int:
        """How often a block has failed so far."""
        return int(block in self._failed_once)


def _numbers(done: np.ndarray, stretch: int = 1 << 16) -> Iterator[int]:
    for start in range(0, done.size, stretch):
        yield from (start + np.flatnonzero(~done[start : start + stretch])).tolist()
