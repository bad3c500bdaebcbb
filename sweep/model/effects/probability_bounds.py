"""What effects' bounds on bins make of probabilities, whichever of the other effects are there.

With x = ln a, a and the threshold b over sigma,

    max_x  Q_1(e^{x + s}, b) - Q_1(e^x, b)  <=  s max g,
    g = dQ_1/dx = a b I_1(a b) e^{-(a^2 + b^2)/2}

with g <= sqrt(a b / (2 pi)) e^{-(a - b)^2 / 2}, which has one maximum, at a (a - b) = 1/2; or the
change from one end of the interval to the other. What is added to a magnitude counts by

    dQ_1/da = b I_1(a b) e^{-(a^2 + b^2)/2} <= min(1/2, 0.22 b e^{-(a - b)^2 / 2}).

Noise that the threshold does not follow changes the false alarms too, whose probability in a
segment is P = 1 - (1 - p)^N, p = e^{-b^2/2}, in a shot P^2. ln P rises with ln p no faster than
this, so that the largest of their changes is

    |d log10 P^2| <= |d b^2| / ln 10,

for P itself, with dP = N p (1 - p)^(N-1) d ln p, has no more than |d b^2| / 4 from two bins on.

Where pd is 1 whatever happens, bins still have magnitudes: |X| a sigma, changed by a factor f and
by a further c, is off by no more than |f - 1| a + c, of a or of sigma, whichever is larger.
"""

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from sweep.model.effects.change import NONE, NOTHING, Bound, Change, Mean
from sweep.model.effects.span import Span
from sweep.model.marcum import marcum_q1_pair

_HUGE = 1e12
_LN_10 = math.log(10.0)
WEAK, STRONG, DOWN, UP, ADDED, SHARE, SHIFT, ALARMS, CHANGE_FIELDS = range(9)
OF_NONE = np.array([1.0, 1.0, 1.0, 1.0, 0.0, 1.0, 0.0, 0.0])
"""Fields of a change of nothing."""
_NO_NOISE = 1e-200
"""Factor of noise that is as good as none, as of what saturates."""
_NEGLIGIBLE = 1e-12
"""A change of a probability that needs no closer look."""


def probability_changes(
    bounds: Sequence[Bound],
    *,
    amplitude: Span,
    threshold: Span,
    leakage: int = -1,
    spreads: Sequence[bool] = (),
) -> np.ndarray:
    """Largest change of a probability or of a magnitude by each effect, (effects, tiles), 0..1.

    For a :class:`Change` the largest of these: the sum of the changes of pd in the three segments,
    which bounds that of their product; the change of log10 of the probability of a false alarm in
    a shot, by noise or by bins that change sides of the threshold; that of the largest bin's
    magnitude in any segment, in relation to it or to sigma, whichever is larger; its shift in bins.

    Parameters
    ----------
    bounds : sequence of Change, Mean or array_like
        Of scalars, (tiles,), or (3, tiles) by segment. An array is a bound on the change of a
        probability itself, and is summed over the segments if it has them; a :class:`Mean` makes
        one from whatever the others leave.
    amplitude : Span
        Magnitude of the detecting bin without any of the effects over sigma, (3, tiles).
    threshold : Span
        Threshold over sigma, (tiles,) or a scalar.
    leakage : int
        Which of them is that of leakage, where it is asked for; none by default. Bins that leak
        are then taken to be moved by effects that spread as far, in sigmas, as the largest; that
        counts up to this bound.
    spreads : sequence of bool
        Whether an effect moves light from bins to others.
    """
    tiles = np.shape(amplitude.low)[1]
    factors = [bound for bound in bounds if isinstance(bound, Change)]
    table, ends = _table(factors, amplitude, threshold)
    out = np.empty((len(bounds), tiles))
    for row, bound in zip(out, bounds, strict=True):
        if not isinstance(bound, Change):
            told = bound.change(*_within_all(table, ends)) if isinstance(bound, Mean) else bound
            value = np.asarray(told, float)
            row[:] = value.sum(axis=0) if value.ndim > 1 else value
    leaking = np.zeros((len(factors), tiles))
    if leakage >= 0:
        asked = zip(bounds, spreads, strict=True)
        moves = np.array([spread for bound, spread in asked if isinstance(bound, Change)])
        leaking[moves] = out[leakage]
    out[[isinstance(bound, Change) for bound in bounds]] = changes_of(table, ends, leaking)
    return np.minimum(out, 1.0)


def within_changes(
    changes: Sequence[Change], *, amplitude: Span, threshold: Span
) -> tuple[Span, Span]:
    """Magnitudes and thresholds over sigma that any of some changes may leave, (3, tiles)."""
    return _within_all(*_table(changes, amplitude, threshold))


def _within_all(table: np.ndarray, ends: np.ndarray) -> tuple[Span, Span]:
    found = np.empty(ends.shape)
    put_all(table, ends, found)
    return Span(found[0, 0], found[0, 1]), Span(found[1, 0], found[1, 1])


def _table(
    changes: Sequence[Change], amplitude: Span, threshold: Span
) -> tuple[np.ndarray, np.ndarray]:
    """Changes as compiled formulas take them; ends of what there is without, (2, 2, 3, tiles)."""
    tiles = np.shape(amplitude.low)[1]
    table = np.empty((len(changes), CHANGE_FIELDS, 3, tiles))
    table[:] = OF_NONE[:, None, None]
    for entry, change in zip(table, changes, strict=True):
        _fill(entry, change)
    finish(table.reshape(len(changes), CHANGE_FIELDS, 3 * tiles))
    ends = np.empty((2, 2, 3, tiles))
    ends[0, 0], ends[0, 1], ends[1, 0], ends[1, 1] = (
        amplitude.low, amplitude.high, threshold.low, threshold.high,
    )  # fmt: skip
    return table, ends


def pd_change_within(
    change: Change,
    *,
    amplitude: tuple[ArrayLike, ArrayLike],
    threshold: tuple[ArrayLike, ArrayLike],
) -> np.ndarray:
    """Largest change of the probability of detection, starting anywhere within intervals, 0..1.

    Parameters
    ----------
    change : Change
        What the effect can change, (n,) or scalars.
    amplitude, threshold : (array_like, array_like)
        Least and largest magnitude and threshold, over sigma, without it.
    """
    ends = np.array(np.broadcast_arrays(*amplitude, *threshold), dtype=float)
    entry = np.empty((CHANGE_FIELDS, *ends.shape[1:]))
    entry.T[...] = OF_NONE
    _fill(entry, change)
    finish(entry.reshape(1, CHANGE_FIELDS, -1))
    flat = _each_within(entry.reshape(CHANGE_FIELDS, -1), ends.reshape(4, -1))
    return np.asarray(flat.reshape(ends.shape[1:]))


def _fill(entry: np.ndarray, change: Change) -> None:
    """Put in what differs from nothing: ends of signal and noise, what is added, and so on."""
    if change.signal is not NONE:
        entry[WEAK], entry[STRONG] = change.signal
    if change.noise is not NONE:
        entry[DOWN], entry[UP] = change.noise
        entry[SHARE] = change.threshold_follows
    for row, value in (ADDED, change.added), (SHIFT, change.shift), (ALARMS, change.alarms):
        if value is not NOTHING:
            entry[row] = value


@njit(cache=True, error_model="numpy")
def finish(table):
    """Factors on amplitude and threshold over sigma; what is added; change of |X| by its factor."""
    for i in range(table.shape[0]):
        for t in range(table.shape[2]):
            own = table[i, :, t]
            weak, strong, follows = own[WEAK], own[STRONG], own[SHARE] != 0.0
            quiet, loud = (
                1.0 / math.sqrt(max(own[DOWN], _NO_NOISE)),
                1.0 / math.sqrt(max(own[UP], _NO_NOISE)),
            )
            own[WEAK], own[STRONG] = min(weak * loud, _HUGE), min(strong * quiet, _HUGE)
            own[DOWN] = 1.0 if follows else min(loud, _HUGE)
            own[UP] = 1.0 if follows else min(quiet, _HUGE)
            own[ADDED] = min(own[ADDED], _HUGE)
            own[SHARE] = min(max(strong - 1.0, 1.0 - weak), _HUGE)


@njit(cache=True, error_model="numpy")
def _each_within(entry, ends):
    """Changes of pd from intervals of their own, (n,)."""
    out = np.empty(ends.shape[1])
    for i in range(out.size):
        out[i] = _within(entry[:, i], ends[0, i], ends[1, i], ends[2, i], ends[3, i])
    return out


@njit(cache=True, error_model="numpy")
def changes_of(table, ends, leaking):
    """Changes of pd, summed over segments, of false alarms or of magnitudes, (effects, tiles)."""
    effects, _, segments, tiles = table.shape
    out = np.zeros((effects, tiles))
    for i in range(effects):
        for t in range(tiles):
            total, other = 0.0, 0.0
            for s in range(segments):
                own = table[i, :, s, t]
                besides = np.maximum(own[SHIFT], own[ALARMS])
                other = max(other, besides if besides < 1.0 else 1.0)
                if not _does_anything(own):
                    continue
                low, high, lower, upper = _with_others(table, ends, i, s, t)
                total += _within(own, low, high, lower, upper)
                other = max(other, _magnitude_change(own, low, high))
                if leaking[i, t] > 0.0:
                    moved = (own[SHARE] + own[ADDED]) * min(high, _HUGE)
                    other = max(other, min(moved, leaking[i, t]))
                if own[DOWN] != 1.0 or own[UP] != 1.0:
                    other = max(other, _alarm_change(own, upper))
            out[i, t] = min(max(total, other), 1.0)
    return out


@njit(cache=True, error_model="numpy")
def put_all(table, ends, out):
    """Ends of amplitude and threshold with any of the effects."""
    for s in range(ends.shape[2]):
        for t in range(ends.shape[3]):
            out[0, 0, s, t], out[0, 1, s, t], out[1, 0, s, t], out[1, 1, s, t] = _with_others(
                table, ends, -1, s, t
            )


@njit(cache=True, error_model="numpy")
def _does_anything(own):
    return (
        own[WEAK] != 1.0
        or own[STRONG] != 1.0
        or own[DOWN] != 1.0
        or own[UP] != 1.0
        or own[ADDED] != 0.0
    )


@njit(cache=True, error_model="numpy")
def _with_others(table, ends, i, s, t):
    """Least and largest amplitude and threshold with any of the effects but one."""
    low, high = ends[0, 0, s, t], ends[0, 1, s, t]
    lower, upper = ends[1, 0, s, t], ends[1, 1, s, t]
    added = 0.0
    for j in range(table.shape[0]):
        if j != i:
            low *= min(table[j, WEAK, s, t], 1.0)
            high *= max(table[j, STRONG, s, t], 1.0)
            lower *= min(table[j, DOWN, s, t], 1.0)
            upper *= max(table[j, UP, s, t], 1.0)
            added += table[j, ADDED, s, t]
    return max(low - high * added, 0.0), high * (1.0 + added), lower, upper


@njit(cache=True, error_model="numpy")
def _magnitude_change(own, low, high):
    """Largest change of a magnitude from within an interval, over it or 1, whichever is larger."""
    more = own[ADDED] * high / max(low, 1.0) if own[ADDED] > 0.0 else 0.0
    return min(own[SHARE], _HUGE) * min(high, 1.0) + more


@njit(cache=True, error_model="numpy")
def _within(own, low, high, lower, upper):
    """Largest change of pd by one effect from anywhere within intervals."""
    weak, strong, down, up, added = own[:SHARE]
    low, high = min(low, _HUGE), min(high, _HUGE)
    if low == high and lower == upper and added == 0.0:
        without = marcum_q1_pair(low, lower)[0]
        most = marcum_q1_pair(min(high * strong, _HUGE), lower * down)[0]
        least = marcum_q1_pair(low * weak, lower * up)[0]
        return max(most - without, without - least)
    more = min(high * added, _HUGE)
    weak, strong, down, up = min(weak, 1.0), max(strong, 1.0), min(down, 1.0), max(up, 1.0)
    below, above = max(low * weak - more, 0.0), min(high * strong + more, _HUGE)
    smallest, biggest = lower * down, upper * up
    step = math.inf if weak == 0.0 else max(math.log(strong), -math.log(weak))
    turn = max(math.log(up), -math.log(down))
    slopes = more * _steepest_addition(below, above, smallest, biggest)
    if step > 0.0:
        slopes += step * _steepest(below, above, smallest, biggest)
    if turn > 0.0:
        slopes += turn * _steepest_threshold(below, above, smallest, biggest)
    if slopes <= _NEGLIGIBLE:
        return slopes
    most = marcum_q1_pair(above, smallest)[0]
    ends = max(most - marcum_q1_pair(below, biggest)[0], 0.0)
    return slopes if slopes < ends else ends


@njit(cache=True, error_model="numpy")
def _apart(low, high, smallest, biggest):
    """Least distance between amplitudes and thresholds of a box."""
    return max(low - biggest, smallest - high, 0.0)


@njit(cache=True, error_model="numpy")
def _steepest(low, high, smallest, biggest):
    """Bound on dQ_1/d ln a over a box of amplitudes and thresholds."""
    peak_low = 0.5 * (smallest + math.sqrt(smallest**2 + 2.0))
    peak_high = 0.5 * (biggest + math.sqrt(biggest**2 + 2.0))
    a = high if high < peak_low else max(low, peak_high)
    a = min(a, peak_high * 1e6)
    beyond = high < peak_low or low > peak_high
    apart = max(smallest - a, a - biggest, 0.0) if beyond else 0.0
    return math.sqrt(a * biggest / (2.0 * math.pi)) * math.exp(-0.5 * apart * apart)


@njit(cache=True, error_model="numpy")
def _steepest_addition(low, high, smallest, biggest):
    """Bound on dQ_1/da over the box."""
    apart = _apart(low, high, smallest, biggest)
    return min(0.5, 0.22 * biggest * math.exp(-0.5 * apart * apart))


@njit(cache=True, error_model="numpy")
def _steepest_threshold(low, high, smallest, biggest):
    """Bound on -dQ_1/d ln b = b^2 I_0(a b) e^{-(a^2 + b^2)/2} over the box.

    I_0(z) e^{-z} is at most 1 and 1/sqrt(1 + 2 z): the one for a below b/2, the other above.
    """
    half = 0.5 * smallest
    found = 0.0
    if low < half:
        apart = max(smallest - min(high, half), 0.0)
        found = biggest**2 * math.exp(-0.5 * apart * apart)
    if high >= half:
        apart = _apart(low, high, smallest, biggest)
        strong = math.exp(-0.5 * apart * apart) / math.sqrt(1.0 + smallest**2)
        found = max(found, biggest**2 * strong)
    return found


@njit(cache=True, error_model="numpy")
def _alarm_change(own, upper):
    """Largest change of log10 of a shot's chance of a false alarm from thresholds up to one."""
    down, up = own[DOWN], own[UP]
    return upper * upper * max(1.0 - down * down, up * up - 1.0) / _LN_10
