"""Signal shot noise: the echo's own light, which close by rivals the local oscillator's.

What it does is in :func:`sweep.model.noise.shot_noise`: 2 q M^2 F Re P B_e of the whole
echo, which makes the rise of false alarms below some 5 m that [T 4.2] reports. Here is what
leaving it out can change: of the echo on the axis, or of the whole footprint's.
"""

from dataclasses import replace

import numpy as np

from sweep.model.effects.effect import Effect, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.preparation import Shots

NAME = "signal_shot_noise"


def size(points: Points) -> Size:
    """The echo's shot noise, which the threshold does not follow."""
    return Size(noise=points.echo_noise, threshold_follows=False)


def act(shots: Shots, scene: Scene) -> Shots:
    """Shot noise of the whole echo."""
    variance = shots.shot_noise_scale * shots.echo_power * scene.share(NAME)
    sources = {"signal_shot": np.asarray(variance)}
    return replace(shots, noise_sources=shots.noise_sources | sources)


EFFECT = Effect(
    name=NAME,
    about="shot noise of the echo itself",
    stage="noise",
    size=size,
    act=act,
    apart=False,
)
