"""Footprint: the ranges of a beam's beamlets, which spread its line over bins.

Called for when S 2/c R div cot(grazing) N/fs is not small. It acts on the lines' positions; a
beam without it has one line, on its axis, of all its echo's power. Phases between beamlets are
an effect of their own (:mod:`sweep.model.effects.footprint_phase`), the velocities too
(:mod:`sweep.model.effects.doppler_spread`).
"""

from dataclasses import replace

import numpy as np

from sweep.model.effects.change import Change
from sweep.model.effects.line_spread import NO_SPREAD, Line, Moments, spread_change
from sweep.model.preparation import Shots


def bound(line: Line, *, ranges: Moments, velocities: Moments = NO_SPREAD, beamlets: int) -> Change:
    """What the footprint's spread of range can change in the largest bin of a segment.

    Parameters
    ----------
    line : Line
        Of the axis.
    ranges, velocities : Moments
        Bins by which ranges (0 in the Doppler segment) and velocities put the lines off it. That
        the velocities' are there already makes no difference to whether this is a bound.
    beamlets : int
        Their number.
    """
    return spread_change(line, ranges, velocities, beamlets)


def without(shots: Shots) -> Shots:
    """The same points with every beamlet at the axis's range.

    Where their velocities are alike too, one beamlet with the echo power of all is left.

    Raises
    ------
    ValueError
        Where phases are coherent: they are nothing without the ranges, and go first. Direct
        detection adds its beats in phase, as one surface across the beam has them.
    """
    if not shots.incoherent and shots.architecture != "direct" and shots.offset.shape[1] > 1:
        raise ValueError("a footprint's phases go before its ranges: leave them out first")
    level = replace(shots, offset=np.zeros_like(shots.offset))
    return level if shots.doppler.any() else collapsed(level)


def collapsed(shots: Shots) -> Shots:
    """One beamlet on the axis with all power."""
    echo = shots.amplitude
    direct = shots.architecture == "direct"
    whole = echo.sum(axis=1) if direct else np.sqrt((echo**2).sum(axis=1))
    nothing = np.zeros((len(echo), 1))
    return replace(shots, offset=nothing, doppler=nothing, amplitude=whole[:, None])
