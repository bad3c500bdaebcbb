"""Results of a grid's blocks, read one block after the other: memory does not follow the study."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from sweep.storage.locations import Location
from sweep.storage.opening import open_group
from sweep.tasks.grid_study import GridStudy
from sweep.tasks.journal import receipted


def done_blocks(store: Location, study: GridStudy) -> np.ndarray:
    """Numbers of the blocks that have a receipt, rising."""
    return np.flatnonzero(receipted(store, study))


def pieces(
    store: Location, study: GridStudy, names: Sequence[str], blocks: np.ndarray
) -> Iterator[tuple[tuple[slice, ...], list[np.ndarray]]]:
    """Where in the grid each block is, and its values in some arrays."""
    group = open_group(store)
    arrays: list[Any] = [group[name] for name in names]
    for block in blocks:
        place = study.grid.block(int(block))
        yield place, [np.asarray(array[place or ...]) for array in arrays]
