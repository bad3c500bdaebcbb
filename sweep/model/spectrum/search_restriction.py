"""Restriction of spans of bins to a search band (:mod:`sweep.model.spectrum.search_band`).

Positions of beamlets' lines, in bins, are computed here as well: they decide which echoes lie in
the band.
"""

import math
from typing import Any

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.added_crossings import (
    any_crossing_probability,
    exclude_crossings_joining_echo,
)
from sweep.model.detection.echo_detection import (
    EchoSpans,
    bin_threshold_of_point,
    echo_bin_bounds,
    echo_half_width,
)
from sweep.model.detection.marcum import marcum_q1_excess
from sweep.model.spectrum.search_band import SearchBand


def restrict_to_band(shots: Any, spans: Any) -> Any:
    """Restrict spans, adjacent bins around the lines, to the bins of the search band.

    Bins outside the band neither detect nor raise a false alarm. If the strongest bin of an echo is
    outside, the echo is not detected, and fewer of its bins are exempt from false alarms. The
    exempt bins are groups of adjacent bins above the threshold that hold a line of the footprint
    and have their strongest bin in the band. The peak magnitude is that of the strongest bin, in
    the band or not.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    spans : BinSpans
        Spans of bins of m points, whose ``magnitudes`` and ``is_exempt`` are changed in place.

    Returns
    -------
    BinSpans
        Spans within the band, with the leakage in them. Probabilities of detection are unchanged:
        :func:`sweep.model.detection.detection_probability.detect_in_spans` sets them.
    """
    if shots.detection_settings.search_band is None:
        return spans
    points = spans.point_numbers
    first_bin, n_bins, peak_index, n_exempt, span_start = (
        np.array(values)
        for values in (
            spans.first_bin,
            spans.n_bins,
            spans.peak_index,
            spans.n_exempt,
            spans.span_start,
        )
    )
    leakage = np.array(spans.leakage_probability)
    bands = shots.detection_settings.search_band.select_points(points)
    peak_is_searched = (spans.n_bins == 0) | bands.contains(spans.first_bin + spans.peak_index)
    line_positions = (
        np.empty((points.size, 3, 0))
        if peak_is_searched.all()
        else beamlet_line_positions(shots)[points]
    )
    evaluates_leakage = np.array(
        [
            shots.detection_settings.leakage_raises_false_alarms and segment.evaluates_leakage
            for segment in shots.waveform_segments
        ]
    )
    _restrict_spans(
        EchoSpans(first_bin, n_bins, peak_index, span_start, spans.magnitudes, spans.is_exempt),
        bands,
        peak_is_searched,
        line_positions,
        shots.bin_thresholds.select(points),
        np.broadcast_to(shots.negligible_signal_ratio, shots.size)[points],
        shots.detection_rule,
        evaluates_leakage,
        n_exempt,
        leakage,
    )
    return spans._replace(
        first_bin=first_bin,
        n_bins=n_bins,
        peak_index=peak_index,
        n_exempt=n_exempt,
        span_start=span_start,
        leakage_probability=leakage,
        peak_is_searched=peak_is_searched,
    )


def beamlet_line_positions(shots: Any, points: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Return the FFT bin positions of each beamlet's line by segment, (m, 3, beamlets).

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    points
        (m,): indices of points; by default all.

    Returns
    -------
    numpy.ndarray
        0 .. N/2; -N/2 .. N/2 of complex records. For lines that drift within the record, due to
        range walk and acceleration, the position is that in the middle of the record.
    """

    def by_point(values: np.ndarray | float) -> np.ndarray:
        """Return values of the points as a column (m, 1)."""
        return append_trailing_axes(shots, values)[points]

    hertz_per_metre = by_point(shots.waveform.chirp_rate) * (2 / SPEED_OF_LIGHT)  # as a beat [Hz]
    axis_range_beat = hertz_per_metre * by_point(shots.range)
    relative_range = 1 + shots.footprint.relative_range_offset[shots.footprint.row_of_point[points]]
    beamlet_doppler = shots.footprint.doppler_ratio_offset[shots.footprint.row_of_point[points]]
    n_points, n_beamlets = beamlet_doppler.shape
    positions = np.empty((n_points, 3, n_beamlets))
    for s, segment in enumerate(shots.waveform_segments):
        beta = by_point(segment.doppler_ratio) + beamlet_doppler
        range_drift = SPEED_OF_LIGHT / 2 * beamlet_doppler * by_point(segment.start_time)
        range_beat = axis_range_beat * relative_range - hertz_per_metre * (
            by_point(segment.range_decrease_since_shot_start) + range_drift
        )
        beat = by_point(segment.carrier) * beta - segment.chirp_rate_ratio * range_beat * (1 + beta)
        beat += by_point(shots.mid_record_frequency_drifts[s])
        positions[:, s] = _fold_to_bins(shots, beat / by_point(shots.sample_rate))
    return positions


def mean_line_positions(shots: Any, points: np.ndarray, strongest_bins: np.ndarray) -> np.ndarray:
    """Return the power-weighted mean FFT bin position of the beamlets' lines, (m, 3).

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    points
        (m,): indices of points.
    strongest_bins
        (m, 3): number of each segment's strongest bin. In complex records, whose spectra are
        periodic, the result is the position nearest to this bin.
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
    """Return the positions [FFT bins] of the lines on the beam's axis, (segments, n)."""
    cycles_per_sample = [
        (beat + drift) / shots.sample_rate
        for beat, drift in zip(
            shots.beat_frequencies, shots.mid_record_frequency_drifts, strict=True
        )
    ]
    return np.array(
        [np.broadcast_to(_fold_to_bins(shots, cycles), shots.size) for cycles in cycles_per_sample]
    )


def _fold_to_bins(shots: Any, cycles_per_sample: np.ndarray) -> np.ndarray:
    """Return the positions [FFT bins] of lines from their frequencies [cycles per sample].

    Frequencies are aliased to within half the sample rate. In real records, negative frequencies
    are folded at 0.
    """
    positions = (cycles_per_sample - np.floor(cycles_per_sample + 0.5)) * shots.fft_size
    return np.asarray(positions if shots.complex_record else abs(positions))


def append_trailing_axes(shots: Any, values: np.ndarray | float, n_trailing: int = 1) -> np.ndarray:
    """Broadcast values to all points, and append axes of size 1.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points.
    values : ndarray (n,) or float
        Values of the points.
    n_trailing : int
        Number of axes to append.

    Returns
    -------
    ndarray (n, 1, ...)
        Values that broadcast over beamlets or bins of each point.
    """
    return np.broadcast_to(values, shots.size).reshape(-1, *[1] * n_trailing)


@njit(cache=True, error_model="numpy", borrows=True)
def _is_in_band(bin_, band):
    """Return true if the FFT bin number ``bin_`` lies in a :class:`SearchBand`."""
    distance = bin_ - band.first_bin
    if band.period_bins > 0:
        distance %= band.period_bins
    return 0 <= distance < band.n_bins


@njit(cache=True, nogil=True, error_model="numpy")
def _restrict_spans(
    spans,
    bands,
    peak_is_searched,
    line_positions,
    bin_thresholds,
    negligible_signal_ratio,
    rule,
    evaluates_leakage,
    n_exempt,
    leakage,
):
    """Restrict spans, adjacent bins around the lines, to the search band, in place.

    Parameters
    ----------
    spans
        :class:`sweep.model.detection.echo_detection.EchoSpans` (segments, m) of m points; all of
        its arrays are changed.
    bands
        :class:`SearchBand` with arrays (segments, m).
    peak_is_searched
        (segments, m) bool: True if the strongest bin is in the band.
    line_positions
        (m, 3, beamlets): :func:`beamlet_line_positions`; without beamlets if all strongest bins are
        in the band.
    bin_thresholds
        :class:`sweep.model.detection.echo_detection.BinThresholds` (m,).
    negligible_signal_ratio
        (m,): |X| over sigma below which a bin counts as noise alone.
    rule
        :class:`sweep.model.detection.echo_detection.DetectionRule`.
    evaluates_leakage
        (segments,) bool: True for segments whose leakage is evaluated.
    n_exempt
        (segments, m): number of exempt bins; changed for spans that the band cuts.
    leakage
        (segments, m): probability of a false peak due to leakage; changed for spans that the
        band cuts.
    """
    first_bin, n_bins, peak_index, span_starts = (
        spans.first_bin,
        spans.n_bins,
        spans.peak_index,
        spans.span_start,
    )
    for s in range(first_bin.shape[0]):
        for j in range(first_bin.shape[1]):
            band = SearchBand(bands.first_bin[s, j], bands.n_bins[s, j], bands.period_bins)
            first, last = n_bins[s, j], -1
            n_searched = 0
            span_bin, span_start = first_bin[s, j], span_starts[s, j]
            for k in range(n_bins[s, j]):
                if _is_in_band(span_bin + k, band):
                    first, last, n_searched = min(first, k), k, n_searched + 1
            if n_searched == n_bins[s, j]:
                continue
            bin_threshold = bin_threshold_of_point(bin_thresholds, j)
            threshold = bin_threshold.threshold
            magnitudes = spans.magnitudes[span_start : span_start + n_bins[s, j]]
            is_exempt = spans.is_exempt[span_start : span_start + n_bins[s, j]]
            if not peak_is_searched[s, j]:
                is_exempt[:] = False
                if threshold <= magnitudes[peak_index[s, j]]:
                    _mark_searched_echoes(
                        magnitudes,
                        is_exempt,
                        span_bin,
                        threshold,
                        echo_half_width(rule, bin_threshold.pedestal.reach_bins),
                        band,
                        line_positions[j, s],
                    )
            largest_index = first
            for k in range(first, last + 1):
                if not _is_in_band(span_bin + k, band):  # between both ends of a periodic band
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
            if evaluates_leakage[s]:
                leakage[s, j] = span_leakage_probability(
                    magnitudes,
                    is_exempt,
                    threshold,
                    bin_threshold.noise_sigma_without_pedestal,
                    negligible_signal_ratio[j],
                    threshold,
                    rule.sidelobe_neighbour_noise_correlation,
                )


@njit(cache=True, error_model="numpy")
def _mark_searched_echoes(
    magnitudes, is_exempt, first_bin, threshold, lobe_half_width, band, line_positions
):
    """Mark the bins of echoes whose strongest bin is in the search band, and adjacent bins.

    Parameters
    ----------
    magnitudes
        (bins,): |X| without noise of adjacent bins.
    is_exempt
        (bins,) bool: output array, True in the marked bins.
    first_bin
        Number of the first bin.
    threshold
        Threshold on |X|; adjacent bins at or above it form a group.
    lobe_half_width
        Half-width [bins] of an echo about its lines.
    band
        :class:`SearchBand`.
    line_positions
        (beamlets,): positions of lines [bins]. Groups without a line are leaked signal, not echoes.
    """
    index = 0
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
            if band.period_bins > 0:
                distance -= band.period_bins * math.floor(distance / band.period_bins)
            holds_line |= 0.0 <= distance <= index - first + 1
        if holds_line and _is_in_band(first_bin + largest_index, band):
            begin, end = echo_bin_bounds(magnitudes, first, index - 1, threshold, lobe_half_width)
            is_exempt[max(min(begin, first - 1), 0) : max(end, index) + 1] = True


@njit(cache=True, error_model="numpy")
def span_leakage_probability(
    magnitudes,
    is_exempt,
    alarm_threshold,
    noise_sigma,
    negligible_signal_ratio,
    group_threshold,
    sidelobe_neighbour_noise_correlation,
):
    """Return the probability that leaked signal raises a false peak apart from the echo.

    A false peak is a group of adjacent bins above the threshold.

    Parameters
    ----------
    magnitudes
        (bins,): |X| without noise of adjacent bins.
    is_exempt
        (bins,) bool: True in bins that belong to an echo.
    alarm_threshold
        Threshold on |X| that a bin has to cross.
    noise_sigma
        Noise per quadrature sigma.
    negligible_signal_ratio
        |X| over sigma below which a bin counts as noise alone.
    group_threshold
        Threshold on |X| by which adjacent bins form a group.
    sidelobe_neighbour_noise_correlation
        Correlation of neighbouring bins' noise components in phase with the signal.
    """
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
    exclude_crossings_joining_echo(
        probabilities,
        0,
        magnitudes.size,
        magnitudes,
        is_exempt,
        noise_sigma,
        group_threshold,
        sidelobe_neighbour_noise_correlation,
    )
    return any_crossing_probability(probabilities, 0, magnitudes.size)
