"""Developed speckle of a footprint in draws: complex amplitudes of bins in the segments of a shot.

The footprint is a grid of lines over the two coordinates of a Gaussian beam, in its standard
deviations. A line at (y, x) has the weight a^2 of a Gaussian rule and a circular complex Gaussian
amplitude z, common to all segments of a shot. In segment s it is b_s . (y, x) bins off the middle
of the echo. Its phase is t_s . (y, x) relative to the first segment, by equation (1) of
:mod:`sweep.model.detection.speckle_correlation`. The amplitude of bin k is

    A_s,k = sum a z e^(i t_s . (y, x)) G(k - middle_s - b_s . (y, x))                            (1)

with the window's transform G. Near DC and Nyquist of a real record the conjugate amplitudes of the
lines' images are added (:mod:`sweep.model.detection.pseudo_variance`): at DC the sum is real. Sums
of Gaussian numbers are Gaussian, so bins of all segments are jointly circular Gaussian. Their
covariances are Gaussian means, which the rule integrates. So the peak bins of two segments have the
correlation mu of that module. Amplitudes are returned over their root mean squares, and callers
multiply them by the magnitudes of the noiseless spectrum.

Positions of peaks wander with speckle. If the footprint spreads over less than a bin, (1) is to
first order in b the bin of a lone tone. This tone is off the middle by

    w_s = b_s . Re(Y_s / A_s),    Y_s = sum a z e^(i t_s . (y, x)) (y, x)                        (2)

A_s and Y_s are independent, as y and x have the mean 0. Let the peak have the power q^2 in units of
its mean, noise included, and let v be the fraction of the echo in that mean. Then w_s is normal:

    var w_s = |b_s|^2 v / (2 q^2)                                                                (3)

This is the law of a ratio of two Gaussian numbers [1]; of angles in radar it is known as glint [2].
The threshold keeps q away from 0; without it w_s has no variance. :func:`wander_covariance` has the
covariance of two segments.

In footprints of half a bin and more, the search limits the position of the peak.
:func:`position_error_moments` applies such a limit if the strongest bin alone detects.

References
----------
.. [1] Goodman, Speckle Phenomena in Optics, 2007, ch. 2.
.. [2] Kanter, IEEE Trans. AES-13, 1977.
"""

import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import special

from sweep.kernel_cache import njit
from sweep.model.beamlets import gaussian_rule
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.detection.speckle_correlation import (
    TRANSFORM_REACH_BINS,
    TRANSFORM_SAMPLES_PER_BIN,
    LineGradients,
    centroid_delay,
    transform_table,
)
from sweep.model.detection.sub_bin_interpolation import (
    complex_exponentials,
    estimate_sub_bin_offset,
    interpolator,
    tone_spectrum,
)
from sweep.model.sampling import philox
from sweep.model.window import Window, window_samples

if TYPE_CHECKING:
    from sweep.model.preparation import Shots

RULE_SIZES = np.array([1, 3, 7, 15, 31, 63, 127, 255, 511])
"""Numbers of nodes of the Gaussian rules, which are the numbers of lines along one coordinate of
the beam."""

_RULE_PHASE_MAX = np.array([0.02, 0.6, 1.9, 3.8, 9.4, 23.0, 52.0, 109.0, np.inf])
"""Largest phase per standard deviation of the beam [rad] that each rule of RULE_SIZES integrates to
1e-3."""

_LINE_WEIGHT_MIN = 1e-6
"""Power fraction below which a line is omitted."""

GROUP_NUMBER_STRIDE = 1 << 24
"""Number of random numbers reserved for a group; those of group g begin at (1 + g) times this."""

LOOK_DRAW_STRIDE = np.int64(1 << 48)
"""Offset in the draw number between successive looks, which makes their random numbers distinct."""


class SpeckleLineGrid(NamedTuple):
    """Grid of speckle lines of n points, for compiled code."""

    line_shift: np.ndarray
    """(n, 3, 2): line shift per standard deviation of the beam [bins], positive towards higher
    bins."""
    phase: np.ndarray
    """(n, 3, 2): phase per standard deviation of the beam, relative to the up segment [rad]."""
    rule_index: np.ndarray
    """(n, 2) int64: index into :data:`RULE_SIZES` for each coordinate."""
    peak_search_bins: np.ndarray
    """(n,) int64: bins on either side of the strongest bin in which the peak is searched."""
    node: np.ndarray
    """(rules, nodes): nodes of the Gaussian rules [standard deviations], padded with 0."""
    weight: np.ndarray
    """(rules, nodes): weights of the Gaussian rules; those of a rule sum to 1."""
    nodes_in_rule: np.ndarray
    """(rules,) int64: number of nodes of each rule."""
    transform: np.ndarray
    """(m,): window transform G at 0, 1/steps, 2/steps .. bins."""
    samples_per_bin: float
    """Samples of ``transform`` per bin of fs/N."""
    transform_reach_bins: float
    """Distance from a line up to which bins receive its light [bins of fs/N]."""
    nyquist_bin: int
    """N/2 of a real record whose bins near DC and Nyquist contain the conjugate images of lines,
    else 0."""

    @classmethod
    def empty(cls) -> "SpeckleLineGrid":
        """Return a grid of no points."""
        no_gradients, no_indices = np.zeros((0, 3, 2)), np.zeros(0, np.int64)
        no_table = np.zeros((0, 0))
        return cls(
            no_gradients,
            no_gradients,
            np.zeros((0, 2), np.int64),
            no_indices,
            no_table,
            no_table,
            no_indices,
            np.zeros(0),
            1.0,
            0.0,
            0,
        )

    def select(self, points: np.ndarray) -> "SpeckleLineGrid":
        """Return the grid of the points with the given indices."""
        if not self.line_shift.shape[0]:
            return self
        return self._replace(
            line_shift=self.line_shift[points],
            phase=self.phase[points],
            rule_index=self.rule_index[points],
            peak_search_bins=self.peak_search_bins[points],
        )


@lru_cache(maxsize=1)
def _gaussian_rules() -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of the Gaussian rules, (rules, nodes), padded with zeros."""
    node, weight = np.zeros((2, RULE_SIZES.size, RULE_SIZES[-1]))
    for row, n_nodes in enumerate(RULE_SIZES.tolist()):
        node[row, :n_nodes], weight[row, :n_nodes] = gaussian_rule(n_nodes)
    return node, weight


def speckle_line_grid(shots: "Shots") -> SpeckleLineGrid:
    """Return the speckle lines of shots; without points if the shots have no developed speckle."""
    gradients = shots.speckle.line_gradients
    transform = transform_table(shots.window)[1]
    node, weight = _gaussian_rules()
    n_points = 0 if gradients is None else shots.size
    line_shift, phase = np.zeros((2, n_points, 3, 2)) if gradients is None else gradients
    padding_factor = shots.fft_size / shots.window.length
    line_shift, phase = _rotate_to_steepest(line_shift, phase, padding_factor)
    # The product of two bins' transforms turns by at most 2 pi for each bin of fs/L.
    phase_max = np.abs(phase[:, :, None] - phase[:, None]).max(axis=(1, 2))
    phase_max = phase_max + np.pi * np.abs(line_shift).max(axis=1) / padding_factor
    rule_index = np.searchsorted(_RULE_PHASE_MAX, phase_max)
    line_shift_max = np.sqrt((line_shift**2).sum(axis=-1)).max(axis=1)
    peak_search_bins = np.ones(n_points, np.int64)
    if shots.detection_settings.echo_bins == "any_bin":
        is_wide = line_shift_max > 0.02 * padding_factor
        peak_search_bins = np.where(is_wide, 1 + np.ceil(2.5 * line_shift_max), 1).astype(np.int64)
    return SpeckleLineGrid(
        np.ascontiguousarray(line_shift * folding_signs(shots)[..., None][:n_points]),
        np.ascontiguousarray(phase),
        rule_index.astype(np.int64),
        peak_search_bins,
        node,
        weight,
        RULE_SIZES,
        transform,
        TRANSFORM_SAMPLES_PER_BIN / padding_factor,
        TRANSFORM_REACH_BINS * padding_factor,
        shots.real_fft_size // 2,
    )


def _rotate_to_steepest(
    line_shift: np.ndarray, phase: np.ndarray, padding_factor: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rotate the beam's coordinates until shifts and phases grow most along the first.

    The beam is round, so the probability law is unchanged. Few lines are then needed along the
    second coordinate.
    """
    phase_slopes = np.concatenate(
        [phase - phase[:, :1], line_shift * (np.pi / padding_factor)], axis=1
    )
    y, x = phase_slopes[..., 0], phase_slopes[..., 1]
    angle = 0.5 * np.arctan2(2 * (y * x).sum(axis=1), (y * y - x * x).sum(axis=1))
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]

    def rotate(vectors: np.ndarray) -> np.ndarray:
        """Rotate vectors (n, 3, 2) by each point's angle."""
        first, second = vectors[..., 0], vectors[..., 1]
        return np.stack([cosine * first + sine * second, cosine * second - sine * first], axis=-1)

    return rotate(line_shift), rotate(phase)


def folding_signs(shots: "Shots") -> np.ndarray:
    """Return the sign of d(bin) / d(beat) after folding, by segment: -1 or 1, (n, 3)."""
    signs = np.ones((shots.size, 3))
    if shots.complex_record:
        return signs
    for s, segment in enumerate(shots.waveform_segments):
        delay = 2 / SPEED_OF_LIGHT * (shots.range - segment.range_decrease)
        beat = segment.carrier * segment.doppler_ratio - segment.chirp_rate * delay * (
            1 + segment.doppler_ratio
        )
        cycles_per_sample = beat / shots.sample_rate
        signs[:, s] = np.where(cycles_per_sample - np.floor(cycles_per_sample + 0.5) < 0, -1.0, 1.0)
    return signs


@njit(cache=True, error_model="numpy", borrows=True)
def interpolate_transform(distance, grid):
    """Interpolate the window transform G at a distance from the line [bins of fs/N]."""
    table_position = abs(distance) * grid.samples_per_bin
    k = int(table_position)
    if k >= grid.transform.size - 1:
        return 0.0
    return grid.transform[k] + (table_position - k) * (grid.transform[k + 1] - grid.transform[k])


@njit(cache=True, error_model="numpy")
def nearest_image_position(position, nyquist_bin):
    """Return the position [bins] of the nearest image of a line, about DC or Nyquist."""
    return -position if position < 0.5 * nyquist_bin else 2.0 * nyquist_bin - position


@njit(cache=True, error_model="numpy", borrows=True)
def mean_bin_powers(grid, point, echo_centre, first_bin, mean_power, pseudo_variance):
    """Compute mean powers of bins by lines of total power 1, and return True if there are images.

    Parameters
    ----------
    grid, point
        Speckle lines (:class:`SpeckleLineGrid`), and the index of the point.
    echo_centre
        (3,): middle of the echo in each segment [bins]; nan for a segment without an echo.
    first_bin
        (3,): first of the bins in each segment.
    mean_power
        (3, bins): set to the mean powers.
    pseudo_variance
        (3, bins): set to the pseudo-variances over the mean powers, which images of lines cause
        near DC and Nyquist (:mod:`sweep.model.detection.pseudo_variance`).
    """
    mean_power[:] = 0.0
    pseudo_variance[:] = 0.0
    has_images = False
    rule_first, rule_second = grid.rule_index[point]
    for s in range(3):
        if np.isnan(echo_centre[s]):
            continue
        for a in range(grid.nodes_in_rule[rule_first]):
            for c in range(grid.nodes_in_rule[rule_second]):
                weight = grid.weight[rule_first, a] * grid.weight[rule_second, c]
                if weight < _LINE_WEIGHT_MIN:
                    continue
                position = echo_centre[s] + grid.line_shift[point, s, 0] * grid.node[rule_first, a]
                position += grid.line_shift[point, s, 1] * grid.node[rule_second, c] - first_bin[s]
                begin = max(0, math.ceil(position - grid.transform_reach_bins))
                for k in range(
                    begin,
                    min(mean_power.shape[1], math.floor(position + grid.transform_reach_bins) + 1),
                ):
                    transform_value = interpolate_transform(k - position, grid)
                    mean_power[s, k] += weight * transform_value * transform_value
                if grid.nyquist_bin == 0:
                    continue
                image_position = (
                    nearest_image_position(position + first_bin[s], grid.nyquist_bin) - first_bin[s]
                )
                begin = max(0, math.ceil(image_position - grid.transform_reach_bins))
                for k in range(
                    begin,
                    min(
                        mean_power.shape[1],
                        math.floor(image_position + grid.transform_reach_bins) + 1,
                    ),
                ):
                    transform_value = interpolate_transform(k - image_position, grid)
                    mean_power[s, k] += weight * transform_value * transform_value
                    pseudo_variance[s, k] += (
                        2.0 * weight * transform_value * interpolate_transform(k - position, grid)
                    )
                    has_images = True
        for k in range(mean_power.shape[1]):
            pseudo_variance[s, k] /= max(mean_power[s, k], 1e-300)
    return has_images


@njit(cache=True, error_model="numpy", borrows=True)
def draw_bin_amplitudes(
    address, group, grid, point, echo_centre, first_bin, mean_power, amplitudes
):
    """Draw complex speckle amplitudes of bins, of mean power 1, into ``amplitudes`` (3, bins).

    Amplitudes are those of the transform about the record's middle.

    Parameters
    ----------
    address
        Key of the point (two uint64) and number of the draw.
    group
        Number of the echo; each echo has its own random numbers.
    grid, point
        Speckle lines (:class:`SpeckleLineGrid`), and the index of the point.
    echo_centre, first_bin
        Middle of the echo and first bin, as in :func:`mean_bin_powers`.
    mean_power
        (3, bins): result of :func:`mean_bin_powers` for the same bins.
    amplitudes
        (3, bins) complex; the result.

    Notes
    -----
    Amplitudes are equation (1) of the module over the root of ``mean_power``. All segments have the
    same amplitudes z. Bins that no line reaches are 0.
    """
    amplitudes[:] = 0.0
    rule_first, rule_second = grid.rule_index[point]
    quadrature_deviation, random_number = math.sqrt(0.5), GROUP_NUMBER_STRIDE * (1 + group)
    for a in range(grid.nodes_in_rule[rule_first]):
        for c in range(grid.nodes_in_rule[rule_second]):
            weight = grid.weight[rule_first, a] * grid.weight[rule_second, c]
            if weight < _LINE_WEIGHT_MIN:
                continue
            re, im = philox.normal_pair(
                address[0], address[1], address[2], philox.STREAM_SPECKLE, random_number
            )
            random_number += 1
            line_amplitude = complex(re, im) * (quadrature_deviation * math.sqrt(weight))
            y, x = grid.node[rule_first, a], grid.node[rule_second, c]
            for s in range(3):
                if np.isnan(echo_centre[s]):
                    continue
                phase = grid.phase[point, s, 0] * y + grid.phase[point, s, 1] * x
                phased_amplitude = line_amplitude
                if phase != 0.0:
                    phased_amplitude = line_amplitude * complex(math.cos(phase), math.sin(phase))
                position = (
                    echo_centre[s]
                    + grid.line_shift[point, s, 0] * y
                    + grid.line_shift[point, s, 1] * x
                    - first_bin[s]
                )
                begin = max(0, math.ceil(position - grid.transform_reach_bins))
                for k in range(
                    begin,
                    min(amplitudes.shape[1], math.floor(position + grid.transform_reach_bins) + 1),
                ):
                    amplitudes[s, k] += phased_amplitude * interpolate_transform(k - position, grid)
                if grid.nyquist_bin == 0:
                    continue
                image_position = (
                    nearest_image_position(position + first_bin[s], grid.nyquist_bin) - first_bin[s]
                )
                begin = max(0, math.ceil(image_position - grid.transform_reach_bins))
                for k in range(
                    begin,
                    min(
                        amplitudes.shape[1],
                        math.floor(image_position + grid.transform_reach_bins) + 1,
                    ),
                ):
                    amplitudes[s, k] += phased_amplitude.conjugate() * interpolate_transform(
                        k - image_position, grid
                    )
    for s in range(3):
        for k in range(amplitudes.shape[1]):
            if mean_power[s, k] > 0.0:
                amplitudes[s, k] /= math.sqrt(mean_power[s, k])


FACTORED_BINS_MAX = 48
"""Largest number of bins, over all segments, whose covariance is factored. For more bins, lines are
drawn."""

_RESIDUAL_POWER_MAX = 1e-8
"""Fraction of a bin's mean power that a factor may omit."""


@njit(cache=True, error_model="numpy")
def factor_bin_covariance(grid, point, echo_centre, first_bin, mean_power, factor):
    """Factor the covariance of the bins of :func:`draw_bin_amplitudes`, and return its rank.

    Parameters
    ----------
    grid, point
        Speckle lines (:class:`SpeckleLineGrid`), and the index of the point.
    echo_centre, first_bin, mean_power
        Middle of the echo, first bin and mean powers, as in :func:`draw_bin_amplitudes`.
    factor
        (rows, 3, bins) complex, with one row for each bin of all segments; the result. The
        amplitudes of the bins are sums of its first rows, up to the rank, times independent
        circular Gaussian numbers of mean power 2.

    Notes
    -----
    Lines that are close together make nearly equal amplitudes. For a footprint within a bin, two or
    three random numbers determine the amplitudes of nine bins. The factor follows from Cholesky's
    factorisation with pivots, until no bin lacks more than 1e-8 of its mean power.
    """
    rule_first, rule_second = grid.rule_index[point]
    n_segments, n_bins = mean_power.shape
    line_weights = np.empty(grid.nodes_in_rule[rule_first] * grid.nodes_in_rule[rule_second])
    line_amplitudes = np.zeros((n_segments, n_bins, line_weights.size), np.complex128)
    n_lines = 0
    for a in range(grid.nodes_in_rule[rule_first]):
        for c in range(grid.nodes_in_rule[rule_second]):
            line_weight = grid.weight[rule_first, a] * grid.weight[rule_second, c]
            if line_weight < _LINE_WEIGHT_MIN:
                continue
            y, x = grid.node[rule_first, a], grid.node[rule_second, c]
            for s in range(n_segments):
                if np.isnan(echo_centre[s]):
                    continue
                phase = grid.phase[point, s, 0] * y + grid.phase[point, s, 1] * x
                phased_amplitude = complex(math.sqrt(line_weight), 0.0)
                if phase != 0.0:
                    phased_amplitude = phased_amplitude.real * complex(
                        math.cos(phase), math.sin(phase)
                    )
                position = (
                    echo_centre[s]
                    + grid.line_shift[point, s, 0] * y
                    + grid.line_shift[point, s, 1] * x
                    - first_bin[s]
                )
                for k in range(n_bins):
                    if mean_power[s, k] > 0.0 and abs(k - position) <= grid.transform_reach_bins:
                        transform_value = interpolate_transform(k - position, grid) / math.sqrt(
                            mean_power[s, k]
                        )
                        line_amplitudes[s, k, n_lines] = phased_amplitude * transform_value
            n_lines += 1
    residual = np.where(mean_power > 0.0, 1.0, 0.0)
    for rank in range(factor.shape[0]):
        pivot, residual_max = (0, 0), _RESIDUAL_POWER_MAX
        for s in range(n_segments):
            for k in range(n_bins):
                if residual[s, k] > residual_max:
                    pivot, residual_max = (s, k), residual[s, k]
        if residual_max == _RESIDUAL_POWER_MAX:
            return rank
        pivot_amplitudes, scale = line_amplitudes[pivot[0], pivot[1]], 1.0 / math.sqrt(residual_max)
        for s in range(n_segments):
            for k in range(n_bins):
                if not residual[s, k] > 0.0:
                    factor[rank, s, k] = 0.0
                    continue
                covariance = complex(0.0, 0.0)
                for line in range(n_lines):
                    covariance += line_amplitudes[s, k, line] * pivot_amplitudes[line].conjugate()
                for r in range(rank):
                    covariance -= factor[r, s, k] * factor[r, pivot[0], pivot[1]].conjugate() * 2.0
                factor[rank, s, k] = covariance * (scale * math.sqrt(0.5))
        for s in range(n_segments):
            for k in range(n_bins):
                residual[s, k] -= 2.0 * abs(factor[rank, s, k]) ** 2
        residual[pivot] = 0.0
    return factor.shape[0]


@njit(cache=True, error_model="numpy", borrows=True)
def draw_factored_amplitudes(address, group, factor, rank, amplitudes):
    """Draw amplitudes of bins into ``amplitudes`` (3, bins) from a factor of their covariance.

    ``factor`` and ``rank`` are the results of :func:`factor_bin_covariance`. ``address`` and
    ``group`` are as in :func:`draw_bin_amplitudes`.
    """
    amplitudes[:] = 0.0
    first_number = GROUP_NUMBER_STRIDE * (1 + group)
    for pair in range(0, rank, 2):
        words = philox.four_words(
            address[0], address[1], address[2], philox.STREAM_SPECKLE, (first_number + pair) >> 1
        )
        first_of_pair = complex(*philox.to_normals(words[0], words[1]))
        if pair + 1 == rank:
            for s in range(amplitudes.shape[0]):
                for k in range(amplitudes.shape[1]):
                    amplitudes[s, k] += first_of_pair * factor[pair, s, k]
            return
        second_of_pair = complex(*philox.to_normals(words[2], words[3]))
        for s in range(amplitudes.shape[0]):
            for k in range(amplitudes.shape[1]):
                amplitudes[s, k] = (
                    amplitudes[s, k] + first_of_pair * factor[pair, s, k]
                ) + second_of_pair * factor[pair + 1, s, k]


def draw_segment_amplitudes(
    grid: SpeckleLineGrid,
    point: int,
    echo_centre: np.ndarray,
    first_and_count: tuple[int, int],
    *,
    key: np.ndarray,
    draws: np.ndarray,
    group: int = 0,
) -> np.ndarray:
    """Draw speckle amplitudes of mean power 1 in adjacent bins of one segment of a point.

    Parameters
    ----------
    grid, point
        Speckle lines (:class:`SpeckleLineGrid`), and the index of the point.
    echo_centre
        (3,): middle of the echo in the segment that is drawn [bins], nan in the other two.
    first_and_count
        First bin, and number of bins.
    key
        (2,) uint64: random key of the point.
    draws
        (m,) int64: numbers of the draws.
    group
        Number of the echo.

    Returns
    -------
    numpy.ndarray
        (m, bins) complex.
    """
    (segment,) = np.flatnonzero(np.isfinite(echo_centre))
    first_bin = np.full(3, first_and_count[0])
    mean_power = np.empty((3, first_and_count[1]))
    mean_bin_powers(
        grid, point, echo_centre, first_bin, mean_power, np.empty((3, first_and_count[1]))
    )
    bin_amplitudes = np.zeros((3, first_and_count[1]), complex)
    drawn_amplitudes = np.empty((draws.size, first_and_count[1]), complex)
    for row, draw in enumerate(draws):
        draw_bin_amplitudes(
            (key[0], key[1], draw),
            group,
            grid,
            point,
            echo_centre,
            first_bin,
            mean_power,
            bin_amplitudes,
        )
        drawn_amplitudes[row] = bin_amplitudes[segment]
    return drawn_amplitudes


RECORD_LINE_DEVIATION_MAX_BINS = 1.0
"""Largest standard deviation of a footprint's lines [bins of fs/L] for which
:class:`FootprintRecord` is used."""


class FootprintRecord(NamedTuple):
    """Windowed record of a footprint's speckle lines: a lone tone at their middle times a series.

    The series is the sum over lines of ``a z e^(i t . (y, x)) e^(2 pi i b . (y, x) (n - middle) /
    N)``, in Chebyshev polynomials of the sample number n.
    """

    series_coefficients: np.ndarray
    """(lines, k) complex: coefficients of the series by line, for an amplitude z of 1."""
    series_positions: np.ndarray
    """(L,): argument of the series at each sample, -1..1 over the samples that contain the echo."""
    windowed_tone: np.ndarray
    """(L,) complex: windowed record of the lone tone, of amplitude 1."""
    mean_bin_power: np.ndarray
    """(N,): mean power of the transform of the record by bin."""

    @classmethod
    def from_line_grid(
        cls,
        line_grid: SpeckleLineGrid,
        point: int,
        segment: int,
        tone_position: float,
        window: Window,
        first_sample: int,
        fft_size: int,
    ) -> "FootprintRecord":
        """Prepare the record of a point in a segment.

        Parameters
        ----------
        line_grid, point
            Speckle lines, and the index of the point.
        segment
            0 up, 1 Doppler, 2 down.
        tone_position
            Frequency of the lone tone [bins].
        window, first_sample
            Window of the record, and the number of samples before the echo.
        fft_size
            FFT size N.

        Notes
        -----
        The mean powers of the bins are the transform of a product over lags. Its factors are the
        window's autocorrelation and the mean phasor of the lines.
        """
        line_offsets, line_phases, line_weights = _line_offsets_phases_and_weights(
            line_grid, point, segment
        )
        length = window.length
        half_length = max(0.5 * (length - 1 - first_sample), 0.5)
        radians_per_sample = 2 * np.pi * line_offsets / fft_size
        record_middle = 0.5 * length + float(centroid_delay(window)[first_sample])
        series_nodes, series_matrix = _chebyshev_nodes_and_matrix(
            _chebyshev_degree(np.abs(radians_per_sample).max() * half_length)
        )
        series_coefficients = np.exp(
            1j
            * (
                line_phases[:, None]
                + radians_per_sample[:, None]
                * (first_sample + half_length * (1 + series_nodes) - record_middle)
            )
        )
        series_coefficients = np.sqrt(0.5 * line_weights)[:, None] * series_coefficients
        # Sums in place of matrix products, whose order depends on the number of threads.
        series_coefficients = (series_coefficients[:, None] * series_matrix).sum(axis=2)
        windowed_tone = window_samples(window.name, length) * complex_exponentials(
            -tone_position / fft_size, length
        )
        windowed_tone[:first_sample] = 0.0
        series_nodes, series_matrix = _chebyshev_nodes_and_matrix(
            _chebyshev_degree(np.abs(radians_per_sample).max() * length)
        )
        mean_phasor = (
            line_weights[:, None]
            * np.exp(0.5j * radians_per_sample[:, None] * length * (1 + series_nodes))
        ).sum(axis=0)
        lag_products, lags = np.zeros(fft_size, complex), np.arange(length)
        lag_products[:length] = _window_autocorrelation(
            window, first_sample
        ) * complex_exponentials(-tone_position / fft_size, length)
        _multiply_by_chebyshev_series(
            (mean_phasor * series_matrix).sum(axis=1), 2 * lags / length - 1, lag_products
        )
        lag_products[0] *= 0.5
        mean_bin_power = 2 * np.fft.fft(lag_products).real
        mean_bin_power = np.maximum(mean_bin_power, _RELATIVE_POWER_MIN * mean_bin_power.max())
        return cls(
            series_coefficients,
            (lags - first_sample) / half_length - 1,
            windowed_tone,
            mean_bin_power,
        )

    def draw_record(self, key: np.ndarray, draw_number: int, group: int) -> np.ndarray:
        """Draw the record (L,) of a group's speckle.

        It uses the same random numbers as :func:`draw_bin_amplitudes`.
        """
        line_amplitudes = np.empty(len(self.series_coefficients), complex)
        _draw_line_amplitudes(
            (key[0], key[1], np.int64(draw_number)),
            GROUP_NUMBER_STRIDE * (1 + group),
            line_amplitudes,
        )
        record = self.windowed_tone.copy()
        _multiply_by_chebyshev_series(
            (line_amplitudes[:, None] * self.series_coefficients).sum(axis=0),
            self.series_positions,
            record,
        )
        return record


_RELATIVE_POWER_MIN = 1e-14
"""Mean power of a bin, over the largest, below which float64 does not resolve it."""


def _line_offsets_phases_and_weights(
    line_grid: SpeckleLineGrid, point: int, segment: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return offsets [bins], phases [rad] and weights of lines, (lines,) each.

    The order is that of :func:`draw_bin_amplitudes`.
    """
    rule_first, rule_second = line_grid.rule_index[point]
    y, x = (
        line_grid.node[rule_index, : line_grid.nodes_in_rule[rule_index]]
        for rule_index in (rule_first, rule_second)
    )
    line_weights = (
        line_grid.weight[rule_first, : y.size, None] * line_grid.weight[rule_second, : x.size]
    )
    offsets_and_phases = [
        gradients[point, segment, 0] * y[:, None] + gradients[point, segment, 1] * x
        for gradients in line_grid[:2]
    ]
    is_used = line_weights >= _LINE_WEIGHT_MIN
    return offsets_and_phases[0][is_used], offsets_and_phases[1][is_used], line_weights[is_used]


@njit(cache=True, error_model="numpy")
def _draw_line_amplitudes(address, first_number, amplitudes):
    """Draw circular complex Gaussian numbers of mean power 2 from the stream of speckle."""
    for k in range(amplitudes.size):
        re, im = philox.normal_pair(
            address[0], address[1], address[2], philox.STREAM_SPECKLE, first_number + k
        )
        amplitudes[k] = complex(re, im)


def _chebyshev_degree(phase_max: float) -> int:
    """Return the degree at which a Chebyshev series of exp(i x), |x| <= phase, errs by 1e-7."""
    return 9 + math.ceil(1.5 * phase_max)


@lru_cache(maxsize=64)
def _chebyshev_nodes_and_matrix(n_coefficients: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes (k,) of a Chebyshev series, and the matrix (k, k) that fits one.

    The matrix times values at the nodes gives the coefficients.
    """
    node_angles = np.pi * (np.arange(n_coefficients) + 0.5) / n_coefficients
    series_matrix = np.cos(np.arange(n_coefficients)[:, None] * node_angles) * (
        2.0 / n_coefficients
    )
    series_matrix[0] *= 0.5
    return np.cos(node_angles), series_matrix


_SAMPLES_PER_BATCH = 128
"""Number of samples at which a series is evaluated together, in vector registers."""


@njit(cache=True, error_model="numpy")
def _multiply_by_chebyshev_series(coefficients, positions, values):
    """Multiply values in place by a Chebyshev series at positions -1..1 (Clenshaw's algorithm)."""
    b1_re, b1_im = np.empty(_SAMPLES_PER_BATCH), np.empty(_SAMPLES_PER_BATCH)
    b2_re, b2_im = np.empty(_SAMPLES_PER_BATCH), np.empty(_SAMPLES_PER_BATCH)
    twice_positions = np.empty(_SAMPLES_PER_BATCH)
    for batch_begin in range(0, positions.size, _SAMPLES_PER_BATCH):
        n_samples = min(_SAMPLES_PER_BATCH, positions.size - batch_begin)
        for n in range(n_samples):
            twice_positions[n] = 2.0 * positions[batch_begin + n]
            b1_re[n] = b1_im[n] = b2_re[n] = b2_im[n] = 0.0
        for k in range(coefficients.size - 1, 0, -1):
            re, im = coefficients[k].real, coefficients[k].imag
            for n in range(n_samples):
                b0 = re + twice_positions[n] * b1_re[n] - b2_re[n]
                b2_re[n], b1_re[n] = b1_re[n], b0
            for n in range(n_samples):
                b0 = im + twice_positions[n] * b1_im[n] - b2_im[n]
                b2_im[n], b1_im[n] = b1_im[n], b0
        for n in range(n_samples):
            re = coefficients[0].real + 0.5 * twice_positions[n] * b1_re[n] - b2_re[n]
            im = coefficients[0].imag + 0.5 * twice_positions[n] * b1_im[n] - b2_im[n]
            values[batch_begin + n] *= complex(re, im)


@lru_cache(maxsize=16)
def _window_autocorrelation(window: Window, first_sample: int) -> np.ndarray:
    """Return the autocorrelation (L,) of a window without its first samples, by lag."""
    window_values = window_samples(window.name, window.length).copy()
    window_values[:first_sample] = 0.0
    spectrum = np.fft.rfft(window_values, 2 * window_values.size)
    return np.asarray(
        np.fft.irfft(np.abs(spectrum) ** 2, 2 * window_values.size)[: window_values.size]
    )


def wander_covariance(
    gradients: LineGradients,
    pair: tuple[int, int],
    relative_power: np.ndarray,
    echo_fraction: np.ndarray,
) -> np.ndarray:
    """Return the covariance [bins^2] of the positions of two segments' peaks by speckle, (m,).

    Parameters
    ----------
    gradients
        Gradients of the lines of the footprints of the m peaks.
    pair
        Numbers of the two segments.
    relative_power
        (2, m): power q^2 of the two peaks in units of its mean, noise included.
    echo_fraction
        (2, m): fraction v of the echo in that mean.

    Returns
    -------
    numpy.ndarray
        (m,), signed as the beats.

    Notes
    -----
    Let t be the difference of the two phase gradients. The correlation of the amplitudes A_1 and
    A_2 is rho = exp(-t.t / 2) (v_1 v_2)^(1/2). The means of Y_1 and Y_2 given both amplitudes are

        E[Y_1] = -i t rho k (A_2 - rho A_1),   E[Y_2] = i t rho k (A_1 - rho A_2),
        k = 1 / (1 - rho^2),

    and the remainders have the covariance rho (1 - k t t'). An instrument knows the magnitudes of
    the amplitudes. Given these, their phases differ by an angle of von Mises' distribution with the
    concentration K = 2 k rho q_1 q_2. The mean of its cosine is I_1(K) / I_0(K), and that of its
    squared sine I_1(K) / (K I_0(K)). Hence the covariance is

        (b_1.t) (b_2.t) (rho k)^2 E[sin^2] + rho (b_1.b_2 - k (b_1.t) (b_2.t)) E[cos] / (2 q_1 q_2).
    """
    first, second = pair
    shift_first, shift_second = gradients.line_shift[:, first], gradients.line_shift[:, second]
    phase_difference = gradients.phase[:, second] - gradients.phase[:, first]
    squared_phase = (phase_difference * phase_difference).sum(axis=-1)
    rho = np.exp(-0.5 * squared_phase) * np.sqrt(echo_fraction[0] * echo_fraction[1])
    remainder = np.maximum(1 - rho * rho, 1e-12)
    magnitude_product = np.sqrt(relative_power[0] * relative_power[1])
    # Beyond these limits the ratio equals its limits to float64.
    concentration = np.clip(2 * rho * magnitude_product / remainder, 1e-12, 1e7)
    mean_cosine = special.i1e(concentration) / special.i0e(concentration)
    phase_term = (
        (shift_first * phase_difference).sum(axis=-1)
        * (shift_second * phase_difference).sum(axis=-1)
        / remainder
    )
    shift_term = (shift_first * shift_second).sum(axis=-1) - phase_term
    mean_squared_sine = mean_cosine / np.maximum(2 * rho * magnitude_product / remainder, 1e-12)
    return np.asarray(
        phase_term * rho * rho / remainder * mean_squared_sine
        + rho * shift_term * mean_cosine / (2 * magnitude_product)
    )


class SpecklePeaks(NamedTuple):
    """Detected peaks of m echoes in developed speckle, (m, 3) by segment; nan for none."""

    offset: np.ndarray
    """Interpolated position, relative to the bin about which it was estimated [bins]."""
    folding_sign: np.ndarray
    """-1 if the segment's bin falls as its beat rises (:func:`folding_signs`), else 1."""
    relative_power: np.ndarray
    """Power q^2 of the peak bin over its mean, echo and noise."""
    echo_fraction: np.ndarray
    """Fraction v of the echo in the mean power of the peak bin, 0..1."""


WANDER_MAX_BINS = 1.5
"""Bound on the wander of a peak [bins] if only the strongest bin is tested (``peak_bin``)."""


SEGMENT_PAIRS_AND_SELF = (0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)
"""All pairs of segments (0 up, 1 Doppler, 2 down), including each segment with itself."""
CHIRP_PAIRS = (0, 0), (0, 2), (2, 2)
"""Pairs of the up and down segment alone, including each segment with itself."""


def position_error_moments(
    gradients: LineGradients,
    peaks: SpecklePeaks,
    shots: "Shots",
    pairs: tuple[tuple[int, int], ...] = SEGMENT_PAIRS_AND_SELF,
) -> np.ndarray:
    """Return second moments E[e_i e_j] [bins^2] of the errors of peak positions by speckle.

    Parameters
    ----------
    gradients
        Gradients of the lines of the m echoes (:class:`LineGradients`).
    peaks
        Peaks of the m echoes, (m, 3).
    shots
        Prepared shots, for window, FFT size, rule of detection and looks.
    pairs
        Pairs of segments (i, j) that are computed.

    Returns
    -------
    numpy.ndarray
        (m, 3, 3) by segment, signed as the beats; 0 for pairs without both peaks, or not in
        `pairs`.

    Notes
    -----
    An error is the sum of two parts: the wander, by equation (3) and :func:`wander_covariance`, and
    the error by the shape of the peak (:class:`PeakShapeErrors`). Re V has the mean b^2 and the
    variance b^4 (v / q^2 + v^2 / q^4), with the peak's power q^2 and its echo fraction v. If only
    the strongest bin is tested, the wander's deviation is divided by sqrt(1 + variance /
    WANDER_MAX_BINS^2). The mean over L looks of independent speckle has 1 / L of the variance.
    """
    squared_shift = (gradients.line_shift**2).sum(axis=-1)
    has_peak = np.isfinite(peaks.relative_power) & np.isfinite(peaks.offset)
    relative_power = np.where(has_peak, np.maximum(peaks.relative_power, 1e-12), 1.0)
    echo_fraction = np.where(has_peak, peaks.echo_fraction, 0.0)
    variance = squared_shift * echo_fraction / (2 * relative_power)
    shape_errors = PeakShapeErrors.from_offset(
        np.where(has_peak, peaks.offset, 0.0), variance, shots
    )
    shape_error = (
        peaks.folding_sign * shape_errors.error_per_variance * squared_shift * (echo_fraction > 0)
    )
    mean_error = peaks.folding_sign * shape_errors.imaginary_shift_error + shape_error
    shape_deviation = (
        np.sqrt((echo_fraction / relative_power) * (1 + echo_fraction / relative_power))
        * shape_error
    )
    wander_factor = np.ones(variance.shape)
    if shots.detection_settings.echo_bins == "peak_bin":
        wander_factor = 1 / np.sqrt(1 + variance / WANDER_MAX_BINS**2)
    n_looks = (
        shots.looks.number
        if shots.looks.is_noncoherent and shots.looks.has_independent_speckle
        else 1
    )
    moments = np.zeros((*relative_power.shape, 3))
    for first, second in pairs:
        both_exist = has_peak[:, first] & has_peak[:, second]
        if first == second:
            moment, amplitude_correlation = variance[:, first], 1.0
        else:
            pair = [first, second]
            moment = wander_covariance(
                gradients, (first, second), relative_power[:, pair].T, echo_fraction[:, pair].T
            )
            phase_difference = gradients.phase[:, second] - gradients.phase[:, first]
            amplitude_correlation = np.exp(
                -0.5 * (phase_difference * phase_difference).sum(axis=-1)
            )
        moment = (
            moment + shape_deviation[:, first] * shape_deviation[:, second] * amplitude_correlation
        )
        moment = moment * wander_factor[:, first] * wander_factor[:, second] / n_looks
        moment = np.where(both_exist, moment + mean_error[:, first] * mean_error[:, second], 0.0)
        moments[:, first, second] = moments[:, second, first] = moment
    return moments


_TEST_DISPLACEMENT_BINS = 0.05
"""Displacement for numerical derivatives [bins]: the imaginary shift, and the root of the variance.
"""


class PeakShapeErrors(NamedTuple):
    """Position errors of peaks deformed by speckle, to second order in the lines' spread."""

    imaginary_shift_error: np.ndarray
    """Error [bins] by the imaginary part of the tone's complex shift, for the given variance."""
    error_per_variance: np.ndarray
    """Error [bins] per bin^2 of Re V, with the complex variance V of the lines."""

    @classmethod
    def from_offset(
        cls, offset: np.ndarray, variance: np.ndarray, shots: "Shots"
    ) -> "PeakShapeErrors":
        """Return the errors of tones ``offset`` [bins] from the strongest bin.

        Notes
        -----
        To second order in the spread b the bin at x is A (G - s G' + (V + s^2) G'' / 2). The real
        and imaginary part of the complex shift s each have the ``variance`` [bins^2], and

            V = sum a z b^2 y^2 / A - s^2.

        The real part of s is the wander. Im s and V make the magnitudes of three bins differ from
        those of any tone. The error of the estimate is proportional to (Im s)^2 and to Re V.
        """
        positions, error_per_square_shift, error_per_variance = _shape_error_table(
            shots.window, shots.fft_size
        )
        sign, distance = np.sign(offset), np.abs(offset)
        return cls(
            sign * np.interp(distance, positions, error_per_square_shift) * variance,
            sign * np.interp(distance, positions, error_per_variance),
        )


@lru_cache(maxsize=16)
def _shape_error_table(window: Window, fft_size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tabulate positions 0..1 [bins], error / (Im s)^2 [1/bins] and error / Re V [1/bins]."""
    interpolation, tone = interpolator(window, fft_size), tone_spectrum(window, fft_size)
    positions = np.linspace(0.0, 1.0, 65)
    bins = np.array([[-1.0], [0.0], [1.0]]) - positions
    shifted_tones, broadened_tones = (
        tone(bins - 1j * _TEST_DISPLACEMENT_BINS),
        0.5 * (tone(bins + _TEST_DISPLACEMENT_BINS) + tone(bins - _TEST_DISPLACEMENT_BINS)),
    )
    errors = [
        (
            np.array(
                [
                    estimate_sub_bin_offset(*magnitudes, interpolation)
                    for magnitudes in np.abs(values).T
                ]
            )
            - positions
        )
        / _TEST_DISPLACEMENT_BINS**2
        for values in (shifted_tones, broadened_tones)
    ]
    return positions, errors[0], errors[1]
