"""Probabilities that the strongest peak of a segment is the echo's, or another's.

A peak elsewhere that is larger than the echo's takes its place: what is reported is detected, with
a wrong range. Let Z be the largest |X| of the bins searched that the echo does not occupy, and b
the threshold. Let P_z be the probability that the echo crosses a level z, by the same law as at b.
Then

    P(right) = P_b - L,    P(wrong) = P(Z >= b) (1 - P_b) + L,
    L = int_b^inf (P_b - P_z) dP(Z < z),    P(none) = P(Z < b) (1 - P_b)

and these three add to 1. All terms are positive, so that small ones keep their digits. P(Z < z) is
that no bin of noise crosses z, n independent ones at each level
(:mod:`sweep.model.detection.bin_noise`), and
that no bin of leaked signal does either. With y = z^2 / (2 sigma^2), -ln P(Z < z) is very nearly
proportional to e^-y. The integral over y is Gauss's in intervals, and its mass is made exact.

Noise is independent from segment to segment, and so are right peaks of a steady echo. If speckle is
shared, the probability of both is that of two correlated Rayleigh magnitudes which cross their own
levels, max(b, Z), averaged over both Z. An echo of many bins counts at each level as the one bin
that crosses it as often. It is within 0.01 of drawn records at any threshold.

A shot is wrong where both chirps report a peak, and not both of the echo.
"""

import math
from typing import Any

import numpy as np

from sweep.kernel_cache import njit
from sweep.model import waveform
from sweep.model.detection import bin_noise
from sweep.model.detection.echo_detection import (
    BinThreshold,
    Detection,
    EchoBins,
    bin_speckle_at,
    bin_threshold_at,
    pd_and_miss,
)
from sweep.model.detection.marcum import marcum_q1_tails
from sweep.model.spectrum.search_restriction import span_leakage
from sweep.model.spectrum.segment_spectra import iter_spans

GAUSS_ORDER = 4
"""Gauss points of each stretch of y."""
INTERVAL_EDGES = np.array([0, 1, 2, 3, 4, 5, 6, 7.5, 9.5, 12, 15, 19, 24, 30, 37.0])
"""Ends of the stretches, from the threshold or from 4 below ln n on, where noise surely alarms."""

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(GAUSS_ORDER)
_DERIVATIVE_MATRIX = np.array(
    [
        np.polynomial.Polynomial.fit(_GAUSS_NODES, row, GAUSS_ORDER - 1).deriv()(_GAUSS_NODES)
        for row in np.eye(GAUSS_ORDER)
    ]
).T
"""Derivative at the points of the polynomial through values at them."""


def strongest_peak_probabilities(
    shots: Any, pd: np.ndarray, miss: np.ndarray, magnitude: np.ndarray
) -> dict[str, np.ndarray]:
    """Probabilities of segments and shot, (n,) by name: ``pd_``, ``miss_``, ``p_wrong_range_``.

    By those of all peaks and |X| [V] of the strongest bin, by segment, (3, n) each.
    """
    pd_loss, p_alarm, shared_gain = (
        np.zeros((3, shots.size)),
        np.zeros((3, shots.size)),
        np.zeros(shots.size),
    )
    for spans in iter_spans(shots, bin_by_bin=True):
        (
            pd_loss[:, spans.point_numbers],
            p_alarm[:, spans.point_numbers],
            shared_gain[spans.point_numbers],
        ) = _span_probabilities(shots, spans, pd)
    pd_right, miss_right = np.maximum(pd - pd_loss, 0.0), np.minimum(miss + pd_loss, 1.0)
    p_wrong = np.minimum(p_alarm * miss + pd_loss, 1.0)
    results = {
        f"{name}_{segment}": values[s]
        for name, values in {"pd": pd_right, "miss": miss_right, "p_wrong_range": p_wrong}.items()
        for s, segment in enumerate(waveform.SEGMENT_NAMES)
    }
    p_no_alarm = (1 - p_alarm[0]) * (1 - p_alarm[2])
    p_both_right = pd_right[0] * pd_right[2] + shared_gain
    if shots.speckle.segment_correlations is not None:
        speckle_covariance = (
            shots.joint_detection_probability(pd[0], pd[2], (magnitude[0], magnitude[2]))
            - pd[0] * pd[2]
        )
        p_both_right = np.minimum(
            p_both_right + p_no_alarm * speckle_covariance, np.minimum(pd_right[0], pd_right[2])
        )
    p_reported_wrong = p_wrong[0] * (pd_right[2] + p_wrong[2]) + pd_right[0] * p_wrong[2]
    return results | {
        "pd_shot": p_both_right,
        "miss_shot": np.minimum(miss_right[0] + np.maximum(pd_right[0] - p_both_right, 0.0), 1.0),
        "p_wrong_range_shot": np.maximum(p_reported_wrong - shared_gain, 0.0),
    }


def _span_probabilities(
    shots: Any, spans: Any, pd: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """L and P(Z >= b) by segment, (3, m); by how much shared speckle adds to both, (m,)."""
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
    span_numbers = np.array([spans.first_bin, spans.n_bins, spans.peak_index, spans.span_start])
    _evaluate_levels(
        span_numbers,
        spans.peak_is_searched,
        (spans.magnitudes, spans.is_exempt),
        levels,
        np.concatenate([shots.bin_threshold_table[:, points], negligible_signal_ratio[None]]),
        (shots.detection_rule, shots.detection_settings.includes_leakage),
        (points, shots.speckle_table),
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
        _shared_excess(
            (level_probabilities[0], level_probabilities[2]),
            (level_exponents[0], level_exponents[2]),
            (echo_fractions[0], echo_fractions[2]),
            squared_correlation,
            joint_excess,
        )
    total_loss = (weight * pd_loss[..., 1:]).sum(axis=-1)
    return (
        np.where(segment_exists, total_loss, np.nan),
        np.where(segment_exists, p_alarm, np.nan),
        joint_excess,
    )


def _level_half_squares(shots: Any, spans: Any, threshold_ratio: np.ndarray) -> np.ndarray:
    """Places y, (3, m, 1 + points), that of the threshold first."""
    threshold_half_square = 0.5 * np.square(threshold_ratio)
    n_bins = shots.n_searched_bins(spans.n_exempt, spans.point_numbers)
    first_half_square = np.maximum(threshold_half_square, np.log(np.maximum(n_bins, 1.0)) - 4)
    inner = (
        INTERVAL_EDGES[:-1, None] + np.diff(INTERVAL_EDGES)[:, None] * 0.5 * (_GAUSS_NODES + 1)
    ).ravel()
    first = np.broadcast_to(threshold_half_square, first_half_square.shape)[..., None]
    return np.concatenate([first, first_half_square[..., None] + inner], axis=-1)


def _noise_exponents(shots: Any, spans: Any, half_squares: np.ndarray) -> np.ndarray:
    """-ln P(no bin of noise is at or above y), of the shape of y."""
    n_bins = shots.n_searched_bins(spans.n_exempt, spans.point_numbers)[..., None]
    if shots.detection_settings.noise_bins == "correlated":
        n_bins = bin_noise.alarm_equivalent_bins(
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
    """Weights of the points, their sum P(Z >= b), of the shape of ``exponents`` (3, m, points)."""
    by_interval = exponents.reshape(*exponents.shape[:2], -1, GAUSS_ORDER)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_slopes = -(np.log(by_interval) @ _DERIVATIVE_MATRIX.T)
    weights = _GAUSS_WEIGHTS * np.exp(-by_interval) * by_interval * log_slopes
    weights = np.nan_to_num(weights, nan=0.0).reshape(exponents.shape)
    weights = np.maximum(weights, 0.0)
    return weights * (p_alarm / np.maximum(weights.sum(axis=-1), 1e-300))[..., None]


@njit(cache=True, error_model="numpy")
def _joint_excess(exponent_first, exponent_second, squared_correlation):
    """P(both) - e^-a e^-b of two Rayleigh magnitudes (:func:`.detection.fading_together`)."""
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
    span_numbers,
    peak_is_searched,
    span_bins,
    levels,
    threshold_rows,
    rule_and_leakage,
    points_and_speckle,
    pd_loss,
    exponents,
):
    """Evaluate runs at all levels: what the echo loses there, and what leaked signal adds.

    ``span_numbers`` (4, segments, m) are low, count, peak and start of runs; ``span_bins`` |X| [V]
    of all
    runs, and whether they are of the echo; ``levels`` (segments, m, k) [V], the threshold first;
    ``threshold_rows`` (8, m) levels of the bins
    (:class:`sweep.model.detection.echo_detection.BinThreshold`), and the floor of
    leakage over the noise; ``rule_and_leakage`` the rule of detection, and whether leakage is
    looked at;
    ``points_and_speckle`` points (m,) and the speckle of all. Results, of the levels' shape:
    ``pd_loss`` P_b - P_z; ``exponents`` -ln P(Z < z), to which that of leaked signal is added.
    """
    first_bin, n_bins, peak_index, span_start = span_numbers
    noise_sigma, negligible_signal_ratio = threshold_rows[2], threshold_rows[7]
    for s in range(first_bin.shape[0]):
        for j in range(first_bin.shape[1]):
            if n_bins[s, j] == 0:
                continue
            magnitudes = span_bins[0][span_start[s, j] : span_start[s, j] + n_bins[s, j]]
            is_echo = span_bins[1][span_start[s, j] : span_start[s, j] + n_bins[s, j]]
            at_threshold, bin_threshold = Detection(0.0, 1.0), bin_threshold_at(threshold_rows, j)
            for k in range(levels.shape[2]):
                threshold = levels[s, j, k]
                if peak_is_searched[s, j]:
                    at_level = pd_and_miss(
                        EchoBins(magnitudes, is_echo, first_bin[s, j]),
                        peak_index[s, j],
                        rule_and_leakage[0],
                        BinThreshold(
                            bin_threshold.line_noise,
                            threshold,
                            bin_threshold.noise_without_pedestal,
                            bin_threshold.side_noise,
                            bin_threshold.pedestal,
                        ),
                        bin_speckle_at(points_and_speckle[1], s, points_and_speckle[0][j]),
                    )
                    if k == 0:
                        at_threshold = at_level
                    # The difference of the smaller probabilities keeps its digits.
                    loss_at_level = at_threshold.pd - at_level.pd
                    if at_level.miss < 0.5:
                        loss_at_level = at_level.miss - at_threshold.miss
                    pd_loss[s, j, k] = max(loss_at_level, 0.0)
                if rule_and_leakage[1]:
                    p_leak = span_leakage(
                        magnitudes,
                        is_echo,
                        (threshold, noise_sigma[j], negligible_signal_ratio[j]),
                        levels[s, j, 0],
                        rule_and_leakage[0].sidelobe_correlation,
                    )
                    p_leak = min(p_leak, 1.0 - 1e-16)
                    exponents[s, j, k] -= math.log1p(-p_leak)


@njit(cache=True, nogil=True, error_model="numpy")
def _shared_excess(
    level_probabilities, level_exponents, echo_fractions, squared_correlation, excess
):
    """Excess probability that both peaks are right if noise crosses in either, (m,) in place.

    ``level_probabilities``, ``level_exponents`` and ``echo_fractions`` are of up and down segment,
    (m, 1 + k) each, the threshold
    first: probabilities of levels that the echo has to cross; -ln P_z; share of signal in the power
    of the bin detected as often. ``squared_correlation`` is the square of the correlation of the
    signals' amplitudes.
    """
    for j in range(excess.size):
        up, down, total = level_probabilities[0][j], level_probabilities[1][j], 0.0
        up_alarm, down_alarm = 1.0 - up[0], 1.0 - down[0]
        for k in range(up.size):
            for i in range(1 if k == 0 else 0, down.size):
                probability = up[k] * down[i]
                if probability > 1e-9 * (up_alarm if k > 0 else 1.0) * (
                    down_alarm if i > 0 else 1.0
                ):
                    squared_product = min(
                        squared_correlation[j] * echo_fractions[0][j, k] * echo_fractions[1][j, i],
                        1.0 - 1e-12,
                    )
                    total += probability * _joint_excess(
                        level_exponents[0][j, k], level_exponents[1][j, i], squared_product
                    )
        excess[j] = total
