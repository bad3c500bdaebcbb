"""Scintillation: turbulent air makes the echo's power twinkle from shot to shot.

The irradiance, of unit mean, is the product of a factor by large and one by small eddies, whose
log variances :mod:`sweep.model.effects.turbulence` gives: log-normal (weak turbulence) or each
gamma-distributed, the gamma-gamma law of Al-Habash, Andrews and Phillips (Opt. Eng. 40, 2001), for
any strength.

The beam goes there and back. What is taken: on the way out a plane wave twinkles on the target,
averaged over the footprint; on the way back a spherical wave twinkles in the receiver's aperture;
the two are independent, and their product multiplies the power of the whole echo, so its root the
amplitudes, alike in all segments of a shot (milliseconds). That they pass the same eddies, which
a small rough target next to the axis would show as enhanced backscatter, is left out; so is the
spreading of the beam and the loss of mixing over the aperture.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from sweep.model import philox
from sweep.model.effects.atmosphere import path_heights
from sweep.model.effects.effect import Effect, Parameter, Realisation, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.effects.turbulence import (
    HUFNAGEL_VALLEY,
    LogVariances,
    Turbulence,
    both_ways,
)
from sweep.model.preparation import Shots

DISTRIBUTIONS = ("log_normal", "gamma_gamma")
_LEAST_SPREAD = 1e-5
_STEEPEST, _MOST_BENT = 0.5, 0.5
"""Suprema over a of |dQ_1(a, b)/d ln a| over 1 + b, and of its second derivative over 1 + b^2."""


def factors(
    distribution: str, legs: Sequence[LogVariances], realisation: Realisation
) -> np.ndarray:
    """Random factors of unit mean on the echo's power, (n,).

    Numbers 2 i and 2 i + 1 of the stream are leg i's large and small eddies, turned into factors
    by the inverse of their distribution.

    Parameters
    ----------
    distribution : str
        ``log_normal`` or ``gamma_gamma``.
    legs : sequence of LogVariances
        Those of one to two ways, (n,) each or scalar; they are independent.
    realisation : Realisation
        Which draws.
    """
    uniforms = philox.uniforms(realisation.keys, realisation.draw, philox.STREAM_SCINTILLATION, 4)
    total = np.ones(realisation.draw.size)
    for i, variance in enumerate(_parts(legs, total.size)):
        total *= _inverse(distribution, uniforms[:, i], variance)
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


_TURBULENCE, _CONSTANT = "atmosphere.turbulence", "atmosphere.structure_constant"
_LAW = "atmosphere.scintillation_law"


def turbulence_of(p: Mapping[str, np.ndarray]) -> Turbulence | None:
    """Turbulence over height for points of one category; None in still air."""
    name = str(p[_TURBULENCE])
    if name == "uniform":
        return Turbulence(uniform=float(p[_CONSTANT]))
    return HUFNAGEL_VALLEY if name == "hufnagel_valley" else None


def _legs(
    air: Turbulence, p: Mapping[str, np.ndarray], range: np.ndarray
) -> tuple[LogVariances, LogVariances]:
    """Log variances of points by their parameters."""
    lidar, target = path_heights(p, range)
    return both_ways(
        air,
        wavelength=p["instrument.laser.wavelength"],
        range=range,
        lidar_height=lidar,
        target_height=target,
        aperture=p["instrument.telescope.aperture"],
        beam_divergence=p["instrument.laser.beam_divergence"],
    )


def size(points: Points) -> Size | None:
    """What leaving twinkling out changes of mean probabilities.

    With L half the logarithm of the factor I, E I = 1, and h the probability over the logarithm of
    the amplitude, |E h(x + L) - h(x)| <= sup h' |E L| + sup |h''| E L^2 / 2; in a product of
    segments, which twinkle alike, the suprema of two slopes, times E L^2, come on top.
    """
    if points.word(_TURBULENCE) == "none" or (air := turbulence_of(points.parameters)) is None:
        return None
    mean, square = _moments(points.word(_LAW), _legs(air, points.parameters, points.range))
    b = points.threshold
    slope, bend = _STEEPEST * (1 + b), _MOST_BENT * (1 + b * b)
    each = slope * mean + 0.5 * (bend + slope**2) * square
    return Size(chance=np.minimum(len(points.signs) * each, 1.0))


def draw(shots: Shots, scene: Scene, realisation: Realisation) -> Shots:
    """An echo that twinkles, alike in all segments of a shot."""
    p = scene.parameters
    air = turbulence_of(p)
    if air is None:
        return shots
    legs = _legs(air, p, shots.range)
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
    )


EFFECT = Effect(
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
            si_unit="m^(-2/3)",
            default=1e-14,
            example="1e-14 m^(-2/3)",
            at_least="0 m^(-2/3)",
            at_most="100 m^(-2/3)",
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
