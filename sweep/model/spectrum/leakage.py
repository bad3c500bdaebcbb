"""Detection and leakage of a segment, where all bins count but few are computed.

Leakage is the probability of false alarms due to the echo's signal far from its lines.

A span, the adjacent bins around the lines, is computed bin by bin. It contains all bins that may
cross the threshold, and as many more as it takes for the leaked signal to become smooth. Beyond the
span, down to DC and up to Nyquist, the probabilities that leaked signal adds are summed as an
integral, with an error below 1e-6 of the leakage. The integral is left out if the envelope of the
line shape bounds it below the tolerance.

Without padding the factor e^{i pi k} is a sign, so |X| far from the lines is a smooth function of
k. Its sum over bins is then an integral plus corrections at its near end (Euler-Maclaurin, in
central differences). As |X|^2 is even about DC and Nyquist, the only correction at the far end is
half the value there. In v = cot(pi q / N), with the distance q from the lines, the integrand is
nearly a polynomial: about thirty Gauss points represent sixty thousand bins.

In developed speckle the leaked signal fades with its echo. The speckle's power is u, of mean 1. Let
R(u) be the summed rate of false alarms by bins of power u |X|^2. At least one of them raises a
false alarm with the probability 1 - exp(-R(u)). The mean is

    P = int_0^inf e^{-u} (1 - exp(-R(u))) du.

ln R is computed at powers an octave or half an octave apart, and interpolated by a monotone cubic
(:func:`mean_leakage_from_log_rates`). Bins exempt at the mean power are exempt at any power.

Bins that cross next to an echo whose outermost bin crosses are part of the echo
(:func:`sweep.model.detection.added_crossings.exclude_crossings_joining_echo`), and no leakage.
"""

import math
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection.added_crossings import (
    ALL_JOIN_PROBABILITY_MIN,
    any_crossing_probability,
    crossing_rate,
    exclude_crossings_joining_echo,
    fill_added_crossing_probabilities,
    largest_or_zero,
    weighted_crossing_rate_sum,
)
from sweep.model.detection.echo_detection import mark_exempt_bins
from sweep.model.detection.marcum import marcum_q1_excess
from sweep.model.detection.speckle_crossing_rates import (
    N_SPECKLE_OCTAVES,
    N_SPECKLE_POWERS,
    POWERS_PER_OCTAVE_MAX,
    SPECKLE_POWER_MAX,
    TABULATED_SPECKLE_POWERS,
    add_entry_weights_of_bin,
    add_rates_by_speckle_power,
    add_rates_from_entry_weights,
    n_entry_weights,
    rate_at_brightest_speckle,
)
from sweep.model.kernel_integers import INTEGER_ZERO, STEP_DOWN, STEP_UP
from sweep.model.spectrum.bin_spectrum import (
    FAR_LINE_EXTRA_LOG_ACCURACY,
    FAR_LINE_LOG_ACCURACY,
    AveragingShifts,
    DetectedSpan,
    add_line_by_record_ends,
    bins_around_lines,
    compute_end_amplitudes_and_far_lines,
    compute_magnitudes,
    envelope_index,
    falloff_distance_with_images,
    far_line_weight,
    folded_line_range,
    is_mirrored,
    tangent_of_bin,
)
from sweep.model.spectrum.lines import REAL_WITH_IMAGES

INTEGRAL_END_CORRECTION_BINS = 3
"""Number of bins on each side of the leakage integral's end near the lines, from which the
correction of that end is computed."""

LAST_END_CORRECTION_FRACTION_MAX = 1e-7
"""Largest accepted size of the last term of the Euler-Maclaurin correction at the integral's near
end, relative to the whole leakage.

The integral over bins stands for a sum over them. Leakage is the probability of false alarms due to
the echo's signal far from its lines.
"""

GAUSS_POINTS_MAX = 200
"""Maximum number of Gauss points of the integral over bins on one side of the lines."""

AT_BIN, HALF_BIN_BEYOND = np.bool_(False), np.bool_(True)
"""Arguments of :func:`_bin_cotangent`: distance of a whole number of bins, or half a bin more. They
are NumPy booleans, because numba would compile the function anew for Python's."""

OCTAVE_STEP_LEAKAGE_MAX = 0.5
"""Leakage in the brightest speckle up to which a mean over speckle uses one speckle power per
octave. Leakage is the probability of false alarms due to the echo's signal far from its lines."""
LEAKAGE_RATE_MIN = 1e-30
"""Lower limit of the bins' summed rate of false alarms due to leaked signal. Smaller sums count as
this value. The probability of at least one false alarm is 1 - exp(-sum)."""
LEAKAGE_RATE_MAX = 34.5
"""Upper limit of the bins' summed rate of false alarms due to leaked signal. Larger sums count as
this value, at which the probability of at least one false alarm, 1 - exp(-sum), is 1."""

_N_SPECKLE_INTEGRATION_STEPS = 160
_RELATIVE_ROOT_SPECKLE_POWERS = (
    np.arange(1, _N_SPECKLE_INTEGRATION_STEPS + 1) / _N_SPECKLE_INTEGRATION_STEPS
)
_SPECKLE_POWER_NODES = np.concatenate([[0.0], SPECKLE_POWER_MAX * _RELATIVE_ROOT_SPECKLE_POWERS**2])
"""Speckle powers, over their mean, at which a mean over speckle is evaluated. Small powers are
closer together."""
_SPECKLE_OCTAVES_BELOW_MAX = -2 * np.log2(_RELATIVE_ROOT_SPECKLE_POWERS)
"""Distance of each speckle power, except 0, below SPECKLE_POWER_MAX [octaves]."""
_SPECKLE_POWER_WEIGHTS = (
    np.exp(-_SPECKLE_POWER_NODES[1:])
    * 0.5
    * np.append(
        _SPECKLE_POWER_NODES[2:] - _SPECKLE_POWER_NODES[:-2], np.diff(_SPECKLE_POWER_NODES[-2:])
    )
)
"""Weight of each speckle power u, except 0, in a mean over speckle: the density e^-u times the
trapezoidal interval of u."""

_END_CORRECTION_FACTORS = 1.0 / 24.0, -17.0 / 5760.0, 367.0 / 967680.0
"""Factors of the integrand's first, third and fifth difference in the Euler-Maclaurin correction of
the end of an integral over bins that is near the lines."""

_GAUSS_ORDER_MAX = 12
_GAUSS_NODES = np.zeros((_GAUSS_ORDER_MAX + 1, _GAUSS_ORDER_MAX))
_GAUSS_WEIGHTS = np.zeros((_GAUSS_ORDER_MAX + 1, _GAUSS_ORDER_MAX))
for _n in range(1, _GAUSS_ORDER_MAX + 1):
    _GAUSS_NODES[_n, :_n], _GAUSS_WEIGHTS[_n, :_n] = np.polynomial.legendre.leggauss(_n)


class LeakageInputs(NamedTuple):
    """Noise, threshold and tolerance for computing leakage."""

    noise_sigma: float
    """Noise standard deviation per quadrature in a bin [V, summed over the record]."""
    threshold: float
    """Detection threshold on a bin's magnitude [V, summed over the record]."""
    tolerance: float
    """Leakage that may be neglected [probability of at least one false alarm]."""
    sidelobe_neighbour_noise_correlation: float
    """Correlation coefficient of the noise of adjacent bins, in phase with a line's sidelobes."""


class FalsePeakProbability(NamedTuple):
    """Probabilities that leaked signal raises bins of a segment above the threshold."""

    leakage_probability: float
    """Probability of at least one false peak apart from the echo. In developed speckle it is the
    mean over the speckle."""
    raised_bin_probability_max: float
    """Upper bound on the probability that leaked signal raises any bin above the threshold,
    including bins that join the echo. It is 1 if bins are counted in developed speckle."""


class LeakageResult(NamedTuple):
    """Leakage of the computed bins around the lines and of all bins beyond them.

    The result is valid only if enough bins around the lines are computed.
    """

    leakage_probability: float
    """Probability that the echo's signal far from its lines raises at least one false alarm."""
    raised_bin_probability_max: float
    """Upper bound on the probability that leaked signal raises any bin above the threshold,
    including bins that join the echo."""
    is_valid: bool
    """True if enough bins around the lines are computed for a valid ``leakage_probability``."""


class EnvelopeTail(NamedTuple):
    """Bounds on a line's spectrum in bins a given distance or more away, for the amplitude 1."""

    magnitude: float
    """Largest magnitude of the line's spectrum at the given distance or farther."""
    square_sum: float
    """Upper bound of the sum of squared magnitudes, over bins at the given distance or farther on
    one side of the line."""


class NearEndCorrection(NamedTuple):
    """Correction of a sum over bins that is computed as an integral (Euler-Maclaurin).

    The correction applies at the integral's end near the lines, on one side of them.
    """

    correction: float
    """Correction added to the sum of the bins' false-alarm rates."""
    last_term: float
    """Size of the last term of ``correction``, an estimate of its error."""
    steepness: float
    """-d ln f / dq of a bin's false-alarm rate f over the distance q [1/bin], at the near end."""
    exists: bool
    """False if bins of the echo are too close to the near end to compute the correction."""


@njit(cache=True, error_model="numpy", borrows=True, inline="always")
def detect_with_leakage(
    bundle,
    negligible_magnitude,
    inputs,
    speckle_power_max,
    lobe_half_width,
    shape,
    layout,
    bin_tangents,
    workspace,
    crossing_series,
    speckle_rates,
):
    """Compute the bins around a segment's lines, the detection, and the leakage of all bins.

    Leakage is the probability of false alarms due to the echo's signal far from its lines.

    Parameters
    ----------
    bundle : LineBundle
        Number, range and total weight of the lines, which are in ``workspace.line_spectrum.lines``
        (:class:`sweep.model.spectrum.bin_spectrum.LineBundle`).
    negligible_magnitude : float
        Largest |X| of images that may be left out [V, summed over the record].
    inputs : LeakageInputs
        Noise, threshold and tolerated leakage.
    speckle_power_max : float
        SPECKLE_POWER_MAX if the echo is in developed speckle, else 1.
    lobe_half_width : int
        Half-width of the echo's main lobe or pedestal [bins]. Bins within this distance of a strong
        bin belong to the echo (:func:`sweep.model.detection.echo_detection.mark_exempt_bins`). 0 if
        only the strongest bin may detect the echo.
    shape : LineShape
        Shape of the lines (:class:`sweep.model.spectrum.line_shape.LineShape`).
    layout : SpectrumLayout
        Sizes of spectrum and tables (:class:`sweep.model.spectrum.lines.SpectrumLayout`).
    bin_tangents : ndarray (N/2 + 1,)
        tan(pi k / N) of bins k = 0 .. N/2, with the FFT size N.
    workspace : SpectrumWorkspace
        Lines, and scratch arrays (:class:`sweep.model.spectrum.bin_spectrum.SpectrumWorkspace`).
        Results are ``span.magnitude``, |X| [V] of the computed bins without noise, and
        ``span.is_exempt``, true in bins of the echo.
    crossing_series : ndarray
        :func:`sweep.model.detection.added_crossings.fill_crossing_series` of the threshold over
        sigma, the noise of a bin per quadrature.
    speckle_rates : SpeckleCrossingRates
        Crossing rates at the same threshold, used in developed speckle
        (:class:`sweep.model.detection.speckle_crossing_rates.SpeckleCrossingRates`).

    Returns
    -------
    DetectedSpan
        First bin, number of bins, strongest bin, number of the echo's bins, and leakage. In
        developed speckle the leakage is the mean over the speckle.
    """
    span, weight_sum, envelope = workspace.span, bundle.weight_sum, shape.envelope
    # Bounds are those of the brightest speckle.
    inverse_root = 1.0 / math.sqrt(speckle_power_max)
    brightest_inputs = LeakageInputs(
        inputs.noise_sigma * inverse_root,
        inputs.threshold * inverse_root,
        inputs.tolerance,
        inputs.sidelobe_neighbour_noise_correlation,
    )
    nyquist_bin, clearance, far_weight = layout.fft_size // 2, layout.clearance_bins, weight_sum
    if lobe_half_width > clearance // 2:  # an echo whose pedestal reaches far
        clearance += lobe_half_width
    folded_range = folded_line_range(
        bundle.origin_bin, bundle.lowest_position, bundle.highest_position, layout
    )
    image_distance = (
        max(min(folded_range.lowest_position, nyquist_bin - folded_range.highest_position), 0.0)
        if layout.spectrum_type == REAL_WITH_IMAGES
        else math.inf
    )
    distance_min = crossing_distance = max(
        falloff_distance_with_images(
            brightest_inputs.threshold, weight_sum, folded_range, envelope, layout
        ),
        float(clearance),
    )
    tolerance_left = inputs.tolerance - _far_leakage_probability_bound(
        far_weight, distance_min, image_distance, brightest_inputs, envelope
    )
    if tolerance_left < 0.0 or crossing_distance > clearance:
        n_sources = compute_end_amplitudes_and_far_lines(
            bundle, float(clearance), FAR_LINE_LOG_ACCURACY, layout, workspace.line_spectrum
        )
        far_weight = far_line_weight(
            weight_sum, n_sources, layout, workspace.line_spectrum.far_equivalent_lines
        )
        crossing_distance = max(
            falloff_distance_with_images(
                brightest_inputs.threshold, far_weight, folded_range, envelope, layout
            ),
            float(clearance),
        )
        distance_min = min(crossing_distance, float(clearance + nyquist_bin))
        tolerance_left = inputs.tolerance - _far_leakage_probability_bound(
            far_weight, distance_min, image_distance, brightest_inputs, envelope
        )
        while (
            tolerance_left < 0.0 and distance_min < layout.table_half_width_bins
        ):  # bins of the table take less time than an integral
            distance_min = min(1.25 * distance_min, float(layout.table_half_width_bins))
            tolerance_left = inputs.tolerance - _far_leakage_probability_bound(
                far_weight, distance_min, image_distance, brightest_inputs, envelope
            )
    # Wide enough if the integral may be left out, else a first guess.
    is_integral_negligible = tolerance_left >= 0.0
    near_bins = bins_around_lines(
        distance_min if is_integral_negligible else float(clearance), folded_range, layout
    )
    extra_bins = INTEGER_ZERO
    if not is_integral_negligible:
        extra_bins = _n_extra_bins_min(
            far_weight,
            bundle.highest_position - bundle.lowest_position,
            brightest_inputs,
            crossing_distance,
            envelope,
            layout,
        )
    negligible_ratio = negligible_magnitude / max(weight_sum, 1e-300)
    no_shifts = AveragingShifts(span.magnitude[:0], span.magnitude[:0])
    while True:
        first_bin, last_bin = near_bins.first_bin, near_bins.last_bin
        if not is_integral_negligible:
            first_bin, last_bin = first_bin - extra_bins, last_bin + extra_bins
            end_bins = extra_bins + INTEGRAL_END_CORRECTION_BINS
            first_bin = INTEGER_ZERO if first_bin <= end_bins else first_bin
            last_bin = nyquist_bin if nyquist_bin - last_bin <= end_bins else last_bin
        n_bins = last_bin - first_bin + 1
        compute_magnitudes(
            first_bin,
            n_bins,
            bundle,
            negligible_ratio,
            no_shifts,
            shape,
            layout,
            bin_tangents,
            workspace,
        )
        peak_index, n_exempt = mark_exempt_bins(
            span.magnitude, n_bins, inputs.threshold, span.is_exempt, lobe_half_width
        )
        if is_integral_negligible:
            leakage, raised_bin_probability_max = 0.0, inputs.tolerance
            if not (
                tolerance_left > 0.0
                and _leakage_bound_of_span(n_bins, brightest_inputs, span) <= tolerance_left
            ):
                probability = _leakage_of_span(
                    n_bins, inputs, speckle_power_max, span, crossing_series, speckle_rates
                )
                leakage = probability.leakage_probability
                raised_bin_probability_max += (
                    1.0 - inputs.tolerance
                ) * probability.raised_bin_probability_max
            return DetectedSpan(
                first_bin, n_bins, peak_index, n_exempt, leakage, raised_bin_probability_max
            )
        result = _leakage_of_all_bins(
            DetectedSpan(first_bin, n_bins, peak_index, n_exempt, 0.0, 1.0),
            bundle,
            folded_range,
            inputs,
            speckle_power_max,
            shape,
            layout,
            bin_tangents,
            workspace,
            crossing_series,
            speckle_rates,
        )
        if result.is_valid:
            return DetectedSpan(
                first_bin,
                n_bins,
                peak_index,
                n_exempt,
                result.leakage_probability,
                result.raised_bin_probability_max,
            )
        extra_bins *= 2


@njit(cache=True, error_model="numpy", borrows=True)
def _leakage_of_span(n_bins, inputs, speckle_power_max, span, crossing_series, speckle_rates):
    """Return the :class:`FalsePeakProbability` of leaked signal in the computed bins.

    The computed bins are those of a span around the lines.

    Parameters
    ----------
    n_bins : int
        Number of computed bins.
    inputs : LeakageInputs
        Noise and threshold.
    speckle_power_max : float
        The mean over developed speckle is taken if it is above 1.
    span : SpanArrays
        Magnitudes of the computed bins [V], and which of them belong to the echo.
    crossing_series : ndarray
        :func:`sweep.model.detection.added_crossings.fill_crossing_series` of the threshold over
        sigma, the noise of a bin per quadrature.
    speckle_rates : SpeckleCrossingRates
        Crossing rates at the same threshold, used in developed speckle.
    """
    if speckle_power_max > 1.0:
        return FalsePeakProbability(
            _false_peak_probability_averaged_over_speckle(n_bins, inputs, span, speckle_rates), 1.0
        )
    return _false_peak_probability(n_bins, inputs, span, crossing_series)


@njit(cache=True, error_model="numpy", borrows=True)
def false_peak_probability_of_bins(n_bins, inputs, negligible_signal_ratio, span, crossing_series):
    """Return the :class:`FalsePeakProbability` of leaked signal in the bins of a span.

    A span is the computed bins around a segment's lines. Magnitudes below
    ``negligible_signal_ratio`` times the noise sigma are set to 0, except those of the echo.

    Parameters
    ----------
    n_bins
        Number of bins of the span.
    inputs
        :class:`LeakageInputs`; the tolerance is not used.
    negligible_signal_ratio
        |X| over sigma below which a bin counts as noise alone.
    span
        :class:`sweep.model.spectrum.bin_spectrum.SpanArrays`.
    crossing_series
        :func:`sweep.model.detection.added_crossings.fill_crossing_series` of the threshold over
        sigma.
    """
    _clear_negligible_bins(n_bins, inputs.noise_sigma, negligible_signal_ratio, span)
    return _false_peak_probability(n_bins, inputs, span, crossing_series)


@njit(cache=True, error_model="numpy", borrows=True)
def false_peak_probability_of_bins_in_speckle(
    n_bins, inputs, negligible_signal_ratio, span, speckle_rates
):
    """Return the mean leakage of :func:`false_peak_probability_of_bins` over developed speckle.

    Parameters
    ----------
    n_bins : int
        Number of bins of the span, the computed bins around the lines.
    inputs : LeakageInputs
        Noise and threshold; the tolerance is not used.
    negligible_signal_ratio : float
        |X| over sigma below which a bin counts as noise alone. sigma is the noise of a bin per
        quadrature.
    span : SpanArrays
        Magnitudes of the bins [V], of which negligible ones are set to 0.
    speckle_rates : SpeckleCrossingRates
        Crossing rates at the threshold over sigma, by speckle power.
    """
    _clear_negligible_bins(n_bins, inputs.noise_sigma, negligible_signal_ratio, span)
    return _false_peak_probability_averaged_over_speckle(n_bins, inputs, span, speckle_rates)


@njit(cache=True, error_model="numpy", borrows=True)
def _clear_negligible_bins(n_bins, noise_sigma, negligible_signal_ratio, span):
    """Set magnitudes below ``negligible_signal_ratio`` times ``noise_sigma`` to 0, in place.

    Magnitudes of the echo are kept.
    """
    for i in range(n_bins):
        if not span.is_exempt[i] and span.magnitude[i] < negligible_signal_ratio * noise_sigma:
            span.magnitude[i] = 0.0


@njit(cache=True, error_model="numpy", borrows=True)
def _false_peak_probability(n_bins, inputs, span, crossing_series):
    """Return the :class:`FalsePeakProbability` of leaked signal in the computed bins.

    A false peak is a group of adjacent bins above the threshold. The crossing probabilities of the
    bins go to ``span.crossing_probability``.
    """
    _fill_crossing_probabilities(n_bins, inputs, span, crossing_series)
    raised_bin_probability = any_crossing_probability(
        span.crossing_probability, INTEGER_ZERO, n_bins
    )
    exclude_crossings_joining_echo(
        span.crossing_probability,
        INTEGER_ZERO,
        n_bins,
        span.magnitude,
        span.is_exempt,
        inputs.noise_sigma,
        inputs.threshold,
        inputs.sidelobe_neighbour_noise_correlation,
    )
    return FalsePeakProbability(
        any_crossing_probability(span.crossing_probability, INTEGER_ZERO, n_bins),
        raised_bin_probability,
    )


@njit(cache=True, error_model="numpy")
def _false_peak_probability_averaged_over_speckle(n_bins, inputs, span, speckle_rates):
    """Return the probability of a false peak due to leaked signal, averaged over speckle.

    The bins are the computed ones around a segment's lines (a span).
    """
    return _mean_leakage_over_speckle(
        INTEGER_ZERO, n_bins, inputs, span, speckle_rates, np.zeros(N_SPECKLE_POWERS)
    )


@njit(cache=True, error_model="numpy")
def _mean_leakage_over_speckle(
    first_index, end_index, inputs, span, speckle_rates, relative_rates_of_far_bins
):
    """Return the probability of a false peak due to leaked signal, averaged over speckle.

    The bins are some of those of a span (the computed bins around the lines), and all bins beyond
    the span.

    Parameters
    ----------
    first_index, end_index
        First bin of the span that counts, and the bin after the last.
    inputs
        :class:`LeakageInputs`; the tolerance is not used.
    span
        :class:`sweep.model.spectrum.bin_spectrum.SpanArrays`.
    speckle_rates
        :class:`sweep.model.detection.speckle_crossing_rates.SpeckleCrossingRates` of the threshold
        over sigma.
    relative_rates_of_far_bins
        (N_SPECKLE_POWERS,): sum of the crossing rates of the bins beyond the span at each speckle
        power, over this power.
    """
    noise_sigma, threshold = inputs.noise_sigma, inputs.threshold
    n_listed_max = _mark_joining_bins(first_index, end_index, noise_sigma, span, speckle_rates)
    rate_sums, scale = np.zeros(N_SPECKLE_POWERS), 1.0 / (noise_sigma * noise_sigma)
    # Bins that may join an echo, the echo's bins next to them, and one for all that lie between.
    joining_rates, probabilities = (
        np.zeros((n_listed_max, N_SPECKLE_POWERS)),
        np.zeros(n_listed_max),
    )
    magnitudes, is_echo = np.zeros(n_listed_max), np.zeros(n_listed_max, np.bool_)
    n_listed, is_gap_listed = INTEGER_ZERO, True
    entry_weights = np.zeros(n_entry_weights(speckle_rates))
    for i in range(first_index, end_index):
        squared_ratio = span.magnitude[i] * span.magnitude[i] * scale
        if span.is_exempt[i]:
            if (i > first_index and not span.is_exempt[i - 1]) or (
                i + 1 < end_index and not span.is_exempt[i + 1]
            ):
                magnitudes[n_listed], is_echo[n_listed] = span.magnitude[i], True
                n_listed, is_gap_listed = n_listed + 1, False
        elif span.crossing_probability[i] > 0.0:  # marked by _mark_joining_bins
            add_rates_by_speckle_power(squared_ratio, 1.0, speckle_rates, joining_rates[n_listed])
            magnitudes[n_listed], n_listed, is_gap_listed = span.magnitude[i], n_listed + 1, False
        else:
            add_entry_weights_of_bin(squared_ratio, speckle_rates, entry_weights)
            if not is_gap_listed:
                n_listed, is_gap_listed = n_listed + 1, True
    add_rates_from_entry_weights(entry_weights, speckle_rates, rate_sums)
    rate_at_brightest = rate_sums[N_SPECKLE_POWERS - 1] + max(
        relative_rates_of_far_bins[N_SPECKLE_POWERS - 1], 0.0
    )
    for i in range(n_listed):
        rate_at_brightest += joining_rates[i, N_SPECKLE_POWERS - 1]
    rate_at_brightest *= SPECKLE_POWER_MAX
    if rate_at_brightest < 1e-12:
        return 0.0
    powers_per_octave = _n_speckle_powers_per_octave(rate_at_brightest)
    power_stride = POWERS_PER_OCTAVE_MAX // powers_per_octave
    log_rates = np.empty(powers_per_octave * N_SPECKLE_OCTAVES + 1)
    for k in range(log_rates.size):
        power_index = N_SPECKLE_POWERS - 1 - k * power_stride
        power = TABULATED_SPECKLE_POWERS[power_index]
        rate = power * (rate_sums[power_index] + max(relative_rates_of_far_bins[power_index], 0.0))
        if n_listed > 0:
            for i in range(n_listed):
                probabilities[i] = -math.expm1(-power * joining_rates[i, power_index])
            root_power = math.sqrt(power)
            exclude_crossings_joining_echo(
                probabilities,
                INTEGER_ZERO,
                n_listed,
                magnitudes,
                is_echo,
                noise_sigma / root_power,
                threshold / root_power,
                inputs.sidelobe_neighbour_noise_correlation,
            )
            for i in range(n_listed):
                rate += crossing_rate(probabilities[i])
        log_rates[k] = math.log(min(max(rate, LEAKAGE_RATE_MIN), LEAKAGE_RATE_MAX))
    return mean_leakage_from_log_rates(log_rates, powers_per_octave)


@njit(cache=True, error_model="numpy", borrows=True)
def _mark_joining_bins(first_index, end_index, noise_sigma, span, speckle_rates):
    """Set the crossing probability of bins that may join an echo to 1, and of all others to 0.

    A bin joins an echo if it crosses the threshold next to the echo.

    Parameters
    ----------
    first_index, end_index : int
        First bin of the span that counts, and the bin after the last.
    noise_sigma : float
        Noise standard deviation per quadrature in a bin [V, summed over the record].
    span : SpanArrays
        Magnitudes, and which bins belong to an echo
        (:class:`sweep.model.spectrum.bin_spectrum.SpanArrays`). The result is
        ``crossing_probability``, 1 in bins that may join an echo, else 0.
    speckle_rates : SpeckleCrossingRates
        Crossing rates at the threshold over sigma, by speckle power
        (:class:`sweep.model.detection.speckle_crossing_rates.SpeckleCrossingRates`).

    Returns
    -------
    int
        Upper bound of the number of bins to be listed one by one: marked bins, the echo's bins next
        to them, and one for each gap between them.
    """
    n_listed_max, gap_end = 0, first_index
    for i in range(first_index, end_index):
        span.crossing_probability[i] = 0.0
    while gap_end < end_index:
        gap_begin = gap_end
        while gap_end < end_index and not span.is_exempt[gap_end]:
            gap_end += 1
        if gap_end > gap_begin and gap_begin > first_index:
            n_listed_max += 2 + _mark_bins_that_may_all_cross(
                gap_begin, STEP_UP, gap_end - gap_begin, noise_sigma, span, speckle_rates
            )
        if gap_end > gap_begin and gap_end < end_index:
            n_listed_max += 2 + _mark_bins_that_may_all_cross(
                gap_end - 1, STEP_DOWN, gap_end - gap_begin, noise_sigma, span, speckle_rates
            )
        gap_end += 1
    return n_listed_max


@njit(cache=True, error_model="numpy", borrows=True)
def _mark_bins_that_may_all_cross(first_index, step, n_bins, noise_sigma, span, speckle_rates):
    """Mark consecutive bins as long as all of them may cross the threshold; return their number.

    The first bin is always marked. For each next bin, the probability that all bins from the second
    to this one cross is computed for the brightest speckle. Marking ends after the bin at which
    this probability falls to ALL_JOIN_PROBABILITY_MIN.

    Parameters
    ----------
    first_index : int
        Index of the first bin in the span, the one next to the echo.
    step : int
        1 to continue upwards, -1 downwards.
    n_bins : int
        Number of bins that may be marked.
    noise_sigma : float
        Noise standard deviation per quadrature in a bin [V, summed over the record].
    span : SpanArrays
        Magnitudes (:class:`sweep.model.spectrum.bin_spectrum.SpanArrays`). The result is
        ``crossing_probability``, set to 1 in marked bins.
    speckle_rates : SpeckleCrossingRates
        Crossing rates at the threshold over sigma
        (:class:`sweep.model.detection.speckle_crossing_rates.SpeckleCrossingRates`).

    Returns
    -------
    int
        Number of marked bins.
    """
    n_marked, p_all_cross = 0, 1.0
    while n_marked < n_bins and p_all_cross > ALL_JOIN_PROBABILITY_MIN:
        i = first_index + n_marked * step
        signal_ratio = span.magnitude[i] / noise_sigma
        if n_marked > 0:
            p_all_cross *= -math.expm1(
                -rate_at_brightest_speckle(signal_ratio * signal_ratio, speckle_rates)
            )
        span.crossing_probability[i] = 1.0
        n_marked += 1
    return n_marked


@njit(cache=True, error_model="numpy", borrows=True)
def _n_speckle_powers_per_octave(rate_at_brightest):
    """Return the number of speckle powers per octave at which leakage is computed.

    ``rate_at_brightest`` is the summed rate of false alarms in the brightest speckle. At a high
    rate the powers are closer together, because leakage may fall as the power rises: bins may join
    the echo in bright speckle.
    """
    return POWERS_PER_OCTAVE_MAX if -math.expm1(-rate_at_brightest) > OCTAVE_STEP_LEAKAGE_MAX else 1


@njit(cache=True, error_model="numpy", borrows=True)
def _harmonic_mean_slope(first, second):
    """Return the harmonic mean of two slopes, or 0 if their signs differ."""
    return 2.0 * first * second / (first + second) if first * second > 0.0 else 0.0


@njit(cache=True, error_model="numpy", borrows=True)
def mean_leakage_from_log_rates(log_rates, powers_per_octave):
    """Return the mean leakage over developed speckle, int_0^inf e^-u (1 - exp(-R(u))) du.

    Here u is the speckle's power relative to its mean, and R(u) the sum of the bins' false-alarm
    rates.

    Parameters
    ----------
    log_rates
        (powers,): ln R at powers u from SPECKLE_POWER_MAX downwards.
    powers_per_octave
        Number of these powers in a factor of 2.

    Notes
    -----
    R is taken as proportional to u below the smallest tabulated power. Powers above
    SPECKLE_POWER_MAX are left out.
    """
    last_index, mean, interval = log_rates.size - 1, 0.0, -1
    slope_at_start, slope_at_end, slope = 0.0, 0.0, 0.0
    for i in range(_N_SPECKLE_INTEGRATION_STEPS - 1, -1, -1):
        table_position = powers_per_octave * _SPECKLE_OCTAVES_BELOW_MAX[i]
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
        mean += _SPECKLE_POWER_WEIGHTS[i] * p_leakage
    return mean


@njit(cache=True, error_model="numpy", borrows=True)
def _far_leakage_probability_bound(weight_sum, distance_min, image_distance, inputs, envelope):
    """Return a bound on the probability of false alarms due to leaked signal far from the lines.

    The bins are ``distance_min`` or more bins away from the lines.

    Parameters
    ----------
    weight_sum
        Sum of the lines' amplitudes [V].
    distance_min
        Least distance from the lines [bins].
    image_distance
        Least distance of a bin from an image [bins]; inf if there are no images.
    inputs
        :class:`LeakageInputs`; the tolerance is not used.
    envelope
        :class:`sweep.model.spectrum.line_shape.LineEnvelope`.

    Returns
    -------
    bound
        Bound on the probability; inf if it does not hold (z > 2 y).

    Notes
    -----
    Let a be the signal in a bin and b the threshold, both in units of the noise sigma. With
    x = a^2/2, y = b^2/2 and z = a b, the bin adds at most

        x dQ_1/dx = x y e^{-y} g(z),    g(z) = I_1(z) / (z/2),

    where g(z) is at most e^{z^2/8}, and at most 2 e^z / sqrt(2 pi z^3). g rises with z, so the
    nearest bin has the largest value. All bins together add at most y e^{-y} times this value times
    the sum of x. Images are no nearer to a bin than the lines, nor than ``image_distance`` bins.
    """
    weight_ratio, b = weight_sum / inputs.noise_sigma, inputs.threshold / inputs.noise_sigma
    y = 0.5 * b * b
    far_bounds = _envelope_tail(distance_min, envelope)
    nearest_envelope, square_sum = far_bounds.magnitude, far_bounds.square_sum
    if image_distance < math.inf:
        image = _envelope_tail(max(distance_min, image_distance), envelope)
        image_square_sum = image.square_sum + (
            max(image_distance - distance_min, 0.0) * image.magnitude * image.magnitude
        )
        nearest_envelope += image.magnitude
        square_sum = (math.sqrt(square_sum) + math.sqrt(image_square_sum)) ** 2
    z = weight_ratio * nearest_envelope * b
    if z > 2.0 * y:
        return np.inf
    growth = z * z / 8.0
    if z > 1.0:
        growth = min(growth, z + math.log(2.0 / math.sqrt(2.0 * math.pi * z * z * z)))
    return weight_ratio * weight_ratio * square_sum * y * math.exp(growth - y) / -math.expm1(-y)


@njit(cache=True, error_model="numpy", borrows=True)
def _envelope_tail(distance_min, envelope):
    """Return bounds on a line's spectrum in bins ``distance_min`` or more [bins] away from it."""
    index = envelope_index(distance_min - 1.5, envelope)
    magnitude = envelope.magnitude[index]
    return EnvelopeTail(magnitude, magnitude * magnitude + envelope.square_integral[index])


@njit(cache=True, error_model="numpy", borrows=True)
def _leakage_bound_of_span(n_bins, inputs, span):
    """Return a bound on the leakage of computed bins; inf if a bin is too strong.

    Parameters
    ----------
    n_bins : int
        Number of computed bins.
    inputs : LeakageInputs
        Noise and threshold.
    span : SpanArrays
        Magnitudes of the computed bins [V], and which of them belong to the echo.

    Notes
    -----
    Leakage is the probability of false alarms due to the echo's signal. Let a be the signal and b
    the threshold over the noise sigma, x = a^2/2, y = b^2/2 and z = a b. Marcum's Q_1 is convex in
    x up to y - 2, because I_2(z) / I_1(z) >= z / (2 + sqrt(z^2 + 4)). Relative to the strongest bin
    each bin then adds at most the ratio of their powers. The strongest bin adds at most e^{-(b -
    a)^2 / 2}. The factor 1.2 allows for the probability that noise alone stays below the threshold,
    at least 1 - e^-2.
    """
    largest, square_sum = 0.0, 0.0
    for i in range(n_bins):
        magnitude = 0.0 if span.is_exempt[i] else span.magnitude[i]
        largest = max(largest, magnitude)
        square_sum += magnitude * magnitude
    if not largest > 0.0:
        return 0.0
    a, b = largest / inputs.noise_sigma, inputs.threshold / inputs.noise_sigma
    if a * a > b * b - 4.0:
        return np.inf
    return 1.2 * square_sum / (largest * largest) * math.exp(-0.5 * (b - a) * (b - a))


@njit(cache=True, error_model="numpy", borrows=True)
def _fill_crossing_probabilities(n_bins, inputs, span, crossing_series):
    """Compute the increase of each bin's crossing probability that signal causes over noise alone.

    Bins of the echo are left out. Bins above the threshold, which bright speckle may contain, are
    outside the range of the series and are computed by Marcum's function.

    Parameters
    ----------
    n_bins : int
        Number of computed bins.
    inputs : LeakageInputs
        Noise and threshold.
    span : SpanArrays
        Magnitudes of the computed bins [V], and which of them belong to the echo. The result is
        ``span.crossing_probability``; ``span.half_square`` is scratch.
    crossing_series : ndarray
        :func:`sweep.model.detection.added_crossings.fill_crossing_series` of the threshold over
        sigma, the noise of a bin per quadrature.
    """
    noise_sigma, threshold = inputs.noise_sigma, inputs.threshold
    threshold_ratio, scale = threshold / noise_sigma, 0.5 / (noise_sigma * noise_sigma)
    any_above = False
    for i in range(n_bins):
        is_above = span.magnitude[i] > threshold and not span.is_exempt[i]
        any_above |= is_above
        half_square = span.magnitude[i] * span.magnitude[i] * scale
        span.half_square[i] = 0.0 if span.is_exempt[i] or is_above else half_square
    fill_added_crossing_probabilities(
        span.half_square, n_bins, threshold_ratio, crossing_series, span.crossing_probability
    )
    if any_above:
        p_noise_stay = -math.expm1(-0.5 * threshold_ratio * threshold_ratio)
        for i in range(n_bins):
            if span.magnitude[i] > threshold and not span.is_exempt[i]:
                span.crossing_probability[i] = min(
                    marcum_q1_excess(span.magnitude[i] / noise_sigma, threshold_ratio)
                    / p_noise_stay,
                    1.0,
                )


@njit(cache=True, error_model="numpy", borrows=True)
def _n_extra_bins_min(weight_sum, line_extent, inputs, crossing_distance, envelope, layout):
    """Return the number of bins to compute one by one beyond the clearance from the lines.

    The leakage integral covers the bins beyond these. The number is a heuristic, and a multiple of
    8. :func:`detect_with_leakage` doubles it until :func:`_leakage_of_all_bins` is accurate.

    Parameters
    ----------
    weight_sum : float
        Sum of the magnitudes of the lines' weights as seen from far bins [V].
    line_extent : float
        Distance of the highest from the lowest line [bins]; 3/4 of it are computed.
    inputs : LeakageInputs
        Noise and threshold, of the brightest speckle.
    crossing_distance : float
        Distance from the lines up to which signal alone may cross the threshold [bins].
    envelope : LineEnvelope
        Upper envelope of a line's spectrum.
    layout : SpectrumLayout
        Sizes of the spectrum; it has the clearance from the lines [bins].
    """
    clearance = layout.clearance_bins
    edge_signal = envelope.magnitude[clearance] * weight_sum / inputs.noise_sigma
    smooth_distance = 4.0 + 1.5 * math.sqrt(
        edge_signal * clearance * inputs.threshold / inputs.noise_sigma
    )
    distance_min = max(crossing_distance, max(smooth_distance, 0.75 * line_extent)) - clearance
    return int(
        min(
            (max(math.ceil(distance_min), 0.0) + 2 * INTEGRAL_END_CORRECTION_BINS + 7) // 8 * 8,
            layout.fft_size // 2,
        )
    )


@njit(cache=True, error_model="numpy", borrows=True, inline="always")
def _leakage_of_all_bins(
    detected,
    bundle,
    folded_range,
    inputs,
    speckle_power_max,
    shape,
    layout,
    bin_tangents,
    workspace,
    crossing_series,
    speckle_rates,
):
    """Compute the leakage of the bins around the lines and of all other bins.

    Leakage is the probability of false alarms due to the echo's signal far from its lines. In
    developed speckle it is the mean over the speckle.

    Parameters
    ----------
    detected : DetectedSpan
        Computed bins around the lines, whose magnitudes are in ``workspace.span``.
    bundle : LineBundle
        Number, range and total weight of the lines, which are in ``workspace.line_spectrum.lines``.
    folded_range : FoldedLineRange
        Range of the lines after negative frequencies are folded at DC [bins].
    inputs : LeakageInputs
        Noise, threshold and tolerated leakage.
    speckle_power_max : float
        SPECKLE_POWER_MAX if the echo is in developed speckle, else 1.
    shape : LineShape
        Shape of the lines (:class:`sweep.model.spectrum.line_shape.LineShape`).
    layout : SpectrumLayout
        Sizes of spectrum and tables (:class:`sweep.model.spectrum.lines.SpectrumLayout`).
    bin_tangents : ndarray (N/2 + 1,)
        tan(pi k / N) of bins k = 0 .. N/2, with the FFT size N.
    workspace : SpectrumWorkspace
        Lines and magnitudes, and scratch arrays
        (:class:`sweep.model.spectrum.bin_spectrum.SpectrumWorkspace`).
    crossing_series : ndarray
        :func:`sweep.model.detection.added_crossings.fill_crossing_series` of the threshold over
        sigma, the noise of a bin per quadrature.
    speckle_rates : SpeckleCrossingRates
        Crossing rates at the same threshold, used in developed speckle.

    Returns
    -------
    LeakageResult
        Leakage, and whether enough bins around the lines are computed for it to be valid.
    """
    span, integral = workspace.span, workspace.leakage_quadrature
    first_bin, n_bins, peak_index = detected.first_bin, detected.n_bins, detected.peak_index
    noise_sigma, threshold = inputs.noise_sigma, inputs.threshold
    fft_size, nyquist_bin = layout.fft_size, layout.fft_size // 2
    threshold_ratio, scale = threshold / noise_sigma, 0.5 / (noise_sigma * noise_sigma)
    goes_on_below, goes_on_above = first_bin > 0, first_bin + n_bins - 1 < nyquist_bin
    if not goes_on_below and not goes_on_above:
        probability = _leakage_of_span(
            n_bins, inputs, speckle_power_max, span, crossing_series, speckle_rates
        )
        return LeakageResult(
            probability.leakage_probability, probability.raised_bin_probability_max, True
        )
    _fill_crossing_probabilities(n_bins, inputs, span, crossing_series)
    centre_bin = abs(
        math.floor(0.5 * (folded_range.lowest_position + folded_range.highest_position) + 0.5)
    )
    centre_bin = fft_size - centre_bin if centre_bin > nyquist_bin else centre_bin
    far_rate, last_terms, n_points = 0.0, 0.0, INTEGER_ZERO
    for side in (-1, 1):
        if not (goes_on_below if side < 0 else goes_on_above):
            continue
        near_end = _near_end_correction(side, n_bins, span)
        if not near_end.exists:
            return LeakageResult(0.0, 1.0, False)
        far_rate += near_end.correction
        last_terms += near_end.last_term
        end_distance = (
            centre_bin - first_bin - INTEGRAL_END_CORRECTION_BINS
            if side < 0
            else first_bin + n_bins - 1 - INTEGRAL_END_CORRECTION_BINS - centre_bin
        )
        n_points = _append_gauss_points(
            side,
            end_distance,
            centre_bin,
            near_end.steepness,
            layout,
            bin_tangents,
            integral.cotangent,
            integral.weight,
            n_points,
        )
    first_index, end_index = (
        INTEGRAL_END_CORRECTION_BINS if goes_on_below else INTEGER_ZERO,
        n_bins - INTEGRAL_END_CORRECTION_BINS if goes_on_above else n_bins,
    )
    raised_in_span = any_crossing_probability(span.crossing_probability, first_index, end_index)
    exclude_crossings_joining_echo(
        span.crossing_probability,
        first_index,
        end_index,
        span.magnitude,
        span.is_exempt,
        noise_sigma,
        threshold,
        inputs.sidelobe_neighbour_noise_correlation,
    )
    span_leakage = any_crossing_probability(span.crossing_probability, first_index, end_index)
    while n_points % 8:  # whole vectors: a remainder takes as long
        integral.cotangent[n_points] = integral.cotangent[n_points - 1]
        integral.weight[n_points] = 0.0
        n_points += 1
    bins_per_radian = fft_size / math.pi
    for i in range(n_points):
        cotangent = integral.cotangent[i]
        integral.weight[i] *= bins_per_radian / (1.0 + cotangent * cotangent)
        integral.cotangent[i] = 1.0 / cotangent
    log_accuracy = min(
        max(
            math.log(200.0 * threshold_ratio * threshold_ratio / max(inputs.tolerance, 1e-300)),
            4.0,
        ),
        FAR_LINE_LOG_ACCURACY,
    )
    _fill_squared_magnitudes_of_points(
        n_points, centre_bin, bundle, log_accuracy, shape, layout, bin_tangents, workspace
    )
    # The span's scratch arrays now serve the points of the integral.
    for i in range(n_points):
        integral.half_square[i] *= scale
        span.half_square[i] = integral.half_square[i]
    largest_far_half_square = largest_or_zero(integral.half_square[:n_points])
    fill_added_crossing_probabilities(
        span.half_square, n_points, threshold_ratio, crossing_series, span.crossing_probability
    )
    far_rate += weighted_crossing_rate_sum(
        span.crossing_probability[:n_points], integral.weight[:n_points]
    )
    half_square_max = min(
        0.45 * threshold_ratio * threshold_ratio,
        span.magnitude[peak_index] * span.magnitude[peak_index] * scale,
    )
    if not (
        largest_far_half_square <= half_square_max
        and last_terms <= LAST_END_CORRECTION_FRACTION_MAX * (span_leakage + far_rate)
    ):
        return LeakageResult(0.0, 1.0, False)
    if speckle_power_max > 1.0:
        return LeakageResult(
            _mean_leakage_of_all_bins(
                n_bins,
                n_points,
                inputs,
                goes_on_below,
                goes_on_above,
                span,
                integral,
                speckle_rates,
            ),
            1.0,
            True,
        )
    any_far_probability = -math.expm1(-far_rate)
    return LeakageResult(
        span_leakage + (1.0 - span_leakage) * any_far_probability,
        raised_in_span + (1.0 - raised_in_span) * any_far_probability,
        True,
    )


@njit(cache=True, error_model="numpy")
def _mean_leakage_of_all_bins(
    n_bins, n_points, inputs, goes_on_below, goes_on_above, span, integral, speckle_rates
):
    """Return the mean leakage over developed speckle of computed bins and of the integral's bins.

    The integral covers the bins beyond the computed ones, below them, above them, or both.

    Parameters
    ----------
    n_bins : int
        Number of computed bins.
    n_points : int
        Number of quadrature points of the integral.
    inputs : LeakageInputs
        Noise and threshold.
    goes_on_below, goes_on_above : bool
        True if the integral has bins below or above the computed ones.
    span : SpanArrays
        Magnitudes of the computed bins [V], and which of them belong to the echo.
    integral : LeakageQuadrature
        Points of the integral: their weights, and |X|^2 over twice the noise variance per
        quadrature.
    speckle_rates : SpeckleCrossingRates
        Crossing rates at the threshold over sigma, by speckle power.
    """
    relative_rates_of_far_bins = np.zeros(N_SPECKLE_POWERS)
    scale = 1.0 / (inputs.noise_sigma * inputs.noise_sigma)
    for side in (-1, 1):
        if not (goes_on_below if side < 0 else goes_on_above):
            continue
        last_near_index = (
            n_bins - INTEGRAL_END_CORRECTION_BINS - 1 if side > 0 else INTEGRAL_END_CORRECTION_BINS
        )  # the last bin before the integral
        for offset in range(-2, 4):
            magnitude = span.magnitude[last_near_index + side * offset]
            add_rates_by_speckle_power(
                magnitude * magnitude * scale,
                _end_correction_factor(offset),
                speckle_rates,
                relative_rates_of_far_bins,
            )
    for i in range(n_points):
        add_rates_by_speckle_power(
            2.0 * integral.half_square[i],
            integral.weight[i],
            speckle_rates,
            relative_rates_of_far_bins,
        )
    first_index, end_index = (
        INTEGRAL_END_CORRECTION_BINS if goes_on_below else INTEGER_ZERO,
        n_bins - INTEGRAL_END_CORRECTION_BINS if goes_on_above else n_bins,
    )
    return _mean_leakage_over_speckle(
        first_index, end_index, inputs, span, speckle_rates, relative_rates_of_far_bins
    )


@njit(cache=True, error_model="numpy", borrows=True)
def _end_correction_factor(offset):
    """Return the factor of a bin's false-alarm rate in the correction at the integral's near end.

    ``offset`` is the bin's distance from the last bin before the integral, -2 .. 3, positive
    towards the integral.
    """
    factor_1, factor_3, factor_5 = _END_CORRECTION_FACTORS
    factors = factor_1 - 3.0 * factor_3 + 10.0 * factor_5, factor_3 - 5.0 * factor_5, factor_5
    return factors[offset - 1] if offset > 0 else -factors[-offset]


@njit(cache=True, error_model="numpy", borrows=True, inline="always")
def _fill_squared_magnitudes_of_points(
    n_points, centre_bin, bundle, log_accuracy, shape, layout, bin_tangents, workspace
):
    """Compute the squared magnitude of the spectrum at the leakage integral's points.

    If there are fewer lines than equivalent lines needed, the lines are summed exactly.

    Parameters
    ----------
    n_points : int
        Number of points.
    centre_bin : int
        Bin in the middle of the lines, 0 .. N/2, from which the distance q [bins] of points counts.
    bundle : LineBundle
        Number, range and total weight of the lines, which are in ``workspace.line_spectrum.lines``.
    log_accuracy : float
        -ln of the relative error.
    shape : LineShape
        Shape of the lines (:class:`sweep.model.spectrum.line_shape.LineShape`).
    layout : SpectrumLayout
        Sizes of spectrum and tables (:class:`sweep.model.spectrum.lines.SpectrumLayout`).
    bin_tangents : ndarray (N/2 + 1,)
        tan(pi k / N) of bins k = 0 .. N/2, with the FFT size N.
    workspace : SpectrumWorkspace
        Lines and scratch arrays. ``leakage_quadrature.cotangent`` contains tan(pi q / N) of each
        point. The result is ``leakage_quadrature.half_square``, |X|^2 [V^2].
    """
    line_spectrum, integral = workspace.line_spectrum, workspace.leakage_quadrature
    far_bins = line_spectrum.far_bins
    is_mirror_image = is_mirrored(
        bundle.origin_bin, bundle.lowest_position, bundle.highest_position, layout.spectrum_type
    )
    line_direction = -1 if is_mirror_image else 1
    for image_pass in range(2 if layout.spectrum_type == REAL_WITH_IMAGES else 1):
        direction = line_direction if image_pass == 0 else -line_direction
        tangent_shift = tangent_of_bin(
            centre_bin - direction * bundle.origin_bin, layout.fft_size, bin_tangents
        )
        for i in range(n_points):
            tangent = integral.cotangent[i]
            far_bins.tangent[i] = (
                direction * (tangent + tangent_shift) / (1.0 - tangent * tangent_shift)
            )
            far_bins.phasor_re[i], far_bins.phasor_im[i] = 1.0, 0.0
            line_spectrum.re[i], line_spectrum.im[i] = 0.0, 0.0
        distance_min = float(layout.clearance_bins)
        if image_pass == 1:  # images are as far from DC and Nyquist as the lines
            edge_distance = min(centre_bin, layout.fft_size // 2 - centre_bin) - 0.5 * (
                bundle.highest_position - bundle.lowest_position
            )
            distance_min = max(distance_min, edge_distance - 2.0)
        n_sources = compute_end_amplitudes_and_far_lines(
            bundle, distance_min, log_accuracy, layout, line_spectrum
        )
        for source in range(n_sources):
            add_line_by_record_ends(
                INTEGER_ZERO,
                n_points,
                INTEGER_ZERO,
                line_spectrum.far_equivalent_lines,
                source,
                log_accuracy + FAR_LINE_EXTRA_LOG_ACCURACY,
                shape.end_polynomials,
                layout,
                line_spectrum,
            )
        for i in range(n_points):
            re, im = line_spectrum.re[i], direction * line_spectrum.im[i]
            integral.re[i] = re if image_pass == 0 else integral.re[i] + re
            integral.im[i] = im if image_pass == 0 else integral.im[i] + im
    for i in range(n_points):
        re, im = integral.re[i], integral.im[i]
        integral.half_square[i] = max(re, 0.0) if layout.adds_powers else re * re + im * im


@njit(cache=True, error_model="numpy", borrows=True)
def _near_end_correction(side, n_bins, span):
    """Compute the :class:`NearEndCorrection` of the leakage integral on one side of the lines.

    Parameters
    ----------
    side : int
        -1 for the integral below the computed bins, 1 for that above.
    n_bins : int
        Number of computed bins.
    span : SpanArrays
        Crossing probabilities of the computed bins, and which of them belong to the echo.

    Returns
    -------
    NearEndCorrection
        Correction of the sum of false-alarm rates, its error, and the integrand's steepness.
    """
    probabilities, is_exempt = span.crossing_probability, span.is_exempt
    step = 1 if side > 0 else -1
    i = (
        n_bins - INTEGRAL_END_CORRECTION_BINS - 1 if side > 0 else INTEGRAL_END_CORRECTION_BINS
    )  # the last bin before the integral
    for k in range(-2, 4):
        if is_exempt[i + k * step]:
            return NearEndCorrection(0.0, 0.0, 0.0, False)
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
    term_1, term_3, term_5 = (
        difference_1 / 24.0,
        -17.0 / 5760.0 * difference_3,
        367.0 / 967680.0 * difference_5,
    )
    last_term = max(abs(term_5), abs(term_3) / 30.0)  # the fifth may cross zero
    steepness = abs(difference_1) / max(rate_after, 1e-300)
    return NearEndCorrection(term_1 + term_3 + term_5, last_term, steepness, True)


@njit(cache=True, error_model="numpy", borrows=True)
def _append_gauss_points(
    side, last_distance, centre_bin, steepness, layout, bin_tangents, cotangents, weights, n_points
):
    """Append the quadrature points of the leakage integral on one side of the lines.

    The integral is over bins far from the lines. The result is the number of points with those
    appended.

    Parameters
    ----------
    side
        -1 below the lines, 1 above.
    last_distance
        Distance [bins] from ``centre_bin`` to the last bin before the integral. The integral begins
        half a bin beyond this distance.
    centre_bin
        Bin in the middle of the lines, 0 .. N/2.
    steepness
        -d ln f / dq of the integrand at the near end [1/bin].
    layout
        :class:`sweep.model.spectrum.lines.SpectrumLayout`.
    bin_tangents
        tan(pi k / N) of bins k = 0 .. N/2, with the FFT size N.
    cotangents, weights
        Results: cot(pi q / N) at the distance q from ``centre_bin``, and weights of an integral
        over the cotangent.
    n_points
        Number of points that these arrays hold already.

    Notes
    -----
    With images the spectrum is even about DC and Nyquist. Without images the spectrum continues
    beyond DC and Nyquist: the integral extends half a bin beyond the last bin, and is corrected by
    the first difference.
    """
    fft_size, nyquist_bin = layout.fft_size, layout.fft_size // 2
    far_bin = 0 if side < 0 else nyquist_bin
    ends_half_bin_beyond = side > 0 and 2 * nyquist_bin != fft_size
    far_distance = abs(far_bin - centre_bin)
    goes_on = layout.spectrum_type != REAL_WITH_IMAGES and far_distance < nyquist_bin
    ends_half_bin_beyond = ends_half_bin_beyond or goes_on
    far_cotangent = max(
        _bin_cotangent(far_distance, ends_half_bin_beyond, fft_size, bin_tangents), 1e-9
    )
    near_cotangent = _bin_cotangent(last_distance, HALF_BIN_BEYOND, fft_size, bin_tangents)
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
            cotangents[n_points] = side * (middle + half_width * _GAUSS_NODES[n_panel_points, i])
            weights[n_points] = half_width * _GAUSS_WEIGHTS[n_panel_points, i]
            n_points += 1
        panel_start = panel_end
    bin_angle = math.pi / fft_size
    if goes_on:
        for k in range(2):
            cotangent = _bin_cotangent(far_distance + k, AT_BIN, fft_size, bin_tangents)
            cotangents[n_points] = side * cotangent
            weights[n_points] = (1.0 - 2.0 * k) / 24.0 * bin_angle * (1.0 + cotangent * cotangent)
            n_points += 1
    elif not ends_half_bin_beyond:  # the far end is a bin: half of it lies beyond the integral
        cotangents[n_points] = side * far_cotangent
        weights[n_points] = 0.5 * bin_angle * (1.0 + far_cotangent * far_cotangent)
        n_points += 1
    return n_points


@njit(cache=True, error_model="numpy", borrows=True)
def _bin_cotangent(distance, half_bin_beyond, fft_size, bin_tangents):
    """Return cot(pi q / N) at the distance q [bins], with the FFT size N and 0 < q <= N/2.

    q is ``distance``, or ``distance`` + 1/2 if ``half_bin_beyond``. ``bin_tangents`` holds
    tan(pi k / N) of bins k = 0 .. N/2.
    """
    tangent_at_bin = bin_tangents[distance]
    if not half_bin_beyond:
        return 1.0 / tangent_at_bin
    half_bin_tangent = 0.5 * math.pi / fft_size
    half_bin_tangent *= 1.0 + half_bin_tangent * half_bin_tangent / 3.0
    return (1.0 - tangent_at_bin * half_bin_tangent) / (tangent_at_bin + half_bin_tangent)


@njit(cache=True, error_model="numpy", borrows=True)
def _gauss_order(near_steepness, relative_cotangent):
    """Return the number of Gauss points for one section of the leakage integral.

    ``near_steepness`` is -d ln f / d ln q of the integrand f over the distance q, at the near end.
    ``relative_cotangent`` is the cotangent at the section's start, relative to that at the near
    end.
    """
    order = 4 + int(0.6 * near_steepness * relative_cotangent)
    if relative_cotangent > 0.9:
        order += 5
    elif relative_cotangent > 0.06:
        order += 4
    elif relative_cotangent > 0.008:
        order += 2
    return min(order, _GAUSS_ORDER_MAX)
