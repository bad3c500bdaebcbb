"""Scan patterns: where the beams point, and when."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

import sweep.spec.declaring as of
from sweep.model.geometry import scanner as patterns
from sweep.model.geometry.scanner import Scanner
from sweep.spec.parts import Part
from sweep.spec.rules import Beams

Numbers = tuple[float, ...]

MOST_BEAMS = "10000"
_REACH = ("0 deg", "89 deg")


def _rate() -> Any:
    return of.frequency("Measurement cycles a second")


def _interval(default: str, value: float | None) -> Any:
    """Field of the time from beam to beam."""
    about = f"Time from one beam of a cycle to the next; {default} by default"
    return of.duration(about, "10 ms", default=value)


def _together() -> Any:
    return _interval("0, all at once,", 0.0)


def _spread() -> Any:
    return _interval("spread evenly over the cycle", None)


def _angles(about: str, example: str, *bounds: str, number: tuple[int, int], **more: Any) -> Any:
    """Field of several angles."""
    return of.several(of.measure("Angle", "rad", example, *bounds), *number, about=about, **more)


class Cone(Part):
    """Beams evenly round nadir, all of them in every cycle."""

    kind: Literal["cone"]
    beams: int = of.count("Beams", "3", at_most=MOST_BEAMS)
    half_angle: float = of.angle("From nadir", "22.5 deg", *_REACH)
    azimuth: float = of.angle("Of the first beam, from forward to the left", default=0.0)
    rate: float = _rate()
    interval: float = _together()

    def pattern(self) -> Scanner:
        """The scan pattern."""
        pointed = patterns.cone(self.beams, half_angle=self.half_angle, azimuth=self.azimuth)
        return patterns.fixed(pointed, rate=self.rate, interval=self.interval)


class FixedBeams(Part):
    """Beams at stated directions, all of them in every cycle."""

    kind: Literal["fixed"]
    beams: tuple[Numbers, ...] = of.field(
        Beams(about="Angles towards forward and left, or vectors in the body frame, of each beam")
    )
    rate: float = _rate()
    interval: float = _together()

    def pattern(self) -> Scanner:
        """The scan pattern."""
        pointed = [patterns.steered(*b) if len(b) == 2 else np.array(b) for b in self.beams]  # type: ignore[arg-type]
        return patterns.fixed(np.array(pointed), rate=self.rate, interval=self.interval)


class Corners(Part):
    """One steered beam that visits the corners of a square."""

    kind: Literal["corners"]
    angle: float = of.angle("Of both axes from nadir", "22.5 deg", *_REACH)
    rate: float = _rate()
    interval: float | None = _spread()

    def pattern(self) -> Scanner:
        """The scan pattern."""
        return patterns.fixed(patterns.corners(self.angle), rate=self.rate, interval=self.interval)


class Squares(Part):
    """One beam steered by stacked elements, square after square; a cycle is a square."""

    kind: Literal["squares"]
    elements: Numbers = _angles(
        "Angle by which each element of an axis throws the beam to either side",
        "15 deg", "1e-6 deg", "45 deg", number=(1, 5),
    )  # fmt: skip
    rate: float = _rate()
    interval: float | None = _spread()

    def pattern(self) -> Scanner:
        """The scan pattern."""
        directions, visited = patterns.squares(self.elements)
        return patterns.BeamCycle(directions, visited, self.rate, self.interval)


class RasterScan(Part):
    """One steered beam that visits a grid of directions; a cycle is a frame."""

    kind: Literal["raster"]
    columns: int = of.count("Directions across", "32", at_most=MOST_BEAMS)
    rows: int = of.count("Directions along", "32", at_most=MOST_BEAMS)
    half_angles: Numbers = _angles(
        "Reach to each side of nadir, across and along", "10 deg", *_REACH, number=(2, 2)
    )
    rate: float = _rate()
    both_ways: bool = of.flag("Every other row runs backwards", default=True)

    def pattern(self) -> Scanner:
        """The scan pattern."""
        across, along = self.half_angles
        return patterns.raster(
            columns=self.columns,
            rows=self.rows,
            half_angles=(across, along),
            rate=self.rate,
            both_ways=self.both_ways,
        )


class Line(Part):
    """Beams swept together from side to side; a cycle is one measurement of each."""

    kind: Literal["line"]
    half_angle: float = of.angle("Reach of the sweep to each side", "5 deg", *_REACH)
    line_rate: float = of.frequency("Lines a second; a sweep one way is a line")
    rate: float = _rate()
    along: Numbers = _angles(
        "Angle of each beam from nadir towards forward",
        "250 urad", "-89 deg", "89 deg", number=(1, 1000), default=(0.0,),
    )  # fmt: skip
    wave: str = of.choice("Constant rate or resonant mirror", ("triangle", "sine"), "triangle")
    interval: float = _together()

    def pattern(self) -> Scanner:
        """The scan pattern."""
        return patterns.LineScan(**self.model_dump(exclude={"kind"}))


AnyScanner = Annotated[
    Cone | FixedBeams | Corners | Squares | RasterScan | Line, Field(discriminator="kind")
]


def shots_a_cycle(pattern: Scanner) -> int:
    """Shots of one measurement cycle."""
    if isinstance(pattern, patterns.BeamCycle):
        return pattern.beams_per_cycle
    return pattern.beams
