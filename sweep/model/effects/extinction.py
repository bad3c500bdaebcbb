"""Extinction: air, haze and dust dim the beam on its way there and back.

The transmission T = exp(-tau) of the axis's path (:mod:`sweep.model.effects.atmosphere`)
multiplies the echo of all beamlets by T^2 [T 4.4], and light that comes from the ground, such as
the sun's, by T.
"""

from dataclasses import replace

from sweep.model.effects import solar_background
from sweep.model.effects.atmosphere import PARAMETERS, path_heights, profile_of, transmission
from sweep.model.effects.effect import Effect, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.preparation import Shots


def act(shots: Shots, scene: Scene) -> Shots:
    """A dimmer echo."""
    air = profile_of(scene.parameters)
    if air is None:
        return shots
    lidar, target = path_heights(scene.parameters, shots.range)
    t = transmission(air, start_height=lidar, end_height=target, range=shots.range)
    beat = t**2 if shots.architecture == "direct" else t
    return replace(
        shots,
        echo_scale=shots.echo_scale * t**2,
        beat_scale=shots.beat_scale * beat,
        ground_transmission=t,
    )


def size(points: Points) -> Size | None:
    """What leaving extinction out changes: the echo, and shot noise of light from the target."""
    air = profile_of(points.parameters)
    if air is None:
        return None
    lidar, target = path_heights(points.parameters, points.range)
    t = transmission(air, start_height=lidar, end_height=target, range=points.range)
    light = points.echo_noise
    if (sun := solar_background.size(points)) is not None:
        light = light + sun.noise
    # the threshold follows the sun's part and not the echo's: the worse is taken
    return Size(
        magnitude=1 - (t**2 if points.architecture == "direct" else t),
        noise=-(1 - t**2) * light / (1 + light),
        threshold_follows=False,
    )


EFFECT = Effect(
    name="extinction",
    about="air, haze and dust that dim the light",
    stage="light",
    size=size,
    act=act,
    parameters=PARAMETERS,
)
