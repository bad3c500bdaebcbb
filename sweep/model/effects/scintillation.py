"""Scintillation: turbulent air makes the echo's power twinkle from shot to shot.

The strength of turbulence C_n^2(h) gives the Rytov variance of a plane or a spherical wave over
the path, and this the variances of the logarithms of large and small eddies' factors, averaged
over an aperture, at any strength [Andrews and Phillips, Laser Beam Propagation through Random
Media, 2nd ed. 2005, ch. 9, 10; zero inner scale, infinite outer scale]. The irradiance, of unit
mean, is the product of both factors: log-normal (weak turbulence) or each gamma-distributed, the
gamma-gamma law of Al-Habash, Andrews and Phillips (Opt. Eng. 40, 2001), for any strength.

The beam goes there and back. What is taken: on the way out a plane wave twinkles on the target,
averaged over the footprint; on the way back a spherical wave twinkles in the receiver's aperture;
the two are independent, and their product multiplies the power of the whole echo, so its root the
amplitudes, alike in all segments of a shot (milliseconds). That they pass the same eddies, which
a small rough target next to the axis would show as enhanced backscatter, is left out; so is the
spreading of the beam and the loss of mixing over the aperture.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from scipy import special

from sweep.model import philox
from sweep.model.effects.change import Change
from sweep.model.marcum import marcum_q1

DISTRIBUTIONS = ("log_normal", "gamma_gamma")
WAVES = ("plane", "spherical")

_ENDS = {"plane": (5 / 6, 0.0), "spherical": (5 / 6, 5 / 6)}
"""Powers of the distances to receiver and source in the integral over the path."""
_LARGE = {"plane": (0.65, 1.11), "spherical": (0.18, 0.56)}
_CHANCES = np.array([1e-12, 1e-9, 1e-6, 1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.2, 0.35, 0.5])
_LEAST_SPREAD = 1e-5


class Turbulence(NamedTuple):
    """Profile of the refractive index's structure constant over height above the ground."""

    uniform: float = 0.0
    """Part that is the same at all heights [m^(-2/3)]: alone, a constant C_n^2."""
    surface: float = 0.0
    """Hufnagel and Valley's A [m^(-2/3)] on the ground, e-folding over 100 m: 1.7e-14."""
    wind: float = 0.0
    """Their rms wind speed aloft [m/s]: 21."""
    middle: float = 0.0
    """Their [m^(-2/3)] of e-folding height 1500 m: 2.7e-16."""


HUFNAGEL_VALLEY = Turbulence(surface=1.7e-14, wind=21.0, middle=2.7e-16)
"""The 5/7 model: at 0.5 um 5 cm of coherence and 7 urad of isoplanatic angle [Valley 1980]."""


class LogVariances(NamedTuple):
    """Variances of the logarithm of the irradiance by large and by small eddies, (n,) each."""

    large: np.ndarray
    small: np.ndarray


def structure_constant(turbulence: Turbulence, height: ArrayLike) -> np.ndarray:
    """C_n^2 [m^(-2/3)] at heights above the ground [m]; below the ground that on it."""
    h = np.maximum(np.asarray(height, float), 0.0)
    aloft = 0.00594 * (turbulence.wind / 27) ** 2 * (1e-5 * h) ** 10 * np.exp(-h / 1e3)
    middle = turbulence.middle * np.exp(-h / 1.5e3)
    return turbulence.uniform + aloft + middle + turbulence.surface * np.exp(-h / 100)


def rytov_variance(
    wave: str,
    turbulence: Turbulence,
    *,
    wavelength: ArrayLike,
    range: ArrayLike,
    start_height: ArrayLike,
    end_height: ArrayLike,
) -> np.ndarray:
    """Variance of the log irradiance of weak turbulence along a straight path, (n,).

    2.25 k^(7/6) integral of C_n^2 (L - z)^(5/6) [(z/L)^(5/6) for a spherical wave] over z from
    source to receiver; 1.23 and 0.50 C_n^2 k^(7/6) L^(11/6) in even turbulence. By a rule of
    Gauss and Jacobi, which holds the powers exactly; paths may span 20 km of height.

    Parameters
    ----------
    wave : str
        ``plane`` or ``spherical``.
    wavelength, range, start_height, end_height : array_like
        [m], (n,) or scalar; start is the wave's source.
    """
    to_receiver, to_source = _ENDS[wave]
    x, weights = special.roots_jacobi(64, to_receiver, to_source)
    share = (1 + x) / 2
    weights = weights / 2 ** (1 + to_receiver + to_source)
    h0, h1 = (np.asarray(h, float)[..., None] for h in (start_height, end_height))
    mean = (structure_constant(turbulence, h0 + (h1 - h0) * share) * weights).sum(axis=-1)
    k = 2 * math.pi / np.asarray(wavelength, float)
    return np.asarray(2.25 * k ** (7 / 6) * np.asarray(range, float) ** (11 / 6) * mean)


def log_variances(
    wave: str,
    *,
    rytov_variance: ArrayLike,
    wavelength: ArrayLike,
    range: ArrayLike,
    aperture: ArrayLike,
) -> LogVariances:
    """What large and small eddies make of the irradiance averaged over an aperture.

    exp(large + small) - 1 is the scintillation index: the Rytov variance for a point in weak
    turbulence, and 1 + 0.86 sigma_R^(-4/5) for a plane wave in strong. As it serves any strength
    the published fit averages too little over wide apertures: in weak turbulence it is 1.3 times
    Kolmogorov's integral where k D^2 / 4 L is 1, and 2 (plane) or 1.5 (spherical) where it is 10.

    Parameters
    ----------
    wave : str
        ``plane`` or ``spherical``.
    rytov_variance : array_like
        Of that wave, >= 0, (n,) or scalar, as all.
    wavelength, range, aperture : array_like
        [m]; the diameter of the aperture that averages, 0 for a point.
    """
    v = np.asarray(rytov_variance, float)
    k = 2 * math.pi / np.asarray(wavelength, float)
    d2 = k * np.asarray(aperture, float) ** 2 / (4 * np.asarray(range, float))
    strength = v**1.2  # sigma_R^(12/5)
    by_aperture, by_strength = _LARGE[wave]
    large = 0.49 * v / (1 + by_aperture * d2 + by_strength * strength) ** (7 / 6)
    small = 0.51 * v * (1 + 0.69 * strength) ** (-5 / 6)
    return LogVariances(large, small / (1 + 0.90 * d2 + 0.62 * d2 * strength))


def both_ways(
    turbulence: Turbulence,
    *,
    wavelength: ArrayLike,
    range: ArrayLike,
    lidar_height: ArrayLike,
    target_height: ArrayLike,
    aperture: ArrayLike,
    beam_divergence: ArrayLike,
) -> tuple[LogVariances, LogVariances]:
    """Log variances of the way out, averaged over the footprint, and back, over the aperture."""
    out = rytov_variance(
        "plane", turbulence, wavelength=wavelength, range=range,
        start_height=lidar_height, end_height=target_height,
    )  # fmt: skip
    back = rytov_variance(
        "spherical", turbulence, wavelength=wavelength, range=range,
        start_height=target_height, end_height=lidar_height,
    )  # fmt: skip
    footprint = np.asarray(aperture, float) + np.asarray(beam_divergence, float) * range
    return (
        log_variances(
            "plane", rytov_variance=out, wavelength=wavelength, range=range, aperture=footprint
        ),
        log_variances(
            "spherical", rytov_variance=back, wavelength=wavelength, range=range, aperture=aperture
        ),
    )


def index(legs: Sequence[LogVariances]) -> np.ndarray:
    """Variance of the whole factor of unit mean, exp(sum of log variances) - 1, for either law."""
    return np.expm1(sum(leg.large + leg.small for leg in legs))


def factors(
    distribution: str,
    legs: Sequence[LogVariances],
    *,
    keys: np.ndarray,
    first_draw: int,
    draws: int,
) -> np.ndarray:
    """Random factors of unit mean on the echo's power, (n, draws).

    Numbers 2 i and 2 i + 1 of the stream are leg i's large and small eddies, turned into factors
    by the inverse of their distribution.

    Parameters
    ----------
    distribution : str
        ``log_normal`` or ``gamma_gamma``.
    legs : sequence of LogVariances
        Those of one to two ways, (n,) each or scalar; they are independent.
    keys : (n, 2) uint64
        Random key of each point.
    first_draw, draws : int
        Number of the first draw, and how many.
    """
    uniforms = np.empty((len(keys), draws, 4))
    _fill(keys, first_draw, uniforms)
    total = np.ones(uniforms.shape[:2])
    for i, variance in enumerate(_parts(legs, len(keys))):
        total *= _inverse(distribution, uniforms[..., i], variance[:, None])
    return total


def bound(distribution: str, legs: Sequence[LogVariances], *, chance: float = 1e-6) -> Change:
    """Interval that a bin's magnitude leaves with no more than a chance, (n,).

    Where f, the probability of detection, rises with the magnitude, its mean over the factors is
    within f at the ends of the interval, but for the chance: the mean changes by no more than
    ``pd_change`` of this and ``chance`` on top.

    Parameters
    ----------
    distribution, legs
        As of :func:`factors`.
    chance : float
        0 < . < 1, for both sides together.
    """
    low, high = _interval(distribution, legs, np.array(chance / 2))
    return Change(signal=(np.sqrt(low), np.sqrt(high)))


def mean_pd_bound(
    distribution: str,
    legs: Sequence[LogVariances],
    *,
    amplitudes: Sequence[ArrayLike],
    threshold: ArrayLike,
) -> np.ndarray:
    """Bound on how far the mean probability of detection lies from that of the mean echo, (n,).

    f(I) is the product over segments of Q_1(a sqrt(I), b), and E I = 1. Three bounds hold, and
    the least is taken:

    - f is smooth and the factor's mean is 1, so |E f(I) - f(1)| <= sup|f''| Var(I) / 2. With
      s = a^2 I / 2 and y = b^2 / 2, Q_1 is the mean over k ~ Poisson(s) of P(Poisson(y) <= k),
      each derivative by s a difference in k: with p the law of Poisson(y), 0 <= dQ_1/ds <=
      max_{j>=1} p(j) and |d^2Q_1/ds^2| <= max_{j>=1} |p(j+1) - p(j)|.
    - f rises, so the mean falls by at most f(1) - (1 - e) f(q) with P(I < q) <= e, for any e;
    - and rises by at most (1 - e) f(q') + e - f(1) with P(I > q') <= e.

    Parameters
    ----------
    distribution, legs
        As of :func:`factors`.
    amplitudes : sequence of array_like
        Magnitude of the detecting bin without scintillation over the noise's standard deviation
        in a quadrature, >= 0, for each segment that must detect: one for its own probability, up
        and down for the shot's.
    threshold : array_like
        Threshold over the same deviation, >= 0.
    """
    a, b = [np.asarray(v, float) for v in amplitudes], np.asarray(threshold, float)
    slope, bend = _steepest(b * b / 2)
    gains = [v * v / 2 for v in a]
    squares = sum(gain * gain for gain in gains)
    curvature = bend * squares + slope**2 * (sum(gains) ** 2 - squares)
    smooth = 0.5 * curvature * index(legs)
    low, high = _interval(distribution, legs, _CHANCES)

    def pd(factor: np.ndarray | float) -> np.ndarray:
        root = np.sqrt(factor)
        chances = [marcum_q1(v[..., None] * root, b[..., None]).q for v in a]
        return np.asarray(np.prod(np.broadcast_arrays(*chances), axis=0))

    without = pd(1.0)
    fall = (without - (1 - _CHANCES) * pd(low)).min(axis=-1)
    rise = ((1 - _CHANCES) * pd(high) + _CHANCES - without).min(axis=-1)
    return np.minimum(smooth, np.maximum(np.maximum(fall, rise), 0.0))


def _steepest(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Largest p(j) and largest |p(j+1) - p(j)| over whole j >= 1, p(j) = exp(-y) y^j / j!.

    p is largest at the whole part of y, and its difference extreme where the second one changes
    sign, at j = y - 3/2 +- sqrt(y + 1/4).
    """
    largest = _poisson(np.maximum(np.floor(y), 1.0), y)
    turn = np.sqrt(y + 0.25)
    steepest = np.zeros(np.shape(y))
    for place in (y - 1.5 - turn, y - 1.5 + turn):
        for shift in (-1, 0, 1, 2):
            j = np.maximum(np.floor(place) + shift, 1.0)
            steepest = np.maximum(steepest, _poisson(j, y) * np.abs(y / (j + 1) - 1))
    return largest, steepest


def _poisson(j: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(np.exp(special.xlogy(j, y) - y - special.gammaln(j + 1)))


def _interval(
    distribution: str, legs: Sequence[LogVariances], chance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ends that the whole factor leaves with no more than `chance` to each side.

    Exact for the log-normal law. A product of independent factors is below the product of their
    quantiles only where one of them is below its own: the chance is shared among them.
    """
    if distribution == "log_normal":
        variance = sum(leg.large + leg.small for leg in legs)
        parts: list[ArrayLike] = [variance]
    else:
        parts = [variance for leg in legs for variance in leg]
    each = chance / len(parts)
    low, high = np.ones(1), np.ones(1)
    for part in parts:
        column = np.asarray(part, float)
        column = column[..., None] if chance.ndim else column
        low = low * _inverse(distribution, each, column)
        high = high * _inverse(distribution, each, column, upper=True)
    return low, high


def _parts(legs: Sequence[LogVariances], size: int) -> list[np.ndarray]:
    return [np.broadcast_to(np.asarray(v, float), size) for leg in legs for v in leg]


def _inverse(
    distribution: str, chance: np.ndarray, variance: np.ndarray, *, upper: bool = False
) -> np.ndarray:
    """Value that a factor of unit mean and this log variance falls below (exceeds) by chance.

    A gamma law of shape a has the variance 1/a = exp(log variance) - 1. Shapes beyond 1e5, which
    the library's inverse can get wrong, go by Wilson and Hilferty's cube of a normal number,
    there within 1e-3 standard deviations.
    """
    z = special.ndtri(chance) * (-1.0 if upper else 1.0)
    if distribution == "log_normal":
        return np.asarray(np.exp(np.sqrt(variance) * z - variance / 2))
    if distribution != "gamma_gamma":
        raise ValueError(
            f"no distribution {distribution!r}: take one of {', '.join(DISTRIBUTIONS)}"
        )
    spread = np.expm1(variance)
    shape = 1 / np.maximum(spread, _LEAST_SPREAD)
    inverse = special.gammainccinv if upper else special.gammaincinv
    cube = (1 - spread / 9 + np.sqrt(spread) / 3 * z) ** 3
    return np.where(spread > _LEAST_SPREAD, inverse(shape, chance) / shape, cube)


@njit(cache=True)
def _fill(keys, first_draw, out):
    """The first four uniforms of the stream for points and draws, out (n, draws, 4)."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = philox.uniform4(
                keys[i, 0], keys[i, 1], first_draw + j, philox.STREAM_SCINTILLATION, 0
            )
