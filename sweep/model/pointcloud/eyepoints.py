"""Eyepoints: geometry of each shot of a flight, before any radiometry.

The geometry of a shot - range, incidence, surface and radial velocity at every beamlet - does not
depend on laser power, receiver or processing. It is computed once and serves any number of
radiometric studies [T 3.2].
"""

from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from sweep.model import beam
from sweep.model.beamlets import place_beamlets
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.catalogue import DEFAULT_EFFECTS
from sweep.model.evaluation import prepare_ray_traced_shots
from sweep.model.geometry.body_motion import BodyState, MovingBody
from sweep.model.geometry.mesh import SurfaceMaterial
from sweep.model.geometry.quaternion import rotate
from sweep.model.geometry.ray_casting import BundleHits, Pose, RayCaster
from sweep.model.geometry.scanner import PointingJitter, ScanPattern, beamlet_directions
from sweep.model.ground import BeamletTable, RayTracedGround, backscatter
from sweep.model.link_budget import BEAM_ELEVATION_PATH
from sweep.model.preparation import Parameters, Shots
from sweep.model.shot_settings import APPROACH_SPEED_PATH
from sweep.model.unsupported_shot import UnsupportedShotError

TARGET_HEIGHT_PATH = "atmosphere.target_height"
"""Dotted path of the parameter for the height of the target [m], above the height at which
atmospheric profiles begin."""
SOLAR_IRRADIANCE_PATH = "target.solar_irradiance"
"""Dotted path of the parameter for the spectral irradiance of the sun on the target [W/m^3]."""

HIT_RANGE_MIN = 1e-3
"""Smallest range of a hit [m]. Rays pass through nearer surfaces.

An instrument that stands on the ground, or in the plane of a wall, would otherwise see the surface
at range 0, with an infinite echo.
"""

_GRAZING_SINE_MIN = 0.01
"""Smallest sine of the angle between a ray and the surface that it hits. A smaller sine is replaced
by it where the speed at which the range falls is computed."""


class Eyepoints(NamedTuple):
    """Geometry of n shots of a flight, each of b beamlets (rays that sample the beam).

    Units are SI, and vectors are in the world frame. The reference beamlet of a shot is the first
    one that hits a surface.
    """

    time: np.ndarray
    """(n,): time at which the measurement of the shot begins [s]."""
    beam: np.ndarray
    """(n,) int64: number of the beam of the scanner in which the shot is fired."""
    cycle: np.ndarray
    """(n,) int64: number of the measurement cycle to which the shot belongs."""
    position: np.ndarray
    """(n, 3): position of the instrument [m]."""
    velocity: np.ndarray
    """(n, 3): velocity of the instrument [m/s]."""
    direction: np.ndarray
    """(n, 3): unit vector along the beam's axis in the world's frame, as commanded (without
    jitter)."""
    range: np.ndarray
    """(n,): range of the reference beamlet [m]: the first beamlet that hits a surface. It is inf
    for a shot that hits nothing."""
    offset: np.ndarray
    """(n, b): range of each beamlet minus the range of the reference beamlet [m]; nan for a beamlet
    that misses."""
    radial_velocity: np.ndarray
    """(n,): radial velocity of the reference beamlet [m/s], positive when closing; nan for a shot
    that hits nothing."""
    acceleration: np.ndarray
    """(n,): time derivative of the reference beamlet's radial velocity [m/s^2], positive if the
    closing speed rises; nan for a shot that hits nothing."""
    approach_speed: np.ndarray
    """(n,): speed at which the reference beamlet's range falls [m/s]; nan for a shot that hits
    nothing."""
    turn_rate: np.ndarray
    """(n,): angular speed at which scanner and platform together turn the direction of the
    reference beamlet [rad/s]."""
    direction_rate: np.ndarray
    """(n, 3): time derivative of the commanded ``direction`` of the beam [1/s]."""
    platform_acceleration: np.ndarray
    """(n, 3): acceleration of the instrument in the world's frame [m/s^2]."""
    velocity_offset: np.ndarray
    """(n, b): radial velocity of each beamlet minus that of the reference beamlet [m/s]; nan for a
    beamlet that misses."""
    cos_incidence: np.ndarray
    """(n, b): cosine of the angle of incidence, 0..1; nan for a beamlet that misses."""
    surface: np.ndarray
    """(n, b) int16: index of the surface material that the beamlet hits; -1 for a beamlet that
    misses."""
    weight: np.ndarray
    """(b,): fraction of the beam's power in each beamlet; the fractions sum to 1."""

    @property
    def has_target(self) -> np.ndarray:
        """Mask (n,), True for shots with a beamlet that hits a surface."""
        return np.isfinite(self.range)

    @property
    def reference_beamlet(self) -> np.ndarray:
        """Index (n,) of each shot's reference beamlet: the first that hits a surface."""
        return np.asarray((self.surface >= 0).argmax(axis=1))

    @property
    def platform_radial_velocity(self) -> np.ndarray:
        """Component of the instrument's velocity along each commanded beam, (n,) [m/s]."""
        return _scalar_products(self.velocity, self.direction)

    def select(self, selection: slice | np.ndarray) -> "Eyepoints":
        """Return the record for shots selected by a slice, indices or a mask.

        A slice is not copied.
        """
        indices = np.arange(len(self.time))[selection]
        if indices.size and (np.diff(indices) == 1).all():
            selection = slice(indices[0], indices[-1] + 1)
        return Eyepoints._make([*(values[selection] for values in self[:-1]), self.weight])


def compute_eyepoints(
    shot_numbers: np.ndarray,
    *,
    flight: MovingBody,
    scanner: ScanPattern,
    caster: RayCaster,
    beam_divergence: float,
    n_beamlets: int,
    pattern: str = "hexagonal",
    body_motions: Sequence[MovingBody | None] | None = None,
    jitter: PointingJitter | None = None,
    bodies_rotate: bool = True,
    footprint_full_angles: Callable[[np.ndarray], beam.FootprintAngles] | None = None,
) -> Eyepoints:
    """Compute the geometry (eyepoints) of n shots of a flight by ray casting.

    The result of a shot depends on its number and not on other shots, so any part of a flight can
    be computed alone.

    Parameters
    ----------
    shot_numbers
        (n,): numbers of the shots, from 0.
    flight
        Motion of the instrument.
    scanner
        Scan pattern.
    caster
        Ray caster of the scene.
    beam_divergence
        Full 1/e^2 angle of the beam [rad], if `footprint_full_angles` is None.
    n_beamlets, pattern
        Number and pattern of beamlets (:func:`sweep.model.beamlets.place_beamlets`).
    body_motions
        Motion of each of the caster's bodies; None for a body at rest.
    jitter
        Random pointing of the light of each shot. The instrument does not know it, so position,
        velocity and `direction` of the result are those without jitter.
    bodies_rotate
        False to neglect the velocity of surfaces by the rotation of their body.
    footprint_full_angles
        Function that returns the angles of the footprint, as
        :func:`sweep.model.beam.footprint_full_angles`. Its argument is the range (n,) of the beam's
        axis [m], infinite if the axis hits nothing.

    Raises
    ------
    UnsupportedShotError
        If the geometry of a shot is not finite. The message names the first such shot.

    Notes
    -----
    Rays pass through surfaces nearer than `HIT_RANGE_MIN`.
    """
    shot_numbers = np.asarray(shot_numbers)
    shots = scanner.shots(shot_numbers)
    time = flight.start_time + shots.time
    state = flight.state(time)
    (across, along), weight = place_beamlets(n_beamlets, pattern)
    attitude = (
        state.attitude if jitter is None else jitter.perturb_attitude(state.attitude, shot_numbers)
    )
    body_states = [None if body is None else body.state(time) for body in body_motions or ()]
    poses = [None if body is None else Pose(body.position, body.attitude) for body in body_states]
    make_rays = partial(beamlet_directions, attitude, shots.direction)
    if footprint_full_angles is None:
        light_directions = ray_directions = make_rays(across, along, beam_divergence / 4)
    else:  # the range of the axis determines the width of the footprint
        zero_angle = np.zeros(1)
        axis_bundle = caster.cast_bundles(
            state.position,
            make_rays(zero_angle, zero_angle, 1.0),
            poses=poses or None,
            range_min=HIT_RANGE_MIN,
        )
        ray_directions, light_directions = (
            make_rays(across, along, np.reshape(full_angle, (-1, 1)) / 4)
            for full_angle in footprint_full_angles(axis_bundle.range)
        )
    bundle = caster.cast_bundles(
        state.position, ray_directions, poses=poses or None, range_min=HIT_RANGE_MIN
    )
    radial_velocity = _radial_velocities(
        state, ray_directions, light_directions, bundle, body_states, bodies_rotate
    )
    rows = np.arange(len(time))
    reference_velocity = radial_velocity[rows, np.maximum(bundle.reference_beamlet, 0)]
    scanner_rate = rotate(state.attitude, shots.direction_rate)
    _require_finite(shot_numbers, time, state, bundle, radial_velocity)
    acceleration, approach_speed, turn_rate = _reference_beamlet_rates(
        state, scanner_rate, ray_directions, bundle, body_states, bodies_rotate
    )
    direction = rotate(state.attitude, shots.direction)
    direction_rate = np.cross(state.angular_velocity, direction) + scanner_rate
    return Eyepoints(
        time,
        shots.beam_number,
        shots.cycle_number,
        state.position,
        state.velocity,
        direction,
        bundle.range,
        bundle.range_offset,
        reference_velocity,
        acceleration,
        approach_speed,
        turn_rate,
        direction_rate,
        state.acceleration,
        radial_velocity - reference_velocity[:, None],
        bundle.cos_incidence,
        bundle.surface_index,
        weight,
    )


def _require_finite(
    shot_numbers: np.ndarray,
    time: np.ndarray,
    state: BodyState,
    bundle: BundleHits,
    velocity: np.ndarray,
) -> None:
    """Raise UnsupportedShotError if the geometry of any shot is not finite.

    Loops over bins would not end for that shot.
    """
    is_hit = bundle.is_hit
    for label, is_wrong in (
        ("position", ~np.isfinite(state.position).all(axis=1)),
        ("velocity", ~np.isfinite(state.velocity).all(axis=1)),
        ("range", (is_hit & ~np.isfinite(bundle.range[:, None] + bundle.range_offset)).any(axis=1)),
        ("angle of incidence", (is_hit & ~np.isfinite(bundle.cos_incidence)).any(axis=1)),
        ("radial velocity", (is_hit & ~np.isfinite(velocity)).any(axis=1)),
    ):
        if is_wrong.any():
            k = int(is_wrong.argmax())
            raise UnsupportedShotError(
                f"shot {shot_numbers[k]}, at time {time[k]:.6g} s, has a {label} that is not "
                "finite: "
                "check the path and the scene there for numbers out of all proportion",
                k,
            )


def _radial_velocities(
    state: BodyState,
    ray_directions: np.ndarray,
    light_directions: np.ndarray,
    bundle: BundleHits,
    body_states: Sequence[BodyState | None],
    bodies_rotate: bool,
) -> np.ndarray:
    """Compute the radial velocities of beamlets, (n, b) [m/s]; nan for a beamlet that misses.

    Parameters
    ----------
    state
        Position and motion of the instrument in n shots.
    ray_directions
        (n, b, 3): directions of the rays, which determine the points that are hit.
    light_directions
        (n, b, 3): directions of the light, along which velocities are seen.
    bundle
        Hits of the rays.
    body_states
        Position and motion of each body; None for a body at rest.
    bodies_rotate
        False to neglect the velocity of surfaces by the rotation of their body.

    Notes
    -----
    A surface on a body at X, of velocity V and angular velocity omega, moves with V + omega x (P -
    X) at the point P that is hit. Rotation of the instrument about itself does not shift the
    light's frequency. Rotation with a lever arm does, through the instrument's velocity.
    """
    closing_speed = light_directions[..., 0] * state.velocity[:, :1]
    for k in (2, 1):  # fixed order of addition, for equal bits
        closing_speed += light_directions[..., k] * state.velocity[:, k, None]
    closing_speed[~bundle.is_hit] = np.nan
    for body, body_state in enumerate(body_states):
        if body_state is None:
            continue
        surface_velocity = body_state.velocity[:, None]
        if bodies_rotate and body_state.angular_velocity.any():
            hit_range = np.where(
                bundle.body_index == body, bundle.range[:, None] + bundle.range_offset, 0.0
            )
            lever_arm = (
                state.position[:, None]
                + ray_directions * hit_range[..., None]
                - body_state.position[:, None]
            )
            surface_velocity = surface_velocity + np.cross(
                body_state.angular_velocity[:, None], lever_arm
            )
        receding_speed = (light_directions * surface_velocity).sum(axis=-1)
        closing_speed = np.where(
            bundle.body_index == body, closing_speed - receding_speed, closing_speed
        )
    return closing_speed


def _reference_beamlet_rates(
    state: BodyState,
    scanner_rate: np.ndarray,
    ray_directions: np.ndarray,
    bundle: BundleHits,
    body_states: Sequence[BodyState | None],
    bodies_rotate: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute acceleration, approach speed and turn rate along the reference beamlets of n shots.

    The reference beamlet of a shot is the first that hits a surface.

    Parameters
    ----------
    state, ray_directions, bundle, body_states, bodies_rotate
        Arguments of :func:`_radial_velocities`.
    scanner_rate
        (n, 3): rate of change of the beam's direction by the scanner [1/s], in the world's frame.

    Returns
    -------
    acceleration : ndarray (n,)
        Rate at which the radial velocity grows [m/s^2]; nan if nothing is hit.
    approach_speed : ndarray (n,)
        Speed at which the range falls [m/s]; nan if nothing is hit.
    turn_rate : ndarray (n,)
        Rate at which the direction turns [rad/s].

    Notes
    -----
    The body that is hit rotates with the angular velocity w, and is thought to extend to the
    instrument. The velocity of the instrument relative to this extended body is V. The beam has the
    direction d and the range R, and the surface has the normal n. A prime is a time derivative. The
    closing speed V.d grows at the rate V'.d + V.d'. The range falls at the speed (V + R (d' - w x
    d)).n / d.n. Bodies are assumed to rotate at steady rates.
    """
    rows, reference = np.arange(len(ray_directions)), np.maximum(bundle.reference_beamlet, 0)
    ray, body = ray_directions[rows, reference], bundle.body_index[rows, reference]
    direction_rate = np.cross(state.angular_velocity, ray) + scanner_rate
    velocity, acceleration = state.velocity.copy(), state.acceleration.copy()
    relative_direction_rate = direction_rate.copy()
    for body_number, body_state in enumerate(body_states):
        if body_state is None:
            continue
        is_on_body = (body == body_number)[:, None]
        angular_velocity = (
            body_state.angular_velocity if bodies_rotate else 0.0 * body_state.angular_velocity
        )
        relative_velocity = state.velocity - body_state.velocity
        lever_arm = state.position - body_state.position
        velocity = np.where(
            is_on_body, relative_velocity - np.cross(angular_velocity, lever_arm), velocity
        )
        relative_acceleration = (
            state.acceleration
            - body_state.acceleration
            - np.cross(angular_velocity, relative_velocity)
        )
        acceleration = np.where(is_on_body, relative_acceleration, acceleration)
        relative_direction_rate = np.where(
            is_on_body, direction_rate - np.cross(angular_velocity, ray), relative_direction_rate
        )
    reference_range = np.where(bundle.reference_beamlet >= 0, bundle.range, np.nan)
    closing_acceleration = _scalar_products(acceleration, ray) + _scalar_products(
        velocity, direction_rate
    )
    incidence_cosine = np.minimum(_scalar_products(bundle.normal, ray), -_GRAZING_SINE_MIN)
    approach_speed = (
        _scalar_products(
            velocity + reference_range[:, None] * relative_direction_rate, bundle.normal
        )
        / incidence_cosine
    )
    turn_rate = np.sqrt(_scalar_products(direction_rate, direction_rate))
    return (
        np.where(bundle.reference_beamlet >= 0, closing_acceleration, np.nan),
        approach_speed,
        turn_rate,
    )


def _scalar_products(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the scalar products (n,) of the rows of two arrays (n, 3)."""
    return first[:, 0] * second[:, 0] + first[:, 1] * second[:, 1] + first[:, 2] * second[:, 2]


def prepare_eyepoint_shots(
    eyepoints: Eyepoints,
    parameters: Parameters,
    surfaces: Sequence[SurfaceMaterial],
    effects: Collection[str] = DEFAULT_EFFECTS,
) -> Shots:
    """Prepare shots for simulation from their geometry (eyepoints); each shot must hit a surface.

    Parameters
    ----------
    eyepoints
        Geometry of n shots.
    parameters
        Parameters that `eyepoints` does not hold, by dotted path, scalars.
    surfaces
        Materials by the surface numbers of `eyepoints`.
    effects
        Names of the effects to simulate.
    """
    return prepare_ray_traced_shots(
        *parameters_and_ground_of_eyepoints(eyepoints, parameters, surfaces), effects
    )


def parameters_and_ground_of_eyepoints(
    eyepoints: Eyepoints, parameters: Parameters, surfaces: Sequence[SurfaceMaterial]
) -> tuple[Parameters, RayTracedGround]:
    """Convert the geometry of shots (eyepoints) to parameters and footprints for simulation.

    Range, velocities, reflectance and reflectance law follow from the eyepoints and the surfaces. A
    beamlet that misses returns no light.

    Parameters
    ----------
    eyepoints
        Geometry of n shots; each shot hits a surface.
    parameters
        Parameters that `eyepoints` does not hold, by dotted path, scalars.
    surfaces
        Materials by the surface numbers of `eyepoints`.

    Returns
    -------
    parameters : mapping
        Parameters by dotted path, (n,) or scalars.
    ground : RayTracedGround
        Footprints of the n shots.
    """
    surface = eyepoints.surface
    is_hit = surface >= 0
    relative_range_offset = np.where(is_hit, eyepoints.offset / eyepoints.range[:, None], 0.0)
    doppler_ratio_offset = np.where(is_hit, 2 * eyepoints.velocity_offset / SPEED_OF_LIGHT, 0.0)
    reflectances = np.array([surface_properties.reflectance for surface_properties in surfaces])
    sent_fraction = np.where(is_hit, eyepoints.weight * reflectances[surface], 0.0)
    beamlet_backscatter = np.zeros_like(sent_fraction)
    for law in {surface_properties.reflectance_law for surface_properties in surfaces}:
        has_law = np.array(
            [surface_properties.reflectance_law == law for surface_properties in surfaces]
        )[surface]
        law_backscatter = backscatter(law, eyepoints.cos_incidence)
        np.copyto(beamlet_backscatter, law_backscatter, where=is_hit & has_law)
    range_loss = (1 + relative_range_offset) * (1 + relative_range_offset)
    if beam.is_single_mode(parameters):
        linear_coefficient, quadratic_coefficient = beam.range_loss_coefficients(
            parameters, eyepoints.range[:, None]
        )
        range_loss = 1 + relative_range_offset * (
            linear_coefficient + relative_range_offset * quadratic_coefficient
        )
    relative_echo = sent_fraction * beamlet_backscatter / range_loss
    axis_surface = surface[np.arange(len(surface)), eyepoints.reference_beamlet]
    direction_z = eyepoints.direction[:, 2]
    height = eyepoints.position[:, 2] + eyepoints.range * direction_z
    beamlet_table = BeamletTable(
        np.arange(len(relative_echo)), relative_range_offset, doppler_ratio_offset, relative_echo
    )
    shot_parameters = {
        **parameters,
        "target.range": eyepoints.range,
        "target.radial_velocity": eyepoints.radial_velocity,
        "target.acceleration": eyepoints.acceleration,
        APPROACH_SPEED_PATH: eyepoints.approach_speed,
        beam.SCAN_RATE_PATH: parameters.get(beam.SCAN_RATE_PATH, 0.0) + eyepoints.turn_rate,
        BEAM_ELEVATION_PATH: -np.arcsin(direction_z),
        "target.reflectance": 1.0,
        TARGET_HEIGHT_PATH: parameters.get(TARGET_HEIGHT_PATH, 0.0) + height,
        # The sun lights the same surfaces: the irradiance contains their mean reflectance.
        SOLAR_IRRADIANCE_PATH: np.asarray(parameters[SOLAR_IRRADIANCE_PATH])
        * sent_fraction.sum(axis=1),
    }
    return shot_parameters, RayTracedGround(
        beamlet_table, is_hit & (surface != axis_surface[:, None])
    )
