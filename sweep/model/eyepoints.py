"""Eyepoints: what each shot of a flight sees, before any radiometry.

The geometry of a shot - range, incidence, surface and radial velocity at every beamlet - does not
depend on laser power, receiver or processing. It is worked out once and serves any number of
radiometric studies [T 3.2].
"""

from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from sweep.model import beam
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.atmosphere import PATH_ELEVATION
from sweep.model.effects.catalogue import CORE
from sweep.model.footprint import beamlets
from sweep.model.geometry.mesh import Surface
from sweep.model.geometry.platform import Flight, State
from sweep.model.geometry.quaternion import rotate
from sweep.model.geometry.rays import Bundle, Caster, Pose
from sweep.model.geometry.scanner import PointingJitter, Scanner, beamlet_rays
from sweep.model.ground import Cast, Footprints, backscatter
from sweep.model.preparation import APPROACH, Parameters, Shots
from sweep.model.shot import prepare_cast
from sweep.model.unsupported import UnsupportedShot

HEIGHT = "atmosphere.target_height"
SUNLIGHT = "target.solar_irradiance"

LEAST_RANGE = 1e-3
"""Range [m] below which a surface is passed through: no light is focused or falls off so near.

An instrument in the plane of a wall, or standing on the ground, would see it at range 0, where the
echo is infinite.
"""

_FLATTEST = 0.01
"""Sine of the grazing angle under which a surface is not taken to go on as a plane."""


class Eyepoints(NamedTuple):
    """Geometry of n shots of b beamlets; SI, world frame."""

    time: np.ndarray
    """(n,): start of the measurement [s]."""
    beam: np.ndarray
    """(n,) int64: number of the beam."""
    cycle: np.ndarray
    """(n,) int64: number of the measurement cycle."""
    position: np.ndarray
    """(n, 3): of the instrument [m]."""
    velocity: np.ndarray
    """(n, 3): of the instrument [m/s]."""
    direction: np.ndarray
    """(n, 3): unit vector along the beam's axis, as commanded."""
    range: np.ndarray
    """(n,): range R_0 of the reference beamlet [m]; inf where nothing is seen."""
    offset: np.ndarray
    """(n, b): R_b - R_0 [m]; nan for a beamlet that misses."""
    radial_velocity: np.ndarray
    """(n,): of the reference beamlet [m/s], positive when closing; nan where nothing is seen."""
    acceleration: np.ndarray
    """(n,): rate at which that grows [m/s^2]; nan where nothing is seen."""
    approach: np.ndarray
    """(n,): speed at which its range falls [m/s]; nan where nothing is seen."""
    turn_rate: np.ndarray
    """(n,): rate at which its direction turns [rad/s], by scanner and platform."""
    turning: np.ndarray
    """(n, 3): rate of change of the direction, as commanded [1/s]."""
    platform_acceleration: np.ndarray
    """(n, 3): of the instrument [m/s^2]."""
    velocity_offset: np.ndarray
    """(n, b): radial velocity less the reference's [m/s]; nan for a miss."""
    cos_incidence: np.ndarray
    """(n, b): 0..1; nan for a miss."""
    surface: np.ndarray
    """(n, b) int16: -1 for a miss."""
    weight: np.ndarray
    """(b,): power fractions; they sum to 1."""

    @property
    def seen(self) -> np.ndarray:
        """Shots of which any beamlet hits something, (n,) bool."""
        return np.isfinite(self.range)

    @property
    def reference(self) -> np.ndarray:
        """Reference beamlet, the first that hits anything, (n,)."""
        return np.asarray((self.surface >= 0).argmax(axis=1))

    @property
    def own_velocity(self) -> np.ndarray:
        """Velocity of the instrument along its beams, as commanded, (n,) [m/s]."""
        return _dot(self.velocity, self.direction)

    def some(self, shots: slice | np.ndarray) -> "Eyepoints":
        """Return some of the shots, by a slice, indices or a mask; neighbours are not copied."""
        places = np.arange(len(self.time))[shots]
        if places.size and (np.diff(places) == 1).all():
            shots = slice(places[0], places[-1] + 1)
        return Eyepoints._make([*(values[shots] for values in self[:-1]), self.weight])


def observe(
    index: np.ndarray,
    *,
    flight: Flight,
    scanner: Scanner,
    caster: Caster,
    beam_divergence: float,
    number: int,
    pattern: str = "hexagonal",
    bodies: Sequence[Flight | None] | None = None,
    jitter: PointingJitter | None = None,
    rotation: bool = True,
    angles: Callable[[np.ndarray], beam.Angles] | None = None,
) -> Eyepoints:
    """Eyepoints of shots by number (n,), from 0; any part of a flight can be had alone.

    `number` and `pattern` are those of :func:`sweep.model.footprint.beamlets`, `bodies` the motion
    of each of the caster's bodies, None for one at rest. `angles` gives the footprint by the range
    (n,) of the beam's axis, infinite where that hits nothing (:func:`sweep.model.beam.angles`);
    without it the beam is `beam_divergence` wide everywhere [rad, between 1/e^2 points].

    Surfaces nearer than `LEAST_RANGE` are passed through. `jitter` turns the light of each shot, of
    which the instrument knows nothing: position, velocity and `direction` stay those commanded.
    Without `rotation` the surfaces of turning bodies stand still. An UnsupportedShot names the
    first shot whose geometry is not finite.
    """
    index = np.asarray(index)
    shots = scanner.shots(index)
    time = flight.start + shots.time
    state = flight.state(time)
    (across, along), weight = beamlets(number, pattern)
    attitude = state.attitude if jitter is None else jitter.turned(state.attitude, index)
    moving = [None if body is None else body.state(time) for body in bodies or ()]
    poses = [None if body is None else Pose(body.position, body.attitude) for body in moving]
    fan = partial(beamlet_rays, attitude, shots.direction)
    if angles is None:
        seen = rays = fan(across, along, beam_divergence / 4)
    else:  # a ray along the axis tells how wide the footprint is
        nothing = np.zeros(1)
        axis = caster.bundle(
            state.position,
            fan(nothing, nothing, 1.0),
            poses=poses or None,
            least_range=LEAST_RANGE,
        )
        rays, seen = (
            fan(across, along, np.reshape(full, (-1, 1)) / 4) for full in angles(axis.range)
        )
    bundle = caster.bundle(state.position, rays, poses=poses or None, least_range=LEAST_RANGE)
    velocity = _radial_velocity(state, (rays, seen), bundle, moving, rotation)
    rows = np.arange(len(time))
    reference = velocity[rows, np.maximum(bundle.reference, 0)]
    turning = rotate(state.attitude, shots.turning)
    _require_finite(index, time, state, bundle, velocity)
    acceleration, approach, turn_rate = _along_beam(state, turning, rays, bundle, moving, rotation)
    direction = rotate(state.attitude, shots.direction)
    commanded = np.cross(state.rate, direction) + turning
    return Eyepoints(
        time, shots.beam, shots.cycle, state.position, state.velocity,
        direction, bundle.range, bundle.offset, reference,
        acceleration, approach, turn_rate, commanded, state.acceleration,
        velocity - reference[:, None], bundle.cos_incidence, bundle.surface, weight,
    )  # fmt: skip


def _require_finite(
    index: np.ndarray, time: np.ndarray, state: State, bundle: Bundle, velocity: np.ndarray
) -> None:
    """Refuse shots whose geometry is not finite: no loop over their spectra would end."""
    hit = bundle.valid
    for words, wrong in (
        ("position", ~np.isfinite(state.position).all(axis=1)),
        ("velocity", ~np.isfinite(state.velocity).all(axis=1)),
        ("range", (hit & ~np.isfinite(bundle.range[:, None] + bundle.offset)).any(axis=1)),
        ("angle of incidence", (hit & ~np.isfinite(bundle.cos_incidence)).any(axis=1)),
        ("radial velocity", (hit & ~np.isfinite(velocity)).any(axis=1)),
    ):
        if wrong.any():
            k = int(wrong.argmax())
            raise UnsupportedShot(
                f"shot {index[k]}, at time {time[k]:.6g} s, has a {words} that is not finite: "
                "check the path and the scene there for numbers out of all proportion",
                k,
            )


def _radial_velocity(
    state: State,
    rays: tuple[np.ndarray, np.ndarray],
    bundle: Bundle,
    moving: Sequence[State | None],
    rotation: bool,
) -> np.ndarray:
    """Compute closing speeds of instrument and surface along beamlets [m/s], (n, b); nan: a miss.

    Rays find the places, and hold the directions of light there. A surface on a body that turns
    moves with V + omega x (P - X) at the point P that is hit. A turn of the instrument about itself
    moves no light: it shows in the lever arm's velocity.
    """
    places, seen = rays
    closing = seen[..., 0] * state.velocity[:, :1]
    for k in (2, 1):  # the order that results have had, bit for bit
        closing += seen[..., k] * state.velocity[:, k, None]
    closing[~bundle.valid] = np.nan
    for body, motion in enumerate(moving):
        if motion is None:
            continue
        surface = motion.velocity[:, None]
        if rotation and motion.rate.any():
            hit = np.where(bundle.body == body, bundle.range[:, None] + bundle.offset, 0.0)
            arm = state.position[:, None] + places * hit[..., None] - motion.position[:, None]
            surface = surface + np.cross(motion.rate[:, None], arm)
        receding = (seen * surface).sum(axis=-1)
        closing = np.where(bundle.body == body, closing - receding, closing)
    return closing


def _along_beam(
    state: State,
    turning: np.ndarray,
    rays: np.ndarray,
    bundle: Bundle,
    moving: Sequence[State | None],
    rotation: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute closing acceleration, range rate (falling) and turn rate of reference beams, (n,).

    V is the velocity of the instrument against the body that is hit, which turns by w and is
    taken to extend to the instrument. The beam d sees the closing speed V.d, which grows by
    V'.d + V.d'. It meets the surface, a plane of normal n there, at a range that falls by
    (V + R (d' - w x d)).n / d.n. Bodies are taken to turn at steady rates. ``turning`` is the
    scanner's part of d', (n, 3).
    """
    rows, first = np.arange(len(rays)), np.maximum(bundle.reference, 0)
    ray, body = rays[rows, first], bundle.body[rows, first]
    turned = np.cross(state.rate, ray) + turning
    velocity, acceleration = state.velocity.copy(), state.acceleration.copy()
    sliding = turned.copy()
    for number, motion in enumerate(moving):
        if motion is None:
            continue
        here = (body == number)[:, None]
        spin = motion.rate if rotation else 0.0 * motion.rate
        against = state.velocity - motion.velocity
        arm = state.position - motion.position
        velocity = np.where(here, against - np.cross(spin, arm), velocity)
        grows = state.acceleration - motion.acceleration - np.cross(spin, against)
        acceleration = np.where(here, grows, acceleration)
        sliding = np.where(here, turned - np.cross(spin, ray), sliding)
    far = np.where(bundle.reference >= 0, bundle.range, np.nan)
    grows = _dot(acceleration, ray) + _dot(velocity, turned)
    steep = np.minimum(_dot(bundle.normal, ray), -_FLATTEST)
    falls = _dot(velocity + far[:, None] * sliding, bundle.normal) / steep
    turns = np.sqrt(_dot(turned, turned))
    return np.where(bundle.reference >= 0, grows, np.nan), falls, turns


def _dot(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return one[:, 0] * other[:, 0] + one[:, 1] * other[:, 1] + one[:, 2] * other[:, 2]


def prepare_eyepoints(
    eyepoints: Eyepoints,
    parameters: Parameters,
    surfaces: Sequence[Surface],
    effects: Collection[str] = CORE,
) -> Shots:
    """Radiometry's shots of eyepoints that all see something; arguments of :func:`seen_ground`."""
    return prepare_cast(*seen_ground(eyepoints, parameters, surfaces), effects)


def seen_ground(
    eyepoints: Eyepoints, parameters: Parameters, surfaces: Sequence[Surface]
) -> tuple[Parameters, Cast]:
    """Parameters of shots, and their footprints; a beamlet that misses sends nothing back.

    All n shots see something. Range, velocity, reflectance and law come from the eyepoints and the
    surfaces that their numbers mean, all other parameters are given, as scalars.
    """
    surface = eyepoints.surface
    hit = surface >= 0
    relative = np.where(hit, eyepoints.offset / eyepoints.range[:, None], 0.0)
    doppler = np.where(hit, 2 * eyepoints.velocity_offset / SPEED_OF_LIGHT, 0.0)
    bright = np.array([each.reflectance for each in surfaces])
    sent = np.where(hit, eyepoints.weight * bright[surface], 0.0)
    back = np.zeros_like(sent)
    for law in {each.law for each in surfaces}:
        by_law = np.array([each.law == law for each in surfaces])[surface]
        scattered = backscatter(law, eyepoints.cos_incidence)
        np.copyto(back, scattered, where=hit & by_law)
    loss = (1 + relative) * (1 + relative)
    if beam.is_single_mode(parameters):
        first, second = beam.dimming(parameters, eyepoints.range[:, None])
        loss = 1 + relative * (first + relative * second)
    echo = sent * back / loss
    axis = surface[np.arange(len(surface)), eyepoints.reference]
    upwards = eyepoints.direction[:, 2]
    height = eyepoints.position[:, 2] + eyepoints.range * upwards
    footprints = Footprints(np.arange(len(echo)), relative, doppler, echo)
    shots = {
        **parameters,
        "target.range": eyepoints.range,
        "target.radial_velocity": eyepoints.radial_velocity,
        "target.acceleration": eyepoints.acceleration,
        APPROACH: eyepoints.approach,
        beam.SCAN_RATE: parameters.get(beam.SCAN_RATE, 0.0) + eyepoints.turn_rate,
        PATH_ELEVATION: -np.arcsin(upwards),
        "target.reflectance": 1.0,
        HEIGHT: parameters.get(HEIGHT, 0.0) + height,
        # The sun lights what the beam sees: its mean reflectance stands in the irradiance.
        SUNLIGHT: np.asarray(parameters[SUNLIGHT]) * sent.sum(axis=1),
    }
    return shots, Cast(footprints, hit & (surface != axis[:, None]))
