"""Ray casting at rigid bodies: the first hit of each ray, its range and incidence.

Coordinates are taken relative to a mesh's own origin exactly. Tests without gaps between neighbours
find the nearest triangle (:mod:`sweep.model.geometry.bvh`). Its plane is intersected in twice
float64's precision (:mod:`sweep.model.geometry.mesh`). So a range is the exact one for the given
numbers, rounded once, which at 2 km is 1e-6 rad of optical phase. Rays are transformed to the frame
of a moving body, so its mesh is never rebuilt.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.geometry import quaternion
from sweep.model.geometry.bvh import build_tree, find_nearest_triangles
from sweep.model.geometry.mesh import (
    Mesh,
    dot,
    facet_normals,
    plane_distances,
    subtract,
    to_double_double,
)

_RAYS_PER_BATCH = 4096
"""Number of rays processed together, so that intermediate results stay in the cache."""


class Pose(NamedTuple):
    """Position and attitude of a body: x_world = attitude x_body + position."""

    position: np.ndarray
    """(3,), or (n, 3) for each bundle, float64 [m]."""
    attitude: np.ndarray
    """(4,) or (n, 4) float64: quaternion (w, x, y, z) from the body's frame to the world's."""


class BundleHits(NamedTuple):
    """First hits of the beamlets of each bundle."""

    range: np.ndarray
    """(n,) float64 [m]: range R_0 of the reference beamlet, inf if all miss."""
    reference_beamlet: np.ndarray
    """(n,) int64: beamlet that ranges are relative to, the first that hits; -1 if all miss."""
    normal: np.ndarray
    """(n, 3) float64: unit normal where the reference beamlet hits, towards the origin; nan if all
    miss."""
    range_offset: np.ndarray
    """(n, b) float64 [m]: R_b - R_0 with all its digits, nan for a miss."""
    is_hit: np.ndarray
    """(n, b) bool: True if the beamlet hits a body."""
    cos_incidence: np.ndarray
    """(n, b) float64: cosine of the incidence angle, 0..1; nan for a miss."""
    surface_index: np.ndarray
    """(n, b) int16: index of the surface, -1 for a miss."""
    face_index: np.ndarray
    """(n, b) int64: triangle in the body's mesh, -1 for a miss."""
    body_index: np.ndarray
    """(n, b) int16: index of the body, -1 for a miss."""


class RayCaster:
    """Rigid bodies, numbered from 0, prepared for ray casting.

    Parameters
    ----------
    bodies : Mesh or sequence of Mesh
        Meshes of the bodies.
    """

    def __init__(self, bodies: Mesh | Sequence[Mesh]):
        self.meshes = (bodies,) if isinstance(bodies, Mesh) else tuple(bodies)
        self._trees = [build_tree(mesh.vertices, mesh.faces) for mesh in self.meshes]

    @property
    def nbytes(self) -> int:
        """Memory of the bodies' triangles and trees [bytes]."""
        mesh_bytes = sum(
            mesh.vertices.nbytes + mesh.faces.nbytes + mesh.surface_index.nbytes
            for mesh in self.meshes
        )
        return mesh_bytes + sum(array.nbytes for tree in self._trees for array in tree)

    def cast_bundles(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        *,
        poses: Sequence[Pose | None] | None = None,
        range_min: float = 0.0,
    ) -> BundleHits:
        """Find the first hits of bundles of beamlets.

        Parameters
        ----------
        origins : array_like (n, 3)
            Origin of each bundle in the world's frame [m].
        directions : array_like (n, b, 3)
            Unit vectors in the world's frame, the beam's centre first.
        poses : sequence of Pose or None, optional
            Pose of each body; None for a body at rest in the world's frame.
        range_min : float
            Rays pass through everything nearer than this [m]. At 0, a facet on which a ray starts,
            within rounding, may count as hit or not.

        Returns
        -------
        BundleHits
        """
        origin, direction = (
            np.ascontiguousarray(rays, np.float64) for rays in (origins, directions)
        )
        frames = self._mesh_frames(poses, len(origin))
        face_index, body_index = self._first_hits(frames, origin, direction, range_min)
        is_hit = face_index >= 0
        reference_beamlet = np.where(is_hit.any(axis=1), is_hit.argmax(axis=1), -1)
        n_bundles, hit_bundles = len(origin), np.flatnonzero(reference_beamlet >= 0)
        range_high, range_low, normal = (
            np.full(n_bundles, np.inf),
            np.zeros(n_bundles),
            np.full((n_bundles, 3), np.nan),
        )
        reference_rays = hit_bundles, reference_beamlet[hit_bundles]
        reference_hits = self._intersect(
            frames,
            origin,
            direction,
            reference_rays,
            (face_index[reference_rays], body_index[reference_rays]),
        )
        range_high[hit_bundles], range_low[hit_bundles], normal[hit_bundles], cosines = (
            reference_hits
        )
        normal[hit_bundles[cosines > 0]] *= -1.0  # towards the ray's origin
        # On one facet t_b - t_0 = -t_0 n.delta / (n.d_b), delta = d_b - d_0, without cancellation.
        all_bundles, (range_offset, cos_incidence) = (
            np.arange(n_bundles),
            np.zeros((2, *face_index.shape)),
        )
        for axis in range(3):
            normal_component, direction_component = normal[:, axis, None], direction[..., axis]
            cos_incidence += normal_component * direction_component
            range_offset += normal_component * (
                direction_component - direction_component[all_bundles, reference_beamlet][:, None]
            )
        range_offset *= -range_high[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):  # misses, or another facet
            range_offset /= cos_incidence
        is_other_facet = face_index != face_index[all_bundles, reference_beamlet][:, None]
        is_other_facet |= body_index != body_index[all_bundles, reference_beamlet][:, None]
        range_offset[is_other_facet] = cos_incidence[is_other_facet] = np.nan
        other_rays = np.nonzero(is_other_facet & is_hit)
        reference_hits = self._intersect(
            frames, origin, direction, other_rays, (face_index[other_rays], body_index[other_rays])
        )
        range_offset[other_rays] = (reference_hits[0] - range_high[other_rays[0]]) + (
            reference_hits[1] - range_low[other_rays[0]]
        )
        cos_incidence[other_rays] = reference_hits[3]
        surface_index = np.full(face_index.shape, -1, dtype=np.int16)
        for body_number, mesh in enumerate(self.meshes):
            is_body = body_index == body_number
            surface_index[is_body] = mesh.surface_index[face_index[is_body]]
        return BundleHits(
            range_high,
            reference_beamlet,
            normal,
            range_offset,
            is_hit,
            np.abs(cos_incidence),
            surface_index,
            face_index,
            body_index,
        )

    def _first_hits(self, frames, origins, directions, range_min):
        """Return the triangle and the body that each beamlet hits first, (n, b) each."""
        shape = directions.shape[:2]
        distance, face_index = np.full(shape, np.inf), np.full(shape, -1)
        body_index = np.full(shape, -1, np.int16)
        for body_number, frame in enumerate(frames):
            found_face = np.full(shape, -1)
            rays = frame.to_mesh_rounded(origins, directions)
            find_nearest_triangles(self._trees[body_number], *rays, distance, found_face, range_min)
            is_nearer = found_face >= 0
            face_index[is_nearer], body_index[is_nearer] = found_face[is_nearer], body_number
        return face_index, body_index

    def _intersect(self, frames, origins, directions, ray_indices, facets):
        """Return ranges, high and low [m], normals (m, 3), and cosines between rays and normals.

        `ray_indices` are bundle and beamlet of each ray, ((m,), (m,)); `facets` are its triangle
        and body.
        """
        results = np.empty((6, len(ray_indices[0])))
        for body_number, (mesh, frame) in enumerate(zip(self.meshes, frames, strict=True)):
            hit_places = np.flatnonzero(facets[1] == body_number)
            for batch_start in range(0, len(hit_places), _RAYS_PER_BATCH):
                batch = hit_places[batch_start : batch_start + _RAYS_PER_BATCH]
                bundle, beamlet = ray_indices[0][batch], ray_indices[1][batch]
                results[:, batch] = _intersect_mesh(
                    mesh,
                    frame,
                    bundle,
                    origins[bundle],
                    directions[bundle, beamlet],
                    facets[0][batch],
                )
        return results[0], results[1], results[2:5].T, results[5]

    def _mesh_frames(self, poses, n_bundles):
        """Return the frame of each body for its pose."""
        poses = [None] * len(self.meshes) if poses is None else poses
        return [
            _MeshFrame(
                mesh.origin, *((None, None) if pose is None else _pose_matrices(pose, n_bundles))
            )
            for mesh, pose in zip(self.meshes, poses, strict=True)
        ]


class _MeshFrame(NamedTuple):
    """Frame of a mesh, for n rays or bundles."""

    mesh_origin: np.ndarray
    """(3,): the mesh's own origin in the body's frame [m]."""
    rotation: np.ndarray | None
    """(n, 3, 3): x_world = rotation x_body + position; None if the body's frame is the world's."""
    position: np.ndarray | None
    """(n, 3): position of the body [m]; None if the body's frame is the world's."""

    def to_mesh_origins(self, origins, ray_rows):
        """Return origins (m, 3) in the mesh's frame as double-doubles (3, m).

        `ray_rows` (m,) are the rows of the rays in rotation and position.
        """
        world_origin, mesh_origin = (
            to_double_double(origins.T),
            to_double_double(self.mesh_origin[:, None]),
        )
        if self.rotation is None:
            return subtract(world_origin, mesh_origin)
        from_body = subtract(world_origin, to_double_double(self.position[ray_rows].T))
        return subtract(self._rotate_back(from_body, ray_rows), mesh_origin)

    def to_mesh_directions(self, directions, ray_rows):
        """Return directions (m, 3) in the mesh's frame as double-doubles (3, m)."""
        world_direction = to_double_double(directions.T)
        return (
            world_direction
            if self.rotation is None
            else self._rotate_back(world_direction, ray_rows)
        )

    def _rotate_back(self, vector, ray_rows):
        """Rotate vectors from the world's frame to the body's."""
        rotations = self.rotation[ray_rows].transpose(1, 2, 0)
        return dot((vector[0][:, None], vector[1][:, None]), to_double_double(rotations))

    def to_mesh_rounded(self, origins, directions):
        """Return origins (n, 3) and directions (n, b, 3) in the mesh's frame, as float64."""
        n_bundles, n_beamlets = directions.shape[:2]
        mesh_origins = self.to_mesh_origins(origins, np.arange(n_bundles))[0].T
        if self.rotation is not None:
            flat_directions, ray_rows = (
                directions.reshape(-1, 3),
                np.repeat(np.arange(n_bundles), n_beamlets),
            )
            batches = [
                slice(batch_start, batch_start + _RAYS_PER_BATCH)
                for batch_start in range(0, n_bundles * n_beamlets, _RAYS_PER_BATCH)
            ]
            rotated = [
                self.to_mesh_directions(flat_directions[batch], ray_rows[batch])[0].T
                for batch in batches
            ]
            directions = np.concatenate([*rotated, np.empty((0, 3))]).reshape(directions.shape)
        directions = directions.view()
        directions.flags.writeable = False  # always, else numba compiles another version
        return np.ascontiguousarray(mesh_origins), directions

    def to_world(self, vector, ray_rows):
        """Return vectors (3, m) in the world's frame."""
        if self.rotation is None:
            return vector
        x, y, z = self.rotation[ray_rows].transpose(2, 1, 0)
        return x * vector[0] + y * vector[1] + z * vector[2]


def _intersect_mesh(mesh, frame, bundle, origins, directions, face_index):
    """Return the results of `RayCaster._intersect` for rays that hit one body, as rows (6, m)."""
    starts_facet = np.ones(len(bundle), bool)  # successive rays may hit the same facet
    starts_facet[1:] = (np.diff(bundle) != 0) | (np.diff(face_index) != 0)
    first_ray, facet_of_ray = np.flatnonzero(starts_facet), np.cumsum(starts_facet) - 1
    corners = mesh.vertices[mesh.faces[face_index[first_ray]]].transpose(1, 2, 0)
    ray_origin = frame.to_mesh_origins(origins[first_ray], bundle[first_ray])
    normal = facet_normals(corners)
    plane_height = dot(normal, subtract(to_double_double(corners[0]), ray_origin))
    length = np.sqrt(
        normal[0][0] * normal[0][0] + normal[0][1] * normal[0][1] + normal[0][2] * normal[0][2]
    )
    unit_normal = frame.to_world(normal[0] / length, bundle[first_ray])[:, facet_of_ray]
    normal, plane_height, ray_origin = (
        tuple(component[..., facet_of_ray] for component in pair)
        for pair in (normal, plane_height, ray_origin)
    )
    ray_direction = frame.to_mesh_directions(directions, bundle)
    distance_high, distance_low = plane_distances(
        corners[..., facet_of_ray], normal, plane_height, ray_origin, ray_direction
    )
    x, y, z = unit_normal * directions.T
    return np.concatenate([[distance_high, distance_low], unit_normal, [x + y + z]])


def _pose_matrices(pose, n_bundles):
    """Return the rotation matrices (n, 3, 3) and positions (n, 3) of a pose."""
    attitude = np.atleast_2d(quaternion.normalise(pose.attitude))
    position = np.atleast_2d(np.asarray(pose.position, dtype=np.float64))
    columns = quaternion.rotate(attitude[:, None], np.eye(3))
    rotation = np.broadcast_to(np.swapaxes(columns, 1, 2), (n_bundles, 3, 3))
    return rotation, np.broadcast_to(position, (n_bundles, 3))
