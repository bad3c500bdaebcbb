"""Signal shot noise: the echo's own light, which close by rivals the local oscillator's.

What it does is in :func:`sweep.model.noise.shot_noise`: 2 q M^2 F Re P B_e of the whole
echo, which makes the rise of false alarms below some 5 m that [T 4.2] reports. Here is what
leaving it out can change: of the echo on the axis, or of the whole footprint's.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sweep.model.effects.change import Change, added_noise
from sweep.model.effects.effect import Effect, Scene
from sweep.model.effects.span import Span
from sweep.model.preparation import Shots

if TYPE_CHECKING:
    from sweep.model.effects.block import Block

NAME = "signal_shot_noise"


def bound(block: "Block") -> Change:
    """Change by the echo's shot noise, which the threshold does not follow."""
    more = Span.hull(1.0, block.echo_ratio)
    variance = block.echo_scale.times(block.echo, more, block.shot_noise_scale)
    return added_noise(
        least=variance.low,
        largest=variance.high,
        noise_variance=block.noise_variance,
        threshold_follows=False,
    )


def act(shots: Shots, scene: Scene) -> Shots:
    """Shot noise of the whole echo."""
    variance = shots.shot_noise_scale * shots.echo_power * scene.share(NAME)
    sources = {"signal_shot": np.asarray(variance)}
    return replace(shots, noise_sources=shots.noise_sources | sources)


EFFECT = Effect(
    name=NAME,
    about="shot noise of the echo itself",
    stage="noise",
    bound=bound,
    act=act,
    apart=False,
)
