"""Probabilities of detection of bins, segments and shots, whatever the rule of detection.

Each probability of detection pd, and its complement, the miss probability, is computed once, from
|X| without noise (the modulus of the spectrum) in the bins around an echo:

=============================  ====================================================================
one echo in one record         :func:`sweep.model.detection.echo_detection.pd_and_miss`, by the
                               strongest bin or any bin, steady or in developed speckle
one bin in several looks       :func:`pd_and_miss_in_looks`
the segments of points         :func:`detect_in_spans`, by one of these two laws. A span is the
                               range of bins around an echo. Spans are complete here: cut to the
                               search band, empty in segments that no echo reaches, and including
                               the permanent line
a group of bins                :func:`pd_of_bin_group` in one record, and in all looks
                               :func:`group_pd_in_all_looks`
both chirps of a shot          :func:`joint_detection_probability`
a shot                         :func:`shot_pd_and_miss`, by both chirps or any two of three segments
the strongest peak alone       :func:`segment_strongest_peak_probabilities`,
                               :func:`shot_strongest_peak_probabilities`
one of M independent bins      :func:`.echo_detection.pd_of_one_independent_bin`
a segment, given another one   :func:`down_pd_given_up_result`, :func:`doppler_pd_given_chirps`
=============================  ====================================================================

Developed speckle makes the segments of a shot fade together. Far from DC and Nyquist an echo's bins
are circular complex Gaussian numbers, and the joint laws are those of
:mod:`sweep.model.detection.echo_detection` and :mod:`sweep.model.detection.looks`. Near these ends
of a real record, lines overlap their images, and the laws are corrected by
:mod:`sweep.model.detection.pseudo_variance`.

:mod:`sweep.model.spectrum.strongest_peak` applies the first law at higher thresholds, to find how
often another peak is larger than the echo's. The time-domain truth and the thesis's method apply it
to whole spectra (:func:`sweep.model.detection.echo_detection.detect_in_spectra`).
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection import echo_detection
from sweep.model.detection.echo_detection import (
    EchoBins,
    EchoSpans,
    at_least_two_of_three_probability,
    bin_speckle_of_point,
    bin_threshold_of_point,
    echo_bin_bounds,
    echo_half_width,
    pd_and_miss,
)
from sweep.model.detection.look_speckle import phase_rotated_look_covariances
from sweep.model.detection.looks import PdAndMissArrays, pd_and_miss_any_two_in_speckle
from sweep.model.detection.pseudo_variance import (
    mean_joint_pd_over_phases,
    multilook_pd_and_miss_near_ends,
)

if TYPE_CHECKING:
    from sweep.model.preparation import Shots


def detect_in_spans(shots: "Shots", spans: Any) -> Any:
    """Compute the probabilities of detection and of a miss of each segment from its echo's bins.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    spans : BinSpans
        Spans (ranges of adjacent bins around the echoes) of m points.

    Returns
    -------
    BinSpans
        The spans with their fields pd and miss set: probability of detection, and its complement.
        An echo whose strongest bin lies outside the search band, or is masked by a permanent line,
        is not detected. Both fields are nan in segments that do not exist.
    """
    if shots.looks.is_noncoherent:
        peak_magnitude = spans.peak_magnitude
        if shots.permanent_line is not None:  # it adds to |X| of the bins, not to the echo's own
            has_bins = spans.n_bins > 0
            peak_magnitude = peak_magnitude.copy()
            peak_magnitude[has_bins] = spans.magnitudes[
                (spans.span_start + spans.peak_index)[has_bins]
            ]
        pd, miss = pd_and_miss_in_looks(
            shots, peak_magnitude, spans.first_bin + spans.peak_index, spans.point_numbers
        )
    else:
        pd, miss = np.full((2, *spans.first_bin.shape), np.nan)
        _fill_span_pd_and_miss(
            EchoSpans(
                *map(
                    np.ascontiguousarray,
                    (
                        spans.first_bin,
                        spans.n_bins,
                        spans.peak_index,
                        spans.span_start,
                        spans.magnitudes,
                        spans.is_exempt,
                    ),
                )
            ),
            np.ascontiguousarray(spans.point_numbers),
            shots.detection_rule,
            shots.bin_thresholds,
            shots.speckle_table,
            pd,
            miss,
        )
    is_detectable = spans.peak_is_searched & ~spans.peak_is_masked
    return spans._replace(
        pd=np.where(is_detectable, pd, 0.0), miss=np.where(is_detectable, miss, 1.0)
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_span_pd_and_miss(spans, point_indices, rule, bin_thresholds, speckle_table, pd, miss):
    """Fill the probabilities of detection and of a miss of the echoes of m points, by segment.

    A span is the range of adjacent bins around an echo; empty ones are skipped.

    Parameters
    ----------
    spans
        :class:`sweep.model.detection.echo_detection.EchoSpans`.
    point_indices
        (m,): index of each point in the arrays of all points.
    rule, bin_thresholds, speckle_table
        :class:`~sweep.model.detection.echo_detection.DetectionRule`, and
        :class:`~sweep.model.detection.echo_detection.BinThresholds` and
        :class:`~sweep.model.detection.echo_detection.SpeckleTable` of all points.
    pd, miss
        (segments, m): results, the probabilities of detection and of a miss.
    """
    for s in range(spans.first_bin.shape[0]):
        for j in range(spans.first_bin.shape[1]):
            if spans.n_bins[s, j] == 0:
                continue
            begin = spans.span_start[s, j]
            end = begin + spans.n_bins[s, j]
            detection = pd_and_miss(
                EchoBins(
                    spans.magnitudes[begin:end], spans.is_exempt[begin:end], spans.first_bin[s, j]
                ),
                spans.peak_index[s, j],
                rule,
                bin_threshold_of_point(bin_thresholds, point_indices[j]),
                bin_speckle_of_point(speckle_table, s, point_indices[j]),
            )
            pd[s, j], miss[s, j] = detection.pd, detection.miss


@njit(cache=True, error_model="numpy")
def pd_of_bin_group(magnitude, strongest, first, last, first_bin, rule, bin_threshold, bin_speckle):
    """Return the probability that a group of adjacent bins is detected in one record.

    The group counts as an echo. Bins of its main lobe below the threshold belong to this echo too
    (:func:`sweep.model.detection.echo_detection.echo_bin_bounds`). The law is
    :func:`sweep.model.detection.echo_detection.pd_and_miss`.

    Parameters
    ----------
    magnitude
        (bins,): |X| without noise of the span, the adjacent bins around an echo [V].
    strongest, first, last
        Indices in the span of the group's strongest, first and last bin.
    first_bin
        Bin number in the spectrum of the span's first bin.
    rule, bin_threshold, bin_speckle
        :class:`~sweep.model.detection.echo_detection.DetectionRule`,
        :class:`~sweep.model.detection.echo_detection.BinThreshold` and
        :class:`~sweep.model.detection.echo_detection.BinSpeckle` of the point and segment.
    """
    first_index, last_index = echo_bin_bounds(
        magnitude,
        first,
        last,
        bin_threshold.threshold,
        echo_half_width(rule, bin_threshold.pedestal.reach_bins),
    )
    return pd_and_miss(
        EchoBins(
            magnitude[first_index : last_index + 1],
            np.ones(last_index - first_index + 1, np.bool_),
            first_bin + first_index,
        ),
        strongest - first_index,
        rule,
        bin_threshold,
        bin_speckle,
    ).pd


def group_pd_in_all_looks(
    shots: "Shots",
    pd: np.ndarray,
    magnitude: np.ndarray,
    strongest_bin: np.ndarray,
    is_searched: np.ndarray,
    point_indices: np.ndarray,
) -> np.ndarray:
    """Return the probabilities of detection of groups of bins, from all looks of a segment.

    A look is one of several records of the same segment.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    pd : ndarray (m, 3, groups)
        Probabilities of detection in one record, by :func:`pd_of_bin_group`.
    magnitude : ndarray (m, 3, groups)
        |X| of each group's strongest bin [V].
    strongest_bin : ndarray (m, 3, groups)
        Bin number of each group's strongest bin.
    is_searched : ndarray (m, 3) bool
        True if the search band contains any bin of the echo, the first group.
    point_indices : ndarray (m,)
        Points to which the rows belong.

    Returns
    -------
    ndarray (m, 3, groups)
        Probabilities by :func:`pd_and_miss_in_looks` if several looks are combined, else ``pd``.
        That of an echo outside the search band is 0.
    """
    if shots.looks.is_noncoherent:
        pd = pd_and_miss_in_looks(shots, magnitude.T, strongest_bin.T, point_indices).pd.T
    pd = pd.copy()
    pd[..., 0] = np.where(is_searched, pd[..., 0], 0.0)
    return pd


def pd_and_miss_in_looks(
    shots: "Shots",
    magnitude: np.ndarray,
    bins: np.ndarray,
    point_indices: np.ndarray | slice = slice(None),
) -> PdAndMissArrays:
    """Return the probabilities that a bin is detected in several looks, and that it is missed.

    A look is one of several records of the same segment.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    magnitude : ndarray (..., m)
        |X| of one look [V]; nan without an echo.
    bins : ndarray (..., m)
        Bin numbers.
    point_indices : ndarray (m,) or slice
        Points to which the columns belong.

    Returns
    -------
    PdAndMissArrays
        pd and miss, (..., m); nan where `magnitude` is.
    """
    is_present = np.isfinite(magnitude)
    noise_sigma, threshold = (
        np.broadcast_to(values, shots.size)[point_indices]
        for values in (shots.line_noise_sigma, shots.threshold)
    )
    signal_ratio = np.where(is_present, magnitude, 0.0) / noise_sigma
    if shots.speckle.segment_correlations is not None:
        detection = _pd_and_miss_in_looks_and_speckle(
            shots, signal_ratio, threshold / noise_sigma, bins, point_indices
        )
    else:
        is_real_bin = np.isin(bins, (0, shots.fft_size_if_end_bins_real // 2)) & (
            shots.fft_size_if_end_bins_real > 0
        )
        detection = shots.looks.pd_and_miss_steady(
            signal_ratio, threshold / noise_sigma, is_real_bin
        )
    return PdAndMissArrays(
        *(np.where(is_present, probability, np.nan) for probability in detection)
    )


def _pd_and_miss_in_looks_and_speckle(
    shots: "Shots",
    signal_ratio: np.ndarray,
    threshold_ratio: np.ndarray,
    bins: np.ndarray,
    point_indices: np.ndarray | slice,
) -> PdAndMissArrays:
    """Compute :func:`pd_and_miss_in_looks` of bins in developed speckle, from several looks.

    ``signal_ratio`` and ``threshold_ratio`` are over sigma, the noise per quadrature.
    """
    look_speckle = (
        None
        if shots.speckle.look_speckle is None
        else shots.speckle.look_speckle.select(point_indices)
    )
    pd, miss = shots.looks.pd_and_miss_in_speckle(signal_ratio, threshold_ratio, look_speckle)
    rule, speckle_table = shots.detection_rule, shots.speckle_table
    speckle_row = np.broadcast_to(
        speckle_table.pseudo_variance_row[:, point_indices], signal_ratio.shape
    )
    bins_from_end = np.minimum(bins, shots.fft_size // 2 - bins)
    is_near_end = (
        (speckle_row > 0)
        & (bins_from_end >= 0)
        & (bins_from_end < speckle_table.pseudo_variance_ratio.shape[1])
    )
    if is_near_end.any():
        signal_pseudo_variance_ratio = speckle_table.pseudo_variance_ratio[
            speckle_row[is_near_end], bins_from_end[is_near_end]
        ]
        noise_pseudo_variance_ratio = (
            rule.noise_pseudo_variance_ratio[bins_from_end[is_near_end]]
            if rule.has_real_noise_at_ends
            else np.zeros(signal_pseudo_variance_ratio.size)
        )
        near_threshold_ratio = np.broadcast_to(threshold_ratio, signal_ratio.shape)[is_near_end]
        pd, miss = pd.copy(), miss.copy()
        segment, point_column = (
            index_grid[is_near_end] for index_grid in np.indices(signal_ratio.shape)[-2:]
        )
        look_covariance = _look_amplitude_covariance(
            shots, segment, np.arange(shots.size)[point_indices][point_column]
        )
        pd[is_near_end], miss[is_near_end] = multilook_pd_and_miss_near_ends(
            shots.looks,
            signal_ratio[is_near_end],
            near_threshold_ratio,
            signal_pseudo_variance_ratio,
            noise_pseudo_variance_ratio,
            look_covariance,
        )
    return PdAndMissArrays(pd, miss)


def _look_amplitude_covariance(
    shots: "Shots", segment: np.ndarray, point: np.ndarray
) -> np.ndarray:
    """Return the covariance of an echo's amplitudes over k looks, (m, k, k).

    A look is one of several records of the same segment. ``segment`` and ``point`` have m elements.
    """
    n_looks = shots.looks.number
    correlation_by_lag, look_power = (
        np.ones((point.size, n_looks), complex),
        np.ones((point.size, n_looks)),
    )
    if shots.looks.has_independent_speckle:
        correlation_by_lag[:, 1:] = 0.0
    elif shots.speckle.look_speckle is not None:
        correlation_by_lag = shots.speckle.look_speckle.correlation_by_lag[segment, point]
        look_power = shots.speckle.look_speckle.look_power[segment, point]
    cycles_per_look = (
        np.zeros(point.size)
        if shots.speckle.phase_cycles_per_look is None
        else shots.speckle.phase_cycles_per_look[segment, point]
    )
    return phase_rotated_look_covariances(correlation_by_lag, look_power, cycles_per_look)


def joint_detection_probability(
    shots: "Shots",
    pd_up: np.ndarray,
    pd_down: np.ndarray,
    magnitudes: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Return the probability that both up and down segment are detected.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    pd_up, pd_down : ndarray (..., n)
        Probabilities of detection of each segment.
    magnitudes : tuple of ndarray (..., n)
        |X| of the strongest bins of up and down segment [V].

    Returns
    -------
    ndarray (..., n)
        Without speckle, the product of ``pd_up`` and ``pd_down``. In developed speckle the segments
        are correlated and the probability is larger.
    """
    if shots.speckle.segment_correlations is None:
        return pd_up * pd_down
    joint_law = _joint_pd_in_looks if shots.looks.is_noncoherent else _joint_pd_in_one_record
    correlation = np.abs(shots.speckle.segment_correlations.up_down)
    pd_both = joint_law(shots, pd_up, pd_down, magnitudes, correlation)
    return np.where((pd_up == 0) | (pd_down == 0), 0.0, pd_both)


def _joint_pd_in_one_record(
    shots: "Shots",
    pd_up: np.ndarray,
    pd_down: np.ndarray,
    magnitudes: tuple[np.ndarray, np.ndarray],
    correlation: np.ndarray,
) -> np.ndarray:
    """Compute :func:`joint_detection_probability` of one record of each segment in speckle.

    ``correlation`` (n,) is the magnitude of the correlation of the two segments' speckle.
    """
    threshold_ratio = shots.threshold / shots.line_noise_sigma
    n_equivalent = mean_n_detection_equivalent_bins(shots, (pd_up, pd_down), magnitudes)
    pd_both = echo_detection.joint_pd_in_speckle(
        pd_up, pd_down, threshold_ratio, correlation, n_equivalent
    )
    speckle_table, speckle_rows = (
        shots.speckle_table,
        shots.speckle_table.pseudo_variance_row[[0, 2]],
    )
    near_ends = np.flatnonzero(speckle_rows.any(axis=0))
    if near_ends.size:
        threshold_ratio, correlation, n_equivalent = (
            np.broadcast_to(values, pd_up.shape)[..., near_ends]
            for values in (threshold_ratio, correlation, n_equivalent)
        )
        (pd_both[..., near_ends],) = mean_joint_pd_over_phases(
            speckle_table.relative_power_by_phase[speckle_rows[:, near_ends]],
            (pd_up[..., near_ends], pd_down[..., near_ends]),
            lambda up, down: (
                echo_detection.joint_pd_in_speckle(
                    up, down, threshold_ratio, correlation, n_equivalent
                ),
            ),
        )
    return pd_both


def _joint_pd_in_looks(
    shots: "Shots",
    pd_up: np.ndarray,
    pd_down: np.ndarray,
    magnitudes: tuple[np.ndarray, np.ndarray],
    correlation: np.ndarray,
) -> np.ndarray:
    """Compute :func:`joint_detection_probability` of several looks in speckle.

    ``correlation`` (n,) is the magnitude of the correlation of the two segments' speckle. It is not
    used if the speckle of the looks is partially correlated; then ``segment_correlation`` of their
    :class:`.LookSpeckle` is used.

    Notes
    -----
    Far from DC and Nyquist the law is that of
    :meth:`sweep.model.detection.looks.Looks.joint_pd_in_speckle`. Near DC and Nyquist, the joint
    probability exceeds the product of both pd by a fraction of the largest possible excess. This
    fraction is computed as if DC and Nyquist were far away.
    """
    threshold_ratio = shots.threshold / shots.line_noise_sigma
    signal_up, signal_down = (magnitude / shots.line_noise_sigma for magnitude in magnitudes)
    look_speckle = shots.speckle.look_speckle
    if look_speckle is not None:
        _, correlation, _ = look_speckle.segment_correlation  # of up and down
    pd_both = shots.looks.joint_pd_in_speckle(
        signal_up, signal_down, threshold_ratio, correlation, look_speckle
    )
    is_near_ends = shots.speckle_table.pseudo_variance_row[[0, 2]].any(axis=0)
    if not is_near_ends.any():
        return pd_both
    pd_up_far_from_ends, pd_down_far_from_ends = _pd_in_looks_far_from_ends(
        shots, signal_up, signal_down, threshold_ratio
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        excess_fraction = (pd_both - pd_up_far_from_ends * pd_down_far_from_ends) / (
            np.minimum(pd_up_far_from_ends, pd_down_far_from_ends)
            - pd_up_far_from_ends * pd_down_far_from_ends
        )
    excess_fraction = np.clip(np.nan_to_num(excess_fraction), 0.0, 1.0)
    return np.where(
        is_near_ends,
        pd_up * pd_down + excess_fraction * (np.minimum(pd_up, pd_down) - pd_up * pd_down),
        pd_both,
    )


def _pd_in_looks_far_from_ends(
    shots: "Shots", signal_up: np.ndarray, signal_down: np.ndarray, threshold_ratio: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return pd of up and down segment over several looks, as if DC and Nyquist were far away.

    Signals (root mean square |X|) and threshold are over sigma, the noise per quadrature.
    """
    signals = np.nan_to_num(np.stack([signal_up, 0 * signal_up, signal_down], axis=-2))
    pd_up, _, pd_down = np.moveaxis(
        shots.looks.pd_and_miss_in_speckle(
            signals, threshold_ratio[..., None, :], shots.speckle.look_speckle
        ).pd,
        -2,
        0,
    )
    return pd_up, pd_down


def mean_n_detection_equivalent_bins(
    shots: "Shots", probabilities: tuple[np.ndarray, ...], magnitudes: tuple[np.ndarray, ...]
) -> np.ndarray | float:
    """Return the number of independent bins that are detected as often as an echo's bins.

    The number is the geometric mean over the given segments of
    :func:`sweep.model.detection.echo_detection.n_detection_equivalent_bins`. It is 1 if an echo is
    detected by its strongest bin alone.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    probabilities : tuple of ndarray
        Probabilities of detection of the segments.
    magnitudes : tuple of ndarray
        |X| of the segments' strongest bins [V].
    """
    if shots.detection_settings.echo_bin_rule == "peak_bin":
        return 1.0
    noise_sigma = shots.line_noise_sigma
    threshold_ratio = shots.threshold / noise_sigma
    n_equivalent: Any = 1.0
    for pd, magnitude in zip(probabilities, magnitudes, strict=True):
        n_equivalent = n_equivalent * echo_detection.n_detection_equivalent_bins(
            pd, magnitude / noise_sigma, threshold_ratio
        )
    return np.asarray(n_equivalent ** (1 / len(probabilities)))


def shot_pd_and_miss(
    shots: "Shots", pd: np.ndarray, miss: np.ndarray, magnitudes: np.ndarray
) -> PdAndMissArrays:
    """Return the probabilities that a shot is detected, and that it is missed.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    pd, miss : ndarray (3, n)
        Probabilities of detection and of a miss of each segment.
    magnitudes : ndarray (3, n)
        |X| of the segments' strongest bins [V].

    Returns
    -------
    PdAndMissArrays
        (n,): probability ``pd`` that a shot is detected, and its complement ``miss``. ``miss`` is
        not computed as 1 - ``pd``, so that both keep their precision.
    """
    if shots.detects_by_any_two_segments:
        return _pd_and_miss_any_two(shots, pd, miss, magnitudes)
    pd_up, _, pd_down = pd
    miss_up, _, miss_down = miss
    magnitude_up, _, magnitude_down = magnitudes
    pd_both = joint_detection_probability(shots, pd_up, pd_down, (magnitude_up, magnitude_down))
    miss_shot = miss_up + pd_up * miss_down
    if shots.speckle.segment_correlations is not None:
        miss_shot = miss_up + np.maximum(pd_up - pd_both, 0.0)
    return PdAndMissArrays(pd_both, np.minimum(miss_shot, 1.0))  # rounding may exceed 1


def _pd_and_miss_any_two(
    shots: "Shots", pd: np.ndarray, miss: np.ndarray, magnitudes: np.ndarray
) -> PdAndMissArrays:
    """Compute :func:`shot_pd_and_miss` where detection in any two of three segments suffices."""
    if shots.speckle.segment_correlations is None:
        return PdAndMissArrays(
            at_least_two_of_three_probability(pd, miss), at_least_two_of_three_probability(miss, pd)
        )
    threshold_ratio = shots.threshold / shots.line_noise_sigma
    if shots.looks.is_noncoherent:
        look_speckle = shots.speckle.look_speckle
        correlations = (
            np.abs(np.array(shots.speckle.segment_correlations))
            if look_speckle is None
            else look_speckle.segment_correlation
        )
        signal_ratios = magnitudes / shots.line_noise_sigma
        return shots.looks.pd_and_miss_any_two(
            signal_ratios, threshold_ratio, correlations, pd, look_speckle
        )
    correlations = np.abs(np.array(shots.speckle.segment_correlations))
    pd_shot, miss_shot = pd_and_miss_any_two_in_speckle(pd, miss, threshold_ratio, correlations)
    speckle_table = shots.speckle_table
    near_ends = np.flatnonzero(speckle_table.pseudo_variance_row.any(axis=0))
    if near_ends.size:
        threshold_ratio = np.broadcast_to(threshold_ratio, shots.size)[near_ends]
        correlations = correlations[:, near_ends]
        pd_shot[near_ends], miss_shot[near_ends] = mean_joint_pd_over_phases(
            speckle_table.relative_power_by_phase[speckle_table.pseudo_variance_row[:, near_ends]],
            tuple(pd[:, near_ends]),
            lambda *pd: pd_and_miss_any_two_in_speckle(
                np.array(pd), 1 - np.array(pd), threshold_ratio, correlations
            ),
        )
    return PdAndMissArrays(pd_shot, miss_shot)


class StrongestPeakProbabilities(NamedTuple):
    """Probabilities of a right and of a wrong peak, if only the strongest peak is reported.

    Arrays are (3, n) by segment, or (n,) of the shot.
    """

    pd: np.ndarray
    """Probability that the echo's peak is reported; for a shot, that both chirps report it."""
    miss: np.ndarray
    """Probability 1 - pd, precise where pd is near 1."""
    p_wrong_range: np.ndarray
    """Probability that a peak other than the echo's is reported. For a shot, probability of a wrong
    range: both chirps report a peak, and one of them is not the echo's, or the two peaks are
    resolved to a wrong range."""


@njit(cache=True, error_model="numpy", borrows=True)
def pd_decrease_with_threshold(at_threshold, at_level):
    """Return the decrease of pd from the threshold b to a higher level z, P_b - P_z >= 0.

    The decrease is computed from ``miss`` instead of ``pd`` where the former is more precise.

    Parameters
    ----------
    at_threshold, at_level
        :class:`~sweep.model.detection.echo_detection.PdAndMiss` of an echo at the threshold b and
        at the higher level z.
    """
    decrease = at_threshold.pd - at_level.pd
    if at_level.miss < 0.5:
        decrease = at_level.miss - at_threshold.miss
    return max(decrease, 0.0)


def segment_strongest_peak_probabilities(
    pd: np.ndarray, miss: np.ndarray, pd_loss: np.ndarray, p_alarm: np.ndarray
) -> StrongestPeakProbabilities:
    """Return the probabilities that a segment's strongest peak is the echo's, or a wrong one.

    Parameters
    ----------
    pd, miss : ndarray (3, n)
        Probabilities that any peak of the echo is detected, or none.
    pd_loss : ndarray (3, n)
        Probability L that the echo crosses the threshold, but another peak is larger.
    p_alarm : ndarray (3, n)
        Probability that any bin outside the echo crosses the threshold.

    Notes
    -----
    P(right) = pd - L, and P(wrong) = p_alarm miss + L.
    """
    return StrongestPeakProbabilities(
        pd=np.maximum(pd - pd_loss, 0.0),
        miss=np.minimum(miss + pd_loss, 1.0),
        p_wrong_range=np.minimum(p_alarm * miss + pd_loss, 1.0),
    )


def shot_strongest_peak_probabilities(
    segments: StrongestPeakProbabilities,
    p_alarm: np.ndarray,
    *,
    shared_speckle_gain: np.ndarray,
    speckle_covariance: np.ndarray | None,
    is_range_misread: np.ndarray,
) -> StrongestPeakProbabilities:
    """Return the probabilities that a shot reports the echo's peaks, or a wrong range.

    Parameters
    ----------
    segments : StrongestPeakProbabilities
        Probabilities of the segments, (3, n).
    p_alarm : ndarray (3, n)
        Probability that any bin outside the echo crosses the threshold.
    shared_speckle_gain : ndarray (n,)
        Increase, due to speckle that both chirps share, of the probability that both report the
        echo's peak. Only cases count in which bins outside the echo cross the threshold.
    speckle_covariance : ndarray (n,) or None
        Probability that the echo is detected in both chirps, minus the product of the two chirps'
        probabilities; None without developed speckle.
    is_range_misread : ndarray (n,) bool
        True where the peaks of the echo itself are resolved to a wrong range.

    Returns
    -------
    StrongestPeakProbabilities
        (n,): ``pd``, that both chirps report the echo's peak; its complement ``miss``; and
        ``p_wrong_range``, that the shot reports a wrong range.

    Notes
    -----
    With r, w and a the probabilities of a right peak, a wrong peak and an alarm in up (1) and down
    segment (2), G ``shared_speckle_gain`` and C ``speckle_covariance``,

        P(right) = min(r1 r2 + G + (1 - a1) (1 - a2) C, r1, r2)
        P(wrong) = w1 (r2 + w2) + r1 w2 - G, plus P(right) where the range is misread
        P(miss) = miss1 + r1 - P(right)
    """
    right_up, _, right_down = segments.pd
    miss_up, _, _ = segments.miss
    wrong_up, _, wrong_down = segments.p_wrong_range
    p_both_right = right_up * right_down + shared_speckle_gain
    if speckle_covariance is not None:
        alarm_up, _, alarm_down = p_alarm
        p_no_alarm = (1 - alarm_up) * (1 - alarm_down)
        p_both_right = np.minimum(
            p_both_right + p_no_alarm * speckle_covariance, np.minimum(right_up, right_down)
        )
    p_wrong = wrong_up * (right_down + wrong_down) + right_up * wrong_down
    return StrongestPeakProbabilities(
        pd=p_both_right,
        miss=np.minimum(miss_up + np.maximum(right_up - p_both_right, 0.0), 1.0),
        p_wrong_range=np.maximum(p_wrong - shared_speckle_gain, 0.0)
        + np.where(is_range_misread, p_both_right, 0.0),
    )


class ConditionalPd(NamedTuple):
    """Probabilities of detection in a segment, given the result in other segments of the shot."""

    pd_if_condition_fails: np.ndarray
    """(...): probability of detection in the segment if the condition does not hold."""
    pd_if_condition_holds: np.ndarray
    """(...): probability of detection in the segment if the condition holds."""


def down_pd_given_up_result(
    pd_up: np.ndarray, pd_down: np.ndarray, pd_both: np.ndarray
) -> ConditionalPd:
    """Return the probability of detection in the down segment, given the result in the up segment.

    Parameters
    ----------
    pd_up, pd_down, pd_both
        Probability of a detection in the up segment, in the down segment, and in both, (...).

    Returns
    -------
    ConditionalPd
        The condition is a detection in the up segment. The probability is pd_both / pd_up if the up
        segment detects, and (pd_down - pd_both) / (1 - pd_up) if it does not.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        without_up = np.where(
            pd_up < 1, np.clip((pd_down - pd_both) / (1 - pd_up), 0.0, 1.0), pd_down
        )
        return ConditionalPd(
            without_up, np.where(pd_up > 0, np.minimum(pd_both / pd_up, 1.0), pd_down)
        )


def doppler_pd_given_chirps(
    pd_doppler: np.ndarray,
    pd_exactly_one: np.ndarray,
    pd_added_by_doppler: np.ndarray,
    detects_any_two: np.ndarray,
) -> ConditionalPd:
    """Return the probability of detection in the Doppler segment, given the results of both chirps.

    The condition is that exactly one of the two chirps detects. If it holds, and detections in any
    two of three segments suffice, the Doppler segment decides on the shot.

    Parameters
    ----------
    pd_doppler
        (...): probability D of a detection in the Doppler segment.
    pd_exactly_one
        (...): probability E that exactly one of the chirps detects.
    pd_added_by_doppler
        (...): probability A that the Doppler segment and exactly one chirp detect.
    detects_any_two
        (...) bool: True where detections in any two of three segments detect a shot. Elsewhere the
        Doppler segment decides nothing, and both probabilities are D.

    Returns
    -------
    ConditionalPd
        A / E if the condition holds, (D - A) / (1 - E) if it does not.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        pd_if_condition_holds = np.where(
            detects_any_two & (pd_exactly_one > 0),
            np.clip(pd_added_by_doppler / pd_exactly_one, 0.0, 1.0),
            pd_doppler,
        )
        pd_if_condition_fails = np.clip(
            (pd_doppler - pd_added_by_doppler) / (1 - pd_exactly_one), 0.0, 1.0
        )
    return ConditionalPd(
        np.where(detects_any_two & (pd_exactly_one < 1), pd_if_condition_fails, pd_doppler),
        pd_if_condition_holds,
    )
