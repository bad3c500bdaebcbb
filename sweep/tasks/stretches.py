"""The blocks of a flight: stretches of cycles and draws, scanner by scanner."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from sweep.spec import SceneSpec

#: Shots that a cycle must have for a velocity vector.
LEAST_BEAMS = 3


class Part(NamedTuple):
    """A block: a stretch of cycles and of draws, at one place along the axes, of one scanner."""

    scanner: str
    axes: tuple[int, ...]
    draws: int  # number of its stretch of draws
    cycles: int  # number of its stretch of cycles


class Stretches:
    """The blocks of one scanner: axes, stretches of draws, stretches of cycles, the last fastest.

    Parameters
    ----------
    spec
        The study.
    scanner
        Name of the scanner.
    """

    def __init__(self, spec: SceneSpec, scanner: str) -> None:
        self.scanner = scanner
        self.total_cycles, self.shots_a_cycle = spec.cycles(scanner), spec.shots_a_cycle(scanner)
        self.draws = int(spec.draws.number)
        fitting = max(1, int(spec.storage.block_shots) // self.shots_a_cycle)
        self.block_cycles = min(self.total_cycles, fitting)
        self.block_draws = min(self.draws, int(spec.storage.block_draws))
        self.axes = tuple(int(axis.size) for axis in spec.axes)
        self.along = (
            *self.axes,
            -(-self.draws // self.block_draws),
            -(-self.total_cycles // self.block_cycles),
        )
        self.number = math.prod(self.along)

    @property
    def navigates(self) -> bool:
        """Whether a cycle has the shots that a velocity vector takes."""
        return self.shots_a_cycle >= LEAST_BEAMS

    def part(self, number: int) -> Part:
        """A block of this scanner by its number."""
        *axes, draws, cycles = (int(i) for i in np.unravel_index(number, self.along))
        return Part(self.scanner, tuple(axes), draws, cycles)

    def block(self, part: Part) -> int:
        """Number of a block of this scanner."""
        return int(np.ravel_multi_index((*part.axes, part.draws, part.cycles), self.along))

    def cycle_range(self, part: Part) -> tuple[int, int]:
        """First cycle of a block, and the one after its last."""
        first = part.cycles * self.block_cycles
        return first, min(first + self.block_cycles, self.total_cycles)

    def shot_range(self, part: Part) -> tuple[int, int]:
        """First shot of a block, and the one after its last."""
        first, stop = self.cycle_range(part)
        return first * self.shots_a_cycle, stop * self.shots_a_cycle

    def draw_range(self, part: Part) -> tuple[int, int]:
        """First draw of a block, and the one after its last."""
        first = part.draws * self.block_draws
        return first, min(first + self.block_draws, self.draws)

    def points(self, part: Part) -> int:
        """Shots times draws of a block."""
        shots, draws = self.shot_range(part), self.draw_range(part)
        return (shots[1] - shots[0]) * (draws[1] - draws[0])

    def points_in(self, blocks: np.ndarray) -> int:
        """Shots times draws of the blocks that are marked in an ndarray of bool (number,)."""
        marked = blocks.reshape(-1, *self.along[-2:]).sum(axis=0)
        draws = self._lengths(self.draws, self.block_draws)
        cycles = self._lengths(self.total_cycles, self.block_cycles)
        return int(draws @ marked @ cycles) * self.shots_a_cycle

    @staticmethod
    def _lengths(total: int, each: int) -> np.ndarray:
        """Lengths of the stretches that a whole is cut into."""
        return np.minimum(each, total - np.arange(0, total, each))
