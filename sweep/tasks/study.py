"""What every kind of study is to those that run it: blocks, and arrays that take them."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

Results = dict[str, np.ndarray]


class Found(NamedTuple):
    """Results of some points of a block."""

    points: np.ndarray
    """(m,) int64: their numbers in C order over the block."""
    results: Results
    """(m, ...) each, by name."""


NONE_FOUND = Found(np.zeros(0, np.int64), {})


class Known(NamedTuple):
    """What is known of a block before it is computed."""

    done: Found = NONE_FOUND
    """Points that need not be computed."""
    begun: Found = NONE_FOUND
    """Points that were drawn less often."""


def together(found: Sequence[Found]) -> Found:
    """Results of several parts of a block as one; the names are those of the first."""
    if not found:
        return NONE_FOUND
    names = found[0].results
    return Found(
        np.concatenate([each.points for each in found]),
        {name: np.concatenate([each.results[name] for each in found]) for name in names},
    )


@dataclass
class Stop:
    """Time that a piece of a block's work may take: asked between draws whether it is over."""

    at: float = float("inf")
    """By `time.monotonic`."""
    told: bool = False
    """Tell whether it was over when asked."""

    def __call__(self) -> bool:
        """Tell whether the time is over."""
        self.told = self.told or time.monotonic() >= self.at
        return self.told


class Unfinished(Exception):
    """A block was stopped: what there is of it, and to how many points that comes."""

    def __init__(self, known: Known, points: float) -> None:
        super().__init__()
        self.known, self.points = known, points


@dataclass(frozen=True, kw_only=True)
class ArrayLayout:
    """An array of a store.

    Parameters
    ----------
    name
        Its path inside the store, ``range`` or ``group/range``.
    shape, chunks, dims, dtype
        As Zarr has them; text has the type ``string``.
    fill
        What stands where nothing is written.
    attributes
        Units, name in words and so on.
    values
        What it holds, where that is known as the store is made; else blocks write it.
    """

    name: str
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dims: tuple[str, ...]
    dtype: str
    fill: float | int | str | None = None
    attributes: Mapping[str, Any] = field(default_factory=dict)
    values: np.ndarray | None = None

    def within(self, group: str) -> ArrayLayout:
        """The same array in a group."""
        return replace(self, name=f"{group}/{self.name}")


class Content(Protocol):
    """What a store is made of."""

    @property
    def id(self) -> str:
        """Hash of all that its results depend on."""

    def attributes(self) -> dict[str, Any]:
        """What its store says of it, but for versions; the same wherever it is made."""

    def groups(self) -> dict[str, dict[str, Any]]:
        """Groups of its store and their attributes."""

    def arrays(self) -> list[ArrayLayout]:
        """Every array of its store."""


class Study(Content, Protocol):
    """A study as the driver and its workers see it.

    No two blocks share a chunk of any array, and every chunk belongs to a block.
    """

    @property
    def unit(self) -> str:
        """What its points are called, in the plural."""

    @property
    def points(self) -> int:
        """Number of points of all blocks."""

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""

    def block_size(self, block: int) -> int:
        """Points of a block."""

    def points_in(self, blocks: np.ndarray) -> int:
        """Points in the blocks that are marked in an ndarray of bool (blocks,)."""

    def chunks(self, block: int) -> dict[str, tuple[int, ...]]:
        """Chunks that a block writes, whole: the position of one in each of some arrays."""

    def owners(self) -> dict[str, np.ndarray]:
        """Block that writes each chunk, in the shape of the grid of chunks, of every such array."""

    def evaluate(self, block: int) -> Results:
        """Results of a block by the names of its arrays, each with its chunk's shape."""

    def compile(self) -> None:
        """Compile what evaluation compiles, so that workers find it on disk."""


class Evaluate(Protocol):
    """What computes a block in place of the study itself, with the same results."""

    def __call__(self, study: Any, block: int) -> Results:
        """Results of one block by name."""
