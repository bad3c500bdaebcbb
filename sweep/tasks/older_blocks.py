"""Blocks of an older store, read for what a larger study has in common with it.

The store is only read. Each of its blocks is held against the digest in its receipt first; one that
is damaged counts as absent.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from sweep.storage import sealing
from sweep.storage.locations import Location
from sweep.storage.opening import open_group
from sweep.tasks import store
from sweep.tasks.journal import digests
from sweep.tasks.study import Results, Study

if TYPE_CHECKING:
    import zarr

#: Blocks of the older store that a process keeps in memory.
BLOCKS_KEPT = 2

#: What Zarr raises of a chunk that is not there, or not as it was written.
DAMAGED = (OSError, ValueError, RuntimeError)


class OlderBlocks:
    """The blocks of a store that were committed.

    Parameters
    ----------
    path, study
        The store, and the study in it.
    """

    def __init__(self, path: Location, study: Study) -> None:
        self._path, self._study = path, study
        self._digests = digests(path, study.n_blocks)
        self.read = lru_cache(maxsize=BLOCKS_KEPT)(self._read)

    def has(self, block: int) -> bool:
        """Whether a block was committed."""
        return bool(self._digests[block])

    def _read(self, block: int) -> Results | None:
        """Results by name, each with its chunk's shape; None where a block is damaged or lost."""
        try:
            objects = store.block_objects(self._study, block)
            if sealing.digest(self._path, objects).encode() != self._digests[block]:
                return None
            return {name: self.chunk(name, block) for name in self._study.chunks(block)}
        except DAMAGED:
            return None

    def chunk(self, name: str, block: int) -> np.ndarray:
        """A block's chunk of an array, as it is."""
        array = cast("zarr.Array[Any]", self._group[name])
        return np.asarray(array.blocks[self._study.chunks(block)[name]])

    @cached_property
    def _group(self) -> zarr.Group:
        return open_group(self._path)
