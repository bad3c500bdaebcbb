"""Detection and leakage of a segment, with all bins accounted for but few evaluated.

Bins in a run around the lines are evaluated one by one: all that may cross the threshold, and as
many more as it takes for the leaked signal to become smooth. Beyond the run, down to DC and up to
Nyquist, the probabilities that leaked signal adds are summed as an integral, with an error below
1e-6 of the leakage. The integral is left out where the envelope of the line shape bounds it below
the accuracy asked for.

Without padding the factor e^{i pi k} is a sign, so |X| far from the lines is a smooth function of
k. Its sum over bins is then an integral plus corrections at its near end (Euler-Maclaurin, in
central differences). As |X|^2 is even about DC and Nyquist, the far end needs no correction but
half the value there. In v = cot(pi q / N), with the distance q from the lines, the integrand is
nearly a polynomial: some thirty Gauss points represent sixty thousand bins.

In developed speckle the leaked signal fades with its echo. If the speckle's power is u, of mean 1,
bins of power u |X|^2 leak with the probability 1 - exp(-R(u)), and the mean is

    P = int_0^inf e^{-u} (1 - exp(-R(u))) du.

ln R is computed at powers an octave or half of one apart and interpolated by a monotone cubic
(:func:`mean_leakage_in_speckle`). Bins that are exempt at the mean power are exempt at any power.

Bins that cross next to an echo whose outermost bin crosses are part of the echo
(:func:`sweep.model.detection.added_crossings.exclude_bins_joining_echo`), and no leakage.
"""

import math

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection.added_crossings import (
    JOINED_PROBABILITY_MIN,
    any_crossing_probability,
    crossing_rate,
    exclude_bins_joining_echo,
    fill_added_crossings,
    largest_or_zero,
    weighted_crossing_rate,
)
from sweep.model.detection.echo_detection import mark_exempt_bins
from sweep.model.detection.marcum import marcum_q1_excess
from sweep.model.detection.speckle_crossing_rates import (
    N_SPECKLE_OCTAVES,
    N_SPECKLE_POWERS,
    POWERS_PER_OCTAVE_MAX,
    SPECKLE_POWER_MAX,
    TABULATED_SPECKLE_POWERS,
    add_rates_by_power,
    rate_at_brightest_speckle,
)
from sweep.model.spectrum.bin_spectrum import (
    AFAR,
    CHANCE,
    END_POLYNOMIAL_EXTRA_LOG_ACCURACY,
    F_IM,
    F_RE,
    HALF_SQUARE,
    OUT,
    POINT,
    REAL_WITH_IMAGES,
    SOURCE_LOG_ACCURACY,
    SOURCES,
    TAN,
    TURN_IM,
    TURN_RE,
    WEIGHT,
    ZERO,
    add_line_by_record_ends,
    compute_magnitudes,
    compute_sources,
    distance_below_level_with_images,
    envelope_index,
    far_line_weight,
    is_mirrored,
    seen_positions,
    span_around_lines,
    tangent_at,
)

END_CORRECTION_BINS = 3
"""Bins on either side of the integral's near end that its end corrections use."""

END_CORRECTION_ERROR_MAX = 1e-7
"""Largest last term of the end corrections, relative to the whole leakage."""

GAUSS_POINTS_MAX = 200
"""Maximum number of Gauss points on one side of the lines."""

AT_BIN, HALF_BIN_BEYOND = np.bool_(False), np.bool_(True)
"""Positions of cotangents: at a bin, or half a bin beyond. NumPy booleans, because numba
would compile the function anew for Python's."""

OCTAVE_STEP_LEAKAGE_MAX = 0.5
"""Leakage of the brightest speckle up to which one power an octave is enough."""
RATE_MIN = 1e-30
"""Rate R below which leakage is taken to be 0."""
CERTAIN_LEAKAGE_RATE = 34.5
"""Rate R from which on leakage is certain."""

_SPECKLE_INTEGRATION_STEPS = 160
_RELATIVE_ROOT_POWERS = np.arange(1, _SPECKLE_INTEGRATION_STEPS + 1) / _SPECKLE_INTEGRATION_STEPS
_POWER_NODES = np.concatenate([[0.0], SPECKLE_POWER_MAX * _RELATIVE_ROOT_POWERS**2])
"""Nodes of the mean over speckle: closer together where powers are small."""
_OCTAVES_BELOW_MAX = -2 * np.log2(_RELATIVE_ROOT_POWERS)
"""Octaves from LOUDEST down to these nodes but the first."""
_POWER_WEIGHTS = (
    np.exp(-_POWER_NODES[1:])
    * 0.5
    * np.append(_POWER_NODES[2:] - _POWER_NODES[:-2], np.diff(_POWER_NODES[-2:]))
)

_END_CORRECTION_FACTORS = 1.0 / 24.0, -17.0 / 5760.0, 367.0 / 967680.0
"""Factors of the first, third and fifth difference in the correction of an integral's near end."""

_GAUSS_ORDER_MAX = 12
_GAUSS_RULES = np.zeros((2, _GAUSS_ORDER_MAX + 1, _GAUSS_ORDER_MAX))
for _n in range(1, _GAUSS_ORDER_MAX + 1):
    _GAUSS_RULES[:, _n, :_n] = np.polynomial.legendre.leggauss(_n)


@njit(cache=True, error_model="numpy")
def detect_with_leakage(
    origin_bin,
    lines,
    limits,
    table,
    outline,
    layout,
    tangents,
    scratch,
    is_exempt,
    crossing_series,
    speckle_rates,
):
    """Evaluate a segment: a run of bins around its lines, detection, and leakage of all bins.

    Parameters and results are those of :func:`sweep.model.spectrum.bin_spectrum.detect_in_span`,
    with these differences.

    Parameters
    ----------
    limits
        Noise per quadrature sigma; threshold on |X|; probability of leakage that may be neglected;
        LOUDEST if the echo is in developed speckle, else 1; and the correlation of neighbours'
        noise in phase with the signal.
    crossing_series
        :func:`sweep.model.detection.added_crossings.fill_crossing_series` of the threshold over
        sigma.
    speckle_rates
        :class:`sweep.model.detection.speckle_crossing_rates.SpeckleCrossingRates` of it if the echo
        is in developed speckle.

    Returns
    -------
    first_bin, n_bins, peak_index, n_exempt, leakage
        First bin and length of the run; index of the largest bin; number of exempt bins;
        probability that leaked signal raises at least one false alarm.
    """
    n_lines, lowest_position, highest_position, weight_sum, negligible = lines
    noise_sigma, threshold, tolerance, speckle_power_max, sidelobe_correlation = limits
    limits = noise_sigma, threshold, tolerance, sidelobe_correlation
    # Bounds are those of the brightest speckle.
    inverse_root = 1.0 / math.sqrt(speckle_power_max)
    brightest_limits = (
        noise_sigma * inverse_root,
        threshold * inverse_root,
        tolerance,
        sidelobe_correlation,
    )
    nyquist_bin, clearance, far_weight = layout[0] // 2, layout[6], weight_sum
    if layout[8] > clearance // 2:  # an echo whose pedestal reaches far
        clearance += layout[8]
    line_positions = seen_positions(origin_bin, lowest_position, highest_position, layout)
    image_distance = (
        max(min(line_positions[0], nyquist_bin - line_positions[1]), 0.0)
        if layout[7] == REAL_WITH_IMAGES
        else math.inf
    )
    distance_min = crossing_distance = max(
        distance_below_level_with_images(
            brightest_limits[1], weight_sum, line_positions, outline, layout
        ),
        float(clearance),
    )
    tolerance_left = limits[2] - _leakage_bound_beyond(
        far_weight, distance_min, image_distance, brightest_limits, outline
    )
    if tolerance_left < 0.0 or crossing_distance > clearance:
        n_sources = compute_sources(
            n_lines,
            lowest_position,
            highest_position,
            float(clearance),
            SOURCE_LOG_ACCURACY,
            layout,
            scratch,
        )
        far_weight = far_line_weight(weight_sum, n_sources, layout, scratch)
        crossing_distance = max(
            distance_below_level_with_images(
                brightest_limits[1], far_weight, line_positions, outline, layout
            ),
            float(clearance),
        )
        distance_min = min(crossing_distance, float(clearance + nyquist_bin))
        tolerance_left = limits[2] - _leakage_bound_beyond(
            far_weight, distance_min, image_distance, brightest_limits, outline
        )
        while (
            tolerance_left < 0.0 and distance_min < layout[2]
        ):  # bins that tables hold take less than an integral
            distance_min = min(1.25 * distance_min, float(layout[2]))
            tolerance_left = limits[2] - _leakage_bound_beyond(
                far_weight, distance_min, image_distance, brightest_limits, outline
            )
    bundle = n_lines, lowest_position, highest_position, negligible / max(weight_sum, 1e-300)
    if tolerance_left >= 0.0:
        first_bin, last_bin = span_around_lines(distance_min, line_positions, layout)
        n_bins = last_bin - first_bin + 1
        compute_magnitudes(
            first_bin,
            n_bins,
            origin_bin,
            bundle,
            scratch[:2, :0],
            table,
            outline,
            layout,
            tangents,
            scratch,
        )
        peak_index, n_exempt = mark_exempt_bins(
            scratch[OUT], n_bins, limits[1], is_exempt, layout[8]
        )
        leakage_of_span = 0.0
        if not (
            tolerance_left > 0.0
            and _leakage_bound_of_span(n_bins, brightest_limits, is_exempt, scratch)
            <= tolerance_left
        ):
            if speckle_power_max > 1.0:
                leakage_of_span = _mean_leakage_of_bins(
                    n_bins, limits, scratch, is_exempt, speckle_rates
                )
            else:
                leakage_of_span = _further_group_probability(
                    n_bins, limits, scratch, is_exempt, crossing_series
                )
        return first_bin, n_bins, peak_index, n_exempt, leakage_of_span
    near_first_bin, near_last_bin = span_around_lines(float(clearance), line_positions, layout)
    extra_bins = _extra_bins_min(
        far_weight,
        highest_position - lowest_position,
        brightest_limits,
        crossing_distance,
        outline,
        layout,
    )
    while True:
        first_bin, last_bin = near_first_bin - extra_bins, near_last_bin + extra_bins
        first_bin = 0 if first_bin <= extra_bins + END_CORRECTION_BINS else first_bin
        last_bin = (
            nyquist_bin if nyquist_bin - last_bin <= extra_bins + END_CORRECTION_BINS else last_bin
        )
        n_bins = last_bin - first_bin + 1
        compute_magnitudes(
            first_bin,
            n_bins,
            origin_bin,
            bundle,
            scratch[:2, :0],
            table,
            outline,
            layout,
            tangents,
            scratch,
        )
        peak_index, n_exempt = mark_exempt_bins(
            scratch[OUT], n_bins, limits[1], is_exempt, layout[8]
        )
        span = first_bin, n_bins, peak_index, origin_bin
        leakage, is_settled = _leakage_of_span_and_beyond(
            span,
            (n_lines, lowest_position, highest_position),
            line_positions,
            limits,
            outline,
            layout,
            tangents,
            scratch,
            is_exempt,
            crossing_series,
            speckle_rates,
            speckle_power_max,
        )
        if is_settled:
            return first_bin, n_bins, peak_index, n_exempt, leakage
        extra_bins *= 2


@njit(cache=True, error_model="numpy")
def leakage_of_bins(n_bins, limits, negligible_signal_ratio, scratch, is_exempt, crossing_series):
    """Leakage of a span, over its bins that exceed ``negligible_signal_ratio`` [sigma].

    Magnitudes of the others become 0. ``limits`` is as of :func:`detect_with_leakage` without what
    fades.
    """
    _clear_negligible_bins(n_bins, limits[0], negligible_signal_ratio, scratch, is_exempt)
    return _further_group_probability(n_bins, limits, scratch, is_exempt, crossing_series)


@njit(cache=True, error_model="numpy")
def leakage_of_bins_in_speckle(
    n_bins, limits, negligible_signal_ratio, scratch, is_exempt, speckle_rates
):
    """Return the mean of :func:`leakage_of_bins` over developed speckle.

    ``speckle_rates``: :class:`sweep.model.detection.speckle_crossing_rates.SpeckleCrossingRates` of
    the threshold.
    """
    _clear_negligible_bins(n_bins, limits[0], negligible_signal_ratio, scratch, is_exempt)
    return _mean_leakage_of_bins(n_bins, limits, scratch, is_exempt, speckle_rates)


@njit(cache=True, error_model="numpy")
def _clear_negligible_bins(n_bins, noise_sigma, negligible_signal_ratio, scratch, is_exempt):
    """Set bins of a run that are of no echo and below ``negligible_signal_ratio`` [sigma] to 0."""
    for i in range(n_bins):
        if not is_exempt[i] and scratch[OUT, i] < negligible_signal_ratio * noise_sigma:
            scratch[OUT, i] = 0.0


@njit(cache=True, error_model="numpy")
def _further_group_probability(n_bins, limits, scratch, is_exempt, crossing_series):
    """Return the probability of a further group in a run's bins; probabilities are in row CHANCE.

    ``limits``: sigma, threshold, tolerance, and correlation of neighbours' noise.
    """
    _fill_crossing_probabilities(n_bins, limits, scratch, is_exempt, crossing_series)
    exclude_bins_joining_echo(
        scratch[CHANCE], ZERO, n_bins, scratch[OUT], is_exempt, limits[0], limits[1], limits[3]
    )
    return any_crossing_probability(scratch[CHANCE], ZERO, n_bins)


@njit(cache=True, error_model="numpy")
def _mean_leakage_of_bins(n_bins, limits, scratch, is_exempt, speckle_rates):
    """Return the mean leakage of a run's bins over developed speckle."""
    return _mean_leakage_over_speckle(
        ZERO, n_bins, limits, scratch, is_exempt, speckle_rates, np.zeros(N_SPECKLE_POWERS)
    )


@njit(cache=True, error_model="numpy")
def _mean_leakage_over_speckle(
    first_index, end_index, limits, scratch, is_exempt, speckle_rates, relative_rates_beyond
):
    """Return the mean leakage, over developed speckle, of bins first .. last - 1 and of others.

    ``limits``: sigma, threshold, tolerance, and correlation of neighbours' noise.
    ``relative_rates_beyond``: of the
    others the sum of rates at each speckle power, over this power.
    """
    noise_sigma, threshold, _, sidelobe_correlation = limits
    n_listed_max = _mark_joining_bins(
        first_index, end_index, noise_sigma, scratch, is_exempt, speckle_rates
    )
    rate_sums, scale = np.zeros(N_SPECKLE_POWERS), 1.0 / (noise_sigma * noise_sigma)
    # Bins that may join an echo, the echo's bins next to them, and one for all that lie between.
    joining_rates, probabilities = (
        np.zeros((n_listed_max, N_SPECKLE_POWERS)),
        np.zeros(n_listed_max),
    )
    magnitudes, is_echo = np.zeros(n_listed_max), np.zeros(n_listed_max, np.bool_)
    n_listed, is_gap_listed = 0, True
    for i in range(first_index, end_index):
        squared_ratio = scratch[OUT, i] * scratch[OUT, i] * scale
        if is_exempt[i]:
            if (i > first_index and not is_exempt[i - 1]) or (
                i + 1 < end_index and not is_exempt[i + 1]
            ):
                magnitudes[n_listed], is_echo[n_listed] = scratch[OUT, i], True
                n_listed, is_gap_listed = n_listed + 1, False
        elif scratch[CHANCE, i] > 0.0:
            add_rates_by_power(squared_ratio, 1.0, speckle_rates, joining_rates[n_listed])
            magnitudes[n_listed], n_listed, is_gap_listed = scratch[OUT, i], n_listed + 1, False
        else:
            add_rates_by_power(squared_ratio, 1.0, speckle_rates, rate_sums)
            if not is_gap_listed:
                n_listed, is_gap_listed = n_listed + 1, True
    rate_at_brightest = rate_sums[N_SPECKLE_POWERS - 1] + max(
        relative_rates_beyond[N_SPECKLE_POWERS - 1], 0.0
    )
    for i in range(n_listed):
        rate_at_brightest += joining_rates[i, N_SPECKLE_POWERS - 1]
    rate_at_brightest *= SPECKLE_POWER_MAX
    if rate_at_brightest < 1e-12:
        return 0.0
    powers_per_octave = _n_powers_per_octave(rate_at_brightest)
    power_stride = POWERS_PER_OCTAVE_MAX // powers_per_octave
    log_rates = np.empty(powers_per_octave * N_SPECKLE_OCTAVES + 1)
    for k in range(log_rates.size):
        power_index = N_SPECKLE_POWERS - 1 - k * power_stride
        power = TABULATED_SPECKLE_POWERS[power_index]
        rate = power * (rate_sums[power_index] + max(relative_rates_beyond[power_index], 0.0))
        if n_listed > 0:
            for i in range(n_listed):
                probabilities[i] = -math.expm1(-power * joining_rates[i, power_index])
            root_power = math.sqrt(power)
            exclude_bins_joining_echo(
                probabilities,
                ZERO,
                n_listed,
                magnitudes,
                is_echo,
                noise_sigma / root_power,
                threshold / root_power,
                sidelobe_correlation,
            )
            for i in range(n_listed):
                rate += crossing_rate(probabilities[i])
        log_rates[k] = math.log(min(max(rate, RATE_MIN), CERTAIN_LEAKAGE_RATE))
    return mean_leakage_in_speckle(log_rates, powers_per_octave)


@njit(cache=True, error_model="numpy", borrows=True)
def _mark_joining_bins(first_index, end_index, noise_sigma, scratch, is_exempt, speckle_rates):
    """Mark bins first .. last - 1 that may join an echo in row CHANCE, by 1; others by 0.

    Return their number, with that of the bins next to them and of those that set them apart.
    """
    n_listed_max, stretch_end = 0, first_index
    for i in range(first_index, end_index):
        scratch[CHANCE, i] = 0.0
    while stretch_end < end_index:
        stretch_begin = stretch_end
        while stretch_end < end_index and not is_exempt[stretch_end]:
            stretch_end += 1
        if stretch_end > stretch_begin and stretch_begin > first_index:
            n_listed_max += 2 + _mark_bins_that_may_all_cross(
                stretch_begin, 1, stretch_end - stretch_begin, noise_sigma, scratch, speckle_rates
            )
        if stretch_end > stretch_begin and stretch_end < end_index:
            n_listed_max += 2 + _mark_bins_that_may_all_cross(
                stretch_end - 1,
                -1,
                stretch_end - stretch_begin,
                noise_sigma,
                scratch,
                speckle_rates,
            )
        stretch_end += 1
    return n_listed_max


@njit(cache=True, error_model="numpy", borrows=True)
def _mark_bins_that_may_all_cross(first_index, step, n_bins, noise_sigma, scratch, speckle_rates):
    """Mark bins from ``first_index`` on as long as all of them may cross; return their number."""
    n_marked, p_all_cross = 0, 1.0
    while n_marked < n_bins and p_all_cross > JOINED_PROBABILITY_MIN:
        i = first_index + n_marked * step
        signal_ratio = scratch[OUT, i] / noise_sigma
        if n_marked > 0:
            p_all_cross *= -math.expm1(
                -rate_at_brightest_speckle(signal_ratio * signal_ratio, speckle_rates)
            )
        scratch[CHANCE, i] = 1.0
        n_marked += 1
    return n_marked


@njit(cache=True, error_model="numpy")
def _n_powers_per_octave(rate_at_brightest):
    """Return how many speckle powers an octave leakage is computed at, by the brightest's rate.

    Where runs of bins join the echo in bright speckle, leakage does not rise with the power.
    """
    return POWERS_PER_OCTAVE_MAX if -math.expm1(-rate_at_brightest) > OCTAVE_STEP_LEAKAGE_MAX else 1


@njit(cache=True, error_model="numpy")
def _harmonic_mean_slope(first, second):
    """Return the harmonic mean of two slopes, or 0 if their signs differ."""
    return 2.0 * first * second / (first + second) if first * second > 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def mean_leakage_in_speckle(log_rates, powers_per_octave):
    """Return int_0^inf e^-u (1 - exp(-R(u))) du, ln R given at powers from LOUDEST down.

    ``powers_per_octave`` is the number of these in a factor of 2. Below the smallest of these
    powers R is proportional to u; above LOUDEST nothing is added.
    """
    last_index, mean, interval = log_rates.size - 1, 0.0, -1
    slope_at_start, slope_at_end, slope = 0.0, 0.0, 0.0
    for i in range(_SPECKLE_INTEGRATION_STEPS - 1, -1, -1):
        table_position = powers_per_octave * _OCTAVES_BELOW_MAX[i]
        k = int(table_position)
        if k >= last_index:
            log_rate = (
                log_rates[last_index]
                - (table_position - last_index) * math.log(2.0) / powers_per_octave
            )
        else:
            if k != interval:
                # A monotone cubic [Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5, 300, 1984].
                interval, slope = k, log_rates[k + 1] - log_rates[k]
                previous_slope = log_rates[k] - log_rates[k - 1] if k > 0 else slope
                next_slope = log_rates[k + 2] - log_rates[k + 1] if k + 2 <= last_index else slope
                slope_at_start, slope_at_end = (
                    _harmonic_mean_slope(previous_slope, slope),
                    _harmonic_mean_slope(slope, next_slope),
                )
            x = table_position - k
            log_rate = log_rates[k] + x * (
                slope_at_start
                + x
                * (
                    3.0 * slope
                    - 2.0 * slope_at_start
                    - slope_at_end
                    + x * (slope_at_start + slope_at_end - 2.0 * slope)
                )
            )
        rate = math.exp(min(log_rate, 4.0))
        p_leakage = rate * (1.0 - rate * (0.5 - rate / 6.0)) if rate < 1e-4 else -math.expm1(-rate)
        mean += _POWER_WEIGHTS[i] * p_leakage
    return mean


@njit(cache=True, error_model="numpy")
def _leakage_bound_beyond(weight_sum, distance_min, image_distance, limits, outline):
    """Bound the leakage of all bins that are ``distance_min`` or more bins away from the lines.

    With x = a^2/2, y = b^2/2 and z = a b a single bin adds at most

        x dQ_1/dx = x y e^{-y} g,    g = I_1(z) / (z/2) <= e^{z^2/8}, 2 e^z / sqrt(2 pi z^3),

    so that all of them together add at most y e^{-y} g(nearest) times the sum of x. Images are no
    nearer to a bin than the lines, nor than ``image_distance`` bins; inf if there are no images.
    ``weight_sum``: summed magnitude of the lines; ``limits`` begins with sigma, threshold. Returns
    inf where the bound does not hold (z > 2 y).
    """
    noise_sigma, threshold, _, _ = limits
    weight_sum /= noise_sigma
    b = threshold / noise_sigma
    y = 0.5 * b * b
    nearest_envelope, square_sum = _envelope_beyond(distance_min, outline)
    if image_distance < math.inf:
        image_envelope, image_square_sum = _envelope_beyond(
            max(distance_min, image_distance), outline
        )
        image_square_sum += (
            max(image_distance - distance_min, 0.0) * image_envelope * image_envelope
        )
        nearest_envelope += image_envelope
        square_sum = (math.sqrt(square_sum) + math.sqrt(image_square_sum)) ** 2
    z = weight_sum * nearest_envelope * b
    if z > 2.0 * y:
        return np.inf
    growth = z * z / 8.0
    if z > 1.0:
        growth = min(growth, z + math.log(2.0 / math.sqrt(2.0 * math.pi * z * z * z)))
    return weight_sum * weight_sum * square_sum * y * math.exp(growth - y) / -math.expm1(-y)


@njit(cache=True, error_model="numpy")
def _envelope_beyond(distance_min, outline):
    """Envelope of |G| at ``distance_min`` bins, and half the sum of its squares from there on."""
    index = envelope_index(distance_min - 1.5, outline)
    return outline[1, index], outline[1, index] * outline[1, index] + outline[2, index]


@njit(cache=True, error_model="numpy")
def _leakage_bound_of_span(n_bins, limits, is_exempt, scratch):
    """Bound the leakage of a run's bins from their magnitudes; inf where a bin is too strong.

    With x and y as in :func:`_leakage_bound_beyond`, Q_1 is convex in x up to y - 2, because I_2(z)
    / I_1(z)
    >= z / (2 + sqrt(z^2 + 4)). Each bin then adds at most in proportion to the strongest one, and
    this at most e^{-(b - a)^2 / 2}; the factor 1.2 covers that noise alone stays below the
    threshold with a probability of at least 1 - e^-2.
    """
    noise_sigma, threshold, _, _ = limits
    largest, square_sum = 0.0, 0.0
    for i in range(n_bins):
        magnitude = 0.0 if is_exempt[i] else scratch[OUT, i]
        largest = max(largest, magnitude)
        square_sum += magnitude * magnitude
    if not largest > 0.0:
        return 0.0
    a, b = largest / noise_sigma, threshold / noise_sigma
    if a * a > b * b - 4.0:
        return np.inf
    return 1.2 * square_sum / (largest * largest) * math.exp(-0.5 * (b - a) * (b - a))


@njit(cache=True, error_model="numpy")
def _fill_crossing_probabilities(n_bins, limits, scratch, is_exempt, crossing_series):
    """Store in row CHANCE the crossing probability that signal adds in each bin of a run.

    Bins above the threshold, which bright speckle lifts over it, are no matter of the series.
    """
    noise_sigma, threshold = limits[0], limits[1]
    threshold_ratio, scale = threshold / noise_sigma, 0.5 / (noise_sigma * noise_sigma)
    any_above = False
    for i in range(n_bins):
        is_above = scratch[OUT, i] > threshold and not is_exempt[i]
        any_above |= is_above
        half_square = scratch[OUT, i] * scratch[OUT, i] * scale
        scratch[HALF_SQUARE, i] = 0.0 if is_exempt[i] or is_above else half_square
    fill_added_crossings(
        scratch[HALF_SQUARE], n_bins, threshold_ratio, crossing_series, scratch[CHANCE]
    )
    if any_above:
        p_noise_stay = -math.expm1(-0.5 * threshold_ratio * threshold_ratio)
        for i in range(n_bins):
            if scratch[OUT, i] > threshold and not is_exempt[i]:
                scratch[CHANCE, i] = min(
                    marcum_q1_excess(scratch[OUT, i] / noise_sigma, threshold_ratio) / p_noise_stay,
                    1.0,
                )


@njit(cache=True, error_model="numpy")
def _extra_bins_min(weight_sum, line_extent, limits, crossing_distance, outline, layout):
    """Return how many bins beyond the near ones the run has to include before the integral begins.

    Heuristic: far enough for the threshold, for a smooth rate, and for 3/4 of the lines' spread;
    rounded up to a multiple of 8. :func:`detect_with_leakage` doubles it until
    :func:`_leakage_of_span_and_beyond` is accurate.
    """
    noise_sigma, threshold, _, _ = limits
    clearance = layout[6]
    edge_signal = outline[1, clearance] * weight_sum / noise_sigma
    smooth_distance = 4.0 + 1.5 * math.sqrt(edge_signal * clearance * threshold / noise_sigma)
    distance_min = max(crossing_distance, max(smooth_distance, 0.75 * line_extent)) - clearance
    return int(
        min(
            (max(math.ceil(distance_min), 0.0) + 2 * END_CORRECTION_BINS + 7) // 8 * 8,
            layout[0] // 2,
        )
    )


@njit(cache=True, error_model="numpy")
def _leakage_of_span_and_beyond(
    span,
    lines,
    line_positions,
    limits,
    outline,
    layout,
    tangents,
    scratch,
    is_exempt,
    crossing_series,
    speckle_rates,
    speckle_power_max,
):
    """Return the leakage of the run and of all bins beyond it, and whether the run is long enough.

    If ``speckle_power_max`` is above 1 the echo fades, and the leakage is the mean over its
    speckle.
    """
    first_bin, n_bins, peak_index, origin_bin = span
    noise_sigma, threshold, _, sidelobe_correlation = limits
    fft_size, nyquist_bin = layout[0], layout[0] // 2
    threshold_ratio, scale = threshold / noise_sigma, 0.5 / (noise_sigma * noise_sigma)
    goes_on_below, goes_on_above = first_bin > 0, first_bin + n_bins - 1 < nyquist_bin
    if not goes_on_below and not goes_on_above:
        if speckle_power_max > 1.0:
            return _mean_leakage_of_bins(n_bins, limits, scratch, is_exempt, speckle_rates), True
        return _further_group_probability(n_bins, limits, scratch, is_exempt, crossing_series), True
    _fill_crossing_probabilities(n_bins, limits, scratch, is_exempt, crossing_series)
    centre_bin = abs(math.floor(0.5 * (line_positions[0] + line_positions[1]) + 0.5))
    centre_bin = fft_size - centre_bin if centre_bin > nyquist_bin else centre_bin
    rate_beyond, last_terms, n_points = 0.0, 0.0, ZERO
    for side in (-1, 1):
        if not (goes_on_below if side < 0 else goes_on_above):
            continue
        correction, correction_term, steepness, exists = _near_end_correction(
            side, n_bins, scratch[CHANCE], is_exempt
        )
        if not exists:
            return 0.0, False
        rate_beyond += correction
        last_terms += correction_term
        end_distance = (
            centre_bin - first_bin - END_CORRECTION_BINS
            if side < 0
            else first_bin + n_bins - 1 - END_CORRECTION_BINS - centre_bin
        )
        n_points = _add_gauss_points(
            side, end_distance, centre_bin, steepness, layout, tangents, scratch, n_points
        )
    first_index, end_index = (
        END_CORRECTION_BINS if goes_on_below else ZERO,
        n_bins - END_CORRECTION_BINS if goes_on_above else n_bins,
    )
    exclude_bins_joining_echo(
        scratch[CHANCE],
        first_index,
        end_index,
        scratch[OUT],
        is_exempt,
        limits[0],
        limits[1],
        sidelobe_correlation,
    )
    span_leakage = any_crossing_probability(scratch[CHANCE], first_index, end_index)
    while n_points % 8:  # whole vectors: what is left over costs as much as all of them
        scratch[POINT, n_points], scratch[WEIGHT, n_points] = scratch[POINT, n_points - 1], 0.0
        n_points += 1
    bins_per_radian = fft_size / math.pi
    for i in range(n_points):
        scratch[WEIGHT, i] *= bins_per_radian / (1.0 + scratch[POINT, i] * scratch[POINT, i])
        scratch[POINT, i] = 1.0 / scratch[POINT, i]
    log_accuracy = min(
        max(math.log(200.0 * threshold_ratio * threshold_ratio / max(limits[2], 1e-300)), 4.0),
        SOURCE_LOG_ACCURACY,
    )
    _fill_far_powers(
        n_points, centre_bin, origin_bin, lines, log_accuracy, outline, layout, tangents, scratch
    )
    for i in range(n_points):
        scratch[HALF_SQUARE, i] *= scale
        scratch[AFAR, i] = scratch[HALF_SQUARE, i]
    largest_beyond = largest_or_zero(scratch[HALF_SQUARE, :n_points])
    fill_added_crossings(
        scratch[HALF_SQUARE], n_points, threshold_ratio, crossing_series, scratch[CHANCE]
    )
    rate_beyond += weighted_crossing_rate(scratch[CHANCE, :n_points], scratch[WEIGHT, :n_points])
    half_square_max = min(
        0.45 * threshold_ratio * threshold_ratio,
        scratch[OUT, peak_index] * scratch[OUT, peak_index] * scale,
    )
    if not (
        largest_beyond <= half_square_max
        and last_terms <= END_CORRECTION_ERROR_MAX * (span_leakage + rate_beyond)
    ):
        return 0.0, False
    if speckle_power_max > 1.0:
        return _mean_leakage_of_span_and_beyond(
            n_bins,
            n_points,
            limits,
            goes_on_below,
            goes_on_above,
            scratch,
            is_exempt,
            speckle_rates,
        ), True
    return span_leakage - (1.0 - span_leakage) * math.expm1(-rate_beyond), True


@njit(cache=True, error_model="numpy")
def _mean_leakage_of_span_and_beyond(
    n_bins, n_points, limits, goes_on_below, goes_on_above, scratch, is_exempt, speckle_rates
):
    """Return the mean leakage, over developed speckle, of a run and of the integral beyond it."""
    relative_rates_beyond, scale = np.zeros(N_SPECKLE_POWERS), 1.0 / (limits[0] * limits[0])
    for side in (-1, 1):
        if not (goes_on_below if side < 0 else goes_on_above):
            continue
        last_near_index = (
            n_bins - END_CORRECTION_BINS - 1 if side > 0 else END_CORRECTION_BINS
        )  # the last bin before the integral
        for offset in range(-2, 4):
            magnitude = scratch[OUT, last_near_index + side * offset]
            add_rates_by_power(
                magnitude * magnitude * scale,
                _end_correction_factor(offset),
                speckle_rates,
                relative_rates_beyond,
            )
    for i in range(n_points):
        add_rates_by_power(
            2.0 * scratch[AFAR, i], scratch[WEIGHT, i], speckle_rates, relative_rates_beyond
        )
    first_index, end_index = (
        END_CORRECTION_BINS if goes_on_below else ZERO,
        n_bins - END_CORRECTION_BINS if goes_on_above else n_bins,
    )
    return _mean_leakage_over_speckle(
        first_index, end_index, limits, scratch, is_exempt, speckle_rates, relative_rates_beyond
    )


@njit(cache=True, error_model="numpy", borrows=True)
def _end_correction_factor(offset):
    """Factor of bin ``offset``, -2 .. 3, in the correction at the near end."""
    factor_1, factor_3, factor_5 = _END_CORRECTION_FACTORS
    factors = factor_1 - 3.0 * factor_3 + 10.0 * factor_5, factor_3 - 5.0 * factor_5, factor_5
    return factors[offset - 1] if offset > 0 else -factors[-offset]


@njit(cache=True, error_model="numpy")
def _fill_far_powers(
    n_points, centre_bin, origin_bin, lines, log_accuracy, outline, layout, tangents, scratch
):
    """Store |X|^2 at far points in row HALF_SQUARE, with a relative error of e^-digits.

    The points are given by tan(pi q / N), with their distance q from ``centre_bin``, in row POINT.
    Lines that are too few for equivalent sources are summed exactly.
    """
    n_lines, lowest_position, highest_position = lines
    adds_powers, line_direction = (
        layout[4] != 0,
        -1 if is_mirrored(origin_bin, lowest_position, highest_position, layout[7]) else 1,
    )
    for image_pass in range(2 if layout[7] == REAL_WITH_IMAGES else 1):
        direction = line_direction if image_pass == 0 else -line_direction
        tangent_shift = tangent_at(centre_bin - direction * origin_bin, layout[0], tangents)
        for i in range(n_points):
            tangent = scratch[POINT, i]
            scratch[TAN, i] = (
                direction * (tangent + tangent_shift) / (1.0 - tangent * tangent_shift)
            )
            scratch[TURN_RE, i], scratch[TURN_IM, i] = 1.0, 0.0
            scratch[F_RE, i], scratch[F_IM, i] = 0.0, 0.0
        distance_min = float(layout[6])
        if image_pass == 1:  # images are as far from DC and Nyquist as the lines
            edge_distance = min(centre_bin, layout[0] // 2 - centre_bin) - 0.5 * (
                highest_position - lowest_position
            )
            distance_min = max(distance_min, edge_distance - 2.0)
        n_sources = compute_sources(
            n_lines, lowest_position, highest_position, distance_min, log_accuracy, layout, scratch
        )
        for source in range(n_sources):
            add_line_by_record_ends(
                ZERO,
                n_points,
                ZERO,
                SOURCES,
                source,
                log_accuracy + END_POLYNOMIAL_EXTRA_LOG_ACCURACY,
                outline,
                layout,
                scratch,
            )
        for i in range(n_points):
            re, im = scratch[F_RE, i], direction * scratch[F_IM, i]
            scratch[HALF_SQUARE, i] = re if image_pass == 0 else scratch[HALF_SQUARE, i] + re
            scratch[CHANCE, i] = im if image_pass == 0 else scratch[CHANCE, i] + im
    for i in range(n_points):
        re, im = scratch[HALF_SQUARE, i], scratch[CHANCE, i]
        scratch[HALF_SQUARE, i] = max(re, 0.0) if adds_powers else re * re + im * im


@njit(cache=True, error_model="numpy")
def _near_end_correction(side, n_bins, probabilities, is_exempt):
    """Compute the Euler-Maclaurin correction at the near end of one side's integral.

    Returns the correction, the size of its last term, the steepness -d ln f / dq [1/bin], and False
    if an exempt bin is too near for it.
    """
    step = 1 if side > 0 else -1
    i = (
        n_bins - END_CORRECTION_BINS - 1 if side > 0 else END_CORRECTION_BINS
    )  # the last bin before the integral
    for k in range(-2, 4):
        if is_exempt[i + k * step]:
            return 0.0, 0.0, 0.0, False
    rate_before, rate_after = (
        crossing_rate(probabilities[i]),
        crossing_rate(probabilities[i + step]),
    )
    difference_1 = rate_after - rate_before
    outer_difference = crossing_rate(probabilities[i + 2 * step]) - crossing_rate(
        probabilities[i - step]
    )
    difference_3 = outer_difference - 3.0 * difference_1
    difference_5 = crossing_rate(probabilities[i + 3 * step]) - crossing_rate(
        probabilities[i - 2 * step]
    )
    difference_5 += 10.0 * difference_1 - 5.0 * outer_difference
    terms = difference_1 / 24.0, -17.0 / 5760.0 * difference_3, 367.0 / 967680.0 * difference_5
    last_term = max(abs(terms[2]), abs(terms[1]) / 30.0)  # the fifth may cross zero
    steepness = abs(difference_1) / max(rate_after, 1e-300)
    return terms[0] + terms[1] + terms[2], last_term, steepness, True


@njit(cache=True, error_model="numpy")
def _add_gauss_points(
    side, last_distance, centre_bin, steepness, layout, tangents, scratch, n_points
):
    """Append the Gauss points of one side's integral to rows POINT and WEIGHT; return their number.

    Rows hold cotangents of pi q / N and weights. The integral begins half a bin beyond
    ``last_distance``, q
    counted from ``centre_bin``. With images the spectrum is even about DC and Nyquist. Without them
    it goes on, and the integral, out to half a bin beyond the last bin, is corrected by the first
    difference.
    """
    fft_size, nyquist_bin = layout[0], layout[0] // 2
    far_bin = 0 if side < 0 else nyquist_bin
    ends_half_bin_beyond = side > 0 and 2 * nyquist_bin != fft_size
    far_distance = abs(far_bin - centre_bin)
    goes_on = layout[7] != REAL_WITH_IMAGES and far_distance < nyquist_bin
    ends_half_bin_beyond = ends_half_bin_beyond or goes_on
    far_cotangent = max(
        _bin_cotangent(far_distance, ends_half_bin_beyond, fft_size, tangents), 1e-9
    )
    near_cotangent = _bin_cotangent(last_distance, HALF_BIN_BEYOND, fft_size, tangents)
    panel_start, scale_min = near_cotangent, max(far_cotangent, 0.5)
    while panel_start > far_cotangent:
        if panel_start > 8.0 * scale_min:
            panel_end = panel_start * (0.125 if panel_start > 32.0 * scale_min else 0.25)
        else:
            panel_end = 0.5 * panel_start if panel_start > 2.2 * scale_min else far_cotangent
        n_panel_points = _gauss_order(
            steepness * (last_distance + 0.5), panel_start / near_cotangent
        )
        middle, half_width = 0.5 * (panel_start + panel_end), 0.5 * (panel_start - panel_end)
        for i in range(n_panel_points):
            scratch[POINT, n_points] = side * (
                middle + half_width * _GAUSS_RULES[0, n_panel_points, i]
            )
            scratch[WEIGHT, n_points] = half_width * _GAUSS_RULES[1, n_panel_points, i]
            n_points += 1
        panel_start = panel_end
    bin_angle = math.pi / fft_size
    if goes_on:
        for k in range(2):
            cotangent = _bin_cotangent(far_distance + k, AT_BIN, fft_size, tangents)
            scratch[POINT, n_points] = side * cotangent
            scratch[WEIGHT, n_points] = (
                (1.0 - 2.0 * k) / 24.0 * bin_angle * (1.0 + cotangent * cotangent)
            )
            n_points += 1
    elif not ends_half_bin_beyond:  # the far end is a bin: half of it lies beyond the integral
        scratch[POINT, n_points] = side * far_cotangent
        scratch[WEIGHT, n_points] = 0.5 * bin_angle * (1.0 + far_cotangent * far_cotangent)
        n_points += 1
    return n_points


@njit(cache=True, error_model="numpy")
def _bin_cotangent(distance, half_bin_beyond, fft_size, tangents):
    """Return cot(pi q / N) at q = ``distance`` bins, or half a bin farther, 0 < q <= N/2."""
    tangent_at_bin = tangents[distance]
    if not half_bin_beyond:
        return 1.0 / tangent_at_bin
    half_bin_tangent = 0.5 * math.pi / fft_size
    half_bin_tangent *= 1.0 + half_bin_tangent * half_bin_tangent / 3.0
    return (1.0 - tangent_at_bin * half_bin_tangent) / (tangent_at_bin + half_bin_tangent)


@njit(cache=True, error_model="numpy")
def _gauss_order(steepness, relative_cotangent):
    """Return the number of Gauss points of a panel that begins at this cotangent."""
    order = 4 + int(0.6 * steepness * relative_cotangent)
    if relative_cotangent > 0.9:
        order += 5
    elif relative_cotangent > 0.06:
        order += 4
    elif relative_cotangent > 0.008:
        order += 2
    return min(order, _GAUSS_ORDER_MAX)
