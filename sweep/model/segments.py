"""Segments of shots: from lines to runs of bins, detections and leakage, point by point.

A run holds |X| without noise in every bin around a segment's lines that may matter. Whoever looks
at spectra (detection, groups, draws, pictures) looks at runs.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model import line_shape
from sweep.model.crossings import MOST_TERMS, any_crossing, crossing_series, leave_out_joined
from sweep.model.detection import (
    BinLevels,
    PedestalShape,
    any_neighbour,
    found_pair,
    free_images,
    speckle_of,
)
from sweep.model.effects.circulator_leak import beside_leak
from sweep.model.effects.line_width import gaussian_shifts
from sweep.model.faded_rates import faded_rates, no_rates
from sweep.model.ground import different_rows
from sweep.model.leakage import LOUDEST, MOST_POINTS, inspect, of_bins, of_fading_bins
from sweep.model.line_shape import Shapes
from sweep.model.lines import (
    AMPLITUDE_TOLERANCES,
    IM,
    LEAST_WIDTH,
    MOST_NODES,
    PLACE,
    POWER_TOLERANCES,
    RE,
    X,
    add_images,
    fold_lines,
    node_limits,
    nodes_for,
    place_lines,
    put_on_nodes,
    relative_error,
    survey,
)
from sweep.model.looks import MOST_PLACES
from sweep.model.preparation import LINE_STEPS, Shots
from sweep.model.search import cut
from sweep.model.spectrum import (
    A_IM,
    A_RE,
    CHANCE,
    COMPLEX,
    FOLDED,
    IMAGED,
    MOST_CELLS,
    OUT,
    ROOM,
    detect,
)
from sweep.model.window import Window

POINTS = 256
"""Points that are prepared together; 16 times as many where few line shapes serve them all."""

ROOM_FOR_RUNS = 1 << 21
"""Bins of runs that are kept at a time, at least."""

THRESHOLD_STEP = 1e-7
"""Step to which thresholds [sigma] are rounded for rates of leakage in developed speckle."""

SEGMENT_FIELDS = ("pd", "miss", "magnitude", "frequency", "exempted", "leakage")
"""Values found for each segment's spectrum."""

NO_LEAKAGE, INTEGRAL, BIN_BY_BIN = range(3)
"""Ways to look at leakage: not at all; all bins, those far away as an integral; those of the run
that stand above a floor."""


class Runs(NamedTuple):
    """Runs of bins around the lines of some points' segments, and what stands in them.

    Arrays are (segments, m) for m points; count is 0 in segments that there are not.
    """

    part: np.ndarray
    """(m,): which points of the shots these are."""
    low: np.ndarray
    """First bin; of complex records N more than its frequency says, or twice as many, so that no
    bin of a run is below 0."""
    bins: np.ndarray
    """Bins in the run."""
    peak: np.ndarray
    """Place of the largest bin in the run."""
    exempted: np.ndarray
    """Bins that can't raise a false alarm."""
    pd: np.ndarray
    miss: np.ndarray
    magnitude: np.ndarray
    """|X| of the largest bin."""
    leakage: np.ndarray
    """Probability that leaked signal raises at least one extra group, over noise alone."""
    start: np.ndarray
    """Begin of each run in the arrays that follow."""
    magnitudes: np.ndarray
    """|X| of all runs, one after the other."""
    exempt: np.ndarray
    """Bins of them that can't raise a false alarm, bool."""
    inside: np.ndarray
    """True where the largest bin of all is searched, bool; else it is in no run."""

    def run(self, segment: int, i: int) -> np.ndarray:
        """|X| of one run, (count,)."""
        start = self.start[segment, i]
        return self.magnitudes[start : start + self.bins[segment, i]]


class Together(NamedTuple):
    """Points whose line shapes are made of the same modes."""

    part: np.ndarray
    """(m,): which points."""
    which: np.ndarray
    """(m,): shape of each."""
    shapes: Shapes
    centre: np.ndarray
    """(segments, u): shift of the lines [bins of fs/L]."""
    modes: np.ndarray
    """(segments, u, 2, k): real and imaginary parts."""
    number: np.ndarray
    """(segments, u): modes that count."""
    partly: bool = False
    """True where echoes have part of the record's samples."""


def find(shots: Shots, *, every_bin: bool = False) -> np.ndarray:
    """Evaluate each segment's spectrum: (3, fields, n) by segment and SEGMENT_FIELDS.

    ``every_bin``: look at each bin by itself where leakage could be summed as an integral.
    """
    found = np.full((3, len(SEGMENT_FIELDS), shots.size), np.nan)
    width = (shots.sample_rate / shots.fft_size) + np.zeros(shots.size)
    for runs in runs_of(shots, every_bin=every_bin, keep=False):
        for s in np.flatnonzero(shots.segments):
            frequency = shots.signed_bin(runs.low[s] + runs.peak[s]) * width[runs.part]
            found[s][:, runs.part] = (
                runs.pd[s], runs.miss[s], runs.magnitude[s],
                np.where(runs.inside[s], frequency, np.nan), runs.exempted[s], runs.leakage[s],
            )  # fmt: skip
    return found


def runs_of(
    shots: Shots,
    *,
    points: np.ndarray | None = None,
    least: np.ndarray | None = None,
    leakage: bool = True,
    every_bin: bool = False,
    keep: bool = True,
    whole: bool = False,
    chances: bool = True,
) -> Iterator[Runs]:
    """Yield runs of all points, or of those in ``points``, some points at a time, in any order.

    Bins below ``least`` (n,) [V, summed over the record], by default the threshold, may be left
    out. With ``every_bin`` each bin is looked at by itself where leakage could be summed as an
    integral; ``keep`` hands magnitudes on; ``whole`` has bins that are not searched as well.
    Without ``chances`` the probabilities of a detection are nan.
    """
    table = shots.point_table()
    levels = table[11] if least is None else np.broadcast_to(least, shots.size)
    some = np.arange(shots.size) if points is None else points
    for together in _together(shots, some):
        leaks = _way_to_leakage(shots, together, every_bin) if leakage else NO_LEAKAGE
        floor = table[12] * table[10] if leaks == BIN_BY_BIN else np.inf
        if shots.fading is not None:  # faint leakage of bright speckle counts
            floor = floor / math.sqrt(LOUDEST)
        lowest, done = np.minimum(levels, floor), 0
        while done < together.part.size:
            held = keep or (shots.looks.several and bool(leaks))
            held |= shots.leak_amplitude is not None or shots.band is not None
            runs, number = _some(shots, table, lowest, together, leaks, done, held, chances)
            runs = runs if whole else cut(shots, _without_echo(shots, runs))
            runs = _of_looks(shots, runs, bool(leaks)) if shots.looks.several else runs
            yield runs if shots.leak_amplitude is None else beside_leak(shots, runs)
            done += number


def _without_echo(shots: Shots, runs: Runs) -> Runs:
    """Empty the runs of segments whose echo has no sample of the record: nothing is detected."""
    if shots.first_sample is None:
        return runs
    dark = (shots.first_sample[:, runs.part] >= shots.window.length) & (runs.bins > 0)
    if not dark.any():
        return runs
    return runs._replace(
        bins=np.where(dark, 0, runs.bins),
        peak=np.where(dark, 0, runs.peak),
        exempted=np.where(dark, 0, runs.exempted),
        pd=np.where(dark, 0.0, runs.pd),
        miss=np.where(dark, 1.0, runs.miss),
        leakage=np.where(dark, 0.0, runs.leakage),
        inside=runs.inside & ~dark,
    )


def _of_looks(shots: Shots, runs: Runs, leakage: bool) -> Runs:
    """Replace one record's probabilities in runs by those of several looks."""
    floor, sigma, level = (
        np.broadcast_to(v, shots.size)[runs.part]
        for v in (shots.floor, shots.bin_deviation, shots.threshold)
    )
    leaked, looks = runs.leakage.copy(), shots.looks
    for s, i in np.argwhere(runs.bins > 0) if leakage and shots.leakage else ():
        if not shots.waveform[s].leaks:
            continue
        stretch = slice(runs.start[s, i], runs.start[s, i] + runs.bins[s, i])
        signal, exempt = runs.magnitudes[stretch] / sigma[i], runs.exempt[stretch]
        faintest = floor[i]
        powers, weights = np.ones(1), np.ones(1)
        if shots.fading is not None:
            powers, weights = looks.speckle_powers(shots.look_speckle, s, int(runs.part[i]))
            faintest = floor[i] / math.sqrt(LOUDEST)
        counts = ~exempt & (signal >= faintest)
        roots, chances = np.sqrt(powers), np.zeros((powers.size, signal.size))
        chances[:, counts] = np.minimum(
            looks.excess(np.outer(roots, signal[counts]), level[i] / sigma[i]), 1.0
        )
        # Groups join by one record that detects as the looks do.
        scaled = float(looks.scaled(level[i] / sigma[i]))
        near, mean = shots.echo_rule.sidelobe_correlation, 0.0
        for root, weight, raised in zip(roots, weights, chances, strict=True):
            noise = 1 / (looks.sharper * root), scaled / (looks.sharper * root)
            leave_out_joined(raised, 0, raised.size, signal, exempt, noise, near)
            mean += weight * any_crossing(raised, 0, raised.size)
        leaked[s, i] = mean
    pd, miss = shots.detected(runs.magnitude, runs.low + runs.peak, runs.part)
    pd, miss = np.where(runs.inside, pd, 0.0), np.where(runs.inside, miss, 1.0)
    return runs._replace(pd=pd, miss=miss, leakage=leaked)


def spectrum(shots: Shots, i: int, segment: int, *, level: float = 0.0) -> tuple:
    """Bins of a segment in which the echo stands above a level, and |X| there, without noise.

    Bins rise from one to the next. Those of a complex record go on past Nyquist:
    :meth:`sweep.model.preparation.Shots.signed_bin` tells their frequencies. Bins below the level
    [V, summed over the record] may be left out; 0 gives all.
    """
    shots = replace(shots, leak_amplitude=None)
    (runs,) = runs_of(
        shots, points=np.array([i]), least=np.array([level]), leakage=False, whole=True,
        chances=False,
    )  # fmt: skip
    low = int(runs.low[segment, 0])
    magnitude = runs.run(segment, 0).copy()
    return np.arange(low, low + magnitude.size), magnitude


def whole_spectrum(shots: Shots, i: int, segment: int) -> np.ndarray:
    """|X| of all bins of a segment without noise [V], (bins,), in the order of their frequencies.

    Bins are those of :attr:`sweep.model.preparation.Shots.signed_bins`.
    """
    bins, magnitude = spectrum(shots, i, segment)
    found = np.zeros(shots.bins)
    found[shots.index_of_bin(bins)] = magnitude
    return found


def view(shots: Shots) -> int:
    """Return the view of a spectrum that shots have: FOLDED, IMAGED or COMPLEX."""
    return COMPLEX if shots.complex_record else IMAGED if shots.image else FOLDED


def _way_to_leakage(shots: Shots, together: Together, every_bin: bool) -> int:
    shapes = together.shapes
    if not shots.leakage:
        return NO_LEAKAGE
    averaged = shots.gaussian_width is not None and not shots.incoherent
    averaged |= shots.looks.several or every_bin or shots.band is not None or together.partly
    smooth = shapes.sizes[0] == shapes.sizes[1] and not shapes.sizes[5]
    if smooth and not averaged and view(shots) != COMPLEX:
        return INTEGRAL
    return BIN_BY_BIN


def _together(shots: Shots, points: np.ndarray) -> Iterator[Together]:
    """Yield groups of points whose line shapes can be computed together, in any order."""
    if shots.first_sample is not None:
        there = shots.segments
        late = (shots.first_sample[there][:, points] > 0).any(axis=0)
        yield from _partly_filled(shots, points[late])
        points = points[~late]
    window, fft_size, power = shots.window, shots.fft_size, shots.incoherent
    simple = line_shape.has_modes(window, fft_size)
    segments = len(shots.waveform)
    plainly = shots.gaussian_width is None and not np.any(shots.look_drift)
    few = plainly and (shots.alike or not shots.phase_errors)
    step = 16 * POINTS if few else POINTS
    if not shots.phase_errors:
        plain = line_shape.shapes if simple else _plain
        shapes = plain(window, fft_size, power, 0 if simple else segments)
        modes = np.zeros((segments, 1, 2, 1))
        modes[:, :, 0] = 1.0
        number = np.ones((segments, 1), np.int64)
        centre = np.zeros((segments, 1))
        for first in range(0, points.size, step):
            some = points[first : first + step]
            yield Together(some, 0 * some, shapes, centre, modes, number)
        return
    for first in range(0, points.size, step):
        some = points[first : first + step]
        point, which = _different(shots, some)
        left = np.arange(point.size)
        for tier in range(len(line_shape.TIERS) if simple else 0):
            nodes = 2 * line_shape.TIERS[tier][0]
            phase = _phases(shots, point[left], line_shape.record_places(nodes))
            centre = np.zeros(phase.shape[:2])
            number = np.zeros(phase.shape[:2], np.int64)
            modes = np.zeros((*phase.shape[:2], 2, nodes // 2))
            line_shape.find_modes(
                phase, _NO_WEIGHT, line_shape.to_modes(nodes), centre, modes, number
            )
            told = (number > 0).all(axis=0)
            place = np.full(point.size, -1)
            place[left[told]] = np.arange(np.count_nonzero(told))
            these = place[which] >= 0
            if these.any():
                yield _sorted(
                    some[these], place[which[these]],
                    line_shape.shapes(window, fft_size, power, tier, shared=shots.alike),
                    centre[:, told], modes[:, told], number[:, told],
                )  # fmt: skip
            left = left[~told]
            if not left.size:
                break
        for each in left:  # tables of all bins, one after the other
            places = 2 * np.arange(window.length) / window.length - 1
            phase = _phases(shots, point[each : each + 1], places)[:, 0]
            these = some[which == each]
            yield Together(
                these, 0 * these, line_shape.whole_shapes(window, fft_size, power, phase),
                np.zeros((segments, 1)), np.zeros((segments, 1, 2, 1)),
                np.ones((segments, 1), np.int64),
            )  # fmt: skip


_NO_WEIGHT = np.empty((0, 0, 0))


def _partly_filled(shots: Shots, points: np.ndarray) -> Iterator[Together]:
    """Yield groups of points whose echoes have part of the record's samples, in any order."""
    window, fft_size, power = shots.window, shots.fft_size, shots.incoherent
    there, segments = shots.segments, len(shots.waveform)
    assert shots.first_sample is not None
    dark = (shots.first_sample[there][:, points] >= window.length).all(axis=0)
    if dark.any():
        shapes = _no_shape(window, fft_size, power, segments)
        nothing = np.zeros((segments, 1)), np.zeros((segments, 1, 2, 1))
        some = points[dark]
        yield Together(some, 0 * some, shapes, *nothing, np.ones((segments, 1), np.int64), True)
        points = points[~dark]
    for begin in range(0, points.size, POINTS):
        some = points[begin : begin + POINTS]
        point, which = _different(shots, some)
        lengths = window.length - shots.first_sample[:, point]
        lengths[~there] = lengths[there][0]
        least, largest = lengths.min(axis=0), lengths.max(axis=0)
        steps = line_shape.part_class(window, least)
        left = np.ones(point.size, np.bool_)
        for tier in range(len(line_shape.TIERS)):
            tried = left & line_shape.part_has_modes(window, fft_size, tier, least, largest)
            for step in np.unique(steps[tried]).tolist():
                these = np.flatnonzero(tried & (steps == step))
                nodes = 2 * line_shape.TIERS[tier][0]
                x = line_shape.record_places(nodes)
                phase = _phases(shots, point[these], x)
                weight = line_shape.part_window(window, x, lengths[:, these])
                centre = np.zeros(phase.shape[:2])
                number = np.zeros(phase.shape[:2], np.int64)
                modes = np.zeros((*phase.shape[:2], 2, nodes // 2))
                line_shape.find_modes(
                    phase, weight, line_shape.to_modes(nodes), centre, modes, number
                )
                told = (number > 0).all(axis=0)
                place = np.full(point.size, -1)
                place[these[told]] = np.arange(np.count_nonzero(told))
                left[these[told]] = False
                members = place[which] >= 0
                if members.any():
                    shapes = line_shape.part_shapes(window, fft_size, power, tier, step)
                    shapes = shapes._replace(lengths=np.ascontiguousarray(lengths[:, these[told]]))
                    group = _sorted(
                        some[members], place[which[members]], shapes, centre[:, told],
                        modes[:, told], number[:, told],
                    )  # fmt: skip
                    yield group._replace(partly=True)
        for each in np.flatnonzero(left):  # tables of all bins, one after the other
            these = some[which == each]
            first = window.length - lengths[:, each]
            phase = np.zeros((segments, window.length))
            for s in np.flatnonzero(there & (lengths[:, each] > 0)):
                x = 2 * np.arange(lengths[s, each]) / lengths[s, each] - 1
                phase[s, first[s] :] = _phases(shots, point[each : each + 1], x)[s, 0]
            yield Together(
                these, 0 * these, line_shape.whole_shapes(window, fft_size, power, phase, first),
                np.zeros((segments, 1)), np.zeros((segments, 1, 2, 1)),
                np.ones((segments, 1), np.int64), partly=True,
            )  # fmt: skip


@lru_cache(maxsize=2)
def _plain(window: Window, fft_size: int, power: bool, segments: int) -> Shapes:
    """Tables of all bins of lines without a phase error."""
    return line_shape.whole_shapes(window, fft_size, power, np.zeros((segments, window.length)))


@lru_cache(maxsize=2)
def _no_shape(window: Window, fft_size: int, power: bool, segments: int) -> Shapes:
    """Tables of all bins of echoes that have no sample of the record."""
    phase, first = np.zeros((segments, window.length)), np.full(segments, window.length)
    return line_shape.whole_shapes(window, fft_size, power, phase, first)


def _sorted(
    part: np.ndarray, which: np.ndarray, shapes: Shapes, centre: np.ndarray, modes: np.ndarray,
    number: np.ndarray,
) -> Together:  # fmt: skip
    """Points by their shapes, so that each of these is made once."""
    order = np.argsort(which, kind="stable")
    parts = map(np.ascontiguousarray, (centre, modes, number))
    return Together(part[order], which[order], shapes, next(parts), next(parts), next(parts))


def _different(shots: Shots, some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of which no two have the same line shapes; which of these each of some points has."""
    begins = () if shots.first_sample is None else shots.first_sample[shots.segments]
    of_all = (
        np.broadcast_to(np.asarray(one, float), shots.size)[some]
        for value in (
            *begins, *(v for error in shots.phase_errors for v in error.values.values())
        )
        for one in (value if isinstance(value, tuple) else (value,))
    )  # fmt: skip
    varying = (v for v in of_all if (v != v[0]).any())
    first_varying = next(varying, None)
    if first_varying is None:
        return some[:1], np.zeros(some.size, np.int64)
    if not shots.alike:
        return some, np.arange(some.size)
    first, which = different_rows([first_varying, *varying])
    return some[first], which


def _phases(shots: Shots, points: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Phase errors [cycles] of points at places x of the record, (segments, points, places).

    Of the part of it that the echo has, where it has not all.
    """
    found = np.zeros((len(shots.waveform), points.size, x.size))
    for segment in np.flatnonzero(shots.segments):
        for error in shots.phase_errors:
            values = error.chosen(int(segment), points)
            found[segment] += error.phase(x, sign=shots.waveform[segment].slope, **values)
    return found


def _some(
    shots: Shots, table: np.ndarray, levels: np.ndarray, together: Together, leaks: int,
    first: int, keep: bool, chances: bool,
) -> tuple[Runs, int]:  # fmt: skip
    """Compute runs of as many points from ``first`` on as there is room for; return how many."""
    part = together.part[first:]
    segments, m = len(shots.waveform), part.size
    bins = shots.bins
    shifts = _shifts(shots, part)
    lines = max(2 * shots.offset.shape[1], MOST_NODES) * max(shifts.shape[3], 1)
    width = max(lines, bins, 2 * MOST_POINTS, LEAST_WIDTH, MOST_CELLS) + 16
    size = max(ROOM_FOR_RUNS, segments * bins) if keep else 0
    numbers = np.zeros((5, segments, m), np.int64)
    values = np.full((4, segments, m), np.nan)
    magnitudes, exempt = np.empty(size), np.empty(size, np.bool_)
    shapes = together.shapes
    places = line_shape.places_of(shapes.sizes)
    form = np.zeros((segments, 7, shapes.reach.shape[1]))
    form[:, 0] = shapes.reach[0]
    rule = shots.echo_rule
    done = _inspect_points(
        np.ascontiguousarray(table[:, part].T),
        np.stack([shots.row[part], together.which[first:], part]),
        shots.footprint,
        (together.centre, together.modes, together.number, shifts),
        shapes._replace(sizes=np.append(shapes.sizes, (view(shots), rule.beside))),
        (_node_limits(shots, together), tangents(shots.fft_size)),
        (shots.segments, levels[part], np.array([leaks * each.leaks for each in shots.waveform]),
         shots.window.sum, rule, shots.speckle_table, chances),
        (np.empty((segments, 2, places)), form),
        (np.empty((ROOM, width)), np.empty(width, np.bool_), np.empty(MOST_TERMS)),
        (numbers, values, magnitudes, exempt),
    )  # fmt: skip
    low, count, peak, exempted, start = numbers[:, :, :done]
    pd, miss, magnitude, leakage = values[:, :, :done]
    return Runs(
        part[:done], low, count, peak, exempted, pd, miss, magnitude, leakage, start, magnitudes,
        exempt, np.ones(low.shape, np.bool_),
    ), done  # fmt: skip


def _node_limits(shots: Shots, together: Together) -> np.ndarray:
    """Limits of nodes of the record's window; of part of it, as if all were at the record's end."""
    if not together.partly:
        return shots.window.node_limits(shots.incoherent)
    tolerances = POWER_TOLERANCES if shots.incoherent else AMPLITUDE_TOLERANCES
    return node_limits((0.0, 1.0), tolerances)


@lru_cache(maxsize=4)
def tangents(fft_size: int) -> np.ndarray:
    """tan(pi k / N) for k = 0 .. N/2, (N // 2 + 1,)."""
    return np.tan(np.pi * np.arange(fft_size // 2 + 1) / fft_size)


def _shifts(shots: Shots, part: np.ndarray) -> np.ndarray:
    """Shifts [bins of fs/N] over which |X|^2 is averaged, and weights, (points, segments, 2, k)."""
    segments = len(shots.waveform)
    if shots.gaussian_width is None:
        found = np.empty((part.size, 2, 0))
    else:
        duration = np.broadcast_to(shots.record_duration, shots.size)[part]
        shifts = gaussian_shifts(fwhm=shots.gaussian_width[part], duration=duration)
        bins = shots.fft_size / shots.window.length
        found = np.stack([bins * shifts.offset, shifts.weight], axis=1)
        # Those of no weight, which wider lines beside a point bring, go to the end.
        order = np.argsort(found[:, 1:] == 0, axis=2, kind="stable")
        found = np.take_along_axis(found, np.broadcast_to(order, found.shape), axis=2)
    by_segment = np.repeat(found[:, None], segments, axis=1)
    drift = np.broadcast_to(shots.look_drift, (segments, shots.size))[:, part].T
    if shots.looks.averaged == 1 or not drift.any():
        return by_segment
    if not by_segment.shape[3]:
        by_segment = np.tile([[0.0], [1.0]], (*drift.shape, 1, 1))
    # Of looks that follow each other closely some stand for all, of the same mean square.
    number = shots.looks.number
    few = min(number, MOST_PLACES)
    place = (np.arange(few) - (few - 1) / 2) * math.sqrt((number**2 - 1) / (few**2 - 1))
    moved = (by_segment[..., :1, :, None] + drift[..., None, None, None] * place).reshape(
        *drift.shape, 1, -1
    )
    weight = np.repeat(by_segment[..., 1:, :] / few, few, axis=3)
    return np.concatenate([moved, weight], axis=2)


@njit(cache=True, error_model="numpy", borrows=True)
def _take_lines(p, where, footprint, centre, shift, window_sum, limits, sizes, room):
    """Lines of a point's segment into rows PLACE .., few for many; origin, number, survey."""
    segment, row = where
    power = sizes[4] != 0
    origin = place_lines(p, segment, footprint, row, sizes, room)
    n = footprint.shape[2]
    apart = centre * sizes[0] / sizes[1]
    for b in range(n):
        room[PLACE, b] += apart
    if p[16] > 0.0:
        n = add_images(room, n, origin, p[16], power)
    whole, squares, lowest, highest = survey(room, n, power)
    if max(-lowest, highest) > 0.5 * sizes[0]:  # lines further apart than there are bins
        fold_lines(room, n, sizes)
        whole, squares, lowest, highest = survey(room, n, power)
    total = math.sqrt(whole) if power else whole
    copies = shift.shape[1] if power else 0
    for turn in range(2 if copies else 1):
        if turn == 1:  # copies of the lines at each shift
            for m in range(copies - 1, -1, -1):
                for b in range(n):
                    room[PLACE, m * n + b] = room[PLACE, b] + shift[0, m]
                    room[RE, m * n + b] = room[RE, b] * shift[1, m]
                    room[IM, m * n + b] = 0.0
            n *= copies
            whole, squares, lowest, highest = survey(room, n, power)
        half = 0.5 * (highest - lowest)
        if n > 2 and p[15] > 0.0:
            error = relative_error(
                whole, squares, n, power, window_sum, p[15] * p[10] / LINE_STEPS, p[11]
            )
            band = np.pi * sizes[1] / sizes[0] * (2.0 if power else 1.0)
            nodes = nodes_for(band * half, error, limits)
            if 4 * nodes < 3 * n and nodes <= MOST_NODES:
                middle = 0.5 * (lowest + highest)
                n = put_on_nodes(room, RE, IM, n, nodes, (middle, half), A_RE, A_IM)
                for b in range(n):
                    room[PLACE, b] = room[X, b]
                    room[RE, b], room[IM, b] = room[A_RE, b], room[A_IM, b]
    return origin, n, total, lowest, highest


@njit(cache=True, error_model="numpy", borrows=True)
def _keep(at, count, room, exempt, magnitudes, exempts):
    """Hands a run on, from ``at`` on; where the next one begins."""
    for k in range(count):
        magnitudes[at + k], exempts[at + k] = room[OUT, k], exempt[k]
    return at + count


@njit(cache=True, nogil=True, error_model="numpy")
def _inspect_points(points, where, footprint, modes, shapes, tables, how, made, work, out):
    """Compute runs of points; return the number of points that there was room for.

    ``points`` are rows of :meth:`sweep.model.preparation.Shots.point_table`; ``where`` (3, m) rows
    in the footprints, shapes, and numbers of the points; ``modes`` and ``shapes`` those of
    :class:`Together`, with shifts (m, segments, 2, k) and with sizes that end in the view and half
    of the echo's main lobe, in whose place a wider pedestal's reach comes; ``tables`` limits of
    nodes, and tangents; ``how`` segments that there are, levels below which bins may be left out,
    each segment's way to look at leakage, the window's sum, the rule of detection, the speckle of
    all points, and true if probabilities of a detection are asked for. ``made`` and ``work`` are
    room for shapes and for spectra. Results (``out``): low, count, peak, exempted and start (5,
    segments, m); pd, miss, magnitude and leakage (4, segments, m); magnitudes and exempt bins of
    runs, which may have no room at all.
    """
    centre, shifts = modes[0], modes[3]
    sizes, limits, tangent = shapes[0], tables[0], tables[1]
    (segments, levels, leaks, window_sum, rule, speckle, chances), (table, form) = how, made
    room, exempt, series = work
    numbers, values, magnitudes, exempts = out
    keep, at = magnitudes.size > 0, np.int64(0)
    rates = no_rates()
    before, made_of = -1.0, np.int64(-1)  # a literal would compile what takes it once more
    lengths, length = shapes.lengths, sizes[1]
    partly = lengths.size > 0
    for i in range(points.shape[0]):
        p, row, which = points[i], where[0, i], where[1, i]
        begun = p[7]
        if which != made_of:
            for s in range(segments.size):
                if segments[s] and partly:
                    twin = line_shape.same_part(s, which, modes, lengths, segments)
                    if twin >= 0:
                        table[s], form[s, 1:] = table[twin], form[twin, 1:]
                    else:
                        sizes[1] = lengths[s, which]
                        line_shape.build_part(s, which, modes, shapes, table[s], form[s])
                elif segments[s]:
                    line_shape.build(s, (which, made_of), modes, shapes, table[s], form[s])
            made_of = which
        sigma, level = p[10], p[11]
        pedestal = PedestalShape(p[18], p[19], p[20])
        sizes[8] = max(rule.beside, int(pedestal.reach))
        threshold = level / sigma
        if rule.fades >= 0.0:  # one table serves thresholds that differ by light's shot noise
            threshold = math.floor(threshold / THRESHOLD_STEP + 0.5) * THRESHOLD_STEP
        if leaks.any() and threshold != before:
            before = threshold
            crossing_series(before, series)
            if rule.fades >= 0.0:
                rates = faded_rates(before, series)
        for s in range(segments.size):
            if not segments[s]:
                continue
            if partly:  # what the echo has of the record is a record of its own
                sizes[1] = lengths[s, which]
                p[7] = begun + (length - lengths[s, which]) / p[6]
            shift = shifts[i, s][:, : np.count_nonzero(shifts[i, s, 1])]  # zeros are last
            origin, n, total, lowest, highest = _take_lines(
                p, (s, row), footprint, centre[s, which], shift, window_sum, limits, sizes, room
            )
            lines = n, lowest, highest, total, p[15] * sigma / LINE_STEPS
            fades = rule.fades >= 0.0
            loudest, leakage = LOUDEST if fades else 1.0, 0.0
            noise = sigma, level, p[14], loudest, rule.sidelobe_correlation
            if leaks[s] == INTEGRAL:
                low, count, peak, exempted, leakage = inspect(
                    origin, lines, noise, table[s], form[s], sizes, tangent, room, exempt, series,
                    rates,
                )  # fmt: skip
            else:
                low, count, peak, exempted = detect(
                    origin, lines, (level, levels[i]), shift[:, : (1 - sizes[4]) * shift.shape[1]],
                    table[s], form[s], sizes, tangent, room, exempt,
                )  # fmt: skip
            if p[16] > 0.0:
                exempted = free_images(room[OUT, :count], exempt[:count], low, sizes[0], p[16])
            if keep:
                if at + count > magnitudes.size:
                    return i
                numbers[4, s, i] = at
                at = _keep(at, count, room, exempt, magnitudes, exempts)
            found, missed = np.nan, np.nan
            if chances:
                found, missed = found_pair(
                    room[OUT, :count], exempt[:count], peak, low, rule,
                    BinLevels(p[13], level, sigma, p[17], pedestal),
                    speckle_of(speckle, s, where[2, i]),
                )  # fmt: skip
            if leaks[s] == BIN_BY_BIN:
                bins = sigma, level, p[14], rule.sidelobe_correlation
                if fades:
                    least = p[12] / math.sqrt(LOUDEST)
                    leakage = of_fading_bins(count, bins, least, room, exempt, rates)
                else:
                    leakage = of_bins(count, bins, p[12], room, exempt, series)
                    if p[16] > 0.0 and rule.pairs.size > 0:
                        leakage = any_neighbour(room[CHANCE], count, rule.pairs)
            low += sizes[0] * (sizes[7] == COMPLEX)  # never below 0
            numbers[0, s, i], numbers[1, s, i], numbers[2, s, i] = low, count, peak
            numbers[3, s, i] = exempted
            values[0, s, i], values[1, s, i] = found, missed
            values[2, s, i], values[3, s, i] = room[OUT, peak], leakage
    return points.shape[0]
