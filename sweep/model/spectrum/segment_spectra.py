"""Segments of shots: from lines to runs of bins, detections and leakage, point by point.

A run holds |X| without noise in every bin around a segment's lines that may matter. Whoever looks
at spectra (detection, groups, draws, pictures) looks at runs.
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
    exclude_bins_joining_echo,
    fill_crossing_series,
)
from sweep.model.detection.echo_detection import (
    BinThreshold,
    Detection,
    EchoBins,
    PedestalShape,
    any_crossing_of_chain,
    bin_speckle_at,
    clear_image_exemptions,
    pd_and_miss,
)
from sweep.model.detection.looks import DRIFT_POSITIONS_MAX
from sweep.model.detection.speckle_crossing_rates import (
    empty_crossing_rates,
    tabulate_crossing_rates,
)
from sweep.model.ground import distinct_rows
from sweep.model.laser_line import gaussian_frequency_shifts
from sweep.model.preparation import LINE_APPROXIMATIONS_MAX, Shots
from sweep.model.spectrum import line_shape
from sweep.model.spectrum.bin_spectrum import (
    A_IM,
    A_RE,
    CHANCE,
    COMPLEX_RECORD,
    LINE_BATCH_CELLS_MAX,
    N_SCRATCH_ROWS,
    OUT,
    REAL_WITH_IMAGES,
    REAL_WITHOUT_IMAGES,
    detect_in_span,
)
from sweep.model.spectrum.leakage import (
    GAUSS_POINTS_MAX,
    SPECKLE_POWER_MAX,
    detect_with_leakage,
    leakage_of_bins,
    leakage_of_bins_in_speckle,
)
from sweep.model.spectrum.line_shape import LineShapeTables
from sweep.model.spectrum.lines import (
    AMPLITUDE_TOLERANCES,
    IM,
    NODES_MAX,
    PLACE,
    POWER_TOLERANCES,
    RE,
    SCRATCH_WIDTH_MIN,
    X,
    add_image_lines,
    allowed_relative_error,
    compute_lines,
    count_nodes,
    fold_lines,
    node_phase_limits,
    replace_lines_by_nodes,
    summarise_lines,
)
from sweep.model.spectrum.permanent_line import apply_permanent_line
from sweep.model.spectrum.search_restriction import restrict_to_band
from sweep.model.window import Window

POINTS_PER_BATCH = 256
"""Points that are prepared together; 16 times as many where few line shapes serve them all."""

SPAN_BINS_PER_BATCH = 1 << 21
"""Bins of runs that are kept at a time, at least."""

THRESHOLD_RATIO_STEP = 1e-7
"""Step to which thresholds [sigma] are rounded for rates of leakage in developed speckle."""

SEGMENT_FIELDS = ("pd", "miss", "magnitude", "frequency", "exempted", "leakage")
"""Values found for each segment's spectrum."""

NO_LEAKAGE, LEAKAGE_BY_INTEGRAL, LEAKAGE_BIN_BY_BIN = range(3)
"""Ways to look at leakage: not at all; all bins, those far away as an integral; those of the run
that stand above a floor."""


class BinSpans(NamedTuple):
    """Runs of bins around the lines of some points' segments, and what stands in them.

    Arrays are (segments, m) for m points; count is 0 in segments that there are not.
    """

    point_numbers: np.ndarray
    """(m,): which points of the shots these are."""
    first_bin: np.ndarray
    """First bin; of complex records N more than its frequency says, or twice as many, so that no
    bin of a run is below 0."""
    n_bins: np.ndarray
    """Bins in the run."""
    peak_index: np.ndarray
    """Place of the largest bin in the run."""
    n_exempt: np.ndarray
    """Bins that can't raise a false alarm."""
    pd: np.ndarray
    miss: np.ndarray
    peak_magnitude: np.ndarray
    """|X| of the largest bin."""
    leakage: np.ndarray
    """Probability that leaked signal raises at least one extra group, over noise alone."""
    span_start: np.ndarray
    """Begin of each run in the arrays that follow."""
    magnitudes: np.ndarray
    """|X| of all runs, one after the other."""
    is_exempt: np.ndarray
    """Bins of them that can't raise a false alarm, bool."""
    peak_is_searched: np.ndarray
    """True where the largest bin of all is searched, bool; else it is in no run."""

    def span_magnitudes(self, segment: int, column: int) -> np.ndarray:
        """|X| of one run, (count,)."""
        span_begin = self.span_start[segment, column]
        return self.magnitudes[span_begin : span_begin + self.n_bins[segment, column]]


class ShapeGroup(NamedTuple):
    """Points whose line shapes are made of the same modes."""

    point_numbers: np.ndarray
    """(m,): which points."""
    shape_index: np.ndarray
    """(m,): shape of each."""
    tables: LineShapeTables
    line_shift: np.ndarray
    """(segments, u): shift of the lines [bins of fs/L]."""
    mode_coefficients: np.ndarray
    """(segments, u, 2, k): real and imaginary parts."""
    n_modes: np.ndarray
    """(segments, u): modes that count."""
    is_late: bool = False
    """True where echoes have part of the record's samples."""


def evaluate_segments(shots: Shots, *, bin_by_bin: bool = False) -> np.ndarray:
    """Evaluate each segment's spectrum: (3, fields, n) by segment and SEGMENT_FIELDS.

    ``bin_by_bin``: look at each bin by itself where leakage could be summed as an integral.
    """
    results = np.full((3, len(SEGMENT_FIELDS), shots.size), np.nan)
    bin_width = (shots.sample_rate / shots.fft_size) + np.zeros(shots.size)
    for spans in iter_spans(shots, bin_by_bin=bin_by_bin, keeps_magnitudes=False):
        for s in np.flatnonzero(shots.has_segment):
            frequency = (
                shots.to_signed_bins(spans.first_bin[s] + spans.peak_index[s])
                * bin_width[spans.point_numbers]
            )
            results[s][:, spans.point_numbers] = (
                spans.pd[s],
                spans.miss[s],
                spans.peak_magnitude[s],
                np.where(spans.peak_is_searched[s], frequency, np.nan),
                spans.n_exempt[s],
                spans.leakage[s],
            )
    return results


def iter_spans(
    shots: Shots,
    *,
    points: np.ndarray | None = None,
    level_min: np.ndarray | None = None,
    leakage: bool = True,
    bin_by_bin: bool = False,
    keeps_magnitudes: bool = True,
    ignores_band: bool = False,
    with_pd: bool = True,
) -> Iterator[BinSpans]:
    """Yield runs of all points, or of those in ``points``, some points at a time, in any order.

    Bins below ``level_min`` (n,) [V, summed over the record], by default the threshold, may be left
    out. With ``bin_by_bin`` each bin is looked at by itself where leakage could be summed as an
    integral; ``keeps_magnitudes`` hands magnitudes on; ``ignores_band`` has bins that are not
    searched as well. Without ``with_pd`` the probabilities of a detection are nan.
    """
    point_rows = shots.point_parameter_table()
    point_levels = point_rows[11] if level_min is None else np.broadcast_to(level_min, shots.size)
    chosen_points = np.arange(shots.size) if points is None else points
    for group in _iter_shape_groups(shots, chosen_points):
        leakage_method = _leakage_method(shots, group, bin_by_bin) if leakage else NO_LEAKAGE
        negligible_magnitude = (
            point_rows[12] * point_rows[10] if leakage_method == LEAKAGE_BIN_BY_BIN else np.inf
        )
        if shots.speckle.segment_correlations is not None:  # faint leakage of bright speckle counts
            negligible_magnitude = negligible_magnitude / math.sqrt(SPECKLE_POWER_MAX)
        lowest_levels, n_done = np.minimum(point_levels, negligible_magnitude), 0
        while n_done < group.point_numbers.size:
            must_keep = keeps_magnitudes or (shots.looks.is_noncoherent and bool(leakage_method))
            must_keep |= (
                shots.permanent_line is not None or shots.detection_settings.search_band is not None
            )
            spans, n_computed = _evaluate_batch(
                shots, point_rows, lowest_levels, group, leakage_method, n_done, must_keep, with_pd
            )
            spans = (
                spans
                if ignores_band
                else restrict_to_band(shots, _clear_spans_without_echo(shots, spans))
            )
            spans = (
                _apply_looks(shots, spans, bool(leakage_method))
                if shots.looks.is_noncoherent
                else spans
            )
            yield (spans if shots.permanent_line is None else apply_permanent_line(shots, spans))
            n_done += n_computed


def _clear_spans_without_echo(shots: Shots, spans: BinSpans) -> BinSpans:
    """Empty the runs of segments whose echo has no sample of the record: nothing is detected."""
    if shots.echo_record.n_samples_before is None:
        return spans
    lacks_echo = (
        shots.echo_record.n_samples_before[:, spans.point_numbers] >= shots.window.length
    ) & (spans.n_bins > 0)
    if not lacks_echo.any():
        return spans
    return spans._replace(
        n_bins=np.where(lacks_echo, 0, spans.n_bins),
        peak_index=np.where(lacks_echo, 0, spans.peak_index),
        n_exempt=np.where(lacks_echo, 0, spans.n_exempt),
        pd=np.where(lacks_echo, 0.0, spans.pd),
        miss=np.where(lacks_echo, 1.0, spans.miss),
        leakage=np.where(lacks_echo, 0.0, spans.leakage),
        peak_is_searched=spans.peak_is_searched & ~lacks_echo,
    )


def _apply_looks(shots: Shots, spans: BinSpans, leakage: bool) -> BinSpans:
    """Replace one record's probabilities in runs by those of several looks."""
    negligible_signal_ratio, noise_sigma, threshold = (
        np.broadcast_to(value, shots.size)[spans.point_numbers]
        for value in (shots.negligible_signal_ratio, shots.bin_noise_sigma, shots.threshold)
    )
    leakage_in_looks, looks = spans.leakage.copy(), shots.looks
    for s, column in (
        np.argwhere(spans.n_bins > 0)
        if leakage and shots.detection_settings.includes_leakage
        else ()
    ):
        if not shots.waveform_segments[s].includes_leakage:
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
            looks.added_crossing_probability(
                np.outer(root_powers, signal[is_counted]), threshold[column] / noise_sigma[column]
            ),
            1.0,
        )
        # Groups join by one record that detects as the looks do.
        equivalent_threshold_ratio = float(
            looks.equivalent_threshold_ratio(threshold[column] / noise_sigma[column])
        )
        sidelobe_correlation, mean_leakage = shots.detection_rule.sidelobe_correlation, 0.0
        for root_power, weight, probabilities in zip(
            root_powers, weights, crossing_probabilities, strict=True
        ):
            sigma_and_threshold = (
                1 / (looks.amplitude_gain_max * root_power),
                equivalent_threshold_ratio / (looks.amplitude_gain_max * root_power),
            )
            exclude_bins_joining_echo(
                probabilities,
                0,
                probabilities.size,
                signal,
                is_exempt,
                sigma_and_threshold,
                sidelobe_correlation,
            )
            mean_leakage += weight * any_crossing_probability(probabilities, 0, probabilities.size)
        leakage_in_looks[s, column] = mean_leakage
    pd, miss = shots.pd_and_miss_in_looks(
        spans.peak_magnitude, spans.first_bin + spans.peak_index, spans.point_numbers
    )
    pd, miss = (
        np.where(spans.peak_is_searched, pd, 0.0),
        np.where(spans.peak_is_searched, miss, 1.0),
    )
    return spans._replace(pd=pd, miss=miss, leakage=leakage_in_looks)


def segment_spectrum(shots: Shots, point: int, segment: int, *, level_min: float = 0.0) -> tuple:
    """Bins of a segment in which the echo stands above a level, and |X| there, without noise.

    Bins rise from one to the next. Those of a complex record go on past Nyquist:
    :meth:`sweep.model.preparation.Shots.to_signed_bins` tells their frequencies. Bins below the
    level [V, summed over the record] may be left out; 0 gives all.
    """
    shots = replace(shots, permanent_line=None)
    (spans,) = iter_spans(
        shots,
        points=np.array([point]),
        level_min=np.array([level_min]),
        leakage=False,
        ignores_band=True,
        with_pd=False,
    )
    first_bin = int(spans.first_bin[segment, 0])
    magnitude = spans.span_magnitudes(segment, 0).copy()
    return np.arange(first_bin, first_bin + magnitude.size), magnitude


def full_segment_spectrum(shots: Shots, point: int, segment: int) -> np.ndarray:
    """|X| of all bins of a segment without noise [V], (bins,), in the order of their frequencies.

    Bins are those of :attr:`sweep.model.preparation.Shots.all_signed_bins`.
    """
    bins, magnitude = segment_spectrum(shots, point, segment)
    all_magnitudes = np.zeros(shots.n_bins)
    all_magnitudes[shots.bin_indices(bins)] = magnitude
    return all_magnitudes


def spectrum_type(shots: Shots) -> int:
    """Return the view of a spectrum that shots have: FOLDED, IMAGED or COMPLEX."""
    return (
        COMPLEX_RECORD
        if shots.complex_record
        else REAL_WITH_IMAGES
        if shots.images.are_summed
        else REAL_WITHOUT_IMAGES
    )


def _leakage_method(shots: Shots, group: ShapeGroup, bin_by_bin: bool) -> int:
    tables = group.tables
    if not shots.detection_settings.includes_leakage:
        return NO_LEAKAGE
    is_averaged = shots.laser_line.gaussian_width is not None and not shots.footprint.adds_powers
    is_averaged |= (
        shots.looks.is_noncoherent
        or bin_by_bin
        or shots.detection_settings.search_band is not None
        or group.is_late
    )
    is_smooth = tables.layout[0] == tables.layout[1] and not tables.layout[5]
    if is_smooth and not is_averaged and spectrum_type(shots) != COMPLEX_RECORD:
        return LEAKAGE_BY_INTEGRAL
    return LEAKAGE_BIN_BY_BIN


def _iter_shape_groups(shots: Shots, points: np.ndarray) -> Iterator[ShapeGroup]:
    """Yield groups of points whose line shapes can be computed together, in any order."""
    if shots.echo_record.n_samples_before is not None:
        segment_exists = shots.has_segment
        is_late = (shots.echo_record.n_samples_before[segment_exists][:, points] > 0).any(axis=0)
        yield from _iter_late_shape_groups(shots, points[is_late])
        points = points[~is_late]
    window, fft_size, adds_powers = shots.window, shots.fft_size, shots.footprint.adds_powers
    has_modes = line_shape.window_has_modes(window, fft_size)
    segments = len(shots.waveform_segments)
    lines_stand_still = shots.laser_line.gaussian_width is None and not np.any(
        shots.motion.line_drift_per_look
    )
    has_few_shapes = lines_stand_still and (
        shots.echo_record.shares_phase_errors or not shots.echo_record.phase_errors
    )
    batch_size = 16 * POINTS_PER_BATCH if has_few_shapes else POINTS_PER_BATCH
    if not shots.echo_record.phase_errors:
        make_tables = line_shape.line_shape_tables if has_modes else _tables_without_phase_error
        tables = make_tables(window, fft_size, adds_powers, 0 if has_modes else segments)
        mode_coefficients = np.zeros((segments, 1, 2, 1))
        mode_coefficients[:, :, 0] = 1.0
        n_modes = np.ones((segments, 1), np.int64)
        line_shift = np.zeros((segments, 1))
        for batch_begin in range(0, points.size, batch_size):
            batch = points[batch_begin : batch_begin + batch_size]
            yield ShapeGroup(batch, 0 * batch, tables, line_shift, mode_coefficients, n_modes)
        return
    for batch_begin in range(0, points.size, batch_size):
        batch = points[batch_begin : batch_begin + batch_size]
        distinct_points, shape_index = _find_distinct_shapes(shots, batch)
        remaining = np.arange(distinct_points.size)
        for tier in range(len(line_shape.MODE_TIERS) if has_modes else 0):
            n_nodes = 2 * line_shape.MODE_TIERS[tier][0]
            phase = _phase_errors(
                shots, distinct_points[remaining], line_shape.chebyshev_nodes(n_nodes)
            )
            line_shift = np.zeros(phase.shape[:2])
            n_modes = np.zeros(phase.shape[:2], np.int64)
            mode_coefficients = np.zeros((*phase.shape[:2], 2, n_nodes // 2))
            line_shape.decompose_phase_errors(
                phase,
                _NO_WEIGHT,
                line_shape.chebyshev_coefficient_matrix(n_nodes),
                line_shift,
                mode_coefficients,
                n_modes,
            )
            is_resolved = (n_modes > 0).all(axis=0)
            table_index = np.full(distinct_points.size, -1)
            table_index[remaining[is_resolved]] = np.arange(np.count_nonzero(is_resolved))
            members = table_index[shape_index] >= 0
            if members.any():
                yield _sort_by_shape(
                    batch[members],
                    table_index[shape_index[members]],
                    line_shape.line_shape_tables(
                        window,
                        fft_size,
                        adds_powers,
                        tier,
                        shared=shots.echo_record.shares_phase_errors,
                    ),
                    line_shift[:, is_resolved],
                    mode_coefficients[:, is_resolved],
                    n_modes[:, is_resolved],
                )
            remaining = remaining[~is_resolved]
            if not remaining.size:
                break
        for distinct in remaining:  # tables of all bins, one after the other
            record_positions = 2 * np.arange(window.length) / window.length - 1
            phase = _phase_errors(
                shots, distinct_points[distinct : distinct + 1], record_positions
            )[:, 0]
            members = batch[shape_index == distinct]
            yield ShapeGroup(
                members,
                0 * members,
                line_shape.full_line_shape_tables(window, fft_size, adds_powers, phase),
                np.zeros((segments, 1)),
                np.zeros((segments, 1, 2, 1)),
                np.ones((segments, 1), np.int64),
            )


_NO_WEIGHT = np.empty((0, 0, 0))


def _iter_late_shape_groups(shots: Shots, points: np.ndarray) -> Iterator[ShapeGroup]:
    """Yield groups of points whose echoes have part of the record's samples, in any order."""
    window, fft_size, adds_powers = shots.window, shots.fft_size, shots.footprint.adds_powers
    segment_exists, segments = shots.has_segment, len(shots.waveform_segments)
    assert shots.echo_record.n_samples_before is not None
    lacks_echo = (
        shots.echo_record.n_samples_before[segment_exists][:, points] >= window.length
    ).all(axis=0)
    if lacks_echo.any():
        tables = _tables_without_echo(window, fft_size, adds_powers, segments)
        no_modes = np.zeros((segments, 1)), np.zeros((segments, 1, 2, 1))
        batch = points[lacks_echo]
        yield ShapeGroup(
            batch, 0 * batch, tables, *no_modes, np.ones((segments, 1), np.int64), True
        )
        points = points[~lacks_echo]
    for batch_begin in range(0, points.size, POINTS_PER_BATCH):
        batch = points[batch_begin : batch_begin + POINTS_PER_BATCH]
        distinct_points, shape_index = _find_distinct_shapes(shots, batch)
        echo_lengths = window.length - shots.echo_record.n_samples_before[:, distinct_points]
        echo_lengths[~segment_exists] = echo_lengths[segment_exists][0]
        length_min, length_max = echo_lengths.min(axis=0), echo_lengths.max(axis=0)
        length_classes = line_shape.late_length_class(window, length_min)
        is_remaining = np.ones(distinct_points.size, np.bool_)
        for tier in range(len(line_shape.MODE_TIERS)):
            is_tried = is_remaining & line_shape.late_echo_has_modes(
                window, fft_size, tier, length_min, length_max
            )
            for length_class in np.unique(length_classes[is_tried]).tolist():
                selected = np.flatnonzero(is_tried & (length_classes == length_class))
                n_nodes = 2 * line_shape.MODE_TIERS[tier][0]
                record_positions = line_shape.chebyshev_nodes(n_nodes)
                phase = _phase_errors(shots, distinct_points[selected], record_positions)
                window_values = line_shape.late_window_samples(
                    window, record_positions, echo_lengths[:, selected]
                )
                line_shift = np.zeros(phase.shape[:2])
                n_modes = np.zeros(phase.shape[:2], np.int64)
                mode_coefficients = np.zeros((*phase.shape[:2], 2, n_nodes // 2))
                line_shape.decompose_phase_errors(
                    phase,
                    window_values,
                    line_shape.chebyshev_coefficient_matrix(n_nodes),
                    line_shift,
                    mode_coefficients,
                    n_modes,
                )
                is_resolved = (n_modes > 0).all(axis=0)
                table_index = np.full(distinct_points.size, -1)
                table_index[selected[is_resolved]] = np.arange(np.count_nonzero(is_resolved))
                is_remaining[selected[is_resolved]] = False
                members = table_index[shape_index] >= 0
                if members.any():
                    tables = line_shape.late_line_shape_tables(
                        window, fft_size, adds_powers, tier, length_class
                    )
                    tables = tables._replace(
                        echo_lengths=np.ascontiguousarray(echo_lengths[:, selected[is_resolved]])
                    )
                    group = _sort_by_shape(
                        batch[members],
                        table_index[shape_index[members]],
                        tables,
                        line_shift[:, is_resolved],
                        mode_coefficients[:, is_resolved],
                        n_modes[:, is_resolved],
                    )
                    yield group._replace(is_late=True)
        for distinct in np.flatnonzero(is_remaining):  # tables of all bins, one after the other
            selected = batch[shape_index == distinct]
            first_sample = window.length - echo_lengths[:, distinct]
            phase = np.zeros((segments, window.length))
            for s in np.flatnonzero(segment_exists & (echo_lengths[:, distinct] > 0)):
                record_positions = (
                    2 * np.arange(echo_lengths[s, distinct]) / echo_lengths[s, distinct] - 1
                )
                phase[s, first_sample[s] :] = _phase_errors(
                    shots, distinct_points[distinct : distinct + 1], record_positions
                )[s, 0]
            yield ShapeGroup(
                selected,
                0 * selected,
                line_shape.full_line_shape_tables(
                    window, fft_size, adds_powers, phase, first_sample
                ),
                np.zeros((segments, 1)),
                np.zeros((segments, 1, 2, 1)),
                np.ones((segments, 1), np.int64),
                is_late=True,
            )


@lru_cache(maxsize=2)
def _tables_without_phase_error(
    window: Window, fft_size: int, adds_powers: bool, segments: int
) -> LineShapeTables:
    """Tables of all bins of lines without a phase error."""
    return line_shape.full_line_shape_tables(
        window, fft_size, adds_powers, np.zeros((segments, window.length))
    )


@lru_cache(maxsize=2)
def _tables_without_echo(
    window: Window, fft_size: int, adds_powers: bool, segments: int
) -> LineShapeTables:
    """Tables of all bins of echoes that have no sample of the record."""
    phase, first_sample = np.zeros((segments, window.length)), np.full(segments, window.length)
    return line_shape.full_line_shape_tables(window, fft_size, adds_powers, phase, first_sample)


def _sort_by_shape(
    points: np.ndarray,
    shape_index: np.ndarray,
    tables: LineShapeTables,
    line_shift: np.ndarray,
    mode_coefficients: np.ndarray,
    n_modes: np.ndarray,
) -> ShapeGroup:
    """Points by their shapes, so that each of these is made once."""
    order = np.argsort(shape_index, kind="stable")
    mode_arrays = map(np.ascontiguousarray, (line_shift, mode_coefficients, n_modes))
    return ShapeGroup(
        points[order],
        shape_index[order],
        tables,
        next(mode_arrays),
        next(mode_arrays),
        next(mode_arrays),
    )


def _find_distinct_shapes(shots: Shots, batch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of which no two have the same line shapes; which of these each of some points has."""
    first_samples = (
        ()
        if shots.echo_record.n_samples_before is None
        else shots.echo_record.n_samples_before[shots.has_segment]
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
        return batch[:1], np.zeros(batch.size, np.int64)
    if not shots.echo_record.shares_phase_errors:
        return batch, np.arange(batch.size)
    first_of_shape, shape_index = distinct_rows([first_varying, *varying])
    return batch[first_of_shape], shape_index


def _phase_errors(shots: Shots, points: np.ndarray, record_positions: np.ndarray) -> np.ndarray:
    """Phase errors [cycles] of points at places x of the record, (segments, points, places).

    Of the part of it that the echo has, where it has not all.
    """
    phase = np.zeros((len(shots.waveform_segments), points.size, record_positions.size))
    for segment in np.flatnonzero(shots.has_segment):
        for error in shots.echo_record.phase_errors:
            arguments = error.select_arguments(int(segment), points)
            phase[segment] += error.phase(
                record_positions, sign=shots.waveform_segments[segment].chirp_slope, **arguments
            )
    return phase


def _evaluate_batch(
    shots: Shots,
    point_rows: np.ndarray,
    lowest_levels: np.ndarray,
    group: ShapeGroup,
    leakage_method: int,
    batch_begin: int,
    keeps_magnitudes: bool,
    with_pd: bool,
) -> tuple[BinSpans, int]:
    """Compute spans of as many points from ``batch_begin`` on as fit in. Return their number."""
    points = group.point_numbers[batch_begin:]
    segments, n_points = len(shots.waveform_segments), points.size
    spectrum_bins = shots.n_bins
    shifts = _averaging_shifts(shots, points)
    n_lines_max = max(2 * shots.footprint.n_beamlets, NODES_MAX) * max(shifts.shape[3], 1)
    scratch_width = (
        max(
            n_lines_max,
            spectrum_bins,
            2 * GAUSS_POINTS_MAX,
            SCRATCH_WIDTH_MIN,
            LINE_BATCH_CELLS_MAX,
        )
        + 16
    )
    n_kept = max(SPAN_BINS_PER_BATCH, segments * spectrum_bins) if keeps_magnitudes else 0
    span_numbers = np.zeros((5, segments, n_points), np.int64)
    span_values = np.full((4, segments, n_points), np.nan)
    magnitudes, is_exempt = np.empty(n_kept), np.empty(n_kept, np.bool_)
    tables = group.tables
    table_size = line_shape.table_row_size(tables.layout)
    outlines = np.zeros((segments, 7, tables.envelope_distances.shape[1]))
    outlines[:, 0] = tables.envelope_distances[0]
    rule = shots.detection_rule
    n_done = _evaluate_points(
        np.ascontiguousarray(point_rows[:, points].T),
        np.stack([shots.footprint.row_of_point[points], group.shape_index[batch_begin:], points]),
        shots.beamlet_table,
        (group.line_shift, group.mode_coefficients, group.n_modes, shifts),
        tables._replace(
            layout=np.append(tables.layout, (spectrum_type(shots), rule.lobe_half_width))
        ),
        (_group_node_limits(shots, group), bin_tangents(shots.fft_size)),
        (
            shots.has_segment,
            lowest_levels[points],
            np.array(
                [leakage_method * segment.includes_leakage for segment in shots.waveform_segments]
            ),
            shots.window.sum,
            rule,
            shots.speckle_table,
            with_pd,
        ),
        (np.empty((segments, 2, table_size)), outlines),
        (
            np.empty((N_SCRATCH_ROWS, scratch_width)),
            np.empty(scratch_width, np.bool_),
            np.empty(SERIES_TERMS_MAX),
        ),
        (span_numbers, span_values, magnitudes, is_exempt),
    )
    first_bin, n_bins, peak_index, n_exempt, span_start = span_numbers[:, :, :n_done]
    pd, miss, peak_magnitude, leakage = span_values[:, :, :n_done]
    return BinSpans(
        points[:n_done],
        first_bin,
        n_bins,
        peak_index,
        n_exempt,
        pd,
        miss,
        peak_magnitude,
        leakage,
        span_start,
        magnitudes,
        is_exempt,
        np.ones(first_bin.shape, np.bool_),
    ), n_done


def _group_node_limits(shots: Shots, group: ShapeGroup) -> np.ndarray:
    """Limits of nodes of the record's window; of part of it, as if all were at the record's end."""
    if not group.is_late:
        return shots.window.node_phase_limits(shots.footprint.adds_powers)
    tolerances = POWER_TOLERANCES if shots.footprint.adds_powers else AMPLITUDE_TOLERANCES
    return node_phase_limits((0.0, 1.0), tolerances)


@lru_cache(maxsize=4)
def bin_tangents(fft_size: int) -> np.ndarray:
    """tan(pi k / N) for k = 0 .. N/2, (N // 2 + 1,)."""
    return np.tan(np.pi * np.arange(fft_size // 2 + 1) / fft_size)


def _averaging_shifts(shots: Shots, points: np.ndarray) -> np.ndarray:
    """Shifts [bins of fs/N] over which |X|^2 is averaged, and weights, (points, segments, 2, k)."""
    segments = len(shots.waveform_segments)
    if shots.laser_line.gaussian_width is None:
        shift_rows = np.empty((points.size, 2, 0))
    else:
        duration = np.broadcast_to(shots.record.duration, shots.size)[points]
        shifts = gaussian_frequency_shifts(
            fwhm=shots.laser_line.gaussian_width[points], duration=duration
        )
        padding_factor = shots.fft_size / shots.window.length
        shift_rows = np.stack([padding_factor * shifts.offset_window_bins, shifts.weight], axis=1)
        # Those of no weight, which wider lines beside a point bring, go to the end.
        order = np.argsort(shift_rows[:, 1:] == 0, axis=2, kind="stable")
        shift_rows = np.take_along_axis(
            shift_rows, np.broadcast_to(order, shift_rows.shape), axis=2
        )
    by_segment = np.repeat(shift_rows[:, None], segments, axis=1)
    drift = np.broadcast_to(shots.motion.line_drift_per_look, (segments, shots.size))[:, points].T
    if shots.looks.n_power_averaged == 1 or not drift.any():
        return by_segment
    if not by_segment.shape[3]:
        by_segment = np.tile([[0.0], [1.0]], (*drift.shape, 1, 1))
    # Of looks that follow each other closely some stand for all, of the same mean square.
    n_looks = shots.looks.number
    n_positions = min(n_looks, DRIFT_POSITIONS_MAX)
    positions = (np.arange(n_positions) - (n_positions - 1) / 2) * math.sqrt(
        (n_looks**2 - 1) / (n_positions**2 - 1)
    )
    moved_shifts = (
        by_segment[..., :1, :, None] + drift[..., None, None, None] * positions
    ).reshape(*drift.shape, 1, -1)
    weight = np.repeat(by_segment[..., 1:, :] / n_positions, n_positions, axis=3)
    return np.concatenate([moved_shifts, weight], axis=2)


@njit(cache=True, error_model="numpy", borrows=True)
def _prepare_lines(
    point,
    segment_and_row,
    footprint,
    line_shift,
    averaging_shifts,
    window_sum,
    phase_limits,
    layout,
    scratch,
):
    """Lines of a point's segment into rows PLACE .., few for many; origin, number, survey."""
    segment, footprint_row = segment_and_row
    adds_powers = layout[4] != 0
    origin_bin = compute_lines(point, segment, footprint, footprint_row, layout, scratch)
    n_lines = footprint.shape[2]
    shift_bins = line_shift * layout[0] / layout[1]
    for line in range(n_lines):
        scratch[PLACE, line] += shift_bins
    if point[16] > 0.0:
        n_lines = add_image_lines(scratch, n_lines, origin_bin, point[16], adds_powers)
    magnitude_sum, power_sum, lowest_position, highest_position = summarise_lines(
        scratch, n_lines, adds_powers
    )
    if (
        max(-lowest_position, highest_position) > 0.5 * layout[0]
    ):  # lines further apart than there are bins
        fold_lines(scratch, n_lines, layout)
        magnitude_sum, power_sum, lowest_position, highest_position = summarise_lines(
            scratch, n_lines, adds_powers
        )
    weight_sum = math.sqrt(magnitude_sum) if adds_powers else magnitude_sum
    n_copies = averaging_shifts.shape[1] if adds_powers else 0
    for copy_pass in range(2 if n_copies else 1):
        if copy_pass == 1:  # copies of the lines at each shift
            for copy in range(n_copies - 1, -1, -1):
                for line in range(n_lines):
                    scratch[PLACE, copy * n_lines + line] = (
                        scratch[PLACE, line] + averaging_shifts[0, copy]
                    )
                    scratch[RE, copy * n_lines + line] = (
                        scratch[RE, line] * averaging_shifts[1, copy]
                    )
                    scratch[IM, copy * n_lines + line] = 0.0
            n_lines *= n_copies
            magnitude_sum, power_sum, lowest_position, highest_position = summarise_lines(
                scratch, n_lines, adds_powers
            )
        half_width = 0.5 * (highest_position - lowest_position)
        if n_lines > 2 and point[15] > 0.0:
            error_allowed = allowed_relative_error(
                magnitude_sum,
                power_sum,
                n_lines,
                adds_powers,
                window_sum,
                point[15] * point[10] / LINE_APPROXIMATIONS_MAX,
                point[11],
            )
            phase_per_bin = np.pi * layout[1] / layout[0] * (2.0 if adds_powers else 1.0)
            n_nodes = count_nodes(phase_per_bin * half_width, error_allowed, phase_limits)
            if 4 * n_nodes < 3 * n_lines and n_nodes <= NODES_MAX:
                middle = 0.5 * (lowest_position + highest_position)
                n_lines = replace_lines_by_nodes(
                    scratch, RE, IM, n_lines, n_nodes, (middle, half_width), A_RE, A_IM
                )
                for line in range(n_lines):
                    scratch[PLACE, line] = scratch[X, line]
                    scratch[RE, line], scratch[IM, line] = scratch[A_RE, line], scratch[A_IM, line]
    return origin_bin, n_lines, weight_sum, lowest_position, highest_position


@njit(cache=True, error_model="numpy", borrows=True)
def _store_span(start, n_bins, scratch, is_exempt, all_magnitudes, all_is_exempt):
    """Hands a run on, from ``start`` on; where the next one begins."""
    for k in range(n_bins):
        all_magnitudes[start + k], all_is_exempt[start + k] = scratch[OUT, k], is_exempt[k]
    return start + n_bins


@njit(cache=True, nogil=True, error_model="numpy")
def _evaluate_points(
    point_rows,
    point_index,
    footprint,
    shape_modes,
    tables,
    limits_and_tangents,
    config,
    shape_workspace,
    workspace,
    results,
):
    """Compute runs of points; return the number of points that there was room for.

    ``point_rows`` are rows of :meth:`sweep.model.preparation.Shots.point_parameter_table`;
    ``point_index`` (3, m) rows
    in the footprints, shapes, and numbers of the points; ``shape_modes`` and ``tables`` those of
    :class:`ShapeGroup`, with shifts (m, segments, 2, k) and with sizes that end in the view and
    half
    of the echo's main lobe, in whose place a wider pedestal's reach comes; ``limits_and_tangents``
    limits of
    nodes, and tangents; ``config`` segments that there are, levels below which bins may be left
    out,
    each segment's way to look at leakage, the window's sum, the rule of detection, the speckle of
    all points, and true if probabilities of a detection are asked for. ``shape_workspace`` and
    ``workspace`` are
    room for shapes and for spectra. Results (``results``): low, count, peak, exempted and start (5,
    segments, m); pd, miss, magnitude and leakage (4, segments, m); magnitudes and exempt bins of
    runs, which may have no room at all.
    """
    line_shift, shifts = shape_modes[0], shape_modes[3]
    layout, phase_limits, tangents = tables[0], limits_and_tangents[0], limits_and_tangents[1]
    (
        (segment_exists, lowest_levels, leakage_methods, window_sum, rule, speckle_table, with_pd),
        (table, outlines),
    ) = config, shape_workspace
    scratch, is_exempt, crossing_series = workspace
    span_numbers, span_values, all_magnitudes, all_is_exempt = results
    keeps_magnitudes, next_start = all_magnitudes.size > 0, np.int64(0)
    speckle_rates = empty_crossing_rates()
    previous_ratio, built_shape = (
        -1.0,
        np.int64(-1),
    )  # a literal would compile what takes it once more
    echo_lengths, record_length = tables.echo_lengths, layout[1]
    is_late = echo_lengths.size > 0
    for i in range(point_rows.shape[0]):
        point, footprint_row, shape_index = point_rows[i], point_index[0, i], point_index[1, i]
        record_start = point[7]
        if shape_index != built_shape:
            for s in range(segment_exists.size):
                if segment_exists[s] and is_late:
                    same_segment = line_shape.first_segment_of_same_shape(
                        s, shape_index, shape_modes, echo_lengths, segment_exists
                    )
                    if same_segment >= 0:
                        table[s], outlines[s, 1:] = table[same_segment], outlines[same_segment, 1:]
                    else:
                        layout[1] = echo_lengths[s, shape_index]
                        line_shape.build_late_line_shape(
                            s, shape_index, shape_modes, tables, table[s], outlines[s]
                        )
                elif segment_exists[s]:
                    line_shape.build_line_shape(
                        s, (shape_index, built_shape), shape_modes, tables, table[s], outlines[s]
                    )
            built_shape = shape_index
        noise_sigma, threshold = point[10], point[11]
        pedestal = PedestalShape(point[18], point[19], point[20])
        layout[8] = max(rule.lobe_half_width, int(pedestal.reach_bins))
        threshold_ratio = threshold / noise_sigma
        if rule.in_speckle:  # one table serves thresholds that differ by light's shot noise
            threshold_ratio = (
                math.floor(threshold_ratio / THRESHOLD_RATIO_STEP + 0.5) * THRESHOLD_RATIO_STEP
            )
        if leakage_methods.any() and threshold_ratio != previous_ratio:
            previous_ratio = threshold_ratio
            fill_crossing_series(previous_ratio, crossing_series)
            if rule.in_speckle:
                speckle_rates = tabulate_crossing_rates(previous_ratio, crossing_series)
        for s in range(segment_exists.size):
            if not segment_exists[s]:
                continue
            if is_late:  # what the echo has of the record is a record of its own
                layout[1] = echo_lengths[s, shape_index]
                point[7] = record_start + (record_length - echo_lengths[s, shape_index]) / point[6]
            averaging_shifts = shifts[i, s][
                :, : np.count_nonzero(shifts[i, s, 1])
            ]  # zeros are last
            origin_bin, n_lines, weight_sum, lowest_position, highest_position = _prepare_lines(
                point,
                (s, footprint_row),
                footprint,
                line_shift[s, shape_index],
                averaging_shifts,
                window_sum,
                phase_limits,
                layout,
                scratch,
            )
            lines = (
                n_lines,
                lowest_position,
                highest_position,
                weight_sum,
                point[15] * noise_sigma / LINE_APPROXIMATIONS_MAX,
            )
            speckle_power_max, leakage = SPECKLE_POWER_MAX if rule.in_speckle else 1.0, 0.0
            leakage_limits = (
                noise_sigma,
                threshold,
                point[14],
                speckle_power_max,
                rule.sidelobe_correlation,
            )
            if leakage_methods[s] == LEAKAGE_BY_INTEGRAL:
                first_bin, n_bins, peak_index, n_exempt, leakage = detect_with_leakage(
                    origin_bin,
                    lines,
                    leakage_limits,
                    table[s],
                    outlines[s],
                    layout,
                    tangents,
                    scratch,
                    is_exempt,
                    crossing_series,
                    speckle_rates,
                )
            else:
                first_bin, n_bins, peak_index, n_exempt = detect_in_span(
                    origin_bin,
                    lines,
                    (threshold, lowest_levels[i]),
                    averaging_shifts[:, : (1 - layout[4]) * averaging_shifts.shape[1]],
                    table[s],
                    outlines[s],
                    layout,
                    tangents,
                    scratch,
                    is_exempt,
                )
            if point[16] > 0.0:
                n_exempt = clear_image_exemptions(
                    scratch[OUT, :n_bins], is_exempt[:n_bins], first_bin, layout[0], point[16]
                )
            if keeps_magnitudes:
                if next_start + n_bins > all_magnitudes.size:
                    return i
                span_numbers[4, s, i] = next_start
                next_start = _store_span(
                    next_start, n_bins, scratch, is_exempt, all_magnitudes, all_is_exempt
                )
            detection = Detection(np.nan, np.nan)
            if with_pd:
                detection = pd_and_miss(
                    EchoBins(scratch[OUT, :n_bins], is_exempt[:n_bins], first_bin),
                    peak_index,
                    rule,
                    BinThreshold(point[13], threshold, noise_sigma, point[17], pedestal),
                    bin_speckle_at(speckle_table, s, point_index[2, i]),
                )
            if leakage_methods[s] == LEAKAGE_BIN_BY_BIN:
                bin_limits = noise_sigma, threshold, point[14], rule.sidelobe_correlation
                if rule.in_speckle:
                    negligible_signal_ratio = point[12] / math.sqrt(SPECKLE_POWER_MAX)
                    leakage = leakage_of_bins_in_speckle(
                        n_bins,
                        bin_limits,
                        negligible_signal_ratio,
                        scratch,
                        is_exempt,
                        speckle_rates,
                    )
                else:
                    leakage = leakage_of_bins(
                        n_bins, bin_limits, point[12], scratch, is_exempt, crossing_series
                    )
                    if point[16] > 0.0 and rule.joint_tail_rule.sine.size > 0:
                        leakage = any_crossing_of_chain(
                            scratch[CHANCE], n_bins, rule.joint_tail_rule
                        )
            first_bin += layout[0] * (layout[7] == COMPLEX_RECORD)  # never below 0
            span_numbers[0, s, i], span_numbers[1, s, i], span_numbers[2, s, i] = (
                first_bin,
                n_bins,
                peak_index,
            )
            span_numbers[3, s, i] = n_exempt
            span_values[0, s, i], span_values[1, s, i] = detection.pd, detection.miss
            span_values[2, s, i], span_values[3, s, i] = scratch[OUT, peak_index], leakage
    return point_rows.shape[0]
