"""Probability that leaked signal makes bins cross the threshold, in addition to noise.

Amplitude a of a bin and threshold b are in units of the noise per quadrature; x = a^2/2 and
y = b^2/2. The bin crosses with Marcum's Q_1(a, b). Noise alone crosses with e^-y. The leaked
signal adds

    Q_1(a, b) - e^-y = e^-x sum_{n >= 1} c_n x^n / n!,    c_n = e^-y sum_{j=1..n} y^j / j!

(the Poisson mixture of chi-square tails less its value at a = 0). All terms are positive, so the
sum keeps its precision however small it is. c_n depends on the threshold alone, so all bins of a
point are one polynomial in x, which vectorises.

Adjacent bins that cross count as one group. The outermost bin of an echo crosses with probability
q. Bins next to it that cross then belong to the echo's group, and are no false peak. Let the bins
1, 2, .. next to the echo cross with the probabilities p_1, p_2, ... They hold a separate group with
the probability

    (1 - p_1) B_2 + p_1 (1 - q + q A_2),    A_j = p_j A_(j+1) + (1 - p_j) B_(j+1).

B_j is the probability that any bin from j on crosses. A_j is the probability that a bin from j on
crosses after one that does not. Bins between two echoes may join either.
"""

import math

from sweep.kernel_cache import njit
from sweep.model.detection.marcum import marcum_q1_excess, marcum_q1_tails
from sweep.model.kernel_integers import INTEGER_ZERO, STEP_DOWN, STEP_UP

BINS_PER_BATCH = 256
"""Largest number of bins for which the crossing series is evaluated at once. The series is the
probability that leaked signal makes a bin cross the threshold where noise alone does not."""

SERIES_HALF_SQUARED_THRESHOLD_MAX = 450.0
"""Largest y = b^2/2 for which the crossing series is used; b is the threshold over the noise per
quadrature. Above it, Marcum's Q is evaluated bin by bin."""

SERIES_TERMS_MAX = 800
"""Size of the array of coefficients of the crossing series, and so the largest number of terms."""

ALL_JOIN_PROBABILITY_MIN = 1e-9
"""Probability that all bins from an echo to a given bin cross the threshold, below which bins
beyond the given one are taken never to join the echo."""

ECHO_EDGE_NOISE_DEVIATION_MIN = 0.01
"""Smallest value used for the standard deviation of the noise in an echo's outermost bin, given
that its neighbour crosses. It avoids a division by zero. The unit is the noise per quadrature."""

_EXPONENTIAL_COEFFICIENTS = tuple((-1) ** n / math.factorial(n) for n in range(12))
"""Taylor coefficients (-1)^n / n! of e^-z, n = 0 .. 11. Their sum errs by 1e-16 for z <= 1/4."""
_HIGHEST_ORDER_COEFFICIENT = _EXPONENTIAL_COEFFICIENTS[-1]
"""Coefficient of z^11, with which the evaluation of e^-z begins."""


@njit(cache=True, error_model="numpy")
def fill_crossing_series(threshold_ratio, series):
    """Fill ``series`` with the coefficients of the crossing series of one threshold b.

    Element n is c_n y^n / n! / (1 - e^-y), with c_n = e^-y sum_{j=1..n} y^j / j! and y = b^2/2. As
    many terms are filled as the series needs for amplitudes up to the threshold. Nothing is filled
    for y above :data:`SERIES_HALF_SQUARED_THRESHOLD_MAX`.

    Parameters
    ----------
    threshold_ratio
        Threshold b over the noise per quadrature; y = b^2/2.
    series
        (terms,): the coefficients; element 0 is left as it is.
    """
    y = 0.5 * threshold_ratio * threshold_ratio
    if not 0.0 < y <= SERIES_HALF_SQUARED_THRESHOLD_MAX:
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
    """Return the number of terms that the crossing series needs for an error of 1e-16.

    ``x`` is half the squared largest amplitude, ``y`` half the squared threshold; x <= y. Amplitude
    and threshold are in units of the noise per quadrature.
    """
    root = math.sqrt(x * y)
    return int(8.0 + 1.3 * root + 5.0 * math.sqrt(root) + 4.0 * math.sqrt(x))


@njit(cache=True, error_model="numpy")
def fill_added_crossing_probabilities(half_squares, n_bins, threshold_ratio, series, probabilities):
    """Fill in each bin's probability that its signal makes it cross where noise alone does not.

    The probability of a bin is (Q_1(a, b) - e^-y) / (1 - e^-y), 0..1, with Marcum's Q_1.

    Parameters
    ----------
    half_squares
        (n_bins + 7,): a^2/2 of each bin, below y; a is |X| without noise over the noise per
        quadrature. The array is overwritten.
    n_bins
        Number of bins.
    threshold_ratio
        Threshold b over the noise per quadrature; y = b^2/2.
    series
        Result of :func:`fill_crossing_series` for this threshold.
    probabilities
        (n_bins + 7,): output array; the last seven elements are scratch.
    """
    y = 0.5 * threshold_ratio * threshold_ratio
    if y > SERIES_HALF_SQUARED_THRESHOLD_MAX:
        for i in range(n_bins):
            probabilities[i] = marcum_q1_excess(math.sqrt(2.0 * half_squares[i]), threshold_ratio)
        return
    # Whole vectors: a remainder would cost as much as all of them.
    padded_count = (n_bins + 7) // 8 * 8
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
    """Return the largest element of an array, or 0 if all are negative."""
    maximum = 0.0
    for i in range(values.size):
        maximum = values[i] if values[i] > maximum else maximum
    return maximum


@njit(cache=True, error_model="numpy")
def _evaluate_series(half_squares, inverse_y, series, n_terms, scale, halvings, probabilities):
    """Fill ``probabilities`` with the series e^-x sum_n d_n (x / y)^n, n = 1 .. ``n_terms``.

    Parameters
    ----------
    half_squares
        x = a^2/2 of each bin; a is |X| without noise over the noise per quadrature. Overwritten by
        e^-x.
    inverse_y
        1/y, with y = b^2/2; b is the threshold over the noise per quadrature.
    series
        Coefficients d_n, the result of :func:`fill_crossing_series`.
    n_terms
        Number of terms.
    scale, halvings
        Number of halvings of x, and scale = 2^-halvings. e^(-x scale) is squared ``halvings`` times
        to give e^-x.
    probabilities
        Result: probability that the signal makes each bin cross the threshold.
    """
    for i in range(half_squares.size):
        probabilities[i] = 0.0
    for n in range((n_terms + 7) // 8 * 8 - 7, 0, -8):  # eight terms at once save loads and stores
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
        decay = _HIGHEST_ORDER_COEFFICIENT
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
    """Return the probability that any of several independent bins crosses, 1 - prod(1 - p).

    Small results keep their precision.

    Parameters
    ----------
    probabilities : ndarray
        Crossing probability p of each bin, 0..1.
    first, last : int
        The product is over the indices first .. last - 1.
    """
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    i = first
    while i + 3 < last:  # four independent chains, as each step depends on the one before
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
    """Return -ln(1 - p) of a crossing probability p.

    The sum of this rate over independent bins is -ln of the probability that none of them crosses.
    """
    if probability < 1e-4:
        return probability * (
            1.0 + probability * (0.5 + probability * (1.0 / 3.0 + 0.25 * probability))
        )
    return -math.log1p(-probability)


@njit(cache=True, error_model="numpy")
def weighted_crossing_rate_sum(probabilities, weights):
    """Return the weighted sum over bins of -ln(1 - p), where p is a bin's crossing probability.

    Parameters
    ----------
    probabilities : ndarray (n,)
        Crossing probability p of each bin, 0..1.
    weights : ndarray
        Weight w of each bin, of either sign; at least n elements.

    Returns
    -------
    float
        -sum_i w_i ln(1 - p_i), by :func:`crossing_rate`.
    """
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    i = 0
    while i + 3 < probabilities.size:  # four sums, as each addition depends on the one before
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
def echo_edge_crossing_probability(
    edge_ratio, neighbour_ratio, threshold_ratio, sidelobe_neighbour_noise_correlation
):
    """Return the probability that an echo's outermost bin crosses, given that its neighbour does.

    The neighbour is the adjacent bin outside the echo.

    Parameters
    ----------
    edge_ratio, neighbour_ratio
        |X| without noise of the outermost bin, and of its neighbour outside the echo, over the
        noise per quadrature sigma.
    threshold_ratio
        Threshold b over sigma.
    sidelobe_neighbour_noise_correlation
        Correlation rho of the two bins' noise components in phase with their signals.

    Notes
    -----
    All amplitudes are in units of sigma. The neighbour, of amplitude a, crosses by noise n > d
    = b - a in phase with its signal. Given this, n has the mean m = phi(d) / (1 - Phi(d)) and the
    variance 1 - m (m - d), with the standard normal density phi and distribution function Phi.

    The noise of the outermost bin then has the mean rho m and the variance s^2 = 1 - rho^2 m (m -
    d). The bin, of amplitude a_edge, crosses as often as a bin of amplitude b - (b - a_edge - rho
    m) / s in noise of unit variance.
    """
    if sidelobe_neighbour_noise_correlation != 0.0:
        distance_to_threshold = threshold_ratio - neighbour_ratio
        noise_mean = max(distance_to_threshold, 0.0)
        if -8.0 < distance_to_threshold < 30.0:
            tail = 0.5 * math.erfc(math.sqrt(0.5) * distance_to_threshold)
            noise_mean = math.exp(-0.5 * distance_to_threshold * distance_to_threshold) / (
                math.sqrt(2.0 * math.pi) * tail
            )
        noise_variance = (
            1.0
            - sidelobe_neighbour_noise_correlation
            * sidelobe_neighbour_noise_correlation
            * noise_mean
            * (noise_mean - distance_to_threshold)
        )
        noise_deviation = math.sqrt(
            max(noise_variance, ECHO_EDGE_NOISE_DEVIATION_MIN * ECHO_EDGE_NOISE_DEVIATION_MIN)
        )
        edge_ratio = max(
            threshold_ratio
            - (threshold_ratio - edge_ratio - sidelobe_neighbour_noise_correlation * noise_mean)
            / noise_deviation,
            0.0,
        )
    return marcum_q1_tails(edge_ratio, threshold_ratio).above


@njit(cache=True, error_model="numpy")
def exclude_crossings_joining_echo(
    probabilities,
    first_index,
    end_index,
    magnitudes,
    is_exempt,
    noise_sigma,
    threshold,
    sidelobe_neighbour_noise_correlation,
):
    """Remove crossings that join an echo from the bins' crossing probabilities, in place.

    Adjacent bins above the threshold count as one group. A bin next to an echo that crosses may
    thus belong to the echo's group and be no false peak. Bins that may join an echo are therefore
    treated together. The element of the bin next to the echo becomes the probability that these
    bins hold a group separate from the echo. The elements of the other bins become 0.

    Parameters
    ----------
    probabilities
        (bins,): probability that leaked signal makes each bin cross; changed in place.
    first_index, end_index
        Index of the first bin to process, and of the bin after the last.
    magnitudes
        (bins,): |X| without noise [V].
    is_exempt
        (bins,) bool: True in bins that belong to an echo.
    noise_sigma
        Standard deviation of the noise per quadrature [V].
    threshold
        Threshold on |X| [V]; adjacent bins above it form a group.
    sidelobe_neighbour_noise_correlation
        Correlation of neighbouring bins' noise components in phase with the signal.
    """
    gap_end = first_index
    while gap_end < end_index:
        gap_begin = gap_end
        while gap_end < end_index and not is_exempt[gap_end]:
            gap_end += 1
        n_bins = gap_end - gap_begin
        n_joining_below, n_joining_above = INTEGER_ZERO, INTEGER_ZERO
        p_join_below, p_join_above = 0.0, 0.0
        if n_bins > 0 and gap_begin > first_index and probabilities[gap_begin] > 0.0:
            n_joining_below = _count_joining_bins(probabilities, gap_begin, STEP_UP, n_bins)
            p_join_below = echo_edge_crossing_probability(
                magnitudes[gap_begin - 1] / noise_sigma,
                magnitudes[gap_begin] / noise_sigma,
                threshold / noise_sigma,
                sidelobe_neighbour_noise_correlation,
            )
        if n_bins > 0 and gap_end < end_index and probabilities[gap_end - 1] > 0.0:
            n_joining_above = _count_joining_bins(probabilities, gap_end - 1, STEP_DOWN, n_bins)
            p_join_above = echo_edge_crossing_probability(
                magnitudes[gap_end] / noise_sigma,
                magnitudes[gap_end - 1] / noise_sigma,
                threshold / noise_sigma,
                sidelobe_neighbour_noise_correlation,
            )
        if n_joining_below + n_joining_above > n_bins:
            _fill_separate_group_probability(
                probabilities, gap_begin, STEP_UP, n_bins, p_join_below, p_join_above
            )
        else:
            _fill_separate_group_probability(
                probabilities, gap_begin, STEP_UP, n_joining_below, p_join_below, 0.0
            )
            _fill_separate_group_probability(
                probabilities, gap_end - 1, STEP_DOWN, n_joining_above, p_join_above, 0.0
            )
        gap_end += 1


@njit(cache=True, error_model="numpy")
def _count_joining_bins(probabilities, first_index, step, n_bins):
    """Return the number of bins next to an echo that may join the echo, 1 .. ``n_bins``.

    A bin joins the echo if it crosses the threshold together with all bins between it and the echo.
    The first bin is ``first_index``, and ``step``, 1 or -1, leads to the next one. The count ends
    at the first bin for which the probability that all bins so far cross is at most
    :data:`ALL_JOIN_PROBABILITY_MIN`.
    """
    n_joining, p_all_cross = 1, 1.0
    while n_joining < n_bins and p_all_cross > ALL_JOIN_PROBABILITY_MIN:
        p_all_cross *= probabilities[first_index + n_joining * step]
        n_joining += 1
    return n_joining


@njit(cache=True, error_model="numpy")
def _fill_separate_group_probability(
    probabilities, first_index, step, n_bins, p_join_first, p_join_last
):
    """Store in the first bin the probability that bins next to an echo hold a separate group.

    A group is a run of adjacent bins that cross the threshold. It is separate if it does not touch
    the echo's group. The probabilities of the other ``n_bins - 1`` bins become 0.

    Parameters
    ----------
    probabilities
        Crossing probabilities; changed in place.
    first_index, step, n_bins
        Index of the first bin, step to the next one, and number of bins.
    p_join_first, p_join_last
        Probability that the first and that the last bin join an echo if they cross.
    """
    # Joint probabilities of no further group so far and the state of the last bin: it does not
    # cross, belongs to the echo's group, or may join the echo at the other end.
    p_after_quiet_bin, p_all_in_echo = 1.0 - p_join_first, p_join_first
    p_undecided, p_further_group = 0.0, 0.0
    for i in range(first_index, first_index + n_bins * step, step):
        p_cross = probabilities[i]
        p_further_group += (1.0 - p_cross) * p_undecided
        p_undecided = p_cross * (p_undecided + p_after_quiet_bin)
        p_after_quiet_bin = (1.0 - p_cross) * (p_after_quiet_bin + p_all_in_echo)
        p_all_in_echo *= p_cross
        probabilities[i] = 0.0
    if n_bins > 0:
        probabilities[first_index] = p_further_group + p_undecided * (1.0 - p_join_last)
