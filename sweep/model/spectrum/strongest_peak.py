"""Probabilities that the strongest peak of a segment is that of the echo, or another one.

A peak elsewhere that is larger than the echo's takes its place: it is reported as a detection with
a wrong range. Let Z be the largest |X| of the searched bins that the echo does not occupy, and b
the threshold. Let P_z be the probability that the echo crosses a level z, by the same law as at b.
Then

    P(right) = P_b - L,    P(wrong) = P(Z >= b) (1 - P_b) + L,
    L = int_b^inf (P_b - P_z) dP(Z < z),    P(none) = P(Z < b) (1 - P_b)

and these three add to 1. All terms are positive, so that small ones keep their digits. P(Z < z) is
the probability that no bin crosses z: neither one of noise, of which n independent ones are
equivalent to all bins at each level (:mod:`sweep.model.detection.bin_noise`), nor one of leaked
signal. With y = z^2 / (2 sigma^2), -ln P(Z < z) is very nearly proportional to e^-y. The integral
over y is computed by Gauss's rule in intervals, and its total weight is made exact.

Noise is independent from segment to segment, and so are right peaks of a steady echo. If segments
share their speckle, the probability that both peaks are right is that of two correlated Rayleigh
magnitudes which cross their own levels, max(b, Z), averaged over both Z. An echo of many bins
counts at each level as the one bin that crosses it with the same probability. Drawn records agree
within 0.01 at any threshold.

A shot is wrong if both chirps report a peak, and not both peaks are the echo's.
"""

import math
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection import bin_noise
from sweep.model.detection.detection_probability import (
    StrongestPeakProbabilities,
    joint_detection_probability,
    pd_decrease_with_threshold,
    segment_strongest_peak_probabilities,
    shot_strongest_peak_probabilities,
)
from sweep.model.detection.echo_detection import (
    BinThreshold,
    EchoBins,
    PdAndMiss,
    bin_speckle_of_point,
    bin_threshold_of_point,
    pd_and_miss,
)
from sweep.model.detection.marcum import marcum_q1_tails
from sweep.model.preparation import Shots
from sweep.model.spectrum.search_restriction import span_leakage_probability
from sweep.model.spectrum.segment_spectra import BinSpans, iter_spans

GAUSS_ORDER = 4
"""Number of Gauss quadrature points in each interval of QUADRATURE_INTERVAL_EDGES."""
QUADRATURE_INTERVAL_EDGES = np.array([0, 1, 2, 3, 4, 5, 6, 7.5, 9.5, 12, 15, 19, 24, 30, 37.0])
"""Edges of the quadrature intervals of u = z^2 / (2 sigma^2), less the lower limit of u. z is the
magnitude, and sigma the noise per quadrature. The lower limit is the larger of the threshold's u
and ln n - 4. The u of the largest of n bins of noise is almost certainly above ln n - 4."""
UP, DOPPLER, DOWN = range(3)
"""Indices of the segments in arrays by segment."""
THRESHOLD_LEVEL_INDEX = 0
"""Index of the detection threshold among the magnitude levels of a segment."""

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(GAUSS_ORDER)
_DERIVATIVE_MATRIX = np.array(
    [
        np.polynomial.Polynomial.fit(_GAUSS_NODES, row, GAUSS_ORDER - 1).deriv()(_GAUSS_NODES)
        for row in np.eye(GAUSS_ORDER)
    ]
).T
"""Matrix from values at the Gauss points to the derivatives of their interpolating polynomial at
the same points."""


class OtherPeakProbabilities(NamedTuple):
    """Probabilities that another peak is larger than the echo's, at m points."""

    pd_loss: np.ndarray
    """(segments, m): probability that the echo crosses the threshold but another peak is larger."""
    p_alarm: np.ndarray
    """(segments, m): probability that any bin outside the echo crosses the threshold."""
    shared_speckle_gain: np.ndarray
    """(m,): increase, due to shared speckle, of the probability that both chirps report the echo's
    peak. It is for cases in which bins outside the echo cross the threshold too."""


class LevelProbabilities(NamedTuple):
    """Probabilities at the magnitude levels that an echo may have to exceed in one segment.

    Arrays are (m, levels), the threshold first. To be reported, the echo has to exceed the
    threshold and the largest bin outside the echo.
    """

    level_probability: np.ndarray
    """Probability that the echo has to exceed this level."""
    exceedance_exponent: np.ndarray
    """-ln of the probability that the echo exceeds this level."""
    echo_power_fraction: np.ndarray
    """Echo power over the mean power of echo and noise, in an equivalent bin. The equivalent bin is
    a single bin that exceeds this level as often as the echo with all its bins."""


class StrongestPeakResults(NamedTuple):
    """Probabilities of the segments and of the shot if only the strongest peak is reported."""

    segments: StrongestPeakProbabilities
    """(3, n): probabilities of each segment: up, Doppler, down."""
    shot: StrongestPeakProbabilities
    """(n,): probabilities of the shot."""


def strongest_peak_probabilities(
    shots: Shots,
    pd: np.ndarray,
    miss: np.ndarray,
    magnitude: np.ndarray,
    is_range_misread: np.ndarray,
) -> StrongestPeakResults:
    """Compute detection and wrong-range probabilities if only the strongest peak is reported.

    Parameters
    ----------
    shots : Shots
        n prepared shots.
    pd, miss : ndarray (3, n)
        Probabilities, by segment, that any peak of the echo is detected, or not.
    magnitude : ndarray (3, n)
        |X| of the strongest bin [V, summed over the record].
    is_range_misread : ndarray (n,) bool
        True where the peaks of the echo itself are resolved to a wrong range.

    Returns
    -------
    StrongestPeakResults
        Probabilities by segment, and of the shot.
    """
    pd_loss, p_alarm, shared_speckle_gain = (
        np.zeros((3, shots.size)),
        np.zeros((3, shots.size)),
        np.zeros(shots.size),
    )
    for spans in iter_spans(shots, bin_by_bin=True, computes_pd=False):
        probabilities = _other_peak_probabilities(shots, spans, pd)
        pd_loss[:, spans.point_numbers] = probabilities.pd_loss
        p_alarm[:, spans.point_numbers] = probabilities.p_alarm
        shared_speckle_gain[spans.point_numbers] = probabilities.shared_speckle_gain
    segments = segment_strongest_peak_probabilities(pd, miss, pd_loss, p_alarm)
    speckle_covariance = None
    if shots.speckle.segment_correlations is not None:
        speckle_covariance = (
            joint_detection_probability(shots, pd[UP], pd[DOWN], (magnitude[UP], magnitude[DOWN]))
            - pd[UP] * pd[DOWN]
        )
    return StrongestPeakResults(
        segments,
        shot_strongest_peak_probabilities(
            segments,
            p_alarm,
            shared_speckle_gain=shared_speckle_gain,
            speckle_covariance=speckle_covariance,
            is_range_misread=is_range_misread,
        ),
    )


def _other_peak_probabilities(
    shots: Shots, spans: BinSpans, pd: np.ndarray
) -> OtherPeakProbabilities:
    """Compute the :class:`OtherPeakProbabilities` of the points of some spans.

    A span is a set of adjacent bins around a segment's lines. ``pd`` (3, n) is the probability that
    the echo is detected, of all n shots by segment.
    """
    points = spans.point_numbers
    deviation, noise_sigma, threshold, negligible_signal_ratio = (
        np.broadcast_to(value, shots.size)[points]
        for value in (
            shots.line_noise_sigma,
            shots.bin_noise_sigma,
            shots.threshold,
            shots.negligible_signal_ratio,
        )
    )
    half_squares = _level_half_squares(shots, spans, threshold / noise_sigma)
    levels, exponents = (
        np.sqrt(2 * half_squares) * noise_sigma[:, None],
        _noise_exponents(shots, spans, half_squares),
    )
    pd_loss = np.zeros(levels.shape)
    _evaluate_levels(
        spans,
        levels,
        shots.bin_thresholds.select(points),
        negligible_signal_ratio,
        shots.detection_rule,
        shots.detection_settings.leakage_raises_false_alarms,
        shots.speckle_table,
        pd_loss,
        exponents,
    )
    p_alarm = -np.expm1(-exponents[..., 0])
    weight = _level_weights(exponents[..., 1:], p_alarm)
    segment_exists, joint_excess = shots.has_segment[:, None], np.zeros(points.size)
    if shots.speckle.segment_correlations is not None:
        squared_correlation = np.broadcast_to(
            np.abs(shots.speckle.segment_correlations.up_down) ** 2, shots.size
        )[points]
        with np.errstate(divide="ignore"):
            level_exponents = np.minimum(
                -np.log(np.maximum(pd[:, points, None] - pd_loss, 0.0)), 700.0
            )
        echo_fractions = np.maximum(
            1 - level_exponents / (0.5 * np.square(levels / deviation[:, None])), 0.0
        )
        level_probabilities = np.concatenate([1 - p_alarm[..., None], weight], axis=-1)
        up, down = (
            LevelProbabilities(level_probabilities[s], level_exponents[s], echo_fractions[s])
            for s in (UP, DOWN)
        )
        _fill_joint_probability_increase(up, down, squared_correlation, joint_excess)
    total_loss = (weight * pd_loss[..., 1:]).sum(axis=-1)
    return OtherPeakProbabilities(
        np.where(segment_exists, total_loss, np.nan),
        np.where(segment_exists, p_alarm, np.nan),
        joint_excess,
    )


def _level_half_squares(shots: Shots, spans: BinSpans, threshold_ratio: np.ndarray) -> np.ndarray:
    """Return z^2 / (2 sigma^2) of all magnitude levels z, (3, m, levels), the threshold first.

    sigma is the noise per quadrature. ``threshold_ratio`` (m,) is the threshold over sigma.
    """
    threshold_half_square = 0.5 * np.square(threshold_ratio)
    n_bins = shots.n_searched_bins(spans.n_exempt, spans.point_numbers)
    first_half_square = np.maximum(threshold_half_square, np.log(np.maximum(n_bins, 1.0)) - 4)
    inner = (
        QUADRATURE_INTERVAL_EDGES[:-1, None]
        + np.diff(QUADRATURE_INTERVAL_EDGES)[:, None] * 0.5 * (_GAUSS_NODES + 1)
    ).ravel()
    first = np.broadcast_to(threshold_half_square, first_half_square.shape)[..., None]
    return np.concatenate([first, first_half_square[..., None] + inner], axis=-1)


def _noise_exponents(shots: Shots, spans: BinSpans, half_squares: np.ndarray) -> np.ndarray:
    """Return -ln of the probability that no bin of noise exceeds a magnitude level z.

    ``half_squares`` (3, m, levels) is z^2 / (2 sigma^2), with the noise sigma. The result has the
    same shape.
    """
    n_bins = shots.n_searched_bins(spans.n_exempt, spans.point_numbers)[..., None]
    if shots.detection_settings.noise_bin_model == "correlated":
        n_bins = bin_noise.n_alarm_equivalent_bins(
            n_bins,
            threshold_ratio=np.sqrt(2 * half_squares),
            correlation=shots.noise_bin_correlation,
        )
    with np.errstate(divide="ignore", under="ignore"):
        exponent_per_bin = np.where(
            half_squares > 0.7, -np.log1p(-np.exp(-half_squares)), -np.log(-np.expm1(-half_squares))
        )
    return np.array(n_bins * exponent_per_bin)


def _level_weights(exponents: np.ndarray, p_alarm: np.ndarray) -> np.ndarray:
    """Return the probability that the largest bin outside the echo is at each Gauss point's level.

    ``exponents`` (3, m, points) is -ln of the probability that no bin outside the echo exceeds the
    Gauss point's level. ``p_alarm`` (3, m) is the probability that any bin outside the echo crosses
    the threshold. The result, (3, m, points), has the sum ``p_alarm``.
    """
    by_interval = exponents.reshape(*exponents.shape[:2], -1, GAUSS_ORDER)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_slopes = -(np.log(by_interval) @ _DERIVATIVE_MATRIX.T)
    weights = _GAUSS_WEIGHTS * np.exp(-by_interval) * by_interval * log_slopes
    weights = np.nan_to_num(weights, nan=0.0).reshape(exponents.shape)
    weights = np.maximum(weights, 0.0)
    return weights * (p_alarm / np.maximum(weights.sum(axis=-1), 1e-300))[..., None]


@njit(cache=True, error_model="numpy")
def _joint_probability_increase(exponent_first, exponent_second, squared_correlation):
    """Return the increase of two Rayleigh magnitudes' joint probability due to correlation.

    Each magnitude has to exceed a level of its own. The first exceeds its level with the
    probability exp(-``exponent_first``), the second with exp(-``exponent_second``). The result is
    the probability that both exceed their levels, minus the product of the two probabilities.
    ``squared_correlation`` is the square of the correlation of the complex amplitudes.
    """
    if squared_correlation <= 0.0 or exponent_first + exponent_second > 700.0:
        return 0.0
    inverse_remainder = 2.0 / (1.0 - squared_correlation)
    p_both = (
        math.exp(-exponent_first)
        * marcum_q1_tails(
            math.sqrt(exponent_second * inverse_remainder),
            math.sqrt(squared_correlation * exponent_first * inverse_remainder),
        ).below
    )
    p_both += (
        math.exp(-exponent_second)
        * marcum_q1_tails(
            math.sqrt(squared_correlation * exponent_second * inverse_remainder),
            math.sqrt(exponent_first * inverse_remainder),
        ).above
    )
    return max(p_both - math.exp(-exponent_first - exponent_second), 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _evaluate_levels(
    spans,
    levels,
    bin_thresholds,
    negligible_signal_ratio,
    rule,
    leakage_raises_false_alarms,
    speckle_table,
    pd_loss,
    exponents,
):
    """Compute, at all magnitude levels, the echo's loss of pd and the effect of leaked signal.

    Parameters
    ----------
    spans
        :class:`sweep.model.spectrum.segment_spectra.BinSpans` of m points.
    levels
        (segments, m, levels): levels z of |X| [V, summed over the record], the threshold first.
    bin_thresholds
        (m,) each: :attr:`sweep.model.preparation.Shots.bin_thresholds`.
    negligible_signal_ratio
        (m,): |X| over sigma below which a bin counts as noise alone.
    rule
        :class:`sweep.model.detection.echo_detection.DetectionRule`.
    leakage_raises_false_alarms
        True if leaked signal counts.
    speckle_table
        :class:`sweep.model.detection.echo_detection.SpeckleTable` of all points.
    pd_loss
        (segments, m, levels): output array, the probability that the echo exceeds the threshold
        minus the probability that it exceeds the level z.
    exponents
        (segments, m, levels): -ln of the probability that no bin outside the echo exceeds z by
        noise alone; changed to that by noise and leaked signal.
    """
    for s in range(spans.first_bin.shape[0]):
        for j in range(spans.first_bin.shape[1]):
            n_bins = spans.n_bins[s, j]
            if n_bins == 0:
                continue
            span_begin, first_bin = spans.span_start[s, j], spans.first_bin[s, j]
            magnitudes = spans.magnitudes[span_begin : span_begin + n_bins]
            is_echo = spans.is_exempt[span_begin : span_begin + n_bins]
            at_threshold, bin_threshold = (
                PdAndMiss(0.0, 1.0),
                bin_threshold_of_point(bin_thresholds, j),
            )
            for k in range(levels.shape[2]):
                level = levels[s, j, k]
                if spans.peak_is_searched[s, j] and not spans.peak_is_masked[s, j]:
                    at_level = pd_and_miss(
                        EchoBins(magnitudes, is_echo, first_bin),
                        spans.peak_index[s, j],
                        rule,
                        BinThreshold(
                            bin_threshold.line_noise_sigma,
                            level,
                            bin_threshold.noise_sigma_without_pedestal,
                            bin_threshold.noise_sigma_next_to_lines,
                            bin_threshold.pedestal,
                        ),
                        bin_speckle_of_point(speckle_table, s, spans.point_numbers[j]),
                    )
                    if k == THRESHOLD_LEVEL_INDEX:
                        at_threshold = at_level
                    pd_loss[s, j, k] = pd_decrease_with_threshold(at_threshold, at_level)
                if leakage_raises_false_alarms:
                    p_leak = span_leakage_probability(
                        magnitudes,
                        is_echo,
                        level,
                        bin_threshold.noise_sigma_without_pedestal,
                        negligible_signal_ratio[j],
                        levels[s, j, THRESHOLD_LEVEL_INDEX],
                        rule.sidelobe_neighbour_noise_correlation,
                    )
                    p_leak = min(p_leak, 1.0 - 1e-16)
                    exponents[s, j, k] -= math.log1p(-p_leak)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_joint_probability_increase(up, down, squared_correlation, joint_excess):
    """Compute the increase, due to shared speckle, of the probability that both peaks are right.

    A combination of a level of the up and one of the down segment counts if either is above the
    threshold, so that a bin without the echo has crossed.

    Parameters
    ----------
    up, down
        :class:`LevelProbabilities` of the up and the down segment.
    squared_correlation
        (m,): square of the correlation of the echo's complex amplitudes in both segments.
    joint_excess
        (m,): result.
    """
    for j in range(joint_excess.size):
        up_alarm = 1.0 - up.level_probability[j, THRESHOLD_LEVEL_INDEX]
        down_alarm, total = 1.0 - down.level_probability[j, THRESHOLD_LEVEL_INDEX], 0.0
        for k in range(up.level_probability.shape[1]):
            for i in range(1 if k == THRESHOLD_LEVEL_INDEX else 0, down.level_probability.shape[1]):
                probability = up.level_probability[j, k] * down.level_probability[j, i]
                if probability > 1e-9 * (up_alarm if k != THRESHOLD_LEVEL_INDEX else 1.0) * (
                    down_alarm if i != THRESHOLD_LEVEL_INDEX else 1.0
                ):
                    squared_product = min(
                        squared_correlation[j]
                        * up.echo_power_fraction[j, k]
                        * down.echo_power_fraction[j, i],
                        1.0 - 1e-12,
                    )
                    total += probability * _joint_probability_increase(
                        up.exceedance_exponent[j, k],
                        down.exceedance_exponent[j, i],
                        squared_product,
                    )
        joint_excess[j] = total
