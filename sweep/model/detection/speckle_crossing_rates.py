"""Table of the rates of false alarms due to leaked signal, for many powers of developed speckle.

Leaked signal of amplitude a, over the noise per quadrature sigma, makes its bin cross the threshold
b with a probability c in addition to noise (:mod:`sweep.model.detection.added_crossings`). The rate
r = -ln(1 - c) is additive over bins. An echo whose speckle has the power u, of mean 1, leaks signal
of amplitude a sqrt(u). The rate of its bin is

    r(a sqrt(u)) = a^2 u rho(ln a + ln(u) / 2).

The relative rate rho depends on the threshold alone, and is constant for faint signal. It is
tabulated for a threshold at evenly spaced ln(a), with a whole number of steps between successive
speckle powers. A bin's rates at all powers are then weighted sums of a few rows of the table.
"""

import math
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection.added_crossings import crossing_rate, fill_added_crossing_probabilities
from sweep.model.detection.marcum import marcum_q1_tails
from sweep.model.kernel_integers import INTEGER_ZERO

SPECKLE_POWER_MAX = 16.0
"""Largest speckle power (mean 1) in averages over the fading of leaked signal. A fraction e^-16 of
all speckle exceeds it."""
N_SPECKLE_OCTAVES = 9
"""Number of octaves of speckle power, below SPECKLE_POWER_MAX, for which the false alarms due to
leaked signal are computed."""
POWERS_PER_OCTAVE_MAX = 2
"""Largest number of speckle powers per octave at which the false alarms due to leaked signal are
computed."""

N_SPECKLE_POWERS = POWERS_PER_OCTAVE_MAX * N_SPECKLE_OCTAVES + 2
"""Number of tabulated speckle powers: POWERS_PER_OCTAVE_MAX for each octave, the one at the end of
the last octave, and a fainter one that fills the last SIMD vector."""

TABULATED_SPECKLE_POWERS = SPECKLE_POWER_MAX * 2.0 ** (
    -np.arange(N_SPECKLE_POWERS - 1, -1, -1) / POWERS_PER_OCTAVE_MAX
)
"""(N_SPECKLE_POWERS,): speckle powers (mean 1), in rising order, at which false alarms due to
leaked signal are computed."""

N_INTERPOLATION_POINTS = 6
"""Number of adjacent table entries from which a rate is interpolated."""

CERTAIN_CROSSING_RATE = 40.0
"""Rate -ln(1 - c), with a bin's crossing probability c, above which it counts as certain to cross
the threshold."""

_LOG_AMPLITUDE_STEP_BETWEEN_POWERS = 0.5 * math.log(2.0) / POWERS_PER_OCTAVE_MAX
"""Natural logarithm of the ratio of the amplitudes at two successive tabulated speckle powers."""
_LOG_AMPLITUDE_AT_FAINTEST_POWER = (
    0.5 * math.log(SPECKLE_POWER_MAX) - (N_SPECKLE_POWERS - 1) * _LOG_AMPLITUDE_STEP_BETWEEN_POWERS
)
_CONSTANT_RATE_PRODUCT_MAX = 0.01
"""Product of signal and threshold, each over the noise per quadrature, below which the crossing
rate is taken as proportional to power. The signal is that at the largest speckle power. The
relative error is 1.3e-5."""
_LOG_RATE_STEP_MAX = 0.3
"""Largest change of ln(rho) between two table entries of the relative crossing rate rho. The
interpolated rho then has a relative error of 4e-6."""
_CERTAIN_CROSSING_MARGIN_SIGMA = 9.0
"""Excess of amplitude over threshold beyond which a bin's rate is set to CERTAIN_CROSSING_RATE, in
units of the noise per quadrature."""
_TABULATED_THRESHOLD_RATIO_MIN = 1e-3
"""Smallest threshold, over the noise per quadrature, for which rates are tabulated. Smaller
thresholds count as this one."""
_ENTRIES_PER_POWER_MIN, _ENTRIES_PER_POWER_MAX = 4, 256
"""Smallest and largest number of table entries between two speckle powers."""


class SpeckleCrossingRates(NamedTuple):
    """Table of the relative rate of threshold crossings due to leaked signal, for one threshold.

    The relative rate rho is the rate -ln(1 - c) over the squared amplitude. c is the probability
    that the signal makes a bin cross where noise alone does not. Amplitudes are over the noise per
    quadrature.
    """

    log_amplitude_first: float
    """ln(amplitude) of the first table entry; amplitudes are over the noise per quadrature."""
    log_amplitude_step: float
    """Difference of ln(amplitude) between successive table entries."""
    position_max: float
    """Largest table position (fractional entry number) of a bin's amplitude at the faintest speckle
    power. From larger positions the rate at the brightest speckle would lie outside the table."""
    entries_per_power: int
    """Number p of steps in the table from the amplitude at one speckle power to that at the
    next."""
    relative_rates: np.ndarray
    """(rows, columns): relative rates of the table's entries. With p ``entries_per_power`` there
    are p + 5 rows or more, and entry number p c + r is in row r and column c. The entries of a bin
    at successive speckle powers are thus adjacent in a row, and the six entries of an interpolation
    are in six successive rows."""


class RateTableGrid(NamedTuple):
    """Amplitudes of the entries of a table of crossing rates, and the size of the table."""

    log_amplitude_first: float
    """ln(amplitude) of the first entry; amplitudes are over the noise per quadrature."""
    log_amplitude_step: float
    """Difference of ln(amplitude) between successive entries."""
    entries_per_power: int
    """Number of steps in the table from the amplitude at one speckle power to that at the next."""
    n_columns: int
    """Number of columns of the table, with ``entries_per_power`` entries each."""


class RateTableArrays(NamedTuple):
    """Arrays for the table of crossing rates at one threshold, and for its computation."""

    squared_amplitudes: np.ndarray
    """(entries,): squared amplitude of each entry, over the noise power per quadrature."""
    half_squares: np.ndarray
    """(entries + 8,): half of the squared amplitudes."""
    relative_rate_by_entry: np.ndarray
    """(entries + 8,): relative rate of the entries, in the order of their amplitudes."""
    relative_rates: np.ndarray
    """(rows, columns): relative crossing rates, as in
    :attr:`SpeckleCrossingRates.relative_rates`."""


@njit(cache=True, error_model="numpy", borrows=True)
def _rate_table_grid(threshold_ratio):
    """Return the :class:`RateTableGrid` for a threshold over the noise per quadrature."""
    # The slope of ln(rate) over ln(a) is a (b - a), and rates below e^-30 are negligible.
    steepness = min(0.25 * threshold_ratio * threshold_ratio, 7.7 * threshold_ratio) + 1.0
    entries_per_power = int(_LOG_AMPLITUDE_STEP_BETWEEN_POWERS * steepness / _LOG_RATE_STEP_MAX) + 1
    entries_per_power = min(max(entries_per_power, _ENTRIES_PER_POWER_MIN), _ENTRIES_PER_POWER_MAX)
    log_amplitude_step = _LOG_AMPLITUDE_STEP_BETWEEN_POWERS / entries_per_power
    log_amplitude_first = (
        math.log(_CONSTANT_RATE_PRODUCT_MAX / threshold_ratio)
        - 2.0 * log_amplitude_step
        - (N_SPECKLE_POWERS - 1) * _LOG_AMPLITUDE_STEP_BETWEEN_POWERS
    )
    log_amplitude_span = max(
        math.log(threshold_ratio + _CERTAIN_CROSSING_MARGIN_SIGMA) - log_amplitude_first, 0.0
    )
    n_columns = int(log_amplitude_span / _LOG_AMPLITUDE_STEP_BETWEEN_POWERS) + N_SPECKLE_POWERS + 3
    return RateTableGrid(log_amplitude_first, log_amplitude_step, entries_per_power, n_columns)


def allocate_rate_table(threshold_ratios: np.ndarray) -> RateTableArrays:
    """Allocate arrays that are large enough for the table of any one of several thresholds.

    ``threshold_ratios`` (n,) are thresholds over the noise per quadrature; n may be 0.
    """
    entries_per_power, n_columns = _table_shape_max(np.ascontiguousarray(threshold_ratios, float))
    n_entries = entries_per_power * n_columns
    return RateTableArrays(
        np.empty(n_entries),
        np.empty(n_entries + 8),
        np.empty(n_entries + 8),
        np.empty((entries_per_power + N_INTERPOLATION_POINTS - 1, n_columns)),
    )


@njit(cache=True, error_model="numpy", borrows=True)
def _table_shape_max(threshold_ratios):
    """Return the largest number of entries per power, and of columns, over several thresholds."""
    entries_per_power, n_columns = 0, 0
    for threshold_ratio in threshold_ratios:
        grid = _rate_table_grid(max(threshold_ratio, _TABULATED_THRESHOLD_RATIO_MIN))
        entries_per_power = max(entries_per_power, grid.entries_per_power)
        n_columns = max(n_columns, grid.n_columns)
    return entries_per_power, n_columns


def tabulate_crossing_rates(
    threshold_ratio: float, crossing_series: np.ndarray
) -> SpeckleCrossingRates:
    """Tabulate the relative rate of threshold crossings due to leaked signal, for one threshold.

    Parameters
    ----------
    threshold_ratio
        Threshold over the noise per quadrature.
    crossing_series
        Result of :func:`sweep.model.detection.added_crossings.fill_crossing_series` for this
        threshold.

    Returns
    -------
    SpeckleCrossingRates
    """
    arrays = allocate_rate_table(np.array([threshold_ratio]))
    grid = fill_rate_table(threshold_ratio, crossing_series, arrays)
    return rate_table(grid, arrays)


@njit(cache=True, error_model="numpy", borrows=True)
def fill_rate_table(threshold_ratio, crossing_series, arrays):
    """Fill arrays with the table of :func:`tabulate_crossing_rates`.

    Parameters
    ----------
    threshold_ratio : float
        Threshold over sigma, the noise of a bin per quadrature.
    crossing_series : ndarray
        Result of :func:`sweep.model.detection.added_crossings.fill_crossing_series` for
        ``threshold_ratio``.
    arrays : RateTableArrays
        Arrays to fill, from :func:`allocate_rate_table`.

    Returns
    -------
    RateTableGrid
        Grid of the table.
    """
    threshold_ratio = max(threshold_ratio, _TABULATED_THRESHOLD_RATIO_MIN)
    grid = _rate_table_grid(threshold_ratio)
    squared_amplitudes, half_squares, rates = (
        arrays.squared_amplitudes,
        arrays.half_squares,
        arrays.relative_rate_by_entry,
    )
    n_entries = grid.entries_per_power * grid.n_columns
    n_below_threshold = INTEGER_ZERO
    for k in range(n_entries):
        amplitude = math.exp(grid.log_amplitude_first + grid.log_amplitude_step * k)
        squared_amplitudes[k] = amplitude * amplitude
        half_squares[k] = 0.5 * squared_amplitudes[k]
        n_below_threshold += amplitude < threshold_ratio
    for k in range(n_entries + 8):
        rates[k] = 0.0
    p_noise_stay = -math.expm1(-0.5 * threshold_ratio * threshold_ratio)
    fill_added_crossing_probabilities(
        half_squares, n_below_threshold, threshold_ratio, crossing_series, rates
    )
    for k in range(n_entries):
        rate = CERTAIN_CROSSING_RATE
        if k < n_below_threshold:
            rate = crossing_rate(rates[k])
        elif squared_amplitudes[k] < (threshold_ratio + _CERTAIN_CROSSING_MARGIN_SIGMA) * (
            threshold_ratio + _CERTAIN_CROSSING_MARGIN_SIGMA
        ):
            p_signal_stay = (
                marcum_q1_tails(math.sqrt(squared_amplitudes[k]), threshold_ratio).below
                / p_noise_stay
            )
            rate = min(-math.log(max(p_signal_stay, 1e-300)), CERTAIN_CROSSING_RATE)
        rates[k] = rate / squared_amplitudes[k]
    for row in range(grid.entries_per_power + N_INTERPOLATION_POINTS - 1):
        for column in range(grid.n_columns):
            arrays.relative_rates[row, column] = rates[
                min(grid.entries_per_power * column + row, n_entries - 1)
            ]
    return grid


@njit(cache=True, error_model="numpy", inline="always")
def rate_table(grid, arrays):
    """Return the table of crossing rates that :func:`fill_rate_table` has put into arrays.

    Parameters
    ----------
    grid : RateTableGrid
        Grid of the table, the result of :func:`fill_rate_table`.
    arrays : RateTableArrays
        Arrays that :func:`fill_rate_table` has filled. The table refers to their memory.

    Returns
    -------
    SpeckleCrossingRates
        Table of the relative rates of threshold crossings.
    """
    return SpeckleCrossingRates(
        grid.log_amplitude_first,
        grid.log_amplitude_step,
        float((grid.n_columns - N_SPECKLE_POWERS - 1) * grid.entries_per_power),
        grid.entries_per_power,
        arrays.relative_rates,
    )


class RateTablePlace(NamedTuple):
    """Position in a table of crossing rates of a bin's amplitude at the faintest speckle."""

    first_entry: int
    """Number of the first of the six entries from which the bin's rate is interpolated."""
    fraction: float
    """Position of the bin's amplitude between the third and the fourth of the six entries, 0..1."""


class InterpolationWeights(NamedTuple):
    """Weights of six adjacent table entries in a bin's rate."""

    w0: float
    w1: float
    w2: float
    w3: float
    w4: float
    w5: float


@njit(cache=True, error_model="numpy", inline="always")
def _rate_table_place(squared_ratio, rate_table):
    """Return the :class:`RateTablePlace` of a bin.

    ``squared_ratio`` is the squared amplitude of the leaked signal over the noise variance per
    quadrature, at mean speckle power. ``rate_table`` is a :class:`SpeckleCrossingRates`.
    """
    table_position = (
        0.5 * math.log(squared_ratio)
        + _LOG_AMPLITUDE_AT_FAINTEST_POWER
        - rate_table.log_amplitude_first
    ) / rate_table.log_amplitude_step
    table_position = min(max(table_position, 2.0), rate_table.position_max)
    return RateTablePlace(
        np.uint64(table_position) - np.uint64(2), table_position - math.floor(table_position)
    )


@njit(cache=True, error_model="numpy", inline="always")
def _interpolation_weights(x, weight):
    """Return ``weight`` times the :class:`InterpolationWeights` of Lagrange's polynomial at ``x``.

    ``x`` is the fraction of :class:`RateTablePlace`.
    """
    square_1, square_2 = x * x - 1.0, x * x - 4.0
    return InterpolationWeights(
        weight * x * square_1 * (x - 2.0) * (3.0 - x) / 120.0,
        weight * x * (x - 1.0) * square_2 * (x - 3.0) / 24.0,
        weight * square_1 * square_2 * (3.0 - x) / 12.0,
        weight * x * (x + 1.0) * square_2 * (x - 3.0) / 12.0,
        weight * x * square_1 * (x + 2.0) * (3.0 - x) / 24.0,
        weight * x * square_1 * square_2 / 120.0,
    )


@njit(cache=True, error_model="numpy", borrows=True)
def add_rates_by_speckle_power(squared_ratio, weight, rate_table, rate_sums):
    """Add a bin's crossing rates at all speckle powers to sums over bins.

    Each rate -ln(1 - c), with the crossing probability c due to leaked signal, is divided by the
    speckle power and multiplied by the bin's weight.

    Parameters
    ----------
    squared_ratio
        Squared amplitude of the leaked signal at mean speckle power, over the noise variance per
        quadrature.
    weight
        Weight of the bin.
    rate_table
        :class:`SpeckleCrossingRates`.
    rate_sums
        (N_SPECKLE_POWERS,): sums by speckle power; changed in place.
    """
    place = _rate_table_place(squared_ratio, rate_table)
    relative_rates = rate_table.relative_rates
    entries_per_power = np.uint64(rate_table.entries_per_power)
    column = place.first_entry // entries_per_power
    row = place.first_entry - column * entries_per_power
    w = _interpolation_weights(place.fraction, weight * squared_ratio)
    for j in range(np.uint64(N_SPECKLE_POWERS)):
        power_column = column + j
        rate_sums[j] += (
            (
                w.w0 * relative_rates[row, power_column]
                + w.w1 * relative_rates[row + np.uint64(1), power_column]
            )
            + (
                w.w2 * relative_rates[row + np.uint64(2), power_column]
                + w.w3 * relative_rates[row + np.uint64(3), power_column]
            )
            + (
                w.w4 * relative_rates[row + np.uint64(4), power_column]
                + w.w5 * relative_rates[row + np.uint64(5), power_column]
            )
        )


@njit(cache=True, error_model="numpy", inline="always")
def n_entry_weights(rate_table):
    """Return the size of ``entry_weights`` in :func:`add_entry_weights_of_bin`, for a table."""
    return rate_table.entries_per_power * rate_table.relative_rates.shape[1]


@njit(cache=True, error_model="numpy", borrows=True)
def add_entry_weights_of_bin(squared_ratio, rate_table, entry_weights):
    """Add the six interpolation weights of one bin to the weights of the table's entries.

    The rate of a bin is a weighted sum of six entries. The sum over many bins is therefore one
    weighted sum of all entries, which :func:`add_rates_from_entry_weights` computes at the end. A
    bin costs six additions here, and six for each speckle power in
    :func:`add_rates_by_speckle_power`.

    Parameters
    ----------
    squared_ratio : float
        Squared amplitude of the leaked signal over sigma^2, at mean speckle power. sigma is the
        noise of a bin per quadrature.
    rate_table : SpeckleCrossingRates
        Crossing rates by squared amplitude and speckle power.
    entry_weights : ndarray
        Weights of the entries, changed in place; its size is given by :func:`n_entry_weights`.
    """
    place = _rate_table_place(squared_ratio, rate_table)
    w = _interpolation_weights(place.fraction, squared_ratio)
    first_entry = place.first_entry
    entry_weights[first_entry] += w.w0
    entry_weights[first_entry + np.uint64(1)] += w.w1
    entry_weights[first_entry + np.uint64(2)] += w.w2
    entry_weights[first_entry + np.uint64(3)] += w.w3
    entry_weights[first_entry + np.uint64(4)] += w.w4
    entry_weights[first_entry + np.uint64(5)] += w.w5


@njit(cache=True, error_model="numpy", borrows=True)
def add_rates_from_entry_weights(entry_weights, rate_table, rate_sums):
    """Add the crossing rates of all bins to sums by speckle power, by the weights of table entries.

    Parameters
    ----------
    entry_weights : ndarray
        Weights of the entries, filled by :func:`add_entry_weights_of_bin`.
    rate_table : SpeckleCrossingRates
        Crossing rates by squared amplitude and speckle power.
    rate_sums : ndarray (N_SPECKLE_POWERS,)
        Sums by speckle power, changed in place.
    """
    relative_rates = rate_table.relative_rates
    entries_per_power = np.uint64(rate_table.entries_per_power)
    for entry in range(np.uint64(entry_weights.size)):
        weight = entry_weights[entry]
        if weight == 0.0:  # most entries, as amplitudes of the bins are similar
            continue
        column = entry // entries_per_power
        row = entry - column * entries_per_power
        for j in range(np.uint64(N_SPECKLE_POWERS)):
            rate_sums[j] += weight * relative_rates[row, column + j]


@njit(cache=True, error_model="numpy", borrows=True)
def rate_at_brightest_speckle(squared_ratio, rate_table):
    """Return a bin's crossing rate -ln(1 - c) at SPECKLE_POWER_MAX, by linear interpolation.

    c is the probability that leaked signal makes the bin cross the threshold.

    Parameters
    ----------
    squared_ratio : float
        Squared amplitude a^2 of the leaked signal over sigma^2, at mean speckle power, > 0. sigma
        is the noise of a bin per quadrature.
    rate_table : SpeckleCrossingRates
        Table of relative rates rho at the threshold.

    Returns
    -------
    float
        r = a^2 u rho(ln a + ln(u) / 2), with the speckle power u = SPECKLE_POWER_MAX.
    """
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
        rate_table.entries_per_power,
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
