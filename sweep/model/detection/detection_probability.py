"""Probabilities of detection of segments and shots, whatever the rule of detection.

Each probability of detection pd, and its complement, the miss probability, is computed once, from
|X| without noise (the modulus of the spectrum) in the bins around an echo:

=============================  ====================================================================
one echo in one record         :func:`sweep.model.detection.echo_detection.pd_and_miss`, by the
                               strongest bin or any bin, steady or in developed speckle
one bin in several looks       :meth:`sweep.model.preparation.Shots.pd_and_miss_in_looks`
the segments of points         :func:`detect_in_spans`, by one of these two laws. A span is the
                               range of bins around an echo; it is final then: cut to the search
                               band, and empty in segments that no echo reaches
both chirps of a shot          :meth:`sweep.model.preparation.Shots.joint_detection_probability`
a shot                         :func:`shot_pd_and_miss`, by both chirps or any two of three segments
=============================  ====================================================================

Three callers apply the first two laws to bins of their own: groups of bins
(:mod:`sweep.model.pointcloud.bin_groups`), the line of leaked light, which changes |X|
(:mod:`sweep.model.effects.circulator_leak`), and higher thresholds
(:mod:`sweep.model.spectrum.strongest_peak`).
"""

from typing import Any

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection.echo_detection import (
    EchoBins,
    EchoSpans,
    at_least_two_of_three,
    bin_speckle_at,
    bin_threshold_at,
    pd_and_miss,
)
from sweep.model.detection.looks import DetectionArrays, pd_and_miss_any_two_in_speckle
from sweep.model.detection.pseudo_variance import mean_over_phases


def pd_follows_from_computed_spans(shots: Any) -> bool:
    """Test if probabilities of detection follow from the bins around an echo as first computed.

    They do not if a search band later removes some of these bins, if leaked light adds a line to
    them, or if several looks (records of each segment) are combined.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    """
    return (
        shots.detection_settings.search_band is None
        and shots.permanent_line is None
        and not shots.looks.is_noncoherent
    )


def detect_in_spans(shots: Any, spans: Any) -> Any:
    """Set the probabilities of detection of each segment from the bins around its echo.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    spans : BinSpans
        Spans (ranges of adjacent bins around the echoes) of m points. Their pd and miss are kept
        if :func:`pd_follows_from_computed_spans` is true.

    Returns
    -------
    BinSpans
        Spans with the probabilities pd of detection and miss, its complement. An echo whose
        strongest bin lies outside the search band is not detected. Both are nan in segments that do
        not exist.
    """
    pd, miss = spans.pd, spans.miss
    if shots.looks.is_noncoherent:
        pd, miss = shots.pd_and_miss_in_looks(
            spans.peak_magnitude, spans.first_bin + spans.peak_index, spans.point_numbers
        )
    elif not pd_follows_from_computed_spans(shots):
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
    return spans._replace(
        pd=np.where(spans.peak_is_searched, pd, 0.0),
        miss=np.where(spans.peak_is_searched, miss, 1.0),
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
                bin_threshold_at(bin_thresholds, point_indices[j]),
                bin_speckle_at(speckle_table, s, point_indices[j]),
            )
            pd[s, j], miss[s, j] = detection.pd, detection.miss


def shot_pd_and_miss(
    shots: Any, pd: np.ndarray, miss: np.ndarray, magnitudes: np.ndarray
) -> DetectionArrays:
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
    DetectionArrays
        (n,): probabilities pd that a shot is detected, and miss that it is not. miss is not
        computed as 1 - pd, so that both keep their precision.
    """
    if shots.any_two:
        return _pd_and_miss_any_two(shots, pd, miss, magnitudes)
    pd_up, _, pd_down = pd
    miss_up, _, miss_down = miss
    magnitude_up, _, magnitude_down = magnitudes
    pd_both = shots.joint_detection_probability(pd_up, pd_down, (magnitude_up, magnitude_down))
    miss_shot = miss_up + pd_up * miss_down
    if shots.speckle.segment_correlations is not None:
        miss_shot = miss_up + np.maximum(pd_up - pd_both, 0.0)
    return DetectionArrays(pd_both, np.minimum(miss_shot, 1.0))  # rounding may exceed 1


def _pd_and_miss_any_two(
    shots: Any, pd: np.ndarray, miss: np.ndarray, magnitudes: np.ndarray
) -> DetectionArrays:
    """Compute :func:`shot_pd_and_miss` where detection in any two of three segments suffices."""
    if shots.speckle.segment_correlations is None:
        return DetectionArrays(at_least_two_of_three(pd, miss), at_least_two_of_three(miss, pd))
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
    near_ends = np.flatnonzero(speckle_table.ratio_row.any(axis=0))
    if near_ends.size:
        threshold_ratio = np.broadcast_to(threshold_ratio, shots.size)[near_ends]
        correlations = correlations[:, near_ends]
        pd_shot[near_ends], miss_shot[near_ends] = mean_over_phases(
            speckle_table.phase_factors[speckle_table.ratio_row[:, near_ends]],
            tuple(pd[:, near_ends]),
            lambda *pd: pd_and_miss_any_two_in_speckle(
                np.array(pd), 1 - np.array(pd), threshold_ratio, correlations
            ),
        )
    return DetectionArrays(pd_shot, miss_shot)
