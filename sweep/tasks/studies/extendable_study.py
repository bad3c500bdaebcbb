"""Studies that are declared by a spec, and may take results from the store of a smaller study."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from sweep.model import MODEL_VERSION
from sweep.tasks.engine.block_study import BlockStudy

CHUNK_READ_ERRORS = (OSError, ValueError, RuntimeError)
"""Exceptions that Zarr raises for a chunk that is missing or damaged."""


class ExtendableStudy(BlockStudy):
    """Base of studies that may be extended to a larger study, or may extend a smaller one.

    `find_reuse_source` returns the results of a smaller study, or None.
    """

    model_version = MODEL_VERSION

    def __init__(self, spec: Any) -> None:
        self.spec = spec
        self.find_reuse_source: Callable[[], Any] = lambda: None

    @cached_property
    def reuse_source(self) -> Any:
        """Results of the smaller study that this study extends; None if it extends none.

        The smaller study's store is opened when this attribute is first read.
        """
        return self.find_reuse_source()

    @property
    def id(self) -> str:
        """Hash of all entries of the spec that results depend on."""
        return str(self.spec.id)

    @abstractmethod
    def has_numerics_set_by_tolerance(self, block: int) -> np.ndarray | bool:
        """Return True for each point of a block whose numerics depend on the tolerance.

        The result is a mask (points,), or one bool for all points. Numerics are numbers of rays and
        error limits. The choice of effects, which always depends on the tolerance, does not count.
        """

    def block_of_first_draws(self, block: int) -> int:
        """Return the number of the block that holds the first draws of the points in block `block`.

        The block with the first draws also holds the results that do not depend on draws.
        """
        return block

    def pop_reused_point_count(self, block: int) -> int:
        """Return how many points of a block were taken from the smaller study's store.

        The count is deleted, so that a second call returns 0.
        """
        reuse_source = self.reuse_source
        return reuse_source.reused_points_by_block.pop(block, 0) if reuse_source else 0

    def count_reusable_points_of_block(self, block: int) -> int:
        """Return how many points of a block are in the smaller study's store, damaged or not."""
        shared_point_groups = (
            self.reuse_source.iter_shared_points(block) if self.reuse_source else ()
        )
        return (
            sum(shared_points.indices_in_block.size for shared_points in shared_point_groups)
            * self.locate_block(block).grid.fine_steps
        )
