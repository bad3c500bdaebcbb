"""Where bins lie on a window's transform, read from a table: the largest and the least magnitude.

Bounds need |W| over intervals of distance, short ones above all: bins are a whole number apart, so
that a line next to a bin has all its bins near the sidelobes' zeros. The table is the model's own
kernel, densely sampled, of any window; what it holds is what lies between the samples too.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.model.spectrum import bin_magnitudes, tangents
from sweep.model.window import Window, samples, window

REACH = 16
"""Bins of fs/L that the table reaches, at the most."""
CELLS = 64
"""Cells a bin."""
_SAMPLES = 16
"""Samples a cell."""
LEVELS = 6
"""Runs of 2, 4, .. 2^6 cells; longer ones count as all beyond."""
_CREST = 1e-3
"""Relative room for what lies between samples."""
STEEPEST = 2 * np.pi
"""Most that |dW/dy| exceeds the largest |W| from one bin nearer on. A window's transform has the
band of a sine of half a cycle a bin, whose slope is pi; sidelobes fall off by less than as much
again."""


class Sidelobes(NamedTuple):
    """Magnitudes |W| over the peak's, by distance in bins of fs/L, in cells of equal width."""

    highest: np.ndarray
    """(levels + 1, cells): largest in the 2, 4, .. cells from each on; last, in all from it on."""
    steepest: np.ndarray
    """(levels + 1, cells): likewise of |dW/dy|, y in bins of fs/L."""
    lowest: np.ndarray
    """(cells,): least from the line to the end of a cell; 0 from the main lobe's end on."""


@lru_cache(maxsize=32)
def sidelobes(name: str, length: int) -> Sidelobes:
    """The table of the window of this name and length, prepared once and kept."""
    shape = window(name, length)
    reach = max(min(REACH, length // 2 - 1), 1)
    value = _magnitudes(shape, reach) / shape.sum
    beyond, before = (
        shape.envelope[max(int(np.searchsorted(shape.reach, place, "right")) - 1, 0)]
        for place in (reach, reach - 1)
    )
    real = _real(shape, value)
    return Sidelobes(
        _runs(value, beyond),
        _runs(_slopes(shape, real), STEEPEST * before),
        _least(shape, real)[_SAMPLES::_SAMPLES].copy(),
    )


def _runs(value: np.ndarray, beyond: float) -> np.ndarray:
    """Largest in runs of cells, (levels + 1, cells)."""
    cells = np.lib.stride_tricks.sliding_window_view(value, _SAMPLES + 1)[::_SAMPLES]
    own = np.r_[(1 + _CREST) * cells.max(axis=1), np.full(2**LEVELS, beyond)]
    rows = [own]
    for level in range(LEVELS):
        rows.append(np.maximum(rows[-1], np.roll(rows[-1], -(2**level))))
    return np.array([*rows[1:], np.maximum.accumulate(own[::-1])[::-1]])[:, : len(cells)].copy()


def _magnitudes(shape: Window, reach: int) -> np.ndarray:
    """|W| at equal steps, 0 .. reach bins of fs/L."""
    steps, length = CELLS * _SAMPLES, shape.length
    kernel = shape.coefficients, shape.numerator, shape.poles, shape.edge, shape.table
    one, none, tangent = np.ones(1), np.zeros(1), tangents(length)
    found = np.empty((reach + 1, steps))
    room = np.empty((5, reach + 1))
    for i in range(steps):
        bin_magnitudes(
            0, reach, 0, np.array([-i / steps]), one, none, 1, (length, length), kernel, False,
            tangent, room[0], room[1], room[2:], False,
        )  # fmt: skip
        found[:, i] = room[0]
    return found.ravel()[: reach * steps + 1]


def _real(shape: Window, value: np.ndarray) -> np.ndarray:
    """|S| over the peak's, from |W|."""
    place = np.arange(value.size) / (CELLS * _SAMPLES)
    return np.asarray(
        np.sqrt(np.maximum(value**2 - (shape.edge / shape.sum * np.sin(np.pi * place)) ** 2, 0))
    )


def _slopes(shape: Window, real: np.ndarray) -> np.ndarray:
    """|W'| at each sample, from the steepest step of |S| beside it, and one further.

    A step over a zero of S is shorter than S' makes it, but no other beside it is.
    """
    step = np.pad(np.abs(np.diff(real)) * (CELLS * _SAMPLES), 2, mode="edge")
    steepest = np.lib.stride_tricks.sliding_window_view(step, 4).max(axis=1)
    return np.asarray(np.hypot(steepest, np.pi * shape.edge / shape.sum))


def _least(shape: Window, real: np.ndarray) -> np.ndarray:
    """Least |S| over the peak's so far: what lines of equal phase have at least in common."""
    so_far = (1 - _CREST) * np.minimum.accumulate(real)
    # |S'| <= pi sum|w| / sum w: where this is less, S may be 0 before the next sample
    steepest = np.pi * np.abs(samples(shape.name, shape.length)).sum() / shape.sum
    return np.where(so_far > 0.5 * steepest / (CELLS * _SAMPLES), so_far, 0.0)
