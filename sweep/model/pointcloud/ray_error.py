"""Error of probabilities and peak magnitudes by sampling the beam with too few rays.

If powers add, the power of the detected bin is a mean over the beam, P = sum_b w_b g_b. Here g_b is
the power of the bin if all light went to beamlet b. A hexagonal lattice of whole shells is exact
for all odd functions about the beam's axis and for squares of the positions, and nearly exact for
smooth ground. So g is made even, and its best polynomial is subtracted, of degree 2 for few rays
and 4 for more. The remainder r measures the roughness of the ground between the beamlets. The part
of the beam about each beamlet is assumed to err, independently, by as much as it differs from its
neighbours:

    (dP)^2 = sum w_a w_b (r_a - r_b)^2    over the pairs of neighbours.

The lattice ends at a radius, and is stretched so that squares remain exact. So its weights w_b are
not the powers u_b of the beam about the beamlets. If the power outside the lattice is taken from
the outermost shell, the power changes by

    sum (u_b - w_b) g_b + (1 - sum u_b) mean of g in the outermost shell.

This is 0.5 % for 19 rays whose lines fill some bins, and less for more rays, whose lattices are
wider. Its magnitude is added to dP.

In developed speckle the same dP changes a probability of detection less, and no magnitude: rays
that the probabilities do not need are not cast.

Like the error itself, dP is about inversely proportional to the number of rays. It does not include
objects that no ray has hit. It overestimates the roughness of smooth ground, most of all for 19
rays. It was checked against 8,017 or 16,021 rays, on shots with errors above 1e-6 where powers add:
1,000 shots of each of scan pattern comparison, gale crater descent, forest scan and square high
descent. For one in a thousand of the forest's shots it is below half of the error, whatever the
number of rays, and for no others. Its median is 7 to 60 times the error for 19 rays, and 2 to 10
times from 61 rays on.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.beamlets import lattice_radius, place_beamlets
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.ground import BeamletTable
from sweep.model.preparation import Shots
from sweep.model.window import window_samples

_CHIRP_SIGNS = 1.0, 0.0, -1.0
"""Signs of the frequency slopes of the segments: up 1, Doppler 0, down -1."""

_LOBE_REACH_CELLS = 4
"""Largest distance from a line's centre in the table of the line's power [resolution cells]. A cell
is the sample rate over the number of samples in the record."""
_LOBE_STEPS_PER_CELL = 1024
"""Number of entries per resolution cell in the table of a line's power by distance from its centre.
A cell is the sample rate over the number of samples in the record."""
_LINE_TABLE_WINDOW_SAMPLES = 1024
"""Number of window samples from which the table of a line's power by distance is computed."""

_NEIGHBOUR_DISTANCE_RATIO = 1.3
"""Largest distance of two beamlets that count as neighbours, divided by the lattice's smallest
distance. The second smallest distance is 1.7 times the smallest."""

_QUARTIC_RAYS_MIN = 37
"""Smallest number of rays for which polynomials of degree 4 are subtracted from the powers. With
fewer rays the degree is 2, because too few residuals would remain."""

_NEGLIGIBLE_DENSITY_DISTANCE_SIGMA = 15.0
"""Difference between magnitude and threshold, in standard deviations of the noise per quadrature,
beyond which an error of the magnitude changes no probability. The density of the noise is e^-112 of
its maximum at this difference."""

_RESULT_CHANGE_MIN = 1e-9
"""Smallest change of a result that matters. The error due to too few rays is computed only for
peaks whose results could change by more. Results are probabilities of detection, and magnitudes of
peaks (relative change)."""


class OppositeBeamletPairs(NamedTuple):
    """Hexagonal lattice of beamlets, as h pairs of opposite beamlets about the central one.

    The central beamlet is a pair by itself. Quantities that are odd about the beam's axis cancel in
    a pair.
    """

    beamlet: np.ndarray
    """(h,) int64: index of the first beamlet of each pair of opposite beamlets."""
    opposite_beamlet: np.ndarray
    """(h,) int64: index of the second beamlet of each pair of opposite beamlets."""
    inverse_weight: np.ndarray
    """(h,): 1 divided by the fraction of the beam's power that both beamlets of a pair have
    together."""
    polynomials: np.ndarray
    """(k, h): values of k even polynomials of beamlet position at each of h pairs. They are
    orthonormal, with the power fractions of the pairs as weights."""
    weighted_polynomials: np.ndarray
    """(k, h): ``polynomials`` times the power fractions of the pairs."""
    relative_weight_deficit: np.ndarray
    """(h,): (u - w) / w, with u the fraction of the beam's power in the area about a beamlet, and w
    the fraction that the beamlet has as its weight."""
    first_neighbouring_pair: np.ndarray
    """(m,) int64: index of the first pair of each two neighbouring pairs of beamlets."""
    second_neighbouring_pair: np.ndarray
    """(m,) int64: index of the second pair of each two neighbouring pairs of beamlets."""
    neighbour_weight: np.ndarray
    """(m,): product of the power fractions of two neighbours, summed over both sides of the beam,
    times h / (h - k). h is the number of pairs and k that of fitted polynomials, which remove
    roughness that the factor restores."""


def estimate_ray_error(
    shots: Shots, beamlet_table: BeamletTable, peak_bins: np.ndarray, magnitude: np.ndarray
) -> np.ndarray:
    """Estimate the error of each shot's results that is due to too few rays per beam.

    The estimate (n,), 0..1, is the larger of two errors. The first is the error of the
    probabilities of detection, summed over the segments. The second is the error of a peak's
    magnitude, relative to the larger of the magnitude and sigma, the noise per quadrature. The
    second error counts only without speckle: the magnitude of a speckled echo varies by decibels
    from shot to shot.

    Parameters
    ----------
    shots
        Prepared shots whose powers add.
    beamlet_table
        Footprints of the shots by ray casting: a hexagonal lattice of whole shells, even if the
        effect of its spread on the lines is omitted.
    peak_bins
        (n, 3): bin of each segment's peak, -1 for none.
    magnitude
        (n, 3): |X| of each segment's peak, nan for none.
    """
    threshold, noise_sigma = shots.threshold, shots.line_noise_sigma
    pd_change, magnitude_change = np.zeros((2, shots.size))
    beamlet_pairs = pair_opposite_beamlets(beamlet_table.relative_echo.shape[1])
    for s in range(3):
        has_peak = peak_bins[:, s] >= 0 if shots.has_segment[s] else np.zeros(shots.size, bool)
        a, b = magnitude[:, s] / noise_sigma, np.broadcast_to(threshold / noise_sigma, shots.size)
        a, b = a * shots.looks.amplitude_gain_max, shots.looks.equivalent_threshold_ratio(b)
        # Lines of the down-chirp are spread as those of the up-chirp. Those of the Doppler segment
        # are closer together, which makes them smoother. So one magnitude stands for all.
        counts_magnitude = has_peak if s == 0 else has_peak & ~(peak_bins[:, 0] >= 0)
        if shots.detection_rule.in_speckle:
            counts_magnitude = np.zeros(shots.size, bool)
        is_relevant = (
            counts_magnitude & (_relative_magnitude_change(a, 1.0) >= _RESULT_CHANGE_MIN)
        ) | (_pd_change_bound(shots, a, b, 1.0) >= _RESULT_CHANGE_MIN)
        indices = np.flatnonzero(has_peak & is_relevant)
        relative_power_error = np.empty(indices.size)
        bin_powers = _bin_powers(shots, beamlet_table, s, indices, peak_bins[indices, s])
        _fill_power_errors(bin_powers.power, beamlet_pairs, relative_power_error)
        pd_error = _pd_change_bound(shots, a[indices], b[indices], relative_power_error)
        if shots.detection_rule.in_speckle and shots.detection_rule.detects_by_any_bin:
            # Bins of a wide echo fade by themselves, and their powers err by different rays.
            pd_error = np.minimum(pd_error * np.sqrt(bin_powers.echo_width), 1.0)
        pd_change[indices] += pd_error
        magnitude_change[indices] = np.maximum(
            magnitude_change[indices],
            np.where(
                counts_magnitude[indices],
                _relative_magnitude_change(a[indices], relative_power_error),
                0.0,
            ),
        )
    return np.minimum(np.maximum(pd_change, magnitude_change), 1.0)


def _pd_change_bound(
    shots: Shots, a: np.ndarray, b: np.ndarray, relative_power_change: np.ndarray | float
) -> np.ndarray:
    """Return an upper bound on the change of a probability of detection as power changes, 0..1.

    Parameters
    ----------
    shots
        Prepared shots; their looks and their speckle choose the law.
    a, b
        Magnitude and threshold of a single record that detects as often as the looks, over the
        standard deviation of the noise per quadrature.
    relative_power_change
        Relative change of a^2.
    """
    if not shots.detection_rule.in_speckle:
        return _steady_pd_change_bound(a, b, relative_power_change)
    if shots.looks.is_noncoherent:
        return _pd_change_bound_of_looks(shots.looks.number, relative_power_change)
    return _speckled_pd_change(a, b, relative_power_change)


def _steady_pd_change_bound(
    a: np.ndarray, b: np.ndarray, relative_power_change: np.ndarray | float
) -> np.ndarray:
    """Return an upper bound on the change of Marcum's Q_1(a, b) as a^2 changes.

    Q_1 is the probability of detection of an echo that does not fade. a is its magnitude and b the
    threshold, both over the noise per quadrature. ``relative_power_change`` is the relative change
    of a^2.

    Notes
    -----
    dQ_1/d ln a <= sqrt(a b / (2 pi)) exp(-(a - b)^2 / 2), where the exponent takes the value of a
    that is nearest to b.
    """
    distance = np.maximum(np.abs(a - b) - 0.5 * relative_power_change * a, 0.0)
    bound = (
        0.5 * relative_power_change * np.sqrt(a * b / (2 * math.pi)) * np.exp(-0.5 * distance**2)
    )
    return np.where(distance > _NEGLIGIBLE_DENSITY_DISTANCE_SIGMA, 0.0, np.minimum(bound, 1.0))


def _speckled_pd_change(
    a: np.ndarray, b: np.ndarray, relative_power_change: np.ndarray | float
) -> np.ndarray:
    """Return the change of the probability of detection in speckle as the mean power a^2 changes.

    The probability is exp(-(b^2 / 2) / (1 + a^2 / 2)), with a the magnitude and b the threshold,
    both over the noise per quadrature. a^2 rises or falls by the fraction
    ``relative_power_change``, and the larger of the two changes is returned.
    """
    snr, squared_threshold = 0.5 * a * a, 0.5 * b * b
    less, equal, more = (
        np.exp(-squared_threshold / (1.0 + snr * factor))
        for factor in (
            np.maximum(1.0 - np.asarray(relative_power_change), 0.0),
            1.0,
            1.0 + np.asarray(relative_power_change),
        )
    )
    return np.asarray(np.maximum(more - equal, equal - less))


def _pd_change_bound_of_looks(
    n_looks: int, relative_power_change: np.ndarray | float
) -> np.ndarray:
    """Return an upper bound on the change of the detection probability of several faded looks.

    The summed power of N looks is gamma-distributed with the shape N. Its logarithm has a density
    of at most sqrt(N / (2 pi)). A loss of the fraction x, ``relative_power_change``, changes the
    logarithm by -ln(1 - x).
    """
    log_change = -np.log1p(-np.minimum(relative_power_change, 1.0 - 1e-12))
    return np.asarray(np.minimum(log_change * math.sqrt(n_looks / (2.0 * math.pi)), 1.0))


def _relative_magnitude_change(
    a: np.ndarray, relative_power_change: np.ndarray | float
) -> np.ndarray:
    """Return the change of a magnitude ``a`` as its square changes, over the larger of a and 1.

    ``a`` is a magnitude over the standard deviation of the noise per quadrature, and
    ``relative_power_change`` the relative change of a^2.
    """
    return np.asarray(0.5 * relative_power_change * np.minimum(a, 1.0))


class BinPowers(NamedTuple):
    """Powers of beamlets in one bin of m shots, and the width of the shots' echoes."""

    power: np.ndarray
    """(m, b): power that the line of each of b beamlets has in a bin of each of m shots, up to a
    factor common to the beamlets of a shot."""
    echo_width: np.ndarray
    """(m,): width [resolution cells] of a uniform echo with the standard deviation of the lines,
    plus 1. A cell is the sample rate over the number of samples in the record."""


def _bin_powers(
    shots: Shots,
    beamlet_table: BeamletTable,
    segment_index: int,
    indices: np.ndarray,
    bins: np.ndarray,
) -> BinPowers:
    """Return the powers that beamlets' lines have in one bin of each of m shots.

    Parameters
    ----------
    shots, beamlet_table
        Prepared shots, and their footprints.
    segment_index
        The segment: 0 up, 1 Doppler, 2 down.
    indices
        (m,): indices of the shots.
    bins
        (m,): bin of each shot.

    Returns
    -------
    BinPowers
    """
    segment = shots.waveform_segments[segment_index]
    columns = (
        shots.range - segment.range_decrease_since_shot_start,
        segment.doppler_ratio,
        shots.waveform.chirp_rate,
        shots.sample_rate,
        segment.carrier,
        shots.receiver_filter.detector_bandwidth,
        shots.receiver_filter.amplifier_bandwidth,
    )
    (
        axis_range,
        doppler_ratio,
        chirp_rate,
        sample_rate,
        carrier,
        detector_bandwidth,
        amplifier_bandwidth,
    ) = (np.broadcast_to(column, shots.size)[indices, None] for column in columns)
    row = beamlet_table.row_of_point[indices]
    relative_range_offset, doppler_ratio_offset = (
        beamlet_table.relative_range_offset[row],
        beamlet_table.doppler_ratio_offset[row],
    )
    # Precise to a fraction of a bin; phases would need far more, but powers have none.
    beamlet_range = axis_range * (1 + relative_range_offset)
    beat = carrier * (doppler_ratio + doppler_ratio_offset)
    beat -= (
        _CHIRP_SIGNS[segment_index]
        * chirp_rate
        * (2 / SPEED_OF_LIGHT)
        * beamlet_range
        * (1 + doppler_ratio + doppler_ratio_offset)
    )
    fft_size = shots.fft_size
    bin_position = beat * (fft_size / sample_rate)
    axis_position = carrier * doppler_ratio - _CHIRP_SIGNS[segment_index] * chirp_rate * (
        2 / SPEED_OF_LIGHT
    ) * axis_range * (1 + doppler_ratio)
    axis_position = axis_position * (fft_size / sample_rate)
    wrap_shift = np.floor(axis_position / fft_size + 0.5) * fft_size
    bin_position = (
        np.where(axis_position < wrap_shift, -1.0, 1.0) * (bin_position - wrap_shift)
        - bins[:, None]
    )
    echo = beamlet_table.relative_echo[row]
    total_echo = echo.sum(axis=1)
    mean_position = (echo * bin_position).sum(axis=1) / total_echo
    variance = (echo * np.square(bin_position - mean_position[:, None])).sum(axis=1) / total_echo
    echo_width = 1.0 + np.sqrt(12.0 * variance) * (shots.window.length / fft_size)
    bin_position = np.abs(bin_position)
    lobe = _main_lobe_table(shots.window.name)
    bin_position *= shots.window.length / fft_size * _LOBE_STEPS_PER_CELL
    table_index = np.minimum(bin_position, lobe.size - 2.0).astype(np.int64)
    table_fraction = np.minimum(bin_position - table_index, 1.0)
    power = echo * (
        lobe[table_index] + (lobe[table_index + 1] - lobe[table_index]) * table_fraction
    )
    p, q = (
        1 - beat * beat / (detector_bandwidth * amplifier_bandwidth),
        beat * (1 / detector_bandwidth + 1 / amplifier_bandwidth),
    )
    return BinPowers(np.asarray(power / (p * p + q * q)), np.asarray(echo_width))


@lru_cache(maxsize=16)
def pair_opposite_beamlets(n_beamlets: int) -> OppositeBeamletPairs:
    """Return the lattice of ``n_beamlets`` beamlets as an :class:`OppositeBeamletPairs`.

    The lattice is hexagonal, and the beamlets fill its shells completely.
    """
    from scipy.spatial import cKDTree  # slow to import

    offsets, weights = place_beamlets(n_beamlets)
    positions = offsets.T
    tree = cKDTree(positions)
    (_, nearest_distance), _ = tree.query(positions[0], 2)  # the first is the position itself
    neighbour_distance = _NEIGHBOUR_DISTANCE_RATIO * nearest_distance
    _, opposite = tree.query(-positions)
    representatives = np.flatnonzero(np.arange(n_beamlets) <= opposite)
    folded_index = np.empty(n_beamlets, np.int64)
    folded_index[representatives] = folded_index[opposite[representatives]] = np.arange(
        representatives.size
    )
    folded_weights = (
        np.where(opposite[representatives] == representatives, 1.0, 2.0) * weights[representatives]
    )
    neighbours = tree.query_pairs(neighbour_distance, output_type="ndarray")
    neighbours = neighbours[np.lexsort(neighbours.T)]  # independent of the tree's order
    first_beamlet, second_beamlet = neighbours.T
    first_folded, second_folded = np.sort(folded_index[neighbours], axis=1).T
    neighbour_keys, key_index = np.unique(
        first_folded * n_beamlets + second_folded, return_inverse=True
    )
    neighbour_weights: np.ndarray = np.bincount(
        key_index.ravel(), weights[first_beamlet] * weights[second_beamlet]
    )
    polynomials = _even_polynomials(
        offsets[:, representatives], folded_weights, 4 if n_beamlets >= _QUARTIC_RAYS_MIN else 2
    )
    neighbour_weights = neighbour_weights * (
        representatives.size / (representatives.size - len(polynomials))
    )
    relative_weight_deficit = (
        _beamlet_weight_deficit(offsets, weights)[representatives] / weights[representatives]
    )
    return OppositeBeamletPairs(
        representatives,
        opposite[representatives],
        1 / folded_weights,
        polynomials,
        folded_weights * polynomials,
        relative_weight_deficit,
        neighbour_keys // n_beamlets,
        neighbour_keys % n_beamlets,
        neighbour_weights,
    )


def _beamlet_weight_deficit(offsets: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the fraction of the beam's power about each beamlet minus the beamlet's weight.

    The result is (beamlets,). The beam is Gaussian, and the cells about the beamlets have equal
    areas. Power outside of all cells is shared by the beamlets at the largest radius, so that the
    sum of the result is 0.

    Parameters
    ----------
    offsets
        (2, beamlets): positions of the beamlets [standard deviations of the beam].
    weight
        (beamlets,): power fractions of the beamlets; they sum to 1.
    """
    squared_radius = (offsets**2).sum(axis=0)
    # Weights are exp(-r^2 / 2) at the radius r before the lattice is stretched.
    centre_index = int(np.argmin(squared_radius))
    stretch = squared_radius.max() / (-2 * np.log(weight.min() / weight[centre_index]))
    cell_factor = stretch * lattice_radius(weight.size) ** 2 / (2 * weight.size)  # over 2 pi
    cell_power = cell_factor * np.exp(-0.5 * squared_radius)
    is_outermost = squared_radius > squared_radius.max() * (1 - 1e-9)
    cell_power[is_outermost] += (1 - cell_power.sum()) / np.count_nonzero(is_outermost)
    return np.asarray(cell_power - weight)


def _even_polynomials(offsets: np.ndarray, weights: np.ndarray, degree: int) -> np.ndarray:
    """Return the values (k, h) of k even polynomials at h positions.

    The polynomials are orthonormal with ``weights``.

    Parameters
    ----------
    offsets
        (2, h): positions.
    weights
        (h,): weight of each position.
    degree
        Largest degree of the polynomials.
    """
    x, y = offsets
    powers = [(total - k, k) for total in range(0, degree + 1, 2) for k in range(total + 1)]
    root = np.sqrt(weights)
    orthogonal, _ = np.linalg.qr(np.stack([root * x**i * y**k for i, k in powers], axis=1))
    return np.ascontiguousarray(orthogonal.T / root)


@lru_cache(maxsize=32)
def _main_lobe_table(window_name: str) -> np.ndarray:
    """Return the power |W(y) / W(0)|^2 of a line at distances y = 0, 1, 2 .. steps from its centre.

    W is the transform of the window. A step is 1 / ``_LOBE_STEPS_PER_CELL`` of a resolution cell,
    which is the sample rate over the number of samples in the record. So one table serves windows
    of any length.
    """
    w = window_samples(window_name, _LINE_TABLE_WINDOW_SAMPLES)
    transform = np.abs(
        np.fft.rfft(w, _LINE_TABLE_WINDOW_SAMPLES * _LOBE_STEPS_PER_CELL)[
            : _LOBE_REACH_CELLS * _LOBE_STEPS_PER_CELL + 1
        ]
    )
    transform[-1] = 0.0  # zero beyond the table
    return np.asarray((transform / w.sum()) ** 2)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_power_errors(powers, beamlet_pairs, relative_errors):
    """Compute the relative errors of the powers of m bins that are due to too few rays per beam.

    The description of :mod:`sweep.model.pointcloud.ray_error` derives them.

    Parameters
    ----------
    powers
        (m, b): power of each beamlet's line in the bins.
    beamlet_pairs
        Lattice of the beamlets (:class:`OppositeBeamletPairs`).
    relative_errors
        (m,): output array, at most 1.
    """
    beamlet, opposite_beamlet = beamlet_pairs.beamlet, beamlet_pairs.opposite_beamlet
    inverse_weight, relative_weight_deficit = (
        beamlet_pairs.inverse_weight,
        beamlet_pairs.relative_weight_deficit,
    )
    polynomials, weighted_polynomials = (
        beamlet_pairs.polynomials,
        beamlet_pairs.weighted_polynomials,
    )
    first_neighbouring_pair, second_neighbouring_pair = (
        beamlet_pairs.first_neighbouring_pair,
        beamlet_pairs.second_neighbouring_pair,
    )
    neighbour_weight = beamlet_pairs.neighbour_weight
    residual = np.empty(beamlet.size)
    for i in range(relative_errors.size):
        total_power = bias = 0.0
        for f in range(beamlet.size):
            pair_power = powers[i, beamlet[f]]
            if opposite_beamlet[f] != beamlet[f]:
                pair_power += powers[i, opposite_beamlet[f]]
            total_power += pair_power
            bias += relative_weight_deficit[f] * pair_power
            residual[f] = pair_power * inverse_weight[f]
        for j in range(polynomials.shape[0]):  # orthonormal, so one at a time suffices
            projection = 0.0
            for f in range(beamlet.size):
                projection += weighted_polynomials[j, f] * residual[f]
            for f in range(beamlet.size):
                residual[f] -= projection * polynomials[j, f]
        roughness = 0.0
        for k in range(neighbour_weight.size):
            difference = (
                residual[first_neighbouring_pair[k]] - residual[second_neighbouring_pair[k]]
            )
            roughness += neighbour_weight[k] * difference * difference
        relative_errors[i] = (
            min((math.sqrt(roughness) + abs(bias)) / total_power, 1.0) if total_power > 0.0 else 1.0
        )
