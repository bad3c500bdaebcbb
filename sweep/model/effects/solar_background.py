"""Solar background: sunlight scattered into the receiver, as shot noise.

What it does is in :func:`sweep.model.noise.solar_power` and
:func:`sweep.model.noise.shot_noise`; here is what leaving it out can change.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from sweep.model import noise
from sweep.model.constants import BOLTZMANN, PLANCK, SPEED_OF_LIGHT
from sweep.model.effects.effect import Effect, Parameter, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.preparation import Shots

NAME = "solar_background"


_SCATTERING = {
    "reflectance": "target.reflectance",
    "aperture": "instrument.telescope.aperture",
    "optical_passband": "instrument.receiver.optical_passband",
    "optical_efficiency": "instrument.telescope.optical_efficiency",
}


_DISTANCE, _ELEVATION = "target.sun_distance", "target.sun_elevation"
_FIELD = "instrument.receiver.field_of_view"

SUN_TEMPERATURE = 5772.0
"""Effective temperature of the sun [K], IAU 2015 resolution B3."""
SUN_RADIUS = 6.957e8
"""Nominal radius of the sun [m], likewise."""


def sunlight(*, wavelength: ArrayLike, distance: ArrayLike, elevation: ArrayLike) -> np.ndarray:
    """Spectral irradiance [W/m^3] of a level surface by a black sun; 0 for a distance of 0.

    Planck's radiance pi B(wavelength, T) (R / d)^2 sin(elevation).

    Parameters
    ----------
    wavelength, distance, elevation : array_like
        [m]; from the sun [m]; of the sun above the surface [rad].
    """
    x, d = np.asarray(wavelength, float), np.asarray(distance, float)
    exponent = PLANCK * SPEED_OF_LIGHT / (x * BOLTZMANN * SUN_TEMPERATURE)
    # 1 / (e^u - 1), written so that it fades to 0 where e^u exceeds what a float holds.
    photons = np.exp(-exponent) / -np.expm1(-exponent)
    exitance = 2 * np.pi * PLANCK * SPEED_OF_LIGHT**2 / x**5 * photons
    dilution = np.where(d > 0, (SUN_RADIUS / np.where(d > 0, d, 1.0)) ** 2, 0.0)
    return np.asarray(exitance * dilution * np.maximum(np.sin(elevation), 0.0))


def received(p: Mapping[str, np.ndarray]) -> np.ndarray:
    """Sunlight on the detector [W] without extinction, (n,) or scalar."""
    lit = p["target.solar_irradiance"] + sunlight(
        wavelength=p["instrument.laser.wavelength"],
        distance=p[_DISTANCE],
        elevation=p[_ELEVATION],
    )
    divergence, field = p["instrument.laser.beam_divergence"], np.asarray(p[_FIELD], float)
    return noise.solar_power(
        solar_irradiance=lit,
        beam_divergence=np.where(field > 0, field, divergence),
        **{name: p[path] for name, path in _SCATTERING.items()},
    )


def size(points: Points) -> Size | None:
    """Sunlight on the detector, without the air; the threshold is set on it."""
    if not points.has("target.solar_irradiance", _DISTANCE):
        return None
    variance = received(points.numbers) * points.receiver.per_watt
    return Size(noise=variance / points.noise_variance)


def act(shots: Shots, scene: Scene) -> Shots:
    """Shot noise of sunlight; the air dims it on its way up."""
    light = received(scene.parameters) * shots.ground_transmission * scene.share(NAME)
    sun = {"solar_shot": np.asarray(shots.shot_noise_scale * light)}
    return replace(shots, noise_sources=shots.noise_sources | sun)


EFFECT = Effect(
    name=NAME,
    about="shot noise of sunlight on the target",
    stage="noise",
    size=size,
    act=act,
    apart=False,
    parameters=(
        Parameter(
            path=_DISTANCE,
            about="Distance of the target from the sun, which then lights it; 0 for none",
            si_unit="m",
            default=0.0,
            example="1.52 au",
            at_least="0 m",
            at_most="1e18 m",
        ),
        Parameter(
            path=_ELEVATION,
            about="Elevation of that sun above the target's surface",
            si_unit="rad",
            default=float(np.pi / 2),
            example="30 deg",
            at_least="0 deg",
            at_most="90 deg",
        ),
        Parameter(
            path=_FIELD,
            about="Full angle of the receiver's field of view; 0 for that of the beam",
            si_unit="rad",
            default=0.0,
            example="100 urad",
            at_least="0 rad",
            at_most="180 deg",
        ),
    ),
)
