"""Studies that are declared by a spec, and may take results from the store of a smaller study."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from sweep.model import VERSION
from sweep.tasks.engine.block_study import BlockStudy

#: Errors of Zarr at a chunk that is not there, or not as it was written.
CHUNK_READ_ERRORS = (OSError, ValueError, RuntimeError)


class ExtendableStudy(BlockStudy):
    """A study that may be extended, and may extend another."""

    model_version = VERSION

    def __init__(self, spec: Any) -> None:
        self.spec = spec
        self.find_reuse_source: Callable[[], Any] = lambda: None

    @cached_property
    def reuse_source(self) -> Any:
        """Results of a smaller study, or None; looked for as the first block is computed."""
        return self.find_reuse_source()

    @property
    def id(self) -> str:
        """Hash of the spec's identity."""
        return str(self.spec.id)

    @abstractmethod
    def depends_on_tolerance(self, block: int) -> np.ndarray | bool:
        """Mark the points of a block that a tighter tolerance computes more closely, (points,)."""

    def first_draw_block(self, block: int) -> int:
        """Block with all that the draws of a block have in common."""
        return block

    def pop_reused_points(self, block: int) -> int:
        """Return how many points of a block came from the smaller study's store, and forget it."""
        reuse_source = self.reuse_source
        return reuse_source.reused_points_by_block.pop(block, 0) if reuse_source else 0

    def count_reusable_points(self, block: int) -> int:
        """Points of a block that the smaller study has, if nothing is damaged."""
        shared = self.reuse_source.iter_shared_points(block) if self.reuse_source else ()
        return (
            sum(shared_points.local_indices.size for shared_points in shared)
            * self.locate_in_grid(block)[0].fine_steps
        )
