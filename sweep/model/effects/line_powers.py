"""The largest bin's power, line by line: compiled formulas of :mod:`.line_spread`."""

import numpy as np
from numba import njit

from sweep.model.effects.lobes import lobe_least, lobe_most

_CHEBYSHEV = (1.4, 1.8, 2.5, 4.0, 8.0)
_NEAR_EDGE = 8.0
"""Window bins from line to image beyond which F is below 0.4 % of the bin's, F', F'' below 5 %."""


@njit(cache=True, error_model="numpy")
def image_factor_of(edge, extreme, margin):
    """How much larger images can make powers, of lines that reach so far towards the edge."""
    return 1.01 if 2 * ((edge - extreme) / margin) > _NEAR_EDGE else 2.0


@njit(cache=True, error_model="numpy")
def put_image_factors(table, margin, out):
    """Images' factors (n,) of rows edge and extreme."""
    for i in range(out.size):
        out[i] = image_factor_of(table[0, i], table[1, i], margin)


@njit(cache=True, error_model="numpy")
def put_amplitudes(table, highest, lowest, out):
    """Least and largest magnitudes of one line's largest bin (2, n).

    Rows of the table: ends of what it has on a bin; offset, least offset, transfer and least
    transfer of the line.
    """
    for i in range(table.shape[1]):
        low, high, offset, offset_least, transfer, transfer_least = table[:, i]
        least = lobe_least(lowest, offset)
        most = least if offset == offset_least else lobe_most(highest, offset_least)
        out[0, i], out[1, i] = low * transfer_least * least, high * transfer * most


@njit(cache=True, error_model="numpy")
def put_power_ranges(table, beamlets, tables, sizes, out):
    """Least and largest powers (2, n).

    Rows of the table: offset, least offset, edge and tilt of lines; mean, rms, extreme of a spread.
    """
    bounds = extremes_of(beamlets, tables)
    for i in range(table.shape[1]):
        offset, offset_least, edge, tilt, mean, rms, extreme = table[:, i]
        out[0, i], out[1, i] = power_range_of(
            (offset, offset_least, edge, tilt), (mean, rms, extreme), bounds, tables, sizes
        )


@njit(cache=True, error_model="numpy")
def put_moved_changes(table, beamlets, tables, sizes, out):
    """Least and largest factors on magnitudes (2, n).

    Rows of the table: shift; moments added and present, three each; offset, least offset, edge,
    transfer, least transfer and tilt of the line that is moved, and of the one that is not, but
    for lines that only spread.
    """
    bounds = extremes_of(beamlets, tables)
    slope, curvature, margin, _ = sizes
    for i in range(table.shape[1]):
        own, line = table[:13, i], table[-6:, i]
        shift, mean, rms, extreme = own[0], own[1], own[2], own[3]
        if extreme == 0 and shift == 0:
            out[0, i], out[1, i] = 1.0, 1.0
            continue
        wide, tilt = own[6] + extreme, line[5]
        uphill, steepest = uphill_of(tilt, wide + shift), uphill_of(tilt, shift)
        together = own[4] + mean, own[5] + rms, wide
        moved, still = (own[7], own[8], own[9], own[12]), (line[0], line[1], line[2], tilt)
        with_least, with_most = power_range_of(moved, together, bounds, tables, sizes)
        least, most = power_range_of(still, (own[4], own[5], own[6]), bounds, tables, sizes)
        double = max(image_factor_of(line[2], wide + shift, margin), 1.05)
        change = slope * (mean + shift) + curvature * (own[5] * rms + rms * rms / 2)
        change = double * uphill * (change + tilt * (rms + shift)) / least
        if np.isnan(change):
            change = np.inf
        fall, rise = own[11] / line[3], own[10] / line[4]
        less, more = np.maximum(fall * fall, 1 / steepest), np.minimum(rise * rise, steepest)
        out[0, i] = np.sqrt(np.fmax(1 - change, less * with_least / most))
        out[1, i] = np.sqrt(np.fmin(1 + change, more * with_most / least))


@njit(cache=True, error_model="numpy")
def uphill_of(tilt, bins):
    """Most that the receiver's poles make of powers so many bins away."""
    return np.exp(np.minimum(tilt * bins, 50.0))


@njit(cache=True, error_model="numpy")
def extremes_of(beamlets, tables):
    """Power of the weakest beamlet's line half a bin away, and of all on the lobe's peak."""
    highest, lowest = tables
    return lobe_least(lowest, 0.5) ** 2 / beamlets, lobe_most(highest, 0.0) ** 2


@njit(cache=True, error_model="numpy")
def power_range_of(line, spread, extremes, tables, sizes):
    """Least and largest power of the largest bin, over that of all lines on a bin."""
    (highest, lowest), (slope, curvature, margin, energy) = tables, sizes
    offset, offset_least, edge, tilt = line
    mean, rms, extreme = spread
    worst, top = extremes
    double = image_factor_of(edge, extreme, margin)
    on_axis = lobe_least(lowest, offset) ** 2
    second = 0.5 * curvature * rms**2
    slant = min(slope, curvature * offset)
    least = on_axis - slant * mean - second - tilt * rms
    uphill = uphill_of(tilt, extreme)
    one_place = offset == offset_least and rms == 0
    most = on_axis if one_place else lobe_most(highest, offset_least) ** 2
    most = np.fmin(most + slope * mean + second, top)
    most = double * most * (1 + uphill * np.fmin(tilt * rms, 50.0))
    least = np.fmax(least, np.exp(-tilt * extreme) * worst)
    if rms > 0:
        for t in _CHEBYSHEV:
            wide = t * rms
            mean_bin = (1 - 1 / t**2) * energy / (2 * wide + 2 * margin + 1)
            least = np.fmax(least, mean_bin * np.exp(-tilt * wide))
    return np.minimum(least, most), most
