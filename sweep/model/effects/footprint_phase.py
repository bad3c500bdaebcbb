"""Footprint phase: beamlets of a smooth surface add as amplitudes, with the phases of its shape.

The round trip to beamlet b differs by 4 pi/lambda (R_b - R_0) in phase. Where that is not small
against 1 the sum may be anything from nothing to sqrt(N) times (Cauchy and Schwarz) what the
powers make; where it is, beamlets add in phase to g = sum a_b / sqrt(sum a_b^2) times that, which
is no less of a change: it is kept wherever there are several beamlets. One beamlet's line adds to
its own image. It acts on the sum of the lines: without it their powers add.
"""

from dataclasses import replace

from sweep.model.effects import image
from sweep.model.effects.effect import Effect, Scene, Size
from sweep.model.effects.points import Points
from sweep.model.preparation import Shots


def size(points: Points) -> Size | None:
    """What phases change in the largest bin: it may fade, or gain what a sum in phase does."""
    if not points.by_roots:
        return None
    if points.number == 1:
        return image.size(points)
    return Size(magnitude=points.footprint.gain)


def act(shots: Shots, scene: Scene) -> Shots:
    """Beamlets that add as amplitudes, where the spec says that their phases follow the surface."""
    if str(scene.parameters["footprint.phases"]) != "coherent":
        return shots
    return replace(shots, incoherent=False)


EFFECT = Effect(
    name="footprint_phase",
    about="optical phases of a smooth surface",
    stage="lines",
    size=size,
    act=act,
    within="footprint",
)
