"""Bins of a segment as the engine looks at them, by what it has compiled for a study's points.

A kernel that is called with arrays as they are would be compiled once more for each window.
"""

import numpy as np

from sweep.model import modulation, segments
from sweep.model.compiling import owning
from sweep.model.crossings import crossing_series
from sweep.model.lending import lend
from sweep.model.segments import _smooth_lines, inspect_segment, lent


@owning(nogil=True)
def _point(points, row):
    """Values of the first point, and where its lines are."""
    p = np.empty(points.shape[0])
    p[:] = points[:, 0]
    return p, (row[0], points.shape[1] - 1)


@owning(nogil=True)
def _run(segment, points, row, scene, choices, kernel, work):
    """First bin and number of those that are looked at; |X| is in the room's first row."""
    seen, known, (room, exempt, series) = lent(scene, kernel, work)
    scene, kernel = lend(seen), lend(known)
    p, at = _point(points, row)
    crossing_series(p[11] / p[10], series)
    low, count, _, _, _ = inspect_segment(
        segment, p, scene, at, choices, kernel, room, exempt, series
    )
    return low, count


@owning(nogil=True)
def _kind(segment, points, row, scene, choices, kernel, work):
    """What :func:`lines_of` tells."""
    seen, known, (room, _, _) = lent(scene, kernel, work)
    scene, kernel = lend(seen), lend(known)
    p, at = _point(points, row)
    _, number, kind = _smooth_lines(segment, p, scene, at, choices[0], kernel, room)
    return number, kind[0], kind[1], kind[5]


def _given(shots, segment):
    """One point, as the engine takes it; the room, whose first row will hold |X|."""
    point = modulation.single(shots, 0)
    work = segments.workspace(point.lines, shots.fft_size)
    return (
        segment, point.points, point.row, point.scene, modulation.choices(shots), shots.kernel(),
        work,
    ), work[0]  # fmt: skip


def run_of_bins(shots, segment):
    """First bin and |X| of those that detection and leakage look at one by one."""
    given, room = _given(shots, segment)
    low, count = _run(*given)
    return low, room[0, :count].copy()


def lines_of(shots, segment):
    """Number of lines; row of their moments, or -1; bundles; whether these have a form."""
    return _kind(*_given(shots, segment)[0])
