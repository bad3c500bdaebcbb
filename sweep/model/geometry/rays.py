"""Rays cast at rigid bodies: what each hits first, how far off and how steeply.

Coordinates are taken relative to a mesh's own origin exactly, the nearest triangle is found by
tests that leave no crack between neighbours (:mod:`sweep.model.geometry.ray_triangle`), and its
plane is met in twice float64's precision (:mod:`sweep.model.geometry.ray_plane`): a range is the
exact one of the numbers given, rounded once, which at 2 km is 1e-6 rad of optical phase. A body
that moves is met in its own frame, so its mesh is never rebuilt.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.geometry import quaternion
from sweep.model.geometry.bvh import build
from sweep.model.geometry.bvh_traversal import nearest_of_bundles, nearest_of_rays
from sweep.model.geometry.mesh import Mesh
from sweep.model.geometry.ray_hits import are_units, first_hits, put_surfaces, take_nearer
from sweep.model.geometry.ray_ranges import finish_bundles, finish_rays, to_body, turn_to_body

_UNIT_TOLERANCE = 1e-9
_STILL = (np.eye(3)[None], np.zeros((1, 3)))


class Pose(NamedTuple):
    """Where a body is and how it is turned: x_world = attitude x_body + position."""

    position: np.ndarray
    """(3,) or, ray by ray (bundle by bundle), (n, 3) float64 [m]."""
    attitude: np.ndarray
    """(4,) or (n, 4) float64: quaternion (w, x, y, z) from the body's frame to the world's."""


class Hits(NamedTuple):
    """What each ray hits first."""

    face: np.ndarray
    """(n,) int64: triangle in the body's mesh, -1 for a miss."""
    range: np.ndarray
    """(n,) float64 [m] > 0: distance along the direction given, inf for a miss."""
    cos_incidence: np.ndarray
    """(n,) float64, 0..1: cosine of the angle to the normal, nan for a miss."""
    normal: np.ndarray
    """(n, 3) float64: unit normal of the facet, towards the ray's origin, nan for a miss."""
    surface: np.ndarray
    """(n,) int16: the triangle's surface, -1 for a miss."""
    body: np.ndarray
    """(n,) int16: number of the body hit, -1 for a miss."""


class Bundle(NamedTuple):
    """What the beamlets of each bundle hit first."""

    range: np.ndarray
    """(n,) float64 [m]: range R_0 of the reference beamlet, inf where all miss."""
    reference: np.ndarray
    """(n,) int64: beamlet that ranges are relative to, the first that hits; -1 where all miss."""
    normal: np.ndarray
    """(n, 3) float64: unit normal where the reference beamlet hits, towards the origin; or nan."""
    offset: np.ndarray
    """(n, b) float64 [m]: R_b - R_0 with all its digits, nan for a miss."""
    valid: np.ndarray
    """(n, b) bool: the beamlet hits something."""
    cos_incidence: np.ndarray
    """(n, b) float64, 0..1; nan for a miss."""
    surface: np.ndarray
    """(n, b) int16, -1 for a miss."""
    face: np.ndarray
    """(n, b) int64: triangle in the body's mesh, -1 for a miss."""
    body: np.ndarray
    """(n, b) int16: number of the body hit, -1 for a miss."""


class Caster:
    """One or several rigid bodies, ready to be cast at.

    Parameters
    ----------
    bodies : Mesh or sequence of Mesh
        The bodies, numbered from 0; coordinates in each body's frame.

    Raises
    ------
    ValueError
        There is no body.
    """

    def __init__(self, bodies: Mesh | Sequence[Mesh]):
        self.meshes = (bodies,) if isinstance(bodies, Mesh) else tuple(bodies)
        if not self.meshes:
            raise ValueError("there is no body to cast rays at")
        self._trees = [build(mesh.vertices, mesh.faces) for mesh in self.meshes]

    def cast(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        *,
        origin_offset: ArrayLike | None = None,
        poses: Sequence[Pose | None] | None = None,
    ) -> Hits:
        """First hits of single rays.

        Parameters
        ----------
        origins, directions : (n, 3) array_like
            Where rays start [m] and their unit vectors, in the world's frame. A facet on which a
            ray starts, within rounding, may count as hit or not.
        origin_offset : (3,) array_like, optional
            Added to the origins without rounding the sum [m], default zero: for coordinates of
            which float64 alone would keep too few digits.
        poses : sequence of Pose or None, optional
            Of each body, None for one that rests in the world's frame; default all at rest.

        Raises
        ------
        ValueError
            Shapes do not fit, a number is not finite, or a direction is not of length 1.
        """
        start, along = _rays(origins, directions, 2)
        n = len(start)
        frames = self._frames(origin_offset, poses, n)
        distance, face, body = _nothing_yet((n,))
        for number, frame in enumerate(frames):
            o, d = _in_frame(frame, start, along[:, None])
            found = np.full(n, -1)
            nearest_of_rays(self._trees[number], o, np.ascontiguousarray(d[:, 0]), distance, found)
            take_nearer(found, number, face, body)
        result = np.full(n, np.inf), np.zeros(n), np.full(n, np.nan), np.full((n, 3), np.nan)
        self._finish(frames, start, along[:, None], np.zeros_like(face), face, body, result)
        return Hits(face, result[0], result[2], result[3], self._surface(face, body), body)

    def bundle(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        *,
        origin_offset: ArrayLike | None = None,
        poses: Sequence[Pose | None] | None = None,
    ) -> Bundle:
        """First hits of bundles of beamlets, each bundle from one origin.

        Parameters
        ----------
        origins : (n, 3) array_like
            Where bundles start [m].
        directions : (n, b, 3) array_like
            Unit vectors of each bundle's beamlets, b >= 1, the beam's centre first.
        origin_offset, poses
            As in `cast`, a pose for each bundle.

        Raises
        ------
        ValueError
            As in `cast`.
        """
        start, along = _rays(origins, directions, 3)
        frames = self._frames(origin_offset, poses, len(start))
        distance, face, body = _nothing_yet(along.shape[:2])
        for number, frame in enumerate(frames):
            o, d = _in_frame(frame, start, along)
            found = np.full(face.shape, -1)
            nearest_of_bundles(self._trees[number], o, d, distance, found)
            take_nearer(found.reshape(-1), number, face.reshape(-1), body.reshape(-1))
        return self._relative(frames, start, along, face, body)

    def _frames(self, offset, poses, n):
        """(shift, rotation, position, anchor, fixed) of each body; see `body_origin`."""
        shift = np.zeros(3) if offset is None else np.array(offset, dtype=np.float64)
        if shift.shape != (3,) or not np.isfinite(shift).all():
            raise ValueError("an offset of origins is three finite coordinates")
        poses = [None] * len(self.meshes) if poses is None else poses
        if len(poses) != len(self.meshes):
            raise ValueError(f"{len(self.meshes)} bodies need as many poses, not {len(poses)}")
        return [
            (shift, *(_STILL if pose is None else _turned(pose, n)), mesh.origin, pose is None)
            for mesh, pose in zip(self.meshes, poses, strict=True)
        ]

    def _finish(self, frames, origins, directions, beamlet, face, body, result):
        """Fill ranges, cosines and normals of one beamlet of each bundle in, body by body."""
        for number, (mesh, frame) in enumerate(zip(self.meshes, frames, strict=True)):
            rays = np.flatnonzero(body == number)
            finish_rays(
                (mesh.vertices, mesh.faces), frame, rays, beamlet, origins, directions, face,
                result,
            )  # fmt: skip

    def _relative(self, frames, origins, directions, face, body):
        """Bundle of known hits: the reference beamlets first, then all relative to them."""
        n, rows = len(origins), np.arange(len(origins))
        reference = np.empty(n, np.int64)
        first_hits(face, reference)
        high, low, cosine = np.full(n, np.inf), np.zeros(n), np.full(n, np.nan)
        normal = np.full((n, 3), np.nan)
        at = face[rows, reference], body[rows, reference]
        self._finish(frames, origins, directions, reference, *at, (high, low, cosine, normal))
        result = np.full(face.shape, np.nan), np.full(face.shape, np.nan)
        for number, (mesh, frame) in enumerate(zip(self.meshes, frames, strict=True)):
            finish_bundles(
                (mesh.vertices, mesh.faces), frame, number, origins, directions,
                (face, body), (reference, high, low, normal), result,
            )  # fmt: skip
        surface = self._surface(face, body)
        return Bundle(high, reference, normal, result[0], face >= 0, result[1], surface, face, body)

    def _surface(self, face, body):
        """Surface of each triangle hit, -1 for a miss."""
        surface = np.full(face.shape, -1, dtype=np.int16)
        for number, mesh in enumerate(self.meshes):
            put_surfaces(
                mesh.surface, number, face.reshape(-1), body.reshape(-1), surface.reshape(-1)
            )
        return surface


def _rays(origins, directions, dimensions):
    """Origins and directions as contiguous float64, checked."""
    origins = np.ascontiguousarray(origins, dtype=np.float64)
    directions = np.ascontiguousarray(directions, dtype=np.float64)
    shape = (len(origins), *directions.shape[1:-1], 3)
    if origins.ndim != 2 or directions.ndim != dimensions or directions.shape != shape:
        raise ValueError(
            f"origins {origins.shape} and directions {directions.shape} do not fit each other"
        )
    if 0 in directions.shape[1:] or origins.shape[1] != 3:
        raise ValueError("a ray has an origin of three coordinates; a bundle, at least one beamlet")
    if not np.isfinite(origins).all():
        raise ValueError("a ray's origin is finite")
    if not are_units(directions.reshape(-1, 3), _UNIT_TOLERANCE):
        raise ValueError("a ray's direction is a vector of length 1")
    return origins, directions


def _nothing_yet(shape):
    """Distances, faces and bodies before any ray is cast."""
    return np.full(shape, np.inf), np.full(shape, -1), np.full(shape, -1, dtype=np.int16)


def _in_frame(frame, origins, directions):
    """Origins (n, 3) and directions (n, b, 3) in a mesh's frame."""
    _, rotation, _, _, fixed = frame
    o = np.empty_like(origins)
    to_body(origins, *frame, o)
    if fixed:
        return o, directions
    d = np.empty_like(directions)
    turn_to_body(directions, rotation, d)
    return o, d


def _turned(pose, n):
    """Rotation matrices (1 or n, 3, 3) and positions (1 or n, 3) of a pose."""
    attitude = np.atleast_2d(quaternion.normalise(pose.attitude))
    position = np.atleast_2d(np.asarray(pose.position, dtype=np.float64))
    count = max(len(attitude), len(position))
    if count not in (1, n) or attitude.shape[1] != 4 or position.shape[1] != 3:
        raise ValueError(f"a pose is one for all or one for each of {n} rays or bundles")
    if not np.isfinite(position).all():
        raise ValueError("a body's position is finite")
    columns = quaternion.rotate(attitude[:, None], np.eye(3))
    rotation = np.broadcast_to(np.swapaxes(columns, 1, 2), (count, 3, 3))
    return np.ascontiguousarray(rotation), np.ascontiguousarray(
        np.broadcast_to(position, (count, 3))
    )
