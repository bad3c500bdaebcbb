"""Extinction: air, haze and dust dim the beam on its way there and back.

The transmission T = exp(-tau) of the axis's path (:mod:`sweep.model.effects.atmosphere`)
multiplies the echo of all beamlets by T^2 [T 4.4], and light that comes from the ground, such as
the sun's, by T.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects import solar_background
from sweep.model.effects.atmosphere import (
    PARAMETERS,
    depth_over,
    path_heights,
    path_of,
    profile_of,
    profile_over,
    transmission,
)
from sweep.model.effects.change import Change
from sweep.model.effects.effect import Effect, Scene
from sweep.model.effects.span import Span
from sweep.model.preparation import Shots

if TYPE_CHECKING:
    from sweep.model.effects.block import Block


def dimming(*, depth: Span, amplitude_exponent: float, dimmed_share: ArrayLike) -> Change:
    """Change by extinction: exact on the signal; less light from the target is less shot noise.

    Parameters
    ----------
    depth : Span
        Optical depth of the path, one way.
    amplitude_exponent : float
        Power of T in the beat's amplitude: 1 with a local oscillator (its square is T^2), 2 for
        direct detection.
    dimmed_share : array_like
        Largest share of the noise variance, 0..1, that light from the target makes without
        extinction (signal and solar shot noise): at most 1 - T^2 of that share is gone.
    """
    quieter = 1 + np.expm1(-2 * np.asarray(depth.high)) * np.asarray(dimmed_share, float)
    low, high = (np.exp(-amplitude_exponent * np.asarray(d)) for d in (depth.high, depth.low))
    # The threshold follows the sun's part and not the echo's: an interval that holds both.
    return Change(
        signal=(low, high), noise=(quieter, np.ones_like(quieter)), threshold_follows=False
    )


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


def bound(block: "Block") -> Change | None:
    """What leaving extinction out can change, (tiles,)."""
    air = profile_over(block)
    if air is None:
        return None
    echo = block.shot_noise_scale * block.echo_scale * block.echo * Span.hull(1.0, block.echo_ratio)
    dimmed = (echo / block.noise_variance).high
    if (sun := solar_background.bound(block)) is not None:
        dimmed = dimmed + np.asarray(sun.noise[1]) - 1
    return dimming(
        depth=depth_over(air, path_of(block)),
        amplitude_exponent=2.0 if block.architecture == "direct" else 1.0,
        dimmed_share=dimmed / (1 + dimmed),
    )


EFFECT = Effect(
    name="extinction",
    about="air, haze and dust that dim the light",
    stage="light",
    bound=bound,
    act=act,
    parameters=PARAMETERS,
)
