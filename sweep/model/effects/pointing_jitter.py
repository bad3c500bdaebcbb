"""Pointing jitter over a plane: a random turn of the beam, draw by draw.

The beam is thrown off by two independent normal angles of deviation sigma, a in the plane of
incidence (towards grazing) and b across it. From the same height over the same plane it then meets

    sin(grazing') = sin(grazing) cos(t) - a cos(grazing) sin(t)/t,     t^2 = a^2 + b^2
    range' = range sin(grazing) / sin(grazing'),

to first order range (1 + a cot(grazing)); along the normal, range (1 + t^2/2). The instrument
knows nothing of it: its reports are of the turned beam.

It acts before everything else, on the geometry of a draw, from which echo, lines and noise follow
as ever; the footprint turns with its axis. If phases follow the geometry, the footprint of
every draw fades anew.

Of the velocity, a plane's target gives what lies along the beam. The velocity across may be given
too. The turned beam sees v_r cos(t) + (v_a a + v_b b) sin(t)/t.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.effects.effect import Effect, Parameter, Realisation, Size
from sweep.model.effects.points import Points, Smear, by_power
from sweep.model.footprint import NO_SPREAD, reach_of

RARE = 1e-6
"""Probability of a draw whose beam is further off than its size takes it to be."""

_JITTER = "target.pointing_jitter"


class Turned(NamedTuple):
    """Geometry of a turned beam, each of the broadcast shape; nan where it misses the plane."""

    range: np.ndarray
    """[m]"""
    grazing_angle: np.ndarray
    """[rad]"""
    radial_velocity: np.ndarray
    """[m/s], positive when closing."""


def angles(realisation: Realisation, sigma: np.ndarray) -> np.ndarray:
    """Angles (a, b) by which beams of this standard deviation are off, (n, 2) [rad]."""
    from sweep.model.philox import STREAM_POINTING_JITTER, normals, uniforms

    draws = uniforms(realisation.keys, realisation.draw, STREAM_POINTING_JITTER, 2)
    return normals(draws) * np.asarray(sigma, float)[..., None]


def turned(
    *,
    range: ArrayLike,
    grazing_angle: ArrayLike,
    radial_velocity: ArrayLike,
    angles: np.ndarray,
    velocity_across: ArrayLike = (0.0, 0.0),
) -> Turned:
    """Geometry of beams that are off by some angles (..., 2) [rad].

    Range, grazing angle and velocity [m, rad, m/s] are those of the axis as aimed; they broadcast
    against the angles' leading axes. The angles are a, positive towards grazing (upwards), and b,
    and `velocity_across` (..., 2) the instrument's velocity along their directions [m/s].
    """
    aimed, off = np.asarray(grazing_angle, float), np.asarray(angles, float)
    angle = np.hypot(off[..., 0], off[..., 1])
    ratio, cosine = np.sinc(angle / math.pi), np.cos(angle)
    sine = np.sin(aimed) * cosine - off[..., 0] * np.cos(aimed) * ratio
    ahead = np.cos(aimed) * cosine + off[..., 0] * np.sin(aimed) * ratio
    grazing = np.arctan2(sine, np.hypot(ahead, off[..., 1] * ratio))
    across = (np.asarray(velocity_across, float) * off).sum(axis=-1) * ratio
    hits = sine > 0
    far = np.asarray(range, float) * np.sin(aimed) / np.where(hits, sine, 1.0)
    return Turned(
        np.where(hits, far, np.nan),
        np.where(hits, grazing, np.nan),
        np.asarray(radial_velocity, float) * cosine + across,
    )


def _furthest(points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Ratio of ranges, less 1, and bins by which lines move, by the furthest turn but for few.

    Down to the lowest beamlets; infinite where one may pass over the horizon.
    """
    off = points[_JITTER] * math.sqrt(2 * math.log(1 / RARE))
    rim: np.ndarray | float = 0.0
    if points.number > 1:
        rim = reach_of(points.number, points.pattern) * points.angles.places / 4
    lowest = points["target.grazing_angle"] - rim
    sure = lowest > off
    lowest = np.where(sure, lowest, 1.0)
    ratio = np.where(sure, np.sin(lowest) / np.sin(lowest - np.where(sure, off, 0.0)) - 1, np.inf)
    across = np.abs(points["target.transverse_velocity"])
    doppler = np.abs(points.radial_velocity) * off**2 / 2 + across * off
    ratio = np.where(off > 0, np.maximum(ratio, off**2 / 2), 0.0)
    bins = points.per_range * np.minimum(ratio, 1e6) + points.per_velocity * doppler
    return ratio, bins


def smear(points: Points) -> Smear | None:
    """Reach of lines that draws throw off."""
    if not points.has(_JITTER):
        return None
    return Smear(reach=_furthest(points)[1] / points.margin)


def size(points: Points) -> Size | None:
    """Change by leaving jitter out in all draws but few.

    Echo powers go by the cube of the ratio of ranges (1/R^2 and at most Lambert's cosine). A
    footprint whose phases follow its geometry may fade altogether, or not any more, and so may
    lines with their images: of those nothing is known.
    """
    if not points.has(_JITTER):
        return None
    ratio, bins = _furthest(points)
    echo = 3 * ratio * (1 + ratio) ** 2
    power = points.moved(NO_SPREAD, points.spread, bins) + echo
    unknown = points.may_cancel & (points[_JITTER] > 0)
    added: np.ndarray | float = 0.0
    if points.may_add:  # a line turns against its image as the range changes
        turns = points.carriers * points.delay * np.minimum(ratio, 1e6)
        added = points.image * np.minimum(4 * math.pi * turns, 2.0)
    return Size(
        magnitude=np.where(unknown, 1.0, by_power(power)),
        added=added,
        noise=np.minimum(echo, 1e6) * points.echo_noise,
        threshold_follows=False,
    )


def turn(p: dict[str, np.ndarray], realisation: Realisation) -> dict[str, np.ndarray]:
    """Range, grazing angle and velocities of beams that are off; no echo where they miss."""
    off = angles(realisation, p[_JITTER])
    across = np.zeros_like(off)
    across[:, 0] = -p["target.transverse_velocity"]  # towards the near side is off grazing
    aimed = {name: p[f"target.{name}"] for name in Turned._fields}
    seen = turned(angles=off, velocity_across=across, **aimed)
    hits = np.isfinite(seen.range)
    return p | {
        "target.range": np.where(hits, seen.range, 1.0),
        "target.grazing_angle": np.where(hits, seen.grazing_angle, math.pi / 2),
        "target.radial_velocity": seen.radial_velocity,
        "target.reflectance": np.where(hits, p["target.reflectance"], 0.0),
    }


POINTING_JITTER = Effect(
    name="pointing_jitter",
    about="a beam that wanders from shot to shot",
    stage="draws",
    size=size,
    smear=smear,
    turn=turn,
    parameters=(
        Parameter(
            path=_JITTER,
            about="Standard deviation of the beam's direction, on each axis, from shot to shot",
            example="20 urad",
            limits=("0 rad", "10 deg"),
        ),
    ),
)
