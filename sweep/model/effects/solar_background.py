"""Solar background: sunlight scattered into the receiver, as shot noise.

What it does is in :func:`sweep.model.noise.solar_power` and
:func:`sweep.model.noise.shot_noise`; here is what leaving it out can change.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sweep.model import noise
from sweep.model.constants import BOLTZMANN, PLANCK, SPEED_OF_LIGHT
from sweep.model.effects.change import Change, added_noise
from sweep.model.effects.effect import Effect, Parameter, Scene
from sweep.model.effects.span import Span, monotone
from sweep.model.preparation import Shots

if TYPE_CHECKING:
    from sweep.model.effects.block import Block

NAME = "solar_background"


_SCATTERING = {
    "reflectance": "target.reflectance",
    "aperture": "instrument.telescope.aperture",
    "optical_passband": "instrument.receiver.optical_passband",
    "optical_efficiency": "instrument.telescope.optical_efficiency",
}


def bound(block: "Block") -> Change | None:
    """Change by sunlight on the detector: its share of the other noise, or what air leaves of it.

    The threshold is set on it: the sun shines with and without an echo.
    """
    if not block.has("target.solar_irradiance", _DISTANCE):
        return None
    field, divergence = block[_FIELD], block["instrument.laser.beam_divergence"].high
    widest = np.where(np.less_equal(field.low, 0), np.maximum(field.high, divergence), field.high)
    light = monotone(
        noise.solar_power,
        solar_irradiance=block["target.solar_irradiance"] + _sunlight_over(block),
        beam_divergence=Span(0.0, widest),
        **{name: block[path] for name, path in _SCATTERING.items()},
    )
    variance = light * block.shot_noise_scale
    return added_noise(least=0.0, largest=variance.high, noise_variance=block.noise_variance)


_DISTANCE, _ELEVATION = "target.sun_distance", "target.sun_elevation"
_FIELD = "instrument.receiver.field_of_view"

SUN_TEMPERATURE = 5772.0
"""Effective temperature of the sun [K], IAU 2015 resolution B3."""
SUN_RADIUS = 6.957e8
"""Nominal radius of the sun [m], likewise."""
_BRIGHTEST = PLANCK * SPEED_OF_LIGHT / (4.965114231744276 * BOLTZMANN * SUN_TEMPERATURE)
"""Wavelength at which a black sun is brightest [m], Wien's law."""


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


def _sunlight_over(block: "Block") -> Span:
    """Irradiance by the sun over wavelengths that may hold its brightest."""
    wavelength = block["instrument.laser.wavelength"]
    distance = block[_DISTANCE]
    none = np.less_equal(distance.low, 0)
    some = Span(np.where(none, np.minimum(SUN_RADIUS, distance.high), distance.low), distance.high)
    brightest = np.clip(_BRIGHTEST, wavelength.low, wavelength.high)
    places = [
        monotone(
            lambda distance, elevation, at=at: sunlight(
                wavelength=at, distance=distance, elevation=elevation
            ),
            falling=("distance",),
            distance=some,
            elevation=block[_ELEVATION],
        )
        for at in (wavelength.low, brightest, wavelength.high)
    ]
    found = Span.hull(*places)
    return Span(np.where(none, 0.0, found.low), found.high)


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


def act(shots: Shots, scene: Scene) -> Shots:
    """Shot noise of sunlight; the air dims it on its way up."""
    light = received(scene.parameters) * shots.ground_transmission * scene.share(NAME)
    sun = {"solar_shot": np.asarray(shots.shot_noise_scale * light)}
    return replace(shots, noise_sources=shots.noise_sources | sun)


EFFECT = Effect(
    name=NAME,
    about="shot noise of sunlight on the target",
    stage="noise",
    bound=bound,
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
