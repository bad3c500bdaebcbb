"""Doppler: the shift 2 v_r / lambda of every line.

Without it nothing is known of velocity at all, whatever the detection probability says: it is
left out where nothing moves, :func:`shift` telling by how much lines would move. Otherwise the
bound says what the shift does to detection: the receiver's transfer at the new frequency, and
where between two bins the line comes to lie.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.change import Change
from sweep.model.effects.line_spread import NO_SPREAD, Line, Moments, moved_change
from sweep.model.preparation import Shots


def shift(
    *,
    radial_velocity: ArrayLike,
    range: ArrayLike,
    carrier: ArrayLike,
    chirp_rate: ArrayLike,
    bin_width: ArrayLike,
) -> np.ndarray:
    """Bins by which the Doppler effect moves a line at the most, >= 0 (unfolded).

    f beta, and the S tau beta by which it stretches the beat of the range.
    """
    beta = 2 * np.abs(np.asarray(radial_velocity, float)) / SPEED_OF_LIGHT
    beat = np.asarray(chirp_rate, float) * (2 / SPEED_OF_LIGHT) * np.asarray(range, float)
    return np.asarray(beta * (np.asarray(carrier) + beat) / np.asarray(bin_width))


def bound(
    moving: Line, resting: Line, *, shift: ArrayLike, spread: Moments, beamlets: int
) -> Change:
    """What the shift can change in the largest bin of a segment.

    Parameters
    ----------
    moving, resting : Line
        Of the axis, at its radial velocity and at none.
    shift : array_like
        Bins between them, unfolded: :func:`shift`.
    spread : Moments
        Bins by which ranges and velocities put the lines off the axis's.
    beamlets : int
        Their number.
    """
    return moved_change(moving, resting, shift, NO_SPREAD, spread, beamlets)


def without(shots: Shots) -> Shots:
    """The same points with their axes at rest; beamlets keep their differences of velocity."""
    return replace(shots, radial_velocity=np.zeros_like(shots.radial_velocity))
