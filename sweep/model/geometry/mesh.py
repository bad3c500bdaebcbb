"""Triangle meshes for ray casting, their surface materials, and distances of facets along rays.

A wavelength of a micrometre at kilometres of range needs the last bits of float64, and grazing
incidence amplifies rounding. So a facet's normal, the ray's origin relative to a corner, and their
products are computed in double-double arithmetic (:mod:`sweep.model.geometry.double_double`). The
remaining error is the rounding of the range itself, half a unit in its last place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.model.geometry.double_double import (
    DoubleDouble,
    cross,
    dot,
    multiply,
    quick_two_sum,
    subtract,
)


@dataclass(frozen=True)
class SurfaceMaterial:
    """Optical properties of a kind of surface."""

    name: str
    """Name of the surface in the spec of the scene."""
    reflectance: float
    """Reflectance of the surface, 0..1. Its meaning depends on ``reflectance_law``."""
    reflectance_law: str = "lambert"
    """Name of the law by which the reflectance depends on the angle of incidence
    (:data:`sweep.model.ground.REFLECTANCE_LAWS`)."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangle mesh whose vertices are relative to an origin, which keeps the digits of positions.

    Raises
    ------
    ValueError
        For shapes that do not fit, no triangle, or a vertex that is not finite or missing.
    """

    vertices: np.ndarray
    """(n, 3) float64: positions of the vertices relative to ``origin`` [m]."""
    faces: np.ndarray
    """(m, 3) int32: indices of each triangle's three vertices. Their order may be either winding,
    since both sides are visible."""
    surface_index: np.ndarray
    """(m,) int16: index of each triangle's surface material in the scene."""
    origin: np.ndarray
    """(3,) float64 [m]: position, in the frame of the scene or of the body, of the point to which
    ``vertices`` are relative."""

    def __post_init__(self):
        require_consistent_mesh(self.vertices, self.faces, self.surface_index)
        if len(self.faces) == 0:
            raise ValueError("a mesh needs at least one triangle")
        if not np.isfinite(self.vertices).all():
            raise ValueError("a mesh's vertices are finite")
        if np.shape(self.origin) != (3,) or not np.isfinite(self.origin).all():
            raise ValueError("a mesh's origin is three finite coordinates")
        dtype_by_name = {"vertices": np.float64, "faces": np.int32, "surface_index": np.int16}
        for name, dtype in (dtype_by_name | {"origin": np.float64}).items():
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), dtype=dtype))


def merge_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Return one mesh of all triangles of meshes in the same frame, in the order of the meshes."""
    corners = [
        mesh.origin + corner_function(mesh.vertices, axis=0)
        for mesh in meshes
        for corner_function in (np.min, np.max)
    ]
    origin = rounded_centre(np.array(corners))
    if len(meshes) == 1 and np.array_equal(meshes[0].origin, origin):
        return meshes[0]
    vertices = np.empty((sum(len(mesh.vertices) for mesh in meshes), 3))
    faces = np.empty((sum(len(mesh.faces) for mesh in meshes), 3), np.int32)
    n_vertices = n_faces = 0
    for mesh in meshes:  # in place: copies of all would take twice the memory
        rows = slice(n_faces, n_faces + len(mesh.faces))
        np.add(mesh.faces, n_vertices, out=faces[rows])
        rows = slice(n_vertices, n_vertices + len(mesh.vertices))
        np.add(mesh.vertices, mesh.origin - origin, out=vertices[rows])
        n_vertices, n_faces = n_vertices + len(mesh.vertices), n_faces + len(mesh.faces)
    return Mesh(vertices, faces, np.concatenate([mesh.surface_index for mesh in meshes]), origin)


def require_consistent_mesh(
    vertices: np.ndarray, faces: np.ndarray, surface_index: np.ndarray
) -> None:
    """Check that the arrays of a mesh fit together and that faces refer to existing vertices.

    Parameters
    ----------
    vertices : ndarray (n, 3)
        Vertices.
    faces : ndarray (m, 3) of int
        Vertices of each triangle.
    surface_index : ndarray (m,)
        Surface of each triangle.

    Raises
    ------
    ValueError
        If shapes do not fit, indices are not integers, or a face names a vertex that does not
        exist.
    """
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"vertices are of shape (n, 3), not {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"faces are integers of shape (m, 3), not {faces.dtype} {faces.shape}")
    if surface_index.shape != faces.shape[:1]:
        raise ValueError(f"{len(faces)} faces need as many surfaces, not {surface_index.shape}")
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError(f"a face names a vertex outside 0..{len(vertices) - 1}")


def rounded_centre(vertices: np.ndarray) -> np.ndarray:
    """Return the centre (3,) of the bounding box of vertices (n, 3), rounded [m].

    Subtracting the result from a vertex has no rounding error. The centre is rounded to multiples
    of a power of two, which is at least 1/1024 of the box's largest extent.

    A coordinate of the result is 0 if the centre is no farther from 0 along this axis than the
    largest extent. Small coordinates of vertices would otherwise lose their last digits. If all
    vertices are equal, the result is their position.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extent = float((high - low).max())
    if extent == 0.0:
        return np.array(low)
    step = 2.0 ** np.ceil(np.log2(extent / 1024.0))
    middle = np.round((0.5 * low + 0.5 * high) / step) * step
    return np.where(np.abs(middle) > extent, middle, 0.0)


_GRAZING_SINE_MAX = 1e-6
"""Sine of the angle between a ray and a facet's plane, up to which rounding may make the ray lie in
the plane."""


def facet_normals(corners: np.ndarray) -> DoubleDouble:
    """Compute the normals of triangles, each with a length of twice the triangle's area.

    Parameters
    ----------
    corners : ndarray (3, 3, n)
        Corners of n facets [m]: first, second and third corner; x, y, z; facet.

    Returns
    -------
    DoubleDouble (3, n)
        x, y, z of each normal [m^2], oriented by the facet's winding.
    """
    first, second, third = (DoubleDouble.from_float64(corner) for corner in corners)
    return cross(subtract(second, first), subtract(third, first))


def plane_distances(
    corners: np.ndarray,
    facet_normal: DoubleDouble,
    plane_height: DoubleDouble,
    ray_origin: DoubleDouble,
    ray_direction: DoubleDouble,
) -> DoubleDouble:
    """Compute the distances along rays from their origins to the planes of facets (triangles).

    Parameters
    ----------
    corners : ndarray (3, 3, n)
        Corners of the facets [m], as in :func:`facet_normals`.
    facet_normal : DoubleDouble (3, n)
        Normals of the facets, as in :func:`facet_normals`.
    plane_height : DoubleDouble (n,)
        Scalar product of each normal with the vector from the ray's origin to the facet's first
        corner.
    ray_origin, ray_direction : DoubleDouble (3, n)
        Origins [m] and directions of the rays.

    Returns
    -------
    DoubleDouble (n,)
        Distance in lengths of `ray_direction`.

    Notes
    -----
    If a plane is so oblique that it lies along the ray within rounding, the hit may be anywhere on
    the facet. The distance is then limited to the interval between the distances of its corners.
    """
    normal_speed = dot(facet_normal, ray_direction)
    with np.errstate(all="ignore"):  # rays parallel to a plane
        quotient = plane_height.high / normal_speed.high
        remainder = subtract(
            plane_height, multiply(DoubleDouble.from_float64(quotient), normal_speed)
        )
        distance = quick_two_sum(quotient, (remainder.high + remainder.low) / normal_speed.high)
    x, y, z = np.abs(facet_normal.high)
    grazing_facets = np.flatnonzero(~(np.abs(normal_speed.high) > _GRAZING_SINE_MAX * (x + y + z)))
    if grazing_facets.size:
        grazing_origin = DoubleDouble(
            ray_origin.high[:, grazing_facets], ray_origin.low[:, grazing_facets]
        )
        x, y, z = grazing_direction = ray_direction.high[:, grazing_facets]
        squared_length = x**2 + y**2 + z**2
        corner_distances = []
        for corner in corners[:, :, grazing_facets]:
            from_origin = subtract(DoubleDouble.from_float64(corner), grazing_origin).high
            x, y, z = from_origin * grazing_direction
            corner_distances.append((x + y + z) / squared_length)
        nearest, farthest = np.min(corner_distances, axis=0), np.max(corner_distances, axis=0)
        grazing_distance = distance.high[grazing_facets]
        is_outside = ~((grazing_distance >= nearest) & (grazing_distance <= farthest))
        distance.low[grazing_facets[is_outside]] = 0.0
        distance.high[grazing_facets] = np.where(
            is_outside,
            np.where(grazing_distance < nearest, nearest, farthest),
            grazing_distance,
        )
    return distance
