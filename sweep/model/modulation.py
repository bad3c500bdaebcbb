"""What befalls lines within a record: phase errors, and a frequency that is not quite known.

Shots may carry phase errors that all lines of a segment share (:class:`PhaseError`), and a
Gaussian width of their beat. The compiled code takes both as numbers: each line becomes a few
lines (:mod:`sweep.model.effects.line_splitting`), each spectrum the mean over a few shifts
(:func:`sweep.model.effects.gaussian_line.gaussian_shifts`). They are worked out for a
stretch of points at a time, so that what they take of memory does not grow with the number of
points; shots without them are one stretch, and pay for nothing.

Shifts are about the middle of the record: there, lines and images keep their phases.
"""

import math
from collections.abc import Iterator
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from sweep.model import waveform
from sweep.model.bundles import DELTA, STRENGTH_IM, STRENGTH_RE, relative_error, together
from sweep.model.compiling import borrowing
from sweep.model.effects.gaussian_line import gaussian_shifts
from sweep.model.effects.line_modes import (
    CENTRE,
    NUMBER,
    NUMBERS,
    PLACES,
    in_modes,
    is_plain,
    middles_of,
)
from sweep.model.effects.line_splitting import Split
from sweep.model.effects.mode_lines import split
from sweep.model.equivalent import MOST_NODES, equivalent_lines
from sweep.model.kernel_rows import digests
from sweep.model.phase_moments import ALONE, take_phases
from sweep.model.preparation import LINE_STEPS, Shots

POINTS = 256
"""Points of a stretch."""

SPLIT_TOLERANCES = (1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3)
"""To which lines are split, relative to all of them in phase: the last that a point allows."""

_TOLERANCES = np.array(SPLIT_TOLERANCES)


class Stretch(NamedTuple):
    """A run of points, and what compiled code has to know of them."""

    part: slice
    """Which points of the shots these m are."""
    points: np.ndarray
    """(16, m) :meth:`sweep.model.preparation.Shots.point_table`."""
    row: np.ndarray
    """(m,) int64: row in the footprints."""
    scene: tuple
    """Footprint; parts of lines: places [bins of fs/L], real and imaginary weight (3, u, k), how
    many count (3, u), which of the u each point has (m,), digests (3, u), nan where no other points
    have the same; shifts [bins of fs/L] and their weights (m, k). Empty where there is none.
    Of lines in modes no parts count, real weights are what they are known by, and imaginary ones
    cosine and sine of the phase's middle."""
    lines: int
    """Lines that one point may have at the most."""


def stretches(shots: Shots) -> Iterator[Stretch]:
    """Points in stretches, in their order; one at least."""
    levels = _levels(shots)
    alike = _alike(shots, levels)
    plain = shots.gaussian_width is None and alike.point.size <= POINTS
    step = max(shots.size, 1) if plain else POINTS
    table, shared = shots.point_table(), _parts(shots, alike) if plain else None
    for first in range(0, max(shots.size, 1), step):
        part = slice(first, min(first + step, shots.size))
        yield _stretch(shots, table, part, shared or _parts(shots, alike.some(part)))


def single(shots: Shots, i: int) -> Stretch:
    """Point ``i`` alone."""
    alone = Alike(np.array([i]), np.zeros(1, np.int64), _levels(shots)[i : i + 1])
    return _stretch(shots, shots.point_table(), slice(i, i + 1), _parts(shots, alone))


class Alike(NamedTuple):
    """Points that stand for all those with the same phase errors, as exactly to be split."""

    point: np.ndarray
    """(u,) int64: the points."""
    which: np.ndarray
    """(m,) int64: which of these stands for each point."""
    level: np.ndarray
    """(u,) int64: place in :data:`SPLIT_TOLERANCES`."""

    def some(self, part: slice) -> "Alike":
        """Those that stand for a run of points."""
        those = self.which[part]
        if self.point.size == self.which.size:  # each stands for one
            return Alike(self.point[those], np.arange(those.size), self.level[those])
        those, which = np.unique(those, return_inverse=True)
        return Alike(self.point[those], which, self.level[those])


def _alike(shots: Shots, levels: np.ndarray) -> Alike:
    """Points of which no two have the same phase errors; which of these each point has."""
    if _by_modes(shots):
        return Alike(np.arange(shots.size), np.arange(shots.size), levels)
    values = [
        np.broadcast_to(np.asarray(one, float), shots.size)
        for error in shots.phase_errors
        for value in error.values.values()
        for one in (value if isinstance(value, tuple) else (value,))
    ]
    if not values:
        return Alike(*np.empty((3, 0), np.int64))
    varying = [v for v in (levels, *values) if v.size and (v != v[0]).any()]
    if not shots.alike and any(v is not levels for v in varying):
        return Alike(np.arange(shots.size), np.arange(shots.size), levels)
    if not varying:
        one = np.zeros(min(shots.size, 1), np.int64)
        return Alike(one, np.zeros(shots.size, np.int64), levels[one])
    _, first, which = np.unique(np.stack(varying), axis=1, return_index=True, return_inverse=True)
    return Alike(first, which.ravel(), levels[first])


def _levels(shots: Shots) -> np.ndarray:
    """How exactly each point's lines are to be split: a place in :data:`SPLIT_TOLERANCES`, (n,)."""
    if not shots.phase_errors:
        return np.zeros(shots.size, np.int64)
    squares = (shots.amplitude**2).sum(axis=1)[shots.row]
    lines = together(math.sqrt(shots.amplitude.shape[1]))
    whole = 0.5 * shots.beat_scale * np.sqrt(squares) * lines * shots.window.sum
    error = shots.line_tolerance * shots.bin_deviation / LINE_STEPS
    relative = np.where(whole > 0, error / np.where(whole > 0, whole, 1.0), np.inf)
    found = np.searchsorted(SPLIT_TOLERANCES, relative + np.zeros(shots.size), "right") - 1
    return np.asarray(np.maximum(found, 0))


def _stretch(shots: Shots, table: np.ndarray, part: slice, parts: tuple) -> Stretch:
    index = np.arange(part.start, part.stop)
    shifts = _shifts(shots, index)
    beamlets = shots.offset.shape[1]
    times = max(parts[0].shape[2], shifts[0].shape[1], ALONE if _by_modes(shots) else 0)
    return Stretch(
        part,
        np.ascontiguousarray(table[:, part]),
        shots.row[part],
        (shots.footprint, parts, shifts),
        max(beamlets, MOST_NODES) * times if times else beamlets,
    )


def choices(shots: Shots, *, every_bin: bool = False) -> tuple[bool, bool, bool, bool]:
    """What compiled code is to do: add beamlets as powers, sum images, look at leakage.

    The last is whether each bin of it is looked at by itself, where it could be an integral.
    """
    return shots.incoherent, shots.image, shots.leakage, every_bin


def _by_modes(shots: Shots) -> bool:
    """Whether each shot's phase error is its own; powers are in modes where spectra are smooth."""
    closed = not shots.window.table.size and shots.window.length == shots.fft_size
    return bool(shots.phase_errors) and not shots.alike and (closed or not shots.incoherent)


def _parts(shots: Shots, alike: Alike) -> tuple[np.ndarray, ...]:
    """Places and weights of the lines that each line is split into, by segment and point."""
    size = alike.point.size if shots.phase_errors else 0
    number, unknown = np.zeros((3, size), np.int64), np.full((3, size), np.nan)
    modes = np.empty((3, size, 0))
    if size == 0:
        return modes, modes, modes, number, alike.which, unknown
    which, segments = np.arange(size), np.flatnonzero(shots.segments)
    middles = np.empty((3, size, 2))
    if _by_modes(shots):
        modes, middles = _modes_of(shots, alike)
        which = np.flatnonzero((modes[segments, :, NUMBER:CENTRE] == 0).all(axis=2).any(axis=0))
        if not which.size:
            return modes, modes, middles, number, alike.which, unknown
    own = _split(shots, alike.point[which], _TOLERANCES[alike.level[which]])
    most = max(own.offset.shape[2], NUMBERS if modes.size else 0)
    offset, re, im = np.zeros((3, 3, size, most))
    at = segments[:, None], which, slice(own.offset.shape[2])
    offset[at], re[at], im[at] = own.offset, own.weight.real, own.weight.imag
    number[at[:2]] = own.number
    if modes.size:
        as_modes = (modes[:, :, NUMBER:CENTRE] > 0).any(axis=2)
        number[as_modes] = 0
        re[as_modes, :NUMBERS], im[as_modes, :2] = modes[as_modes], middles[as_modes]
    known_as = digests(offset, re, im) if shots.alike else unknown
    return offset, re, im, number, alike.which, known_as


def _modes_of(shots: Shots, alike: Alike) -> tuple[np.ndarray, np.ndarray]:
    """Lines in modes by segment and point, (3, u, NUMBERS), and cosine and sine of middles."""
    phase = np.zeros((3, alike.point.size, PLACES.size))
    for segment in map(int, np.flatnonzero(shots.segments)):
        phase[segment] = _total_phase(_errors(shots, alike.point, segment, once=True), PLACES)
    return in_modes(phase, _TOLERANCES[alike.level]), middles_of(phase)


def _errors(shots: Shots, points: np.ndarray, segment: int, *, once: bool = False) -> tuple:
    """Phase errors of some points in a segment, as :func:`_total_phase` takes them.

    ``once``: what all points share is given once.
    """
    return tuple(
        (
            error.phase,
            waveform.SIGNS[segment],
            tuple(error.chosen(segment, points, once=once).items()),
        )
        for error in shots.phase_errors
    )


def _split(shots: Shots, points: np.ndarray, tolerance: np.ndarray) -> Split:
    """Lines that each line of some points is split into, by segment that there is.

    What one point has is remembered.
    """
    errors = tuple(_errors(shots, points, int(s)) for s in np.flatnonzero(shots.segments))
    if points.size > 1:
        return split(partial(_phases, errors), tolerance)
    alone = tuple(
        tuple(
            (phase, sign, tuple((name, float(value[0])) for name, value in values))
            for phase, sign, values in own
        )
        for own in errors
    )
    return _split_alone(alone, float(tolerance[0]))


@lru_cache(maxsize=64)
def _split_alone(errors: tuple, tolerance: float) -> Split:
    """Lines of one point; errors as of :func:`_phases`, their values numbers."""
    arrays = tuple(
        tuple(
            (phase, sign, tuple((name, np.array([value])) for name, value in values))
            for phase, sign, values in own
        )
        for own in errors
    )
    return split(partial(_phases, arrays), np.array([tolerance]))


def _phases(errors: tuple, x: np.ndarray) -> np.ndarray:
    """Phases [cycles] of points in segments, (segments, n, m), from their errors."""
    return np.stack([_total_phase(own, x) for own in errors])


def _total_phase(errors: tuple, x: np.ndarray) -> np.ndarray:
    """Sum of phase errors [cycles] at places x: of each the function, the sign, its values."""
    return np.asarray(sum(phase(x, sign=sign, **dict(values)) for phase, sign, values in errors))


def _shifts(shots: Shots, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shifts over which |X|^2 is averaged, and their weights."""
    if shots.gaussian_width is None:
        return np.empty((0, 0)), np.empty((0, 0))
    duration = np.broadcast_to(shots.record_duration, shots.size)[index]
    shifts = gaussian_shifts(fwhm=shots.gaussian_width[index], duration=duration)
    return shifts.offset, shifts.weight


@borrowing()
def modulate(segment, i, n, fold, scene, power, allowed, kernel, room):
    """Lines in rows DELTA .. after what befalls them, as far as that leaves them plain lines.

    Amplitudes are split into parts, powers shifted; few lines stand for many before.

    Parameters
    ----------
    segment, i, n : int
        0 up, 1 Doppler, 2 down; place of the point in its stretch; number of lines.
    fold : float
        -1 where the lines are seen as their images, which conjugates their weights.
    allowed
        As of :func:`sweep.model.bundles.relative_error`.
    scene, power, kernel, room
        As of :class:`Stretch` and :func:`sweep.model.segments.segment_spectrum`.

    Returns
    -------
    int
        Number of lines.
    """
    parts, shifts = scene[1], scene[2]
    count = shifts[0].shape[1] if power else parts[0].shape[2]
    if count == 0 or (not power and is_whole(segment, i, scene, power)):
        return n
    if not power and parts[3][segment, parts[4][i]] == 0:
        numbers, middle = parts[1][segment, parts[4][i]], parts[2][segment, parts[4][i]]
        return take_phases(n, numbers, middle, fold, allowed, kernel, room)
    fft_size, length = kernel[0]
    bins = fold * fft_size / length
    few = reduce_lines(n, power, allowed, n - 1, kernel, room)
    delta, re, im = room[DELTA], room[STRENGTH_RE], room[STRENGTH_IM]
    at, one, other = room[4], room[5], room[6]
    lines = 0
    if power:
        for m in range(count):
            share = shifts[1][i, m]
            if share > 0.0:
                apart = bins * shifts[0][i, m]
                for j in range(few):
                    delta[lines + j], re[lines + j] = at[j] + apart, one[j] * share
                    im[lines + j] = 0.0
                lines += few
    else:
        own = parts[4][i]
        for m in range(parts[3][segment, own]):
            apart = bins * parts[0][segment, own, m]
            a, b = parts[1][segment, own, m], fold * parts[2][segment, own, m]
            for j in range(few):
                delta[lines + j] = at[j] + apart
                re[lines + j] = one[j] * a - other[j] * b
                im[lines + j] = one[j] * b + other[j] * a
            lines += few
    return lines


@borrowing()
def is_whole(segment, i, scene, power):
    """Whether a segment's lines stay what they are, as the Doppler segment's under range walk."""
    parts = scene[1]
    own = parts[4][i]
    if parts[3][segment, own] == 0:
        turned = not power and parts[2][segment, own, 0] != 1.0
        return is_plain(parts[1][segment, own]) and not turned
    whole = parts[3][segment, own] == 1 and parts[0][segment, own, 0] == 0.0
    return whole and parts[1][segment, own, 0] == 1.0 and parts[2][segment, own, 0] == 0.0


@borrowing()
def reduce_lines(n, power, allowed, most, kernel, room):
    """Few lines that are equivalent to those in rows DELTA .., into rows 4 to 6; how many.

    ``allowed`` is as of :func:`sweep.model.bundles.relative_error`; above ``most`` lines nothing is
    gained, and they stay as they are.
    """
    fft_size, length = kernel[0]
    band = np.pi * length / fft_size * (2.0 if power else 1.0)
    tolerance = relative_error(n, power, allowed, kernel, room)
    return equivalent_lines(
        room[DELTA], room[STRENGTH_RE], room[STRENGTH_IM], n, power, band, tolerance, most,
        kernel[3], room[4], room[5], room[6], room[7:12],
    )  # fmt: skip


@borrowing()
def take_few(n, power, allowed, most, kernel, room):
    """Puts equivalent lines in the place of n lines; how many there are then."""
    few = reduce_lines(n, power, allowed, most, kernel, room)
    for j in range(few):
        room[DELTA, j], room[STRENGTH_RE, j] = room[4, j], room[5, j]
        room[STRENGTH_IM, j] = room[6, j]
    return few
