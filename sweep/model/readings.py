"""Readings of a triple of peaks: which are folded at Nyquist, and which sum is the Doppler's."""

import numpy as np
from numba import njit

from sweep.model.constants import SPEED_OF_LIGHT

READINGS = 16


@njit(cache=True, error_model="numpy")
def _read(code, up, down, sample_rate):
    """(f_d, f_r): signed Doppler and range beat by one of the readings, in the unit given.

    The bits of ``code`` are, from the highest, folds of up, Doppler and down peak, and whether
    half sum and half difference are exchanged: in the order in which readings are tried.
    """
    u = sample_rate - up if code & 8 else up
    d = sample_rate - down if code & 2 else down
    half_sum, half_difference = (u + d) / 2.0, abs(d - u) / 2.0
    shift, beat = (half_difference, half_sum) if code & 1 else (half_sum, half_difference)
    return (shift if d >= u else -shift), beat


@njit(cache=True, error_model="numpy")
def best_reading(up, doppler, down, at_start, sample_rate, penalty, tolerance):
    """Reading that predicts the Doppler peak best among those that do within a tolerance.

    ``at_start`` is the Doppler segment's carrier over that at mid-chirp, which the chirps see.

    Returns
    -------
    code : int
        Reading; -1 where none comes within the tolerance.
    cost : float
        Its mismatch and penalties, in the unit of the frequencies; inf for none.
    """
    best, least = -1, np.inf
    for code in range(READINGS):
        shift, _ = _read(code, up, down, sample_rate)
        p = sample_rate - doppler if code & 4 else doppler
        mismatch = abs(abs(shift) * at_start - p)
        cost = mismatch + ((code >> 3 & 1) + (code >> 2 & 1) + (code >> 1 & 1)) * penalty
        if cost < least and mismatch <= tolerance:
            best, least = code, cost
    return best, least


@njit(cache=True, error_model="numpy")
def resolve_reading(code, up, down, carrier, bandwidth, duration, sample_rate):
    """(range [m], radial velocity [m/s]) of an up and a down peak [Hz] by a given reading."""
    f_d, f_r = _read(code, up, down, sample_rate)
    beta = f_d / (carrier + bandwidth / 2.0)
    delay = (f_r - bandwidth * beta / 2.0) / (bandwidth / duration * (1.0 + beta))
    return SPEED_OF_LIGHT * delay / 2.0, SPEED_OF_LIGHT * beta / 2.0


@njit(cache=True, error_model="numpy")
def resolve_each(columns, found):
    """Range and radial velocity (2, n) that peaks report by the reading that predicts best; or 0.

    Columns are up, Doppler and down peak [Hz], carrier, bandwidth, duration and sample rate, and
    what a fold costs [Hz].
    """
    for i in range(columns.shape[1]):
        up, doppler, down, carrier, bandwidth, duration, sample_rate, penalty = columns[:, i]
        at_start = carrier / (carrier + bandwidth / 2)  # the Doppler segment's carrier is lower
        code, _ = best_reading(up, doppler, down, at_start, sample_rate, penalty, np.inf)
        found[0, i], found[1, i] = 0.0, 0.0
        if code >= 0:
            found[0, i], found[1, i] = resolve_reading(
                code, up, down, carrier, bandwidth, duration, sample_rate
            )
