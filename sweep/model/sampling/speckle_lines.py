"""Developed speckle in draws: random complex amplitudes of the bins of an echo, in all segments.

The footprint is represented by a grid of lines over the two coordinates y and x of a Gaussian beam,
in its standard deviations. The line at (y, x) has the weight a^2 of a Gaussian quadrature, and a
circular complex Gaussian amplitude z, common to all segments of a shot. In segment s it is b_s .
(y, x) bins off the middle of the echo. Its phase is t_s . (y, x) relative to the first segment, by
equation (1) of :mod:`sweep.model.detection.speckle_correlation`. The amplitude of bin k is

    A_s,k = sum a z e^(i t_s . (y, x)) G(k - middle_s - b_s . (y, x))                            (1)

with the window's transform G. Near DC and Nyquist of a real record the conjugate amplitudes of the
lines' images are added (:mod:`sweep.model.detection.pseudo_variance`): at DC the sum is real. Sums
of Gaussian numbers are Gaussian, so bins of all segments are jointly circular Gaussian. Their
covariances are means over the beam, which the quadrature computes. So the peak bins of two segments
have the correlation mu of that module. Amplitudes are returned over their root mean squares, and
callers multiply them by the magnitudes of the noiseless spectrum.

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
from sweep.model.beamlets import normal_distribution_quadrature
from sweep.model.detection.speckle_correlation import (
    TRANSFORM_REACH_CELLS,
    TRANSFORM_SAMPLES_PER_CELL,
    LineGradients,
    late_echo_centroid_shift,
    window_transform_table,
)
from sweep.model.detection.sub_bin_interpolation import (
    complex_exponentials,
)
from sweep.model.sampling import philox
from sweep.model.sampling.peak_shape_errors import (
    PeakShapeErrors,
    TwoBinErrors,
    uses_two_bin_estimator,
)
from sweep.model.window import Window, window_samples

if TYPE_CHECKING:
    from sweep.model.preparation import Shots

QUADRATURE_NODE_COUNTS = np.array([1, 3, 7, 15, 31, 63, 127, 255, 511])
"""Numbers of nodes that a Gaussian quadrature may have. The nodes are lines that represent a
footprint along one coordinate of the beam."""

_QUADRATURE_PHASE_SLOPE_MAX = np.array([0.02, 0.6, 1.9, 3.8, 9.4, 23.0, 52.0, 109.0, np.inf])
"""Largest slope of a phase [rad per standard deviation of the beam] for which a Gaussian quadrature
errs by at most 1e-3, for each number of nodes in QUADRATURE_NODE_COUNTS."""

_LINE_WEIGHT_MIN = 1e-6
"""Fraction of the beam's power below which a line of the footprint is omitted."""

ECHO_RANDOM_INDEX_STRIDE = 1 << 24
"""Number of indices of random numbers reserved for each echo. The indices of echo g (0, 1, ..)
begin at (1 + g) times this number."""

LOOK_DRAW_STRIDE = np.int64(1 << 48)
"""Difference of the draw numbers used for successive looks (records of a segment) of one draw, so
that looks have different random numbers."""

_FIRST, _SECOND = 0, 1
"""Indices of the beam's two coordinates, y and x, as rotated by :func:`_rotate_to_steepest`."""


class SpeckleLineGrid(NamedTuple):
    """Lines that represent the footprints of n points in developed speckle, for compiled code.

    Arrays by segment have the rows 0 up, 1 Doppler, 2 down. Arrays by coordinate have the columns y
    and x of the beam.
    """

    line_shift_gradient: np.ndarray
    """(n, 3, 2): derivative of a line's frequency [bins] with respect to its distance from the
    beam's axis [standard deviations of the beam]. Axes are point, segment and coordinate of the
    beam; positive values are towards higher bins."""
    phase_gradient: np.ndarray
    """(n, 3, 2): derivative of the phase of a line's amplitude [rad] with respect to its distance
    from the beam's axis [standard deviations of the beam]. Axes are point, segment and coordinate
    of the beam. Phases are relative to the up segment."""
    quadrature_index: np.ndarray
    """(n, 2) int64: index, in :data:`QUADRATURE_NODE_COUNTS`, of the Gaussian quadrature along each
    coordinate of the beam."""
    peak_search_half_width: np.ndarray
    """(n,) int64: number of bins on either side of the strongest noiseless bin among which the peak
    of a draw is searched."""
    node: np.ndarray
    """(quadratures, nodes): nodes of each Gaussian quadrature [standard deviations of the beam],
    padded with 0."""
    weight: np.ndarray
    """(quadratures, nodes): weights of the nodes of each Gaussian quadrature; they sum to 1."""
    n_nodes: np.ndarray
    """(quadratures,) int64: number of nodes of each Gaussian quadrature, without padding."""
    window_transform: np.ndarray
    """(m,): transform of the window at the distances 0, 1, 2 .. times 1 / ``samples_per_bin`` from
    a line [bins]."""
    samples_per_bin: float
    """Number of samples of ``window_transform`` per bin of fs/N, with the sampling rate fs and the
    FFT size N."""
    transform_reach_bins: float
    """Largest distance [bins of fs/N] at which a line contributes to a bin. fs is the sampling rate
    and N the FFT size."""
    nyquist_bin: int
    """Half of the FFT size for a real record, whose bins near frequency 0 and Nyquist also contain
    conjugate images of lines; 0 for a complex record."""

    @classmethod
    def empty(cls) -> "SpeckleLineGrid":
        """Return a record of lines for no points."""
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
        """Return the record for the points with the given indices."""
        if not len(self.line_shift_gradient):
            return self
        return self._replace(
            line_shift_gradient=self.line_shift_gradient[points],
            phase_gradient=self.phase_gradient[points],
            quadrature_index=self.quadrature_index[points],
            peak_search_half_width=self.peak_search_half_width[points],
        )


@lru_cache(maxsize=1)
def _quadrature_tables() -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes and weights of all Gaussian quadratures, (quadratures, nodes) each.

    Rows are padded with zeros.
    """
    node, weight = np.zeros((2, QUADRATURE_NODE_COUNTS.size, QUADRATURE_NODE_COUNTS[-1]))
    for row, n_nodes in enumerate(QUADRATURE_NODE_COUNTS.tolist()):
        node[row, :n_nodes], weight[row, :n_nodes] = normal_distribution_quadrature(n_nodes)
    return node, weight


def speckle_line_grid(shots: "Shots") -> SpeckleLineGrid:
    """Return the lines that represent the footprints of shots in developed speckle.

    Without developed speckle the result has no points.
    """
    gradients = shots.speckle.line_gradients
    _, window_transform = window_transform_table(shots.window)
    node, weight = _quadrature_tables()
    n_points = 0 if gradients is None else shots.size
    line_shift, phase = np.zeros((2, n_points, 3, 2)) if gradients is None else gradients
    padding_factor = shots.fft_size / shots.window.length
    line_shift, phase = _rotate_to_steepest(line_shift, phase, padding_factor)
    # The product of two bins' transforms turns by at most 2 pi for each bin of fs/L.
    phase_max = np.abs(phase[:, :, None] - phase[:, None]).max(axis=(1, 2))
    phase_max = phase_max + np.pi * np.abs(line_shift).max(axis=1) / padding_factor
    quadrature_index = np.searchsorted(_QUADRATURE_PHASE_SLOPE_MAX, phase_max)
    line_shift_max = np.sqrt((line_shift**2).sum(axis=-1)).max(axis=1)
    peak_search_half_width = np.ones(n_points, np.int64)
    if shots.detection_settings.echo_bin_rule == "any_bin":
        is_wide = line_shift_max > 0.02 * padding_factor
        peak_search_half_width = np.where(is_wide, 1 + np.ceil(2.5 * line_shift_max), 1).astype(
            np.int64
        )
    return SpeckleLineGrid(
        np.ascontiguousarray(line_shift * folding_signs(shots)[..., None][:n_points]),
        np.ascontiguousarray(phase),
        quadrature_index.astype(np.int64),
        peak_search_half_width,
        node,
        weight,
        QUADRATURE_NODE_COUNTS,
        window_transform,
        TRANSFORM_SAMPLES_PER_CELL / padding_factor,
        TRANSFORM_REACH_CELLS * padding_factor,
        shots.fft_size_if_end_bins_real // 2,
    )


def _rotate_to_steepest(
    line_shift: np.ndarray, phase: np.ndarray, padding_factor: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rotate the beam's coordinates so that line shifts and phases change most along the first.

    The beam is round, so the joint distribution of the amplitudes is unchanged. Few lines are
    needed along the second coordinate.

    Parameters
    ----------
    line_shift, phase
        (n, 3, 2): fields of :class:`SpeckleLineGrid`, in any coordinates.
    padding_factor
        FFT size over the window's length.

    Returns
    -------
    tuple of ndarray
        ``line_shift`` and ``phase`` in the rotated coordinates.
    """
    phase_slopes = np.concatenate(
        [phase - phase[:, :1], line_shift * (np.pi / padding_factor)], axis=1
    )
    y, x = phase_slopes[..., 0], phase_slopes[..., 1]
    angle = 0.5 * np.arctan2(2 * (y * x).sum(axis=1), (y * y - x * x).sum(axis=1))
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]

    def rotate(vectors: np.ndarray) -> np.ndarray:
        """Rotate each point's vectors, (n, 3, 2) in all, by the angle of the point."""
        first, second = vectors[..., 0], vectors[..., 1]
        return np.stack([cosine * first + sine * second, cosine * second - sine * first], axis=-1)

    return rotate(line_shift), rotate(phase)


def folding_signs(shots: "Shots") -> np.ndarray:
    """Return -1 for segments whose peak moves to lower bins as the beat rises, else 1, (n, 3).

    A peak moves to lower bins if its beat is folded at frequency 0 or at Nyquist.
    """
    signs = np.ones((shots.size, 3))
    if shots.complex_record:
        return signs
    for s, segment in enumerate(shots.waveform_segments):
        delay = segment.echo_delay(shots.range)
        beat = segment.carrier * segment.doppler_ratio - segment.chirp_rate * delay * (
            1 + segment.doppler_ratio
        )
        cycles_per_sample = beat / shots.sample_rate
        signs[:, s] = np.where(cycles_per_sample - np.floor(cycles_per_sample + 0.5) < 0, -1.0, 1.0)
    return signs


@njit(cache=True, error_model="numpy", borrows=True)
def interpolate_transform(distance, grid):
    """Interpolate the window's transform linearly at a distance from a line.

    Parameters
    ----------
    distance : float
        Distance [bins of fs/N], with the sampling rate fs and the FFT size N. Its sign does not
        matter.
    grid : SpeckleLineGrid
        Lines of footprints, with the table of the transform (:class:`SpeckleLineGrid`).

    Returns
    -------
    float
        Transform, 1 at distance 0; 0 beyond the table.
    """
    table_position = abs(distance) * grid.samples_per_bin
    k = int(table_position)
    if k >= grid.window_transform.size - 1:
        return 0.0
    return grid.window_transform[k] + (table_position - k) * (
        grid.window_transform[k + 1] - grid.window_transform[k]
    )


@njit(cache=True, error_model="numpy")
def nearest_image_position(position, nyquist_bin):
    """Return the position of the nearer mirror image of a line: at frequency 0 or at Nyquist.

    Parameters
    ----------
    position : float
        Position x of the line [bins].
    nyquist_bin : int
        Half of the FFT size, N/2.

    Returns
    -------
    float
        -x if x is below N/4, else N - x [bins].
    """
    return -position if position < 0.5 * nyquist_bin else 2.0 * nyquist_bin - position


@njit(cache=True, error_model="numpy", borrows=True)
def fill_mean_bin_powers(grid, point, echo_centre, first_bin, mean_power, pseudo_variance):
    """Compute, into ``mean_power``, the mean powers over speckle of an echo's bins.

    All lines of the echo together have the power 1.

    Parameters
    ----------
    grid, point
        Speckle lines (:class:`SpeckleLineGrid`), and the index of the point.
    echo_centre
        (3,): middle of the echo in each segment [bins]; nan for a segment without an echo.
    first_bin
        (3,): number of the first bin in each segment; later elements are for successive bins.
    mean_power
        (3, bins): output array of mean powers.
    pseudo_variance
        (3, bins): output array of pseudo-variances over mean powers, which images of lines cause
        near DC and Nyquist (:mod:`sweep.model.detection.pseudo_variance`).

    Returns
    -------
    bool
        True if images of lines reach any of the bins.
    """
    mean_power[:] = 0.0
    pseudo_variance[:] = 0.0
    has_images = False
    first_quadrature, second_quadrature = grid.quadrature_index[point]
    for s in range(3):
        if np.isnan(echo_centre[s]):
            continue
        for a in range(grid.n_nodes[first_quadrature]):
            for c in range(grid.n_nodes[second_quadrature]):
                weight = grid.weight[first_quadrature, a] * grid.weight[second_quadrature, c]
                if weight < _LINE_WEIGHT_MIN:
                    continue
                position = (
                    echo_centre[s]
                    + grid.line_shift_gradient[point, s, _FIRST] * grid.node[first_quadrature, a]
                )
                position += (
                    grid.line_shift_gradient[point, s, _SECOND] * grid.node[second_quadrature, c]
                    - first_bin[s]
                )
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
    address, echo_number, grid, point, echo_centre, first_bin, mean_power, amplitudes
):
    """Draw the complex speckle amplitudes of an echo's bins, of mean power 1, as sums over lines.

    Parameters
    ----------
    address
        Key of the point and number of the draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    echo_number
        Number of the echo; each echo has its own random numbers.
    grid, point
        Speckle lines (:class:`SpeckleLineGrid`), and the index of the point.
    echo_centre, first_bin
        Middle of the echo and first bin, as in :func:`fill_mean_bin_powers`.
    mean_power
        (3, bins): result of :func:`fill_mean_bin_powers` for the same bins.
    amplitudes
        (3, bins) complex: output array.

    Notes
    -----
    Amplitudes are equation (1) of the module over the root of ``mean_power``. Their phases refer to
    the middle of the record. All segments have the same amplitudes of the lines. Bins that no line
    reaches are 0.
    """
    amplitudes[:] = 0.0
    key_0, key_1, draw = address
    first_quadrature, second_quadrature = grid.quadrature_index[point]
    amplitude_deviation, random_number = (
        math.sqrt(0.5),
        ECHO_RANDOM_INDEX_STRIDE * (1 + echo_number),
    )
    for a in range(grid.n_nodes[first_quadrature]):
        for c in range(grid.n_nodes[second_quadrature]):
            weight = grid.weight[first_quadrature, a] * grid.weight[second_quadrature, c]
            if weight < _LINE_WEIGHT_MIN:
                continue
            re, im = philox.normal_pair(key_0, key_1, draw, philox.STREAM_SPECKLE, random_number)
            random_number += 1
            line_amplitude = complex(re, im) * (amplitude_deviation * math.sqrt(weight))
            y, x = grid.node[first_quadrature, a], grid.node[second_quadrature, c]
            for s in range(3):
                if np.isnan(echo_centre[s]):
                    continue
                phase = (
                    grid.phase_gradient[point, s, _FIRST] * y
                    + grid.phase_gradient[point, s, _SECOND] * x
                )
                phased_amplitude = line_amplitude
                if phase != 0.0:
                    phased_amplitude = line_amplitude * complex(math.cos(phase), math.sin(phase))
                position = (
                    echo_centre[s]
                    + grid.line_shift_gradient[point, s, _FIRST] * y
                    + grid.line_shift_gradient[point, s, _SECOND] * x
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
"""Largest number of bins, summed over segments, whose speckle is drawn by a factor of its
covariance. The speckle of more bins is summed over the lines of the footprint."""

_RESIDUAL_POWER_MAX = 1e-8
"""Largest fraction of a bin's mean power that the factor of the speckle's covariance may leave out.
"""


@njit(cache=True, error_model="numpy")
def factor_bin_covariance(grid, point, echo_centre, first_bin, mean_power, factor):
    """Compute a factor of the covariance of the speckle in an echo's bins; return its rank.

    Amplitudes drawn by the factor (:func:`draw_factored_amplitudes`) have the same distribution as
    those drawn by :func:`draw_bin_amplitudes`, and take fewer random numbers.

    Parameters
    ----------
    grid, point
        Speckle lines (:class:`SpeckleLineGrid`), and the index of the point.
    echo_centre, first_bin, mean_power
        Middle of the echo, first bin and mean powers, as in :func:`draw_bin_amplitudes`.
    factor
        (rows, 3, bins) complex, with one row for each bin of all segments: output array. The
        amplitudes of the bins are the sum over its first rows, up to the rank, of the row times a
        circular Gaussian number of mean power 2.

    Returns
    -------
    int
        Rank: the number of rows that are used.

    Notes
    -----
    Lines that are close together make nearly equal amplitudes. For a footprint within a bin, two or
    three random numbers determine the amplitudes of nine bins. The factor follows from Cholesky's
    factorisation with pivots, until no bin lacks more than 1e-8 of its mean power.
    """
    first_quadrature, second_quadrature = grid.quadrature_index[point]
    n_segments, n_bins = mean_power.shape
    line_weights = np.empty(grid.n_nodes[first_quadrature] * grid.n_nodes[second_quadrature])
    # Real and imaginary parts by line, so that the bins of a line are summed together.
    line_re = np.zeros((line_weights.size, n_segments * n_bins))
    line_im = np.zeros((line_weights.size, n_segments * n_bins))
    covariance_re, covariance_im = np.empty(n_segments * n_bins), np.empty(n_segments * n_bins)
    root_power = np.sqrt(mean_power)
    n_lines = 0
    for a in range(grid.n_nodes[first_quadrature]):
        for c in range(grid.n_nodes[second_quadrature]):
            line_weight = grid.weight[first_quadrature, a] * grid.weight[second_quadrature, c]
            if line_weight < _LINE_WEIGHT_MIN:
                continue
            y, x = grid.node[first_quadrature, a], grid.node[second_quadrature, c]
            for s in range(n_segments):
                if np.isnan(echo_centre[s]):
                    continue
                phase = (
                    grid.phase_gradient[point, s, _FIRST] * y
                    + grid.phase_gradient[point, s, _SECOND] * x
                )
                phased_amplitude = complex(math.sqrt(line_weight), 0.0)
                if phase != 0.0:
                    phased_amplitude = phased_amplitude.real * complex(
                        math.cos(phase), math.sin(phase)
                    )
                position = (
                    echo_centre[s]
                    + grid.line_shift_gradient[point, s, _FIRST] * y
                    + grid.line_shift_gradient[point, s, _SECOND] * x
                    - first_bin[s]
                )
                for k in range(n_bins):
                    if mean_power[s, k] > 0.0 and abs(k - position) <= grid.transform_reach_bins:
                        transform_value = (
                            interpolate_transform(k - position, grid) / root_power[s, k]
                        )
                        line_re[n_lines, s * n_bins + k] = phased_amplitude.real * transform_value
                        line_im[n_lines, s * n_bins + k] = phased_amplitude.imag * transform_value
            n_lines += 1
    residual = np.where(mean_power > 0.0, 1.0, 0.0)
    for rank in range(factor.shape[0]):
        pivot_segment, pivot_bin, residual_max = 0, 0, _RESIDUAL_POWER_MAX
        for s in range(n_segments):
            for k in range(n_bins):
                if residual[s, k] > residual_max:
                    pivot_segment, pivot_bin, residual_max = s, k, residual[s, k]
        if residual_max == _RESIDUAL_POWER_MAX:
            return rank
        scale, pivot_column = 1.0 / math.sqrt(residual_max), pivot_segment * n_bins + pivot_bin
        covariance_re[:], covariance_im[:] = 0.0, 0.0
        for line in range(n_lines):
            re, im = line_re[line, pivot_column], line_im[line, pivot_column]
            for column in range(n_segments * n_bins):
                covariance_re[column] += line_re[line, column] * re + line_im[line, column] * im
                covariance_im[column] += line_im[line, column] * re - line_re[line, column] * im
        for s in range(n_segments):
            for k in range(n_bins):
                if not residual[s, k] > 0.0:
                    factor[rank, s, k] = 0.0
                    continue
                covariance = complex(covariance_re[s * n_bins + k], covariance_im[s * n_bins + k])
                for r in range(rank):
                    covariance -= (
                        factor[r, s, k] * factor[r, pivot_segment, pivot_bin].conjugate() * 2.0
                    )
                factor[rank, s, k] = covariance * (scale * math.sqrt(0.5))
        for s in range(n_segments):
            for k in range(n_bins):
                residual[s, k] -= 2.0 * abs(factor[rank, s, k]) ** 2
        residual[pivot_segment, pivot_bin] = 0.0
    return factor.shape[0]


@njit(cache=True, error_model="numpy", borrows=True)
def draw_factored_amplitudes(address, echo_number, factor, rank, amplitudes):
    """Draw the complex speckle amplitudes of an echo's bins by a factor of their covariance.

    The amplitudes have mean power 1.

    Parameters
    ----------
    address, echo_number
        Address of the draw and number of the echo, as in :func:`draw_bin_amplitudes`.
    factor, rank
        Results of :func:`factor_bin_covariance`.
    amplitudes
        (3, bins) complex: output array, of mean power 1.
    """
    amplitudes[:] = 0.0
    key_0, key_1, draw = address
    first_number = ECHO_RANDOM_INDEX_STRIDE * (1 + echo_number)
    for pair in range(0, rank, 2):
        word_0, word_1, word_2, word_3 = philox.four_words(
            key_0, key_1, draw, philox.STREAM_SPECKLE, (first_number + pair) >> 1
        )
        first_of_pair = complex(*philox.to_normals(word_0, word_1))
        if pair + 1 == rank:
            for s in range(amplitudes.shape[0]):
                for k in range(amplitudes.shape[1]):
                    amplitudes[s, k] += first_of_pair * factor[pair, s, k]
            return
        second_of_pair = complex(*philox.to_normals(word_2, word_3))
        for s in range(amplitudes.shape[0]):
            for k in range(amplitudes.shape[1]):
                amplitudes[s, k] = (
                    amplitudes[s, k] + first_of_pair * factor[pair, s, k]
                ) + second_of_pair * factor[pair + 1, s, k]


def draw_segment_bin_amplitudes(
    grid: SpeckleLineGrid,
    point: int,
    echo_centre: np.ndarray,
    first_bin: int,
    n_bins: int,
    *,
    key: np.ndarray,
    draws: np.ndarray,
    echo_number: int = 0,
) -> np.ndarray:
    """Draw the complex speckle amplitudes of adjacent bins of an echo in one segment.

    The amplitudes have mean power 1.

    Parameters
    ----------
    grid, point
        Speckle lines (:class:`SpeckleLineGrid`), and the index of the point.
    echo_centre
        (3,): middle of the echo in the segment that is drawn [bins], nan in the other two.
    first_bin, n_bins
        Number of the first bin, and count of bins.
    key
        (2,) uint64: random key of the point.
    draws
        (m,) int64: numbers of the draws.
    echo_number
        Number of the echo.

    Returns
    -------
    numpy.ndarray
        (m, bins) complex.
    """
    (segment,) = np.flatnonzero(np.isfinite(echo_centre))
    key_0, key_1 = key
    first_bins = np.full(3, first_bin)
    mean_power = np.empty((3, n_bins))
    fill_mean_bin_powers(grid, point, echo_centre, first_bins, mean_power, np.empty((3, n_bins)))
    bin_amplitudes = np.zeros((3, n_bins), complex)
    drawn_amplitudes = np.empty((draws.size, n_bins), complex)
    for row, draw in enumerate(draws):
        draw_bin_amplitudes(
            philox.DrawAddress(key_0, key_1, draw),
            echo_number,
            grid,
            point,
            echo_centre,
            first_bins,
            mean_power,
            bin_amplitudes,
        )
        drawn_amplitudes[row] = bin_amplitudes[segment]
    return drawn_amplitudes


RECORD_LINE_DEVIATION_MAX_CELLS = 1.0
"""Largest standard deviation of the positions of a footprint's lines [resolution cells] for which
speckle is drawn by a :class:`FootprintRecord`. A cell is the sample rate over the number of samples
in the record."""


class FootprintRecord(NamedTuple):
    """Windowed record of an echo in speckle, from which its samples are drawn.

    The record is that of a lone tone at the middle of the echo, times a factor that varies slowly
    from sample to sample. The factor is the sum over lines of ``a z e^(i t . (y, x)) e^(2 pi i b .
    (y, x) (n - middle) / N)``, with the symbols of the module and the sample number n. It is
    represented by a series of Chebyshev polynomials in n.
    """

    series_coefficients: np.ndarray
    """(lines, k) complex: Chebyshev coefficients of each line's contribution to the record, for a
    line of amplitude 1."""
    chebyshev_arguments: np.ndarray
    """(L,): argument of the Chebyshev polynomials at each of the L samples. It rises from -1 to 1
    over the samples that contain the echo."""
    windowed_tone: np.ndarray
    """(L,) complex: samples times window of a pure tone of amplitude 1 at the middle of the echo.
    """
    mean_bin_power: np.ndarray
    """(N,): mean over speckle of the power of each bin of the record's transform, with N the FFT
    size."""

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
        """Return the record from which the speckle of a point's echo in a segment is drawn.

        Parameters
        ----------
        line_grid, point
            Speckle lines, and the index of the point.
        segment
            0 up, 1 Doppler, 2 down.
        tone_position
            Frequency of the lone tone [bins].
        window, first_sample
            Window of the record, and the first of its samples that contain the echo.
        fft_size
            FFT size N.

        Notes
        -----
        The mean powers of the bins are the transform of a product over lags. Its factors are the
        window's autocorrelation and the mean phasor of the lines.
        """
        line_offsets, line_phases, line_weights = _line_table(line_grid, point, segment)
        length = window.length
        half_length = max(0.5 * (length - 1 - first_sample), 0.5)
        radians_per_sample = 2 * np.pi * line_offsets / fft_size
        record_middle = 0.5 * length + float(late_echo_centroid_shift(window)[first_sample])
        series_nodes, series_matrix = _chebyshev_nodes_and_matrix(
            _n_chebyshev_coefficients(np.abs(radians_per_sample).max() * half_length)
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
            _n_chebyshev_coefficients(np.abs(radians_per_sample).max() * length)
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

    def draw_speckled_record(
        self, key: np.ndarray, draw_number: int, echo_number: int
    ) -> np.ndarray:
        """Draw the complex windowed samples of an echo in speckle.

        The random numbers are those of :func:`draw_bin_amplitudes`.

        Parameters
        ----------
        key : ndarray (2,) uint64
            Random key of the point.
        draw_number : int
            Number of the draw.
        echo_number : int
            Number of the echo (group of adjacent bins) in the segment.

        Returns
        -------
        ndarray (L,) complex
            Samples of the record.
        """
        key_0, key_1 = key
        line_amplitudes = np.empty(len(self.series_coefficients), complex)
        _draw_line_amplitudes(
            philox.DrawAddress(key_0, key_1, np.int64(draw_number)),
            ECHO_RANDOM_INDEX_STRIDE * (1 + echo_number),
            line_amplitudes,
        )
        record = self.windowed_tone.copy()
        _multiply_by_chebyshev_series(
            (line_amplitudes[:, None] * self.series_coefficients).sum(axis=0),
            self.chebyshev_arguments,
            record,
        )
        return record


_RELATIVE_POWER_MIN = 1e-14
"""Smallest mean power of a bin over the largest mean power of all bins. A smaller power, which
float64 does not resolve, is replaced by it."""


class _LineTable(NamedTuple):
    """Lines of one point in one segment, (lines,) each.

    The lines are in the order in which :func:`draw_bin_amplitudes` draws their amplitudes.
    """

    offset: np.ndarray
    """(lines,): frequency of each line minus the frequency of the middle of the echo [bins]."""
    phase: np.ndarray
    """(lines,): phase of each line's amplitude, relative to the up segment [rad]."""
    weight: np.ndarray
    """(lines,): fraction of the echo's power in each line."""


def _line_table(line_grid: SpeckleLineGrid, point: int, segment: int) -> _LineTable:
    """Return the frequencies, phases and weights of the lines of a point in a segment.

    The result is a :class:`_LineTable`.
    """
    first_quadrature, second_quadrature = line_grid.quadrature_index[point]
    y, x = (
        line_grid.node[quadrature_index, : line_grid.n_nodes[quadrature_index]]
        for quadrature_index in (first_quadrature, second_quadrature)
    )
    line_weights = (
        line_grid.weight[first_quadrature, : y.size, None]
        * line_grid.weight[second_quadrature, : x.size]
    )
    offsets, phases = (
        gradients[point, segment, _FIRST] * y[:, None] + gradients[point, segment, _SECOND] * x
        for gradients in (line_grid.line_shift_gradient, line_grid.phase_gradient)
    )
    is_used = line_weights >= _LINE_WEIGHT_MIN
    return _LineTable(offsets[is_used], phases[is_used], line_weights[is_used])


@njit(cache=True, error_model="numpy")
def _draw_line_amplitudes(address, first_number, amplitudes):
    """Fill ``amplitudes`` with circular complex Gaussian numbers of mean power 2.

    Each is a pair of normal numbers of the stream of speckle, beginning with pair ``first_number``.
    ``address`` is the address of the draw (:class:`sweep.model.sampling.philox.DrawAddress`).
    """
    key_0, key_1, draw = address
    for k in range(amplitudes.size):
        re, im = philox.normal_pair(key_0, key_1, draw, philox.STREAM_SPECKLE, first_number + k)
        amplitudes[k] = complex(re, im)


def _n_chebyshev_coefficients(phase_max: float) -> int:
    """Return the number of Chebyshev coefficients that represent exp(i x) within 1e-7.

    x is real, with |x| <= ``phase_max`` [rad].
    """
    return 9 + math.ceil(1.5 * phase_max)


@lru_cache(maxsize=64)
def _chebyshev_nodes_and_matrix(n_coefficients: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes and the matrix that fit a Chebyshev series to a function.

    Returns
    -------
    nodes : ndarray (k,)
        Positions -1..1 at which the function is evaluated.
    matrix : ndarray (k, k)
        The matrix times the values at the nodes gives the k coefficients of the series.
    """
    node_angles = np.pi * (np.arange(n_coefficients) + 0.5) / n_coefficients
    series_matrix = np.cos(np.arange(n_coefficients)[:, None] * node_angles) * (
        2.0 / n_coefficients
    )
    series_matrix[0] *= 0.5
    return np.cos(node_angles), series_matrix


_SERIES_SAMPLES_PER_BATCH = 128
"""Number of samples at which a Chebyshev series is evaluated in one step, in vector registers."""


@njit(cache=True, error_model="numpy")
def _multiply_by_chebyshev_series(coefficients, positions, values):
    """Multiply complex values (n,) in place by a Chebyshev series at positions -1..1 (n,).

    ``coefficients`` (k,) complex are those of the series, which Clenshaw's algorithm evaluates.
    """
    b1_re, b1_im = np.empty(_SERIES_SAMPLES_PER_BATCH), np.empty(_SERIES_SAMPLES_PER_BATCH)
    b2_re, b2_im = np.empty(_SERIES_SAMPLES_PER_BATCH), np.empty(_SERIES_SAMPLES_PER_BATCH)
    twice_positions = np.empty(_SERIES_SAMPLES_PER_BATCH)
    for batch_begin in range(0, positions.size, _SERIES_SAMPLES_PER_BATCH):
        n_samples = min(_SERIES_SAMPLES_PER_BATCH, positions.size - batch_begin)
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
    """Return the autocorrelation (L,) of a window of L samples, at lags of 0 to L - 1 samples.

    Samples before ``first_sample`` count as 0.
    """
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
    """Return the covariance (m,) [bins^2], due to speckle, of peak positions in two segments.

    Parameters
    ----------
    gradients
        Gradients of the lines of the footprints of m echoes.
    pair
        The two segments: 0 up, 1 Doppler, 2 down.
    relative_power
        (2, m): power q^2 of the peak in either segment, over its mean, both with noise.
    echo_fraction
        (2, m): fraction v of the echo in that mean power.

    Returns
    -------
    numpy.ndarray
        (m,): covariance [bins^2]. Positions have the signs of the beats, before any folding.

    Notes
    -----
    Symbols are those of the module, with 1 and 2 for the two segments. Let t be the difference of
    the two phase gradients. The correlation of the amplitudes A_1 and A_2 is rho = exp(-t.t / 2)
    (v_1 v_2)^(1/2). The means of Y_1 and Y_2 given both amplitudes are

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
    phase_difference = gradients.phase_gradient[:, second] - gradients.phase_gradient[:, first]
    squared_phase = (phase_difference * phase_difference).sum(axis=-1)
    fraction_first, fraction_second = echo_fraction
    power_first, power_second = relative_power
    rho = np.exp(-0.5 * squared_phase) * np.sqrt(fraction_first * fraction_second)
    remainder = np.maximum(1 - rho * rho, 1e-12)
    magnitude_product = np.sqrt(power_first * power_second)
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
    """Detected peaks of m echoes in developed speckle, (m, 3) by segment; nan without a peak."""

    offset: np.ndarray
    """(m, 3): interpolated position of the peak minus the number of the bin about which it was
    estimated [bins]."""
    folding_sign: np.ndarray
    """(m, 3): -1 if the peak moves to lower bins as the beat rises (:func:`folding_signs`), else 1.
    """
    relative_power: np.ndarray
    """(m, 3): power of the peak's bin in a draw, divided by its mean over draws. Both powers
    include noise."""
    echo_fraction: np.ndarray
    """(m, 3): fraction, 0..1, of the echo in the mean power of the peak bin; the rest is noise."""


WANDER_MAX_BINS = 1.5
"""Upper limit of the standard deviation by which speckle moves a peak [bins], under the rule
``peak_bin``: only the bin that is strongest without noise is tested."""


SEGMENT_PAIRS_WITH_SELF = (0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)
"""All pairs of segments (0 up, 1 Doppler, 2 down), including each segment with itself."""
CHIRP_PAIRS_WITH_SELF = (0, 0), (0, 2), (2, 2)
"""All pairs of the two chirp segments (0 up, 2 down), including each segment with itself."""


def position_error_moments(
    gradients: LineGradients,
    peaks: SpecklePeaks,
    shots: "Shots",
    pairs: tuple[tuple[int, int], ...] = SEGMENT_PAIRS_WITH_SELF,
    *,
    from_three_bins: bool = True,
) -> np.ndarray:
    """Return the second moments E[e_i e_j] of peak position errors due to speckle [bins^2].

    e_i is the error of the peak's position in segment i.

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
    from_three_bins
        True if positions are those of :mod:`sweep.model.detection.sub_bin_interpolation`. Other
        estimators have the errors of :class:`PeakShapeErrors` in any window, because they do not
        mistake the side of a peak in the rectangular window.

    Returns
    -------
    numpy.ndarray
        (m, 3, 3) by segments i and j [bins^2]; 0 for pairs without both peaks, or not in `pairs`.
        Positions have the signs of the beats, before any folding.

    Notes
    -----
    An error is the sum of two parts: the wander, by equation (3) and :func:`wander_covariance`, and
    the error by the shape of the peak (:class:`PeakShapeErrors`). In footprints of much less than a
    bin the error by broadening is proportional to Re V, with the complex variance V = sum a z b^2
    y^2 / A - s^2 of the lines about the complex shift s. Re V has the mean b^2 and the variance
    b^4 (v / q^2 + v^2 / q^4). Here b is the spread of the lines [bins], q^2 the peak's power over
    its mean, and v the echo fraction. In wider footprints the error has the same relative
    deviation. If only the strongest bin is tested, the wander's deviation is divided by sqrt(1 +
    variance / WANDER_MAX_BINS^2). Positions by two bins have the errors of :class:`TwoBinErrors`
    instead: the wander times its gain, and an excess that is independent from segment to segment.
    The mean over L looks of independent speckle has 1 / L of the variance.
    """
    squared_shift = (gradients.line_shift**2).sum(axis=-1)
    has_peak = np.isfinite(peaks.relative_power) & np.isfinite(peaks.offset)
    relative_power = np.where(has_peak, np.maximum(peaks.relative_power, 1e-12), 1.0)
    echo_fraction = np.where(has_peak, peaks.echo_fraction, 0.0)
    variance = squared_shift * echo_fraction / (2 * relative_power)
    squared_spread = np.where(echo_fraction > 0, squared_shift, 0.0)
    offset, shift_ratio = np.where(has_peak, peaks.offset, 0.0), echo_fraction / relative_power
    shape_deviation, imaginary_shift_deviation, own_variance = np.zeros((3, *variance.shape))
    wander_factor = np.ones(variance.shape)
    if from_three_bins and uses_two_bin_estimator(shots):
        noise_ratio = np.sqrt((1 - echo_fraction) / (2 * relative_power))
        side_errors = TwoBinErrors.from_offset(
            offset, squared_spread, shift_ratio, noise_ratio, shots
        )
        mean_error = np.where(has_peak, peaks.folding_sign * side_errors.mean, 0.0)
        own_variance = np.where(echo_fraction > 0, side_errors.excess_variance, 0.0)
        wander_factor = side_errors.wander_gain
    else:
        shape_errors = PeakShapeErrors.from_offset(offset, squared_spread, variance, shots)
        spread_error = peaks.folding_sign * shape_errors.spread_error
        mean_error = spread_error + peaks.folding_sign * shape_errors.imaginary_shift_error
        shape_deviation = np.sqrt(shift_ratio * (1 + shift_ratio)) * spread_error
        imaginary_shift_deviation = peaks.folding_sign * shape_errors.imaginary_shift_deviation
        if shots.detection_settings.echo_bin_rule == "peak_bin":
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
            own_moment = own_variance[:, first]
        else:
            pair = [first, second]
            own_moment = np.zeros(variance.shape[0])
            moment = wander_covariance(
                gradients, (first, second), relative_power[:, pair].T, echo_fraction[:, pair].T
            )
            phase_difference = (
                gradients.phase_gradient[:, second] - gradients.phase_gradient[:, first]
            )
            amplitude_correlation = np.exp(
                -0.5 * (phase_difference * phase_difference).sum(axis=-1)
            )
        moment = (
            moment
            + (
                shape_deviation[:, first] * shape_deviation[:, second]
                + imaginary_shift_deviation[:, first] * imaginary_shift_deviation[:, second]
            )
            * amplitude_correlation
        )
        moment = moment * wander_factor[:, first] * wander_factor[:, second] + own_moment
        moment = moment / n_looks
        moment = np.where(both_exist, moment + mean_error[:, first] * mean_error[:, second], 0.0)
        moments[:, first, second] = moments[:, second, first] = moment
    return moments
