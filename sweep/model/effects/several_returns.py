"""Several returns: a footprint on more than one surface, each with its own group of bins.

Called for where an edge lies in the footprint. It acts on the lines' positions: without it the
beamlets beside the axis's surface send their power back from the axis's own range.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sweep.model.effects.change import Change
from sweep.model.effects.effect import Effect, Scene
from sweep.model.effects.line_spread import (
    NO_SPREAD,
    Moments,
    image_factor,
    power_range,
)
from sweep.model.effects.span import any_holds
from sweep.model.preparation import Shots

if TYPE_CHECKING:
    from sweep.model.effects.block import Block

NAME = "several_returns"


def bound(block: "Block") -> Change | None:
    """What the other surfaces' ranges can change in the largest bin.

    As powers, with a share f beside the axis's surface, whose own lines put a in their largest
    bin: with the effect that bin holds a at the least, and no bin more than a + f; without it the
    largest holds a at the least, and a and f's line on the axis at the most. Of amplitudes that
    add nothing is known but that no bin holds more than all in phase.
    """
    if not any_holds(np.greater(block.beside_share.high, 0)):
        return None
    f, line = np.clip(block.beside_share.high, 0.0, 1.0), block.lines
    apart = block.of_ranges(Moments(0.0, 0.0, block.beside_apart)).extreme
    spread = block.own_range_spread
    own = (1 - f) * power_range(line, spread, block.number)[0]
    _, on_axis = power_range(line, NO_SPREAD, block.number)
    elsewhere = np.fmin(np.exp(np.minimum(line.tilt * apart, 50.0)), line.transfer_least**-2.0)
    elsewhere = elsewhere * image_factor(line, apart)
    with np.errstate(divide="ignore", invalid="ignore"):
        less, more = own / (own + f * on_axis), 1 + f * elsewhere / own
    there = (f > 0) & (np.asarray(apart) > 0)
    low, high = np.sqrt(np.where(there, less, 1.0)), np.sqrt(np.where(there, more, 1.0))
    if block.adds_amplitudes:
        all_in_phase = 2 / (line.transfer_least * line.lobe.least(np.asarray(0.5)))
        low, high = np.where(f > 0, 0.0, low), np.where(f > 0, np.maximum(high, all_in_phase), high)
    return Change(signal=(low, high))


def act(shots: Shots, scene: Scene) -> Shots:
    """Beamlets on other surfaces than the axis's at ranges of their own, where there are any."""
    offset = scene.ground.beamlets.offset
    if scene.ground.beside is None or shots.offset.shape != offset.shape:
        return shots
    return replace(shots, offset=scene.beamlets(NAME, shots.row, offset, shots.offset))


EFFECT = Effect(
    name=NAME,
    about="more than one surface in a footprint",
    stage="lines",
    bound=bound,
    act=act,
    within="footprint",
    apart=False,
)
