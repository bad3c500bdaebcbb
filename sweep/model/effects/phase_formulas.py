"""What phase errors make of the largest bin: compiled formulas of :mod:`.phase_bounds`.

Errors are rows: largest coefficients of x .. x^4 and what is no power [cycles].
"""

import math

import numpy as np
from numba import njit

from sweep.model.effects.columns import product_of
from sweep.model.effects.line_powers import extremes_of, image_factor_of, power_range_of

MARGIN = 1.01
"""What a and b are raised by, for the means being sums over nodes."""
HUGE = 1e12

_TURN = 2 * math.pi
_ROWS = 5
_BINOMIAL = np.array([[math.comb(j, k) for k in range(5)] for j in range(5)], float)


@njit(cache=True, error_model="numpy")
def put_reaches(table, slopes, out):
    """Roots B of second moments of the slope's place [bins], (2, n): of errors and others; others.

    Rows of the table: an error, and the others.
    """
    for i in range(table.shape[1]):
        both, others = 0.0, 0.0
        for k in range(4):
            both += (table[k, i] + table[_ROWS + k, i]) * slopes[k]
            others += table[_ROWS + k, i] * slopes[k]
        out[0, i] = np.sqrt(1 / 3 + MARGIN * (both * both))
        out[1, i] = np.sqrt(1 / 3 + MARGIN * (others * others))


@njit(cache=True, error_model="numpy")
def put_phase_changes(table, reaches, known, sizes, flags, out):
    """Least and largest factor on magnitudes, (2, n).

    Parameters
    ----------
    table : (12, n) float64
        An error, the others, least and largest peak.
    reaches : (2, 2, n) float64
        Those of :func:`put_reaches`, and the hyperbolic tangent of pi times these.
    known : ((4,), (4,), (4,)) tuples of float
        Means of powers: absolute, without the odd ones' best line, square.
    sizes : (float, float, float, float)
        Of the window: <|w|>, first sample, top, <h>.
    flags : (bool, bool)
        Whether there are others; whether the peak is one line's.
    """
    absolute, bent, square = known
    most_of, edge, top, hann = sizes
    beside, single = flags
    for i in range(table.shape[1]):
        error, others = table[:_ROWS, i], table[_ROWS : 2 * _ROWS, i]
        least, largest = table[10, i], table[11, i]
        besides, turned = 0.0, 0.0
        if beside:
            besides = missed_of(others, absolute, most_of)
            turned = missed_of(error, absolute, most_of) * np.minimum(largest_of(others), 2.0)
        c = least - besides
        if single:
            c = np.fmax(c, _matched(reaches[0, 1, i], reaches[1, 1, i], others[4], hann))
        c = c if c > 0 else 0.0
        a, b = _parts(error, absolute, absolute, square, most_of)
        a_rest, _ = _parts(error, bent, absolute, square, most_of)
        a, b = a + turned, b + turned
        most = largest + besides
        low = 1 - (a + b * edge / c) / c
        low = np.fmax(low, (c - a_rest - b * edge / c) / most)
        if single:
            kept = _matched(reaches[0, 0, i], reaches[1, 0, i], error[4] + others[4], hann)
            low = np.fmax(low, kept / most)
        rise = 1 + a / c
        high = np.sqrt(rise * rise + (2 * b * edge + b * b) / (c * c))
        high = np.fmin(high, (math.hypot(top + a_rest, b + edge) + besides) / c)
        high = np.fmin(high, most_of / c)
        low = 0.0 if np.isnan(low) else low
        high = HUGE if np.isnan(high) else high
        out[0, i], out[1, i] = min(max(low, 0.0), 1.0), min(max(high, 1.0), HUGE)


@njit(cache=True, error_model="numpy")
def put_missed(table, absolute, most, out):
    """<|phi|> of errors, (n,)."""
    for i in range(out.size):
        out[i] = missed_of(table[:, i], absolute, most)


@njit(cache=True, error_model="numpy")
def missed_of(error, absolute, most):
    """<|phi|> [rad]: by which any bin of a line changes at most, relative to its peak."""
    total = 0.0
    for k in range(4):
        total += _TURN * error[k] * absolute[k]
    total += _TURN * error[4] * most
    return MARGIN * np.minimum(total, 2 * most)


@njit(cache=True, error_model="numpy")
def largest_of(error):
    """Largest phase [rad] anywhere in the record."""
    return _TURN * (0.0 + error[0] + error[1] + error[2] + error[3] + error[4])


@njit(cache=True, error_model="numpy")
def _parts(error, odd_means, absolute, square, most):
    """Bounds a, b [rad]."""
    rest = _TURN * error[4]
    one, two, three, four = (
        _TURN * error[0], _TURN * error[1], _TURN * error[2], _TURN * error[3],
    )  # fmt: skip
    odd = rest * most + (one * odd_means[0] + three * odd_means[2])
    even = rest * most + (two * absolute[1] + four * absolute[3])
    root = rest * np.sqrt(most) + (two * square[1] + four * square[3])
    a = np.minimum(odd, 2 * most) + np.minimum(root * root / 2, 2 * most)
    return MARGIN * a, MARGIN * np.minimum(even, most)


@njit(cache=True, error_model="numpy")
def _matched(reach, tangent, rest, hann):
    """Lower bound from a Hann window that carries the same phase error."""
    if rest > 0:
        return 0.0
    room = 2 * (3 / 8) * math.pi * reach / tangent
    return hann / np.sqrt(room) / MARGIN


@njit(cache=True, error_model="numpy")
def put_peaks(table, beamlets, lobe, record, shares, out):
    """Least and largest magnitudes of the largest bin, images' factors on powers, (3, n).

    Parameters
    ----------
    table : (11, n) float64
        Edge and tilt of lines; mean, rms and extreme of the spread that they may have, what the
        receiver's poles make of that, and the extreme without the laser's width; x .. x^4 of an
        error.
    beamlets : int
        Lines at the most.
    lobe : tuple, tuple
        As of :func:`.line_powers.put_power_ranges`.
    record : (float, float)
        Size of the FFT, length of the record.
    shares : (float, float)
        What images leave of the least, and what the largest is of what they may make it.
    """
    tables, sizes = lobe
    fft_size, length = record
    bounds = extremes_of(beamlets, tables)
    for i in range(table.shape[1]):
        edge, tilt, mean, rms, extreme, uphill, away = table[:7, i]
        slopes = 0.0
        for k in range(4):
            slopes += (k + 1) * table[7 + k, i]
        reach = 2 * slopes * fft_size / length
        images = image_factor_of(edge, away + reach, sizes[2])
        anywhere, spread = (0.5, 0.0, edge, tilt), (mean, rms, extreme)
        least, most = power_range_of(anywhere, spread, bounds, tables, sizes)
        out[0, i] = shares[0] * np.sqrt(least / (images * uphill))
        out[1, i], out[2, i] = np.sqrt(most) / shares[1], images


@njit(cache=True, error_model="numpy")
def put_added(table, absolute, most, least, out):
    """What errors add to sums of amplitudes, (n,).

    Rows of the table: an error, its size in the record's middle, the images' factors.
    """
    for i in range(out.size):
        error = table[:_ROWS, i]
        if table[6, i] > 1.5:
            anywhere = largest_of(error) + _TURN * table[5, i]
            each = MARGIN * most * np.minimum(anywhere, 2.0)
        else:
            each = missed_of(error, absolute, most)
        out[i] = 2 * each / least


@njit(cache=True, error_model="numpy")
def put_moved(table, steady, factor, out):
    """Bins, (n,), by which errors' best lines move what is measured."""
    fft_size, length = factor
    for i in range(out.size):
        moved = 0.0
        for k in range(_ROWS):
            moved += table[k, i] * steady[k]
        out[i] = 2 * moved * fft_size / length


@njit(cache=True, error_model="numpy")
def put_over_record(table, exponents, out):
    """Largest coefficients of x^0 .. x^4 of sums of powers of time, (5, n).

    Rows of the table: powers 0..4 of half the record; ends of those of its middle; ends of each
    term's coefficient, whose exponents are given.
    """
    for i in range(table.shape[1]):
        for k in range(5):
            low, high = 0.0, 0.0
            for m in range(exponents.size):
                j = exponents[m]
                if j < k:
                    continue
                ways, own, place = _BINOMIAL[j, k], 15 + 2 * m, 5 + 2 * (j - k)
                least, most = product_of(
                    (ways * table[own, i], ways * table[own + 1, i]),
                    (table[place, i], table[place + 1, i]),
                )
                low, high = low + least, high + most
            out[k, i] = np.maximum(abs(low), abs(high)) * table[k, i]
