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
    NUMBERS,
    PLACES,
    RE,
    in_modes,
    mode_weights,
)
from sweep.model.effects.line_splitting import Phase, Split, split_lines
from sweep.model.elementary import sincos_cycles

STEPS = ((1, 1.0), (3, 0.2), (5, 0.2), (7, 0.2), (9, 0.2), (11, 0.25), (15, 0.35), (21, 0.5),
         (31, 0.65))  # fmt: skip
"""Numbers of lines to try in turn, and bins of fs/L from one to the next."""

LEFT_OUT = 0.1
"""Of the tolerance, for modes that are left out; the rest is that of their lines."""


class _Made(NamedTuple):
    """Of what the modes are made up, by step; rows end in zeros."""

    number: np.ndarray
    """(steps + 1,): the last for where there is none."""
    offset: np.ndarray
    """(steps, lines)."""
    strength: np.ndarray
    """(steps, modes, lines)."""
    error: np.ndarray
    """(steps, modes)."""


def split(phase: Phase, tolerance: np.ndarray) -> Split:
    """Lines of which each of n lines with a phase error over the record is made up, by segment.

    As :func:`sweep.model.effects.line_splitting.split_lines`, which is asked for what wanders too
    far for modes; but that ``phase`` and results have a first dimension, that of segments, and that
    each line has a tolerance of its own, (n,).
    """
    at, made = np.ascontiguousarray(phase(PLACES)), _made()
    segments, n, _ = at.shape
    allowed = np.broadcast_to(tolerance, (segments, n)).ravel()
    found = in_modes(at, 2 * LEFT_OUT * tolerance).reshape(-1, NUMBERS)
    step, error = _steps_needed(found, allowed, made.error)
    number = made.number[step]
    whole = _room(number, error)
    _put_together(found, at.reshape(-1, PLACES.size), step, made, whole)
    for each in np.unique(allowed[number == 0]):
        rest = np.flatnonzero((number == 0) & (allowed == each))
        whole = _with(whole, rest, split_lines(partial(_some, phase, rest), tolerance=float(each)))
    return Split(*(values.reshape(segments, n, *values.shape[1:]) for values in whole))


def _some(phase: Phase, rows: np.ndarray, x: np.ndarray) -> np.ndarray:
    return phase(x).reshape(-1, x.size)[rows]


def _room(number: np.ndarray, error: np.ndarray) -> Split:
    """Room for so many lines of each row."""
    room = number.size, max(int(number.max(initial=0)), 1)
    return Split(np.zeros(room), np.zeros(room, complex), number, error)


def _with(whole: Split, rows: np.ndarray, own: Split) -> Split:
    """A split with some rows from another one."""
    number, error = whole.number.copy(), whole.error.copy()
    number[rows], error[rows] = own.number, own.error
    found = _room(number, error)
    shared = whole.offset.shape[1]
    for out, before, values in zip(found[:2], whole[:2], own[:2], strict=True):
        out[:, :shared] = before
        out[rows, : values.shape[1]] = values
    return found


@lru_cache(maxsize=1)
def _made() -> _Made:
    most = STEPS[-1][0]
    made = _Made(
        np.array([*(lines for lines, _ in STEPS), 0]), np.zeros((len(STEPS), most)),
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
        own, allowed = found[row], tolerance[row]
        if own[NUMBER] == 0.0 and own[NUMBER + 1] == 0.0:
            continue
        for k in range(MODES):
            size[k] = math.sqrt(own[RE + k] * own[RE + k] + own[IM + k] * own[IM + k])
        for tried in range(errors.shape[0]):
            off = LEFT_OUT * allowed
            for k in range(MODES):
                off += size[k] * errors[tried, k]
            if off <= allowed:
                step[row], error[row] = tried, off
                break
    return step, error


@njit(cache=True, error_model="numpy")
def _put_together(found, phase, step, made, out):
    """Lines of rows in modes, of the step of each; none of rows without."""
    _, offsets, strengths, _ = made
    offset, weight, number, _ = out
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
