"""Runs of bins and beamlets' lines in a search band (:mod:`sweep.model.spectrum.search_band`)."""

import math
from typing import Any

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.added_crossings import (
    any_crossing_probability,
    exclude_bins_joining_echo,
)
from sweep.model.detection.echo_detection import (
    Detection,
    EchoBins,
    bin_speckle_at,
    bin_threshold_at,
    echo_bounds,
    pd_and_miss,
)
from sweep.model.detection.marcum import marcum_q1_excess


def restrict_to_band(shots: Any, spans: Any) -> Any:
    """Cut runs of bins to the band: what is not searched neither detects nor raises an alarm.

    Of an echo whose strongest bin is not searched nothing is detected, but for other groups of
    bins about lines of its footprint; the magnitude stays that of its strongest bin.
    """
    if shots.detection_settings.search_band is None:
        return spans
    points = spans.point_numbers
    span_numbers = np.array(
        [spans.first_bin, spans.n_bins, spans.peak_index, spans.n_exempt, spans.span_start]
    )
    probabilities = np.array([spans.pd, spans.miss, spans.leakage])
    period_bins = shots.fft_size if shots.complex_record else 0
    band_bins = np.ascontiguousarray(shots.detection_settings.search_band[:, :, points])
    peak_distance = spans.first_bin + spans.peak_index - band_bins[:, 0]
    peak_distance = peak_distance % period_bins if period_bins else peak_distance
    peak_is_searched = (spans.n_bins == 0) | (
        (peak_distance >= 0) & (peak_distance < band_bins[:, 1])
    )
    line_positions = (
        np.empty((points.size, 3, 0))
        if peak_is_searched.all()
        else beamlet_line_positions(shots)[points]
    )
    negligible_signal_ratio = np.broadcast_to(shots.negligible_signal_ratio, shots.size)[points]
    threshold_rows = np.concatenate(
        [shots.bin_threshold_table[:, points], negligible_signal_ratio[None]]
    )
    evaluates_leakage = np.array(
        [
            shots.detection_settings.includes_leakage and segment.includes_leakage
            for segment in shots.waveform_segments
        ]
    )
    band_and_lines = band_bins, period_bins, line_positions, peak_is_searched
    points_and_speckle = points, shots.speckle_table
    _restrict_spans(
        span_numbers,
        band_and_lines,
        threshold_rows,
        (shots.detection_rule, evaluates_leakage),
        points_and_speckle,
        spans.magnitudes,
        spans.is_exempt,
        probabilities,
    )
    first_bin, n_bins, peak_index, n_exempt, span_start = span_numbers
    return spans._replace(
        first_bin=first_bin,
        n_bins=n_bins,
        peak_index=peak_index,
        n_exempt=n_exempt,
        span_start=span_start,
        pd=probabilities[0],
        miss=probabilities[1],
        leakage=probabilities[2],
        peak_is_searched=peak_is_searched,
    )


def beamlet_line_positions(shots: Any, points: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Places of each beamlet's line in the three spectra [bins, 0..N/2], (m, 3, beamlets).

    In spectra of complex records -N/2 .. N/2. Lines that drift within the record, by range walk and
    acceleration, lie where they are at its middle.
    """

    def by_point(values: np.ndarray | float) -> np.ndarray:
        return as_columns(shots, values)[points]

    hertz_per_metre = by_point(shots.waveform.chirp_rate) * (2 / SPEED_OF_LIGHT)  # as a beat [Hz]
    range_beat_and_factor = (
        hertz_per_metre * by_point(shots.range),
        1 + shots.footprint.relative_range_offset[shots.footprint.row_of_point[points]],
    )
    beamlet_doppler = shots.footprint.doppler_ratio_offset[shots.footprint.row_of_point[points]]
    positions = np.empty((beamlet_doppler.shape[0], 3, beamlet_doppler.shape[1]))
    for s, segment in enumerate(shots.waveform_segments):
        beta = by_point(segment.doppler_ratio) + beamlet_doppler
        range_drift = SPEED_OF_LIGHT / 2 * beamlet_doppler * by_point(segment.start_time)
        range_beat = range_beat_and_factor[0] * range_beat_and_factor[1] - hertz_per_metre * (
            by_point(segment.range_decrease) + range_drift
        )
        beat = by_point(segment.carrier) * beta - segment.chirp_slope * range_beat * (1 + beta)
        beat += by_point(shots.mid_record_drifts[s])
        positions[:, s] = _fold_to_bins(shots, beat / by_point(shots.sample_rate))
    return positions


def mean_line_positions(shots: Any, points: np.ndarray, strongest_bins: np.ndarray) -> np.ndarray:
    """Mean places of the beamlets' lines, weighted by power, (m, 3) [bins].

    Next to the ``strongest_bins`` bins (m, 3) of complex records, whose bins may be numbered from
    anywhere on.
    """
    line_offsets = beamlet_line_positions(shots, points) - strongest_bins[..., None]
    if shots.complex_record:
        line_offsets -= shots.fft_size * np.rint(line_offsets / shots.fft_size)
    line_power = (
        shots.footprint.relative_amplitude[shots.footprint.row_of_point[points]][:, None] ** 2
    )
    return np.asarray(
        strongest_bins + (line_power * line_offsets).sum(axis=-1) / line_power.sum(axis=-1)
    )


def axis_line_positions(shots: Any) -> np.ndarray:
    """Positions (segments, n) of the lines on the beam's axis [bins]."""
    cycles_per_sample = [
        (beat + drift) / shots.sample_rate
        for beat, drift in zip(shots.beat_frequencies, shots.mid_record_drifts, strict=True)
    ]
    return np.array(
        [np.broadcast_to(_fold_to_bins(shots, cycles), shots.size) for cycles in cycles_per_sample]
    )


def _fold_to_bins(shots: Any, cycles_per_sample: np.ndarray) -> np.ndarray:
    """Places [bins] in a spectrum at which lines of a frequency over the sample rate are seen."""
    positions = (cycles_per_sample - np.floor(cycles_per_sample + 0.5)) * shots.fft_size
    return np.asarray(positions if shots.complex_record else abs(positions))


def as_columns(shots: Any, values: np.ndarray | float, n_trailing: int = 1) -> np.ndarray:
    """One value a point, with so many dimensions behind it."""
    return np.broadcast_to(values, shots.size).reshape(-1, *[1] * n_trailing)


@njit(cache=True, error_model="numpy", borrows=True)
def _is_in_band(bin_, first_and_count, period_bins):
    """Test if a bin is in the band (first bin, number); ``period_bins`` is N of complex records."""
    distance = bin_ - first_and_count[0]
    if period_bins > 0:
        distance %= period_bins
    return 0 <= distance < first_and_count[1]


@njit(cache=True, nogil=True, error_model="numpy")
def _restrict_spans(
    span_numbers,
    band_and_lines,
    threshold_rows,
    rule_and_leakage,
    points_and_speckle,
    all_magnitudes,
    all_is_exempt,
    probabilities,
):
    """Cut runs to the band, in place.

    ``span_numbers`` (5, segments, m) are low, count, peak, exempted and start of runs;
    ``band_and_lines`` the
    band (3, 2, m), N of complex records or 0, places of lines (m, 3, beamlets), and whether a run's
    largest bin is searched; ``threshold_rows`` (8, m) those of
    :class:`sweep.model.detection.echo_detection.BinThreshold`,
    and the floor of leakage over the noise; ``rule_and_leakage`` the rule of detection and segments
    whose leakage is looked at; ``points_and_speckle`` points (m,) and the speckle of all;
    ``probabilities`` (3, segments, m) pd, miss and leakage.
    """
    (band_bins, period_bins, line_positions, peak_is_searched), (rule, evaluates_leakage) = (
        band_and_lines,
        rule_and_leakage,
    )
    first_bin, n_bins, peak_index, n_exempt, span_starts = span_numbers
    for s in range(first_bin.shape[0]):
        for j in range(first_bin.shape[1]):
            first, last = n_bins[s, j], -1
            n_searched = 0
            span_bin, span_start = first_bin[s, j], span_starts[s, j]
            for k in range(n_bins[s, j]):
                if _is_in_band(span_bin + k, band_bins[s, :, j], period_bins):
                    first, last, n_searched = min(first, k), k, n_searched + 1
            if n_searched == n_bins[s, j]:
                continue
            magnitudes = all_magnitudes[span_start : span_start + n_bins[s, j]]
            is_exempt = all_is_exempt[span_start : span_start + n_bins[s, j]]
            if not peak_is_searched[s, j]:
                is_exempt[:] = False
                if threshold_rows[1, j] <= magnitudes[peak_index[s, j]]:
                    lobe_half_width = max(rule.lobe_half_width, int(threshold_rows[4, j]))
                    _mark_searched_echoes(
                        magnitudes,
                        is_exempt,
                        span_bin,
                        threshold_rows[1, j],
                        lobe_half_width,
                        (band_bins[s, :, j], period_bins),
                        line_positions[j, s],
                    )
            largest_index = first
            for k in range(first, last + 1):
                if not _is_in_band(
                    span_bin + k, band_bins[s, :, j], period_bins
                ):  # between both ends of the band
                    magnitudes[k], is_exempt[k] = 0.0, False
                largest_index = k if magnitudes[k] > magnitudes[largest_index] else largest_index
            first_bin[s, j], span_starts[s, j], n_bins[s, j] = (
                span_bin + first,
                span_start + first,
                last + 1 - first,
            )
            if last < 0:
                first_bin[s, j], span_starts[s, j], n_bins[s, j] = span_bin, span_start, 0
            magnitudes, is_exempt = magnitudes[first : last + 1], is_exempt[first : last + 1]
            peak_index[s, j] = (
                peak_index[s, j] - first
                if peak_is_searched[s, j]
                else max(largest_index - first, 0)
            )
            n_exempt[s, j] = is_exempt.sum()
            detection = Detection(0.0, 1.0)
            if peak_is_searched[s, j]:
                detection = pd_and_miss(
                    EchoBins(magnitudes, is_exempt, first_bin[s, j]),
                    peak_index[s, j],
                    rule,
                    bin_threshold_at(threshold_rows, j),
                    bin_speckle_at(points_and_speckle[1], s, points_and_speckle[0][j]),
                )
            probabilities[0, s, j], probabilities[1, s, j] = detection.pd, detection.miss
            if evaluates_leakage[s]:
                probabilities[2, s, j] = span_leakage(
                    magnitudes,
                    is_exempt,
                    (threshold_rows[1, j], threshold_rows[2, j], threshold_rows[7, j]),
                    threshold_rows[1, j],
                    rule.sidelobe_correlation,
                )


@njit(cache=True, error_model="numpy")
def _mark_searched_echoes(
    magnitudes, is_exempt, first_bin, threshold, lobe_half_width, band_and_period, line_positions
):
    """Mark the bins of groups about lines whose largest bin is searched, and those beside them."""
    index, period_bins = 0, band_and_period[1]
    while index < magnitudes.size:
        if not magnitudes[index] >= threshold:  # true of nan too, which would end no loop
            index += 1
            continue
        first = largest_index = index
        while index < magnitudes.size and magnitudes[index] >= threshold:
            largest_index = (
                index if magnitudes[index] > magnitudes[largest_index] else largest_index
            )
            index += 1
        holds_line = False
        for position in line_positions:
            distance = position - (first_bin + first - 1)
            if period_bins > 0:
                distance -= period_bins * math.floor(distance / period_bins)
            holds_line |= 0.0 <= distance <= index - first + 1
        if holds_line and _is_in_band(first_bin + largest_index, band_and_period[0], period_bins):
            begin, end = echo_bounds(magnitudes, first, index - 1, threshold, lobe_half_width)
            is_exempt[max(min(begin, first - 1), 0) : max(end, index) + 1] = True


@njit(cache=True, error_model="numpy")
def span_leakage(
    magnitudes, is_exempt, threshold_sigma_and_floor, group_threshold, sidelobe_correlation
):
    """Return the probability that leaked signal in a run raises a further group to a level.

    Parameters
    ----------
    magnitudes, is_exempt
        |X| of its bins, and whether they are of an echo.
    threshold_sigma_and_floor
        Level, noise per quadrature sigma, and lowest |X| / sigma that is looked at.
    group_threshold
        Threshold on |X|, which groups hang together by.
    sidelobe_correlation
        Correlation of neighbours' noise in phase with the signal.
    """
    alarm_threshold, noise_sigma, negligible_signal_ratio = threshold_sigma_and_floor
    threshold_ratio, probabilities = alarm_threshold / noise_sigma, np.zeros(magnitudes.size)
    p_noise_stay = -math.expm1(-0.5 * threshold_ratio * threshold_ratio)
    for k in range(magnitudes.size):
        if (
            not is_exempt[k]
            and magnitudes[k] >= negligible_signal_ratio * noise_sigma
            and magnitudes[k] > 0.0
        ):
            probabilities[k] = (
                marcum_q1_excess(magnitudes[k] / noise_sigma, threshold_ratio) / p_noise_stay
            )
    exclude_bins_joining_echo(
        probabilities,
        0,
        magnitudes.size,
        magnitudes,
        is_exempt,
        (noise_sigma, group_threshold),
        sidelobe_correlation,
    )
    return any_crossing_probability(probabilities, 0, magnitudes.size)
