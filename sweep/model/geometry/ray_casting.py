"""Ray casting at rigid bodies: the first hit of each ray, its range and incidence.

Coordinates are taken relative to a mesh's own origin exactly. The nearest triangle is found by
tests that leave no gap between neighbouring triangles (:mod:`sweep.model.geometry.bvh`). The
distance of its plane is computed in twice float64's precision (:mod:`sweep.model.geometry.mesh`).
So a range is exact for the given numbers, except for one rounding. At 2 km this rounding is 1e-6
rad of optical phase. Rays are transformed to the frame of a moving body, so its mesh is never
rebuilt.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.model.geometry import quaternion
from sweep.model.geometry.bvh import build_tree, find_nearest_triangles
from sweep.model.geometry.double_double import DoubleDouble, dot, subtract
from sweep.model.geometry.mesh import Mesh, facet_normals, plane_distances

_RAYS_PER_BATCH = 4096
"""Number of rays that are processed in one step, so that intermediate results stay in the
processor's cache."""


class Pose(NamedTuple):
    """Position and attitude of a body, which transform body coordinates to world coordinates.

    x_world = attitude x_body + position, where the attitude rotates the vector.
    """

    position: np.ndarray
    """Position of the body's frame in the world [m], float64: (3,), or (n, 3) with one for each
    bundle of rays."""
    attitude: np.ndarray
    """Quaternion (w, x, y, z) from the body's frame to the world's, float64: (4,), or (n, 4) with
    one for each bundle of rays."""


class BundleHits(NamedTuple):
    """First hits of n bundles of b beamlets (rays that sample a beam).

    The reference beamlet of a bundle is the first that hits a body.
    """

    range: np.ndarray
    """(n,) float64: range of the reference beamlet [m]; inf if all beamlets miss."""
    reference_beamlet: np.ndarray
    """(n,) int64: index of the first beamlet that hits a body; -1 if all miss. Ranges of other
    beamlets are relative to the range of this one."""
    normal: np.ndarray
    """(n, 3) float64: unit normal of the surface that the reference beamlet hits, on the side of
    the ray's origin; nan if all beamlets miss."""
    range_offset: np.ndarray
    """(n, b) float64: range of each beamlet minus that of the reference beamlet [m]; nan for a
    beamlet that misses. It is computed before either range is rounded."""
    is_hit: np.ndarray
    """(n, b) bool: True if the beamlet hits a body."""
    cos_incidence: np.ndarray
    """(n, b) float64: cosine of the angle of incidence, 0..1; nan for a beamlet that misses."""
    surface_index: np.ndarray
    """(n, b) int16: index in the scene of the surface material that the beamlet hits; -1 for a
    beamlet that misses."""
    face_index: np.ndarray
    """(n, b) int64: index, in the body's mesh, of the triangle that is hit; -1 for a beamlet that
    misses."""
    body_index: np.ndarray
    """(n, b) int16: index of the body that is hit; -1 for a beamlet that misses."""


class RayCaster:
    """Rigid bodies, numbered from 0, at which rays can be cast.

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
        """Memory occupied by the triangles and box trees of all bodies [bytes]."""
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
        """Find the first hit of each ray (beamlet) in bundles; rays of a bundle share an origin.

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
            within rounding, may or may not count as hit.

        Returns
        -------
        BundleHits
        """
        origin, direction = (
            np.ascontiguousarray(rays, np.float64) for rays in (origins, directions)
        )
        frames = self._mesh_frames(poses, len(origin))
        face_index, body_index = self._find_first_hits(frames, origin, direction, range_min)
        is_hit = face_index >= 0
        reference_beamlet = np.where(is_hit.any(axis=1), is_hit.argmax(axis=1), -1)
        n_bundles, hit_bundles = len(origin), np.flatnonzero(reference_beamlet >= 0)
        range_rounded, range_remainder = np.full(n_bundles, np.inf), np.zeros(n_bundles)
        normal = np.full((n_bundles, 3), np.nan)
        reference_rays = _RayIndices(hit_bundles, reference_beamlet[hit_bundles])
        reference_hits = self._intersect_facets(
            frames,
            origin,
            direction,
            reference_rays,
            _HitFacets(face_index[reference_rays], body_index[reference_rays]),
        )
        range_rounded[hit_bundles] = reference_hits.range_rounded
        range_remainder[hit_bundles] = reference_hits.range_remainder
        normal[hit_bundles] = reference_hits.normal.T
        normal[
            hit_bundles[reference_hits.ray_normal_cosine > 0]
        ] *= -1.0  # towards the ray's origin
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
        range_offset *= -range_rounded[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):  # misses, or another facet
            range_offset /= cos_incidence
        is_other_facet = face_index != face_index[all_bundles, reference_beamlet][:, None]
        is_other_facet |= body_index != body_index[all_bundles, reference_beamlet][:, None]
        range_offset[is_other_facet] = cos_incidence[is_other_facet] = np.nan
        other_rays = _RayIndices(*np.nonzero(is_other_facet & is_hit))
        other_hits = self._intersect_facets(
            frames,
            origin,
            direction,
            other_rays,
            _HitFacets(face_index[other_rays], body_index[other_rays]),
        )
        range_offset[other_rays] = (other_hits.range_rounded - range_rounded[other_rays.bundle]) + (
            other_hits.range_remainder - range_remainder[other_rays.bundle]
        )
        cos_incidence[other_rays] = other_hits.ray_normal_cosine
        surface_index = np.full(face_index.shape, -1, dtype=np.int16)
        for body_number, mesh in enumerate(self.meshes):
            is_body = body_index == body_number
            surface_index[is_body] = mesh.surface_index[face_index[is_body]]
        return BundleHits(
            range_rounded,
            reference_beamlet,
            normal,
            range_offset,
            is_hit,
            np.abs(cos_incidence),
            surface_index,
            face_index,
            body_index,
        )

    def _find_first_hits(self, frames, origins, directions, range_min):
        """Return the indices of the triangle and the body that each beamlet hits first.

        Both arrays are (n, b). Elements of a beamlet that misses are -1.
        """
        shape = directions.shape[:2]
        distance, face_index = np.full(shape, np.inf), np.full(shape, -1)
        body_index = np.full(shape, -1, np.int16)
        for body_number, frame in enumerate(frames):
            nearer_face = np.full(shape, -1)
            rays = frame.rays_in_mesh_frame(origins, directions)
            find_nearest_triangles(
                self._trees[body_number], *rays, distance, nearer_face, range_min
            )
            is_nearer = nearer_face >= 0
            face_index[is_nearer], body_index[is_nearer] = nearer_face[is_nearer], body_number
        return face_index, body_index

    def _intersect_facets(self, frames, origins, directions, rays, facets):
        """Intersect m rays with the planes of the facets (triangles) that they hit.

        Parameters
        ----------
        frames : list of _MeshFrame
            Frame of each body.
        origins, directions : ndarray (n, 3), (n, b, 3)
            All bundles of rays, in the world's frame.
        rays : _RayIndices
            The m rays.
        facets : _HitFacets
            The facet that each of these rays hits.

        Returns
        -------
        _FacetIntersections
        """
        intersections = _FacetIntersections.empty(rays.bundle.size)
        for body_number, (mesh, frame) in enumerate(zip(self.meshes, frames, strict=True)):
            rays_of_body = np.flatnonzero(facets.body_index == body_number)
            for batch_start in range(0, len(rays_of_body), _RAYS_PER_BATCH):
                batch = rays_of_body[batch_start : batch_start + _RAYS_PER_BATCH]
                bundle, beamlet = rays.bundle[batch], rays.beamlet[batch]
                batch_intersections = _intersect_mesh(
                    mesh,
                    frame,
                    bundle,
                    origins[bundle],
                    directions[bundle, beamlet],
                    facets.face_index[batch],
                )
                for values, batch_values in zip(intersections, batch_intersections, strict=True):
                    values[..., batch] = batch_values
        return intersections

    def _mesh_frames(self, poses, n_bundles):
        """Return the :class:`_MeshFrame` of each body, at the body's pose.

        The pose of a body at rest in the world's frame is None.
        """
        poses = [None] * len(self.meshes) if poses is None else poses
        return [
            _MeshFrame(
                mesh.origin,
                *((None, None) if pose is None else _rotation_and_position(pose, n_bundles)),
            )
            for mesh, pose in zip(self.meshes, poses, strict=True)
        ]


class _RayIndices(NamedTuple):
    """Indices of m rays, which select elements of arrays (bundles, beamlets)."""

    bundle: np.ndarray
    """(m,) int64: index of the bundle to which each ray belongs."""
    beamlet: np.ndarray
    """(m,) int64: index of each ray in its bundle."""


class _HitFacets(NamedTuple):
    """Facets (triangles) that m rays hit."""

    face_index: np.ndarray
    """(m,) int64: index, in the body's mesh, of the triangle that each ray hits."""
    body_index: np.ndarray
    """(m,) int16: index of the body that each ray hits."""


class _FacetIntersections(NamedTuple):
    """Intersections of m rays with the planes of the facets (triangles) that they hit."""

    range_rounded: np.ndarray
    """(m,): range at which each ray meets the plane, rounded to float64 [m]."""
    range_remainder: np.ndarray
    """(m,): exact range minus ``range_rounded`` [m]."""
    normal: np.ndarray
    """(3, m): unit normal of the facet in the world's frame, oriented by its winding."""
    ray_normal_cosine: np.ndarray
    """(m,): cosine, -1..1, of the angle between the ray's direction and ``normal``."""

    @classmethod
    def empty(cls, n_rays: int) -> "_FacetIntersections":
        """Return uninitialised arrays for `n_rays` rays."""
        return cls(np.empty(n_rays), np.empty(n_rays), np.empty((3, n_rays)), np.empty(n_rays))


class _MeshFrame(NamedTuple):
    """Transformation from the world's frame to the frame of a mesh, for n bundles of rays."""

    mesh_origin: np.ndarray
    """(3,): position in the body's frame of the point to which the mesh's vertices are relative
    [m]."""
    rotation: np.ndarray | None
    """(n, 3, 3): rotation matrices from the body's frame to the world's; None if the frames are
    equal."""
    position: np.ndarray | None
    """(n, 3): position of the body's frame in the world [m]; None if the frames are equal."""

    def origins_in_mesh_frame(self, origins, ray_rows):
        """Transform origins of m rays to the mesh's frame.

        Parameters
        ----------
        origins : ndarray (m, 3)
            Origins in the world's frame [m].
        ray_rows : ndarray (m,) int
            Row of each ray in `rotation` and `position`.

        Returns
        -------
        DoubleDouble (3, m)
        """
        world_origin = DoubleDouble.from_float64(origins.T)
        mesh_origin = DoubleDouble.from_float64(self.mesh_origin[:, None])
        if self.rotation is None:
            return subtract(world_origin, mesh_origin)
        from_body = subtract(world_origin, DoubleDouble.from_float64(self.position[ray_rows].T))
        return subtract(self._rotate_to_body(from_body, ray_rows), mesh_origin)

    def directions_in_mesh_frame(self, directions, ray_rows):
        """Rotate directions of m rays to the mesh's frame.

        Parameters
        ----------
        directions : ndarray (m, 3)
            Directions in the world's frame.
        ray_rows : ndarray (m,) int
            Row of each ray in `rotation`.

        Returns
        -------
        DoubleDouble (3, m)
            Directions R^T d, with the rotation R from the body's frame to the world's.
        """
        world_direction = DoubleDouble.from_float64(directions.T)
        return (
            world_direction
            if self.rotation is None
            else self._rotate_to_body(world_direction, ray_rows)
        )

    def _rotate_to_body(self, vector, ray_rows):
        """Rotate double-double vectors (3, m) from the world's frame to the body's.

        ``ray_rows`` (m,) is the row of each vector in ``rotation``.
        """
        rotations = self.rotation[ray_rows].transpose(1, 2, 0)
        vector_column = DoubleDouble(vector.high[:, None], vector.low[:, None])
        return dot(vector_column, DoubleDouble.from_float64(rotations))

    def rays_in_mesh_frame(self, origins, directions):
        """Transform bundles of rays to the mesh's frame.

        Parameters
        ----------
        origins : ndarray (n, 3)
            Origin of each bundle in the world's frame [m].
        directions : ndarray (n, b, 3)
            Directions of the rays in the world's frame.

        Returns
        -------
        origins : ndarray (n, 3)
            R^T (o - p) - m for the origin o [m], rounded to float64. R is the rotation from the
            body's frame to the world's, p the body's position, and m the mesh's origin.
        directions : ndarray (n, b, 3)
            R^T d for the direction d, rounded to float64; a read-only array.
        """
        n_bundles, n_beamlets = directions.shape[:2]
        mesh_origins = self.origins_in_mesh_frame(origins, np.arange(n_bundles)).high.T
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
                self.directions_in_mesh_frame(flat_directions[batch], ray_rows[batch]).high.T
                for batch in batches
            ]
            directions = np.concatenate([*rotated, np.empty((0, 3))]).reshape(directions.shape)
        directions = directions.view()
        directions.flags.writeable = False  # always, else numba compiles another version
        return np.ascontiguousarray(mesh_origins), directions

    def rotate_to_world(self, vector, ray_rows):
        """Rotate vectors from the body's frame to the world's.

        Parameters
        ----------
        vector : ndarray (3, m)
            Components x, y, z in the body's frame, of m vectors in any unit.
        ray_rows : ndarray (m,) int
            Row of each vector in `rotation`.

        Returns
        -------
        ndarray (3, m)
            Components in the world's frame, in the same unit.
        """
        if self.rotation is None:
            return vector
        x_axis, y_axis, z_axis = self.rotation[ray_rows].transpose(2, 1, 0)
        x, y, z = vector
        return x_axis * x + y_axis * y + z_axis * z


def _intersect_mesh(mesh, frame, bundle, origins, directions, face_index):
    """Intersect m rays with the planes of the facets (triangles) that they hit in one mesh.

    Parameters
    ----------
    mesh, frame : Mesh, _MeshFrame
        Mesh, and its frame.
    bundle : ndarray (m,) int
        Bundle of each ray.
    origins, directions : ndarray (m, 3)
        Origins [m] and directions of the rays in the world's frame.
    face_index : ndarray (m,) int
        Facet of each ray.

    Returns
    -------
    _FacetIntersections
    """
    starts_facet = np.ones(len(bundle), bool)  # successive rays may hit the same facet
    starts_facet[1:] = (np.diff(bundle) != 0) | (np.diff(face_index) != 0)
    first_ray, facet_of_ray = np.flatnonzero(starts_facet), np.cumsum(starts_facet) - 1
    corners = mesh.vertices[mesh.faces[face_index[first_ray]]].transpose(1, 2, 0)
    first_corner, _, _ = corners
    ray_origin = frame.origins_in_mesh_frame(origins[first_ray], bundle[first_ray])
    normal = facet_normals(corners)
    plane_height = dot(normal, subtract(DoubleDouble.from_float64(first_corner), ray_origin))
    x, y, z = normal.high
    length = np.sqrt(x * x + y * y + z * z)
    unit_normal = frame.rotate_to_world(normal.high / length, bundle[first_ray])[:, facet_of_ray]
    normal, plane_height, ray_origin = (
        DoubleDouble(values.high[..., facet_of_ray], values.low[..., facet_of_ray])
        for values in (normal, plane_height, ray_origin)
    )
    ray_direction = frame.directions_in_mesh_frame(directions, bundle)
    distance = plane_distances(
        corners[..., facet_of_ray], normal, plane_height, ray_origin, ray_direction
    )
    x, y, z = unit_normal * directions.T
    return _FacetIntersections(distance.high, distance.low, unit_normal, x + y + z)


def _rotation_and_position(pose, n_bundles):
    """Return rotation matrices (n, 3, 3), body to world, and positions (n, 3) [m] of a pose."""
    attitude = np.atleast_2d(quaternion.normalise(pose.attitude))
    position = np.atleast_2d(np.asarray(pose.position, dtype=np.float64))
    columns = quaternion.rotate(attitude[:, None], np.eye(3))
    rotation = np.broadcast_to(np.swapaxes(columns, 1, 2), (n_bundles, 3, 3))
    return rotation, np.broadcast_to(position, (n_bundles, 3))
