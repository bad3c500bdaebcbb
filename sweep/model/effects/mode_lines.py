"""Lines with a gentle phase error as few pure lines, by way of modes.

What :mod:`sweep.model.effects.line_splitting` fits line by line is here put together: a phase error
is a sum of few polynomials of time (:mod:`sweep.model.effects.line_modes`), and of how many pure
lines each of these is made up, to what error, is worked out once. The lines are the same, as least
squares are linear, and the fewest that a tolerance takes; finding them costs a twentieth.
"""

import math
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
    at, made = np.ascontiguousarray(phase(PLACES)), _made()
    found = in_modes(at, np.full(at.shape[0], 2 * LEFT_OUT * tolerance))
    step, error = _steps_needed(found, tolerance, made.error)
    number = np.append(made.number, 0)[step]
    room = at.shape[0], int(number.max(initial=1))
    whole = Split(np.zeros(room), np.zeros(room, complex), number, error)
    _put_together(found, at, step, number, made.offset, made.strength, whole.offset, whole.weight)
    rest = np.flatnonzero(number == 0)
    if rest.size == 0:
        return whole
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
def _steps_needed(found, tolerance, errors):
    """First step that serves each row in modes, -1 where none does or it has none; its error."""
    step, error = np.full(found.shape[0], -1), np.zeros(found.shape[0])
    size = np.empty(MODES)
    for row in range(found.shape[0]):
        own = found[row]
        if own[NUMBER] == 0.0 and own[NUMBER + 1] == 0.0:
            continue
        for k in range(MODES):
            size[k] = math.sqrt(own[RE + k] * own[RE + k] + own[IM + k] * own[IM + k])
        for tried in range(errors.shape[0]):
            off = LEFT_OUT * tolerance
            for k in range(MODES):
                off += size[k] * errors[tried, k]
            if off <= tolerance:
                step[row], error[row] = tried, off
                break
    return step, error


@njit(cache=True, error_model="numpy")
def _put_together(found, phase, step, number, offsets, strengths, offset, weight):
    """Lines of rows in modes, of the step of each; none of rows without."""
    for row in range(found.shape[0]):
        own = found[row]
        evens, odds = int(own[NUMBER]), int(own[NUMBER + 1])
        middle = 0.0
        for i in range(phase.shape[1]):
            middle += phase[row, i] / phase.shape[1]
        sine, cosine = sincos_cycles(middle)
        for p in range(number[row]):
            re, im = 0.0, 0.0
            for k in range(evens):
                re += own[RE + k] * strengths[step[row], k, p]
                im += own[IM + k] * strengths[step[row], k, p]
            for k in range(EVENS, EVENS + odds):  # times i
                re -= own[IM + k] * strengths[step[row], k, p]
                im += own[RE + k] * strengths[step[row], k, p]
            offset[row, p] = own[CENTRE] + offsets[step[row], p]
            weight[row, p] = complex(cosine * re - sine * im, cosine * im + sine * re)
