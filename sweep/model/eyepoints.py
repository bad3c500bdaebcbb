"""Eyepoints: what each shot of a flight sees, before any radiometry.

The geometry of a shot - range, incidence, surface and radial velocity at every beamlet - does not
depend on laser power, receiver or processing. It is worked out once and serves any number of
radiometric studies [T 3.2].
"""

from collections.abc import Collection, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit

from sweep.model import reflectance
from sweep.model.chain import prepare_cast
from sweep.model.compiling import borrowing, inlined
from sweep.model.constants import SPEED_OF_LIGHT
from sweep.model.effects.atmosphere import PATH_ELEVATION
from sweep.model.effects.catalogue import CORE
from sweep.model.footprint import beamlets
from sweep.model.geometry.beamlet_rays import beamlet_rays
from sweep.model.geometry.jitter import PointingJitter
from sweep.model.geometry.platform import Flight, State
from sweep.model.geometry.quaternion import rotate
from sweep.model.geometry.rays import Bundle, Caster, Pose
from sweep.model.geometry.scanner import Scanner
from sweep.model.geometry.surfaces import Surface
from sweep.model.ground import Cast, Footprints
from sweep.model.preparation import Parameters, Shots

HEIGHT = "atmosphere.target_height"
SUNLIGHT = "target.solar_irradiance"

_RAYS = 512
"""Rays of shots that are looked at together: so many that what is made of them stays at hand."""
_LAMBERT = reflectance.LAWS.index("lambert")


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

    def some(self, shots: slice | np.ndarray) -> "Eyepoints":
        """Some of the shots, by a slice, their places or a mask; neighbours are not copied."""
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
) -> Eyepoints:
    """Eyepoints of shots by number.

    Parameters
    ----------
    index : (n,) int array
        Numbers of the shots, from 0; any stretch of a flight can be had without the rest.
    flight, scanner
        What carries the instrument, and where its beams point in the body frame, and when.
    caster : Caster
        The scene.
    beam_divergence : float
        Full angle between the 1/e^2 intensity points [rad].
    number, pattern
        Of :func:`sweep.model.footprint.beamlets`.
    bodies : sequence of Flight or None, optional
        Motion of each of the caster's bodies, None for one at rest; all at rest by default.
    jitter : PointingJitter, optional
        Turns the light of each shot, of which the instrument knows nothing: position, velocity
        and `direction` stay those commanded. None draws nothing.
    rotation : bool
        Whether the surfaces of turning bodies move as they turn.
    """
    index = np.asarray(index)
    shots = scanner.shots(index)
    time = flight.start + shots.time
    state = flight.state(time)
    (across, along), weight = beamlets(number, pattern)
    attitude = state.attitude if jitter is None else jitter.turned(state.attitude, index)
    rays = beamlet_rays(attitude, shots.direction, across, along, beam_divergence / 4)
    moving = [None if body is None else body.state(time) for body in bodies or ()]
    poses = [None if body is None else Pose(body.position, body.attitude) for body in moving]
    bundle = caster.bundle(state.position, rays, poses=poses or None)
    velocity = _radial_velocity(state, rays, bundle, moving, rotation)
    rows = np.arange(len(time))
    reference = velocity[rows, np.maximum(bundle.reference, 0)]
    return Eyepoints(
        time, shots.beam, shots.cycle, state.position, state.velocity,
        rotate(state.attitude, shots.direction), bundle.range, bundle.offset, reference,
        velocity - reference[:, None], bundle.cos_incidence, bundle.surface, weight,
    )  # fmt: skip


def _radial_velocity(
    state: State,
    rays: np.ndarray,
    bundle: Bundle,
    moving: Sequence[State | None],
    rotation: bool,
) -> np.ndarray:
    """Closing speed of instrument and surface along every beamlet [m/s], (n, b); nan for a miss.

    A surface on a body that turns moves with V + omega x (P - X) at the point P that is hit. A
    turn of the instrument about itself moves no light: it shows in the lever arm's velocity.
    """
    closing = np.empty(rays.shape[:2])
    _project(rays, state.velocity, bundle.surface, closing)
    for body, motion in enumerate(moving):
        if motion is None:
            continue
        surface = motion.velocity[:, None]
        if rotation and motion.rate.any():
            hit = np.where(bundle.body == body, bundle.range[:, None] + bundle.offset, 0.0)
            arm = state.position[:, None] + rays * hit[..., None] - motion.position[:, None]
            surface = surface + np.cross(motion.rate[:, None], arm)
        receding = (rays * surface).sum(axis=-1)
        closing = np.where(bundle.body == body, closing - receding, closing)
    return closing


@njit(cache=True, nogil=True, error_model="numpy")
def _project(rays, velocity, surface, closing):
    """Products of rays with the instrument's velocity, (n, b); nan for a miss."""
    for i in range(rays.shape[0]):
        x, y, z = velocity[i, 0], velocity[i, 1], velocity[i, 2]
        for b in range(rays.shape[1]):
            # x and z first: the order that results have had, bit for bit
            along = rays[i, b, 0] * x + rays[i, b, 2] * z + rays[i, b, 1] * y
            closing[i, b] = along if surface[i, b] >= 0 else np.nan


def prepare_eyepoints(
    eyepoints: Eyepoints,
    parameters: Parameters,
    surfaces: Sequence[Surface],
    effects: Collection[str] = CORE,
) -> Shots:
    """Radiometry's shots of eyepoints that all see something.

    Parameters
    ----------
    eyepoints, parameters, surfaces
        As of :func:`seen_ground`.
    effects : collection of str
        Names of the effects that are simulated.
    """
    return prepare_cast(*seen_ground(eyepoints, parameters, surfaces), effects)


def seen_ground(
    eyepoints: Eyepoints, parameters: Parameters, surfaces: Sequence[Surface]
) -> tuple[Parameters, Cast]:
    """Parameters of shots, and what their beams meet.

    Parameters
    ----------
    eyepoints : Eyepoints
        n shots, each :attr:`Eyepoints.seen`.
    parameters : mapping
        Instrument, footprint and accuracy as for :func:`sweep.model.shot.evaluate`, scalars.
        Range, velocity, reflectance and law come from the eyepoints and their surfaces.
    surfaces : sequence of Surface
        What the surface numbers mean.

    Raises
    ------
    ValueError
        Where a shot sees nothing, or a surface that is not given.
    """
    lit, relative, doppler, echo, beside = _footprints(eyepoints, surfaces)
    ground = Cast(Footprints(np.arange(len(echo)), relative, doppler, echo), beside)
    shots = {
        **parameters,
        **axis_parameters(eyepoints),
        "target.reflectance": 1.0,
        HEIGHT: parameters.get(HEIGHT, 0.0) + height_of_target(eyepoints),
        # The sun lights what the beam sees: its mean reflectance stands in the irradiance.
        SUNLIGHT: np.asarray(parameters[SUNLIGHT]) * lit,
    }
    return shots, ground


def axis_parameters(eyepoints: Eyepoints) -> dict[str, np.ndarray]:
    """What is seen along the beams' axes, by path, (n,) each."""
    return {
        "target.range": eyepoints.range,
        "target.radial_velocity": eyepoints.radial_velocity,
        PATH_ELEVATION: -np.arcsin(eyepoints.direction[:, 2]),
    }


def height_of_target(eyepoints: Eyepoints) -> np.ndarray:
    """Height in the world where the beam's axis ends [m], (n,)."""
    return eyepoints.position[:, 2] + eyepoints.range * eyepoints.direction[:, 2]


def _footprints(eyepoints: Eyepoints, surfaces: Sequence[Surface]) -> tuple[np.ndarray, ...]:
    """What footprints send back, and from where; 0 for a beamlet that misses.

    Returns
    -------
    (n,) ndarray
        Power fraction x reflectance.
    (n, beamlets) ndarray, (n, beamlets) ndarray, (n, beamlets) ndarray
        Offset, Doppler and echo as of :class:`sweep.model.ground.Footprints`.
    (n, beamlets) bool ndarray
        Whether a beamlet meets another surface than the reference beamlet.
    """
    rays, materials = _to_look_at(eyepoints, surfaces)
    shape = eyepoints.offset.shape
    sent, relative, doppler, echo = np.empty((4, *shape))
    beside = np.empty(shape, np.bool_)
    flat = tuple(values.reshape(-1) for values in (sent, relative, doppler, echo, beside))
    _look(rays, materials, np.empty(materials[0].size), flat)
    return sent.sum(axis=1), relative, doppler, echo, beside


def _to_look_at(
    eyepoints: Eyepoints, surfaces: Sequence[Surface]
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """What :func:`_look_at` needs of shots, one after the other, and of surfaces.

    Returns
    -------
    tuple of ndarray
        Ranges (n,); offsets, velocities, cosines and surface numbers of rays, (n beamlets,) each.
    tuple of ndarray
        Weights of the beamlets of as many shots as are looked at together; reflectance and law of
        each surface.

    Raises
    ------
    ValueError
        As of :func:`seen_ground`.
    """
    if not eyepoints.seen.all():
        raise ValueError("a shot that sees nothing has no radiometry: leave it out")
    if eyepoints.surface.max(initial=-1) >= len(surfaces):
        raise ValueError(f"beamlets hit surfaces beyond the {len(surfaces)} given")
    rays = (
        eyepoints.range, eyepoints.offset, eyepoints.velocity_offset, eyepoints.cos_incidence,
        eyepoints.surface,
    )  # fmt: skip
    together = max(_RAYS // len(eyepoints.weight), 1)
    weight = np.tile(eyepoints.weight, together)
    bright, laws = _materials(tuple(surfaces))
    return tuple(np.ascontiguousarray(v).reshape(-1) for v in rays), (weight, bright, laws)


@lru_cache(maxsize=16)
def _materials(surfaces: tuple[Surface, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Reflectance and number of the law of surfaces."""
    bright = np.array([surface.reflectance for surface in surfaces])
    return bright, np.array([reflectance.LAWS.index(surface.law) for surface in surfaces])


@borrowing(nogil=True)
def _look(rays, materials, room, found):
    """Fill in what :func:`_footprints` says, of rays one after the other."""
    ranges, offset = rays[0], rays[1]
    beamlets = offset.size // max(ranges.size, 1)
    group = room.size // beamlets
    sent, relative, doppler, echo, beside = found
    for first in range(0, ranges.size, group):
        stop = min(first + group, ranges.size)
        some = slice(first * beamlets, stop * beamlets)
        here = sent[some], relative[some], doppler[some], echo[some], beside[some]
        _look_at(first, stop, rays, materials, room, here)


@inlined(nogil=True)
def _look_at(first, stop, rays, materials, room, found):
    """What some footprints send back, and from where, ray by ray.

    All rays of shots are taken at once, however few each has, as the machine's vectors like it.
    """
    ranges, offset, velocity, cosine, surface = rays
    weight, bright, laws = materials
    sent, relative, _, echo, _ = found
    beamlets = sent.size // (stop - first)
    some = slice(first * beamlets, stop * beamlets)
    offset, velocity, cosine, surface = offset[some], velocity[some], cosine[some], surface[some]
    for i in range(first, stop):
        for j in range((i - first) * beamlets, (i - first + 1) * beamlets):
            room[j] = ranges[i]
    if _is_one(surface):
        axis = surface[0]
        _look_alike((room, offset, velocity, cosine), weight, bright[axis], laws[axis], found)
    else:
        _look_each(beamlets, (room, offset, velocity, cosine, surface), materials, found)
    for j in range(sent.size):  # by itself, as the machine's vectors take it
        echo[j] /= (1 + relative[j]) * (1 + relative[j])


@inlined(nogil=True)
def _look_alike(rays, weight, reflected, law, found):
    """The same of footprints that lie on one surface, in loops short enough for vectors."""
    ranges, offset, velocity, cosine = rays
    sent, relative, doppler, echo, beside = found
    for j in range(sent.size):
        beside[j] = False
    for j in range(sent.size):
        relative[j] = offset[j] / ranges[j]
    for j in range(sent.size):
        doppler[j] = 2 * velocity[j] / SPEED_OF_LIGHT
    for j in range(sent.size):
        sent[j] = weight[j] * reflected
    if law == _LAMBERT:
        for j in range(sent.size):
            echo[j] = sent[j] * reflectance.backscatter_of(_LAMBERT, cosine[j])
    else:
        even = reflectance.backscatter_of(law, 1.0)
        for j in range(sent.size):
            echo[j] = sent[j] * even


@borrowing(nogil=True)
def _look_each(beamlets, rays, materials, found):
    """The same of footprints on several surfaces, or with beamlets that miss, ray by ray."""
    ranges, offset, velocity, cosine, surface = rays
    weight, bright, laws = materials
    sent, relative, doppler, echo, beside = found
    for start in range(0, surface.size, beamlets):
        axis = _first_seen(surface[start : start + beamlets])
        for j in range(start, start + beamlets):
            s = surface[j]
            hit = s >= 0
            beside[j] = hit and s != axis
            relative[j] = offset[j] / ranges[j] if hit else 0.0
            doppler[j] = 2 * velocity[j] / SPEED_OF_LIGHT if hit else 0.0
            sent[j] = weight[j] * bright[s] if hit else 0.0
            back = reflectance.backscatter_of(laws[s], cosine[j]) if hit else 0.0
            echo[j] = sent[j] * back


@inlined(nogil=True)
def _is_one(surface):
    """Whether all beamlets meet one and the same surface."""
    different = 0
    for b in range(surface.size):
        different |= surface[b] ^ surface[0]
    return different == 0 and surface[0] >= 0


@inlined(nogil=True)
def _first_seen(surface):
    """Surface that the first beamlet meets that meets any; -1 for none."""
    for b in range(surface.size):
        if surface[b] >= 0:
            return surface[b]
    return -1
