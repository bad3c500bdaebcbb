"""Spectra of segments: spans of bins around the lines, detections and leakage, point by point.

A span holds |X| without noise in all bins around a segment's lines that may matter. Detection,
groups of bins, draws and pictures of spectra all use spans.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection.added_crossings import (
    SERIES_TERMS_MAX,
    any_crossing_probability,
    exclude_crossings_joining_echo,
    fill_crossing_series,
)
from sweep.model.detection.detection_probability import (
    detect_in_spans,
)
from sweep.model.detection.echo_detection import (
    BinThreshold,
    DetectionRule,
    PedestalShape,
    any_crossing_probability_in_chain,
    clear_image_exemptions,
)
from sweep.model.detection.looks import N_DRIFT_POSITIONS_MAX
from sweep.model.detection.speckle_crossing_rates import (
    RateTableGrid,
    allocate_rate_table,
    fill_rate_table,
    rate_table,
)
from sweep.model.ground import find_distinct_rows
from sweep.model.laser_line import gaussian_frequency_shifts
from sweep.model.preparation import LINE_APPROXIMATIONS_MAX, Shots
from sweep.model.spectrum import line_shape
from sweep.model.spectrum.bin_spectrum import (
    AveragingShifts,
    LineBundle,
    allocate_workspace,
    detect_in_span,
)
from sweep.model.spectrum.leakage import (
    GAUSS_POINTS_MAX,
    SPECKLE_POWER_MAX,
    LeakageInputs,
    detect_with_leakage,
    false_peak_probability_of_bins,
    false_peak_probability_of_bins_in_speckle,
)
from sweep.model.spectrum.line_shape import LineShapeTables, PhaseErrorModes
from sweep.model.spectrum.lines import (
    AMPLITUDE_TOLERANCES,
    COMPLEX_RECORD,
    NODES_MAX,
    POWER_TOLERANCES,
    REAL_WITH_IMAGES,
    REAL_WITHOUT_IMAGES,
    BeatParameters,
    PointParameters,
    SegmentParameters,
    SpectrumLayout,
    add_image_lines,
    allowed_relative_error,
    beat_parameters_at,
    compute_lines,
    fold_lines,
    n_required_nodes,
    phase_span_max_table,
    replace_lines_by_nodes,
    summarise_lines,
)
from sweep.model.spectrum.permanent_line import apply_permanent_line
from sweep.model.spectrum.search_restriction import restrict_to_band
from sweep.model.window import Window

POINTS_PER_BATCH = 256
"""Number of points that are processed in one batch. Batches are 16 times as large if all points
share few line shapes."""

SPAN_BINS_PER_BATCH = 1 << 21
"""Least number of bins, over all spans, for which memory is allocated in one step. A span is a
range of bins around a segment's lines."""

THRESHOLD_RATIO_STEP = 1e-7
"""Step to which the threshold over the noise sigma is rounded. Rates of false alarms due to leaked
signal in developed speckle are tabulated per rounded threshold."""

NO_LEAKAGE, LEAKAGE_BY_INTEGRAL, LEAKAGE_BIN_BY_BIN = range(3)
"""Methods for the probability of false alarms due to leaked signal. The first computes none. The
second counts all bins of the spectrum, with an integral over bins far from the lines. The third
counts only the computed bins that exceed a level."""


SPAN_DOES_NOT_FIT = np.int64(-1)
"""Result of :func:`_evaluate_segment` if a segment's bins exceed the allocated memory."""


class SegmentResults(NamedTuple):
    """Detection and false alarms in the noiseless spectra of the segments of n points.

    Arrays are (3, n): up, Doppler and down segment. They are nan in segments that do not exist.
    """

    pd: np.ndarray
    """Probability that the echo is detected, 0..1."""
    miss: np.ndarray
    """Probability that the echo is missed, 1 - pd, accurate even where it is small."""
    magnitude: np.ndarray
    """|X| of the echo's largest bin without noise [V, summed over the record]."""
    frequency: np.ndarray
    """Frequency of the echo's largest bin [Hz]; nan if the search band does not contain it."""
    n_exempt: np.ndarray
    """Number of bins that belong to the echo or are masked, and so cannot raise a false alarm."""
    leakage_probability: np.ndarray
    """Probability that leaked signal raises at least one extra false peak, over noise alone."""


def allocate_segment_results(n_points: int) -> SegmentResults:
    """Return results of ``n_points`` points that are nan in every segment."""
    return SegmentResults(*(np.full((3, n_points), np.nan) for _ in SegmentResults._fields))


class BinSpans(NamedTuple):
    """Bins around the lines of the segments of m points (spans), and the echoes in them.

    Arrays are (segments, m) unless another shape is stated. Segments that do not exist have no
    bins.
    """

    point_numbers: np.ndarray
    """(m,): indices of the points in the shots."""
    first_bin: np.ndarray
    """FFT bin number of the first bin of the span. For a complex record N or 2 N is added, N being
    the FFT size, so that no bin number is below 0.
    """
    n_bins: np.ndarray
    """Number of bins of the span, the computed bins around the lines."""
    peak_index: np.ndarray
    """Index of the bin with the largest magnitude, counted from the span's first bin."""
    n_exempt: np.ndarray
    """Number of bins that belong to the echo and so cannot raise a false alarm."""
    pd: np.ndarray
    """Probability that the echo is detected in the segment."""
    miss: np.ndarray
    """Probability that the echo is missed, 1 - pd, accurate even where it is small."""
    peak_magnitude: np.ndarray
    """Magnitude of the largest bin without noise [V, summed over the record]."""
    leakage_probability: np.ndarray
    """Probability that leaked signal raises at least one extra false peak, over noise alone. A
    false peak is a group of adjacent bins above the threshold.
    """
    raised_bin_probability_max: np.ndarray
    """Upper bound on the probability that leaked signal raises any bin above the threshold, one
    that joins the echo included. It is 1 where the bins that may be raised are not counted one by
    one: in developed speckle, with several looks, with a permanent line, and with a search band. It
    is 0 in segments that do not exist.
    """
    span_start: np.ndarray
    """Index in ``magnitudes`` and ``is_exempt`` of the first bin of each segment and point."""
    magnitudes: np.ndarray
    """(bins,): magnitudes without noise of all spans, one span after the other [V, summed over the
    record].
    """
    is_exempt: np.ndarray
    """(bins,) bool: true in bins that belong to an echo and so cannot raise a false alarm."""
    peak_is_searched: np.ndarray
    """Bool: true if the largest bin of the echo is in the search band. Otherwise the span does not
    contain that bin."""
    peak_is_masked: np.ndarray
    """Bool: true if a permanent line masks the largest bin of the echo, which is then not detected.
    """

    def span_magnitudes(self, segment: int, column: int) -> np.ndarray:
        """Return the magnitudes without noise of the bins around one segment's lines.

        Parameters
        ----------
        segment : int
            Index of the segment: 0 up, 1 Doppler, 2 down.
        column : int
            Index of the point in ``point_numbers``.

        Returns
        -------
        ndarray (bins,)
            |X| of the span's bins, first bin first [V, summed over the record].
        """
        span_begin = self.span_start[segment, column]
        return self.magnitudes[span_begin : span_begin + self.n_bins[segment, column]]


class SegmentSpectrum(NamedTuple):
    """Bin numbers and magnitudes of one segment's spectrum, without noise."""

    bins: np.ndarray
    """(bins,): consecutive bin numbers. Those of a complex record continue past Nyquist;
    :meth:`sweep.model.preparation.Shots.to_signed_bins` returns their frequencies."""
    magnitude: np.ndarray
    """(bins,): magnitude of the spectrum without noise [V, summed over the record]."""


class LineShapeGroup(NamedTuple):
    """Points whose line shapes are computed from the same tables.

    A line shape is the spectrum of a line of amplitude 1.
    """

    point_numbers: np.ndarray
    """(m,): indices of the points in the shots."""
    line_shape_index: np.ndarray
    """(m,): index in ``modes`` of each point's line shape."""
    tables: LineShapeTables
    """Tables from which the line shapes are computed."""
    modes: PhaseErrorModes
    """Chebyshev coefficients of the phase errors of the line shapes."""
    has_late_echoes: bool = False
    """True if some echoes arrive after the record has begun and lack its first samples."""


class DistinctLineShapes(NamedTuple):
    """One point for each line shape that occurs in a batch of points."""

    point_numbers: np.ndarray
    """(shapes,): index in the shots of one point per line shape."""
    line_shape_index: np.ndarray
    """(m,): index in ``point_numbers`` of the point that has the line shape of each point of the
    batch."""


class EvaluationSettings(NamedTuple):
    """Settings of :func:`_evaluate_points` that all points share."""

    segment_exists: np.ndarray
    """(segments,) bool: true if the up, Doppler or down segment exists."""
    leakage_methods: np.ndarray
    """(segments,): method for the probability of false alarms due to leaked signal: NO_LEAKAGE,
    LEAKAGE_BY_INTEGRAL or LEAKAGE_BIN_BY_BIN."""
    window_sum: float
    """Sum of the window's samples, the peak of its transform."""
    detection_rule: DetectionRule
    """Rule by which bins of an echo decide whether the echo is detected."""
    phase_span_max_table: np.ndarray
    """Table of :func:`sweep.model.spectrum.lines.phase_span_max_table` for the record's window. It
    gives the number of equivalent lines that replace all lines.
    """
    bin_tangents: np.ndarray
    """(N // 2 + 1,): tan(pi k / N) of bins k = 0 .. N/2, with the FFT size N."""


def evaluate_segments(shots: Shots, *, bin_by_bin: bool = False) -> SegmentResults:
    """Compute detection and false alarms due to leaked signal in each segment's spectrum.

    Parameters
    ----------
    shots : Shots
        n prepared shots.
    bin_by_bin : bool
        True to compute the leakage of each bin, even if an integral over bins is accurate.

    Returns
    -------
    SegmentResults
        Arrays (3, n).
    """
    results = allocate_segment_results(shots.size)
    bin_width = (shots.sample_rate / shots.fft_size) + np.zeros(shots.size)
    for spans in iter_spans(shots, bin_by_bin=bin_by_bin):
        for s in np.flatnonzero(shots.has_segment):
            frequency = (
                shots.to_signed_bins(spans.first_bin[s] + spans.peak_index[s])
                * bin_width[spans.point_numbers]
            )
            results.pd[s, spans.point_numbers] = spans.pd[s]
            results.miss[s, spans.point_numbers] = spans.miss[s]
            results.magnitude[s, spans.point_numbers] = spans.peak_magnitude[s]
            results.frequency[s, spans.point_numbers] = np.where(
                spans.peak_is_searched[s], frequency, np.nan
            )
            results.n_exempt[s, spans.point_numbers] = spans.n_exempt[s]
            results.leakage_probability[s, spans.point_numbers] = spans.leakage_probability[s]
    return results


def iter_spans(
    shots: Shots,
    *,
    points: np.ndarray | None = None,
    level_min: np.ndarray | None = None,
    leakage: bool = True,
    doppler_leakage: bool = False,
    bin_by_bin: bool = False,
    ignores_band: bool = False,
    computes_pd: bool = True,
) -> Iterator[BinSpans]:
    """Yield the spectra around the lines of all points, some points at a time, in any order.

    The adjacent bins around the lines of a segment are a span.

    Parameters
    ----------
    shots : Shots
        n prepared shots.
    points : ndarray (m,), optional
        Indices of the points; by default all.
    level_min : ndarray (n,) or (3, n), optional
        |X| [V, summed over the record] below which bins may be left out, of all segments or of each
        one; by default the threshold.
    leakage : bool
        True to compute leakage.
    doppler_leakage : bool
        True to compute leakage also in the Doppler segment. A false peak in that segment alone
        makes no false point.
    bin_by_bin : bool
        True to compute the leakage of each bin, even if an integral over bins is accurate.
    ignores_band : bool
        True to include bins that are not searched.
    computes_pd : bool
        False if probabilities of detection are not needed; they are then nan.

    Yields
    ------
    BinSpans
        Spans of some points.
    """
    parameters, parameters_by_segment = shots.point_parameters(), shots.segment_parameters()
    level_min = parameters.threshold if level_min is None else level_min
    levels_shape = len(shots.waveform_segments), shots.size
    chosen_points = np.arange(shots.size) if points is None else points
    for group in _iter_line_shape_groups(shots, chosen_points):
        leakage_method = _leakage_method(shots, group, bin_by_bin) if leakage else NO_LEAKAGE
        negligible_magnitude = (
            parameters.negligible_signal_ratio * parameters.noise_sigma
            if leakage_method == LEAKAGE_BIN_BY_BIN
            else np.inf
        )
        if shots.speckle.segment_correlations is not None:  # faint leakage of bright speckle counts
            negligible_magnitude = negligible_magnitude / math.sqrt(SPECKLE_POWER_MAX)
        lowest_levels = np.ascontiguousarray(
            np.broadcast_to(np.minimum(level_min, negligible_magnitude), levels_shape)
        )
        n_done = 0
        while n_done < group.point_numbers.size:
            spans = _evaluate_batch(
                shots,
                parameters,
                parameters_by_segment,
                lowest_levels,
                group,
                leakage_method
                * (
                    np.array([s.evaluates_leakage for s in shots.waveform_segments])
                    | doppler_leakage
                ),
                n_done,
            )
            n_done += spans.point_numbers.size
            spans = (
                spans
                if ignores_band
                else restrict_to_band(shots, _clear_spans_without_echo(shots, spans))
            )
            if not is_raised_bin_bound_valid(shots):
                spans = spans._replace(
                    raised_bin_probability_max=np.ones_like(spans.raised_bin_probability_max)
                )
            if shots.looks.is_noncoherent and leakage_method:
                spans = _apply_looks_to_leakage(shots, spans)
            if shots.permanent_line is not None:
                spans = apply_permanent_line(shots, spans)
            yield detect_in_spans(shots, spans) if computes_pd else spans


def is_raised_bin_bound_valid(shots: Shots) -> bool:
    """Return True if the computed ``raised_bin_probability_max`` is an upper bound; if not, 1 is.

    It is none for noncoherent looks, which have another law of crossings, and with a permanent line
    or a search band, which change the bins that may be raised: bins of an echo outside the band
    count as leaked signal.
    """
    return (
        not shots.looks.is_noncoherent
        and shots.permanent_line is None
        and shots.detection_settings.search_band is None
    )


def _clear_spans_without_echo(shots: Shots, spans: BinSpans) -> BinSpans:
    """Return spans without the bins of segments whose echo arrives after the record.

    The number of bins and the leakage of these segments are 0, and no peak is searched.
    """
    if shots.echo_record.n_samples_before_echo is None:
        return spans
    lacks_echo = (
        shots.echo_record.n_samples_before_echo[:, spans.point_numbers] >= shots.window.length
    ) & (spans.n_bins > 0)
    if not lacks_echo.any():
        return spans
    return spans._replace(
        n_bins=np.where(lacks_echo, 0, spans.n_bins),
        peak_index=np.where(lacks_echo, 0, spans.peak_index),
        n_exempt=np.where(lacks_echo, 0, spans.n_exempt),
        leakage_probability=np.where(lacks_echo, 0.0, spans.leakage_probability),
        peak_is_searched=spans.peak_is_searched & ~lacks_echo,
    )


def _apply_looks_to_leakage(shots: Shots, spans: BinSpans) -> BinSpans:
    """Return spans with the leakage of all looks of a shot in place of that of one record.

    A look is one of several records of the same segment. Leakage is a probability of false alarm.
    """
    negligible_signal_ratio, noise_sigma, threshold = (
        np.broadcast_to(value, shots.size)[spans.point_numbers]
        for value in (shots.negligible_signal_ratio, shots.bin_noise_sigma, shots.threshold)
    )
    leakage_in_looks, looks = spans.leakage_probability.copy(), shots.looks
    for s, column in (
        np.argwhere(spans.n_bins > 0)
        if shots.detection_settings.leakage_raises_false_alarms
        else ()
    ):
        if not shots.waveform_segments[s].evaluates_leakage:
            continue
        span_slice = slice(
            spans.span_start[s, column], spans.span_start[s, column] + spans.n_bins[s, column]
        )
        signal, is_exempt = (
            spans.magnitudes[span_slice] / noise_sigma[column],
            spans.is_exempt[span_slice],
        )
        signal_ratio_min = negligible_signal_ratio[column]
        powers, weights = np.ones(1), np.ones(1)
        if shots.speckle.segment_correlations is not None:
            powers, weights = looks.speckle_power_quadrature(
                shots.speckle.look_speckle, s, int(spans.point_numbers[column])
            )
            signal_ratio_min = negligible_signal_ratio[column] / math.sqrt(SPECKLE_POWER_MAX)
        is_counted = ~is_exempt & (signal >= signal_ratio_min)
        root_powers, crossing_probabilities = np.sqrt(powers), np.zeros((powers.size, signal.size))
        crossing_probabilities[:, is_counted] = np.minimum(
            looks.crossing_probability_added_by_signal(
                np.outer(root_powers, signal[is_counted]), threshold[column] / noise_sigma[column]
            ),
            1.0,
        )
        # Groups join by one record that detects as the looks do.
        equivalent_threshold_ratio = float(
            looks.equivalent_threshold_ratio(threshold[column] / noise_sigma[column])
        )
        sidelobe_neighbour_noise_correlation, mean_leakage = (
            shots.detection_rule.sidelobe_neighbour_noise_correlation,
            0.0,
        )
        for root_power, weight, probabilities in zip(
            root_powers, weights, crossing_probabilities, strict=True
        ):
            exclude_crossings_joining_echo(
                probabilities,
                0,
                probabilities.size,
                signal,
                is_exempt,
                1 / (looks.amplitude_gain_max * root_power),
                equivalent_threshold_ratio / (looks.amplitude_gain_max * root_power),
                sidelobe_neighbour_noise_correlation,
            )
            mean_leakage += weight * any_crossing_probability(probabilities, 0, probabilities.size)
        leakage_in_looks[s, column] = mean_leakage
    return spans._replace(leakage_probability=leakage_in_looks)


def segment_spectrum(
    shots: Shots, point: int, segment: int, *, level_min: float = 0.0
) -> SegmentSpectrum:
    """Return the echo's spectrum in one segment of one point, without noise and permanent line.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    point : int
        Index of the point.
    segment : int
        Index of the segment: up, Doppler, down.
    level_min : float
        |X| [V, summed over the record] below which bins may be left out; 0 returns all bins.

    Returns
    -------
    SegmentSpectrum
        Numbers and magnitudes of adjacent bins around the echo's lines.
    """
    shots = replace(shots, permanent_line=None)
    (spans,) = iter_spans(
        shots,
        points=np.array([point]),
        level_min=np.array([level_min]),
        leakage=False,
        ignores_band=True,
        computes_pd=False,
    )
    first_bin = int(spans.first_bin[segment, 0])
    magnitude = spans.span_magnitudes(segment, 0).copy()
    return SegmentSpectrum(np.arange(first_bin, first_bin + magnitude.size), magnitude)


def full_segment_spectrum(shots: Shots, point: int, segment: int) -> np.ndarray:
    """Return the magnitude of all bins of a segment without noise, by rising frequency.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    point : int
        Index of the point.
    segment : int
        Index of the segment: up, Doppler, down.

    Returns
    -------
    ndarray (bins,)
        |X| [V, summed over the record] of the bins
        :attr:`sweep.model.preparation.Shots.all_signed_bins`.
    """
    bins, magnitude = segment_spectrum(shots, point, segment)
    all_magnitudes = np.zeros(shots.n_bins)
    all_magnitudes[shots.bin_indices(bins)] = magnitude
    return all_magnitudes


def spectrum_type(shots: Shots) -> int:
    """Return the type of the shots' spectra for :class:`SpectrumLayout`, e.g. COMPLEX_RECORD."""
    return (
        COMPLEX_RECORD
        if shots.complex_record
        else REAL_WITH_IMAGES
        if shots.line_images.are_summed
        else REAL_WITHOUT_IMAGES
    )


def _leakage_method(shots: Shots, group: LineShapeGroup, bin_by_bin: bool) -> int:
    """Return the method by which the leakage of a group of points is computed, such as NO_LEAKAGE.

    ``bin_by_bin`` excludes LEAKAGE_BY_INTEGRAL.
    """
    layout = group.tables.layout
    if not shots.detection_settings.leakage_raises_false_alarms:
        return NO_LEAKAGE
    is_averaged = shots.laser_line.gaussian_fwhm is not None and not shots.footprint.adds_powers
    is_averaged |= (
        shots.looks.is_noncoherent
        or bin_by_bin
        or shots.detection_settings.search_band is not None
        or group.has_late_echoes
    )
    is_smooth = layout.fft_size == layout.record_length and not layout.holds_all_bins
    if is_smooth and not is_averaged and spectrum_type(shots) != COMPLEX_RECORD:
        return LEAKAGE_BY_INTEGRAL
    return LEAKAGE_BIN_BY_BIN


def _iter_line_shape_groups(shots: Shots, points: np.ndarray) -> Iterator[LineShapeGroup]:
    """Yield groups of points whose line shapes are computed from the same tables, in any order."""
    if shots.echo_record.n_samples_before_echo is not None:
        segment_exists = shots.has_segment
        is_late = (shots.echo_record.n_samples_before_echo[segment_exists][:, points] > 0).any(
            axis=0
        )
        yield from _iter_late_line_shape_groups(shots, points[is_late])
        points = points[~is_late]
    window, fft_size, adds_powers = shots.window, shots.fft_size, shots.footprint.adds_powers
    has_modes = line_shape.window_has_modes(window, fft_size)
    segments = len(shots.waveform_segments)
    lines_stand_still = shots.laser_line.gaussian_fwhm is None and not np.any(
        shots.motion.line_drift_per_look
    )
    has_few_shapes = lines_stand_still and (
        shots.echo_record.shots_share_phase_errors or not shots.echo_record.phase_errors
    )
    batch_size = 16 * POINTS_PER_BATCH if has_few_shapes else POINTS_PER_BATCH
    if not shots.echo_record.phase_errors:
        make_tables = line_shape.line_shape_tables if has_modes else _tables_without_phase_error
        tables = make_tables(window, fft_size, adds_powers, 0 if has_modes else segments)
        modes = line_shape.zero_phase_error_modes(segments, 1, 1)
        modes.re[:], modes.n_modes[:] = 1.0, 1
        for batch_begin in range(0, points.size, batch_size):
            batch = points[batch_begin : batch_begin + batch_size]
            yield LineShapeGroup(batch, 0 * batch, tables, modes)
        return
    for batch_begin in range(0, points.size, batch_size):
        batch = points[batch_begin : batch_begin + batch_size]
        distinct_points, line_shape_index = _find_distinct_line_shapes(shots, batch)
        remaining = np.arange(distinct_points.size)
        for tier in range(len(line_shape.LINE_SHAPE_TIERS) if has_modes else 0):
            n_nodes = 2 * line_shape.LINE_SHAPE_TIERS[tier].n_modes_max
            phase = _phase_errors(
                shots, distinct_points[remaining], line_shape.chebyshev_nodes(n_nodes)
            )
            modes = line_shape.zero_phase_error_modes(segments, phase.shape[1], n_nodes // 2)
            line_shape.decompose_phase_errors(
                phase, _NO_WINDOW, line_shape.chebyshev_coefficient_matrix(n_nodes), modes
            )
            is_resolved = np.asarray((modes.n_modes > 0).all(axis=0))
            table_index = np.full(distinct_points.size, -1)
            table_index[remaining[is_resolved]] = np.arange(np.count_nonzero(is_resolved))
            members = table_index[line_shape_index] >= 0
            if members.any():
                yield _sort_by_line_shape(
                    batch[members],
                    table_index[line_shape_index[members]],
                    line_shape.line_shape_tables(
                        window,
                        fft_size,
                        adds_powers,
                        tier,
                        shared=shots.echo_record.shots_share_phase_errors,
                    ),
                    modes.select(is_resolved),
                )
            remaining = remaining[~is_resolved]
            if not remaining.size:
                break
        for distinct in remaining:  # shapes whose tables hold all bins, one after the other
            record_positions = 2 * np.arange(window.length) / window.length - 1
            phase = _phase_errors(
                shots, distinct_points[distinct : distinct + 1], record_positions
            )[:, 0]
            members = batch[line_shape_index == distinct]
            yield LineShapeGroup(
                members,
                0 * members,
                line_shape.full_line_shape_tables(window, fft_size, adds_powers, phase),
                _unused_phase_error_modes(segments),
            )


_NO_WINDOW = np.empty((0, 0, 0))
"""Empty array of window values, for Chebyshev modes that do not include the window."""


def _unused_phase_error_modes(segments: int) -> PhaseErrorModes:
    """Return :class:`PhaseErrorModes` of one mode of amplitude 0, for shapes without modes."""
    modes = line_shape.zero_phase_error_modes(segments, 1, 1)
    modes.n_modes[:] = 1
    return modes


def _iter_late_line_shape_groups(shots: Shots, points: np.ndarray) -> Iterator[LineShapeGroup]:
    """Yield groups of points with late echoes and common tables of line shapes, in any order."""
    window, fft_size, adds_powers = shots.window, shots.fft_size, shots.footprint.adds_powers
    segment_exists, segments = shots.has_segment, len(shots.waveform_segments)
    assert shots.echo_record.n_samples_before_echo is not None
    lacks_echo = (
        shots.echo_record.n_samples_before_echo[segment_exists][:, points] >= window.length
    ).all(axis=0)
    if lacks_echo.any():
        tables = _tables_without_echo(window, fft_size, adds_powers, segments)
        batch = points[lacks_echo]
        yield LineShapeGroup(
            batch, 0 * batch, tables, _unused_phase_error_modes(segments), has_late_echoes=True
        )
        points = points[~lacks_echo]
    for batch_begin in range(0, points.size, POINTS_PER_BATCH):
        batch = points[batch_begin : batch_begin + POINTS_PER_BATCH]
        distinct_points, line_shape_index = _find_distinct_line_shapes(shots, batch)
        echo_lengths = window.length - shots.echo_record.n_samples_before_echo[:, distinct_points]
        echo_lengths[~segment_exists] = echo_lengths[segment_exists][0]
        length_min, length_max = echo_lengths.min(axis=0), echo_lengths.max(axis=0)
        length_classes = line_shape.late_echo_length_classes(window, length_min)
        is_remaining = np.ones(distinct_points.size, np.bool_)
        for tier in range(len(line_shape.LINE_SHAPE_TIERS)):
            is_tried = is_remaining & line_shape.late_echo_has_modes(
                window, fft_size, tier, length_min, length_max
            )
            for length_class in np.unique(length_classes[is_tried]).tolist():
                selected = np.flatnonzero(is_tried & (length_classes == length_class))
                n_nodes = 2 * line_shape.LINE_SHAPE_TIERS[tier].n_modes_max
                record_positions = line_shape.chebyshev_nodes(n_nodes)
                phase = _phase_errors(shots, distinct_points[selected], record_positions)
                window_values = line_shape.window_over_last_samples(
                    window, record_positions, echo_lengths[:, selected]
                )
                modes = line_shape.zero_phase_error_modes(segments, phase.shape[1], n_nodes // 2)
                line_shape.decompose_phase_errors(
                    phase, window_values, line_shape.chebyshev_coefficient_matrix(n_nodes), modes
                )
                is_resolved = np.asarray((modes.n_modes > 0).all(axis=0))
                table_index = np.full(distinct_points.size, -1)
                table_index[selected[is_resolved]] = np.arange(np.count_nonzero(is_resolved))
                is_remaining[selected[is_resolved]] = False
                members = table_index[line_shape_index] >= 0
                if members.any():
                    tables = line_shape.late_line_shape_tables(
                        window, fft_size, adds_powers, tier, length_class
                    )
                    tables = tables._replace(
                        echo_lengths=np.ascontiguousarray(echo_lengths[:, selected[is_resolved]])
                    )
                    group = _sort_by_line_shape(
                        batch[members],
                        table_index[line_shape_index[members]],
                        tables,
                        modes.select(is_resolved),
                    )
                    yield group._replace(has_late_echoes=True)
        for distinct in np.flatnonzero(is_remaining):  # shapes whose tables hold all bins
            selected = batch[line_shape_index == distinct]
            first_sample = window.length - echo_lengths[:, distinct]
            phase = np.zeros((segments, window.length))
            for s in np.flatnonzero(segment_exists & (echo_lengths[:, distinct] > 0)):
                record_positions = (
                    2 * np.arange(echo_lengths[s, distinct]) / echo_lengths[s, distinct] - 1
                )
                phase[s, first_sample[s] :] = _phase_errors(
                    shots, distinct_points[distinct : distinct + 1], record_positions
                )[s, 0]
            yield LineShapeGroup(
                selected,
                0 * selected,
                line_shape.full_line_shape_tables(
                    window, fft_size, adds_powers, phase, first_sample
                ),
                _unused_phase_error_modes(segments),
                has_late_echoes=True,
            )


@lru_cache(maxsize=2)
def _tables_without_phase_error(
    window: Window, fft_size: int, adds_powers: bool, segments: int
) -> LineShapeTables:
    """Return line-shape tables that hold all bins, for records without a phase error."""
    return line_shape.full_line_shape_tables(
        window, fft_size, adds_powers, np.zeros((segments, window.length))
    )


@lru_cache(maxsize=2)
def _tables_without_echo(
    window: Window, fft_size: int, adds_powers: bool, segments: int
) -> LineShapeTables:
    """Return line-shape tables of zeros, for echoes that arrive after the record."""
    phase, first_sample = np.zeros((segments, window.length)), np.full(segments, window.length)
    return line_shape.full_line_shape_tables(window, fft_size, adds_powers, phase, first_sample)


def _sort_by_line_shape(
    points: np.ndarray,
    line_shape_index: np.ndarray,
    tables: LineShapeTables,
    modes: PhaseErrorModes,
) -> LineShapeGroup:
    """Return a :class:`LineShapeGroup` whose points are sorted by line shape.

    Sorting makes points of the same line shape adjacent, so that the shape is computed once.
    """
    order = np.argsort(line_shape_index, kind="stable")
    return LineShapeGroup(points[order], line_shape_index[order], tables, modes)


def _find_distinct_line_shapes(shots: Shots, batch: np.ndarray) -> DistinctLineShapes:
    """Return one point for each line shape that occurs in a batch of points.

    A line shape is the spectrum of a line of amplitude 1.
    """
    first_samples = (
        ()
        if shots.echo_record.n_samples_before_echo is None
        else shots.echo_record.n_samples_before_echo[shots.has_segment]
    )
    values_of_points = (
        np.broadcast_to(np.asarray(entry, float), shots.size)[batch]
        for value in (
            *first_samples,
            *(
                error_value
                for error in shots.echo_record.phase_errors
                for error_value in error.arguments.values()
            ),
        )
        for entry in (value if isinstance(value, tuple) else (value,))
    )
    varying = (
        error_value for error_value in values_of_points if (error_value != error_value[0]).any()
    )
    first_varying = next(varying, None)
    if first_varying is None:
        return DistinctLineShapes(batch[:1], np.zeros(batch.size, np.int64))
    if not shots.echo_record.shots_share_phase_errors:
        return DistinctLineShapes(batch, np.arange(batch.size))
    first_of_shape, line_shape_index = find_distinct_rows([first_varying, *varying])
    return DistinctLineShapes(batch[first_of_shape], line_shape_index)


def _phase_errors(shots: Shots, points: np.ndarray, record_positions: np.ndarray) -> np.ndarray:
    """Return the phase errors of the echoes' beats [cycles], summed over all causes.

    The shape is (segments, points, positions). ``record_positions`` from -1 to 1 are positions in
    the part of the record that contains the echo.
    """
    phase = np.zeros((len(shots.waveform_segments), points.size, record_positions.size))
    for segment in np.flatnonzero(shots.has_segment):
        for error in shots.echo_record.phase_errors:
            arguments = error.select_arguments(int(segment), points)
            phase[segment] += error.phase_function(
                record_positions,
                sign=shots.waveform_segments[segment].chirp_rate_ratio,
                **arguments,
            )
    return phase


def _evaluate_batch(
    shots: Shots,
    parameters: PointParameters,
    parameters_by_segment: SegmentParameters,
    lowest_levels: np.ndarray,
    group: LineShapeGroup,
    leakage_methods: np.ndarray,
    batch_begin: int,
) -> BinSpans:
    """Compute the spectra around the lines for the next batch of a group. Return `BinSpans`.

    The batch begins with the group's point number ``batch_begin``. It has as many points as fit
    into SPAN_BINS_PER_BATCH bins, at least one. The points of a group share the tables of line
    shapes. ``parameters`` and ``parameters_by_segment`` hold the values of all n points of
    the shots, not only of the batch. ``lowest_levels`` (3, n) are the magnitudes [V] below which
    bins may be left out, and ``leakage_methods`` (3,) the methods for the leakage of the segments.
    """
    points, tables = np.ascontiguousarray(group.point_numbers[batch_begin:]), group.tables
    segments, n_points = len(shots.waveform_segments), points.size
    shifts = _averaging_shifts(shots, points)
    n_lines_max = max(2 * shots.footprint.n_beamlets, NODES_MAX) * max(shifts.offset.shape[2], 1)
    width = max(n_lines_max, shots.n_bins, 2 * GAUSS_POINTS_MAX) + 16
    n_kept = max(SPAN_BINS_PER_BATCH, segments * shots.n_bins)
    shape = segments, n_points
    spans = BinSpans(
        point_numbers=points,
        first_bin=np.zeros(shape, np.int64),
        n_bins=np.zeros(shape, np.int64),
        peak_index=np.zeros(shape, np.int64),
        n_exempt=np.zeros(shape, np.int64),
        pd=np.full(shape, np.nan),
        miss=np.full(shape, np.nan),
        peak_magnitude=np.full(shape, np.nan),
        leakage_probability=np.full(shape, np.nan),
        raised_bin_probability_max=np.repeat(1.0 * shots.has_segment[:, None], n_points, axis=1),
        span_start=np.zeros(shape, np.int64),
        magnitudes=np.empty(n_kept),
        is_exempt=np.empty(n_kept, np.bool_),
        peak_is_searched=np.ones(shape, np.bool_),
        peak_is_masked=np.zeros(shape, np.bool_),
    )
    n_done = _evaluate_points(
        parameters,
        parameters_by_segment,
        lowest_levels,
        shots.beamlet_arrays,
        np.ascontiguousarray(shots.footprint.row_of_point, np.int64),
        np.ascontiguousarray(group.line_shape_index[batch_begin:]),
        shifts,
        group.modes,
        tables._replace(layout=tables.layout._replace(spectrum_type=spectrum_type(shots))),
        EvaluationSettings(
            segment_exists=shots.has_segment,
            leakage_methods=leakage_methods,
            window_sum=shots.window.sum,
            detection_rule=shots.detection_rule,
            phase_span_max_table=_phase_span_max_table_of_group(shots, group),
            bin_tangents=bin_tangents(shots.fft_size),
        ),
        line_shape.allocate_line_shapes(tables, segments),
        allocate_workspace(width),
        np.empty(SERIES_TERMS_MAX),
        allocate_rate_table(
            _rounded_threshold_ratios(parameters.threshold[points], parameters.noise_sigma[points])
            if shots.detection_rule.in_speckle and leakage_methods.any()
            else np.empty(0)
        ),
        spans,
    )
    if n_done == n_points:
        return spans
    return spans._replace(
        point_numbers=points[:n_done],
        **{
            name: np.ascontiguousarray(values[:, :n_done])
            for name, values in spans._asdict().items()
            if values.ndim == 2
        },
    )


def _phase_span_max_table_of_group(shots: Shots, group: LineShapeGroup) -> np.ndarray:
    """Return the table that gives the number of equivalent lines for a group of points.

    The table is that of :func:`sweep.model.spectrum.lines.phase_span_max_table`, for the record's
    window. For late echoes the table is for a window with all its weight at the record's end.
    """
    if not group.has_late_echoes:
        return shots.window.phase_span_max_table(shots.footprint.adds_powers)
    tolerances = POWER_TOLERANCES if shots.footprint.adds_powers else AMPLITUDE_TOLERANCES
    return phase_span_max_table((0.0, 1.0), tolerances)


@lru_cache(maxsize=4)
def bin_tangents(fft_size: int) -> np.ndarray:
    """Return tan(pi k / N) of bins k = 0 .. N/2, (N // 2 + 1,), for the FFT size N."""
    return np.tan(np.pi * np.arange(fft_size // 2 + 1) / fft_size)


def _averaging_shifts(shots: Shots, points: np.ndarray) -> AveragingShifts:
    """Return the :class:`AveragingShifts` over which power spectra are averaged.

    The arrays are (points, segments, shifts), without shifts if there is no average. Shifts result
    from the laser's line width, and from the drift of lines over looks. Shifts of weight 0 are the
    last ones.
    """
    segments = len(shots.waveform_segments)
    if shots.laser_line.gaussian_fwhm is None:
        offset_rows, weight_rows = np.empty((points.size, 0)), np.empty((points.size, 0))
    else:
        duration = np.broadcast_to(shots.record.duration, shots.size)[points]
        shifts = gaussian_frequency_shifts(
            fwhm=shots.laser_line.gaussian_fwhm[points], duration=duration
        )
        padding_factor = shots.fft_size / shots.window.length
        offset_rows, weight_rows = padding_factor * shifts.shift_window_bins, shifts.weight
        # A point has shifts of weight 0 if another point has a wider line.
        order = np.argsort(weight_rows == 0, axis=1, kind="stable")
        offset_rows, weight_rows = (
            np.take_along_axis(rows, order, axis=1) for rows in (offset_rows, weight_rows)
        )
    offset, weight = (
        np.repeat(rows[:, None], segments, axis=1) for rows in (offset_rows, weight_rows)
    )
    drift = np.broadcast_to(shots.motion.line_drift_per_look, (segments, shots.size))[:, points].T
    if shots.looks.n_power_averaged == 1 or not np.any(shots.motion.line_drift_per_look):
        return AveragingShifts(offset, weight)
    if not offset.shape[2]:
        offset, weight = np.zeros((*drift.shape, 1)), np.ones((*drift.shape, 1))
    # Looks that follow each other closely are replaced by a few with the same mean square.
    n_looks = shots.looks.number
    n_positions = min(n_looks, N_DRIFT_POSITIONS_MAX)
    positions = (np.arange(n_positions) - (n_positions - 1) / 2) * math.sqrt(
        (n_looks**2 - 1) / (n_positions**2 - 1)
    )
    return AveragingShifts(
        (offset[..., None] + drift[..., None, None] * positions).reshape(*drift.shape, -1),
        np.repeat(weight / n_positions, n_positions, axis=2),
    )


@njit(cache=True, error_model="numpy", borrows=True, inline="always")
def _copy_lines_to_shifts(lines, n_lines, shifts):
    """Copy lines to several shifted frequencies; return the number of all copies.

    The powers of the lines add. The copies average the power spectrum over the shifts.

    Parameters
    ----------
    lines
        :class:`sweep.model.spectrum.lines.LineArrays`. The copies are written to it, and the first
        ``n_lines`` are replaced.
    n_lines
        Number of lines.
    shifts
        :class:`sweep.model.spectrum.bin_spectrum.AveragingShifts`.
    """
    for copy in range(shifts.offset.size - 1, -1, -1):  # the lines themselves are the first copy
        for line in range(n_lines):
            lines.position[copy * n_lines + line] = lines.position[line] + shifts.offset[copy]
            lines.re[copy * n_lines + line] = lines.re[line] * shifts.weight[copy]
            lines.im[copy * n_lines + line] = 0.0
    return n_lines * shifts.offset.size


@njit(cache=True, error_model="numpy", borrows=True, inline="always")
def _compute_equivalent_lines(
    beat,
    segment,
    footprint_row,
    beamlets,
    line_shift,
    shifts,
    image_gain,
    window_sum,
    bin_error_allowed,
    threshold,
    phase_span_max_table,
    layout,
    workspace,
):
    """Compute the lines of one segment, and replace them by fewer equivalent lines.

    Parameters
    ----------
    beat
        :class:`sweep.model.spectrum.lines.BeatParameters` of the segment.
    segment
        Index of the segment: 0 up, 1 Doppler, 2 down.
    footprint_row
        Row of the footprint in ``beamlets``.
    beamlets
        :class:`sweep.model.spectrum.lines.BeamletArrays`.
    line_shift
        Shift of all lines by the phase error [bins of fs/L].
    shifts
        :class:`sweep.model.spectrum.bin_spectrum.AveragingShifts`; lines whose powers add are
        copied at each shift.
    image_gain
        Amplitude of the I/Q image of a line over that of the line; 0 if there is none.
    window_sum
        Sum of the window's samples.
    bin_error_allowed
        Error that the equivalent lines may make in |X| [V, summed over the record]; 0 if lines are
        not to be replaced.
    threshold
        Threshold on |X| [V, summed over the record].
    phase_span_max_table
        :func:`sweep.model.spectrum.lines.phase_span_max_table`.
    layout
        :class:`sweep.model.spectrum.lines.SpectrumLayout`.
    workspace
        :class:`sweep.model.spectrum.bin_spectrum.SpectrumWorkspace`; the lines go to
        ``line_spectrum.lines``.

    Returns
    -------
    LineBundle
        Number, extent and weight of the lines.
    """
    lines, nodes, scratch = (
        workspace.line_spectrum.lines,
        workspace.nodes,
        workspace.line_spectrum.line_scratch,
    )
    adds_powers = layout.adds_powers
    origin_bin = compute_lines(
        beat,
        segment,
        beamlets,
        footprint_row,
        layout,
        lines,
        workspace.inverse_gain_re,
        workspace.inverse_gain_im,
    )
    n_lines = beamlets.relative_range_offset.shape[1]
    shift_bins = line_shift * layout.fft_size / layout.record_length
    for line in range(n_lines):
        lines.position[line] += shift_bins
    if image_gain > 0.0:
        n_lines = add_image_lines(lines, n_lines, origin_bin, image_gain, adds_powers)
    summary = summarise_lines(lines, n_lines, adds_powers, scratch.batch)
    if max(-summary.lowest_position, summary.highest_position) > 0.5 * layout.fft_size:
        fold_lines(lines, n_lines, layout)  # lines are farther apart than there are bins
        summary = summarise_lines(lines, n_lines, adds_powers, scratch.batch)
    weight_sum = math.sqrt(summary.magnitude_sum) if adds_powers else summary.magnitude_sum
    n_copies = shifts.offset.size if adds_powers else 0
    for copy_pass in range(2 if n_copies else 1):
        if copy_pass == 1:
            n_lines = _copy_lines_to_shifts(lines, n_lines, shifts)
            summary = summarise_lines(lines, n_lines, adds_powers, scratch.batch)
        half_width = 0.5 * (summary.highest_position - summary.lowest_position)
        if n_lines > 2 and bin_error_allowed > 0.0:
            error_allowed = allowed_relative_error(
                summary, n_lines, adds_powers, window_sum, bin_error_allowed, threshold
            )
            phase_per_bin = (
                np.pi * layout.record_length / layout.fft_size * (2.0 if adds_powers else 1.0)
            )
            n_nodes = n_required_nodes(
                phase_per_bin * half_width, error_allowed, phase_span_max_table
            )
            if 4 * n_nodes < 3 * n_lines and n_nodes <= NODES_MAX:
                middle = 0.5 * (summary.lowest_position + summary.highest_position)
                n_lines = replace_lines_by_nodes(
                    lines, n_lines, n_nodes, middle, half_width, scratch, nodes
                )
                for line in range(n_lines):
                    lines.position[line] = nodes.position[line]
                    lines.re[line], lines.im[line] = nodes.re[line], nodes.im[line]
    return LineBundle(
        origin_bin, n_lines, summary.lowest_position, summary.highest_position, weight_sum
    )


@njit(cache=True, error_model="numpy", borrows=True, inline="always")
def _store_span(start, n_bins, span, magnitudes, is_exempt):
    """Append a span, the computed bins around a segment's lines, to the spans of earlier points.

    Parameters
    ----------
    start : int
        Index in the arrays of all spans at which the span begins.
    n_bins : int
        Number of bins of the span.
    span : SpanArrays
        Magnitudes of the span's bins, and which of them belong to an echo
        (:class:`sweep.model.spectrum.bin_spectrum.SpanArrays`).
    magnitudes : ndarray (bins,)
        Result: |X| without noise of all spans [V, summed over the record].
    is_exempt : ndarray (bins,) bool
        Result: True in bins of an echo, of all spans.

    Returns
    -------
    int
        Index after the span, at which the next one begins.
    """
    for k in range(n_bins):
        magnitudes[start + k], is_exempt[start + k] = span.magnitude[k], span.is_exempt[k]
    return start + n_bins


@njit(cache=True, error_model="numpy", borrows=True)
def _beat_parameters_of_late_echo(beat, n_missing_samples):
    """Return the beat parameters of an echo that lacks the record's first ``n_missing_samples``."""
    return BeatParameters(
        beat.range,
        beat.range_decrease_since_shot_start,
        beat.doppler_ratio,
        beat.start_time,
        beat.chirp_rate,
        beat.carrier,
        beat.amplitude,
        beat.detector_bandwidth,
        beat.amplifier_bandwidth,
        beat.sample_rate,
        beat.record_start + n_missing_samples / beat.sample_rate,
    )


@njit(cache=True, error_model="numpy", borrows=True)
def _layout_of_late_echo(layout, n_samples):
    """Return the layout of a spectrum for an echo with ``n_samples`` of the record's samples."""
    return SpectrumLayout(
        layout.fft_size,
        n_samples,
        layout.table_half_width_bins,
        layout.cells_per_bin,
        layout.adds_powers,
        layout.holds_all_bins,
        layout.clearance_bins,
        layout.spectrum_type,
    )


@njit(cache=True, error_model="numpy")
def _fill_line_shapes(line_shape_index, built_index, modes, tables, segment_exists, shapes):
    """Compute the line shapes of all segments of a point.

    Parameters
    ----------
    line_shape_index : int
        Index of the line shape in ``modes``.
    built_index : int
        Index of the line shape that is in ``shapes`` already, or -1; not used for late echoes.
    modes : PhaseErrorModes
        Chebyshev modes of the phase errors
        (:class:`sweep.model.spectrum.line_shape.PhaseErrorModes`).
    tables : LineShapeTables
        Tables of the window and FFT size
        (:class:`sweep.model.spectrum.line_shape.LineShapeTables`).
    segment_exists : ndarray (segments,) bool
        True for the segments that exist. Others are left out.
    shapes : LineShape
        Result: line shapes of the segments, with a leading dimension
        (:class:`sweep.model.spectrum.line_shape.LineShape`).
    """
    is_late = tables.echo_lengths.size > 0
    for s in range(segment_exists.size):
        if not segment_exists[s]:
            continue
        shape = line_shape.select_segment(shapes, s)
        if not is_late:
            line_shape.build_line_shape(s, line_shape_index, built_index, modes, tables, shape)
            continue
        same_segment = line_shape.first_segment_of_same_line_shape(
            s, line_shape_index, modes, tables.echo_lengths, segment_exists
        )
        if same_segment >= 0:
            line_shape.copy_line_shape(shapes, same_segment, s)
        else:
            line_shape.build_late_line_shape(s, line_shape_index, modes, tables, shape)


@njit(cache=True, error_model="numpy", borrows=True, inline="always")
def _evaluate_segment(
    s,
    i,
    next_start,
    parameters,
    parameters_by_segment,
    lowest_levels,
    beamlets,
    footprint_row,
    line_shape_index,
    averaging_shifts,
    modes,
    tables,
    settings,
    shape,
    workspace,
    crossing_series,
    speckle_rates,
    spans,
):
    """Compute the spectrum, the echo's bins and the leakage of one segment of one point.

    Parameters
    ----------
    s : int
        Index of the segment: up, Doppler, down.
    i : int
        Index of the point in ``spans.point_numbers``.
    next_start : int
        Index in ``spans.magnitudes`` of the segment's first bin.
    parameters : PointParameters
        Parameters (n,) of all n points (:class:`sweep.model.spectrum.lines.PointParameters`).
    parameters_by_segment : SegmentParameters
        Parameters (segments, n) of all points
        (:class:`sweep.model.spectrum.lines.SegmentParameters`).
    lowest_levels : ndarray (3, n)
        |X| [V, summed over the record] below which bins may be left out.
    beamlets : BeamletArrays
        Beamlets of all footprints (:class:`sweep.model.spectrum.lines.BeamletArrays`).
    footprint_row : ndarray (n,) int64
        Row of each point's footprint in ``beamlets``.
    line_shape_index : ndarray (m,) int64
        Index of each evaluated point's line shape in ``modes``.
    averaging_shifts : AveragingShifts
        Frequency shifts (m, segments, shifts) over which |X|^2 is averaged [bins]. Shifts of weight
        0 are the last ones.
    modes : PhaseErrorModes
        Chebyshev coefficients of the phase errors
        (:class:`sweep.model.spectrum.line_shape.PhaseErrorModes`).
    tables : LineShapeTables
        Tables of the window (:class:`sweep.model.spectrum.line_shape.LineShapeTables`).
    settings : EvaluationSettings
        Settings common to all points.
    shape : LineShape
        Line shape of this segment (:class:`sweep.model.spectrum.line_shape.LineShape`).
    workspace : SpectrumWorkspace
        Scratch arrays, overwritten (:class:`sweep.model.spectrum.bin_spectrum.SpectrumWorkspace`).
    crossing_series : ndarray (SERIES_TERMS_MAX,)
        :func:`sweep.model.detection.added_crossings.fill_crossing_series` of the point's threshold
        over sigma, the noise of a bin per quadrature.
    speckle_rates : SpeckleCrossingRates
        Crossing rates of the point at the same threshold, used in developed speckle.
    spans : BinSpans
        Bins around the lines of m points. Its arrays for this point and segment are results.

    Returns
    -------
    next_start : int
        Index of the next span's first bin; SPAN_DOES_NOT_FIT if this span does not fit.
    """
    point, rule, span = spans.point_numbers[i], settings.detection_rule, workspace.span
    leakage_method = settings.leakage_methods[s]
    noise_sigma, threshold = parameters.noise_sigma[point], parameters.threshold[point]
    image_gain = parameters.image_gain[point]
    negligible_signal_ratio = parameters.negligible_signal_ratio[point]
    bin_error_allowed = (
        parameters.line_error_tolerance[point] * noise_sigma / LINE_APPROXIMATIONS_MAX
    )
    bin_threshold = BinThreshold(
        parameters.line_noise_sigma[point],
        threshold,
        noise_sigma,
        parameters.noise_sigma_next_to_lines[point],
        PedestalShape(
            parameters.pedestal_reach_bins[point],
            parameters.pedestal_line_width_bins[point],
            parameters.pedestal_delay_bin_width_product[point],
        ),
    )
    inputs = LeakageInputs(
        noise_sigma,
        threshold,
        parameters.leakage_tolerance[point],
        rule.sidelobe_neighbour_noise_correlation,
    )
    lobe_half_width = max(rule.lobe_half_width, int(bin_threshold.pedestal.reach_bins))
    beat = beat_parameters_at(parameters, parameters_by_segment, s, point)
    layout = tables.layout
    if tables.echo_lengths.size > 0:  # the samples that a late echo has are a record of their own
        n_samples = tables.echo_lengths[s, line_shape_index[i]]
        beat = _beat_parameters_of_late_echo(beat, layout.record_length - n_samples)
        layout = _layout_of_late_echo(layout, n_samples)
    n_shifts = 0
    while (
        n_shifts < averaging_shifts.weight.shape[2] and averaging_shifts.weight[i, s, n_shifts] != 0
    ):
        n_shifts += 1
    shifts = AveragingShifts(
        averaging_shifts.offset[i, s, :n_shifts], averaging_shifts.weight[i, s, :n_shifts]
    )
    bundle = _compute_equivalent_lines(
        beat,
        s,
        footprint_row[point],
        beamlets,
        modes.line_shift[s, line_shape_index[i]],
        shifts,
        image_gain,
        settings.window_sum,
        bin_error_allowed,
        threshold,
        settings.phase_span_max_table,
        layout,
        workspace,
    )
    if leakage_method == LEAKAGE_BY_INTEGRAL:
        detected = detect_with_leakage(
            bundle,
            bin_error_allowed,
            inputs,
            SPECKLE_POWER_MAX if rule.in_speckle else 1.0,
            lobe_half_width,
            shape,
            layout,
            settings.bin_tangents,
            workspace,
            crossing_series,
            speckle_rates,
        )
    else:
        n_averaged = 0 if layout.adds_powers else n_shifts  # else the lines are copied
        detected = detect_in_span(
            bundle,
            bin_error_allowed,
            threshold,
            lowest_levels[s, point],
            lobe_half_width,
            AveragingShifts(shifts.offset[:n_averaged], shifts.weight[:n_averaged]),
            shape,
            layout,
            settings.bin_tangents,
            workspace,
        )
    first_bin, n_bins = detected.first_bin, detected.n_bins
    n_exempt, leakage = detected.n_exempt, detected.leakage_probability
    raised_bin_probability_max = detected.raised_bin_probability_max
    if image_gain > 0.0:
        n_exempt = clear_image_exemptions(
            span.magnitude[:n_bins],
            span.is_exempt[:n_bins],
            first_bin,
            layout.fft_size,
            image_gain,
        )
    if next_start + n_bins > spans.magnitudes.size:
        return SPAN_DOES_NOT_FIT
    spans.span_start[s, i] = next_start
    next_start = _store_span(next_start, n_bins, span, spans.magnitudes, spans.is_exempt)
    if leakage_method == LEAKAGE_BIN_BY_BIN:
        if rule.in_speckle:
            leakage = false_peak_probability_of_bins_in_speckle(
                n_bins,
                inputs,
                negligible_signal_ratio / math.sqrt(SPECKLE_POWER_MAX),
                span,
                speckle_rates,
            )
        else:
            probability = false_peak_probability_of_bins(
                n_bins, inputs, negligible_signal_ratio, span, crossing_series
            )
            leakage = probability.leakage_probability
            raised_bin_probability_max = probability.raised_bin_probability_max
            if image_gain > 0.0 and rule.neighbour_crossing_quadrature.sine.size > 0:
                leakage = any_crossing_probability_in_chain(
                    span.crossing_probability, n_bins, rule.neighbour_crossing_quadrature
                )
    if layout.spectrum_type == COMPLEX_RECORD:  # no bin of a span is below 0
        first_bin += layout.fft_size
    spans.first_bin[s, i], spans.n_bins[s, i] = first_bin, n_bins
    spans.peak_index[s, i], spans.n_exempt[s, i] = detected.peak_index, n_exempt
    spans.peak_magnitude[s, i] = span.magnitude[detected.peak_index]
    spans.leakage_probability[s, i] = leakage
    spans.raised_bin_probability_max[s, i] = raised_bin_probability_max
    return next_start


@njit(cache=True, error_model="numpy", borrows=True)
def _rounded_threshold_ratio(threshold_ratio):
    """Return a threshold over the noise, rounded to a multiple of THRESHOLD_RATIO_STEP.

    Shot noise of echoes makes thresholds over the noise differ slightly. One table serves all
    thresholds that are equal after rounding.
    """
    return math.floor(threshold_ratio / THRESHOLD_RATIO_STEP + 0.5) * THRESHOLD_RATIO_STEP


def _rounded_threshold_ratios(threshold: np.ndarray, noise_sigma: np.ndarray) -> np.ndarray:
    """Return thresholds over the noise, (n,), rounded to multiples of THRESHOLD_RATIO_STEP."""
    return np.floor(threshold / noise_sigma / THRESHOLD_RATIO_STEP + 0.5) * THRESHOLD_RATIO_STEP


@njit(cache=True, error_model="numpy", borrows=True)
def _evaluate_points(
    parameters,
    parameters_by_segment,
    lowest_levels,
    beamlets,
    footprint_row,
    line_shape_index,
    averaging_shifts,
    modes,
    tables,
    settings,
    shapes,
    workspace,
    crossing_series,
    rate_arrays,
    spans,
):
    """Compute the bins around the lines (span) of the first of m points, until memory is full.

    The result is the number of points that are done. Memory is the size of the arrays in ``spans``.

    Parameters
    ----------
    parameters
        :class:`sweep.model.spectrum.lines.PointParameters` of all n points.
    parameters_by_segment
        :class:`sweep.model.spectrum.lines.SegmentParameters` of all n points.
    lowest_levels
        (n,): |X| [V, summed over the record] below which bins may be left out.
    beamlets
        :class:`sweep.model.spectrum.lines.BeamletArrays` of all footprints.
    footprint_row
        (n,): row of each point's footprint in ``beamlets``.
    line_shape_index
        (m,): index of each point's line shape in ``modes``.
    averaging_shifts
        :class:`sweep.model.spectrum.bin_spectrum.AveragingShifts` (m, segments, shifts). Shifts of
        weight 0 are the last ones.
    modes
        :class:`sweep.model.spectrum.line_shape.PhaseErrorModes`.
    tables
        :class:`sweep.model.spectrum.line_shape.LineShapeTables`, whose layout has the type of the
        spectra.
    settings
        :class:`EvaluationSettings`.
    shapes
        :class:`sweep.model.spectrum.line_shape.LineShape` (segments, ...), overwritten.
    workspace
        :class:`sweep.model.spectrum.bin_spectrum.SpectrumWorkspace`, overwritten.
    crossing_series
        (SERIES_TERMS_MAX,): scratch.
    rate_arrays
        :class:`sweep.model.detection.speckle_crossing_rates.RateTableArrays`, overwritten.
    spans
        :class:`BinSpans` of the m points in ``spans.point_numbers``. The other fields are results,
        except the probabilities of detection and the flags of the peaks.
    """
    next_start, rule = np.int64(0), settings.detection_rule
    rate_grid = RateTableGrid(0.0, 1.0, np.int64(0), np.int64(0))
    previous_ratio, built_index = -1.0, np.int64(-1)  # numba would compile anew for a literal -1
    for i in range(spans.point_numbers.size):
        point = spans.point_numbers[i]
        if line_shape_index[i] != built_index:
            _fill_line_shapes(
                line_shape_index[i], built_index, modes, tables, settings.segment_exists, shapes
            )
            built_index = line_shape_index[i]
        threshold_ratio = parameters.threshold[point] / parameters.noise_sigma[point]
        if rule.in_speckle:
            threshold_ratio = _rounded_threshold_ratio(threshold_ratio)
        if settings.leakage_methods.any() and threshold_ratio != previous_ratio:
            previous_ratio = threshold_ratio
            fill_crossing_series(previous_ratio, crossing_series)
            if rule.in_speckle:
                rate_grid = fill_rate_table(previous_ratio, crossing_series, rate_arrays)
        for s in range(settings.segment_exists.size):
            if settings.segment_exists[s]:
                next_start = _evaluate_segment(
                    s,
                    i,
                    next_start,
                    parameters,
                    parameters_by_segment,
                    lowest_levels,
                    beamlets,
                    footprint_row,
                    line_shape_index,
                    averaging_shifts,
                    modes,
                    tables,
                    settings,
                    line_shape.select_segment(shapes, s),
                    workspace,
                    crossing_series,
                    rate_table(rate_grid, rate_arrays),
                    spans,
                )
                if next_start == SPAN_DOES_NOT_FIT:
                    return i
    return spans.point_numbers.size
