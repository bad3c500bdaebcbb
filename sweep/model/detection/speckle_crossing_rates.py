"""Rates of false alarms by leaked signal at many powers of developed speckle, from one table.

Signal of amplitude a, over the noise per quadrature sigma, adds c to the probability that noise
alone makes its bin cross the threshold b (:mod:`sweep.model.detection.added_crossings`). Bins add
up by their rates
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
from sweep.model.detection.added_crossings import crossing_rate, fill_added_crossings
from sweep.model.detection.marcum import marcum_q1_tails

SPECKLE_POWER_MAX = 16.0
"""Largest speckle power (mean 1) in averages of leakage; a fraction e^-16 of draws exceeds it."""
N_SPECKLE_OCTAVES = 9
"""Octaves of speckle power below LOUDEST at which leakage is computed."""
POWERS_PER_OCTAVE_MAX = 2
"""Largest number of powers an octave."""

N_SPECKLE_POWERS = POWERS_PER_OCTAVE_MAX * N_SPECKLE_OCTAVES + 2
"""Number of powers: those of the octaves, and a fainter one, as rows take whole vectors."""

TABULATED_SPECKLE_POWERS = SPECKLE_POWER_MAX * 2.0 ** (
    -np.arange(N_SPECKLE_POWERS - 1, -1, -1) / POWERS_PER_OCTAVE_MAX
)
"""(POWERS,): speckle powers in rising order."""

INTERPOLATION_POINTS = 6
"""Entries that interpolation takes."""

CERTAIN_CROSSING_RATE = 40.0
"""Rate from which on a bin is certain to cross."""

_LOG_AMPLITUDE_PER_POWER = 0.5 * math.log(2.0) / POWERS_PER_OCTAVE_MAX
"""Distance of two powers in ln(amplitude)."""
_LOG_AMPLITUDE_AT_FAINTEST_POWER = (
    0.5 * math.log(SPECKLE_POWER_MAX) - (N_SPECKLE_POWERS - 1) * _LOG_AMPLITUDE_PER_POWER
)
_CONSTANT_RATE_PRODUCT_MAX = 0.01
"""Product a b at the largest power below which rho is taken to be constant; it changes by 1.3e-5
there."""
_LOG_RATE_STEP_MAX = 0.3
"""Largest change of ln(rho) between entries; interpolation then errs by 4e-6 of rho."""
_CERTAIN_MARGIN_SIGMA = 9.0
"""Amplitude above the threshold [sigma] from which on rates are RATE_MAX."""
_ENTRIES_PER_POWER_MIN, _ENTRIES_PER_POWER_MAX = 4, 256


class SpeckleCrossingRates(NamedTuple):
    """Table of rho for a threshold."""

    log_amplitude_first: float
    """ln(amplitude) of the first entry."""
    log_amplitude_step: float
    """Distance of entries in ln(amplitude)."""
    position_max: float
    """Largest place, in entries, that interpolation has entries for at all powers."""
    relative_rates: np.ndarray
    """(phases + 5, columns): rho. Entry number ``phases`` c + p is that in row p and column c, so
    that the powers of a bin are adjacent, and the six entries that it takes are in six rows."""


@njit(cache=True, nogil=True, error_model="numpy")
def empty_crossing_rates():
    """Return a table of no threshold."""
    return SpeckleCrossingRates(0.0, 1.0, 0.0, np.empty((0, 0)))


@njit(cache=True, nogil=True, error_model="numpy")
def tabulate_crossing_rates(threshold_ratio, crossing_series):
    """Tabulate the rates at a threshold.

    Parameters
    ----------
    threshold_ratio
        Threshold [sigma].
    crossing_series
        :func:`sweep.model.detection.added_crossings.fill_crossing_series` of it.
    """
    threshold_ratio = max(threshold_ratio, 1e-3)
    # ln(rate) rises by a (b - a) for each unit of ln(a), and rates below e^-30 don't matter.
    steepness = min(0.25 * threshold_ratio * threshold_ratio, 7.7 * threshold_ratio) + 1.0
    entries_per_power = int(_LOG_AMPLITUDE_PER_POWER * steepness / _LOG_RATE_STEP_MAX) + 1
    entries_per_power = min(max(entries_per_power, _ENTRIES_PER_POWER_MIN), _ENTRIES_PER_POWER_MAX)
    log_amplitude_step = _LOG_AMPLITUDE_PER_POWER / entries_per_power
    log_amplitude_first = (
        math.log(_CONSTANT_RATE_PRODUCT_MAX / threshold_ratio)
        - 2.0 * log_amplitude_step
        - (N_SPECKLE_POWERS - 1) * _LOG_AMPLITUDE_PER_POWER
    )
    log_amplitude_span = max(
        math.log(threshold_ratio + _CERTAIN_MARGIN_SIGMA) - log_amplitude_first, 0.0
    )
    n_columns = int(log_amplitude_span / _LOG_AMPLITUDE_PER_POWER) + N_SPECKLE_POWERS + 3
    n_entries = entries_per_power * n_columns
    squared_amplitudes, rates, half_squares = (
        np.empty(n_entries),
        np.zeros(n_entries + 8),
        np.empty(n_entries + 8),
    )
    n_below_threshold = 0
    for k in range(n_entries):
        amplitude = math.exp(log_amplitude_first + log_amplitude_step * k)
        squared_amplitudes[k] = amplitude * amplitude
        half_squares[k] = 0.5 * squared_amplitudes[k]
        n_below_threshold += amplitude < threshold_ratio
    p_noise_stay = -math.expm1(-0.5 * threshold_ratio * threshold_ratio)
    fill_added_crossings(half_squares, n_below_threshold, threshold_ratio, crossing_series, rates)
    for k in range(n_entries):
        rate = CERTAIN_CROSSING_RATE
        if k < n_below_threshold:
            rate = crossing_rate(rates[k])
        elif squared_amplitudes[k] < (threshold_ratio + _CERTAIN_MARGIN_SIGMA) * (
            threshold_ratio + _CERTAIN_MARGIN_SIGMA
        ):
            p_signal_stay = (
                marcum_q1_tails(math.sqrt(squared_amplitudes[k]), threshold_ratio).below
                / p_noise_stay
            )
            rate = min(-math.log(max(p_signal_stay, 1e-300)), CERTAIN_CROSSING_RATE)
        rates[k] = rate / squared_amplitudes[k]
    relative_rates = np.empty((entries_per_power + INTERPOLATION_POINTS - 1, n_columns))
    for row in range(entries_per_power + INTERPOLATION_POINTS - 1):
        for column in range(n_columns):
            relative_rates[row, column] = rates[
                min(entries_per_power * column + row, n_entries - 1)
            ]
    return SpeckleCrossingRates(
        log_amplitude_first,
        log_amplitude_step,
        float((n_columns - N_SPECKLE_POWERS - 1) * entries_per_power),
        relative_rates,
    )


@njit(cache=True, error_model="numpy", borrows=True)
def add_rates_by_power(squared_ratio, weight, rate_table, rate_sums):
    """Add ``weight`` times a bin's rates over the speckle power to ``rate_sums``, (POWERS,).

    ``squared_ratio``: squared amplitude over that of sigma, at mean power.
    """
    table_position = (
        0.5 * math.log(squared_ratio)
        + _LOG_AMPLITUDE_AT_FAINTEST_POWER
        - rate_table.log_amplitude_first
    ) / rate_table.log_amplitude_step
    table_position = min(max(table_position, 2.0), rate_table.position_max)
    first_entry = np.uint64(table_position) - np.uint64(2)
    fraction, entries_per_power = (
        table_position - math.floor(table_position),
        np.uint64(rate_table.relative_rates.shape[0] - (INTERPOLATION_POINTS - 1)),
    )
    column = first_entry // entries_per_power
    row, relative_rates = first_entry - column * entries_per_power, rate_table.relative_rates
    # Lagrange's polynomial through six entries.
    quadratic, cubic, weight = (
        fraction * fraction - 1.0,
        (fraction * fraction - 1.0) * (fraction - 2.0),
        weight * squared_ratio,
    )
    a = weight * fraction * cubic * (3.0 - fraction) / 120.0
    b = weight * fraction * (fraction - 1.0) * (fraction * fraction - 4.0) * (fraction - 3.0) / 24.0
    c = weight * quadratic * (fraction * fraction - 4.0) * (3.0 - fraction) / 12.0
    d = weight * fraction * (fraction + 1.0) * (fraction * fraction - 4.0) * (fraction - 3.0) / 12.0
    e = weight * fraction * quadratic * (fraction + 2.0) * (3.0 - fraction) / 24.0
    f = weight * fraction * quadratic * (fraction * fraction - 4.0) / 120.0
    for j in range(np.uint64(N_SPECKLE_POWERS)):
        power_column = column + j
        rate_sums[j] += (
            (
                a * relative_rates[row, power_column]
                + b * relative_rates[row + np.uint64(1), power_column]
            )
            + (
                c * relative_rates[row + np.uint64(2), power_column]
                + d * relative_rates[row + np.uint64(3), power_column]
            )
            + (
                e * relative_rates[row + np.uint64(4), power_column]
                + f * relative_rates[row + np.uint64(5), power_column]
            )
        )


@njit(cache=True, error_model="numpy", borrows=True)
def rate_at_brightest_speckle(squared_ratio, rate_table):
    """Return the rate of a bin at the power LOUDEST, by linear interpolation."""
    table_position = (
        0.5 * math.log(squared_ratio)
        + _LOG_AMPLITUDE_AT_FAINTEST_POWER
        - rate_table.log_amplitude_first
    )
    table_position = min(
        max(table_position / rate_table.log_amplitude_step, 2.0), rate_table.position_max
    )
    first_entry, entries_per_power = (
        int(table_position),
        rate_table.relative_rates.shape[0] - (INTERPOLATION_POINTS - 1),
    )
    fraction, power_column = table_position - first_entry, N_SPECKLE_POWERS - 1
    rate_at_entry = rate_table.relative_rates[
        first_entry % entries_per_power, first_entry // entries_per_power + power_column
    ]
    rate_at_next_entry = rate_table.relative_rates[
        first_entry % entries_per_power + 1, first_entry // entries_per_power + power_column
    ]
    return (
        SPECKLE_POWER_MAX
        * squared_ratio
        * (rate_at_entry + fraction * (rate_at_next_entry - rate_at_entry))
    )
