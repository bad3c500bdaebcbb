"""Several returns: a footprint on more than one surface, each with its own group of bins.

Called for where an edge lies in the footprint. It acts on the lines' positions: without it the
beamlets beside the axis's surface send their power back from the axis's own range.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from sweep.model.effects.change import Change
from sweep.model.effects.columns import columns
from sweep.model.effects.effect import Effect, Scene
from sweep.model.effects.line_powers import image_factor_of, uphill_of
from sweep.model.effects.line_spread import NO_SPREAD, Moments, power_range
from sweep.model.effects.lobes import lobe_least
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
    line = block.lines
    apart = block.of_ranges(Moments(0.0, 0.0, block.beside_apart)).extreme
    own, _ = power_range(line, block.spreads.own_ranges, block.number)
    _, on_axis = power_range(line, NO_SPREAD, block.number)
    table, shape = columns(
        block.beside_share.high, apart, own, on_axis, line.edge, line.transfer_least, line.tilt
    )  # fmt: skip
    found, lobe = np.empty((2, *shape)), line.lobe
    put_changes(table, lobe.margin, lobe.lowest, block.adds_amplitudes, found.reshape(2, -1))
    return Change(signal=(found[0], found[1]))


@njit(cache=True, error_model="numpy")
def put_changes(table, margin, lowest, amplitudes, out):
    """Least and largest factor on magnitudes, (2, n).

    Rows of the table: share beside the axis's surface, and how far its lines lie apart; least power
    of the largest bin of the axis's own lines, largest of one on the axis; edge, least transfer
    and tilt of the axis's line.
    """
    for i in range(table.shape[1]):
        share, apart, least, on_axis, edge, transfer, tilt = table[:, i]
        f = min(max(share, 0.0), 1.0)
        own = (1 - f) * least
        low, high = 1.0, 1.0
        if f > 0 and apart > 0:
            elsewhere = np.fmin(uphill_of(tilt, apart), 1 / (transfer * transfer))
            more = elsewhere * image_factor_of(edge, apart, margin)
            low, high = np.sqrt(own / (own + f * on_axis)), np.sqrt(1 + f * more / own)
        if amplitudes and f > 0:
            all_in_phase = 2 / (transfer * lobe_least(lowest, 0.5))
            low, high = 0.0, np.maximum(high, all_in_phase)
        out[0, i], out[1, i] = low, high


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
