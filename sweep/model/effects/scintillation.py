"""Scintillation: turbulent air makes the echo's power twinkle from shot to shot.

The strength of turbulence C_n^2(h) gives the Rytov variance of a plane or a spherical wave over the
path. This gives the variances of the logarithms of large and small eddies' factors, averaged over
an aperture, at any strength [Andrews and Phillips, Laser Beam Propagation through Random Media, 2nd
ed. 2005, ch. 9, 10; zero inner scale, infinite outer scale].

The irradiance, of unit mean, is the product of the two factors: log-normal (weak turbulence) or
each gamma-distributed, the gamma-gamma law of Al-Habash, Andrews and Phillips (Opt. Eng. 40, 2001),
for any strength.

The beam goes there and back. On the way out a plane wave twinkles on the target, averaged over the
footprint. On the way back a spherical wave twinkles in the receiver's aperture. The two are
independent. Their product multiplies the power of the whole echo, so its root the amplitudes, alike
in all segments of a shot (milliseconds). Eddies that both pass (enhanced backscatter of small rough
targets near the axis), the spreading of the beam and the loss of mixing are left out.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from sweep.model import beam
from sweep.model.effects.atmosphere import path_heights
from sweep.model.effects.effect import Effect, Parameter, Realisation, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.preparation import LASER, TELESCOPE, Shots

_ENDS = {"plane": (5 / 6, 0.0), "spherical": (5 / 6, 5 / 6)}
"""Powers of the distances to receiver and source in the integral over the path."""
_LARGE = {"plane": (0.65, 1.11), "spherical": (0.18, 0.56)}


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
    Gauss and Jacobi, which holds the powers exactly; paths may span 20 km of height. `wave` is
    ``plane`` or ``spherical``, all else in [m], (n,) or scalar; it starts at the wave's source.
    """
    share, weights = _rule(wave)
    h0, h1 = (np.asarray(h, float)[..., None] for h in (start_height, end_height))
    mean = (structure_constant(turbulence, h0 + (h1 - h0) * share) * weights).sum(axis=-1)
    k = 2 * math.pi / np.asarray(wavelength, float)
    return np.asarray(2.25 * k ** (7 / 6) * np.asarray(range, float) ** (11 / 6) * mean)


@lru_cache(maxsize=2)
def _rule(wave: str) -> tuple[np.ndarray, np.ndarray]:
    """Shares of the way from source to receiver and weights that hold the powers."""
    to_receiver, to_source = _ENDS[wave]
    x, weights = special.roots_jacobi(64, to_receiver, to_source)
    return (1 + x) / 2, weights / 2 ** (1 + to_receiver + to_source)


def log_variances(
    wave: str,
    *,
    rytov_variance: ArrayLike,
    wavelength: ArrayLike,
    range: ArrayLike,
    aperture: ArrayLike,
) -> LogVariances:
    """Log variances of the irradiance averaged over an aperture, by large and small eddies.

    exp(large + small) - 1 is the scintillation index: the Rytov variance for a point in weak
    turbulence, and 1 + 0.86 sigma_R^(-4/5) for a plane wave in strong. Because it serves any
    strength, the published fit averages too little over wide apertures. In weak turbulence it is
    1.3 times Kolmogorov's integral where k D^2 / 4 L is 1, and 2 (plane) or 1.5 (spherical) where
    it is 10. The Rytov variance is that of `wave`; the aperture's diameter [m] is 0 for a point.
    """
    v = np.asarray(rytov_variance, float)
    k = 2 * math.pi / np.asarray(wavelength, float)
    d2 = k * np.asarray(aperture, float) ** 2 / (4 * np.asarray(range, float))
    strength = v**1.2  # sigma_R^(12/5)
    by_aperture, by_strength = _LARGE[wave]
    large = 0.49 * v / (1 + by_aperture * d2 + by_strength * strength) ** (7 / 6)
    small = 0.51 * v * (1 + 0.69 * strength) ** (-5 / 6)
    return LogVariances(large, small / (1 + 0.90 * d2 + 0.62 * d2 * strength))


DISTRIBUTIONS = ("log_normal", "gamma_gamma")
_LEAST_SPREAD = 1e-5
_STEEPEST, _MOST_BENT = 0.5, 0.5
"""Suprema over a of |dQ_1(a, b)/d ln a| over 1 + b, and of its second derivative over 1 + b^2."""


def factors(
    distribution: str, legs: Sequence[LogVariances], realisation: Realisation
) -> np.ndarray:
    """Random factors of unit mean on the echo's power, (n,), of legs that are independent.

    Numbers 2 i and 2 i + 1 of the stream are leg i's large and small eddies, turned into factors
    by the inverse of their distribution.
    """
    from sweep.model import philox

    uniforms = philox.uniforms(realisation.keys, realisation.draw, philox.STREAM_SCINTILLATION, 4)
    total = np.ones(realisation.draw.size)
    for i, variance in enumerate(v for leg in legs for v in leg):
        total *= _inverse(distribution, uniforms[:, i], np.asarray(variance, float))
    return total


def _moments(distribution: str, legs: Sequence[LogVariances]) -> tuple[np.ndarray, np.ndarray]:
    """|E L| and E L^2, or more, of half the logarithm of the whole factor.

    A gamma law of shape 1/s has ln I of mean above -(s/2 + s^2/12) and a variance below
    s + s^2/2 + s^3/6, of the digamma function's and its derivative's enveloping series.
    """
    variances = [np.asarray(v, float) for leg in legs for v in leg]
    if distribution == "log_normal":
        spread = sum(variances)
        mean = spread / 2
    else:
        shapes = [np.expm1(v) for v in variances]
        mean = sum(s / 2 + s**2 / 12 for s in shapes)
        spread = sum(s + s**2 / 2 + s**3 / 6 for s in shapes)
    return np.asarray(mean / 2), np.asarray((mean**2 + spread) / 4)


def _inverse(distribution: str, chance: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Value that a factor of unit mean and this log variance falls below with a given probability.

    A gamma law of shape a has the variance 1/a = exp(log variance) - 1. Shapes beyond 1e5, which
    the library's inverse can get wrong, go by Wilson and Hilferty's cube of a normal number,
    there within 1e-3 standard deviations.
    """
    z = special.ndtri(chance)
    if distribution == "log_normal":
        return np.asarray(np.exp(np.sqrt(variance) * z - variance / 2))
    spread = np.expm1(variance)
    shape = 1 / np.maximum(spread, _LEAST_SPREAD)
    cube = (1 - spread / 9 + np.sqrt(spread) / 3 * z) ** 3
    return np.where(spread > _LEAST_SPREAD, special.gammaincinv(shape, chance) / shape, cube)


_TURBULENCE, _CONSTANT = "atmosphere.turbulence", "atmosphere.structure_constant"
_LAW = "atmosphere.scintillation_law"


def turbulence_of(p: Mapping[str, np.ndarray]) -> Turbulence | None:
    """Turbulence over height for points of one category; None in still air."""
    name = str(p[_TURBULENCE])
    if name == "uniform":
        return Turbulence(uniform=float(p[_CONSTANT]))
    return HUFNAGEL_VALLEY if name == "hufnagel_valley" else None


def both_ways(
    air: Turbulence, p: Mapping[str, np.ndarray], range: np.ndarray
) -> tuple[LogVariances, LogVariances]:
    """Log variances of the way out, averaged over the footprint, and back, over the aperture."""
    lidar, target = path_heights(p, range)
    aperture = np.asarray(p[TELESCOPE + "aperture"], float)
    footprint = aperture + beam.divergence(p) * range
    ways = (("plane", lidar, target, footprint), ("spherical", target, lidar, aperture))
    light = {"wavelength": p[LASER + "wavelength"], "range": range}
    out, back = (
        log_variances(
            wave,
            rytov_variance=rytov_variance(wave, air, start_height=start, end_height=end, **light),
            aperture=width,
            **light,
        )
        for wave, start, end, width in ways
    )
    return out, back


def size(points: Points) -> Size | None:
    """Change of mean probabilities by leaving twinkling out.

    With L half the logarithm of the factor I, E I = 1, and h the probability over the logarithm of
    the amplitude, |E h(x + L) - h(x)| <= sup h' |E L| + sup |h''| E L^2 / 2. In a product of
    segments, which twinkle alike, the suprema of two slopes, times E L^2, come on top.
    """
    if points.word(_TURBULENCE) == "none" or (air := turbulence_of(points.parameters)) is None:
        return None
    mean, square = _moments(points.word(_LAW), both_ways(air, points.parameters, points.range))
    b = points.threshold
    slope, bend = _STEEPEST * (1 + b), _MOST_BENT * (1 + b * b)
    each = slope * mean + 0.5 * (bend + slope**2) * square
    return Size(chance=np.minimum(len(points.signs) * each, 1.0))


def draw(shots: Shots, scene: Scene, realisation: Realisation) -> Shots:
    """Draw the scintillation of each shot's echo, the same in all its segments."""
    p = scene.parameters
    air = turbulence_of(p)
    if air is None:
        return shots
    legs = both_ways(air, p, shots.range)
    power = factors(str(p[_LAW]), legs, realisation)
    beat = power if shots.architecture == "direct" else np.sqrt(power)
    sources = shots.noise_sources
    if "signal_shot" in sources:
        sources = sources | {"signal_shot": sources["signal_shot"] * power}
    return replace(
        shots,
        echo_scale=shots.echo_scale * power,
        beat_scale=shots.beat_scale * beat,
        noise_sources=sources,
        pedestal=shots.pedestal * beat**2,
        pedestal_beside=shots.pedestal_beside * beat**2,
    )


SCINTILLATION = Effect(
    name="scintillation",
    about="an echo that twinkles in turbulent air",
    stage="draws",
    size=size,
    draw=draw,
    parameters=(
        Parameter(
            path=_TURBULENCE,
            about="Turbulence over height: none, even, or Hufnagel and Valley's 5/7 model",
            default="none",
            options=("none", "uniform", "hufnagel_valley"),
        ),
        Parameter(
            path=_CONSTANT,
            about="Structure constant of the refractive index of even turbulence",
            default=1e-14,
            example="1e-14 m^(-2/3)",
            limits=("0 m^(-2/3)", "100 m^(-2/3)"),
            category=True,
        ),
        Parameter(
            path=_LAW,
            about="Distribution of the irradiance",
            default="gamma_gamma",
            options=DISTRIBUTIONS,
        ),
    ),
)
