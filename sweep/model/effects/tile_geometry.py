"""What the beams of a block's tiles meet, as spans: a flat plane, or what rays have found."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects import plane_geometry
from sweep.model.effects.columns import columns
from sweep.model.effects.footprint_fields import (
    APART,
    BESIDE,
    GAIN,
    OWN_RANGES,
    RANGES,
    VELOCITIES,
    WHOLE,
)
from sweep.model.effects.line_spread import Moments
from sweep.model.effects.plane_geometry import put_planes
from sweep.model.effects.span import Span
from sweep.model.preparation import LASER, RECEIVER
from sweep.model.reflectance import LAWS

OF_PLANES = (
    "target.grazing_angle", LASER + "beam_divergence", "target.radial_velocity",
    "target.transverse_velocity",
)  # fmt: skip
"""What :func:`.plane_geometry.put_planes` takes the ends of."""


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
    architecture = str(p[RECEIVER + "architecture"])
    law = LAWS.index(str(p["target.reflectance_law"]))
    spans = [_number(p, path) for path in OF_PLANES]
    table, shape = columns(*(end for span in spans for end in (span.low, span.high)))
    found = np.empty((plane_geometry.FIELDS, *shape))
    beam = plane_geometry.beam_of(number, pattern, architecture)
    put_planes(table, law, beam, found.reshape(plane_geometry.FIELDS, -1))
    echo, ratio, gain = (Span(*found[k : k + 2]) for k in (0, 2, 4))
    ranges, velocities = (Moments(*found[k : k + 3]) for k in (6, 9))
    return Geometry(
        grazing_angle=spans[0],
        echo=echo,
        echo_ratio=ratio,
        gain=gain,
        ranges=ranges,
        own_ranges=ranges,
        velocities=velocities,
        beside_share=Span.of(0.0),
        flat=True,
    )


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
