"""Several returns: a footprint on more than one surface, each with its own group of bins.

Called for where an edge lies in the footprint. It acts on the lines' positions: without it the
beamlets beside the axis's surface send their power back from the axis's own range.
"""

from dataclasses import replace

import numpy as np

from sweep.model.effects.effect import Effect, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.preparation import Shots

NAME = "several_returns"


def size(points: Points) -> Size | None:
    """What the other surfaces' ranges change in the largest bin.

    As powers, with a share f beside the axis's surface, whose own lines put a in their largest
    bin: with the effect that bin holds a at the least, and no bin more than a + f; without it the
    largest holds a at the least, and a and f's line on the axis at the most. Of amplitudes that
    add nothing is known but that no bin holds more than all in phase.
    """
    share = np.minimum(points.footprint.beside, 1.0)
    if not (share > 0).any():
        return None
    if points.adds_amplitudes:
        return Size(magnitude=np.where(share > 0, points.footprint.gain + 1.0, 0.0))
    apart = points.footprint.apart * points.per_range
    least = points.power_range(points.own_spread)[0]
    elsewhere = np.minimum(np.exp(np.minimum(points.tilt * apart, 50.0)), 1 / points.transfer**2)
    more = share * np.maximum(elsewhere, 1.0) * np.where(points.near_image, 2.0, 1.01)
    kept = np.maximum((1 - share) * least, 1e-9)
    return Size(magnitude=np.where(apart > 0, np.minimum(more / kept, 1e3), 0.0))


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
    size=size,
    act=act,
    within="footprint",
    apart=False,
)
