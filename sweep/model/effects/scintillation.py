"""Scintillation: turbulent air makes the echo's power fluctuate from shot to shot.

The strength of turbulence C_n^2(h) gives the Rytov variance of a plane or a spherical wave over the
path. From it follow the log variances of the factors of large and small eddies, averaged over an
aperture, at any strength [1]_, for zero inner scale and infinite outer scale.

The irradiance, of unit mean, is the product of the two factors. They are log-normal (weak
turbulence), or gamma-distributed, which gives the gamma-gamma distribution [2]_ for any strength.

The light travels out and back. On the way out a plane wave scintillates on the target, averaged
over the footprint. On the way back a spherical wave scintillates in the receiver's aperture. The
two are independent. Their product multiplies the power of the total echo, and its root the
amplitudes, equally in all segments of a shot (milliseconds). Neglected are eddies that both paths
share (enhanced backscatter of small rough targets near the axis), the spreading of the beam, and
the loss of mixing.

References
----------
.. [1] Andrews and Phillips, Laser Beam Propagation through Random Media, 2nd ed. 2005, ch. 9, 10.
.. [2] Al-Habash, Andrews and Phillips, Opt. Eng. 40, 2001.
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
from sweep.model.effects.atmosphere import path_end_heights
from sweep.model.effects.effect import DrawAddresses, Effect, EffectContext, Parameter
from sweep.model.effects.error_bounds import ErrorBound
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.link_budget import ECHO_NOISE_SOURCES, LASER_PREFIX, TELESCOPE_PREFIX
from sweep.model.preparation import Shots

_RYTOV_DISTANCE_EXPONENTS = {"plane": (5 / 6, 0.0), "spherical": (5 / 6, 5 / 6)}
"""Exponents of two factors in the Rytov variance's integral over the path, by kind of wave. The
factors are the distance to the receiver and the distance to the source."""
_LARGE_EDDY_COEFFICIENTS = {"plane": (0.65, 1.11), "spherical": (0.18, 0.56)}
"""Coefficients, by kind of wave, of two terms in the log variance due to large eddies. The first
term is the aperture's, the second that of the strength of turbulence."""


class TurbulenceProfile(NamedTuple):
    """Structure constant C_n^2 of the air's refractive index over height above the ground.

    The structure constant is the sum of a uniform part and of the three terms of Hufnagel and
    Valley's model.
    """

    uniform_strength: float = 0.0
    """Part of C_n^2 that is the same at all heights [m^(-2/3)]. If the other fields are 0, it is
    C_n^2."""
    surface_layer_strength: float = 0.0
    """Coefficient A of Hufnagel and Valley's surface layer [m^(-2/3)]: C_n^2 of the layer on the
    ground, 1.7e-14 in the 5/7 model. It falls by the factor e over a height of 100 m."""
    wind_speed: float = 0.0
    """Rms wind speed at high altitude in Hufnagel and Valley's model [m/s]; 21 in the 5/7 model."""
    mid_altitude_strength: float = 0.0
    """Coefficient of Hufnagel and Valley's term for middle altitudes [m^(-2/3)], 2.7e-16 in the 5/7
    model. The term falls by the factor e over a height of 1500 m."""


HUFNAGEL_VALLEY = TurbulenceProfile(
    surface_layer_strength=1.7e-14, wind_speed=21.0, mid_altitude_strength=2.7e-16
)
"""Hufnagel and Valley's 5/7 model of turbulence [Valley 1980]. At a wavelength of 0.5 um its
coherence length is 5 cm, and its isoplanatic angle 7 urad."""


class LogIrradianceVariances(NamedTuple):
    """Variances of the logarithm of the irradiance due to large and small eddies, (n,) each."""

    large_eddies: np.ndarray
    """(n,): variance of the logarithm of the irradiance factor that large eddies cause."""
    small_eddies: np.ndarray
    """(n,): variance of the logarithm of the irradiance factor that small eddies cause."""


def structure_constant(turbulence: TurbulenceProfile, height: ArrayLike) -> np.ndarray:
    """Return the structure constant C_n^2 at heights above the ground.

    Parameters
    ----------
    turbulence : TurbulenceProfile
        Turbulence over height.
    height : array_like
        Height h above the ground [m]; below the ground, the value on the ground is returned.

    Returns
    -------
    ndarray
        C_n^2 [m^(-2/3)].

    Notes
    -----
    The uniform part is added to Hufnagel and Valley's model, 0.00594 (v / 27)^2 (1e-5 h)^10 exp(-h
    / 1000) + mid_altitude_strength exp(-h / 1500) + surface_layer_strength exp(-h / 100), with the
    wind speed v.
    """
    h = np.maximum(np.asarray(height, float), 0.0)
    aloft = 0.00594 * (turbulence.wind_speed / 27) ** 2 * (1e-5 * h) ** 10 * np.exp(-h / 1e3)
    mid_altitude_strength = turbulence.mid_altitude_strength * np.exp(-h / 1.5e3)
    return (
        turbulence.uniform_strength
        + aloft
        + mid_altitude_strength
        + turbulence.surface_layer_strength * np.exp(-h / 100)
    )


def rytov_variance(
    wave: str,
    turbulence: TurbulenceProfile,
    *,
    wavelength: ArrayLike,
    range: ArrayLike,
    start_height: ArrayLike,
    end_height: ArrayLike,
) -> np.ndarray:
    """Compute the Rytov variance: the log variance of irradiance in weak turbulence.

    Parameters
    ----------
    wave : str
        ``plane`` or ``spherical``.
    turbulence : TurbulenceProfile
        Turbulence over height.
    wavelength, range : array_like
        Wavelength and length L of the straight path [m], (n,) or scalar.
    start_height, end_height : array_like
        Heights of the wave's source and of the receiver [m], (n,) or scalar.

    Returns
    -------
    ndarray (n,)

    Notes
    -----
    2.25 k^(7/6) integral of C_n^2 (L - z)^(5/6) [(z/L)^(5/6) for a spherical wave] over z from
    source to receiver. In uniform turbulence it is 1.23 and 0.50 C_n^2 k^(7/6) L^(11/6) for plane
    and spherical waves. A Gauss-Jacobi rule includes the powers exactly; paths may span 20 km of
    height.
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
    """Return quadrature nodes and weights for the Rytov variance's integral over the path.

    Nodes are fractions of the path from source to receiver. Weights include the powers of the
    distances to both.
    """
    to_receiver, to_source = _RYTOV_DISTANCE_EXPONENTS[wave]
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
    """Compute the log variances of the irradiance averaged over an aperture.

    Parameters
    ----------
    wave : str
        ``plane`` or ``spherical``.
    rytov_variance : array_like
        Rytov variance sigma_R^2 of that wave.
    wavelength, range : array_like
        Wavelength and length L of the path [m].
    aperture : array_like
        Diameter D of the aperture [m]; 0 for a point.

    Returns
    -------
    LogIrradianceVariances
        Log variances due to large and due to small eddies, (n,) each.

    Notes
    -----
    exp(large + small) - 1 is the scintillation index: the Rytov variance for a point in weak
    turbulence, and 1 + 0.86 sigma_R^(-4/5) for a plane wave in strong turbulence. The published fit
    serves any strength and averages too little over wide apertures. In weak turbulence, the fit's
    scintillation index is 1.3 times Kolmogorov's integral for k D^2 / 4 L = 1. For k D^2 / 4 L = 10
    it is 2 times the integral for a plane wave, and 1.5 times for a spherical one.
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
"""Names of the distributions of the irradiance that a spec can select."""
_GAMMA_VARIANCE_MIN = 1e-5
"""Variance of a gamma variable of mean 1 below which Wilson and Hilferty's approximation gives its
quantiles."""
_PD_SLOPE_MAX, _PD_CURVATURE_MAX = 0.5, 0.5
"""Bounds on derivatives of Marcum's Q_1(a, b) by ln a, with the signal a and the threshold b over
the noise per quadrature. The first derivative is at most the first number times 1 + b, the second
at most the second number times 1 + b^2."""


def draw_scintillation_factors(
    distribution: str, legs: Sequence[LogIrradianceVariances], draw_addresses: DrawAddresses
) -> np.ndarray:
    """Draw factors of unit mean on the echo's power.

    Parameters
    ----------
    distribution : str
        One of :data:`IRRADIANCE_DISTRIBUTIONS`.
    legs : sequence of LogIrradianceVariances
        Log variances of the ways out and back, which are independent.
    draw_addresses : DrawAddresses
        Random keys and draw numbers of n points.

    Returns
    -------
    ndarray (n,)

    Notes
    -----
    Random numbers 2 i and 2 i + 1 of the stream are for the large and small eddies of leg i. The
    inverse of the eddies' distribution turns the numbers into factors.
    """
    from sweep.model.sampling import philox

    uniform_draws = draw_addresses.uniforms(philox.STREAM_SCINTILLATION, 4)
    factor = np.ones(draw_addresses.draw_numbers.size)
    for i, variance in enumerate(v for leg in legs for v in leg):
        factor *= _irradiance_quantile(
            distribution, uniform_draws[:, i], np.asarray(variance, float)
        )
    return factor


def _log_amplitude_moments(
    distribution: str, legs: Sequence[LogIrradianceVariances]
) -> tuple[np.ndarray, np.ndarray]:
    """Return |E[L]| and E[L^2] of scintillation, or upper bounds of them, (n,) each.

    L is half the logarithm of the factor on the echo's power, and E[] the mean over draws. The
    gamma-gamma distribution has upper bounds. The logarithm of a gamma variable of mean 1 and
    variance s has a mean above -(s/2 + s^2/12) and a variance below s + s^2/2 + s^3/6. They follow
    from the enveloping series of the digamma function and its derivative.
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


def _irradiance_quantile(
    distribution: str, probability: np.ndarray, variance: np.ndarray
) -> np.ndarray:
    """Return the quantile at ``probability`` of a factor of mean 1 and log variance ``variance``.

    A gamma distribution of shape a has the variance 1/a = exp(log variance) - 1. For shapes beyond
    1e5 the library's inverse can be wrong. Wilson and Hilferty's cube of a normal number replaces
    it, accurate to 1e-3 standard deviations.
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
    """Return the turbulence over height; None in still air. All points share text parameters."""
    name = str(parameters[_TURBULENCE_PATH])
    if name == "uniform":
        return TurbulenceProfile(uniform_strength=float(parameters[_STRUCTURE_CONSTANT_PATH]))
    return HUFNAGEL_VALLEY if name == "hufnagel_valley" else None


def two_way_log_variances(
    turbulence: TurbulenceProfile, parameters: Mapping[str, np.ndarray], range: np.ndarray
) -> tuple[LogIrradianceVariances, LogIrradianceVariances]:
    """Return the log variances of the irradiance on the ways out and back.

    Parameters
    ----------
    turbulence : TurbulenceProfile
        Turbulence over height.
    parameters : mapping
        Parameters by dotted path.
    range : ndarray (n,)
        Range of the target [m].

    Returns
    -------
    out, back : LogIrradianceVariances
        A plane wave averaged over the footprint, and a spherical wave averaged over the aperture.
    """
    lidar_height, target_height = path_end_heights(parameters, range)
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
    """Return a bound on the change of mean probabilities if scintillation is omitted.

    Notes
    -----
    The echo's power is multiplied by a random factor of mean 1. Let L be half the factor's
    logarithm, E[] the mean over draws, and h(x) the probability at the logarithm x of the
    amplitude. Then |E[h(x + L)] - h(x)| <= sup h' |E[L]| + sup |h''| E[L^2] / 2. All segments share
    one factor. For their product, the suprema of two slopes times E[L^2] are added.
    """
    if (
        points.shared_option(_TURBULENCE_PATH) == "none"
        or (turbulence := turbulence_profile(points.parameters)) is None
    ):
        return None
    mean_log_amplitude, mean_square = _log_amplitude_moments(
        points.shared_option(_DISTRIBUTION_PATH),
        two_way_log_variances(turbulence, points.parameters, points.range),
    )
    threshold_ratio = points.threshold_ratio
    slope, curvature = (
        _PD_SLOPE_MAX * (1 + threshold_ratio),
        _PD_CURVATURE_MAX * (1 + threshold_ratio * threshold_ratio),
    )
    segment_bound = slope * mean_log_amplitude + 0.5 * (curvature + slope**2) * mean_square
    return ErrorBound(
        probability_change=np.minimum(len(points.existing_chirp_slopes) * segment_bound, 1.0)
    )


def perturb_shots(shots: Shots, context: EffectContext, draw_addresses: DrawAddresses) -> Shots:
    """Draw the scintillation of each shot's echo, the same in all its segments.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points, after all effects that are not random.
    context : EffectContext
        Parameters and ground of the points.
    draw_addresses : DrawAddresses
        Random key (n, 2) and draw number (n,) of each point. Equal addresses give equal shots.

    Returns
    -------
    Shots
        Shots whose echo power, beat amplitude, noise by the echo and pedestal are changed.

    Notes
    -----
    The factor multiplies the echo's power and its shot noise. Its square root multiplies the beat's
    amplitude, or with direct detection the factor itself. The square of that multiplies the
    pedestal of phase noise.
    """
    parameters = context.parameters
    turbulence = turbulence_profile(parameters)
    if turbulence is None:
        return shots
    legs = two_way_log_variances(turbulence, parameters, shots.range)
    power_factor = draw_scintillation_factors(
        str(parameters[_DISTRIBUTION_PATH]), legs, draw_addresses
    )
    beat_factor = power_factor if shots.waveform.architecture == "direct" else np.sqrt(power_factor)
    echo_variances = {
        name: variance * power_factor
        for name, variance in shots.noise.variances.items()
        if name in ECHO_NOISE_SOURCES
    }
    return replace(
        shots,
        echo_scales=shots.echo_scales.with_scaled_echo(
            power_factor=power_factor, amplitude_factor=beat_factor
        ),
        noise=shots.noise.with_sources(**echo_variances),
        laser_line=shots.laser_line.with_scaled_pedestal(beat_factor**2),
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
"""Effect that lets turbulence vary the power of the echo at random from shot to shot."""
