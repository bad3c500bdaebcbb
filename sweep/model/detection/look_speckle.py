"""Partially correlated speckle of a shot's looks, if the target or the beam moves between them.

In look k a bin of a segment holds ``z_k = s_k sqrt(x_k) + n_k``: the speckle s_k, a circular
complex Gaussian number of power 1, times the root of the look's SNR x_k, plus noise of power 1. The
speckle of looks k and l has the correlation mu(l - k), by equation (2) of
:mod:`sweep.model.detection.speckle_correlation`. The phase [cycles] of a scatterer turns between
them by F beta (l - k) T, with the optical frequency F, the scatterer's Doppler ratio beta, and the
time T from look to look. If the echo spreads over bins, mu follows from equation (3). A line that
moves to other bins has less power in this bin in some looks.

**Mean power.** Let x be the mean SNR of the N looks. The matrix sqrt(x_k x_l) mu(l - k) / x has the
eigenvalues c_j, whose sum is N. The sum of |z_k|^2 is one of independent exponential variables, of
means 1 + x c_j. It exceeds y with

    P(y) = 1 / (2 pi i) int exp(-s y) / s prod_j (1 - (1 + x c_j) s)^(-m_j) ds                 (1)

along a parabola through the saddle point of the integrand, which encloses the poles. Unlike partial
fractions this is precise where eigenvalues are close to each other. The multiplicities m_j are 1.
More than MATRIX_LOOKS_MAX looks are represented by that number of looks at a larger spacing. If
their speckle is uncorrelated over this spacing, one eigenvalue of multiplicity M = N^2 / sum c^2
replaces all: a gamma variable of the same variance [Goodman, Speckle Phenomena in Optics, 2007,
4.6].

**Votes.** A shot may be detected if enough looks cross the threshold in a bin. Given the speckle,
looks cross independently, by Marcum's Q_1. The probability that enough of them cross is averaged
over SPECKLE_LATTICE_SIZE fixed realisations, a Kronecker lattice whose second moments are made
exact. The error of the lattice is known for looks of independent speckle, whose law is binomial.
This error times (M - 1) / (N - 1) is subtracted.

**Two segments.** Let r be the correlation of the segments' mean powers,

    r = sum_kl |mu_12(k, l)|^2 / sqrt(sum_kl |mu_11|^2 sum_kl |mu_22|^2).

mu_12 is the correlation between looks of the two segments, mu_11 and mu_22 that within a segment.
With the same speckle in both segments the joint probability is the mean over the speckle of the
product of both probabilities. For r < 1 the covariance of the two detections is a fraction of that
with the same speckle. For M = 1 the fraction is that of two Rayleigh magnitudes with the
correlation r, for large M it is r.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.detection.marcum import marcum_q1_tails

MATRIX_LOOKS_MAX = 64
"""Largest number of looks whose full correlation matrix is used. More looks are represented by this
number of looks at a larger spacing."""

GAMMA_SHAPE_MIN = 32.0
"""Effective number of looks of independent speckle above which the looks' mean power is treated as
a gamma variable. Up to MATRIX_LOOKS_MAX looks are never treated in this way."""

SPECKLE_LATTICE_SIZE = 2048
"""Number of fixed realisations of the speckle of all looks. The probability that enough looks cross
the threshold is averaged over these realisations."""

_N_CONTOUR_NODES = 40
"""Number of quadrature nodes of the contour integral for tail probabilities of the looks' mean
power. The nodes lie on the upper half of a parabola in the complex plane."""
_CONTOUR_ASINH_MAX = 4.6
"""Largest asinh(Im s / c) on the contour of the integral over s for tail probabilities of the
looks' mean power. c is the width of the integrand's peak."""
_BISECTION_STEPS = 60
_CROSSING_TABLE_STEPS = 512
"""Number of steps in the table of a look's crossing probability over the magnitude of speckle."""
_TABULATED_SPECKLE_MAGNITUDE_MAX = 5.0
"""Largest tabulated speckle magnitude, in units of its root mean square."""


class LookSpeckle(NamedTuple):
    """Correlation of the speckle between the N looks of a shot, by segment and point.

    A look is one record of each segment.
    """

    eigenvalue: np.ndarray
    """(3, n, k): eigenvalues of the correlation matrix of the looks' speckle, by segment and
    point."""
    multiplicity: np.ndarray
    """(3, n, k): multiplicities of the eigenvalues, 0 for unused entries. The sum of eigenvalue
    times multiplicity is the number of looks."""
    n_effective_looks: np.ndarray
    """(3, n): number of looks of independent speckle that are equivalent to the N looks, 1 .. N."""
    segment_correlation: np.ndarray
    """(3, n): square root of the correlation of two segments' mean powers. The rows are the pairs
    (up, Doppler), (up, down), (Doppler, down)."""
    correlation_by_lag: np.ndarray
    """(3, n, N) complex: correlation of the speckle of two looks, by their distance of 0 .. N - 1
    looks."""
    look_power: np.ndarray
    """(3, n, N): power of each look in the echo's strongest bin, over the mean of all looks."""

    @classmethod
    def from_correlations(
        cls, correlation_by_lag: np.ndarray, look_power: np.ndarray, segment_correlation: np.ndarray
    ) -> "LookSpeckle":
        """Compute the eigenvalues and the effective number of looks from correlations and powers.

        Parameters
        ----------
        correlation_by_lag : ndarray (3, n, N) complex
            Correlation mu of the speckle of two looks, by segment, point, and distance of
            0 .. N - 1 looks.
        look_power : ndarray (3, n, N)
            Power of each look in the echo's strongest bin, over the mean of all looks.
        segment_correlation : ndarray (3, n)
            Square root of the correlation of two segments' mean powers, for the pairs
            (up, Doppler), (up, down) and (Doppler, down).

        Returns
        -------
        LookSpeckle
            The arguments, the eigenvalues and their multiplicities, and the effective number of
            looks.

        Notes
        -----
        Let x_k be the looks' relative powers. The eigenvalues c_j of sqrt(x_k x_l) mu(l - k) are
        scaled to the sum N. The effective number of looks is

            M = N^2 / sum c_j^2.

        More than MATRIX_LOOKS_MAX looks are represented by that number of looks at a larger
        spacing. If M of these looks exceeds GAMMA_SHAPE_MIN, one eigenvalue N/M of multiplicity M
        replaces all [Goodman, Speckle Phenomena in Optics, 2007, 4.6]. M is then computed anew from
        the correlations of all N looks, with equal powers: M = N^2 / sum_kl |mu(l - k)|^2, but at
        least GAMMA_SHAPE_MIN.
        """
        n_looks = correlation_by_lag.shape[2]
        eigenvalue = np.maximum(
            np.linalg.eigvalsh(look_covariances(correlation_by_lag, look_power)), 0.0
        )
        eigenvalue *= n_looks / eigenvalue.sum(axis=-1, keepdims=True)
        multiplicity = np.ones(eigenvalue.shape)
        n_effective_looks = n_looks**2 / np.square(eigenvalue).sum(axis=-1)
        if n_looks > MATRIX_LOOKS_MAX:
            lags = np.arange(n_looks)
            n_pairs = np.where(lags > 0, 2.0, 1.0) * (n_looks - lags)
            is_gamma = n_effective_looks > GAMMA_SHAPE_MIN
            effective_of_all = n_looks**2 / (n_pairs * np.abs(correlation_by_lag) ** 2).sum(axis=-1)
            n_effective_looks = np.where(
                is_gamma, np.maximum(effective_of_all, GAMMA_SHAPE_MIN), n_effective_looks
            )
            eigenvalue[is_gamma], multiplicity[is_gamma] = 0.0, 0.0
            eigenvalue[is_gamma, 0] = n_looks / n_effective_looks[is_gamma]
            multiplicity[is_gamma, 0] = n_effective_looks[is_gamma]
        return cls(
            eigenvalue,
            multiplicity,
            np.clip(n_effective_looks, 1.0, n_looks),
            segment_correlation,
            correlation_by_lag,
            look_power,
        )

    def select(self, points: np.ndarray | slice) -> "LookSpeckle":
        """Return the :class:`LookSpeckle` of some points, given by their indices."""
        return LookSpeckle(*(column[:, points] for column in self))

    def covariance_root(self, segment: int, point: int) -> np.ndarray:
        """Return a matrix A (N, N) whose product A A^H is the covariance of the looks' speckle.

        A^H is the conjugate transpose. For a vector z of independent circular complex Gaussian
        numbers of power 1, A z are speckle amplitudes of the N looks.

        Parameters
        ----------
        segment : int
            Index of the segment: 0 up, 1 Doppler, 2 down.
        point : int
            Index of the point.

        Returns
        -------
        ndarray (N, N) complex
            A. Its columns are eigenvectors of the covariance, each times the root of its
            eigenvalue, from the largest eigenvalue to the smallest.

        Notes
        -----
        The covariance of looks k and l is sqrt(x_k x_l) mu(l - k), with the looks' relative powers
        x of mean 1, and the correlation mu (:func:`look_covariances`).
        """
        correlation_by_lag = self.correlation_by_lag[segment, point]
        covariance = look_covariances(
            correlation_by_lag, self.look_power[segment, point], correlation_by_lag.size
        )
        eigenvalue, eigenvector = np.linalg.eigh(covariance)
        return eigenvector[:, ::-1] * np.sqrt(np.maximum(eigenvalue[::-1], 0.0))

    def covariance_roots(self) -> np.ndarray:
        """Return :meth:`covariance_root` of all segments and points, (3, n, N, k).

        Only the first k columns are kept. Each column after them has, at all points, less than the
        fraction :data:`_EIGENVALUE_FRACTION_MIN` of the power.
        """
        n_looks = self.correlation_by_lag.shape[2]
        eigenvalues, eigenvectors = np.linalg.eigh(
            look_covariances(self.correlation_by_lag, self.look_power, n_looks)
        )
        eigenvalues = np.maximum(eigenvalues[..., ::-1], 0.0)
        n_used = (eigenvalues > _EIGENVALUE_FRACTION_MIN * n_looks).any(axis=(0, 1)).sum()
        return (eigenvectors[..., ::-1] * np.sqrt(eigenvalues)[..., None, :])[..., :n_used]


_EIGENVALUE_FRACTION_MIN = 1e-7
"""Fraction of the total power of all looks below which an eigenvalue of the covariance of the
looks' speckle is dropped."""


def look_covariances(
    correlation_by_lag: np.ndarray, look_power: np.ndarray, looks_max: int = MATRIX_LOOKS_MAX
) -> np.ndarray:
    """Return the covariance matrices of the looks' speckle amplitudes, (..., k, k).

    Looks i and j have the covariance sqrt(x_i x_j) mu(j - i), with their relative powers x and the
    correlation mu by lag.

    Parameters
    ----------
    correlation_by_lag, look_power
        (..., N): as in :class:`LookSpeckle`.
    looks_max
        Largest number k of rows. More looks are represented by this number of looks, at
        :func:`representative_look_positions`.
    """
    n_looks = correlation_by_lag.shape[-1]
    position = representative_look_positions(n_looks, looks_max)
    n_kept = position.size
    if n_kept < n_looks:
        index = np.minimum(position.astype(int), n_looks - 2)
        fraction = position - index
        correlation_by_lag, look_power = (
            values[..., index] * (1 - fraction) + values[..., index + 1] * fraction
            for values in (correlation_by_lag, look_power)
        )
    lag = np.arange(n_kept) - np.arange(n_kept)[:, None]
    covariance = correlation_by_lag[..., np.abs(lag)]
    covariance = np.where(lag < 0, np.conj(covariance), covariance)
    return covariance * np.sqrt(look_power[..., :, None] * look_power[..., None, :])


def representative_look_positions(n_looks: int, looks_max: int = MATRIX_LOOKS_MAX) -> np.ndarray:
    """Return the positions, in the sequence of looks, of the looks that represent all, (k,).

    Parameters
    ----------
    n_looks : int
        Number N of looks.
    looks_max : int
        Largest number of positions, at least 2.

    Returns
    -------
    ndarray (k,)
        Positions, k = min(N, ``looks_max``). Positions count looks from 0, rise evenly, and need
        not be integers.

    Notes
    -----
    The spacing is sqrt((N^2 - 1) / (k^2 - 1)). The k positions then have the variance of the
    positions of all N looks.
    """
    n_kept = min(n_looks, looks_max)
    position_step = math.sqrt((n_looks**2 - 1) / (n_kept**2 - 1)) if n_kept < n_looks else 1.0
    return np.minimum(np.arange(n_kept) * position_step, n_looks - 1)


def phase_rotated_look_covariances(
    correlation_by_lag: np.ndarray, look_power: np.ndarray, cycles_per_look: np.ndarray
) -> np.ndarray:
    """Return covariances of echo amplitudes whose phase rotates from look to look, (m, k, k).

    Parameters
    ----------
    correlation_by_lag, look_power
        (m, N): as in :class:`LookSpeckle`.
    cycles_per_look
        (m,): rotation of the line's phase from one look to the next [cycles].
    """
    positions = representative_look_positions(correlation_by_lag.shape[-1])
    phase = 2 * np.pi * np.mod(cycles_per_look[:, None] * positions, 1.0)
    return look_covariances(correlation_by_lag, look_power) * np.exp(
        1j * (phase[:, None, :] - phase[:, :, None])
    )


def mean_power_tails(
    look_speckle: LookSpeckle, n_looks: int, snr: np.ndarray, threshold: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the probabilities that the sum of the looks' powers is above and below a threshold.

    The probabilities are two arrays (..., 3, n). That above the threshold is equation (1) of the
    module's description.

    Parameters
    ----------
    look_speckle
        Correlation of the looks' speckle.
    n_looks
        Number of looks N.
    snr
        (..., 3, n): mean SNR of one look.
    threshold
        (..., 3, n): threshold on the sum, over the mean noise power of one look.
    """
    snr, threshold = np.broadcast_arrays(snr, threshold)
    noise_multiplicity = n_looks - look_speckle.multiplicity.sum(axis=-1, keepdims=True)
    multiplicity = np.concatenate(
        [look_speckle.multiplicity, np.maximum(noise_multiplicity, 0.0)], axis=-1
    )
    mean_power = 1 + snr[..., None] * look_speckle.eigenvalue
    mean_power = np.concatenate([mean_power, np.ones((*mean_power.shape[:-1], 1))], axis=-1)
    return gamma_sum_tails(multiplicity, mean_power, threshold)


def gamma_sum_tails(
    gamma_shape: np.ndarray, gamma_scale: np.ndarray, threshold: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return P(sum of independent gamma variables > threshold), and its complement.

    Parameters
    ----------
    gamma_shape
        (..., k): shapes of the variables: 1 of an exponential one, 1/2 of a squared Gaussian one.
    gamma_scale
        (..., k): scales of the variables, mean over shape.
    threshold
        (...): threshold on the sum.
    """
    scale_max = gamma_scale.max(axis=-1)
    gamma_scale, scaled_threshold = gamma_scale / scale_max[..., None], threshold / scale_max
    is_rare = scaled_threshold > (gamma_shape * gamma_scale).sum(axis=-1)
    saddle, second_derivative, third_derivative = _saddle_point(
        gamma_shape, gamma_scale, scaled_threshold, is_rare
    )
    contour_scale = 1 / np.sqrt(second_derivative)
    contour_curvature = np.clip(
        third_derivative / (6 * second_derivative), 0.05 / contour_scale, 2 / contour_scale
    )[..., None]
    step = _CONTOUR_ASINH_MAX / _N_CONTOUR_NODES
    node = (np.arange(_N_CONTOUR_NODES) + 0.5) * step
    imaginary_part = contour_scale[..., None] * np.sinh(node)
    s = (
        saddle[..., None]
        + 1j * imaginary_part
        + contour_curvature * imaginary_part * imaginary_part
    )
    contour_step = (
        (1j + 2 * contour_curvature * imaginary_part)
        * contour_scale[..., None]
        * np.cosh(node)
        * step
    )
    exponent = -s * scaled_threshold[..., None]
    for j in range(gamma_scale.shape[-1]):
        exponent = exponent - gamma_shape[..., j, None] * np.log(1 - gamma_scale[..., j, None] * s)
    tail = np.abs((np.exp(exponent) / s * contour_step / 1j).real.sum(axis=-1)) / np.pi
    tail = np.minimum(tail, 1.0)
    return np.where(is_rare, tail, 1 - tail), np.where(is_rare, 1 - tail, tail)


def _saddle_point(
    multiplicity: np.ndarray,
    mean_power: np.ndarray,
    scaled_threshold: np.ndarray,
    is_rare: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the saddle point of a tail integral, and derivatives of the integrand's logarithm.

    The integral is equation (1) of the module's description.

    The saddle point lies between 0 and the first pole for the upper tail, and below 0 for the lower
    tail.

    Parameters
    ----------
    multiplicity, mean_power
        (..., k): shapes and scales of the gamma variables; the largest scale is 1.
    scaled_threshold
        (...): threshold over the largest scale.
    is_rare
        (...) bool: True if the upper tail is computed.

    Returns
    -------
    tuple of numpy.ndarray
        (...) each: saddle point, second derivative and third derivative.
    """
    low = np.where(is_rare, 1e-12, -1e12)
    high = np.where(is_rare, 1 - 1e-12, -1e-12)
    for _ in range(_BISECTION_STEPS):
        middle = np.where(is_rare, 0.5 * (low + high), -np.sqrt(low * high))
        ratio = mean_power / (1 - mean_power * middle[..., None])
        is_left_of_saddle = (multiplicity * ratio).sum(axis=-1) - scaled_threshold - 1 / middle > 0
        low, high = (
            np.where(is_left_of_saddle, low, middle),
            np.where(is_left_of_saddle, middle, high),
        )
    second_derivative = (multiplicity * ratio**2).sum(axis=-1) + 1 / middle**2
    return middle, second_derivative, 2 * (multiplicity * ratio**3).sum(axis=-1) - 2 / middle**3


@lru_cache(maxsize=8)
def speckle_lattice_amplitudes(n_looks: int) -> np.ndarray:
    """Return fixed realisations of the amplitudes of N looks whose speckle is independent.

    The realisations are (SPECKLE_LATTICE_SIZE, N) complex. A Kronecker lattice of the roots of
    primes is transformed to circular Gaussian numbers. The numbers are standardised to mean 0 and
    the unit covariance matrix.
    """
    primes = [2]
    while len(primes) < 2 * n_looks:
        candidate = primes[-1] + 1
        while any(candidate % prime == 0 for prime in primes):
            candidate += 1
        primes.append(candidate)
    lattice = np.mod((np.arange(SPECKLE_LATTICE_SIZE)[:, None] + 0.5) * np.sqrt(primes), 1.0)
    lattice = np.clip(lattice, 1e-9, 1 - 1e-9)
    speckle = np.sqrt(-np.log(lattice[:, :n_looks])) * np.exp(2j * np.pi * lattice[:, n_looks:])
    speckle -= speckle.mean(axis=0)
    factor = np.linalg.cholesky(speckle.conj().T @ speckle / SPECKLE_LATTICE_SIZE)
    return speckle @ np.linalg.inv(factor).conj().T


@njit(cache=True, error_model="numpy")
def correlated_speckle_magnitudes(speckle, covariance_root):
    """Return the magnitudes of the correlated speckle of N looks in m realisations, (m, N).

    The magnitudes are |A z|, with the matrix A and independent amplitudes z.

    Parameters
    ----------
    speckle
        (m, k) complex: m realisations of independent amplitudes z.
    covariance_root
        (N, k) complex: A, as in :meth:`LookSpeckle.covariance_root`.
    """
    magnitude = np.empty((speckle.shape[0], covariance_root.shape[0]))
    for i in range(speckle.shape[0]):
        for k in range(covariance_root.shape[0]):
            re, im = 0.0, 0.0
            for j in range(covariance_root.shape[1]):
                product = speckle[i, j] * covariance_root[k, j]
                re += product.real
                im += product.imag
            magnitude[i, k] = math.hypot(re, im)
    return magnitude


@njit(cache=True, error_model="numpy")
def vote_probability_given_speckle(signal, threshold_ratio, votes_needed, magnitude, is_real=False):
    """Return the probability that enough looks cross the threshold, given their speckle, (m,).

    Parameters
    ----------
    signal, threshold_ratio
        Root mean square signal and threshold of one look, over the noise per quadrature.
    votes_needed
        Smallest number of looks that must cross for a detection.
    magnitude
        (m, N): magnitudes of the looks' speckle, of mean square 1.
    is_real
        True if the noise is real: one quadrature has the noise power of both.

    Notes
    -----
    Given their speckle s_k, looks cross independently with Q_1(signal |s_k|, threshold), or the
    tails of a normal variable for real noise. The number of crossings has a Poisson binomial
    distribution, which is built up look by look.
    """
    crossing_table = np.empty(_CROSSING_TABLE_STEPS + 1)
    step = _TABULATED_SPECKLE_MAGNITUDE_MAX / _CROSSING_TABLE_STEPS
    for k in range(_CROSSING_TABLE_STEPS + 1):
        faded_signal = signal * k * step
        if is_real:
            tail_above, tail_below = (
                math.erfc(0.5 * (threshold_ratio - faded_signal)),
                math.erfc(0.5 * (threshold_ratio + faded_signal)),
            )
            crossing_table[k] = 0.5 * (tail_above + tail_below)
        else:
            crossing_table[k] = marcum_q1_tails(faded_signal, threshold_ratio).above
    vote_probability, count_distribution = np.empty(magnitude.shape[0]), np.empty(votes_needed + 1)
    for i in range(magnitude.shape[0]):
        count_distribution[:] = 0.0
        count_distribution[0] = 1.0
        for j in range(magnitude.shape[1]):
            table_position = min(magnitude[i, j] / step, _CROSSING_TABLE_STEPS - 1e-9)
            k = int(table_position)
            p_cross = crossing_table[k] + (table_position - k) * (
                crossing_table[k + 1] - crossing_table[k]
            )
            count_distribution[votes_needed] += count_distribution[votes_needed - 1] * p_cross
            for v in range(votes_needed - 1, 0, -1):
                count_distribution[v] = (
                    count_distribution[v] * (1.0 - p_cross) + count_distribution[v - 1] * p_cross
                )
            count_distribution[0] *= 1.0 - p_cross
        vote_probability[i] = count_distribution[votes_needed]
    return vote_probability
