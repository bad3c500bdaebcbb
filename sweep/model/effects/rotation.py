"""Rotation of a body in the scene: its surface moves with V + omega x (P - X).

A beamlet along d_b that meets the body at P_b = O + R_b d_b, seen from O, has from the rotation
the closing speed -omega x (P_b - X) . d_b = -omega x (O - X) . d_b: R_b falls out. Rotation is
thus what a velocity -omega x (O - X) of the instrument would be, whatever the body's form: a
Doppler shift by its component along the beam, a Doppler spread by that across it.
"""

from sweep.model.effects.effect import Effect, Size
from sweep.model.effects.points import Points


def size(points: Points) -> Size | None:
    """Whether anything turns: what it does to velocities is in the scene, and not left out."""
    return Size(chance=1.0) if points.rotating else None


EFFECT = Effect(
    name="rotation",
    about="surfaces of turning bodies",
    stage="lines",
    size=size,
)
