"""Random draws of shots: detections and false alarms counted, batch by batch.

Two ways that agree in the mean. ``probabilities`` is [T 3.3.2]'s: uniform numbers against pd and
the probability of a false alarm (noise and leakage together). ``noise`` adds complex Gaussian
noise to the bins of the echo, alike as window and padding make it, and looks. Over the other bins,
which hold noise alone, the largest magnitude is drawn from the order statistic of as many
independent ones as alarm as often. If effects are random, each draw has a spectrum and
probabilities of its own, and its noise with them: see :mod:`sweep.model.sampling`, which also says
when to stop. Echoes in developed speckle fade by factors that the segments have partly in common,
or, where any bin detects, by the lines of their footprint (:mod:`sweep.model.speckle_lines`).

Every number is addressed by point, draw, cause and index (:mod:`sweep.model.philox`).
"""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model import philox
from sweep.model.alarms import TAPS, noise_filter
from sweep.model.detection import levels_of, pedestal_of_bins
from sweep.model.hoyt import bin_share
from sweep.model.marcum import at_least_one
from sweep.model.philox import (
    STREAM_DETECTION,
    STREAM_FALSE_ALARM,
    STREAM_NOISE,
    STREAM_NOISE_MAXIMUM,
)
from sweep.model.preparation import Shots
from sweep.model.search import middle_lines
from sweep.model.segments import runs_of
from sweep.model.speckle_lines import (
    FACTORED_ROWS_MAX,
    LineFan,
    draw_factored,
    draw_lines,
    factor_bins,
    line_fan,
    line_powers,
)

BOTH = "pd_both_chirps"
"""Probability of a detection in both chirps, beside the outputs where any two segments detect."""

_AT_ONCE = 256
"""Draws of a row whose random numbers are made together."""


class Rows(NamedTuple):
    """Spectra, (m,) each, of a run of draws."""

    point: np.ndarray
    """int64: the point whose counts they add to."""
    keys: np.ndarray
    """(m, 2) uint64: random key of that point."""
    first: np.ndarray
    """int64: number of the first draw."""
    last: np.ndarray
    """int64: number after the last."""


def count_by_chance(
    rows: Rows, ends: np.ndarray, outputs: Mapping[str, np.ndarray], counts: np.ndarray
) -> None:
    """Add the draws of some rows, held against their outputs, to the counts.

    ``ends`` (batches + 1,) are the numbers of draws between batches; the counts, int64, are (names,
    points, batches) in the order of :data:`sweep.model.outputs.DRAW_OUTPUTS`.
    """
    size, chances = rows.point.size, _chances(outputs)
    rule = np.empty((0, TAPS)), np.empty(0, np.int64), 0
    none = False, *rule, np.isfinite(outputs.get(BOTH, np.full(size, np.nan)))
    nothing = Seen.nothing(size), np.empty((0, size))
    circular = np.zeros((3, size), np.int64), np.zeros((1, 0)), 0, LineFan.nothing()
    circular_at = *circular, np.empty((0, 3))
    levels = np.zeros((2, size)), np.zeros((7, size))
    _count(rows, ends, *levels, chances, none, *nothing, circular_at, 0.0, counts)


def count_in_noise(rows: Rows, ends: np.ndarray, shots: Shots, counts: np.ndarray) -> None:
    """Add the draws of some rows, in the noise of their shots, as :func:`count_by_chance` does."""
    levels = noise_levels(shots)
    mixing = np.empty((0, shots.size)) if shots.fading is None else shots.fading.mixing()
    one, speckle = np.exp(-0.5 * levels[0] ** 2), shots.speckle_table
    fan = line_fan(shots)
    for part, seen in seen_spectra(shots):
        others = at_least_one(one[part], seen.others.T)
        chances = np.array([others, *np.zeros((2, *others.shape))])  # in C order
        some = Rows(*(column[part] for column in rows))
        rule = echo_filter(shots, seen)
        own = (
            levels[:, part].copy(),
            shots.bin_levels[:, part].copy(),
            chances,
            (True, *rule, np.full(part.size, shots.any_two)),
            seen,
            mixing[:, part].copy(),
            (
                speckle.row[:, part].copy(), speckle.quadratures, shots.fft_size // 2,
                fan.of(part), np.ascontiguousarray(middle_lines(shots, part, seen.low + seen.peak)),
            ),
            shots.echo_rule.sidelobe_correlation,
        )  # fmt: skip
        _count(some, ends, *own, counts)


def echo_filter(shots: Shots, seen: "Seen", least: int = 0) -> tuple[np.ndarray, np.ndarray, int]:
    """Filter of the noise of an echo's bins, none where the largest alone detects; N or 0.

    It has ``least`` bins where any detects, if that is more than there are. The last is N where
    noise at DC and Nyquist is real.
    """
    most = max(int(seen.bins.max(initial=1)), least) if shots.echo_rule[1] else 0
    bins = 1 << (most - 1).bit_length() if most else 0
    if shots.noise_bins == "independent":
        weights = np.zeros((bins, TAPS))
        weights[:, TAPS // 2] = 1.0
        return weights, np.arange(bins) - TAPS // 2, 0
    return *noise_filter(shots.window, shots.fft_size, bins), shots.real_ends


ROOT_BINS_MAX = 16
"""Bins of which noise is made of as few numbers as there are bins."""


def noise_root(rule: tuple[np.ndarray, np.ndarray, int]) -> np.ndarray:
    """Return the triangular matrix (k, k) that makes the noise of adjacent bins of k numbers.

    Of the filter of :func:`echo_filter`, up to ROOT_BINS_MAX bins; away from DC and Nyquist, where
    :func:`draw_noise` says how bins are alike.
    """
    weights, start, _ = rule
    number = min(weights.shape[0], ROOT_BINS_MAX)
    of_numbers = np.zeros((number, int(start[number - 1] - start[0]) + TAPS if number else 0))
    for k in range(number):
        of_numbers[k, start[k] - start[0] : start[k] - start[0] + TAPS] = weights[k]
    root = np.zeros((number, number))
    for k in range(number):
        for j in range(k + 1):
            shared = (of_numbers[k] * of_numbers[j]).sum() - (root[k, :j] * root[j, :j]).sum()
            if j < k:
                root[k, j] = shared / root[j, j] if root[j, j] > 0 else 0.0
            elif shared > _LEAST_REMAINDER:
                root[k, k] = math.sqrt(shared)
    return root


_LEAST_REMAINDER = 1e-9
"""Share of a bin's noise that its neighbours do not make, below which there is none."""


def _chances(outputs: Mapping[str, np.ndarray]) -> np.ndarray:
    """Probabilities of a false alarm, and of a detection without and with one in the up segment.

    By segment (up, Doppler, down), (3, 3, n); of a detection in the Doppler segment where not one
    alone of the other two has a detection, and where one has, which decides if any two detect.
    """
    up, down, shot = (np.nan_to_num(outputs[f"pd_{name}"]) for name in ("up", "down", "shot"))
    known = outputs.get(BOTH, np.full(up.shape, np.nan))
    both = np.where(np.isfinite(known), known, shot)
    alone, beside = down_given_up(up, down, both)
    doppler = np.nan_to_num(outputs["pd_doppler"])
    odd, added, third = up + down - 2 * both, shot - both, np.isfinite(known)
    with np.errstate(divide="ignore", invalid="ignore"):
        one_more = np.where(third & (odd > 0), np.clip(added / odd, 0.0, 1.0), doppler)
        even = np.clip((doppler - added) / (1 - odd), 0.0, 1.0)
    none_more = np.where(third & (odd < 1), even, doppler)
    noise_up = outputs["pfa_segment"]
    both, one = outputs["log10_pfa_both_chirps"], outputs["log10_pfa_segment"]
    some = np.isfinite(one)  # else the detection occupies every bin
    noise_down = np.where(some, 10 ** (both - np.where(some, one, 0.0)), 0.0)
    alarm_up = 1 - (1 - noise_up) * (1 - outputs["p_leakage_up"])
    alarm_down = 1 - (1 - noise_down) * (1 - outputs["p_leakage_down"])
    alarms = alarm_up, np.zeros_like(alarm_up), alarm_down
    return np.array([alarms, (up, none_more, alone), (up, one_more, beside)])


def down_given_up(up: np.ndarray, down: np.ndarray, both: np.ndarray) -> np.ndarray:
    """Probabilities of a detection in the down segment, without and with one in up, (2, ...).

    From those of either segment and of both.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        alone = np.where(up < 1, np.clip((down - both) / (1 - up), 0.0, 1.0), down)
        return np.stack([alone, np.where(up > 0, np.minimum(both / up, 1.0), down)])


def noise_levels(shots: Shots) -> np.ndarray:
    """Threshold and noise under the lines, over the noise of any other bin, (2, n)."""
    levels = np.stack([shots.threshold, shots.line_deviation]) / shots.bin_deviation
    return np.ascontiguousarray(np.broadcast_to(levels, (2, shots.size)))


ECHO = 1 << 24
"""Numbers of the noise of an echo's bins, from which they count apart from those of single bins."""


class Seen(NamedTuple):
    """Spectra without noise, by point and segment (m, 3), for noise to be added to."""

    low: np.ndarray
    """int64: first of the bins that hold signal, from which they are numbered."""
    peak: np.ndarray
    """int64: number of the largest."""
    ratio: np.ndarray
    """Its |X| / sigma; nan for a segment that does not exist."""
    real: np.ndarray
    """bool: whether noise is real there."""
    start: np.ndarray
    """int64: where the segment's bins begin in the two that follow, from ``low`` on."""
    bins: np.ndarray
    """int64: number of these."""
    ratios: np.ndarray
    """|X| / sigma of all bins."""
    echo: np.ndarray
    """bool: whether they are of the echo."""
    others: np.ndarray
    """Bins that count for false alarms and hold noise alone."""
    stretch: np.ndarray
    """(m, 3, 2) int64: first of the bins below, and after the last; none without leakage."""
    aside: np.ndarray
    """int64: numbers of bins of leaked signal, that may raise a false alarm by themselves."""
    leaked: np.ndarray
    """|X| / sigma of them."""
    edge: np.ndarray
    """|X| / sigma of the bin next to each of them that is exempt from false alarms, 0 for none."""
    side: np.ndarray
    """int64: 1 where that bin is above, else -1."""

    @classmethod
    def nothing(cls, points: int) -> "Seen":
        """No spectra, for what is drawn against probabilities."""
        low, stretch = np.zeros((points, 3), np.int64), np.zeros((points, 3, 2), np.int64)
        none, others = np.full((points, 3), np.nan), np.zeros((points, 3))
        numbers, values = np.empty(0, np.int64), np.empty(0)
        bins = low, low, values, np.empty(0, np.bool_)
        leaked = numbers, values, values, numbers
        return cls(low, low, none, np.zeros((points, 3), np.bool_), *bins, others, stretch, *leaked)


def seen_spectra(
    shots: Shots, points: np.ndarray | None = None
) -> Iterator[tuple[np.ndarray, Seen]]:
    """Yield points of some shots, all or those of ``points``, and their spectra.

    As many at once as memory holds.
    """
    sigma, is_real = shots.bin_deviation, shots.real_ends > 0
    # Without leakage none but the peak is looked at.
    floor = shots.floor + np.zeros(shots.size) if shots.leakage else np.full(shots.size, np.inf)
    least = np.minimum(shots.threshold, floor * sigma)
    for runs in runs_of(shots, points=points, least=least, leakage=False, chances=False):
        count, start, peak = (c.T.ravel() for c in (runs.bins, runs.start, runs.peak))
        run = np.repeat(np.arange(count.size), count)  # of each bin, point by point
        number = np.arange(run.size) - (np.cumsum(count) - count)[run]
        at, point = start[run] + number, runs.part[run // 3]
        ratio = runs.magnitudes[at] / sigma[point]
        inside = runs.inside.T.ravel()
        leaks = (ratio >= floor[point]) & ((number != peak[run]) | ~inside[run])
        leaks &= ~runs.exempt[at]
        edges = np.pad(np.where(runs.exempt[at], ratio, 0.0), 1)
        below = np.where(number > 0, edges[:-2], 0.0)
        above = np.where(number < count[run] - 1, edges[2:], 0.0)
        leaking = np.bincount(run[leaks], minlength=count.size).reshape(-1, 3)
        after = np.cumsum(leaking).reshape(-1, 3)
        there = runs.bins.T > 0
        exempted = np.where(there, runs.exempted.T, 0.0)
        others = shots.counted_bins(exempted.T, runs.part).T - leaking
        seen = Seen(
            low=np.where(there, runs.low.T, 0),
            peak=np.where(there, runs.peak.T, 0),
            real=np.isin((runs.low + runs.peak).T, (0, shots.real_ends / 2)) & there & is_real,
            ratio=np.where(
                there & runs.inside.T, runs.magnitude.T / sigma[runs.part, None], np.nan
            ),
            start=(np.cumsum(count) - count).reshape(-1, 3),
            bins=runs.bins.T,
            ratios=ratio,
            echo=runs.exempt[at],
            others=np.maximum(others, 0.0),
            stretch=np.stack([after - leaking, after], axis=2),
            aside=number[leaks],
            leaked=ratio[leaks],
            edge=np.maximum(below, above)[leaks],
            side=np.where(above >= below, 1, -1)[leaks],
        )
        # In C order as those of `nothing`: numba compiles anew for each order.
        yield runs.part, Seen(*map(np.ascontiguousarray, seen))


@njit(cache=True, nogil=True, error_model="numpy")
def _count(
    rows, ends, levels, of_bins, chances, how, seen, mixing, quadratures, correlation, counts
):  # fmt: skip
    """Add the draws of each row to the counts.

    ``how``: whether in noise; filter of an echo's noise, as of :func:`echo_filter`; whether any
    two segments detect a shot. ``levels`` (2,
    m): :func:`noise_levels`; ``of_bins`` (7, m) the levels of bins of which any detects
    (:class:`sweep.model.detection.BinLevels`). ``chances`` (3, 3, m): those of a false alarm in
    bins that are not looked at one by one, and, of no meaning in noise, of a detection without and
    with one in the up segment. ``mixing`` (6, m): :meth:`sweep.model.detection.Fading.mixing`, or
    nothing.
    ``quadratures``: rows (3, m) of the pseudo-variances near DC and Nyquist
    (:class:`sweep.model.quadratures.SignalQuadratures`), these, and N/2; lines of footprints in
    developed speckle, and their middles (m, 3) [bins]. ``correlation``: that of neighbours' noise
    in phase with the signal.
    """
    noisy, weights, start, real_ends, any_two = how
    noise_of_bins = np.empty((4, weights.shape[0] + weights.shape[1]))
    words = np.empty((4, _AT_ONCE), np.uint64)
    factors, amplitudes = np.ones((3, _AT_ONCE)), np.zeros((3, 2, _AT_ONCE))
    along, across = np.ones(_AT_ONCE), np.zeros(_AT_ONCE)
    no_bins = np.zeros((3, 0, 0), np.complex128)
    hits, alarms = np.empty((2, 3, _AT_ONCE), np.bool_)
    for j in range(rows.point.size):
        threshold, under_lines = levels[0, j] * levels[0, j], levels[1, j]
        i, batch = rows.point[j], 0
        for first in range(rows.first[j], rows.last[j], _AT_ONCE):
            number = min(_AT_ONCE, rows.last[j] - first)
            address = rows.keys[j, 0], rows.keys[j, 1], first, number
            hits[:], alarms[:] = False, False
            for d in range(number if mixing.shape[0] > 0 else 0):
                one, other, last = fading_amplitudes(address[:2], first + d, 0, mixing[:, j])
                for part in range(2):
                    amplitudes[0, part, d], amplitudes[1, part, d] = one[part], other[part]
                    amplitudes[2, part, d] = last[part]
                for s in range(3):
                    factors[s, d] = math.hypot(amplitudes[s, 0, d], amplitudes[s, 1, d])
            bins = no_bins
            if mixing.shape[0] > 0 and weights.size > 0:
                bins = _draw_echoes(address, j, seen, quadratures, factors)
            for s in (0, 2, 1):
                stream, ratio, peak = STREAM_NOISE[s], seen.ratio[j, s], seen.peak[j, s]
                row = quadratures[0][s, j]
                shares = quadratures[1][row, : (quadratures[1].shape[1] if row > 0 else 0)]
                if noisy and weights.size > 0:
                    _cross_any(
                        address, (j, s), seen, (weights, start, real_ends), levels_of(of_bins, j),
                        bins[s], noise_of_bins, hits[s],
                    )  # fmt: skip
                elif noisy:
                    noise = under_lines, under_lines
                    if seen.real[j, s]:
                        noise = math.sqrt(2.0) * under_lines, 0.0
                    along[:], across[:] = factors[s], 0.0
                    if row > 0:
                        share = bin_share(seen.low[j, s] + peak, quadratures[2], shares)
                        along[:] = math.sqrt(1.0 + share) * amplitudes[s, 0]
                        across[:] = math.sqrt(max(1.0 - share, 0.0)) * amplitudes[s, 1]
                    line = ratio, noise, threshold, along, across
                    _cross(address, stream, peak, line, words, hits[s])
                else:
                    either = chances[1, s, j], chances[2, s, j]
                    one = hits[0] if s == 2 else hits[0] ^ hits[2]
                    _happen(address, STREAM_DETECTION[s], either, one, words, hits[s])
                if chances[0, s, j] > 0.0:
                    largest = STREAM_NOISE_MAXIMUM[s] if noisy else STREAM_FALSE_ALARM[s]
                    chance = chances[0, s, j], chances[0, s, j]
                    _happen(address, largest, chance, hits[0], words, alarms[s])
                _alarm_by_leakage(
                    address, (j, s), seen, levels[0, j], correlation, factors[s], words, alarms[s]
                )
            for d in range(number):
                while first + d >= ends[batch + 1]:
                    batch += 1
                counts[0, i, batch] += hits[0, d]
                counts[1, i, batch] += hits[2, d]
                counts[2, i, batch] += hits[1, d]
                third = any_two[j] & hits[1, d] & (hits[0, d] | hits[2, d])
                counts[3, i, batch] += (hits[0, d] & hits[2, d]) | third
                counts[4, i, batch] += alarms[0, d]
                counts[5, i, batch] += alarms[2, d]
                counts[6, i, batch] += alarms[0, d] & alarms[2, d]


@njit(cache=True, error_model="numpy")
def _alarm_by_leakage(address, at, seen, level, correlation, factors, words, alarms):
    """Mark the draws in which bins of leaked signal, with their noise, raise a further group.

    Bins that cross next to an echo whose outermost bin crosses are part of the echo.

    Parameters
    ----------
    address
        Key (two uint64), first draw, and number of draws.
    at
        Point and segment.
    seen
        :class:`Seen`.
    level
        Threshold [sigma].
    correlation
        Correlation of neighbours' noise in phase with the signal.
    factors
        (draws,): factors on magnitudes by speckle.
    words
        Room for random numbers (4, draws).
    alarms
        Result (draws,), bool: True where they do.
    """
    stream, number = STREAM_NOISE[at[1]], address[3]
    rest = math.sqrt(1.0 - correlation * correlation)
    nothing, of_echo = np.zeros(number), np.zeros(number, np.bool_)
    begin, end = seen.stretch[at]
    # A group that begins beside an echo is the echo's to its end, and one that ends beside an echo
    # from its begin: an alarm waits until its group ends.
    waits, crosses = np.zeros(number, np.bool_), np.empty(number, np.bool_)
    for k in range(begin, end):
        if k > begin and seen.aside[k] != seen.aside[k - 1] + 1:
            for d in range(number):
                alarms[d] |= waits[d]
                waits[d] = of_echo[d] = False
        crosses[:] = False
        line = seen.leaked[k], (1.0, 1.0), level * level, factors, nothing
        _cross(address, stream, seen.aside[k], line, words, crosses)
        for d in range(number):
            if not crosses[d]:
                alarms[d] |= waits[d]
                waits[d] = of_echo[d] = False
                continue
            if seen.edge[k] > 0.0:
                draw = address[2] + d
                re, im = philox.normal_pair(address[0], address[1], draw, stream, seen.aside[k])
                edge = seen.aside[k] + seen.side[k]
                re_edge, im_edge = philox.normal_pair(address[0], address[1], draw, stream, edge)
                along = seen.edge[k] * factors[d] + correlation * re + rest * re_edge
                across = correlation * im + rest * im_edge
                of_echo[d] |= math.hypot(along, across) >= level
            waits[d] = not of_echo[d]
    for d in range(number):
        alarms[d] |= waits[d]


@njit(cache=True, error_model="numpy", borrows=True)
def fading_factors(key, draw, group, mixing):
    """Factors of a draw on a group's magnitudes in the three segments; their mean square is 1."""
    one, other, last = fading_amplitudes(key, draw, group, mixing)
    return math.hypot(one[0], one[1]), math.hypot(other[0], other[1]), math.hypot(last[0], last[1])


@njit(cache=True, error_model="numpy", borrows=True)
def fading_amplitudes(key, draw, group, mixing):
    """Amplitudes of a draw of a group in the three segments, complex; their mean square is 1.

    Three standard normal amplitudes of the stream, those of the group's number, mixed.
    """
    stream, half = philox.STREAM_SPECKLE, math.sqrt(0.5)
    a, b = philox.normal_pair(key[0], key[1], draw, stream, 3 * group)
    c, d = philox.normal_pair(key[0], key[1], draw, stream, 3 * group + 1)
    e, f = philox.normal_pair(key[0], key[1], draw, stream, 3 * group + 2)
    near, own, far, re, im, rest = mixing
    second = half * (near * a + own * c), half * (near * b + own * d)
    last_re = far * a + (re * c - im * d) + rest * e
    last_im = far * b + (re * d + im * c) + rest * f
    return (half * a, half * b), second, (half * last_re, half * last_im)


@njit(cache=True, error_model="numpy", borrows=True)
def _happen(address, stream, chances, given, words, found):
    """Mark the draws (key, first, number) in which something happens, by two probabilities.

    The second is that of draws that are ``given``. These may be the ones that are marked.
    """
    philox.fill_words(address[:3], stream, philox.FIRST_BLOCK, philox.BY_DRAW, address[3], words)
    for d in range(address[3]):
        chance = chances[1] if given[d] else chances[0]
        found[d] |= philox.to_uniform(words[0, d]) < chance


@njit(cache=True, error_model="numpy")
def _ends_of_echo(at, seen):
    """First and last bin of an echo, from those of the spectrum; the last is -1 of none."""
    begin, count = seen.start[at], seen.bins[at]
    first, last = 0, count - 1
    while first < count and not seen.echo[begin + first]:
        first += 1
    while last > first and not seen.echo[begin + last]:
        last -= 1
    return first, (last if first < count else -1)


@njit(cache=True, error_model="numpy")
def _draw_echoes(address, j, seen, speckle, factors):
    """Draw amplitudes (3, draws, bins) of an echo's bins in developed speckle, of mean power 1.

    Those of the lines of its footprint; bins that no line reaches have that of the strongest bin.
    ``factors`` (3, draws) takes the size of the strongest bin's. ``speckle`` is the ``quadratures``
    of :func:`_count`.
    """
    fan, middle = speckle[3], speckle[4][j].copy()
    first, widest = np.zeros(3, np.int64), 0
    low = np.zeros(3, np.int64)
    for s in range(3):
        begin, end = _ends_of_echo((j, s), seen)
        first[s], low[s] = seen.low[j, s] + begin, begin
        widest = max(widest, end - begin + 1)
        if end < begin:
            middle[s] = np.nan
    power, pseudo = np.zeros((3, widest)), np.zeros((3, widest))
    imaged = line_powers(fan, j, middle, first, power, pseudo)
    rows, rank = 3 * widest, 0
    factor = np.empty((rows if rows <= FACTORED_ROWS_MAX else 0, 3, widest), np.complex128)
    if factor.shape[0] > 0 and not imaged:
        rank = factor_bins(fan, j, middle, first, power, factor)
    out, one = (
        np.zeros((3, address[3], widest), np.complex128),
        np.zeros((3, widest), np.complex128),
    )
    for d in range(address[3]):
        draw = address[0], address[1], address[2] + d
        if rank > 0:
            draw_factored(draw, 0, factor, rank, one)
        else:
            draw_lines(draw, 0, fan, j, middle, first, power, one)
        for s in range(3):
            peak = seen.peak[j, s] - low[s]
            if not 0 <= peak < widest:
                continue
            factors[s, d] = abs(one[s, peak])
            for k in range(widest):
                out[s, d, k] = one[s, k] if power[s, k] > 0.0 else one[s, peak]
    return out


@njit(cache=True, error_model="numpy")
def _cross_any(address, at, seen, rule, levels, speckle, room, found):
    """Mark the draws in which any bin of an echo, with its noise, reaches the threshold.

    ``levels`` are the :class:`sweep.model.detection.BinLevels` of the point. ``speckle`` (draws,
    bins): amplitudes of the echo's bins, of none if it does not fade. A pedestal fades as they do.
    """
    begin, count = seen.start[at], seen.bins[at]
    ratios, echo = seen.ratios[begin : begin + count], seen.echo[begin : begin + count]
    first, last = _ends_of_echo(at, seen)
    if last < 0:
        return
    threshold = levels.threshold / levels.quiet
    pedestal = np.zeros(count)
    if levels.beside > levels.quiet or levels.line > levels.quiet:
        pedestal_of_bins(ratios, echo, levels, pedestal)
    for d in range(address[3]):
        draw = address[0], address[1], address[2] + d, STREAM_NOISE[at[1]]
        draw_noise(draw, ECHO, seen.low[at] + first, last - first + 1, rule, room)
        for i in range(first, last + 1):
            faded = speckle[d, i - first] if speckle.shape[1] > 0 else complex(1.0, 0.0)
            deviation = math.sqrt(1.0 + pedestal[i] * abs(faded) ** 2)
            re = deviation * room[0, i - first] + ratios[i] * faded.real
            im = deviation * room[1, i - first] + ratios[i] * faded.imag
            found[d] |= echo[i] and re * re + im * im >= threshold * threshold


@njit(cache=True, error_model="numpy", borrows=True)
def draw_noise(draw, number, low, count, rule, room):
    """Noise of adjacent bins over sigma, in phase with the signal and across, to rows 0 and 1.

    ``draw``: key of the point, number of the draw, stream; independent numbers count from
    ``number``. ``low``, ``count``: first bin, number of bins. ``rule``: :func:`echo_filter`.
    ``room`` (4, >= count + TAPS): result, and the independent numbers.
    """
    weights, start, ends = rule
    taps = weights.shape[1]
    turned = ends > 0 and 2 * (low + count - 1) == ends  # counted from Nyquist
    is_even = turned or (ends > 0 and low == 0)
    first = 0 if is_even else start[0]
    for j in range(start[count - 1] + taps - first):
        re, im = philox.normal_pair(draw[0], draw[1], draw[2], draw[3], number + j)
        if is_even and j == 0:
            re, im = math.sqrt(2.0) * re, 0.0
        room[2, j], room[3, j] = re, im
    for k in range(count):
        re, im = 0.0, 0.0
        for m in range(taps):
            j = start[k] + m - first
            sign = -1.0 if is_even and j < 0 else 1.0  # a real record's are conjugate
            re += weights[k, m] * room[2, abs(j)]
            im += weights[k, m] * sign * room[3, abs(j)]
        i = count - 1 - k if turned else k
        room[0, i], room[1, i] = re, im


@njit(cache=True, error_model="numpy", borrows=True)
def draw_noise_by_root(draw, number, count, root, room):
    """Noise of ``count`` adjacent bins over sigma, to rows 0 and 1 of ``room`` (4, >= count).

    ``draw`` and ``number`` are as of :func:`draw_noise`, with an even number; ``root`` is
    :func:`noise_root`.
    """
    for k in range(0, count, 2):
        words = philox.words4(draw[0], draw[1], draw[2], draw[3], (number + k) >> 1)
        room[2, k], room[3, k] = philox.to_normals(words[0], words[1])
        if k + 1 < count:
            room[2, k + 1], room[3, k + 1] = philox.to_normals(words[2], words[3])
    for k in range(count):
        re, im = 0.0, 0.0
        for j in range(k + 1):
            re += root[k, j] * room[2, j]
            im += root[k, j] * room[3, j]
        room[0, k], room[1, k] = re, im


@njit(cache=True, error_model="numpy", borrows=True)
def _cross(address, stream, index, line, words, found):
    """Mark the draws in which a bin, with its noise, reaches the threshold.

    ``index``: pair of the stream that the noise is. ``line``: |X| / sigma; the noise's deviations
    in its phase and across; the threshold, a power; factors on |X| in both, draw by draw.
    """
    ratio, deviation, threshold, along, across = line
    philox.fill_words(address[:3], stream, index >> 1, philox.BY_DRAW, address[3], words)
    lane = 2 * (index & 1)
    for d in range(address[3]):
        re, im = philox.to_normals(words[lane, d], words[lane + 1, d])
        re, im = ratio * along[d] + re * deviation[0], ratio * across[d] + im * deviation[1]
        found[d] |= re**2 + im**2 >= threshold


@njit(cache=True, error_model="numpy")
def largest_of(number, chance, looks):
    """|X| / sigma that the largest of so many bins of noise exceeds with the given probability.

    The root of the mean power of some looks.
    """
    if not number > 0.0:
        return 0.0
    if looks > 1:
        each = -math.expm1(math.log1p(-chance) / number)
        return math.sqrt(2.0 * gamma_exceeded(looks, each) / looks)
    return math.sqrt(-2.0 * math.log(-math.expm1(math.log1p(-chance) / number)))


@njit(cache=True, error_model="numpy")
def gamma_exceeded(order, chance):
    """Return x of Q(n, x) = `chance`, which a Gamma variable of whole order exceeds."""
    low, high = 0.0, 2.0 * (order + 40.0 - math.log(max(chance, 1e-300)))
    for _ in range(60):
        x = 0.5 * (low + high)
        term = total = 1.0
        for k in range(1, order):
            term *= x / k
            total += term
        if math.log(total) - x > math.log(max(chance, 1e-300)):
            low = x
        else:
            high = x
    return 0.5 * (low + high)
