"""Rotation of a body in the scene: its surface moves with V + omega x (P - X).

A beamlet along d_b that meets the body at P_b = O + R_b d_b, seen from O, has from the rotation
the closing speed -omega x (P_b - X) . d_b = -omega x (O - X) . d_b: R_b falls out. Rotation is
thus what a velocity -omega x (O - X) of the instrument would be, whatever the body's form: a
Doppler shift by its component along the beam, a Doppler spread by that across it.
"""

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.change import Change
from sweep.model.effects.line_spread import Line, Moments, moved_change
from sweep.model.geometry.platform import State


def equivalent_velocity(
    *, rate: np.ndarray, instrument: np.ndarray, pivot: np.ndarray
) -> np.ndarray:
    """Velocity of the instrument that would do what the rotation does [m/s], (n, 3).

    Parameters
    ----------
    rate : (n, 3) ndarray
        Angular velocity of the body, omega [rad/s].
    instrument, pivot : (n, 3) ndarray
        O and X [m]; X is the point whose velocity is called the body's.
    """
    return np.asarray(-np.cross(rate, np.asarray(instrument) - np.asarray(pivot)))


def bound(
    turning: Line,
    still: Line,
    *,
    shift: ArrayLike,
    velocities: Moments,
    present: Moments,
    beamlets: int,
) -> Change:
    """What a rotation can change in the largest bin of a segment.

    Parameters
    ----------
    turning, still : Line
        Of the axis, with the rotation's radial velocity and without.
    shift : array_like
        Bins between them (:func:`sweep.model.effects.doppler.shift`).
    velocities, present : Moments
        Bins by which it spreads the lines, and those of the spread there is without it.
    beamlets : int
        Their number.
    """
    return moved_change(turning, still, shift, velocities, present, beamlets)


def without(state: State) -> State:
    """The motion of a body that keeps its path and its attitudes, its surface not turning."""
    return state._replace(rate=np.zeros_like(state.rate))
