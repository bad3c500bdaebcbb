"""Doppler spread: the beam's divergence sees a velocity across it as different radial velocities.

Called for when 2/lambda |v_perp| div is not small against a bin (100 m/s across and 50 urad:
1.4 bins of 4.6 kHz). It acts on the lines' positions in all three segments.
"""

from dataclasses import replace

import numpy as np

from sweep.model.effects.change import Change
from sweep.model.effects.footprint import collapsed
from sweep.model.effects.line_spread import NO_SPREAD, Line, Moments, spread_change
from sweep.model.preparation import Shots


def bound(line: Line, *, velocities: Moments, ranges: Moments = NO_SPREAD, beamlets: int) -> Change:
    """What differences of velocity can change in the largest bin of a segment.

    Parameters
    ----------
    line : Line
        Of the axis.
    velocities, ranges : Moments
        Bins by which velocities and ranges put the lines off it (ranges: 0 in the Doppler
        segment, and for a footprint that is left out).
    beamlets : int
        Their number.
    """
    return spread_change(line, velocities, ranges, beamlets)


def without(shots: Shots) -> Shots:
    """The same points with every beamlet at the axis's radial velocity."""
    level = replace(shots, doppler=np.zeros_like(shots.doppler))
    if shots.incoherent and not shots.offset.any():
        return collapsed(level)
    return level
