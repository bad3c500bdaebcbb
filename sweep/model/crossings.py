"""Threshold crossings that a signal adds to those of noise, for many bins at a time.

With x = a^2/2 and y = b^2/2, a bin of amplitude a (in units of the noise per quadrature) crosses a
threshold b with Q_1(a, b); over the e^-y of noise alone that is

    Q_1(a, b) - e^-y = e^-x sum_{n >= 1} c_n x^n / n!,    c_n = e^-y sum_{j=1..n} y^j / j!

(the Poisson mixture of chi-square tails less its value at a = 0). All terms are positive, so it
keeps its digits however small it is; and c_n depends on the threshold alone, so a run of bins
costs one polynomial in x, which vectorises.

Adjacent bins that cross are one group. Those next to an echo whose outermost bin crosses with
probability q are part of its group. If bins 1, 2 .. next to it cross with c_1, c_2 .., a further
group stands in them with the probability

    (1 - c_1) B_2 + c_1 (1 - q + q A_2),    A_j = c_j A_(j+1) + (1 - c_j) B_(j+1),

B_j that any of the bins from j on crosses, A_j that one does after a bin that does not. Bins
between two echoes may join either.
"""

import math

from sweep.kernel_cache import njit
from sweep.model.marcum import excess_crossing, marcum_q1_pair

STRETCH = 256
"""Bins for which the polynomial is evaluated together."""

LARGEST_SERIES = 450.0
"""y up to which the series serves; above, and for amplitudes that dwarf the noise, Marcum's Q."""

MOST_TERMS = 800

JOINED_CHANCE_MIN = 1e-9
"""Probability that all bins of a run cross, below which no further one is taken to join it."""

EDGE_DEVIATION_MIN = 0.01
"""Smallest deviation [sigma] of an outermost bin's noise, given that its neighbour crosses."""

_EXPONENTIAL = tuple((-1) ** n / math.factorial(n) for n in range(12))
"""Of e^-z, to 1e-16 for z <= 1/4."""


@njit(cache=True, error_model="numpy")
def crossing_series(beta, series):
    """c_n y^n / n! over the probability that noise alone stays below ``beta``, into ``series``.

    As many as any amplitude below the threshold asks for; none above :data:`LARGEST_SERIES`.
    """
    y = 0.5 * beta * beta
    if not 0.0 < y <= LARGEST_SERIES:
        return
    term, power, total = math.exp(-y) / -math.expm1(-y), 1.0, 0.0
    for n in range(1, min(_terms(y, y) + 8, series.size)):
        ratio = y / n
        term *= ratio
        power *= ratio
        total += term
        series[n] = total * power


@njit(cache=True, error_model="numpy")
def _terms(x, y):
    """Terms that leave less than 1e-16 of the sum for amplitudes up to x (<= y)."""
    root = math.sqrt(x * y)
    return int(8.0 + 1.3 * root + 5.0 * math.sqrt(root) + 4.0 * math.sqrt(x))


@njit(cache=True, error_model="numpy")
def added_crossings(x, count, beta, series, out):
    """Probabilities (Q_1 - e^-y) / (1 - e^-y) of bins, 0..1, into ``out``, (>= count + 7,).

    ``x`` is a^2/2 of each bin, below y; used up, and so are up to seven elements more. ``beta``:
    threshold over the noise per quadrature; ``series``: :func:`crossing_series` of it.
    """
    y = 0.5 * beta * beta
    if y > LARGEST_SERIES:
        for i in range(count):
            out[i] = excess_crossing(math.sqrt(2.0 * x[i]), beta)
        return
    whole = (count + 7) // 8 * 8  # whole vectors: what is left over costs as much as all of them
    x[count:whole] = 0.0
    for first in range(0, whole, STRETCH):
        last = min(first + STRETCH, whole)
        most = largest(x[first:last])
        terms = min(_terms(min(most, y), y), series.size - 8)
        halvings = 0
        scale = 1.0
        while most * scale > 0.25:
            scale *= 0.5
            halvings += 1
        _polynomial(x[first:last], 1.0 / y, series, terms, scale, halvings, out[first:last])


@njit(cache=True, error_model="numpy")
def largest(x):
    """Largest of some numbers, at least 0."""
    most = 0.0
    for i in range(x.size):
        most = x[i] if x[i] > most else most
    return most


@njit(cache=True, error_model="numpy")
def _polynomial(x, inverse, series, terms, scale, halvings, out):
    """e^-x sum d_n (x inverse)^n, n = 1 .. terms; e^-x as a power of e^(-x scale)."""
    for i in range(x.size):
        out[i] = 0.0
    for n in range((terms + 7) // 8 * 8 - 7, 0, -8):  # eight at a time: fewer loads and stores
        a, b, c, d = series[n], series[n + 1], series[n + 2], series[n + 3]
        e, f, g, h = series[n + 4], series[n + 5], series[n + 6], series[n + 7]
        for i in range(x.size):
            u = x[i] * inverse
            u2 = u * u
            high = u2 * (u * (h + out[i]) + g) + (u * f + e)
            low = u2 * (u * d + c) + (u * b + a)
            out[i] = u * (u2 * u2 * high + low)
    for i in range(x.size):
        z = scale * x[i]
        decay = _EXPONENTIAL[11]
        for n in range(10, -1, -1):
            decay = z * decay + _EXPONENTIAL[n]
        x[i] = decay
    for _ in range(halvings):
        for i in range(x.size):
            x[i] *= x[i]
    for i in range(x.size):
        out[i] *= x[i]


@njit(cache=True, error_model="numpy")
def any_crossing(chances, first, last):
    """1 - prod(1 - probability) over probabilities first .. last - 1, with all its digits."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    i = first
    while i + 3 < last:  # four at a time, as each waits for the one before
        a += chances[i] * (1.0 - a)
        b += chances[i + 1] * (1.0 - b)
        c += chances[i + 2] * (1.0 - c)
        d += chances[i + 3] * (1.0 - d)
        i += 4
    a += b * (1.0 - a)
    c += d * (1.0 - c)
    a += c * (1.0 - a)
    while i < last:
        a += chances[i] * (1.0 - a)
        i += 1
    return a


@njit(cache=True, error_model="numpy")
def silence(chance):
    """-ln(1 - probability): what adds up over bins."""
    if chance < 1e-4:
        return chance * (1.0 + chance * (0.5 + chance * (1.0 / 3.0 + 0.25 * chance)))
    return -math.log1p(-chance)


@njit(cache=True, error_model="numpy")
def weighted_silence(chances, weights):
    """Sum of the weighted -ln(1 - probability)."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    i = 0
    while i + 3 < chances.size:  # four at a time, as each sum waits for the one before
        a += weights[i] * silence(chances[i])
        b += weights[i + 1] * silence(chances[i + 1])
        c += weights[i + 2] * silence(chances[i + 2])
        d += weights[i + 3] * silence(chances[i + 3])
        i += 4
    while i < chances.size:
        a += weights[i] * silence(chances[i])
        i += 1
    return (a + b) + (c + d)


@njit(cache=True, error_model="numpy")
def edge_crossing(edge, signal, level, correlation):
    """Return the probability that an echo's outermost bin crosses, given that its neighbour does.

    Parameters
    ----------
    edge, signal
        |X| / sigma of the outermost bin, and of its neighbour outside the echo.
    level
        Threshold [sigma].
    correlation
        Correlation of their noise in phase with the signal.

    Notes
    -----
    A bin crosses by noise n > b - a in phase with its signal. This has the mean m = phi / (1 - Phi)
    at d = b - a and the variance 1 - m (m - d). In the outermost bin it leaves noise of the mean
    rho m and the variance s^2 = 1 - rho^2 m (m - d), whose distance from the threshold is that of a
    bin of the amplitude b - (b - a_edge - rho m) / s in noise of unit variance.
    """
    if correlation != 0.0:
        below = level - signal
        mean = max(below, 0.0)
        if -8.0 < below < 30.0:
            tail = 0.5 * math.erfc(math.sqrt(0.5) * below)
            mean = math.exp(-0.5 * below * below) / (math.sqrt(2.0 * math.pi) * tail)
        square = 1.0 - correlation * correlation * mean * (mean - below)
        deviation = math.sqrt(max(square, EDGE_DEVIATION_MIN * EDGE_DEVIATION_MIN))
        edge = max(level - (level - edge - correlation * mean) / deviation, 0.0)
    return marcum_q1_pair(edge, level)[0]


@njit(cache=True, error_model="numpy")
def leave_out_joined(chances, first, last, magnitude, exempt, noise, correlation):
    """Leave runs of bins that join an echo out of probabilities, in place.

    The first bin next to an echo takes the probability of a further group in all bins that may join
    it, and these take 0.

    Parameters
    ----------
    chances
        Probabilities that signal makes bins cross.
    first, last
        First bin, and that after the last, of those that are looked at.
    magnitude, exempt
        |X|, and whether bins are of an echo.
    noise
        Noise per quadrature sigma, and threshold on |X|.
    correlation
        Correlation of neighbours' noise in phase with the signal.
    """
    sigma, level, end = noise[0], noise[1], first
    while end < last:
        begin = end
        while end < last and not exempt[end]:
            end += 1
        count = end - begin
        below, above, joins_below, joins_above = 0, 0, 0.0, 0.0
        if count > 0 and begin > first and chances[begin] > 0.0:
            below = _joining(chances, begin, 1, count)
            joins_below = edge_crossing(
                magnitude[begin - 1] / sigma, magnitude[begin] / sigma, level / sigma, correlation
            )
        if count > 0 and end < last and chances[end - 1] > 0.0:
            above = _joining(chances, end - 1, -1, count)
            joins_above = edge_crossing(
                magnitude[end] / sigma, magnitude[end - 1] / sigma, level / sigma, correlation
            )
        if below + above > count:
            _join(chances, begin, 1, count, joins_below, joins_above)
        else:
            _join(chances, begin, 1, below, joins_below, 0.0)
            _join(chances, end - 1, -1, above, joins_above, 0.0)
        end += 1


@njit(cache=True, error_model="numpy")
def _joining(chances, begin, step, count):
    """Return how many of ``count`` bins from ``begin`` on may all cross."""
    number, all_cross = 1, 1.0
    while number < count and all_cross > JOINED_CHANCE_MIN:
        all_cross *= chances[begin + number * step]
        number += 1
    return number


@njit(cache=True, error_model="numpy")
def _join(chances, begin, step, count, joins, joins_last):
    """Replace the probability of bin ``begin`` by that of a further group in ``count`` bins.

    ``joins`` and ``joins_last``: probabilities that the first and the last join an echo if they
    cross. The other bins take 0.
    """
    quiet, of_echo, waits, further = 1.0 - joins, joins, 0.0, 0.0
    # Probabilities of no further group yet: after a bin that does not cross, that is of the echo
    # or that may join one at the end. Before the first bin there stands an echo or none.
    for i in range(begin, begin + count * step, step):
        crosses = chances[i]
        further += (1.0 - crosses) * waits
        waits = crosses * (waits + quiet)
        quiet = (1.0 - crosses) * (quiet + of_echo)
        of_echo *= crosses
        chances[i] = 0.0
    if count > 0:
        chances[begin] = further + waits * (1.0 - joins_last)
