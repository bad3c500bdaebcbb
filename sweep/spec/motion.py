"""How things move: flight paths, attitudes, and the platform that carries the instrument."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

import sweep.spec.quantities as of
from sweep.model.geometry import platform as laws
from sweep.model.geometry import quaternion
from sweep.spec.instrument import Part
from sweep.spec.list_rules import Either, File, Flag, Several

if TYPE_CHECKING:
    from sweep.model.geometry.platform import Flight, Path
    from sweep.spec.files import Files

Vector = tuple[float, ...]
Span = tuple[float, float]
"""Start and stop of a stretch of time [s]."""

_SPEED = "30 m/s"


class Straight(Part):
    """A straight line, the speed changing at a constant rate."""

    kind: Literal["straight"]
    begin: Annotated[Vector, of.position("Where it begins")] = Field(alias="from")
    to: Annotated[Vector, of.position("Where it ends")]
    initial_speed: Annotated[float, of.speed("Speed at the beginning")]
    final_speed: Annotated[float | None, of.speed("Speed at the end; the initial one")] = None

    def path(self, files: Files, span: Span | None = None) -> Path:
        """The path."""
        from sweep.model.geometry.platform import straight

        return straight(
            begin=self.begin,
            end=self.to,
            initial_speed=self.initial_speed,
            final_speed=self.final_speed,
        )


class Acceleration(Part):
    """A constant acceleration, 0 by default."""

    kind: Literal["acceleration"]
    position: Annotated[Vector, of.position("Position at the beginning")]
    velocity: Annotated[Vector, of.vector("Velocity at the beginning", "m/s", _SPEED)]
    acceleration: Annotated[Vector, of.vector("Acceleration", "m/s^2", "1 m/s^2")] = (0, 0, 0)
    duration: Annotated[float, of.duration("How long it lasts", at_least="1 ns")]

    def path(self, files: Files, span: Span | None = None) -> Path:
        """The path."""
        from sweep.model.geometry.platform import ConstantAcceleration

        return ConstantAcceleration(
            self.position, self.velocity, self.acceleration, self.duration
        )  # fmt: skip


class WaypointPath(Part):
    """A path through the waypoints of a table."""

    kind: Literal["waypoints"]
    file: Annotated[str, File(about="CSV table with time, x, y, z and, if it likes, attitude")]
    smooth: Annotated[bool, Flag(about="Join them by a cubic spline, not by straight lines")] = True

    def path(self, files: Files, span: Span | None = None) -> Path:
        """The path."""
        from sweep.model.geometry.platform import Waypoints
        from sweep.scenes.waypoints import read_waypoints

        table = read_waypoints(files.path(self.file))
        return Waypoints(table.time, table.position, smooth=self.smooth)


class Still(Part):
    """No movement."""

    kind: Literal["still"]
    position: Annotated[Vector, of.position("Where it stays")]
    duration: Annotated[
        float | None,
        of.duration("How long; a target stays throughout the flight by default", at_least="1 ns"),
    ] = None

    def path(self, files: Files, span: Span | None = None) -> Path:
        """The path."""
        from sweep.model.geometry.platform import Waypoints

        if self.duration is not None:
            span = (0.0, self.duration)
        if span is None:
            raise ValueError("a platform that stays needs a duration")
        return Waypoints(span, [self.position, self.position], smooth=False)


AnyPath = Annotated[Straight | Acceleration | WaypointPath | Still, Field(discriminator="kind")]


class Turn(Part):
    """A turn of a body against the world, or of an instrument against its body."""

    heading: Annotated[float, of.angle("Of forward, from x, counter-clockwise from above")] = 0.0
    pitch: Annotated[float, of.angle("Nose up", at_least="-90 deg", at_most="90 deg")] = 0.0
    roll: Annotated[float, of.angle("Left side up")] = 0.0
    quaternion: Annotated[
        Vector | None,
        Several(
            about="The turn as w, x, y, z, instead of angles",
            of=of.number("Component", "0.5"),
            least=4,
            most=4,
        ),
    ] = None

    def turn(self) -> np.ndarray:
        """Unit quaternion (4,).

        Raises
        ------
        ValueError
            For a quaternion without length, or beside angles.
        """
        if self.quaternion is None:
            return quaternion.from_heading(heading=self.heading, pitch=self.pitch, roll=self.roll)
        if any((self.heading, self.pitch, self.roll)):
            raise ValueError("has both angles and a quaternion: leave one of them out")
        return quaternion.normalise(np.asarray(self.quaternion))


_HEADING = Either(
    about="Of forward, from x, counter-clockwise from above; 'track' follows the path",
    words=("track",),
    of=of.angle("Heading"),
)


class Nadir(Part):
    """Level, so that a beam along -z points straight down."""

    kind: Literal["nadir"]
    heading: Annotated[float | str, _HEADING] = 0.0

    def law(self, files: Files, path: Any) -> laws.Attitude:
        """The law of attitude."""
        return laws.Nadir(None if self.heading == "track" else float(self.heading))


class AlongTrack(Part):
    """Forward along the velocity."""

    kind: Literal["along_track"]
    roll: Annotated[float, of.angle("Left side up")] = 0.0

    def law(self, files: Files, path: Any) -> laws.Attitude:
        """The law of attitude."""
        return laws.AlongTrack(self.roll)


class FixedAttitude(Turn):
    """One attitude throughout."""

    kind: Literal["fixed"]

    def law(self, files: Files, path: Any) -> laws.Attitude:
        """The law of attitude."""
        return laws.Fixed(self.turn())


class Spin(Turn):
    """Turning at a constant rate; the angles are those at the path's beginning."""

    kind: Literal["spin"]
    angular_velocity: Annotated[
        Vector, of.vector("Angular velocity about the world's axes", "rad/s", "10 deg/s")
    ]

    def law(self, files: Files, path: Any) -> laws.Attitude:
        """The law of attitude."""
        return laws.Spin(self.angular_velocity, self.turn(), path.start)


class Tracked(Part):
    """The attitude of the waypoints' table."""

    kind: Literal["track"]
    file: Annotated[
        str | None, File(about="CSV table with time, position and attitude; the path's by default")
    ] = None

    def law(self, files: Files, path: Any) -> laws.Attitude:
        """The law of attitude."""
        from sweep.scenes.files import SceneError
        from sweep.scenes.waypoints import read_waypoints

        if self.file is None:
            raise ValueError("needs a table: name its file, or take waypoints for the path")
        table = read_waypoints(files.path(self.file))
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

    def flight(self, files: Files, span: Span | None = None) -> Flight:
        """Movement of the body; one that stays does so throughout `span`."""
        from sweep.model.geometry.platform import Flight

        path = self.path.path(files, span)
        return Flight(path, self.law(files, path))

    def law(self, files: Files, path: Path) -> laws.Attitude:
        """The law of attitude along a path."""
        law = self.attitude
        if isinstance(law, Tracked) and law.file is None and isinstance(self.path, WaypointPath):
            law = law.model_copy(update={"file": self.path.file})
        return law.law(files, path)


class Platform(Motion):
    """What carries the instrument, and how steadily."""

    attitude: AnyAttitude = Nadir(kind="nadir")
    lever_arm: Annotated[Vector, of.position("The instrument's position in the body frame")] = (
        0.0, 0.0, 0.0,
    )  # fmt: skip
    mounting: Turn = Turn()
    jitter: Annotated[
        float,
        of.angle("Standard deviation of random turns about each body axis", "20 urad",
                 at_least="0 rad", at_most="10 deg"),
    ] = 0.0  # fmt: skip

    def flight(self, files: Files, span: Span | None = None) -> Flight:
        """Movement of the instrument."""
        from sweep.model.geometry.platform import Flight

        mounting = self.mounting.turn()
        path = self.path.path(files, span)
        law = laws.Mounted(self.law(files, path), mounting)
        # A flight's arm is told in the frame of its attitude, which is the instrument's.
        arm = quaternion.rotate(quaternion.conjugate(mounting), np.asarray(self.lever_arm, float))
        return Flight(path, law, arm)
