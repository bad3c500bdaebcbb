"""Speckle that the looks of a shot share in part, as the target or the beam moves on between them.

In look k a bin of a segment holds ``z_k = s_k sqrt(x_k) + n_k``: the speckle s, circular complex
Gaussian of power 1, times the root of the look's SNR, and noise of power 1. The speckles of looks
k and l have the correlation mu(l - k), equation (2) of :mod:`sweep.model.speckle_correlation`: with
the turn F beta (l - k) T of a scatterer between two looks, which start T apart. If the echo spreads
over bins it is equation (3). Looks in which the line has moved on to other bins have less power in
this one.

**Mean power.** Let x be the mean SNR, and c_j the eigenvalues of the matrix sqrt(x_k x_l) mu(l - k)
over x, of which the sum is N. The sum of |z_k|^2 is one of independent exponential variables, of
means 1 + x c_j. It exceeds y with

    P(y) = 1 / (2 pi i) int exp(-s y) / s prod_j (1 - (1 + x c_j) s)^(-m_j) ds                 (1)

along a parabola through the saddle point of the integrand, which the poles lie within. In contrast
to partial fractions this keeps its digits where eigenvalues are alike. m_j is 1. More than
MATRIX_LOOKS_MAX looks have the eigenvalues of as many looks that are farther apart. If their
speckle has no memory over this distance, there is one of multiplicity M = N^2 / sum c^2: a gamma
variable of the same variance [Goodman, Speckle Phenomena in Optics, 2007, 4.6].

**Votes.** Given the speckles, records cross independently, by Q_1. The probability that enough do
is averaged over NODES fixed speckles, a Kronecker lattice with its second moments made exact. The
lattice's error for looks of independent speckle, of which the binomial law is known, is taken off
in proportion to (M - 1) / (N - 1).

**Two segments.** Let r be the correlation of the segments' mean powers,

    r = sum_kl |mu_12(k, l)|^2 / sqrt(sum_kl |mu_11|^2 sum_kl |mu_22|^2).

If they share all their speckle, the product of both is averaged over it. Of the covariance that
this leaves they have a part: that which two Rayleigh magnitudes have at r if M is 1, and r if M is
large.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.kernel_cache import njit
from sweep.model.marcum import marcum_q1_pair

MATRIX_LOOKS_MAX = 64
"""Number of looks up to which the full correlation matrix is used."""

GAMMA_SHAPE_MIN = 32.0
"""Effective number of looks from which, with more than MATRIX_LOOKS_MAX looks, the mean power is
treated as a gamma variable."""

NODES = 2048
"""Number of lattice points (joint speckles of all looks) over which votes are averaged."""

_CONTOUR_NODES = 40
_CONTOUR_END = 4.6
_HALVINGS = 60
_Q_STEPS = 512
_SPECKLE_MAX = 5.0
"""Largest tabulated speckle magnitude, in units of its root mean square."""


class LookSpeckle(NamedTuple):
    """Correlation of the speckle between the N looks of a shot, by segment and point."""

    strength: np.ndarray
    """(3, n, k): eigenvalues c_j of the looks' correlation matrix."""
    multiplicity: np.ndarray
    """(3, n, k): multiplicities m_j, 0 for unused entries; sum_j c_j m_j = N."""
    shape: np.ndarray
    """(3, n): effective number M of looks of independent speckle, 1 .. N."""
    between: np.ndarray
    """(3, n): sqrt(r) for the pairs (up, Doppler), (up, down), (Doppler, down)."""
    by_lag: np.ndarray
    """(3, n, N) complex: correlation mu of two looks by their distance 0 .. N - 1."""
    power: np.ndarray
    """(3, n, N): relative power of each look in the strongest bin; mean 1."""

    @classmethod
    def of(cls, by_lag: np.ndarray, power: np.ndarray, between: np.ndarray) -> "LookSpeckle":
        """Compute eigenvalues and effective number of looks from correlations and powers.

        ``by_lag``, ``power`` and ``between`` are as of the fields.
        """
        number = by_lag.shape[2]
        strength = np.maximum(np.linalg.eigvalsh(look_matrices(by_lag, power)), 0.0)
        strength *= number / strength.sum(axis=-1, keepdims=True)
        multiplicity = np.ones(strength.shape)
        shape = number**2 / np.square(strength).sum(axis=-1)
        if number > MATRIX_LOOKS_MAX:
            lags = np.arange(number)
            pairs = np.where(lags > 0, 2.0, 1.0) * (number - lags)
            is_gamma = shape > GAMMA_SHAPE_MIN
            of_all = number**2 / (pairs * np.abs(by_lag) ** 2).sum(axis=-1)
            shape = np.where(is_gamma, np.maximum(of_all, GAMMA_SHAPE_MIN), shape)
            strength[is_gamma], multiplicity[is_gamma] = 0.0, 0.0
            strength[is_gamma, 0] = number / shape[is_gamma]
            multiplicity[is_gamma, 0] = shape[is_gamma]
        return cls(strength, multiplicity, np.clip(shape, 1.0, number), between, by_lag, power)

    def at(self, points: np.ndarray | slice) -> "LookSpeckle":
        """Select points by their indices."""
        return LookSpeckle(*(column[:, points] for column in self))

    def root(self, segment: int, point: int) -> np.ndarray:
        """Return a matrix A (N, N) with A A^H = the covariance of the looks' speckle.

        A z are the speckles of the N looks, each times the root of its power, if the z are
        independent, of mean power 1.
        """
        by_lag = self.by_lag[segment, point]
        matrix = look_matrices(by_lag, self.power[segment, point], by_lag.size)
        value, vector = np.linalg.eigh(matrix)
        return vector[:, ::-1] * np.sqrt(np.maximum(value[::-1], 0.0))

    def roots(self) -> np.ndarray:
        """Return the matrices of :meth:`root` of all segments and points, (3, n, N, k).

        With as many columns as independent speckles have a share in the looks of any point.
        """
        number = self.by_lag.shape[2]
        value, vector = np.linalg.eigh(look_matrices(self.by_lag, self.power, number))
        value = np.maximum(value[..., ::-1], 0.0)
        used = (value > _LEAST_STRENGTH * number).any(axis=(0, 1)).sum()
        return (vector[..., ::-1] * np.sqrt(value)[..., None, :])[..., :used]


_LEAST_STRENGTH = 1e-7
"""Share of the looks' power below which an independent speckle is left out."""


def look_matrices(
    by_lag: np.ndarray, power: np.ndarray, most: int = MATRIX_LOOKS_MAX
) -> np.ndarray:
    """Return the covariance matrices sqrt(x_k x_l) mu(l - k) of the looks' speckle, (..., k, k).

    More than ``most`` looks are represented by those of :func:`look_places`.
    """
    number = by_lag.shape[-1]
    place = look_places(number, most)
    few = place.size
    if few < number:
        lower = np.minimum(place.astype(int), number - 2)
        share = place - lower
        by_lag, power = (
            values[..., lower] * (1 - share) + values[..., lower + 1] * share
            for values in (by_lag, power)
        )
    lag = np.arange(few) - np.arange(few)[:, None]
    matrix = by_lag[..., np.abs(lag)]
    matrix = np.where(lag < 0, np.conj(matrix), matrix)
    return matrix * np.sqrt(power[..., :, None] * power[..., None, :])


def look_places(number: int, most: int = MATRIX_LOOKS_MAX) -> np.ndarray:
    """Return the places, in looks, of the ``most`` looks at most that represent ``number`` looks.

    They have the same mean square time from the middle.
    """
    few = min(number, most)
    step = math.sqrt((number**2 - 1) / (few**2 - 1)) if few < number else 1.0
    return np.minimum(np.arange(few) * step, number - 1)


def turned_matrices(by_lag: np.ndarray, power: np.ndarray, cycles: np.ndarray) -> np.ndarray:
    """Return :func:`look_matrices` of echoes whose phase turns from look to look, (m, k, k).

    Parameters
    ----------
    by_lag, power
        (m, N): as of :class:`LookSpeckle`.
    cycles
        (m,): turn of the line's phase from one look to the next [cycles].
    """
    place = look_places(by_lag.shape[-1])
    phase = 2 * np.pi * np.mod(cycles[:, None] * place, 1.0)
    return look_matrices(by_lag, power) * np.exp(1j * (phase[:, None, :] - phase[:, :, None]))


def mean_power_tails(
    speckle: LookSpeckle, number: int, snr: np.ndarray, threshold: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return P(sum of the looks' powers > threshold), equation (1), and its complement.

    Parameters
    ----------
    speckle
        Correlation of the looks' speckle.
    number
        Number of looks N.
    snr
        (..., 3, n): mean SNR of one look.
    threshold
        (..., 3, n): threshold on the sum, over the mean noise power of one look.
    """
    snr, threshold = np.broadcast_arrays(snr, threshold)
    noise_alone = number - speckle.multiplicity.sum(axis=-1, keepdims=True)
    weight = np.concatenate([speckle.multiplicity, np.maximum(noise_alone, 0.0)], axis=-1)
    mean = 1 + snr[..., None] * speckle.strength
    mean = np.concatenate([mean, np.ones((*mean.shape[:-1], 1))], axis=-1)
    return power_sum_tails(weight, mean, threshold)


def power_sum_tails(
    weight: np.ndarray, mean: np.ndarray, threshold: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return P(sum of independent gamma variables > threshold), and its complement.

    Parameters
    ----------
    weight
        (..., k): shapes of the variables: 1 of an exponential one, 1/2 of a squared Gaussian one.
    mean
        (..., k): their means over their shapes.
    threshold
        (...).
    """
    largest = mean.max(axis=-1)
    mean, y = mean / largest[..., None], threshold / largest
    is_rare = y > (weight * mean).sum(axis=-1)
    saddle, bend, skew = _saddle_point(weight, mean, y, is_rare)
    wide = 1 / np.sqrt(bend)
    curve = np.clip(skew / (6 * bend), 0.05 / wide, 2 / wide)[..., None]
    step = _CONTOUR_END / _CONTOUR_NODES
    node = (np.arange(_CONTOUR_NODES) + 0.5) * step
    across = wide[..., None] * np.sinh(node)
    s = saddle[..., None] + 1j * across + curve * across * across
    slope = (1j + 2 * curve * across) * wide[..., None] * np.cosh(node) * step
    exponent = -s * y[..., None]
    for j in range(mean.shape[-1]):
        exponent = exponent - weight[..., j, None] * np.log(1 - mean[..., j, None] * s)
    tail = np.abs((np.exp(exponent) / s * slope / 1j).real.sum(axis=-1)) / np.pi
    tail = np.minimum(tail, 1.0)
    return np.where(is_rare, tail, 1 - tail), np.where(is_rare, 1 - tail, tail)


def _saddle_point(
    weight: np.ndarray, mean: np.ndarray, y: np.ndarray, is_rare: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Saddle point of the integrand of (1), and the second and third derivative of its logarithm.

    It lies between 0 and the first pole for the upper tail, below 0 for the lower one.
    """
    low = np.where(is_rare, 1e-12, -1e12)
    high = np.where(is_rare, 1 - 1e-12, -1e-12)
    for _ in range(_HALVINGS):
        middle = np.where(is_rare, 0.5 * (low + high), -np.sqrt(low * high))
        ratio = mean / (1 - mean * middle[..., None])
        rises = (weight * ratio).sum(axis=-1) - y - 1 / middle > 0
        low, high = np.where(rises, low, middle), np.where(rises, middle, high)
    bend = (weight * ratio**2).sum(axis=-1) + 1 / middle**2
    return middle, bend, 2 * (weight * ratio**3).sum(axis=-1) - 2 / middle**3


@lru_cache(maxsize=8)
def independent_speckles(number: int) -> np.ndarray:
    """Return a fixed lattice of independent speckles, (NODES, number) complex.

    Kronecker lattice of the roots of primes, standardised: mean 0, covariance the unit matrix.
    """
    primes = [2]
    while len(primes) < 2 * number:
        following = primes[-1] + 1
        while any(following % prime == 0 for prime in primes):
            following += 1
        primes.append(following)
    place = np.mod((np.arange(NODES)[:, None] + 0.5) * np.sqrt(primes), 1.0)
    place = np.clip(place, 1e-9, 1 - 1e-9)
    speckle = np.sqrt(-np.log(place[:, :number])) * np.exp(2j * np.pi * place[:, number:])
    speckle -= speckle.mean(axis=0)
    factor = np.linalg.cholesky(speckle.conj().T @ speckle / NODES)
    return speckle @ np.linalg.inv(factor).conj().T


@njit(cache=True, error_model="numpy")
def correlated_magnitudes(speckle, root):
    """Return magnitudes |A z| of correlated speckles, (m, N).

    ``speckle`` (m, k): independent speckles z; ``root`` (N, k): A, as of :meth:`LookSpeckle.root`.
    """
    magnitude = np.empty((speckle.shape[0], root.shape[0]))
    for i in range(speckle.shape[0]):
        for k in range(root.shape[0]):
            re, im = 0.0, 0.0
            for j in range(root.shape[1]):
                product = speckle[i, j] * root[k, j]
                re += product.real
                im += product.imag
            magnitude[i, k] = math.hypot(re, im)
    return magnitude


@njit(cache=True, error_model="numpy")
def votes_given_speckle(signal, level, votes, magnitude, is_real=False):
    """Return the probability that at least ``votes`` looks cross, given their speckle, (m,).

    Parameters
    ----------
    signal, level
        Root mean square signal and threshold of one look, over the noise per quadrature.
    votes
        Number of looks that have to cross.
    magnitude
        (m, N): magnitudes of the looks' speckle, of mean square 1.
    is_real
        The noise is real: it has the power of both quadratures in one.

    Notes
    -----
    Looks cross independently, with Q_1(signal |s_k|, level), or the tails of a normal variable. The
    number of crossings has a Poisson binomial distribution, summed up look by look.
    """
    crossing = np.empty(_Q_STEPS + 1)
    step = _SPECKLE_MAX / _Q_STEPS
    for k in range(_Q_STEPS + 1):
        faded = signal * k * step
        if is_real:
            above, below = math.erfc(0.5 * (level - faded)), math.erfc(0.5 * (level + faded))
            crossing[k] = 0.5 * (above + below)
        else:
            crossing[k] = marcum_q1_pair(faded, level)[0]
    enough, share = np.empty(magnitude.shape[0]), np.empty(votes + 1)
    for i in range(magnitude.shape[0]):
        share[:] = 0.0
        share[0] = 1.0
        for j in range(magnitude.shape[1]):
            place = min(magnitude[i, j] / step, _Q_STEPS - 1e-9)
            k = int(place)
            chance = crossing[k] + (place - k) * (crossing[k + 1] - crossing[k])
            share[votes] += share[votes - 1] * chance
            for v in range(votes - 1, 0, -1):
                share[v] = share[v] * (1.0 - chance) + share[v - 1] * chance
            share[0] *= 1.0 - chance
        enough[i] = share[votes]
    return enough
