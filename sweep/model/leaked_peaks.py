"""False peaks that leaked signal raises: in which bins, how often, and how large.

Each bin of a segment outside the echoes raises a false peak for two reasons, which are drawn apart.
Noise alone does so in all bins searched alike. Leaked signal of amplitude a (over the noise per
quadrature sigma) raises bin k in further draws, with the probability that it adds to noise,

    c_k(z) = (Q_1(a_k, z) - e^(-z^2 / 2)) / (1 - e^(-z^2 / 2)),

at the threshold z = b. The two together leave the bin below any level z with the probability

    (1 - e^(-z^2 / 2)) (1 - c_k(z)) = 1 - Q_1(a_k, z)

that Rice's law has for signal and noise. So a bin is found at its own place and as large as in
drawn noise, and the probability of leakage of a segment is 1 - prod (1 - c_k(b)).

Bins are independent. With the rates r_k = -ln(1 - c_k), the first bin in which a peak is raised is
the one where the sum of rates exceeds a number from the exponential distribution. The search goes
on from the next bin with another such number.

Bins that cross next to an echo whose outermost bin crosses are part of the echo, where peaks are
drawn as in probabilities (:mod:`sweep.model.crossings`).

An echo in developed speckle fades as a whole, and its leaked signal with it. A bin fades with the
echo whose strongest bin is nearest. The probability of leakage is then the mean over speckle. With
the speckle's power u = e^t, of mean 1, and the sum R(u) of an echo's rates r(a_k sqrt(u)) it is

    P = int (1 - exp(-R(e^t))) e^(t - e^t) dt,

by the trapezoidal rule, which converges exponentially as the integrand vanishes at both ends. Its
nodes are a whole number of steps of the tabulated ln(a) apart. A bin's rates at all nodes are then
one row of a table (:func:`_rates_by_phase`), and R is a weighted sum of rows, without a logarithm.

A line of leaked light (:mod:`sweep.model.effects.circulator_leak`) raises peaks in its own bins, by
the magnitudes that it has there at one of some phases.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from sweep.kernel_cache import njit
from sweep.model import philox
from sweep.model.crossings import edge_crossing, silence
from sweep.model.draws import Seen, seen_spectra
from sweep.model.effects.circulator_leak import PHASES, bins_of_line, line_of
from sweep.model.groups import Groups, add_groups, room_for_groups
from sweep.model.looks import Looks
from sweep.model.marcum import excess_crossing, marcum_q1_pair
from sweep.model.preparation import Shots
from sweep.model.segments import Runs, runs_of

RATES = 2048
"""Number of amplitudes at which rates are tabulated."""

SURE = 12.0
"""Amplitude above the threshold [sigma] from which a bin is certain to cross."""

FAINTEST = 1e-2
"""Lowest tabulated amplitude [sigma]; below it rates go as the amplitude squared."""

SELDOM = 1e-9
"""Probability of leakage in a segment below which no leaked peaks are drawn."""

LINE = 1 << 24
"""First random number of the leaked light's line; lower ones belong to the echoes."""

EDGES = 1 << 25
"""Numbers of the random numbers of bins of an echo next to leaked signal, likewise."""

POINTS_WITH_LINE = 4
"""Points processed at a time if leaked light has a line, which bounds memory to 1e8 numbers."""

HALVINGS = 40
"""Bisection steps for the magnitude of a raised peak; relative error 1e-11."""

LOG_POWER_MIN, LOG_POWER_MAX = -10.0, 3.5
"""Ends of the average over speckle in ln(power), whose mean power is 1."""

LOG_POWER_MIN_FAINT = -5.0
"""Lower end where rates at mean power are FAINT_RATES or less in all, and below it go as power."""
FAINT_RATES = 0.1

LOG_POWER_STEP_MAX = 0.25
"""Largest step of this average, which errs by 1e-8 of the mean for e^(2 t - e^t)."""

JOINED_RATE_MIN = 1e-2
"""Rate at the power e^(2 BRIGHT) of bins in a row below which the next one joins no echo."""
BRIGHT = math.log(4.0)

FAINT_LEAKAGE = 1e-5
"""Probability of leakage up to which its mean over speckle is the sum of the means of its bins.

Two bins then hardly ever cross together, nor a bin with the echo that it would join."""

MEAN_STEP = 8
"""Tabulated amplitudes from one to the next at which a bin's mean over speckle is integrated."""

OCTAVES = 5
"""Speckle powers 1, 2, 4 .. at which bounds of the rates' sum are kept."""

EDGE_STEP = 0.75
"""Step in ln(power) at which the probability that an echo's outermost bin crosses is computed."""
EDGE_DEPTH = 3.0
"""-ln(power) below which this probability is taken to be that at it."""

CROSSING_STEP_MAX = 0.5
"""Largest step of ln(rate) between nodes: what crosses within fewer ones errs by more than 1e-7."""


class LeakedPeaks(NamedTuple):
    """Bins in which leaked signal may raise false peaks, by point and segment (m, 3)."""

    stretch: np.ndarray
    """(m, 3, 2) int64: begin and end of each segment in ``bin``, ``amplitude`` and ``echo``."""
    bin: np.ndarray
    """int64: bins with leaked echo, numbered as :attr:`sweep.model.groups.Groups.bin`."""
    amplitude: np.ndarray
    """ln(|X| / sigma) in these bins."""
    echo: np.ndarray
    """int64: index of the group (echo) with which each bin fades."""
    edge: np.ndarray
    """|X| / sigma of the bin next to it that is exempt from false alarms, 0 for none."""
    side: np.ndarray
    """int64: 1 where that bin is above, else -1."""
    total: np.ndarray
    """(m, 3): sum of the rates of these bins at mean speckle power, or somewhat more."""
    bound: np.ndarray
    """(m, 3, OCTAVES): the same at speckle powers 1, 2, 4 .."""
    faint: np.ndarray
    """(m, 3): sum of the mean probabilities over speckle that these bins cross; nan if unknown."""
    line_stretch: np.ndarray
    """(m, 3, 2) int64: begin and end of each segment in ``line_bin`` and ``line_amplitude``."""
    line_bin: np.ndarray
    line_amplitude: np.ndarray
    """(PHASES, bins): ln(|X| / sigma) in these bins at each phase of the leaked light's line."""
    line_total: np.ndarray
    """(m, 3): largest over the phases of the sum of the rates of these bins."""
    barred_stretch: np.ndarray
    """(m, 3, 2) int64: begin and end of each segment in ``barred_bin``."""
    barred_bin: np.ndarray
    """int64: bins in which noise alone raises no peak."""
    law: np.ndarray
    """(m,) int64: row of ``rates`` and ``scale`` of each point."""
    rates: np.ndarray
    """(laws, RATES): ln(rate) at evenly spaced ln(amplitude)."""
    scale: np.ndarray
    """(laws, 2): first of these ln(amplitude), and their step."""
    level: np.ndarray
    """(laws,): threshold [sigma] of a record that detects as all looks do."""
    sharper: float
    """Factor on |X| / sigma with which that record has it."""
    correlation: float
    """Correlation of neighbours' noise in phase with the signal."""

    @classmethod
    def nothing(cls, points: int) -> "LeakedPeaks":
        """Return no bins at all, for ``points`` points."""
        none, bins, sums = np.zeros((points, 3, 2), np.int64), np.empty(0, np.int64), (points, 3)
        return cls(
            none, bins, np.empty(0), bins, np.empty(0), bins, np.zeros(sums),
            np.zeros((*sums, OCTAVES)), np.full(sums, np.nan), none, bins,
            np.empty((PHASES, 0)), np.zeros(sums), none, bins, np.zeros(points, np.int64),
            np.zeros((1, 1)), np.zeros((1, 2)), np.zeros(1), 1.0, 0.0,
        )  # fmt: skip

    def of(self, points: np.ndarray) -> "LeakedPeaks":
        """Bins of some points by their numbers, or a mask; lists of bins stay whole."""
        by_point = (
            "stretch", "total", "bound", "faint", "line_stretch", "line_total", "barred_stretch",
            "law",
        )  # fmt: skip
        return self._replace(**{name: getattr(self, name)[points] for name in by_point})

    def mean_leakage(self) -> np.ndarray:
        """Return the mean probability of leakage over speckle and the line's phase, (m, 3)."""
        means = np.empty(self.total.shape)
        _average(self, means)
        return means


def leaking_points(shots: Shots, found: Groups) -> np.ndarray:
    """Return the indices of points whose probability of leakage exceeds SELDOM in any segment."""
    return np.flatnonzero((found.leakage > SELDOM).any(axis=1))


def echo_of_bins(shots: Shots, found: Groups, part: np.ndarray, seen: Seen) -> np.ndarray:
    """Return the group with which each leaking bin fades, that of the nearest strongest bin.

    ``part`` are the points of ``seen``; distances of a complex record are around the circle.
    """
    bins, point, segment = _leaked_bins(seen)
    groups = found.bin[part[point], segment]
    apart = np.abs(bins[:, None] - groups)
    if shots.complex_record:
        apart = np.minimum(apart % shots.fft_size, -apart % shots.fft_size)
    return np.where(groups < 0, np.iinfo(np.int64).max, apart).argmin(axis=1)


def peaks_in_noise(shots: Shots, found: Groups, part: np.ndarray, seen: Seen) -> LeakedPeaks:
    """List bins whose noise is drawn with their signal; noise alone raises no peak there.

    No bin of the result raises leaked peaks; ``echo`` holds the group of each listed bin.
    """
    return LeakedPeaks.nothing(part.size)._replace(
        echo=echo_of_bins(shots, found, part, seen),
        barred_stretch=seen.stretch,
        barred_bin=_leaked_bins(seen)[0],
    )


def leaked_peaks(
    shots: Shots, found: Groups, points: np.ndarray
) -> Iterator[tuple[np.ndarray, LeakedPeaks]]:
    """Yield batches of ``points``: their indices, and the bins of their leaked signal."""
    if shots.leak_amplitude is None:
        for runs in _runs_with_leakage(shots, points):
            yield runs.part, _leaks_of_runs(shots, found, runs)
        return
    echoes_alone = replace(shots, leak_amplitude=None)
    for first in range(0, points.size, POINTS_WITH_LINE):
        for part, seen in seen_spectra(echoes_alone, points[first : first + POINTS_WITH_LINE]):
            echo = echo_of_bins(shots, found, part, seen)
            seen, echo, leaks = _with_line(shots, part, seen, echo)
            leaks = leaks._replace(
                stretch=seen.stretch, bin=_leaked_bins(seen)[0], amplitude=np.log(seen.leaked),
                echo=echo, edge=seen.edge, side=seen.side,
            )  # fmt: skip
            yield part, _with_rates(shots, part, leaks)


def groups_with_leaks(
    shots: Shots, most: int
) -> tuple[Groups, list[tuple[np.ndarray, LeakedPeaks]]]:
    """Find groups as :func:`sweep.model.groups.groups` does, and list their leaked peaks.

    Of echoes in developed speckle, which are searched for both at once. The probability of leakage
    is its mean over speckle. A search band, or a line of leaked light, takes two searches.
    """
    bins, found = room_for_groups(shots.size, most)
    listed = []
    for runs in _runs_with_leakage(shots, np.arange(shots.size)):
        add_groups(shots, runs, bins, found)
        leaks = _leaks_of_runs(shots, found, runs)
        found.leakage[runs.part] = leaks.mean_leakage()
        listed.append((runs.part, leaks))
    return found, listed


def _runs_with_leakage(shots: Shots, points: np.ndarray) -> Iterator[Runs]:
    """Yield runs of all bins of points that may leak."""
    least = np.minimum(shots.threshold, _leaking_from(shots) * shots.bin_deviation)
    return runs_of(shots, points=points, least=least, leakage=False, chances=False)


def _leaking_from(shots: Shots) -> np.ndarray:
    """|X| / sigma from which bins of points may leak, (n,)."""
    return np.broadcast_to(shots.floor if shots.leakage else np.inf, shots.size)


def _leaks_of_runs(shots: Shots, found: Groups, runs: Runs) -> LeakedPeaks:
    """List the bins of leaked signal in runs of points."""
    low, count, peak, start = (
        np.ascontiguousarray(v) for v in (runs.low, runs.bins, runs.peak, runs.start)
    )
    bins, echo, side = np.empty((3, count.sum()), np.int64)
    amplitude, edge = np.empty((2, bins.size))
    stretch = np.empty((runs.part.size, 3, 2), np.int64)
    number = _list_leaked(
        runs.part, low, count, peak, start, np.ascontiguousarray(runs.inside), runs.magnitudes,
        runs.exempt, np.array(np.broadcast_to(shots.bin_deviation, shots.size)),
        np.array(_leaking_from(shots)), np.ascontiguousarray(found.bin),
        shots.fft_size if shots.complex_record else 0, stretch, bins, amplitude, echo, edge, side,
    )  # fmt: skip
    leaks = LeakedPeaks.nothing(runs.part.size)._replace(
        stretch=stretch, bin=bins[:number], amplitude=amplitude[:number], echo=echo[:number],
        edge=edge[:number], side=side[:number],
    )  # fmt: skip
    return _with_rates(shots, runs.part, leaks)


@njit(cache=True, nogil=True, error_model="numpy", borrows=True)
def _list_leaked(
    part, low, count, peak, start, inside, magnitudes, exempt, sigma, least, groups, circle,
    stretch, bins, amplitude, echo, edge, side,
):  # fmt: skip
    """List the bins of leaked signal in runs; return their number.

    Parameters
    ----------
    part
        (m,): points of the runs.
    low, count, peak, start, inside
        (3, m): first bin, number of bins, place of the largest, begin in ``magnitudes`` and
        ``exempt``, and whether the largest is searched, by segment.
    magnitudes, exempt
        |X| [V] of all bins, and whether they are of an echo.
    sigma, least
        (n,): noise per quadrature [V], and |X| / sigma from which bins of points may leak.
    groups
        (n, 3, most): strongest bins of groups, -1 for none.
    circle
        Number of bins of a complex record, else 0.
    stretch, bins, amplitude, echo, edge, side
        Results, as of :class:`LeakedPeaks`.
    """
    number = 0
    for j in range(part.size):
        i = part[j]
        for s in range(3):
            stretch[j, s, 0] = number
            begin = start[s, j]
            for k in range(count[s, j]):
                at = begin + k
                ratio = magnitudes[at] / sigma[i]
                if exempt[at] or not ratio >= least[i] or (k == peak[s, j] and inside[s, j]):
                    continue
                below, above = 0.0, 0.0
                if k > 0 and exempt[at - 1]:
                    below = magnitudes[at - 1] / sigma[i]
                if k + 1 < count[s, j] and exempt[at + 1]:
                    above = magnitudes[at + 1] / sigma[i]
                nearest, group = np.int64(1) << 62, 0
                for g in range(groups.shape[2]):
                    if groups[i, s, g] < 0:
                        continue
                    apart = abs(low[s, j] + k - groups[i, s, g])
                    if circle > 0:
                        apart = min(apart % circle, -apart % circle)
                    if apart < nearest:
                        nearest, group = apart, g
                bins[number], amplitude[number] = low[s, j] + k, math.log(ratio)
                echo[number], edge[number] = group, max(below, above)
                side[number] = 1 if above >= below else -1
                number += 1
            stretch[j, s, 1] = number
    return number


def _with_rates(shots: Shots, part: np.ndarray, leaks: LeakedPeaks) -> LeakedPeaks:
    """Complete listed bins of points by the law and the sums of their rates."""
    level = np.broadcast_to(shots.threshold / shots.bin_deviation, shots.size)[part]
    levels, law = _laws(level)
    fades = shots.fading is not None
    tables = [_rate_tables(shots.looks, float(one), fades) for one in levels]
    rates, scale, bound, mean = (
        np.array([table[k] for table in tables]).reshape(levels.size, -1) for k in range(4)
    )
    leaks = leaks._replace(
        law=law, rates=rates, scale=scale, level=shots.looks.scaled(levels),
        sharper=float(shots.looks.sharper), correlation=shots.echo_rule.sidelobe_correlation,
    )  # fmt: skip
    _sum_rates(leaks, bound, mean)
    return leaks


class RateTables(NamedTuple):
    """Tables of one threshold by ln(amplitude)."""

    rates: np.ndarray
    """(RATES,): ln(rate)."""
    scale: np.ndarray
    """(2,): first ln(amplitude), and their step."""
    bound: np.ndarray
    """(RATES,): rate."""
    mean: np.ndarray
    """(RATES,): mean probability over speckle that a bin crosses; of no size if not asked for."""


@lru_cache(maxsize=64)
def _rate_tables(looks: Looks, level: float, fades: bool) -> RateTables:
    """Return the tables of a threshold [sigma]; means over speckle if an echo ``fades``."""
    rates, scale = _rates(looks, np.array([level]))
    mean = np.empty(0)
    if fades:
        means, place = np.empty(RATES // MEAN_STEP + 1), np.arange(RATES) / MEAN_STEP
        _fill_means(rates[0], scale[0], means)
        logarithm = np.log(np.maximum(means, 1e-300))
        mean = np.exp(CubicSpline(np.arange(means.size), logarithm)(place))
    return RateTables(rates[0], scale[0], np.exp(rates[0]), mean)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_means(log_rates, scale, means):
    """Fill in the mean over speckle of a bin's probability, at each MEAN_STEP th amplitude."""
    rule = _speckle_rule(log_rates, scale)
    sums = np.empty(rule.weights.size)
    for k in range(means.size):
        sums[:] = 0.0
        _add_rates(scale[0] + k * MEAN_STEP * scale[1], scale, rule, sums)
        means[k] = _faded_leakage(sums, rule.weights)


def _leaked_bins(seen: Seen) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return bin number, point (index into the batch) and segment of each bin of leaked signal."""
    number = np.diff(seen.stretch.reshape(-1, 2)).ravel()
    run = np.repeat(np.arange(number.size), number)
    return seen.low.ravel()[run] + seen.aside, run // 3, run % 3


def _with_line(
    shots: Shots, part: np.ndarray, seen: Seen, echo: np.ndarray
) -> tuple[Seen, np.ndarray, LeakedPeaks]:
    """Remove bins that a line of leaked light masks, and return the bins that this line raises.

    Returns the reduced spectra, ``echo`` (as of :func:`echo_of_bins`) of the bins that are left,
    and :class:`LeakedPeaks` with the fields ``line_*`` and ``barred_*`` alone filled in.
    """
    kept = np.ones(seen.aside.size, bool)
    stretches = np.zeros((3, part.size, 3, 2), np.int64)  # of leaked, raised and masked bins
    raised, hidden, amplitudes = [], [], [np.empty((PHASES, 0))]
    turns = np.exp(1j * np.pi * (np.arange(PHASES) + 0.5) / PHASES)[:, None]
    ends = np.zeros(3, np.int64)
    for j, i in enumerate(part.tolist()):
        deviation = float(np.broadcast_to(shots.bin_deviation, shots.size)[i])
        for s in range(3):
            stretches[:, j, s] = ends[:, None]
            if not shots.segments[s]:
                continue
            scale, line = line_of(shots, i, s)
            start, low = seen.start[j, s], seen.low[j, s]
            own = low + np.flatnonzero(seen.echo[start : start + seen.bins[j, s]])
            masked, _, raising = bins_of_line(shots, i, line, scale=scale, echo=own)
            leaked = slice(*seen.stretch[j, s])
            places = low + seen.aside[leaked]
            kept[leaked] = ~masked[places % shots.fft_size if shots.complex_record else places]
            raised.append(np.flatnonzero(raising))
            hidden.append(np.flatnonzero(masked))
            one, other = (scale / deviation) * line.terms[:, raised[-1]]
            amplitudes.append(np.abs(one * turns + other * turns.conj()))
            ends += np.array([kept[leaked].sum(), raised[-1].size, hidden[-1].size])
            stretches[:, j, s, 1] = ends
    none = np.empty(0, np.int64)
    return (
        seen._replace(
            stretch=stretches[0], aside=seen.aside[kept], leaked=seen.leaked[kept],
            edge=seen.edge[kept], side=seen.side[kept],
        ),
        echo[kept],
        LeakedPeaks.nothing(part.size)._replace(
            line_stretch=stretches[1], line_bin=np.concatenate([none, *raised]),
            line_amplitude=np.concatenate(amplitudes, axis=1),
            barred_stretch=stretches[2], barred_bin=np.concatenate([none, *hidden]),
        ),
    )  # fmt: skip


def _laws(level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return different thresholds of points [sigma], and the number of each point's.

    Thresholds within 1e-7 of each other, which those of a flight are, have one table of rates.
    """
    levels, law = np.unique(np.round(level, 7), return_inverse=True)
    return levels, law.ravel().astype(np.int64)


def _rates(looks: Looks, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return :attr:`LeakedPeaks.rates` and ``scale``, by threshold (laws,) [sigma]."""
    rates, scale = np.empty((level.size, RATES)), np.empty((level.size, 2))
    _fill_rates(level, rates, scale)
    if looks.several:
        for j in range(level.size):
            amplitude = np.exp(scale[j, 0] + scale[j, 1] * np.arange(RATES))
            added = np.minimum(looks.excess(amplitude, float(level[j])), 1 - 1e-16)
            rates[j] = np.log(np.maximum(-np.log1p(-added), 1e-300))
    return rates, scale


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_rates(level, rates, scale):
    """Tabulate ln(rate) for single looks, into ``rates`` (m, RATES) and ``scale`` (m, 2).

    ``level`` (m,): threshold [sigma].
    """
    for j in range(level.size):
        b = level[j]
        scale[j, 0] = math.log(FAINTEST)
        scale[j, 1] = (math.log(b + SURE) - scale[j, 0]) / (RATES - 1)
        stays = -math.expm1(-0.5 * b * b)
        for k in range(RATES):
            a, rate = math.exp(scale[j, 0] + scale[j, 1] * k), 0.0
            if stays > 0.0 and a < b:
                rate = -math.log1p(-excess_crossing(a, b) / stays)
            elif stays > 0.0:
                rate = -math.log(max(marcum_q1_pair(a, b)[1], 1e-300) / stays)
            rates[j, k] = math.log(max(rate, 1e-300))


@njit(cache=True, error_model="numpy", borrows=True)
def _rate(amplitude, rates, scale):
    """Return the rate -ln(1 - c) of a bin.

    ``amplitude`` is ln(|X| / sigma); ``rates`` are logarithms, at the amplitudes of ``scale``.
    """
    place = (amplitude - scale[0]) / scale[1]
    if place <= 0.0:
        return math.exp(rates[0] + 2.0 * (amplitude - scale[0]))
    k = int(place)
    if k >= rates.size - 1:
        return math.exp(rates[rates.size - 1])
    return math.exp(rates[k] + (place - k) * (rates[k + 1] - rates[k]))


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_rates(leaks, bound, mean):
    """Store the sums of rates in the fields of ``leaks``, in place.

    ``bound`` and ``mean`` (laws, RATES) are those of :class:`RateTables`.
    """
    for p in range(leaks.line_amplitude.shape[0]):
        for k in range(leaks.line_amplitude.shape[1]):
            leaks.line_amplitude[p, k] = math.log(max(leaks.line_amplitude[p, k], 1e-300))
    for j in range(leaks.total.shape[0]):
        rates, scale = leaks.rates[leaks.law[j]], leaks.scale[leaks.law[j]]
        octave = math.ceil(0.5 * math.log(2.0) / scale[1])
        for s in range(3):
            sums, means = leaks.bound[j, s], 0.0
            sums[:] = 0.0
            for k in range(leaks.stretch[j, s, 0], leaks.stretch[j, s, 1]):
                share, place = 1.0, (leaks.amplitude[k] - scale[0]) / scale[1]
                if place < 0.0:  # rates go as the amplitude squared
                    share, place = math.exp(2.0 * (leaks.amplitude[k] - scale[0])), 0.0
                at = min(int(place), RATES - 2)
                for p in range(OCTAVES):
                    sums[p] += share * bound[leaks.law[j], min(at + 1 + p * octave, RATES - 1)]
                if mean.shape[1] > 0:
                    one, other = mean[leaks.law[j], at], mean[leaks.law[j], at + 1]
                    means += share * (one + min(place - at, 1.0) * (other - one))
            leaks.total[j, s], leaks.line_total[j, s] = sums[0], 0.0
            if mean.shape[1] > 0:
                leaks.faint[j, s] = means
            for p in range(leaks.line_amplitude.shape[0]):
                whole = 0.0
                for k in range(leaks.line_stretch[j, s, 0], leaks.line_stretch[j, s, 1]):
                    whole += _rate(leaks.line_amplitude[p, k], rates, scale)
                leaks.line_total[j, s] = max(leaks.line_total[j, s], whole)


class SpeckleRule(NamedTuple):
    """Trapezoidal rule of the average over speckle, for one law of rates."""

    stride: int
    """Distance of nodes in steps of the tabulated ln(amplitude)."""
    below: int
    """Number of nodes whose power is less than 1."""
    weights: np.ndarray
    """(nodes,): weights at the powers e^(2 stride step (i - below)), in rising order."""
    rates: np.ndarray
    """(stride * columns,): rates at ln(amplitude), beginning ``below`` strides under the table.

    That with the number stride c + p is at p columns + c, so that the nodes of a bin are adjacent.
    """


@njit(cache=True, error_model="numpy")
def _speckle_rule(log_rates, scale):
    """Return the :class:`SpeckleRule` of one row of :attr:`LeakedPeaks.rates` and ``scale``."""
    step, steepest = scale[1], 0.0
    for k in range(1, log_rates.size):
        if log_rates[k] < 1.0:  # beyond, a bin crosses at almost any power
            steepest = max(steepest, log_rates[k] - log_rates[k - 1])
    stride = max(int(min(0.5 * LOG_POWER_STEP_MAX / step, CROSSING_STEP_MAX / steepest)), 1)
    spacing = 2.0 * stride * step
    below, above = int(-LOG_POWER_MIN / spacing) + 1, int(LOG_POWER_MAX / spacing) + 1
    weights = np.empty(below + above + 1)
    for i in range(weights.size):
        power = math.exp((i - below) * spacing)
        weights[i] = spacing * power * math.exp(-power)
    # A bin crosses at the faintest node too from ``below`` strides beyond the table.
    columns = 2 * below + above + log_rates.size // stride + 4
    rates = np.empty(stride * columns)
    for k in range(rates.size):
        place = float(k - below * stride - 1)
        rate = _rate(scale[0] + place * step, log_rates, scale)
        rates[k % stride * columns + k // stride] = rate
    return SpeckleRule(stride, below, weights, rates)


@njit(cache=True, error_model="numpy")
def _add_rates(amplitude, scale, rule, sums):
    """Add the rates of a bin at the last nodes to ``sums``, by cubic interpolation.

    ``amplitude`` is ln(|X| / sigma) at mean power.
    """
    share, place = 1.0, (amplitude - scale[0]) / scale[1]
    if place < 0.0:  # rates go as the amplitude squared
        share, place = math.exp(2.0 * (amplitude - scale[0])), 0.0
    columns = rule.rates.size // rule.stride
    k = int(min(place, float(rule.rates.size - rule.stride * rule.weights.size - 4)))
    x = min(place - k, 1.0)
    first = share * x * (x - 1.0) * (2.0 - x) / 6.0
    second = share * (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0
    third = share * (x + 1.0) * x * (2.0 - x) / 2.0
    fourth = share * (x + 1.0) * x * (x - 1.0) / 6.0
    a = k % rule.stride * columns + k // rule.stride
    b = (k + 1) % rule.stride * columns + (k + 1) // rule.stride
    c = (k + 2) % rule.stride * columns + (k + 2) // rule.stride
    d = (k + 3) % rule.stride * columns + (k + 3) // rule.stride
    rates, end, start = rule.rates, rule.weights.size, rule.weights.size - sums.size
    one, two = rates[a + start : a + end], rates[b + start : b + end]
    three, four = rates[c + start : c + end], rates[d + start : d + end]
    for i in range(sums.size):
        sums[i] += (first * one[i] + second * two[i]) + (third * three[i] + fourth * four[i])


@njit(cache=True, error_model="numpy")
def _faded_leakage(sums, weights):
    """Return the mean over speckle of 1 - exp(-R), of the sums of rates R at some last nodes.

    Terms below the first node go on as a geometric series: in proportion to the power where all
    draws leak, and else to its square.
    """
    mean, lowest, next_ = 0.0, 0.0, 0.0
    for i in range(sums.size - 1, -1, -1):
        term = weights[weights.size - sums.size + i] * _crossing(sums[i])
        mean += term
        lowest, next_ = term, lowest
    return mean + (lowest * lowest / (next_ - lowest) if next_ > lowest else 0.0)


@njit(cache=True, error_model="numpy")
def _joined_chances(k, stretch, leaks, law, rule, joined, joins):
    """Evaluate a bin next to an echo, and further ones that may join the echo with it.

    Parameters
    ----------
    k
        Index of the bin in ``leaks.bin``.
    stretch
        First and last index + 1 of the segment's bins.
    law
        Row of ``leaks.rates``.
    rule
        :class:`SpeckleRule` of this law.
    joined
        True of bins that have been evaluated so.
    joins
        Result: rates of a further group in these bins at some last nodes.

    Returns
    -------
    int
        Index of the last of these bins.
    """
    rates, scale, step = leaks.rates[law], leaks.scale[law], -leaks.side[k]
    nodes = joins.size
    end = k + step
    while stretch[0] <= end < stretch[1] and leaks.bin[end] - leaks.bin[k] == end - k:
        bright = leaks.amplitude[end - step] + BRIGHT  # as long as the bins so far all cross
        if abs(end - k) > 1 and _rate(bright, rates, scale) < JOINED_RATE_MIN:
            break
        if joined[end] or leaks.echo[end] != leaks.echo[k] or leaks.edge[end] > 0.0:
            break
        end += step
    of_bin, after_quiet, any_ = np.empty(nodes), np.zeros(nodes), np.zeros(nodes)
    for j in range(end - step, k, -step):
        of_bin[:] = 0.0
        _add_rates(leaks.amplitude[j], scale, rule, of_bin)
        for i in range(nodes):
            chance = _crossing(of_bin[i])
            after_quiet[i] = chance * after_quiet[i] + (1.0 - chance) * any_[i]
            any_[i] = chance + (1.0 - chance) * any_[i]
    of_bin[:] = 0.0
    _add_rates(leaks.amplitude[k], scale, rule, of_bin)
    spacing = 2.0 * rule.stride * scale[1]
    every = max(int(EDGE_STEP / spacing), 1)
    below = nodes - rule.weights.size + rule.below
    first = max(below - int(EDGE_DEPTH / spacing), 0)
    edge, signal = leaks.sharper * leaks.edge[k], leaks.sharper * math.exp(leaks.amplitude[k])
    after, begin = 0.0, -every
    while begin < nodes:
        end_of_step = first if begin < 0 else begin + every
        root = math.exp(0.5 * spacing * (end_of_step - below))
        before = after
        after = edge_crossing(edge * root, signal * root, leaks.level[law], leaks.correlation)
        slope = (after - before) / every
        if begin < 0:
            begin, before, slope = 0, after, 0.0
        for i in range(begin, min(end_of_step, nodes)):
            crosses = before + slope * (i - begin)
            chance = _crossing(of_bin[i])
            apart = 1.0 - crosses + crosses * after_quiet[i]
            joins[i] = silence(chance * apart + (1.0 - chance) * any_[i])
        begin = end_of_step
    return end - step


@njit(cache=True, error_model="numpy")
def _crossing(rate):
    """Return 1 - e^-rate."""
    if rate < 1e-4:
        return rate * (1.0 - rate * (0.5 - rate / 6.0))
    return -math.expm1(-rate)


@njit(cache=True, nogil=True, error_model="numpy")
def _average(leaks, out):
    """Average the probability of leakage over speckle and the line's phase, into ``out`` (m, 3).

    Each echo fades independently.
    """
    joined = np.zeros(leaks.bin.size, np.bool_)
    no_rule = SpeckleRule(1, 0, np.empty(0), np.empty(0))
    for law in range(leaks.scale.shape[0]):
        rates, scale = leaks.rates[law], leaks.scale[law]
        loud = False
        for j in range(out.shape[0]):
            for s in range(3):
                loud |= leaks.law[j] == law and not leaks.faint[j, s] <= FAINT_LEAKAGE
        rule, at_nodes, faint = no_rule, np.empty((2, 0)), 0
        if loud:
            rule = _speckle_rule(rates, scale)
            at_nodes = np.empty((2, rule.weights.size))
            spacing = 2.0 * rule.stride * scale[1]
            faint = int((LOG_POWER_MIN_FAINT - LOG_POWER_MIN) / spacing)
        for j in range(out.shape[0]):
            if leaks.law[j] != law:
                continue
            for s in range(3):
                begin, end = leaks.stretch[j, s]
                first = faint if leaks.total[j, s] <= FAINT_RATES else 0
                sums, joins = at_nodes[0, first:], at_nodes[1, first:]
                leakage, echoes = 0.0, 0
                if leaks.faint[j, s] <= FAINT_LEAKAGE:
                    leakage, end = leaks.faint[j, s], begin
                for k in range(begin, end):
                    echoes = max(echoes, leaks.echo[k] + 1)
                for g in range(echoes):
                    sums[:] = 0.0
                    for k in range(begin, end):
                        if leaks.edge[k] > 0.0 and leaks.echo[k] == g and not joined[k]:
                            last = _joined_chances(k, (begin, end), leaks, law, rule, joined, joins)
                            joined[min(k, last) : max(k, last) + 1] = True
                            sums += joins
                    for k in range(begin, end):
                        if leaks.echo[k] == g and not joined[k]:
                            _add_rates(leaks.amplitude[k], scale, rule, sums)
                    leakage += _faded_leakage(sums, rule.weights) * (1.0 - leakage)
                phases, alarm = leaks.line_amplitude.shape[0], 0.0
                for p in range(phases):
                    whole = 0.0
                    for k in range(leaks.line_stretch[j, s, 0], leaks.line_stretch[j, s, 1]):
                        whole += _rate(leaks.line_amplitude[p, k], rates, scale)
                    alarm -= math.expm1(-whole) / phases
                out[j, s] = leakage + alarm * (1.0 - leakage)


@njit(cache=True, error_model="numpy", borrows=True)
def list_peak(peak, bins, ratios, number):
    """Insert a peak (bin, |X| / sigma) into a list sorted by strength; return its new length.

    A bin of -1 is ignored. If the list is full, its weakest peak is dropped.
    """
    bin_, ratio = peak
    if bin_ < 0:
        return number
    at = number
    while at > 0 and ratios[at - 1] < ratio:
        at -= 1
    if at >= bins.size:
        return number
    number = min(number + 1, bins.size)
    for k in range(number - 1, at, -1):
        bins[k], ratios[k] = bins[k - 1], ratios[k - 1]
    bins[at], ratios[at] = bin_, ratio
    return number


@njit(cache=True, error_model="numpy", borrows=True)
def draw_leaked(address, at, leaks, fading, level, looks, tables, bins, ratios):
    """Draw the leaked peaks of a segment, and insert them into the list of the strongest peaks.

    Parameters
    ----------
    address
        Key of the point (two uint64) and number of the draw.
    at
        Point and segment.
    leaks
        :class:`LeakedPeaks` of the batch.
    fading
        (groups, 3): factors on the echoes' magnitudes by speckle.
    level
        Threshold [sigma].
    looks
        Number of looks whose powers are averaged.
    bins, ratios
        Results: bin and |X| / sigma of the peaks, strongest first. For averaged looks |X| is that
        of a single look of the same significance.

    Returns
    -------
    int
        Number of peaks in the list.
    """
    (a, b, draw), (i, s) = address, at
    rates, scale = leaks.rates[leaks.law[i]], leaks.scale[leaks.law[i]]
    brightest, octave, total = 0.0, 0, np.inf
    for g in range(fading.shape[0]):
        brightest = max(brightest, fading[g, s] * fading[g, s])
    while octave < OCTAVES and brightest > float(1 << octave):
        octave += 1
    if octave < OCTAVES:
        total = leaks.bound[i, s, octave]
    number = 0
    if total > 0.0:
        number = _list_raised(
            address, s, 0, leaks.stretch[i, s], leaks.bin, leaks.amplitude, leaks.echo, leaks.edge,
            fading[:, s], total, rates, scale, (level, looks, tables.sidelobe_correlation), bins,
            ratios, number,
        )  # fmt: skip
    if leaks.line_total[i, s] > 0.0:
        turn = philox.uniform(a, b, draw, philox.STREAM_LEAKAGE[s], LINE)
        phase = int(turn * leaks.line_amplitude.shape[0])
        number = _list_raised(
            address, s, LINE + 1, leaks.line_stretch[i, s], leaks.line_bin,
            leaks.line_amplitude[phase], leaks.echo[:0], leaks.edge[:0], fading[:, s],
            leaks.line_total[i, s], rates, scale, (level, looks, 0.0), bins, ratios, number,
        )  # fmt: skip
    return number


@njit(cache=True, error_model="numpy", borrows=True)
def _list_raised(
    address, s, first, stretch, bins, amplitude, echo, edge, fading, total, rates, scale, law,
    listed, ratios, number,
):  # fmt: skip
    """Draw which bins of a range are raised, and insert their peaks; adjacent bins make one peak.

    Peaks that join on to a bin of the echo that crosses are the echo's.

    Bins are skipped by exponential numbers, as the module says. ``first``: first random number of
    the segment's stream; ``echo``, ``edge``: of no size of bins that do not fade and join no echo;
    ``total``: bound of the sum of the rates of all bins in this draw; ``law``: threshold [sigma],
    number of looks and correlation of neighbours' noise; ``listed``, ``ratios``, ``number``: the
    list, as of :func:`list_peak`. Returns its new length.
    """
    (a, b, draw), stream, (level, looks, near) = address, philox.STREAM_LEAKAGE[s], law
    rest = math.sqrt(1.0 - near * near)
    chance = philox.uniform(a, b, draw, stream, first)
    if chance > total:  # and so is -ln(1 - chance)
        return number
    left = -math.log1p(-chance)
    if left > total:
        return number
    many = math.sqrt(float(looks))
    z = level * many
    before, peak, largest, is_echo = np.int64(-2), np.int64(-1), 0.0, False
    for k in range(stretch[0], stretch[1]):
        faded = fading[echo[k]] if echo.size > 0 else 1.0
        own = amplitude[k] + math.log(faded)
        left -= _rate(own, rates, scale)
        if left > 0.0:
            continue
        if bins[k] != before + 1:
            number = list_peak((np.int64(-1) if is_echo else peak, largest), listed, ratios, number)
            peak, largest, is_echo = np.int64(-1), 0.0, False
        before, signal = bins[k], math.exp(own) * many
        chance = philox.uniform(a, b, draw, stream, first + 1) * _added(signal, z)
        if edge.size > 0 and edge[k] > 0.0:  # its noise is in step with that which raises this bin
            re, im = philox.normal_pair(a, b, draw, stream, EDGES + k - stretch[0])
            along = edge[k] * faded * many + near * (_exceeded(signal, z, chance) - signal)
            is_echo |= math.hypot(along + rest * re, rest * im) >= z
        least = max(largest, ratios[number - 1] if number == ratios.size else 0.0)
        if least * many < z or _added(signal, least * many) > chance:
            peak, largest = bins[k], _exceeded(signal, z, chance) / many
        first += 2
        left = -math.log1p(-philox.uniform(a, b, draw, stream, first))
    return list_peak((np.int64(-1) if is_echo else peak, largest), listed, ratios, number)


@njit(cache=True, error_model="numpy")
def _added(signal, level):
    """Return c(z), the probability that signal lifts a bin to a level that noise alone misses."""
    return excess_crossing(signal, level) / -math.expm1(-0.5 * level * level)


@njit(cache=True, error_model="numpy")
def _exceeded(signal, level, chance):
    """Return the magnitude z >= ``level`` [sigma] at which c(z) is ``chance``, by bisection."""
    low, high = level, max(signal, level) + SURE
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if _added(signal, middle) > chance:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
