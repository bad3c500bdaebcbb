"""Random draws of shots: count detections and false alarms, batch by batch.

Two methods agree in the mean. ``probabilities`` is the method of [T 3.3.2]. It compares uniform
random numbers with pd and with the probability of a false alarm due to noise and leakage together.
``noise`` adds complex Gaussian noise to the bins of the echo, in each look, correlated between bins
as window and padding make it. The other bins hold noise alone. Their largest magnitude follows from
the order statistic of an equivalent number of independent bins, which has the same probability of a
false alarm.

If effects are random, each draw has a spectrum, probabilities and noise of its own
(:mod:`sweep.model.sampling.samplers`, which also decides when to stop). Echoes in developed speckle
fade by factors that are correlated between segments. If any bin may detect an echo, the factors
follow from the lines of its footprint (:mod:`sweep.model.sampling.speckle_lines`).

Every random number is addressed by point, draw, cause and index
(:mod:`sweep.model.sampling.philox`).
"""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection.bin_noise import N_NOISE_FILTER_TAPS, noise_filter
from sweep.model.detection.detection_probability import (
    doppler_pd_given_chirps,
    down_pd_given_up_result,
)
from sweep.model.detection.echo_detection import (
    BinThresholds,
    SpeckleMixing,
    bin_threshold_of_point,
    fill_pedestal_ratios,
    speckle_mixing_of_point,
)
from sweep.model.detection.hoyt import pseudo_variance_ratio_at
from sweep.model.detection.marcum import at_least_one_probability
from sweep.model.kernel_integers import INTEGER_ZERO
from sweep.model.preparation import Shots
from sweep.model.sampling import philox
from sweep.model.sampling.philox import (
    STREAM_DETECTION,
    STREAM_FALSE_ALARM,
    STREAM_NOISE,
    STREAM_NOISE_MAXIMUM,
    DrawAddress,
)
from sweep.model.sampling.speckle_lines import (
    FACTORED_BINS_MAX,
    SpeckleLineGrid,
    draw_bin_amplitudes,
    draw_factored_amplitudes,
    factor_bin_covariance,
    fill_mean_bin_powers,
    speckle_line_grid,
)
from sweep.model.spectrum.search_restriction import mean_line_positions
from sweep.model.spectrum.segment_spectra import iter_spans

PD_BOTH_CHIRPS_NAME = "pd_both_chirps"
"""Name of the output for the probability that both chirps, up and down, detect the echo. The output
exists only if any two segments suffice to detect a shot. Otherwise ``pd_shot`` is this probability.
"""

_DRAWS_PER_STEP = 256
"""Number of draws of one point for which random numbers are generated in one step."""


class DrawRanges(NamedTuple):
    """Ranges of consecutive draws, one for each of m points or prepared spectra, (m,) each."""

    point_index: np.ndarray
    """(m,) int64: index of the point to whose counts the draws are added."""
    keys: np.ndarray
    """(m, 2) uint64: random key of the point, from which its random numbers follow."""
    first_draw: np.ndarray
    """(m,) int64: number of the first draw of the range."""
    end_draw: np.ndarray
    """(m,) int64: number of the last draw of the range, plus 1."""


class DrawCountConfig(NamedTuple):
    """Settings and tables for counting detections and false alarms, common to all points."""

    adds_noise: bool
    """True if noise is added to the bins of an echo and the sum is compared with the threshold;
    False if random numbers are compared with probabilities of detection."""
    noise_filter: "NoiseFilter"
    """Filter that makes the correlated noise of an echo's bins. It has no bins if only the
    strongest bin may detect the echo."""
    sidelobe_neighbour_noise_correlation: float
    """Correlation coefficient of the noise of two adjacent bins, for the component in phase with
    the signal."""
    pseudo_variance_ratio: np.ndarray
    """(ratio rows, bins): ratio E[X^2] / E[|X|^2] of complex amplitudes X in bins near frequency 0
    (DC) and Nyquist. ``DrawCountInputs.pseudo_variance_row`` selects the row."""
    nyquist_bin: int
    """Number of the bin at the Nyquist frequency: N/2, with N the FFT size."""


class DrawCountInputs(NamedTuple):
    """Quantities of m points on which counts of detections and false alarms depend.

    Segments are up, Doppler and down. sigma is the noise of a bin per quadrature.
    """

    threshold_ratio: np.ndarray
    """(m,): threshold divided by sigma, the noise of a bin per quadrature."""
    line_noise_ratio: np.ndarray
    """(m,): noise per quadrature of bins that hold lines of the echo, divided by sigma, the noise
    per quadrature of bins without signal."""
    bin_thresholds: BinThresholds
    """Record with (m,) in each field: threshold on |X|, and noise, of an echo's bins, for detection
    by any bin (:attr:`sweep.model.preparation.Shots.bin_thresholds`)."""
    pfa: np.ndarray
    """(3, m): probability of a false alarm in a segment, in bins whose noise is not drawn one by
    one."""
    pd_if_condition_fails: np.ndarray
    """(3, m): probability that each segment detects the echo if its condition is False; unused if
    noise is drawn. The condition of the down segment is that the up segment detects, and that of
    the Doppler segment that exactly one of the other two segments detects. The up segment has none.
    """
    pd_if_condition_holds: np.ndarray
    """(3, m): probability that each segment detects the echo if its condition is True; unused if
    noise is drawn. The condition of the down segment is that the up segment detects, and that of
    the Doppler segment that exactly one of the other two segments detects. The up segment has none.
    """
    detects_by_any_two_segments: np.ndarray
    """(m,) bool: True if a shot counts as detected by any two of its segments."""
    speckle_mixing: SpeckleMixing
    """Record with (m,) in each field: coefficients by which independent random amplitudes are mixed
    into the speckle of the three segments. Without speckle the arrays are (0,)."""
    pseudo_variance_row: np.ndarray
    """(3, m) int64: row of ``DrawCountConfig.pseudo_variance_ratio`` for each segment; 0 for an
    echo far from frequency 0 and Nyquist."""
    line_grid: SpeckleLineGrid
    """Lines that represent each point's footprint in developed speckle."""
    line_centre: np.ndarray
    """(m, 3): mean position of the lines of each segment's echo [bins]; (0, 3) without speckle."""


class DrawCounts(NamedTuple):
    """Numbers of draws with an event, (points, batches) int64 each.

    The fields have the order of :data:`sweep.model.outputs.DRAW_COUNT_OUTPUTS`.
    """

    up_detections: np.ndarray
    """(points, batches) int64: number of draws with a detection in the up segment."""
    down_detections: np.ndarray
    """(points, batches) int64: number of draws with a detection in the down segment."""
    doppler_detections: np.ndarray
    """(points, batches) int64: number of draws with a detection in the Doppler segment."""
    shot_detections: np.ndarray
    """(points, batches) int64: number of draws that detect the shot. Up and down segment must
    detect it, or any two segments if ``DrawCountInputs.detects_by_any_two_segments`` is True for
    the point."""
    up_alarms: np.ndarray
    """(points, batches) int64: number of draws with a false alarm in the up segment."""
    down_alarms: np.ndarray
    """(points, batches) int64: number of draws with a false alarm in the down segment."""
    joint_alarms: np.ndarray
    """(points, batches) int64: number of draws with a false alarm in both the up and the down
    segment."""


class EventProbabilities(NamedTuple):
    """Probabilities of events in each segment, with which random numbers are compared.

    Each is (3, n), by segment: up, Doppler, down. The condition for the down segment is that the up
    segment detects. The condition for the Doppler segment is that exactly one of the other two
    detects, so that the Doppler segment decides whether any two do. The up segment has no
    condition.
    """

    false_alarm_probability: np.ndarray
    """(3, n): probability of a false alarm by noise or by leaked signal; 0 for Doppler segments."""
    pd_if_condition_fails: np.ndarray
    """(3, n): probability that each segment detects the echo if its condition is False. The
    condition of the down segment is that the up segment detects, and that of the Doppler segment
    that exactly one of the other two segments detects. The up segment has none."""
    pd_if_condition_holds: np.ndarray
    """(3, n): probability that each segment detects the echo if its condition is True. The
    condition of the down segment is that the up segment detects, and that of the Doppler segment
    that exactly one of the other two segments detects. The up segment has none."""


class SegmentAmplitudeFactors(NamedTuple):
    """Complex factors by speckle on an echo in the three segments, of mean square 1."""

    up: complex
    """Complex factor, due to speckle, on the echo's amplitude in the up segment."""
    doppler: complex
    """Complex factor, due to speckle, on the echo's amplitude in the Doppler segment."""
    down: complex
    """Complex factor, due to speckle, on the echo's amplitude in the down segment."""


class BinInNoise(NamedTuple):
    """Signal of one bin in several draws, and the noise that is added to it.

    sigma is the noise of a bin without signal per quadrature.
    """

    magnitude_ratio: float
    """|X| of the bin without noise and speckle, over sigma, the noise of a bin per quadrature."""
    noise_deviation_in_phase: float
    """Standard deviation, over sigma, of the noise component in phase with the signal. sigma is the
    noise of a bin without signal per quadrature."""
    noise_deviation_in_quadrature: float
    """Standard deviation, over sigma, of the noise component in quadrature with the signal. sigma
    is the noise of a bin without signal per quadrature."""
    squared_threshold_ratio: float
    """Square of the threshold over sigma, the noise of a bin per quadrature."""
    speckle_factor_in_phase: np.ndarray
    """(draws,): real part of the complex speckle factor, of mean power 1, by which the signal is
    multiplied."""
    speckle_factor_in_quadrature: np.ndarray
    """(draws,): imaginary part of the complex speckle factor, of mean power 1, by which the signal
    is multiplied."""


def count_by_probability(
    draw_ranges: DrawRanges,
    batch_edges: np.ndarray,
    outputs: Mapping[str, np.ndarray],
    counts: np.ndarray,
) -> None:
    """Count detections and false alarms, by comparing random numbers with their probabilities.

    The counts are added to ``counts`` in place.

    Parameters
    ----------
    draw_ranges
        Draws of m points.
    batch_edges
        (batches + 1,) int64: numbers of the draws at which batches begin, and the number after the
        last draw.
    outputs
        Outputs (m,) of the points by name.
    counts
        (names, points, batches) int64, in the order of
        :data:`sweep.model.outputs.DRAW_COUNT_OUTPUTS`; the counts are added to it.
    """
    n_rows, probabilities = draw_ranges.point_index.size, _event_probabilities(outputs)
    no_filter = NoiseFilter(np.empty((0, N_NOISE_FILTER_TAPS)), np.empty(0, np.int64), 0)
    inputs = DrawCountInputs(
        threshold_ratio=np.zeros(n_rows),
        line_noise_ratio=np.zeros(n_rows),
        bin_thresholds=BinThresholds(*np.zeros((7, n_rows))),
        pfa=probabilities.false_alarm_probability,
        pd_if_condition_fails=probabilities.pd_if_condition_fails,
        pd_if_condition_holds=probabilities.pd_if_condition_holds,
        detects_by_any_two_segments=np.isfinite(
            outputs.get(PD_BOTH_CHIRPS_NAME, np.full(n_rows, np.nan))
        ),
        speckle_mixing=SpeckleMixing(*np.empty((6, 0))),
        pseudo_variance_row=np.zeros((3, n_rows), np.int64),
        line_grid=SpeckleLineGrid.empty(),
        line_centre=np.empty((0, 3)),
    )
    _draw_and_count_events(
        draw_ranges,
        batch_edges,
        DrawCountConfig(False, no_filter, 0.0, np.zeros((1, 0)), 0),
        inputs,
        NoiselessSpectra.empty(n_rows),
        DrawCounts(*counts),
    )


def count_in_noise(
    draw_ranges: DrawRanges, batch_edges: np.ndarray, shots: Shots, counts: np.ndarray
) -> None:
    """Count detections and false alarms, by drawing the noise of prepared shots.

    The counts are added to ``counts`` in place.

    Parameters
    ----------
    draw_ranges
        Draws of the m points of `shots`.
    batch_edges
        (batches + 1,) int64: numbers of the draws at which batches begin, and the number after the
        last draw.
    shots
        Prepared shots of m points.
    counts
        (names, points, batches) int64, in the order of
        :data:`sweep.model.outputs.DRAW_COUNT_OUTPUTS`; the counts are added to it.
    """
    threshold_ratio, line_noise_ratio = threshold_and_line_noise_ratios(shots)
    speckle_mixing = (
        None
        if shots.speckle.segment_correlations is None
        else shots.speckle.segment_correlations.speckle_mixing().broadcast(shots.size)
    )
    pfa_bin, speckle_table = np.exp(-0.5 * threshold_ratio**2), shots.speckle_table
    line_grid = speckle_line_grid(shots)
    for indices, spectra in iter_noiseless_spectra(shots):
        pfa_elsewhere = at_least_one_probability(pfa_bin[indices], spectra.n_noise_bins.T)
        no_probabilities = np.zeros(pfa_elsewhere.shape)
        inputs = DrawCountInputs(
            threshold_ratio=threshold_ratio[indices],
            line_noise_ratio=line_noise_ratio[indices],
            bin_thresholds=shots.bin_thresholds.select(indices),
            pfa=np.ascontiguousarray(pfa_elsewhere),
            pd_if_condition_fails=no_probabilities,
            pd_if_condition_holds=no_probabilities,
            detects_by_any_two_segments=np.full(indices.size, shots.detects_by_any_two_segments),
            speckle_mixing=(
                SpeckleMixing(*np.empty((6, 0)))
                if speckle_mixing is None
                else speckle_mixing.select(indices)
            ),
            pseudo_variance_row=speckle_table.pseudo_variance_row[:, indices].copy(),
            line_grid=line_grid.select(indices),
            line_centre=np.ascontiguousarray(
                mean_line_positions(shots, indices, spectra.first_bin + spectra.peak_index)
            ),
        )
        config = DrawCountConfig(
            True,
            make_echo_noise_filter(shots, spectra),
            shots.detection_rule.sidelobe_neighbour_noise_correlation,
            speckle_table.pseudo_variance_ratio,
            shots.fft_size // 2,
        )
        part_ranges = DrawRanges(*(column[indices] for column in draw_ranges))
        _draw_and_count_events(
            part_ranges, batch_edges, config, inputs, spectra, DrawCounts(*counts)
        )


class NoiseFilter(NamedTuple):
    """Filter that makes the noise of adjacent bins from independent normal numbers."""

    weights: np.ndarray
    """(bins, N_NOISE_FILTER_TAPS): weights of the independent normal numbers whose weighted sum is
    a bin's noise. The squares of a bin's weights sum to 1."""
    first_number_index: np.ndarray
    """(bins,) int64: index of the first independent normal number in each bin's weighted sum; 0 for
    the first bin."""
    fft_size_if_end_bins_real: int
    """FFT size N if noise in the bins at frequency 0 and at Nyquist is real; 0 if it counts as
    complex."""


class NoiseScratch(NamedTuple):
    """Noise of adjacent bins over sigma, and the independent numbers from which it is made.

    sigma is the standard deviation of a bin's noise per quadrature.
    """

    in_phase: np.ndarray
    """(k,): noise component in phase with the signal in each of k bins, over sigma, the noise of a
    bin per quadrature."""
    in_quadrature: np.ndarray
    """(k,): noise component in quadrature with the signal in each of k bins, over sigma, the noise
    of a bin per quadrature."""
    independent_in_phase: np.ndarray
    """(k,): independent normal numbers that a filter turns into ``in_phase``."""
    independent_in_quadrature: np.ndarray
    """(k,): independent normal numbers that a filter turns into ``in_quadrature``."""

    @classmethod
    def allocate(cls, n_bins: int) -> "NoiseScratch":
        """Return a record with arrays for the noise of ``n_bins`` bins."""
        return cls(*np.empty((4, n_bins + N_NOISE_FILTER_TAPS)))


def make_echo_noise_filter(
    shots: Shots, spectra: "NoiselessSpectra", bins_min: int = 0
) -> NoiseFilter:
    """Return the filter that makes the correlated noise of an echo's bins.

    Parameters
    ----------
    shots
        Prepared shots.
    spectra
        Noiseless spectra of the shots.
    bins_min
        Smallest number of bins of the filter if any bin detects an echo.

    Returns
    -------
    NoiseFilter
        The filter. It has no bins if only the largest bin of an echo detects it.
    """
    n_echo_bins = (
        max(int(spectra.n_bins.max(initial=1)), bins_min)
        if shots.detection_rule.detects_by_any_bin
        else 0
    )
    n_filter_bins = 1 << (n_echo_bins - 1).bit_length() if n_echo_bins else 0
    if shots.detection_settings.noise_bin_model == "independent":
        weights = np.zeros((n_filter_bins, N_NOISE_FILTER_TAPS))
        weights[:, N_NOISE_FILTER_TAPS // 2] = 1.0
        return NoiseFilter(weights, np.arange(n_filter_bins) - N_NOISE_FILTER_TAPS // 2, 0)
    return NoiseFilter(
        *noise_filter(shots.window, shots.fft_size, n_filter_bins), shots.fft_size_if_end_bins_real
    )


COVARIANCE_ROOT_BINS_MAX = 16
"""Largest number of adjacent bins whose correlated noise is made by a Cholesky factor of its
covariance. The factor takes one independent random number for each bin."""


def noise_covariance_root(filter_rule: NoiseFilter) -> np.ndarray:
    """Return the triangular matrix (k, k) that makes the noise of k adjacent bins from k numbers.

    The matrix is the Cholesky factor of the covariance that a filter of
    :func:`make_echo_noise_filter` gives, for at most COVARIANCE_ROOT_BINS_MAX bins.
    Frequency 0 and Nyquist, where the noise is real, need :func:`draw_bin_noise` instead.
    """
    weights, start = filter_rule.weights, filter_rule.first_number_index
    n_bins = min(weights.shape[0], COVARIANCE_ROOT_BINS_MAX)
    number_weights = np.zeros(
        (n_bins, int(start[n_bins - 1] - start[0]) + N_NOISE_FILTER_TAPS if n_bins else 0)
    )
    for k in range(n_bins):
        number_weights[k, start[k] - start[0] : start[k] - start[0] + N_NOISE_FILTER_TAPS] = (
            weights[k]
        )
    root = np.zeros((n_bins, n_bins))
    for k in range(n_bins):
        for j in range(k + 1):
            covariance = (number_weights[k] * number_weights[j]).sum() - (
                root[k, :j] * root[j, :j]
            ).sum()
            if j < k:
                root[k, j] = covariance / root[j, j] if root[j, j] > 0 else 0.0
            elif covariance > _UNEXPLAINED_VARIANCE_FRACTION_MIN:
                root[k, k] = math.sqrt(covariance)
    return root


_UNEXPLAINED_VARIANCE_FRACTION_MIN = 1e-9
"""Smallest fraction of a bin's noise variance, not determined by the noise of the bins before it,
for which the bin gets an independent random number."""


def _event_probabilities(outputs: Mapping[str, np.ndarray]) -> EventProbabilities:
    """Return the :class:`EventProbabilities` that follow from the outputs of points."""
    pd_up, pd_down, pd_shot = (
        np.nan_to_num(outputs[f"pd_{name}"]) for name in ("up", "down", "shot")
    )
    stated_both = outputs.get(PD_BOTH_CHIRPS_NAME, np.full(pd_up.shape, np.nan))
    both = np.where(np.isfinite(stated_both), stated_both, pd_shot)
    down_pd = down_pd_given_up_result(pd_up, pd_down, both)
    pd_doppler = np.nan_to_num(outputs["pd_doppler"])
    doppler_pd = doppler_pd_given_chirps(
        pd_doppler, pd_up + pd_down - 2 * both, pd_shot - both, np.isfinite(stated_both)
    )
    pfa_noise_up = outputs["pfa_segment"]
    both, log_pfa_up = outputs["log10_pfa_both_chirps"], outputs["log10_pfa_segment"]
    has_free_bins = np.isfinite(log_pfa_up)  # else the detection occupies every bin
    pfa_noise_down = np.where(
        has_free_bins, 10 ** (both - np.where(has_free_bins, log_pfa_up, 0.0)), 0.0
    )
    alarm_up = 1 - (1 - pfa_noise_up) * (1 - outputs["p_leakage_up"])
    alarm_down = 1 - (1 - pfa_noise_down) * (1 - outputs["p_leakage_down"])
    return EventProbabilities(
        false_alarm_probability=np.array([alarm_up, np.zeros_like(alarm_up), alarm_down]),
        pd_if_condition_fails=np.array(
            [pd_up, doppler_pd.pd_if_condition_fails, down_pd.pd_if_condition_fails]
        ),
        pd_if_condition_holds=np.array(
            [pd_up, doppler_pd.pd_if_condition_holds, down_pd.pd_if_condition_holds]
        ),
    )


def threshold_and_line_noise_ratios(shots: Shots) -> tuple[np.ndarray, np.ndarray]:
    """Return the threshold, and the noise of the echo's bins per quadrature, over sigma, (n,) each.

    sigma is the noise of a bin without signal per quadrature.
    """
    ratios = np.stack([shots.threshold, shots.line_noise_sigma]) / shots.bin_noise_sigma
    threshold_ratio, line_noise_ratio = np.ascontiguousarray(
        np.broadcast_to(ratios, (2, shots.size))
    )
    return threshold_ratio, line_noise_ratio


ECHO_NOISE_FIRST_RANDOM_INDEX = np.int64(1 << 24)
"""Index, in the noise stream, of the first random number used for the noise of all bins of an echo.
Lower indices are used for bins whose noise is drawn one by one."""


class NoiselessSpectra(NamedTuple):
    """Spectra without noise by point and segment, (m, 3), to which noise is added.

    Indices of bins are counted from the segment's ``first_bin``. sigma is the noise of a bin per
    quadrature.
    """

    first_bin: np.ndarray
    """(m, 3) int64: number of the first bin that holds signal."""
    peak_index: np.ndarray
    """(m, 3) int64: index of the bin with the largest magnitude, counted from ``first_bin``."""
    peak_magnitude_ratio: np.ndarray
    """(m, 3): largest |X| / sigma of the segment; nan for a segment that does not exist. sigma is
    the noise of a bin per quadrature."""
    peak_has_real_noise: np.ndarray
    """(m, 3) bool: True if the noise in the bin with the largest magnitude is real, as at frequency
    0 (DC) and Nyquist."""
    bins_start: np.ndarray
    """(m, 3) int64: index of the segment's first bin in ``bin_magnitude_ratios`` and ``is_echo``.
    """
    n_bins: np.ndarray
    """(m, 3) int64: number of the segment's bins in ``bin_magnitude_ratios`` and ``is_echo``."""
    bin_magnitude_ratios: np.ndarray
    """(bins,): |X| / sigma in the bins of all points and segments. sigma is the noise of a bin per
    quadrature."""
    is_echo: np.ndarray
    """(bins,) bool: mask of the bins, of all points and segments, that belong to an echo."""
    n_noise_bins: np.ndarray
    """(m, 3): equivalent number of independent bins that hold noise alone and may raise a false
    alarm (not an integer)."""
    leaked_begin: np.ndarray
    """(m, 3) int64: index of each segment's first bin in the arrays (leaked,): ``leaked_index``,
    ``leaked_magnitude_ratio``, ``exempt_neighbour_magnitude_ratio`` and
    ``side_of_adjacent_echo_bin``."""
    leaked_end: np.ndarray
    """(m, 3) int64: index of each segment's last bin, plus 1, in the arrays (leaked,) that
    ``leaked_begin`` names. It equals ``leaked_begin`` without leaked signal."""
    leaked_index: np.ndarray
    """(leaked,) int64: indices, counted from ``first_bin``, of the bins with signal leaked from an
    echo. Leaked signal and noise together may raise a false alarm in these bins."""
    leaked_magnitude_ratio: np.ndarray
    """(leaked,): |X| / sigma in the bins that hold leaked signal. sigma is the noise of a bin per
    quadrature."""
    exempt_neighbour_magnitude_ratio: np.ndarray
    """(leaked,): |X| / sigma of the adjacent bin, if it belongs to an echo and so cannot raise a
    false alarm; 0 if neither adjacent bin does. sigma is the noise of a bin per quadrature."""
    side_of_adjacent_echo_bin: np.ndarray
    """(leaked,) int64: 1 if the next higher bin belongs to an echo, -1 if the next lower bin does;
    without meaning if neither does."""

    @classmethod
    def empty(cls, n_points: int) -> "NoiselessSpectra":
        """Return a record without bins, for draws that compare numbers with probabilities."""
        zeros, no_numbers, no_values = (
            np.zeros((n_points, 3), np.int64),
            np.empty(0, np.int64),
            np.empty(0),
        )
        return cls(
            first_bin=zeros,
            peak_index=zeros,
            peak_magnitude_ratio=np.full((n_points, 3), np.nan),
            peak_has_real_noise=np.zeros((n_points, 3), np.bool_),
            bins_start=zeros,
            n_bins=zeros,
            bin_magnitude_ratios=no_values,
            is_echo=np.empty(0, np.bool_),
            n_noise_bins=np.zeros((n_points, 3)),
            leaked_begin=zeros,
            leaked_end=zeros,
            leaked_index=no_numbers,
            leaked_magnitude_ratio=no_values,
            exempt_neighbour_magnitude_ratio=no_values,
            side_of_adjacent_echo_bin=no_numbers,
        )


def iter_noiseless_spectra(
    shots: Shots, point_indices: np.ndarray | None = None
) -> Iterator[tuple[np.ndarray, NoiselessSpectra]]:
    """Yield indices of points and their noiseless spectra, in batches that fit into memory.

    Parameters
    ----------
    shots
        Prepared shots.
    point_indices
        Points to include; by default all.
    """
    noise_sigma, has_real_ends = shots.bin_noise_sigma, shots.fft_size_if_end_bins_real > 0
    # Without leakage only the peak is evaluated.
    negligible_ratio = (
        shots.negligible_signal_ratio + np.zeros(shots.size)
        if shots.detection_settings.leakage_raises_false_alarms
        else np.full(shots.size, np.inf)
    )
    magnitude_min = np.minimum(shots.threshold, negligible_ratio * noise_sigma)
    for spans in iter_spans(
        shots, points=point_indices, level_min=magnitude_min, leakage=False, computes_pd=False
    ):
        n_bins, start, peak_index = (
            c.T.ravel() for c in (spans.n_bins, spans.span_start, spans.peak_index)
        )
        span_of_bin = np.repeat(np.arange(n_bins.size), n_bins)  # segment of each bin
        index_in_span = np.arange(span_of_bin.size) - (np.cumsum(n_bins) - n_bins)[span_of_bin]
        flat_index, point_of_bin = (
            start[span_of_bin] + index_in_span,
            spans.point_numbers[span_of_bin // 3],
        )
        ratio = spans.magnitudes[flat_index] / noise_sigma[point_of_bin]
        is_searched = spans.peak_is_searched.T.ravel()
        is_leaked = (ratio >= negligible_ratio[point_of_bin]) & (
            (index_in_span != peak_index[span_of_bin]) | ~is_searched[span_of_bin]
        )
        is_leaked &= ~spans.is_exempt[flat_index]
        exempt_ratios = np.pad(np.where(spans.is_exempt[flat_index], ratio, 0.0), 1)
        below = np.where(index_in_span > 0, exempt_ratios[:-2], 0.0)
        above = np.where(index_in_span < n_bins[span_of_bin] - 1, exempt_ratios[2:], 0.0)
        n_leaked = np.bincount(span_of_bin[is_leaked], minlength=n_bins.size).reshape(-1, 3)
        leaked_end = np.cumsum(n_leaked).reshape(-1, 3)
        exists = spans.n_bins.T > 0
        n_exempt = np.where(exists, spans.n_exempt.T, 0.0)
        n_noise_bins = shots.n_alarm_equivalent_bins(n_exempt.T, spans.point_numbers).T - n_leaked
        spectra = NoiselessSpectra(
            first_bin=np.where(exists, spans.first_bin.T, 0),
            peak_index=np.where(exists, spans.peak_index.T, 0),
            peak_has_real_noise=np.isin(
                (spans.first_bin + spans.peak_index).T, (0, shots.fft_size_if_end_bins_real / 2)
            )
            & exists
            & has_real_ends,
            peak_magnitude_ratio=np.where(
                exists & spans.peak_is_searched.T,
                spans.peak_magnitude.T / noise_sigma[spans.point_numbers, None],
                np.nan,
            ),
            bins_start=(np.cumsum(n_bins) - n_bins).reshape(-1, 3),
            n_bins=spans.n_bins.T,
            bin_magnitude_ratios=ratio,
            is_echo=spans.is_exempt[flat_index],
            n_noise_bins=np.maximum(n_noise_bins, 0.0),
            leaked_begin=leaked_end - n_leaked,
            leaked_end=leaked_end,
            leaked_index=index_in_span[is_leaked],
            leaked_magnitude_ratio=ratio[is_leaked],
            exempt_neighbour_magnitude_ratio=np.maximum(below, above)[is_leaked],
            side_of_adjacent_echo_bin=np.where(above >= below, 1, -1)[is_leaked],
        )
        # In C order as in `NoiselessSpectra.empty`: numba compiles anew for each order.
        yield spans.point_numbers, NoiselessSpectra(*map(np.ascontiguousarray, spectra))


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_and_count_events(draw_ranges, batch_edges, config, inputs, spectra, counts):
    """Draw detections and false alarms in m ranges of draws, and add them to the counts.

    Parameters
    ----------
    draw_ranges
        :class:`DrawRanges` of m rows.
    batch_edges
        (batches + 1,): numbers of the draws at which batches begin, and the number after the last
        draw.
    config
        :class:`DrawCountConfig`.
    inputs
        :class:`DrawCountInputs` of the rows.
    spectra
        :class:`NoiselessSpectra` of the rows.
    counts
        :class:`DrawCounts` of the points; the counts are added to it.
    """
    n_filter_bins, n_taps = config.noise_filter.weights.shape
    noise = NoiseScratch(
        np.empty(n_filter_bins + n_taps),
        np.empty(n_filter_bins + n_taps),
        np.empty(n_filter_bins + n_taps),
        np.empty(n_filter_bins + n_taps),
    )
    random_words = np.empty((4, _DRAWS_PER_STEP), np.uint64)
    segment_factors = np.ones((3, _DRAWS_PER_STEP))
    speckle_factors_in_phase, speckle_factors_in_quadrature = (
        np.zeros((3, _DRAWS_PER_STEP)),
        np.zeros((3, _DRAWS_PER_STEP)),
    )
    speckle_factor_in_phase, speckle_factor_in_quadrature = (
        np.ones(_DRAWS_PER_STEP),
        np.zeros(_DRAWS_PER_STEP),
    )
    no_amplitudes = np.zeros((3, 0, 0), np.complex128)
    is_detected, has_alarm = np.empty((2, 3, _DRAWS_PER_STEP), np.bool_)
    for j in range(draw_ranges.point_index.size):
        threshold_ratio, line_noise_ratio = inputs.threshold_ratio[j], inputs.line_noise_ratio[j]
        in_speckle = inputs.speckle_mixing.doppler_from_independent.size > 0
        i, batch = draw_ranges.point_index[j], 0
        for first in range(draw_ranges.first_draw[j], draw_ranges.end_draw[j], _DRAWS_PER_STEP):
            n_draws = min(_DRAWS_PER_STEP, draw_ranges.end_draw[j] - first)
            address = DrawAddress(draw_ranges.keys[j, 0], draw_ranges.keys[j, 1], first)
            is_detected[:], has_alarm[:] = False, False
            for d in range(n_draws if in_speckle else 0):
                amplitudes = speckle_amplitudes(
                    DrawAddress(address.key_0, address.key_1, first + d),
                    INTEGER_ZERO,
                    speckle_mixing_of_point(inputs.speckle_mixing, j),
                )
                for s in range(3):
                    speckle_factors_in_phase[s, d] = amplitudes[s].real
                    speckle_factors_in_quadrature[s, d] = amplitudes[s].imag
                    segment_factors[s, d] = math.hypot(
                        speckle_factors_in_phase[s, d], speckle_factors_in_quadrature[s, d]
                    )
            echo_amplitudes = no_amplitudes
            if in_speckle and n_filter_bins > 0:
                echo_amplitudes = _draw_echo_amplitudes(
                    address,
                    n_draws,
                    j,
                    spectra,
                    inputs.line_grid,
                    inputs.line_centre,
                    segment_factors,
                )
            for s in (0, 2, 1):
                stream, peak_magnitude_ratio, peak_index = (
                    STREAM_NOISE[s],
                    spectra.peak_magnitude_ratio[j, s],
                    spectra.peak_index[j, s],
                )
                pseudo_variance_row = inputs.pseudo_variance_row[s, j]
                pseudo_variance_ratios = config.pseudo_variance_ratio[
                    pseudo_variance_row,
                    : (config.pseudo_variance_ratio.shape[1] if pseudo_variance_row > 0 else 0),
                ]
                if config.adds_noise and n_filter_bins > 0:
                    _mark_any_bin_crossings(
                        address,
                        n_draws,
                        j,
                        s,
                        spectra,
                        config.noise_filter,
                        bin_threshold_of_point(inputs.bin_thresholds, j),
                        echo_amplitudes[s],
                        noise,
                        is_detected[s],
                    )
                elif config.adds_noise:
                    noise_deviation_in_phase = noise_deviation_in_quadrature = line_noise_ratio
                    if spectra.peak_has_real_noise[j, s]:
                        noise_deviation_in_phase = math.sqrt(2.0) * line_noise_ratio
                        noise_deviation_in_quadrature = 0.0
                    speckle_factor_in_phase[:], speckle_factor_in_quadrature[:] = (
                        segment_factors[s],
                        0.0,
                    )
                    if pseudo_variance_row > 0:
                        bin_pseudo_variance = pseudo_variance_ratio_at(
                            spectra.first_bin[j, s] + peak_index,
                            config.nyquist_bin,
                            pseudo_variance_ratios,
                        )
                        speckle_factor_in_phase[:] = (
                            math.sqrt(1.0 + bin_pseudo_variance) * speckle_factors_in_phase[s]
                        )
                        speckle_factor_in_quadrature[:] = (
                            math.sqrt(max(1.0 - bin_pseudo_variance, 0.0))
                            * speckle_factors_in_quadrature[s]
                        )
                    peak_bin = BinInNoise(
                        peak_magnitude_ratio,
                        noise_deviation_in_phase,
                        noise_deviation_in_quadrature,
                        threshold_ratio * threshold_ratio,
                        speckle_factor_in_phase,
                        speckle_factor_in_quadrature,
                    )
                    _mark_crossings(
                        address,
                        n_draws,
                        stream,
                        peak_index,
                        peak_bin,
                        random_words,
                        is_detected[s],
                    )
                else:
                    condition = is_detected[0] if s == 2 else is_detected[0] ^ is_detected[2]
                    _mark_random_events(
                        address,
                        n_draws,
                        STREAM_DETECTION[s],
                        inputs.pd_if_condition_fails[s, j],
                        inputs.pd_if_condition_holds[s, j],
                        condition,
                        random_words,
                        is_detected[s],
                    )
                if inputs.pfa[s, j] > 0.0:
                    alarm_stream = (
                        STREAM_NOISE_MAXIMUM[s] if config.adds_noise else STREAM_FALSE_ALARM[s]
                    )
                    _mark_random_events(
                        address,
                        n_draws,
                        alarm_stream,
                        inputs.pfa[s, j],
                        inputs.pfa[s, j],
                        is_detected[0],
                        random_words,
                        has_alarm[s],
                    )
                _mark_leakage_alarms(
                    address,
                    n_draws,
                    j,
                    s,
                    spectra,
                    threshold_ratio,
                    config.sidelobe_neighbour_noise_correlation,
                    segment_factors[s],
                    random_words,
                    has_alarm[s],
                )
            for d in range(n_draws):
                while first + d >= batch_edges[batch + 1]:
                    batch += 1
                up_detects, doppler_detects, down_detects = (
                    is_detected[0, d],
                    is_detected[1, d],
                    is_detected[2, d],
                )
                by_doppler = (
                    inputs.detects_by_any_two_segments[j]
                    & doppler_detects
                    & (up_detects | down_detects)
                )
                counts.up_detections[i, batch] += up_detects
                counts.down_detections[i, batch] += down_detects
                counts.doppler_detections[i, batch] += doppler_detects
                counts.shot_detections[i, batch] += (up_detects & down_detects) | by_doppler
                counts.up_alarms[i, batch] += has_alarm[0, d]
                counts.down_alarms[i, batch] += has_alarm[2, d]
                counts.joint_alarms[i, batch] += has_alarm[0, d] & has_alarm[2, d]


@njit(cache=True, error_model="numpy")
def _mark_leakage_alarms(
    address,
    n_draws,
    point,
    segment,
    spectra,
    threshold_ratio,
    sidelobe_neighbour_noise_correlation,
    magnitude_factors,
    random_words,
    has_alarm,
):
    """Mark the draws in which bins of leaked signal, with their noise, raise a false alarm.

    A bin crosses if its magnitude reaches the threshold. Crossing bins next to an echo whose
    outermost bin crosses too belong to the echo.

    Parameters
    ----------
    address, n_draws
        Address of the first draw (:class:`sweep.model.sampling.philox.DrawAddress`), and number of
        draws.
    point, segment
        Index of the point in ``spectra``, and segment.
    spectra
        :class:`NoiselessSpectra`.
    threshold_ratio
        Threshold [sigma].
    sidelobe_neighbour_noise_correlation
        Correlation of the noise of neighbouring bins in phase with the signal.
    magnitude_factors
        (draws,): factors that speckle puts on magnitudes.
    random_words
        (4, draws) uint64: scratch for random numbers.
    has_alarm
        (draws,) bool: set to True in draws with a false alarm.
    """
    key_0, key_1, first_draw = address
    stream = STREAM_NOISE[segment]
    independent_part = math.sqrt(
        1.0 - sidelobe_neighbour_noise_correlation * sidelobe_neighbour_noise_correlation
    )
    zeros, joins_echo = np.zeros(n_draws), np.zeros(n_draws, np.bool_)
    begin, end = spectra.leaked_begin[point, segment], spectra.leaked_end[point, segment]
    # A group that begins or ends next to an echo belongs to the echo as a whole. So an alarm
    # is pending until its group ends.
    is_pending, is_crossing = np.zeros(n_draws, np.bool_), np.empty(n_draws, np.bool_)
    for leaked_bin in range(begin, end):
        if (
            leaked_bin > begin
            and spectra.leaked_index[leaked_bin] != spectra.leaked_index[leaked_bin - 1] + 1
        ):
            for d in range(n_draws):
                has_alarm[d] |= is_pending[d]
                is_pending[d] = joins_echo[d] = False
        is_crossing[:] = False
        bin_in_noise = BinInNoise(
            spectra.leaked_magnitude_ratio[leaked_bin],
            1.0,
            1.0,
            threshold_ratio * threshold_ratio,
            magnitude_factors,
            zeros,
        )
        _mark_crossings(
            address,
            n_draws,
            stream,
            spectra.leaked_index[leaked_bin],
            bin_in_noise,
            random_words,
            is_crossing,
        )
        for d in range(n_draws):
            if not is_crossing[d]:
                has_alarm[d] |= is_pending[d]
                is_pending[d] = joins_echo[d] = False
                continue
            if spectra.exempt_neighbour_magnitude_ratio[leaked_bin] > 0.0:
                re, im = philox.normal_pair(
                    key_0, key_1, first_draw + d, stream, spectra.leaked_index[leaked_bin]
                )
                edge_index = (
                    spectra.leaked_index[leaked_bin] + spectra.side_of_adjacent_echo_bin[leaked_bin]
                )
                re_edge, im_edge = philox.normal_pair(
                    key_0, key_1, first_draw + d, stream, edge_index
                )
                in_phase = (
                    spectra.exempt_neighbour_magnitude_ratio[leaked_bin] * magnitude_factors[d]
                    + sidelobe_neighbour_noise_correlation * re
                    + independent_part * re_edge
                )
                in_quadrature = (
                    sidelobe_neighbour_noise_correlation * im + independent_part * im_edge
                )
                joins_echo[d] |= math.hypot(in_phase, in_quadrature) >= threshold_ratio
            is_pending[d] = not joins_echo[d]
    for d in range(n_draws):
        has_alarm[d] |= is_pending[d]


@njit(cache=True, error_model="numpy", borrows=True)
def speckle_factors(address, group, mixing):
    """Return the real factors, due to speckle, on an echo's magnitudes in the three segments.

    Parameters
    ----------
    address : DrawAddress
        Address of the draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    group : int
        Number of the echo (group of adjacent bins).
    mixing : SpeckleMixing
        Coefficients of the point, scalars
        (:class:`sweep.model.detection.echo_detection.SpeckleMixing`).

    Returns
    -------
    up, doppler, down : float
        Factors on |X| in each segment, of mean square 1.
    """
    up, doppler, down = speckle_amplitudes(address, group, mixing)
    return (
        math.hypot(up.real, up.imag),
        math.hypot(doppler.real, doppler.imag),
        math.hypot(down.real, down.imag),
    )


@njit(cache=True, error_model="numpy", borrows=True)
def speckle_amplitudes(address, group, mixing):
    """Return the complex factors, due to speckle, on an echo's amplitudes in the three segments.

    Their mean square is 1.

    Parameters
    ----------
    address : DrawAddress
        Address of the draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    group : int
        Number of the echo (group of adjacent bins).
    mixing : SpeckleMixing
        Coefficients of the point, scalars
        (:class:`sweep.model.detection.echo_detection.SpeckleMixing`).

    Returns
    -------
    SegmentAmplitudeFactors
        Mixtures of three independent circular normal amplitudes of the echo.
    """
    key_0, key_1, draw = address
    stream, root_half = philox.STREAM_SPECKLE, math.sqrt(0.5)
    re_0, im_0 = philox.normal_pair(key_0, key_1, draw, stream, 3 * group)
    re_1, im_1 = philox.normal_pair(key_0, key_1, draw, stream, 3 * group + 1)
    re_2, im_2 = philox.normal_pair(key_0, key_1, draw, stream, 3 * group + 2)
    doppler_re = mixing.doppler_from_up * re_0 + mixing.doppler_from_independent * re_1
    doppler_im = mixing.doppler_from_up * im_0 + mixing.doppler_from_independent * im_1
    down_re = (
        mixing.down_from_up * re_0
        + (mixing.down_from_doppler_re * re_1 - mixing.down_from_doppler_im * im_1)
        + mixing.down_from_independent * re_2
    )
    down_im = (
        mixing.down_from_up * im_0
        + (mixing.down_from_doppler_re * im_1 + mixing.down_from_doppler_im * re_1)
        + mixing.down_from_independent * im_2
    )
    return SegmentAmplitudeFactors(
        complex(root_half * re_0, root_half * im_0),
        complex(root_half * doppler_re, root_half * doppler_im),
        complex(root_half * down_re, root_half * down_im),
    )


@njit(cache=True, error_model="numpy", borrows=True)
def _mark_random_events(
    address,
    n_draws,
    stream,
    probability_otherwise,
    probability_if_condition,
    condition,
    random_words,
    is_marked,
):
    """Mark draws in which a random number is below the probability of an event.

    Parameters
    ----------
    address : DrawAddress
        Address of the first draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    n_draws : int
        Number of consecutive draws.
    stream : int
        Number of the stream. Its first number in each draw is compared with the probability.
    probability_otherwise, probability_if_condition : float
        Probabilities of the event: in draws whose condition is False, and True.
    condition : ndarray (draws,) bool
        The condition; it may be the same array as ``is_marked``.
    random_words : ndarray (4, >= n_draws) uint64
        Scratch.
    is_marked : ndarray (draws,) bool
        Result: set to True in draws with the event, unchanged in others.
    """
    philox.fill_words(
        address,
        stream,
        philox.FIRST_BLOCK_NUMBER,
        philox.DRAW_INCREMENTS,
        n_draws,
        random_words,
    )
    for d in range(n_draws):
        probability = probability_if_condition if condition[d] else probability_otherwise
        is_marked[d] |= philox.to_uniform(random_words[0, d]) < probability


@njit(cache=True, error_model="numpy")
def _first_and_last_echo_index(point, segment, spectra):
    """Return an echo's first and last bin, as indices counted from the segment's first bin.

    The last index is -1 if the segment has no echo.
    """
    bins_start, n_bins = spectra.bins_start[point, segment], spectra.n_bins[point, segment]
    first_index, last_index = 0, n_bins - 1
    while first_index < n_bins and not spectra.is_echo[bins_start + first_index]:
        first_index += 1
    while last_index > first_index and not spectra.is_echo[bins_start + last_index]:
        last_index -= 1
    return first_index, (last_index if first_index < n_bins else -1)


@njit(cache=True, error_model="numpy")
def _draw_echo_amplitudes(address, n_draws, row, spectra, line_grid, line_centres, segment_factors):
    """Draw the complex factors, due to developed speckle, on the bins of a point's echo.

    The factors have mean power 1, and follow from the lines of the footprint
    (:func:`sweep.model.sampling.speckle_lines.draw_bin_amplitudes`). Bins that no line reaches have
    the factor of the strongest bin.

    Parameters
    ----------
    address : DrawAddress
        Address of the first draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    n_draws : int
        Number of consecutive draws.
    row : int
        Index of the point in ``spectra``, ``line_grid`` and ``line_centres``.
    spectra : NoiselessSpectra
        Spectra without noise, with the bins of each echo (:class:`NoiselessSpectra`).
    line_grid : SpeckleLineGrid
        Lines that represent the footprints
        (:class:`sweep.model.sampling.speckle_lines.SpeckleLineGrid`).
    line_centres : ndarray (m, 3)
        Mean position of the lines of each segment's echo [bins].
    segment_factors : ndarray (3, draws)
        Result: magnitude of the factor of the strongest bin. It is unchanged for a segment without
        an echo.

    Returns
    -------
    ndarray (3, draws, bins) complex
        Factors by segment (up, Doppler, down), draw, and bin from the first bin of the echo on. The
        number of bins is that of the widest of the three echoes. A segment without an echo has 0.
    """
    line_centre = line_centres[row].copy()
    first_bin, n_bins_max = np.zeros(3, np.int64), 0
    first_index = np.zeros(3, np.int64)
    for s in range(3):
        begin_index, end_index = _first_and_last_echo_index(row, s, spectra)
        first_bin[s], first_index[s] = spectra.first_bin[row, s] + begin_index, begin_index
        n_bins_max = max(n_bins_max, end_index - begin_index + 1)
        if end_index < begin_index:
            line_centre[s] = np.nan
    mean_power, pseudo_variance = np.zeros((3, n_bins_max)), np.zeros((3, n_bins_max))
    has_images = fill_mean_bin_powers(
        line_grid, row, line_centre, first_bin, mean_power, pseudo_variance
    )
    n_rows_max, factor_rank = 3 * n_bins_max, 0
    factor = np.empty(
        (n_rows_max if n_rows_max <= FACTORED_BINS_MAX else 0, 3, n_bins_max), np.complex128
    )
    if factor.shape[0] > 0 and not has_images:
        factor_rank = factor_bin_covariance(
            line_grid, row, line_centre, first_bin, mean_power, factor
        )
    amplitudes, drawn_amplitudes = (
        np.zeros((3, n_draws, n_bins_max), np.complex128),
        np.zeros((3, n_bins_max), np.complex128),
    )
    for d in range(n_draws):
        address_of_draw = DrawAddress(address.key_0, address.key_1, address.draw + d)
        if factor_rank > 0:
            draw_factored_amplitudes(
                address_of_draw, INTEGER_ZERO, factor, factor_rank, drawn_amplitudes
            )
        else:
            draw_bin_amplitudes(
                address_of_draw,
                INTEGER_ZERO,
                line_grid,
                row,
                line_centre,
                first_bin,
                mean_power,
                drawn_amplitudes,
            )
        for s in range(3):
            peak_index = spectra.peak_index[row, s] - first_index[s]
            if not 0 <= peak_index < n_bins_max:
                continue
            segment_factors[s, d] = abs(drawn_amplitudes[s, peak_index])
            for k in range(n_bins_max):
                amplitudes[s, d, k] = (
                    drawn_amplitudes[s, k]
                    if mean_power[s, k] > 0.0
                    else drawn_amplitudes[s, peak_index]
                )
    return amplitudes


@njit(cache=True, error_model="numpy")
def _mark_any_bin_crossings(
    address,
    n_draws,
    point,
    segment,
    spectra,
    filter_rule,
    bin_threshold,
    echo_amplitudes,
    noise,
    is_marked,
):
    """Mark the draws in which any bin of an echo, with its noise, reaches the threshold.

    A bin reaches the threshold t if

        |r A + (1 + p |A|^2)^(1/2) n| >= t

    with its noiseless magnitude r, speckle factor A, complex noise n, and power p of the
    phase-noise pedestal, which fades with the echo. r, t and n are over sigma, the receiver's noise
    of a bin per quadrature. p is over the receiver's noise power.

    Parameters
    ----------
    address : DrawAddress
        Address of the first draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    n_draws : int
        Number of consecutive draws.
    point, segment : int
        Index of the point in ``spectra``, and of the segment: 0 up, 1 Doppler, 2 down.
    spectra : NoiselessSpectra
        Spectra without noise (:class:`NoiselessSpectra`).
    filter_rule : NoiseFilter
        Filter that makes the correlated noise of at least as many bins as the echo has
        (:class:`NoiseFilter`).
    bin_threshold : BinThreshold
        Threshold and noise of the point
        (:class:`sweep.model.detection.echo_detection.BinThreshold`).
    echo_amplitudes : ndarray (draws, bins) complex
        Factors A of the bins, from the first bin of the echo on; no bins if the echo does not fade.
    noise : NoiseScratch
        Scratch for the noise of the echo's bins (:class:`NoiseScratch`).
    is_marked : ndarray (draws,) bool
        Result: set to True in draws with a crossing, unchanged in others.
    """
    begin, n_bins = spectra.bins_start[point, segment], spectra.n_bins[point, segment]
    bin_magnitude_ratios, is_echo = (
        spectra.bin_magnitude_ratios[begin : begin + n_bins],
        spectra.is_echo[begin : begin + n_bins],
    )
    first_index, last_index = _first_and_last_echo_index(point, segment, spectra)
    if last_index < 0:
        return
    threshold_ratio = bin_threshold.threshold / bin_threshold.noise_sigma_without_pedestal
    pedestal_power = np.zeros(n_bins)
    if (
        bin_threshold.noise_sigma_next_to_lines > bin_threshold.noise_sigma_without_pedestal
        or bin_threshold.line_noise_sigma > bin_threshold.noise_sigma_without_pedestal
    ):
        fill_pedestal_ratios(bin_magnitude_ratios, is_echo, bin_threshold, pedestal_power)
    for d in range(n_draws):
        draw_bin_noise(
            DrawAddress(address.key_0, address.key_1, address.draw + d),
            STREAM_NOISE[segment],
            ECHO_NOISE_FIRST_RANDOM_INDEX,
            spectra.first_bin[point, segment] + first_index,
            last_index - first_index + 1,
            filter_rule,
            noise,
        )
        for i in range(first_index, last_index + 1):
            amplitude = (
                echo_amplitudes[d, i - first_index]
                if echo_amplitudes.shape[1] > 0
                else complex(1.0, 0.0)
            )
            noise_deviation = math.sqrt(1.0 + pedestal_power[i] * abs(amplitude) ** 2)
            re = (
                noise_deviation * noise.in_phase[i - first_index]
                + bin_magnitude_ratios[i] * amplitude.real
            )
            im = (
                noise_deviation * noise.in_quadrature[i - first_index]
                + bin_magnitude_ratios[i] * amplitude.imag
            )
            is_marked[d] |= is_echo[i] and re * re + im * im >= threshold_ratio * threshold_ratio


@njit(cache=True, error_model="numpy", borrows=True)
def draw_bin_noise(address, stream, first_index, first_bin, n_bins, filter_rule, noise):
    """Draw the noise of adjacent bins in units of sigma, correlated by window and zero padding.

    Parameters
    ----------
    address, stream
        Address of the draw (:class:`sweep.model.sampling.philox.DrawAddress`), and stream.
    first_index
        Stream index of the first pair of independent numbers.
    first_bin, n_bins
        First bin and number of bins.
    filter_rule
        :class:`NoiseFilter` of at least as many bins.
    noise
        :class:`NoiseScratch` of at least as many bins, to which the noise is written.

    Notes
    -----
    sigma is the standard deviation of a bin's noise per quadrature. At DC and Nyquist of a real
    record the noise is real, and bins on either side are complex conjugates.
    """
    key_0, key_1, draw = address
    weights, start = filter_rule.weights, filter_rule.first_number_index
    fft_size_if_end_bins_real = filter_rule.fft_size_if_end_bins_real
    n_taps = weights.shape[1]
    is_from_nyquist = (
        fft_size_if_end_bins_real > 0 and 2 * (first_bin + n_bins - 1) == fft_size_if_end_bins_real
    )  # counted from Nyquist
    is_symmetric = is_from_nyquist or (fft_size_if_end_bins_real > 0 and first_bin == 0)
    first_number = 0 if is_symmetric else start[0]
    for j in range(start[n_bins - 1] + n_taps - first_number):
        re, im = philox.normal_pair(key_0, key_1, draw, stream, first_index + j)
        if is_symmetric and j == 0:
            re, im = math.sqrt(2.0) * re, 0.0
        noise.independent_in_phase[j], noise.independent_in_quadrature[j] = re, im
    for k in range(n_bins):
        re, im = 0.0, 0.0
        for m in range(n_taps):
            j = start[k] + m - first_number
            sign = -1.0 if is_symmetric and j < 0 else 1.0  # conjugate in a real record
            re += weights[k, m] * noise.independent_in_phase[abs(j)]
            im += weights[k, m] * sign * noise.independent_in_quadrature[abs(j)]
        i = n_bins - 1 - k if is_from_nyquist else k
        noise.in_phase[i], noise.in_quadrature[i] = re, im


@njit(cache=True, error_model="numpy", borrows=True)
def draw_bin_noise_by_root(address, stream, first_index, n_bins, root, noise):
    """Draw the noise of adjacent bins in units of sigma, by a Cholesky factor of its covariance.

    Parameters
    ----------
    address, stream
        Address of the draw (:class:`sweep.model.sampling.philox.DrawAddress`), and stream.
    first_index
        Stream index of the first pair of independent numbers; even.
    n_bins
        Number of bins.
    root
        Result of :func:`noise_covariance_root`.
    noise
        :class:`NoiseScratch` of at least as many bins, to which the noise is written.

    Notes
    -----
    sigma is the standard deviation of a bin's noise per quadrature.
    """
    key_0, key_1, draw = address
    re_numbers, im_numbers = noise.independent_in_phase, noise.independent_in_quadrature
    for k in range(0, n_bins, 2):
        radius_word, angle_word, next_radius_word, next_angle_word = philox.four_words(
            key_0, key_1, draw, stream, (first_index + k) >> 1
        )
        re_numbers[k], im_numbers[k] = philox.to_normals(radius_word, angle_word)
        if k + 1 < n_bins:
            re_numbers[k + 1], im_numbers[k + 1] = philox.to_normals(
                next_radius_word, next_angle_word
            )
    for k in range(n_bins):
        re, im = 0.0, 0.0
        for j in range(k + 1):
            re += root[k, j] * re_numbers[j]
            im += root[k, j] * im_numbers[j]
        noise.in_phase[k], noise.in_quadrature[k] = re, im


@njit(cache=True, error_model="numpy", borrows=True)
def _mark_crossings(address, n_draws, stream, pair_index, bin_in_noise, random_words, is_marked):
    """Mark the draws in which signal plus noise of one bin reaches the threshold.

    The bin reaches the threshold t if (r a + s_i n_i)^2 + (r b + s_q n_q)^2 >= t^2, with its
    noiseless magnitude r, factor a + i b by speckle, standard deviations s_i and s_q of the noise,
    and independent standard normal numbers n_i and n_q.

    Parameters
    ----------
    address : DrawAddress
        Address of the first draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    n_draws : int
        Number of consecutive draws.
    stream : int
        Number of the stream of the noise.
    pair_index : int
        Index in the stream of the pair of numbers that make the noise.
    bin_in_noise : BinInNoise
        Signal, noise and threshold of the bin (:class:`BinInNoise`).
    random_words : ndarray (4, >= n_draws) uint64
        Scratch.
    is_marked : ndarray (draws,) bool
        Result: set to True in draws with a crossing, unchanged in others.
    """
    philox.fill_words(
        address, stream, pair_index >> 1, philox.DRAW_INCREMENTS, n_draws, random_words
    )
    lane = 2 * (pair_index & 1)
    for d in range(n_draws):
        re, im = philox.to_normals(random_words[lane, d], random_words[lane + 1, d])
        re = (
            bin_in_noise.magnitude_ratio * bin_in_noise.speckle_factor_in_phase[d]
            + re * bin_in_noise.noise_deviation_in_phase
        )
        im = (
            bin_in_noise.magnitude_ratio * bin_in_noise.speckle_factor_in_quadrature[d]
            + im * bin_in_noise.noise_deviation_in_quadrature
        )
        is_marked[d] |= re**2 + im**2 >= bin_in_noise.squared_threshold_ratio


@njit(cache=True, error_model="numpy")
def noise_maximum_at_probability(n_bins, probability, n_looks):
    """Return the |X| / sigma that the largest of n noise bins exceeds with a given probability.

    X is a bin of the spectrum, and sigma the standard deviation of its noise per quadrature.

    Parameters
    ----------
    n_bins
        Equivalent number of independent bins.
    probability
        Probability, 0..1.
    n_looks
        Number of looks (records of a segment). |X| is the root of their mean power.
    """
    if not n_bins > 0.0:
        return 0.0
    if n_looks > 1:
        bin_probability = -math.expm1(math.log1p(-probability) / n_bins)
        return math.sqrt(2.0 * gamma_upper_quantile(n_looks, bin_probability) / n_looks)
    return math.sqrt(-2.0 * math.log(-math.expm1(math.log1p(-probability) / n_bins)))


@njit(cache=True, error_model="numpy")
def gamma_upper_quantile(order, probability):
    """Return the x that a Gamma variable of scale 1 exceeds with a given probability.

    The quantile x solves Q(n, x) = p by bisection. Q is the regularised upper incomplete Gamma
    function of the integer order n,

        Q(n, x) = exp(-x) sum_{k < n} x^k / k!.

    Parameters
    ----------
    order : int
        Order n, at least 1.
    probability : float
        Probability p, 0..1. Values below 1e-300 count as 1e-300.

    Returns
    -------
    float
        Quantile x.
    """
    low, high = 0.0, 2.0 * (order + 40.0 - math.log(max(probability, 1e-300)))
    for _ in range(60):
        x = 0.5 * (low + high)
        term = total = 1.0
        for k in range(1, order):
            term *= x / k
            total += term
        if math.log(total) - x > math.log(max(probability, 1e-300)):
            low = x
        else:
            high = x
    return 0.5 * (low + high)
