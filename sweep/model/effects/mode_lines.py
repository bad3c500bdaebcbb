"""Lines with a gentle phase error as few pure lines, by way of modes.

What :mod:`sweep.model.effects.line_splitting` fits line by line is here put together: a phase error
is a sum of few polynomials of time (:mod:`sweep.model.effects.line_modes`), and of how many pure
lines each of these is made up, to what error, is worked out once. The lines are the same, as least
squares are linear, and the fewest that a tolerance takes; finding them costs a twentieth.
"""

from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numba import njit

from sweep.model.effects.line_modes import (
    CENTRE,
    EVENS,
    IM,
    MODES,
    NUMBER,
    PLACES,
    RE,
    in_modes,
    mode_weights,
)
from sweep.model.effects.line_splitting import TOLERANCE, Phase, Split, split_lines
from sweep.model.elementary import sincos_cycles

STEPS = ((1, 1.0), (3, 0.2), (5, 0.2), (7, 0.2), (9, 0.2), (11, 0.25), (15, 0.35), (21, 0.5),
         (31, 0.65))  # fmt: skip
"""Numbers of lines to try in turn, and bins of fs/L from one to the next."""

LEFT_OUT = 0.1
"""Of the tolerance, for modes that are left out; the rest is that of their lines."""


class _Made(NamedTuple):
    """Of what the modes are made up, by step; rows end in zeros."""

    number: np.ndarray
    offset: np.ndarray
    """(steps, lines)."""
    strength: np.ndarray
    """(steps, modes, lines)."""
    error: np.ndarray
    """(steps, modes)."""


def split(phase: Phase, *, tolerance: float = TOLERANCE) -> Split:
    """Lines of which each of n lines with a phase error over the record is made up.

    As :func:`sweep.model.effects.line_splitting.split_lines`, which is asked for what wanders too
    far for modes; parameters, result and errors are its own.
    """
    at = np.ascontiguousarray(phase(PLACES))
    size, most = at.shape[0], STEPS[-1][0]
    found = in_modes(at, np.full(size, 2 * LEFT_OUT * tolerance))
    whole = Split(
        np.zeros((size, most)), np.zeros((size, most), complex), np.zeros(size, np.int64),
        np.zeros(size),
    )  # fmt: skip
    _put_together(found, at, tolerance, *_made(), *whole)
    rest = np.flatnonzero(whole.number == 0)
    if rest.size == 0:
        most = int(whole.number.max(initial=1))
        return Split(whole.offset[:, :most], whole.weight[:, :most], whole.number, whole.error)
    return _with(whole, rest, split_lines(partial(_some, phase, rest), tolerance=tolerance))


def _some(phase: Phase, rows: np.ndarray, x: np.ndarray) -> np.ndarray:
    return phase(x)[rows]


def _with(whole: Split, rows: np.ndarray, own: Split) -> Split:
    """A split with some rows from another one."""
    most = max(int(whole.number.max()), own.offset.shape[1])
    found = Split(
        np.zeros((whole.number.size, most)), np.zeros((whole.number.size, most), complex),
        whole.number, whole.error,
    )  # fmt: skip
    shared = min(most, whole.offset.shape[1])
    for out, before, values in zip(found[:2], whole[:2], own[:2], strict=True):
        out[:, :shared] = before[:, :shared]
        out[rows, : values.shape[1]] = values
    found.number[rows], found.error[rows] = own.number, own.error
    return found


@lru_cache(maxsize=1)
def _made() -> _Made:
    most = STEPS[-1][0]
    made = _Made(
        np.array([lines for lines, _ in STEPS]), np.zeros((len(STEPS), most)),
        np.zeros((len(STEPS), MODES, most)), np.zeros((len(STEPS), MODES)),
    )  # fmt: skip
    for step, (lines, spacing) in enumerate(STEPS):
        each = mode_weights(lines, spacing)
        made.offset[step, :lines], made.strength[step, :, :lines] = each.offset, each.strength
        made.error[step] = each.error
    return made


@njit(cache=True, error_model="numpy")
def _put_together(
    found, phase, tolerance, numbers, offsets, strengths, errors, offset, weight, number, error
):
    """Lines of rows in modes, of the first step that serves; none of rows without."""
    for row in range(found.shape[0]):
        own = found[row]
        evens, odds = int(own[NUMBER]), int(own[NUMBER + 1])
        if evens == 0 and odds == 0:
            continue
        for step in range(numbers.size):
            off = 0.0
            for k in range(MODES):
                off += np.hypot(own[RE + k], own[IM + k]) * errors[step, k]
            if off <= (1.0 - LEFT_OUT) * tolerance:
                break
        else:
            continue
        sine, cosine = sincos_cycles(phase[row].mean())
        turn = complex(cosine, sine)
        number[row], error[row] = numbers[step], LEFT_OUT * tolerance + off
        for p in range(numbers[step]):
            offset[row, p] = own[CENTRE] + offsets[step, p]
            even, odd = 0j, 0j
            for k in range(evens):
                even += complex(own[RE + k], own[IM + k]) * strengths[step, k, p]
            for k in range(EVENS, EVENS + odds):
                odd += complex(own[RE + k], own[IM + k]) * strengths[step, k, p]
            weight[row, p] = turn * (even + 1j * odd)
