"""What phase errors make of the largest bin: compiled formulas of :mod:`.phase_bounds`.

Errors are rows: largest coefficients of x .. x^4 and what is no power [cycles].
"""

import math

import numpy as np
from numba import njit

from sweep.model.effects.columns import product_of
from sweep.model.effects.line_powers import (
    extremes_of,
    image_factor_of,
    power_range_of,
    uphill_of,
)
from sweep.model.effects.lobes import lobe_least

MARGIN = 1.01
"""What a and b are raised by, for the means being sums over nodes."""
HUGE = 1e12
IMAGE = 0.9
"""What an image far away leaves at least of a line whose amplitude it adds to."""

_TURN = 2 * math.pi
_ROWS = 5
_BINOMIAL = np.array([[math.comb(j, k) for k in range(5)] for j in range(5)], float)


@njit(cache=True, error_model="numpy")
def put_error_changes(axis, table, beamlets, lobe, record, window, flags, out):
    """What one of the errors of a block's lines changes, (4, n).

    Least and largest factor on magnitudes; what is added to sums of amplitudes; bins by which what
    is measured moves.

    Parameters
    ----------
    axis : (9, n) float64
        Lines and their spread, as of :attr:`sweep.model.effects.block.Block.axis`.
    table : (13, n) float64
        Width of the laser's line [bins]; an error, with its size in the record's middle, and the
        others.
    beamlets, lobe, record
        As of :func:`put_peaks`.
    window : tuple, tuple, tuple
        As of :func:`put_phase_changes`; slopes of powers' best straight lines.
    flags : (bool, bool, bool)
        Whether there are others; whether there is one line; whether lines add as amplitudes.
    """
    known, sizes, steady = window
    beside, single, amplitudes = flags
    for i in range(axis.shape[1]):
        error, others = table[1:7, i], table[7:13, i]
        both = (
            error[0] + others[0], error[1] + others[1], error[2] + others[2], error[3] + others[3],
        )  # fmt: skip
        least, most, images = _peak(axis[:, i], table[0, i], both, beamlets, lobe, record)
        low, high = _change(error, others, (least, most), known, sizes, (beside, single))
        more = 0.0
        if amplitudes and (images > 1.5 or not single):
            low, high = 1.0, 1.0
            more = _added(error, images, known[0], sizes[0], lobe_least(lobe[0][1], 0.5))
        out[0, i], out[1, i], out[2, i] = low, high, more
        moved = 0.0
        for k in range(_ROWS):
            moved += error[k] * steady[k]
        out[3, i] = 2 * moved * record[0] / record[1]


@njit(cache=True, error_model="numpy")
def put_phase_changes(table, known, sizes, flags, out):
    """Least and largest factor on magnitudes, (2, n).

    Parameters
    ----------
    table : (12, n) float64
        An error, the others, least and largest peak.
    known : ((4,), (4,), (4,), (4,)) tuples of float
        Means of powers: absolute, without the odd ones' best line, square; slopes' deviations.
    sizes : (float, float, float, float)
        Of the window: <|w|>, first sample, top, <h>.
    flags : (bool, bool)
        Whether there are others; whether the peak is one line's.
    """
    for i in range(table.shape[1]):
        error, others = table[:_ROWS, i], table[_ROWS : 2 * _ROWS, i]
        peak = table[10, i], table[11, i]
        out[0, i], out[1, i] = _change(error, others, peak, known, sizes, flags)


@njit(cache=True, error_model="numpy")
def _change(error, others, peak, known, sizes, flags):
    """Least and largest factor on a magnitude."""
    (absolute, bent, square, slopes), (most_of, edge, top, hann) = known, sizes
    (beside, single), (least, largest) = flags, peak
    besides, turned = 0.0, 0.0
    if beside:
        besides = missed_of(others, absolute, most_of)
        turned = missed_of(error, absolute, most_of) * np.minimum(largest_of(others), 2.0)
    c, kept = least - besides, 0.0
    if single:
        both, own = 0.0, 0.0
        for k in range(4):
            both += (error[k] + others[k]) * slopes[k]
            own += others[k] * slopes[k]
        c = np.fmax(c, _matched(own, others[4], hann))
        kept = _matched(both, error[4] + others[4], hann)
    c = c if c > 0 else 0.0
    a, b = _parts(error, absolute, absolute, square, most_of)
    a_rest, _ = _parts(error, bent, absolute, square, most_of)
    a, b = a + turned, b + turned
    most = largest + besides
    low = 1 - (a + b * edge / c) / c
    low = np.fmax(low, (c - a_rest - b * edge / c) / most)
    if single:
        low = np.fmax(low, kept / most)
    rise = 1 + a / c
    high = np.sqrt(rise * rise + (2 * b * edge + b * b) / (c * c))
    high = np.fmin(high, (math.hypot(top + a_rest, b + edge) + besides) / c)
    high = np.fmin(high, most_of / c)
    low = 0.0 if np.isnan(low) else low
    high = HUGE if np.isnan(high) else high
    return min(max(low, 0.0), 1.0), min(max(high, 1.0), HUGE)


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
def _matched(slope, rest, hann):
    """Lower bound from a Hann window that carries the same error; its slope deviates so much."""
    if rest > 0:
        return 0.0
    reach = np.sqrt(1 / 3 + MARGIN * (slope * slope))
    room = 2 * (3 / 8) * math.pi * reach / np.tanh(math.pi * reach)
    return hann / np.sqrt(room) / MARGIN


@njit(cache=True, error_model="numpy")
def put_peaks(axis, table, beamlets, lobe, record, out):
    """Least and largest magnitudes of the largest bin, images' factors on powers, (3, n).

    Parameters
    ----------
    axis : (9, n) float64
        As of :func:`put_error_changes`.
    table : (5, n) float64
        Width of the laser's line [bins]; x .. x^4 of an error.
    beamlets : int
        Lines at the most.
    lobe : tuple, tuple
        As of :func:`.line_powers.put_power_ranges`.
    record : (float, float, float)
        Size of the FFT, length of the record; what images leave of the least.
    """
    for i in range(axis.shape[1]):
        out[0, i], out[1, i], out[2, i] = _peak(
            axis[:, i], table[0, i], table[1:, i], beamlets, lobe, record
        )


@njit(cache=True, error_model="numpy")
def _peak(axis, width, powers, beamlets, lobe, record):
    """The same of one block of lines."""
    _, _, edge, _, _, tilt, mean, rms, away = axis
    (tables, sizes), (fft_size, length, share) = lobe, record
    slopes = 0.0
    for k in range(4):
        slopes += (k + 1) * powers[k]
    extreme = away + 6 * width
    images = image_factor_of(edge, extreme + 2 * slopes * fft_size / length, sizes[2])
    anywhere, spread = (0.5, 0.0, edge, tilt), (mean, np.hypot(rms, width), extreme)
    bounds = extremes_of(beamlets, tables)
    least, most = power_range_of(anywhere, spread, bounds, tables, sizes)
    least = share * np.sqrt(least / (images * uphill_of(tilt, extreme)))
    return least, np.sqrt(most) / IMAGE, images


@njit(cache=True, error_model="numpy")
def put_added(table, absolute, most, least, out):
    """What errors add to sums of amplitudes, (n,).

    Rows of the table: an error, its size in the record's middle, the images' factors.
    """
    for i in range(out.size):
        out[i] = _added(table[:6, i], table[6, i], absolute, most, least)


@njit(cache=True, error_model="numpy")
def _added(error, images, absolute, most, least):
    """The same of one."""
    if images > 1.5:
        anywhere = largest_of(error) + _TURN * error[5]
        each = MARGIN * most * np.minimum(anywhere, 2.0)
    else:
        each = missed_of(error, absolute, most)
    return 2 * each / least


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
