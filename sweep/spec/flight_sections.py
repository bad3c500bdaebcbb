"""Sections of a spec for motion and beam directions: paths, attitudes, platform and scan patterns.

World frame: metres, z up. Body frame: x forward, y left, z up.
"""

from __future__ import annotations

from decimal import Decimal
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

import sweep.spec.fields as declare
from sweep.model.geometry import body_motion as motion_laws
from sweep.model.geometry import quaternion
from sweep.model.geometry import scanner as scan_patterns
from sweep.model.geometry.scanner import ScanPattern
from sweep.spec.fields import SpecFiles, SpecSection, Vector
from sweep.spec.rules import JsonObject, ListRule, Rule, read_list_element
from sweep.units import QuantityError

TimeSpan = tuple[float, float]
"""Start and end of a time interval [s]."""


class StraightPath(SpecSection):
    """Straight path with constant acceleration along it."""

    kind: Literal["straight"]
    begin: Vector = declare.position_field("Position of the start", alias="from")
    to: Vector = declare.position_field("Position of the end")
    initial_speed: float = declare.speed_field("Speed at the beginning")
    final_speed: float | None = declare.speed_field(
        "Speed at the end; by default the initial speed", default=None
    )

    def build_trajectory(
        self, files: SpecFiles, span: TimeSpan | None = None
    ) -> motion_laws.Trajectory:
        """Return the trajectory along a straight line; the arguments are not used."""
        return motion_laws.straight_trajectory(
            start_point=self.begin,
            end_point=self.to,
            initial_speed=self.initial_speed,
            final_speed=self.final_speed,
        )


class AccelerationPath(SpecSection):
    """Path of constant acceleration, 0 by default."""

    kind: Literal["acceleration"]
    position: Vector = declare.position_field("Position at the beginning")
    velocity: Vector = declare.vector_field("Velocity at the beginning", "m/s", "30 m/s")
    acceleration: Vector = declare.vector_field(
        "Acceleration", "m/s^2", "1 m/s^2", default=(0, 0, 0)
    )
    duration: float = declare.duration_field("Duration of the path", at_least="1 ns")

    def build_trajectory(
        self, files: SpecFiles, span: TimeSpan | None = None
    ) -> motion_laws.Trajectory:
        """Return the trajectory of constant acceleration; the arguments are not used."""
        path_class = motion_laws.ConstantAcceleration
        return path_class(self.position, self.velocity, self.acceleration, self.duration)


class WaypointPath(SpecSection):
    """Path through the waypoints of a table."""

    kind: Literal["waypoints"]
    file: str = declare.file_path_field("CSV table with time, x, y, z and optionally attitude")
    smooth: bool = declare.flag_field(
        "Join the waypoints by a cubic spline, not by straight lines", default=True
    )

    def build_trajectory(
        self, files: SpecFiles, span: TimeSpan | None = None
    ) -> motion_laws.Trajectory:
        """Return the trajectory through the waypoints of the table; `span` is not used."""
        from sweep.scenes.scene_files import read_waypoints

        table = read_waypoints(files.resolve(self.file), files.time_origin)
        return motion_laws.Waypoints(table.time, table.position, is_smooth=self.smooth)


class StationaryPath(SpecSection):
    """Path of a body at rest."""

    kind: Literal["still"]
    position: Vector = declare.position_field("Position of the body")
    duration: float | None = declare.duration_field(
        "Duration; by default a target stays throughout the flight", at_least="1 ns", default=None
    )

    def build_trajectory(
        self, files: SpecFiles, span: TimeSpan | None = None
    ) -> motion_laws.Trajectory:
        """Return the trajectory of a body at rest, which lasts for `duration`, else for `span`.

        Raises
        ------
        ValueError
            If there is neither a duration nor a span, as for a platform without a duration.
        """
        if self.duration is not None:
            span = (0.0, self.duration)
        if span is None:
            raise ValueError("a platform that stays needs a duration")
        return motion_laws.Waypoints(span, [self.position, self.position], is_smooth=False)


AnyPath = Annotated[
    StraightPath | AccelerationPath | WaypointPath | StationaryPath, Field(discriminator="kind")
]


class Orientation(SpecSection):
    """Rotation of a body relative to the world, or of an instrument relative to its body."""

    heading: float = declare.angle_field(
        "Direction of the forward axis, from x, counter-clockwise seen from above", default=0.0
    )
    pitch: float = declare.angle_field(
        "Angle by which the nose is up", "10 deg", "-90 deg", "90 deg", default=0.0
    )
    roll: float = declare.angle_field("Angle by which the left side is up", default=0.0)
    quaternion: Vector | None = declare.vector_field(
        "Rotation as a quaternion w, x, y, z, in place of angles",
        "",
        "0.5",
        dimensions=4,
        default=None,
    )

    def to_quaternion(self) -> np.ndarray:
        """Return the orientation as a unit quaternion (4,) with the components w, x, y, z.

        Raises
        ------
        ValueError
            If the quaternion has length 0, or if angles are given in addition to it.
        """
        if self.quaternion is None:
            return quaternion.from_heading(heading=self.heading, pitch=self.pitch, roll=self.roll)
        if any((self.heading, self.pitch, self.roll)):
            raise ValueError("has both angles and a quaternion: leave one of them out")
        return quaternion.normalise(np.asarray(self.quaternion))


class NadirAttitude(SpecSection):
    """Level attitude: a beam along -z points straight down."""

    kind: Literal["nadir"]
    heading: float | str = declare.angle_field(
        "Direction of the forward axis, from x, counter-clockwise seen from above; 'track' follows "
        "the path",
        keyword="track", keyword_value="track", default=0.0,
    )  # fmt: skip

    def build_attitude(self, files: SpecFiles, path: Any) -> motion_laws.AttitudeLaw:
        """Return the attitude law of a level body; the arguments are not used.

        The heading is fixed, or follows the direction of motion if it is ``track``.
        """
        return motion_laws.NadirAttitude(None if self.heading == "track" else float(self.heading))


class AlongTrackAttitude(SpecSection):
    """Attitude whose forward axis points along the velocity."""

    kind: Literal["along_track"]
    roll: float = declare.angle_field("Angle by which the left side is up", default=0.0)

    def build_attitude(self, files: SpecFiles, path: Any) -> motion_laws.AttitudeLaw:
        """Return the attitude law of a body that points along its velocity.

        The arguments are not used.
        """
        return motion_laws.AlongTrackAttitude(self.roll)


class FixedAttitude(Orientation):
    """Constant attitude."""

    kind: Literal["fixed"]

    def build_attitude(self, files: SpecFiles, path: Any) -> motion_laws.AttitudeLaw:
        """Return the attitude law of a constant orientation; the arguments are not used."""
        return motion_laws.FixedAttitude(self.to_quaternion())


class SpinningAttitude(Orientation):
    """Attitude of constant angular velocity; the angles are those at the start of the path."""

    kind: Literal["spin"]
    angular_velocity: Vector = declare.vector_field(
        "Angular velocity about the world's axes", "rad/s", "10 deg/s"
    )

    def build_attitude(self, files: SpecFiles, path: Any) -> motion_laws.AttitudeLaw:
        """Return the attitude law of a constant angular velocity from the start of `path` on."""
        return motion_laws.SpinningAttitude(
            self.angular_velocity, self.to_quaternion(), path.start_time
        )


class TabulatedAttitude(SpecSection):
    """Attitude from a table, that of the waypoints by default."""

    kind: Literal["track"]
    file: str | None = declare.file_path_field(
        "CSV table with time, position and attitude; the path's by default", None
    )

    def build_attitude(self, files: SpecFiles, path: Any) -> motion_laws.AttitudeLaw:
        """Return the attitude law that interpolates between the orientations in a table.

        Raises
        ------
        ValueError
            If no table is named.
        SceneError
            If the table can't be read or has no attitude.
        """
        from sweep.scenes.scene_files import SceneError, read_waypoints

        if self.file is None:
            raise ValueError("needs a table: name its file, or take waypoints for the path")
        table = read_waypoints(files.resolve(self.file), files.time_origin)
        if table.attitude is None:
            remedy = "add heading, pitch and roll, or qw, qx, qy and qz"
            raise SceneError(self.file, "has no attitude to follow", remedy)
        return motion_laws.AttitudeTrack(table.time, table.attitude)


AnyAttitude = Annotated[
    NadirAttitude | AlongTrackAttitude | FixedAttitude | SpinningAttitude | TabulatedAttitude,
    Field(discriminator="kind"),
]


class RigidMotion(SpecSection):
    """Motion of a rigid target."""

    path: AnyPath
    attitude: AnyAttitude = FixedAttitude(kind="fixed")

    def build_moving_body(
        self, files: SpecFiles, span: TimeSpan | None = None
    ) -> motion_laws.MovingBody:
        """Return the motion of a rigid body: trajectory and attitude as functions of time.

        Parameters
        ----------
        files : SpecFiles
            Files that the spec names.
        span : tuple of float, optional
            Start and stop [s] of the motion of a body at rest that has no duration.

        Returns
        -------
        MovingBody
            Trajectory and attitude law of the body.
        """
        path = self.path.build_trajectory(files, span)
        return motion_laws.MovingBody(path, self.build_attitude(files, path))

    def build_attitude(
        self, files: SpecFiles, path: motion_laws.Trajectory
    ) -> motion_laws.AttitudeLaw:
        """Return the attitude law of the body on `path`.

        A tabulated attitude without a file is read from the table of waypoints of the path.
        """
        attitude = self.attitude
        if (
            isinstance(attitude, TabulatedAttitude)
            and attitude.file is None
            and isinstance(self.path, WaypointPath)
        ):
            attitude = attitude.model_copy(update={"file": self.path.file})
        return attitude.build_attitude(files, path)


class Platform(RigidMotion):
    """Carrier of the instrument: path, attitude, mounting and pointing jitter."""

    attitude: AnyAttitude = NadirAttitude(kind="nadir")
    lever_arm: Vector = declare.position_field(
        "The instrument's position in the body frame", default=(0.0, 0.0, 0.0)
    )
    mounting: Orientation = Orientation()
    jitter: float = declare.angle_field(
        "Standard deviation of random turns about each body axis", "20 urad", "0 rad", "10 deg",
        default=0.0,
    )  # fmt: skip

    def read_time_origin(self, files: SpecFiles) -> Decimal:
        """Return the first time in the path's table of waypoints [s], exactly as written.

        The flight begins at this time. The result is 0 if the path has no table.
        """
        from sweep.scenes.scene_files import read_first_waypoint_time

        if not isinstance(self.path, WaypointPath):
            return Decimal(0)
        return read_first_waypoint_time(files.resolve(self.path.file))

    def build_moving_body(
        self, files: SpecFiles, span: TimeSpan | None = None
    ) -> motion_laws.MovingBody:
        """Return the motion of the instrument, mounted on its platform with a lever arm.

        Parameters
        ----------
        files : SpecFiles
            Files that the spec names.
        span : tuple of float, optional
            Start and stop [s] of the motion of a platform at rest that has no duration.

        Returns
        -------
        MovingBody
            Trajectory of the platform, attitude law of the instrument, and lever arm in the
            instrument's frame.
        """
        mounting = self.mounting.to_quaternion()
        path = self.path.build_trajectory(files, span)
        mounted_attitude = motion_laws.MountedAttitude(self.build_attitude(files, path), mounting)
        # MovingBody takes the lever arm in the frame of its attitude law: here the instrument's
        # frame.
        instrument_arm = quaternion.rotate(
            quaternion.conjugate(mounting), np.asarray(self.lever_arm, float)
        )
        return motion_laws.MovingBody(path, mounted_attitude, instrument_arm)


# Scan patterns

BEAMS_MAX = 10_000
"""Largest number of beams of a scanner, and of rows or columns of a raster scan."""
STEERING_ANGLES_RULE = ListRule(
    description="Angles of a beam towards forward and towards the left",
    element_rule=declare.quantity_rule("Angle from nadir", "rad", "22.5 deg", "-89 deg", "89 deg"),
    length_min=2,
    length_max=2,
)
"""Rule of a beam direction as two angles from nadir [rad]: towards forward, and towards the
left."""
_DIRECTION_VECTOR_RULE = ListRule(
    description="Direction of a beam in the body frame",
    element_rule=declare.quantity_rule("Component", "", "-1", "-1e9", "1e9"),
)
"""Rule of a beam direction as a vector of three components in the body frame."""


class BeamDirectionsRule(Rule):
    """Rule of a list of beam directions: steering angles, or vectors in the body frame."""

    def read(self, raw_value: object) -> tuple[tuple[float, ...], ...]:
        """Return a tuple per beam: two steering angles [rad] or three vector components.

        Raise `QuantityError` if the list as written is invalid.
        """
        remedy = "write e.g. [[22.5 deg, 0 deg], [0 deg, 0 deg]]"
        if not isinstance(raw_value, list | tuple) or not 0 < len(raw_value) <= BEAMS_MAX:
            raise QuantityError(f"must be a list of 1 to {BEAMS_MAX} beams", remedy)
        return tuple(
            read_list_element(beam_direction_rule(raw_beam), i, raw_beam)
            for i, raw_beam in enumerate(raw_value)
        )

    def format(self, value: Any) -> Any:
        """Convert a result of `read` back to a list of beam directions as a spec would hold it."""
        return [beam_direction_rule(beam).format(beam) for beam in value]

    def _value_schema(self) -> JsonObject:
        beam_schema = {"anyOf": [STEERING_ANGLES_RULE.schema(), _DIRECTION_VECTOR_RULE.schema()]}
        length_keywords = {"minItems": 1, "maxItems": BEAMS_MAX}
        return {"type": "array", "items": beam_schema} | length_keywords


def beam_direction_rule(beam: object) -> ListRule:
    """Return the rule of a beam direction: a vector if `beam` has 3 numbers, else two angles."""
    return (
        _DIRECTION_VECTOR_RULE
        if isinstance(beam, list | tuple) and len(beam) == 3
        else STEERING_ANGLES_RULE
    )


_NADIR_ANGLE_BOUNDS = ("0 deg", "89 deg")
"""Least and greatest angle between a beam and straight down (nadir), with units."""
_CYCLE_RATE_FIELD = declare.frequency_field("Number of measurement cycles per second")
_BEAM_INTERVAL_FIELD_DEFAULT_ZERO = declare.duration_field(
    "Time from one beam of a cycle to the next; 0, all at once, by default", "10 ms", default=0.0
)
_BEAM_INTERVAL_FIELD_DEFAULT_UNIFORM = declare.duration_field(
    "Time from one beam of a cycle to the next; spread evenly over the cycle by default",
    "10 ms", default=None,
)  # fmt: skip


class ConeScanner(SpecSection):
    """Beams at equal azimuth steps on a cone around nadir; all of them fire in every cycle."""

    kind: Literal["cone"]
    beams: int = declare.integer_field("Beams", "3", at_most=str(BEAMS_MAX))
    half_angle: float = declare.angle_field(
        "Angle between the beams and nadir", "22.5 deg", *_NADIR_ANGLE_BOUNDS
    )
    azimuth: float = declare.angle_field(
        "Azimuth of the first beam, from forward towards the left", default=0.0
    )
    rate: float = _CYCLE_RATE_FIELD
    interval: float = _BEAM_INTERVAL_FIELD_DEFAULT_ZERO

    def build_pattern(self) -> ScanPattern:
        """Return the scan pattern of beams on a cone around nadir, which fire in every cycle."""
        directions = scan_patterns.cone_directions(
            self.beams, half_angle=self.half_angle, azimuth=self.azimuth
        )
        return scan_patterns.fixed_beams(directions, rate=self.rate, interval=self.interval)


class FixedBeamsScanner(SpecSection):
    """Beams at given directions; all of them fire in every cycle."""

    kind: Literal["fixed"]
    beams: tuple[Vector, ...] = declare.field_with_rule(
        BeamDirectionsRule(
            description="Angles towards forward and left, or vectors in the body frame, of each "
            "beam"
        )
    )
    rate: float = _CYCLE_RATE_FIELD
    interval: float = _BEAM_INTERVAL_FIELD_DEFAULT_ZERO

    def build_pattern(self) -> ScanPattern:
        """Return the scan pattern of beams in the directions `beams`, which fire in every cycle."""
        directions = [
            scan_patterns.steered_directions(*beam) if len(beam) == 2 else np.array(beam)  # type: ignore[arg-type]
            for beam in self.beams
        ]
        return scan_patterns.fixed_beams(
            np.array(directions), rate=self.rate, interval=self.interval
        )


class CornersScanner(SpecSection):
    """One beam steered to the corners of a square."""

    kind: Literal["corners"]
    angle: float = declare.angle_field(
        "Angle of both axes from nadir", "22.5 deg", *_NADIR_ANGLE_BOUNDS
    )
    rate: float = _CYCLE_RATE_FIELD
    interval: float | None = _BEAM_INTERVAL_FIELD_DEFAULT_UNIFORM

    def build_pattern(self) -> ScanPattern:
        """Return the scan pattern of one beam that is steered to the four corners of a square."""
        return scan_patterns.fixed_beams(
            scan_patterns.corner_directions(self.angle), rate=self.rate, interval=self.interval
        )


class SquaresScanner(SpecSection):
    """One beam steered by stacked elements along squares; a cycle is a square."""

    kind: Literal["squares"]
    elements: Vector = declare.list_field(
        declare.quantity_rule("Angle", "rad", "15 deg", "1e-6 deg", "45 deg"), 1, 5,
        description="Angle by which each element of an axis throws the beam to either side",
    )  # fmt: skip
    rate: float = _CYCLE_RATE_FIELD
    interval: float | None = _BEAM_INTERVAL_FIELD_DEFAULT_UNIFORM

    def build_pattern(self) -> ScanPattern:
        """Return the scan pattern of one beam that is steered along squares, one per cycle."""
        directions, visited_directions = scan_patterns.square_patterns(self.elements)
        return scan_patterns.BeamCycle(directions, visited_directions, self.rate, self.interval)


class RasterScanner(SpecSection):
    """One beam steered over a grid of directions; a cycle is a frame."""

    kind: Literal["raster"]
    columns: int = declare.integer_field("Directions across", "32", at_most=str(BEAMS_MAX))
    rows: int = declare.integer_field("Directions along", "32", at_most=str(BEAMS_MAX))
    half_angles: Vector = declare.list_field(
        declare.quantity_rule("Angle", "rad", "10 deg", *_NADIR_ANGLE_BOUNDS), 2, 2,
        description="Reach to each side of nadir, across and along",
    )  # fmt: skip
    rate: float = _CYCLE_RATE_FIELD
    both_ways: bool = declare.flag_field("Every other row runs backwards", default=True)

    def build_pattern(self) -> ScanPattern:
        """Return the scan pattern of one beam, steered over a grid of directions per cycle."""
        return scan_patterns.raster_scan(**self.model_dump(exclude={"kind"}))


class LineScanner(SpecSection):
    """Beams swept together from side to side; a cycle is one measurement of each beam."""

    kind: Literal["line"]
    half_angle: float = declare.angle_field(
        "Reach of the sweep to each side", "5 deg", *_NADIR_ANGLE_BOUNDS
    )
    line_rate: float = declare.frequency_field("Lines a second; a sweep one way is a line")
    rate: float = _CYCLE_RATE_FIELD
    along: Vector = declare.list_field(
        declare.quantity_rule("Angle", "rad", "250 urad", "-89 deg", "89 deg"), 1, 1000, (0.0,),
        description="Angle of each beam from nadir towards forward",
    )  # fmt: skip
    wave: str = declare.choice_field("Constant rate or resonant mirror", ("triangle", "sine"))
    interval: float = _BEAM_INTERVAL_FIELD_DEFAULT_ZERO

    def build_pattern(self) -> ScanPattern:
        """Return the scan pattern of beams that are swept together from side to side."""
        return scan_patterns.LineScan(**self.model_dump(exclude={"kind"}))


AnyScanner = Annotated[
    ConeScanner | FixedBeamsScanner | CornersScanner | SquaresScanner | RasterScanner | LineScanner,
    Field(discriminator="kind"),
]


def shots_per_cycle(pattern: ScanPattern) -> int:
    """Return the number of shots in one measurement cycle of a scan pattern."""
    if isinstance(pattern, scan_patterns.BeamCycle):
        return pattern.shots_per_cycle
    return pattern.n_beams
