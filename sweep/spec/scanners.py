"""Scan patterns: where the beams point, and when."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

import sweep.spec.quantities as of
from sweep.model.geometry.scanner import (
    BeamCycle,
    LineScan,
    Scanner,
    cone,
    corners,
    fixed,
    raster,
    squares,
    steered,
)
from sweep.spec.instrument import Part
from sweep.spec.list_rules import Beams, Flag, Several
from sweep.spec.rules import Choice, Numeric

Numbers = tuple[float, ...]

MOST_BEAMS = "10000"
_RATE = of.frequency("Measurement cycles a second")
_REACH = {"at_least": "0 deg", "at_most": "89 deg"}


def _interval(default: str) -> Numeric:
    about = f"Time from one beam of a cycle to the next; {default} by default"
    return of.duration(about, "10 ms")


_TOGETHER = _interval("0, all at once,")
_SPREAD = _interval("spread evenly over the cycle")


class Cone(Part):
    """Beams evenly round nadir, all of them in every cycle."""

    kind: Literal["cone"]
    beams: Annotated[int, of.count("Beams", "3", at_most=MOST_BEAMS)]
    half_angle: Annotated[float, of.angle("From nadir", "22.5 deg", **_REACH)]
    azimuth: Annotated[float, of.angle("Of the first beam, from forward to the left")] = 0.0
    rate: Annotated[float, _RATE]
    interval: Annotated[float, _TOGETHER] = 0.0

    def pattern(self) -> Scanner:
        """The scan pattern."""
        pointed = cone(self.beams, half_angle=self.half_angle, azimuth=self.azimuth)
        return fixed(pointed, rate=self.rate, interval=self.interval)


class FixedBeams(Part):
    """Beams at stated directions, all of them in every cycle."""

    kind: Literal["fixed"]
    beams: Annotated[
        tuple[Numbers, ...],
        Beams(about="Angles towards forward and left, or vectors in the body frame, of each beam"),
    ]
    rate: Annotated[float, _RATE]
    interval: Annotated[float, _TOGETHER] = 0.0

    def pattern(self) -> Scanner:
        """The scan pattern."""
        pointed = [steered(*b) if len(b) == 2 else np.array(b) for b in self.beams]  # type: ignore[arg-type]
        return fixed(np.array(pointed), rate=self.rate, interval=self.interval)


class Corners(Part):
    """One steered beam that visits the corners of a square."""

    kind: Literal["corners"]
    angle: Annotated[float, of.angle("Of both axes from nadir", "22.5 deg", **_REACH)]
    rate: Annotated[float, _RATE]
    interval: Annotated[float | None, _SPREAD] = None

    def pattern(self) -> Scanner:
        """The scan pattern."""
        return fixed(corners(self.angle), rate=self.rate, interval=self.interval)


class Squares(Part):
    """One beam steered by stacked elements, square after square; a cycle is a square."""

    kind: Literal["squares"]
    elements: Annotated[
        Numbers,
        Several(
            about="Angle by which each element of an axis throws the beam to either side",
            of=of.angle("Angle", "15 deg", at_least="1e-6 deg", at_most="45 deg"),
            least=1,
            most=5,
        ),
    ]
    rate: Annotated[float, _RATE]
    interval: Annotated[float | None, _SPREAD] = None

    def pattern(self) -> Scanner:
        """The scan pattern."""
        directions, patterns = squares(self.elements)
        return BeamCycle(directions, patterns, self.rate, self.interval)


class RasterScan(Part):
    """One steered beam that visits a grid of directions; a cycle is a frame."""

    kind: Literal["raster"]
    columns: Annotated[int, of.count("Directions across", "32", at_most=MOST_BEAMS)]
    rows: Annotated[int, of.count("Directions along", "32", at_most=MOST_BEAMS)]
    half_angles: Annotated[
        Numbers,
        Several(
            about="Reach to each side of nadir, across and along",
            of=of.angle("Angle", "10 deg", **_REACH),
            least=2,
            most=2,
        ),
    ]
    rate: Annotated[float, _RATE]
    both_ways: Annotated[bool, Flag(about="Every other row runs backwards")] = True

    def pattern(self) -> Scanner:
        """The scan pattern."""
        across, along = self.half_angles
        return raster(
            columns=self.columns,
            rows=self.rows,
            half_angles=(across, along),
            rate=self.rate,
            both_ways=self.both_ways,
        )


class Line(Part):
    """Beams swept together from side to side; a cycle is one measurement of each."""

    kind: Literal["line"]
    half_angle: Annotated[float, of.angle("Reach of the sweep to each side", "5 deg", **_REACH)]
    line_rate: Annotated[float, of.frequency("Lines a second; a sweep one way is a line")]
    rate: Annotated[float, _RATE]
    along: Annotated[
        Numbers,
        Several(
            about="Angle of each beam from nadir towards forward",
            of=of.angle("Angle", "250 urad", at_least="-89 deg", at_most="89 deg"),
            least=1,
            most=1000,
        ),
    ] = (0.0,)
    wave: Annotated[
        str, Choice(about="Constant rate or resonant mirror", options=("triangle", "sine"))
    ] = "triangle"
    interval: Annotated[float, _TOGETHER] = 0.0

    def pattern(self) -> Scanner:
        """The scan pattern."""
        return LineScan(
            half_angle=self.half_angle,
            line_rate=self.line_rate,
            rate=self.rate,
            along=self.along,
            wave=self.wave,
            interval=self.interval,
        )


AnyScanner = Annotated[
    Cone | FixedBeams | Corners | Squares | RasterScan | Line, Field(discriminator="kind")
]


def shots_a_cycle(pattern: Scanner) -> int:
    """Shots of one measurement cycle."""
    return pattern.beams_per_cycle if isinstance(pattern, BeamCycle) else pattern.beams
