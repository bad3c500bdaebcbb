"""Noise in addition to the receiver's own: of the echo, the sun, the local oscillator and the ADC.

Each effect adds a noise variance at the ADC. Its error bound is that variance over the variance of
the receiver's noise. Symbols in the equations: the elementary charge q, the detector's gain M,
excess noise factor F and responsivity Re, the optical power P, and the electrical bandwidth B_e.

References
----------
Shot noise is that of [T 2.23] for any light P, in :mod:`sweep.model.receiver_chain`. That of the
echo raises false alarms at short range [T 4.2]. Sunlight is Planck's law for the temperature of the
sun, and rounding is Widrow and Kollar, Quantization Noise, 2008, ch. 4, 9.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from sweep.model import beam, receiver_chain
from sweep.model.constants import BOLTZMANN, PLANCK, SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, EffectContext, Parameter, add_noise_sources
from sweep.model.effects.error_bounds import ErrorBound
from sweep.model.effects.planner_inputs import PlannerInputs
from sweep.model.effects.requirements import (
    ParameterRequirement,
    is_positive,
    positive_value_requirement,
)
from sweep.model.link_budget import (
    ADC_NOISE_SOURCE,
    LASER_PREFIX,
    PROCESSING_PREFIX,
    RECEIVER_PREFIX,
    TELESCOPE_PREFIX,
    adc_noise_variance,
)
from sweep.model.preparation import Shots

# The echo's own shot noise is 2 q M^2 F Re P B_e of the total echo. At short range it is as large
# as the local oscillator's. It explains the rise of false alarms below some 5 m that [T 4.2]
# reports.


def signal_shot_noise_error_bound(points: PlannerInputs) -> ErrorBound:
    """Return the variance of the echo's shot noise over that of the receiver's noise.

    The threshold is set on noise without this shot noise, which comes with the echo.
    """
    return ErrorBound(
        noise_variance_change=points.echo_shot_noise_ratio, threshold_follows_noise=False
    )


def apply_signal_shot_noise(shots: Shots, context: EffectContext) -> Shots:
    """Add the shot noise of the total echo.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Mask of the effect (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the noise source ``signal_shot`` [V^2], 0 for points without the effect.

    Notes
    -----
    The current variance is 2 q M^2 F Re P B_e. q is the elementary charge, M the detector's gain, F
    its excess noise factor, Re its responsivity, P the echo's power and B_e the electrical
    bandwidth.
    """
    variance = (
        shots.receiver_noise.shot_noise_variance_per_watt
        * shots.echo_power
        * context.effect_mask("signal_shot_noise")
    )
    return add_noise_sources(shots, signal_shot=np.asarray(variance))


SIGNAL_SHOT_NOISE = Effect(
    name="signal_shot_noise",
    description="shot noise of the echo itself",
    stage="noise",
    error_bound=signal_shot_noise_error_bound,
    apply=apply_signal_shot_noise,
    needs_separate_batches=False,
)
"""Effect that adds the shot noise of the echo's own light."""


_IRRADIANCE_PATH, _SUN_DISTANCE_PATH = "target.solar_irradiance", "target.sun_distance"
_SUN_ELEVATION_PATH, _FIELD_OF_VIEW_PATH = "target.sun_elevation", RECEIVER_PREFIX + "field_of_view"

SUN_TEMPERATURE = 5772.0
"""Effective temperature of the sun [K], IAU 2015 resolution B3."""
SUN_RADIUS = 6.957e8
"""Nominal radius of the sun [m], IAU 2015 resolution B3."""


def solar_irradiance(
    *, wavelength: ArrayLike, distance: ArrayLike, elevation: ArrayLike
) -> np.ndarray:
    """Return the spectral irradiance of a level surface by the sun as a black body.

    Parameters
    ----------
    wavelength : array_like
        Wavelength [m].
    distance : array_like
        Distance d from the sun [m]; 0 for no sun.
    elevation : array_like
        Elevation of the sun [rad].

    Returns
    -------
    ndarray
        Spectral irradiance [W/m^3]; 0 for a distance of 0.

    Notes
    -----
    The irradiance is pi B (R / d)^2 sin(elevation), with Planck's radiance B of a black body of the
    temperature SUN_TEMPERATURE, and the sun's radius R.
    """
    x, d = np.asarray(wavelength, float), np.asarray(distance, float)
    exponent = PLANCK * SPEED_OF_LIGHT / (x * BOLTZMANN * SUN_TEMPERATURE)
    # 1 / (e^u - 1), in a form that underflows to 0 where e^u would overflow.
    photons = np.exp(-exponent) / -np.expm1(-exponent)
    exitance = 2 * np.pi * PLANCK * SPEED_OF_LIGHT**2 / x**5 * photons
    dilution = np.where(d > 0, (SUN_RADIUS / np.where(d > 0, d, 1.0)) ** 2, 0.0)
    return np.asarray(exitance * dilution * np.maximum(np.sin(elevation), 0.0))


def received_sunlight(parameters: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the sunlight [W] that a diffuse surface sends to the detector, without extinction.

    Notes
    -----
    The surface fills the field of view with the radiance E rho / pi, where E is the spectral
    irradiance [W/m^3] and rho the reflectance. The radiance is multiplied by the aperture's area,
    the field's solid angle and the optical passband.
    """
    irradiance = parameters[_IRRADIANCE_PATH] + solar_irradiance(
        wavelength=parameters[LASER_PREFIX + "wavelength"],
        distance=parameters[_SUN_DISTANCE_PATH],
        elevation=parameters[_SUN_ELEVATION_PATH],
    )
    field_of_view = np.asarray(parameters[_FIELD_OF_VIEW_PATH], float)
    aperture_diameter, field_angle = beam.receiver_diameter_and_view_angle(parameters)
    area = receiver_chain.aperture_area(
        np.where(field_of_view > 0, parameters[TELESCOPE_PREFIX + "aperture"], aperture_diameter)
    )
    solid_angle = np.pi * (np.where(field_of_view > 0, field_of_view, field_angle) / 2) ** 2
    radiance = irradiance * parameters["target.reflectance"] / np.pi
    light = radiance * area * solid_angle * parameters[RECEIVER_PREFIX + "optical_passband"]
    return np.asarray(light * parameters[TELESCOPE_PREFIX + "optical_efficiency"])


def solar_background_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return the variance of sunlight's shot noise over that of the receiver's noise.

    Extinction in the air is neglected. The threshold is set on the noise with sunlight.
    """
    if not points.any_nonzero(_IRRADIANCE_PATH, _SUN_DISTANCE_PATH):
        return None
    return ErrorBound(
        noise_variance_change=received_sunlight(points.parameters)
        * points.receiver_noise.shot_noise_variance_per_watt
        / points.noise.variance_without_echo
    )


def apply_solar_background(shots: Shots, context: EffectContext) -> Shots:
    """Add the shot noise of sunlight, attenuated by the air between target and receiver.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Parameters of sun, target and receiver, and mask of the effect
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the noise source ``solar_shot`` [V^2], 0 for points without the effect.

    Notes
    -----
    The current variance is 2 q M^2 F Re P B_e, with the symbols of the module's description. The
    power P is that of :func:`received_sunlight` times the air's transmission.
    """
    effect_mask = context.effect_mask("solar_background")
    light = (
        received_sunlight(context.parameters)
        * shots.echo_scales.ground_light_transmission
        * effect_mask
    )
    return add_noise_sources(
        shots, solar_shot=np.asarray(shots.receiver_noise.shot_noise_variance_per_watt * light)
    )


SOLAR_BACKGROUND = Effect(
    name="solar_background",
    description="shot noise of sunlight on the target",
    stage="noise",
    error_bound=solar_background_error_bound,
    apply=apply_solar_background,
    needs_separate_batches=False,
    parameters=(
        Parameter(
            path=_SUN_DISTANCE_PATH,
            description="Distance of the target from the sun, which then lights it; 0 for none",
            example="1.52 au",
            limits=("0 m", "1e18 m"),
            requirements=(
                ParameterRequirement(
                    beam.WAVELENGTH_PATH,
                    is_positive,  # always: the requirement is on the distance alone
                    f"must be 0, for no sun, or at least the sun's radius, {SUN_RADIUS:g} m",
                    "set it to 1 au or so",
                    applies_to=lambda distance: (distance > 0) & (distance < SUN_RADIUS),
                ),
            ),
        ),
        Parameter(
            path=_SUN_ELEVATION_PATH,
            description="Elevation of that sun above the target's surface",
            default=float(np.pi / 2),
            example="30 deg",
            limits=("0 deg", "90 deg"),
            si_unit="rad",
        ),
        Parameter(
            path=_FIELD_OF_VIEW_PATH,
            description="Full angle of the receiver's field of view; 0 for that of the beam",
            example="100 urad",
            limits=("0 rad", "180 deg"),
        ),
    ),
)
"""Effect that adds the shot noise of sunlight from the target."""


_RIN_PATH, _REJECTION_PATH = (
    LASER_PREFIX + "relative_intensity_noise",
    RECEIVER_PREFIX + "common_mode_rejection",
)


def intensity_noise_current_variance(
    parameters: Mapping[str, np.ndarray], electrical_bandwidth: np.ndarray
) -> np.ndarray:
    """Compute the current variance due to intensity noise of the local oscillator.

    Parameters
    ----------
    parameters : mapping
        Parameters by dotted path.
    electrical_bandwidth : ndarray
        Electrical bandwidth B_e of the receiver [Hz].

    Returns
    -------
    ndarray
        Variance [A^2], >= 0.

    Notes
    -----
    One diode has (M Re P_lo)^2 RIN B_e. M is its gain, Re its responsivity, P_lo the power of the
    local oscillator, RIN the relative intensity noise [1/Hz] and B_e the electrical bandwidth. The
    two diodes of a balanced receiver see the same fluctuation and subtract it, except for their
    mismatch. The common-mode rejection (in dB 20 log10 of the ratio of their currents) divides the
    variance. RIN and rejection are assumed to be constant over the electrical bandwidth. The echo's
    own intensity noise is neglected: it is smaller by P / P_lo, with the echo's power P.
    """
    current = (
        parameters[RECEIVER_PREFIX + "apd_gain"] * parameters[RECEIVER_PREFIX + "responsivity"]
    )
    current = current * parameters[RECEIVER_PREFIX + "local_oscillator_power"]
    intensity_density = parameters[_RIN_PATH] / parameters[_REJECTION_PATH]
    return np.asarray(current**2 * intensity_density * electrical_bandwidth)


def relative_intensity_noise_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return the ratio of the local oscillator's intensity noise to the receiver's noise.

    The ratio is that of variances, and exact, not a bound. The threshold is set on noise that
    includes this source.
    """
    if points.waveform.architecture == "direct" or not points.any_nonzero(_RIN_PATH):
        return None
    current_variance = intensity_noise_current_variance(
        points.parameters, points.receiver_noise.electrical_bandwidth
    )
    return ErrorBound(
        noise_variance_change=current_variance
        * points.receiver_noise.variance_per_square_ampere
        / points.noise.variance_without_echo
    )


def apply_relative_intensity_noise(shots: Shots, context: EffectContext) -> Shots:
    """Add the intensity noise of the local oscillator; direct detection has none.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Parameters of laser and receiver; the ground is not used
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the noise source ``relative_intensity`` [V^2], or unchanged with direct
        detection.

    Notes
    -----
    The current variance [A^2] is that of :func:`intensity_noise_current_variance`. The noise
    variance at the ADC is this variance times a factor [V^2/A^2] of the receiver.
    """
    if shots.waveform.architecture == "direct":
        return shots
    current_variance = intensity_noise_current_variance(
        context.parameters, shots.receiver_noise.electrical_bandwidth
    )
    return add_noise_sources(
        shots, relative_intensity=current_variance * shots.receiver_noise.variance_per_square_ampere
    )


RELATIVE_INTENSITY_NOISE = Effect(
    name="relative_intensity_noise",
    description="fluctuation of the local oscillator's power",
    stage="noise",
    error_bound=relative_intensity_noise_error_bound,
    apply=apply_relative_intensity_noise,
    parameters=(
        Parameter(
            path=_RIN_PATH,
            description="One-sided spectral density of the laser's relative intensity",
            example="-155 dB/Hz",
            limits=("0 1/Hz", "100 1/Hz"),
        ),
        Parameter(
            path=_REJECTION_PATH,
            description="Common-mode rejection of a balanced receiver; 0 dB for a single diode",
            default=1.0,
            example="25 dB",
            limits=("0 dB", "300 dB"),
            can_cause_effect=False,
        ),
    ),
)
"""Effect that adds the noise of fluctuations of the local oscillator's power."""


_BITS_PATH = PROCESSING_PREFIX + "bits"


def quantisation_error_bound(points: PlannerInputs) -> ErrorBound | None:
    """Return the noise of the ADC's rounding over the receiver's noise, without clipping.

    Rounding noise is white, and is compared with the density of the receiver's noise at the line.
    The threshold is set on noise that includes this source. In a whitened spectrum lines are
    divided by the root of the noise density. This density includes rounding noise only with the
    effect.
    """
    if not points.any_nonzero(_BITS_PATH):
        return None
    white_noise_ratio = adc_noise_variance(points.parameters) / points.noise.variance_without_echo
    density_min = np.finfo(float).tiny  # density where filters pass nothing
    relative_density = np.maximum(
        points.receiver_filter.relative_noise_density(points.beat_frequency), density_min
    )
    magnitude_factor = np.sqrt((1 + white_noise_ratio) / (1 + white_noise_ratio / relative_density))
    return ErrorBound(
        magnitude_change=np.abs(magnitude_factor - 1),
        noise_variance_change=white_noise_ratio / relative_density,
    )


def apply_quantisation(shots: Shots, context: EffectContext) -> Shots:
    """Add the ADC's rounding noise, if a number of bits is stated.

    Parameters
    ----------
    shots : Shots
        Prepared shots of n points (:class:`sweep.model.preparation.Shots`).
    context : EffectContext
        Full scale [V] and number of bits of the ADC; the ground is not used
        (:class:`sweep.model.effects.effect.EffectContext`).

    Returns
    -------
    Shots
        Shots with the noise source ``quantisation`` [V^2]; it is 0 if the number of bits is 0.

    Notes
    -----
    The noise is white. Its variance is lsb^2/12 for steps of lsb [V], or twice that with I and Q
    (:func:`sweep.model.receiver_chain.quantisation_variance`, which cites the source).
    """
    return add_noise_sources(shots, **{ADC_NOISE_SOURCE: adc_noise_variance(context.parameters)})


QUANTISATION = Effect(
    name="quantisation",
    description="the ADC's steps",
    stage="noise",
    error_bound=quantisation_error_bound,
    apply=apply_quantisation,
    parameters=(
        Parameter(
            path=_BITS_PATH,
            description="Effective number of bits of the ADC; 0 for one without steps",
            example="12",
            limits=("0", "64"),
            requirements=(positive_value_requirement(PROCESSING_PREFIX + "full_scale"),),
        ),
    ),
)
"""Effect that adds the noise of rounding to the ADC's steps."""
