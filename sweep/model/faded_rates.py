"""Rates of false alarms by leaked signal at many powers of developed speckle, from one table.

Signal of amplitude a, over the noise per quadrature sigma, adds c to the probability that noise
alone makes its bin cross the threshold b (:mod:`sweep.model.crossings`). Bins add up by their rates
r = -ln(1 - c). An echo whose speckle has the power u, of mean 1, leaks signal of amplitude
a sqrt(u). Its rate is

    r(a sqrt(u)) = a^2 u rho(ln a + ln(u) / 2),

and rho, which is constant where signal is faint, depends on the threshold alone. It is tabulated
for a threshold, at evenly spaced ln(a) of which a whole number makes up the distance of two
powers. A bin's rates at all powers are then a weighted sum of a few rows of the table.
"""

import math
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.crossings import added_crossings, silence
from sweep.model.marcum import marcum_q1_pair

LOUDEST = 16.0
"""Largest speckle power (mean 1) in averages of leakage; a fraction e^-16 of draws exceeds it."""
OCTAVES = 9
"""Octaves of speckle power below LOUDEST at which leakage is computed."""
FINER_POWERS = 2
"""Largest number of powers an octave."""

POWERS = FINER_POWERS * OCTAVES + 2
"""Number of powers: those of the octaves, and a fainter one, as rows take whole vectors."""

SPECKLE_POWERS = LOUDEST * 2.0 ** (-np.arange(POWERS - 1, -1, -1) / FINER_POWERS)
"""(POWERS,): speckle powers in rising order."""

TAPS = 6
"""Entries that interpolation takes."""

RATE_MAX = 40.0
"""Rate from which on a bin is certain to cross."""

_POWER_STEP = 0.5 * math.log(2.0) / FINER_POWERS
"""Distance of two powers in ln(amplitude)."""
_FAINTEST_POWER_LOG = 0.5 * math.log(LOUDEST) - (POWERS - 1) * _POWER_STEP
_FAINTEST_PRODUCT = 0.01
"""Product a b at the largest power below which rho is taken to be constant; it changes by 1.3e-5
there."""
_LOG_STEP_MAX = 0.3
"""Largest change of ln(rho) between entries; interpolation then errs by 4e-6 of rho."""
_CERTAIN = 9.0
"""Amplitude above the threshold [sigma] from which on rates are RATE_MAX."""
_PHASES_MIN, _PHASES_MAX = 4, 256


class FadedRates(NamedTuple):
    """Table of rho for a threshold."""

    first: float
    """ln(amplitude) of the first entry."""
    step: float
    """Distance of entries in ln(amplitude)."""
    last: float
    """Largest place, in entries, that interpolation has entries for at all powers."""
    values: np.ndarray
    """(phases + 5, columns): rho. Entry number ``phases`` c + p is that in row p and column c, so
    that the powers of a bin are adjacent, and the six entries that it takes are in six rows."""


@njit(cache=True, nogil=True, error_model="numpy")
def no_rates():
    """Return a table of no threshold."""
    return FadedRates(0.0, 1.0, 0.0, np.empty((0, 0)))


@njit(cache=True, nogil=True, error_model="numpy")
def faded_rates(level, series):
    """Tabulate the rates at a threshold.

    Parameters
    ----------
    level
        Threshold [sigma].
    series
        :func:`sweep.model.crossings.crossing_series` of it.
    """
    level = max(level, 1e-3)
    # ln(rate) rises by a (b - a) for each unit of ln(a), and rates below e^-30 don't matter.
    steepness = min(0.25 * level * level, 7.7 * level) + 1.0
    phases = int(_POWER_STEP * steepness / _LOG_STEP_MAX) + 1
    phases = min(max(phases, _PHASES_MIN), _PHASES_MAX)
    step = _POWER_STEP / phases
    first = math.log(_FAINTEST_PRODUCT / level) - 2.0 * step - (POWERS - 1) * _POWER_STEP
    span = max(math.log(level + _CERTAIN) - first, 0.0)
    columns = int(span / _POWER_STEP) + POWERS + 3
    number = phases * columns
    squares, rates, used = np.empty(number), np.zeros(number + 8), np.empty(number + 8)
    below = 0
    for k in range(number):
        amplitude = math.exp(first + step * k)
        squares[k] = amplitude * amplitude
        used[k] = 0.5 * squares[k]
        below += amplitude < level
    stays = -math.expm1(-0.5 * level * level)
    added_crossings(used, below, level, series, rates)
    for k in range(number):
        rate = RATE_MAX
        if k < below:
            rate = silence(rates[k])
        elif squares[k] < (level + _CERTAIN) * (level + _CERTAIN):
            quiet = marcum_q1_pair(math.sqrt(squares[k]), level)[1] / stays
            rate = min(-math.log(max(quiet, 1e-300)), RATE_MAX)
        rates[k] = rate / squares[k]
    values = np.empty((phases + TAPS - 1, columns))
    for row in range(phases + TAPS - 1):
        for column in range(columns):
            values[row, column] = rates[min(phases * column + row, number - 1)]
    return FadedRates(first, step, float((columns - POWERS - 1) * phases), values)


@njit(cache=True, error_model="numpy", borrows=True)
def add_rates(square, weight, table, sums):
    """Add ``weight`` times a bin's rates over the speckle power to ``sums``, (POWERS,).

    ``square``: squared amplitude over that of sigma, at mean power.
    """
    place = (0.5 * math.log(square) + _FAINTEST_POWER_LOG - table.first) / table.step
    place = min(max(place, 2.0), table.last)
    k = np.uint64(place) - np.uint64(2)
    x, phases = place - math.floor(place), np.uint64(table.values.shape[0] - (TAPS - 1))
    column = k // phases
    row, values = k - column * phases, table.values
    # Lagrange's polynomial through six entries.
    low, high, weight = x * x - 1.0, (x * x - 1.0) * (x - 2.0), weight * square
    a = weight * x * high * (3.0 - x) / 120.0
    b = weight * x * (x - 1.0) * (x * x - 4.0) * (x - 3.0) / 24.0
    c = weight * low * (x * x - 4.0) * (3.0 - x) / 12.0
    d = weight * x * (x + 1.0) * (x * x - 4.0) * (x - 3.0) / 12.0
    e = weight * x * low * (x + 2.0) * (3.0 - x) / 24.0
    f = weight * x * low * (x * x - 4.0) / 120.0
    for j in range(np.uint64(POWERS)):
        at = column + j
        sums[j] += (
            (a * values[row, at] + b * values[row + np.uint64(1), at])
            + (c * values[row + np.uint64(2), at] + d * values[row + np.uint64(3), at])
            + (e * values[row + np.uint64(4), at] + f * values[row + np.uint64(5), at])
        )


@njit(cache=True, error_model="numpy", borrows=True)
def brightest_rate(square, table):
    """Return the rate of a bin at the power LOUDEST, by linear interpolation."""
    place = 0.5 * math.log(square) + _FAINTEST_POWER_LOG - table.first
    place = min(max(place / table.step, 2.0), table.last)
    k, phases = int(place), table.values.shape[0] - (TAPS - 1)
    x, column = place - k, POWERS - 1
    before = table.values[k % phases, k // phases + column]
    after = table.values[k % phases + 1, k // phases + column]
    return LOUDEST * square * (before + x * (after - before))
