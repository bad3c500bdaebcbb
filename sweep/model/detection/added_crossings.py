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
from sweep.model.detection.marcum import marcum_q1_excess, marcum_q1_tails

BINS_PER_BATCH = 256
"""Bins for which the polynomial is evaluated together."""

SERIES_Y_MAX = 450.0
"""y up to which the series serves; above, and for amplitudes that dwarf the noise, Marcum's Q."""

SERIES_TERMS_MAX = 800

JOINED_PROBABILITY_MIN = 1e-9
"""Probability that all bins of a run cross, below which no further one is taken to join it."""

EDGE_NOISE_DEVIATION_MIN = 0.01
"""Smallest deviation [sigma] of an outermost bin's noise, given that its neighbour crosses."""

_EXPONENTIAL_COEFFICIENTS = tuple((-1) ** n / math.factorial(n) for n in range(12))
"""Of e^-z, to 1e-16 for z <= 1/4."""


@njit(cache=True, error_model="numpy")
def fill_crossing_series(threshold_ratio, series):
    """Fill ``series`` with c_n y^n / n!, over the probability that noise alone stays below.

    As many as any amplitude below the threshold asks for; none above :data:`SERIES_Y_MAX`.
    """
    y = 0.5 * threshold_ratio * threshold_ratio
    if not 0.0 < y <= SERIES_Y_MAX:
        return
    term, power, total = math.exp(-y) / -math.expm1(-y), 1.0, 0.0
    for n in range(1, min(_n_series_terms(y, y) + 8, series.size)):
        ratio = y / n
        term *= ratio
        power *= ratio
        total += term
        series[n] = total * power


@njit(cache=True, error_model="numpy")
def _n_series_terms(x, y):
    """Terms that leave less than 1e-16 of the sum for amplitudes up to x (<= y)."""
    root = math.sqrt(x * y)
    return int(8.0 + 1.3 * root + 5.0 * math.sqrt(root) + 4.0 * math.sqrt(x))


@njit(cache=True, error_model="numpy")
def fill_added_crossings(half_squares, n_bins, threshold_ratio, series, probabilities):
    """Fill ``probabilities`` (>= count + 7,) with (Q_1 - e^-y) / (1 - e^-y) of bins, 0..1.

    ``half_squares`` is a^2/2 of each bin, below y; used up, and so are up to seven elements more.
    ``threshold_ratio``:
    threshold over the noise per quadrature; ``series``: :func:`fill_crossing_series` of it.
    """
    y = 0.5 * threshold_ratio * threshold_ratio
    if y > SERIES_Y_MAX:
        for i in range(n_bins):
            probabilities[i] = marcum_q1_excess(math.sqrt(2.0 * half_squares[i]), threshold_ratio)
        return
    padded_count = (
        (n_bins + 7) // 8 * 8
    )  # whole vectors: what is left over costs as much as all of them
    half_squares[n_bins:padded_count] = 0.0
    for first in range(0, padded_count, BINS_PER_BATCH):
        last = min(first + BINS_PER_BATCH, padded_count)
        half_square_max = largest_or_zero(half_squares[first:last])
        n_terms = min(_n_series_terms(min(half_square_max, y), y), series.size - 8)
        halvings = 0
        scale = 1.0
        while half_square_max * scale > 0.25:
            scale *= 0.5
            halvings += 1
        _evaluate_series(
            half_squares[first:last],
            1.0 / y,
            series,
            n_terms,
            scale,
            halvings,
            probabilities[first:last],
        )


@njit(cache=True, error_model="numpy")
def largest_or_zero(values):
    """Largest of some numbers, at least 0."""
    maximum = 0.0
    for i in range(values.size):
        maximum = values[i] if values[i] > maximum else maximum
    return maximum


@njit(cache=True, error_model="numpy")
def _evaluate_series(half_squares, inverse_y, series, n_terms, scale, halvings, probabilities):
    """e^-x sum d_n (x inverse)^n, n = 1 .. terms; e^-x as a power of e^(-x scale)."""
    for i in range(half_squares.size):
        probabilities[i] = 0.0
    for n in range((n_terms + 7) // 8 * 8 - 7, 0, -8):  # eight at a time: fewer loads and stores
        a, b, c, d = series[n], series[n + 1], series[n + 2], series[n + 3]
        e, f, g, h = series[n + 4], series[n + 5], series[n + 6], series[n + 7]
        for i in range(half_squares.size):
            u = half_squares[i] * inverse_y
            u2 = u * u
            high = u2 * (u * (h + probabilities[i]) + g) + (u * f + e)
            low = u2 * (u * d + c) + (u * b + a)
            probabilities[i] = u * (u2 * u2 * high + low)
    for i in range(half_squares.size):
        z = scale * half_squares[i]
        decay = _EXPONENTIAL_COEFFICIENTS[11]
        for n in range(10, -1, -1):
            decay = z * decay + _EXPONENTIAL_COEFFICIENTS[n]
        half_squares[i] = decay
    for _ in range(halvings):
        for i in range(half_squares.size):
            half_squares[i] *= half_squares[i]
    for i in range(half_squares.size):
        probabilities[i] *= half_squares[i]


@njit(cache=True, error_model="numpy")
def any_crossing_probability(probabilities, first, last):
    """1 - prod(1 - probability) over probabilities first .. last - 1, with all its digits."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    i = first
    while i + 3 < last:  # four at a time, as each waits for the one before
        a += probabilities[i] * (1.0 - a)
        b += probabilities[i + 1] * (1.0 - b)
        c += probabilities[i + 2] * (1.0 - c)
        d += probabilities[i + 3] * (1.0 - d)
        i += 4
    a += b * (1.0 - a)
    c += d * (1.0 - c)
    a += c * (1.0 - a)
    while i < last:
        a += probabilities[i] * (1.0 - a)
        i += 1
    return a


@njit(cache=True, error_model="numpy")
def crossing_rate(probability):
    """-ln(1 - probability): what adds up over bins."""
    if probability < 1e-4:
        return probability * (
            1.0 + probability * (0.5 + probability * (1.0 / 3.0 + 0.25 * probability))
        )
    return -math.log1p(-probability)


@njit(cache=True, error_model="numpy")
def weighted_crossing_rate(probabilities, weights):
    """Sum of the weighted -ln(1 - probability)."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    i = 0
    while i + 3 < probabilities.size:  # four at a time, as each sum waits for the one before
        a += weights[i] * crossing_rate(probabilities[i])
        b += weights[i + 1] * crossing_rate(probabilities[i + 1])
        c += weights[i + 2] * crossing_rate(probabilities[i + 2])
        d += weights[i + 3] * crossing_rate(probabilities[i + 3])
        i += 4
    while i < probabilities.size:
        a += weights[i] * crossing_rate(probabilities[i])
        i += 1
    return (a + b) + (c + d)


@njit(cache=True, error_model="numpy")
def edge_crossing_probability(edge_ratio, neighbour_ratio, threshold_ratio, sidelobe_correlation):
    """Return the probability that an echo's outermost bin crosses, given that its neighbour does.

    Parameters
    ----------
    edge_ratio, neighbour_ratio
        |X| / sigma of the outermost bin, and of its neighbour outside the echo.
    threshold_ratio
        Threshold [sigma].
    sidelobe_correlation
        Correlation of their noise in phase with the signal.

    Notes
    -----
    A bin crosses by noise n > b - a in phase with its signal. This has the mean m = phi / (1 - Phi)
    at d = b - a and the variance 1 - m (m - d). In the outermost bin it leaves noise of the mean
    rho m and the variance s^2 = 1 - rho^2 m (m - d), whose distance from the threshold is that of a
    bin of the amplitude b - (b - a_edge - rho m) / s in noise of unit variance.
    """
    if sidelobe_correlation != 0.0:
        distance_to_threshold = threshold_ratio - neighbour_ratio
        noise_mean = max(distance_to_threshold, 0.0)
        if -8.0 < distance_to_threshold < 30.0:
            tail = 0.5 * math.erfc(math.sqrt(0.5) * distance_to_threshold)
            noise_mean = math.exp(-0.5 * distance_to_threshold * distance_to_threshold) / (
                math.sqrt(2.0 * math.pi) * tail
            )
        noise_variance = 1.0 - sidelobe_correlation * sidelobe_correlation * noise_mean * (
            noise_mean - distance_to_threshold
        )
        noise_deviation = math.sqrt(
            max(noise_variance, EDGE_NOISE_DEVIATION_MIN * EDGE_NOISE_DEVIATION_MIN)
        )
        edge_ratio = max(
            threshold_ratio
            - (threshold_ratio - edge_ratio - sidelobe_correlation * noise_mean) / noise_deviation,
            0.0,
        )
    return marcum_q1_tails(edge_ratio, threshold_ratio).above


@njit(cache=True, error_model="numpy")
def exclude_bins_joining_echo(
    probabilities,
    first_index,
    end_index,
    magnitudes,
    is_exempt,
    sigma_and_threshold,
    sidelobe_correlation,
):
    """Leave runs of bins that join an echo out of probabilities, in place.

    The first bin next to an echo takes the probability of a further group in all bins that may join
    it, and these take 0.

    Parameters
    ----------
    probabilities
        Probabilities that signal makes bins cross.
    first_index, end_index
        First bin, and that after the last, of those that are looked at.
    magnitudes, is_exempt
        |X|, and whether bins are of an echo.
    sigma_and_threshold
        Noise per quadrature sigma, and threshold on |X|.
    sidelobe_correlation
        Correlation of neighbours' noise in phase with the signal.
    """
    noise_sigma, threshold, stretch_end = (
        sigma_and_threshold[0],
        sigma_and_threshold[1],
        first_index,
    )
    while stretch_end < end_index:
        stretch_begin = stretch_end
        while stretch_end < end_index and not is_exempt[stretch_end]:
            stretch_end += 1
        n_bins = stretch_end - stretch_begin
        n_joining_below, n_joining_above, p_join_below, p_join_above = 0, 0, 0.0, 0.0
        if n_bins > 0 and stretch_begin > first_index and probabilities[stretch_begin] > 0.0:
            n_joining_below = _count_joining_bins(probabilities, stretch_begin, 1, n_bins)
            p_join_below = edge_crossing_probability(
                magnitudes[stretch_begin - 1] / noise_sigma,
                magnitudes[stretch_begin] / noise_sigma,
                threshold / noise_sigma,
                sidelobe_correlation,
            )
        if n_bins > 0 and stretch_end < end_index and probabilities[stretch_end - 1] > 0.0:
            n_joining_above = _count_joining_bins(probabilities, stretch_end - 1, -1, n_bins)
            p_join_above = edge_crossing_probability(
                magnitudes[stretch_end] / noise_sigma,
                magnitudes[stretch_end - 1] / noise_sigma,
                threshold / noise_sigma,
                sidelobe_correlation,
            )
        if n_joining_below + n_joining_above > n_bins:
            _fill_further_group_probability(
                probabilities, stretch_begin, 1, n_bins, p_join_below, p_join_above
            )
        else:
            _fill_further_group_probability(
                probabilities, stretch_begin, 1, n_joining_below, p_join_below, 0.0
            )
            _fill_further_group_probability(
                probabilities, stretch_end - 1, -1, n_joining_above, p_join_above, 0.0
            )
        stretch_end += 1


@njit(cache=True, error_model="numpy")
def _count_joining_bins(probabilities, first_index, step, n_bins):
    """Return how many of ``n_bins`` bins from ``first_index`` on may all cross."""
    n_joining, p_all_cross = 1, 1.0
    while n_joining < n_bins and p_all_cross > JOINED_PROBABILITY_MIN:
        p_all_cross *= probabilities[first_index + n_joining * step]
        n_joining += 1
    return n_joining


@njit(cache=True, error_model="numpy")
def _fill_further_group_probability(
    probabilities, first_index, step, n_bins, p_join_first, p_join_last
):
    """Replace the probability of bin ``first_index`` by that of a further group in ``n_bins`` bins.

    ``p_join_first`` and ``p_join_last``: probabilities that the first and the last join an echo if
    they cross. The other bins take 0.
    """
    p_after_quiet_bin, p_all_in_echo, p_undecided, p_further_group = (
        1.0 - p_join_first,
        p_join_first,
        0.0,
        0.0,
    )
    # Probabilities of no further group yet: after a bin that does not cross, that is of the echo
    # or that may join one at the end. Before the first bin there stands an echo or none.
    for i in range(first_index, first_index + n_bins * step, step):
        p_cross = probabilities[i]
        p_further_group += (1.0 - p_cross) * p_undecided
        p_undecided = p_cross * (p_undecided + p_after_quiet_bin)
        p_after_quiet_bin = (1.0 - p_cross) * (p_after_quiet_bin + p_all_in_echo)
        p_all_in_echo *= p_cross
        probabilities[i] = 0.0
    if n_bins > 0:
        probabilities[first_index] = p_further_group + p_undecided * (1.0 - p_join_last)
