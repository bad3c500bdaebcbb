"""What the beams of a block's tiles meet, as spans: a flat plane, or what rays have found."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sweep.model import reflectance
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.footprint_fields import (
    APART,
    BESIDE,
    GAIN,
    OWN_RANGES,
    RANGES,
    VELOCITIES,
    WHOLE,
    fields_of,
)
from sweep.model.effects.line_spread import (
    Moments,
    plane_range_moments,
    plane_velocity_moments,
    reach_of,
)
from sweep.model.effects.span import Span, monotone
from sweep.model.footprint import beamlets
from sweep.model.ground import Footprints
from sweep.model.preparation import LASER, RECEIVER

_ROUNDING = 1e-12


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """What the beams meet, by tile; echoes for a reflectance of 1."""

    grazing_angle: Span
    """[rad]; 0..pi/2 where the ground is no plane."""
    echo: Span
    """Of the bare line [1/sr]."""
    echo_ratio: Span
    """Echo of all beamlets over that of the bare line."""
    gain: Span
    """g = sum a_b / sqrt(sum a_b^2) of the beamlets' relative amplitudes, 1..sqrt(N); 1 for
    direct detection, whose bare line is the sum already."""
    ranges: Moments
    """Bounds on (R_b - R_0) / R_0."""
    own_ranges: Moments
    """Likewise, of the beamlets on the axis's surface only."""
    velocities: Moments
    """Bounds on the beamlets' radial velocities less the axis's [m/s]."""
    beside_share: Span
    """Share of the echo that comes from other surfaces than the axis's, 0..1."""
    beside_apart: np.ndarray | float = 0.0
    """Largest |R_b - R_0| / R_0 on other surfaces."""
    rotating: bool = False
    """Whether any surface belongs to a body that turns."""
    flat: bool = False
    """Whether the ground is a plane."""


def plane(p: Mapping[str, Span | str], number: int, pattern: str) -> Geometry:
    """Tiles of points on a flat plane: ``number`` beamlets in a pattern."""
    law = str(p["target.reflectance_law"])
    architecture = str(p[RECEIVER + "architecture"])
    angle, divergence, along, across = (
        _number(p, path)
        for path in (
            "target.grazing_angle", LASER + "beam_divergence", "target.radial_velocity",
            "target.transverse_velocity",
        )
    )  # fmt: skip
    shape: dict[str, Any] = {
        "grazing_angle": angle.low, "beam_divergence": divergence.high, "number": number,
        "pattern": pattern,
    }  # fmt: skip
    ranges = plane_range_moments(**shape)
    sideways = across.magnitude
    reach = reach_of(number, pattern) if number > 1 else 0.0
    each, whole = plane_echo(law, grazing_angle=angle, beam_divergence=divergence, reach=reach)
    return Geometry(
        grazing_angle=angle,
        echo=monotone(lambda angle: reflectance.backscatter(law, np.sin(angle)), angle=angle),
        echo_ratio=whole,
        gain=_plane_gain(architecture, number, pattern, each, whole),
        ranges=ranges,
        own_ranges=ranges,
        velocities=plane_velocity_moments(
            across=sideways, along=np.where(sideways > 0, along.magnitude, 0.0), **shape
        ),
        beside_share=Span.of(0.0),
        flat=True,
    )


def plane_echo(
    law: str, *, grazing_angle: Span, beam_divergence: Span, reach: float
) -> tuple[Span, Span]:
    """Echo of any beamlet, and of all of them, over what they would have on the axis.

    With u = y cot(g) for a beamlet tilted by y towards the near side and d its direction, whose
    length on the axis is 1, it is ((1 + u) / |d|)^m, m = 2 for laws that are even in all
    directions and 3 for Lambert's. u has the mean 0 and the rms q = (divergence/4) cot(g), so that
    the sum differs from 1 in the second order; where a beamlet may pass over the horizon only the
    beamlets' own bounds are left.

    Parameters
    ----------
    law : str
        Reflectance law, see :func:`sweep.model.reflectance.backscatter`.
    grazing_angle, beam_divergence : Span
        Angle between axis and plane, full 1/e^2 angle [rad].
    reach : float
        Farthest beamlet from the axis in standard deviations; 0 for one beamlet.
    """
    sigma, cot = beam_divergence / 4, monotone(_cotangent, falling=("angle",), angle=grazing_angle)
    rim, widest = reach * sigma.high, reach * sigma.high * cot.high
    power = 2 + float(np.log2(reflectance.backscatter(law, np.asarray(1.0))
                              / reflectance.backscatter(law, np.asarray(0.5))))  # fmt: skip
    longest = np.sqrt(1 + rim**2)
    near = np.minimum(1 + widest, 1 / np.sin(grazing_angle.low)) ** power
    far = (np.maximum(1 - widest, 0.0) / longest) ** power
    square = (sigma * cot) ** 2 if reach > 0 else Span.of(0.0)
    lean = 0.0 if power == 2 else widest
    inside = widest < 1
    more = 1 + (power * (power - 1) / 2 + lean) * square.high
    less = (1 + (power * (power - 1) / 2 - lean) * square.low) / longest**power
    whole = Span(
        np.maximum(np.where(inside, less, 0.0), far) * (1 - _ROUNDING),
        np.minimum(np.where(inside, more, np.inf), near) * (1 + _ROUNDING),
    )
    return Span(far, near), whole


def _cotangent(angle: np.ndarray) -> np.ndarray:
    return np.asarray(1 / np.tan(angle))


def _plane_gain(architecture: str, number: int, pattern: str, each: Span, whole: Span) -> Span:
    """Gain of beamlets whose echoes are the pattern's weights but for what the plane does."""
    if architecture == "direct":
        return Span.of(1.0)
    level = np.sqrt(beamlets(number, pattern)[1]).sum()
    found = (level * each.sqrt() / whole.sqrt()).minimum(np.sqrt(number))
    return Span(
        np.maximum(found.low * (1 - _ROUNDING), 1.0), np.maximum(found.high * (1 + _ROUNDING), 1.0)
    )


def cast(
    footprints: Footprints,
    beside: np.ndarray | None,
    edges: np.ndarray,
    architecture: str,
    rotating: bool,
) -> Geometry:
    """Tiles of shots whose footprints rays have found.

    Parameters
    ----------
    footprints, beside, edges, rotating
        As of :meth:`sweep.model.effects.block.Block.of_cast`.
    architecture : str
        The receiver's.
    """
    row, offset, doppler, echo = footprints
    others = np.zeros(echo.shape, np.bool_) if beside is None else beside
    found = fields_of(offset, doppler, echo, others, architecture != "direct")
    return of_fields(over(found[:, row], edges), rotating)


def of_fields(fields: Span, rotating: bool = False) -> Geometry:
    """Tiles by what is found in the footprints of their shots, (fields and more, tiles)."""
    low, high = np.asarray(fields.low), np.asarray(fields.high)
    doppler = high[VELOCITIES : VELOCITIES + 3]
    return Geometry(
        grazing_angle=Span(0.0, np.pi / 2),
        echo=Span(low[WHOLE], high[WHOLE]),
        echo_ratio=Span.of(1.0),
        gain=Span(low[GAIN], high[GAIN]),
        ranges=Moments(*high[RANGES : RANGES + 3]),
        own_ranges=Moments(*high[OWN_RANGES : OWN_RANGES + 3]),
        velocities=Moments(*(doppler * (SPEED_OF_LIGHT / 2))),
        beside_share=Span(low[BESIDE], high[BESIDE]),
        beside_apart=high[APART],
        rotating=rotating,
    )


def over(values: np.ndarray, edges: np.ndarray) -> Span:
    """Least and largest of (..., n) values over each tile, from one edge up to the next."""
    starts = edges[:-1]
    return Span(
        np.minimum.reduceat(values, starts, axis=-1), np.maximum.reduceat(values, starts, axis=-1)
    )


def _number(p: Mapping[str, Span | str], path: str) -> Span:
    value = p[path]
    if isinstance(value, str):
        raise TypeError(f"{path} is a word: {value}")
    return value
