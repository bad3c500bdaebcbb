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
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from scipy import special

from sweep.model import philox
from sweep.model.effects.atmosphere import path_heights, path_of
from sweep.model.effects.change import Mean
from sweep.model.effects.effect import Effect, Parameter, Realisation, Scene
from sweep.model.effects.span import Span
from sweep.model.effects.turbulence import (
    HUFNAGEL_VALLEY,
    LogVariances,
    Turbulence,
    both_ways,
    largest_both_ways,
)
from sweep.model.marcum import marcum_q1
from sweep.model.preparation import Shots

if TYPE_CHECKING:
    from sweep.model.effects.block import Block

DISTRIBUTIONS = ("log_normal", "gamma_gamma")
_CHANCES = np.array([1e-9, 1e-6, 1e-4, 1e-2])
_HUGE = 1e9
_LEAST_SPREAD = 1e-5


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
    uniforms = np.empty((realisation.draw.size, 4))
    _fill(realisation.keys, realisation.draw, uniforms)
    total = np.ones(realisation.draw.size)
    for i, variance in enumerate(_parts(legs, total.size)):
        total *= _inverse(distribution, uniforms[:, i], variance)
    return total


def mean_pd_bound(
    distribution: str, legs: Sequence[LogVariances], *, amplitude: Span, threshold: Span
) -> np.ndarray:
    """Bound on how far means of probabilities of detection lie from those of the mean echo, (k, n).

    Their sum bounds that of the product of segments, which twinkle alike. With L half the
    logarithm of the factor I, E I = 1, and h the probability over the logarithm of the amplitude,
    the lesser of two bounds is taken:

    - |E h(x + L) - h(x)| <= sup h' |E L| + sup |h''| E L^2 / 2, whatever the amplitude; in a
      product the suprema of two slopes, times E L^2, come on top;
    - h rises, so the mean falls by at most h - (1 - e) h(q) with P(I < q) <= e, for any e, and
      rises by at most (1 - e) h(q') + e - h with P(I > q') <= e; both may happen in a product.

    Parameters
    ----------
    distribution, legs
        As of :func:`factors`, (n,).
    amplitude : Span
        Magnitude of the detecting bin without scintillation over the noise's standard deviation
        in a quadrature, >= 0, (k, n) by segment.
    threshold : Span
        Threshold over the same deviation, >= 0, (n,).
    """
    mean, square = _moments(distribution, legs)
    slope, bend = steepest(np.asarray(threshold.high))
    smooth = slope * mean + 0.5 * (bend + slope**2) * square
    low, high = _interval(distribution, legs, _CHANCES)
    a, b = (
        Span(np.minimum(v.low, _HUGE)[..., None], np.minimum(v.high, _HUGE)[..., None])
        for v in (amplitude, threshold)
    )
    least, most = marcum_q1(a.low, b.high).q, marcum_q1(a.high, b.low).q
    fall = most - (1 - _CHANCES) * marcum_q1(a.low * np.sqrt(low), b.high).q
    rise = (1 - _CHANCES) * marcum_q1(a.high * np.sqrt(high), b.low).q + _CHANCES - least
    apart = np.maximum(fall.min(axis=-1), 0.0) + np.maximum(rise.min(axis=-1), 0.0)
    return np.minimum(smooth, apart)


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


def steepest(threshold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Largest |h'| and |h''| of h(x) = Q_1(e^x, b) over all x, for thresholds up to b.

    h' = g = z I_1(z) e^{-(a^2 + b^2)/2}, z = a b, and h'' = g (z I_0(z) / I_1(z) - a^2).
    """
    place, slopes, bends = _steepest_table()
    b = np.asarray(threshold, float)
    slope, bend = (np.interp(b, place, values) for values in (slopes, bends))
    return slope * (1 + b), bend * (1 + b * b)


@lru_cache(maxsize=1)
def _steepest_table() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Thresholds, and the suprema over 1 + b and 1 + b^2, with 2 % for what lies between."""
    b = np.linspace(0.0, 40.0, 161)[:, None]
    a = np.maximum(b + np.linspace(-8.0, 8.0, 801), 1e-3)
    z = np.maximum(a * b, 1e-12)
    first, zeroth = special.ive(1, z), special.ive(0, z)
    slope = z * first * np.exp(-((a - b) ** 2) / 2)
    bend = np.abs(slope * (z * zeroth / first - a * a))
    found = [
        1.02 * np.maximum.accumulate(v.max(axis=1)) / (1 + b[:, 0] ** power)
        for power, v in ((1, slope), (2, bend))
    ]
    return b[:, 0], found[0], found[1]


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
def _fill(keys, draw, out):
    """The first four uniforms of the stream for each point's draw, out (n, 4)."""
    for i in range(draw.size):
        out[i] = philox.uniform4(keys[i, 0], keys[i, 1], draw[i], philox.STREAM_SCINTILLATION, 0)


_TURBULENCE, _CONSTANT = "atmosphere.turbulence", "atmosphere.structure_constant"
_LAW = "atmosphere.scintillation_law"


def turbulence_of(p: Mapping[str, np.ndarray]) -> Turbulence | None:
    """Turbulence over height for points of one category; None in still air."""
    name = str(p[_TURBULENCE])
    if name == "uniform":
        return Turbulence(uniform=float(p[_CONSTANT]))
    return HUFNAGEL_VALLEY if name == "hufnagel_valley" else None


def bound(block: "Block") -> Mean | None:
    """What leaving twinkling out can change of mean probabilities."""
    if block.word(_TURBULENCE) == "none":
        return None
    numbers = {_CONSTANT: np.ravel(block[_CONSTANT].low)[0]}
    air = turbulence_of(numbers | {_TURBULENCE: block.word(_TURBULENCE)})
    if air is None:
        return None
    legs = largest_both_ways(
        air,
        wavelength=block["instrument.laser.wavelength"],
        path=path_of(block),
        aperture=block["instrument.telescope.aperture"],
        beam_divergence=block["instrument.laser.beam_divergence"],
    )
    law = block.word(_LAW)

    def change(amplitude: Span, threshold: Span) -> np.ndarray:
        return mean_pd_bound(law, legs, amplitude=amplitude, threshold=threshold)

    return Mean(change)


def draw(shots: Shots, scene: Scene, realisation: Realisation) -> Shots:
    """An echo that twinkles, alike in all segments of a shot."""
    p = scene.parameters
    air = turbulence_of(p)
    if air is None:
        return shots
    lidar, target = path_heights(p, shots.range)
    legs = both_ways(
        air,
        wavelength=p["instrument.laser.wavelength"],
        range=shots.range,
        lidar_height=lidar,
        target_height=target,
        aperture=p["instrument.telescope.aperture"],
        beam_divergence=p["instrument.laser.beam_divergence"],
    )
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
    bound=bound,
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
