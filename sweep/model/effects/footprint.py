"""Footprint: the ranges of a beam's beamlets, which spread its line over bins.

Called for when S 2/c R div cot(grazing) N/fs is not small. It acts on the lines' positions; a
beam without it has one line, on its axis, of all its echo's power. Phases between beamlets are
an effect of their own (:mod:`sweep.model.effects.footprint_phase`), the velocities too
(:mod:`sweep.model.effects.doppler_spread`).
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sweep.model.effects import footprint_phase
from sweep.model.effects.change import Change
from sweep.model.effects.effect import Effect, Parameter, Scene
from sweep.model.effects.line_spread import NO_SPREAD, spread_change
from sweep.model.effects.span import Span
from sweep.model.footprint import PATTERNS
from sweep.model.preparation import Shots, relative_amplitude

if TYPE_CHECKING:
    from sweep.model.effects.block import Block


def bound(block: "Block") -> Change | None:
    """What the ranges of the footprint can change in the largest bin, and how much more it echoes.

    Of powers, without velocities, other surfaces or phases: these are within it. In direct
    detection the echoes' beats always add as amplitudes, with the phases that the ranges give to
    the radio frequency.
    """
    if block.number == 1:
        return None
    spread, ratio = block.spreads.own_ranges, block.echo_ratio
    if block.architecture != "direct":
        change = spread_change(block.lines, spread, NO_SPREAD, block.number)
        ratio = ratio.sqrt()
    else:
        uphill = np.exp(np.minimum(block.lines.tilt * spread.extreme, 50.0))
        most = 2.1 * uphill / block.lines.lobe.worst  # all, and their images
        phase = footprint_phase.phase_reach(block, block.geometry.own_ranges, NO_SPREAD)
        change = footprint_phase.sum_change(
            block.lines, phase=phase, gain=Span.of(1.0), spread=spread, most=most
        )
    low, high = change.signal
    return Change(signal=(np.multiply(low, ratio.low), np.multiply(high, ratio.high)))


def act(shots: Shots, scene: Scene) -> Shots:
    """Beamlets at their own ranges, those on other surfaces at the axis's, all of its velocity."""
    row, offset, _, echo = scene.ground.beamlets
    if scene.ground.beside is not None:
        offset = np.where(scene.ground.beside, 0.0, offset)
    return replace(
        shots,
        row=row,
        offset=offset,
        doppler=np.zeros_like(offset),
        amplitude=relative_amplitude(shots.architecture, echo),
    )


EFFECT = Effect(
    name="footprint",
    about="beamlets at ranges of their own",
    stage="lines",
    bound=bound,
    act=act,
    parameters=(
        Parameter(
            path="footprint.pattern",
            about="Arrangement of the beamlets; auto: as many as the tolerance needs lie in a line "
            "along the slope, a given number in a hexagonal lattice where their powers add, else "
            "in a sunflower",
            default="auto",
            options=("auto", *PATTERNS),
        ),
    ),
)
