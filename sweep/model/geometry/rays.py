"""Rays cast at rigid bodies: what each hits first, how far off and how steeply.

Coordinates are taken relative to a mesh's own origin exactly. The nearest triangle is found by
tests that leave no crack between neighbours (:mod:`sweep.model.geometry.bvh`). Its plane is met in
twice float64's precision (:mod:`sweep.model.geometry.mesh`). So a range is the exact one of the
numbers given, rounded once, which at 2 km is 1e-6 rad of optical phase. A body that moves is met in
its own frame, so its mesh is never rebuilt.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.geometry import quaternion
from sweep.model.geometry.bvh import build, nearest
from sweep.model.geometry.mesh import Mesh, distances, dot, exact, less, normals

_AT_ONCE = 4096
"""Rays that are looked at together: so many that what is made of them stays at hand."""


class Pose(NamedTuple):
    """Position and attitude of a body: x_world = attitude x_body + position."""

    position: np.ndarray
    """(3,) or, ray by ray (bundle by bundle), (n, 3) float64 [m]."""
    attitude: np.ndarray
    """(4,) or (n, 4) float64: quaternion (w, x, y, z) from the body's frame to the world's."""


class Bundle(NamedTuple):
    """First hits of the beamlets of each bundle."""

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
    """One or several rigid bodies, numbered from 0, ready to be cast at."""

    def __init__(self, bodies: Mesh | Sequence[Mesh]):
        self.meshes = (bodies,) if isinstance(bodies, Mesh) else tuple(bodies)
        self._trees = [build(mesh.vertices, mesh.faces) for mesh in self.meshes]

    @property
    def nbytes(self) -> int:
        """Bytes of the bodies' triangles and trees."""
        of_meshes = sum(m.vertices.nbytes + m.faces.nbytes + m.surface.nbytes for m in self.meshes)
        return of_meshes + sum(array.nbytes for tree in self._trees for array in tree)

    def bundle(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        *,
        poses: Sequence[Pose | None] | None = None,
        least_range: float = 0.0,
    ) -> Bundle:
        """First hits of bundles of beamlets, each bundle from one origin (n, 3) [m].

        Directions (n, b, 3) are unit vectors in the world's frame, the beam's centre first. A pose
        of None is that of a body that rests in the world's frame. Rays pass through all that is
        nearer than `least_range` [m]. If that is 0, a facet on which a ray starts, within
        rounding, may count as hit or not.
        """
        start, along = (np.ascontiguousarray(a, np.float64) for a in (origins, directions))
        frames = self._frames(poses, len(start))
        face, body = self._first_hits(frames, start, along, least_range)
        hit = face >= 0
        reference = np.where(hit.any(axis=1), hit.argmax(axis=1), -1)
        n, rows = len(start), np.flatnonzero(reference >= 0)
        high, low, normal = np.full(n, np.inf), np.zeros(n), np.full((n, 3), np.nan)
        centre = rows, reference[rows]
        met = self._met(frames, start, along, centre, (face[centre], body[centre]))
        high[rows], low[rows], normal[rows], cosine = met
        normal[rows[cosine > 0]] *= -1.0  # towards the ray's origin
        # On one facet  t_b - t_0 = -t_0 n.delta / (n.d_b),  delta = d_b - d_0: nothing is lost.
        every, (offset, cos_incidence) = np.arange(n), np.zeros((2, *face.shape))
        for k in range(3):
            unit, d = normal[:, k, None], along[..., k]
            cos_incidence += unit * d
            offset += unit * (d - d[every, reference][:, None])
        offset *= -high[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):  # nothing is hit, or another facet
            offset /= cos_incidence
        other = face != face[every, reference][:, None]
        other |= body != body[every, reference][:, None]
        offset[other] = cos_incidence[other] = np.nan
        others = np.nonzero(other & hit)
        met = self._met(frames, start, along, others, (face[others], body[others]))
        offset[others] = (met[0] - high[others[0]]) + (met[1] - low[others[0]])
        cos_incidence[others] = met[3]
        surface = np.full(face.shape, -1, dtype=np.int16)
        for number, mesh in enumerate(self.meshes):
            here = body == number
            surface[here] = mesh.surface[face[here]]
        return Bundle(
            high, reference, normal, offset, hit, np.abs(cos_incidence), surface, face, body
        )

    def _first_hits(self, frames, origins, directions, least_range):
        """Triangle and body that each beamlet hits first, (n, b)."""
        shape = directions.shape[:2]
        distance, face = np.full(shape, np.inf), np.full(shape, -1)
        body = np.full(shape, -1, np.int16)
        for number, frame in enumerate(frames):
            found = np.full(shape, -1)
            rays = frame.rounded(origins, directions)
            nearest(self._trees[number], *rays, distance, found, least_range)
            nearer = found >= 0
            face[nearer], body[nearer] = found[nearer], number
        return face, body

    def _met(self, frames, origins, directions, rays, hit):
        """Ranges of facets that rays meet, high and low [m], normals (m, 3), cosines to these.

        `rays` are bundle and beamlet of each, ((m,), (m,)), `hit` its triangle and body.
        """
        found = np.empty((6, len(rays[0])))
        for number, (mesh, frame) in enumerate(zip(self.meshes, frames, strict=True)):
            places = np.flatnonzero(hit[1] == number)
            for first in range(0, len(places), _AT_ONCE):
                some = places[first : first + _AT_ONCE]
                i, b = rays[0][some], rays[1][some]
                found[:, some] = _met_on(mesh, frame, i, origins[i], directions[i, b], hit[0][some])
        return found[0], found[1], found[2:5].T, found[5]

    def _frames(self, poses, n):
        """Frame of each body."""
        poses = [None] * len(self.meshes) if poses is None else poses
        return [
            _Frame(mesh.origin, *((None, None) if pose is None else _turned(pose, n)))
            for mesh, pose in zip(self.meshes, poses, strict=True)
        ]


class _Frame(NamedTuple):
    """Frame of a mesh, for n rays or bundles."""

    anchor: np.ndarray
    """(3,): the mesh's own origin in the body's frame [m]."""
    rotation: np.ndarray | None
    """(n, 3, 3): x_world = rotation x_body + position; None: the body's frame is the world's."""
    position: np.ndarray | None
    """(n, 3) [m]."""

    def origins(self, origins, rows):
        """Origins of rays (m, 3) by their places (m,) as a vector of pairs (3, m)."""
        x, anchor = exact(origins.T), exact(self.anchor[:, None])
        if self.rotation is None:
            return less(x, anchor)
        away = less(x, exact(self.position[rows].T))
        return less(self._back(away, rows), anchor)

    def directions(self, directions, rows):
        """Directions of rays, likewise."""
        d = exact(directions.T)
        return d if self.rotation is None else self._back(d, rows)

    def _back(self, v, rows):
        turns = self.rotation[rows].transpose(1, 2, 0)
        return dot((v[0][:, None], v[1][:, None]), exact(turns))

    def rounded(self, origins, directions):
        """Origins (n, 3) and directions (n, b, 3) in the mesh's frame, rounded to float64."""
        n, b = directions.shape[:2]
        o = self.origins(origins, np.arange(n))[0].T
        if self.rotation is not None:
            d, rows = directions.reshape(-1, 3), np.repeat(np.arange(n), b)
            parts = [slice(k, k + _AT_ONCE) for k in range(0, n * b, _AT_ONCE)]
            turned = [self.directions(d[part], rows[part])[0].T for part in parts]
            directions = np.concatenate([*turned, np.empty((0, 3))]).reshape(directions.shape)
        directions = directions.view()
        directions.flags.writeable = False  # always, as numba compiles anew for either
        return np.ascontiguousarray(o), directions

    def out(self, v, rows):
        """Vectors (3, m) in the world's frame."""
        if self.rotation is None:
            return v
        x, y, z = self.rotation[rows].transpose(2, 1, 0)
        return x * v[0] + y * v[1] + z * v[2]


def _met_on(mesh, frame, bundle, origins, directions, face):
    """Compute what `_met` returns, for rays that meet one body, (6, m)."""
    is_new = np.ones(len(bundle), bool)  # the ray before may have met the same facet
    is_new[1:] = (np.diff(bundle) != 0) | (np.diff(face) != 0)
    first, of = np.flatnonzero(is_new), np.cumsum(is_new) - 1
    corners = mesh.vertices[mesh.faces[face[first]]].transpose(1, 2, 0)
    o = frame.origins(origins[first], bundle[first])
    n = normals(corners)
    height = dot(n, less(exact(corners[0]), o))
    length = np.sqrt(n[0][0] * n[0][0] + n[0][1] * n[0][1] + n[0][2] * n[0][2])
    unit = frame.out(n[0] / length, bundle[first])[:, of]
    n, height, o = (tuple(part[..., of] for part in pair) for pair in (n, height, o))
    d = frame.directions(directions, bundle)
    high, low = distances(corners[..., of], n, height, o, d)
    x, y, z = unit * directions.T
    return np.concatenate([[high, low], unit, [x + y + z]])


def _turned(pose, n):
    """Rotation matrices (n, 3, 3) and positions (n, 3) of a pose."""
    attitude = np.atleast_2d(quaternion.normalise(pose.attitude))
    position = np.atleast_2d(np.asarray(pose.position, dtype=np.float64))
    columns = quaternion.rotate(attitude[:, None], np.eye(3))
    rotation = np.broadcast_to(np.swapaxes(columns, 1, 2), (n, 3, 3))
    return rotation, np.broadcast_to(position, (n, 3))
