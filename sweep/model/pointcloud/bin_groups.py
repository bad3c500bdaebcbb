"""Groups of adjacent bins at or above the threshold in noiseless spectra.

A group is a run of adjacent bins whose magnitude reaches the threshold. It is the echo of a
surface, or a sidelobe of a strong echo. Draws add noise to the strongest bin of each group
(:mod:`sweep.model.pointcloud.returns`).
"""

from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection.detection_probability import group_pd_in_all_looks, pd_of_bin_group
from sweep.model.detection.echo_detection import bin_speckle_of_point, bin_threshold_of_point
from sweep.model.preparation import Shots
from sweep.model.spectrum.segment_spectra import BinSpans, is_raised_bin_bound_valid, iter_spans


class BinGroups(NamedTuple):
    """Groups of adjacent bins at or above the threshold in noiseless spectra, by point and segment.

    Segments are in the order up, Doppler, down. Each group is the echo of a surface, or a sidelobe
    of a strong echo. Groups are listed strongest first. Elements without a group have bin -1 and
    nan. If no bin reaches the threshold, the strongest bin is listed, because noise may lift it. An
    echo outside the search band, or one that arrives after the record, has no group. Its entry has
    bin -1, but holds |X| of the strongest bin.
    """

    strongest_bin: np.ndarray
    """(n, 3, groups) int64: number of the group's strongest bin; -1 for no group. With the FFT size
    N it is 0..N/2 for a real record. Numbers of a complex record are periodic in N."""
    first_bin: np.ndarray
    """(n, 3, groups) int64: number of the first (lowest) bin of the group; -1 for no group."""
    last_bin: np.ndarray
    """(n, 3, groups) int64: number of the last (highest) bin of the group; -1 for no group."""
    peak_and_neighbour_magnitudes: np.ndarray
    """(n, 3, groups, 3): |X| without noise [V, summed over the record] of three bins: the bin below
    the group's strongest bin, the strongest bin, and the bin above it."""
    pd: np.ndarray
    """(n, 3, groups): probability, in noise, that the segment detects the group; nan for no group.
    """
    n_exempt_bins: np.ndarray
    """(n, 3): number of bins of a segment that belong to echoes. They cannot raise a false alarm.
    """
    leakage_probability: np.ndarray
    """(n, 3): probability that leaked signal (echo power far from its line) raises a false peak.
    False peaks of noise alone are not included."""
    raised_bin_probability_max: np.ndarray
    """(n, 3): upper bound on the probability that leaked signal raises any bin above the threshold.
    Bins that join an echo count. The bound is 1 where it is not computed."""

    @property
    def magnitude(self) -> np.ndarray:
        """Return |X| without noise of each group's strongest bin [V, summed over the record].

        The result is (n, 3, groups).
        """
        return self.peak_and_neighbour_magnitudes[..., 1]

    def without_unused_groups(self) -> "BinGroups":
        """Return a copy of the record with a shorter axis of groups.

        Trailing entries that are -1 (no group) for all points and segments are cut off. At least
        one entry remains.
        """
        n_groups = max(int((self.strongest_bin >= 0).any(axis=(0, 1)).sum()), 1)
        return self._replace(
            **{
                name: np.ascontiguousarray(getattr(self, name)[:, :, :n_groups])
                for name in (
                    "strongest_bin",
                    "first_bin",
                    "last_bin",
                    "peak_and_neighbour_magnitudes",
                    "pd",
                )
            }
        )


class GroupBinIndices(NamedTuple):
    """Strongest, first and last bins of the groups of one segment, as indices in its span."""

    strongest: np.ndarray
    """(groups,) int64: index of each group's strongest bin in an array of adjacent bins."""
    first: np.ndarray
    """(groups,) int64: index of each group's first (lowest) bin in the same array."""
    last: np.ndarray
    """(groups,) int64: index of each group's last (highest) bin in the same array."""


def list_bin_groups(
    shots: Shots, *, groups_max: int = 4, every_bin: bool = False, with_leakage: bool = True
) -> BinGroups:
    """Return the strongest groups of bins in the noiseless spectra of all points and segments.

    A group is a run of adjacent bins at or above the threshold.

    Parameters
    ----------
    shots
        Prepared shots.
    groups_max
        Largest number of groups that are listed for a segment.
    every_bin
        True to sum leakage bin by bin where it could be an integral (:func:`iter_spans`).
    with_leakage
        False to skip the probability of leakage, which is then 0.
    """
    bin_groups = allocate_bin_groups(shots.size, groups_max)
    for spans in iter_spans(
        shots,
        bin_by_bin=every_bin,
        leakage=with_leakage,
        doppler_leakage=is_raised_bin_bound_valid(shots),
        computes_pd=False,
    ):
        find_groups_in_spans(shots, spans, bin_groups)
    return bin_groups


def allocate_bin_groups(n_points: int, groups_max: int) -> BinGroups:
    """Return a :class:`BinGroups` without any group, for n points.

    Parameters
    ----------
    n_points : int
        Number n of points.
    groups_max : int
        Largest number of groups of a segment.

    Returns
    -------
    BinGroups
        Arrays (n, 3, ``groups_max``), with bins -1 and other values nan.
    """
    shape = n_points, 3, groups_max
    return BinGroups(
        strongest_bin=np.full(shape, -1, np.int64),
        first_bin=np.full(shape, -1, np.int64),
        last_bin=np.full(shape, -1, np.int64),
        peak_and_neighbour_magnitudes=np.full((*shape, 3), np.nan),
        pd=np.full(shape, np.nan),
        n_exempt_bins=np.full((n_points, 3), np.nan),
        leakage_probability=np.full((n_points, 3), np.nan),
        raised_bin_probability_max=np.ones((n_points, 3)),
    )


def find_groups_in_spans(shots: Shots, spans: BinSpans, bin_groups: BinGroups) -> None:
    """Find groups of adjacent bins above the threshold, and write them into ``bin_groups``.

    The search covers spans: ranges of adjacent bins around the lines of each segment.

    Parameters
    ----------
    shots
        Prepared shots.
    spans
        Spans of bins of some of the points.
    bin_groups
        Arrays of :func:`allocate_bin_groups` for all points, in which the groups are written.
    """
    nyquist_bin = 0 if shots.complex_record else shots.fft_size // 2
    n_bins, magnitudes = (
        (spans.n_bins, spans.magnitudes)
        if shots.detection_settings.search_band is None
        else _zero_leakage_of_unsearched_echoes(spans)
    )
    _find_and_write_groups(
        spans.point_numbers,
        # In C order: numba compiles anew for each order.
        np.ascontiguousarray(spans.first_bin),
        np.ascontiguousarray(n_bins),
        np.ascontiguousarray(spans.peak_index),
        np.ascontiguousarray(spans.span_start),
        magnitudes,
        spans.is_exempt,
        shots.bin_thresholds,
        nyquist_bin,
        shots.detection_rule,
        shots.speckle_table,
        bin_groups,
    )
    bin_groups.pd[spans.point_numbers] = group_pd_in_all_looks(
        shots,
        bin_groups.pd[spans.point_numbers],
        bin_groups.magnitude[spans.point_numbers],
        bin_groups.strongest_bin[spans.point_numbers],
        spans.peak_is_searched.T | (n_bins.T > 0),
        spans.point_numbers,
    )
    lacks_group = (bin_groups.strongest_bin[spans.point_numbers, :, 0] < 0) & shots.has_segment
    strongest_magnitudes = bin_groups.peak_and_neighbour_magnitudes[spans.point_numbers, :, 0, 1]
    bin_groups.peak_and_neighbour_magnitudes[spans.point_numbers, :, 0, 1] = np.where(
        lacks_group, spans.peak_magnitude.T, strongest_magnitudes
    )
    n_exempt_or_nan = np.where((spans.n_bins > 0) | ~spans.peak_is_searched, spans.n_exempt, np.nan)
    (
        bin_groups.n_exempt_bins[spans.point_numbers],
        bin_groups.leakage_probability[spans.point_numbers],
    ) = (
        n_exempt_or_nan.T,
        spans.leakage_probability.T,
    )
    bin_groups.raised_bin_probability_max[spans.point_numbers] = spans.raised_bin_probability_max.T


def _zero_leakage_of_unsearched_echoes(spans: BinSpans) -> tuple[np.ndarray, np.ndarray]:
    """Return the bin counts and |X| of spans, with leakage of unsearched echoes set to 0.

    A span is a range of adjacent bins of one segment. An echo is unsearched if its strongest bin is
    outside the search band. Its sidelobes are leaked signal and make no groups, so |X| is set to 0
    in all bins of its segment outside the echo.
    """
    n_bins, magnitudes = spans.n_bins.copy(), spans.magnitudes.copy()
    for s, j in np.argwhere(~spans.peak_is_searched):
        start, end = spans.span_start[s, j] + np.array([0, spans.n_bins[s, j]])
        is_echo = spans.is_exempt[start:end]
        magnitudes[start:end][~is_echo] = 0.0
        if not is_echo.any():
            n_bins[s, j] = 0
    return n_bins, magnitudes


@njit(cache=True, nogil=True, error_model="numpy")
def _find_and_write_groups(
    point_numbers,
    first_bin,
    n_bins,
    peak_index,
    span_start,
    magnitudes,
    is_exempt,
    bin_thresholds,
    nyquist_bin,
    rule,
    speckle_table,
    bin_groups,
):
    """Find groups in every span, and write them into the arrays of a :class:`BinGroups`.

    A group is a run of adjacent bins at or above the threshold. A span holds the adjacent bins
    around the lines of a segment.

    Parameters
    ----------
    point_numbers
        (m,): index of each point.
    first_bin, n_bins, peak_index, span_start
        (3, m): first bin, number of bins, index of the largest bin, and begin in ``magnitudes`` and
        ``is_exempt``, of each span.
    magnitudes
        (bins,): |X| of the bins of all spans [V, summed over the record].
    is_exempt
        (bins,) bool: True for bins of echoes. Groups in other bins are leaked signal.
    bin_thresholds
        (n,) each: :attr:`sweep.model.preparation.Shots.bin_thresholds`.
    nyquist_bin
        Half of the FFT size, N/2, or 0 for a complex record.
    rule
        :attr:`sweep.model.preparation.Shots.detection_rule`.
    speckle_table
        :attr:`sweep.model.preparation.Shots.speckle_table`.
    bin_groups
        Result: bins, magnitudes and pd of the groups of all n points in a :class:`BinGroups`.
    """
    for j in range(point_numbers.size):
        i = point_numbers[j]
        bin_threshold = bin_threshold_of_point(bin_thresholds, i)
        for segment in range(3):
            if n_bins[segment, j] == 0:
                continue
            begin = span_start[segment, j]
            end = begin + n_bins[segment, j]
            magnitude = magnitudes[begin:end]
            is_echo = is_exempt[begin : end if nyquist_bin == 0 else begin]
            bounds = GroupBinIndices(
                bin_groups.strongest_bin[i, segment],
                bin_groups.first_bin[i, segment],
                bin_groups.last_bin[i, segment],
            )
            n_groups = _list_strongest_groups(
                magnitude, is_echo, peak_index[segment, j], bin_threshold.threshold, bounds
            )
            for group in range(n_groups):
                strongest_index = bounds.strongest[group]
                bin_groups.pd[i, segment, group] = pd_of_bin_group(
                    magnitude,
                    strongest_index,
                    bounds.first[group],
                    bounds.last[group],
                    first_bin[segment, j],
                    rule,
                    bin_threshold,
                    bin_speckle_of_point(speckle_table, segment, i),
                )
                for side in range(3):
                    bin_groups.peak_and_neighbour_magnitudes[i, segment, group, side] = (
                        _magnitude_at_mirrored_index(
                            magnitude,
                            first_bin[segment, j],
                            strongest_index + side - 1,
                            nyquist_bin,
                        )
                    )
                bounds.strongest[group] += first_bin[segment, j]  # from indices to bin numbers
                bounds.first[group] += first_bin[segment, j]
                bounds.last[group] += first_bin[segment, j]


@njit(cache=True, error_model="numpy", borrows=True)
def _magnitude_at_mirrored_index(magnitude, first_bin, index, nyquist_bin):
    """Return |X| of a bin, given by its index in a span (adjacent bins from ``first_bin`` on).

    A bin beyond frequency 0 or Nyquist has the magnitude of its mirror image. A bin outside the
    span has the magnitude 0.
    """
    if nyquist_bin > 0:
        bin_ = abs(first_bin + index)
        index = (2 * nyquist_bin - bin_ if bin_ > nyquist_bin else bin_) - first_bin
    return magnitude[index] if 0 <= index < magnitude.size else 0.0


@njit(cache=True, error_model="numpy", borrows=True)
def _list_strongest_groups(magnitude, is_echo, peak_index, threshold, bounds):
    """List the strongest groups of adjacent bins at or above the threshold; return their number.

    A group whose strongest bin does not belong to an echo is leaked signal, and is omitted. The
    group of the span's largest bin is never omitted. If the largest bin is below the threshold, it
    is the only listed group.

    Parameters
    ----------
    magnitude : ndarray (bins,)
        |X| of a span's bins without noise [V, summed over the record]. A nan counts as below the
        threshold.
    is_echo : ndarray (bins,) bool
        True in bins of an echo. If the array is empty, no group is omitted.
    peak_index : int
        Index of the largest bin.
    threshold : float
        Threshold on |X| [V, summed over the record].
    bounds : GroupBinIndices
        Results: indices in ``magnitude`` of each group's strongest, first and last bin, strongest
        group first. If there are more groups than elements, the weakest are omitted
        (:class:`GroupBinIndices`).

    Returns
    -------
    int
        Number of listed groups, at least 1.
    """
    if not magnitude[peak_index] >= threshold:
        bounds.strongest[0] = bounds.first[0] = bounds.last[0] = peak_index
        return 1
    groups_max, n_groups, k = bounds.strongest.size, 0, 0
    while k < magnitude.size:
        if not magnitude[k] >= threshold:  # also true for nan, which would loop forever
            k += 1
            continue
        strongest_index = first = k
        while k < magnitude.size and magnitude[k] >= threshold:
            strongest_index = k if magnitude[k] > magnitude[strongest_index] else strongest_index
            k += 1
        if is_echo.size > 0 and not is_echo[strongest_index] and strongest_index != peak_index:
            continue
        g = n_groups
        while g > 0 and magnitude[bounds.strongest[g - 1]] < magnitude[strongest_index]:
            g -= 1
        n_groups = min(n_groups + 1, groups_max)
        for h in range(n_groups - 1, g, -1):
            bounds.strongest[h] = bounds.strongest[h - 1]
            bounds.first[h], bounds.last[h] = bounds.first[h - 1], bounds.last[h - 1]
        if g < groups_max:
            bounds.strongest[g], bounds.first[g], bounds.last[g] = strongest_index, first, k - 1
    return n_groups
