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
from sweep.model.effects.effect import DrawAddresses, Effect, EffectContext, ErrorBound, Parameter
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.preparation import LASER_PREFIX, TELESCOPE_PREFIX, Shots

_DISTANCE_EXPONENTS = {"plane": (5 / 6, 0.0), "spherical": (5 / 6, 5 / 6)}
"""Powers of the distances to receiver and source in the integral over the path."""
_LARGE_EDDY_COEFFICIENTS = {"plane": (0.65, 1.11), "spherical": (0.18, 0.56)}


class TurbulenceProfile(NamedTuple):
    """Profile of the refractive index's structure constant over height above the ground."""

    uniform: float = 0.0
    """Part that is the same at all heights [m^(-2/3)]: alone, a constant C_n^2."""
    surface_layer: float = 0.0
    """Hufnagel and Valley's A [m^(-2/3)] on the ground, e-folding over 100 m: 1.7e-14."""
    wind_speed: float = 0.0
    """Their rms wind speed aloft [m/s]: 21."""
    mid_altitude: float = 0.0
    """Their [m^(-2/3)] of e-folding height 1500 m: 2.7e-16."""


HUFNAGEL_VALLEY = TurbulenceProfile(surface_layer=1.7e-14, wind_speed=21.0, mid_altitude=2.7e-16)
"""The 5/7 model: at 0.5 um 5 cm of coherence and 7 urad of isoplanatic angle [Valley 1980]."""


class LogIrradianceVariances(NamedTuple):
    """Variances of the logarithm of the irradiance by large and by small eddies, (n,) each."""

    large_eddies: np.ndarray
    small_eddies: np.ndarray


def structure_constant(turbulence: TurbulenceProfile, height: ArrayLike) -> np.ndarray:
    """C_n^2 [m^(-2/3)] at heights above the ground [m]; below the ground that on it."""
    h = np.maximum(np.asarray(height, float), 0.0)
    aloft = 0.00594 * (turbulence.wind_speed / 27) ** 2 * (1e-5 * h) ** 10 * np.exp(-h / 1e3)
    mid_altitude = turbulence.mid_altitude * np.exp(-h / 1.5e3)
    return turbulence.uniform + aloft + mid_altitude + turbulence.surface_layer * np.exp(-h / 100)


def rytov_variance(
    wave: str,
    turbulence: TurbulenceProfile,
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
    path_fraction, weights = _path_quadrature(wave)
    h0, h1 = (np.asarray(h, float)[..., None] for h in (start_height, end_height))
    mean_structure_constant = (
        structure_constant(turbulence, h0 + (h1 - h0) * path_fraction) * weights
    ).sum(axis=-1)
    wavenumber = 2 * math.pi / np.asarray(wavelength, float)
    return np.asarray(
        2.25
        * wavenumber ** (7 / 6)
        * np.asarray(range, float) ** (11 / 6)
        * mean_structure_constant
    )


@lru_cache(maxsize=2)
def _path_quadrature(wave: str) -> tuple[np.ndarray, np.ndarray]:
    """Shares of the way from source to receiver and weights that hold the powers."""
    to_receiver, to_source = _DISTANCE_EXPONENTS[wave]
    nodes, weights = special.roots_jacobi(64, to_receiver, to_source)
    return (1 + nodes) / 2, weights / 2 ** (1 + to_receiver + to_source)


def log_irradiance_variances(
    wave: str,
    *,
    rytov_variance: ArrayLike,
    wavelength: ArrayLike,
    range: ArrayLike,
    aperture: ArrayLike,
) -> LogIrradianceVariances:
    """Log variances of the irradiance averaged over an aperture, by large and small eddies.

    exp(large + small) - 1 is the scintillation index: the Rytov variance for a point in weak
    turbulence, and 1 + 0.86 sigma_R^(-4/5) for a plane wave in strong. Because it serves any
    strength, the published fit averages too little over wide apertures. In weak turbulence it is
    1.3 times Kolmogorov's integral where k D^2 / 4 L is 1, and 2 (plane) or 1.5 (spherical) where
    it is 10. The Rytov variance is that of `wave`; the aperture's diameter [m] is 0 for a point.
    """
    rytov = np.asarray(rytov_variance, float)
    wavenumber = 2 * math.pi / np.asarray(wavelength, float)
    aperture_ratio = wavenumber * np.asarray(aperture, float) ** 2 / (4 * np.asarray(range, float))
    strength = rytov**1.2  # sigma_R^(12/5)
    aperture_coefficient, strength_coefficient = _LARGE_EDDY_COEFFICIENTS[wave]
    large_eddies = (
        0.49
        * rytov
        / (1 + aperture_coefficient * aperture_ratio + strength_coefficient * strength) ** (7 / 6)
    )
    small_eddies = 0.51 * rytov * (1 + 0.69 * strength) ** (-5 / 6)
    return LogIrradianceVariances(
        large_eddies, small_eddies / (1 + 0.90 * aperture_ratio + 0.62 * aperture_ratio * strength)
    )


IRRADIANCE_DISTRIBUTIONS = ("log_normal", "gamma_gamma")
_GAMMA_VARIANCE_MIN = 1e-5
_PD_SLOPE_MAX, _PD_CURVATURE_MAX = 0.5, 0.5
"""Suprema over a of |dQ_1(a, b)/d ln a| over 1 + b, and of its second derivative over 1 + b^2."""


def draw_scintillation_factors(
    distribution: str, legs: Sequence[LogIrradianceVariances], draw_addresses: DrawAddresses
) -> np.ndarray:
    """Random factors of unit mean on the echo's power, (n,), of legs that are independent.

    Numbers 2 i and 2 i + 1 of the stream are leg i's large and small eddies, turned into factors
    by the inverse of their distribution.
    """
    from sweep.model.sampling import philox

    uniform_draws = philox.uniforms(
        draw_addresses.point_keys, draw_addresses.draw_numbers, philox.STREAM_SCINTILLATION, 4
    )
    factor = np.ones(draw_addresses.draw_numbers.size)
    for i, variance in enumerate(v for leg in legs for v in leg):
        factor *= _inverse_distribution(
            distribution, uniform_draws[:, i], np.asarray(variance, float)
        )
    return factor


def _log_amplitude_moments(
    distribution: str, legs: Sequence[LogIrradianceVariances]
) -> tuple[np.ndarray, np.ndarray]:
    """|E L| and E L^2, or more, of half the logarithm of the whole factor.

    A gamma law of shape 1/s has ln I of mean above -(s/2 + s^2/12) and a variance below
    s + s^2/2 + s^3/6, of the digamma function's and its derivative's enveloping series.
    """
    variances = [np.asarray(v, float) for leg in legs for v in leg]
    if distribution == "log_normal":
        variance = sum(variances)
        mean = variance / 2
    else:
        gamma_variances = [np.expm1(v) for v in variances]
        mean = sum(s / 2 + s**2 / 12 for s in gamma_variances)
        variance = sum(s + s**2 / 2 + s**3 / 6 for s in gamma_variances)
    return np.asarray(mean / 2), np.asarray((mean**2 + variance) / 4)


def _inverse_distribution(
    distribution: str, probability: np.ndarray, variance: np.ndarray
) -> np.ndarray:
    """Value that a factor of unit mean and this log variance falls below with a given probability.

    A gamma law of shape a has the variance 1/a = exp(log variance) - 1. Shapes beyond 1e5, which
    the library's inverse can get wrong, go by Wilson and Hilferty's cube of a normal number,
    there within 1e-3 standard deviations.
    """
    normal_quantile = special.ndtri(probability)
    if distribution == "log_normal":
        return np.asarray(np.exp(np.sqrt(variance) * normal_quantile - variance / 2))
    gamma_variance = np.expm1(variance)
    gamma_shape = 1 / np.maximum(gamma_variance, _GAMMA_VARIANCE_MIN)
    normal_approximation = (
        1 - gamma_variance / 9 + np.sqrt(gamma_variance) / 3 * normal_quantile
    ) ** 3
    return np.where(
        gamma_variance > _GAMMA_VARIANCE_MIN,
        special.gammaincinv(gamma_shape, probability) / gamma_shape,
        normal_approximation,
    )


_TURBULENCE_PATH, _STRUCTURE_CONSTANT_PATH = (
    "atmosphere.turbulence",
    "atmosphere.structure_constant",
)
_DISTRIBUTION_PATH = "atmosphere.scintillation_law"


def turbulence_profile(parameters: Mapping[str, np.ndarray]) -> TurbulenceProfile | None:
    """Turbulence over height for points of one category; None in still air."""
    name = str(parameters[_TURBULENCE_PATH])
    if name == "uniform":
        return TurbulenceProfile(uniform=float(parameters[_STRUCTURE_CONSTANT_PATH]))
    return HUFNAGEL_VALLEY if name == "hufnagel_valley" else None


def two_way_log_variances(
    turbulence: TurbulenceProfile, parameters: Mapping[str, np.ndarray], range: np.ndarray
) -> tuple[LogIrradianceVariances, LogIrradianceVariances]:
    """Log variances of the way out, averaged over the footprint, and back, over the aperture."""
    lidar_height, target_height = path_heights(parameters, range)
    aperture = np.asarray(parameters[TELESCOPE_PREFIX + "aperture"], float)
    footprint_diameter = aperture + beam.far_field_divergence(parameters) * range
    legs = (
        ("plane", lidar_height, target_height, footprint_diameter),
        ("spherical", target_height, lidar_height, aperture),
    )
    common_inputs = {"wavelength": parameters[LASER_PREFIX + "wavelength"], "range": range}
    out, back = (
        log_irradiance_variances(
            wave,
            rytov_variance=rytov_variance(
                wave, turbulence, start_height=start, end_height=end, **common_inputs
            ),
            aperture=diameter,
            **common_inputs,
        )
        for wave, start, end, diameter in legs
    )
    return out, back


def error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Change of mean probabilities by leaving twinkling out.

    With L half the logarithm of the factor I, E I = 1, and h the probability over the logarithm of
    the amplitude, |E h(x + L) - h(x)| <= sup h' |E L| + sup |h''| E L^2 / 2. In a product of
    segments, which twinkle alike, the suprema of two slopes, times E L^2, come on top.
    """
    if (
        points.option(_TURBULENCE_PATH) == "none"
        or (turbulence := turbulence_profile(points.parameters)) is None
    ):
        return None
    mean_log_amplitude, mean_square = _log_amplitude_moments(
        points.option(_DISTRIBUTION_PATH),
        two_way_log_variances(turbulence, points.parameters, points.range),
    )
    threshold_ratio = points.threshold_ratio
    slope, curvature = (
        _PD_SLOPE_MAX * (1 + threshold_ratio),
        _PD_CURVATURE_MAX * (1 + threshold_ratio * threshold_ratio),
    )
    segment_bound = slope * mean_log_amplitude + 0.5 * (curvature + slope**2) * mean_square
    return ErrorBound(
        probability_change=np.minimum(len(points.existing_chirp_rates) * segment_bound, 1.0)
    )


def perturb_shots(shots: Shots, context: EffectContext, draw_addresses: DrawAddresses) -> Shots:
    """Draw the scintillation of each shot's echo, the same in all its segments."""
    parameters = context.parameters
    turbulence = turbulence_profile(parameters)
    if turbulence is None:
        return shots
    legs = two_way_log_variances(turbulence, parameters, shots.range)
    power_factor = draw_scintillation_factors(
        str(parameters[_DISTRIBUTION_PATH]), legs, draw_addresses
    )
    beat_factor = power_factor if shots.architecture == "direct" else np.sqrt(power_factor)
    noise_variances = shots.noise_variances
    if "signal_shot" in noise_variances:
        noise_variances = noise_variances | {
            "signal_shot": noise_variances["signal_shot"] * power_factor
        }
    return replace(
        shots,
        echo_power_scale=shots.echo_power_scale * power_factor,
        beat_amplitude_scale=shots.beat_amplitude_scale * beat_factor,
        noise_variances=noise_variances,
        pedestal_variance_under_lines=shots.pedestal_variance_under_lines * beat_factor**2,
        pedestal_variance_beside_lines=shots.pedestal_variance_beside_lines * beat_factor**2,
    )


SCINTILLATION = Effect(
    name="scintillation",
    description="an echo that twinkles in turbulent air",
    stage="draws",
    error_bound=error_bound,
    perturb_shots=perturb_shots,
    parameters=(
        Parameter(
            path=_TURBULENCE_PATH,
            description="Turbulence over height: none, even, or Hufnagel and Valley's 5/7 model",
            default="none",
            options=("none", "uniform", "hufnagel_valley"),
        ),
        Parameter(
            path=_STRUCTURE_CONSTANT_PATH,
            description="Structure constant of the refractive index of even turbulence",
            default=1e-14,
            example="1e-14 m^(-2/3)",
            limits=("0 m^(-2/3)", "100 m^(-2/3)"),
            is_category_key=True,
        ),
        Parameter(
            path=_DISTRIBUTION_PATH,
            description="Distribution of the irradiance",
            default="gamma_gamma",
            options=IRRADIANCE_DISTRIBUTIONS,
        ),
    ),
)
