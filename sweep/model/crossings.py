"""Threshold crossings that a signal adds to those of noise, for many bins at a time.

With x = a^2/2 and y = b^2/2, a bin of amplitude a (in units of the noise per quadrature) crosses a
threshold b with Q_1(a, b); over the e^-y of noise alone that is

    Q_1(a, b) - e^-y = e^-x sum_{n >= 1} c_n x^n / n!,    c_n = e^-y sum_{j=1..n} y^j / j!

(the Poisson mixture of chi-square tails less its value at a = 0). All terms are positive, so it
keeps its digits however small it is; and c_n depends on the threshold alone, so a run of bins
costs one polynomial in x, which vectorises.
"""

import math

from sweep.kernels import njit
from sweep.model.marcum import excess_crossing

STRETCH = 256
"""Bins for which the polynomial is evaluated together."""

LARGEST_SERIES = 450.0
"""y up to which the series serves; above, and for amplitudes that dwarf the noise, Marcum's Q."""

MOST_TERMS = 800

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
