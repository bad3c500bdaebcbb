"""Movement of things and directions of beams: paths, attitudes, the platform, scan patterns."""

from __future__ import annotations

from decimal import Decimal
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

import sweep.spec.parts as of
from sweep.model.geometry import platform as laws
from sweep.model.geometry import quaternion
from sweep.model.geometry import scanner as patterns
from sweep.model.geometry.scanner import Scanner
from sweep.spec.parts import Files, Part
from sweep.spec.rules import Json, Rule, Several, read_element
from sweep.units import QuantityError

Vector = tuple[float, ...]
Span = tuple[float, float]
"""Start and stop of a stretch of time [s]."""


class Straight(Part):
    """A straight line, the speed changing at a constant rate."""

    kind: Literal["straight"]
    begin: Vector = of.position("Where it begins", alias="from")
    to: Vector = of.position("Where it ends")
    initial_speed: float = of.speed("Speed at the beginning")
    final_speed: float | None = of.speed("Speed at the end; the initial one", default=None)

    def path(self, files: Files, span: Span | None = None) -> laws.Path:
        """Return the straight path."""
        return laws.straight(
            begin=self.begin,
            end=self.to,
            initial_speed=self.initial_speed,
            final_speed=self.final_speed,
        )


class Acceleration(Part):
    """A constant acceleration, 0 by default."""

    kind: Literal["acceleration"]
    position: Vector = of.position("Position at the beginning")
    velocity: Vector = of.vector("Velocity at the beginning", "m/s", "30 m/s")
    acceleration: Vector = of.vector("Acceleration", "m/s^2", "1 m/s^2", default=(0, 0, 0))
    duration: float = of.duration("How long it lasts", at_least="1 ns")

    def path(self, files: Files, span: Span | None = None) -> laws.Path:
        """Return the path of constant acceleration."""
        law = laws.ConstantAcceleration
        return law(self.position, self.velocity, self.acceleration, self.duration)


class WaypointPath(Part):
    """A path through the waypoints of a table."""

    kind: Literal["waypoints"]
    file: str = of.file("CSV table with time, x, y, z and, if it likes, attitude")
    smooth: bool = of.flag("Join them by a cubic spline, not by straight lines", default=True)

    def path(self, files: Files, span: Span | None = None) -> laws.Path:
        """Return the path through the file's waypoints."""
        from sweep.scenes.files import read_waypoints

        table = read_waypoints(files.path(self.file), files.time_origin)
        return laws.Waypoints(table.time, table.position, smooth=self.smooth)


class Still(Part):
    """No movement."""

    kind: Literal["still"]
    position: Vector = of.position("Where it stays")
    duration: float | None = of.duration(
        "How long; a target stays throughout the flight by default", at_least="1 ns", default=None
    )

    def path(self, files: Files, span: Span | None = None) -> laws.Path:
        """Return the path of a platform that stays in place."""
        if self.duration is not None:
            span = (0.0, self.duration)
        if span is None:
            raise ValueError("a platform that stays needs a duration")
        return laws.Waypoints(span, [self.position, self.position], smooth=False)


AnyPath = Annotated[Straight | Acceleration | WaypointPath | Still, Field(discriminator="kind")]


class Turn(Part):
    """A turn of a body against the world, or of an instrument against its body."""

    heading: float = of.angle("Of forward, from x, counter-clockwise from above", default=0.0)
    pitch: float = of.angle("Nose up", "10 deg", "-90 deg", "90 deg", default=0.0)
    roll: float = of.angle("Left side up", default=0.0)
    quaternion: Vector | None = of.vector(
        "The turn as w, x, y, z, instead of angles", "", "0.5", of=4, default=None
    )

    def turn(self) -> np.ndarray:
        """Return the unit quaternion (4,); length 0, or angles given too, is a ValueError."""
        if self.quaternion is None:
            return quaternion.from_heading(heading=self.heading, pitch=self.pitch, roll=self.roll)
        if any((self.heading, self.pitch, self.roll)):
            raise ValueError("has both angles and a quaternion: leave one of them out")
        return quaternion.normalise(np.asarray(self.quaternion))


class Nadir(Part):
    """Level, so that a beam along -z points straight down."""

    kind: Literal["nadir"]
    heading: float | str = of.angle(
        "Of forward, from x, counter-clockwise from above; 'track' follows the path",
        word="track", means="track", default=0.0,
    )  # fmt: skip

    def law(self, files: Files, path: Any) -> laws.Attitude:
        """Return the law of attitude."""
        return laws.Nadir(None if self.heading == "track" else float(self.heading))


class AlongTrack(Part):
    """Forward along the velocity."""

    kind: Literal["along_track"]
    roll: float = of.angle("Left side up", default=0.0)

    def law(self, files: Files, path: Any) -> laws.Attitude:
        """Return the law of attitude."""
        return laws.AlongTrack(self.roll)


class FixedAttitude(Turn):
    """One attitude throughout."""

    kind: Literal["fixed"]

    def law(self, files: Files, path: Any) -> laws.Attitude:
        """Return the law of attitude."""
        return laws.Fixed(self.turn())


class Spin(Turn):
    """Turning at a constant rate; the angles are those at the path's beginning."""

    kind: Literal["spin"]
    angular_velocity: Vector = of.vector(
        "Angular velocity about the world's axes", "rad/s", "10 deg/s"
    )

    def law(self, files: Files, path: Any) -> laws.Attitude:
        """Return the law of attitude."""
        return laws.Spin(self.angular_velocity, self.turn(), path.start)


class Tracked(Part):
    """The attitude of the waypoints' table."""

    kind: Literal["track"]
    file: str | None = of.file(
        "CSV table with time, position and attitude; the path's by default", None
    )

    def law(self, files: Files, path: Any) -> laws.Attitude:
        """Return the law of attitude."""
        from sweep.scenes.files import SceneError, read_waypoints

        if self.file is None:
            raise ValueError("needs a table: name its file, or take waypoints for the path")
        table = read_waypoints(files.path(self.file), files.time_origin)
        if table.attitude is None:
            remedy = "add heading, pitch and roll, or qw, qx, qy and qz"
            raise SceneError(self.file, "has no attitude to follow", remedy)
        return laws.Track(table.time, table.attitude)


AnyAttitude = Annotated[
    Nadir | AlongTrack | FixedAttitude | Spin | Tracked, Field(discriminator="kind")
]


class Motion(Part):
    """Rigid movement of a target."""

    path: AnyPath
    attitude: AnyAttitude = FixedAttitude(kind="fixed")

    def flight(self, files: Files, span: Span | None = None) -> laws.Flight:
        """Movement of the body; one that stays does so throughout `span`."""
        path = self.path.path(files, span)
        return laws.Flight(path, self.law(files, path))

    def law(self, files: Files, path: laws.Path) -> laws.Attitude:
        """Return the law of attitude along a path."""
        law = self.attitude
        if isinstance(law, Tracked) and law.file is None and isinstance(self.path, WaypointPath):
            law = law.model_copy(update={"file": self.path.file})
        return law.law(files, path)


class Platform(Motion):
    """Carrier of the instrument, and its steadiness."""

    attitude: AnyAttitude = Nadir(kind="nadir")
    lever_arm: Vector = of.position(
        "The instrument's position in the body frame", default=(0.0, 0.0, 0.0)
    )
    mounting: Turn = Turn()
    jitter: float = of.angle(
        "Standard deviation of random turns about each body axis", "20 urad", "0 rad", "10 deg",
        default=0.0,
    )  # fmt: skip

    def time_origin(self, files: Files) -> Decimal:
        """Time [s] in tables at which the flight begins: the first of the path's table, or 0."""
        from sweep.scenes.files import first_time

        if not isinstance(self.path, WaypointPath):
            return Decimal(0)
        return first_time(files.path(self.path.file))

    def flight(self, files: Files, span: Span | None = None) -> laws.Flight:
        """Movement of the instrument."""
        mounting = self.mounting.turn()
        path = self.path.path(files, span)
        law = laws.Mounted(self.law(files, path), mounting)
        # A flight's arm is told in the frame of its attitude, which is the instrument's.
        arm = quaternion.rotate(quaternion.conjugate(mounting), np.asarray(self.lever_arm, float))
        return laws.Flight(path, law, arm)


# Scan patterns

MOST_BEAMS = 10_000
STEERED = Several(
    about="Angles of a beam towards forward and towards the left",
    of=of.measure("Angle from nadir", "rad", "22.5 deg", "-89 deg", "89 deg"),
    least=2,
    most=2,
)
_POINTED = Several(
    about="Direction of a beam in the body frame",
    of=of.measure("Component", "", "-1", "-1e9", "1e9"),
)


class Beams(Rule):
    """Directions of beams: angles towards forward and left, or vectors in the body frame."""

    def read(self, written: object) -> tuple[tuple[float, ...], ...]:
        """Angles [rad] (two of them) or components (three) of each beam."""
        example = "write e.g. [[22.5 deg, 0 deg], [0 deg, 0 deg]]"
        if not isinstance(written, list | tuple) or not 0 < len(written) <= MOST_BEAMS:
            raise QuantityError(f"must be a list of 1 to {MOST_BEAMS} beams", example)
        return tuple(read_element(rule_of_beam(b), i, b) for i, b in enumerate(written))

    def written(self, value: Any) -> Any:
        """Return lists that read back as exactly `value`."""
        return [rule_of_beam(beam).written(beam) for beam in value]

    def _json(self) -> Json:
        beam = {"anyOf": [STEERED.schema(), _POINTED.schema()]}
        number = {"minItems": 1, "maxItems": MOST_BEAMS}
        return {"type": "array", "items": beam} | number


def rule_of_beam(beam: object) -> Several:
    """Rule of a beam, by how many numbers it has."""
    return _POINTED if isinstance(beam, list | tuple) and len(beam) == 3 else STEERED


_REACH = ("0 deg", "89 deg")
_RATE = of.frequency("Measurement cycles a second")
_AT_ONCE = of.duration(
    "Time from one beam of a cycle to the next; 0, all at once, by default", "10 ms", default=0.0
)
_SPREAD = of.duration(
    "Time from one beam of a cycle to the next; spread evenly over the cycle by default",
    "10 ms", default=None,
)  # fmt: skip


class Cone(Part):
    """Beams evenly round nadir, all of them in every cycle."""

    kind: Literal["cone"]
    beams: int = of.count("Beams", "3", at_most=str(MOST_BEAMS))
    half_angle: float = of.angle("From nadir", "22.5 deg", *_REACH)
    azimuth: float = of.angle("Of the first beam, from forward to the left", default=0.0)
    rate: float = _RATE
    interval: float = _AT_ONCE

    def pattern(self) -> Scanner:
        """Return the scan pattern."""
        pointed = patterns.cone(self.beams, half_angle=self.half_angle, azimuth=self.azimuth)
        return patterns.fixed(pointed, rate=self.rate, interval=self.interval)


class FixedBeams(Part):
    """Beams at stated directions, all of them in every cycle."""

    kind: Literal["fixed"]
    beams: tuple[Vector, ...] = of.field(
        Beams(about="Angles towards forward and left, or vectors in the body frame, of each beam")
    )
    rate: float = _RATE
    interval: float = _AT_ONCE

    def pattern(self) -> Scanner:
        """Return the scan pattern."""
        pointed = [patterns.steered(*b) if len(b) == 2 else np.array(b) for b in self.beams]  # type: ignore[arg-type]
        return patterns.fixed(np.array(pointed), rate=self.rate, interval=self.interval)


class Corners(Part):
    """One steered beam that visits the corners of a square."""

    kind: Literal["corners"]
    angle: float = of.angle("Of both axes from nadir", "22.5 deg", *_REACH)
    rate: float = _RATE
    interval: float | None = _SPREAD

    def pattern(self) -> Scanner:
        """Return the scan pattern."""
        return patterns.fixed(patterns.corners(self.angle), rate=self.rate, interval=self.interval)


class Squares(Part):
    """One beam steered by stacked elements, square after square; a cycle is a square."""

    kind: Literal["squares"]
    elements: Vector = of.several(
        of.measure("Angle", "rad", "15 deg", "1e-6 deg", "45 deg"), 1, 5,
        about="Angle by which each element of an axis throws the beam to either side",
    )  # fmt: skip
    rate: float = _RATE
    interval: float | None = _SPREAD

    def pattern(self) -> Scanner:
        """Return the scan pattern."""
        directions, visited = patterns.squares(self.elements)
        return patterns.BeamCycle(directions, visited, self.rate, self.interval)


class RasterScan(Part):
    """One steered beam that visits a grid of directions; a cycle is a frame."""

    kind: Literal["raster"]
    columns: int = of.count("Directions across", "32", at_most=str(MOST_BEAMS))
    rows: int = of.count("Directions along", "32", at_most=str(MOST_BEAMS))
    half_angles: Vector = of.several(
        of.measure("Angle", "rad", "10 deg", *_REACH), 2, 2,
        about="Reach to each side of nadir, across and along",
    )  # fmt: skip
    rate: float = _RATE
    both_ways: bool = of.flag("Every other row runs backwards", default=True)

    def pattern(self) -> Scanner:
        """Return the scan pattern."""
        return patterns.raster(**self.model_dump(exclude={"kind"}))


class Line(Part):
    """Beams swept together from side to side; a cycle is one measurement of each."""

    kind: Literal["line"]
    half_angle: float = of.angle("Reach of the sweep to each side", "5 deg", *_REACH)
    line_rate: float = of.frequency("Lines a second; a sweep one way is a line")
    rate: float = _RATE
    along: Vector = of.several(
        of.measure("Angle", "rad", "250 urad", "-89 deg", "89 deg"), 1, 1000, (0.0,),
        about="Angle of each beam from nadir towards forward",
    )  # fmt: skip
    wave: str = of.choice("Constant rate or resonant mirror", ("triangle", "sine"))
    interval: float = _AT_ONCE

    def pattern(self) -> Scanner:
        """Return the scan pattern."""
        return patterns.LineScan(**self.model_dump(exclude={"kind"}))


AnyScanner = Annotated[
    Cone | FixedBeams | Corners | Squares | RasterScan | Line, Field(discriminator="kind")
]


def shots_a_cycle(pattern: Scanner) -> int:
    """Shots of one measurement cycle."""
    if isinstance(pattern, patterns.BeamCycle):
        return pattern.beams_per_cycle
    return pattern.beams
