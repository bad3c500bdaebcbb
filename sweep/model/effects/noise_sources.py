"""Noise besides the receiver's own: of the echo, the sun, the local oscillator and the ADC.

Each adds a variance at the ADC, and its size is that variance over the receiver's.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from sweep.model import beam, link
from sweep.model.constants import BOLTZMANN, PLANCK, SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, Parameter, Scene, Size, noisier
from sweep.model.effects.points import Points
from sweep.model.preparation import LASER, PROCESSING, RECEIVER, TELESCOPE, Shots

# The echo's own shot noise: 2 q M^2 F Re P B_e of the whole echo, which close by rivals the local
# oscillator's, and makes the rise of false alarms below some 5 m that [T 4.2] reports.


def echo_size(points: Points) -> Size:
    """Shot noise of the echo, which the threshold does not follow."""
    return Size(noise=points.echo_noise, threshold_follows=False)


def add_echo(shots: Shots, scene: Scene) -> Shots:
    """Shot noise of the whole echo."""
    variance = shots.shot_noise_scale * shots.echo_power * scene.share("signal_shot_noise")
    return noisier(shots, signal_shot=np.asarray(variance))


SIGNAL_SHOT_NOISE = Effect(
    name="signal_shot_noise",
    about="shot noise of the echo itself",
    stage="noise",
    size=echo_size,
    act=add_echo,
    apart=False,
)


_IRRADIANCE, _DISTANCE = "target.solar_irradiance", "target.sun_distance"
_ELEVATION, _FIELD = "target.sun_elevation", RECEIVER + "field_of_view"

SUN_TEMPERATURE = 5772.0
"""Effective temperature of the sun [K], IAU 2015 resolution B3."""
SUN_RADIUS = 6.957e8
"""Nominal radius of the sun [m], likewise."""


def sunlight(*, wavelength: ArrayLike, distance: ArrayLike, elevation: ArrayLike) -> np.ndarray:
    """Spectral irradiance [W/m^3] of a level surface by a black sun; 0 for a distance of 0.

    Planck's radiance pi B(wavelength, T) (R / d)^2 sin(elevation).
    """
    x, d = np.asarray(wavelength, float), np.asarray(distance, float)
    exponent = PLANCK * SPEED_OF_LIGHT / (x * BOLTZMANN * SUN_TEMPERATURE)
    # 1 / (e^u - 1), written so that it fades to 0 where e^u exceeds what a float holds.
    photons = np.exp(-exponent) / -np.expm1(-exponent)
    exitance = 2 * np.pi * PLANCK * SPEED_OF_LIGHT**2 / x**5 * photons
    dilution = np.where(d > 0, (SUN_RADIUS / np.where(d > 0, d, 1.0)) ** 2, 0.0)
    return np.asarray(exitance * dilution * np.maximum(np.sin(elevation), 0.0))


def received(p: Mapping[str, np.ndarray]) -> np.ndarray:
    """Sunlight [W] that a diffuse surface sends onto the detector, without extinction.

    Radiance E rho / pi of a surface that fills the field of view, through the aperture, over the
    field's solid angle and the optical passband; E is the spectral irradiance on it [W/m^3].
    """
    lit = p[_IRRADIANCE] + sunlight(
        wavelength=p[LASER + "wavelength"], distance=p[_DISTANCE], elevation=p[_ELEVATION]
    )
    field = np.asarray(p[_FIELD], float)
    diameter, angle = beam.receiving_field(p)
    area = link.aperture_area(np.where(field > 0, p[TELESCOPE + "aperture"], diameter))
    solid_angle = np.pi * (np.where(field > 0, field, angle) / 2) ** 2
    radiance = lit * p["target.reflectance"] / np.pi
    light = radiance * area * solid_angle * p[RECEIVER + "optical_passband"]
    return np.asarray(light * p[TELESCOPE + "optical_efficiency"])


def sun_size(points: Points) -> Size | None:
    """Shot noise of sunlight, without the air; the threshold is set on it."""
    if not points.has(_IRRADIANCE, _DISTANCE):
        return None
    return Size(
        noise=received(points.parameters) * points.receiver.per_watt / points.noise_variance
    )


def add_sun(shots: Shots, scene: Scene) -> Shots:
    """Shot noise of sunlight; the air dims it on its way up."""
    share = scene.share("solar_background")
    light = received(scene.parameters) * shots.ground_transmission * share
    return noisier(shots, solar_shot=np.asarray(shots.shot_noise_scale * light))


SOLAR_BACKGROUND = Effect(
    name="solar_background",
    about="shot noise of sunlight on the target",
    stage="noise",
    size=sun_size,
    act=add_sun,
    apart=False,
    parameters=(
        Parameter(
            path=_DISTANCE,
            about="Distance of the target from the sun, which then lights it; 0 for none",
            example="1.52 au",
            limits=("0 m", "1e18 m"),
        ),
        Parameter(
            path=_ELEVATION,
            about="Elevation of that sun above the target's surface",
            default=float(np.pi / 2),
            example="30 deg",
            limits=("0 deg", "90 deg"),
            si_unit="rad",
        ),
        Parameter(
            path=_FIELD,
            about="Full angle of the receiver's field of view; 0 for that of the beam",
            example="100 urad",
            limits=("0 rad", "180 deg"),
        ),
    ),
)


_RIN, _REJECTION = LASER + "relative_intensity_noise", RECEIVER + "common_mode_rejection"


def current_variance(p: Mapping[str, np.ndarray]) -> np.ndarray:
    """Compute the current variance [A^2] from intensity noise of the local oscillator.

    One diode sees (M Re P_lo)^2 RIN B_e. The two diodes of a balanced receiver see the same
    fluctuation and subtract it, all but their mismatch: the common-mode rejection (in dB 20 log10
    of the ratio of their currents) divides the variance. Both are taken to be flat over the
    electrical bandwidth. The echo's own is left out: it is below that by P / P_lo.
    """
    current = p[RECEIVER + "apd_gain"] * p[RECEIVER + "responsivity"]
    current = current * p[RECEIVER + "local_oscillator_power"]
    seen = p[_RIN] / p[_REJECTION]
    bandwidth = link.electrical_bandwidth(link.receiver_values(p))
    return np.asarray(current**2 * seen * bandwidth)


def intensity_size(points: Points) -> Size | None:
    """Intensity noise, exactly; the threshold is set on it."""
    if points.architecture == "direct" or not points.has(_RIN):
        return None
    current = current_variance(points.parameters)
    return Size(noise=current * points.receiver.per_ampere / points.noise_variance)


def add_intensity(shots: Shots, scene: Scene) -> Shots:
    """Intensity noise of the local oscillator; direct detection has none."""
    if shots.architecture == "direct":
        return shots
    current = current_variance(scene.parameters)
    return noisier(shots, relative_intensity=current * shots.noise_scale)


RELATIVE_INTENSITY_NOISE = Effect(
    name="relative_intensity_noise",
    about="fluctuation of the local oscillator's power",
    stage="noise",
    size=intensity_size,
    act=add_intensity,
    parameters=(
        Parameter(
            path=_RIN,
            about="One-sided spectral density of the laser's relative intensity",
            example="-155 dB/Hz",
            limits=("0 1/Hz", "100 1/Hz"),
        ),
        Parameter(
            path=_REJECTION,
            about="Common-mode rejection of a balanced receiver; 0 dB for a single diode",
            default=1.0,
            example="25 dB",
            limits=("0 dB", "300 dB"),
            alone=False,
        ),
    ),
)


_BITS = PROCESSING + "bits"


def rounding_size(points: Points) -> Size | None:
    """Return the noise of rounding, without clipping; the threshold follows it.

    It is white, and is compared with the density of the receiver's noise at the line. A spectrum
    in which all noise is made white scales a line by the root of both together, where the
    receiver's alone is left out.
    """
    if not points.has(_BITS):
        return None
    white = points.rounding / points.noise_variance
    least = np.finfo(float).tiny  # the density where filters let nothing pass
    density = np.maximum(points.noise_density, least)
    scaled = np.sqrt((1 + white) / (1 + white / density))
    return Size(magnitude=np.abs(scaled - 1), noise=white / density)


def add_rounding(shots: Shots, scene: Scene) -> Shots:
    """White noise of lsb^2/12, where the ADC has a number of bits."""
    p, in_quadrature = scene.parameters, shots.complex_record
    added = link.rounding_variance(
        full_scale=p[PROCESSING + "full_scale"], bits=p[_BITS], in_quadrature=in_quadrature
    )
    return noisier(shots, quantisation=added)


QUANTISATION = Effect(
    name="quantisation",
    about="the ADC's steps",
    stage="noise",
    size=rounding_size,
    act=add_rounding,
    parameters=(
        Parameter(
            path=_BITS,
            about="Effective number of bits of the ADC; 0 for one without steps",
            example="12",
            limits=("0", "64"),
        ),
    ),
)
