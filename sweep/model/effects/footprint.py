"""Footprint: beamlets at ranges of their own, on one surface or several, with or without phases.

A beam without it has one line, on its axis, of all its echo's power. It matters where
S 2/c R div cot(grazing) N/fs is not small.
"""

from dataclasses import replace

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects import sidelobes
from sweep.model.effects.effect import Effect, Parameter, Scene, Size
from sweep.model.effects.points import Points, by_power
from sweep.model.footprint import NO_SPREAD, PATTERNS
from sweep.model.preparation import CHIRP, Shots, relative_amplitude


def size(points: Points) -> Size | None:
    """Change of the largest bin by the ranges of the footprint, and by how much more it echoes.

    Of powers, without velocities, other surfaces or phases: these are within it. In direct
    detection the echoes' beats always add as amplitudes, with the phases that the ranges give to
    the radio frequency.
    """
    if points.number == 1:
        return None
    power = points.moved(points.own_spread, NO_SPREAD)
    echo = 2 * np.abs(points.footprint.echo_ratio - 1)
    if points.architecture != "direct":
        return Size(magnitude=by_power(power + echo))
    away = points.range * points.footprint.own_ranges.extreme
    highest = points.carriers + 2 * points[CHIRP + "bandwidth"]
    phase = np.minimum(4 * np.pi / SPEED_OF_LIGHT * highest * away, 2.0)
    beside = np.where(points.near_image, 2 * phase, 0.5 * phase**2)
    return Size(magnitude=by_power(power + echo) + beside + echo)


def spread_out(shots: Shots, scene: Scene) -> Shots:
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


FOOTPRINT = Effect(
    name="footprint",
    about="beamlets at ranges of their own",
    stage="lines",
    size=size,
    act=spread_out,
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


def phase_size(points: Points) -> Size | None:
    """Change of the largest bin by optical phases: it may fade, or gain as a sum in phase does.

    The round trip to beamlet b differs by 4 pi/lambda (R_b - R_0) in phase. If that is not small
    against 1 the sum may be anything from nothing to sqrt(N) times (Cauchy and Schwarz) what the
    powers make. If it is small, beamlets add in phase to g = sum a_b / sqrt(sum a_b^2) times that,
    which is no less of a change. So the effect is kept wherever there are several beamlets. One
    beamlet's line adds to its own image.
    """
    if not points.by_roots:
        return None
    if points.number == 1:
        return sidelobes.image_size(points)
    return Size(magnitude=points.footprint.gain)


def add_amplitudes(shots: Shots, scene: Scene) -> Shots:
    """Beamlets that add as amplitudes, where the spec says that their phases follow the surface."""
    if str(scene.parameters["footprint.phases"]) != "coherent":
        return shots
    return replace(shots, incoherent=False)


FOOTPRINT_PHASE = Effect(
    name="footprint_phase",
    about="optical phases of a smooth surface",
    stage="lines",
    size=phase_size,
    act=add_amplitudes,
    within="footprint",
)


def surfaces_size(points: Points) -> Size | None:
    """Change of the largest bin by the ranges of other surfaces than the axis's.

    As powers, with a share f off the axis's surface, whose own lines put a in their largest bin.
    With the effect that bin holds a at the least, and no bin more than a + f. Without it the
    largest holds a at the least, and a and f's line on the axis at the most. Of amplitudes that add
    nothing is known but that no bin holds more than all in phase.
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


def part_surfaces(shots: Shots, scene: Scene) -> Shots:
    """Beamlets on other surfaces than the axis's at ranges of their own, where there are any.

    Without the effect they send their power back from the axis's own range.
    """
    offset = scene.ground.beamlets.offset
    if scene.ground.beside is None or shots.offset.shape != offset.shape:
        return shots
    offset = scene.beamlets("several_returns", shots.row, offset, shots.offset)
    return replace(shots, offset=offset)


SEVERAL_RETURNS = Effect(
    name="several_returns",
    about="more than one surface in a footprint",
    stage="lines",
    size=surfaces_size,
    act=part_surfaces,
    within="footprint",
    apart=False,
)
