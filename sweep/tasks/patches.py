"""Results of a flight's block put together from patches: stretches of draws of some of its rows.

Rows are shots, or measurement cycles. What is known comes as patches, what is computed fills the
gaps between them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np

from sweep.model.outputs import STATISTICS
from sweep.tasks.study import Results


class Patch(NamedTuple):
    """Results of some rows of a block in a stretch of its draws."""

    rows: np.ndarray
    """(m,) int64: their numbers in the block."""
    draws: slice
    """Of the block's draws, counted from its first."""
    results: Results
    """(m, draws, ...) each by name; (m,) what no draw changes."""


class KnownCloud(NamedTuple):
    """What is known of a flight's block before it is computed."""

    points: Sequence[Patch] = ()
    """Of shots: their points, and their statistics."""
    navigation: Sequence[Patch] = ()
    """Of cycles all of whose shots are known in these draws."""


def completed(
    known: Sequence[Patch],
    room: tuple[int, int],
    compute: Callable[[np.ndarray, slice], Iterable[Patch]],
) -> Results:
    """Results of all rows and draws of a block.

    Parameters
    ----------
    known
        Patches that are there.
    room
        Rows and draws of the block.
    compute
        Patches that fill some rows and a stretch of draws.
    """
    computed = (compute(rows, draws) for rows, draws in gaps(known, room))
    results: Results = {}
    for patch in chain(known, chain.from_iterable(computed)):
        for name, values in patch.results.items():
            if name in STATISTICS:
                whole = (room[0], *values.shape[1:])
                results.setdefault(name, np.empty(whole, values.dtype))[patch.rows] = values
            else:
                whole = (*room, *values.shape[2:])
                array = results.setdefault(name, np.empty(whole, values.dtype))
                array[patch.rows, patch.draws] = values
    return results


def gaps(known: Iterable[Patch], room: tuple[int, int]) -> Iterator[tuple[np.ndarray, slice]]:
    """Rows and stretches of draws that no patch covers; rows that lack the same come together."""
    lacking = np.ones(room, bool)
    for patch in known:
        lacking[patch.rows, patch.draws] = False
    patterns, which = np.unique(lacking, axis=0, return_inverse=True)
    for number, pattern in enumerate(patterns):
        rows = np.flatnonzero(which.ravel() == number)
        edges = np.flatnonzero(np.diff(pattern, prepend=False, append=False))
        for first, stop in edges.reshape(-1, 2).tolist():
            yield rows, slice(first, stop)
