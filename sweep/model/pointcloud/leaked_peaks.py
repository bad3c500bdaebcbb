"""False peaks by leaked signal: their bins, probabilities and magnitudes.

Each bin of a segment outside the echoes raises a false peak for two reasons, which are drawn
separately. Noise alone does so in all searched bins with equal probability. Leaked signal of
amplitude a (over the noise per quadrature sigma) raises bin k in additional draws, with the
probability that it adds to noise,

    c_k(z) = (Q_1(a_k, z) - e^(-z^2 / 2)) / (1 - e^(-z^2 / 2)),

at the threshold z = b. Q_1 is Marcum's function, the probability that signal and noise together
exceed z. Both together leave the bin below any level z with the probability

    (1 - e^(-z^2 / 2)) (1 - c_k(z)) = 1 - Q_1(a_k, z)

of Rice's law for signal and noise. So positions and magnitudes of false peaks have the same law as
in drawn noise. The probability of leakage of a segment is 1 - prod (1 - c_k(b)).

Bins are independent. With the rates r_k = -ln(1 - c_k), the first raised bin is the one at which
the sum of rates exceeds a random number of the exponential distribution. The search continues from
the next bin with another such number.

Crossing bins that are adjacent to an echo whose outermost bin crosses belong to the echo, both in
probabilities and in draws of peaks (:mod:`sweep.model.detection.added_crossings`).

An echo in developed speckle fades as a whole, together with its leaked signal. A bin fades with the
echo whose strongest bin is nearest. The probability of leakage is then the mean over speckle. With
the speckle's power u = e^t, of mean 1, and the sum R(u) of an echo's rates r(a_k sqrt(u)) it is

    P = int (1 - exp(-R(e^t))) e^(t - e^t) dt,

by the trapezoidal rule, which converges exponentially as the integrand vanishes at both ends. The
distance of its nodes is an integer number of steps of the tabulated ln(a). A bin's rates at all
nodes are then one row of a table, and R is a weighted sum of rows, without a logarithm
(:class:`SpeckleQuadrature`).

A line of leaked light (:mod:`sweep.model.effects.circulator_leak`) raises peaks in the bins of the
line. The magnitudes there depend on the line's phase, which is one of N_PHASES.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection.added_crossings import crossing_rate, echo_edge_crossing_probability
from sweep.model.detection.looks import Looks
from sweep.model.detection.marcum import marcum_q1_excess, marcum_q1_tails
from sweep.model.kernel_integers import INTEGER_ZERO, NO_INDEX
from sweep.model.pointcloud.bin_groups import BinGroups, allocate_bin_groups, find_groups_in_spans
from sweep.model.preparation import Shots
from sweep.model.sampling import philox
from sweep.model.sampling.draws import NoiselessSpectra, iter_noiseless_spectra
from sweep.model.spectrum.permanent_line import N_PHASES, line_bin_masks, permanent_line_of_point
from sweep.model.spectrum.segment_spectra import BinSpans, iter_spans

N_TABLE_AMPLITUDES = 2048
"""Number of signal amplitudes at which the crossing rate is tabulated. The rate of a bin is -ln(1 -
c), with c the probability that signal lifts the bin above the threshold."""

CERTAIN_CROSSING_MARGIN_SIGMA = 12.0
"""Amplitude minus threshold, in standard deviations of the noise per quadrature, from which signal
counts as certain to lift a bin above the threshold."""

TABLE_AMPLITUDE_MIN_SIGMA = 1e-2
"""Lowest signal amplitude, in standard deviations of the noise per quadrature, at which the
crossing rate is tabulated. The rate of a bin is -ln(1 - c), with c the probability that signal
lifts the bin above the threshold. At lower amplitudes the rate is proportional to the amplitude
squared."""

LEAKAGE_PROBABILITY_MIN = 1e-9
"""Probability per segment of a false peak by leaked signal, up to which no false peaks by leaked
signal are drawn."""

RAISED_BIN_RATE_SAFETY_FACTOR = 1.01
"""Factor by which a sum of crossing rates is multiplied to make it an upper bound. The sum contains
an integral over far bins, which is accurate to 1e-3."""

PERMANENT_LINE_FIRST_RANDOM_INDEX = np.int64(1 << 24)
"""Index, in the stream of leaked signal, of the first random number used for the line of light
leaked in the circulator. Lower indices are used for signal leaked from echoes."""

ECHO_EDGE_FIRST_RANDOM_INDEX = 1 << 25
"""Index of the first random number used for the noise of an echo's outermost bins, which are next
to bins of leaked signal."""

PERMANENT_LINE_POINTS_PER_BATCH = 4
"""Number of points that are processed together if light leaked in the circulator has a line. It
limits arrays to some 1e8 elements."""

N_BISECTION_STEPS = 40
"""Number of bisection steps that compute the magnitude of a false peak, to a relative error of
1e-11."""

LOG_SPECKLE_POWER_MIN, LOG_SPECKLE_POWER_MAX = -10.0, 3.5
"""Limits of the integral over speckle, in ln(speckle power). The mean speckle power is 1."""

FAINT_LEAKAGE_LOG_SPECKLE_POWER_MIN = -5.0
"""Lower limit, in ln(speckle power), of the integral over speckle for faint leaked signal. The
integral below this limit is extrapolated. Signal is faint if the sum of its crossing rates is at
most FAINT_LEAKAGE_CROSSING_RATE_SUM_MAX."""
FAINT_LEAKAGE_CROSSING_RATE_SUM_MAX = 0.1
"""Largest sum of the crossing rates of a segment's bins for which leaked signal counts as faint.
The rate of a bin is -ln(1 - c), with c the probability, at mean speckle power, that leaked signal
lifts the bin above the threshold. For faint signal the integral over speckle begins at
FAINT_LEAKAGE_LOG_SPECKLE_POWER_MIN."""

LOG_SPECKLE_POWER_STEP_MAX = 0.25
"""Largest step in ln(speckle power) of the integral over speckle. With this step the mean over
speckle has a relative error of 1e-8."""

JOINING_CROSSING_RATE_MIN = 1e-2
"""Smallest crossing rate of a bin, in bright speckle, at which the next bin may still join an echo.
The rate is -ln(1 - c), with c the probability that leaked signal lifts the bin above the threshold.
The run of bins that may join the echo ends at the first bin of a lower rate."""
BRIGHT_SPECKLE_LOG_AMPLITUDE = math.log(4.0)
"""ln of the factor on the signal amplitude that stands for bright speckle, in the comparison of
crossing rates with JOINING_CROSSING_RATE_MIN."""

FAINT_LEAKAGE_PROBABILITY_MAX = 1e-5
"""Largest probability, per segment, of a false peak by leaked signal for which the crossing
probabilities of bins, averaged over speckle, are simply added.

Bins with such faint signal hardly ever cross the threshold together with each other or with an
adjacent echo.
"""

MEAN_CROSSING_TABLE_STRIDE = 8
"""Number of table steps between signal amplitudes at which a bin's crossing probability is averaged
over speckle. The average at amplitudes between them is interpolated."""

N_RATE_BOUND_SPECKLE_POWERS = 5
"""Number of speckle powers (1, 2, 4 .. times the mean) at which upper bounds of the sum of a
segment's crossing rates are stored. The rate of a bin is -ln(1 - c), with c the probability that
signal lifts the bin above the threshold."""

ECHO_EDGE_LOG_SPECKLE_POWER_STEP = 0.75
"""Step in ln(speckle power) of the table of the probability that an echo's outermost bin crosses
the threshold."""
ECHO_EDGE_LOG_SPECKLE_POWER_DEPTH = 3.0
"""Largest -ln(speckle power) in the table of the probability that an echo's outermost bin crosses
the threshold. At lower powers the probability at this power is used."""

LOG_CROSSING_RATE_STEP_MAX = 0.5
"""Largest difference of ln(crossing rate) between successive nodes of the integral over speckle. A
larger difference would give the mean over speckle an error above 1e-7. The rate of a bin is -ln(1 -
c), with c the probability that signal lifts the bin above the threshold."""


class LeakageBins(NamedTuple):
    """Bins in which leaked signal may raise false peaks, by point and segment (m, 3).

    Leaked signal is echo power far from the echo's line. A bin crosses if its magnitude reaches the
    threshold. The crossing rate of a bin is -ln(1 - c), with c the probability that signal makes it
    cross. Rates are tabulated for each distinct threshold. sigma is the noise of a bin per
    quadrature.
    """

    bins_begin: np.ndarray
    """(m, 3) int64: index of each segment's first bin in the arrays (bins,): ``bins``,
    ``log_amplitude``, ``fading_group``, ``exempt_neighbour_magnitude_ratio`` and
    ``side_of_adjacent_echo_bin``."""
    bins_end: np.ndarray
    """(m, 3) int64: index of each segment's last bin, plus 1, in the arrays (bins,) that
    ``bins_begin`` names."""
    bins: np.ndarray
    """(bins,) int64: numbers of the bins that hold signal leaked from an echo."""
    log_amplitude: np.ndarray
    """(bins,): ln(|X| / sigma) of the leaked signal. sigma is the noise of a bin per quadrature."""
    fading_group: np.ndarray
    """(bins,) int64: index of the echo (group of adjacent bins) with whose speckle the bin fades.
    """
    exempt_neighbour_magnitude_ratio: np.ndarray
    """(bins,): |X| / sigma of the adjacent bin, if it belongs to an echo and so cannot raise a
    false alarm; 0 if neither adjacent bin does. sigma is the noise of a bin per quadrature."""
    side_of_adjacent_echo_bin: np.ndarray
    """(bins,) int64: 1 if the next higher bin belongs to an echo, -1 if the next lower bin does;
    without meaning if neither does."""
    crossing_rate_sum_bound_at_mean: np.ndarray
    """(m, 3): upper bound, at mean speckle power, on the sum of the crossing rates of a segment's
    bins. The rate of a bin is -ln(1 - c), with c the probability that signal lifts the bin above
    the threshold."""
    crossing_rate_sum_bounds: np.ndarray
    """(m, 3, N_RATE_BOUND_SPECKLE_POWERS): upper bounds on the sum of crossing rates in a
    segment, at speckle powers of 1, 2, 4 .. times the mean. The rate of a bin is -ln(1 - c), with c
    the probability that signal lifts the bin above the threshold."""
    mean_crossing_probability_sum: np.ndarray
    """(m, 3): sum, over a segment's bins, of the probability that leaked signal lifts the bin above
    the threshold. Each probability is a mean over speckle. The sum is nan if not computed."""
    permanent_line_begin: np.ndarray
    """(m, 3) int64: index of each segment's first bin in ``permanent_line_bins`` and
    ``permanent_line_log_amplitude``."""
    permanent_line_end: np.ndarray
    """(m, 3) int64: index of each segment's last bin, plus 1, in ``permanent_line_bins`` and
    ``permanent_line_log_amplitude``."""
    permanent_line_bins: np.ndarray
    """(line bins,) int64: numbers of the bins that the line of light leaked in the circulator may
    lift above the threshold."""
    permanent_line_log_amplitude: np.ndarray
    """(N_PHASES, line bins): ln(|X| / sigma) of the line of light leaked in the circulator, at each
    of N_PHASES phases of the line. sigma is the noise of a bin per quadrature."""
    permanent_line_crossing_rate_sum: np.ndarray
    """(m, 3): sum of the crossing rates of ``permanent_line_bins``, at the phase of the line with
    the largest sum. The rate of a bin is -ln(1 - c), with c the probability that the line of leaked
    light lifts the bin above the threshold."""
    no_noise_peak_begin: np.ndarray
    """(m, 3) int64: index of each segment's first bin in ``no_noise_peak_bins``."""
    no_noise_peak_end: np.ndarray
    """(m, 3) int64: index of each segment's last bin in ``no_noise_peak_bins``, plus 1."""
    no_noise_peak_bins: np.ndarray
    """(excluded,) int64: numbers of the bins in which no false peak is drawn for noise alone."""
    threshold_index: np.ndarray
    """(m,) int64: index of each point's threshold in the arrays (thresholds, ...), such as
    ``log_crossing_rates``."""
    log_crossing_rates: np.ndarray
    """(thresholds, N_TABLE_AMPLITUDES): ln of the crossing rate at evenly spaced ln(|X| / sigma),
    for each threshold. The rate is -ln(1 - c), with c the probability that signal of |X| lifts a
    bin above the threshold. sigma is the noise of a bin per quadrature."""
    first_log_amplitude: np.ndarray
    """(thresholds,): smallest ln(|X| / sigma) at which ``log_crossing_rates`` is tabulated. sigma
    is the noise of a bin per quadrature."""
    log_amplitude_step: np.ndarray
    """(thresholds,): difference of successive ln(|X| / sigma) at which ``log_crossing_rates`` is
    tabulated. sigma is the noise of a bin per quadrature."""
    threshold_ratio: np.ndarray
    """(thresholds,): threshold over sigma, the noise of a bin per quadrature. If looks (records of
    a segment) are combined, it is the equivalent threshold for a single record."""
    amplitude_gain_max: float
    """Largest factor from |X| / sigma in one look (record of a segment) to |X| / sigma in the
    single record that is equivalent to all looks; 1 for one look."""
    sidelobe_neighbour_noise_correlation: float
    """Correlation coefficient of the noise of two adjacent bins, for the component in phase with
    the signal."""

    @classmethod
    def empty(cls, n_points: int) -> "LeakageBins":
        """Return a record of ``n_points`` points without bins of leaked signal."""
        no_indices, no_bins, sum_shape = (
            np.zeros((n_points, 3), np.int64),
            np.empty(0, np.int64),
            (n_points, 3),
        )
        return cls(
            bins_begin=no_indices,
            bins_end=no_indices,
            bins=no_bins,
            log_amplitude=np.empty(0),
            fading_group=no_bins,
            exempt_neighbour_magnitude_ratio=np.empty(0),
            side_of_adjacent_echo_bin=no_bins,
            crossing_rate_sum_bound_at_mean=np.zeros(sum_shape),
            crossing_rate_sum_bounds=np.zeros((*sum_shape, N_RATE_BOUND_SPECKLE_POWERS)),
            mean_crossing_probability_sum=np.full(sum_shape, np.nan),
            permanent_line_begin=no_indices,
            permanent_line_end=no_indices,
            permanent_line_bins=no_bins,
            permanent_line_log_amplitude=np.empty((N_PHASES, 0)),
            permanent_line_crossing_rate_sum=np.zeros(sum_shape),
            no_noise_peak_begin=no_indices,
            no_noise_peak_end=no_indices,
            no_noise_peak_bins=no_bins,
            threshold_index=np.zeros(n_points, np.int64),
            log_crossing_rates=np.zeros((1, 1)),
            first_log_amplitude=np.zeros(1),
            log_amplitude_step=np.zeros(1),
            threshold_ratio=np.zeros(1),
            amplitude_gain_max=1.0,
            sidelobe_neighbour_noise_correlation=0.0,
        )

    def select_points(self, points: np.ndarray) -> "LeakageBins":
        """Return the record for points selected by indices or a mask.

        Arrays of bins are shared with this record, not copied.
        """
        by_point = (
            "bins_begin",
            "bins_end",
            "crossing_rate_sum_bound_at_mean",
            "crossing_rate_sum_bounds",
            "mean_crossing_probability_sum",
            "permanent_line_begin",
            "permanent_line_end",
            "permanent_line_crossing_rate_sum",
            "no_noise_peak_begin",
            "no_noise_peak_end",
            "threshold_index",
        )
        return self._replace(**{name: getattr(self, name)[points] for name in by_point})

    def mean_leakage_probability(self) -> np.ndarray:
        """Return the probability of a false peak by leaked signal in each segment, (m, 3).

        The probability is a mean over speckle, and over the phase of the line of light leaked in
        the circulator.
        """
        leakage = np.empty(self.crossing_rate_sum_bound_at_mean.shape)
        _fill_mean_leakage_probabilities(self, leakage)
        return leakage


class _LeakedBinLocations(NamedTuple):
    """Bins of leaked signal in the spectra of a batch of points, (bins,) each."""

    bin_number: np.ndarray
    """(bins,) int64: number of the bin."""
    point_in_batch: np.ndarray
    """(bins,) int64: index, in the batch, of the point to which the bin belongs."""
    segment: np.ndarray
    """(bins,) int64: segment of the bin: 0 up, 1 Doppler, 2 down."""


def find_leaking_points(groups: BinGroups) -> np.ndarray:
    """Return indices of points with a notable probability of a false peak by leaked signal.

    The probability exceeds LEAKAGE_PROBABILITY_MIN in at least one segment of these points.

    Parameters
    ----------
    groups : BinGroups
        Groups of bins of n points, with the probability of leakage in each segment
        (:class:`sweep.model.pointcloud.bin_groups.BinGroups`).

    Returns
    -------
    ndarray (m,) int64
        Indices of the points, in rising order.
    """
    return np.flatnonzero((groups.leakage_probability > LEAKAGE_PROBABILITY_MIN).any(axis=1))


def find_segments_with_raised_bins(
    groups: BinGroups, points: np.ndarray, keys: np.ndarray, first_draw: int, draws: int
) -> np.ndarray:
    """Return in which segments leaked signal may raise a bin in at least one draw, (n, 3) bool.

    In every draw of any other segment, -ln(1 - u) exceeds RAISED_BIN_RATE_MARGIN times an upper
    bound on the sum of the bins' crossing rates. u is the first random number of
    :func:`draw_leaked_peaks`. No bin is raised then, so that the bins need not be listed.

    Parameters
    ----------
    groups : BinGroups
        Groups of adjacent bins above the threshold of n points, with bounds on raised bins.
    points : ndarray (m,) int64
        Indices of the points that may leak. Segments of other points are not marked.
    keys : ndarray (n, 2) uint64
        Random key of each point.
    first_draw, draws : int
        Number of the first draw, and number of draws.
    """
    with np.errstate(divide="ignore"):  # a certain crossing has an infinite rate
        rate_sums = -np.log1p(-groups.raised_bin_probability_max[points])
    rate_sum_max = RAISED_BIN_RATE_SAFETY_FACTOR * rate_sums
    has_raised_bin = np.zeros((keys.shape[0], 3), np.bool_)
    has_raised_bin_at_points = np.zeros((points.size, 3), np.bool_)
    _mark_segments_with_raised_bins(
        np.ascontiguousarray(keys[points]),
        rate_sum_max,
        int(first_draw),
        draws,
        has_raised_bin_at_points,
    )
    has_raised_bin[points] = has_raised_bin_at_points
    return has_raised_bin


@njit(cache=True, nogil=True, error_model="numpy", borrows=True)
def _mark_segments_with_raised_bins(keys, rate_sum_max, first_draw, n_draws, has_raised_bin):
    """Mark the segments of m points in which leaked signal may raise a bin in at least one draw.

    Parameters
    ----------
    keys
        (m, 2) uint64: random keys.
    rate_sum_max
        (m, 3): upper bounds on the sums of the bins' rates -ln(1 - c), with c the probability that
        signal lifts a bin above the threshold.
    first_draw, n_draws
        Number of the first draw, and number of draws.
    has_raised_bin
        (m, 3) bool: True is written where a bin may be raised.
    """
    for i in range(has_raised_bin.shape[0]):
        for segment in range(has_raised_bin.shape[1]):
            for draw in range(first_draw, first_draw + n_draws):
                probability = philox.uniform(
                    keys[i, 0], keys[i, 1], draw, philox.STREAM_LEAKAGE[segment], INTEGER_ZERO
                )
                if -math.log1p(-probability) <= rate_sum_max[i, segment]:
                    has_raised_bin[i, segment] = True


def fading_group_of_bins(
    shots: Shots, groups: BinGroups, points: np.ndarray, spectra: NoiselessSpectra
) -> np.ndarray:
    """Return the group (echo) with whose speckle each bin of leaked signal fades.

    It is the group whose strongest bin is nearest to the bin. Bins of a complex record are
    periodic.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    groups : BinGroups
        Groups of adjacent bins whose noiseless magnitude exceeds the threshold: the echoes.
    points : ndarray (m,) int64
        Indices of the points of ``spectra``.
    spectra : NoiselessSpectra
        Spectra of the points, which list their bins of leaked signal.

    Returns
    -------
    ndarray (bins,) int64
        Index of the group in the segment of each bin.
    """
    bins = _locate_leaked_bins(spectra)
    group_bins = groups.strongest_bin[points[bins.point_in_batch], bins.segment]
    distance = np.abs(bins.bin_number[:, None] - group_bins)
    if shots.complex_record:
        distance = np.minimum(distance % shots.fft_size, -distance % shots.fft_size)
    return np.where(group_bins < 0, np.iinfo(np.int64).max, distance).argmin(axis=1)


def bins_without_noise_peaks(
    shots: Shots, groups: BinGroups, points: np.ndarray, spectra: NoiselessSpectra
) -> LeakageBins:
    """List the bins of leaked signal as bins in which no false peak of noise alone is drawn.

    The noise of these bins is drawn together with their signal instead.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    groups : BinGroups
        Groups of adjacent bins whose noiseless magnitude exceeds the threshold: the echoes.
    points : ndarray (m,) int64
        Indices of the points of ``spectra``.
    spectra : NoiselessSpectra
        Spectra of the points, which list their bins of leaked signal.

    Returns
    -------
    LeakageBins
        Bins that raise no leaked peaks. ``fading_group`` holds the group of each listed bin.
    """
    return LeakageBins.empty(points.size)._replace(
        fading_group=fading_group_of_bins(shots, groups, points, spectra),
        no_noise_peak_begin=spectra.leaked_begin,
        no_noise_peak_end=spectra.leaked_end,
        no_noise_peak_bins=_locate_leaked_bins(spectra).bin_number,
    )


def iter_leakage_bins(
    shots: Shots,
    groups: BinGroups,
    points: np.ndarray,
    has_raised_bin: np.ndarray | None = None,
) -> Iterator[tuple[np.ndarray, LeakageBins]]:
    """Yield points in batches, with the bins in which leaked signal may raise peaks.

    Parameters
    ----------
    shots : Shots
        Prepared shots.
    groups : BinGroups
        Groups of adjacent bins whose noiseless magnitude exceeds the threshold: the echoes.
    points : ndarray (m,) int64
        Indices of the points that may have such bins (:func:`find_leaking_points`).
    has_raised_bin : ndarray (n, 3) bool, optional
        True for segments in which all these bins are listed; in other segments only bins above
        the threshold are. By default, and in any case with a permanent line, all segments are True.

    Yields
    ------
    batch : ndarray (k,) int64
        Indices of the batch's points.
    leakage_bins : LeakageBins
        Their bins of leaked signal.
    """
    if shots.permanent_line is None:
        for spans in _iter_leaking_spans(shots, points, has_raised_bin):
            yield spans.point_numbers, _leakage_bins_of_spans(shots, groups, spans)
        return
    echoes_alone = replace(shots, permanent_line=None)
    for batch_begin in range(0, points.size, PERMANENT_LINE_POINTS_PER_BATCH):
        for batch, spectra in iter_noiseless_spectra(
            echoes_alone, points[batch_begin : batch_begin + PERMANENT_LINE_POINTS_PER_BATCH]
        ):
            fading_group = fading_group_of_bins(shots, groups, batch, spectra)
            spectra, fading_group, leakage_bins = _remove_bins_masked_by_leaked_light(
                shots, batch, spectra, fading_group
            )
            leakage_bins = leakage_bins._replace(
                bins_begin=spectra.leaked_begin,
                bins_end=spectra.leaked_end,
                bins=_locate_leaked_bins(spectra).bin_number,
                log_amplitude=np.log(spectra.leaked_magnitude_ratio),
                fading_group=fading_group,
                exempt_neighbour_magnitude_ratio=spectra.exempt_neighbour_magnitude_ratio,
                side_of_adjacent_echo_bin=spectra.side_of_adjacent_echo_bin,
            )
            yield batch, _add_crossing_rate_tables(shots, batch, leakage_bins)


def find_groups_and_leakage_bins(
    shots: Shots, groups_max: int
) -> tuple[BinGroups, list[tuple[np.ndarray, LeakageBins]]]:
    """Find both bin groups and leaked-signal bins in one search, for echoes in developed speckle.

    Shots with a search band or a line of leaked light need two separate searches instead
    (:func:`sweep.model.pointcloud.bin_groups.list_bin_groups`, :func:`iter_leakage_bins`).

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    groups_max : int
        Largest number of groups that are listed for a segment.

    Returns
    -------
    groups : BinGroups
        Groups of adjacent bins whose noiseless magnitude exceeds the threshold, of all points
        (:class:`sweep.model.pointcloud.bin_groups.BinGroups`). The field ``leakage_probability`` is
        a mean over speckle.
    leakage_bins_by_part : list of tuple
        Pairs of point indices (k,) and :class:`LeakageBins`, as :func:`iter_leakage_bins` yields
        them.
    """
    groups = allocate_bin_groups(shots.size, groups_max)
    leakage_bins_by_part = []
    for spans in _iter_leaking_spans(shots, np.arange(shots.size)):
        find_groups_in_spans(shots, spans, groups)
        leakage_bins = _leakage_bins_of_spans(shots, groups, spans)
        groups.leakage_probability[spans.point_numbers] = leakage_bins.mean_leakage_probability()
        leakage_bins_by_part.append((spans.point_numbers, leakage_bins))
    return groups, leakage_bins_by_part


def _iter_leaking_spans(
    shots: Shots, point_indices: np.ndarray, has_raised_bin: np.ndarray | None = None
) -> Iterator[BinSpans]:
    """Yield the spans (adjacent bins) of points in which leaked signal is not negligible.

    In segments that ``has_raised_bin`` (n, 3) does not mark, spans end at the threshold.
    """
    magnitude_min = np.minimum(
        shots.threshold, _leaking_magnitude_ratio_min(shots) * shots.bin_noise_sigma
    )
    if has_raised_bin is not None:
        magnitude_min = np.where(has_raised_bin.T, magnitude_min, shots.threshold)
    return iter_spans(
        shots, points=point_indices, level_min=magnitude_min, leakage=False, computes_pd=False
    )


def _leaking_magnitude_ratio_min(shots: Shots) -> np.ndarray:
    """Return the smallest |X| / sigma, (n,), at which leaked signal may raise a false peak.

    sigma is the noise of a bin per quadrature. The result is infinite if the settings omit leaked
    signal.
    """
    return np.broadcast_to(
        shots.negligible_signal_ratio
        if shots.detection_settings.leakage_raises_false_alarms
        else np.inf,
        shots.size,
    )


def _leakage_bins_of_spans(shots: Shots, groups: BinGroups, spans: BinSpans) -> LeakageBins:
    """Return the :class:`LeakageBins` in spans (adjacent bins), with their crossing rates."""
    first_bin, n_bins, peak_index, span_start = (
        np.ascontiguousarray(array)
        for array in (spans.first_bin, spans.n_bins, spans.peak_index, spans.span_start)
    )
    bins, group, side_of_adjacent_echo_bin = np.empty((3, n_bins.sum()), np.int64)
    log_amplitude, exempt_neighbour_magnitude_ratio = np.empty((2, bins.size))
    bins_begin, bins_end = np.empty((2, spans.point_numbers.size, 3), np.int64)
    n_listed = _fill_leakage_bins(
        spans.point_numbers,
        first_bin,
        n_bins,
        peak_index,
        span_start,
        np.ascontiguousarray(spans.peak_is_searched),
        spans.magnitudes,
        spans.is_exempt,
        np.array(np.broadcast_to(shots.bin_noise_sigma, shots.size)),
        np.array(_leaking_magnitude_ratio_min(shots)),
        np.ascontiguousarray(groups.strongest_bin),
        shots.fft_size if shots.complex_record else 0,
        bins_begin,
        bins_end,
        bins,
        log_amplitude,
        group,
        exempt_neighbour_magnitude_ratio,
        side_of_adjacent_echo_bin,
    )
    leakage_bins = LeakageBins.empty(spans.point_numbers.size)._replace(
        bins_begin=bins_begin,
        bins_end=bins_end,
        bins=bins[:n_listed],
        log_amplitude=log_amplitude[:n_listed],
        fading_group=group[:n_listed],
        exempt_neighbour_magnitude_ratio=exempt_neighbour_magnitude_ratio[:n_listed],
        side_of_adjacent_echo_bin=side_of_adjacent_echo_bin[:n_listed],
    )
    return _add_crossing_rate_tables(shots, spans.point_numbers, leakage_bins)


@njit(cache=True, nogil=True, error_model="numpy", borrows=True)
def _fill_leakage_bins(
    point_numbers,
    first_bin,
    n_bins,
    peak_index,
    span_start,
    peak_is_searched,
    magnitudes,
    is_exempt,
    noise_sigma,
    signal_ratio_min,
    group_bins,
    circle_bins,
    bins_begin,
    bins_end,
    bins,
    log_amplitude,
    group,
    exempt_neighbour_magnitude_ratio,
    side_of_adjacent_echo_bin,
):
    """List the bins of leaked signal in spans (adjacent bins of a segment); return their number.

    Parameters
    ----------
    point_numbers
        (m,): indices of the points.
    first_bin, n_bins, peak_index, span_start, peak_is_searched
        (3, m): first bin, number of bins, index of the largest bin, begin in ``magnitudes`` and
        ``is_exempt``, and True if the largest bin is searched.
    magnitudes, is_exempt
        |X| [V] of all bins, and True for bins of an echo.
    noise_sigma, signal_ratio_min
        (n,): noise per quadrature [V], and |X| / sigma from which bins of points may leak.
    group_bins
        (n, 3, groups): strongest bins of groups, -1 for none.
    circle_bins
        Number of bins of a complex record, else 0.
    bins_begin, bins_end, bins, log_amplitude, group
        Results, as in :class:`LeakageBins`.
    exempt_neighbour_magnitude_ratio, side_of_adjacent_echo_bin
        Results, as in :class:`LeakageBins`.
    """
    n_listed = 0
    for j in range(point_numbers.size):
        i = point_numbers[j]
        for s in range(3):
            bins_begin[j, s] = n_listed
            span_begin = span_start[s, j]
            for index_in_span in range(n_bins[s, j]):
                flat_index = span_begin + index_in_span
                signal_ratio = magnitudes[flat_index] / noise_sigma[i]
                if (
                    is_exempt[flat_index]
                    or not signal_ratio >= signal_ratio_min[i]
                    or (index_in_span == peak_index[s, j] and peak_is_searched[s, j])
                ):
                    continue
                ratio_below, ratio_above = 0.0, 0.0
                if index_in_span > 0 and is_exempt[flat_index - 1]:
                    ratio_below = magnitudes[flat_index - 1] / noise_sigma[i]
                if index_in_span + 1 < n_bins[s, j] and is_exempt[flat_index + 1]:
                    ratio_above = magnitudes[flat_index + 1] / noise_sigma[i]
                nearest_distance, nearest_group = np.int64(1) << 62, 0
                for group_index in range(group_bins.shape[2]):
                    if group_bins[i, s, group_index] < 0:
                        continue
                    distance = abs(first_bin[s, j] + index_in_span - group_bins[i, s, group_index])
                    if circle_bins > 0:
                        distance = min(distance % circle_bins, -distance % circle_bins)
                    if distance < nearest_distance:
                        nearest_distance, nearest_group = distance, group_index
                bins[n_listed], log_amplitude[n_listed] = (
                    first_bin[s, j] + index_in_span,
                    math.log(signal_ratio),
                )
                group[n_listed], exempt_neighbour_magnitude_ratio[n_listed] = (
                    nearest_group,
                    max(ratio_below, ratio_above),
                )
                side_of_adjacent_echo_bin[n_listed] = 1 if ratio_above >= ratio_below else -1
                n_listed += 1
            bins_end[j, s] = n_listed
    return n_listed


def _add_crossing_rate_tables(
    shots: Shots, batch: np.ndarray, leakage_bins: LeakageBins
) -> LeakageBins:
    """Return :class:`LeakageBins` with the tables and sums of crossing rates included.

    The rate of a bin is -ln(1 - c), with c the probability that signal lifts the bin above the
    threshold. ``batch`` holds the indices of the points of ``leakage_bins``.
    """
    point_threshold_ratio = np.broadcast_to(shots.threshold / shots.bin_noise_sigma, shots.size)[
        batch
    ]
    threshold_ratios, threshold_index = _distinct_thresholds(point_threshold_ratio)
    in_speckle = shots.speckle.segment_correlations is not None
    tables = [
        _make_crossing_tables(shots.looks, float(threshold_ratio), in_speckle)
        for threshold_ratio in threshold_ratios
    ]
    leakage_bins = leakage_bins._replace(
        threshold_index=threshold_index,
        log_crossing_rates=np.array([table.log_crossing_rates for table in tables]),
        first_log_amplitude=np.array([table.first_log_amplitude for table in tables]),
        log_amplitude_step=np.array([table.log_amplitude_step for table in tables]),
        threshold_ratio=shots.looks.equivalent_threshold_ratio(threshold_ratios),
        amplitude_gain_max=float(shots.looks.amplitude_gain_max),
        sidelobe_neighbour_noise_correlation=shots.detection_rule.sidelobe_neighbour_noise_correlation,
    )
    _fill_rate_sums(
        leakage_bins,
        np.array([table.linear_rates for table in tables]),
        np.array([table.mean_probabilities for table in tables]),
    )
    return leakage_bins


class CrossingRateTable(NamedTuple):
    """Table of the rates of bins at one threshold, for compiled code.

    The rate is -ln(1 - c), with c the probability that signal lifts a bin above the threshold.
    sigma is the noise of a bin per quadrature.
    """

    log_crossing_rates: np.ndarray
    """(N_TABLE_AMPLITUDES,): ln of the crossing rate at evenly spaced ln(|X| / sigma). The rate is
    -ln(1 - c), with c the probability that signal of |X| lifts a bin above the threshold. sigma is
    the noise of a bin per quadrature."""
    first_log_amplitude: float
    """Smallest tabulated ln(|X| / sigma) of signal. sigma is the noise of a bin per quadrature."""
    log_amplitude_step: float
    """Difference of successive tabulated ln(|X| / sigma) of signal. sigma is the noise of a bin per
    quadrature."""


class CrossingTables(NamedTuple):
    """Tables for one threshold, by ln(|X| / sigma) of the signal.

    The rate is -ln(1 - c), with c the probability that signal lifts a bin above the threshold.
    sigma is the noise of a bin per quadrature.
    """

    log_crossing_rates: np.ndarray
    """(N_TABLE_AMPLITUDES,): ln of the crossing rate -ln(1 - c) at evenly spaced ln(|X| / sigma). c
    is the probability that signal of |X| lifts a bin above the threshold."""
    first_log_amplitude: float
    """Smallest tabulated ln(|X| / sigma) of signal. sigma is the noise of a bin per quadrature."""
    log_amplitude_step: float
    """Difference of successive tabulated ln(|X| / sigma) of signal. sigma is the noise of a bin per
    quadrature."""
    linear_rates: np.ndarray
    """(N_TABLE_AMPLITUDES,): crossing rate -ln(1 - c) at evenly spaced ln(|X| / sigma). c is the
    probability that signal of |X| lifts a bin above the threshold."""
    mean_probabilities: np.ndarray
    """(N_TABLE_AMPLITUDES,): probability, averaged over speckle, that signal lifts a bin above the
    threshold, at evenly spaced ln(|X| / sigma). |X| is that at mean speckle power. Without speckle
    the array is empty."""


@lru_cache(maxsize=64)
def _make_crossing_tables(looks: Looks, threshold_ratio: float, in_speckle: bool) -> CrossingTables:
    """Return :class:`CrossingTables` for a threshold [sigma].

    sigma is the noise of a bin per quadrature. ``in_speckle`` is True to include the probabilities
    averaged over speckle.
    """
    rate_table = _tabulate_log_crossing_rates(looks, threshold_ratio)
    mean_probabilities = np.empty(0)
    if in_speckle:
        from scipy.interpolate import CubicSpline  # slow to import

        coarse_means, coarse_positions = (
            np.empty(N_TABLE_AMPLITUDES // MEAN_CROSSING_TABLE_STRIDE + 1),
            np.arange(N_TABLE_AMPLITUDES) / MEAN_CROSSING_TABLE_STRIDE,
        )
        _fill_mean_probabilities(rate_table, coarse_means)
        log_means = np.log(np.maximum(coarse_means, 1e-300))
        mean_probabilities = np.exp(
            CubicSpline(np.arange(coarse_means.size), log_means)(coarse_positions)
        )
    return CrossingTables(
        *rate_table,
        linear_rates=np.exp(rate_table.log_crossing_rates),
        mean_probabilities=mean_probabilities,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_mean_probabilities(rate_table, mean_probabilities):
    """Compute the probability, averaged over speckle, that signal lifts a bin above the threshold.

    It is computed at every MEAN_CROSSING_TABLE_STRIDE-th signal amplitude of ``rate_table``, a
    :class:`CrossingRateTable`.
    """
    quadrature = _make_speckle_quadrature(rate_table)
    rate_sums = np.empty(quadrature.weights.size)
    for k in range(mean_probabilities.size):
        rate_sums[:] = 0.0
        _add_rates_at_nodes(
            rate_table.first_log_amplitude
            + k * MEAN_CROSSING_TABLE_STRIDE * rate_table.log_amplitude_step,
            rate_table,
            quadrature,
            rate_sums,
        )
        mean_probabilities[k] = _mean_leakage_probability_from_rates(rate_sums, quadrature.weights)


def _locate_leaked_bins(spectra: NoiselessSpectra) -> _LeakedBinLocations:
    """Return the bin number, point and segment of all bins of leaked signal."""
    n_bins = (spectra.leaked_end - spectra.leaked_begin).ravel()
    span = np.repeat(np.arange(n_bins.size), n_bins)
    return _LeakedBinLocations(
        spectra.first_bin.ravel()[span] + spectra.leaked_index, span // 3, span % 3
    )


def _remove_bins_masked_by_leaked_light(
    shots: Shots, batch: np.ndarray, spectra: NoiselessSpectra, group: np.ndarray
) -> tuple[NoiselessSpectra, np.ndarray, LeakageBins]:
    """Remove bins that a line of leaked light masks, and list the bins that the line raises.

    ``group`` is the result of :func:`fading_group_of_bins`. Three results are returned: the spectra
    without the masked bins, the groups of the remaining bins, and a :class:`LeakageBins` with only
    the fields ``permanent_line_*`` and ``no_noise_peak_*`` filled.
    """
    is_kept = np.ones(spectra.leaked_index.size, bool)
    n_kept, n_raised, n_masked = np.zeros((3, batch.size, 3), np.int64)
    raised_bins, masked_bins, line_amplitudes = [], [], [np.empty((N_PHASES, 0))]
    phase_factors = np.exp(1j * np.pi * (np.arange(N_PHASES) + 0.5) / N_PHASES)[:, None]
    for j, i in enumerate(batch.tolist()):
        deviation = float(np.broadcast_to(shots.bin_noise_sigma, shots.size)[i])
        for s in range(3):
            if not shots.has_segment[s]:
                continue
            line_scale, line = permanent_line_of_point(shots, i, s)
            start, first_bin = spectra.bins_start[j, s], spectra.first_bin[j, s]
            echo_bins = first_bin + np.flatnonzero(
                spectra.is_echo[start : start + spectra.n_bins[j, s]]
            )
            is_masked, _, may_raise = line_bin_masks(
                shots, i, line, half_amplitude=line_scale, echo_bins=echo_bins
            )
            leaked = slice(spectra.leaked_begin[j, s], spectra.leaked_end[j, s])
            bin_numbers = first_bin + spectra.leaked_index[leaked]
            is_kept[leaked] = ~is_masked[
                bin_numbers % shots.fft_size if shots.complex_record else bin_numbers
            ]
            raised_bins.append(np.flatnonzero(may_raise))
            masked_bins.append(np.flatnonzero(is_masked))
            line_term, image_term = (
                (line_scale / deviation) * transform[raised_bins[-1]]
                for transform in (line.transform, line.image_transform)
            )
            line_amplitudes.append(
                np.abs(line_term * phase_factors + image_term * phase_factors.conj())
            )
            n_kept[j, s] = is_kept[leaked].sum()
            n_raised[j, s], n_masked[j, s] = raised_bins[-1].size, masked_bins[-1].size
    kept_end, raised_end, masked_end = (
        np.cumsum(number).reshape(number.shape) for number in (n_kept, n_raised, n_masked)
    )
    no_bins = np.empty(0, np.int64)
    return (
        spectra._replace(
            leaked_begin=kept_end - n_kept,
            leaked_end=kept_end,
            leaked_index=spectra.leaked_index[is_kept],
            leaked_magnitude_ratio=spectra.leaked_magnitude_ratio[is_kept],
            exempt_neighbour_magnitude_ratio=spectra.exempt_neighbour_magnitude_ratio[is_kept],
            side_of_adjacent_echo_bin=spectra.side_of_adjacent_echo_bin[is_kept],
        ),
        group[is_kept],
        LeakageBins.empty(batch.size)._replace(
            permanent_line_begin=raised_end - n_raised,
            permanent_line_end=raised_end,
            permanent_line_bins=np.concatenate([no_bins, *raised_bins]),
            permanent_line_log_amplitude=np.concatenate(line_amplitudes, axis=1),
            no_noise_peak_begin=masked_end - n_masked,
            no_noise_peak_end=masked_end,
            no_noise_peak_bins=np.concatenate([no_bins, *masked_bins]),
        ),
    )


def _distinct_thresholds(threshold_ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct thresholds [sigma], and each point's index into them.

    Thresholds within 1e-7 of each other, as in a flight, count as equal. sigma is the noise of a
    bin per quadrature.
    """
    distinct_ratios, threshold_index = np.unique(np.round(threshold_ratio, 7), return_inverse=True)
    return distinct_ratios, threshold_index.ravel().astype(np.int64)


def _tabulate_log_crossing_rates(looks: Looks, threshold_ratio: float) -> CrossingRateTable:
    """Return a :class:`CrossingRateTable`: ln of the crossing rate by signal amplitude.

    The rate is -ln(1 - c), where signal adds c to the probability that a bin crosses the threshold
    [sigma]. If powers of looks are summed, c is the probability that the sum crosses.
    """
    log_crossing_rates = np.empty(N_TABLE_AMPLITUDES)
    first_log_amplitude, log_amplitude_step = _fill_log_crossing_rates(
        threshold_ratio, log_crossing_rates
    )
    if looks.is_noncoherent:
        amplitudes = np.exp(
            first_log_amplitude + log_amplitude_step * np.arange(N_TABLE_AMPLITUDES)
        )
        added_probability = np.minimum(
            looks.crossing_probability_added_by_signal(amplitudes, threshold_ratio), 1 - 1e-16
        )
        log_crossing_rates[:] = np.log(np.maximum(-np.log1p(-added_probability), 1e-300))
    return CrossingRateTable(log_crossing_rates, first_log_amplitude, log_amplitude_step)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_log_crossing_rates(threshold_ratio, log_crossing_rates):
    """Fill a table of ln(crossing rate) for one record; return its first ln(|X| / sigma) and step.

    ``log_crossing_rates`` (N_TABLE_AMPLITUDES,) is the table, and ``threshold_ratio`` the threshold
    over sigma, the noise of a bin per quadrature.
    """
    first_log_amplitude = math.log(TABLE_AMPLITUDE_MIN_SIGMA)
    log_amplitude_step = (
        math.log(threshold_ratio + CERTAIN_CROSSING_MARGIN_SIGMA) - first_log_amplitude
    ) / (N_TABLE_AMPLITUDES - 1)
    p_noise_stay = -math.expm1(-0.5 * threshold_ratio * threshold_ratio)
    for k in range(N_TABLE_AMPLITUDES):
        amplitude, rate = math.exp(first_log_amplitude + log_amplitude_step * k), 0.0
        if p_noise_stay > 0.0 and amplitude < threshold_ratio:
            rate = -math.log1p(-marcum_q1_excess(amplitude, threshold_ratio) / p_noise_stay)
        elif p_noise_stay > 0.0:
            rate = -math.log(
                max(marcum_q1_tails(amplitude, threshold_ratio).below, 1e-300) / p_noise_stay
            )
        log_crossing_rates[k] = math.log(max(rate, 1e-300))
    return first_log_amplitude, log_amplitude_step


@njit(cache=True, error_model="numpy", borrows=True)
def _crossing_rate(log_amplitude, rate_table):
    """Interpolate the crossing rate of a bin in a table.

    The rate is -ln(1 - c), with c the probability that signal lifts the bin above the threshold.
    ``log_amplitude`` is ln(|X| / sigma), and ``rate_table`` a :class:`CrossingRateTable`. At
    amplitudes below the table the rate is proportional to the amplitude squared.
    """
    log_crossing_rates = rate_table.log_crossing_rates
    table_position = (
        log_amplitude - rate_table.first_log_amplitude
    ) / rate_table.log_amplitude_step
    if table_position <= 0.0:
        return math.exp(
            log_crossing_rates[0] + 2.0 * (log_amplitude - rate_table.first_log_amplitude)
        )
    k = int(table_position)
    if k >= log_crossing_rates.size - 1:
        return math.exp(log_crossing_rates[log_crossing_rates.size - 1])
    return math.exp(
        log_crossing_rates[k]
        + (table_position - k) * (log_crossing_rates[k + 1] - log_crossing_rates[k])
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_rate_sums(leakage_bins, linear_rates, mean_probabilities):
    """Fill the fields of ``leakage_bins`` that are sums of crossing rates, in place.

    The rate of a bin is -ln(1 - c), with c the probability that signal lifts the bin above the
    threshold. ``permanent_line_log_amplitude`` is converted from amplitudes to logarithms.
    ``linear_rates`` and ``mean_probabilities`` (thresholds, N_TABLE_AMPLITUDES) are the fields of
    :class:`CrossingTables` for each threshold.
    """
    for phase in range(leakage_bins.permanent_line_log_amplitude.shape[0]):
        for k in range(leakage_bins.permanent_line_log_amplitude.shape[1]):
            leakage_bins.permanent_line_log_amplitude[phase, k] = math.log(
                max(leakage_bins.permanent_line_log_amplitude[phase, k], 1e-300)
            )
    for j in range(leakage_bins.crossing_rate_sum_bound_at_mean.shape[0]):
        threshold_index = leakage_bins.threshold_index[j]
        rate_table = CrossingRateTable(
            leakage_bins.log_crossing_rates[threshold_index],
            leakage_bins.first_log_amplitude[threshold_index],
            leakage_bins.log_amplitude_step[threshold_index],
        )
        steps_per_power_doubling = math.ceil(0.5 * math.log(2.0) / rate_table.log_amplitude_step)
        for s in range(3):
            rate_sums, mean_crossing_probability_sum = (
                leakage_bins.crossing_rate_sum_bounds[j, s],
                0.0,
            )
            rate_sums[:] = 0.0
            for k in range(leakage_bins.bins_begin[j, s], leakage_bins.bins_end[j, s]):
                log_amplitude_above_first = (
                    leakage_bins.log_amplitude[k] - rate_table.first_log_amplitude
                )
                power_fraction, table_position = (
                    1.0,
                    log_amplitude_above_first / rate_table.log_amplitude_step,
                )
                if table_position < 0.0:  # rate proportional to the amplitude squared
                    power_fraction, table_position = math.exp(2.0 * log_amplitude_above_first), 0.0
                table_index = min(int(table_position), N_TABLE_AMPLITUDES - 2)
                for doublings in range(N_RATE_BOUND_SPECKLE_POWERS):
                    rate_sums[doublings] += (
                        power_fraction
                        * linear_rates[
                            threshold_index,
                            min(
                                table_index + 1 + doublings * steps_per_power_doubling,
                                N_TABLE_AMPLITUDES - 1,
                            ),
                        ]
                    )
                if mean_probabilities.shape[1] > 0:
                    mean_at_index, mean_at_next = (
                        mean_probabilities[threshold_index, table_index],
                        mean_probabilities[threshold_index, table_index + 1],
                    )
                    mean_crossing_probability_sum += power_fraction * (
                        mean_at_index
                        + min(table_position - table_index, 1.0) * (mean_at_next - mean_at_index)
                    )
            (
                leakage_bins.crossing_rate_sum_bound_at_mean[j, s],
                leakage_bins.permanent_line_crossing_rate_sum[j, s],
            ) = rate_sums[0], 0.0
            if mean_probabilities.shape[1] > 0:
                leakage_bins.mean_crossing_probability_sum[j, s] = mean_crossing_probability_sum
            for phase in range(leakage_bins.permanent_line_log_amplitude.shape[0]):
                phase_sum = 0.0
                for k in range(
                    leakage_bins.permanent_line_begin[j, s], leakage_bins.permanent_line_end[j, s]
                ):
                    phase_sum += _crossing_rate(
                        leakage_bins.permanent_line_log_amplitude[phase, k], rate_table
                    )
                leakage_bins.permanent_line_crossing_rate_sum[j, s] = max(
                    leakage_bins.permanent_line_crossing_rate_sum[j, s], phase_sum
                )


class SpeckleQuadrature(NamedTuple):
    """Trapezoidal rule for the mean over speckle, for one table of rates.

    Nodes are values of ln(speckle power). The rate of a bin is -ln(1 - c), with c the probability
    that signal lifts it above the threshold.
    """

    node_stride: int
    """Number of steps of ln(amplitude) in the table of rates between successive nodes of the
    quadrature."""
    n_nodes_below_mean: int
    """Number of nodes whose speckle power is below the mean power 1."""
    weights: np.ndarray
    """(nodes,): weights of the trapezoidal rule. Node i has the speckle power exp(2 node_stride
    step (i - n_nodes_below_mean)), where step is the table's step of ln(amplitude)."""
    rates_by_node_phase: np.ndarray
    """(node_stride * columns,): crossing rates at evenly spaced ln(amplitude), sorted so that the
    rates of a bin at all nodes are adjacent.

    The array holds node_stride rows, one after the other. Row p holds the rates at the steps p, p +
    node_stride, p + 2 node_stride .. of ln(amplitude). Step 0 is ``n_nodes_below_mean`` strides
    below the table.
    """


@njit(cache=True, error_model="numpy")
def _make_speckle_quadrature(rate_table):
    """Return the :class:`SpeckleQuadrature` (trapezoidal rule) for one table of crossing rates."""
    log_crossing_rates, log_amplitude_step, log_rate_step_max = (
        rate_table.log_crossing_rates,
        rate_table.log_amplitude_step,
        0.0,
    )
    for k in range(1, log_crossing_rates.size):
        if log_crossing_rates[k] < 1.0:  # at higher rates a bin crosses at almost any power
            log_rate_step_max = max(
                log_rate_step_max, log_crossing_rates[k] - log_crossing_rates[k - 1]
            )
    node_stride = max(
        int(
            min(
                0.5 * LOG_SPECKLE_POWER_STEP_MAX / log_amplitude_step,
                LOG_CROSSING_RATE_STEP_MAX / log_rate_step_max,
            )
        ),
        1,
    )
    log_power_step = 2.0 * node_stride * log_amplitude_step
    n_nodes_below_mean, n_nodes_above_mean = (
        int(-LOG_SPECKLE_POWER_MIN / log_power_step) + 1,
        int(LOG_SPECKLE_POWER_MAX / log_power_step) + 1,
    )
    weights = np.empty(n_nodes_below_mean + n_nodes_above_mean + 1)
    for i in range(weights.size):
        power = math.exp((i - n_nodes_below_mean) * log_power_step)
        weights[i] = log_power_step * power * math.exp(-power)
    # From `n_nodes_below_mean` strides beyond the table a bin crosses even at the faintest node.
    n_columns = (
        2 * n_nodes_below_mean + n_nodes_above_mean + log_crossing_rates.size // node_stride + 4
    )
    rates_by_node_phase = np.empty(node_stride * n_columns)
    for k in range(rates_by_node_phase.size):
        table_position = float(k - n_nodes_below_mean * node_stride - 1)
        rate = _crossing_rate(
            rate_table.first_log_amplitude + table_position * log_amplitude_step, rate_table
        )
        rates_by_node_phase[k % node_stride * n_columns + k // node_stride] = rate
    return SpeckleQuadrature(node_stride, n_nodes_below_mean, weights, rates_by_node_phase)


@njit(cache=True, error_model="numpy")
def _add_rates_at_nodes(log_amplitude, rate_table, quadrature, rate_sums):
    """Add the crossing rates of a bin, at the nodes of speckle power, to ``rate_sums``, in place.

    ``log_amplitude`` is ln(|X| / sigma) at mean power, and ``rate_table`` the table from which
    ``quadrature`` was made. Only the nodes of highest speckle power are evaluated, as many as
    ``rate_sums`` has elements. Rates are interpolated by cubic polynomials.
    """
    log_amplitude_above_first = log_amplitude - rate_table.first_log_amplitude
    power_fraction, table_position = (
        1.0,
        log_amplitude_above_first / rate_table.log_amplitude_step,
    )
    if table_position < 0.0:  # rate proportional to the amplitude squared
        power_fraction, table_position = math.exp(2.0 * log_amplitude_above_first), 0.0
    n_columns = quadrature.rates_by_node_phase.size // quadrature.node_stride
    table_index = int(
        min(
            table_position,
            float(
                quadrature.rates_by_node_phase.size
                - quadrature.node_stride * quadrature.weights.size
                - 4
            ),
        )
    )
    fraction = min(table_position - table_index, 1.0)
    weight_1 = power_fraction * fraction * (fraction - 1.0) * (2.0 - fraction) / 6.0
    weight_2 = power_fraction * (fraction + 1.0) * (fraction - 1.0) * (fraction - 2.0) / 2.0
    weight_3 = power_fraction * (fraction + 1.0) * fraction * (2.0 - fraction) / 2.0
    weight_4 = power_fraction * (fraction + 1.0) * fraction * (fraction - 1.0) / 6.0
    row_1 = table_index % quadrature.node_stride * n_columns + table_index // quadrature.node_stride
    row_2 = (table_index + 1) % quadrature.node_stride * n_columns + (
        table_index + 1
    ) // quadrature.node_stride
    row_3 = (table_index + 2) % quadrature.node_stride * n_columns + (
        table_index + 2
    ) // quadrature.node_stride
    row_4 = (table_index + 3) % quadrature.node_stride * n_columns + (
        table_index + 3
    ) // quadrature.node_stride
    rates_by_node_phase, node_end, node_begin = (
        quadrature.rates_by_node_phase,
        quadrature.weights.size,
        quadrature.weights.size - rate_sums.size,
    )
    rates_1, rates_2 = (
        rates_by_node_phase[row_1 + node_begin : row_1 + node_end],
        rates_by_node_phase[row_2 + node_begin : row_2 + node_end],
    )
    rates_3, rates_4 = (
        rates_by_node_phase[row_3 + node_begin : row_3 + node_end],
        rates_by_node_phase[row_4 + node_begin : row_4 + node_end],
    )
    for i in range(rate_sums.size):
        rate_sums[i] += (weight_1 * rates_1[i] + weight_2 * rates_2[i]) + (
            weight_3 * rates_3[i] + weight_4 * rates_4[i]
        )


@njit(cache=True, error_model="numpy")
def _mean_leakage_probability_from_rates(rate_sums, weights):
    """Return the mean over speckle of the probability of leakage, 1 - exp(-R).

    This is the probability that leaked signal lifts at least one bin above the threshold. R is the
    sum of the bins' crossing rates. ``rate_sums`` holds R at the nodes of highest speckle power.
    Below the lowest of these nodes, terms of the mean are continued as a geometric series. If all
    draws leak (R is large even there), the terms are proportional to the speckle power. If R is
    small, it is proportional to the speckle power too, and the terms to its square.
    """
    mean, lowest_term, next_term = 0.0, 0.0, 0.0
    for i in range(rate_sums.size - 1, -1, -1):
        term = weights[weights.size - rate_sums.size + i] * _crossing_probability(rate_sums[i])
        mean += term
        lowest_term, next_term = term, lowest_term
    return mean + (
        lowest_term * lowest_term / (next_term - lowest_term) if next_term > lowest_term else 0.0
    )


@njit(cache=True, error_model="numpy")
def _compute_separate_peak_rates(
    bin_index,
    bins_begin,
    bins_end,
    leakage_bins,
    threshold_index,
    rate_table,
    quadrature,
    is_evaluated,
    separate_peak_rates,
):
    """Compute the rates of false peaks, in leaked bins next to an echo, that do not join the echo.

    Crossing bins adjacent to the echo join it if the echo's outermost bin crosses the threshold.

    Parameters
    ----------
    bin_index
        Index of the bin in ``leakage_bins.bins``.
    bins_begin, bins_end
        Index of the segment's first bin, and of its last bin plus 1.
    leakage_bins
        :class:`LeakageBins` of the batch.
    threshold_index
        Index of the threshold in ``leakage_bins.log_crossing_rates``.
    rate_table, quadrature
        :class:`CrossingRateTable` and :class:`SpeckleQuadrature` for this threshold.
    is_evaluated
        (bins,) bool: True for bins that were evaluated before.
    separate_peak_rates
        Result: rates -ln(1 - p) at the nodes of highest speckle power. p is the probability of
        a peak that does not join the echo, in the bin ``bin_index`` or in bins farther from the
        echo.

    Returns
    -------
    int
        Index of the bin farthest from the echo that p includes.
    """
    n_nodes, step = separate_peak_rates.size, -leakage_bins.side_of_adjacent_echo_bin[bin_index]
    end_index = bin_index + step
    while (
        bins_begin <= end_index < bins_end
        and leakage_bins.bins[end_index] - leakage_bins.bins[bin_index] == end_index - bin_index
    ):
        bright_log_amplitude = (
            leakage_bins.log_amplitude[end_index - step] + BRIGHT_SPECKLE_LOG_AMPLITUDE
        )  # amplitude in bright speckle
        if (
            abs(end_index - bin_index) > 1
            and _crossing_rate(bright_log_amplitude, rate_table) < JOINING_CROSSING_RATE_MIN
        ):
            break
        if (
            is_evaluated[end_index]
            or leakage_bins.fading_group[end_index] != leakage_bins.fading_group[bin_index]
            or leakage_bins.exempt_neighbour_magnitude_ratio[end_index] > 0.0
        ):
            break
        end_index += step
    bin_rates, p_any_after_quiet, p_any = np.empty(n_nodes), np.zeros(n_nodes), np.zeros(n_nodes)
    for j in range(end_index - step, bin_index, -step):
        bin_rates[:] = 0.0
        _add_rates_at_nodes(leakage_bins.log_amplitude[j], rate_table, quadrature, bin_rates)
        for i in range(n_nodes):
            p_cross = _crossing_probability(bin_rates[i])
            p_any_after_quiet[i] = p_cross * p_any_after_quiet[i] + (1.0 - p_cross) * p_any[i]
            p_any[i] = p_cross + (1.0 - p_cross) * p_any[i]
    bin_rates[:] = 0.0
    _add_rates_at_nodes(leakage_bins.log_amplitude[bin_index], rate_table, quadrature, bin_rates)
    log_power_step = 2.0 * quadrature.node_stride * rate_table.log_amplitude_step
    nodes_per_step = max(int(ECHO_EDGE_LOG_SPECKLE_POWER_STEP / log_power_step), 1)
    mean_power_node = n_nodes - quadrature.weights.size + quadrature.n_nodes_below_mean
    first_edge_node = max(
        mean_power_node - int(ECHO_EDGE_LOG_SPECKLE_POWER_DEPTH / log_power_step), 0
    )
    edge_ratio, neighbour_ratio = (
        leakage_bins.amplitude_gain_max * leakage_bins.exempt_neighbour_magnitude_ratio[bin_index],
        leakage_bins.amplitude_gain_max * math.exp(leakage_bins.log_amplitude[bin_index]),
    )
    p_edge_after, step_begin = 0.0, -nodes_per_step
    while step_begin < n_nodes:
        step_end = first_edge_node if step_begin < 0 else step_begin + nodes_per_step
        root_power = math.exp(0.5 * log_power_step * (step_end - mean_power_node))
        p_edge_before = p_edge_after
        p_edge_after = echo_edge_crossing_probability(
            edge_ratio * root_power,
            neighbour_ratio * root_power,
            leakage_bins.threshold_ratio[threshold_index],
            leakage_bins.sidelobe_neighbour_noise_correlation,
        )
        p_edge_slope = (p_edge_after - p_edge_before) / nodes_per_step
        if step_begin < 0:
            step_begin, p_edge_before, p_edge_slope = 0, p_edge_after, 0.0
        for i in range(step_begin, min(step_end, n_nodes)):
            p_edge = p_edge_before + p_edge_slope * (i - step_begin)
            p_cross = _crossing_probability(bin_rates[i])
            p_apart = 1.0 - p_edge + p_edge * p_any_after_quiet[i]
            separate_peak_rates[i] = crossing_rate(p_cross * p_apart + (1.0 - p_cross) * p_any[i])
        step_begin = step_end
    return end_index - step


@njit(cache=True, error_model="numpy")
def _crossing_probability(rate):
    """Return 1 - exp(-rate): the probability that a bin with this crossing rate is raised."""
    if rate < 1e-4:
        return rate * (1.0 - rate * (0.5 - rate / 6.0))
    return -math.expm1(-rate)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_mean_leakage_probabilities(leakage_bins, leakage_probability):
    """Compute the probability of a false peak by leaked signal in each segment.

    The results are written into ``leakage_probability`` (m, 3). The probability is a mean over
    speckle, in which each echo fades independently, and over the phase of the line of light leaked
    in the circulator.
    """
    is_evaluated = np.zeros(leakage_bins.bins.size, np.bool_)
    no_quadrature = SpeckleQuadrature(1, 0, np.empty(0), np.empty(0))
    for threshold_index in range(leakage_bins.first_log_amplitude.size):
        rate_table = CrossingRateTable(
            leakage_bins.log_crossing_rates[threshold_index],
            leakage_bins.first_log_amplitude[threshold_index],
            leakage_bins.log_amplitude_step[threshold_index],
        )
        needs_quadrature = False
        for j in range(leakage_probability.shape[0]):
            for s in range(3):
                needs_quadrature |= (
                    leakage_bins.threshold_index[j] == threshold_index
                    and not leakage_bins.mean_crossing_probability_sum[j, s]
                    <= FAINT_LEAKAGE_PROBABILITY_MAX
                )
        quadrature, node_scratch, faint_first_node = no_quadrature, np.empty((2, 0)), 0
        if needs_quadrature:
            quadrature = _make_speckle_quadrature(rate_table)
            node_scratch = np.empty((2, quadrature.weights.size))
            log_power_step = 2.0 * quadrature.node_stride * rate_table.log_amplitude_step
            faint_first_node = int(
                (FAINT_LEAKAGE_LOG_SPECKLE_POWER_MIN - LOG_SPECKLE_POWER_MIN) / log_power_step
            )
        for j in range(leakage_probability.shape[0]):
            if leakage_bins.threshold_index[j] != threshold_index:
                continue
            for s in range(3):
                begin, end = leakage_bins.bins_begin[j, s], leakage_bins.bins_end[j, s]
                first_node = (
                    faint_first_node
                    if leakage_bins.crossing_rate_sum_bound_at_mean[j, s]
                    <= FAINT_LEAKAGE_CROSSING_RATE_SUM_MAX
                    else 0
                )
                rate_sums, separate_peak_rates = (
                    node_scratch[0, first_node:],
                    node_scratch[1, first_node:],
                )
                p_leakage, n_groups = 0.0, 0
                if (
                    leakage_bins.mean_crossing_probability_sum[j, s]
                    <= FAINT_LEAKAGE_PROBABILITY_MAX
                ):
                    p_leakage, end = leakage_bins.mean_crossing_probability_sum[j, s], begin
                for k in range(begin, end):
                    n_groups = max(n_groups, leakage_bins.fading_group[k] + 1)
                for group in range(n_groups):
                    rate_sums[:] = 0.0
                    for k in range(begin, end):
                        if (
                            leakage_bins.exempt_neighbour_magnitude_ratio[k] > 0.0
                            and leakage_bins.fading_group[k] == group
                            and not is_evaluated[k]
                        ):
                            last_joined = _compute_separate_peak_rates(
                                k,
                                begin,
                                end,
                                leakage_bins,
                                threshold_index,
                                rate_table,
                                quadrature,
                                is_evaluated,
                                separate_peak_rates,
                            )
                            is_evaluated[min(k, last_joined) : max(k, last_joined) + 1] = True
                            rate_sums += separate_peak_rates
                    for k in range(begin, end):
                        if leakage_bins.fading_group[k] == group and not is_evaluated[k]:
                            _add_rates_at_nodes(
                                leakage_bins.log_amplitude[k], rate_table, quadrature, rate_sums
                            )
                    p_leakage += _mean_leakage_probability_from_rates(
                        rate_sums, quadrature.weights
                    ) * (1.0 - p_leakage)
                n_phases, p_line_alarm = leakage_bins.permanent_line_log_amplitude.shape[0], 0.0
                for phase in range(n_phases):
                    crossing_rate_sum = 0.0
                    for k in range(
                        leakage_bins.permanent_line_begin[j, s],
                        leakage_bins.permanent_line_end[j, s],
                    ):
                        crossing_rate_sum += _crossing_rate(
                            leakage_bins.permanent_line_log_amplitude[phase, k], rate_table
                        )
                    p_line_alarm -= math.expm1(-crossing_rate_sum) / n_phases
                leakage_probability[j, s] = p_leakage + p_line_alarm * (1.0 - p_leakage)


@njit(cache=True, error_model="numpy", borrows=True)
def insert_peak(bin_number, ratio, peak_bins, peak_ratios, n_peaks):
    """Insert a peak into a list sorted by strength, strongest first.

    If the list is full, its weakest peak is dropped.

    Parameters
    ----------
    bin_number : int
        Bin of the peak; -1 for no peak, which leaves the list as it is.
    ratio : float
        |X| of the bin over sigma, the noise of a bin per quadrature.
    peak_bins, peak_ratios : ndarray (peaks,)
        List of bins and of |X| / sigma, changed in place.
    n_peaks : int
        Number of peaks in the list.

    Returns
    -------
    int
        New number of peaks.
    """
    if bin_number < 0:
        return n_peaks
    rank = n_peaks
    while rank > 0 and peak_ratios[rank - 1] < ratio:
        rank -= 1
    if rank >= peak_bins.size:
        return n_peaks
    n_peaks = min(n_peaks + 1, peak_bins.size)
    for k in range(n_peaks - 1, rank, -1):
        peak_bins[k], peak_ratios[k] = peak_bins[k - 1], peak_ratios[k - 1]
    peak_bins[rank], peak_ratios[rank] = bin_number, ratio
    return n_peaks


@njit(cache=True, error_model="numpy", borrows=True, forceinline=True)
def draw_leaked_peaks(
    address,
    point,
    segment,
    leakage_bins,
    fading_factors,
    threshold_ratio,
    n_looks,
    interpolation,
    peak_bins,
    peak_ratios,
):
    """Draw the false peaks that leaked signal raises in a segment, and list the strongest.

    Parameters
    ----------
    address
        Address of the draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    point, segment
        Index of the point in ``leakage_bins``, and segment.
    leakage_bins
        :class:`LeakageBins` of the batch.
    fading_factors
        (groups, 3): factors, due to speckle, on the echoes' magnitudes.
    threshold_ratio
        Threshold [sigma].
    n_looks
        Number of looks (records of the segment) whose powers are averaged.
    interpolation
        Interpolator of the window, for the correlation of neighbours' noise.
    peak_bins, peak_ratios
        Results: bin and |X| / sigma of the peaks, strongest first. For averaged looks |X| is that
        of a single look of the same significance.

    Returns
    -------
    int
        Number of peaks in the list.
    """
    key_0, key_1, draw = address
    threshold_index = leakage_bins.threshold_index[point]
    rate_table = CrossingRateTable(
        leakage_bins.log_crossing_rates[threshold_index],
        leakage_bins.first_log_amplitude[threshold_index],
        leakage_bins.log_amplitude_step[threshold_index],
    )
    speckle_power_max, bound_index, rate_sum_bound = 0.0, 0, np.inf
    for group_index in range(fading_factors.shape[0]):
        speckle_power_max = max(
            speckle_power_max,
            fading_factors[group_index, segment] * fading_factors[group_index, segment],
        )
    while bound_index < N_RATE_BOUND_SPECKLE_POWERS and speckle_power_max > float(1 << bound_index):
        bound_index += 1
    if bound_index < N_RATE_BOUND_SPECKLE_POWERS:
        rate_sum_bound = leakage_bins.crossing_rate_sum_bounds[point, segment, bound_index]
    n_peaks = INTEGER_ZERO
    if rate_sum_bound > 0.0:
        n_peaks = _draw_raised_bins(
            address,
            segment,
            INTEGER_ZERO,
            leakage_bins.bins_begin[point, segment],
            leakage_bins.bins_end[point, segment],
            leakage_bins.bins,
            leakage_bins.log_amplitude,
            leakage_bins.fading_group,
            leakage_bins.exempt_neighbour_magnitude_ratio,
            fading_factors[:, segment],
            rate_sum_bound,
            rate_table,
            threshold_ratio,
            n_looks,
            interpolation.sidelobe_neighbour_noise_correlation,
            peak_bins,
            peak_ratios,
            n_peaks,
        )
    if leakage_bins.permanent_line_crossing_rate_sum[point, segment] > 0.0:
        uniform_phase = philox.uniform(
            key_0, key_1, draw, philox.STREAM_LEAKAGE[segment], PERMANENT_LINE_FIRST_RANDOM_INDEX
        )
        phase = int(uniform_phase * leakage_bins.permanent_line_log_amplitude.shape[0])
        n_peaks = _draw_raised_bins(
            address,
            segment,
            PERMANENT_LINE_FIRST_RANDOM_INDEX + 1,
            leakage_bins.permanent_line_begin[point, segment],
            leakage_bins.permanent_line_end[point, segment],
            leakage_bins.permanent_line_bins,
            leakage_bins.permanent_line_log_amplitude[phase],
            leakage_bins.fading_group[:0],
            leakage_bins.exempt_neighbour_magnitude_ratio[:0],
            fading_factors[:, segment],
            leakage_bins.permanent_line_crossing_rate_sum[point, segment],
            rate_table,
            threshold_ratio,
            n_looks,
            0.0,
            peak_bins,
            peak_ratios,
            n_peaks,
        )
    return n_peaks


@njit(cache=True, error_model="numpy", borrows=True)
def _draw_raised_bins(
    address,
    segment,
    first_random,
    bins_begin,
    bins_end,
    bins,
    log_amplitude,
    group,
    exempt_neighbour_magnitude_ratio,
    fading_factors,
    crossing_rate_sum,
    rate_table,
    threshold_ratio,
    n_looks,
    noise_correlation,
    peak_bins,
    peak_ratios,
    n_peaks,
):
    """Draw which bins of leaked signal cross the threshold; list their peaks, and return how many.

    Adjacent raised bins make one peak. Peaks adjacent to a crossing bin of the echo belong to
    the echo. Bins are skipped by exponential random numbers, as the module describes.

    Parameters
    ----------
    address, segment
        Address of the draw (:class:`sweep.model.sampling.philox.DrawAddress`), and segment.
    first_random
        Index of the first random number of the segment's stream.
    bins_begin, bins_end
        Index of the segment's first bin in the arrays, and of its last bin plus 1.
    bins, log_amplitude
        Numbers of the bins, and ln(|X| / sigma).
    group, exempt_neighbour_magnitude_ratio
        Fields of :class:`LeakageBins`; empty for bins that do not fade and join no echo.
    fading_factors
        (groups,): factors, due to speckle, on the echoes' magnitudes.
    crossing_rate_sum
        Upper bound on the sum of the rates of all bins in this draw.
    rate_table
        :class:`CrossingRateTable` of the threshold.
    threshold_ratio, n_looks, noise_correlation
        Threshold [sigma], number of looks, and correlation of neighbours' noise.
    peak_bins, peak_ratios, n_peaks
        List of peaks, as in :func:`insert_peak`.
    """
    key_0, key_1, draw = address
    stream = philox.STREAM_LEAKAGE[segment]
    remainder = math.sqrt(1.0 - noise_correlation * noise_correlation)
    probability = philox.uniform(key_0, key_1, draw, stream, first_random)
    if probability > crossing_rate_sum:  # then -ln(1 - probability) is larger, too
        return n_peaks
    exponent_left = -math.log1p(-probability)
    if exponent_left > crossing_rate_sum:
        return n_peaks
    root_looks = math.sqrt(float(n_looks))
    scaled_threshold = threshold_ratio * root_looks
    previous_bin, peak_bin, peak_ratio, is_echo = np.int64(-2), NO_INDEX, 0.0, False
    for k in range(bins_begin, bins_end):
        fading_factor = fading_factors[group[k]] if group.size > 0 else 1.0
        log_amplitude_k = log_amplitude[k] + math.log(fading_factor)
        exponent_left -= _crossing_rate(log_amplitude_k, rate_table)
        if exponent_left > 0.0:
            continue
        if bins[k] != previous_bin + 1:
            n_peaks = insert_peak(
                NO_INDEX if is_echo else peak_bin, peak_ratio, peak_bins, peak_ratios, n_peaks
            )
            peak_bin, peak_ratio, is_echo = NO_INDEX, 0.0, False
        previous_bin, signal = bins[k], math.exp(log_amplitude_k) * root_looks
        probability = philox.uniform(
            key_0, key_1, draw, stream, first_random + 1
        ) * _crossing_probability_added_by_signal(signal, scaled_threshold)
        if (
            exempt_neighbour_magnitude_ratio.size > 0 and exempt_neighbour_magnitude_ratio[k] > 0.0
        ):  # its noise is correlated with that of this bin
            re, im = philox.normal_pair(
                key_0, key_1, draw, stream, ECHO_EDGE_FIRST_RANDOM_INDEX + k - bins_begin
            )
            echo_bin_signal = exempt_neighbour_magnitude_ratio[k] * fading_factor * root_looks
            echo_bin_in_phase = echo_bin_signal + noise_correlation * (
                _magnitude_at_crossing_probability(signal, scaled_threshold, probability) - signal
            )
            is_echo |= (
                math.hypot(echo_bin_in_phase + remainder * re, remainder * im) >= scaled_threshold
            )
        ratio_min = max(
            peak_ratio, peak_ratios[n_peaks - 1] if n_peaks == peak_ratios.size else 0.0
        )
        if (
            ratio_min * root_looks < scaled_threshold
            or _crossing_probability_added_by_signal(signal, ratio_min * root_looks) > probability
        ):
            peak_bin, peak_ratio = (
                bins[k],
                _magnitude_at_crossing_probability(signal, scaled_threshold, probability)
                / root_looks,
            )
        first_random += 2
        exponent_left = -math.log1p(-philox.uniform(key_0, key_1, draw, stream, first_random))
    return insert_peak(
        NO_INDEX if is_echo else peak_bin, peak_ratio, peak_bins, peak_ratios, n_peaks
    )


@njit(cache=True, error_model="numpy")
def _crossing_probability_added_by_signal(signal, threshold_ratio):
    """Return the probability c(z) that signal lifts a bin to a level z that noise alone misses.

    ``signal`` and ``threshold_ratio`` (the level z) are amplitudes over sigma, the noise of a bin
    per quadrature.
    """
    return marcum_q1_excess(signal, threshold_ratio) / -math.expm1(
        -0.5 * threshold_ratio * threshold_ratio
    )


@njit(cache=True, error_model="numpy")
def _magnitude_at_crossing_probability(signal, threshold_ratio, probability):
    """Return the magnitude z [sigma] at which c(z) equals ``probability``, by bisection.

    c(z) is the probability that ``signal`` lifts a bin to z if noise alone does not. sigma is the
    noise of a bin per quadrature. z is at least ``threshold_ratio``.
    """
    low, high = threshold_ratio, max(signal, threshold_ratio) + CERTAIN_CROSSING_MARGIN_SIGMA
    for _ in range(N_BISECTION_STEPS):
        middle = 0.5 * (low + high)
        if _crossing_probability_added_by_signal(signal, middle) > probability:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
